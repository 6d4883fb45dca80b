"""Replay: one log through one experiment. What does not depend on the run is prepared once; a block of runs is a pure
function of it, so that blocks can be computed anywhere, in any order, by any number of workers.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd

from copem_replay.communication.arrivals import instants
from copem_replay.core.errors import ExperimentError
from copem_replay.core.fused_tracks import Belief
from copem_replay.core.interpolation import at_instants
from copem_replay.core.time_chunk import WHOLE, Stretch
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float, Int, Scene, Tracks, spliced
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recorded_units import RecordedUnits, recorded_units
from copem_replay.io.recording import Recording
from copem_replay.metrics.braking.ego_path import EgoCourse
from copem_replay.metrics.braking.encounter import Encounter, encounters
from copem_replay.metrics.braking.verdict import passing
from copem_replay.metrics.detection.by_truth_id import detect
from copem_replay.metrics.detection.conflict import Foreseeing
from copem_replay.metrics.detections_table import Events, table
from copem_replay.metrics.episodes import Looks, looks
from copem_replay.metrics.line_of_sight import first_sights, in_sight_s
from copem_replay.perception.observation import Candidates, KeptShares, candidates, joined_stretches
from copem_replay.perception.sensor_poses import Placed, place
from copem_replay.pipeline.chunking import ROWS_A_STRETCH, ROWS_HELD, Reach, candidate_rows, stretches
from copem_replay.pipeline.conversions import as_belief
from copem_replay.pipeline.expansion import Fleet, fleet_of
from copem_replay.pipeline.receiver import Believed, Receivers, World, by_truth, listen, seen_by_all
from copem_replay.pipeline.scoring import Appraisal, Appraiser, Surroundings, match_lists

BLOCK_BYTES = 200_000_000
"""How much a block may hold (chosen)."""

STATE_BYTES = 400
"""Bytes of a row × run cell where states are sampled, fused and measured, else one (chosen: fifty numbers)."""

WORTH_A_BLOCK = 1_000_000
"""Row × run cells below which a block is not cut further (chosen: a few milliseconds)."""


_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class Replay:
    """One log made ready: nothing in it depends on the run or on a configuration."""

    scene: Scene
    fleet: Fleet  # the experiment's units over this log
    truth: Tracks  # the world at its own frames, short gaps filled
    placed: Placed
    stretches: tuple[Stretch, ...]
    recorded: RecordedUnits | None
    looks: Looks
    encounters: tuple[Encounter, ...]  # those in conflict
    lane_boundaries: tuple[Float, ...] = ()  # (K, 3) each, for showing only

    @cached_property
    def ego(self) -> EgoCourse:
        """How the ego drives through the log. There has to be one."""
        return EgoCourse(self.scene, self.truth, self.fleet.experiment.max_gap_s)

    @cached_property
    def passing_s(self) -> dict[int, Float]:
        """For each look in conflict the beginnings of braking (K, 2), from and to, with which the ego passes."""
        braking = self.fleet.experiment.braking
        if braking is None:
            return {}
        return {each.look_ix: passing(each, braking.driver, braking.margin_m) for each in self.encounters}

    @property
    def first_sights_s(self) -> Float:
        """(U, M) when each modelled unit first has each look in sight; inf: never."""
        return self._overview[0]

    @property
    def ever_met(self) -> Bool:
        """(U,) whether any object ever meets a condition of the PEM of each modelled unit."""
        return self._overview[1]

    @cached_property
    def _overview(self) -> tuple[Float, Bool]:
        sights: list[Float] = []
        met: list[Bool] = []
        for stretch in self.stretches:
            found = self.found(stretch)
            sights.append(first_sights(found, self.looks))
            met.append(found.ever_met)
        return np.min(sights, axis=0), np.any(met, axis=0)

    @cached_property
    def surroundings(self) -> Surroundings:
        """The truth at the instants of fused lists, each computed once."""
        return Surroundings(self.scene, self.truth, self.fleet.experiment)

    @cached_property
    def _shares(self) -> KeptShares:
        return KeptShares()

    @cached_property
    def _whole(self) -> Candidates:
        return candidates(self.scene, self.truth, self.fleet.experiment, self.placed)

    @cached_property
    def measured(self) -> Candidates:
        """The rows of objects that are looked at."""
        return self.rows_of(self.looks.object_ix)

    def rows_of(self, object_ix: Int) -> Candidates:
        """The candidate rows of some objects."""
        return joined_stretches([self.found(stretch).of_objects(object_ix) for stretch in self.stretches])

    def found(self, stretch: Stretch, from_s: float | None = None) -> Candidates:
        """The candidate rows captured in a stretch, or since an earlier instant. Those of a whole log are kept."""
        if stretch == WHOLE:
            return self._whole
        return candidates(
            self.scene,
            self.truth,
            self.fleet.experiment,
            self.placed,
            from_s=stretch.from_s if from_s is None else from_s,
            until_s=stretch.until_s,
            kept=self._shares,
            cut_s=stretch.from_s,
        )

    def world(self, experiment: Experiment) -> World:
        """The log as the units of an experiment have it, by configuration."""
        units = fleet_of(experiment, self.scene).experiment
        return World(self.scene, self.truth, self._whole.listable, self.recorded, units)

    def worlds(self, experiment: Experiment, there: Bool | None, *, measured_only: bool = False) -> Iterator[World]:
        """The same stretch by stretch, all of it or what is looked at, for receivers of the units `there (U,)`."""
        if self.stretches == (WHOLE,):
            whole = self.world(experiment)
            yield replace(whole, found=self.measured.listable) if measured_only else whole
            return
        lists = self.lists_only(experiment)
        units, seen = lists.experiment, seen_by_all(lists, np.arange(1), states="true")
        reach = Reach(
            units, {name: listen(seen, lists.truth, units, c, there) for name, c in units.configurations.items()}
        )
        for stretch in self.stretches:
            earliest_s = reach.earliest_s(stretch)
            found = self.found(stretch, earliest_s).listable
            yield World(
                self.scene,
                self.truth.captured_between(earliest_s, stretch.until_s),
                found.of_objects(self.looks.object_ix) if measured_only else found,
                None if self.recorded is None else self.recorded.captured_between(earliest_s, stretch.until_s),
                units,
                stretch,
            )

    def lists_only(self, experiment: Experiment) -> World:
        """The same without what is in the lists."""
        none = np.empty(0, dtype=np.int64)
        found = candidates(self.scene, self.truth, self.fleet.experiment, self.placed, from_s=np.inf)
        recorded = None if self.recorded is None else self.recorded.captured_between(np.inf, np.inf)
        units = fleet_of(experiment, self.scene).experiment
        return World(self.scene, self.truth.take_rows(none), found, recorded, units)


@dataclass(frozen=True)
class Outcome:
    """What a block of runs (S,) gave: rows of `detections.parquet`, and by configuration how good the lists were.

    `worked_s`, `accuracy_s`: how long it took, and how much of that `measure: {accuracy: false}` would have spared.
    """

    log: str
    runs: Int
    table: pd.DataFrame
    appraisals: dict[str, Appraisal]
    worked_s: float
    accuracy_s: float


def prepare(recording: Recording, experiment: Experiment, *, onsets_of: Experiment | None = None) -> Replay:
    """Everything about a log that all runs and configurations share. Raises ExperimentError where an ego is missing.

    `onsets_of`: whose onsets they are, where units of the experiment are only in this run (`fleet.of_run`).
    """
    scene = recording.scene
    if scene.ego_ix < 0:
        for key, asked in (("braking", experiment.braking), ("measure.conflict", experiment.measure.conflict)):
            if asked is not None:
                raise ExperimentError(f"{scene.log}: {key}: no ego in this study to brake or collide")
    fleet = fleet_of(experiment, scene)
    truth = at_instants(recording.truth, recording.truth.stamp_ns, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
    placed = place(scene, truth, fleet.experiment)
    recorded = recorded_units(
        recording.lists, scene, truth, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s
    )
    on = looks(scene, truth, placed.static, onsets_of or experiment)
    meeting = encounters(scene, truth, on, experiment)
    cut = stretches(scene, truth, fleet.experiment)
    return Replay(scene, fleet, truth, placed, cut, recorded, on, meeting, recording.lane_boundaries)


def blocks(replay: Replay, experiment: Experiment, jobs: int) -> list[Int]:
    """The runs cut into blocks, small enough for memory and enough of them for the workers."""
    states = _needs_all(experiment) or experiment.measure.conflict is not None
    if len(replay.stretches) > 1:
        rows = ROWS_A_STRETCH
    else:
        found = replay.found(WHOLE) if _needs_all(experiment) else replay.measured
        rows = max(len(found.tracks.frame_ix), 1)
    even = -(-experiment.runs // jobs)
    # Smaller ones show progress and can be interrupted sooner, down to a size at which they would only cost time.
    small = max(-(-even // 8), WORTH_A_BLOCK // rows)
    at_once = BLOCK_BYTES // (rows * (STATE_BYTES if states else 1))
    size = max(1, min(at_once, even, small))
    return [np.arange(k, min(k + size, experiment.runs)) for k in range(0, experiment.runs, size)]


def _needs_all(experiment: Experiment) -> bool:
    """Whether anything goes by whole lists, and not only by whether they hold a measured object."""
    return experiment.measure.accuracy or _matches(experiment)


def _matches(experiment: Experiment) -> bool:
    """Whether anything is known by match, for which lists are needed whether their accuracy is measured or not."""
    others = any(not by_truth(configuration) for configuration in experiment.configurations.values())
    return experiment.measure.match.always or others


def replay_block(replay: Replay, experiment: Experiment, runs: Int) -> pd.DataFrame:
    """Only what was known and when: the rows of `detections.parquet` of one block of runs (S,), without accuracy."""
    when = experiment.model_copy(update={"measure": experiment.measure.model_copy(update={"accuracy": False})})
    return pd.concat([part.table for part in outcomes(replay, when, runs)], ignore_index=True)


def outcomes(replay: Replay, experiment: Experiment, runs: Int) -> list[Outcome]:
    """What one block of runs (S,) gives; in several parts where not all runs have the same units."""
    equipped = replay.fleet.equipped(replay.scene.log, runs)
    measure = experiment.measure
    by_entry = measure.confirm.of == 1 and measure.conflict is None and not _needs_all(experiment)
    if equipped is None or by_entry:
        return [_block(replay, experiment, runs, equipped, None)]
    # Which lists there are decides what is consecutive: runs with the same units go together.
    patterns, which = np.unique(equipped, axis=0, return_inverse=True)
    return [_block(replay, experiment, runs[which == k], None, there) for k, there in enumerate(patterns)]


def _block(replay: Replay, experiment: Experiment, runs: Int, equipped: Bool | None, there: Bool | None) -> Outcome:
    """What runs (S,) give: `equipped (S, U)` says which units list anything, `there (U,)` which send lists at all."""
    measure, began_s = experiment.measure, time.perf_counter()
    sight_s = _in_sight(replay, experiment, equipped, there)
    events = _by_truth_id(replay, experiment, runs, equipped, there, sight_s)
    appraisals: dict[str, Appraisal] = {}
    everything, accuracy_s, lists_s = _needs_all(experiment), 0.0, time.perf_counter()
    if everything or measure.conflict is not None:
        receivers = Receivers(runs, there)
        judges: dict[str, _Judge] = {}
        for world in replay.worlds(experiment, there, measured_only=not everything):
            around = _around(replay, world.stretch)
            for name, believed in receivers.believe(world):
                if name not in judges:
                    judges[name] = _Judge(replay, experiment, believed, receivers.issue_s(name), len(runs))
                judges[name].add(around, believed)
        for name, judge in judges.items():
            appraisal, foreseen_s = judge.result()
            if appraisal is not None:
                appraisals[name] = appraisal
                if name not in events or measure.match.always:
                    events[name] = Events(judge.units, appraisal.detections, sight_s[name])
            if foreseen_s is not None:
                events[name] = replace(events[name], foreseen_s=foreseen_s)
            accuracy_s += judge.accuracy_s
        if not _matches(experiment) and measure.conflict is None:  # for nothing else
            accuracy_s = time.perf_counter() - lists_s
    ordered = {name: events[name] for name in experiment.configurations}
    rows = table(replay.scene, replay.truth, experiment, replay.looks, replay.encounters, runs, ordered)
    return Outcome(replay.scene.log, runs, rows, appraisals, time.perf_counter() - began_s, accuracy_s)


class _Judge:
    """What comes of one configuration's lists, stretch by stretch."""

    def __init__(self, replay: Replay, experiment: Experiment, first: Believed, issue_s: Float, runs: int) -> None:
        measure = experiment.measure
        self.units, self._runs = first.heard.units, runs
        self._appraiser = self._foreseeing = None
        if _needs_all(experiment):
            self._appraiser = Appraiser(replay.surroundings, replay.looks, first, issue_s, measure)
        if measure.conflict is not None:
            self._foreseeing = Foreseeing(
                replay.ego,
                replay.looks,
                measure.conflict,
                confirm=measure.confirm,
                count_earlier=measure.count_earlier,
            )

    def add(self, around: Surroundings, believed: Believed) -> None:
        matches = None if self._appraiser is None else self._appraiser.add(around, believed)
        if self._foreseeing is None:
            return
        if believed.belief is not None:
            self._foreseeing.add(believed.belief)
        else:  # lists without truth ids: run by run, by what they were matched with
            assert matches is not None
            for s in range(len(believed.lists.start)):
                belief = as_belief(believed.lists, s, matches, believed.heard, believed.at.issue_s, believed.at.newest)
                self._foreseeing.add(belief, s)
        self._foreseeing.next(believed.at.issue_s)

    @property
    def accuracy_s(self) -> float:
        """How long measuring accuracy took."""
        return 0.0 if self._appraiser is None else self._appraiser.accuracy_s

    def result(self) -> tuple[Appraisal | None, Float | None]:
        appraisal = None if self._appraiser is None else self._appraiser.result(self._runs)
        return appraisal, None if self._foreseeing is None else self._foreseeing.result()


def _in_sight(replay: Replay, experiment: Experiment, equipped: Bool | None, there: Bool | None) -> dict[str, Float]:
    """By configuration when any of its units first has each look in sight: (S | 1, M)."""
    equipped = equipped if there is None else there[None]
    fleet = fleet_of(experiment, replay.scene).experiment
    return {
        name: in_sight_s(replay.first_sights_s, fleet, fleet.units_of(configuration), equipped)
        for name, configuration in fleet.configurations.items()
    }


def _by_truth_id(
    replay: Replay,
    experiment: Experiment,
    runs: Int,
    equipped: Bool | None,
    there: Bool | None,
    sight_s: dict[str, Float],
) -> dict[str, Events]:
    """Detections of the configurations that have truth ids: they need no states, only who was listed."""
    units = fleet_of(experiment, replay.scene).experiment
    chosen = {name: c for name, c in units.configurations.items() if by_truth(c)}
    if not chosen:
        return {}
    seen = _sightings(replay, units, runs, equipped)
    events: dict[str, Events] = {}
    for name, configuration in chosen.items():
        heard = listen(seen, replay.truth, units, configuration, there)
        result = detect(
            heard,
            replay.looks,
            confirm=experiment.measure.confirm,
            count_earlier=experiment.measure.count_earlier,
            max_age_s=configuration.max_age_s,
        )
        events[name] = Events(heard.units, result, sight_s[name])
    return events


def _sightings(replay: Replay, experiment: Experiment, runs: Int, equipped: Bool | None) -> Tracks:
    """Who was listed in the runs (S,), at least of what is looked at. Of a long log without states."""
    pieces = []
    for stretch in replay.stretches:
        found = replay.measured if stretch == WHOLE else replay.found(stretch).of_objects(replay.looks.object_ix)
        found = found.listable
        recorded = None
        if replay.recorded is not None:
            recorded = replay.recorded.captured_between(stretch.from_s, stretch.until_s)
        world = World(replay.scene, replay.truth, found, recorded, experiment, stretch)
        seen = seen_by_all(world, runs, states="true", equipped=equipped)
        if stretch == WHOLE:
            return seen
        looked_at = np.isin(seen.row_object_ix, replay.looks.object_ix)
        pieces.append(seen.take_rows(np.flatnonzero(seen.valid.any(axis=0) & looked_at)))
    return spliced(pieces, states=False)[0]


def _around(replay: Replay, stretch: Stretch) -> Surroundings:
    """What configurations share: of a whole log for good, of a stretch for the time being."""
    return (
        replay.surroundings if stretch == WHOLE else Surroundings(replay.scene, replay.truth, replay.fleet.experiment)
    )


@dataclass(frozen=True)
class Beliefs:
    """What the receiver believes in one run, configuration by configuration: its fused lists, stretch after stretch.

    As often as one likes; of a log that is one stretch they are kept, of a longer one made anew each time.
    """

    replay: Replay
    experiment: Experiment
    run: int

    def __iter__(self) -> Iterator[dict[str, Belief]]:
        if len(self.replay.stretches) == 1:
            yield self._all
        else:
            yield from self._made()

    def whole(self) -> dict[str, Belief]:
        """All of it at once. Raises ExperimentError where that is too much."""
        replay = self.replay
        if len(replay.stretches) == 1:
            return self._all
        if candidate_rows(replay.scene, replay.truth, replay.fleet.experiment) > ROWS_HELD:
            raise ExperimentError(f"{replay.scene.log}: too long to be held at once; take a window of it")
        return replace(self, replay=replace(replay, stretches=(WHOLE,))).whole()

    @cached_property
    def _all(self) -> dict[str, Belief]:
        return next(self._made())

    def _made(self) -> Iterator[dict[str, Belief]]:
        replay, runs = self.replay, np.array([self.run])
        equipped = replay.fleet.equipped(replay.scene.log, runs)
        there = None if equipped is None else equipped[0]
        receivers = Receivers(runs, there)
        for world in replay.worlds(self.experiment, there):
            around = _around(replay, world.stretch)
            result = {}
            for name, one in receivers.believe(world):
                if one.belief is not None:
                    result[name] = one.belief
                else:
                    matches = match_lists(around, one, self.experiment.measure)
                    result[name] = as_belief(one.lists, 0, matches, one.heard, one.at.issue_s, one.at.newest)
            yield result


def believed(replay: Replay, experiment: Experiment, run: int) -> dict[str, Belief]:
    """What the receiver believes in one run of a log that is not long."""
    return Beliefs(replay, experiment, run).whole()


def list_rates(replay: Replay, experiment: Experiment) -> dict[str, tuple[int, float]]:
    """For each configuration how many intervals there are between fused lists issued while the log lasts, and the
    seconds they cover.

    Units that only some runs have are taken to be there.
    """
    world = replay.lists_only(experiment)
    seen = seen_by_all(world, np.arange(1), states="true")
    rates = {}
    for name, configuration in world.experiment.configurations.items():
        heard = listen(seen, world.truth, world.experiment, configuration)
        issue_s = instants(heard, max_age_s=configuration.max_age_s).issue_s
        issue_s = issue_s[(issue_s >= -_TOLERANCE_S) & (issue_s <= world.scene.end_s + _TOLERANCE_S)]
        rates[name] = (len(issue_s) - 1, float(issue_s[-1] - issue_s[0])) if len(issue_s) > 1 else (0, 0.0)
    return rates
