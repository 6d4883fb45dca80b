"""The scenes of scenes.py, replayed: expected values follow from the words."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from copem_replay.core.interpolation import interpolate_at_instants
from copem_replay.io.recording import Recording
from copem_replay.perception.observation import observe_objects
from copem_replay.pipeline.run import StudyTables, run_experiment
from tests.helpers import scenes
from tests.helpers.replays import study_rows
from tests.helpers.scenes import EGO_UNIT, Thing, experiment, recording, standing


def replayed(log: Recording, **changes: Any) -> StudyTables:
    return run_experiment(experiment(**changes), [log])


def row(result: StudyTables, configuration: str, object_id: str = "other", run_number: int = 0) -> pd.Series:
    table = study_rows(result)
    chosen = table[
        (table["configuration"] == configuration) & (table["object_id"] == object_id) & (table["run"] == run_number)
    ]
    assert len(chosen) == 1
    return chosen.iloc[0]


def of(result: StudyTables, configuration: str) -> pd.Series:
    return result.summary.set_index("configuration").loc[configuration]


class TestOncomingCar:
    def test_without_latency(self) -> None:
        found = row(replayed(scenes.oncoming_car()), "PEM")
        assert found["onset_s"] == pytest.approx(2.0)
        assert found["began"] == "crossed"
        assert found["detected"]
        assert found["captured_s"] == found["detection_s"] == pytest.approx(4.0)
        assert found["time_to_detection_s"] == pytest.approx(2.0)
        assert found["distance_at_detection_m"] == pytest.approx(60.0)
        assert found["gap_at_detection_m"] == pytest.approx(56.0), "two half lengths of 2 m nearer"
        assert found["ended_s"] == pytest.approx(8.0)
        assert found["ended_by"] == "log_end"
        assert found["first_unit"] == "ego"

    def test_latency_is_not_rounded_to_a_tick(self) -> None:
        result = replayed(scenes.oncoming_car(), configurations={"late": {"units": ["ego"], "latency_s": 0.35}})
        found = row(result, "late")
        assert found["detection_s"] == pytest.approx(4.35)
        assert found["captured_s"] == pytest.approx(4.0)
        assert found["time_to_detection_s"] == pytest.approx(2.35)
        assert found["distance_at_detection_m"] == pytest.approx(56.5)

    def test_confirmed_by_two_of_three(self) -> None:
        result = replayed(
            scenes.oncoming_car(),
            configurations={"late": {"units": ["ego"], "latency_s": 0.35}},
            measure={"onset": {"kind": "in_range", "range_m": 80}, "confirm": {"hits": 2, "of": 3}},
        )
        found = row(result, "late")
        assert found["detection_s"] == pytest.approx(4.45)
        assert found["distance_at_detection_m"] == pytest.approx(55.5)
        assert found["captured_s"] == pytest.approx(4.1)

    def test_the_truth_is_known_at_the_onset(self) -> None:
        found = row(replayed(scenes.oncoming_car()), "GT")
        assert found["time_to_detection_s"] == 0
        assert found["distance_at_detection_m"] == pytest.approx(80.0)
        assert found["first_unit"] == "truth"

    def test_what_was_captured_before_the_onset_counts_only_when_asked(self) -> None:
        sees_all = {"units": {"ego": EGO_UNIT | {"pem": "all"}}}
        onset = {"kind": "in_range", "range_m": 80}
        later = row(replayed(scenes.oncoming_car(), **sees_all), "PEM")
        assert later["time_to_detection_s"] == 0
        earlier = row(
            replayed(scenes.oncoming_car(), **sees_all, measure={"onset": onset, "count_earlier": True}), "PEM"
        )
        assert earlier["time_to_detection_s"] == pytest.approx(-2.0)
        assert earlier["distance_at_detection_m"] == pytest.approx(100.0)

    def test_lists_at_a_units_own_rate(self) -> None:
        """4 Hz from 0.1 s: … 3.85, 4.10: the first list within 60 m is that of 4.1 s, at 59 m."""
        unit = EGO_UNIT | {"rate_hz": 4.0, "phase_s": 0.1}
        found = row(replayed(scenes.oncoming_car(), units={"ego": unit}), "PEM")
        assert found["detection_s"] == pytest.approx(4.1)
        slow = EGO_UNIT | {"rate_hz": 4.0, "phase_s": 0.03}  # … 3.78, 4.03: 59.7 m, between two frames
        found = row(replayed(scenes.oncoming_car(), units={"ego": slow}), "PEM")
        assert found["detection_s"] == pytest.approx(4.03)
        assert found["distance_at_detection_m"] == pytest.approx(59.7)
        assert of(replayed(scenes.oncoming_car(), units={"ego": slow}), "PEM")["list_rate_hz"] == pytest.approx(4.0)

    def test_a_list_that_arrives_after_the_end_is_too_late(self) -> None:
        result = replayed(scenes.oncoming_car(), configurations={"late": {"units": ["ego"], "latency_s": 4.05}})
        found = row(result, "late")
        assert not found["detected"]
        assert np.isnan(found["time_to_detection_s"])
        assert np.isnan(found["distance_at_detection_m"])
        assert found["first_unit"] is None

    def test_two_units_late_and_fresh(self) -> None:
        """A unit standing 30 m ahead sees the car 3 s earlier, at 90 m, before the onset; its lists take 0.5 s.

        It counts from the list captured at the onset, 2.0 s, which arrives at 2.5 s.
        """
        result = replayed(
            scenes.oncoming_car(),
            units={"ego": EGO_UNIT, "rsu": {"at": [30, 5], "height_m": 5.0, "pem": "all"}},
            configurations={"both": {"units": "all", "latency_s": {"ego": 0.0, "default": 0.5}}},
        )
        found = row(result, "both")
        assert found["detection_s"] == pytest.approx(2.5)
        assert found["captured_s"] == pytest.approx(2.0)
        assert found["first_unit"] == "rsu"
        # The ego's lists come at every frame, the other's in between or with them: still 10 instants a second.
        assert of(result, "both")["list_rate_hz"] == pytest.approx(10.0)

    def test_lists_are_counted_while_the_log_lasts(self) -> None:
        """8 s: the ego's 81 lists come at once; of the other's, from 0.05 s on and 4 s late, the 40 until 7.95 s do.

        120 intervals in 8 s; with all that arrives until 11.95 s it would be 160, 13.4 a second.
        """
        late = {"ego": 0.0, "default": 4.0}
        result = replayed(
            scenes.oncoming_car(),
            units={"ego": EGO_UNIT, "rsu": {"at": [30, 5], "height_m": 5.0, "pem": "all", "rate_hz": 10.0,
                                            "phase_s": 0.05}},
            configurations={"both": {"units": "all", "latency_s": late}, "rsu": {"units": ["rsu"], "latency_s": late},
                            "never": {"units": "all", "latency_s": 8.5}},
        )  # fmt: skip
        assert of(result, "both")["list_rate_hz"] == pytest.approx(15.0)
        assert of(result, "rsu")["list_rate_hz"] == pytest.approx(10.0)
        assert of(result, "never")["list_rate_hz"] is None or np.isnan(of(result, "never")["list_rate_hz"])

    def test_only_behind_is_not_ahead(self) -> None:
        behind = [{"when": {"azimuth_deg": [150, -150]}, "detection": {"kind": "constant", "probability": 1.0}}]
        result = replayed(scenes.oncoming_car(), pems={"sure": behind})
        assert not row(result, "PEM")["detected"]
        turned = replayed(scenes.oncoming_car(), pems={"sure": behind}, units={"ego": EGO_UNIT | {"yaw_deg": 180}})
        assert row(turned, "PEM")["time_to_detection_s"] == 0

    def test_onset_at_an_instant_and_at_appearance(self) -> None:
        at = row(replayed(scenes.oncoming_car(), measure={"onset": {"kind": "at", "time_s": 3.21}}), "GT")
        assert at["onset_s"] == pytest.approx(3.21)
        assert at["detection_s"] == pytest.approx(3.3), "the first list captured at or after it"
        appears = row(replayed(scenes.oncoming_car(), measure={"onset": {"kind": "appears"}}), "GT")
        assert appears["onset_s"] == 0
        assert appears["began"] == "log_start"

    def test_starts_moving_within_a_distance_of_the_front(self) -> None:
        """The front of the ego is at x = 2, so the car, always moving, is 30 m before it when at x = 32: 6.8 s."""
        onset = {"kind": "starts_moving", "speed_mps": 0.3, "within_m": 30, "from": "front"}
        found = row(replayed(scenes.oncoming_car(), measure={"onset": onset}), "GT")
        assert found["onset_s"] == pytest.approx(6.8)


def test_who_leaves_unseen_is_never_detected() -> None:
    result = replayed(scenes.passing_by())
    found = row(result, "PEM")
    assert found["onset_s"] == pytest.approx(2.0)
    assert (found["detected"], found["ended_by"], found["ended_s"]) == (False, "object_left", pytest.approx(3.0))
    summary = of(result, "PEM")
    assert summary["detected_share"] == 0
    assert pd.isna(summary["ttd_median_s"])
    assert summary["ttd_rmst_s"] == pytest.approx(1.0), "never detected counts as the horizon, the longest episode: 1 s"
    assert pd.isna(summary["dad_median_m"])


def test_the_egos_leaving_censors() -> None:
    found = row(replayed(scenes.ego_leaves()), "PEM")
    assert (found["ended_by"], found["ended_s"]) == ("ego_left", pytest.approx(3.0))
    assert not found["detected"]


def test_line_of_sight() -> None:
    """Past the wall's end (1 m left at 10 m, seen at 20 m: 2 m left) his left side comes out first, at 1.75 s + some.

    Flat share from the origin, wall corner at (9.95, 1): azimuth atan(1 / 9.95). His visible part is what is left of
    it, of the angle between his right rear corner's and his left near corner's azimuth.
    """
    result = replayed(
        scenes.behind_a_wall(),
        visibility="flat",
        measure={"onset": {"kind": "line_of_sight", "visible_share": 0.5}},
        pems={"sure": [{"when": {"visible_share": [0.999, 1]}, "detection": {"kind": "constant", "probability": 1}}]},
    )
    found = row(result, "PEM", "walker")
    edge = np.arctan2(1, 9.95)

    def share(t: float) -> float:
        left, right = np.arctan2(t + 0.25, 19.75), np.arctan2(t - 0.25, 20.25)
        return float(np.clip((left - edge) / (left - right), 0, 1))

    times = np.arange(51) / 10
    assert found["onset_s"] == pytest.approx(next(t for t in times if share(t) >= 0.5))
    assert found["detection_s"] == pytest.approx(next(t for t in times if share(t) >= 0.999))
    assert 1.8 < found["onset_s"] < found["detection_s"] < 2.6


@pytest.mark.parametrize(("gap_s", "lists_in_gap"), [(0.5, 4), (0.6, 0)])
def test_short_gaps_are_bridged_and_long_ones_not(gap_s: float, lists_in_gap: int) -> None:
    log = scenes.come_and_go(gap_s)
    truth = interpolate_at_instants(log.truth, log.truth.stamp_ns, t0_ns=log.scene.t0_ns, max_gap_s=0.5)
    walker = truth.captured_s[truth.frame_ix[truth.row_object_ix == 1]]
    assert np.count_nonzero((walker > 1.01) & (walker < 0.99 + gap_s)) == lists_in_gap
    assert len(study_rows(replayed(log, measure={"onset": {"kind": "appears"}}))) == 2, (
        "still one object with one onset"
    )


def test_a_unit_on_another_car_sees_past_it() -> None:
    """From the ego the first car is hidden by the middle one; a unit on the middle one sees it, and not the middle."""
    log = scenes.convoy()
    plan = experiment(
        units={"ego": EGO_UNIT | {"height_m": 1.0}, "v2v": {"on": "middle", "height_m": 1.0, "pem": "sure"}},
        pems={"sure": [{"detection": {"kind": "visible_share"}}]},
        configurations={"PEM": {"units": ["ego"]}, "V2V": {"units": ["v2v"]}},
    )
    found = observe_objects(log.scene, log.truth, plan)
    ids = np.array(log.scene.object_ids)[found.tracks.row_object_ix]
    unit = np.array(found.tracks.units)[found.tracks.row_unit_ix]
    assert set(ids[unit == "ego"]) == {"middle", "first"}
    assert set(ids[unit == "v2v"]) == {"ego", "first"}
    assert found.view.visible_share[(unit == "ego") & (ids == "first")].max() == 0
    assert found.view.visible_share[(unit == "v2v")].min() == 1
    assert set(found.view.range_m[(unit == "v2v")].round(9)) == {10.0}
    result = run_experiment(plan, [log])
    assert not row(result, "PEM", "first")["detected"]
    assert row(result, "V2V", "first")["detected"]


def test_units_heights_count_from_the_ground_under_them() -> None:
    """A box 1 m high hides the lower part of a pedestrian from eyes at 1 m, nothing from a mast; ground is at z = 5."""
    log = recording(
        [
            Thing("ego", "car", standing(0, 0), size_m=(4, 2, 1.5)),
            Thing("walker", "pedestrian", standing(20, 0), size_m=(0.5, 0.5, 2.0)),
            Thing("box", "other", standing(10, 0), size_m=(0.01, 6, 1.0), moving=False),
        ],
        until_s=0.1,
    )
    from dataclasses import replace

    raised = replace(log, truth=replace(log.truth, z_m=log.truth.z_m + 5))
    plan = experiment(
        units={"low": EGO_UNIT | {"height_m": 1.0}, "mast": {"at": [0, 0], "height_m": 6.0, "pem": "sure"}},
        configurations={"PEM": {"units": "all"}},
    )
    for each in (log, raised):
        found = observe_objects(each.scene, each.truth, plan)
        walker = found.tracks.row_object_ix == 1
        low, mast = (found.view.visible_share[walker & (found.tracks.row_unit_ix == k)] for k in (0, 1))
        assert low == pytest.approx(0.5, abs=1e-3)
        assert mast == pytest.approx(1.0)


def test_no_ego_distances_from_a_unit() -> None:
    from dataclasses import replace

    log = scenes.oncoming_car()
    log = replace(log, scene=replace(log.scene, ego_ix=-1))
    result = replayed(
        log,
        ego="none",
        units={"rsu": {"at": [0, 0], "height_m": 5.0, "pem": "sure"}},
        configurations={"RSU": {"units": ["rsu"]}},
        measure={"onset": {"kind": "in_range", "range_m": 80}, "distance_to": "rsu", "objects": {"ids": ["other"]}},
    )
    found = row(result, "RSU")
    assert found["time_to_detection_s"] == pytest.approx(2.0)
    assert found["distance_at_detection_m"] == pytest.approx(60.0)
    assert found["gap_at_detection_m"] == pytest.approx(58.0), "a unit is a point"


def test_an_offset_moves_a_fixed_unit_along_its_own_heading() -> None:
    """At (5, 0), looking north; 3 m forward and 4 m to the left is (1, 3). The car at x is hypot(x − 1, 3) away."""
    mast = {"at": [5, 0], "yaw_deg": 90, "offset_m": [3, 4], "height_m": 5.0, "pem": "all"}
    plan = experiment(units={"mast": mast}, configurations={"all": {"units": "all"}}, measure={"distance_to": "mast"})
    log = scenes.oncoming_car()
    found = observe_objects(log.scene, log.truth, plan)
    other = found.tracks.row_object_ix == log.scene.object_number["other"]
    assert found.view.range_m[other][0] == pytest.approx(np.hypot(99, 3))
    result = run_experiment(plan, [log])
    distance = row(result, "all")["distance_at_detection_m"]
    assert distance == pytest.approx(np.hypot(100 - 10 * row(result, "all")["detection_s"] - 1, 3))
