"""What scenes for Foxglove and Lichtblick are made of besides boxes: lines, texts, ellipses, in any encoding."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

Rgba: TypeAlias = tuple[float, float, float, float]
Place: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class Pose:
    """A place in the frame of reference, m, and a turn about the vertical, rad."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    yaw_rad: float = 0.0


@dataclass(frozen=True)
class Line:
    """A line through points (K, 3) of its own frame; `width` in pixels."""

    points: Sequence[Place]
    colour: Rgba
    pose: Pose = field(default_factory=Pose)
    width: float = 1.5


@dataclass(frozen=True)
class Text:
    """A text that faces the camera; `size` in pixels."""

    text: str
    colour: Rgba
    pose: Pose
    size: float = 14.0


@dataclass(frozen=True)
class Ellipse:
    """An upright elliptic cylinder with these diameters and this height, m."""

    size: Place
    colour: Rgba
    pose: Pose


@dataclass(frozen=True)
class Entity:
    """What has one name: what a click on it tells, and what it is drawn of."""

    name: str
    says: Mapping[str, str] = field(default_factory=dict)
    lines: Sequence[Line] = ()
    texts: Sequence[Text] = ()
    ellipses: Sequence[Ellipse] = ()


@dataclass(frozen=True)
class TruthFrame:
    """What there was at an instant of the log's clock; `followed`: where the eye's frame was, None: it was not."""

    time_ns: int
    entities: Sequence[Entity]
    followed: Pose | None


@dataclass(frozen=True)
class TruthScene:
    """The truth, to be drawn: what never moves, and frame by frame what does; the name of the frame to follow."""

    static: Sequence[Entity]
    frames: Iterable[TruthFrame]
    follow: str
