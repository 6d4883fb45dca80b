"""The results folder, looked at with other libraries; which run is shown."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

import scenes
from copem_replay import replay as replays
from copem_replay.check import read_logs
from copem_replay.experiment import Experiment
from copem_replay.results import write_results
from copem_replay.run import Result, run, shown_logs, shown_run
from recordings import Obj, write_recording
from scenes import experiment

COLUMNS = {
    "log": pa.string(),
    "configuration": pa.string(),
    "run": pa.int64(),
    "object_id": pa.string(),
    "object_class": pa.string(),
    "onset_s": pa.float64(),
    "onset_at_start": pa.bool_(),
    "detected": pa.bool_(),
    "detection_s": pa.float64(),
    "captured_s": pa.float64(),
    "time_to_detection_s": pa.float64(),
    "distance_at_detection_m": pa.float64(),
    "gap_at_detection_m": pa.float64(),
    "ended_s": pa.float64(),
    "ended_by": pa.string(),
    "first_unit": pa.string(),
}
SUMMARY = [
    "configuration", "n", "list_rate_hz", "detected_share", "detected_share_low", "detected_share_high", "interval",
    "interval_over", "ttd_p5_s", "ttd_median_s", "ttd_p95_s", "ttd_rmst_s", "ttd_rmst_horizon_s", "dad_median_m",
    "dad_p5_m",
]  # fmt: skip


def plan(**changes: Any) -> Experiment:
    return experiment(ego="1", runs=3, **changes)


@pytest.fixture
def two_logs(tmp_path: Path) -> list[Path]:
    """Two recordings of one name in two folders: a car that comes from 100 m, and one that leaves at 70 m."""
    paths = []
    for folder, until in (("near", 60), ("far", 31)):
        frames = [(k / 10, [Obj(id=1, x=0.0), *([Obj(id=2, x=100.0 - k)] if k < until else [])]) for k in range(61)]
        path = tmp_path / folder / "drive.mcap"
        path.parent.mkdir()
        write_recording(path, frames, host=1)
        paths.append(path)
    return paths


def test_the_folder_of_several_logs(two_logs: list[Path], tmp_path: Path) -> None:
    chosen = plan(show={"logs": ["all"], "run": 1}, configurations={"GT": {"units": "truth"}, "PEM": {"units": "all"}})
    recordings, refused = read_logs(chosen, two_logs, None)
    assert not refused
    result = run(chosen, recordings)
    folder = tmp_path / "out"
    write_results(folder, chosen, recordings, result)
    names = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert names == {
        "experiment.yaml", "provenance.json", "detections.parquet", "summary.csv",
        "replay/near/drive.mcap", "replay/near/drive.rrd", "replay/far/drive.mcap", "replay/far/drive.rrd",
    }  # fmt: skip
    table = parquet.read_table(folder / "detections.parquet")
    assert {f.name: f.type for f in table.schema} == COLUMNS
    rows = table.to_pylist()
    assert len(rows) == 2 * 2 * 3, "logs × configurations × runs, one measured object each"
    assert [(r["log"], r["configuration"], r["run"]) for r in rows] == [
        (log, name, k) for log in ("near/drive", "far/drive") for name in ("GT", "PEM") for k in range(3)
    ]
    left = next(r for r in rows if r["log"] == "far/drive" and r["configuration"] == "PEM")
    assert left["detected"] is False
    assert left["ended_by"] == "object_left"
    for name in ("detection_s", "captured_s", "time_to_detection_s", "distance_at_detection_m", "first_unit"):
        assert left[name] is None, f"{name}: what does not exist is null"
    with (folder / "summary.csv").open(newline="") as file:
        summary = list(csv.DictReader(file))
    assert list(summary[0]) == SUMMARY
    assert [(s["configuration"], s["n"], s["detected_share"]) for s in summary] == [
        ("GT", "6", "1"),
        ("PEM", "6", "0.5"),
    ]
    assert summary[0]["interval"] == "", "two logs, two objects: too few to resample"
    provenance = json.loads((folder / "provenance.json").read_text())
    assert [entry["log"] for entry in provenance["logs"]] == ["near/drive", "far/drive"]
    assert any("no interval" in note for note in provenance["notes"])
    assert provenance["run_shown"] == {"near/drive": 1, "far/drive": 1}


def made_up(times: list[float | None]) -> Result:
    """A result of one log with these times to detection, run by run; the horizon is 9 s."""
    table = pd.DataFrame({"log": "scene", "run": range(len(times)), "time_to_detection_s": times})
    ready = replays.prepare(scenes.oncoming_car(), experiment())
    return Result(table, pd.DataFrame(), (), (ready,), 9.0)


@pytest.mark.parametrize(
    ("times", "median", "worst"),
    [
        ([3.0, 1.0, 2.0], 2, 0),
        ([3.0, None, 2.0], 0, 1),  # never detected counts as the horizon
        ([5.0, 1.0, 2.0, 5.0], 2, 3),
        ([4.0], 0, 0),
    ],
)
def test_which_run_is_shown(times: list[float | None], median: int, worst: int) -> None:
    result = made_up(times)
    assert shown_run(experiment(show={"run": "median"}), result, "scene") == median
    assert shown_run(experiment(show={"run": "worst"}), result, "scene") == worst
    assert shown_run(experiment(show={"run": 0}), result, "scene") == 0
    for nothing in ({"run": None}, None):
        assert shown_run(experiment(show=nothing), result, "scene") is None
        assert shown_logs(experiment(show=nothing), result) == []
    assert shown_logs(experiment(), result) == ["scene"]


def test_blocks_bound_what_is_held_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    log, many = scenes.oncoming_car(), experiment(runs=100)
    ready = replays.prepare(log, many)
    rows = len(ready.measured.tracks.frame_ix)
    monkeypatch.setattr(replays, "ROWS_TIMES_RUNS", 7 * rows)
    cut = replays.blocks(ready, many, jobs=1)
    assert max(map(len, cut)) == 7
    assert np.concatenate(cut).tolist() == list(range(100))
    whole = run(many, [log]).table
    monkeypatch.setattr(replays, "ROWS_TIMES_RUNS", 1)
    assert run(many, [log]).table.equals(whole)
