"""Pose errors: a unit takes itself to be elsewhere, and turned. All of a list shifts and turns alike.

Visibility follows the true pose; lists follow the pose that the unit takes for its own:
x' = x + δ + (R(δθ) − 1)(x − p), yaw' = yaw + δθ, v' = R(δθ) v, with p the true place of the unit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.draws import Draws
from copem_replay.core.interpolation import wrap
from copem_replay.core.lasting import ListTimes, shared
from copem_replay.core.random import CounterRng, RandomKey
from copem_replay.core.tracks import Float, Int, Scene, Tracks
from copem_replay.core.view_geometry import ViewGeometry

if TYPE_CHECKING:
    from copem_replay.perception.config import PerceptionSetup
    from copem_replay.perception.unit_errors import PoseError


def misplaced(
    scene: Scene, seen: Tracks, true: Tracks, view: ViewGeometry, setup: PerceptionSetup, runs: Int
) -> Tracks:
    """The lists of the units in the runs (S,) as units that err about their own pose report them.

    `seen`: rows (P,) as they are without that; `true`: the same rows without any error, `view`: how they look.
    """
    for name, unit in setup.modelled.items():
        if (placed := unit.placed) is None:
            continue
        rows = np.flatnonzero(seen.row_unit_ix == seen.units.index(name))
        frames, of_row = np.unique(seen.frame_ix[rows], return_inverse=True)
        drawn = _drawn(scene, seen, frames, placed, (setup.seed, name, runs))
        # From where the unit truly is.
        from_unit_m = view.range_m[rows] * np.stack([np.cos(view.bearing_rad[rows]), np.sin(view.bearing_rad[rows])])
        at_m = np.stack([true.x_m[0, rows], true.y_m[0, rows]]) - from_unit_m
        seen = _moved(seen, rows, at_m, tuple(one[:, of_row] for one in drawn))
        if placed.stated:
            seen = _stating(seen, rows, from_unit_m, placed)
    return seen


def _moved(seen: Tracks, rows: Int, at_m: Float, off: tuple[Float, ...]) -> Tracks:
    """Some rows (K,) shifted and turned about `at_m` (2, K), by `off`: east, north (m) and turn (rad), (S, K) each."""
    east_m, north_m, turn_rad = off
    shape = (len(turn_rad), len(seen.frame_ix))
    columns: dict[str, Any] = {name: np.array(np.broadcast_to(getattr(seen, name), shape)) for name in _MOVED}
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    dx_m, dy_m = columns["x_m"][:, rows] - at_m[0], columns["y_m"][:, rows] - at_m[1]
    # What neither shifts nor turns stays to the last bit.
    columns["x_m"][:, rows] += east_m + ((cos - 1) * dx_m - sin * dy_m)
    columns["y_m"][:, rows] += north_m + (sin * dx_m + (cos - 1) * dy_m)
    columns["yaw_rad"][:, rows] = wrap(columns["yaw_rad"][:, rows] + turn_rad)
    vx_mps, vy_mps = columns["vx_mps"][:, rows], columns["vy_mps"][:, rows]
    columns["vx_mps"][:, rows], columns["vy_mps"][:, rows] = cos * vx_mps - sin * vy_mps, sin * vx_mps + cos * vy_mps
    return replace(seen, **columns)


_MOVED = ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps")


def _stating(seen: Tracks, rows: Int, from_unit_m: Float, placed: PoseError) -> Tracks:
    """Stated covariances with J Σ Jᵀ of the pose added, J = [1 | (−dy, dx)] of the true geometry."""
    position_m2, turn_rad2 = placed.position_sigma_m**2, np.deg2rad(placed.yaw_sigma_deg) ** 2
    dx_m, dy_m = from_unit_m
    more: dict[str, Any] = {
        "cov_ee_m2": position_m2 + turn_rad2 * dy_m**2,
        "cov_en_m2": -turn_rad2 * dx_m * dy_m,
        "cov_nn_m2": position_m2 + turn_rad2 * dx_m**2,
        "yaw_var_rad2": np.full(len(rows), turn_rad2),
    }
    for name, added in more.items():
        stated = getattr(seen, name)
        more[name] = np.zeros((1, len(seen.frame_ix))) if stated is None else stated.copy()
        more[name][:, rows] += added
    return replace(seen, **more)


def _drawn(
    scene: Scene, seen: Tracks, frames: Int, placed: PoseError, address: tuple[int, str, Int]
) -> tuple[Float, Float, Float]:
    """Easting, northing (m) and heading (rad) of some lists of a unit: (S, K) each. `address`: seed, unit, runs."""
    seed, name, runs = address
    mine = np.flatnonzero(seen.frame_unit_ix == seen.units.index(name))
    lists = ListTimes(seen.stamp_ns[mine], np.zeros(len(mine), dtype=np.int64), np.searchsorted(mine, frames))
    of_unit = np.zeros(len(frames), dtype=np.int64)
    random_key = shared(RandomKey((name,), of_unit, of_unit.astype(np.uint64), seen.stamp_ns[frames]), "unit")
    draws = Draws(CounterRng(seed, scene.log), random_key, lists, runs)
    east, north, yaw = (draws.normal(f"placed {what}", placed.parts) for what in ("east", "north", "yaw"))
    sigma_m, sigma_rad = placed.position_sigma_m, np.deg2rad(placed.yaw_sigma_deg)
    return sigma_m * east, sigma_m * north, sigma_rad * yaw
