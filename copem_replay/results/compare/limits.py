"""Figures of pairs and the limits of their differences: over resamples, exact, or none and why.

*Pair*: the same row (log, object, run) in two configurations, with common random numbers.
*Difference*: the first minus the second, pair by pair, or of two figures of the same pairs.
*Discordant*: a pair that succeeded in one only. McNemar's test asks whether as many do so in the one as in the other.
*Cluster*: dependent pairs, such as all of one log. A *resample* draws as many clusters as there are, with replacement,
both sides of a pair together, so that what both have in common cancels, as it does in the difference.
*Median*: the smallest value that at least half of the weight is at or below: the value of some pair.

Clusters are those of `summary.csv`: logs, if there are at least five; else measured objects, if there are at least
five; runs, where there is one object in one log. With fewer there is no interval: more runs of the same traffic do not
narrow it, and few clusters do not show how they vary.

Letters of the shapes: i items, K clusters, R resamples, m sums.
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

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.intervals import (
    FEWEST_CLUSTERS,
    NOTHING_DRAWN,
    Counts,
    Resamples,
    alike_limits,
    draw_resamples,
    effective_number,
    percentile_limits,
)
from copem_replay.metrics.survival import CENSORED, DETECTED, cumulative_incidence, quantile_with_never, restricted_mean

# Items of figures, and the clusters that are resampled.

_KEPT = 4
"""Sets of clusters whose resamples are kept: few sets differ, and each may be large; changes no result."""
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


class ClusterDraws:
    """Resamples of clusters, addressed by their names: the same clusters are drawn alike for every metric."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._kept: dict[tuple[str, ...], Resamples] = {}

    def of(self, names: tuple[str, ...]) -> Resamples:
        """The resamples of the named clusters."""
        if names not in self._kept:
            while len(self._kept) >= _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[names] = draw_resamples(names, self._seed)
        return self._kept[names]


@dataclass(frozen=True)
class ClusterIndex:
    """K clusters: sorted `names`, and the `number` of each log, object or run among them (−1: none, counts once)."""

    over: str
    names: tuple[str, ...]
    number: Int  # its last element is for −1

    def of(self, items: StatisticItems) -> Int:
        """(i,) the cluster of each item, −1: none."""
        cluster: Int = self.number[items[self.over]]
        return cluster


def choose_resampled(objects: Sequence[int]) -> str:
    """The kind of cluster that is resampled for all metrics of a pair. `objects`: number with rows in each log."""
    if sum(objects) == 1:
        return "runs"
    return "logs" if sum(count > 0 for count in objects) >= FEWEST_CLUSTERS else "objects"


def index_clusters(items: StatisticItems, over: str, names: ClusterNames) -> ClusterIndex | None:
    """The logs, objects or runs that are resampled, in the order of their names; None: too few have the figure."""
    all_names = {"logs": names.logs, "objects": names.objects, "runs": [str(run) for run in range(names.runs)]}[over]
    present = sorted(np.unique(items[over][items[over] >= 0]).tolist(), key=lambda k: all_names[k])
    if len(present) < FEWEST_CLUSTERS:
        return None
    number = np.full(len(all_names) + 1, -1, dtype=np.int64)
    number[present] = np.arange(len(present))
    return ClusterIndex(over, tuple(all_names[k] for k in present), number)


# Statistics of pairs. A ValueError for shapes or values is a defect of the caller.

_CELLS = 4_000_000
"""Numbers held at a time, 32 MB: the size of blocks, which changes no result."""


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


def resample_sums(sums: Float, count: NDArray[np.unsignedinteger[Any]]) -> Float:
    """(R, m) sums of each resample: `sums (K, m)` of the clusters, drawn `count (R, K)` times.

    Equal columns give equal sums, to the last bit. Raises ValueError for other shapes.
    """
    _check_clusters(count, len(sums))
    # Each distinct column once: a product of matrices may round equal columns differently.
    first = [next(j for j in range(k + 1) if np.array_equal(sums[:, j], sums[:, k])) for k in range(sums.shape[1])]
    distinct = sorted(set(first))
    columns = np.ascontiguousarray(sums[:, distinct], dtype=float)
    result = np.empty((len(count), len(distinct)))
    size = max(1, _CELLS // max(len(sums), 1))
    for r in range(0, len(count), size):
        result[r : r + size] = count[r : r + size].astype(float) @ columns
    sums_of_all: Float = result[:, [distinct.index(k) for k in first]]
    return sums_of_all


def resample_medians(values: Float, cluster: Int, count: NDArray[np.unsignedinteger[Any]], n: Int) -> Float:
    """(R,) median of each resample: `values (i,)`, `n (i,)` times each, those of `cluster (i,)` drawn
    `count (R, K)` times.

    Values may be infinite; NaN where a resample has no value. Raises ValueError for NaN, or other shapes.
    """
    if values.shape != cluster.shape or np.isnan(values).any():
        raise ValueError("resampled_medians: expected numbers, each of a cluster")
    R, K = count.shape
    _check_clusters(count, K if not len(cluster) else max(K, int(cluster.max()) + 1))
    if not len(values):
        return np.full(R, np.nan)
    order = np.argsort(values, kind="stable")
    ranked, ranked_cluster, times = values[order], cluster[order], n[order]
    # In two steps: the block, of about √i blocks of neighbours, with the median, then the place in the block. All
    # counts are whole numbers, which floats hold exactly.
    items = len(values)
    length = max(1, math.isqrt(items))
    blocks = -(-items // length)
    in_block = np.bincount(ranked_cluster * blocks + np.arange(items) // length, times, minlength=K * blocks).reshape(
        K, blocks
    )
    until = np.empty((R, blocks))
    size = max(1, _CELLS // K)
    for r in range(0, R, size):
        until[r : r + size] = np.cumsum(count[r : r + size].astype(float) @ in_block, axis=1)
    total = until[:, -1]
    block = np.argmax(2 * until >= total[:, None], axis=1)
    before = np.where(block > 0, until[np.arange(R), np.maximum(block - 1, 0)], 0.0)
    place = block[:, None] * length + np.arange(length)
    exists = place < items
    place = np.minimum(place, items - 1)
    weight = np.where(exists, count[np.arange(R)[:, None], ranked_cluster[place]] * times[place], 0)
    reached = 2 * (before[:, None] + np.cumsum(weight, axis=1)) >= total[:, None]
    median = ranked[place[np.arange(R), np.argmax(reached, axis=1)]]
    return np.where(total > 0, median, np.nan)


def _check_clusters(count: NDArray[Any], clusters: int) -> None:
    if count.ndim != 2 or count.shape[1] != clusters:
        raise ValueError(f"expected counts of {clusters} clusters, found {count.shape}")


# Figures of pairs, computed from items that can be summed over any clusters: of all logs, of one, of a resample.


@dataclass(frozen=True, kw_only=True)
class PairStatistic(ABC):
    """A figure of two configurations. Items of shares have `only (i, 2)`: whether only the first, or second, succeeded.

    `by_object`: whether the items are known by object, so that objects can be resampled.
    """

    parts: tuple[StatisticItems, ...]
    by_object: bool = True

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
    def resampled(self, clusters: ClusterIndex, count: Counts) -> Float:
        """(R,) differences when each cluster counts as in `count (R, K)`."""


@dataclass(frozen=True, kw_only=True)
class SumStatistic(PairStatistic):
    """A function `of` sums (…, m) that gives the figure of either side: shares, means, their roots. Items: `sums`."""

    of: Callable[[Float], tuple[Float, Float]]

    def values(self) -> tuple[float, float, float]:
        """Of the first, of the second, and their difference."""
        with np.errstate(divide="ignore", invalid="ignore"):  # division by 0: there is no figure
            first, second = self.of(self.items["sums"].sum(axis=0))
            return float(first), float(second), float(first - second)

    def resampled(self, clusters: ClusterIndex, count: Counts) -> Float:
        """(R,) differences; items of no cluster count once in each resample."""
        cluster, sums = clusters.of(self.items), self.items["sums"]
        drawn, size = cluster >= 0, len(clusters.names)
        by_cluster = [np.bincount(cluster[drawn], column[drawn], minlength=size) for column in sums.T]
        fixed = sums[~drawn].sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = self.of(resample_sums(np.stack(by_cluster, axis=1), count) + fixed)
            difference: Float = first - second
        return difference


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

    def resampled(self, clusters: ClusterIndex, count: Counts) -> Float:
        """(R,) medians of the differences."""
        return resample_medians(self.differences, clusters.of(self.items), count, self.items["n"])


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

    def resampled(self, clusters: ClusterIndex, count: Counts) -> Float:
        """(R,) differences."""
        sides = np.zeros((2, len(count)))
        for share, part in zip(self.shares, self.parts, strict=True):
            sides[int(share < 0)] += abs(share) * self._means(part, clusters, count)
        difference: Float = sides[0] - sides[1]
        return difference

    def _means(self, part: StatisticItems, clusters: ClusterIndex, count: Counts) -> Float:
        """(R,) restricted means: `cumulative_incidence` for all resamples at once.

        A step is weighted by what the earlier censored rows hand on. Times of censoring are few, one or less per
        object: between two of them sums over clusters are enough.
        """
        time_s, ending, n, cluster = part["time_s"], part["ending"], part["n"], clusters.of(part)
        censored = ending == CENSORED
        lost_s = np.unique(time_s[censored])
        K, spans = len(clusters.names), len(lost_s) + 1
        span = np.searchsorted(lost_s, time_s, side="left")  # censored at the end of it, or all else within it

        def by_cluster(kept: Bool, weight: Float) -> Float:
            """(R, spans) sums of the resamples."""
            place = cluster[kept] * spans + span[kept]
            return count.astype(float) @ np.bincount(place, weight[kept], minlength=K * spans).reshape(K, spans)

        within = by_cluster(np.ones(len(n), dtype=bool), n)
        total = within.sum(axis=1)
        lost = by_cluster(censored, n)[:, :-1]
        remaining = total[:, None] - np.cumsum(within, axis=1)[:, :-1]
        remains = remaining > 0  # whole numbers
        factors = np.where(remains, 1.0 + lost / np.where(remains, remaining, 1.0), 1.0)
        handed = np.concatenate([np.ones((len(count), 1)), np.cumprod(factors, axis=1)], axis=1)
        gained = by_cluster(ending == DETECTED, n * np.maximum(self.horizon_s - time_s, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            means: Float = self.horizon_s - (gained * handed).sum(axis=1) / total
        return means


def _weighted_median(values: Float, weight: Float) -> float:
    if not len(values):
        return math.nan
    median = quantile_with_never(values, values > -np.inf, 0.5, weight)
    return -math.inf if median is None else median


ALL_ALIKE = "all clusters alike"
"""The kind of an interval that does not exist as the difference is the same in every cluster, so all resamples are
equal.

For a median it is enough that it is the same in nearly all.
"""
_SAME = 1e-9
"""Differences this close are the same: far below what any of the metrics resolves."""


def difference_limits(
    figure: PairStatistic, difference: float, over: str, names: ClusterNames, draws: ClusterDraws, *, fixed: bool
) -> dict[str, object]:
    """The columns `low`, `high`, `interval` and `interval_over` of a difference, as far as they exist.

    `over`: the kind of cluster that is resampled. `fixed`: the figure is equal in every run, on either side.
    """
    if not math.isfinite(difference):
        return {}
    if over == "runs" and fixed:
        return {"interval": NOTHING_DRAWN}
    drawn = index_clusters(figure.items, over, names)
    if drawn is None or not (figure.by_object or over != "objects"):
        return {}
    resampled = draws.of(drawn.names)
    low, high = percentile_limits(figure.resampled(drawn, resampled.count), resampled)
    kind = "bootstrap"
    if abs(high - low) <= _SAME:
        if "only" not in figure.items.columns:
            return {"interval": ALL_ALIKE}
        cluster = drawn.of(figure.items)
        rows = np.bincount(cluster[cluster >= 0], figure.items["n"][cluster >= 0], minlength=len(drawn.names))
        kind, (low, high) = "exact", alike_limits(difference, effective_number(rows))
    limits = {"low": low, "high": high}
    return {name: limit if math.isfinite(limit) else None for name, limit in limits.items()} | {
        "interval": kind,
        "interval_over": over,
    }
