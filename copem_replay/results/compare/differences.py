"""Figures of pairs, made of items that can be summed over any clusters: of all logs, of one, of a resample.

Those of a log are made of its rows; what is kept of it for all logs are `condensed` items.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from copem_replay.core.tracks import Bool, Float
from copem_replay.metrics.intervals import Counts
from copem_replay.metrics.survival import CENSORED, DETECTED, cumulative_incidence, quantile_with_never, restricted_mean
from copem_replay.results.compare.bootstrap import Items
from copem_replay.results.compare.paired_statistics import resampled_medians, resampled_sums

if TYPE_CHECKING:
    from copem_replay.results.compare.bootstrap import Clusters


@dataclass(frozen=True, kw_only=True)
class Figure(ABC):
    """A figure of two configurations. `only (i, 2)` among the items, of shares: which side of a pair alone succeeded.

    `by_object`: whether objects can be resampled, what an item counts being known for each.
    """

    parts: tuple[Items, ...]
    by_object: bool = True

    @property
    def items(self) -> Items:
        """Which pairs there are."""
        return self.parts[0]

    def condensed(self, *, runs: bool) -> Self:
        """The same of fewer items, to be joined. `runs`: those of several runs stay apart."""
        return replace(self, parts=tuple(part.condensed(runs=runs) for part in self.parts))

    @classmethod
    def joined(cls, logs: Sequence[Self]) -> Self:
        """The figure of several logs."""
        return replace(logs[0], parts=tuple(map(Items.joined, zip(*(log.parts for log in logs), strict=True))))

    @abstractmethod
    def values(self) -> tuple[float, float, float]:
        """Of the first, of the second, and their difference; NaN or infinite: there is none."""

    @abstractmethod
    def resampled(self, clusters: Clusters, count: Counts) -> Float:
        """(R,) differences when each cluster counts as in `count (R, K)`."""


@dataclass(frozen=True, kw_only=True)
class OfSums(Figure):
    """A function `of` sums (…, m), one of each side, to be subtracted: shares, means, their roots. Items: `sums`."""

    of: Callable[[Float], tuple[Float, Float]]

    def values(self) -> tuple[float, float, float]:
        """Of the first, of the second, and their difference."""
        with np.errstate(divide="ignore", invalid="ignore"):  # nothing to divide by: there is no figure
            first, second = self.of(self.items["sums"].sum(axis=0))
            return float(first), float(second), float(first - second)

    def resampled(self, clusters: Clusters, count: Counts) -> Float:
        """(R,) differences; items of no cluster count once in each resample."""
        of, sums = clusters.of(self.items), self.items["sums"]
        drawn, size = of >= 0, len(clusters.names)
        by_cluster = [np.bincount(of[drawn], column[drawn], minlength=size) for column in sums.T]
        fixed = sums[~drawn].sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = self.of(resampled_sums(np.stack(by_cluster, axis=1), count) + fixed)
            difference: Float = first - second
        return difference


@dataclass(frozen=True, kw_only=True)
class OfMedians(Figure):
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
            _median(of, weight) for of in (self.items["first"], self.items["second"], self.differences)
        )
        return first, second, difference

    def resampled(self, clusters: Clusters, count: Counts) -> Float:
        """(R,) medians of the differences."""
        return resampled_medians(self.differences, clusters.of(self.items), count, self.items["n"])


@dataclass(frozen=True, kw_only=True)
class OfTimes(Figure):
    """Restricted means of times to detection; those of a side are the mean of its parts, by their shares of the drives.

    `shares`: of the parts, those of the first side positive, of the second negative. Items: `time_s` and `ending` as
    `cumulative_incidence` has them.
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

    def resampled(self, clusters: Clusters, count: Counts) -> Float:
        """(R,) differences."""
        sides = np.zeros((2, len(count)))
        for share, part in zip(self.shares, self.parts, strict=True):
            sides[int(share < 0)] += abs(share) * self._means(part, clusters, count)
        difference: Float = sides[0] - sides[1]
        return difference

    def _means(self, part: Items, clusters: Clusters, count: Counts) -> Float:
        """(R,) restricted means: `cumulative_incidence` for all resamples at once.

        Its steps weigh by what the censored before them hand on. Times of censoring are few, those of objects: between
        two of them sums over clusters are enough.
        """
        time_s, ending, n, of = part["time_s"], part["ending"], part["n"], clusters.of(part)
        censored = ending == CENSORED
        lost_s = np.unique(time_s[censored])
        K, spans = len(clusters.names), len(lost_s) + 1
        span = np.searchsorted(lost_s, time_s, side="left")  # censored at the end of it, or all else within it

        def by_cluster(kept: Bool, weight: Float) -> Float:
            """(R, spans) sums of the resamples."""
            place = of[kept] * spans + span[kept]
            return count.astype(float) @ np.bincount(place, weight[kept], minlength=K * spans).reshape(K, spans)

        within = by_cluster(np.ones(len(n), dtype=bool), n)
        total = within.sum(axis=1)
        lost = by_cluster(censored, n)[:, :-1]
        remaining = total[:, None] - np.cumsum(within, axis=1)[:, :-1]
        there = remaining > 0  # whole numbers
        factors = np.where(there, 1.0 + lost / np.where(there, remaining, 1.0), 1.0)
        handed = np.concatenate([np.ones((len(count), 1)), np.cumprod(factors, axis=1)], axis=1)
        gained = by_cluster(ending == DETECTED, n * np.maximum(self.horizon_s - time_s, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            means: Float = self.horizon_s - (gained * handed).sum(axis=1) / total
        return means


def _median(values: Float, weight: Float) -> float:
    if not len(values):
        return math.nan
    found = quantile_with_never(values, values > -np.inf, 0.5, weight)
    return -math.inf if found is None else found
