"""Latency models: how long it takes from one instant to another. They invert a distribution and never draw."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema

from copem_replay.core.components import Component, GivenError, Latency, Positive, Slot, asked
from copem_replay.core.tracks import Float


class LatencyModel(Component, ABC):
    """Base of latency models, of a link's `latency` and of a unit's `ready`.

    >>> class Uniform(cr.LatencyModel):
    ...     def delays(self, uniform):
    ...         return 0.02 + 0.06 * uniform
    >>> Uniform(kind="my_package.links:Uniform").delays(np.array([0.5]))
    array([0.05])
    """

    @abstractmethod
    def delays(self, uniform: Float) -> Float:
        """(K,) seconds for uniform numbers (K,) in (0, 1): the inverse of their distribution, never decreasing."""

    @property
    def fixed_s(self) -> float | None:
        """What it always is; None: it is drawn."""
        return None


def delays_of(model: LatencyModel, uniform: Float, where: str) -> Float:
    """(K,) what a model says, checked. Raises InputError, naming `where` it stands, where these are no delays."""

    def checked() -> Float:
        found = model.delays(uniform)
        if not isinstance(found, np.ndarray) or found.shape != uniform.shape:
            said = found.shape if isinstance(found, np.ndarray) else type(found).__name__
            raise GivenError("delays", f"expected shape {uniform.shape}, found {said}")
        if found.dtype.kind not in "fiu" or not ((found >= 0) & (found < np.inf)).all():
            raise GivenError("delays", "expected seconds of 0 or more, found others")
        return found

    return asked(model, where, checked)


class ConstantLatency(LatencyModel):
    """The same every time."""

    kind: Literal["constant"] = "constant"
    s: Latency = 0.0

    def delays(self, uniform: Float) -> Float:
        """(K,) all the same."""
        return np.full(len(uniform), self.s)

    @property
    def fixed_s(self) -> float:
        """What it always is."""
        return self.s


class GammaLatency(LatencyModel):
    """`min_s` plus a gamma distributed time; the mean of the sum is `mean_s`."""

    kind: Literal["gamma"] = "gamma"
    min_s: Latency = 0.0
    mean_s: Latency
    shape: Annotated[float, Field(strict=True, ge=0.01, le=1e6)]

    @model_validator(mode="after")
    def _beyond(self) -> Self:
        if self.mean_s <= self.min_s:
            raise ValueError(f"mean_s: expected more than min_s ({self.min_s:g}), found {self.mean_s:g}")
        return self

    def delays(self, uniform: Float) -> Float:
        """(K,) quantiles."""
        from scipy.special import gammaincinv  # it takes long to import

        result: Float = self.min_s + (self.mean_s - self.min_s) / self.shape * gammaincinv(self.shape, uniform)
        return result


class LognormalLatency(LatencyModel):
    """`min_s` plus a log-normal time with median `median_s` and standard deviation `sigma` of its logarithm."""

    kind: Literal["lognormal"] = "lognormal"
    min_s: Latency = 0.0
    median_s: Positive
    sigma: Annotated[float, Field(strict=True, ge=0, le=10)]

    def delays(self, uniform: Float) -> Float:
        """(K,) quantiles."""
        from scipy.special import ndtri  # as above

        result: Float = self.min_s + self.median_s * np.exp(self.sigma * ndtri(uniform))
        return result


LATENCIES = {
    "constant": "copem_replay.communication.latency:ConstantLatency",
    "gamma": "copem_replay.communication.latency:GammaLatency",
    "lognormal": "copem_replay.communication.latency:LognormalLatency",
    "recorded": "copem_replay.experiment.recorded_latency:RecordedLatency",  # reads recordings
}


def _seconds(value: object) -> object:
    return {"kind": "constant", "s": value} if isinstance(value, int | float) and not isinstance(value, bool) else value


class _OrSeconds:
    """JSON Schema: a number stands beside the components."""

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [{"type": "number", "minimum": 0, "maximum": 86_400}, *handler(schema)["anyOf"]]}


Delay = Annotated[LatencyModel, Slot("latency", LATENCIES), BeforeValidator(_seconds), _OrSeconds()]
"""A latency model; a number is a constant one."""
