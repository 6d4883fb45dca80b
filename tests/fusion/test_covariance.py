"""Combined estimates against published numbers, exact fractions, other optimisers, and what defines each method."""

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numba as nb
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from scipy.optimize import minimize, minimize_scalar

from copem_replay.fusion.covariance import covariance_intersection, fast_covariance_intersection, inverse_variance

# As kernels call them:
covariance_intersection, fast_covariance_intersection, inverse_variance = map(
    njit,
    (covariance_intersection, fast_covariance_intersection, inverse_variance),
)

Array = npt.NDArray[np.float64]
Estimates = tuple[Array, Array]
"""Means (n, d) and covariances (n, d, d)."""

CARMA = np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([np.diag([4.0, 5, 6]), np.diag([7.0, 8, 9])])
"""The first test of CARMA's multiple object tracking."""
CROSSED = np.array([[0.0, 0], [1, 1]]), np.array([np.diag([4.0, 1]), np.diag([1.0, 4])])


def in_plane(xx: float, xy: float, z: float = 1.0) -> Array:
    return np.array([[xx, xy, 0], [xy, xx, 0], [0, 0, z]])


TRACKS = (
    np.array([[1.0, 2, 0], [2, 2, 0], [2, 3, 0]]),
    np.array([in_plane(10, 5), in_plane(10, -5), in_plane(12, 9)]),
)
"""Three tracks of MathWorks' documentation of track fusion."""


def rotation(angle_rad: float) -> Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def turned(large: float, small: float, angle_rad: float) -> Array:
    return rotation(angle_rad) @ np.diag([large, small]) @ rotation(angle_rad).T


def information(cov: Array) -> Array:
    return np.linalg.inv(cov)


def fused(x: Array, cov: Array, weight: Array) -> Estimates:
    """The definition, word for word."""
    total = sum(w * i for w, i in zip(weight, information(cov), strict=True))
    moment = sum(w * i @ m for w, i, m in zip(weight, information(cov), x, strict=True))
    return np.linalg.solve(total, moment), np.linalg.inv(total)


def criterion(weight: Array, cov: Array, by_determinant: bool) -> float:
    covariance = fused(np.zeros(cov.shape[:2]), cov, weight)[1]
    return float(np.linalg.slogdet(covariance)[1] if by_determinant else np.trace(covariance))


def drawn(seed: int, n: int, d: int, decades: float, kinds: int | None = None) -> Estimates:
    """Random estimates, eigenvalues over so many decades; only so many `kinds` of covariances."""
    rng = np.random.default_rng(seed)
    cov = np.empty((kinds or n, d, d))
    for k in range(len(cov)):
        axes = np.linalg.qr(rng.normal(size=(d, d)))[0]
        made = axes @ np.diag(10 ** rng.uniform(-decades / 2, decades / 2, d)) @ axes.T
        cov[k] = (made + made.T) / 2
    return rng.normal(size=(n, d)) * 3, cov if kinds is None else cov[rng.integers(0, kinds, n)]


def estimates(decades: float, *, most: int = 30, least: int = 1) -> st.SearchStrategy[Estimates]:
    return st.builds(
        drawn,
        st.integers(0, 2**32 - 1),
        st.integers(least, most),
        st.integers(1, 3),
        st.floats(0, decades),
        st.none() | st.integers(1, 4),
    )


def all_methods(x: Array, cov: Array) -> list[Estimates]:
    return [
        inverse_variance(x, cov),
        covariance_intersection(x, cov, True)[:2],
        covariance_intersection(x, cov, False)[:2],
        fast_covariance_intersection(x, cov, False)[:2],
        fast_covariance_intersection(x, cov, True)[:2],
    ]


criteria = pytest.mark.parametrize("by_determinant", [False, True], ids=["trace", "determinant"])

# ------------------------------------------------------------------------------------ vectors


@pytest.mark.parametrize(
    ("given_", "mean", "covariance"),
    [
        (CARMA, (2.090909, 3.153846, 4.2), np.diag([2.545455, 3.076923, 3.6])),
        (CROSSED, (0.8, 0.2), np.diag([0.8, 0.8])),
        (TRACKS, (1.525253, 2.414141, 0), in_plane(2.424242, 0.757576, 1 / 3)),
    ],
    ids=["carma", "crossed", "tracks"],
)
def test_inverse_variance(given_: Estimates, mean: tuple[float, ...], covariance: Array):
    found = inverse_variance(*given_)
    assert found[0] == pytest.approx(mean, abs=1e-6)
    assert found[1] == pytest.approx(covariance, abs=1e-6)


@pytest.mark.parametrize(
    ("given_", "by_determinant", "weight", "mean", "covariance"),
    [
        (CROSSED, False, (0.5, 0.5), (0.8, 0.2), 1.6 * np.eye(2)),
        (CROSSED, True, (0.5, 0.5), (0.8, 0.2), 1.6 * np.eye(2)),
        (TRACKS, False, (0, 0.577342, 0.422658), (1.681503, 2.466928, 0), in_plane(6.474902, 0.9)),
        (TRACKS, True, (0, 0.46875, 0.53125), (1.68125, 2.53125, 0), in_plane(6.6, 1.8)),
    ],
)
def test_covariance_intersection(
    given_: Estimates, by_determinant: bool, weight: tuple[float, ...], mean: tuple[float, ...], covariance: Array
):
    found = covariance_intersection(*given_, by_determinant)
    assert found[0] == pytest.approx(mean, abs=1e-6)
    assert found[1] == pytest.approx(covariance, abs=1e-6)
    assert found[2] == pytest.approx(weight, abs=1e-6)
    assert (found[2] == 0).tolist() == [w == 0 for w in weight]


@pytest.mark.parametrize("keep_best", [False, True])
def test_fast_covariance_intersection_of_three_tracks(keep_best: bool):
    # Better than the best input: it does not matter whether that is kept.
    mean, covariance, weight = fast_covariance_intersection(*TRACKS, keep_best)
    assert weight == pytest.approx((0.298211, 0.357853, 0.343936), abs=1e-6)
    assert mean == pytest.approx((1.543958, 2.423557, 0), abs=1e-6)
    assert covariance == pytest.approx(in_plane(7.160374, 2.113551), abs=1e-6)


def test_the_fast_formula_can_be_worse_than_the_best_input():
    mean, covariance, weight = fast_covariance_intersection(*CARMA, False)
    assert weight == pytest.approx((0.58951049, 0.41048951), abs=1e-8)
    assert mean == pytest.approx((1.853922, 2.909701, 3.951121), abs=1e-6)
    assert covariance == pytest.approx(np.diag([4.853922, 5.909701, 6.951121]), abs=1e-6)


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
@pytest.mark.parametrize(
    "method",
    [
        lambda x, cov: covariance_intersection(x, cov, False),
        lambda x, cov: covariance_intersection(x, cov, True),
        lambda x, cov: fast_covariance_intersection(x, cov, True),
    ],
)
def test_an_input_that_wins_alone_comes_back_to_the_last_bit(
    order: list[int], method: Callable[..., tuple[Array, Array, Array]]
):
    x, cov = CARMA[0][order] / 3, CARMA[1][order] / 3
    best = order.index(0)
    mean, covariance, weight = method(x, cov)
    assert (mean == x[best]).all()
    assert (covariance == cov[best]).all()
    assert weight.tolist() == [float(k == best) for k in range(2)]


# ---------------------------------------------------------------------- by hand, and symmetries


def test_n_equal_circles_by_inverse_variance():
    for n, variance in ((1, 1.0), (2, 0.5), (3, 1 / 3), (5, 0.2), (21, 0.047619)):
        found = inverse_variance(np.arange(2.0 * n).reshape(n, 2), np.tile(np.eye(2), (n, 1, 1)))
        assert found[0] == pytest.approx([n - 1, n], rel=1e-14)
        assert found[1] == pytest.approx(variance * np.eye(2), abs=1e-6)


def test_independent_of_one_dimension():
    # 1/4 + 1 of information; the mean a fifth of the way.
    mean, variance = inverse_variance(np.array([[0.0], [1.0]]), np.array([[[4.0]], [[1.0]]]))
    assert (mean[0], variance[0, 0]) == pytest.approx((0.8, 0.8), rel=1e-15)
    mean, variance, weight = covariance_intersection(np.array([[0.0], [1.0]]), np.array([[[4.0]], [[1.0]]]), False)
    assert (mean[0], variance[0, 0], *weight) == (1.0, 1.0, 0.0, 1.0)


@criteria
@pytest.mark.parametrize("n", [2, 3, 7, 20])
def test_equal_covariances_are_no_better_together_and_share_alike(n: int, by_determinant: bool):
    rng = np.random.default_rng(n)
    x, one = rng.normal(size=(n, 2)), turned(4.0, 0.1, 0.7)
    cov = np.tile(one, (n, 1, 1))
    for mean, covariance, weight in (
        covariance_intersection(x, cov, by_determinant),
        fast_covariance_intersection(x, cov, True),
    ):
        assert weight == pytest.approx(np.full(n, 1 / n), abs=1e-13)
        assert covariance == pytest.approx(one, rel=1e-12)
        assert mean == pytest.approx(x.mean(axis=0), abs=1e-12)
    mean, covariance = inverse_variance(x, cov)
    assert covariance == pytest.approx(one / n, rel=1e-12)
    assert mean == pytest.approx(x.mean(axis=0), abs=1e-12)


@criteria
@pytest.mark.parametrize("sides", [2, 3, 4, 5, 8])
def test_equal_sensors_all_around_share_alike_though_fewer_would_do(sides: int, by_determinant: bool):
    # Of four, two that cross would give the same covariance: which two must not depend on the order.
    # A fifth unit of no use is there to set the search off its starting point.
    angles = np.arange(sides) * math.pi / sides
    cov = np.array([turned(4.0, 1.0, a) for a in angles] + [100 * np.eye(2)])
    x = np.random.default_rng(sides).normal(size=(sides + 1, 2))
    mean, covariance, weight = covariance_intersection(x, cov, by_determinant)
    assert weight == pytest.approx([1 / sides] * sides + [0], abs=1e-11)
    assert weight[-1] == 0
    # Information 1/4 and 1, on average 5/8 in all directions.
    assert covariance == pytest.approx(1.6 * np.eye(2), rel=1e-11)
    assert mean == pytest.approx(fused(x, cov, weight)[0], abs=1e-12)


@criteria
def test_two_of_the_better_kind_share_and_the_worse_gets_nothing(by_determinant: bool):
    cov = np.array([3 * np.eye(2), np.eye(2), 3 * np.eye(2), np.eye(2)])
    x = np.array([[9.0, 9], [0, 0], [7, 7], [1, 2]])
    for mean, covariance, weight in (
        covariance_intersection(x, cov, by_determinant),
        fast_covariance_intersection(x, cov, True),
    ):
        assert weight == pytest.approx([0, 0.5, 0, 0.5], abs=1e-13)
        assert (weight[::2] == 0).all()
        assert mean == pytest.approx([0.5, 1.0], abs=1e-12)
        assert covariance == pytest.approx(np.eye(2), abs=1e-12)


@given(estimates(6, most=1))
def test_a_single_estimate_comes_back(one: Estimates):
    for mean, covariance in all_methods(*one):
        assert (mean == one[0][0]).all()
        assert (covariance == one[1][0]).all()
    assert covariance_intersection(*one, True)[2].tolist() == [1.0]
    assert fast_covariance_intersection(*one, False)[2].tolist() == [1.0]


@given(estimates(4), st.randoms())
def test_the_order_of_the_inputs_does_not_matter(given_: Estimates, random: Any):
    x, cov = given_
    order = list(range(len(x)))
    random.shuffle(order)
    for one, other in zip(all_methods(x, cov), all_methods(x[order], cov[order]), strict=True):
        assert other[0] == pytest.approx(one[0], abs=1e-7)
        assert other[1] == pytest.approx(one[1], abs=1e-9 * np.trace(one[1]))


@criteria
@pytest.mark.parametrize(("large", "factors"), [(20.0, (1.0, 2.0)), (20.0, (1.0, 1.1, 1.3)), (4.0, (1.0, 1.05, 4.0))])
def test_nor_does_it_where_many_weights_would_do(large: float, factors: tuple[float, ...], by_determinant: bool):
    # Few kinds of ellipses in four directions: the best covariance can be had in several ways, and often is.
    for seed in range(150):
        rng = np.random.default_rng(seed)
        n = 3 + seed % 12
        kinds = zip(rng.integers(0, 4, n), rng.choice(factors, n), strict=True)
        cov = np.array([factor * turned(large, 1.0, math.pi * quarter / 4) for quarter, factor in kinds])
        x, order = rng.normal(size=(n, 2)), rng.permutation(n)
        one = covariance_intersection(x, cov, by_determinant)
        other = covariance_intersection(x[order], cov[order], by_determinant)
        assert other[2] == pytest.approx(one[2][order], abs=1e-10)
        assert other[0] == pytest.approx(one[0], abs=1e-9)
        # Equal ones share alike.
        for k in range(n):
            same = (cov == cov[k]).all(axis=(1, 2))
            assert one[2][same] == pytest.approx(one[2][k], abs=1e-10)


@criteria
@pytest.mark.parametrize("difference", [1e-15, 1e-13, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6])
def test_nor_does_it_where_covariances_differ_in_late_digits_only(difference: float, by_determinant: bool):
    # Any weights do here, for the covariance; the mean follows the weights.
    for seed in range(40):
        x, cov = drawn(seed, 2 + seed % 20, 2, difference, None if seed % 2 else 3)
        order = np.random.default_rng(seed).permutation(len(x))
        one = covariance_intersection(x, cov, by_determinant)
        other = covariance_intersection(x[order], cov[order], by_determinant)
        assert other[0] == pytest.approx(one[0], abs=1e-7)
        assert other[1] == pytest.approx(one[1], abs=1e-12)


@given(estimates(3), st.floats(-math.pi, math.pi), st.floats(-8000, 8000))
def test_the_frame_of_reference_does_not_matter(given_: Estimates, angle_rad: float, shift_m: float):
    x, cov = given_
    turn = np.eye(x.shape[1])
    if len(turn) > 1:
        turn[:2, :2] = rotation(angle_rad)
    there = all_methods(x @ turn.T + shift_m, turn @ cov @ turn.T)
    for here, elsewhere in zip(all_methods(x, cov), there, strict=True):
        # Where covariances differ in late digits only, any weights do, and the mean follows the weights.
        assert elsewhere[0] == pytest.approx(turn @ here[0] + shift_m, abs=1e-5)
        assert elsewhere[1] == pytest.approx(turn @ here[1] @ turn.T, abs=1e-9 * np.trace(here[1]))


@given(estimates(6))
def test_covariances_are_symmetric_and_positive_definite(given_: Estimates):
    smallest = np.linalg.eigvalsh(given_[1]).min()
    for mean, covariance in all_methods(*given_):
        assert np.isfinite(mean).all()
        assert (covariance == covariance.T).all()
        # Nothing is better than all that is known, n times the best in every direction.
        assert np.linalg.eigvalsh(covariance).min() > 0.99 * smallest / len(given_[0])


@given(estimates(6))
def test_weights_are_shares(given_: Estimates):
    for method, flag in (
        (covariance_intersection, True),
        (covariance_intersection, False),
        (fast_covariance_intersection, False),
        (fast_covariance_intersection, True),
    ):
        weight = method(*given_, flag)[2]
        assert (weight >= 0).all()
        assert weight.sum() == pytest.approx(1, abs=1e-14)


# ---------------------------------------------------------------------------------- far away


def exactly(x: Array, cov: Array) -> list[float]:
    """Inverse-variance mean of 2-D estimates in fractions."""
    a = b = c = u = v = Fraction(0)
    for mean, spread in zip(x, cov, strict=True):
        ee, en, nn = Fraction(spread[0, 0]), Fraction(spread[0, 1]), Fraction(spread[1, 1])
        det = ee * nn - en * en
        a, b, c = a + nn / det, b - en / det, c + ee / det
        u += (nn * Fraction(mean[0]) - en * Fraction(mean[1])) / det
        v += (ee * Fraction(mean[1]) - en * Fraction(mean[0])) / det
    det = a * c - b * b
    return [float((c * u - b * v) / det), float((a * v - b * u) / det)]


def test_no_digits_are_lost_seven_kilometres_from_the_origin():
    # Ellipses of 1 m by 1 mm that are all but parallel: the least of their entries' digits decide.
    x = np.array([[7000.25, -6999.5], [7000.5, -6999.75], [7000.0, -6999.25]])
    cov = np.array([turned(1.0, 1e-6, a) for a in (0.7, 0.7001, 0.7002)])
    cov[:, 1, 0] = cov[:, 0, 1]
    expected = exactly(x, cov)
    assert np.abs(inverse_variance(x, cov)[0] - expected).max() < 5e-9
    # So this can fail: not relative to the first, the same sums are farther off.
    assert np.abs(fused(x, cov, np.ones(3))[0] - expected).max() > 5e-8


def test_exact_states_outweigh_all_others_and_agree_to_the_micrometre():
    x = np.array([[7000.0, 1.0], [7003.0, 2.0], [6990.0, 5.0]])
    cov = np.array([100 * np.eye(2), 1e-9 * np.eye(2), 1e3 * np.eye(2)])
    for mean, covariance in all_methods(x, cov)[:3] + all_methods(x, cov)[4:]:
        assert mean == pytest.approx(x[1], rel=0, abs=1e-9)
        assert covariance == pytest.approx(cov[1], rel=1e-9)


# ------------------------------------------------------------------------ the best weights


@criteria
@given(estimates(3, least=2))
def test_no_input_scores_more_than_those_with_weight(by_determinant: bool, given_: Estimates):
    # The condition that is met at the optimum and nowhere else: moving weight to any input gains nothing.
    x, cov = given_
    mean, covariance, weight = covariance_intersection(x, cov, by_determinant)
    expected = fused(x, cov, weight)
    assert mean == pytest.approx(expected[0], abs=1e-9)
    assert covariance == pytest.approx(expected[1], abs=1e-10 * np.trace(expected[1]))
    slope = covariance if by_determinant else covariance @ covariance
    score = np.array([np.trace(slope @ i) for i in information(cov)])
    value = len(covariance) if by_determinant else np.trace(covariance)
    assert (score <= value * (1 + 1e-8)).all()
    assert score[weight > 0] == pytest.approx(value, rel=1e-8)


@criteria
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.floats(0, 4))
def test_two_against_a_bounded_search(by_determinant: bool, seed: int, d: int, decades: float):
    x, cov = drawn(seed, 2, d, decades)
    covariance = covariance_intersection(x, cov, by_determinant)[1]

    def value(share: float) -> float:
        return criterion(np.array([share, 1 - share]), cov, by_determinant)

    search = minimize_scalar(value, bounds=(0, 1), method="bounded", options={"xatol": 1e-9})
    best = min(search.fun, value(0.0), value(1.0))
    found = np.linalg.slogdet(covariance)[1] if by_determinant else np.trace(covariance)
    assert found == pytest.approx(best, rel=1e-8, abs=1e-8)


@criteria
@pytest.mark.parametrize("seed", range(6))
def test_three_against_a_grid(seed: int, by_determinant: bool):
    x, cov = drawn(seed, 3, 2, 1.5)
    steps = 100
    grid = [
        criterion(np.array([i, j, steps - i - j]) / steps, cov, by_determinant)
        for i in range(steps + 1)
        for j in range(steps + 1 - i)
    ]
    weight = covariance_intersection(x, cov, by_determinant)[2]
    found = criterion(weight, cov, by_determinant)
    assert found <= min(grid) + 1e-12
    assert found == pytest.approx(min(grid), abs=2e-3)


@criteria
@pytest.mark.parametrize(("seed", "n", "d"), [(147, 4, 2), (104, 6, 2), (34, 12, 2), (3, 5, 3), (7, 10, 3)])
def test_many_against_another_optimiser(seed: int, n: int, d: int, by_determinant: bool):
    # In most of these an input has to come back that had lost its weight on the way.
    x, cov = drawn(seed, n, d, 1.0)
    result = minimize(
        criterion,
        np.full(n, 1 / n),
        (cov, by_determinant),
        method="SLSQP",
        bounds=[(0, 1)] * n,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert result.success
    weight = covariance_intersection(x, cov, by_determinant)[2]
    assert criterion(weight, cov, by_determinant) == pytest.approx(result.fun, abs=1e-7)
    assert weight == pytest.approx(result.x, abs=1e-3)


@given(estimates(4))
def test_no_worse_than_the_best_input_nor_than_the_fast_formula(given_: Estimates):
    x, cov = given_
    trace = np.trace(covariance_intersection(x, cov, False)[1])
    kept = np.trace(fast_covariance_intersection(x, cov, True)[1])
    raw = np.trace(fast_covariance_intersection(x, cov, False)[1])
    best = np.trace(cov, axis1=1, axis2=2).min()
    assert trace <= kept * (1 + 1e-9)
    assert kept <= min(raw, best) * (1 + 1e-9)


@given(estimates(2, least=2))
def test_the_fast_formula_is_the_published_one(given_: Estimates):
    x, cov = given_
    infos = information(cov)
    det, total = np.linalg.det, infos.sum(axis=0)
    below = len(x) * det(total) + sum(det(i) - det(total - i) for i in infos)
    expected = [(det(total) - det(total - i) + det(i)) / below for i in infos]
    mean, covariance, weight = fast_covariance_intersection(x, cov, False)
    assert weight == pytest.approx(expected, rel=1e-7)
    assert mean == pytest.approx(fused(x, cov, weight)[0], abs=1e-8)
    assert covariance == pytest.approx(fused(x, cov, weight)[1], abs=1e-9 * np.trace(covariance))


# -------------------------------------------------------------------------- what is claimed


def actual(cov: Array, weight: Array, covariance: Array, joint: Array) -> Array:
    """Covariance of the fused error where those of the inputs are correlated as in `joint (n·d, n·d)`."""
    gain = np.hstack([w * covariance @ i for w, i in zip(weight, information(cov), strict=True)])
    return gain @ joint @ gain.T


def correlated(seed: int, cov: Array, sources: int) -> Array:
    """A joint covariance with these blocks, errors from few common sources."""
    n, d = cov.shape[:2]
    raw = np.random.default_rng(seed).normal(size=(n, d, max(sources, d)))
    rows = []
    for k in range(n):
        white = np.linalg.solve(np.linalg.cholesky(raw[k] @ raw[k].T), raw[k])
        rows.append(np.linalg.cholesky(cov[k]) @ white)
    stacked = np.vstack(rows)
    return stacked @ stacked.T


@given(estimates(2, most=8), st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_intersection_is_never_too_sure_however_errors_are_correlated(given_: Estimates, seed: int, sources: int):
    x, cov = given_
    joint = correlated(seed, cov, sources)
    for _, covariance, weight in (
        covariance_intersection(x, cov, False),
        covariance_intersection(x, cov, True),
        fast_covariance_intersection(x, cov, False),
        fast_covariance_intersection(x, cov, True),
    ):
        excess = covariance - actual(cov, weight, covariance, joint)
        assert np.linalg.eigvalsh(excess).min() >= -1e-9 * np.trace(covariance)


def test_inverse_variance_is_as_sure_as_it_may_be_if_errors_are_independent_and_too_sure_if_not():
    cov = np.tile(np.eye(1), (2, 1, 1))
    covariance = inverse_variance(np.zeros((2, 1)), cov)[1]
    assert covariance[0, 0] == pytest.approx(0.5, rel=1e-15)
    assert actual(cov, np.ones(2), covariance, np.eye(2))[0, 0] == pytest.approx(0.5, rel=1e-15)
    # With a correlation of 0.9: (1 + 1 + 2 · 0.9) / 4.
    assert actual(cov, np.ones(2), covariance, np.array([[1, 0.9], [0.9, 1]]))[0, 0] == pytest.approx(0.95)


# ------------------------------------------------------------------------------- how it is called


@nb.njit
def of_the_first(x: Array, cov: Array, n: int) -> tuple[Array, Array, Array]:
    one = inverse_variance(x[:n], cov[:n])
    two = covariance_intersection(x[:n], cov[:n], True)
    three = fast_covariance_intersection(x[:n], cov[:n], True)
    return one[0], two[0], three[0]


def test_from_other_kernels_with_the_filled_part_of_larger_arrays():
    x, cov = drawn(1, 3, 2, 1.0)
    wide_x, wide_cov = np.full((9, 2), np.nan), np.full((9, 2, 2), np.nan)
    wide_x[:3], wide_cov[:3] = x, cov
    found = of_the_first(wide_x, wide_cov, 3)
    assert (found[0] == inverse_variance(x, cov)[0]).all()
    assert (found[1] == covariance_intersection(x, cov, True)[0]).all()
    assert (found[2] == fast_covariance_intersection(x, cov, True)[0]).all()
    # Not contiguous either.
    strided_x, strided_cov = wide_x[::-2], wide_cov[::-2]
    strided_x[:3], strided_cov[:3] = x, cov
    assert (inverse_variance(strided_x[:3], strided_cov[:3])[0] == found[0]).all()


def test_what_goes_in_stays_and_what_comes_out_is_new():
    x, cov = drawn(1, 3, 2, 1.0)
    before = x.copy(), cov.copy()
    for mean, covariance in all_methods(x, cov) + all_methods(x[:1], cov[:1]):
        mean[:] = covariance[:] = np.nan
    assert (x == before[0]).all()
    assert (cov == before[1]).all()
