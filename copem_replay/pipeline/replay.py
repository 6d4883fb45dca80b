"""Replay: the runs of one log, block by block.

A block is a pure function of the prepared log, the experiment and its runs: blocks are computed anywhere, in any order,
by any number of workers, and no result depends on how runs are cut into blocks.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from copem_replay.communication.link import sample_arrivals
from copem_replay.core.tracks import TRUTH, WHOLE, Bool, Float, Int, Tracks, splice_rows
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.detection.by_truth_id import FirstDetections, detect_by_truth_id
from copem_replay.metrics.detection.conflict import ConflictDetector
from copem_replay.metrics.detections_table import (
    DetectionEvents,
    Way,
    build_detection_columns,
    build_frame,
    concatenate_columns,
    find_informing_list,
    first_listed_s,
    pick_list_times,
    stack_events,
)
from copem_replay.metrics.episodes import earliest_sight_s
from copem_replay.pipeline.expansion import ExpandedExperiment, Presence
from copem_replay.pipeline.prepare import ROWS_A_CHUNK, Replay
from copem_replay.pipeline.receiver import (
    ReceiverOutput,
    Receivers,
    convert_to_tracks,
    has_truth_ids,
    perceive_all_units,
    receive_lists,
)
from copem_replay.pipeline.scoring import ConfigurationScores, Scorer, TruthCache
from copem_replay.pipeline.world import OnAir, Perceived, WorldChunk, has_channel

BLOCK_BYTES = 200_000_000
"""Bytes that a block may hold. Larger: fewer blocks, and more memory for each worker."""

STATE_BYTES = 400
"""Bytes of a row × run cell where states are sampled, fused and measured, else one: about fifty numbers."""

TRACK_BYTES = 100
"""Bytes of a row × run cell where all fusion is by truth id; each fused row, one of those of all units, has
`STATE_BYTES` more (measured: 40 to 170 in all with 21 units, 500 with one)."""

LASTING_BYTES = 40
"""Bytes of a row × run cell without states where detection lasts: about five numbers, not only hit or miss."""

WORTH_A_BLOCK = 2_000_000
"""Row × run cells below which a block is not cut further: what all runs share then takes about a tenth of its time."""


@dataclass(frozen=True)
class BlockOutcome:
    """What a block of runs (S,) gives: columns of `detections.parquet`, and the scores of the lists by configuration.

    `assessed (M,)`: of which episodes accuracy is measured, the first of each object. `worked_s`: seconds it took;
    `accuracy_s`: those that `measure: {accuracy: false}` would save.
    """

    log: str
    runs: Int
    columns: dict[str, Any]
    assessed: Bool
    all_scores: dict[str, ConfigurationScores]
    worked_s: float
    accuracy_s: float

    @property
    def table(self) -> pd.DataFrame:
        """The columns as rows."""
        return build_frame(self.columns)


def cut_blocks(replay: Replay, experiment: Experiment, jobs: int, runs: tuple[int, int] | None = None) -> list[Int]:
    """All runs, or those of a range, cut into blocks that are small enough for memory and enough for the workers."""
    begin, end = runs or (0, experiment.runs)
    units = replay.expanded.with_(experiment)
    needs_states = _needs_all(experiment) or experiment.measure.conflict is not None or bool(units.sends)
    if len(replay.chunks) > 1:
        rows = ROWS_A_CHUNK
    else:
        # What units send, and how long it is on air, depends on all that they list.
        needs_all_rows = _needs_all(experiment) or bool(units.sends) or has_channel(units)
        observations = replay.observe(WHOLE) if needs_all_rows else replay.measured
        rows = max(len(observations.tracks.frame_ix), 1)
    even = -(-(end - begin) // jobs)
    # Smaller blocks show progress and can be interrupted sooner; below this size they only cost time.
    small = max(-(-even // 8), WORTH_A_BLOCK // rows)
    detection_lasts = any(
        pem.memory_of(c).get("detection") for pem in experiment.pems.values() for c in range(len(pem.couples))
    )
    cell_bytes = LASTING_BYTES if detection_lasts else 1
    if needs_states:
        cell_bytes = STATE_BYTES
        if not _needs_matches(experiment):
            cell_bytes = min(cell_bytes, TRACK_BYTES + STATE_BYTES // max(len(replay.expanded.units), 1))
    at_once = BLOCK_BYTES // (rows * cell_bytes)
    size = max(1, min(at_once, even, small))
    return [np.arange(k, min(k + size, end)) for k in range(begin, end, size)]


def _needs_all(experiment: Experiment) -> bool:
    """Whether anything depends on whole lists, and not only on whether they hold a measured object."""
    return experiment.measure.accuracy or _needs_matches(experiment)


def _needs_matches(experiment: Experiment) -> bool:
    """Whether any detection is by match, for which lists are needed even without accuracy."""
    others = any(not has_truth_ids(configuration) for configuration in experiment.configurations.values())
    return experiment.measure.match.always or others


def replay_block(replay: Replay, experiment: Experiment, runs: Int) -> pd.DataFrame:
    """Detections alone: the rows of `detections.parquet` of one block of runs (S,), without accuracy."""
    detections_only = experiment.model_copy(
        update={"measure": experiment.measure.model_copy(update={"accuracy": False})}
    )
    return build_frame(concatenate_columns([part.columns for part in replay_outcomes(replay, detections_only, runs)]))


def replay_outcomes(replay: Replay, experiment: Experiment, runs: Int) -> list[BlockOutcome]:
    """What one block of runs (S,) gives; in several parts where not all runs have the same units."""
    presence = Presence.of(replay.expanded, replay.scene.log, runs)
    measure = experiment.measure
    by_entry = measure.confirm.of == 1 and measure.conflict is None and not _needs_all(experiment)
    units = replay.expanded.with_(experiment)
    if by_entry and not units.arrivals_differ:
        return _replay_runs(replay, experiment, runs, presence, apart=False)
    # Which lists there are decides which hits are consecutive: runs with the same units go together.
    return [
        outcome
        for part in presence.parts(runs)
        for outcome in _replay_runs(replay, experiment, *part, apart=units.runs_apart)
    ]


def _replay_runs(
    replay: Replay, experiment: Experiment, runs: Int, presence: Presence, *, apart: bool
) -> list[BlockOutcome]:
    """What runs (S,) give, together or `apart`, one by one; perception and the table are computed together."""
    began_s, sight_s = time.perf_counter(), _find_sights(replay, experiment, presence)
    # Of a log in several chunks the lists of many runs are too much to be held.
    perceived = Perceived(runs, presence.listing) if apart and replay.chunks == (WHOLE,) else None
    pieces = np.split(runs, len(runs)) if apart else [runs]
    results = [_find_known(replay, experiment, piece, presence, sight_s, perceived) for piece in pieces]
    events = stack_events([one.events for one in results])
    columns = build_detection_columns(
        replay.scene, replay.truth, experiment, replay.episodes, replay.encounters, runs, events
    )
    shape = len(events), len(pieces), -1
    assessed = np.zeros(len(replay.episodes.object_ix), dtype=bool)
    assessed[replay.episodes.passes[0][0]] = True
    each_s = (time.perf_counter() - began_s) / len(pieces)
    return [
        BlockOutcome(
            replay.scene.log, piece, {name: column.reshape(shape)[:, k].ravel() for name, column in columns.items()},
            assessed, results[k].all_scores, each_s, results[k].accuracy_s,
        )
        for k, piece in enumerate(pieces)
    ]  # fmt: skip


class _BlockEvents(NamedTuple):
    """Events and scores of a block by configuration, and the seconds that accuracy took."""

    events: dict[str, DetectionEvents]
    all_scores: dict[str, ConfigurationScores]
    accuracy_s: float


def _find_known(
    replay: Replay,
    experiment: Experiment,
    runs: Int,
    presence: Presence,
    sight_s: dict[str, Float],
    perceived: Perceived | None,
) -> _BlockEvents:
    """The detections of runs (S,), and the scores of their lists."""
    measure = experiment.measure
    lists = _BlockLists(replay, replay.expanded.with_(experiment), runs, presence, perceived)
    events = _detect_by_truth_id(lists, experiment, sight_s)
    all_scores: dict[str, ConfigurationScores] = {}
    everything, accuracy_s, lists_s = _needs_all(experiment), 0.0, time.perf_counter()
    if everything or measure.conflict is not None:
        receivers = Receivers(runs, presence.sending)
        judges: dict[str, _Judge] = {}
        for world in replay.worlds(experiment, runs, presence, measured_only=not everything, perceived=perceived):
            around = replay.truth_cache_of(world.chunk)
            for name, output in receivers.receive(world):
                if name not in judges:
                    judges[name] = _Judge(replay, experiment, name, output, receivers.issue_s(name), len(runs))
                judges[name].add(around, output)
        for name, judge in judges.items():
            scores, conflict_known_s = judge.result()
            if scores is not None:
                all_scores[name] = scores
                if name not in events or measure.match.always:
                    events[name] = DetectionEvents(judge.units, scores.detections, sight_s[name])
            if conflict_known_s is not None:
                events[name] = replace(events[name], conflict_known_s=conflict_known_s)
            accuracy_s += judge.accuracy_s
        if not _needs_matches(experiment) and measure.conflict is None:  # lists were fused for accuracy alone
            accuracy_s = time.perf_counter() - lists_s
    for name in filter(experiment.has_way, experiment.configurations):
        events[name] = replace(events[name], way=lists.way(name, events[name].detections))
    return _BlockEvents({name: events[name] for name in experiment.configurations}, all_scores, accuracy_s)


class _Judge:
    """Scores and perceived conflicts of one configuration's lists, chunk by chunk."""

    def __init__(
        self, replay: Replay, experiment: Experiment, name: str, first: ReceiverOutput, issue_s: Float, runs: int
    ) -> None:
        measure = experiment.measure
        self.units, self._runs = first.received.units, runs
        self._scorer = self._conflicts = None
        if _needs_all(experiment):
            frames = replay.held_frames if measure.accuracy else None
            self._scorer = Scorer(
                replay.truth_cache, replay.episodes, first, issue_s, measure, frames,
                experiment.configurations[name].max_age_s,
            )  # fmt: skip
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
                fused_tracks = convert_to_tracks(
                    output.lists, s, matches, output.received, output.instants.issue_s, output.instants.newest
                )
                self._conflicts.add(fused_tracks, s)
        self._conflicts.next(output.instants.issue_s)

    @property
    def accuracy_s(self) -> float:
        """Seconds that measuring accuracy took."""
        return 0.0 if self._scorer is None else self._scorer.accuracy_s

    def result(self) -> tuple[ConfigurationScores | None, Float | None]:
        scores = None if self._scorer is None else self._scorer.result(self._runs)
        return scores, None if self._conflicts is None else self._conflicts.result()


def _find_sights(replay: Replay, experiment: Experiment, presence: Presence) -> dict[str, Float]:
    """By configuration when any of its units first has each episode in sight: (S | 1, M)."""
    units = replay.expanded.with_(experiment)
    return {
        name: earliest_sight_s(replay.first_sights_s, units, units.units_of(configuration), presence.listing)
        for name, configuration in units.configurations.items()
    }


@dataclass(frozen=True)
class _BlockLists:
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
        return _draw_sightings(self.replay, self.units, self.runs, self.presence, self._world.on_air, self.perceived)

    @cached_property
    def _listed(self) -> Tracks:
        """The listed rows, with those that units hold back and do not send."""
        held_back = bool(self.units.sends)
        return (
            _draw_sightings(self.replay, self.units, self.runs, self.presence, None, self.perceived)
            if held_back
            else self._sent
        )

    def arriving(self, name: str) -> Tracks:
        """The lists that the receiver of a configuration hears, by when links deliver them."""
        if name not in self._arriving:
            self._arriving[name] = receive_lists(self._sent, self._world, name, self.presence.sending, ticks=False)
        return self._arriving[name]

    def received(self, name: str) -> Tracks:
        """The lists that the receiver of a configuration hears, by when it takes them in (`issue_hz`)."""
        return sample_arrivals(self.arriving(name), self.units.configurations[name].issue_hz)

    def way(self, name: str, known: FirstDetections) -> Way:
        """When known objects were first listed, and their informing list was sent and arrived."""
        configuration, informing = self.units.configurations[name], find_informing_list(self.received(name), known)
        of_truth, count_earlier = configuration.units == TRUTH, self.units.measure.count_earlier
        listed, sent = (self._world.truth,) * 2 if of_truth else (self._listed, self._sent)
        units = self.units.units_of(configuration) or (TRUTH,)
        return Way(
            first_listed_s(listed, self.replay.episodes, units, count_earlier=count_earlier),
            pick_list_times(informing, sent.common_arrives_s),
            pick_list_times(informing, self.arriving(name).common_arrives_s),
        )


def _detect_by_truth_id(
    lists: _BlockLists, experiment: Experiment, sight_s: dict[str, Float]
) -> dict[str, DetectionEvents]:
    """Detections of the configurations that have truth ids, which need no states, only which rows are listed."""
    events: dict[str, DetectionEvents] = {}
    for name, configuration in lists.units.configurations.items():
        if not has_truth_ids(configuration):
            continue
        received = lists.received(name)
        result = detect_by_truth_id(
            received,
            lists.replay.episodes,
            confirm=experiment.measure.confirm,
            count_earlier=experiment.measure.count_earlier,
            max_age_s=configuration.max_age_s,
        )
        events[name] = DetectionEvents(received.units, result, sight_s[name])
    return events


def _draw_sightings(
    replay: Replay,
    experiment: ExpandedExperiment,
    runs: Int,
    presence: Presence,
    on_air: OnAir | None,
    perceived: Perceived | None,
) -> Tracks:
    """The rows listed in the runs (S,), at least those of measured objects; without states if a log has many chunks."""
    pieces = []
    for chunk in replay.chunks:
        observations = (
            replay.measured if chunk == WHOLE else replay.observe(chunk).of_objects(replay.episodes.object_ix)
        )
        observations = observations.listable
        recorded = None
        if replay.recorded is not None:
            recorded = replay.recorded.captured_between(chunk.from_s, chunk.until_s)
        world = WorldChunk(
            replay.scene, replay.truth, observations, recorded, experiment, chunk, on_air=on_air, perceived=perceived
        )
        seen = perceive_all_units(world, runs, states="true", equipped=presence.listing)
        if chunk == WHOLE:
            return seen
        measured = np.isin(seen.row_object_ix, replay.episodes.object_ix)
        pieces.append(seen.take_rows(np.flatnonzero(seen.valid.any(axis=0) & measured)))
    return splice_rows(pieces, states=False)[0]
