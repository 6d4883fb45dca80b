"""Sweeps as keys of an experiment file: values of one quantity at a time."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from copem_replay.core.components import Either, Frozen, Id, Latency, Share
from copem_replay.perception.config import Rate
from copem_replay.perception.pem.ghosts import MeanNumber


def _how_many(value: object) -> object:
    if isinstance(value, str | list | tuple):
        raise ValueError(f"expected how many units beside the ego's, such as 2 (a count, no names), found {value!r}")
    return value


Units = Annotated[int, Field(strict=True, ge=0, le=10**6), BeforeValidator(_how_many)]


def _once(values: tuple[float, ...]) -> tuple[float, ...]:
    for k, value in enumerate(values):
        if value in values[:k]:
            raise ValueError(f"expected each value once, found {value:g} twice")
    return values


def _none_or_lasting(value: float) -> float:
    if 0 < value < 0.001:
        raise ValueError(f"expected 0 or at least 0.001 (s), found {value:g}")
    return value


Lasting = Annotated[float, Field(strict=True, ge=0, le=86_400), AfterValidator(_none_or_lasting)]
"""A correlation time in seconds; 0: nothing lasts."""
_UNSAID: Any = Field(default=None, exclude_if=lambda value: value is None)
SweptNames = Annotated[tuple[Id, ...], Field(min_length=1)]


class SweptBy(Frozen):
    """Which configurations each quantity changes, if these differ between quantities."""

    latency_s: SweptNames | None = None
    rate_hz: SweptNames | None = None
    units: SweptNames | None = None
    penetration_rate: SweptNames | None = None
    correlation_s: SweptNames | None = _UNSAID
    ghosts_in_list: SweptNames | None = _UNSAID
    loss: SweptNames | None = _UNSAID
    burst_s: SweptNames | None = _UNSAID


Swept = Either[SweptNames, SweptBy]


class Sweep(Frozen):
    """Further values at which `configurations` (names, or names by quantity) are run, one quantity at a time.

    By default a quantity changes all configurations that have it; `latency_s` those with a latency above 0 or by unit.
    `latency_s`: of the whole list; if latencies are by unit, the `default` one. `rate_hz`: of every unit. `units`:
    number of a configuration's units beside the ego's, taken in order. `penetration_rate`: share of possible carriers
    with a unit. `correlation_s`: of the first part of `memory.detection`; 0: new in every list. `ghosts_in_list`: mean
    number of ghosts of the first entry of `ghosts` in a list. `loss`: share of lists that links lose. `burst_s`: how
    long losses last: `bad_lasts_s`, else the first part of `memory.reception`.
    """

    configurations: Swept | None = None
    latency_s: Annotated[tuple[Latency, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    rate_hz: Annotated[tuple[Rate, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    units: Annotated[tuple[Units, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    penetration_rate: Annotated[tuple[Share, ...], Field(min_length=1), AfterValidator(_once)] | None = None
    correlation_s: Annotated[tuple[Lasting, ...], Field(min_length=1), AfterValidator(_once)] | None = _UNSAID
    ghosts_in_list: Annotated[tuple[MeanNumber, ...], Field(min_length=1), AfterValidator(_once)] | None = _UNSAID
    loss: Annotated[tuple[Share, ...], Field(min_length=1), AfterValidator(_once)] | None = _UNSAID
    burst_s: Annotated[tuple[Lasting, ...], Field(min_length=1), AfterValidator(_once)] | None = _UNSAID

    @model_validator(mode="after")
    def _some(self) -> Self:
        names = list(SweptBy.model_fields)
        if not any(getattr(self, name) for name in names):
            known = f"{', '.join(names[:-1])} or {names[-1]}"
            raise ValueError(f"expected values of {known}, such as `latency_s: [0, 0.5, 1]`")
        for quantity in SweptBy.model_fields if isinstance(self.configurations, SweptBy) else ():
            if self.chosen(quantity) and not getattr(self, quantity):
                raise ValueError(f"configurations.{quantity}: expected values of {quantity} beside it, found none")
        return self

    def chosen(self, quantity: str) -> tuple[str, ...] | None:
        """The configurations that a quantity shall change; None: nothing is said of it."""
        if not isinstance(self.configurations, SweptBy):
            return self.configurations
        chosen: tuple[str, ...] | None = getattr(self.configurations, quantity)
        return chosen
