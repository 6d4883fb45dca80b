"""One run of one log: the receiver's fused lists, configuration by configuration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from copem_replay.core.errors import ExperimentError
from copem_replay.core.fused_tracks import Belief
from copem_replay.core.time_chunk import WHOLE
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.chunking import ROWS_HELD, candidate_rows
from copem_replay.pipeline.conversions import as_belief
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.presence import Presence
from copem_replay.pipeline.receiver import Receivers
from copem_replay.pipeline.scoring import match_lists


@dataclass(frozen=True)
class Beliefs:
    """What the receiver believes in one run, configuration by configuration: its fused lists, stretch after stretch.

    As often as one likes; of a log that is one stretch they are kept, of a longer one made anew each time.
    """

    replay: Replay
    experiment: Experiment
    run: int

    def __iter__(self) -> Iterator[dict[str, Belief]]:
        if len(self.replay.stretches) == 1:
            yield self._all
        else:
            yield from self._made()

    def whole(self) -> dict[str, Belief]:
        """All of it at once. Raises ExperimentError where that is too much."""
        replay = self.replay
        if len(replay.stretches) == 1:
            return self._all
        if candidate_rows(replay.scene, replay.truth, replay.expanded) > ROWS_HELD:
            raise ExperimentError(f"{replay.scene.log}: too long to be held at once; take a window of it")
        return replace(self, replay=replace(replay, stretches=(WHOLE,))).whole()

    @cached_property
    def _all(self) -> dict[str, Belief]:
        return next(self._made())

    def _made(self) -> Iterator[dict[str, Belief]]:
        replay, runs = self.replay, np.array([self.run])
        [(_, presence)] = Presence.of(replay.expanded, replay.scene.log, runs).parts(runs)
        receivers = Receivers(runs, presence.sending)
        for world in replay.worlds(self.experiment, presence.sending):
            around = replay.surroundings_of(world.stretch)
            result = {}
            for name, one in receivers.believe(world):
                if one.belief is not None:
                    result[name] = one.belief
                else:
                    matches = match_lists(around, one, self.experiment.measure)
                    result[name] = as_belief(one.lists, 0, matches, one.heard, one.at.issue_s, one.at.newest)
            yield result


def believed(replay: Replay, experiment: Experiment, run: int) -> dict[str, Belief]:
    """What the receiver believes in one run of a log that is not long."""
    return Beliefs(replay, experiment, run).whole()
