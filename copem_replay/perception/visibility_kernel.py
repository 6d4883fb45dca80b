"""The compiled kernel of visible shares: the integration over azimuth (perception/visibility.py defines the share).

Between the azimuths of two neighbouring corners, the inverse distance to the face a ray enters by (or leaves
by) is linear in the ray's direction u, so the slope at which each body begins and ends to cover is linear in u too.
Slopes are equal where a linear function of u vanishes: these azimuths are computed in closed form and split the
interval. What is left is a smooth ratio of two linear functions, integrated with three Gauss points.

A box that overlaps the target does not hide it. A part of an obstacle may overlap it: it hides where its face is nearer
than the target's, so the azimuths at which the two outlines cross split the interval, too.

A unit over or under a body stands within its outline: the body is there at all azimuths, from straight down (up) to the
slope of its far upper (lower) edge.

All in one file, because Numba's cache on disk only notices changes in the file of the function it compiled.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np

from copem_replay.core.compiled import kernel
from copem_replay.core.tracks import Bool, Float, Int

Work = tuple[Float, Float, Float, Float, Float, Float, Float]


class Boxes(NamedTuple):
    """The objects: rows P list by list, `bounds (F + 1,)` their starts."""

    bounds: Int
    corners_m: Float  # (P, 4, 2)
    bottom_m: Float  # (P,)
    top_m: Float
    object_ix: Int


class Statics(NamedTuple):
    """Static obstacles as convex parts: `xy_m (V, 2)` counter-clockwise, parts `start (G + 1,)`.

    `body (G,)` says which obstacle a part belongs to; `bottom_m`, `top_m (G,)` are heights in the world. What stands on
    the ground begins 20 m below it.
    """

    xy_m: Float
    start: Int
    body: Int
    bottom_m: Float
    top_m: Float


class Observers(NamedTuple):
    """Where units are at each list of a world: `place_m (U, F, 3)`, whether they are there `present (U, F)`.

    `carrier_ix (U,)`: the object that carries each, −1: none.
    """

    place_m: Float
    present: Bool
    carrier_ix: Int


class FaceColumns(NamedTuple):
    """Columns of a target's face between two azimuths `a` and `b`, (ux, uy) half way between them."""

    a: float
    b: float
    ux: float
    uy: float
    face: float  # distance along (ux, uy)
    tx: float
    ty: float
    z0: float
    z1: float


BODY = np.dtype(
    [
        ("size", np.int64), ("owner", np.int64), ("x_m", np.float64), ("y_m", np.float64), ("radius_m", np.float64),
        ("bottom_m", np.float64), ("top_m", np.float64),
        ("bearing", np.float64), ("distance_m", np.float64), ("lo", np.float64), ("hi", np.float64),
    ]
)  # fmt: skip
"""A body: how many corners it has; the obstacle it is a part of, −1: none; middle, radius and height. From one
observer: bearing and distance of the middle, and the extent in azimuth about it."""

_CORNERS = 4
"""Corners of a target."""
_OVERLAP_M = 1e-6
"""Footprints that enter each other by less than this only touch: above rounding, below any overlap of objects."""
_ON_TOP_M = 0.01
"""A unit so little above a box touches it: heights in logs are rounded."""
_SURELY = 1e-6
"""A body that surely hides all of another exceeds it by this, in rad, m and slope: far above rounding. Larger: slower,
no result changes."""
_STEEP = 1e6
"""Height (m) at the target's face of a slope that stands for straight down or straight up: beyond any target."""
_MAX_PIECES = 512
"""Azimuth pieces per view: 60 bodies in front of one target need about 250."""


@kernel
def compute_shares(
    f0: int, f1: int, boxes: Boxes, obstacles: Statics, places: Observers, flat: bool, out: Float, blocker: Int
) -> None:
    """Visible shares `out (U, P)` of the lists f0 … f1 − 1.

    `blocker (U, P)`, unless empty, becomes the row of the body that alone would hide most of each row, −1 where none
    hides any of it, −2 − k for the obstacle k.
    """
    bounds, corners, bottom, top, object_ix = boxes
    static_xy, static_start, static_body, static_bottom, static_top = obstacles
    observer_m, present, carrier_ix = places
    # Bodies of one list: the boxes first, then the static parts. Everything below is relative to the observer.
    n_static = len(static_body)
    most = n_static
    for f in range(f0, f1):
        most = max(most, bounds[f + 1] - bounds[f] + n_static)
    widest = 4
    for g in range(n_static):
        widest = max(widest, static_start[g + 1] - static_start[g])
    xy = np.empty((most, widest, 2))
    of = np.empty(most, BODY)
    hides, inside, over = np.empty(most, dtype=np.bool_), np.empty(most, dtype=np.bool_), np.empty(most, dtype=np.bool_)
    near, alone = np.empty(most, dtype=np.int64), np.empty(1, dtype=np.int64)
    work = _make_workspace(most, widest)

    for f in range(f0, f1):
        first = bounds[f]
        n = bounds[f + 1] - first
        bodies = n + n_static
        for b in range(bodies):
            if b < n:
                of[b].size, of[b].owner = 4, -1
                of[b].bottom_m, of[b].top_m = bottom[first + b], top[first + b]
                for k in range(4):
                    xy[b, k, 0], xy[b, k, 1] = corners[first + b, k, 0], corners[first + b, k, 1]
            else:
                g = b - n
                of[b].size, of[b].owner = static_start[g + 1] - static_start[g], static_body[g]
                of[b].bottom_m, of[b].top_m = static_bottom[g], static_top[g]
                for k in range(of[b].size):
                    v = static_start[g] + k
                    xy[b, k, 0], xy[b, k, 1] = static_xy[v, 0], static_xy[v, 1]
            mx = my = r2 = 0.0
            for k in range(of[b].size):
                mx += xy[b, k, 0] / of[b].size
                my += xy[b, k, 1] / of[b].size
            for k in range(of[b].size):
                r2 = max(r2, (xy[b, k, 0] - mx) ** 2 + (xy[b, k, 1] - my) ** 2)
            of[b].x_m, of[b].y_m, of[b].radius_m = mx, my, np.sqrt(r2)

        for u in range(present.shape[0]):
            if not present[u, f]:
                continue
            ox, oy, oz = observer_m[u, f, 0], observer_m[u, f, 1], observer_m[u, f, 2]
            for b in range(bodies):
                # A unit that touches a box is in it: some logs hold the mast, too. A unit that touches an obstacle is
                # in front of it: some cameras are fixed to walls, or stand on roofs.
                dx, dy = of[b].x_m - ox, of[b].y_m - oy
                of[b].bearing, of[b].distance_m = np.arctan2(dy, dx), np.sqrt(dx * dx + dy * dy)
                inside[b] = of[b].distance_m <= of[b].radius_m + _SURELY and _contains(
                    xy[b], of[b].size, ox, oy, 0.0 if b < n else _OVERLAP_M
                )
                apart = _ON_TOP_M if b < n else -_OVERLAP_M
                over[b] = not flat and inside[b] and (oz > of[b].top_m + apart or oz < of[b].bottom_m - apart)
                hides[b] = over[b] or not inside[b]
                if b < n and object_ix[first + b] == carrier_ix[u]:
                    hides[b] = False
                of[b].lo = of[b].hi = 0.0
                if over[b]:
                    of[b].lo, of[b].hi = -np.pi, np.pi
                elif hides[b]:
                    for k in range(of[b].size):
                        vx, vy = xy[b, k, 0] - ox, xy[b, k, 1] - oy
                        angle = np.arctan2(dx * vy - dy * vx, dx * vx + dy * vy)
                        of[b].lo, of[b].hi = min(of[b].lo, angle), max(of[b].hi, angle)
            for b in range(n, bodies):  # a unit inside one part of an obstacle is inside the obstacle
                if inside[b] and not over[b]:
                    for c in range(n, bodies):
                        if of[c].owner == of[b].owner:
                            hides[c] = False
            for t in range(n):
                if object_ix[first + t] == carrier_ix[u]:
                    continue
                if inside[t]:
                    out[u, first + t] = 1.0
                    continue
                count = 0
                for b in range(bodies):
                    if b == t or not hides[b] or of[b].distance_m - of[b].radius_m > of[t].distance_m + of[t].radius_m:
                        continue
                    turn = of[b].bearing - of[t].bearing
                    turn -= 2 * np.pi * np.rint(turn / (2 * np.pi))
                    if (
                        (turn + of[b].lo < of[t].hi and turn + of[b].hi > of[t].lo)
                        or turn + of[b].hi - 2 * np.pi > of[t].lo
                        or turn + of[b].lo + 2 * np.pi < of[t].hi
                    ):
                        near[count] = b
                        count += 1
                count = _drop_overlapping_boxes(t, near, count, xy, of)
                if count == 0:
                    out[u, first + t] = 1.0
                elif _hidden_by_one(t, near, count, of, oz, flat):
                    out[u, first + t] = 0.0
                else:
                    out[u, first + t] = _visible_share(t, near, count, xy, of, (ox, oy, oz), flat, work)
                if blocker.shape[0] == 0:
                    continue
                least = 1.0 - 1e-9
                for i in range(count):
                    alone[0] = near[i]
                    left = _visible_share(t, alone, 1, xy, of, (ox, oy, oz), flat, work)
                    if left < least:
                        least = left
                        blocker[u, first + t] = first + near[i] if near[i] < n else -2 - of[near[i]].owner


@kernel
def _hidden_by_one(t: int, near: Int, count: int, of: Any, oz: float, flat: bool) -> bool:
    # Whether one body surely hides all of target t, by bounds alone: what `_visible_share` gives, in far less time.
    nearest, farthest = of[t].distance_m - of[t].radius_m, of[t].distance_m + of[t].radius_m
    z0, z1 = of[t].bottom_m - oz, of[t].top_m - oz
    lowest = z0 / nearest if z0 < 0.0 else z0 / farthest  # slopes between which the target is
    highest = z1 / nearest if z1 > 0.0 else z1 / farthest
    for i in range(count):
        b = near[i]
        begins, ends = of[b].distance_m - of[b].radius_m, of[b].distance_m + of[b].radius_m
        if begins <= _SURELY or ends + _SURELY >= nearest:
            continue
        turn = of[b].bearing - of[t].bearing
        turn -= 2 * np.pi * np.rint(turn / (2 * np.pi))
        if turn + of[b].lo + _SURELY >= of[t].lo or turn + of[b].hi - _SURELY <= of[t].hi:
            continue
        if flat:
            return True
        bottom, top = of[b].bottom_m - oz, of[b].top_m - oz
        from_slope = bottom / ends if bottom < 0.0 else bottom / begins
        to_slope = top / ends if top > 0.0 else top / begins
        if from_slope + _SURELY < lowest and to_slope - _SURELY > highest:
            return True
    return False


@nb.njit(inline="always")
def _contains(polygon: Float, size: int, px: float, py: float, depth_m: float) -> bool:
    # Whether a place is inside a polygon by at least depth_m.
    for k in range(size):
        m = k + 1 if k + 1 < size else 0
        ex, ey = polygon[m, 0] - polygon[k, 0], polygon[m, 1] - polygon[k, 1]
        least = depth_m * np.sqrt(ex * ex + ey * ey) if depth_m > 0.0 else 0.0
        if ex * (py - polygon[k, 1]) - ey * (px - polygon[k, 0]) < least:
            return False
    return True


@kernel
def _are_separated(a: Float, na: int, b: Float, nb_: int) -> bool:
    # Whether some edge of a has all of b on its outer side (or touching it).
    for k in range(na):
        m = k + 1 if k + 1 < na else 0
        ex, ey = a[m, 0] - a[k, 0], a[m, 1] - a[k, 1]
        reach = np.sqrt(ex * ex + ey * ey) * _OVERLAP_M
        outside = True
        for j in range(nb_):
            if ex * (b[j, 1] - a[k, 1]) - ey * (b[j, 0] - a[k, 0]) > reach:
                outside = False
                break
        if outside:
            return True
    return False


@kernel
def _drop_overlapping_boxes(t: int, near: Int, count: int, xy: Float, of: Any) -> int:
    # A box that overlaps the target's footprint does not hide it: a rider's overlaps that of the bicycle.
    kept = 0
    for i in range(count):
        b = near[i]
        if (
            of[b].owner >= 0
            or not _may_meet(of, b, t)
            or _are_separated(xy[t], of[t].size, xy[b], of[b].size)
            or _are_separated(xy[b], of[b].size, xy[t], of[t].size)
        ):
            near[kept] = b
            kept += 1
    return kept


@nb.njit(inline="always")
def _may_meet(of: Any, a: int, b: int) -> bool:
    dx, dy, reach = of[a].x_m - of[b].x_m, of[a].y_m - of[b].y_m, of[a].radius_m + of[b].radius_m
    return bool(dx * dx + dy * dy < reach * reach)


@kernel
def _make_workspace(most: int, widest: int) -> Work:
    return (
        np.empty((most + 1, widest, 2)),  # corners in the frame of the view: observer at 0, target along +x
        np.empty((1 + _CORNERS) * most * widest + widest + 2),  # azimuths of corners, and of edges that cross
        np.empty((most, 2)), np.empty((most, 2)),  # slopes at which each active body begins and ends to cover, as g·u
        np.empty(_MAX_PIECES),  # azimuths where two slopes are equal
        np.empty(most), np.empty(most),  # covered intervals of one column
    )  # fmt: skip


@nb.njit(inline="always")
def _crossing_distances(
    polygon: Float, size: int, ux: float, uy: float
) -> tuple[bool, float, float, float, float, float]:
    # Inverse distances of entry and exit along u, as vectors g with 1/d = g·u; hit is False where the ray misses.
    enter, leave = -np.inf, np.inf
    nx = ny = fx = fy = 0.0
    hit = True
    for k in range(size):
        m = k + 1 if k + 1 < size else 0
        ax, ay = polygon[k, 0], polygon[k, 1]
        ex, ey = polygon[m, 0] - ax, polygon[m, 1] - ay
        offset = ey * ax - ex * ay  # outward normal (ey, −ex) times a point of the edge
        speed = ey * ux - ex * uy
        # Zero where the observer stands in line with the edge: then it is not the face that is seen.
        nearness = 1.0 / offset if offset != 0.0 else 0.0
        if speed < 0.0:
            d = offset / speed
            if d > enter:
                enter, nx, ny = d, ey * nearness, -ex * nearness
        elif speed > 0.0:
            d = offset / speed
            if d < leave:
                leave, fx, fy = d, ey * nearness, -ex * nearness
        elif offset < 0.0:
            hit = False
    return hit and enter < leave and leave > 0.0, enter, nx, ny, fx, fy


@kernel
def _insert_sorted(values: Float, count: int, value: float) -> int:
    # Keeps values[:count] ascending.
    k = count
    while k > 0 and values[k - 1] > value:
        values[k] = values[k - 1]
        k -= 1
    values[k] = value
    return count + 1


@kernel
def _insert_crossings(a: Float, na: int, b: Float, nb_: int, lo: float, hi: float, breaks: Float, count: int) -> int:
    # The azimuths between lo and hi at which an edge of a crosses one of b go to the ascending breaks[:count].
    for k in range(na):
        m = k + 1 if k + 1 < na else 0
        ex, ey = a[m, 0] - a[k, 0], a[m, 1] - a[k, 1]
        for j in range(nb_):
            n = j + 1 if j + 1 < nb_ else 0
            fx, fy = b[n, 0] - b[j, 0], b[n, 1] - b[j, 1]
            across = ex * fy - ey * fx
            if across == 0.0:
                continue
            dx, dy = b[j, 0] - a[k, 0], b[j, 1] - a[k, 1]
            p, q = (dx * fy - dy * fx) / across, (dx * ey - dy * ex) / across  # parts of the edges up to there
            if 0.0 <= p <= 1.0 and 0.0 <= q <= 1.0:
                angle = np.arctan2(a[k, 1] + p * ey, a[k, 0] + p * ex)
                if lo < angle < hi:
                    count = _insert_sorted(breaks, count, angle)
    return count


@nb.njit(inline="always")
def _equal_at(
    gx: float, gy: float, a: float, b: float, cos_a: float, sin_a: float, cos_b: float, sin_b: float
) -> float:
    # The azimuth within (a, b) at which g·u = 0, else a.
    va, vb = gx * cos_a + gy * sin_a, gx * cos_b + gy * sin_b
    if va * vb >= 0.0:
        return a
    va, vb = abs(va), abs(vb)
    angle = np.arctan2(sin_a * vb + sin_b * va, cos_a * vb + cos_b * va)
    return float(min(max(angle, a), b))


@kernel
def _visible_share(
    t: int, near: Int, count: int, xy: Float, of: Any, eye_m: tuple[float, float, float], flat: bool, work: Work
) -> float:
    # The share of target t that the bodies near[:count] leave visible: the open azimuths, column by column.
    local, breaks, begin, end, splits, low, high = work
    ox, oy, oz = eye_m
    bearing, lo, hi = of[t].bearing, of[t].lo, of[t].hi
    cos, sin = np.cos(bearing), np.sin(bearing)
    n_breaks = _insert_sorted(breaks, 0, lo)
    n_breaks = _insert_sorted(breaks, n_breaks, hi)
    for i in range(count + 1):  # the target last
        b = near[i] if i < count else t
        for k in range(of[b].size):
            dx, dy = xy[b, k, 0] - ox, xy[b, k, 1] - oy
            vx, vy = cos * dx + sin * dy, cos * dy - sin * dx
            local[i, k, 0], local[i, k, 1] = vx, vy
            angle = np.arctan2(vy, vx)
            if lo < angle < hi:
                n_breaks = _insert_sorted(breaks, n_breaks, angle)
    for i in range(count):
        if of[near[i]].owner >= 0 and _may_meet(of, near[i], t):
            n_breaks = _insert_crossings(local[i], of[near[i]].size, local[count], of[t].size, lo, hi, breaks, n_breaks)
    z0, z1 = of[t].bottom_m - oz, of[t].top_m - oz
    seen = 0.0
    for piece in range(n_breaks - 1):
        a, b = breaks[piece], breaks[piece + 1]
        if b - a < 1e-12:
            continue
        ux, uy = np.cos((a + b) / 2), np.sin((a + b) / 2)
        hit, face, tx, ty, _fx, _fy = _crossing_distances(local[count], of[t].size, ux, uy)
        if not hit:  # rounding at a grazing corner
            continue
        columns = FaceColumns(a, b, ux, uy, face, tx, ty, z0, z1)
        active = _find_covering_bodies(near, count, local, of, oz, columns, flat, begin, end)
        if active == 0:
            seen += b - a
        elif active > 0:
            n_splits = _split_azimuths(active, begin, end, tx, ty, z0, z1, a, b, splits)
            for k in range(n_splits - 1):
                width = splits[k + 1] - splits[k]
                if width < 1e-12:
                    continue
                for g in range(3):
                    theta = splits[k] + width * (0.5 + (g - 1) * 0.3872983346207417)  # √0.15: Gauss–Legendre
                    weight = (8.0 if g == 1 else 5.0) / 18.0
                    seen += width * weight * _open_share(active, begin, end, tx, ty, z0, z1, theta, low, high)
    return float(min(max(seen / (hi - lo), 0.0), 1.0))


@nb.njit(inline="always")
def _find_covering_bodies(
    near: Int, count: int, local: Float, of: Any, oz: float, columns: FaceColumns, flat: bool, begin: Float, end: Float
) -> int:
    # Bodies that cover a part of the columns between the azimuths a and b: how many, their slopes in begin and end.
    # −1 where one of them covers all of it. Linear in u: what holds at both ends holds throughout.
    a, b, ux, uy, face, tx, ty, z0, z1 = columns
    cos_a, sin_a, cos_b, sin_b = np.cos(a), np.sin(a), np.cos(b), np.sin(b)
    tx0, ty0, tx1, ty1 = z0 * tx, z0 * ty, z1 * tx, z1 * ty
    active = 0
    for i in range(count):
        body = near[i]
        hit, enter, nx, ny, fx, fy = _crossing_distances(local[i], of[body].size, ux, uy)
        if not hit or enter >= face:
            continue
        of_obstacle = of[body].owner >= 0
        if of_obstacle and enter + _OVERLAP_M >= face:  # in line with the target's face: not before it
            continue
        if flat:
            return -1
        bottom, top = of[body].bottom_m - oz, of[body].top_m - oz
        if of_obstacle and fx * ux + fy * uy < tx * ux + ty * uy:  # what is beyond the target's face hides nothing
            fx, fy = tx, ty
        # It begins to cover at its lower edge: the near one where that is below the eyes, else the far one.
        bx, by = (bottom * nx, bottom * ny) if bottom < 0.0 else (bottom * fx, bottom * fy)
        ex, ey = (top * nx, top * ny) if top > 0.0 else (top * fx, top * fy)
        if enter <= 0.0:  # the unit is within its outline
            if top <= _OVERLAP_M:
                bx, by = -_STEEP * tx, -_STEEP * ty
            elif bottom >= -_OVERLAP_M:
                ex, ey = _STEEP * tx, _STEEP * ty
            else:  # it leans on its face
                return -1
        below = (bx - tx0) * cos_a + (by - ty0) * sin_a <= 0 and (bx - tx0) * cos_b + (by - ty0) * sin_b <= 0
        above = (ex - tx1) * cos_a + (ey - ty1) * sin_a >= 0 and (ex - tx1) * cos_b + (ey - ty1) * sin_b >= 0
        if below and above:
            return -1
        under = (ex - tx0) * cos_a + (ey - ty0) * sin_a <= 0 and (ex - tx0) * cos_b + (ey - ty0) * sin_b <= 0
        over = (bx - tx1) * cos_a + (by - ty1) * sin_a >= 0 and (bx - tx1) * cos_b + (by - ty1) * sin_b >= 0
        if not (under or over):
            begin[active, 0], begin[active, 1], end[active, 0], end[active, 1] = bx, by, ex, ey
            active += 1
    return active


@kernel
def _split_azimuths(
    active: int, begin: Float, end: Float, tx: float, ty: float, z0: float, z1: float, a: float, b: float, splits: Float
) -> int:
    # The azimuths from a to b between which no slope crosses another, nor an end of the column; how many.
    cos_a, sin_a, cos_b, sin_b = np.cos(a), np.sin(a), np.cos(b), np.sin(b)
    n_splits = _insert_sorted(splits, 0, a)
    n_splits = _insert_sorted(splits, n_splits, b)
    for i in range(active):
        for edge in range(2):
            gx = begin[i, 0] if edge == 0 else end[i, 0]
            gy = begin[i, 1] if edge == 0 else end[i, 1]
            for other in range(-2, 2 * active):
                if other < 0:
                    z = z0 if other == -2 else z1
                    hx, hy = z * tx, z * ty
                elif other // 2 <= i:
                    continue
                elif other % 2 == 0:
                    hx, hy = begin[other // 2, 0], begin[other // 2, 1]
                else:
                    hx, hy = end[other // 2, 0], end[other // 2, 1]
                angle = _equal_at(gx - hx, gy - hy, a, b, cos_a, sin_a, cos_b, sin_b)
                if angle > a and n_splits < _MAX_PIECES:
                    n_splits = _insert_sorted(splits, n_splits, angle)
    return n_splits


@nb.njit(inline="always")
def _open_share(
    active: int, begin: Float, end: Float, tx: float, ty: float, z0: float, z1: float, theta: float,
    low: Float, high: Float,
) -> float:  # fmt: skip
    # The share of the column at one azimuth that is not covered: 1 less the union of the bodies' intervals.
    ux, uy = np.cos(theta), np.sin(theta)
    inverse = tx * ux + ty * uy
    n_covered = 0
    for i in range(active):
        first = max(((begin[i, 0] * ux + begin[i, 1] * uy) / inverse - z0) / (z1 - z0), 0.0)
        last = min(((end[i, 0] * ux + end[i, 1] * uy) / inverse - z0) / (z1 - z0), 1.0)
        if last <= first:
            continue
        j = n_covered
        while j > 0 and low[j - 1] > first:
            low[j], high[j] = low[j - 1], high[j - 1]
            j -= 1
        low[j], high[j] = first, last
        n_covered += 1
    left, reach = 1.0, 0.0
    for i in range(n_covered):
        if high[i] > reach:
            left -= high[i] - max(low[i], reach)
            reach = high[i]
    return left
