"""Links: when the receiver has each list. The delay of a link comes on top exactly, no rounding to a tick.

A modelled unit sends a list when it is captured, a recorded one when it was recorded.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Container
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from copem_replay.core.components import Component, GivenError, Id, NotNegative, asked
from copem_replay.core.tracks import Float, Int, Tracks


@dataclass(frozen=True)
class SentLists:
    """The lists (F,) of some units (U,) as they are sent. Times are seconds since the log's start.

    >>> cr.SentLists(("rsu",), np.zeros(1, dtype=int), captured_s=np.array([0.1]), sent_s=np.array([0.1])).units
    ('rsu',)
    """

    units: tuple[str, ...]  # U names; the truth has the one unit TRUTH
    unit_ix: Int  # (F,) the unit that sends each list
    captured_s: Float  # (F,)
    sent_s: Float  # (F,)


class LinkModel(Component, ABC):
    """Base of all links, of a configuration's `link:`. A link is pure: the same lists have the same delays.

    >>> class Filling(cr.LinkModel):
    ...     def delays_s(self, lists):
    ...         return (0.01 * lists.sent_s)[None]
    """

    @abstractmethod
    def delays_s(self, lists: SentLists) -> Float:
        """Seconds from the sending of each list to its arrival: (S | 1, F), 0 or more; inf: the list never arrives.

        Arrival times have to be common to all runs: more than one row is refused. The delay of a list depends on the
        list alone.
        """

    def fixed_s(self, unit: str) -> float | None:
        """The delay (s) of every list of a unit; None: it differs from list to list, or is not known in advance."""
        return None


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
class Delays:
    """The delays that a link gives the lists (F,): `by_run_s (S | 1, F)`. Raises GivenError where they are none."""

    by_run_s: Float
    lists: int

    def __post_init__(self) -> None:
        given = self.by_run_s
        if not isinstance(given, np.ndarray) or given.ndim != 2 or given.shape[1] != self.lists:
            found = given.shape if isinstance(given, np.ndarray) else type(given).__name__
            raise GivenError("delays_s", f"expected shape (1, {self.lists}), found {found}")
        if given.dtype.kind not in "fiu" or not (given >= 0).all():  # NaN is not at least 0 either
            raise GivenError("delays_s", "expected seconds of 0 or more (inf: never), found others")

    @property
    def common_s(self) -> Float:
        """(1, F) what all runs have in common. Raises GivenError where delays differ by run.

        The receiver's instants are those of all runs of a log: they cannot be computed once from such delays.
        """
        if len(self.by_run_s) != 1:
            raise GivenError(
                "delays_s",
                f"expected one row of delays, common to all runs, found {len(self.by_run_s)}; arrival times that "
                "differ by run are not supported",
            )
        return self.by_run_s


def transmit(seen: Tracks, link: LinkModel, where: str, heard: Container[str] | None = None) -> Tracks:
    """The same tracks with the arrival times of their lists at the receiver, inf: never.

    `heard`: names of the units whose lists reach the receiver, None: all. Raises InputError, naming `where` the link
    stands, where a link of the user's own fails.
    """
    made = np.isfinite(seen.common_arrives_s)  # a list that is not made is no concern of the link
    sent_s = np.where(made, seen.common_arrives_s, seen.captured_s)
    sent = SentLists(seen.units, seen.frame_unit_ix, seen.captured_s, sent_s)
    delay_s = asked(link, where, lambda: Delays(link.delays_s(sent), len(sent.sent_s)).common_s)
    if heard is not None:
        reaches = np.array([name in heard for name in seen.units], dtype=bool)
        delay_s = np.where(reaches[seen.frame_unit_ix], delay_s, np.inf)
    return replace(seen, arrives_s=seen.arrives_s + delay_s)
