"""First detection of an object by match: for fusions without truth ids.

Known by the first list, available before looking ends, with an entry about the object (`metrics/matching.py`) that was
captured at or after the onset: its match, or a duplicate, for the match of a union may be a unit's older entry.
`confirm` counts captures, not messages, by the rules of `metrics/detection/by_truth_id.py`: an entry about the object
says that the capture it goes back to holds it, however often it is issued again.

How surely it was known: had entries below some existence not been listed, the detection would have come later, or
never. `Steps` says when, for every existence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.object_list import Entries, ObjectLists
from copem_replay.core.tracks import SAME_INSTANT_NS, Float, Int, Tracks
from copem_replay.metrics.config import Confirm
from copem_replay.metrics.detection.by_match_kernel import HELD, Matched, Stays, levels
from copem_replay.metrics.detection.by_truth_id import Detections, capture_instants
from copem_replay.metrics.matching import Matches

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9
_FOUND = np.dtype(
    [
        ("run_ix", "i8"), ("episode_ix", "i8"), ("existence", "f8"), ("detection_s", "f8"), ("captured_s", "f8"),
        ("unit_ix", "i8"),
    ]
)  # fmt: skip
"""A step, and what the entry that makes it says."""


@dataclass(frozen=True)
class Steps:
    """When each episode would be detected if only entries of at least some existence were listed. All (R,).

    By run, episode and time. Of one run and episode existence and time both ascend, from the detection itself on: the
    first row with as much existence as is asked for says when; where none has, it is never detected.
    """

    run_ix: Int
    episode_ix: Int
    existence: Float
    detection_s: Float


@dataclass(frozen=True)
class Captures:
    """When units made their lists, unit by unit and in order of time: (F,) each; `instant` numbers capture instants."""

    captured_s: Float
    unit_ix: Int
    instant: Int


def captures_of(heard: Tracks, *, instants: bool = True) -> Captures:
    """The captures behind the lists that were heard. `instants`: whether anything goes by which are one instant."""
    came = np.isfinite(heard.common_arrives_s)
    order = np.flatnonzero(came)
    order = order[np.lexsort((heard.captured_s[order], heard.frame_unit_ix[order]))]
    instant = capture_instants(heard)[order] if instants else np.zeros(len(order), dtype=np.int64)
    return Captures(heard.captured_s[order], heard.frame_unit_ix[order], instant)


class FirstMatches:
    """First detection of each of M episodes in S runs, of as many lists at a time as one likes.

    `captures`: what entries go back to, those of all lists. What is remembered from one time chunk of lists to the next
    is, beside what has been found, which captures hold an object more surely than it is known to be there.
    """

    def __init__(
        self, episodes: Episodes, *, runs: int, confirm: Confirm, count_earlier: bool, captures: Captures
    ) -> None:
        count = len(episodes.object_ix)
        episode_of = np.full(int(episodes.object_ix.max(initial=-1)) + 1, -1)
        episode_of[episodes.object_ix] = np.arange(count)
        not_before_s = np.full(count, -np.inf) if count_earlier else episodes.onset_s - _TOLERANCE_S
        self._stays = Stays(episode_of, not_before_s, episodes.ended_s + _TOLERANCE_S)
        self._confirm, self._captures = confirm, captures
        # Captures are numbered: the instants, which have no unit, then the lists, each its unit's.
        self._instants = int(captures.instant.max(initial=-1)) + 1
        self._group = np.concatenate([np.full(self._instants, -1), captures.unit_ix])
        self._best = np.full((runs, count), -np.inf)
        self._held = np.empty(0, dtype=HELD)
        self._found: list[Entries] = [np.empty(0, dtype=_FOUND)]

    def add(self, lists: ObjectLists, matches: Matches, issue_s: Float) -> None:
        """Take in the lists that come next. `issue_s (K,)`: when each is available, ascending."""
        # One hit confirms at once, whatever the captures.
        source = np.zeros((0, 2), dtype=np.int64)
        if self._confirm.hits > 1:
            source = _sources(lists.entries, self._captures)
            source[source[:, 1] >= 0, 1] += self._instants
        level = np.full(len(lists.entries), np.nan)
        self._held = levels(
            Matched(lists.start, lists.entries, matches.object_ix, matches.role, issue_s), self._stays,
            source, self._group, self._confirm.hits, self._confirm.of, self._best, self._held, level,
        )  # fmt: skip
        entry = np.flatnonzero(~np.isnan(level))
        # Of empty lists, which begin where the next does, the last is the one that holds the entry.
        run_ix, number = np.divmod(np.searchsorted(lists.start.ravel(), entry, side="right") - 1, lists.start.shape[1])
        found = np.empty(len(entry), dtype=_FOUND)
        found["run_ix"], found["episode_ix"] = run_ix, self._stays.episode_of[matches.object_ix[entry]]
        found["existence"], found["detection_s"] = level[entry], issue_s[number]
        found["captured_s"], found["unit_ix"] = lists.entries["captured_s"][entry], lists.entries["unit_ix"][entry]
        self._found.append(found)

    def result(self) -> tuple[Detections, Steps]:
        """The detections of the lists so far, and how they depend on the existence asked for.

        The captured instant and the first unit are those of the entry.
        """
        found = np.concatenate(self._found)
        # As they were found: each episode's in order of time.
        found = found[np.lexsort((found["episode_ix"], found["run_ix"]))]
        run_ix, episode_ix = found["run_ix"], found["episode_ix"]
        first = (np.diff(run_ix, prepend=-1) != 0) | (np.diff(episode_ix, prepend=-1) != 0)
        shape = self._best.shape
        detections = Detections(np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1))
        at = run_ix[first], episode_ix[first]
        detections.detection_s[at] = found["detection_s"][first]
        detections.captured_s[at] = found["captured_s"][first]
        detections.first_unit_ix[at] = found["unit_ix"][first]
        columns = (run_ix, episode_ix, found["existence"], found["detection_s"])
        return detections, Steps(*map(np.ascontiguousarray, columns))


def _sources(entries: Entries, captures: Captures) -> Int:
    """(N, 2) the capture instant and the list each entry goes back to, −1: none.

    That of its unit where it made one then, else the first unit's; an entry that says it was captured at another time
    goes back to the instant before, and to no list.
    """
    captured_s = entries["captured_s"]
    by_time = np.argsort(captures.captured_s, kind="stable")
    ordered_s = captures.captured_s[by_time]
    before = np.searchsorted(ordered_s, captured_s + _TOLERANCE_S, side="right") - 1
    instant = np.where(before >= 0, captures.instant[by_time[before]], -1) if len(by_time) else before
    made = np.full(len(entries), -1)
    units = np.unique(captures.unit_ix)
    for own in (True, False):
        for unit in units:
            first, last = np.searchsorted(captures.unit_ix, (unit, unit + 1))
            asked = np.flatnonzero((made < 0) & (entries["unit_ix"] == unit)) if own else np.flatnonzero(made < 0)
            at = np.searchsorted(captures.captured_s[first:last], captured_s[asked] - _TOLERANCE_S) + first
            there = at < last
            there[there] = captures.captured_s[at[there]] <= captured_s[asked[there]] + _TOLERANCE_S
            made[asked[there]] = at[there]
    instant = np.where(made >= 0, captures.instant[made], instant) if len(by_time) else instant
    return np.stack([instant, made], axis=1)
