"""Kalman filter of a point that moves at constant velocity, its position measured: the kernels.

State (x, y, vx, vy) with covariance P (4, 4); every kernel changes both in place and leaves P symmetric. Acceleration
is white noise of spectral density q [m²/s³] on each axis: Q = q [Δt³/3 Δt²/2; Δt²/2 Δt], so that two steps are as good
as one. Measured is z = (x, y) with covariance R = (ee, en; en, nn).

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley 2001
(Kalman filter and its Joseph form, continuous white noise acceleration, gate).
"""

from __future__ import annotations

import numba as nb

from copem_replay.core.tracks import Float


@nb.njit(cache=True, nogil=True)
def carry(P: Float, dt_s: float) -> None:
    """Lets `dt_s` ≥ 0 pass: P ← F P Fᵀ, in place, without acceleration."""
    for i in range(2):
        for j in range(2):
            P[i, j] += dt_s * (P[i, 2 + j] + P[2 + i, j]) + dt_s * dt_s * P[2 + i, 2 + j]
    for i in range(2):
        for j in range(2):
            P[i, 2 + j] += dt_s * P[2 + i, 2 + j]
            P[2 + j, i] = P[i, 2 + j]


@nb.njit(cache=True, nogil=True)
def predict(state: Float, P: Float, dt_s: float, q_m2ps3: float) -> None:
    """Lets `dt_s` ≥ 0 pass: x ← F x, P ← F P Fᵀ + Q."""
    for i in range(2):
        state[i] += dt_s * state[2 + i]
    carry(P, dt_s)
    for i in range(2):
        P[i, i] += q_m2ps3 * dt_s**3 / 3
        P[i, 2 + i] += q_m2ps3 * dt_s**2 / 2
        P[2 + i, i] = P[i, 2 + i]
        P[2 + i, 2 + i] += q_m2ps3 * dt_s


@nb.njit(cache=True, nogil=True)
def update(state: Float, P: Float, x_m: float, y_m: float, ee: float, en: float, nn: float) -> None:
    """Takes in a measured position: x ← x + K ν, P ← (I − K H) P (I − K H)ᵀ + K R Kᵀ."""
    a, b, d = P[0, 0] + ee, P[0, 1] + en, P[1, 1] + nn
    det = a * d - b * b
    k_x = _gain(P, d / det, -b / det)
    k_y = _gain(P, -b / det, a / det)
    # I − K H in the measured rows is R S⁻¹: so written, nothing is left of a difference of nearly equal numbers.
    r00, r01 = (ee * d - en * b) / det, (en * a - ee * b) / det
    r10, r11 = (en * d - nn * b) / det, (nn * a - en * b) / det
    dx, dy = x_m - state[0], y_m - state[1]
    for i in range(4):
        state[i] += k_x[i] * dx + k_y[i] * dy
    for j in range(4):
        p0, p1 = P[0, j], P[1, j]
        P[0, j], P[1, j] = r00 * p0 + r01 * p1, r10 * p0 + r11 * p1
        P[2, j] -= k_x[2] * p0 + k_y[2] * p1
        P[3, j] -= k_x[3] * p0 + k_y[3] * p1
    for i in range(4):
        p0, p1 = P[i, 0], P[i, 1]
        noise_x, noise_y = k_x[i] * ee + k_y[i] * en, k_x[i] * en + k_y[i] * nn
        P[i, 0], P[i, 1] = r00 * p0 + r01 * p1, r10 * p0 + r11 * p1
        P[i, 2] -= p0 * k_x[2] + p1 * k_y[2]
        P[i, 3] -= p0 * k_x[3] + p1 * k_y[3]
        for j in range(4):
            P[i, j] += noise_x * k_x[j] + noise_y * k_y[j]
    for i in range(4):
        for j in range(i):
            P[i, j] = P[j, i] = (P[i, j] + P[j, i]) / 2


@nb.njit(cache=True, nogil=True)
def _gain(P: Float, a: float, b: float) -> tuple[float, float, float, float]:
    """A column of K = P Hᵀ S⁻¹, (a, b) being that column of S⁻¹."""
    return (
        P[0, 0] * a + P[0, 1] * b,
        P[1, 0] * a + P[1, 1] * b,
        P[2, 0] * a + P[2, 1] * b,
        P[3, 0] * a + P[3, 1] * b,
    )


@nb.njit(cache=True, nogil=True)
def distance2(dx_m: float, dy_m: float, a: float, b: float, d: float) -> float:
    """Mahalanobis distance d² = νᵀ S⁻¹ ν of ν = (dx, dy), S = (a, b; b, d)."""
    return (d * dx_m * dx_m - 2 * b * dx_m * dy_m + a * dy_m * dy_m) / (a * d - b * b)
