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

from copem_replay.core.compiled import borrowing, borrowing_kernel, callee
from copem_replay.core.tracks import Bool, Float, Int


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
    cos_a: float
    sin_a: float
    cos_b: float
    sin_b: float
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
        ("near_m", np.float64), ("far_m", np.float64), ("lowest", np.float64), ("highest", np.float64),
        ("from_slope", np.float64), ("to_slope", np.float64), ("begins_m", np.float64),
        ("hides", np.bool_), ("inside", np.bool_), ("over", np.bool_),
    ]
)  # fmt: skip
"""A body: how many corners it has; the obstacle it is a part of, −1: none; middle, radius and height. From one
observer: bearing and distance of the middle, the extent in azimuth about it, the distances of the outline's nearest and
farthest point, the slopes between which all of it is, and those between which it covers at every azimuth of its extent;
whether it can hide others, whether the observer is within its outline, and then over or under it."""

_CORNERS = 4
"""Corners of a target."""
_OVERLAP_M = 1e-6
"""Footprints that enter each other by less than this only touch: above rounding, below any overlap of objects."""
_ON_TOP_M = 0.01
"""A unit so little above a box touches it: heights in logs are rounded."""
_SURELY = 1e-6
"""A body that surely hides all of another exceeds it by this, in rad, m and slope: far above rounding. Larger: slower,
no result changes."""
_BESIDE_M = 1e-3
"""From a body nearer than this azimuths are too unsure to tell what it misses; above it rounding is far below
`_SURELY`."""
_STEEP = 1e6
"""Height (m) at the target's face of a slope that stands for straight down or straight up: beyond any target."""
_APART = 1e-9
"""Slopes that differ by this at both ends of a piece, to the one or the other side, do not cross: above rounding. For
larger ones: this part of them."""
_MAX_PIECES = 512
"""Azimuth pieces per view: 60 bodies in front of one target need about 250."""
_MOST_SECTORS = 256
"""Sectors of azimuth by which bodies are found. No result depends on it."""
_WORD = 64
"""Bodies in a word of the index."""
_MOST_KEPT = 200_000
"""Static bodies as units see them that are kept from list to list: 40 MB in each thread. No result depends on it."""
_LOWEST_BIT = 0x03F79D71B4CB0A89
"""De Bruijn's sequence: times a power of two, its top six bits tell which power. No two windows of six are equal."""
_PLACE_OF = np.zeros(_WORD, dtype=np.int64)
_PLACE_OF[[(_LOWEST_BIT << place & 2**64 - 1) >> 58 for place in range(_WORD)]] = np.arange(_WORD)


class _Still(NamedTuple):
    # Static bodies, and what units saw of them in the list before.
    xy: Float  # (G, corners, 2)
    of: Any  # (G,) as far as it does not depend on a unit
    eye_m: Float  # (U, 3) from where; NaN: from nowhere yet
    kept: Bool  # (U,) whether what follows is there
    seen: Any  # (U, G)
    azimuth: Float  # (U, G, corners)


class _Index(NamedTuple):
    # The bodies that may hide something, by how near they are and by sectors of azimuth.
    order: Int  # (B,) nearer ones first; those with the same depth in any order
    depth: Int  # (B,) of each, from 0 on
    ends: Int  # (B + 1,) where each depth ends in `order`
    bits: Int  # (sectors, words) a bit for each place in `order` whose body reaches into the sector
    half_m: Float  # (1,) half of the depths are for what is nearer


class _Found(NamedTuple):
    # The bodies that may hide the target at hand, and what is known of them.
    near: Int
    span: Float  # (B, 2) azimuths about the target's bearing, outside which a body surely hides nothing
    covered: Float  # (B, 2) azimuths, ascending and apart, between which a body surely hides all of the target
    kept: Int  # those of `near` that matter elsewhere, ascending, and their spans
    kept_span: Float


def compute_shares(
    f0: int, f1: int, boxes: Boxes, obstacles: Statics, places: Observers, asked: Bool, flat: bool, out: Float,
    blocker: Int,
) -> None:  # fmt: skip
    """Fill `out (U, P)`, U units by P rows of bodies, with visible shares 0 … 1 in frames f0 … f1 − 1, where `asked`.

    `flat`: heights do not count. `blocker (U, P)`, unless empty, gets the row of the body that by itself hides most of
    the row: −1 where nothing hides it, −2 − k for the obstacle k.
    """
    units, count = len(places.carrier_ix), len(obstacles.body)
    most = int(np.diff(boxes.bounds[f0 : f1 + 1]).max(initial=0)) + count
    widest = max(boxes.corners_m.shape[1], int(np.diff(obstacles.start).max(initial=0)))
    room = np.empty((most, widest, 2)), np.empty(most, BODY)
    index = _Index(
        np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most + 1, np.int64),
        np.empty((_MOST_SECTORS, most // _WORD + 1), np.int64), np.empty(1),
    )  # fmt: skip
    found = _Found(
        np.empty(most, np.int64), np.empty((most, 2)), np.empty((most + 1, 2)), np.empty(most, np.int64),
        np.empty((most, 2)),
    )  # fmt: skip
    kept = min(units, _MOST_KEPT // max(count, 1))
    still = _Still(
        np.empty((count, widest, 2)), np.empty(count, BODY), np.full((kept, 3), np.nan), np.zeros(kept, np.bool_),
        np.empty((kept, count), BODY), np.empty((kept, count, widest)),
    )  # fmt: skip
    _view_lists(
        f0, f1, boxes, obstacles, places, asked, flat, out, blocker, room, still, index, found,
        _make_workspace(most, widest),
    )  # fmt: skip


@borrowing_kernel
def _view_lists(
    f0: int, f1: int, boxes: Boxes, obstacles: Statics, places: Observers, asked: Bool, flat: bool, out: Float,
    blocker: Int, room: tuple[Float, Any], still: _Still, index: _Index, found: _Found, work: _Work,
) -> None:  # fmt: skip
    """Fills `out (U, P)`, and `blocker`, for lists f0 … f1 − 1. Bodies of a list: the boxes, then the static parts."""
    xy, of = room
    _gather_statics(obstacles, still)
    for f in range(f0, f1):
        first = boxes.bounds[f]
        n = boxes.bounds[f + 1] - first
        _gather_bodies(first, n, boxes, still, xy, of)
        bodies = of[: n + len(obstacles.body)]
        for u in range(places.present.shape[0]):
            if places.present[u, f] and _find_next(0, u, first, n, asked) < n:
                eye_m = (places.place_m[u, f, 0], places.place_m[u, f, 1], places.place_m[u, f, 2])
                carrier_ix = places.carrier_ix[u]
                _look_around(
                    u, eye_m, n, boxes.object_ix[first : first + n], carrier_ix, flat, xy, bodies, work.azimuth, still
                )
                _index_bodies(bodies, index)
                t = -1
                while True:
                    t = _find_next(t + 1, u, first, n, asked)
                    if t >= n:
                        break
                    if boxes.object_ix[first + t] == carrier_ix:
                        continue
                    share, b, alone = 1.0, -1, len(blocker) > 0
                    if not bodies[t].inside:
                        share, b = _view_target(t, alone, xy, bodies, eye_m, flat, index, found, work)
                        if alone:
                            blocker[u, first + t] = -1 if b < 0 else first + b if b < n else -2 - bodies[b].owner
                    out[u, first + t] = share


@nb.njit(inline="always")
def _find_next(t: int, u: int, first: int, n: int, asked: Bool) -> int:
    # The first target from t on that is asked for; n: none.
    while t < n and not asked[u, first + t]:
        t += 1
    return t


@borrowing
def _gather_statics(obstacles: Statics, still: _Still) -> None:
    # Out: the static bodies.
    for g in range(len(obstacles.body)):
        still.of[g].size, still.of[g].owner = obstacles.start[g + 1] - obstacles.start[g], obstacles.body[g]
        still.of[g].bottom_m, still.of[g].top_m = obstacles.bottom_m[g], obstacles.top_m[g]
        for k in range(still.of[g].size):
            v = obstacles.start[g] + k
            still.xy[g, k, 0], still.xy[g, k, 1] = obstacles.xy_m[v, 0], obstacles.xy_m[v, 1]
        _enclose(still.xy[g], still.of[g])


@borrowing
def _gather_bodies(first: int, n: int, boxes: Boxes, still: _Still, xy: Float, of: Any) -> None:
    """Fills `of` and `xy` with the bodies of one list: n boxes from `first` on, then the static parts."""
    for b in range(n):
        of[b].size, of[b].owner = 4, -1
        of[b].bottom_m, of[b].top_m = boxes.bottom_m[first + b], boxes.top_m[first + b]
        for k in range(4):
            xy[b, k, 0], xy[b, k, 1] = boxes.corners_m[first + b, k, 0], boxes.corners_m[first + b, k, 1]
        _enclose(xy[b], of[b])
    for g in range(len(still.of)):
        of[n + g] = still.of[g]
        for k in range(still.of[g].size):
            xy[n + g, k, 0], xy[n + g, k, 1] = still.xy[g, k, 0], still.xy[g, k, 1]


@borrowing
def _enclose(polygon: Float, body: Any) -> None:
    # Out: the middle and the radius of a body.
    mx = my = r2 = 0.0
    for k in range(body.size):
        mx += polygon[k, 0] / body.size
        my += polygon[k, 1] / body.size
    for k in range(body.size):
        r2 = max(r2, (polygon[k, 0] - mx) ** 2 + (polygon[k, 1] - my) ** 2)
    body.x_m, body.y_m, body.radius_m = mx, my, np.sqrt(r2)


@borrowing
def _look_around(
    u: int, eye_m: tuple[float, float, float], n: int, object_ix: Int, mine: int, flat: bool, xy: Float, of: Any,
    azimuth: Float, still: _Still,
) -> None:  # fmt: skip
    """Fills what of the bodies depends on observer u; static ones are copied if it has not moved for two lists."""
    count = len(still.of)
    has_not_moved = u < len(still.eye_m) and (
        still.eye_m[u, 0] == eye_m[0] and still.eye_m[u, 1] == eye_m[1] and still.eye_m[u, 2] == eye_m[2]
    )
    is_cached = has_not_moved and still.kept[u]
    _look_at_bodies(eye_m, n, object_ix, mine, flat, xy, of[:n] if is_cached else of, azimuth)
    if is_cached:
        for g in range(count):
            of[n + g] = still.seen[u, g]
            for k in range(still.of[g].size):
                azimuth[n + g, k] = still.azimuth[u, g, k]
    elif has_not_moved:
        still.kept[u] = True
        for g in range(count):
            still.seen[u, g] = of[n + g]
            for k in range(still.of[g].size):
                still.azimuth[u, g, k] = azimuth[n + g, k]
    elif u < len(still.eye_m):
        still.kept[u] = False
        still.eye_m[u, 0], still.eye_m[u, 1], still.eye_m[u, 2] = eye_m[0], eye_m[1], eye_m[2]


@borrowing
def _look_at_bodies(
    eye_m: tuple[float, float, float], n: int, object_ix: Int, mine: int, flat: bool, xy: Float, of: Any, azimuth: Float
) -> None:
    """Fills what of bodies depends on the observer. The first n are boxes; `mine`: the object that carries the unit."""
    ox, oy, oz = eye_m
    for b in range(len(of)):
        # A unit that touches a box is in it: some logs hold the mast, too. A unit that touches an obstacle is
        # in front of it: some cameras are fixed to walls, or stand on roofs.
        body = of[b]
        dx, dy = body.x_m - ox, body.y_m - oy
        body.bearing, body.distance_m = np.arctan2(dy, dx), np.sqrt(dx * dx + dy * dy)
        body.inside = body.distance_m <= body.radius_m + _SURELY and _contains(
            xy[b], body.size, ox, oy, 0.0 if b < n else _OVERLAP_M
        )
        margin_m = _ON_TOP_M if b < n else -_OVERLAP_M
        body.over = not flat and body.inside and (oz > body.top_m + margin_m or oz < body.bottom_m - margin_m)
        body.hides = (body.over or not body.inside) and not (b < n and object_ix[b] == mine)
        body.lo = body.hi = 0.0
        if body.over:
            body.lo, body.hi = -np.pi, np.pi
        elif body.hides:
            for k in range(body.size):
                vx, vy = xy[b, k, 0] - ox, xy[b, k, 1] - oy
                angle = np.arctan2(dx * vy - dy * vx, dx * vx + dy * vy)
                body.lo, body.hi, azimuth[b, k] = min(body.lo, angle), max(body.hi, angle), angle
        _bound_slopes(xy[b], eye_m, flat, body)
    for b in range(n, len(of)):  # a unit inside one part of an obstacle is inside the obstacle
        if of[b].inside and not of[b].over:
            for c in range(n, len(of)):
                if of[c].owner == of[b].owner:
                    of[c].hides = False


@borrowing
def _bound_slopes(polygon: Float, eye_m: tuple[float, float, float], flat: bool, body: Any) -> None:
    """Fills distances and slopes of a body. One too near to be sure of is infinitely far: it surely hides nothing."""
    near_m2, far_m2, has_short_edge = np.inf, 0.0, False
    for k in range(body.size):
        m = k + 1 if k + 1 < body.size else 0
        ax, ay = polygon[k, 0] - eye_m[0], polygon[k, 1] - eye_m[1]
        ex, ey = polygon[m, 0] - polygon[k, 0], polygon[m, 1] - polygon[k, 1]
        along, length2 = -(ax * ex + ay * ey), ex * ex + ey * ey
        has_short_edge |= length2 < _BESIDE_M * _BESIDE_M
        if along >= length2:  # nearest at the next corner
            along = 0.0
        edge_part = along / length2 if along > 0.0 else 0.0
        px, py = ax + edge_part * ex, ay + edge_part * ey
        near_m2, far_m2 = min(near_m2, px * px + py * py), max(far_m2, ax * ax + ay * ay)
    near_m, far_m = np.sqrt(near_m2), np.sqrt(far_m2)
    body.near_m, body.far_m = near_m, far_m
    if near_m <= _BESIDE_M or has_short_edge or body.inside:
        body.near_m, body.far_m = 0.0, np.inf
        return
    bottom, top = body.bottom_m - eye_m[2], body.top_m - eye_m[2]
    body.lowest = bottom / near_m if bottom < 0.0 else bottom / far_m
    body.highest = top / near_m if top > 0.0 else top / far_m
    body.from_slope = -np.inf if flat else bottom / far_m if bottom < 0.0 else bottom / near_m
    body.to_slope = np.inf if flat else top / far_m if top > 0.0 else top / near_m


# What may hide a target: bodies by depth and by sectors of azimuth.


@borrowing
def _index_bodies(of: Any, index: _Index) -> None:
    """Fills the index of bodies that may hide something: by distance, and by sector of azimuth as bits."""
    bodies, total_m = len(of), 1.0
    if bodies == 0:
        return
    for b in range(bodies):
        of[b].begins_m = of[b].distance_m - of[b].radius_m
        total_m += of[b].distance_m
    index.half_m[0] = total_m / bodies
    index.ends[: bodies + 1] = 0
    for b in range(bodies):
        index.depth[b] = _find_depth(of[b].begins_m, bodies, index)
        index.ends[index.depth[b] + 1] += 1
    for depth in range(bodies):
        index.ends[depth + 1] += index.ends[depth]
    sectors, words = min(_MOST_SECTORS, 4 * bodies), bodies // _WORD + 1
    index.bits[:sectors, :words] = 0
    for b in range(bodies):
        place = index.ends[index.depth[b]]
        index.ends[index.depth[b]] += 1
        index.order[place] = b
        if of[b].hides:
            first, last = _find_sectors(of[b], sectors)
            for k in range(first, last + 1):
                index.bits[k if k < sectors else k - sectors, place // _WORD] |= 1 << (place % _WORD)


@nb.njit(inline="always")
def _find_depth(begins_m: float, bodies: int, index: _Index) -> int:
    # What begins farther away has no smaller depth, 0 … bodies − 1; half of the depths are for what is nearer.
    return int(max(begins_m, 0.0) / (max(begins_m, 0.0) + index.half_m[0]) * bodies)


@nb.njit(inline="always")
def _find_sectors(body: Any, sectors: int) -> tuple[int, int]:
    # The first and the last sector that a body reaches into, counted on beyond a full round.
    if body.over:
        return 0, sectors - 1
    first = int(np.floor((body.bearing + body.lo - _SURELY) * sectors / (2 * np.pi)))
    last = int(np.floor((body.bearing + body.hi + _SURELY) * sectors / (2 * np.pi)))
    round_ = first % sectors - first
    return first + round_, min(last, first + sectors - 1) + round_


@borrowing
def _find_near_bodies(t: int, all_: bool, xy: Float, of: Any, index: _Index, found: _Found) -> tuple[int, int]:
    """Fills `found` with bodies that may hide a part of target t, and with covered azimuths; returns how many of both.
    Unless `all_`, it ends where all azimuths are covered.
    """
    sectors, bodies = min(_MOST_SECTORS, 4 * len(of)), len(of)
    first, last = _find_sectors(of[t], sectors)
    far_end_m, lo, hi = of[t].distance_m + of[t].radius_m, of[t].lo, of[t].hi
    words = index.ends[min(_find_depth(far_end_m, bodies, index) + 1, bodies - 1)] // _WORD + 1  # nothing beyond
    count = n_covered = 0
    for w in range(words):
        bits_left = 0
        for k in range(first, last + 1):
            bits_left |= index.bits[k if k < sectors else k - sectors, w]
        while bits_left != 0:
            b = index.order[w * _WORD + _PLACE_OF[((bits_left & -bits_left) * _LOWEST_BIT >> 58) & 63]]
            bits_left &= bits_left - 1
            if b == t or of[b].begins_m > far_end_m:
                continue
            turn_rad = of[b].bearing - of[t].bearing
            turn_rad -= 2 * np.pi * np.rint(turn_rad / (2 * np.pi))
            meets_ahead = turn_rad + of[b].lo < hi and turn_rad + of[b].hi > lo
            left_round, right_round = turn_rad + of[b].hi - 2 * np.pi > lo, turn_rad + of[b].lo + 2 * np.pi < hi
            if not (meets_ahead or left_round or right_round):
                continue
            since, until = -np.inf, np.inf
            if of[b].near_m > 0.0 and meets_ahead + left_round + right_round == 1:
                turn_rad += 2 * np.pi if right_round else -2 * np.pi if left_round else 0.0
                since, until = turn_rad + of[b].lo, turn_rad + of[b].hi
            if since > -np.inf and _surely_covers(of[b], of[t]):
                n_covered = _cover_azimuths(since, until, n_covered, found.covered)
                if not all_ and _covers_all(lo, hi, found.covered[:n_covered]):
                    return count, n_covered
            elif _overlaps_target(b, t, xy, of):
                continue
            found.near[count], found.span[count, 0], found.span[count, 1] = b, since, until
            count += 1
    return count, n_covered


@nb.njit(inline="always")
def _overlaps_target(b: int, t: int, xy: Float, of: Any) -> bool:
    # A box that overlaps the target's footprint does not hide it: a rider's overlaps that of the bicycle.
    return (
        of[b].owner < 0
        and _may_meet(of, b, t)
        and not _are_separated(xy[t], of[t].size, xy[b], of[b].size)
        and not _are_separated(xy[b], of[b].size, xy[t], of[t].size)
    )


@nb.njit(inline="always")
def _surely_covers(body: Any, target: Any) -> bool:
    # Whether a body hides all of a target at every azimuth of its extent, by bounds alone.
    return bool(
        body.far_m + 2 * _SURELY < target.near_m
        and body.from_slope + _SURELY < target.lowest
        and body.to_slope - _SURELY > target.highest
    )


@nb.njit(inline="always")
def _cover_azimuths(since: float, until: float, n: int, covered: Float) -> int:
    """Adds an interval to covered[:n]; those that surely overlap become one. Returns their new number."""
    k = 0
    while k < n and covered[k, 1] < since + 2 * _SURELY:
        k += 1
    m = k
    while m < n and covered[m, 0] + 2 * _SURELY <= until:
        since, until = min(since, covered[m, 0]), max(until, covered[m, 1])
        m += 1
    if m == k:  # room for one more
        for j in range(n, k, -1):
            covered[j, 0], covered[j, 1] = covered[j - 1, 0], covered[j - 1, 1]
    else:
        for j in range(m, n):
            covered[k + 1 + j - m, 0], covered[k + 1 + j - m, 1] = covered[j, 0], covered[j, 1]
    covered[k, 0], covered[k, 1] = since, until
    return n + 1 - (m - k)


@nb.njit(inline="always")
def _covers_all(lo: float, hi: float, covered: Float) -> bool:
    found = False
    for k in range(len(covered)):
        found |= covered[k, 0] + _SURELY < lo and covered[k, 1] - _SURELY > hi
    return found


@borrowing
def _keep_what_matters(t: int, count: int, covered: Float, of: Any, found: _Found) -> int:
    """Fills `found.kept` with bodies that may hide target t where it is not covered; returns how many."""
    kept_count = 0
    for i in range(count):
        since, until = found.span[i, 0], found.span[i, 1]
        lo, hi = max(since - _SURELY, of[t].lo), min(until + _SURELY, of[t].hi)
        may_hide = True
        for k in range(len(covered)):
            if lo >= covered[k, 0] + 2 * _SURELY and hi <= covered[k, 1] - 2 * _SURELY:
                may_hide = False
        if not may_hide:
            continue
        j = kept_count
        while j > 0 and found.kept[j - 1] > found.near[i]:
            found.kept[j], found.kept_span[j, 0] = found.kept[j - 1], found.kept_span[j - 1, 0]
            found.kept_span[j, 1] = found.kept_span[j - 1, 1]
            j -= 1
        found.kept[j], found.kept_span[j, 0], found.kept_span[j, 1] = found.near[i], since, until
        kept_count += 1
    return kept_count


@borrowing
def _view_target(
    t: int, alone: bool, xy: Float, of: Any, eye_m: tuple[float, float, float], flat: bool, index: _Index,
    found: _Found, work: _Work,
) -> tuple[float, int]:  # fmt: skip
    """The visible share of target t; and, if `alone`, the body that hides most of it by itself (−1: none hides any)."""
    count, n_covered = _find_near_bodies(t, alone, xy, of, index, found)
    share, least_share, main_blocker = 1.0, 1.0 - 1e-9, -1
    if _covers_all(of[t].lo, of[t].hi, found.covered[:n_covered]):
        share = 0.0
        if not alone:
            return share, main_blocker
    # At first all bodies at once, then each, which is compiled once.
    for which in range(-1 if count > 0 and share > 0.0 else 0, count if alone else 0):
        covered = found.covered[: n_covered if which < 0 else 0]
        kept = _keep_what_matters(t, count, covered, of, found) if which <= 0 else count
        first, after = (0, kept) if which < 0 else (which, which + 1)
        visible_share = _visible_share(
            t, found.kept[first:after], found.kept_span[first:after], covered, xy, of, eye_m, flat, work
        )
        if which < 0:
            share = visible_share
        elif visible_share < least_share:
            least_share, main_blocker = visible_share, found.kept[which]
    return share, main_blocker


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


@callee
def _are_separated(a: Float, na: int, b: Float, nb_: int) -> bool:
    """Whether all of polygon b is on the outer side of (or touches) some edge of polygon a."""
    for k in range(na):
        m = k + 1 if k + 1 < na else 0
        ex, ey = a[m, 0] - a[k, 0], a[m, 1] - a[k, 1]
        tolerance = np.sqrt(ex * ex + ey * ey) * _OVERLAP_M
        is_outside = True
        for j in range(nb_):
            if ex * (b[j, 1] - a[k, 1]) - ey * (b[j, 0] - a[k, 0]) > tolerance:
                is_outside = False
                break
        if is_outside:
            return True
    return False


@nb.njit(inline="always")
def _may_meet(of: Any, a: int, b: int) -> bool:
    dx, dy, reach = of[a].x_m - of[b].x_m, of[a].y_m - of[b].y_m, of[a].radius_m + of[b].radius_m
    return bool(dx * dx + dy * dy < reach * reach)


class _Work(NamedTuple):
    # Of the target at hand and the bodies in front of it, the target last.
    azimuth: Float  # (B, corners) of the corners of each body of the list, about its bearing
    corner: Float  # (B, corners, 2) in the frame of the view: observer at 0, target along +x
    edge: (
        Float  # (B, corners, 4) of each edge its direction, how far it is from the observer times its length, 1 / that
    )
    ahead: Int  # the bodies that may cover a part of it
    breaks: Float  # azimuths of corners, and of edges that cross
    slope: (
        Float  # (4, B) at which each active body begins and ends to cover, as g·u: x, y of the one, x, y of the other
    )
    slope_at: (
        Float  # (2, 2 B) these slopes at both ends of a piece: where the first body begins, ends, the next begins …
    )
    sorted: Float  # (2, 2 B + 2) these, and the ends of the column, ascending at a
    splits: Float  # azimuths where two slopes are equal
    interval: Float  # (2, B) of each active body in one column
    low: Float  # covered intervals of one column that do not begin at its bottom
    high: Float


def _make_workspace(most: int, widest: int) -> _Work:
    return _Work(
        np.empty((most, widest)), np.empty((most + 1, widest, 2)), np.empty((most + 1, widest, 4)),
        np.empty(most, np.int64),
        np.empty((1 + _CORNERS) * most * widest + widest + 2), np.empty((4, most)), np.empty((2, 2 * most)),
        np.empty((2, 2 * most + 2)), np.empty(_MAX_PIECES), np.empty((2, most)), np.empty(most), np.empty(most),
    )  # fmt: skip


@nb.njit(inline="always")
def _measure_edges(polygon: Float, size: int, edge: Float) -> None:
    for k in range(size):
        m = k + 1 if k + 1 < size else 0
        ax, ay = polygon[k, 0], polygon[k, 1]
        ex, ey = polygon[m, 0] - ax, polygon[m, 1] - ay
        offset = ey * ax - ex * ay  # outward normal (ey, −ex) times a point of the edge
        # Zero where the observer stands in line with the edge: then it is not the face that is seen.
        edge[k, 0], edge[k, 1], edge[k, 2], edge[k, 3] = ex, ey, offset, 1.0 / offset if offset != 0.0 else 0.0


@borrowing
def _crossing_distances(edge: Float, size: int, ux: float, uy: float) -> tuple[bool, float, float, float, float, float]:
    """Whether the ray u hits; entry distance; inverse distances of entry and exit as vectors g with 1/d = g·u."""
    enter, leave = -np.inf, np.inf
    front = back = -1
    hit = True
    for k in range(size):
        speed = edge[k, 1] * ux - edge[k, 0] * uy
        if speed < 0.0:
            d = edge[k, 2] / speed
            if d > enter:
                enter, front = d, k
        elif speed > 0.0:
            d = edge[k, 2] / speed
            if d < leave:
                leave, back = d, k
        elif edge[k, 2] < 0.0:
            hit = False
    if not (hit and enter < leave and leave > 0.0):
        return False, enter, 0.0, 0.0, 0.0, 0.0
    nx, ny = (edge[front, 1] * edge[front, 3], -edge[front, 0] * edge[front, 3]) if front >= 0 else (0.0, 0.0)
    fx, fy = (edge[back, 1] * edge[back, 3], -edge[back, 0] * edge[back, 3]) if back >= 0 else (0.0, 0.0)
    return True, enter, nx, ny, fx, fy


@callee
def _insert_sorted(values: Float, count: int, value: float) -> int:
    # Keeps values[:count] ascending.
    k = count
    while k > 0 and values[k - 1] > value:
        values[k] = values[k - 1]
        k -= 1
    values[k] = value
    return count + 1


@callee
def _insert_crossings(a: Float, na: int, b: Float, nb_: int, lo: float, hi: float, breaks: Float, count: int) -> int:
    """Adds to the ascending breaks[:count] azimuths from lo to hi where edges of a and b cross; returns the count."""
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


@callee
def _visible_share(
    t: int, near: Int, span: Float, covered: Float, xy: Float, of: Any, eye_m: tuple[float, float, float], flat: bool,
    work: _Work,
) -> float:  # fmt: skip
    """The share of target t that bodies `near` leave visible: its open azimuths, integrated column by column."""
    breaks, splits, count = work.breaks, work.splits, len(near)
    lo, hi, oz = of[t].lo, of[t].hi, eye_m[2]
    breaks[0], breaks[1], n_breaks = lo, hi, 2
    for i in range(count + 1):  # the target last
        b = near[i] if i < count else t
        turn = span[i, 0] - of[b].lo if i < count else -np.inf
        n_breaks = _place_corners(i, b, turn, xy[b], of, t, eye_m, n_breaks, work)
    for i in range(count):
        if of[near[i]].owner >= 0 and _may_meet(of, near[i], t):
            n_breaks = _insert_crossings(
                work.corner[i], of[near[i]].size, work.corner[count], of[t].size, lo, hi, breaks, n_breaks
            )
    n_ahead = _find_bodies_ahead(t, near, span, of, flat, work.ahead)
    cos_b, sin_b, at_b = 0.0, 0.0, np.nan
    z0, z1 = of[t].bottom_m - oz, of[t].top_m - oz
    seen = 0.0
    for piece in range(n_breaks - 1):
        a, b = breaks[piece], breaks[piece + 1]
        if b - a < 1e-12 or _is_covered((a + b) / 2, covered):
            continue
        ux, uy = np.cos((a + b) / 2), np.sin((a + b) / 2)
        hit, face, tx, ty, _fx, _fy = _crossing_distances(work.edge[count], of[t].size, ux, uy)
        if not hit:  # rounding at a grazing corner
            continue
        cos_a, sin_a = (cos_b, sin_b) if a == at_b else (np.cos(a), np.sin(a))
        cos_b, sin_b, at_b = np.cos(b), np.sin(b), b
        columns = FaceColumns(a, b, cos_a, sin_a, cos_b, sin_b, ux, uy, face, tx, ty, z0, z1)
        active = _find_covering_bodies(near, work.ahead[:n_ahead], span, of, oz, columns, flat, work)
        if active == 0:
            seen += b - a
        elif active > 0:
            n_splits = _split_azimuths(active, columns, work)
            for k in range(n_splits - 1):
                width = splits[k + 1] - splits[k]
                if width < 1e-12:
                    continue
                for g in range(3):
                    theta = splits[k] + width * (0.5 + (g - 1) * 0.3872983346207417)  # √0.15: Gauss–Legendre
                    weight = (8.0 if g == 1 else 5.0) / 18.0
                    seen += width * weight * _open_share(active, columns, theta, work)
    return float(min(max(seen / (hi - lo), 0.0), 1.0))


@nb.njit(inline="always")
def _place_corners(
    i: int, b: int, turn: float, polygon: Float, of: Any, t: int, eye_m: tuple[float, float, float], count: int,
    work: _Work,
) -> int:  # fmt: skip
    """Fills corners and edges of body b, the i-th, in the frame of target t; corners within its extent go to the
    breaks. `turn`: of its bearing from the target's (rad), −∞: unsure. Returns the number of breaks.
    """
    corner, lo, hi = work.corner, of[t].lo, of[t].hi
    cos, sin = np.cos(of[t].bearing), np.sin(of[t].bearing)
    for k in range(of[b].size):
        dx, dy = polygon[k, 0] - eye_m[0], polygon[k, 1] - eye_m[1]
        vx, vy = cos * dx + sin * dy, cos * dy - sin * dx
        corner[i, k, 0], corner[i, k, 1] = vx, vy
        if turn == -np.inf or lo - _SURELY < turn + work.azimuth[b, k] < hi + _SURELY:
            angle = np.arctan2(vy, vx)
            if lo < angle < hi:
                count = _insert_sorted(work.breaks, count, angle)
    _measure_edges(corner[i], of[b].size, work.edge[i])
    return count


@nb.njit(inline="always")
def _find_bodies_ahead(t: int, near: Int, span: Float, of: Any, flat: bool, ahead: Int) -> int:
    """Fills `ahead` with places in `near` of bodies neither surely beyond target t nor surely below or above what is
    visible of it. Returns their number.
    """
    n = 0
    for i in range(len(near)):
        body = of[near[i]]
        if (
            span[i, 0] > -np.inf
            and of[t].near_m > 0.0
            and (
                body.near_m > of[t].far_m + 2 * _SURELY
                or (not flat and (body.highest + _SURELY < of[t].lowest or body.lowest - _SURELY > of[t].highest))
            )
        ):
            continue
        ahead[n] = i
        n += 1
    return n


@nb.njit(inline="always")
def _is_covered(angle: float, covered: Float) -> bool:
    found = False
    for k in range(len(covered)):
        found |= covered[k, 0] + _SURELY <= angle <= covered[k, 1] - _SURELY
    return found


@nb.njit(inline="always")
def _find_covering_bodies(
    near: Int, ahead: Int, span: Float, of: Any, oz: float, columns: FaceColumns, flat: bool, work: _Work
) -> int:
    """The number of bodies that cover a part of the columns from azimuth a to b, slopes in `work.slope`; −1: one covers
    all. Linear in u: what holds at both ends holds throughout.
    """
    a, b, cos_a, sin_a, cos_b, sin_b, ux, uy, face, tx, ty, z0, z1 = columns
    tx0, ty0, tx1, ty1 = z0 * tx, z0 * ty, z1 * tx, z1 * ty
    active = 0
    middle = (a + b) / 2
    for i in ahead:
        if middle < span[i, 0] - _SURELY or middle > span[i, 1] + _SURELY:
            continue
        body = near[i]
        of_obstacle = of[body].owner >= 0
        hit, enter, nx, ny, fx, fy = _crossing_distances(work.edge[i], of[body].size, ux, uy)
        if not hit or enter >= face:
            continue
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
            slope, slope_at = work.slope, work.slope_at
            slope[0, active], slope[1, active], slope[2, active], slope[3, active] = bx, by, ex, ey
            slope_at[0, 2 * active], slope_at[1, 2 * active] = bx * cos_a + by * sin_a, bx * cos_b + by * sin_b
            slope_at[0, 2 * active + 1], slope_at[1, 2 * active + 1] = ex * cos_a + ey * sin_a, ex * cos_b + ey * sin_b
            active += 1
    return active


@borrowing
def _split_azimuths(active: int, columns: FaceColumns, work: _Work) -> int:
    """Fills `work.splits`: azimuths from a to b between which no slope crosses another or a column's end; how many."""
    a, b, tx, ty = columns.a, columns.b, columns.tx, columns.ty
    slope, splits = work.slope, work.splits
    cos_a, sin_a, cos_b, sin_b = columns.cos_a, columns.sin_a, columns.cos_b, columns.sin_b
    splits[0], splits[1], n_splits = a, b, 2
    largest = 1.0 + (abs(columns.z0) + abs(columns.z1)) * (abs(tx) + abs(ty))
    for i in range(active):
        for k in range(4):
            largest = max(largest, abs(slope[k, i]))
    if _crosses_none(2 * active, columns, _APART * largest, work):
        return n_splits
    for i in range(active):
        for edge in range(2):
            gx, gy = slope[2 * edge, i], slope[2 * edge + 1, i]
            for other in range(-2, 2 * active):
                if other < 0:
                    z = columns.z0 if other == -2 else columns.z1
                    hx, hy = z * tx, z * ty
                elif other // 2 <= i:
                    continue
                else:
                    hx, hy = slope[2 * (other % 2), other // 2], slope[2 * (other % 2) + 1, other // 2]
                angle = _equal_at(gx - hx, gy - hy, a, b, cos_a, sin_a, cos_b, sin_b)
                if angle > a and n_splits < _MAX_PIECES:
                    n_splits = _insert_sorted(splits, n_splits, angle)
    return n_splits


@nb.njit(inline="always")
def _crosses_none(count: int, columns: FaceColumns, least: float, work: _Work) -> bool:
    """Whether slopes and column ends surely have one order at both azimuths, `least` apart, so that none crosses."""
    face_a = columns.tx * columns.cos_a + columns.ty * columns.sin_a
    face_b = columns.tx * columns.cos_b + columns.ty * columns.sin_b
    low, high, n = work.sorted[0], work.sorted[1], 0
    for k in range(-2, count):
        z = columns.z0 if k == -2 else columns.z1
        at_a, at_b = (work.slope_at[0, k], work.slope_at[1, k]) if k >= 0 else (z * face_a, z * face_b)
        j = n
        while j > 0 and low[j - 1] > at_a:
            low[j], high[j] = low[j - 1], high[j - 1]
            j -= 1
        low[j], high[j] = at_a, at_b
        n += 1
        if (j > 0 and high[j - 1] + least > at_b) or (j + 1 < n and at_b + least > high[j + 1]):
            return False
    apart = True
    for k in range(1, n):
        apart &= low[k - 1] + least <= low[k]
    return apart


@nb.njit(inline="always")
def _open_share(active: int, columns: FaceColumns, theta: float, work: _Work) -> float:
    """The share of the column at azimuth `theta` that is not covered: 1 less the union of the bodies' intervals."""
    slope, low, high, z0, height = work.slope, work.low, work.high, columns.z0, columns.z1 - columns.z0
    ux, uy = np.cos(theta), np.sin(theta)
    inverse = columns.tx * ux + columns.ty * uy
    for i in range(active):  # apart from what follows, so that it is compiled to work on several at once
        work.interval[0, i] = ((slope[0, i] * ux + slope[1, i] * uy) / inverse - z0) / height
        work.interval[1, i] = ((slope[2, i] * ux + slope[3, i] * uy) / inverse - z0) / height
    left, reach = 1.0, 0.0
    n_covered = 0
    for i in range(active):
        first, last = max(work.interval[0, i], 0.0), min(work.interval[1, i], 1.0)
        if last <= first:
            continue
        if first == 0.0:  # before all others
            if last > reach:
                left -= last - reach
                reach = last
            continue
        j = n_covered
        while j > 0 and low[j - 1] > first:
            low[j], high[j] = low[j - 1], high[j - 1]
            j -= 1
        low[j], high[j] = first, last
        n_covered += 1
    for i in range(n_covered):
        if high[i] > reach:
            left -= high[i] - max(low[i], reach)
            reach = high[i]
    return left
