"""From when to when an object is looked at, and how far away it is: at the boundaries, by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from copem_replay.api.recordings import read_recording
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.detections_table import measure_distances
from copem_replay.metrics.episodes import find_episodes
from copem_replay.metrics.onset import began_texts
from copem_replay.metrics.survival import END_REASONS, end_reason_texts, is_competing
from copem_replay.perception.visibility import NO_STATICS
from tests.helpers import scenes
from tests.helpers.experiments import drive
from tests.helpers.scenes import Thing, driving, experiment, recording, standing


def looked(log: Recording, **changes: object) -> dict[str, tuple[float, str, float, str]]:
    """Onset, how it began, end and why, of each object."""
    found = find_episodes(log.scene, log.truth, NO_STATICS, experiment(**changes))
    return {
        log.scene.object_ids[k]: (float(onset_s), str(began), float(ended_s), str(why))
        for k, onset_s, began, ended_s, why in zip(
            found.object_ix,
            found.onset_s,
            began_texts(found.began),
            found.ended_s,
            end_reason_texts(found.ended_by),
            strict=True,
        )
    }


def test_who_leaves_with_the_ego_has_left() -> None:
    """Both are gone after 3 s of 8: the object's own end, so that it is never detected, not censored."""
    until: dict[str, object] = {"there": lambda t: t < 3.01}
    things = [
        Thing("ego", "car", standing(0, 0), **until),  # type: ignore[arg-type]
        Thing("with", "car", standing(20, 0), **until),  # type: ignore[arg-type]
        Thing("after", "car", standing(20, 9), there=lambda t: t < 3.11),
        Thing("stays", "car", standing(20, -9)),
    ]
    found = looked(recording(things, until_s=8.0), measure={"onset": {"kind": "appears"}})
    assert found == {
        "with": (0.0, "log_start", 3.0, "object_left"),
        "after": (0.0, "log_start", 3.0, "ego_left"),
        "stays": (0.0, "log_start", 3.0, "ego_left"),
    }


@pytest.mark.parametrize(("later_us", "ended_by"), [(1, "object_left"), (2, "ego_left")])
def test_a_microsecond_is_the_same_frame(later_us: int, ended_by: str) -> None:
    things = [
        Thing("ego", "car", standing(0, 0), there=lambda t: t < 0.5e-6),
        Thing("other", "car", standing(20, 0), there=lambda t: t < (later_us + 0.5) * 1e-6),
    ]
    found = looked(recording(things, until_s=9e-6, rate_hz=1e6), measure={"onset": {"kind": "appears"}})
    assert found["other"][3] == ended_by


def test_who_is_in_range_when_the_ego_comes_was_so_from_the_start() -> None:
    """The ego is in the log from 1 s on: before, the condition can be asked of nobody. Who comes later appears."""
    things = [
        Thing("ego", "car", standing(0, 0), there=lambda t: t > 0.99),
        Thing("near", "car", standing(20, 0)),
        Thing("comes", "car", driving(100, 5, -10)),
        Thing("later", "car", standing(20, 9), there=lambda t: t > 1.09),
        Thing("far", "car", driving(150, -5, -20), there=lambda t: t > 1.09),
    ]
    found = looked(recording(things, until_s=8.0), measure={"onset": {"kind": "in_range", "range_m": 80}})
    assert found["near"] == (1.0, "log_start", 8.0, "log_end")
    assert found["later"] == (pytest.approx(1.1), "appeared", 8.0, "log_end")
    assert found["far"][:2] == (pytest.approx(3.6), "crossed")  # 150 − 20 t, and 5 m beside: 78.2 m away at 3.6 s
    assert found["comes"][:2] == (pytest.approx(2.1), "crossed")  # 100 − 10 t, and 5 m beside: 79.2 m away at 2.1 s


def test_whose_condition_holds_later_crossed_whenever_the_track_began() -> None:
    """A car at the log's start beyond the range, one that appears beyond it, and one that is gone and back at once."""
    things = [
        Thing("ego", "car", standing(0, 0)),
        Thing("first", "car", driving(100, 0, -10)),
        Thing("second", "car", driving(90, 9, -10), there=lambda t: t > 0.49),
        Thing("gap", "car", standing(20, 20), there=lambda t: t < 0.01 or t > 2.0),
    ]
    found = looked(recording(things, until_s=8.0), measure={"onset": {"kind": "in_range", "range_m": 80}})
    assert {name: began for name, (_, began, _, _) in found.items()} == {
        "first": "crossed", "second": "crossed", "gap": "log_start",
    }  # fmt: skip


def test_an_instant_is_crossed_by_all() -> None:
    """At 0 s, too: the clock starts for all alike, whoever was there before."""
    found = looked(scenes.oncoming_car(), measure={"onset": {"kind": "at", "time_s": 0.0}})
    assert found["other"][:2] == (0.0, "crossed")


@pytest.mark.parametrize(("from_s", "began"), [(0.0, "crossed"), (1.5, "crossed"), (3.0, "log_start")])
def test_a_window_begins_the_log(tmp_path: Path, from_s: float, began: str) -> None:
    """The car is 70 − 10 t ahead: within 50 m from 2 s on, and so from the start of a window that begins later."""
    log = read_recording(drive(tmp_path / "drive.mcap"), window_s=(from_s, None))
    measure = {"objects": {"ids": ["2"]}, "onset": {"kind": "in_range", "range_m": 50}}
    assert looked(log, measure=measure)["2"][1] == began


@pytest.mark.parametrize(("share", "expected_s"), [(1.0, 2.3), (0.5, 2.1)])
def test_what_is_wholly_visible_reaches_a_share_of_one(share: float, expected_s: float) -> None:
    """A walker, 0.5 m wide, comes to the left from behind a wall whose left end is 1 m left of the line, 9.95 m ahead.

    His middle, 20 m ahead, is past it at 20 / 9.95 = 2.01 m, his right side, up to 20.25 m ahead, at 2.04 + 0.25 m.
    """
    onset = {"onset": {"kind": "line_of_sight", "visible_share": share}}
    found = looked(scenes.behind_a_wall(), measure=onset, visibility="flat", pems={"sure": scenes.SEES_ALL})
    assert found["walker"][:2] == (pytest.approx(expected_s), "crossed")


def test_only_an_object_that_leaves_is_never_detected() -> None:
    """The ends of the ego and of the log censor; positions are those of the texts, in any shape."""
    assert is_competing(pd.Series(["log_end", "object_left", "ego_left"])).tolist() == [False, True, False]
    assert is_competing(pd.Series([], dtype=object)).tolist() == []
    assert {reason.value: reason.censors for reason in END_REASONS} == {
        "object_left": False, "ego_left": True, "log_end": True,
    }  # fmt: skip
    assert end_reason_texts(np.array([2, 0, 1, 0])).tolist() == ["log_end", "object_left", "ego_left", "object_left"]


def without_a_size(distance_to: str) -> tuple[Recording, Experiment]:
    log = scenes.oncoming_car()
    pole = {"at": [10.0, 0.0], "height_m": 5.0, "ground_z_m": 0.0, "pem": "sure"}
    units = {"ego": scenes.EGO_UNIT, "pole": pole}
    plan = experiment(units=units, measure={"onset": {"kind": "appears"}, "distance_to": distance_to})
    return replace(log, scene=replace(log.scene, ego_sized=False)), plan


@pytest.mark.parametrize(("distance_to", "distance_m", "gap_m"), [("ego", 80.0, None), ("pole", 70.0, 68.0)])
def test_the_gap_to_a_unit_is_known_where_the_ego_has_no_size(
    distance_to: str, distance_m: float, gap_m: float | None
) -> None:
    """At 2 s the car is at 80 m, its front 2 m nearer; a unit is a point, an ego of unknown size has no gap."""
    log, plan = without_a_size(distance_to)
    other = np.array([log.scene.object_number["other"]])
    distance, gap = measure_distances(log.scene, log.truth, plan, other, np.array([2.0]))
    assert distance.tolist() == [pytest.approx(distance_m)]
    assert np.isnan(gap[0]) if gap_m is None else gap[0] == pytest.approx(gap_m)
