"""The receiver's instants: when it issues a fused list, and which lists it then uses.

It issues one at every instant at which at least one list arrives (within 1 µs is one instant), from each unit's newest
list that has arrived, none older than `max_age_s`, counted from capture, on top of the list's own way to the receiver.
Ideal fusion and trackers use every other list that arrives at the instant as well. Of a unit that sends partial
messages the receiver keeps the newest entry of each object.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from copem_replay.core.compiled import kernel
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Tracks


@dataclass(frozen=True)
class FusionSchedule:
    """Instants `issue_s (K,)`, and at each the newest list of each unit: frame index `newest (K, U)`, −1: none.

    `arrived (A,)` are the lists in order of arrival, `arrived[arrived_start[k] : arrived_start[k + 1]]` those of
    instant k.
    """

    issue_s: Float
    newest: Int
    arrived: Int
    arrived_start: Int

    def beside_newest(self) -> tuple[Int, Int]:
        """The lists (B,) that are not their unit's newest at the instant they arrive: their instants, and the lists.

        They arrive together with a newer one of their unit, or after it. Each list arrives once.
        """
        instant = np.repeat(np.arange(len(self.issue_s)), np.diff(self.arrived_start))
        beside = (self.newest[instant] != self.arrived[:, None]).all(axis=1)
        return instant[beside], self.arrived[beside]

    def between(self, from_s: float, until_s: float) -> FusionSchedule:
        """The schedule of the instants from `from_s` on and before `until_s`."""
        first, after = np.searchsorted(self.issue_s, (from_s, until_s))
        begin, end = self.arrived_start[first], self.arrived_start[after]
        return FusionSchedule(
            self.issue_s[first:after],
            self.newest[first:after],
            self.arrived[begin:end],
            self.arrived_start[first : after + 1] - begin,
        )


def fusion_schedule(received: Tracks, *, max_age_s: float) -> FusionSchedule:
    """The receiver's instants for lists whose arrival times are common to all runs."""
    arrives_s = received.common_arrives_s
    arrived = np.flatnonzero(np.isfinite(arrives_s))
    arrived = arrived[np.argsort(arrives_s[arrived], kind="stable")]
    last = _ends_instant(arrives_s[arrived])
    issue_s = arrives_s[arrived][last]
    newest = np.full((len(issue_s), max(len(received.units), 1)), -1)
    frame = arrived[~find_out_of_sequence(received)[arrived]]
    instant = np.searchsorted(issue_s + SAME_INSTANT_S, arrives_s[frame])
    newest[instant, received.frame_unit_ix[frame]] = frame  # of lists of a unit that arrive together the last
    since = np.maximum.accumulate(np.where(newest >= 0, np.arange(len(issue_s))[:, None], 0), axis=0)
    newest = np.take_along_axis(newest, since, axis=0)
    outdated_s = arrives_s[newest] + max_age_s + SAME_INSTANT_S
    newest[issue_s[:, None] > outdated_s] = -1
    return FusionSchedule(issue_s, newest, arrived, np.append(0, np.flatnonzero(last) + 1))


def receiver_instants(received: Tracks) -> Float:
    """(K,) the receiver's instants: `issue_s` of its schedule."""
    arrives_s = np.sort(received.common_arrives_s[np.isfinite(received.common_arrives_s)])
    instants_s: Float = arrives_s[_ends_instant(arrives_s)]
    return instants_s


def _ends_instant(ordered_s: Float) -> Bool:
    """(A,) which arrivals are the last of their instant; those within a microsecond of the one before belong to it."""
    return np.append(np.diff(ordered_s) > SAME_INSTANT_S, True) if len(ordered_s) else np.empty(0, dtype=bool)


def find_out_of_sequence(received: Tracks) -> Bool:
    """(F,) lists that arrive together with a newer one of their unit, or after it, or not at all."""
    arrives_s, unit = received.common_arrives_s, received.frame_unit_ix
    result: Bool = ~np.isfinite(arrives_s)
    arriving = np.flatnonzero(~result)
    # Unit by unit; of lists that arrive together the newest counts.
    arriving = arriving[np.lexsort((-received.stamp_ns[arriving], arrives_s[arriving], unit[arriving]))]
    age = unit[arriving] * len(arriving) + np.unique(received.stamp_ns[arriving], return_inverse=True)[1]
    newest = np.maximum.accumulate(age)
    result[arriving[1:][age[1:] <= newest[:-1]]] = True
    return result


def find_overtaken_lists(arriving: Tracks) -> Bool:
    """(F,) lists that arrive more than a microsecond after a newer one of their unit."""
    arrives_s = arriving.common_arrives_s
    result: Bool = np.isfinite(arrives_s) & (arrives_s > first_newer_arrival_s(arriving) + SAME_INSTANT_S)
    return result


def first_newer_arrival_s(arriving: Tracks) -> Float:
    """(F,) arrival of the first list that the unit of each list captured after it; inf: none arrives."""
    arrives_s, unit = arriving.common_arrives_s, arriving.frame_unit_ix
    result = np.full(len(arrives_s), np.inf)
    order = np.lexsort((arriving.stamp_ns, unit))
    for frames in np.split(order, np.flatnonzero(np.diff(unit[order])) + 1):
        stamps = arriving.stamp_ns[frames]
        first_s = np.append(np.minimum.accumulate(arrives_s[frames][::-1])[::-1], np.inf)
        result[frames] = first_s[np.searchsorted(stamps, stamps, side="right")]
    return result


# Units that send partial messages.


@dataclass(frozen=True)
class KeptEntries:
    """The entries that the receiver caches of units with partial messages, as lists (L,) beside those that are sent.

    List l has the entries `entry[start[l] : start[l + 1]]`, each as it was sent, in messages of the unit up to `frame`.
    `newest (K, U)`: as in FusionSchedule, and F + l for list l, with F lists sent. `partial (U,)`: the units.
    """

    start: Int
    entry: Int
    frame: Int
    newest: Int
    partial: Bool


class SentEntries(NamedTuple):
    """Lists (F,) and their entries (N,), `start[f] : start[f + 1]`; `same`: a number for each object of each unit."""

    start: Int
    same: Int  # (N,) −1: not kept


def keep_entries(
    received: Tracks,
    sent: SentEntries,
    partial: Bool,
    schedule: FusionSchedule,
    instants: FusionSchedule,
    *,
    max_age_s: float,
) -> KeptEntries:
    """The newest entry of each object of the units that are `partial (U,)`, at `instants`, some of `schedule`.

    An entry is kept for `max_age_s` after it arrived. It may be in a message that arrives after a newer one.
    """
    before = int(np.searchsorted(schedule.issue_s, instants.issue_s[0])) if len(instants.issue_s) else 0
    frame = np.repeat(np.arange(len(received.stamp_ns)), np.diff(sent.start))
    object_of = np.where(partial[received.frame_unit_ix[frame]], sent.same, -1)
    lists = _PartialLists(
        sent.start, received.frame_unit_ix, received.captured_s, received.common_arrives_s + max_age_s + SAME_INSTANT_S
    )
    columns = _keep_newest(
        schedule.issue_s, schedule.arrived, schedule.arrived_start, before, instants.newest, lists, frame, object_of,
        np.flatnonzero(partial),
    )  # fmt: skip
    return KeptEntries(*columns, partial)


class _PartialLists(NamedTuple):
    """Lists (F,): where their entries begin, their unit, their capture, and from when on they are too old."""

    start: Int
    unit_ix: Int
    captured_s: Float
    outdated_s: Float


@kernel
def _keep_newest(
    issue_s: Float, arrived: Int, arrived_start: Int, before: int, known: Int, lists: _PartialLists, frame: Int,
    object_of: Int, units: Int,
) -> tuple[Int, Int, Int, Int]:  # fmt: skip
    """Columns of KeptEntries: start, entry, frame, newest.

    `before`: how many instants come first and are left out of the result. `known (K, U)`: the newest list of each unit
    at the others. `frame (N,)`, `object_of (N,)`: list and object number of each entry. `units`: send partial messages.
    """
    newest, current = known.copy(), np.full(object_of.max() + 1 if len(object_of) else 0, -1)
    active, n = np.empty(len(current), np.int64), 0  # objects of which there is an entry
    start, entries, frames = [0], [0], [0]
    entries.pop()
    frames.pop()
    changed, list_of = np.ones(known.shape[1], np.bool_), np.full(known.shape[1], -1)
    for k in range(before + len(known)):
        for j in range(n - 1, -1, -1):  # first, so that an older entry that arrives now takes the place
            f = frame[current[active[j]]]
            if issue_s[k] > lists.outdated_s[f]:
                changed[lists.unit_ix[f]] = True
                current[active[j]] = -1
                active[j] = active[n - 1]
                n -= 1
        for f in arrived[arrived_start[k] : arrived_start[k + 1]]:
            for e in range(lists.start[f], lists.start[f + 1]):
                i = object_of[e]
                if i < 0:
                    continue
                changed[lists.unit_ix[f]] = True
                if current[i] < 0:
                    current[i], active[n] = e, i
                    n += 1
                elif lists.captured_s[f] >= lists.captured_s[frame[current[i]]]:
                    current[i] = e
        if k < before:
            continue
        for u in units:
            last = known[k - before, u]
            if not changed[u] and last >= 0 and list_of[u] >= 0 and frames[list_of[u]] == last:
                newest[k - before, u] = len(lists.unit_ix) + list_of[u]
                continue
            entry_ix = [current[i] for i in active[:n] if lists.unit_ix[frame[current[i]]] == u]
            if len(entry_ix) == 0 and last < 0:
                continue
            for e in entry_ix:
                if last < 0 or (known[k - before, u] < 0 and lists.captured_s[frame[e]] > lists.captured_s[last]):
                    last = frame[e]
            entry_ix.sort()  # an order that does not depend on where a log is cut
            entries.extend(entry_ix)
            start.append(len(entries))
            frames.append(last)
            list_of[u], changed[u] = len(frames) - 1, False
            newest[k - before, u] = len(lists.unit_ix) + list_of[u]
    return np.array(start), np.array(entries), np.array(frames), newest
