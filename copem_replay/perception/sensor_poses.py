"""Perception units: where each one is at each of its lists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from copem_replay.core.interpolation import at_instants, wrap
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Scene, Tracks
from copem_replay.perception.config import Obstacle, PerceptionSetup, Placement
from copem_replay.perception.visibility import NO_STATICS, Observers, Statics, statics

GROUND_WITHIN_M = 50.0
"""How far the nearest object may be whose ground is taken for a fixed place (the contract's)."""


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
    """All modelled units at each of their lists, in the experiment's order, and the static obstacles around them."""

    stamps_ns: dict[str, Int]  # (F,) captures
    poses: dict[str, UnitPoses]
    carrier_ix: dict[str, int]  # −1: a fixed place
    static: Statics
    notes: tuple[str, ...]


def place(scene: Scene, truth: Tracks, experiment: PerceptionSetup) -> SensorPoses:
    """Where the units of an experiment are over one log (`truth`: the world at its own frames)."""
    notes: list[str] = []
    static = place_obstacles(truth, experiment.obstacles, notes)
    stamps: dict[str, Int] = {}
    there: dict[str, UnitPoses] = {}
    carriers = {name: carrier(scene, unit) for name, unit in experiment.modelled.items()}
    for name, unit in experiment.modelled.items():
        stamps[name] = list_instants(scene, truth, unit)
        host = truth.take_tracks(truth.object_ix == carriers[name])
        if unit.rate_hz is not None:
            host = at_instants(host, stamps[name], t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
        there[name] = poses(scene, unit, host, unit_ground(truth, name, unit, notes))
    return SensorPoses(stamps, there, carriers, static, tuple(notes))


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


def ground_at(truth: Tracks, corners: Float) -> float | None:
    """Box bottom of the object state nearest to a place (1, 2) or to a polygon (K, 2); None beyond 50 m."""
    import shapely

    if not len(truth.frame_ix):
        return None
    near = _may_be_nearest(truth.x_m[0], truth.y_m[0], corners)
    place = shapely.Point(corners[0]) if len(corners) == 1 else shapely.Polygon(corners)
    distance = shapely.distance(place, shapely.points(truth.x_m[0, near], truth.y_m[0, near]))
    nearest = near[np.argmin(distance)]
    if distance.min() > GROUND_WITHIN_M:
        return None
    return float(truth.z_m[0, nearest] - truth.height_m[0, nearest] / 2)


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


def unit_ground(truth: Tracks, name: str, unit: Placement, notes: list[str]) -> float:
    """Ground under a fixed unit; 0 for a carried one, which brings its own. What was assumed goes to `notes`."""
    if unit.at is None:
        return 0.0
    return _ground(truth, unit.ground_z_m, np.array([unit.at]), f"unit {name}", notes)


def place_obstacles(truth: Tracks, obstacles: tuple[Obstacle, ...], notes: list[str]) -> Statics:
    """The experiment's static obstacles on their ground."""
    if not obstacles:
        return NO_STATICS
    polygons = [np.array(o.polygon_m) for o in obstacles]
    grounds = [
        _ground(truth, o.ground_z_m, polygon, f"obstacle {k}", notes)
        for k, (o, polygon) in enumerate(zip(obstacles, polygons, strict=True))
    ]
    return statics(polygons, grounds, [o.height_m for o in obstacles])


def _ground(truth: Tracks, given_m: float | None, corners: Float, unit: str, notes: list[str]) -> float:
    if given_m is not None:
        return given_m
    found = ground_at(truth, corners)
    if found is None:
        notes.append(f"{unit}: no object within {GROUND_WITHIN_M:g} m, ground taken as z = 0 (give ground_z_m)")
        return 0.0
    return found
