"""Tables of detection probabilities fitted to rows, shrunk towards what they have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv, betaln
from scipy.stats import t

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.extras.fitting.estimate import PASSES_ALONE, Estimate
from copem_replay.extras.fitting.rows import NodeWeights, PooledRows

# Kernels: EM on the nodes of tables, and monotone regression. Shapes: C pooled rows, K nodes of G tables of I ranges ×
# J visible shares.

_LEAST = 1e-12
"""Probabilities keep this far from 0 and 1 within EM, where logarithms are taken."""
_CLOSE = 1e-7
"""A step of EM by less is its last."""


@kernel
def fit_em(
    theta: Float, node: Int, weight: Float, hit: Bool, count: Float, prior: Float, shape: Int, monotone: bool
) -> tuple[Float, Float]:
    """Maximum-likelihood probabilities (K,) at the nodes, p = Σ weight · θ, and the hits and misses there (2, K).

    `node`, `weight` (C, 4): the nodes around a pooled row; `count (C,)`: how many rows it stands for; `hit`: whether
    they are listed. `prior (2, K)`: hits and misses that are added to each node. `shape (3,)`: G, I, J. Each step
    shares a row among its nodes by their parts in its probability, and takes hits over rows at each node. Two steps
    are extrapolated where that is better (SQUAREM, scheme 3; Varadhan and Roland, Scand. J. Statist. 35, 2008).
    """
    counts = np.zeros((2, len(theta)))
    current = theta.copy()
    for _ in range(300):
        _share_out(current, node, weight, hit, count, prior, counts)
        step1 = _divide_counts(counts, shape, monotone)
        level = _share_out(step1, node, weight, hit, count, prior, counts)
        step2 = _divide_counts(counts, shape, monotone)
        first, second = step1 - current, step2 - 2 * step1 + current
        done = np.abs(step2 - step1).max() < _CLOSE
        ahead = np.sqrt((first**2).sum() / max((second**2).sum(), 1e-300))
        current, leap = step2, current + 2 * ahead * first + ahead**2 * second
        if done:
            break
        if ahead > 1:
            leap = np.minimum(np.maximum(leap, _LEAST), 1 - _LEAST)
            if monotone:
                leap = monotone_tables(leap, np.ones(len(leap)), shape)
            if _share_out(leap, node, weight, hit, count, prior, counts) > level:
                current = leap
    _share_out(current, node, weight, hit, count, prior, counts)
    return current, counts - prior


@callee
def _share_out(theta: Float, node: Int, weight: Float, hit: Bool, count: Float, prior: Float, counts: Float) -> float:
    """Fill `counts (2, K)` with hits and misses of each node and its prior; the penalised log-likelihood of `theta`."""
    counts[:] = prior
    total = 0.0
    for k in range(len(theta)):
        if prior[0, k] > 0:
            total += prior[0, k] * np.log(theta[k])
        if prior[1, k] > 0:
            total += prior[1, k] * np.log(1 - theta[k])
    for c in range(len(count)):
        if count[c] == 0:
            continue
        p = 0.0
        for m in range(4):
            value = theta[node[c, m]]
            p += weight[c, m] * (value if hit[c] else 1 - value)
        p = max(p, _LEAST)
        total += count[c] * np.log(p)
        side = 0 if hit[c] else 1
        for m in range(4):
            value = theta[node[c, m]]
            counts[side, node[c, m]] += count[c] * weight[c, m] * (value if hit[c] else 1 - value) / p
    return total


@callee
def _divide_counts(counts: Float, shape: Int, monotone: bool) -> Float:
    total = np.maximum(counts[0] + counts[1], _LEAST)
    share = np.minimum(np.maximum(counts[0] / total, _LEAST), 1 - _LEAST)
    return monotone_tables(share, total, shape) if monotone else share


@callee
def monotone_tables(value: Float, weight: Float, shape: Int) -> Float:
    """The nearest tables (K,) in weighted squares that do not rise with range nor fall with visible share.

    For shares of counts these are also the likeliest such tables. Projections on either order in turn, each after its
    last correction is given back (Dykstra and Robertson, Ann. Statist. 10, 1982).
    """
    tables, ranges, shares = shape
    out = value.copy()
    corrections = np.zeros((2, len(value)))
    for _ in range(1000):
        before = out.copy()
        for order in range(2):
            target = out + corrections[order]
            for g in range(tables):
                first = g * ranges * shares
                if order == 0:
                    for j in range(shares):
                        part = slice(first + j, first + ranges * shares, shares)
                        out[part] = -_fit_ascending(-target[part], weight[part])
                else:
                    for i in range(ranges):
                        part = slice(first + i * shares, first + (i + 1) * shares)
                        out[part] = _fit_ascending(target[part], weight[part])
            corrections[order] = target - out
        if ranges == 1 or shares == 1 or np.abs(out - before).max() < 1e-10:
            break
    return out


@callee
def _fit_ascending(value: Float, weight: Float) -> Float:
    """The ascending values nearest to `value` in weighted squares: neighbours out of order are pooled (PAVA)."""
    n = len(value)
    mean, mass, size = np.empty(n), np.empty(n), np.empty(n, dtype=np.int64)
    top = 0
    for i in range(n):
        mean[top], mass[top], size[top] = value[i], weight[i], 1
        top += 1
        while top > 1 and mean[top - 2] > mean[top - 1]:
            total = mass[top - 2] + mass[top - 1]
            mean[top - 2] = (mean[top - 2] * mass[top - 2] + mean[top - 1] * mass[top - 1]) / total
            mass[top - 2], size[top - 2] = total, size[top - 2] + size[top - 1]
            top -= 1
    out = np.empty(n)
    position = 0
    for k in range(top):
        out[position : position + size[k]] = mean[k]
        position += size[k]
    return out


# Fits of tables.

STRENGTHS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Effective rows that a prior may count as. The least keeps a node off 0 and 1; the most is less than a node has of its
own, as tables that look alike are not known to be."""


@dataclass(frozen=True)
class TableFit:
    """Probabilities `theta (K,)` at the nodes, and how they are shrunk.

    The table of all rows is shrunk towards one constant, and where there are several tables these towards that of
    all, each by a prior of `strength` effective rows, one number for each level. `worth`: rows per effective row.
    """

    theta: Float
    strength: tuple[float, ...]
    worth: float


def fit_table(entries: PooledRows, times: Float, worth: float, *, monotone: bool) -> TableFit:
    """Fit to the passes; `times (passes,)`: how often each counts; `worth`: rows per effective row."""
    count = entries.count.T @ times
    constant = (count @ entries.hit / worth + 0.5) / (count.sum() / worth + 1)  # Jeffreys
    tables, by_range, by_share = (placed := entries.placed).shape
    levels = [placed.pooled()] * (by_range * by_share > 1) + [placed] * (tables > 1)  # of one node: none
    theta, strength = np.array([constant]), []
    for level in levels:
        parent = np.resize(theta, int(np.prod(level.shape)))
        theta, prior = _shrink_table(level, entries.hit, count, parent, worth, monotone)
        strength.append(prior)
    return TableFit(theta if levels else np.array([constant]), tuple(strength), worth)


def _shrink_table(
    placed: NodeWeights, hit: Bool, count: Float, parent: Float, worth: float, monotone: bool
) -> tuple[Float, float]:
    """Probabilities (K,) shrunk towards `parent (K,)`, and the likeliest strength of that, in effective rows. The
    likelihood of a strength is Laplace's approximation, all probabilities integrated out in their log-odds.
    """
    shape, theta, best = np.array(placed.shape), parent, (-np.inf, parent, 0.0)
    for strength in STRENGTHS:
        a, b = strength * parent, strength * (1 - parent)
        prior = worth * np.stack([a, b])
        theta = fit_em(theta, placed.node, placed.weight, hit, count, prior, shape, monotone)[0]
        p, spread = placed.chances(theta), theta * (1 - theta)
        curve = spread[:, None] * fisher_information(placed, theta, count / worth) * spread + np.diag(strength * spread)
        log_likelihood = (
            count @ np.log(np.where(hit, p, 1 - p)) / worth
            + (a * np.log(theta) + b * np.log1p(-theta) - betaln(a, b) + np.log(2 * np.pi) / 2).sum()
            - np.linalg.slogdet(curve)[1] / 2
        )
        if log_likelihood > best[0]:
            best = float(log_likelihood), theta, strength
    return best[1:]


def fisher_information(placed: NodeWeights, theta: Float, count: Float) -> Float:
    """(K, K) Fisher information on the probabilities at the nodes of `count (C,)` pooled rows."""
    p, dense = np.clip(placed.chances(theta), 1e-9, 1 - 1e-9), placed.dense()
    result: Float = (dense * (count / (p * (1 - p)))[:, None]).T @ dense
    return result


def estimate_nodes(entries: PooledRows, rows: NodeWeights, fit: TableFit) -> list[Estimate]:
    """The probability at each node with Jeffreys' interval of an effective number of rows.

    These are the rows that touch the node, or what the information is worth there, over rows per effective row. Where
    PASSES_ALONE passes touch it there are no more than θ(1 − θ)/V · (t of n − 1 / t of K − 1)² as for shares over logs
    (`metrics/limits.py`), V the variance by the scores of whole passes.
    """
    theta, placed = fit.theta, entries.placed
    spread, dense = theta * (1 - theta), placed.dense()
    strength = fit.strength[-1] if fit.strength else 1.0
    information = fisher_information(placed, theta, np.asarray(entries.count.sum(axis=0)))
    inverse = np.linalg.inv(information + fit.worth * np.diag(strength / spread))
    touched = np.bincount(rows.node[rows.weight > 0], minlength=len(theta))
    effective = np.minimum(spread / np.diag(inverse), touched) / fit.worth
    p = np.clip(placed.chances(theta), 1e-9, 1 - 1e-9)
    scores = entries.count @ (dense * ((entries.hit - p) / (p * (1 - p)))[:, None])
    passes = ((entries.count @ (dense > 0)) > 0).sum(axis=0)
    several = np.maximum(passes, 2)
    variance = ((scores @ inverse) ** 2).sum(axis=0) * several / (several - 1)
    ratio = t.ppf(0.975, np.maximum(touched - 1, 1)) / t.ppf(0.975, several - 1)
    by_passes = np.where(variance > 0, spread / np.maximum(variance, 1e-300) * ratio**2, np.inf)
    effective = np.where(passes < PASSES_ALONE, effective, np.maximum(np.minimum(effective, by_passes), 1.0))
    limits = (betaincinv(theta * effective + 0.5, (1 - theta) * effective + 0.5, q) for q in (0.025, 0.975))
    columns = (column.tolist() for column in (theta, *limits, touched, effective))
    return [Estimate(*one) for one in zip(*columns, strict=True)]
