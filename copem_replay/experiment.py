"""The experiment: what is replayed through what, and what is measured. Frozen models, defaults that run.

Key names are the contract's; units are in the names. Cross-references (a unit's `pem`, a configuration's `units`)
are checked in `check.py`, which reports all problems of a file at once.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag, WithJsonSchema, model_validator

from copem_replay.braking.driver import DRIVERS, Driver
from copem_replay.components import Count, Flag, Frozen, NotNegative, Number, Positive, Share, Slot
from copem_replay.pem.condition import ClassNames, Pem


def _identifier(value: object) -> object:
    """Ids may be numbers or text: `1` is `"1"`."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _unit_name(value: str) -> str:
    if value in ("default", "truth", "all", ""):
        raise ValueError(f"{value!r} cannot be a unit's name")
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


Id = Annotated[str, BeforeValidator(_identifier), WithJsonSchema({"type": ["string", "integer"]})]
UnitName = Annotated[Id, AfterValidator(_unit_name)]
ConfigurationName = Annotated[Id, AfterValidator(_configuration_name)]
Point = tuple[Number, Number]
Latency = Annotated[float, Field(strict=True, ge=0, le=86_400)]
"""Seconds, a day at most (chosen: more is a mistake, and a stamp in nanoseconds has an end)."""


Rate = Annotated[float, Field(strict=True, ge=0.001, le=1000)]
"""Lists per second."""


class Carriers(Frozen):
    """Objects that carry a unit each, or not: every one of these classes but the ego, with probability `share`."""

    classes: ClassNames
    share: Share


def _what_carries(value: object) -> str:
    return "carriers" if isinstance(value, dict | Carriers) else "id"


On = Annotated[Annotated[Id, Tag("id")] | Annotated[Carriers, Tag("carriers")], Discriminator(_what_carries)]


class Unit(Frozen):
    """A perception unit: carried `on` the ego, another object or a share of some classes, or standing `at` a place.

    `height_m` above the ground; left out, a carried unit is on the roof.
    """

    on: On | None = None
    at: Point | None = None
    offset_m: Point = (0.0, 0.0)
    yaw_deg: Number = 0.0
    height_m: NotNegative | None = None
    ground_z_m: Number | None = None
    pem: Id
    rate_hz: Rate | None = None
    phase_s: NotNegative = 0.0

    @model_validator(mode="after")
    def _place(self) -> Self:
        if (self.on is None) == (self.at is None):
            raise ValueError("expected one of `on: ego`, `on: <object id>`, `on: {classes, share}` and `at: [x, y]`")
        if self.height_m is None and self.at is not None:
            raise ValueError("height_m: needed for a unit `at` a place; only a carried one is on a roof by default")
        if self.ground_z_m is not None and self.at is None:
            raise ValueError("ground_z_m: only for a unit `at` a place; a carrier brings its own ground")
        if self.phase_s and self.rate_hz is None:
            raise ValueError("phase_s: needs rate_hz (without it there is one list per frame of the truth)")
        return self


class Obstacle(Frozen):
    """A static obstacle beside those in the log."""

    polygon_m: Annotated[tuple[Point, ...], Field(min_length=3)]
    height_m: Positive
    ground_z_m: Number | None = None

    @model_validator(mode="after")
    def _simple(self) -> Self:
        import shapely

        polygon = shapely.Polygon(self.polygon_m)
        if not polygon.is_valid or polygon.area <= 0:
            raise ValueError(f"polygon_m: expected a simple polygon, found {shapely.is_valid_reason(polygon)}")
        return self


class Ideal(Frozen):
    """The paper's Ideal Fusion Model: matching by truth id, inverse-variance combination.

    `combine: samples` weighs the units' sampled errors (draws stay common with other configurations),
    `combine: posterior` draws once from N(μ, Σ); both have the same law.
    """

    kind: Literal["ideal"] = "ideal"
    combine: Literal["samples", "posterior"] = "samples"


class Configuration(Frozen):
    """What is compared: which units, which fusion, which latency."""

    units: Literal["truth", "all"] | Annotated[tuple[Id, ...], Field(min_length=1)]
    fusion: Ideal = Ideal()
    latency_s: Latency | dict[Id, Latency] = 0.0
    max_age_s: Positive = 1.0

    def latency_of(self, unit: str) -> float:
        """Seconds from capture to arrival of a unit's lists."""
        if isinstance(self.latency_s, dict):
            return self.latency_s.get(unit, self.latency_s.get("default", 0.0))
        return self.latency_s


class Objects(Frozen):
    """Which objects are measured. Neither key: all moving objects but the ego."""

    classes: ClassNames | None = None
    ids: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.classes is not None and self.ids is not None:
            raise ValueError("expected either classes or ids, found both")
        return self


class StartsMoving(Frozen):
    """The object moves, within a distance of the ego's centre, or ahead of its front along its heading."""

    kind: Literal["starts_moving"]
    speed_mps: Positive = 0.3
    within_m: Positive | None = None
    from_: Annotated[Literal["centre", "front"], Field(alias="from")] = "centre"


class Appears(Frozen):
    """The object is in the log."""

    kind: Literal["appears"]


class InRange(Frozen):
    """The distance to the ego is within the range."""

    kind: Literal["in_range"] = "in_range"
    range_m: Positive = 50.0


class LineOfSight(Frozen):
    """The ego's units see at least this share of it (`line_of_sight`), or any unit does (`line_of_sight_any`)."""

    kind: Literal["line_of_sight", "line_of_sight_any"]
    visible_share: Annotated[Share, Field(gt=0)] = 0.1


class At(Frozen):
    """An instant of the log."""

    kind: Literal["at"]
    time_s: NotNegative


Onset = Annotated[StartsMoving | Appears | InRange | LineOfSight | At, Field(discriminator="kind")]


LONGEST_CHAIN = 12
"""More capture instants than this have no exact times (chosen: the chain has 2¹¹ states)."""

Captures = Annotated[int, Field(strict=True, ge=1, le=1000)]


class Confirm(Frozen):
    """Detected when `hits` of the last `of` capture instants hold the object."""

    hits: Captures = 1
    of: Captures = 1

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.hits > self.of:
            raise ValueError(f"expected hits ≤ of, found {self.hits} of {self.of}")
        return self


Margin = Annotated[float, Field(strict=True, ge=0, le=100)]
"""Metres, a hundred at most (chosen: more is a mistake)."""


class Conflict(Frozen):
    """When a perceived state implies a collision: its predicted way meets the ego's corridor within the horizon.

    The corridor is what the ego, at its present speed, will sweep of its own path, and `margin_m` around it; the object
    is taken to keep its perceived velocity.
    """

    horizon_s: Positive = 3.0
    margin_m: Margin = 0.5


class Measure(Frozen):
    """What is measured, and from when."""

    objects: Objects = Objects()
    onset: Onset = InRange()
    count_earlier: Flag = False
    confirm: Confirm = Confirm()
    distance_to: Id = "ego"
    horizon_s: Positive | None = None
    conflict: Conflict | None = None
    exact: Flag = False


class Braking(Frozen):
    """What the ego's declared driver does when an object is known (`brakes_for: object`) or seen to be in its way.

    `ego`: until it brakes, the ego drives as recorded, or with constant speed from the onset (whoever was recorded may
    have braked already).
    """

    driver: Annotated[Driver, Slot("driver", DRIVERS)]
    margin_m: Margin = 0.5
    ego: Literal["recorded", "constant_speed"] = "recorded"
    brakes_for: Literal["object", "conflict"] = "object"


Units = Annotated[int, Field(strict=True, ge=0, le=10**6)]


def _once(values: tuple[float, ...]) -> tuple[float, ...]:
    for k, value in enumerate(values):
        if value in values[:k]:
            raise ValueError(f"expected each value once, found {value:g} twice")
    return values


class Sweep(Frozen):
    """Values of one quantity at a time at which the configurations (by default all that it changes) are run, too.

    `latency_s`: of the whole list; where latencies are given by unit, the `default` one. `rate_hz`: of every unit.
    `units`: how many of a configuration's units beside the ego's, the first ones. `share`: of those who carry a unit.
    """

    configurations: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None
    latency_s: Annotated[tuple[Latency, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    rate_hz: Annotated[tuple[Rate, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    units: Annotated[tuple[Units, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    share: Annotated[tuple[Share, ...], Field(min_length=1), AfterValidator(_once)] | None = None

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not (self.latency_s or self.rate_hz or self.units or self.share):
            raise ValueError("expected values of latency_s, rate_hz, units or share, such as `latency_s: [0, 0.5, 1]`")
        return self


class Read(Frozen):
    """How the truth is found in a recording that holds several object lists."""

    topic: str | None = None


class Show(Frozen):
    """Which logs and which run are written to MCAP and .rrd; `run: null` writes none."""

    logs: Annotated[tuple[Id, ...], Field(min_length=1)] = ("first",)
    run: Annotated[int, Field(strict=True, ge=0)] | Literal["median", "worst"] | None = 0


class Experiment(Frozen):
    """An experiment file."""

    version: Annotated[Literal[1], BeforeValidator(_version)]
    logs: Annotated[tuple[str, ...], Field(min_length=1)]
    read: Read = Read()
    ego: Id | None = None
    max_gap_s: Positive = 0.5
    runs: Count = 1
    seed: Annotated[int, Field(strict=True)] = 0
    pems: dict[Id, Pem] = Field(default_factory=dict)
    units: dict[UnitName, Unit] = Field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] = ()
    visibility: Literal["surface", "flat"] = "surface"
    configurations: Annotated[dict[ConfigurationName, Configuration], Field(min_length=1)]
    measure: Measure = Measure()
    braking: Braking | None = None
    sweep: Sweep | None = None
    show: Show | None = Show()

    def units_of(self, configuration: Configuration) -> tuple[str, ...]:
        """Names of the units of a configuration, in the experiment's order; none for the truth."""
        if configuration.units == "truth":
            return ()
        if configuration.units == "all":
            return tuple(self.units)
        return tuple(name for name in self.units if name in configuration.units)

    def as_written(self) -> dict[str, Any]:
        """The experiment with every default filled in, as plain data for YAML."""
        return self.model_dump(mode="json", by_alias=True)
