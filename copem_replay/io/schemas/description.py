"""How a format is described: where its messages have their objects, and an object what is to be known of it.

Paths are relative to an object of the list; one that begins with `/`, and those of the time stamp and of the frame of
reference, go from the message down.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from copem_replay.core.components import Frozen, Id, Number
from copem_replay.core.tracks import CLASSES

Path = Annotated[str, Field(min_length=1)]
Amount = Path | Number
"""A path, or a number that goes for all objects."""


class Stamp(Frozen):
    """A time stamp that is one number: where, and its unit."""

    path: Path
    unit: Literal["s", "ms", "us", "ns"] = "s"


class Class(Frozen):
    """What an object is: where that is said, what each value means, and how probable it is said to be.

    A value that `map` does not have is read as a name (`car`, `Pedestrian`, `vehicle.bus`), else as `other`. The value
    of a protobuf enumeration is its name.
    """

    path: Path
    map: dict[Id, str] = Field(default_factory=dict)
    probability: Path | None = None
    key: Path | None = None
    """Of a list of keys and values: where the key is of the value at `path`."""
    keys: tuple[str, ...] = ()
    """The keys, in small letters, whose values are classes."""

    @field_validator("map")
    @classmethod
    def _known(cls, value: dict[str, str]) -> dict[str, str]:
        for name in value.values():
            if name not in CLASSES:
                raise ValueError(f"expected one of {', '.join(CLASSES)}, found {name!r}")
        return value


class Yaw(Frozen):
    """A heading that is not in radians: degrees, or a quaternion with fields x, y, z, w."""

    quaternion: Path | None = None
    degrees: Path | None = None

    @model_validator(mode="after")
    def _one(self) -> Yaw:
        if (self.quaternion is None) == (self.degrees is None):
            raise ValueError("expected quaternion or degrees")
        return self


class Fields(Frozen):
    """Where a message has its objects, and an object what is to be known of it."""

    objects: Path
    stamp: Path | Stamp | None = None
    frame: Path | None = None
    id: Path | None = None
    class_: Annotated[Path | Class | None, Field(alias="class")] = None
    x_m: Path
    y_m: Path
    z_m: Amount | None = None
    yaw_rad: Amount | Yaw | None = None
    length_m: Amount
    width_m: Amount
    height_m: Amount | None = None
    vx_mps: Path | None = None
    vy_mps: Path | None = None
    velocity: Literal["list", "object"] = "list"
    """Whether velocities are along the axes of the list's frame of reference, or of the object."""
    existence: Path | None = None
    covariance: Path | None = None
    """A 6 × 6 matrix by rows, as ROS 2 has it."""


@dataclass(frozen=True)
class Solid:
    """Where an object says that it is a box, a sphere, a cylinder or a cone, and its sizes (shape_msgs)."""

    kind: str
    dimensions: str


@dataclass(frozen=True)
class Description:
    """A format: its fields, which objects are meant (by values of `only`), and what an id is unique `within`.

    `said`: where an object says whether it says its `yaw`, `velocity`, `covariance`: a number, 0 where it does not.
    `footprint`: the points of its outline, with x and y along its axes, where it has no length and width. `solid`:
    where its shape is said. `largest_of`: the list of things that may have several bodies; the largest counts. `stays`:
    the ids of things that are there until it is said otherwise.
    """

    fields: Fields
    only: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    within: str | None = None
    said: Mapping[Literal["yaw", "velocity", "covariance"], str] = field(default_factory=dict)
    footprint: str | None = None
    solid: Solid | None = None
    largest_of: str | None = None
    stays: str | None = None
