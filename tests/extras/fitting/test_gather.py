"""What a model is fitted to, gathered from a recorded unit: by hand, from lists written message by message."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import CLASSES
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.schema import Experiment
from copem_replay.extras.fitting.gather import (
    Gathered,
    NothingMatchedError,
    assign_folds,
    check_unit,
    find_reach,
    gather_rows,
    number_passes,
    raw_lists,
    view_log,
)
from copem_replay.extras.fitting.pose import pool_delays, unit_delay
from copem_replay.io.clock_offset import TimeOffset
from tests.helpers.recordings import Obj, pedestrian
from tests.io.test_recorded_units import car, drive, list_of, plan_of, read

UNIT = {"at": [0.0, 0.0], "height_m": 5.0, "yaw_deg": 90.0}


def gathered(path: Path, *, delay_s: float = 0.0, unit: Any = None, **changes: Any) -> Gathered:
    """Of the unit `rsu` of a recording, at the origin and heading north."""
    recorded = {"topic": "rsu", "covariance_m2": [[1.0, 0.0], [0.0, 1.0]]}
    units: Any = {"units": {"rsu": UNIT | {"recorded": recorded} | (unit or {})}}
    experiment = plan_of(path, **units, **changes)
    recording = read(path, **units, **changes)
    view = view_log(recording, raw_lists([recording], experiment, "rsu")[0], experiment, "rsu", delay_s)
    return gather_rows([view], gate_m=3.0, max_gap_s=0.5, name="rsu")


def passing(t_s: float) -> list[Obj]:
    """A car that drives east at 10 m/s, 20 m north of the unit; the ego far behind."""
    return [Obj(id=1, x=0.0, y=-500.0), Obj(id=2, x=-10.0 + 10 * t_s, y=20.0, vx=10.0)]


def seen(t_s: float, *, east: float = 0.0, north: float = 0.0, **more: Any) -> Any:
    return car(-10.0 + 10 * t_s + east, 20.0 + north, vx=10.5, **more)


class TestRows:
    def test_errors_are_along_and_across_the_line_of_sight(self, tmp_path: Path) -> None:
        """At 1 s the car is north of the unit: along is north, and across, to its left, is west."""
        lists = [list_of(k / 10, seen(k / 10, east=0.3, north=0.2)) for k in range(5, 16)]
        found = gathered(drive(tmp_path / "a.mcap", *lists, objects=passing)).rows
        k = int(np.flatnonzero(np.isclose(found.captured_s, 1.0))[0])
        assert (found.along_m[k], found.across_m[k]) == (pytest.approx(0.2), pytest.approx(-0.3))
        assert (found.view.range_m[k], found.view.azimuth_rad[k]) == (pytest.approx(20.0), pytest.approx(0.0))
        np.testing.assert_allclose([found.east_m, found.north_m], [[0.3] * 11, [0.2] * 11], atol=1e-6)
        np.testing.assert_allclose(found.speed_mps, 0.5)
        assert found.listed.all()
        assert np.isnan(found.yaw_rad).all(), "no entry has an orientation"
        assert (found.class_ix == found.view.class_ix).all()

    def test_the_delay_is_taken_off(self, tmp_path: Path) -> None:
        lists = [list_of(k / 10 + 0.25, seen(k / 10)) for k in range(3, 16)]
        path = drive(tmp_path / "a.mcap", *lists, objects=passing)
        np.testing.assert_allclose(gathered(path, delay_s=0.25).rows.east_m, 0.0, atol=1e-6)
        np.testing.assert_allclose(gathered(path).rows.east_m, -2.5, atol=1e-6)

    def test_misses_duplicates_and_entries_about_nobody(self, tmp_path: Path) -> None:
        entries = {k: [seen(k / 10)] for k in range(2, 19)}
        entries[7] = []
        entries[8] += [car(-2.0, 21.5)]  # a second one of the same car
        entries[9] += [car(30.0, 5.0, existence=0.3)]
        path = drive(tmp_path / "a.mcap", *(list_of(k / 10, *some) for k, some in entries.items()), objects=passing)
        found = gathered(path)
        assert np.flatnonzero(~found.rows.listed).tolist() == [5]
        assert found.lists.entries.tolist() == [1] * 5 + [0, 2, 2] + [1] * 9
        other = found.other
        np.testing.assert_allclose(other.captured_s, [0.8, 0.9], atol=1e-6)
        np.testing.assert_allclose(other.nearest_m, [1.5, np.hypot(31.0, 15.0)], atol=1e-6)
        assert [CLASSES[k] for k in other.nearest_class_ix] == ["car", "car"]
        assert other.existence[1] == pytest.approx(0.3)
        assert np.isnan(other.existence[0])
        assert not found.crowded

    def test_what_two_objects_may_be_meant_by_has_no_error(self, tmp_path: Path) -> None:
        """From 1 s on another car is 0.9 m beside, nearer than errors tell apart: both are listed, none is an error."""

        def two(t_s: float) -> list[Obj]:
            return [*passing(t_s), Obj(id=3, x=-10.0 + 10 * t_s, y=20.9 if t_s > 0.95 else 60.0, vx=10.0)]

        lists = [list_of(k / 10, seen(k / 10), seen(k / 10, north=0.9 if k > 9 else 40.0)) for k in range(2, 19)]
        found = gathered(drive(tmp_path / "a.mcap", *lists, objects=two)).rows
        assert found.listed.all()
        assert (np.isnan(found.along_m) == (found.captured_s > 0.95)).all()

    def test_another_class_at_the_very_place_is_the_object_mistaken(self, tmp_path: Path) -> None:
        lists = [
            list_of(k / 10, seen(k / 10, kinds=((3, None, 1.0),) if k == 9 else ((2, 4, 1.0),))) for k in range(5, 16)
        ]
        found = gathered(drive(tmp_path / "a.mcap", *lists, objects=passing)).rows
        assert found.listed.all()
        assert found.class_ix.tolist() == [3] * 4 + [0] + [3] * 6

    def test_lists_after_the_truth_count_for_nothing(self, tmp_path: Path) -> None:
        lists = [list_of(k / 10, seen(k / 10), car(30.0)) for k in (*range(2, 19), 23, 25)]
        found = gathered(drive(tmp_path / "a.mcap", *lists, objects=passing))
        assert len(found.lists.log) == len(found.other.list) == 17


class TestReach:
    def test_from_the_nearest_to_the_farthest_bin_with_five_matches(self) -> None:
        range_m = np.concatenate([np.full(4, 3.0), np.full(5, 12.0), np.full(6, 33.0), np.full(4, 44.0)])
        azimuth = np.radians(np.where(range_m < 20, 12.0, -32.0))
        view = replace(ViewGeometry(*np.zeros((10, len(range_m)))), range_m=range_m, azimuth_rad=azimuth)
        found = find_reach(view, np.ones(len(range_m), dtype=bool))
        assert found is not None
        assert (found.range_m, found.azimuth_deg) == ((10.0, 35.0), (-35.0, 15.0))
        assert found.holds(view).tolist() == [False] * 4 + [True] * 11 + [False] * 4

    def test_a_false_entry_for_a_while_does_not_draw_it_out(self) -> None:
        range_m = np.concatenate([np.full(50, 12.0), np.full(200, 62.0)])
        view = replace(ViewGeometry(*np.zeros((10, 250))), range_m=range_m)
        listed = range_m < 60
        listed[50:58] = True
        found = find_reach(view, listed)
        assert found is not None
        assert found.range_m == (10.0, 15.0)

    def test_through_the_back(self) -> None:
        azimuth = np.radians(np.repeat([172.0, -178.0], 5))
        view = replace(ViewGeometry(*np.zeros((10, 10))), azimuth_rad=azimuth)
        found = find_reach(view, np.ones(10, dtype=bool))
        assert found is not None
        assert found.azimuth_deg == (170.0, -175.0)
        assert found.holds(view).all()

    def test_a_pass_ends_where_a_list_has_no_row(self) -> None:
        log, thing = np.array([0, 0, 0, 0, 0, 1]), np.array([0, 0, 0, 1, 1, 1])
        assert number_passes(log, thing, np.array([4, 5, 7, 7, 8, 9])).tolist() == [0, 0, 1, 2, 2, 3]

    def test_folds_are_passes_or_logs_or_none(self) -> None:
        pass_ix = np.arange(6)
        assert assign_folds(pass_ix, np.zeros(6, dtype=int), None).tolist() == [0, 1, 2, 3, 4, 0]
        assert assign_folds(pass_ix, np.array([0, 0, 1, 1, 2, 2]), 3).tolist() == [0, 0, 1, 1, 2, 2]
        assert assign_folds(np.array([0, 0, 1, 2]), np.zeros(4, dtype=int), None).tolist() == [0, 0, 0, 0]


class TestDelay:
    def test_logs_are_weighted_by_how_sure_they_are(self) -> None:
        """Standard errors .01, .02 s: weights 4 to 1, (4 · .10 + .13) / 5 = .106; χ² = .03² / (.01² + .02²) = 1.8."""
        one = TimeOffset(0.10, 0.10 - 0.0196, 0.10 + 0.0196, 100)
        two = TimeOffset(0.13, 0.13 - 0.0392, 0.13 + 0.0392, 50)
        found = pool_delays({"a": one, "b": two, "c": TimeOffset(untold="nothing moves")}, None).estimate
        assert found.value == pytest.approx(0.106)
        assert found.high - found.value == pytest.approx(1.96 * math.sqrt(1.8) / math.sqrt(12_500), rel=1e-6)
        assert (found.n, found.why) == (150, None)

    def test_logs_that_contradict_each_other_are_said_with_their_values(self) -> None:
        offsets = {"a": (0.147, 0.013), "b": (0.137, 0.024), "c": (0.119, 0.098), "d": (0.469, 0.058)}
        told = {log: TimeOffset(at, at - half, at + half, 100) for log, (at, half) in offsets.items()}
        found = pool_delays(told, None)
        each = "0.147 s in a, 0.137 s in b, 0.119 s in c, 0.469 s in d"
        assert found.notes[-1] == (
            f"delays contradict each other beyond chance: {each}; --delay-by log or class takes each its own"
        )
        assert found.estimate.low < 0.14 < found.estimate.high
        assert found.estimate.high - found.estimate.low > 0.3  # three degrees of freedom, and one far away
        same = {log: replace(one, offset_s=0.14, low_s=0.12, high_s=0.16) for log, one in told.items()}
        assert len(pool_delays(same, None).notes) == 4

    def test_what_no_log_tells_is_kept_as_declared(self) -> None:
        shifted = TimeOffset(0.2, 0.15, 0.25, 100, unbiased=True)
        assert pool_delays({"a": shifted}, 0.1).estimate.value == 0.1
        assert pool_delays({"a": TimeOffset(untold="nothing moves")}, None).estimate.value == 0.0
        found = pool_delays({"a": shifted}, None).estimate
        assert (found.value, found.low) == (pytest.approx(0.2), pytest.approx(0.15))
        assert found.why is not None
        assert "shift along the way" in found.why

    def test_lists_that_say_when_they_were_captured(self, tmp_path: Path) -> None:
        lists = [list_of(k / 10 + 0.3, seen(k / 10), captured_s=k / 10) for k in range(3, 16)]
        path = drive(tmp_path / "a.mcap", *lists, objects=passing)
        units: Any = {"units": {"rsu": UNIT | {"recorded": {"topic": "rsu", "covariance_m2": [[1, 0], [0, 1]]}}}}
        experiment, recording = plan_of(path, **units), read(path, **units)
        found = unit_delay([(recording, raw_lists([recording], experiment, "rsu")[0])], None)
        assert found.seconds == pytest.approx(0.3)


class TestRefusals:
    def test_nothing_near_a_true_object(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", *(list_of(k / 10, car(300.0)) for k in range(5, 16)), objects=passing)
        said = "nothing of unit rsu's 11 entries is within 3 m of a true object at any delay up to 0.5 s: other frame"
        with pytest.raises(NothingMatchedError, match=said):
            gathered(path)

    def test_too_little_near_true_objects(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", *(list_of(k / 10, seen(k / 10)) for k in range(5, 8)), objects=passing)
        with pytest.raises(NothingMatchedError, match=r"only 3 of unit rsu's 3 entries are within 3 m"):
            gathered(path)

    @pytest.mark.parametrize(
        ("name", "unit", "said"),
        [
            ("rsu", {"at": None}, r"unit rsu: fit needs its place \(`at` or `on`\)"),
            ("rsu", {"height_m": None}, "unit rsu: fit needs its `height_m`"),
            ("mast", {}, r"unit mast: expected a unit whose lists are recorded \(rsu\), found no such unit"),
        ],
    )
    def test_units_that_cannot_be_fitted(self, name: str, unit: Any, said: str) -> None:
        place = {key: value for key, value in (UNIT | unit).items() if value is not None}
        experiment = Experiment.model_validate(
            {"version": 1, "units": {"rsu": {**place, "recorded": {"topic": "rsu"}}},
             "configurations": {"recorded": {"units": ["rsu"]}}}
        )  # fmt: skip
        with pytest.raises(InputError, match=said):
            check_unit(experiment, name)


def test_a_pedestrian_behind_a_van_is_not_seen(tmp_path: Path) -> None:
    """Visible shares are those that a replay computes: a van in between hides all of a pedestrian from a low unit."""

    def hidden(t_s: float) -> list[Obj]:
        van = Obj(id=2, x=0.0, y=10.0, z=1.5, length=6.0, width=2.0, height=3.0)
        return [Obj(id=1, x=0.0, y=-500.0), van, pedestrian(3, 0.0, 20.0)]

    lists = [list_of(k / 10, car(0.0, 10.0)) for k in range(5, 16)]
    path = drive(tmp_path / "a.mcap", *lists, objects=hidden)
    found = gathered(path, unit={"height_m": 1.0})
    assert found.reach.range_m == (10.0, 15.0)
    low = log_of(path, 1.0)
    assert low.view.visible_share[low.states.row_object_ix == 2].max() == 0.0
    assert log_of(path, 30.0).view.visible_share[low.states.row_object_ix == 2].min() > 0.5


def log_of(path: Path, height_m: float) -> Any:
    recorded = {"topic": "rsu", "covariance_m2": [[1.0, 0.0], [0.0, 1.0]]}
    units: Any = {"units": {"rsu": UNIT | {"recorded": recorded, "height_m": height_m}}}
    experiment, recording = plan_of(path, **units), read(path, **units)
    return view_log(recording, raw_lists([recording], experiment, "rsu")[0], experiment, "rsu", 0.0)
