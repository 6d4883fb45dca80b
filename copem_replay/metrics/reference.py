"""The place that distances are measured from: the ego, or a unit where there is no ego."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.errors import ExperimentError
from copem_replay.core.interpolation import states_at, wrap
from copem_replay.core.tracks import Bool, Float, Scene, Tracks
from copem_replay.metrics.config import MetricsSetup
from copem_replay.perception.sensor_poses import carrier, moved


@dataclass(frozen=True)
class Reference:
    """From where distances are measured: the ego, or a unit when there is no ego. All (K,), NaN where absent.

    Its box is `length_m × width_m` around its place; a unit is a point.
    """

    x_m: Float
    y_m: Float
    heading_rad: Float
    length_m: Float
    width_m: Float
    present: Bool


def reference_at(scene: Scene, truth: Tracks, experiment: MetricsSetup, time_s: Float) -> Reference:
    """The place distances are measured from, at times (K,). Raises ExperimentError when there is none."""
    n = len(time_s)
    name = experiment.measure.distance_to
    if name == "ego":
        if scene.ego_ix < 0:
            raise ExperimentError(
                f"{scene.log}: no ego to measure distances from; give `ego:` or `distance_to: <unit>`"
            )
        at, present = _state(scene, truth, scene.ego_ix, time_s, experiment.max_gap_s)
        return Reference(at["x_m"], at["y_m"], at["yaw_rad"], at["length_m"], at["width_m"], present)
    unit = experiment.units[name]
    point = np.zeros(n)
    if unit.at is not None:
        heading = np.full(n, np.deg2rad(unit.yaw_deg))
        x, y = moved(np.full(n, unit.at[0]), np.full(n, unit.at[1]), heading, unit.offset_m)
        return Reference(x, y, heading, point, point, np.ones(n, dtype=bool))
    at, present = _state(scene, truth, carrier(scene, unit), time_s, experiment.max_gap_s)
    x, y = moved(at["x_m"], at["y_m"], at["yaw_rad"], unit.offset_m)
    return Reference(x, y, wrap(at["yaw_rad"] + np.deg2rad(unit.yaw_deg)), point, point, present)


def _state(
    scene: Scene, truth: Tracks, object_ix: int, time_s: Float, max_gap_s: float
) -> tuple[dict[str, Float], Bool]:
    return states_at(truth, np.full(len(time_s), object_ix), time_s, t0_ns=scene.t0_ns, max_gap_s=max_gap_s)
