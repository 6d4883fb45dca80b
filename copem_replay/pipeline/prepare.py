"""Prepare: one log made ready for its runs. Nothing here depends on the run or on a configuration's fusion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from copem_replay.communication.link import KeptDraws
from copem_replay.communication.reception import RadioPath
from copem_replay.core.errors import ExperimentError
from copem_replay.core.interpolation import at_instants
from copem_replay.core.time_chunk import WHOLE, TimeChunk
from copem_replay.core.tracks import Bool, Float, Int, Scene, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recorded_units import RecordedUnits, recorded_units
from copem_replay.io.recording import Recording
from copem_replay.metrics.braking.ego_path import EgoPath
from copem_replay.metrics.braking.encounter import Encounter, encounters
from copem_replay.metrics.braking.verdict import passing
from copem_replay.metrics.episodes import Episodes, episodes
from copem_replay.metrics.line_of_sight import first_sights
from copem_replay.metrics.within import only_within
from copem_replay.perception.observation import KeptShares, Observations, joined_chunks, observations
from copem_replay.perception.sensor_poses import SensorPoses, place
from copem_replay.pipeline.chunking import Reach, time_chunks
from copem_replay.pipeline.expansion import ExpandedExperiment, expand
from copem_replay.pipeline.on_air import OnAir, asks_for_path, has_channel, paths
from copem_replay.pipeline.perceived import Perceived
from copem_replay.pipeline.presence import Presence
from copem_replay.pipeline.receiver import WorldChunk, ghosts_of, listen, seen_by_all
from copem_replay.pipeline.scoring import TruthCache
from copem_replay.pipeline.sent import ClaimedRows, claimed_rows, sent_objects
from copem_replay.pipeline.stated_captures import stated_captures


@dataclass(frozen=True)
class Replay:
    """One log made ready: nothing in it depends on the run or on a configuration."""

    scene: Scene
    expanded: ExpandedExperiment  # the experiment's units over this log
    truth: Tracks  # the world at its own frames, short gaps filled
    placed: SensorPoses
    chunks: tuple[TimeChunk, ...]
    recorded: RecordedUnits | None
    episodes: Episodes
    encounters: tuple[Encounter, ...]  # those in conflict
    lane_boundaries: tuple[Float, ...] = ()  # (K, 3) each, for showing only
    outside_ix: Int = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (K,) what `within` leaves out

    @cached_property
    def ego(self) -> EgoPath:
        """How the ego drives through the log. There has to be one."""
        return EgoPath(self.scene, self.truth, self.expanded.max_gap_s)

    @cached_property
    def passing_s(self) -> dict[int, Float]:
        """For each episode in conflict the beginnings of braking (K, 2), from and to, with which the ego passes."""
        braking = self.expanded.braking
        if braking is None:
            return {}
        return {each.episode_ix: passing(each, braking.driver, braking.margin_m) for each in self.encounters}

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
            found = self.found(chunk)
            sights.append(first_sights(found, self.episodes))
            met.append(found.ever_met)
        return np.min(sights, axis=0), np.any(met, axis=0)

    @cached_property
    def truth_cache(self) -> TruthCache:
        """The truth at the instants of fused lists, each computed once."""
        return TruthCache(self.scene, self.truth, self.expanded)

    def truth_cache_of(self, chunk: TimeChunk) -> TruthCache:
        """The truth that configurations share: of a whole log it is kept, of a part of one it is made anew."""
        if chunk == WHOLE:
            return self.truth_cache
        return TruthCache(self.scene, self.truth, self.expanded)

    @cached_property
    def _shares(self) -> KeptShares:
        return KeptShares()

    @cached_property
    def _whole(self) -> Observations:
        return observations(self.scene, self.truth, self.expanded, self.placed)

    @cached_property
    def measured(self) -> Observations:
        """The rows of objects that are looked at."""
        return self.rows_of(self.episodes.object_ix)

    def rows_of(self, object_ix: Int) -> Observations:
        """The observation rows of some objects."""
        return joined_chunks([self.found(chunk).of_objects(object_ix) for chunk in self.chunks])

    def found(self, chunk: TimeChunk, from_s: float | None = None) -> Observations:
        """The observation rows captured in a time chunk, or since an earlier instant. Those of a whole log are kept."""
        if chunk == WHOLE:
            return self._whole
        return observations(
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
        """The log as the units of an experiment have it, by configuration."""
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
        """The same chunk by chunk, all of it or what is looked at, for runs (S,) that have the same lists.

        `presence`: which units there are; `perceived`: of a log in one chunk what they list in these and other runs.
        """
        sending, equipped = presence.sending, presence.listing
        if self.chunks == (WHOLE,):
            on_air = self.on_air(experiment, runs, equipped, perceived)
            whole = replace(self.world(experiment), on_air=on_air, perceived=perceived)
            yield replace(whole, found=self.measured.listable) if measured_only else whole
            return
        lists = self.lists_only(experiment, runs[:1], equipped)
        units, seen = lists.experiment, seen_by_all(lists, runs[:1], states="true")
        heard = {name: listen(seen, lists, name, sending) for name in units.configurations}
        stated = None
        if units.runs_apart:
            stated = {name: stated_captures(self.scene, of, units, int(runs[0])) for name, of in heard.items()}
        reach = Reach(units, heard, stated)
        for chunk in self.chunks:
            earliest_s = reach.earliest_s(chunk)
            found = self.found(chunk, earliest_s).listable
            yield WorldChunk(
                self.scene,
                self.truth.captured_between(earliest_s, chunk.until_s),
                found.of_objects(self.episodes.object_ix) if measured_only else found,
                None if self.recorded is None else self.recorded.captured_between(earliest_s, chunk.until_s),
                units,
                chunk,
                self.placed,
                earliest_s,
                lists.on_air,
            )

    def lists_only(self, experiment: Experiment, runs: Int | None = None, equipped: Bool | None = None) -> WorldChunk:
        """The same without what is in the lists. Of runs (S,), of which there is one where arrivals are drawn."""
        none = np.empty(0, dtype=np.int64)
        found = observations(self.scene, self.truth, self.expanded, self.placed, from_s=np.inf)
        recorded = None if self.recorded is None else self.recorded.captured_between(np.inf, np.inf)
        units = self.expanded.with_(experiment)
        on_air = None if runs is None else self.on_air(experiment, runs, equipped)
        return WorldChunk(self.scene, self.truth.take_rows(none), found, recorded, units, on_air=on_air)

    def on_air(
        self, experiment: Experiment, runs: Int, equipped: Bool | None = None, perceived: Perceived | None = None
    ) -> OnAir | None:
        """What drawn links go by in one run (1,); None: none is drawn. `equipped (1, U)`: which units list."""
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
            on_air = replace(on_air, sent=sent_objects(units, self._listed_in(units, runs, equipped, perceived)))
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
            found = self.found(chunk).listable
            world = WorldChunk(
                self.scene, self.truth, found, None, units, chunk, self.placed, chunk.from_s, perceived=perceived
            )
            ghosts = ghosts_of(world, runs)
            seen = seen_by_all(world, runs, states="sampled", equipped=equipped, ghosts=ghosts)
            yield world, seen, claimed_rows(world, runs, ghosts)

    def _counts(
        self, units: ExpandedExperiment, runs: Int, equipped: Bool | None, on_air: OnAir, perceived: Perceived | None
    ) -> Int:
        """(F,) how many entries each list of one run has, ghosts among them."""
        counts = np.zeros(0, dtype=np.int64)
        for chunk in self.chunks:
            recorded = None if self.recorded is None else self.recorded.captured_between(chunk.from_s, chunk.until_s)
            found = self.found(chunk).listable
            world = WorldChunk(
                self.scene, self.truth, found, recorded, units, chunk, self.placed, chunk.from_s, on_air, perceived
            )
            seen = seen_by_all(world, runs, states="true", equipped=equipped, ghosts=ghosts_of(world, runs))
            of_chunk = np.bincount(seen.frame_ix[seen.valid[0]], minlength=len(seen.stamp_ns))
            counts = of_chunk + counts if len(counts) else of_chunk
        return counts

    @cached_property
    def paths(self) -> RadioPath:
        """The way of each list of all units to the ego."""
        lists = seen_by_all(self.lists_only(self.expanded.written), np.zeros(1, dtype=np.int64), states="true")
        return paths(self.rows_of(np.array([self.scene.ego_ix])), self.scene, self.expanded, lists)


def prepare(recording: Recording, experiment: Experiment, *, onsets_of: Experiment | None = None) -> Replay:
    """Everything about a log that all runs and configurations share. Raises ExperimentError where an ego is missing.

    `onsets_of`: whose onsets they are, where units of the experiment are only in this run (`expansion.of_run`).
    """
    scene = recording.scene
    if scene.ego_ix < 0:
        for key, asked in (("braking", experiment.braking), ("measure.conflict", experiment.measure.conflict)):
            if asked is not None:
                raise ExperimentError(f"{scene.log}: {key}: no ego in this study to brake or collide")
    expanded = expand(experiment, scene)
    truth = at_instants(recording.truth, recording.truth.stamp_ns, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
    placed = place(scene, truth, expanded)
    lists = {name: found for name, found in recording.lists.items() if name in expanded.units}
    recorded = recorded_units(
        lists, scene, truth, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s
    )
    on, outside_ix = only_within(
        scene, truth, episodes(scene, truth, placed.static, onsets_of or experiment), onsets_of or experiment
    )
    meeting = encounters(scene, truth, on, experiment)
    cut = time_chunks(scene, truth, expanded)
    return Replay(scene, expanded, truth, placed, cut, recorded, on, meeting, recording.lane_boundaries, outside_ix)
