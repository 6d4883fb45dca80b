"""Statistics of pairs, and limits over resamples, against SciPy, NumPy and plain loops."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from copem_replay.metrics.intervals import Resamples, count_multiplicities, percentile_limits
from copem_replay.results.compare.limits import mcnemar_p_value
from tests.helpers.compare_folders import widened

counts = st.integers(0, 400)


@given(counts, counts)
def test_mcnemar_is_the_exact_binomial_test_of_the_discordant_pairs(only_first, only_second):
    n = only_first + only_second
    expected = binomtest(only_first, n).pvalue if n else 1.0
    assert mcnemar_p_value(only_first, only_second) == pytest.approx(expected, rel=1e-9)


def test_mcnemar_by_hand():
    # Of 6 discordant pairs 1 is the other way: 2 · (1 + 6) / 64.
    assert mcnemar_p_value(1, 5) == pytest.approx(14 / 64)
    assert mcnemar_p_value(5, 1) == mcnemar_p_value(1, 5)
    assert mcnemar_p_value(3, 3) == 1.0
    assert mcnemar_p_value(0, 0) == 1.0


def test_mcnemar_of_less_than_nothing_is_refused():
    with pytest.raises(ValueError, match="at least 0"):
        mcnemar_p_value(-1, 2)


def test_each_number_draws_its_cluster():
    drawn = count_multiplicities(np.array([[0.1, 0.9, 0.5], [0.1, 0.2, 0.3], [0.99, 0.7, 0.34]]))
    assert drawn.tolist() == [[1, 1, 1], [3, 0, 0], [0, 1, 2]]


def limits(values, clusters, confidence=0.95):
    """Of figures of so many resamples, each drawn once."""
    drawn = Resamples(np.ones((len(values), clusters), dtype=np.uint32), np.ones(len(values), dtype=np.int64))
    return percentile_limits(np.array(values), drawn, confidence=confidence)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40), st.integers(2, 200), st.floats(0.5, 0.99))
def test_limits_are_quantiles_linear_between_neighbours(values, clusters, confidence):
    expected = np.quantile(values, widened(clusters, confidence))
    found = limits(values, clusters, confidence)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-6)


def test_what_resamples_do_not_have_is_left_out_of_the_limits():
    assert limits([math.nan, 2.0, math.nan], 5) == (2.0, 2.0)
    assert all(math.isnan(limit) for limit in limits([math.nan], 5))


def test_limits_among_infinite_figures_are_infinite():
    low, high = limits([-math.inf] * 10 + [1.0] * 90, 50)
    assert (low, high) == (-math.inf, 1.0)
    # Between one and the other infinity there is no number.
    assert math.isnan(limits([-math.inf, math.inf], 50, 0.5)[0])
