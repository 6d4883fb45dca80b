"""Replay: one log through one experiment. What does not depend on the run is prepared once; a block of runs is a pure
function of it, so that blocks can be computed anywhere, in any order, by any number of workers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd

from copem_replay.appraise import Appraisal, Surroundings, appraise, match_lists
from copem_replay.believe import Believed, World, believe, by_truth, listen, seen_by_all
from copem_replay.braking.course import EgoCourse
from copem_replay.braking.encounter import Encounter, encounters
from copem_replay.braking.verdict import passing
from copem_replay.candidates import Candidates, candidates
from copem_replay.detect import detect
from copem_replay.errors import ExperimentError
from copem_replay.experiment import Experiment
from copem_replay.fleet import Fleet, fleet_of
from copem_replay.foresee import foreseen
from copem_replay.fusion.as_lists import as_belief
from copem_replay.fusion.belief import Belief
from copem_replay.fusion.instants import instants
from copem_replay.measure import Events, table
from copem_replay.onset import Looks, looks
from copem_replay.read import Recording
from copem_replay.recorded import RecordedUnits, recorded_units
from copem_replay.resample import at_instants
from copem_replay.sight import first_sights, in_sight_s
from copem_replay.tracks import Bool, Float, Int, Scene, Tracks

BLOCK_BYTES = 200_000_000
"""How much a block may hold (chosen)."""

STATE_BYTES = 400
"""Bytes of a row × run cell where states are sampled, fused and measured, else one (chosen: fifty numbers)."""

WORTH_A_BLOCK = 1_000_000
"""Row × run cells below which a block is not cut further (chosen: a few milliseconds)."""


@dataclass(frozen=True)
class Replay:
    """One log made ready: nothing in it depends on the run or on a configuration."""

    scene: Scene
    fleet: Fleet  # the experiment's units over this log
    truth: Tracks  # the world at its own frames, short gaps filled
    found: Candidates
    measured: Candidates  # the rows of objects that are looked at
    recorded: RecordedUnits | None
    looks: Looks
    encounters: tuple[Encounter, ...]  # those in conflict

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

    @cached_property
    def first_sights_s(self) -> Float:
        """(U, M) when each modelled unit first has each look in sight; inf: never."""
        return first_sights(self.measured, self.looks)

    @cached_property
    def surroundings(self) -> Surroundings:
        """The truth at the instants of fused lists, each computed once."""
        return Surroundings(self.scene, self.truth, self.fleet.experiment)

    def world(self, experiment: Experiment, *, measured_only: bool = False) -> World:
        """The log as the units of an experiment have it, by configuration: all of it, or what is looked at."""
        found = self.measured if measured_only else self.found
        return World(self.scene, self.truth, found, self.recorded, fleet_of(experiment, self.scene).experiment)


@dataclass(frozen=True)
class Outcome:
    """What a block of runs (S,) gave: rows of `detections.parquet`, and by configuration how good the lists were."""

    log: str
    runs: Int
    table: pd.DataFrame
    appraisals: dict[str, Appraisal]


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
    found = candidates(scene, truth, fleet.experiment)
    recorded = recorded_units(
        recording.lists, scene, truth, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s
    )
    on = looks(scene, truth, found.static, onsets_of or experiment)
    meeting = encounters(scene, truth, on, experiment)
    return Replay(scene, fleet, truth, found, found.of_objects(on.object_ix), recorded, on, meeting)


def blocks(replay: Replay, experiment: Experiment, jobs: int) -> list[Int]:
    """The runs cut into blocks, small enough for memory and enough of them for the workers."""
    states = _needs_all(experiment) or experiment.measure.conflict is not None
    candidate_rows = replay.found if _needs_all(experiment) else replay.measured
    rows = max(len(candidate_rows.tracks.frame_ix), 1)
    even = -(-experiment.runs // jobs)
    # Smaller ones show progress and can be interrupted sooner, down to a size at which they would only cost time.
    small = max(-(-even // 8), WORTH_A_BLOCK // rows)
    at_once = BLOCK_BYTES // (rows * (STATE_BYTES if states else 1))
    size = max(1, min(at_once, even, small))
    return [np.arange(k, min(k + size, experiment.runs)) for k in range(0, experiment.runs, size)]


def _needs_all(experiment: Experiment) -> bool:
    """Whether anything goes by whole lists, and not only by whether they hold a measured object."""
    measure = experiment.measure
    others = any(not by_truth(configuration) for configuration in experiment.configurations.values())
    return measure.accuracy or measure.match.always or others


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
    measure = experiment.measure
    everything = _needs_all(experiment)
    sight_s = _in_sight(replay, experiment, equipped, there)
    events = _by_truth_id(replay, experiment, runs, equipped, there, sight_s)
    appraisals: dict[str, Appraisal] = {}
    if everything or measure.conflict is not None:
        world = replay.world(experiment, measured_only=not everything)
        for name, believed in believe(world, runs, there):
            appraisal = None
            if everything:
                appraisal = appraise(replay.surroundings, replay.looks, believed, measure, len(runs))
                if name not in events or measure.match.always:
                    events[name] = Events(believed.heard.units, appraisal.detections, sight_s[name])
                appraisals[name] = appraisal
            if measure.conflict is not None:
                events[name] = replace(events[name], foreseen_s=_foreseen(replay, believed, appraisal, experiment))
    ordered = {name: events[name] for name in experiment.configurations}
    rows = table(replay.scene, replay.truth, experiment, replay.looks, replay.encounters, runs, ordered)
    return Outcome(replay.scene.log, runs, rows, appraisals)


def _in_sight(replay: Replay, experiment: Experiment, equipped: Bool | None, there: Bool | None) -> dict[str, Float]:
    """By configuration when any of its units first has each look in sight: (S | 1, M)."""
    equipped = equipped if there is None else there[None]
    fleet = fleet_of(experiment, replay.scene).experiment
    return {
        name: in_sight_s(replay.first_sights_s, fleet, configuration, equipped)
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
    world = replay.world(experiment, measured_only=True)
    chosen = {name: c for name, c in world.experiment.configurations.items() if by_truth(c)}
    if not chosen:
        return {}
    seen = seen_by_all(world, runs, states="true", equipped=equipped)
    events: dict[str, Events] = {}
    for name, configuration in chosen.items():
        heard = listen(seen, replay.truth, world.experiment, configuration, there)
        result = detect(
            heard,
            replay.looks,
            confirm=experiment.measure.confirm,
            count_earlier=experiment.measure.count_earlier,
            max_age_s=configuration.max_age_s,
        )
        events[name] = Events(heard.units, result, sight_s[name])
    return events


def _foreseen(replay: Replay, believed: Believed, appraisal: Appraisal | None, experiment: Experiment) -> Float:
    """(S, M) when each look is first seen to lead to a collision."""
    measure = experiment.measure
    assert measure.conflict is not None
    beliefs = [believed.belief] if believed.belief is not None else _as_beliefs(believed, appraisal)
    return np.concatenate(
        [
            foreseen(
                belief,
                replay.ego,
                replay.looks,
                measure.conflict,
                confirm=measure.confirm,
                count_earlier=measure.count_earlier,
            )
            for belief in beliefs
        ]
    )


def _as_beliefs(believed: Believed, appraisal: Appraisal | None) -> list[Belief]:
    """Lists without truth ids as tracks, run by run, by what they were matched with."""
    assert appraisal is not None  # they are always matched
    return [
        as_belief(believed.lists, s, appraisal.matches, believed.heard, believed.at.issue_s, believed.at.newest)
        for s in range(len(believed.lists.start))
    ]


def believed(replay: Replay, experiment: Experiment, run: int) -> dict[str, Belief]:
    """What the receiver believes in one run, configuration by configuration: its fused lists of all objects."""
    runs = np.array([run])
    equipped = replay.fleet.equipped(replay.scene.log, runs)
    there = None if equipped is None else equipped[0]
    result = {}
    for name, one in believe(replay.world(experiment), runs, there):
        if one.belief is not None:
            result[name] = one.belief
        else:
            matches = match_lists(replay.surroundings, one, experiment.measure)
            result[name] = as_belief(one.lists, 0, matches, one.heard, one.at.issue_s, one.at.newest)
    return result


def list_rates(replay: Replay, experiment: Experiment) -> dict[str, tuple[int, float]]:
    """For each configuration how many intervals between fused lists there are, and the seconds they cover.

    Units that only some runs have are taken to be there.
    """
    world = replay.world(experiment, measured_only=True)
    seen = seen_by_all(world, np.arange(1), states="true")
    rates = {}
    for name, configuration in world.experiment.configurations.items():
        heard = listen(seen, replay.truth, world.experiment, configuration)
        issue_s = instants(heard, max_age_s=configuration.max_age_s).issue_s
        rates[name] = (len(issue_s) - 1, float(issue_s[-1] - issue_s[0])) if len(issue_s) > 1 else (0, 0.0)
    return rates
