"""Survival: how probably an object is still unknown after each list, in logarithms, so that no tail is lost.

Lists are independent given the truth, but where detection lasts (`lasting_survival.py`); a list holds the object with
probability p. What is carried on from instant to instant is the logarithm of the probability that the object is not
known yet, and nothing is one minus its complement.
Beside it goes d ln P(never) / dδ, δ being added to the log-odds of every p: how much the tail hangs on error models.
Letters of the shapes: P lists of one object, K instants at which some arrive. Definitions: docs/guide/metrics.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS, Float, Int
from copem_replay.metrics.lasting_survival import Lasting, moved_odds

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9
_HALF = 0.5
"""Half the odds: at which the tail is worked out once more."""


@dataclass(frozen=True)
class FirstKnown:
    """When an object is first known: `probability (K,)` at the instants `time_s (K,)`, else never.

    `log_never`: ln P(never), −inf where it is certain to be known. `per_logit`: its derivative by δ, NaN there.
    `log_never_half`: ln P(never) were the odds p / (1 − p) of every list halved.
    """

    time_s: Float
    probability: Float
    log_never: float
    per_logit: float
    log_never_half: float


def first_of(arrives_s: Float, listed: Float, unit_ix: Int, share: Float, lasts: Lasting | None = None) -> FirstKnown:
    """When the first list holds the object; `arrives_s (P,)`, `listed (P,)` with which probability p, 0 … 1.

    A unit that is there with probability q < 1, `share (U,)`, misses the object with (1 − q) + q Π (1 − p). `lasts`:
    of which lists detection lasts, None: of none; then the units of one process are there in all runs.
    """
    time_s, instant = _by_instant(arrives_s)
    missed, half = _log_missed(listed, 1.0), _log_missed(listed, _HALF)
    if lasts is not None:
        missed, half = lasts.log_missed(listed, missed), lasts.log_missed(moved_odds(listed, _HALF), half)
    step, slope, log_half = np.zeros(len(time_s)), 0.0, 0.0
    # Units that are certain to be there are one group.
    group = np.where(share[unit_ix] == 1, -1, unit_ix)
    order = np.argsort(group, kind="stable")
    numbers, begins = np.unique(group[order], return_index=True)
    for number, mine in zip(numbers, np.split(order, begins[1:]), strict=False):
        there = 1.0 if number < 0 else float(share[number])
        alone = _at(instant[mine], missed[mine], len(time_s))
        step += _perhaps(alone, there)
        log_half += float(_perhaps(half[mine].sum(keepdims=True), there)[0])
        # Its lists can tell more only if it is there, which it hardly is when all of them have missed.
        still = float(_there(alone.sum(keepdims=True), there)[0][0])
        if lasts is None:
            slope -= still * float(listed[mine].sum())
        else:
            some = lasts.take(mine)
            slope += still * (some.slope(listed[mine]) - float(listed[mine][some.process < 0].sum()))
    unknown = np.cumsum(step)
    probability = np.exp(_before(unknown)) * (0.0 - np.expm1(step))
    return _known(time_s, probability, float(unknown[-1]) if len(unknown) else 0.0, slope, log_half)


def confirmed(instant: Int, arrives_s: Float, listed: Float, hits: int, of: int) -> FirstKnown:
    """When for the first time `hits` ≥ 2 of the last `of` captures hold the object; lists (P,) as in `first_of`.

    `instant (P,)`: number of the capture instant of each list. What is captured together arrives together, what is
    captured later not sooner: several instants may arrive together, too.
    """
    time_s, arrival = _by_instant(arrives_s)
    number, place = np.unique(instant, return_inverse=True)
    arrival_of = np.zeros(len(number), dtype=np.int64)
    arrival_of[place] = arrival
    without = np.minimum(np.diff(number, prepend=number[:1]) - 1, of)
    total = _at(place, listed, len(number))
    probability, half = np.zeros(len(number)), np.zeros(len(number))
    log_never, slope = _chain(_at(place, _log_missed(listed, 1.0), len(number)), total, without, hits, of, probability)
    log_half, _ = _chain(_at(place, _log_missed(listed, _HALF), len(number)), total, without, hits, of, half)
    return _known(time_s, _at(arrival_of, probability, len(time_s)), log_never, slope, log_half)


def _known(time_s: Float, probability: Float, log_never: float, slope: float, log_half: float) -> FirstKnown:
    certain = log_never == -np.inf
    # No list at all: zeros without a sign.
    return FirstKnown(time_s, probability, log_never + 0.0, np.nan if certain else slope + 0.0, log_half + 0.0)


def _log_missed(listed: Float, odds: float) -> Float:
    """(P,) ln of the probability of a miss when the odds of p (P,) are so many times what they are.

    It is (1 − p) / (1 − p + odds · p).
    """
    with np.errstate(divide="ignore"):  # certain: −inf
        missed: Float = np.log1p(-listed) - np.log1p((odds - 1) * listed)
    return missed


def _by_instant(arrives_s: Float) -> tuple[Float, Int]:
    """Instants (K,) of arrival, and of which of them each list (P,) is."""
    order = np.argsort(arrives_s, kind="stable")
    ordered = arrives_s[order]
    begins = np.diff(ordered, prepend=-np.inf) > _TOLERANCE_S
    instant = np.empty(len(order), dtype=np.int64)
    instant[order] = np.cumsum(begins) - 1
    return ordered[begins], instant


def _at(instant: Int, values: Float, count: int) -> Float:
    """(K,) sums of values (P,) by instant."""
    return np.bincount(instant, weights=values, minlength=count).astype(np.float64)


def _before(unknown: Float) -> Float:
    """(K,) what was before each instant, 0 before the first."""
    return np.append(0.0, unknown)[:-1]


def _there(log_missed: Float, share: float) -> tuple[Float, Float]:
    """How probably a unit is there, and is not, if it has missed the object: Bayes' rule. All (K,).

    `log_missed`: ln of the probability that it does if it is there. `share`: how probably it is.
    """
    from scipy.special import expit, logit

    if share == 1:
        return np.ones(len(log_missed)), np.zeros(len(log_missed))
    log_odds = logit(share) + log_missed
    return expit(log_odds), expit(-log_odds)


def _perhaps(step: Float, share: float) -> Float:
    """(K,) the steps of a unit that is there with probability `share`, from those (K,) of one that is.

    Neither a step near 0 nor one near −∞ is the difference of two numbers.
    """
    if share == 1:
        return step
    there, absent = _there(_before(np.cumsum(step)), share)
    found = there * -np.expm1(step)
    return np.where(found < 0.5, np.log1p(-np.minimum(found, 0.5)), np.log(absent + there * np.exp(step)))


@nb.njit(cache=True, nogil=True)
def _chain(step: Float, listed: Float, without: Int, hits: int, of: int, probability: Float) -> tuple[float, float]:
    """A chain over which of the last `of` − 1 captures hold the object: fills `probability (K,)`, gives ln P(never).

    `step (K,)`: ln of the probability that no list of the instant holds it, `listed (K,)`: the sum of their p,
    `without (K,)`: captures without the object before it. Each state has the logarithm of its mass and, by δ, the
    derivative of that logarithm; what meets in a state is weighted by its masses. Returns the derivative, too.
    """
    states = 1 << (of - 1)
    held = np.zeros(states, dtype=np.int64)
    for state in range(1, states):
        held[state] = held[state >> 1] + (state & 1)
    mass, slope = np.full(states, -np.inf), np.zeros(states)
    mass[0] = 0.0
    known, known_slope = 0.0, 0.0
    for k in range(len(step)):
        for _ in range(without[k]):
            mass, slope = _moved(mass, slope, held, of + 1, 0.0, 0.0, -np.inf, 0.0)
        hit, hit_slope = -np.inf, 0.0
        if step[k] < 0:
            hit, hit_slope = np.log(-np.expm1(step[k])), listed[k] / np.expm1(-step[k])
        done, done_slope = -np.inf, 0.0
        for state in range(states):
            if held[state] + 1 >= hits:
                done, done_slope = _met(done, done_slope, mass[state] + hit, slope[state] + hit_slope)
        probability[k] = np.exp(done)
        known += probability[k]
        known_slope += probability[k] * done_slope
        mass, slope = _moved(mass, slope, held, hits, step[k], -listed[k], hit, hit_slope)
    if known < 0.5:  # then the rest is near 1, and its logarithm near 0
        return np.log1p(-known), -known_slope / (1 - known)
    rest, rest_slope = -np.inf, 0.0
    for state in range(states):
        rest, rest_slope = _met(rest, rest_slope, mass[state], slope[state])
    return rest, rest_slope


@nb.njit(cache=True, nogil=True)
def _moved(
    mass: Float, slope: Float, held: Int, hits: int, miss: float, miss_slope: float, hit: float, hit_slope: float
) -> tuple[Float, Float]:
    """One capture on: of each two states that differ in the oldest capture only, a miss and a hit lead to one each."""
    states = len(mass)
    new, new_slope = np.full(states, -np.inf), np.zeros(states)
    for state in range(states):
        after = (state << 1) & (states - 1)
        new[after], new_slope[after] = _met(new[after], new_slope[after], mass[state] + miss, slope[state] + miss_slope)
        if held[state] + 1 < hits:
            new[after | 1], new_slope[after | 1] = _met(
                new[after | 1], new_slope[after | 1], mass[state] + hit, slope[state] + hit_slope
            )
    return new, new_slope


@nb.njit(cache=True, nogil=True)
def _met(a: float, a_slope: float, b: float, b_slope: float) -> tuple[float, float]:
    """ln(eᵃ + eᵇ), and its derivative."""
    if b == -np.inf:
        return a, a_slope
    if a == -np.inf:
        return b, b_slope
    if a < b:
        a, b, a_slope, b_slope = b, a, b_slope, a_slope
    share = np.exp(b - a)
    return a + np.log1p(share), (a_slope + share * b_slope) / (1 + share)
