"""Where the eye is, what it looks at and what it follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from copem_replay.core.interpolation import states_at
from copem_replay.core.tracks import Float, Int, Scene
from copem_replay.experiment.schema import Experiment
from copem_replay.perception.sensor_poses import carrier, moved
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.sink import Out, f32, ns

FARTHEST_AHEAD_M = 12.0
"""So far ahead of whom it follows the eye looks at most (chosen: nobody drives out of the picture)."""
AROUND_UNIT_M = 40.0
"""Of ways past a fixed unit from which distances are measured so much is in view (chosen)."""
FOLLOWED = ("world", "eye")
TURNED_RAD, DOWN_RAD = np.deg2rad((65.0, 45.0))
"""The eye looks this far to the right of the ego's heading, and down (chosen)."""
EYE_RAD, MARGIN_M = np.deg2rad(55.0), 2.5
"""The viewer's vertical field of view, and room around places (chosen)."""
NEAR_FAR_M, FOLLOWING_M = (20.0, 150.0), (18.0, 45.0)
"""How far the eye is from what it looks at, at least and at most; the second of an ego that it follows (chosen: from
farther away people are a few pixels)."""


@dataclass(frozen=True)
class Eye:
    """Where it is and what it looks at, `(3,)` each; and what it follows: `ahead_m` of whom carries the unit `unit`."""

    place_m: Float
    target_m: Float
    unit: str | None
    ahead_m: float = 0.0


def eye_on(replay: Replay, experiment: Experiment, table: pd.DataFrame, wide: float) -> Eye:
    """So that the objects are in view at their onsets: from whom it follows, if somebody, else all their ways.

    `wide`: how much wider a view is than high.
    """
    truth, scene, unit = replay.truth, replay.scene, _followed(replay.scene, experiment)
    episodes = table.drop_duplicates("object_id")
    onset_s = episodes["onset_s"].to_numpy(dtype=float)
    at = _states(replay, experiment, episodes["object_id"].map(scene.object_number).to_numpy(dtype=np.int64), onset_s)
    there = ~np.isnan(at[0])
    place, onset_s = at[:3, there], onset_s[there]
    on = carrier(scene, experiment.units[unit]) if unit is not None else -1
    if on >= 0 and len(onset_s):
        own = _states(replay, experiment, np.full(len(onset_s), on), onset_s)
        shared = np.flatnonzero(~np.isnan(own[0]))
        if len(shared):
            first = shared[np.argmin(onset_s[shared])]
            yaw_rad = own[3, first]
            off = place[:, shared] - own[:3, shared]
            way = np.cos(own[3, shared]) * off[0] + np.sin(own[3, shared]) * off[1]
            ahead_m = round(float(np.clip(np.median(way) / 2, 0, FARTHEST_AHEAD_M)), 1)
            middle = ahead_m * np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
            seen = np.concatenate([off - middle[:, None], -middle[:, None]], axis=1)
            target, towards = own[:3, first] + middle, _ahead(yaw_rad)
            eye = target - _distance(seen, towards, FOLLOWING_M, wide) * towards
            return Eye(np.round(eye, 1), np.round(target, 1), unit, ahead_m)
    whose = episodes["object_id"].map(scene.object_number).to_numpy(dtype=np.int64)
    rows = np.flatnonzero(np.isin(truth.row_object_ix, whose if len(whose) else truth.object_ix))
    place = np.stack([truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows]])
    named = experiment.units.get(experiment.measure.distance_to)
    if named is not None and named.at is not None:
        unit_at = np.array([*named.at, place[2].mean() if place.size else 0.0])[:, None]
        near = np.hypot(*(place - unit_at)[:2]) <= AROUND_UNIT_M
        place = np.concatenate([place[:, near if near.any() else slice(None)], unit_at], axis=1)
    if not place.size:
        return Eye(np.array([-30.0, 0.0, 30.0]), np.zeros(3), None)
    target, towards = place.mean(axis=1), _ahead(0.0)
    eye = target - _distance(place - target[:, None], towards, NEAR_FAR_M, wide) * towards
    return Eye(np.round(eye, 1), np.round(target, 1), None)


def follow(out: Out, replay: Replay, experiment: Experiment, eye: Eye) -> None:
    """What the eye keeps in its middle: a point that nobody sees."""
    import rerun as rr

    if eye.unit is None:
        return
    truth = replay.truth
    rows = np.flatnonzero(truth.row_object_ix == carrier(replay.scene, experiment.units[eye.unit]))
    yaw_rad = truth.yaw_rad[0, rows]
    x_m, y_m = moved(truth.x_m[0, rows], truth.y_m[0, rows], yaw_rad, (eye.ahead_m, 0.0))
    columns = rr.Points3D.columns(positions=f32(x_m, y_m, truth.z_m[0, rows])).partition(np.ones(len(rows), int))
    out.columns(FOLLOWED, ns(truth.row_captured_s[rows]), columns)
    out.static(FOLLOWED, rr.Points3D.from_fields(radii=rr.Radius.ui_points(0.0), colors=[(0, 0, 0, 0)]))


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
