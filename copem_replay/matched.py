"""When did the receiver first know of an object? By match: for fusions that go without truth ids.

Known by the first list with a match of the object (`match.py`) that was captured at or after the onset and is
available before looking ends. `confirm` counts captures, not messages, by the rules of `detect.py`: an entry about the
object, a match or a duplicate of one, says that the capture it goes back to holds the object, however often it is
issued again.

How surely it was known: had entries below some existence not been listed, the detection would have come later, or
never. `Steps` says when, for every existence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from copem_replay.detect import Detections, capture_instants
from copem_replay.fusion.object_list import Entries, Lists
from copem_replay.match import DUPLICATE, MATCH, Matches
from copem_replay.measure_keys import Confirm
from copem_replay.onset import Looks
from copem_replay.tracks import SAME_INSTANT_NS, Float, Int, Tracks

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class Steps:
    """When each look would be detected if only entries of at least some existence were listed. All (R,).

    By run, look and time. Of one run and look existence and time both ascend, from the detection itself on: the first
    row with as much existence as is asked for says when; where none has, it is never detected.
    """

    run_ix: Int
    look_ix: Int
    existence: Float
    detection_s: Float


@dataclass(frozen=True)
class Captures:
    """When units made their lists, unit by unit and in order of time: (F,) each; `instant` numbers capture instants."""

    captured_s: Float
    unit_ix: Int
    instant: Int


def captures_of(heard: Tracks) -> Captures:
    """The captures behind the lists that were heard."""
    came = np.isfinite(heard.arrives_s[0])
    order = np.flatnonzero(came)
    order = order[np.lexsort((heard.captured_s[order], heard.frame_unit_ix[order]))]
    return Captures(heard.captured_s[order], heard.frame_unit_ix[order], capture_instants(heard)[order])


def first_matches(
    lists: Lists,
    matches: Matches,
    issue_s: Float,
    looks: Looks,
    *,
    confirm: Confirm,
    count_earlier: bool,
    captures: Captures,
) -> tuple[Detections, Steps]:
    """First detection of each of M looks in S runs, and how it depends on the existence asked for.

    `issue_s (K,)`: when each list is available, ascending; `captures`: what entries go back to. The captured instant
    and the first unit are those of the entry.
    """
    look_of = np.full(int(max(looks.object_ix.max(initial=-1), matches.object_ix.max(initial=-1))) + 1, -1)
    look_of[looks.object_ix] = np.arange(len(looks.object_ix))
    not_before_s = np.full(len(looks.object_ix), -np.inf) if count_earlier else looks.onset_s - _TOLERANCE_S
    level = np.full(len(lists.entries), np.nan)
    # One hit confirms at once, whatever the captures.
    source = _sources(lists.entries, captures) if confirm.hits > 1 else np.zeros((0, 2), dtype=np.int64)
    _levels(
        lists.start, lists.entries, matches.object_ix, matches.role, issue_s, source, captures.unit_ix,
        int(captures.instant.max(initial=-1)) + 1, look_of, not_before_s, looks.ended_s + _TOLERANCE_S,
        confirm.hits, confirm.of, level,
    )  # fmt: skip
    entry = np.flatnonzero(~np.isnan(level))
    # Of empty lists, which begin where the next does, the last is the one that holds the entry.
    run_ix, number = np.divmod(np.searchsorted(lists.start.ravel(), entry, side="right") - 1, lists.start.shape[1])
    look_ix = look_of[matches.object_ix[entry]]
    order = np.lexsort((entry, look_ix, run_ix))
    entry, run_ix, look_ix, number = entry[order], run_ix[order], look_ix[order], number[order]
    steps = Steps(run_ix, look_ix, level[entry], issue_s[number])
    first = np.flatnonzero((np.diff(run_ix, prepend=-1) != 0) | (np.diff(look_ix, prepend=-1) != 0))
    shape = (len(lists.start), len(looks.object_ix))
    found = Detections(np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1))
    at = run_ix[first], look_ix[first]
    found.detection_s[at] = steps.detection_s[first]
    found.captured_s[at] = lists.entries["captured_s"][entry[first]]
    found.first_unit_ix[at] = lists.entries["unit_ix"][entry[first]]
    return found, steps


def _sources(entries: Entries, captures: Captures) -> Int:
    """(i, 2) the capture instant and the list each entry goes back to, −1: none.

    That of its unit where it made one then, else the first unit's; an entry that says it was captured at another time
    goes back to the instant before, and to no list.
    """
    captured_s = entries["captured_s"]
    by_time = np.argsort(captures.captured_s, kind="stable")
    ordered_s = captures.captured_s[by_time]
    before = np.searchsorted(ordered_s, captured_s + _TOLERANCE_S, side="right") - 1
    instant = np.where(before >= 0, captures.instant[by_time[before]], -1) if len(by_time) else before
    made = np.full(len(entries), -1)
    units = np.unique(captures.unit_ix)
    for own in (True, False):
        for unit in units:
            first, last = np.searchsorted(captures.unit_ix, (unit, unit + 1))
            asked = np.flatnonzero((made < 0) & (entries["unit_ix"] == unit)) if own else np.flatnonzero(made < 0)
            at = np.searchsorted(captures.captured_s[first:last], captured_s[asked] - _TOLERANCE_S) + first
            there = at < last
            there[there] = captures.captured_s[at[there]] <= captured_s[asked[there]] + _TOLERANCE_S
            made[asked[there]] = at[there]
    instant = np.where(made >= 0, captures.instant[made], instant) if len(by_time) else instant
    return np.stack([instant, made], axis=1)


@nb.njit(cache=True, nogil=True)
def _levels(
    start: Int, entries: Entries, object_ix: Int, role: NDArray[np.int8], issue_s: Float, source: Int,
    unit_of_list: Int, instants: int, look_of: Int, not_before_s: Float, until_s: Float, hits: int, of: int,
    level: Float,
) -> None:  # fmt: skip
    # At each entry that makes one known at a higher existence than before: that existence.
    M = len(until_s)
    best = np.empty(M)
    # The highest existence with which each capture instant, and each unit's list, holds the object of each look.
    by_instant, by_list = np.empty((M, instants)), np.empty((M, len(unit_of_list)))
    nobody = np.zeros(instants, dtype=np.int64)
    held = np.empty(of)
    # What one fused list says of the looks in it, and the entry that stands for it.
    touched, reached, standing = np.empty(M, dtype=np.int64), np.empty(M), np.full(M, -1)
    for s in range(len(start)):
        best[:] = -np.inf
        if hits > 1:
            by_instant[:], by_list[:] = -np.inf, -np.inf
        for k in range(len(issue_s)):
            n = 0
            for i in range(start[s, k], start[s, k + 1]):
                about = role[i] == MATCH or (hits > 1 and role[i] == DUPLICATE)
                m = look_of[object_ix[i]] if about else -1
                if m < 0 or issue_s[k] > until_s[m] or entries[i].captured_s < not_before_s[m]:
                    continue
                existence = entries[i].existence
                if standing[m] < 0:
                    touched[n], standing[m], reached[m] = m, i, -np.inf
                    n += 1
                elif _stands_before(entries, role, i, standing[m]):
                    standing[m] = i
                if hits == 1:
                    reached[m] = existence
                    continue
                instant, made = source[i]
                if instant >= 0 and existence > by_instant[m, instant]:
                    by_instant[m, instant] = existence
                    reached[m] = max(reached[m], _confirmed(by_instant[m], instant, hits, of, nobody, held))
                if made >= 0 and existence > by_list[m, made]:
                    by_list[m, made] = existence
                    reached[m] = max(reached[m], _confirmed(by_list[m], made, hits, of, unit_of_list, held))
            for m in touched[:n]:
                if reached[m] > best[m]:
                    best[m] = level[standing[m]] = reached[m]
                standing[m] = -1


@nb.njit(cache=True, nogil=True)
def _stands_before(entries: Entries, role: NDArray[np.int8], i: int, j: int) -> bool:
    # Of two entries about one object: the match, the surer, the newer, the first unit's.
    one, other = entries[i], entries[j]
    if role[i] != role[j]:
        return bool(role[i] < role[j])
    if one.existence != other.existence:
        return bool(one.existence > other.existence)
    if one.captured_s != other.captured_s:
        return bool(one.captured_s > other.captured_s)
    return bool(one.unit_ix < other.unit_ix)


@nb.njit(cache=True, nogil=True)
def _confirmed(existence: Float, at: int, hits: int, of: int, group: Int, held: Float) -> float:
    # With at most which existence do `hits` of some `of` consecutive captures of a group, this one among them, hold it?
    found = -np.inf
    for first in range(max(at - of + 1, 0), at + 1):
        n = 0
        for q in range(first, min(first + of, len(existence))):
            if group[q] == group[at] and existence[q] > -np.inf:
                held[n] = existence[q]
                n += 1
        if n >= hits:
            held[:n].sort()
            found = max(found, held[n - hits])
    return found
