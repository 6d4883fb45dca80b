"""Encounters: what would happen between the ego and a measured object if the ego did not brake.

Prepared once per log; nothing here depends on the run or on a configuration. An encounter is *in conflict* when the
ego, not braking, comes within the margin of the object's true motion after the onset. Distances are judged at instants
`NODE_S` apart and at every frame; between them both move on straight lines.

The ego's path is made of its recorded places that are at least `STRIDE_M` apart, so that the jitter of a standing
vehicle is no way; it turns back only where the ego goes back by `REVERSAL_M`. It ends with the ego's last place, if
that is not behind, and goes straight on from there as the ego heads then (backwards where the ego was in reverse).

Letters as in core/geometry.py: T instants, V path vertices, R courses of the ego.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.compiled import borrowing, borrowing_kernel, kernel
from copem_replay.core.geometry import (
    box_distance,
    corner_travel,
    count_below,
    find_smallest_distances,
    pose_on_path,
)
from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Scene, Tracks
from copem_replay.metrics.config import MetricsSetup
from copem_replay.metrics.episodes import Episodes

# The ego's course: its path through the log, and how it drives along it.

STRIDE_M = 0.1
"""Places of the path are at least this far apart: more than the jitter of a standing vehicle."""
REVERSAL_M = 2.0
"""Going back by this much is reversing; going back by less is taken for noise of the place."""


@dataclass(frozen=True)
class Course:
    """The course of the ego that does not brake, at T instants.

    `along_m (T,)`: way from the first vertex of the path, NaN where the ego is not in the log. `bound_m (T,)`: that way
    with gaps closed, and beyond the ego's last frame, `until_s`, with its last speed; the ego is never farther.
    `speed_mps (T,)`.
    """

    along_m: Float
    bound_m: Float
    speed_mps: Float
    until_s: float


class EgoPath:
    """The ego's path through the log, and how it drives along it.

    `path (V, 4)`: arc length, x, y, yaw; `size_m (2,)`: length, width. `frame_s`, `frame_m`, `frame_mps (F,)`: instant,
    way along the path and speed at the ego's own frames.
    """

    def __init__(self, scene: Scene, truth: Tracks, max_gap_s: float) -> None:
        self._truth, self._scene, self._max_gap_s = truth, scene, max_gap_s
        rows = np.flatnonzero(truth.row_object_ix == scene.ego_ix)
        x, y, yaw = truth.x_m[0, rows], truth.y_m[0, rows], np.unwrap(truth.yaw_rad[0, rows])
        self.frame_s = truth.row_captured_s[rows]
        self.frame_mps = np.hypot(truth.vx_mps[0, rows], truth.vy_mps[0, rows])
        vertex, backwards = _choose_vertices(x, y, yaw, STRIDE_M, REVERSAL_M)
        places = np.stack([_arc_length_m(x[vertex], y[vertex]), x[vertex], y[vertex], yaw[vertex]], axis=1)
        self.path = _extend_end(places, backwards)
        self.frame_m = _project_on_path(x, y, vertex, self.path)
        self.size_m = np.array([truth.length_m[0, rows[0]], truth.width_m[0, rows[0]]])

    def course(self, time_s: Float, constant_from_s: float | None = None) -> Course:
        """Where the ego is at instants (T,): as recorded, or at constant speed from `constant_from_s` (s) on."""
        if constant_from_s is not None:
            start_m, speed = (np.interp(constant_from_s, self.frame_s, v) for v in (self.frame_m, self.frame_mps))
            along = start_m + speed * (time_s - constant_from_s)
            return Course(along, along, np.full(len(time_s), speed), np.inf)
        last_s = float(self.frame_s[-1])
        bound = np.interp(time_s, self.frame_s, self.frame_m)
        bound += self.frame_mps[-1] * np.maximum(time_s - last_s, 0.0)
        _, present = self.states(self._scene.ego_ix, time_s)
        speed = np.interp(time_s, self.frame_s, self.frame_mps)
        return Course(np.where(present, bound, np.nan), bound, speed, last_s + SAME_INSTANT_S)

    def locate(self, along_m: Float) -> tuple[Float, Float]:
        """Places (K,) at these distances along the path; beyond its ends it goes straight on."""
        path = self.path
        k = np.clip(np.searchsorted(path[:, 0], along_m) - 1, 0, len(path) - 2)
        f = (along_m - path[k, 0]) / (path[k + 1, 0] - path[k, 0])
        return path[k, 1] + f * (path[k + 1, 1] - path[k, 1]), path[k, 2] + f * (path[k + 1, 2] - path[k, 2])

    def states(self, object_ix: int, time_s: Float) -> tuple[dict[str, Float], Bool]:
        """The states of an object at instants (T,), and whether it is in the log then."""
        which = np.full(len(time_s), object_ix)
        return interpolate_states(self._truth, which, time_s, t0_ns=self._scene.t0_ns, max_gap_s=self._max_gap_s)


def _arc_length_m(x_m: Float, y_m: Float) -> Float:
    """(V,) way in metres from the first place to each."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))])


def _extend_end(path: Float, backwards: bool) -> Float:
    """The path (V, 4) and one more vertex a metre on: ahead, or behind where the ego was in reverse."""
    _, x, y, yaw = path[-1]
    ahead = np.array([np.cos(yaw), np.sin(yaw)]) * (-1 if backwards else 1)
    return np.vstack([path, [path[-1, 0] + 1.0, x + ahead[0], y + ahead[1], yaw]])


def _project_on_path(x_m: Float, y_m: Float, vertex: Int, path: Float) -> Float:
    """(F,) way along the path to each place, projected on the piece from the vertex before it; it never decreases."""
    piece = np.searchsorted(vertex, np.arange(len(x_m)), side="right") - 1
    way = np.diff(path[:, :3], axis=0)[piece]
    ahead_m = ((x_m - path[piece, 1]) * way[:, 1] + (y_m - path[piece, 2]) * way[:, 2]) / way[:, 0]
    result: Float = np.maximum.accumulate(path[piece, 0] + np.clip(ahead_m, 0.0, way[:, 0]))
    return result


@kernel
def _choose_vertices(x_m: Float, y_m: Float, yaw_rad: Float, stride_m: float, reversal_m: float) -> tuple[Int, bool]:
    """Indices (V,) of the places (x, y, yaw) that make the path, and whether it ends in reverse.

    These are the first place, and each a stride ahead of the last vertex, or `reversal_m` behind it, which turns the
    direction of travel. The last place, if less than a stride ahead, replaces the last vertex: in a bend the ego heads
    elsewhere a decimetre before.
    """
    vertices = np.empty(len(x_m), dtype=np.int64)
    vertices[0] = 0
    n, backwards = 1, False
    for k in range(1, len(x_m)):
        dx, dy = x_m[k] - x_m[vertices[n - 1]], y_m[k] - y_m[vertices[n - 1]]
        reverses = (dx * np.cos(yaw_rad[k]) + dy * np.sin(yaw_rad[k]) < 0) != backwards
        if np.hypot(dx, dy) >= (reversal_m if reverses else stride_m):
            vertices[n] = k
            n += 1
            backwards = backwards != reverses
        elif k == len(x_m) - 1 and n > 1 and not reverses:
            dx, dy = x_m[k] - x_m[vertices[n - 2]], y_m[k] - y_m[vertices[n - 2]]
            if np.hypot(dx, dy) >= stride_m:
                vertices[n - 1] = k
    return vertices[:n].copy(), backwards


# The stretches of its path that the ego must not be on, and the deceleration that avoids them. Compiled.

_STRIDE_M = 1e-3
"""The shortest step along a path in search of a contact: a shorter graze may be missed."""
_INSIDE_M = 0.1
"""The step along a path in search of the end of a contact: a shorter gap may be missed."""


@borrowing_kernel
def find_blocked_stretches(
    path: Float, size: Float, other: Float, other_size: Float, margin_m: float, from_m: float, to_m: Float, out: Float
) -> None:
    """The stretches of the path on which the ego is within the margin of the other: `out (B, 2, T)`, from and to.

    The first B stretches from `from_m` on that begin before `to_m (T,)`; inf and inf where there are fewer. The ego
    advances by the distance that surely stays clear until that is 0 (sphere tracing), then step by step until it is
    clear again.
    """
    most = corner_travel(path, size)
    out[:] = np.inf
    for k in range(other.shape[1]):
        if np.isnan(other[0, k]):
            continue
        clear, s, count = from_m, from_m, 0
        while s <= to_m[k] and count < len(out):
            free = _clearance_m(path, size, other[:, k], other_size, margin_m, s)
            if free > 0.0:
                clear = s
                s += max(free / most, _STRIDE_M)
                continue
            out[count, 0, k] = _find_border(path, size, other[:, k], other_size, margin_m, clear, s)
            while free <= 0.0:
                within, s = s, s + _INSIDE_M
                free = _clearance_m(path, size, other[:, k], other_size, margin_m, s)
            out[count, 1, k] = _find_border(path, size, other[:, k], other_size, margin_m, s, within)
            clear, count = s, count + 1


@borrowing
def _clearance_m(path: Float, size: Float, other: Float, other_size: Float, margin_m: float, s: float) -> float:
    """Distance in metres, minus the margin, between the other and the ego at a place of its path."""
    x, y, yaw = pose_on_path(path, s)
    return float(
        box_distance(x, y, yaw, size[0], size[1], other[0], other[1], other[2], other_size[0], other_size[1]) - margin_m
    )


@borrowing
def _find_border(
    path: Float, size: Float, other: Float, other_size: Float, margin_m: float, clear: float, within: float
) -> float:
    """The distance along the path (m) between `clear` and `within` at which the margin is reached, by bisection."""
    for _ in range(40):
        s = (clear + within) / 2
        if _clearance_m(path, size, other, other_size, margin_m, s) > 0.0:
            clear = s
        else:
            within = s
    return within


@borrowing_kernel
def find_required_deceleration(
    time_s: Float, stretch_m: Float, begin_s: Float, begin_m: Float, speed_mps: Float, out: Float
) -> None:
    """Out (R,): smallest constant deceleration from `begin_s (R,)` on that avoids `stretch_m (B, 2, T)`; inf: none.

    At `begin_s` the ego is at `begin_m (R,)` with `speed_mps (R,)`. Each instant rules out the decelerations between
    the one that brings the ego to the end of a stretch by then and the one that brings it to its beginning.
    """
    for r in range(len(out)):
        first = count_below(time_s, begin_s[r])
        a, ruled_out = 0.0, True
        while ruled_out and a < np.inf:
            ruled_out = False
            for k in range(first, len(time_s)):
                t = time_s[k] - begin_s[r]
                for b in range(len(stretch_m)):
                    if stretch_m[b, 0, k] == np.inf:
                        break
                    most = _deceleration_to_reach(stretch_m[b, 0, k] - begin_m[r], t, speed_mps[r])
                    if a < most and a >= _deceleration_to_reach(stretch_m[b, 1, k] - begin_m[r], t, speed_mps[r]):
                        a, ruled_out = most, True
        out[r] = a


@borrowing
def _deceleration_to_reach(way_m: float, after_s: float, speed_mps: float) -> float:
    """The constant deceleration (m/s²) with which the ego covers at most `way_m` in `after_s`; inf: `way_m` ≤ 0. 0
    where v·t ≤ g; 2 (v·t − g) / t² where the ego still moves then; v² / 2 g where it has stopped before.
    """
    if way_m <= 0:
        return np.inf
    if speed_mps * after_s <= way_m:
        return 0.0
    if speed_mps * after_s / 2 <= way_m:
        return 2 * (speed_mps * after_s - way_m) / (after_s * after_s)
    return speed_mps * speed_mps / (2 * way_m)


NODE_S = 0.01
"""Seconds between instants of judgement: at 10 m/s² a straight line over it is off by 0.13 mm."""

_STRETCHES = 3
"""How often the ego's path may meet a place, by a lap or in reverse; further meetings are not looked at."""


@dataclass(frozen=True)
class Encounter:
    """One measured object and the ego that does not brake, from the onset until the object leaves."""

    episode_ix: int
    time_s: Float  # (T,)
    course: Course
    path: Float  # (V, 4): arc length, x, y, yaw
    size_m: Float  # (2,) of the ego
    other: Float  # (3, T): x, y, yaw of the object, NaN where it is not in the log
    other_size_m: Float  # (2,)
    stretch_m: Float  # (B, 2, T): stretches of the path on which the ego is within the margin, from and to; inf: none
    spent_s: float  # when the ego that does not brake first comes within the margin


def find_encounters(scene: Scene, truth: Tracks, episodes: Episodes, experiment: MetricsSetup) -> tuple[Encounter, ...]:
    """The encounters in conflict, in the order of the episodes. None without `braking`."""
    braking = experiment.braking
    if braking is None or scene.ego_ix < 0:
        return ()
    ego = EgoPath(scene, truth, experiment.max_gap_s)
    encounters = []
    track_of = {int(object_ix): track for track, object_ix in enumerate(truth.object_ix)}
    for k, object_ix in enumerate(episodes.object_ix):
        track = track_of[int(object_ix)]
        rows = np.arange(truth.start[track], truth.start[track + 1])
        onset_s = float(episodes.onset_s[k])
        if k + 1 < len(episodes.object_ix) and episodes.object_ix[k + 1] == object_ix:  # it comes back
            rows = rows[truth.row_captured_s[rows] < episodes.onset_s[k + 1] - SAME_INSTANT_S]
        constant_from_s = onset_s if braking.ego == "constant_speed" else None
        if _may_meet(ego, truth, rows, onset_s, constant_from_s, braking.margin_m):
            encounter = _find_encounter(ego, truth, rows, k, onset_s, constant_from_s, braking.margin_m)
            encounters += [encounter] if encounter is not None else []
    return tuple(encounters)


def _may_meet(
    ego: EgoPath, truth: Tracks, rows: Int, onset_s: float, constant_from_s: float | None, margin_m: float
) -> bool:
    """Whether an object (its `rows` of the truth) may come within the margin of the ego's course; False is certain."""
    # The frame before the onset stands for the onset itself, which may lie between two.
    first_row = max(int(np.searchsorted(truth.row_captured_s[rows], onset_s, side="right")) - 1, 0)
    rows = rows[first_row:]
    course = ego.course(truth.row_captured_s[rows], constant_from_s)
    is_on_course = truth.row_captured_s[rows] <= course.until_s
    rows, bound_m = rows[is_on_course], course.bound_m[is_on_course]
    if not len(rows):
        return False
    x, y = ego.locate(bound_m)
    dx, dy = truth.x_m[0, rows] - x, truth.y_m[0, rows] - y
    radii = (np.hypot(*ego.size_m) + np.hypot(truth.length_m[0, rows[0]], truth.width_m[0, rows[0]])) / 2
    step = np.hypot(np.diff(dx), np.diff(dy)).max(initial=0.0)
    return bool((np.hypot(dx, dy) - radii - step).min() <= margin_m)


def _find_encounter(
    ego: EgoPath, truth: Tracks, rows: Int, episode_ix: int, onset_s: float, constant_from_s: float | None,
    margin_m: float,
) -> Encounter | None:  # fmt: skip
    """The encounter of one episode; None: the ego, not braking, stays farther than the margin from the object."""
    captured_s = truth.row_captured_s[rows]
    last_s = max(float(captured_s[-1]), onset_s)
    regular = onset_s + NODE_S * np.arange(int((last_s - onset_s) / NODE_S) + 1)
    frames = captured_s[(captured_s > onset_s) & (captured_s <= last_s)]
    time_s = np.unique(np.round(np.concatenate([regular, frames]), 9))  # to a nanosecond: equal instants are one
    states, _ = ego.states(int(truth.row_object_ix[rows[0]]), time_s)
    course = ego.course(time_s, constant_from_s)
    other = np.stack([states["x_m"], states["y_m"], _unwrap_angles(states["yaw_rad"])])
    other_size = np.array([truth.length_m[0, rows[0]], truth.width_m[0, rows[0]]])
    least_distance_m, touch = np.empty(1), np.empty(1)
    find_smallest_distances(course.along_m[None], ego.path, ego.size_m, other, other_size, least_distance_m, touch)
    if not least_distance_m[0] <= margin_m:
        return None
    stretch_m = np.empty((_STRETCHES, 2, len(time_s)))
    find_blocked_stretches(
        ego.path, ego.size_m, other, other_size, margin_m, float(course.bound_m[0]), course.bound_m, stretch_m
    )
    is_within = ((course.along_m >= stretch_m[:, 0]) & (course.along_m <= stretch_m[:, 1])).any(axis=0)
    reached_s = time_s[np.argmax(is_within)] if is_within.any() else np.inf
    return Encounter(episode_ix, time_s, course, ego.path, ego.size_m, other, other_size, stretch_m, float(reached_s))


def _unwrap_angles(yaw_rad: Float) -> Float:
    """Angles without jumps, NaN left where it is."""
    defined = ~np.isnan(yaw_rad)
    unwrapped = yaw_rad.copy()
    unwrapped[defined] = np.unwrap(yaw_rad[defined])
    return unwrapped
