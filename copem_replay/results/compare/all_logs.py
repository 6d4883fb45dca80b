"""What is kept of a pair while its logs are gone through one by one: no row, but what rows add up to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from copem_replay.core.tracks import Int
from copem_replay.results.compare.configuration_data import ConfigurationData
from copem_replay.results.compare.metrics import Regret
from copem_replay.results.compare.pairing import Grid
from copem_replay.results.compare.per_list import shared_instants


@dataclass
class AllLogs:
    """Of both sides, by log: `objects` they have rows of, `alone` (2,) rows that one side has, `instants` (3,)."""

    objects: list[int] = field(default_factory=list)
    alone: list[tuple[int, int]] = field(default_factory=list)
    instants: list[Int] = field(default_factory=list)
    _found: dict[str, list[Regret]] = field(default_factory=dict)

    def add(
        self, first: ConfigurationData, second: ConfigurationData, found: Sequence[Regret], grid: Grid, *, more: bool
    ) -> None:
        """One more log, of which this was `found`. `more`: there are others."""
        both = np.flatnonzero(first.there & second.there)
        objects = len(np.unique(both // grid.runs))
        self.objects.append(objects)
        self.alone.append((int((first.there & ~second.there).sum()), int((second.there & ~first.there).sum())))
        if first.accuracy is not None and second.accuracy is not None:
            self.instants.append(shared_instants(first.accuracy, second.accuracy))
        for of in found:
            # Of one object runs are resampled, if there is no other in any log.
            figure = of.figure.condensed(runs=objects <= 1) if more else of.figure
            self._found.setdefault(of.metric, []).append(replace(of, figure=figure))

    def regrets(self) -> Iterator[Regret]:
        """Every metric over all logs."""
        for of_logs in self._found.values():
            figures = [of.figure for of in of_logs]
            yield replace(of_logs[0], figure=type(figures[0]).joined(figures))
