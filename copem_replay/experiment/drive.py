"""The experiment of one log: with the settings of the log's entry in `logs`; and latencies recorded in a file.

A replay takes the experiment of its log from `resolve_for_log`; code on all logs takes the experiment itself.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from pydantic import Field, PrivateAttr, ValidationError, model_validator

from copem_replay.communication.latency import LatencyModel
from copem_replay.core.components import FileBeside, error_at_key
from copem_replay.core.errors import InputError, count_noun
from copem_replay.core.tracks import Float
from copem_replay.core.yaml import Key
from copem_replay.experiment.degrees import resolve_degrees
from copem_replay.experiment.schema import Configuration, Experiment, LogSettings, Unit
from copem_replay.io.channel import DefinitionError
from copem_replay.io.encodings import make_definition
from copem_replay.io.encodings.columns import shred_messages
from copem_replay.io.log import gather_messages
from copem_replay.io.open import open_log
from copem_replay.io.stamps import find_stamp_paths, parse_nanoseconds
from copem_replay.metrics.config import Measure, Objects

T = TypeVar("T")
_INSTEAD = {"pem": "recorded", "recorded": "pem", "classes": "ids", "ids": "classes"}
_PLACES = {"on", "at", "at_wgs84"}
"""Keys that exclude each other: a setting of the one replaces the others."""


class SettingsError(ValueError):
    """Settings that do not fit their experiment: `error` is about the keys below `key`, whose values are `data`."""

    def __init__(self, key: Key, data: dict[str, Any], error: ValidationError) -> None:
        super().__init__(str(error))
        self.key, self.data, self.error = key, data, error


def cache_last_experiment(function: Callable[..., T]) -> Callable[..., T]:
    """Cache a function of an experiment and of names, for the last experiment it was called with."""
    last: list[tuple[Experiment, dict[tuple[str, ...], T]]] = []

    @wraps(function)
    def once(experiment: Experiment, *names: str) -> T:
        cached_for, values = last[0] if last else (None, {})
        if cached_for is not experiment:
            values = {}
            last[:] = [(experiment, values)]
        if names not in values:
            values[names] = function(experiment, *names)
        return values[names]

    return once


def resolve_for_log(experiment: Experiment, log: str) -> Experiment:
    """The experiment of one log, by the log's name; the experiment itself where the log has no settings."""
    settings = _settings_by_name(experiment).get(log)
    return experiment if settings is None else apply_settings(experiment, settings)


@cache_last_experiment
def _settings_by_name(experiment: Experiment) -> dict[str | None, LogSettings]:
    return {entry.name: entry for entry in reversed(experiment.logs) if isinstance(entry, LogSettings)}


def apply_settings(experiment: Experiment, settings: LogSettings) -> Experiment:
    """An experiment with the settings of one log, and no `logs`; metres for degrees where they give the frame.

    Raises SettingsError where they do not fit.
    """
    keys = settings.model_fields_set
    changed: dict[str, Any] = {key: getattr(settings, key) for key in ("ego", "window_s") if key in keys}
    changed |= {
        key: value for key in ("read", "obstacles", "maps", "frame") if (value := getattr(settings, key)) is not None
    }
    units = _apply_units(experiment, settings)
    changed |= {"units": units, "configurations": _keep_configurations(experiment, units)}
    if settings.tags:
        changed["tags"] = experiment.tags | settings.tags
    if settings.measure:
        changed["measure"] = _apply_measure(experiment.measure, settings.measure)
    of_log = experiment.model_copy(update=changed | {"logs": ()})
    return of_log if of_log.frame is None else resolve_degrees(of_log, of_log.frame.frame)


def _apply_units(experiment: Experiment, settings: LogSettings) -> dict[str, Unit]:
    """The units that a log has, with its own keys; a unit that fuses fuses those members. Raises SettingsError."""
    units: dict[str, Unit] = {}
    for name, unit in experiment.units.items():
        changes = settings.units.get(name, {})
        if changes is None:
            continue
        units[name] = unit
        if changes:
            data = _replace_keys(unit.model_dump(mode="json", by_alias=True, exclude_unset=True), changes)
            try:
                units[name] = Unit.model_validate(data)
            except ValidationError as error:
                raise SettingsError(("units", name), data, error) from error
    for name, unit in list(units.items()):  # a unit fuses those of its members that the log has
        if unit.fuses is not None and not units.keys() >= set(unit.fuses):
            members_here = tuple(member for member in unit.fuses if member in units)
            units.pop(name)
            units |= {name: unit.model_copy(update={"fuses": members_here})} if members_here else {}
    return units


def _replace_keys(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The data with changed keys, without the keys that these exclude."""
    given = {key for key, value in changes.items() if value is not None}
    gone = {_INSTEAD[key] for key in given & _INSTEAD.keys()} - changes.keys()
    if given & _PLACES:
        gone |= _PLACES - changes.keys()
    return {key: value for key, value in data.items() if key not in gone} | dict(changes)


def _apply_measure(measure: Measure, changes: Mapping[str, Any]) -> Measure:
    """`measure` of a log: `objects` is changed key by key, other keys are replaced. Raises SettingsError."""
    data: dict[str, Any] = {key: getattr(measure, key) for key in measure.model_fields_set} | dict(changes)
    objects = changes.get("objects")
    try:
        if isinstance(objects, dict):
            own_objects = measure.objects.model_dump(mode="json", by_alias=True, exclude_unset=True)
            data["objects"] = _replace_keys(own_objects, objects)
            Objects.model_validate(data["objects"])
        return Measure.model_validate(data)
    except ValidationError as error:
        key = ("measure", "objects") if error.title == Objects.__name__ else ("measure",)
        raise SettingsError(key, data["objects"] if len(key) > 1 else data, error) from error


def _keep_configurations(experiment: Experiment, units: Mapping[str, Unit]) -> dict[str, Configuration]:
    """The configurations reduced to the units that the log has; those that lose all their units are left out."""
    remaining: dict[str, Configuration] = {}
    for name, configuration in experiment.configurations.items():
        members = experiment.units_of(configuration)
        present = tuple(unit for unit in members if unit in units)
        changed: dict[str, Any] = {}
        if len(present) < len(members) and configuration.units != "all":
            changed["units"] = present
        latency_s = configuration.latency_s
        if isinstance(latency_s, dict) and not latency_s.keys() <= {*units, "default", "truth"}:
            changed["latency_s"] = {
                unit: s for unit, s in latency_s.items() if unit in units or unit not in experiment.units
            }
        if isinstance(configuration.link, dict):
            changed["link"] = {
                unit: link for unit, link in configuration.link.items() if unit in units or unit not in experiment.units
            }
        if present or not members:
            remaining[name] = configuration.model_copy(update=changed) if changed else configuration
    return remaining


def settings_notes(experiment: Experiment) -> Iterator[str]:
    """A note for every configuration that lacks some or all of its units in some logs."""
    logs = [entry for entry in experiment.logs if isinstance(entry, LogSettings)]
    for name, configuration in experiment.configurations.items():
        members = experiment.units_of(configuration)
        lacking: dict[tuple[str, ...], list[str]] = {}
        for entry in logs:
            if missing := tuple(unit for unit in members if unit in entry.units and entry.units[unit] is None):
                lacking.setdefault(missing, []).append(entry.name or "")
        for missing, names in lacking.items():
            where = f"{len(names)} of {count_noun(len(experiment.logs), 'log')} ({_shorten_names(names)})"
            if len(missing) == len(members):
                yield f"configuration {name}: none of its units in {where}, and left out there"
            else:
                yield f"configuration {name}: without unit{'s' * (len(missing) > 1)} {', '.join(missing)} in {where}"


def _shorten_names(names: list[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")


# Recorded latencies: a column of a CSV, or log times minus stamps of an MCAP topic.

Name = Annotated[str, Field(min_length=1)]


class RecordedLatency(LatencyModel):
    """Recorded latencies: `column` of a CSV, in seconds, or log time − `stamp` of the messages on an MCAP's `topic`.

    `file` is relative to the experiment file. Quantiles are interpolated linearly between the values.
    """

    kind: Literal["recorded"] = "recorded"
    file: FileBeside
    column: Name | None = None
    topic: Name | None = None
    stamp: Name = "header.stamp"
    _sorted_s: tuple[float, ...] = PrivateAttr(())

    @model_validator(mode="after")
    def _read(self) -> Self:
        """Read the delays (s) from the file, when the keys are parsed. Raises an error at the key `file`."""
        if (self.column is None) == (self.topic is None):
            raise ValueError("expected one of `column: <name>` (of a CSV) and `topic: <name>` (of an MCAP)")
        where = f"{Path(self.file).name}: {f'column {self.column}' if self.column else f'topic {self.topic}'}"
        try:
            delays_s = _read_column(Path(self.file), self.column) if self.column else self._of_topic(str(self.topic))
        except (OSError, UnicodeDecodeError, InputError) as error:
            why = error.strerror if isinstance(error, OSError) else str(error)
            raise error_at_key("file", f"{self.file}: cannot be read: {why}") from None
        except (KeyError, DefinitionError) as error:
            raise error_at_key("file", f"{where}: {error.args[0] if error.args else error}") from None
        if not len(delays_s) or not np.isfinite(delays_s).all():
            raise error_at_key(
                "file", f"{where}: expected seconds, found {'none' if not len(delays_s) else 'what is no number'}"
            )
        if (delays_s < 0).any():
            raise error_at_key("file", f"{where}: {count_noun(int((delays_s < 0).sum()), 'negative value')}")
        self._sorted_s = tuple(np.sort(delays_s).tolist())
        return self

    @property
    def sorted_s(self) -> tuple[float, ...]:
        """The recorded latencies in seconds, ascending."""
        return self._sorted_s

    def delays(self, uniform: Float) -> Float:
        """(K,) seconds for uniform numbers (K,): quantiles, linear between the order statistics."""
        result: Float = np.quantile(np.array(self._sorted_s), uniform)
        return result

    def _of_topic(self, topic: str) -> Float:
        """Log time − stamp (s) of all messages of a topic. Raises KeyError: no such topic, or no stamps."""
        log = open_log(Path(self.file))
        channel = next((c for c in log.channels if c.topic == topic), None)
        if channel is None:
            raise KeyError("there is no such topic")
        messages = gather_messages(log, frozenset({channel.number}))
        definition = make_definition(channel, messages.payloads[channel.number])
        paths = find_stamp_paths(definition.offers(), self.stamp)
        if not paths:
            raise KeyError(f"its messages have no time at {self.stamp!r}; say `stamp: <field>`")
        level = shred_messages(definition, messages.payloads[channel.number], texts=paths).levels[""]
        stamp_ns, stamped, _ = parse_nanoseconds([level.texts[path] for path in paths], "ns")
        logged_ns = np.array(messages.log_time_ns[channel.number], dtype=np.int64)[level.parent]
        delay_s: Float = (logged_ns - stamp_ns)[stamped] * np.float64(1e-9)
        return delay_s


def _read_column(path: Path, column: str) -> Float:
    """A column of numbers, a single NaN where a text is no number. Raises KeyError where there is no such column."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file)
        if column not in (rows.fieldnames or ()):
            raise KeyError(f"there is no such column; there are {', '.join(rows.fieldnames or ('none',))}")
        texts = [row[column] for row in rows]
    try:
        return np.array([float(text) for text in texts])
    except (ValueError, TypeError):
        return np.array([np.nan])
