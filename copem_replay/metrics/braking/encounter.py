"""Encounters: what would happen between the ego and a measured object if the ego did not brake.

Prepared once per log; nothing here depends on the run or on a configuration. An encounter is *in conflict* when the
ego, not braking, comes within the margin of the object's true motion after the onset. Times are judged at instants
`NODE_S` apart and at every frame; between them both move on straight lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.box_distance import nearest
from copem_replay.core.tracks import Float, Int, Scene, Tracks
from copem_replay.metrics.braking.blocked import blocked
from copem_replay.metrics.braking.ego_path import Course, EgoPath
from copem_replay.metrics.config import MetricsSetup
from copem_replay.metrics.episodes import Episodes

NODE_S = 0.01
"""Between instants of judgement (chosen: at 10 m/s² a straight line over it is off by 0.13 mm)."""

_STRETCHES = 3
"""How often the ego's path may meet a place, by a lap or in reverse (chosen)."""


@dataclass(frozen=True)
class Encounter:
    """One measured object and the ego, from the onset until the object leaves. V vertices of the ego's path."""

    episode_ix: int
    time_s: Float  # (T,)
    course: Course
    path: Float  # (V, 4): arc length, x, y, yaw
    size_m: Float  # (2,) of the ego
    other: Float  # (3, T): x, y, yaw of the object, NaN where it is not in the log
    other_size_m: Float  # (2,)
    stretch_m: Float  # (B, 2, T): from where to where the ego, on its path, is within the margin; inf: nowhere
    spent_s: float  # when the ego that does not brake first comes within the margin


def encounters(scene: Scene, truth: Tracks, found: Episodes, experiment: MetricsSetup) -> tuple[Encounter, ...]:
    """The encounters in conflict, in the order of the episodes. None without `braking`."""
    braking = experiment.braking
    if braking is None or scene.ego_ix < 0:
        return ()
    ego = EgoPath(scene, truth, experiment.max_gap_s)
    result = []
    track_of = {int(object_ix): track for track, object_ix in enumerate(truth.object_ix)}
    for k, object_ix in enumerate(found.object_ix):
        track = track_of[int(object_ix)]
        rows = np.arange(truth.start[track], truth.start[track + 1])
        onset_s = float(found.onset_s[k])
        constant_from_s = onset_s if braking.ego == "constant_speed" else None
        if _may_meet(ego, truth, rows, onset_s, constant_from_s, braking.margin_m):
            encounter = _encounter(ego, truth, rows, k, onset_s, constant_from_s, braking.margin_m)
            result += [encounter] if encounter is not None else []
    return tuple(result)


def _may_meet(
    ego: EgoPath, truth: Tracks, rows: Int, onset_s: float, constant_from_s: float | None, margin_m: float
) -> bool:
    """Whether an object comes anywhere near the ego's course: what surely stays away needs no closer look.

    `rows`: those of the object.
    """
    # The frame before the onset stands for the onset itself, which may lie between two.
    first = max(int(np.searchsorted(truth.row_captured_s[rows], onset_s, side="right")) - 1, 0)
    rows = rows[first:]
    course = ego.course(truth.row_captured_s[rows], constant_from_s)
    shared = truth.row_captured_s[rows] <= course.until_s
    rows, bound_m = rows[shared], course.bound_m[shared]
    if not len(rows):
        return False
    x, y = _ahead(ego.path, bound_m)
    dx, dy = truth.x_m[0, rows] - x, truth.y_m[0, rows] - y
    radii = (np.hypot(*ego.size_m) + np.hypot(truth.length_m[0, rows[0]], truth.width_m[0, rows[0]])) / 2
    step = np.hypot(np.diff(dx), np.diff(dy)).max(initial=0.0)
    return bool((np.hypot(dx, dy) - radii - step).min() <= margin_m)


def _ahead(path: Float, along_m: Float) -> tuple[Float, Float]:
    """Places (K,) on a path, straight on beyond its ends."""
    k = np.clip(np.searchsorted(path[:, 0], along_m) - 1, 0, len(path) - 2)
    f = (along_m - path[k, 0]) / (path[k + 1, 0] - path[k, 0])
    return path[k, 1] + f * (path[k + 1, 1] - path[k, 1]), path[k, 2] + f * (path[k + 1, 2] - path[k, 2])


def _encounter(
    ego: EgoPath, truth: Tracks, rows: Int, episode_ix: int, onset_s: float, constant_from_s: float | None,
    margin_m: float,
) -> Encounter | None:  # fmt: skip
    """The encounter of one episode, None where the ego, not braking, stays clear."""
    own_s = truth.row_captured_s[rows]
    last_s = max(float(own_s[-1]), onset_s)
    regular = onset_s + NODE_S * np.arange(int((last_s - onset_s) / NODE_S) + 1)
    frames = own_s[(own_s > onset_s) & (own_s <= last_s)]
    time_s = np.unique(np.round(np.concatenate([regular, frames]), 9))  # to a nanosecond: equal instants are one
    at, _ = ego.states(int(truth.row_object_ix[rows[0]]), time_s)
    course = ego.course(time_s, constant_from_s)
    other = np.stack([at["x_m"], at["y_m"], _unwrapped(at["yaw_rad"])])
    other_size = np.array([truth.length_m[0, rows[0]], truth.width_m[0, rows[0]]])
    near, touch = np.empty(1), np.empty(1)
    nearest(course.along_m[None], ego.path, ego.size_m, other, other_size, near, touch)
    if not near[0] <= margin_m:
        return None
    stretch_m = np.empty((_STRETCHES, 2, len(time_s)))
    blocked(ego.path, ego.size_m, other, other_size, margin_m, float(course.bound_m[0]), course.bound_m, stretch_m)
    within = ((course.along_m >= stretch_m[:, 0]) & (course.along_m <= stretch_m[:, 1])).any(axis=0)
    spent_s = time_s[np.argmax(within)] if within.any() else np.inf
    return Encounter(episode_ix, time_s, course, ego.path, ego.size_m, other, other_size, stretch_m, float(spent_s))


def _unwrapped(yaw_rad: Float) -> Float:
    """Angles without jumps, NaN left where it is."""
    known = ~np.isnan(yaw_rad)
    result = yaw_rad.copy()
    result[known] = np.unwrap(yaw_rad[known])
    return result
