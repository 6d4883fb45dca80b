"""The experiment: what is replayed through what, and what is measured. Frozen models, defaults that run.

Units are in the names of keys. Cross-references (a unit's `pem`, a configuration's `units`)
are checked in `experiment/validate.py`, which reports all problems of a file at once.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    field_validator,
    model_serializer,
    model_validator,
)

from copem_replay.communication.link import ConstantLink, LinkModel
from copem_replay.core.components import Count, Frozen, Id, Positive, Share, Slot, at_key, described
from copem_replay.fusion import FUSIONS
from copem_replay.fusion.base import Fusion, Ideal
from copem_replay.io.config import Ego, HowRead, Latency, Read, Recorded, WindowOf
from copem_replay.metrics.config import Braking, Measure
from copem_replay.perception.config import Carriers, Obstacle, Placement, Rate
from copem_replay.perception.pem.ghosts import MeanNumber
from copem_replay.perception.pem.model import Pem
from copem_replay.perception.visibility import Surface, Visibility


def _unit_name(value: str) -> str:
    if value in ("default", "truth", "all", ""):
        raise ValueError(f"{value!r} cannot be a unit's name")
    return value


def _of_64_bits(value: int) -> int:
    if not -(2**63) <= value < 2**64:
        raise ValueError(f"expected a whole number of 64 bits (-2^63 … 2^64 - 1), found {value}")
    return value


def _version(value: object) -> object:
    if isinstance(value, bool):  # equals 1 to Python
        raise ValueError(f"expected 1, found {str(value).lower()}")
    return value


def _configuration_name(value: str) -> str:
    # The name is part of topics and of entity paths.
    if not value or "/" in value or not value.isprintable():
        raise ValueError(f"expected a printable name without '/', found {value!r}")
    return value


UnitName = Annotated[Id, AfterValidator(_unit_name)]
ConfigurationName = Annotated[Id, AfterValidator(_configuration_name)]


_NOT_RECORDED = {
    "placed": "is where its lists say",
    "clock": "captures when its lists say",
    "outages": "makes the lists that are recorded",
}


class Unit(Placement):
    """A perception unit: its place, and the PEM its lists come from, or the topic they are `recorded` on.

    One whose lists are recorded has no PEM, and needs a place only where distances are measured from it.

    >>> cr.Unit(at=(12.0, -4.5), yaw_deg=90.0, height_m=5.0, pem="camera").rate_hz is None
    True
    """

    recorded: Recorded | None = None

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
    """What is compared: which units, which fusion, which latency, by unit or not, or which `link` of the user's own.

    >>> late = cr.Configuration(units="all", latency_s={"ego": 0.0, "default": 0.15}, fusion={"kind": "gnn"})
    >>> late.latency_of("mast"), late.fusion.kind
    (0.15, 'gnn')
    """

    units: Literal["truth", "all"] | Annotated[tuple[Id, ...], Field(min_length=1)]
    fusion: Annotated[Fusion, Slot("fusion", FUSIONS, "ideal")] = Ideal()
    latency_s: Latency | dict[Id, Latency] = 0.0
    link: Annotated[LinkModel, Slot("link", {})] | None = Field(default=None, exclude_if=lambda link: link is None)
    max_age_s: Positive = 1.0

    @model_validator(mode="after")
    def _one_link(self) -> Self:
        if self.link is not None and self.latency_s:
            raise ValueError("link: expected either `latency_s` or `link`, found both")
        return self

    @property
    def link_model(self) -> LinkModel:
        """The link to the receiver: the declared one, else that of `latency_s`."""
        return ConstantLink(latency_s=self.latency_s) if self.link is None else self.link

    def latency_of(self, unit: str) -> float | None:
        """Seconds from capture to arrival of every list of a unit; None: they differ from list to list."""
        return self.link_model.fixed_s(unit)


def _how_many(value: object) -> object:
    if isinstance(value, str | list | tuple):
        raise ValueError(f"expected how many units beside the ego's, such as 2 (a count, no names), found {value!r}")
    return value


Units = Annotated[int, Field(strict=True, ge=0, le=10**6), BeforeValidator(_how_many)]


def _once(values: tuple[float, ...]) -> tuple[float, ...]:
    for k, value in enumerate(values):
        if value in values[:k]:
            raise ValueError(f"expected each value once, found {value:g} twice")
    return values


def _none_or_lasting(value: float) -> float:
    if 0 < value < 0.001:
        raise ValueError(f"expected 0 or at least 0.001 (s), found {value:g}")
    return value


Lasting = Annotated[float, Field(strict=True, ge=0, le=86_400), AfterValidator(_none_or_lasting)]
"""A correlation time in seconds; 0: nothing lasts."""
SweptNames = Annotated[tuple[Id, ...], Field(min_length=1)]


class SweptBy(Frozen):
    """Which configurations each quantity changes, where not all change the same ones."""

    latency_s: SweptNames | None = None
    rate_hz: SweptNames | None = None
    units: SweptNames | None = None
    penetration_rate: SweptNames | None = None
    correlation_s: SweptNames | None = Field(default=None, exclude_if=lambda names: names is None)
    ghosts_in_list: SweptNames | None = Field(default=None, exclude_if=lambda names: names is None)


def _swept_by(value: object) -> str:
    return "by" if isinstance(value, dict | SweptBy) else "names"


Swept = Annotated[Annotated[SweptNames, Tag("names")] | Annotated[SweptBy, Tag("by")], Discriminator(_swept_by)]


class Sweep(Frozen):
    """Values of one quantity at a time at which `configurations` are run, too: names, or names by quantity.

    By default they are all that a quantity changes, of the latency those that state one above 0 or by unit.
    `latency_s`: of the whole list; where latencies are given by unit, the `default` one. `rate_hz`: of every unit.
    `units`: how many of a configuration's units beside the ego's, the first ones. `penetration_rate`:
    how many of those that may carry a unit do. `correlation_s`: of the first part of `memory.detection`; 0: new in
    every list. `ghosts_in_list`: how many of the first entry of `ghosts` there are in a list, on average.
    """

    configurations: Swept | None = None
    latency_s: Annotated[tuple[Latency, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    rate_hz: Annotated[tuple[Rate, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    units: Annotated[tuple[Units, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    penetration_rate: Annotated[tuple[Share, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    correlation_s: Annotated[tuple[Lasting, ...], Field(min_length=1), AfterValidator(_once)] | None = Field(
        default=None, exclude_if=lambda values: values is None
    )
    ghosts_in_list: Annotated[tuple[MeanNumber, ...], Field(min_length=1), AfterValidator(_once)] | None = Field(
        default=None, exclude_if=lambda values: values is None
    )

    @model_validator(mode="after")
    def _some(self) -> Self:
        names = list(SweptBy.model_fields)
        if not any(getattr(self, name) for name in names):
            known = f"{', '.join(names[:-1])} or {names[-1]}"
            raise ValueError(f"expected values of {known}, such as `latency_s: [0, 0.5, 1]`")
        for quantity in SweptBy.model_fields if isinstance(self.configurations, SweptBy) else ():
            if self.chosen(quantity) and not getattr(self, quantity):
                raise ValueError(f"configurations.{quantity}: expected values of {quantity} beside it, found none")
        return self

    def chosen(self, quantity: str) -> tuple[str, ...] | None:
        """The configurations that a quantity shall change; None: nothing is said of it."""
        if not isinstance(self.configurations, SweptBy):
            return self.configurations
        chosen: tuple[str, ...] | None = getattr(self.configurations, quantity)
        return chosen


MEASURED_PER_LOG = ("objects", "onset", "distance_to", "annotated")
"""Keys of `measure` that a log may have its own of; the others say what the tables of all logs have in common."""


class LogSettings(Frozen):
    """A recording, and what is otherwise for it: keys that are given replace those of the experiment, lists whole.

    `file`: as a plain entry, wildcards too. `name`: what the log is called, by default as its file. Of `units` and
    `measure` single keys are replaced; `null` in the place of a unit: the log lacks it.
    """

    file: Annotated[str, Field(min_length=1)]
    name: Annotated[Id, Field(min_length=1)] | None = None
    ego: Ego | None = None
    window_s: WindowOf | None = None
    units: dict[Id, dict[str, Any] | None] = Field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] | None = None
    read: HowRead | None = None
    measure: dict[str, Any] = Field(default_factory=dict)

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


def _what_log(value: object) -> str:
    return "settings" if isinstance(value, dict | LogSettings) else "path"


LogEntry = Annotated[Annotated[str, Tag("path")] | Annotated[LogSettings, Tag("settings")], Discriminator(_what_log)]
"""A path, with wildcards or not, or a mapping with settings."""


WhichRun = Annotated[int, Field(strict=True, ge=0)] | Literal["median", "worst", "best"]


def _each_once(runs: tuple[WhichRun, ...]) -> tuple[WhichRun, ...]:
    twice = [run for k, run in enumerate(runs) if run in runs[:k]]
    if twice:
        raise ValueError(f"expected each run once, found {twice[0]} twice")
    return runs


class Show(Frozen):
    """Which logs, run or runs, and configurations (by default all) are written to MCAP and .rrd.

    `run: null` writes none; `pipeline/selected_runs.py` says which run is `median`, `worst` or `best`.
    """

    logs: Annotated[tuple[Id, ...], Field(min_length=1)] = ("first",)
    run: WhichRun | Annotated[tuple[WhichRun, ...], Field(min_length=1), AfterValidator(_each_once)] | None = 0
    configurations: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None

    def asked(self) -> tuple[WhichRun, ...]:
        """The runs, one or several or none, in their order."""
        if isinstance(self.run, tuple):
            return self.run
        return () if self.run is None else (self.run,)


def _as_file(schema: dict[str, Any]) -> None:
    """A file has to name its logs; only an experiment that is made in Python may leave them out."""
    described(schema)
    del schema["properties"]["logs"]["default"]
    schema["required"].insert(1, "logs")


class Experiment(Frozen):
    """An experiment file.

    `logs`: paths, or mappings with what is otherwise for a log. `window_s`: what of each log is read, [from, to] in
    seconds since the first message of its truth was logged.

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
    configurations: Annotated[dict[ConfigurationName, Configuration], Field(min_length=1)]
    measure: Measure = Measure()
    braking: Braking | None = None
    sweep: Sweep | None = None
    show: Show | None = Show()

    @property
    def modelled(self) -> dict[str, Unit]:
        """The units that have a PEM."""
        return {name: unit for name, unit in self.units.items() if unit.recorded is None}

    @property
    def recorded(self) -> dict[str, Recorded]:
        """The units whose lists are recorded in the log."""
        return {name: unit.recorded for name, unit in self.units.items() if unit.recorded is not None}

    def units_of(self, configuration: Configuration) -> tuple[str, ...]:
        """Names of the units of a configuration, in the experiment's order; none for the truth."""
        if configuration.units == "truth":
            return ()
        if configuration.units == "all":
            return tuple(self.modelled)
        return tuple(name for name in self.units if name in configuration.units)

    def shown(self) -> dict[str, Configuration]:
        """The configurations that are written to MCAP and .rrd."""
        wanted = self.show.configurations if self.show is not None else None
        return {name: c for name, c in self.configurations.items() if wanted is None or name in wanted}

    def as_written(self) -> dict[str, Any]:
        """The experiment with every default filled in, as plain data for YAML."""
        return self.model_dump(mode="json", by_alias=True)
