"""One run of one log: the receiver's fused lists, configuration by configuration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from copem_replay.core.errors import ExperimentError
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.time_chunk import WHOLE
from copem_replay.core.tracks import TRUTH, Bool, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.chunking import ROWS_HELD, observation_rows
from copem_replay.pipeline.conversions import as_fused_tracks
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.presence import Presence
from copem_replay.pipeline.receiver import Receivers
from copem_replay.pipeline.scoring import match_lists


@dataclass(frozen=True)
class RunTracks:
    """The receiver's fused tracks in one run, configuration by configuration, chunk after chunk.

    As often as one likes; of a log that is one time chunk they are kept, of a longer one made anew each time.
    """

    replay: Replay
    experiment: Experiment
    run: int

    def __iter__(self) -> Iterator[dict[str, FusedTracks]]:
        if len(self.replay.chunks) == 1:
            yield self._all
        else:
            yield from self._made()

    def whole(self) -> dict[str, FusedTracks]:
        """All of it at once. Raises ExperimentError where that is too much."""
        replay = self.replay
        if len(replay.chunks) == 1:
            return self._all
        if observation_rows(replay.scene, replay.truth, replay.expanded) > ROWS_HELD:
            raise ExperimentError(f"{replay.scene.log}: too long to be held at once; take a window of it")
        return replace(self, replay=replace(replay, chunks=(WHOLE,))).whole()

    @cached_property
    def _all(self) -> dict[str, FusedTracks]:
        return next(self._made())

    def _made(self) -> Iterator[dict[str, FusedTracks]]:
        replay, runs = self.replay, np.array([self.run])
        [(_, presence)] = Presence.of(replay.expanded, replay.scene.log, runs).parts(runs)
        receivers = Receivers(runs, presence.sending)
        for world in replay.worlds(self.experiment, runs, presence):
            around = replay.truth_cache_of(world.chunk)
            result = {}
            for name, one in receivers.receive(world):
                if one.fused_tracks is not None:
                    result[name] = one.fused_tracks
                else:
                    matches = match_lists(around, one, self.experiment.measure)
                    result[name] = as_fused_tracks(one.lists, 0, matches, one.heard, one.at.issue_s, one.at.newest)
                if one.faults is not None:
                    result[name] = replace(result[name], faults=one.faults)
                if linked := world.experiment.linked(name):
                    result[name] = replace(result[name], by_link=_by_link(one.sent, linked, presence))
            yield result


def _by_link(sent: Tracks, linked: list[str], presence: Presence) -> Bool:
    """(F,) which lists the units of this run send by a link."""
    sending = np.array([name in linked for name in sent.units])
    if sent.units != (TRUTH,):
        sending &= presence.sending
    there: Bool = sending[sent.frame_unit_ix] & np.isfinite(sent.common_arrives_s)
    return there


def tracks_of_run(replay: Replay, experiment: Experiment, run: int) -> dict[str, FusedTracks]:
    """The receiver's fused tracks in one run of a log that is not long."""
    return RunTracks(replay, experiment, run).whole()
