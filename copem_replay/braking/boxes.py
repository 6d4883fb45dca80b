"""How near do two boxes come to each other? Compiled: the ego along its path, the other along its recorded motion.

All is piecewise linear: the ego's way between instants, its path between vertices, the other's motion between instants.
A pose is (x, y, yaw), a size is (length, width); T instants, V path vertices, R courses of the ego.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.tracks import Float

_TOUCH_M = 1e-9
"""Boxes this near touch (chosen: rounding of positions within a few kilometres of the origin)."""
_STRIDE_M = 1e-3
"""The shortest step along a path in search of a contact (chosen: a graze shorter than this may be missed)."""


@nb.njit(cache=True, inline="always")
def _corners_to(ax: float, ay: float, ayaw: float, al: float, aw: float,
                bx: float, by: float, byaw: float, bl: float, bw: float) -> tuple[float, bool]:  # fmt: skip
    """Squared distance from the corners of a to the rectangle b, and whether an axis of b separates the two."""
    cb, sb = np.cos(byaw), np.sin(byaw)
    x, y = cb * (ax - bx) + sb * (ay - by), -sb * (ax - bx) + cb * (ay - by)
    c, s = np.cos(ayaw - byaw), np.sin(ayaw - byaw)
    hl, hw = bl / 2, bw / 2
    reach_x = abs(c) * al / 2 + abs(s) * aw / 2
    reach_y = abs(s) * al / 2 + abs(c) * aw / 2
    apart = abs(x) > hl + reach_x or abs(y) > hw + reach_y
    best = np.inf
    for k in range(4):
        u = al / 2 if k & 1 else -al / 2
        v = aw / 2 if k & 2 else -aw / 2
        dx = max(abs(x + c * u - s * v) - hl, 0.0)
        dy = max(abs(y + s * u + c * v) - hw, 0.0)
        best = min(best, dx * dx + dy * dy)
    return best, apart


@nb.njit(cache=True)
def box_distance(ax: float, ay: float, ayaw: float, al: float, aw: float,
                 bx: float, by: float, byaw: float, bl: float, bw: float) -> float:  # fmt: skip
    """Horizontal distance of two boxes, m; 0 where they touch or overlap (then no axis of either separates them)."""
    d1, apart1 = _corners_to(ax, ay, ayaw, al, aw, bx, by, byaw, bl, bw)
    d2, apart2 = _corners_to(bx, by, byaw, bl, bw, ax, ay, ayaw, al, aw)
    if not apart1 and not apart2:
        return 0.0
    return float(np.sqrt(min(d1, d2)))


@nb.njit(cache=True)
def pose_on(path: Float, s: float) -> tuple[float, float, float]:
    """Pose at arc length `s` of a path (V, 4): s, x, y, yaw by vertex. Beyond its ends it goes straight on."""
    n = len(path)
    if n == 1:
        return path[0, 1], path[0, 2], path[0, 3]
    k = min(max(int(np.searchsorted(path[:, 0], s)) - 1, 0), n - 2)
    f = (s - path[k, 0]) / (path[k + 1, 0] - path[k, 0])
    turn = min(max(f, 0.0), 1.0)
    return (
        path[k, 1] + f * (path[k + 1, 1] - path[k, 1]),
        path[k, 2] + f * (path[k + 1, 2] - path[k, 2]),
        path[k, 3] + turn * (path[k + 1, 3] - path[k, 3]),
    )


@nb.njit(cache=True, inline="always")
def _between(values: Float, at: float) -> float:
    """Value at a place between the instants, counted in them: 2.5 is half way from 2 to 3."""
    k = min(int(at), len(values) - 2) if len(values) > 1 else 0
    f = at - k
    return float(values[k]) if f == 0 else float(values[k] + f * (values[k + 1] - values[k]))


@nb.njit(cache=True)
def _distance_at(along: Float, path: Float, size: Float, other: Float, other_size: Float, at: float) -> float:
    """Box distance at a place between the instants; `other (3, T)`."""
    x, y, yaw = pose_on(path, _between(along, at))
    return float(
        box_distance(
            x, y, yaw, size[0], size[1],
            _between(other[0], at), _between(other[1], at), _between(other[2], at), other_size[0], other_size[1],
        )
    )  # fmt: skip


@nb.njit(cache=True, nogil=True)
def nearest(along: Float, path: Float, size: Float, other: Float, other_size: Float, near: Float, touch: Float) -> None:
    """Smallest box distance of each course `along (R, T)` of the ego, and where the boxes first touch.

    NaN in `along` or in `other (3, T)`: not there. Out: `near (R,)`, metres, inf where they are never there together;
    `touch (R,)`, a place between the instants, inf where they never touch.
    """
    radii = np.hypot(size[0], size[1]) / 2 + np.hypot(other_size[0], other_size[1]) / 2
    n = along.shape[1]
    d = np.empty(n)  # distance at each instant, or something below it where it cannot be the smallest
    for r in range(len(along)):
        best, touches = np.inf, np.inf
        last_x = last_y = np.nan
        step = 0.0  # how far the two moved against each other since the instant before
        for k in range(n):
            if np.isnan(along[r, k]) or np.isnan(other[0, k]):
                d[k] = np.inf
                last_x = last_y = np.nan
                continue
            x, y, yaw = pose_on(path, along[r, k])
            dx, dy = x - other[0, k], y - other[1, k]
            step = 0.0 if np.isnan(last_x) else np.hypot(dx - last_x, dy - last_y)
            last_x, last_y = dx, dy
            d[k] = np.hypot(dx, dy) - radii
            if d[k] < best + step:
                d[k] = box_distance(
                    x, y, yaw, size[0], size[1], other[0, k], other[1, k], other[2, k], other_size[0], other_size[1]
                )
            if d[k] <= _TOUCH_M:
                touches = k if k == 0 or d[k - 1] == np.inf else _first_touch(along[r], path, size, other, other_size, k)
                best = 0.0
                break
            best = min(best, d[k])
            if k >= 2 and d[k - 1] <= d[k] and d[k - 1] <= d[k - 2] and d[k - 1] - 2 * step < best:
                place, lowest = _lowest(along[r], path, size, other, other_size, k - 2.0, float(k))
                if lowest <= _TOUCH_M:
                    touches, best = place, 0.0
                    break
                best = min(best, lowest)
        near[r], touch[r] = best, touches


@nb.njit(cache=True)
def _first_touch(along: Float, path: Float, size: Float, other: Float, other_size: Float, k: int) -> float:
    """Where between the instants k − 1 and k, which is in touch, the boxes first touch: by halves."""
    a, b = k - 1.0, float(k)
    for _ in range(40):
        m = (a + b) / 2
        if _distance_at(along, path, size, other, other_size, m) <= _TOUCH_M:
            b = m
        else:
            a = m
    return b


@nb.njit(cache=True)
def _lowest(
    along: Float, path: Float, size: Float, other: Float, other_size: Float, a: float, b: float
) -> tuple[float, float]:
    """Place and value of the smallest distance between two places, which has one valley there: by golden sections."""
    g = (np.sqrt(5.0) - 1) / 2
    u, v = b - g * (b - a), a + g * (b - a)
    du = _distance_at(along, path, size, other, other_size, u)
    dv = _distance_at(along, path, size, other, other_size, v)
    for _ in range(30):
        if du <= dv:
            b, v, dv = v, u, du
            u = b - g * (b - a)
            du = _distance_at(along, path, size, other, other_size, u)
        else:
            a, u, du = u, v, dv
            v = a + g * (b - a)
            dv = _distance_at(along, path, size, other, other_size, v)
    return (u, du) if du <= dv else (v, dv)


@nb.njit(cache=True, nogil=True)
def reach(
    path: Float, size: Float, other: Float, other_size: Float, margin_m: float, from_m: float, to_m: Float, out: Float
) -> None:
    """How far along its path the ego can go, instant by instant, before it is within the margin of the other: (T,).

    From `from_m` on, at most to `to_m (T,)`; inf where it is never within the margin up to there. The ego advances by
    as much as surely stays clear until nothing is left of it (sphere tracing).
    """
    half = np.hypot(size[0], size[1]) / 2
    turning = 1.0  # metres a corner moves per metre of way, at most
    for v in range(len(path) - 1):
        turning = max(turning, 1.0 + half * abs(path[v + 1, 3] - path[v, 3]) / (path[v + 1, 0] - path[v, 0]))
    for k in range(other.shape[1]):
        out[k] = np.inf
        if np.isnan(other[0, k]):
            continue
        clear, s = from_m, from_m
        while s <= to_m[k]:
            x, y, yaw = pose_on(path, s)
            free = (
                box_distance(
                    x, y, yaw, size[0], size[1], other[0, k], other[1, k], other[2, k], other_size[0], other_size[1]
                )
                - margin_m
            )
            if free <= 0.0:
                out[k] = _last_clear(path, size, other[:, k], other_size, margin_m, clear, s)
                break
            if len(path) == 1:  # it stands
                break
            clear = s
            s += max(free / turning, _STRIDE_M)


@nb.njit(cache=True)
def _last_clear(
    path: Float, size: Float, other: Float, other_size: Float, margin_m: float, clear: float, within: float
) -> float:
    """Where between two places of the path, the second within the margin, the ego comes within it: by halves."""
    for _ in range(40):
        s = (clear + within) / 2
        x, y, yaw = pose_on(path, s)
        if box_distance(x, y, yaw, size[0], size[1], other[0], other[1], other[2], other_size[0], other_size[1]) > margin_m:
            clear = s
        else:
            within = s
    return within


@nb.njit(cache=True, nogil=True)
def required(time_s: Float, reach_m: Float, begin_s: Float, begin_m: Float, speed_mps: Float, out: Float) -> None:
    """Smallest constant deceleration (R,) that stays short of `reach_m (T,)` from `begin_s (R,)` on; inf: none does.

    At `begin_s` the ego is at `begin_m (R,)` with `speed_mps (R,)`. To be no farther than g after t: none where v·t ≤ g;
    2 (v·t − g) / t² where it then still moves; v² / 2 g where it has to stop before.
    """
    for r in range(len(out)):
        a = 0.0
        v = speed_mps[r]
        for k in range(int(np.searchsorted(time_s, begin_s[r])), len(time_s)):
            t, g = time_s[k] - begin_s[r], reach_m[k] - begin_m[r]
            if v * t <= g and g > 0:
                continue
            if g <= 0:
                a = np.inf
                break
            a = max(a, 2 * (v * t - g) / (t * t) if v * t / 2 <= g else v * v / (2 * g))
        out[r] = a
