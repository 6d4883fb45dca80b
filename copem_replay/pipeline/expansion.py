"""Fleets: units that some objects carry and others don't, each by an addressed draw of its own in every run.

`on: {classes, share}` stands for one unit per object of those classes (but the ego). In a run an object carries its
unit when its number is below the share, so that who carries one at 30 % does at 50 %, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.errors import ExperimentError
from copem_replay.core.random import Address, Dice, object_words
from copem_replay.core.tracks import Bool, Float, Int, Scene, class_indices
from copem_replay.experiment.schema import Configuration, Experiment, Unit
from copem_replay.perception.config import Carriers


@dataclass(frozen=True)
class Fleet:
    """An experiment over one log with a unit per carrier, and who the carriers are. U units.

    `named (U,)`: what the experiment calls the unit, `carrier (U,)`: id of the object that may carry it (else empty),
    `share (U,)`: with which probability it does, 1 for all others.
    """

    experiment: Experiment
    named: tuple[str, ...]
    carrier: tuple[str, ...]
    share: Float

    def equipped(self, log: str, runs: Int) -> Bool | None:
        """(S, U) which units there are in each of the runs (S,); None: all."""
        if (self.share == 1).all():
            return None
        # No list and no instant to go by: the carrier and the unit's name in the experiment are the address.
        units = tuple(dict.fromkeys(self.named))
        which = np.array([units.index(name) for name in self.named])
        address = Address(units, which, object_words(self.carrier), np.zeros(len(which), dtype=np.int64))
        return Dice(self.experiment.seed, log).bernoulli("carries", address, runs, self.share)


def fleet_of(experiment: Experiment, scene: Scene) -> Fleet:
    """An experiment's units over one log, one for every object that may carry one.

    Raises ExperimentError where another unit has such a name.
    """
    units: dict[str, Unit] = {}
    named: list[str] = []
    carriers: list[str] = []
    share: list[float] = []
    for name, unit in experiment.units.items():
        if not isinstance(unit.on, Carriers):
            units[name] = unit
            named, carriers, share = [*named, name], [*carriers, ""], [*share, 1.0]
            continue
        of_class = np.isin(scene.object_class, class_indices(unit.on.classes))
        for k in np.flatnonzero(of_class):
            if k == scene.ego_ix:
                continue
            one = scene.object_ids[k]
            if f"{name}:{one}" in experiment.units:
                raise ExperimentError(
                    f"units: {name}:{one} is what {name} is called on object {one}; choose another name"
                )
            units[f"{name}:{one}"] = unit.model_copy(update={"on": one})
            named, carriers, share = [*named, name], [*carriers, one], [*share, unit.on.share]
    if all(name in units for name in experiment.units):
        return Fleet(experiment, tuple(named), tuple(carriers), np.array(share))
    members = {name: [unit for unit, of in zip(units, named, strict=True) if of == name] for name in experiment.units}
    changed = {"units": units, "configurations": _members_for(experiment.configurations, members)}
    return Fleet(experiment.model_copy(update=changed), tuple(named), tuple(carriers), np.array(share))


def of_run(experiment: Experiment, scene: Scene, run: int) -> Experiment:
    """The experiment as it is in one run: with the units that are carried in it."""
    fleet = fleet_of(experiment, scene)
    there = fleet.equipped(scene.log, np.array([run]))
    if there is None:
        return fleet.experiment
    kept = {n: u for (n, u), on in zip(fleet.experiment.units.items(), there[0], strict=True) if on}
    members = {name: [name] if name in kept else [] for name in fleet.experiment.units}
    changed = {"units": kept, "configurations": _members_for(fleet.experiment.configurations, members)}
    return fleet.experiment.model_copy(update=changed)


def _members_for(configurations: dict[str, Configuration], members: dict[str, list[str]]) -> dict[str, Configuration]:
    """Configurations with units replaced by others: their lists of units, and their latencies by unit."""
    result = {}
    for name, configuration in configurations.items():
        changed: dict[str, object] = {}
        if not isinstance(configuration.units, str):
            changed["units"] = tuple(one for unit in configuration.units for one in members[unit])
        if isinstance(configuration.latency_s, dict):
            changed["latency_s"] = {
                one: value for unit, value in configuration.latency_s.items() for one in members.get(unit, [unit])
            }
        result[name] = configuration.model_copy(update=changed)
    return result
