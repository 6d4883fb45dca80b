"""Limits: how far a figure may be from that of all such traffic, by the drives at hand; one engine for all figures.

*Cluster*: rows that hang together (`choose_over`). Logs, from `FEWEST_LOGS` on; in a single log its objects, from
`FEWEST_CLUSTERS` on; of a single object its passes (episodes), from as many on; of fewer its runs, counted as runs. Of
two logs there is no interval: how drives differ cannot be told from two, and objects of several logs are never taken as
independent. A cluster weighs what the figure averages: rows, pairs, minutes.
*Share*: exact limits (Clopper–Pearson) of p·n of n trials, n an effective number of objects: no more than there are
once objects of one log hang together by `WITHIN_LOG`, nor than the spread between logs tells (`limit_share`).
*Mean between bounds*: one more cluster that was not seen, at the far end (`limit_bounded_mean`).
*Any other figure*: value ± t·√V, from the figure without each cluster (`limit_figure`), at most `MOST_GROUPS` times.
*Quantile*: all values at which the limits of the share at or below them hold the quantile's level (`limit_quantile`).
*Nothing drawn*: where no random number is behind a result it is equal in every run, and an interval over runs tells
nothing.

Limits are at 95 % unless a function is given another `confidence`. What they hold, and what not: tools/coverage.py,
docs/guide/metrics.md. Functions of arrays take any leading axes (…). Letters of the shapes: n rows, K clusters, G
values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import Bool, Float, Int

if TYPE_CHECKING:
    import pandas as pd

OBJECTS, DRIVES = "objects", "drives"
"""What weighs alike in figures of rows: every row; or every drive, however many objects it has."""
FEWEST_LOGS = 3
"""From so many logs on intervals are over logs."""
FEWEST_CLUSTERS = 5
"""Over fewer objects of one log, or passes of one object, there is no interval of a figure."""
MOST_GROUPS = 200
"""More clusters are joined to so many groups before a figure is computed without each."""
WITHIN_LOG = 0.2
"""Correlation of two objects of a log that few logs cannot refute; on recorded drives .02 to .10."""
CONFIDENCE = 0.95
_ROUNDING = 1e-9
"""Numbers of trials, and figures, that differ by less differ by rounding only; times are whole nanoseconds."""

# What an interval is over.

CLUSTERS = {
    "logs": ("log", "", "how far other drives of this kind may differ"),
    "objects": ("object", " of this drive",
                "how far other objects of this drive may differ; nothing about other drives"),
    "passes": ("pass", " of this one object",
               "how far other passes of this object may differ; nothing about other objects or days"),
    "runs": ("run", " of this one object",
             "how far other draws of the same models may differ for this one object; nothing about other traffic"),
}  # fmt: skip
"""Words for what intervals are over: of one, whose, and what they tell."""
_OF_DRIVING = "run", " of the driving", "how far other draws of the same models may differ; nothing about other drives"
TRAFFIC = ("logs", "objects", "passes")
"""What intervals that tell of more than other draws are over."""


def choose_over(logs: int, objects: int, passes: int) -> str | None:
    """The unit an interval is over: `logs`, `objects`, `passes` or `runs`; None: no interval.

    `logs`, `objects`, `passes` (episodes): how many of each have rows.
    """
    if logs >= FEWEST_LOGS:
        return "logs"
    if logs != 1:
        return None
    if objects == 1:
        return "passes" if passes >= FEWEST_CLUSTERS else "runs"
    return "objects" if objects >= FEWEST_CLUSTERS else None


def count_clusters(table: pd.DataFrame) -> tuple[int, int, int]:
    """The number of logs, of objects in them and of episodes of these that have rows."""
    keys = [name for name in ("log", "object_id", "episode") if name in table]
    logs, objects, passes = (len(table[keys[:k]].drop_duplicates()) for k in (1, 2, 3))
    return logs, objects, passes


@dataclass(frozen=True, eq=False)
class Clusters:
    """What an interval of rows (n,) is over: the `number` of each row's cluster, 0 … K − 1, and the `unit` it is about.

    A unit is an object of a log; a pass, where clusters are passes or runs. `once`: clusters are drives that weigh
    alike.
    """

    over: str
    number: Int
    unit: Int
    once: bool = False

    @cached_property
    def count(self) -> int:
        """The number of clusters, K."""
        return int(self.number.max(initial=-1)) + 1

    @cached_property
    def units(self) -> int:
        """The number of objects, or passes, that the rows are about; where clusters are runs, of those in each run."""
        import pandas as pd

        return len(pd.unique(self.unit))

    @property
    def by_run(self) -> bool:
        """Whether clusters are runs."""
        return self.over == "runs"

    @cached_property
    def group(self) -> Int:
        """(n,) the group of each row's cluster: where clusters are many, neighbours are left out together."""
        group: Int = self.grouped[self.number]
        return group

    @cached_property
    def grouped(self) -> Int:
        """(K,) the group of each cluster."""
        return group_clusters(self.count)

    @property
    def share_kind(self) -> str:
        """The kind of the limits of a share."""
        return BOUNDED if self.once else EXACT

    def select(self, mask: Bool) -> Clusters:
        """The clusters of some of the rows, `mask (n,)`."""
        return replace(self, number=np.unique(self.number[mask], return_inverse=True)[1], unit=self.unit[mask])

    def weigh(self, weight: Float) -> Float:
        """(K,) sums of `weight (n,)`."""
        return np.bincount(self.number, weight, self.count).astype(float)

    def weigh_units(self, weight: Float) -> Float:
        """(K,) the number of units in each cluster by the `weight (n,)` of its rows; runs count one each."""
        sums = self.weigh(weight)
        units: Float = sums * (self.count if self.by_run else self.units) / sums.sum()
        return units

    def limit_share(self, successes: Float, weight: Float, confidence: float) -> tuple[float, float]:
        """Limits of Σ successes / Σ weight, of rows (n,)."""
        sums, counts = self.weigh(successes), self.weigh(weight)
        if self.once:
            low, high = limit_share_once(sums, counts, confidence)
        elif self.by_run:
            share = sums.sum() / counts.sum()
            low, high = limit_share_of_runs(np.asarray(share), sums - share * counts, self.units, confidence)
        else:
            low, high = limit_share(sums, counts, self.units, confidence)
        return float(low), float(high)


def weigh_rows(table: pd.DataFrame, column: str, weigh: str = OBJECTS) -> Float:
    """(n,) the weight of each row: its number of runs, or its probability, by the `column`.

    `weigh`: `drives`: all logs weigh the same; the sum of weights stays.
    """
    import pandas as pd

    weight: Float = table[column].to_numpy(dtype=float)
    if weigh == OBJECTS or not len(table):
        return weight
    log, logs = pd.factorize(table["log"])
    scale: Float = (weight.sum() / len(logs) / np.bincount(log, weight))[log]
    return weight * scale


def find_clusters(table: pd.DataFrame, *, of_runs: bool = False, weigh: str = OBJECTS) -> Clusters | None:
    """The clusters of a table's rows (n,), by `choose_over`; None: there is no interval.

    `of_runs`: it is over runs. Rows of a tally stand for several runs: they then form one cluster. `weigh`: as for
    `weigh_rows`.
    """
    import pandas as pd

    log, logs = pd.factorize(table["log"].astype(str), sort=True)
    name, names = pd.factorize(table["object_id"].astype(str), sort=True)
    unit, units = pd.factorize(log * max(len(names), 1) + name, sort=True)
    episode, episodes = pd.factorize(table["episode"].to_numpy() if "episode" in table else np.zeros(len(table), int))
    pass_ix, passes = pd.factorize(unit * max(len(episodes), 1) + episode)
    over = "runs" if of_runs else choose_over(len(logs), len(units), len(passes))
    if over is None:
        return None
    run: Any = pd.factorize(table["run"], sort=True)[0] if "run" in table else np.zeros(len(table), dtype=np.int64)
    number = {"logs": log, "objects": unit, "passes": pass_ix, "runs": run}[over]
    return Clusters(over, number, pass_ix if over in ("passes", "runs") else unit, over == "logs" and weigh == DRIVES)


def describe_clusters(over: str, number: int | None = None, fewest: int | None = None, driving: bool = False) -> str:
    """What the interval is over and what it shows: `8 logs: how far other drives of this kind may differ`.

    `fewest`: where intervals are over different numbers of clusters, up to `number`. `driving`: of the ego's
    driving, not of objects.
    """
    noun, whose, tells = _OF_DRIVING if driving and over == "runs" else CLUSTERS[over]
    counted = over if number is None else count_noun(number, noun, over)
    up_to = "" if fewest is None or fewest == number else f"{fewest} to "
    return f"{up_to}{counted}{whose}: {tells}"


NOT_ENOUGH = "neither more runs nor objects of several logs together tell how other drives differ"
"""What is said beside the reason why there is no interval."""


def explain_no_clusters(logs: int, objects: int, *_: int) -> str:
    """The reason why `choose_over` allows no interval: `2 logs, fewer than 3`."""
    if logs == 1:
        return f"{count_noun(objects, 'object')} of one drive, fewer than {FEWEST_CLUSTERS}"
    return f"{count_noun(logs, 'log')}, fewer than {FEWEST_LOGS}"


def describe_absent(logs: int) -> str:
    """The share of drives of a kind that K logs cannot exclude at 95 % when none is of that kind: 1 − .05^(1/K)."""
    share = 1.0 - (1.0 - CONFIDENCE) ** (1.0 / logs)
    return f"a kind of drive that makes up to {100 * share:.0f} % of such traffic can be absent"


# Shares.


def exact_limits(successes: float | Float, n: float | Float, confidence: float = CONFIDENCE) -> tuple[Float, Float]:
    """Bound the probability of success given `successes` of `n` independent trials exactly: (low, high), shares (…).

    The limits enclose all p with which so few successes, and so many, have a probability of at least half of
    1 − `confidence`. Neither number need be whole: the limits are quantiles of beta distributions.

    Source: C. J. Clopper, E. S. Pearson, "The use of confidence or fiducial limits illustrated in the case of the
    binomial", Biometrika 26 (1934) 404–413.
    """
    from scipy.special import betaincinv

    tail = (1.0 - confidence) / 2
    k, n = np.broadcast_arrays(np.asarray(successes, dtype=float), np.asarray(n, dtype=float))
    is_zero, all_of_them = k <= _ROUNDING, n - k <= _ROUNDING
    failures = np.where(all_of_them, 0.0, n - k)
    low = betaincinv(np.where(is_zero, 1.0, k), failures + 1.0, tail)
    high = betaincinv(np.where(is_zero, 0.0, k) + 1.0, np.where(all_of_them, 1.0, failures), 1.0 - tail)
    return np.where(is_zero, 0.0, low), np.where(all_of_them, 1.0, high)


def limit_share(
    successes: Float | Int,
    rows: Float | Int,
    objects: float | Float | Int | None = None,
    confidence: float = CONFIDENCE,
    within: float = WITHIN_LOG,
) -> tuple[Float, Float]:
    """Bound Σ successes / Σ rows over K clusters: (low, high), shares (…).

    `successes (…, K)` of `rows (…, K)`; a cluster without rows is none. `objects (…)`: how many the rows are about,
    None: one in each cluster; rows weigh so that together they are as many. `within`: as for `spread_share`.
    """
    rows = np.asarray(rows, dtype=float)
    objects = (rows > 0).sum(axis=-1) if objects is None else objects
    total, scale = rows.sum(axis=-1), np.asarray(objects, dtype=float) / rows.sum(axis=-1)
    share = np.sum(successes, axis=-1) / total
    residual = (successes - share[..., None] * rows) * scale[..., None]
    weights = rows * scale[..., None]
    return spread_share(share, share_variance(residual, weights), weights, confidence, within)


def limit_share_once(successes: Float | Int, rows: Float | Int, confidence: float = CONFIDENCE) -> tuple[Float, Float]:
    """Bound the mean of K clusters' shares, `successes (…, K)` of `rows (…, K)`: (low, high), (…)."""
    shares = successes / rows
    K, value = shares.shape[-1], shares.mean(axis=-1)
    without = (K * value[..., None] - shares) / (K - 1)
    return limit_bounded_mean(value, without, np.ones_like(shares), (0.0, 1.0), confidence=confidence)


def limit_share_of_runs(
    share: Float, residual: Float, looks: float, confidence: float = CONFIDENCE
) -> tuple[Float, Float]:
    """Bound a share by S independent runs with `looks` rows each: (low, high), shares (…).

    `residual (…, S)`: of each run, successes minus share · looks. A run with one row is a trial. Of several rows the
    spread of the runs tells how many trials they are worth; where all runs are alike it tells nothing, and rows of a
    run may be one and the same: a run counts once.
    """
    runs = residual.shape[-1]
    if looks <= 1:
        return exact_limits(share * runs, float(runs), confidence)
    weights = np.broadcast_to(float(looks), residual.shape)
    variance = share_variance(residual, weights)
    return spread_share(share, variance, weights, confidence, np.where(variance > 0, 0.0, 1.0))


def share_variance(residual: Float, weights: Float) -> Float:
    """(…) variance of a share, from residuals (…, K), s_g − p·w_g, of clusters with weights (…, K): point estimate."""
    clusters = (weights > 0).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):  # one cluster: no variance
        variance: Float = clusters / (clusters - 1.0) * (residual**2).sum(axis=-1) / weights.sum(axis=-1) ** 2
    return np.where(clusters > 1, variance, 0.0)


def spread_share(
    share: Float, variance: Float, weights: Float, confidence: float = CONFIDENCE, within: float | Float = WITHIN_LOG
) -> tuple[Float, Float]:
    """Exact limits (…) of a share whose variance (…) is over clusters with `weights (…, K)` objects.

    Of n objects, m = Σw²/Σw in an average object's cluster, at most n/(1 + `within`·(m − 1)) count, `within` being the
    correlation in a cluster that its number cannot refute; nor more than p(1 − p)/variance, times
    (t of n − 1 / t of K − 1)² as few clusters show little of how they vary. One at least.
    """
    from scipy.special import stdtrit

    tail = (1.0 - confidence) / 2

    n, clusters = weights.sum(axis=-1), (weights > 0).sum(axis=-1)
    counted = n / (1.0 + within * ((weights**2).sum(axis=-1) / n - 1.0))
    spread = share * (1.0 - share)
    varies = (variance > 0) & (spread > _ROUNDING**2) & (clusters > 1)
    ratio = stdtrit(np.where(varies, n - 1.0, 1.0), tail) / stdtrit(np.where(varies, clusters - 1.0, 1.0), tail)
    by_spread = np.where(varies, spread / np.where(varies, variance, 1.0) * ratio**2, np.inf)
    effective = np.maximum(np.minimum(counted, by_spread), 1.0)
    return exact_limits(np.clip(share, 0.0, 1.0) * effective, effective, confidence)


def alike_limits(difference: float, weights: Float, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Bound a difference of two shares, −1 … 1, that is the same in all clusters: (low, high). `weights (K,)`: objects.

    Exact on each side, with n as in `spread_share` without a variance: as if |difference| · n of n objects favoured the
    one and the rest neither; of the rest, any share that is possible where none of n does may favour the other. Five
    logs of one object at 0: [−.522, .522], at 1: [.478, 1].
    """
    size, objects = min(abs(difference), 1.0), np.asarray(weights, dtype=float)
    nothing = np.asarray(0.0)
    low, high = (float(limit) for limit in spread_share(np.asarray(size), nothing, objects, confidence))
    low -= (1.0 - size) * float(spread_share(nothing, nothing, objects, confidence)[1])
    return (low, high) if difference >= 0 else (-high, -low)


# Rates.


def limit_rate(events: Float, hours: Float, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Bound a rate per hour, Σ events / Σ hours of K clusters: (low, high). Events may be means over runs.

    Exact Poisson limits of an effective number of events: N over φ, by which the variance of the rate between clusters
    exceeds that of N events, times (t of K − 1 / t of ∞)² as few clusters show little of how they vary; φ is 1 at
    least.
    Without any event: [0, 3.69 / Σ hours] at 95 %. What they hold: tools/coverage.py.

    Source: F. Garwood, "Fiducial limits for the Poisson distribution", Biometrika 28 (1936) 437–442.
    """
    from scipy.special import gammaincinv, ndtri, stdtrit

    N, H, K, tail = float(events.sum()), float(hours.sum()), len(events), (1.0 - confidence) / 2
    if N <= 0.0:
        return 0.0, float(gammaincinv(1.0, 1.0 - tail)) / H
    rate, phi = N / H, 1.0
    if K > 1:
        variance = K / (K - 1) * float(((events - rate * hours) ** 2).sum()) / H**2
        phi = max(1.0, variance * H / rate * (stdtrit(K - 1.0, tail) / ndtri(tail)) ** 2)
    m = N / phi
    low, high = (float(gammaincinv(shape, q)) for shape, q in ((m, tail), (m + 1.0, 1.0 - tail)))
    return low / m * rate, high / m * rate


# Any other figure.


def group_clusters(clusters: int) -> Int:
    """(K,) the group of each cluster, neighbours together, at most `MOST_GROUPS`."""
    return np.arange(clusters) * min(clusters, MOST_GROUPS) // max(clusters, 1)


def figure_variance(value: Float, without: Float, weights: Float) -> tuple[Float, Float]:
    """The variance (…) of a figure and its degrees of freedom (…), from the figure without each cluster (…, K).

    e = (n − w)·(value − without), V = Σ e²/(1 − w/n)/n², n = Σw. Degrees of freedom (tr Q)²/tr Q², Q being the
    covariance of e/√(1 − w/n) for clusters that vary alike: K − 1 where all weigh the same. Clusters of weight 0 do
    not count.

    Source: R. M. Bell, D. F. McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage
    samples", Survey Methodology 28 (2002) 169–181, whose formula for a mean this is, with a jackknife's residuals.
    """
    u = weights / weights.sum(axis=-1, keepdims=True)
    rest_share = np.where(u < 1.0, 1.0 - u, 1.0)
    error = np.where(u > 0, (1.0 - u) * (value[..., None] - without), 0.0)
    squares = (u**2).sum(axis=-1)[..., None, None]
    crossed = u[..., :, None] * u[..., None, :]
    Q = crossed * (squares - u[..., :, None] - u[..., None, :])
    place = np.arange(u.shape[-1])
    Q[..., place, place] += u**2
    Q /= np.sqrt(rest_share[..., :, None] * rest_share[..., None, :])
    trace = np.trace(Q, axis1=-2, axis2=-1)
    return (error**2 / rest_share).sum(axis=-1), trace**2 / (Q**2).sum(axis=(-2, -1))


def limit_figure(
    value: float | Float,
    without: Float,
    weights: Float,
    bounds: tuple[float, float] = (-np.inf, np.inf),
    confidence: float = CONFIDENCE,
) -> tuple[Float, Float]:
    """Bound a figure by Student's t, from the figure without each cluster (…, K): (low, high), (…).

    `weights (…, K)`: how many objects, or whatever the figure is an average over, a cluster has. `bounds`: the least
    and the most that is possible. At least two clusters weigh something.
    """
    from scipy.special import stdtrit

    value = np.asarray(value, dtype=float)
    variance, df = figure_variance(value, without, np.asarray(weights, dtype=float))
    half = -stdtrit(df, (1.0 - confidence) / 2) * np.sqrt(variance)
    return np.maximum(value - half, bounds[0]), np.minimum(value + half, bounds[1])


def alike_run_limits(
    value: float, bounds: tuple[float, float], runs: int, confidence: float = CONFIDENCE
) -> tuple[float | Float, float | Float]:
    """Bound a mean between `bounds` that is the same in all of `runs` independent runs: (low, high).

    In a share of runs at most, by exact limits of none of them, it is another, as far as the bounds allow.
    """
    other = float(exact_limits(0.0, float(runs), confidence)[1])
    return value - other * (value - bounds[0]), value + other * (bounds[1] - value)


def limit_bounded_mean(
    value: float | Float,
    without: Float,
    weights: Float,
    bounds: tuple[float | Float, float | Float],
    followed: float | Float = 1.0,
    confidence: float = CONFIDENCE,
    unseen: float | Float | None = None,
) -> tuple[Float, Float]:
    """Bound a mean of values between `bounds`, from the mean without each cluster (…, K): (low, high), (…).

    To the K clusters' means one more is added that was not seen, at the far end, once for each limit, and they weigh at
    random: the limit is the quantile of a beta distribution between the least and the most of them, with the mean and
    the variance of that sum. Of values 0 and 1 it is exact. `weights (…, K)`: of what the mean averages. `followed`:
    share of the weight whose value is known (not censored), `unseen`: the weight of the cluster not seen; None: that
    of an average row's cluster, Σw²/Σw, over `followed`.

    Source: N. Gaffke, "Three test statistics for a nonparametric one-sided hypothesis on the mean of a nonnegative
    variable", Math. Methods of Statistics 14 (2005) 451–467, whose limits it approximates by their two moments.
    """
    value, without = np.asarray(value, dtype=float)[..., None], np.asarray(without, dtype=float)
    w = np.asarray(weights, dtype=float)
    n = w.sum(axis=-1, keepdims=True)
    points = value + (n / np.where(w > 0, w, n) - 1.0) * (value - without)
    average = (w**2).sum(axis=-1) / n[..., 0] / followed
    added = np.broadcast_to(average if unseen is None else np.asarray(unseen, dtype=float), average.shape)
    tail = (1.0 - confidence) / 2
    low = _weighted_at_random(points, w, np.broadcast_to(bounds[0], added.shape), added, tail)
    high = _weighted_at_random(points, w, np.broadcast_to(bounds[1], added.shape), added, 1.0 - tail)
    return np.maximum(low, bounds[0]), np.minimum(high, bounds[1])


def _weighted_at_random(points: Float, weights: Float, edge: Float, added: Float, q: float) -> Float:
    """(…) the q-quantile of Σ E·w·z / Σ E·w: E exponential, independent; z and w of `points (…, K)` and `edge`."""
    from scipy.special import betaincinv

    z, w = np.concatenate([points, edge[..., None]], axis=-1), np.concatenate([weights, added[..., None]], axis=-1)
    u = w / w.sum(axis=-1, keepdims=True)
    mean = (u * z).sum(axis=-1)
    variance = ((u * (z - mean[..., None])) ** 2).sum(axis=-1) / (1.0 + (u**2).sum(axis=-1))
    lowest, span = z.min(axis=-1), np.ptp(z, axis=-1)
    is_constant = (span <= _ROUNDING) | (variance <= 0)
    width = np.where(is_constant, 1.0, span)
    p = np.clip((mean - lowest) / width, 1e-12, 1.0 - 1e-12)
    size = np.maximum(p * (1.0 - p) * width**2 / np.where(is_constant, 1.0, variance) - 1.0, _ROUNDING)
    quantile: Float = np.where(is_constant, mean, lowest + width * betaincinv(p * size, (1.0 - p) * size, q))
    return quantile


@dataclass(frozen=True)
class LimitedFigure:
    """A figure with its limits and their `kind`, or the reason why it has none; `value` None: there is no row.

    Of a time the value may be ∞, never, of a distance −∞; a limit that is infinite says that there is none.
    `share`: of a quantile, the share on the good side of the bound it is held against, between its limits. `bounds`,
    `spread`: of a mean between bounds, and the standard deviation of its clusters' means.
    """

    value: float | None
    low: float = math.nan
    high: float = math.nan
    kind: str | None = None
    share: tuple[float, float, float] | None = None
    bounds: tuple[float, float] | None = None
    spread: float = math.nan


def limit_left_out(
    value: float,
    without: Float,
    weights: Float,
    bounds: tuple[float, float] = (-math.inf, math.inf),
    confidence: float = CONFIDENCE,
    unseen: float | None = None,
    runs: int = 0,
) -> LimitedFigure:
    """A figure with its limits, from the figure without each of K clusters.

    `unseen`: the weight of the cluster that was not seen, of a mean between `bounds`; None: Student's t. `runs`: how
    many, where clusters are runs: of a mean that is the same in all their number tells something.
    """
    if len(weights) < 2 or not np.isfinite(without).all():
        return LimitedFigure(value)
    limits: tuple[float | Float, float | Float]
    if unseen is not None:
        low, high = limit_bounded_mean(value, without, weights, bounds, 1.0, confidence, unseen)
        share = weights / weights.sum()
        deviation = np.where(share > 0, (1.0 / np.where(share > 0, share, 1.0) - 1.0) * (value - without), 0.0)
        spread = math.sqrt(float(share @ deviation**2) * len(share) / (len(share) - 1))
        return LimitedFigure(value, float(low), float(high), BOUNDED, bounds=bounds, spread=spread)
    if np.abs(without - value).max() > _ROUNDING:
        limits, kind = limit_figure(value, without, weights, bounds, confidence), JACKKNIFE
    elif runs and np.isfinite(bounds).all():
        limits, kind = alike_run_limits(value, bounds, runs, confidence), JACKKNIFE
    else:
        return LimitedFigure(value, kind=ALL_ALIKE)
    return LimitedFigure(value, float(limits[0]), float(limits[1]), kind)


# Quantiles.


def limit_quantile(values: Float, low: Float, high: Float, q: float = 0.5) -> tuple[float, float]:
    """Bound the q-quantile by the limits `low`, `high (G,)` of the share at or below each of `values (G,)`.

    Values ascend, the first is the lowest possible, −∞ where there is none: where even there the share may be q, few
    clusters tell no lower limit. From the first value whose share may be q to the first whose share, and that of all
    after it, is q for sure; ∞ where there is none. So it is conservative where limits do not ascend.
    """
    possible, unsure = np.flatnonzero(high >= q - _ROUNDING), np.flatnonzero(low < q - _ROUNDING)
    ends = np.append(values, np.inf)
    return float(ends[possible[0] if len(possible) else -1]), float(ends[unsure[-1] + 1 if len(unsure) else 0])


_VALUES = 2000
"""Most values at which limits of a quantile are sought: they are then off by at most a two-thousandth of the rows."""


def limit_ranked_quantile(
    values: Float,
    weight: Float,
    cluster: Int,
    clusters: int,
    objects: float | None,
    q: float = 0.5,
    confidence: float = CONFIDENCE,
    *,
    once: bool = False,
) -> tuple[float, float]:
    """Bound the q-quantile of values (n,), −∞ among them, that weigh `weight (n,)` and are in a `cluster (n,)`.

    `objects`: how many the rows are about, as for `limit_share`; None: clusters are runs. `once`: clusters are drives
    that weigh alike.
    """
    order = np.argsort(values, kind="stable")
    ranked = values[order]
    last_of = np.flatnonzero(np.append(ranked[1:] != ranked[:-1], True))
    last_of = last_of[np.unique(np.linspace(0, len(last_of) - 1, min(len(last_of), _VALUES)).astype(int))]
    # Rows of each cluster up to each value; of −∞, where no row needs to be, none.
    place = np.searchsorted(last_of, np.arange(len(ranked)), side="left") * clusters + cluster[order]
    until = np.cumsum(np.bincount(place, weight[order], len(last_of) * clusters).reshape(-1, clusters), axis=0)
    until = np.concatenate([np.zeros((1, clusters)), until])
    if once:
        low, high = limit_share_once(until, np.broadcast_to(until[-1], until.shape), confidence)
    elif objects is None:
        share = until.sum(axis=1) / until[-1].sum()
        looks = until[-1].sum() / clusters
        low, high = limit_share_of_runs(share, until - share[:, None] * until[-1], looks, confidence)
    else:
        low, high = limit_share(until, np.broadcast_to(until[-1], until.shape), objects, confidence)
    return limit_quantile(np.append(-np.inf, ranked[last_of]), low, high, q)


EXACT = "exact"
"""The kind of an interval by exact binomial limits, of a share or of a difference of shares that all clusters have."""
JACKKNIFE = "jackknife"
"""The kind of an interval by Student's t from the figure without each cluster."""
BOUNDED = "bounded"
"""The kind of an interval of a mean between bounds, by one more cluster that was not seen."""
INVERTED = "inverted"
"""The kind of an interval of a median, from the limits of shares."""
ALL_ALIKE = "all clusters alike"
"""The kind of an interval that does not exist as the figure is the same in every cluster, a median in nearly all."""
NOTHING_DRAWN = "nothing drawn"
"""The kind of an interval that does not exist as all runs are equal."""


def interval_words(kind: str, over: str, number: int | None = None) -> str:
    """The columns `interval` and `interval_over` in words: `over 8 logs: how far …`."""
    method = {
        EXACT: "exact binomial limits", JACKKNIFE: "Student's t", INVERTED: "of medians",
        BOUNDED: "one that was not seen added at the far end",
    }.get(kind, kind)  # fmt: skip
    return f"{method} over {describe_clusters(over, number)}"


def format_limit(value: float) -> str:
    """A limit, or a difference, to three significant digits, without an exponent; a dash where there is none."""
    if not math.isfinite(value):
        return "–"
    if abs(value) < _ROUNDING:
        return "0"
    return f"{value:.0f}" if abs(value) >= 1000 else np.format_float_positional(float(f"{value:.3g}"), trim="-")


def format_limits(low: float, high: float) -> str:
    """An interval in the one notation of tables and texts: `[0.052, 4.39]`; a dash on a side without a limit."""
    return f"[{format_limit(low)}, {format_limit(high)}]"
