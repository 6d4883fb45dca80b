"""Reception models: the probability that a list arrives. They never draw."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Protocol, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from copem_replay.core.components import Component, GivenError, NotNegative, Number, Positive, Share, ask_component
from copem_replay.core.interpolation import check_grid, interpolate_bilinear
from copem_replay.core.tracks import Float

NEAR_M = 3.0
"""Metres; nearer than this the path loss does not change, as the logarithm of a distance has no lower end."""
BLOCKED = 0.05
"""A path is blocked where less than this share of the receiver shows: a sliver beside a corner is no free path. Larger:
more paths get `blocked_db`."""


@dataclass(frozen=True)
class RadioPath:
    """The way of each list (F,) from its unit to the receiver, the ego, when it was captured.

    `visible_share`: how much of the ego shows from the unit: what blocks sight blocks radio. A unit on the ego has
    distance 0 and share 1; where the log has no ego at that instant the distance is inf. NaN: not known.

    >>> cr.RadioPath(distance_m=np.array([120.0]), visible_share=np.array([0.4])).visible_share
    array([0.4])
    """

    distance_m: Float
    visible_share: Float


class UniformNoise(Protocol):
    """Uniform numbers in (0, 1) by name, (1, F): one for each list."""

    def __call__(self, name: str, *, lasts_s: float | None = None) -> Float:
        """New in every list, or as the link's `memory` says; with `lasts_s` below any number for so long on average."""


class ReceptionModel(Component, ABC):
    """Base of reception models, of a link's `reception`.

    >>> class Within(cr.ReceptionModel):
    ...     radius_m: float
    ...     def probability(self, path, noise):
    ...         return np.where(path.distance_m < self.radius_m, 0.95, 0.2)
    >>> path = cr.RadioPath(np.array([100.0]), np.array([1.0]))
    >>> Within(kind="my_package.links:Within", radius_m=150).probability(path, None)
    array([0.95])
    """

    by_path: ClassVar[bool] = True
    """Whether it asks for the path: then the log needs a receiver, and units places."""

    @abstractmethod
    def probability(self, path: RadioPath, noise: UniformNoise) -> Float:
        """(F,) probability that each list arrives, 0 … 1, or (1, F); it may depend on numbers that `noise(name)` draws.

        `noise(name)` is (1, F): uniform numbers, one for each list.
        """


def ask_reception_probability(model: ReceptionModel, path: RadioPath, noise: UniformNoise, where: str) -> Float:
    """(F,) the probabilities that a model gives, checked. Raises InputError, naming `where` it stands, for others."""
    expected = path.distance_m.shape

    def checked() -> Float:
        probability = np.asarray(model.probability(path, noise), dtype=float)
        if probability.shape not in (expected, (1, *expected)):
            raise GivenError("probability", f"expected shape {(1, *expected)}, found {probability.shape}")
        beyond = ~((probability >= 0) & (probability <= 1 + 1e-12))
        if beyond.any():
            raise GivenError("probability", f"expected 0 … 1, found {probability[beyond][0]}")
        return probability.reshape(expected)

    return ask_component(model, where, checked)


class ConstantReception(ReceptionModel):
    """The same probability, wherever the sender is."""

    by_path: ClassVar[bool] = False

    kind: Literal["constant"] = "constant"
    probability_: Annotated[Share, Field(alias="probability")] = 1.0

    def probability(self, path: RadioPath, noise: UniformNoise) -> Float:
        """(F,) `probability` everywhere."""
        return np.full(len(path.distance_m), self.probability_)


class TableReception(ReceptionModel):
    """By distance and visible share of the receiver, bilinear between the given values, constant beyond them.

    `probability[i][j]` belongs to `distance_m[i]` and `visible_share[j]`; without `visible_share`, `probability[i]`.
    """

    kind: Literal["table"] = "table"
    distance_m: Annotated[tuple[NotNegative, ...], Field(min_length=1)]
    visible_share: Annotated[tuple[Share, ...], Field(min_length=1)] = (0.0,)
    probability_: Annotated[tuple[tuple[Share, ...], ...], Field(alias="probability")]

    @field_validator("probability_", mode="before")
    @classmethod
    def _columns(cls, rows: object) -> object:
        alone = isinstance(rows, list | tuple) and rows and not any(isinstance(row, list | tuple) for row in rows)
        return [[row] for row in rows] if alone else rows  # type: ignore[attr-defined]

    @model_validator(mode="after")
    def _shape(self) -> Self:
        check_grid(
            ("distance_m", self.distance_m), ("visible_share", self.visible_share), "probability", self.probability_
        )
        return self

    def probability(self, path: RadioPath, noise: UniformNoise) -> Float:
        """(F,) the table, interpolated."""
        distance_m = np.minimum(path.distance_m, self.distance_m[-1])
        return interpolate_bilinear(
            self.distance_m, self.visible_share, self.probability_, distance_m, path.visible_share
        )


class Shadowing(ReceptionModel):
    """Path loss by distance, and log-normal shadowing: Φ((10 n lg(d₅₀ / d) − b) / σ); b is 0 if the path is free.

    Source: eq. (13) of Sepulcre et al., "Analytical models of the performance of IEEE 802.11p vehicle to vehicle
    communications", IEEE Trans. Veh. Technol. 71 (2022), with the distance at which half of the lists arrive instead of
    power, sensitivity and the path loss of a metre.
    """

    kind: Literal["shadowing"] = "shadowing"
    half_at_m: Positive
    exponent: Positive
    sigma_db: Positive
    blocked_db: Number = 0.0

    def probability(self, path: RadioPath, noise: UniformNoise) -> Float:
        """(F,) the probability that the shadowing leaves enough."""
        with np.errstate(divide="ignore"):
            margin_db = 10 * self.exponent * np.log10(self.half_at_m / np.maximum(path.distance_m, NEAR_M))
        margin_db = margin_db - np.where(path.visible_share < BLOCKED, self.blocked_db, 0.0)
        from scipy.special import ndtr  # here, as its import takes long

        result: Float = ndtr(margin_db / self.sigma_db)
        return result


class GilbertElliott(ReceptionModel):
    """Two states, good and bad, each with its own loss; `bad_share` of the time is bad, for `bad_lasts_s` on average.

    Source: Gilbert, "Capacity of a burst-noise channel", Bell Syst. Tech. J. 39 (1960); Elliott, ibid. 42 (1963). It is
    in continuous time, so the channel is the same at any list rate.
    """

    by_path: ClassVar[bool] = False

    kind: Literal["gilbert_elliott"] = "gilbert_elliott"
    good_loss: Share = 0.0
    bad_loss: Share = 1.0
    bad_share: Share
    bad_lasts_s: Annotated[float, Field(strict=True, ge=0.001, le=86_400)]

    def probability(self, path: RadioPath, noise: UniformNoise) -> Float:
        """(1, F) 1 less the loss in the state of the channel."""
        bad = noise("state", lasts_s=self.bad_lasts_s) < self.bad_share
        return 1 - np.where(bad, self.bad_loss, self.good_loss)


RECEPTIONS = {
    "constant": "copem_replay.communication.reception:ConstantReception",
    "table": "copem_replay.communication.reception:TableReception",
    "shadowing": "copem_replay.communication.reception:Shadowing",
    "gilbert_elliott": "copem_replay.communication.reception:GilbertElliott",
}
"""Built-in names of `reception: {kind: …}`."""
