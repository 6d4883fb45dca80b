"""Detection models: the probability that an object is listed. They never draw."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from copem_replay.core.components import Component, NotNegative, Share, ask_numbers
from copem_replay.core.interpolation import check_grid, interpolate_bilinear
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


def ask_detection_probability(model: DetectionModel, view: ViewGeometry, where: str) -> Float:
    """(P,) the probabilities that a model gives, checked. Raises InputError, naming `where` it stands, for others."""
    shape = (len(view.range_m),)
    return ask_numbers(model, where, "probability(view)", lambda: model.probability(view), shape, "0 … 1", 1 + 1e-12)


class VisibleShare(DetectionModel):
    """Detected with the probability of the visible share (the paper's d(o) in its occlusion experiment)."""

    kind: Literal["visible_share"] = "visible_share"

    def probability(self, view: ViewGeometry) -> Float:
        """(P,) the visible share itself."""
        return view.visible_share


class ConstantDetection(DetectionModel):
    """Detected with the same probability wherever the condition holds."""

    kind: Literal["constant"] = "constant"
    probability_: Annotated[Share, Field(alias="probability")]

    def probability(self, view: ViewGeometry) -> Float:
        """(P,) `probability` everywhere."""
        return np.full(len(view.range_m), self.probability_)


class TableDetection(DetectionModel):
    """Detection probability by range and visible share, bilinear between the given values, constant beyond them.

    `probability[i][j]` belongs to `range_m[i]` and `visible_share[j]`. Either axis may be left out.
    """

    kind: Literal["table"] = "table"
    range_m: Annotated[tuple[NotNegative, ...], Field(min_length=1)] = (0.0,)
    visible_share: Annotated[tuple[Share, ...], Field(min_length=1)] = (0.0,)
    probability_: Annotated[tuple[tuple[Share, ...], ...], Field(alias="probability")]

    @model_validator(mode="after")
    def _shape(self) -> Self:
        check_grid(("range_m", self.range_m), ("visible_share", self.visible_share), "probability", self.probability_)
        return self

    def probability(self, view: ViewGeometry) -> Float:
        """(P,) the table, interpolated."""
        return interpolate_bilinear(
            self.range_m, self.visible_share, self.probability_, view.range_m, view.visible_share
        )


DETECTION_MODELS = {
    "visible_share": "copem_replay.perception.pem.detection:VisibleShare",
    "constant": "copem_replay.perception.pem.detection:ConstantDetection",
    "table": "copem_replay.perception.pem.detection:TableDetection",
}
"""Built-in names of `detection: {kind: …}`."""
