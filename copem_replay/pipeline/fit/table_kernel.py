"""Compiled: tables of probabilities fitted by EM, and monotone regression on their nodes.

Letters of the shapes: C entries (rows that were put together), K nodes of G tables of I ranges × J visible shares.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.core.tracks import Bool, Float, Int

_LEAST = 1e-12


@nb.njit(cache=True, nogil=True)
def em_many(
    theta: Float,
    node: Int,
    weight: Float,
    hit: Bool,
    count: Float,
    prior: Float,
    shape: Int,
    monotone: bool,
    close: float,
) -> Float:
    """(R, K) as `em`, from one start, for counts (R, C) and priors (R, 2, K)."""
    out = np.empty((len(count), len(theta)))
    for r in range(len(count)):
        out[r] = em(theta, node, weight, hit, count[r], prior[r], shape, monotone, close)[0]
    return out


@nb.njit(cache=True, nogil=True)
def em(
    theta: Float,
    node: Int,
    weight: Float,
    hit: Bool,
    count: Float,
    prior: Float,
    shape: Int,
    monotone: bool,
    close: float = 1e-7,
) -> tuple[Float, Float]:
    """Probabilities (K,) at the nodes that make p = Σ weight · θ of the entries likeliest, and the counts (2, K).

    `node`, `weight` (C, 4): between which nodes an entry lies, `count (C,)` how many rows it stands for, `hit` whether
    they are listed. `prior (2, K)`: hits and misses that are added to each node. `shape (3,)`: G, I, J. Each step
    shares a row among its nodes by what they have in its probability, and takes hits over rows at each node. Two steps
    are extrapolated where that is better (SQUAREM, scheme 3; Varadhan and Roland, Scand. J. Statist. 35, 2008).
    """
    counts = np.zeros((2, len(theta)))
    here = theta.copy()
    for _ in range(300):
        _share_out(here, node, weight, hit, count, prior, counts)
        one = _ratio(counts, shape, monotone)
        level = _share_out(one, node, weight, hit, count, prior, counts)
        two = _ratio(counts, shape, monotone)
        first, second = one - here, two - 2 * one + here
        done = np.abs(two - one).max() < close
        ahead = np.sqrt((first**2).sum() / max((second**2).sum(), 1e-300))
        here, far = two, here + 2 * ahead * first + ahead**2 * second
        if done:
            break
        if ahead > 1:
            far = np.minimum(np.maximum(far, _LEAST), 1 - _LEAST)
            if monotone:
                far = monotone_tables(far, np.ones(len(far)), shape)
            if _share_out(far, node, weight, hit, count, prior, counts) > level:
                here = far
    _share_out(here, node, weight, hit, count, prior, counts)
    return here, counts - prior


@nb.njit(cache=True, nogil=True)
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


@nb.njit(cache=True, nogil=True)
def _ratio(counts: Float, shape: Int, monotone: bool) -> Float:
    total = np.maximum(counts[0] + counts[1], _LEAST)
    share = np.minimum(np.maximum(counts[0] / total, _LEAST), 1 - _LEAST)
    return monotone_tables(share, total, shape) if monotone else share


@nb.njit(cache=True, nogil=True)
def monotone_tables(value: Float, weight: Float, shape: Int) -> Float:
    """The nearest tables (K,) in weighted squares that do not rise with range nor fall with visible share.

    For shares of counts these are the likeliest such tables, too. Projections on the one order and on the other in
    turn, each without what it had taken away before (Dykstra and Robertson, Ann. Statist. 10, 1982).
    """
    tables, ranges, shares = shape
    out = value.copy()
    taken = np.zeros((2, len(value)))
    for _ in range(1000):
        before = out.copy()
        for order in range(2):
            wanted = out + taken[order]
            for g in range(tables):
                first = g * ranges * shares
                if order == 0:
                    for j in range(shares):
                        part = slice(first + j, first + ranges * shares, shares)
                        out[part] = -_ascending(-wanted[part], weight[part])
                else:
                    for i in range(ranges):
                        part = slice(first + i * shares, first + (i + 1) * shares)
                        out[part] = _ascending(wanted[part], weight[part])
            taken[order] = wanted - out
        if ranges == 1 or shares == 1 or np.abs(out - before).max() < 1e-10:
            break
    return out


@nb.njit(cache=True, nogil=True)
def _ascending(value: Float, weight: Float) -> Float:
    """The nearest ascending values: neighbours that are out of order are pooled."""
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
    at = 0
    for k in range(top):
        out[at : at + size[k]] = mean[k]
        at += size[k]
    return out
