"""The exact test of pairs, against SciPy."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from copem_replay.results.compare.limits import mcnemar_p_value

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
