"""Strips of points, one for each row: those of nearly one distance side by side, as wide as there are many of them.

Counts are of a tally, so that points find their places log by log, and of very many only some are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Bool, Float, Int

KINDS = FAIL, NEUTRAL, PASS = "fails", "not in conflict", "passes"
"""In the order in which they lie across a strip."""
MOST = 1000
"""Points of a bin that are drawn, at most (chosen: they cover their part of the strip ten times over)."""


@dataclass(frozen=True)
class Strip:
    """A configuration's points: how many there are by distance, in bins of `width_m`, and kind, `count (bins, 3)`.

    `judged`: whether they are told apart by kind. `never`, `lost`: rows without the event, and without a distance.
    """

    width_m: float
    count: Int
    judged: bool = True
    never: int = 0
    lost: int = 0

    @classmethod
    def of(cls, tally: pd.DataFrame, width_m: float, *, judged: bool) -> Strip:
        """Of the rows of a tally of one event and configuration."""
        distance_m, runs = (tally[name].to_numpy() for name in ("distance_at_detection_m", "runs"))
        known, placed = tally["time_to_detection_s"].notna().to_numpy(), ~np.isnan(distance_m)
        cell = _cells(distance_m[placed], width_m)
        count = np.zeros((int(cell.max(initial=0)) + 1, len(KINDS)), dtype=np.int64)
        np.add.at(count, cell, counts(tally if judged else tally[["runs"]])[placed])
        return cls(width_m, count, judged, int(runs[~known].sum()), int(runs[known & ~placed].sum()))

    def place(self, distance_m: Float, kind: Int, before: Int) -> tuple[Float, Bool]:
        """Where across the strip points (n,) lie, −1 … 1: those of a bin evenly. And which are drawn.

        `kind (n,)`: as of KINDS. `before`, as `count`: how many have their places already; these are added.
        """
        cell = _cells(distance_m, self.width_m)
        ranked = np.lexsort((kind, cell))
        new = np.diff(len(KINDS) * cell[ranked] + kind[ranked], prepend=-1) != 0
        first = np.maximum.accumulate(np.where(new, np.arange(len(cell)), 0))
        place = np.empty(len(cell), dtype=np.int64)
        place[ranked] = np.arange(len(cell)) - first
        place += (np.cumsum(self.count, axis=1) - self.count + before)[cell, kind]
        np.add.at(before, (cell, kind), 1)
        many = self.count.sum(axis=1)
        across: Float = (2 * (place + 0.5) / many[cell] - 1) * many[cell] / max(many.max(), 1)
        drawn: Bool = place * np.minimum(many[cell], MOST) % many[cell] < MOST
        return across, drawn


def counts(tally: pd.DataFrame) -> Int:
    """(n, 3) how many rows of each kind, as of KINDS, those of a tally stand for."""
    runs = tally["runs"].to_numpy()
    if "in_conflict" not in tally:
        return np.stack([0 * runs, runs, 0 * runs], axis=1)
    conflict, passed = tally["in_conflict"].to_numpy(dtype=bool), tally["passed"].to_numpy()
    parts = conflict * (runs - passed), ~conflict * runs, conflict * passed
    return np.stack(parts, axis=1)


def kinds(rows: pd.DataFrame) -> Int:
    """(n,) the kind of each row of `detections.parquet`, as of KINDS."""
    conflict, passed = (rows[name].fillna(False).to_numpy(dtype=bool) for name in ("conflict", "braking_pass"))
    return np.where(conflict, np.where(passed, KINDS.index(PASS), KINDS.index(FAIL)), KINDS.index(NEUTRAL))


def _cells(distance_m: Float, width_m: float) -> Int:
    return np.floor(distance_m / width_m + 0.5).astype(np.int64)
