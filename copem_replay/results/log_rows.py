"""Rows of a table log by log: only those of one log are in memory.

The place of each log's rows in a folder is known from a pass over the names alone; they may be in one file or in one
for each log, in any order.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import InputError
from copem_replay.results.schema import AGAIN, TABLES, check_columns, check_kind, check_text

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, eq=False)
class LogRows:
    """One table, log by log: the kinds of its columns, rows by log and configuration in the order of both.

    `read`: the named columns of a log's rows, in parts.
    """

    place: Path
    kinds: Mapping[str, str]
    counts: Mapping[tuple[str, str], int]
    without_rows: pa.Table
    read: Callable[[str, Sequence[str]], list[pa.Table]]

    def of(self, log: str) -> pa.Table:
        """A log's rows without the column `log`, text as `string`. Raises InputError where they are damaged."""
        import pyarrow as pa

        names = [name for name in self.kinds if name != "log"]
        parts = self.read(log, names)
        table = pa.concat_tables(parts) if parts else self.without_rows.select(names)
        for k, name in enumerate(names):
            if self.kinds[name] == "text":
                check_text(self.place, name, table[name])
                table = table.set_column(k, name, table[name].cast(pa.string()))
        return table

    @property
    def logs(self) -> tuple[str, ...]:
        """The logs that have rows, in their order."""
        return tuple(dict.fromkeys(log for log, _ in self.counts))

    @property
    def configurations(self) -> tuple[str, ...]:
        """The configurations that have rows, in their order."""
        return tuple(dict.fromkeys(configuration for _, configuration in self.counts))

    def only(self, names: Iterable[str]) -> LogRows:
        """The table with those of the named columns that it has."""
        columns = self.without_rows.column_names
        return replace(self, kinds={name: self.kinds.get(name, "") for name in names if name in columns})

    def renamed(self, to: Mapping[str, str]) -> LogRows:
        """The table with its logs renamed, `to` by the old names."""
        counts = {(to.get(log, log), configuration): n for (log, configuration), n in self.counts.items()}
        before = {to.get(log, log): log for log in self.logs}
        return replace(self, counts=counts, read=lambda log, names: self.read(before.get(log, log), names))


def log_rows(place: Path, kinds: Mapping[str, str], files: Sequence[Path] = ()) -> LogRows:
    """A table in a file, which has at least columns of these kinds. `files`: those of a table that is a folder.

    Raises InputError where the table cannot be read, lacks a column, or has one of another kind.
    """
    import pyarrow as pa
    from pyarrow import parquet

    names, schema = ["log", "configuration"], pa.schema([])
    where: dict[str, list[tuple[Path, int, int, int]]] = {}  # of each log's rows: file, row group, from, to
    counts: Counter[tuple[str, str]] = Counter()
    for path in files or [place]:
        with _report_damage(place):
            file = parquet.ParquetFile(path, read_dictionary=names)
            schema = file.schema_arrow.remove_metadata()
        known = {c.name: c.kind for c in TABLES[place.name].columns if c.name in schema.names}
        check_columns(place, {**kinds, **known}, schema.names)
        kinds = known
        for name, kind in kinds.items():
            column_type = schema.field(name).type
            if file.metadata.num_rows or not pa.types.is_null(column_type):  # without rows columns may have no types
                check_kind(place, name, kind, column_type)
        for k in range(file.num_row_groups if file.metadata.num_rows else 0):
            with _report_damage(place):
                group = file.read_row_group(k, names).unify_dictionaries()
            for name in names:
                check_text(place, name, group[name])
            counts.update(count_rows(group))
            for log, begin, end in find_stretches(group["log"].combine_chunks()):
                where.setdefault(log, []).append((path, k, begin, end))
    last: dict[tuple[object, ...], pa.Table] = {}

    def read(log: str, columns: Sequence[str]) -> list[pa.Table]:
        parts = []
        for file, k, begin, end in where.get(log, ()):
            if (key := (file, k, *columns)) not in last:
                last.clear()
                with _report_damage(place):
                    group = parquet.ParquetFile(file).read_row_group(k, list(columns))
                    last[key] = group.replace_schema_metadata(None)  # pandas would parse any text in it
            parts.append(last[key].slice(begin, end - begin))
        return parts

    return LogRows(place, kinds, counts, schema.empty_table(), read)


def count_rows(table: pa.Table) -> dict[tuple[str, str], int]:
    """Rows by log and configuration."""
    keys = ["log", "configuration"]
    sizes = table.group_by(keys, use_threads=False).aggregate([([], "count_all")]).to_pydict()
    return dict(zip(zip(sizes["log"], sizes["configuration"], strict=True), sizes["count_all"], strict=True))


@contextmanager
def _report_damage(place: Path) -> Iterator[None]:
    """Raise InputError where Arrow cannot read a table."""
    try:
        yield
    except KeyError as error:  # of a column that is asked for by its name
        name = error.args[0].decode() if isinstance(error.args[0], bytes) else error.args[0]
        raise InputError(f"{place}: expected the column {name}, found none; {AGAIN}") from None
    except (OSError, ValueError) as error:  # what Arrow raises derives from these
        why = " ".join(str(error).split())
        raise InputError(f"{place}: expected a table that can be read, found damage: {why}; {AGAIN}") from None


def find_stretches(names: pa.Array) -> Iterator[tuple[str, int, int]]:
    """Stretches of equal names: name, first row, row after the last."""
    import pyarrow as pa

    column = names if pa.types.is_dictionary(names.type) else names.dictionary_encode()
    name_ix, distinct = column.indices.to_numpy(), column.dictionary.to_pylist()
    ends = np.append(np.flatnonzero(np.diff(name_ix)) + 1, len(name_ix)).tolist()
    for begin, end in zip([0, *ends], ends, strict=False):
        yield distinct[name_ix[begin]], begin, end
