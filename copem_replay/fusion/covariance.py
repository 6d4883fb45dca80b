"""Several Gaussian estimates of one quantity combined into one: by inverse variance, and by covariance intersection.

Everywhere: means `x (n, d)`, covariances `cov (n, d, d)`, n ≥ 1, as n units state them; slices of larger arrays will
do. Covariances are symmetric and positive definite (the caller floors their eigenvalues); *information* I is their
inverse. Results are new arrays, the covariance symmetric and positive definite. The order of the inputs does not
matter, beyond rounding. An input that wins alone is returned as it is, to the last bit.

All in one file, because Numba's cache on disk only notices changes in the file of the function it compiled.
"""

from __future__ import annotations

import math

import numpy as np

from copem_replay.core.compiled import callee
from copem_replay.core.tracks import Bool, Float

SMALLEST_VARIANCE_M2 = 1e-9
"""Smaller eigenvalues of a stated covariance count as this: exact positions have an inverse, too."""
FLATTEST = 1e-12
"""No eigenvalue counts as less than this share of the other, as rounding could make it negative."""


@callee
def floor_eigenvalues(ee: float, en: float, nn: float) -> tuple[float, float, float]:
    """The covariance (ee, en; en, nn) with its axes kept and eigenvalues that are too small raised."""
    middle, half = (ee + nn) / 2, math.hypot((ee - nn) / 2, en)
    high = max(middle + half, SMALLEST_VARIANCE_M2)
    low = max(middle - half, SMALLEST_VARIANCE_M2, FLATTEST * high)
    if low <= middle - half:
        return ee, en, nn
    if half == 0.0:
        return high, 0.0, high
    c2, s2 = (ee - nn) / 2 / half, en / half
    middle, half = (high + low) / 2, (high - low) / 2
    return middle + half * c2, half * s2, middle - half * c2


_GAP = 1e-12
"""The search ends when no input could lower the criterion by more than this share of it: a few times rounding."""
_RIDGE = 1e-9
"""Added to the curvature (of the order of 1), so that it can be inverted where weights change next to nothing."""
_ALIKE = 1e-9
"""Inputs that score this little less than the best may share its weight: above the rounding of scores."""
_SOFT = 1e-12
"""Square of a relative difference of inputs (1e-6) below which they share weight alike: it could be rounding."""
_TIE = 1e-12
"""Traces that differ by less than this share are equal: it is rounding."""


@callee
def inverse_variance(x: Float, cov: Float) -> tuple[Float, Float]:
    """Mean (d,) and covariance (d, d) of the summed information: optimal if and only if the errors are independent."""
    information = invert_all(cov)
    return _combine_weighted(x, cov, information, np.ones(len(x)))


@callee
def covariance_intersection(x: Float, cov: Float, by_determinant: bool) -> tuple[Float, Float, Float]:
    """Mean (d,), covariance P (d, d) and weights (n,) of P⁻¹ = Σ wᵢIᵢ: never too sure, however errors are correlated.

    The weights, ≥ 0 with sum 1, make the determinant of P the least there is, or its trace, to some parts in 10⁹; an
    input that does not help has weight 0. Where several sets of weights do (equal covariances, say), those with the
    least sum of squares.

    Source: S. Julier, J. Uhlmann, "A non-divergent estimation algorithm in the presence of unknown correlations",
    American Control Conference 1997. All inputs at once, not pair after pair, which would depend on their order.
    """
    information = invert_all(cov)
    weight = _best_weights(information, by_determinant)
    mean, covariance = _combine_weighted(x, cov, information, weight)
    return mean, covariance, weight


@callee
def fast_covariance_intersection(x: Float, cov: Float, keep_best: bool) -> tuple[Float, Float, Float]:
    """Covariance intersection with weights in closed form: mean (d,), covariance (d, d), weights (n,).

    The formula can end up worse than the best of its inputs. With `keep_best`, the input with the least trace is
    returned where that is less than the result's, with weight 1; several that tie share it, no worse than each alone.

    Source: D. Fränken, A. Hüpper, "Improved fast covariance intersection for distributed data fusion", FUSION 2005.
    """
    n, d = x.shape
    information = invert_all(cov)
    total = np.zeros((d, d))
    for k in range(n):
        total += information[k]
    whole = _safe_determinant(total)
    weight = np.empty(n)
    for k in range(n):
        weight[k] = whole - _safe_determinant(total - information[k]) + _safe_determinant(information[k])
    weight /= weight.sum()
    mean, covariance = _combine_weighted(x, cov, information, weight)
    if keep_best:
        trace = np.empty(n)
        for k in range(n):
            trace[k] = np.trace(cov[k])
        least = trace.min()
        if np.trace(covariance) > least * (1 + _TIE):
            weight = (trace <= least * (1 + _TIE)).astype(np.float64)
            weight /= weight.sum()
            mean, covariance = _combine_weighted(x, cov, information, weight)
    return mean, covariance, weight


@callee
def _combine_weighted(x: Float, cov: Float, information: Float, weight: Float) -> tuple[Float, Float]:
    """Mean (d,) and covariance (d, d) where input i counts `weight[i]` times; a single input stays as it is."""
    n, d = x.shape
    single = -1
    for k in range(n):
        if weight[k] > 0:
            single = k if single == -1 else -2
    mean, covariance = np.empty(d), np.empty((d, d))
    if single >= 0 and weight[single] == 1:
        for i in range(d):
            mean[i] = x[single, i]
            for j in range(d):
                covariance[i, j] = (cov[single, i, j] + cov[single, j, i]) / 2
        return mean, covariance
    total, moment = np.zeros((d, d)), np.zeros(d)
    for k in range(n):
        if weight[k] == 0:
            continue
        for i in range(d):
            for j in range(d):
                part = weight[k] * information[k, i, j]
                total[i, j] += part
                # Relative to the first: information of 1e9 times kilometres would leave no digits for millimetres.
                moment[i] += part * (x[k, j] - x[0, j])
    invert_matrix(total, covariance)
    for i in range(d):
        mean[i] = 0.0
        for j in range(d):
            mean[i] += covariance[i, j] * moment[j]
        mean[i] += x[0, i]
    return mean, covariance


# The best weights.
#
# The criterion is convex in the weights: the problem is that of optimal designs of experiments. With J = Σ wᵢIᵢ, the
# *score* of input i is how fast the criterion falls as i gains weight, over its mean under w: tr(J⁻¹Iᵢ)/d for the
# determinant (of its logarithm), tr(J⁻¹IᵢJ⁻¹)/tr(J⁻¹) for the trace. At the optimum, and only there, all inputs with
# weight score 1, and none scores more (J. Kiefer, J. Wolfowitz, "The equivalence of two extremum problems", Canadian
# Journal of Mathematics 12 (1960) 363–366; scores above 1 also bound what there is to gain).
#
# From equal weights: Newton steps among the inputs with weight. An input that reaches 0 leaves; once those with weight
# have one score, the input that scores most enters. J at the optimum is unique. Weights are not where informations
# depend on each other (equal ones, or equal ones seen from many sides), and the mean goes by them: then they are shared
# out evenly. Information is kept in coordinates in which J = 1, and B (d, d), of norm 1, is what the criterion weighs
# there: 1/√d for the determinant, L⁻¹ in proportion for the trace, with LLᵀ = J. Then scores are ⟨IᵢB, B⟩, and
# curvatures ⟨IᵢB, IⱼB⟩, twice for the trace.


@callee
def _best_weights(information: Float, by_determinant: bool) -> Float:
    """Weights (n,), sum 1, that minimise the determinant or the trace of (Σ wᵢIᵢ)⁻¹, by Newton's method."""
    n, d = information.shape[:2]
    weight = np.full(n, 1.0 / n)
    if n == 1:
        return weight
    info = information.copy()
    weighted = np.ones(n, dtype=np.bool_)
    B, lever, score = np.eye(d) / np.sqrt(d), np.empty((n, d, d)), np.empty(n)
    for _ in range(40 + 4 * n):
        _whiten(info, weight, B, by_determinant)
        largest_error, entering = 0.0, -1
        for k in range(n):
            score[k] = 0.0
            for i in range(d):
                for j in range(d):
                    lever[k, i, j] = 0.0
                    for m in range(d):
                        lever[k, i, j] += info[k, i, m] * B[m, j]
                    score[k] += lever[k, i, j] * B[i, j]
            if weighted[k]:
                largest_error = max(largest_error, abs(score[k] - 1))
            elif entering < 0 or score[k] > score[entering]:
                entering = k
        if largest_error <= _GAP:
            if entering < 0 or score[entering] <= 1 + _GAP:
                break
            weighted[entering] = True
        change = _newton_step(lever, score, weighted, 1.0 if by_determinant else 2.0)
        longest_step = np.inf
        along = np.zeros((d, d))
        for k in range(n):
            if change[k] < 0:
                longest_step = min(longest_step, -weight[k] / change[k])
            for i in range(d):
                for j in range(d):
                    along[i, j] += change[k] * info[k, i, j]
        if not 0 < longest_step < np.inf:
            break
        # Close to the optimum plain steps: the slope along weights that change next to nothing is rounding.
        step = _search_line(along, B, by_determinant, longest_step) if largest_error > 1e-6 else min(1.0, longest_step)
        for k in range(n):
            leaves = step == longest_step and change[k] < 0 and -weight[k] / change[k] <= longest_step * (1 + 1e-9)
            weighted[k] = weighted[k] and not leaves
            weight[k] = max(weight[k] + step * change[k], 0.0) if weighted[k] else 0.0
        weight /= weight.sum()
    _share_weight(info, weight, weighted | (score >= 1 - _ALIKE))
    return weight


@callee
def _share_weight(info: Float, weight: Float, among: Bool) -> None:
    """Of all weights `among` these inputs that give the same Σ wᵢIᵢ, take those with the least Σ wᵢ², in place.

    They are wᵢ = max(0, ⟨Λ, Iᵢ⟩) for some symmetric Λ; Newton's method finds it, penalised by _SOFT · |Λ|²/2: of inputs
    that differ by less than 1e-6 the sum may be off a little, rather than rounding amplified.
    """
    sharing = np.flatnonzero(among)
    c, d = len(sharing), info.shape[1]
    if c == 1:
        return
    size = d * (d + 1) // 2
    entries, target, largest = np.empty((c, size)), np.zeros(size), 1.0
    for p in range(c):
        e = 0
        for i in range(d):
            for j in range(i + 1):
                entries[p, e] = info[sharing[p], i, j]
                target[e] += weight[sharing[p]] * entries[p, e]
                largest = max(largest, abs(entries[p, e]))
                e += 1
    soft = _SOFT * largest**2
    multiplier, root = np.zeros(size), np.empty((size, size))
    share, is_positive = np.zeros(c), np.ones(c, dtype=np.bool_)
    settled_rounds = 0
    for _ in range(50):
        residual, curvature = target.copy(), np.zeros((size, size))
        for e in range(size):
            residual[e] -= soft * multiplier[e]
            curvature[e, e] += soft
            for p in range(c):
                residual[e] -= share[p] * entries[p, e]
                if is_positive[p]:
                    for f in range(e + 1):
                        curvature[e, f] += entries[p, e] * entries[p, f]
        invert_root(curvature, root)
        multiplier += solve_with_root(root, residual)
        settled_rounds += 1
        for p in range(c):
            total = 0.0
            for e in range(size):
                total += multiplier[e] * entries[p, e]
            if is_positive[p] != (total > 0):
                settled_rounds = 0
            share[p], is_positive[p] = max(total, 0.0), total > 0
        if settled_rounds == 3:  # one step solves it, two more take off what rounding left
            for p in range(c):
                weight[sharing[p]] = share[p]
            weight /= weight.sum()
            return


@callee
def _whiten(info: Float, weight: Float, B: Float, by_determinant: bool) -> None:
    """Changes `info` and B to coordinates in which Σ wᵢIᵢ = 1, in place."""
    n, d = info.shape[:2]
    total, half, factor = np.zeros((d, d)), np.empty((d, d)), np.empty((d, d))
    for k in range(n):
        if weight[k] > 0:
            for i in range(d):
                for j in range(d):
                    total[i, j] += weight[k] * info[k, i, j]
    invert_root(total, factor)
    for k in range(n):
        for i in range(d):
            for j in range(d):
                half[i, j] = 0.0
                for m in range(i + 1):
                    half[i, j] += factor[i, m] * info[k, m, j]
        for i in range(d):
            for j in range(i + 1):
                info[k, i, j] = 0.0
                for m in range(j + 1):
                    info[k, i, j] += half[i, m] * factor[j, m]
                info[k, j, i] = info[k, i, j]
    if not by_determinant:
        norm = 0.0
        for i in range(d - 1, -1, -1):  # from below, as each row takes those above it
            for j in range(d):
                B[i, j] *= factor[i, i]
                for m in range(i):
                    B[i, j] += factor[i, m] * B[m, j]
                norm += B[i, j] ** 2
        for i in range(d):
            for j in range(d):
                B[i, j] /= np.sqrt(norm)


@callee
def _newton_step(lever: Float, score: Float, weighted: Bool, times: float) -> Float:
    """Newton's change of the weights (n,), which sums to 0; inputs without weight (`weighted` False) keep none."""
    active = np.flatnonzero(weighted)
    c, d = len(active), lever.shape[1]
    curvature, root = np.empty((c, c)), np.empty((c, c))
    for p in range(c):
        for q in range(p + 1):
            total = 0.0
            for i in range(d):
                for j in range(d):
                    total += lever[active[p], i, j] * lever[active[q], i, j]
            curvature[p, q] = times * total
        curvature[p, p] += _RIDGE
    invert_root(curvature, root)
    gain, ones_solved = solve_with_root(root, score[active] - 1), solve_with_root(root, np.ones(c))
    shift = gain.sum() / ones_solved.sum()  # so that the changes sum to 0
    change = np.zeros(len(weighted))
    for p in range(c):
        change[active[p]] = gain[p] - shift * ones_solved[p]
    return change


@callee
def _search_line(along: Float, B: Float, by_determinant: bool, longest: float) -> float:
    """The step (≤ `longest`) from J = 1 along `along` at which the criterion hardly falls any more."""
    first = _criterion_slope(0.0, along, B, by_determinant)
    low, high, step = 0.0, np.inf, min(1.0, longest)
    for _ in range(60):
        slope = _criterion_slope(step, along, B, by_determinant)
        if abs(slope) <= 0.1 * abs(first) or (slope < 0 and step == longest):
            return step
        if slope < 0:
            low = step
        else:
            high = step
        step = min(2 * step, longest) if high == np.inf else (low + high) / 2
    return low


@callee
def _criterion_slope(step: float, along: Float, B: Float, by_determinant: bool) -> float:
    """Derivative of the criterion by `step` at J = 1 + step · along, over its value at J = 1 (of the logarithm: /d)."""
    d = len(along)
    J, inverse = np.empty((d, d)), np.empty((d, d))
    for i in range(d):
        for j in range(d):
            J[i, j] = step * along[i, j]
        J[i, i] += 1.0
    invert_matrix(J, inverse)
    total = 0.0
    if by_determinant:
        for i in range(d):
            for j in range(d):
                total -= inverse[i, j] * along[i, j] / d
        return total
    for m in range(d):
        for i in range(d):
            J[i, m] = 0.0
            for j in range(d):
                J[i, m] += inverse[i, j] * B[j, m]
        for i in range(d):
            for j in range(d):
                total -= along[i, j] * J[i, m] * J[j, m]
    return total


# Small symmetric positive definite matrices.


@callee
def invert_all(cov: Float) -> Float:
    """Inverses (n, d, d) of covariances (n, d, d)."""
    information = np.empty(cov.shape)
    for k in range(len(cov)):
        invert_matrix(cov[k], information[k])
    return information


@callee
def invert_matrix(matrix: Float, out: Float) -> None:
    """Writes the inverse of a matrix (d, d) into `out`, exactly symmetric."""
    d = len(matrix)
    if d == 2:
        a, b, c = matrix[0, 0], (matrix[0, 1] + matrix[1, 0]) / 2, matrix[1, 1]
        over = 1 / (a * c - b * b)
        out[0, 0], out[1, 1] = c * over, a * over
        out[0, 1] = out[1, 0] = -b * over
        return
    root = np.empty((d, d))
    invert_root(matrix, root)
    for i in range(d):
        for j in range(i + 1):
            total = 0.0
            for m in range(i, d):
                total += root[m, i] * root[m, j]
            out[i, j] = out[j, i] = total


@callee
def invert_root(matrix: Float, out: Float) -> None:
    """Writes L⁻¹ into `out`, where LLᵀ is the matrix, of which only the lower triangle is read (Cholesky)."""
    d = len(matrix)
    for i in range(d):
        for j in range(i + 1):
            total = matrix[i, j]
            for m in range(j):
                total -= out[i, m] * out[j, m]
            out[i, j] = np.sqrt(total) if i == j else total / out[j, j]
            out[j, i] = out[i, j] if i == j else 0.0
    for j in range(d):
        out[j, j] = 1 / out[j, j]
        for i in range(j + 1, d):
            total = 0.0
            for m in range(j, i):
                total -= out[i, m] * out[m, j]
            out[i, j] = total / out[i, i]


@callee
def solve_with_root(root: Float, right: Float) -> Float:
    """The solution (d,) of M y = `right`, given L⁻¹ of M = LLᵀ."""
    solution = np.zeros(len(right))
    for i in range(len(right)):
        total = 0.0
        for j in range(i + 1):
            total += root[i, j] * right[j]
        for j in range(i + 1):
            solution[j] += root[i, j] * total
    return solution


@callee
def _safe_determinant(matrix: Float) -> float:
    """The determinant of a symmetric matrix; 0 where rounding leaves one that is not positive definite."""
    d = len(matrix)
    if d == 2:
        return float(matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0])
    reduced, product = matrix.copy(), 1.0
    for j in range(d):
        if reduced[j, j] <= 0:
            return 0.0
        product *= reduced[j, j]
        for i in range(j + 1, d):
            for m in range(j + 1, d):
                reduced[i, m] -= reduced[i, j] * reduced[j, m] / reduced[j, j]
    return product
