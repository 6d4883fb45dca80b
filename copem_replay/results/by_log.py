"""The tables that comparisons read, log by log: of a table of any size only the rows of one log are in memory.

Where each log's rows are is known from a pass over the names alone. They may be in one file or in one for each log, in
any order.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import InputError
from copem_replay.results.tables import AGAIN, MAY_HAVE, check_kind, check_text

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, eq=False)
class LogRows:
    """One table: which columns of which kinds, and where the rows of each log are: file, row group, from, to."""

    place: Path
    kinds: Mapping[str, str]
    where: Mapping[str, Sequence[tuple[Path, int, int, int]]]
    counts: Mapping[tuple[str, str], int]  # rows by log and configuration, in the order of both
    without_rows: pa.Table
    _last: dict[tuple[Path, int], pa.Table] = field(default_factory=dict)

    def of(self, log: str) -> pa.Table:
        """The columns of a log's rows but `log`, text as `string`. Raises InputError where they are damaged."""
        import pyarrow as pa
        from pyarrow import parquet

        names, parts = [name for name in self.kinds if name != "log"], []
        for file, k, begin, end in self.where.get(log, ()):
            if (file, k) not in self._last:
                self._last.clear()
                with _damage(self.place):
                    self._last[file, k] = parquet.ParquetFile(file).read_row_group(k, names)
            parts.append(self._last[file, k].slice(begin, end - begin))
        table = pa.concat_tables(parts) if parts else self.without_rows.select(names)
        for k, name in enumerate(names):
            if self.kinds[name] == "text":
                check_text(self.place, name, table[name])
                table = table.set_column(k, name, table[name].cast(pa.string()))
        return table

    @property
    def configurations(self) -> tuple[str, ...]:
        """Those that have rows, in their order."""
        return tuple(dict.fromkeys(configuration for _, configuration in self.counts))

    def only(self, names: Iterable[str]) -> LogRows:
        """The same with these of its columns."""
        there = self.without_rows.column_names
        return replace(self, kinds={name: self.kinds.get(name, "") for name in names if name in there}, _last={})

    def renamed(self, to: Mapping[str, str]) -> LogRows:
        """The same of logs by other names."""
        where = {to.get(log, log): of for log, of in self.where.items()}
        counts = {(to.get(log, log), configuration): n for (log, configuration), n in self.counts.items()}
        return replace(self, where=where, counts=counts, _last={})


def log_rows(place: Path, kinds: Mapping[str, str], files: Sequence[Path] = ()) -> LogRows:
    """Where the rows of each log are in a table. `files`: of one that is a folder.

    Raises InputError where it cannot be read, or lacks a column, or has one of another kind.
    """
    import pyarrow as pa
    from pyarrow import parquet

    names, schema = ["log", "configuration"], pa.schema([])
    where: dict[str, list[tuple[Path, int, int, int]]] = {}
    counts: Counter[tuple[str, str]] = Counter()
    for path in files or [place]:
        with _damage(place):
            file = parquet.ParquetFile(path, read_dictionary=names)
            schema = file.schema_arrow
        if missing := [name for name in kinds if name not in schema.names]:
            raise InputError(f"{place}: expected the column {missing[0]}, found none; {AGAIN}")
        kinds = dict(kinds) | {name: k for name, k in MAY_HAVE.get(place.name, {}).items() if name in schema.names}
        for name, kind in kinds.items():
            found = schema.field(name).type
            if file.metadata.num_rows or not pa.types.is_null(found):  # without rows columns may have no types
                check_kind(place, name, kind, found)
        for k in range(file.num_row_groups if file.metadata.num_rows else 0):
            with _damage(place):
                group = file.read_row_group(k, names).unify_dictionaries()
            for name in names:
                check_text(place, name, group[name])
            found = group.group_by(names, use_threads=False).aggregate([([], "count_all")]).to_pydict()
            counts.update(
                dict(zip(zip(found["log"], found["configuration"], strict=True), found["count_all"], strict=True))
            )
            for log, begin, end in _stretches(group["log"].combine_chunks()):
                where.setdefault(log, []).append((path, k, begin, end))
    return LogRows(place, kinds, where, counts, schema.empty_table())


@contextmanager
def _damage(place: Path) -> Iterator[None]:
    """Raise InputError where Arrow cannot read a table."""
    try:
        yield
    except (OSError, ValueError) as error:  # what Arrow raises derives from these
        why = " ".join(str(error).split())
        raise InputError(f"{place}: expected a table that can be read, found damage: {why}; {AGAIN}") from None


def _stretches(names: pa.Array) -> Iterator[tuple[str, int, int]]:
    """Which name stands from which row to which."""
    import pyarrow as pa

    column = names if pa.types.is_dictionary(names.type) else names.dictionary_encode()
    of, known = column.indices.to_numpy(), column.dictionary.to_pylist()
    ends = np.append(np.flatnonzero(np.diff(of)) + 1, len(of)).tolist()
    for begin, end in zip([0, *ends], ends, strict=False):
        yield known[of[begin]], begin, end
