"""The union of all lists as a fusion: the baseline that other fusions have to beat; and lists of runs put together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from copem_replay.core.compiled import kernel
from copem_replay.core.components import Share
from copem_replay.core.object_list import Entries, Inputs, ObjectLists, join_entries, take_entries
from copem_replay.core.tracks import Bool, Int
from copem_replay.fusion.interface import ListFusion

_APART, _LARGEST = np.int64(-7046029254386353131), np.int64(2**63 - 1)
"""Ids of unit u are xored with u times the first, in 63 bits: so those of different units lie far apart."""


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
        """All entries of the newest lists of each run; track ids are changed so that they differ between units."""
        runs = []
        for bounds in inputs.lists.start:
            entries = inputs.lists.entries[bounds[0] : bounds[-1]]
            start, rows = gather_newest_rows(
                bounds - bounds[0], inputs.newest, entries["existence"] >= self.min_existence
            )
            runs.append((start, take_entries(entries, rows)))
        fused = join_runs(runs, len(inputs.issue_s))
        fused.entries["track_id"] = _renumber_track_ids(fused)
        return fused


def _renumber_track_ids(lists: ObjectLists) -> Int:
    """(N,) track ids that differ between units, unchanged for the first unit; −1 where a list has an id twice."""
    ids, unit_ix = lists.entries["track_id"], lists.entries["unit_ix"]
    track_id: Int = np.where(ids < 0, -1, ids ^ (unit_ix * _APART & _LARGEST))
    starts = np.append(lists.start[:, :-1].ravel(), lists.start[-1:, -1])
    list_ix = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    order = np.lexsort((track_id, list_ix))
    again = (np.diff(track_id[order]) == 0) & (np.diff(list_ix[order]) == 0)
    track_id[order[1:][again]] = track_id[order[:-1][again]] = -1
    return track_id


def join_runs(runs: Sequence[tuple[Int, Entries]], instants: int) -> ObjectLists:
    """Lists of all runs from those of each: `start (K + 1,)`, from 0 on, and entries."""
    start = np.zeros((len(runs), instants + 1), dtype=np.int64)
    total = 0
    for s, (begin, _) in enumerate(runs):
        start[s] = total + begin
        total += int(begin[-1])
    return ObjectLists(start, join_entries([entries for _, entries in runs]))


@kernel
def gather_newest_rows(bounds: Int, newest: Int, counts: Bool) -> tuple[Int, Int]:
    """(K + 1,) where the rows of each instant begin, and (R,) the rows of its newest lists that count.

    `bounds (F + 1,)` of the lists, `newest (K, U)`, `counts (N,)`.
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
