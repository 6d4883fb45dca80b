"""An experiment over one log: a unit for every object that may carry one, and one for the output of each stack.

`on: {classes, penetration_rate}` stands for one unit per object of those classes, without the ego. In a run an object
carries its unit if its random number is below the share: an object that carries one at 30 % does so at 50 %, too.

The recorded output of a stack is a recorded unit that only its configuration hears, and that is handed on as it is.

What a configuration is, by truth id, fixed, or regretted to which ideal, is decided here once (`find_facts`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from pydantic import ConfigDict, Field

from copem_replay.communication.latency import LatencyModel
from copem_replay.communication.link import UnitLinks
from copem_replay.communication.sends import Sends
from copem_replay.core.errors import ExperimentError
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import TRUTH, Bool, Float, Int, Scene, class_indices
from copem_replay.experiment.schema import Configuration, Experiment, Unit, output_unit
from copem_replay.fusion.interface import IdealFusion, ListFusion, PredictedFusion, RecordedFusion
from copem_replay.io.config import RecordedOutput
from copem_replay.metrics.braking.driver import ConstantReaction
from copem_replay.metrics.onset import Requires
from copem_replay.perception.config import Carriers
from copem_replay.perception.pem.condition import Couple
from copem_replay.perception.pem.detection import ConstantDetection
from copem_replay.perception.pem.model import Pem

E = TypeVar("E", bound=Experiment)

# What configurations are.


@dataclass(frozen=True)
class ConfigurationFacts:
    """The properties of a configuration, as `provenance.json` states them.

    `truth`: its lists are the truth; `recorded`: they are the output of a stack. `by_truth_id`: objects are detected by
    truth id, not by match. `fixed`: detections are equal in every run; `fixed_verdicts`: and whether the ego passes.
    `needs_visibility`: its episodes depend on which body hides which. `ideal`: the ideal fusion of its `ideal_of`: of
    its inputs, whose lists come alike, or of its units; None: it is ideal itself, or there is none. `remembering`: the
    ideal fusion with memory of its inputs, if its own fusion remembers. `least_s`: no time to detection is shorter.
    """

    truth: bool
    recorded: bool
    by_truth_id: bool
    fixed: bool
    fixed_verdicts: bool
    needs_visibility: bool
    ideal: str | None
    ideal_of: str | None
    remembering: str | None
    least_s: float = 0.0


def find_facts(experiment: Experiment) -> dict[str, ConfigurationFacts]:
    """The properties of each configuration of an experiment, by name.

    Fixed by kind of unit: lists of the truth and of recorded units are not drawn; those of a unit with a PEM are, and
    so are its carriers, even where probabilities are 0 or 1. A driver's delay is drawn, except with the `constant`
    reaction.
    """
    driver = None if experiment.braking is None else experiment.braking.driver
    reaction = getattr(driver, "reaction", None)
    reacts_alike = driver is not None and (reaction is None or isinstance(reaction, ConstantReaction))
    in_sight = experiment.measure.onset.requires is not Requires.NOTHING
    facts = {}
    for name, configuration in experiment.configurations.items():
        recorded, fixed = configuration.recorded is not None, _is_fixed(experiment, name, configuration)
        ideal, ideal_of = _find_ideal(experiment, configuration)
        facts[name] = ConfigurationFacts(
            truth=configuration.units == TRUTH,
            recorded=recorded,
            by_truth_id=_has_truth_ids(configuration),
            fixed=fixed,
            fixed_verdicts=fixed and reacts_alike,
            needs_visibility=in_sight,
            ideal=ideal,
            ideal_of=ideal_of,
            remembering=_find_remembering(experiment, configuration),
            least_s=0.0
            if recorded or experiment.measure.count_earlier  # what is known before counts
            else min(map(configuration.latency_of, experiment.units_of(configuration) or (TRUTH,))),
        )
    return facts


def _has_truth_ids(configuration: Configuration) -> bool:
    """Whether a configuration's fused tracks have truth ids: the truth itself, and ideal fusion."""
    computed = configuration.recorded is None  # not the output of a stack
    return computed and (configuration.units == TRUTH or isinstance(configuration.fusion, IdealFusion))


def _is_fixed(experiment: Experiment, name: str, configuration: Configuration) -> bool:
    if configuration.recorded is not None:
        return True
    drawn = [unit for unit in experiment.units_of(configuration) if unit not in experiment.recorded]
    return not drawn and not any(of.link.drawn for of in experiment.links_of(name))


def _find_ideal(experiment: Experiment, configuration: Configuration) -> tuple[str | None, str | None]:
    """The ideal fusion to compare a configuration with, and what they share: its `inputs` (units, latency, link,
    `issue_hz`) or only its `units`. None, None: there is none.
    """
    if configuration.recorded is None and isinstance(configuration.fusion, IdealFusion):
        return None, None
    own_inputs, candidates = _list_inputs(experiment, configuration), {}
    for name, other in experiment.configurations.items():
        if other.recorded is None and other.fusion == IdealFusion():
            inputs = _list_inputs(experiment, other)
            if own_inputs[0] and inputs[0] == own_inputs[0]:
                candidates[name] = inputs == own_inputs
    alike = next((name for name, is_alike in candidates.items() if is_alike), None)
    return alike or next(iter(candidates), None), None if not candidates else "units" if alike is None else "inputs"


def _find_remembering(experiment: Experiment, configuration: Configuration) -> str | None:
    """The ideal fusion with memory of the inputs of a configuration whose fusion remembers."""
    fusion = configuration.fusion
    if configuration.recorded is not None or not (isinstance(fusion, ListFusion) and fusion.remembers):
        return None
    own = _list_inputs(experiment, configuration)
    for name, other in experiment.configurations.items():
        remembers = isinstance(other.fusion, IdealFusion) and other.fusion.memory is not None
        if other.recorded is None and remembers and _list_inputs(experiment, other) == own:
            return name
    return None


def _list_inputs(experiment: Experiment, configuration: Configuration) -> tuple[frozenset[str], object]:
    """The units of a configuration, none of the truth; and how their lists come: by unit latency and link, the rate.

    A recorded output has its inputs as they arrived, without latency or link.
    """
    recorded = configuration.recorded is not None
    units = (configuration.inputs or ()) if recorded else experiment.units_of(configuration)
    come = {unit: (configuration.latency_of(unit), configuration.link_of(unit)) for unit in units}
    return frozenset(units), (come, configuration.issue_hz)


# An experiment over one log.


class ExpandedExperiment(Experiment):
    """An experiment over one log, with a unit for every object that may carry one. U units.

    `given`: the units before. `named (U,)`: the name that each unit has there. `carrier (U,)`: id of the object that
    may carry the unit, else empty. `share (U,)`: the probability that the unit is there, 1 without. `facts`: what
    each configuration is. `ways`: configurations of which the way of lists is measured (`has_way`), of the study: also
    in a log without a carrier. `unit_links`: the links of each.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True, defer_build=True)  # it is made of a valid experiment

    given: dict[str, Unit] = Field(exclude=True)
    named: tuple[str, ...] = Field(exclude=True)
    carrier: tuple[str, ...] = Field(exclude=True)
    share: Float = Field(exclude=True)
    facts: dict[str, ConfigurationFacts] = Field(exclude=True)
    ways: frozenset[str] = Field(exclude=True)
    unit_links: dict[str, list[UnitLinks]] = Field(exclude=True)

    @property
    def same_in_all_runs(self) -> bool:
        """Whether all runs have the same units."""
        return bool((self.share == 1).all())

    @property
    def outages(self) -> bool:
        """Whether a unit at times makes no lists."""
        return any(unit.outages is not None for unit in self.units.values())

    @property
    def ready(self) -> dict[str, LatencyModel]:
        """Seconds from capture until a list can be sent, by unit that states a model of it."""
        return {name: unit.ready for name, unit in self.units.items() if unit.ready is not None}

    @property
    def sends(self) -> dict[str, Sends]:
        """The sending rules by unit, for units that do not send all of their lists."""
        return {name: unit.sends for name, unit in self.units.items() if unit.sends is not None}

    @property
    def partial(self) -> list[str]:
        """The units whose messages leave objects out."""
        return [name for name, sends in self.sends.items() if sends.partial]

    def links_of(self, name: str) -> list[UnitLinks]:
        """The links of a configuration."""
        return self.unit_links[name]

    def has_way(self, name: str) -> bool:
        """Whether the study measures the way of a configuration's lists."""
        return name in self.ways

    def linked(self, name: str) -> list[str]:
        """The units that send by a link in any of these configurations; TRUTH stands for the truth."""
        configuration = self.configurations[name]
        return [unit for unit in self.units_of(configuration) or (TRUTH,) if configuration.link_of(unit) is not None]

    @property
    def arrivals_differ(self) -> bool:
        """Whether lists or their arrivals differ between runs: each run then has receiver instants of its own."""
        return (
            self.outages
            or bool(self.sends or self.fusing)
            or any(ready.fixed_s is None for ready in self.ready.values())
            or any(one.link.drawn for name in self.configurations for one in self.links_of(name))
        )

    @property
    def runs_apart(self) -> bool:
        """Whether runs are replayed one by one, as their lists differ in more than presence and states of rows."""
        return self.arrivals_differ or any(
            unit.clock is not None or (unit.pem is not None and self.pems[unit.pem].draws_claims)
            for configuration in self.configurations.values()
            if isinstance(configuration.fusion, ListFusion)
            for unit in (self.units[name] for name in self.units_of(configuration))
        )

    @property
    def draws_claims(self) -> bool:
        """Whether a PEM draws more than states: ghosts, classes, scores or track ids."""
        return any(self.pems[str(unit.pem)].draws_claims for unit in self.modelled.values())

    def equipped(self, log: str, runs: Int) -> Bool | None:
        """(S, U) which units there are in each of the runs (S,); None: all units in all runs."""
        if self.same_in_all_runs:
            return None
        # A carrier has no list and no instant: its id and the unit's name in the experiment are the address.
        units = tuple(dict.fromkeys(self.named))
        which = np.array([units.index(name) for name in self.named])
        random_key = RandomKey(units, which, object_words(self.carrier), np.zeros(len(which), dtype=np.int64))
        return CounterRng(self.seed, log).bernoulli("carries", random_key, runs, self.share)


def expand_experiment(experiment: Experiment, scene: Scene) -> ExpandedExperiment:
    """An experiment's units over one log, with one for every object that may carry one, and for each recorded output.

    Raises ExperimentError where a name that a unit gets is taken.
    """
    fleet = _expand_carriers(experiment, scene)
    if not experiment.outputs:
        return fleet
    units = fleet.units.copy()
    for name, output in experiment.outputs.items():
        unit = output_unit(name)
        if unit in units:
            raise ExperimentError(f"units: {unit} is what the recorded output of {name} is called; choose another name")
        units[unit] = Unit(recorded=output)
    added = tuple(units)[len(fleet.named) :]
    no_carrier, certain = ("",) * len(added), np.ones(len(added))
    return _replace_units(
        experiment, units, (*fleet.named, *added), (*fleet.carrier, *no_carrier), np.append(fleet.share, certain)
    )


def _expand_carriers(experiment: Experiment, scene: Scene) -> ExpandedExperiment:
    """The experiment over one log, with a unit of its own for each object that may carry one."""
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
            object_id = scene.object_ids[k]
            if f"{name}:{object_id}" in experiment.units:
                raise ExperimentError(
                    f"units: {name}:{object_id} is what {name} is called on object {object_id}; choose another name"
                )
            units[f"{name}:{object_id}"] = unit.model_copy(update={"on": object_id})
            named, carriers, share = [*named, name], [*carriers, object_id], [*share, unit.on.penetration_rate]
    return _replace_units(experiment, units, tuple(named), tuple(carriers), np.array(share))


def expand_alike(experiment: Experiment, other: ExpandedExperiment) -> ExpandedExperiment:
    """An experiment with the units of another over one log; the two differ in configurations or in what is measured.
    Raises ValueError where the units differ.
    """
    if isinstance(experiment, ExpandedExperiment):
        return experiment
    if experiment.units != other.given:
        raise ValueError("expected an experiment with the units that the log was prepared for")
    return _replace_units(experiment, other.units, other.named, other.carrier, other.share)


def _replace_units(
    experiment: Experiment, units: dict[str, Unit], named: tuple[str, ...], carrier: tuple[str, ...], share: Float
) -> ExpandedExperiment:
    """The experiment with `units` instead of its own, also in configurations. `named`, `carrier`, `share`: of each, its
    name in the file, the object that carries it, and the share of runs that have it.
    """
    expanded = experiment
    if units.keys() != experiment.units.keys():
        members = {n: [unit for unit, of in zip(units, named, strict=True) if of == n] for n in experiment.units}
        configurations = _replace_members(experiment.configurations, members)
        for name, output in experiment.outputs.items():
            if output_unit(name) in units:
                configurations[name] = _relay_unit(configurations[name], name, output)
        expanded = experiment.model_copy(update={"units": units, "configurations": configurations})
    configurations = expanded.configurations
    result = ExpandedExperiment.model_construct(
        expanded.model_fields_set, **dict(expanded), given=experiment.units, named=named, carrier=carrier, share=share,
        facts=find_facts(experiment), ways=frozenset(filter(experiment.has_way, configurations)),
        unit_links={name: expanded.links_of(name) for name in configurations},
    )  # fmt: skip
    result._has_areas = experiment.has_areas
    return result


def expand_members(experiment: ExpandedExperiment) -> ExpandedExperiment:
    """The experiment with the members of each fusing unit as a configuration, and without that unit."""
    keep = [k for k, unit in enumerate(experiment.units.values()) if unit.fuses is None]
    names = list(experiment.units)
    given = {name: getattr(experiment, name) for name in Experiment.model_fields}
    given["configurations"] = {name: unit.as_configuration() for name, unit in experiment.fusing.items()}
    return _replace_units(
        Experiment.model_construct(**given),
        {names[k]: experiment.units[names[k]] for k in keep},
        tuple(experiment.named[k] for k in keep), tuple(experiment.carrier[k] for k in keep), experiment.share[keep],
    )  # fmt: skip


def give_views(experiment: E, *, alone: bool = False) -> E:
    """The experiment in which recorded units with `views` have a PEM instead that lists all they see: for sight alone.

    `alone`: without other units. An experiment without such units is given back.
    """
    views = {name: unit.views for name, unit in experiment.units.items() if unit.views is not None}
    if not views:
        return experiment
    pem, as_sensor = "views of {}".format, {"recorded": None, "views": None}
    sensors = {name: experiment.units[name].model_copy(update={**as_sensor, "pem": pem(name)}) for name in views}
    sure = ConstantDetection.model_validate({"probability": 1.0})
    sees = {pem(name): Pem(couples=tuple(Couple(when=when, detection=sure) for when in views[name])) for name in views}
    units = sensors if alone else {**experiment.units, **sensors}
    return experiment.model_copy(update={"units": units, "pems": {**experiment.pems, **sees}})


def _relay_unit(configuration: Configuration, name: str, output: RecordedOutput) -> Configuration:
    """A configuration that hands on what the unit of a recorded output lists."""
    fusion = PredictedFusion() if output.tells_of == "available" else RecordedFusion()
    return configuration.model_copy(update={"units": (output_unit(name),), "fusion": fusion, "recorded": None})


def resolve_for_run(experiment: Experiment, scene: Scene, run: int) -> Experiment:
    """The experiment in one run, with only the units that objects carry in it."""
    expanded = _expand_carriers(experiment, scene)  # `prepare_log` adds the outputs
    equipped = expanded.equipped(scene.log, np.array([run]))
    if equipped is None and expanded.units.keys() == experiment.units.keys():
        return experiment
    kept = {n: u for k, (n, u) in enumerate(expanded.units.items()) if equipped is None or equipped[0, k]}
    members = {name: [name] if name in kept else [] for name in expanded.units}
    changed = {"units": kept, "configurations": _replace_members(expanded.configurations, members)}
    return experiment.model_copy(update=changed)


def _replace_members(
    configurations: dict[str, Configuration], members: dict[str, list[str]]
) -> dict[str, Configuration]:
    """Configurations in which each unit is replaced by its `members`: in `units`, `latency_s` and `link`."""
    result = {}
    for name, configuration in configurations.items():
        changed: dict[str, object] = {}
        if not isinstance(configuration.units, str):
            changed["units"] = tuple(member for unit in configuration.units for member in members[unit])
        if isinstance(configuration.latency_s, dict):
            changed["latency_s"] = {
                member: value for unit, value in configuration.latency_s.items() for member in members.get(unit, [unit])
            }
        if isinstance(configuration.link, dict):
            changed["link"] = {
                member: link for unit, link in configuration.link.items() for member in members.get(unit, [unit])
            }
        result[name] = configuration.model_copy(update=changed)
    return result


# Groups of runs that are replayed together.


@dataclass(frozen=True)
class RunGroup:
    """Runs (S,) of one log that are replayed together; which of U units list objects in each, and which send lists.

    A unit that is only in some of the runs sends empty lists in the others. That is right where only the entries of
    lists count; where lists themselves count, all runs of a group have the same units.
    """

    runs: Int
    listing: Bool  # (S | 1, U)
    sending: Bool  # (U,)

    @classmethod
    def of_all_units(cls, experiment: ExpandedExperiment, runs: Int) -> RunGroup:
        """Runs (S,) with all units in each."""
        present = np.ones(len(experiment.named), dtype=bool)
        return cls(runs, present[None], present)


def group_runs(experiment: ExpandedExperiment, log: str, runs: Int, *, entries_alone: bool = False) -> list[RunGroup]:
    """The runs (S,) grouped by equal lists. `entries_alone`: only the entries of lists count."""
    everyone = RunGroup.of_all_units(experiment, runs)
    equipped = experiment.equipped(log, runs)
    if entries_alone and not experiment.arrivals_differ:
        return [everyone if equipped is None else replace(everyone, listing=equipped)]
    patterns, pattern_ix = everyone.listing, np.zeros(len(runs), dtype=np.int64)
    if equipped is not None:
        patterns, pattern_ix = np.unique(equipped, axis=0, return_inverse=True)
    if experiment.runs_apart:
        return [RunGroup(runs[s : s + 1], patterns[k][None], patterns[k]) for s, k in enumerate(pattern_ix.tolist())]
    return [RunGroup(runs[pattern_ix == k], present[None], present) for k, present in enumerate(patterns)]
