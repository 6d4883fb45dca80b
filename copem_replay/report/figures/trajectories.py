"""Courses of the ego and how near the object is: as recorded, as it is judged without braking, and braked.

Instants are seconds since the log's start, (T,).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from copem_replay.core.box_distance import box_distance, pose_on
from copem_replay.core.tracks import SAME_INSTANT_NS, Float
from copem_replay.metrics.braking.driver import Driver
from copem_replay.metrics.braking.ego_path import EgoPath
from copem_replay.metrics.braking.encounter import Encounter
from copem_replay.metrics.braking.verdict import braked
from copem_replay.pipeline.prepare import Replay

_SAME_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class DrivenCourse:
    """How the ego drives and how near the object is: all (T,), NaN where the ego (or either) is not in the log."""

    time_s: Float
    speed_mps: Float
    gap_m: Float  # box to box


def recorded_course(replay: Replay, max_gap_s: float, object_ix: int, time_s: Float) -> DrivenCourse:
    """As the log has both."""
    ego = EgoPath(replay.scene, replay.truth, max_gap_s)
    course = ego.course(time_s)
    at, present = ego.states(object_ix, time_s)
    other = np.stack([at["x_m"], at["y_m"], at["yaw_rad"]])
    k = int(np.argmax(present))  # sizes do not change
    size_m = np.array([at["length_m"][k], at["width_m"][k]])
    speed = np.where(np.isnan(course.along_m), np.nan, course.speed_mps)
    return DrivenCourse(time_s, speed, _gaps(course.along_m, ego.path, ego.size_m, other, size_m))


def free_course(
    replay: Replay, max_gap_s: float, object_ix: int, encounter: Encounter | None, time_s: Float
) -> DrivenCourse:
    """The ego that does not brake: recorded until the onset, then as the encounter is judged, if there is one."""
    course = recorded_course(replay, max_gap_s, object_ix, time_s)
    if encounter is None:
        return course
    after = time_s >= encounter.time_s[0]
    along_m = np.interp(time_s[after], encounter.time_s, encounter.course.along_m, right=np.nan)
    speed = np.interp(time_s[after], encounter.time_s, encounter.course.speed_mps)
    course.speed_mps[after] = np.where(np.isnan(along_m), np.nan, speed)
    course.gap_m[after] = _gaps_along(encounter, along_m, time_s[after])
    return course


def braked_course(encounter: Encounter, driver: Driver, brake_s: float, time_s: Float) -> DrivenCourse:
    """The ego that begins to brake at `brake_s` (inf: never), from the onset on; the object does not react."""
    along_m, speed = (
        np.interp(time_s, encounter.time_s, of[0]) for of in braked(encounter, driver, np.array([brake_s]))
    )
    speed[np.isnan(along_m)] = np.nan
    course = DrivenCourse(time_s, speed, _gaps_along(encounter, along_m, time_s))
    # Encounters are timed to a nanosecond.
    beyond = (time_s < encounter.time_s[0] - _SAME_S) | (time_s > encounter.time_s[-1] + _SAME_S)
    course.speed_mps[beyond] = course.gap_m[beyond] = np.nan
    return course


def _gaps_along(encounter: Encounter, along_m: Float, time_s: Float) -> Float:
    """Gap (T,) with the ego at places (T,) of its path."""
    other = np.stack([np.interp(time_s, encounter.time_s, values, right=np.nan) for values in encounter.other])
    return _gaps(along_m, encounter.path, encounter.size_m, other, encounter.other_size_m)


@nb.njit(cache=True)
def _gaps(along: Float, path: Float, size: Float, other: Float, other_size: Float) -> Float:
    """Box distance (T,) of the ego at places (T,) of its path from the other at poses (3, T); NaN where one is not."""
    result = np.full(len(along), np.nan)
    for k in range(len(along)):
        if not np.isnan(along[k]) and not np.isnan(other[0, k]):
            x, y, yaw = pose_on(path, along[k])
            result[k] = box_distance(
                x, y, yaw, size[0], size[1], other[0, k], other[1, k], other[2, k], other_size[0], other_size[1]
            )
    return result
