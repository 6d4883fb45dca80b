"""Accuracy of a fusion that remembers is held against an ideal that remembers; everything else against the ideal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import copem_replay as cr
from copem_replay.results.compare.compare import compare_folders
from copem_replay.results.read import read_results
from tests.helpers.recordings import Obj, pedestrian, write_recording

TEXT = """\
version: 1
logs: [drive.mcap]
runs: 3
pems: {p: {couples: [{detection: {kind: constant, probability: 0.7},
                      error: {kind: gaussian, covariance_m2: [[1, 0], [0, 1]]}}]}}
units: {ego: {on: ego, height_m: 1.8, pem: p}, mast: {at: [9, 9], height_m: 5, pem: p}}
configurations:
  ideal:    {units: all, latency_s: 0.2}
  memory:   {units: all, latency_s: 0.2, fusion: {kind: ideal, memory: {kind: constant_velocity}}}
  other:    {units: all, latency_s: 0.1, fusion: {kind: ideal, memory: {kind: constant_velocity}}}
  gnn:      {units: all, latency_s: 0.2, fusion: {kind: gnn}}
  tracker:  {units: all, latency_s: 0.2, fusion: {kind: tracker}}
  alone:    {units: [ego], fusion: {kind: tracker}}
measure: {onset: {kind: appears}, began: [log_start, appeared], by: [class]}
show: {run: null}
"""


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("remembering")
    frames = [
        (
            0.1 * k,
            [Obj(id=1, x=0.1 * k), pedestrian(id=2, x=20.0, y=-3 + 0.1 * k), Obj(id=3, x=40.0 - k, y=4.0, vx=-10.0)],
        )
        for k in range(31)
    ]
    write_recording(folder / "drive.mcap", frames, host=1)
    (folder / "plan.yaml").write_text(TEXT, encoding="utf-8")
    cr.run(folder / "plan.yaml").save(folder / "out")
    return folder / "out"


HELD = {"position_rmse_held_m", "gospa_held_m"}


def test_what_remembers_is_held_against_what_remembers(out: Path) -> None:
    comparison = compare_folders([out], by=["class"])
    rows = comparison.table
    assert set(rows[(rows["configuration"] == "tracker") & rows["metric"].isin(HELD)]["baseline"]) == {"memory"}
    assert set(rows[(rows["configuration"] != "tracker") | ~rows["metric"].isin(HELD)]["baseline"]) == {"ideal"}
    assert [note for note in comparison.notes if "remembers" in note] == [
        "tracker: accuracy held against memory, ideal fusion of the same lists that remembers, too"
    ]
    against = compare_folders([out], baseline="memory").table
    for metric in HELD:
        one, other = (
            of[(of["configuration"] == "tracker") & (of["metric"] == metric)].iloc[0] for of in (rows, against)
        )
        for name in ("value", "baseline_value", "difference", "low", "high", "n", "frames", "baseline_age_s"):
            np.testing.assert_equal(one[name], other[name])
    assert comparison.groups is not None
    groups = comparison.groups
    assert set(groups[(groups["configuration"] == "tracker") & groups["metric"].isin(HELD)]["baseline"]) == {"memory"}


def test_who_is_asked_for_is_the_baseline_of_all(out: Path) -> None:
    comparison = compare_folders([out], baseline="ideal")
    assert set(comparison.table["baseline"]) == {"ideal"}
    assert not [note for note in comparison.notes if "remembers" in note]


def test_whose_memory_it_is(out: Path) -> None:
    """Of the same units whose lists come alike; a recorded output or one without memory has none."""
    facts = read_results(out).facts
    assert {name: of.remembering for name, of in facts.items()} == {
        "ideal": None, "memory": None, "other": None, "gnn": None, "tracker": "memory", "alone": None,
    }  # fmt: skip
