"""The receiver's instants: when it issues a fused list, and which lists it then uses.

It issues one at every instant at which at least one list arrives (within 1 µs is one instant), from each unit's newest
list that has arrived, none older than `max_age_s`, counted from capture, on top of the list's own way to the receiver.
Ideal fusion and trackers use every other list that arrives at the instant as well.
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

    def beside_newest(self) -> tuple[Int, Int]:
        """Lists that arrive at an instant without being their unit's newest there: their instants and themselves, (B,).

        They arrive together with a newer one of their unit, or after it. Each list arrives once.
        """
        instant = np.repeat(np.arange(len(self.issue_s)), np.diff(self.arrived_start))
        beside = (self.newest[instant] != self.arrived[:, None]).all(axis=1)
        return instant[beside], self.arrived[beside]

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
    last = _ends_instant(arrives_s[arrived])
    issue_s = arrives_s[arrived][last]
    newest = np.full((len(issue_s), max(len(heard.units), 1)), -1)
    frame = arrived[~out_of_sequence(heard)[arrived]]
    instant = np.searchsorted(issue_s + _TOLERANCE_S, arrives_s[frame])
    newest[instant, heard.frame_unit_ix[frame]] = frame  # of a unit's that arrive together the last
    since = np.maximum.accumulate(np.where(newest >= 0, np.arange(len(issue_s))[:, None], 0), axis=0)
    newest = np.take_along_axis(newest, since, axis=0)
    outdated_s = arrives_s[newest] + max_age_s + _TOLERANCE_S
    newest[issue_s[:, None] > outdated_s] = -1
    return FusionSchedule(issue_s, newest, arrived, np.append(0, np.flatnonzero(last) + 1))


def instants_of(heard: Tracks) -> Float:
    """(K,) the receiver's instants alone."""
    arrives_s = np.sort(heard.common_arrives_s[np.isfinite(heard.common_arrives_s)])
    instants_s: Float = arrives_s[_ends_instant(arrives_s)]
    return instants_s


def _ends_instant(ordered_s: Float) -> Bool:
    """(A,) which arrivals are the last of their instant; those within a microsecond of the one before belong to it."""
    return np.append(np.diff(ordered_s) > _TOLERANCE_S, True) if len(ordered_s) else np.empty(0, dtype=bool)


def out_of_sequence(heard: Tracks) -> Bool:
    """(F,) lists that arrive together with a newer one of their unit, or after it, or not at all."""
    arrives_s, unit = heard.common_arrives_s, heard.frame_unit_ix
    result: Bool = ~np.isfinite(arrives_s)
    came = np.flatnonzero(~result)
    # Unit by unit; of lists that arrive together the newest counts.
    came = came[np.lexsort((-heard.stamp_ns[came], arrives_s[came], unit[came]))]
    age = unit[came] * len(came) + np.unique(heard.stamp_ns[came], return_inverse=True)[1]
    newest = np.maximum.accumulate(age)
    result[came[1:][age[1:] <= newest[:-1]]] = True
    return result


def overtaken(arriving: Tracks) -> Bool:
    """(F,) lists that arrive later than a newer one of their unit: by more than a microsecond, else it is together."""
    arrives_s = arriving.common_arrives_s
    result: Bool = np.isfinite(arrives_s) & (arrives_s > newer_arrives_s(arriving) + _TOLERANCE_S)
    return result


def newer_arrives_s(arriving: Tracks) -> Float:
    """(F,) when the first of the lists arrives that their unit captured later; inf: none does."""
    arrives_s, unit = arriving.common_arrives_s, arriving.frame_unit_ix
    result = np.full(len(arrives_s), np.inf)
    order = np.lexsort((arriving.stamp_ns, unit))
    for mine in np.split(order, np.flatnonzero(np.diff(unit[order])) + 1):
        stamps = arriving.stamp_ns[mine]
        first_s = np.append(np.minimum.accumulate(arrives_s[mine][::-1])[::-1], np.inf)
        result[mine] = first_s[np.searchsorted(stamps, stamps, side="right")]
    return result
