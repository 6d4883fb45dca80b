"""Optimal assignment against every assignment there is, against SciPy, and by hand."""

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from scipy.optimize import linear_sum_assignment

from copem_replay.core.assignment import assign, assign_pairs, spread_component_maximum
from tests.oracles.gnn import largest_around as largest_by_scipy

assign_pairs, spread_component_maximum = map(njit, (assign_pairs, spread_component_maximum))  # as kernels call them

Cost = npt.NDArray[np.float64]
NOT = np.inf


def partners(cost: Cost) -> list[int]:
    partner = np.full(len(cost), 99)
    assign(np.asarray(cost, dtype=np.float64), partner)
    return partner.tolist()


def partners_of_pairs(row: list[int], col: list[int], cost: list[float], n: int, m: int) -> list[int]:
    partner = np.full(n, 99)
    assign_pairs(
        np.array(row, dtype=np.int64), np.array(col, dtype=np.int64), np.array(cost, dtype=float), n, m, partner
    )
    return partner.tolist()


def total(cost: Cost, partner: list[int]) -> float:
    chosen = [j for j in partner if j >= 0]
    assert len(set(chosen)) == len(chosen), "a column is chosen twice"
    return sum(float(cost[i, j]) for i, j in enumerate(partner) if j >= 0)


def least(cost: Cost) -> float:
    """The least total of all assignments, tried one by one."""
    options = [[-1, *np.flatnonzero(row < np.inf)] for row in cost]
    totals = []
    for partner in itertools.product(*options):
        chosen = [j for j in partner if j >= 0]
        if len(set(chosen)) == len(chosen):
            totals.append(sum(cost[i, j] for i, j in enumerate(partner) if j >= 0))
    return float(min(totals))


def by_scipy(cost: Cost) -> list[int]:
    """Each row may take a column of its own, at cost 0, instead."""
    n, m = cost.shape
    own = np.full((n, n), np.inf)
    np.fill_diagonal(own, 0.0)
    _, col = linear_sum_assignment(np.hstack([cost, own]))
    return np.where(col < m, col, -1).tolist()


def near_pairs(rng: np.random.Generator, n: int, m: int, side_m: float, gate_m: float) -> Cost:
    """Two clouds of points: squared distance less that of the gate, where that is negative."""
    a, b = rng.uniform(0.0, side_m, (n, 2)), rng.uniform(0.0, side_m, (m, 2))
    squared = ((a[:, None] - b) ** 2).sum(axis=2)
    return np.where(squared < gate_m**2, squared - gate_m**2, np.inf)


# -------------------------------------------------------------------------------------- by hand


@pytest.mark.parametrize(
    ("cost", "expected"),
    [
        ([[-5.0, NOT], [NOT, -3.0]], [0, 1]),  # each other's only choice
        ([[-5.0, -4.0], [-4.0, NOT]], [1, 0]),  # the best pair is not in it: −8, not −5
        ([[-5.0, -1.0], [-2.0, NOT]], [0, -1]),  # one alone is better than both in pairs: −5, not −3
        ([[-2.0], [-5.0], [-3.0]], [-1, 0, -1]),  # the later row displaces the first
        ([[-2.0, -5.0, -3.0]], [1]),
        ([[-9.0, -8.0, NOT], [-9.0, -7.0, -1.0], [NOT, -9.0, NOT]], [0, 2, 1]),  # −19; with a row left alone −18
        ([[-9.5, -8.0, NOT], [-9.0, -7.0, NOT], [NOT, -9.0, NOT]], [0, -1, 1]),  # displaced, and back again
    ],
)
def test_small_ones(cost: list[list[float]], expected: list[int]):
    assert partners(np.array(cost)) == expected
    assert partners(np.array(cost).T) == [expected.index(i) if i in expected else -1 for i in range(len(cost[0]))]


def test_a_pair_that_is_no_better_than_nothing_is_not_chosen():
    assert partners(np.array([[0.0, 2.0], [NOT, np.nan]])) == [-1, -1]
    # Neither as a step to something better: with it the total would be −9 as well.
    assert partners(np.array([[-9.0, 0.0], [-9.0, NOT]])) == [0, -1]


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 3), (3, 0), (2, 2)])
def test_where_there_are_no_pairs_all_are_alone(n: int, m: int):
    assert partners(np.full((n, m), np.inf)) == [-1] * n
    assert partners_of_pairs([], [], [], n, m) == [-1] * n


def test_of_a_pair_given_twice_the_cheaper_counts():
    assert partners_of_pairs([0, 0], [0, 0], [-2.0, -7.0], 1, 1) == [0]
    # Row 0 is worth 7 to the column, row 1 only 5.
    assert partners_of_pairs([0, 1, 0], [0, 0, 0], [-2.0, -5.0, -7.0], 2, 1) == [0, -1]
    assert partners_of_pairs([0, 1, 0], [0, 0, 0], [-7.0, -5.0, -2.0], 2, 1) == [0, -1]
    assert partners_of_pairs([0, 1, 0], [0, 0, 0], [-2.0, -5.0, 3.0], 2, 1) == [-1, 0]


def test_ties_are_broken_by_index():
    assert partners(np.full((3, 3), -1.0)) == [0, 1, 2]
    assert partners(np.full((3, 1), -1.0)) == [0, -1, -1]
    assert partners(np.full((1, 3), -1.0)) == [0]
    assert partners(np.array([[-3.0, -2.0], [-1.0, NOT]])) == [0, -1]  # both in pairs: −3 as well
    assert partners(np.array([[-1.0, -1.0, NOT], [-1.0, NOT, -1.0]])) == [0, 2]  # a free column before the first
    assert partners_of_pairs([2, 0, 1], [0, 0, 0], [-1.0, -1.0, -1.0], 3, 1) == [0, -1, -1]
    assert partners_of_pairs([0, 0, 0], [2, 0, 1], [-1.0, -1.0, -1.0], 1, 3) == [0]


@pytest.mark.parametrize("length", [1, 2, 50])
def test_a_newcomer_may_shift_a_whole_row_of_pairs(length: int):
    # Row i may take column i or, a little worse, column i + 1; the last row may take column 0 only. To shift them all
    # costs less than to leave one alone.
    cost = np.full((length + 1, length + 1), np.inf)
    for i in range(length):
        cost[i, i], cost[i, i + 1] = -4.0, -3.96875
    cost[length, 0] = -4.0
    assert partners(cost) == [*range(1, length + 1), 0]


# ------------------------------------------------------------------- whole numbers: sums are exact

prices = st.sampled_from([np.inf, np.inf]) | st.integers(-6, 2).map(float)


@st.composite
def matrices(draw: st.DrawFn, most: int = 5) -> Cost:
    n, m = draw(st.integers(0, most)), draw(st.integers(0, most))
    return np.array(draw(st.lists(prices, min_size=n * m, max_size=n * m)), dtype=float).reshape(n, m)


@given(matrices(most=4))
def test_no_assignment_is_better(cost: Cost):
    assert total(cost, partners(cost)) == least(cost)


@given(matrices(most=12))
def test_the_total_is_that_of_scipy(cost: Cost):
    assert total(cost, partners(cost)) == total(cost, by_scipy(cost))


@given(matrices(most=8))
def test_only_pairs_better_than_nothing_are_chosen(cost: Cost):
    assert all(cost[i, j] < 0 for i, j in enumerate(partners(cost)) if j >= 0)


@given(matrices(most=7), st.randoms(use_true_random=False))
def test_the_order_of_pairs_does_not_matter_even_in_ties(cost: Cost, random: np.random.Generator):
    pairs = [(int(i), int(j), float(cost[i, j])) for i, j in np.argwhere(cost < np.inf)]
    random.shuffle(pairs)
    row, col, price = ([pair[k] for pair in pairs] for k in range(3))
    assert partners_of_pairs(row, col, price, *cost.shape) == partners(cost)


@given(st.lists(matrices(most=3), min_size=2, max_size=3))
def test_what_has_no_pair_in_common_is_settled_by_itself(blocks: list[Cost]):
    n, m = (sum(block.shape[axis] for block in blocks) for axis in range(2))
    whole = np.full((n, m), np.inf)
    expected: list[int] = []
    i = j = 0
    for block in blocks:
        whole[i : i + block.shape[0], j : j + block.shape[1]] = block
        expected += [p + j if p >= 0 else -1 for p in partners(block)]
        i, j = i + block.shape[0], j + block.shape[1]
    assert partners(whole) == expected


# --------------------------------------------------------- as objects lie: the optimum is unique


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize("gate_m", [1.0, 3.0, 30.0])
def test_of_points_it_is_the_assignment_of_scipy(seed: int, gate_m: float):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 30, 2)
    cost = near_pairs(rng, n, m, side_m=12.0, gate_m=gate_m)
    expected = by_scipy(cost)
    assert partners(cost) == expected
    row, col = np.nonzero(cost < 0)
    order = rng.permutation(len(row))
    shuffled = (list(column[order]) for column in (row, col, cost[row, col]))
    assert partners_of_pairs(*shuffled, n, m) == expected


@pytest.mark.parametrize(("n", "m", "gate_m"), [(160, 160, 8.0), (160, 160, 1000.0), (40, 300, 20.0), (300, 40, 20.0)])
def test_of_many_points_too(n: int, m: int, gate_m: float):
    cost = near_pairs(np.random.default_rng(3), n, m, side_m=90.0, gate_m=gate_m)
    assert partners(cost) == by_scipy(cost)


@given(st.integers(0, 12), st.integers(1, 12), st.floats(0.0, 0.5), st.integers(0, 999))
def test_the_largest_around_is_that_of_the_connected_component(n: int, m: int, share: float, seed: int):
    rng = np.random.default_rng(seed)
    allowed = rng.random((n, m)) < share
    row, col = np.nonzero(allowed)
    value = rng.integers(-3, 4, len(row)).astype(float)
    expected = largest_by_scipy(allowed, value)
    order = rng.permutation(len(row))
    found = value[order]
    spread_component_maximum(row[order], col[order], found, n, m)
    assert found.tolist() == expected[order].tolist()


def test_a_chain_is_one_component_and_its_end_is_heard_at_the_other():
    row, col = np.repeat(np.arange(500), 2)[1:], np.repeat(np.arange(500), 2)[:-1]
    for order in (slice(None), slice(None, None, -1)):
        value = np.arange(len(row), dtype=float)
        spread_component_maximum(row[order], col[order], value, 500, 500)
        assert (value == len(row) - 1).all()
