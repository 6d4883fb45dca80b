"""GOSPA (α = 2) with its parts, and OSPA: distances of a list from the truth, of positions without identities.

Both are metrics between finite sets of points, with a cut-off c and a power p ≥ 1. A true and an estimated object may
be paired where they are nearer than c, and the pairs are those of least total cost:

GOSPA = (Σ dᵖ + cᵖ/2 · missed + cᵖ/2 · false)^(1/p), over the pairs, true and estimated objects without a partner;
OSPA = ((Σ dᵖ + cᵖ · (max(n, m) − pairs)) / max(n, m))^(1/p): an average, so that in a long list one error is small.

One set of pairs serves both. Two empty lists are at distance 0. Letters: n truths, m estimated objects.

Source: A. S. Rahmathullah, Á. F. García-Fernández, L. Svensson, "Generalized optimal sub-pattern assignment metric",
FUSION 2017; D. Schuhmacher, B.-T. Vo, B.-N. Vo, "A consistent metric for performance evaluation of multi-object
filters", IEEE Trans. Signal Process. 56 (2008) 3447–3457.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np

from copem_replay.core.assignment import assign_pairs
from copem_replay.core.compiled import kernel, making_kernel
from copem_replay.core.tracks import Float, Int


@dataclass(frozen=True)
class GospaDistance:
    """GOSPA and what it is made of: `value_m ** power == localisation + missed + false`."""

    value_m: float
    localisation: float  # Σ dᵖ of the pairs; this and the next two in metres to the power p
    missed: float
    false: float
    missed_count: int
    false_count: int
    partner: Int  # (n,) the estimated object of each truth, −1: missed


def gospa(truth: Float, estimates: Float, *, cutoff_m: float, power: float) -> GospaDistance:
    """GOSPA between `truth (n, 2)` and `estimates (m, 2)`, metres.

    Raises ValueError for other shapes, for positions that are not finite, for a cut-off not above 0, for a power
    below 1 or infinite, and where the cut-off to that power is too large or too small a number.

    Source: Rahmathullah, García-Fernández, Svensson, FUSION 2017.

    >>> found = cr.gospa(np.array([[0.0, 0.0], [9.0, 0.0]]), np.array([[3.0, 4.0]]), cutoff_m=6.0, power=1)
    >>> found.value_m, found.localisation, found.missed_count
    (8.0, 5.0, 1)
    """
    x, y = _check_points("truth", truth), _check_points("estimates", estimates)
    unit = _cutoff_cost(cutoff_m, power)
    n, m = x.shape[1], y.shape[1]
    partner = np.empty(n, dtype=np.int64)
    localisation, pairs = gospa_pairs(x[0], x[1], y[0], y[1], float(cutoff_m), float(power), partner)
    missed, false = unit / 2 * (n - pairs), unit / 2 * (m - pairs)
    value_m = (localisation + missed + false) ** (1 / power)
    return GospaDistance(value_m, localisation, missed, false, n - pairs, m - pairs, partner)


def ospa(truth: Float, estimates: Float, *, cutoff_m: float, power: float) -> float:
    """OSPA between `truth (n, 2)` and `estimates (m, 2)`, metres.

    Raises ValueError as `gospa` does.

    Source: Schuhmacher, Vo, Vo, IEEE Trans. Signal Process. 56 (2008) 3447–3457.

    >>> cr.ospa(np.array([[0.0, 0.0], [9.0, 0.0]]), np.array([[3.0, 4.0]]), cutoff_m=6.0, power=1)
    5.5
    """
    result = gospa(truth, estimates, cutoff_m=cutoff_m, power=power)
    n = len(result.partner)
    m = n - result.missed_count + result.false_count
    if max(n, m) == 0:
        return 0.0
    alone = _cutoff_cost(cutoff_m, power) * max(result.missed_count, result.false_count)
    return float(((result.localisation + alone) / max(n, m)) ** (1 / power))


@making_kernel
def gospa_pairs(
    tx: Float, ty: Float, bx: Float, by: Float, cutoff_m: float, power: float, partner: Int
) -> tuple[float, int]:
    """Pair truths at `tx, ty (n,)` with estimates at `bx, by (m,)`. NaN is near to nothing; nothing is checked.

    Out: `partner (n,)`, −1: missed. Gives Σ dᵖ over the pairs, and how many they are.
    """
    n, m = len(tx), len(bx)
    near = 0
    for i in range(n):
        for j in range(m):
            near += (tx[i] - bx[j]) ** 2 + (ty[i] - by[j]) ** 2 < cutoff_m * cutoff_m
    if near == 0:
        partner[:n] = -1
        return 0.0, 0
    row, col, cost = np.empty(near, np.int64), np.empty(near, np.int64), np.empty(near)
    unit = cutoff_m**power
    k = 0
    for i in range(n):
        for j in range(m):
            squared = (tx[i] - bx[j]) ** 2 + (ty[i] - by[j]) ** 2
            if squared < cutoff_m * cutoff_m:
                row[k], col[k], cost[k] = i, j, _raise_to_power(power, squared) - unit
                k += 1
    assign_pairs(row, col, cost, n, m, partner)
    localisation, pairs = 0.0, 0
    for i in range(n):
        j = partner[i]
        if j >= 0:
            localisation += _raise_to_power(power, (tx[i] - bx[j]) ** 2 + (ty[i] - by[j]) ** 2)
            pairs += 1
    return localisation, pairs


def gospas_m(truth: Float, starts: Int, estimates: Float, begins: Int, cutoff_m: float, power: float) -> Float:
    """GOSPA (m) of many lists (K,): `truth (2, P)` and `estimates (2, R)`, list k from `starts[k]` and `begins[k]` on.

    `starts` and `begins` have one entry more, the end of the last list. Raises ValueError as `gospa` does.
    """
    unit = _cutoff_cost(cutoff_m, power)
    if not (np.isfinite(truth).all() and np.isfinite(estimates).all()):
        raise ValueError("expected finite positions")
    tx, ty, bx, by = (np.ascontiguousarray(column, dtype=np.float64) for column in (*truth, *estimates))
    total = np.empty(len(starts) - 1)
    _sum_gospa(tx, ty, starts, bx, by, begins, float(cutoff_m), float(power), unit, total)
    value_m: Float = total ** (1 / power)
    return value_m


@kernel
def _sum_gospa(
    tx: Float, ty: Float, starts: Int, bx: Float, by: Float, begins: Int,
    cutoff_m: float, power: float, unit: float, total: Float,
) -> None:  # fmt: skip
    """Out: `total (K,)`, GOSPA to the power p."""
    for k in range(len(total)):
        i, j, m, n = starts[k], starts[k + 1], begins[k], begins[k + 1]
        partner = np.empty(j - i, dtype=np.int64)
        localisation, pairs = gospa_pairs(tx[i:j], ty[i:j], bx[m:n], by[m:n], cutoff_m, power, partner)
        total[k] = localisation + unit / 2 * ((j - i - pairs) + (n - m - pairs))


@nb.njit(inline="always")
def _raise_to_power(power: float, squared: float) -> float:
    """A distance to the power p, from its square."""
    if power == 2.0:
        return squared
    return float(np.sqrt(squared)) if power == 1.0 else float(squared ** (power / 2))


def _check_points(name: str, points: Float) -> Float:
    """The points as contiguous columns (2, n). Raises ValueError for another shape, or a position not finite."""
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"{name}: expected points (n, 2), found shape {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(f"{name}: expected finite positions")
    return np.ascontiguousarray(points.T)


def _cutoff_cost(cutoff_m: float, power: float) -> float:
    """The cut-off to the power p, twice the cost of one object without a partner in GOSPA. Raises ValueError."""
    if not 0 < cutoff_m < math.inf:
        raise ValueError(f"cutoff_m: expected a distance above 0, found {cutoff_m}")
    if not 1 <= power < math.inf:
        raise ValueError(f"power: expected a finite number of at least 1, found {power}")
    with np.errstate(over="ignore", under="ignore"):
        unit = float(np.float64(cutoff_m) ** power)
    if not 0 < unit < math.inf:
        raise ValueError(f"cutoff_m to the power {power}: expected a finite number above 0, found {unit}")
    return unit
