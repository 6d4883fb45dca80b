"""The metrics of `summary.csv`, in the order of its columns: the statistics of each, its value and its words.

Shares, times and distances are defined in metrics/survival.py. Times are cumulative incidences with departure
competing: an object that leaves undetected counts as never detected, and only the end of the ego or of the log censors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Bool, Float
from copem_replay.metrics.accuracy.metrics import ACCURACY
from copem_replay.metrics.braking.driver import UNRESOLVED
from copem_replay.metrics.braking.driving import DRIVING
from copem_replay.metrics.limits import (
    CLUSTERS,
    CONFIDENCE,
    EXACT,
    NOTHING_DRAWN,
    LimitedFigure,
    count_clusters,
    exact_limits,
    find_clusters,
    weigh_rows,
)
from copem_replay.metrics.metric import LINK, OUTPUT, Compared, Metric, MetricInputs, compared_metric
from copem_replay.metrics.row_figures import FigureRows
from copem_replay.metrics.survival import (
    CENSORED,
    DETECTED,
    LEFT,
    compute_unknown_s,
    cumulative_incidence,
    is_competing,
    quantile_time,
    quantile_with_never,
    restricted_mean,
)

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class DetectionStatistics:
    """Statistics of an event: its cumulative incidence over time, and the rows with their distances.

    Without rows there are no times, and every figure is None.
    """

    times_s: Float  # (M,) distinct times
    incidence: Float  # (M,) of detection
    distance_m: Float  # (n,) of the rows that can be ranked
    detected: Bool  # (n,)
    weight: Float  # (n,)
    horizon_s: float | None
    rows: bool

    def quantile_s(self, q: float) -> float | None:
        """Seconds by which a share q is detected; None: fewer are ever detected."""
        return quantile_time(self.times_s, self.incidence, q) if self.rows else None

    def mean_s(self) -> float | None:
        """Mean time in seconds, never detected counting as the horizon; None without rows or horizon."""
        if not self.rows or self.horizon_s is None:
            return None
        return restricted_mean(self.times_s, self.incidence, self.horizon_s)

    def distance_quantile_m(self, q: float) -> float | None:
        """Metres above which a share 1 − q is detected; never detected ranks below every distance."""
        if not len(self.detected):
            return None
        return quantile_with_never(self.distance_m, self.detected, q, self.weight)


def _detection_statistics(
    part: pd.DataFrame, detected: Bool, weight: Float, horizon_s: float | None, least: float = 1e-12
) -> DetectionStatistics:
    """Curve and distances of rows (n,), each counting by its `weight`. `least`: as for `cumulative_incidence`."""
    if not len(part):
        nothing = np.empty(0)
        return DetectionStatistics(nothing, nothing, nothing, np.empty(0, dtype=bool), nothing, None, rows=False)
    ending = np.where(detected, DETECTED, np.where(is_competing(part["ended_by"]), LEFT, CENSORED))
    observed_s = (part["ended_s"] - part["onset_s"]).to_numpy(dtype=float)
    # To a nanosecond: of equal times detections come first, and 1 − 0.8 is less than 0.2 − 0.
    time_s = np.round(np.where(detected, part["time_to_detection_s"].to_numpy(dtype=float), observed_s), 9)
    times, incidence = cumulative_incidence(time_s, ending, weight, least=least)
    distance_m = part["distance_at_detection_m"].to_numpy(dtype=float)
    has_distance = ~detected | ~np.isnan(distance_m)  # detected during a gap of the truth: no distance to rank
    return DetectionStatistics(
        times, incidence, distance_m[has_distance], detected[has_distance], weight[has_distance], horizon_s, rows=True
    )


def _tally_statistics(rows: pd.DataFrame, inputs: MetricInputs) -> DetectionStatistics:
    return _detection_statistics(rows, _is_known(rows), weigh_rows(rows, "runs", inputs.weigh), inputs.horizon_s)


def _is_known(rows: pd.DataFrame) -> Bool:
    """(n,) whether a row of the tally is for an instant, not for never."""
    known: Bool = rows["time_to_detection_s"].notna().to_numpy(dtype=bool)
    return known


def summarise_detections(inputs: MetricInputs) -> DetectionStatistics:
    """Statistics of the first list that confirms the object."""
    return _tally_statistics(inputs.rows, inputs)


def summarise_conflicts(inputs: MetricInputs) -> DetectionStatistics | None:
    """Statistics of the first list that implies a collision; None where the experiment does not ask for it."""
    return None if inputs.conflicts is None else _tally_statistics(inputs.conflicts, inputs)


@dataclass(frozen=True)
class ShareEstimate:
    """A share of rows and its 95 % limits, their kind, what they are over and how many of these (None: nothing)."""

    n: int
    share: float | None
    kind: str | None = None
    over: str | None = None
    clusters: int | None = None
    low: float | None = None
    high: float | None = None


def _estimate_share(
    part: pd.DataFrame, successes: NDArray[np.int64], inputs: MetricInputs, fixed: str
) -> ShareEstimate:
    """The share of `successes (n,)` in the runs of tally rows (n,), with limits; `fixed`: fact that all are alike."""
    n, weight = int(part["runs"].sum()), weigh_rows(part, "runs", inputs.weigh)
    counted = successes * (weight / part["runs"].to_numpy(dtype=float))
    total = float(counted.sum())
    share = total / n if n else None
    clusters = find_clusters(part, weigh=inputs.weigh)
    if clusters is None or not n:
        return ShareEstimate(n, share)
    if not clusters.by_run:
        low, high = clusters.limit_share(counted, weight, CONFIDENCE)
        return ShareEstimate(n, share, clusters.share_kind, clusters.over, clusters.count, low, high)
    if getattr(inputs.facts, fixed, False):
        return ShareEstimate(n, share, NOTHING_DRAWN)
    runs = n // count_clusters(part)[2]  # passes of a run may be one and the same: a run counts once
    return ShareEstimate(n, share, EXACT, clusters.over, runs, *map(float, exact_limits(total / n * runs, runs)))


def estimate_detected_share(inputs: MetricInputs) -> ShareEstimate:
    """The share of the rows that are detected."""
    runs = inputs.rows["runs"].to_numpy()
    return _estimate_share(inputs.rows, np.where(_is_known(inputs.rows), runs, 0), inputs, "fixed")


@dataclass(frozen=True)
class UnknownTimes:
    """How long objects are unknown, and what became of those that are never detected.

    `mean_s`: mean seconds from the onset to the detection or to the end of the episode, 0 where the object was known
    before; `to_horizon_s`: mean of the lesser of these and the horizon. `left_share`: of the rows, those whose object
    left undetected; `open_share`: those still undetected when the ego or the log ended, of which what would have come
    later is not known. All None without rows.
    """

    mean_s: float | None = None
    to_horizon_s: float | None = None
    left_share: float | None = None
    open_share: float | None = None


def _measure_unknown(rows: pd.DataFrame, known: Bool, weight: Float, horizon_s: float | None) -> UnknownTimes:
    """Times unknown (s) and shares never known, of rows (n,) that count by `weight`; `known (n,)`: detected."""
    total = float(weight.sum())
    if not total:
        return UnknownTimes()
    length_s = (rows["ended_s"] - rows["onset_s"]).to_numpy(dtype=float)
    unknown_s = compute_unknown_s(rows["time_to_detection_s"].to_numpy(dtype=float), length_s)
    left_unknown = is_competing(rows["ended_by"]) & ~known
    return UnknownTimes(
        float(weight @ unknown_s) / total,
        None if horizon_s is None else float(weight @ np.minimum(unknown_s, horizon_s)) / total,
        float(weight[left_unknown].sum()) / total,
        float(weight[~known & ~left_unknown].sum()) / total,
    )


def measure_unknown(inputs: MetricInputs) -> UnknownTimes:
    """How long objects are unknown in the rows of the tally."""
    weight = weigh_rows(inputs.rows, "runs", inputs.weigh)
    return _measure_unknown(inputs.rows, _is_known(inputs.rows), weight, inputs.horizon_s)


def limit_means(inputs: MetricInputs) -> tuple[LimitedFigure, LimitedFigure]:
    """The mean time to detection, and that of min(unknown, horizon), with their 95 % limits; over runs without."""
    clusters = find_clusters(inputs.rows, weigh=inputs.weigh)
    if not len(inputs.rows) or inputs.horizon_s is None or clusters is None or clusters.by_run:
        return LimitedFigure(None), LimitedFigure(None)
    least_s = getattr(inputs.facts, "least_s", 0.0)
    rows = FigureRows(inputs.rows, weigh_rows(inputs.rows, "runs", inputs.weigh), clusters, least_s=least_s)
    unknown_s = np.minimum(rows.unknown_s, inputs.horizon_s)
    limited_s = rows.limit_mean(unknown_s, inputs.horizon_s, CONFIDENCE)
    return rows.limit_mean_time(inputs.horizon_s, CONFIDENCE), limited_s


def _end_of_mean(k: int, end: str) -> Callable[[tuple[LimitedFigure, ...]], float | None]:
    return lambda limits: _number_or_none(float(getattr(limits[k], end)))


def estimate_foreseen_share(inputs: MetricInputs) -> float | None:
    """The share of the rows in which a list implies a collision; NaN without rows."""
    if inputs.conflicts is None:
        return None
    weight = weigh_rows(inputs.conflicts, "runs", inputs.weigh)
    return float(weight[_is_known(inputs.conflicts)].sum() / weight.sum()) if len(weight) else np.nan


def estimate_passed_share(inputs: MetricInputs) -> ShareEstimate | None:
    """The share of the rows in conflict that pass; None without braking."""
    if "in_conflict" not in inputs.rows:
        return None
    part = inputs.rows[inputs.rows["in_conflict"]]
    return _estimate_share(part, part["passed"].to_numpy(), inputs, "fixed_verdicts")


@dataclass(frozen=True)
class ExactStatistics:
    """The limit for many runs: all episodes count alike, the rows of `exact.parquet` of each by their probability."""

    share: float | None
    times: DetectionStatistics
    unknown: UnknownTimes
    missed: dict[str, float | None]


def summarise_exact(inputs: MetricInputs) -> ExactStatistics | None:
    """Statistics of `exact.parquet`; None where the experiment does not ask for exact times.

    Less than one of the n rows of the runs counts as none: with censoring, an episode that is still open with
    probability 10⁻⁹ would otherwise stand for all that were censored before.
    """
    part = inputs.exact
    if part is None:
        return None
    missed = _summarise_missed(part[part["detection_s"].isna()])
    if not len(part):
        times = _detection_statistics(part, np.empty(0, dtype=bool), np.empty(0), None)
        return ExactStatistics(None, times, UnknownTimes(), missed)
    part = part[part["probability"] > 0]
    weight = weigh_rows(part, "probability", inputs.weigh)
    known = part["detection_s"].notna().to_numpy()
    times = _detection_statistics(part, known, weight, inputs.horizon_s, 1 / int(inputs.rows["runs"].sum()))
    unknown = _measure_unknown(part, known, weight, inputs.horizon_s)
    return ExactStatistics(weight[known].sum() / weight.sum(), times, unknown, missed)


def _summarise_missed(rows: pd.DataFrame) -> dict[str, float | None]:
    """Base-10 logarithm of the mean probability to miss an object, also at half the odds, from the “never” rows of
    `exact.parquet`. Its derivative by the log-odds of detection weighs each episode by its share of the mean.
    """
    names = ("miss_log10", "miss_log10_half_odds")
    if not rows["miss_log10"].notna().any():
        return dict.fromkeys((*names, "miss_per_logit"))
    shares: dict[str, Float] = {}
    row: dict[str, float | None] = {}
    for name in names:
        log10 = rows[name].fillna(-np.inf).to_numpy(dtype=float)
        shares[name] = np.power(10.0, log10 - log10.max())
        row[name] = float(log10.max() + np.log10(shares[name].mean()))
    weight, slope = shares["miss_log10"], rows["miss_per_logit"].fillna(0.0).to_numpy(dtype=float)
    return row | {"miss_per_logit": float(weight @ slope / weight.sum())}


def exact_verdict_shares(inputs: MetricInputs) -> tuple[float | None, float | None] | None:
    """The shares that pass and that fail, from `exact.parquet`; None: no conflict, or a failure too rare to resolve."""
    if inputs.exact is None or "conflict" not in inputs.exact:
        return None
    part = inputs.exact[inputs.exact["conflict"]]
    if not len(part):
        return None, None
    weight = weigh_rows(part, "probability", inputs.weigh)
    passes, fails = (part[f"{name}_probability"].to_numpy(dtype=float) for name in ("pass", "fail"))
    share = float(weight @ np.nan_to_num(fails) / weight.sum())
    failed = None if share < UNRESOLVED and np.isnan(fails).any() else share
    return float(weight @ passes / weight.sum()), failed


def _number_or_none(value: float) -> float | None:
    return None if np.isnan(value) else value


def _limit_metrics(
    share: str, statistics: Callable[[MetricInputs], ShareEstimate | None], prefix: str = ""
) -> tuple[Metric, ...]:
    """The metrics beside a `share`: its lower and upper limit, their kind, and the clusters they are over."""
    row = partial(Metric, statistics=statistics, better=0)
    return (
        row(f"{share}_low", value=attrgetter("low"), help=f"lower limit of {share}, 95 %"),
        row(f"{share}_high", value=attrgetter("high"), help=f"upper limit of {share}, 95 %"),
        row(f"{prefix}interval", value=attrgetter("kind"), kind="text",
            help=f"kind of the limits of {share}, or why there are none"),
        row(f"{prefix}interval_over", value=attrgetter("over"), kind="text", among=tuple(CLUSTERS),
            help=f"what the limits of {share} are over: logs, objects of one log, passes or runs of one object"),
        row(f"{prefix}interval_clusters", value=attrgetter("clusters"),
            help=f"how many of these the limits of {share} are over"),
    )  # fmt: skip


_MEAN = "mean of min(time after which it is known, horizon), never detected counting as the horizon"

_DETECTION_METRICS = (
    Metric("n", attrgetter("rows"), lambda rows: int(rows["runs"].sum()), 0,
           "rows: runs × measured objects × logs", "summary", "rows"),
    Metric("list_rate_hz", lambda of: of, lambda of: of.list_rate_hz, 0, "fused lists per second", "summary",
           "fused lists per second"),
    Metric("detected_share", estimate_detected_share, lambda of: of.share, 1,
           "share of the rows that were detected, [95 % interval]", "summary", "detected, %",
           Compared("share detected", itemgetter("detected"))),
    *_limit_metrics("detected_share", estimate_detected_share),
    Metric("ttd_p5_s", summarise_detections, lambda of: of.quantile_s(0.05), -1,
           "time after which 5 % of the rows are known"),
    Metric("ttd_median_s", summarise_detections, lambda of: of.quantile_s(0.5), -1,
           "median of the time after which an object is known", "summary", "known after (median), s"),
    Metric("ttd_p95_s", summarise_detections, lambda of: of.quantile_s(0.95), -1,
           "time after which 95 % are known; a dash: fewer ever are", "summary", "known after (95 % by), s"),
    Metric("ttd_rmst_s", summarise_detections, lambda of: of.mean_s(), -1, _MEAN, "summary",
           "known after (mean), s", Compared(_MEAN, "restricted means")),
    compared_metric("ttd_both_s", -1, "summary", "known after where both detect, s",
                    Compared("mean time after which it is known over the rows that both detect; beside it those that "
                             "one alone detects", "means where both detect")),
    Metric("ttd_rmst_horizon_s", summarise_detections, lambda of: of.horizon_s, 0, "the horizon of ttd_rmst_s"),
    Metric("ttd_rmst_s_low", limit_means, _end_of_mean(0, "low"), 0, "lower limit of ttd_rmst_s, 95 %"),
    Metric("ttd_rmst_s_high", limit_means, _end_of_mean(0, "high"), 0, "upper limit of ttd_rmst_s, 95 %"),
    Metric("unknown_s", measure_unknown, lambda of: of.mean_s, -1,
           "mean seconds from the onset until it is known or gone; needs no horizon", "summary",
           "unknown (mean), s"),
    Metric("unknown_to_horizon_s", measure_unknown, lambda of: of.to_horizon_s, -1,
           "mean of min(seconds unknown, horizon): what criteria and stars judge, for one long stay decides no mean",
           "summary", "unknown up to the horizon (mean), s",
           Compared("mean of min(seconds unknown, horizon)", "times unknown")),
    Metric("unknown_to_horizon_s_low", limit_means, _end_of_mean(1, "low"), 0,
           "lower limit of unknown_to_horizon_s, 95 %"),
    Metric("unknown_to_horizon_s_high", limit_means, _end_of_mean(1, "high"), 0,
           "upper limit of unknown_to_horizon_s, 95 %"),
    Metric("left_undetected_share", measure_unknown, lambda of: of.left_share, -1,
           "share of the rows whose object left undetected: never detected", "undetected", "left undetected, %"),
    Metric("open_share", measure_unknown, lambda of: of.open_share, 0,
           "share of the rows still undetected when the log or the ego ended: censored", "undetected",
           "undetected at the end, %"),
    compared_metric("ttd_rmst_s_equal_ghosts", -1, "summary", "known after at equal false positives, s",
                    Compared("the same at as many false positives per minute as the baseline has",
                             "restricted means at equal ghosts", ("lists.parquet", "thresholds.parquet"))),
    Metric("dad_median_m", summarise_detections, lambda of: of.distance_quantile_m(0.5), 1,
           "median distance at detection, centre to centre; never detected ranks below all", "summary",
           "at distance (median), m",
           Compared("median of the differences of distances at detection", "distances")),
    Metric("dad_p5_m", summarise_detections, lambda of: of.distance_quantile_m(0.05), 1,
           "distance at detection that 95 % of the rows exceed", "summary", "at distance (95 % beyond), m"),
)  # fmt: skip

_CONFLICT_METRICS = (
    Metric("conflict_detected_share", estimate_foreseen_share, _number_or_none, 1,
           "share of the rows in which a list implied a collision", "conflict", "collision foreseen, %"),
    Metric("conflict_ttd_median_s", summarise_conflicts, lambda of: of.quantile_s(0.5), -1,
           "median time to the first list that implied a collision", "conflict", "median time until foreseen, s"),
    Metric("conflict_ttd_p95_s", summarise_conflicts, lambda of: of.quantile_s(0.95), -1,
           "time by which 95 % of the rows had such a list", "conflict", "95 % foreseen by, s"),
    Metric("conflict_ttd_rmst_s", summarise_conflicts, lambda of: of.mean_s(), -1,
           "mean time to such a list, never counting as the horizon", "conflict", "mean time until foreseen, s"),
    Metric("conflict_dad_median_m", summarise_conflicts, lambda of: of.distance_quantile_m(0.5), 1,
           "median distance at such a list", "conflict", "median distance when foreseen, m"),
)  # fmt: skip

_BRAKING_METRICS = (
    Metric("n_conflict", estimate_passed_share, lambda of: of.n, 0,
           "rows in conflict: without braking the ego would come too near", "braking", "rows in conflict"),
    Metric("pass_share", estimate_passed_share, lambda of: of.share, 1,
           "share of conflicts that the configured driver avoids when braking after detection, [95 % interval]",
           "braking", "passes, %", Compared("share of conflicts that pass", "passes")),
    *_limit_metrics("pass_share", estimate_passed_share, "pass_"),
)  # fmt: skip


def _exact_metric(name: str, value: Callable[[ExactStatistics], float | None], better: Literal[-1, 0, 1]) -> Metric:
    return Metric(f"{name}_exact", summarise_exact, value, better, f"{name} in closed form, the limit for many runs")


def _exact_missed(name: str, help: str) -> Metric:
    find = itemgetter(name)
    return Metric(name, summarise_exact, lambda exact: find(exact.missed), -1, help)


_EXACT_METRICS = (
    _exact_metric("detected_share", lambda of: of.share, 1),
    _exact_metric("ttd_p5_s", lambda of: of.times.quantile_s(0.05), -1),
    _exact_metric("ttd_median_s", lambda of: of.times.quantile_s(0.5), -1),
    _exact_metric("ttd_p95_s", lambda of: of.times.quantile_s(0.95), -1),
    _exact_metric("ttd_rmst_s", lambda of: of.times.mean_s(), -1),
    _exact_metric("unknown_s", lambda of: of.unknown.mean_s, -1),
    _exact_metric("unknown_to_horizon_s", lambda of: of.unknown.to_horizon_s, -1),
    _exact_metric("dad_median_m", lambda of: of.times.distance_quantile_m(0.5), 1),
    _exact_metric("dad_p5_m", lambda of: of.times.distance_quantile_m(0.05), 1),
    _exact_missed("miss_log10", "log₁₀ of the mean probability that an episode misses its object"),
    _exact_missed("miss_log10_half_odds", "the same with the odds of every detection halved"),
    _exact_missed("miss_per_logit", "derivative of ln of that probability by the log-odds of every detection"),
    Metric(
        "pass_share_exact",
        exact_verdict_shares,
        itemgetter(0),
        1,
        "pass_share in closed form, the limit for many runs",
        "braking",
        "passes without a draw, %",
    ),
    Metric(
        "fail_share_exact",
        exact_verdict_shares,
        itemgetter(1),
        -1,
        "share of conflicts that fail, in closed form; null below 10⁻¹⁵",
    ),
)

_ALL = {
    "": _DETECTION_METRICS, "conflict": _CONFLICT_METRICS, "braking": _BRAKING_METRICS, "needless": DRIVING,
    "accuracy": ACCURACY,
    "output": OUTPUT, "link": LINK, "exact": _EXACT_METRICS,
}  # fmt: skip
METRICS_OF: dict[str, tuple[Metric, ...]] = {what: tuple(m for m in of if m.help) for what, of in _ALL.items()}
"""All built-in metrics of the summary, in the order of its columns, by what an experiment asks for; "": always."""
METRICS: tuple[Metric, ...] = tuple(metric for of in METRICS_OF.values() for metric in of)
METRIC: dict[str, Metric] = {metric.name: metric for metric in METRICS}
COMPARED: dict[str, Metric] = {
    metric.name: metric
    for what in ("", "accuracy", "braking", "needless")
    for metric in _ALL[what]
    if metric.compared is not None
}
"""The metrics that `compare` holds against a baseline, in its order."""

OF_LISTS = ("lists", "needless")
"""Parts of metrics that are of whole lists, or of driving: of all rows, whichever count for times."""
PARTS = {
    "summary": "When, and how far away",
    "undetected": "What became of those never detected",
    "braking": "Braking in time",
    "needless": "Braking for nothing",
    "conflict": "When a collision was foreseen",
    "accuracy": "How far off",
    "lists": "Contents of the lists",
    "link": "Lists on links",
    "output": "How old a recorded output is",
    "own": "Own metrics",
}
"""Tables that metrics are shown in, and their captions."""
