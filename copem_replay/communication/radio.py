"""A radio link: how long a list takes, whether it is lost, and what holds it up. docs/guide/links.md."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from copem_replay.communication.latency import ConstantLatency, Delay, delays_of
from copem_replay.communication.link import Air, LinkModel, SentLists
from copem_replay.communication.reception import (
    RECEPTIONS,
    ConstantReception,
    RadioPath,
    ReceptionModel,
    probability_of,
)
from copem_replay.core.components import Frozen, Positive, Slot, at_key
from copem_replay.core.lasting import dwelling
from copem_replay.core.memory import Memory, Part
from copem_replay.core.own_code import is_own
from copem_replay.core.tracks import Bool, Float, Int


class Channel(Frozen):
    """A channel that sends a unit's lists one after the other: a list waits for earlier ones, then takes its air time.

    A list has `header_bytes`, and `object_bytes` for each object (values used in simulations of cooperative perception;
    not checked against a standard).
    """

    kbps: Positive
    header_bytes: Annotated[int, Field(strict=True, ge=0, le=10**9)] = 121
    object_bytes: Annotated[int, Field(strict=True, ge=0, le=10**9)] = 35

    def takes_s(self, objects: Int) -> Float:
        """(K,) how long lists of so many objects are in the air."""
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
    channel: Channel | None = Field(default=None, exclude_if=lambda channel: channel is None)

    @model_validator(mode="after")
    def _drawn_names(self) -> Self:
        for name in self.memory.keys() - {"latency", "reception"}:
            if not is_own(type(self.reception)):
                raise at_key(
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
        """(1, F) in the run that the lists are of."""
        waits_s, air = self._waits_s(lists), lists.air
        if air is None:
            latency_s, arrives = self._drawn(lists)
        else:
            key = air.draws.rng, lists.units, air.draws.runs.tobytes()
            latency_s, arrives = air.kept.of(self, key, lambda: self._drawn(lists))
        delay_s = waits_s + latency_s
        if self.order == "kept":
            delay_s = _in_order(lists, delay_s)
        return np.where(arrives, delay_s, np.inf)[None]

    def _drawn(self, lists: SentLists) -> tuple[Float, Bool]:
        """(F,) the latency of each list, and whether it arrives: nothing of it depends on what is in the lists."""
        air, fixed_s = lists.air, self.latency.fixed_s
        latency_s, arrives = np.full(len(lists.sent_s), fixed_s or 0.0), np.ones(len(lists.sent_s), dtype=bool)
        if fixed_s is None:
            uniform = _numbers(air, "latency", self.memory.get("latency", ()))
            latency_s = delays_of(self.latency, uniform, f"{lists.where}.latency")
        if self.loses:
            uniform = _numbers(air, "reception", self.memory.get("reception", ()))
            arrives = uniform < self.received(lists)
        return latency_s, arrives

    def received(self, lists: SentLists) -> Float:
        """(F,) the probability that each list arrives."""
        air = lists.air
        nowhere = np.full(len(lists.sent_s), np.nan)
        path = air.path if air is not None and air.path is not None else RadioPath(nowhere, nowhere)
        return probability_of(self.reception, path, partial(self._noise, air), f"{lists.where}.reception")

    def _noise(self, air: Air | None, name: str, *, lasts_s: float | None = None) -> Float:
        if lasts_s is None:
            return _numbers(air, f"reception {name}", self.memory.get(name, ()))[None]
        assert air is not None  # a link that draws has numbers
        draws = air.draws
        return dwelling(draws.rng, f"reception {name}", draws.random_key, draws.runs, lasts_s)

    def _waits_s(self, lists: SentLists) -> Float:
        """(F,) how long each list waits for those before it, and is in the air: Lindley's queue at each unit."""
        if self.channel is None:
            return np.zeros(len(lists.sent_s))
        assert lists.air is not None
        assert lists.air.objects is not None
        takes_s, waits_s = self.channel.takes_s(lists.air.objects), np.zeros(len(lists.sent_s))
        for mine in _by_unit(lists, lists.sent_s):
            done_s = np.cumsum(takes_s[mine])
            begins_s = np.maximum.accumulate(lists.sent_s[mine] - (done_s - takes_s[mine]))
            waits_s[mine] = np.maximum(begins_s + done_s - lists.sent_s[mine], takes_s[mine])
        return waits_s


def _numbers(air: Air | None, name: str, parts: tuple[Part, ...]) -> Float:
    """(F,) the uniform numbers of one run."""
    assert air is not None  # a link that draws has numbers
    uniform: Float = air.draws.uniform(name, parts)[0]
    return uniform


def _in_order(lists: SentLists, delay_s: Float) -> Float:
    """Delays with which no list arrives before one of its unit that was captured before, lost or not.

    A list that is lost on the way holds up those behind it all the same: so more loss only removes lists.
    """
    delay_s = delay_s.copy()
    for mine in _by_unit(lists, lists.captured_s):
        arrives_s = lists.sent_s[mine] + delay_s[mine]
        latest_s = np.maximum.accumulate(arrives_s)
        held = latest_s > arrives_s
        delay_s[mine[held]] = (latest_s - lists.sent_s[mine])[held]
    return delay_s


def _by_unit(lists: SentLists, by: Float) -> Iterator[Int]:
    """The lists that are made, unit by unit in the order of some times (F,)."""
    made: Bool = np.ones(len(lists.unit_ix), dtype=bool) if lists.made is None else lists.made
    order = np.flatnonzero(made)
    order = order[np.lexsort((lists.captured_s[order], by[order], lists.unit_ix[order]))]
    yield from np.split(order, np.flatnonzero(np.diff(lists.unit_ix[order])) + 1)
