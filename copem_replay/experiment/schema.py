"""The experiment: what is replayed through what, and what is measured. Frozen models, defaults that run.

Units are in the names of keys. Cross-references (a unit's `pem`, a configuration's `units`)
are checked in `experiment/validate.py`, which reports all problems of a file at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from copem_replay.communication.latency import Delay
from copem_replay.communication.link import ConstantLink, LinkModel, UnitLinks
from copem_replay.communication.sends import Sends
from copem_replay.core.components import Count, Either, Frozen, Id, Latency, Number, Positive, Slot, at_key, described
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.link_keys import AnyLink, IssueRate, LinkName, LinkOf
from copem_replay.experiment.names import ConfigurationName, UnitName
from copem_replay.experiment.show_keys import Show
from copem_replay.experiment.sweep_keys import Sweep
from copem_replay.fusion import FUSIONS
from copem_replay.fusion.base import Fusion, Ideal
from copem_replay.io.config import Ego, HowRead, Read, Recorded, RecordedOutput, WindowOf
from copem_replay.metrics.config import Braking, Measure
from copem_replay.perception.config import Carriers, Obstacle, Placement
from copem_replay.perception.pem.model import Pem
from copem_replay.perception.visibility import Surface, Visibility


def _of_64_bits(value: int) -> int:
    if not -(2**63) <= value < 2**64:
        raise ValueError(f"expected a whole number of 64 bits (-2^63 … 2^64 - 1), found {value}")
    return value


def _version(value: object) -> object:
    if isinstance(value, bool):  # equals 1 to Python
        raise ValueError(f"expected 1, found {str(value).lower()}")
    return value


_NOT_RECORDED = {
    "placed": "is where its lists say",
    "clock": "captures when its lists say",
    "outages": "makes the lists that are recorded",
    "ready": "arrives when its lists say",
    "sends": "sends what is recorded",
}


class Unit(Placement):
    """A perception unit: its place, and the PEM or the `recorded` topic of its lists.

    A recorded unit has no PEM, and needs a place only where distances are measured from it. `ready`: processing time
    from capture until a list can be sent; `sends`: which lists and objects it sends.

    >>> cr.Unit(at=(12.0, -4.5), yaw_deg=90.0, height_m=5.0, pem="camera").rate_hz is None
    True
    """

    recorded: Recorded | None = None
    ready: Delay | None = Field(default=None, exclude_if=lambda ready: ready is None)
    sends: Sends | None = Field(default=None, exclude_if=lambda sends: sends is None)

    @model_validator(mode="after")
    def _place(self) -> Self:
        if (self.pem is None) == (self.recorded is None):
            raise ValueError("expected one of `pem: <name>` and `recorded: {topic: …}`")
        if self.recorded is not None:
            for key, why in _NOT_RECORDED.items():
                if getattr(self, key) is not None:
                    raise at_key(key, f"a recorded unit {why}; only for units with a pem")
            if self.rate_hz is not None or isinstance(self.on, Carriers) or (self.on and self.at):
                raise ValueError("recorded: goes with one place, `on` an object or `at` a point, and without rate_hz")
            return self
        if (self.on is None) == (self.at is None):
            raise ValueError(
                "expected one of `on: ego`, `on: <object id>`, `on: {classes, penetration_rate}` and `at: [x, y]`"
            )
        if self.height_m is None and self.at is not None:
            raise ValueError("height_m: needed for a unit `at` a place; only a carried one is on a roof by default")
        if self.ground_z_m is not None and self.at is None:
            raise ValueError("ground_z_m: only for a unit `at` a place; a carrier brings its own ground")
        if self.phase_s and self.rate_hz is None:
            raise ValueError("phase_s: needs rate_hz (without it there is one list per frame of the truth)")
        return self


class Configuration(Frozen):
    """Units, fusion, `link` and additional latency (for all units or by unit) that are compared with others.

    `issue_hz`: how often the receiver issues fused lists; left out, whenever a list arrives.

    Or a stack's `recorded` output, and the recorded units that were its `inputs`: its regret is the difference to ideal
    fusion of these.

    >>> late = cr.Configuration(units="all", latency_s={"ego": 0.0, "default": 0.15}, fusion={"kind": "gnn"})
    >>> late.latency_of("mast"), late.fusion.kind
    (0.15, 'gnn')
    """

    units: Literal["truth", "all"] | Annotated[tuple[Id, ...], Field(min_length=1)] = ()
    recorded: RecordedOutput | None = None
    inputs: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None
    fusion: Annotated[Fusion, Slot("fusion", FUSIONS, "ideal")] = Ideal()
    latency_s: Latency | dict[Id, Latency] = 0.0
    link: LinkOf | None = Field(default=None, exclude_if=lambda link: link is None)
    issue_hz: IssueRate | None = Field(default=None, exclude_if=lambda rate: rate is None)
    max_age_s: Positive = 1.0

    @model_validator(mode="after")
    def _what(self) -> Self:
        if self.recorded is None:
            if not self.units:
                raise ValueError("units: missing (or `recorded: {topic: …}`, a stack's own output)")
            if self.inputs is not None:
                raise ValueError("inputs: what a `recorded` output was made of; other configurations have `units`")
        elif beside := sorted(self.model_fields_set - {"recorded", "inputs"}):
            raise ValueError(f"recorded: nothing is made of it, so it goes without {', '.join(beside)}")
        return self

    @model_serializer(mode="wrap")
    def _as_given(self, dump: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """A recorded output without what does not go with it, any other configuration without what only that has."""
        output = self.recorded is not None
        return {k: v for k, v in dump(self).items() if (k in ("recorded", "inputs")) == output and (v or not output)}

    def latency_of(self, unit: str) -> float:
        """Seconds that `latency_s` adds to the way of every list of a unit."""
        return ConstantLink(latency_s=self.latency_s).fixed_s(unit)

    def link_of(self, unit: str) -> str | LinkModel | None:
        """The link that a unit sends by, or its name; None: there is none but `latency_s`."""
        link = self.link.get(unit, self.link.get("default", "none")) if isinstance(self.link, dict) else self.link
        return None if link == "none" else link


MEASURED_PER_LOG = ("objects", "onset", "distance_to", "annotated")
"""Keys of `measure` that a log may have its own of; the others say what the tables of all logs have in common."""


class LogSettings(Frozen):
    """A recording and its settings: keys given here replace those of the experiment, lists as a whole.

    `file`: a path, wildcards allowed. `name`: name of the log, by default that of its file. In `units` and `measure`
    single keys are replaced; a unit that is `null` is absent from the log. `together`, instead of `file`: several
    recordings of one drive; `clock_offset_s`: how far the clock of each is ahead of the first one's.
    """

    file: Annotated[str, Field(min_length=1)] | None = None
    together: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=2)] | None = None
    clock_offset_s: dict[str, Number] = Field(default_factory=dict)
    name: Annotated[Id, Field(min_length=1)] | None = None
    ego: Ego | None = None
    window_s: WindowOf | None = None
    units: dict[Id, dict[str, Any] | None] = Field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] | None = None
    read: HowRead | None = None
    measure: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.file is None) == (self.together is None):
            raise ValueError("expected one of `file: <recording>` and `together: [<recording>, <recording>]`")
        paths = self.together or ()
        if len(set(paths)) < len(paths):
            raise ValueError(f"together: expected each recording once, found {max(paths, key=paths.count)!r} twice")
        for name, offset_s in self.clock_offset_s.items():
            if name not in paths:
                expected = ", ".join(paths[1:]) or "none without `together`"
                raise ValueError(f"clock_offset_s: expected a recording of `together` ({expected}), found {name!r}")
            if name == paths[0] and offset_s:
                raise ValueError(f"clock_offset_s: {name!r} is the first, by whose clock the others are ahead")
        return self

    @field_validator("measure")
    @classmethod
    def _of_a_log(cls, measure: dict[str, Any]) -> dict[str, Any]:
        for key in measure:
            if key not in MEASURED_PER_LOG:
                names = ", ".join(MEASURED_PER_LOG)
                raise ValueError(f"{key}: goes for all logs alike; a log has its own {names}")
        return measure

    @model_serializer(mode="wrap")
    def _as_given(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Only keys that are given: a `null` would be one, too."""
        written: dict[str, Any] = write(self)
        return {key: value for key, value in written.items() if key in self.model_fields_set}


def output_unit(configuration: str) -> str:
    """What the unit is called that stands for the recorded output of a configuration."""
    return f"{configuration} (recorded)"


def ideal_over(configurations: Mapping[str, Configuration], inputs: Sequence[str]) -> str | None:
    """The configuration that is ideal fusion of these very units without latency; None: there is none."""
    for name, one in configurations.items():
        alike = one.recorded is None and not isinstance(one.units, str) and set(one.units) == set(inputs)
        if alike and one.fusion == Ideal() and one.link is None and not one.latency_s and one.issue_hz is None:
            return name
    return None


def _with_ideals(configurations: dict[str, Configuration]) -> dict[str, Configuration]:
    """Beside each recorded output ideal fusion of its inputs, `<name>:ideal`, where there is none yet."""
    result = dict(configurations)
    for name, one in configurations.items():
        if one.inputs is None or ideal_over(result, one.inputs) is not None:
            continue
        if f"{name}:ideal" in result:
            raise ValueError(f"{name}:ideal: expected ideal fusion of the inputs of {name}, found another; rename it")
        result[f"{name}:ideal"] = Configuration(units=one.inputs)
    return result


LogEntry = Either[str, LogSettings]
"""A path, with wildcards or not, or a mapping with settings."""


def _as_file(schema: dict[str, Any]) -> None:
    """A file has to name its logs; only an experiment that is made in Python may leave them out."""
    described(schema)
    del schema["properties"]["logs"]["default"]
    schema["required"].insert(1, "logs")


class Experiment(Frozen):
    """An experiment file.

    `logs`: paths or URLs, or mappings with settings for one log. `window_s`: the part of each log that is read,
    [from, to] in log time since the first message of its truth.

    >>> experiment = cr.Experiment(version=1, runs=20, configurations={"GT": cr.Configuration(units="truth")})
    >>> experiment.model_copy(update={"runs": 50}).runs, experiment.seed
    (50, 0)
    """

    model_config = ConfigDict(json_schema_extra=_as_file)

    version: Annotated[Literal[1], BeforeValidator(_version)]
    logs: Annotated[tuple[LogEntry, ...], Field(min_length=1)] = ()
    read: HowRead = Read()
    ego: Ego | None = None
    window_s: WindowOf | None = None
    max_gap_s: Positive = 0.5
    runs: Count = 1
    seed: Annotated[int, Field(strict=True), AfterValidator(_of_64_bits)] = 0
    pems: dict[Id, Pem] = Field(default_factory=dict)
    units: dict[UnitName, Unit] = Field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] = ()
    visibility: Visibility = Field(default=Surface(), json_schema_extra={"default": "surface"})
    links: dict[LinkName, AnyLink] = Field(default_factory=dict, exclude_if=lambda links: not links)
    configurations: Annotated[dict[ConfigurationName, Configuration], Field(min_length=1)]
    measure: Measure = Measure()
    braking: Braking | None = None
    sweep: Sweep | None = None
    show: Show | None = Show()

    @field_validator("configurations", mode="after")
    @classmethod
    def _ideals(cls, configurations: dict[str, Configuration]) -> dict[str, Configuration]:
        return _with_ideals(configurations)

    @property
    def modelled(self) -> dict[str, Unit]:
        """The units that have a PEM."""
        return {name: unit for name, unit in self.units.items() if unit.recorded is None}

    @property
    def recorded(self) -> dict[str, Recorded]:
        """The units whose lists are recorded in the log."""
        return {name: unit.recorded for name, unit in self.units.items() if unit.recorded is not None}

    @property
    def outputs(self) -> dict[str, RecordedOutput]:
        """The recorded outputs of stacks, by configuration."""
        return {name: one.recorded for name, one in self.configurations.items() if one.recorded is not None}

    def units_of(self, configuration: Configuration) -> tuple[str, ...]:
        """Names of the units of a configuration, in the experiment's order; none for the truth and a stack's output."""
        if configuration.units == "truth":
            return ()
        if configuration.units == "all":
            return tuple(self.modelled)
        return tuple(name for name in self.units if name in configuration.units)

    def links_of(self, name: str) -> list[UnitLinks]:
        """The links of a configuration: those that its units send by, and last what `latency_s` adds."""
        configuration = self.configurations[name]
        units = self.units_of(configuration) or (TRUTH,)
        by_link: dict[str, list[str]] = {}
        found: dict[str, LinkModel] = {}
        for unit in units:
            link = configuration.link_of(unit)
            if link is not None:
                where = f"links.{link}" if isinstance(link, str) else f"configurations.{name}.link"
                found[where] = self.links[link] if isinstance(link, str) else link
                by_link.setdefault(where, []).append(unit)
        every = len(by_link) == 1 and len(*by_link.values()) == len(units)
        added = UnitLinks(f"configurations.{name}.latency_s", ConstantLink(latency_s=configuration.latency_s))
        return [UnitLinks(w, link, None if every else frozenset(by_link[w])) for w, link in found.items()] + [added]

    def has_way(self, name: str) -> bool:
        """Whether lists of a configuration come by a link, or of a unit with `ready` or `sends`."""
        configuration = self.configurations[name]
        units = self.units_of(configuration)
        if any(self.units[unit].ready is not None or self.units[unit].sends is not None for unit in units):
            return True
        return any(configuration.link_of(unit) is not None for unit in units or (TRUTH,))

    def delay_of(self, name: str, unit: str) -> float | None:
        """Seconds from capture to arrival of the lists of a unit in a configuration; None: they differ."""
        one = self.units.get(unit)
        ready_s = one.ready.fixed_s if one is not None and one.ready is not None else 0.0
        links = [of.link.fixed_s(unit) for of in self.links_of(name) if of.units is None or unit in of.units]
        parts = [part for part in (ready_s, *links) if part is not None]
        return sum(parts) if len(parts) == len(links) + 1 else None

    def shown(self) -> dict[str, Configuration]:
        """The configurations that are written to MCAP and .rrd."""
        wanted = self.show.configurations if self.show is not None else None
        return {name: c for name, c in self.configurations.items() if wanted is None or name in wanted}

    def as_written(self) -> dict[str, Any]:
        """The experiment with every default filled in, as plain data for YAML."""
        return self.model_dump(mode="json", by_alias=True)
