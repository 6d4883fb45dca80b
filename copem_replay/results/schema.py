"""The schema of a results folder: columns and kinds of its tables, how they are read and written, its provenance."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet

from copem_replay.core.errors import InputError, RemoteFile
from copem_replay.core.files import avoid_device_name, parse_json
from copem_replay.experiment.file import relocate_settings
from copem_replay.experiment.schema import LogSettings
from copem_replay.experiment.validate import resolve_place
from copem_replay.io.open import File, first_recording
from copem_replay.io.recording import Recording
from copem_replay.metrics.config import Measure
from copem_replay.pipeline.study_log import compute_log_digests
from copem_replay.results.folder import MARK

MANY_ROWS = 10_000_000
"""A table with more rows than this is a folder of its name, with a file per log: as a whole it takes half a GB."""


def table_file(table: Path, log: str) -> Path:
    """The file with the rows of a log, of a table that is a folder."""
    return table / avoid_device_name(f"{quote(log, safe=' ')}.parquet")


FORMAT = 3
"""The format of results folders: raised when columns, files or their meaning change so that readers have to know."""

AGAIN = "run the experiment again with --overwrite"
"""The way out for a table that is damaged or of an older version."""

EXACT = ("log", "configuration", "object_id", "episode", "began", "time_to_detection_s", "probability")
_KEYS = {"log": "text", "configuration": "text", "run": "whole numbers"}
_OBJECT = _KEYS | {"object_id": "text"}
DETECTIONS = _OBJECT | {
    "episode": "whole numbers",
    "onset_s": "numbers",
    "began": "text",
    "detected": "true or false",
    "detection_s": "numbers",
    "distance_at_detection_m": "numbers",
    "ended_s": "numbers",
    "ended_by": "text",
}
VERDICTS = {"conflict": "true or false", "braking_pass": "true or false"}
"""Columns of `detections.parquet` that comparisons read with braking, beside `DETECTIONS`; figures read those below."""
ROWS = DETECTIONS | {"object_class": "text", "captured_s": "numbers", "time_to_detection_s": "numbers"}
BRAKING = VERDICTS | dict.fromkeys(("brake_s", "min_distance_m", "impact_s", "impact_speed_mps"), "numbers")
CONFLICT = {
    "conflict_detected": "true or false",
    "conflict_detection_s": "numbers",
    "distance_at_conflict_detection_m": "numbers",
}
_OBJECT_COLUMNS = ("object_id", "object_class", "episode", "onset_s", "began", "ended_s", "ended_by")
TALLY = ("log", "configuration", "event", *_OBJECT_COLUMNS, "time_to_detection_s", "distance_at_detection_m", "runs")
HELD = ("error_held_m", "age_held_s", "gospa_held_m2")
"""Columns of `accuracy.parquet` with a value for each frame."""
OPTIONAL = {
    "accuracy.parquet": _OBJECT
    | {"episode": "whole numbers", "ghosts": "whole numbers", "first_frame": "whole numbers"}
    | dict.fromkeys(HELD, "lists of numbers"),
    "instants.parquet": {
        "log": "text",
        "configuration": "text",
        "available_s": "lists of numbers",
        "frame_s": "lists of numbers",
        "held_list": "lists of whole numbers",
    },
    "lists.parquet": _KEYS
    | {
        "minutes": "numbers",
        "ghosts": "whole numbers",
        "without_truth": "whole numbers",
        "existence": "lists of numbers",
        "ghosts_at": "lists of whole numbers",
    },
    "thresholds.parquet": _OBJECT | {"episode": "whole numbers", "existence": "numbers", "detection_s": "numbers"},
}
"""Optional files of a results folder, and their columns that comparisons read."""
MAY_HAVE = {"detections.parquet": ROWS | BRAKING | CONFLICT, "instants.parquet": {"run": "whole numbers"}}
"""Optional columns; `instants.parquet` has `run` where runs differ in their units."""
_NUMBERS = {name for name, kind in (ROWS | CONFLICT).items() if kind in ("numbers", "whole numbers")} | {
    "value", "list_rate_hz", "probability", "n", "runs",
}  # fmt: skip


def read_csv(path: Path) -> pd.DataFrame:
    """A table from CSV: names are text, whatever they look like, and only empty cells are missing."""
    text = {"configuration": str, "sweep": str}
    table = pd.read_csv(path, dtype=text, na_values=[""], keep_default_na=False)
    return unquote_names(table.fillna({name: "" for name in text if name in table}), [n for n in text if n in table])


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
    if not _is_kind(kind, found):
        raise InputError(f"{path}: column {name}: expected {kind}, found {found}; {AGAIN}")


def check_text(path: Path, name: str, column: pa.ChunkedArray) -> None:
    """Raise InputError where a name is missing."""
    if column.null_count:
        raise InputError(f"{path}: column {name}: expected text in every row, found none in some; {AGAIN}")


def _is_kind(kind: str, what: pa.DataType) -> bool:
    import pyarrow as pa

    types = pa.types
    if kind.startswith("lists of "):
        listed = types.is_list(what) or types.is_large_list(what)
        return bool(listed and _is_kind(kind.removeprefix("lists of "), what.value_type))
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


# The provenance of results: `provenance.json`, read back.


@dataclass(frozen=True)
class RecordedLog:
    """A recording that was replayed: its name in the tables, the topic of its truth, the SHA-256 of its content.

    `truth`: the SHA-256 of its truth, None in results of older versions.
    """

    name: str
    topic: str | None
    sha256: str
    truth: str | None = None


@dataclass(frozen=True)
class Provenance:
    """`provenance.json`. `measure` has every default filled in. `data`: the whole file."""

    logs: tuple[RecordedLog, ...]
    seed: int
    runs: int
    visibility: str | None
    max_gap_s: float | None
    window_s: object
    measure: dict[str, Any]
    braking: dict[str, Any] | None
    horizon_used_s: float
    run_shown: dict[str, int]  # by log
    data: dict[str, Any]


def check_format(folder: Path) -> None:
    """Raise InputError, one line, where a folder has results of another format; without results nothing is raised."""
    if (folder / MARK).is_file():
        read_provenance(folder / MARK)


_SKIPPED = ("log", "reason")
"""Keys of each of `logs_skipped`."""


def read_provenance(path: Path) -> Provenance:
    """Read `provenance.json`. Raises InputError."""
    try:
        data: Any = parse_json(path.read_text(encoding="utf-8"))
        if (found := dict(data).get("format", 1)) != FORMAT:
            raise InputError(f"{path.parent}: expected results of format {FORMAT}, found format {found}; {AGAIN}")
        logs = tuple(
            RecordedLog(str(log["log"]), log.get("topic"), str(log["sha256"]), log.get("truth")) for log in data["logs"]
        )
        notes = [*data.get("notes", []), *(log[name] for log in data.get("logs_skipped", []) for name in _SKIPPED)]
        if not all(isinstance(note, str) for note in notes):
            raise ValueError("expected text in notes and logs_skipped")
        measure, braking, gap_s = dict(data["measure"]), data.get("braking"), data.get("max_gap_s")
        used_s, run_shown = float(measure.pop("horizon_used_s")), data.get("run_shown") or {}
        return Provenance(
            logs=logs,
            seed=int(data["seed"]),
            runs=int(data["runs"]),
            visibility=data.get("visibility"),
            max_gap_s=None if gap_s is None else float(gap_s),
            window_s=data.get("window_s"),
            # A missing key, from an older version, stands for its default.
            measure=Measure().model_dump(mode="json", by_alias=True) | measure,
            braking=None if braking is None else dict(braking),
            horizon_used_s=used_s,
            run_shown={str(log): int(run) for log, run in run_shown.items() if run is not None},
            data=data,
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise InputError(f"{path}: expected the provenance of results, found damage: {why}; {AGAIN}") from None


# Common to all kinds of results: recordings, versions, tables.

_LIBRARIES = (
    "foxglove-schemas-protobuf", "mcap", "numba", "numpy", "osi-python", "pandas", "protobuf", "pyarrow", "rerun-sdk",
    "scipy", "shapely",
)  # fmt: skip
ROWS_A_GROUP = 1 << 17
GROUP_BYTES = 1 << 26
"""Rows of a row group of Parquet, at most, and about their bytes: it is in memory as a whole, where it is written and
where it is compared."""


def log_entries(logs: Sequence[Any], recordings: Sequence[Recording], folder: Path) -> list[Any]:
    """`logs` of the folder's experiment: paths relative to the folder, with settings where logs have them."""

    def called(file: File) -> str:
        return recording_name(file, folder)

    settings = [entry for entry in logs if isinstance(entry, LogSettings)]
    if len(settings) < len(recordings):
        return [called(first_recording(recording.place)) for recording in recordings]
    moved = (relocate_settings(one, r.place, called) for one, r in zip(settings, recordings, strict=True))
    return [one.model_dump(mode="json", by_alias=True) for one in moved]


def recording_name(file: File, folder: Path) -> str:
    """The name of a recording in results: its path relative to the folder, or its URL without user and query."""
    return str(file) if isinstance(file, RemoteFile) else os.path.relpath(resolve_place(file), folder)


def list_versions() -> dict[str, object]:
    """Versions of this project, of Python, and of the libraries that results depend on."""
    return {
        "copem_replay": version("copem-replay"),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in _LIBRARIES},
    }


def describe_logs(recordings: Sequence[Recording]) -> list[dict[str, object]]:
    """Name, topic and content digests of each recording."""
    return [{"log": r.scene.log, "topic": r.topic, **compute_log_digests(r)} for r in recordings]


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
        """Add rows."""
        arrow = pa.Table.from_pandas(table, preserve_index=False) if isinstance(table, pd.DataFrame) else table
        fields = [pa.field(f.name, pa.string()) if pa.types.is_large_string(f.type) else f for f in arrow.schema]
        arrow = arrow.cast(pa.schema(fields, arrow.schema.metadata))
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


def _count_group_rows(table: pa.Table) -> int:
    """How many rows of a table are its first row group; one more than there are: no group is complete."""
    sizes = np.zeros(min(len(table), ROWS_A_GROUP), dtype=np.int64)
    for column in table.slice(0, ROWS_A_GROUP).columns:
        if pa.types.is_list(column.type) or pa.types.is_large_list(column.type):
            lengths = pc.fill_null(pc.list_value_length(column), 0).to_numpy()
            sizes += lengths * (column.type.value_type.bit_width // 8)
    return min(int(np.searchsorted(np.cumsum(sizes), GROUP_BYTES)) + 1, ROWS_A_GROUP)


# Names in CSV files. A name that begins with `=`, `+`, `-`, `@`, a tab or a line's end gets an apostrophe before it,
# which tells spreadsheets that it is text; so does one that begins with an apostrophe, so that taking one away gives
# every name back.

_QUOTE = "'"
_QUOTED = ("=", "+", "-", "@", "\t", "\r", "\n", _QUOTE)


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
