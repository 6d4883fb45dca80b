"""The receiver's instants: when it issues a fused list, and which lists it then goes by.

It issues one at every instant at which at least one list arrives (within 1 µs is one instant), from each unit's newest
arrived list, none older than `max_age_s`, counted from capture, on top of the list's own way to the receiver.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.tracks import SAME_INSTANT_NS, Float, Int, Tracks


@dataclass(frozen=True)
class Inbox:
    """Instants (K,) and the newest list of each unit at each: frame index (K, U), −1: none."""

    issue_s: Float
    newest: Int


def inbox(heard: Tracks, *, max_age_s: float) -> Inbox:
    """The receiver's instants for lists whose arrival times are common to all runs."""
    arrives_s = heard.arrives_s[0]
    tolerance_s = SAME_INSTANT_NS * 1e-9
    ordered = np.sort(arrives_s[np.isfinite(arrives_s)])
    # The last arrival within a microsecond of the one before belongs to the same instant.
    last = np.append(np.diff(ordered) > tolerance_s, True) if len(ordered) else np.empty(0, dtype=bool)
    issue_s = ordered[last]
    newest = np.full((len(issue_s), max(len(heard.units), 1)), -1)
    for unit in range(len(heard.units)):
        # In order of capture, and so of arrival; without those that were lost.
        mine = np.flatnonzero((heard.frame_unit_ix == unit) & np.isfinite(arrives_s))
        at = np.searchsorted(arrives_s[mine], issue_s + tolerance_s, side="right") - 1
        known = at >= 0
        frame = mine[at[known]]
        fresh = issue_s[known] <= arrives_s[frame] + max_age_s + tolerance_s
        newest[np.flatnonzero(known)[fresh], unit] = frame[fresh]
    return Inbox(issue_s, newest)
