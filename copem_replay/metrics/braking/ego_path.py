"""The ego's course: the path it takes through the log, and how it drives along it.

The path is what matters of its recorded places: those at least `STRIDE_M` apart, so that what a standing vehicle's
place jitters by is no way, and it turns back only where the ego goes back by `REVERSAL_M`. It goes straight on ahead
where the recording ends (backwards where the ego was in reverse).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from copem_replay.core.interpolation import states_at
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Scene, Tracks

STRIDE_M = 0.1
"""Places of the path are at least this far apart (chosen: more than a standing vehicle jitters)."""
REVERSAL_M = 2.0
"""Going back by this much is reversing, by less the noise of a place (chosen)."""
_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class Course:
    """The ego that does not brake, at T instants.

    `along_m (T,)` its way from the first vertex of the path, NaN where it is not in the log; `bound_m (T,)` the same
    with gaps closed, going on past its last frame, `until_s`, as fast as there: farther than that it never is;
    `speed_mps (T,)`.
    """

    along_m: Float
    bound_m: Float
    speed_mps: Float
    until_s: float


class EgoPath:
    """The ego's path through the log, and how it drives along it.

    `path (V, 4)`: arc length, x, y, yaw; `size_m (2,)`. `frame_s`, `frame_m`, `frame_mps (F,)`: when, how far along the
    path and how fast it is at its own frames.
    """

    def __init__(self, scene: Scene, truth: Tracks, max_gap_s: float) -> None:
        self._truth, self._scene, self._max_gap_s = truth, scene, max_gap_s
        rows = np.flatnonzero(truth.row_object_ix == scene.ego_ix)
        x, y, yaw = truth.x_m[0, rows], truth.y_m[0, rows], np.unwrap(truth.yaw_rad[0, rows])
        self.frame_s = truth.row_captured_s[rows]
        self.frame_mps = np.hypot(truth.vx_mps[0, rows], truth.vy_mps[0, rows])
        vertex, backwards = _vertices(x, y, yaw, STRIDE_M, REVERSAL_M)
        places = np.stack([_arc(x[vertex], y[vertex]), x[vertex], y[vertex], yaw[vertex]], axis=1)
        self.path = _with_end(places, backwards)
        self.frame_m = _along(x, y, vertex, self.path)
        self.size_m = np.array([truth.length_m[0, rows[0]], truth.width_m[0, rows[0]]])

    def course(self, time_s: Float, constant_from_s: float | None = None) -> Course:
        """How it drives at instants (T,): as recorded, or with constant speed from an instant on."""
        if constant_from_s is not None:
            start_m, speed = (np.interp(constant_from_s, self.frame_s, v) for v in (self.frame_m, self.frame_mps))
            along = start_m + speed * (time_s - constant_from_s)
            return Course(along, along, np.full(len(time_s), speed), np.inf)
        last_s = float(self.frame_s[-1])
        bound = np.interp(time_s, self.frame_s, self.frame_m)
        bound += self.frame_mps[-1] * np.maximum(time_s - last_s, 0.0)
        _, present = self.states(self._scene.ego_ix, time_s)
        speed = np.interp(time_s, self.frame_s, self.frame_mps)
        return Course(np.where(present, bound, np.nan), bound, speed, last_s + _TOLERANCE_S)

    def states(self, object_ix: int, time_s: Float) -> tuple[dict[str, Float], Bool]:
        """States of any object at instants (T,), and whether it is in the log then."""
        which = np.full(len(time_s), object_ix)
        return states_at(self._truth, which, time_s, t0_ns=self._scene.t0_ns, max_gap_s=self._max_gap_s)


def _arc(x_m: Float, y_m: Float) -> Float:
    """(V,) way from the first of some places to each."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))])


def _with_end(path: Float, backwards: bool) -> Float:
    """The path (V, 4) and one more vertex a metre on: ahead, or behind where the ego was in reverse."""
    _, x, y, yaw = path[-1]
    ahead = np.array([np.cos(yaw), np.sin(yaw)]) * (-1 if backwards else 1)
    return np.vstack([path, [path[-1, 0] + 1.0, x + ahead[0], y + ahead[1], yaw]])


def _along(x_m: Float, y_m: Float, vertex: Int, path: Float) -> Float:
    """(F,) how far along the path each place is: on the piece from the vertex before it, never going back."""
    piece = np.searchsorted(vertex, np.arange(len(x_m)), side="right") - 1
    way = np.diff(path[:, :3], axis=0)[piece]
    on = ((x_m - path[piece, 1]) * way[:, 1] + (y_m - path[piece, 2]) * way[:, 2]) / way[:, 0]
    result: Float = np.maximum.accumulate(path[piece, 0] + np.clip(on, 0.0, way[:, 0]))
    return result


@nb.njit(cache=True)
def _vertices(x_m: Float, y_m: Float, yaw_rad: Float, stride_m: float, reversal_m: float) -> tuple[Int, bool]:
    """Indices (V,) of the places that make the path, and whether it ends in reverse.

    The first one, and each that is a stride away from the one before in the direction the ego goes, or a reversal away
    against it; then it goes that way.
    """
    kept = np.empty(len(x_m), dtype=np.int64)
    kept[0] = 0
    n, backwards = 1, False
    for k in range(1, len(x_m)):
        dx, dy = x_m[k] - x_m[kept[n - 1]], y_m[k] - y_m[kept[n - 1]]
        against = (dx * np.cos(yaw_rad[k]) + dy * np.sin(yaw_rad[k]) < 0) != backwards
        if np.hypot(dx, dy) >= (reversal_m if against else stride_m):
            kept[n] = k
            n += 1
            backwards = backwards != against
    return kept[:n].copy(), backwards
