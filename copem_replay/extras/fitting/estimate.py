"""Estimates: one number of a fitted model with its interval, maximum likelihood, and the choice among models."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.core.yaml import CommentedValue
from copem_replay.metrics.limits import figure_variance

PER_ROW = "per row"
"""Metadata of a field with a value for each row of the data, which is not reported as an estimate."""


def round_digits(value: float, count: int = 4) -> float:
    """The number rounded to `count` significant digits: no interval tells more."""
    return float(f"{value:.{count}g}")


@dataclass(frozen=True)
class Estimate:
    """`value` with its 95 % interval, from `n` observations that are worth `n_effective` independent ones.

    `n_effective` NaN: not known. `why`: why the data do not determine the number; then `value` is what is used instead,
    and `low` and `high` bound what the data leave open (NaN: no bound). `chosen`: set, not estimated. Without an
    observation a number is not identifiable, whatever its value.

    >>> Estimate(0.9, 0.85, 0.94, n=400, n_effective=120.0).words()
    '0.9 (95 %: 0.85 … 0.94, n 400, effective 120)'
    >>> Estimate(1.0, why="no miss in 161 lists").words()
    'not identifiable: no miss in 161 lists'
    >>> Estimate(0.0315, 0.0315, 0.0315, n=40, n_effective=40.0).words()
    '0.0315 (the same in all 40)'
    """

    value: float
    low: float = float("nan")
    high: float = float("nan")
    n: int = 0
    n_effective: float = 0.0
    why: str | None = None
    chosen: bool = False

    def __post_init__(self) -> None:
        if self.n == 0 and self.why is None and not self.chosen:
            object.__setattr__(self, "why", "no rows")

    def words(self) -> str:
        """The estimate in words, as files and the report have it: with so many digits that its limits differ."""
        if self.why is not None:
            return f"not identifiable: {self.why}"
        if self.chosen:
            return "chosen"
        value, limits = self.shown()
        if " … " not in limits:
            return f"{value} ({limits})"
        effective = "" if math.isnan(self.n_effective) else f", effective {self.n_effective:.3g}"
        return f"{value} (95 %: {limits}, n {self.n}{effective})"

    def shown(self) -> tuple[str, str]:
        """The value and its limits with three digits, or with as many as tell the limits apart."""
        if math.isclose(self.low, self.high, rel_tol=1e-9):
            return f"{self.value:.3g}", f"the same in all {self.n}"
        digits = next((k for k in range(3, 12) if f"{self.low:.{k}g}" != f"{self.high:.{k}g}"), 3)
        value, low, high = (f"{one:.{digits}g}".replace("inf", "∞") for one in (self.value, self.low, self.high))
        return value, f"{low} … {high}"

    def written(self, digits: int = 4) -> CommentedValue:
        """The value in the form of files, with its words as a comment."""
        return CommentedValue(round_digits(self.value, digits), self.words())


# Maximum likelihood over a few numbers, and profile intervals.

LogLikelihood = Callable[[Float], float]
Bounds = Sequence[tuple[float, float]]
DROP = 1.9207294
"""By how much the log-likelihood falls at the ends of a 95 % interval: half of the 95 % quantile of χ²₁."""
_H = 1e-3
"""Step of derivatives: small beside 1, the scale of logarithms and log-odds, and large beside rounding."""
_GAIN = 1e-3
"""Log-likelihood that a step must promise, else the maximum is found: far below DROP."""
_FAR = 3.0
"""The longest step of a parameter, a logarithm or log-odds: a factor of twenty."""


def maximise_likelihood(
    logp: LogLikelihood, starts: Sequence[Sequence[float] | Float], bounds: Bounds
) -> tuple[Float, float]:
    """Where a log-likelihood of a few numbers is largest, and its maximum: the best of Newton's method from each start.

    With derivatives by differences, along the eigenvectors of the curvature, damped where a step gains nothing: for so
    few numbers fewer calls than L-BFGS (docs/develop/decisions/fitting.md).
    """
    low, high = np.array(bounds, dtype=float).reshape(-1, 2).T
    maxima = [_climb(logp, np.clip(np.asarray(start, dtype=float), low, high), low, high) for start in starts]
    return max(maxima, key=lambda maximum: maximum[1])


def _climb(logp: LogLikelihood, point: Float, low: Float, high: Float) -> tuple[Float, float]:
    """The maximum within bounds (x, log-likelihood) that damped Newton steps reach from `point`."""
    value, damping = logp(point), 1e-3
    for _ in range(60 if len(point) else 0):
        slope, curvature = _differentiate(logp, point, value, low, high)
        is_free = ~(((point <= low) & (slope < 0)) | ((point >= high) & (slope > 0)))
        slope = np.where(is_free, slope, 0.0)
        curvature *= np.outer(is_free, is_free)
        curvatures, axes = np.linalg.eigh(curvature)
        slope_along = axes.T @ slope
        while True:
            step = axes @ (slope_along / (np.abs(curvatures) * (1 + damping) + damping + 1e-9))
            step *= min(1.0, _FAR / max(np.abs(step).max(), 1e-12))
            next_point = np.clip(point + step, low, high)
            if slope @ (next_point - point) < _GAIN:
                return point, value
            if (next_value := logp(next_point)) > value:
                point, value, damping = next_point, next_value, damping / 8
                break
            damping *= 10
    return point, value


def _differentiate(logp: LogLikelihood, point: Float, value: float, low: Float, high: Float) -> tuple[Float, Float]:
    """Gradient (k,) and curvature (k, k), just inside the bounds."""
    steps = _H * np.eye(len(point))
    point = np.clip(point, low + _H, high - _H)
    above, beneath = ([logp(point + sign * step) for step in steps] for sign in (1, -1))
    curvature = np.diag([(u + d - 2 * value) / _H**2 for u, d in zip(above, beneath, strict=True)])
    for i in range(len(point)):
        for j in range(i):
            both = logp(point + steps[i] + steps[j])
            curvature[i, j] = curvature[j, i] = (both - above[i] - above[j] + value) / _H**2
    return (np.array(above) - np.array(beneath)) / (2 * _H), curvature


def profile_limits(logp: LogLikelihood, best: Float, value: float, k: int, bounds: Bounds) -> tuple[float, float]:
    """The 95 % profile interval of parameter k about the maximum; a bound where the likelihood never falls enough."""
    other_ix = [j for j in range(len(best)) if j != k]
    other_bounds = [bounds[j] for j in other_ix]
    # Near the bounds of log-odds a log-likelihood is flat, and a search that starts there stays there.
    low, high = ([(1 - a) * one + a * two for one, two in other_bounds] for a in (0.3, 0.7))

    def limit(towards: float) -> float:
        """The value of parameter k, below or above the best, where the profile likelihood has fallen by `DROP`."""
        starts = [best[other_ix], np.clip(best[other_ix], low, high)]

        def fall(point: float) -> float:
            nonlocal starts
            if np.array_equal(starts[0], starts[-1]):
                starts = starts[:1]
            warm, highest = maximise_likelihood(lambda x: logp(np.insert(x, k, point)), starts, other_bounds)
            starts = [warm]
            return value - highest - DROP

        end, step, inner = bounds[k][0 if towards < 0 else 1], 0.25, float(best[k])
        while True:  # outwards until the likelihood has fallen
            outer = min(inner + step, end) if towards > 0 else max(inner - step, end)
            if (over := fall(outer)) > 0:
                break
            if outer == end:
                return end
            inner, step = outer, 2 * step
        inner_gap = fall(inner) if inner != best[k] else -DROP
        for _ in range(6):  # the profile is about a parabola: secants of its root meet fast
            near, far = np.sqrt(max(inner_gap + DROP, 0.0)), np.sqrt(over + DROP)
            point = inner + (outer - inner) * np.clip((np.sqrt(DROP) - near) / (far - near), 0.02, 0.98)
            gap = fall(point)
            if abs(gap) < 0.02:
                return float(point)
            inner, inner_gap, outer, over = (point, gap, outer, over) if gap < 0 else (inner, inner_gap, point, gap)
        return float(inner)

    return limit(-1.0), limit(1.0)


# The choice among models: the simplest that predicts like the best. Held out, each model is fitted without a fold of
# the passes and scored there by the log-probability of the recording; Breiman's rule takes the simplest within one
# standard error of the best. With too few passes to hold any out, BIC decides.
#
# Sources: L. Breiman, J. Friedman, R. Olshen, C. Stone, "Classification and Regression Trees", 1984, section 3.4.3
# (the rule); G. Schwarz, "Estimating the dimension of a model", Ann. Statist. 6 (1978) 461–464.

FEWEST_PASSES = 4
"""Passes below which none is held out: a standard error of fewer differences says little."""
PASSES_ALONE = 5
"""Passes from which on an interval is by passes alone (docs/develop/decisions/fitting.md)."""


@dataclass(frozen=True)
class Rung:
    """One model of a ladder: its score per list, and how far that is below the best, ± one standard error.

    `score`: held-out log-likelihood (nats per list), −BIC / 2n, or the log-likelihood of what it is fitted to.
    """

    name: str
    score: float
    below: float
    below_se: float
    chosen: bool
    by: Literal["held out", "BIC", "likelihood"]

    def words(self) -> str:
        """The rung in words, as files and the report have it."""
        far = "the best" if self.below == 0 else f"{self.below:.3g} ± {self.below_se:.2g} below the best"
        return f"{self.name}: {self.score:.4g} nats per list ({self.by}), {far}{', chosen' if self.chosen else ''}"


def held_out_possible(pass_ix: Int, fold: Int) -> bool:
    """Whether there are enough passes, in more than one fold."""
    return len(np.unique(pass_ix)) >= FEWEST_PASSES and len(np.unique(fold)) > 1


def compare_models(
    names: Sequence[str], score: Callable[[int, Bool], Float], fold: Int, lists: Int, parameters: Int,
    n_effective: float, *, simplest: bool,
) -> tuple[int, tuple[Rung, ...]]:  # fmt: skip
    """The index of the model that is written, from the simplest to the richest, and the table of all.

    `score(k, held_out)`: log-likelihood of each pass (P,) by model k fitted to those that are not held out. `fold`,
    `lists (P,)`: of the passes. With too few to hold any out BIC decides, by `parameters` and rows that are worth
    `n_effective`.
    """
    if not held_out_possible(np.arange(len(fold)), fold):
        whole = np.array([score(k, np.zeros(len(fold), dtype=bool)).sum() for k in range(len(names))])
        return choose_by_bic(names, whole, parameters, int(lists.sum()), n_effective, simplest=simplest)
    scores = np.zeros((len(names), len(fold)))
    for k, f in product(range(len(names)), np.unique(fold)):
        scores[k, fold == f] = score(k, fold == f)[fold == f]
    return choose_rung(names, scores, lists, simplest=simplest)


def choose_rung(
    names: Sequence[str], scores: Float, weights: Float | Int, *, simplest: bool = False
) -> tuple[int, tuple[Rung, ...]]:
    """The simplest rung within one standard error of the best, and the table of all; `simplest`: the first in any case.

    `names` from the simplest to the richest; `scores (rungs, passes)`: held-out log-likelihood of each pass, summed;
    `weights (passes,)`: how many lists each has. The standard error is that of the difference to the best, from the
    difference without each pass. A rung by which something recorded is impossible (−inf) is below any other.
    """
    score = scores.sum(axis=1) / weights.sum()
    best = int(np.argmax(score))
    with np.errstate(invalid="ignore"):
        deficit = scores[best] - scores
        without = (deficit.sum(axis=1, keepdims=True) - deficit) / (weights.sum() - weights)
        below = score[best] - score
        variance, _ = figure_variance(below, without, np.asarray(weights, dtype=float))
    below[best] = 0.0
    return _tabulate_rungs(names, score, below, np.sqrt(np.nan_to_num(variance)), "held out", simplest)


def choose_by_bic(
    names: Sequence[str], log_likelihood: Float, parameters: Int, n: int, n_effective: float, *, simplest: bool = False
) -> tuple[int, tuple[Rung, ...]]:
    """The rung of the least BIC, of equal ones the simplest, and the table of all; see `choose_rung`.

    `log_likelihood (rungs,)` of `n` rows that are worth `n_effective`, each model fitted to all. `parameters`: how many
    numbers each has.
    """
    score = log_likelihood / n - parameters * np.log(max(n_effective, 1.0)) / (2 * n_effective)
    return _tabulate_rungs(names, score, score.max() - score, np.zeros(len(names)), "BIC", simplest)


def _tabulate_rungs(
    names: Sequence[str], score: Float, below: Float, error: Float, by: Literal["held out", "BIC"], simplest: bool
) -> tuple[int, tuple[Rung, ...]]:
    index = 0 if simplest else int(np.argmax(below <= error))
    columns = zip(names, score.tolist(), below.tolist(), error.tolist(), strict=True)
    return index, tuple(Rung(name, s, b, e, k == index, by) for k, (name, s, b, e) in enumerate(columns))


# A number of several logs: its mean, and how far it scatters between them.


@dataclass(frozen=True)
class LogPool:
    """A number over logs: its `mean`, its standard deviation `between` logs, and whether they contradict each other."""

    mean: Estimate
    between: Estimate
    contradict: bool


def pool_logs(values: Float, variances: Float, n: int) -> LogPool:
    """The mean of values (K,) with variances (K,), and the standard deviation τ of what they are the values of.

    τ² by Paule and Mandel, Σ w (y − mean)² = K − 1 with w = 1/(v + τ²); its limits by the Q-profile; the mean's by
    Student's t with K − 1 degrees of freedom, its variance max(1, q)/Σw with q = Σ w (y − mean)²/(K − 1). Where
    logs differ less than by chance, no τ would be left: the upper limit takes variances for no larger than the scatter
    says. `contradict`: scatter within logs alone is refused at five per cent.

    Sources: R. C. Paule, J. Mandel, J. Res. NBS 87 (1982) 377–385; W. Viechtbauer, Statist. Med. 26 (2007) 37–52.
    """
    from scipy.optimize import brentq
    from scipy.stats import chi2, t

    K = len(values)
    most = (np.ptp(values) + np.sqrt(variances.max())) ** 2 * 1e4

    def scatter(tau_m2: float, within: Float = variances) -> float:
        w = 1 / (within + tau_m2)
        return float((w * (values - (w @ values) / w.sum()) ** 2).sum())

    def solve(level: float, within: Float = variances) -> float:
        if scatter(0.0, within) <= level:
            return 0.0
        if scatter(most, within) >= level:
            return float("inf")
        return float(brentq(lambda x: scatter(x, within) - level, 0.0, most))

    tau_m2, ratio = solve(K - 1), scatter(0.0) / (K - 1)
    w = 1 / (variances + tau_m2)
    mean = float(w @ values / w.sum())
    half = float(t.ppf(0.975, K - 1) * np.sqrt(max(1.0, scatter(tau_m2) / (K - 1)) / w.sum()))
    above, below = chi2.ppf([0.975, 0.025], K - 1).tolist()
    limits = solve(above), solve(below, variances * min(ratio, 1.0) if ratio > 0 else variances)
    tau, low, high = np.sqrt([tau_m2, *limits]).tolist()
    return LogPool(
        Estimate(mean, mean - half, mean + half, n, K), Estimate(tau, low, high, n, K),
        scatter(0.0) > float(chi2.ppf(0.95, K - 1)),
    )  # fmt: skip
