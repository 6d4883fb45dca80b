"""What units send of their lists, and what the receiver keeps of messages that leave objects out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from copem_replay.core.errors import ExperimentError
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Float, Tracks
from copem_replay.experiment.file import make_plain_source as filed
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems
from copem_replay.io.recording import Recording
from copem_replay.pipeline import prepare as chunking
from copem_replay.pipeline.closed_form import check_exact
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import StudyTables, run_experiment
from tests.helpers import scenes
from tests.helpers.replays import study_accuracy, study_rows, world_of
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, standing

CPM = {"kind": "cpm"}
MAST = {"at": [0.0, 20.0], "height_m": 5.0, "pem": "all"}
ERROR = {"kind": "gaussian", "covariance_m2": [[0.2, 0.0], [0.0, 0.2]], "yaw_sigma_deg": 2.0, "speed_sigma_mps": 0.2}
NOISY = {
    "couples": [{"detection": {"kind": "constant", "probability": 0.8}, "error": ERROR}],
    "ghosts": [{"in_list": 0.5, "lasts_s": 1.0, "where": {"kind": "field", "range_m": [5, 40]}}],
    "tracks": {"lasts_s": 3.0},
}


def recorded(*things: Thing, until_s: float = 6.0) -> Recording:
    return scenes.recording([Thing("ego", "car", standing(0, 0)), *things], until_s=until_s)


def plan(sends: object, fusions: tuple[str, ...] = ("ideal",), mast: Any = None, **changes: Any) -> Experiment:
    """A mast that surely sees everything without any error, and sends by `sends`."""
    mast = {**MAST, **(mast or {})} | ({} if sends is None else {"sends": sends})
    configurations = {kind: {"units": ["mast"], "fusion": {"kind": kind}} for kind in fusions}
    data: dict[str, Any] = {
        "units": {"ego": {**EGO_UNIT, "pem": "all"}, "mast": mast},
        "configurations": configurations,
    }
    return experiment(**(data | changes))


def sent(recording: Recording, some: Experiment, one: int = 0) -> Tracks:
    """What units send in one run."""
    return world_of(prepare_log(recording, some), some, [one]).sent("true")


def when(recording: Recording, some: Experiment, name: str) -> list[float]:
    """When the mast sends an object, in tenths of a second."""
    tracks = sent(recording, some)
    mine = (tracks.row_object_ix == recording.scene.object_number[name]) & (tracks.row_unit_ix == 1) & tracks.valid[0]
    return np.round(10 * tracks.row_captured_s[mine], 6).tolist()


@pytest.mark.parametrize(("v_mps", "tenths"), [(15, 3), (12, 4), (10, 5), (8, 6), (5, 9), (3, 10), (0, 10)])
def test_a_vehicle_is_sent_again_when_it_has_moved_by_more_than_4_m(v_mps: float, tenths: int) -> None:
    """At 10 m/s it has moved by 4 m exactly after 0.4 s, which is not more. Far from the origin that is the same."""
    car = Thing("car", "car", driving(123_456.7, 4, v_mps))
    assert when(recorded(car), plan(CPM), "car") == list(range(0, 61, tenths))


def test_speed_and_heading_count_too() -> None:
    """From 2 s on it is 1 m/s faster; from 4.05 s on it drives 6 degrees to the right, over ±180 degrees."""

    def moves(t: float) -> tuple[float, float]:
        return (2.0 * t + max(t - 2.05, 0.0), 5.0)

    assert when(recorded(Thing("car", "car", moves)), plan(CPM), "car")[:5] == [0, 10, 20, 21, 31]
    some = recorded(Thing("car", "car", standing(9, 9), yaw_rad=np.radians(179.0)))
    yaw = some.truth.yaw_rad.copy()
    mine = (some.truth.row_object_ix == 1) & (some.truth.row_captured_s > 3.25)
    yaw[0, mine] = np.radians(-175.0)
    turned = replace(some, truth=replace(some.truth, yaw_rad=yaw))
    assert when(turned, plan(CPM), "car")[:6] == [0, 10, 20, 30, 33, 43]
    yaw[0, mine] = np.radians(-178.0)  # 3 degrees only, across the cut
    assert when(turned, plan(CPM), "car")[:6] == [0, 10, 20, 30, 40, 50]


def test_vulnerable_road_users_go_together() -> None:
    """One appears at 1.3 s: it is new, so both are sent, and from then on every half second."""
    walkers = recorded(
        Thing("p", "pedestrian", driving(10, 4, 1.0)),
        Thing("q", "bicycle", driving(14, 4, 1.0), there=lambda t: t > 1.25, size_m=(1.8, 0.6, 1.7)),
    )
    some = plan(CPM)
    assert when(walkers, some, "p")[:6] == [0, 5, 10, 13, 18, 23]
    assert when(walkers, some, "q")[:3] == [13, 18, 23]


def test_messages_have_an_interval() -> None:
    """At least 0.25 s of lists every 0.1 s are 0.3 s; whole lists, which leave nothing out."""
    car = recorded(Thing("car", "car", driving(30, 4, 1)))
    assert when(car, plan({"interval_s": 0.25}), "car") == list(range(0, 61, 3))
    some = sent(car, plan({"interval_s": 0.3}))
    mine = some.frame_unit_ix == 1
    held_back = np.isinf(some.common_arrives_s)
    assert (~held_back[mine]).sum() == 21
    assert not held_back[~mine].any()
    together = when(car, plan({"kind": "cpm", "interval_s": 0.3}), "car")
    assert together == [0, 12, 24, 36, 48, 60]  # after 1 s, in the next message


def test_at_most_so_many_objects_those_first_of_which_most_is_to_be_told() -> None:
    """Three standing cars take turns in messages with room for one; a fast one takes most of them."""
    standers = [Thing(name, "car", standing(10 + 8 * k, 9)) for k, name in enumerate("abc")]
    some, room = recorded(*standers), plan({"max_objects": 2})
    turns = [when(some, room, name) for name in ("ego", *"abc")]
    assert sorted(t for each in turns for t in each) == sorted([*range(61), *range(61)])
    assert all(np.diff(each).max() <= 2 for each in turns)
    with_fast = recorded(*standers, Thing("fast", "car", driving(-200, 4, 60.0)))
    assert len(when(with_fast, room, "fast")) > 30 + len(when(with_fast, room, "a")) / 2
    assert len(when(some, plan({"max_objects": 4}), "a")) == 61


def held(tracks: FusedTracks, name: str) -> Float:
    """Whether each fused list holds an object."""
    fused = tracks.fused
    rows = (fused.row_object_ix == int(name)) & fused.valid[0]
    result = np.zeros(len(fused.stamp_ns), dtype=bool)
    result[fused.frame_ix[rows]] = True
    return result


@pytest.mark.parametrize("kind", ["ideal", "gnn", "nms", "union", "tracker"])
def test_an_object_that_is_left_out_is_not_gone(kind: str) -> None:
    """A car that stands for 6 s is sent every second, and in every list from the first (the tracker: second) on."""
    car = recorded(Thing("car", "car", standing(30, 4)))
    [tracks] = tracks_of_run(prepare_log(car, plan(CPM, (kind,))), plan(CPM, (kind,)), 0).values()
    there = held(tracks, "1")
    assert len(there) == 61
    assert there[11 if kind == "tracker" else 0 :].all()


@pytest.mark.parametrize("kind", ["ideal", "gnn"])
def test_what_is_kept_is_as_it_was_captured_and_only_for_so_long(kind: str) -> None:
    """A pedestrian walks at 1 m/s and is hidden from 2.65 s on: what was sent at 2.5 s is kept until 3.5 s."""
    walker = recorded(Thing("p", "pedestrian", driving(10, 4, 1.0), there=lambda t: t < 2.65))
    some = plan(CPM, (kind,), {"pem": "all"})
    [tracks] = tracks_of_run(prepare_log(walker, some), some, 0).values()
    at_s = tracks.fused.common_arrives_s
    assert at_s[held(tracks, "1")].max() == pytest.approx(3.5)
    rows = np.flatnonzero(tracks.fused.valid[0] & (tracks.fused.row_object_ix == 1))
    sent_s = np.minimum(np.floor(at_s[tracks.fused.frame_ix[rows]] / 0.5 + 1e-6) * 0.5, 2.5)
    np.testing.assert_allclose(tracks.captured_s[0, rows], sent_s, atol=1e-9)
    np.testing.assert_allclose(tracks.fused.x_m[0, rows], 10 + sent_s, atol=1e-6)


def test_the_first_message_that_arrives_detects() -> None:
    """Half of the messages are lost: an object is known with the first that holds it, by truth id as in fused lists."""
    car = recorded(Thing("car", "car", standing(30, 4)), Thing("van", "car", driving(60, 8, -8)))
    lossy = {"reception": {"kind": "constant", "probability": 0.5}, "latency": 0.05}
    configurations = {"coop": {"units": ["mast"], "link": "lossy", "max_age_s": 2.0}}
    some = plan(CPM, links={"lossy": lossy}, configurations=configurations, runs=20)
    table = study_rows(run_experiment(some, [car]))
    replay = prepare_log(car, some)
    late = 0
    for one in range(20):
        tracks = tracks_of_run(replay, some, one)["coop"]
        for name, k in (("car", "1"), ("van", "2")):
            first_s = tracks.fused.common_arrives_s[held(tracks, k)].min(initial=np.inf)
            [known_s] = table[(table.run == one) & (table.object_id == name)].detection_s
            assert known_s == pytest.approx(first_s) or (np.isnan(known_s) and np.isinf(first_s))
            late += known_s > 0.5
    assert late > 5


def noisy(sends: object = CPM, **changes: Any) -> tuple[Recording, Experiment]:
    cars = [Thing(f"c{k}", "car", driving(60 + 15 * k, 3 + k, -10), yaw_rad=np.pi) for k in range(3)]
    cars.append(Thing("p", "pedestrian", driving(10, 9, 1.0)))
    link = {"latency": {"kind": "gamma", "min_s": 0.02, "mean_s": 0.1, "shape": 2},
            "reception": {"kind": "constant", "probability": 0.7}}  # fmt: skip
    configurations = {
        kind: {"units": "all", "link": {"mast": "v2x"}, "fusion": {"kind": kind}}
        for kind in ("ideal", "gnn", "tracker")
    }
    some = plan(
        sends, pems={"sure": scenes.SEES_60_M, "all": NOISY}, links={"v2x": link}, configurations=configurations,
        runs=3, **changes,
    )  # fmt: skip
    return recorded(*cars), some


def assert_same(one: StudyTables, other: StudyTables) -> None:
    assert study_rows(one).equals(study_rows(other))
    assert one.summary.equals(other.summary)
    assert study_accuracy(one)
    assert study_accuracy(other)
    assert study_accuracy(one)["lists.parquet"].equals(study_accuracy(other)["lists.parquet"])


@pytest.mark.parametrize("sends", [CPM, {"kind": "cpm", "interval_s": 0.2, "max_objects": 2}])
def test_a_log_in_time_chunks_and_several_workers_give_the_same(monkeypatch: pytest.MonkeyPatch, sends: object) -> None:
    car, some = noisy(sends)
    whole = run_experiment(some, [car])
    assert_same(whole, run_experiment(some, [car], jobs=2))
    monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
    monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 200)
    cut = run_experiment(some, [car])
    assert len(cut.logs[0].replay().chunks) > 2
    assert_same(whole, cut)


def test_it_is_decided_on_what_the_unit_lists_in_its_run() -> None:
    """With errors in speed and heading an object is sent more often, and otherwise in each run."""
    car, some = noisy()
    surely = plan(CPM)
    by_run = [when_in(car, some, one) for one in range(3)]
    assert len({tuple(each) for each in by_run}) == 3
    assert all(len(each) > len(when(car, surely, "p")) for each in by_run)


def when_in(recording: Recording, some: Experiment, one: int) -> list[float]:
    tracks = sent(recording, some, one)
    mine = (tracks.row_object_ix == recording.scene.object_number["c0"]) & (tracks.row_unit_ix == 1) & tracks.valid[0]
    return np.round(10 * tracks.row_captured_s[mine], 6).tolist()


def test_refusals() -> None:
    def said(some: dict[str, Any]) -> str:
        return "\n".join(map(str, find_problems(filed(some))[1]))

    data = plan(CPM).as_written() | {"measure": {"confirm": {"hits": 2, "of": 3}}}
    assert "measure.confirm: the messages of unit 'mast' leave out objects" in said(data)
    mast = {"at": [0.0, 20.0], "recorded": {"topic": "/mast"}, "sends": {"interval_s": 0.5}}
    assert "units.mast.sends: a recorded unit sends what is recorded" in said(
        plan(None).as_written() | {"units": {"mast": mast}}
    )
    assert "expected kind: cpm, interval_s or max_objects" in said(
        plan(None).as_written() | {"units": {"mast": {**MAST, "sends": {}}}}
    )
    exact = plan({"interval_s": 0.5}, measure={"exact": True, "accuracy": False})
    with pytest.raises(ExperimentError, match="`sends` rules that depend on earlier messages"):
        check_exact([prepare_log(recorded(), exact)], exact)
    assert "unit 'mast' has `sends` rules that depend on earlier messages" in said(exact.as_written())
    assert "sends" not in str(plan(None).as_written())
