"""Verdicts: whether the declared driver, braking after the detection, stays clear.

A verdict is a function of the encounter and of the instant at which braking begins, whatever led to it. From then on
the ego is where its driver has braked to, along its own path, and never farther than it would have been without. It
passes when it stays more than the margin from the object's true motion throughout: it has stopped in time, or the
object has left its way. The others do not react. Source of the idea: Piazzoni et al. 2022; definitions:
docs/guide/metrics.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.box_distance import nearest
from copem_replay.core.kernels import borrowing
from copem_replay.core.tracks import Bool, Float
from copem_replay.metrics.braking.blocked import required
from copem_replay.metrics.braking.driver import UNRESOLVED, Driver, Reaction, deceleration_of, delays_of, survival_of

if TYPE_CHECKING:
    from copem_replay.metrics.braking.encounter import Encounter

_CELLS = 1_000_000
"""Courses × instants held at a time (chosen: 8 MB a column)."""
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
    found = Verdicts(*(np.full(len(unique), np.nan) for _ in range(4)))
    touch = np.empty(len(unique))
    rows = max(1, _CELLS // len(encounter.time_s))
    for k in range(0, len(unique), rows):
        some = slice(k, k + rows)
        way, speed = braked(encounter, driver, unique[some])
        nearest(
            way, encounter.path, encounter.size_m, encounter.other, encounter.other_size_m,
            found.min_distance_m[some], touch[some],
        )  # fmt: skip
        hit = np.flatnonzero(np.isfinite(touch[some]))
        found.impact_speed_mps[k + hit] = _at(speed[hit], touch[some][hit])
    found.impact_s[:] = _at(np.broadcast_to(encounter.time_s, (len(unique), len(encounter.time_s))), touch)
    begin_m, begin_mps, ever = _begin(encounter, unique)
    late = unique >= encounter.spent_s
    found.required_mps2[ever & late] = np.inf
    inquired = np.flatnonzero(ever & ~late)
    need = np.empty(len(inquired))
    required(encounter.time_s, encounter.stretch_m, unique[inquired], begin_m[inquired], begin_mps[inquired], need)
    found.required_mps2[inquired] = need
    return Verdicts(*(getattr(found, name)[back] for name in Verdicts.__dataclass_fields__))


def _at(values: Float, place: Float) -> Float:
    """(R,) values (R, T) at a place between the instants of each row; NaN where it is infinite."""
    result = np.full(len(place), np.nan)
    r = np.flatnonzero(np.isfinite(place))
    k = place[r].astype(np.int64)
    after = np.minimum(k + 1, values.shape[1] - 1)
    result[r] = values[r, k] + (place[r] - k) * (values[r, after] - values[r, k])
    return result


def braked(encounter: Encounter, driver: Driver, brake_s: Float) -> tuple[Float, Float]:
    """Way along the path, NaN: not in the log, and speed when braking begins at `brake_s (R,)`: (R, T) each.

    A beginning after the ego's last frame counts as never.
    """
    course, time_s = encounter.course, encounter.time_s
    begin_m, begin_mps, ever = _begin(encounter, brake_s)
    begin_s = np.where(ever, brake_s, np.inf)
    # Of each step what lies after the beginning, and the deceleration halfway through that.
    since_s = np.maximum(np.append(time_s[:1], time_s[:-1]), begin_s[:, None])
    after = time_s > begin_s[:, None]
    elapsed_s = np.where(after, (since_s + time_s) / 2 - np.where(ever, brake_s, 0.0)[:, None], 0.0)
    deceleration = deceleration_of(driver, elapsed_s, begin_mps[:, None])
    way, speed = np.empty(elapsed_s.shape), np.empty(elapsed_s.shape)
    _drive(
        time_s, course.along_m, course.bound_m, course.speed_mps, begin_s, begin_m, begin_mps, deceleration, way, speed
    )
    return way, speed


@borrowing
def _drive(
    time_s: Float, along_m: Float, bound_m: Float, recorded_mps: Float, begin_s: Float, begin_m: Float,
    begin_mps: Float, deceleration: Float, way: Float, speed: Float,
) -> None:  # fmt: skip
    """Step by step; never faster than recorded, and never faster again."""
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
                then = min(v - a * dt, recorded_mps[k])
                s += (v + then) / 2 * dt
                v = then
            way[r, k], speed[r, k] = min(s, bound_m[k]), v


def _begin(encounter: Encounter, brake_s: Float) -> tuple[Float, Float, Bool]:
    """Where the ego is and how fast when braking begins, and whether it does: (R,) each."""
    course = encounter.course
    begin_m, begin_mps = (np.interp(brake_s, encounter.time_s, of) for of in (course.bound_m, course.speed_mps))
    return begin_m, begin_mps, (brake_s <= course.until_s) & np.isfinite(brake_s)


def passing(encounter: Encounter, driver: Driver, margin_m: float) -> Float:
    """Intervals [from, to] (K, 2) of the beginnings of braking, seconds, with which the ego passes.

    Between beginnings `_GRID_S` apart that are judged alike it is taken to be judged the same; where they differ the
    border is found by halves. −inf: from the onset on, before which the ego does not brake.
    """
    grid = np.append(np.arange(encounter.time_s[0], encounter.time_s[-1], _GRID_S), encounter.time_s[-1])
    good = judge(encounter, driver, grid).min_distance_m > margin_m
    turns = np.flatnonzero(good[1:] != good[:-1])
    a, b = grid[turns], grid[turns + 1]
    for _ in range(40 if len(turns) else 0):
        m = (a + b) / 2
        same = (judge(encounter, driver, m).min_distance_m > margin_m) == good[turns]
        a, b = np.where(same, m, a), np.where(same, b, m)
    borders = [*([-np.inf] if good[0] else []), *((a + b) / 2), *([np.inf] if good[-1] else [])]
    return np.array(borders).reshape(-1, 2)


def pass_probability(between_s: Float, known_s: Float, reaction: Reaction) -> Float:
    """Probability (K,) to pass when the object is known at `known_s (K,)`, inf: never; by the reaction's delay alone.

    `between_s (I, 2)`: beginnings of braking that pass, from `passing`.
    """
    probability, _ = _begins_in(between_s, known_s, reaction)
    return np.where(np.isfinite(known_s), probability, 0.0)


def fail_probability(between_s: Float, known_s: Float, reaction: Reaction) -> Float:
    """Probability (K,) not to pass, the same way: of the beginnings between those that pass, not 1 − that to pass.

    NaN below `UNRESOLVED` where the reaction gives no survival function.
    """
    outside = np.concatenate([[-np.inf], between_s.ravel(), [np.inf]]).reshape(-1, 2)
    probability, resolved = _begins_in(outside, known_s, reaction)
    if not resolved:
        probability = np.where(probability < UNRESOLVED, np.nan, probability)
    return np.where(np.isfinite(known_s), probability, 1.0)


def _begins_in(between_s: Float, known_s: Float, reaction: Reaction) -> tuple[Float, bool]:
    """Probability (K,) that braking begins within intervals (I, 2), and whether that holds in the far tail, too."""
    if not len(between_s):
        return np.zeros(len(known_s)), True
    delay_s = between_s - np.where(np.isfinite(known_s), known_s, 0.0)[:, None, None]
    within, beyond, resolved = _tails(reaction, delay_s.ravel())
    low, high = within.reshape(delay_s.shape)[:, :, 0], within.reshape(delay_s.shape)[:, :, 1]
    later, latest = beyond.reshape(delay_s.shape)[:, :, 0], beyond.reshape(delay_s.shape)[:, :, 1]
    # Of the two tails the smaller one: its differences lose least.
    probability: Float = np.where(low < 0.5, high - low, later - latest).sum(axis=1)
    return probability, resolved


def _tails(reaction: Reaction, delay_s: Float) -> tuple[Float, Float, bool]:
    """Probabilities (K,) that a reaction takes at most, and longer than, `delay_s (K,)`; whether both hold far out."""
    within = np.where(delay_s > 0, 1.0, 0.0)
    some = np.isfinite(delay_s) & (delay_s >= 0)
    of_s = delay_s[some]
    survival = survival_of(reaction, of_s)
    if survival is None:
        within[some] = _share_within(reaction, of_s, -53)
        return within, 1 - within, False
    beyond = 1 - within
    beyond[some] = survival
    within[some] = 1 - survival
    early = np.flatnonzero(some)[survival > 0.5]
    within[early] = _share_within(reaction, delay_s[early], -1022)
    return within, beyond, True


def _share_within(reaction: Reaction, delay_s: Float, least: int) -> Float:
    """Probability (K,) that a reaction takes at most `delay_s (K,)`, 0 below 2 to the power of `least`.

    Its inverse distribution inverted: the exponent of the probability is found by halves.
    """
    low, high = np.full(len(delay_s), float(least)), np.zeros(len(delay_s))
    for _ in range(70 if len(delay_s) else 0):
        middle = (low + high) / 2
        within = delays_of(reaction, np.minimum(np.exp2(middle), 1 - 2.0**-53)) <= delay_s
        low, high = np.where(within, middle, low), np.where(within, high, middle)
    share: Float = np.exp2((low + high) / 2)
    return np.where(low == least, 0.0, np.where(high == 0, 1.0, share))
