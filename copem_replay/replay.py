"""Replay: one log through one experiment. What does not depend on the run is prepared once; a block of runs is a pure
function of it, so that blocks can be computed anywhere, in any order, by any number of workers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import pandas as pd

from copem_replay.braking.course import EgoCourse
from copem_replay.braking.encounter import Encounter, encounters
from copem_replay.braking.verdict import passing
from copem_replay.candidates import Candidates, candidates
from copem_replay.detect import detect
from copem_replay.errors import ExperimentError
from copem_replay.experiment import Configuration, Experiment
from copem_replay.fleet import Fleet, fleet_of
from copem_replay.foresee import foreseen
from copem_replay.fusion.ideal import Belief, draw_posterior, fuse
from copem_replay.fusion.inbox import inbox
from copem_replay.measure import Events, table
from copem_replay.onset import Looks, looks
from copem_replay.perceive import perceive
from copem_replay.read import Recording
from copem_replay.resample import at_instants
from copem_replay.tracks import TRUTH, Bool, Float, Int, Scene, Tracks
from copem_replay.transmit import transmit

ROWS_TIMES_RUNS = 50_000_000
"""How many row × run cells a block may hold (chosen: a byte each while only detections are drawn)."""

STATE_BYTES = 100
"""Bytes of a row × run cell where states are sampled and fused, too (chosen: a dozen numbers)."""

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
    on = looks(scene, truth, found.static, onsets_of or experiment)
    meeting = encounters(scene, truth, on, experiment)
    return Replay(scene, fleet, truth, found, found.of_objects(on.object_ix), on, meeting)


def blocks(replay: Replay, experiment: Experiment, jobs: int) -> list[Int]:
    """The runs cut into blocks, small enough for memory and enough of them for the workers."""
    rows = max(len(replay.measured.tracks.frame_ix), 1)
    even = -(-experiment.runs // jobs)
    # Smaller ones show progress and can be interrupted sooner, down to a size at which they would only cost time.
    small = max(-(-even // 8), WORTH_A_BLOCK // rows)
    at_once = ROWS_TIMES_RUNS // (rows * (STATE_BYTES if experiment.measure.conflict is not None else 1))
    size = max(1, min(at_once, even, small))
    return [np.arange(k, min(k + size, experiment.runs)) for k in range(0, experiment.runs, size)]


def replay_block(replay: Replay, experiment: Experiment, runs: Int) -> pd.DataFrame:
    """The rows of `detections.parquet` of one block of runs (S,)."""
    equipped = replay.fleet.equipped(replay.scene.log, runs)
    if equipped is None or (experiment.measure.confirm.of == 1 and experiment.measure.conflict is None):
        return _block(replay, experiment, runs, equipped, None)
    # Which lists there are decides what is consecutive: runs with the same units go together.
    patterns, which = np.unique(equipped, axis=0, return_inverse=True)
    parts = [_block(replay, experiment, runs[which == k], None, there) for k, there in enumerate(patterns)]
    return pd.concat(parts, ignore_index=True)


def _block(
    replay: Replay, experiment: Experiment, runs: Int, equipped: Bool | None, there: Bool | None
) -> pd.DataFrame:
    """Rows of runs (S,): `equipped (S, U)` says which units list anything, `there (U,)` which send lists at all."""
    experiment = fleet_of(experiment, replay.scene).experiment
    seen = perceive(replay.scene, replay.measured, experiment, runs, states="true", equipped=equipped)
    results: dict[str, Events] = {}
    for name, configuration in experiment.configurations.items():
        heard = listen(seen, replay.truth, experiment, configuration, there)
        result = detect(
            heard,
            replay.looks,
            confirm=experiment.measure.confirm,
            count_earlier=experiment.measure.count_earlier,
            max_age_s=configuration.max_age_s,
        )
        results[name] = Events(heard.units, result)
    if experiment.measure.conflict is not None:
        for name, belief in _beliefs(replay, replay.measured, experiment, runs, there):
            results[name] = replace(results[name], foreseen_s=_foreseen(replay, belief, experiment))
    return table(replay.scene, replay.truth, experiment, replay.looks, replay.encounters, runs, results)


def _foreseen(replay: Replay, belief: Belief, experiment: Experiment) -> Float:
    """(S, M) when each look is first seen to lead to a collision."""
    measure = experiment.measure
    assert measure.conflict is not None
    return foreseen(
        belief,
        replay.ego,
        replay.looks,
        measure.conflict,
        confirm=measure.confirm,
        count_earlier=measure.count_earlier,
    )


def listen(
    seen: Tracks, truth: Tracks, experiment: Experiment, configuration: Configuration, there: Bool | None = None
) -> Tracks:
    """What reaches the receiver in one configuration: the lists of its units, late; those of the others never.

    `there (U,)`: which units there are, None: all. Nothing is copied: configurations share the rows, and what was drawn
    for them.
    """
    if configuration.units == TRUTH:
        return transmit(truth, configuration.latency_of)
    heard = set(experiment.units_of(configuration))
    if there is not None:
        heard &= {name for name, present in zip(seen.units, there, strict=True) if present}
    return transmit(seen, lambda unit: configuration.latency_of(unit) if unit in heard else np.inf)


def believed(replay: Replay, experiment: Experiment, run: int) -> dict[str, Belief]:
    """What the receiver believes in one run, configuration by configuration: its fused lists of all objects."""
    runs = np.array([run])
    equipped = replay.fleet.equipped(replay.scene.log, runs)
    experiment = fleet_of(experiment, replay.scene).experiment
    return dict(_beliefs(replay, replay.found, experiment, runs, None if equipped is None else equipped[0]))


def _beliefs(
    replay: Replay, found: Candidates, experiment: Experiment, runs: Int, there: Bool | None
) -> Iterator[tuple[str, Belief]]:
    """Fused lists in the runs (S,), made of the rows of `found`, by the units that are `there (U,)`."""
    ego = replay.scene.ego_ix
    seen: dict[bool, Tracks] = {}  # by whether the states are the expected ones; each is made when first needed
    for name, configuration in experiment.configurations.items():
        posterior = configuration.fusion.combine == "posterior" and configuration.units != TRUTH
        if posterior not in seen:
            states: Literal["expected", "sampled"] = "expected" if posterior else "sampled"
            seen[posterior] = perceive(replay.scene, found, experiment, runs, states=states)
        heard = listen(seen[posterior], replay.truth, experiment, configuration, there)
        belief = fuse(heard, max_age_s=configuration.max_age_s, without_object_ix=ego)
        if configuration.units != TRUTH:
            belief = replace(belief, look=found.look)
        yield name, draw_posterior(belief, replay.scene, experiment.seed, runs) if posterior else belief


def list_rates(replay: Replay, experiment: Experiment) -> dict[str, tuple[int, float]]:
    """For each configuration how many intervals between fused lists there are, and the seconds they cover.

    Units that only some runs have are taken to be there.
    """
    experiment = fleet_of(experiment, replay.scene).experiment
    rates = {}
    for name, configuration in experiment.configurations.items():
        heard = listen(replay.measured.tracks, replay.truth, experiment, configuration)
        issue_s = inbox(heard, max_age_s=configuration.max_age_s).issue_s
        rates[name] = (len(issue_s) - 1, float(issue_s[-1] - issue_s[0])) if len(issue_s) > 1 else (0, 0.0)
    return rates
