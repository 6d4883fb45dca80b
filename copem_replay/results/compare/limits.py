"""Figures of pairs and the limits of their differences: by leaving out clusters, exact, or none and why.

*Pair*: the same row (log, object, run) in two configurations, with common random numbers.
*Difference*: the first minus the second, pair by pair, or of two figures of the same pairs.
*Discordant*: a pair that succeeded in one only. McNemar's test asks whether as many do so in the one as in the other.
*Cluster*: dependent pairs, such as all of one log. It is left out on both sides of a pair together, so that what both
have in common cancels, as it does in the difference.
*Median*: the smallest value that at least half of the weight is at or below: the value of some pair.

Clusters are those of `summary.csv` (`metrics/limits.py`), and have the weight of what the figure averages: rows; pairs
of what both hold, lists in GOSPA, minutes in ghosts per minute.

Letters of the shapes: i items, K clusters, m sums, G values.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.limits import (
    ALL_ALIKE,
    CONFIDENCE,
    EXACT,
    FEWEST_CLUSTERS,
    FEWEST_LOGS,
    INVERTED,
    MOST_GROUPS,
    NOTHING_DRAWN,
    LimitedFigure,
    alike_limits,
    group_clusters,
    limit_left_out,
    limit_ranked_quantile,
)
from copem_replay.metrics.survival import (
    CENSORED,
    cumulative_incidence,
    quantile_with_never,
    restricted_mean,
    restricted_means_without,
)

# Items of figures, and the clusters that are left out.

_SUMMED = ("n", "only", "sums")
"""Columns that are summed when items are joined; the others are equal among them."""


@dataclass(frozen=True)
class StatisticItems:
    """The items of a figure, by columns (i, …): `logs`, `objects` (−1: none in particular), `passes`, episodes of a log
    (−1: any), `runs` (−1: all).

    These count in the lists of `ClusterNames`. `n`: number of pairs (rows, lists) that an item stands for.
    """

    columns: Mapping[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def condensed(self, *, runs: bool) -> StatisticItems:
        """Items that are equal in all but the summed columns, added up to one. `runs`: not across runs and passes."""
        columns = dict(self.columns)
        for name in ("runs", "passes"):
            columns[name] = self[name] if runs else np.full_like(self[name], -1)
        group = np.zeros(len(self["n"]), dtype=np.int64)
        for name in columns.keys() - {*_SUMMED}:
            number, known = pd.factorize(columns[name])
            group = pd.factorize(group * max(len(known), 1) + number)[0]
        first = np.unique(group, return_index=True)[1]  # groups are numbered by their first items
        return StatisticItems(
            {name: _sum_groups(of, group) if name in _SUMMED else of[first] for name, of in columns.items()}
        )

    @property
    def weight(self) -> Float:
        """(i,) the weight of an item in means and medians: its number of pairs, unless drives weigh alike."""
        return self.columns.get("weight", self["n"]).astype(float)

    def each_drive_once(self) -> StatisticItems:
        """The items with weights by which each log counts the same."""
        sums = self.columns.get("sums")
        averaged = self["n"].astype(float) if sums is None else sums[:, 2]
        of_log = np.bincount(self["logs"], averaged)
        scale = averaged.sum() / max(np.count_nonzero(of_log), 1) / np.where(of_log > 0, of_log, np.inf)[self["logs"]]
        scaled = {"weight": self["n"] * scale} | ({} if sums is None else {"sums": sums * scale[:, None]})
        return StatisticItems({**self.columns, **scaled})

    @staticmethod
    def joined(parts: Sequence[StatisticItems]) -> StatisticItems:
        """The items of several logs in one."""
        return StatisticItems({name: np.concatenate([part[name] for part in parts]) for name in parts[0].columns})


def _sum_groups(values: NDArray[Any], group: Int) -> NDArray[Any]:
    """(g, …) sums of values (i, …) of each group."""
    sums = [np.bincount(group, column) for column in np.atleast_2d(values.T)]
    return np.stack(sums, axis=-1).reshape(len(sums[0]), *values.shape[1:]).astype(values.dtype)


@dataclass(frozen=True)
class ClusterNames:
    """The names of logs, objects and runs, to which the numbers of items refer; passes are numbers."""

    logs: Sequence[str]
    objects: list[str]  # log and id, separated by a line feed
    runs: int


@dataclass(frozen=True)
class ClusterIndex:
    """K clusters: sorted `names`, and the `number` of each log, object, pass or run (−1: in none, always there).

    Clusters are what `over` says, or groups of neighbours where there are many.
    """

    over: str
    names: tuple[str, ...]
    number: Int  # its last element is for −1

    def of(self, items: StatisticItems) -> Int:
        """(i,) the cluster of each item, −1: none."""
        cluster: Int = self.number[items[self.over]]
        return cluster

    @property
    def grouped(self) -> ClusterIndex:
        """At most `MOST_GROUPS` clusters: neighbours together."""
        if len(self.names) <= MOST_GROUPS:
            return self
        group = group_clusters(len(self.names))
        names = tuple(self.names[k] for k in np.flatnonzero(np.diff(group, prepend=-1)))
        return replace(self, names=names, number=np.where(self.number >= 0, group[self.number], -1))

    def count_objects(self, items: StatisticItems) -> Float:
        """(K,) objects with items in each cluster; passes or runs where clusters are these."""
        cluster, by = self.of(items), self.over if self.over in ("passes", "runs") else "objects"
        counted = (cluster >= 0) & (items[by] >= 0)
        pairs = np.unique(np.stack([cluster[counted], items[by][counted]]), axis=1)
        return np.bincount(pairs[0], minlength=len(self.names)).astype(float)


def index_clusters(items: StatisticItems, over: str, names: ClusterNames) -> ClusterIndex | None:
    """The clusters of items: logs, objects, passes or runs, by name in order; None: too few have the figure."""
    numbers = [str(k) for k in range(max(names.runs, int(items["passes"].max(initial=-1)) + 1))]
    all_names = {"logs": names.logs, "objects": names.objects}.get(over, numbers)
    present = sorted(np.unique(items[over][items[over] >= 0]).tolist(), key=lambda k: all_names[k])
    if len(present) < (FEWEST_LOGS if over == "logs" else FEWEST_CLUSTERS):
        return None
    number = np.full(len(all_names) + 1, -1, dtype=np.int64)
    number[present] = np.arange(len(present))
    return ClusterIndex(over, tuple(all_names[k] for k in present), number)


# Statistics of pairs. A ValueError for shapes or values is a defect of the caller.


def mcnemar_p_value(only_first: int, only_second: int) -> float:
    """Exact two-sided p-value of so many discordant pairs, were either kind as likely; 1 without any.

    The pairs are taken as independent. Runs of one object are not, which makes the p-value too small: then an interval
    over whole objects or logs is the one to trust.

    Raises ValueError for negative counts.

    Source: Q. McNemar, "Note on the sampling error of the difference between correlated proportions or percentages",
    Psychometrika 12 (1947) 153–157; exact instead of χ²: the binomial distribution with p = ½.
    """
    from scipy.special import bdtr

    if only_first < 0 or only_second < 0:
        raise ValueError(f"mcnemar: expected counts of at least 0, found {only_first} and {only_second}")
    return min(1.0, 2.0 * float(bdtr(min(only_first, only_second), only_first + only_second, 0.5)))


# Figures of pairs, computed from items that can be summed over any clusters: of all logs, of one, without one.


@dataclass(frozen=True, kw_only=True)
class PairStatistic(ABC):
    """A figure of two configurations. Items may have `only (i, 2)`: whether only the first, or second, succeeded.

    `by_object`: whether the items are known by object, so that objects or passes can be clusters. `share`: whether the
    figure is a share of the items, which then have `only`.
    """

    parts: tuple[StatisticItems, ...]
    by_object: bool = True
    share: bool = False

    @property
    def items(self) -> StatisticItems:
        """The items that stand for the pairs."""
        return self.parts[0]

    def condensed(self, *, runs: bool) -> Self:
        """The figure with equal items joined. `runs`: items of several runs stay apart."""
        return replace(self, parts=tuple(part.condensed(runs=runs) for part in self.parts))

    @classmethod
    def joined(cls, logs: Sequence[Self]) -> Self:
        """The figure of several logs."""
        return replace(logs[0], parts=tuple(map(StatisticItems.joined, zip(*(log.parts for log in logs), strict=True))))

    def each_drive_once(self) -> Self:
        """The figure with weights by which each log counts the same."""
        return replace(self, parts=tuple(part.each_drive_once() for part in self.parts))

    @abstractmethod
    def values(self) -> tuple[float, float, float]:
        """The figure of the first, of the second, and their difference; NaN or infinite: undefined."""

    @abstractmethod
    def without_each(self, clusters: ClusterIndex) -> Float:
        """(K,) differences without the items of each cluster."""

    def weights(self, clusters: ClusterIndex) -> Float:
        """(K,) the weight of each cluster in the figure's average: its number of pairs."""
        cluster, n = clusters.of(self.items), self.items.weight
        return np.bincount(cluster[cluster >= 0], n[cluster >= 0], len(clusters.names)).astype(float)

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the greatest possible difference."""
        return -math.inf, math.inf

    @property
    def followed(self) -> float:
        """The share of pairs whose values are known up to the bounds."""
        return 1.0

    def limits(self, difference: float, clusters: ClusterIndex, confidence: float = CONFIDENCE) -> LimitedFigure:
        """The difference with its limits; none: without some cluster there is no difference."""
        of = clusters.grouped
        found = limit_left_out(difference, self.without_each(of), self.weights(of), self.bounds, confidence)
        if found.kind != ALL_ALIKE or not self.share:
            return found
        weights = self.weights(clusters)
        objects = weights * clusters.count_objects(self.items).sum() / weights.sum()
        return LimitedFigure(difference, *alike_limits(difference, objects, confidence), EXACT)

    def limit_by_bounds(
        self, difference: float, clusters: ClusterIndex, confidence: float = CONFIDENCE
    ) -> LimitedFigure:
        """The difference with limits of a mean between bounds, by which a criterion can be met; else without limits."""
        if not np.isfinite(self.bounds).all() or not self.followed:
            return LimitedFigure(difference)
        of, each = clusters.grouped, self.weights(clusters)
        unseen = float((each**2).sum() / each.sum()) / self.followed
        return limit_left_out(difference, self.without_each(of), self.weights(of), self.bounds, confidence, unseen)


@dataclass(frozen=True, kw_only=True)
class SumStatistic(PairStatistic):
    """A function `of` sums (…, m) that gives the figure of either side: shares, means, their roots.

    Items: `sums`; the third is what the figure averages over. `most`: as far apart both sides can be.
    """

    of: Callable[[Float], tuple[Float, Float]]
    most: float = math.inf

    def values(self) -> tuple[float, float, float]:
        """The figure of the first, of the second, and their difference."""
        with np.errstate(divide="ignore", invalid="ignore"):  # division by 0: there is no figure
            first, second = self.of(self.items["sums"].sum(axis=0))
            return float(first), float(second), float(first - second)

    def _sums_by_cluster(self, clusters: ClusterIndex) -> tuple[Float, Float]:
        """(K, m) sums of each cluster, and (m,) of the items that are in none."""
        cluster, sums = clusters.of(self.items), self.items["sums"]
        within, size = cluster >= 0, len(clusters.names)
        columns = [np.bincount(cluster[within], column[within], minlength=size) for column in sums.T]
        return np.stack(columns, axis=1), sums[~within].sum(axis=0)

    def without_each(self, clusters: ClusterIndex) -> Float:
        """(K,) the difference without cluster k, the others scaled up to its weight. Items of no cluster stay."""
        by_cluster, sums_of_no_cluster = self._sums_by_cluster(clusters)
        sums = by_cluster.sum(axis=0) - by_cluster
        if sums_of_no_cluster.any():
            weights = clusters.count_objects(self.items)
            total = weights.sum()
            sums = sums * (total / np.where(weights < total, total - weights, total))[:, None] + sums_of_no_cluster
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = self.of(sums)
            difference: Float = first - second
        return difference

    def weights(self, clusters: ClusterIndex) -> Float:
        """(K,) the weight of each cluster in the figure's average; objects where some of it belongs to no cluster."""
        by_cluster, always = self._sums_by_cluster(clusters)
        weights: Float = clusters.count_objects(self.items) if always.any() else by_cluster[:, 2]
        return weights

    @property
    def bounds(self) -> tuple[float, float]:
        """−1 and 1 for a difference of shares."""
        return -self.most, self.most


@dataclass(frozen=True, kw_only=True)
class MedianStatistic(PairStatistic):
    """Medians of the items' `first` and `second`, which may be −∞, and the median of their pairwise differences."""

    @property
    def differences(self) -> Float:
        """(i,) first − second; 0 where both are −∞."""
        first, second = self.items["first"], self.items["second"]
        with np.errstate(invalid="ignore"):
            return np.where(first == second, 0.0, first - second)

    def values(self) -> tuple[float, float, float]:
        """Median of the first, of the second, and of the differences."""
        weight = self.items.weight
        first, second, difference = (
            _weighted_median(of, weight) for of in (self.items["first"], self.items["second"], self.differences)
        )
        return first, second, difference

    def without_each(self, clusters: ClusterIndex) -> Float:
        """(K,) medians of the differences without each cluster."""
        cluster, n = clusters.of(self.items), self.items.weight
        medians = [
            _weighted_median(self.differences[cluster != k], n[cluster != k]) for k in range(len(clusters.names))
        ]
        return np.array(medians)

    def limits(self, difference: float, clusters: ClusterIndex, confidence: float = CONFIDENCE) -> LimitedFigure:
        """Limits of the median: those of the share of differences at or below a value, inverted."""
        cluster, n = clusters.of(self.items), self.items.weight
        objects = None if clusters.over == "runs" else clusters.count_objects(self.items).sum()
        once = clusters.over == "logs" and "weight" in self.items.columns
        least, most = limit_ranked_quantile(
            self.differences, n, cluster, len(clusters.names), objects, confidence=confidence, once=once
        )
        if most - least <= _SAME:
            return LimitedFigure(difference, kind=ALL_ALIKE)
        return LimitedFigure(difference, least, most, INVERTED)


@dataclass(frozen=True, kw_only=True)
class TimeStatistic(PairStatistic):
    """Restricted means of times to detection; that of a side is the mean of its parts, weighted by `shares`.

    `shares`: of the drives by part, positive for the first side, negative for the second. Items: `time_s` and `ending`
    as for `cumulative_incidence`.
    """

    shares: tuple[float, ...]
    horizon_s: float

    def values(self) -> tuple[float, float, float]:
        """The restricted mean of the first, of the second, and their difference."""
        if not len(self.items["n"]):
            return math.nan, math.nan, math.nan
        sides = [0.0, 0.0]
        for share, part in zip(self.shares, self.parts, strict=True):
            steps = cumulative_incidence(part["time_s"], part["ending"], part.weight)
            sides[share < 0] += abs(share) * restricted_mean(*steps, self.horizon_s)
        return sides[0], sides[1], sides[0] - sides[1]

    def without_each(self, clusters: ClusterIndex) -> Float:
        """(K,) differences of the restricted means without each cluster."""
        K, sides = len(clusters.names), np.zeros((2, len(clusters.names)))
        for share, part in zip(self.shares, self.parts, strict=True):
            means = restricted_means_without(
                part["time_s"], part["ending"], part.weight, clusters.of(part), K, self.horizon_s
            )
            sides[int(share < 0)] += abs(share) * means
        difference: Float = sides[0] - sides[1]
        return difference

    @property
    def bounds(self) -> tuple[float, float]:
        """The greatest possible difference, from the earliest time to never, with either sign."""
        earliest = min((float(part["time_s"].min(initial=0.0)) for part in self.parts), default=0.0)
        return min(earliest, self.horizon_s) - self.horizon_s, self.horizon_s - min(earliest, self.horizon_s)

    @property
    def followed(self) -> float:
        """The share of pairs detected, departed or observed to the horizon, on the side where it is less."""
        known = [(of["ending"] != CENSORED) | (of["time_s"] >= self.horizon_s - _SAME) for of in self.parts]
        return min(float(of.weight[kept].sum() / of.weight.sum()) for of, kept in zip(self.parts, known, strict=True))


def _weighted_median(values: Float, weight: Float) -> float:
    if not len(values):
        return math.nan
    median = quantile_with_never(values, values > -np.inf, 0.5, weight)
    return -math.inf if median is None else median


_SAME = 1e-9
"""Differences this close are the same: far below what any of the metrics resolves."""


def find_decisive_log(figure: PairStatistic, difference: float, names: ClusterNames) -> tuple[str, float] | None:
    """The log without which the difference turns its sign or halves, and the difference then; None: no log.

    Of several the one that changes it most.
    """
    clusters = index_clusters(figure.items, "logs", names)
    if clusters is None or abs(difference) <= _SAME or clusters.grouped is not clusters:
        return None
    left = figure.without_each(clusters) * np.sign(difference)
    left = np.where(np.isnan(left), np.inf, left)
    k = int(np.argmin(left))
    return (clusters.names[k], float(left[k] * np.sign(difference))) if left[k] <= abs(difference) / 2 else None


def difference_limits(
    figure: PairStatistic, difference: float, over: str | None, names: ClusterNames, *, fixed: bool,
    confidence: float = CONFIDENCE,
) -> dict[str, object]:  # fmt: skip
    """The columns `low`, `high`, `low_bounded`, `high_bounded`, `interval`, `interval_over` and `clusters` of a
    difference, as far as they exist.

    `over`: the kind of cluster, None: none. `fixed`: the figure is equal in every run, on either side.
    """
    if over is None or not math.isfinite(difference):
        return {}
    if over == "runs" and fixed:
        return {"interval": NOTHING_DRAWN}
    clusters = index_clusters(figure.items, over, names)
    if clusters is None or not (figure.by_object or over not in ("objects", "passes")):
        return {}
    interval = figure.limits(difference, clusters, confidence)
    bounded = LimitedFigure(difference) if over == "runs" else figure.limit_by_bounds(difference, clusters, confidence)
    limits = {"low_bounded": bounded.low, "high_bounded": bounded.high} if bounded.kind else {}
    if interval.kind == ALL_ALIKE:
        return {"interval": interval.kind, **limits, **({"clusters": len(clusters.names)} if limits else {})}
    if not (math.isfinite(interval.low) or math.isfinite(interval.high)):
        return {}
    limits |= {"low": interval.low, "high": interval.high}
    return {name: limit if math.isfinite(limit) else None for name, limit in limits.items()} | {
        "interval": interval.kind,
        "interval_over": over,
        "clusters": len(clusters.names),
    }


# Stars of a table.

STAR, ALONE = "*", "°"
"""Marks of differences: one that stands in a whole table, and one whose own interval alone excludes 0."""
BETTER, WORSE, ALIKE, OPEN = "better", "worse", "alike", "open"
"""What a difference is in words, held against the least one that matters."""


def is_off_zero(limits: Mapping[str, Any]) -> bool:
    """Whether an interval with the columns of `difference_limits` excludes 0."""
    low, high = limits.get("low"), limits.get("high")
    return bool((low is not None and low > _SAME) or (high is not None and high < -_SAME))


def find_stars(number: int, limit: Sequence[Callable[[float], Mapping[str, object]]]) -> set[int]:
    """Which differences exclude 0 together: Holm's procedure by sets. `number`: how many differences a table has.

    `limit`: of each that may, its limits at a confidence. Those whose limits at 1 − .05/`number` exclude 0 are held;
    the rest is asked anew at 1 − .05 over as many as are left, until none is added: under no difference at all at most
    one table in twenty has any.

    Source: S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statist. 6 (1979) 65–70.
    """
    starred: set[int] = set()
    while len(starred) < number:
        level = 1.0 - (1.0 - CONFIDENCE) / (number - len(starred))
        added = {k for k, at in enumerate(limit) if k not in starred and is_off_zero(at(level))}
        if not added:
            break
        starred |= added
    return starred


def describe_difference(row: Mapping[str, Any], better: int, least: float) -> str:
    """The word of a row with its star: `alike` where its interval is within ± `least`, the least that matters."""
    if row.get("star") == STAR:
        return BETTER if row["difference"] * better > 0 else WORSE
    low, high = row.get("low"), row.get("high")
    return ALIKE if low is not None and high is not None and max(-low, high) <= least else OPEN
