"""How often the receiver of each configuration issues a fused list, and what its links make of the lists it is sent."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from copem_replay.communication.arrivals import instants_of
from copem_replay.communication.link import taken_in
from copem_replay.core.tracks import SAME_INSTANT_NS, TRUTH, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.link_times import LinkTimes, link_times
from copem_replay.pipeline.receiver import WorldChunk, listen, seen_by_all

if TYPE_CHECKING:
    from copem_replay.pipeline.prepare import Replay

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class ListTimes:
    """Of one configuration: intervals between fused lists while a log lasts, the seconds they cover, and its links."""

    intervals: int
    covered_s: float
    links: LinkTimes | None

    @property
    def rate_hz(self) -> float | None:
        """Fused lists per second; None: there are no two."""
        return self.intervals / self.covered_s if self.covered_s > 0 else None

    @classmethod
    def read(cls, said: dict[str, Any]) -> Self:
        """From JSON."""
        links = said["links"]
        if links is not None:
            links = LinkTimes(**links | {name: np.array(links[name]) for name in ("from_s", "to_s")})
        return cls(said["intervals"], said["covered_s"], links)


def list_times(replay: Replay, experiment: Experiment) -> dict[str, ListTimes]:
    """By configuration what there is of all runs, or of the one that stands for all.

    Units that only some runs have are taken to be there.
    """
    world = replay.lists_only(experiment)
    units, result, seen = world.experiment, dict[str, list[ListTimes]](), None
    differ = units.outages or units.sends or any(ready.fixed_s is None for ready in units.ready.values())
    for run in range(experiment.runs if units.arrivals_differ else 1):
        alone = np.array([run])
        in_run = replace(world, on_air=replay.on_air(experiment, alone))
        if seen is None or differ:
            seen = seen_by_all(in_run, alone, states="true")
        _add(result, in_run, seen)
    return {name: together(runs) for name, runs in result.items()}


def together(times: Iterable[ListTimes]) -> ListTimes:
    """All runs and logs of a configuration as one."""
    every = list(times)
    links = [one.links for one in every if one.links is not None]
    added = sum(links[1:], links[0]) if links else None
    return ListTimes(sum(one.intervals for one in every), sum(one.covered_s for one in every), added)


def _add(result: dict[str, list[ListTimes]], world: WorldChunk, seen: Tracks) -> None:
    """The configurations in one run, with the lists `seen` in it."""
    end_s = world.scene.end_s
    for name, configuration in world.experiment.configurations.items():
        arriving = listen(seen, world, name, ticks=False)
        heard = taken_in(arriving, configuration.issue_hz)
        issue_s = instants_of(heard)
        issue_s = issue_s[(issue_s >= -_TOLERANCE_S) & (issue_s <= end_s + _TOLERANCE_S)]
        covered_s = float(issue_s[-1] - issue_s[0]) if len(issue_s) > 1 else 0.0
        links = None
        if linked := world.experiment.linked(name):
            sent = world.truth if configuration.units == TRUTH else seen
            links = link_times(sent, arriving, heard, linked, end_s)
        result.setdefault(name, []).append(ListTimes(max(len(issue_s) - 1, 0), covered_s, links))
