"""Cameras of the 3-D views: place, target, and what they follow: the ego or one of the shown objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import Float, Int, Scene
from copem_replay.experiment.schema import Experiment
from copem_replay.perception.sensor_poses import find_carrier, offset_places
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.sink import RecordingSink, entity_names, stack_float32, to_nanoseconds

FARTHEST_BESIDE_M = 16.0
"""Farthest target from the ego, on the way to the object, so that the ego stays in the picture."""
AROUND_UNIT_M = 40.0
"""Radius in view around a fixed unit from which distances are measured: all of long paths would be too small."""
EYES = ("world", "eyes")
BESIDE_ASPECT = 1.7
"""Width by height of two views beside each other, at least."""
TOGETHER_M = 60.0
"""Farthest unit that is in one picture with what it sees: from farther away people are a few pixels."""
TURNED_RAD, DOWN_RAD = np.deg2rad((65.0, 65.0))
"""Direction of view, right of the ego's heading and down: from so high few words overlap."""
ABOVE_RAD = np.deg2rad(75.0)
"""Downward angle of the camera on the units: fields of view are hardly foreshortened."""
EYE_RAD, MARGIN_M = np.deg2rad(55.0), 2.5
"""The viewer's vertical field of view, and room around centres: half the length of a car."""
NEAR_FAR_M, FOLLOWING_M, CLOSE_M = (20.0, 150.0), (18.0, 48.0), (20.0, 38.0)
"""Least and greatest distance from camera to target: not following, following the ego, following an object. From
farther away people are a few pixels."""


@dataclass(frozen=True)
class Camera:
    """Place and target of a camera, `(3,)` each, as seen from the entity `path`.

    A camera that follows has a `path` that moves with object `object_ix`, `ahead_m` and `left_m` of it: a view with
    that origin shows the same whenever it is first drawn. `at_m`: the target in the world, at the onset.
    """

    place_m: Float
    target_m: Float
    at_m: Float
    object_ix: int | None = None
    ahead_m: float = 0.0
    left_m: float = 0.0
    path: tuple[str, ...] = ("world",)


def camera_on_object(
    replay: Replay, experiment: Experiment, table: pd.DataFrame, first: int | None, aspect: float
) -> Camera:
    """A camera with object `first` in view, from the ego's side, at the log's start and at the object's onset.

    Without an ego or a carried unit to follow, the paths of all objects of the table are in view. `wide`: width of a
    view by its height.
    """
    truth, scene, unit = replay.truth, replay.scene, _followed_unit(replay.scene, experiment)
    episodes = table.drop_duplicates("object_id")
    on = find_carrier(scene, experiment.units[unit]) if unit is not None else -1
    first_onset_s = episodes["onset_s"][
        episodes["object_id"] == (scene.object_ids[first] if first is not None else None)
    ]
    if on >= 0 and first is not None and len(first_onset_s):
        # The onset first: its heading of the ego turns the camera.
        time_s = np.array([float(first_onset_s.iloc[0]), 0.0])
        own, followed = (_interpolate_states(replay, experiment, np.full(2, k), time_s) for k in (on, first))
        shared = np.flatnonzero(~np.isnan(own[0]) & ~np.isnan(followed[0]))
        if len(shared):
            yaw_rad = own[3, shared[0]]
            off = followed[:3, shared] - own[:3, shared]
            cos, sin = np.cos(own[3, shared]), np.sin(own[3, shared])
            half = np.array([cos[0] * off[0, 0] + sin[0] * off[1, 0], cos[0] * off[1, 0] - sin[0] * off[0, 0]]) / 2
            half *= min(1.0, FARTHEST_BESIDE_M / max(float(np.hypot(*half)), 1e-9))
            ahead_m, left_m = (round(float(way), 1) for way in half)
            middle = np.stack([ahead_m * cos - left_m * sin, ahead_m * sin + left_m * cos, 0 * cos])
            places = np.concatenate([off - middle, -middle], axis=1)
            at_m, towards = own[:3, shared[0]] + middle[:, 0], _view_direction(yaw_rad)
            place = -_fitting_distance(places, towards, FOLLOWING_M, aspect) * towards
            return Camera(np.round(place, 1), np.zeros(3), at_m, on, ahead_m, left_m, (*EYES, "ego"))
    measured = episodes["object_id"].map(scene.object_number).to_numpy(dtype=np.int64)
    rows = np.flatnonzero(np.isin(truth.row_object_ix, measured if len(measured) else truth.object_ix))
    place = np.stack([truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows]])
    distance_unit = experiment.units.get(experiment.measure.distance_to)
    if distance_unit is not None and distance_unit.at is not None:
        unit_at = np.array([*distance_unit.at, place[2].mean() if place.size else 0.0])[:, None]
        near = np.hypot(*(place - unit_at)[:2]) <= AROUND_UNIT_M
        place = np.concatenate([place[:, near if near.any() else slice(None)], unit_at], axis=1)
    if not place.size:
        return Camera(np.array([-14.0, 0.0, 30.0]), np.zeros(3), np.zeros(3))
    target, towards = place.mean(axis=1), _view_direction(0.0)
    eye = target - _fitting_distance(place - target[:, None], towards, NEAR_FAR_M, aspect) * towards
    return Camera(np.round(eye, 1), np.round(target, 1), target)


def camera_following(replay: Replay, experiment: Experiment, table: pd.DataFrame, object_ix: int) -> Camera:
    """A camera that follows an object of the table, with the ego in view at the onset if `CLOSE_M` allows."""
    scene = replay.scene
    onset_s = table["onset_s"][table["object_id"] == scene.object_ids[object_ix]].to_numpy(dtype=float)[:1]
    target = _interpolate_states(replay, experiment, np.array([object_ix]), onset_s)[:3, 0]
    unit = _followed_unit(scene, experiment)
    on = find_carrier(scene, experiment.units[unit]) if unit is not None else -1
    own = _interpolate_states(replay, experiment, np.array([max(on, 0)]), onset_s)[:, 0]
    has_ego = on >= 0 and not np.isnan(own[0])
    towards = _view_direction(own[3] if has_ego else 0.0)
    away_m = float(np.clip(np.hypot(*(own - np.append(target, 0))[:2]) if has_ego else 0.0, *CLOSE_M))
    path = (*EYES, entity_names(scene)[object_ix])
    return Camera(np.round(-away_m * towards, 1), np.zeros(3), np.nan_to_num(target), object_ix, path=path)


def include_places(eye: Camera, places_m: Float) -> Camera:
    """A camera that looks between its object and the places (3, K) around it, from where all of them are seen.

    `places_m`: relative to the object. Places farther away than `TOGETHER_M` are left out.
    """
    near = places_m[:, np.hypot(*places_m[:2]) <= TOGETHER_M]
    if not near.size:
        return eye
    both = np.concatenate([np.zeros((3, 1)), near], axis=1)
    middle = (both.min(axis=1) + both.max(axis=1)) / 2
    back = eye.place_m / np.linalg.norm(eye.place_m)
    right = np.array([-back[1], back[0], 0.0]) / np.hypot(*back[:2])
    off, tall = both - middle[:, None], np.tan(EYE_RAD / 2)
    beside, above = np.abs(right @ off) / (BESIDE_ASPECT * tall), np.abs(np.cross(back, right) @ off) / tall
    needed_m = (np.maximum(beside, above) + MARGIN_M / tall + back @ off).max()
    away_m = max(CLOSE_M[0], float(needed_m))
    return replace(eye, place_m=np.round(middle + away_m * back, 1), target_m=np.round(middle, 1))


def camera_above(places_m: Float, eye: Camera) -> Camera:
    """A camera that looks down on places (3, K) and on the target of `eye`, in its direction; it follows nothing."""
    place = np.concatenate([places_m, eye.at_m[:, None]], axis=1)
    target = (place.min(axis=1) + place.max(axis=1)) / 2
    turned = float(np.arctan2(*(eye.target_m - eye.place_m)[[1, 0]]))
    towards = np.array([np.cos(turned), np.sin(turned), -np.tan(ABOVE_RAD)])
    towards /= np.linalg.norm(towards)
    away_m = _fitting_distance(place - target[:, None], towards, NEAR_FAR_M, 1.5)
    return Camera(np.round(target - away_m * towards, 1), np.round(target, 1), target)


def write_camera_origin(out: RecordingSink, replay: Replay, eye: Camera) -> None:
    """Write the entity that a camera follows: on the ground at or beside the object, not rotated."""
    import rerun as rr

    if eye.object_ix is None:
        return
    truth = replay.truth
    rows = np.flatnonzero(truth.row_object_ix == eye.object_ix)
    yaw_rad = truth.yaw_rad[0, rows]
    x_m, y_m = offset_places(truth.x_m[0, rows], truth.y_m[0, rows], yaw_rad, (eye.ahead_m, eye.left_m))
    place = stack_float32(x_m, y_m, truth.z_m[0, rows] - truth.height_m[0, rows] / 2)
    elapsed = to_nanoseconds(truth.row_captured_s[rows])
    if elapsed[0] > 0:  # before the object comes, the camera waits where it will
        elapsed, place = np.append(0, elapsed), np.concatenate([place[:1], place])
    out.columns(eye.path, elapsed, rr.Transform3D.columns(translation=place))


def _followed_unit(scene: Scene, experiment: Experiment) -> str | None:
    """The first unit on the ego; without an ego the unit from which distances are measured, if it is carried."""
    for name, unit in experiment.modelled.items():
        if find_carrier(scene, unit) == scene.ego_ix >= 0:
            return name
    to = experiment.measure.distance_to
    carried = to in experiment.units and experiment.units[to].on is not None
    return to if scene.ego_ix < 0 and carried and find_carrier(scene, experiment.units[to]) >= 0 else None


def _interpolate_states(replay: Replay, experiment: Experiment, objects: Int, time_s: Float) -> Float:
    """(4, K) x, y, z and heading of objects at times, NaN while absent."""
    states, _ = interpolate_states(
        replay.truth, objects, time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
    )
    return np.stack([states["x_m"], states["y_m"], states["z_m"], states["yaw_rad"]])


def _view_direction(yaw_rad: float) -> Float:
    """(3,) the direction of view, down and from the ego's left: its path runs across the picture, which is wide."""
    turned = yaw_rad - TURNED_RAD
    ahead = np.array([np.cos(turned), np.sin(turned), -np.tan(DOWN_RAD)])
    unit: Float = ahead / np.linalg.norm(ahead)
    return unit


def _fitting_distance(place_m: Float, ahead: Float, within_m: tuple[float, float], aspect: float) -> float:
    """The distance, within `within_m`, from which all places (3, K), relative to the target, are in the picture."""
    right = np.array([ahead[1], -ahead[0], 0]) / np.hypot(*ahead[:2])
    up = np.cross(right, ahead)
    beside = (np.abs(right @ place_m) + MARGIN_M) / (aspect * np.tan(EYE_RAD / 2))
    above = (np.abs(up @ place_m) + MARGIN_M) / np.tan(EYE_RAD / 2)
    return float(np.clip((np.maximum(beside, above) - ahead @ place_m).max(), *within_m))
