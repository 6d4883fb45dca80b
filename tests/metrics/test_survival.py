"""Curves, quantiles and intervals against numbers computed by hand, their definitions, and symmetries."""

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.metrics.survival import (
    CENSORED,
    DETECTED,
    LEFT,
    cumulative_incidence,
    incidences_without,
    quantile_time,
    quantile_with_never,
    restricted_mean,
    restricted_means_without,
)

Array = npt.NDArray[np.float64]
Person = tuple[int, int]
"""Time in quarters of a second, and how looking ended."""

QUARTER_S = 0.25  # so that times, their sums and products are exact in binary
CODES = (CENSORED, DETECTED, LEFT)


def people(*codes: int, least: int = 1) -> st.SearchStrategy[list[Person]]:
    """Few times for many, so that ties of all kinds are the rule."""
    return st.lists(st.tuples(st.integers(-4, 8), st.sampled_from(codes)), min_size=least, max_size=14)


def columns(group: list[Person]) -> tuple[Array, npt.NDArray[np.int8]]:
    times = np.array([time for time, _ in group], dtype=float) * QUARTER_S
    return times, np.array([code for _, code in group], dtype=np.int8)


def curve(group: list[Person]) -> tuple[Array, Array]:
    return cumulative_incidence(*columns(group))


def at(times_s: Array, incidence: Array, t_s: float) -> float:
    """The step function read off, step by step."""
    value = 0.0
    for time, after in zip(times_s, incidence, strict=True):
        if time <= t_s:
            value = float(after)
    return value


def product_limit(group: list[Person]) -> dict[int, tuple[Fraction, Fraction, Fraction]]:
    """After each instant: probability to have been detected, to have left, to be neither; by the definition.

    Person by person: the hazard of an end at an instant is the share it strikes among those still there, the
    ones censored at the very instant included.
    """
    detected, left, neither = Fraction(0), Fraction(0), Fraction(1)
    after = {}
    for instant in sorted({time for time, _ in group}):
        at_risk = seen = gone = 0
        for time, code in group:
            if time < instant:
                continue
            at_risk += 1
            if time == instant and code == DETECTED:
                seen += 1
            if time == instant and code == LEFT:
                gone += 1
        detected += neither * Fraction(seen, at_risk)
        left += neither * Fraction(gone, at_risk)
        neither *= 1 - Fraction(seen + gone, at_risk)
        assert detected + left + neither == 1
        after[instant] = (detected, left, neither)
    return after


# ------------------------------------------------------------------------- cumulative incidence

EXAMPLE = (np.array([1.0, 2.0, 2.0, 3.0, 5.0]), np.array([DETECTED, DETECTED, LEFT, DETECTED, CENSORED]))


def test_the_example_departure_takes_its_share_away_for_ever():
    times_s, incidence = cumulative_incidence(*EXAMPLE)
    assert times_s.tolist() == [1.0, 2.0, 3.0]
    assert incidence.tolist() == [0.2, 0.4, 0.6]


def test_departure_is_not_censoring():
    # Were the one who left censored at 2, his fifth would go to the two who remain, half to each.
    time_s, ending = EXAMPLE
    times_s, incidence = cumulative_incidence(time_s, np.where(ending == LEFT, CENSORED, ending))
    assert times_s.tolist() == [1.0, 2.0, 3.0]
    assert incidence == pytest.approx([0.2, 0.4, 0.7], abs=1e-15)


def test_a_censored_one_counts_as_looked_at_at_that_very_time():
    # At 1 all four are at risk: 1/4. At 2 two are: 3/4 · 1/2 more, then the other 3/8.
    times_s, incidence = cumulative_incidence(
        np.array([1.0, 2.0, 1.0, 3.0]), np.array([CENSORED, DETECTED, DETECTED, DETECTED])
    )
    assert times_s.tolist() == [1.0, 2.0, 3.0]
    assert incidence.tolist() == [0.25, 0.625, 1.0]


@pytest.mark.parametrize(("least", "expected"), [(0.5, 1.0), (0.5 + 1e-6, 0.5)])
def test_what_is_no_share_of_all_takes_no_weight_over(least: float, expected: float):
    # One of two is censored at 1: to the other, half of all, goes its weight where half is enough to be somebody.
    _, incidence = cumulative_incidence(np.array([1.0, 2.0]), np.array([CENSORED, DETECTED]), least=least)
    assert incidence.tolist() == [expected]


@pytest.mark.parametrize(("rest", "expected"), [(1e-9, 1.0), (1e-15, 1e-15)])
def test_next_to_nothing_is_nobody(rest: float, expected: float):
    _, incidence = cumulative_incidence(np.array([1.0, 2.0]), np.array([CENSORED, DETECTED]), np.array([1.0, rest]))
    assert incidence == pytest.approx([expected], rel=1e-6)


def test_detection_and_departure_at_one_instant_share_the_risk_of_that_instant():
    _, incidence = cumulative_incidence(np.array([1.0, 1.0, 1.0]), np.array([LEFT, DETECTED, DETECTED]))
    assert incidence.tolist() == [2 / 3]


def test_detections_before_the_onset_are_steps_at_negative_times():
    times_s, incidence = cumulative_incidence(
        np.array([0.0, -1.5, 2.0, -1.5]), np.array([DETECTED, DETECTED, LEFT, DETECTED])
    )
    assert times_s.tolist() == [-1.5, 0.0]
    assert incidence.tolist() == [0.5, 0.75]


@pytest.mark.parametrize("ending", [LEFT, CENSORED])
def test_where_nothing_is_detected_there_is_no_step(ending: int):
    times_s, incidence = cumulative_incidence(np.array([1.0, 4.0]), np.array([ending, ending]))
    assert times_s.shape == incidence.shape == (0,)
    assert quantile_time(times_s, incidence, 0.01) is None
    assert restricted_mean(times_s, incidence, 4.0) == 4.0


@given(people(*CODES))
def test_it_is_the_product_limit_of_the_definition(group: list[Person]):
    times_s, incidence = curve(group)
    expected = product_limit(group)
    assert times_s.tolist() == sorted({time * QUARTER_S for time, code in group if code == DETECTED})
    for instant, (detected, _, _) in expected.items():
        assert at(times_s, incidence, instant * QUARTER_S) == pytest.approx(float(detected), abs=1e-14)


@given(people(*CODES))
def test_detected_departed_and_neither_add_up_to_one(group: list[Person]):
    swap = {DETECTED: LEFT, LEFT: DETECTED, CENSORED: CENSORED}
    seen, gone = curve(group), curve([(time, swap[code]) for time, code in group])
    for instant, (_, _, neither) in product_limit(group).items():
        t_s = instant * QUARTER_S
        assert at(*seen, t_s) + at(*gone, t_s) == pytest.approx(1 - float(neither), abs=1e-14)


@given(people(DETECTED, LEFT))
def test_without_censoring_it_is_the_share_detected_by_then_to_the_last_bit(group: list[Person]):
    times_s, incidence = curve(group)
    for t_s, value in zip(times_s, incidence, strict=True):
        assert value == sum(code == DETECTED and time * QUARTER_S <= t_s for time, code in group) / len(group)


@given(people(*CODES))
def test_it_rises_strictly_and_stays_within_one(group: list[Person]):
    times_s, incidence = curve(group)
    assert (np.diff(times_s) > 0).all()
    assert (np.diff(incidence, prepend=0.0) > 0).all()
    assert (incidence <= 1.0).all()


@given(people(*CODES), st.randoms(use_true_random=False), st.integers(-3, 3), st.integers(-8, 8))
def test_order_unit_and_origin_of_time_do_not_matter(group: list[Person], random: Any, power: int, shift: int):
    times_s, incidence = curve(group)
    shuffled = random.sample(group, len(group))
    time_s, ending = columns(shuffled)
    other_s, other = cumulative_incidence(time_s * 2.0**power + shift, ending)
    assert other_s.tolist() == (times_s * 2.0**power + shift).tolist()
    assert other.tolist() == incidence.tolist()


@given(people(*CODES), st.integers(2, 5))
def test_everyone_counted_several_times_gives_the_same_curve(group: list[Person], copies: int):
    times_s, incidence = curve(group)
    same_s, same = curve(group * copies)
    assert same_s.tolist() == times_s.tolist()
    assert same == pytest.approx(incidence, abs=1e-14)


def test_rounding_does_not_lift_it_above_one():
    # Six times the weight 7/6, over 7, is a bit more than 1 in binary.
    ending = np.array([CENSORED] + 6 * [DETECTED])
    assert cumulative_incidence(np.arange(7.0), ending)[1][-1] == 1.0


def test_shares_of_a_million_are_exact():
    n = 1_000_000
    times_s, incidence = cumulative_incidence(np.arange(n, 0.0, -1.0), np.full(n, DETECTED))
    assert incidence[-1] == 1.0
    assert incidence[n // 3 - 1] == (n // 3) / n
    assert quantile_time(times_s, incidence, 0.07) == 70_000.0


# ------------------------------------------------------------------------------- quantiles of time


def test_quantiles_of_the_example():
    steps = cumulative_incidence(*EXAMPLE)
    levels = (0.01, 0.2, 0.21, 0.4, 0.5, 0.6)
    assert [quantile_time(*steps, q) for q in levels] == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    assert quantile_time(*steps, 0.61) is None
    assert quantile_time(*steps, 1.0) is None


def test_a_level_that_rounding_missed_is_reached_and_the_next_is_not():
    times_s, incidence = np.array([1.0, 2.0]), np.array([0.5 - 1e-13, 0.5 + 1e-9])
    assert quantile_time(times_s, incidence, 0.5) == 1.0
    assert quantile_time(times_s, incidence, 0.5 + 1e-10) == 2.0
    assert quantile_time(times_s, incidence, 0.5 + 2e-9) is None


@given(people(DETECTED, LEFT), st.integers(1, 40))
def test_without_censoring_a_quantile_counts_heads(group: list[Person], fortieths: int):
    ranked = sorted(time * QUARTER_S if code == DETECTED else math.inf for time, code in group)
    # The first head that, with all before it, makes up the level.
    expected = next(t for k, t in enumerate(ranked, 1) if Fraction(k, len(group)) >= Fraction(fortieths, 40))
    assert quantile_time(*curve(group), fortieths / 40) == (None if math.isinf(expected) else expected)


# ------------------------------------------------------------------------------- restricted mean


def test_restricted_mean_of_the_example():
    steps = cumulative_incidence(*EXAMPLE)
    # 1 · 1 + 0.8 · 1 + 0.6 · 1 + 0.4 · 2
    assert restricted_mean(*steps, 5.0) == pytest.approx(3.2, abs=1e-15)
    # Half way into the second step: 1 + 0.8 · 0.5. On a step: the step adds nothing.
    assert restricted_mean(*steps, 1.5) == pytest.approx(1.4, abs=1e-15)
    assert restricted_mean(*steps, 2.0) == pytest.approx(1.8, abs=1e-15)
    assert restricted_mean(*steps, 0.5) == 0.5


def test_known_before_the_onset_counts_negative():
    # Detected at −1 and 2, one never: (−1 + 2 + 5)/3; all known before: below 0.
    steps = cumulative_incidence(np.array([-1.0, 2.0, 3.0]), np.array([DETECTED, DETECTED, LEFT]))
    assert restricted_mean(*steps, 5.0) == pytest.approx(2.0, abs=1e-15)
    early = cumulative_incidence(np.array([-3.0, -1.0]), np.array([DETECTED, DETECTED]))
    assert restricted_mean(*early, 5.0) == -2.0


@given(people(DETECTED, LEFT), st.integers(1, 12))
def test_without_censoring_it_is_the_mean_over_heads(group: list[Person], horizon: int):
    capped = [min(time, horizon) if code == DETECTED else horizon for time, code in group]
    expected = float(Fraction(sum(capped), len(group))) * QUARTER_S
    assert restricted_mean(*curve(group), horizon * QUARTER_S) == pytest.approx(expected, abs=1e-14)


@given(people(*CODES), st.integers(1, 12))
def test_with_censoring_it_is_the_mean_over_the_probabilities_of_the_instants(group: list[Person], horizon: int):
    mean, previous = Fraction(0), Fraction(0)
    for instant, (detected, _, _) in product_limit(group).items():
        mean += (detected - previous) * min(instant, horizon)
        previous = detected
    mean += (1 - previous) * horizon
    assert restricted_mean(*curve(group), horizon * QUARTER_S) == pytest.approx(float(mean) * QUARTER_S, abs=1e-14)


@given(people(*CODES), st.floats(0.1, 10.0), st.floats(-5.0, 5.0), st.integers(1, 12))
def test_a_mean_moves_and_stretches_with_time(group: list[Person], factor: float, shift_s: float, horizon: int):
    # A latency moves every detection by exactly itself, and the mean with them.
    times_s, incidence = curve(group)
    horizon_s = horizon * QUARTER_S
    mean_s = restricted_mean(times_s, incidence, horizon_s)
    moved_s = restricted_mean(times_s * factor + shift_s, incidence, horizon_s * factor + shift_s)
    assert moved_s == pytest.approx(mean_s * factor + shift_s, abs=1e-12)


# -------------------------------------------------------------------- quantiles with never detected


def test_never_ranks_below_every_distance():
    values = np.array([30.0, np.nan, 10.0, 20.0])
    detected = np.array([True, False, True, True])
    levels = (0.05, 0.25, 0.26, 0.5, 0.51, 0.75, 0.76, 1.0)
    expected = [None, None, 10.0, 10.0, 20.0, 20.0, 30.0, 30.0]
    assert [quantile_with_never(values, detected, q) for q in levels] == expected


def test_what_stands_where_nothing_was_detected_is_not_read():
    detected = np.array([True, False, True])
    for stray in (-1.0, 1e9, np.nan, np.inf):
        assert quantile_with_never(np.array([4.0, stray, 6.0]), detected, 0.5) == 4.0


def test_all_or_none_detected():
    values = np.array([3.0, 1.0, 2.0])
    assert quantile_with_never(values, np.ones(3, dtype=bool), 0.05) == 1.0
    assert quantile_with_never(values, np.ones(3, dtype=bool), 1e-13) == 1.0
    assert quantile_with_never(values, np.zeros(3, dtype=bool), 1.0) is None


def test_a_whole_rank_is_not_missed_by_rounding():
    # 0.07 · 100 and 0.55 · 100 are a little more than 7 and 55 in binary.
    assert 0.07 * 100 > 7
    assert 0.55 * 100 > 55
    values, detected = np.arange(1.0, 101.0), np.ones(100, dtype=bool)
    assert quantile_with_never(values, detected, 0.07) == 7.0
    assert quantile_with_never(values, detected, 0.55) == 55.0


rows = st.lists(st.none() | st.integers(0, 6), min_size=1, max_size=15)


@given(rows, st.integers(1, 40))
def test_it_is_the_smallest_value_with_enough_rows_at_or_below(distances: list[int | None], fortieths: int):
    detected = np.array([d is not None for d in distances])
    values = np.array([np.nan if d is None else float(d) for d in distances])
    enough = Fraction(fortieths, 40) * len(distances)
    # None is tried first: it ranks below every value.
    candidates: list[int | None] = [None, *range(7)]
    expected = next(v for v in candidates if sum(d is None or (v is not None and d <= v) for d in distances) >= enough)
    assert quantile_with_never(values, detected, fortieths / 40) == expected


@given(rows, st.integers(1, 40), st.floats(0.01, 100.0))
def test_a_distance_in_other_units_is_the_same_distance(distances: list[int | None], fortieths: int, factor: float):
    detected = np.array([d is not None for d in distances])
    values = np.array([np.nan if d is None else float(d) for d in distances])
    in_metres = quantile_with_never(values, detected, fortieths / 40)
    expected = None if in_metres is None else in_metres * factor
    assert quantile_with_never(values * factor, detected, fortieths / 40) == expected


# ------------------------------------------------------------------------------ without each cluster


clustered = st.lists(st.tuples(st.integers(0, 12), st.sampled_from([CENSORED, DETECTED, LEFT]), st.integers(0, 2),
                               st.integers(1, 3)), min_size=1, max_size=14)  # fmt: skip


@given(clustered, st.integers(0, 14))
def test_without_a_cluster_it_is_the_curve_and_the_mean_of_the_other_rows(
    rows: list[tuple[int, int, int, int]], quarters: int
):
    time_s, ending, cluster, weight = (np.array(column) for column in zip(*rows, strict=True))
    horizon_s, at_s = quarters / 4, np.arange(-1, 14) / 4
    means = restricted_means_without(time_s / 4, ending, weight.astype(float), cluster, 3, horizon_s)
    shares = incidences_without(time_s / 4, ending, weight.astype(float), cluster, 3, at_s)
    for k in range(3):
        kept = np.repeat(np.arange(len(rows)), np.where(cluster == k, 0, weight))  # each row as often as it counts
        if not len(kept):
            assert np.isnan([means[k], *shares[k]]).all()
            continue
        times_s, incidence = cumulative_incidence(time_s[kept] / 4, ending[kept])
        assert means[k] == pytest.approx(restricted_mean(times_s, incidence, horizon_s), abs=1e-9)
        expected = [float(incidence[times_s <= t][-1]) if (times_s <= t).any() else 0.0 for t in at_s]
        assert shares[k] == pytest.approx(expected, abs=1e-9)


# --------------------------------------------------------------------------- what is not accepted

ONE = np.array([1.0])


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        (lambda: cumulative_incidence(np.array([]), np.array([], dtype=int)), "at least one row"),
        (lambda: cumulative_incidence(ONE, np.array([1, 1])), "equal length"),
        (lambda: cumulative_incidence(np.ones((1, 1)), np.ones((1, 1), dtype=int)), "two columns"),
        (lambda: cumulative_incidence(np.array([np.nan]), np.array([LEFT])), "finite"),
        (lambda: cumulative_incidence(np.array([np.inf]), np.array([LEFT])), "finite"),
        (lambda: cumulative_incidence(ONE, np.array([3])), "DETECTED, LEFT or CENSORED"),
    ],
)
def test_a_defect_of_the_caller_is_said(call: Callable[[], object], reason: str):
    with pytest.raises(ValueError, match=reason):
        call()
