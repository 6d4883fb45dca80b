"""Intervals: how far a figure may be from that of all such traffic, by the drives at hand.

*Cluster*: rows that hang together. Logs, from `FEWEST_LOGS` on; in a single log its objects, from `FEWEST_CLUSTERS` on;
of a single object its runs. Of two logs there is no interval: how drives differ cannot be told from two, and objects of
several logs are never taken as independent (`choose_over`).
*Share*: exact limits (Clopper–Pearson) of p·n of n trials, n an effective number of objects: no more than there are
once objects of one log hang together by `WITHIN_LOG`, nor than the spread between logs tells (`limit_share`).
*Any other figure*: value ± t·√V, from the figure without each cluster (`limit_figure`), at most `MOST_GROUPS` times.
*Quantile*: all values at which the limits of the share at or below them hold the quantile's level (`limit_quantile`).
*Nothing drawn*: where no random number is behind a result it is equal in every run, and an interval over runs tells
nothing.

Limits are at 95 % unless a function is given another `confidence`. What they hold, and what not: tools/coverage.py,
docs/guide/metrics.md. Functions of arrays take any leading axes (…). Letters of the shapes: K clusters, G values.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import Float, Int

if TYPE_CHECKING:
    import pandas as pd

FEWEST_LOGS = 3
"""From so many logs on intervals are over logs."""
FEWEST_CLUSTERS = 5
"""Over fewer objects of one log, or runs of one object, there is no interval of a figure."""
MOST_GROUPS = 200
"""More clusters are joined to so many groups before a figure is computed without each."""
WITHIN_LOG = 0.2
"""Correlation of two objects of a log that few logs cannot refute; on recorded drives .02 to .10."""
CONFIDENCE = 0.95
_ROUNDING = 1e-9
"""Numbers of trials, and figures, that differ by less differ by rounding only."""

# What an interval is over.

_TELLS = {
    "logs": "how far other drives of this kind may differ",
    "objects": "how far other objects of this drive may differ; nothing about other drives",
    "runs": "how far other draws of the same models may differ for this one object; nothing about other traffic",
}
CLUSTERS = {"logs": ("log", ""), "objects": ("object", " of this drive"), "runs": ("run", " of this one object")}


def choose_over(logs: int, objects: int) -> str | None:
    """What an interval is over: `logs`, `objects` or `runs`; None: nothing. `logs`, `objects`: how many have rows."""
    if logs >= FEWEST_LOGS:
        return "logs"
    if logs != 1:
        return None
    return "runs" if objects == 1 else "objects" if objects >= FEWEST_CLUSTERS else None


def choose_clusters(table: pd.DataFrame) -> tuple[str | None, pd.Series]:
    """What an interval of a table's rows is over, as by `choose_over`, and each row's cluster (n,).

    Rows of a tally stand for several runs: where the interval is over runs they form one cluster.
    """
    log = table["log"].astype(str)
    episode = log + "\n" + table["object_id"].astype(str)
    over = choose_over(log.nunique(), episode.nunique())
    if over == "runs" and "run" in table:
        return over, table["run"].astype(str)
    return over, log if over == "logs" else episode


def describe_clusters(over: str, number: int | None = None, fewest: int | None = None) -> str:
    """What an interval is over, and what it tells: `8 logs: how far other drives of this kind may differ`.

    `fewest`: where intervals are over different numbers of clusters, up to `number`.
    """
    noun, whose = CLUSTERS[over]
    counted = f"{noun}s" if number is None else count_noun(number, noun)
    up_to = "" if fewest is None or fewest == number else f"{fewest} to "
    return f"{up_to}{counted}{whose}: {_TELLS[over]}"


NOT_ENOUGH = "neither more runs nor objects of several logs together tell how other drives differ"
"""What is said beside the reason why there is no interval."""


def explain_no_clusters(logs: int, objects: int) -> str:
    """Why there is no interval, where `choose_over` says so: `2 logs, fewer than 3`."""
    if logs == 1:
        return f"{count_noun(objects, 'object')} of one drive, fewer than {FEWEST_CLUSTERS}"
    return f"{count_noun(logs, 'log')}, fewer than {FEWEST_LOGS}"


def absent_share(logs: int) -> float:
    """The largest share of traffic that may be of a kind which none of so many logs has, at 95 %: 1 − .05^(1/K)."""
    return float(1.0 - (1.0 - CONFIDENCE) ** (1.0 / logs))


def describe_absent(logs: int) -> str:
    """What so many logs cannot exclude, whatever the interval: a kind of drive that none of them is."""
    return f"a kind of drive that makes up to {100 * absent_share(logs):.0f} % of such traffic can be absent"


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
    none, all_of_them = k <= _ROUNDING, n - k <= _ROUNDING
    failures = np.where(all_of_them, 0.0, n - k)
    low = betaincinv(np.where(none, 1.0, k), failures + 1.0, tail)
    high = betaincinv(np.where(none, 0.0, k) + 1.0, np.where(all_of_them, 1.0, failures), 1.0 - tail)
    return np.where(none, 0.0, low), np.where(all_of_them, 1.0, high)


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
    """Exact limits (…) of a share with a variance (…) over clusters that have so many objects each, `weights (…, K)`.

    Of n objects, m = Σw²/Σw in an average object's cluster, at most n/(1 + `within`·(m − 1)) count, `within` being the
    correlation in a cluster that its number cannot refute; nor more than p(1 − p)/variance, times
    (t of n − 1 / t of K − 1)² as few clusters show little of how they vary. One at least.
    """
    from scipy.special import stdtrit

    tail = (1.0 - confidence) / 2

    n, clusters = weights.sum(axis=-1), (weights > 0).sum(axis=-1)
    counted = n / (1.0 + within * ((weights**2).sum(axis=-1) / n - 1.0))
    spread = share * (1.0 - share)
    told = (variance > 0) & (spread > _ROUNDING**2) & (clusters > 1)
    ratio = stdtrit(np.where(told, n - 1.0, 1.0), tail) / stdtrit(np.where(told, clusters - 1.0, 1.0), tail)
    by_spread = np.where(told, spread / np.where(told, variance, 1.0) * ratio**2, np.inf)
    effective = np.maximum(np.minimum(counted, by_spread), 1.0)
    return exact_limits(np.clip(share, 0.0, 1.0) * effective, effective, confidence)


def alike_limits(difference: float, weights: Float, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Bound a difference of two shares, −1 … 1, that all clusters have alike: (low, high). `weights (K,)`: objects.

    Exact on each side, with n as in `spread_share` without a variance: as if |difference| · n of n objects favoured the
    one and the rest neither; of the rest, any share that is possible where none of n does may favour the other. Five
    logs of one object at 0: [−.522, .522], at 1: [.478, 1].
    """
    size, objects = min(abs(difference), 1.0), np.asarray(weights, dtype=float)
    nothing = np.asarray(0.0)
    low, high = (float(limit) for limit in spread_share(np.asarray(size), nothing, objects, confidence))
    low -= (1.0 - size) * float(spread_share(nothing, nothing, objects, confidence)[1])
    return (low, high) if difference >= 0 else (-high, -low)


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
    rest = np.where(u < 1.0, 1.0 - u, 1.0)
    error = np.where(u > 0, (1.0 - u) * (value[..., None] - without), 0.0)
    squares = (u**2).sum(axis=-1)[..., None, None]
    crossed = u[..., :, None] * u[..., None, :]
    Q = crossed * (squares - u[..., :, None] - u[..., None, :])
    place = np.arange(u.shape[-1])
    Q[..., place, place] += u**2
    Q /= np.sqrt(rest[..., :, None] * rest[..., None, :])
    trace = np.trace(Q, axis1=-2, axis2=-1)
    return (error**2 / rest).sum(axis=-1), trace**2 / (Q**2).sum(axis=(-2, -1))


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
) -> tuple[float, float]:
    """Bound a mean between `bounds` that is the same in so many independent runs: (low, high).

    In a share of runs at most, by exact limits of none of them, it is another, as far as the bounds allow.
    """
    other = float(exact_limits(0.0, float(runs), confidence)[1])
    return value - other * (value - bounds[0]), value + other * (bounds[1] - value)


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
) -> tuple[float, float]:
    """Bound the q-quantile of values (n,), −∞ among them, that weigh `weight (n,)` and are in a `cluster (n,)`.

    `objects`: how many the rows are about, as for `limit_share`; None: clusters are runs.
    """
    order = np.argsort(values, kind="stable")
    ranked = values[order]
    last_of = np.flatnonzero(np.append(ranked[1:] != ranked[:-1], True))
    last_of = last_of[np.unique(np.linspace(0, len(last_of) - 1, min(len(last_of), _VALUES)).astype(int))]
    # Rows of each cluster up to each value; of −∞, where no row needs to be, none.
    place = np.searchsorted(last_of, np.arange(len(ranked)), side="left") * clusters + cluster[order]
    until = np.cumsum(np.bincount(place, weight[order], len(last_of) * clusters).reshape(-1, clusters), axis=0)
    until = np.concatenate([np.zeros((1, clusters)), until])
    if objects is None:
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
INVERTED = "inverted"
"""The kind of an interval of a median, from the limits of shares."""
ALL_ALIKE = "all clusters alike"
"""The kind of an interval that does not exist as the figure is the same in every cluster, a median in nearly all."""


def interval_words(kind: str, over: str, number: int | None = None) -> str:
    """What limits are, by the columns `interval` and `interval_over`: `over 8 logs: how far …`."""
    method = {EXACT: "exact binomial limits", JACKKNIFE: "Student's t", INVERTED: "of medians"}.get(kind, kind)
    return f"{method} over {describe_clusters(over, number)}"


# Outcomes that are equal in every run.

NOTHING_DRAWN = "nothing drawn"
"""The kind of an interval that does not exist as all runs are equal."""
