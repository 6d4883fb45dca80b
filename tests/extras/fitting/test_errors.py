"""Errors of entries: what was drawn is found again, with intervals that hold it."""

from dataclasses import replace

import numpy as np
import pytest
from statsmodels.tsa.statespace.sarimax import SARIMAX

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import CLASSES
from copem_replay.core.yaml import strip_comments
from copem_replay.extras.fitting.error_memory import (
    MemoryShares,
    ResidualSeries,
    fit_error_memory,
    log_likelihood,
    whiten_series,
)
from copem_replay.extras.fitting.errors import fit_errors, gaussian_share, remove_pose, weigh_covariances
from copem_replay.extras.fitting.estimate import Estimate
from copem_replay.extras.fitting.moments import RangeBin, fit_moments
from copem_replay.extras.fitting.pose import PoseFit
from copem_replay.extras.fitting.rows import FitLists, FitRows
from copem_replay.perception.pem.error import Gaussian, StudentT
from tests.extras.fitting.fit_rows import lasting_normals, rows_of

ERRORS_M = ("along_m", "across_m", "east_m", "north_m")


def _series(rng: np.random.Generator, count: int, lists: int, **of: float) -> tuple[np.ndarray, ResidualSeries]:
    gap_s = rng.uniform(0.05, 0.15, count * lists)
    new = np.arange(count * lists) % lists == 0
    gap_s[new] = 0.0
    each = [lasting_normals(rng, np.cumsum(gap_s[k * lists : (k + 1) * lists]), **of, columns=2) for k in range(count)]
    return np.concatenate(each), ResidualSeries(gap_s, new)


def test_the_likelihood_of_a_drift_and_white_noise_is_that_of_statsmodels() -> None:
    rng = np.random.default_rng(3)
    z = rng.normal(size=60).cumsum() / 4
    drift, tau_s, gap_s = 0.7, 0.8, 0.1
    phi = np.exp(-gap_s / tau_s)
    model = SARIMAX(z, order=(1, 0, 0), measurement_error=True)
    expected = model.loglike([phi, 1 - drift, drift * (1 - phi**2)])
    series = ResidualSeries(np.where(np.arange(60) == 0, 0.0, gap_s), np.arange(60) == 0)
    out, variance = whiten_series(z[:, None], series, MemoryShares(drift, tau_s))
    found = -0.5 * float((out**2).sum() + np.log(variance).sum() + 60 * np.log(2 * np.pi))
    assert found == pytest.approx(expected, abs=1e-6)


def test_the_likelihood_with_uneven_lists_and_a_constant_is_that_of_the_dense_covariance() -> None:
    rng = np.random.default_rng(4)
    z, series = _series(rng, 3, 7, drift=0.5, tau_s=0.4, constant=0.3)
    shares = MemoryShares(0.5, 0.4, 0.3)
    covariance = np.zeros((21, 21))
    for k in range(3):
        at = np.cumsum(series.gap_s[7 * k : 7 * k + 7])
        apart = np.abs(at[:, None] - at)
        covariance[7 * k : 7 * k + 7, 7 * k : 7 * k + 7] = 0.5 * np.exp(-apart / 0.4) + 0.3 + 0.2 * np.eye(7)
    inverse, one, total = np.linalg.inv(covariance), np.ones(21), 0.0
    for column in z.T:  # REML: the mean and the scale integrated out
        rest = column - (one @ inverse @ column) / (one @ inverse @ one)
        total -= 0.5 * (np.linalg.slogdet(covariance)[1] + np.log(one @ inverse @ one))
        total -= 10 * np.log(rest @ inverse @ rest / 20)
    assert log_likelihood(z, series, shares, centred=True) == pytest.approx(total, abs=1e-8)


def test_drift_and_constant_are_found_again() -> None:
    z, series = _series(np.random.default_rng(1), 60, 80, drift=0.6, tau_s=1.0, constant=0.2)
    fit = fit_error_memory(z, series, centred=True)
    drifting, always = fit.parts
    assert always.correlation_s == "always"
    assert not isinstance(drifting.correlation_s, str)
    for estimate, true in ((drifting.share, 0.6), (drifting.correlation_s, 1.0), (always.share, 0.2)):
        assert estimate.low <= true <= estimate.high
        assert estimate.low <= estimate.value <= estimate.high
        assert estimate.high - estimate.low < 0.9 * true
    assert fit.untold is None


@pytest.mark.parametrize(
    ("drawn", "expected"),
    [
        ({"drift": 0.0, "tau_s": 1.0, "constant": 0.0}, "no memory"),
        ({"drift": 0.8, "tau_s": 400.0, "constant": 0.0}, "s or constant"),
    ],
)
def test_what_cannot_be_told_is_said(drawn: dict[str, float], expected: str) -> None:
    z, series = _series(np.random.default_rng(2), 12, 60, **drawn)
    fit = fit_error_memory(z, series, centred=True)
    assert fit.untold is not None
    assert expected in fit.untold
    assert fit.shares.drift == 0


@pytest.mark.parametrize("period_s", [3.0, 5.0, 12.0])
def test_a_single_smooth_series_has_intervals_of_some_width(period_s: float) -> None:
    """Hardly anything is new in a list, and a constant is in the mean of the only series: no part is told exactly."""
    at_s = np.arange(160) / 10
    turn = 2 * np.pi * at_s / period_s
    z = np.column_stack([np.sin(turn) + 0.3 * np.sin(2.3 * turn + 1), np.cos(1.1 * turn + 0.4) + 0.2 * np.sin(at_s)])
    series = ResidualSeries(np.where(at_s > 0, 0.1, 0.0), at_s == 0)
    [part] = fit_error_memory(z, series, centred=True).parts
    assert not isinstance(part.correlation_s, str)
    for one in (part.share, part.correlation_s):
        assert one.low <= one.value <= one.high
        assert one.high - one.low > 1e-6


@pytest.mark.long
def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    held = []
    for seed in range(20):
        rows, _ = rows_of(seed, passes=16, lists_each=60)
        fit = fit_errors(rows)
        [part] = fit.memory["position"]
        assert not isinstance(part.correlation_s, str)
        assert fit.yaw_sigma_deg is not None
        assert fit.size_sigma_m is not None
        expected = [
            (part.share, 0.6), (part.correlation_s, 1.0),
            (fit.yaw_sigma_deg, np.rad2deg(0.05)), (fit.size_sigma_m, 0.3),
        ]  # fmt: skip
        for one in fit.bins:
            expected += [(one.mean_m[0], 0.2), (one.mean_m[1], -0.1)]
            expected += [(one.covariance_m2[0], 0.16), (one.covariance_m2[2], 0.04)]
        held += [estimate.low <= true <= estimate.high for estimate, true in expected]
    assert len(held) >= 160
    assert np.mean(held) >= 0.88  # four standard errors below 0.95 of 160 numbers


def test_memory_is_declined_only_where_white_noise_is_not_refused() -> None:
    """Three passes drift and one is white: held out memory is no better, and yet errors last."""
    rows, _ = rows_of(2, passes=4, lists_each=150, memory=(0.9, 4.0, 0.0), mean_m=(0.0, 0.0), folds=4)
    white_m = np.random.default_rng(2).normal(0, 0.6, (2, len(rows.log))) + np.where(rows.listed, 0.0, np.nan)
    along_m, across_m = np.where(rows.pass_ix == 3, white_m, (rows.along_m, rows.across_m))
    cos, sin = np.cos(rows.view.bearing_rad), np.sin(rows.view.bearing_rad)
    mixed = replace(
        rows, along_m=along_m, across_m=across_m,
        east_m=cos * along_m - sin * across_m, north_m=sin * along_m + cos * across_m,
    )  # fmt: skip
    fit = fit_errors(mixed)
    without, with_memory = fit.ladder[-2:]
    assert without.score > with_memory.score
    assert with_memory.chosen
    assert fit.memory["position"]
    simplest = fit_errors(mixed, simplest=True)
    assert not simplest.memory["position"]
    for mean in (*fit.bins[0].mean_m, *simplest.bins[0].mean_m):
        assert mean.n_effective < 100
    white, _ = rows_of(2, passes=4, lists_each=150, memory=(0.0, 1.0, 0.0))
    assert not fit_errors(white).memory["position"]


def test_bins_and_frame_are_chosen_where_they_explain_more() -> None:
    rows, _ = rows_of(5, passes=40, spread=lambda r: (0.1 + 0.02 * r, 0.1 + 0.005 * r), memory=(0.3, 0.3, 0.0))
    fit = fit_errors(rows)
    assert fit.frame == "line_of_sight"
    near, *_, far = fit.bins
    assert near.where.range_m[0] == 0.0
    assert 2 * near.covariance_m2[0].high < far.covariance_m2[0].low
    assert [rung.name for rung in fit.ladder if rung.chosen] == ["by range + memory"]
    assert len(fit_errors(rows, simplest=True).bins) == 1


def student(seed: int, nu: float, passes: int = 40) -> tuple[FitRows, FitLists]:
    """Errors of variance .16 and .04 m², new in every list: normals over the root of a χ² that both axes share."""
    rows, lists = rows_of(seed, passes=passes, lists_each=60, memory=(0.0, 1.0, 0.0), mean_m=(0.0, 0.0))
    factor = np.sqrt((nu - 2) / np.random.default_rng(seed + 7).chisquare(nu, len(rows.log)))
    return replace(rows, **{name: getattr(rows, name) * factor for name in ERRORS_M}), lists


def test_heavy_tails_are_said_and_written() -> None:
    """Student's t₃: ν and both variances are held; a Gaussian's are off by more than a tenth as often as not."""
    held = np.zeros(3)
    for seed in range(8):
        fit = fit_errors(student(seed, 3.0)[0])
        nu, [bin_] = fit.shape.degrees_of_freedom, fit.bins
        assert fit.shape.written
        assert "explains" in fit.shape.words()
        model = StudentT.model_validate(strip_comments(fit.error_keys(bin_)))
        assert model.degrees_of_freedom == pytest.approx(nu.value, rel=1e-2)
        pairs = ((nu, 3.0), (bin_.covariance_m2[0], 0.16), (bin_.covariance_m2[2], 0.04))
        held += [one.low <= true <= one.high for one, true in pairs]
    assert (held >= 7).all()


def test_a_gaussian_has_no_heavy_tails() -> None:
    fits = [fit_errors(rows_of(seed, passes=20)[0]) for seed in range(5)]
    assert sum(fit.shape.heavier for fit in fits) <= 1
    assert fits[0].error_keys(fits[0].bins[0])["kind"] == "gaussian"
    assert "no heavier" in fits[0].shape.words()


def test_tails_by_hand() -> None:
    """(E f)² of f = √(1/χ²₃): (½ Γ(1)²/Γ(1.5)²) = 2/π. A scatter is the mean at its own weights."""
    assert gaussian_share(3.0) == pytest.approx(2 / np.pi)
    assert gaussian_share(1e6) == pytest.approx(1.0, abs=1e-5)
    error_m = np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1], [7, 7], [-7, -7], [1, -1], [-1, 1]])
    zeros = np.zeros(8, dtype=int)
    new = np.ones(8, dtype=bool)
    plain = fit_moments(error_m, zeros, (RangeBin((0, 9)),), ResidualSeries(0.0 * zeros, new), MemoryShares())
    scale = weigh_covariances(plain, error_m, zeros, 3.0).covariance_m2[0] / 3
    fixed = np.zeros((2, 2))  # at its own weights it is what it was
    for one in error_m:
        fixed += 5 / (3 + one @ np.linalg.inv(scale) @ one) * np.outer(one, one) / 7
    np.testing.assert_allclose(scale, fixed, rtol=1e-3)
    assert scale[0, 0] < plain.covariance_m2[0, 0, 0]


def by_class(spread: float, seed: int = 4) -> FitRows:
    """16 passes, every other that of a pedestrian, whose errors are `spread` times as large."""
    rows, _ = rows_of(seed, passes=16, lists_each=60, mean_m=(0.0, 0.0))
    walks = rows.pass_ix % 2 == 1
    kind = np.where(walks, CLASSES.index("pedestrian"), CLASSES.index("car")).astype(np.int8)
    scaled = {name: getattr(rows, name) * np.where(walks, spread, 1.0) for name in ERRORS_M}
    return replace(rows, view=replace(rows.view, class_ix=kind), fold=rows.pass_ix // 2 % 4, **scaled)


def test_classes_have_errors_of_their_own_where_these_differ() -> None:
    """Cars of .16 m² and pedestrians of .01 m² along: pooled neither is held. Alike they stay together."""
    fit = fit_errors(by_class(0.25))
    kinds = {one.where.of_class: one for one in fit.bins}
    assert kinds.keys() == {"car", "pedestrian"}
    for kind, along_m2 in (("car", 0.16), ("pedestrian", 0.01)):
        variance = kinds[kind].covariance_m2[0]
        assert variance.low <= along_m2 <= variance.high
        assert kinds[kind].where.when["classes"] == [kind]
    assert [rung.name for rung in fit.ladder if rung.chosen] == ["one covariance and class + memory"]
    alike = [fit_errors(by_class(1.0, seed)) for seed in range(4, 8)]
    assert sum(len(one.bins) == 1 for one in alike) >= 3
    assert len(fit_errors(by_class(0.25), simplest=True).bins) == 1


def test_what_is_written_is_what_is_replayed() -> None:
    rows, _ = rows_of(6)
    fit = fit_errors(rows)
    model = Gaussian.model_validate(strip_comments(fit.error_keys(fit.bins[0])))
    assert model.covariance_m2[0][0] == pytest.approx(fit.bins[0].covariance_m2[0].value, rel=1e-3)
    assert model.speed_sigma_mps == 0
    assert fit.untold["speed"] == "the lists have no such field"
    flat_m = np.array([np.zeros(len(rows.listed)), np.zeros(len(rows.listed)), np.full(len(rows.listed), np.nan)])
    assert fit_errors(replace(rows, size_m=flat_m)).untold["size"] == "the lists have only some of its fields"
    assert fit.memory_keys()["position"][0]["share"].value == pytest.approx(fit.shares.drift, abs=1e-3)


def test_a_field_that_is_never_filled_is_no_measurement() -> None:
    rows, _ = rows_of(9)
    fit = fit_errors(replace(rows, speed_mps=np.where(rows.listed, 0.0 - rows.view.speed_mps, np.nan)))
    assert fit.speed_sigma_mps is None
    assert fit.untold["speed"] == "the same in every entry"
    reversed_yaw = np.where(np.arange(len(rows.log)) % 4 == 0, rows.yaw_rad - np.pi, rows.yaw_rad)
    fit = fit_errors(replace(rows, yaw_rad=reversed_yaw))
    assert fit.yaw_sigma_deg is None
    assert fit.untold["yaw"].endswith("% of the entries point backwards, which no Gaussian does")


def test_what_the_pose_explains_is_not_in_the_errors_too() -> None:
    rows, _ = rows_of(9)
    fit = fit_errors(rows)
    assert remove_pose(fit, PoseFit(untold="no pair")) is fit
    placed = PoseFit(Estimate(0.1), Estimate(float(np.rad2deg(0.005))))
    [one], [less] = fit.bins, remove_pose(fit, placed).bins
    far_m = one.where.range_m[1]
    assert less.covariance_m2[0].value == pytest.approx(one.covariance_m2[0].value - 0.01)
    expected = one.covariance_m2[2].value - 0.01 - 0.005**2 * far_m**2 / 3  # the mean of r² between 0 and there
    assert less.covariance_m2[2].value == pytest.approx(expected)
    assert less.covariance_m2[2].high < one.covariance_m2[2].high
    huge = remove_pose(fit, PoseFit(Estimate(5.0), Estimate(0.0))).bins[0]
    assert huge.covariance_m2[0].value == pytest.approx(one.covariance_m2[0].value / 20)
    assert huge.covariance_m2[0].low == 0.0
    assert huge.covariance_m2[0].why == "the pose of the unit explains nearly all of it"
    assert less.covariance_m2[0].why is None


def test_few_passes_are_scored_by_bic() -> None:
    rows, _ = rows_of(7, passes=3)
    assert {rung.by for rung in fit_errors(rows).ladder} == {"BIC"}


def test_too_few_entries_are_refused_with_a_reason() -> None:
    rows, _ = rows_of(8, passes=1, lists_each=20, listed=0.1)
    with pytest.raises(InputError, match="errors need at least 8"):
        fit_errors(rows)
