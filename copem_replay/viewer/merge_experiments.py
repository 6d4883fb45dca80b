"""Merge: experiments that are compared, as one that holds the configurations of all, for what shows them together.

Nothing is drawn with it: draws are by the units' names, and units of one name that differ get another here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from copem_replay.communication.link import LinkModel
from copem_replay.experiment.schema import Configuration, Experiment, Unit
from copem_replay.perception.pem.model import Pem


@dataclass(frozen=True)
class Part:
    """An experiment, what its folder is called, and what its configurations are called in the merged one."""

    name: str
    experiment: Experiment
    labels: Mapping[str, str]


def merged(parts: Sequence[Part]) -> Experiment:
    """The first experiment with the units and configurations of all."""
    units: dict[str, Unit] = {}
    pems: dict[str, Pem] = {}
    configurations: dict[str, Configuration] = {}
    links: dict[str, LinkModel] = {}
    for part in parts:
        called: dict[str, str] = {}
        for name, unit in part.experiment.units.items():
            pem = None if unit.pem is None else part.experiment.pems[unit.pem]
            called[name] = _called(name, part.name, unit, pem, units, pems)
            units[called[name]] = unit if pem is None else unit.model_copy(update={"pem": called[name]})
            if pem is not None:
                pems[called[name]] = pem
        mine = part.experiment.links
        same = {name: name if links.get(name, link) == link else f"{part.name}:{name}" for name, link in mine.items()}
        links |= {same[name]: link for name, link in mine.items()}
        for name, label in part.labels.items():
            configurations[label] = _with(part.experiment, part.experiment.configurations[name], called, same)
    changed = {"units": units, "pems": pems, "links": links, "configurations": configurations, "sweep": None}
    return parts[0].experiment.model_copy(update=changed)


def _called(
    name: str, folder: str, unit: Unit, pem: Pem | None, units: Mapping[str, Unit], pems: Mapping[str, Pem]
) -> str:
    """The unit's own name, where it is free or borne by the same unit; else with the folder's, until it is."""
    wanted = name
    while wanted in units:
        same = units[wanted].model_copy(update={"pem": None}) == unit.model_copy(update={"pem": None})
        if same and pems.get(wanted) == pem:
            break
        wanted = f"{folder}:{wanted}"
    return wanted


def _with(
    experiment: Experiment, configuration: Configuration, called: Mapping[str, str], links: Mapping[str, str]
) -> Configuration:
    """A configuration that names its units, and its links, as they are called in the merged experiment."""
    changed: dict[str, object] = {}
    if configuration.units != "truth":
        changed["units"] = tuple(called[name] for name in experiment.units_of(configuration))
    if configuration.inputs is not None:
        changed["inputs"] = tuple(called[name] for name in configuration.inputs)
    if isinstance(configuration.latency_s, dict):
        changed["latency_s"] = {called.get(unit, unit): late for unit, late in configuration.latency_s.items()}
    if isinstance(configuration.link, str):
        changed["link"] = links.get(configuration.link, configuration.link)
    if isinstance(configuration.link, dict):
        changed["link"] = {called.get(unit, unit): links.get(link, link) for unit, link in configuration.link.items()}
    return configuration.model_copy(update=changed)
