"""The first fused lists that imply a collision (the paper's detection of the potential collision).

A fused list implies one when the object, keeping its perceived velocity from its perceived place, will within the
horizon be in the ego's corridor: what the ego, at its present speed, will sweep of its own path, and a margin around
it. Paths are compared, arrival times are not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numba as nb
import numpy as np

from copem_replay.core.box_distance import pose_on
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Tracks
from copem_replay.metrics.braking.ego_path import EgoPath
from copem_replay.metrics.config import Confirm, Conflict

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9
_PIECE_M = 2.0
"""Length of the straight pieces a corridor is made of (chosen)."""
_PIECES = 500
"""More pieces than this are not made: they are longer then (chosen: a kilometre)."""


class ConflictDetector:
    """When the receiver first has a list (`hits` of its last `of` lists) that implies a collision, episode by episode.

    As with detections, a list counts when something at or after the onset contributed to what it says of the object.
    Time chunks of a log are added one after the other.
    """

    def __init__(self, ego: EgoPath, found: Episodes, wanted: Conflict, *, confirm: Confirm, count_earlier: bool):
        self._ego, self._found, self._wanted, self._confirm = ego, found, wanted, confirm
        never = np.full(len(found.object_ix), -np.inf)
        self._not_before_s = never if count_earlier else found.onset_s - _TOLERANCE_S
        self._lists, self._runs, self._issue_s = 0, 1, [np.empty(0)]
        self._held: dict[tuple[int, int], list[Int]] = {}  # by run and episode: lists that imply one

    def add(self, fused_tracks: FusedTracks, first_run: int = 0) -> None:
        """Take in the fused tracks of runs (S,), `first_run` and on; several of one time chunk may be."""
        fused = fused_tracks.fused
        self._runs = max(self._runs, first_run + len(fused.valid))
        issue_s = fused.common_arrives_s
        implied = implied_by(fused, self._ego, self._wanted)
        newest_s = fused_tracks.captured_s
        track_of = {int(o): k for k, o in enumerate(fused.object_ix)}
        for m, object_ix in enumerate(self._found.object_ix.tolist()):
            if object_ix not in track_of:
                continue
            track = track_of[object_ix]
            rows = slice(int(fused.start[track]), int(fused.start[track + 1]))
            counts = implied[:, rows] & (newest_s[:, rows] >= self._not_before_s[m])
            counts &= issue_s[fused.frame_ix[rows]] <= self._found.ended_s[m] + _TOLERANCE_S
            for s in np.flatnonzero(counts.any(axis=1)).tolist():
                held = self._lists + fused.frame_ix[rows][counts[s]]
                self._held.setdefault((first_run + s, m), []).append(held)

    def next(self, issue_s: Float) -> None:
        """Done with a time chunk, whose lists were available at `issue_s (K,)`."""
        self._issue_s.append(issue_s)
        self._lists += len(issue_s)

    def result(self) -> Float:
        """(S, M) when that was, in one run where one stands for all; NaN: never."""
        issue_s = np.concatenate(self._issue_s)
        first_s = np.full((self._runs, len(self._found.object_ix)), np.nan)
        hits, of = self._confirm.hits, self._confirm.of
        for (s, m), parts in self._held.items():
            held = np.concatenate(parts)
            # So many lists before it hold it too, that list among them, within the last `of`.
            enough = np.flatnonzero(held[hits - 1 :] - held[: max(len(held) - hits + 1, 0)] < of)
            if len(enough):
                first_s[s, m] = issue_s[held[enough[0] + hits - 1]]
        return first_s


def implied_by(tracks: Tracks, ego: EgoPath, wanted: Conflict) -> Bool:
    """(S, P) which states of tracks imply a collision, at the instants their lists are available."""
    pieces, bounds = corridors(ego, tracks.common_arrives_s, wanted)
    implied = np.zeros(tracks.valid.shape, dtype=np.bool_)
    columns = (tracks.x_m, tracks.y_m, tracks.yaw_rad, tracks.vx_mps, tracks.vy_mps, tracks.length_m, tracks.width_m)
    _implied(tracks.valid, _Boxes(*columns), tracks.frame_ix, pieces, bounds, wanted.horizon_s, implied)
    return implied


def corridors(ego: EgoPath, now_s: Float, wanted: Conflict) -> tuple[Float, Int]:
    """Rectangles (C, 5) — x, y, yaw, length, width — that cover the ego's corridor at instants (K,), grouped (K + 1,).

    None where the ego is not in the log.
    """
    course = ego.course(now_s)
    ahead_m = np.where(np.isnan(course.along_m), np.nan, course.speed_mps * wanted.horizon_s)
    pieces_of = np.clip(np.ceil(np.nan_to_num(ahead_m) / _PIECE_M), 1, _PIECES)
    count = np.where(np.isnan(ahead_m), 0, pieces_of).astype(np.int64)
    bounds = np.concatenate([[0], np.cumsum(count)])
    pieces = np.empty((bounds[-1], 5))
    size = ego.size_m + 2 * wanted.margin_m
    _cover(ego.path, course.along_m, np.nan_to_num(ahead_m), bounds, size, pieces)
    return pieces, bounds


@nb.njit(cache=True, nogil=True)
def _cover(path: Float, along: Float, ahead: Float, bounds: Int, size: Float, pieces: Float) -> None:
    """Each piece lies as the ego does halfway along it, and reaches as far as the path does in between."""
    for k in range(len(along)):
        n = bounds[k + 1] - bounds[k]
        for j in range(n):
            from_m, to_m = along[k] + ahead[k] * j / n, along[k] + ahead[k] * (j + 1) / n
            x, y, yaw = pose_on(path, (from_m + to_m) / 2)
            c, s = np.cos(yaw), np.sin(yaw)
            low, high, right, left = 0.0, 0.0, 0.0, 0.0
            first = np.searchsorted(path[:, 0], from_m)
            last = np.searchsorted(path[:, 0], to_m)
            for v in range(first - 1, last + 1):
                at_m = from_m if v < first else to_m if v == last else path[v, 0]
                px, py, _ = pose_on(path, at_m)
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


@nb.njit(cache=True, nogil=True)
def _implied(
    valid: Bool, boxes: _Boxes, frame_ix: Int, pieces: Float, bounds: Int, horizon_s: float, out: Bool
) -> None:
    x, y, yaw, vx, vy, length, width = boxes
    for s in range(valid.shape[0]):
        for p in range(valid.shape[1]):
            if not valid[s, p]:
                continue
            for c in range(bounds[frame_ix[p]], bounds[frame_ix[p] + 1]):
                if _will_be_in(
                    x[s, p], y[s, p], yaw[s, p], vx[s, p], vy[s, p], length[s, p], width[s, p], pieces[c], horizon_s
                ):
                    out[s, p] = True
                    break


@nb.njit(cache=True)
def _will_be_in(
    x: float, y: float, yaw: float, vx: float, vy: float, length: float, width: float, piece: Float, horizon_s: float
) -> bool:
    """Whether a box that moves on straight without turning meets a standing one within the horizon.

    At any instant two rectangles overlap unless an axis of either separates them, and each axis stops and starts to do
    so at one instant each.
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
        apart, speed = ax * dx + ay * dy, ax * vx + ay * vy
        if abs(speed) < 1e-12:
            if abs(apart) > reach:
                return False
            continue
        t0, t1 = (-reach - apart) / speed, (reach - apart) / speed
        first, last = max(first, min(t0, t1)), min(last, max(t0, t1))
        if first > last:
            return False
    return True
