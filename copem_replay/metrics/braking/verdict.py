"""Verdicts: whether the declared driver, braking after the detection, stays clear.

A verdict is a function of the encounter and of the instant at which braking begins, whatever led to it. From then on
the ego moves along its own path as its driver brakes, and never farther than it would without braking. It passes when
it stays more than the margin from the object's true motion throughout: it has stopped in time, or the object has left
its path. Other objects do not react. Source of the idea: Piazzoni et al. 2022; definitions:
docs/guide/metrics.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.compiled import borrowing_kernel
from copem_replay.core.geometry import find_smallest_distances
from copem_replay.core.tracks import Bool, Float
from copem_replay.metrics.braking.driver import (
    UNRESOLVED,
    Driver,
    Reaction,
    driver_deceleration,
    reaction_delays,
    reaction_survival,
)
from copem_replay.metrics.braking.encounter import find_required_deceleration

if TYPE_CHECKING:
    from copem_replay.metrics.braking.encounter import Encounter


_CELLS = 1_000_000
"""Courses × instants held at a time, 8 MB a column: the size of blocks, which changes no result."""
_GRID_S = 0.005
"""Seconds between beginnings of braking that are tried, half of `NODE_S`: a shorter turn to pass or fail is missed."""


@dataclass(frozen=True)
class Verdicts:
    """The outcome of one encounter for beginnings of braking (R,), inf: never. All (R,), NaN: does not exist.

    `min_distance_m`: smallest box distance. `impact_s`, `impact_speed_mps`: when the boxes first touch, and the ego's
    speed then. `required_mps2`: smallest constant deceleration from `brake_s` on that stays clear, inf: none does.
    """

    min_distance_m: Float
    impact_s: Float
    impact_speed_mps: Float
    required_mps2: Float


def judge_braking(encounter: Encounter, driver: Driver, brake_s: Float) -> Verdicts:
    """Verdicts for beginnings of braking (R,). Raises InputError where a driver of the user's own fails."""
    unique, index = np.unique(brake_s, return_inverse=True)
    verdicts = Verdicts(*(np.full(len(unique), np.nan) for _ in range(4)))
    touch = np.empty(len(unique))
    rows = max(1, _CELLS // len(encounter.time_s))
    for k in range(0, len(unique), rows):
        block = slice(k, k + rows)
        way_m, speed = simulate_braking(encounter, driver, unique[block])
        find_smallest_distances(
            way_m, encounter.path, encounter.size_m, encounter.other, encounter.other_size_m,
            verdicts.min_distance_m[block], touch[block],
        )  # fmt: skip
        hit = np.flatnonzero(np.isfinite(touch[block]))
        verdicts.impact_speed_mps[k + hit] = _interpolate_rows(speed[hit], touch[block][hit])
    verdicts.impact_s[:] = _interpolate_rows(
        np.broadcast_to(encounter.time_s, (len(unique), len(encounter.time_s))), touch
    )
    begin_m, begin_mps, ever = _find_braking_start(encounter, unique)
    late = unique >= encounter.spent_s
    verdicts.required_mps2[ever & late] = np.inf
    braked = np.flatnonzero(ever & ~late)
    need = np.empty(len(braked))
    find_required_deceleration(
        encounter.time_s, encounter.stretch_m, unique[braked], begin_m[braked], begin_mps[braked], need
    )
    verdicts.required_mps2[braked] = need
    return Verdicts(*(getattr(verdicts, name)[index] for name in Verdicts.__dataclass_fields__))


def _interpolate_rows(values: Float, place: Float) -> Float:
    """(R,) values (R, T) at a place (R,) between the instants of each row; NaN where the place is infinite."""
    result = np.full(len(place), np.nan)
    r = np.flatnonzero(np.isfinite(place))
    k = place[r].astype(np.int64)
    after = np.minimum(k + 1, values.shape[1] - 1)
    result[r] = values[r, k] + (place[r] - k) * (values[r, after] - values[r, k])
    return result


def simulate_braking(encounter: Encounter, driver: Driver, brake_s: Float) -> tuple[Float, Float]:
    """(R, T) way along the path, NaN where not in the log, and (R, T) speed, for braking from `brake_s (R,)` on.

    A beginning after the ego's last frame counts as never.
    """
    course, time_s = encounter.course, encounter.time_s
    begin_m, begin_mps, ever = _find_braking_start(encounter, brake_s)
    begin_s = np.where(ever, brake_s, np.inf)
    # The part of each step after the beginning of braking, and the deceleration halfway through that part.
    since_s = np.maximum(np.append(time_s[:1], time_s[:-1]), begin_s[:, None])
    after = time_s > begin_s[:, None]
    elapsed_s = np.where(after, (since_s + time_s) / 2 - np.where(ever, brake_s, 0.0)[:, None], 0.0)
    deceleration = driver_deceleration(driver, elapsed_s, begin_mps[:, None])
    way, speed = np.empty(elapsed_s.shape), np.empty(elapsed_s.shape)
    _drive_braking(
        time_s, course.along_m, course.bound_m, course.speed_mps, begin_s, begin_m, begin_mps, deceleration, way, speed
    )
    return way, speed


@borrowing_kernel
def _drive_braking(
    time_s: Float, along_m: Float, bound_m: Float, recorded_mps: Float, begin_s: Float, begin_m: Float,
    begin_mps: Float, deceleration: Float, way: Float, speed: Float,
) -> None:  # fmt: skip
    """Fills `way` (m), `speed` (m/s), each (R, T): braking from `begin_s (R,)` on, never faster than recorded."""
    for r in range(len(begin_s)):
        s, v = begin_m[r], begin_mps[r]
        for k in range(len(time_s)):
            if time_s[k] <= begin_s[r]:
                way[r, k], speed[r, k] = along_m[k], recorded_mps[k]
                continue
            dt = time_s[k] - (begin_s[r] if k == 0 else max(time_s[k - 1], begin_s[r]))
            a = deceleration[r, k]
            if a * dt >= v:
                s += v * v / (2 * a) if a > 0 else 0.0
                v = 0.0
            else:
                next_mps = min(v - a * dt, recorded_mps[k])
                s += (v + next_mps) / 2 * dt
                v = next_mps
            way[r, k], speed[r, k] = min(s, bound_m[k]), v


def _find_braking_start(encounter: Encounter, brake_s: Float) -> tuple[Float, Float, Bool]:
    """(R,) each: way and speed of the ego when braking begins, and whether it begins."""
    course = encounter.course
    begin_m, begin_mps = (np.interp(brake_s, encounter.time_s, column) for column in (course.bound_m, course.speed_mps))
    return begin_m, begin_mps, (brake_s <= course.until_s) & np.isfinite(brake_s)


def find_passing_intervals(encounter: Encounter, driver: Driver, margin_m: float) -> Float:
    """Intervals [from, to] (K, 2) of the beginnings of braking, seconds, with which the ego passes.

    Beginnings between two that are `_GRID_S` apart and judged alike are taken to be judged so; where the two differ,
    the border is found by bisection. −inf: from the onset on, before which the ego does not brake.
    """
    grid = np.append(np.arange(encounter.time_s[0], encounter.time_s[-1], _GRID_S), encounter.time_s[-1])
    passes = judge_braking(encounter, driver, grid).min_distance_m > margin_m
    turns = np.flatnonzero(passes[1:] != passes[:-1])
    a, b = grid[turns], grid[turns + 1]
    for _ in range(40 if len(turns) else 0):
        middle = (a + b) / 2
        unchanged = (judge_braking(encounter, driver, middle).min_distance_m > margin_m) == passes[turns]
        a, b = np.where(unchanged, middle, a), np.where(unchanged, b, middle)
    borders = [*([-np.inf] if passes[0] else []), *((a + b) / 2), *([np.inf] if passes[-1] else [])]
    return np.array(borders).reshape(-1, 2)


def pass_probability(between_s: Float, known_s: Float, reaction: Reaction) -> Float:
    """Probability (K,) to pass when the object is known at `known_s (K,)`, inf: never, over the reaction's delay.

    `between_s (I, 2)`: intervals of beginnings of braking that pass, from `find_passing_intervals`.
    """
    probability, _ = _probability_between(between_s, known_s, reaction)
    return np.where(np.isfinite(known_s), probability, 0.0)


def fail_probability(between_s: Float, known_s: Float, reaction: Reaction) -> Float:
    """Probability (K,) to fail when the object is known at `known_s (K,)`, inf: never, over the reaction's delay.

    Of the beginnings outside `between_s`, not 1 − the probability to pass. NaN below `UNRESOLVED` where the reaction
    has no survival function.
    """
    outside = np.concatenate([[-np.inf], between_s.ravel(), [np.inf]]).reshape(-1, 2)
    probability, resolved = _probability_between(outside, known_s, reaction)
    if not resolved:
        probability = np.where(probability < UNRESOLVED, np.nan, probability)
    return np.where(np.isfinite(known_s), probability, 1.0)


def _probability_between(between_s: Float, known_s: Float, reaction: Reaction) -> tuple[Float, bool]:
    """Probability (K,) that braking begins within intervals (I, 2), and whether it is exact in the far tail."""
    if not len(between_s):
        return np.zeros(len(known_s)), True
    delay_s = between_s - np.where(np.isfinite(known_s), known_s, 0.0)[:, None, None]
    within, beyond, resolved = _reaction_tails(reaction, delay_s.ravel())
    low, high = within.reshape(delay_s.shape)[:, :, 0], within.reshape(delay_s.shape)[:, :, 1]
    later, latest = beyond.reshape(delay_s.shape)[:, :, 0], beyond.reshape(delay_s.shape)[:, :, 1]
    # The smaller of the two tails, as its differences lose the fewest digits.
    probability: Float = np.where(low < 0.5, high - low, later - latest).sum(axis=1)
    return probability, resolved


def _reaction_tails(reaction: Reaction, delay_s: Float) -> tuple[Float, Float, bool]:
    """Probabilities (K,) of a reaction within `delay_s (K,)`, and beyond; whether both are exact far out."""
    probability_within = np.where(delay_s > 0, 1.0, 0.0)
    possible = np.isfinite(delay_s) & (delay_s >= 0)
    possible_s = delay_s[possible]
    survival = reaction_survival(reaction, possible_s)
    if survival is None:
        probability_within[possible] = _share_within(reaction, possible_s, -53)
        return probability_within, 1 - probability_within, False
    probability_beyond = 1 - probability_within
    probability_beyond[possible] = survival
    probability_within[possible] = 1 - survival
    early = np.flatnonzero(possible)[survival > 0.5]
    probability_within[early] = _share_within(reaction, delay_s[early], -1022)
    return probability_within, probability_beyond, True


def _share_within(reaction: Reaction, delay_s: Float, least: int) -> Float:
    """Probability (K,) that a reaction takes at most `delay_s (K,)`, 0 below 2 to the power of `least`. By bisection of
    its exponent, as only the inverse of the distribution is known.
    """
    low, high = np.full(len(delay_s), float(least)), np.zeros(len(delay_s))
    for _ in range(70 if len(delay_s) else 0):
        middle = (low + high) / 2
        within = reaction_delays(reaction, np.minimum(np.exp2(middle), 1 - 2.0**-53)) <= delay_s
        low, high = np.where(within, middle, low), np.where(within, high, middle)
    share: Float = np.exp2((low + high) / 2)
    return np.where(low == least, 0.0, np.where(high == 0, 1.0, share))
