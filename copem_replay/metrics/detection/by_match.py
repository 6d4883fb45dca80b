"""First detections by match: of fused lists whose entries have been matched with the truth, whatever the fusion.

An object is detected by the first list, available before its episode ends, with an entry about the object, its match or
a duplicate (`metrics/matching.py`), that goes back to a list which holds the object and was captured at or after the
onset (`metrics/origin.py`).
`confirm` counts turns of units, and instants of all (`metrics/detection/turns.py`): of the lists that an entry about
the object goes back to, those that hold it have their turn counted, once, however often the entry is issued.

If only entries of at least some existence were listed, the detection would come later, or never: `DetectionSteps` says
when, for every existence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.compiled import borrowing, callee, kernel
from copem_replay.core.object_list import Entries, ObjectLists
from copem_replay.core.tracks import SAME_INSTANT_S, Float, Int
from copem_replay.metrics.config import Confirm
from copem_replay.metrics.detection.by_truth_id import FirstDetections
from copem_replay.metrics.detection.turns import Turns
from copem_replay.metrics.matching import DUPLICATE, MATCH, Matches
from copem_replay.metrics.origin import GoesBack, Holdings, Origins, find_holding_lists

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes


HELD = np.dtype([("run_ix", "i8"), ("episode_ix", "i8"), ("turn", "i8"), ("existence", "f8")])
"""The highest existence with which a turn, or an instant, holds the object of an episode."""


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


class Confirming(NamedTuple):
    """What `hits` of `of` are counted of: first the instants, group −1, then the turns, group the unit of each."""

    hits: int
    of: int
    group: Int  # (C,)
    counts: Int  # (F, 2) instant and turn of each list


@kernel
def find_existence_levels(
    lists: MatchedLists, episodes: EpisodeWindows, origins: Origins, confirming: Confirming, best: Float,
    carry: NDArray[Any], level: Float, by_list: Int,
) -> NDArray[Any]:  # fmt: skip
    """Find each entry (N,) that makes an object known at a higher existence than any entry before it.

    Out: `level (N,)`, that existence; `by_list (N,)`, the newest list that holds the object and from which such entries
    come. Updated from chunk to chunk: `best (S, M)`, the highest existence so far; `carry`, the turns that still count,
    by run and episode, whose new state is returned. A turn whose existence is not above `best` is dropped.
    """
    S, M = best.shape
    most = 0
    for s in range(S):
        most = max(most, lists.start[s, -1] - lists.start[s, 0])
    episode, first = np.empty(most, np.int64), np.empty(M + 1, np.int64)
    row, number = np.empty(most, np.int64), np.empty(most, np.int64)
    holds = np.full(len(confirming.group), -np.inf)  # by turn, of the episode at hand
    turns, scratch = np.empty(len(holds), np.int64), np.empty(confirming.of)
    carried, n_carried, h = np.empty(len(carry), HELD), 0, 0
    for s in range(S):
        _sort_by_episode(s, lists, episodes, episode, first, row, number)
        for m in range(M):
            n = 0
            while h < len(carry) and carry[h].run_ix == s and carry[h].episode_ix == m:
                turns[n] = carry[h].turn
                holds[turns[n]] = carry[h].existence
                n += 1
                h += 1
            rows, numbers = row[first[m] : first[m + 1]], number[first[m] : first[m + 1]]
            n = _take_in(
                s, rows, numbers, lists, episodes.not_before_s[m], origins, confirming, best[s, m : m + 1], holds,
                turns, n, scratch, level, by_list,
            )  # fmt: skip
            if n_carried + n > len(carried):
                grown = np.empty(2 * (n_carried + n), HELD)
                for c in range(n_carried):
                    grown[c] = carried[c]
                carried = grown
            for c in turns[:n]:
                if holds[c] > best[s, m]:
                    record = carried[n_carried]
                    record.run_ix, record.episode_ix, record.turn, record.existence = s, m, c, holds[c]
                    n_carried += 1
                holds[c] = -np.inf
    return carried[:n_carried].copy()


@borrowing
def _take_in(
    s: int, rows: Int, numbers: Int, lists: MatchedLists, not_before_s: float, origins: Origins,
    confirming: Confirming, best: Float, holds: Float, turns: Int, n: int, scratch: Float, level: Float, by_list: Int,
) -> int:  # fmt: skip
    """Takes in the entries `rows` about one object, list by list: raises `best (1,)`, fills `level` and `by_list` by
    entry. Returns how many `turns` hold the object; `n`: before.
    """
    place = 0
    while place < len(rows):
        k, first_row, reached, newest = numbers[place], rows[place], best[0], -1
        while place < len(rows) and numbers[place] == k:
            i = rows[place]
            place += 1
            existence = lists.entries[i].existence
            if existence <= best[0]:
                continue
            count = find_holding_lists(origins, s, k, i, lists.object_ix[i], not_before_s, False)
            for a in origins.holdings.holding[:count]:
                if _is_newer(origins.holdings, a, newest):
                    newest = a
                if confirming.hits == 1:
                    reached = max(reached, existence)
                    continue
                for c in confirming.counts[origins.holdings.frame[a]]:
                    if existence <= max(holds[c], best[0]):
                        continue
                    if holds[c] == -np.inf:
                        turns[n] = c
                        n += 1
                    holds[c] = existence
                    reached = max(reached, _find_confirming_existence(holds, c, confirming, scratch))
        if reached > best[0]:
            best[0] = level[first_row] = reached
            by_list[first_row] = newest
    return n


@borrowing
def _is_newer(holdings: Holdings, a: int, b: int) -> bool:
    # Whether list a was captured after list b, −1: none; of lists captured together the first unit's is the newer.
    if b < 0:
        return True
    later_s = holdings.captured_s[a] - holdings.captured_s[b]
    return bool(later_s > SAME_INSTANT_S or (later_s >= -SAME_INSTANT_S and a < b))


@callee
def _sort_by_episode(
    s: int, lists: MatchedLists, episodes: EpisodeWindows, episode: Int, first: Int, row: Int, number: Int
) -> None:
    """Fills `row` with the entries of run s that count, by episode and then by list, and `number` with their lists;
    `first`: where each episode begins.
    """
    start, object_ix, role, issue_s = lists.start[s], lists.object_ix, lists.role, lists.issue_s
    episode_of, until_s = episodes.episode_of, episodes.until_s
    first[:] = 0
    for k in range(len(issue_s)):
        for i in range(start[k], start[k + 1]):
            about = role[i] == MATCH or role[i] == DUPLICATE
            m = episode_of[object_ix[i]] if about and object_ix[i] < len(episode_of) else -1
            if m >= 0 and issue_s[k] > until_s[m]:
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


@borrowing
def _find_confirming_existence(existence: Float, turn: int, confirming: Confirming, scratch: Float) -> float:
    """The highest existence at which `hits` of `window` consecutive turns of a group, `turn` among them, hold the
    object; −inf: fewer do. `scratch`: room for as many.
    """
    highest, hits, window, group = -np.inf, confirming.hits, confirming.of, confirming.group
    for first in range(max(turn - window + 1, 0), turn + 1):
        n = 0
        for q in range(first, min(first + window, len(existence))):
            if group[q] == group[turn] and existence[q] > -np.inf:
                place = n
                while place > 0 and scratch[place - 1] > existence[q]:  # ascending
                    scratch[place] = scratch[place - 1]
                    place -= 1
                scratch[place] = existence[q]
                n += 1
        if n >= hits:
            highest = max(highest, scratch[n - hits])
    return highest


_STEP = np.dtype(
    [
        ("run_ix", "i8"), ("episode_ix", "i8"), ("existence", "f8"), ("detection_s", "f8"), ("captured_s", "f8"),
        ("unit_ix", "i8"),
    ]
)  # fmt: skip
"""A step of `DetectionSteps`, with capture and unit of the list that it goes back to."""


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


class FirstMatches:
    """First detection of each of M episodes in S runs; lists are added in time chunks of any size.

    `turns`: of all lists that entries go back to; None: one hit confirms, whatever the turns. Beside the detections so
    far, the turns that hold an object with a higher existence than it is known at are kept from one time chunk to the
    next.
    """

    def __init__(
        self, episodes: Episodes, *, runs: int, confirm: Confirm, count_earlier: bool, turns: Turns | None
    ) -> None:
        count = len(episodes.object_ix)
        episode_of = np.full(int(episodes.object_ix.max(initial=-1)) + 1, -1)
        episode_of[episodes.object_ix] = np.arange(count)
        not_before_s = episodes.counts_from_s(count_earlier=count_earlier)
        self._stays = EpisodeWindows(episode_of, not_before_s, episodes.ended_s + SAME_INSTANT_S)
        self._confirming = Confirming(confirm.hits, confirm.of, *_number_counts(turns if confirm.hits > 1 else None))
        self._best = np.full((runs, count), -np.inf)
        self._held = np.empty(0, dtype=HELD)
        self._steps: list[Entries] = [np.empty(0, dtype=_STEP)]

    def add(self, lists: ObjectLists, matches: Matches, issue_s: Float, origins: Origins) -> None:
        """Take in the lists that come next, with their matches. `issue_s (K,)`: when each is available, ascending."""
        level, by_list = np.full(len(lists.entries), np.nan), np.full(len(lists.entries), -1)
        self._held = find_existence_levels(
            MatchedLists(lists.start, lists.entries, matches.object_ix, matches.role, issue_s), self._stays, origins,
            self._confirming, self._best, self._held, level, by_list,
        )  # fmt: skip
        entry = np.flatnonzero(~np.isnan(level))
        # Of empty lists, which begin where the next does, the last is the one that holds the entry.
        run_ix, number = np.divmod(np.searchsorted(lists.start.ravel(), entry, side="right") - 1, lists.start.shape[1])
        steps = np.empty(len(entry), dtype=_STEP)
        steps["run_ix"], steps["episode_ix"] = run_ix, self._stays.episode_of[matches.object_ix[entry]]
        steps["existence"], steps["detection_s"] = level[entry], issue_s[number]
        if origins.holdings.goes_back == GoesBack.TO_NEWEST:
            steps["captured_s"] = origins.holdings.captured_s[by_list[entry]]
            steps["unit_ix"] = origins.holdings.unit_ix[by_list[entry]]
        else:  # a stack does not say whose lists contribute
            steps["captured_s"], steps["unit_ix"] = lists.entries["captured_s"][entry], -1
        self._steps.append(steps)

    def result(self) -> tuple[FirstDetections, DetectionSteps]:
        """The first detections (S, M) of the lists so far, and each step by which the best existence rose.

        Capture and unit are those of the newest list that makes the detection; of a stack's output the capture of its
        entry, and no unit.
        """
        steps = np.concatenate(self._steps)
        # The sort is stable: within an episode the steps stay in order of time.
        steps = steps[np.lexsort((steps["episode_ix"], steps["run_ix"]))]
        run_ix, episode_ix = steps["run_ix"], steps["episode_ix"]
        is_first_step = (np.diff(run_ix, prepend=-1) != 0) | (np.diff(episode_ix, prepend=-1) != 0)
        shape = self._best.shape
        detections = FirstDetections(np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1))
        cells = run_ix[is_first_step], episode_ix[is_first_step]
        detections.detection_s[cells] = steps["detection_s"][is_first_step]
        detections.captured_s[cells] = steps["captured_s"][is_first_step]
        detections.first_unit_ix[cells] = steps["unit_ix"][is_first_step]
        columns = (run_ix, episode_ix, steps["existence"], steps["detection_s"])
        return detections, DetectionSteps(*map(np.ascontiguousarray, columns))


def _number_counts(turns: Turns | None) -> tuple[Int, Int]:
    """(C,) the groups of instants and turns, and (F, 2) the instant and the turn of each list, as `Confirming` says."""
    if turns is None:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 2), dtype=np.int64)
    instants = int(turns.instant.max(initial=-1)) + 1
    counts = np.stack([turns.list_instant, turns.turn + instants], axis=1)
    return np.concatenate([np.full(instants, -1), turns.unit_ix]), counts
