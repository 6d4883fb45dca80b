"""Time chunks of the receiver's instants: a long recording is fused one after the other, and gives the lists of one go.

Lists of units are numbered through the whole recording, so list f is the same in every time chunk; but only
those that a time chunk needs have their entries in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from copem_replay.communication.arrivals import FusionSchedule
from copem_replay.core.object_list import Inputs, ObjectLists, entries_of
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int


def needed_lists(captured_s: Float, at: FusionSchedule | Inputs, first: int, after: int, looks_back_s: float) -> Bool:
    """(F,) which lists have to have their entries at the instants `first` … `after` − 1, F lists `captured_s`.

    The units' newest, those that arrive, and, where `ListFusion.looks_back_s` is not 0, of those that have arrived
    before what was captured up to so long before the newest of them.
    """
    needed: Bool = np.zeros(len(captured_s), dtype=bool)
    if first == after:
        return needed
    newest = at.newest[first:after]
    needed[newest[newest >= 0]] = True
    begin, end = at.arrived_start[first], at.arrived_start[after]
    needed[at.arrived[begin:end]] = True
    before = at.arrived[:begin]
    if looks_back_s > 0 and len(before):
        # Twice: a fusion that looks back has a tolerance of its own.
        oldest_s = captured_s[before].max() - looks_back_s - 2 * SAME_INSTANT_NS * 1e-9
        needed[before[captured_s[before] >= oldest_s]] = True
    return needed


def chunk(inputs: Inputs, first: int, after: int, looks_back_s: float) -> Inputs:
    """The instants `first` … `after` − 1 by themselves, with the entries of the lists they need only."""
    needed = needed_lists(inputs.captured_s, inputs, first, after, looks_back_s)
    start, entries = inputs.lists.start, inputs.lists.entries
    lengths = np.where(needed, np.diff(start), 0)
    kept = np.repeat(np.tile(needed, len(start)), np.diff(start).ravel())
    begin = inputs.arrived_start[first]
    return replace(
        inputs,
        lists=ObjectLists(_start(lengths), entries[kept]),
        issue_s=inputs.issue_s[first:after],
        newest=inputs.newest[first:after],
        arrived=inputs.arrived[begin : inputs.arrived_start[after]],
        arrived_start=inputs.arrived_start[first : after + 1] - begin,
    )


def one_after_another(chunks: Sequence[ObjectLists]) -> ObjectLists:
    """The lists of all time chunks, at least one, of the same runs."""
    parts = [one.entries[one.start[s, 0] : one.start[s, -1]] for s in range(len(chunks[0].start)) for one in chunks]
    lengths = np.concatenate([np.diff(one.start) for one in chunks], axis=1)
    return ObjectLists(_start(lengths), np.concatenate([entries_of(0), *parts]))


def _start(lengths: Int) -> Int:
    """(S, K + 1) where lists of so many entries (S, K) begin."""
    ends = np.cumsum(lengths).reshape(lengths.shape)
    totals = lengths.sum(axis=1)
    return np.concatenate([(np.cumsum(totals) - totals)[:, None], ends], axis=1)
