"""Believe: what the receiver makes of what it hears, configuration by configuration (f of the paper's coPEM)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from copem_replay.candidates import Candidates
from copem_replay.chance import Address, Dice, object_words
from copem_replay.experiment import Configuration, Experiment
from copem_replay.fusion.as_lists import as_lists
from copem_replay.fusion.belief import Belief
from copem_replay.fusion.component import Ideal, ListFusion, fused_by
from copem_replay.fusion.ideal import draw_posterior, fuse
from copem_replay.fusion.instants import Instants, instants
from copem_replay.fusion.object_list import Lists
from copem_replay.fusion.reports import Claims, lists_without_truth, reports
from copem_replay.perceive import perceive
from copem_replay.recorded import RecordedUnits
from copem_replay.tracks import CLASSES, TRUTH, Bool, Int, Scene, Tracks, joined
from copem_replay.transmit import transmit

States = Literal["true", "expected", "sampled"]


@dataclass(frozen=True)
class World:
    """One log as the units of an experiment have it: what of it is the same in all runs.

    `truth` at its own frames; `found`: rows of the modelled units, `recorded` those of the others. `experiment` has a
    unit per carrier.
    """

    scene: Scene
    truth: Tracks
    found: Candidates
    recorded: RecordedUnits | None
    experiment: Experiment


@dataclass(frozen=True)
class Believed:
    """What one configuration's receiver believes in the runs (S,).

    `belief`: of ideal fusion and the truth, which know the objects; else None. `lists` are the same without truth ids,
    or what another fusion gave; one run where all runs agree.
    """

    heard: Tracks
    at: Instants
    belief: Belief | None
    scene: Scene
    fused: Lists | None

    @cached_property
    def lists(self) -> Lists:
        """The fused lists without truth ids."""
        if self.fused is not None:
            return self.fused
        assert self.belief is not None
        return as_lists(self.belief, self.scene)


def seen_by_all(world: World, runs: Int, *, states: States, equipped: Bool | None = None) -> Tracks:
    """What every unit lists in the runs (S,), whatever its lists come from. `equipped (S, U)` as in `perceive`."""
    experiment = world.experiment
    if equipped is not None:
        equipped = equipped[:, [k for k, unit in enumerate(experiment.units.values()) if unit.recorded is None]]
    seen = perceive(world.scene, world.found, experiment, runs, states=states, equipped=equipped)
    if world.recorded is None:
        return seen
    recorded = world.recorded.tracks
    recorded = replace(recorded, valid=np.broadcast_to(recorded.valid, (len(runs), len(recorded.frame_ix))))
    both = joined((*seen.units, *recorded.units), [seen, recorded])
    # In the experiment's order: it decides between lists that arrive together.
    names = tuple(experiment.units)
    place = np.array([names.index(name) for name in both.units])
    return replace(both, units=names, unit_ix=place[both.unit_ix], frame_unit_ix=place[both.frame_unit_ix])


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


def by_truth(configuration: Configuration) -> bool:
    """Whether what a configuration believes has truth ids: the truth itself, and ideal fusion."""
    return configuration.units == TRUTH or isinstance(configuration.fusion, Ideal)


def believe(world: World, runs: Int, there: Bool | None) -> Iterator[tuple[str, Believed]]:
    """What each configuration's receiver believes in the runs (S,), of the units that are `there (U,)`.

    Raises InputError where a fusion of the user's own fails.
    """
    ego_ix, experiment = world.scene.ego_ix, world.experiment
    seen: dict[States, Tracks] = {}  # each is made when first needed
    without_truth: list[Lists] = []

    def seen_in(states: States) -> Tracks:
        if states not in seen:
            seen[states] = seen_by_all(world, runs, states=states)
        return seen[states]

    for name, configuration in experiment.configurations.items():
        fusion, of_truth = configuration.fusion, configuration.units == TRUTH
        if isinstance(fusion, ListFusion):
            heard = listen(seen_in("sampled"), world.truth, experiment, configuration, there)
            if not without_truth:
                without_truth.append(_without_truth(world, seen_in("sampled"), runs))
            told = reports(heard, without_truth[0], max_age_s=configuration.max_age_s)
            fused = fused_by(fusion, told, f"configurations.{name}.fusion")
            yield name, Believed(heard, instants(heard, max_age_s=configuration.max_age_s), None, world.scene, fused)
            continue
        assert isinstance(fusion, Ideal)
        posterior = fusion.combine == "posterior" and not of_truth
        heard = listen(seen_in("expected" if posterior else "sampled"), world.truth, experiment, configuration, there)
        belief = fuse(heard, max_age_s=configuration.max_age_s, without_object_ix=ego_ix)
        if not of_truth and world.recorded is None:
            belief = replace(belief, look=world.found.look)
        if posterior:
            belief = draw_posterior(belief, world.scene, experiment.seed, runs)
        yield name, Believed(heard, instants(heard, max_age_s=configuration.max_age_s), belief, world.scene, None)


def _without_truth(world: World, seen: Tracks, runs: Int) -> Lists:
    """The units' lists as a real fusion sees them: no truth ids, and in no order that means anything."""
    found, recorded = world.found, world.recorded
    words = object_words(world.scene.object_ids)[found.tracks.row_object_ix]
    existence = found.existence
    likely = np.eye(len(CLASSES))[found.look.class_ix]
    track_id = np.full(len(words), -1)
    if recorded is not None:
        words = np.concatenate([words, np.arange(len(recorded.existence), dtype=np.uint64)])
        existence = np.concatenate([existence, recorded.existence])
        likely = np.concatenate([likely, recorded.class_probability])
        track_id = np.concatenate([track_id, recorded.track_id])
    address = Address(seen.units, seen.row_unit_ix, words, seen.stamp_ns[seen.frame_ix])
    drawn = Dice(world.experiment.seed, world.scene.log).uniform("order in the list", address, runs)
    claims = Claims(existence, likely, track_id)
    return lists_without_truth(seen, claims, drawn, without_object_ix=world.scene.ego_ix)
