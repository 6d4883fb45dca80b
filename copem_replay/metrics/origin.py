"""Origin: which objects an entry of a fused list may be about, by what the lists hold that it goes back to.

An entry goes back, of each unit, to the newest list that the receiver has taken in and that was captured no later than
the entry's newest capture, if that list was still in use at this capture, for `max_age_s` from its arrival. The entry
may be about an object only if one of these lists holds the object: by truth id, in recorded lists by match
(`assign_truth_ids`). No list holds the receiver's own body. So a neighbour's entry makes nobody known.

- Of a unit with partial messages every list still in use counts: the receiver keeps what newer messages leave out.
- Entries of ideal fusion, and of the truth, have an id of their own. Each goes back to every list in use that holds
  that object, and may be about no other.
- Entries of a stack's output go back to every list of its `inputs` taken in by then: a stack states coasted objects as
  new, by a clock of its own.
- Of an output without `inputs` nothing is known of origin: its entries may be about any object, by the list of their
  own capture.

A fused list makes an object known by entries about it that go back to a list which holds it, captured early enough. No
fusion of the same lists, at the same instants, can then know it before ideal fusion does.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from copem_replay.core.compiled import borrowing
from copem_replay.core.geometry import count_below
from copem_replay.core.object_list import Entries
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Tracks


class GoesBack(IntEnum):
    """The lists that an entry goes back to: of each unit the newest, all that were taken in, or unknown."""

    TO_NEWEST = 0
    TO_ALL = 1
    UNKNOWN = 2


@dataclass(frozen=True)
class OriginLists:
    """The lists that entries of a fusion may go back to, with their rows.

    `lists`: as they are taken in, by `arrives_s`; `rows`: the same with rows that other configurations share.
    `partial (U,)`: units with partial messages. `own_body_ix`: the object that no list holds, −1: none.
    """

    lists: Tracks
    rows: Tracks
    goes_back: GoesBack
    max_age_s: float
    partial: Bool
    own_body_ix: int

    def find_holdings(self, issue_s: Float) -> Holdings:
        """Which objects each list holds, ready for look-up by fused lists that are available at `issue_s (K,)`."""
        lists, arrives_s = self.lists, self.lists.common_arrives_s
        longest_way_s = find_longest_way_s(lists)
        # Those before the first row, in a time chunk, hold nobody; where nothing is known of origin, each counts.
        unknown = self.goes_back == GoesBack.UNKNOWN
        since_s = -np.inf if unknown else self.rows.row_captured_s.min(initial=np.inf)
        frames = np.flatnonzero(
            (lists.captured_s >= since_s) & (arrives_s <= issue_s.max(initial=-np.inf) + SAME_INSTANT_S)
        )
        frames = frames[np.lexsort((lists.captured_s[frames], lists.frame_unit_ix[frames]))]
        start = np.searchsorted(lists.frame_unit_ix[frames], np.arange(len(lists.units) + 1))
        (row, first_row), units = self.rows.by_object, len(lists.units)
        return Holdings(
            int(self.goes_back), self.partial, start, frames, arrives_s[frames], lists.captured_s[frames],
            lists.frame_unit_ix[frames], self.rows.valid, row, self.rows.row_captured_s[row],
            self.rows.entry_captured_s[row], self.rows.frame_ix[row], first_row, (len(first_row) - 1) // max(units, 1),
            self.own_body_ix, issue_s, self.max_age_s, longest_way_s,
            np.full((units, 2), np.nan), np.empty(units, np.int64), np.empty(len(frames), np.int64),
        )  # fmt: skip


def find_longest_way_s(lists: Tracks) -> float:
    """The longest time from capture to arrival, in seconds, of the lists that arrive."""
    ways_s = lists.common_arrives_s - lists.captured_s
    return float(ways_s[np.isfinite(ways_s)].max(initial=0.0))


def find_earliest_origin_s(lists: Tracks, captured_s: Float, max_age_s: float, partial: Bool) -> Float:
    """(K,) the earliest capture that entries whose newest captures are `captured_s (K,)` may go back to.

    Of each unit the newest list that had surely arrived at such a capture; `partial (U,)`: of all lists then in use.
    """
    earliest_s = np.where(partial.any(), captured_s - max_age_s - find_longest_way_s(lists), captured_s)
    for unit in range(len(lists.units)):
        own = np.flatnonzero((lists.frame_unit_ix == unit) & np.isfinite(lists.common_arrives_s))
        own_s = np.sort(lists.captured_s[own])
        way_s = (lists.common_arrives_s - lists.captured_s)[own].max(initial=0.0)
        place = np.searchsorted(own_s, captured_s - way_s, side="right") - 1
        newest_s = own_s[place] if len(own_s) else np.full(len(captured_s), -np.inf)
        in_use = (place >= 0) & (newest_s >= captured_s - max_age_s - way_s - 3 * SAME_INSTANT_S)
        earliest_s = np.where(in_use, np.minimum(earliest_s, newest_s), earliest_s)
    return earliest_s


class Holdings(NamedTuple):
    """The objects in lists (A,), unit by unit in order of capture; fused lists (K,), rows (P,) as `by_object`."""

    goes_back: int
    partial: Bool  # (U,)
    start: Int  # (U + 1,) where the lists of each unit begin
    frame: Int  # (A,) number among all lists
    arrives_s: Float  # (A,)
    captured_s: Float  # (A,)
    unit_ix: Int  # (A,)
    valid: Bool  # (S | 1, P)
    row: Int
    row_captured_s: Float
    row_entry_s: Float
    row_frame: Int
    first_row: Int
    objects: int  # rows of unit u and object o begin at first_row[u · objects + o + 1]
    own_body_ix: int
    issue_s: Float  # (K,)
    max_age_s: float
    way_s: float  # the longest from capture to arrival
    asked: Float  # (U, 2) the fused list and the capture that `newest` was last found for
    newest: Int  # (U,)
    holding: Int  # (A,) out of `find_holding_lists`


class Origins(NamedTuple):
    """What entries (N,) go back to: `entries` with their true captures; `own_ix` their truth ids, empty: none."""

    entries: Entries
    own_ix: Int
    holdings: Holdings


@borrowing
def _find_newest_list(h: Holdings, u: int, k: int, captured_s: float) -> int:
    """The newest list of unit u that fused list k has taken in, captured by `captured_s`; start[u] − 1: none."""
    if h.asked[u, 0] != k or h.asked[u, 1] != captured_s:
        first, after, latest_capture_s = h.start[u], h.start[u + 1], captured_s + SAME_INSTANT_S
        if h.goes_back == GoesBack.TO_ALL:
            latest_capture_s = np.inf
        a = first + count_below(h.captured_s[first:after], latest_capture_s) - 1
        while a >= first and h.arrives_s[a] > h.issue_s[k] + SAME_INSTANT_S:
            a -= 1
        h.asked[u, 0], h.asked[u, 1], h.newest[u] = k, captured_s, a
    return int(h.newest[u])


@borrowing
def _holds(h: Holdings, s: int, a: int, o: int, not_before_s: float) -> bool:
    """Whether list a holds object o in run s, by an entry captured at `not_before_s` or later."""
    if o + 1 >= h.objects or o == h.own_body_ix:
        return False
    group = h.unit_ix[a] * h.objects + o + 1
    first, after = h.first_row[group], h.first_row[group + 1]
    for q in range(first + count_below(h.row_captured_s[first:after], h.captured_s[a]), after):
        if h.row_captured_s[q] > h.captured_s[a]:
            break
        listed = h.row_frame[q] == h.frame[a] and h.valid[s if len(h.valid) > 1 else 0, h.row[q]]
        if listed and h.row_entry_s[q] >= not_before_s:
            return True
    return False


@borrowing
def find_holding_lists(origins: Origins, s: int, k: int, i: int, o: int, not_before_s: float, any_will_do: bool) -> int:
    """Find the lists that entry i of fused list k in run s goes back to and that hold object o; returns their number.

    Out: the first of `h.holding`. Of each unit the newest list counts, of an entry with a truth id all; none captured
    before `not_before_s`. `any_will_do`: stop at the first.
    """
    h, entry, n = origins.holdings, origins.entries[i], 0
    known, bounded = len(origins.own_ix) > 0, h.goes_back == GoesBack.TO_NEWEST
    oldest_s = entry.captured_s - h.max_age_s - 2 * SAME_INSTANT_S  # what arrived before was not in use any more
    for j in range(len(h.newest)):  # the entry's own unit first
        u = (max(entry.unit_ix, 0) + j) % len(h.newest)
        newest = _find_newest_list(h, u, k, entry.captured_s)
        for a in range(newest, h.start[u] - 1, -1):
            if h.captured_s[a] < not_before_s or (bounded and h.captured_s[a] + h.way_s < oldest_s):
                break
            if h.goes_back == GoesBack.UNKNOWN:
                holds = h.captured_s[a] >= entry.captured_s - SAME_INSTANT_S
            else:
                taken_in = h.arrives_s[a] <= h.issue_s[k] + SAME_INSTANT_S
                in_use = not bounded or h.arrives_s[a] >= oldest_s
                holds = taken_in and in_use and _holds(h, s, a, o, not_before_s)
            if holds:
                h.holding[n] = a
                n += 1
                if any_will_do:
                    return n
            if not known and (holds or (not h.partial[u] and h.goes_back != GoesBack.TO_ALL)):
                break
    return n


@borrowing
def may_be_about(origins: Origins, s: int, k: int, i: int, o: int) -> bool:
    """Whether entry i of fused list k in run s may be about object o."""
    if len(origins.own_ix) > 0:
        return bool(origins.own_ix[i] == o)
    if origins.holdings.goes_back == GoesBack.UNKNOWN:
        return True
    return find_holding_lists(origins, s, k, i, o, -np.inf, True) > 0
