"""First detections by truth id: the fast path for ideal fusion and the truth, where no list has to be made.

With ideal fusion an object is in the fused list whenever the receiver takes in a list that holds it, so the first
detection is read off the units' lists. It is what `by_match.py` finds in the fused lists: an object is confirmed when
`hits` of `of` consecutive turns of a unit, or instants of all, hold it (`turns.py`), by the lists that have arrived.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from copem_replay.communication.arrivals import first_newer_arrival_s
from copem_replay.core.compiled import borrowing, callee, kernel
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Tracks
from copem_replay.metrics.config import Confirm
from copem_replay.metrics.detection.turns import number_turns

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes


class FirstDetections(NamedTuple):
    """The first detection of each episode, run by run. All (S, M), NaN and −1 where not detected.

    `detection_s`: when the list that confirms the object is available; `captured_s`, `first_unit_ix`: capture and unit
    of the newest list that contributes, of lists captured together the first unit's.
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
    """The first detections (S, M) by truth id, for episodes of which each object has at most one."""
    captured_s = received.row_captured_s
    order, bounds = _group_by_episode(received, episodes)
    not_before_s = episodes.counts_from_s(count_earlier=count_earlier)
    shape = (received.valid.shape[0], len(episodes.object_ix))
    out = FirstDetections(np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1))
    # The instant from which on a list is no longer used: at its greatest age, within a microsecond, it still is.
    arrives_s = received.common_arrives_s
    outdated_s, instant = arrives_s + max_age_s + 2 * SAME_INSTANT_S, np.zeros(len(received.stamp_ns), dtype=np.int64)
    turn, unit_of_turn = instant, received.frame_unit_ix
    if confirm.hits > 1:  # one hit confirms at once, whatever the turns and the lists before
        turns, outdated_s = number_turns(received), np.minimum(first_newer_arrival_s(received), outdated_s)
        turn, instant, unit_of_turn = turns.turn, turns.list_instant, turns.unit_ix
    rows = _ListedRows(
        received.valid, arrives_s[received.frame_ix], captured_s, received.entry_captured_s,
        outdated_s[received.frame_ix], received.row_unit_ix, instant[received.frame_ix], turn[received.frame_ix],
    )  # fmt: skip
    stays = _EpisodeRows(order, bounds, not_before_s, episodes.ended_s + SAME_INSTANT_S)
    _find_first(rows, unit_of_turn, stays, confirm.hits, confirm.of, out)
    return out


def _group_by_episode(received: Tracks, episodes: Episodes) -> tuple[Int, Int]:
    """Rows by episode, in order of arrival and then of units; (M + 1,) where the rows of each episode begin."""
    # One place more than there are objects: index −1, no truth id, has no episode.
    episode_of = np.full(int(max(episodes.object_ix.max(initial=-1), received.object_ix.max(initial=-1))) + 2, -1)
    episode_of[episodes.object_ix] = np.arange(len(episodes.object_ix))
    episode = episode_of[received.row_object_ix]
    arrives_s = received.common_arrives_s
    rows = np.flatnonzero((episode >= 0) & np.isfinite(arrives_s)[received.frame_ix])
    # Arrivals within a microsecond are one instant: among them the experiment's order of units decides.
    has_rows = np.zeros(len(arrives_s), dtype=bool)
    has_rows[received.frame_ix[rows]] = True
    ordered = np.unique(arrives_s[has_rows])
    instant = np.cumsum(np.diff(ordered, prepend=-np.inf) > SAME_INSTANT_S)
    place = np.zeros(len(arrives_s), dtype=np.int64)
    place[has_rows] = (
        instant[np.searchsorted(ordered, arrives_s[has_rows])] * len(received.units) + received.frame_unit_ix[has_rows]
    )
    # Sorted as one number, as the rows are nearly in order.
    place_of_row = episode[rows] * ((len(ordered) + 1) * len(received.units)) + place[received.frame_ix[rows]]
    rows = rows[np.argsort(place_of_row, kind="stable")]
    return rows, np.searchsorted(episode[rows], np.arange(len(episodes.object_ix) + 1))


class _ListedRows(NamedTuple):
    # Rows (P,) of the lists that are received; `outdated_s`: from then on the row no longer counts.
    valid: Bool  # (S, P)
    arrives_s: Float
    captured_s: Float
    entry_s: Float  # captures of the rows themselves
    outdated_s: Float
    unit_ix: Int
    instant: Int  # of its list's turn
    turn: Int  # of its list


class _EpisodeRows(NamedTuple):
    # Episode m: rows `order[bounds[m] : bounds[m + 1]]`, captured at `not_before_s` or later, here by `until_s`.
    order: Int
    bounds: Int
    not_before_s: Float
    until_s: Float


@kernel
def _find_first(
    rows: _ListedRows, unit_of_turn: Int, episodes: _EpisodeRows, hits: int, window: int, out: FirstDetections
) -> None:
    """Fills `out` (S, M) with the first detection of each episode: confirmed by `hits` of `window` lists or turns."""
    valid, arrives_s, captured_s, entry_s, outdated_s, unit_ix, instant, turn = rows
    order, bounds, not_before_s, until_s = episodes
    detection_s, newest_s, first_unit_ix = out
    holding_rows = np.empty(len(order), dtype=np.int64)  # rows that hold the object, in order of arrival
    no_group = np.zeros(len(unit_of_turn), dtype=np.int64)  # instants are no more than turns
    # What holds the object bears the token of the episode and run, which spares clearing them.
    by_instant, by_turn = no_group.copy(), no_group.copy()
    token = 0
    for m in range(len(bounds) - 1):
        for s in range(valid.shape[0]):
            token += 1
            n = 0
            for k in range(bounds[m], bounds[m + 1]):
                p = order[k]
                if arrives_s[p] > until_s[m]:
                    break
                if not valid[s, p] or entry_s[p] < not_before_s[m]:
                    continue
                holding_rows[n] = p
                n += 1
                if hits > 1:
                    by_instant[instant[p]] = by_turn[turn[p]] = token
                    if not (
                        _is_confirmed(by_instant, token, instant[p], hits, window, no_group)
                        or _is_confirmed(by_turn, token, turn[p], hits, window, unit_of_turn)
                    ):
                        continue
                # The newest list that contributes: of those that arrive at this very instant, and older ones in use.
                newest = p
                for j in range(k + 1, bounds[m + 1]):
                    q = order[j]
                    if arrives_s[q] > arrives_s[p] + SAME_INSTANT_S:
                        break
                    if valid[s, q] and _is_newer(rows, q, newest):
                        newest = q
                for j in range(n):
                    q = holding_rows[j]
                    in_use = (
                        outdated_s[q] > arrives_s[p] + SAME_INSTANT_S or arrives_s[q] > arrives_s[p] - SAME_INSTANT_S
                    )
                    if in_use and _is_newer(rows, q, newest):
                        newest = q
                detection_s[s, m], newest_s[s, m] = arrives_s[p], captured_s[newest]
                first_unit_ix[s, m] = unit_ix[newest]
                break


@borrowing
def _is_newer(rows: _ListedRows, p: int, q: int) -> bool:
    # Whether row p was captured after row q; of rows captured together the first unit's is the newer.
    later_s = rows.captured_s[p] - rows.captured_s[q]
    return bool(later_s > SAME_INSTANT_S or (later_s >= -SAME_INSTANT_S and rows.unit_ix[p] < rows.unit_ix[q]))


@callee
def _is_confirmed(marks: Int, token: int, instant: int, hits: int, window: int, group: Int) -> bool:
    # Whether `hits` of `window` consecutive instants or turns of one group, this one among them, hold the object.
    for start in range(instant - window + 1, instant + 1):
        holding = 0
        for i in range(max(start, 0), min(start + window, len(marks))):
            if marks[i] == token and group[i] == group[instant]:
                holding += 1
        if holding >= hits:
            return True
    return False
