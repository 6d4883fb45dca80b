"""Presence: which units there are in the runs of a block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Bool, Int
from copem_replay.pipeline.expansion import ExpandedExperiment


@dataclass(frozen=True)
class Presence:
    """Which of U units list anything, run by run: `listing (S | 1, U)`; and which send lists: `sending (U,)`.

    A unit that is only in some runs of a block sends empty lists in the others. That serves where only the entries of
    lists count. Where the lists themselves count, too, all runs of a block have the same units: see `parts`.
    """

    listing: Bool
    sending: Bool

    @classmethod
    def same(cls, there: Bool) -> Presence:
        """The same units `there (U,)` in every run."""
        return cls(there[None], there)

    @classmethod
    def of(cls, expanded: ExpandedExperiment, log: str, runs: Int) -> Presence:
        """Each of the runs (S,) with its own units."""
        equipped = expanded.equipped(log, runs)
        there = np.ones(len(expanded.named), dtype=bool)
        return cls.same(there) if equipped is None else cls(equipped, there)

    def parts(self, runs: Int) -> Iterator[tuple[Int, Presence]]:
        """The runs (S,) in parts whose runs have the same units."""
        if len(self.listing) != len(runs):  # one row stands for all
            yield runs, self
            return
        patterns, which = np.unique(self.listing, axis=0, return_inverse=True)
        for k, there in enumerate(patterns):
            yield runs[which == k], Presence.same(there)
