"""How many would decide: numbers by hand, and by counting what studies of that size show."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from copem_replay.metrics.limits import BOUNDED, EXACT, INVERTED, JACKKNIFE, LimitedFigure, limit_bounded_mean
from copem_replay.metrics.needed import (
    Known,
    count_at_best,
    count_deciding,
    count_for_figure,
    count_for_mean,
    count_for_share,
    count_in_logs,
    find_enough_horizon,
    find_level,
    find_spread,
)


@pytest.mark.parametrize(("bound", "number"), [(0.8, 17), (0.9, 36), (0.95, 72), (0.99, 368)])
def test_of_a_share_without_a_miss_so_many_are_enough_and_one_less_is_not(bound: float, number: int) -> None:
    """B^n ≤ .025, by hand; the exact limits of n of n are beyond the bound from there on."""
    assert math.ceil(count_for_share(1.0, bound)) == math.ceil(count_for_share(0.0, 1.0 - bound)) == number
    lows = [binomtest(n, n).proportion_ci(0.95, "exact").low for n in (number - 1, number)]
    assert lows[0] < bound <= lows[1]


@pytest.mark.parametrize(("share", "bound", "number"), [(0.99, 0.95, 188), (0.98, 0.95, 363), (0.98, 0.9, 90)])
def test_of_a_share_beyond_the_bound_four_of_five_studies_show_it(share: float, bound: float, number: int) -> None:
    found = count_for_share(share, bound)
    assert round(found) == pytest.approx(number, abs=1)
    n = math.ceil(found)
    shows = [k for k in range(n + 1) if binomtest(k, n).proportion_ci(0.95, "exact").low >= bound]
    assert 0.75 <= float(binom.pmf(shows, n, share).sum()) <= 0.97


def test_logs_of_several_objects_tell_less_than_so_many_objects() -> None:
    """(1 + .2·(m − 1))/m of 72 objects."""
    logs = [count_in_logs(count_for_share(1.0, 0.95), Known("logs", 4, 4 * m)) for m in (1, 5, 20)]
    assert [math.ceil(one) for one in logs] == [72, 26, 18]
    assert count_in_logs(72.0, Known("objects", 9, 9)) == 72.0


@pytest.mark.parametrize(("most", "number"), [(5.0, 39), (2.0, 11)])
def test_of_a_mean_that_all_have_the_far_end_decides(most: float, number: int) -> None:
    """Mean .6, bound 1: (h − .6)(1 − .025^{1/K}) ≤ .4, by hand from K = 39 on, at a horizon of 2 s from 11."""
    assert count_for_mean(0.6, 1.0, (0.0, most), 0.0) == number
    for K, shown in ((number - 1, False), (number, True)):
        _, high = limit_bounded_mean(0.6, np.full(K, 0.6), np.ones(K), (0.0, most))
        assert (float(high) <= 1.0) == shown


def test_four_of_five_studies_of_a_mean_show_it() -> None:
    rng, spread = np.random.default_rng(1), 0.3
    K = math.ceil(count_for_mean(0.5, 1.0, (0.0, 5.0), spread))
    y = np.clip(rng.normal(0.5, spread, (400, K)), 0.0, 5.0)
    value = y.mean(axis=1)
    without = (K * value[:, None] - y) / (K - 1)
    _, high = limit_bounded_mean(value, without, np.ones_like(y), (0.0, 5.0))
    assert float((high <= 1.0).mean()) >= 0.72


def test_a_mean_beyond_the_bound_is_asked_from_the_other_end() -> None:
    assert count_for_mean(4.4, 4.0, (0.0, 5.0), 0.0) == count_for_mean(0.6, 1.0, (0.0, 5.0), 0.0)


def test_a_figure_needs_the_square_of_what_its_interval_is_too_wide() -> None:
    """((1.96 + .84)/1.96 · 2)² times as many, to show with four chances in five what is half as far away."""
    assert count_for_figure(1.0, 2.0, 2.0, 8) == pytest.approx(8 * (4 * (1 + 0.8416 / 1.95996)) ** 2 / 4, rel=1e-4)
    assert count_for_figure(1.0, 1.0, 2.0, 8) == count_for_share(0.9, 0.9) == math.inf
    assert count_for_mean(1.0, 1.0, (0.0, 5.0), 0.1) == math.inf
    assert find_spread(-1.0, 1.0, 9) == pytest.approx(3 / 2.306004, rel=1e-6)


def test_each_kind_of_figure_is_asked_by_its_own_limits() -> None:
    known = Known("objects", 13, 13)
    mean = LimitedFigure(0.6, 0.2, 2.0, BOUNDED, None, (0.0, 5.0), 0.0)
    assert count_deciding("ttd_rmst_s", mean, 1.0, known) == 39
    share = LimitedFigure(1.0, 0.75, 1.0, EXACT)
    assert count_deciding("detected_share", share, 0.95, known) == 72
    quantile = LimitedFigure(0.2, 0.0, math.inf, INVERTED, (0.75, 1.0, 1.0))
    assert count_deciding("ttd_p95_s", quantile, 0.5, known) == count_deciding("dad_p5_m", quantile, 9.0, known) == 72
    other = LimitedFigure(1.0, 0.0, 2.0, JACKKNIFE)
    assert count_deciding("nees", other, 2.0, known) == math.ceil(count_for_figure(1.0, 2.0, 1.0, 13))
    assert count_deciding("nees", other, 1.0, known) is None
    paired = LimitedFigure(-0.02, -0.1, 0.06, EXACT)  # of shares, with a bound that no share has
    found = count_deciding("pass_share", paired, -0.05, known, paired=True)
    assert found == math.ceil(count_for_figure(-0.02, -0.05, 0.08, 13))
    assert count_for_share(0.5, -0.1) == count_for_share(1.0, 1.5) == math.inf


def test_what_no_one_can_show_is_told_before_the_run() -> None:
    objects = Known("objects", 13, 13)
    assert count_at_best("detected_share", "at_least", 0.9, 5.0, objects) == 36
    assert count_at_best("left_undetected_share", "at_most", 0.1, 5.0, objects) == 36
    assert count_at_best("ttd_p95_s", "at_most", 0.5, 5.0, objects) == 72
    assert count_at_best("ttd_median_s", "at_most", 0.5, 5.0, objects) is None  # 6 can
    assert count_at_best("ttd_rmst_s", "at_most", 1.0, 5.0, objects) == 17
    enough_s = find_enough_horizon("ttd_rmst_s", 1.0, objects)
    assert enough_s is not None
    assert count_at_best("ttd_rmst_s", "at_most", 1.0, enough_s * 0.999, objects) is None
    assert count_at_best("ttd_rmst_s", "at_most", 1.0, enough_s * 1.1, objects) is not None
    assert count_at_best("position_rmse_m", "at_most", 1.0, 5.0, objects) is None
    assert find_enough_horizon("detected_share", 0.9, objects) is None


def test_levels_are_of_the_side_that_is_wanted() -> None:
    """95 % are known by the p95 of times, and 95 % farther away than the p5 of distances."""
    assert [find_level(name) for name in ("ttd_p95_s", "ttd_median_s", "dad_p5_m", "conflict_dad_median_m")] == [
        0.95, 0.5, 0.95, 0.5,
    ]  # fmt: skip
    assert find_level("ttd_rmst_s") is None
