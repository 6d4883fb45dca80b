"""A radio link: how long a list takes, whether it is lost, and what holds it up. docs/guide/links.md."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from copem_replay.communication.latency import ConstantLatency, Delay, ask_delays
from copem_replay.communication.link import LinkInput, LinkModel, SentLists
from copem_replay.communication.reception import (
    RECEPTIONS,
    ConstantReception,
    RadioPath,
    ReceptionModel,
    ask_reception_probability,
)
from copem_replay.core.components import Frozen, Positive, Slot, error_at_key
from copem_replay.core.errors import is_own
from copem_replay.core.lasting import draw_dwelling_uniforms
from copem_replay.core.memory import Memory, MemoryPart
from copem_replay.core.tracks import Bool, Float, Int


class RadioChannel(Frozen):
    """A channel that sends a unit's lists one after the other: a list waits for earlier ones, then takes its air time.

    A list has `header_bytes`, and `object_bytes` for each object (values used in simulations of cooperative perception;
    not checked against a standard).
    """

    kbps: Positive
    header_bytes: Annotated[int, Field(strict=True, ge=0, le=10**9)] = 121
    object_bytes: Annotated[int, Field(strict=True, ge=0, le=10**9)] = 35

    def takes_s(self, objects: Int) -> Float:
        """(K,) seconds in the air of lists of so many objects."""
        result: Float = 8 * (self.header_bytes + self.object_bytes * objects) / (1000 * self.kbps)
        return result


class Radio(LinkModel):
    """A radio link: `latency`, and the probability that a list arrives (`reception`); `memory`: which draws last.

    `order: kept`: no list arrives before an older one that its unit sent. `channel`: lists queue at their unit.
    """

    kind: Literal["radio"] = "radio"
    latency: Delay = ConstantLatency()
    reception: Annotated[ReceptionModel, Slot("reception", RECEPTIONS)] = ConstantReception()
    memory: Memory = Field(default_factory=dict, exclude_if=lambda memory: not memory)
    order: Literal["free", "kept"] = "free"
    channel: RadioChannel | None = Field(default=None, exclude_if=lambda channel: channel is None)

    @model_validator(mode="after")
    def _drawn_names(self) -> Self:
        for name in self.memory.keys() - {"latency", "reception"}:
            if not is_own(type(self.reception)):
                raise error_at_key(
                    "memory", f'no model of this link asks for noise "{name}" (they ask for latency, reception)'
                )
        return self

    @property
    def loses(self) -> bool:
        """Whether a list may be lost."""
        return not (isinstance(self.reception, ConstantReception) and self.reception.probability_ == 1)

    @property
    def drawn(self) -> bool:
        """Whether delays differ from run to run."""
        return self.loses or self.latency.fixed_s is None or self.channel is not None

    def fixed_s(self, unit: str) -> float | None:
        """The delay (s) of every list that arrives; None: it differs from list to list."""
        return self.latency.fixed_s if self.channel is None else None

    def delays_s(self, lists: SentLists) -> Float:
        """(1, F) delays in the run of the lists, inf: lost."""
        waits_s, air = self._waits_s(lists), lists.air
        if air is None:
            latency_s, arrives = self._drawn(lists)
        else:
            key = air.draws.rng, lists.units, air.draws.runs.tobytes()
            latency_s, arrives = air.kept.of(self, key, lambda: self._drawn(lists))
        delay_s = waits_s + latency_s
        if self.order == "kept":
            delay_s = _keep_order(lists, delay_s)
        return np.where(arrives, delay_s, np.inf)[None]

    def _drawn(self, lists: SentLists) -> tuple[Float, Bool]:
        """(F,) the latency of each list, and whether it arrives: neither depends on what is in the lists."""
        air, fixed_s = lists.air, self.latency.fixed_s
        latency_s, arrives = np.full(len(lists.sent_s), fixed_s or 0.0), np.ones(len(lists.sent_s), dtype=bool)
        if fixed_s is None:
            uniform = _draw_uniforms(air, "latency", self.memory.get("latency", ()))
            latency_s = ask_delays(self.latency, uniform, f"{lists.where}.latency")
        if self.loses:
            uniform = _draw_uniforms(air, "reception", self.memory.get("reception", ()))
            arrives = uniform < self.received(lists)
        return latency_s, arrives

    def received(self, lists: SentLists) -> Float:
        """(F,) the probability that each list arrives."""
        air = lists.air
        nowhere = np.full(len(lists.sent_s), np.nan)
        path = air.path if air is not None and air.path is not None else RadioPath(nowhere, nowhere)
        return ask_reception_probability(self.reception, path, partial(self._noise, air), f"{lists.where}.reception")

    def _noise(self, air: LinkInput | None, name: str, *, lasts_s: float | None = None) -> Float:
        """(1, F) uniform numbers for the reception model: see UniformNoise."""
        if lasts_s is None:
            return _draw_uniforms(air, f"reception {name}", self.memory.get(name, ()))[None]
        assert air is not None  # a link that draws is given random numbers
        draws = air.draws
        return draw_dwelling_uniforms(draws.rng, f"reception {name}", draws.random_key, draws.runs, lasts_s)

    def _waits_s(self, lists: SentLists) -> Float:
        """(F,) seconds that each list waits for those before it and is in the air: Lindley's queue at each unit."""
        if self.channel is None:
            return np.zeros(len(lists.sent_s))
        assert lists.air is not None
        assert lists.air.objects is not None
        takes_s, waits_s = self.channel.takes_s(lists.air.objects), np.zeros(len(lists.sent_s))
        for frames in _rows_by_unit(lists, lists.sent_s):
            done_s = np.cumsum(takes_s[frames])
            begins_s = np.maximum.accumulate(lists.sent_s[frames] - (done_s - takes_s[frames]))
            waits_s[frames] = np.maximum(begins_s + done_s - lists.sent_s[frames], takes_s[frames])
        return waits_s


def _draw_uniforms(air: LinkInput | None, name: str, parts: tuple[MemoryPart, ...]) -> Float:
    """(F,) the uniform numbers of one run."""
    assert air is not None  # a link that draws is given random numbers
    uniform: Float = air.draws.uniform(name, parts)[0]
    return uniform


def _keep_order(lists: SentLists, delay_s: Float) -> Float:
    """(F,) delays with which no list arrives before one of its unit that was captured before, lost or not.

    A lost list holds up those behind it, too: so more loss only removes lists.
    """
    delay_s = delay_s.copy()
    for frames in _rows_by_unit(lists, lists.captured_s):
        arrives_s = lists.sent_s[frames] + delay_s[frames]
        latest_s = np.maximum.accumulate(arrives_s)
        held = latest_s > arrives_s
        delay_s[frames[held]] = (latest_s - lists.sent_s[frames])[held]
    return delay_s


def _rows_by_unit(lists: SentLists, time_s: Float) -> Iterator[Int]:
    """The lists that are made, unit by unit, in the order of the times `time_s (F,)`."""
    made: Bool = np.ones(len(lists.unit_ix), dtype=bool) if lists.made is None else lists.made
    order = np.flatnonzero(made)
    order = order[np.lexsort((lists.captured_s[order], time_s[order], lists.unit_ix[order]))]
    yield from np.split(order, np.flatnonzero(np.diff(lists.unit_ix[order])) + 1)
