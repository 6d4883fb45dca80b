"""GOSPA and OSPA against published values, every pairing there is, SciPy, and as metrics."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from copem_replay.metrics.gospa import gospa, gospa_pairs, gospas_m, ospa

Points = npt.NDArray[np.float64]

NOBODY = np.empty((0, 2))
powers = st.sampled_from([1.0, 1.5, 2.0, 3.0])
cutoffs = st.sampled_from([0.5, 2.0, 5.0, 20.0])
coordinates = st.integers(-16, 16).map(lambda quarters: quarters / 4)  # so that points coincide and tie


def point_sets(most: int) -> st.SearchStrategy[Points]:
    points = st.lists(st.tuples(coordinates, coordinates), max_size=most)
    return points.map(lambda chosen: np.array(chosen, dtype=float).reshape(-1, 2))


def pairings(n: int, m: int) -> list[list[tuple[int, int]]]:
    """Every set of pairs of n and m, none twice."""
    return [
        list(zip(some, others, strict=True))
        for k in range(min(n, m) + 1)
        for some in itertools.combinations(range(n), k)
        for others in itertools.permutations(range(m), k)
    ]


def gospa_of_all(truth: Points, estimates: Points, c: float, p: float) -> float:
    """The definition with α = 2: the least over all pairings."""
    n, m = len(truth), len(estimates)
    return min(
        sum(math.dist(truth[i], estimates[j]) ** p for i, j in pairs) + c**p / 2 * (n + m - 2 * len(pairs))
        for pairs in pairings(n, m)
    ) ** (1 / p)


def ospa_of_all(truth: Points, estimates: Points, c: float, p: float) -> float:
    """The definition: the shorter list with every choice of as many of the longer, distances cut off at c."""
    short, long = sorted((truth, estimates), key=len)
    if len(long) == 0:
        return 0.0
    least = min(
        sum(min(math.dist(a, b), c) ** p for a, b in zip(short, chosen, strict=True))
        for chosen in itertools.permutations(long, len(short))
    )
    return ((least + c**p * (len(long) - len(short))) / len(long)) ** (1 / p)


def by_scipy(truth: Points, estimates: Points, c: float, p: float) -> tuple[float, float, list[int]]:
    """GOSPA, OSPA and the partners: of distances cut off at c, c itself standing for no pair."""
    distance = np.minimum(np.hypot(*(truth[:, None] - estimates).transpose(2, 0, 1)), c)
    row, col = linear_sum_assignment(distance**p)
    least, (n, m) = float((distance[row, col] ** p).sum()), distance.shape
    partner = np.full(n, -1)
    paired = distance[row, col] < c
    partner[row[paired]] = col[paired]
    with_surplus = (least + c**p / 2 * abs(n - m)) ** (1 / p)
    return with_surplus, ((least + c**p * abs(n - m)) / max(n, m)) ** (1 / p), partner.tolist()


# --------------------------------------------------------------------------------- known values

FIVE = np.array([[0.0, 3.0 * k] for k in range(5)])


def east(points: Points, offset_m: float) -> Points:
    return points + np.array([offset_m, 0.0])


@pytest.mark.parametrize(("offset_m", "expected"), [(0.5, 2.5), (1.0, 5.0)])
def test_gospa_of_power_one_sums_distances(offset_m: float, expected: float):
    estimates = east(FIVE, offset_m)
    assert gospa(FIVE, estimates, cutoff_m=10.0, power=1.0).value_m == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("power", [1.0, 2.0])
@pytest.mark.parametrize("offset_m", [0.5, 0.2])
def test_ospa_of_one_offset_is_the_offset(offset_m: float, power: float):
    estimates = east(FIVE[::-1], offset_m)
    assert ospa(FIVE, estimates, cutoff_m=10.0, power=power) == pytest.approx(offset_m, abs=1e-12)


@pytest.mark.parametrize(
    ("power", "offset_m", "expected"),
    [
        (1.0, 0.5, 2.4),
        (1.0, 0.2, 2.16),
        (2.0, 0.5, 4.49444),
        (2.0, 0.2, 4.47571),
    ],
)
def test_ospa_of_four_for_five(power: float, offset_m: float, expected: float):
    estimates = east(FIVE[:4], offset_m)
    assert ospa(FIVE, estimates, cutoff_m=10.0, power=power) == pytest.approx(expected, abs=5e-6)
    assert ospa(estimates, FIVE, cutoff_m=10.0, power=power) == pytest.approx(expected, abs=5e-6)


def test_one_missed_one_false_two_somewhat_off():
    truth = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    estimates = np.array([[40.0, 0.0], [0.0, 1.0], [10.5, 0.0]])
    result = gospa(truth, estimates, cutoff_m=5.0, power=2.0)
    assert result.value_m == pytest.approx(5.123475, abs=5e-7)
    assert (result.localisation, result.missed, result.false) == (1.25, 12.5, 12.5)
    assert (result.missed_count, result.false_count) == (1, 1)
    assert result.partner.tolist() == [1, 2, -1]
    assert ospa(truth, estimates, cutoff_m=5.0, power=2.0) == pytest.approx(2.958040, abs=5e-7)


def test_a_nearest_partner_is_given_up_for_a_better_whole():
    # 1 m and then 3 m away would be 1 + 9; 2 m and 0 m are better.
    truth, estimates = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[1.0, 0.0], [-2.0, 0.0]])
    assert gospa(truth, estimates, cutoff_m=9.0, power=2.0).partner.tolist() == [1, 0]


@pytest.mark.parametrize("power", [1.0, 2.0, 3.0])
def test_at_the_cut_off_there_is_no_pair_any_more(power: float):
    origin = np.array([[0.0, 0.0]])
    for distance_m, partner in ((4.999, 0), (5.0, -1), (5.001, -1)):
        result = gospa(origin, np.array([[0.0, distance_m]]), cutoff_m=5.0, power=power)
        assert result.partner.tolist() == [partner]
        assert result.missed_count == result.false_count == -partner
        assert result.value_m == pytest.approx(min(distance_m, 5.0), abs=1e-12)


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_of_empty_lists(power: float):
    assert ospa(NOBODY, NOBODY, cutoff_m=5.0, power=power) == 0.0
    assert ospa(FIVE, NOBODY, cutoff_m=5.0, power=power) == pytest.approx(5.0, abs=1e-12)
    assert ospa(NOBODY, FIVE, cutoff_m=5.0, power=power) == pytest.approx(5.0, abs=1e-12)
    nothing = gospa(NOBODY, NOBODY, cutoff_m=5.0, power=power)
    assert (nothing.value_m, nothing.missed_count, nothing.false_count, len(nothing.partner)) == (0.0, 0, 0, 0)
    missed = gospa(FIVE, NOBODY, cutoff_m=5.0, power=power)
    assert missed.value_m == pytest.approx((5 * 5.0**power / 2) ** (1 / power))
    assert (missed.missed_count, missed.false_count, missed.partner.tolist()) == (5, 0, [-1] * 5)
    false = gospa(NOBODY, FIVE, cutoff_m=5.0, power=power)
    assert (false.value_m, false.missed, false.missed_count, false.false_count) == (missed.value_m, 0.0, 0, 5)


# ---------------------------------------------------------------------------------- by definition


@given(point_sets(4), point_sets(4), cutoffs, powers)
def test_no_pairing_is_better(truth: Points, estimates: Points, c: float, p: float):
    assert gospa(truth, estimates, cutoff_m=c, power=p).value_m == pytest.approx(gospa_of_all(truth, estimates, c, p))


@given(point_sets(4), point_sets(4), cutoffs, powers)
def test_ospa_is_what_its_definition_says(truth: Points, estimates: Points, c: float, p: float):
    assert ospa(truth, estimates, cutoff_m=c, power=p) == pytest.approx(ospa_of_all(truth, estimates, c, p))


@given(point_sets(6), point_sets(6), cutoffs, powers)
def test_the_parts_are_those_of_the_pairs_and_sum_up(truth: Points, estimates: Points, c: float, p: float):
    result = gospa(truth, estimates, cutoff_m=c, power=p)
    pairs = [(i, j) for i, j in enumerate(result.partner.tolist()) if j >= 0]
    assert len({j for _, j in pairs}) == len(pairs)
    distances = [math.dist(truth[i], estimates[j]) for i, j in pairs]
    assert all(d < c for d in distances)
    assert result.localisation == pytest.approx(sum(d**p for d in distances))
    assert result.missed_count == len(truth) - len(pairs)
    assert result.false_count == len(estimates) - len(pairs)
    assert result.missed == pytest.approx(c**p / 2 * result.missed_count)
    assert result.false == pytest.approx(c**p / 2 * result.false_count)
    assert result.value_m**p == pytest.approx(result.localisation + result.missed + result.false)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("power", [1.0, 2.0, 2.5])
def test_of_many_points_it_is_what_scipy_finds(seed: int, power: float):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 60, 2)
    truth, estimates = rng.uniform(0.0, 30.0, (n, 2)), rng.uniform(0.0, 30.0, (m, 2))
    expected, expected_ospa, partner = by_scipy(truth, estimates, 5.0, power)
    result = gospa(truth, estimates, cutoff_m=5.0, power=power)
    assert result.value_m == pytest.approx(expected, rel=1e-12)
    assert result.partner.tolist() == partner
    assert ospa(truth, estimates, cutoff_m=5.0, power=power) == pytest.approx(expected_ospa, rel=1e-12)


def test_the_kernel_says_what_the_function_says():
    rng = np.random.default_rng(5)
    truth, estimates = rng.uniform(0.0, 30.0, (15, 2)), rng.uniform(0.0, 30.0, (17, 2))
    expected = gospa(truth, estimates, cutoff_m=5.0, power=2.0)
    partner = np.full(15, 99)
    columns = [np.ascontiguousarray(column) for column in (*truth.T, *estimates.T)]
    localisation, pairs = gospa_pairs(*columns, 5.0, 2.0, partner)
    assert (localisation, pairs) == (expected.localisation, 15 - expected.missed_count)
    assert partner.tolist() == expected.partner.tolist()


def test_for_the_kernel_nan_is_near_to_nothing():
    partner = np.full(2, 99)
    x, nan = np.array([0.0, 1.0]), np.array([0.0, math.nan])
    assert gospa_pairs(x, nan, x, x * 0, 5.0, 2.0, partner) == (0.0, 1)
    assert partner.tolist() == [0, -1]


# --------------------------------------------------------------------------------------- a metric


def values(truth: Points, estimates: Points, c: float, p: float) -> list[float]:
    """Both metrics."""
    return [
        gospa(truth, estimates, cutoff_m=c, power=p).value_m,
        ospa(truth, estimates, cutoff_m=c, power=p),
    ]


@given(point_sets(6), cutoffs, powers, st.randoms(use_true_random=False))
def test_a_list_in_another_order_is_the_same_list(points: Points, c: float, p: float, random: np.random.Generator):
    order = list(range(len(points)))
    random.shuffle(order)
    assert values(points, points[order], c, p) == [0.0, 0.0]


@given(point_sets(5), point_sets(5), cutoffs, powers)
def test_different_lists_are_apart(first: Points, second: Points, c: float, p: float):
    same = sorted(map(tuple, first)) == sorted(map(tuple, second))
    assert [value == 0.0 for value in values(first, second, c, p)] == [same] * 2


@given(point_sets(8), point_sets(8), cutoffs, powers)
def test_truth_and_believed_exchanged_are_as_far_apart(first: Points, second: Points, c: float, p: float):
    there, back = (gospa(*lists, cutoff_m=c, power=p) for lists in ((first, second), (second, first)))
    assert (there.missed, there.missed_count) == pytest.approx((back.false, back.false_count))
    assert values(first, second, c, p) == pytest.approx(values(second, first, c, p))


@given(point_sets(6), point_sets(6), point_sets(6), cutoffs, powers)
def test_by_way_of_a_third_list_it_is_no_shorter(first: Points, second: Points, third: Points, c: float, p: float):
    direct, to, onward = values(first, third, c, p), values(first, second, c, p), values(second, third, c, p)
    assert all(d <= a + b + 1e-9 for d, a, b in zip(direct, to, onward, strict=True))


@given(point_sets(6), point_sets(6), cutoffs, powers, st.sampled_from([0.1, 3.0, 1000.0]))
def test_in_other_units_it_is_the_same_distance(first: Points, second: Points, c: float, p: float, scale: float):
    scaled = [value * scale for value in values(first, second, c, p)]
    assert values(first * scale, second * scale, c * scale, p) == pytest.approx(scaled, rel=1e-9, abs=1e-9)


# --------------------------------------------------------------------------- what is not accepted


@pytest.mark.parametrize("metric", [gospa, ospa])
@pytest.mark.parametrize(
    ("points", "cutoff_m", "power", "reason"),
    [
        (np.zeros(4), 5.0, 2.0, r"expected points \(n, 2\), found shape \(4,\)"),
        (np.zeros((4, 3)), 5.0, 2.0, r"found shape \(4, 3\)"),
        (np.array([[0.0, math.nan]]), 5.0, 2.0, "finite positions"),
        (np.array([[0.0, math.inf]]), 5.0, 2.0, "finite positions"),
        (FIVE, 0.0, 2.0, "cutoff_m: expected a distance above 0, found 0.0"),
        (FIVE, math.inf, 2.0, "cutoff_m"),
        (FIVE, math.nan, 2.0, "cutoff_m"),
        (FIVE, 5.0, 0.99, "power: expected a finite number of at least 1, found 0.99"),
        (FIVE, 5.0, math.nan, "power"),
        (FIVE, 5.0, 1e4, "found inf"),
        (FIVE, 0.5, 1e4, "found 0.0"),
    ],
)
def test_a_defect_of_the_caller_is_said(
    metric: Callable[..., object], points: Points, cutoff_m: float, power: float, reason: str
):
    for lists in ((points, FIVE), (FIVE, points)):
        with pytest.raises(ValueError, match=reason):
            metric(*lists, cutoff_m=cutoff_m, power=power)


def test_gospa_has_no_infinite_power():
    with pytest.raises(ValueError, match="power"):
        gospa(FIVE, FIVE, cutoff_m=5.0, power=math.inf)


@given(st.lists(st.tuples(point_sets(4), point_sets(4)), max_size=6), cutoffs, powers)
def test_of_many_lists_each_is_that_of_its_own(lists: list[tuple[Points, Points]], c: float, p: float):
    both = [np.concatenate([NOBODY, *(pair[side] for pair in lists)]).T for side in (0, 1)]
    starts = [np.cumsum([0, *(len(pair[side]) for pair in lists)]) for side in (0, 1)]
    found = gospas_m(both[0], starts[0], both[1], starts[1], c, p)
    assert found == pytest.approx([gospa(*pair, cutoff_m=c, power=p).value_m for pair in lists], rel=1e-14)
