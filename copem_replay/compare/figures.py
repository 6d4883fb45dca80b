"""Figures of pairs, made of items that can be summed over any clusters: of all logs, of one, of a resample."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from copem_replay.compare.intervals import Clusters, Counts, Whose
from copem_replay.paired import resampled_medians, resampled_sums
from copem_replay.statistics import quantile_with_never
from copem_replay.tracks import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class Figure(ABC):
    """A figure of two configurations from the same items (i,).

    `n (i,)`: how many pairs (rows, lists) each stands for. `only (i, 2)`: which of a row's two sides alone succeeded.
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


def _median(values: Float) -> float:
    if not len(values):
        return math.nan
    found = quantile_with_never(values, values > -np.inf, 0.5)
    return -math.inf if found is None else found
