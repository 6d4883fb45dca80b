"""The union of all lists: what fusion has to beat."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numba as nb
import numpy as np

from copem_replay.core.components import Share
from copem_replay.core.object_list import Entries, Inputs, ObjectLists, joined, taken
from copem_replay.core.tracks import Bool, Int
from copem_replay.fusion.base import ListFusion

_APART, _LARGEST = np.int64(-7046029254386353131), np.int64(2**63 - 1)
"""Numbers of units times the first lie far apart among those of 63 bits."""


class Union(ListFusion):
    """All entries of every unit's newest list side by side, unchanged.

    Entries with an existence below `min_existence` are left out. No source: it is cooperative perception without any
    fusion. It assumes nothing, so an object listed by n units is there n times, n − 1 times as a duplicate, and every
    ghost stays. Tracks of different units get different ids; those of the first unit keep theirs.
    """

    kind: Literal["union"] = "union"
    min_existence: Share = 0.0

    resumable: ClassVar[bool] = True

    def fuse(self, inputs: Inputs) -> ObjectLists:
        """Every run by itself."""
        runs = []
        for bounds in inputs.lists.start:
            entries = inputs.lists.entries[bounds[0] : bounds[-1]]
            start, rows = side_by_side(bounds - bounds[0], inputs.newest, entries["existence"] >= self.min_existence)
            runs.append((start, taken(entries, rows)))
        fused = run_after_run(runs, len(inputs.issue_s))
        fused.entries["track_id"] = _track_ids(fused)
        return fused


def _track_ids(lists: ObjectLists) -> Int:
    """(N,) the ids that units keep, of each unit others: the first's as they are. −1 where a list has one twice."""
    ids, unit_ix = lists.entries["track_id"], lists.entries["unit_ix"]
    told: Int = np.where(ids < 0, -1, ids ^ (unit_ix * _APART & _LARGEST))
    starts = np.append(lists.start[:, :-1].ravel(), lists.start[-1:, -1])
    list_ix = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    order = np.lexsort((told, list_ix))
    again = (np.diff(told[order]) == 0) & (np.diff(list_ix[order]) == 0)
    told[order[1:][again]] = told[order[:-1][again]] = -1
    return told


def run_after_run(runs: Sequence[tuple[Int, Entries]], instants: int) -> ObjectLists:
    """Lists of all runs from each run's, `start (K + 1,)` beginning at 0, and entries."""
    start = np.zeros((len(runs), instants + 1), dtype=np.int64)
    total = 0
    for s, (one, _) in enumerate(runs):
        start[s] = total + one
        total += int(one[-1])
    return ObjectLists(start, joined([entries for _, entries in runs]))


@nb.njit(cache=True, nogil=True)
def side_by_side(bounds: Int, newest: Int, counts: Bool) -> tuple[Int, Int]:
    """Rows of the entries that count of all newest lists at each instant, (R,), and where each instant's begin.

    `bounds (F + 1,)` of the lists, `newest (K, U)`, `counts (N,)`; `start (K + 1,)`.
    """
    start = np.zeros(len(newest) + 1, np.int64)
    for k in range(len(newest)):
        start[k + 1] = start[k]
        for f in newest[k]:
            if f >= 0:
                start[k + 1] += np.sum(counts[bounds[f] : bounds[f + 1]])
    rows = np.empty(start[-1], np.int64)
    n = 0
    for k in range(len(newest)):
        for f in newest[k]:
            if f >= 0:
                for r in range(bounds[f], bounds[f + 1]):
                    if counts[r]:
                        rows[n] = r
                        n += 1
    return start, rows
