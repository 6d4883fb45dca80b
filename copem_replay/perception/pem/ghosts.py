"""Ghosts: entries about no object. Keys: how many there are, how long they last, where they are, and their classes.

What comes of them in a run: `perception/ghosts.py`. docs/guide/unit-errors.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator

from copem_replay.core.components import Component, Frozen, NotNegative, Number, Positive, Slot
from copem_replay.core.tracks import Float
from copem_replay.perception.pem.classes import Shares
from copem_replay.perception.pem.condition import ClassNames, ascending, one_turn
from copem_replay.perception.pem.scores import Claimed

Frame = Literal["unit", "world", "object"]


class GhostPlace(Component, ABC):
    """Where ghosts are: at a place that is drawn at birth, in the frame of the unit, of the world or of an object."""

    frame: ClassVar[Frame] = "unit"

    @abstractmethod
    def places_m(self, uniform: Float, length_m: Float, width_m: Float) -> Float:
        """(2, B) where ghosts are in the frame, ahead and to the left (of the world: east and north).

        `uniform` (3, B): of each ghost three, in (0, 1). `length_m`, `width_m` (B,): of the object beside which it is.
        """


class InField(GhostPlace):
    """Uniform over the area of a field of view, which moves with the unit."""

    kind: Literal["field"] = "field"
    range_m: Annotated[tuple[NotNegative, NotNegative], AfterValidator(ascending)]
    azimuth_deg: Annotated[tuple[Number, Number], AfterValidator(one_turn)] = (-180.0, 180.0)

    def places_m(self, uniform: Float, length_m: Float, width_m: Float) -> Float:
        """Radius √(a² + u (b² − a²)), so that equal areas have equally many."""
        near_m, far_m = self.range_m
        first, last = np.deg2rad(self.azimuth_deg)
        span = last - first if last - first >= 2 * np.pi - 1e-9 else np.mod(last - first, 2 * np.pi)
        range_m, azimuth_rad = np.sqrt(near_m**2 + uniform[0] * (far_m**2 - near_m**2)), first + span * uniform[1]
        return np.stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad)])


class AtPlaces(GhostPlace):
    """At one of the given places in the world frame of the log, with a normal spread around it."""

    kind: Literal["places"] = "places"
    frame: ClassVar[Frame] = "world"
    at_m: Annotated[tuple[tuple[Number, Number], ...], Field(min_length=1)]
    spread_m: NotNegative = 0.0

    def places_m(self, uniform: Float, length_m: Float, width_m: Float) -> Float:
        """A place alike for all, and a standard deviation of `spread_m` in easting and in northing."""
        which = np.minimum((uniform[2] * len(self.at_m)).astype(np.int64), len(self.at_m) - 1)
        from scipy.special import ndtri  # it takes long to import

        places: Float = np.array(self.at_m)[which].T + self.spread_m * ndtri(uniform[:2])
        return places


class Beside(GhostPlace):
    """Uniform around objects of the given classes that the unit could list, within a distance of their sides."""

    kind: Literal["beside"] = "beside"
    frame: ClassVar[Frame] = "object"
    classes: ClassNames
    within_m: Positive

    def places_m(self, uniform: Float, length_m: Float, width_m: Float) -> Float:
        """Alike over the object's box, widened on all sides."""
        sides_m = np.stack([length_m, width_m]) + 2 * self.within_m
        return (uniform[:2] - 0.5) * sides_m


PLACES = {
    "field": "copem_replay.perception.pem.ghosts:InField",
    "places": "copem_replay.perception.pem.ghosts:AtPlaces",
    "beside": "copem_replay.perception.pem.ghosts:Beside",
}


MeanNumber = Annotated[float, Field(strict=True, ge=0, le=1000)]
"""How many there are on average."""


class Ghosts(Frozen):
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
