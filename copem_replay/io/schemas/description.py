"""Description of a format of object lists: which fields of a message hold objects, and which of an object hold what.

Paths are relative to an object of the list; one that begins with `/`, and those of the time stamp and of the frame of
reference, start at the message. `DecodedObjects` is what a decoder makes of messages; time stamps are parsed here.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from copem_replay.core.components import Frozen, Id, Number
from copem_replay.core.tracks import CLASSES, Bool, Int
from copem_replay.io.channel import LAST_NS
from copem_replay.io.encodings.columns import DistinctTexts, any_item_path

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
class SolidField:
    """The paths of an object's type of solid (box, sphere, cylinder, cone) and of its dimensions (shape_msgs)."""

    kind: str
    dimensions: str


@dataclass(frozen=True)
class Description:
    """A format: its fields, the values of paths that select objects (`only`), and the path an id is unique `within`.

    `said`: paths of numbers that are 0 where an object does not state its `yaw`, `velocity`, `covariance`. `footprint`:
    the points of an object's outline, with x and y along its axes, for objects without length and width. `solid`: the
    fields of its shape. `largest_of`: the list of things that may have several bodies, of which the largest counts.
    `stays`: the path of the ids of things that exist until a message removes them.
    """

    fields: Fields
    only: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    within: str | None = None
    said: Mapping[Literal["yaw", "velocity", "covariance"], str] = field(default_factory=dict)
    footprint: str | None = None
    solid: SolidField | None = None
    largest_of: str | None = None
    stays: str | None = None


# Decoded lists of one topic as flat columns: not corrected, and in the order of the messages.


X, Y, Z, YAW, VX, VY = range(6)
"""Columns of `values`, the first of `tracks.VALUES`."""


# Time stamps in messages: one number, seconds and nanoseconds, or text after ISO 8601.

UNIT_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_PAIRS = (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec"), ("secs", "nsecs"))
_LAST_SECOND = LAST_NS // 10**9
_ISO = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)[Tt ](\d\d):(\d\d):(\d\d)(?:[.,](\d{1,30}))?\s?(?:[Zz]|(?:UTC)|([+-])(\d\d)(?::?(\d\d))?)?",
    re.ASCII,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def find_stamp_paths(offers: Collection[str], path: str) -> list[str]:
    """Paths of the time stamp at `path`: one, or those of seconds and nanoseconds; empty: there is no time stamp."""
    if any_item_path(path) in offers:
        return [path]
    pairs = ([f"{path}.{name}" for name in pair] for pair in _PAIRS)
    return next((both for both in pairs if all(any_item_path(p) in offers for p in both)), [])


def parse_nanoseconds(texts: Sequence[DistinctTexts], unit: str) -> tuple[Int, Bool, int]:
    """(R,) times in ns of one column, or of seconds and nanoseconds; (R,) whether each is one; how many are impossible.

    Decimal numbers are exact. A date without a zone is in UTC. Impossible: beyond `LAST_NS`.
    """
    parts = [_parse_words(t, unit if len(texts) == 1 else u) for t, u in zip(texts, ("s", "ns"), strict=False)]
    stamp_ns, is_time, impossible = parts[0]
    if len(parts) == 2:
        stamp_ns, is_time = stamp_ns + parts[1][0], is_time & parts[1][1]
        impossible += parts[1][2]
    return stamp_ns, is_time, impossible


def _parse_words(texts: DistinctTexts, unit: str) -> tuple[Int, Bool, int]:
    """As `parse_nanoseconds`, of one column."""
    stamp_of_word, is_time = np.zeros(len(texts.words) + 1, dtype=np.int64), np.zeros(len(texts.words) + 1, dtype=bool)
    impossible = np.zeros(len(texts.words) + 1, dtype=bool)
    for k, word in enumerate(texts.words):
        try:
            value, scale = Decimal(word), UNIT_NS[unit]
        except ArithmeticError:  # no number
            instant_ns = _parse_date(word)
            if instant_ns is None:
                continue
            value, scale = Decimal(instant_ns), 1
        if value.is_finite() and value.copy_abs() <= _LAST_SECOND * 1_000_000_000 // scale:
            stamp_of_word[k], is_time[k] = round(value * scale), True
        else:
            impossible[k] = True
    return stamp_of_word[texts.code], is_time[texts.code], int(impossible[texts.code].sum())


def _parse_date(word: str) -> int | None:
    """`2024-05-01T12:00:00.25+02:00` in ns of Unix time; None: no such text."""
    found = _ISO.fullmatch(word.strip())
    if found is None:
        return None
    *parts, fraction, sign, hours, minutes = found.groups()
    try:
        whole = datetime(*map(int, parts), tzinfo=UTC) - _EPOCH  # type: ignore[misc,arg-type]
    except ValueError:  # the 30th of February
        return None
    ahead = timedelta(hours=int(hours or 0), minutes=int(minutes or 0))
    whole += ahead if sign == "-" else -ahead
    nanos = round(Decimal(f"0.{fraction or 0}") * 10**9)
    return (whole.days * 86_400 + whole.seconds) * 10**9 + nanos
