"""Survival where detection lasts: how probable a sequence of lists with and without an object is, by a filter.

A list holds the object when its uniform is below p. With probability 1 − s the uniform is new, with s it is the held
one, U, which by the next list, Δ later, is still the same with probability φ = e^(−Δ/τ). So what is known of U after
any sequence is a density that is constant between the p of the lists: n lists take n times as many steps as they have
different p. The density is normalised at each list and logarithms are summed, so that no tail is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from copem_replay.core.tracks import Bool, Float, Int

_STEP = 1e-4
"""By how much log-odds are moved for their derivative (chosen: error some 1e-8 of it)."""


@dataclass(frozen=True)
class Lasting:
    """Of lists (P,): with which `share` they go by a held number, of which `process` (−1: none), captured when.

    `tau_s (P,)`: correlation time of that number, the same for all lists of a process; inf: always the same number,
    0: a new one at every capture.
    """

    process: Int
    share: Float
    tau_s: Float
    captured_s: Float

    def take(self, rows: Int) -> Lasting:
        """Of some lists only."""
        return Lasting(self.process[rows], self.share[rows], self.tau_s[rows], self.captured_s[rows])

    def log_missed(self, listed: Float, fresh: Float) -> Float:
        """(P,) ln of the probability that each list misses the object, given that those before it of its process do.

        `listed (P,)`: with which probability it holds the object, `fresh (P,)`: ln of the probability of a miss. Lists
        of a process arrive in the order of their captures.
        """
        missed = fresh.copy()
        for number in np.unique(self.process[self.process >= 0]):
            mine = np.flatnonzero(self.process == number)
            mine = mine[np.argsort(self.captured_s[mine], kind="stable")]
            none = np.zeros(len(mine), dtype=np.bool_)
            gap_s = np.diff(self.captured_s[mine], prepend=self.captured_s[mine[:1]])
            missed[mine] = log_sequence(listed[mine], none, gap_s, self.share[mine], float(self.tau_s[mine[0]]))
        return missed

    def slope(self, listed: Float) -> float:
        """The derivative of ln P(all lists of all processes miss) by δ, added to the log-odds of every p."""
        mine = np.flatnonzero(self.process >= 0)
        if not len(mine):
            return 0.0
        some, p = self.take(mine), listed[mine]
        up, down = (some.log_missed(moved_odds(p, np.exp(step)), np.zeros(len(p))).sum() for step in (_STEP, -_STEP))
        return float(up - down) / (2 * _STEP) if np.isfinite(up) and np.isfinite(down) else np.nan


def moved_odds(listed: Float, odds: float) -> Float:
    """(P,) p whose odds p / (1 − p) are so many times those of `listed`."""
    result: Float = odds * listed / (1 + (odds - 1) * listed)
    return result


def log_sequence(listed: Float, held: Bool, gap_s: Float, share: Float, tau_s: float) -> Float:
    """(P,) ln of the probability of what each list shows, `held` the object or not, given those before it.

    Lists in order of capture: `listed` with which probability, `gap_s` since the one before, `share` of its draws that
    last with the correlation time `tau_s`. Their sum is ln of the probability of the sequence.
    """
    out = np.zeros(len(listed))
    edges = np.unique(np.concatenate([[0.0, 1.0], listed]))
    with np.errstate(invalid="ignore", divide="ignore"):
        log_same = np.where(gap_s > 0, -gap_s / tau_s, 0.0)
    _filter(listed, held, log_same, np.ascontiguousarray(share), edges, out)
    return out


@dataclass(frozen=True)
class Sequences:
    """What several series of lists show, one after the other: `start (N + 1,)` where each begins, lists (P,).

    In each series in order of capture: `listed` with which probability, `held` the object or not, `gap_s` since the
    list before. `edges`: 0, 1 and the different p of each series, which begin at `edge_start (N + 1,)`.
    """

    start: Int
    listed: Float
    held: Bool
    gap_s: Float
    edges: Float
    edge_start: Int

    @classmethod
    def of(cls, start: Int, listed: Float, held: Bool, captured_s: Float) -> Sequences:
        """Of lists captured at instants, series by series."""
        number = np.repeat(np.arange(len(start) - 1), np.diff(start))
        ends = np.repeat(np.arange(len(start) - 1), 2)
        edges = np.concatenate([listed, np.tile([0.0, 1.0], len(start) - 1)])
        number = np.concatenate([number, ends])
        order = np.lexsort((edges, number))
        number, edges = number[order], edges[order]
        new = np.r_[True, (np.diff(number) > 0) | (np.diff(edges) > 0)]
        gap_s = np.diff(captured_s, prepend=captured_s[:1])
        gap_s[start[:-1]] = 0.0
        bounds = np.searchsorted(number[new], np.arange(len(start)))
        return cls(start, listed, np.ascontiguousarray(held), gap_s, edges[new], bounds)

    def log_probability(self, share: float, tau_s: float) -> Float:
        """(P,) as `log_sequence` of each series."""
        out = np.zeros(len(self.listed))
        _filter_each(
            self.start, self.listed, self.held, -self.gap_s / tau_s, np.full(len(out), share), self.edge_start,
            self.edges, out,
        )  # fmt: skip
        return out


@nb.njit(cache=True, nogil=True)
def _filter_each(
    start: Int, listed: Float, held: Bool, log_same: Float, share: Float, edge_start: Int, edges: Float, out: Float
) -> None:
    for n in range(len(start) - 1):
        a, b = start[n], start[n + 1]
        cells = edges[edge_start[n] : edge_start[n + 1]]
        _filter(listed[a:b], held[a:b], log_same[a:b], share[a:b], cells, out[a:b])


@nb.njit(cache=True, nogil=True)
def _filter(listed: Float, held: Bool, log_same: Float, share: Float, edges: Float, out: Float) -> None:
    """Fill `out (P,)`; `edges`: between which the density of U is constant, 0 … 1; `log_same`: ln φ of each list.

    Once something is certain not to be, what follows it is 0.
    """
    width = np.diff(edges)
    mass = width.copy()
    for i in range(len(listed)):
        p, s = listed[i], share[i]
        same, renewed = np.exp(log_same[i]), -np.expm1(log_same[i])
        for j in range(len(mass)):
            mass[j] = same * mass[j] + renewed * width[j]
        first = np.searchsorted(edges, p)  # the first cell above p
        below = 0.0  # mass of U below p, and above it: each by itself, as either may be tiny
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
