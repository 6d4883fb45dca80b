"""No view of a recording says known before the table does: of every configuration, run and object that is shown.

A pedestrian waits beside the road and sets out at 1 s, another appears at 1.4 s and leaves at 2.2 s; the ego passes.
What counts is what `detections.parquet` says; lanes, words, curves and the arrays behind them are held against it.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording, read_log
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.replay import replay_block
from copem_replay.pipeline.sight import ABSENT, compute_sight
from copem_replay.pipeline.status import EARLY, KNOWN, TOO_LATE, UNCONFIRMED, compute_status, read_episode_clocks
from copem_replay.results.shown_objects import choose_shown_objects
from copem_replay.viewer import write_rrd
from tests.helpers.recordings import SHARED
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing
from tests.viewer.test_rrd import SUMMARY, rows
from tests.viewer.test_status import PERSON, labels, lane, told

RUNS = 6
NOISY = {"kind": "gaussian", "covariance_m2": [[0.2, 0.0], [0.0, 0.2]]}
CONFIGURATIONS: dict[str, Any] = {
    "GT": {"units": "truth"},
    "GT late": {"units": "truth", "latency_s": 0.4},
    "PEM": {"units": ["ego"]},
    "late": {"units": "all", "latency_s": 1.5, "max_age_s": 0.4},
    "mixed": {"units": "all", "latency_s": {"ego": 0.0, "default": 0.55}, "fusion": {"kind": "ideal",
              "combine": "posterior"}},
    "gnn": {"units": "all", "latency_s": 0.3, "fusion": {"kind": "gnn"}},
    "union": {"units": "all", "latency_s": 0.7, "fusion": {"kind": "union"}},
    "tracker": {"units": "all", "latency_s": {"ego": 0.0, "default": 0.3}, "fusion": {"kind": "tracker"}},
}  # fmt: skip
STARTS = {"kind": "starts_moving", "speed_mps": 0.3, "within_m": 60}


def waiting() -> Recording:
    return recording(
        [
            Thing("ego", "car", driving(-10, 0, 5)),
            Thing("2", "pedestrian", _sets_out),
            Thing("3", "pedestrian", driving(15, 6, 0, -1), there=lambda t: 1.39 < t < 2.21),
            Thing("4", "pedestrian", standing(20, -5)),
            Thing("5", "truck", standing(3, -4)),
        ],
        until_s=4.0,
    )


def _sets_out(t: float) -> tuple[float, float]:
    return 10.0, -5.0 + max(t - 1.0, 0.0)


def plan(**measure: Any) -> Experiment:
    seen = [{"detection": {"kind": "constant", "probability": 0.6}, "error": NOISY}]
    return experiment(
        runs=RUNS, pems={"sure": seen, "pole": seen},
        units={"ego": EGO_UNIT, "pole": {"at": [0, 9], "height_m": 5.0, "pem": "pole", "rate_hz": 7}},
        configurations=CONFIGURATIONS,
        measure={"objects": {"classes": ["pedestrian"]}, "onset": STARTS} | measure,
    )  # fmt: skip


MEASURES: dict[str, dict[str, Any]] = {
    "plain": {},
    "earlier": {"count_earlier": True},
    "2 of 3": {"confirm": {"hits": 2, "of": 3}},
    "3 of 5, earlier": {"confirm": {"hits": 3, "of": 5}, "count_earlier": True},
    "on the way": {"onset": {"kind": "in_range", "range_m": 12}},
}


def shown_in(replay: Replay, wanted: Experiment, run: int) -> tuple[pd.DataFrame, list[int]]:
    table = replay_block(replay, wanted, np.array([run]))
    return table, list(choose_shown_objects(replay.scene, replay.truth, wanted, table).object_ix)


def agrees(replay: Replay, wanted: Experiment, run: int, table: pd.DataFrame, shown: list[int]) -> set[int]:
    """Hold every status of one run against the table; which statuses there are."""
    seen, run_tracks, found = compute_sight(replay, wanted, shown), tracks_of_run(replay, wanted, run), set()
    for name in wanted.configurations:
        of = compute_status(
            replay, wanted, name, run_tracks[name], seen, read_episode_clocks(replay.scene, table, name)
        )
        fused, episodes = run_tracks[name].fused, table[table["configuration"] == name].set_index("object_id")
        newest = np.searchsorted(fused.arrives_s[0], of.elapsed_ns / 1e9 + 1e-6, side="right") - 1
        for m, k in enumerate(shown):
            episode = episodes.loc[replay.scene.object_ids[k]]
            time_s, status = of.elapsed_ns / 1e9, of.status[:, m]
            found |= set(status.tolist())
            rows = np.flatnonzero(fused.valid[0] & (fused.row_object_ix == k))
            held, onset_s = np.isin(newest, fused.frame_ix[rows]), episode["onset_s"] - 1e-6
            since = run_tracks[name].captured_s[0, rows] >= (-np.inf if wanted.measure.count_earlier else onset_s)
            counts = held & ((time_s < onset_s) | np.isin(newest, fused.frame_ix[rows[since]]) | (status == KNOWN))
            assert ((status >= EARLY) == counts).all(), "nothing is listed without being one of these"
            assert EARLY not in status[time_s >= onset_s]
            if episode["detected"]:
                assert ((status == KNOWN) == (held & (time_s >= episode["detection_s"] - 1e-9))).all()
                assert (status[np.abs(time_s - episode["detection_s"]) < 1e-9] == KNOWN).any()
            else:
                assert not (status == KNOWN).any()
            # What was captured since the onset is known, or waits for another, or came when all was over.
            assert wanted.measure.confirm.hits > 1 or UNCONFIRMED not in status
            before = status[time_s < episode["onset_s"] - 1e-6]
            assert TOO_LATE not in before
            assert wanted.measure.count_earlier or KNOWN not in before
    return found


@pytest.mark.parametrize("measure", MEASURES)
def test_known_is_what_the_table_says(measure: str) -> None:
    """Never before `detection_s`, from there on whenever the newest list holds it; otherwise it is listed at most."""
    wanted = plan(**MEASURES[measure])
    replay = prepare_log(waiting(), wanted)
    found = set()
    for run in range(RUNS):
        table, shown = shown_in(replay, wanted, run)
        assert shown
        found |= agrees(replay, wanted, run, table, shown)
    assert {KNOWN, ABSENT} <= found
    assert (EARLY in found) == (not wanted.measure.count_earlier)
    assert (UNCONFIRMED in found) == (wanted.measure.confirm.hits > 1)


@pytest.mark.parametrize("measure", ["plain", "2 of 3"])
def test_so_it_is_on_a_drive(measure: str) -> None:
    """A recorded one, with every object that has an onset: 30 m from the ego."""
    if not (path := SHARED / "nuscenes_scene0061.mcap").exists():
        pytest.skip(f"no {path}")
    seen = [{"when": {"range_m": [0, 50]}, "detection": {"kind": "visible_share"}, "error": NOISY}]
    wanted = experiment(
        pems={"sure": seen},
        configurations={
            "GT": {"units": "truth"},
            **{f: {"units": ["ego"], "latency_s": 0.3, "fusion": {"kind": f}} for f in ("ideal", "gnn", "tracker")},
        },
        measure={"onset": {"kind": "in_range", "range_m": 30}} | MEASURES[measure],
    )
    replay = prepare_log(read_log(path, name="drive"), wanted)
    table = replay_block(replay, wanted, np.array([0]))
    shown = [replay.scene.object_number[name] for name in dict.fromkeys(table["object_id"])]
    assert len(shown) > 20
    assert {EARLY, KNOWN} <= agrees(replay, wanted, 0, table, shown)


@pytest.mark.parametrize("measure", ["plain", "3 of 5, earlier"])
def test_so_do_all_views(measure: str, tmp_path: Path) -> None:
    """Lanes, labels, sentences, marks and the curve of how many are known, as they are in the file."""
    wanted = plan(**MEASURES[measure])
    replay = prepare_log(waiting(), wanted)
    table, shown = shown_in(replay, wanted, 2)
    path = tmp_path / "replay.rrd"
    six = {name: CONFIGURATIONS[name] for name in ("GT", "PEM", "late", "mixed", "gnn", "tracker")}
    given = wanted.model_copy(update={"configurations": {n: wanted.configurations[n] for n in six}})
    run_tracks = tracks_of_run(replay, given, 2)
    write_rrd(path, replay, given, [run_tracks], table[table["configuration"].isin(six)], SUMMARY, 2)
    beside = [name for name in six if name != "GT"]  # the truth has no lane
    for c, name in enumerate(beside):
        mine = table[table["configuration"] == name].set_index("object_id")
        for k in shown:
            who = replay.scene.object_ids[k]
            known = [time_s for time_s, said in lane(path, f"{who} pedestrian", c) if said == "known"]
            detection_s = mine.loc[who, "detection_s"]
            assert known[:1] == ([] if np.isnan(detection_s) else [pytest.approx(detection_s, abs=1e-9)])
            said = [
                (row["elapsed"] / 1e9, label)
                for row in rows(path, f"/world/{name}/status")
                for label in [*row.get("Points3D:labels", []), *row.get("why:why", [])]
                if label == who or label.startswith(f"{who} known")  # what is known is only named
            ]
            assert all(time_s >= detection_s - 1e-9 for time_s, _ in said)
            assert bool(said) == bool(known)
            marked = [
                row["elapsed"] / 1e9
                for row in rows(path, f"/world/{name}/marks/from")
                if any(text.startswith(f"{who} ") for text in row["Points3D:labels"])
            ]
            assert all(time_s >= detection_s - 1e-9 for time_s in marked)
        counted = [(row["elapsed"] / 1e9, row["Scalars:scalars"][0]) for row in rows(path, f"/plots/known/{name}")]
        assert counted
        for time_s, count in counted:
            assert count <= (mine["detection_s"] <= time_s + 1e-9).sum()
    # The mark in every lane ends at the onset.
    for k in shown:
        who = replay.scene.object_ids[k]
        onset_s = table[table["object_id"] == who]["onset_s"].iloc[0]
        for c in range(len(beside)):
            told_at = lane(path, f"{who} pedestrian", c)
            ends = [b[0] for a, b in pairwise(told_at) if a[1] == "from here it counts"]
            assert ends == ([pytest.approx(onset_s, abs=1e-9)] if onset_s > 0.1 else [])


def test_what_was_captured_before_the_onset_is_not_known(tmp_path: Path) -> None:
    """He sets out at 1 s (0.3 m/s are reached at the frame of 1 s); lists take 0.5 s."""
    wanted = experiment(
        units={"ego": EGO_UNIT}, measure=PERSON | {"onset": STARTS},
        configurations={"GT": {"units": "truth"}, "late": {"units": ["ego"], "latency_s": 0.5}},
    )  # fmt: skip
    replay = prepare_log(waiting(), wanted)
    table = replay_block(replay, wanted, np.array([0]))
    path = tmp_path / "x.rrd"
    write_rrd(path, replay, wanted, [tracks_of_run(replay, wanted, 0)], table, SUMMARY, 0)
    assert lane(path, "2 pedestrian", 0) == [
        (0, "on its way from ego"),
        (0.5, "listed before it counts"),
        (pytest.approx(0.95, abs=0.05), "from here"),
        (pytest.approx(0.975, abs=0.025), "from here it counts"),
        (1, "on its way from ego"),
        (1.5, "known"),
    ]
    assert told(path, "late", 0.9)[0] == "2 listed, 0.5 s old"
    assert told(path, "late", 1.0)[0] == "2 listed by ego, arrives in 0.5 s"
    assert told(path, "late", 1.45)[0] == "2 listed by ego, arrives in 0.1 s"
    assert told(path, "late", 1.5)[0] == "2 known, 0.5 s old"
    assert labels(path, "late", 0.9) == ["2 listed"]
    assert labels(path, "late", 1.2) == ["2 on its way"]
    counted = [(row["elapsed"], row["Scalars:scalars"][0]) for row in rows(path, "/plots/known/late")]
    assert [count for elapsed, count in counted if elapsed < 1.55e9] == [0, 1]


def test_not_confirmed_and_too_late(tmp_path: Path) -> None:
    """Two of two lists, ten a second, are needed of 2; 3 leaves at 2.2 s, and what tells of him arrives later."""
    units = {"ego": EGO_UNIT}
    twice = experiment(units=units, measure=PERSON | {"confirm": {"hits": 2, "of": 2}})
    replay = prepare_log(waiting(), twice)
    table = replay_block(replay, twice, np.array([0]))
    write_rrd(tmp_path / "x.rrd", replay, twice, [tracks_of_run(replay, twice, 0)], table, SUMMARY, 0)
    assert lane(tmp_path / "x.rrd", "2 pedestrian", 0) == [(0, "listed, not confirmed"), (0.1, "known")]
    assert told(tmp_path / "x.rrd", "PEM", 0.0)[0] == "2 listed, not confirmed yet"
    late = experiment(units=units, measure=PERSON, configurations={"late": {"units": ["ego"], "latency_s": 1.0}})
    replay = prepare_log(waiting(), late)
    table = replay_block(replay, late, np.array([0]))
    assert table.set_index("object_id").loc["3", "ended_by"] == "object_left"
    write_rrd(tmp_path / "y.rrd", replay, late, [tracks_of_run(replay, late, 0)], table, SUMMARY, 0)
    assert lane(tmp_path / "y.rrd", "3 pedestrian", 0)[-2:] == [
        (2.4, "listed too late"),
        (3.3, None),
    ]
    assert "3 listed too late, 1.0 s old" in told(tmp_path / "y.rrd", "late", 2.4)
