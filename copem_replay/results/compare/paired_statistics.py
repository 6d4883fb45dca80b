"""Statistics of pairs: two configurations on the same rows. Pure functions; nothing here draws a random number.

*Pair*: the same row (log, object, run) in two configurations, on the same dice; what differs is the configuration.
*Difference*: the first minus the second, pair by pair, or of two figures of the same pairs.
*Discordant*: a pair that succeeded in one only. McNemar's test asks whether as many do so in the one as in the other.
*Cluster*: pairs that hang together, such as all of one log. A *resample* draws as many clusters as there are, with
replacement, both sides of a pair together: so what both have in common cancels, as it does in the difference.
*Median*: the smallest value that at least half of the weight is at or below: the value of some pair.

Letters of the shapes: i items, K clusters, R resamples, m sums. Every function raises ValueError when shapes or values
are not as said: that is a defect of the caller.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Float, Int

_CELLS = 4_000_000
"""Numbers held at a time (chosen: 32 MB)."""


def mcnemar(only_first: int, only_second: int) -> float:
    """Exact two-sided p-value of so many discordant pairs, were either kind as likely; 1 without any.

    The pairs are taken as independent. Runs of one object hang together, which makes the p-value too small: then an
    interval over whole objects or logs is the one to trust.

    Raises ValueError for negative counts.

    Source: Q. McNemar, "Note on the sampling error of the difference between correlated proportions or percentages",
    Psychometrika 12 (1947) 153–157; exact instead of χ²: the binomial distribution with p = ½.
    """
    from scipy.special import bdtr

    if only_first < 0 or only_second < 0:
        raise ValueError(f"mcnemar: expected counts of at least 0, found {only_first} and {only_second}")
    return min(1.0, 2.0 * float(bdtr(min(only_first, only_second), only_first + only_second, 0.5)))


def resampled_sums(sums: Float, count: NDArray[np.unsignedinteger[Any]]) -> Float:
    """(R, m) sums of each resample: `sums (K, m)` of the clusters, drawn `count (R, K)` times.

    Equal columns give equal sums, to the last bit. Raises ValueError for other shapes.
    """
    _check_clusters(count, len(sums))
    # Each distinct column once: a product of matrices may round equal columns differently.
    first = [next(j for j in range(k + 1) if np.array_equal(sums[:, j], sums[:, k])) for k in range(sums.shape[1])]
    distinct = sorted(set(first))
    columns = np.ascontiguousarray(sums[:, distinct], dtype=float)
    result = np.empty((len(count), len(distinct)))
    size = max(1, _CELLS // max(len(sums), 1))
    for r in range(0, len(count), size):
        result[r : r + size] = count[r : r + size].astype(float) @ columns
    of_all: Float = result[:, [distinct.index(k) for k in first]]
    return of_all


def resampled_medians(values: Float, cluster: Int, count: NDArray[np.unsignedinteger[Any]], n: Int) -> Float:
    """(R,) median of each resample: `values (i,)`, `n (i,)` times each, those of `cluster (i,)` drawn
    `count (R, K)` times.

    Values may be infinite; NaN where a resample has no value. Raises ValueError for NaN, or other shapes.
    """
    if values.shape != cluster.shape or np.isnan(values).any():
        raise ValueError("resampled_medians: expected numbers, each of a cluster")
    R, K = count.shape
    _check_clusters(count, K if not len(cluster) else max(K, int(cluster.max()) + 1))
    if not len(values):
        return np.full(R, np.nan)
    order = np.argsort(values, kind="stable")
    ranked, of, times = values[order], cluster[order], n[order]
    # In two steps: which of about √i blocks of neighbours the median is in, then where in the block. All counts are
    # whole numbers, which floats hold exactly.
    items = len(values)
    length = max(1, math.isqrt(items))
    blocks = -(-items // length)
    in_block = np.bincount(of * blocks + np.arange(items) // length, times, minlength=K * blocks).reshape(K, blocks)
    until = np.empty((R, blocks))
    size = max(1, _CELLS // K)
    for r in range(0, R, size):
        until[r : r + size] = np.cumsum(count[r : r + size].astype(float) @ in_block, axis=1)
    total = until[:, -1]
    block = np.argmax(2 * until >= total[:, None], axis=1)
    before = np.where(block > 0, until[np.arange(R), np.maximum(block - 1, 0)], 0.0)
    place = block[:, None] * length + np.arange(length)
    there = place < items
    place = np.minimum(place, items - 1)
    weight = np.where(there, count[np.arange(R)[:, None], of[place]] * times[place], 0)
    reached = 2 * (before[:, None] + np.cumsum(weight, axis=1)) >= total[:, None]
    found = ranked[place[np.arange(R), np.argmax(reached, axis=1)]]
    return np.where(total > 0, found, np.nan)


def _check_clusters(count: NDArray[Any], clusters: int) -> None:
    if count.ndim != 2 or count.shape[1] != clusters:
        raise ValueError(f"expected counts of {clusters} clusters, found {count.shape}")
