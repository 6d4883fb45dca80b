"""What the receiver keeps of units that send partial messages: of each of their objects the newest entry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba as nb
import numpy as np

from copem_replay.communication.arrivals import FusionSchedule
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Tracks

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class KeptEntries:
    """Of units whose messages are partial the entries that the receiver has of them, as lists (L,) beside those sent.

    List l has the entries `entry[start[l] : start[l + 1]]`, each as it was sent, in messages of the unit up to `frame`.
    `newest (K, U)`: as in FusionSchedule, and F + l for list l; F: how many lists are sent. `partial (U,)`: of whom.
    """

    start: Int
    entry: Int
    frame: Int
    newest: Int
    partial: Bool


class Sent(NamedTuple):
    """Lists (F,) and their entries (N,), `start[f] : start[f + 1]`; `same`: equal where a unit means one object."""

    start: Int
    same: Int  # (N,) −1: of no interest


def kept_entries(
    heard: Tracks, sent: Sent, partial: Bool, schedule: FusionSchedule, at: FusionSchedule, *, max_age_s: float
) -> KeptEntries:
    """At the instants `at` of all of `schedule` the newest entry of each object that `partial (U,)` units mean.

    An entry is kept for `max_age_s` after it arrived. It may be in a message that arrives after a newer one.
    """
    before = int(np.searchsorted(schedule.issue_s, at.issue_s[0])) if len(at.issue_s) else 0
    frame = np.repeat(np.arange(len(heard.stamp_ns)), np.diff(sent.start))
    same = np.where(partial[heard.frame_unit_ix[frame]], sent.same, -1)
    lists = _Lists(sent.start, heard.frame_unit_ix, heard.captured_s, heard.common_arrives_s + max_age_s + _TOLERANCE_S)
    made = _kept(*_instants(schedule), before, at.newest, lists, frame, same, np.flatnonzero(partial))
    return KeptEntries(*made, partial)


class _Lists(NamedTuple):
    start: Int
    unit_ix: Int
    captured_s: Float
    outdated_s: Float


def _instants(schedule: FusionSchedule) -> tuple[Float, Int, Int]:
    return schedule.issue_s, schedule.arrived, schedule.arrived_start


@nb.njit(cache=True, nogil=True)
def _kept(
    issue_s: Float, arrived: Int, arrived_start: Int, before: int, given: Int, lists: _Lists, frame: Int, same: Int,
    units: Int,
) -> tuple[Int, Int, Int, Int]:  # fmt: skip
    newest, current = given.copy(), np.full(same.max() + 1 if len(same) else 0, -1)
    active, n = np.empty(len(current), np.int64), 0  # of which there is an entry
    start, entries, frames = [0], [0], [0]
    entries.pop()
    frames.pop()
    changed, which = np.ones(given.shape[1], np.bool_), np.full(given.shape[1], -1)
    for k in range(before + len(given)):
        for f in arrived[arrived_start[k] : arrived_start[k + 1]]:
            for e in range(lists.start[f], lists.start[f + 1]):
                i = same[e]
                if i < 0:
                    continue
                changed[lists.unit_ix[f]] = True
                if current[i] < 0:
                    current[i], active[n] = e, i
                    n += 1
                elif lists.captured_s[f] >= lists.captured_s[frame[current[i]]]:
                    current[i] = e
        for j in range(n - 1, -1, -1):
            f = frame[current[active[j]]]
            if issue_s[k] > lists.outdated_s[f]:
                changed[lists.unit_ix[f]] = True
                current[active[j]] = -1
                active[j] = active[n - 1]
                n -= 1
        if k < before:
            continue
        for u in units:
            last = given[k - before, u]
            if not changed[u] and last >= 0 and which[u] >= 0 and frames[which[u]] == last:
                newest[k - before, u] = len(lists.unit_ix) + which[u]
                continue
            mine = [current[i] for i in active[:n] if lists.unit_ix[frame[current[i]]] == u]
            if len(mine) == 0 and last < 0:
                continue
            for e in mine:
                if last < 0 or (given[k - before, u] < 0 and lists.captured_s[frame[e]] > lists.captured_s[last]):
                    last = frame[e]
            mine.sort()  # the same wherever a log is cut
            entries.extend(mine)
            start.append(len(entries))
            frames.append(last)
            which[u], changed[u] = len(frames) - 1, False
            newest[k - before, u] = len(lists.unit_ix) + which[u]
    return np.array(start), np.array(entries), np.array(frames), newest
