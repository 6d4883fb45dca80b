"""A log in time chunks gives what it gives in one piece, to the last bit: tables, summary, MCAP, and what is said."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from copem_replay.cli import main as cli
from copem_replay.core.object_list import Inputs, ObjectLists
from copem_replay.core.tracks import TRUTH, VALUES, TimeChunk, Tracks
from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.fusion.interface import ListFusion
from copem_replay.fusion.union import Union
from copem_replay.io.recording import Recording
from copem_replay.perception.visibility import visible_shares
from copem_replay.pipeline import prepare as chunking
from copem_replay.pipeline.expansion import expand_experiment
from copem_replay.pipeline.one_run import RunTracks
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.receiver import Reach, Receivers
from copem_replay.pipeline.run import StudyTables, run_experiment
from tests.helpers import scenes
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.replays import study_accuracy, study_rows, transmitted
from tests.helpers.scenes import Thing, driving, experiment, standing
from tests.io import test_recorded_units as test_recorded
from tests.viewer.test_rrd import rows

"""There is one unit, and it is there."""
LOGS = Path(__file__).parents[2] / "logs"


class AllAtOnce(ListFusion):
    """A user's own fusion that says nothing of time chunks."""

    kind: str = "tests.pipeline.test_chunking:AllAtOnce"

    def fuse(self, inputs: Inputs) -> ObjectLists:
        return Union().fuse(inputs)


def shown_in(path: Path) -> dict[str, list[str]]:
    """By entity what a recording says of it at which instants, however it is cut into chunks."""
    from rerun.chunk import RrdReader

    entities = {chunk.entity_path for chunk in RrdReader(path).stream()}
    return {entity: sorted(str(sorted(row.items())) for row in rows(path, entity)) for entity in entities}


def both_ways(plan: Experiment, recordings: Sequence[Recording], rows_at_once: int) -> tuple[StudyTables, StudyTables]:
    """In one piece, and in time chunks of so many observation rows."""
    whole = run_experiment(plan, recordings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunking, "ROWS_AT_ONCE", 1)
        patch.setattr(chunking, "ROWS_A_CHUNK", rows_at_once)
        return whole, run_experiment(plan, recordings)


def assert_same(whole: StudyTables, pieces: StudyTables) -> None:
    assert [log.replay().chunks for log in whole.logs] == [(TimeChunk(),)] * len(whole.logs)
    pd.testing.assert_frame_equal(study_rows(whole), study_rows(pieces), check_exact=True)
    pd.testing.assert_frame_equal(whole.summary, pieces.summary, check_exact=True)
    assert whole.notes == pieces.notes
    assert (whole.sweep is None) == (pieces.sweep is None)
    if whole.sweep is not None:
        pd.testing.assert_frame_equal(whole.sweep, pieces.sweep, check_exact=True)
    assert study_accuracy(whole)
    assert study_accuracy(pieces)
    pd.testing.assert_frame_equal(whole.bands, pieces.bands, check_exact=True)
    assert_same_tables(study_accuracy(whole), study_accuracy(pieces))


def assert_same_tables(whole: dict[str, pa.Table], pieces: dict[str, pa.Table]) -> None:
    assert whole.keys() == pieces.keys()
    for name, table in whole.items():
        assert table.equals(pieces[name]), name


@pytest.mark.parametrize(("name", "rows", "configurations"), [("tc016d", 1500, None), ("crossing", 25_000, 9)])
def test_the_sample_logs(name: str, rows: int, configurations: int | None) -> None:
    source = read_experiment_file(LOGS / f"{name}.yaml")
    plan, found = find_problems(source)
    assert plan is not None, found
    chosen = dict(list(plan.configurations.items())[:configurations])
    plan = plan.model_copy(update={"runs": 2, "configurations": chosen})
    recordings, _ = read_logs(plan, log_paths(source)[0], source)
    whole, pieces = both_ways(plan, recordings, rows)
    assert len(pieces.logs[0].replay().chunks) > 5
    assert_same(whole, pieces)


NOISY = [
    {
        "when": {"range_m": [0, 45]},
        "detection": {"kind": "constant", "probability": 0.6},
        "error": {"kind": "gaussian", "covariance_m2": [[0.5, 0.1], [0.1, 0.3]], "speed_sigma_mps": 0.3},
    }
]


def traffic() -> Recording:
    """The ego drives along a street; others come towards it, cross, stand, come and go, one with a gap of 0.3 s."""
    things = [
        Thing("ego", "car", driving(-30, 0, 6)),
        Thing("oncoming", "car", driving(60, 3, -8), yaw_rad=math.pi),
        Thing("crossing", "pedestrian", driving(10, -6, 0, 1.5), there=lambda t: 1 < t < 7),
        Thing("blinking", "pedestrian", driving(5, 5, 0.5), there=lambda t: not 2.95 < t < 3.15 and t < 6),
        Thing("parked", "truck", standing(20, -4)),
        Thing("late", "car", driving(40, -20, 0, 5), there=lambda t: t > 5),
    ]
    return scenes.recording(things, until_s=9.0)


@st.composite
def plans(draw: st.DrawFn) -> Experiment:
    """Units on the ego, on another and on a mast, some at rates of their own; late lists; any of the fusions."""
    rates = st.sampled_from([None, 10.0, 7.0, 23.0])
    late = st.sampled_from([0.0, 0.05, 0.1, 0.37, 1.4])
    units: dict[str, Any] = {
        "ego": {"on": "ego", "height_m": 1.8, "pem": "noisy", "rate_hz": draw(rates)},
        "mast": {"at": [15.0, 8.0], "height_m": 5.0, "pem": "noisy", "rate_hz": 7.0, "phase_s": 0.03},
        "car": {"on": draw(st.sampled_from(["oncoming", "late", "blinking"])), "height_m": 1.5, "pem": "noisy"},
    }
    if draw(st.booleans()):
        units["fleet"] = {"on": {"classes": ["car"], "penetration_rate": 0.5}, "pem": "noisy"}
    configurations: dict[str, Any] = {"GT": {"units": "truth", "latency_s": draw(late)}, "PEM": {"units": ["ego"]}}
    fusions: list[dict[str, Any]] = [
        {"kind": "ideal"}, {"kind": "ideal", "combine": "posterior"}, {"kind": "union"}, {"kind": "nms"},
        {"kind": "gnn"}, *({"kind": "tracker", "late": how} for how in ("stale", "predict", "replay")),
    ]  # fmt: skip
    for k, fusion in enumerate(draw(st.lists(st.sampled_from(fusions), min_size=1, max_size=3))):
        delays = {"ego": draw(late), "mast": draw(late), "default": draw(late)}
        configurations[str(k)] = {
            "units": "all",
            "fusion": fusion,
            "latency_s": delays,
            "max_age_s": draw(st.sampled_from([0.3, 1.0])),
        }
    measure: dict[str, Any] = {
        "onset": draw(st.sampled_from([{"kind": "appears"}, {"kind": "in_range", "range_m": 40}])),
        "count_earlier": draw(st.booleans()),
        "confirm": draw(st.sampled_from([{"hits": 1, "of": 1}, {"hits": 2, "of": 3}])),
    }
    if draw(st.booleans()):
        measure["conflict"] = {"horizon_s": 3.0, "margin_m": 0.5}
    return experiment(
        runs=2, seed=draw(st.integers(0, 99)), pems={"noisy": NOISY}, units=units, configurations=configurations,
        measure=measure,
    )  # fmt: skip


@given(plan=plans(), rows=st.integers(40, 700))
@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)  # each replays a log twice and compares all
def test_whatever_is_replayed(plan: Experiment, rows: int) -> None:
    whole, pieces = both_ways(plan, [traffic()], rows)
    assert len(pieces.logs[0].replay().chunks) > 1
    assert_same(whole, pieces)


WRONG = {
    "placed": {
        "position_sigma_m": 0.3, "yaw_sigma_deg": 1.0, "stated": True,
        "memory": [{"share": 0.2, "correlation_s": "always"}, {"share": 0.7, "correlation_s": 3.0}],
    },
    "clock": {"offset_sigma_s": 0.05, "drift_sigma_ppm": 5000.0},
    "outages": {"down_share": 0.2, "lasts_s": 0.5},
}  # fmt: skip
ALL_WRONG = {
    "couples": [NOISY[0] | {"existence": {"kind": "scores", "real": [8, 2], "ghost": [2, 4], "calibrated": True}}],
    "memory": {
        "detection": [{"share": 0.6, "correlation_s": 0.8}], "position": [{"share": 0.7, "correlation_s": 2.0}],
        "class": [{"share": 0.5, "correlation_s": 1.0}], "existence": [{"share": 0.5, "correlation_s": 1.0}],
    },
    "ghosts": [
        {"in_list": 0.4, "lasts_s": 0.7, "where": {"kind": "field", "range_m": [3, 40]}, "classes": {"car": 1.0}},
        {"in_list": 0.2, "lasts_s": 2.0, "where": {"kind": "beside", "classes": ["truck", "car"], "within_m": 3}},
        {"in_list": 0.3, "where": {"kind": "places", "at_m": [[12, 3]], "spread_m": 0.5}},
    ],
    "classes": {"confusion": {"pedestrian": {"pedestrian": 0.8, "bicycle": 0.2}}, "confidence": 0.8},
    "tracks": {"lasts_s": 3.0},
}  # fmt: skip


@pytest.mark.parametrize("rows", [60, 250])
def test_all_that_units_get_wrong(rows: int) -> None:
    units: dict[str, Any] = {
        "ego": {"on": "ego", "height_m": 1.8, "pem": "noisy"} | WRONG,
        "mast": {"at": [15.0, 8.0], "height_m": 5.0, "pem": "noisy", "rate_hz": 7.0, "phase_s": 0.03} | WRONG,
    }
    kinds: list[dict[str, Any]] = [
        {"kind": "ideal"}, {"kind": "union"}, {"kind": "gnn"}, {"kind": "tracker", "late": "replay"},
    ]  # fmt: skip
    late = {"ego": 0.05, "mast": 0.37}
    plan = experiment(
        runs=2, pems={"noisy": ALL_WRONG}, units=units,
        configurations={
            "GT": {"units": "truth"},
            **{kind["kind"]: {"units": "all", "fusion": kind, "latency_s": late} for kind in kinds},
        },
        measure={
            "onset": {"kind": "in_range", "range_m": 40}, "confirm": {"hits": 2, "of": 3},
        },
    )  # fmt: skip
    whole, pieces = both_ways(plan, [traffic()], rows)
    assert len(pieces.logs[0].replay().chunks) > 1
    assert_same(whole, pieces)
    parallel = run_experiment(plan, [traffic()], jobs=2)
    assert_same(whole, parallel)


def test_recorded_units(tmp_path: Path) -> None:
    """A unit whose lists come late, and once in the wrong order, beside fusions of all kinds."""
    lists = [
        test_recorded.list_of(stamp_s, test_recorded.car(29.5 + k / 10, 0.2))
        for k, stamp_s in enumerate((0.2, 0.35, 0.5, 0.64, 0.6, 0.9, 1.1, 1.3, 1.65, 1.9))
    ]
    path = test_recorded.drive(tmp_path / "drive.mcap", *lists)
    plan = test_recorded.plan_of(path, unit={"delay_s": 0.17})
    whole, pieces = both_ways(plan, [test_recorded.read(path, unit={"delay_s": 0.17})], 10)
    assert len(pieces.logs[0].replay().chunks) > 3
    assert_same(whole, pieces)


def test_a_foreseen_collision_without_accuracy_holds_only_what_is_looked_at() -> None:
    plan = experiment(
        runs=3, pems={"sure": NOISY}, configurations={"ideal": {"units": "all", "latency_s": 0.1}},
        measure={
            "onset": {"kind": "appears"}, "accuracy": False, "objects": {"classes": ["pedestrian"]},
            "conflict": {"horizon_s": 3.0, "margin_m": 0.5},
        },
    )  # fmt: skip
    whole, pieces = both_ways(plan, [traffic()], 60)
    assert len(pieces.logs[0].replay().chunks) > 5
    assert study_rows(whole)["conflict_detection_s"].notna().any()
    pd.testing.assert_frame_equal(study_rows(whole), study_rows(pieces), check_exact=True)
    pedestrians = {whole.logs[0].replay().scene.object_number[name] for name in ("crossing", "blinking")}
    for replay in (whole.logs[0].replay(), pieces.logs[0].replay()):
        worlds = list(Receivers(transmitted(replay, plan, complete=False)).worlds())
        assert {int(k) for world in worlds for k in world.observations.tracks.row_object_ix} == pedestrians


def test_sweeps() -> None:
    plan = experiment(
        pems={"sure": NOISY}, sweep={"latency_s": [0.0, 0.3], "rate_hz": [5.0]},
        configurations={"GT": {"units": "truth"}, "ideal": {"units": "all", "latency_s": 0.1}},
    )  # fmt: skip
    assert_same(*both_ways(plan, [traffic()], 60))


def test_a_fusion_that_is_not_resumable_gets_all_at_once() -> None:
    own = {
        "GT": {"units": "truth"},
        "own": {"units": "all", "fusion": {"kind": "tests.pipeline.test_chunking:AllAtOnce"}},
    }
    plan = experiment(pems={"sure": NOISY}, configurations=own)
    whole, pieces = both_ways(plan, [traffic()], 50)
    assert pieces.logs[0].replay().chunks == (TimeChunk(),)
    assert_same(whole, pieces)


def test_chunks_cover_the_log_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
    monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 40)
    log = traffic()
    replay = prepare_log(log, experiment())
    cuts = replay.chunks
    assert (cuts[0].from_s, cuts[-1].until_s) == (-np.inf, np.inf)
    assert all(one.until_s == after.from_s for one, after in pairwise(cuts))
    rows = [len(replay.observe(time_chunk).tracks.frame_ix) for time_chunk in cuts]
    assert sum(rows) == len(replay.observe(TimeChunk()).tracks.frame_ix)
    assert max(rows) <= 40
    alone = RunTracks(replay, experiment(), 0).whole()["GT"].fused  # held at once all the same: it is not that long
    assert len(alone.frame_ix) == len(replay.truth.frame_ix) - 91  # but for the ego
    monkeypatch.setattr("copem_replay.pipeline.one_run.ROWS_HELD", 40)
    with pytest.raises(Exception, match="too long to be held at once; take a window of it"):
        RunTracks(replay, experiment(), 0).whole()


def standing_still(frames: int, objects: int) -> Recording:
    """So many objects at one place, at 10 Hz."""
    rows, stamps = frames * objects, np.arange(frames) * 10**8
    log = scenes.recording([Thing(str(k), "car", standing(0, 0)) for k in range(objects)], until_s=0.1)
    truth = Tracks(
        units=(TRUTH,), start=np.arange(objects + 1) * frames, unit_ix=np.zeros(objects, dtype=np.int64),
        object_ix=np.arange(objects), frame_ix=np.tile(np.arange(frames), objects), stamp_ns=stamps,
        captured_s=stamps * 1e-9, frame_unit_ix=np.zeros(frames, dtype=np.int64), arrives_s=stamps[None] * 1e-9,
        valid=np.ones((1, rows), dtype=bool), **{name: np.ones((1, rows)) for name in VALUES},
    )  # fmt: skip
    return Recording(**{**vars(log), "truth": truth})


def test_a_log_of_half_a_million_rows_is_cut() -> None:
    """3000 frames of 60 objects and two units: 3000 · 60 · 3 observation rows, in six pieces of 50 s."""
    two = {"ego": scenes.EGO_UNIT, "mast": {"at": [0, 9], "height_m": 5.0, "pem": "sure"}}
    log, plan = standing_still(3000, 60), experiment(ego="0", units=two)
    assert chunking.observation_rows(log.scene, log.truth, plan) == 540_000
    cuts = chunking.time_chunks(log.scene, log.truth, plan)
    assert [(500 * k + 499.381966) / 10 for k in range(5)] == pytest.approx([cut.until_s for cut in cuts[:-1]])
    assert chunking.time_chunks(log.scene, log.truth, experiment(ego="0")) == (TimeChunk(),)  # 360 000


def test_what_is_held_to_the_end_has_the_lists_once_and_no_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else memory would grow with the square of the length: every chunk has all lists of the log."""
    monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
    monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 40)
    replay = prepare_log(traffic(), experiment())
    for observed in (*map(replay.observe, replay.chunks), replay.rows_of(np.arange(2))):
        for name in ("stamp_ns", "captured_s", "frame_unit_ix", "arrives_s"):
            assert getattr(observed.tracks, name) is getattr(replay.no_rows.tracks, name)
    worlds = [*Receivers(transmitted(replay, experiment())).worlds()]
    sighted = [world.sightings("sampled") for world in worlds]
    seen = [world.listed("sampled") for world in worlds]
    assert sum(len(of.frame_ix) for of in sighted) > 100
    for of, all_rows in zip(sighted, seen, strict=True):
        assert [getattr(of, name).strides[1] for name in VALUES] == [0] * len(VALUES)  # one number for all rows
        held = set(zip(all_rows.row_object_ix.tolist(), all_rows.frame_ix.tolist(), strict=True))
        assert held >= set(zip(of.row_object_ix.tolist(), of.frame_ix.tolist(), strict=True))


@pytest.mark.parametrize("rows_at_once", [10**9, 60])
def test_what_no_run_lists_is_not_held(rows_at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen up to 20 m only: of all others nothing is drawn, fused or kept."""
    monkeypatch.setattr(chunking, "ROWS_AT_ONCE", rows_at_once)
    monkeypatch.setattr(chunking, "ROWS_A_CHUNK", rows_at_once)
    near = [{"when": {"range_m": [0, 20]}, "detection": {"kind": "constant", "probability": 0.5}}]
    plan = experiment(pems={"sure": near})
    replay = prepare_log(traffic(), plan)
    found = replay.observe(TimeChunk())
    listed = np.flatnonzero((found.view.range_m >= 0) & (found.view.range_m < 20))
    assert 0 < len(listed) < len(found.view.range_m) / 2
    held = [set(world.observations.view.range_m.tolist()) for world in Receivers(transmitted(replay, plan)).worlds()]
    assert set().union(*held) == set(found.view.range_m[listed].tolist())


def test_visible_shares_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many blocks of runs, passes and files there are; of the same units and rows."""
    views: list[int] = []

    def counted(world: Tracks, static: Any, observers: Any, model: Any, *asked: Any) -> Any:
        views.append(len(world.frame_ix) * len(observers.carrier_ix))
        return visible_shares(world, static, observers, model, *asked)

    monkeypatch.setattr("copem_replay.perception.observation.visible_shares", counted)
    monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
    monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 60)
    monkeypatch.setattr("copem_replay.pipeline.replay.CHUNK_BYTES", 1)
    plan = experiment(runs=3, configurations={"late": {"units": "all", "latency_s": 0.4}}, pems={"sure": NOISY})
    result = run_experiment(plan, [traffic()])
    [replay] = (log.replay() for log in result.logs)
    list(RunTracks(replay, plan, 0))
    rows = len(replay.truth.frame_ix)
    # What a time chunk needs from before it is looked at with it once more: 0.4 s and a list of 6 objects at 10 Hz.
    assert rows <= sum(views) <= rows + (len(replay.chunks) - 1) * 6 * 6


def test_how_far_back_a_chunk_reaches() -> None:
    """Lists captured every second arrive 0.4 s later; the receiver goes by each until the next; a tracker by 2 s."""
    plan = experiment(configurations={"ideal": {"units": ["ego"], "latency_s": 0.4}})
    log = scenes.recording([Thing("ego", "car", standing(0, 0))], until_s=10.0, rate_hz=1.0)
    received = log.truth.captured_between(np.inf, np.inf)  # what is in the lists does not matter
    late = Recording(**{**vars(log), "truth": received}).truth
    late = type(late)(**{**{f: getattr(late, f) for f in late.__dataclass_fields__}, "arrives_s": late.arrives_s + 0.4})
    reach = Reach(expand_experiment(plan, log.scene), {"ideal": late})
    # From 5.2 s on: the first instant is 5.4 s, at which the list captured at 5 s arrives.
    assert reach.earliest_s(TimeChunk(5.2, 8.0)) == pytest.approx(5.0, abs=0.01)
    assert reach.earliest_s(TimeChunk(5.2, 5.3)) == 5.2  # no instant at all
    assert reach.earliest_s(TimeChunk(4.8, 8.0)) == pytest.approx(4.8, abs=0.01)
    assert reach.earliest_s(TimeChunk()) == -np.inf
    tracker = {"kind": "tracker", "late": "replay", "buffer_s": 2.0}
    replayed = experiment(configurations={"t": {"units": ["ego"], "latency_s": 0.4, "fusion": tracker}})
    # At 5.0 s the newest that has arrived was captured at 4 s: 2 s before that.
    assert Reach(expand_experiment(replayed, log.scene), {"t": late}).earliest_s(TimeChunk(5.0, 8.0)) == pytest.approx(
        2.0, abs=0.01
    )


def test_a_chunk_reaches_back_to_a_list_that_another_unit_still_goes_by() -> None:
    """One unit's list of 2 s is the newest it has for a second: an instant of the other one at 2.9 s goes by it."""
    plan = experiment(
        units={"ego": scenes.EGO_UNIT, "slow": {"at": [0, 9], "height_m": 5.0, "pem": "sure", "rate_hz": 1.0}},
        configurations={"ideal": {"units": "all", "latency_s": {"default": 0.2}}},
    )
    replay = prepare_log(traffic(), plan)
    received = {"ideal": transmitted(replay, plan).received("ideal")}
    assert Reach(replay.expanded, received).earliest_s(TimeChunk(2.85, 3.0)) == pytest.approx(2.0, abs=0.01)


def test_the_results_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All its files but the .rrd are the same, and that one has the same entities with the same in them."""
    frames = [
        (0.1 * k, [Obj(id=1, x=1.0 * k), pedestrian(id=2, x=20.0, y=-3 + 0.1 * k), Obj(id=3, x=40.0 - k, y=4.0)])
        for k in range(41)
    ]
    write_recording(tmp_path / "drive.mcap", frames, host=1)
    (tmp_path / "plan.yaml").write_text(
        "version: 1\nlogs: [drive.mcap]\nruns: 2\npems: {p: {"
        "couples: [{detection: {kind: constant, probability: 0.7}}], "
        "ghosts: [{in_list: 0.1, where: {kind: field, range_m: [5, 40]}}]}}\n"
        "units: {ego: {on: ego, height_m: 1.8, pem: p}, mast: {at: [9, 9], height_m: 5, pem: p}}\n"
        "configurations: {GT: {units: truth}, ideal: {units: all, latency_s: 0.2}, gnn: {units: all, fusion: "
        "{kind: gnn}}, tracker: {units: all, fusion: {kind: tracker}}}\nmeasure: {began: [log_start, crossed]}\n"
    )
    monkeypatch.chdir(tmp_path)
    for out, count in (("whole", 10**9), ("pieces", 60)):
        with monkeypatch.context() as patch:
            patch.setattr(chunking, "ROWS_AT_ONCE", count)
            patch.setattr(chunking, "ROWS_A_CHUNK", count)
            patch.setattr("copem_replay.results.truth_scene.MOST_ROWS", count)
            patch.setattr("sys.argv", ["copem-replay", "run", "plan.yaml", "--out", out])
            with pytest.raises(SystemExit) as ended:
                cli.main()
            assert ended.value.code == 0
    assert "long" not in capsys.readouterr().err
    files = {path.name for path in (tmp_path / "whole").iterdir()}
    assert files == {path.name for path in (tmp_path / "pieces").iterdir()}
    for name in files - {"replay.rrd", "made.jsonl"}:
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "pieces" / name).read_bytes(), name
    whole, pieces = (shown_in(tmp_path / out / "replay.rrd") for out in ("whole", "pieces"))
    assert {"/world/gnn/status", "/world/ideal/listings"} <= whole.keys()
    assert any(name.startswith("/lanes/2_pedestrian/") and name.endswith("_gnn") for name in whole)
    why = [name for name in whole if name.endswith(("status", "hiding", "listings")) or name.startswith("/lanes")]
    assert len(why) == 3 + 3 + 3 * 2  # of all but the truth: statuses, lists, lanes of both objects
    assert {name: whole[name] for name in why} == {name: pieces[name] for name in why}
    assert whole.keys() == pieces.keys()
