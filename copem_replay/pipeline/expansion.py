"""An experiment over one log: a unit for every object that may carry one, and one for the output of each stack.

Fleets: units that some objects carry and others don't, each by an addressed draw of its own in every run.

`on: {classes, penetration_rate}` stands for one unit per object of those classes (but the ego). In a run an object
carries its unit when its number is below the share, so that a carrier at 30 % is one at 50 %, too.

A stack's recorded output is a recorded unit that its configuration alone hears, handed on as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from copem_replay.communication.latency import LatencyModel
from copem_replay.communication.link import UnitLinks
from copem_replay.communication.sends import Sends
from copem_replay.core.errors import ExperimentError
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import TRUTH, Bool, Float, Int, Scene, class_indices
from copem_replay.experiment.schema import Configuration, Experiment, Unit, output_unit
from copem_replay.fusion.as_recorded import AsPredicted, AsRecorded
from copem_replay.fusion.base import ListFusion
from copem_replay.io.config import Recorded, RecordedOutput
from copem_replay.metrics.config import Braking, Measure
from copem_replay.perception.config import Carriers, Obstacle
from copem_replay.perception.pem.model import Pem
from copem_replay.perception.visibility import VisibilityModel


@dataclass(frozen=True)
class ExpandedExperiment:
    """An experiment over one log, with a unit for every object that may carry one. U units.

    `written`: the experiment as it was. `named (U,)`: its name of each unit, `carrier (U,)`: id of the object that may
    carry the unit (else empty), `share (U,)`: the probability that it does, 1 for all others.
    """

    written: Experiment
    _expanded: Experiment
    named: tuple[str, ...]
    carrier: tuple[str, ...]
    share: Float

    @property
    def units(self) -> dict[str, Unit]:
        """(U,) all units by name: none is carried by a share of some classes."""
        return self._expanded.units

    @property
    def modelled(self) -> dict[str, Unit]:
        """The units that have a PEM."""
        return self._expanded.modelled

    @property
    def recorded(self) -> dict[str, Recorded]:
        """The units whose lists are recorded in the log."""
        return self._expanded.recorded

    @property
    def configurations(self) -> dict[str, Configuration]:
        """The configurations, which name these units."""
        return self._expanded.configurations

    def units_of(self, configuration: Configuration) -> tuple[str, ...]:
        """Names of the units of one of these configurations, in order; none for the truth."""
        return self._expanded.units_of(configuration)

    @property
    def pems(self) -> dict[str, Pem]:
        """Perception error models by name."""
        return self.written.pems

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Static obstacles beside those of the log."""
        return self.written.obstacles

    @property
    def visibility(self) -> VisibilityModel:
        """How much of each object shows."""
        return self.written.visibility

    @property
    def max_gap_s(self) -> float:
        """States further apart than this (s) are not interpolated between."""
        return self.written.max_gap_s

    @property
    def seed(self) -> int:
        """The seed of all draws."""
        return self.written.seed

    @property
    def measure(self) -> Measure:
        """What is measured."""
        return self.written.measure

    @property
    def braking(self) -> Braking | None:
        """What the declared driver does, if asked."""
        return self.written.braking

    @property
    def same_in_all_runs(self) -> bool:
        """Whether all runs have the same units."""
        return bool((self.share == 1).all())

    @property
    def outages(self) -> bool:
        """Whether a unit at times makes no lists."""
        return any(unit.outages is not None for unit in self.modelled.values())

    @property
    def ready(self) -> dict[str, LatencyModel]:
        """How long units take until a list is there to be sent, of those that take any time."""
        return {name: unit.ready for name, unit in self.modelled.items() if unit.ready is not None}

    @property
    def sends(self) -> dict[str, Sends]:
        """What units send of their lists, of those that do not send them as they are."""
        return {name: unit.sends for name, unit in self.modelled.items() if unit.sends is not None}

    @property
    def partial(self) -> list[str]:
        """The units whose messages leave objects out."""
        return [name for name, sends in self.sends.items() if sends.partial]

    def links_of(self, name: str) -> list[UnitLinks]:
        """The links of one of these configurations."""
        return self._links[name]

    @cached_property
    def _links(self) -> dict[str, list[UnitLinks]]:
        return {name: self._expanded.links_of(name) for name in self.configurations}

    def linked(self, name: str) -> list[str]:
        """The units that send by a link in one of these configurations; of the truth TRUTH."""
        configuration = self.configurations[name]
        return [unit for unit in self.units_of(configuration) or (TRUTH,) if configuration.link_of(unit) is not None]

    @cached_property
    def arrivals_differ(self) -> bool:
        """Whether lists arrive otherwise from run to run: each run then has lists, and instants, of its own."""
        return (
            self.outages
            or bool(self.sends)
            or any(ready.fixed_s is None for ready in self.ready.values())
            or any(one.link.drawn for name in self.configurations for one in self.links_of(name))
        )

    @property
    def runs_apart(self) -> bool:
        """Whether lists differ from run to run in more than the states of their rows: a block then has one run."""
        return self.arrivals_differ or any(
            isinstance(configuration.fusion, ListFusion)
            and any(self._apart(self.units[name]) for name in self.units_of(configuration))
            for configuration in self.configurations.values()
        )

    @property
    def draws_claims(self) -> bool:
        """Whether a PEM draws more than states: ghosts, classes, scores or track ids."""
        return any(self.pems[str(unit.pem)].draws_claims for unit in self.modelled.values())

    def _apart(self, unit: Unit) -> bool:
        return unit.clock is not None or (unit.pem is not None and self.pems[unit.pem].draws_claims)

    def with_(self, experiment: Experiment) -> ExpandedExperiment:
        """The same units in an experiment that differs in its configurations, or in what is measured.

        Raises ValueError where its units are others.
        """
        if experiment is self.written:
            return self
        if experiment.units != self.written.units:
            raise ValueError("expected an experiment with the units that the log was prepared for")
        return _expanded(experiment, self.units, self.named, self.carrier, self.share)

    def equipped(self, log: str, runs: Int) -> Bool | None:
        """(S, U) which units there are in each of the runs (S,); None: all."""
        if self.same_in_all_runs:
            return None
        # No list and no instant to go by: the carrier and the unit's name in the experiment are the address.
        units = tuple(dict.fromkeys(self.named))
        which = np.array([units.index(name) for name in self.named])
        random_key = RandomKey(units, which, object_words(self.carrier), np.zeros(len(which), dtype=np.int64))
        return CounterRng(self.seed, log).bernoulli("carries", random_key, runs, self.share)


def expand(experiment: Experiment, scene: Scene) -> ExpandedExperiment:
    """An experiment's units over one log, one for every object that may carry one, last those of recorded outputs.

    Raises ExperimentError where another unit has such a name.
    """
    fleet = _with_carriers(experiment, scene)
    if not experiment.outputs:
        return fleet
    units = dict(fleet.units)
    for name, output in experiment.outputs.items():
        one = output_unit(name)
        if one in units:
            raise ExperimentError(f"units: {one} is what the recorded output of {name} is called; choose another name")
        units[one] = Unit(recorded=output)
    added = tuple(units)[len(fleet.named) :]
    none, sure = ("",) * len(added), np.ones(len(added))
    return _expanded(experiment, units, (*fleet.named, *added), (*fleet.carrier, *none), np.append(fleet.share, sure))


def _with_carriers(experiment: Experiment, scene: Scene) -> ExpandedExperiment:
    """The same without those of recorded outputs."""
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
            named, carriers, share = [*named, name], [*carriers, one], [*share, unit.on.penetration_rate]
    return _expanded(experiment, units, tuple(named), tuple(carriers), np.array(share))


def _expanded(
    experiment: Experiment, units: dict[str, Unit], named: tuple[str, ...], carrier: tuple[str, ...], share: Float
) -> ExpandedExperiment:
    """An experiment with these units in the place of its own."""
    if units.keys() == experiment.units.keys():
        return ExpandedExperiment(experiment, experiment, named, carrier, share)
    members = {name: [unit for unit, of in zip(units, named, strict=True) if of == name] for name in experiment.units}
    configurations = _members_for(experiment.configurations, members)
    for name, output in experiment.outputs.items():
        if output_unit(name) in units:
            configurations[name] = _heard_alone(configurations[name], name, output)
    changed = {"units": units, "configurations": configurations}
    return ExpandedExperiment(experiment, experiment.model_copy(update=changed), named, carrier, share)


def _heard_alone(configuration: Configuration, name: str, output: RecordedOutput) -> Configuration:
    """A configuration that hands on what its unit lists."""
    fusion = AsPredicted() if output.tells_of == "available" else AsRecorded()
    return configuration.model_copy(update={"units": (output_unit(name),), "fusion": fusion, "recorded": None})


def of_run(experiment: Experiment, scene: Scene, run: int) -> Experiment:
    """The experiment as it is in one run: with the units that are carried in it."""
    expanded = _with_carriers(experiment, scene)  # outputs are added when the run is made ready
    there = expanded.equipped(scene.log, np.array([run]))
    if there is None and expanded.units.keys() == experiment.units.keys():
        return experiment
    kept = {n: u for k, (n, u) in enumerate(expanded.units.items()) if there is None or there[0, k]}
    members = {name: [name] if name in kept else [] for name in expanded.units}
    changed = {"units": kept, "configurations": _members_for(expanded.configurations, members)}
    return experiment.model_copy(update=changed)


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
        if isinstance(configuration.link, dict):
            changed["link"] = {
                one: link for unit, link in configuration.link.items() for one in members.get(unit, [unit])
            }
        result[name] = configuration.model_copy(update=changed)
    return result
