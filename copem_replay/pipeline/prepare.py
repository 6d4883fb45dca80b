"""Prepare: what all runs and configurations of one log share, once and chunk by chunk.

A long log is replayed in time chunks, so that memory does not grow with its length. What is cut are the receiver's
instants: a time chunk has those from `from_s` on and before `until_s`. Its lists, what is fused of them, matched and
measured are made, used and dropped before the next chunk; what a receiver must remember across a cut stays. No result
depends on where the cuts are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from copem_replay.communication.link import KeptDraws
from copem_replay.communication.reception import RadioPath
from copem_replay.core.errors import ExperimentError
from copem_replay.core.interpolation import interpolate_at_instants, interpolate_at_stated_instants
from copem_replay.core.tracks import (
    AGREE,
    CLASSES,
    SAME_INSTANT_S,
    Bool,
    Float,
    Int,
    Scene,
    TimeChunk,
    Tracks,
    class_indices,
    join_tracks,
)
from copem_replay.experiment.cross_references import NO_EGO
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.interface import IdealFusion, ListFusion
from copem_replay.io.recorded_units import RecordedUnits, join_recorded_units
from copem_replay.io.recording import Recording
from copem_replay.metrics.accuracy.held import HeldFrames, make_held_frames
from copem_replay.metrics.braking.demand import BrakingEgo
from copem_replay.metrics.braking.encounter import EgoPath, Encounter, find_encounters
from copem_replay.metrics.braking.needless import TruthDemand, find_truth_demand
from copem_replay.metrics.braking.verdict import find_passing_intervals
from copem_replay.metrics.config import Measure, MetricsSetup
from copem_replay.metrics.detection.conflict import keep_episodes_within
from copem_replay.metrics.episodes import (
    Episodes,
    Reference,
    find_episodes,
    locate_reference,
    measured_objects,
)
from copem_replay.perception.observation import KeptShares, Observations, join_observations, observe_objects
from copem_replay.perception.sensor_poses import SensorPoses, list_instants, place_units
from copem_replay.perception.sight import SightSpans, find_sight_changes, join_sight_changes
from copem_replay.pipeline.expansion import ExpandedExperiment, expand_alike, expand_experiment, give_views

T = TypeVar("T")

# Time chunks.

ROWS_AT_ONCE = 500_000
"""Observation rows up to which a log is one time chunk: with one run shown it takes about 1 GB."""
ROWS_A_CHUNK = 100_000
"""Observation rows of a time chunk of a longer log: some hundred MB."""
ROWS_HELD = 4_000_000
"""Observation rows up to which a log is held at once by what needs all of it: some GB."""
_AFTER = 0.381966
"""Where between two frames a cut is: 1 − 1/φ, where latencies of round numbers hardly ever bring a list."""


def time_chunks(scene: Scene, truth: Tracks, experiment: ExpandedExperiment) -> tuple[TimeChunk, ...]:
    """A log in time chunks of about as many observation rows each."""
    rows = observation_rows(scene, truth, experiment)
    fusions = [c.fusion for c in experiment.configurations.values()]
    whole = any(isinstance(one, IdealFusion) and one.memory is not None for one in fusions)
    if (
        rows <= ROWS_AT_ONCE
        or whole
        or experiment.fusing
        or not all(fusion.resumable for fusion in fusions if isinstance(fusion, ListFusion))
    ):
        return (TimeChunk(),)
    _, bounds = truth.by_frame
    pieces = int(-(-rows // ROWS_A_CHUNK))
    frames = np.unique(np.searchsorted(bounds, np.linspace(0, len(truth.frame_ix), pieces + 1)[1:-1]))
    frames = frames[(frames > 0) & (frames < len(truth.stamp_ns))]
    before_s, after_s = truth.captured_s[frames - 1], truth.captured_s[frames]
    # Between two frames: no cut comes between lists of different configurations that are available together.
    cuts = [-np.inf, *(before_s + _AFTER * (after_s - before_s)).tolist(), np.inf]
    return tuple(TimeChunk(*pair) for pair in pairwise(cuts))


def observation_rows(scene: Scene, truth: Tracks, experiment: ExpandedExperiment) -> float:
    """The estimated number of observation rows of a log, with those of the truth, which is perceived like a unit."""
    lists = sum(len(list_instants(scene, truth, unit)) for unit in experiment.modelled.values())
    return len(truth.frame_ix) * (1 + lists / max(len(truth.stamp_ns), 1))


# The truth at the instants of fused lists.

KEPT = 64
"""Sets of instants of which the truth is kept. More take more memory, and where arrivals are drawn no set comes again:
each run has its own. No result depends on it."""


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
        return self._keep(self._worlds, time_s, self.between)

    def between(self, time_s: Float) -> Tracks:
        """The truth at instants (K,), ascending, without caching."""
        return interpolate_at_instants(
            self.truth, self._stamps(time_s), t0_ns=self.scene.t0_ns, max_gap_s=self.experiment.max_gap_s
        )

    def at_stated(self, time_s: Float, captured_s: tuple[Float, Float]) -> Tracks:
        """The truth at stated instants (K,), ascending; `captured_s`: the earliest and latest true capture of each."""
        return self._keep(self._worlds, np.stack([time_s, *captured_s]), self._at_stated)

    def _keep(self, cache: dict[bytes, T], time_s: Float, compute: Callable[[Float], T]) -> T:
        """The cached value at these instants, else the computed one, which is cached and evicts the oldest."""
        key = time_s.tobytes()
        value = cache.get(key)
        if value is None:
            value = cache[key] = compute(time_s)
            for oldest in list(cache)[:-KEPT]:
                cache.pop(oldest, None)
        return value

    def _at_stated(self, times_s: Float) -> Tracks:
        stamps, earliest, latest = self._stamps(times_s)
        return interpolate_at_stated_instants(
            self.truth, stamps, (earliest, latest), t0_ns=self.scene.t0_ns,
            max_gap_s=self.experiment.max_gap_s,
        )  # fmt: skip

    def _stamps(self, time_s: Float) -> Int:
        return self.scene.t0_ns + np.rint(time_s * 1e9).astype(np.int64)

    def reference(self, time_s: Float) -> Reference:
        """The place that distances are measured from, at instants (K,)."""
        return self._keep(self._references, time_s, self._locate_reference)

    def _locate_reference(self, time_s: Float) -> Reference:
        return locate_reference(self.scene, self.truth, self.experiment, time_s)

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
        """(M,) the first instant of each episode's object in the log."""
        since: Float = self._begins_s[episodes.object_ix]
        return since

    @cached_property
    def _begins_s(self) -> Float:
        """(N,) when each object first is in the log."""
        first = np.full(len(self.scene.object_ids), np.inf)
        np.minimum.at(first, self.truth.object_ix, self.truth.captured_s[self.truth.frame_ix[self.truth.start[:-1]]])
        return first


@dataclass(frozen=True)
class Replay:
    """One prepared log: nothing in it depends on the run or on a configuration's fusion."""

    scene: Scene
    expanded: ExpandedExperiment  # the experiment's units over this log
    truth: Tracks  # the world at its own frames, short gaps filled
    placed: SensorPoses
    chunks: tuple[TimeChunk, ...]
    recorded: RecordedUnits | None
    episodes: Episodes
    encounters: tuple[Encounter, ...]  # those in conflict
    lane_boundaries: tuple[Float, ...] = ()  # (K, 3) each, for showing only
    outside_ix: Int = field(
        default_factory=lambda: np.empty(0, dtype=np.int64)
    )  # (K,) objects that `within` leaves out
    paths_of: Replay | None = None  # the log with bodies between a unit and the ego; None: this one
    kept_draws: KeptDraws = field(init=False, default_factory=KeptDraws)  # what links drew for the lists of this log
    _shares: KeptShares = field(init=False, default_factory=KeptShares)

    def expand(self, experiment: Experiment) -> ExpandedExperiment:
        """The experiment expanded to the units of this log. Raises ValueError where it has others."""
        return expand_alike(experiment, self.expanded)

    @cached_property
    def ego(self) -> EgoPath:
        """The ego's way through the log, which must have an ego."""
        return EgoPath(self.scene, self.truth, self.expanded.max_gap_s)

    @cached_property
    def truth_demand(self) -> TruthDemand | None:
        """When the truth gives the driver a reason to brake; None: needless braking is not measured."""
        braking, needless = self.expanded.braking, self.expanded.needless
        if braking is None or needless is None or self.scene.ego_ix < 0:
            return None
        ego = BrakingEgo(self.ego, braking.driver, needless.slower_mps)
        return find_truth_demand(ego, needless, self.scene, self.truth, self.expanded.max_gap_s)

    @cached_property
    def passing_s(self) -> dict[int, Float]:
        """Intervals (K, 2) by episode in conflict: if the ego begins to brake in one of them, it passes."""
        braking = self.expanded.braking
        if braking is None:
            return {}
        return {
            each.episode_ix: find_passing_intervals(each, braking.driver, braking.margin_m) for each in self.encounters
        }

    @cached_property
    def measured_truth(self) -> Tracks:
        """The truth of objects with an episode, without states; its lists are those of the whole truth."""
        keep = np.repeat(np.isin(self.truth.object_ix, self.episodes.object_ix), np.diff(self.truth.start))
        return self.truth if keep.all() else self.truth.take_rows(np.flatnonzero(keep), states=False)

    def with_units(self, expanded: ExpandedExperiment) -> Replay:
        """The log for an experiment without the units that fuse."""
        return self._keep_observed(replace(self, expanded=expanded))

    def with_recorded(self, recorded: RecordedUnits) -> Replay:
        """The log with other recorded lists, as those of one run."""
        paths_of = None if self.paths_of is None else self.paths_of.with_recorded(recorded)
        return self._keep_observed(replace(self, recorded=recorded, paths_of=paths_of))

    def _keep_observed(self, other: Replay) -> Replay:
        """Another log, with what modelled units observe of this one: it is computed once."""
        shared = ("_whole", "no_rows", "measured", "truth_cache", "_overview", "measured_truth")
        vars(other).update({name: getattr(self, name) for name in shared})
        return other

    def find_episodes_of(self, experiment: Experiment) -> Episodes:
        """The episodes of this log by another `measure`."""
        return _find_kept_episodes(self.scene, self.truth, self.placed, experiment)[0]

    @cached_property
    def sighted(self) -> ExpandedExperiment:
        """The experiment in which recorded units with `views` have a PEM."""
        return give_views(self.expanded)

    @property
    def sight_spans(self) -> SightSpans:
        """The spans, list by list, in which an object is in one state to a unit: of units with a PEM or `views`."""
        return self._overview[0]

    @property
    def ever_met(self) -> Bool:
        """(U,) whether any object ever meets a condition of the PEM of each modelled unit."""
        return self._overview[1]

    @cached_property
    def _overview(self) -> tuple[SightSpans, Bool, int]:
        """`sight_spans`, `ever_met`, and the number of observation rows of objects that have an episode."""
        sight_changes, met_by_chunk, rows, units = [], list[Bool](), 0, list(self.sighted.modelled)
        viewing = give_views(self.expanded, alone=True)
        for chunk in self.chunks:
            observations = self.observe(chunk)
            observed = [(observations, self.expanded)]
            if viewing is not self.expanded:
                observed.append((self._observe_with(viewing, chunk), viewing))
            for seen, experiment in observed:
                episode_ix = self.episodes.number_rows(seen.tracks)
                changed = find_sight_changes(seen, experiment, self.scene.tags, episode_ix)
                unit_ix = np.array([units.index(name) for name in seen.tracks.units], dtype=np.int64)
                sight_changes.append(changed._replace(unit_ix=unit_ix[changed.unit_ix]))
            met_by_chunk.append(observations.ever_met)
            rows += int(np.isin(observations.tracks.row_object_ix, self.episodes.object_ix).sum())
        return join_sight_changes(sight_changes, self.episodes.onset_s), np.any(met_by_chunk, axis=0), rows

    @cached_property
    def truth_cache(self) -> TruthCache:
        """The truth at the instants of fused lists, each computed once."""
        return TruthCache(self.scene, self.truth, self.expanded)

    @cached_property
    def held_frames(self) -> HeldFrames:
        """The frames at which the lists that receivers hold are measured."""
        around = self.truth_cache
        return make_held_frames(self.truth.captured_s, self.episodes.firsts, around.between, around.reference)

    def truth_cache_of(self, chunk: TimeChunk) -> TruthCache:
        """The truth that configurations share: cached for a whole log, made anew for a time chunk."""
        whole = chunk == TimeChunk()
        return self.truth_cache if whole else TruthCache(self.scene, self.truth, self.expanded)

    @cached_property
    def _whole(self) -> Observations:
        return observe_objects(self.scene, self.truth, self.expanded, self.placed, as_read=True)

    @cached_property
    def no_rows(self) -> Observations:
        """The lists of the modelled units of the whole log, without rows."""
        return observe_objects(self.scene, self.truth, self.expanded, self.placed, from_s=np.inf)

    @cached_property
    def measured(self) -> Observations:
        """The observation rows of objects with an episode; visible shares only where a draw depends on them."""
        return self._observe_objects(self.episodes.object_ix)

    def _observe_objects(self, object_ix: Int) -> Observations:
        return join_observations([self.observe(chunk).of_objects(object_ix) for chunk in self.chunks])

    def rows_of(self, object_ix: Int) -> Observations:
        """The observation rows of some objects, with all visible shares, computed anew."""
        return join_observations([self._observe(chunk, chunk.from_s, only_ix=object_ix) for chunk in self.chunks])

    def observe(self, chunk: TimeChunk, from_s: float | None = None) -> Observations:
        """What units observe in a time chunk, or from `from_s` on, as lists may arrive later; cached for a whole log.

        Visible shares are there where a couple of the unit's PEM may apply, and of the ego; NaN elsewhere.
        """
        if chunk == TimeChunk():
            return self._whole
        begin_s = chunk.from_s if from_s is None else from_s
        return self._observe(chunk, begin_s, cache=self._shares, cut_s=chunk.from_s, as_read=True)

    def _observe(self, chunk: TimeChunk, from_s: float, **how: Any) -> Observations:
        """The observation rows of a time chunk; lists, which are those of the whole log, are in memory once."""
        observed = observe_objects(
            self.scene, self.truth, self.expanded, self.placed, from_s=from_s, until_s=chunk.until_s, **how
        )
        return replace(observed, tracks=observed.tracks.in_lists_of(self.no_rows.tracks))

    def _observe_with(self, viewing: ExpandedExperiment, chunk: TimeChunk) -> Observations:
        return observe_objects(
            self.scene, self.truth, viewing, self.placed, from_s=chunk.from_s, until_s=chunk.until_s, as_read=True
        )

    def observe_listable(self, chunk: TimeChunk, from_s: float, *, complete: bool) -> Observations:
        """The rows that can be listed, captured from `from_s` on, of all objects or of those with an episode."""
        if complete:
            return self.observe(chunk, from_s).listable
        if len(self.chunks) == 1:
            return self.measured.listable
        return self.observe(chunk, from_s).of_objects(self.episodes.object_ix).listable

    @property
    def rows_kept(self) -> int:
        """The number of cached observation rows: all of a log in one time chunk, else those of measured objects."""
        return self._overview[2] if len(self.chunks) > 1 else len(self._whole.tracks.frame_ix)

    def add_recorded(self, tracks: Tracks, recorded: RecordedUnits | None) -> Tracks:
        """The lists of modelled units, then those of recorded ones; units in the experiment's order."""
        if recorded is None:
            return tracks
        lists = recorded.tracks
        lists = replace(lists, valid=np.broadcast_to(lists.valid, (len(tracks.valid), len(lists.frame_ix))))
        joined = join_tracks((*tracks.units, *lists.units), [tracks, lists])
        # It decides between lists that arrive together.
        names = tuple(self.expanded.units)
        place = np.array([names.index(name) for name in joined.units])
        return replace(joined, units=names, unit_ix=place[joined.unit_ix], frame_unit_ix=place[joined.frame_unit_ix])

    @cached_property
    def paths(self) -> RadioPath:
        """The radio path of each list (F,), from its unit to the ego: distance (m) and visible share.

        Distance 0: aboard the ego; ∞: no observation of the ego; NaN: a recorded unit. A unit that fuses has those of
        its first member's list before.
        """
        if self.paths_of is not None:
            return self.paths_of.paths
        expanded, senders = self.expanded, self.senders
        of_ego, F = self._observe_objects(np.array([self.scene.ego_ix])), len(senders)
        distance_m: Float = np.full(F, np.inf)
        visible_share: Float = np.zeros(F)
        distance_m[of_ego.tracks.frame_ix] = of_ego.view.range_m
        visible_share[of_ego.tracks.frame_ix] = of_ego.view.visible_share
        ego = self.scene.object_ids[self.scene.ego_ix]
        is_aboard = np.isin(senders, [name for name, unit in expanded.modelled.items() if unit.on in ("ego", ego)])
        is_recorded = np.isin(senders, list(expanded.recorded))
        captured_s = self.recorded_lists.captured_s
        for name, unit in expanded.fusing.items():  # as far as its first member's list before
            lists, member_lists = np.flatnonzero(senders == name), np.flatnonzero(senders == (unit.fuses or ("",))[0])
            place = np.searchsorted(captured_s[member_lists], captured_s[lists] + SAME_INSTANT_S) - 1
            list_before = member_lists[np.maximum(place, 0)] if len(member_lists) else lists
            distance_m[lists], visible_share[lists] = distance_m[list_before], visible_share[list_before]
            is_aboard[lists] = is_aboard[list_before]
        distance_m[is_aboard], visible_share[is_aboard] = 0.0, 1.0
        distance_m[is_recorded] = visible_share[is_recorded] = np.nan
        return RadioPath(distance_m, visible_share)

    @cached_property
    def recorded_lists(self) -> Tracks:
        """The lists (F,) of all units, with the rows of recorded ones alone."""
        return self.add_recorded(self.no_rows.tracks, self.recorded)

    @cached_property
    def senders(self) -> np.ndarray:
        """(F,) the name of the unit of each list of all units; modelled ones first."""
        lists = self.recorded_lists
        return np.array(lists.units, dtype=str)[lists.frame_unit_ix]


def _find_kept_episodes(
    scene: Scene, truth: Tracks, placed: SensorPoses, experiment: Experiment
) -> tuple[Episodes, Int]:
    """The episodes that `within` keeps, and the objects that it leaves out."""
    return keep_episodes_within(scene, truth, find_episodes(scene, truth, placed.static, experiment), experiment)


def prepare_log(recording: Recording, experiment: Experiment, *, onsets_of: Experiment | None = None) -> Replay:
    """The prepared log: all that its runs and configurations share. Raises ExperimentError where an ego is missing.

    `onsets_of`: the experiment that onsets are of, where `experiment` has the units of one run (`resolve_for_run`).
    """
    scene = recording.scene
    if scene.ego_ix < 0:
        driven = experiment.ego != NO_EGO  # a log that says it has none lacks verdicts, and no other log does
        for key, setting in (
            ("braking", driven and experiment.braking),
            ("measure.conflict", experiment.measure.conflict),
        ):
            if setting:
                raise ExperimentError(f"{scene.log}: {key}: no ego in this study to brake or collide")
    expanded = expand_experiment(experiment, scene)
    truth = interpolate_at_instants(
        recording.truth, recording.truth.stamp_ns, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s
    )
    placed = place_units(scene, truth, give_views(expanded))
    lists = {name: observations for name, observations in recording.lists.items() if name in expanded.units}
    recorded = join_recorded_units(
        lists, scene, truth, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s
    )
    episodes, outside_ix = _find_kept_episodes(scene, truth, placed, onsets_of or experiment)
    encounters = find_encounters(scene, truth, episodes, experiment)
    chunks = time_chunks(scene, truth, expanded)
    return Replay(
        scene, expanded, truth, placed, chunks, recorded, episodes, encounters, recording.lane_boundaries, outside_ix
    )
