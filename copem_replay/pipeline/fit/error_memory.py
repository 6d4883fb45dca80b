"""What of an error lasts: z = √w · drift + √c · constant + √(1 − w − c) · white, from standardised residuals.

The drift is the Ornstein–Uhlenbeck process that is replayed, with e^(−Δ/τ) at any list rate; the constant is one number
for each object in a log, which `always` is. The likelihood is a Kalman filter's over irregular lists; scale, and where
asked the mean, are integrated out of it (REML), so that few series do not look surer than they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.special import expit, logit

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.pipeline.fit.errors_kernel import moments, whiten
from copem_replay.pipeline.fit.estimate import Estimate, Note, digits, plain
from copem_replay.pipeline.fit.profile import DROP, Bounds, maximum, profile_limits

_ODDS = 8.0
"""Log-odds beyond which a share counts as none, or all."""
_FEWEST = 12
"""Rows below which no memory is looked for (chosen)."""
_ENOUGH = 10_000
"""Rows that tell where to begin and which model is refused (chosen)."""


@dataclass(frozen=True)
class Shares:
    """Of the variance: what drifts (`drift`, with `tau_s`) and what is `constant`; the rest is white."""

    drift: float = 0.0
    tau_s: float = 1.0
    constant: float = 0.0


@dataclass(frozen=True)
class LastingPart:
    """A part of a PEM's `memory`: which share of the variance, and how long it lasts."""

    share: Estimate
    correlation_s: Estimate | Literal["always"]

    def keys(self, note: Note = plain) -> dict[str, Any]:
        """The keys as they are replayed."""
        lasts = self.correlation_s
        return {
            "share": note(round(self.share.value, 3), self.share.words()),
            "correlation_s": lasts if isinstance(lasts, str) else note(digits(lasts.value), lasts.words()),
        }

    @property
    def yaml(self) -> dict[str, Any]:
        """The same as plain data."""
        return self.keys()


@dataclass(frozen=True)
class MemoryFit:
    """What lasts of one quantity. `log_likelihood` by model (`none`, `constant`, `drift`, `both`), REML.

    `shares`: of the model that is written, the simplest that the data do not refuse. `parts`: the same with intervals
    (under `both`, whichever is written). `untold`: what the data cannot tell.
    """

    shares: Shares = Shares()
    parts: tuple[LastingPart, ...] = ()
    log_likelihood: dict[str, float] = field(default_factory=dict)
    untold: str | None = None


class Series:
    """Rows (n,) that follow each other: seconds since the one before, and whether a series begins."""

    def __init__(self, gap_s: Float, new: Bool) -> None:
        self.gap_s, self.new = gap_s, new
        self._last = (0.0, gap_s)

    def decay(self, tau_s: float) -> Float:
        """(n,) e^(−Δ/τ)."""
        if self._last[0] != tau_s:  # derivatives by shares ask for the same again
            self._last = tau_s, np.exp(-self.gap_s / tau_s)
        return self._last[1]

    def some(self, rows: int) -> Int:
        """Rows of whole series, evenly among all, until there are so many."""
        series_ix = np.cumsum(self.new) - 1
        step = max(len(self.new) // rows, 1)
        return np.flatnonzero(series_ix % step == 0)


def whitened(values: Float, series: Series, shares: Shares) -> tuple[Float, Float]:
    """Columns (n, K) freed of memory, and the variance of each row given those before it (n,)."""
    if shares.drift == shares.constant == 0:
        return values, np.ones(len(values))
    decay = series.decay(shares.tau_s)
    return whiten(np.ascontiguousarray(values), decay, series.new, shares.drift, shares.constant)


def log_likelihood(z: Float, series: Series, shares: Shares, *, centred: bool) -> float:
    """REML of columns (n, C) that share a memory: each with a scale, and if `centred` a mean, of its own."""
    n, C = z.shape
    squares, cross, ones, logs = moments(z, series.decay(shares.tau_s), series.new, shares.drift, shares.constant)
    total = -0.5 * C * logs
    if centred:
        squares, n, total = squares - cross**2 / ones, n - 1, total - 0.5 * C * np.log(ones)
    return float(total - 0.5 * n * np.log(np.maximum(squares, 1e-300) / n).sum())


def refit_memory(z: Float, series: Series, start: Shares, *, centred: bool) -> Shares:
    """The memory of residuals that are much like others with a known one: from there, and no choice among models."""
    z, bounds = np.ascontiguousarray(z), _bounds(series)
    best, _ = maximum(lambda x: log_likelihood(z, series, _shares(x), centred=centred), [_numbers(start)], bounds)
    return _shares(best)


def fit_memory(z: Float, series: Series, *, centred: bool, intervals: bool = True) -> MemoryFit:
    """The memory of residuals (n, C); without `intervals` there are no parts.

    Of many rows those of some series tell where to begin, and which of the models is refused.
    """
    n, count = len(z), int(series.new.sum())
    if n < _FEWEST or n <= count + 2:
        return MemoryFit(untold=f"{n} entries in {count} series: no memory can be told")
    if n > 2 * _ENOUGH:
        rows = series.some(_ENOUGH)
        rough = fit_memory(z[rows], Series(series.gap_s[rows], series.new[rows]), centred=centred, intervals=False)
        if rough.untold is None and rough.shares.drift > 0:
            return _polished(np.ascontiguousarray(z), series, rough, centred=centred, intervals=intervals)
    z, bounds = np.ascontiguousarray(z), _bounds(series)

    def of(shares: Shares) -> float:
        return log_likelihood(z, series, shares, centred=centred)

    first = [Shares(w, tau_s, c) for w in (0.3, 0.7) for c in (0.05, 0.2) for tau_s in (0.3, 1.0, 3.0)]
    both, highest = maximum(
        lambda x: of(_shares(x)), [_numbers(one) for one in sorted(first, key=of, reverse=True)[:2]], bounds
    )
    at = _shares(both)
    starts = [(at.drift + 0.5 * at.constant, both[2]), (at.drift + at.constant, bounds[2][1] - 3.0)]
    drift, of_drift = maximum(
        lambda x: of(_drifting(x)),
        [(both[0], both[2]), *((logit(np.clip(w, 0.01, 0.99)), tau) for w, tau in starts)],
        [bounds[0], bounds[2]],
    )
    constant, of_constant = maximum(lambda x: of(Shares(constant=float(expit(x[0])))), [(0.0,), (-3.0,)], bounds[:1])
    found = {"none": of(Shares()), "constant": of_constant, "drift": of_drift, "both": max(highest, of_drift)}
    models = {"none": Shares(), "constant": Shares(constant=float(expit(constant[0]))), "drift": _drifting(drift)}
    models["both"] = at
    chosen = next(name for name, allowed in _ALLOWED.items() if found["both"] - found[name] <= allowed)
    fit = MemoryFit(models[chosen], (), found)
    return _with_intervals(fit, of, (both, highest), bounds, (n, count)) if intervals else fit


def _polished(z: Float, series: Series, rough: MemoryFit, *, centred: bool, intervals: bool) -> MemoryFit:
    """The fit to all rows, from that to some of them; what these refuse, all do."""
    bounds, constant = _bounds(series), rough.shares.constant > 0

    def of(shares: Shares) -> float:
        return log_likelihood(z, series, shares, centred=centred)

    both, highest = maximum(lambda x: of(_shares(x)), [_numbers(rough.shares)], bounds)
    shares, found = _shares(both), {"none": of(Shares()), "both": highest}
    if not constant:
        start = (logit(shares.drift + 0.5 * shares.constant), both[2])
        drift, found["drift"] = maximum(lambda x: of(_drifting(x)), [start], [bounds[0], bounds[2]])
        shares = _drifting(drift) if highest - found["drift"] <= _ALLOWED["drift"] else shares
    fit = MemoryFit(shares, (), found)
    return _with_intervals(fit, of, (both, highest), bounds, (len(z), int(series.new.sum()))) if intervals else fit


def _bounds(series: Series) -> list[tuple[float, float]]:
    """Of log-odds of the shares and of ln τ: from a tenth of a gap to twenty of the longest series."""
    longest_s = float(np.bincount(np.cumsum(series.new) - 1, np.where(series.new, 0.0, series.gap_s)).max())
    shortest = np.log(max(np.median(series.gap_s[~series.new]) / 10, 1e-3))
    return [(-_ODDS, _ODDS), (-_ODDS, _ODDS), (shortest, max(np.log(20 * max(longest_s, 1e-3)), shortest + 1))]


_ALLOWED = {"none": 3.907, "constant": 2.996, "drift": DROP, "both": 0.0}
"""By how much less a simpler model may explain: half of the 95 % quantile of χ² with 3, 2 and 1 degrees of freedom."""


def _shares(x: Float) -> Shares:
    """From the log-odds of the drift, of the constant in what is left, and ln τ."""
    drift = float(expit(x[0]))
    return Shares(drift, float(np.exp(x[2])), (1 - drift) * float(expit(x[1])))


def _drifting(x: Float) -> Shares:
    """From the log-odds of the drift and ln τ."""
    return Shares(float(expit(x[0])), float(np.exp(x[1])))


def _swapped(x: Float) -> Shares:
    """The same with the constant first: its share is then a number of its own."""
    constant = float(expit(x[0]))
    return Shares((1 - constant) * float(expit(x[1])), float(np.exp(x[2])), constant)


def _numbers(shares: Shares, *, swapped: bool = False) -> tuple[float, float, float]:
    one, two = (shares.constant, shares.drift) if swapped else (shares.drift, shares.constant)
    one = min(one, 1 - 1e-6)
    return float(logit(one)), float(logit(min(two / (1 - one), 1.0))), float(np.log(shares.tau_s))


def _with_intervals(
    fit: MemoryFit, of: Callable[[Shares], float], peak: tuple[Float, float], bounds: Bounds, counted: tuple[int, int]
) -> MemoryFit:
    both, value = peak
    n, count = counted
    shares = fit.shares

    def share_of(at: Float, model: Callable[[Float], Shares], written: float, effective: float) -> Estimate:
        low, high = profile_limits(lambda x: of(model(x)), at, value, 0, bounds)
        low, high = (0.0 if low <= -_ODDS else float(expit(low))), (1.0 if high >= _ODDS else float(expit(high)))
        return Estimate(written, min(low, written), max(high, written), n, effective)

    if shares.drift == shares.constant == 0:
        return MemoryFit(shares, (), fit.log_likelihood, f"no memory in {n} entries of {count} series beyond chance")
    parts = []
    if shares.drift > 0:
        low, high = profile_limits(lambda x: of(_shares(x)), both, value, 2, bounds)
        low_s, high_s = float(np.exp(low)), float("inf") if high >= bounds[2][1] else float(np.exp(high))
        share = share_of(both, _shares, shares.drift, float(count))
        tau = Estimate(shares.tau_s, min(low_s, shares.tau_s), max(high_s, shares.tau_s), n, float(count))
        parts.append(LastingPart(share, tau))
    untold = None
    if shares.constant > 0:
        at = np.clip(_numbers(_shares(both), swapped=True), *np.array(bounds).T)
        share = share_of(at, _swapped, shares.constant, float(count))
        parts.append(LastingPart(share, "always"))
        if shares.drift == 0:
            start = float(logit(np.clip(shares.constant, 1e-3, 1 - 1e-3)))
            only = [bounds[0], bounds[2]]
            best, top = maximum(lambda x: of(_drifting(x)), [(start, bounds[2][1]), (start, bounds[2][1] - 3)], only)
            low, _ = profile_limits(lambda x: of(_drifting(x)), best, top, 1, only)
            untold = f"τ > {np.exp(low):.2g} s or constant"
    return MemoryFit(shares, tuple(parts), fit.log_likelihood, untold)
