"""What the folders of all kinds of results hold alike: tables, versions, and which recordings they are of."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import pandas as pd
import pyarrow as pa
from pyarrow import parquet

from copem_replay.core.remote import Remote
from copem_replay.experiment.file import at_place
from copem_replay.experiment.schema import LogSettings
from copem_replay.experiment.validate import place_of
from copem_replay.io.recording import Recording
from copem_replay.io.together import File, first_of
from copem_replay.pipeline.study_log import digests_of

_LIBRARIES = (
    "foxglove-schemas-protobuf", "mcap", "numba", "numpy", "osi-python", "pandas", "protobuf", "pyarrow", "rerun-sdk",
    "scipy", "shapely",
)  # fmt: skip
ROWS_A_GROUP = 1 << 17
"""Rows of a row group of Parquet, at most (chosen: comparisons read whole ones, also of lists per row)."""


def log_entries(logs: Sequence[Any], recordings: Sequence[Recording], folder: Path) -> list[Any]:
    """`logs` as the folder has it: a path relative to it each, with the log's settings where it has some."""

    def called(file: File) -> str:
        return written_name(file, folder)

    settings = [entry for entry in logs if isinstance(entry, LogSettings)]
    if len(settings) < len(recordings):
        return [called(first_of(recording.place)) for recording in recordings]
    moved = (at_place(one, r.place, called) for one, r in zip(settings, recordings, strict=True))
    return [one.model_dump(mode="json", by_alias=True) for one in moved]


def written_name(file: File, folder: Path) -> str:
    """What results in a folder call a recording: its path from there, or its URL without user and query."""
    return str(file) if isinstance(file, Remote) else os.path.relpath(place_of(file), folder)


def versions() -> dict[str, object]:
    """Of this project, of Python, and of what decides on numbers."""
    return {
        "copem_replay": version("copem-replay"),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in _LIBRARIES},
    }


def said_of_logs(recordings: Sequence[Recording]) -> list[dict[str, object]]:
    """Which recordings they were, by their content."""
    return [{"log": r.scene.log, "topic": r.topic, **digests_of(r)} for r in recordings]


def write_parquet(table: Any, path: Path) -> None:
    """A table, of pandas or of Arrow, as Parquet: NaN as null, text as `string` whatever pandas keeps it in."""
    with TableFile(path) as file:
        file.add(table)


class TableFile:
    """The same part by part: row groups do not depend on how it is cut. Parts have the same columns of one kind."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: parquet.ParquetWriter | None = None
        self._left: pa.Table | None = None  # less than a group
        self._written = False  # any group

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._writer is not None and self._left is not None:
            if error[0] is None and (len(self._left) or not self._written):
                self._write(self._left)
            self._writer.close()

    def add(self, table: Any) -> None:
        """More rows."""
        arrow = pa.Table.from_pandas(table, preserve_index=False) if isinstance(table, pd.DataFrame) else table
        fields = [pa.field(f.name, pa.string()) if pa.types.is_large_string(f.type) else f for f in arrow.schema]
        arrow = arrow.cast(pa.schema(fields, arrow.schema.metadata))
        if self._writer is None:
            self._writer = parquet.ParquetWriter(self._path, arrow.schema, compression="zstd")
        if self._left is not None:
            arrow = pa.concat_tables([self._left, arrow])
        for k in range(0, whole := len(arrow) // ROWS_A_GROUP * ROWS_A_GROUP, ROWS_A_GROUP):
            self._write(arrow.slice(k, ROWS_A_GROUP))
        self._left = arrow.slice(whole)

    def _write(self, rows: pa.Table) -> None:
        """A row group, of one chunk however the table was put together."""
        assert self._writer is not None
        self._writer.write_table(rows.combine_chunks(), row_group_size=ROWS_A_GROUP)
        self._written = True
