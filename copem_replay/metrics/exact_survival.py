"""Exact survival: the probability that an object is still unknown after each list, in logarithms, so that no tail is
lost.

A list holds the object with probability p. Lists are independent given the truth, except where detection lasts
(`LastingDetection`). The logarithm of the probability that the object is not known yet is carried on from instant to
instant, and nothing is computed as one minus its complement. Beside it goes d ln P(never) / dδ, δ being added to the
log-odds of every p: how strongly the tail depends on error models.

Where detection lasts, a list holds the object when its uniform number is below p. With probability 1 − s that number is
new, with s it is the held one, U, which by the next list, Δ later, is still the same with probability φ = e^(−Δ/τ). The
distribution of U after any sequence of lists has therefore a density that is constant between the p of the lists: n
lists take n times as many steps as they have different p. The density is normalised at each list and the logarithms are
summed.

Letters of the shapes: P lists of one object, K instants at which some arrive, N series of lists. Definitions:
docs/guide/metrics.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int

# Where detection lasts: the probability of a sequence of lists with and without the object, by a filter.

_STEP = 1e-4
"""Step in log-odds of the central difference that gives the derivative: its error is some 1e-8 of the derivative."""


@dataclass(frozen=True)
class LastingDetection:
    """How the detection of lists (P,) lasts: by a number that the lists of one process share.

    `process`: number of the process, −1: none. `share`: probability that a list uses the held number instead of a new
    one. `tau_s`: correlation time of the held number in seconds, equal within a process; inf: it never changes, 0: it
    is new at every capture. `captured_s`: instants of capture.
    """

    process: Int
    share: Float
    tau_s: Float
    captured_s: Float

    def take(self, rows: Int) -> LastingDetection:
        """The lists of these rows."""
        return LastingDetection(self.process[rows], self.share[rows], self.tau_s[rows], self.captured_s[rows])

    def log_missed(self, listed: Float, fresh: Float) -> Float:
        """(P,) ln of the probability that each list misses the object, given that its process's earlier lists miss it.

        `listed (P,)`: probability that the list holds the object; `fresh (P,)`: ln of the probability of a miss where
        the list has no process. Lists of a process arrive in the order of their captures.
        """
        missed = fresh.copy()
        for number in np.unique(self.process[self.process >= 0]):
            rows = np.flatnonzero(self.process == number)
            rows = rows[np.argsort(self.captured_s[rows], kind="stable")]
            not_held = np.zeros(len(rows), dtype=np.bool_)
            gap_s = np.diff(self.captured_s[rows], prepend=self.captured_s[rows[:1]])
            missed[rows] = log_sequence(listed[rows], not_held, gap_s, self.share[rows], float(self.tau_s[rows[0]]))
        return missed

    def slope(self, listed: Float) -> float:
        """The derivative of ln P(all lists of all processes miss) by δ, added to the log-odds of every p."""
        rows = np.flatnonzero(self.process >= 0)
        if not len(rows):
            return 0.0
        lasting, p = self.take(rows), listed[rows]
        up, down = (lasting.log_missed(scale_odds(p, np.exp(step)), np.zeros(len(p))).sum() for step in (_STEP, -_STEP))
        return float(up - down) / (2 * _STEP) if np.isfinite(up) and np.isfinite(down) else np.nan


def scale_odds(listed: Float, odds: float) -> Float:
    """(P,) probabilities whose odds p / (1 − p) are `odds` times those of `listed (P,)`."""
    result: Float = odds * listed / (1 + (odds - 1) * listed)
    return result


def log_sequence(listed: Float, held: Bool, gap_s: Float, share: Float, tau_s: float) -> Float:
    """(P,) ln of the probability of what each list shows, given the lists before it; the sum is that of the sequence.

    Lists in order of capture, all (P,): `held`: whether the list holds the object; `listed`: the probability that it
    does; `gap_s`: seconds since the list before; `share`: probability that it uses the held number, of correlation time
    `tau_s`.
    """
    out = np.zeros(len(listed))
    edges = np.unique(np.concatenate([[0.0, 1.0], listed]))
    with np.errstate(invalid="ignore", divide="ignore"):
        log_same = np.where(gap_s > 0, -gap_s / tau_s, 0.0)
    _filter_sequence(listed, held, log_same, np.ascontiguousarray(share), edges, out)
    return out


@dataclass(frozen=True)
class Sequences:
    """What the lists (P,) of several series show, one series after the other: series n begins at `start[n]`, (N + 1,).

    In each series in order of capture: `listed`: probability that the list holds the object; `held`: whether it does;
    `gap_s`: seconds since the list before. `edges`: 0, 1 and the different p of each series, from `edge_start[n]` on,
    (N + 1,).
    """

    start: Int
    listed: Float
    held: Bool
    gap_s: Float
    edges: Float
    edge_start: Int

    @classmethod
    def of(cls, start: Int, listed: Float, held: Bool, captured_s: Float) -> Sequences:
        """The series of lists (P,): probability `listed`, whether `held`, capture (s); series i from `start[i]` on."""
        number = np.repeat(np.arange(len(start) - 1), np.diff(start))
        ends = np.repeat(np.arange(len(start) - 1), 2)
        edges = np.concatenate([listed, np.tile([0.0, 1.0], len(start) - 1)])
        number = np.concatenate([number, ends])
        order = np.lexsort((edges, number))
        number, edges = number[order], edges[order]
        is_new = np.r_[True, (np.diff(number) > 0) | (np.diff(edges) > 0)]
        gap_s = np.diff(captured_s, prepend=captured_s[:1])
        gap_s[start[:-1]] = 0.0
        bounds = np.searchsorted(number[is_new], np.arange(len(start)))
        return cls(start, listed, np.ascontiguousarray(held), gap_s, edges[is_new], bounds)

    def log_probability(self, share: float, tau_s: float) -> Float:
        """(P,) ln of the probability of what each list shows, given the lists before it in its series."""
        out = np.zeros(len(self.listed))
        _filter_sequences(
            self.start, self.listed, self.held, -self.gap_s / tau_s, np.full(len(out), share), self.edge_start,
            self.edges, out,
        )  # fmt: skip
        return out


@kernel
def _filter_sequences(
    start: Int, listed: Float, held: Bool, log_same: Float, share: Float, edge_start: Int, edges: Float, out: Float
) -> None:
    for n in range(len(start) - 1):
        a, b = start[n], start[n + 1]
        cells = edges[edge_start[n] : edge_start[n + 1]]
        _filter_sequence(listed[a:b], held[a:b], log_same[a:b], share[a:b], cells, out[a:b])


@kernel
def _filter_sequence(listed: Float, held: Bool, log_same: Float, share: Float, edges: Float, out: Float) -> None:
    """Fill `out (P,)`: ln of the probability of each hit (`held`) or miss after the former. `edges`: U is even between.

    `log_same (P,)`: ln φ. After a list that is impossible, −inf, the rest of `out` stays 0.
    """
    width = np.diff(edges)
    mass = width.copy()
    for i in range(len(listed)):
        p, s = listed[i], share[i]
        same, renewed = np.exp(log_same[i]), -np.expm1(log_same[i])
        for j in range(len(mass)):
            mass[j] = same * mass[j] + renewed * width[j]
        first = np.searchsorted(edges, p)  # the first cell above p
        below = 0.0  # mass of U below p, and above it: each summed by itself, as either may be tiny
        for j in range(first):
            below += mass[j]
        above = 0.0
        for j in range(first, len(mass)):
            above += mass[j]
        hit, miss = (1 - s) * p + s * below, (1 - s) * (1 - p) + s * above
        chance, other = (hit, miss) if held[i] else (miss, hit)
        if chance <= 0:
            out[i] = -np.inf
            return
        out[i] = np.log1p(-other) if other < 0.5 else np.log(chance)
        by_fresh = (1 - s) * (p if held[i] else 1 - p)
        by_both = (by_fresh + s) / chance
        by_fresh /= chance
        for j in range(first):
            mass[j] *= by_both if held[i] else by_fresh
        for j in range(first, len(mass)):
            mass[j] *= by_fresh if held[i] else by_both


_HALF = 0.5
"""The tail is computed once more with the odds of every detection halved."""


# The distribution of the instant at which an object is first known.


@dataclass(frozen=True)
class FirstKnown:
    """When an object is first known: `probability (K,)` at the instants `time_s (K,)`, else never.

    `log_never`: ln P(never), −inf where the object is certain to be known. `per_logit`: its derivative by δ, then NaN.
    `log_never_half`: ln P(never) were the odds p / (1 − p) of every list halved.
    """

    time_s: Float
    probability: Float
    log_never: float
    per_logit: float
    log_never_half: float


def first_known(
    arrives_s: Float, listed: Float, unit_ix: Int, share: Float, lasts: LastingDetection | None = None
) -> FirstKnown:
    """When the first list holds the object: lists (P,) arrive at `arrives_s` and hold it with probability `listed`.

    A unit that is there with probability q < 1, `share (U,)`, misses the object with (1 − q) + q Π (1 − p). `lasts`:
    how detection lasts, None: it does not. The units of one process are there in all runs.
    """
    time_s, instant = _group_by_instant(arrives_s)
    missed, half = _log_missed(listed, 1.0), _log_missed(listed, _HALF)
    if lasts is not None:
        missed, half = lasts.log_missed(listed, missed), lasts.log_missed(scale_odds(listed, _HALF), half)
    step, slope, log_half = np.zeros(len(time_s)), 0.0, 0.0
    # The units that are certain to be there form one group.
    group = np.where(share[unit_ix] == 1, -1, unit_ix)
    order = np.argsort(group, kind="stable")
    numbers, begins = np.unique(group[order], return_index=True)
    for number, rows in zip(numbers, np.split(order, begins[1:]), strict=False):
        presence = 1.0 if number < 0 else float(share[number])
        unit_step = _sum_by_instant(instant[rows], missed[rows], len(time_s))
        step += _weigh_by_presence(unit_step, presence)
        log_half += float(_weigh_by_presence(half[rows].sum(keepdims=True), presence)[0])
        # The derivative counts only if the unit is there, which is improbable when all its lists have missed.
        p_there = float(_posterior_presence(unit_step.sum(keepdims=True), presence)[0][0])
        if lasts is None:
            slope -= p_there * float(listed[rows].sum())
        else:
            unit_lasts = lasts.take(rows)
            slope += p_there * (unit_lasts.slope(listed[rows]) - float(listed[rows][unit_lasts.process < 0].sum()))
    unknown = np.cumsum(step)
    probability = np.exp(_shift_by_one(unknown)) * (0.0 - np.expm1(step))
    return _build_first_known(time_s, probability, float(unknown[-1]) if len(unknown) else 0.0, slope, log_half)


def first_confirmed(instant: Int, arrives_s: Float, listed: Float, hits: int, window: int) -> FirstKnown:
    """When `hits` ≥ 2 of the last `window` captures hold the object for the first time; lists (P,) as in `first_known`.

    `instant (P,)`: number of the capture instant of each list. Lists of one instant arrive together, and those of a
    later instant not sooner: several instants may arrive together.
    """
    time_s, arrival = _group_by_instant(arrives_s)
    number, place = np.unique(instant, return_inverse=True)
    arrival_of = np.zeros(len(number), dtype=np.int64)
    arrival_of[place] = arrival
    gaps = np.minimum(np.diff(number, prepend=number[:1]) - 1, window)
    total = _sum_by_instant(place, listed, len(number))
    probability, half = np.zeros(len(number)), np.zeros(len(number))
    log_never, slope = _run_chain(
        _sum_by_instant(place, _log_missed(listed, 1.0), len(number)), total, gaps, hits, window, probability
    )
    log_half, _ = _run_chain(
        _sum_by_instant(place, _log_missed(listed, _HALF), len(number)), total, gaps, hits, window, half
    )
    return _build_first_known(time_s, _sum_by_instant(arrival_of, probability, len(time_s)), log_never, slope, log_half)


def _build_first_known(
    time_s: Float, probability: Float, log_never: float, slope: float, log_half: float
) -> FirstKnown:
    certain = log_never == -np.inf
    # + 0.0: without any list zeros have no sign.
    return FirstKnown(time_s, probability, log_never + 0.0, np.nan if certain else slope + 0.0, log_half + 0.0)


def _log_missed(listed: Float, odds: float) -> Float:
    """(P,) ln of the probability of a miss, (1 − p) / (1 − p + odds · p), of p = `listed` with multiplied odds."""
    with np.errstate(divide="ignore"):  # certain: −inf
        missed: Float = np.log1p(-listed) - np.log1p((odds - 1) * listed)
    return missed


def _group_by_instant(arrives_s: Float) -> tuple[Float, Int]:
    """Instants (K,) of arrival, and the index of its instant for each list (P,)."""
    order = np.argsort(arrives_s, kind="stable")
    ordered = arrives_s[order]
    begins = np.diff(ordered, prepend=-np.inf) > SAME_INSTANT_S
    instant = np.empty(len(order), dtype=np.int64)
    instant[order] = np.cumsum(begins) - 1
    return ordered[begins], instant


def _sum_by_instant(instant: Int, values: Float, count: int) -> Float:
    """(K,) sums of values (P,) by instant."""
    return np.bincount(instant, weights=values, minlength=count).astype(np.float64)


def _shift_by_one(unknown: Float) -> Float:
    """(K,) the value before each instant, 0 before the first."""
    return np.append(0.0, unknown)[:-1]


def _posterior_presence(log_missed: Float, share: float) -> tuple[Float, Float]:
    """Probabilities (K,) that a unit is there, and that it is not, given that it missed the object: Bayes' rule.

    `log_missed (K,)`: ln of the probability of the miss if the unit is there. `share`: prior probability that it is.
    """
    from scipy.special import expit, logit

    if share == 1:
        return np.ones(len(log_missed)), np.zeros(len(log_missed))
    log_odds = logit(share) + log_missed
    return expit(log_odds), expit(-log_odds)


def _weigh_by_presence(step: Float, share: float) -> Float:
    """(K,) the steps in ln P(unknown) of a unit that is there with probability `share`, from those if it is there.

    No step, near 0 or near −∞, is computed as the difference of two nearly equal numbers.
    """
    if share == 1:
        return step
    present, absent = _posterior_presence(_shift_by_one(np.cumsum(step)), share)
    detected = present * -np.expm1(step)
    return np.where(detected < 0.5, np.log1p(-np.minimum(detected, 0.5)), np.log(absent + present * np.exp(step)))


@kernel
def _run_chain(
    step: Float, listed: Float, gaps: Int, hits: int, window: int, probability: Float
) -> tuple[float, float]:
    """The log of P(never confirmed) and its derivative by δ; fills `probability (K,)`, of confirmation at each instant.

    A Markov chain over which of the last `window` − 1 captures hold the object. `step (K,)`: ln of the probability that
    no list of the instant holds it; `listed (K,)`: the sum of their p; `gaps (K,)`: captures without the object before
    it. Masses are logarithms; derivatives that meet in a state are weighted by them.
    """
    states = 1 << (window - 1)
    hits_in = np.zeros(states, dtype=np.int64)
    for state in range(1, states):
        hits_in[state] = hits_in[state >> 1] + (state & 1)
    mass, slope = np.full(states, -np.inf), np.zeros(states)
    mass[0] = 0.0
    known_probability, known_slope = 0.0, 0.0
    for k in range(len(step)):
        for _ in range(gaps[k]):
            mass, slope = _advance_chain(mass, slope, hits_in, window + 1, 0.0, 0.0, -np.inf, 0.0)
        hit, hit_slope = -np.inf, 0.0
        if step[k] < 0:
            hit, hit_slope = np.log(-np.expm1(step[k])), listed[k] / np.expm1(-step[k])
        new, confirmed_slope = -np.inf, 0.0
        for state in range(states):
            if hits_in[state] + 1 >= hits:
                new, confirmed_slope = _add_logs(new, confirmed_slope, mass[state] + hit, slope[state] + hit_slope)
        probability[k] = np.exp(new)
        known_probability += probability[k]
        known_slope += probability[k] * confirmed_slope
        mass, slope = _advance_chain(mass, slope, hits_in, hits, step[k], -listed[k], hit, hit_slope)
    if known_probability < 0.5:  # then the rest is near 1, and its logarithm near 0
        return np.log1p(-known_probability), -known_slope / (1 - known_probability)
    never_log, never_slope = -np.inf, 0.0
    for state in range(states):
        never_log, never_slope = _add_logs(never_log, never_slope, mass[state], slope[state])
    return never_log, never_slope


@callee
def _advance_chain(
    mass: Float, slope: Float, hits_in: Int, hits: int, miss: float, miss_slope: float, hit: float, hit_slope: float
) -> tuple[Float, Float]:
    """The log masses and slopes (states,) one capture on: each state goes on by a miss, or a hit (below `hits`)."""
    states = len(mass)
    new, new_slope = np.full(states, -np.inf), np.zeros(states)
    for state in range(states):
        next_state = (state << 1) & (states - 1)
        new[next_state], new_slope[next_state] = _add_logs(
            new[next_state], new_slope[next_state], mass[state] + miss, slope[state] + miss_slope
        )
        if hits_in[state] + 1 < hits:
            new[next_state | 1], new_slope[next_state | 1] = _add_logs(
                new[next_state | 1], new_slope[next_state | 1], mass[state] + hit, slope[state] + hit_slope
            )
    return new, new_slope


@callee
def _add_logs(a: float, a_slope: float, b: float, b_slope: float) -> tuple[float, float]:
    """ln(eᵃ + eᵇ), and its derivative from those of a and b."""
    if b == -np.inf:
        return a, a_slope
    if a == -np.inf:
        return b, b_slope
    if a < b:
        a, b, a_slope, b_slope = b, a, b_slope, a_slope
    share = np.exp(b - a)
    return a + np.log1p(share), (a_slope + share * b_slope) / (1 + share)
