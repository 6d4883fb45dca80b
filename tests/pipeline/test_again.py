"""Who comes back: `again_after_s` makes an episode of every return, by hand.

The ego stands at the origin; it counts what is within 50 m of it. `car` is 20 m away during the first 8.6 s of every
28.6 s, ten times in 286 s, else 80 m; `once` drives in at 100 s and stays. A list is known after 0.5 s.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.episodes import Episodes, find_episodes
from copem_replay.metrics.onset import began_texts
from copem_replay.metrics.survival import end_reason_texts
from copem_replay.perception.visibility import NO_STATICS
from copem_replay.pipeline.run import StudyTables, run_experiment
from tests.helpers.experiments import changed, drive
from tests.helpers.replays import study_accuracy, study_rows
from tests.helpers.scenes import EGO_UNIT, SEES_60_M, Thing, driving, experiment, recording, standing
from tests.system.test_cli import Call, call, here

__all__ = ["call", "here"]

PERIOD_S, IN_S = 28.6, 8.6


def swinging(t: float) -> tuple[float, float]:
    return (20.0 if t % PERIOD_S < IN_S - 0.01 else 80.0, 0.0)


def site() -> Recording:
    things = [
        Thing("ego", "car", standing(0, 0)),
        Thing("car", "car", swinging),
        Thing("once", "car", driving(1060, 9, -10)),
    ]
    return recording(things, until_s=286.0 - 0.2, rate_hz=5.0)


CONFIGURATIONS: dict[str, Any] = {
    "GT": {"units": "truth"},
    "late": {"units": ["ego"], "latency_s": 0.5},
    "gnn": {"units": ["ego"], "latency_s": 0.5, "fusion": {"kind": "gnn"}},
    "hits": {"units": ["ego"], "fusion": {"kind": "union"}},
}


def plan(again_after_s: float | None = 10.0, **changes: Any) -> Experiment:
    onset = {"kind": "in_range", "range_m": 50} | ({} if again_after_s is None else {"again_after_s": again_after_s})
    measure = {"onset": onset} | changes.pop("measure", {})
    return experiment(**({"configurations": CONFIGURATIONS, "measure": measure} | changes))


def episodes_of(log: Recording, *keys: Any, **measure: Any) -> Episodes:
    return find_episodes(log.scene, log.truth, NO_STATICS, plan(*keys, **measure))


def of(result: StudyTables, configuration: str) -> pd.Series:
    return result.summary.set_index("configuration").loc[configuration]


def test_every_return_is_an_episode() -> None:
    log = site()
    found = episodes_of(log)
    car = found.take(found.object_ix == log.scene.object_number["car"])
    assert car.number.tolist() == list(range(10))
    assert car.onset_s == pytest.approx([28.6 * k for k in range(10)], abs=0.21)
    assert (car.ended_s - car.onset_s)[:-1] == pytest.approx(8.4, abs=0.21)  # its last frame within 50 m
    assert began_texts(car.began).tolist() == ["log_start"] + ["crossed"] * 9
    assert set(end_reason_texts(car.ended_by[:-1])) == {"object_left"}
    assert end_reason_texts(car.ended_by[-1:]) == ["log_end"]
    assert car.returns.tolist() == [0] * 10
    once = found.take(found.object_ix == log.scene.object_number["once"])
    assert (once.number.tolist(), once.ended_s.tolist()) == ([0], [pytest.approx(285.8)])


def test_off_by_default_and_then_said() -> None:
    result = run_experiment(plan(None), [site()])
    assert of(result, "GT")["n"] == 2
    assert (
        "scene: object car comes back 9 times after more than 10 s, 1 other object too; only the first episode counts "
        "(`onset: {again_after_s: 10}` counts each)"
    ) not in result.notes, "`once` passes and does not come back"
    assert any("object car comes back 9 times after more than 10 s; only the first" in note for note in result.notes)
    assert not any("comes back" in note for note in run_experiment(plan(), [site()]).notes)


ONSETS = [
    {"kind": "in_range", "range_m": 50}, {"kind": "appears"}, {"kind": "line_of_sight"}, {"kind": "line_of_sight_any"},
]  # fmt: skip
"""Those that can cease to hold while an object is there."""


@pytest.mark.parametrize("onset", ONSETS, ids=lambda onset: onset["kind"])
@pytest.mark.parametrize(("gone", "ended_by"), [("ego", "ego_left"), ("car", "object_left")])
def test_a_gap_of_the_ego_is_the_egos(onset: dict[str, Any], gone: str, ended_by: str) -> None:
    """Ego and car stand 20 m apart; one of them is missing from 3 to 7 s. Whose track it is says why it ended."""
    there = {gone: lambda t: not 3.01 < t < 6.99}
    places = {"ego": standing(0, 0), "car": standing(20, 0)}
    things = [Thing(name, "car", at, there=there.get(name, lambda t: True)) for name, at in places.items()]
    log = recording(things, until_s=10.0)
    found = find_episodes(log.scene, log.truth, NO_STATICS, plan(measure={"onset": onset | {"again_after_s": 3.0}}))
    assert found.onset_s.tolist() == pytest.approx([0.0, 7.0])
    assert found.ended_s.tolist() == pytest.approx([3.0, 10.0])
    assert end_reason_texts(found.ended_by).tolist() == [ended_by, "log_end"]
    assert began_texts(found.began).tolist() == ["log_start", "appeared"]


def test_who_leaves_while_the_ego_is_there_has_left() -> None:
    """It leaves the range at 3 s; the ego is missing from 5 to 9 s, when the car is back."""
    car = Thing("car", "car", lambda t: (20.0 if t < 3.01 or t > 8.99 else 80.0, 0.0))
    ego = Thing("ego", "car", standing(0, 0), there=lambda t: not 5.01 < t < 8.99)
    found = episodes_of(recording([ego, car], until_s=12.0), 3.0)
    assert end_reason_texts(found.ended_by).tolist() == ["object_left", "log_end"]


@pytest.mark.parametrize(("again_after_s", "episodes"), [(19.0, 10), (20.1, 10), (20.5, 1)])
def test_who_is_out_for_less_is_still_there(again_after_s: float, episodes: int) -> None:
    """Out from 8.4 s, the last frame within, to 28.6 s: 20.2 s."""
    log = site()
    found = episodes_of(log, again_after_s)
    assert int((found.object_ix == log.scene.object_number["car"]).sum()) == episodes


def test_times_of_every_episode_are_its_own() -> None:
    """Half a second after each onset, whichever way detections are found; nothing is known from the time before."""
    result = run_experiment(plan(), [site()])
    table = study_rows(result)[study_rows(result)["object_id"] == "car"]
    assert of(result, "GT")["n"] == 11
    for name, late_s in (("GT", 0.0), ("late", 0.5), ("gnn", 0.5), ("hits", 0.0)):
        rows = table[table["configuration"] == name]
        assert rows["episode"].tolist() == list(range(10))
        assert rows["time_to_detection_s"].to_numpy() == pytest.approx(late_s), name
    tally = result.tally
    assert len(tally) == 4 * 11, "a row per configuration and episode"


def test_earlier_lists_count_from_the_end_of_the_episode_before() -> None:
    """The unit sees 60 m, the clock starts at 30 m: a car that comes and goes at 10 m/s is listed 3 s sooner."""

    def to_and_fro(t: float) -> tuple[float, float]:
        return (10 + abs((10 * t) % 400 - 200), 0.0)  # nearest at 20 s, 60 s, …

    log = recording([Thing("ego", "car", standing(0, 0)), Thing("car", "car", to_and_fro)], until_s=80.0)
    of_30_m = {"kind": "in_range", "range_m": 30, "again_after_s": 10}
    configurations = {"PEM": {"units": ["ego"]}, "union": {"units": ["ego"], "fusion": {"kind": "union"}}}
    measure = {"onset": of_30_m, "count_earlier": True}
    table = study_rows(
        run_experiment(
            plan(configurations=configurations, measure=measure, pems={"sure": SEES_60_M}, units={"ego": EGO_UNIT}),
            [log],
        )
    )
    assert table["onset_s"].to_numpy() == pytest.approx([18.0, 58.0] * 2)
    # After the first episode it drives on and is listed to 60 m: those lists tell of its leaving, but count.
    assert table["time_to_detection_s"].to_numpy() == pytest.approx([-3.0, -35.9] * 2)


def test_exact_times_have_the_same_episodes() -> None:
    exact = run_experiment(plan(configurations={"late": CONFIGURATIONS["late"]}, measure={"exact": True}), [site()])
    assert exact.exact is not None
    rows = exact.exact[(exact.exact["object_id"] == "car") & (exact.exact["probability"] > 0)]
    assert rows["episode"].tolist() == list(range(10))
    assert rows["time_to_detection_s"].to_numpy() == pytest.approx(0.5)
    row = of(exact, "late")
    assert row["ttd_rmst_s_exact"] == pytest.approx(row["ttd_rmst_s"])


def test_accuracy_is_of_each_object_once() -> None:
    """From its first onset to the end of its stay: as without returns."""
    one, again = (run_experiment(plan(after_s), [site()]) for after_s in (None, 10.0))
    for name in ("position_rmse_m", "gospa_m", "missed_share", "false_positives_per_min", "longest_gap_s"):
        if name in one.summary:
            assert one.summary[name].to_list() == pytest.approx(again.summary[name].to_list(), nan_ok=True), name
    assert study_accuracy(one)
    assert study_accuracy(again)
    lengths = [len(values) for values in study_accuracy(again)["accuracy.parquet"]["error_m"].to_pylist()]
    later = study_rows(again)["episode"].to_numpy() > 0
    assert not np.array(lengths)[later].any()
    kept = study_accuracy(again)["accuracy.parquet"].filter(~later).drop_columns(["episode"])
    assert kept.equals(study_accuracy(one)["accuracy.parquet"].drop_columns(["episode"]))


def test_who_was_gone_appears_again() -> None:
    there = [(0.0, 5.0), (20.0, 25.0), (40.0, 45.0)]
    car = Thing("car", "car", standing(20, 0), there=lambda t: any(a - 0.01 < t < b for a, b in there))
    found = episodes_of(recording([Thing("ego", "car", standing(0, 0)), car], until_s=60.0))
    assert found.onset_s == pytest.approx([0.0, 20.0, 40.0])
    assert began_texts(found.began).tolist() == ["log_start", "appeared", "appeared"]
    assert found.ended_s == pytest.approx([4.9, 24.9, 44.9])


def test_an_oracle_of_episodes() -> None:
    """Against the words alone, over random ways in and out."""
    rng = np.random.default_rng(1)
    for _ in range(25):
        near = rng.random(60) < 0.4  # second by second
        there = rng.random(60) < 0.8
        if not there.any():
            continue
        car = Thing(
            "car", "car", lambda t, near=near: (20.0 if near[round(t)] else 80.0, 0.0),
            there=lambda t, there=there: bool(there[round(t)]),
        )  # fmt: skip
        log = recording([Thing("ego", "car", standing(0, 0)), car], until_s=59.0, rate_hz=1.0)
        after_s = float(rng.choice([1.5, 3.5, 6.5]))
        expected, last = [], None
        for second in np.flatnonzero(near & there).tolist():
            if last is None or second - last > after_s:
                expected.append([second, second])
            expected[-1][1] = second
            last = second
        if expected:
            expected[-1][1] = int(np.flatnonzero(there)[-1])
        found = episodes_of(log, after_s, max_gap_s=0.5)
        assert found.onset_s == pytest.approx(np.array([first for first, _ in expected], dtype=float))
        assert found.ended_s == pytest.approx(np.array([until for _, until in expected], dtype=float))


def test_pieces_and_jobs_change_nothing(here: Path, call: Call) -> None:
    frames = changed("measure: {onset: {kind: in_range, range_m: 60, again_after_s: 0.6}}", "show: {run: 0}")
    (here / "e.yaml").write_text(frames)
    kept = []
    for options in (["--jobs", "1"], ["--jobs", "2", "--pieces", "kept"], ["--jobs", "1", "--pieces", "kept"]):
        assert call("run", "e.yaml", "--overwrite", "--report", *options).code == 0
        names = ("detections", "tally", "accuracy", "thresholds")
        kept.append([(here / f"out/e/{name}.parquet").read_bytes() for name in names])
    assert kept[0] == kept[1] == kept[2]


@pytest.mark.parametrize(
    ("onset", "said"),
    [
        ("{kind: in_range, again_after_s: 0.5}",
         "measure.onset.again_after_s: expected more than max_gap_s, 0.5 s, over which gaps are filled; found 0.5"),
        ("{kind: at, time_s: 1, again_after_s: 10}",
         "measure.onset: again_after_s: `at` is one instant, to which nobody comes back; leave it out"),
        ("{kind: in_range, again_after_s: 0}", "measure.onset.again_after_s: expected more than 0, found 0"),
    ],
)  # fmt: skip
def test_bad_gaps_are_refused(here: Path, call: Call, onset: str, said: str) -> None:
    (here / "e.yaml").write_text(changed(f"measure: {{onset: {onset}}}"))
    drive(here / "drive.mcap")
    ended = call("check", "e.yaml")
    assert ended.code == 2
    assert ended.lines == [f"e.yaml:17: {said}"]
