"""Units in the experiment file: where they stand, when they list, how they err beside their PEM; and obstacles.

`PerceptionSetup` is all that perception reads of an experiment.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Protocol, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from copem_replay.core.components import Either, Flag, Frozen, Id, NotNegative, Number, Positive, Share
from copem_replay.core.memory import MemoryPart, Parts
from copem_replay.perception.pem.condition import ClassNames
from copem_replay.perception.visibility import VisibilityModel

if TYPE_CHECKING:
    from copem_replay.perception.pem.model import Pem


# Errors of a unit beside its PEM: its own pose, its clock, and outages, drawn in perception/perceive.py.
# docs/guide/unit-errors.md.


class PoseError(Frozen):
    """Errors of a unit's own position and heading, from mounting or localisation.

    `position_sigma_m` applies to easting and to northing, `yaw_sigma_deg` to the heading. `memory`: the parts that
    last, for the unit, or with `of: all` shared by all units; the rest is new in every list. `stated`: the unit's
    stated covariances include these errors.
    """

    position_sigma_m: NotNegative = 0.0
    yaw_sigma_deg: NotNegative = 0.0
    stated: Flag = False
    memory: Parts | None = Field(default=None, exclude_if=lambda memory: memory is None)

    @field_validator("memory")
    @classmethod
    def _of_units(cls, parts: tuple[MemoryPart, ...] | None) -> tuple[MemoryPart, ...] | None:
        if any(part.of == "object" for part in parts or ()):
            raise ValueError("of: object: a pose is of no object; expected unit or all")
        return parts

    @property
    def parts(self) -> tuple[MemoryPart, ...]:
        """The parts of `memory`; `of: pair` means the unit."""
        return tuple(p.model_copy(update={"of": "unit"}) if p.of == "pair" else p for p in self.memory or ())


class ClockError(Frozen):
    """Errors of a unit's clock: offset, and drift since the log's start, as standard deviations over the runs.

    Within a run both are constant. A fusion sees captures in this clock.
    """

    offset_sigma_s: NotNegative = 0.0
    drift_sigma_ppm: NotNegative = 0.0


class Outages(Frozen):
    """Times without lists: `down_share` of the time, each for `lasts_s` on average."""

    down_share: Annotated[float, Field(strict=True, ge=0, le=0.999)]
    lasts_s: Annotated[float, Field(strict=True, ge=0.001, le=86_400)]

    @property
    def correlation_s(self) -> float:
        """Mean time between renewals of a uniform number; the unit is down while the number is below `down_share`.

        1 − `down_share` of the renewals are above and end the outage: after `lasts_s` on average.
        """
        return self.lasts_s * (1 - self.down_share)


Point = tuple[Number, Number]


def _check_two_numbers(value: object) -> object:
    if isinstance(value, list | tuple) and len(value) == 3:
        found = ", ".join(str(number) for number in value)
        raise ValueError(f"expected two numbers, in the plane, found [{found}]; the height above ground is `height_m`")
    return value


InPlane = Annotated[Point, BeforeValidator(_check_two_numbers)]
"""A point in the plane; three numbers are refused with a pointer to `height_m`."""


def _check_degrees(place: tuple[float, ...]) -> tuple[float, ...]:
    lat, lon = place[:2]
    if abs(lat) > 84 or abs(lon) > 180:
        raise ValueError(
            f"expected latitude (-84 … 84) and longitude (-180 … 180) in degrees, found [{lat:g}, {lon:g}]"
        )
    return place


OnEarthPlace = Annotated[tuple[Number, Number], AfterValidator(_check_degrees)]
"""Latitude and longitude of WGS84 in degrees, in this order."""
OnEarthPose = Annotated[tuple[Number, ...], Field(min_length=2, max_length=3), AfterValidator(_check_degrees)]
"""Latitude, longitude and, if it is given, the heading clockwise from true north, in degrees."""
OnEarthPolygon = Annotated[tuple[OnEarthPlace, ...], Field(min_length=3)]

Rate = Annotated[float, Field(strict=True, ge=0.001, le=1000)]
"""Lists per second."""


class Carriers(Frozen):
    """Objects of these classes, except the ego, that carry a unit each with probability `penetration_rate`."""

    classes: ClassNames
    penetration_rate: Share


On = Either[Id, Carriers]


class Placement(Frozen):
    """Carried `on` the ego, another object or a share of some classes, or standing `at` a place; lists at some rate.

    `at_wgs84`, instead of `at`: latitude, longitude and, instead of `yaw_deg`, heading clockwise from true north.

    `height_m` above the ground; left out, a carried unit is on the roof. `placed`: how wrong the unit is about its own
    pose, `clock`: about the time, `outages`: when it makes no lists.
    """

    on: On | None = None
    at: InPlane | None = None
    at_wgs84: OnEarthPose | None = Field(default=None, exclude_if=lambda place: place is None)
    offset_m: InPlane = (0.0, 0.0)
    yaw_deg: Number = 0.0
    height_m: NotNegative | None = None
    ground_z_m: Number | None = None
    pem: Id | None = None
    rate_hz: Rate | None = None
    phase_s: NotNegative = 0.0
    placed: PoseError | None = Field(default=None, exclude_if=lambda placed: placed is None)
    clock: ClockError | None = Field(default=None, exclude_if=lambda clock: clock is None)
    outages: Outages | None = Field(default=None, exclude_if=lambda outages: outages is None)

    @model_serializer(mode="wrap")
    def _with_one_heading(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without `yaw_deg` where `at_wgs84` has the heading, as both are refused."""
        written: dict[str, Any] = write(self)
        if isinstance(self.at_wgs84, tuple) and len(self.at_wgs84) == 3:
            written.pop("yaw_deg", None)
        return written


def _describe_polygon_fault(reason: str) -> str:
    """What is wrong with a polygon, from the reason that shapely gives, such as `Self-intersection[5 5]`."""
    fault, _, place = reason.rstrip("]").partition("[")
    where = f" at [{', '.join(place.split())}]" if place else ""
    words = {
        "Self-intersection": f"edges that cross or overlap{where}",
        "Ring Self-intersection": f"edges that meet{where}",
    }
    return words.get(fault, "corners without an area between them")


def check_polygon(points_m: tuple[Point, ...], key: str = "polygon_m") -> tuple[Point, ...]:
    """The corners of an area. Raises ValueError where its edges cross, or there is nothing between them."""
    import shapely

    polygon = shapely.Polygon(points_m)
    if not polygon.is_valid or polygon.area <= 0:
        fault = _describe_polygon_fault(shapely.is_valid_reason(polygon))
        raise ValueError(f"{key}: expected the corners in order around an area, each once, found {fault}")
    return points_m


class Obstacle(Frozen):
    """A static obstacle beside those in the log: its outline in metres of the log, or as latitudes and longitudes."""

    polygon_m: Annotated[tuple[Point, ...], Field(min_length=3)] = Field(default=(), exclude_if=lambda one: not one)
    polygon_wgs84: OnEarthPolygon | None = Field(default=None, exclude_if=lambda one: one is None)
    height_m: Positive
    ground_z_m: Number | None = None

    @model_validator(mode="after")
    def _simple(self) -> Self:
        if bool(self.polygon_m) == (self.polygon_wgs84 is not None):
            found = "both" if self.polygon_m else "none"
            raise ValueError(f"expected one of polygon_m and polygon_wgs84, found {found}")
        if self.polygon_wgs84 is not None:
            check_polygon(self.polygon_wgs84, "polygon_wgs84")
        else:
            check_polygon(self.polygon_m)
        return self


class PerceptionSetup(Protocol):
    """What perception reads of an experiment."""

    @property
    def seed(self) -> int:
        """The seed of all draws."""

    @property
    def max_gap_s(self) -> float:
        """Seconds; between states further apart than this nothing is interpolated."""

    @property
    def visibility(self) -> VisibilityModel:
        """How much of each object shows."""

    @property
    def pems(self) -> Mapping[str, Pem]:
        """Perception error models by name."""

    @property
    def units(self) -> Mapping[str, Placement]:
        """All units by name."""

    @property
    def modelled(self) -> Mapping[str, Placement]:
        """The units with a PEM, by name."""

    @property
    def areas(self) -> Mapping[str, Any]:
        """Areas of the experiment by name, with their `rings_m`, beside those of the log's maps."""

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Static obstacles beside those of the log."""
