"""The couples of a PEM: a condition, a detection model and an error model; the first that applies is used."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from copem_replay.core.components import Frozen, NotNegative, Number, Share, Slot
from copem_replay.core.memory import Memory
from copem_replay.core.tracks import CLASS_GROUPS, CLASSES, Bool, Float, Int, class_indices
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.perception.pem.detection import DETECTION_MODELS, DetectionModel
from copem_replay.perception.pem.error import ERROR_MODELS, ErrorModel, names_asked
from copem_replay.perception.pem.memory import QUANTITIES, check_names, quantity_of
from copem_replay.perception.pem.scores import Claimed

_ON_THE_BOUND = 1e-9
"""Bounds are included; a value this far outside is on the bound (metres, radians, shares)."""


def ascending(value: tuple[float, float]) -> tuple[float, float]:
    """Validate that a range ends where it begins, or later."""
    if value[1] < value[0]:
        raise ValueError(f"expected [from, to] with from ≤ to, found {list(value)}")
    return value


def one_turn(value: tuple[float, float]) -> tuple[float, float]:
    """Validate that angles are within one turn."""
    beyond = [angle for angle in value if abs(angle) > 360]
    if beyond:
        raise ValueError(f"expected degrees from -360 to 360, found {beyond[0]:g} (through 0: [350, 10])")
    return value


def _class_name(value: str) -> str:
    if value not in CLASSES and value not in CLASS_GROUPS:
        known = ", ".join([*CLASSES, *CLASS_GROUPS])
        raise ValueError(f"expected one of {known}; found {value!r}")
    return value


ClassName = Annotated[str, AfterValidator(_class_name)]
ClassNames = Annotated[tuple[ClassName, ...], Field(min_length=1)]


class Condition(Frozen):
    """When a couple applies. All given keys must hold; bounds are included."""

    range_m: Annotated[tuple[NotNegative, NotNegative], AfterValidator(ascending)] | None = None
    azimuth_deg: Annotated[tuple[Number, Number], AfterValidator(one_turn)] | None = None
    classes: ClassNames | None = None
    visible_share: Annotated[tuple[Share, Share], AfterValidator(ascending)] | None = None

    def holds(self, view: ViewGeometry) -> Bool:
        """(P,) where the condition holds."""
        result = np.ones(len(view.range_m), dtype=bool)
        if self.range_m is not None:
            result &= _within(view.range_m, *self.range_m)
        if self.azimuth_deg is not None:
            first, last = np.deg2rad(self.azimuth_deg)
            if last - first < 2 * np.pi - _ON_THE_BOUND:  # [150, −150] runs through 180
                span = np.mod(last - first, 2 * np.pi)
                turned = np.mod(view.azimuth_rad - first + _ON_THE_BOUND, 2 * np.pi)
                result &= turned <= span + 2 * _ON_THE_BOUND
        if self.classes is not None:
            result &= np.isin(view.class_ix, class_indices(self.classes))
        if self.visible_share is not None:
            result &= _within(view.visible_share, *self.visible_share)
        return result


def _within(value: Float, low: float, high: float) -> Bool:
    return (value >= low - _ON_THE_BOUND) & (value <= high + _ON_THE_BOUND)


class Couple(Frozen):
    """A detection and an error model that apply under a condition. Without `error` the state is exact.

    `existence`: the probability that there is an object, as the unit claims it: one value for all entries (0.9 is
    chosen), the visible share, or drawn for each entry (`scores`). `memory`: which draws last where this couple
    applies, instead of the PEM's memory.
    """

    when: Condition = Condition()
    detection: Annotated[DetectionModel, Slot("detection", DETECTION_MODELS)]
    error: Annotated[ErrorModel, Slot("error", ERROR_MODELS)] | None = None
    existence: Claimed = 0.9
    memory: Memory | None = Field(default=None, exclude_if=lambda memory: memory is None)

    @model_validator(mode="after")
    def _asked(self) -> Self:
        if self.memory is not None and self.memory.keys() - set(QUANTITIES):
            check_names(self.memory, self.asked(), "couple")
        return self

    def asked(self) -> frozenset[str] | None:
        """The quantities that its error model draws; None where one of the user's own does not say."""
        names = frozenset[str]() if self.error is None else names_asked(self.error)
        return None if names is None else frozenset(map(quantity_of, names))


def applies(couples: tuple[Couple, ...], view: ViewGeometry) -> Int:
    """(P,) index of the couple that applies to each row, −1 where none does (then it is not detected)."""
    chosen = np.full(len(view.range_m), -1)
    for k, couple in enumerate(couples):
        chosen[(chosen < 0) & couple.when.holds(view)] = k
    return chosen
