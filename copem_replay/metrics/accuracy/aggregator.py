"""Statistics of `metrics/accuracy/statistics.py`, added up chunk after chunk of lists."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.object_list import ObjectLists
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Scene, Tracks
from copem_replay.metrics.accuracy.kernel import Asked, Found, SoFar, Stays, Sums, World, add_up, close
from copem_replay.metrics.accuracy.statistics import BAND, EXISTENCE, EXISTENCE_BINS, OBJECT, RUN, Accuracy, Settings
from copem_replay.metrics.area import corners
from copem_replay.metrics.matching import Matches
from copem_replay.metrics.reference import Reference

if TYPE_CHECKING:
    from copem_replay.metrics.episodes import Episodes

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


class Aggregator:
    """Adds up how far off K lists in S runs are, as many of them at a time as one likes: to the last bit the same.

    `issue_s (K,)`: when each list of all is available, ascending. `stay_from_s (M,)`: the first instant that object
    and ego share, or earlier. `reference`: from where distances are measured, at the instants of all lists.
    `measured_class (C,)`: what a ghost has to be called to count as one of a measured object. `runs`: S, the same in
    every time chunk (1, too, where one run stands for all).
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
        settings: Settings,
        runs: int,
    ) -> None:
        first = np.searchsorted(issue_s, stay_from_s - _TOLERANCE_S, side="left")
        count = np.maximum(np.searchsorted(issue_s, episodes.ended_s + _TOLERANCE_S, side="right") - first, 0)
        episode_of = np.full(len(scene.object_ids), -1)
        episode_of[episodes.object_ix] = np.arange(len(episodes.object_ix))
        self._stays = Stays(episode_of, first, count, np.cumsum(count) - count, episodes.onset_s, episodes.ended_s)
        self._issue_s, self._reference, self._settings = issue_s, reference, settings
        distance_edges_m, time_edges_s = _column(settings.distance_edges_m), _column(settings.time_edges_s)
        thresholds = _column(settings.existence_thresholds)
        self._asked = Asked(
            settings.cutoff_m, settings.power, settings.gate_m, measured_class, distance_edges_m, time_edges_s,
            thresholds, corners(settings.annotated_m), settings.annotated_range_m,
        )  # fmt: skip
        S, M, L = runs, len(episodes.object_ix), int(count.sum())
        self._out = Sums(
            np.full((S, L), np.nan, dtype=np.float32),
            np.full((S, L), np.nan, dtype=np.float32),
            np.zeros((S, M), dtype=OBJECT),
            np.zeros(S, dtype=RUN),
            np.zeros((S, len(thresholds)), dtype=np.int64),
            np.zeros((S, max(len(distance_edges_m) - 1, 0)), dtype=BAND),
            np.zeros((S, max(len(time_edges_s) - 1, 0)), dtype=BAND),
            np.zeros((S, EXISTENCE_BINS), dtype=EXISTENCE),
        )
        self._out.by_run["lists"] = reference.present.sum()
        self._out.by_run["time_s"] = _time_s(issue_s, reference.present)
        self._so_far = SoFar(np.full((S, M), -1), np.tile(episodes.onset_s, (S, 1)))
        self._added = 0

    def add(self, lists: ObjectLists, about: Matches, now: Matches, world: Tracks) -> None:
        """Add the lists that come next.

        `about`: matches at the instants the entries tell of, `now`: at those the lists are available. `world`: the
        truth at these, frame k at the instant of the k-th list.
        """
        runs, count = len(lists.start), lists.start.shape[1] - 1
        left = len(self._issue_s) - self._added
        if runs != len(self._out.by_run) or count > left:
            expected = f"lists of {len(self._out.by_run)} runs, at most {left} of each"
            raise ValueError(f"Assessment: expected {expected}; found {runs} runs of {count}")
        these = slice(self._added, self._added + count)
        at = self._reference
        add_up(
            lists.start, lists.entries, _found(about), _found(now), self._issue_s[these], _by_list(world),
            self._stays._replace(first_list=self._stays.first_list - self._added),
            at.x_m[these], at.y_m[these], at.present[these], self._asked, self._so_far, self._out,
        )  # fmt: skip
        self._added += count

    def result(self) -> Accuracy:
        """The statistics of all lists, once all have been added."""
        if self._added != len(self._issue_s):
            raise ValueError(f"Assessment: expected {len(self._issue_s)} lists, found {self._added}")
        close(self._stays, self._so_far, self._out)
        return Accuracy(self._settings, self._stays.first_list, self._stays.lists, *self._out)


def _column(values: tuple[float, ...]) -> Float:
    return np.array(values, dtype=np.float64)


def _found(matches: Matches) -> Found:
    return Found(matches.object_ix, matches.role, matches.x_m, matches.y_m, matches.class_ix)


def _by_list(truth: Tracks) -> World:
    order = np.lexsort((truth.row_object_ix, truth.frame_ix))
    columns = (getattr(truth, name)[0, order] for name in ("x_m", "y_m", "vx_mps", "vy_mps"))
    return World(truth.by_frame[1], truth.row_object_ix[order], *columns)


def _time_s(issue_s: Float, present: Bool) -> float:
    """The time from the first list with a reference to the last, without that in which there is none. 0: no two lists.

    Of a log of 10.0 s these are 10.0 s, whatever the rate of its lists.
    """
    neighbours = present[1:] & present[:-1]
    return float(np.diff(issue_s)[neighbours].sum())
