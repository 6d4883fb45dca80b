"""Tables of detection probabilities fitted to rows, shrunk towards what they have in common."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv, betaln

from copem_replay.core.tracks import Bool, Float
from copem_replay.metrics.intervals import DRAWN_FROM, percentile_limits, resamples
from copem_replay.pipeline.fit.estimate import Estimate
from copem_replay.pipeline.fit.nodes import Entries, Placed
from copem_replay.pipeline.fit.table_kernel import em, em_many

_DRAWN = 200
"""Resamples (chosen)."""
STRENGTHS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""As so many effective rows a prior counts, one of these (chosen). The least keeps a node off 0 and 1; the most is less
than a node has of its own: tables that look alike are not known to be.
"""


@dataclass(frozen=True)
class TableFit:
    """Probabilities `theta (K,)` at the nodes, and how they came about.

    Shrunk towards one `constant` and, where there are several tables, these towards the one of all, each with a prior
    of so many effective rows (`strength`, one number for each level). `worth`: rows per effective row.
    """

    theta: Float
    constant: float
    strength: tuple[float, ...]
    worth: float


def fit_table(entries: Entries, times: Float, worth: float, *, monotone: bool) -> TableFit:
    """Fit to the passes, each of which counts so many `times`; `worth`: rows per effective row."""
    count = entries.count.T @ times
    constant = (count @ entries.hit / worth + 0.5) / (count.sum() / worth + 1)  # Jeffreys
    levels = _levels(entries.placed)
    theta, strength = np.array([constant]), []
    for level in levels:
        parent = np.resize(theta, int(np.prod(level.shape)))
        theta, prior = _shrunk(level, entries.hit, count, parent, worth, monotone)
        strength.append(prior)
    return TableFit(theta if levels else np.array([constant]), float(constant), tuple(strength), worth)


def _levels(placed: Placed) -> list[Placed]:
    """From the table of all to the tables; none where there is but one node."""
    levels = [placed.pooled()] if placed.shape[1] * placed.shape[2] > 1 else []
    return [*levels, placed] if placed.shape[0] > 1 else levels


def _shrunk(
    placed: Placed, hit: Bool, count: Float, parent: Float, worth: float, monotone: bool
) -> tuple[Float, float]:
    """Probabilities shrunk towards `parent (K,)`, and by how many effective rows: those of greatest likelihood.

    The likelihood of a strength, all probabilities integrated out in their log-odds, by Laplace's approximation.
    """
    shape, theta, best = np.array(placed.shape), parent, (-np.inf, parent, 0.0)
    for strength in STRENGTHS:
        a, b = strength * parent, strength * (1 - parent)
        prior = worth * np.stack([a, b])
        theta = em(theta, placed.node, placed.weight, hit, count, prior, shape, monotone)[0]
        p, inside = placed.chances(theta), theta * (1 - theta)
        curve = inside[:, None] * information(placed, theta, count / worth) * inside + np.diag(strength * inside)
        likely = (
            count @ np.log(np.where(hit, p, 1 - p)) / worth
            + (a * np.log(theta) + b * np.log1p(-theta) - betaln(a, b) + np.log(2 * np.pi) / 2).sum()
            - np.linalg.slogdet(curve)[1] / 2
        )
        if likely > best[0]:
            best = float(likely), theta, strength
    return best[1:]


def information(placed: Placed, theta: Float, count: Float) -> Float:
    """(K, K) what so many rows at each place (C,) tell of the probabilities at the nodes."""
    p = np.clip(placed.chances(theta), 1e-9, 1 - 1e-9)
    dense = np.zeros((len(p), len(theta)))
    for m in range(4):
        np.add.at(dense, (np.arange(len(p)), placed.node[:, m]), placed.weight[:, m])
    result: Float = (dense * (count / (p * (1 - p)))[:, None]).T @ dense
    return result


def estimates(
    entries: Entries, rows: Placed, fit: TableFit, *, monotone: bool, resampled: bool = True
) -> tuple[list[Estimate], Float]:
    """The probability at each node with its interval, and the covariance (K, K) of all.

    That of as many independent rows as there are effectively (Jeffreys). Where there are enough passes to resample the
    wider of both on each side: resamples see neither what hardly ever happens nor the shrinking.
    """
    theta, placed = fit.theta, entries.placed
    passes = entries.count.shape[0]
    count = np.asarray(entries.count.sum(axis=0))
    K, inside = len(theta), theta * (1 - theta)
    strength = fit.strength[-1] if fit.strength else 1.0
    curve = information(placed, theta, count / fit.worth) + np.diag(strength / inside)
    covariance = np.asarray(np.linalg.inv(curve), dtype=np.float64)
    touched = np.zeros(K, dtype=np.int64)
    np.add.at(touched, rows.node[rows.weight > 0], 1)
    effective = np.minimum(inside / np.diag(covariance), touched / fit.worth)
    low, high = (betaincinv(theta * effective + 0.5, (1 - theta) * effective + 0.5, q) for q in (0.025, 0.975))
    if passes >= DRAWN_FROM and resampled:
        drawn = resamples([str(k) for k in range(passes)], 0, _DRAWN)
        theta_drawn = _resampled(entries, fit, drawn.count.astype(float), monotone)
        covariance[:] = np.cov(theta_drawn.T)
        for k in range(K):
            a, b = percentile_limits(theta_drawn[:, k], drawn)
            low[k], high[k] = min(low[k], a), max(high[k], b)
    columns = zip(theta, low, high, touched, effective, strict=True)
    return [Estimate(float(t), float(a), float(b), int(n), float(e)) for t, a, b, n, e in columns], covariance


def _resampled(entries: Entries, fit: TableFit, times: Float, monotone: bool) -> Float:
    """(R, K) as `fit_table` at its strengths, with passes counted so many `times (R, passes)`."""
    count = np.ascontiguousarray(times @ entries.count)
    total = count.sum(axis=1)
    theta: Float = ((count @ entries.hit / fit.worth + 0.5) / (total / fit.worth + 1))[:, None]
    for level, strength in zip(_levels(entries.placed), fit.strength, strict=True):
        K = int(np.prod(level.shape))
        parent = np.tile(theta, (1, K // theta.shape[1]))
        prior = fit.worth * strength * np.stack([parent, 1 - parent], axis=1)
        start = fit.theta if len(fit.theta) == K else fit.theta.reshape(-1, K).mean(axis=0)
        theta = _each(level, entries.hit, start, monotone, count, prior)
    return theta


def _each(placed: Placed, hit: Bool, start: Float, monotone: bool, count: Float, prior: Float) -> Float:
    """(R, K) of the counts (R, C) and priors (R, 2, K), from one start; some at a time, in threads."""
    shape = np.array(placed.shape)

    def fitted(count: Float, prior: Float) -> Float:
        result: Float = em_many(start, placed.node, placed.weight, hit, count, prior, shape, monotone, 1e-5)
        return result

    with ThreadPoolExecutor() as threads:
        return np.concatenate(list(threads.map(fitted, np.array_split(count, 8), np.array_split(prior, 8))))
