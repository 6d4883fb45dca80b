"""Tables of a results folder, read with the columns that are needed: by pandas or, for comparisons, by Arrow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import pandas as pd

from copem_replay.core.csv_names import as_named
from copem_replay.core.errors import InputError

if TYPE_CHECKING:
    import pyarrow as pa

MANY_ROWS = 10_000_000
"""A table with more rows than this is a folder of its name, with a file per log (chosen: half a GB in memory)."""


def file_of(table: Path, log: str) -> Path:
    """Where the rows of a log are, of a table that is a folder."""
    return table / f"{quote(log, safe=' ')}.parquet"


FORMAT = 2
"""Of results folders: raised when columns, files or their meaning change so that readers have to know."""

AGAIN = "run the experiment again with --overwrite"
"""What helps against a table that is damaged or of an older version."""

NUMBERS = ("run", "onset_s", "captured_s", "detection_s", "time_to_detection_s", "distance_at_detection_m", "ended_s")
ROWS = ("log", "configuration", "object_id", "object_class", "detected", "ended_by", *NUMBERS)
BRAKING = ("conflict", "braking_pass", "brake_s", "min_distance_m", "impact_s", "impact_speed_mps")
CONFLICT = ("conflict_detected", "conflict_detection_s", "distance_at_conflict_detection_m")
EXACT = ("log", "configuration", "object_id", "time_to_detection_s", "probability")
_KEYS = {"log": "text", "configuration": "text", "run": "whole numbers"}
_OBJECT = _KEYS | {"object_id": "text"}
DETECTIONS = _OBJECT | {
    "onset_s": "numbers",
    "detected": "true or false",
    "detection_s": "numbers",
    "distance_at_detection_m": "numbers",
    "ended_s": "numbers",
    "ended_by": "text",
}
VERDICTS = {"conflict": "true or false", "braking_pass": "true or false"}
OPTIONAL = {
    "accuracy.parquet": _OBJECT
    | {
        "first_list": "whole numbers",
        "error_m": "lists of numbers",
        "gospa_m2": "lists of numbers",
        "ghosts": "whole numbers",
    },
    "instants.parquet": {"log": "text", "configuration": "text", "available_s": "lists of numbers"},
    "lists.parquet": _KEYS
    | {
        "minutes": "numbers",
        "ghosts": "whole numbers",
        "existence": "lists of numbers",
        "ghosts_at": "lists of whole numbers",
    },
    "thresholds.parquet": _OBJECT | {"existence": "numbers", "detection_s": "numbers"},
}
"""Files of a results folder that need not be there, and the columns of them that comparisons read."""
MAY_HAVE = {"instants.parquet": {"run": "whole numbers"}}
"""Columns that a file has where runs differ in their units."""


def read_csv(path: Path) -> pd.DataFrame:
    """A table of which names stay text and what is empty is missing, whatever else a name looks like."""
    text = {"configuration": str, "sweep": str}
    table = pd.read_csv(path, dtype=text, na_values=[""], keep_default_na=False)
    return as_named(table.fillna({name: "" for name in text if name in table}), [n for n in text if n in table])


def read_frame(path: Path, reader: Callable[[Path], pd.DataFrame], columns: Sequence[str]) -> pd.DataFrame:
    """A table with at least these columns. Raises InputError."""
    try:
        table = reader(path)
    except (OSError, ValueError) as error:  # what Arrow and pandas raise derives from these
        why = " ".join(str(error).split())
        raise InputError(f"{path}: expected a table that can be read, found damage: {why}; {AGAIN}") from None
    if missing := [name for name in columns if name not in table.columns]:
        raise InputError(f"{path}: expected the column {missing[0]}, found none; {AGAIN}")
    for name in set(columns) & {*NUMBERS, "value", "list_rate_hz", "probability", "n"}:
        if table[name].dtype.kind not in "iuf" and table[name].notna().any():
            raise InputError(f"{path}: column {name}: expected numbers, found {table[name].dtype}; {AGAIN}")
    return table


def is_rowless(path: Path) -> bool:
    """Whether a table is sound and has no row. Its columns then have no types either."""
    from pyarrow import parquet

    if path.is_dir():
        return False
    try:
        return bool(parquet.read_metadata(path).num_rows == 0)
    except (OSError, ValueError):  # the reader of the table reports it
        return False


def read_arrow(path: Path, columns: Mapping[str, str], files: Sequence[Path] = ()) -> pa.Table:
    """These columns of a table, text as `string`, and those that it may have. `files`: of one that is a folder.

    Raises InputError where one is missing or of another kind.
    """
    import pyarrow as pa
    from pyarrow import parquet

    try:
        there = parquet.read_schema(files[0] if files else path).names
        if missing := [name for name in columns if name not in there]:
            raise InputError(f"{path}: expected the column {missing[0]}, found none; {AGAIN}")
        columns = dict(columns) | {n: kind for n, kind in MAY_HAVE.get(path.name, {}).items() if n in there}
        table = parquet.read_table(list(files) or path, columns=list(columns))
    except (OSError, ValueError) as error:  # what Arrow raises derives from these
        why = " ".join(str(error).split())
        raise InputError(f"{path}: expected a table that can be read, found damage: {why}; {AGAIN}") from None
    for k, (name, kind) in enumerate(columns.items()):
        column = table[name]
        if kind == "text" and pa.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        if not _is(kind, column.type):
            raise InputError(f"{path}: column {name}: expected {kind}, found {column.type}; {AGAIN}")
        if kind == "text":
            if column.null_count:
                raise InputError(f"{path}: column {name}: expected text in every row, found none in some; {AGAIN}")
            column = column.cast(pa.string())
        table = table.set_column(k, name, column)
    return table


def _is(kind: str, what: pa.DataType) -> bool:
    import pyarrow as pa

    types = pa.types
    if kind.startswith("lists of "):
        listed = types.is_list(what) or types.is_large_list(what)
        return bool(listed and _is(kind.removeprefix("lists of "), what.value_type))
    if types.is_null(what):  # nothing but nulls
        return kind != "text"
    return bool(
        {
            "text": types.is_string(what) or types.is_large_string(what) or types.is_dictionary(what),
            "whole numbers": types.is_integer(what),
            "numbers": types.is_integer(what) or types.is_floating(what),
            "true or false": types.is_boolean(what),
        }[kind]
    )
