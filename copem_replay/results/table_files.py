"""Tables as files: Parquet written part by part and read log by log, CSV that spreadsheets take for what it is.

The place of each log's rows in a folder is known from a pass over the names alone; they may be in one file or in one
for each log, in any order. Only the rows of one log are in memory.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet

from copem_replay.core.errors import InputError
from copem_replay.core.files import avoid_device_name
from copem_replay.metrics.columns import TABLES, Column, find_columns, find_unit

AGAIN = "run the experiment again with --overwrite"
"""The way out for a table that is damaged or of an older version."""
MANY_ROWS = 10_000_000
"""A table with more rows than this is a folder of its name, with a file per log: as a whole it takes half a GB."""


def table_file(table: Path, log: str) -> Path:
    """The file with the rows of a log, of a table that is a folder."""
    return table / avoid_device_name(f"{quote(log, safe=' ')}.parquet")


# What is read is checked.


def read_parquet(path: Path, files: Sequence[Path] = ()) -> pd.DataFrame:
    """A table from Parquet. `files`: those of a table that is a folder."""
    table = parquet.read_table(list(files) or path).replace_schema_metadata(None)
    # Column by column, so that no column is in memory twice.
    return table.to_pandas(split_blocks=True, self_destruct=True)


def read_frame(path: Path, reader: Callable[[Path], pd.DataFrame], kinds: Mapping[str, str]) -> pd.DataFrame:
    """A table with at least these columns, each checked against its definition. Raises InputError."""
    with _report_damage(path):
        table = reader(path)
    check_columns(path, kinds, table.columns)
    of_csv = path.suffix == ".csv"
    columns = find_columns(path.name)
    if of_csv:  # other columns are metrics of the user's own
        columns |= {name: Column(name, "numbers", "", infinite=True) for name in table if name not in columns}
    for name, column in columns.items() if len(table) else ():
        if name in table:
            _check_series(path, column, table[name], optional=of_csv)
    keys = [name for name in TABLES[path.name].keys if name in table]
    if keys and (twice := table.duplicated(keys)).any():
        found = ", ".join(map(str, table.loc[twice.idxmax(), keys]))
        raise InputError(f"{path}: expected one row for each {', '.join(keys)}, found several for {found}; {AGAIN}")
    return table


def _check_series(path: Path, column: Column, values: pd.Series, *, optional: bool) -> None:
    """Raise InputError where a column as pandas has it is of another kind, or its values cannot be."""
    try:
        array = pa.array(values, from_pandas=True)
    except (TypeError, ValueError, OverflowError):  # values of several kinds
        raise InputError(f"{path}: column {column.name}: expected {column.kind}, found others; {AGAIN}") from None
    if array.null_count < len(array):  # with nulls pandas has whole numbers as others
        check_kind(path, column.name, column.kind.replace("whole numbers", "numbers"), array.type)
    check_values(path, column, array, optional=optional)


def check_columns(path: Path, expected: Iterable[str], present: Collection[str]) -> None:
    """Raise InputError where a column is missing, or there several times."""
    counts = Counter(list(present))
    for name in expected:
        if counts[name] != 1:
            raise InputError(f"{path}: expected the column {name}, found {counts[name] or 'none'}; {AGAIN}")


def check_kind(path: Path, name: str, kind: str, data_type: pa.DataType) -> None:
    """Raise InputError where a column is of another kind."""
    if not _is_kind(kind, data_type):
        shown = "text" if _is_kind("text", data_type) else data_type
        raise InputError(f"{path}: column {name}: expected {kind}, found {shown}; {AGAIN}")


_MOST_S = 1e10
"""Times of recordings are 64-bit nanoseconds."""
_MOST = 1e100
"""Squares of numbers, and their sums, are numbers."""
_MOST_WHOLE = 1e15
"""Whole numbers up to here are exact as others, too."""
_IN_EVERY_ROW = {"text": "text", "true or false": "true or false", "numbers": "a number", "whole numbers": "a number"}


def check_values(path: Path, column: Column, values: Any, *, optional: bool = False) -> None:
    """Raise InputError where values, an array of Arrow, are missing in a column that is full, or absurd.

    Text is missing nowhere but where its column says so, or where it is `optional`. Numbers are finite but where their
    column says otherwise; whole ones, which count or number something, are not below 0.
    """
    kind = column.kind
    full = column.full or (kind == "text" and not optional)
    if full and pc.any(pc.is_null(values, nan_is_null=True)).as_py():
        raise InputError(
            f"{path}: column {column.name}: expected {_IN_EVERY_ROW[kind]} in every row, found none in some; {AGAIN}"
        )
    if column.among and (others := set(pc.unique(values).drop_null().to_pylist()).difference(column.among)):
        expected = f"one of {', '.join(column.among)}"
        raise InputError(f"{path}: column {column.name}: expected {expected}, found {min(others)!r}; {AGAIN}")
    if pa.types.is_list(values.type) or pa.types.is_large_list(values.type):
        values = pc.list_flatten(values)
    if column.infinite or not (pa.types.is_integer(values.type) or pa.types.is_floating(values.type)):
        return
    whole = kind.endswith("whole numbers")
    most = _MOST_WHOLE if whole else _MOST_S if column.name.endswith("_s") else _MOST
    least = 0 if whole else -most
    for value in pc.min_max(values).as_py().values():
        if value is not None and not least <= value <= most and value == value:
            raise InputError(
                f"{path}: column {column.name}: expected numbers from {least:g} to {most:g}, found {value:g}; {AGAIN}"
            )


def _is_kind(kind: str, data_type: pa.DataType) -> bool:
    """Whether a column of this Arrow type can hold a kind of values, such as `numbers or null`."""
    types = pa.types
    if kind.startswith("lists of "):
        listed = types.is_list(data_type) or types.is_large_list(data_type)
        return bool(listed and _is_kind(kind.removeprefix("lists of "), data_type.value_type))
    if types.is_null(data_type):  # nothing but nulls
        return kind != "text"
    return bool(
        {
            "text": types.is_string(data_type) or types.is_large_string(data_type) or types.is_dictionary(data_type),
            "whole numbers": types.is_integer(data_type),
            "numbers": types.is_integer(data_type) or types.is_floating(data_type),
            "true or false": types.is_boolean(data_type),
        }[kind.removesuffix(" or null")]
    )


# Log by log.


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
        """A log's rows (columns of `kinds` but `log`, text as `string`). Raises InputError where values are damaged."""
        names = [name for name in self.kinds if name != "log"]
        parts = self.read(log, names)
        table = pa.concat_tables(parts) if parts else self.without_rows.select(names)
        columns = find_columns(self.place.name)
        for k, name in enumerate(names):
            if name in columns:
                check_values(self.place, columns[name], table[name])
            if self.kinds[name] == "text":
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


def read_log_rows(place: Path, kinds: Mapping[str, str], files: Sequence[Path] = ()) -> LogRows:
    """A table in a file, which has at least columns of these kinds. `files`: those of a table that is a folder.

    Raises InputError where the table cannot be read, lacks a column, or has one of another kind.
    """
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
                check_values(place, find_columns(place.name)[name], group[name])
            counts.update(_count_rows(group))
            for log, begin, end in _find_stretches(group["log"].combine_chunks()):
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


def check_configurations(rows: LogRows, names: Collection[str]) -> None:
    """Raise InputError where rows are of another experiment or missing, or where there are none."""
    unknown = [name for name in rows.configurations if name not in names]
    if unknown:
        raise InputError(f"{rows.place}: expected the configurations of experiment.yaml, found {unknown[0]!r}; {AGAIN}")
    if not rows.counts:
        raise InputError(f"{rows.place}: expected rows to draw, found none: no measured object has an onset")
    # A configuration that has none of its units in a log is left out of that log.
    counts = [*rows.counts.values(), *[0] * (set(names) != set(rows.configurations))]
    counts_of: dict[str, set[int]] = {}
    for (log, _), count in rows.counts.items():
        counts_of.setdefault(log, set()).add(count)
    if 0 in counts or any(len(sizes) > 1 for sizes in counts_of.values()):
        raise InputError(
            f"{rows.place}: expected as many rows of each configuration, found {min(counts)} to {max(counts)}; {AGAIN}"
        )


def _count_rows(table: pa.Table) -> dict[tuple[str, str], int]:
    """Rows by log and configuration."""
    keys = ["log", "configuration"]
    sizes = table.group_by(keys, use_threads=False).aggregate([([], "count_all")]).to_pydict()
    return dict(zip(zip(sizes["log"], sizes["configuration"], strict=True), sizes["count_all"], strict=True))


@contextmanager
def _report_damage(place: Path) -> Iterator[None]:
    """Raise InputError where Arrow or pandas cannot read a table."""
    try:
        yield
    except KeyError as error:  # of a column that is asked for by its name
        name = error.args[0].decode() if isinstance(error.args[0], bytes) else error.args[0]
        raise InputError(f"{place}: expected the column {name}, found none; {AGAIN}") from None
    except (OSError, ValueError) as error:  # what Arrow and pandas raise derives from these
        why = " ".join(str(error).split())
        raise InputError(f"{place}: expected a table that can be read, found damage: {why}; {AGAIN}") from None


def _find_stretches(names: pa.Array) -> Iterator[tuple[str, int, int]]:
    """Stretches of equal names: name, first row, row after the last."""
    column = names if pa.types.is_dictionary(names.type) else names.dictionary_encode()
    name_ix, distinct = column.indices.to_numpy(), column.dictionary.to_pylist()
    ends = np.append(np.flatnonzero(np.diff(name_ix)) + 1, len(name_ix)).tolist()
    for begin, end in zip([0, *ends], ends, strict=False):
        yield distinct[name_ix[begin]], begin, end


# Parquet is written part by part.

ROWS_A_GROUP = 1 << 17
GROUP_BYTES = 1 << 26
"""Rows of a row group of Parquet, at most, and about their bytes: it is in memory as a whole, where it is written and
where it is compared."""


def write_parquet(table: Any, path: Path) -> None:
    """Write a table, of pandas or Arrow, as Parquet: NaN as null, text as `string` whatever type pandas has."""
    with TableFile(path) as file:
        file.add(table)


class TableFile:
    """A Parquet file written part by part; row groups do not depend on the parts, whose columns are equal."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: parquet.ParquetWriter | None = None
        self._left: pa.Table | None = None  # rows of an incomplete group
        self._written = False  # whether any group

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._writer is not None and self._left is not None:
            if error[0] is None and (len(self._left) or not self._written):
                self._write(self._left)
            self._writer.close()

    def add(self, table: Any) -> None:
        """Add a pandas or Arrow table; rows are written in full row groups, the remainder is held until more come."""
        arrow = pa.Table.from_pandas(table, preserve_index=False) if isinstance(table, pd.DataFrame) else table
        arrow = arrow.cast(pa.schema([_write_field(field) for field in arrow.schema], arrow.schema.metadata))
        if self._writer is None:
            self._writer = parquet.ParquetWriter(self._path, arrow.schema, compression="zstd")
        if self._left is not None:
            arrow = pa.concat_tables([self._left, arrow])
        while (count := _count_group_rows(arrow)) <= len(arrow):
            self._write(arrow.slice(0, count))
            arrow = arrow.slice(count)
        self._left = arrow

    def _write(self, rows: pa.Table) -> None:
        """Write a row group, as one chunk whatever the chunks of its rows."""
        assert self._writer is not None
        self._writer.write_table(rows.combine_chunks(), row_group_size=ROWS_A_GROUP)
        self._written = True


def _write_field(field: pa.Field) -> pa.Field:
    """A column as it is written: with its unit in its metadata, as `unit`."""
    unit = find_unit(field.name)
    kind = pa.string() if pa.types.is_large_string(field.type) else field.type
    return pa.field(field.name, kind, field.nullable, metadata=None if unit is None else {"unit": unit})


def _count_group_rows(table: pa.Table) -> int:
    """How many rows of a table are its first row group; one more than there are: no group is complete."""
    sizes = np.zeros(min(len(table), ROWS_A_GROUP), dtype=np.int64)
    for column in table.slice(0, ROWS_A_GROUP).columns:
        if pa.types.is_list(column.type) or pa.types.is_large_list(column.type):
            lengths = pc.fill_null(pc.list_value_length(column), 0).to_numpy()
            sizes += lengths * (column.type.value_type.bit_width // 8)
    return min(int(np.searchsorted(np.cumsum(sizes), GROUP_BYTES)) + 1, ROWS_A_GROUP)


# CSV. A name that begins with `=`, `+`, `-`, `@`, a tab or a line's end gets an apostrophe before it,
# which tells spreadsheets that it is text; so does one that begins with an apostrophe, so that taking one away gives
# every name back.

_QUOTE = "'"
_QUOTED = ("=", "+", "-", "@", "\t", "\r", "\n", _QUOTE)


def write_csv(table: pd.DataFrame, path: Path) -> None:
    """Write a table as CSV: nulls empty, numbers with nine significant digits, names quoted for spreadsheets."""
    quote_formulas(table).to_csv(path, index=False, float_format="%.9g", lineterminator="\n")


def quote_formulas(table: pd.DataFrame) -> pd.DataFrame:
    """A table with an apostrophe before each text that a spreadsheet would take for a formula; numbers stay."""
    text = [name for name, column in table.items() if not pd.api.types.is_numeric_dtype(column)]
    return table.assign(**{name: table[name].map(_quote_cell) for name in text})


def unquote_names(table: pd.DataFrame, columns: Iterable[str]) -> pd.DataFrame:
    """A table with the names in `columns` as they were before `quote_formulas`."""
    return table.assign(**{name: table[name].map(_unquote_cell) for name in columns})


def _quote_cell(value: Any) -> Any:
    return _QUOTE + value if isinstance(value, str) and value.startswith(_QUOTED) else value


def _unquote_cell(value: Any) -> Any:
    return value.removeprefix(_QUOTE) if isinstance(value, str) else value


def read_csv(path: Path) -> pd.DataFrame:
    """A table from CSV: names are text, whatever they look like, and only empty cells are missing."""
    text = {name: str for name, column in find_columns(path.name).items() if column.kind.startswith("text")}
    table = pd.read_csv(path, dtype=text, na_values=[""], keep_default_na=False)
    names = [name for name in ("configuration", "sweep", "by", "group") if name in table]
    return unquote_names(table.fillna(dict.fromkeys(names, "")), names)
