"""Moments of errors: means and covariances by bins of range and visible share, with what passes tell of their spread.

Rows of a pass (one object in one log) hang together, whether or not a memory is written: the mean's interval is that of
whole passes from PASSES_ALONE on, with fewer the wider of that and of an autoregression, and a variance counts for no
more rows than either the memory or the autoregression leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.stats import chi2, t

from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.extras.fitting.error_memory import MemoryShares, ResidualSeries, sum_correlations
from copem_replay.extras.fitting.estimate import PASSES_ALONE, PER_ROW, Estimate, pool_logs
from copem_replay.metrics.limits import FEWEST_LOGS

EFFECTIVE_ROWS = 20
"""Independent rows that a bin holds at least: a standard deviation is then known to about 16 %."""
MOST_BINS = 5
"""Bins of range at most: errors change slowly with range. More: a longer PEM, each number from fewer rows."""
CLASS_ROWS = 5
"""Independent rows of a class from which on its errors may differ from those of others: with fewer they are drawn
towards those of all so far that a split says nothing."""
LOGS_WRITTEN = 4
"""Logs from which on a part that is drawn once per log and unit is written."""
_WHOLE = 0.95
"""Visible share from which on an object counts as wholly visible: it is 1 only up to rounding and small overlaps."""
_STRENGTHS = np.geomspace(4, 1e5, 60)
"""Degrees of freedom of the inverse Wishart prior that are tried; with 3 or fewer it has no mean."""


@dataclass(frozen=True)
class RangeBin:
    """The area of one covariance: an interval of range, and of visible share and class where bins are split by it."""

    range_m: tuple[float, float]
    visible_share: tuple[float, float] | None = None
    of_class: str | None = None

    @property
    def when(self) -> dict[str, Any]:
        """The area as the condition of a couple."""
        when: dict[str, Any] = {"range_m": list(self.range_m)}
        when |= {} if self.visible_share is None else {"visible_share": list(self.visible_share)}
        return when if self.of_class is None else when | {"classes": [self.of_class]}

    @property
    def words(self) -> str:
        """The area in words."""
        low_m, high_m = self.range_m
        shares = "" if self.visible_share is None else ", visible share {:g} to {:g}".format(*self.visible_share)
        return f"{low_m:g} to {high_m:g} m{shares}{'' if self.of_class is None else f', {self.of_class}'}"


@dataclass(frozen=True)
class Moments:
    """Moments by bin: `mean_m (B, 2)`, `covariance_m2 (B, 2, 2)`, `n (B,)` rows in `passes (B,)`.

    `half_width_m (B, 2)`: of the means' 95 % intervals. `freedom (B, 2)`: degrees of freedom of the two variances.
    """

    mean_m: Float
    covariance_m2: Float
    n: Int
    passes: Int
    half_width_m: Float
    freedom: Float

    def standardised(self, error_m: Float, bin_ix: Int) -> Float:
        """(n, 2) standardised errors: L⁻¹ (e − mean) by the bin of each row."""
        first, below, second = _factorise(self.covariance_m2)
        rest = error_m - self.mean_m[bin_ix]
        z = rest[:, 0] / first[bin_ix]
        return np.column_stack([z, (rest[:, 1] - below[bin_ix] * z) / second[bin_ix]])

    def log_determinant(self) -> Float:
        """(B,) ln |L|."""
        first, _, second = _factorise(self.covariance_m2)
        log: Float = np.log(first * second)
        return log


def _factorise(covariance: Float) -> tuple[Float, Float, Float]:
    """Cholesky factors of (B, 2, 2), as the replayed model has them: first, below, second, (B,) each."""
    first = np.sqrt(covariance[:, 0, 0])
    below = covariance[:, 0, 1] / first
    return first, below, np.sqrt(np.maximum(covariance[:, 1, 1] - below**2, 1e-12))


def range_bins(view: ViewGeometry, worth: float) -> tuple[RangeBin, ...]:
    """Bins of range with about equal numbers of rows, as many as EFFECTIVE_ROWS allows; `worth`: effective per row."""
    far_m = float(np.ceil(10 * view.range_m.max()) / 10)
    count = int(np.clip(len(view.range_m) * worth / EFFECTIVE_ROWS, 1, MOST_BINS))
    edges_m = np.unique(np.round(np.quantile(view.range_m, np.arange(1, count) / count), 1)).tolist()
    inside = [edge for edge in edges_m if 0 < edge < far_m]
    return tuple(RangeBin(pair) for pair in zip([0.0, *inside], [*inside, far_m], strict=True))


def share_bins(bins: tuple[RangeBin, ...], view: ViewGeometry, worth: float) -> tuple[RangeBin, ...]:
    """Bins split at the median visible share of partly hidden objects, where both halves hold enough rows."""
    hidden = view.visible_share[view.visible_share < _WHOLE]
    if len(hidden) * worth < EFFECTIVE_ROWS:
        return bins
    median_share = float(np.round(np.median(hidden), 2))
    low, bin_ix = view.visible_share <= median_share, find_bin(view, bins)
    out: list[RangeBin] = []
    for b, one in enumerate(bins):
        halves = np.bincount(low[bin_ix == b], minlength=2) * worth
        shares = [(0.0, median_share), (median_share, 1.0)] if halves.min() >= EFFECTIVE_ROWS else [None]
        out += [replace(one, visible_share=share) for share in shares]
    return tuple(out)


def class_bins(bins: tuple[RangeBin, ...], view: ViewGeometry, worth: float) -> tuple[RangeBin, ...]:
    """Bins split by class; classes of fewer than CLASS_ROWS effective rows stay together, in bins behind the others."""
    kinds, n = np.unique(view.class_ix, return_counts=True)
    single_classes = [CLASSES[k] for k in kinds[n * worth >= CLASS_ROWS].tolist()]
    if not single_classes or len(kinds) < 2:
        return bins
    split = tuple(replace(one, of_class=kind) for kind in single_classes for one in bins)
    return split if len(single_classes) == len(kinds) else (*split, *bins)


def find_bin(view: ViewGeometry, bins: tuple[RangeBin, ...]) -> Int:
    """(P,) the first bin that holds each row, bounds included, as couples apply; without any the last bin."""
    out = np.full(len(view.range_m), len(bins) - 1)
    for b in reversed(range(len(bins))):
        low, high = bins[b].range_m
        holds = (view.range_m >= low) & (view.range_m <= high)
        if (share := bins[b].visible_share) is not None:
            holds &= (view.visible_share >= share[0]) & (view.visible_share <= share[1])
        if (kind := bins[b].of_class) is not None:
            holds &= view.class_ix == CLASSES.index(kind)
        out[holds] = b
    return out


def fit_moments(
    error_m: Float, bin_ix: Int, where: tuple[RangeBin, ...], series: ResidualSeries, shares: MemoryShares
) -> Moments:
    """Means of rows, and covariances by moments that are shrunk to that of all bins of their class.

    A covariance is that of the residuals, over the number of rows reduced by the uncertainty of their mean under the
    memory. It is shrunk by an inverse Wishart prior whose mean is the pooled covariance, with the strength that makes
    all bins most probable: similar bins become equal, others stay. A bin without rows has the mean of all.
    """
    bins = len(where)
    n = np.bincount(bin_ix, minlength=bins)
    sums = sum_correlations(series.decay(shares.tau_s), series.new, bin_ix, bins, shares.drift, shares.constant)
    sum_rho, sum_rho2 = np.maximum(sums, 1.0)
    mean = np.repeat(error_m.mean(axis=0)[None], bins, axis=0)
    moments = np.zeros((bins, 2, 2))
    freedom, half_width_m, passes = np.full((bins, 2), 1e-3), np.full((bins, 2), np.inf), np.zeros(bins, dtype=np.int64)
    series_ix = np.cumsum(series.new) - 1
    of_mean = np.minimum(sum_rho / np.maximum(n, 1) ** 2, 0.9)
    for b in np.flatnonzero(n).tolist():
        rows = np.flatnonzero(bin_ix == b)
        new = np.diff(series_ix[rows], prepend=-1) != 0
        mean[b] = error_m[rows].mean(axis=0)
        residuals, passes[b] = error_m[rows] - mean[b], int(new.sum())
        moments[b] = residuals.T @ residuals / max(n[b] * (1 - of_mean[b]), 1.0)
        for k in range(2):
            phi = lag_one_correlation(residuals[:, k], new)
            neighbours = n[b] * (1 - phi**2) / (1 + phi**2)
            freedom[b, k] = max(min(n[b] ** 2 / sum_rho2[b] * (1 - of_mean[b]), neighbours), 1e-3)
            half_width_m[b, k] = mean_half_width(residuals[:, k], new, phi, float(moments[b, k, k]))
    for kind in {one.of_class: None for one in where}:
        alike = np.flatnonzero([one.of_class == kind for one in where])
        least = freedom[alike].min(axis=1)
        moments[alike], more = _shrink_covariances(moments[alike], least)
        freedom[alike] *= (more / least)[:, None]
    return Moments(mean, moments, n, passes, half_width_m, freedom)


def lag_one_correlation(residuals: Float, new: Bool) -> float:
    """φ of an autoregression, from residuals (n,) about a common mean; `new (n,)`: where a pass begins. 0 to 0.9999.

    Too small by (1 + 4φ)/n on average, which is added (F. H. C. Marriott, J. A. Pope, Biometrika 41 (1954) 390–402).
    """
    n, pairs = len(residuals), int((~new[1:]).sum())
    total = float(residuals @ residuals)
    if not pairs or total == 0:
        return 0.0
    phi = float((residuals[1:] * residuals[:-1])[~new[1:]].sum()) / pairs / (total / n)
    return float(np.clip(phi + (1 + 4 * phi) / n, 0.0, 0.9999))


def count_effective(phi: float, lengths: Int) -> float:
    """How many independent rows the mean of passes of so many rows is worth: n² / Σ φ^|i−j| over pairs of a pass."""
    return float(lengths.sum() ** 2 / _sum_autoregression(phi, lengths).sum())


def _sum_autoregression(phi: float, lengths: Int) -> Float:
    """(G,) Σ φ^|i−j| over all pairs of rows of each pass, a row with itself as 1."""
    m = lengths.astype(float)
    out: Float = m * (1 + phi) / (1 - phi) - 2 * phi * (1 - phi**m) / (1 - phi) ** 2
    return out


def mean_half_width(residuals: Float, new: Bool, phi: float, variance: float) -> float:
    """Half the width of the 95 % interval of a mean, from residuals (n,) about it; `new (n,)`: where a pass begins.

    By passes: V = Σ e²/(1 − w/n)/n² over the passes' sums e of w rows, with the degrees of freedom (tr Q)²/tr Q² that
    V has if rows are an autoregression of φ (R. M. Bell, D. F. McCaffrey, Survey Methodology 28 (2002) 169–181).
    """
    n, w = len(residuals), np.diff(np.append(np.flatnonzero(new), len(residuals)))
    effective = count_effective(phi, w)
    half = float(t.ppf(0.975, max(effective - 1, 0.5)) * np.sqrt(variance / effective))
    if len(w) == 1:
        return half
    pass_sums = np.add.reduceat(residuals, np.flatnonzero(new))
    scale = 1 / (1 - w / n)
    spread = np.eye(len(w)) - np.outer(w, np.ones(len(w))) / n
    root = np.sqrt(scale)[:, None] * spread
    q = root * _sum_autoregression(phi, w) @ root.T
    freedom = float(np.trace(q) ** 2 / (q * q).sum())
    by_passes = float(t.ppf(0.975, freedom) * np.sqrt((pass_sums**2 * scale).sum()) / n)
    return by_passes if len(w) >= PASSES_ALONE else max(by_passes, half)


def _shrink_covariances(covariance: Float, freedom: Float) -> tuple[Float, Float]:
    """Covariances (B, 2, 2) shrunk towards the pooled one (empirical Bayes), and their degrees of freedom (B,)."""
    from scipy.special import multigammaln

    pooled = (covariance * freedom[:, None, None]).sum(axis=0) / freedom.sum() + 1e-9 * np.eye(2)
    if len(freedom) == 1:
        return covariance + 1e-9 * np.eye(2), freedom
    scatter = covariance * freedom[:, None, None]

    def evidence(strength: float) -> float:
        prior = (strength - 3) * pooled
        posterior_strength = strength + freedom
        gammas = multigammaln(posterior_strength / 2, 2) - multigammaln(strength / 2, 2)
        dets = strength * np.log(np.linalg.det(prior)) - posterior_strength * np.log(np.linalg.det(prior + scatter))
        return float((gammas + dets / 2).sum())

    strength = max(_STRENGTHS, key=evidence)
    shrunk = ((strength - 3) * pooled + scatter) / (strength - 3 + freedom)[:, None, None]
    return shrunk, np.minimum(freedom + strength, freedom.sum())


# Between logs.


@dataclass(frozen=True)
class BetweenLogs:
    """By how much the mean differs between logs: `sigma_m` along both axes, and that as a `share` of the variance.

    `untold`: why it is not written; None: it is. `half_width_m (2,)`: of the mean's interval over logs.
    """

    sigma_m: tuple[Estimate, Estimate]
    share: float
    untold: str | None
    half_width_m: Float = field(metadata={PER_ROW: True})


def fit_between_logs(rest_m: Float, log: Int, series: ResidualSeries, shares: MemoryShares) -> BetweenLogs | None:
    """The scatter of the means of logs, from residuals (n, 2) about the mean of their bin; None of too few logs.

    A log's mean has the variance that the memory leaves it, or an autoregression if that is more. It is written from
    LOGS_WRITTEN logs on, where its lower limit is above 0.
    """
    logs, log_ix = np.unique(log, return_inverse=True)
    K = len(logs)
    if K < FEWEST_LOGS:
        return None
    n = np.bincount(log_ix)
    sum_rho, _ = sum_correlations(series.decay(shares.tau_s), series.new, log_ix, K, shares.drift, shares.constant)
    lengths = np.diff(np.append(np.flatnonzero(series.new), len(log)))
    log_of_pass = log_ix[series.new]
    pools, variances = [], (rest_m**2).mean(axis=0)
    for k in range(2):
        phi = lag_one_correlation(rest_m[:, k], series.new)
        alone = np.array([1 / count_effective(phi, lengths[log_of_pass == g]) for g in range(K)])
        means = np.bincount(log_ix, rest_m[:, k]) / n
        pools.append(pool_logs(means, variances[k] * np.maximum(sum_rho / n**2, alone), len(log)))
    sigmas = pools[0].between, pools[1].between
    share = float(min((sigmas[0].value ** 2 + sigmas[1].value ** 2) / variances.sum(), 1.0))
    untold = None
    if K < LOGS_WRITTEN:
        untold = f"{K} logs, it is written from {LOGS_WRITTEN} on"
    elif not max(one.low for one in sigmas) > 0:
        untold = (
            f"the means of {K} logs differ no more than chance makes them (by less than {sigmas[0].high:.2g} m and "
        )
        untold += f"{sigmas[1].high:.2g} m)"
    half = np.array([(one.mean.high - one.mean.low) / 2 for one in pools])
    return BetweenLogs(sigmas, share, untold, np.zeros(2) if untold else half)


# The estimates of a bin.


@dataclass(frozen=True)
class ErrorBin:
    """One couple's error: where it holds, the mean (m), and the covariance's entries (m²) xx, xy and yy."""

    where: RangeBin
    mean_m: tuple[Estimate, Estimate]
    covariance_m2: tuple[Estimate, Estimate, Estimate]


def estimate_bin(where: RangeBin, moments: Moments, b: int) -> ErrorBin:
    """The numbers of bin b with their intervals."""
    (xx, xy), (_, yy) = moments.covariance_m2[b]
    n, freedom = int(moments.n[b]), moments.freedom[b]
    mean_estimates = [
        Estimate(
            float(value), float(value - half), float(value + half), n, min(float(variance * (1.96 / half) ** 2), n)
        )
        for value, half, variance in zip(moments.mean_m[b], moments.half_width_m[b], (xx, yy), strict=True)
    ]
    least = float(freedom.min())
    half_m2 = float(t.ppf(0.975, max(least, 1.0)) * np.sqrt((xx * yy + xy**2) / least))
    covariance = Estimate(float(xy), float(xy - half_m2), float(xy + half_m2), n, least)
    return ErrorBin(
        where,
        (mean_estimates[0], mean_estimates[1]),
        (estimate_variance(xx, n, float(freedom[0])), covariance, estimate_variance(yy, n, float(freedom[1]))),
    )


def estimate_variance(value: float, n: int, freedom: float) -> Estimate:
    """A variance of `n` rows with χ² limits of so many degrees of freedom."""
    low, high = freedom * value / chi2.ppf([0.975, 0.025], max(freedom, 1.0))
    return Estimate(float(value), float(low), float(high), n, freedom)
