"""An experiment as it is for one log: with what the log's entry in `logs` says otherwise.

What is replayed of a log takes the experiment from `of_log`; what all logs have in common takes the experiment itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from typing import Any, TypeVar

from pydantic import ValidationError

from copem_replay.core.text import counted
from copem_replay.core.yaml import Key
from copem_replay.experiment.schema import Configuration, Experiment, LogSettings, Unit
from copem_replay.metrics.config import Measure, Objects

T = TypeVar("T")
_INSTEAD = {"on": "at", "at": "on", "pem": "recorded", "recorded": "pem", "classes": "ids", "ids": "classes"}
"""Of two keys that exclude each other, the one that is given takes the other's place."""


class SettingsError(ValueError):
    """Settings that do not fit their experiment: what is wrong with the keys below `key`, whose values are `data`."""

    def __init__(self, key: Key, data: dict[str, Any], error: ValidationError) -> None:
        super().__init__(str(error))
        self.key, self.data, self.error = key, data, error


def for_all_logs(of: Callable[..., T]) -> Callable[..., T]:
    """What is asked of one experiment, and of names in it, for each of its logs: worked out once."""
    last: list[tuple[Experiment, dict[tuple[str, ...], T]]] = []

    @wraps(of)
    def once(experiment: Experiment, *names: str) -> T:
        about, known = last[0] if last else (None, {})
        if about is not experiment:
            known = {}
            last[:] = [(experiment, known)]
        if names not in known:
            known[names] = of(experiment, *names)
        return known[names]

    return once


def of_log(experiment: Experiment, log: str) -> Experiment:
    """The experiment of one log, by the log's name; the experiment itself where the log has no settings."""
    settings = _by_name(experiment).get(log)
    return experiment if settings is None else with_settings(experiment, settings)


@for_all_logs
def _by_name(experiment: Experiment) -> dict[str | None, LogSettings]:
    return {entry.name: entry for entry in reversed(experiment.logs) if isinstance(entry, LogSettings)}


def with_settings(experiment: Experiment, settings: LogSettings) -> Experiment:
    """An experiment with the settings of one log, which its `logs` then have no more. Raises SettingsError."""
    given = settings.model_fields_set
    changed: dict[str, Any] = {key: getattr(settings, key) for key in ("ego", "window_s") if key in given}
    changed |= {key: value for key in ("read", "obstacles") if (value := getattr(settings, key)) is not None}
    units = _units(experiment, settings)
    changed |= {"units": units, "configurations": _configurations(experiment, units)}
    if settings.measure:
        changed["measure"] = _measure(experiment.measure, settings.measure)
    return experiment.model_copy(update=changed | {"logs": ()})


def _units(experiment: Experiment, settings: LogSettings) -> dict[str, Unit]:
    units: dict[str, Unit] = {}
    for name, unit in experiment.units.items():
        changes = settings.units.get(name, {})
        if changes is None:
            continue
        units[name] = unit
        if changes:
            data = _replaced(unit.model_dump(mode="json", by_alias=True, exclude_unset=True), changes)
            try:
                units[name] = Unit.model_validate(data)
            except ValidationError as error:
                raise SettingsError(("units", name), data, error) from error
    return units


def _replaced(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Keys with others in their place; what excludes one that is given goes."""
    gone = {_INSTEAD[key] for key, value in changes.items() if key in _INSTEAD and value is not None} - changes.keys()
    return {key: value for key, value in data.items() if key not in gone} | dict(changes)


def _measure(measure: Measure, changes: Mapping[str, Any]) -> Measure:
    """What is measured, of a log: `objects` key by key, the others whole."""
    data: dict[str, Any] = {key: getattr(measure, key) for key in measure.model_fields_set} | dict(changes)
    objects = changes.get("objects")
    try:
        if isinstance(objects, dict):
            mine = measure.objects.model_dump(mode="json", by_alias=True, exclude_unset=True)
            data["objects"] = _replaced(mine, objects)
            Objects.model_validate(data["objects"])
        return Measure.model_validate(data)
    except ValidationError as error:
        key = ("measure", "objects") if error.title == Objects.__name__ else ("measure",)
        raise SettingsError(key, data["objects"] if len(key) > 1 else data, error) from error


def _configurations(experiment: Experiment, units: Mapping[str, Unit]) -> dict[str, Configuration]:
    """The configurations that have a unit left, or never needed one, with the units there are."""
    kept: dict[str, Configuration] = {}
    for name, configuration in experiment.configurations.items():
        before = experiment.units_of(configuration)
        there = tuple(unit for unit in before if unit in units)
        changed: dict[str, Any] = {}
        if len(there) < len(before) and configuration.units != "all":
            changed["units"] = there
        late = configuration.latency_s
        if isinstance(late, dict) and not late.keys() <= {*units, "default", "truth"}:
            changed["latency_s"] = {
                unit: s for unit, s in late.items() if unit in units or unit not in experiment.units
            }
        if isinstance(configuration.link, dict):
            changed["link"] = {
                unit: link for unit, link in configuration.link.items() if unit in units or unit not in experiment.units
            }
        if there or not before:
            kept[name] = configuration.model_copy(update=changed) if changed else configuration
    return kept


def settings_notes(experiment: Experiment) -> Iterator[str]:
    """Which configurations lack units in how many logs: some of them, or all, so that they are left out there."""
    logs = [entry for entry in experiment.logs if isinstance(entry, LogSettings)]
    for name, configuration in experiment.configurations.items():
        members = experiment.units_of(configuration)
        without: dict[tuple[str, ...], list[str]] = {}
        for entry in logs:
            if gone := tuple(unit for unit in members if unit in entry.units and entry.units[unit] is None):
                without.setdefault(gone, []).append(entry.name or "")
        for gone, names in without.items():
            where = f"{len(names)} of {counted(len(experiment.logs), 'log')} ({_some(names)})"
            if len(gone) == len(members):
                yield f"configuration {name}: none of its units in {where}, and left out there"
            else:
                yield f"configuration {name}: without unit{'s' * (len(gone) > 1)} {', '.join(gone)} in {where}"


def _some(names: list[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")
