"""The errors of entries: mean and covariance of the position by bins, the spread of other fields, and their memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from scipy.stats import chi2

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.core.yaml import CommentedValue
from copem_replay.extras.fitting.error_memory import (
    ErrorMemoryFit,
    LastingPart,
    MemoryShares,
    ResidualSeries,
    fit_error_memory,
    refit_error_memory,
    sum_correlations,
    whiten_series,
)
from copem_replay.extras.fitting.estimate import (
    DROP,
    PER_ROW,
    Estimate,
    Rung,
    compare_models,
    maximise_likelihood,
    profile_limits,
    round_digits,
)
from copem_replay.extras.fitting.moments import (
    BetweenLogs,
    ErrorBin,
    Moments,
    RangeBin,
    class_bins,
    estimate_bin,
    estimate_variance,
    find_bin,
    fit_between_logs,
    fit_moments,
    lag_one_correlation,
    range_bins,
    share_bins,
)
from copem_replay.extras.fitting.pose import PoseFit
from copem_replay.extras.fitting.rows import FitRows

# Fits of errors.

Frame = Literal["line_of_sight", "absolute"]
FEWEST = 8
"""Entries below which no error is fitted: a mean and a covariance are five numbers."""
_REVERSED, _STILL_MPS = 0.05, 1.0
"""Share from which on entries that point backwards are no outliers, and speed below which an entry does not count as
backwards: there its sign is noise."""
_FREEDOMS = (2.05, 200.0)
"""Degrees of freedom of Student's t that are tried: at 2 it has no variance, at 200 it is a Gaussian."""
_EVERYWHERE = (RangeBin((0.0, np.inf)),)
_ONE, _RANGE, _SHARE, _MEMORY = "one covariance", "by range", "by range and visible share", " + memory"


@dataclass(frozen=True)
class ErrorShape:
    """Whether errors are Gaussian: standardised errors `z (n, 2)`, their excess kurtosis, and Student's t beside it.

    `degrees_of_freedom`: of the likeliest t; `gain`: nats per row that it explains more than a Gaussian. `heavier`:
    beyond chance; `untold`: why it is not written nonetheless.
    """

    z: Float = field(metadata={PER_ROW: True})
    excess_kurtosis: float
    degrees_of_freedom: Estimate
    gain: float
    heavier: bool
    untold: str | None = None

    @property
    def written(self) -> bool:
        """Whether the written model is Student's t."""
        return self.heavier and self.untold is None

    def words(self) -> str:
        """The tails of the errors in words."""
        if not self.heavier:
            return f"tails no heavier than a Gaussian's (excess kurtosis {self.excess_kurtosis:.2g})"
        nu = self.degrees_of_freedom
        return (
            f"tails are heavier than a Gaussian's: Student's t with {nu.value:.3g} degrees of freedom "
            f"({nu.shown()[1]}) explains {self.gain:.2g} nats per entry more"
            f"{f', but is not written: {self.untold}' if self.untold else ', and is written'}"
        )


@dataclass(frozen=True)
class ErrorFit:
    """The errors of entries. `frame`, `bins`: of the position. Spreads are None where lists have no such field.

    `memory`: by quantity the parts that last; `shares`: those of the position as numbers. `rows (n,)`: which rows of
    `FitRows` have an entry; `bin_ix`: their bin. `ladder`: the models that were compared; `frames`: the two frames.
    `untold`: by key why the data do not determine it. `between_logs`: None of fewer than three logs.
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
    between_logs: BetweenLogs | None = None

    @property
    def axes(self) -> tuple[str, str]:
        """The names of the frame's axes."""
        return ("along", "across") if self.frame == "line_of_sight" else ("east", "north")

    def error_keys(self, bin_: ErrorBin) -> dict[str, Any]:
        """The error model of a bin as keys of the experiment file: mean (m), covariance (m²), tails, other fields."""
        xx, xy, yy = (round_digits(estimate.value) for estimate in bin_.covariance_m2)
        largest_xy = 0.9999 * np.sqrt(xx * yy)  # rounding must not make it singular
        xy = round_digits(float(np.clip(xy, -largest_xy, largest_xy)))
        out: dict[str, Any] = {"kind": "gaussian", "frame": self.frame}
        if self.shape.written:
            nu = self.shape.degrees_of_freedom
            words = f"{nu.words()}; {self.shape.words()}"
            out |= {"kind": "student_t", "degrees_of_freedom": CommentedValue(round_digits(nu.value, 3), words)}
        first, covariance, second = (estimate.words() for estimate in bin_.covariance_m2)
        out |= {
            "mean_m": [estimate.written() for estimate in bin_.mean_m],
            "covariance_m2": [
                CommentedValue([xx, xy], f"variance {first}; covariance {covariance}"),
                CommentedValue([xy, yy], f"variance {second}"),
            ],
        }
        names = ("yaw_sigma_deg", "speed_sigma_mps", "size_sigma_m")
        return out | {name: sigma.written() for name in names if (sigma := getattr(self, name)) is not None}

    def memory_keys(self) -> dict[str, list[dict[str, Any]]]:
        """The keys of `memory`. What differs between logs is a part of all objects of the unit, and is taken off the
        parts of single objects: first the constant one, then those that drift.
        """
        out = {name: [part.keys() for part in parts] for name, parts in self.memory.items() if parts}
        normal_share = gaussian_share(self.shape.degrees_of_freedom.value) if self.shape.written else 1.0
        between_logs = None if self.between_logs is None or self.between_logs.untold else self.between_logs
        remaining, position = 0.0 if between_logs is None else round(between_logs.share, 3), []
        for part in sorted(
            self.memory["position"], key=lambda one: between_logs is not None and one.correlation_s != "always"
        ):
            removed = min(remaining, part.share.value)
            remaining -= removed
            words = part.share.words() + (f", of which t keeps {normal_share:.2g}" if self.shape.written else "")
            words += f"; {removed:.3g} of it differs between logs" if removed else ""
            if (remaining_share := round(part.share.value / normal_share - removed, 3)) > 0 or between_logs is None:
                position.append(part.keys() | {"share": CommentedValue(remaining_share, words)})
        if between_logs is not None:
            words = "between logs: " + " and ".join(f"{one.words()} m" for one in between_logs.sigma_m)
            share = CommentedValue(round(between_logs.share, 3), words)
            position.append({"share": share, "correlation_s": "always", "of": "unit"})
        return out | ({"position": position} if position else {})


def remove_pose(fit: ErrorFit, placed: PoseFit) -> ErrorFit:
    """The errors without the part that is due to the unit's own pose, which is replayed by itself.

    Across the line of sight a turn θ moves an entry at range r by r θ; in easting and northing the variance is half of
    that each. At least a twentieth of each variance is left.
    """
    if placed.untold is not None or placed.position_sigma_m is None or placed.yaw_sigma_deg is None:
        return fit
    shift_m2, turn = placed.position_sigma_m.value**2, np.deg2rad(placed.yaw_sigma_deg.value) ** 2
    bins = []
    for error_bin in fit.bins:
        near_m, far_m = error_bin.where.range_m
        turned_m2 = turn * (near_m**2 + near_m * far_m + far_m**2) / 3
        parts = (0.0, 1.0) if fit.frame == "line_of_sight" else (0.5, 0.5)
        first, cov, second = error_bin.covariance_m2
        xx, yy = (
            _remove_variance(of, shift_m2 + part * turned_m2) for of, part in zip((first, second), parts, strict=True)
        )
        most = np.sqrt(xx.value * yy.value / (first.value * second.value))
        bins.append(replace(error_bin, covariance_m2=(xx, replace(cov, value=cov.value * min(most, 1.0)), yy)))
    return replace(fit, bins=tuple(bins))


def _remove_variance(variance: Estimate, pose_m2: float) -> Estimate:
    """A variance less that of the pose, and a twentieth of it at least; then the data leave open what it is."""
    least = variance.value / 20
    value, low, high = (max(one - pose_m2, least) for one in (variance.value, variance.low, variance.high))
    why = "the pose of the unit explains nearly all of it" if value == least and variance.why is None else variance.why
    return replace(variance, value=value, low=0.0 if why else low, high=high, why=why)


def fit_errors(rows: FitRows, *, simplest: bool = False) -> ErrorFit:
    """Fit the errors of all listed rows. Raises InputError where too few rows are listed."""
    listed = np.flatnonzero(rows.listed & np.isfinite(rows.along_m) & np.isfinite(rows.across_m))
    if len(listed) < FEWEST:
        raise InputError(f"{len(listed)} entries are of a true object: errors need at least {FEWEST}")
    entries = rows.take(listed)
    series, one_bin = build_series(entries), np.zeros(len(listed), dtype=np.int64)
    los_m = np.column_stack([entries.along_m, entries.across_m])
    z = fit_moments(los_m, one_bin, _EVERYWHERE, series, MemoryShares()).standardised(los_m, one_bin)
    start = fit_error_memory(z, series, centred=True, intervals=False).shares
    worth = float(fit_moments(los_m, one_bin, _EVERYWHERE, series, start).freedom.min()) / len(listed)
    trial = _ModelTrial(entries, series, worth, simplest)
    frame, (error_m, bins, _), memory, ladder, frames = _choose_model(trial, start)
    bin_ix = find_bin(entries.view, bins)
    moments = fit_moments(error_m, bin_ix, bins, series, memory.shares)
    between = fit_between_logs(error_m - moments.mean_m[bin_ix], entries.log, series, memory.shares)
    if between is not None:
        moments = replace(moments, half_width_m=np.maximum(moments.half_width_m, between.half_width_m))
    shape = _measure_shape(moments.standardised(error_m, bin_ix), series, memory.shares, between, simplest)
    spreads, lasting, untold = _fit_spreads(entries, simplest=simplest)
    if memory.untold is not None:
        untold = {"memory.position": memory.untold} | untold
    return ErrorFit(
        frame, _estimate_bins(bins, moments, shape, error_m, bin_ix), spreads["yaw"], spreads["speed"], spreads["size"],
        {"position": memory.parts} | lasting, memory.shares, shape, listed, bin_ix, ladder, frames, untold, between,
    )  # fmt: skip


def _choose_model(
    trial: _ModelTrial, start: MemoryShares
) -> tuple[Frame, _Model, ErrorMemoryFit, tuple[Rung, ...], tuple[Rung, ...]]:
    """The frame, the model in it, its memory, and the tables that compare models and frames."""
    rows, series = trial.rows, trial.series
    errors: dict[Frame, Float] = {
        "line_of_sight": np.column_stack([rows.along_m, rows.across_m]),
        "absolute": np.column_stack([rows.east_m, rows.north_m]),
    }
    by_range = range_bins(rows.view, trial.worth)
    finer = share_bins(by_range, rows.view, trial.worth)
    candidates: dict[str, tuple[RangeBin, ...]] = {_ONE: (RangeBin((0.0, by_range[-1].range_m[1])),)}
    candidates |= {
        name: bins for name, bins, than in ((_RANGE, by_range, 1), (_SHARE, finer, len(by_range))) if len(bins) > than
    }
    most_bins = list(candidates.values())[-1]
    frame_ix, frames = trial.choose({str(name): (error_m, most_bins, None) for name, error_m in errors.items()})
    frame, error_m = list(errors.items())[frame_ix]
    bins_ix, ladder = trial.choose({name: (error_m, bins, None) for name, bins in candidates.items()})
    name, bins = list(candidates.items())[bins_ix]
    memory = _fit_error_memory(error_m, find_bin(rows.view, bins), bins, series, start)
    model: _Model = (error_m, bins, memory.shares)
    _, last_rungs = trial.choose({name: (error_m, bins, None), name + _MEMORY: model})
    last_rungs = tuple(replace(rung, chosen=k == bool(memory.parts)) for k, rung in enumerate(last_rungs))
    split = class_bins(bins, rows.view, trial.worth)
    if len(split) > len(bins) and not trial.simplest:
        class_memory = _fit_error_memory(error_m, find_bin(rows.view, split), split, series, memory.shares)
        gain = trial.gain((error_m, split, class_memory.shares), model) / len(error_m)
        class_is_better = gain * len(error_m) > float(chi2.ppf(0.95, 5 * (len(split) - len(bins)))) / 2
        score = last_rungs[bool(memory.parts)].score + gain
        by_class = Rung(f"{name} and class{_MEMORY}", score, max(-gain, 0.0), 0.0, class_is_better, "likelihood")
        last_rungs = (*(replace(rung, chosen=rung.chosen and not class_is_better) for rung in last_rungs), by_class)
        model, memory = ((error_m, split, class_memory.shares), class_memory) if class_is_better else (model, memory)
    if trial.simplest and memory.parts:
        memory = ErrorMemoryFit(log_likelihood=memory.log_likelihood, untold="the simplest model was asked for")
        last_rungs = tuple(replace(rung, chosen=k == 0) for k, rung in enumerate(last_rungs))
    return frame, model, memory, (*(rung for rung in ladder if not rung.chosen), *last_rungs), frames


def _fit_spreads(
    rows: FitRows, *, simplest: bool
) -> tuple[dict[str, Estimate | None], dict[str, tuple[LastingPart, ...]], dict[str, str]]:
    """By `yaw` (°), `speed` (m/s), `size` (m): spread, lasting parts, why one lacks; `simplest`: nothing lasts."""
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
    error_m: Float, bin_ix: Int, bins: tuple[RangeBin, ...], series: ResidualSeries, start: MemoryShares
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
        """The index of the chosen model, from the simplest to the richest, and the table that compares them."""
        rows = self.rows
        _, first, pass_of_row = np.unique(rows.pass_ix, return_index=True, return_inverse=True)
        candidates = list(models.values())

        def score(k: int, held_out: Bool) -> Float:
            scored_rows = held_out[pass_of_row] | (not held_out.any())
            rows_of = self._scores(candidates[k], ~held_out[pass_of_row], scored_rows)
            return np.bincount(pass_of_row[scored_rows], weights=rows_of, minlength=len(first)).astype(np.float64)

        numbers = np.array([5 * len(bins) + 3 * (memory is not None) for _, bins, memory in candidates])
        worth = len(rows.log) * self.worth
        return compare_models(
            list(models), score, rows.fold[first], np.bincount(pass_of_row), numbers, worth, simplest=self.simplest
        )

    def gain(self, model: _Model, base: _Model) -> float:
        """By how much the log-likelihood of all rows is higher under a model than under another, both fitted to all."""
        whole = np.ones(len(self.rows.log), dtype=bool)
        return float(self._scores(model, whole, whole).sum() - self._scores(base, whole, whole).sum())

    def _scores(self, model: _Model, train: Any, test: Any) -> Float:
        """Log-likelihood of each row `test`, given those before it, by the model fitted to the rows `train`."""
        error_m, bins, memory = model
        bin_ix = find_bin(self.rows.view, bins)
        fitted, scored = build_series(self.rows.take(train)), build_series(self.rows.take(test))
        shares = memory or MemoryShares()
        if memory is not None and not np.all(train):
            first = fit_moments(error_m[train], bin_ix[train], bins, fitted, memory)
            shares = refit_error_memory(first.standardised(error_m[train], bin_ix[train]), fitted, memory, centred=True)
        moments = fit_moments(error_m[train], bin_ix[train], bins, fitted, shares)
        out, variance = whiten_series(moments.standardised(error_m[test], bin_ix[test]), scored, shares)
        log: Float = -0.5 * (out**2).sum(axis=1) - np.log(variance) - np.log(2 * np.pi)
        scored_: Float = log - moments.log_determinant()[bin_ix[test]]
        return scored_


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
    """The standard deviation about 0 of columns (n, C) taken together, its lasting parts, and why it is not fitted."""
    is_finite = np.asarray(np.isfinite(values).all(axis=1))
    n, C = int(is_finite.sum()), values.shape[1]
    if n < FEWEST:
        why_none = f"the lists have {'only some of its fields' if np.isfinite(values).any() else 'no such field'}"
        return None, (), why_none if n == 0 else f"{n} entries have it"
    sigma = float(np.sqrt((values[is_finite] ** 2).mean()))
    if sigma < 1e-9:
        return None, (), "it is exact"
    series = build_series(rows.take(is_finite))
    memory = ErrorMemoryFit() if simplest else fit_error_memory(values[is_finite] / sigma, series, centred=False)
    shares = memory.shares
    zeros = np.zeros(n, dtype=np.int64)
    _, twice = sum_correlations(series.decay(shares.tau_s), series.new, zeros, 1, shares.drift, shares.constant)
    phi = np.mean([lag_one_correlation(column, series.new) for column in values[is_finite].T])
    freedom = C * min(n**2 / float(twice[0]), n * (1 - phi**2) / (1 + phi**2))
    square = estimate_variance(sigma**2, C * n, freedom)
    return (
        Estimate(sigma, float(np.sqrt(square.low)), float(np.sqrt(square.high)), C * n, freedom),
        memory.parts,
        memory.untold,
    )


def _measure_shape(
    z: Float, series: ResidualSeries, shares: MemoryShares, between: BetweenLogs | None, simplest: bool
) -> ErrorShape:
    """How heavy the tails of standardised errors (n, 2) are: Student's t with its degrees of freedom, by likelihood."""
    innovations, _ = whiten_series(z, series, shares)
    squares = (innovations**2).sum(axis=1)
    n = len(squares)
    kurtosis = float((((z - z.mean(axis=0)) / z.std(axis=0)) ** 4).mean()) - 3

    def of(x: Float) -> float:
        freedom, scale = np.exp(x)
        log = gammaln(freedom / 2 + 1) - gammaln(freedom / 2) - np.log(freedom * np.pi * scale)
        return float(n * log - (freedom / 2 + 1) * np.log1p(squares / (freedom * scale)).sum())

    bounds = (np.log(_FREEDOMS), np.log([1e-3, 1e3]))
    pairs = [(float(low), float(high)) for low, high in bounds]
    best, value = maximise_likelihood(of, [(np.log(4.0), -0.5), (np.log(20.0), 0.0)], pairs)
    gain = value + n * (np.log(np.pi * squares.mean()) + 1)
    freedom = float(np.exp(best[0]))
    low, high = np.exp(profile_limits(of, best, value, 0, pairs)) if gain > DROP else (freedom, np.inf)
    estimate = Estimate(freedom, float(low), float(high), n, float(n))
    normal_share = gaussian_share(freedom)
    why = None
    if shares.drift + shares.constant > normal_share:
        why = f"what lasts is more than the share of {normal_share:.2g} of the variance that it could have"
    if simplest or (between is not None and between.untold is None):
        why = "the simplest model was asked for" if simplest else "errors differ between logs, which is written instead"
    return ErrorShape(z, kurtosis, estimate, gain / n, bool(gain > DROP), why)


def _estimate_bins(
    bins: tuple[RangeBin, ...], moments: Moments, shape: ErrorShape, error_m: Float, bin_ix: Int
) -> tuple[ErrorBin, ...]:
    """The error of each bin: mean (m), covariance (m²) of the position; of Student's t where the fit writes that."""
    nu = shape.degrees_of_freedom
    if not shape.written:
        return tuple(estimate_bin(one, moments, b) for b, one in enumerate(bins))
    moments = weigh_covariances(moments, error_m, bin_ix, nu.value)
    return tuple(_widen_by_tails(estimate_bin(one, moments, b), nu) for b, one in enumerate(bins))


def gaussian_share(nu: float) -> float:
    """The share of the correlation of the normals behind it that Student's t keeps, where its factor is always new."""
    return float((nu - 2) / 2 * np.exp(2 * (gammaln((nu - 1) / 2) - gammaln(nu / 2))))


def weigh_covariances(moments: Moments, error_m: Float, bin_ix: Int, nu: float) -> Moments:
    """Covariances of Student's t by its likelihood: far errors count for less, ν/(ν − 2) makes up for it. Their degrees
    of freedom are those of a Gaussian's over (ν + 4)/(ν + 2) · (1 + 1/ν).
    """
    scatter = moments.covariance_m2 * (nu - 2) / nu
    for _ in range(30):
        d = (replace(moments, covariance_m2=scatter).standardised(error_m, bin_ix) ** 2).sum(axis=1)
        weight = (nu + 2) / (nu + d)
        rest = error_m - moments.mean_m[bin_ix]
        for b in np.flatnonzero(moments.n).tolist():
            mine = bin_ix == b
            scatter[b] = (weight[mine, None] * rest[mine]).T @ rest[mine] / max(int(mine.sum()) - 1, 1)
    less = (nu + 4) / (nu + 2) * (1 + 1 / nu)
    return replace(moments, covariance_m2=scatter * nu / (nu - 2), freedom=moments.freedom / less)


def _widen_by_tails(error_bin: ErrorBin, nu: Estimate) -> ErrorBin:
    """The bin with variances' limits widened by those of ν: a variance is ν/(ν − 2) times that of the bulk."""
    factor, least_factor, most_factor = (
        value / (value - 2) if value > 2.0001 else np.inf for value in (nu.value, min(nu.high, 1e6), nu.low)
    )

    def widen(estimate: Estimate) -> Estimate:
        if not np.isfinite(most_factor):
            return replace(estimate, low=estimate.low * least_factor / factor, high=np.inf)
        return replace(estimate, low=estimate.low * least_factor / factor, high=estimate.high * most_factor / factor)

    xx, xy, yy = error_bin.covariance_m2
    return replace(error_bin, covariance_m2=(widen(xx), xy, widen(yy)))
