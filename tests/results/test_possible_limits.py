"""No limit is where its figure cannot be: every column with limits of a summary, of slices and of comparisons."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.experiment.draft.template import format_draft
from copem_replay.metrics.summary_metrics import COMPARED
from copem_replay.results.compare import compare_folders
from copem_replay.results.read import Results
from copem_replay.results.slices import summarise_slices
from tests.helpers.recordings import Obj, pedestrian, write_recording

SHARED = Path(__file__).parents[3] / "shared/data"
RECORDINGS = ("ind_aah1", "drone_swerve", "av2_3b3570b4")
LATE_S = 0.4
PEM = {"p": [{"when": {"range_m": [0, 40]}, "detection": {"kind": "constant", "probability": 0.7},
              "error": {"kind": "gaussian", "covariance_m2": [[0.5, 0], [0, 0.5]]}}]}  # fmt: skip
STUDY: dict[str, Any] = {
    "version": 1, "runs": 4, "pems": PEM, "show": None, "logs": [],
    "units": {"ego": {"on": "ego", "height_m": 1.8, "pem": "p"}},
    "configurations": {
        "GT": {"units": "truth"}, "ideal": {"units": ["ego"]}, "gnn": {"units": ["ego"], "fusion": {"kind": "gnn"}},
        "late": {"units": ["ego"], "fusion": {"kind": "gnn"}, "latency_s": LATE_S},
    },
    "braking": {"driver": {"kind": "constant_deceleration", "a_max_mps2": 8.0}},
    "measure": {"onset": {"kind": "in_range", "range_m": 50}, "began": ["log_start", "crossed", "appeared"],
                "horizon_s": 3, "by": ["class"]},
}  # fmt: skip
"""`late` knows nobody before its latency, `ideal` and the truth list nobody false."""


def replay(folder: Path, logs: int, walkers: int) -> Results:
    """The ego comes nearer to pedestrians, four metres apart."""
    for k in range(logs):
        there = [pedestrian(id=2 + w, x=56.0 + 4 * w, y=6.0) for w in range(walkers)]
        frames = [(0.1 * t, [Obj(id=1, x=0.8 * t, vx=8.0), *there]) for t in range(50)]
        write_recording(folder / f"d{k}.mcap", frames, host=1)
    return cr.run(STUDY, [folder / f"d{k}.mcap" for k in range(logs)])


def check_table(table: pd.DataFrame, least_s: dict[str, float]) -> int:
    """Check each figure with limits of a row per configuration, and return how many there are."""
    number = 0
    for row in table.to_dict("records"):
        name, horizon_s = row["configuration"], row["ttd_rmst_horizon_s"]
        for column in (of.removesuffix("_low") for of in table if of.endswith("_low") and of != "nees_low"):
            value, low, high = (row[f"{column}{end}"] for end in ("", "_low", "_high"))
            if pd.isna(low) and pd.isna(high):
                continue
            number += 1
            least = min(least_s[name], horizon_s) if column == "ttd_rmst_s" else 0.0
            most = 1.0 if "share" in column else horizon_s if column.endswith("_s") else math.inf
            assert least - 1e-9 <= low <= value <= high <= most + 1e-9, (name, column)
            if name == "GT" and column != "pass_share":
                assert low == value == high, f"{column} of the truth can be no other"
    return number


def check_comparison(results: Results, baseline: str) -> int:
    compared, number = compare_folders([results], baseline=baseline), 0
    for row in compared.table.dropna(subset=["low", "high"]).itertuples():
        number += 1
        most = 1.0 if "share" in row.metric else compared.horizon_s if row.metric.startswith("ttd_") else math.inf
        assert -most - 1e-9 <= row.low <= row.high <= most + 1e-9, (row.configuration, row.metric)
        errs = row.metric in ("position_rmse_held_m", "gospa_held_m", "false_positives_per_min", "needless_brake_share")
        errs |= row.metric in ("ttd_rmst_s", "detected_share", "unknown_to_horizon_s")
        if errs and "GT" in (row.configuration, baseline):  # nothing is better than the truth
            worse = -COMPARED[row.metric].better * (1 if baseline == "GT" else -1)
            assert worse * (row.low if worse > 0 else row.high) >= -1e-9, (row.configuration, row.metric)
        if row.metric == "false_positives_per_min" and baseline == "ideal":
            assert row.low >= 0, "fused by truth ids, nobody is false"
    return number


def check_results(results: Results, summary: pd.DataFrame, least_s: dict[str, float]) -> None:
    assert check_table(summary, least_s) > 3 * len(least_s) - 3
    for baseline in least_s:
        assert check_comparison(results, baseline) > 0


@pytest.mark.parametrize(("logs", "walkers"), [(1, 6), (1, 1), (3, 2)])
def test_no_limit_is_where_the_figure_cannot_be(tmp_path: Path, logs: int, walkers: int) -> None:
    results = replay(tmp_path, logs, walkers)
    least_s = dict.fromkeys(STUDY["configurations"], 0.0) | {"late": LATE_S}
    assert {name: of.least_s for name, of in results.facts.items()} == least_s
    if walkers > 1:
        check_results(results, results.summary, least_s)
        slices = summarise_slices(results, None)
        assert slices is not None
        assert check_table(slices.assign(ttd_rmst_horizon_s=3.0), least_s) > 0
    else:
        check_table(results.summary, least_s)
        check_comparison(results, "GT")


def test_what_is_known_before_counts_where_that_is_asked_for(tmp_path: Path) -> None:
    """Then a time may be below the latency, and below 0."""
    write_recording(tmp_path / "d.mcap", [(0.1 * t, [Obj(id=1), pedestrian(id=2, x=40.0)]) for t in range(9)], host=1)
    plan = STUDY | {"measure": {**STUDY["measure"], "count_earlier": True}}
    assert {of.least_s for of in cr.run(plan, [tmp_path / "d.mcap"]).facts.values()} == {0.0}


@pytest.mark.parametrize("name", RECORDINGS)
def test_of_real_recordings(tmp_path: Path, name: str) -> None:
    if not (SHARED / f"{name}.mcap").exists():
        pytest.skip("no shared/data beside the project")
    draft = format_draft(survey_recording(SHARED / f"{name}.mcap"))
    (tmp_path / "e.yaml").write_text(draft.replace("runs: 20", "runs: 6").replace("show: {run: 0}", "show: null"))
    results = cr.run(tmp_path / "e.yaml")
    check_table(results.summary, {of: facts.least_s for of, facts in results.facts.items()})
    assert sum(check_comparison(results, baseline) for baseline in ("GT", "ideal", "late")) > 0
