"""What a receiver holds: how far off the newest list is at every frame of the truth, between two lists too.

Two configurations that issue lists at other instants have no list in common, but both hold one at any time. They are
compared at the *frames* of the truth, thinned to ten a second and the same for all configurations. At each frame:

- *held* is the newest list available by then. Where it has been available for longer than `max_age_s` there is none:
  what is held is empty. Before its first list a configuration has issued nothing, and no frame counts.
- An entry keeps the object that its own list gave it, at the instant the entry tells of; it is never matched again.
- *Error* (m): the entry's position as it stands in the list, minus the truth at the frame. No gate, no extrapolation:
  of an object at constant velocity v and an entry of age a it is the list's own error minus v · a.
- *Age* (s): the frame minus the entry's newest capture.
- Objects: those with an episode, from onset to end, where the truth has them at the frame and there is a place to
  measure distances from.
- *GOSPA*: of these objects against the held entries, as in `metrics/accuracy/statistics.py`. Entries at no object of
  measured classes are false, so are those whose object is no longer in the truth; an empty list misses every object.
- Entries about an object after its onset that has no truth at the frame are counted (`without_truth`), in no error.

Letters of the shapes: G frames, M episodes, K lists, S runs, L pairs of episode and frame, episode after episode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.compiled import borrowing, borrowing_kernel
from copem_replay.core.geometry import is_in_area
from copem_replay.core.object_list import Entries, ObjectLists
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Scene, Tracks
from copem_replay.metrics.accuracy.aggregator import make_parameters, sort_truth_by_list, take_match_columns
from copem_replay.metrics.accuracy.kernel import (
    AccuracyParameters,
    EntryMatches,
    Estimates,
    Targets,
    TruthByList,
    divide_gospa,
    make_estimates,
    make_targets,
)
from copem_replay.metrics.accuracy.statistics import AccuracySettings
from copem_replay.metrics.matching import GHOST, MATCH, Matches

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes, Reference

EVERY_S = 0.1
"""Seconds between frames: ten a second show what a list of usual rate is worth, and more would only cost."""
_EARLY_S = EVERY_S / 10
"""A frame so much before the next is due is taken for it: recorded rates are not exact."""
_FRAMES_AT_ONCE = 600
"""Frames whose truth is interpolated at a time, a minute: of long logs all columns would not fit; changes no result."""


@dataclass(frozen=True)
class HeldFrames:
    """The frames of a log at which configurations are compared, with truth and reference at each."""

    time_s: Float  # (G,)
    truth: TruthByList  # by frame, objects with an episode only
    reference: Reference  # at the frames
    first: Int  # (M,) frames first … first + count − 1 are from the onset to the end of the episode
    count: Int  # (M,)


def make_held_frames(
    frame_s: Float, episodes: Episodes, truth_at: Callable[[Float], Tracks], reference: Callable[[Float], Reference]
) -> HeldFrames:
    """The frames of a log. `frame_s`: of its truth, ascending; `truth_at`, `reference`: truth and place at instants."""
    time_s = thin_frames(frame_s)
    parts = []
    for k in range(0, max(len(time_s), 1), _FRAMES_AT_ONCE):
        world = truth_at(time_s[k : k + _FRAMES_AT_ONCE])
        parts.append(sort_truth_by_list(world.take_tracks(np.isin(world.object_ix, episodes.object_ix))))
    rows = np.concatenate([np.zeros(1, dtype=np.int64), *(np.diff(part.start) for part in parts)])
    columns = (np.concatenate(of) for of in zip(*(part[1:] for part in parts), strict=True))
    first = np.searchsorted(time_s, episodes.onset_s - SAME_INSTANT_S, side="left")
    after = np.searchsorted(time_s, episodes.ended_s + SAME_INSTANT_S, side="right")
    return HeldFrames(
        time_s, TruthByList(np.cumsum(rows), *columns), reference(time_s), first, np.maximum(after - first, 0)
    )


def thin_frames(frame_s: Float) -> Float:
    """The frames (F,) of a truth thinned to ten a second (G,): the first, then the next when another is due.

    A frame that is late by up to half of the time between two does not put off the next.
    """
    thinned_s, due_s = [], float(frame_s[0]) if len(frame_s) else 0.0
    for time_s in frame_s.tolist():
        if time_s >= due_s - _EARLY_S:
            thinned_s.append(time_s)
            due_s = max(due_s, time_s - EVERY_S / 2) + EVERY_S
    return np.array(thinned_s, dtype=np.float64)


def find_newest_lists(issue_s: Float, frame_s: Float, max_age_s: float) -> tuple[Int, Bool]:
    """(G,) the newest list available by each frame, −1: none yet; and whether it is held, not older than `max_age_s`.

    `issue_s (K,)`: when each list is available, ascending.
    """
    newest: Int = np.searchsorted(issue_s, frame_s + SAME_INSTANT_S, side="right") - 1
    since_s = np.append(issue_s, -np.inf)[newest]
    return newest, frame_s - since_s <= max_age_s + SAME_INSTANT_S


@dataclass(frozen=True)
class HeldAccuracy:
    """How far off what is held is, in S runs. Columns (S, L) count the frames `first … first + count − 1` (M,)."""

    frame_s: Float  # (G,)
    list_ix: Int  # (G,) the list that is held, −1: none
    first: Int
    count: Int
    error_m: NDArray[np.float32]  # (S, L) NaN: the object is not listed
    age_s: NDArray[np.float32]  # (S, L) NaN: the object is not listed
    gospa: NDArray[np.float32]  # (S, L) the object's part of GOSPAᵖ; NaN: it does not count at the frame
    without_truth: Int  # (S,) held entries whose object has no truth at the frame

    def repeated(self, runs: int) -> HeldAccuracy:
        """The accuracy of `runs` equal runs, from that of one."""
        if len(self.without_truth) == runs:
            return self
        error_m, age_s, gospa = (
            np.broadcast_to(of, (runs, of.shape[1])) for of in (self.error_m, self.age_s, self.gospa)
        )
        without_truth = np.broadcast_to(self.without_truth, (runs,))
        return replace(self, error_m=error_m, age_s=age_s, gospa=gospa, without_truth=without_truth)


class HeldErrors:
    """Measures what is held of K lists in S runs, chunk after chunk: to the last bit equal for chunks of any size.

    `issue_s (K,)`: when each list of the whole log is available. `measured_class`, `settings`, `runs`: as of
    `Aggregator`.
    """

    def __init__(
        self,
        frames: HeldFrames,
        issue_s: Float,
        max_age_s: float,
        scene: Scene,
        episodes: Episodes,
        measured_class: Bool,
        *,
        settings: AccuracySettings,
        runs: int,
    ) -> None:
        self._frames, self._newest = frames, find_newest_lists(issue_s, frames.time_s, max_age_s)
        self._parameters = make_parameters(settings, measured_class)
        episode_of = np.full(len(scene.object_ids), -1)
        episode_of[episodes.object_ix] = np.arange(len(episodes.object_ix))
        column = np.cumsum(frames.count) - frames.count
        self._episodes = _EpisodeFrames(episode_of, frames.first, frames.count, column, episodes.onset_s)
        error_m, age_s, gospa = (np.full((runs, int(frames.count.sum())), np.nan, dtype=np.float32) for _ in range(3))
        self._out = _HeldColumns(error_m, age_s, gospa, np.zeros(runs, dtype=np.int64))
        self._added = self._measured = 0

    def add(self, lists: ObjectLists, matches: Matches) -> None:
        """Add the next lists; measures the frames that hold one. `matches`: at the instants that entries tell of."""
        frames, (newest, is_held) = self._frames, self._newest
        after = self._added + lists.start.shape[1] - 1
        chunk = slice(self._measured, int(np.searchsorted(newest, after, side="left")))
        number = np.where(is_held, newest - self._added, -1)[chunk]
        reference, M = frames.reference, len(self._episodes.first)
        _measure_frames(
            lists.start, lists.entries, take_match_columns(matches), number, self._measured, frames.time_s,
            frames.truth, self._episodes, (reference.x_m, reference.y_m, reference.present), self._parameters,
            self._out, make_targets(M), make_estimates(lists), _FrameScratch(np.full(M, -1), np.zeros(M, dtype=bool)),
        )  # fmt: skip
        self._added, self._measured = after, chunk.stop

    def result(self) -> HeldAccuracy:
        """What is held at all frames. Raises ValueError before all lists have been added."""
        newest, is_held = self._newest
        if self._measured != len(newest):
            raise ValueError(f"HeldErrors: expected {len(newest)} frames, found {self._measured}")
        frames = self._frames
        return HeldAccuracy(frames.time_s, np.where(is_held, newest, -1), frames.first, frames.count, *self._out)


class _EpisodeFrames(NamedTuple):
    # Which frames count for each episode. All (M,) but the first.
    episode_of: Int  # (N,) by object, −1: not measured
    first: Int  # frames first … first + frames − 1
    frames: Int
    column: Int  # of the first frame, in the columns (S, L)
    onset_s: Float


class _HeldColumns(NamedTuple):
    # Columns and sums that are filled, as in `HeldAccuracy`.
    error_m: NDArray[np.float32]
    age_s: NDArray[np.float32]
    gospa: NDArray[np.float32]
    without_truth: Int


class _FrameScratch(NamedTuple):
    # The objects at the frame at hand.
    target_of: Int  # (M,) by episode: its place among the targets, −1: none
    present: Bool  # (M,) whether the truth has it


@borrowing_kernel
def _measure_frames(
    start: Int, entries: Entries, matches: EntryMatches, number: Int, first: int, time_s: Float, truth: TruthByList,
    episodes: _EpisodeFrames, reference: tuple[Float, Float, Bool], params: AccuracyParameters, out: _HeldColumns,
    targets: Targets, estimates: Estimates, room: _FrameScratch,
) -> None:  # fmt: skip
    """Fills `out` with the errors at frames `first`, `first + 1`, …; `number`: the list held at each (−1: none)."""
    reference_x_m, reference_y_m, is_placed = reference
    for q in range(len(number)):
        g, k = first + q, number[q]
        if not is_placed[g]:
            continue
        n_true = _gather_present(g, truth, episodes, targets, room)
        for s in range(len(start)):
            count = 0
            if k >= 0:
                count = _add_held_entries(
                    s, start[s, k], start[s, k + 1], entries, matches, time_s[g], episodes,
                    (reference_x_m[g], reference_y_m[g]), params, targets, estimates, room, out,
                )  # fmt: skip
            _fill_gospa(targets, n_true, estimates, count, params, out.gospa[s])
        for p in range(truth.start[g], truth.start[g + 1]):
            m = episodes.episode_of[truth.object_ix[p]]
            room.target_of[m], room.present[m] = -1, False


@borrowing
def _fill_gospa(
    targets: Targets,
    n_true: int,
    estimates: Estimates,
    count: int,
    params: AccuracyParameters,
    out: NDArray[np.float32],
) -> None:
    """Fills `out` with the GOSPA (to the power p) of each of the first `n_true` targets; `count`: of estimates."""
    if n_true > 0:
        divide_gospa(targets, n_true, estimates, count, params.cutoff_m, params.power)
        for t in range(n_true):
            out[targets.column[t]] = targets.located[t] + targets.missed[t] + targets.false[t]


@borrowing
def _gather_present(g: int, truth: TruthByList, episodes: _EpisodeFrames, targets: Targets, room: _FrameScratch) -> int:
    """Fills `targets` with the objects that count at frame g, `room` with all that are there. Returns how many do."""
    n_true = 0
    for p in range(truth.start[g], truth.start[g + 1]):
        m = episodes.episode_of[truth.object_ix[p]]
        room.present[m] = True
        if g < episodes.first[m] or g >= episodes.first[m] + episodes.frames[m]:
            continue
        room.target_of[m] = n_true
        targets.episode[n_true], targets.column[n_true] = m, episodes.column[m] + g - episodes.first[m]
        targets.x_m[n_true], targets.y_m[n_true] = truth.x_m[p], truth.y_m[p]
        n_true += 1
    return n_true


@borrowing
def _add_held_entries(
    s: int, first: int, after: int, entries: Entries, matches: EntryMatches, time_s: float, episodes: _EpisodeFrames,
    from_m: tuple[float, float], params: AccuracyParameters, targets: Targets, estimates: Estimates,
    room: _FrameScratch, out: _HeldColumns,
) -> int:  # fmt: skip
    """Adds errors and ages of entries of one held list of run s to `out`. Returns the number of entries in GOSPA."""
    count = 0
    for i in range(first, after):
        if matches.role[i] == GHOST:
            false = params.measured_class[matches.class_ix[i]]
        else:
            m = episodes.episode_of[matches.object_ix[i]]
            target = room.target_of[m] if m >= 0 else -1
            false = m >= 0 and not room.present[m] and time_s >= episodes.onset_s[m] - SAME_INSTANT_S
            if false:
                out.without_truth[s] += 1
            elif target < 0:
                continue
            elif matches.role[i] == MATCH:
                column = targets.column[target]
                east_m, north_m = entries[i].x_m - targets.x_m[target], entries[i].y_m - targets.y_m[target]
                out.error_m[s, column], out.age_s[s, column] = np.hypot(east_m, north_m), time_s - entries[i].captured_s
        if false or matches.role[i] != GHOST:
            if false and not is_in_area(
                entries[i].x_m, entries[i].y_m, from_m[0], from_m[1], params.annotated_m, params.annotated_range_m
            ):
                continue
            estimates.x_m[count], estimates.y_m[count] = entries[i].x_m, entries[i].y_m
            count += 1
    return count
