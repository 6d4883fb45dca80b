"""Which share of a unit's detections goes by a number that lasts, and for how long: by the likelihood of what it lists.

The likelihood is that of the filter which gives exact times: metrics/lasting_survival.py. Intervals are those of the
profile likelihood: all values at which it is no more than half of χ²'s 95 % quantile below its best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import minimize
from scipy.special import expit, logit

from copem_replay.core.text import counted
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.lasting_survival import Sequences
from copem_replay.pipeline.fit.choice import FEWEST_PASSES
from copem_replay.pipeline.fit.estimate import Estimate

LEVELS = 50
"""Probabilities are told apart by steps of π/2 over this in their arcsine: at most 2e-4 nats per list lost (chosen)."""
_SHARES = (0.01, 0.999)
_DROP = 1.9207294
"""Half of the 95 % quantile of χ² with one degree of freedom."""
_GRID = 9
_FINE = 601


@dataclass(frozen=True)
class MemoryFit:
    """`share` of the lists that go by a held number, and its `correlation_s`, ∞: always the same one.

    `gain`: log-likelihood per list above that without memory, of the passes it was fitted to.
    """

    share: Estimate
    correlation_s: Estimate
    gain: float


def pass_starts(pass_ix: Int) -> Int:
    """(N + 1,) where each pass begins; its rows lie together."""
    return np.flatnonzero(np.r_[True, pass_ix[1:] != pass_ix[:-1], True])


def sequences_of(listed: Bool, probability: Float, captured_s: Float, pass_ix: Int) -> Sequences:
    """What the passes show, with no more than some hundred different probabilities: means of those close together."""
    level = np.rint(np.arcsin(np.sqrt(probability)) * (2 * LEVELS / np.pi)).astype(np.int64)
    count = np.maximum(np.bincount(level), 1)
    return Sequences.of(
        pass_starts(pass_ix), (np.bincount(level, probability) / count)[level], listed, captured_s
    )  # fmt: skip


def why_no_memory(listed: Bool, pass_ix: Int) -> str | None:
    """Why the data cannot tell how long detection lasts; None where they can."""
    passes = len(np.unique(pass_ix))
    for what, where in (("miss", ~listed), ("hit", listed)):
        if not where.any():
            return f"no {what} in {counted(len(listed), 'list')}"
    if passes < FEWEST_PASSES or len(listed) == passes:
        return f"{counted(passes, 'pass', 'passes')}: no correlation time of detection can be told"
    return None


def fit_memory(seen: Sequences, *, intervals: bool = True) -> MemoryFit:
    """Share and correlation time of the greatest likelihood, given the probabilities of detection.

    Correlation times from a third of the period up to twenty of the longest pass are tried; the last is `always`.
    """
    length_s = np.add.reduceat(seen.gap_s, seen.start[:-1]).max()
    period_s = float(np.median(seen.gap_s[seen.gap_s > 0]))
    bounds = np.array([logit(_SHARES), np.log([period_s / 3, 20 * length_s])])

    def likelihood(at: Float) -> float:
        share, tau = np.clip(at, bounds[:, 0], bounds[:, 1])
        return float(seen.log_probability(expit(share), np.exp(tau)).sum())

    starts = [
        np.array([s, t])
        for s in logit([0.3, 0.7, 0.95])
        for t in bounds[1, 0] + np.array([0.2, 0.4, 0.6, 0.8]) * np.ptp(bounds[1])
    ]
    first = max(starts, key=likelihood)
    options = {"xatol": 0.01, "fatol": 0.005, "initial_simplex": first + np.array([[0, 0], [0.5, 0], [0, 0.5]])}
    found = minimize(lambda at: -likelihood(at), first, method="Nelder-Mead", options=options)
    best = np.clip(found.x, bounds[:, 0], bounds[:, 1])
    limits = _profile_limits(likelihood, best, bounds) if intervals else np.full((2, 2), np.nan)
    # A limit that the likelihood does not reach within bounds is the end of what there is.
    open_ends = np.abs(limits - bounds) < 1e-6
    shares = np.where(open_ends[0], [0.0, 1.0], expit(limits[0]))
    taus = np.where(open_ends[1], [0.0, np.inf], np.exp(limits[1]))
    share, tau = float(expit(best[0])), float(np.exp(best[1]))
    n = len(seen.listed)
    worth = n / design_effect(share, tau, seen)
    always = best[1] > bounds[1, 1] - 0.01
    return MemoryFit(
        Estimate(share, float(shares[0]), float(shares[1]), n, worth),
        Estimate(np.inf if always else tau, float(taus[0]), float(taus[1]), n, worth),
        float(likelihood(best) - seen.log_probability(0.0, 1.0).sum()) / n,
    )


def design_effect(share: float, tau_s: float, seen: Sequences) -> float:
    """By how much more the mean of the lists of a pass varies than that of as many that are independent.

    1 + 2 Σ (1 − k/m) s²φᵏ over passes of m lists, for any gaps between them.
    """
    total = 0.0
    for a, b in zip(seen.start[:-1], seen.start[1:], strict=True):
        at = np.cumsum(seen.gap_s[a:b])
        ahead = 0.0
        for same in np.exp(-np.diff(at) / tau_s).tolist():
            ahead = same * (ahead + 1)
            total += ahead
    return 1 + 2 * share**2 * total / len(seen.listed)


def _profile_limits(likelihood: Callable[[Float], float], best: Float, bounds: Float) -> Float:
    """(2, 2) from where to where each number may be: of a spline through the likelihood on a grid about its best."""
    top = likelihood(best)
    bend = np.array([2 * top - likelihood(best + step) - likelihood(best - step) for step in 0.2 * np.eye(2)]) / 0.04
    half = np.clip(3 / np.sqrt(np.maximum(bend, 1e-9)), 0.1, 2)[:, None] * [-1.0, 1.0]  # how far the grid reaches
    for _ in range(6):
        ends = np.clip(best[:, None] + half, bounds[:, :1], bounds[:, 1:])
        axes = [np.linspace(low, high, _GRID) for low, high in ends.tolist()]
        grid = np.array([[likelihood(np.array([s, t])) for t in axes[1]] for s in axes[0]])
        fine = [np.linspace(low, high, _FINE) for low, high in ends.tolist()]
        spline = RectBivariateSpline(*axes, grid)(*fine)
        profiles = [spline.max(axis=1), spline.max(axis=0)]
        inside = [profile >= max(grid.max(), top) - _DROP for profile in profiles]
        wide = np.array([[keep[0], keep[-1]] for keep in inside]) & (np.abs(ends - bounds) > 1e-9)
        if not wide.any():
            break
        half = np.where(wide, 2 * half, half)
    return np.array([[axis[keep][0], axis[keep][-1]] for axis, keep in zip(fine, inside, strict=True)])
