"""Moments of errors and their intervals: by hand, by plain sums over all pairs of rows, and by drawing again."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, t

from copem_replay.extras.fitting.error_memory import ALLOWED, MemoryShares, ResidualSeries, sum_correlations
from copem_replay.extras.fitting.moments import (
    RangeBin,
    count_effective,
    estimate_bin,
    fit_moments,
    lag_one_correlation,
    mean_half_width,
    range_bins,
)
from tests.extras.fitting.detection_rows import view_of

ALL = (RangeBin((0.0, 100.0)),)


def begins(*lengths: int) -> np.ndarray:
    """Where passes of these lengths begin."""
    return np.concatenate([np.arange(length) == 0 for length in lengths])


def series_of(*lengths: int) -> ResidualSeries:
    new = begins(*lengths)
    return ResidualSeries(np.where(new, 0.0, 0.1), new)


def test_the_correlation_of_neighbours_is_within_passes_and_corrected() -> None:
    """1, 1, −1, −1: ⅓ of three pairs, and (1 + 4/3)/4 more; in two as 1, −1 | 1, 1: 0 and ¼ more; .9999 at most."""
    assert lag_one_correlation(np.array([1.0, 1, -1, -1]), begins(4)) == pytest.approx(11 / 12)
    assert lag_one_correlation(np.array([1.0, -1, 1, 1]), begins(2, 2)) == pytest.approx(1 / 4)
    assert lag_one_correlation(np.array([1.0, 1, -1, -1]), begins(2, 2)) == 0.9999
    assert lag_one_correlation(np.array([1.0, -1, 1, -1]), begins(4)) == 0.0
    assert lag_one_correlation(np.ones(3), begins(1, 1, 1)) == 0.0


def test_effective_rows_of_a_mean() -> None:
    """φ ½: three rows have Σ φ^|i−j| = 3 + 4·½ + 2·¼ = 5.5, one more pass of one row 6.5."""
    assert count_effective(0.5, np.array([3])) == pytest.approx(9 / 5.5)
    assert count_effective(0.5, np.array([3, 1])) == pytest.approx(16 / 6.5)
    assert count_effective(0.0, np.array([7, 5])) == pytest.approx(12)


def test_equal_passes_are_students_interval_of_their_means() -> None:
    """Five passes of one row: t₄ s/√5. Two of two rows at 1 and −1: V = 1 of one degree of freedom."""
    rest = np.array([2.0, -1, -1, 0, 0])
    assert mean_half_width(rest, begins(1, 1, 1, 1, 1), 0.0, 1.5) == pytest.approx(2.7764 * np.sqrt(1.5 / 5), rel=1e-4)
    assert mean_half_width(np.array([1.0, 1, -1, -1]), begins(2, 2), 0.0, 1.0) == pytest.approx(12.706, rel=1e-4)


def test_few_passes_have_the_wider_and_one_has_the_autoregression() -> None:
    """Passes that agree by chance do not make a mean sure while there are fewer than five; one pass has φ alone."""
    rest, phi = np.tile([1.0, -1.0], 8), 0.5
    for lengths in ((16,), (8, 8), (4, 4, 4, 4)):
        effective = count_effective(phi, np.array(lengths))
        expected = t.ppf(0.975, effective - 1) * np.sqrt(2.0 / effective)
        assert mean_half_width(rest, begins(*lengths), phi, 2.0) == pytest.approx(expected)
    assert mean_half_width(rest, begins(4, 4, 4, 2, 2), phi, 2.0) == pytest.approx(0.0, abs=1e-12)


def test_unequal_passes_against_sums_over_all_rows() -> None:
    """V, and the degrees of freedom that it has under an autoregression, from the covariance of all rows."""
    lengths, phi = (3, 9, 2, 14, 6), 0.7
    new = begins(*lengths)
    n, number = len(new), np.cumsum(new) - 1
    rest = np.random.default_rng(0).normal(size=n)
    rest -= rest.mean()
    covariance = np.array([[phi ** abs(i - j) * (number[i] == number[j]) for j in range(n)] for i in range(n)])
    square, each = 0.0, []
    for g, w in enumerate(lengths):
        of_rows = ((number == g) - w / n) / np.sqrt(1 - w / n)
        each.append(of_rows)
        square += (rest[number == g].sum() ** 2) / (1 - w / n) / n**2
    q = np.array([[a @ covariance @ b for b in each] for a in each])
    expected = t.ppf(0.975, np.trace(q) ** 2 / np.trace(q @ q)) * np.sqrt(square)
    assert mean_half_width(rest, new, phi, 1.0) == pytest.approx(expected, rel=1e-9)


def test_a_variance_is_over_the_rows_less_those_of_its_mean() -> None:
    """−1, 0, 1 without memory: 2/(3 − 1); two degrees of freedom, fewer than 3(1 − φ²)/(1 + φ²) = 2.4 at φ = ⅓."""
    error_m = np.array([[-1.0, 1], [0, 0], [1, -1]])
    found = fit_moments(error_m, np.zeros(3, dtype=int), ALL, series_of(3), MemoryShares())
    assert found.covariance_m2[0, 0, 0] == pytest.approx(1.0)
    assert found.freedom[0, 0] == pytest.approx(2.0)


def test_without_memory_a_variance_counts_what_neighbours_share() -> None:
    """Rows 2, 2, −2, −2, … : a φ of .53 leaves fewer of them."""
    error_m = np.tile([2.0, 2, -2, -2], 25)[:, None] * [1.0, 1.0] + np.random.default_rng(0).normal(size=(100, 2))
    found = fit_moments(error_m, np.zeros(100, dtype=int), ALL, series_of(100), MemoryShares())
    rest = error_m - error_m.mean(axis=0)
    for k in range(2):
        phi = sum(rest[i, k] * rest[i + 1, k] for i in range(99)) / 99 / (sum(rest[:, k] ** 2) / 100)
        phi += (1 + 4 * phi) / 100
        least = 100 * (1 - phi**2) / (1 + phi**2)
        assert found.freedom[0, k] == pytest.approx(min(least, 99.0), rel=1e-9)
    bin_ = range_bins(view_of(np.full(100, 20.0), np.ones(100)), 1.0)[0]
    variance = estimate_bin(bin_, found, 0).covariance_m2[0]
    low, high = found.freedom[0, 0] * variance.value / chi2.ppf([0.975, 0.025], found.freedom[0, 0])
    assert (variance.low, variance.high) == pytest.approx((low, high))


def test_pairs_of_a_series() -> None:
    """Two rows with φ ½, drift ½, constant ¼: ρ = ½, so Σρ = 3 and Σρ² = 2.5."""
    new, decay = begins(2), np.array([1.0, 0.5])
    found = sum_correlations(decay, new, np.zeros(2, dtype=int), 1, 0.5, 0.25)
    assert found[:, 0] == pytest.approx([3.0, 2.5])


def test_white_noise_is_refused_at_the_usual_level() -> None:
    """Half of the 95 % quantiles of χ² with as many degrees of freedom as the models differ in."""
    three, two = chi2.ppf(0.95, [3, 2]) / 2
    assert {
        "none": pytest.approx(three, abs=1e-3), "constant": pytest.approx(two, abs=1e-3),
        "drift": pytest.approx(chi2.ppf(0.95, 1) / 2), "both": 0.0,
    } == ALLOWED  # fmt: skip


@pytest.mark.parametrize("lengths", [(60,) * 6, (20, 40, 60, 80, 100, 60, 30), (120, 120, 120)])
def test_means_are_held_although_no_memory_is_written(lengths: tuple[int, ...]) -> None:
    """400 recordings of an autoregression of φ .95: an interval from independent rows holds a third of the means."""
    rng, new = np.random.default_rng(1), begins(*lengths)
    n, held, zeros = len(new), 0, np.zeros(len(new), dtype=int)
    for _ in range(400):
        error_m = rng.normal(size=(n, 2))
        for k in range(1, n):
            if not new[k]:
                error_m[k] = 0.95 * error_m[k - 1] + np.sqrt(1 - 0.95**2) * error_m[k]
        found = fit_moments(error_m, zeros, ALL, series_of(*lengths), MemoryShares())
        held += int((np.abs(found.mean_m[0]) <= found.half_width_m[0]).sum())
    assert held / 800 >= 0.92


def test_bins_are_drawn_towards_those_of_their_class() -> None:
    """Two bins of the same spread become equal, that of another class, a tenth of it, keeps its own."""
    rng = np.random.default_rng(0)
    where = (RangeBin((0, 20), of_class="car"), RangeBin((20, 40), of_class="car"), RangeBin((0, 40), of_class="bus"))
    bin_ix = np.repeat([0, 1, 2], 40)
    error_m = rng.normal(size=(120, 2)) * np.where(bin_ix == 2, 0.1, 1.0)[:, None]
    found = fit_moments(error_m, bin_ix, where, series_of(*[1] * 120), MemoryShares())
    near, far, other = found.covariance_m2[:, 0, 0]
    own = [error_m[bin_ix == b, 0].var(ddof=1) for b in range(3)]
    assert abs(near - far) < 0.2 * abs(own[0] - own[1]) + 1e-9
    assert other == pytest.approx(own[2], rel=1e-6)
