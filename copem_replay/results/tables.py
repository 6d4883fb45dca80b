"""Tables of a results folder, read with the columns that are needed: by pandas or, for comparisons, by Arrow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
"""What comparisons read of `detections.parquet`, and where there is braking; below, what figures read besides."""
ROWS = DETECTIONS | {"object_class": "text", "captured_s": "numbers", "time_to_detection_s": "numbers"}
BRAKING = VERDICTS | dict.fromkeys(("brake_s", "min_distance_m", "impact_s", "impact_speed_mps"), "numbers")
CONFLICT = {
    "conflict_detected": "true or false",
    "conflict_detection_s": "numbers",
    "distance_at_conflict_detection_m": "numbers",
}
_OF_OBJECT = ("object_id", "object_class", "onset_s", "ended_s", "ended_by")
TALLY = ("log", "configuration", "event", *_OF_OBJECT, "time_to_detection_s", "distance_at_detection_m", "runs")
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
MAY_HAVE = {"detections.parquet": ROWS | BRAKING | CONFLICT, "instants.parquet": {"run": "whole numbers"}}
"""Columns that a file need not have; instants are of runs where these differ in their units."""
_NUMBERS = {name for name, kind in (ROWS | CONFLICT).items() if kind in ("numbers", "whole numbers")} | {
    "value", "list_rate_hz", "probability", "n", "runs",
}  # fmt: skip


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
    for name in _NUMBERS.intersection(columns):
        if table[name].dtype.kind not in "iuf" and table[name].notna().any():
            raise InputError(f"{path}: column {name}: expected numbers, found {table[name].dtype}; {AGAIN}")
    return table


def check_kind(path: Path, name: str, kind: str, found: pa.DataType) -> None:
    """Raise InputError where a column is of another kind."""
    if not _is(kind, found):
        raise InputError(f"{path}: column {name}: expected {kind}, found {found}; {AGAIN}")


def check_text(path: Path, name: str, column: pa.ChunkedArray) -> None:
    """Raise InputError where a name is missing."""
    if column.null_count:
        raise InputError(f"{path}: column {name}: expected text in every row, found none in some; {AGAIN}")


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
