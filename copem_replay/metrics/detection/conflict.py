"""Implied collisions: the first fused list that implies one, and the episodes that `measure.objects.within` keeps.

A fused list implies a collision when the object, keeping its perceived velocity from its perceived place, will within
the horizon be in the ego's corridor: the part of its own path that the ego, at its present speed, will sweep, and a
margin around it. Paths are compared, arrival times are not. Source: Piazzoni et al. 2022 (detection of the potential
collision).

`within` is decided on the truth. Polygon and path: by the object's centre at the onset; conflict: at any of its frames
from the onset to the end of its episode. The path is the part ahead of the ego at the onset, up to the end of the
episode.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.errors import ExperimentError
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.geometry import are_in_area, polygon_corners, pose_on_path
from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Scene, Tracks
from copem_replay.metrics.areas import are_in_areas, are_in_named
from copem_replay.metrics.braking.encounter import EgoPath
from copem_replay.metrics.config import Confirm, Conflict, MetricsSetup, Within

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes


_PIECE_M = 2.0
"""Length of the straight pieces of a corridor; shorter: narrower corridors in bends, slower."""
_PIECES = 500
"""Corridors above a kilometre have this many longer pieces, so that no speed makes the computation slow."""


class ConflictDetector:
    """When the receiver first has a list (`hits` of its last `of` lists) that implies a collision, episode by episode.

    As with detections, a list counts when a capture at or after the onset contributed to its entry.
    Time chunks of a log are added one after the other.
    """

    def __init__(self, ego: EgoPath, episodes: Episodes, conflict: Conflict, *, confirm: Confirm, count_earlier: bool):
        self._ego, self._episodes, self._conflict, self._confirm = ego, episodes, conflict, confirm
        self._not_before_s = episodes.counts_from_s(count_earlier=count_earlier)
        self._lists, self._runs, self._issue_s = 0, 1, [np.empty(0)]
        self._held: dict[tuple[int, int], list[Int]] = {}  # by run and episode: numbers of the lists that imply one

    def add(self, fused_tracks: FusedTracks, first_run: int = 0) -> None:
        """Add the fused tracks of a time chunk in runs `first_run` … + S; notes the lists that imply a collision."""
        fused = fused_tracks.fused
        self._runs = max(self._runs, first_run + len(fused.valid))
        issue_s = fused.common_arrives_s
        implied = find_conflicts(fused, self._ego, self._conflict)
        newest_s = fused_tracks.captured_s
        track_of = {int(o): k for k, o in enumerate(fused.object_ix)}
        for m, object_ix in enumerate(self._episodes.object_ix.tolist()):
            if object_ix not in track_of:
                continue
            track = track_of[object_ix]
            rows = slice(int(fused.start[track]), int(fused.start[track + 1]))
            counts = implied[:, rows] & (newest_s[:, rows] >= self._not_before_s[m])
            counts &= issue_s[fused.frame_ix[rows]] <= self._episodes.ended_s[m] + SAME_INSTANT_S
            for s in np.flatnonzero(counts.any(axis=1)).tolist():
                held = self._lists + fused.frame_ix[rows][counts[s]]
                self._held.setdefault((first_run + s, m), []).append(held)

    def next(self, issue_s: Float) -> None:
        """End a time chunk, whose lists are available at `issue_s (K,)`."""
        self._issue_s.append(issue_s)
        self._lists += len(issue_s)

    def result(self) -> Float:
        """(S, M) instant (s) of the list that confirms an implied collision; NaN: never. S = 1: alike in all runs."""
        issue_s = np.concatenate(self._issue_s)
        first_s = np.full((self._runs, len(self._episodes.object_ix)), np.nan)
        hits, window = self._confirm.hits, self._confirm.of
        for (s, m), parts in self._held.items():
            list_ix = np.concatenate(parts)
            # Places in `list_ix` from which `hits` lists are within `window` consecutive ones.
            confirmed_at = np.flatnonzero(list_ix[hits - 1 :] - list_ix[: max(len(list_ix) - hits + 1, 0)] < window)
            if len(confirmed_at):
                first_s[s, m] = issue_s[list_ix[confirmed_at[0] + hits - 1]]
        return first_s


def find_conflicts(tracks: Tracks, ego: EgoPath, conflict: Conflict) -> Bool:
    """(S, P) whether each state of the tracks implies a collision, at the instants their lists are available."""
    pieces, bounds = build_corridors(ego, tracks.common_arrives_s, conflict)
    implied = np.zeros(tracks.valid.shape, dtype=np.bool_)
    columns = (tracks.x_m, tracks.y_m, tracks.yaw_rad, tracks.vx_mps, tracks.vy_mps, tracks.length_m, tracks.width_m)
    _mark_conflicts(tracks.valid, _Boxes(*columns), tracks.frame_ix, pieces, bounds, conflict.horizon_s, implied)
    return implied


def build_corridors(ego: EgoPath, now_s: Float, conflict: Conflict) -> tuple[Float, Int]:
    """Rectangles (C, 5), x, y, yaw, length, width, that cover the ego's corridor at instants (K,); bounds (K + 1,).

    Those of instant k are rows `bounds[k] : bounds[k + 1]`; none where the ego is not in the log.
    """
    course = ego.course(now_s)
    ahead_m = np.where(np.isnan(course.along_m), np.nan, course.speed_mps * conflict.horizon_s)
    pieces_of = np.clip(np.ceil(np.nan_to_num(ahead_m) / _PIECE_M), 1, _PIECES)
    count = np.where(np.isnan(ahead_m), 0, pieces_of).astype(np.int64)
    bounds = np.concatenate([[0], np.cumsum(count)])
    pieces = np.empty((bounds[-1], 5))
    size = ego.size_m + 2 * conflict.margin_m
    _cover_corridor(ego.path, course.along_m, np.nan_to_num(ahead_m), bounds, size, pieces)
    return pieces, bounds


@kernel
def _cover_corridor(path: Float, along: Float, ahead: Float, bounds: Int, size: Float, pieces: Float) -> None:
    """Fills `pieces (…, 5)` (x, y, yaw, length, width) with boxes that cover the ego's way `ahead` from `along`."""
    for k in range(len(along)):
        n = bounds[k + 1] - bounds[k]
        for j in range(n):
            from_m, to_m = along[k] + ahead[k] * j / n, along[k] + ahead[k] * (j + 1) / n
            x, y, yaw = pose_on_path(path, (from_m + to_m) / 2)
            c, s = np.cos(yaw), np.sin(yaw)
            low, high, right, left = 0.0, 0.0, 0.0, 0.0
            first = np.searchsorted(path[:, 0], from_m)
            last = np.searchsorted(path[:, 0], to_m)
            for v in range(first - 1, last + 1):
                at_m = from_m if v < first else to_m if v == last else path[v, 0]
                px, py, _ = pose_on_path(path, at_m)
                u, w = c * (px - x) + s * (py - y), -s * (px - x) + c * (py - y)
                low, high, right, left = min(low, u), max(high, u), min(right, w), max(left, w)
            u, w = (low + high) / 2, (right + left) / 2
            piece = pieces[bounds[k] + j]
            piece[0], piece[1], piece[2] = x + c * u - s * w, y + s * u + c * w, yaw
            piece[3], piece[4] = size[0] + high - low, size[1] + left - right


class _Boxes(NamedTuple):
    # Perceived states, all (S, P).
    x_m: Float
    y_m: Float
    yaw_rad: Float
    vx_mps: Float
    vy_mps: Float
    length_m: Float
    width_m: Float


@kernel
def _mark_conflicts(
    valid: Bool, boxes: _Boxes, frame_ix: Int, pieces: Float, bounds: Int, horizon_s: float, out: Bool
) -> None:
    """Sets `out (S, P)` where a box, at constant velocity, will enter a piece of the corridor within the horizon."""
    x, y, yaw, vx, vy, length, width = boxes
    for s in range(valid.shape[0]):
        for p in range(valid.shape[1]):
            if not valid[s, p]:
                continue
            for c in range(bounds[frame_ix[p]], bounds[frame_ix[p] + 1]):
                if will_enter(
                    x[s, p], y[s, p], yaw[s, p], vx[s, p], vy[s, p], length[s, p], width[s, p], pieces[c], horizon_s
                ):
                    out[s, p] = True
                    break


@callee
def will_enter(
    x: float, y: float, yaw: float, vx: float, vy: float, length: float, width: float, piece: Float, horizon_s: float
) -> bool:
    """Whether a box that moves straight on without turning meets a standing one within the horizon.

    At any instant two rectangles overlap unless an axis of either separates them (separating axis theorem); each axis
    stops to separate them at one instant, and starts again at one.
    """
    dx, dy = x - piece[0], y - piece[1]
    first, last = 0.0, horizon_s
    turn = yaw - piece[2]
    c, s = abs(np.cos(turn)), abs(np.sin(turn))
    for axis in range(4):
        angle = (yaw if axis >= 2 else piece[2]) + (np.pi / 2 if axis & 1 else 0.0)
        ax, ay = np.cos(angle), np.sin(angle)
        if axis == 0:
            reach = piece[3] + c * length + s * width
        elif axis == 1:
            reach = piece[4] + s * length + c * width
        elif axis == 2:
            reach = length + c * piece[3] + s * piece[4]
        else:
            reach = width + s * piece[3] + c * piece[4]
        reach /= 2
        along, speed = ax * dx + ay * dy, ax * vx + ay * vy
        if abs(speed) < 1e-12:
            if abs(along) > reach:
                return False
            continue
        t0, t1 = (-reach - along) / speed, (reach - along) / speed
        first, last = max(first, min(t0, t1)), min(last, max(t0, t1))
        if first > last:
            return False
    return True


# Episodes that matter, by `measure.objects.within`: in a polygon, near the ego's path, or soon on it.

_TOLERANCE_M = 1e-6
"""Far below any distance that matters, far above the rounding of coordinates."""


def keep_episodes_within(
    scene: Scene, truth: Tracks, episodes: Episodes, experiment: MetricsSetup
) -> tuple[Episodes, Int]:
    """The episodes that `measure.objects.within` keeps, and the indices (K,) of objects of which it keeps none.

    Raises ExperimentError where the condition needs the path of an ego and there is none.
    """
    condition = experiment.measure.objects.within
    if condition is None:
        return episodes, np.empty(0, dtype=np.int64)
    if condition.of_ego and scene.ego_ix < 0:
        raise ExperimentError(f"{scene.log}: measure.objects.within: no ego in this study, and so no path of it")
    decide = _is_within_at_onset if condition.conflict_s is None else _will_conflict
    is_kept = decide(scene, truth, episodes, experiment)
    return episodes.take(is_kept), np.setdiff1d(episodes.object_ix, episodes.object_ix[is_kept])


def describe_excluded(condition: Within) -> str:
    """Where the excluded objects are, for a note."""
    if condition.polygon_m is not None:
        return "outside the polygon at their onset"
    if condition.areas is not None:
        return f"outside {', '.join(condition.areas)} at their onset"
    if condition.lanes is not None:
        return f"outside the lanes {', '.join(condition.lanes)} at their onset"
    if condition.corridor_m is not None:
        return f"more than {condition.corridor_m:g} m beside the ego's way ahead"
    return f"never within {condition.conflict_s:g} s of the ego's way"


def _is_within_at_onset(scene: Scene, truth: Tracks, episodes: Episodes, experiment: MetricsSetup) -> Bool:
    """(M,) whether the centre is in the polygon or corridor at the onset; False in a gap of the truth."""
    condition = experiment.measure.objects.within
    assert condition is not None
    state, present = interpolate_states(
        truth, episodes.object_ix, episodes.onset_s, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s
    )  # fmt: skip
    x_m, y_m = state["x_m"], state["y_m"]
    if condition.polygon_m is not None:
        return present & are_in_area(x_m, y_m, x_m, y_m, polygon_corners(condition.polygon_m), np.inf)
    if condition.areas is not None:
        return present & are_in_areas(x_m, y_m, scene, condition.areas, experiment)
    if condition.lanes is not None:
        return present & are_in_named(x_m, y_m, scene.lanes, condition.lanes)
    assert condition.corridor_m is not None
    beside_m = _distance_to_path_m(EgoPath(scene, truth, experiment.max_gap_s), x_m, y_m, episodes)
    near: Bool = present & (beside_m <= condition.corridor_m + _TOLERANCE_M)
    return near


def _distance_to_path_m(ego: EgoPath, x_m: Float, y_m: Float, episodes: Episodes) -> Float:
    """(M,) distance (m) from places to the ego's way between the onset and the end of each episode."""
    import shapely

    ends_m = [np.interp(time_s, ego.frame_s, ego.frame_m) for time_s in (episodes.onset_s, episodes.ended_s)]
    paths = []
    for from_m, to_m in zip(*ends_m, strict=True):
        first, after = np.searchsorted(ego.path[:, 0], (from_m, to_m))
        along_m = np.concatenate([[from_m], ego.path[first:after, 0], [to_m]])
        paths.append(np.stack([np.interp(along_m, ego.path[:, 0], ego.path[:, k]) for k in (1, 2)], axis=1))
    distance_m: Float = shapely.distance([shapely.LineString(path) for path in paths], shapely.points(x_m, y_m))
    return distance_m


def _will_conflict(scene: Scene, truth: Tracks, episodes: Episodes, experiment: MetricsSetup) -> Bool:
    """(M,) whether the object, at constant velocity, would at any frame enter the corridor within `conflict_s`."""
    condition, measure = experiment.measure.objects.within, experiment.measure
    assert condition is not None
    assert condition.conflict_s is not None
    margin_m = (measure.conflict or Conflict()).margin_m
    ego = EgoPath(scene, truth, experiment.max_gap_s)
    tracks = truth.take_tracks(np.isin(truth.object_ix, episodes.object_ix))
    implied = find_conflicts(tracks, ego, Conflict(horizon_s=condition.conflict_s, margin_m=margin_m))[0]
    kept_by_pass = []
    for _, part in episodes.passes:
        episode_of = np.full(len(scene.object_ids), -1)
        episode_of[part.object_ix] = np.arange(len(part.object_ix))
        rows = np.flatnonzero(implied & (episode_of[tracks.row_object_ix] >= 0))
        episode, time_s = episode_of[tracks.row_object_ix[rows]], tracks.row_captured_s[rows]
        during = (time_s >= part.onset_s[episode] - SAME_INSTANT_S) & (time_s <= part.ended_s[episode] + SAME_INSTANT_S)
        is_kept = np.zeros(len(part.object_ix), dtype=bool)
        is_kept[episode[during]] = True
        kept_by_pass.append(is_kept)
    return episodes.join_passes(kept_by_pass)
