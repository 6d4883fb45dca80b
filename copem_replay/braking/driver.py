"""Driver models: what the ego does once an object is known. They say how late and how hard, and never draw.

A driver reacts after a delay and then brakes along its path; it does not steer. It is declared, not observed: a verdict
is that of the declared driver.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from copem_replay.components import Component, NotNegative, Positive, Slot, asked, wrong
from copem_replay.tracks import Float

_SHORTEST_S = 0.05
"""A deceleration that builds up faster than this is taken to be there at once (chosen: 5 steps)."""


class Reaction(Component, ABC):
    """Base of reaction models: seconds from the instant a list is available until the ego begins to brake."""

    @abstractmethod
    def delays(self, uniform: Float) -> Float:
        """(K,) seconds for uniform numbers (K,) in (0, 1): the inverse of their distribution, never decreasing."""


class ConstantReaction(Reaction):
    """The same delay every time."""

    kind: Literal["constant"] = "constant"
    delay_s: NotNegative = 0.0

    def delays(self, uniform: Float) -> Float:
        """(K,) all the same."""
        return np.full(len(uniform), self.delay_s)


class GammaReaction(Reaction):
    """Gamma distributed delays, by shape and mean."""

    kind: Literal["gamma"] = "gamma"
    shape: Annotated[float, Field(strict=True, ge=0.01, le=1e6)]
    mean_s: Positive

    def delays(self, uniform: Float) -> Float:
        """(K,) quantiles of the gamma distribution."""
        from scipy.special import gammaincinv

        result: Float = gammaincinv(self.shape, uniform) * (self.mean_s / self.shape)
        return result


class LognormalReaction(Reaction):
    """Log-normal delays, by median and the standard deviation of their logarithm."""

    kind: Literal["lognormal"] = "lognormal"
    median_s: Positive
    sigma: Annotated[float, Field(strict=True, ge=0, le=10)]

    def delays(self, uniform: Float) -> Float:
        """(K,) quantiles of the log-normal distribution."""
        from scipy.special import ndtri

        result: Float = self.median_s * np.exp(self.sigma * ndtri(uniform))
        return result


REACTIONS = {
    "constant": "copem_replay.braking.driver:ConstantReaction",
    "gamma": "copem_replay.braking.driver:GammaReaction",
    "lognormal": "copem_replay.braking.driver:LognormalReaction",
}


class Driver(Component, ABC):
    """Base of driver models: how long it takes to react, and how hard it then brakes."""

    reaction: Annotated[Reaction, Slot("reaction", REACTIONS)] = ConstantReaction()

    @abstractmethod
    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        """(R, T) how hard it brakes `elapsed_s (R, T)` ≥ 0 after it began to at `speed_mps (R, 1)`, ≥ 0."""


def _resolved(build_up_s: float) -> float:
    if 0 < build_up_s < _SHORTEST_S:
        raise ValueError(
            f"expected 0, or at least {_SHORTEST_S:g} s (braking is worked out every 10 ms), found {build_up_s:g}"
        )
    return build_up_s


class ConstantDeceleration(Driver):
    """Brakes with `a_max_mps2` to a stop; with `build_up_s` the deceleration grows linearly to it over that time.

    With build-up the jerk is a_max / build_up, as in the careful and competent driver of UN R157, by way of esmini's
    reading of it (docs/measures.md).
    """

    kind: Literal["constant_deceleration"] = "constant_deceleration"
    a_max_mps2: Annotated[float, Field(strict=True, ge=0.01, le=100)]
    build_up_s: Annotated[float, Field(strict=True, ge=0, le=100), AfterValidator(_resolved)] = 0.0

    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        """(R, T) a_max, or as much of it as is built up."""
        if self.build_up_s == 0:
            return np.full(elapsed_s.shape, self.a_max_mps2)
        result: Float = self.a_max_mps2 * np.minimum(elapsed_s / self.build_up_s, 1.0)
        return result


DRIVERS = {"constant_deceleration": "copem_replay.braking.driver:ConstantDeceleration"}


def delays_of(reaction: Reaction, uniform: Float) -> Float:
    """(K,) what a reaction model says of uniform numbers (K,), checked. Raises InputError when it is no delay."""
    where = "braking.driver.reaction"
    found = asked(reaction, where, lambda: np.asarray(reaction.delays(uniform), dtype=float))
    if found.shape != uniform.shape:
        raise wrong(reaction, where, f"delays(uniform): expected shape {uniform.shape}, found {found.shape}", "delays")
    none = ~((found >= 0) & np.isfinite(found))
    if none.any():
        raise wrong(reaction, where, f"delays(uniform): expected seconds ≥ 0, found {found[none][0]}", "delays")
    return found


def deceleration_of(driver: Driver, elapsed_s: Float, speed_mps: Float) -> Float:
    """(R, T) what a driver model says of `elapsed_s (R, T)` and `speed_mps (R, 1)`, checked. Raises InputError."""
    where = "braking.driver"
    found = asked(driver, where, lambda: np.asarray(driver.deceleration_mps2(elapsed_s, speed_mps), dtype=float))
    method = "deceleration_mps2"
    what = f"{method}(elapsed_s, speed_mps)"
    if found.shape != elapsed_s.shape:
        raise wrong(driver, where, f"{what}: expected shape {elapsed_s.shape}, found {found.shape}", method)
    none = ~((found >= 0) & np.isfinite(found))
    if none.any():
        raise wrong(driver, where, f"{what}: expected m/s² ≥ 0, found {found[none][0]}", method)
    return found
