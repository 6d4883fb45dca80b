"""Prepare: what all runs and configurations of one log share, once and chunk by chunk.

A long log is replayed in time chunks, so that memory does not grow with its length. What is cut are the receiver's
instants: a time chunk has those from `from_s` on and before `until_s`. Its lists, what is fused of them, matched and
measured are made, used and dropped before the next chunk; what a receiver must remember across a cut stays. No result
depends on where the cuts are.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.communication.link import KeptDraws
from copem_replay.communication.reception import RadioPath
from copem_replay.core.errors import ExperimentError
from copem_replay.core.interpolation import AROUND_S, interpolate_at_instants
from copem_replay.core.tracks import WHOLE, Bool, Float, Int, Scene, TimeChunk, Tracks
from copem_replay.experiment.schema import Configuration, Experiment
from copem_replay.fusion.interface import ListFusion
from copem_replay.io.recorded_units import RecordedUnits, join_recorded_units
from copem_replay.io.recording import Recording
from copem_replay.metrics.accuracy.held import HeldFrames
from copem_replay.metrics.braking.encounter import EgoPath, Encounter, find_encounters
from copem_replay.metrics.braking.verdict import find_passing_intervals
from copem_replay.metrics.detection.conflict import keep_episodes_within
from copem_replay.metrics.episodes import Episodes, find_episodes, first_sights
from copem_replay.perception.observation import KeptShares, Observations, join_observations, observe_objects
from copem_replay.perception.sensor_poses import SensorPoses, list_instants, place_units
from copem_replay.pipeline.expansion import ExpandedExperiment, Presence, expand_experiment
from copem_replay.pipeline.receiver import (
    StatedCaptures,
    draw_shown_ghosts,
    perceive_all_units,
    receive_lists,
    state_captures,
)
from copem_replay.pipeline.scoring import TruthCache, make_log_frames
from copem_replay.pipeline.world import (
    ClaimedRows,
    OnAir,
    Perceived,
    WorldChunk,
    asks_for_path,
    claim_rows,
    find_radio_paths,
    has_channel,
    select_sent_objects,
)

# Time chunks.

ROWS_AT_ONCE = 500_000
"""Observation rows up to which a log is one time chunk: with one run shown it takes about 1 GB."""
ROWS_A_CHUNK = 250_000
"""Observation rows of a time chunk of a longer log: a few hundred MB."""
ROWS_HELD = 4_000_000
"""Observation rows up to which a log is held at once by what needs all of it: some GB."""
_AFTER = 0.381966
"""Where between two frames a cut is: 1 − 1/φ, where latencies of round numbers hardly ever bring a list."""


def time_chunks(scene: Scene, truth: Tracks, experiment: ExpandedExperiment) -> tuple[TimeChunk, ...]:
    """A log in time chunks of about as many observation rows each."""
    if not _can_be_cut(experiment.configurations.values()):
        return (WHOLE,)
    rows = observation_rows(scene, truth, experiment)
    if rows <= ROWS_AT_ONCE:
        return (WHOLE,)
    _, bounds = truth.by_frame
    pieces = int(-(-rows // ROWS_A_CHUNK))
    frames = np.unique(np.searchsorted(bounds, np.linspace(0, len(truth.frame_ix), pieces + 1)[1:-1]))
    frames = frames[(frames > 0) & (frames < len(truth.stamp_ns))]
    before_s, after_s = truth.captured_s[frames - 1], truth.captured_s[frames]
    # Between two frames: no cut comes between lists of different configurations that are available together.
    cuts = [-np.inf, *(before_s + _AFTER * (after_s - before_s)).tolist(), np.inf]
    return tuple(TimeChunk(*pair) for pair in pairwise(cuts))


def observation_rows(scene: Scene, truth: Tracks, experiment: ExpandedExperiment) -> float:
    """About how many observation rows a log has, with those of the truth, which is perceived like a unit."""
    lists = sum(len(list_instants(scene, truth, unit)) for unit in experiment.modelled.values())
    return len(truth.frame_ix) * (1 + lists / max(len(truth.stamp_ns), 1))


def _can_be_cut(configurations: Iterable[Configuration]) -> bool:
    return all(fusion.resumable for c in configurations if isinstance(fusion := c.fusion, ListFusion))


class Reach:
    """The earliest captures that the receivers need in a time chunk: of lists that arrive, are kept, or looked back to.

    `received`: by configuration the lists that reach its receiver, whatever is in them. `stated`: the captures that
    their units state, None where these are true.
    """

    def __init__(
        self,
        experiment: ExpandedExperiment,
        received: Mapping[str, Tracks],
        stated: Mapping[str, StatedCaptures | None] | None = None,
    ) -> None:
        self._oldest: list[tuple[Float, Float]] = []  # instants, and the oldest capture that each needs
        self._again: list[tuple[Float, Float]] = []
        for name, configuration in experiment.configurations.items():
            lists = received[name]
            schedule = fusion_schedule(lists, max_age_s=configuration.max_age_s)
            if not len(schedule.issue_s):
                continue
            # The lists that arrive at an instant, and those that are fused beside them.
            oldest_s = np.minimum.reduceat(lists.captured_s[schedule.arrived], schedule.arrived_start[:-1])
            used_s = np.where(schedule.newest >= 0, lists.captured_s[schedule.newest], np.inf).min(axis=1)
            if partial := {
                n for n, of in experiment.modelled.items() if of.sends is not None and of.sends.partial
            }:  # entries are kept for max_age_s after a message that leaves them out
                of_partial = np.array([unit in partial for unit in lists.units], dtype=bool)[lists.frame_unit_ix]
                way_s = np.where(
                    of_partial & np.isfinite(lists.common_arrives_s), lists.common_arrives_s - lists.captured_s, 0.0
                )
                used_s = np.minimum(used_s, schedule.issue_s - configuration.max_age_s - way_s.max(initial=0.0))
            self._oldest.append((schedule.issue_s, np.minimum(oldest_s, used_s)))
            fusion = configuration.fusion
            if isinstance(fusion, ListFusion) and fusion.looks_back_s > 0:
                arrives_s, captured_s = lists.common_arrives_s[schedule.arrived], lists.captured_s[schedule.arrived]
                ahead_s = 0.0
                if (
                    stated is not None and (stated_captures := stated[name]) is not None
                ):  # it looks back in stated captures
                    captured_s, ahead_s = stated_captures.stated_s[schedule.arrived], stated_captures.ahead_s
                newest_s = np.maximum.accumulate(captured_s)
                self._again.append((arrives_s, newest_s - ahead_s - fusion.looks_back_s - AROUND_S))

    def earliest_s(self, chunk: TimeChunk) -> float:
        """The earliest capture that a time chunk needs."""
        earliest_s = chunk.from_s
        for issue_s, oldest_s in self._oldest:
            first, after = np.searchsorted(issue_s, (chunk.from_s, chunk.until_s))
            earliest_s = min(earliest_s, float(oldest_s[first:after].min(initial=np.inf)) - AROUND_S)
        for arrives_s, needed_s in self._again:
            arrived = int(np.searchsorted(arrives_s, chunk.from_s))
            if arrived:
                earliest_s = min(earliest_s, float(needed_s[arrived - 1]))
        return earliest_s


@dataclass(frozen=True)
class Replay:
    """One log made ready for its runs: nothing in it depends on the run or on a configuration's fusion."""

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

    @cached_property
    def ego(self) -> EgoPath:
        """The ego's way through the log, which must have an ego."""
        return EgoPath(self.scene, self.truth, self.expanded.max_gap_s)

    @cached_property
    def passing_s(self) -> dict[int, Float]:
        """By episode in conflict the intervals (K, 2) in which the ego may begin to brake and passes."""
        braking = self.expanded.braking
        if braking is None:
            return {}
        return {
            each.episode_ix: find_passing_intervals(each, braking.driver, braking.margin_m) for each in self.encounters
        }

    def find_episodes_of(self, experiment: Experiment) -> Episodes:
        """The episodes of this log by another `measure`."""
        return _find_kept_episodes(self.scene, self.truth, self.placed, experiment)[0]

    @property
    def first_sights_s(self) -> Float:
        """(U, M) when each modelled unit first has each episode in sight; inf: never."""
        return self._overview[0]

    @property
    def ever_met(self) -> Bool:
        """(U,) whether any object ever meets a condition of the PEM of each modelled unit."""
        return self._overview[1]

    @cached_property
    def _overview(self) -> tuple[Float, Bool]:
        sights: list[Float] = []
        met: list[Bool] = []
        for chunk in self.chunks:
            observations = self.observe(chunk)
            sights.append(first_sights(observations, self.episodes))
            met.append(observations.ever_met)
        return np.min(sights, axis=0), np.any(met, axis=0)

    @cached_property
    def truth_cache(self) -> TruthCache:
        """The truth at the instants of fused lists, each computed once."""
        return TruthCache(self.scene, self.truth, self.expanded)

    @cached_property
    def held_frames(self) -> HeldFrames:
        """The frames at which it is measured what receivers hold."""
        return make_log_frames(self.truth_cache, self.episodes)

    def truth_cache_of(self, chunk: TimeChunk) -> TruthCache:
        """The truth that configurations share: of a whole log it is kept, of a time chunk it is made anew."""
        if chunk == WHOLE:
            return self.truth_cache
        return TruthCache(self.scene, self.truth, self.expanded)

    @cached_property
    def _shares(self) -> KeptShares:
        return KeptShares()

    @cached_property
    def _whole(self) -> Observations:
        return observe_objects(self.scene, self.truth, self.expanded, self.placed)

    @cached_property
    def measured(self) -> Observations:
        """The observation rows of objects that have an episode."""
        return self.rows_of(self.episodes.object_ix)

    def rows_of(self, object_ix: Int) -> Observations:
        """The observation rows of some objects."""
        return join_observations([self.observe(chunk).of_objects(object_ix) for chunk in self.chunks])

    def observe(self, chunk: TimeChunk, from_s: float | None = None) -> Observations:
        """The observation rows captured in a time chunk, or from `from_s` on. Those of a whole log are kept."""
        if chunk == WHOLE:
            return self._whole
        return observe_objects(
            self.scene,
            self.truth,
            self.expanded,
            self.placed,
            from_s=chunk.from_s if from_s is None else from_s,
            until_s=chunk.until_s,
            kept=self._shares,
            cut_s=chunk.from_s,
        )

    def world(self, experiment: Experiment) -> WorldChunk:
        """The whole log as the units of an experiment perceive it."""
        units = self.expanded.with_(experiment)
        return WorldChunk(self.scene, self.truth, self._whole.listable, self.recorded, units, placed=self.placed)

    def worlds(
        self,
        experiment: Experiment,
        runs: Int,
        presence: Presence,
        *,
        measured_only: bool = False,
        perceived: Perceived | None = None,
    ) -> Iterator[WorldChunk]:
        """The log as units perceive it, chunk by chunk, for runs (S,) that have the same lists.

        `presence`: which units there are. `measured_only`: of objects with an episode. `perceived`: of a log in one
        chunk what units list in these and other runs.
        """
        sending, equipped = presence.sending, presence.listing
        if self.chunks == (WHOLE,):
            on_air = self.on_air(experiment, runs, equipped, perceived)
            whole = replace(self.world(experiment), on_air=on_air, perceived=perceived)
            yield replace(whole, observations=self.measured.listable) if measured_only else whole
            return
        lists = self.lists_only(experiment, runs[:1], equipped)
        units, seen = lists.experiment, perceive_all_units(lists, runs[:1], states="true")
        received = {name: receive_lists(seen, lists, name, sending) for name in units.configurations}
        stated = None
        if units.runs_apart:
            stated = {name: state_captures(self.scene, of, units, int(runs[0])) for name, of in received.items()}
        reach = Reach(units, received, stated)
        for chunk in self.chunks:
            earliest_s = reach.earliest_s(chunk)
            observations = self.observe(chunk, earliest_s).listable
            yield WorldChunk(
                self.scene,
                self.truth.captured_between(earliest_s, chunk.until_s),
                observations.of_objects(self.episodes.object_ix) if measured_only else observations,
                None if self.recorded is None else self.recorded.captured_between(earliest_s, chunk.until_s),
                units,
                chunk,
                self.placed,
                earliest_s,
                lists.on_air,
            )

    def lists_only(self, experiment: Experiment, runs: Int | None = None, equipped: Bool | None = None) -> WorldChunk:
        """The lists of the whole log without entries. `runs (S,)`: one if arrivals are drawn; None: no draws."""
        none = np.empty(0, dtype=np.int64)
        observations = observe_objects(self.scene, self.truth, self.expanded, self.placed, from_s=np.inf)
        recorded = None if self.recorded is None else self.recorded.captured_between(np.inf, np.inf)
        units = self.expanded.with_(experiment)
        on_air = None if runs is None else self.on_air(experiment, runs, equipped)
        return WorldChunk(self.scene, self.truth.take_rows(none), observations, recorded, units, on_air=on_air)

    def on_air(
        self, experiment: Experiment, runs: Int, equipped: Bool | None = None, perceived: Perceived | None = None
    ) -> OnAir | None:
        """The input of drawn links in one run (1,); None: no link is drawn. `equipped (1, U)`: which units list."""
        units = self.expanded.with_(experiment)
        if not units.arrivals_differ:
            return None
        if perceived is None:
            return self._on_air(units, runs, equipped, None)
        return perceived.on_air(int(runs[0]), lambda: self._on_air(units, runs, equipped, perceived))

    def _on_air(
        self, units: ExpandedExperiment, runs: Int, equipped: Bool | None, perceived: Perceived | None
    ) -> OnAir:
        path = self.paths if asks_for_path(units, self.scene) else None
        on_air = OnAir(int(runs[0]), path, None, kept=self._drawn)
        if units.sends:
            on_air = replace(on_air, sent=select_sent_objects(units, self._listed_in(units, runs, equipped, perceived)))
        if has_channel(units):
            on_air = replace(on_air, objects=self._counts(units, runs, equipped, on_air, perceived))
        return on_air

    @cached_property
    def _drawn(self) -> KeptDraws:
        return KeptDraws()

    def _listed_in(
        self, units: ExpandedExperiment, runs: Int, equipped: Bool | None, perceived: Perceived | None
    ) -> Iterator[tuple[WorldChunk, Tracks, ClaimedRows]]:
        """What the modelled units list in one run, chunk by chunk."""
        for chunk in self.chunks:
            observations = self.observe(chunk).listable
            world = WorldChunk(
                self.scene, self.truth, observations, None, units, chunk, self.placed, chunk.from_s, perceived=perceived
            )
            ghosts = draw_shown_ghosts(world, runs)
            seen = perceive_all_units(world, runs, states="sampled", equipped=equipped, ghosts=ghosts)
            yield world, seen, claim_rows(world, runs, ghosts)

    def _counts(
        self, units: ExpandedExperiment, runs: Int, equipped: Bool | None, on_air: OnAir, perceived: Perceived | None
    ) -> Int:
        """(F,) how many entries each list of one run has, ghosts among them."""
        counts = np.zeros(0, dtype=np.int64)
        for chunk in self.chunks:
            recorded = None if self.recorded is None else self.recorded.captured_between(chunk.from_s, chunk.until_s)
            observations = self.observe(chunk).listable
            world = WorldChunk(
                self.scene,
                self.truth,
                observations,
                recorded,
                units,
                chunk,
                self.placed,
                chunk.from_s,
                on_air,
                perceived,
            )
            seen = perceive_all_units(
                world, runs, states="true", equipped=equipped, ghosts=draw_shown_ghosts(world, runs)
            )
            of_chunk = np.bincount(seen.frame_ix[seen.valid[0]], minlength=len(seen.stamp_ns))
            counts = of_chunk + counts if len(counts) else of_chunk
        return counts

    @cached_property
    def paths(self) -> RadioPath:
        """The radio path of each list of all units to the ego."""
        return find_radio_paths(self.rows_of(np.array([self.scene.ego_ix])), self.scene, self.expanded, self._lists)

    @property
    def senders(self) -> np.ndarray:
        """(F,) the unit of each list of all units, by name."""
        return np.array(self._lists.units)[self._lists.frame_unit_ix]

    @cached_property
    def _lists(self) -> Tracks:
        return perceive_all_units(self.lists_only(self.expanded.written), np.zeros(1, dtype=np.int64), states="true")


def _find_kept_episodes(
    scene: Scene, truth: Tracks, placed: SensorPoses, experiment: Experiment
) -> tuple[Episodes, Int]:
    """The episodes that `within` keeps, and the objects that it leaves out."""
    return keep_episodes_within(scene, truth, find_episodes(scene, truth, placed.static, experiment), experiment)


def prepare_log(recording: Recording, experiment: Experiment, *, onsets_of: Experiment | None = None) -> Replay:
    """Everything about a log that all runs and configurations share. Raises ExperimentError where an ego is missing.

    `onsets_of`: the experiment that onsets are of, where `experiment` has the units of one run (`resolve_for_run`).
    """
    scene = recording.scene
    if scene.ego_ix < 0:
        for key, asked in (("braking", experiment.braking), ("measure.conflict", experiment.measure.conflict)):
            if asked is not None:
                raise ExperimentError(f"{scene.log}: {key}: no ego in this study to brake or collide")
    expanded = expand_experiment(experiment, scene)
    truth = interpolate_at_instants(
        recording.truth, recording.truth.stamp_ns, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s
    )
    placed = place_units(scene, truth, expanded)
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
