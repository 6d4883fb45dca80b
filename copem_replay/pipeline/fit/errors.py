"""How far off entries are: mean and covariance of the position by bins, other spreads, and what of all that lasts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, t

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.pipeline.fit.choice import Rung, choose, choose_by_bic, held_out_possible
from copem_replay.pipeline.fit.error_bins import Bin, Moments, bin_of, fit_moments, range_bins, share_bins
from copem_replay.pipeline.fit.error_memory import (
    LastingPart,
    MemoryFit,
    Series,
    Shares,
    fit_memory,
    refit_memory,
    whitened,
)
from copem_replay.pipeline.fit.errors_kernel import squared_correlations
from copem_replay.pipeline.fit.estimate import PER_ROW, Estimate, digits
from copem_replay.pipeline.fit.pose import PoseFit
from copem_replay.pipeline.fit.rows import FitLists, FitRows

Frame = Literal["line_of_sight", "absolute"]
FEWEST = 8
"""Entries below which no error is fitted (chosen)."""
_REVERSED, _STILL_MPS = 0.05, 1.0
"""Entries that point backwards are no outliers from this share on; slower than this none does (chosen)."""
_ONE, _RANGE, _SHARE, _MEMORY = "one covariance", "by range", "by range and visible share", " + memory"


@dataclass(frozen=True)
class ErrorBin:
    """One couple's error: where it holds, the mean (m), and the covariance's entries (m²) xx, xy and yy."""

    where: Bin
    mean_m: tuple[Estimate, Estimate]
    covariance_m2: tuple[Estimate, Estimate, Estimate]


@dataclass(frozen=True)
class Shape:
    """Whether the errors are Gaussian: standardised ones `z (n, 2)`, their excess kurtosis, and how many nats per row
    Student's t₄ explains more (less: negative).
    """

    z: Float = field(metadata={PER_ROW: True})
    excess_kurtosis: float
    t4_gain: float


@dataclass(frozen=True)
class ErrorFit:
    """The errors of entries. `frame`, `bins`: of the position. Spreads are None where lists have no such field.

    `memory`: by quantity the parts that last. `shares`: the same of the position, as numbers. `rows (n,)`: which rows
    of `FitRows` have an entry, `bin_ix` their bin. `ladder`: what was compared; `frames`: the two frames.
    """

    frame: Frame
    bins: tuple[ErrorBin, ...]
    yaw_sigma_deg: Estimate | None
    speed_sigma_mps: Estimate | None
    size_sigma_m: Estimate | None
    memory: Mapping[str, tuple[LastingPart, ...]]
    shares: Shares
    shape: Shape
    rows: Int = field(metadata={PER_ROW: True})
    bin_ix: Int = field(metadata={PER_ROW: True})
    ladder: tuple[Rung, ...]
    frames: tuple[Rung, ...]
    untold: Mapping[str, str]

    def yaml_error(self, bin_: ErrorBin) -> dict[str, Any]:
        """The keys of an error model, as it is replayed."""
        xx, xy, yy = (digits(one.value) for one in bin_.covariance_m2)
        within = 0.9999 * np.sqrt(xx * yy)  # rounding may not make it singular
        out: dict[str, Any] = {"kind": "gaussian", "frame": self.frame}
        xy = digits(float(np.clip(xy, -within, within)))
        out |= {"mean_m": [digits(one.value) for one in bin_.mean_m], "covariance_m2": [[xx, xy], [xy, yy]]}
        for name in ("yaw_sigma_deg", "speed_sigma_mps", "size_sigma_m"):
            if (sigma := getattr(self, name)) is not None:
                out[name] = digits(sigma.value)
        return out

    @property
    def yaml_memory(self) -> dict[str, list[dict[str, Any]]]:
        """The keys of `memory`."""
        return {name: [part.yaml for part in parts] for name, parts in self.memory.items() if parts}


def without_pose(fit: ErrorFit, placed: PoseFit) -> ErrorFit:
    """The errors without what the unit's own pose makes of them, which is replayed beside: the variances are less.

    Across the line of sight a turn moves what is at range r by r θ; in easting and northing by half of that each. What
    is left is a twentieth at least.
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
    """Fit the errors of all listed rows. `edges_m`: bounds between bins of range, left out: quantiles.

    Raises InputError where too few rows are listed.
    """
    listed = np.flatnonzero(rows.listed & np.isfinite(rows.along_m) & np.isfinite(rows.across_m))
    if len(listed) < FEWEST:
        raise InputError(f"{len(listed)} entries are of a true object: errors need at least {FEWEST}")
    some = rows.take(listed)
    series = series_of(some)
    errors = {
        "line_of_sight": np.column_stack([some.along_m, some.across_m]),
        "absolute": np.column_stack([some.east_m, some.north_m]),
    }
    everything = np.zeros(len(listed), dtype=np.int64)
    los_m = errors["line_of_sight"]
    z = fit_moments(los_m, everything, 1, series, Shares()).standardised(los_m, everything)
    start = fit_memory(z, series, centred=True, intervals=False).shares
    worth = 1 / float(fit_moments(los_m, everything, 1, series, start).of_mean[0]) / len(listed)
    by_range = range_bins(some.view, worth, edges_m)
    finer = share_bins(by_range, some.view, worth)
    whole = (Bin((0.0, by_range[-1].range_m[1])),)
    candidates = {_ONE: whole} | ({_RANGE: by_range} if len(by_range) > 1 else {})
    candidates |= {_SHARE: finer} if len(finer) > len(by_range) else {}
    test = _Trial(some, series, worth, simplest)
    wide = list(candidates.values())[-1]
    frame_ix, frames = test.choose({name: (error_m, wide, None) for name, error_m in errors.items()})
    frame: Frame = ("line_of_sight", "absolute")[frame_ix]
    error_m = errors[frame]
    bins_ix, ladder = test.choose({name: (error_m, bins, None) for name, bins in candidates.items()})
    name, bins = list(candidates.items())[bins_ix]
    bin_ix = bin_of(some.view, bins)
    memory = _memory(error_m, bin_ix, len(bins), series, start)
    last_ix, last = test.choose({name: (error_m, bins, None), name + _MEMORY: (error_m, bins, memory.shares)})
    if last_ix == 0:
        instead = memory.untold or f"no better on passes held out ({last[1].words()})"
        memory = MemoryFit(log_likelihood=memory.log_likelihood, untold=instead)
    moments = fit_moments(error_m, bin_ix, len(bins), series, memory.shares)
    found, untold = {"position": memory.parts}, dict[str, str]()
    if memory.untold is not None:
        untold["memory.position"] = memory.untold
    spreads: dict[str, Estimate | None] = {}
    fields = {"yaw": np.rad2deg(some.yaw_rad)[:, None], "speed": some.speed_mps[:, None], "size": some.size_m.T}
    said = {"yaw": np.exp(1j * (some.view.yaw_rad + some.yaw_rad)), "speed": some.view.speed_mps + some.speed_mps}
    backwards = {"yaw": np.abs(some.yaw_rad) > np.pi / 2, "speed": said["speed"] < -_STILL_MPS}
    for key, values in fields.items():
        no_spread = _no_gaussian(said[key], backwards[key]) if key in said else None
        spread, parts, why = (None, (), no_spread) if no_spread else _spread(values, some, simplest=simplest)
        spreads[key] = spread
        found[key] = parts
        if why is not None:
            untold[f"memory.{key}" if spread is not None else key] = why
    return ErrorFit(
        frame, tuple(_estimates(one, moments, b) for b, one in enumerate(bins)),
        spreads["yaw"], spreads["speed"], spreads["size"],
        found, memory.shares, _shape(moments.standardised(error_m, bin_ix)), listed, bin_ix,
        (*(rung for rung in ladder if not rung.chosen), *last), frames, untold,
    )  # fmt: skip


def series_of(rows: FitRows) -> Series:
    """The entries of each object in each log as a series: what is constant in a replay is one number in it."""
    new = np.ones(len(rows.log), dtype=bool)
    new[1:] = (np.diff(rows.log) != 0) | (np.diff(rows.object) != 0)
    gap_s = np.diff(rows.captured_s, prepend=0.0)
    return Series(np.where(new, 0.0, gap_s), new)


def _memory(error_m: Float, bin_ix: Int, bins: int, series: Series, start: Shares) -> MemoryFit:
    """The memory of errors by bins, jointly with their moments: in turns, twice."""
    for last in (False, True):
        z = fit_moments(error_m, bin_ix, bins, series, start).standardised(error_m, bin_ix)
        fit = fit_memory(z, series, centred=True, intervals=last)
        start = fit.shares
    return fit


_Model = tuple[Float, tuple[Bin, ...], Shares | None]
"""Errors (n, 2), bins, and a memory (None: without)."""


@dataclass(frozen=True)
class _Trial:
    """Models against each other on what they were not fitted to."""

    rows: FitRows
    series: Series
    worth: float
    simplest: bool

    def choose(self, models: Mapping[str, _Model]) -> tuple[int, tuple[Rung, ...]]:
        """Which of some models, from the simplest to the richest."""
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
            out = rows.fold == fold
            for k, model in enumerate(models.values()):
                scores[k] += np.bincount(which[out], self._scores(model, ~out, out), len(passes))
        return choose(names, scores, np.bincount(which), simplest=self.simplest)

    def _scores(self, model: _Model, into: Any, of: Any) -> Float:
        """Log-likelihood of each of the rows `of` given those before it, fitted to the rows `into`."""
        error_m, bins, memory = model
        bin_ix = bin_of(self.rows.view, bins)
        fitted, scored = series_of(self.rows.take(into)), series_of(self.rows.take(of))
        shares = memory or Shares()
        if memory is not None and not np.all(into):
            first = fit_moments(error_m[into], bin_ix[into], len(bins), fitted, memory)
            shares = refit_memory(first.standardised(error_m[into], bin_ix[into]), fitted, memory, centred=True)
        moments = fit_moments(error_m[into], bin_ix[into], len(bins), fitted, shares)
        out, variance = whitened(moments.standardised(error_m[of], bin_ix[of]), scored, shares)
        log: Float = -0.5 * (out**2).sum(axis=1) - np.log(variance) - np.log(2 * np.pi)
        scored_: Float = log - moments.log_determinant()[bin_ix[of]]
        return scored_


def _estimates(where: Bin, moments: Moments, b: int) -> ErrorBin:
    (xx, xy), (_, yy) = moments.covariance_m2[b]
    n, worth, freedom = int(moments.n[b]), 1 / float(moments.of_mean[b]), float(moments.freedom[b])
    far = t.ppf(0.975, max(worth - 1, 1))
    means = [
        Estimate(float(value), float(value - far * error), float(value + far * error), n, worth)
        for value, error in zip(moments.mean_m[b], np.sqrt(np.array([xx, yy]) / worth), strict=True)
    ]
    aside = 1.96 * np.sqrt((xx * yy + xy**2) / freedom)
    between = Estimate(float(xy), float(xy - aside), float(xy + aside), n, freedom)
    return ErrorBin(where, (means[0], means[1]), (_variance(xx, n, freedom), between, _variance(yy, n, freedom)))


def _variance(value: float, n: int, freedom: float) -> Estimate:
    low, high = freedom * value / chi2.ppf([0.975, 0.025], max(freedom, 1.0))
    return Estimate(float(value), float(low), float(high), n, freedom)


def _no_gaussian(said: NDArray[Any], backwards: Bool) -> str | None:
    """Why errors of what entries say (n,) are no spread: the field is never filled, or often reversed."""
    there = np.isfinite(said)
    if there.any() and np.abs(said[there] - said[there][0]).max() < 1e-3:
        return "the same in every entry"
    share = float(backwards[there].mean()) if there.any() else 0.0
    return f"{share:.0%} of the entries point backwards, which no Gaussian does" if share > _REVERSED else None


def _spread(
    values: Float, rows: FitRows, *, simplest: bool
) -> tuple[Estimate | None, tuple[LastingPart, ...], str | None]:
    """Standard deviation about 0 of columns (n, C) that have one in common, what of it lasts, what cannot be told."""
    there = np.asarray(np.isfinite(values).all(axis=1))
    n, C = int(there.sum()), values.shape[1]
    if n < FEWEST:
        none = f"the lists have {'only some of its fields' if np.isfinite(values).any() else 'no such field'}"
        return None, (), none if n == 0 else f"{n} entries have it"
    sigma = float(np.sqrt((values[there] ** 2).mean()))
    if sigma < 1e-9:
        return None, (), "it is exact"
    series = series_of(rows.take(there))
    memory = MemoryFit() if simplest else fit_memory(values[there] / sigma, series, centred=False)
    shares = memory.shares
    zeros = np.zeros(n, dtype=np.int64)
    pairs = squared_correlations(series.decay(shares.tau_s), series.new, zeros, 1, shares.drift, shares.constant)
    freedom = C * n**2 / float(pairs[0])
    square = _variance(sigma**2, C * n, freedom)
    return (
        Estimate(sigma, float(np.sqrt(square.low)), float(np.sqrt(square.high)), C * n, freedom),
        memory.parts,
        memory.untold,
    )


def _shape(z: Float) -> Shape:
    from scipy.stats import norm

    each = (z - z.mean(axis=0)) / z.std(axis=0)
    scales = np.geomspace(0.4, 1.1, 36)
    of_t4 = max(float((t.logpdf(each / scale, 4) - np.log(scale)).mean()) for scale in scales)
    kurtosis = float((each**4).mean()) - 3
    return Shape(z, kurtosis, of_t4 - float(norm.logpdf(each).mean()))
