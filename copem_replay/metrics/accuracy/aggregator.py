"""The aggregator adds up the statistics of accuracy (`metrics/accuracy/statistics.py`), chunk after chunk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.geometry import are_in_area, polygon_corners
from copem_replay.core.object_list import ObjectLists
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Scene, Tracks
from copem_replay.metrics.accuracy.kernel import (
    AccuracyParameters,
    AccuracySums,
    EntryMatches,
    EpisodeLists,
    EpisodeStates,
    TruthByList,
    add_up,
    close_episodes,
    make_estimates,
    make_list_scratch,
    make_targets,
)
from copem_replay.metrics.accuracy.statistics import (
    BAND,
    EXISTENCE,
    EXISTENCE_BINS,
    OBJECT,
    RUN,
    Accuracy,
    AccuracySettings,
)
from copem_replay.metrics.episodes import Reference
from copem_replay.metrics.matching import Matches

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes


class Aggregator:
    """Adds up how far off K lists in S runs are. The sums are equal to the last bit for time chunks of any size.

    `issue_s (K,)`: when each of the lists is available, ascending. `stay_from_s (M,)`: the first instant that object
    and ego share, or earlier. `reference`: the place that distances are measured from, at the instants of all lists.
    `measured_class (C,)`: whether a ghost of the class counts as one of a measured object. `runs`: S, equal in all time
    chunks; 1 where one run stands for all.
    """

    def __init__(
        self,
        issue_s: Float,
        scene: Scene,
        episodes: Episodes,
        stay_from_s: Float,
        reference: Reference,
        measured_class: Bool,
        *,
        settings: AccuracySettings,
        runs: int,
    ) -> None:
        first = np.searchsorted(issue_s, stay_from_s - SAME_INSTANT_S, side="left")
        count = np.maximum(np.searchsorted(issue_s, episodes.ended_s + SAME_INSTANT_S, side="right") - first, 0)
        episode_of = np.full(len(scene.object_ids), -1)
        episode_of[episodes.object_ix] = np.arange(len(episodes.object_ix))
        self._stays = EpisodeLists(
            episode_of, first, count, np.cumsum(count) - count, episodes.onset_s, episodes.ended_s
        )
        self._issue_s, self._reference, self._settings = issue_s, reference, settings
        self._parameters = params = make_parameters(settings, measured_class)
        S, M, L = runs, len(episodes.object_ix), int(count.sum())
        self._out = AccuracySums(
            np.full((S, L), np.nan, dtype=np.float32),
            np.full((S, L), np.nan, dtype=np.float32),
            np.zeros((S, M), dtype=OBJECT),
            np.zeros(S, dtype=RUN),
            np.zeros((S, len(params.existence_thresholds)), dtype=np.int64),
            np.zeros((S, max(len(params.distance_edges_m) - 1, 0)), dtype=BAND),
            np.zeros((S, max(len(params.time_edges_s) - 1, 0)), dtype=BAND),
            np.zeros((S, EXISTENCE_BINS), dtype=EXISTENCE),
        )
        self._out.by_run["lists"] = reference.present.sum()
        self._out.by_run["time_s"] = _time_s(issue_s, reference.present)
        self._scratch = make_list_scratch(M), make_targets(M)
        self._states = EpisodeStates(np.full((S, M), -1), np.tile(episodes.onset_s, (S, 1)))
        self._added = 0

    def add(self, lists: ObjectLists, matches: Matches, now: Matches, world: Tracks) -> None:
        """Add the next lists. `matches`, `now`: of their entries at the instants these tell of, and when the lists are
        available.

        `world`: the truth when lists are available, frame k for the k-th list. Raises ValueError for another number of
        runs, or more lists than are left.
        """
        runs, count = len(lists.start), lists.start.shape[1] - 1
        lists_left = len(self._issue_s) - self._added
        if runs != len(self._out.by_run) or count > lists_left:
            expected = f"lists of {len(self._out.by_run)} runs, at most {lists_left} of each"
            raise ValueError(f"Assessment: expected {expected}; found {runs} runs of {count}")
        chunk = slice(self._added, self._added + count)
        reference = self._reference
        add_up(
            lists.start, lists.entries, take_match_columns(matches), take_match_columns(now), self._issue_s[chunk],
            sort_truth_by_list(world),
            self._stays._replace(first_list=self._stays.first_list - self._added),
            reference.x_m[chunk], reference.y_m[chunk], reference.present[chunk],
            self._parameters, self._states, self._out, *self._scratch, make_estimates(lists),
        )  # fmt: skip
        self._added += count

    def result(self) -> Accuracy:
        """The statistics of all lists. Raises ValueError before all have been added."""
        if self._added != len(self._issue_s):
            raise ValueError(f"Assessment: expected {len(self._issue_s)} lists, found {self._added}")
        close_episodes(self._stays, self._states, self._out)
        return Accuracy(self._settings, self._stays.first_list, self._stays.lists, *self._out)


def make_parameters(settings: AccuracySettings, measured_class: Bool) -> AccuracyParameters:
    """The settings as arrays and numbers for compiled code. `measured_class (C,)`: as of `Aggregator`."""
    return AccuracyParameters(
        settings.cutoff_m, settings.power, settings.gate_m, measured_class, _as_column(settings.distance_edges_m),
        _as_column(settings.time_edges_s), _as_column(settings.existence_thresholds),
        polygon_corners(settings.annotated_m), settings.annotated_range_m,
    )  # fmt: skip


def _as_column(values: tuple[float, ...]) -> Float:
    return np.array(values, dtype=np.float64)


def take_match_columns(matches: Matches) -> EntryMatches:
    """The columns of the matches as arrays for compiled code."""
    return EntryMatches(matches.object_ix, matches.role, matches.x_m, matches.y_m, matches.class_ix)


def sort_truth_by_list(truth: Tracks) -> TruthByList:
    """The rows of the truth sorted by list, and by object within a list."""
    order = np.lexsort((truth.row_object_ix, truth.frame_ix))
    columns = (getattr(truth, name)[0, order] for name in ("x_m", "y_m", "vx_mps", "vy_mps"))
    return TruthByList(truth.by_frame[1], truth.row_object_ix[order], *columns)


def _time_s(issue_s: Float, present: Bool) -> float:
    """Seconds from the first list with a reference to the last, without spans that have none; 0 for fewer than two
    lists.

    For a log of 10.0 s this is 10.0 s, whatever the rate of its lists.
    """
    neighbours = present[1:] & present[:-1]
    return float(np.diff(issue_s)[neighbours].sum())


def are_annotated(x_m: Float, y_m: Float, list_ix: Int, reference: Reference, settings: AccuracySettings) -> Bool:
    """(N,) whether listed places are in the annotated area; `reference`: the place at the instants of all lists."""
    if not settings.annotated_m and np.isinf(settings.annotated_range_m):
        return np.ones(len(list_ix), dtype=bool)
    from_m, corners = (reference.x_m[list_ix], reference.y_m[list_ix]), polygon_corners(settings.annotated_m)
    x_m, y_m = np.ascontiguousarray(x_m), np.ascontiguousarray(y_m)
    return are_in_area(x_m, y_m, *from_m, corners, settings.annotated_range_m)
