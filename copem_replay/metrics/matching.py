"""Matches of fused entries with true objects, list by list, for every fusion without truth ids.

An entry *tells of* one instant: of its newest capture, or, where the fusion brings its entries to the present, of the
instant the list is available (`ListFusion.tells_of`). An object is *within the gate* of an entry when the entry may be
about it (`metrics/origin.py`), it is there at that instant, the horizontal distance of their centres is at most the
gate, and their classes agree (`AGREE` in `core/object_list.py`; of the entry the most probable one). In a gap of the
truth the object is absent; but where a clock states another instant than that of the capture, an object that was there
at the capture is there. Objects count measured or not, moving or not: an entry at one that a list holds is no ghost.

1. Every entry belongs to the nearest object within its gate. Of several at one object the *preferred* one is its
   match: the highest existence, the newest capture, the smallest variance stated (of both axes together), then by a
   number scattered from its place; never the one that happens to be closest, outermost, or first in an experiment.
2. Of the others, the preferred first, each becomes the match of the nearest object within its gate that has none yet:
   of two pedestrians side by side the entries of both may lie nearer to one of them. An entry at the very place of a
   preferred one is a copy of it: it becomes no match, and is about the object that the preferred one is about.
3. What is then left is a duplicate of its nearest object, or a ghost where there is none within the gate.

Entries of one list may tell of different instants; an object has one match in a list, whichever they are. The order of
the entries in a list does not matter. Definitions: docs/guide/metrics.md.

What a list is worth *now* is a second question, for which all entries are taken as if they told of the instant the list
is available: an entry about an object that has left since is then a false positive.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.compiled import borrowing, borrowing_kernel
from copem_replay.core.geometry import count_below
from copem_replay.core.object_list import Entries, ObjectLists, TellsOf, most_probable_class
from copem_replay.core.tracks import AGREE, SAME_INSTANT_S, Bool, Float, Int, Scene, Tracks
from copem_replay.metrics.origin import Origins, may_be_about

MATCH, DUPLICATE, GHOST = 0, 1, 2
"""Roles of entries."""

_TOLERANCE_M = 1e-9
"""An object at exactly the gate is within it, whatever the rounding of the distance."""


@dataclass(frozen=True)
class Matches:
    """The true object that each entry of `ObjectLists` is about. All (N,)."""

    object_ix: Int  # the object it is about, −1: none
    role: NDArray[np.int8]  # MATCH, DUPLICATE or GHOST
    x_m: Float  # where that object is at the instant asked for; means nothing where there is none
    y_m: Float
    class_ix: NDArray[np.int8]  # its own most probable class


def match_entries(
    lists: ObjectLists, world: Tracks, scene: Scene, origins: Origins, *, gate_m: float, tells_of: TellsOf = "now"
) -> Matches:
    """Match the entries of K lists in S runs with true objects, at the instants the entries tell of.

    `world`: the truth. Where entries tell of `now` its frame k is at the instant list k is available, where they tell
    of their `capture` frames are ascending, at all captures that these entries name, at least.
    """
    out = _allocate_matches(lists)
    rows = _sort_truth_rows(world, scene, by_frame=tells_of == "now")
    _match_lists(
        lists.start, lists.entries, origins, rows, rows, AGREE, gate_m + _TOLERANCE_M, out, out, _make_scratch(lists)
    )
    return Matches(*out)


def match_at_both_times(
    lists: ObjectLists, then: Tracks, now: Tracks, scene: Scene, origins: Origins, *, gate_m: float
) -> tuple[Matches, Matches]:
    """Matches of entries that tell of their `capture`, at the capture and as if they told of `now`.

    `then`, `now`: the truth, as `match_entries` takes it for `capture` and for `now`.
    """
    matches = _allocate_matches(lists)
    at_once = _allocate_matches(lists)._replace(class_ix=matches.class_ix)
    rows = _sort_truth_rows(then, scene, by_frame=False), _sort_truth_rows(now, scene, by_frame=True)
    scratch = _make_scratch(lists)
    _match_lists(lists.start, lists.entries, origins, *rows, AGREE, gate_m + _TOLERANCE_M, matches, at_once, scratch)
    return Matches(*matches), Matches(*at_once)


def _make_scratch(lists: ObjectLists) -> Int:
    # Two rows as long as the longest list.
    return np.empty((2, lists.longest), dtype=np.int64)


class _MatchColumns(NamedTuple):
    # The columns of `Matches`, to be filled.
    object_ix: Int
    role: NDArray[np.int8]
    x_m: Float
    y_m: Float
    class_ix: NDArray[np.int8]


def _allocate_matches(lists: ObjectLists) -> _MatchColumns:
    N = len(lists.entries)
    role = np.full(N, GHOST, dtype=np.int8)
    return _MatchColumns(np.full(N, -1), role, np.empty(N), np.empty(N), np.empty(N, dtype=np.int8))


class _TruthRows(NamedTuple):
    # The truth: frame f, at `frame_s[f]`, is rows `bounds[f] : bounds[f + 1]`, in each from west to east.
    by_frame: bool  # frame k goes with list k, whatever its entries tell of
    frame_s: Float
    bounds: Int
    object_ix: Int
    class_ix: NDArray[np.int8]
    x_m: Float
    y_m: Float
    match_of: Int  # by object its match in the list at hand, −1: none


def _sort_truth_rows(world: Tracks, scene: Scene, *, by_frame: bool) -> _TruthRows:
    _, bounds = world.by_frame
    order = world.west_to_east
    object_ix = world.row_object_ix[order]
    return _TruthRows(
        by_frame, world.captured_s, bounds, object_ix, scene.object_class[object_ix], world.x_m[0, order],
        world.y_m[0, order], np.full(int(object_ix.max(initial=-1)) + 1, -1),
    )  # fmt: skip


@borrowing
def most_probable_entry_class(entries: Entries, i: int) -> int:
    """The most probable class of entry i; of equally probable ones the first, `other` where nothing is said."""
    return most_probable_class(entries[i].class_probability)


@borrowing_kernel
def _match_lists(
    start: Int, entries: Entries, origins: Origins, rows: _TruthRows, now: _TruthRows, agree: Bool, gate_m: float,
    matches: _MatchColumns, at_once: _MatchColumns, scratch: Int,
) -> None:  # fmt: skip
    """Fills `matches`, and `at_once` with those against the truth `now`, when the list is available (if it is another).
    `agree (C, C)`: classes that may match; `scratch`: two rows, as long as the longest list.
    """
    frame, contested = scratch[0], scratch[1]
    has_second = rows.by_frame != now.by_frame
    for s in range(len(start)):
        for k in range(start.shape[1] - 1):
            first, n = start[s, k], start[s, k + 1] - start[s, k]
            for i in range(first, first + n):
                matches.class_ix[i] = most_probable_class(entries[i].class_probability)
            frame[:n] = k
            if not rows.by_frame:
                _find_frames(entries, first, rows.frame_s, frame[:n])
            _match_list(entries, origins, (s, k), first, frame[:n], contested, rows, agree, gate_m, matches)
            if not has_second:
                continue
            # At one instant the truths may differ: a clock that is fast tells of an object that has left.
            objects, late = now.bounds[k + 1] - now.bounds[k], False
            for f in frame[:n]:
                late |= f < 0 or rows.frame_s[f] != now.frame_s[k] or rows.bounds[f + 1] - rows.bounds[f] != objects
            if late:
                frame[:n] = k
                _match_list(entries, origins, (s, k), first, frame[:n], contested, now, agree, gate_m, at_once)
            else:
                for i in range(first, first + n):
                    at_once.object_ix[i], at_once.role[i] = matches.object_ix[i], matches.role[i]
                    at_once.x_m[i], at_once.y_m[i] = matches.x_m[i], matches.y_m[i]


@borrowing
def _find_frames(entries: Entries, first: int, frame_s: Float, out: Int) -> None:
    # Out: the frame at the capture of each entry of a list; −1: none.
    f, last = 0, len(frame_s) - 1
    for j in range(len(out)):
        captured_s = entries[first + j].captured_s
        if last >= 0 and frame_s[f] != captured_s:  # entries of one list were mostly captured together
            f = min(count_below(frame_s, captured_s), last)
            if f > 0 and captured_s - frame_s[f - 1] < frame_s[f] - captured_s:
                f -= 1
        out[j] = f if last >= 0 and abs(frame_s[f] - captured_s) <= SAME_INSTANT_S else -1


@borrowing
def _match_list(
    entries: Entries,
    origins: Origins,
    list_key: tuple[int, int],
    first: int,
    frame: Int,
    contested: Int,
    rows: _TruthRows,
    agree: Bool,
    gate_m: float,
    out: _MatchColumns,
) -> None:
    """Fills `out` for the entries of one list, from `first` on; `frame`: the truth's frame of each (−1: none)."""
    bounds, row_object_ix, row_class_ix = rows.bounds, rows.object_ix, rows.class_ix
    row_x_m, row_y_m = rows.x_m, rows.y_m
    object_ix, role, class_ix, match_of = out.object_ix, out.role, out.class_ix, rows.match_of
    n = 0
    for second_pass in range(2):
        # At first all entries, then those at an object whose match is another entry: most of these have no other
        # object near, and only those that have one are sorted.
        for j in range(len(frame)):
            i = first + j
            if second_pass and (role[i] != DUPLICATE or _are_at_one_place(entries, i, match_of[object_ix[i]])):
                continue
            p = -1
            if frame[j] >= 0:
                p = _find_nearest(
                    entries[i].x_m, entries[i].y_m, class_ix[i], bounds[frame[j]], bounds[frame[j] + 1], gate_m, agree,
                    row_object_ix, row_class_ix, row_x_m, row_y_m, match_of, second_pass == 1, origins, list_key, i,
                )  # fmt: skip
            if p < 0:
                continue
            if second_pass:
                contested[n] = i
                n += 1
                continue
            o = row_object_ix[p]
            object_ix[i], role[i], out.x_m[i], out.y_m[i] = o, DUPLICATE, row_x_m[p], row_y_m[p]
            if match_of[o] < 0 or _is_preferred(entries, i, match_of[o]):
                match_of[o] = i
    for i in range(first, first + len(frame)):
        if role[i] == DUPLICATE and match_of[object_ix[i]] == i:
            role[i] = MATCH
    _sort_by_preference(entries, contested, n)
    for j in range(n):
        i = contested[j]
        f = frame[i - first]
        p = _find_nearest(
            entries[i].x_m, entries[i].y_m, class_ix[i], bounds[f], bounds[f + 1], gate_m, agree,
            row_object_ix, row_class_ix, row_x_m, row_y_m, match_of, True, origins, list_key, i,
        )  # fmt: skip
        original = _find_original(entries, i, contested[:j])
        if original >= 0:
            if entries[original].captured_s == entries[i].captured_s and class_ix[original] == class_ix[i]:
                object_ix[i], out.x_m[i], out.y_m[i] = object_ix[original], out.x_m[original], out.y_m[original]
        elif p >= 0:
            o = row_object_ix[p]
            object_ix[i], role[i], out.x_m[i], out.y_m[i] = o, MATCH, row_x_m[p], row_y_m[p]
            match_of[o] = i
    for i in range(first, first + len(frame)):
        if role[i] == MATCH:
            match_of[object_ix[i]] = -1


@borrowing
def _find_nearest(
    x: float, y: float, entry_class_ix: int, first: int, high: int, gate_m: float, agree: Bool, object_ix: Int,
    class_ix: NDArray[np.int8], x_m: Float, y_m: Float, match_of: Int, only_free: bool, origins: Origins,
    list_key: tuple[int, int], i: int,
) -> int:  # fmt: skip
    """The row in first … high − 1 nearest to (x, y) within the gate (at a tie the western), of a class that agrees and
    an object that entry i of the list may be about; −1: none.
    """
    least_square, nearest_row, west_m = gate_m * gate_m, -1, x - gate_m
    rows_left = high - first
    while rows_left > 0:  # the first row that is not too far west; without branches, which cannot be predicted
        half = rows_left >> 1
        too_far = x_m[first + half] < west_m
        first = first + half + 1 if too_far else first
        rows_left = rows_left - half - 1 if too_far else half
    for p in range(first, high):
        if x_m[p] > x + gate_m:
            break
        if not agree[entry_class_ix, class_ix[p]] or (only_free and match_of[object_ix[p]] >= 0):
            continue
        square = (x_m[p] - x) ** 2 + (y_m[p] - y) ** 2
        nearer = square < least_square or (square == least_square and nearest_row < 0)
        if nearer and may_be_about(origins, list_key[0], list_key[1], i, object_ix[p]):
            least_square, nearest_row = square, p
    return nearest_row


@borrowing
def _is_preferred(entries: Entries, i: int, j: int) -> bool:
    """Whether entry i goes before j: higher existence, then newer, then more certain, then values that break ties."""
    a, b = entries[i], entries[j]
    if a.existence != b.existence:
        return bool(a.existence > b.existence)
    if a.captured_s != b.captured_s:
        return bool(a.captured_s > b.captured_s)
    variance_a, variance_b = a.cov_ee_m2 + a.cov_nn_m2, b.cov_ee_m2 + b.cov_nn_m2
    if variance_a != variance_b:
        return bool(variance_a < variance_b)
    scattered_a, scattered_b = _scatter(a.x_m, a.y_m), _scatter(b.x_m, b.y_m)
    if scattered_a != scattered_b:
        return bool(scattered_a < scattered_b)
    # At the very same place the rest decides, so that the order in the list never does.
    if a.track_id != b.track_id:
        return bool(a.track_id < b.track_id)
    class_a, class_b = most_probable_entry_class(entries, i), most_probable_entry_class(entries, j)
    return bool(class_a < class_b or (class_a == class_b and a.unit_ix < b.unit_ix))


@borrowing
def _scatter(x: float, y: float) -> float:
    # A number in [0, 1) of a place that tells nothing of where it is: of several entries of one object the western one
    # errs most.
    number = x * 7919.7182818 + y * 104729.3141593
    return float(number - np.floor(number))


@borrowing
def _are_at_one_place(entries: Entries, i: int, j: int) -> bool:
    return bool(entries[i].x_m == entries[j].x_m and entries[i].y_m == entries[j].y_m)


@borrowing
def _find_original(entries: Entries, i: int, preferred: Int) -> int:
    # The most preferred entry at the very place of entry i; −1: none.
    for j in preferred:
        if _are_at_one_place(entries, i, j):
            return int(j)
    return -1


@borrowing
def _sort_by_preference(entries: Entries, rows: Int, n: int) -> None:
    """Sorts the first n `rows` in place, preferred entries first: Shell's sort with the gaps of Knuth, (3ʰ − 1) / 2."""
    gap = 1
    while gap < n:
        gap = 3 * gap + 1
    while gap > 0:
        for place in range(gap, n):
            i, hole = rows[place], place
            while hole >= gap and _is_preferred(entries, i, rows[hole - gap]):
                rows[hole] = rows[hole - gap]
                hole -= gap
            rows[hole] = i
        gap //= 3
