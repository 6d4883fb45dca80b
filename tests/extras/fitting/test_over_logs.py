"""Numbers over logs: by hand where logs are equally sure, by the equations themselves where they are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, t

from copem_replay.core.yaml import strip_comments
from copem_replay.extras.fitting.error_memory import MemoryShares
from copem_replay.extras.fitting.errors import ErrorFit, build_series, fit_errors
from copem_replay.extras.fitting.estimate import pool_logs
from copem_replay.extras.fitting.moments import fit_between_logs
from copem_replay.extras.fitting.rows import FitLists, FitRows
from copem_replay.perception.pem.model import Pem
from tests.extras.fitting.fit_rows import rows_of
from tools import check_fit

VALUES = np.array([0.1, 0.2, 0.6, 0.5])


def test_logs_that_are_equally_sure() -> None:
    """v alike: τ² = s² − v, mean ± t₃ s/√4, and s² between (K − 1)s²/χ² gives the limits of τ² + v."""
    variance, square = 0.01, VALUES.var(ddof=1)
    found = pool_logs(VALUES, np.full(4, variance), 800)
    assert found.mean.value == pytest.approx(0.35)
    half = t.ppf(0.975, 3) * np.sqrt(square / 4)
    assert (found.mean.low, found.mean.high) == pytest.approx((0.35 - half, 0.35 + half))
    assert found.between.value == pytest.approx(np.sqrt(square - variance))
    low, high = 3 * square / chi2.ppf([0.975, 0.025], 3) - variance
    assert (found.between.low, found.between.high) == pytest.approx((np.sqrt(low), np.sqrt(high)))
    assert found.contradict
    assert (found.mean.n, found.mean.n_effective) == (800, 4)


def test_logs_that_agree_better_than_they_should() -> None:
    """s² below v: τ 0, and the mean is no surer than its logs are: t₃ √(v/4), not t₃ s/2."""
    found = pool_logs(VALUES, np.full(4, 1.0), 800)
    assert found.between.value == found.between.low == 0
    assert not found.contradict
    assert found.mean.high - found.mean.value == pytest.approx(t.ppf(0.975, 3) * 0.5)


def test_logs_that_are_not_equally_sure() -> None:
    """Each limit solves its equation: Σ w (y − mean)² is K − 1, and the quantiles of χ²."""
    variances = np.array([0.001, 0.02, 0.01, 0.002])
    found = pool_logs(VALUES, variances, 100)
    for tau, level in (
        (found.between.value, 3.0), (found.between.low, chi2.ppf(0.975, 3)), (found.between.high, chi2.ppf(0.025, 3)),
    ):  # fmt: skip
        w = 1 / (variances + tau**2)
        mean = sum(w * VALUES) / sum(w)
        assert sum(w * (VALUES - mean) ** 2) == pytest.approx(level, rel=1e-6)
    w = 1 / (variances + found.between.value**2)
    assert found.mean.value == pytest.approx(sum(w * VALUES) / sum(w))
    assert found.mean.high - found.mean.value == pytest.approx(t.ppf(0.975, 3) / np.sqrt(sum(w)))


@pytest.mark.parametrize("logs", [3, 4, 8])
@pytest.mark.parametrize("tau", [0.0, 0.3, 1.0])
def test_the_scatter_and_the_mean_are_held(logs: int, tau: float) -> None:
    """The short form of `tools/check_fit.py logs`: 200 sets, .92 less two standard errors."""
    for precision in check_fit.PRECISION:
        drawn = [check_fit.drawn_logs(logs, tau, precision, seed) for seed in range(200)]
        for kind in ("mean", "between"):
            assert np.mean([check_fit.holds(*one[kind]) for one in drawn]) >= 0.92 - 2 * np.sqrt(0.92 * 0.08 / 200)


def test_logs_that_agree_better_than_chance_leave_a_scatter_possible() -> None:
    """Values of variance s² whose logs claim 600 s²: no τ has so little scatter, yet one of the values' size may be."""
    values = np.array([0.01, 0.02, 0.0, 0.01])
    between = pool_logs(values, np.full(4, 0.04), 40).between
    square = values.var(ddof=1)
    most = 3 * square / chi2.ppf(0.025, 3) - square
    assert (between.value, between.low, between.high) == pytest.approx((0, 0, np.sqrt(most)))


def drives(seed: int, logs: int, sigma_m: float) -> tuple[FitRows, FitLists]:
    """Six passes in each log, with errors of .4 and .2 m, and a shift of each log."""
    rows, lists = rows_of(seed, passes=6 * logs, lists_each=30, memory=(0.3, 0.3, 0.0), mean_m=(0.0, 0.0))
    log = rows.pass_ix // 6
    shift = sigma_m * np.random.default_rng(seed + 99).normal(size=(2, logs))[:, log]
    along_m, across_m = rows.along_m + shift[0], rows.across_m + shift[1]
    cos, sin = np.cos(rows.view.bearing_rad), np.sin(rows.view.bearing_rad)
    east_m, north_m = cos * along_m - sin * across_m, sin * along_m + cos * across_m
    moved = replace(rows, log=log, along_m=along_m, across_m=across_m, east_m=east_m, north_m=north_m)
    return moved, replace(lists, log=np.repeat(np.arange(logs), 6 * 30))


def position(fit: ErrorFit) -> list[dict[str, object]]:
    return strip_comments(fit.memory_keys()).get("position", [])


def test_what_differs_between_logs_is_drawn_once_per_log() -> None:
    fit = fit_errors(drives(0, 6, 0.4)[0])
    between = fit.between_logs
    assert between is not None
    assert between.untold is None
    for one in between.sigma_m:
        assert one.low <= 0.4 <= one.high
    variance = sum(fit.bins[0].covariance_m2[k].value for k in (0, 2))
    assert between.share == pytest.approx(sum(one.value**2 for one in between.sigma_m) / variance, rel=0.1)
    *_, last = position(fit)
    assert last == {"share": round(between.share, 3), "correlation_s": "always", "of": "unit"}
    assert sum(part["share"] for part in position(fit)) <= 1  # type: ignore[misc]
    pem = {"couples": [{"detection": {"kind": "constant", "probability": 0.9}}], "memory": {"position": position(fit)}}
    assert Pem.model_validate(pem).memory["position"][-1].of == "unit"
    for mean in fit.bins[0].mean_m:  # of six logs, not of 36 passes
        assert mean.high - mean.low > 2 * t.ppf(0.975, 5) * 0.15 / np.sqrt(6)


def test_logs_that_do_not_differ_are_said() -> None:
    fit = fit_errors(drives(1, 6, 0.0)[0])
    assert fit.between_logs is not None
    assert fit.between_logs.untold is not None
    assert fit.between_logs.untold.startswith("the means of 6 logs differ no more than chance makes them")
    assert all(part.get("of") is None for part in position(fit))
    three = fit_errors(drives(0, 3, 0.4)[0]).between_logs
    assert three is not None
    assert three.untold == "3 logs, it is written from 4 on"
    assert fit_errors(drives(0, 2, 0.4)[0]).between_logs is None


def test_a_logs_mean_is_as_sure_as_its_memory_leaves_it() -> None:
    """Four logs of one pass of two rows without memory, one residual each way: v of ½ s², so τ² = s²(means) − v."""
    rows, _ = drives(0, 4, 0.0)
    some = rows.take((rows.pass_ix % 6 == 0) & (np.arange(len(rows.log)) % 30 < 2))
    rest = np.array([[1.0, 1], [-1, -1], [3, 3], [1, 1], [-1, -1], [-3, -3], [1, 1], [-1, -1]])
    found = fit_between_logs(rest, some.log, build_series(some), MemoryShares())
    assert found is not None
    means, variance = np.array([0.0, 2.0, -2.0, 0.0]), (rest[:, 0] ** 2).mean()
    lag = (-1 + 3 + 3 - 1) / 4 / variance
    phi = lag + (1 + 4 * lag) / 8
    v = variance * max(1 / 2, (2 + 2 * phi) / 4)
    assert found.sigma_m[0].value == pytest.approx(np.sqrt(max(means.var(ddof=1) - v, 0.0)))
