"""Scoring: how good a configuration's fused lists are.

Entries are matched with the truth at the instant they tell of, and for the accuracy of a list now with the truth at the
instant it is available (`metrics/matching.py`). Where a unit's clock is off, an entry may tell of an instant before its
object's first frame, or after its last: it is compared with the state moved there (`core/interpolation.py`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.accuracy.aggregator import Aggregator
from copem_replay.metrics.accuracy.held import HeldAccuracy, HeldErrors
from copem_replay.metrics.accuracy.statistics import Accuracy, AccuracySettings, repeat_for_runs
from copem_replay.metrics.braking.needless import NeedlessBraking, NeedlessDetector
from copem_replay.metrics.config import AnnotatedArea, Measure
from copem_replay.metrics.detection.by_match import DetectionSteps, FirstMatches
from copem_replay.metrics.detection.by_truth_id import FirstDetections
from copem_replay.metrics.detection.conflict import ConflictDetector
from copem_replay.metrics.detection.turns import number_turns
from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH, Matches, match_at_both_times, match_entries
from copem_replay.metrics.origin import Origins
from copem_replay.pipeline.false_tracks import FalseTracks
from copem_replay.pipeline.prepare import Replay, TruthCache
from copem_replay.pipeline.receiver import ReceiverOutput

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ConfigurationScores:
    """The scores of one configuration in the runs (S,), or in one where all are equal.

    `issue_s (K,)`: when each list is available. `detections`, `steps`: by match, whatever the fusion. `held`,
    `false_tracks`: with `accuracy`; `needless`: with it where a driver is asked.
    """

    issue_s: Float
    detections: FirstDetections
    steps: DetectionSteps
    accuracy: Accuracy | None
    held: HeldAccuracy | None = None
    needless: NeedlessBraking | None = None
    false_tracks: pd.DataFrame | None = None


def match_lists(cache: TruthCache, output: ReceiverOutput, measure: Measure) -> Matches:
    """The true object that each entry of the fused lists is about, at the instant it tells of."""
    world = cache.at(output.instants.issue_s) if output.tells_of == "now" else _interpolate_told_world(cache, output)
    gate_m = measure.match.gate_m
    return match_entries(output.told, world, cache.scene, output.origins, gate_m=gate_m, tells_of=output.tells_of)


def match_lists_twice(cache: TruthCache, output: ReceiverOutput, measure: Measure) -> tuple[Matches, Matches]:
    """Matches at the instants that entries tell of, and at the instants at which their lists are available."""
    if output.tells_of == "now":
        matches = match_lists(cache, output, measure)
        return matches, matches
    then, now = _interpolate_told_world(cache, output), cache.at(output.instants.issue_s)
    return match_at_both_times(output.told, then, now, cache.scene, output.origins, gate_m=measure.match.gate_m)


def _interpolate_told_world(cache: TruthCache, output: ReceiverOutput) -> Tracks:
    """The truth at the captures that entries tell of."""
    captures_s = _list_captures(output)
    if output.stated is None:
        return cache.at(captures_s)
    return cache.at_stated(captures_s, output.stated.captured_between_s(captures_s))


def _list_captures(output: ReceiverOutput) -> Float:
    """Ascending captures (s) of received lists; in a time chunk only those beside captures that entries tell of."""
    received = output.received
    captures: Float = np.unique(
        np.append(received.captured_s, () if received.entry_age_s is None else received.entry_captured_s)
        if output.stated is None
        else output.stated.told[0]
    )
    if output.whole:
        return captures
    after = np.searchsorted(captures, output.told.entries["captured_s"])
    used = np.zeros(len(captures) + 1, dtype=bool)
    used[after] = used[np.maximum(after - 1, 0)] = True
    return captures[used[:-1]]


def match_run(around: TruthCache, output: ReceiverOutput, measure: Measure) -> Matches:
    """As `match_lists`; but an entry about no object that is at one now is a second entry, not a false one."""
    matches, now = match_lists_twice(around, output, measure)
    somebody = (matches.role == GHOST) & (now.role != GHOST)
    role = np.where(somebody, np.int8(DUPLICATE), matches.role)
    return replace(matches, role=role, object_ix=np.where(somebody, now.object_ix, matches.object_ix))


def _match_by_id(matches: Matches, origins: Origins) -> Matches:
    """The matches, in which an entry that has an id is about whom it names, however far off."""
    if not len(origins.own_ix):
        return matches
    role = np.where((matches.role == GHOST) & (origins.own_ix >= 0), np.int8(DUPLICATE), matches.role)
    return replace(matches, role=role)


class Judge:
    """Measures the output of one configuration's receiver, chunk by chunk: detection, accuracy and conflicts.

    `issue_s (K,)`: when its lists of the whole log are available. `matches`: whether its lists are matched.
    """

    def __init__(self, log: Replay, experiment: Experiment, name: str, issue_s: Float, *, matches: bool) -> None:
        measure = experiment.measure
        self._log, self._measure, self._issue_s, self._matches = log, measure, issue_s, matches
        self._max_age_s = experiment.configurations[name].max_age_s
        self.accuracy_s = 0.0
        """Seconds that measuring accuracy took."""
        self._known: list[FirstMatches] = []
        self._aggregator: Aggregator | None = None
        self._held: HeldErrors | None = None
        self._needless: NeedlessDetector | None = None
        self._false: FalseTracks | None = None
        self._conflicts: ConflictDetector | None = None
        if measure.conflict is not None:
            self._conflicts = ConflictDetector(
                log.ego, log.episodes, measure.conflict, confirm=measure.confirm, count_earlier=measure.count_earlier
            )

    def match(self, cache: TruthCache, output: ReceiverOutput) -> tuple[Matches, Matches] | None:
        """Matches of a chunk's entries with the truth: at the instants they tell of, and when lists are available (for
        accuracy; else the same). None: not needed.
        """
        if not self._matches:
            return None
        if self._measure.accuracy:
            began_s = time.perf_counter()
            pair = match_lists_twice(cache, output, self._measure)
            self.accuracy_s += time.perf_counter() - began_s
            return pair
        matches = match_lists(cache, output, self._measure)
        return matches, matches

    def measure(self, cache: TruthCache, output: ReceiverOutput, pair: tuple[Matches, Matches] | None) -> None:
        """Add a chunk's lists to all measures; `pair`: from `match`, None: only what needs no matches."""
        issue_s = output.instants.issue_s
        if pair is not None:
            lists, (matches, now) = output.lists, pair
            if not self._known:
                self._begin(cache, output)
            if self._aggregator is not None and self._held is not None and self._false is not None:
                began_s = time.perf_counter()
                by_id = _match_by_id(matches, output.origins)
                self._aggregator.add(lists, by_id, now, cache.at(issue_s))
                self._false.add(lists, by_id, now)
                self._held.add(lists, matches)
                self.accuracy_s += time.perf_counter() - began_s
            if len(object_ix := output.origins.own_ix):  # known by truth ids, however far off
                matches = replace(matches, object_ix=object_ix, role=np.full(len(object_ix), MATCH, dtype=np.int8))
            if self._needless is not None:
                began_s = time.perf_counter()
                self._needless.add(lists, matches, output.tells_of)
                self.accuracy_s += time.perf_counter() - began_s
            for known in self._known:
                known.add(lists, matches, issue_s, output.origins)
        if self._conflicts is not None:
            for s, fused_tracks in output.tracks_by_run(pair and pair[0]):
                self._conflicts.add(fused_tracks, s)
            self._conflicts.next(issue_s)

    def _begin(self, cache: TruthCache, output: ReceiverOutput) -> None:
        """Set up the measures that need matches, at the first lists, which have the runs of all."""
        measure, episodes, runs = self._measure, self._log.episodes, len(output.lists.start)
        turns = number_turns(output.origin.lists) if measure.confirm.hits > 1 else None
        self._known = [
            FirstMatches(part, runs=runs, confirm=measure.confirm, count_earlier=measure.count_earlier, turns=turns)
            for _, part in episodes.passes
        ]
        if not measure.accuracy:
            return
        firsts, scene, issue_s = episodes.firsts, cache.scene, self._issue_s
        settings, classes = accuracy_settings(measure, scene.end_s), cache.classes(measure)
        since_s, reference = cache.since_s(firsts), cache.reference(issue_s)
        self._aggregator = Aggregator(issue_s, scene, firsts, since_s, reference, classes, settings=settings, runs=runs)
        self._held = HeldErrors(
            self._log.held_frames, issue_s, self._max_age_s, scene, firsts, classes, settings=settings, runs=runs
        )
        self._false = FalseTracks(issue_s, reference, classes, settings, self._max_age_s, output.received.units)
        if (truth := self._log.truth_demand) is not None:
            self._needless = NeedlessDetector(
                truth, issue_s, reference, settings, confirm=measure.confirm, max_age_s=self._max_age_s, runs=runs
            )

    def conflict_known_s(self) -> Float | None:
        """(S | 1, M) when a list first implied a collision, NaN: never; None: conflicts are not measured."""
        return None if self._conflicts is None else self._conflicts.result()

    def scores(self, runs: int) -> ConfigurationScores | None:
        """The scores in this number of runs; None: lists are not matched."""
        if not self._known:
            return None
        detections, steps = self._join_known()
        accuracy = None if self._aggregator is None else repeat_for_runs(self._aggregator.result(), runs)
        held = None if self._held is None else self._held.result().repeated(runs)
        needless = None if self._needless is None else self._needless.result().repeated(runs)
        false = None if self._false is None else self._false.result(runs)
        return ConfigurationScores(self._issue_s, detections, steps, accuracy, held, needless, false)

    def _join_known(self) -> tuple[FirstDetections, DetectionSteps]:
        """The first detections of all episodes, joined over passes, and their steps by run and episode."""
        results = [known.result() for known in self._known]
        detections = FirstDetections(
            *(self._log.episodes.join_passes(columns) for columns in zip(*(one for one, _ in results), strict=True))
        )
        if len(results) == 1:
            return detections, results[0][1]
        parts = [
            (steps.run_ix, which[steps.episode_ix], steps.existence, steps.detection_s)
            for (which, _), (_, steps) in zip(self._log.episodes.passes, results, strict=True)
        ]
        run_ix, episode_ix, existence, detection_s = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.lexsort((episode_ix, run_ix))
        return detections, DetectionSteps(*(column[order] for column in (run_ix, episode_ix, existence, detection_s)))


# What accuracy is measured by: bands of distance, time and existence.

DISTANCE_EDGES_M = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 75.0, 100.0, 150.0, 200.0)
"""Edges of the bands of distance: finer where most entries of a roadside or vehicle unit are. Round values."""

TIME_BANDS = 120
"""Bands of time at most, each of whole seconds: two minutes by the second; longer logs have longer bands."""

EXISTENCE_THRESHOLDS = (
    0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.89, 0.91, 0.95,
    0.98, 0.992, 0.9992, 0.99992, 0.999992,
)  # fmt: skip
"""Existence from which on ghosts are counted: twentieths, and above 0.85 values that tell one, two, three, … units of
existence 0.9 that agree from fewer (1 − 0.1ⁿ)."""


def accuracy_settings(measure: Measure, end_s: float) -> AccuracySettings:
    """Parameters of the accuracy for a log that ends at `end_s`."""
    cutoff_m = measure.gospa.cutoff_m if measure.gospa.cutoff_m is not None else measure.match.gate_m
    step_s = max(1, int(np.ceil(end_s / TIME_BANDS)))
    area = measure.annotated or AnnotatedArea.model_construct()
    return AccuracySettings(
        cutoff_m,
        measure.match.gate_m,
        measure.gospa.power,
        DISTANCE_EDGES_M,
        tuple(float(edge) for edge in range(0, int(end_s) + 1 + step_s, step_s)),
        EXISTENCE_THRESHOLDS,
        area.polygon_m or (),
        np.inf if area.range_m is None else area.range_m,
    )
