"""Sweeps: an experiment at several values of one quantity, everything else unchanged, with common random numbers.

A sweep of `latency_s` or `units` varies configurations alone, one of `rate_hz` or `penetration_rate` units, one of
`correlation_s` the memory of PEMs, one of `ghosts_in_list` their ghosts, which the truth and ideal fusion never have,
one of `loss` or `burst_s` links: with common draws more loss only removes lists. Configurations that a sweep does not
change, or makes equal to one before, are left out. A latency is varied only where a configuration has one (above 0, or
by unit) or is named: one that hears no unit over the air has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from copem_replay.communication.link import LinkModel
from copem_replay.communication.radio import Radio
from copem_replay.communication.reception import ConstantReception, GilbertElliott
from copem_replay.core.memory import Memory
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.schema import Configuration, Experiment, SweptBy, Unit
from copem_replay.fusion.interface import ListFusion
from copem_replay.metrics.config import Measure
from copem_replay.perception.config import Carriers
from copem_replay.perception.pem.model import Pem

# Links at one value of a sweep.

SHORTEST_S = 0.001
"""A burst of 0 s is one of a millisecond, shorter than any interval of lists: the state is new in every list."""


def can_vary(link: LinkModel | None, kind: str) -> bool:
    """Whether a sweep of `loss` or `burst_s` can change the link."""
    if not isinstance(link, Radio):
        return False
    if isinstance(link.reception, GilbertElliott):
        return True
    return isinstance(link.reception, ConstantReception) if kind == "loss" else bool(link.memory.get("reception"))


def set_link(link: LinkModel, kind: str, value: float) -> LinkModel:
    """A link at one value of a sweep; unchanged where the sweep does not vary it."""
    if kind not in ("loss", "burst_s") or not isinstance(link, Radio) or not can_vary(link, kind):
        return link
    reception, changed = link.reception, link.reception
    if kind == "loss" and isinstance(reception, GilbertElliott):
        changed = reception.model_copy(update={"bad_share": _bad_share(reception, value)})
    elif kind == "loss":
        changed = reception.model_copy(update={"probability_": 1 - value})
    elif isinstance(reception, GilbertElliott):
        changed = reception.model_copy(update={"bad_lasts_s": max(float(value), SHORTEST_S)})
    else:
        first, *others = link.memory["reception"]
        parts = (first.model_copy(update={"correlation_s": float(value)}), *others)
        return link.model_copy(update={"memory": link.memory | {"reception": parts}})
    return link.model_copy(update={"reception": changed})


def _bad_share(reception: GilbertElliott, loss: float) -> float:
    """The share of time in the bad state, 0 … 1, at which the mean loss is `loss`."""
    good, bad = reception.good_loss, reception.bad_loss
    return min(max((loss - good) / (bad - good), 0.0), 1.0) if bad != good else reception.bad_share


# Points of a sweep.

KINDS = ("latency_s", "rate_hz", "units", "penetration_rate", "correlation_s", "ghosts_in_list", "loss", "burst_s")


@dataclass(frozen=True)
class SweepPoint:
    """One value of one sweep: `experiment` at that value, with the configurations that the sweep changes."""

    sweep: str
    value: float
    experiment: Experiment

    @property
    def same_units(self) -> bool:
        """Whether a log that is prepared for the experiment can be used at this point, too."""
        return self.sweep not in ("rate_hz", "penetration_rate")


def list_points(experiment: Experiment) -> Iterator[SweepPoint]:
    """The points of all sweeps of an experiment, sweep by sweep in the order of their values."""
    if experiment.sweep is None:
        return
    for kind in KINDS:
        values = getattr(experiment.sweep, kind) or ()
        curves = _sweep_configurations(experiment, kind, values)
        for k, value in enumerate(values):
            swept = experiment.model_copy(
                update={
                    "configurations": {name: c for name, curve in curves.items() if (c := curve[k]) is not None},
                    "units": _set_units(experiment.units, kind, value),
                    "pems": _set_pems(experiment.pems, kind, value),
                    "links": {name: set_link(link, kind, value) for name, link in experiment.links.items()},
                    "sweep": None,
                    "measure": _reduce_measure(experiment),
                }
            )
            if swept.configurations:
                yield SweepPoint(kind, float(value), swept)


def resolve_sweep(experiment: Experiment) -> Experiment:
    """The experiment with explicit `sweep.configurations`: one list, or one for each quantity where they differ."""
    sweep = experiment.sweep
    if sweep is None or isinstance(sweep.configurations, tuple):
        return experiment
    swept = {kind: values for kind in KINDS if (values := getattr(sweep, kind))}
    names = {
        kind: sweep.chosen(kind)
        or tuple(name for name, curve in _sweep_configurations(experiment, kind, values).items() if any(curve))
        for kind, values in swept.items()
    }
    first, *others = names.values()
    if not any(names.values()):
        return experiment
    all_equal = all(other == first for other in others)
    configurations = first if all_equal else SweptBy(**{kind: of_kind for kind, of_kind in names.items() if of_kind})
    return experiment.model_copy(update={"sweep": sweep.model_copy(update={"configurations": configurations})})


def describe_unswept(experiment: Experiment) -> list[str]:
    """Notes: sweeps that change no configuration, with what helps, and recorded outputs, which no sweep changes."""
    if experiment.sweep is None:
        return []
    effective = {point.sweep for point in list_points(experiment)}
    without_effect = [kind for kind in KINDS if getattr(experiment.sweep, kind) and kind not in effective]
    notes = [
        f"sweep of {kind}: it changes no configuration{_explain_unstated(experiment, kind)}" for kind in without_effect
    ]
    if experiment.outputs:
        notes.append(
            f"sweep: leaves {', '.join(experiment.outputs)} out, for the output of a stack is as it was recorded"
        )
    return notes


def _explain_unstated(experiment: Experiment, kind: str) -> str:
    assert experiment.sweep is not None
    received = [c for c in experiment.configurations.values() if c.units != TRUTH and not c.latency_s]
    if kind != "latency_s" or experiment.sweep.chosen(kind) or not received:
        return ""
    return "; none states a latency above 0 or by unit, and `sweep: {configurations: […]}` does not name any"


def _reduce_measure(experiment: Experiment) -> Measure:
    """What sweeps measure: no accuracy, no own metrics; perceived conflicts only if the driver brakes for them."""
    needed = experiment.braking is not None and experiment.braking.brakes_for == "conflict"
    conflict = experiment.measure.conflict if needed else None
    return experiment.measure.model_copy(update={"conflict": conflict, "accuracy": False, "metrics": ()})


def _sweep_configurations(
    experiment: Experiment, kind: str, values: tuple[float, ...]
) -> dict[str, tuple[Configuration | None, ...]]:
    """By name each configuration at each value; None: it has no such value. Of equal ones only the first."""
    curves: dict[str, tuple[Configuration | None, ...]] = {}
    assert experiment.sweep is not None
    chosen = experiment.sweep.chosen(kind)
    for name, configuration in experiment.configurations.items():
        # A configuration has a latency if it is above 0 or by unit; else it is varied only by name.
        wanted = name in chosen if chosen is not None else kind != "latency_s" or bool(configuration.latency_s)
        recorded = configuration.recorded is not None
        if not wanted or recorded or configuration.units == TRUTH or not _is_concerned(experiment, configuration, kind):
            continue
        curve = tuple(_set_configuration(experiment, configuration, kind, value) for value in values)
        if curve not in curves.values():
            curves[name] = curve
    return curves


def _is_concerned(experiment: Experiment, configuration: Configuration, kind: str) -> bool:
    """Whether a configuration changes with the swept quantity `kind`, such as `units` or `rate_hz`."""
    units = [experiment.units[name] for name in experiment.units_of(configuration)]
    if kind == "units":
        return any(not _is_ego(unit) for unit in units)
    if kind == "latency_s" and isinstance(configuration.latency_s, dict):
        return any(name not in configuration.latency_s for name in experiment.units_of(configuration))
    if kind in ("loss", "burst_s"):
        links = [configuration.link_of(name) for name in experiment.units_of(configuration)]
        return any(can_vary(experiment.links[one] if isinstance(one, str) else one, kind) for one in links)
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


def _set_configuration(
    experiment: Experiment, configuration: Configuration, kind: str, value: float
) -> Configuration | None:
    """The configuration with `value` for `latency_s`, `loss`, `burst_s` or `units`; None: it has fewer units."""
    if kind == "latency_s":
        by_unit = configuration.latency_s
        late = by_unit | {"default": value} if isinstance(by_unit, dict) else value
        return configuration.model_copy(update={"latency_s": late})
    if kind in ("loss", "burst_s") and isinstance(configuration.link, LinkModel):
        return configuration.model_copy(update={"link": set_link(configuration.link, kind, value)})
    if kind != "units":
        return configuration
    received = experiment.units_of(configuration)
    others = [name for name in received if not _is_ego(experiment.units[name])]
    kept = [name for name in received if name not in others[int(value) :]]
    if value > len(others) or not kept:
        return None
    return configuration.model_copy(update={"units": tuple(kept)})


def _set_units(units: Mapping[str, Unit], kind: str, value: float) -> dict[str, Unit]:
    """The units with `value` for `rate_hz` or `penetration_rate`; other kinds change no unit."""
    if kind == "rate_hz":
        return {
            name: unit if unit.pem is None else unit.model_copy(update={"rate_hz": value})
            for name, unit in units.items()
        }
    if kind == "penetration_rate":
        return {
            name: unit.model_copy(update={"on": unit.on.model_copy(update={"penetration_rate": value})})
            if isinstance(unit.on, Carriers)
            else unit
            for name, unit in units.items()
        }
    return dict(units)


def _set_pems(pems: Mapping[str, Pem], kind: str, value: float) -> dict[str, Pem]:
    """The PEMs with `value` for `ghosts_in_list` or `correlation_s` of detection; other kinds change no PEM."""
    if kind == "ghosts_in_list":
        return {name: _set_ghosts(pem, value) for name, pem in pems.items()}
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


def _set_ghosts(pem: Pem, in_list: float) -> Pem:
    """A PEM whose first sort of ghosts has `in_list` entries in a list on average."""
    if not pem.ghosts:
        return pem
    first, *others = pem.ghosts
    return pem.model_copy(update={"ghosts": (first.model_copy(update={"in_list": float(in_list)}), *others)})
