"""Figures of a configuration's rows with their limits (`metrics/limits.py`): drawn as bands, and held against bounds.

A share at an instant has the limits of a share: its variance is from the curves without each cluster, as with censoring
a curve is no ratio of sums. A quantile has the limits of the shares at or below each value, inverted, so that it is
within them wherever its share is.

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
from copem_replay.metrics.limits import (
    INVERTED,
    WITHIN_LOG,
    Clusters,
    LimitedFigure,
    limit_bounded_mean,
    limit_left_out,
    limit_quantile,
    limit_ranked_quantile,
    limit_share_of_runs,
    share_variance,
    spread_share,
)
from copem_replay.metrics.survival import (
    CENSORED,
    DETECTED,
    LEFT,
    compute_unknown_s,
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

_SAME = 1e-9
"""Times this close are equal: they are whole nanoseconds."""


def detection_endings(rows: pd.DataFrame) -> tuple[Float, Int]:
    """The time (n,) from onset to detection or end of the episode, and the kind of ending (n,).

    `rows`: of `Results.known`, or of the tally.
    """
    detected = rows["time_to_detection_s"].notna().to_numpy()
    looked_s = (rows["ended_s"] - rows["onset_s"]).to_numpy(dtype=float)
    time_s = np.where(detected, rows["time_to_detection_s"].to_numpy(dtype=float), looked_s)
    ending = np.where(detected, DETECTED, np.where(is_competing(rows["ended_by"]), LEFT, CENSORED))
    return time_s, ending


_INSTANTS = 1000
"""Most instants at which limits of a quantile are sought."""


@dataclass(frozen=True)
class FigureRows:
    """Rows (n,) of a configuration: `table` has the columns of the tally, each row counts by its `weight`.

    `least`: as for `cumulative_incidence`. `clusters`: None: no limits. `least_s`: no time to detection can be shorter.
    """

    table: pd.DataFrame
    weight: Float
    clusters: Clusters | None
    least: float = 1e-12
    least_s: float = 0.0

    @cached_property
    def known(self) -> Bool:
        """(n,) whether the object is ever known: the row has an instant, not never."""
        known: Bool = self.table["time_to_detection_s"].notna().to_numpy(dtype=bool)
        return known

    @property
    def length_s(self) -> Float:
        """(n,) lengths of the episodes."""
        length_s: Float = (self.table["ended_s"] - self.table["onset_s"]).to_numpy(dtype=float)
        return length_s

    @property
    def unknown_s(self) -> Float:
        """(n,) seconds for which the object is unknown."""
        return compute_unknown_s(self.table["time_to_detection_s"].to_numpy(dtype=float), self.length_s)

    @cached_property
    def endings(self) -> tuple[Float, Int]:
        """(n,) times of endings and (n,) their kinds, by `detection_endings`."""
        time_s, ending = detection_endings(self.table)
        return np.round(time_s, 9), ending

    @cached_property
    def curve(self) -> tuple[Float, Float]:
        """The cumulative incidence: its times and its values."""
        return cumulative_incidence(*self.endings, self.weight, least=self.least)

    def limit_share(self, successes: Float, confidence: float) -> LimitedFigure:
        """The share of the weight that `successes (n,)` have, with limits."""
        value = float(successes.sum()) / float(self.weight.sum())
        if self.clusters is None:
            return LimitedFigure(value)
        low, high = self.clusters.limit_share(successes, self.weight, confidence)
        return LimitedFigure(value, low, high, self.clusters.share_kind)

    def limit_mean_time(self, horizon_s: float, confidence: float) -> LimitedFigure:
        """The mean time to detection (s) up to the horizon; without limits where no row is followed to an ending."""
        value, clusters = restricted_mean(*self.curve, horizon_s), self.clusters
        time_s, ending = self.endings
        followed = float(self.weight[(ending != CENSORED) | (time_s >= horizon_s - _SAME)].sum() / self.weight.sum())
        if clusters is None or not followed:
            return LimitedFigure(value)
        groups = int(clusters.group.max()) + 1
        bounds = float(time_s[self.known].min(initial=min(self.least_s, horizon_s))), horizon_s
        means_without = restricted_means_without(
            time_s, ending, self.weight, clusters.group, groups, horizon_s, least=self.least
        )  # fmt: skip
        return self._limit_mean(clusters, value, means_without, bounds, confidence, followed)

    def limit_mean(self, values: Float, most: float, confidence: float) -> LimitedFigure:
        """The mean of values (n,), each from 0 to `most`, with limits."""
        total = float(self.weight.sum())
        value, over = float(self.weight @ values) / total, self.clusters
        if over is None:
            return LimitedFigure(value)
        sums, rows = (np.bincount(over.group, self.weight * column) for column in (values, np.ones(len(values))))
        with np.errstate(divide="ignore", invalid="ignore"):
            without = (sums.sum() - sums) / (total - rows)
        return self._limit_mean(over, value, without, (0.0, most), confidence)

    def _limit_mean(
        self,
        over: Clusters,
        value: float,
        without: Float,
        bounds: tuple[float, float],
        confidence: float,
        followed: float = 1.0,
    ) -> LimitedFigure:
        """A mean within `bounds`, with limits from the means `without` each group of clusters (jackknife)."""
        rows, groups = over.weigh(self.weight), np.bincount(over.group, self.weight).astype(float)
        unseen = None if over.by_run else float((rows**2).sum() / rows.sum()) / followed
        return limit_left_out(value, without, groups, bounds, confidence, unseen, over.count if over.by_run else 0)

    @cached_property
    def _quantile_limits(self) -> dict[float, tuple[Float, Float, Float, Int]]:
        return {}

    def limit_time_quantile(self, q: float, confidence: float, bound: float | None = None) -> LimitedFigure:
        """The time (s) by which a share q is detected, with limits; ∞: fewer are. `bound` (s): also the share by it."""
        time_s = quantile_time(*self.curve, q)
        value = math.inf if time_s is None else time_s
        if self.clusters is None:
            return LimitedFigure(value)
        if confidence not in self._quantile_limits:
            self._quantile_limits[confidence] = self._limit_curve(confidence)
        times_s, low, high, steps = self._quantile_limits[confidence]
        low_s, most = limit_quantile(np.append(-np.inf, times_s[steps]), low, high, q)
        if math.isfinite(low_s) and (k := int(np.searchsorted(times_s[steps], low_s))) > 0:
            low_s = float(times_s[steps[k - 1] + 1])  # between two instants limits are not known
        return LimitedFigure(value, low_s, most, INVERTED, None if bound is None else self._share_by(bound, confidence))

    def _share_by(self, at_s: float, confidence: float) -> tuple[float, float, float]:
        """The cumulative incidence at an instant between its limits."""
        share = np.append(0.0, self.curve[1])[np.searchsorted(self.curve[0], at_s, side="right")]
        low, high = self.limit_incidence([at_s], confidence)
        return float(low[0]), float(share), float(high[0])

    def _limit_curve(self, confidence: float) -> tuple[Float, Float, Float, Int]:
        times_s = self.curve[0]
        steps = np.unique(np.linspace(0, len(times_s) - 1, min(len(times_s), _INSTANTS)).astype(int))
        before = [min([0.0, *times_s[:1]]) - 1.0]
        return times_s, *self.limit_incidence(np.append(before, times_s[steps]), confidence), steps

    def limit_incidence(self, at_s: Sequence[float] | Float, confidence: float) -> tuple[Float, Float]:
        """Lower and upper limits (G,) of the share detected by ascending instants `at_s (G,)`. Needs clusters."""
        assert self.clusters is not None
        over, at_s, times_s = self.clusters, np.asarray(at_s, dtype=float), self.curve[0]
        share = np.append(0.0, self.curve[1])[np.searchsorted(times_s, at_s, side="right")]
        if over.by_run and over.units <= 1:
            return limit_share_of_runs(share, np.zeros((len(share), over.count)), 1, confidence)
        units = over.weigh_units(self.weight)
        group_units = np.bincount(over.grouped, units)
        share_without = incidences_without(
            *self.endings, self.weight, over.group, len(group_units), at_s, least=self.least
        ).T  # fmt: skip
        if over.once:
            return self._limit_incidence_once(over, at_s, share, share_without, confidence)
        residual = (group_units.sum() - group_units) * (share[:, None] - share_without)
        variance = share_variance(residual, np.broadcast_to(group_units, residual.shape))
        within_log = np.where(variance > _SAME**2, 0.0, 1.0) if over.by_run else WITHIN_LOG
        units = np.broadcast_to(units * (over.units if over.by_run else 1.0), (len(share), over.count))
        return spread_share(share, variance, units, confidence, within_log)

    def _limit_incidence_once(
        self, over: Clusters, at_s: Float, share: Float, without: Float, confidence: float
    ) -> tuple[Float, Float]:
        """The same where drives weigh alike: the mean of their shares, between 0 and 1."""
        (time_s, ending), total = self.endings, float(self.weight.sum())
        order = np.argsort(time_s, kind="stable")
        lost = np.append(0.0, np.cumsum(np.where(ending == CENSORED, self.weight, 0.0)[order]))
        followed = 1.0 - lost[np.searchsorted(time_s[order], at_s, side="left")] / total
        groups = np.broadcast_to(np.bincount(over.group, self.weight).astype(float), without.shape)
        unseen = total / over.count / np.maximum(followed, _SAME)
        return limit_bounded_mean(share, without, groups, (0.0, 1.0), 1.0, confidence, unseen)

    def limit_distance_quantile(self, q: float, confidence: float, bound: float | None = None) -> LimitedFigure:
        """The distance (m) beyond which a share 1 − q is detected, with limits; −∞: fewer are ever detected."""
        distance_m = self.table["distance_at_detection_m"].to_numpy(dtype=float)
        has_distance = ~self.known | ~np.isnan(distance_m)
        weight, ranked = self.weight[has_distance], np.where(self.known, distance_m, -np.inf)[has_distance]
        if not has_distance.any():
            return LimitedFigure(None)
        distance_or_none = quantile_with_never(ranked, self.known[has_distance], q, weight)
        value = -math.inf if distance_or_none is None else distance_or_none
        if self.clusters is None:
            return LimitedFigure(value)
        clusters = self.clusters.select(has_distance)
        units = None if clusters.by_run else clusters.units
        low, high = limit_ranked_quantile(
            ranked, weight, clusters.number, clusters.count, units, q, confidence, once=clusters.once
        )  # fmt: skip
        if bound is None:
            return LimitedFigure(value, low, high, INVERTED)
        beyond = np.where(ranked >= bound, weight, 0.0)
        low_share, high_share = clusters.limit_share(beyond, weight, confidence)
        return LimitedFigure(value, low, high, INVERTED, (low_share, float(beyond.sum() / weight.sum()), high_share))


def limit_sums(
    sums: Float,
    compute: Callable[[Float], Any],
    clusters: Clusters | None,
    weight: Float,
    confidence: float,
    least: float = -math.inf,
) -> LimitedFigure:
    """A figure with its limits: `compute` of the totals of `sums (n, m)` over rows that weigh `weight (n,)`.

    `least`: its smallest possible value.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        total = sums.sum(axis=0)
        value = float(compute(total))
        if not math.isfinite(value):
            return LimitedFigure(None)
        if clusters is None:
            return LimitedFigure(value)
        by_group = np.stack([np.bincount(clusters.group, column) for column in sums.T], axis=1).astype(np.float64)
        without = np.array([float(compute(total - group_sums)) for group_sums in by_group])
    weights = np.bincount(clusters.group, weight).astype(float)
    return limit_left_out(value, without, weights, (least, math.inf), confidence)


# Metrics of the summary that are held against bounds.


class JudgedMetric(NamedTuple):
    """How a metric is computed from rows. `rows`: of detections, implied collisions (`conflict`), those in conflict
    (`braking`), closed forms (`exact`, `exact braking`). `limit`: the figure, from rows, horizon, confidence, bound.
    """

    rows: Literal["detected", "conflict", "braking", "exact", "exact braking"]
    limit: Callable[[FigureRows, float, float, float], LimitedFigure]

    @property
    def to_horizon(self) -> bool:
        """Whether it is a mean up to the horizon."""
        return self.limit in (_mean_time, _mean_unknown_to_horizon)


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
    return rows.limit_mean(rows.unknown_s, float(rows.length_s.max()), confidence)


def _mean_unknown_to_horizon(rows: FigureRows, horizon_s: float, confidence: float, _: float) -> LimitedFigure:
    return rows.limit_mean(np.minimum(rows.unknown_s, horizon_s), horizon_s, confidence)


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
    "unknown_to_horizon_s": _mean_unknown_to_horizon,
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
        """The least possible value: a bias may be negative."""
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
