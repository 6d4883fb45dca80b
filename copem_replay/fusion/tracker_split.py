"""The tracker's update where a part of the errors is common: a split covariance intersection filter.

Of the covariance P (4, 4) a part C, `common`, may hang together in any way with the common part of what is measured,
`share` · R; the rest of both is independent. With ω in (0, 1]: P₁ = C/ω + (P − C), R₁ = share · R/(1 − ω) + (1 − share)
· R, K = P₁Hᵀ(HP₁Hᵀ + R₁)⁻¹, x ← x + Kν, P ← (1 − KH)P₁; the independent part becomes (1 − KH)(P − C)(1 − KH)ᵀ +
K(1 − share)RKᵀ, the common part is the rest. ω is that of the least determinant of P, which is convex in it.

Source: H. Li, F. Nashashibi, M. Yang, "Split covariance intersection filter: theory and its application to vehicle
localization", IEEE T-ITS 14 (2013) 1860–1871.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.fusion.tracker_filter import update

_LEAST = 1e-6
"""ω is no smaller, and 1 − ω 0 or no smaller (chosen): nearer to the end nothing changes."""
_ROUNDS = 30
"""Golden sections: ω to .618³⁰ = 5e-7, where the determinant is flat."""
_GOLDEN = (math.sqrt(5) - 1) / 2


@nb.njit(cache=True, nogil=True)
def update_split(state: Float, P: Float, common: Float, seen: Float, share: float, grown: float) -> None:
    """Takes in a measured position, in place. `seen`: x, y, ee, en, nn; the independent part of R counts `grown` times.

    `grown`: from 1 to infinity, where the measurement tells nothing new but its common part.
    """
    own = (1.0 - share) * min(grown, 1e12)
    # The determinant is convex in ω: golden sections between its ends, which are then held against the best.
    low, high = _LEAST, 1.0 - _LEAST
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = _size(left, P, common, seen, share, own), _size(right, P, common, seen, share, own)
    for _ in range(_ROUNDS):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = _size(left, P, common, seen, share, own)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = _size(right, P, common, seen, share, own)
    omega = (low + high) / 2
    if omega >= 1.0 - 2.0 * _LEAST:  # it would not help: as if it had not been heard
        return
    independent, whole = np.empty((4, 4)), np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            independent[i, j] = P[i, j] - common[i, j]
            whole[i, j] = common[i, j] / omega + independent[i, j]
    scale = share / (1.0 - omega) + own
    gain = _gain(whole, scale * seen[2], scale * seen[3], scale * seen[4])
    update(state, whole, seen[0], seen[1], scale * seen[2], scale * seen[3], scale * seen[4])
    left_over = _reduced(independent, gain, own * seen[2], own * seen[3], own * seen[4])
    for i in range(4):
        for j in range(4):
            P[i, j] = whole[i, j]
            common[i, j] = whole[i, j] - left_over[i, j]


@nb.njit(cache=True, nogil=True)
def _size(omega: float, P: Float, common: Float, seen: Float, share: float, own: float) -> float:
    """The determinant of P after the update: |P₁| |R₁| / |HP₁Hᵀ + R₁|, P₁ by blocks of position and velocity."""
    more, scale = 1.0 / omega - 1.0, share / (1.0 - omega) + own
    a, b, d = P[0, 0] + more * common[0, 0], P[0, 1] + more * common[0, 1], P[1, 1] + more * common[1, 1]
    det = a * d - b * b
    p, q = P[0, 2] + more * common[0, 2], P[1, 2] + more * common[1, 2]
    r, s = P[0, 3] + more * common[0, 3], P[1, 3] + more * common[1, 3]
    xx = P[2, 2] + more * common[2, 2] - (d * p * p - 2.0 * b * p * q + a * q * q) / det
    xy = P[2, 3] + more * common[2, 3] - (d * p * r - b * (p * s + q * r) + a * q * s) / det
    yy = P[3, 3] + more * common[3, 3] - (d * r * r - 2.0 * b * r * s + a * s * s) / det
    ee, en, nn = scale * seen[2], scale * seen[3], scale * seen[4]
    measured = (ee * nn - en * en) / ((a + ee) * (d + nn) - (b + en) * (b + en))
    return float(det * (xx * yy - xy * xy) * measured)


@nb.njit(cache=True, nogil=True)
def _gain(whole: Float, ee: float, en: float, nn: float) -> Float:
    """K (4, 2)."""
    a, b, d = whole[0, 0] + ee, whole[0, 1] + en, whole[1, 1] + nn
    det = a * d - b * b
    gain = np.empty((4, 2))
    for i in range(4):
        gain[i, 0] = (whole[i, 0] * d - whole[i, 1] * b) / det
        gain[i, 1] = (whole[i, 1] * a - whole[i, 0] * b) / det
    return gain


@nb.njit(cache=True, nogil=True)
def _reduced(independent: Float, gain: Float, ee: float, en: float, nn: float) -> Float:
    """(1 − KH) N (1 − KH)ᵀ + K R Kᵀ, symmetric."""
    half, out = np.empty((4, 4)), np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            half[i, j] = independent[i, j] - gain[i, 0] * independent[0, j] - gain[i, 1] * independent[1, j]
    for i in range(4):
        for j in range(i + 1):
            out[i, j] = half[i, j] - half[i, 0] * gain[j, 0] - half[i, 1] * gain[j, 1]
            out[i, j] += gain[i, 0] * (ee * gain[j, 0] + en * gain[j, 1])
            out[i, j] += gain[i, 1] * (en * gain[j, 0] + nn * gain[j, 1])
            out[j, i] = out[i, j]
    return out
