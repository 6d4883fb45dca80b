"""First detections by match: for fusions without truth ids.

An object is detected by the first list, available before its episode ends, with an entry about the object
(`metrics/matching.py`) that was captured at or after the onset: its match, or a duplicate, for the match of a union may
be a unit's older entry.
`confirm` counts captures, not messages, by the rules of `metrics/detection/by_truth_id.py`: an entry about the object
says that the capture it goes back to holds it, however often it is issued again.

If only entries of at least some existence were listed, the detection would come later, or never: `DetectionSteps` says
when, for every existence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.compiled import kernel
from copem_replay.core.object_list import Entries, ObjectLists
from copem_replay.core.tracks import SAME_INSTANT_S, Float, Int, Tracks
from copem_replay.metrics.config import Confirm
from copem_replay.metrics.detection.by_truth_id import FirstDetections, capture_instants
from copem_replay.metrics.matching import DUPLICATE, MATCH, Matches

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes


HELD = np.dtype([("run_ix", "i8"), ("episode_ix", "i8"), ("capture", "i8"), ("existence", "f8")])
"""The highest existence with which a capture holds the object of an episode."""


class MatchedLists(NamedTuple):
    """Lists of S runs and their matches, columns of `ObjectLists` and `Matches`; `issue_s`: when available."""

    start: Int  # (S, K + 1)
    entries: Entries  # (N,)
    object_ix: Int  # (N,)
    role: NDArray[np.int8]  # (N,)
    issue_s: Float  # (K,)


class EpisodeWindows(NamedTuple):
    """Episodes by object, −1: none, and for each the first capture and the last available list that count."""

    episode_of: Int  # (C,)
    not_before_s: Float  # (M,)
    until_s: Float  # (M,)


@kernel
def find_existence_levels(
    lists: MatchedLists, stays: EpisodeWindows, source: Int, group: Int, hits: int, of: int, best: Float,
    held: NDArray[Any], level: Float,
) -> NDArray[Any]:  # fmt: skip
    """Write, at each entry that makes an object known at a higher existence than before, that existence to `level
    (N,)`.

    `source (N, 2)`: captures an entry goes back to, −1: none; `group (captures,)`: the unit of each capture.
    Carried over: `best (S, M)`, the existence at which each object is known; `held`, by run and episode, returned as it
    is after these lists. A capture that holds an object with no higher existence than it is known at is dropped:
    whatever it would confirm, as many hits have confirmed already.
    """
    start, entries, role = lists.start, lists.entries, lists.role
    S, M = best.shape
    most = 0
    for s in range(S):
        most = max(most, start[s, -1] - start[s, 0])
    episode, first = np.empty(most, np.int64), np.empty(M + 1, np.int64)
    row, number = np.empty(most, np.int64), np.empty(most, np.int64)
    holds = np.full(len(group) if hits > 1 else 0, -np.inf)  # by capture, of the episode at hand
    used = np.empty(len(held) + 2 * most if hits > 1 else 0, np.int64)
    within = np.empty(of)
    carried, kept, h = np.empty(len(held), HELD), 0, 0
    for s in range(S):
        _sort_by_episode(s, lists, stays, episode, first, row, number)
        for m in range(M):
            n = 0
            while h < len(held) and held[h].run_ix == s and held[h].episode_ix == m:
                used[n] = held[h].capture
                holds[used[n]] = held[h].existence
                n += 1
                h += 1
            place = first[m]
            while place < first[m + 1]:
                # What one list says of the object, and the entry that stands for it.
                k, standing, reached = number[place], row[place], -np.inf
                while place < first[m + 1] and number[place] == k:
                    i = row[place]
                    place += 1
                    if _is_preferred(entries, role, i, standing):
                        standing = i
                    existence = entries[i].existence
                    if hits == 1:
                        reached = max(reached, existence)
                        continue
                    for c in source[i]:
                        if c < 0 or existence <= max(holds[c], best[s, m]):
                            continue
                        if holds[c] == -np.inf:
                            used[n] = c
                            n += 1
                        holds[c] = existence
                        reached = max(reached, _find_confirming_existence(holds, c, hits, of, group, within))
                if reached > best[s, m]:
                    best[s, m] = level[standing] = reached
            if kept + n > len(carried):
                grown = np.empty(2 * (kept + n), HELD)
                for c in range(kept):
                    grown[c] = carried[c]
                carried = grown
            for c in used[:n]:
                if holds[c] > best[s, m]:
                    record = carried[kept]
                    record.run_ix, record.episode_ix, record.capture, record.existence = s, m, c, holds[c]
                    kept += 1
                holds[c] = -np.inf
    return carried[:kept].copy()


@kernel
def _sort_by_episode(
    s: int, lists: MatchedLists, stays: EpisodeWindows, episode: Int, first: Int, row: Int, number: Int
) -> None:
    # Out: the entries of run s that count, episode by episode and in each list by list: `row`, and `number` of the
    # list.
    start, entries, object_ix, role, issue_s = lists.start[s], lists.entries, lists.object_ix, lists.role, lists.issue_s
    episode_of, not_before_s, until_s = stays.episode_of, stays.not_before_s, stays.until_s
    first[:] = 0
    for k in range(len(issue_s)):
        for i in range(start[k], start[k + 1]):
            about = role[i] == MATCH or role[i] == DUPLICATE
            m = episode_of[object_ix[i]] if about and object_ix[i] < len(episode_of) else -1
            if m >= 0 and (issue_s[k] > until_s[m] or entries[i].captured_s < not_before_s[m]):
                m = -1
            episode[i - start[0]] = m
            if m >= 0:
                first[m] += 1
    n = 0
    for m in range(len(first)):
        n, first[m] = n + first[m], n
    for k in range(len(issue_s)):
        for i in range(start[k], start[k + 1]):
            m = episode[i - start[0]]
            if m >= 0:
                row[first[m]], number[first[m]] = i, k
                first[m] += 1
    # Each element has advanced to where the next episode begins.
    for m in range(len(first) - 1, 0, -1):
        first[m] = first[m - 1]
    first[0] = 0


@kernel
def _is_preferred(entries: Entries, role: NDArray[np.int8], i: int, j: int) -> bool:
    # Of two entries about one object: the match, the higher existence, the newer capture, the first unit's.
    one, other = entries[i], entries[j]
    if role[i] != role[j]:
        return bool(role[i] < role[j])
    if one.existence != other.existence:
        return bool(one.existence > other.existence)
    if one.captured_s != other.captured_s:
        return bool(one.captured_s > other.captured_s)
    return bool(one.unit_ix < other.unit_ix)


@kernel
def _find_confirming_existence(existence: Float, capture: int, hits: int, of: int, group: Int, held: Float) -> float:
    # The highest existence with which `hits` of `of` consecutive captures of a group, this one among them, hold the
    # object.
    highest = -np.inf
    for first in range(max(capture - of + 1, 0), capture + 1):
        n = 0
        for q in range(first, min(first + of, len(existence))):
            if group[q] == group[capture] and existence[q] > -np.inf:
                place = n
                while place > 0 and held[place - 1] > existence[q]:  # ascending
                    held[place] = held[place - 1]
                    place -= 1
                held[place] = existence[q]
                n += 1
        if n >= hits:
            highest = max(highest, held[n - hits])
    return highest


_STEP = np.dtype(
    [
        ("run_ix", "i8"), ("episode_ix", "i8"), ("existence", "f8"), ("detection_s", "f8"), ("captured_s", "f8"),
        ("unit_ix", "i8"),
    ]
)  # fmt: skip
"""A step of `DetectionSteps`, with capture and unit of the entry that makes it."""


@dataclass(frozen=True)
class DetectionSteps:
    """When each episode would be detected if only entries of at least some existence were listed. All (R,).

    By run, episode and time. Within one run and episode existence and time both ascend, from the detection itself on:
    the first row with at least the existence asked for has the time; where there is none, the object is never detected.
    """

    run_ix: Int
    episode_ix: Int
    existence: Float
    detection_s: Float


@dataclass(frozen=True)
class CaptureInstants:
    """Captures of lists (F,), unit by unit and in order of time; `instant`: number of the capture instant."""

    captured_s: Float
    unit_ix: Int
    instant: Int


def collect_captures(received: Tracks, *, instants: bool = True) -> CaptureInstants:
    """The captures of the lists that arrive. `instants`: whether capture instants are needed; else all are 0."""
    arrives = np.isfinite(received.common_arrives_s)
    order = np.flatnonzero(arrives)
    order = order[np.lexsort((received.captured_s[order], received.frame_unit_ix[order]))]
    instant = capture_instants(received)[order] if instants else np.zeros(len(order), dtype=np.int64)
    return CaptureInstants(received.captured_s[order], received.frame_unit_ix[order], instant)


class FirstMatches:
    """First detection of each of M episodes in S runs; lists are added in time chunks of any size.

    `captures`: those of all lists, to which entries go back. Beside the detections so far, the captures that hold an
    object with a higher existence than it is known at are kept from one time chunk to the next.
    """

    def __init__(
        self, episodes: Episodes, *, runs: int, confirm: Confirm, count_earlier: bool, captures: CaptureInstants
    ) -> None:
        count = len(episodes.object_ix)
        episode_of = np.full(int(episodes.object_ix.max(initial=-1)) + 1, -1)
        episode_of[episodes.object_ix] = np.arange(count)
        not_before_s = episodes.counts_from_s(count_earlier=count_earlier)
        self._stays = EpisodeWindows(episode_of, not_before_s, episodes.ended_s + SAME_INSTANT_S)
        self._confirm, self._captures = confirm, captures
        # Captures are numbered: first the capture instants, without a unit, then the lists of the units.
        self._instants = int(captures.instant.max(initial=-1)) + 1
        self._group = np.concatenate([np.full(self._instants, -1), captures.unit_ix])
        self._best = np.full((runs, count), -np.inf)
        self._held = np.empty(0, dtype=HELD)
        self._steps: list[Entries] = [np.empty(0, dtype=_STEP)]

    def add(self, lists: ObjectLists, matches: Matches, issue_s: Float) -> None:
        """Take in the lists that come next. `issue_s (K,)`: when each is available, ascending."""
        # One hit confirms at once, whatever the captures.
        source = np.zeros((0, 2), dtype=np.int64)
        if self._confirm.hits > 1:
            source = _trace_sources(lists.entries, self._captures)
            source[source[:, 1] >= 0, 1] += self._instants
        level = np.full(len(lists.entries), np.nan)
        self._held = find_existence_levels(
            MatchedLists(lists.start, lists.entries, matches.object_ix, matches.role, issue_s), self._stays,
            source, self._group, self._confirm.hits, self._confirm.of, self._best, self._held, level,
        )  # fmt: skip
        entry = np.flatnonzero(~np.isnan(level))
        # Of empty lists, which begin where the next does, the last is the one that holds the entry.
        run_ix, number = np.divmod(np.searchsorted(lists.start.ravel(), entry, side="right") - 1, lists.start.shape[1])
        steps = np.empty(len(entry), dtype=_STEP)
        steps["run_ix"], steps["episode_ix"] = run_ix, self._stays.episode_of[matches.object_ix[entry]]
        steps["existence"], steps["detection_s"] = level[entry], issue_s[number]
        steps["captured_s"], steps["unit_ix"] = lists.entries["captured_s"][entry], lists.entries["unit_ix"][entry]
        self._steps.append(steps)

    def result(self) -> tuple[FirstDetections, DetectionSteps]:
        """The detections of the lists so far, and their steps by existence.

        Captured instant and first unit are those of the entry that makes the detection.
        """
        steps = np.concatenate(self._steps)
        # The sort is stable: within an episode the steps stay in order of time.
        steps = steps[np.lexsort((steps["episode_ix"], steps["run_ix"]))]
        run_ix, episode_ix = steps["run_ix"], steps["episode_ix"]
        first = (np.diff(run_ix, prepend=-1) != 0) | (np.diff(episode_ix, prepend=-1) != 0)
        shape = self._best.shape
        detections = FirstDetections(np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1))
        cells = run_ix[first], episode_ix[first]
        detections.detection_s[cells] = steps["detection_s"][first]
        detections.captured_s[cells] = steps["captured_s"][first]
        detections.first_unit_ix[cells] = steps["unit_ix"][first]
        columns = (run_ix, episode_ix, steps["existence"], steps["detection_s"])
        return detections, DetectionSteps(*map(np.ascontiguousarray, columns))


def _trace_sources(entries: Entries, captures: CaptureInstants) -> Int:
    """(N, 2) the capture instant and the list that each entry goes back to, −1: none.

    The list is that of the entry's unit at its capture, else that of the first unit with a list then; an entry with
    another capture goes back to the instant before it, and to no list.
    """
    captured_s = entries["captured_s"]
    by_time = np.argsort(captures.captured_s, kind="stable")
    ordered_s = captures.captured_s[by_time]
    before = np.searchsorted(ordered_s, captured_s + SAME_INSTANT_S, side="right") - 1
    instant = np.where(before >= 0, captures.instant[by_time[before]], -1) if len(by_time) else before
    list_ix = np.full(len(entries), -1)
    units = np.unique(captures.unit_ix)
    for own in (True, False):
        for unit in units:
            first, last = np.searchsorted(captures.unit_ix, (unit, unit + 1))
            rows = np.flatnonzero((list_ix < 0) & (entries["unit_ix"] == unit)) if own else np.flatnonzero(list_ix < 0)
            place = np.searchsorted(captures.captured_s[first:last], captured_s[rows] - SAME_INSTANT_S) + first
            matches = place < last
            matches[matches] = captures.captured_s[place[matches]] <= captured_s[rows[matches]] + SAME_INSTANT_S
            list_ix[rows[matches]] = place[matches]
    instant = np.where(list_ix >= 0, captures.instant[list_ix], instant) if len(by_time) else instant
    return np.stack([instant, list_ix], axis=1)
