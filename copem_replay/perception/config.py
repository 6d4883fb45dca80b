"""Where perception units stand and when they list: keys of the experiment file, and what perception reads of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Protocol, Self

from pydantic import BeforeValidator, Field, model_validator

from copem_replay.core.components import Either, Frozen, Id, NotNegative, Number, Positive, Share
from copem_replay.perception.pem.condition import ClassNames
from copem_replay.perception.unit_errors import Clock, Outages, PoseError
from copem_replay.perception.visibility import VisibilityModel

if TYPE_CHECKING:
    from copem_replay.perception.pem.model import Pem

Point = tuple[Number, Number]


def _two(value: object) -> object:
    if isinstance(value, list | tuple) and len(value) == 3:
        found = ", ".join(str(number) for number in value)
        raise ValueError(f"expected two numbers, in the plane, found [{found}]; the height above ground is `height_m`")
    return value


InPlane = Annotated[Point, BeforeValidator(_two)]
"""A point beside which a height may stand."""

Rate = Annotated[float, Field(strict=True, ge=0.001, le=1000)]
"""Lists per second."""


class Carriers(Frozen):
    """Objects of these classes, except the ego, that carry a unit each with probability `penetration_rate`."""

    classes: ClassNames
    penetration_rate: Share


On = Either[Id, Carriers]


class Placement(Frozen):
    """Carried `on` the ego, another object or a share of some classes, or standing `at` a place; lists at some rate.

    `height_m` above the ground; left out, a carried unit is on the roof. `placed`: how wrong the unit is about its own
    pose, `clock`: about the time, `outages`: when it makes no lists.
    """

    on: On | None = None
    at: InPlane | None = None
    offset_m: InPlane = (0.0, 0.0)
    yaw_deg: Number = 0.0
    height_m: NotNegative | None = None
    ground_z_m: Number | None = None
    pem: Id | None = None
    rate_hz: Rate | None = None
    phase_s: NotNegative = 0.0
    placed: PoseError | None = Field(default=None, exclude_if=lambda placed: placed is None)
    clock: Clock | None = Field(default=None, exclude_if=lambda clock: clock is None)
    outages: Outages | None = Field(default=None, exclude_if=lambda outages: outages is None)


_AROUND = "the corners in order around an area, each once"


def _crooked(reason: str) -> str:
    """What is wrong with a polygon, of which shapely says `Self-intersection[5 5]`."""
    what, _, place = reason.rstrip("]").partition("[")
    at = f" at [{', '.join(place.split())}]" if place else ""
    words = {"Self-intersection": f"edges that cross or overlap{at}", "Ring Self-intersection": f"edges that meet{at}"}
    return words.get(what, "corners without an area between them")


def simple_polygon(points_m: tuple[Point, ...]) -> tuple[Point, ...]:
    """The corners of an area. Raises ValueError where its edges cross, or there is nothing between them."""
    import shapely

    polygon = shapely.Polygon(points_m)
    if not polygon.is_valid or polygon.area <= 0:
        raise ValueError(f"polygon_m: expected {_AROUND}, found {_crooked(shapely.is_valid_reason(polygon))}")
    return points_m


class Obstacle(Frozen):
    """A static obstacle beside those in the log."""

    polygon_m: Annotated[tuple[Point, ...], Field(min_length=3)]
    height_m: Positive
    ground_z_m: Number | None = None

    @model_validator(mode="after")
    def _simple(self) -> Self:
        simple_polygon(self.polygon_m)
        return self


class PerceptionSetup(Protocol):
    """What perception reads of an experiment."""

    @property
    def seed(self) -> int:
        """Of all draws."""

    @property
    def max_gap_s(self) -> float:
        """States further apart than this (s) are not interpolated between."""

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
        """Those with a PEM."""

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Static obstacles beside those of the log."""
