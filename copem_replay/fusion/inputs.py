"""The input of fusions without truth ids: the lists of the units in each run, made from tracks with truth ids.

Nothing in the lists tells which entries are of one object: the order within each list is drawn. The receiver's own body
is left out, since it knows where it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from copem_replay.communication.arrivals import FusionSchedule, KeptEntries, fusion_schedule
from copem_replay.core.compiled import callee, kernel
from copem_replay.core.object_list import COVARIANCES, ENTRY, Inputs, ObjectLists, join_entries, take_entries
from copem_replay.core.tracks import CLASSES, VALUES, Bool, Float, Int, Tracks
from copem_replay.fusion.ideal import floor_covariances
from copem_replay.perception.perceive import EntryClaims


def make_entry_lists(
    tracks: Tracks, claims: EntryClaims, drawn: Float, *, without_object_ix: int
) -> tuple[ObjectLists, Int]:
    """The lists of the runs (S,) with their rows (P,) as entries, in the order of `drawn (S, P)`; their rows (N,)."""
    columns = {name: getattr(tracks, name) for name in VALUES}
    columns |= zip(COVARIANCES, floor_covariances(tracks), strict=True)
    start, entry_rows = _list_rows(tracks, drawn, without_object_ix=without_object_ix)
    rows = np.zeros(len(tracks.frame_ix), dtype=ENTRY)
    for name, values in columns.items():  # those that the runs share
        if len(values) == 1:
            rows[name] = values[0]
    rows["existence"], rows["class_probability"], rows["track_id"] = claims
    rows["captured_s"], rows["unit_ix"] = tracks.entry_captured_s, tracks.row_unit_ix
    entries = take_entries(rows, entry_rows)
    run = np.repeat(np.arange(len(start)), start[:, -1] - start[:, 0])
    for name, values in columns.items():
        if len(values) > 1:
            entries[name] = values[run, entry_rows]
    return ObjectLists(start, entries), entry_rows


def _list_rows(received: Tracks, drawn: Float, *, without_object_ix: int) -> tuple[Int, Int]:
    """(S, F + 1) where each list begins, and (N,) the row of each entry, in the order of `drawn (S, P)`."""
    valid = received.valid if without_object_ix < 0 else received.valid & (received.row_object_ix != without_object_ix)
    order, bounds = received.by_frame
    start = np.zeros((len(valid), len(bounds)), dtype=np.int64)
    picked = np.empty(int(valid.sum()), dtype=np.int64)
    _pick_rows(valid, drawn, order, bounds, start, picked)
    return start, picked


def make_inputs(
    received: Tracks,
    lists: ObjectLists,
    *,
    max_age_s: float,
    instants: FusionSchedule | None = None,
    captured_s: Float | None = None,
) -> Inputs:
    """The input of a fusion: lists with the instants at which the receiver of a configuration has and uses each.

    `instants`: some of its instants; None: all. `captured_s (F,)`: the captures that fusion is told; None: the true
    ones.
    """
    instants = instants or fusion_schedule(received, max_age_s=max_age_s)
    captured_s = received.captured_s if captured_s is None else captured_s
    return Inputs(
        received.units, received.frame_unit_ix, captured_s, received.common_arrives_s, lists,
        instants.issue_s, instants.newest, instants.arrived, instants.arrived_start,
    )  # fmt: skip


def add_kept_entries(inputs: Inputs, cached: KeptEntries, partial: Bool, max_age_s: float) -> Inputs:
    """The input in one run, plus the entries that the receiver caches of units with partial messages, for `max_age_s`.

    `partial (U,)`: those units.
    """
    lists, frame = inputs.lists, cached.frame
    start = np.concatenate([lists.start[0], lists.start[0, -1] + cached.start[1:]])[None]
    return replace(
        inputs,
        unit_ix=np.append(inputs.unit_ix, inputs.unit_ix[frame]),
        captured_s=np.append(inputs.captured_s, inputs.captured_s[frame]),
        arrives_s=np.append(inputs.arrives_s, inputs.arrives_s[frame]),
        lists=ObjectLists(start, join_entries([lists.entries, take_entries(lists.entries, cached.entry)])),
        newest=cached.newest,
        keeps_s=np.where(partial, max_age_s, 0.0),
    )


@kernel
def _pick_rows(valid: Bool, drawn: Float, order: Int, bounds: Int, start: Int, entry_rows: Int) -> None:
    """Fill `start (S, F + 1)` and `entry_rows (N,)` with the valid rows, list by list, ordered by `drawn`."""
    n = 0
    for s in range(valid.shape[0]):
        start[s, 0] = n
        for f in range(len(bounds) - 1):
            first = n
            for k in range(bounds[f], bounds[f + 1]):
                p = order[k]
                if not valid[s, p]:
                    continue
                place = n  # insertion by the number drawn
                while place > first and drawn[s, entry_rows[place - 1]] > drawn[s, p]:
                    entry_rows[place] = entry_rows[place - 1]
                    place -= 1
                entry_rows[place] = p
                n += 1
            start[s, f + 1] = n


# An order of entries by their content alone: neither the order they came in nor their units matter.

WIDTH = 13 + len(CLASSES)
"""So many numbers of an entry, from the first on, describe the object; the rest are times and ids."""
assert list(ENTRY.names or ())[13:15] == ["class_probability", "captured_s"]
_BLOCK = 16
"""Rows in a block that is sorted by insertion, before blocks are merged. It changes the time alone."""


@kernel
def order_by_content(start: Int, content: Float) -> Int:
    """Indices of the entries (N,), list by list, in order of their content, place first."""
    rows = np.arange(start[-1])
    for f in range(len(start) - 1):
        sort_rows(content, rows[start[f] : start[f + 1]])
    return rows


@kernel
def sort_rows(values: Float, order: Int) -> None:
    """Sort `order`, indices of rows of `values (N, V)`, by the first column, then the second …; in place, stably."""
    n = len(order)
    # The first column nearly always decides: it is kept at hand.
    key, other_key, other = np.empty(n), np.empty(n), np.empty(n, np.int64)
    for p in range(n):
        x, r, place = values[order[p], 0], order[p], p
        while place % _BLOCK > 0 and (
            x < key[place - 1] or (x == key[place - 1] and compare_rows(values, r, order[place - 1]) < 0)
        ):
            key[place], order[place] = key[place - 1], order[place - 1]
            place -= 1
        key[place], order[place] = x, r
    block = _BLOCK
    while block < n:
        for left in range(0, n, 2 * block):
            middle, right = min(left + block, n), min(left + 2 * block, n)
            i, j = left, middle
            for p in range(left, right):
                later = j < right and i < middle
                if later:
                    later = key[j] < key[i] or (key[j] == key[i] and compare_rows(values, order[j], order[i]) < 0)
                if later or i == middle:
                    other_key[p], other[p] = key[j], order[j]
                    j += 1
                else:
                    other_key[p], other[p] = key[i], order[i]
                    i += 1
        for p in range(n):
            key[p], order[p] = other_key[p], other[p]
        block *= 2


@callee
def compare_rows(values: Float, a: int, b: int) -> int:
    """−1, 0 or 1: row a comes before row b, equals it, or comes after it."""
    for v in range(values.shape[1]):
        if values[a, v] != values[b, v]:
            return -1 if values[a, v] < values[b, v] else 1
    return 0
