"""Intervals over whole clusters against numbers computed by hand, SciPy and plain loops."""

import itertools
import math

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from copem_replay.metrics.limits import (
    MOST_GROUPS,
    alike_limits,
    describe_absent,
    describe_clusters,
    exact_limits,
    figure_variance,
    format_limits,
    group_clusters,
    limit_bounded_mean,
    limit_figure,
    limit_quantile,
    limit_share,
)
from copem_replay.metrics.summary import format_summary, summarise_rows
from tests.oracles import intervals as oracle

Array = npt.NDArray[np.float64]


def pair(limits: tuple[Array, Array]) -> tuple[float, float]:
    return float(limits[0]), float(limits[1])


# ------------------------------------------------------------------------------------ exact limits


def test_exact_limits_by_hand():
    # All of five, with probability p⁵ = 0.025; none of five, (1 − p)⁵ = 0.025.
    assert pair(exact_limits(5, 5)) == (pytest.approx(0.025**0.2), 1.0)
    assert pair(exact_limits(0, 5)) == (0.0, pytest.approx(1 - 0.025**0.2))
    assert pair(exact_limits(5, 5))[0] == pytest.approx(0.478176, abs=1e-6)
    # In between: of Beta(1, 1.5) the distribution is 1 − (1 − x)^1.5.
    assert pair(exact_limits(1, 1.5))[0] == pytest.approx(1 - 0.975 ** (1 / 1.5))


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_exact_limits_of_whole_numbers_are_those_of_clopper_and_pearson(trials: tuple[int, int]):
    k, n = trials
    expected = binomtest(k, n).proportion_ci(0.95, method="exact")
    assert pair(exact_limits(k, n)) == pytest.approx((expected.low, expected.high), abs=1e-8)


fractional = st.floats(1, 200).flatmap(lambda n: st.tuples(st.floats(0, 1).map(lambda share: share * n), st.just(n)))


@given(fractional)
def test_exact_limits_hold_their_share_and_are_mirrored_by_the_failures(trials: tuple[float, float]):
    k, n = trials
    low, high = pair(exact_limits(k, n))
    assert 0 <= low <= k / n + 1e-9
    assert k / n - 1e-9 <= high <= 1
    assert pair(exact_limits(n - k, n)) == pytest.approx((1 - high, 1 - low), abs=1e-7)


# ------------------------------------------------------------------------------------ shares


def test_three_logs_that_detect_all_are_as_many_objects_as_hang_together_a_little():
    # Three logs of five: m = 5, n/(1 + .2 · 4) = 15/1.8; low = .025^(1.8/15).
    assert pair(limit_share([5, 5, 5], [5, 5, 5], 15)) == (pytest.approx(0.025 ** (1.8 / 15)), 1.0)
    # Of one object each: n = 3. More runs of each change nothing.
    assert pair(limit_share([1, 1, 1], [1, 1, 1], 3)) == (pytest.approx(0.025 ** (1 / 3)), 1.0)
    assert pair(limit_share([900, 900, 900], [900, 900, 900], 3)) == (pytest.approx(0.025 ** (1 / 3)), 1.0)


def test_logs_that_contradict_each_other_are_few_objects():
    # All of ten, none of ten, five of ten: p = .5, v = 3/2 · (5² + 5²)/30² = 1/12, p(1 − p)/v = 3; t of 29 degrees is
    # 2.045230, of 2 4.302653: 3 · .225949 = .677848, and less than one object there is not.
    assert pair(limit_share([10, 0, 5], [10, 10, 10], 30)) == pytest.approx(oracle.exact(0.5, 1.0))
    # 7, 5 and 6 of 10: p = .6, v = 3/2 · 2/900 = 1/300, p(1 − p)/v = 72 · .225949 = 16.27 > 30/2.8.
    assert pair(limit_share([7, 5, 6], [10, 10, 10], 30)) == pytest.approx(oracle.exact(0.6, 30 / 2.8))
    # 9, 3, 6: v = 3/2 · 18/900 = .03, .24/.03 · .225949 = 1.807593.
    assert pair(limit_share([9, 3, 6], [10, 10, 10], 30)) == pytest.approx(oracle.exact(0.6, 1.807593), abs=1e-5)


def test_unequal_logs_by_hand():
    # 4 of 4, 1 of 1, 0 of 1: n = 6, p = 5/6, m = 18/6 = 3, 6/1.4 = 4.2857; residuals 2/3, 1/6, −5/6: v =
    # 3/2 · (42/36)/36 = 7/144, p(1 − p)/v = 20/7; t of 5 degrees is 2.570582: · .356936 = 1.019817.
    expected = oracle.exact(5 / 6, 1.019817)
    assert pair(limit_share([4, 1, 0], [4, 1, 1], 6)) == pytest.approx(expected, abs=1e-5)


logs = st.lists(
    st.integers(1, 9).flatmap(lambda w: st.tuples(st.floats(0, 1).map(lambda p: p * w), st.just(w))),
    min_size=3, max_size=12,
)  # fmt: skip


@given(logs)
def test_limits_of_shares_are_those_of_the_plain_formula(clusters: list[tuple[float, float]]):
    successes, objects = np.array(clusters).T
    found = pair(limit_share(successes, objects, objects.sum()))
    assert found == pytest.approx(oracle.share(clusters), abs=1e-7)
    share = successes.sum() / objects.sum()
    assert found[0] - 1e-9 <= share <= found[1] + 1e-9


@given(logs, st.permutations(range(12)), st.integers(2, 50))
def test_neither_the_order_of_logs_nor_more_runs_change_limits(
    clusters: list[tuple[float, float]], order: list[int], runs: int
):
    successes, objects = np.array(clusters).T
    once = pair(limit_share(successes, objects, objects.sum()))
    shuffled = [k for k in order if k < len(clusters)]
    assert pair(limit_share(successes[shuffled], objects[shuffled], objects.sum())) == pytest.approx(once, abs=1e-9)
    assert pair(limit_share(successes * runs, objects * runs, objects.sum())) == pytest.approx(once, abs=1e-9)


@given(logs)
def test_failures_have_the_mirrored_interval(clusters: list[tuple[float, float]]):
    successes, objects = np.array(clusters).T
    low, high = pair(limit_share(successes, objects, objects.sum()))
    assert pair(limit_share(objects - successes, objects, objects.sum())) == pytest.approx(
        (1 - high, 1 - low), abs=1e-6
    )


def test_many_studies_at_once_are_each_by_itself():
    rng = np.random.default_rng(3)
    objects = rng.integers(0, 5, (2, 7, 4)) * 1.0 + [1, 0, 1, 1]
    successes = objects * rng.random((2, 7, 4))
    low, high = limit_share(successes, objects, objects.sum(axis=-1))
    for a, b in itertools.product(range(2), range(7)):
        there = objects[a, b] > 0  # a log without objects is none
        of = list(zip(successes[a, b][there], objects[a, b][there], strict=True))
        assert (low[a, b], high[a, b]) == pytest.approx(oracle.share(of), abs=1e-8)


# ------------------------------------------------------------------------------------ other figures


def test_three_equal_logs_have_the_ordinary_interval_of_their_mean():
    # 1, 2 and 6: mean 3, variance 7, 3 ± 4.302653 · √(7/3); without each: 4, 3.5, 1.5.
    low, high = pair(limit_figure(3.0, np.array([4.0, 3.5, 1.5]), np.ones(3)))
    assert (low, high) == pytest.approx((3 - 4.302653 * math.sqrt(7 / 3), 3 + 4.302653 * math.sqrt(7 / 3)), abs=1e-5)
    assert pair(limit_figure(3.0, np.array([4.0, 3.5, 1.5]), np.ones(3), (0.0, 5.0))) == (0.0, 5.0)


@pytest.mark.parametrize("K", [2, 3, 5, 20])
def test_equal_logs_leave_one_degree_of_freedom_less(K):
    df = figure_variance(np.asarray(0.0), np.arange(float(K)), np.full(K, 7.0))[1]
    assert float(df) == pytest.approx(K - 1)


def test_a_log_that_has_nearly_all_leaves_little_more_than_one_degree_of_freedom():
    # Weights 2, 1, 1: n = 4, Q = BBᵀ written out: diag 1/2 · (1/4), …
    variance, df = figure_variance(np.asarray(1.0), np.array([0.0, 1.5, 1.5]), np.array([2.0, 1.0, 1.0]))
    # e = 2 · 1, 3 · −.5, 3 · −.5: (4/.5 + 2.25/.75 · 2)/16.
    assert float(variance) == pytest.approx((8 + 6) / 16)
    w = np.array([2.0, 1.0, 1.0])
    B = np.diag((1 - w / 4) ** -0.5) @ (np.diag(w) - np.outer(w, w) / 4)
    assert float(df) == pytest.approx(np.trace(B @ B.T) ** 2 / np.trace(B @ B.T @ B @ B.T))
    assert 1 < float(df) < 2


figures = st.lists(st.tuples(st.floats(-50, 50), st.integers(1, 30)), min_size=2, max_size=9)


@given(figures)
def test_limits_of_means_are_those_of_the_plain_formula(clusters: list[tuple[float, int]]):
    sums, weights = np.array([x * w for x, w in clusters]), np.array([w for _, w in clusters], dtype=float)
    value = sums.sum() / weights.sum()
    without = (sums.sum() - sums) / (weights.sum() - weights)
    low, high = pair(limit_figure(value, without, weights))
    assert (low, high) == pytest.approx(oracle.figure(value, without, weights), abs=1e-6, rel=1e-6)
    assert low <= value <= high
    order = np.argsort(sums, kind="stable")
    again = pair(limit_figure(value, without[order], weights[order]))
    assert again == pytest.approx((low, high), abs=1e-6)
    scaled = pair(limit_figure(value, without, weights * 12))  # weights count by their ratio
    assert scaled == pytest.approx((low, high), abs=1e-6)


def test_many_clusters_make_groups_of_neighbours():
    assert group_clusters(3).tolist() == [0, 1, 2]
    assert group_clusters(MOST_GROUPS).tolist() == list(range(MOST_GROUPS))
    many = group_clusters(1001)
    assert np.unique(many).tolist() == list(range(MOST_GROUPS))
    assert (np.diff(many) >= 0).all()
    assert set(np.bincount(many).tolist()) == {5, 6}


# ------------------------------------------------------------------------------------ means between bounds


@given(st.integers(3, 60).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))), st.sampled_from([0.9, 0.95]))
def test_a_mean_of_values_0_and_1_has_the_limits_of_clopper_and_pearson(trials: tuple[int, int], confidence: float):
    k, n = trials
    values = np.array([1.0] * k + [0.0] * (n - k))
    found = pair(limit_bounded_mean(k / n, (k - values) / (n - 1), np.ones(n), (0.0, 1.0), confidence=confidence))
    expected = binomtest(k, n).proportion_ci(confidence, method="exact")
    assert found == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_five_objects_that_are_all_known_at_once_exclude_little():
    """Five at 0 of a horizon of 5 s: as none of five, up to 1 − .025^(1/5) = .5218 of such objects may be at 5 s."""
    low, high = pair(limit_bounded_mean(0.0, np.zeros(5), np.ones(5), (0.0, 5.0)))
    assert (low, high) == (0.0, pytest.approx(5 * (1 - 0.025**0.2)))
    # Half of the weight is followed: the object not seen weighs two, and two of seven parts are drawn beyond.
    assert pair(limit_bounded_mean(0.0, np.zeros(5), np.ones(5), (0.0, 5.0), 0.5))[1] > high


some_means = st.lists(st.tuples(st.floats(0, 5), st.integers(1, 60)), min_size=2, max_size=30)


@given(some_means, st.floats(0.05, 1), st.sampled_from([0.8, 0.95, 0.99]))
def test_limits_of_means_between_bounds_are_those_of_the_plain_formula(
    clusters: list[tuple[float, int]], followed: float, confidence: float
):
    values, weights = np.array(clusters).T
    value = float(values @ weights / weights.sum())
    without = (value * weights.sum() - values * weights) / (weights.sum() - weights)
    low, high = pair(limit_bounded_mean(value, without, weights, (0.0, 5.0), followed, confidence))
    expected = oracle.bounded(value, without.tolist(), weights.tolist(), 0.0, 5.0, followed, confidence)
    assert (low, high) == pytest.approx(expected, abs=1e-9)
    assert 0 <= low <= value + 1e-9
    assert value - 1e-9 <= high <= 5
    mirrored = pair(limit_bounded_mean(5 - value, 5 - without, weights, (0.0, 5.0), followed, confidence))
    assert mirrored == pytest.approx((5 - high, 5 - low), abs=1e-7)


# ------------------------------------------------------------------------------------ quantiles


def test_a_median_of_eight_is_between_the_first_and_the_last():
    """Of eight objects in one log: a half is possible from one of eight (high .5265) to seven (low .4735)."""
    values = np.array([-math.inf, *range(8)])
    shares = np.tril(np.ones((9, 8)), -1)
    low, high = limit_share(shares, np.ones((9, 8)))
    for k in range(9):
        assert (low[k], high[k]) == pytest.approx(oracle.share([(float(i < k), 1.0) for i in range(8)]))
    assert limit_quantile(values, low, high) == (0.0, 7.0)
    # Three tell no limit: with none at or below a value, up to .708 may be; with all, from .292 on.
    few = limit_share(np.tril(np.ones((4, 3)), -1), np.ones((4, 3)))
    assert limit_quantile(values[:4], *few) == (-math.inf, math.inf)


def test_a_limit_that_does_not_ascend_is_taken_conservatively():
    values, high = np.arange(4.0), np.array([0.4, 0.6, 0.4, 1.0])
    assert limit_quantile(values, np.array([0.0, 0.5, 0.4, 0.7]), high) == (1.0, 3.0)
    assert limit_quantile(values, np.array([0.0, 0.5, 0.5, 0.7]), high, 0.9) == (3.0, math.inf)


# ------------------------------------------------------------------------------------ differences that are all alike


def test_a_difference_that_is_the_same_in_five_objects_by_hand():
    assert alike_limits(0.0, np.ones(5)) == pytest.approx((-0.521824, 0.521824), abs=1e-6)
    assert alike_limits(1.0, np.ones(5)) == pytest.approx((0.478176, 1.0), abs=1e-6)
    assert alike_limits(-1.0, np.ones(5)) == pytest.approx((-1.0, -0.478176), abs=1e-6)
    # Three logs of five: 15/1.8 objects.
    assert alike_limits(1.0, np.full(3, 5.0)) == pytest.approx((0.025 ** (1.8 / 15), 1.0))


some_weights = st.lists(st.integers(1, 40), min_size=1, max_size=9).map(lambda w: np.array(w, dtype=float))


@given(st.floats(-1, 1), some_weights)
def test_limits_of_alike_differences_are_mirrored_hold_it_and_stay_possible(difference: float, weights: Array):
    low, high = alike_limits(difference, weights)
    assert -1 - 1e-9 <= low <= difference + 1e-9
    assert difference - 1e-9 <= high <= 1 + 1e-9
    assert alike_limits(-difference, weights) == pytest.approx((-high, -low), abs=1e-12)


@given(st.floats(0, 0.99), some_weights)
def test_a_little_more_of_a_difference_changes_its_limits_a_little(difference: float, weights: Array):
    one, other = np.array(alike_limits(difference, weights)), np.array(alike_limits(difference + 1e-4, weights))
    assert (other >= one - 1e-9).all()
    assert other == pytest.approx(one, abs=0.02)


# ------------------------------------------------------------------------------------ words


def test_what_a_sample_cannot_exclude():
    # .95 that eight have one: 1 − (1 − x)⁸, x = .312344; of three .631597.
    assert describe_absent(8) == "a kind of drive that makes up to 31 % of such traffic can be absent"
    assert describe_absent(3) == "a kind of drive that makes up to 63 % of such traffic can be absent"


def test_an_interval_says_what_it_is_over():
    assert describe_clusters("logs", 8) == "8 logs: how far other drives of this kind may differ"
    assert describe_clusters("logs", 8, 8) == describe_clusters("logs", 8)
    assert describe_clusters("logs", 8, 5).startswith("5 to 8 logs: ")
    assert describe_clusters("objects", 12).startswith("12 objects of this drive: ")
    assert "nothing about other drives" in describe_clusters("objects")
    assert describe_clusters("runs", 1).startswith("1 run of this one object: ")
    assert describe_clusters("runs", 20, driving=True) == (
        "20 runs of the driving: how far other draws of the same models may differ; nothing about other drives"
    )
    assert describe_clusters("logs", 8, driving=True) == describe_clusters("logs", 8)
    assert describe_clusters("passes", 9).startswith("9 passes of this one object: how far other passes of this object")


# ------------------------------------------------------------------------------------ the summary


def rows_of(detected: list[list[bool]]) -> pd.DataFrame:
    """Rows of one configuration, an object each with its runs, that are looked at for 2 s and known at 1 s or never."""
    found = pd.DataFrame(
        [
            {"object_id": str(k), "run": run, "detected": known, "time_to_detection_s": 1.0 if known else math.nan}
            for k, of_object in enumerate(detected)
            for run, known in enumerate(of_object)
        ]
    )
    return found.assign(log="a", configuration="c", episode=0, onset_s=0.0, ended_s=2.0, ended_by="object_left",
                        distance_at_detection_m=5.0)  # fmt: skip


def test_the_summary_of_five_objects_that_are_always_detected() -> None:
    table, notes = summarise_rows(rows_of([[True] * 20] * 5), ["c"], {"c": 10.0}, horizon_s=2.0)
    (row,) = table.to_dict("records")
    assert (row["detected_share_low"], row["detected_share_high"]) == (pytest.approx(0.025**0.2), 1.0)
    assert (row["interval"], row["interval_over"], row["interval_clusters"], notes) == ("exact", "objects", 5, [])
    lines = format_summary(table).splitlines()
    assert "[0.478, 1]" in lines[1]
    assert any(line.startswith("95 %: exact binomial limits over 5 objects of this drive: ") for line in lines)
    assert not any("absent" in line for line in lines)


def drives(shares: list[list[float]], runs: int = 4) -> pd.DataFrame:
    """A log each, objects with the share of their runs in which they are detected."""
    return pd.concat(
        [rows_of([[r < share * runs for r in range(runs)] for share in of]).assign(log=f"log {k}")
         for k, of in enumerate(shares)], ignore_index=True,
    )  # fmt: skip


def test_the_summary_of_three_logs_counts_objects() -> None:
    shares = [[1.0, 0.5, 0.75], [1.0], [0.25, 0.5]]
    table, notes = summarise_rows(drives(shares), ["c"], {"c": 10.0}, horizon_s=2.0)
    (row,) = table.to_dict("records")
    expected = oracle.share([(sum(of), len(of)) for of in shares])
    assert (row["detected_share_low"], row["detected_share_high"]) == pytest.approx(expected)
    assert (row["interval_over"], row["interval_clusters"], notes) == ("logs", 3, [])
    lines = format_summary(table).splitlines()
    assert any("over 3 logs: how far other drives of this kind may differ" in line for line in lines)
    assert any("up to 63 % of such traffic can be absent" in line for line in lines)
    more, _ = summarise_rows(drives(shares, runs=40), ["c"], {"c": 10.0}, horizon_s=2.0)
    limits = ["detected_share_low", "detected_share_high"]
    assert more[limits].to_numpy() == pytest.approx(table[limits].to_numpy())


def test_two_logs_have_no_interval_whatever_is_in_them() -> None:
    table, notes = summarise_rows(drives([[1.0] * 9, [0.5] * 9]), ["c"], {"c": 10.0}, horizon_s=2.0)
    assert table[["detected_share_low", "interval", "interval_over", "interval_clusters"]].isna().all(axis=None)
    (note,) = notes
    assert note.startswith("no interval of the detected share: 2 logs, fewer than 3; ")


def test_one_object_has_the_binomial_interval_of_its_runs() -> None:
    table, _ = summarise_rows(drives([[0.75]], runs=20), ["c"], {"c": 10.0}, horizon_s=2.0)
    (row,) = table.to_dict("records")
    expected = binomtest(15, 20).proportion_ci(0.95, method="exact")
    assert (row["detected_share_low"], row["detected_share_high"]) == pytest.approx((expected.low, expected.high))
    assert (row["interval"], row["interval_over"], row["interval_clusters"]) == ("exact", "runs", 20)


def passes(shares: list[float], runs: int) -> pd.DataFrame:
    """Episodes of one object."""
    rows = rows_of([[r < share * runs for r in range(runs)] for share in shares])
    return rows.assign(episode=rows["object_id"].astype(int), object_id="rtk")


def test_passes_of_one_object_are_the_clusters_and_runs_are_never_more_than_there_are() -> None:
    """9 of 10 passes known in 20 runs each are ten trials, not 200; of 4 passes 20 runs are 20 trials, not 80."""
    runs = binomtest(15, 20).proportion_ci(0.95, method="exact")
    for shares, over, clusters, limits in (
        ([1.0] * 9 + [0.0], "passes", 10, oracle.share([(1.0, 1.0)] * 9 + [(0.0, 1.0)])),
        ([1.0] * 3 + [0.0], "runs", 20, (runs.low, runs.high)),
    ):
        table, _ = summarise_rows(passes(shares, 20), ["c"], {"c": 10.0}, horizon_s=2.0)
        (row,) = table.to_dict("records")
        assert (row["detected_share_low"], row["detected_share_high"]) == pytest.approx(limits)
        assert (row["interval_over"], row["interval_clusters"]) == (over, clusters)


def test_limits_have_three_digits_and_no_exponent():
    assert format_limits(5.4217e-05, 1.4349) == "[0.0000542, 1.43]"
    assert format_limits(-0.1, 100.0) == "[-0.1, 100]"
    assert format_limits(-1234.5, 999.6) == "[-1234, 1000]"
    assert format_limits(-math.inf, 1e-12) == "[–, 0]"
    assert format_limits(math.nan, 0.99962) == "[–, 1]"
