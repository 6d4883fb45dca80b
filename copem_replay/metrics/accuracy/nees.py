"""NEES, and what of it a gate lets through: errors beyond it are no pairs, so where some are expected it is not 2.

Of an error whose covariance is as stated, of eigenvalues λ₁ ≥ λ₂, eᵀP⁻¹e is χ² of two degrees of freedom, and in
direction φ of the whitened error its length squared is that times s(φ) = λ₁cos²φ + λ₂sin²φ: within the gate g while
eᵀP⁻¹e ≤ t = g²/s. Beyond it is the share e^(−t/2) of them, and of what is within the first and the second moment, not
yet over the share within, are 2 − (t + 2)e^(−t/2) and 8 − (t² + 4t + 8)e^(−t/2). All are means over φ, periodic and
smooth: 64 equal steps (chosen) give six digits where one axis is twenty times the other.

Source: χ² of two degrees of freedom is the exponential distribution of mean 2; the moments are its truncated ones.
"""

from __future__ import annotations

import numpy as np

from copem_replay.core.kernels import borrowing

SMALLEST_VARIANCE_M2 = 1e-9
"""Eigenvalues of a covariance count as at least this (the contract's)."""

_ROUND = np.cos((np.arange(16) + 0.5) * np.pi / 16)
"""cos 2φ at 64 equal steps of φ round the circle, each value once: every one is met four times."""
_NEARLY_ROUND = np.cos((np.arange(8) + 0.5) * np.pi / 8)
"""At 32 steps, which where the axes are alike give the same."""
_ALIKE = 5.0
"""Up to this ratio of eigenvalues they do, to five digits."""
_NONE = 80.0
"""From this t on nothing is beyond (chosen: e⁻⁴⁰ is less than a double tells from 0 beside 1)."""
_SMALL = 1e-3
_LEAST = 1e-30


@borrowing
def nees(a: float, b: float, d: float, east_m: float, north_m: float) -> tuple[float, float, float]:
    """eᵀP⁻¹e of an error and P = ((a, b), (b, d)), and the eigenvalues of P, the larger first: (1, m², m²)."""
    half, turn = (a + d) / 2, np.hypot((a - d) / 2, b)
    along = 0.5 * np.arctan2(2 * b, a - d)  # the direction of the larger eigenvalue
    u, v = east_m * np.cos(along) + north_m * np.sin(along), north_m * np.cos(along) - east_m * np.sin(along)
    large, small = max(half + turn, SMALLEST_VARIANCE_M2), max(half - turn, SMALLEST_VARIANCE_M2)
    return float(u * u / large + v * v / small), large, small


@borrowing
def expected(large_m2: float, small_m2: float, gate_m: float) -> tuple[float, float, float]:
    """The share beyond a gate, mean NEES and mean squared NEES of what is within, for such eigenvalues."""
    square = gate_m * gate_m
    if square >= _NONE * large_m2:
        return 0.0, 2.0, 8.0
    if square < _SMALL * small_m2:
        return _of_little(large_m2, small_m2, square)
    mean, half = (large_m2 + small_m2) / 2, (large_m2 - small_m2) / 2
    steps = _NEARLY_ROUND if large_m2 <= _ALIKE * small_m2 else _ROUND
    beyond = first = second = 0.0
    for step in steps:
        t = square / (mean + half * step)
        e = np.exp(-t / 2)
        beyond += e
        first += (t + 2) * e
        second += ((t + 4) * t + 8) * e
    n = len(steps)
    within = n - beyond
    return beyond / n, (2 * n - first) / within, (8 * n - second) / within


@borrowing
def _of_little(large_m2: float, small_m2: float, square: float) -> tuple[float, float, float]:
    # The same where next to nothing is within: the first terms of their series, for the differences are but rounding.
    within = first = second = 0.0
    for step in _ROUND:
        t = max(square / ((large_m2 + small_m2) / 2 + (large_m2 - small_m2) / 2 * step), _LEAST)
        within += t / 2 - t * t / 8
        first += t * t / 4 - t**3 / 12
        second += t**3 / 6 - t**4 / 16
    return 1.0 - within / len(_ROUND), first / within, second / within
