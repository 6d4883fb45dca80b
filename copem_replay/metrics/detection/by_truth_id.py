"""First detections by truth id: for ideal fusion and the truth, whose lists say which objects they hold.

With ideal fusion an object is in the fused list whenever the receiver takes in a list that holds it, so the first
detection is read off the units' lists; every other fusion is judged by its own lists (`by_match.py`).

`confirm` counts captures, not messages: the object is confirmed when `hits` of `of` consecutive capture instants hold
it, by the lists that have arrived. Captures of several units within half a list period are one instant. What confirms
in the lists of one unit alone confirms also where others have joined it, whatever their rates.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from copem_replay.communication.arrivals import first_newer_arrival_s
from copem_replay.core.compiled import kernel
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Tracks
from copem_replay.metrics.config import Confirm

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes


class FirstDetections(NamedTuple):
    """The first detection of each episode, run by run. All (S, M), NaN and −1 where not detected.

    `detection_s`: when the list that confirms the object is available; `captured_s`: the newest capture that
    contributed; `first_unit_ix`: the unit of the first list that holds the object.
    """

    detection_s: Float
    captured_s: Float
    first_unit_ix: Int


def detect_by_truth_id(
    received: Tracks,
    episodes: Episodes,
    *,
    confirm: Confirm,
    count_earlier: bool,
    max_age_s: float,
) -> FirstDetections:
    """First detection of every episode, from the lists of all units as received, whose arrival times all runs share.

    Every list counts at the instant at which the receiver takes it in, also beside or after a newer one of its unit.
    `max_age_s` counts from capture, on top of a list's own way to the receiver.
    """
    parts = [
        _detect_first(received, one, confirm=confirm, count_earlier=count_earlier, max_age_s=max_age_s)
        for _, one in episodes.passes
    ]
    return FirstDetections(*(episodes.join_passes(columns) for columns in zip(*parts, strict=True)))


def _detect_first(
    received: Tracks, episodes: Episodes, *, confirm: Confirm, count_earlier: bool, max_age_s: float
) -> FirstDetections:
    """The same of episodes with one of each object at most."""
    captured_s = received.row_captured_s
    order, bounds = _group_by_episode(received, episodes)
    not_before_s = episodes.counts_from_s(count_earlier=count_earlier)
    shape = (received.valid.shape[0], len(episodes.object_ix))
    out = FirstDetections(np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1))
    # The instant from which on a list is no longer used: at its greatest age, within a microsecond, it still is.
    arrives_s = received.common_arrives_s
    outdated_s, cluster = arrives_s + max_age_s + 2 * SAME_INSTANT_S, np.zeros(len(received.stamp_ns), dtype=np.int64)
    place, units_in_place = cluster, received.frame_unit_ix
    if confirm.hits > 1:  # one hit confirms at once, whatever the instants and the lists before
        outdated_s, cluster = np.minimum(first_newer_arrival_s(received), outdated_s), capture_instants(received)
        place, units_in_place = _sort_by_unit(received)
    rows = _ListedRows(
        received.valid, arrives_s[received.frame_ix], captured_s, outdated_s[received.frame_ix], received.row_unit_ix,
        cluster[received.frame_ix], place[received.frame_ix],
    )  # fmt: skip
    stays = _EpisodeRows(order, bounds, not_before_s, episodes.ended_s + SAME_INSTANT_S)
    _find_first(rows, units_in_place, stays, confirm.hits, confirm.of, out)
    return out


def capture_instants(received: Tracks) -> Int:
    """(F,) the capture instant each list belongs to, counted from the first; 0 for lists that never arrive.

    Captures of several units within half the shortest list period of the first one are one instant; two captures of
    one unit never are.
    """
    arrives = np.isfinite(received.common_arrives_s)  # what never arrives is no capture to the receiver
    reach_s = shortest_period_s(received) / 2 + SAME_INSTANT_S
    order = np.flatnonzero(arrives)
    order = order[np.argsort(received.captured_s[order], kind="stable")]
    cluster = np.zeros(len(arrives), dtype=np.int64)
    _cluster_captures(
        received.captured_s, received.frame_unit_ix, np.full(len(received.units), -1), reach_s, order, cluster
    )
    return cluster


def shortest_period_s(received: Tracks) -> float:
    """The shortest of the units' list periods in seconds, each the median between two captures; 0 without any."""
    lists = np.flatnonzero(np.isfinite(received.common_arrives_s))
    lists = lists[np.lexsort((received.captured_s[lists], received.frame_unit_ix[lists]))]
    unit = received.frame_unit_ix[lists]
    same = unit[1:] == unit[:-1]
    steps_s, unit_of_step = np.diff(received.captured_s[lists])[same], unit[1:][same]
    steps_s = steps_s[np.lexsort((steps_s, unit_of_step))]
    _, first, count = np.unique(unit_of_step, return_index=True, return_counts=True)
    medians_s = (steps_s[first + (count - 1) // 2] + steps_s[first + count // 2]) / 2
    return min(medians_s.tolist(), default=0.0)


def _sort_by_unit(received: Tracks) -> tuple[Int, Int]:
    """(F,) the place of each list, unit by unit in order of capture, lists that never arrive last; (F,) the unit at
    each.
    """
    arrives = np.isfinite(received.common_arrives_s)
    unit = np.where(
        arrives, received.frame_unit_ix, len(received.units)
    )  # what never arrives is no capture to the receiver
    order = np.lexsort((received.captured_s, unit))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return place, unit[order]


def _group_by_episode(received: Tracks, episodes: Episodes) -> tuple[Int, Int]:
    """Rows, episode by episode, in order of arrival and then of units; where those of each episode begin, (M + 1,)."""
    # One place more than there are objects: index −1, no truth id, has no episode.
    episode_of = np.full(int(max(episodes.object_ix.max(initial=-1), received.object_ix.max(initial=-1))) + 2, -1)
    episode_of[episodes.object_ix] = np.arange(len(episodes.object_ix))
    episode = episode_of[received.row_object_ix]
    arrives_s = received.common_arrives_s
    rows = np.flatnonzero((episode >= 0) & np.isfinite(arrives_s)[received.frame_ix])
    # Arrivals within a microsecond are one instant: among them the experiment's order of units decides.
    held = np.zeros(len(arrives_s), dtype=bool)
    held[received.frame_ix[rows]] = True
    ordered = np.unique(arrives_s[held])
    instant = np.cumsum(np.diff(ordered, prepend=-np.inf) > SAME_INSTANT_S)
    place = np.zeros(len(arrives_s), dtype=np.int64)
    place[held] = (
        instant[np.searchsorted(ordered, arrives_s[held])] * len(received.units) + received.frame_unit_ix[held]
    )
    # Sorted as one number, as the rows are nearly in order.
    place_of_row = episode[rows] * ((len(ordered) + 1) * len(received.units)) + place[received.frame_ix[rows]]
    rows = rows[np.argsort(place_of_row, kind="stable")]
    return rows, np.searchsorted(episode[rows], np.arange(len(episodes.object_ix) + 1))


@kernel
def _cluster_captures(captured_s: Float, unit_ix: Int, last_of: Int, reach_s: float, order: Int, out: Int) -> None:
    current, first = -1, -np.inf
    for k in order:
        if captured_s[k] > first + reach_s or last_of[unit_ix[k]] == current:
            current, first = current + 1, captured_s[k]
        out[k] = last_of[unit_ix[k]] = current


class _ListedRows(NamedTuple):
    # Rows (P,) of the lists that are received; `outdated_s`: from then on the row no longer counts.
    valid: Bool  # (S, P)
    arrives_s: Float
    captured_s: Float
    outdated_s: Float
    unit_ix: Int
    cluster: Int  # the capture instant
    place: Int  # of its list among those of its unit


class _EpisodeRows(NamedTuple):
    # Episode m: rows `order[bounds[m] : bounds[m + 1]]`, captured at `not_before_s` or later, here by `until_s`.
    order: Int
    bounds: Int
    not_before_s: Float
    until_s: Float


@kernel
def _find_first(
    rows: _ListedRows, units_in_place: Int, stays: _EpisodeRows, hits: int, of: int, out: FirstDetections
) -> None:
    valid, arrives_s, captured_s, outdated_s, unit_ix, cluster, place = rows
    order, bounds, not_before_s, until_s = stays
    detection_s, newest_s, first_unit_ix = out
    held = np.empty(len(order), dtype=np.int64)  # rows that hold the object, in order of arrival
    no_group = np.zeros(len(units_in_place), dtype=np.int64)
    # The instants that hold the object bear the token of the episode and run, which spares clearing them.
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
                        _is_confirmed(by_instant, token, cluster[p], hits, of, no_group)
                        or _is_confirmed(by_list, token, place[p], hits, of, units_in_place)
                    ):
                        continue
                detection_s[s, m] = arrives_s[p]
                first_unit_ix[s, m] = unit_ix[held[0]]
                # The newest capture that contributes: lists that arrive at this very instant, older ones still in use.
                newest = captured_s[p]
                for j in range(k + 1, bounds[m + 1]):
                    q = order[j]
                    if arrives_s[q] > arrives_s[p] + SAME_INSTANT_S:
                        break
                    if valid[s, q]:
                        newest = max(newest, captured_s[q])
                for j in range(n):
                    q = held[j]
                    if outdated_s[q] > arrives_s[p] + SAME_INSTANT_S or arrives_s[q] > arrives_s[p] - SAME_INSTANT_S:
                        newest = max(newest, captured_s[q])
                newest_s[s, m] = newest
                break


@kernel
def _is_confirmed(marks: Int, token: int, instant: int, hits: int, of: int, group: Int) -> bool:
    # Whether `hits` of `of` consecutive instants of one group, this instant among them, hold the object.
    for start in range(instant - of + 1, instant + 1):
        holding = 0
        for i in range(max(start, 0), min(start + of, len(marks))):
            if marks[i] == token and group[i] == group[instant]:
                holding += 1
        if holding >= hits:
            return True
    return False
