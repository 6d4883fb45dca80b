"""The smallest distance of two moving boxes. Compiled: the ego along its path, the other along its recorded motion.

All is piecewise linear: the ego's way between instants, its path between vertices, the other's motion between instants.
A pose is (x, y, yaw), a size is (length, width); T instants, V path vertices, R courses of the ego.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from copem_replay.core.kernels import borrowing
from copem_replay.core.tracks import Float, Int

_TOUCH_M = 1e-9
"""Boxes this near touch (chosen: rounding of positions within a few kilometres of the origin)."""
_FINE_M = 1e-6
"""A distance that could be smaller by no more than this is not looked into (chosen)."""


@nb.njit(cache=True, inline="always")
def _corners_to(
    x: float, y: float, c: float, s: float, al: float, aw: float, bl: float, bw: float
) -> tuple[float, bool]:
    """Squared distance of a box's corners from a rectangle around the origin; whether an axis of that parts the two.

    The box lies at (x, y), turned by an angle with cosine c and sine s, and has the half sizes al and aw.
    """
    apart = abs(x) > bl + abs(c) * al + abs(s) * aw or abs(y) > bw + abs(s) * al + abs(c) * aw
    best = np.inf
    for u, v in ((al, aw), (al, -aw), (-al, -aw), (-al, aw)):
        dx = max(abs(x + c * u - s * v) - bl, 0.0)
        dy = max(abs(y + s * u + c * v) - bw, 0.0)
        best = min(best, dx * dx + dy * dy)
    return best, apart


@borrowing
def box_distance(ax: float, ay: float, ayaw: float, al: float, aw: float,
                 bx: float, by: float, byaw: float, bl: float, bw: float) -> float:  # fmt: skip
    """Horizontal distance of two boxes, m; 0 where they touch or overlap (then no axis of either separates them)."""
    ca, sa, cb, sb = np.cos(ayaw), np.sin(ayaw), np.cos(byaw), np.sin(byaw)
    c, s = ca * cb + sa * sb, sa * cb - ca * sb
    dx, dy = ax - bx, ay - by
    al, aw, bl, bw = al / 2, aw / 2, bl / 2, bw / 2
    d1, apart1 = _corners_to(cb * dx + sb * dy, -sb * dx + cb * dy, c, s, al, aw, bl, bw)
    d2, apart2 = _corners_to(-ca * dx - sa * dy, sa * dx - ca * dy, c, -s, bl, bw, al, aw)
    if not apart1 and not apart2:
        return 0.0
    return float(np.sqrt(min(d1, d2)))


@borrowing
def pose_on(path: Float, s: float) -> tuple[float, float, float]:
    """Pose at arc length `s` of a path (V, 4): s, x, y, yaw by vertex. Beyond its ends it goes straight on."""
    n = len(path)
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
    k = int(at)
    f = at - k
    return float(values[k]) if f == 0 else float(values[k] + f * (values[k + 1] - values[k]))


class Meeting(NamedTuple):
    """The ego on one course, and the other."""

    along: Float  # (T,) how far the ego is along its path
    path: Float  # (V, 4)
    size: Float  # (2,)
    other: Float  # (3, T) poses
    other_size: Float  # (2,)


@borrowing
def _distance_at(meeting: Meeting, at: float) -> float:
    """Box distance at a place between the instants."""
    along, path, size, other, other_size = meeting
    x, y, yaw = pose_on(path, _between(along, at))
    return float(
        box_distance(
            x, y, yaw, size[0], size[1],
            _between(other[0], at), _between(other[1], at), _between(other[2], at), other_size[0], other_size[1],
        )
    )  # fmt: skip


@borrowing
def turning(path: Float, size: Float) -> float:
    """How far a corner of the ego moves per metre of its path, at most."""
    most = 1.0
    half = np.hypot(size[0], size[1]) / 2
    for v in range(len(path) - 1):
        most = max(most, 1.0 + half * abs(path[v + 1, 3] - path[v, 3]) / (path[v + 1, 0] - path[v, 0]))
    return most


@nb.njit(cache=True, nogil=True)
def nearest(along: Float, path: Float, size: Float, other: Float, other_size: Float, near: Float, touch: Float) -> None:
    """Smallest box distance of each course `along (R, T)` of the ego, and where the boxes first touch.

    NaN in `along` or in `other (3, T)`: not there. Out: `near (R,)`, metres, inf where they are never there together;
    `touch (R,)`, a place between the instants, inf where they never touch.
    """
    n = along.shape[1]
    most = turning(path, size)
    half = np.hypot(other_size[0], other_size[1]) / 2
    moved = np.zeros(n)  # how far a corner of the other has moved since the first instant, at most
    for k in range(1, n):
        step = np.hypot(other[0, k] - other[0, k - 1], other[1, k] - other[1, k - 1])
        step += half * abs(other[2, k] - other[2, k - 1])
        moved[k] = moved[k - 1] + (0.0 if np.isnan(step) else step)
    scratch = np.empty((128, 2), np.int64), np.empty((128, 2))
    for r in range(len(along)):
        meeting = Meeting(along[r], path, size, other, other_size)
        best, place = np.inf, np.inf
        first = 0
        while first < n and place == np.inf:  # stretches at which both are there
            if np.isnan(along[r, first]) or np.isnan(other[0, first]):
                first += 1
                continue
            last = first
            while last + 1 < n and not (np.isnan(along[r, last + 1]) or np.isnan(other[0, last + 1])):
                last += 1
            best, _ = _search(meeting, moved, most, first, last, best, False, scratch)
            if best <= _TOUCH_M:
                _, place = _search(meeting, moved, most, first, last, _TOUCH_M, True, scratch)
                best = 0.0
            first = last + 1
        near[r], touch[r] = best, place


@borrowing
def _search(
    meeting: Meeting, moved: Float, most: float, first: int, last: int, best: float, touching: bool,
    scratch: tuple[Int, Float],
) -> tuple[float, float]:  # fmt: skip
    """Smallest distance between two instants if it is below `best`; or, `touching`, the first place not above `best`.

    `moved (T,)`: how far a corner of the other has moved at most, `most` how far one of the ego per metre of its path.

    By halves, the earlier one first. Between two instants it cannot be smaller than half the sum of the distances at
    them less half of what the two have moved meanwhile; a stretch that thus cannot matter is left out.
    """
    stack, known = scratch
    d_first, d_last = _distance_at(meeting, float(first)), _distance_at(meeting, float(last))
    if touching and d_first <= best:
        return d_first, float(first)
    best = best if touching else min(best, d_first, d_last)
    stack[0, 0], stack[0, 1], known[0, 0], known[0, 1] = first, last, d_first, d_last
    depth = 1
    while depth:
        depth -= 1
        a, b, da, db = stack[depth, 0], stack[depth, 1], known[depth, 0], known[depth, 1]
        movement = most * (meeting.along[b] - meeting.along[a]) + moved[b] - moved[a]
        if (da + db - movement) / 2 >= best + (1e-12 if touching else -_FINE_M):
            continue
        if b - a > 1:
            m = (a + b) // 2
            dm = _distance_at(meeting, float(m))
            if not touching:
                best = min(best, dm)
            stack[depth, 0], stack[depth, 1], known[depth, 0], known[depth, 1] = m, b, dm, db
            depth += 1
            stack[depth, 0], stack[depth, 1], known[depth, 0], known[depth, 1] = a, m, da, dm
            depth += 1
            continue
        # Between neighbours both move straight: the distance is convex, and so above the lines on by its values.
        dm = _distance_at(meeting, (a + b) / 2)
        if b > a and not touching:
            best = min(best, dm)
            if 2 * dm - max(da, db) < best - _FINE_M:
                best = min(best, _lowest(meeting, float(a), float(b))[1])
        elif b > a:
            end, d_end = float(b), db
            if d_end > best:
                end, d_end = _lowest(meeting, float(a), float(b))
            if d_end <= best:
                return d_end, _first_touch(meeting, float(a), end)
    return best, np.inf


@borrowing
def _first_touch(meeting: Meeting, clear: float, within: float) -> float:
    """Where between two places, the second in touch, the boxes first touch: by halves."""
    for _ in range(40):
        m = (clear + within) / 2
        if _distance_at(meeting, m) <= _TOUCH_M:
            within = m
        else:
            clear = m
    return within


@borrowing
def _lowest(meeting: Meeting, a: float, b: float) -> tuple[float, float]:
    """Place and value of the smallest distance between two places, which has one valley there: by golden sections."""
    g = (np.sqrt(5.0) - 1) / 2
    u, v = b - g * (b - a), a + g * (b - a)
    du = _distance_at(meeting, u)
    dv = _distance_at(meeting, v)
    for _ in range(30):
        if du <= dv:
            b, v, dv = v, u, du
            u = b - g * (b - a)
            du = _distance_at(meeting, u)
        else:
            a, u, du = u, v, dv
            v = a + g * (b - a)
            dv = _distance_at(meeting, v)
    return (u, du) if du <= dv else (v, dv)
