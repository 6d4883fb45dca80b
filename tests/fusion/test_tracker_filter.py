"""The Kalman filter against the matrices of the textbook, numbers worked out elsewhere, and what must always hold."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from copem_replay.fusion.covariance import floor_eigenvalues
from copem_replay.fusion.tracker_kernel import mahalanobis2, predict_state, update_state

# As kernels call them:
floor_eigenvalues, mahalanobis2, predict_state, update_state = map(
    njit,
    (floor_eigenvalues, mahalanobis2, predict_state, update_state),
)

Array = npt.NDArray[np.float64]
H = np.eye(2, 4)


def transition(dt_s: float) -> Array:
    F = np.eye(4)
    F[0, 2] = F[1, 3] = dt_s
    return F


def process_noise(dt_s: float, q: float) -> Array:
    block = q * np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
    return np.kron(block, np.eye(2))


def drawn(seed: int) -> tuple[Array, Array]:
    """A state and a covariance of no particular form."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4))
    return rng.normal(0.0, 10.0, 4), root @ root.T + 0.01 * np.eye(4)


def covariance(east_m2: float, north_m2: float, turned_rad: float) -> Array:
    c, s = math.cos(turned_rad), math.sin(turned_rad)
    turn = np.array([[c, -s], [s, c]])
    return turn @ np.diag([east_m2, north_m2]) @ turn.T


def measured(state: Array, cov: Array, z: Array, R: Array) -> None:
    update_state(state, cov, float(z[0]), float(z[1]), float(R[0, 0]), float(R[0, 1]), float(R[1, 1]))


variances = st.floats(-9.0, 6.0).map(lambda power: 10.0**power)
angles = st.floats(-4.0, 4.0)


# ------------------------------------------------------------------------------------------- against the textbook


@given(st.integers(0, 10_000), st.floats(0.0, 3.0), st.floats(0.0, 5.0))
def test_a_prediction_is_that_of_the_matrices(seed: int, dt_s: float, q: float):
    state, cov = drawn(seed)
    F = transition(dt_s)
    expected, spread = F @ state, F @ cov @ F.T + process_noise(dt_s, q)
    predict_state(state, cov, dt_s, q)
    assert state == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert cov == pytest.approx(spread, rel=1e-12, abs=1e-12)
    assert (cov == cov.T).all()


@given(st.integers(0, 10_000), st.floats(0.01, 9.0), st.floats(0.01, 9.0), angles)
def test_an_update_is_that_of_the_matrices(seed: int, first_m2: float, second_m2: float, turned_rad: float):
    state, cov = drawn(seed)
    z, R = np.array([3.0, -2.0]), covariance(first_m2, second_m2, turned_rad)
    K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + R)
    expected, spread = state + K @ (z - H @ state), (np.eye(4) - K @ H) @ cov
    measured(state, cov, z, R)
    assert state == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert cov == pytest.approx(spread, rel=1e-9, abs=1e-9)
    assert (cov == cov.T).all()


@given(st.integers(0, 10_000), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_two_steps_are_one(seed: int, first_s: float, second_s: float):
    once, cov_once = drawn(seed)
    twice, cov_twice = drawn(seed)
    predict_state(once, cov_once, first_s + second_s, 0.7)
    predict_state(twice, cov_twice, first_s, 0.7)
    predict_state(twice, cov_twice, second_s, 0.7)
    assert twice == pytest.approx(once, rel=1e-12, abs=1e-12)
    assert cov_twice == pytest.approx(cov_once, rel=1e-12, abs=1e-12)


def test_two_measurements_at_once_can_come_in_any_order():
    z, R = [np.array([1.0, 2.0]), np.array([1.5, 1.0])], [covariance(1.0, 4.0, 0.3), covariance(0.5, 0.1, 1.2)]
    one, cov_one = drawn(3)
    other, cov_other = drawn(3)
    for k in (0, 1):
        measured(one, cov_one, z[k], R[k])
        measured(other, cov_other, z[1 - k], R[1 - k])
    assert one == pytest.approx(other, abs=1e-12)
    assert cov_one == pytest.approx(cov_other, abs=1e-12)


# ------------------------------------------------------------------------- a measurement that comes out of sequence


def start() -> tuple[Array, Array]:
    return np.array([0.0, 0.0, 10.0, 0.0]), np.diag([1.0, 1.0, 4.0, 4.0])


def along_x(steps: list[tuple[float, float | None]]) -> tuple[Array, Array]:
    """Position and speed along x, and their covariance, after steps of (seconds that pass, then what is measured)."""
    state, cov = start()
    for dt_s, z in steps:
        predict_state(state, cov, dt_s, 1.0)
        if z is not None:
            measured(state, cov, np.array([z, 0.0]), 0.25 * np.eye(2))
    return state[[0, 2]], cov[np.ix_([0, 2], [0, 2])]


def test_in_order_it_gives_the_exact_numbers():
    x, cov = along_x([(0.1, 1.2), (0.1, 2.1)])
    assert x == pytest.approx([2.133277, 9.998782], abs=1e-6)
    assert cov == pytest.approx(np.array([[0.126803, 0.236910], [0.236910, 3.617297]]), abs=1e-6)


def test_without_the_late_measurement():
    x, _ = along_x([(0.2, 2.1)])
    assert x == pytest.approx([2.082303, 10.058046], abs=1e-6)


def test_with_the_late_measurement_taken_for_a_current_one():
    x, _ = along_x([(0.2, 2.1), (0.0, 1.2)])
    assert x == pytest.approx([1.683976, 9.777116], abs=1e-6)


# ------------------------------------------------------------------------------------------------- what must hold


@given(st.lists(st.tuples(st.floats(0.0, 2.0), variances, variances, angles), min_size=1, max_size=30))
def test_covariances_stay_symmetric_and_positive_definite(steps: list[tuple[float, float, float, float]]):
    state, cov = np.array([1e6, -1e6, 20.0, 0.0]), np.diag([1.0, 1.0, 9.0, 9.0])
    for dt_s, first_m2, second_m2, turned_rad in steps:
        ee, en, nn = floor_eigenvalues(*covariance(first_m2, second_m2, turned_rad)[[0, 0, 1], [0, 1, 1]].tolist())
        predict_state(state, cov, dt_s, 1.0)
        update_state(state, cov, 1e6, -1e6, ee, en, nn)
        assert (cov == cov.T).all()
        assert np.isfinite(state).all()
        # Scaled to ones on the diagonal: variances differ by many powers of ten.
        scale = np.sqrt(np.diag(cov))
        assert np.linalg.eigvalsh(cov / np.outer(scale, scale)).min() > 0
        assert cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2 > 0


def test_an_exact_measurement_after_a_vague_one_is_believed_to_its_last_digit():
    state, cov = np.zeros(4), np.diag([1e6, 1e6, 9.0, 9.0])
    measured(state, cov, np.array([3.0, 4.0]), 1e-9 * np.eye(2))
    assert state[:2] == pytest.approx([3.0, 4.0], abs=1e-12)
    assert np.diag(cov)[:2] == pytest.approx([1e-9, 1e-9], rel=1e-9)


# ------------------------------------------------------------------------------------------ smallest variances, d²


@given(variances, variances, angles)
def test_what_is_wide_enough_is_left_as_it_is(first_m2: float, second_m2: float, turned_rad: float):
    given_ = covariance(first_m2 + 2e-9, second_m2 + 2e-9, turned_rad)
    if min(first_m2, second_m2) < 1e-10 * max(first_m2, second_m2):
        return
    assert floor_eigenvalues(*given_[[0, 0, 1], [0, 1, 1]].tolist()) == tuple(given_[[0, 0, 1], [0, 1, 1]].tolist())


@pytest.mark.parametrize(
    ("given_", "expected"),
    [
        ((0.0, 0.0, 0.0), (1e-9, 0.0, 1e-9)),
        ((4.0, 0.0, 0.0), (4.0, 0.0, 1e-9)),
        ((0.0, 0.0, 4.0), (1e-9, 0.0, 4.0)),
        ((1e-12, 0.0, 1e-10), (1e-9, 0.0, 1e-9)),
        # Eigenvalues 2 and 0 along the diagonals.
        ((1.0, 1.0, 1.0), (1.0 + 5e-10, 1.0 - 5e-10, 1.0 + 5e-10)),
        ((1.0, -1.0, 1.0), (1.0 + 5e-10, -1.0 + 5e-10, 1.0 + 5e-10)),
    ],
)
def test_what_is_too_narrow_is_widened_along_its_axes(given_: tuple[float, ...], expected: tuple[float, ...]):
    assert floor_eigenvalues(*given_) == pytest.approx(expected, rel=1e-12, abs=1e-15)


@given(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(0.01, 9.0), st.floats(0.01, 9.0), angles)
def test_the_distance_is_that_of_the_inverse(dx: float, dy: float, first_m2: float, second_m2: float, turned: float):
    S = covariance(first_m2, second_m2, turned)
    expected = np.array([dx, dy]) @ np.linalg.solve(S, np.array([dx, dy]))
    assert mahalanobis2(dx, dy, S[0, 0], S[0, 1], S[1, 1]) == pytest.approx(expected, rel=1e-9, abs=1e-12)
