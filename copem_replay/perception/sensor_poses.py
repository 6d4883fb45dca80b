"""Sensor poses: where each unit is at each of its lists, the ground it stands on, and the solids around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.errors import count_noun
from copem_replay.core.interpolation import interpolate_at_instants, wrap_angles
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Scene, Solid, Tracks, outline_solids
from copem_replay.perception.config import Obstacle, PerceptionSetup, Placement
from copem_replay.perception.pem.condition import Couple
from copem_replay.perception.visibility import NO_STATICS, Observers, Statics, make_statics

FAR_GROUND_M = 50.0
"""A note names ground that is taken from an object farther away than this: it is wrong by 2 m on a slope of 4 %."""
BELOW_GROUND_M = 20.0
"""A solid on the ground begins so far below it, so that no unit sees under it where the ground falls away."""
TOUCHES_M = 1e-6
"""A unit less deep in a solid only leans on it, as in the visibility kernel."""
_NAMED = 5
"""Solids, and objects in each, that a note names: it stays readable, and counts the others."""


@dataclass(frozen=True)
class UnitPoses:
    """One unit at the instants of its lists. All (F,); NaN under `present == False`."""

    x_m: Float
    y_m: Float
    z_m: Float  # of the sensor itself
    heading_rad: Float
    present: Bool
    ground_m: Float  # height of the ground under it


@dataclass(frozen=True)
class SensorPoses:
    """All modelled units at each of their lists, in the experiment's order, and the solids around them."""

    stamps_ns: dict[str, Int]  # (F,) captures
    poses: dict[str, UnitPoses]
    carrier_ix: dict[str, int]  # −1: a fixed place
    solids: tuple[Solid, ...]
    static: Statics  # the solids as visibility takes them: body k is solid k
    notes: tuple[str, ...]


def place_units(scene: Scene, truth: Tracks, experiment: PerceptionSetup) -> SensorPoses:
    """Where the units of an experiment are over one log (`truth`: the world at its own frames)."""
    far_m: dict[str, float] = {}
    solids = collect_solids(scene, truth, experiment.obstacles, far_m)
    stamps: dict[str, Int] = {}
    poses: dict[str, UnitPoses] = {}
    carriers = {name: find_carrier(scene, unit) for name, unit in experiment.modelled.items()}
    for name, unit in experiment.modelled.items():
        stamps[name] = list_instants(scene, truth, unit)
        host = truth.take_tracks(truth.object_ix == carriers[name])
        if unit.rate_hz is not None:
            host = interpolate_at_instants(host, stamps[name], t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
        poses[name] = compute_unit_poses(scene, unit, host, unit_ground(truth, name, unit, far_m))
    notes = (*_note_far_grounds(far_m), *_note_objects_inside(scene, truth, solids))
    return SensorPoses(stamps, poses, carriers, solids, make_solid_statics(solids), notes)


def list_instants(scene: Scene, truth: Tracks, unit: Placement) -> Int:
    """(F,) capture stamps of a unit's lists: the frames of the truth, or t0 + phase + k / rate within the log."""
    if unit.rate_hz is None:
        return truth.stamp_ns
    first_ns = unit.phase_s * 1e9
    period_ns = 1e9 / unit.rate_hz
    span_ns = scene.end_ns - scene.t0_ns + SAME_INSTANT_NS
    count = int(np.floor((span_ns - first_ns) / period_ns)) + 1 if span_ns >= first_ns else 0
    stamps: Int = scene.t0_ns + np.rint(first_ns + np.arange(count) * period_ns).astype(np.int64)
    return stamps


def compute_unit_poses(scene: Scene, unit: Placement, world: Tracks, ground_m: float) -> UnitPoses:
    """Where a unit is at each list of `world`, which holds its carrier at the unit's list instants."""
    n = len(world.stamp_ns)
    if unit.at is not None:
        heading = np.full(n, wrap_angles(np.deg2rad(np.array(unit.yaw_deg))))
        assert unit.height_m is not None  # the experiment is validated
        x, y, z = (np.full(n, v) for v in (*unit.at, ground_m + unit.height_m))
        ground = np.full(n, ground_m)
        x, y = offset_places(x, y, heading, unit.offset_m)
        present = np.ones(n, dtype=bool)
    else:
        x, y, z, yaw, ground = (np.full(n, np.nan) for _ in range(5))
        rows = np.flatnonzero(world.row_object_ix == find_carrier(scene, unit))
        present_at = world.frame_ix[rows]
        present = np.zeros(n, dtype=bool)
        present[present_at] = True
        x[present_at], y[present_at], yaw[present_at] = world.x_m[0, rows], world.y_m[0, rows], world.yaw_rad[0, rows]
        height_m = world.height_m[0, rows] if unit.height_m is None else unit.height_m  # on the roof
        ground[present_at] = world.z_m[0, rows] - world.height_m[0, rows] / 2
        z[present_at] = ground[present_at] + height_m
        x, y = offset_places(x, y, yaw, unit.offset_m)
        heading = wrap_angles(yaw + np.deg2rad(unit.yaw_deg))
    return UnitPoses(x, y, z, heading, present, ground)


def offset_places(x_m: Float, y_m: Float, heading_rad: Float, offset_m: tuple[float, float]) -> tuple[Float, Float]:
    """Places (K,) moved forward and to the left of their headings."""
    forward, left = offset_m
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return x_m + cos * forward - sin * left, y_m + sin * forward + cos * left


def make_observers(places: Sequence[UnitPoses], carriers: Int) -> Observers:
    """Units at the lists of one world, in the form that visibility takes; `carriers (U,)`: object indices, −1: none."""
    return Observers(
        np.stack([np.stack([p.x_m, p.y_m, p.z_m], axis=-1) for p in places]),
        np.stack([p.present for p in places]),
        carriers,
    )


def mounting_height(scene: Scene, truth: Tracks, unit: Placement) -> float:
    """Height (m) of a unit above the ground: as given, or the height of its carrier when that first appears."""
    if unit.height_m is not None:
        return unit.height_m
    return float(truth.height_m[0, np.flatnonzero(truth.row_object_ix == find_carrier(scene, unit))[0]])


def find_carrier(scene: Scene, unit: Placement) -> int:
    """Index of the object that carries a unit, −1 for a fixed place."""
    if unit.on is None:
        return -1
    return scene.ego_ix if unit.on == "ego" else scene.object_number[str(unit.on)]


def find_ground(truth: Tracks, corners: Float) -> tuple[float, float]:
    """Box bottom of the object state nearest to a place (1, 2) or to a polygon (K, 2), and how far (m) that one is.

    z = 0 where there is no object at all.
    """
    import shapely

    if not len(truth.frame_ix):
        return 0.0, np.inf
    near = _nearest_candidates(truth.x_m[0], truth.y_m[0], corners)
    place = shapely.Point(corners[0]) if len(corners) == 1 else shapely.Polygon(corners)
    distance = shapely.distance(place, shapely.points(truth.x_m[0, near], truth.y_m[0, near]))
    nearest = near[np.argmin(distance)]
    return float(truth.z_m[0, nearest] - truth.height_m[0, nearest] / 2), float(distance.min())


def find_grounds(truth: Tracks, outlines: Sequence[Any] | NDArray[np.object_]) -> tuple[Float, Float]:
    """As `find_ground`, of many outlines (K,), polygons as shapely has them: grounds (K,), distances (K,)."""
    import shapely

    grounds_m, far_m = np.zeros(len(outlines)), np.full(len(outlines), np.inf)
    if len(truth.frame_ix) and len(outlines):
        tree = shapely.STRtree(shapely.points(truth.x_m[0], truth.y_m[0]))
        (which, state), distance_m = tree.query_nearest(outlines, return_distance=True)
        order = np.lexsort((state, which))  # of equally near states the first
        which, first = np.unique(which[order], return_index=True)
        nearest, far_m[which] = state[order][first], distance_m[order][first]
        grounds_m[which] = truth.z_m[0, nearest] - truth.height_m[0, nearest] / 2
    return grounds_m, far_m


def _nearest_candidates(x_m: Float, y_m: Float, corners: Float) -> Int:
    """Indices (R,) of the states that may be nearest to a polygon: others are farther from its bounding box than one of
    these. (To build a geometry of a state takes most of the time.)
    """
    (west, south), (east, north) = corners.min(axis=0), corners.max(axis=0)
    box_distance_m = np.hypot(
        np.maximum(np.maximum(west - x_m, x_m - east), 0), np.maximum(np.maximum(south - y_m, y_m - north), 0)
    )
    reach = min(float(np.hypot(x_m - x, y_m - y).min()) for x, y in corners)
    near_states = np.flatnonzero(box_distance_m <= reach * (1 + 1e-9))
    return near_states if len(near_states) else np.arange(len(x_m))


def unit_ground(truth: Tracks, name: str, unit: Placement, far_m: dict[str, float] | None = None) -> float:
    """Ground under a fixed unit; 0 for a carried one, which brings its own.

    `far_m` gets the distance of the object whose ground is taken, under the unit's name, where it is far.
    """
    if unit.at is None:
        return 0.0
    return _ground_or_assumed(truth, unit.ground_z_m, np.array([unit.at]), f"unit {name}", far_m)


def collect_solids(
    scene: Scene, truth: Tracks, obstacles: tuple[Obstacle, ...], far_m: dict[str, float] | None = None
) -> tuple[Solid, ...]:
    """The experiment's obstacles on their ground, then the solids of the log. `far_m`: as in `unit_ground`."""
    return (*(_make_solid(truth, k, obstacle, far_m) for k, obstacle in enumerate(obstacles)), *scene.solids)


def _make_solid(truth: Tracks, k: int, obstacle: Obstacle, far_m: dict[str, float] | None = None) -> Solid:
    name, given_m = f"obstacle {k}", obstacle.ground_z_m
    ground_m = _ground_or_assumed(truth, given_m, np.array(obstacle.polygon_m), name, far_m)
    return Solid(name, obstacle.polygon_m, ground_m, obstacle.height_m, on_ground=given_m is None)


def make_solid_statics(solids: Sequence[Solid]) -> Statics:
    """Solids in the form that visibility takes."""
    if not solids:
        return NO_STATICS
    bottoms_m, heights_m = zip(*((solid.bottom_m, solid.height_m) for solid in solids), strict=True)
    static = make_statics(outline_solids(solids), bottoms_m, heights_m)
    return static._replace(bottom_m=np.array([_hides_from_m(solid) for solid in solids])[static.body])


def _hides_from_m(solid: Solid) -> float:
    """Height from which on a solid hides, above z = 0."""
    return solid.bottom_m - BELOW_GROUND_M if solid.on_ground else solid.bottom_m


def find_enclosing_solid(
    scene: Scene, truth: Tracks, unit: Placement, obstacles: tuple[Obstacle, ...]
) -> tuple[Solid, float] | None:
    """The solid around a fixed unit, and the unit's distance (m) from the nearest face; None: it is in none."""
    import shapely

    if unit.at is None or unit.height_m is None:
        return None
    x, y = offset_places(np.array(unit.at[0]), np.array(unit.at[1]), np.array(np.deg2rad(unit.yaw_deg)), unit.offset_m)
    place = shapely.Point(float(x), float(y))

    def is_around(solid: Solid) -> bool:
        """Whether it may hold the place, told without a polygon: of thousands hardly any does."""
        east, north = zip(*solid.corners_m, strict=True)
        return bool(min(east) <= x <= max(east) and min(north) <= y <= max(north))

    def depth_m(outline: shapely.Polygon) -> float:
        return float(outline.boundary.distance(place)) if outline.contains(place) else 0.0

    of_experiment = (
        _make_solid(truth, k, candidate)
        for k, candidate in enumerate(obstacles)
        if depth_m(shapely.Polygon(candidate.polygon_m)) > TOUCHES_M
    )
    for solid in (
        *of_experiment,
        *(candidate for candidate in scene.solids if is_around(candidate) and depth_m(candidate.outline) > TOUCHES_M),
    ):
        z = unit_ground(truth, "", unit) + unit.height_m
        if _hides_from_m(solid) + TOUCHES_M < z < solid.top_m - TOUCHES_M:
            return solid, depth_m(solid.outline)
    return None


def _ground_or_assumed(
    truth: Tracks, given_m: float | None, corners: Float, label: str, far_m: dict[str, float] | None
) -> float:
    """Ground of corners (K, 2): as given, or of the nearest object, noted in `far_m` as `label` where it is far."""
    if given_m is not None:
        return given_m
    ground_m, distance_m = find_ground(truth, corners)
    if far_m is not None and distance_m > FAR_GROUND_M:
        far_m[label] = distance_m
    return ground_m


def _note_far_grounds(far_m: Mapping[str, float]) -> list[str]:
    """One note on all units and obstacles whose ground is that of an object far away; no note where there are none."""
    if not far_m:
        return []
    first, others = next(iter(far_m)), len(far_m) - 1
    whose = first + (f" and {count_noun(others, 'other')}" if others else "")
    up_to = "up to " if others else ""
    distance = f"{up_to}{max(far_m.values()):.0f} m away"
    return [f"{whose}: ground taken from the nearest object, {distance} (give ground_z_m)"]


def _note_objects_inside(scene: Scene, truth: Tracks, solids: Sequence[Solid]) -> list[str]:
    """A note, at most, on objects whose centres are in solids at times, as they are hidden there."""
    import shapely

    if not solids:
        return []
    outlines = outline_solids(solids)
    x, y, z = truth.x_m[0], truth.y_m[0], truth.z_m[0]
    west, south, east, north = shapely.total_bounds(outlines)
    near_rows = np.flatnonzero((x >= west) & (x <= east) & (y >= south) & (y <= north))
    point, solid_ix = shapely.STRtree(outlines).query(shapely.points(x[near_rows], y[near_rows]), predicate="within")
    row, heights = near_rows[point], np.array([(_hides_from_m(solid), solid.top_m) for solid in solids])
    is_inside = (heights[solid_ix, 0] < z[row]) & (z[row] < heights[solid_ix, 1])
    row, solid_ix = row[is_inside], solid_ix[is_inside]
    step_s = float(np.median(np.diff(truth.captured_s))) if len(truth.captured_s) > 1 else 0.0
    clauses = []
    for k in np.unique(solid_ix).tolist():
        rows = row[solid_ix == k]
        ids = [scene.object_ids[n] for n in np.unique(truth.row_object_ix[rows])]
        more = f" and {count_noun(len(ids) - _NAMED, 'other')}" if len(ids) > _NAMED else ""
        objects = f"{'object' if len(ids) == 1 else 'objects'} {', '.join(ids[:_NAMED])}{more}"
        verb = "is" if len(ids) == 1 else "are"
        clauses.append(f"{solids[k].name}: {objects} {verb} inside it for {len(rows) * step_s:.1f} s: hidden there")
    if len(clauses) > _NAMED:
        clauses[_NAMED:] = [f"so are objects in {count_noun(len(clauses) - _NAMED, 'other')}"]
    return ["; ".join(clauses)] if clauses else []


# Outlines of the couples of a PEM in the unit's own frame, for drawing.

_ARC_STEP_RAD, _COARSE_STEP_RAD = np.deg2rad(3), np.deg2rad(9)
"""Chords of these angles are 3 and 25 cm off the arc at 80 m."""


def couple_outlines(pem: Sequence[Couple]) -> list[Float]:
    """Borders (K, 2) of the fields in which couples of a PEM apply, m, ahead along x; none for an unbounded field."""
    return [border for borders in _field_borders(pem) for border in borders]


def couple_polygons(pem: Sequence[Couple]) -> list[Float]:
    """These fields as coarse polygons (K, 2), counter-clockwise, the first corner once; a ring is cut open behind."""
    return [
        borders[0][:-1] if len(borders) == 1 else np.concatenate([borders[1], borders[0][::-1]])
        for borders in _field_borders(pem, _COARSE_STEP_RAD)
    ]


def _field_borders(pem: Sequence[Couple], step_rad: float = _ARC_STEP_RAD) -> list[list[Float]]:
    """The borders of each field: one, or of a ring the inner and the outer one."""
    fields = dict.fromkeys((c.when.range_m, c.when.azimuth_deg) for c in pem)
    return [_field_outline(range_m, azimuth, step_rad) for range_m, azimuth in fields if range_m is not None]


def _field_outline(
    range_m: tuple[float, float], azimuth_deg: tuple[float, float] | None, step_rad: float
) -> list[Float]:
    """Borders (K, 2) in m of a field of view: circles (one if it begins at 0), or one closed outline of a sector."""
    near_m, far_m = range_m
    first, last = np.deg2rad(azimuth_deg or (-180.0, 180.0))
    all_around = last - first >= 2 * np.pi - 1e-9
    span_rad = 2 * np.pi if all_around else np.mod(last - first, 2 * np.pi)
    angle = first + np.linspace(0, span_rad, int(np.ceil(span_rad / step_rad - 1e-9)) + 1)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    if all_around:
        return [radius_m * arc for radius_m in (near_m, far_m) if radius_m > 0]
    inner = near_m * (arc[::-1] if near_m > 0 else arc[:1])
    return [np.concatenate([inner[-1:], far_m * arc, inner])]
