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


@nb.njit(cache=True, nogil=True)
def _filter(listed: Float, held: Bool, log_same: Float, share: Float, edges: Float, out: Float) -> None:
    """Fill `out (P,)`; `edges`: between which the density of U is constant, 0 … 1; `log_same`: ln φ of each list.

    Once something is certain not to be, what follows it is 0.
    """
    width = np.diff(edges)
    mass = width.copy()
    for i in range(len(listed)):
        p, s = listed[i], share[i]
        renewed = -np.expm1(log_same[i])
        below = 0.0  # mass of U below p, and above it: each by itself, as either may be tiny
        above = 0.0
        for j in range(len(mass)):
            mass[j] = np.exp(log_same[i]) * mass[j] + renewed * width[j]
            if edges[j] < p:
                below += mass[j]
            else:
                above += mass[j]
        hit, miss = (1 - s) * p + s * below, (1 - s) * (1 - p) + s * above
        chance, other = (hit, miss) if held[i] else (miss, hit)
        if chance <= 0:
            out[i] = -np.inf
            return
        out[i] = np.log1p(-other) if other < 0.5 else np.log(chance)
        for j in range(len(mass)):
            fits = (edges[j] < p) == held[i]
            by_fresh = (1 - s) * (p if held[i] else 1 - p)
            mass[j] *= (by_fresh + (s if fits else 0.0)) / chance
