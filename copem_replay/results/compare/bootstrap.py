"""Intervals of differences: which clusters are resampled whole, and with which draws.

The clusters are those of `summary.csv`, resampled alike: logs, if there are at least five; else measured
objects, if there are at least five; runs, where there is one object in one log. With fewer there is no interval: more
runs do not tell about other traffic, and few of anything do not tell how it varies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Bool, Int
from copem_replay.metrics.intervals import FEWEST_CLUSTERS, Resamples, resamples
from copem_replay.results.compare.pairing import Grid

_KEPT = 4
"""Sets of clusters whose draws are kept (chosen: few differ, and each may be large)."""


@dataclass(frozen=True)
class Whose:
    """What items (i,) are of: a log, an object (−1: of none in particular), a run (−1: of all)."""

    log_ix: Int
    object_ix: Int
    run: Int

    def take(self, kept: Bool) -> Whose:
        """Some of them."""
        return Whose(self.log_ix[kept], self.object_ix[kept], self.run[kept])


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
    """`names` of K clusters, sorted, and which one each item is of (i,), −1: of none, it always counts once."""

    over: str
    names: tuple[str, ...]
    of: Int


def resampled_over(rows: Whose) -> str:
    """What is resampled of a pair, going by all rows that both have: the same for all its metrics."""
    things, logs = np.unique(rows.object_ix), np.unique(rows.log_ix)
    if len(things) == 1 and len(logs) == 1:
        return "runs"
    return "logs" if len(logs) >= FEWEST_CLUSTERS else "objects"


def clusters(whose: Whose, over: str, grid: Grid) -> Clusters | None:
    """The logs, objects or runs of items that are resampled; None: too few of them have the figure."""
    if over == "runs":
        found = _named(over, whose.run, [str(run) for run in range(grid.runs)])
    elif over == "logs":
        found = _named(over, whose.log_ix, grid.logs)
    else:
        found = _named(over, whose.object_ix, grid.objects)
    return found if len(found.names) >= FEWEST_CLUSTERS else None


def _named(over: str, of: Int, names: Sequence[str]) -> Clusters:
    """Clusters in the order of their names, as `summary.csv` has them."""
    there = sorted({int(k) for k in np.unique(of[of >= 0])}, key=lambda k: names[k])
    number = np.full(len(names) + 1, -1, dtype=np.int64)
    number[there] = np.arange(len(there))
    return Clusters(over, tuple(names[k] for k in there), number[of])
