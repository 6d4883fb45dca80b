"""Detection models: is an object listed? They return a probability and never draw."""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from copem_replay.core.components import Component, NotNegative, Share, asked, wrong
from copem_replay.core.tracks import Float
from copem_replay.core.view_geometry import ViewGeometry


class DetectionModel(Component, ABC):
    """Base of detection models.

    >>> class Fading(cr.DetectionModel):
    ...     def probability(self, view):
    ...         return view.visible_share * np.exp2(-view.range_m / 50.0)
    >>> view = cr.ViewGeometry(*np.full((10, 1), 1.0))
    >>> Fading(kind="my_package.models:Fading").probability(view).round(3)
    array([0.986])
    """

    @abstractmethod
    def probability(self, view: ViewGeometry) -> Float:
        """(P,) probability that each row is listed, 0 … 1."""


def probability_of(model: DetectionModel, view: ViewGeometry, where: str) -> Float:
    """(P,) what a model says, checked. Raises InputError, naming `where` it stands, when it is no probability."""
    found = asked(model, where, lambda: np.asarray(model.probability(view), dtype=float))
    expected = (len(view.range_m),)
    if found.shape != expected:
        raise wrong(model, where, f"probability(view): expected shape {expected}, found {found.shape}", "probability")
    beyond = ~((found >= 0) & (found <= 1 + 1e-12))
    if beyond.any():
        raise wrong(model, where, f"probability(view): expected 0 … 1, found {found[beyond][0]}", "probability")
    return found


class VisibleShare(DetectionModel):
    """Detected with the probability of the visible share (the paper's d(o) in its occlusion experiment)."""

    kind: Literal["visible_share"] = "visible_share"

    def probability(self, view: ViewGeometry) -> Float:
        """(P,) the visible share itself."""
        return view.visible_share


class Constant(DetectionModel):
    """Detected with one probability wherever the condition holds."""

    kind: Literal["constant"] = "constant"
    probability_: Annotated[Share, Field(alias="probability")]

    def probability(self, view: ViewGeometry) -> Float:
        """(P,) all the same."""
        return np.full(len(view.range_m), self.probability_)


class Table(DetectionModel):
    """Detection probability by range and visible share, bilinear between the given values, constant beyond them.

    `probability[i][j]` belongs to `range_m[i]` and `visible_share[j]`. Either axis may be left out.
    """

    kind: Literal["table"] = "table"
    range_m: Annotated[tuple[NotNegative, ...], Field(min_length=1)] = (0.0,)
    visible_share: Annotated[tuple[Share, ...], Field(min_length=1)] = (0.0,)
    probability_: Annotated[tuple[tuple[Share, ...], ...], Field(alias="probability")]

    @model_validator(mode="after")
    def _shape(self) -> Self:
        for name in ("range_m", "visible_share"):
            axis = getattr(self, name)
            if any(b <= a for a, b in pairwise(axis)):
                raise ValueError(f"{name}: expected increasing values, found {list(axis)}")
        expected = (len(self.range_m), len(self.visible_share))
        widths = {len(row) for row in self.probability_}
        if len(self.probability_) != expected[0] or widths != {expected[1]}:
            raise ValueError(
                f"probability: expected {expected[0]} rows (range_m) of {expected[1]} values (visible_share), "
                f"found {len(self.probability_)} rows of {sorted(widths)}"
            )
        return self

    def probability(self, view: ViewGeometry) -> Float:
        """(P,) interpolated."""
        table = np.array(self.probability_)
        i, a = _place(np.array(self.range_m), view.range_m)
        j, b = _place(np.array(self.visible_share), view.visible_share)
        i1, j1 = np.minimum(i + 1, table.shape[0] - 1), np.minimum(j + 1, table.shape[1] - 1)
        low = table[i, j] * (1 - b) + table[i, j1] * b
        high = table[i1, j] * (1 - b) + table[i1, j1] * b
        result: Float = low * (1 - a) + high * a
        return result


def _place(axis: Float, value: Float) -> tuple[np.ndarray, Float]:
    """Cell (P,) and place within it (P,), 0 … 1, of values on an ascending axis; the ends hold beyond them."""
    if len(axis) == 1:
        return np.zeros(len(value), dtype=int), np.zeros(len(value))
    cell = np.clip(np.searchsorted(axis, value, side="right") - 1, 0, len(axis) - 2)
    return cell, np.clip((value - axis[cell]) / (axis[cell + 1] - axis[cell]), 0.0, 1.0)


DETECTION_MODELS = {
    "visible_share": "copem_replay.perception.pem.detection:VisibleShare",
    "constant": "copem_replay.perception.pem.detection:Constant",
    "table": "copem_replay.perception.pem.detection:Table",
}
