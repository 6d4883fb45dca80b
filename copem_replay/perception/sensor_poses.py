"""Perception units: where each one is at each of its lists."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from copem_replay.core.interpolation import at_instants, wrap
from copem_replay.core.text import counted
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Scene, Solid, Tracks
from copem_replay.perception.config import Obstacle, PerceptionSetup, Placement
from copem_replay.perception.visibility import NO_STATICS, Observers, Statics, statics

FAR_GROUND_M = 50.0
"""Ground that is taken from an object farther away is said (chosen: beyond, it is wrong by 2 m and more on slopes)."""
BELOW_GROUND_M = 20.0
"""What stands on the ground hides from so far below it (chosen): nobody sees under it where the ground falls away."""
TOUCHES_M = 1e-6
"""A unit less deep in a solid leans on it (the kernel's)."""
_NAMED = 5  # solids, and objects in each, that a note names (chosen)


@dataclass(frozen=True)
class UnitPoses:
    """One unit at the instants of its lists. All (F,); NaN under `present == False`."""

    x_m: Float
    y_m: Float
    z_m: Float  # of the sensor itself
    heading_rad: Float
    present: Bool
    ground_m: Float  # under it


@dataclass(frozen=True)
class SensorPoses:
    """All modelled units at each of their lists, in the experiment's order, and the solids around them."""

    stamps_ns: dict[str, Int]  # (F,) captures
    poses: dict[str, UnitPoses]
    carrier_ix: dict[str, int]  # −1: a fixed place
    solids: tuple[Solid, ...]
    static: Statics  # the same, for visibility: body k is solid k
    notes: tuple[str, ...]


def place(scene: Scene, truth: Tracks, experiment: PerceptionSetup) -> SensorPoses:
    """Where the units of an experiment are over one log (`truth`: the world at its own frames)."""
    far_m: dict[str, float] = {}
    solids = solids_of(scene, truth, experiment.obstacles, far_m)
    stamps: dict[str, Int] = {}
    there: dict[str, UnitPoses] = {}
    carriers = {name: carrier(scene, unit) for name, unit in experiment.modelled.items()}
    for name, unit in experiment.modelled.items():
        stamps[name] = list_instants(scene, truth, unit)
        host = truth.take_tracks(truth.object_ix == carriers[name])
        if unit.rate_hz is not None:
            host = at_instants(host, stamps[name], t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
        there[name] = poses(scene, unit, host, unit_ground(truth, name, unit, far_m))
    notes = (*_far_grounds(far_m), *_objects_inside(scene, truth, solids))
    return SensorPoses(stamps, there, carriers, solids, statics_of(solids), notes)


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


def poses(scene: Scene, unit: Placement, world: Tracks, ground_m: float) -> UnitPoses:
    """Where a unit is at each list of `world`, which holds its carrier at the unit's list instants."""
    n = len(world.stamp_ns)
    if unit.at is not None:
        heading = np.full(n, wrap(np.deg2rad(np.array(unit.yaw_deg))))
        assert unit.height_m is not None  # the experiment says so
        x, y, z = (np.full(n, v) for v in (*unit.at, ground_m + unit.height_m))
        ground = np.full(n, ground_m)
        x, y = moved(x, y, heading, unit.offset_m)
        present = np.ones(n, dtype=bool)
    else:
        x, y, z, yaw, ground = (np.full(n, np.nan) for _ in range(5))
        rows = np.flatnonzero(world.row_object_ix == carrier(scene, unit))
        at = world.frame_ix[rows]
        present = np.zeros(n, dtype=bool)
        present[at] = True
        x[at], y[at], yaw[at] = world.x_m[0, rows], world.y_m[0, rows], world.yaw_rad[0, rows]
        height_m = world.height_m[0, rows] if unit.height_m is None else unit.height_m  # on the roof
        ground[at] = world.z_m[0, rows] - world.height_m[0, rows] / 2
        z[at] = ground[at] + height_m
        x, y = moved(x, y, yaw, unit.offset_m)
        heading = wrap(yaw + np.deg2rad(unit.yaw_deg))
    return UnitPoses(x, y, z, heading, present, ground)


def moved(x_m: Float, y_m: Float, heading_rad: Float, offset_m: tuple[float, float]) -> tuple[Float, Float]:
    """Places (K,) moved forward and to the left of their headings."""
    forward, left = offset_m
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return x_m + cos * forward - sin * left, y_m + sin * forward + cos * left


def observers(places: Sequence[UnitPoses], carriers: Int) -> Observers:
    """Units at the lists of one world, as visibility wants them; `carriers (U,)` object indices."""
    return Observers(
        np.stack([np.stack([p.x_m, p.y_m, p.z_m], axis=-1) for p in places]),
        np.stack([p.present for p in places]),
        carriers,
    )


def mounting_height(scene: Scene, truth: Tracks, unit: Placement) -> float:
    """Metres a unit is above the ground: as given, or the height of its carrier when that first appears."""
    if unit.height_m is not None:
        return unit.height_m
    return float(truth.height_m[0, np.flatnonzero(truth.row_object_ix == carrier(scene, unit))[0]])


def carrier(scene: Scene, unit: Placement) -> int:
    """Index of the object that carries a unit, −1 for a fixed place."""
    if unit.on is None:
        return -1
    return scene.ego_ix if unit.on == "ego" else scene.object_number[str(unit.on)]


def ground_at(truth: Tracks, corners: Float) -> tuple[float, float]:
    """Box bottom of the object state nearest to a place (1, 2) or to a polygon (K, 2), and how far (m) that one is.

    z = 0 where there is no object at all.
    """
    import shapely

    if not len(truth.frame_ix):
        return 0.0, np.inf
    near = _may_be_nearest(truth.x_m[0], truth.y_m[0], corners)
    place = shapely.Point(corners[0]) if len(corners) == 1 else shapely.Polygon(corners)
    distance = shapely.distance(place, shapely.points(truth.x_m[0, near], truth.y_m[0, near]))
    nearest = near[np.argmin(distance)]
    return float(truth.z_m[0, nearest] - truth.height_m[0, nearest] / 2), float(distance.min())


def _may_be_nearest(x_m: Float, y_m: Float, corners: Float) -> Int:
    """Which states (R,) to ask: those whose distance from the corners' bounds is within the least from a corner.

    To build a geometry of each state takes most of the time, and most are farther away.
    """
    (west, south), (east, north) = corners.min(axis=0), corners.max(axis=0)
    outside = np.hypot(
        np.maximum(np.maximum(west - x_m, x_m - east), 0), np.maximum(np.maximum(south - y_m, y_m - north), 0)
    )
    reach = min(float(np.hypot(x_m - x, y_m - y).min()) for x, y in corners)
    near = np.flatnonzero(outside <= reach * (1 + 1e-9))
    return near if len(near) else np.arange(len(x_m))


def unit_ground(truth: Tracks, name: str, unit: Placement, far_m: dict[str, float] | None = None) -> float:
    """Ground under a fixed unit; 0 for a carried one, which brings its own.

    `far_m` gets how far the object is whose ground it is, by the unit, where that is far.
    """
    if unit.at is None:
        return 0.0
    return _ground(truth, unit.ground_z_m, np.array([unit.at]), f"unit {name}", far_m)


def solids_of(
    scene: Scene, truth: Tracks, obstacles: tuple[Obstacle, ...], far_m: dict[str, float] | None = None
) -> tuple[Solid, ...]:
    """The experiment's obstacles on their ground, then what the log has of its own. `far_m`: as in `unit_ground`."""
    return (*(_solid(truth, k, obstacle, far_m) for k, obstacle in enumerate(obstacles)), *scene.solids)


def _solid(truth: Tracks, k: int, obstacle: Obstacle, far_m: dict[str, float] | None = None) -> Solid:
    name, given_m = f"obstacle {k}", obstacle.ground_z_m
    ground_m = _ground(truth, given_m, np.array(obstacle.polygon_m), name, far_m)
    return Solid(name, obstacle.polygon_m, ground_m, obstacle.height_m, on_ground=given_m is None)


def statics_of(solids: Sequence[Solid]) -> Statics:
    """What solids hide, as visibility wants it."""
    if not solids:
        return NO_STATICS
    outlines, bottoms_m, heights_m = zip(
        *((np.array(s.corners_m), s.bottom_m, s.height_m) for s in solids), strict=True
    )
    static = statics(outlines, bottoms_m, heights_m)
    return static._replace(bottom_m=np.array([_hides_from_m(solid) for solid in solids])[static.body])


def _hides_from_m(solid: Solid) -> float:
    return solid.bottom_m - BELOW_GROUND_M if solid.on_ground else solid.bottom_m


def solid_around(
    scene: Scene, truth: Tracks, unit: Placement, obstacles: tuple[Obstacle, ...]
) -> tuple[Solid, float] | None:
    """The solid that a fixed unit is in, and how far (m) from its nearest face; None: it is in none."""
    import shapely

    if unit.at is None or unit.height_m is None:
        return None
    x, y = moved(np.array(unit.at[0]), np.array(unit.at[1]), np.array(np.deg2rad(unit.yaw_deg)), unit.offset_m)
    place = shapely.Point(float(x), float(y))

    def depth_m(corners_m: Sequence[tuple[float, float]]) -> float:
        outline = shapely.Polygon(corners_m)
        return float(outline.exterior.distance(place)) if outline.contains(place) else 0.0

    of_experiment = (_solid(truth, k, one) for k, one in enumerate(obstacles) if depth_m(one.polygon_m) > TOUCHES_M)
    for solid in (*of_experiment, *(one for one in scene.solids if depth_m(one.corners_m) > TOUCHES_M)):
        z = unit_ground(truth, "", unit) + unit.height_m
        if _hides_from_m(solid) + TOUCHES_M < z < solid.top_m - TOUCHES_M:
            return solid, depth_m(solid.corners_m)
    return None


def _ground(truth: Tracks, given_m: float | None, corners: Float, what: str, far_m: dict[str, float] | None) -> float:
    if given_m is not None:
        return given_m
    ground_m, distance_m = ground_at(truth, corners)
    if far_m is not None and distance_m > FAR_GROUND_M:
        far_m[what] = distance_m
    return ground_m


def _far_grounds(far_m: Mapping[str, float]) -> list[str]:
    """One note on all whose ground is that of an object far away."""
    if not far_m:
        return []
    first, others = next(iter(far_m)), len(far_m) - 1
    whose = first + (f" and {counted(others, 'other')}" if others else "")
    up_to = "up to " if others else ""
    away = f"{up_to}{max(far_m.values()):.0f} m away"
    return [f"{whose}: ground taken from the nearest object, {away} (give ground_z_m)"]


def _objects_inside(scene: Scene, truth: Tracks, solids: Sequence[Solid]) -> list[str]:
    """One note on the objects whose centres are in solids at times."""
    import shapely

    if not solids:
        return []
    outlines = shapely.polygons([shapely.linearrings(solid.corners_m) for solid in solids])
    x, y, z = truth.x_m[0], truth.y_m[0], truth.z_m[0]
    west, south, east, north = shapely.total_bounds(outlines)
    near = np.flatnonzero((x >= west) & (x <= east) & (y >= south) & (y <= north))
    at, of = shapely.STRtree(outlines).query(shapely.points(x[near], y[near]), predicate="within")
    row, heights = near[at], np.array([(_hides_from_m(solid), solid.top_m) for solid in solids])
    within = (heights[of, 0] < z[row]) & (z[row] < heights[of, 1])
    row, of = row[within], of[within]
    step_s = float(np.median(np.diff(truth.captured_s))) if len(truth.captured_s) > 1 else 0.0
    said = []
    for k in np.unique(of).tolist():
        rows = row[of == k]
        ids = [scene.object_ids[n] for n in np.unique(truth.row_object_ix[rows])]
        more = f" and {counted(len(ids) - _NAMED, 'other')}" if len(ids) > _NAMED else ""
        who = f"{'object' if len(ids) == 1 else 'objects'} {', '.join(ids[:_NAMED])}{more}"
        verb = "is" if len(ids) == 1 else "are"
        said.append(f"{solids[k].name}: {who} {verb} inside it for {len(rows) * step_s:.1f} s: hidden there")
    if len(said) > _NAMED:
        said[_NAMED:] = [f"so are objects in {counted(len(said) - _NAMED, 'other')}"]
    return ["; ".join(said)] if said else []
