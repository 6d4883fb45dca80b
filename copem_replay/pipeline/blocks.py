"""Blocks: the runs of one log, block by block. A block is a pure function of what is prepared, so that blocks are
computed anywhere, in any order, by any number of workers.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from copem_replay.communication.link import taken_in
from copem_replay.core.time_chunk import WHOLE
from copem_replay.core.tracks import TRUTH, Float, Int, Tracks, spliced
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.columns import beneath, frame
from copem_replay.metrics.detection.by_truth_id import Detections, detect
from copem_replay.metrics.detection.conflict import ConflictDetector
from copem_replay.metrics.detections_table import Events, stacked, table
from copem_replay.metrics.line_of_sight import in_sight_s
from copem_replay.metrics.way import Way, at_list, first_listed_s, list_that_told
from copem_replay.pipeline.chunking import ROWS_A_CHUNK
from copem_replay.pipeline.conversions import as_fused_tracks
from copem_replay.pipeline.expansion import ExpandedExperiment
from copem_replay.pipeline.on_air import OnAir, has_channel
from copem_replay.pipeline.perceived import Perceived
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.presence import Presence
from copem_replay.pipeline.receiver import ReceiverOutput, Receivers, WorldChunk, by_truth, listen, seen_by_all
from copem_replay.pipeline.scoring import Scorer, Scores, TruthCache

BLOCK_BYTES = 200_000_000
"""How much a block may hold (chosen)."""

STATE_BYTES = 400
"""Bytes of a row × run cell where states are sampled, fused and measured, else one (chosen: fifty numbers)."""

TRACK_BYTES = 100
"""The same where all fuse by truth id, and of each row that they make of those of the units `STATE_BYTES` (measured:
40 to 170 in all of 21 units, 500 of one)."""

LASTING_BYTES = 40
"""Without states, where detection lasts: numbers themselves, not only whether they are below p (chosen)."""

WORTH_A_BLOCK = 2_000_000
"""Row × run cells below which a block is not cut further (chosen: what is the same for all runs takes a tenth)."""


@dataclass(frozen=True)
class Outcome:
    """What a block of runs (S,) gave: columns of `detections.parquet`, and by configuration how good the lists were.

    `worked_s`, `accuracy_s`: how long it took, and how much of that `measure: {accuracy: false}` would have spared.
    """

    log: str
    runs: Int
    columns: dict[str, Any]
    all_scores: dict[str, Scores]
    worked_s: float
    accuracy_s: float

    @property
    def table(self) -> pd.DataFrame:
        """The columns as rows."""
        return frame(self.columns)


def blocks(replay: Replay, experiment: Experiment, jobs: int, runs: tuple[int, int] | None = None) -> list[Int]:
    """The runs, or those from … up to, cut into blocks, small enough for memory and enough of them for the workers."""
    begin, end = runs or (0, experiment.runs)
    units = replay.expanded.with_(experiment)
    states = _needs_all(experiment) or experiment.measure.conflict is not None or bool(units.sends)
    if len(replay.chunks) > 1:
        rows = ROWS_A_CHUNK
    else:
        # What is sent, and how long it is in the air, goes by all that is listed.
        every = _needs_all(experiment) or bool(units.sends) or has_channel(units)
        found = replay.found(WHOLE) if every else replay.measured
        rows = max(len(found.tracks.frame_ix), 1)
    even = -(-(end - begin) // jobs)
    # Smaller ones show progress and can be interrupted sooner, down to a size at which they would only cost time.
    small = max(-(-even // 8), WORTH_A_BLOCK // rows)
    lasts = any(pem.memory_of(c).get("detection") for pem in experiment.pems.values() for c in range(len(pem.couples)))
    cell = LASTING_BYTES if lasts else 1
    if states:
        cell = STATE_BYTES
        if not _matches(experiment):
            cell = min(cell, TRACK_BYTES + STATE_BYTES // max(len(replay.expanded.units), 1))
    at_once = BLOCK_BYTES // (rows * cell)
    size = max(1, min(at_once, even, small))
    return [np.arange(k, min(k + size, end)) for k in range(begin, end, size)]


def _needs_all(experiment: Experiment) -> bool:
    """Whether anything goes by whole lists, and not only by whether they hold a measured object."""
    return experiment.measure.accuracy or _matches(experiment)


def _matches(experiment: Experiment) -> bool:
    """Whether anything is known by match, for which lists are needed whether their accuracy is measured or not."""
    others = any(not by_truth(configuration) for configuration in experiment.configurations.values())
    return experiment.measure.match.always or others


def replay_block(replay: Replay, experiment: Experiment, runs: Int) -> pd.DataFrame:
    """Detections alone: the rows of `detections.parquet` of one block of runs (S,), without accuracy."""
    when = experiment.model_copy(update={"measure": experiment.measure.model_copy(update={"accuracy": False})})
    return frame(beneath([part.columns for part in outcomes(replay, when, runs)]))


def outcomes(replay: Replay, experiment: Experiment, runs: Int) -> list[Outcome]:
    """What one block of runs (S,) gives; in several parts where not all runs have the same units."""
    presence = Presence.of(replay.expanded, replay.scene.log, runs)
    measure = experiment.measure
    by_entry = measure.confirm.of == 1 and measure.conflict is None and not _needs_all(experiment)
    units = replay.expanded.with_(experiment)
    if by_entry and not units.arrivals_differ:
        return _block(replay, experiment, runs, presence, apart=False)
    # Which lists there are decides what is consecutive: runs with the same units go together.
    return [
        outcome
        for part in presence.parts(runs)
        for outcome in _block(replay, experiment, *part, apart=units.runs_apart)
    ]


def _block(replay: Replay, experiment: Experiment, runs: Int, presence: Presence, *, apart: bool) -> list[Outcome]:
    """What runs (S,) give, at once or `apart`, one by one; what they perceive and their table are made at once."""
    began_s, sight_s = time.perf_counter(), _in_sight(replay, experiment, presence)
    # Of a log in several chunks what is listed in many runs is too much to be held.
    perceived = Perceived(runs, presence.listing) if apart and replay.chunks == (WHOLE,) else None
    pieces = np.split(runs, len(runs)) if apart else [runs]
    known = [_known(replay, experiment, piece, presence, sight_s, perceived) for piece in pieces]
    events = stacked([one.events for one in known])
    columns = table(replay.scene, replay.truth, experiment, replay.episodes, replay.encounters, runs, events)
    shape = len(events), len(pieces), -1
    each_s = (time.perf_counter() - began_s) / len(pieces)
    return [
        Outcome(
            replay.scene.log, piece, {name: column.reshape(shape)[:, k].ravel() for name, column in columns.items()},
            known[k].all_scores, each_s, known[k].accuracy_s,
        )
        for k, piece in enumerate(pieces)
    ]  # fmt: skip


class _Known(NamedTuple):
    events: dict[str, Events]
    all_scores: dict[str, Scores]
    accuracy_s: float


def _known(
    replay: Replay,
    experiment: Experiment,
    runs: Int,
    presence: Presence,
    sight_s: dict[str, Float],
    perceived: Perceived | None,
) -> _Known:
    """What runs (S,) came to know and when, and how good their lists were."""
    measure = experiment.measure
    lists = _Lists(replay, replay.expanded.with_(experiment), runs, presence, perceived)
    events = _by_truth_id(lists, experiment, sight_s)
    all_scores: dict[str, Scores] = {}
    everything, accuracy_s, lists_s = _needs_all(experiment), 0.0, time.perf_counter()
    if everything or measure.conflict is not None:
        receivers = Receivers(runs, presence.sending)
        judges: dict[str, _Judge] = {}
        for world in replay.worlds(experiment, runs, presence, measured_only=not everything, perceived=perceived):
            around = replay.truth_cache_of(world.chunk)
            for name, output in receivers.receive(world):
                if name not in judges:
                    judges[name] = _Judge(replay, experiment, output, receivers.issue_s(name), len(runs))
                judges[name].add(around, output)
        for name, judge in judges.items():
            scores, conflict_known_s = judge.result()
            if scores is not None:
                all_scores[name] = scores
                if name not in events or measure.match.always:
                    events[name] = Events(judge.units, scores.detections, sight_s[name])
            if conflict_known_s is not None:
                events[name] = replace(events[name], conflict_known_s=conflict_known_s)
            accuracy_s += judge.accuracy_s
        if not _matches(experiment) and measure.conflict is None:  # for nothing else
            accuracy_s = time.perf_counter() - lists_s
    for name in filter(experiment.has_way, experiment.configurations):
        events[name] = replace(events[name], way=lists.way(name, events[name].detections))
    return _Known({name: events[name] for name in experiment.configurations}, all_scores, accuracy_s)


class _Judge:
    """What comes of one configuration's lists, chunk by chunk."""

    def __init__(
        self, replay: Replay, experiment: Experiment, first: ReceiverOutput, issue_s: Float, runs: int
    ) -> None:
        measure = experiment.measure
        self.units, self._runs = first.heard.units, runs
        self._scorer = self._conflicts = None
        if _needs_all(experiment):
            self._scorer = Scorer(replay.truth_cache, replay.episodes, first, issue_s, measure)
        if measure.conflict is not None:
            self._conflicts = ConflictDetector(
                replay.ego,
                replay.episodes,
                measure.conflict,
                confirm=measure.confirm,
                count_earlier=measure.count_earlier,
            )

    def add(self, around: TruthCache, output: ReceiverOutput) -> None:
        matches = None if self._scorer is None else self._scorer.add(around, output)
        if self._conflicts is None:
            return
        if output.fused_tracks is not None:
            self._conflicts.add(output.fused_tracks)
        else:  # lists without truth ids: run by run, by what they were matched with
            assert matches is not None
            for s in range(len(output.lists.start)):
                fused_tracks = as_fused_tracks(
                    output.lists, s, matches, output.heard, output.at.issue_s, output.at.newest
                )
                self._conflicts.add(fused_tracks, s)
        self._conflicts.next(output.at.issue_s)

    @property
    def accuracy_s(self) -> float:
        """How long measuring accuracy took."""
        return 0.0 if self._scorer is None else self._scorer.accuracy_s

    def result(self) -> tuple[Scores | None, Float | None]:
        scores = None if self._scorer is None else self._scorer.result(self._runs)
        return scores, None if self._conflicts is None else self._conflicts.result()


def _in_sight(replay: Replay, experiment: Experiment, presence: Presence) -> dict[str, Float]:
    """By configuration when any of its units first has each episode in sight: (S | 1, M)."""
    units = replay.expanded.with_(experiment)
    return {
        name: in_sight_s(replay.first_sights_s, units, units.units_of(configuration), presence.listing)
        for name, configuration in units.configurations.items()
    }


@dataclass(frozen=True)
class _Lists:
    """Listed rows of the runs (S,), by truth id and without states, and when these lists arrive; made when needed."""

    replay: Replay
    units: ExpandedExperiment
    runs: Int
    presence: Presence
    perceived: Perceived | None
    _arriving: dict[str, Tracks] = field(default_factory=dict)

    @cached_property
    def _world(self) -> WorldChunk:
        replay, units = self.replay, self.units
        on_air = replay.on_air(units.written, self.runs, self.presence.listing, self.perceived)
        return WorldChunk(replay.scene, replay.truth, replay.measured, replay.recorded, units, on_air=on_air)

    @cached_property
    def _sent(self) -> Tracks:
        return _sightings(self.replay, self.units, self.runs, self.presence, self._world.on_air, self.perceived)

    @cached_property
    def _listed(self) -> Tracks:
        """The same, what units hold back with it."""
        held_back = bool(self.units.sends)
        return (
            _sightings(self.replay, self.units, self.runs, self.presence, None, self.perceived)
            if held_back
            else self._sent
        )

    def arriving(self, name: str) -> Tracks:
        """When the lists arrive that the receiver of a configuration hears."""
        if name not in self._arriving:
            self._arriving[name] = listen(self._sent, self._world, name, self.presence.sending, ticks=False)
        return self._arriving[name]

    def heard(self, name: str) -> Tracks:
        """And when it takes them in."""
        return taken_in(self.arriving(name), self.units.configurations[name].issue_hz)

    def way(self, name: str, known: Detections) -> Way:
        """Of what the receiver of a configuration knows."""
        configuration, told = self.units.configurations[name], list_that_told(self.heard(name), known)
        of_truth, count_earlier = configuration.units == TRUTH, self.units.measure.count_earlier
        listed, sent = (self._world.truth,) * 2 if of_truth else (self._listed, self._sent)
        units = self.units.units_of(configuration) or (TRUTH,)
        return Way(
            first_listed_s(listed, self.replay.episodes, units, count_earlier=count_earlier),
            at_list(told, sent.common_arrives_s),
            at_list(told, self.arriving(name).common_arrives_s),
        )


def _by_truth_id(lists: _Lists, experiment: Experiment, sight_s: dict[str, Float]) -> dict[str, Events]:
    """Detections of the configurations that have truth ids: they need no states, only which rows are listed."""
    events: dict[str, Events] = {}
    for name, configuration in lists.units.configurations.items():
        if not by_truth(configuration):
            continue
        heard = lists.heard(name)
        result = detect(
            heard,
            lists.replay.episodes,
            confirm=experiment.measure.confirm,
            count_earlier=experiment.measure.count_earlier,
            max_age_s=configuration.max_age_s,
        )
        events[name] = Events(heard.units, result, sight_s[name])
    return events


def _sightings(
    replay: Replay,
    experiment: ExpandedExperiment,
    runs: Int,
    presence: Presence,
    on_air: OnAir | None,
    perceived: Perceived | None,
) -> Tracks:
    """The rows listed in the runs (S,), at least of measured objects. Of a long log without states."""
    pieces = []
    for chunk in replay.chunks:
        found = replay.measured if chunk == WHOLE else replay.found(chunk).of_objects(replay.episodes.object_ix)
        found = found.listable
        recorded = None
        if replay.recorded is not None:
            recorded = replay.recorded.captured_between(chunk.from_s, chunk.until_s)
        world = WorldChunk(
            replay.scene, replay.truth, found, recorded, experiment, chunk, on_air=on_air, perceived=perceived
        )
        seen = seen_by_all(world, runs, states="true", equipped=presence.listing)
        if chunk == WHOLE:
            return seen
        measured = np.isin(seen.row_object_ix, replay.episodes.object_ix)
        pieces.append(seen.take_rows(np.flatnonzero(seen.valid.any(axis=0) & measured)))
    return spliced(pieces, states=False)[0]
