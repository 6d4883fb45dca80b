"""Perceive: the lists of each unit, with their errors (W̃_n = PEM_n(W), the paper's equation for one unit).

Detection is decided first, then the error is sampled, as in the paper. Beside the states: claims of existence, class
and track id, and the errors of a unit's own pose, of its clock, and outages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from copem_replay.core.interpolation import wrap_angles
from copem_replay.core.lasting import ListStamps, draw_held_uniforms, drop_capture, drop_unshared, renewal_stamps
from copem_replay.core.memory import MemoryPart, Parts, UnitDraws
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import CLASSES, Bool, Float, Int, Scene, Tracks
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.perception.config import PerceptionSetup
from copem_replay.perception.observation import Observations, rows_by_unit
from copem_replay.perception.pem.condition import Claimed, ExistenceScores, noise_quantity
from copem_replay.perception.pem.error import ask_errors

if TYPE_CHECKING:
    from copem_replay.perception.config import PoseError
    from copem_replay.perception.pem.model import Pem


SMALLEST_SIZE_M = 0.05
"""A size error never makes a box smaller than this, so that each box keeps an area to overlap with."""


def perceive(
    scene: Scene,
    observations: Observations,
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
    tracks, draws = observations.tracks, make_draws(scene, observations, experiment, runs)
    valid = _draw_detected(observations, experiment, draws)
    if equipped is not None:
        valid &= equipped[:, tracks.row_unit_ix]
    seen = replace(tracks, valid=valid)
    if states == "true":
        return seen
    return add_states(scene, seen, observations, experiment, None if states == "expected" else draws)


def make_draws(scene: Scene, observations: Observations, experiment: PerceptionSetup, runs: Int) -> UnitDraws:
    """The random numbers of the rows of objects (P,) in the runs (S,)."""
    tracks = observations.tracks
    random_key = RandomKey(
        tracks.units,
        tracks.row_unit_ix,
        object_words(scene.object_ids)[tracks.row_object_ix],
        tracks.stamp_ns[tracks.frame_ix],
    )
    lists = ListStamps(tracks.stamp_ns, tracks.frame_unit_ix, tracks.frame_ix)
    return UnitDraws(CounterRng(experiment.seed, scene.log), random_key, lists, runs)


def add_states(
    scene: Scene, tracks: Tracks, observations: Observations, experiment: PerceptionSetup, draws: UnitDraws | None
) -> Tracks:
    """The lists with the errors of their couples and of the units' poses; `draws` None: with the mean errors alone."""
    tracks = _add_errors(tracks, observations, experiment, draws)
    return (
        tracks
        if draws is None
        else apply_pose_errors(scene, tracks, observations.tracks, observations.view, experiment, draws.runs)
    )


def _draw_detected(observations: Observations, experiment: PerceptionSetup, draws: UnitDraws) -> Bool:
    """(S, P) whether each row is detected: its addressed uniform is below the probability (0: never, 1: always)."""
    P = len(observations.probability)
    rows_by_parts: dict[tuple[MemoryPart, ...], list[Int]] = {}
    for unit, unit_rows in zip(experiment.modelled.values(), rows_by_unit(observations.tracks), strict=True):
        pem = experiment.pems[str(unit.pem)]
        for c in range(len(pem.couples)):
            if parts := pem.memory_of(c).get("detection", ()):
                rows_by_parts.setdefault(parts, []).append(unit_rows[observations.couple_ix[unit_rows] == c])
    if not rows_by_parts:
        return draws.rng.bernoulli("detection", draws.random_key, draws.runs, observations.probability)
    valid = np.empty((len(draws.runs), P), dtype=np.bool_)
    is_memoryless = np.ones(P, dtype=np.bool_)
    for parts, pieces in rows_by_parts.items():
        rows = np.sort(np.concatenate(pieces))
        is_memoryless[rows] = False
        valid[:, rows] = draws.take(rows).uniform("detection", parts) < observations.probability[rows]
    memoryless_rows = np.flatnonzero(is_memoryless)
    valid[:, memoryless_rows] = draws.rng.bernoulli(
        "detection", draws.random_key.take(memoryless_rows), draws.runs, observations.probability[memoryless_rows]
    )
    return valid


def _draw_noise(draws: UnitDraws | None, memory: Mapping[str, Parts], valid: Bool, name: str) -> Float:
    """The noise of an error model for its rows: standard normals where listed; zeros without `draws`."""
    if draws is None:
        return np.zeros(valid.shape)
    return draws.normal(f"error {name}", memory.get(noise_quantity(name), ()), np.ascontiguousarray(valid))


def _add_errors(
    tracks: Tracks, observations: Observations, experiment: PerceptionSetup, draws: UnitDraws | None
) -> Tracks:
    """The lists with the errors of the couples that apply (`draws` None: mean errors), and stated variances."""
    S, P = tracks.valid.shape
    columns: dict[str, Any] = {}

    def per_run(name: str) -> Float:
        # A value without error keeps its one row for all runs.
        if name not in columns:
            columns[name] = np.repeat(getattr(tracks, name), S, axis=0)
        column: Float = columns[name]
        return column

    spread: dict[str, Any] = {
        name: np.zeros((1, P))
        for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2", "yaw_var_rad2", "size_var_m2", "speed_var_m2ps2")
    }
    for unit, unit_rows in zip(experiment.modelled.values(), rows_by_unit(tracks), strict=True):
        pem = experiment.pems[str(unit.pem)]
        for c, couple in enumerate(pem.couples):
            rows = unit_rows[observations.couple_ix[unit_rows] == c]
            if couple.error is None or not len(rows):
                continue
            where = f"pems.{unit.pem}[{c}].error"
            drawn = None if draws is None else draws.take(rows)
            # Consecutive rows are a view, others a copy.
            columns_at = slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] < len(rows) else rows
            noise = partial(_draw_noise, drawn, pem.memory_of(c), tracks.valid[:, columns_at])
            errors = ask_errors(couple.error, observations.view.take(rows), noise, S, where)
            per_run("x_m")[:, columns_at] += errors.east_m
            per_run("y_m")[:, columns_at] += errors.north_m
            for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2"):
                spread[name][0, columns_at] = getattr(errors, name)
            if errors.yaw_rad is not None:
                yaw = per_run("yaw_rad")
                yaw[:, columns_at] = wrap_angles(yaw[:, columns_at] + errors.yaw_rad)
                spread["yaw_var_rad2"][0, columns_at] = errors.yaw_var_rad2
            if errors.size_m is not None:
                for axis, name in enumerate(("length_m", "width_m", "height_m")):
                    size = per_run(name)
                    size[:, columns_at] = np.maximum(size[:, columns_at] + errors.size_m[axis], SMALLEST_SIZE_M)
                spread["size_var_m2"][0, columns_at] = errors.size_var_m2
            if errors.speed_mps is not None:
                east, north = _travel_direction(tracks, observations.view.speed_mps[rows], columns_at)
                per_run("vx_mps")[:, columns_at] += errors.speed_mps * east
                per_run("vy_mps")[:, columns_at] += errors.speed_mps * north
                spread["speed_var_m2ps2"][0, columns_at] = errors.speed_var_m2ps2
    return replace(tracks, **columns, **spread)


def _travel_direction(tracks: Tracks, speed_mps: Float, columns_at: Any) -> tuple[Float, Float]:
    """East and north (K,) of the direction of travel, of the heading where an object stands."""
    moving, divisor = speed_mps > 0, np.maximum(speed_mps, 1e-9)
    yaw_rad = tracks.yaw_rad[0, columns_at]
    east = np.where(moving, tracks.vx_mps[0, columns_at] / divisor, np.cos(yaw_rad))
    north = np.where(moving, tracks.vy_mps[0, columns_at] / divisor, np.sin(yaw_rad))
    return east, north


# Claims of entries: existence, class probabilities, and the unit's own track id. Claims that are drawn are asked for
# one run at a time; the others are equal in all runs.

TRACK_ID_BITS = 52
"""Bits of a track id: numbers in JSON are exact up to 53; of a million ids two are equal with probability 1e-4."""


class EntryClaims(NamedTuple):
    """Claims of entries beside their states, row by row: track ids are −1 where there are none."""

    existence: Float  # (P,)
    class_probability: Float  # (P, C)
    track_id: Int  # (P,)

    def followed_by(self, others: EntryClaims) -> EntryClaims:
        """The claims of these rows, then those of other rows."""
        columns: Any = map(np.concatenate, zip(self, others, strict=True))
        return EntryClaims(*columns)


def draw_claims(
    observations: Observations, setup: PerceptionSetup, draws: UnitDraws, ghost_sort: Int | None = None
) -> EntryClaims:
    """The claims of the units about rows (P,) in one run, that of `draws`.

    `ghost_sort (P,)`: the rows are ghosts, of these sorts of their PEMs; None: they are objects.
    """
    claims = EntryClaims(
        observations.existence.copy(),
        np.eye(len(CLASSES))[observations.view.class_ix],
        np.full(len(observations.couple_ix), -1),
    )
    for unit, rows in zip(setup.modelled.values(), rows_by_unit(observations.tracks), strict=True):
        pem = setup.pems[str(unit.pem)]
        if not len(rows) or not pem.draws_claims:
            continue
        unit_draws = draws.take(rows)
        sort = None if ghost_sort is None else ghost_sort[rows]
        claims.existence[rows] = _claim_existence(pem, observations, rows, unit_draws, sort)
        claims.class_probability[rows] = _claim_classes(pem, observations, rows, unit_draws, of_ghosts=sort is not None)
        if pem.tracks is not None:
            claims.track_id[rows] = _claim_track_ids(unit_draws, pem.tracks.lasts_s)
    return claims


def _claim_existence(pem: Pem, observations: Observations, rows: Int, draws: UnitDraws, sort: Int | None) -> Float:
    """(P,) existence as claimed of rows of one unit; `sort`: the rows are ghosts of these sorts, None: objects."""
    existence = observations.existence[rows]
    couple_ix = observations.couple_ix[rows]
    for c, couple in enumerate(pem.couples):
        for n in range(1 if sort is None else len(pem.ghosts)):
            sort_rows = np.flatnonzero((couple_ix == c) & (True if sort is None else sort == n))
            claimed: Claimed = couple.existence
            if sort is not None and (own_existence := pem.ghosts[n].existence) is not None:
                claimed = own_existence
            if not len(sort_rows):
                continue
            if isinstance(claimed, ExistenceScores):
                [uniform] = draws.take(sort_rows).uniform("existence", pem.memory_of(c).get("existence", ()))
                existence[sort_rows] = claimed.claimed(
                    uniform, of_ghosts=sort is not None, ghosts_in_list=pem.ghosts_in_list
                )
            else:
                existence[sort_rows] = (
                    observations.view.visible_share[rows[sort_rows]] if claimed == "visible_share" else claimed
                )
    return existence


def _claim_classes(pem: Pem, observations: Observations, rows: Int, draws: UnitDraws, *, of_ghosts: bool) -> Float:
    """(P, C) class probabilities that a unit states of its rows; a ghost's listed class is drawn at its birth."""
    class_ix = observations.view.class_ix[rows].astype(np.int64)
    if pem.classes is None:
        return np.eye(len(CLASSES))[class_ix]
    if pem.classes.confusion and not of_ghosts:
        couple_ix, true_class = observations.couple_ix[rows], class_ix.copy()
        for c in range(len(pem.couples)):
            couple_rows = np.flatnonzero(couple_ix == c)
            if len(couple_rows):
                [uniform] = draws.take(couple_rows).uniform("class", pem.memory_of(c).get("class", ()))
                class_ix[couple_rows] = pem.classes.listed(true_class[couple_rows], uniform)
    return pem.classes.stated(class_ix)


def _claim_track_ids(draws: UnitDraws, lasts_s: float) -> Int:
    """(P,) track ids: a number drawn for each renewal; an id lasts from one renewal to the next."""
    key, run = draws.random_key, draws.runs
    [renewal] = renewal_stamps(draws.rng, "track id", key, run, lasts_s)
    drawn = draws.rng.uniform("track id number", RandomKey(key.units, key.unit_ix, key.object_word, renewal), run)
    ids: Int = (drawn[0] * 2.0**TRACK_ID_BITS).astype(np.int64)
    return ids


# Pose errors: a unit takes itself to be elsewhere, and turned, so all of a list shifts and turns alike. Visibility
# follows the true pose; lists follow the pose that the unit takes for its own: x' = x + δ + (R(δθ) − 1)(x − p),
# yaw' = yaw + δθ, v' = R(δθ) v, with p the true place of the unit.


def apply_pose_errors(
    scene: Scene, tracks: Tracks, true: Tracks, view: ViewGeometry, setup: PerceptionSetup, runs: Int
) -> Tracks:
    """The lists of the units in the runs (S,), moved by the errors of the units about their own poses.

    `tracks`: rows (P,) without these errors; `true`: the rows without any error; `view`: their view geometry.
    """
    for name, unit in setup.modelled.items():
        if (placed := unit.placed) is None:
            continue
        rows = np.flatnonzero(tracks.row_unit_ix == tracks.units.index(name))
        # From the true place of the unit.
        from_unit_m = view.range_m[rows] * np.stack([np.cos(view.bearing_rad[rows]), np.sin(view.bearing_rad[rows])])
        true_m = np.stack([true.x_m[0, rows], true.y_m[0, rows]])
        tracks = displace_rows(scene, tracks, rows, true_m - from_unit_m, from_unit_m, placed, (setup.seed, name, runs))
    return tracks


def displace_rows(
    scene: Scene, tracks: Tracks, rows: Int, at_m: Float, from_unit_m: Float, placed: PoseError,
    address: tuple[int, str, Int],
) -> Tracks:  # fmt: skip
    """Rows (K,) of one unit moved by its pose errors about its place `at_m`; they are `from_unit_m` away, (2, K) each.

    `address`: seed, unit, runs.
    """
    frames, of_row = np.unique(tracks.frame_ix[rows], return_inverse=True)
    drawn = _draw_pose_errors(scene, tracks, frames, placed, address)
    tracks = _shift_rows(tracks, rows, at_m, tuple(error[:, of_row] for error in drawn))
    return _state_pose_covariance(tracks, rows, from_unit_m, placed) if placed.stated else tracks


def _shift_rows(tracks: Tracks, rows: Int, at_m: Float, off: tuple[Float, ...]) -> Tracks:
    """Rows (K,) shifted and turned about `at_m` (2, K) by `off`: east, north (m) and turn (rad), (S, K) each."""
    east_m, north_m, turn_rad = off
    shape = (len(turn_rad), len(tracks.frame_ix))
    columns: dict[str, Any] = {name: np.array(np.broadcast_to(getattr(tracks, name), shape)) for name in _MOVED}
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    dx_m, dy_m = columns["x_m"][:, rows] - at_m[0], columns["y_m"][:, rows] - at_m[1]
    # Written so that without shift and turn no bit changes.
    columns["x_m"][:, rows] += east_m + ((cos - 1) * dx_m - sin * dy_m)
    columns["y_m"][:, rows] += north_m + (sin * dx_m + (cos - 1) * dy_m)
    columns["yaw_rad"][:, rows] = wrap_angles(columns["yaw_rad"][:, rows] + turn_rad)
    vx_mps, vy_mps = columns["vx_mps"][:, rows], columns["vy_mps"][:, rows]
    columns["vx_mps"][:, rows], columns["vy_mps"][:, rows] = cos * vx_mps - sin * vy_mps, sin * vx_mps + cos * vy_mps
    return replace(tracks, **columns)


_MOVED = ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps")


def _state_pose_covariance(tracks: Tracks, rows: Int, from_unit_m: Float, placed: PoseError) -> Tracks:
    """The rows with J Σ Jᵀ of the pose added to their stated covariances, J = [1 | (−dy, dx)] of the true geometry."""
    position_m2, turn_rad2 = placed.position_sigma_m**2, np.deg2rad(placed.yaw_sigma_deg) ** 2
    dx_m, dy_m = from_unit_m
    columns: dict[str, Any] = {
        "cov_ee_m2": position_m2 + turn_rad2 * dy_m**2,
        "cov_en_m2": -turn_rad2 * dx_m * dy_m,
        "cov_nn_m2": position_m2 + turn_rad2 * dx_m**2,
        "yaw_var_rad2": np.full(len(rows), turn_rad2),
    }
    for name, added in columns.items():
        stated = getattr(tracks, name)
        columns[name] = np.zeros((1, len(tracks.frame_ix))) if stated is None else stated.copy()
        columns[name][:, rows] += added
    return replace(tracks, **columns)


def _draw_pose_errors(
    scene: Scene, tracks: Tracks, frames: Int, placed: PoseError, address: tuple[int, str, Int]
) -> tuple[Float, Float, Float]:
    """Pose errors of some lists of a unit: east, north (m), heading (rad), (S, K) each. `address`: seed, unit, runs."""
    seed, name, runs = address
    unit_frames = np.flatnonzero(tracks.frame_unit_ix == tracks.units.index(name))
    lists = ListStamps(
        tracks.stamp_ns[unit_frames], np.zeros(len(unit_frames), dtype=np.int64), np.searchsorted(unit_frames, frames)
    )
    zeros = np.zeros(len(frames), dtype=np.int64)
    random_key = drop_unshared(RandomKey((name,), zeros, zeros.astype(np.uint64), tracks.stamp_ns[frames]), "unit")
    draws = UnitDraws(CounterRng(seed, scene.log), random_key, lists, runs)
    east, north, yaw = (draws.normal(f"placed {what}", placed.parts) for what in ("east", "north", "yaw"))
    sigma_m, sigma_rad = placed.position_sigma_m, np.deg2rad(placed.yaw_sigma_deg)
    return sigma_m * east, sigma_m * north, sigma_rad * yaw


# Clocks: a unit states captures by its own clock, whose offset and drift are constant in a run.


def clock_errors_s(
    scene: Scene, units: tuple[str, ...], setup: PerceptionSetup, captured_s: Float, unit_ix: Int, run: int
) -> Float | None:
    """(F,) seconds that the clocks of units (U,) add to the captures of lists (F,) in one run; None: no clock errs."""
    clocks = {name: unit.clock for name, unit in setup.units.items() if unit.clock is not None and name in units}
    if not clocks:
        return None
    rng, zero = CounterRng(setup.seed, scene.log), np.zeros(1, dtype=np.int64)
    error_s = np.zeros(len(captured_s))
    for name, clock in clocks.items():
        random_key = drop_capture(drop_unshared(RandomKey((name,), zero, zero.astype(np.uint64), zero), "unit"))
        [[offset]] = rng.normal("clock offset", random_key, np.array([run]))
        [[drift]] = rng.normal("clock drift", random_key, np.array([run]))
        of_unit = unit_ix == units.index(name)
        error_s[of_unit] = clock.offset_sigma_s * offset + 1e-6 * clock.drift_sigma_ppm * drift * captured_s[of_unit]
    return error_s


# Outages: for a while a unit makes no list at all, not even an empty one.


def remove_outages(scene: Scene, tracks: Tracks, setup: PerceptionSetup, runs: Int) -> Tracks:
    """The lists of the units in one run, runs (1,), without those that are not made: they never arrive."""
    down = lists_not_made(scene, tracks, setup, runs)
    if down is None:
        return tracks
    [missing] = down
    arrives_s = np.where(missing, np.inf, tracks.arrives_s)
    return replace(tracks, arrives_s=arrives_s, valid=tracks.valid & ~missing[tracks.frame_ix])


def lists_not_made(scene: Scene, tracks: Tracks, setup: PerceptionSetup, runs: Int) -> Bool | None:
    """(S, F) lists of `tracks` that are missing in the runs (S,), as their unit is down; None: all are made."""
    outages_by_unit = {
        name: unit.outages for name, unit in setup.units.items() if unit.outages is not None and name in tracks.units
    }
    if not outages_by_unit:
        return None
    down: Bool = np.zeros((len(runs), len(tracks.stamp_ns)), dtype=bool)
    for name, outages in outages_by_unit.items():
        frames = np.flatnonzero(tracks.frame_unit_ix == tracks.units.index(name))
        of_unit = np.zeros(len(frames), dtype=np.int64)
        random_key = drop_unshared(
            RandomKey((name,), of_unit, of_unit.astype(np.uint64), tracks.stamp_ns[frames]), "unit"
        )
        drawn = draw_held_uniforms(CounterRng(setup.seed, scene.log), "outage", random_key, runs, outages.correlation_s)
        down[:, frames] = drawn < outages.down_share
    return down
