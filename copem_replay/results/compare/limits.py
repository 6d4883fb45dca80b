"""Figures of pairs and the limits of their differences: by leaving out clusters, exact, or none and why.

*Pair*: the same row (log, object, run) in two configurations, with common random numbers.
*Difference*: the first minus the second, pair by pair, or of two figures of the same pairs.
*Discordant*: a pair that succeeded in one only. McNemar's test asks whether as many do so in the one as in the other.
*Cluster*: dependent pairs, such as all of one log. It is left out on both sides of a pair together, so that what both
have in common cancels, as it does in the difference.
*Median*: the smallest value that at least half of the weight is at or below: the value of some pair.

Clusters are those of `summary.csv` (`metrics/intervals.py`), and have the weight of what the figure averages: as many
objects as have it; lists in GOSPA, minutes in ghosts per minute, runs where there is one object.

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
from copem_replay.metrics.intervals import (
    ALL_ALIKE,
    CONFIDENCE,
    EXACT,
    FEWEST_CLUSTERS,
    FEWEST_LOGS,
    INVERTED,
    JACKKNIFE,
    MOST_GROUPS,
    NOTHING_DRAWN,
    alike_limits,
    group_clusters,
    limit_figure,
    limit_ranked_quantile,
)
from copem_replay.metrics.survival import (
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
    """The items of a figure, by columns (i, …): `logs`, `objects` (−1: none in particular), `runs` (−1: all).

    These count in the lists of `ClusterNames`. `n`: number of pairs (rows, lists) that an item stands for.
    """

    columns: Mapping[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def condensed(self, *, runs: bool) -> StatisticItems:
        """The items with equal ones joined. `runs`: items of several runs stay apart."""
        columns = {**self.columns, "runs": self["runs"] if runs else np.full_like(self["runs"], -1)}
        group = np.zeros(len(self["n"]), dtype=np.int64)
        for name in columns.keys() - {*_SUMMED}:
            number, known = pd.factorize(columns[name])
            group = pd.factorize(group * max(len(known), 1) + number)[0]
        first = np.unique(group, return_index=True)[1]  # groups are numbered by their first items
        return StatisticItems(
            {name: _sum_groups(of, group) if name in _SUMMED else of[first] for name, of in columns.items()}
        )

    @staticmethod
    def joined(parts: Sequence[StatisticItems]) -> StatisticItems:
        """The items of several logs together."""
        return StatisticItems({name: np.concatenate([part[name] for part in parts]) for name in parts[0].columns})


def _sum_groups(values: NDArray[Any], group: Int) -> NDArray[Any]:
    """(g, …) sums of values (i, …) of each group."""
    sums = [np.bincount(group, column) for column in np.atleast_2d(values.T)]
    return np.stack(sums, axis=-1).reshape(len(sums[0]), *values.shape[1:]).astype(values.dtype)


@dataclass(frozen=True)
class ClusterNames:
    """The names that logs, objects and runs of items count in."""

    logs: Sequence[str]
    objects: list[str]  # log and id, separated by a line feed
    runs: int


@dataclass(frozen=True)
class ClusterIndex:
    """K clusters: sorted `names`, and the `number` of each log, object or run among them (−1: in none, always there).

    Clusters are logs, objects or runs (`over`), or groups of neighbours where there are many.
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
        """(K,) objects with items in each cluster; runs where clusters are runs."""
        cluster, by = self.of(items), "objects" if self.over != "runs" else "runs"
        counted = (cluster >= 0) & (items[by] >= 0)
        pairs = np.unique(np.stack([cluster[counted], items[by][counted]]), axis=1)
        return np.bincount(pairs[0], minlength=len(self.names)).astype(float)


def index_clusters(items: StatisticItems, over: str, names: ClusterNames) -> ClusterIndex | None:
    """The logs, objects or runs with items, in the order of their names; None: too few have the figure."""
    all_names = {"logs": names.logs, "objects": names.objects, "runs": [str(run) for run in range(names.runs)]}[over]
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

    `by_object`: whether the items are known by object, so that objects can be clusters. `share`: whether the figure is
    a share of the items, which then have `only`.
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

    @abstractmethod
    def values(self) -> tuple[float, float, float]:
        """The figure of the first, of the second, and their difference; NaN or infinite: there is none."""

    @abstractmethod
    def without_each(self, clusters: ClusterIndex) -> Float:
        """(K,) differences without the items of each cluster."""

    def weights(self, clusters: ClusterIndex) -> Float:
        """(K,) how much of what the figure averages each cluster has: objects with items, or runs of one."""
        return clusters.count_objects(self.items)

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the most that the difference can be."""
        return -math.inf, math.inf

    def limits(
        self, difference: float, clusters: ClusterIndex, confidence: float = CONFIDENCE
    ) -> tuple[str, float, float]:
        """The kind of the limits, and both; NaN: without some cluster there is no difference, and so no limits."""
        of = clusters.grouped
        without, weights = self.without_each(of), self.weights(of)
        if not np.isfinite(without).all():
            return JACKKNIFE, math.nan, math.nan
        if np.abs(without - difference).max() > _SAME:
            low, high = limit_figure(difference, without, weights, self.bounds, confidence)
            return JACKKNIFE, float(low), float(high)
        if not self.share:
            return ALL_ALIKE, math.nan, math.nan
        return EXACT, *alike_limits(difference, self.weights(clusters), confidence)


@dataclass(frozen=True, kw_only=True)
class SumStatistic(PairStatistic):
    """A function `of` sums (…, m) that gives the figure of either side: shares, means, their roots. Items: `sums`.

    `weighed_by`: the sum that the figure averages over, where it is no number of objects.
    """

    of: Callable[[Float], tuple[Float, Float]]
    weighed_by: int | None = None

    def values(self) -> tuple[float, float, float]:
        """Of the first, of the second, and their difference."""
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
        """(K,) differences. Items of no cluster stay, and the other clusters count for the one that is left out."""
        by_cluster, always = self._sums_by_cluster(clusters)
        rest = by_cluster.sum(axis=0) - by_cluster
        if always.any():
            weights = clusters.count_objects(self.items)
            total = weights.sum()
            rest = rest * (total / np.where(weights < total, total - weights, total))[:, None] + always
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = self.of(rest)
            difference: Float = first - second
        return difference

    def weights(self, clusters: ClusterIndex) -> Float:
        """(K,) the sum `weighed_by` of each cluster; objects where there is none, or where it is not by cluster."""
        by_cluster, always = self._sums_by_cluster(clusters)
        if self.weighed_by is None or always.any():
            return clusters.count_objects(self.items)
        weights: Float = by_cluster[:, self.weighed_by]
        return weights

    @property
    def bounds(self) -> tuple[float, float]:
        """−1 and 1 for a difference of shares."""
        return (-1.0, 1.0) if self.share else super().bounds


@dataclass(frozen=True, kw_only=True)
class MedianStatistic(PairStatistic):
    """Medians of the items' `first` and `second`, that may be −∞, and the median of their differences, pair by pair."""

    @property
    def differences(self) -> Float:
        """(i,) first − second; 0 where both are −∞."""
        first, second = self.items["first"], self.items["second"]
        with np.errstate(invalid="ignore"):
            return np.where(first == second, 0.0, first - second)

    def values(self) -> tuple[float, float, float]:
        """Median of the first, of the second, and of the differences."""
        weight = self.items["n"].astype(float)
        first, second, difference = (
            _weighted_median(of, weight) for of in (self.items["first"], self.items["second"], self.differences)
        )
        return first, second, difference

    def without_each(self, clusters: ClusterIndex) -> Float:
        """(K,) medians of the differences."""
        cluster, n = clusters.of(self.items), self.items["n"].astype(float)
        medians = [
            _weighted_median(self.differences[cluster != k], n[cluster != k]) for k in range(len(clusters.names))
        ]
        return np.array(medians)

    def limits(
        self, difference: float, clusters: ClusterIndex, confidence: float = CONFIDENCE
    ) -> tuple[str, float, float]:
        """Limits of the share of differences at or below a value, inverted."""
        cluster, n = clusters.of(self.items), self.items["n"].astype(float)
        objects = None if clusters.over == "runs" else clusters.count_objects(self.items).sum()
        least, most = limit_ranked_quantile(
            self.differences, n, cluster, len(clusters.names), objects, confidence=confidence
        )
        return (ALL_ALIKE, math.nan, math.nan) if most - least <= _SAME else (INVERTED, least, most)


@dataclass(frozen=True, kw_only=True)
class TimeStatistic(PairStatistic):
    """Restricted means of times to detection; that of a side is the mean of its parts, weighted by `shares`.

    `shares`: of the drives by part, positive for the first side, negative for the second. Items: `time_s` and `ending`
    as for `cumulative_incidence`.
    """

    shares: tuple[float, ...]
    horizon_s: float

    def values(self) -> tuple[float, float, float]:
        """Of the first, of the second, and their difference."""
        if not len(self.items["n"]):
            return math.nan, math.nan, math.nan
        sides = [0.0, 0.0]
        for share, part in zip(self.shares, self.parts, strict=True):
            steps = cumulative_incidence(part["time_s"], part["ending"], part["n"].astype(float))
            sides[share < 0] += abs(share) * restricted_mean(*steps, self.horizon_s)
        return sides[0], sides[1], sides[0] - sides[1]

    def without_each(self, clusters: ClusterIndex) -> Float:
        """(K,) differences."""
        K, sides = len(clusters.names), np.zeros((2, len(clusters.names)))
        for share, part in zip(self.shares, self.parts, strict=True):
            n = part["n"].astype(float)
            means = restricted_means_without(
                part["time_s"], part["ending"], n, clusters.of(part), K, self.horizon_s
            )  # fmt: skip
            sides[int(share < 0)] += abs(share) * means
        difference: Float = sides[0] - sides[1]
        return difference

    @property
    def bounds(self) -> tuple[float, float]:
        """As far apart as never is from the earliest time."""
        earliest = min((float(part["time_s"].min(initial=0.0)) for part in self.parts), default=0.0)
        return min(earliest, self.horizon_s) - self.horizon_s, self.horizon_s - min(earliest, self.horizon_s)


def _weighted_median(values: Float, weight: Float) -> float:
    if not len(values):
        return math.nan
    median = quantile_with_never(values, values > -np.inf, 0.5, weight)
    return -math.inf if median is None else median


_SAME = 1e-9
"""Differences this close are the same: far below what any of the metrics resolves."""


def find_decisive_log(figure: PairStatistic, difference: float, names: ClusterNames) -> tuple[str, float] | None:
    """The log without which the difference turns its sign or is at most half, and the difference then; None: no log.

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
    figure: PairStatistic,
    difference: float,
    over: str | None,
    names: ClusterNames,
    *,
    fixed: bool,
    confidence: float = CONFIDENCE,
) -> dict[str, object]:
    """The columns `low`, `high`, `interval`, `interval_over` and `clusters` of a difference, as far as they exist.

    `over`: the kind of cluster, None: none. `fixed`: the figure is equal in every run, on either side.
    """
    if over is None or not math.isfinite(difference):
        return {}
    if over == "runs" and fixed:
        return {"interval": NOTHING_DRAWN}
    clusters = index_clusters(figure.items, over, names)
    if clusters is None or not (figure.by_object or over != "objects"):
        return {}
    kind, low, high = figure.limits(difference, clusters, confidence)
    if kind == ALL_ALIKE:
        return {"interval": kind}
    if not (math.isfinite(low) or math.isfinite(high)):
        return {}
    limits = {"low": low, "high": high}
    return {name: limit if math.isfinite(limit) else None for name, limit in limits.items()} | {
        "interval": kind,
        "interval_over": over,
        "clusters": len(clusters.names),
    }
