"""Recorded units: the lists of a recording beside those of modelled units, written here message by message."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from osi3.osi_detectedobject_pb2 import DetectedMovingObject
from osi3.osi_sensordata_pb2 import SensorData

from copem_replay.cli import main as cli
from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import CLASSES
from copem_replay.core.yaml import dump_yaml
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import read_logs
from copem_replay.io.recording import Recording
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.receiver import ReceiverOutput
from copem_replay.pipeline.run import StudyTables, run_experiment
from tests.helpers.recordings import CAR, PEDESTRIAN, SHARED, VEHICLE, Obj, Topic, ns, write_recording
from tests.helpers.replays import outputs_of, study_rows


def car(x: float | None, y: float = 0.0, *, vx: float = 0.0, kinds: Any = ((VEHICLE, CAR, 1.0),),
        sigma_m: Any = None, existence: float | None = None,
        track: int | None = 0) -> DetectedMovingObject:  # fmt: skip
    """One entry of a recorded list; None: not said. `kinds`: type, vehicle's type, probability of each candidate."""
    one = DetectedMovingObject()
    if track is not None:
        one.header.tracking_id.value = track
    if existence is not None:
        one.header.existence_probability = existence
    if x is not None:
        one.base.position.x, one.base.position.y, one.base.position.z = x, y, 0.75
    one.base.velocity.x = vx
    for kind, vehicle, probability in kinds:
        candidate = one.candidate.add(type=kind, probability=probability)
        if vehicle is not None:
            candidate.vehicle_classification.type = vehicle
    if sigma_m is not None:
        one.base_rmse.position.x, one.base_rmse.position.y = sigma_m
    return one


def list_of(stamp_s: float, *entries: DetectedMovingObject, captured_s: float | None = None) -> tuple[int, bytes]:
    data = SensorData(moving_object=entries)
    data.timestamp.seconds, data.timestamp.nanos = divmod(ns(stamp_s), 10**9)
    if captured_s is not None:
        data.last_measurement_time.seconds, data.last_measurement_time.nanos = divmod(ns(captured_s), 10**9)
    return ns(stamp_s), data.SerializeToString()


def drive(path: Path, *lists: tuple[int, bytes], objects: Any = None) -> Path:
    """The truth at 10 Hz, 2 s: the ego, 1, and another car, or `objects(t)`; and `lists` on the topic `rsu`."""
    objects = objects or (lambda t: [Obj(id=1, x=0.0), Obj(id=2, x=30.0)])
    frames = [(k / 10, objects(k / 10)) for k in range(21)]
    return write_recording(path, frames, host=1, more=[Topic("rsu", "osi3.SensorData", lists)])


KINDS = ("union", "gnn", "tracker")


def plan_of(path: Path, *, unit: Any = None, measure: Any = None, **changes: Any) -> Experiment:
    recorded = {"topic": "rsu", "covariance_m2": [[0.25, 0.0], [0.0, 0.25]]} | (unit or {})
    data: dict[str, Any] = {
        "version": 1,
        "logs": [str(path)],
        "units": {"rsu": {"recorded": {k: v for k, v in recorded.items() if v is not None}}},
        "configurations": {"GT": {"units": "truth"}, "ideal": {"units": ["rsu"]}}
        | {kind: {"units": ["rsu"], "fusion": {"kind": kind}} for kind in KINDS},
        "measure": {"onset": {"kind": "appears"}, "began": ["log_start", "appeared"]} | (measure or {}),
    }
    return Experiment.model_validate(data | changes)


def read(path: Path, **changes: Any) -> Recording:
    ((recording,), _) = read_logs(plan_of(path, **changes), [path], None)
    return recording


def refused(path: Path, **changes: Any) -> str:
    """Why, in one line; the key is that of the unit."""
    recordings, (found,) = read_logs(plan_of(path, **changes), [path], None)
    assert (recordings, found.key) == ([], ("units", "rsu", "recorded"))
    return found.reason


def replayed(path: Path, **changes: Any) -> StudyTables:
    return run_experiment(plan_of(path, **changes), [read(path, **changes)])


def told(path: Path, **changes: Any) -> dict[str, ReceiverOutput]:
    plan = plan_of(path, **changes)
    return outputs_of(prepare_log(read(path, **changes), plan), plan, np.arange(2))


def figure(result: StudyTables, name: str, configuration: str = "union") -> float:
    return float(result.summary.set_index("configuration").loc[configuration, name])


def row(result: StudyTables, configuration: str) -> pd.Series:
    """Of the other car."""
    return study_rows(result)[study_rows(result)["object_id"] == "2"].set_index("configuration").loc[configuration]


def about(path: Path, **changes: Any) -> list[list[str | None]]:
    """The truth ids of entries, list by list."""
    ready = prepare_log(read(path, **changes), plan_of(path, **changes))
    assert ready.recorded is not None
    ids, tracks = [*ready.scene.object_ids, None], ready.recorded.tracks
    return [[ids[k] for k in tracks.row_object_ix[tracks.frame_ix == f]] for f in range(len(tracks.stamp_ns))]


class TestWhatIsSaid:
    def test_when(self, tmp_path: Path) -> None:
        """The first list says when it was captured, the others don't; `latency_s` comes on top of the stamp."""
        first = list_of(0.7, car(30), captured_s=0.3)
        path = drive(tmp_path / "a.mcap", first, list_of(0.9, car(30)), list_of(1.0, car(30)))
        found = read(path, unit={"delay_s": 0.25}).lists["rsu"].tracks
        np.testing.assert_allclose([found.captured_s, found.arrives_s[0]], [[0.3, 0.65, 0.75], [0.7, 0.9, 1.0]])
        late = {k: {"units": ["rsu"], "fusion": {"kind": k}, "latency_s": 0.15} for k in ("ideal", "union", "gnn")}
        more: Any = {"configurations": late, "measure": {"onset": {"kind": "at", "time_s": 0.4}}}
        result = replayed(path, unit={"delay_s": 0.25}, **more)
        for name in late:
            found_row = row(result, name)[["detection_s", "captured_s", "first_unit"]].tolist()
            assert found_row == [pytest.approx(1.05), pytest.approx(0.65), "rsu"]

    def test_covariance_and_existence(self, tmp_path: Path) -> None:
        entries = [car(30, sigma_m=(0.3, 0.4), existence=0.6), car(40)]
        path = drive(tmp_path / "a.mcap", list_of(0.5, *entries))
        found = read(path, unit={"existence": 0.35}).lists["rsu"]
        assert found.existence.tolist() == [pytest.approx(0.6), 0.35]
        covariance_m2: Any = [getattr(found.tracks, name)[0] for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2")]
        np.testing.assert_allclose(covariance_m2, [[0.09, 0.25], [0.0, 0.0], [0.16, 0.25]])

    def test_no_covariance_from_anywhere(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", list_of(0.5, car(30, sigma_m=(1, 1)), car(40), car(50)))
        said = "rsu: 2 of 3 entries say nothing of their covariance; give `covariance_m2`, which "
        said += "`copem-replay fit` estimates"
        assert refused(path, unit={"covariance_m2": None}) == said
        assert read(drive(tmp_path / "b.mcap", list_of(0.5, car(30, sigma_m=(1, 2)))), unit={"covariance_m2": None})

    def test_class(self, tmp_path: Path) -> None:
        """Candidates of one class add up; what is not said is `other`, and a lone candidate is sure."""
        kinds = [[(VEHICLE, CAR, 0.5), (PEDESTRIAN, None, 0.25), (VEHICLE, CAR, 0.25)], [], [(PEDESTRIAN, None, None)]]
        kinds += [[(VEHICLE, CAR, 0.3), (PEDESTRIAN, None, 0.1)]]
        path = drive(tmp_path / "a.mcap", list_of(0.5, *(car(30, kinds=one) for one in kinds)))
        found = read(path).lists["rsu"]
        said = [{CLASSES[c]: round(p[c], 9) for c in np.flatnonzero(p)} for p in found.class_probability]
        mixed = {"pedestrian": 0.25, "car": 0.75}
        assert said == [mixed, {"other": 1.0}, {"pedestrian": 1.0}, mixed]

    def test_covariance_is_turned_with_the_host(self, tmp_path: Path) -> None:
        """The host heads north, the sensor 60° to the left of east: 0.1 m along, 2 m across."""
        for degrees, expected in ((90, [4.0, 0.0, 0.01]), (60, [3.0025, -1.7277207, 1.0075])):
            stamp, payload = list_of(0.5, car(10, sigma_m=(0.1, 2.0)))
            data = SensorData.FromString(payload)
            data.host_vehicle_location.position.x = 5.0
            data.host_vehicle_location.orientation.yaw = np.deg2rad(90)
            data.mounting_position.orientation.yaw = np.deg2rad(degrees - 90)
            path = drive(tmp_path / f"{degrees}.mcap", (stamp, data.SerializeToString()))
            found = read(path).lists["rsu"].tracks
            covariance_m2 = [getattr(found, name)[0, 0] for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2")]
            np.testing.assert_allclose(covariance_m2, expected, atol=1e-6)
            place = [5 + 10 * np.cos(np.deg2rad(degrees)), 10 * np.sin(np.deg2rad(degrees))]
            np.testing.assert_allclose([found.x_m[0, 0], found.y_m[0, 0]], place, atol=1e-9)

    def test_who_keeps_no_tracks(self, tmp_path: Path) -> None:
        """Two cars that pass each other are no track that turns back: nothing is said of their velocities."""
        lists = [
            list_of(k / 10, car(30 + 0.8 * k, vx=8.0, track=None), car(100 - 0.8 * k, vx=-8.0, track=None))
            for k in range(10)
        ]
        path = drive(tmp_path / "a.mcap", *lists)
        assert set(read(path).lists["rsu"].track_id) == {-1}
        assert not [note for note in read(path).notes if "point against" in note]
        large = read(drive(tmp_path / "b.mcap", list_of(0.5, car(30, track=2**64 - 1)))).lists["rsu"]
        assert large.track_id.tolist() == [2**63 - 1]

    @pytest.mark.parametrize("x", [np.nan, np.inf, None])
    def test_entries_without_a_place_are_left_out_and_said(self, tmp_path: Path, x: float | None) -> None:
        path = drive(tmp_path / "a.mcap", list_of(0.5, car(x, track=7), car(30, track=8), car(x)))
        assert read(path).lists["rsu"].track_id.tolist() == [8]
        assert (
            "unit rsu: 2 object states without a position, or with one that is no number: skipped" in read(path).notes
        )

    def test_lists_out_of_order(self, tmp_path: Path) -> None:
        """Written and captured in any order: they go by their stamps, and a list outrun by a newer one is not used."""
        times = [(1.1, 33, 0.9), (0.7, 30, 0.5), (1.3, 31, 0.7)]
        path = drive(tmp_path / "a.mcap", *(list_of(at, car(x), captured_s=c) for at, x, c in times))
        found = read(path).lists["rsu"].tracks
        said = [found.captured_s, found.arrives_s[0], found.x_m[0]]
        np.testing.assert_allclose(said, [[0.5, 0.9, 0.7], [0.7, 1.1, 1.3], [30.0, 33.0, 31.0]])
        union = told(path)["union"]
        assert union.instants.newest[:, 0].tolist() == [0, 1, 1]
        assert [union.lists.of(0, k)["x_m"].tolist() for k in range(3)] == [[30.0], [33.0], [33.0]]

    @pytest.mark.parametrize(("vx", "jitter_m", "said"), [(-8.0, 0.0, True), (8.0, 0.0, False), (-8.0, 0.05, False)])
    def test_velocities_that_point_backwards(self, tmp_path: Path, vx: float, jitter_m: float, said: bool) -> None:
        """Of a track that moves 0.8 m per list, or whose place jitters by a few centimetres."""
        places = [30 + (jitter_m * (k % 2) if jitter_m else 0.8 * k) for k in range(10)]
        path = drive(tmp_path / "a.mcap", *(list_of(0.1 * k, car(x, vx=vx, track=3)) for k, x in enumerate(places)))
        notes = [note for note in read(path).notes if "in 100% of its entries the velocity points backwards" in note]
        assert len(notes) == said

    def test_what_cannot_be_read(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", list_of(0.5, car(30)))
        assert refused(path, unit={"topic": "obu"}) == "no topic 'obu'; lists of units are on rsu"
        assert (
            refused(path, unit={"topic": "truth"}) == "topic 'truth' holds osi3.GroundTruth; lists of units are on rsu"
        )
        alone = write_recording(
            tmp_path / "d.mcap", [(k / 10, [Obj(id=1), Obj(id=2, x=9.0)]) for k in range(3)], host=1
        )
        assert refused(alone, unit={"topic": "obu"}) == "no topic 'obu'; no topic of this log holds lists of a unit"
        path = drive(tmp_path / "b.mcap", list_of(0.5, car(30)), (ns(0.6), b"\xff\xff\xff"))
        assert "unit rsu: 1 message cannot be decoded: skipped" in read(path).notes
        assert refused(drive(tmp_path / "c.mcap")) == "rsu: holds no list"


class TestWhoItIs:
    def test_the_optimal_assignment_not_the_nearest_first(self, tmp_path: Path) -> None:
        """Cars at 30 and 32 m; entries at 31.4 and 33.4 m. Nearest first, 31.4 would be the second car's."""
        entries = [car(33.4), car(31.4), car(55), car(30, kinds=[(PEDESTRIAN, None, 1.0)])]
        cars = [Obj(id=1, x=0.0), Obj(id=2, x=30.0), Obj(id=3, x=32.0)]
        path = drive(tmp_path / "a.mcap", list_of(0.5, *entries), objects=lambda t: cars)
        assert about(path) == [["3", "2", None, None]]
        assert about(path, measure={"match": {"gate_m": 1.39}}) == [[None, "3", None, None]], "1.4 m is too far then"
        assert sorted(told(path)["ideal"].lists.of(0, 0)["x_m"]) == [31.4, 33.4]
        assert sorted(told(path)["union"].lists.of(0, 0)["x_m"]) == [30.0, 31.4, 33.4, 55.0]

    def test_at_the_capture(self, tmp_path: Path) -> None:
        """At 20 m/s and 0.5 s late an entry lies 10 m behind: it is about whoever was there at its capture."""
        lists = [list_of(0.9, car(38, vx=20)), list_of(1.0, car(40, vx=20))]
        path = drive(tmp_path / "a.mcap", *lists, objects=lambda t: [Obj(id=1), Obj(id=2, x=30 + 20 * t, vx=20)])
        assert about(path, unit={"delay_s": 0.5}) == [["2"], ["2"]]
        assert about(path) == [[None], [None]]
        result = replayed(path, unit={"delay_s": 0.5})
        for name in ("ideal", "union"):
            assert row(result, name)["detection_s"] == pytest.approx(0.9)
        assert figure(result, "false_positives_per_min") == 0.0
        per_min = figure(result, "stale_false_positives_per_min")
        assert per_min == pytest.approx(1200), "two in the 0.1 s from list to list"
        assert figure(result, "position_rmse_m") == pytest.approx(10.0)

    def test_the_receivers_own_body_is_left_out(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", list_of(0.5, car(0.4), car(30)))
        for kind in ("ideal", "union"):
            assert told(path)[kind].lists.of(0, 0)["x_m"].tolist() == [30.0]

    def test_no_exact_pair_is_given_up_for_two(self, tmp_path: Path) -> None:
        """Entries at 30 and 27.1 m, cars at 30 and 32.95 m: two pairs would be possible, 2.95 and 2.9 m apart."""
        cars = [Obj(id=1, x=0.0), Obj(id=2, x=30.0), Obj(id=3, x=32.95)]
        path = drive(tmp_path / "a.mcap", list_of(0.5, car(30.0), car(27.1)), objects=lambda t: cars)
        assert about(path) == [["2", None]]

    @pytest.mark.parametrize("other_m", [-2.95, -20.0, 30.0])
    def test_the_own_body_is_known_by_the_ego_alone(self, tmp_path: Path, other_m: float) -> None:
        """Wherever somebody else truly is: what is listed in the ego's box is the ego, what is 2.9 m ahead is not."""
        path = drive(
            tmp_path / "a.mcap", list_of(0.5, car(0.0), car(2.9)), objects=lambda t: [Obj(id=1), Obj(id=2, x=other_m)]
        )
        assert about(path)[0][0] == "1"
        assert told(path)["union"].lists.of(0, 0)["x_m"].tolist() == [2.9]

    def test_nobody_but_the_ideal_learns_of_it(self, tmp_path: Path) -> None:
        """The truth has other numbers, another order, or nobody but the ego: the fused lists are the same."""
        rng, cars = np.random.default_rng(0), [(30.0, 0.0), (33.0, 1.0), (38.0, -4.0)]
        entries = [[car(x + rng.normal(), y + rng.normal(), track=int(x)) for x, y in cars] for _ in range(20)]
        found = []
        for number, ids in enumerate(([2, 3, 4], [9, 2, 4], [])):
            objects = [Obj(id=1), *(Obj(id=i, x=cars[i % 3][0], y=cars[i % 3][1]) for i in ids)]
            (tmp_path / f"{number}").mkdir()  # the log's name is part of what is drawn
            lists = [list_of(0.1 * k, *entries[k]) for k in range(20)]
            path = drive(tmp_path / f"{number}" / "a.mcap", *lists, objects=lambda t, objects=objects: objects)
            found.append({name: one.lists for name, one in told(path).items() if name in KINDS})
        for name, first in found[0].items():
            assert len(first.entries) > 30
            assert {lists[name].entries.tobytes() for lists in found} == {first.entries.tobytes()}
            assert {lists[name].start.tobytes() for lists in found} == {first.start.tobytes()}


class TestInARun:
    def test_all_means_the_modelled_ones(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", list_of(0.5, car(30)), list_of(0.6, car(30)))
        more: Any = {"pems": {"p": [{"detection": {"kind": "constant", "probability": 1.0}}]}}
        more["units"] = plan_of(path).as_written()["units"] | {"ego": {"on": "ego", "pem": "p"}}
        chosen = {"all": "all", "rsu": ["rsu"], "both": ["ego", "rsu"]}
        more["configurations"] = {k: {"units": units, "fusion": {"kind": "union"}} for k, units in chosen.items()}
        result = replayed(path, **more)
        assert [row(result, name)["first_unit"] for name in chosen] == ["ego", "rsu", "ego"]
        lists = {name: one.lists for name, one in told(path, **more).items()}
        assert [len(lists[name].of(0, 6)) for name in ("all", "both")] == [1, 2]
        assert set(lists["both"].of(0, 6)["unit_ix"]) == {0, 1}

    def test_ghosts_are_of_measured_classes(self, tmp_path: Path) -> None:
        walker = [(PEDESTRIAN, None, 1.0)]
        lists = [list_of(k / 10, car(30), car(50), car(60, kinds=walker), car(70, kinds=walker)) for k in range(21)]
        path = drive(tmp_path / "a.mcap", *lists)
        for classes, per_list in ((["car"], 1), (["vru"], 2), (["car", "vru"], 3), (None, 1)):
            result = replayed(path, measure={"objects": {"classes": classes}})
            assert figure(result, "false_positives_per_min") == pytest.approx(630 * per_list), "21 lists in 2.0 s"

    def test_without_an_ego_distances_are_from_the_units_place(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", list_of(0.5, car(30)), list_of(0.6, car(31)))
        units = {"rsu": {"at": [30, 40], "recorded": plan_of(path).as_written()["units"]["rsu"]["recorded"]}}
        result = replayed(path, ego="none", units=units, measure={"distance_to": "rsu"})
        assert row(result, "union")["distance_at_detection_m"] == pytest.approx(40.0)
        assert figure(result, "position_rmse_m") == pytest.approx(np.sqrt(0.5)), "0 m and 1 m off; car 1 is missed"

    def test_two_thousand_copies_of_one_row_have_no_interval(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", *(list_of(k / 10, car(30)) for k in range(21)))
        summary = replayed(path, runs=2000).summary.set_index("configuration")
        assert (summary["n"] == 2000).all()
        assert (summary["interval"] == "nothing drawn").all()
        assert summary[["detected_share_low", "detected_share_high", "interval_over"]].isna().all(axis=None)
        more: Any = {"pems": {"p": [{"detection": {"kind": "constant", "probability": 1.0}}]}}
        more["units"] = plan_of(path).as_written()["units"] | {"ego": {"on": "ego", "pem": "p"}}
        more["configurations"] = {"both": {"units": ["ego", "rsu"]}}
        assert replayed(path, **more).summary["interval"].tolist() == ["exact"]

    def test_its_results_run_again(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = drive(tmp_path / "a.mcap", *(list_of(k / 10, car(30 + k % 3)) for k in range(21)))
        (tmp_path / "e.yaml").write_text(dump_yaml(plan_of(path, show={"run": 0}).as_written()))
        (tmp_path / "deep").mkdir()
        tables = []
        for experiment, out in ((tmp_path / "e.yaml", "deep/one"), (tmp_path / "deep/one/experiment.yaml", "two")):
            monkeypatch.setattr(sys, "argv", ["copem-replay", "run", str(experiment), "--out", str(tmp_path / out)])
            assert cli._run_to_exit_code() == 0
            tables.append(pd.read_parquet(tmp_path / out / "detections.parquet"))
        pd.testing.assert_frame_equal(tables[0], tables[1], check_exact=True)
        assert (tmp_path / "two" / "replay.mcap").exists()


@pytest.mark.parametrize(("trial", "mean_m", "pairs"), [(3, 0.39, 161), (5, 0.44, 169)])
def test_a_real_roadside_unit(trial: int, mean_m: float, pairs: int) -> None:
    """The recordings' own evaluator gives the mean error of what is within 1.5 m of the car, within 50 m of the origin.

    It takes the nearest frame of the truth, 0.02 s apart, where this project interpolates: a centimetre.
    """
    if not (path := SHARED / f"msight_trial{trial}.mcap").exists():
        pytest.skip(f"no {path}")
    unit = {"topic": "mcity.RSU.SensorData", "delay_s": 0.132, "covariance_m2": [[0.4, 0.0], [0.0, 0.4]]}
    units = {"rsu": {"at": [0, 0], "recorded": unit}}
    more: Any = {"units": units, "ego": "none", "measure": {"distance_to": "rsu"}}
    ready = prepare_log(read(path, **more), plan_of(path, **more))
    assert ready.recorded is not None
    tracks = ready.recorded.tracks
    mine = np.flatnonzero(tracks.row_object_ix >= 0)

    def off_m(time_s: Any) -> Any:
        at, there = interpolate_states(
            ready.truth, np.zeros(len(mine), int), time_s, t0_ns=ready.scene.t0_ns, max_gap_s=0.5
        )
        assert there.all()
        return np.hypot(tracks.x_m[0, mine] - at["x_m"], tracks.y_m[0, mine] - at["y_m"])

    captured_m, arrived_m = off_m(tracks.row_captured_s[mine]), off_m(tracks.arrives_s[0, tracks.frame_ix[mine]])
    counted = (np.hypot(tracks.x_m[0, mine], tracks.y_m[0, mine]) < 50) & (captured_m < 1.5)
    assert captured_m[counted].mean() == pytest.approx(mean_m, abs=0.01)
    assert len(mine) == pairs
    result, matched = replayed(path, **more), captured_m <= 3.0
    for name, error_m in (("position_rmse_captured_m", captured_m), ("position_rmse_m", arrived_m)):
        assert figure(result, name, "ideal") == pytest.approx(np.sqrt((error_m[matched] ** 2).mean()))
