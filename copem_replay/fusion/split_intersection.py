"""Split covariance intersection: a part of each error may be correlated with the others, the rest is independent.

Everywhere: means `x (n, d)`, covariances of the dependent and of the independent parts `(n, d, d)`, n ≥ 1, symmetric;
their sums are positive definite, and so are the dependent parts or all of them are 0.

P⁻¹ = Σ (Dᵢ/wᵢ + Nᵢ)⁻¹ over weights w ≥ 0 with sum 1: whatever the correlation of the dependent parts, diag(Dᵢ/wᵢ) is
no less than their joint covariance, and P that of the best linear estimate under this bound. All inputs at once: the
order does not matter, beyond rounding.

Source: S. Julier, J. Uhlmann, "General decentralized data fusion with covariance intersection", Handbook of Data Fusion
2001; H. Li, F. Nashashibi, M. Yang, "Split covariance intersection filter", IEEE T-ITS 14 (2013) (two inputs).
"""

from __future__ import annotations

import numpy as np

from copem_replay.core.compiled import callee
from copem_replay.core.tracks import Bool, Float
from copem_replay.fusion.covariance import FLATTEST, invert_matrix, invert_root, solve_with_root

_GAP = 1e-10
"""The search ends when no input could lower the criterion by more than this share of it: above rounding."""
_CLOSE = 1e-6
"""Where scores differ by less than this share, Newton steps are not shortened: the criterion's change is rounding."""
_RIDGE = 1e-12
"""Added to the curvature, relative, so that it can be inverted where weights change next to nothing."""


@callee
def split_covariance_intersection(
    x: Float, dependent: Float, independent: Float, by_determinant: bool
) -> tuple[Float, Float, Float, Float]:
    """Mean (d,), covariance P (d, d), its independent part (d, d), and the weights (n,).

    The weights make the determinant of P the least there is, or its trace. Without dependent parts it is inverse
    variance, without independent ones covariance intersection; where P is also least for other weights (equal inputs
    without independent parts), those nearest to equal ones on the way there are taken. The dependent part of the result
    is P without its independent part.
    """
    n, d = x.shape
    weight = _best_weights(dependent, independent, by_determinant)
    information, total, P = np.zeros((n, d, d)), np.empty((d, d)), np.empty((d, d))
    _evaluate_criterion(dependent, independent, weight, by_determinant, information, total, P)
    mean, independent_part, gain = x[0].copy(), np.zeros((d, d)), np.zeros((d, d))
    for k in range(n):
        if weight[k] == 1:
            mean[:] = x[k]
            return mean, dependent[k] + independent[k], independent[k].copy(), weight
        for i in range(d):
            for j in range(d):
                gain[i, j] = 0.0
                for m in range(d):
                    gain[i, j] += P[i, m] * information[k, m, j]
        for i in range(d):
            for j in range(d):
                # Relative to the first: no digits of millimetres go to kilometres.
                mean[i] += gain[i, j] * (x[k, j] - x[0, j])
                for m in range(d):
                    for q in range(d):
                        independent_part[i, j] += gain[i, m] * independent[k, m, q] * gain[j, q]
    return mean, P, independent_part, weight


@callee
def split_by_share(cov: Float, share: float) -> tuple[Float, Float]:
    """Dependent and independent parts of covariances (n, d, d): `share` of each, and the rest."""
    return share * cov, (1 - share) * cov


@callee
def split_by_variance(cov: Float, dependent_m2: float) -> tuple[Float, Float]:
    """Dependent and independent parts of covariances (n, 2, 2): `dependent_m2` on every axis at most; the rest."""
    dependent, independent = np.zeros(cov.shape), np.zeros(cov.shape)
    for k in range(len(cov)):
        ee, en, nn = cov[k, 0, 0], (cov[k, 0, 1] + cov[k, 1, 0]) / 2, cov[k, 1, 1]
        middle, half = (ee + nn) / 2, np.hypot((ee - nn) / 2, en)
        c2, s2 = ((ee - nn) / 2 / half, en / half) if half > 0 else (1.0, 0.0)
        high = middle + half
        low = max(middle - half, FLATTEST * high)
        if high <= dependent_m2:  # all of it, to the last bit
            dependent[k] = cov[k]
            continue
        high, low = dependent_m2, min(dependent_m2, low)
        dependent[k, 0, 0] = (high + low) / 2 + (high - low) / 2 * c2
        dependent[k, 1, 1] = (high + low) / 2 - (high - low) / 2 * c2
        dependent[k, 0, 1] = dependent[k, 1, 0] = (high - low) / 2 * s2
        for i in range(2):
            for j in range(2):
                independent[k, i, j] = cov[k, i, j] - dependent[k, i, j]
    return dependent, independent


# The best weights.
#
# w ↦ (D/w + N)⁻¹ = w (D + wN)⁻¹ = J is concave, so trace and logarithm of the determinant of (Σ Jᵢ)⁻¹ are convex. The
# *score* of an input is how fast the criterion falls as it gains weight. At the optimum, and only there, inputs with
# weight have one score and none scores more. Newton steps among the inputs with weight, as in fusion/covariance.py: an
# input that reaches 0 leaves; once those with weight have one score, the input that scores most enters. Any weights
# make a valid P, so where the steps end before that is a matter of size, never of validity.


@callee
def _best_weights(dependent: Float, independent: Float, by_determinant: bool) -> Float:
    """Weights (n,), sum 1, that minimise the determinant or the trace of P, by Newton's method."""
    n, d = dependent.shape[:2]
    weight = np.full(n, 1.0 / n)
    if n == 1:
        return weight
    weighted = np.ones(n, dtype=np.bool_)
    information, total, P = np.zeros((n, d, d)), np.empty((d, d)), np.empty((d, d))
    lever, score, bend = np.empty((n, d, d)), np.empty(n), np.empty(n)
    value = _evaluate_criterion(dependent, independent, weight, by_determinant, information, total, P)
    for _ in range(40 + 4 * n):
        _derive_terms(dependent, independent, weight, by_determinant, P, lever, score, bend)
        mean = largest_error = 0.0
        for k in range(n):
            mean += weight[k] * score[k]
        if not mean > 0:  # no dependent parts: weights change nothing
            break
        entering = -1
        for k in range(n):
            if weighted[k]:
                largest_error = max(largest_error, abs(score[k] / mean - 1))
            elif entering < 0 or score[k] > score[entering]:
                entering = k
        if largest_error <= _GAP:
            if entering < 0 or score[entering] <= (1 + _GAP) * mean:
                break
            weighted[entering] = True
        change = _newton_step(lever, score / mean, bend / mean, weighted, P, mean, by_determinant)
        longest_step, fall = np.inf, 0.0
        for k in range(n):
            fall += score[k] * change[k]
            if change[k] < 0:
                longest_step = min(longest_step, -weight[k] / change[k])
        if not 0 < longest_step < np.inf:
            break
        step = min(1.0, longest_step)
        for _ in range(40):
            tried_weight = np.maximum(weight + step * change, 0.0)
            lower = _evaluate_criterion(dependent, independent, tried_weight, by_determinant, information, total, P)
            if largest_error <= _CLOSE or lower <= value - 1e-4 * step * fall:
                break
            step /= 2
        for k in range(n):
            leaves = step == longest_step and change[k] < 0 and -weight[k] / change[k] <= longest_step * (1 + 1e-9)
            weighted[k] = weighted[k] and not leaves
            weight[k] = max(weight[k] + step * change[k], 0.0) if weighted[k] else 0.0
        weight /= weight.sum()
        value = _evaluate_criterion(dependent, independent, weight, by_determinant, information, total, P)
    return weight


@callee
def _evaluate_criterion(
    dependent: Float, independent: Float, weight: Float, by_determinant: bool, information: Float, total: Float,
    P: Float,
) -> float:  # fmt: skip
    """Trace of P or logarithm of its determinant; fills P and what each input contributes to its inverse."""
    n, d = dependent.shape[:2]
    spread = np.empty((d, d))
    total[:] = 0.0
    for k in range(n):
        information[k] = 0.0
        if weight[k] == 0:
            continue
        for i in range(d):
            for j in range(d):
                spread[i, j] = dependent[k, i, j] / weight[k] + independent[k, i, j]
        invert_matrix(spread, information[k])
        total += information[k]
    invert_matrix(total, P)
    value = 0.0
    if by_determinant:
        invert_root(total, spread)
        for i in range(d):
            value += 2 * np.log(spread[i, i])
    else:
        for i in range(d):
            value += P[i, i]
    return value


@callee
def _derive_terms(
    dependent: Float, independent: Float, weight: Float, by_determinant: bool, P: Float, lever: Float, score: Float,
    bend: Float,
) -> None:  # fmt: skip
    """Fills for each input PJ′ (n, d, d), its score ⟨PJ′, P⟩ or trace PJ′, and −⟨PJ″, P⟩ or −trace PJ″ (n,)."""
    n, d = dependent.shape[:2]
    spread, inverse, first = np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    for k in range(n):
        for i in range(d):
            for j in range(d):
                spread[i, j] = dependent[k, i, j] + weight[k] * independent[k, i, j]
        score[k] = bend[k] = 0.0
        if not spread[0, 0] > 0:  # nothing dependent, without weight
            lever[k] = 0.0
            continue
        invert_matrix(spread, inverse)
        _multiply_matrices(inverse, dependent[k], spread)
        _multiply_matrices(spread, inverse, first)  # J′ = M⁻¹ D M⁻¹ with M = D + wN
        _multiply_matrices(P, first, lever[k])
        _multiply_matrices(inverse, independent[k], spread)
        second = np.empty((d, d))
        _multiply_matrices(spread, first, second)  # J″ = −2 M⁻¹ N J′
        _multiply_matrices(P, second, spread)
        for i in range(d):
            if by_determinant:
                score[k] += lever[k, i, i]
                bend[k] += 2 * spread[i, i]
                continue
            for j in range(d):
                score[k] += lever[k, i, j] * P[j, i]
                bend[k] += 2 * spread[i, j] * P[j, i]


@callee
def _newton_step(
    lever: Float, score: Float, bend: Float, weighted: Bool, P: Float, mean: float, by_determinant: bool
) -> Float:
    """Newton's change of the weights (n,), its sum 0; inputs without weight keep none. Scores and bends over `mean`."""
    active = np.flatnonzero(weighted)
    c, d = len(active), len(P)
    curvature, root, half = np.empty((c, c)), np.empty((c, c)), np.empty((d, d))
    largest = 0.0
    for p in range(c):
        if not by_determinant:
            _multiply_matrices(P, lever[active[p]], half)
        for q in range(p + 1):
            total = 0.0
            for i in range(d):
                for j in range(d):
                    ones_solved = lever[active[p], i, j] if by_determinant else 2 * half[i, j]
                    total += ones_solved * lever[active[q], j, i]
            curvature[p, q] = total / mean
        curvature[p, p] += bend[active[p]]
        largest = max(largest, curvature[p, p])
    for p in range(c):
        curvature[p, p] += _RIDGE * largest
    invert_root(curvature, root)
    gain, ones_solved = solve_with_root(root, score[active] - 1), solve_with_root(root, np.ones(c))
    shift = gain.sum() / ones_solved.sum()  # so that the changes sum to 0
    change = np.zeros(len(weighted))
    for p in range(c):
        change[active[p]] = gain[p] - shift * ones_solved[p]
    return change


@callee
def _multiply_matrices(a: Float, b: Float, out: Float) -> None:
    """Writes a · b into `out`."""
    d = len(a)
    for i in range(d):
        for j in range(d):
            out[i, j] = 0.0
            for m in range(d):
                out[i, j] += a[i, m] * b[m, j]
