"""Figures of pairs, made of items that can be summed over any clusters: of all logs, of one, of a resample."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.intervals import Counts
from copem_replay.metrics.survival import CENSORED, DETECTED, cumulative_incidence, quantile_with_never, restricted_mean
from copem_replay.results.compare.paired_statistics import resampled_medians, resampled_sums

if TYPE_CHECKING:
    from copem_replay.results.compare.bootstrap import Clusters, Whose


@dataclass(frozen=True, kw_only=True)
class Figure(ABC):
    """A figure of two configurations from the same items (i,).

    `n (i,)`: how many pairs (rows, lists) each stands for. `only (i, 2)`, of shares: which of a row's two sides alone
    succeeded.
    `by_object`: whether objects can be resampled, what an item counts being known for each.
    """

    whose: Whose
    n: Int
    only: Int | None = None
    by_object: bool = True

    def take(self, kept: Bool) -> Self:
        """The same figure of some items."""
        only = None if self.only is None else self.only[kept]
        return replace(self, whose=self.whose.take(kept), n=self.n[kept], only=only)

    @abstractmethod
    def values(self) -> tuple[float, float, float]:
        """Of the first, of the second, and their difference; NaN or infinite: there is none."""

    @abstractmethod
    def resampled(self, clusters: Clusters, count: Counts) -> Float:
        """(R,) differences when each cluster counts as in `count (R, K)`."""


@dataclass(frozen=True, kw_only=True)
class OfSums(Figure):
    """A function `of` sums (…, m), one of each side, to be subtracted: shares, means, their roots."""

    sums: Float  # (i, m)
    of: Callable[[Float], tuple[Float, Float]]

    def take(self, kept: Bool) -> Self:
        """The same figure of some items."""
        return replace(super().take(kept), sums=self.sums[kept])

    def values(self) -> tuple[float, float, float]:
        """Of the first, of the second, and their difference."""
        with np.errstate(divide="ignore", invalid="ignore"):  # nothing to divide by: there is no figure
            first, second = self.of(self.sums.sum(axis=0))
            return float(first), float(second), float(first - second)

    def resampled(self, clusters: Clusters, count: Counts) -> Float:
        """(R,) differences; items of no cluster count once in each resample."""
        drawn, columns = clusters.of >= 0, range(self.sums.shape[1])
        size = len(clusters.names)
        by_cluster = [np.bincount(clusters.of[drawn], self.sums[drawn, k], minlength=size) for k in columns]
        fixed = self.sums[~drawn].sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = self.of(resampled_sums(np.stack(by_cluster, axis=1), count) + fixed)
            difference: Float = first - second
        return difference


@dataclass(frozen=True, kw_only=True)
class OfMedians(Figure):
    """Medians of values (i,) that may be −∞, and the median of their differences, pair by pair."""

    first: Float
    second: Float

    def take(self, kept: Bool) -> Self:
        """The same figure of some items."""
        return replace(super().take(kept), first=self.first[kept], second=self.second[kept])

    @property
    def differences(self) -> Float:
        """(i,) first − second; 0 where both are −∞."""
        with np.errstate(invalid="ignore"):
            return np.where(self.first == self.second, 0.0, self.first - self.second)

    def values(self) -> tuple[float, float, float]:
        """Median of the first, of the second, and of the differences."""
        return _median(self.first), _median(self.second), _median(self.differences)

    def resampled(self, clusters: Clusters, count: Counts) -> Float:
        """(R,) medians of the differences."""
        return resampled_medians(self.differences, clusters.of, count)


@dataclass(frozen=True)
class Times:
    """Times (i,) and how each ended, as `statistics.cumulative_incidence` has them, in a share of the drives."""

    share: float
    time_s: Float
    ending: Int


@dataclass(frozen=True, kw_only=True)
class OfTimes(Figure):
    """Restricted means of times to detection; those of a side are the mean of its parts, by their shares."""

    first: tuple[Times, ...]
    second: tuple[Times, ...]
    horizon_s: float

    def take(self, kept: Bool) -> Self:
        """The same figure of some items."""
        first, second = (
            tuple(Times(part.share, part.time_s[kept], part.ending[kept]) for part in side)
            for side in (self.first, self.second)
        )
        return replace(super().take(kept), first=first, second=second)

    def values(self) -> tuple[float, float, float]:
        """Of the first, of the second, and their difference."""
        if not len(self.n):
            return math.nan, math.nan, math.nan
        first, second = (
            sum(
                part.share * restricted_mean(*cumulative_incidence(part.time_s, part.ending), self.horizon_s)
                for part in side
            )
            for side in (self.first, self.second)
        )
        return first, second, first - second

    def resampled(self, clusters: Clusters, count: Counts) -> Float:
        """(R,) differences."""
        first, second = (
            sum((part.share * self._means(part, clusters, count) for part in side), np.zeros(len(count)))
            for side in (self.first, self.second)
        )
        difference: Float = first - second
        return difference

    def _means(self, part: Times, clusters: Clusters, count: Counts) -> Float:
        """(R,) restricted means: `cumulative_incidence` for all resamples at once.

        Its steps weigh by what the censored before them hand on. Times at which somebody is censored are few, those of
        objects: between two of them sums over clusters are enough.
        """
        censored = part.ending == CENSORED
        lost_s = np.unique(part.time_s[censored])
        K, spans = len(clusters.names), len(lost_s) + 1
        span = np.searchsorted(lost_s, part.time_s, side="left")  # censored at the end of it, or all else within it

        def by_cluster(kept: Bool, weight: Float) -> Float:
            """(R, spans) sums of the resamples."""
            place = clusters.of[kept] * spans + span[kept]
            return count.astype(float) @ np.bincount(place, weight[kept], minlength=K * spans).reshape(K, spans)

        ones = np.ones(len(part.time_s))
        within = by_cluster(np.ones(len(ones), dtype=bool), ones)
        total = within.sum(axis=1)
        lost = by_cluster(censored, ones)[:, :-1]
        remaining = total[:, None] - np.cumsum(within, axis=1)[:, :-1]
        there = remaining > 0  # whole numbers
        factors = np.where(there, 1.0 + lost / np.where(there, remaining, 1.0), 1.0)
        handed = np.concatenate([np.ones((len(count), 1)), np.cumprod(factors, axis=1)], axis=1)
        gained = by_cluster(part.ending == DETECTED, np.maximum(self.horizon_s - part.time_s, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            means: Float = self.horizon_s - (gained * handed).sum(axis=1) / total
        return means


def _median(values: Float) -> float:
    if not len(values):
        return math.nan
    found = quantile_with_never(values, values > -np.inf, 0.5)
    return -math.inf if found is None else found
