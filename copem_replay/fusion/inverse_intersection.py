"""Inverse covariance intersection: what two estimates may know from one source is taken out once, not twice.

Source: B. Noack, J. Sijs, M. Reinhardt, U. Hanebeck, "Decentralized data fusion with inverse covariance intersection",
Automatica 79 (2017) 35–41.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.fusion.covariance import invert

_ALIKE = 1e-9
"""Inputs of which neither lowers the criterion by more than this share are equally good (chosen)."""
_ROUNDS = 100
"""Enough halvings for any slope (chosen: the search ends long before)."""


@nb.njit(cache=True, nogil=True)
def inverse_covariance_intersection(x: Float, cov: Float, by_determinant: bool) -> tuple[Float, Float]:
    """Mean (d,) and covariance (d, d) of estimates `x (n, d)`, `cov (n, d, d)`, one after the other as they stand.

    Of two, A the first: P⁻¹ = A⁻¹ + B⁻¹ − (ωA + (1 − ω)B)⁻¹, ω in [0, 1] of least trace or determinant, which is convex
    in ω. Not too sure where what both know is one piece of information that either could have had alone; not for any
    correlation. An input that wins alone comes back as it is. Of equally good ones each counts alike, the k-th 1/k.
    More than two: the result depends on their order, which the caller has to choose by what they say.
    """
    n, d = x.shape
    mean, P = x[0].copy(), (cov[0] + cov[0].T) / 2
    inverse_a, inverse_b, G, P_new = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    for k in range(1, n):
        B = cov[k]
        invert(P, inverse_a)
        invert(B, inverse_b)
        low = _slope(0.0, P, B, inverse_a, inverse_b, by_determinant)
        high = _slope(1.0, P, B, inverse_a, inverse_b, by_determinant)
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
            omega = _lowest(low, high, P, B, inverse_a, inverse_b, by_determinant)
        _combine(omega, P, B, inverse_a, inverse_b, G, P_new)
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


@nb.njit(cache=True, nogil=True)
def _combine(omega: float, A: Float, B: Float, inverse_a: Float, inverse_b: Float, G: Float, P: Float) -> None:
    """Writes G = (ωA + (1 − ω)B)⁻¹ and P."""
    d = len(A)
    for i in range(d):
        for j in range(d):
            P[i, j] = omega * A[i, j] + (1 - omega) * B[i, j]
    invert(P, G)
    information = np.empty((d, d))
    for i in range(d):
        for j in range(d):
            information[i, j] = inverse_a[i, j] + inverse_b[i, j] - G[i, j]
    invert(information, P)


@nb.njit(cache=True, nogil=True)
def _slope(omega: float, A: Float, B: Float, inverse_a: Float, inverse_b: Float, by_determinant: bool) -> float:
    """Derivative of the criterion by ω over its value (of the determinant: of its logarithm).

    −⟨P, P G (A − B) G⟩ over tr P, or −tr(P G (A − B) G).
    """
    d = len(A)
    G, P = np.empty((d, d)), np.empty((d, d))
    _combine(omega, A, B, inverse_a, inverse_b, G, P)
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


@nb.njit(cache=True, nogil=True)
def _lowest(
    low: float, high: float, A: Float, B: Float, inverse_a: Float, inverse_b: Float, by_determinant: bool
) -> float:
    """ω where the slope, `low` < 0 at 0 and `high` > 0 at 1, is 0: false position, with halvings where it stalls."""
    left, right, omega, before = 0.0, 1.0, 0.5, 2.0
    for count in range(_ROUNDS):
        width = right - left
        omega = left - low * width / (high - low) if count % 3 < 2 else (left + right) / 2
        slope = _slope(omega, A, B, inverse_a, inverse_b, by_determinant)
        if abs(omega - before) <= 1e-13 or slope == 0:
            break
        before = omega
        if slope < 0:
            left, low = omega, slope
        else:
            right, high = omega, slope
    return omega
