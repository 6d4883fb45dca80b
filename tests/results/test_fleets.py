"""The regret of fleets: every run has its own units and so its own instants; pairs are told run by run."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from pyarrow import parquet

from copem_replay.results.compare.compare import compare_folders
from tests.helpers.replays import save_run
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing

SEES = [{"detection": {"kind": "constant", "probability": 0.8},
         "error": {"kind": "gaussian", "covariance_m2": [[0.3, 0.0], [0.0, 0.2]]}}]  # fmt: skip


def came(since_s: float, t: float) -> bool:
    return t >= since_s


LATE = {"latency_s": {"ego": 0.0, "default": 0.13}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ego and six cars that come one by one, each with a unit in half of the runs, 7 Hz; the ego's is at 10 Hz."""
    path: Path = tmp_path_factory.mktemp("fleets")
    cars = [Thing(f"c{k}", "car", driving(8 * k, 6, 2), there=partial(came, 0.3 * k)) for k in range(6)]
    things = [Thing("ego", "car", standing(0, 0)), *cars]
    (path / "scene.mcap").write_bytes(b"what the provenance has a digest of")
    log = recording(things, until_s=2.0)
    fleet = {"on": {"classes": ["car"], "penetration_rate": 0.5}, "pem": "sure", "rate_hz": 7.0, "height_m": 1.5}
    more: dict[str, Any] = {
        "pems": {"sure": SEES}, "units": {"ego": EGO_UNIT, "obu": fleet}, "runs": 6,
        "measure": {"onset": {"kind": "appears"}, "began": ["log_start", "appeared"]},
        "configurations": {
            "ideal": {"units": "all", **LATE}, "gnn": {"units": "all", "fusion": {"kind": "gnn"}, **LATE},
            "alone": {"units": ["ego"]},
        },
    }  # fmt: skip
    recordings = [replace(log, path=path / "scene.mcap")]
    plan = experiment(**more)
    save_run(path / "out", plan, recordings, replays=False)
    return path / "out"


def plainly(folder: Path, name: str, metric: str) -> tuple[float, float]:
    """Of a configuration and of ideal fusion, frame by frame from the first list of both on, run by run."""
    accuracy = parquet.read_table(folder / "accuracy.parquet").to_pandas()
    instants = parquet.read_table(folder / "instants.parquet").to_pandas().set_index(["configuration", "run"])
    column = "error_held_m" if metric == "position_rmse_held_m" else "gospa_held_m2"
    sums, frames, count = np.zeros(2), set(), 0
    for (run, _), both in accuracy.groupby(["run", "object_id"]):
        begins_s = max(instants.loc[one, run]["available_s"][0] for one in (name, "ideal"))
        rows = [both[both["configuration"] == one].iloc[0] for one in (name, "ideal")]
        frame_s = instants.loc["ideal", run]["frame_s"][rows[0]["first_frame"] :]
        for t, *pair in zip(frame_s, *(row[column] for row in rows), strict=False):
            values = np.array(pair, dtype=float)
            if t >= begins_s - 1e-6 and not np.isnan(values).any():
                sums += values**2 if metric == "position_rmse_held_m" else values
                count += 1
                frames.add((run, t))
    n = count if metric == "position_rmse_held_m" else len(frames)
    first, second = np.sqrt(sums / n)
    return float(first), float(second)


@pytest.mark.parametrize("metric", ["position_rmse_held_m", "gospa_held_m"])
@pytest.mark.parametrize("name", ["gnn", "alone"])
def test_regret_over_frames_of_each_run(folder: Path, name: str, metric: str) -> None:
    table = compare_folders([folder], configurations=[name]).overall.set_index("metric")
    expected = plainly(folder, name, metric)
    assert table.loc[metric, ["value", "baseline_value"]].tolist() == pytest.approx(expected, rel=1e-6)
    assert table.loc[metric, "difference"] == pytest.approx(expected[0] - expected[1], rel=1e-6)


def test_what_is_compared_is_that_of_other_configurations(folder: Path) -> None:
    """All metrics, with intervals, over frames that all runs have alike whatever the instants of their lists."""
    comparison = compare_folders([folder])
    metrics = comparison.overall.groupby("configuration")["metric"].agg(set)
    assert {"position_rmse_held_m", "gospa_held_m", "false_positives_per_min"} <= metrics["gnn"] & metrics["alone"]
    assert not any("no accuracy.parquet" in note for note in comparison.notes)
    instants = parquet.read_table(folder / "instants.parquet").to_pandas()
    counts = instants.groupby("configuration")["available_s"].agg(lambda of: sum(map(len, of)))
    assert counts["alone"] == 6 * 21
    assert counts["gnn"] == counts["ideal"] > counts["alone"]
    assert instants[instants["configuration"] == "gnn"]["available_s"].map(len).nunique() > 1
    assert instants["frame_s"].map(tuple).nunique() == 1
    rows = comparison.overall.set_index(["configuration", "metric"])
    assert rows.loc[("gnn", "gospa_held_m"), "frames"] == rows.loc[("alone", "gospa_held_m"), "frames"] == 6 * 21
    assert pd.notna(rows.loc[("gnn", "position_rmse_held_m"), "low"])


def test_fewer_runs_are_the_first_ones(folder: Path) -> None:
    """Instants of runs that are not compared are not read for others."""
    from copem_replay.results.compare.labels import label_configurations
    from copem_replay.results.compare.pairing import build_grid, lay_out_configuration
    from copem_replay.results.read import open_results

    results = open_results(folder)
    (log,) = results.provenance.logs
    tables = results.rows_of(log.name)
    whole = build_grid(0, [tables["detections.parquet"]], results.provenance.runs, 0)
    fewer = replace(whole, runs=2)
    gnn = next(one for one in label_configurations([results]) if one.label == "gnn")
    six, two = (lay_out_configuration(gnn, tables, grid).accuracy for grid in (whole, fewer))
    assert six is not None
    assert two is not None
    assert (len(six.of_run), len(two.of_run)) == (6, 2)
    for place in range(2):
        assert six.begins[six.of_run[place]] == two.begins[two.of_run[place]]
        np.testing.assert_array_equal(six.holds[six.of_run[place]], two.holds[two.of_run[place]])
