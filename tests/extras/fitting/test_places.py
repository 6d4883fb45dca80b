"""Errors and misses in place, read back: every point where and when the rows have it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from copem_replay.extras.fitting.page import write_fit_places
from tests.extras.fitting.fit_rows import rows_of

os.environ["RERUN_ANALYTICS"] = "0"  # before it is imported, which is when something is written


def _column(path: Path, entity: str, component: str) -> tuple[list[int], list[Any]]:
    from rerun.chunk import RrdReader

    elapsed_ns: list[int] = []
    values: list[Any] = []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            [name] = [name for name in batch.schema.names if component in name]
            elapsed_ns += batch.column("elapsed").cast("int64").to_pylist()
            values += batch.column(name).to_pylist()
    return elapsed_ns, values


def test_every_row_is_where_and_when_it_was(tmp_path: Path) -> None:
    rows, lists = rows_of(1, passes=3, lists_each=20)
    path = tmp_path / "places.rrd"
    write_fit_places(path, "rsu", ("drive",), rows, lists)
    for what, which in (("listed", rows.listed), ("missed", ~rows.listed)):
        elapsed_ns, points = _column(path, f"/world/drive/{what}", "positions")
        found = np.array([[*point[:2], at] for at, each in zip(elapsed_ns, points, strict=True) for point in each])
        expected = np.column_stack([rows.state_m[which], np.rint(rows.captured_s[which] * 1e9)])
        np.testing.assert_allclose(found[np.argsort(found[:, 2])], expected, rtol=1e-6)
    elapsed_ns, vectors = _column(path, "/world/drive/error", "vectors")
    found = np.array([one[:2] for each in vectors for one in each])
    expected = np.column_stack([rows.east_m, rows.north_m])[rows.listed]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
