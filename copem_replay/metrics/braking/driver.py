"""Driver models: how late and how hard the ego brakes once an object is known.

A driver reacts after a delay and then brakes along its path; it does not steer. It is declared, not observed: a verdict
is that of the declared driver. Models draw no random numbers; they map those they are given.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from copem_replay.core.components import (
    Component,
    NotNegative,
    Positive,
    Slot,
    ask_component,
    ask_numbers,
    wrong_answer_error,
)
from copem_replay.core.tracks import Float

_SHORTEST_S = 0.05
"""The shortest build-up of a deceleration: five steps of `NODE_S`, in which braking is computed."""
UNRESOLVED = 1e-15
"""Shares below this are unknown where only the inverse of a distribution is known: uniform numbers end 10⁻¹⁶ below 1.
"""


class Reaction(Component, ABC):
    """Base of reaction models: seconds from the instant a list is available until the ego begins to brake.

    >>> class Uniform(cr.Reaction):
    ...     def delays(self, uniform):
    ...         return 0.2 + 0.6 * uniform
    >>> Uniform(kind="my_package.drivers:Uniform").delays(np.array([0.5]))
    array([0.5])
    """

    @abstractmethod
    def delays(self, uniform: Float) -> Float:
        """(K,) seconds for uniform numbers (K,) in (0, 1): the inverse of their distribution, never decreasing."""

    def survival(self, delay_s: Float) -> Float | None:
        """(K,) probability that a reaction takes longer than `delay_s (K,)` ≥ 0, to the far tail. None: not known.

        Optional. With it failures rarer than 10⁻¹⁵ have a probability; `delays` then has to hold for numbers down to
        10⁻³⁰⁰.
        """
        return None


class ConstantReaction(Reaction):
    """The same delay every time."""

    kind: Literal["constant"] = "constant"
    delay_s: NotNegative = 0.0

    def delays(self, uniform: Float) -> Float:
        """(K,) the delay."""
        return np.full(len(uniform), self.delay_s)

    def survival(self, delay_s: Float) -> Float:
        """(K,) 1 before the delay, 0 from then on."""
        return np.where(delay_s < self.delay_s, 1.0, 0.0)


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

    def survival(self, delay_s: Float) -> Float:
        """(K,) the upper regularised incomplete gamma function."""
        from scipy.special import gammaincc

        result: Float = gammaincc(self.shape, delay_s / (self.mean_s / self.shape))
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

    def survival(self, delay_s: Float) -> Float:
        """(K,) the normal distribution of the logarithm."""
        from scipy.special import ndtr

        if self.sigma == 0:
            return np.where(delay_s < self.median_s, 1.0, 0.0)
        with np.errstate(divide="ignore", over="ignore"):  # no delay, or hardly any sigma: ±∞
            result: Float = ndtr(np.log(self.median_s / delay_s) / self.sigma)
        return result


REACTIONS = {
    "constant": "copem_replay.metrics.braking.driver:ConstantReaction",
    "gamma": "copem_replay.metrics.braking.driver:GammaReaction",
    "lognormal": "copem_replay.metrics.braking.driver:LognormalReaction",
}


class Driver(Component, ABC):
    """Base of driver models: how long it takes to react, and how hard it then brakes.

    >>> class Gentle(cr.Driver):
    ...     def deceleration_mps2(self, elapsed_s, speed_mps):
    ...         return np.minimum(2.0 * elapsed_s, 4.0)
    >>> Gentle(kind="my_package.drivers:Gentle").deceleration_mps2(np.array([[1.0, 3.0]]), np.array([[10.0]]))
    array([[2., 4.]])
    """

    reaction: Annotated[Reaction, Slot("reaction", REACTIONS)] = ConstantReaction()

    @abstractmethod
    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        """(R, T) deceleration ≥ 0, `elapsed_s (R, T)` ≥ 0 after braking began at `speed_mps (R, 1)`."""


def _check_build_up(build_up_s: float) -> float:
    if 0 < build_up_s < _SHORTEST_S:
        raise ValueError(
            f"expected 0, or at least {_SHORTEST_S:g} s (braking is worked out every 10 ms), found {build_up_s:g}"
        )
    return build_up_s


class ConstantDeceleration(Driver):
    """Brakes with `a_max_mps2` to a stop; with `build_up_s` the deceleration grows linearly over that time.

    With build-up the jerk is a_max / build_up, as in the careful and competent driver of UN R157 as implemented in
    esmini (docs/guide/metrics.md).
    """

    kind: Literal["constant_deceleration"] = "constant_deceleration"
    a_max_mps2: Annotated[float, Field(strict=True, ge=0.01, le=100)]
    build_up_s: Annotated[float, Field(strict=True, ge=0, le=100), AfterValidator(_check_build_up)] = 0.0

    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        """(R, T) `a_max_mps2`, or the part of it that is built up."""
        if self.build_up_s == 0:
            return np.full(elapsed_s.shape, self.a_max_mps2)
        result: Float = self.a_max_mps2 * np.minimum(elapsed_s / self.build_up_s, 1.0)
        return result


R157: dict[str, object] = {
    "kind": "constant_deceleration", "a_max_mps2": 7.59, "build_up_s": 0.6,
    "reaction": {"kind": "constant", "delay_s": 1.15},
}  # fmt: skip
"""The careful and competent driver of UN R157, as implemented in esmini: .4 s to see the risk and .75 s to react, then
.774 g within .6 s (docs/guide/metrics.md). The keys of `braking.driver` in a draft."""
DRIVERS = {"constant_deceleration": "copem_replay.metrics.braking.driver:ConstantDeceleration"}


def reaction_delays(reaction: Reaction, uniform: Float) -> Float:
    """(K,) delays in seconds of a reaction model for uniform numbers (K,). Raises InputError for an invalid one."""
    where = "braking.driver.reaction"
    return ask_numbers(
        reaction, where, "delays(uniform)", lambda: reaction.delays(uniform), uniform.shape, "seconds ≥ 0"
    )


_TRIED = np.array([0.01, 0.1, 0.5, 0.9, 0.99])
"""Uniform numbers, from both tails and the middle, at which the survival of a reaction is compared with its delays."""


def reaction_survival(reaction: Reaction, delay_s: Float) -> Float | None:
    """(K,) probability that a reaction takes longer than `delay_s (K,)`; None: the model has no survival function.

    Raises InputError for an invalid probability, or one that contradicts the delays of the model.
    """
    where = "braking.driver.reaction"
    call = "survival(delay_s)"

    def survival(of_s: Float) -> Float | None:
        answer = ask_component(reaction, where, lambda: reaction.survival(of_s))
        if answer is None:
            return None
        return ask_numbers(reaction, where, call, lambda: answer, of_s.shape, "probabilities 0 … 1", 1.0)

    survivals = survival(delay_s)
    if survivals is None:
        return None
    # Whatever the distribution, P(D > d) ≤ 1 − u ≤ P(D ≥ d): compared a hair beside d, for rounding.
    at_s = reaction_delays(reaction, _TRIED)
    for hair, sign in ((1e-9, 1), (-1e-9, -1)):
        probability = survival(np.nextafter(at_s * (1 + hair), sign * np.inf))  # of the smallest numbers a hair is none
        assert probability is not None
        off = np.flatnonzero((sign * (probability - (1 - _TRIED)) > 1e-6) & (at_s > 0))
        if len(off):
            k = off[0]
            raise wrong_answer_error(
                reaction, where,
                f"{call}: expected at {at_s[k]:g} s, which is delays({_TRIED[k]:g}), "
                f"at {'most' if sign > 0 else 'least'} {1 - _TRIED[k]:g}; found {probability[k]:g}", "survival",
            )  # fmt: skip
    return survivals


def driver_deceleration(driver: Driver, elapsed_s: Float, speed_mps: Float) -> Float:
    """(R, T) decelerations of a driver model, as `deceleration_mps2`. Raises InputError for an invalid one."""
    where = "braking.driver"
    return ask_numbers(
        driver, where, "deceleration_mps2(elapsed_s, speed_mps)",
        lambda: driver.deceleration_mps2(elapsed_s, speed_mps), elapsed_s.shape, "m/s² ≥ 0",
    )  # fmt: skip
