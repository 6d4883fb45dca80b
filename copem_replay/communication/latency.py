"""Latency models: how long it takes from one instant to another. They invert a distribution and never draw."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema

from copem_replay.core.components import Component, GivenError, Latency, Positive, Slot, ask_component
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
        """The delay where it is always the same; None: it is drawn."""
        return None


def ask_delays(model: LatencyModel, uniform: Float, where: str) -> Float:
    """(K,) the delays that a model gives, checked. Raises InputError, naming `where` it stands, where they are none."""

    def checked() -> Float:
        delays = model.delays(uniform)
        if not isinstance(delays, np.ndarray) or delays.shape != uniform.shape:
            found = delays.shape if isinstance(delays, np.ndarray) else type(delays).__name__
            raise GivenError("delays", f"expected shape {uniform.shape}, found {found}")
        if delays.dtype.kind not in "fiu" or not ((delays >= 0) & (delays < np.inf)).all():
            raise GivenError("delays", "expected seconds of 0 or more, found others")
        return delays

    return ask_component(model, where, checked)


class ConstantLatency(LatencyModel):
    """The same every time."""

    kind: Literal["constant"] = "constant"
    s: Latency = 0.0

    def delays(self, uniform: Float) -> Float:
        """(K,) `s` everywhere."""
        return np.full(len(uniform), self.s)

    @property
    def fixed_s(self) -> float:
        """Always `s`."""
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
        """(K,) quantiles of the distribution."""
        from scipy.special import gammaincinv  # here, as its import takes long

        result: Float = self.min_s + (self.mean_s - self.min_s) / self.shape * gammaincinv(self.shape, uniform)
        return result


class LognormalLatency(LatencyModel):
    """`min_s` plus a log-normal time with median `median_s` and standard deviation `sigma` of its logarithm."""

    kind: Literal["lognormal"] = "lognormal"
    min_s: Latency = 0.0
    median_s: Positive
    sigma: Annotated[float, Field(strict=True, ge=0, le=10)]

    def delays(self, uniform: Float) -> Float:
        """(K,) quantiles of the distribution."""
        from scipy.special import ndtri  # here, as its import takes long

        result: Float = self.min_s + self.median_s * np.exp(self.sigma * ndtri(uniform))
        return result


LATENCIES = {
    "constant": "copem_replay.communication.latency:ConstantLatency",
    "gamma": "copem_replay.communication.latency:GammaLatency",
    "lognormal": "copem_replay.communication.latency:LognormalLatency",
    "recorded": "copem_replay.experiment.drive:RecordedLatency",  # reads recordings
}
"""Built-in names of `latency: {kind: …}`."""


def _as_constant_latency(value: object) -> object:
    return {"kind": "constant", "s": value} if isinstance(value, int | float) and not isinstance(value, bool) else value


class _NumberSchema:
    """JSON Schema: a number stands beside the components."""

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [{"type": "number", "minimum": 0, "maximum": 86_400}, *handler(schema)["anyOf"]]}


Delay = Annotated[LatencyModel, Slot("latency", LATENCIES), BeforeValidator(_as_constant_latency), _NumberSchema()]
"""A latency model; a number is a constant one."""
