"""Intervals of differences: which clusters are resampled whole, and with which draws.

The clusters are those of `summary.csv`, resampled alike: logs, if there are at least five; else measured objects, if
there are at least five; runs, where there is one object in one log. With fewer there is no interval: more runs of the
same traffic do not narrow it, and few clusters do not show how they vary.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from copem_replay.core.tracks import Int
from copem_replay.metrics.intervals import FEWEST_CLUSTERS, Resamples, resamples

_KEPT = 4
"""Sets of clusters whose draws are kept (chosen: few differ, and each may be large)."""


_SUMMED = ("n", "only", "sums")
"""Columns of items that are summed when they become one; the others are then alike."""


@dataclass(frozen=True)
class Items:
    """What a figure is made of, by columns (i, …): `logs`, `objects` (−1: of none in particular), `runs` (−1: of all).

    These are numbers of what there are `Names` of. `n`: how many pairs (rows, lists) an item stands for.
    """

    columns: Mapping[str, NDArray[Any]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def condensed(self, *, runs: bool) -> Items:
        """Fewer items that say the same: equal ones are one. `runs`: those of several stay apart."""
        columns = {**self.columns, "runs": self["runs"] if runs else np.full_like(self["runs"], -1)}
        group = np.zeros(len(self["n"]), dtype=np.int64)
        for name in columns.keys() - {*_SUMMED}:
            number, known = pd.factorize(columns[name])
            group = pd.factorize(group * max(len(known), 1) + number)[0]
        first = np.unique(group, return_index=True)[1]  # groups are numbered by their first items
        return Items({name: _summed(of, group) if name in _SUMMED else of[first] for name, of in columns.items()})

    @staticmethod
    def joined(parts: Sequence[Items]) -> Items:
        """Items of several logs."""
        return Items({name: np.concatenate([part[name] for part in parts]) for name in parts[0].columns})


def _summed(values: NDArray[Any], group: Int) -> NDArray[Any]:
    """(g, …) sums of values (i, …) of each group."""
    sums = [np.bincount(group, column) for column in np.atleast_2d(values.T)]
    return np.stack(sums, axis=-1).reshape(len(sums[0]), *values.shape[1:]).astype(values.dtype)


@dataclass(frozen=True)
class Names:
    """What the numbers of items are of."""

    logs: Sequence[str]
    objects: list[str]  # log and id, apart by a line feed
    runs: int


class Draws:
    """Resamples of clusters, addressed by their names: the same clusters are drawn alike for every metric."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._kept: dict[tuple[str, ...], Resamples] = {}

    def of(self, names: tuple[str, ...]) -> Resamples:
        """How often each cluster is in each resample."""
        if names not in self._kept:
            while len(self._kept) >= _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[names] = resamples(names, self._seed)
        return self._kept[names]


@dataclass(frozen=True)
class Clusters:
    """`names` of K clusters, sorted, and the number of each log, object or run among them (−1: none, counts once)."""

    over: str
    names: tuple[str, ...]
    number: Int  # the last: of −1

    def of(self, items: Items) -> Int:
        """(i,) the cluster of each item, −1: of none."""
        found: Int = self.number[items[self.over]]
        return found


def resampled_over(objects: Sequence[int]) -> str:
    """What is resampled of a pair, alike for all its metrics. `objects`: of how many each log has rows."""
    if sum(objects) == 1:
        return "runs"
    return "logs" if sum(count > 0 for count in objects) >= FEWEST_CLUSTERS else "objects"


def clusters(items: Items, over: str, names: Names) -> Clusters | None:
    """The logs, objects or runs that are resampled; None: too few of them have the figure.

    In the order of their names, as `summary.csv` has them.
    """
    called = {"logs": names.logs, "objects": names.objects, "runs": [str(run) for run in range(names.runs)]}[over]
    there = sorted(np.unique(items[over][items[over] >= 0]).tolist(), key=lambda k: called[k])
    if len(there) < FEWEST_CLUSTERS:
        return None
    number = np.full(len(called) + 1, -1, dtype=np.int64)
    number[there] = np.arange(len(there))
    return Clusters(over, tuple(called[k] for k in there), number)
