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

from copem_replay.pipeline.run import run_experiment
from copem_replay.results.compare.compare import compare_folders
from copem_replay.results.write import write_results
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
        "measure": {"onset": {"kind": "appears"}},
        "configurations": {
            "ideal": {"units": "all", **LATE}, "gnn": {"units": "all", "fusion": {"kind": "gnn"}, **LATE},
            "alone": {"units": ["ego"]},
        },
    }  # fmt: skip
    recordings = [replace(log, path=path / "scene.mcap")]
    plan = experiment(**more)
    write_results(path / "out", plan, recordings, run_experiment(plan, recordings), exporters=())
    return path / "out"


def plainly(folder: Path, name: str, metric: str) -> tuple[float, float]:
    """Of a configuration and of ideal fusion, over the instants at which both have a value, run by run."""
    accuracy = parquet.read_table(folder / "accuracy.parquet").to_pandas()
    instants = parquet.read_table(folder / "instants.parquet").to_pandas()
    sums, lists = np.zeros(2), set()
    count = 0
    for (run_number, _), both in accuracy.groupby(["run", "object_id"]):
        values = []
        for one in (name, "ideal"):
            row = both[both["configuration"] == one].iloc[0]
            mine = (instants["configuration"] == one) & (instants["run"] == run_number)
            times = instants[mine]["available_s"].iloc[0]
            said = row["error_m"] if metric == "position_rmse_m" else row["gospa_m2"]
            here = times[row["first_list"] : row["first_list"] + len(said)]
            values.append({round(t, 6): v for t, v in zip(here, said, strict=True) if v is not None and v == v})
        for t in values[0].keys() & values[1].keys():
            pair = np.array([values[0][t], values[1][t]])
            sums += pair**2 if metric == "position_rmse_m" else pair
            count += 1
            lists.add((run_number, t))
    n = count if metric == "position_rmse_m" else len(lists)
    first, second = np.sqrt(sums / n)
    return float(first), float(second)


@pytest.mark.parametrize("metric", ["position_rmse_m", "gospa_m"])
@pytest.mark.parametrize("name", ["gnn", "alone"])
def test_regret_over_shared_instants_of_each_run(folder: Path, name: str, metric: str) -> None:
    table = compare_folders([folder], configurations=[name]).overall.set_index("metric")
    expected = plainly(folder, name, metric)
    assert table.loc[metric, ["value", "baseline_value"]].tolist() == pytest.approx(expected, rel=1e-6)
    assert table.loc[metric, "difference"] == pytest.approx(expected[0] - expected[1], rel=1e-6)


def test_what_is_compared_is_that_of_other_configurations(folder: Path) -> None:
    """All metrics, with intervals; what is left out are instants that one side does not have, counted over the runs."""
    comparison = compare_folders([folder])
    metrics = comparison.overall.groupby("configuration")["metric"].agg(set)
    assert {"position_rmse_m", "gospa_m", "false_positives_per_min"} <= metrics["gnn"] & metrics["alone"]
    assert not any("no accuracy.parquet" in note for note in comparison.notes)
    instants = parquet.read_table(folder / "instants.parquet").to_pandas()
    counts = instants.groupby("configuration")["available_s"].agg(lambda of: sum(map(len, of)))
    assert counts["alone"] == 6 * 21
    assert counts["gnn"] == counts["ideal"] > counts["alone"]
    assert instants[instants["configuration"] == "gnn"]["available_s"].map(len).nunique() > 1
    assert any(f"of {counts['alone']} and the {counts['ideal']} of ideal" in note for note in comparison.notes)
    rows = comparison.overall.set_index(["configuration", "metric"])
    assert pd.notna(rows.loc[("gnn", "position_rmse_m"), "low"])


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
    assert (six.by_run, len(six.of_run), len(two.of_run)) == (True, 6, 2)
    for place in range(2):
        np.testing.assert_array_equal(six.available_s[six.of_run[place]], two.available_s[two.of_run[place]])
