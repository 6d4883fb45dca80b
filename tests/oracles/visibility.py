"""The visible share of a box, computed the plain way: what the fast code of the package is held against.

Contract, to the letter.  `surface`: seen from the unit, uniform in azimuth over the target's angular extent;
at each azimuth the share of the column of the target's nearest face, bottom to top, that no body in front of
it covers.  A box whose footprint overlaps the target's does not hide it; a solid hides along every ray on which
it begins before the target does.  A unit inside the target's footprint sees 1; a unit inside another body,
between its bottom and its top, ignores that body.  `flat`: the same with infinitely high bodies.

Bodies are upright prisms: a simple footprint polygon, (K, 2) metres in either turning sense and not closed,
with a bottom and a top.  `flat_share` asks Shapely, `surface_share` intersects rays with edges in numpy, so
the two share nothing but the rules about who is inside whom and can be held against each other as well.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt
import shapely

Array = npt.NDArray[np.float64]
Prism = tuple[npt.ArrayLike, float, float]
"""Footprint, bottom, top."""

OVERLAP_M2 = 1e-9  # less common area than this is rounding, and counts as touching
SAME_PLACE_M = 1e-9  # two distances along a ray closer than this are the same point
NARROWEST_RAD = 1e-12  # a slice of azimuth thinner than this weighs nothing, and its mid ray may miss the target
GAP_M = 0.05  # what random bodies keep between each other


class Body(TypedDict):
    """One prism of a random scene."""

    polygon: Array
    z0: float
    z1: float
    static: bool


# --------------------------------------------------------------------------------------- the rules


def _overlaps(a: shapely.Polygon, b: shapely.Polygon) -> bool:
    return bool(shapely.intersection(a, b).area > OVERLAP_M2)


def _can_hide(observer: shapely.Point, target: shapely.Polygon, other: shapely.Polygon, solid: bool = False) -> bool:
    # `contains` is strict: a unit leaning against a wall from outside still has the wall in front of it.
    return (solid or not _overlaps(target, other)) and not other.contains(observer)


def _relative_azimuths(observer_xy: Array, points: Array, bearing: float) -> Array:
    """Azimuths of points in (−π, π], counted from the bearing."""
    delta = points - observer_xy
    angle = np.arctan2(delta[:, 1], delta[:, 0]) - bearing
    return np.arctan2(np.sin(angle), np.cos(angle))


def _angular_extent(observer_xy: Array, target: Array) -> tuple[float, float, float]:
    """Bearing of the target, and the first and the last azimuth of it counted from that bearing."""
    shape = shapely.Polygon(target)
    # Only from outside the convex hull is the extent one interval narrower than π, which cannot wrap.
    # For a box that is all of the outside.
    if shape.convex_hull.contains(shapely.Point(observer_xy)):
        raise ValueError("the observer stands in a notch of the target: its angular extent is not defined here")
    middle = np.array([shape.centroid.x, shape.centroid.y]) - observer_xy
    bearing = math.atan2(middle[1], middle[0])
    azimuths = _relative_azimuths(observer_xy, target, bearing)
    return bearing, float(azimuths.min()), float(azimuths.max())


# -------------------------------------------------------------------------------------------- flat


def flat_share(
    observer_xy: npt.ArrayLike,
    target_polygon: npt.ArrayLike,
    other_polygons: Sequence[npt.ArrayLike],
    solids: Sequence[npt.ArrayLike] = (),
) -> float:
    """Visible share with infinitely high bodies; exact but for rounding (about 1e-9).

    Whether a body is in front of the target changes only at the azimuth of a vertex, or of a place where the
    outline of a solid meets that of the target: boxes that overlap the target are out.  Between two neighbouring
    ones of these one ray speaks for all of them.
    """
    here = np.asarray(observer_xy, dtype=float)[:2]
    target = np.asarray(target_polygon, dtype=float)
    point, target_shape = shapely.Point(here), shapely.Polygon(target)
    if target_shape.intersects(point):
        return 1.0
    shapes = [shapely.Polygon(np.asarray(other, dtype=float)) for other in other_polygons]
    shapes = [shape for shape in shapes if _can_hide(point, target_shape, shape)]
    solid_shapes = [shapely.Polygon(np.asarray(solid, dtype=float)) for solid in solids]
    shapes += [shape for shape in solid_shapes if _can_hide(point, target_shape, shape, solid=True)]

    bearing, first, last = _angular_extent(here, target)
    meetings = [target_shape.boundary.intersection(shape.boundary) for shape in shapes]
    vertices = np.vstack([target, *(shapely.get_coordinates(shape) for shape in [*shapes, *meetings])])
    azimuths = _relative_azimuths(here, vertices, bearing)
    cuts = np.unique(np.clip(azimuths, first, last))
    reach = 1.0 + 2.0 * float(np.linalg.norm(target - here, axis=1).max())

    seen = total = 0.0
    for left, right in itertools.pairwise(cuts):
        if right - left < NARROWEST_RAD:
            continue
        azimuth = bearing + (left + right) / 2.0
        way = np.array([math.cos(azimuth), math.sin(azimuth)])
        ray = shapely.LineString([here, here + reach * way])
        to_target = point.distance(ray.intersection(target_shape))
        sight = shapely.LineString([here, here + to_target * way])
        total += right - left
        # A positive length: a body the observer leans on, with its back to it, is touched but not entered.
        if not any(sight.intersection(shape).length > SAME_PLACE_M for shape in shapes):
            seen += right - left
    return float(seen / total)


# ----------------------------------------------------------------------------------------- surface


def _chords(here: Array, directions: Array, polygon: Array) -> tuple[Array, Array]:
    """Where each of A rays enters and leaves a footprint: two (A, C) arrays, infinite where no chord is.

    A straight line leaves a simple polygon as often as it enters it, so its crossings, sorted, come in pairs.
    """
    relative = polygon - here
    along = directions @ relative.T
    across = directions[:, :1] * relative[:, 1] - directions[:, 1:] * relative[:, 0]
    along_next, across_next = np.roll(along, -1, axis=1), np.roll(across, -1, axis=1)
    # A vertex on the line belongs to its left side: each crossing is counted once, the number stays even.
    crosses = (across >= 0.0) != (across_next >= 0.0)
    fraction = np.divide(across, across - across_next, out=np.zeros_like(across), where=crosses)
    distance = np.where(crosses, along + fraction * (along_next - along), np.inf)
    distance.sort(axis=1)
    if distance.shape[1] % 2:
        distance = distance[:, :-1]  # the crossings are even in number: the last of an odd row is infinite
    near, far = distance[:, 0::2], distance[:, 1::2]
    # A chord lies wholly ahead or wholly behind, up to rounding on the boundary, or goes through the observer, who
    # is above or below the body: it begins at once.
    ahead = far > SAME_PLACE_M
    return np.where(ahead, np.maximum(near, SAME_PLACE_M), np.inf), np.where(ahead, far, np.inf)


def _covered_length(low: Array, high: Array) -> Array:
    """Length of the union of the intervals of each row; an interval with high <= low is empty."""
    order = np.argsort(low, axis=1)
    low, high = np.take_along_axis(low, order, axis=1), np.take_along_axis(high, order, axis=1)
    done = np.full(len(low), -np.inf)  # everything covered so far ends here
    total = np.zeros(len(low))
    for column in range(low.shape[1]):
        total += np.maximum(high[:, column] - np.maximum(low[:, column], done), 0.0)
        done = np.maximum(done, high[:, column])
    return total


def surface_share(
    observer_xyz: npt.ArrayLike,
    target: Prism,
    others: Sequence[Prism],
    azimuths: int = 2000,
    solids: Sequence[Prism] = (),
) -> float:
    """Visible share with the heights of the bodies, by dense sampling of the azimuth.

    Each column is exact, so the only error is that of the azimuth: each silhouette edge is misplaced by half
    a step at most, which is .5 / azimuths of the share (2.5e-4 with 2000).  Over 960 views of random scenes,
    against 100 000 azimuths and against `flat_share`: 2e-5 in the mean, 2.5e-4 at the 99th percentile and
    6e-4 at the worst.
    """
    place = np.asarray(observer_xyz, dtype=float)
    here, eye = place[:2], float(place[2])
    footprint, bottom, top = np.asarray(target[0], dtype=float), float(target[1]), float(target[2])
    if not top > bottom:
        raise ValueError("a target without height has no column")
    point, target_shape = shapely.Point(here), shapely.Polygon(footprint)
    if target_shape.intersects(point):
        return 1.0

    bearing, first, last = _angular_extent(here, footprint)
    angles = bearing + first + (last - first) * (np.arange(azimuths) + 0.5) / azimuths
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    to_target = _chords(here, directions, footprint)[0][:, :1]
    assert np.isfinite(to_target).all(), "every azimuth within the extent meets the target"

    lows, highs = [np.zeros((azimuths, 1))], [np.zeros((azimuths, 1))]  # an empty interval: nothing hides
    for k, (polygon, body_bottom, body_top) in enumerate([*others, *solids]):
        polygon = np.asarray(polygon, dtype=float)
        shape, solid = shapely.Polygon(polygon), k >= len(others)
        if not solid and _overlaps(target_shape, shape):
            continue
        if shape.contains(point) and body_bottom <= eye <= body_top:
            continue
        near, far = _chords(here, directions, polygon)
        in_front = near < to_target - SAME_PLACE_M
        near, far = np.where(in_front, near, to_target), np.minimum(far, to_target)
        # At distance d the sight line to height z of the column is at height eye + (z − eye)·d/d_T.  It is
        # straight, so it misses the body only by being above the top, or below the bottom, at both ends of
        # the chord.  Seen from the eye, these ends are cast onto the column at these heights:
        bottoms = [eye + (body_bottom - eye) * to_target / end for end in (near, far)]
        tops = [eye + (body_top - eye) * to_target / end for end in (near, far)]
        low, high = np.minimum(*bottoms), np.maximum(*tops)
        lows.append(np.clip(low, bottom, top))
        highs.append(np.where(in_front, np.clip(high, bottom, top), -np.inf))
    covered = _covered_length(np.hstack(lows), np.hstack(highs))
    return float(1.0 - covered.mean() / (top - bottom))


# ---------------------------------------------------------------------------------- random scenes

# Length, width, height in metres, and how often.
_KINDS = (((0.5, 0.5, 1.8), 0.35), ((4.5, 1.9, 1.5), 0.45), ((10.0, 2.5, 3.5), 0.20))


def rectangle(x: float, y: float, length: float, width: float, yaw: float = 0.0) -> Array:
    """Footprint of a box: its centre, its sizes along and across its heading, counter-clockwise."""
    corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) * [length / 2.0, width / 2.0]
    return _placed(corners, x, y, yaw)


def _placed(polygon: Array, x: float, y: float, yaw: float) -> Array:
    c, s = math.cos(yaw), math.sin(yaw)
    return polygon @ np.array([[c, s], [-s, c]]) + [x, y]


def _in_disc(rng: np.random.Generator, radius_m: float) -> tuple[float, float]:
    radius, angle = radius_m * math.sqrt(rng.random()), rng.uniform(-math.pi, math.pi)
    return radius * math.cos(angle), radius * math.sin(angle)


def _random_building(rng: np.random.Generator) -> Array:
    if rng.random() < 0.5:
        corners = int(rng.integers(4, 8))
        angles = 2.0 * math.pi * (np.arange(corners) + rng.uniform(-0.3, 0.3, corners)) / corners
        # Points of an ellipse in the order of their angle make a convex polygon.
        return np.column_stack([np.cos(angles), np.sin(angles)]) * rng.uniform(3.0, 7.0, 2)
    (a, b), (p, q) = rng.uniform(6.0, 14.0, 2), rng.uniform(2.5, 4.0, 2)
    ell = np.array([[0.0, 0.0], [a, 0.0], [a, p], [q, p], [q, b], [0.0, b]])
    return ell - [a / 2.0, b / 2.0]


def random_scene(rng: np.random.Generator, boxes: int = 12, radius_m: float = 40.0, static: int = 2) -> list[Body]:
    """Disjoint bodies on flat ground with their centres in a disc around the origin; boxes first."""
    wanted: list[tuple[Array, float, bool]] = []
    for _ in range(static):  # the big ones are placed first, while there is room
        wanted.append((_random_building(rng), float(rng.uniform(3.0, 8.0)), True))
    for kind in rng.choice(len(_KINDS), size=boxes, p=[share for _, share in _KINDS]):
        length, width, height = np.array(_KINDS[kind][0]) * rng.uniform(0.9, 1.1, 3)
        wanted.append((rectangle(0.0, 0.0, length, width), float(height), False))

    bodies: list[Body] = []
    shapes: list[shapely.Polygon] = []
    for outline, height, is_static in wanted:
        for _ in range(10_000):
            x, y = _in_disc(rng, radius_m)
            polygon = _placed(outline, x, y, rng.uniform(-math.pi, math.pi))
            shape = shapely.Polygon(polygon)
            if all(shape.distance(other) > GAP_M for other in shapes):
                break
        else:
            raise ValueError(f"no room for {boxes} boxes and {static} static bodies within {radius_m} m")
        shapes.append(shape)
        bodies.append({"polygon": polygon, "z0": 0.0, "z1": height, "static": is_static})
    return bodies[static:] + bodies[:static]


def random_observer(rng: np.random.Generator, bodies: Sequence[Body], height_m: float, radius_m: float = 40.0) -> Array:
    """Place (x, y, z) in the disc that is outside all footprints."""
    shapes = [shapely.Polygon(body["polygon"]) for body in bodies]
    for _ in range(10_000):
        x, y = _in_disc(rng, radius_m)
        if all(shape.distance(shapely.Point(x, y)) > GAP_M for shape in shapes):
            return np.array([x, y, height_m])
    raise ValueError("the disc is full")


def prism(body: Body | dict[str, Any]) -> Prism:
    """The body of a random scene as `surface_share` takes it."""
    return body["polygon"], body["z0"], body["z1"]
