"""The time a run takes: printed on the terminal and written nowhere, for results are the same on any machine."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from numba.core.event import Event, Listener, install_listener

from copem_replay.pipeline.blocks import Outcome

MOSTLY = 0.5
LONG_S = 10.0
"""Of runs that take longer than this it is said what takes more than that share of it (chosen)."""


@dataclass
class Cost:
    """Seconds of a run: all of it, and what its workers did, of which some was measuring accuracy.

    `compiled`: kernels had to be compiled, so the next run takes less.
    """

    total_s: float = 0.0
    in_blocks_s: float = 0.0  # while blocks were computed, by however many workers
    worked_s: float = 0.0  # by all of them together
    accuracy_s: float = 0.0
    compiled: bool = False

    def notes(self) -> tuple[str, ...]:
        """Accuracy, where it is most of a run that takes long, and how to leave it out."""
        if self.compiled or self.total_s <= LONG_S or self.worked_s <= 0:
            return ()
        share = self.accuracy_s / self.worked_s * self.in_blocks_s / self.total_s
        if share <= MOSTLY:
            return ()
        return (
            f"accuracy took {100 * share:.0f} % of the {self.total_s:.0f} s of this replay; "
            "`measure: {accuracy: false}` leaves it out",
        )

    def add(self, in_blocks_s: float, outcomes: Sequence[Outcome]) -> None:
        """Take in blocks that were computed within so many seconds."""
        self.in_blocks_s += in_blocks_s
        self.worked_s += sum(outcome.worked_s for outcome in outcomes)
        self.accuracy_s += sum(outcome.accuracy_s for outcome in outcomes)


@contextmanager
def watched() -> Iterator[Cost]:
    """The cost of what is done meanwhile; `total_s` and `compiled` are known afterwards."""
    cost, began, compiling = Cost(), time.perf_counter(), _Compiling()
    with install_listener("numba:compile", compiling):
        yield cost
    cost.total_s, cost.compiled = time.perf_counter() - began, compiling.happened


class _Compiling(Listener):
    """Whether any kernel was compiled: what is read from Numba's cache is not."""

    happened = False

    def on_start(self, event: Event) -> None:
        self.happened = True

    def on_end(self, event: Event) -> None:
        pass
