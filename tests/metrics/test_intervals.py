"""Intervals over whole clusters against numbers computed by hand, fractions and SciPy."""

import itertools
import math
from collections import Counter
from fractions import Fraction

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.metrics.intervals import (
    Resamples,
    alike_limits,
    bootstrap_share,
    count_multiplicities,
    draw_resamples,
    effective_number,
    exact_limits,
    expand_tail,
    list_resamples,
    percentile_limits,
    share_limits,
)
from copem_replay.metrics.summary import format_summary, summarise_rows
from tests.helpers.compare_folders import limits_of, widened

Array = npt.NDArray[np.float64]


def of(uniform: Array) -> Resamples:
    """The resamples that these numbers draw."""
    return Resamples(count_multiplicities(uniform), np.ones(len(uniform), dtype=np.int64))


def columns(clusters: list[tuple[int, int]]) -> list[npt.NDArray[np.int64]]:
    return [np.array(column) for column in zip(*clusters, strict=True)]


# ------------------------------------------------------------------------------------ resamples


def test_of_few_clusters_every_resample_is_there_as_often_as_it_is_drawn():
    for clusters in range(1, 6):
        drawn = Counter(
            tuple(some.count(k) for k in range(clusters))
            for some in itertools.product(range(clusters), repeat=clusters)
        )
        found = list_resamples(clusters)
        assert dict(zip(map(tuple, found.count.tolist()), found.times.tolist(), strict=True)) == drawn
    assert len(list_resamples(7).times) == 1716  # 13 over 7
    assert list_resamples(7).times.sum() == 7**7


def test_seven_clusters_are_worked_out_and_eight_are_drawn():
    seven, eight = (draw_resamples([f"log{k}" for k in range(K)], 3) for K in (7, 8))
    assert seven is draw_resamples(list("abcdefg"), 4)  # whatever their names and the seed
    assert (eight.count.shape, eight.times.sum()) == ((2000, 8), 2000)
    assert (eight.count.sum(axis=1) == 8).all()
    assert (draw_resamples([f"log{k}" for k in range(8)], 4).count != eight.count).any()


def test_many_clusters_are_drawn_part_by_part_as_well_as_at_once():
    names = [f"object {k}" for k in range(3000)]  # of which 2000 resamples are more than is held at a time
    drawn = draw_resamples(names, 5).count
    assert (drawn.sum(axis=1) == 3000).all()
    zeros = np.zeros(3000, dtype=np.int64)
    uniform = CounterRng(5, "summary").uniform(
        "bootstrap", RandomKey(("",), zeros, object_words(names), zeros), np.arange(1998, 2000)
    )
    assert drawn[1998:].tolist() == [np.bincount((u * 3000).astype(int), minlength=3000).tolist() for u in uniform]


@given(st.lists(st.integers(-20, 20), min_size=2, max_size=5), st.floats(0.5, 0.99))
def test_limits_are_those_of_all_resamples_written_out(values: list[int], confidence: float):
    """A resample that stands for many counts as often: the quantile of K^K figures, linear between neighbours."""
    every = list_resamples(len(values))
    means = [sum(some) / len(some) for some in itertools.product(values, repeat=len(values))]
    found = percentile_limits(every.count @ np.array(values) / len(values), every, confidence=confidence)
    assert found == pytest.approx(np.quantile(means, widened(len(values), confidence)), abs=1e-9)


def test_two_clusters_by_hand():
    # 0 and 1: the means 0, 1/2 twice, 1; at Φ(−√2 · tan(π/4)) = 0.0786496, of three steps 0.2359488.
    every = list_resamples(2)
    low, high = percentile_limits(every.count @ np.array([0.0, 1.0]) / 2, every, confidence=0.5)
    assert (low, high) == pytest.approx((0.2359488 / 2, 1 - 0.2359488 / 2), abs=1e-7)


# ------------------------------------------------------------------------------------ bootstrap


def share(successes: list[int], totals: list[int], uniform: Array, confidence: float) -> tuple[float, float]:
    return bootstrap_share(np.array(successes), np.array(totals), of(uniform), confidence=confidence)


def test_four_resamples_by_hand():
    # Clusters 0 of 2 and 4 of 4. Drawn: both first, first and second twice, both second.
    uniform = np.array([[0.1, 0.2], [0.1, 0.9], [0.6, 0.4], [0.99, 0.5]])
    # Shares 0, 2/3, 2/3, 1. Two clusters: Student's quantile of one degree of freedom is 1, by √2: Φ(−√2) = 0.0786496.
    steps = 3 * 0.07864960352514258
    expected = (2 / 3 * steps, 1 - 1 / 3 * steps)
    assert share([0, 4], [2, 4], uniform, 0.5) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("clusters", "tail"), [(1, 0.025), (2, 0.0), (5, 0.00095), (10, 0.00855), (10**6, 0.025)])
def test_few_clusters_widen_the_tails(clusters, tail):
    assert expand_tail(0.95, clusters) == pytest.approx(tail, abs=5e-6)


@pytest.mark.long
def test_intervals_over_few_clusters_hold_the_mean_as_often_as_they_say():
    """Means of 5 clusters of equal size: plain percentiles hold it 85 times of 100; these at least 91."""
    rng = np.random.default_rng(11)
    held = 0
    for _ in range(400):
        shares = rng.beta(4, 4, 5)
        successes, totals = np.rint(shares * 10_000).astype(int), np.full(5, 10_000)
        low, high = bootstrap_share(successes, totals, list_resamples(5))
        held += low <= 0.5 <= high
    assert held >= 0.91 * 400


def test_resamples_without_any_total_are_left_out():
    # Of the four, the one that draws the empty cluster twice says nothing; all others say 1/3.
    uniform = np.array([[0.1, 0.2], [0.1, 0.9], [0.6, 0.4], [0.99, 0.5]])
    assert share([0, 1], [0, 3], uniform, 0.95) == pytest.approx((1 / 3, 1 / 3), abs=1e-15)


def test_numbers_next_to_the_ends_draw_the_first_and_the_last_cluster():
    least, most = np.nextafter(0.0, 1.0), np.nextafter(1.0, 0.0)
    for clusters in (1, 3, 7, 10, 1000):
        successes = [0] * (clusters - 1) + [1]
        assert share(successes, [1] * clusters, np.full((2, clusters), most), 0.9) == (1.0, 1.0)
        if clusters > 1:
            assert share(successes, [1] * clusters, np.full((2, clusters), least), 0.9) == (0.0, 0.0)


tallies = st.lists(
    st.integers(0, 5).flatmap(lambda total: st.tuples(st.integers(0, total), st.just(total))),
    min_size=1,
    max_size=4,
).filter(lambda clusters: any(total for _, total in clusters))


def sorted_shares(clusters: list[tuple[int, int]]) -> list[Fraction]:
    """Shares of all equally likely resamples that have one, in fractions."""
    shares = []
    for drawn in itertools.product(clusters, repeat=len(clusters)):
        if total := sum(t for _, t in drawn):
            shares.append(Fraction(sum(s for s, _ in drawn), total))
    return sorted(shares)


@given(tallies, st.integers(1, 19))
def test_over_every_resample_the_limits_are_its_ordered_shares(clusters: list[tuple[int, int]], tail: int):
    shares = sorted_shares(clusters)
    # `tail` fortieths on each side, widened; between two ordered shares, straight.
    low, high = widened(len(clusters), 1 - tail / 20) if len(clusters) > 1 else (tail / 40, 1 - tail / 40)
    expected = []
    for level in (Fraction(low), Fraction(high)):
        steps = level * (len(shares) - 1)
        below = math.floor(steps)
        above = min(below + 1, len(shares) - 1)
        expected.append(float(shares[below] + (steps - below) * (shares[above] - shares[below])))
    found = bootstrap_share(*columns(clusters), list_resamples(len(clusters)), confidence=1 - tail / 20)
    assert found == pytest.approx(expected, abs=1e-12)


@given(tallies, st.integers(2, 50))
def test_more_rows_of_the_same_kind_in_each_cluster_teach_nothing(clusters: list[tuple[int, int]], copies: int):
    successes, totals = columns(clusters)
    every = list_resamples(len(clusters))
    once = bootstrap_share(successes, totals, every, confidence=0.9)
    often = bootstrap_share(successes * copies, totals * copies, every, confidence=0.9)
    assert often == pytest.approx(once, abs=1e-14)


@given(tallies, st.integers(0, 2**32 - 1))
def test_failures_have_the_mirrored_bootstrap_interval(clusters: list[tuple[int, int]], seed: int):
    successes, totals = (list(column) for column in zip(*clusters, strict=True))
    # The first rows draw each cluster alone, so that there is always a resample with a total.
    alone = np.repeat(np.arange(len(clusters))[:, None] + 0.5, len(clusters), axis=1) / len(clusters)
    uniform = np.concatenate([alone, np.random.default_rng(seed).uniform(1e-9, 1.0, (30, len(clusters)))])
    low, high = share(successes, totals, uniform, 0.8)
    failures = [t - s for s, t in clusters]
    assert share(failures, totals, uniform, 0.8) == pytest.approx((1 - high, 1 - low), abs=1e-12)


def test_over_independent_rows_it_agrees_with_theory_at_the_default_size():
    # 400 rows of one, half of them successes: 1.96 · √(0.25/400) = 0.049 to either side.
    uniform = np.random.default_rng(7).uniform(1e-9, 1.0, (2000, 400))
    successes = np.tile([0, 1], 200)
    low, high = bootstrap_share(successes, np.ones(400, dtype=np.int64), of(uniform))
    assert low == pytest.approx(0.451, abs=0.006)
    assert high == pytest.approx(0.549, abs=0.006)
    # The same rows in 20 clusters of one mind each: √20 times as wide.
    low, high = bootstrap_share(np.tile([0, 20], 10), np.full(20, 20), of(uniform[:, :20]))
    assert high - low == pytest.approx(2 * 0.049 * math.sqrt(20), abs=0.05)


# ------------------------------------------------------------------------------------ exact limits


def test_exact_limits_by_hand():
    # All of five, with probability p⁵ = 0.025; none of five, (1 − p)⁵ = 0.025.
    assert exact_limits(5, 5) == (pytest.approx(0.025**0.2), 1.0)
    assert exact_limits(0, 5) == (0.0, pytest.approx(1 - 0.025**0.2))
    assert exact_limits(5, 5)[0] == pytest.approx(0.478176, abs=1e-6)
    # In between: of Beta(1, 1.5) the distribution is 1 − (1 − x)^1.5.
    assert exact_limits(1, 1.5)[0] == pytest.approx(1 - 0.975 ** (1 / 1.5))


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))), st.floats(0.5, 0.999))
def test_exact_limits_of_whole_numbers_are_those_of_clopper_and_pearson(trials: tuple[int, int], confidence: float):
    k, n = trials
    expected = binomtest(k, n).proportion_ci(confidence, method="exact")
    assert exact_limits(k, n, confidence=confidence) == pytest.approx((expected.low, expected.high), abs=1e-8)


fractional = st.floats(1, 200).flatmap(lambda n: st.tuples(st.floats(0, 1).map(lambda share: share * n), st.just(n)))


@given(fractional)
def test_exact_limits_hold_their_share_and_are_mirrored_by_the_failures(trials: tuple[float, float]):
    k, n = trials
    low, high = exact_limits(k, n)
    assert 0 <= low <= k / n + 1e-9
    assert k / n - 1e-9 <= high <= 1
    assert exact_limits(n - k, n) == pytest.approx((1 - high, 1 - low), abs=1e-7)


def test_effective_numbers_by_hand():
    assert effective_number(np.array([7, 7, 7, 7])) == pytest.approx(4)
    assert effective_number(np.array([3.0, 1.0])) == pytest.approx(1.6)
    assert effective_number(np.array([5, 0, 0])) == 1


# ------------------------------------------------------------------------------------ shares


def limits(clusters: list[tuple[int, int]]) -> tuple[str, float, float]:
    return share_limits(*columns(clusters), draw_resamples([str(k) for k in range(len(clusters))], 1))


def test_five_that_are_alike_are_no_certainty():
    assert limits([(20, 20)] * 5) == ("bootstrap+exact", pytest.approx(0.025**0.2), 1.0)
    assert limits([(0, 20)] * 5) == ("bootstrap+exact", 0.0, pytest.approx(1 - 0.025**0.2))
    # Of 150, too: 1 − 0.025^(1/150).
    assert limits([(0, 20)] * 150) == ("bootstrap+exact", 0.0, pytest.approx(0.0242926, abs=1e-7))


def test_a_cluster_that_outweighs_the_others_is_nearly_all_there_is():
    # n = 24² / (20² + 4 · 1²) = 1.425743: low = 0.025^(1/n), of Beta(n, 1).
    kind, low, high = limits([(20, 20), (1, 1), (1, 1), (1, 1), (1, 1)])
    assert (kind, low, high) == ("bootstrap+exact", pytest.approx(0.025 ** (404 / 576)), 1.0)


def test_limits_are_the_wider_of_both_on_each_side():
    # One of five succeeds, and half of another: the exact limits of 1.5 of 5 are wider below, as they are above.
    clusters = [(2, 2), (1, 2), (0, 2), (0, 2), (0, 2)]
    drawn = bootstrap_share(*columns(clusters), list_resamples(5))
    kind, low, high = limits(clusters)
    exact = exact_limits(1.5, 5)
    assert (kind, low, high) == ("bootstrap+exact", min(drawn[0], exact[0]), max(drawn[1], exact[1]))
    assert drawn == pytest.approx(
        limits_of(list("abcde"), lambda some: sum({"a": 2, "b": 1}.get(one, 0) for one in some) / 10), abs=1e-12
    )


def test_many_clusters_of_which_enough_succeed_and_fail_are_only_resampled():
    rng = np.random.default_rng(2)
    clusters = [(int(k), 10) for k in rng.integers(0, 11, 120)]
    assert limits(clusters) == (
        "bootstrap",
        *bootstrap_share(*columns(clusters), draw_resamples(list(map(str, range(120))), 1)),
    )
    # Of 120 nine succeed: fewer than ten.
    assert limits([(1, 1)] * 9 + [(0, 1)] * 111)[0] == "bootstrap+exact"
    assert limits([(1, 1)] * 10 + [(0, 1)] * 110)[0] == "bootstrap"
    assert limits([(1, 1)] * 49 + [(0, 1)] * 50)[0] == "bootstrap+exact"


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(4, 6)), min_size=1, max_size=6))
def test_limits_of_a_share_are_never_narrower_than_either(clusters: list[tuple[int, int]]):
    _, low, high = limits(clusters)
    for narrower in (bootstrap_share(*columns(clusters), list_resamples(len(clusters))),):
        assert low <= narrower[0]
        assert narrower[1] <= high
    successes, totals = columns(clusters)
    n = effective_number(totals)
    least, most = exact_limits(n * successes.sum() / totals.sum(), n)
    assert low <= least + 1e-12
    assert most - 1e-12 <= high


def rows_of(detected: list[list[bool]]) -> pd.DataFrame:
    """Rows of one configuration, an object each with its runs, that are looked at for 2 s and known at 1 s or never."""
    found = pd.DataFrame(
        [
            {"object_id": str(k), "run": run, "detected": known, "time_to_detection_s": 1.0 if known else math.nan}
            for k, of_object in enumerate(detected)
            for run, known in enumerate(of_object)
        ]
    )
    return found.assign(log="a", configuration="c", onset_s=0.0, ended_s=2.0, ended_by="object_left",
                        distance_at_detection_m=5.0)  # fmt: skip


def test_the_summary_of_five_objects_that_are_always_detected() -> None:
    table, notes = summarise_rows(rows_of([[True] * 20] * 5), ["c"], {"c": 10.0}, seed=1, horizon_s=2.0)
    (row,) = table.to_dict("records")
    assert (row["detected_share_low"], row["detected_share_high"]) == (pytest.approx(0.025**0.2), 1.0)
    assert (row["interval"], row["interval_over"], notes) == ("bootstrap+exact", "objects", [])
    lines = format_summary(table).splitlines()
    assert "[0.4782, 1]" in lines[1]
    assert "95 %: bootstrap interval over objects, nowhere narrower than exact binomial limits" in lines


# ------------------------------------------------------------------------------------ differences that are all alike


def test_a_difference_that_is_the_same_in_five_clusters_by_hand():
    assert alike_limits(0.0, 5) == pytest.approx((-0.521824, 0.521824), abs=1e-6)
    assert alike_limits(1.0, 5) == pytest.approx((0.478176, 1.0), abs=1e-6)
    assert alike_limits(-1.0, 5) == pytest.approx((-1.0, -0.478176), abs=1e-6)


@given(st.floats(-1, 1), st.floats(1, 200))
def test_limits_of_alike_differences_are_mirrored_hold_it_and_stay_possible(difference: float, n: float):
    low, high = alike_limits(difference, n)
    assert -1 - 1e-9 <= low <= difference + 1e-9
    assert difference - 1e-9 <= high <= 1 + 1e-9
    assert alike_limits(-difference, n) == pytest.approx((-high, -low), abs=1e-12)


@given(st.floats(0, 0.99), st.floats(1, 60))
def test_a_little_more_of_a_difference_changes_its_limits_a_little(difference: float, n: float):
    one, other = np.array(alike_limits(difference, n)), np.array(alike_limits(difference + 1e-4, n))
    assert (other >= one - 1e-9).all()
    assert other == pytest.approx(one, abs=0.02)
