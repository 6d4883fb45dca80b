"""The far tails of detection times and reactions against mpmath, plainly written, and numbers worked out by hand."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mpmath import mp, mpf

from copem_replay.metrics.exact_survival import FirstKnown, first_confirmed, first_known

SOME = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
DIGITS = 450

# ------------------------------------------------------------------------------------- the oracle, in 450 digits

ObjectLists = Sequence[tuple[int, float, int]]
"""Instant, probability, unit."""
Law = Callable[[Any], tuple[list[Any], Any]]
"""Given δ: how probably it is first known at each instant, and never."""


def shifted(p: float, delta: Any) -> Any:
    """The probability whose log-odds are those of p plus δ."""
    if p in (0, 1):
        return mpf(p)
    odds = mpf(p) / (1 - mpf(p)) * mpmath.exp(delta)
    return odds / (1 + odds)


def by_the_first(lists: ObjectLists, share: Sequence[float], count: int) -> Law:
    """Whoever is there is known of by one of its lists; who is there is summed over, one unit at a time."""

    def law(delta: Any) -> tuple[list[Any], Any]:
        unknown = [mpf(1)]
        for k in range(count):
            after = mpf(1)
            for unit, q in enumerate(share):
                missed = mpf(1)
                for instant, p, of in lists:
                    if of == unit and instant <= k:
                        missed *= 1 - shifted(p, delta)
                after *= (1 - mpf(q)) + mpf(q) * missed
            unknown.append(after)
        return [a - b for a, b in pairwise(unknown)], unknown[-1]

    return law


def by_several(lists: ObjectLists, numbers: Sequence[int], hits: int, of: int) -> Law:
    """By the captures of the last window that hold it, from capture to capture, those without a list included."""

    def law(delta: Any) -> tuple[list[Any], Any]:
        windows: dict[tuple[int, ...], Any] = {(): mpf(1)}
        known = [mpf(0)] * len(numbers)
        for number in range(numbers[0], numbers[-1] + 1):
            missed = mpf(1)
            for instant, p, _ in lists:
                if numbers[instant] == number:
                    missed *= 1 - shifted(p, delta)
            after: dict[tuple[int, ...], Any] = defaultdict(mpf)
            for held, mass in windows.items():
                recent = tuple(n for n in held if n > number - of)
                after[recent] += mass * missed
                if number not in numbers:
                    continue
                if len(recent) + 1 >= hits:
                    known[numbers.index(number)] += mass * (1 - missed)
                else:
                    after[(*recent, number)] += mass * (1 - missed)
            windows = after
        return known, sum(windows.values())

    return law


def check(found: FirstKnown, law: Law) -> None:
    with mp.workdps(DIGITS):
        probability, never = law(mpf(0))
        for p, expected in zip(found.probability.tolist(), probability, strict=True):
            assert_near(p, expected)
        _, half = law(-mpmath.log(2))
        if never == 0:
            assert (found.log_never, found.log_never_half) == (-math.inf, -math.inf)
            assert math.isnan(found.per_logit)
            return
        assert_near(found.log_never, mpmath.log(never))
        assert_near(found.log_never_half, mpmath.log(half))
        h = mpf(10) ** -20
        assert_near(found.per_logit, (mpmath.log(law(h)[1]) - mpmath.log(law(-h)[1])) / (2 * h))


def assert_near(found: float, expected: Any, rtol: float = 1e-11) -> None:
    """To a relative error, down to where doubles end."""
    assert abs(mpf(found) - expected) <= rtol * abs(expected) + mpf(10) ** -300, (found, mpmath.nstr(expected, 17))


def is_known(lists: ObjectLists, share: Sequence[float]) -> FirstKnown:
    instant, p, unit = (np.array(column) for column in zip(*lists, strict=True))
    return first_known(instant * 0.1, p.astype(float), unit.astype(np.int64), np.array(share))


def is_confirmed(lists: ObjectLists, numbers: Sequence[int], hits: int, of: int) -> FirstKnown:
    instant, p, _ = (np.array(column) for column in zip(*lists, strict=True))
    return first_confirmed(np.array(numbers)[instant], np.array(numbers)[instant] * 0.1, p.astype(float), hits, of)


# Certain, rare, and anything between; 1 − 10⁻¹⁵ is the nearest to 1 that is written, 10⁻⁴⁰ is lost beside 1.
PROBABILITIES = st.one_of(
    st.sampled_from([0.0, 1.0]),
    st.floats(0.001, 0.999),
    st.integers(1, 15).map(lambda k: 1 - 10.0**-k),
    st.integers(1, 40).map(lambda k: 10.0**-k),
)
SHARES = st.one_of(
    st.just(1.0), st.just(0.0), st.floats(0.01, 0.99), st.sampled_from([1e-12, 1 - 1e-12, 1 - 2**-53, 0.5])
)


@st.composite
def several_lists(
    draw: st.DrawFn, units: int, kinds: st.SearchStrategy[float] = PROBABILITIES
) -> tuple[ObjectLists, int]:
    """At each of some instants at least one list."""
    count = draw(st.integers(1, 8))
    usual = draw(st.lists(kinds, min_size=1, max_size=3))
    lists = []
    for k in range(count):
        for unit in draw(st.sets(st.integers(0, units - 1), min_size=1)):
            repeated = draw(st.sampled_from([1, 1, 1, 20]))  # so many sensors that all say the same
            lists += [(k, draw(st.sampled_from(usual)), unit)] * repeated
    return lists, count


@SOME
@given(several_lists(3), st.tuples(SHARES, SHARES, SHARES))
def test_one_hit(made: tuple[ObjectLists, int], share: tuple[float, ...]) -> None:
    lists, count = made
    check(is_known(lists, share), by_the_first(lists, share, count))


@SOME
@given(
    several_lists(2),
    st.sampled_from([(2, 2), (2, 3), (3, 3), (2, 5), (3, 5), (5, 5)]),
    st.lists(st.sampled_from([1, 1, 1, 2, 3, 9]), min_size=8, max_size=8),
)
def test_several_hits(made: tuple[ObjectLists, int], confirm: tuple[int, int], gaps: list[int]) -> None:
    lists, count = made
    numbers = np.cumsum(gaps[:count]).tolist()
    check(is_confirmed(lists, numbers, *confirm), by_several(lists, numbers, *confirm))


# ---------------------------------------------------------------------------------------------------- by hand


def alike(count: int, p: float) -> ObjectLists:
    return [(k, p, 0) for k in range(count)]


def test_lists_that_are_all_alike() -> None:
    """Odds of 9 : 1, halved 9 : 2."""
    found = is_known(alike(22, 0.9), (1.0,))
    assert found.log_never == pytest.approx(22 * math.log(0.1), rel=1e-14)
    assert found.per_logit == pytest.approx(-22 * 0.9, rel=1e-14)
    assert found.log_never_half == pytest.approx(22 * math.log(2 / 11), rel=1e-14)
    assert found.probability.tolist() == pytest.approx([0.9 * 0.1**k for k in range(22)], rel=1e-12, abs=0)


def test_a_unit_that_is_there_every_other_time() -> None:
    """½ + ½ · 10⁻³; that it is there though it has missed thrice has 1 : 1000."""
    found = is_known(alike(3, 0.9), (0.5,))
    assert found.log_never == pytest.approx(math.log(0.5005), rel=1e-14)
    assert found.per_logit == pytest.approx(-2.7 / 1001, rel=1e-12)
    assert found.log_never_half == pytest.approx(math.log(0.5 + 0.5 * (2 / 11) ** 3), rel=1e-14)


def test_beyond_what_a_double_holds() -> None:
    """At each of three instants 500 lists of .999. Two of three: all but one instant have to miss."""
    lists = [(k, 0.999, 0) for k in range(3) for _ in range(500)]
    found = is_known(lists, (1.0,))
    assert found.log_never / math.log(10) == pytest.approx(-4500, rel=1e-12)
    assert found.per_logit == pytest.approx(-1500 * 0.999, rel=1e-12)
    found = is_confirmed(lists, (0, 1, 2), 2, 3)
    assert found.log_never / math.log(10) == pytest.approx(-3000 + math.log10(3), rel=1e-12)
    assert found.per_logit == pytest.approx(-1000 * 0.999, rel=1e-12)


@pytest.mark.parametrize("share", [1.0, 1 - 2**-53, 0.5])
def test_what_is_certain_only_if_it_is_there(share: float) -> None:
    found = is_known([(0, 0.5, 0), (1, 1.0, 0)], (share,))
    if share == 1:
        assert (found.log_never, found.log_never_half) == (-math.inf, -math.inf)
        assert math.isnan(found.per_logit)
    else:
        assert found.log_never == pytest.approx(math.log(1 - share), rel=1e-14)
        assert found.per_logit == 0


def test_no_list_at_all() -> None:
    none = np.empty(0, dtype=np.int64)
    for found in (
        first_known(np.empty(0), np.empty(0), none, np.ones(1)),
        first_confirmed(none, np.empty(0), np.empty(0), 2, 3),
    ):
        assert len(found.time_s) == 0
        assert (found.log_never, found.per_logit, found.log_never_half) == (0, 0, 0)
