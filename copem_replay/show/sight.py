"""How the shown objects look from every modelled unit: in its field of view or not, and what hides them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from copem_replay.experiment import Experiment
from copem_replay.pem.condition import Condition, Couple
from copem_replay.pem.look import Look
from copem_replay.replay import Replay
from copem_replay.resample import at_instants, wrap
from copem_replay.show.out import f32
from copem_replay.tracks import Bool, Float, Int
from copem_replay.units import Poses, carrier, observers, poses, unit_ground
from copem_replay.visibility import hidden_by, visible_shares


@dataclass(frozen=True)
class Sight:
    """At frames of the truth (K,), of objects (M,), from the experiment's units (U,), those that are modelled.

    `share`: NaN outside the unit's field of view, where it is absent, or carried by the object. `blocker`: a row of
    `centre_m (B, 3)` and of `body_ix (B,)`, an object or −1 − k for the obstacle k.
    """

    elapsed_ns: Int
    object_ix: Int
    there: Bool  # (K, M) whether the object is
    share: Float  # (U, K, M)
    blocker: Int  # (U, K, M) −1: nothing hides it
    in_range: Bool  # (U, K, M)
    place_m: Float  # (U, K, 3) of the unit
    centre_m: Float
    body_ix: Int


def sight(replay: Replay, experiment: Experiment, shown: Sequence[int]) -> Sight:
    """Computed only at the frames at which one of the shown objects is there."""
    scene, truth = replay.scene, replay.truth
    stamps = truth.stamp_ns[np.unique(truth.frame_ix[np.isin(truth.row_object_ix, shown)])]
    world = at_instants(truth, stamps, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
    rows = np.flatnonzero(np.isin(world.row_object_ix, shown))
    frame = world.frame_ix[rows]
    column = np.searchsorted(np.sort(shown), world.row_object_ix[rows])
    column = np.argsort(shown)[column] if len(rows) else column
    shape = (len(experiment.units), len(stamps), len(shown))
    there = np.zeros(shape[1:], dtype=bool)
    there[frame, column] = True
    share, blocker, place = np.full(shape, np.nan), np.full(shape, -1), np.full((*shape[:2], 3), np.nan)
    in_range, in_field = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for u, (name, unit) in enumerate(experiment.units.items()):
        if unit.recorded is not None or not len(rows):
            continue
        at = poses(scene, unit, world, unit_ground(truth, name, unit, []))
        watching = observers([at], np.array([carrier(scene, unit)]))
        flat = experiment.visibility == "flat"
        share[u, frame, column] = visible_shares(world, replay.found.static, watching, flat=flat)[0, rows]
        hides = hidden_by(world, replay.found.static, watching, flat=flat)[0, rows]
        blocker[u, frame, column] = np.where(hides < -1, len(world.frame_ix) - 2 - hides, hides)
        place[u] = np.stack([at.x_m, at.y_m, at.z_m], axis=-1)
        dx, dy = world.x_m[0, rows] - at.x_m[frame], world.y_m[0, rows] - at.y_m[frame]
        look = _look(at, frame, dx, dy, scene.object_class[world.row_object_ix[rows]])
        pem = experiment.pems[str(unit.pem)]
        in_range[u, frame, column] = _anywhere(pem, look, "range_m")
        in_field[u, frame, column] = _anywhere(pem, look, "range_m", "azimuth_deg", "classes")
    obstacles = _obstacle_centres(replay, experiment)
    return Sight(
        elapsed_ns=stamps - scene.t0_ns,
        object_ix=np.array(shown, dtype=np.int64),
        there=there,
        share=np.where(in_field, share, np.nan),
        blocker=blocker,
        in_range=in_range,
        place_m=place,
        centre_m=np.concatenate([f32(world.x_m[0], world.y_m[0], world.z_m[0]), obstacles]),
        body_ix=np.concatenate([world.row_object_ix, -1 - np.arange(len(obstacles))]),
    )


def _look(at: Poses, frames: Int, dx: Float, dy: Float, class_ix: np.ndarray) -> Look:
    """What fields of view ask: range, azimuth and class; of the rest nothing is said."""
    bearing = np.arctan2(dy, dx)
    nothing = np.full(len(dx), np.nan)
    rest = dict.fromkeys(Look.__dataclass_fields__, nothing)
    known = {
        "range_m": np.hypot(dx, dy),
        "azimuth_rad": wrap(bearing - at.heading_rad[frames]),
        "bearing_rad": bearing,
        "class_ix": class_ix,
    }
    return Look(**(rest | known))


def _anywhere(pem: tuple[Couple, ...], look: Look, *keys: str) -> Bool:
    """(P,) where these parts of the condition of some couple hold."""
    conditions = [Condition(**{key: getattr(couple.when, key) for key in keys}) for couple in pem]
    with np.errstate(invalid="ignore"):
        held: Bool = np.any([condition.holds(look) for condition in conditions], axis=0)
    return held & ~np.isnan(look.range_m)


def _obstacle_centres(replay: Replay, experiment: Experiment) -> np.ndarray:
    """(K, 3) of the experiment's own obstacles, halfway up."""
    import shapely

    static = replay.found.static
    if not experiment.obstacles:
        return np.empty((0, 3), dtype=np.float32)
    middle = shapely.centroid([shapely.Polygon(o.polygon_m) for o in experiment.obstacles])
    _, part = np.unique(static.body, return_index=True)
    return f32(shapely.get_x(middle), shapely.get_y(middle), (static.bottom_m + static.top_m)[part] / 2)
