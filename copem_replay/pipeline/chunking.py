"""Time chunks: a long log is replayed piece by piece, so that memory does not grow with its length.

What is cut are the receiver's instants: a time chunk has those from `from_s` on and before `until_s`. Its lists, what
is fused of them, matched and measured are made, used and forgotten before the next one; what must be remembered across
a cut is. Where the cuts are changes no result, and a log that is not long is one time chunk.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise

import numpy as np

from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.core.interpolation import AROUND_S
from copem_replay.core.time_chunk import WHOLE, TimeChunk
from copem_replay.core.tracks import Float, Scene, Tracks
from copem_replay.experiment.schema import Configuration
from copem_replay.fusion.base import ListFusion
from copem_replay.perception.sensor_poses import list_instants
from copem_replay.pipeline.expansion import ExpandedExperiment
from copem_replay.pipeline.stated_captures import StatedCaptures

ROWS_AT_ONCE = 500_000
"""A log with at most so many observation rows is one time chunk (chosen: shown, too, it takes about 1 GB)."""
ROWS_A_CHUNK = 250_000
"""Observation rows of a time chunk of a longer one (chosen: a few hundred MB)."""
ROWS_HELD = 4_000_000
"""What needs all of a log at once gets it where it has at most so many (chosen: some GB)."""
_AFTER = 0.381966
"""Where between two frames a cut is (chosen: hardly any latency brings a list there)."""


def time_chunks(scene: Scene, truth: Tracks, experiment: ExpandedExperiment) -> tuple[TimeChunk, ...]:
    """A log in time chunks of about as many observation rows each."""
    if not _can_be_cut(experiment.configurations.values()):
        return (WHOLE,)
    rows = observation_rows(scene, truth, experiment)
    if rows <= ROWS_AT_ONCE:
        return (WHOLE,)
    _, bounds = truth.by_frame
    pieces = int(-(-rows // ROWS_A_CHUNK))
    frames = np.unique(np.searchsorted(bounds, np.linspace(0, len(truth.frame_ix), pieces + 1)[1:-1]))
    frames = frames[(frames > 0) & (frames < len(truth.stamp_ns))]
    before_s, after_s = truth.captured_s[frames - 1], truth.captured_s[frames]
    # Where lists of different configurations are available within a nanosecond no cut may come between them.
    cuts = [-np.inf, *(before_s + _AFTER * (after_s - before_s)).tolist(), np.inf]
    return tuple(TimeChunk(*pair) for pair in pairwise(cuts))


def observation_rows(scene: Scene, truth: Tracks, experiment: ExpandedExperiment) -> float:
    """About how many there are, those of the truth, which is perceived, too, among them."""
    lists = sum(len(list_instants(scene, truth, unit)) for unit in experiment.modelled.values())
    return len(truth.frame_ix) * (1 + lists / max(len(truth.stamp_ns), 1))


def _can_be_cut(configurations: Iterable[Configuration]) -> bool:
    return all(fusion.resumable for c in configurations if isinstance(fusion := c.fusion, ListFusion))


class Reach:
    """How early a list may have been captured that is gone by at an instant of a time chunk, or needed once more.

    `heard`: by configuration the lists that its receiver hears, whatever is in them; `stated`: what their units say of
    the captures, where that is not the truth.
    """

    def __init__(
        self,
        experiment: ExpandedExperiment,
        heard: Mapping[str, Tracks],
        stated: Mapping[str, StatedCaptures | None] | None = None,
    ) -> None:
        self._oldest: list[tuple[Float, Float]] = []  # instants, and the oldest capture that each needs
        self._again: list[tuple[Float, Float]] = []
        for name, configuration in experiment.configurations.items():
            mine = heard[name]
            at = fusion_schedule(mine, max_age_s=configuration.max_age_s)
            if not len(at.issue_s):
                continue
            # What arrives at an instant, and what else is gone by.
            oldest_s = np.minimum.reduceat(mine.captured_s[at.arrived], at.arrived_start[:-1])
            used_s = np.where(at.newest >= 0, mine.captured_s[at.newest], np.inf).min(axis=1)
            if partial := {
                n for n, of in experiment.modelled.items() if of.sends is not None and of.sends.partial
            }:  # entries are kept for long after a message that leaves them out
                of = np.array([unit in partial for unit in mine.units], dtype=bool)[mine.frame_unit_ix]
                way_s = np.where(of & np.isfinite(mine.common_arrives_s), mine.common_arrives_s - mine.captured_s, 0.0)
                used_s = np.minimum(used_s, at.issue_s - configuration.max_age_s - way_s.max(initial=0.0))
            self._oldest.append((at.issue_s, np.minimum(oldest_s, used_s)))
            fusion = configuration.fusion
            if isinstance(fusion, ListFusion) and fusion.looks_back_s > 0:
                arrives_s, captured_s = mine.common_arrives_s[at.arrived], mine.captured_s[at.arrived]
                ahead_s = 0.0
                if stated is not None and (told := stated[name]) is not None:  # it looks back by what it is told
                    captured_s, ahead_s = told.stated_s[at.arrived], told.ahead_s
                newest_s = np.maximum.accumulate(captured_s)
                self._again.append((arrives_s, newest_s - ahead_s - fusion.looks_back_s - AROUND_S))

    def earliest_s(self, chunk: TimeChunk) -> float:
        """The earliest capture that a time chunk needs."""
        earliest_s = chunk.from_s
        for issue_s, oldest_s in self._oldest:
            first, after = np.searchsorted(issue_s, (chunk.from_s, chunk.until_s))
            earliest_s = min(earliest_s, float(oldest_s[first:after].min(initial=np.inf)) - AROUND_S)
        for arrives_s, needed_s in self._again:
            arrived = int(np.searchsorted(arrives_s, chunk.from_s))
            if arrived:
                earliest_s = min(earliest_s, float(needed_s[arrived - 1]))
        return earliest_s
