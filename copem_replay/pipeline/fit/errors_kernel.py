"""Kernels of errors that last: whitening by a Kalman filter, and how much rows that hang together are worth."""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.core.tracks import Bool, Float, Int


@nb.njit(cache=True)
def whiten(values: Float, decay: Float, new: Bool, drift: float, constant: float) -> tuple[Float, Float]:
    """Columns (n, K) freed of their memory, (n, K), and the variance of each row given those before it, (n,).

    The model of each column, of variance 1: √drift · Ornstein–Uhlenbeck + √constant · one number per series + white
    noise. `decay (n,)`: e^(−Δ/τ) since the row before; `new (n,)`: a series begins. The filter is linear and its gains
    do not depend on the values: columns of a design are whitened like what is explained by them.

    Source: A. C. Harvey, "Forecasting, structural time series models and the Kalman filter", 1989, 3.4.
    """
    n, K = values.shape
    out, variance = np.empty((n, K)), np.empty(n)
    wander, bias = np.zeros(K), np.zeros(K)
    rest = max(1.0 - drift - constant, 1e-9)
    aa, ab, bb = drift, 0.0, constant
    for t in range(n):
        if new[t]:
            wander[:] = 0.0
            bias[:] = 0.0
            aa, ab, bb = drift, 0.0, constant
        else:
            f = decay[t]
            aa = f * f * aa + (1.0 - f * f) * drift
            ab *= f
            for k in range(K):
                wander[k] *= f
        of_a, of_b = aa + ab, ab + bb
        s = of_a + of_b + rest
        gain_a, gain_b, scale = of_a / s, of_b / s, 1.0 / np.sqrt(s)
        for k in range(K):
            innovation = values[t, k] - wander[k] - bias[k]
            out[t, k] = innovation * scale
            wander[k] += gain_a * innovation
            bias[k] += gain_b * innovation
        aa -= gain_a * of_a
        ab -= gain_a * of_b
        bb -= gain_b * of_b
        variance[t] = s
    return out, variance


@nb.njit(cache=True)
def moments(values: Float, decay: Float, new: Bool, drift: float, constant: float) -> tuple[Float, Float, float, float]:
    """What a likelihood needs of the same, in one walk: Σ v² of each column (C,), Σ v·1 (C,), Σ 1·1, Σ ln variance.

    `1`: a column of ones, whitened like the others: the common mean.
    """
    n, C = values.shape
    squares, cross = np.zeros(C), np.zeros(C)
    state = np.zeros((C + 1, 2))
    rest = max(1.0 - drift - constant, 1e-9)
    ones, logs, product = 0.0, 0.0, 1.0
    aa, ab, bb = drift, 0.0, constant
    for t in range(n):
        f = 0.0
        if new[t]:
            state[:] = 0.0
            aa, ab, bb = drift, 0.0, constant
        else:
            f = decay[t]
            aa = f * f * (aa - drift) + drift
            ab *= f
        of_a, of_b = aa + ab, ab + bb
        s = of_a + of_b + rest
        r = 1.0 / s
        gain_a, gain_b = of_a * r, of_b * r
        a, b = state[C, 0] * f, state[C, 1]
        one = 1.0 - a - b
        state[C, 0], state[C, 1] = a + gain_a * one, b + gain_b * one
        ones += one * one * r
        for k in range(C):
            a, b = state[k, 0] * f, state[k, 1]
            innovation = values[t, k] - a - b
            state[k, 0], state[k, 1] = a + gain_a * innovation, b + gain_b * innovation
            squares[k] += innovation * innovation * r
            cross[k] += innovation * one * r
        aa -= gain_a * of_a
        ab -= gain_a * of_b
        bb -= gain_b * of_b
        product *= s
        if product < 1e-200 or product > 1e200:  # a logarithm now and then
            logs += np.log(product)
            product = 1.0
    return squares, cross, ones, logs + np.log(product)


@nb.njit(cache=True)
def squared_correlations(decay: Float, new: Bool, bin_ix: Int, bins: int, drift: float, constant: float) -> Float:
    """(B,) Σ ρ² over all pairs of rows of a bin, a row with itself as 1: what a sample variance has in common."""
    out = np.zeros(bins)
    once, twice, count = np.zeros(bins), np.zeros(bins), np.zeros(bins)
    for t in range(len(decay)):
        if new[t]:
            once[:] = 0.0
            twice[:] = 0.0
            count[:] = 0.0
        else:
            f = decay[t]
            for b in range(bins):
                once[b] *= f
                twice[b] *= f * f
        b = bin_ix[t]
        pairs = drift * drift * twice[b] + 2 * drift * constant * once[b] + constant * constant * count[b]
        out[b] += 1.0 + 2.0 * pairs
        once[b] += 1.0
        twice[b] += 1.0
        count[b] += 1.0
    return out
