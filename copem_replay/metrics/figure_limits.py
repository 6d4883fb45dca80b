"""Figures of a configuration with limits over clusters of its rows: drawn as bands, and held against bounds.

Clusters are those of `summary.csv` (`metrics/intervals.py`), or the runs: runs of one and the same recordings are
independent, whatever their rows have in common. A share at an instant has the limits of a share: its variance is from
the curves without each cluster, as with censoring a curve is no ratio of sums. A quantile has the limits of the shares
at or below each value, inverted, so that it is within them wherever its share is.

Letters of the shapes: n rows, K clusters, G instants, m sums.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.intervals import (
    ALL_ALIKE,
    CONFIDENCE,
    EXACT,
    INVERTED,
    JACKKNIFE,
    alike_run_limits,
    group_clusters,
    limit_figure,
    limit_quantile,
    limit_ranked_quantile,
    limit_share,
    limit_share_of_runs,
    share_variance,
    spread_share,
)
from copem_replay.metrics.summary_metrics import compute_unknown_s
from copem_replay.metrics.survival import (
    CENSORED,
    DETECTED,
    LEFT,
    cumulative_incidence,
    incidences_without,
    is_competing,
    quantile_time,
    quantile_with_never,
    restricted_mean,
    restricted_means_without,
)

if TYPE_CHECKING:
    import pandas as pd

# Clusters of rows.

_SAME = 1e-9
"""Figures this close are equal: times are whole nanoseconds."""


@dataclass(frozen=True)
class RowClusters:
    """What an interval of rows (n,) is over: each row's `name` (n,), and `object` (n,), the episode it is about."""

    over: str
    name: Sequence[Any]
    object: Sequence[Any]

    @cached_property
    def number(self) -> Int:
        """(n,) the cluster of each row, 0 … K − 1 in the order of their names."""
        import pandas as pd

        number: Int = pd.factorize(np.asarray(self.name), sort=True)[0]
        return number

    @cached_property
    def weights(self) -> Float:
        """(K,) objects of each cluster; runs count one each."""
        import pandas as pd

        size = int(self.number.max(initial=-1)) + 1
        if self.over == "runs":
            return np.ones(size)
        object_ix = pd.factorize(np.asarray(self.object))[0]
        pairs = pd.unique(self.number * (int(object_ix.max(initial=0)) + 1) + object_ix)
        return np.bincount(pairs // (int(object_ix.max(initial=0)) + 1), minlength=size).astype(float)

    @cached_property
    def group(self) -> Int:
        """(K,) the group of each cluster that is left out with its neighbours where there are many."""
        return group_clusters(len(self.weights))

    @cached_property
    def looks(self) -> float:
        """Objects that a run looks at."""
        import pandas as pd

        return float(len(pd.unique(np.asarray(self.object))))


def cluster_rows(rows: pd.DataFrame, over: str, cluster: pd.Series) -> RowClusters:
    """The clusters of a configuration's rows (n,), from `choose_clusters`."""
    return RowClusters(over, list(cluster), list(rows["log"].astype(str) + "\n" + rows["object_id"].astype(str)))


def detection_endings(rows: pd.DataFrame) -> tuple[Float, Int]:
    """Time (n,) from onset to detection or end of the episode, and kind of ending (n,).

    `rows`: of `Results.known`, or of the tally.
    """
    detected = rows["time_to_detection_s"].notna().to_numpy()
    looked_s = (rows["ended_s"] - rows["onset_s"]).to_numpy(dtype=float)
    time_s = np.where(detected, rows["time_to_detection_s"].to_numpy(dtype=float), looked_s)
    ending = np.where(detected, DETECTED, np.where(is_competing(rows["ended_by"]), LEFT, CENSORED))
    return time_s, ending


# Curves and means.


def incidence_limits(
    time_s: Float,
    ending: Int,
    clusters: RowClusters,
    at_s: Float,
    runs: Int | Float | None = None,
    *,
    confidence: float = CONFIDENCE,
    least: float = 1e-12,
) -> tuple[Float, Float]:
    """Lower and upper limits (G,) of the cumulative incidence at instants (G,), ascending.

    `time_s` (n,), `ending` (n,), `least` as in `cumulative_incidence`; `runs` (n,): how often each row counts, None:
    once.
    """
    weight = np.ones(len(time_s)) if runs is None else np.asarray(runs, dtype=float)
    times_s, incidence = cumulative_incidence(time_s, ending, weight, least=least)
    share = np.append(0.0, incidence)[np.searchsorted(times_s, at_s, side="right")]
    weights, group = clusters.weights, clusters.group
    by_run = clusters.over == "runs"
    if by_run and clusters.looks <= 1:
        return limit_share_of_runs(share, np.zeros((len(share), len(weights))), 1, confidence)
    of_group, row_group = np.bincount(group, weights).astype(float), group[clusters.number]
    without = incidences_without(time_s, ending, weight, row_group, len(of_group), at_s, least=least).T
    residual = (of_group.sum() - of_group) * (share[:, None] - without)
    variance = share_variance(residual, np.broadcast_to(of_group, residual.shape))
    weights = np.broadcast_to(weights * (clusters.looks if by_run else 1.0), (len(share), len(weights)))
    if by_run:
        return spread_share(share, variance, weights, confidence, np.where(variance > _SAME**2, 0.0, 1.0))
    return spread_share(share, variance, weights, confidence)


def mean_limits(
    time_s: Float,
    ending: Int,
    clusters: RowClusters,
    horizon_s: float,
    runs: Int | Float | None = None,
    *,
    confidence: float = CONFIDENCE,
    least: float = 1e-12,
) -> tuple[float, float] | None:
    """Limits of the restricted mean of times (n,) at a horizon; None if it is the same without any cluster, or if there
    are fewer than two. Arguments as in `incidence_limits`.
    """
    weight = np.ones(len(time_s)) if runs is None else np.asarray(runs, dtype=float)
    group, weights = clusters.group, np.bincount(clusters.group, clusters.weights).astype(float)
    if len(weights) < 2:
        return None
    mean_s = restricted_mean(*cumulative_incidence(time_s, ending, weight, least=least), horizon_s)
    without = restricted_means_without(
        time_s, ending, weight, group[clusters.number], len(weights), horizon_s, least=least
    )
    bounds = min(0.0, float(time_s.min())), horizon_s
    return _limit_unless_alike(mean_s, without, weights, bounds, confidence)


def _limit_unless_alike(
    value: float, without: Float, weights: Float, bounds: tuple[float, float], confidence: float
) -> tuple[float, float] | None:
    """Limits of a figure from those without each cluster; None: there are too few, or all are the same."""
    if len(weights) < 2 or not np.isfinite(without).all() or np.abs(without - value).max() <= _SAME:
        return None
    low, high = limit_figure(value, without, weights, bounds, confidence)
    return float(low), float(high)


# Figures of rows.

_INSTANTS = 1000
"""Most instants at which limits of a quantile are sought."""


@dataclass(frozen=True)
class LimitedFigure:
    """A figure with its limits, and the `kind` of these or why there are none; `value` None: there is no row.

    Of a time the value may be ∞, never, of a distance −∞; a limit that is infinite says that there is none.
    `share`: of a quantile, the limits of the share at or below the bound it is held against.
    """

    value: float | None
    low: float = math.nan
    high: float = math.nan
    kind: str | None = None
    share: tuple[float, float] | None = None


@dataclass(frozen=True)
class FigureRows:
    """Rows (n,) of a configuration: `table` has the columns of the tally, each row counts by its `weight`.

    `least`: as for `cumulative_incidence`. `clusters`: None: no limits.
    """

    table: pd.DataFrame
    weight: Float
    clusters: RowClusters | None
    least: float = 1e-12

    @cached_property
    def known(self) -> Bool:
        """(n,) whether a row is for an instant, not for never."""
        known: Bool = self.table["time_to_detection_s"].notna().to_numpy(dtype=bool)
        return known

    @cached_property
    def endings(self) -> tuple[Float, Int]:
        """(n,) times, and how they end."""
        time_s, ending = detection_endings(self.table)
        return np.round(time_s, 9), ending

    @cached_property
    def curve(self) -> tuple[Float, Float]:
        """The cumulative incidence: its times and values."""
        return cumulative_incidence(*self.endings, self.weight, least=self.least)

    def limit_share(self, successes: Float, confidence: float) -> LimitedFigure:
        """The share of `successes (n,)`, weights of rows or parts of them."""
        total = float(self.weight.sum())
        value = float(successes.sum()) / total
        if self.clusters is None:
            return LimitedFigure(value)
        number, size = self.clusters.number, len(self.clusters.weights)
        sums, counts = (np.bincount(number, of, minlength=size) for of in (successes, self.weight))
        if self.clusters.over == "runs":
            limits = limit_share_of_runs(np.asarray(value), sums - value * counts, self.clusters.looks, confidence)
        else:
            objects = self.clusters.weights.sum()
            limits = limit_share(sums, counts, objects, confidence)
        low, high = map(float, limits)
        return LimitedFigure(value, low, high, EXACT)

    def limit_mean_time(self, horizon_s: float, confidence: float) -> LimitedFigure:
        """The restricted mean."""
        value = restricted_mean(*self.curve, horizon_s)
        if self.clusters is None:
            return LimitedFigure(value)
        time_s, ending = self.endings
        limits = mean_limits(
            time_s, ending, self.clusters, horizon_s, self.weight, confidence=confidence, least=self.least
        )
        bounds = min(0.0, float(time_s.min())), horizon_s
        return _with_limits(value, limits or self._limit_alike_runs(value, bounds, confidence))

    def _limit_alike_runs(
        self, value: float, bounds: tuple[float, float], confidence: float
    ) -> tuple[float, float] | None:
        """Limits of a mean that is the same in all runs; None: clusters are others, whose number tells less."""
        if self.clusters is None or self.clusters.over != "runs" or len(self.clusters.weights) < 2:
            return None
        return alike_run_limits(value, bounds, len(self.clusters.weights), confidence)

    def limit_mean(self, values: Float, most: Float, confidence: float) -> LimitedFigure:
        """The mean of values (n,), from 0 to `most (n,)`."""
        sums = np.stack([self.weight * values, self.weight], axis=1)
        found = limit_sums(sums, lambda of: of[..., 0] / of[..., 1], self.clusters, confidence)
        if found.kind == ALL_ALIKE and found.value is not None:
            bounds = 0.0, float(self.weight @ most / self.weight.sum())
            return _with_limits(found.value, self._limit_alike_runs(found.value, bounds, confidence))
        return found

    @cached_property
    def _quantile_limits(self) -> dict[float, tuple[Float, Float, Float, Int]]:
        return {}

    def limit_time_quantile(self, q: float, confidence: float, bound: float | None = None) -> LimitedFigure:
        """The time by which a share q is detected; ∞: a smaller share ever is."""
        found = quantile_time(*self.curve, q)
        value = math.inf if found is None else found
        if self.clusters is None:
            return LimitedFigure(value)
        if confidence not in self._quantile_limits:
            self._quantile_limits[confidence] = self._limit_curve(confidence)
        times_s, low, high, steps = self._quantile_limits[confidence]
        least, most = limit_quantile(np.append(-np.inf, times_s[steps]), low, high, q)
        if math.isfinite(least) and (k := int(np.searchsorted(times_s[steps], least))) > 0:
            least = float(times_s[steps[k - 1] + 1])  # between two instants limits are not known
        share = None if bound is None else tuple(float(of[0]) for of in self._incidence_limits([bound], confidence))
        return LimitedFigure(value, least, most, INVERTED, share)  # type: ignore[arg-type]

    def _limit_curve(self, confidence: float) -> tuple[Float, Float, Float, Int]:
        times_s = self.curve[0]
        steps = np.unique(np.linspace(0, len(times_s) - 1, min(len(times_s), _INSTANTS)).astype(int))
        before = [min([0.0, *times_s[:1]]) - 1.0]
        return times_s, *self._incidence_limits(np.append(before, times_s[steps]), confidence), steps

    def _incidence_limits(self, at_s: Sequence[float] | Float, confidence: float) -> tuple[Float, Float]:
        assert self.clusters is not None
        (time_s, ending), at_s = self.endings, np.asarray(at_s, dtype=float)
        return incidence_limits(
            time_s, ending, self.clusters, at_s, self.weight, confidence=confidence, least=self.least
        )

    def limit_distance_quantile(self, q: float, confidence: float, bound: float | None = None) -> LimitedFigure:
        """The distance beyond which a share 1 − q is detected; −∞: a smaller share ever is."""
        distance_m = self.table["distance_at_detection_m"].to_numpy(dtype=float)
        placed = ~self.known | ~np.isnan(distance_m)
        weight, ranked = self.weight[placed], np.where(self.known, distance_m, -np.inf)[placed]
        if not placed.any():
            return LimitedFigure(None)
        found = quantile_with_never(ranked, self.known[placed], q, weight)
        value = -math.inf if found is None else found
        if self.clusters is None:
            return LimitedFigure(value)
        over, name, about = self.clusters.over, self.clusters.number[placed], np.asarray(self.clusters.object)[placed]
        kept = RowClusters(over, name, about)
        size, objects = len(kept.weights), None if over == "runs" else kept.weights.sum()
        low, high = limit_ranked_quantile(ranked, weight, kept.number, size, objects, q, confidence)
        if bound is None:
            return LimitedFigure(value, low, high, INVERTED)
        beyond = np.where(ranked >= bound, weight, 0.0)
        share = FigureRows(self.table[placed], weight, kept).limit_share(beyond, confidence)
        return LimitedFigure(value, low, high, INVERTED, (share.low, share.high))


def _with_limits(value: float, limits: tuple[float, float] | None) -> LimitedFigure:
    return LimitedFigure(value, kind=ALL_ALIKE) if limits is None else LimitedFigure(value, *limits, JACKKNIFE)


def limit_sums(
    sums: Float,
    of: Callable[[Float], Any],
    clusters: RowClusters | None,
    confidence: float,
    weighed_by: int | None = None,
    least: float = -math.inf,
) -> LimitedFigure:
    """A figure `of` sums (…, m) over rows, from `sums (n, m)`; `weighed_by`: the sum that it averages over; `least`:
    the least that it can be.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        total = sums.sum(axis=0)
        value = float(of(total))
        if not math.isfinite(value):
            return LimitedFigure(None)
        if clusters is None:
            return LimitedFigure(value)
        group = clusters.group
        columns = [np.bincount(group[clusters.number], column, int(group.max()) + 1) for column in sums.T]
        by_group: Float = np.stack(columns, axis=1).astype(np.float64)
        without = np.array([float(of(total - one)) for one in by_group])
    of_objects = np.bincount(group, clusters.weights).astype(np.float64)
    weights: Float = of_objects if weighed_by is None else by_group[:, weighed_by]
    return _with_limits(value, _limit_unless_alike(value, without, weights, (least, math.inf), confidence))


# Metrics of the summary that are held against bounds.


class JudgedMetric(NamedTuple):
    """How a metric is taken of rows. `rows`: of which: detections, implied collisions (`conflict`), those in conflict
    (`braking`), closed forms (`exact`, `exact braking`). `limit`: the figure, from rows, horizon, confidence, bound.
    """

    rows: Literal["detected", "conflict", "braking", "exact", "exact braking"]
    limit: Callable[[FigureRows, float, float, float], LimitedFigure]


def _quantile_s(q: float) -> Callable[[FigureRows, float, float, float], LimitedFigure]:
    return lambda rows, _, confidence, bound: rows.limit_time_quantile(q, confidence, bound)


def _quantile_m(q: float) -> Callable[[FigureRows, float, float, float], LimitedFigure]:
    return lambda rows, _, confidence, bound: rows.limit_distance_quantile(q, confidence, bound)


def _share_of(
    successes: Callable[[FigureRows], Float | Bool],
) -> Callable[[FigureRows, float, float, float], LimitedFigure]:
    return lambda rows, _, confidence, __: rows.limit_share(rows.weight * successes(rows), confidence)


def _mean_time(rows: FigureRows, horizon_s: float, confidence: float, _: float) -> LimitedFigure:
    return rows.limit_mean_time(horizon_s, confidence)


def _mean_unknown(rows: FigureRows, _: float, confidence: float, __: float) -> LimitedFigure:
    length_s = (rows.table["ended_s"] - rows.table["onset_s"]).to_numpy(dtype=float)
    unknown_s = compute_unknown_s(rows.table["time_to_detection_s"].to_numpy(dtype=float), length_s)
    return rows.limit_mean(unknown_s, length_s, confidence)


def _left(rows: FigureRows) -> Bool:
    still: Bool = ~rows.known & (rows.endings[1] == LEFT)
    return still


def _open(rows: FigureRows) -> Bool:
    still: Bool = ~rows.known & (rows.endings[1] == CENSORED)
    return still


def _column(name: str) -> Callable[[FigureRows], Float]:
    return lambda rows: np.nan_to_num(rows.table[name].to_numpy(dtype=float))


_OF_DETECTION = {
    "detected_share": _share_of(lambda rows: rows.known),
    "ttd_p5_s": _quantile_s(0.05),
    "ttd_median_s": _quantile_s(0.5),
    "ttd_p95_s": _quantile_s(0.95),
    "ttd_rmst_s": _mean_time,
    "unknown_s": _mean_unknown,
    "dad_median_m": _quantile_m(0.5),
    "dad_p5_m": _quantile_m(0.05),
}
JUDGED = {
    **{name: JudgedMetric("detected", limit) for name, limit in _OF_DETECTION.items()},
    "left_undetected_share": JudgedMetric("detected", _share_of(_left)),
    "open_share": JudgedMetric("detected", _share_of(_open)),
    "conflict_detected_share": JudgedMetric("conflict", _share_of(lambda rows: rows.known)),
    "conflict_ttd_median_s": JudgedMetric("conflict", _quantile_s(0.5)),
    "conflict_ttd_p95_s": JudgedMetric("conflict", _quantile_s(0.95)),
    "conflict_ttd_rmst_s": JudgedMetric("conflict", _mean_time),
    "conflict_dad_median_m": JudgedMetric("conflict", _quantile_m(0.5)),
    "pass_share": JudgedMetric("braking", lambda rows, _, level, __: rows.limit_share(_column("passed")(rows), level)),
    **{f"{name}_exact": JudgedMetric("exact", limit) for name, limit in _OF_DETECTION.items()},
    "pass_share_exact": JudgedMetric("exact braking", _share_of(_column("pass_probability"))),
    "fail_share_exact": JudgedMetric("exact braking", _share_of(_column("fail_probability"))),
}
"""Metrics of rows of the tally and of `exact.parquet`, by name."""


class SummedMetric(NamedTuple):
    """A ratio of two of the sums by episode of `metrics/slices.py`; `root`: of squares."""

    sum: str
    over: str
    root: bool = False

    @property
    def least(self) -> float:
        """The least that it can be: a bias has a sign."""
        return -math.inf if self.sum.endswith(("east_m", "north_m")) else 0.0

    def value_of(self, sums: Float) -> Any:
        """The metric of both sums (…, 2)."""
        mean = sums[..., 0] / sums[..., 1]
        return np.sqrt(mean) if self.root else mean


SUMMED = {
    "position_rmse_m": SummedMetric("square_m2", "placed", root=True),
    "position_rmse_captured_m": SummedMetric("square_then_m2", "pairs", root=True),
    "bias_east_m": SummedMetric("east_m", "placed"),
    "bias_north_m": SummedMetric("north_m", "placed"),
    "velocity_rmse_mps": SummedMetric("velocity_square_m2ps2", "placed", root=True),
    "age_of_information_s": SummedMetric("age_of_information_s", "pairs"),
    "nees": SummedMetric("nees", "pairs"),
    "identity_switches": SummedMetric("switches", "tracked_rows"),
    "longest_gap_s": SummedMetric("longest_gap_s", "rows"),
}
"""Metrics of accuracy, by name."""
PER_MINUTE = {
    "false_positives_per_min": "ghosts",
    "stale_false_positives_per_min": "stale_ghosts",
    "duplicates_per_min": "duplicates",
}
"""Metrics of `lists.parquet`, and the columns that are counted."""
