"""Sweeps: the same experiment at many values of one quantity, everything else as it is, with common random numbers.

A sweep of `latency_s` or `units` only varies configurations, one of `rate_hz` or `penetration_rate` the units
themselves, one of `correlation_s` what their PEMs remember, one of `ghosts_in_list` their ghosts, of which the truth
and ideal fusion never know. Configurations that it leaves as they are, or makes equal to one before, are left out. A
latency is varied only where there is one (above 0, or by unit) or where the configuration is named: one that hears no
unit over the air has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from copem_replay.communication.link import LinkModel
from copem_replay.core.memory import Memory
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.schema import Configuration, Experiment, Unit
from copem_replay.experiment.sweep_keys import SweptBy
from copem_replay.fusion.base import ListFusion
from copem_replay.metrics.config import Measure
from copem_replay.perception.config import Carriers
from copem_replay.perception.pem.model import Pem
from copem_replay.pipeline.swept_links import link_at, varies

KINDS = ("latency_s", "rate_hz", "units", "penetration_rate", "correlation_s", "ghosts_in_list", "loss", "burst_s")


@dataclass(frozen=True)
class Point:
    """One value of one sweep: `experiment` at that value, with the configurations it changes."""

    sweep: str
    value: float
    experiment: Experiment

    @property
    def same_units(self) -> bool:
        """Whether what is prepared for the experiment serves this point, too."""
        return self.sweep not in ("rate_hz", "penetration_rate")


def points(experiment: Experiment) -> Iterator[Point]:
    """The points of all sweeps of an experiment, sweep by sweep in the order of their values."""
    if experiment.sweep is None:
        return
    for kind in KINDS:
        values = getattr(experiment.sweep, kind) or ()
        curves = _curves(experiment, kind, values)
        for k, value in enumerate(values):
            at = experiment.model_copy(
                update={
                    "configurations": {name: c for name, curve in curves.items() if (c := curve[k]) is not None},
                    "units": _units_at(experiment.units, kind, value),
                    "pems": _pems_at(experiment.pems, kind, value),
                    "links": {name: link_at(link, kind, value) for name, link in experiment.links.items()},
                    "sweep": None,
                    "measure": _measured(experiment),
                }
            )
            if at.configurations:
                yield Point(kind, float(value), at)


def resolved(experiment: Experiment) -> Experiment:
    """The same experiment with `sweep.configurations` said: the list, or one for each quantity where they differ."""
    sweep = experiment.sweep
    if sweep is None or isinstance(sweep.configurations, tuple):
        return experiment
    swept = {kind: values for kind in KINDS if (values := getattr(sweep, kind))}
    names = {
        kind: sweep.chosen(kind)
        or tuple(name for name, curve in _curves(experiment, kind, values).items() if any(curve))
        for kind, values in swept.items()
    }
    first, *others = names.values()
    if not any(names.values()):
        return experiment
    alike = all(other == first for other in others)
    said = first if alike else SweptBy(**{kind: of_kind for kind, of_kind in names.items() if of_kind})
    return experiment.model_copy(update={"sweep": sweep.model_copy(update={"configurations": said})})


def without_points(experiment: Experiment) -> list[str]:
    """Sweeps of an experiment that no configuration is changed by, and what would help; what no sweep changes."""
    if experiment.sweep is None:
        return []
    there = {point.sweep for point in points(experiment)}
    none = [kind for kind in KINDS if getattr(experiment.sweep, kind) and kind not in there]
    notes = [f"sweep of {kind}: it changes no configuration{_unstated(experiment, kind)}" for kind in none]
    if experiment.outputs:
        notes.append(
            f"sweep: leaves {', '.join(experiment.outputs)} out, for the output of a stack is as it was recorded"
        )
    return notes


def _unstated(experiment: Experiment, kind: str) -> str:
    assert experiment.sweep is not None
    heard = [c for c in experiment.configurations.values() if c.units != TRUTH and not c.latency_s]
    if kind != "latency_s" or experiment.sweep.chosen(kind) or not heard:
        return ""
    return "; none states a latency above 0 or by unit, and `sweep: {configurations: […]}` does not name any"


def _measured(experiment: Experiment) -> Measure:
    """Perceived conflicts take time, and are not asked for unless the driver brakes for them; accuracy never is."""
    needed = experiment.braking is not None and experiment.braking.brakes_for == "conflict"
    conflict = experiment.measure.conflict if needed else None
    return experiment.measure.model_copy(update={"conflict": conflict, "accuracy": False})


def _curves(
    experiment: Experiment, kind: str, values: tuple[float, ...]
) -> dict[str, tuple[Configuration | None, ...]]:
    """What becomes of each configuration at each value; None: it has no such value."""
    curves: dict[str, tuple[Configuration | None, ...]] = {}
    assert experiment.sweep is not None
    chosen = experiment.sweep.chosen(kind)
    for name, configuration in experiment.configurations.items():
        # A latency that is not above 0 is one only where it is given by unit, or the configuration is named.
        wanted = name in chosen if chosen is not None else kind != "latency_s" or bool(configuration.latency_s)
        recorded = configuration.recorded is not None
        if not wanted or recorded or configuration.units == TRUTH or not _concerns(experiment, configuration, kind):
            continue
        curve = tuple(_configuration_at(experiment, configuration, kind, value) for value in values)
        if curve not in curves.values():
            curves[name] = curve
    return curves


def _concerns(experiment: Experiment, configuration: Configuration, kind: str) -> bool:
    units = [experiment.units[name] for name in experiment.units_of(configuration)]
    if kind == "units":
        return any(not _is_ego(unit) for unit in units)
    if kind == "latency_s" and isinstance(configuration.latency_s, dict):
        return any(name not in configuration.latency_s for name in experiment.units_of(configuration))
    if kind in ("loss", "burst_s"):
        links = [configuration.link_of(name) for name in experiment.units_of(configuration)]
        return any(varies(experiment.links[one] if isinstance(one, str) else one, kind) for one in links)
    if kind == "rate_hz":
        return any(unit.recorded is None for unit in units)
    if kind == "correlation_s":
        pems = [experiment.pems[unit.pem] for unit in units if unit.pem is not None]
        return any(pem.memory_of(c).get("detection") for pem in pems for c in range(len(pem.couples)))
    if kind == "ghosts_in_list":
        pems = [experiment.pems[unit.pem] for unit in units if unit.pem is not None]
        return isinstance(configuration.fusion, ListFusion) and any(pem.ghosts for pem in pems)
    return kind != "penetration_rate" or any(isinstance(unit.on, Carriers) for unit in units)


def _is_ego(unit: Unit) -> bool:
    return unit.on == "ego"


def _configuration_at(
    experiment: Experiment, configuration: Configuration, kind: str, value: float
) -> Configuration | None:
    if kind == "latency_s":
        by_unit = configuration.latency_s
        late = by_unit | {"default": value} if isinstance(by_unit, dict) else value
        return configuration.model_copy(update={"latency_s": late})
    if kind in ("loss", "burst_s") and isinstance(configuration.link, LinkModel):
        return configuration.model_copy(update={"link": link_at(configuration.link, kind, value)})
    if kind != "units":
        return configuration
    heard = experiment.units_of(configuration)
    others = [name for name in heard if not _is_ego(experiment.units[name])]
    kept = [name for name in heard if name not in others[int(value) :]]
    if value > len(others) or not kept:
        return None
    return configuration.model_copy(update={"units": tuple(kept)})


def _units_at(units: Mapping[str, Unit], kind: str, value: float) -> dict[str, Unit]:
    if kind == "rate_hz":
        return {
            name: unit if unit.recorded else unit.model_copy(update={"rate_hz": value}) for name, unit in units.items()
        }
    if kind == "penetration_rate":
        return {
            name: unit.model_copy(update={"on": unit.on.model_copy(update={"penetration_rate": value})})
            if isinstance(unit.on, Carriers)
            else unit
            for name, unit in units.items()
        }
    return dict(units)


def _pems_at(pems: Mapping[str, Pem], kind: str, value: float) -> dict[str, Pem]:
    if kind == "ghosts_in_list":
        return {name: _with_ghosts(pem, value) for name, pem in pems.items()}
    if kind != "correlation_s":
        return dict(pems)

    def at(memory: Memory) -> Memory:
        if not memory.get("detection"):
            return memory
        first, *others = memory["detection"]
        return memory | {"detection": (first.model_copy(update={"correlation_s": float(value)}), *others)}

    result = {}
    for name, pem in pems.items():
        couples = tuple(
            couple if couple.memory is None else couple.model_copy(update={"memory": at(couple.memory)})
            for couple in pem.couples
        )
        result[name] = pem.model_copy(update={"couples": couples, "memory": at(pem.memory)})
    return result


def _with_ghosts(pem: Pem, in_list: float) -> Pem:
    """A PEM with so many of the first of its sorts of ghosts."""
    if not pem.ghosts:
        return pem
    first, *others = pem.ghosts
    return pem.model_copy(update={"ghosts": (first.model_copy(update={"in_list": float(in_list)}), *others)})
