"""Turns: what `confirm` counts. How often a receiver hears something new, whatever the number of messages.

A *turn* of a unit is a fused list at which the receiver takes in a list of the unit that is newer than all before.
Lists that come with it, or after it though captured before, belong to it. Turns of several units captured within half
the shortest period of turns are one *instant*; two turns of one unit never are. What confirms in the turns of one unit
alone confirms also where others have joined it, whatever their rates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.communication.arrivals import find_out_of_sequence
from copem_replay.core.compiled import kernel
from copem_replay.core.tracks import SAME_INSTANT_S, Float, Int, Tracks


@dataclass(frozen=True)
class Turns:
    """Turns (T,), unit by unit in order of capture: their units and instants; `turn (F,)`: the turn of each list.

    Lists that never arrive have one as well; it means nothing.
    """

    turn: Int
    unit_ix: Int
    instant: Int

    @property
    def list_instant(self) -> Int:
        """(F,) the instant of each list."""
        return self.instant[self.turn] if len(self.instant) else self.turn


def number_turns(received: Tracks) -> Turns:
    """The turns of lists whose arrival times all runs share."""
    new = np.flatnonzero(~find_out_of_sequence(received))
    new = new[np.lexsort((received.captured_s[new], received.frame_unit_ix[new]))]
    together = np.diff(received.common_arrives_s[new]) <= SAME_INSTANT_S  # of those of one unit the newest counts
    new = new[np.append(~together | (np.diff(received.frame_unit_ix[new]) != 0), True)[: len(new)]]
    unit_ix, captured_s = received.frame_unit_ix[new], received.captured_s[new]
    turn = np.zeros(len(received.stamp_ns), dtype=np.int64)
    for unit in np.unique(unit_ix):
        first, after = np.searchsorted(unit_ix, (unit, unit + 1))
        lists = np.flatnonzero(received.frame_unit_ix == unit)
        place = first + np.searchsorted(captured_s[first:after], received.captured_s[lists] - SAME_INSTANT_S)
        turn[lists] = np.minimum(place, after - 1)
    instant = np.zeros(len(unit_ix), dtype=np.int64)
    reach_s = _shortest_period_s(captured_s, unit_ix) / 2 + SAME_INSTANT_S
    order = np.argsort(captured_s, kind="stable")
    _cluster_turns(captured_s, unit_ix, np.full(len(received.units), -1), reach_s, order, instant)
    return Turns(turn, unit_ix, instant)


def _shortest_period_s(captured_s: Float, unit_ix: Int) -> float:
    """The shortest of the units' periods in seconds, each the median between two of its turns; 0 without any."""
    steps_s, of_one = np.diff(captured_s), np.diff(unit_ix) == 0
    units = np.unique(unit_ix[1:][of_one])
    return min((float(np.median(steps_s[of_one & (unit_ix[1:] == unit)])) for unit in units), default=0.0)


@kernel
def _cluster_turns(captured_s: Float, unit_ix: Int, last_of: Int, reach_s: float, order: Int, out: Int) -> None:
    current, first = -1, -np.inf
    for t in order:
        if captured_s[t] > first + reach_s or last_of[unit_ix[t]] == current:
            current, first = current + 1, captured_s[t]
        out[t] = last_of[unit_ix[t]] = current
