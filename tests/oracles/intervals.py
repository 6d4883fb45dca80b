"""Intervals over clusters computed plainly: cluster by cluster, with SciPy's distributions, matrices written out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats


def exact(p: float, n: float) -> tuple[float, float]:
    """Clopper–Pearson of p·n in n."""
    k = p * n
    low = 0.0 if k <= 1e-9 else float(stats.beta.ppf(0.025, k, n - k + 1))
    high = 1.0 if n - k <= 1e-9 else float(stats.beta.ppf(0.975, k + 1, n - k))
    return low, high


def effective(clusters: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Share and effective number of objects of clusters (sum of the objects' shares, number of objects)."""
    K, n = len(clusters), sum(w for _, w in clusters)
    p = sum(s for s, _ in clusters) / n
    m = sum(w * w for _, w in clusters) / n
    most = n / (1 + 0.2 * (m - 1))
    v = K / (K - 1) * sum((s - p * w) ** 2 for s, w in clusters) / n**2
    if v > 1e-15:
        most = min(most, p * (1 - p) / v * (stats.t.ppf(0.975, n - 1) / stats.t.ppf(0.975, K - 1)) ** 2)
    return p, max(1.0, most)


def share(clusters: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Limits of the share."""
    return exact(*effective(clusters))


def figure(value: float, without: Sequence[float], weights: Sequence[float]) -> tuple[float, float]:
    """Limits of any other figure, from the figure without each cluster."""
    w = np.array(weights, dtype=float)
    n, K = w.sum(), len(w)
    e = [(n - w[g]) * (value - without[g]) for g in range(K)]
    V = sum(e[g] ** 2 / (1 - w[g] / n) for g in range(K)) / n**2
    B = np.diag((1 - w / n) ** -0.5) @ (np.diag(w) - np.outer(w, w) / n)
    Q = B @ B.T
    half = stats.t.ppf(0.975, np.trace(Q) ** 2 / np.trace(Q @ Q)) * math.sqrt(V)
    return value - half, value + half


def bounded(
    value: float,
    without: Sequence[float],
    weights: Sequence[float],
    least: float,
    most: float,
    followed: float = 1.0,
    confidence: float = 0.95,
) -> tuple[float, float]:
    """Limits of a mean between `least` and `most`: one cluster that was not seen, added at the one end and the other.

    Each limit is a quantile of Σ E·w·z / Σ E·w, E exponential, by a beta distribution with its mean and its variance.
    """
    n = sum(weights)
    own = [value + (n / w - 1) * (value - rest) for w, rest in zip(weights, without, strict=True)]
    unseen = sum(w * w for w in weights) / n / followed
    limits = []
    for edge, q in ((least, (1 - confidence) / 2), (most, 1 - (1 - confidence) / 2)):
        pairs = [*zip(own, weights, strict=True), (edge, unseen)]
        total = sum(w for _, w in pairs)
        mean = sum(w * z for z, w in pairs) / total
        spread = sum((w / total) ** 2 * (z - mean) ** 2 for z, w in pairs) / (
            1 + sum((w / total) ** 2 for _, w in pairs)
        )
        low, high = min(z for z, _ in pairs), max(z for z, _ in pairs)
        if high - low <= 1e-9:
            limits.append(mean)
            continue
        p, v = (mean - low) / (high - low), spread / (high - low) ** 2
        size = p * (1 - p) / v - 1
        limits.append(low + (high - low) * float(stats.beta.ppf(q, p * size, (1 - p) * size)))
    return max(limits[0], least), min(limits[1], most)


def left_out(
    clusters: dict[str, list[Any]], of: Callable[[list[Any]], float], weights: dict[str, float]
) -> tuple[float, float]:
    """Limits of a figure of rows, computed anew from the rows of all clusters but one."""
    every = [row for rows in clusters.values() for row in rows]
    without = [of([row for name, rows in clusters.items() if name != out for row in rows]) for out in clusters]
    return figure(of(every), without, [weights[name] for name in clusters])


def median(clusters: dict[str, list[tuple[float, str]]]) -> tuple[float, float]:
    """Limits of the median of rows (value, object): the values whose share at or below them may be a half."""
    rows = [row for of in clusters.values() for row in of]
    objects = len({(name, thing) for name, of in clusters.items() for _, thing in of})

    def limits(x: float) -> tuple[float, float]:
        scale = objects / len(rows)
        return share([(scale * sum(v <= x for v, _ in of), scale * len(of)) for of in clusters.values()])

    values = [-math.inf, *sorted({v for v, _ in rows})]
    at = [limits(v) if v > -math.inf else share([(0.0, len(of) * objects / len(rows)) for of in clusters.values()])
          for v in values]  # fmt: skip
    low = next((v for v, (_, high) in zip(values, at, strict=True) if high >= 0.5), math.inf)
    high = math.inf
    for v, (least, _) in zip(reversed(values), reversed(at), strict=True):
        if least < 0.5:
            break
        high = v
    return low, high
