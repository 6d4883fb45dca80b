"""First detection of an object by truth id: the objects of a list are known (ideal fusion, and the truth).

With ideal fusion an object is in the fused list whenever the receiver takes in a list that holds it, so the first
detection is read off the lists themselves; every other fusion is judged by its own lists.

`confirm` counts captures, not messages: the object is confirmed when `hits` of `of` consecutive capture instants hold
it, by the lists that have arrived. Captures of several units within half a list period are one instant. What confirms
in the lists of one unit alone confirms also where others have joined it, whatever their rates.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numba as nb
import numpy as np

from copem_replay.communication.arrivals import newer_arrives_s
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Tracks
from copem_replay.metrics.config import Confirm

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


class Detections(NamedTuple):
    """When each episode of Episodes ended in a detection, run by run. All (S, M), NaN and −1 where not detected."""

    detection_s: Float
    captured_s: Float
    first_unit_ix: Int


def detect(
    heard: Tracks,
    found: Episodes,
    *,
    confirm: Confirm,
    count_earlier: bool,
    max_age_s: float,
) -> Detections:
    """First detection of every episode, from the lists of all units heard (their arrival times are common to all runs).

    Every list counts at the instant at which it is taken in, also beside or after a newer one of its unit. `max_age_s`
    counts from capture, on top of a list's own way to the receiver.
    """
    captured_s = heard.row_captured_s
    order, bounds = _by_object(heard, found)
    not_before_s = np.full(len(found.object_ix), -np.inf) if count_earlier else found.onset_s - _TOLERANCE_S
    shape = (heard.valid.shape[0], len(found.object_ix))
    out = Detections(np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1))
    # From when on a list is no longer gone by: at its greatest age, within a microsecond, it still is.
    arrives_s = heard.common_arrives_s
    outdated_s, cluster = arrives_s + max_age_s + 2 * _TOLERANCE_S, np.zeros(len(heard.stamp_ns), dtype=np.int64)
    place, units_in_place = cluster, heard.frame_unit_ix
    if confirm.hits > 1:  # one hit confirms at once, whatever the instants and what was there before
        outdated_s, cluster = np.minimum(newer_arrives_s(heard), outdated_s), capture_instants(heard)
        place, units_in_place = _by_unit(heard)
    rows = _Rows(
        heard.valid, arrives_s[heard.frame_ix], captured_s, outdated_s[heard.frame_ix], heard.row_unit_ix,
        cluster[heard.frame_ix], place[heard.frame_ix],
    )  # fmt: skip
    stays = _Stays(order, bounds, not_before_s, found.ended_s + _TOLERANCE_S)
    _first(rows, units_in_place, stays, confirm.hits, confirm.of, out)
    return out


def capture_instants(heard: Tracks) -> Int:
    """(F,) the capture instant each list belongs to, counted from the first; 0 for lists that never arrive.

    Captures of several units within half the shortest list period of the first one are one instant; two captures of
    one unit never are.
    """
    came = np.isfinite(heard.common_arrives_s)  # what never arrives is no capture to the receiver
    reach_s = shortest_period_s(heard) / 2 + _TOLERANCE_S
    order = np.flatnonzero(came)
    order = order[np.argsort(heard.captured_s[order], kind="stable")]
    cluster = np.zeros(len(came), dtype=np.int64)
    _cluster(heard.captured_s, heard.frame_unit_ix, np.full(len(heard.units), -1), reach_s, order, cluster)
    return cluster


def shortest_period_s(heard: Tracks) -> float:
    """The shortest of the units' list periods (each the median between two captures), 0 where there is none."""
    came = np.flatnonzero(np.isfinite(heard.common_arrives_s))
    came = came[np.lexsort((heard.captured_s[came], heard.frame_unit_ix[came]))]
    unit = heard.frame_unit_ix[came]
    same = unit[1:] == unit[:-1]
    steps_s, of = np.diff(heard.captured_s[came])[same], unit[1:][same]
    steps_s = steps_s[np.lexsort((steps_s, of))]
    _, first, count = np.unique(of, return_index=True, return_counts=True)
    medians_s = (steps_s[first + (count - 1) // 2] + steps_s[first + count // 2]) / 2
    return min(medians_s.tolist(), default=0.0)


def _by_unit(heard: Tracks) -> tuple[Int, Int]:
    """(F,) places of lists, unit by unit in order of capture, those that never arrive last; the unit at each, (F,)."""
    came = np.isfinite(heard.common_arrives_s)
    unit = np.where(came, heard.frame_unit_ix, len(heard.units))  # what never arrives is no capture to the receiver
    order = np.lexsort((heard.captured_s, unit))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return place, unit[order]


def _by_object(heard: Tracks, found: Episodes) -> tuple[Int, Int]:
    """Rows of each episode in order of arrival, then of the units: (rows,), and where each episode's begin (M + 1,)."""
    # One place more than there are objects: index −1, no truth id, has no episode.
    episode_of = np.full(int(max(found.object_ix.max(initial=-1), heard.object_ix.max(initial=-1))) + 2, -1)
    episode_of[found.object_ix] = np.arange(len(found.object_ix))
    episode = episode_of[heard.row_object_ix]
    arrives_s = heard.common_arrives_s
    rows = np.flatnonzero((episode >= 0) & np.isfinite(arrives_s)[heard.frame_ix])
    # Arrivals within a microsecond are one instant: among them the experiment's order of units decides.
    held = np.zeros(len(arrives_s), dtype=bool)
    held[heard.frame_ix[rows]] = True
    ordered = np.unique(arrives_s[held])
    instant = np.cumsum(np.diff(ordered, prepend=-np.inf) > _TOLERANCE_S)
    place = np.zeros(len(arrives_s), dtype=np.int64)
    place[held] = instant[np.searchsorted(ordered, arrives_s[held])] * len(heard.units) + heard.frame_unit_ix[held]
    # As one number, they are nearly in order.
    place_of_row = episode[rows] * ((len(ordered) + 1) * len(heard.units)) + place[heard.frame_ix[rows]]
    rows = rows[np.argsort(place_of_row, kind="stable")]
    return rows, np.searchsorted(episode[rows], np.arange(len(found.object_ix) + 1))


@nb.njit(cache=True, nogil=True)
def _cluster(captured_s: Float, unit_ix: Int, last_of: Int, reach_s: float, order: Int, out: Int) -> None:
    current, first = -1, -np.inf
    for k in order:
        if captured_s[k] > first + reach_s or last_of[unit_ix[k]] == current:
            current, first = current + 1, captured_s[k]
        out[k] = last_of[unit_ix[k]] = current


class _Rows(NamedTuple):
    # Rows P of the lists that are heard; `outdated_s`: from then on the row counts no longer.
    valid: Bool  # (S, P)
    arrives_s: Float
    captured_s: Float
    outdated_s: Float
    unit_ix: Int
    cluster: Int  # the capture instant
    place: Int  # of its list among those of its unit


class _Stays(NamedTuple):
    # Episode m: rows `order[bounds[m] : bounds[m + 1]]`, of captures and arrivals between these times.
    order: Int
    bounds: Int
    not_before_s: Float
    until_s: Float


@nb.njit(cache=True, nogil=True)
def _first(rows: _Rows, units_in_place: Int, stays: _Stays, hits: int, of: int, out: Detections) -> None:
    valid, arrives_s, captured_s, outdated_s, unit_ix, cluster, place = rows
    order, bounds, not_before_s, until_s = stays
    detection_s, newest_s, first_unit_ix = out
    held = np.empty(len(order), dtype=np.int64)  # rows that hold the object, in order of arrival
    no_group = np.zeros(len(units_in_place), dtype=np.int64)
    # Which instants hold the object; a token per episode and run spares clearing them.
    by_instant, by_list = no_group.copy(), no_group.copy()
    token = 0
    for m in range(len(bounds) - 1):
        for s in range(valid.shape[0]):
            token += 1
            n = 0
            for k in range(bounds[m], bounds[m + 1]):
                p = order[k]
                if arrives_s[p] > until_s[m]:
                    break
                if not valid[s, p] or captured_s[p] < not_before_s[m]:
                    continue
                held[n] = p
                n += 1
                if hits > 1:
                    by_instant[cluster[p]] = by_list[place[p]] = token
                    if not (
                        _confirmed(by_instant, token, cluster[p], hits, of, no_group)
                        or _confirmed(by_list, token, place[p], hits, of, units_in_place)
                    ):
                        continue
                detection_s[s, m] = arrives_s[p]
                first_unit_ix[s, m] = unit_ix[held[0]]
                # The newest capture that contributes: lists that arrive at this very instant, older ones still in use.
                newest = captured_s[p]
                for j in range(k + 1, bounds[m + 1]):
                    q = order[j]
                    if arrives_s[q] > arrives_s[p] + 1e-6:
                        break
                    if valid[s, q]:
                        newest = max(newest, captured_s[q])
                for j in range(n):
                    q = held[j]
                    if outdated_s[q] > arrives_s[p] + 1e-6 or arrives_s[q] > arrives_s[p] - 1e-6:
                        newest = max(newest, captured_s[q])
                newest_s[s, m] = newest
                break


@nb.njit(cache=True, nogil=True)
def _confirmed(marks: Int, token: int, instant: int, hits: int, of: int, group: Int) -> bool:
    # Do `hits` of some `of` consecutive instants of one group hold the object, this instant among them?
    for start in range(instant - of + 1, instant + 1):
        holding = 0
        for i in range(max(start, 0), min(start + of, len(marks))):
            if marks[i] == token and group[i] == group[instant]:
                holding += 1
        if holding >= hits:
            return True
    return False
