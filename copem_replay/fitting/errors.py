"""The errors of entries: mean and covariance of the position by bins, the spread of other fields, and their memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, t

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.fitting.error_memory import (
    ErrorMemoryFit,
    LastingPart,
    MemoryShares,
    ResidualSeries,
    fit_error_memory,
    refit_error_memory,
    sum_squared_correlations,
    whiten_series,
)
from copem_replay.fitting.estimate import (
    PER_ROW,
    Estimate,
    Rung,
    choose_by_bic,
    choose_rung,
    held_out_possible,
    round_digits,
)
from copem_replay.fitting.pose import PoseFit
from copem_replay.fitting.rows import FitLists, FitRows

# Moments: means and covariances by bins of range and visible share, under a memory, shrunk towards the pooled ones.

EFFECTIVE_ROWS = 20
"""Independent rows that a bin holds at least: a standard deviation is then known to about 16 %."""
MOST_BINS = 5
"""Bins of range at most: errors change slowly with range. More: a longer PEM, each number from fewer rows."""
_WHOLE = 0.95
"""Visible share from which on an object counts as wholly visible: it is 1 only up to rounding and small overlaps."""
_STRENGTHS = np.geomspace(4, 1e5, 60)
"""Degrees of freedom of the inverse Wishart prior that are tried; with 3 or fewer it has no mean."""
_RIDGE = 1e-3
"""Rows that every bin borrows from the mean of all: an empty bin has this mean."""


@dataclass(frozen=True)
class RangeBin:
    """Where one covariance holds: an interval of range, and of visible share where bins are split by it."""

    range_m: tuple[float, float]
    visible_share: tuple[float, float] | None = None

    @property
    def when(self) -> dict[str, Any]:
        """The condition of a couple."""
        when = {"range_m": list(self.range_m)}
        return when if self.visible_share is None else when | {"visible_share": list(self.visible_share)}


@dataclass(frozen=True)
class Moments:
    """Moments by bin: `mean_m (B, 2)`, `covariance_m2 (B, 2, 2)`, rows `n (B,)`, and their precision (B,).

    `of_mean`: the variance of the mean as a share of the covariance. `freedom`: degrees of freedom of the covariance.
    """

    mean_m: Float
    covariance_m2: Float
    n: Int
    of_mean: Float
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


def range_bins(view: ViewGeometry, worth: float, edges_m: tuple[float, ...] | None = None) -> tuple[RangeBin, ...]:
    """Bins of range with about equal numbers of rows, as many as EFFECTIVE_ROWS allows; `worth`: effective per row."""
    far_m = float(np.ceil(10 * view.range_m.max()) / 10)
    if edges_m is None:
        count = int(np.clip(len(view.range_m) * worth / EFFECTIVE_ROWS, 1, MOST_BINS))
        inner = np.round(np.quantile(view.range_m, np.arange(1, count) / count), 1)
        edges_m = tuple(float(edge) for edge in inner)
    inside = [edge for edge in sorted(set(edges_m)) if 0 < edge < far_m]
    return tuple(RangeBin(pair) for pair in zip([0.0, *inside], [*inside, far_m], strict=True))


def share_bins(bins: tuple[RangeBin, ...], view: ViewGeometry, worth: float) -> tuple[RangeBin, ...]:
    """Bins split at the median visible share of partly hidden objects, where both halves hold enough rows."""
    hidden = view.visible_share[view.visible_share < _WHOLE]
    if len(hidden) * worth < EFFECTIVE_ROWS:
        return bins
    median_share = float(np.round(np.median(hidden), 2))
    out: list[RangeBin] = []
    bin_ix = find_bin(view, bins)
    for b, range_bin in enumerate(bins):
        low = (view.visible_share[bin_ix == b] <= median_share).sum() * worth
        enough = min(low, (bin_ix == b).sum() * worth - low) >= EFFECTIVE_ROWS
        out += (
            [RangeBin(range_bin.range_m, (0.0, median_share)), RangeBin(range_bin.range_m, (median_share, 1.0))]
            if enough
            else [range_bin]
        )
    return tuple(out)


def find_bin(view: ViewGeometry, bins: tuple[RangeBin, ...]) -> Int:
    """(P,) the first bin that holds each row, bounds included, as couples apply; without any the last bin."""
    out = np.full(len(view.range_m), len(bins) - 1)
    for b in reversed(range(len(bins))):
        low, high = bins[b].range_m
        holds = (view.range_m >= low) & (view.range_m <= high)
        if (share := bins[b].visible_share) is not None:
            holds &= (view.visible_share >= share[0]) & (view.visible_share <= share[1])
        out[holds] = b
    return out


def fit_moments(error_m: Float, bin_ix: Int, bins: int, series: ResidualSeries, shares: MemoryShares) -> Moments:
    """Means by generalised least squares under a memory, covariances by moments, shrunk to the pooled one.

    A covariance is that of the residuals, over the number of rows reduced by the uncertainty of their mean; its degrees
    of freedom are n² / Σ ρ². It is shrunk by an inverse Wishart prior whose mean is the pooled covariance, with the
    strength that makes all bins most probable: similar bins become equal, others stay.
    """
    n = np.bincount(bin_ix, minlength=bins)
    design = (bin_ix[:, None] == np.arange(bins)).astype(float)
    centre = error_m.mean(axis=0)
    covariance = np.repeat(np.cov(error_m.T, bias=True)[None] + 1e-9 * np.eye(2), bins, axis=0)
    pairs = sum_squared_correlations(
        series.decay(shares.tau_s), series.new, bin_ix, bins, shares.drift, shares.constant
    )
    for _ in range(2):
        plain = Moments(np.repeat(centre[None], bins, axis=0), covariance, n, pairs, pairs)
        out, _ = whiten_series(np.column_stack([plain.standardised(error_m, bin_ix), design]), series, shares)
        of_design = np.linalg.inv(out[:, 2:].T @ out[:, 2:] + _RIDGE * np.eye(bins))
        first, below, second = _factorise(covariance)
        m = of_design @ (out[:, 2:].T @ out[:, :2])
        mean = centre + np.column_stack([first * m[:, 0], below * m[:, 0] + second * m[:, 1]])
        of_mean = np.minimum(np.diag(of_design), 0.9)
        rest = error_m - mean[bin_ix]
        left = np.maximum(n * (1 - of_mean), 1.0)
        freedom = np.maximum(n.astype(float) ** 2 / np.maximum(pairs, 1.0) * (1 - of_mean), 1e-3)
        moments = np.array([rest[bin_ix == b].T @ rest[bin_ix == b] for b in range(bins)]) / left[:, None, None]
        covariance, freedom = _shrink_covariances(moments, freedom)
    return Moments(mean, covariance, n, of_mean, freedom)


def _shrink_covariances(covariance: Float, freedom: Float) -> tuple[Float, Float]:
    """Covariances (B, 2, 2) shrunk towards the pooled one, and their degrees of freedom (B,)."""
    from scipy.special import multigammaln

    pooled = (covariance * freedom[:, None, None]).sum(axis=0) / freedom.sum() + 1e-9 * np.eye(2)
    if len(freedom) == 1:
        return covariance + 1e-9 * np.eye(2), freedom
    scatter = covariance * freedom[:, None, None]

    def evidence(strength: float) -> float:
        prior = (strength - 3) * pooled
        both = strength + freedom
        gammas = multigammaln(both / 2, 2) - multigammaln(strength / 2, 2)
        dets = strength * np.log(np.linalg.det(prior)) - both * np.log(np.linalg.det(prior + scatter))
        return float((gammas + dets / 2).sum())

    strength = max(_STRENGTHS, key=evidence)
    shrunk = ((strength - 3) * pooled + scatter) / (strength - 3 + freedom)[:, None, None]
    return shrunk, np.minimum(freedom + strength, freedom.sum())


# Fits of errors.

Frame = Literal["line_of_sight", "absolute"]
FEWEST = 8
"""Entries below which no error is fitted: a mean and a covariance are five numbers."""
_REVERSED, _STILL_MPS = 0.05, 1.0
"""Share from which on entries that point backwards are no outliers, and speed below which an entry does not count as
backwards: there its sign is noise."""
_ONE, _RANGE, _SHARE, _MEMORY = "one covariance", "by range", "by range and visible share", " + memory"


@dataclass(frozen=True)
class ErrorBin:
    """One couple's error: where it holds, the mean (m), and the covariance's entries (m²) xx, xy and yy."""

    where: RangeBin
    mean_m: tuple[Estimate, Estimate]
    covariance_m2: tuple[Estimate, Estimate, Estimate]


@dataclass(frozen=True)
class ErrorShape:
    """Whether errors are Gaussian: standardised errors `z (n, 2)`, their excess kurtosis, and the gain of Student's t₄.

    `t4_gain`: nats per row that t₄ explains more than a Gaussian; negative: less.
    """

    z: Float = field(metadata={PER_ROW: True})
    excess_kurtosis: float
    t4_gain: float


@dataclass(frozen=True)
class ErrorFit:
    """The errors of entries. `frame`, `bins`: of the position. Spreads are None where lists have no such field.

    `memory`: by quantity the parts that last; `shares`: those of the position as numbers. `rows (n,)`: which rows of
    `FitRows` have an entry; `bin_ix`: their bin. `ladder`: the models that were compared; `frames`: the two frames.
    `untold`: by key why the data do not determine it.
    """

    frame: Frame
    bins: tuple[ErrorBin, ...]
    yaw_sigma_deg: Estimate | None
    speed_sigma_mps: Estimate | None
    size_sigma_m: Estimate | None
    memory: Mapping[str, tuple[LastingPart, ...]]
    shares: MemoryShares
    shape: ErrorShape
    rows: Int = field(metadata={PER_ROW: True})
    bin_ix: Int = field(metadata={PER_ROW: True})
    ladder: tuple[Rung, ...]
    frames: tuple[Rung, ...]
    untold: Mapping[str, str]

    def yaml_error(self, bin_: ErrorBin) -> dict[str, Any]:
        """The keys of an error model, as it is replayed."""
        xx, xy, yy = (round_digits(one.value) for one in bin_.covariance_m2)
        within = 0.9999 * np.sqrt(xx * yy)  # rounding must not make it singular
        out: dict[str, Any] = {"kind": "gaussian", "frame": self.frame}
        xy = round_digits(float(np.clip(xy, -within, within)))
        out |= {"mean_m": [round_digits(one.value) for one in bin_.mean_m], "covariance_m2": [[xx, xy], [xy, yy]]}
        for name in ("yaw_sigma_deg", "speed_sigma_mps", "size_sigma_m"):
            if (sigma := getattr(self, name)) is not None:
                out[name] = round_digits(sigma.value)
        return out

    @property
    def yaml_memory(self) -> dict[str, list[dict[str, Any]]]:
        """The keys of `memory`."""
        return {name: [part.yaml for part in parts] for name, parts in self.memory.items() if parts}


def remove_pose(fit: ErrorFit, placed: PoseFit) -> ErrorFit:
    """The errors without the part that is due to the unit's own pose, which is replayed by itself.

    Across the line of sight a turn θ moves an entry at range r by r θ; in easting and northing the variance is half of
    that each. At least a twentieth of each variance is left.
    """
    if placed.untold is not None or placed.position_sigma_m is None or placed.yaw_sigma_deg is None:
        return fit
    shift_m2, turn = placed.position_sigma_m.value**2, np.deg2rad(placed.yaw_sigma_deg.value) ** 2
    bins = []
    for one in fit.bins:
        near_m, far_m = one.where.range_m
        turned_m2 = turn * (near_m**2 + near_m * far_m + far_m**2) / 3
        parts = (0.0, 1.0) if fit.frame == "line_of_sight" else (0.5, 0.5)
        first, between, second = one.covariance_m2
        xx, yy = (
            replace(of, **{name: max(getattr(of, name) - shift_m2 - part * turned_m2, of.value / 20)
                           for name in ("value", "low", "high")})
            for of, part in zip((first, second), parts, strict=True)
        )  # fmt: skip
        most = np.sqrt(xx.value * yy.value / (first.value * second.value))
        bins.append(replace(one, covariance_m2=(xx, replace(between, value=between.value * min(most, 1.0)), yy)))
    return replace(fit, bins=tuple(bins))


def fit_errors(
    rows: FitRows, lists: FitLists, *, simplest: bool = False, edges_m: tuple[float, ...] | None = None
) -> ErrorFit:
    """Fit the errors of all listed rows. `edges_m`: bounds between bins of range; None: quantiles.

    Raises InputError where too few rows are listed.
    """
    listed = np.flatnonzero(rows.listed & np.isfinite(rows.along_m) & np.isfinite(rows.across_m))
    if len(listed) < FEWEST:
        raise InputError(f"{len(listed)} entries are of a true object: errors need at least {FEWEST}")
    entries = rows.take(listed)
    series = build_series(entries)
    errors = {
        "line_of_sight": np.column_stack([entries.along_m, entries.across_m]),
        "absolute": np.column_stack([entries.east_m, entries.north_m]),
    }
    everything = np.zeros(len(listed), dtype=np.int64)
    los_m = errors["line_of_sight"]
    z = fit_moments(los_m, everything, 1, series, MemoryShares()).standardised(los_m, everything)
    start = fit_error_memory(z, series, centred=True, intervals=False).shares
    worth = 1 / float(fit_moments(los_m, everything, 1, series, start).of_mean[0]) / len(listed)
    candidates = _list_candidates(entries.view, worth, edges_m)
    trial = _ModelTrial(entries, series, worth, simplest)
    wide = list(candidates.values())[-1]
    frame_ix, frames = trial.choose({name: (error_m, wide, None) for name, error_m in errors.items()})
    frame: Frame = ("line_of_sight", "absolute")[frame_ix]
    error_m = errors[frame]
    bins_ix, ladder = trial.choose({name: (error_m, bins, None) for name, bins in candidates.items()})
    name, bins = list(candidates.items())[bins_ix]
    bin_ix = find_bin(entries.view, bins)
    memory = _fit_error_memory(error_m, bin_ix, len(bins), series, start)
    last_ix, last = trial.choose({name: (error_m, bins, None), name + _MEMORY: (error_m, bins, memory.shares)})
    if last_ix == 0:
        instead = memory.untold or f"no better on passes held out ({last[1].words()})"
        memory = ErrorMemoryFit(log_likelihood=memory.log_likelihood, untold=instead)
    moments = fit_moments(error_m, bin_ix, len(bins), series, memory.shares)
    spreads, lasting, untold = _fit_spreads(entries, simplest=simplest)
    if memory.untold is not None:
        untold = {"memory.position": memory.untold} | untold
    return ErrorFit(
        frame, tuple(_estimate_bin(one, moments, b) for b, one in enumerate(bins)),
        spreads["yaw"], spreads["speed"], spreads["size"],
        {"position": memory.parts} | lasting, memory.shares, _measure_shape(moments.standardised(error_m, bin_ix)),
        listed, bin_ix, (*(rung for rung in ladder if not rung.chosen), *last), frames, untold,
    )  # fmt: skip


def _list_candidates(
    view: ViewGeometry, worth: float, edges_m: tuple[float, ...] | None
) -> dict[str, tuple[RangeBin, ...]]:
    """Bins by name, from one to the finest that the rows allow."""
    by_range = range_bins(view, worth, edges_m)
    finer = share_bins(by_range, view, worth)
    whole = (RangeBin((0.0, by_range[-1].range_m[1])),)
    candidates = {_ONE: whole} | ({_RANGE: by_range} if len(by_range) > 1 else {})
    return candidates | ({_SHARE: finer} if len(finer) > len(by_range) else {})


def _fit_spreads(
    rows: FitRows, *, simplest: bool
) -> tuple[dict[str, Estimate | None], dict[str, tuple[LastingPart, ...]], dict[str, str]]:
    """By `yaw`, `speed` and `size` the spread, the parts that last, and why one of them is not fitted."""
    spreads: dict[str, Estimate | None] = {}
    lasting: dict[str, tuple[LastingPart, ...]] = {}
    untold: dict[str, str] = {}
    errors = {"yaw": np.rad2deg(rows.yaw_rad)[:, None], "speed": rows.speed_mps[:, None], "size": rows.size_m.T}
    listed = {"yaw": np.exp(1j * (rows.view.yaw_rad + rows.yaw_rad)), "speed": rows.view.speed_mps + rows.speed_mps}
    backwards = {"yaw": np.abs(rows.yaw_rad) > np.pi / 2, "speed": listed["speed"] < -_STILL_MPS}
    for key, values in errors.items():
        no_spread = _explain_no_gaussian(listed[key], backwards[key]) if key in listed else None
        spread, parts, why = (None, (), no_spread) if no_spread else _fit_spread(values, rows, simplest=simplest)
        spreads[key] = spread
        lasting[key] = parts
        if why is not None:
            untold[f"memory.{key}" if spread is not None else key] = why
    return spreads, lasting, untold


def build_series(rows: FitRows) -> ResidualSeries:
    """The entries of each object in each log as one series: a constant error is one number per series."""
    new = np.ones(len(rows.log), dtype=bool)
    new[1:] = (np.diff(rows.log) != 0) | (np.diff(rows.object) != 0)
    gap_s = np.diff(rows.captured_s, prepend=0.0)
    return ResidualSeries(np.where(new, 0.0, gap_s), new)


def _fit_error_memory(
    error_m: Float, bin_ix: Int, bins: int, series: ResidualSeries, start: MemoryShares
) -> ErrorMemoryFit:
    """The memory of errors by bins, jointly with their moments: in turns, twice."""
    for last in (False, True):
        z = fit_moments(error_m, bin_ix, bins, series, start).standardised(error_m, bin_ix)
        fit = fit_error_memory(z, series, centred=True, intervals=last)
        start = fit.shares
    return fit


_Model = tuple[Float, tuple[RangeBin, ...], MemoryShares | None]
"""Errors (n, 2), bins, and a memory (None: without)."""


@dataclass(frozen=True)
class _ModelTrial:
    """Compares models on passes they were not fitted to, or by BIC."""

    rows: FitRows
    series: ResidualSeries
    worth: float
    simplest: bool

    def choose(self, models: Mapping[str, _Model]) -> tuple[int, tuple[Rung, ...]]:
        """The index of the model that is written, from the simplest to the richest, and the table of all."""
        rows, names = self.rows, list(models)
        if not held_out_possible(rows.pass_ix, rows.fold):
            whole = np.ones(len(rows.log), dtype=bool)
            score = np.array([self._scores(model, whole, whole).sum() for model in models.values()])
            numbers = np.array([5 * len(bins) + 3 * (memory is not None) for _, bins, memory in models.values()])
            n = len(rows.log)
            return choose_by_bic(names, score, numbers, n, n * self.worth, simplest=self.simplest)
        passes, which = np.unique(rows.pass_ix, return_inverse=True)
        scores = np.zeros((len(names), len(passes)))
        for fold in np.unique(rows.fold):
            held_out = rows.fold == fold
            for k, model in enumerate(models.values()):
                scores[k] += np.bincount(which[held_out], self._scores(model, ~held_out, held_out), len(passes))
        return choose_rung(names, scores, np.bincount(which), simplest=self.simplest)

    def _scores(self, model: _Model, into: Any, of: Any) -> Float:
        """Log-likelihood of each of the rows `of` given those before it, fitted to the rows `into`."""
        error_m, bins, memory = model
        bin_ix = find_bin(self.rows.view, bins)
        fitted, scored = build_series(self.rows.take(into)), build_series(self.rows.take(of))
        shares = memory or MemoryShares()
        if memory is not None and not np.all(into):
            first = fit_moments(error_m[into], bin_ix[into], len(bins), fitted, memory)
            shares = refit_error_memory(first.standardised(error_m[into], bin_ix[into]), fitted, memory, centred=True)
        moments = fit_moments(error_m[into], bin_ix[into], len(bins), fitted, shares)
        out, variance = whiten_series(moments.standardised(error_m[of], bin_ix[of]), scored, shares)
        log: Float = -0.5 * (out**2).sum(axis=1) - np.log(variance) - np.log(2 * np.pi)
        scored_: Float = log - moments.log_determinant()[bin_ix[of]]
        return scored_


def _estimate_bin(where: RangeBin, moments: Moments, b: int) -> ErrorBin:
    (xx, xy), (_, yy) = moments.covariance_m2[b]
    n, worth, freedom = int(moments.n[b]), 1 / float(moments.of_mean[b]), float(moments.freedom[b])
    quantile = t.ppf(0.975, max(worth - 1, 1))
    means = [
        Estimate(float(value), float(value - quantile * error), float(value + quantile * error), n, worth)
        for value, error in zip(moments.mean_m[b], np.sqrt(np.array([xx, yy]) / worth), strict=True)
    ]
    half_width = 1.96 * np.sqrt((xx * yy + xy**2) / freedom)
    between = Estimate(float(xy), float(xy - half_width), float(xy + half_width), n, freedom)
    return ErrorBin(
        where, (means[0], means[1]), (_estimate_variance(xx, n, freedom), between, _estimate_variance(yy, n, freedom))
    )


def _estimate_variance(value: float, n: int, freedom: float) -> Estimate:
    low, high = freedom * value / chi2.ppf([0.975, 0.025], max(freedom, 1.0))
    return Estimate(float(value), float(low), float(high), n, freedom)


def _explain_no_gaussian(listed: NDArray[Any], backwards: Bool) -> str | None:
    """Why errors of a listed field (n,) are no Gaussian: the field is constant, or often points backwards."""
    finite = np.isfinite(listed)
    if finite.any() and np.abs(listed[finite] - listed[finite][0]).max() < 1e-3:
        return "the same in every entry"
    share = float(backwards[finite].mean()) if finite.any() else 0.0
    return f"{share:.0%} of the entries point backwards, which no Gaussian does" if share > _REVERSED else None


def _fit_spread(
    values: Float, rows: FitRows, *, simplest: bool
) -> tuple[Estimate | None, tuple[LastingPart, ...], str | None]:
    """The common standard deviation about 0 of columns (n, C), the parts that last, and why something is not fitted."""
    finite = np.asarray(np.isfinite(values).all(axis=1))
    n, C = int(finite.sum()), values.shape[1]
    if n < FEWEST:
        none = f"the lists have {'only some of its fields' if np.isfinite(values).any() else 'no such field'}"
        return None, (), none if n == 0 else f"{n} entries have it"
    sigma = float(np.sqrt((values[finite] ** 2).mean()))
    if sigma < 1e-9:
        return None, (), "it is exact"
    series = build_series(rows.take(finite))
    memory = ErrorMemoryFit() if simplest else fit_error_memory(values[finite] / sigma, series, centred=False)
    shares = memory.shares
    zeros = np.zeros(n, dtype=np.int64)
    pairs = sum_squared_correlations(series.decay(shares.tau_s), series.new, zeros, 1, shares.drift, shares.constant)
    freedom = C * n**2 / float(pairs[0])
    square = _estimate_variance(sigma**2, C * n, freedom)
    return (
        Estimate(sigma, float(np.sqrt(square.low)), float(np.sqrt(square.high)), C * n, freedom),
        memory.parts,
        memory.untold,
    )


def _measure_shape(z: Float) -> ErrorShape:
    """The shape of standardised errors (n, 2); t₄ at the best of some scales."""
    from scipy.stats import norm

    each = (z - z.mean(axis=0)) / z.std(axis=0)
    scales = np.geomspace(0.4, 1.1, 36)
    of_t4 = max(float((t.logpdf(each / scale, 4) - np.log(scale)).mean()) for scale in scales)
    kurtosis = float((each**4).mean()) - 3
    return ErrorShape(z, kurtosis, of_t4 - float(norm.logpdf(each).mean()))
