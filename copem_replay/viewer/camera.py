"""Eyes: where they are, what they look at, and what they follow: the ego, or one of the shown objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from copem_replay.core.interpolation import states_at
from copem_replay.core.tracks import Float, Int, Scene
from copem_replay.experiment.schema import Experiment
from copem_replay.perception.sensor_poses import carrier, moved
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.sink import Out, entity_names, f32, ns

FARTHEST_BESIDE_M = 16.0
"""So far from the ego, towards the object, the eye looks at most (chosen: the ego stays in the picture)."""
AROUND_UNIT_M = 40.0
"""Of ways past a fixed unit from which distances are measured so much is in view (chosen)."""
EYES = ("world", "eyes")
TURNED_RAD, DOWN_RAD = np.deg2rad((65.0, 65.0))
"""The eye looks this far to the right of the ego's heading, and down (chosen: from above few words overlap)."""
ABOVE_RAD = np.deg2rad(75.0)
"""The eye on the units looks so far down (chosen: fields of view are hardly foreshortened)."""
EYE_RAD, MARGIN_M = np.deg2rad(55.0), 2.5
"""The viewer's vertical field of view, and room around places (chosen)."""
NEAR_FAR_M, FOLLOWING_M, CLOSE_M = (20.0, 150.0), (18.0, 48.0), (20.0, 38.0)
"""How far the eye is from what it looks at, at least and at most; of an ego that it follows; of an object that it
follows (chosen: from farther away people are a few pixels)."""


@dataclass(frozen=True)
class Eye:
    """Where it is and what it looks at, `(3,)` each; what it follows: an object by its index, or a place
    beside it, metres `ahead_m` and `left_m` of it.

    An eye that follows is as seen from the entity `path`, which moves: a view with that origin shows the same whenever
    it is first drawn. `at_m`: what it looks at in the world, at the onset.
    """

    place_m: Float
    target_m: Float
    at_m: Float
    object_ix: int | None = None
    ahead_m: float = 0.0
    left_m: float = 0.0
    path: tuple[str, ...] = ("world",)


def eye_on(replay: Replay, experiment: Experiment, table: pd.DataFrame, first: int | None, wide: float) -> Eye:
    """So that the object `first` is in view from the ego's side at the log's start and at its onset.

    Where no ego or unit is followed: so that the ways of all objects of the table are. `wide`: how much wider a view is
    than high.
    """
    truth, scene, unit = replay.truth, replay.scene, _followed(replay.scene, experiment)
    episodes = table.drop_duplicates("object_id")
    on = carrier(scene, experiment.units[unit]) if unit is not None else -1
    of_first = episodes["onset_s"][episodes["object_id"] == (scene.object_ids[first] if first is not None else None)]
    if on >= 0 and first is not None and len(of_first):
        # The onset first: the eye is turned as the ego is then.
        time_s = np.array([float(of_first.iloc[0]), 0.0])
        own, other = (_states(replay, experiment, np.full(2, k), time_s) for k in (on, first))
        shared = np.flatnonzero(~np.isnan(own[0]) & ~np.isnan(other[0]))
        if len(shared):
            yaw_rad = own[3, shared[0]]
            off = other[:3, shared] - own[:3, shared]
            cos, sin = np.cos(own[3, shared]), np.sin(own[3, shared])
            half = np.array([cos[0] * off[0, 0] + sin[0] * off[1, 0], cos[0] * off[1, 0] - sin[0] * off[0, 0]]) / 2
            half *= min(1.0, FARTHEST_BESIDE_M / max(float(np.hypot(*half)), 1e-9))
            ahead_m, left_m = (round(float(way), 1) for way in half)
            middle = np.stack([ahead_m * cos - left_m * sin, ahead_m * sin + left_m * cos, 0 * cos])
            places = np.concatenate([off - middle, -middle], axis=1)
            at_m, towards = own[:3, shared[0]] + middle[:, 0], _ahead(yaw_rad)
            place = -_distance(places, towards, FOLLOWING_M, wide) * towards
            return Eye(np.round(place, 1), np.zeros(3), at_m, on, ahead_m, left_m, (*EYES, "ego"))
    measured = episodes["object_id"].map(scene.object_number).to_numpy(dtype=np.int64)
    rows = np.flatnonzero(np.isin(truth.row_object_ix, measured if len(measured) else truth.object_ix))
    place = np.stack([truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows]])
    named = experiment.units.get(experiment.measure.distance_to)
    if named is not None and named.at is not None:
        unit_at = np.array([*named.at, place[2].mean() if place.size else 0.0])[:, None]
        near = np.hypot(*(place - unit_at)[:2]) <= AROUND_UNIT_M
        place = np.concatenate([place[:, near if near.any() else slice(None)], unit_at], axis=1)
    if not place.size:
        return Eye(np.array([-14.0, 0.0, 30.0]), np.zeros(3), np.zeros(3))
    target, towards = place.mean(axis=1), _ahead(0.0)
    eye = target - _distance(place - target[:, None], towards, NEAR_FAR_M, wide) * towards
    return Eye(np.round(eye, 1), np.round(target, 1), target)


def eye_after(replay: Replay, experiment: Experiment, table: pd.DataFrame, object_ix: int) -> Eye:
    """One that follows an object of the table, so near that the ego is in view at the onset, if it can be."""
    scene = replay.scene
    onset_s = table["onset_s"][table["object_id"] == scene.object_ids[object_ix]].to_numpy(dtype=float)[:1]
    target = _states(replay, experiment, np.array([object_ix]), onset_s)[:3, 0]
    unit = _followed(scene, experiment)
    on = carrier(scene, experiment.units[unit]) if unit is not None else -1
    own = _states(replay, experiment, np.array([max(on, 0)]), onset_s)[:, 0]
    there = on >= 0 and not np.isnan(own[0])
    towards = _ahead(own[3] if there else 0.0)
    away_m = float(np.clip(np.hypot(*(own - np.append(target, 0))[:2]) if there else 0.0, *CLOSE_M))
    path = (*EYES, entity_names(scene)[object_ix])
    return Eye(np.round(-away_m * towards, 1), np.zeros(3), np.nan_to_num(target), object_ix, path=path)


def eye_above(places_m: Float, other: Eye) -> Eye:
    """One that looks down on places (3, K) and on what another eye looks at, turned as that is; it follows nothing."""
    place = np.concatenate([places_m, other.at_m[:, None]], axis=1)
    target = (place.min(axis=1) + place.max(axis=1)) / 2
    turned = float(np.arctan2(*(other.target_m - other.place_m)[[1, 0]]))
    towards = np.array([np.cos(turned), np.sin(turned), -np.tan(ABOVE_RAD)])
    towards /= np.linalg.norm(towards)
    away_m = _distance(place - target[:, None], towards, NEAR_FAR_M, 1.5)
    return Eye(np.round(target - away_m * towards, 1), np.round(target, 1), target)


def seen_from(eye: Eye, offset_m: Float, wide: float) -> bool:
    """Whether a place (3,), as seen from what the eye looks at, is in the picture."""
    towards = (eye.target_m - eye.place_m) / np.linalg.norm(eye.target_m - eye.place_m)
    right = np.array([towards[1], -towards[0], 0]) / np.hypot(*towards[:2])
    depth = float(np.linalg.norm(eye.target_m - eye.place_m) + offset_m @ towards)
    high = depth * np.tan(EYE_RAD / 2)
    up = np.cross(right, towards)
    return bool(depth > 0 and abs(up @ offset_m) <= high and abs(right @ offset_m) <= wide * high)


def follow(out: Out, replay: Replay, eye: Eye) -> None:
    """Where the eye's origin is: on the ground at or beside what it follows; not turned."""
    import rerun as rr

    if eye.object_ix is None:
        return
    truth = replay.truth
    rows = np.flatnonzero(truth.row_object_ix == eye.object_ix)
    yaw_rad = truth.yaw_rad[0, rows]
    x_m, y_m = moved(truth.x_m[0, rows], truth.y_m[0, rows], yaw_rad, (eye.ahead_m, eye.left_m))
    place = f32(x_m, y_m, truth.z_m[0, rows] - truth.height_m[0, rows] / 2)
    elapsed = ns(truth.row_captured_s[rows])
    if elapsed[0] > 0:  # before it comes the eye waits for it
        elapsed, place = np.append(0, elapsed), np.concatenate([place[:1], place])
    out.columns(eye.path, elapsed, rr.Transform3D.columns(translation=place))


def _followed(scene: Scene, experiment: Experiment) -> str | None:
    """The ego's first unit; without an ego the unit from which distances are measured, if it is carried."""
    for name, unit in experiment.modelled.items():
        if carrier(scene, unit) == scene.ego_ix >= 0:
            return name
    to = experiment.measure.distance_to
    carried = to in experiment.units and experiment.units[to].on is not None
    return to if scene.ego_ix < 0 and carried and carrier(scene, experiment.units[to]) >= 0 else None


def _states(replay: Replay, experiment: Experiment, objects: Int, time_s: Float) -> Float:
    """(4, K) places and headings of objects at times, NaN where they are not there."""
    at, _ = states_at(replay.truth, objects, time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s)
    return np.stack([at["x_m"], at["y_m"], at["z_m"], at["yaw_rad"]])


def _ahead(yaw_rad: float) -> Float:
    """Where the eye looks: along the ego's way, from its left, down. Views are wide, so ways should run across."""
    turned = yaw_rad - TURNED_RAD
    ahead = np.array([np.cos(turned), np.sin(turned), -np.tan(DOWN_RAD)])
    unit: Float = ahead / np.linalg.norm(ahead)
    return unit


def _distance(place_m: Float, ahead: Float, within_m: tuple[float, float], wide: float) -> float:
    """From how far the places (3, K) around the middle of the picture are all in it."""
    right = np.array([ahead[1], -ahead[0], 0]) / np.hypot(*ahead[:2])
    up = np.cross(right, ahead)
    beside = (np.abs(right @ place_m) + MARGIN_M) / (wide * np.tan(EYE_RAD / 2))
    above = (np.abs(up @ place_m) + MARGIN_M) / np.tan(EYE_RAD / 2)
    return float(np.clip((np.maximum(beside, above) - ahead @ place_m).max(), *within_m))
