"""Geometry of boxes seen from above: the distance of two that move, the overlap of two, places in an area. Compiled.

Of two moving boxes the ego follows its path, the other its recorded motion. All is piecewise linear: the ego's way
between instants, its path between vertices, the other's motion between instants. A pose is (x, y, yaw), a size is
(length, width); T instants, V path vertices, R courses of the ego.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from copem_replay.core.compiled import borrowing, borrowing_kernel, callee, kernel
from copem_replay.core.tracks import Bool, Float, Int

_TOUCH_M = 1e-9
"""Boxes this near touch: positions within a few kilometres of the origin are rounded by less."""
_FINE_M = 1e-6
"""The search ends where the distance could be smaller by no more than this: far below what is known of positions."""


@nb.njit(inline="always")
def _corner_distance2(
    x: float, y: float, c: float, s: float, al: float, aw: float, bl: float, bw: float
) -> tuple[float, bool]:
    """Squared distance of a box's corners from a rectangle around the origin; whether an axis of that parts the two.

    The box lies at (x, y), turned by an angle with cosine c and sine s, and has the half sizes al and aw.
    """
    is_apart = abs(x) > bl + abs(c) * al + abs(s) * aw or abs(y) > bw + abs(s) * al + abs(c) * aw
    best = np.inf
    for u, v in ((al, aw), (al, -aw), (-al, -aw), (-al, aw)):
        dx = max(abs(x + c * u - s * v) - bl, 0.0)
        dy = max(abs(y + s * u + c * v) - bw, 0.0)
        best = min(best, dx * dx + dy * dy)
    return best, is_apart


@borrowing
def box_distance(ax: float, ay: float, ayaw: float, al: float, aw: float,
                 bx: float, by: float, byaw: float, bl: float, bw: float) -> float:  # fmt: skip
    """Horizontal distance of two boxes, m; 0 where they touch or overlap (then no axis of either separates them)."""
    ca, sa, cb, sb = np.cos(ayaw), np.sin(ayaw), np.cos(byaw), np.sin(byaw)
    c, s = ca * cb + sa * sb, sa * cb - ca * sb
    dx, dy = ax - bx, ay - by
    al, aw, bl, bw = al / 2, aw / 2, bl / 2, bw / 2
    d1, apart1 = _corner_distance2(cb * dx + sb * dy, -sb * dx + cb * dy, c, s, al, aw, bl, bw)
    d2, apart2 = _corner_distance2(-ca * dx - sa * dy, sa * dx - ca * dy, c, -s, bl, bw, al, aw)
    if not apart1 and not apart2:
        return 0.0
    return float(np.sqrt(min(d1, d2)))


@borrowing
def count_below(values: Float, value: float) -> int:
    """How many ascending numbers are below a value, for NaN all: as `np.searchsorted`, but compiled sooner."""
    first, remaining = 0, len(values)
    while remaining > 0:
        half = remaining // 2
        if values[first + half] >= value:
            remaining = half
        else:
            first, remaining = first + half + 1, remaining - half - 1
    return first


@borrowing
def pose_on_path(path: Float, s: float) -> tuple[float, float, float]:
    """Pose at arc length `s` of a path (V, 4): s, x, y, yaw by vertex. Beyond its ends it goes straight on."""
    n = len(path)
    k = min(max(count_below(path[:, 0], s) - 1, 0), n - 2)
    f = (s - path[k, 0]) / (path[k + 1, 0] - path[k, 0])
    turn = min(max(f, 0.0), 1.0)
    return (
        path[k, 1] + f * (path[k + 1, 1] - path[k, 1]),
        path[k, 2] + f * (path[k + 1, 2] - path[k, 2]),
        path[k, 3] + turn * (path[k + 1, 3] - path[k, 3]),
    )


@nb.njit(inline="always")
def _value_between(values: Float, place: float) -> float:
    """Value at a place between the instants: 2.5 is half way from instant 2 to instant 3."""
    k = int(place)
    f = place - k
    return float(values[k]) if f == 0 else float(values[k] + f * (values[k + 1] - values[k]))


class Meeting(NamedTuple):
    """The ego on one course, and the other box."""

    along: Float  # (T,) how far the ego is along its path
    path: Float  # (V, 4)
    size: Float  # (2,)
    other: Float  # (3, T) poses
    other_size: Float  # (2,)


@borrowing
def _distance_at(meeting: Meeting, place: float) -> float:
    """Box distance at a place between the instants."""
    along, path, size, other, other_size = meeting
    x, y, yaw = pose_on_path(path, _value_between(along, place))
    return float(
        box_distance(
            x, y, yaw, size[0], size[1],
            _value_between(other[0], place), _value_between(other[1], place), _value_between(other[2], place),
            other_size[0], other_size[1],
        )
    )  # fmt: skip


@borrowing
def corner_travel(path: Float, size: Float) -> float:
    """How far a corner of the ego moves per metre of its path, at most."""
    most = 1.0
    half = np.hypot(size[0], size[1]) / 2
    for v in range(len(path) - 1):
        most = max(most, 1.0 + half * abs(path[v + 1, 3] - path[v, 3]) / (path[v + 1, 0] - path[v, 0]))
    return most


@kernel
def find_smallest_distances(
    along: Float, path: Float, size: Float, other: Float, other_size: Float, near: Float, touch: Float
) -> None:
    """Smallest box distance of each course `along (R, T)` of the ego, and where the boxes first touch.

    NaN in `along` or in `other (3, T)`: not there. Out: `near (R,)`, metres, inf where they are never there together;
    `touch (R,)`, a place between the instants, inf where they never touch.
    """
    n = along.shape[1]
    most = corner_travel(path, size)
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
            best, _ = _search_interval(meeting, moved, most, first, last, best, False, scratch)
            if best <= _TOUCH_M:
                _, place = _search_interval(meeting, moved, most, first, last, _TOUCH_M, True, scratch)
                best = 0.0
            first = last + 1
        near[r], touch[r] = best, place


@borrowing
def _search_interval(
    meeting: Meeting, moved: Float, most: float, first: int, last: int, best: float, touching: bool,
    scratch: tuple[Int, Float],
) -> tuple[float, float]:  # fmt: skip
    """Smallest distance between two instants if it is below `best`; or, `touching`, the first place not above `best`.

    `moved (T,)`: how far a corner of the other has moved at most, `most` how far one of the ego per metre of its path.

    By halves, the earlier one first. Between two instants it cannot be smaller than half the sum of the distances at
    them less half of what the two have moved meanwhile; a stretch that thus cannot matter is left out.
    """
    stack, distances = scratch
    d_first, d_last = _distance_at(meeting, float(first)), _distance_at(meeting, float(last))
    if touching and d_first <= best:
        return d_first, float(first)
    best = best if touching else min(best, d_first, d_last)
    stack[0, 0], stack[0, 1], distances[0, 0], distances[0, 1] = first, last, d_first, d_last
    depth = 1
    while depth:
        depth -= 1
        a, b, da, db = stack[depth, 0], stack[depth, 1], distances[depth, 0], distances[depth, 1]
        movement = most * (meeting.along[b] - meeting.along[a]) + moved[b] - moved[a]
        if (da + db - movement) / 2 >= best + (1e-12 if touching else -_FINE_M):
            continue
        if b - a > 1:
            m = (a + b) // 2
            dm = _distance_at(meeting, float(m))
            if not touching:
                best = min(best, dm)
            stack[depth, 0], stack[depth, 1], distances[depth, 0], distances[depth, 1] = m, b, dm, db
            depth += 1
            stack[depth, 0], stack[depth, 1], distances[depth, 0], distances[depth, 1] = a, m, da, dm
            depth += 1
            continue
        # Between neighbours both move straight: the distance is convex, and so above the lines on by its values.
        dm = _distance_at(meeting, (a + b) / 2)
        if b > a and not touching:
            best = min(best, dm)
            if 2 * dm - max(da, db) < best - _FINE_M:
                best = min(best, _minimise_distance(meeting, float(a), float(b))[1])
        elif b > a:
            end, d_end = float(b), db
            if d_end > best:
                end, d_end = _minimise_distance(meeting, float(a), float(b))
            if d_end <= best:
                return d_end, _first_touch(meeting, float(a), end)
    return best, np.inf


@borrowing
def _first_touch(meeting: Meeting, clear: float, reach: float) -> float:
    """Where between two places, the second in touch, the boxes first touch: by halves."""
    for _ in range(40):
        m = (clear + reach) / 2
        if _distance_at(meeting, m) <= _TOUCH_M:
            reach = m
        else:
            clear = m
    return reach


@borrowing
def _minimise_distance(meeting: Meeting, a: float, b: float) -> tuple[float, float]:
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


# The overlap of two boxes, seen from above.

_MOST_CORNERS = 20
"""A rectangle cut by four lines has 8 corners at most. Whatever rounding does, a cut adds no more than half as many as
there were: 4, 6, 9, 13, 19."""


@callee
def rotated_iou(
    x0: float, y0: float, yaw0: float, l0: float, w0: float,
    x1: float, y1: float, yaw1: float, l1: float, w1: float,
) -> float:  # fmt: skip
    """Intersection over union of two boxes: centre, yaw in radians, length and width; in [0, 1].

    Exchanging the boxes changes no bit. 0 for boxes without an area, and where something is NaN.
    """
    area0 = l0 * w0 if l0 > 0.0 and w0 > 0.0 else 0.0
    area1 = l1 * w1 if l1 > 0.0 and w1 > 0.0 else 0.0
    dx, dy = x0 - x1, y0 - y1
    reach = (np.sqrt(l0 * l0 + w0 * w0) + np.sqrt(l1 * l1 + w1 * w1)) / 2
    if not (area0 > 0.0 and area1 > 0.0 and dx * dx + dy * dy < reach * reach):
        return 0.0
    if (l0, w0, yaw0, x0, y0) < (l1, w1, yaw1, x1, y1):  # which box is cut does not depend on their order
        overlap = _intersection_area(dx, dy, yaw0, l0, w0, yaw1, l1, w1)
    else:
        overlap = _intersection_area(-dx, -dy, yaw1, l1, w1, yaw0, l0, w0)
    overlap = min(overlap, area0, area1)
    return float(overlap / (area0 + area1 - overlap))


@callee
def _intersection_area(
    dx: float, dy: float, yaw: float, length: float, width: float, by_yaw: float, by_length: float, by_width: float
) -> float:
    """Area of a box cut by another, whose centre it is dx, dy away from: side by side, in the frame of the other.

    Source: I. E. Sutherland, G. W. Hodgman, "Reentrant polygon clipping", Commun. ACM 17 (1974) 32–42.
    """
    c, s = np.cos(yaw - by_yaw), np.sin(yaw - by_yaw)
    cos, sin = np.cos(by_yaw), np.sin(by_yaw)
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    now, cut = np.empty((_MOST_CORNERS, 2)), np.empty((_MOST_CORNERS, 2))
    count = 0
    for u, v in ((length, width), (-length, width), (-length, -width), (length, -width)):
        now[count, 0], now[count, 1] = x + (c * u - s * v) / 2, y + (s * u + c * v) / 2
        count += 1
    for axis, side, reach in ((0, 1.0, by_length), (0, -1.0, by_length), (1, 1.0, by_width), (1, -1.0, by_width)):
        count = _clip_polygon(now, count, axis, side, reach / 2, cut)
        now, cut = cut, now
    double_area = 0.0
    for k in range(2, count):  # triangles at the first corner
        ax, ay = now[k - 1, 0] - now[0, 0], now[k - 1, 1] - now[0, 1]
        bx, by = now[k, 0] - now[0, 0], now[k, 1] - now[0, 1]
        double_area += ax * by - ay * bx
    return float(max(double_area / 2, 0.0))


@callee
def _clip_polygon(polygon: Float, count: int, axis: int, side: float, reach: float, out: Float) -> int:
    """What of a polygon lies where side · coordinate ≤ reach; how many corners that has."""
    corners = 0
    for k in range(count):
        m = k + 1 if k + 1 < count else 0
        depth, next_depth = reach - side * polygon[k, axis], reach - side * polygon[m, axis]
        if depth >= 0.0:
            out[corners] = polygon[k]
            corners += 1
        if (depth >= 0.0) != (next_depth >= 0.0):
            f = depth / (depth - next_depth)
            out[corners, axis] = side * reach
            out[corners, 1 - axis] = polygon[k, 1 - axis] + f * (polygon[m, 1 - axis] - polygon[k, 1 - axis])
            corners += 1
    return corners


# Areas on the ground, their edges included.

_EDGE_M = 1e-6
"""A place this near an edge is on it: rounding is less, and no place is known so well."""


@borrowing
def is_in_polygon(x_m: float, y_m: float, corners_m: Float) -> bool:
    """Whether a place is in a polygon (V, 2), its edge included: by the parity of the edges east of it."""
    inside = False
    for k in range(len(corners_m)):
        from_x, from_y = corners_m[k - 1]
        to_x, to_y = corners_m[k]
        way_x, way_y = to_x - from_x, to_y - from_y
        square = way_x * way_x + way_y * way_y
        along = ((x_m - from_x) * way_x + (y_m - from_y) * way_y) / square if square > 0 else 0.0
        along = min(max(along, 0.0), 1.0)
        if np.hypot(x_m - from_x - along * way_x, y_m - from_y - along * way_y) <= _EDGE_M:
            return True
        if (from_y > y_m) != (to_y > y_m) and x_m < from_x + (y_m - from_y) / way_y * way_x:
            inside = not inside
    return inside


@borrowing_kernel
def is_in_area(x_m: float, y_m: float, from_x_m: float, from_y_m: float, corners_m: Float, range_m: float) -> bool:
    """Whether a place is within a range of another one, and in a polygon; `corners_m` without corners: anywhere."""
    if np.hypot(x_m - from_x_m, y_m - from_y_m) > range_m + _EDGE_M:
        return False
    return len(corners_m) == 0 or is_in_polygon(x_m, y_m, corners_m)


def are_in_area(x_m: Float, y_m: Float, from_x_m: Float, from_y_m: Float, corners_m: Float, range_m: float) -> Bool:
    """(K,) whether each place is within the range of its own `from` place, and in the polygon (see `is_in_area`)."""
    inside = (is_in_area(*place, corners_m, range_m) for place in zip(x_m, y_m, from_x_m, from_y_m, strict=True))
    return np.fromiter(inside, dtype=bool, count=len(x_m))


def polygon_corners(polygon_m: tuple[tuple[float, float], ...] | None) -> Float:
    """(V, 2) the corners of a polygon, none: anywhere."""
    return np.array(polygon_m or (), dtype=np.float64).reshape(-1, 2)
