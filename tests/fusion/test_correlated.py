"""Estimates whose errors hang together: published vectors, limits, plainly written oracles, and what may not matter."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from copem_replay.fusion.combine import combine_by_cross_covariance, covariance_union, inverse_covariance_intersection
from copem_replay.fusion.covariance import covariance_intersection, inverse_variance
from copem_replay.fusion.split_intersection import split_by_share, split_by_variance, split_covariance_intersection
from tests.oracles import correlated as oracle

# As kernels call them:
(
    combine_by_cross_covariance,
    covariance_intersection,
    covariance_union,
    inverse_covariance_intersection,
    inverse_variance,
    split_by_share,
    split_by_variance,
    split_covariance_intersection,
) = map(
    njit,
    (
        combine_by_cross_covariance,
        covariance_intersection,
        covariance_union,
        inverse_covariance_intersection,
        inverse_variance,
        split_by_share,
        split_by_variance,
        split_covariance_intersection,
    ),
)

Array = npt.NDArray[np.float64]

CARMA = np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([np.diag([4.0, 5, 6]), np.diag([7.0, 8, 9])])
CROSSED = np.array([[0.0, 0], [1, 1]]), np.array([np.diag([4.0, 1]), np.diag([1.0, 4])])
OBLIQUE = np.array([[1.0, 0], [0, 1]]), np.array([np.diag([1, 0.1]), [[0.2, 0.05], [0.05, 0.6]]])

criteria = pytest.mark.parametrize("by_determinant", [False, True], ids=["trace", "determinant"])


def drawn(seed: int, n: int, d: int = 2, decades: float = 1.5) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    cov = np.empty((n, d, d))
    for k in range(n):
        axes = np.linalg.qr(rng.normal(size=(d, d)))[0]
        made = axes @ np.diag(10 ** rng.uniform(-decades / 2, decades / 2, d)) @ axes.T
        cov[k] = (made + made.T) / 2
    return rng.normal(size=(n, d)) * 3, cov


def rotation(angle_rad: float) -> Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def split(x: Array, cov: Array, share: float, by_determinant: bool = False) -> tuple[Array, Array, Array, Array]:
    return split_covariance_intersection(x, *split_by_share(cov, share), by_determinant)


seeds = st.integers(0, 2**32 - 1)
several = st.builds(drawn, seeds, st.integers(2, 7))
pairs = st.builds(drawn, seeds, st.just(2))


def all_methods(x: Array, cov: Array) -> list[tuple[Array, Array]]:
    return [
        inverse_covariance_intersection(x, cov, False),
        inverse_covariance_intersection(x, cov, True),
        split(x, cov, 0.3)[:2],
        split(x, cov, 0.8, True)[:2],
        split_covariance_intersection(x, *split_by_variance(cov, 0.3), False)[:2],
        combine_by_cross_covariance(x, cov, 0.4),
    ]


# ------------------------------------------------------------------------------------------------ vectors


def test_inverse_intersection_of_two_oblique_estimates():
    mean, P = inverse_covariance_intersection(*OBLIQUE, False)
    assert mean == pytest.approx([-0.05503, 0.04889], abs=1e-5)
    assert pytest.approx(np.array([[0.216343, 0.008481], [0.008481, 0.120019]]), abs=1e-6) == P
    # From above, covariance intersection; from below, inverse variance.
    assert np.trace(covariance_intersection(*OBLIQUE, False)[1]) == pytest.approx(0.48968, abs=1e-5)
    assert np.trace(P) == pytest.approx(0.33636, abs=1e-5)
    assert np.trace(inverse_variance(*OBLIQUE)[1]) == pytest.approx(0.24985, abs=1e-5)


@criteria
def test_inverse_intersection_of_crossed_ones(by_determinant: bool):
    mean, P = inverse_covariance_intersection(*CROSSED, by_determinant)
    assert mean == pytest.approx([0.941176, 0.058824], abs=1e-6)
    assert pytest.approx(1.176471 * np.eye(2), abs=1e-6) == P


@criteria
@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_inverse_intersection_leaves_one_that_is_better_in_all_as_it_is(order: list[int], by_determinant: bool):
    x, cov = CARMA
    mean, P = inverse_covariance_intersection(x[order], cov[order], by_determinant)
    assert mean.tolist() == x[0].tolist()
    assert P.tolist() == cov[0].tolist()


def test_split_of_the_demonstration_of_its_filter():
    # Demonstration 1 of SplitCIF: three dimensions, by determinant.
    independent = np.array([[4.0, 0, 1], [0, 4, 0], [1, 0, 4]])
    x, common = np.array([[2.0, 2, 1], [-4, -4, -2]]), 4 * np.eye(3)
    mean, P, own, weight = split_covariance_intersection(
        x, np.array([common, common]), np.array([independent, 2 * independent]), True
    )
    assert weight == pytest.approx([2 / 3, 1 / 3], abs=1e-9)
    assert mean == pytest.approx(np.zeros(3), abs=1e-9)
    assert own == pytest.approx(np.array([[8, 0, 2], [0, 8, 0], [2, 0, 8]]) / 3, abs=1e-9)
    assert P - own == pytest.approx(4 * np.eye(3), abs=1e-9)


@criteria
def test_split_of_crossed_ones_half_of_which_is_common(by_determinant: bool):
    mean, P, own, weight = split(*CROSSED, 0.5, by_determinant)
    assert weight == pytest.approx([0.5, 0.5], abs=1e-9)
    assert mean == pytest.approx([0.8, 0.2], abs=1e-9)
    assert pytest.approx(1.2 * np.eye(2), abs=1e-9) == P
    assert own == pytest.approx(0.4 * np.eye(2), abs=1e-9)


def test_cross_covariance_of_crossed_ones():
    mean, P = combine_by_cross_covariance(*CROSSED, 0.4)
    assert mean == pytest.approx([0.941176, 0.058824], abs=1e-6)
    assert pytest.approx(0.988235 * np.eye(2), abs=1e-6) == P


def test_one_position_stays_as_it_is_by_cross_covariance():
    x, cov = np.array([[3.0, -4.0]]), np.array([[[2.0, 0.5], [0.5, 1.0]]])
    mean, P = combine_by_cross_covariance(x, cov, 0.4)
    assert mean.tolist() == [3.0, -4.0]
    assert P.tolist() == cov[0].tolist()


@pytest.mark.parametrize("n", [2, 3, 20])
def test_equal_circles_by_cross_covariance(n: int):
    # The mean of n unit variances correlated by ρ has (1 + (n − 1)ρ)/n.
    x = np.stack([np.arange(n), np.zeros(n)], axis=1).astype(float)
    mean, P = combine_by_cross_covariance(x, np.array([np.eye(2)] * n), 0.9)
    assert mean == pytest.approx([(n - 1) / 2, 0])
    assert pytest.approx((1 + (n - 1) * 0.9) / n * np.eye(2)) == P


@pytest.mark.parametrize(
    ("a", "A", "b", "B", "mean", "covariance"),
    [
        # Alike and 4 m apart: in the middle, 2² more along, none across.
        ((0, 0), (1, 0, 1), (4, 0), (1, 0, 1), (2, 0), (5, 0, 1)),
        ((0, 0), (1, 0, 1), (0, -4), (1, 0, 1), (0, -2), (1, 0, 5)),
        # One so vague that it covers the other: as it is.
        ((0, 0), (1, 0, 1), (2, 0), (9, 0.5, 3), (2, 0), (9, 0.5, 3)),
        ((2, 0), (9, 0.5, 3), (0, 0), (1, 0, 1), (2, 0), (9, 0.5, 3)),
        # In one place: the larger of both on each axis.
        ((1, 1), (4, 0, 1), (1, 1), (1, 0, 9), (1, 1), (4, 0, 9)),
        # On a line, 1 and 4 m², 3 m apart: 1 + u² = 4 + (3 − u)² at u = 2.
        ((0, 0), (1, 0, 1), (3, 0), (4, 0, 1), (2, 0), (5, 0, 1)),
    ],
)  # fmt: skip
def test_covariance_union_by_hand(a: Any, A: Any, b: Any, B: Any, mean: Any, covariance: Any):
    def full(c: Any) -> Array:
        return np.array([[c[0], c[1]], [c[1], c[2]]], dtype=float)

    found = covariance_union(np.array(a, dtype=float), full(A), np.array(b, dtype=float), full(B))
    assert found[0] == pytest.approx(mean, abs=1e-9)
    assert found[1] == pytest.approx(full(covariance), abs=1e-9)


def test_covariance_union_of_two_that_are_turned():
    """The least trace there is, found by a search on a grid of a millimetre: 8.53338 m²."""
    a, A = np.zeros(2), np.diag([4.0, 1.0])
    b, B = np.array([2.0, 0.0]), np.array([[2.0, 1.5], [1.5, 4.0]])
    assert np.trace(covariance_union(a, A, b, B)[1]) == pytest.approx(8.53338, abs=2e-5)


# ------------------------------------------------------------------------------------------------ limits


@criteria
@given(several)
def test_nothing_dependent_is_inverse_variance(by_determinant: bool, given_: tuple[Array, Array]):
    x, cov = given_
    mean, P, own, _ = split(x, cov, 0.0, by_determinant)
    expected = inverse_variance(x, cov)
    assert mean == pytest.approx(expected[0], rel=1e-9, abs=1e-9)
    assert pytest.approx(expected[1], rel=1e-9, abs=1e-12) == P
    assert own == pytest.approx(P, rel=1e-9, abs=1e-12)


@criteria
@given(several)
def test_all_dependent_is_covariance_intersection(by_determinant: bool, given_: tuple[Array, Array]):
    x, cov = given_
    mean, P, own, _ = split(x, cov, 1.0, by_determinant)
    expected = covariance_intersection(x, cov, by_determinant)
    assert oracle.size(P, by_determinant) == pytest.approx(oracle.size(expected[1], by_determinant), rel=1e-8, abs=1e-8)
    assert mean == pytest.approx(expected[0], rel=1e-3, abs=1e-3)
    assert not own.any()


@given(several)
def test_no_correlation_is_inverse_variance(given_: tuple[Array, Array]):
    x, cov = given_
    mean, P = combine_by_cross_covariance(x, cov, 0.0)
    expected = inverse_variance(x, cov)
    assert mean == pytest.approx(expected[0], rel=1e-9, abs=1e-9)
    assert pytest.approx(expected[1], rel=1e-9, abs=1e-12) == P


@given(pairs)
def test_inverse_intersection_lies_between_inverse_variance_and_intersection(given_: tuple[Array, Array]):
    P = inverse_covariance_intersection(*given_, False)[1]
    assert np.trace(P) <= np.trace(covariance_intersection(*given_, False)[1]) * (1 + 1e-9)
    assert np.linalg.eigvalsh(P - inverse_variance(*given_)[1]).min() >= -1e-9 * np.trace(P)


@criteria
@given(several, st.floats(0.01, 0.99))
def test_more_that_hangs_together_never_makes_surer(by_determinant: bool, given_: tuple[Array, Array], share: float):
    found = [oracle.size(split(*given_, one, by_determinant)[1], by_determinant) for one in (share, share / 2)]
    assert found[0] >= found[1] - 1e-9 * abs(found[1])


@pytest.mark.parametrize("n", [2, 3, 7])
def test_equal_inputs_count_alike(n: int):
    x, one = np.stack([np.arange(n) ** 2, -np.arange(n)], axis=1).astype(float), np.array([[2.0, 0.9], [0.9, 0.5]])
    cov = np.array([one] * n)
    for mean, _ in all_methods(x, cov):
        assert mean == pytest.approx(x.mean(axis=0), abs=1e-6)
    assert inverse_covariance_intersection(x, cov, False)[1] == pytest.approx(one, rel=1e-9)
    assert split(x, cov, 0.4)[1] == pytest.approx((0.4 + 0.6 / n) * one, rel=1e-9)


@pytest.mark.parametrize("variance", [0.0, 0.05, 0.5, 0.7, 5.0])
def test_the_dependent_part_is_a_circle_or_all_there_is(variance: float):
    cov = np.array([rotation(0.6) @ np.diag([2.0, 0.2]) @ rotation(0.6).T, 0.5 * np.eye(2)])
    dependent, independent = split_by_variance(cov, variance)
    expected = rotation(0.6) @ np.diag([min(variance, 2.0), min(variance, 0.2)]) @ rotation(0.6).T
    assert dependent[0] == pytest.approx(expected, abs=1e-12)
    assert dependent[1] == pytest.approx(min(variance, 0.5) * np.eye(2), abs=1e-12)
    assert dependent + independent == pytest.approx(cov, abs=1e-12)
    assert np.linalg.eigvalsh(independent).min() >= -1e-12


# ------------------------------------------------------------------------------------------------ oracles


@criteria
@given(st.builds(drawn, seeds, st.integers(1, 4), st.integers(1, 3)))
def test_inverse_intersection_is_the_one_written_out(by_determinant: bool, given_: tuple[Array, Array]):
    mean, P = inverse_covariance_intersection(*given_, by_determinant)
    expected = oracle.inverse_intersection(*given_, by_determinant)
    assert oracle.size(P, by_determinant) == pytest.approx(oracle.size(expected[1], by_determinant), rel=1e-7, abs=1e-7)
    assert mean == pytest.approx(expected[0], rel=1e-3, abs=1e-3)


@criteria
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_split_is_the_one_written_out(seed: int, n: int, by_determinant: bool):
    x, dependent = drawn(seed, n, 2 + seed % 2)
    independent = drawn(100 + seed, n, 2 + seed % 2)[1]
    mean, P, own, weight = split_covariance_intersection(x, dependent, independent, by_determinant)
    expected = oracle.split_intersection(x, dependent, independent, by_determinant)
    assert oracle.size(P, by_determinant) <= oracle.size(expected[1], by_determinant) + 1e-9
    assert pytest.approx(expected[1], rel=1e-3, abs=1e-3) == P
    assert mean == pytest.approx(expected[0], rel=1e-3, abs=1e-3)
    assert weight.sum() == pytest.approx(1)
    assert (weight >= 0).all()
    # The independent part, by its definition.
    gains = [
        P @ np.linalg.inv(D / w + N) if w > 0 else 0 * D for D, N, w in zip(dependent, independent, weight, strict=True)
    ]
    assert own == pytest.approx(sum(K @ N @ K.T for K, N in zip(gains, independent, strict=True)), rel=1e-6, abs=1e-9)
    assert np.linalg.eigvalsh(P - own).min() >= -1e-9 * np.trace(P)


@given(several, st.floats(0, 0.99))
def test_cross_covariance_is_the_best_linear_estimate(given_: tuple[Array, Array], correlation: float):
    mean, P = combine_by_cross_covariance(*given_, correlation)
    expected = oracle.by_correlation(*given_, correlation)
    assert mean == pytest.approx(expected[0], rel=1e-6, abs=1e-6)
    assert pytest.approx(expected[1], rel=1e-6, abs=1e-9) == P


@given(pairs, st.floats(0, 0.95))
def test_of_two_cross_covariance_is_bar_shaloms_and_campos(given_: tuple[Array, Array], correlation: float):
    (a, b), (A, B) = given_
    C = correlation * np.real(oracle.sqrtm(A)) @ np.real(oracle.sqrtm(B))
    K = (A - C) @ np.linalg.inv(A + B - C - C.T)
    mean, P = combine_by_cross_covariance(*given_, correlation)
    assert mean == pytest.approx(a + K @ (b - a), rel=1e-6, abs=1e-6)
    assert pytest.approx(A - K @ (A - C).T, rel=1e-6, abs=1e-9) == P


@settings(max_examples=25)  # for each the oracle searches for the least trace
@given(pairs, st.floats(0, 3))
def test_covariance_union_covers_both_and_no_trace_is_less(given_: tuple[Array, Array], scale: float):
    (a, b), (A, B) = given_
    b = a + scale * (b - a)
    mean, P = covariance_union(a, A, b, B)
    for place, cov in ((a, A), (b, B)):
        needed = cov + np.outer(mean - place, mean - place)
        assert np.linalg.eigvalsh(P - needed).min() >= -1e-9 * np.trace(P)
    assert np.trace(P) == pytest.approx(oracle.union_at_least(a, A, b, B), rel=1e-6)
    turned = covariance_union(b, B, a, A)
    assert turned[0] == pytest.approx(mean, abs=1e-6)
    assert turned[1] == pytest.approx(P, abs=1e-6 * np.trace(P))


# ------------------------------------------------------------------------------------------------ what they are for


@criteria
@given(several, seeds, st.floats(0.05, 0.95))
def test_split_is_never_too_sure_however_the_dependent_parts_are_correlated(
    by_determinant: bool, given_: tuple[Array, Array], seed: int, share: float
):
    x, cov = given_
    P, weight = split(x, cov, share, by_determinant)[1::2]
    dependent, independent = split_by_share(cov, share)
    rng, n = np.random.default_rng(seed), len(x)
    # Errors of few sources, each input's dependent part of its stated covariance.
    mixing = np.linalg.qr(rng.normal(size=(n, 2, 2)))[0]
    roots = np.concatenate([np.linalg.cholesky(D) @ Q for D, Q in zip(dependent, mixing, strict=True)])
    joint = roots @ roots.T + oracle.block_diag(*independent)
    gains = [
        P @ np.linalg.inv(D / w + N) if w > 0 else 0 * D for D, N, w in zip(dependent, independent, weight, strict=True)
    ]
    gain = np.concatenate(gains, axis=1)
    assert np.linalg.eigvalsh(P - gain @ joint @ gain.T).min() >= -1e-8 * np.trace(P)


def test_inverse_intersection_is_honest_where_both_know_the_same_prior_and_inverse_variance_is_not():
    # A prior of 1 m² and a measurement each, of (0.2, 3) and (3, 0.2) m²: what is known of both is the prior.
    prior, own = np.eye(2), (np.diag([0.2, 3.0]), np.diag([3.0, 0.2]))
    cov = np.array([np.linalg.inv(np.linalg.inv(prior) + np.linalg.inv(one)) for one in own])
    A, B = cov
    G = A @ B  # cov(a, b) = A prior⁻¹ B
    joint = np.block([[A, G], [G.T, B]])
    zero = np.zeros((2, 2))
    for method, honest in ((lambda x: inverse_covariance_intersection(x, cov, False), True),
                           (lambda x: inverse_variance(x, cov), False)):  # fmt: skip
        P = method(zero)[1]
        gain = np.stack([method(np.eye(4)[k].reshape(2, 2))[0] for k in range(4)], axis=1)
        actual = gain @ joint @ gain.T
        assert bool(np.linalg.eigvalsh(P - actual).min() >= -1e-9) == honest


# ------------------------------------------------------------------------------------------------ what may not matter


@given(several, st.floats(-math.pi, math.pi), st.floats(-8000, 8000))
def test_the_frame_of_reference_does_not_matter(given_: tuple[Array, Array], angle_rad: float, shift_m: float):
    x, cov = given_
    turn, shift = rotation(angle_rad), np.array([shift_m, -shift_m / 3])
    there = all_methods(x @ turn.T + shift, turn @ cov @ turn.T)
    for k, ((mean, P), (moved, turned)) in enumerate(zip(all_methods(x, cov), there, strict=True)):
        assert turned == pytest.approx(turn @ P @ turn.T, abs=1e-5 * np.trace(P)), k
        assert moved == pytest.approx(turn @ mean + shift, abs=1e-3), k


@given(several, st.randoms())
def test_the_order_does_not_matter_to_those_that_take_all_at_once(given_: tuple[Array, Array], random: Any):
    x, cov = given_
    order = list(range(len(x)))
    random.shuffle(order)
    for method in (lambda x, cov: split(x, cov, 0.4)[:2], lambda x, cov: combine_by_cross_covariance(x, cov, 0.4)):
        for one, other in zip(method(x, cov), method(x[order], cov[order]), strict=True):
            assert other == pytest.approx(one, rel=1e-4, abs=1e-4)


@given(st.builds(drawn, seeds, st.integers(1, 12), st.just(2), st.floats(0, 6)))
def test_covariances_are_symmetric_and_positive_definite(given_: tuple[Array, Array]):
    for mean, P in all_methods(*given_):
        assert np.isfinite(mean).all()
        assert pytest.approx(P.T, rel=1e-12) == P
        assert np.linalg.eigvalsh(P).min() > 0


def test_what_goes_in_stays():
    x, cov = drawn(3, 4)
    before = x.tobytes(), cov.tobytes()
    all_methods(x, cov)
    covariance_union(x[0], cov[0], x[1], cov[1])
    assert (x.tobytes(), cov.tobytes()) == before
