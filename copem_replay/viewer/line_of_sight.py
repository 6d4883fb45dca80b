"""How the shown objects look from every modelled unit: in its field of view or not, and what hides them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from copem_replay.core.interpolation import AROUND_S, at_instants, wrap
from copem_replay.core.own_code import is_own
from copem_replay.core.tracks import Bool, Float, Int, Solid, Tracks
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.schema import Experiment, Unit
from copem_replay.perception.observation import Observations
from copem_replay.perception.pem.condition import Condition, Couple
from copem_replay.perception.sensor_poses import UnitPoses, carrier, observers, poses, unit_ground
from copem_replay.perception.visibility import VisibilityModel, hidden_by, visible_shares
from copem_replay.pipeline.chunking import ROWS_A_CHUNK
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.sink import f32

CLEAR_ABOVE = 0.5
"""Seen when more than this share of it is (chosen)."""


@dataclass(frozen=True)
class Sight:
    """At frames of the truth (K,), of objects (M,), from the experiment's units (U,), those that are modelled.

    `share`: NaN outside the unit's field of view, where it is absent, or carried by the object. `body_ix`: of what is
    not clearly seen the object that hides most of it, −1 − k: the solid k; `body_m` where that is.
    """

    elapsed_ns: Int
    object_ix: Int
    share: Float  # (U, K, M)
    in_range: Bool  # (U, K, M)
    body_ix: Int  # (U, K, M)
    body_m: Float  # (U, K, M, 3)
    solids: tuple[str, ...]  # their names
    place_m: Float  # (U, K, 3) of the unit


def sight(replay: Replay, experiment: Experiment, shown: Sequence[int], found: Observations | None = None) -> Sight:
    """Computed only at the frames at which one of the shown objects is there.

    `found`: rows of the shown objects, at least, bodies visible shares are known and need not be computed again.
    """
    scene, truth = replay.scene, replay.truth
    stamps = truth.stamp_ns[np.unique(truth.frame_ix[np.isin(truth.row_object_ix, shown)])]
    shape = (len(experiment.units), len(stamps), len(shown))
    seen = Sight(
        elapsed_ns=stamps - scene.t0_ns,
        object_ix=np.array(shown, dtype=np.int64),
        share=np.full(shape, np.nan),
        in_range=np.zeros(shape, dtype=bool),
        body_ix=np.zeros(shape, dtype=np.int64),
        body_m=np.full((*shape, 3), np.nan),
        solids=tuple(solid.name for solid in replay.placed.solids),
        place_m=np.full((*shape[:2], 3), np.nan),
    )
    centres = _centres(replay.placed.solids)
    known = _known_shares(seen, experiment, found, scene.t0_ns)
    # So many frames at once as have the rows of a time chunk: what hides an object is searched among all that is there.
    at_once = max(1, ROWS_A_CHUNK * len(truth.stamp_ns) // max(len(truth.frame_ix), 1))
    for first in range(0, len(stamps), at_once):
        _look_at(replay, experiment, seen, known, slice(first, first + at_once), centres)
    return seen


def _known_shares(seen: Sight, experiment: Experiment, found: Observations | None, t0_ns: int) -> Float:
    """(U, K, M) visible shares of the rows that units have captured at these very frames, NaN elsewhere."""
    known = np.full(seen.share.shape, np.nan)
    if found is None or not len(seen.object_ix):
        return known
    tracks = found.tracks
    numbers = {name: u for u, name in enumerate(experiment.units)}
    unit = np.array([numbers.get(name, -1) for name in tracks.units], dtype=np.int64)[tracks.row_unit_ix]
    captured_ns = tracks.stamp_ns[tracks.frame_ix] - t0_ns
    frame = np.minimum(np.searchsorted(seen.elapsed_ns, captured_ns), max(len(seen.elapsed_ns) - 1, 0))
    column = (tracks.row_object_ix[:, None] == seen.object_ix).argmax(axis=1)
    kept = np.flatnonzero((unit >= 0) & np.isin(tracks.row_object_ix, seen.object_ix))
    kept = kept[seen.elapsed_ns[frame[kept]] == captured_ns[kept]]
    known[unit[kept], frame[kept], column[kept]] = found.view.visible_share[kept]
    return known


def _look_at(
    replay: Replay, experiment: Experiment, seen: Sight, known: Float, part: slice, centres: np.ndarray
) -> None:
    """From all units at some of the frames. Out: their part of `seen`."""
    scene, shown = replay.scene, seen.object_ix.tolist()
    world = _world(replay, experiment, seen.elapsed_ns[part])
    rows, column = _rows(world, shown)
    if not len(rows):
        return
    frame = part.start + world.frame_ix[rows]
    for u, (name, unit) in enumerate(experiment.units.items()):
        if unit.recorded is not None:
            continue
        at = _poses(replay, name, unit, world)
        share = _shares(replay, experiment, unit, at, world, rows, known[u, frame, column])
        view = _view(at, world, rows, scene.object_class[world.row_object_ix[rows]])
        pem = experiment.pems[str(unit.pem)].couples
        in_field = _anywhere(pem, view, "range_m", "azimuth_deg", "classes")
        seen.place_m[u, part] = np.stack([at.x_m, at.y_m, at.z_m], axis=-1)
        seen.in_range[u, frame, column] = _anywhere(pem, view, "range_m")
        seen.share[u, frame, column] = np.where(in_field, share, np.nan)
        _hidden(replay, experiment, unit, at, seen, u, part, centres)


def _poses(replay: Replay, name: str, unit: Unit, world: Tracks) -> UnitPoses:
    """Where the unit is at the frames of the world; of a fixed one that has lists that is known."""
    placed, count = replay.placed.poses[name], len(world.stamp_ns)
    if unit.at is None or not len(placed.x_m):
        return poses(replay.scene, unit, world, unit_ground(replay.truth, name, unit))
    fixed = placed.x_m, placed.y_m, placed.z_m, placed.heading_rad, placed.ground_m
    x, y, z, heading, ground = (np.full(count, of[0]) for of in fixed)
    return UnitPoses(x, y, z, heading, np.ones(count, dtype=bool), ground)


def _shares(
    replay: Replay, experiment: Experiment, unit: Unit, at: UnitPoses, world: Tracks, rows: Int, known: Float
) -> Float:
    """(P,) visible shares of rows of the world, computed at the frames at which one is not known."""
    on = carrier(replay.scene, unit)
    lacks = np.isnan(known) & at.present[world.frame_ix[rows]] & (world.row_object_ix[rows] != on)
    if not lacks.any():
        return known
    watching = observers([at], np.array([on]))
    near, rows = _near_lines(world, at, rows, lacks, experiment.visibility)
    [share] = visible_shares(near, replay.placed.static, watching, experiment.visibility)
    return np.where(lacks, share[rows], known)


def _near_lines(world: Tracks, at: UnitPoses, rows: Int, wanted: Bool, model: VisibilityModel) -> tuple[Tracks, Int]:
    """The world without what cannot hide any of the `wanted` rows from the unit, and where the rows are in it.

    A body within bodies radius no line from the unit to a place within the target's radius runs hides none of it. A
    model of the user's own is asked with the whole world.
    """
    if is_own(type(model)):
        return world, rows
    radius_m = np.hypot(world.length_m[0], world.width_m[0]) / 2
    order, bounds = world.by_frame
    kept = np.zeros(len(world.frame_ix), dtype=bool)
    kept[rows] = True
    asked = rows[wanted & at.present[world.frame_ix[rows]]]
    frames = world.frame_ix[asked]
    count = np.diff(bounds)[frames]
    target = np.repeat(asked, count)
    other = order[
        np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(bounds[frames], count)
    ]
    ux, uy = at.x_m[world.frame_ix[target]], at.y_m[world.frame_ix[target]]
    tx, ty = world.x_m[0, target] - ux, world.y_m[0, target] - uy
    ox, oy = world.x_m[0, other] - ux, world.y_m[0, other] - uy
    along = np.clip((ox * tx + oy * ty) / np.maximum(tx * tx + ty * ty, 1e-12), 0.0, 1.0)
    kept[other[np.hypot(ox - along * tx, oy - along * ty) <= radius_m[target] + radius_m[other] + 1e-6]] = True
    return world.take_rows(np.flatnonzero(kept)), np.cumsum(kept)[rows] - 1


def _world(replay: Replay, experiment: Experiment, elapsed_ns: Int) -> Tracks:
    """The truth at frames (K,), ascending."""
    t0_ns, gap_s = replay.scene.t0_ns, experiment.max_gap_s
    around_s = gap_s + AROUND_S
    near = replay.truth.captured_between(elapsed_ns[0] * 1e-9 - around_s, elapsed_ns[-1] * 1e-9 + around_s)
    return at_instants(near, t0_ns + elapsed_ns, t0_ns=t0_ns, max_gap_s=gap_s)


def _rows(world: Tracks, shown: Sequence[int]) -> tuple[Int, Int]:
    """The rows of the shown objects, and which of them each is about."""
    rows = np.flatnonzero(np.isin(world.row_object_ix, shown))
    return rows, np.argsort(shown)[np.searchsorted(np.sort(shown), world.row_object_ix[rows])]


def _hidden(
    replay: Replay, experiment: Experiment, unit: Unit, at: UnitPoses, seen: Sight, u: int, part: slice,
    centres: np.ndarray,
) -> None:  # fmt: skip
    """What hides objects from unit u, only at the frames at which it does. Out: `body_ix` and `body_m` of `seen`.

    `at`: where the unit is at the frames of the `part`.
    """
    within = np.flatnonzero((seen.share[u, part] <= CLEAR_ABOVE).any(axis=1))
    if not len(within):
        return
    frames = part.start + within
    world = _world(replay, experiment, seen.elapsed_ns[frames])
    then = UnitPoses(
        *(getattr(at, name)[within] for name in ("x_m", "y_m", "z_m", "heading_rad", "present", "ground_m"))
    )
    watching = observers([then], np.array([carrier(replay.scene, unit)]))
    rows, column = _rows(world, seen.object_ix.tolist())
    world, rows = _near_lines(world, then, rows, np.ones(len(rows), dtype=bool), experiment.visibility)
    [hides] = hidden_by(world, replay.placed.static, watching, experiment.visibility)
    kept = hides[rows] != -1  # nothing hides any of it
    rows, column = rows[kept], column[kept]
    count = len(world.frame_ix)
    body = np.where(hides[rows] >= 0, hides[rows], count - 2 - hides[rows])
    bodies = np.concatenate([world.row_object_ix, -1 - np.arange(len(centres))])
    where = np.concatenate([f32(world.x_m[0], world.y_m[0], world.z_m[0]), centres])
    seen.body_ix[u, frames[world.frame_ix[rows]], column] = bodies[body]
    seen.body_m[u, frames[world.frame_ix[rows]], column] = where[body]


def _view(at: UnitPoses, world: Tracks, rows: Int, class_ix: np.ndarray) -> ViewGeometry:
    """What fields of view ask: range, azimuth and class; of the rest nothing is said."""
    frames = world.frame_ix[rows]
    dx, dy = world.x_m[0, rows] - at.x_m[frames], world.y_m[0, rows] - at.y_m[frames]
    bearing = np.arctan2(dy, dx)
    nothing = np.full(len(dx), np.nan)
    rest = dict.fromkeys(ViewGeometry.__dataclass_fields__, nothing)
    known = {
        "range_m": np.hypot(dx, dy),
        "azimuth_rad": wrap(bearing - at.heading_rad[frames]),
        "bearing_rad": bearing,
        "class_ix": class_ix,
    }
    return ViewGeometry(**(rest | known))


def _anywhere(pem: tuple[Couple, ...], view: ViewGeometry, *keys: str) -> Bool:
    """(P,) where these parts of the condition of some couple hold."""
    conditions = [Condition(**{key: getattr(couple.when, key) for key in keys}) for couple in pem]
    with np.errstate(invalid="ignore"):
        held: Bool = np.any([condition.holds(view) for condition in conditions], axis=0)
    return held & ~np.isnan(view.range_m)


def _centres(solids: Sequence[Solid]) -> np.ndarray:
    """(K, 3) halfway up."""
    import shapely

    middle = shapely.centroid([shapely.Polygon(solid.corners_m) for solid in solids])
    halfway_m = np.array([(solid.bottom_m + solid.top_m) / 2 for solid in solids])
    return f32(shapely.get_x(middle), shapely.get_y(middle), halfway_m)
