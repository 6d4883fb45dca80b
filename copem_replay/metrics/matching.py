"""Which true object is each entry of a fused list about? List by list, for every fusion that goes without truth ids.

An object is *within the gate* of an entry when it is there at the list's instant, the horizontal distance of their
centres is at most the gate, and their classes agree (`core/agree.py`; of the entry the most probable one). All true
objects of the instant count, measured or not, moving or not, the ego too: an entry at one of them is no ghost.

1. Every entry belongs to the nearest object within its gate. Of several at one object the *preferred* one is its
   match: the highest existence, then the first unit's (last where it is not said), then the smaller x, the smaller y;
   never the one that happens to be closest.
2. Of the others, the preferred first, each becomes the match of the nearest object within its gate that has none yet:
   of two pedestrians side by side the entries of both may lie nearer to one of them.
3. What is then left is a duplicate of its nearest object, or a ghost where there is none within the gate.

The order of the entries in a list does not matter. Source: the contract, "What the words mean".
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from copem_replay.core.agree import AGREE
from copem_replay.core.agree import most_probable as most_probable_class
from copem_replay.core.object_list import Entries, Lists
from copem_replay.core.tracks import Bool, Float, Int, Scene, Tracks

MATCH, DUPLICATE, GHOST = 0, 1, 2
"""Roles of entries."""

_TOLERANCE_M = 1e-9


@dataclass(frozen=True)
class Matches:
    """What each entry of Lists is. Both (N,)."""

    object_ix: Int  # the object it is about, −1: none
    role: NDArray[np.int8]  # MATCH, DUPLICATE or GHOST


def match(lists: Lists, world: Tracks, scene: Scene, *, gate_m: float) -> Matches:
    """Objects and roles of the entries of K lists in S runs. `world`: the truth, frame k at the instant of list k."""
    out = Matches(np.full(len(lists.entries), -1), np.full(len(lists.entries), GHOST, dtype=np.int8))
    _, bounds = world.by_frame
    # List by list, and in each from west to east; at one place the first object first.
    order = np.lexsort((world.row_object_ix, world.x_m[0], world.frame_ix))
    object_ix = world.row_object_ix[order]
    _match(
        lists.start, lists.entries, bounds, object_ix, scene.object_class[object_ix], world.x_m[0, order],
        world.y_m[0, order], AGREE, gate_m + _TOLERANCE_M, out.object_ix, out.role,
    )  # fmt: skip
    return out


@nb.njit(cache=True, nogil=True)
def most_probable(entries: Entries, i: int) -> int:
    """The most probable class of entry i; of equally probable ones the first, `other` where nothing is said."""
    return most_probable_class(entries[i].class_probability)


@nb.njit(cache=True, nogil=True)
def _match(
    start: Int, entries: Entries, bounds: Int, object_ix: Int, class_ix: NDArray[np.int8], x_m: Float, y_m: Float,
    agree: Bool, gate_m: float, out_object_ix: Int, out_role: NDArray[np.int8],
) -> None:  # fmt: skip
    match_of = np.full(len(object_ix), -1)  # by row of the truth: its match in the list at hand
    longest = 0
    for s in range(len(start)):
        for k in range(len(bounds) - 1):
            longest = max(longest, start[s, k + 1] - start[s, k])
    others = np.empty(longest, np.int64)
    for k in range(len(bounds) - 1):
        low, high = bounds[k], bounds[k + 1]
        for s in range(len(start)):
            match_of[low:high] = -1
            for i in range(start[s, k], start[s, k + 1]):
                fits = agree[most_probable(entries, i)]
                p = _nearest(entries, i, gate_m, fits, low, high, class_ix, x_m, y_m, match_of, False)
                if p >= 0:
                    out_object_ix[i], out_role[i] = object_ix[p], DUPLICATE
                    if match_of[p] < 0 or _preferred(entries, i, match_of[p]):
                        match_of[p] = i
            for p in range(low, high):
                if match_of[p] >= 0:
                    out_role[match_of[p]] = MATCH
            # Most duplicates have no other object near: only those that have are put in order.
            n = 0
            for i in range(start[s, k], start[s, k + 1]):
                if out_role[i] == DUPLICATE:
                    fits = agree[most_probable(entries, i)]
                    if _nearest(entries, i, gate_m, fits, low, high, class_ix, x_m, y_m, match_of, True) >= 0:
                        others[n] = i
                        n += 1
            _in_order_of_preference(entries, others, n)
            for i in others[:n]:
                fits = agree[most_probable(entries, i)]
                p = _nearest(entries, i, gate_m, fits, low, high, class_ix, x_m, y_m, match_of, True)
                if p >= 0:
                    out_object_ix[i], out_role[i], match_of[p] = object_ix[p], MATCH, i


@nb.njit(cache=True, nogil=True)
def _nearest(
    entries: Entries, i: int, gate_m: float, fits: Bool, low: int, high: int, class_ix: NDArray[np.int8],
    x_m: Float, y_m: Float, match_of: Int, only_free: bool,
) -> int:  # fmt: skip
    # The row of the truth, of low … high − 1, nearest to entry i and within its gate (at a tie the western); −1: none.
    x, y = entries[i].x_m, entries[i].y_m
    least, best = gate_m * gate_m, -1
    first, after = low, high
    while first < after:  # the first row that is not too far west
        middle = (first + after) // 2
        if x_m[middle] < x - gate_m:
            first = middle + 1
        else:
            after = middle
    for p in range(first, high):
        if x_m[p] > x + gate_m:
            break
        if not fits[class_ix[p]] or (only_free and match_of[p] >= 0):
            continue
        square = (x_m[p] - x) ** 2 + (y_m[p] - y) ** 2
        if square < least or (square == least and best < 0):
            least, best = square, p
    return best


@nb.njit(cache=True, nogil=True)
def _preferred(entries: Entries, i: int, j: int) -> bool:
    a, b = entries[i], entries[j]
    if a.existence != b.existence:
        return bool(a.existence > b.existence)
    if a.unit_ix != b.unit_ix:
        return bool(a.unit_ix >= 0 and (b.unit_ix < 0 or a.unit_ix < b.unit_ix))
    if a.x_m != b.x_m:
        return bool(a.x_m < b.x_m)
    if a.y_m != b.y_m:
        return bool(a.y_m < b.y_m)
    # At the very same place anything else, so that the order in the list never decides.
    if a.captured_s != b.captured_s:
        return bool(a.captured_s > b.captured_s)
    if a.track_id != b.track_id:
        return bool(a.track_id < b.track_id)
    return most_probable(entries, i) < most_probable(entries, j)


@nb.njit(cache=True, nogil=True)
def _in_order_of_preference(entries: Entries, those: Int, n: int) -> None:
    # Shell's sort with the gaps of Knuth, (3ʰ − 1) / 2.
    gap = 1
    while gap < n:
        gap = 3 * gap + 1
    while gap > 0:
        for at in range(gap, n):
            i, to = those[at], at
            while to >= gap and _preferred(entries, i, those[to - gap]):
                those[to] = those[to - gap]
                to -= gap
            those[to] = i
        gap //= 3
