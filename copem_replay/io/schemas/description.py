"""Description of a format of object lists: which fields of a message hold objects, and which of an object hold what.

Paths are relative to an object of the list; one that begins with `/`, and those of the time stamp and of the frame of
reference, start at the message.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from copem_replay.core.components import Frozen, Id, Number
from copem_replay.core.tracks import CLASSES

Path = Annotated[str, Field(min_length=1)]
Amount = Path | Number
"""A path, or a number for all objects."""


class Stamp(Frozen):
    """A time stamp that is one number: its path and its unit."""

    path: Path
    unit: Literal["s", "ms", "us", "ns"] = "s"


class ClassField(Frozen):
    """The class of an object: its path, the class that each value stands for, and the path of its probability.

    A value that `map` lacks is read as a name (`car`, `Pedestrian`, `vehicle.bus`), else as `other`. The value of a
    protobuf enumeration is its name.
    """

    path: Path
    map: dict[Id, str] = Field(default_factory=dict)
    probability: Path | None = None
    key: Path | None = None
    """Of a list of keys and values: the path of the key of the value at `path`."""
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
    """The paths of the objects in a message, and of their properties in an object."""

    objects: Path
    stamp: Path | Stamp | None = None
    frame: Path | None = None
    id: Path | None = None
    class_: Annotated[Path | ClassField | None, Field(alias="class")] = None
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
    """The axes of velocities: those of the list's frame of reference, or those of the object."""
    existence: Path | None = None
    covariance: Path | None = None
    """A 6 × 6 matrix by rows, as in ROS 2 (`geometry_msgs/PoseWithCovariance`)."""


@dataclass(frozen=True)
class StaysField:
    """Paths, from the message, of what ends a thing: its `lifetime` (0: none does), and removals.

    `kind`: that of a removal, of one thing by its value in `one`, of all in `all`; `id`: of what it removes, None: it
    is an object of the list itself.
    """

    lifetime: str
    kind: str
    id: str | None
    one: tuple[str, ...]
    all: tuple[str, ...]


Made = tuple[Any, ...]
"""A column of numbers that messages have in other units, or in parts: what makes it, and of which columns."""


@dataclass(frozen=True)
class Description:
    """A format: its fields, the values of paths that select objects (`only`), and the path an id is unique `within`.

    `said`: paths of numbers that are 0 where an object does not state its `yaw`, `velocity`, `covariance`. `footprint`:
    the points of an object's outline, with x and y along its axes, for objects without length and width. `largest_of`:
    the list of things that may have several bodies, of which the largest counts. `stays`: how things end that exist
    until a message removes them. `made`: columns by the paths that name them. `station`: whether positions are east and
    north of a station: then columns are made of its `/latitude_deg` and `/longitude_deg`, and of `after_s`, the time
    from the stamp to the measurement of an object.
    """

    fields: Fields
    only: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    within: str | None = None
    said: Mapping[Literal["yaw", "velocity", "covariance"], str] = field(default_factory=dict)
    footprint: str | None = None
    largest_of: str | None = None
    stays: StaysField | None = None
    made: Mapping[str, Made] = field(default_factory=dict)
    station: bool = False
