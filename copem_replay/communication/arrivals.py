"""The receiver's instants: when it issues a fused list, and which lists it then goes by.

It issues one at every instant at which at least one list arrives (within 1 µs is one instant), from each unit's newest
list that has arrived, none older than `max_age_s`, counted from capture, on top of the list's own way to the receiver.
A list that arrives after a newer one of its unit is not gone by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Tracks

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class FusionSchedule:
    """Instants (K,), and the newest list of each unit at each: frame index (K, U), −1: none.

    `arrived (A,)` are the lists in order of arrival, `arrived[arrived_start[k] : arrived_start[k + 1]]` those of
    instant k.
    """

    issue_s: Float
    newest: Int
    arrived: Int
    arrived_start: Int

    def between(self, from_s: float, until_s: float) -> FusionSchedule:
        """Those from one time on and before another."""
        first, after = np.searchsorted(self.issue_s, (from_s, until_s))
        begin, end = self.arrived_start[first], self.arrived_start[after]
        return FusionSchedule(
            self.issue_s[first:after],
            self.newest[first:after],
            self.arrived[begin:end],
            self.arrived_start[first : after + 1] - begin,
        )


def fusion_schedule(heard: Tracks, *, max_age_s: float) -> FusionSchedule:
    """The receiver's instants for lists whose arrival times are common to all runs."""
    arrives_s = heard.common_arrives_s
    arrived = np.flatnonzero(np.isfinite(arrives_s))
    arrived = arrived[np.argsort(arrives_s[arrived], kind="stable")]
    ordered = arrives_s[arrived]
    # The last arrival within a microsecond of the one before belongs to the same instant.
    last = np.append(np.diff(ordered) > _TOLERANCE_S, True) if len(ordered) else np.empty(0, dtype=bool)
    issue_s = ordered[last]
    newest = np.full((len(issue_s), max(len(heard.units), 1)), -1)
    superseded = out_of_sequence(heard)
    for unit in range(len(heard.units)):
        mine = arrived[(heard.frame_unit_ix[arrived] == unit) & ~superseded[arrived]]
        at = np.searchsorted(arrives_s[mine], issue_s + _TOLERANCE_S, side="right") - 1
        known = at >= 0
        frame = mine[at[known]]
        fresh = issue_s[known] <= arrives_s[frame] + max_age_s + _TOLERANCE_S
        newest[np.flatnonzero(known)[fresh], unit] = frame[fresh]
    return FusionSchedule(issue_s, newest, arrived, np.append(0, np.flatnonzero(last) + 1))


def out_of_sequence(heard: Tracks) -> Bool:
    """(F,) lists that arrive when a newer one of their unit is there already, or not at all."""
    arrives_s = heard.common_arrives_s
    result: Bool = ~np.isfinite(arrives_s)
    for unit in np.unique(heard.frame_unit_ix):
        mine = np.flatnonzero((heard.frame_unit_ix == unit) & np.isfinite(arrives_s))
        # Of lists that arrive together the newest counts.
        mine = mine[np.lexsort((-heard.stamp_ns[mine], arrives_s[mine]))]
        stamps = heard.stamp_ns[mine]
        before = np.maximum.accumulate(np.append(np.iinfo(np.int64).min, stamps[:-1])) if len(mine) else stamps
        result[mine[stamps <= before]] = True
    return result
