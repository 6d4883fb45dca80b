"""The tables of a study, log by log: all in memory or, where rows are many and kept, those of one log at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import pandas as pd
import pyarrow as pa

from copem_replay.metrics.way import WAY
from copem_replay.pipeline.log_tables import LogTables

HELD_BYTES = 1_000_000_000
"""So much of all logs is in memory at most where it can be read again (chosen: five million rows without accuracy)."""


class StudyTables:
    """`again`: reads the tables of a log that was added; None: all stay in memory. `way`: whether rows have `WAY`."""

    def __init__(self, again: Callable[[str], LogTables] | None = None, *, way: bool = False) -> None:
        self.counts: dict[str, int] = {}
        """Rows by log, in the order in which logs are added."""
        self._again, self._way = again, way
        self._held: dict[str, LogTables] = {}
        self._bytes = 0
        self._schema: pa.Schema | None = None  # of all rows; None: they are of pandas
        self._last: tuple[str, pd.DataFrame] | None = None

    def add(self, some: Sequence[LogTables]) -> pd.DataFrame:
        """The tables of more logs. Returns their rows."""
        for tables in some:
            self.counts[tables.log] = len(tables.rows)
            self._held[tables.log] = tables
            self._bytes += sum(one.nbytes for one in (tables.beside, tables.runs) if one is not None)
        arrow = [tables.rows for tables in some if isinstance(tables.rows, pa.Table)]
        if arrow:
            self._bytes += sum(rows.nbytes for rows in arrow)
            known = [] if self._schema is None else [self._schema]
            schemas = [*known, *(rows.schema.remove_metadata() for rows in arrow)]
            self._schema = pa.unify_schemas(schemas, promote_options="permissive")
        if self._again is not None and self._bytes > HELD_BYTES:
            self._held.clear()
        return self._frame([tables.rows for tables in some])

    @cached_property
    def whole(self) -> pd.DataFrame:
        """The rows of `detections.parquet` of all logs."""
        rows = self._frame([tables.rows for tables in self.each()])
        self._held = {log: replace(tables, rows=pd.DataFrame()) for log, tables in self._held.items()}
        return rows

    @property
    def many(self) -> bool:
        """Whether they are read again log by log."""
        return len(self._held) < len(self.counts)

    def rows(self, log: str) -> pd.DataFrame:
        """Those of one log."""
        if not self.many:
            return self.whole[self.whole["log"] == log]
        if self._last is None or self._last[0] != log:
            self._last = log, self._frame([self._of(log).rows])
        return self._last[1]

    def each(self) -> Iterator[LogTables]:
        """The tables of one log after the other; without rows where these are in `whole`."""
        return map(self._of, self.counts)

    def parts(self) -> Iterator[tuple[pd.DataFrame, Sequence[LogTables]]]:
        """Rows, and the tables that they are of, in parts of which one is in memory: of all logs, or of one each."""
        if not self.many:
            yield self.whole, list(self.each())
        else:
            yield from ((self._frame([tables.rows]), [tables]) for tables in self.each())

    def _of(self, log: str) -> LogTables:
        if log in self._held:
            return self._held[log]
        assert self._again is not None
        return self._again(log)

    def _frame(self, rows: Sequence[pd.DataFrame | pa.Table]) -> pd.DataFrame:
        """Rows of some logs, of the same kinds and columns however they came to be."""
        if self._schema is None:
            frame = pd.concat(rows, ignore_index=True).infer_objects()
        else:
            tables = [self._schema.empty_table(), *(one.replace_schema_metadata(None) for one in rows)]
            frame = pa.concat_tables(tables, promote_options="permissive").to_pandas()
        if "braking_pass" in frame:
            frame["braking_pass"] = pd.array(frame["braking_pass"], dtype="boolean")
        if not self._way:
            return frame
        # Columns that only some configurations have are in one place, however tables came together.
        return frame.reindex(columns=[*(name for name in frame if name not in WAY), *WAY])
