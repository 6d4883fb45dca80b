"""Verdicts: from the instant it knew, would the declared driver have stayed clear?

A verdict is a function of the encounter and of the instant at which braking begins, whatever led to it. From then on
the ego is where its driver has braked to, along its own path, and never farther than it would have been without. It
passes when it stays more than the margin from the object's true motion throughout: it has stopped in time, or the
object has left its way. The others do not react. Source of the idea: Piazzoni et al. 2022; definitions:
docs/measures.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.braking.boxes import nearest, required
from copem_replay.braking.driver import Driver, Reaction, delays_of, way_of
from copem_replay.braking.encounter import Encounter
from copem_replay.tracks import Bool, Float

_CELLS = 1_000_000
"""Courses × instants held at a time (chosen: 8 MB a column)."""
_INSTANT_S = 1e-5
"""Before and after a touch, to tell the speed at it (chosen)."""
_GRID_S = 0.005
"""Between the beginnings of braking that are tried for where passing turns to failing (chosen)."""


@dataclass(frozen=True)
class Verdicts:
    """What becomes of one encounter when braking begins at `brake_s (R,)`, inf: never. All (R,), NaN: does not exist.

    `min_distance_m`: smallest box distance. `impact_s`, `impact_speed_mps`: when the boxes first touch, and the ego's
    speed then. `required_mps2`: smallest constant deceleration from `brake_s` on that stays clear, inf: none does.
    """

    min_distance_m: Float
    impact_s: Float
    impact_speed_mps: Float
    required_mps2: Float


def judge(encounter: Encounter, driver: Driver, brake_s: Float) -> Verdicts:
    """Verdicts for beginnings of braking (R,). Raises InputError where a driver of the user's own fails."""
    unique, back = np.unique(brake_s, return_inverse=True)
    near, touch = np.empty(len(unique)), np.empty(len(unique))
    rows = max(1, _CELLS // len(encounter.time_s))
    for k in range(0, len(unique), rows):
        courses = braked(encounter, driver, unique[k : k + rows], encounter.time_s[None])
        nearest(
            courses, encounter.path, encounter.size_m, encounter.other, encounter.other_size_m,
            near[k : k + rows], touch[k : k + rows],
        )  # fmt: skip
    impact_s = np.where(np.isinf(touch), np.nan, np.interp(touch, np.arange(len(encounter.time_s)), encounter.time_s))
    speed = _speed_at(encounter, driver, unique, impact_s)
    need = np.full(len(unique), np.nan)
    begin_m, begin_mps, ever = _begin(encounter, unique)
    found = np.empty(int(ever.sum()))
    required(encounter.time_s, encounter.reach_m, unique[ever], begin_m[ever], begin_mps[ever], found)
    need[ever] = found
    return Verdicts(near[back], impact_s[back], speed[back], need[back])


def braked(encounter: Encounter, driver: Driver, brake_s: Float, time_s: Float) -> Float:
    """Way along the path (R, K) when braking begins at `brake_s (R,)`, at instants `time_s (1 | R, K)`; NaN: not there.

    Who would begin after the ego's last frame never does.
    """
    free = np.interp(time_s, encounter.time_s, encounter.course.along_m)
    begin_m, begin_mps, ever = _begin(encounter, brake_s)
    after = (time_s > brake_s[:, None]) & ever[:, None]
    elapsed = np.where(after, time_s - np.where(ever, brake_s, 0.0)[:, None], 0.0)
    way = begin_m[:, None] + way_of(driver, elapsed, begin_mps[:, None])
    result: Float = np.where(after, np.minimum(way, _bound(encounter, time_s)), free)
    return result


def _bound(encounter: Encounter, time_s: Float) -> Float:
    """`Course.bound_m` between the instants: inf as soon as the next one has it."""
    with np.errstate(invalid="ignore"):  # inf − inf between two instants past the end
        found = np.interp(time_s, encounter.time_s, encounter.course.bound_m, right=np.inf)
    return np.where(np.isnan(found), np.inf, found)


def _begin(encounter: Encounter, brake_s: Float) -> tuple[Float, Float, Bool]:
    """Where the ego is and how fast when braking begins, and whether it does: (R,) each, 0 where it does not."""
    at_m = _bound(encounter, brake_s)
    ever = np.isfinite(at_m) & np.isfinite(brake_s)
    speed = np.interp(brake_s, encounter.time_s, encounter.course.speed_mps)
    return np.where(ever, at_m, 0.0), np.where(ever, speed, 0.0), ever


def _speed_at(encounter: Encounter, driver: Driver, brake_s: Float, time_s: Float) -> Float:
    """The ego's speed (R,) at one instant (R,) of each course; NaN where that is."""
    result = np.full(len(brake_s), np.nan)
    there = np.flatnonzero(~np.isnan(time_s))
    around = time_s[there, None] + np.array([-_INSTANT_S, _INSTANT_S])
    around = np.clip(around, encounter.time_s[0], encounter.time_s[-1])
    way = braked(encounter, driver, brake_s[there], around)
    result[there] = np.diff(way, axis=1)[:, 0] / np.diff(around, axis=1)[:, 0]
    return result


def passing(encounter: Encounter, driver: Driver, margin_m: float) -> Float:
    """Intervals [from, to] (K, 2) of the beginnings of braking, seconds, with which the ego passes.

    Between beginnings `_GRID_S` apart that are judged alike it is taken to be judged the same; where they differ the
    border is found by halves. Before the onset nobody brakes.
    """
    grid = np.append(np.arange(encounter.time_s[0], encounter.time_s[-1], _GRID_S), encounter.time_s[-1])
    good = judge(encounter, driver, grid).min_distance_m > margin_m
    turns = np.flatnonzero(good[1:] != good[:-1])
    a, b = grid[turns], grid[turns + 1]
    for _ in range(40 if len(turns) else 0):
        m = (a + b) / 2
        same = (judge(encounter, driver, m).min_distance_m > margin_m) == good[turns]
        a, b = np.where(same, m, a), np.where(same, b, m)
    borders = [*([grid[0]] if good[0] else []), *((a + b) / 2), *([np.inf] if good[-1] else [])]
    return np.array(borders).reshape(-1, 2)


def pass_probability(between_s: Float, known_s: Float, reaction: Reaction) -> Float:
    """Probability (K,) to pass when the object is known at `known_s (K,)`, inf: never; by the reaction's delay alone.

    `between_s (I, 2)`: beginnings of braking that pass, from `passing`.
    """
    if not len(between_s):
        return np.zeros(len(known_s))
    reached = _share_within(reaction, (between_s - known_s[:, None, None]).ravel()).reshape(len(known_s), -1, 2)
    probability: Float = (reached[:, :, 1] - reached[:, :, 0]).sum(axis=1)
    return np.where(np.isfinite(known_s), probability, 0.0)


def _share_within(reaction: Reaction, delay_s: Float) -> Float:
    """Probability (K,) that a reaction takes at most `delay_s (K,)`: its inverse distribution inverted, by halves."""
    low, high = np.zeros(len(delay_s)), np.ones(len(delay_s))
    finite = np.isfinite(delay_s)
    for _ in range(60):
        u = (low + high) / 2
        u = np.clip(u, 2.0**-53, 1 - 2.0**-53)
        within = delays_of(reaction, u) <= delay_s
        low, high = np.where(within, u, low), np.where(within, high, u)
    result = np.where(high <= 2.0**-52, 0.0, np.where(low >= 1 - 2.0**-52, 1.0, (low + high) / 2))
    return np.where(finite, result, np.where(delay_s > 0, 1.0, 0.0))
