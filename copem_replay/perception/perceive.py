"""Perceive: what each unit lists of the world, and with which errors (W̃_n = PEM_n(W), the paper's eq. for one unit).

Detection is decided first, then the error is sampled, as in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import numpy as np

from copem_replay.core.draws import Draws
from copem_replay.core.interpolation import wrap
from copem_replay.core.lasting import ListTimes
from copem_replay.core.memory import Part, Parts
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import Bool, Float, Int, Scene, Tracks
from copem_replay.perception.config import PerceptionSetup
from copem_replay.perception.observation import Observations, rows_by_unit
from copem_replay.perception.pem.error import errors_of
from copem_replay.perception.pem.memory import quantity_of
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
    tracks, draws = found.tracks, draws_of(scene, found, experiment, runs)
    valid = _listed(found, experiment, draws)
    if equipped is not None:
        valid &= equipped[:, tracks.row_unit_ix]
    seen = tracks.with_values(valid=valid)
    if states == "true":
        return seen
    return with_states(scene, seen, found, experiment, None if states == "expected" else draws)


def draws_of(scene: Scene, found: Observations, experiment: PerceptionSetup, runs: Int) -> Draws:
    """The numbers of the rows of objects (P,) in the runs (S,)."""
    tracks = found.tracks
    random_key = RandomKey(
        tracks.units,
        tracks.row_unit_ix,
        object_words(scene.object_ids)[tracks.row_object_ix],
        tracks.stamp_ns[tracks.frame_ix],
    )
    lists = ListTimes(tracks.stamp_ns, tracks.frame_unit_ix, tracks.frame_ix)
    return Draws(CounterRng(experiment.seed, scene.log), random_key, lists, runs)


def with_states(
    scene: Scene, seen: Tracks, found: Observations, experiment: PerceptionSetup, draws: Draws | None
) -> Tracks:
    """What was listed with the errors of its couples and of the units' poses; `draws` None: the expected ones."""
    seen = _with_errors(seen, found, experiment, draws)
    return seen if draws is None else misplaced(scene, seen, found.tracks, found.view, experiment, draws.runs)


def _listed(found: Observations, experiment: PerceptionSetup, draws: Draws) -> Bool:
    """(S, P) what is detected: its addressed uniform is below its probability (0: never, 1: always)."""
    P = len(found.probability)
    by_parts: dict[tuple[Part, ...], list[Int]] = {}
    for unit, mine in zip(experiment.modelled.values(), rows_by_unit(found.tracks), strict=True):
        pem = experiment.pems[str(unit.pem)]
        for c in range(len(pem.couples)):
            if parts := pem.memory_of(c).get("detection", ()):
                by_parts.setdefault(parts, []).append(mine[found.couple_ix[mine] == c])
    if not by_parts:
        return draws.rng.bernoulli("detection", draws.random_key, draws.runs, found.probability)
    valid = np.empty((len(draws.runs), P), dtype=np.bool_)
    fresh = np.ones(P, dtype=np.bool_)
    for parts, pieces in by_parts.items():
        rows = np.sort(np.concatenate(pieces))
        fresh[rows] = False
        valid[:, rows] = draws.take(rows).uniform("detection", parts) < found.probability[rows]
    rest = np.flatnonzero(fresh)
    valid[:, rest] = draws.rng.bernoulli("detection", draws.random_key.take(rest), draws.runs, found.probability[rest])
    return valid


def _noise(draws: Draws | None, memory: Mapping[str, Parts], valid: Bool, name: str) -> Float:
    """What an error model is handed for its rows: standard normals where listed; zeros where no draws are wanted."""
    if draws is None:
        return np.zeros(valid.shape)
    return draws.normal(f"error {name}", memory.get(quantity_of(name), ()), np.ascontiguousarray(valid))


def _with_errors(seen: Tracks, found: Observations, experiment: PerceptionSetup, draws: Draws | None) -> Tracks:
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
        pem = experiment.pems[str(unit.pem)]
        for c, couple in enumerate(pem.couples):
            rows = mine[found.couple_ix[mine] == c]
            if couple.error is None or not len(rows):
                continue
            where = f"pems.{unit.pem}[{c}].error"
            drawn = None if draws is None else draws.take(rows)
            # Rows one after the other are looked at in place, others copied.
            at = slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] < len(rows) else rows
            noise = partial(_noise, drawn, pem.memory_of(c), seen.valid[:, at])
            errors = errors_of(couple.error, found.view.take(rows), noise, S, where)
            per_run("x_m")[:, at] += errors.east_m
            per_run("y_m")[:, at] += errors.north_m
            for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2"):
                spread[name][0, at] = getattr(errors, name)
            if errors.yaw_rad is not None:
                yaw = per_run("yaw_rad")
                yaw[:, at] = wrap(yaw[:, at] + errors.yaw_rad)
                spread["yaw_var_rad2"][0, at] = errors.yaw_var_rad2
            if errors.size_m is not None:
                for axis, name in enumerate(("length_m", "width_m", "height_m")):
                    size = per_run(name)
                    size[:, at] = np.maximum(size[:, at] + errors.size_m[axis], SMALLEST_SIZE_M)
                spread["size_var_m2"][0, at] = errors.size_var_m2
            if errors.speed_mps is not None:
                speed = found.view.speed_mps[rows]
                # Along the direction of travel; of the heading where the object stands.
                east = np.where(speed > 0, seen.vx_mps[0, at] / np.maximum(speed, 1e-9), np.cos(seen.yaw_rad[0, at]))
                north = np.where(speed > 0, seen.vy_mps[0, at] / np.maximum(speed, 1e-9), np.sin(seen.yaw_rad[0, at]))
                per_run("vx_mps")[:, at] += errors.speed_mps * east
                per_run("vy_mps")[:, at] += errors.speed_mps * north
                spread["speed_var_m2ps2"][0, at] = errors.speed_var_m2ps2
    return seen.with_values(**columns, **spread)
