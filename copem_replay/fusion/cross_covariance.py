"""Estimates whose errors are correlated by a known degree: the best linear one (Bar-Shalom and Campo).

Source: Y. Bar-Shalom, L. Campo, "The effect of the common process noise on the two-sensor fused-track covariance", IEEE
T-AES 22 (1986) 803–805; for n inputs the best linear unbiased estimate with their joint covariance.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.fusion.covariance import invert


@nb.njit(cache=True, nogil=True)
def by_cross_covariance(x: Float, cov: Float, correlation: float) -> tuple[Float, Float]:
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
    information, moment, whole = np.zeros((2, 2)), np.zeros(2), np.zeros(2)
    for k in range(n):
        own = roots[k] - mean_root
        y = np.zeros(2)
        for i in range(2):
            for j in range(2):
                y[i] += roots[k, i, j] * (x[k, j] - x[0, j])
        whole += y
        for i in range(2):
            for j in range(2):
                moment[i] += apart * own[i, j] * y[j]
                for m in range(2):
                    information[i, j] += apart * own[i, m] * own[m, j]
    for i in range(2):
        for j in range(2):
            moment[i] += along * mean_root[i, j] * whole[j]
            for m in range(2):
                information[i, j] += n * along * mean_root[i, m] * mean_root[m, j]
    P = np.empty((2, 2))
    invert(information, P)
    mean = x[0].copy()
    for i in range(2):
        for j in range(2):
            mean[i] += P[i, j] * moment[j]
    return mean, P


@nb.njit(cache=True, nogil=True)
def _inverse_root(cov: Float, out: Float) -> None:
    """The inverse of the symmetric square root, itself symmetric: √A = (A + √det·1)/√(tr + 2√det) in the plane."""
    ee, en, nn = cov[0, 0], (cov[0, 1] + cov[1, 0]) / 2, cov[1, 1]
    root_det = math.sqrt(ee * nn - en * en)
    scale = 1 / (root_det * math.sqrt(ee + nn + 2 * root_det))
    out[0, 0], out[1, 1] = (nn + root_det) * scale, (ee + root_det) * scale
    out[0, 1] = out[1, 0] = -en * scale
