"""When did the receiver first know of an object? By match: for fusions that go without truth ids.

Known by the first list with a match of the object (`match.py`) that was captured at or after the onset and is
available before looking ends. `confirm` counts captures, not messages: `hits` of the last `of` capture instants hold
such a match, in whichever of their lists. A list belongs to the newest capture that the receiver has had; captures
within half a list period of the first one of a capture instant belong to that instant.

How surely it was known: had entries below some existence not been listed, the detection would have come later, or
never. `Steps` says when, for every existence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from copem_replay.detect import Detections
from copem_replay.fusion.object_list import Entries, Lists
from copem_replay.match import MATCH, Matches
from copem_replay.measure_keys import Confirm
from copem_replay.onset import Looks
from copem_replay.tracks import SAME_INSTANT_NS, Float, Int

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


def first_matches(
    lists: Lists,
    matches: Matches,
    issue_s: Float,
    looks: Looks,
    *,
    confirm: Confirm,
    count_earlier: bool,
    list_captured_s: Float,
    period_s: float | None = None,
) -> tuple[Detections, Steps]:
    """First detection of each of M looks in S runs, and how it depends on the existence asked for.

    `issue_s (K,)`: when each list is available, ascending; `list_captured_s (K,)`: the newest capture the receiver then
    had. `period_s`: the units' shortest list period; None: the median spacing of the captures, the same with one unit.
    The captured instant and the first unit are those of the entry.
    """
    look_of = np.full(int(max(looks.object_ix.max(initial=-1), matches.object_ix.max(initial=-1))) + 1, -1)
    look_of[looks.object_ix] = np.arange(len(looks.object_ix))
    not_before_s = np.full(len(looks.object_ix), -np.inf) if count_earlier else looks.onset_s - _TOLERANCE_S
    level = np.full(len(lists.entries), np.nan)
    instant = capture_instants(list_captured_s, period_s)
    _levels(
        lists.start, lists.entries, matches.object_ix, matches.role, issue_s, instant, look_of, not_before_s,
        looks.ended_s + _TOLERANCE_S, confirm.hits, confirm.of, level,
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


def capture_instants(list_captured_s: Float, period_s: float | None = None) -> Int:
    """(K,) the capture instant each list belongs to, counted from the first; never one before that of the last list."""
    captured_s = np.maximum.accumulate(list_captured_s)
    if period_s is None:
        apart_s = np.diff(captured_s[np.isfinite(captured_s)])
        apart_s = apart_s[apart_s > _TOLERANCE_S]
        period_s = float(np.median(apart_s)) if len(apart_s) else 0.0
    instant = np.zeros(len(captured_s), dtype=np.int64)
    _cluster(captured_s, period_s / 2 + _TOLERANCE_S, instant)
    return instant


@nb.njit(cache=True, nogil=True)
def _cluster(captured_s: Float, reach_s: float, out: Int) -> None:
    first = 0
    for k in range(1, len(captured_s)):
        out[k] = out[k - 1]
        if captured_s[k] > captured_s[first] + reach_s:
            out[k] += 1
            first = k


@nb.njit(cache=True, nogil=True)
def _levels(
    start: Int, entries: Entries, object_ix: Int, role: NDArray[np.int8], issue_s: Float, instant: Int, look_of: Int,
    not_before_s: Float, until_s: Float, hits: int, of: int, level: Float,
) -> None:  # fmt: skip
    # At each entry that makes one known at a higher existence than before: that existence.
    M = len(until_s)
    best = np.empty(M)
    # The last `of` capture instants that hold a match of each look, in a ring, and the highest existence of each.
    when, highest = np.empty((M, of), dtype=np.int64), np.empty((M, of))
    held = np.empty(of)
    for s in range(len(start)):
        best[:], when[:] = -np.inf, -1
        for k in range(len(issue_s)):
            for i in range(start[s, k], start[s, k + 1]):
                m = look_of[object_ix[i]] if role[i] == MATCH else -1
                if m < 0 or issue_s[k] > until_s[m] or entries[i].captured_s < not_before_s[m]:
                    continue
                existence = entries[i].existence
                if hits > 1:
                    place = instant[k] % of
                    if when[m, place] != instant[k]:
                        when[m, place], highest[m, place] = instant[k], existence
                    highest[m, place] = max(highest[m, place], existence)
                    if existence <= best[m]:
                        continue  # of those above the best there are no more than before
                    n = 0
                    for q in range(of):
                        if when[m, q] >= 0 and when[m, q] > instant[k] - of:
                            held[n] = highest[m, q]
                            n += 1
                    if n < hits:
                        continue
                    held[:n].sort()
                    existence = held[n - hits]
                if existence > best[m]:
                    best[m] = level[i] = existence
