"""The schema of an experiment: logs, units, links, configurations, sweeps. Frozen models, defaults that run.

Units are in the names of keys. References (a unit's `pem`, a configuration's `units`) are checked in
`experiment/cross_references.py`, so that all problems of a file are reported at once.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    Tag,
    field_validator,
    model_serializer,
    model_validator,
)

from copem_replay.communication.latency import Delay
from copem_replay.communication.link import LINKS, ConstantLink, LinkModel, UnitLinks
from copem_replay.communication.sends import Sends
from copem_replay.core.components import (
    Count,
    Either,
    Flag,
    Frozen,
    Id,
    Latency,
    Number,
    Positive,
    Share,
    Slot,
    TagText,
    drop_python_examples,
    error_at_key,
)
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.criteria import Criterion, CriterionName
from copem_replay.experiment.frame import FrameOfLog
from copem_replay.experiment.maps import MapFile
from copem_replay.fusion import FUSIONS
from copem_replay.fusion.interface import Fusion, IdealFusion
from copem_replay.io.config import Ego, HowRead, RecordedOutput, RecordedTopic, TruthTopic, WindowOf
from copem_replay.metrics.config import AREA, Braking, Measure, Needless, OwnArea, parse_slices
from copem_replay.perception.config import Carriers, Obstacle, Placement, Rate
from copem_replay.perception.pem.condition import Condition
from copem_replay.perception.pem.model import MeanNumber, Pem
from copem_replay.perception.visibility import Surface, Visibility

# Links.


def _check_link_name(value: str) -> str:
    if value in ("none", "default", ""):
        raise ValueError(f"{value!r} cannot be a link's name")
    return value


def _discriminate_link(value: object) -> str:
    if isinstance(value, LinkModel) or (isinstance(value, dict) and "kind" in value):
        return "link"
    return "by unit" if isinstance(value, dict) else "name"


LinkName = Annotated[Id, AfterValidator(_check_link_name)]
AnyLink = Annotated[LinkModel, Slot("link", LINKS, "radio")]
LinkOf = Annotated[
    Annotated[AnyLink, Tag("link")] | Annotated[Id, Tag("name")] | Annotated[dict[Id, Id], Tag("by unit")],
    Discriminator(_discriminate_link),
]
"""A link: its name, names by unit with `default`, or the link itself."""
IssueRate = Annotated[float, Field(strict=True, ge=0.001, le=1000)]
"""Fused lists per second."""


# Names of units and configurations.


def _check_unit_name(value: str) -> str:
    if value in ("default", "truth", "all", ""):
        raise ValueError(f"{value!r} cannot be a unit's name")
    return value


def _check_configuration_name(value: str) -> str:
    # The name is part of topics and of entity paths.
    if not value or "/" in value or not value.isprintable():
        raise ValueError(f"expected a printable name without '/', found {value!r}")
    return value


UnitName = Annotated[Id, AfterValidator(_check_unit_name)]
ConfigurationName = Annotated[Id, AfterValidator(_check_configuration_name)]


# Runs that are shown.

WhichRun = Annotated[int, Field(strict=True, ge=0)] | Literal["median", "worst", "best"]


def _check_runs_unique(runs: tuple[WhichRun, ...]) -> tuple[WhichRun, ...]:
    twice = [run for k, run in enumerate(runs) if run in runs[:k]]
    if twice:
        raise ValueError(f"expected each run once, found {twice[0]} twice")
    return runs


class Show(Frozen):
    """Which logs, run or runs, and configurations (by default all) are written to MCAP and .rrd.

    `run: null` writes none; `pipeline/one_run.py` says which run is `median`, `worst` or `best`. `truth: false` leaves
    the drawn truth out of the MCAP, the topics `copem/truth/…`; the recorded one is always in it. `units: false` leaves
    out the lists of the units, the topics `copem/units/…`. `map: true` adds a view on a map of the world to the .rrd,
    for which the viewer asks a foreign host for tiles: it learns where the drive was. `with_recording: true` adds
    images and points of the recording, as large as they are.
    """

    logs: Annotated[tuple[Id, ...], Field(min_length=1)] = ("first",)
    run: WhichRun | Annotated[tuple[WhichRun, ...], Field(min_length=1), AfterValidator(_check_runs_unique)] | None = 0
    configurations: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None
    truth: Flag = True
    units: Flag = True
    map: Annotated[Flag, Field(exclude_if=operator.not_)] = False
    with_recording: Annotated[Flag, Field(exclude_if=operator.not_)] = False

    def asked(self) -> tuple[WhichRun, ...]:
        """The runs in their order: several, one or none."""
        if isinstance(self.run, tuple):
            return self.run
        return () if self.run is None else (self.run,)


# Sweeps: values of one quantity at a time.


def _check_is_count(value: object) -> object:
    if isinstance(value, str | list | tuple):
        raise ValueError(f"expected how many units beside the ego's, such as 2 (a count, no names), found {value!r}")
    return value


Units = Annotated[int, Field(strict=True, ge=0, le=10**6), BeforeValidator(_check_is_count)]


def _check_unique(values: tuple[float, ...]) -> tuple[float, ...]:
    for k, value in enumerate(values):
        if value in values[:k]:
            raise ValueError(f"expected each value once, found {value:g} twice")
    return values


def _check_correlation_time(value: float) -> float:
    if 0 < value < 0.001:
        raise ValueError(f"expected 0 or at least 0.001 (s), found {value:g}")
    return value


Lasting = Annotated[float, Field(strict=True, ge=0, le=86_400), AfterValidator(_check_correlation_time)]
"""A correlation time in seconds; 0: nothing lasts."""
_UNSAID: Any = Field(default=None, exclude_if=lambda value: value is None)
SweptNames = Annotated[tuple[Id, ...], Field(min_length=1)]


class SweptBy(Frozen):
    """Which configurations each quantity changes, if these differ between quantities."""

    latency_s: SweptNames | None = None
    rate_hz: SweptNames | None = None
    units: SweptNames | None = None
    penetration_rate: SweptNames | None = None
    correlation_s: SweptNames | None = _UNSAID
    ghosts_in_list: SweptNames | None = _UNSAID
    loss: SweptNames | None = _UNSAID
    burst_s: SweptNames | None = _UNSAID


Swept = Either[SweptNames, SweptBy]


class Sweep(Frozen):
    """Further values at which `configurations` (names, or names by quantity) are run, one quantity at a time.

    By default a quantity changes all configurations that have it; `latency_s` those with a latency above 0 or by unit.
    `latency_s`: of the whole list; if latencies are by unit, the `default` one. `rate_hz`: of every unit. `units`:
    number of a configuration's units beside the ego's, taken in order. `penetration_rate`: share of possible carriers
    with a unit. `correlation_s`: of the first part of `memory.detection`; 0: new in every list. `ghosts_in_list`: mean
    number of ghosts of the first entry of `ghosts` in a list. `loss`: share of lists that links lose. `burst_s`: how
    long losses last: `bad_lasts_s`, else the first part of `memory.reception`.
    """

    configurations: Swept | None = None
    latency_s: Annotated[tuple[Latency, ...], Field(min_length=1), AfterValidator(_check_unique)] | None = None
    rate_hz: Annotated[tuple[Rate, ...], Field(min_length=1), AfterValidator(_check_unique)] | None = None
    units: Annotated[tuple[Units, ...], Field(min_length=1), AfterValidator(_check_unique)] | None = None
    penetration_rate: Annotated[tuple[Share, ...], Field(min_length=1), AfterValidator(_check_unique)] | None = None
    correlation_s: Annotated[tuple[Lasting, ...], Field(min_length=1), AfterValidator(_check_unique)] | None = _UNSAID
    ghosts_in_list: Annotated[tuple[MeanNumber, ...], Field(min_length=1), AfterValidator(_check_unique)] | None = (
        _UNSAID
    )
    loss: Annotated[tuple[Share, ...], Field(min_length=1), AfterValidator(_check_unique)] | None = _UNSAID
    burst_s: Annotated[tuple[Lasting, ...], Field(min_length=1), AfterValidator(_check_unique)] | None = _UNSAID

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
        """The configurations that a quantity changes; None: the default."""
        if not isinstance(self.configurations, SweptBy):
            return self.configurations
        chosen: tuple[str, ...] | None = getattr(self.configurations, quantity)
        return chosen


def _check_64_bits(value: int) -> int:
    if not -(2**63) <= value < 2**64:
        raise ValueError(f"expected a whole number of 64 bits (-2^63 … 2^64 - 1), found {value}")
    return value


def _check_version(value: object) -> object:
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
"""Keys that a recorded unit does not take, and why."""
_OF_A_SENSOR = ("on", "at", "at_wgs84", "offset_m", "yaw_deg", "height_m", "ground_z_m", "phase_s")
"""Keys that a unit that fuses does not take: its members have them."""


class Unit(Placement):
    """A perception unit: its place, and the PEM or the `recorded` topic of its lists, or the units that it `fuses`.

    A recorded unit has no PEM, and needs a place only where distances are measured from it, or for `views`: where its
    sensors look, so that what hides an object from it is known. `ready`: processing time from capture until a list can
    be sent; `sends`: which lists and objects it sends. A unit that fuses lists what its `fusion` makes of its members'
    lists, whenever one comes, or at `rate_hz`; `max_age_s`: how old a list it uses.

    >>> cr.Unit(at=(12.0, -4.5), yaw_deg=90.0, height_m=5.0, pem="camera").rate_hz is None
    True
    """

    recorded: RecordedTopic | None = None
    views: Annotated[tuple[Condition, ...], Field(min_length=1)] | None = _UNSAID
    fuses: Annotated[tuple[Id, ...], Field(min_length=1)] | None = _UNSAID
    fusion: Annotated[Fusion, Slot("fusion", FUSIONS, "ideal")] | None = _UNSAID
    max_age_s: Positive | None = _UNSAID
    ready: Delay | None = Field(default=None, exclude_if=lambda ready: ready is None)
    sends: Sends | None = Field(default=None, exclude_if=lambda sends: sends is None)

    @model_validator(mode="after")
    def _place(self) -> Self:
        """Check, once keys are parsed, that a unit has one source of lists and one place. Raises ValueError."""
        if sum(what is not None for what in (self.pem, self.recorded, self.fuses)) != 1:
            raise ValueError("expected one of `pem: <name>`, `recorded: {topic: …}` and `fuses: [<unit>, …]`")
        places = (self.on, self.at, self.at_wgs84)
        self._check_fusing()
        if self.views is not None:
            self._check_views()
        if self.at_wgs84 is not None and len(self.at_wgs84) == 3 and "yaw_deg" in self.model_fields_set:
            raise error_at_key("yaw_deg", "the heading is the third number of at_wgs84; expected one of both")
        if self.recorded is not None:
            for key, why in _NOT_RECORDED.items():
                if getattr(self, key) is not None:
                    raise error_at_key(key, f"a recorded unit {why}; only for units with a pem")
            if self.rate_hz is not None or isinstance(self.on, Carriers) or sum(map(bool, places)) > 1:
                raise ValueError("recorded: goes with one place, `on` an object or `at` a point, and without rate_hz")
        if self.pem is None:
            return self
        if sum(place is not None for place in places) != 1:
            raise ValueError(
                "expected one of `on: ego`, `on: <object id>`, `on: {classes, penetration_rate}`, `at: [x, y]` and "
                "`at_wgs84: [latitude, longitude]`"
            )
        if self.height_m is None and self.on is None:
            raise ValueError("height_m: needed for a unit `at` a place; only a carried one is on a roof by default")
        if self.ground_z_m is not None and self.on is not None:
            raise ValueError("ground_z_m: only for a unit `at` a place; a carrier brings its own ground")
        if self.phase_s and self.rate_hz is None:
            raise ValueError("phase_s: needs rate_hz (without it there is one list per frame of the truth)")
        return self

    def _check_views(self) -> None:
        """Raises ValueError for `views` of a unit that is not recorded, or has no place to look from."""
        if self.recorded is None:
            raise error_at_key("views", "only for a recorded unit; a PEM says by its conditions where its unit looks")
        if self.on is None and (self.height_m is None or not (self.at or self.at_wgs84)):
            raise error_at_key("views", "where from? expected `on: <object>`, or `at: [x, y]` with `height_m`")

    def _check_fusing(self) -> None:
        """Raises ValueError for keys of a unit that fuses where none does, and for those that it does not take."""
        for key in () if self.fuses is not None else ("fusion", "max_age_s"):
            if getattr(self, key) is not None:
                raise error_at_key(key, "only for a unit that `fuses` others")
        for key in _OF_A_SENSOR if self.fuses is not None else ():
            if getattr(self, key) != Unit.model_fields[key].default:
                raise error_at_key(key, "a unit that fuses is where its first member is, and lists when lists come")
        if isinstance(self.fusion, IdealFusion) and self.fusion.combine == "posterior":
            raise error_at_key("fusion", "posterior draws anew for each receiver; a unit that fuses has `samples`")

    def as_configuration(self) -> Configuration:
        """A unit that fuses, as a configuration of its members."""
        return Configuration(
            units=self.fuses or (), fusion=self.fusion or IdealFusion(), issue_hz=self.rate_hz,
            max_age_s=self.max_age_s or 1.0,
        )  # fmt: skip


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
    fusion: Annotated[Fusion, Slot("fusion", FUSIONS, "ideal")] = IdealFusion()
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
        """A recorded output with its own keys only, any other configuration without them."""
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
"""Keys of `measure` that a log may set; the others define what the tables of all logs have in common."""


class LogSettings(Frozen):
    """A recording and its settings: keys given here replace those of the experiment, lists as a whole.

    `file`: a path, wildcards allowed. `name`: name of the log, by default that of its file. In `units` and `measure`
    single keys are replaced; a unit that is `null` is absent from the log. `together`, instead of `file`: several
    recordings of one drive; `clock_offset_s`: how far the clock of each is ahead of the first one's. `tags`: what the
    drive is to be found by, in addition to those in the recording: `{weather: rain, site: A}`.
    """

    file: Annotated[str, Field(min_length=1)] | None = None
    together: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=2)] | None = None
    clock_offset_s: dict[str, Number] = Field(default_factory=dict)
    name: Annotated[Id, Field(min_length=1)] | None = None
    ego: Ego | None = None
    window_s: WindowOf | None = None
    units: dict[Id, dict[str, Any] | None] = Field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] | None = None
    maps: tuple[MapFile, ...] | None = Field(default=None, exclude_if=lambda maps: maps is None)
    frame: FrameOfLog | None = Field(default=None, exclude_if=lambda frame: frame is None)
    read: HowRead | None = None
    measure: dict[str, Any] = Field(default_factory=dict)
    tags: dict[Id, TagText] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        """Check, once keys are parsed, that an entry names its recordings once. Raises ValueError."""
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
        """Only the keys that are given, as a `null` would also count as given."""
        written: dict[str, Any] = write(self)
        return {key: value for key, value in written.items() if key in self.model_fields_set}


def output_unit(configuration: str) -> str:
    """The name of the unit that stands for the recorded output of a configuration."""
    return f"{configuration} (recorded)"


def _is_ideal_of(configuration: Configuration, inputs: Sequence[str]) -> bool:
    """Whether a configuration is ideal fusion of exactly these units, without latency or link."""
    return (
        configuration.recorded is None
        and not isinstance(configuration.units, str)
        and set(configuration.units) == set(inputs)
        and configuration.fusion == IdealFusion()
        and configuration.link is None
        and not configuration.latency_s
        and configuration.issue_hz is None
    )


def _add_ideals(configurations: dict[str, Configuration]) -> dict[str, Configuration]:
    """The configurations, with ideal fusion of the inputs of each recorded output, `<name>:ideal`, where it lacks."""
    result = dict(configurations)
    for name, configuration in configurations.items():
        inputs = configuration.inputs
        if inputs is None or any(_is_ideal_of(one, inputs) for one in result.values()):
            continue
        if f"{name}:ideal" in result:
            raise ValueError(f"{name}:ideal: expected ideal fusion of the inputs of {name}, found another; rename it")
        result[f"{name}:ideal"] = Configuration(units=inputs)
    return result


LogEntry = Either[str, LogSettings]
"""A path, with wildcards or not, or a mapping with settings."""


def _require_logs(schema: dict[str, Any]) -> None:
    """Require `logs` in the JSON schema: only an experiment that is made in Python may leave them out."""
    drop_python_examples(schema)
    del schema["properties"]["logs"]["default"]
    schema["required"].insert(1, "logs")


class Experiment(Frozen):
    """An experiment file.

    `logs`: paths or URLs, or mappings with settings for one log. `window_s`: the part of each log that is read,
    [from, to] in log time since the first message of its truth. `tags`: those of all logs, to slice the summary by
    (`measure.by`) and for conditions of PEMs; a log may have others. `frame`: where the logs are on earth. `maps` of
    the site: lanes, areas, solids. `areas`: your own, by name, for `measure.objects.within.areas` and ghosts.

    >>> experiment = cr.Experiment(version=1, runs=20, configurations={"GT": cr.Configuration(units="truth")})
    >>> experiment.model_copy(update={"runs": 50}).runs, experiment.seed
    (50, 0)
    """

    model_config = ConfigDict(json_schema_extra=_require_logs)

    version: Annotated[Literal[1], BeforeValidator(_check_version)]
    logs: Annotated[tuple[LogEntry, ...], Field(min_length=1)] = ()
    read: HowRead = TruthTopic()
    ego: Ego | None = None
    tags: dict[Id, TagText] = Field(default_factory=dict, exclude_if=lambda tags: not tags)
    window_s: WindowOf | None = None
    max_gap_s: Positive = 0.5
    runs: Count = 1
    seed: Annotated[int, Field(strict=True), AfterValidator(_check_64_bits)] = 0
    pems: dict[Id, Pem] = Field(default_factory=dict)
    units: dict[UnitName, Unit] = Field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] = ()
    frame: FrameOfLog | None = Field(default=None, exclude_if=lambda frame: frame is None)
    maps: tuple[MapFile, ...] = Field(default=(), exclude_if=lambda maps: not maps)
    areas: dict[Id, OwnArea] = Field(default_factory=dict, exclude_if=lambda areas: not areas)
    visibility: Visibility = Field(default=Surface(), json_schema_extra={"default": "surface"})
    links: dict[LinkName, AnyLink] = Field(default_factory=dict, exclude_if=lambda links: not links)
    configurations: Annotated[dict[ConfigurationName, Configuration], Field(min_length=1)]
    measure: Measure = Measure()
    braking: Braking | None = None
    sweep: Sweep | None = None
    show: Show | None = Show()
    criteria: dict[CriterionName, Criterion] = Field(default_factory=dict, exclude_if=lambda criteria: not criteria)
    _has_areas: bool = PrivateAttr(False)  # stays that of all logs in a copy for one

    @model_validator(mode="after")
    def _find_areas(self) -> Self:
        of_logs = any(isinstance(entry, LogSettings) and entry.maps for entry in self.logs)
        by_area = any(by.names(AREA) for by in parse_slices(self.measure.by))  # of recordings that have areas, too
        self._has_areas = bool(self.areas or self.maps or of_logs or by_area)
        return self

    @field_validator("configurations", mode="after")
    @classmethod
    def _ideals(cls, configurations: dict[str, Configuration]) -> dict[str, Configuration]:
        return _add_ideals(configurations)

    @property
    def needless(self) -> Needless | None:
        """When braking is for nothing; None: not measured, as without a driver, or without accuracy."""
        return self.braking.needless if self.braking is not None and self.measure.accuracy else None

    @property
    def modelled(self) -> dict[str, Unit]:
        """The units that have a PEM."""
        return {name: unit for name, unit in self.units.items() if unit.pem is not None}

    @property
    def fusing(self) -> dict[str, Unit]:
        """The units that fuse the lists of others."""
        return {name: unit for name, unit in self.units.items() if unit.fuses is not None}

    def list_sensing(self, names: Iterable[str]) -> tuple[str, ...]:
        """The units, and in place of those that fuse their members."""
        return tuple(
            one for name in names for one in (self.units[name].fuses or (name,) if name in self.units else (name,))
        )

    @property
    def recorded(self) -> dict[str, RecordedTopic]:
        """The units whose lists are recorded in the log."""
        return {name: unit.recorded for name, unit in self.units.items() if unit.recorded is not None}

    @property
    def outputs(self) -> dict[str, RecordedOutput]:
        """The recorded outputs of stacks, by configuration."""
        return {name: one.recorded for name, one in self.configurations.items() if one.recorded is not None}

    def units_of(self, configuration: Configuration) -> tuple[str, ...]:
        """Names of the units of a configuration, in the experiment's order; none for the truth and recorded outputs."""
        if configuration.units == "truth":
            return ()
        if configuration.units == "all":
            members = {one for unit in self.fusing.values() for one in unit.fuses or ()}
            return tuple(name for name, unit in self.units.items() if unit.recorded is None and name not in members)
        return tuple(name for name in self.units if name in configuration.units)

    def links_of(self, name: str) -> list[UnitLinks]:
        """The links of a configuration: those that its units send by, and last the one that adds `latency_s`."""
        configuration = self.configurations[name]
        units = self.units_of(configuration) or (TRUTH,)
        by_link: dict[str, list[str]] = {}
        links: dict[str, LinkModel] = {}
        for unit in units:
            link = configuration.link_of(unit)
            if link is not None:
                where = f"links.{link}" if isinstance(link, str) else f"configurations.{name}.link"
                links[where] = self.links[link] if isinstance(link, str) else link
                by_link.setdefault(where, []).append(unit)
        every = len(by_link) == 1 and len(*by_link.values()) == len(units)
        added = UnitLinks(f"configurations.{name}.latency_s", ConstantLink(latency_s=configuration.latency_s))
        senders = {where: None if every else frozenset(by_link[where]) for where in links}
        return [*(UnitLinks(where, link, senders[where]) for where, link in links.items()), added]

    @property
    def has_areas(self) -> bool:
        """Whether the study has areas, its own or of maps, in any of its logs."""
        return self._has_areas or bool(self.areas or self.maps)

    def has_way(self, name: str) -> bool:
        """Whether lists of a configuration come by a link, with `issue_hz`, or of a unit with `ready` or `sends`."""
        configuration = self.configurations[name]
        units = self.units_of(configuration)
        if configuration.issue_hz or any(self.units[unit].ready or self.units[unit].sends for unit in units):
            return True
        return any(configuration.link_of(unit) is not None for unit in units or (TRUTH,))

    def delay_of(self, name: str, unit: str) -> float | None:
        """Seconds from capture to arrival of the lists of a unit in a configuration; None: they differ."""
        sender = self.units.get(unit)
        ready_s = sender.ready.fixed_s if sender is not None and sender.ready is not None else 0.0
        links = [of.link.fixed_s(unit) for of in self.links_of(name) if of.units is None or unit in of.units]
        parts = [part for part in (ready_s, *links) if part is not None]
        return sum(parts) if len(parts) == len(links) + 1 else None

    def shown(self) -> dict[str, Configuration]:
        """The configurations that are written to MCAP and .rrd."""
        names = self.show.configurations if self.show is not None else None
        return {name: c for name, c in self.configurations.items() if names is None or name in names}

    def as_written(self) -> dict[str, Any]:
        """The experiment with every default filled in, as plain data for YAML."""
        return self.model_dump(mode="json", by_alias=True)
