"""Perceived: what modelled units list in all runs of a block, drawn at once; runs that go one by one have views."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from copem_replay.core.tracks import Bool, Int, Tracks
from copem_replay.fusion.ideal import Weighed
from copem_replay.perception.perceive import perceive

if TYPE_CHECKING:
    from copem_replay.core.random import RandomKey
    from copem_replay.fusion.inputs import RowEntries
    from copem_replay.perception.observation import Observations
    from copem_replay.pipeline.on_air import OnAir
    from copem_replay.pipeline.receiver import WorldChunk

States = Literal["true", "expected", "sampled"]


def perceived(world: WorldChunk, runs: Int, states: States, equipped: Bool | None) -> Tracks:
    """What the modelled units list in the runs (S,); `equipped (S, U)`: which of all units there are, None: all."""
    if equipped is not None:
        equipped = equipped[:, [k for k, unit in enumerate(world.experiment.units.values()) if unit.recorded is None]]
    return perceive(world.scene, world.found, world.experiment, runs, states=states, equipped=equipped)


class Perceived:
    """Of the runs (S,), which all have the same units, `equipped (1, U)`; made when it is first asked for."""

    def __init__(self, runs: Int, equipped: Bool | None) -> None:
        self._number = {run: s for s, run in enumerate(runs.tolist())}
        self._runs, self._equipped = runs, equipped
        self._seen: list[tuple[Observations, States, Tracks]] = []
        self._entries: tuple[Observations, RowEntries, RandomKey] | None = None
        self._weighed: tuple[Tracks, Weighed] | None = None
        self._on_air: tuple[int, OnAir | None] | None = None

    def seen(self, world: WorldChunk, run: int, states: States) -> Tracks:
        """What the modelled units list in one of the runs: of some rows, those of the chunk."""
        return self._all(world, states).take_run(self._number[run])

    def entries(
        self, world: WorldChunk, run: int, made_of: Callable[[Tracks], tuple[RowEntries, RandomKey]]
    ) -> tuple[int, RowEntries, RandomKey]:
        """Which of the runs it is; and `made_of` what is listed with errors in all: its rows as entries, and whose."""
        if self._entries is None or self._entries[0] is not world.found:
            self._entries = world.found, *made_of(self._all(world, "sampled"))
        return self._number[run], *self._entries[1:]

    def weighed(self, world: WorldChunk, states: States, heard: Tracks) -> Weighed | None:
        """What ideal fusion goes by in all runs, if that is what it hears; None: what it hears is another in each."""
        every = self._all(world, states)
        if not Weighed.alike(every, heard):
            return None
        if self._weighed is None or self._weighed[0] is not every:
            self._weighed = every, Weighed.of(every)
        return self._weighed[1]

    def on_air(self, run: int, made: Callable[[], OnAir | None]) -> OnAir | None:
        """What drawn links go by in one of the runs, which is asked for several times before the next one."""
        if self._on_air is None or self._on_air[0] != run:
            self._on_air = run, made()
        return self._on_air[1]

    def _all(self, world: WorldChunk, states: States) -> Tracks:
        for found, of, seen in self._seen:
            if found is world.found and of == states:
                return seen
        made = perceived(world, self._runs, states, self._equipped)
        self._seen.append((world.found, states, made))
        return made
