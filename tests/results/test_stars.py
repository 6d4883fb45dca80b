"""Stars of a table: Holm's procedure by sets, against that by p-values; how often a table has a false one."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from copem_replay.results.compare.limits import find_stars


def by_p_values(p: list[float], number: int) -> set[int]:
    """Holm (1979): the smallest p-value is held against .05/N, the next against .05/(N − 1), … until one is above."""
    held: set[int] = set()
    for rank, k in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        if p[k] > 0.05 / (number - rank):
            break
        held.add(k)
    return held


def of_normal(z: float) -> Callable[[float], Mapping[str, object]]:
    """Limits of a difference of z standard errors."""

    def limits(confidence: float) -> Mapping[str, object]:
        half = float(stats.norm.ppf(0.5 + confidence / 2))
        return {"low": z - half, "high": z + half}

    return limits


@given(st.lists(st.floats(-6, 6), max_size=12), st.integers(0, 9))
def test_by_sets_and_by_p_values_are_the_same(z: list[float], without: int) -> None:
    p = [float(2 * stats.norm.sf(abs(one))) for one in z]
    number = len(z) + without
    if any(abs(one * (number - k) - 0.05) < 1e-6 for one in p for k in range(number)):
        return  # at the very bound either may round
    assert find_stars(number, [of_normal(one) for one in z]) == by_p_values(p, number)


def test_at_most_one_table_in_twenty_has_a_false_star() -> None:
    """1,000 tables of 28 differences that are truly 0, four of a group alike."""
    rng = np.random.default_rng(3)
    z = np.repeat(rng.normal(size=(1000, 7)), 4, axis=1) * 0.6 + rng.normal(size=(1000, 28)) * 0.8
    tables = [find_stars(28, [of_normal(float(one)) for one in of_table]) for of_table in z]
    assert 0 < sum(map(bool, tables)) <= 1000 * (0.05 + 3 * np.sqrt(0.05 * 0.95 / 1000))


def test_without_limits_there_is_no_star() -> None:
    limits: list[Mapping[str, object]] = [{}, {"low": None, "high": -1.0}, {"low": 0.0, "high": 0.0}]
    assert find_stars(3, [lambda _, of=of: of for of in limits]) == {1}
