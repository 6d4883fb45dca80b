"""Perceive: what each unit lists of the world, and with which errors (W̃_n = PEM_n(W), the paper's eq. for one unit).

Detection is decided first, then the error is sampled, as in the paper.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from copem_replay.core.interpolation import wrap
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import Bool, Float, Int, Scene, Tracks
from copem_replay.perception.config import PerceptionSetup
from copem_replay.perception.observation import Observations, rows_by_unit
from copem_replay.perception.pem.error import errors_of
from copem_replay.perception.pose_error import misplaced

SMALLEST_SIZE_M = 0.05
"""A size error never makes a box smaller than this (chosen)."""


def perceive(
    scene: Scene,
    found: Observations,
    experiment: PerceptionSetup,
    runs: Int,
    *,
    states: Literal["true", "expected", "sampled"] = "sampled",
    equipped: Bool | None = None,
) -> Tracks:
    """Tracks of every unit in the runs (S,): `valid (S, P)` says what was listed.

    `equipped (S, U)`: which units there are in each run, None: all. States are the true ones (which is all that
    detection times by truth id need), the expected ones (true state plus the mean error) or sampled. What was listed
    does not depend on `states`.
    """
    tracks = found.tracks
    rng = CounterRng(experiment.seed, scene.log)
    random_key = RandomKey(
        tracks.units,
        tracks.row_unit_ix,
        object_words(scene.object_ids)[tracks.row_object_ix],
        tracks.stamp_ns[tracks.frame_ix],
    )
    valid = rng.bernoulli("detection", random_key, runs, found.probability)
    if equipped is not None:
        valid &= equipped[:, tracks.row_unit_ix]
    seen = replace(tracks, valid=valid)
    if states == "true":
        return seen
    seen = _with_errors(seen, found, experiment, _Draws(rng, random_key, runs, valid, states == "expected"))
    return seen if states == "expected" else misplaced(scene, seen, tracks, found.view, experiment, runs)


class _Draws:
    """Hands standard normals to the error models, by row; zeros where the expected state is asked for."""

    def __init__(self, rng: CounterRng, random_key: RandomKey, runs: Int, valid: Bool, zero: bool) -> None:
        self._rng, self._address, self._runs, self._valid, self._zero = rng, random_key, runs, valid, zero

    def normal(self, rows: Int, name: str) -> Float:
        if self._zero:
            return np.zeros((len(self._runs), len(rows)))
        return self._rng.normal(
            f"error {name}", self._address.take(rows), self._runs, np.ascontiguousarray(self._valid[:, rows])
        )


def _with_errors(seen: Tracks, found: Observations, experiment: PerceptionSetup, draws: _Draws) -> Tracks:
    S, P = seen.valid.shape
    columns: dict[str, Any] = {}

    def per_run(name: str) -> Float:
        # What has no error keeps its one row for all runs.
        if name not in columns:
            columns[name] = np.repeat(getattr(seen, name), S, axis=0)
        column: Float = columns[name]
        return column

    spread: dict[str, Any] = {
        name: np.zeros((1, P))
        for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2", "yaw_var_rad2", "size_var_m2", "speed_var_m2ps2")
    }
    for unit, mine in zip(experiment.modelled.values(), rows_by_unit(seen), strict=True):
        for c, couple in enumerate(experiment.pems[str(unit.pem)].couples):
            rows = mine[found.couple_ix[mine] == c]
            if couple.error is None or not len(rows):
                continue
            where = f"pems.{unit.pem}[{c}].error"
            errors = errors_of(couple.error, found.view.take(rows), partial(draws.normal, rows), S, where)
            per_run("x_m")[:, rows] += errors.east_m
            per_run("y_m")[:, rows] += errors.north_m
            for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2"):
                spread[name][0, rows] = getattr(errors, name)
            if errors.yaw_rad is not None:
                yaw = per_run("yaw_rad")
                yaw[:, rows] = wrap(yaw[:, rows] + errors.yaw_rad)
                spread["yaw_var_rad2"][0, rows] = errors.yaw_var_rad2
            if errors.size_m is not None:
                for axis, name in enumerate(("length_m", "width_m", "height_m")):
                    size = per_run(name)
                    size[:, rows] = np.maximum(size[:, rows] + errors.size_m[axis], SMALLEST_SIZE_M)
                spread["size_var_m2"][0, rows] = errors.size_var_m2
            if errors.speed_mps is not None:
                speed = found.view.speed_mps[rows]
                # Along the direction of travel; of the heading where the object stands.
                east = np.where(
                    speed > 0, seen.vx_mps[0, rows] / np.maximum(speed, 1e-9), np.cos(seen.yaw_rad[0, rows])
                )
                north = np.where(
                    speed > 0, seen.vy_mps[0, rows] / np.maximum(speed, 1e-9), np.sin(seen.yaw_rad[0, rows])
                )
                per_run("vx_mps")[:, rows] += errors.speed_mps * east
                per_run("vy_mps")[:, rows] += errors.speed_mps * north
                spread["speed_var_m2ps2"][0, rows] = errors.speed_var_m2ps2
    return replace(seen, **columns, **spread)
