"""Where the ego must not be, instant by instant, and how hard it has to brake not to be there. Compiled.

Letters as in core/box_distance.py: T instants, V path vertices, R courses of the ego.
"""

from __future__ import annotations

import numpy as np

from copem_replay.core.box_distance import box_distance, pose_on, turning
from copem_replay.core.kernels import borrowing
from copem_replay.core.tracks import Float

_STRIDE_M = 1e-3
"""The shortest step along a path in search of a contact (chosen: a graze shorter than this may be missed)."""
_INSIDE_M = 0.1
"""The step along a path in search of where it is clear again (chosen: a gap shorter than this may be missed)."""


@borrowing
def blocked(
    path: Float, size: Float, other: Float, other_size: Float, margin_m: float, from_m: float, to_m: Float, out: Float
) -> None:
    """Which stretches of its path the other blocks: where the ego is within the margin of it, `out (B, 2, T)`.

    The first B of them from `from_m` on that begin before `to_m (T,)`, from and to; inf and inf where there are fewer.
    The ego advances by as much as surely stays clear until nothing is left of it (sphere tracing), then step by step
    until it is clear again.
    """
    most = turning(path, size)
    out[:] = np.inf
    for k in range(other.shape[1]):
        if np.isnan(other[0, k]):
            continue
        clear, s, found = from_m, from_m, 0
        while s <= to_m[k] and found < len(out):
            free = _free(path, size, other[:, k], other_size, margin_m, s)
            if free > 0.0:
                clear = s
                s += max(free / most, _STRIDE_M)
                continue
            out[found, 0, k] = _border(path, size, other[:, k], other_size, margin_m, clear, s)
            while free <= 0.0:
                within, s = s, s + _INSIDE_M
                free = _free(path, size, other[:, k], other_size, margin_m, s)
            out[found, 1, k] = _border(path, size, other[:, k], other_size, margin_m, s, within)
            clear, found = s, found + 1


@borrowing
def _free(path: Float, size: Float, other: Float, other_size: Float, margin_m: float, s: float) -> float:
    """What is left between the ego at a place of its path and the other, beyond the margin."""
    x, y, yaw = pose_on(path, s)
    return float(
        box_distance(x, y, yaw, size[0], size[1], other[0], other[1], other[2], other_size[0], other_size[1]) - margin_m
    )


@borrowing
def _border(
    path: Float, size: Float, other: Float, other_size: Float, margin_m: float, clear: float, within: float
) -> float:
    """Where between two places of the path, one clear and one within the margin, it begins or ends: by halves."""
    for _ in range(40):
        s = (clear + within) / 2
        if _free(path, size, other, other_size, margin_m, s) > 0.0:
            clear = s
        else:
            within = s
    return within


@borrowing
def required(time_s: Float, stretch_m: Float, begin_s: Float, begin_m: Float, speed_mps: Float, out: Float) -> None:
    """Smallest constant deceleration (R,) from `begin_s (R,)` on that is never in `stretch_m (B, 2, T)`; inf: none.

    At `begin_s` the ego is at `begin_m (R,)` with `speed_mps (R,)`. Each instant rules out the decelerations between
    the one that brings the ego to the end of a stretch by then and the one that brings it to its beginning.
    """
    for r in range(len(out)):
        first = int(np.searchsorted(time_s, begin_s[r]))
        a, ruled_out = 0.0, True
        while ruled_out and a < np.inf:
            ruled_out = False
            for k in range(first, len(time_s)):
                t = time_s[k] - begin_s[r]
                for b in range(len(stretch_m)):
                    if stretch_m[b, 0, k] == np.inf:
                        break
                    most = _to_be_at(stretch_m[b, 0, k] - begin_m[r], t, speed_mps[r])
                    if a < most and a >= _to_be_at(stretch_m[b, 1, k] - begin_m[r], t, speed_mps[r]):
                        a, ruled_out = most, True
        out[r] = a


@borrowing
def _to_be_at(way_m: float, after_s: float, speed_mps: float) -> float:
    """Constant deceleration that has gone `way_m` after a time, at most: inf where nothing is that short.

    None where v·t is not farther; 2 (v·t − g) / t² where it still moves then; v² / 2 g where it has stopped before.
    """
    if way_m <= 0:
        return np.inf
    if speed_mps * after_s <= way_m:
        return 0.0
    if speed_mps * after_s / 2 <= way_m:
        return 2 * (speed_mps * after_s - way_m) / (after_s * after_s)
    return speed_mps * speed_mps / (2 * way_m)
