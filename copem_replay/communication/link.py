"""Links: when the receiver has each list. The delay of a link is added exactly, without rounding to a tick.

A modelled unit sends a list when it is ready, a recorded one when it was recorded.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from copem_replay.communication.latency import LatencyModel, ask_delays
from copem_replay.core.components import Component, GivenError, Id, NotNegative, ask_component
from copem_replay.core.lasting import drop_unshared
from copem_replay.core.random import CounterRng, RandomKey
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Tracks

if TYPE_CHECKING:
    from copem_replay.communication.reception import RadioPath
    from copem_replay.core.memory import UnitDraws


LINKS = {"radio": "copem_replay.communication.radio:Radio"}
"""Built-in names of `link: {kind: …}`."""


class KeptDraws:
    """Cache of the numbers that links drew for the lists of one log, run by run.

    Several configurations send by a link, and the columns about links use its draws again. When there is no more room
    all is forgotten, and drawn again where it is needed.
    """

    def __init__(self, room_bytes: int = 64_000_000) -> None:
        self._room_bytes, self._held_bytes = room_bytes, 0
        self._kept: dict[Hashable, list[tuple[LinkModel, tuple[Float, Bool]]]] = {}

    def of(self, link: LinkModel, lists: Hashable, drawn: Callable[[], tuple[Float, Bool]]) -> tuple[Float, Bool]:
        """The cached draws of a link for some lists of one run; the result of `drawn` the first time."""
        for other, draws in tuple(self._kept.get(lists, ())):
            if other == link:
                return draws
        draws_now = drawn()
        size = sum(column.nbytes for column in draws_now)
        if self._held_bytes + size > self._room_bytes:
            self._kept, self._held_bytes = {}, 0
        self._kept.setdefault(lists, []).append((link, draws_now))
        self._held_bytes += size
        return draws_now


@dataclass(frozen=True)
class LinkInput:
    """Inputs of a link for lists (F,) in one run: random numbers, paths, and the number of entries of each list.

    `path`, `objects`: None where no link of the experiment asks for them. `kept`: what was drawn for these lists.
    """

    draws: UnitDraws
    path: RadioPath | None
    objects: Int | None
    kept: KeptDraws = field(default_factory=KeptDraws)


@dataclass(frozen=True)
class SentLists:
    """The lists (F,) of some units (U,) as they are sent. Times are seconds since the log's start.

    `made (F,)`: which of them there are, None: all. `where`: what stands in the experiment for the link.

    >>> cr.SentLists(("rsu",), np.zeros(1, dtype=int), captured_s=np.array([0.1]), sent_s=np.array([0.1])).units
    ('rsu',)
    """

    units: tuple[str, ...]  # U names; the truth has the one unit TRUTH
    unit_ix: Int  # (F,) the unit that sends each list
    captured_s: Float  # (F,)
    sent_s: Float  # (F,)
    made: Bool | None = None
    air: LinkInput | None = None
    where: str = "link"


class LinkModel(Component, ABC):
    """Base of all links. A link is pure: the same lists have the same delays.

    >>> class Filling(cr.LinkModel):
    ...     def delays_s(self, lists):
    ...         return (0.01 * lists.sent_s)[None]
    """

    @abstractmethod
    def delays_s(self, lists: SentLists) -> Float:
        """(1, F) seconds from the sending of each list to its arrival, 0 or more; inf: the list never arrives.

        The delay of a list depends on the list alone, in a link of the user's own: it is the same in all runs.
        """

    def fixed_s(self, unit: str) -> float | None:
        """The delay (s) of every list of a unit; None: it differs from list to list, or is not known in advance."""
        return None

    @property
    def drawn(self) -> bool:
        """Whether delays differ from run to run."""
        return False


class ConstantLink(LinkModel):
    """One delay for all lists, or one by unit: of the units that are not named `default`, or else 0."""

    kind: Literal["constant"] = "constant"
    latency_s: NotNegative | dict[Id, NotNegative] = 0.0

    def delays_s(self, lists: SentLists) -> Float:
        """(1, F) the delay of the unit that sends each list."""
        by_unit = np.array([self.fixed_s(name) for name in lists.units], dtype=float)
        return by_unit[lists.unit_ix][None]

    def fixed_s(self, unit: str) -> float:
        """The delay (s) of every list of a unit."""
        if isinstance(self.latency_s, dict):
            return self.latency_s.get(unit, self.latency_s.get("default", 0.0))
        return self.latency_s


@dataclass(frozen=True)
class UnitLinks:
    """A link of a configuration, the units that send by it (None: all), and `where` the experiment names it."""

    where: str
    link: LinkModel
    units: frozenset[str] | None = None


@dataclass(frozen=True)
class Delays:
    """The checked delays `by_run_s (1, F)` that a link gives F lists. Raises GivenError where they are none."""

    by_run_s: Float
    lists: int

    def __post_init__(self) -> None:
        delays = self.by_run_s
        if not isinstance(delays, np.ndarray) or delays.shape != (1, self.lists):
            found = delays.shape if isinstance(delays, np.ndarray) else type(delays).__name__
            raise GivenError("delays_s", f"expected shape (1, {self.lists}), found {found}")
        if delays.dtype.kind not in "fiu" or not (delays >= 0).all():  # NaN is not at least 0 either
            raise GivenError("delays_s", "expected seconds of 0 or more (inf: never), found others")


def transmit(
    tracks: Tracks,
    links: Sequence[UnitLinks],
    received: Container[str] | None = None,
    *,
    air: LinkInput | None = None,
) -> Tracks:
    """The tracks with the arrival times of their lists at the receiver, inf: never.

    A list takes the delays of all `links` that its unit sends by, one after the other. `received`: names of the units
    whose lists reach the receiver, None: all. Raises InputError, naming where a link stands, where an own one fails.
    """
    arrives_s = tracks.common_arrives_s
    is_made = np.isfinite(arrives_s)  # a list that is not made is no concern of a link
    for unit_link in links:
        sent_s = np.where(is_made, arrives_s, tracks.captured_s)
        sent = SentLists(tracks.units, tracks.frame_unit_ix, tracks.captured_s, sent_s, is_made, air, unit_link.where)
        delay_s = ask_component(unit_link.link, unit_link.where, partial(_check_delays, unit_link.link, sent))
        if unit_link.units is not None:
            delay_s = np.where(_is_of_units(tracks, unit_link.units), delay_s, 0.0)
        arrives_s = arrives_s + delay_s
        is_made = is_made & np.isfinite(delay_s)
    if received is not None:
        arrives_s = np.where(_is_of_units(tracks, received), arrives_s, np.inf)
    return replace(tracks, arrives_s=arrives_s[None])


def _check_delays(link: LinkModel, sent: SentLists) -> Float:
    """(F,) the delays that a link gives. Raises GivenError."""
    delay_s: Float = Delays(link.delays_s(sent), len(sent.sent_s)).by_run_s[0]
    return delay_s


def sample_arrivals(arriving: Tracks, rate_hz: float | None) -> Tracks:
    """The lists, each arriving at the first of the instants k / rate that is not before its arrival, within 1 µs."""
    if rate_hz is None:
        return arriving
    return replace(arriving, arrives_s=np.ceil((arriving.arrives_s - SAME_INSTANT_S) * rate_hz) / rate_hz)


def _is_of_units(seen: Tracks, names: Container[str]) -> Bool:
    """(F,) which lists are of these units."""
    return np.array([name in names for name in seen.units], dtype=bool)[seen.frame_unit_ix]


def delay_until_ready(tracks: Tracks, ready: Mapping[str, LatencyModel], rng: CounterRng, runs: Int) -> Tracks:
    """The lists as each is ready to be sent: later by the time that its unit works on it (`ready`, by unit).

    Times are drawn for one run, runs (1,). Raises InputError where a model of the user's own fails.
    """
    if not ready:
        return tracks
    arrives_s = tracks.common_arrives_s.copy()
    for name, model in ready.items():
        frames = np.flatnonzero(tracks.frame_unit_ix == tracks.units.index(name))
        if model.fixed_s is not None:
            arrives_s[frames] += model.fixed_s
            continue
        of_unit = np.zeros(len(frames), dtype=np.int64)
        random_key = drop_unshared(
            RandomKey((name,), of_unit, of_unit.astype(np.uint64), tracks.stamp_ns[frames]), "unit"
        )
        [uniform] = rng.uniform("ready", random_key, runs)
        arrives_s[frames] += ask_delays(model, uniform, f"units.{name}.ready")
    return replace(tracks, arrives_s=arrives_s[None])
