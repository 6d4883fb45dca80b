"""Covariance union: two estimates of one thing that contradict each other, of which either may be right.

With y the mean's place from the middle between a and b, δ = b − a, U = A + (x − a)(x − a)ᵀ and V likewise: V − U =
B − A − yδᵀ − δyᵀ. Of all P ⪰ U, V the least trace has U + (V − U)₊, which is (tr U + tr V + ‖V − U‖₁)/2, the norm being
the sum of the absolute eigenvalues. So |y|² + ‖V − U‖₁/2 is to be least: convex, in the plane two nested searches.

Source: J. Uhlmann, "Covariance consistency methods for fault-tolerant distributed data fusion", Information Fusion 4
(2003) 201–215 (the two conditions on P).
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from copem_replay.core.tracks import Float

_GOLDEN = (math.sqrt(5) - 1) / 2
_ROUNDS = 60
"""Golden sections, and halvings: .618⁶⁰ = 3e-13 of the distance between the two."""


@nb.njit(cache=True, nogil=True)
def covariance_union(a: Float, A: Float, b: Float, B: Float) -> tuple[Float, Float]:
    """Mean x (2,) and covariance P (2, 2) of least trace with P ⪰ A + (x − a)(x − a)ᵀ and P ⪰ B + (x − b)(x − b)ᵀ.

    Whichever of the two is right, P is no surer of it than it may be. Where one covers the other, it comes back as it
    is. The order of the two does not matter, beyond rounding.
    """
    apart = math.hypot(b[0] - a[0], b[1] - a[1])
    cos, sin = ((b[0] - a[0]) / apart, (b[1] - a[1]) / apart) if apart > 0 else (1.0, 0.0)
    # B − A along the line from a to b, between along and across, and across
    ee, en, nn = B[0, 0] - A[0, 0], (B[0, 1] + B[1, 0] - A[0, 1] - A[1, 0]) / 2, B[1, 1] - A[1, 1]
    along = cos * cos * ee + 2 * cos * sin * en + sin * sin * nn
    both = cos * sin * (nn - ee) + (cos * cos - sin * sin) * en
    across = sin * sin * ee - 2 * cos * sin * en + cos * cos * nn
    if _covers(along - apart * apart, both, across):
        return b.copy(), (B + B.T) / 2
    if _covers(-along - apart * apart, both, -across):
        return a.copy(), (A + A.T) / 2
    u, v = _place(along, both, across, apart)
    mean, P = np.empty(2), (A + A.T) / 2
    mean[0] = (a[0] + b[0]) / 2 + u * cos - v * sin
    mean[1] = (a[1] + b[1]) / 2 + u * sin + v * cos
    plus = _positive_part(along - 2 * u * apart, both - v * apart, across)
    from_a = u + apart / 2
    along, both, across = from_a * from_a + plus[0], from_a * v + plus[1], v * v + plus[2]
    P[0, 0] += cos * cos * along - 2 * cos * sin * both + sin * sin * across
    P[1, 1] += sin * sin * along + 2 * cos * sin * both + cos * cos * across
    P[0, 1] += cos * sin * (along - across) + (cos * cos - sin * sin) * both
    P[1, 0] = P[0, 1]
    return mean, P


@nb.njit(cache=True, nogil=True)
def _covers(a: float, b: float, d: float) -> bool:
    """Whether (a, b; b, d) is positive semi-definite."""
    return a >= 0 and d >= 0 and a * d >= b * b


@nb.njit(cache=True, nogil=True)
def _place(along: float, both: float, across: float, apart: float) -> tuple[float, float]:
    """The place of least trace from the middle: towards b (by golden sections), and to the left of that way."""
    if apart == 0:
        return 0.0, 0.0
    low, high = -apart / 2, apart / 2
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left = _least(left, along, both, across, apart)[1]
    at_right = _least(right, along, both, across, apart)[1]
    for _ in range(_ROUNDS):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = _least(left, along, both, across, apart)[1]
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = _least(right, along, both, across, apart)[1]
    u = (low + high) / 2
    return u, _least(u, along, both, across, apart)[0]


@nb.njit(cache=True, nogil=True)
def _least(u: float, along: float, both: float, across: float, apart: float) -> tuple[float, float]:
    """The best v beside this u, by halvings, and u² + v² + ‖V − U‖₁/2 there.

    The norm of (m, q; q, n) is the larger of |m + n| and the root of (m − n)² + 4q².
    """
    m = along - 2 * u * apart
    trace, difference = abs(m + across), m - across
    low, high = 0.0, min(abs(both) / apart, apart / 2)
    for _ in range(_ROUNDS):
        v = (low + high) / 2
        q = abs(both) - v * apart
        norm = math.hypot(difference, 2 * q)
        if norm <= trace or v * norm >= apart * q:
            high = v
        else:
            low = v
    v = math.copysign(high, both)
    norm = max(trace, math.hypot(difference, 2 * (both - v * apart)))
    return v, u * u + v * v + norm / 2


@nb.njit(cache=True, nogil=True)
def _positive_part(a: float, b: float, d: float) -> tuple[float, float, float]:
    """Of (a, b; b, d) what remains where negative eigenvalues count as 0."""
    middle, half = (a + d) / 2, math.hypot((a - d) / 2, b)
    if middle >= half:
        return a, b, d
    high = middle + half
    if high <= 0:
        return 0.0, 0.0, 0.0
    # high · eeᵀ, with 2eeᵀ = 1 + (cos 2φ, sin 2φ; sin 2φ, −cos 2φ)
    c2, s2 = (a - d) / 2 / half, b / half
    return high * (1 + c2) / 2, high * s2 / 2, high * (1 - c2) / 2
