"""A PEM as an experiment has it: its couples, the draws that last, listed classes, ghosts and track ids.

A list of couples is the short form, and is written where the other keys are absent.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    GetJsonSchemaHandler,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import CoreSchema

from copem_replay.core.components import Component, Frozen, Id, NotNegative, Number, Positive, Share, Slot
from copem_replay.core.memory import Memory, Parts
from copem_replay.core.site_map import make_polygon
from copem_replay.core.tracks import CLASSES, Float, Int
from copem_replay.perception.pem.condition import (
    QUANTITIES,
    Claimed,
    ClassNames,
    Couple,
    ExistenceScores,
    check_ascending,
    check_one_turn,
    check_quantities,
)

# Classes that units list objects as, and the probabilities that they state.


def _check_class(value: str) -> str:
    if value not in CLASSES:
        raise ValueError(f"expected one of {', '.join(CLASSES)}; found {value!r}")
    return value


OneClass = Annotated[str, AfterValidator(_check_class)]


def _check_sum(shares: dict[str, float]) -> dict[str, float]:
    total = math.fsum(shares.values())
    if abs(total - 1) > 1e-9:
        raise ValueError(f"sums to {total:g}, expected 1")
    return shares


Shares = Annotated[dict[OneClass, Share], Field(min_length=1), AfterValidator(_check_sum)]
"""Probability by class; the probabilities sum to 1."""


class ListedClasses(Frozen):
    """The listed classes of objects, by true class; a class that is left out is always listed correctly.

    `confidence`: the stated probability of the listed class; the rest is spread evenly over the others.
    """

    confusion: dict[OneClass, Shares] = Field(default_factory=dict)
    confidence: Share = 1.0

    def listed(self, class_ix: Int, uniform: Float) -> Int:
        """(P,) listed classes of objects of true classes (P,), by the inverse of the cumulated row of each."""
        return draw_classes(self._rows, class_ix, uniform)

    def stated(self, class_ix: Int) -> Float:
        """(P, C) the class probabilities that are stated with listed classes (P,)."""
        stated = np.full((len(class_ix), len(CLASSES)), (1 - self.confidence) / (len(CLASSES) - 1))
        stated[np.arange(len(class_ix)), class_ix] = self.confidence
        return stated

    @property
    def _rows(self) -> Float:
        rows = np.eye(len(CLASSES))
        for name, shares in self.confusion.items():
            rows[CLASSES.index(name)] = class_row(shares)
        return rows


def class_row(shares: dict[str, float]) -> Float:
    """(C,) probabilities in the order of CLASSES."""
    return np.array([shares.get(name, 0.0) for name in CLASSES])


def draw_classes(rows: Float, row_ix: Int, uniform: Float) -> Int:
    """(P,) a class for each uniform (P,), by row `row_ix` (P,) of probabilities (R, C)."""
    cumulated = np.cumsum(rows, axis=1)
    cumulated[:, -1] = 1.0
    last = np.array([np.flatnonzero(row)[-1] for row in rows])  # rounding gives no share to a class of probability 0
    listed: Int = np.minimum((uniform[:, None] >= cumulated[row_ix]).sum(axis=1), last[row_ix])
    return listed


# Ghosts: entries about no object, drawn in perception/ghosts.py. docs/guide/unit-errors.md.

Frame = Literal["unit", "world", "object"]


class GhostPlace(Component, ABC):
    """Where ghosts are: at a place that is drawn at birth, in the frame of the unit, of the world or of an object."""

    frame: ClassVar[Frame] = "unit"

    @abstractmethod
    def places_m(self, uniform: Float, length_m: Float, width_m: Float) -> Float:
        """(2, B) places of ghosts in the frame, ahead and to the left (of the world: east and north).

        `uniform` (3, B): of each ghost three, in (0, 1). `length_m`, `width_m` (B,): of the object beside which it is.
        """


class FieldPlace(GhostPlace):
    """Uniform over the area of a field of view, which moves with the unit."""

    kind: Literal["field"] = "field"
    range_m: Annotated[tuple[NotNegative, NotNegative], AfterValidator(check_ascending)]
    azimuth_deg: Annotated[tuple[Number, Number], AfterValidator(check_one_turn)] = (-180.0, 180.0)

    def places_m(self, uniform: Float, length_m: Float, width_m: Float) -> Float:
        """Radius √(a² + u (b² − a²)), so that equal areas have equally many."""
        near_m, far_m = self.range_m
        first, last = np.deg2rad(self.azimuth_deg)
        span = last - first if last - first >= 2 * np.pi - 1e-9 else np.mod(last - first, 2 * np.pi)
        range_m, azimuth_rad = np.sqrt(near_m**2 + uniform[0] * (far_m**2 - near_m**2)), first + span * uniform[1]
        return np.stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad)])


class GivenPlaces(GhostPlace):
    """At one of the given places in the world frame of the log, with a normal spread around it."""

    kind: Literal["places"] = "places"
    frame: ClassVar[Frame] = "world"
    at_m: Annotated[tuple[tuple[Number, Number], ...], Field(min_length=1)]
    spread_m: NotNegative = 0.0

    def places_m(self, uniform: Float, length_m: Float, width_m: Float) -> Float:
        """Each place equally probable, with a standard deviation of `spread_m` in easting and in northing."""
        which = np.minimum((uniform[2] * len(self.at_m)).astype(np.int64), len(self.at_m) - 1)
        from scipy.special import ndtri  # here, as its import takes long

        places: Float = np.array(self.at_m)[which].T + self.spread_m * ndtri(uniform[:2])
        return places


Rings = tuple[tuple[tuple[float, float], ...], ...]


class AreaPlace(GhostPlace):
    """Uniform over the union of areas by name or kind: your own, and those of maps."""

    kind: Literal["area"] = "area"
    frame: ClassVar[Frame] = "world"
    areas: Annotated[tuple[Id, ...], Field(min_length=1)]
    _polygons_m: tuple[Rings, ...] = PrivateAttr(())  # of the log, set by `over`

    def over(self, polygons_m: Iterable[Rings]) -> Self:
        """The place with the polygons of its areas."""
        copy = self.model_copy()
        copy._polygons_m = tuple(polygons_m)
        return copy

    def places_m(self, uniform: Float, length_m: Float, width_m: Float) -> Float:
        """Places in a triangle chosen by area with the third number, at a point chosen by the two others."""
        corners_m, until = _cut_into_triangles(self._polygons_m)
        a, b, c = corners_m[:, :, np.searchsorted(until, uniform[2])]
        far = np.sqrt(uniform[0])
        places: Float = a + far * (b - a) + far * uniform[1] * (c - b)
        return places


@lru_cache(maxsize=16)
def _cut_into_triangles(polygons_m: tuple[Rings, ...]) -> tuple[Float, Float]:
    """Triangles (3, 2, T) that cover polygons, and the share (T,) of the area up to each; in order of their places."""
    import shapely

    parts = shapely.get_parts(shapely.union_all([make_polygon(rings) for rings in polygons_m]))
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(parts[shapely.area(parts) > 0]))
    corners_m = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    order = np.lexsort(corners_m.reshape(-1, 6).T)
    until = np.cumsum(shapely.area(triangles)[order])
    return corners_m[order].transpose(1, 2, 0), until / until[-1]


class ObjectSidePlace(GhostPlace):
    """Uniform around objects of the given classes that the unit could list, within a distance of their sides."""

    kind: Literal["beside"] = "beside"
    frame: ClassVar[Frame] = "object"
    classes: ClassNames
    within_m: Positive

    def places_m(self, uniform: Float, length_m: Float, width_m: Float) -> Float:
        """Uniform over the object's box, widened by `within_m` on all sides."""
        sides_m = np.stack([length_m, width_m]) + 2 * self.within_m
        return (uniform[:2] - 0.5) * sides_m


PLACES = {
    "field": "copem_replay.perception.pem.model:FieldPlace",
    "places": "copem_replay.perception.pem.model:GivenPlaces",
    "area": "copem_replay.perception.pem.model:AreaPlace",
    "beside": "copem_replay.perception.pem.model:ObjectSidePlace",
}
"""Built-in names of `ghosts: [{where: {kind: …}}]`."""

MeanNumber = Annotated[float, Field(strict=True, ge=0, le=1000)]
"""Mean number of ghosts in a list."""


class GhostModel(Frozen):
    """One sort of ghosts: on average `in_list` of them in a list (Poisson), each for `lasts_s` (exponential).

    Both are the same at any list rate. `lasts_s: 0`: new ghosts in every list. With `beside`, `in_list` counts for each
    such object. `classes`: the listed classes, by default pedestrian (chosen: `other` counts as false only where such
    objects are measured). `existence`: the claimed existence, by default that of the couple that applies.
    """

    in_list: MeanNumber
    lasts_s: Annotated[float, Field(strict=True, ge=0, le=86_400)] = 0.0
    where: Annotated[GhostPlace, Slot("ghosts", PLACES)]
    classes: Shares = Field(default_factory=lambda: {"pedestrian": 1.0})
    existence: Claimed | None = Field(default=None, exclude_if=lambda existence: existence is None)

    @field_validator("lasts_s")
    @classmethod
    def _long_enough(cls, value: float) -> float:
        if 0 < value < 0.001:
            raise ValueError(f"expected 0 (others in every list) or at least 0.001, found {value:g}")
        return value


class TrackIds(Frozen):
    """A unit keeps an id of each object, `lasts_s` on average until it switches to a new one (exponential).

    Objects never swap ids.
    """

    lasts_s: Annotated[float, Field(strict=True, ge=0.001, le=86_400)]


_OF_A_COUPLE = frozenset(Couple.model_fields) - {"memory"}


class Pem(Frozen):
    """A perception error model: ordered couples, the first that applies is used, and the `memory` of their draws."""

    couples: Annotated[tuple[Couple, ...], Field(min_length=1)]
    memory: Memory = Field(default_factory=dict, exclude_if=lambda memory: not memory)
    ghosts: tuple[GhostModel, ...] = Field(default=(), exclude_if=lambda ghosts: not ghosts)
    classes: ListedClasses | None = Field(default=None, exclude_if=lambda classes: classes is None)
    tracks: TrackIds | None = Field(default=None, exclude_if=lambda tracks: tracks is None)

    @model_validator(mode="before")
    @classmethod
    def _short(cls, value: object) -> object:
        if isinstance(value, list | tuple):
            return {"couples": value}
        is_couple = isinstance(value, Mapping) and "couples" not in value and value.keys() & _OF_A_COUPLE
        if is_couple or not isinstance(value, Mapping | cls):
            found = "nothing" if value is None else repr(value)
            found = found if len(found) <= 60 else found[:57] + "…"
            raise ValueError(f"expected a list, found {found}; of couples (each begins with `- `), or `couples: […]`")
        return value

    @model_validator(mode="after")
    def _asked(self) -> Self:
        if self.memory.keys() - set(QUANTITIES):
            check_quantities(self.memory, self.asked(), "PEM")
        return self

    @model_serializer(mode="wrap")
    def _as_list(self, handler: SerializerFunctionWrapHandler) -> Any:
        written = handler(self)
        return written["couples"] if written.keys() == {"couples"} else written

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """JSON Schema: both forms."""
        schema = handler(core_schema)
        return {"anyOf": [handler.resolve_ref_schema(schema)["properties"]["couples"], schema]}

    def asked(self) -> frozenset[str] | None:
        """The quantities that its error models draw; None where a user's own model does not say."""
        by_couple = [couple.asked() for couple in self.couples]
        return (
            None if None in by_couple else frozenset[str]().union(*(names for names in by_couple if names is not None))
        )

    def memory_of(self, couple: int) -> Mapping[str, Parts]:
        """The memory of a couple's draws: its own `memory`, or else that of the PEM."""
        own = self.couples[couple].memory
        return self.memory if own is None else own

    @property
    def draws_claims(self) -> bool:
        """Whether claims of entries beside their states, or ghosts, are drawn."""
        return self._scores or bool(self.ghosts) or self.classes is not None or self.tracks is not None

    @property
    def _scores(self) -> bool:
        claims = [*(couple.existence for couple in self.couples), *(sort.existence for sort in self.ghosts)]
        return any(isinstance(existence, ExistenceScores) for existence in claims)

    @property
    def ghosts_in_list(self) -> float:
        """Mean number of ghosts in a list; of ghosts beside objects as if there were one object."""
        return sum(sort.in_list for sort in self.ghosts)

    @property
    def remembers(self) -> bool:
        """Whether any draw lasts."""
        return any(self.memory_of(c) for c in range(len(self.couples)))

    def in_vain(self) -> Iterator[str]:
        """Quantities in `memory` that no couple draws."""
        noise_names = self.asked()
        drawn = {"detection", *(noise_names or ())}
        drawn |= {"class"} if self.classes is not None and self.classes.confusion else set()
        drawn |= {"existence"} if self._scores else set()
        for name in self.memory if noise_names is not None else ():
            if name not in drawn:
                yield name
