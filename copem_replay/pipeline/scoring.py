"""Scoring: how good a configuration's fused lists are.

Entries are matched with the truth at the instant they tell of, and for the accuracy of a list now with the truth at the
instant it is available (`metrics/matching.py`). Where a unit's clock is off, an entry may tell of an instant before its
object's first frame, or after its last: it is compared with the state moved there (`core/interpolation.py`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from copem_replay.core.interpolation import AROUND_S, interpolate_at_instants, interpolate_at_stated_instants
from copem_replay.core.object_list import AGREE
from copem_replay.core.tracks import CLASSES, Bool, Float, Int, Scene, Tracks, class_indices
from copem_replay.metrics.accuracy.aggregator import Aggregator
from copem_replay.metrics.accuracy.held import HeldAccuracy, HeldErrors, HeldFrames, make_held_frames
from copem_replay.metrics.accuracy.statistics import Accuracy, AccuracySettings, repeat_for_runs
from copem_replay.metrics.config import AnnotatedArea, Measure, MetricsSetup
from copem_replay.metrics.detection.by_match import DetectionSteps, FirstMatches, collect_captures
from copem_replay.metrics.detection.by_truth_id import FirstDetections
from copem_replay.metrics.episodes import Episodes, Reference, locate_reference, measured_objects
from copem_replay.metrics.matching import Matches, match_at_both_times, match_entries

if TYPE_CHECKING:
    from copem_replay.pipeline.receiver import ReceiverOutput


KEPT = 64
"""Sets of instants of which the truth is kept. More take more memory, and where arrivals are drawn no set comes again:
each run has its own. No result depends on it."""

T = TypeVar("T")


def _cache_instants(cache: dict[bytes, T], time_s: Float, compute: Callable[[Float], T]) -> T:
    """What the cache has of these instants, else what `compute` gives, which replaces the oldest entry."""
    key = time_s.tobytes()
    value = cache.get(key)
    if value is None:
        value = cache[key] = compute(time_s)
        for oldest in list(cache)[:-KEPT]:
            cache.pop(oldest, None)
    return value


@dataclass(frozen=True)
class TruthCache:
    """One log's truth at the instants of fused lists; configurations with the same instants share it."""

    scene: Scene
    truth: Tracks
    experiment: MetricsSetup
    _worlds: dict[bytes, Tracks] = field(default_factory=dict)
    _references: dict[bytes, Reference] = field(default_factory=dict)

    def at(self, time_s: Float) -> Tracks:
        """The truth at instants (K,), ascending."""
        return _cache_instants(self._worlds, time_s, self._at)

    def between(self, time_s: Float) -> Tracks:
        """The truth at instants (K,), ascending, which is not kept."""
        return self._at(time_s)

    def at_stated(self, time_s: Float, captured_s: tuple[Float, Float]) -> Tracks:
        """The truth at stated instants (K,), ascending; `captured_s`: the earliest and latest true capture of each."""
        return _cache_instants(self._worlds, np.stack([time_s, *captured_s]), self._at_stated)

    def _at(self, time_s: Float) -> Tracks:
        return interpolate_at_instants(
            self._near(time_s), self._stamps(time_s), t0_ns=self.scene.t0_ns, max_gap_s=self.experiment.max_gap_s
        )

    def _at_stated(self, times_s: Float) -> Tracks:
        stamps, earliest, latest = self._stamps(times_s)
        return interpolate_at_stated_instants(
            self._near(times_s[0]), stamps, (earliest, latest), t0_ns=self.scene.t0_ns,
            max_gap_s=self.experiment.max_gap_s,
        )  # fmt: skip

    def _stamps(self, time_s: Float) -> Int:
        return self.scene.t0_ns + np.rint(time_s * 1e9).astype(np.int64)

    def _near(self, time_s: Float) -> Tracks:
        """The part of the truth that interpolation at instants (K,) needs."""
        if not len(time_s):
            return self.truth
        gap_s = self.experiment.max_gap_s + AROUND_S
        return self.truth.captured_between(time_s[0] - gap_s, time_s[-1] + gap_s)

    def reference(self, time_s: Float) -> Reference:
        """From where distances are measured, at instants (K,)."""
        return _cache_instants(
            self._references, time_s, lambda time_s: locate_reference(self.scene, self.truth, self.experiment, time_s)
        )

    def classes(self, measure: Measure) -> Bool:
        """(C,) which classes are measured: an entry without a true object is a ghost only if it is of one of these."""
        measured: Bool = np.zeros(len(CLASSES), dtype=bool)
        measured[self.scene.object_class[measured_objects(self.scene, measure)]] = True
        if measure.objects.ids is None and measure.objects.classes is not None:
            measured[class_indices(measure.objects.classes)] = True
        # A `vehicle` may be a car; an entry without a class (`other`) may be anything.
        may_be_measured: Bool = np.array(AGREE[:, measured].any(axis=1))
        may_be_measured[CLASSES.index("other")] = measured[CLASSES.index("other")]
        return may_be_measured

    def since_s(self, episodes: Episodes) -> Float:
        """(M,) when the object of each episode first is in the log."""
        first = np.full(len(self.scene.object_ids), np.inf)
        np.minimum.at(first, self.truth.row_object_ix, self.truth.row_captured_s)
        since: Float = first[episodes.object_ix]
        return since


@dataclass(frozen=True)
class ConfigurationScores:
    """The scores of one configuration in the runs (S,), or in the one that stands for all.

    `issue_s (K,)`: when each list is available. `detections`, `steps`: by match, whatever the fusion. `held`: with
    `accuracy`.
    """

    issue_s: Float
    detections: FirstDetections
    steps: DetectionSteps
    accuracy: Accuracy | None
    held: HeldAccuracy | None = None


def match_lists(around: TruthCache, output: ReceiverOutput, measure: Measure) -> Matches:
    """Which true object each entry of the fused lists is about, at the instant it tells of."""
    world = around.at(output.instants.issue_s) if output.tells_of == "now" else _interpolate_told_world(around, output)
    return match_entries(output.told, world, around.scene, gate_m=measure.match.gate_m, tells_of=output.tells_of)


def _match_at_both_times(around: TruthCache, output: ReceiverOutput, measure: Measure) -> tuple[Matches, Matches]:
    """Matches at the instants that entries tell of, and at the instants at which their lists are available."""
    if output.tells_of == "now":
        matches = match_lists(around, output, measure)
        return matches, matches
    then, now = _interpolate_told_world(around, output), around.at(output.instants.issue_s)
    return match_at_both_times(output.told, then, now, around.scene, gate_m=measure.match.gate_m)


def _interpolate_told_world(around: TruthCache, output: ReceiverOutput) -> Tracks:
    """The truth at the captures that entries tell of."""
    captures_s = _list_captures(output)
    if output.stated is None:
        return around.at(captures_s)
    return around.at_stated(captures_s, output.stated.captured_between_s(captures_s))


def _list_captures(output: ReceiverOutput) -> Float:
    """Captures, ascending: all that were received; in a time chunk those about the captures that entries name."""
    captures: Float = np.unique(output.captures_told_s)
    if output.whole:
        return captures
    after = np.searchsorted(captures, output.told.entries["captured_s"])
    used = np.zeros(len(captures) + 1, dtype=bool)
    used[after] = used[np.maximum(after - 1, 0)] = True
    return captures[used[:-1]]


class Scorer:
    """Measures a configuration's lists, chunk by chunk; `issue_s (K,)`: when those of the whole log are available.

    `frames`: at which it is measured what is held; None: accuracy is not measured. `max_age_s`: of the configuration.
    """

    def __init__(
        self, around: TruthCache, episodes: Episodes, output: ReceiverOutput, issue_s: Float, measure: Measure,
        frames: HeldFrames | None, max_age_s: float,
    ) -> None:  # fmt: skip
        self._issue_s, self._measure = issue_s, measure
        self.accuracy_s = 0.0
        """Seconds that measuring accuracy took, without matching."""
        runs = len(output.lists.start)
        self._episodes = episodes
        captures = collect_captures(output.received, instants=measure.confirm.hits > 1)
        self._known = [
            FirstMatches(
                one, runs=runs, confirm=measure.confirm, count_earlier=measure.count_earlier, captures=captures
            )
            for _, one in episodes.passes
        ]
        self._aggregator = self._held = None
        if frames is not None:
            firsts = episodes.firsts
            settings, classes = accuracy_settings(measure, around.scene.end_s), around.classes(measure)
            self._aggregator = Aggregator(
                issue_s, around.scene, firsts, around.since_s(firsts), around.reference(issue_s), classes,
                settings=settings, runs=runs,
            )  # fmt: skip
            self._held = HeldErrors(
                frames, issue_s, max_age_s, around.scene, firsts, classes, settings=settings, runs=runs
            )

    def add(self, around: TruthCache, output: ReceiverOutput) -> Matches:
        """Take in the lists of a time chunk. Returns their matches."""
        lists, issue_s = output.lists, output.instants.issue_s
        if self._aggregator is None or self._held is None:
            matches = match_lists(around, output, self._measure)
        else:
            began_s = time.perf_counter()
            matches, now = _match_at_both_times(around, output, self._measure)
            self._aggregator.add(lists, matches, now, around.at(issue_s))
            self._held.add(lists, matches)
            self.accuracy_s += time.perf_counter() - began_s
        for known in self._known:
            known.add(lists, matches, issue_s)
        return matches

    def result(self, runs: int) -> ConfigurationScores:
        """The scores in this number of runs."""
        detections, steps = self._join_known()
        accuracy = None if self._aggregator is None else repeat_for_runs(self._aggregator.result(), runs)
        held = None if self._held is None else self._held.result().repeated(runs)
        return ConfigurationScores(self._issue_s, detections, steps, accuracy, held)

    def _join_known(self) -> tuple[FirstDetections, DetectionSteps]:
        """The detections of all episodes, and their steps in the order of runs and episodes."""
        results = [known.result() for known in self._known]
        detections = FirstDetections(
            *(self._episodes.join_passes(columns) for columns in zip(*(one for one, _ in results), strict=True))
        )
        if len(results) == 1:
            return detections, results[0][1]
        parts = [
            (steps.run_ix, which[steps.episode_ix], steps.existence, steps.detection_s)
            for (which, _), (_, steps) in zip(self._episodes.passes, results, strict=True)
        ]
        run_ix, episode_ix, existence, detection_s = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.lexsort((episode_ix, run_ix))
        return detections, DetectionSteps(*(column[order] for column in (run_ix, episode_ix, existence, detection_s)))


def make_log_frames(around: TruthCache, episodes: Episodes) -> HeldFrames:
    """The frames of a log at which it is measured what is held."""
    return make_held_frames(around.truth.captured_s, episodes.firsts, around.between, around.reference)


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
