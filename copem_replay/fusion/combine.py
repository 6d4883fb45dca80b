"""Ways to combine the members of a cluster whose errors may be correlated: its position and covariance.

Covariance union, the best linear estimate for a known correlation, inverse and split covariance intersection. Members
stand in an order that only their content decides (fusion/gnn_kernel.py), so methods that combine one after the other
may take them as they stand.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.geometry import rotated_iou
from copem_replay.core.object_list import Entries, most_probable_class
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.fusion.covariance import covariance_intersection, invert_matrix
from copem_replay.fusion.gnn_kernel import POINT, EntryClusters, join_entry, write_entry
from copem_replay.fusion.split_intersection import split_by_share, split_by_variance, split_covariance_intersection

# Covariance union: two estimates of one thing that contradict each other, of which either may be right. With y the
# mean's place from the middle between a and b, δ = b − a, U = A + (x − a)(x − a)ᵀ and V likewise: V − U = B − A − yδᵀ −
# δyᵀ. Of all P ⪰ U, V the least trace has U + (V − U)₊, which is (tr U + tr V + ‖V − U‖₁)/2, the norm being the sum of
# the absolute eigenvalues. So |y|² + ‖V − U‖₁/2 is to be least: convex, in the plane two nested searches. Source: J.
# Uhlmann, "Covariance consistency methods for fault-tolerant distributed data fusion", Information Fusion 4 (2003)
# 201–215 (the two conditions on P).

_GOLDEN = (math.sqrt(5) - 1) / 2
_UNION_ROUNDS = 60
"""Golden sections, and halvings: .618⁶⁰ = 3e-13 of the distance between the two estimates."""


@callee
def covariance_union(a: Float, A: Float, b: Float, B: Float) -> tuple[Float, Float]:
    """Mean x (2,) and covariance P (2, 2) of least trace with P ⪰ A + (x − a)(x − a)ᵀ and P ⪰ B + (x − b)(x − b)ᵀ.

    Whichever of the two is right, P is not too small for it. Where one covers the other, it is returned as it is. The
    order of the two does not matter, beyond rounding.
    """
    distance = math.hypot(b[0] - a[0], b[1] - a[1])
    cos, sin = ((b[0] - a[0]) / distance, (b[1] - a[1]) / distance) if distance > 0 else (1.0, 0.0)
    # B − A along the line from a to b, between along and across, and across
    ee, en, nn = B[0, 0] - A[0, 0], (B[0, 1] + B[1, 0] - A[0, 1] - A[1, 0]) / 2, B[1, 1] - A[1, 1]
    along = cos * cos * ee + 2 * cos * sin * en + sin * sin * nn
    cross = cos * sin * (nn - ee) + (cos * cos - sin * sin) * en
    across = sin * sin * ee - 2 * cos * sin * en + cos * cos * nn
    if _covers(along - distance * distance, cross, across):
        return b.copy(), (B + B.T) / 2
    if _covers(-along - distance * distance, cross, -across):
        return a.copy(), (A + A.T) / 2
    u, v = _find_least_trace(along, cross, across, distance)
    mean, P = np.empty(2), (A + A.T) / 2
    mean[0] = (a[0] + b[0]) / 2 + u * cos - v * sin
    mean[1] = (a[1] + b[1]) / 2 + u * sin + v * cos
    plus = _positive_part(along - 2 * u * distance, cross - v * distance, across)
    from_a = u + distance / 2
    along, cross, across = from_a * from_a + plus[0], from_a * v + plus[1], v * v + plus[2]
    P[0, 0] += cos * cos * along - 2 * cos * sin * cross + sin * sin * across
    P[1, 1] += sin * sin * along + 2 * cos * sin * cross + cos * cos * across
    P[0, 1] += cos * sin * (along - across) + (cos * cos - sin * sin) * cross
    P[1, 0] = P[0, 1]
    return mean, P


@callee
def _covers(a: float, b: float, d: float) -> bool:
    """Whether (a, b; b, d) is positive semi-definite."""
    return a >= 0 and d >= 0 and a * d >= b * b


@callee
def _find_least_trace(along: float, cross: float, across: float, distance: float) -> tuple[float, float]:
    """The place (u, v) of least trace from the middle: u towards b (by golden sections), v to the left of that way."""
    if distance == 0:
        return 0.0, 0.0
    low, high = -distance / 2, distance / 2
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left = _minimise_across(left, along, cross, across, distance)[1]
    at_right = _minimise_across(right, along, cross, across, distance)[1]
    for _ in range(_UNION_ROUNDS):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = _minimise_across(left, along, cross, across, distance)[1]
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = _minimise_across(right, along, cross, across, distance)[1]
    u = (low + high) / 2
    return u, _minimise_across(u, along, cross, across, distance)[0]


@callee
def _minimise_across(u: float, along: float, cross: float, across: float, distance: float) -> tuple[float, float]:
    """The best v for this u, by halvings, and there the criterion u² + v² + ‖V − U‖₁/2. The norm of (m, q; q, n) is the
    larger of |m + n| and the root of (m − n)² + 4q².
    """
    m = along - 2 * u * distance
    trace, difference = abs(m + across), m - across
    low, high = 0.0, min(abs(cross) / distance, distance / 2)
    for _ in range(_UNION_ROUNDS):
        v = (low + high) / 2
        q = abs(cross) - v * distance
        norm = math.hypot(difference, 2 * q)
        if norm <= trace or v * norm >= distance * q:
            high = v
        else:
            low = v
    v = math.copysign(high, cross)
    norm = max(trace, math.hypot(difference, 2 * (cross - v * distance)))
    return v, u * u + v * v + norm / 2


@callee
def _positive_part(a: float, b: float, d: float) -> tuple[float, float, float]:
    """The matrix (a, b; b, d) with its negative eigenvalues replaced by 0, as (a, b, d)."""
    middle, half = (a + d) / 2, math.hypot((a - d) / 2, b)
    if middle >= half:
        return a, b, d
    high = middle + half
    if high <= 0:
        return 0.0, 0.0, 0.0
    # high · eeᵀ, with 2eeᵀ = 1 + (cos 2φ, sin 2φ; sin 2φ, −cos 2φ)
    c2, s2 = (a - d) / 2 / half, b / half
    return high * (1 + c2) / 2, high * s2 / 2, high * (1 - c2) / 2


# Clusters in conflict, joined by covariance union. Two clusters of one instant are one object in conflict where their
# classes agree, their boxes overlap, and no list has an entry in both (a unit that lists two things says that they are
# two).


@kernel
def unite_conflicting(
    clusters: EntryClusters, fused: Entries, entries: Entries, arrives_s: Float, agree: Bool, gate: float
) -> tuple[EntryClusters, Entries]:
    """The clusters and the entry of each, those in conflict joined. `gate`: d² beyond which a member contradicts.

    Cluster after cluster joins the earlier one, as founded, whose box overlaps its own most. Its members are taken in
    one after the other, as they stand: by inverse variance within the gate of the state so far, else by union.
    """
    instants = len(clusters.start) - 1
    host = _find_host_clusters(clusters, fused, agree)
    start, begin = np.zeros(instants + 1, np.int64), np.zeros(len(fused) + 1, np.int64)
    member, out = np.empty_like(clusters.member), np.empty(len(fused), entries.dtype)
    state, class_sum = np.empty(1, POINT), np.empty(len(CLASSES))
    joined = filled = 0
    for k in range(instants):
        for c in range(clusters.start[k], clusters.start[k + 1]):
            if host[c] != c:
                continue
            for other in range(c, clusters.start[k + 1]):
                if host[other] == c:
                    for m in clusters.member[clusters.begin[other] : clusters.begin[other + 1]]:
                        member[filled] = m
                        filled += 1
            begin[joined + 1] = filled
            members = member[begin[joined] : filled]
            class_sum[:] = 0.0
            for i in range(len(members)):
                point = clusters.points[members[i]]
                if i == 0:
                    state[0] = point
                else:
                    _take_in_member(state[0], point, gate)
                for h in range(len(CLASSES)):
                    class_sum[h] += entries[point.row].class_probability[h]
            write_entry(out[joined], state[0], class_sum, members, clusters.points, entries, arrives_s)
            joined += 1
        start[k + 1] = joined
    return EntryClusters(start, begin[: joined + 1], member, clusters.points), out[:joined]


@callee
def _find_host_clusters(clusters: EntryClusters, fused: Entries, agree: Bool) -> Int:
    """(clusters,) the cluster of the same instant that each becomes part of, as boxes overlap; its own index: none."""
    host, class_ix = np.arange(len(fused)), np.empty(len(fused), np.int64)
    for c in range(len(fused)):
        class_ix[c] = most_probable_class(fused[c].class_probability)
    for k in range(len(clusters.start) - 1):
        first = clusters.start[k]
        for c in range(first, clusters.start[k + 1]):
            best_overlap, a = 0.0, fused[c]
            for other in range(first, c):
                b = fused[other]
                reach = np.hypot(a.length_m, a.width_m) / 2 + np.hypot(b.length_m, b.width_m) / 2
                distance2 = (a.x_m - b.x_m) ** 2 + (a.y_m - b.y_m) ** 2
                if host[other] != other or distance2 > reach * reach or not agree[class_ix[c], class_ix[other]]:
                    continue
                overlap = rotated_iou(
                    a.x_m, a.y_m, a.yaw_rad, a.length_m, a.width_m, b.x_m, b.y_m, b.yaw_rad, b.length_m, b.width_m
                )
                if overlap > best_overlap and not _share_a_list(clusters, host, c, other, first):
                    best_overlap = overlap
                    host[c] = other
    return host


@callee
def _share_a_list(clusters: EntryClusters, host: Int, c: int, into: int, first: int) -> bool:
    """Whether a list has an entry in cluster c and in any that is part of `into`."""
    for other in range(first, c):
        if host[other] != into:
            continue
        for m in clusters.member[clusters.begin[other] : clusters.begin[other + 1]]:
            for n in clusters.member[clusters.begin[c] : clusters.begin[c + 1]]:
                if clusters.points[m].list == clusters.points[n].list:
                    return True
    return False


@callee
def _take_in_member(state: Any, point: Any, gate: float) -> None:
    """Joins a member to `state`, in place: by inverse variance within the gate, else by covariance union."""
    ee, en, nn = state.ee + point.ee, state.en + point.en, state.nn + point.nn
    dx, dy = point.x_m - state.x_m, point.y_m - state.y_m
    if nn * dx * dx - 2 * en * dx * dy + ee * dy * dy <= gate * (ee * nn - en * en):
        join_entry(state, point, True)
        return
    a, b = np.array([state.x_m, state.y_m]), np.array([point.x_m, point.y_m])
    A = np.array([[state.ee, state.en], [state.en, state.nn]])
    mean, P = covariance_union(a, A, b, np.array([[point.ee, point.en], [point.en, point.nn]]))
    state.x_m, state.y_m = mean[0], mean[1]
    state.ee, state.en, state.nn = P[0, 0], P[0, 1], P[1, 1]


# Estimates whose errors are correlated by a known degree.
# Source: Y. Bar-Shalom, L. Campo, "The effect of the common process noise on the two-sensor fused-track covariance",
# IEEE T-AES 22 (1986) 803–805; for n inputs the best linear unbiased estimate with their joint covariance.


@callee
def combine_by_cross_covariance(x: Float, cov: Float, correlation: float) -> tuple[Float, Float]:
    """Mean (2,) and covariance (2, 2) of positions `x (n, 2)`, `cov (n, 2, 2)` with errors correlated 0 ≤ ρ < 1.

    The covariance of two errors is ρ·√A·√B, with symmetric square roots: turned with the map, the result turns with it.
    With Wᵢ = √Aᵢ⁻¹, W̄ their mean: P⁻¹ = Σ(Wᵢ − W̄)²/(1 − ρ) + nW̄²/(1 + (n − 1)ρ). The order does not matter, beyond
    rounding. Two inputs: K = (A − C)(A + B − C − Cᵀ)⁻¹, x = a + K(b − a), P = A − K(A − C)ᵀ.
    """
    n = len(x)
    if n == 1:
        return x[0].copy(), (cov[0] + cov[0].T) / 2
    roots, mean_root = np.empty((n, 2, 2)), np.zeros((2, 2))
    for k in range(n):
        _inverse_root(cov[k], roots[k])
        mean_root += roots[k]
    mean_root /= n
    apart, along = 1 / (1 - correlation), 1 / (1 + (n - 1) * correlation)
    information, moment, total = np.zeros((2, 2)), np.zeros(2), np.zeros(2)
    for k in range(n):
        deviation = roots[k] - mean_root
        y = np.zeros(2)
        for i in range(2):
            for j in range(2):
                y[i] += roots[k, i, j] * (x[k, j] - x[0, j])
        total += y
        for i in range(2):
            for j in range(2):
                moment[i] += apart * deviation[i, j] * y[j]
                for m in range(2):
                    information[i, j] += apart * deviation[i, m] * deviation[m, j]
    for i in range(2):
        for j in range(2):
            moment[i] += along * mean_root[i, j] * total[j]
            for m in range(2):
                information[i, j] += n * along * mean_root[i, m] * mean_root[m, j]
    P = np.empty((2, 2))
    invert_matrix(information, P)
    mean = x[0].copy()
    for i in range(2):
        for j in range(2):
            mean[i] += P[i, j] * moment[j]
    return mean, P


@callee
def _inverse_root(cov: Float, out: Float) -> None:
    """The inverse of the symmetric square root, itself symmetric: √A = (A + √det·1)/√(tr + 2√det) in the plane."""
    ee, en, nn = cov[0, 0], (cov[0, 1] + cov[1, 0]) / 2, cov[1, 1]
    root_det = math.sqrt(ee * nn - en * en)
    scale = 1 / (root_det * math.sqrt(ee + nn + 2 * root_det))
    out[0, 0], out[1, 1] = (nn + root_det) * scale, (ee + root_det) * scale
    out[0, 1] = out[1, 0] = -en * scale


# Inverse covariance intersection: information that two estimates may have from one source is counted once, not twice.
# Source: B. Noack, J. Sijs, M. Reinhardt, U. Hanebeck, "Decentralized data fusion with inverse covariance
# intersection", Automatica 79 (2017) 35–41.

_ALIKE = 1e-9
"""Inputs of which neither lowers the criterion by more than this share are equally good: above rounding."""
_INTERSECTION_ROUNDS = 100
"""A bound of the search, far above the halvings that a number in [0, 1] can take; it ends long before."""


@callee
def inverse_covariance_intersection(x: Float, cov: Float, by_determinant: bool) -> tuple[Float, Float]:
    """Mean (d,) and covariance (d, d) of estimates `x (n, d)`, `cov (n, d, d)`, one after the other as they stand.

    Of two, A the first: P⁻¹ = A⁻¹ + B⁻¹ − (ωA + (1 − ω)B)⁻¹, ω in [0, 1] of least trace or determinant, which is convex
    in ω. Not too sure where all common information is one piece that either could have had alone; but not for every
    correlation. An input that wins alone is returned as it is. Of equally good ones each counts alike, the k-th 1/k.
    With more than two the result depends on their order, which the caller must derive from their content.
    """
    n, d = x.shape
    mean, P = x[0].copy(), (cov[0] + cov[0].T) / 2
    inverse_a, inverse_b, G, P_new = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    for k in range(1, n):
        B = cov[k]
        invert_matrix(P, inverse_a)
        invert_matrix(B, inverse_b)
        low = _omega_slope(0.0, P, B, inverse_a, inverse_b, by_determinant)
        high = _omega_slope(1.0, P, B, inverse_a, inverse_b, by_determinant)
        if abs(low) <= _ALIKE and abs(high) <= _ALIKE:
            omega = 1 / (k + 1)
        elif low >= 0:
            continue
        elif high <= 0:
            for i in range(d):
                mean[i] = x[k, i]
                for j in range(d):
                    P[i, j] = (B[i, j] + B[j, i]) / 2
            continue
        else:
            omega = _find_omega(low, high, P, B, inverse_a, inverse_b, by_determinant)
        _combine_pair(omega, P, B, inverse_a, inverse_b, G, P_new)
        # x = a + L (b − a) with L = P (B⁻¹ − (1 − ω) G)
        shift = np.zeros(d)
        for i in range(d):
            for j in range(d):
                shift[i] += (inverse_b[i, j] - (1 - omega) * G[i, j]) * (x[k, j] - mean[j])
        for i in range(d):
            for j in range(d):
                mean[i] += P_new[i, j] * shift[j]
        P[:] = P_new
    return mean, P


@callee
def _combine_pair(omega: float, A: Float, B: Float, inverse_a: Float, inverse_b: Float, G: Float, P: Float) -> None:
    """Fills G = (ωA + (1 − ω)B)⁻¹ and P = (A⁻¹ + B⁻¹ − G)⁻¹: inverse covariance intersection at weight ω."""
    d = len(A)
    for i in range(d):
        for j in range(d):
            P[i, j] = omega * A[i, j] + (1 - omega) * B[i, j]
    invert_matrix(P, G)
    information = np.empty((d, d))
    for i in range(d):
        for j in range(d):
            information[i, j] = inverse_a[i, j] + inverse_b[i, j] - G[i, j]
    invert_matrix(information, P)


@callee
def _omega_slope(omega: float, A: Float, B: Float, inverse_a: Float, inverse_b: Float, by_determinant: bool) -> float:
    """Derivative of the criterion by ω over its value (of the determinant: of its logarithm). −⟨P, P G (A − B) G⟩ over
    tr P, or −tr(P G (A − B) G).
    """
    d = len(A)
    G, P = np.empty((d, d)), np.empty((d, d))
    _combine_pair(omega, A, B, inverse_a, inverse_b, G, P)
    half, change = np.zeros((d, d)), np.zeros((d, d))
    for i in range(d):
        for j in range(d):
            for m in range(d):
                half[i, j] += G[i, m] * (A[m, j] - B[m, j])
    for i in range(d):
        for j in range(d):
            for m in range(d):
                change[i, j] += half[i, m] * G[m, j]
    total = trace = 0.0
    for i in range(d):
        trace += P[i, i]
        for j in range(d):
            if by_determinant:
                total -= P[i, j] * change[j, i]
                continue
            for m in range(d):
                total -= P[m, i] * change[i, j] * P[j, m]
    return total if by_determinant else total / trace


@callee
def _find_omega(
    low: float, high: float, A: Float, B: Float, inverse_a: Float, inverse_b: Float, by_determinant: bool
) -> float:
    """The ω in (0, 1) of slope 0, from slopes `low` < 0 at 0 and `high` > 0 at 1: false position, with halvings."""
    left, right, omega, last_omega = 0.0, 1.0, 0.5, 2.0
    for count in range(_INTERSECTION_ROUNDS):
        width = right - left
        omega = left - low * width / (high - low) if count % 3 < 2 else (left + right) / 2
        slope = _omega_slope(omega, A, B, inverse_a, inverse_b, by_determinant)
        if abs(omega - last_omega) <= 1e-13 or slope == 0:
            break
        last_omega = omega
        if slope < 0:
            left, low = omega, slope
        else:
            right, high = omega, slope
    return omega


INVERSE, SPLIT_BY_SHARE, SPLIT_BY_VARIANCE, CROSS = 0, 1, 2, 3
"""Methods of `combine_members`."""


@kernel
def combine_members(clusters: EntryClusters, method: int, setting: float, by_determinant: bool, fused: Entries) -> None:
    """Write the combined positions and covariances of clusters, in place; a single member stays as it is.

    `setting`: the dependent share, the dependent variance in m², or the correlation, as the method asks.
    """
    for c in range(len(fused)):
        members = clusters.member[clusters.begin[c] : clusters.begin[c + 1]]
        if len(members) == 1:
            continue
        x, cov = np.empty((len(members), 2)), np.empty((len(members), 2, 2))
        for i in range(len(members)):
            point = clusters.points[members[i]]
            x[i, 0], x[i, 1] = point.x_m, point.y_m
            cov[i, 0, 0], cov[i, 0, 1], cov[i, 1, 0], cov[i, 1, 1] = point.ee, point.en, point.en, point.nn
        if method == INVERSE:
            mean, P = inverse_covariance_intersection(x, cov, by_determinant)
        elif method == CROSS:
            mean, P = combine_by_cross_covariance(x, cov, setting)
        else:
            mean, P = _combine_split(x, cov, method, setting, by_determinant)
        fused[c].x_m, fused[c].y_m = mean[0], mean[1]
        fused[c].cov_ee_m2, fused[c].cov_en_m2, fused[c].cov_nn_m2 = P[0, 0], P[0, 1], P[1, 1]


@callee
def _combine_split(x: Float, cov: Float, method: int, setting: float, by_determinant: bool) -> tuple[Float, Float]:
    """Mean and covariance by split covariance intersection; by the plain one where no part is independent."""
    if method == SPLIT_BY_SHARE:
        dependent, independent = split_by_share(cov, setting)
    else:
        dependent, independent = split_by_variance(cov, setting)
    if not independent.any():
        mean, P, _ = covariance_intersection(x, cov, by_determinant)
        return mean, P
    mean, P, _, _ = split_covariance_intersection(x, dependent, independent, by_determinant)
    return mean, P
