"""What is measured, and from when: the keys of `measure` in an experiment file."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal, Protocol, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from copem_replay.core.components import Flag, Frozen, Id, NotNegative, Positive, Slot
from copem_replay.core.errors import unknown_name_message
from copem_replay.core.site_map import make_polygon
from copem_replay.core.tracks import Bool, Float
from copem_replay.metrics.braking.driver import DRIVERS, Driver
from copem_replay.metrics.limits import OBJECTS
from copem_replay.metrics.metric import RowMetric
from copem_replay.metrics.onset import BEGAN, ONSETS, Began, InRange, Onset, Requires
from copem_replay.perception.config import InPlane, OnEarthPolygon, PerceptionSetup, check_polygon
from copem_replay.perception.pem.condition import ClassNames


def _is_none(value: object) -> bool:
    return value is None


Polygon = Annotated[tuple[InPlane, ...], Field(min_length=3)]


def _check_exactly_one(self: BaseModel, *names: str) -> None:
    present = [name for name in names if getattr(self, name) is not None]
    if len(present) != 1:
        raise ValueError(f"expected one of {', '.join(names)}, found {' and '.join(present) or 'none'}")


def _check_outline(self: Within | OwnArea | AnnotatedArea) -> None:
    for key in ("polygon_m", "polygon_wgs84"):
        if (corners := getattr(self, key)) is not None:
            check_polygon(corners, key)


class Within(Frozen):
    """Which objects matter, by the truth: in a polygon, in areas or near the ego's path at onset, or soon on that path.

    `corridor_m`: largest distance from the path of the ego's centre from the onset to the end of the episode.
    `conflict_s`: at some instant of its episode the object, at constant velocity, would within this time enter the area
    that the ego, at constant speed, sweeps along its path, with the margin of `measure.conflict` around it.
    `areas`: by name, your own and those of maps, or by kind: `crosswalk`, `junction`, `drivable`, `parking`.
    `lanes`: of maps and of the recording, by id, or by kind: `driving`, `bicycle`, `walking`, `parking`, `other`.
    """

    polygon_m: Polygon | None = None
    polygon_wgs84: OnEarthPolygon | None = Field(default=None, exclude_if=_is_none)
    corridor_m: NotNegative | None = None
    conflict_s: Positive | None = None
    areas: Annotated[tuple[Id, ...], Field(min_length=1)] | None = Field(default=None, exclude_if=_is_none)
    lanes: Annotated[tuple[Id, ...], Field(min_length=1)] | None = Field(default=None, exclude_if=_is_none)

    @model_validator(mode="after")
    def _one(self) -> Self:
        _check_exactly_one(self, "polygon_m", "polygon_wgs84", "corridor_m", "conflict_s", "areas", "lanes")
        _check_outline(self)
        return self

    @property
    def of_ego(self) -> bool:
        """Whether the condition needs an ego."""
        return self.corridor_m is not None or self.conflict_s is not None


class OwnArea(Frozen):
    """An area of your own: a polygon, or a strip of some width along a line; its ends are cut straight."""

    polygon_m: Polygon | None = None
    polygon_wgs84: OnEarthPolygon | None = Field(default=None, exclude_if=_is_none)
    along_m: Annotated[tuple[InPlane, ...], Field(min_length=2)] | None = None
    width_m: Positive | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        _check_exactly_one(self, "polygon_m", "polygon_wgs84", "along_m")
        _check_outline(self)
        if (self.along_m is None) != (self.width_m is None):
            raise ValueError("expected `width_m` with `along_m`, and not with a polygon")
        return self

    @property
    def rings_m(self) -> tuple[tuple[tuple[float, float], ...], ...]:
        """The rings of its polygon, as an area of a map has them."""
        import shapely

        if self.along_m is None or self.width_m is None:
            return (self.polygon_m or (),)
        strip = shapely.buffer(shapely.LineString(self.along_m), self.width_m / 2, cap_style="flat", join_style="mitre")
        return tuple(tuple(ring.coords[:-1]) for ring in (strip.exterior, *strip.interiors))

    def covers(self, x_m: Float, y_m: Float) -> Bool:
        """Whether places (K,) are in it, or on its border."""
        import shapely

        return np.asarray(shapely.intersects(make_polygon(self.rings_m), shapely.points(x_m, y_m)))


class AnnotatedArea(Frozen):
    """Where the truth has all objects: a polygon, or a range around the place that distances are measured from."""

    polygon_m: Polygon | None = None
    polygon_wgs84: OnEarthPolygon | None = Field(default=None, exclude_if=_is_none)
    range_m: Positive | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        _check_exactly_one(self, "polygon_m", "polygon_wgs84", "range_m")
        _check_outline(self)
        return self


class Objects(Frozen):
    """Which objects are measured: by default all that move but the ego. `within`: of these only those that matter."""

    classes: ClassNames | None = None
    ids: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None
    within: Within | None = Field(default=None, exclude_if=_is_none)

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.classes is not None and self.ids is not None:
            raise ValueError("expected either classes or ids, found both")
        return self


LONGEST_CHAIN = 12
"""Over more capture instants there are no exact times: the chain has 2¹¹ states for 12, twice as many for each more."""

Captures = Annotated[int, Field(strict=True, ge=1, le=1000)]

_ONSET = Slot("onset", ONSETS)


def onset_requirement(kind: str) -> Requires | None:
    """What the onset of a kind needs of the experiment; None: no onset has this name."""
    try:
        onset = _ONSET.find(kind)
    except PydanticCustomError:
        return None
    return onset.requires if issubclass(onset, Onset) else None


class Confirm(Frozen):
    """Detected when `hits` of `of` consecutive turns of a unit, or instants of all, hold the object."""

    hits: Captures = 1
    of: Captures = 1

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.hits > self.of:
            raise ValueError(f"expected hits ≤ of, found {self.hits} of {self.of}")
        return self


Margin = Annotated[float, Field(strict=True, ge=0, le=100)]
"""Metres; more than a hundred is taken for a slip."""


class Conflict(Frozen):
    """When a perceived state implies a collision: its predicted path meets the ego's corridor within the horizon.

    The corridor is the area that the ego sweeps along its path at its present speed, with `margin_m` around it. The
    object is predicted with constant perceived velocity.
    """

    horizon_s: Positive = 3.0
    margin_m: Margin = 0.5


class Match(Frozen):
    """How entries of fused lists are matched to true objects."""

    gate_m: Positive = 3.0


class Gospa(Frozen):
    """Parameters of GOSPA and OSPA (α = 2): by default the cut-off is the gate of `match`."""

    cutoff_m: Positive | None = None
    power: Annotated[float, Field(strict=True, ge=1, le=10)] = 2.0


def _check_began(value: object) -> object:
    if isinstance(value, str) and value not in BEGAN:
        raise ValueError(f"{unknown_name_message('way to begin', value, BEGAN)} (of {', '.join(BEGAN)})")
    return value


def _check_no_repeats(value: tuple[Began, ...]) -> tuple[Began, ...]:
    if repeated := [word for word in BEGAN if value.count(word) > 1]:
        raise ValueError(f"expected each word once, found {repeated[0]} {value.count(repeated[0])} times")
    return value


BeganWords = Annotated[
    tuple[Annotated[Began, BeforeValidator(_check_began)], ...],
    Field(min_length=1),
    AfterValidator(_check_no_repeats),
]


# What the summary is sliced by.

LOG, CLASS, BEGAN_BY, RANGE, AREA, TAGS = "log", "class", "began", "range_at_onset", "area", "tags."
RANGE_EDGES_M = (10.0, 20.0, 30.0, 50.0, 75.0, 100.0)
"""Edges of `range_at_onset` where none are given; nearer and farther objects have groups, too."""
_EXPECTED = f"{LOG}, {CLASS}, {BEGAN_BY}, {RANGE}, {AREA} or {TAGS}NAME"


@dataclass(frozen=True)
class Dimension:
    """What episodes are grouped by. `edges_m`: between the groups of `range_at_onset`."""

    name: str
    edges_m: tuple[float, ...] = ()

    @property
    def label(self) -> str:
        """As it is written in an entry."""
        own = self.edges_m if self.edges_m != RANGE_EDGES_M else ()
        return ":".join([self.name, *(f"{edge_m:g}" for edge_m in own)])

    @property
    def of_logs(self) -> bool:
        """Whether all episodes of a log are in the same group."""
        return self.name == LOG or self.name.startswith(TAGS)


@dataclass(frozen=True)
class Slice:
    """An entry: one dimension, or a cross of several."""

    dimensions: tuple[Dimension, ...]

    @property
    def label(self) -> str:
        """As it is written on the command line: `class*tags.weather`."""
        return "*".join(dimension.label for dimension in self.dimensions)

    @property
    def of_logs(self) -> bool:
        """Whether groups are of whole logs."""
        return all(dimension.of_logs for dimension in self.dimensions)

    @property
    def tags(self) -> tuple[str, ...]:
        """The names of the tags that it groups by."""
        names = (dimension.name for dimension in self.dimensions)
        return tuple(name.removeprefix(TAGS) for name in names if name.startswith(TAGS))

    def names(self, name: str) -> bool:
        """Whether it has a dimension of this name."""
        return any(dimension.name == name for dimension in self.dimensions)


def parse_slice(entry: str | Sequence[str]) -> Slice:
    """An entry of `by`: `class`, `[log, class]`, `log*class`. Raises ValueError with what was expected and found."""
    words = entry.split("*") if isinstance(entry, str) else list(entry)
    dimensions = tuple(_parse_dimension(word.strip()) for word in words)
    names = [dimension.name for dimension in dimensions]
    if not names:
        raise ValueError(f"expected {_EXPECTED}, found an empty list")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"expected each of a cross once, found {name} {names.count(name)} times")
    return Slice(dimensions)


def parse_slices(entries: Sequence[str | Sequence[str]]) -> tuple[Slice, ...]:
    """Entries of `by`, each once. Raises ValueError."""
    slices = tuple(map(parse_slice, entries))
    labels = [by.label for by in slices]
    if repeated := [label for label in labels if labels.count(label) > 1]:
        raise ValueError(f"expected each entry once, found {repeated[0]} {labels.count(repeated[0])} times")
    return slices


def _parse_dimension(word: str) -> Dimension:
    name, *edges = word.split(":") if word.startswith(RANGE) else [word]
    if name == RANGE:
        return Dimension(name, _parse_edges(edges) if edges else RANGE_EDGES_M)
    if name in (LOG, CLASS, BEGAN_BY, AREA) or (name.startswith(TAGS) and len(name) > len(TAGS)):
        return Dimension(name)
    message = unknown_name_message("slice", word, (LOG, CLASS, BEGAN_BY, RANGE, AREA))
    raise ValueError(f"{message} (expected {_EXPECTED}; a cross as [log, class] or log*class)")


def _parse_edges(edges: Sequence[str]) -> tuple[float, ...]:
    try:
        edges_m = tuple(map(float, edges))
    except ValueError:
        edges_m = ()
    if not edges_m or not all(map(math.isfinite, edges_m)) or any(b <= a for a, b in pairwise((0.0, *edges_m))):
        raise ValueError(f"{RANGE}: expected ascending edges above 0 in metres, {RANGE}:20:40, found {':'.join(edges)}")
    return edges_m


def _check_entry(value: object) -> object:
    words = value if isinstance(value, list | tuple) else [value]
    if all(isinstance(word, str) for word in words):
        parse_slice(value)  # type: ignore[arg-type]
    return value


SliceEntry = Annotated[str | tuple[str, ...], BeforeValidator(_check_entry)]


Weigh = Literal["objects", "drives"]
"""What counts alike in figures of rows."""


class Measure(Frozen):
    """What is measured, and from which onset. `began`: which episodes count for times, shares and distances at
    detection, by how they began; everything else is measured of all. `accuracy`: also how far off the fused lists are.

    `annotated`: the area in which entries at no true object are ghosts, by default everywhere. `metrics`: your own
    columns of the summary. `by`: what the summary is sliced by, once more for each entry: `log`, `class`, `began`,
    `range_at_onset` (`range_at_onset:20:40`: by edges of your own, in metres), `area`, `tags.NAME`; a list is a cross.
    `weigh`: what counts alike in shares, times and distances of detection: every object, or every drive.

    >>> measure = cr.Measure(objects={"classes": ["vru"]}, onset={"kind": "in_range", "range_m": 30.0})
    >>> measure.onset.range_m, measure.confirm.hits
    (30.0, 1)
    """

    objects: Objects = Objects()
    onset: Annotated[Onset, _ONSET] = InRange()
    began: BeganWords = ("crossed", "appeared")
    count_earlier: Flag = False
    confirm: Confirm = Confirm()
    match: Match = Match()
    distance_to: Id = "ego"
    horizon_s: Positive = 5.0
    conflict: Conflict | None = None
    exact: Flag = False
    accuracy: Flag = True
    gospa: Gospa = Gospa()
    annotated: AnnotatedArea | None = Field(default=None, exclude_if=_is_none)
    metrics: Annotated[tuple[Annotated[RowMetric, Slot("metric", {})], ...], Field(exclude_if=operator.not_)] = ()
    by: Annotated[tuple[SliceEntry, ...], Field(exclude_if=operator.not_)] = ()
    weigh: Annotated[Weigh, Field(exclude_if=lambda weigh: weigh == OBJECTS)] = "objects"

    @model_validator(mode="after")
    def _sliced(self) -> Self:
        if self.by and (problem := find_range_problem(self.onset, parse_slices(self.by))) is not None:
            raise ValueError(f"by: {problem}")
        return self

    @model_validator(mode="after")
    def _named_once(self) -> Self:
        if self.metrics:
            from copem_replay.metrics.summary_metrics import METRIC

            names = ["configuration", *METRIC]
            for own in self.metrics:
                if own.name in names:
                    raise ValueError(f"metrics: expected a name that no other column has, found {own.name!r}")
                names.append(own.name)
        return self


NO_AREAS = (
    f"{AREA}: expected areas to group by, found none; name them with `areas: {{…}}`, or give `maps: [{{file: …}}]`"
)


def find_range_problem(onset: Onset, slices: Sequence[Slice]) -> str | None:
    """Why episodes cannot be grouped by their range at this onset; None: they can, or are not asked to be."""
    if not isinstance(onset, InRange) or not any(by.names(RANGE) for by in slices):
        return None
    return (
        f"{RANGE}: expected an onset that is no range, found in_range: what comes nearer is at {onset.range_m:g} m, "
        f"and all else began nearer; slice by {BEGAN_BY}, or see bands.csv for accuracy by range at the instant"
    )


GHOST_ENTRY, DUPLICATE_ENTRY, MISPLACED, LATE = "ghost", "duplicate", "misplaced", "late"
CAUSES = (GHOST_ENTRY, DUPLICATE_ENTRY, MISPLACED, LATE)
"""Whose entry a driver brakes for who brakes for nothing."""
PositiveShare = Annotated[float, Field(strict=True, gt=0, le=1)]


class Needless(Frozen):
    """When the driver brakes for an entry of a list, and when the truth gives a reason to.

    Braking with less than the share `brakes_at` of the driver's deceleration does not keep the ego `margin_m` clear of
    the entry. The truth gives a reason where, within `around_s` of the list, less than `needed_at` does not keep it
    `wider_m` clear of a true object. An ego slower than `slower_mps` does not drive. Needless braking that pauses for
    `merge_s` or less is one event.
    """

    brakes_at: PositiveShare = 0.6
    needed_at: PositiveShare = 0.3
    margin_m: Margin = 0.0
    wider_m: Margin = 0.5
    around_s: Annotated[float, Field(strict=True, ge=0, le=60)] = 0.5
    slower_mps: Positive = 1.0
    merge_s: Annotated[float, Field(strict=True, ge=0, le=60)] = 1.0

    @model_validator(mode="after")
    def _tolerant(self) -> Self:
        if self.needed_at > self.brakes_at:
            raise ValueError(
                f"expected needed_at ≤ brakes_at, found {self.needed_at:g} and {self.brakes_at:g}: a true "
                "object may be a little less in the way than an entry, not more"
            )
        if self.wider_m < self.margin_m:
            raise ValueError(f"expected wider_m ≥ margin_m, found {self.wider_m:g} and {self.margin_m:g}")
        return self


class Braking(Frozen):
    """What the ego's driver does when an object is known (`brakes_for: object`) or a list implies a collision.

    `ego`: until it brakes, the ego drives as recorded, or with constant speed from the onset (the recorded driver may
    have braked already). `needless`: when braking is for nothing, of all entries of the lists; null: not measured.
    """

    driver: Annotated[Driver, Slot("driver", DRIVERS)]
    margin_m: Margin = 0.5
    ego: Literal["recorded", "constant_speed"] = "recorded"
    brakes_for: Literal["object", "conflict"] = "object"
    needless: Needless | None = Needless()


class MetricsSetup(PerceptionSetup, Protocol):
    """What metrics read of an experiment."""

    @property
    def measure(self) -> Measure:
        """What is measured."""

    @property
    def braking(self) -> Braking | None:
        """What the driver does; None: the experiment does not ask."""

    @property
    def areas(self) -> Mapping[str, OwnArea]:
        """Areas of one's own, by name."""

    @property
    def has_areas(self) -> bool:
        """Whether the study has areas, its own or of maps."""

    @property
    def recorded(self) -> Mapping[str, object]:
        """Units whose lists are recorded."""
