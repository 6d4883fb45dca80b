"""The memory of errors: z = √w · drift + √c · constant + √(1 − w − c) · white, from standardised residuals.

The drift is the Ornstein–Uhlenbeck process that is replayed, with e^(−Δ/τ) at any list rate; the constant is one number
per object and log, as `always` is. The likelihood is that of a Kalman filter over irregular lists; scale, and where
asked the mean, are integrated out (REML), so that few series do not look surer than they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.special import expit, logit

from copem_replay.core.compiled import kernel
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.core.yaml import CommentedValue
from copem_replay.extras.fitting.estimate import DROP, Bounds, Estimate, maximise_likelihood, profile_limits

# Kernels: whitening by a Kalman filter, and correlations between rows.


@kernel
def whiten_columns(values: Float, decay: Float, new: Bool, drift: float, constant: float) -> tuple[Float, Float]:
    """Columns (n, K) freed of their memory, (n, K), and the variance of each row given those before it, (n,).

    The model of each column, of variance 1: √drift · Ornstein–Uhlenbeck + √constant · one number per series + white
    noise. `decay (n,)`: e^(−Δ/τ) since the row before; `new (n,)`: a series begins. The filter is linear and its gains
    do not depend on the values: columns of a design are whitened like what is explained by them.

    Source: A. C. Harvey, "Forecasting, structural time series models and the Kalman filter", 1989, 3.4.
    """
    n, K = values.shape
    out, variance = np.empty((n, K)), np.empty(n)
    wander, bias = np.zeros(K), np.zeros(K)
    white_share = max(1.0 - drift - constant, 1e-9)
    aa, ab, bb = drift, 0.0, constant
    for t in range(n):
        if new[t]:
            wander[:] = 0.0
            bias[:] = 0.0
            aa, ab, bb = drift, 0.0, constant
        else:
            f = decay[t]
            aa = f * f * aa + (1.0 - f * f) * drift
            ab *= f
            for k in range(K):
                wander[k] *= f
        of_a, of_b = aa + ab, ab + bb
        s = of_a + of_b + white_share
        gain_a, gain_b, scale = of_a / s, of_b / s, 1.0 / np.sqrt(s)
        for k in range(K):
            innovation = values[t, k] - wander[k] - bias[k]
            out[t, k] = innovation * scale
            wander[k] += gain_a * innovation
            bias[k] += gain_b * innovation
        aa -= gain_a * of_a
        ab -= gain_a * of_b
        bb -= gain_b * of_b
        variance[t] = s
    return out, variance


@kernel
def sum_correlations(decay: Float, new: Bool, bin_ix: Int, bins: int, drift: float, constant: float) -> Float:
    """(2, B) Σ ρ and Σ ρ² over all pairs of rows of a bin, a row with itself as 1. A mean is worth n² over the first
    effective rows, a variance n² over the second.
    """
    out = np.zeros((2, bins))
    lag_sum, square_sum, count = np.zeros(bins), np.zeros(bins), np.zeros(bins)
    for t in range(len(decay)):
        if new[t]:
            lag_sum[:] = 0.0
            square_sum[:] = 0.0
            count[:] = 0.0
        else:
            f = decay[t]
            for b in range(bins):
                lag_sum[b] *= f
                square_sum[b] *= f * f
        b = bin_ix[t]
        out[0, b] += 1.0 + 2.0 * (drift * lag_sum[b] + constant * count[b])
        pairs = drift * drift * square_sum[b] + 2 * drift * constant * lag_sum[b] + constant * constant * count[b]
        out[1, b] += 1.0 + 2.0 * pairs
        lag_sum[b] += 1.0
        square_sum[b] += 1.0
        count[b] += 1.0
    return out


# Fits of the memory.

_ODDS = (-8.0, 16.0)
"""Log-odds beyond which a share counts as none, or all: of smooth errors a ten-millionth is new in every list."""
_LEAST = 1e-3
"""A share below this is a bound that the search has met, and no part of its own."""
_FEWEST = 12
"""Rows below which no memory is fitted: three parameters, and a scale and a mean of each column."""
_ENOUGH = 10_000
"""Rows by which a fit to many starts, and by which a model is refused. More take longer and refuse hardly more."""


@dataclass(frozen=True)
class MemoryShares:
    """Shares of the variance that drift (`drift`, with `tau_s`) and that are `constant`; the rest is white."""

    drift: float = 0.0
    tau_s: float = 1.0
    constant: float = 0.0


@dataclass(frozen=True)
class LastingPart:
    """A part of a PEM's `memory`: its share of the variance, and its correlation time."""

    share: Estimate
    correlation_s: Estimate | Literal["always"]

    def keys(self) -> dict[str, Any]:
        """The keys as the experiment file has them."""
        lasts = self.correlation_s
        return {
            "share": CommentedValue(round(self.share.value, 3), self.share.words()),
            "correlation_s": lasts if isinstance(lasts, str) else lasts.written(),
        }


@dataclass(frozen=True)
class ErrorMemoryFit:
    """The memory of one quantity. `log_likelihood` by model (`none`, `constant`, `drift`, `both`), REML.

    `shares`: of the model that is written, the simplest that the data do not refuse. `parts`: these with intervals
    (under `both`, whichever is written). `untold`: what the data do not determine.
    """

    shares: MemoryShares = MemoryShares()
    parts: tuple[LastingPart, ...] = ()
    log_likelihood: dict[str, float] = field(default_factory=dict)
    untold: str | None = None


class ResidualSeries:
    """Rows (n,) that follow each other: seconds since the one before, and whether a series begins."""

    def __init__(self, gap_s: Float, new: Bool) -> None:
        self.gap_s, self.new = gap_s, new
        self._last = (0.0, gap_s)

    def decay(self, tau_s: float) -> Float:
        """(n,) e^(−Δ/τ)."""
        if self._last[0] != tau_s:  # derivatives by shares keep τ
            self._last = tau_s, np.exp(-self.gap_s / tau_s)
        return self._last[1]

    def some(self, rows: int) -> Int:
        """About `most` rows: those of every n-th series."""
        series_ix = np.cumsum(self.new) - 1
        step = max(len(self.new) // rows, 1)
        return np.flatnonzero(series_ix % step == 0)


def whiten_series(values: Float, series: ResidualSeries, shares: MemoryShares) -> tuple[Float, Float]:
    """Columns (n, K) without their memory, and the variance of each row given those before it (n,)."""
    if shares.drift == shares.constant == 0:
        return values, np.ones(len(values))
    decay = series.decay(shares.tau_s)
    return whiten_columns(np.ascontiguousarray(values), decay, series.new, shares.drift, shares.constant)


def log_likelihood(z: Float, series: ResidualSeries, shares: MemoryShares, *, centred: bool) -> float:
    """REML of columns (n, C) that share a memory: each with a scale, and if `centred` a mean, of its own."""
    n, C = z.shape
    decay, ones = series.decay(shares.tau_s), np.ones((n, 1))
    out, variance = whiten_columns(np.hstack([z, ones]), decay, series.new, shares.drift, shares.constant)
    moments = out.T @ out  # of the columns and, last, of their common mean
    squares, total = moments.diagonal()[:C], -0.5 * C * float(np.log(variance).sum())
    if centred:
        squares, n = squares - moments[C, :C] ** 2 / moments[C, C], n - 1
        total -= 0.5 * C * np.log(moments[C, C])
    return float(total - 0.5 * n * np.log(np.maximum(squares, 1e-300) / n).sum())


_FREE = {"none": [], "constant": [1], "drift": [0, 2], "both": [0, 1, 2]}
"""By model its parameters among the log-odds of the drift, those of the constant in the rest, and ln τ."""
ALLOWED = {"none": 3.907, "constant": 2.996, "drift": DROP, "both": 0.0}
"""By how much the log-likelihood of a simpler model may be less: half of the 95 % quantile of χ²₃, χ²₂ and χ²₁."""


def _unpack_shares(x: Float, swapped: bool = False) -> MemoryShares:
    """Shares from the parameters; `swapped`: the log-odds of the constant, those of the drift in the rest, and ln τ."""
    first = float(expit(x[0]))
    second = (1 - first) * float(expit(x[1]))
    drift, constant = (second, first) if swapped else (first, second)
    return MemoryShares(drift, float(np.exp(x[2])), constant)


def _pack_shares(shares: MemoryShares, swapped: bool = False) -> Float:
    """The parameters that `_unpack_shares` turns into these shares."""
    first, second = (shares.constant, shares.drift) if swapped else (shares.drift, shares.constant)
    first = min(first, 1 - 1e-6)
    return np.array([logit(first), logit(min(second / (1 - first), 1.0)), np.log(shares.tau_s)])


@dataclass(frozen=True)
class _MemoryTrial:
    """Likelihoods of residuals (n, C) under memories. `bounds`: of the three parameters."""

    z: Float
    series: ResidualSeries
    centred: bool
    bounds: Bounds

    @classmethod
    def of(cls, z: Float, series: ResidualSeries, *, centred: bool) -> _MemoryTrial:
        """The trial, with correlation times from a tenth of a gap to twenty times the longest series."""
        longest_s = float(np.bincount(np.cumsum(series.new) - 1, np.where(series.new, 0.0, series.gap_s)).max())
        shortest = np.log(max(np.median(series.gap_s[~series.new]) / 10, 1e-3))
        ends = (shortest, max(np.log(20 * max(longest_s, 1e-3)), shortest + 1))
        # About the mean of a single series there is no constant.
        constant = (_ODDS[0], _ODDS[0]) if centred and series.new.sum() == 1 else _ODDS
        return cls(np.ascontiguousarray(z), series, centred, [_ODDS, constant, ends])

    def likelihood(self, shares: MemoryShares) -> float:
        """The log-likelihood of a memory."""
        return log_likelihood(self.z, self.series, shares, centred=self.centred)

    def climb(self, model: str, starts: Sequence[Float]) -> tuple[Float, float]:
        """The likeliest parameters (3,) of a model from any of `starts` (−∞, 0: absent), and their log-likelihood."""
        free = _FREE[model]

        def fill(x: Float) -> Float:
            out = np.array([-np.inf, -np.inf, 0.0])
            out[free] = x
            return out

        bounds = [self.bounds[k] for k in free]
        found = maximise_likelihood(
            lambda x: self.likelihood(_unpack_shares(fill(x))), [x[free] for x in starts], bounds
        )
        return fill(found[0]), found[1]

    def limits(self, point: Float, k: int, swapped: bool = False) -> tuple[float, float]:
        """The profile interval of parameter k under `both`, whose maximum is near a point."""

        def of(x: Float) -> float:
            return self.likelihood(_unpack_shares(x, swapped))

        return profile_limits(of, *maximise_likelihood(of, [point], self.bounds), k, self.bounds)


def refit_error_memory(z: Float, series: ResidualSeries, start: MemoryShares, *, centred: bool) -> MemoryShares:
    """The shares of greatest likelihood from a start near them, without a choice among models."""
    return _unpack_shares(_MemoryTrial.of(z, series, centred=centred).climb("both", [_pack_shares(start)])[0])


def fit_error_memory(z: Float, series: ResidualSeries, *, centred: bool, intervals: bool = True) -> ErrorMemoryFit:
    """The memory of residuals (n, C); without `intervals` it has no parts. Of many rows some are the start."""
    n, count = len(z), int(series.new.sum())
    if n < _FEWEST or n <= count + 2:
        return ErrorMemoryFit(untold=f"{n} entries in {count} series: no memory can be told")
    trial = _MemoryTrial.of(z, series, centred=centred)
    first = [MemoryShares(w, tau_s, c) for w in (0.3, 0.7) for c in (0.05, 0.2) for tau_s in (0.3, 1.0, 3.0)]
    if n > 2 * _ENOUGH:
        rows = series.some(_ENOUGH)
        few = ResidualSeries(series.gap_s[rows], series.new[rows])
        rough = fit_error_memory(z[rows], few, centred=centred, intervals=False)
        first = [rough.shares] if rough.shares.drift > 0 else first
    best = [_pack_shares(one) for one in sorted(first, key=trial.likelihood, reverse=True)[:2]]
    peak, highest = trial.climb("both", best)
    free, end = _unpack_shares(peak), trial.bounds[2][1]
    lasts = ((free.drift + 0.5 * free.constant, peak[2]), (free.drift + free.constant, end - 3.0))
    instead = [np.array([logit(np.clip(share, 0.01, 0.99)), 0.0, tau]) for share, tau in lasts]
    climbs = {
        "none": trial.climb("none", [peak]),
        "constant": trial.climb("constant", [np.zeros(3), np.full(3, -3.0)]),
        "drift": trial.climb("drift", [peak, *instead]),
    }
    likelihoods = {name: value for name, (_, value) in climbs.items()}
    likelihoods["both"] = max(highest, likelihoods["drift"])
    chosen = next(name for name, allowed in ALLOWED.items() if likelihoods["both"] - likelihoods[name] <= allowed)
    if chosen == "both" and min(free.drift, free.constant) < _LEAST:
        chosen = "drift" if free.constant < _LEAST else "constant"
    shares = free if chosen == "both" else _unpack_shares(climbs[chosen][0])
    parts, untold = _estimate_parts(trial, shares, peak, (n, count)) if intervals else ((), None)
    return ErrorMemoryFit(shares, parts, likelihoods, untold)


def _estimate_parts(
    trial: _MemoryTrial, shares: MemoryShares, peak: Float, counted: tuple[int, int]
) -> tuple[tuple[LastingPart, ...], str | None]:
    """The lasting parts with profile intervals, and what is not told (None: nothing). `counted`: rows and series."""
    n, count = counted

    def estimate(value: float, limits: tuple[float, float]) -> Estimate:
        return Estimate(value, min(limits[0], value), max(limits[1], value), n, float(count))

    def bound_share(point: Float, swapped: bool) -> tuple[float, float]:
        low, high = trial.limits(point, 0, swapped)
        return (0.0 if low <= _ODDS[0] else float(expit(low))), (1.0 if high >= _ODDS[1] else float(expit(high)))

    if shares.drift == shares.constant == 0:
        return (), f"no memory in {n} entries of {count} series beyond chance"
    end, parts = trial.bounds[2][1], list[LastingPart]()
    if shares.drift > 0:
        low, high = trial.limits(peak, 2)
        tau = estimate(shares.tau_s, (float(np.exp(low)), float("inf") if high >= end else float(np.exp(high))))
        parts.append(LastingPart(estimate(shares.drift, bound_share(peak, False)), tau))
    if shares.constant > 0:
        swapped = _pack_shares(_unpack_shares(peak), swapped=True)
        parts.append(LastingPart(estimate(shares.constant, bound_share(swapped, True)), "always"))
    if shares.drift > 0 or not parts:
        return tuple(parts), None
    start = logit(np.clip(shares.constant, 1e-3, 1 - 1e-3))
    best, top = trial.climb("drift", [np.array([start, 0.0, tau]) for tau in (end, end - 3)])
    free_ix = _FREE["drift"]

    def drifting(x: Float) -> float:
        return trial.likelihood(MemoryShares(float(expit(x[0])), float(np.exp(x[1]))))

    low, _ = profile_limits(drifting, best[free_ix], top, 1, [trial.bounds[k] for k in free_ix])
    return tuple(parts), f"τ > {np.exp(low):.2g} s or constant"
