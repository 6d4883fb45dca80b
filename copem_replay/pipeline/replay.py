"""Replay: the runs of one log, block by block.

A block is a pure function of the prepared log, the experiment and its runs: blocks are computed anywhere, in any order,
by any number of workers, and no result depends on how runs are cut into blocks.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from copem_replay.core.tracks import TRUTH, Bool, Int, Tracks, splice_rows
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.detection.by_truth_id import FirstDetections, detect_by_truth_id
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
from copem_replay.perception.sight import measure_sight
from copem_replay.pipeline.chain import fuse_members
from copem_replay.pipeline.expansion import ExpandedExperiment, RunGroup, group_runs
from copem_replay.pipeline.prepare import ROWS_A_CHUNK, Replay
from copem_replay.pipeline.receiver import Receivers, states_needed
from copem_replay.pipeline.scoring import ConfigurationScores, Judge
from copem_replay.pipeline.world import States, Transmission, has_channel

if TYPE_CHECKING:
    import pandas as pd

BLOCK_BYTES, CHUNK_BYTES = 80_000_000, 400_000_000
"""Bytes that a block may hold, and one of a log in time chunks, for each of which its truth and views are made anew.
Larger: fewer blocks, and more memory for each worker."""

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
    """The results of a block of runs (S,): columns of `detections.parquet`, and scores of the lists by configuration.

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
    """The runs, or a range of them, cut into blocks: small enough for memory, and enough of them for the workers."""
    begin, end = runs or (0, experiment.runs)
    units = replay.expand(experiment)
    rows, room = ROWS_A_CHUNK, CHUNK_BYTES
    if len(replay.chunks) == 1:
        room = BLOCK_BYTES
        observations = replay.observe(replay.chunks[0]) if _needs_all_rows(units) else replay.measured
        rows = max(len(observations.tracks.frame_ix), 1)
    even = -(-(end - begin) // jobs)
    # Smaller blocks show progress and can be interrupted sooner; below this size they only cost time.
    small = max(-(-even // 8), WORTH_A_BLOCK // rows)
    detection_lasts = any(
        pem.memory_of(c).get("detection") for pem in experiment.pems.values() for c in range(len(pem.couples))
    )
    cell_bytes = LASTING_BYTES if detection_lasts else 1
    if _needs_lists(units) or experiment.measure.conflict is not None or units.sends:
        cell_bytes = STATE_BYTES
        if not _needs_matches(units):
            cell_bytes = min(cell_bytes, TRACK_BYTES + STATE_BYTES // max(len(replay.expanded.units), 1))
    at_once = room // (rows * cell_bytes)
    size = max(1, min(at_once, even, small))
    return [np.arange(k, min(k + size, end)) for k in range(begin, end, size)]


def _needs_lists(units: ExpandedExperiment) -> bool:
    """Whether anything depends on whole lists, and not only on whether they hold a measured object."""
    return units.measure.accuracy or _needs_matches(units)


def _needs_matches(units: ExpandedExperiment) -> bool:
    """Whether any detection is by match, for which lists are needed even without accuracy."""
    return not all(of.by_truth_id for of in units.facts.values())


def _needs_all_rows(units: ExpandedExperiment) -> bool:
    """Whether rows of all objects are drawn: what units send, and how long it is on air, depends on them, too."""
    return _needs_lists(units) or bool(units.sends) or has_channel(units)


def replay_block(replay: Replay, experiment: Experiment, runs: Int) -> pd.DataFrame:
    """Detections alone: the rows of `detections.parquet` of one block of runs (S,), without accuracy."""
    detections_only = experiment.model_copy(
        update={"measure": experiment.measure.model_copy(update={"accuracy": False})}
    )
    return build_frame(concatenate_columns([part.columns for part in replay_outcomes(replay, detections_only, runs)]))


def replay_outcomes(replay: Replay, experiment: Experiment, runs: Int) -> list[BlockOutcome]:
    """The outcomes of one block of runs (S,); several parts where not all runs have the same lists."""
    began_s, units, measure = time.perf_counter(), replay.expand(experiment), experiment.measure
    # Which lists there are decides which hits are consecutive.
    by_entry = measure.confirm.of == 1 and measure.conflict is None and not _needs_lists(units)
    groups = group_runs(units, replay.scene.log, runs, entries_alone=by_entry)
    known = [replay_runs(replay, units, group) for group in groups]
    # The table of all runs at once: made for each alone it takes longer than their replay.
    together = np.concatenate([group.runs for group in groups])
    events = stack_events([one.events for one in known], [len(group.runs) for group in groups])
    columns = build_detection_columns(
        replay.scene, replay.truth, experiment, replay.episodes, replay.encounters, together, events
    )
    assessed = np.zeros(len(replay.episodes.object_ix), dtype=bool)
    assessed[replay.episodes.passes[0][0]] = True
    each_s, cuts = (time.perf_counter() - began_s) / len(groups), np.cumsum([len(group.runs) for group in groups])[:-1]
    shape = len(events), len(runs), -1
    by_run = {name: column.reshape(shape) for name, column in columns.items()}
    parts = {name: np.split(values, cuts, axis=1) for name, values in by_run.items()}
    return [
        BlockOutcome(
            replay.scene.log, group.runs, {name: part[k].ravel() for name, part in parts.items()}, assessed,
            known[k].all_scores, each_s, known[k].accuracy_s,
        )
        for k, group in enumerate(groups)
    ]  # fmt: skip


class GroupOutcome(NamedTuple):
    """Events and scores of a group of runs by configuration, and the seconds that accuracy took."""

    events: dict[str, DetectionEvents]
    all_scores: dict[str, ConfigurationScores]
    accuracy_s: float


def replay_runs(log: Replay, experiment: Experiment, group: RunGroup) -> GroupOutcome:
    """The events and scores of every configuration in the runs (S,) of a group, which have the same lists."""
    units, measure = log.expand(experiment), experiment.measure
    # For detection by truth id alone is drawn which rows are listed; else states as well, for matches of all rows.
    matched = _needs_lists(units)
    fused = list(units.configurations) if matched or measure.conflict is not None else []
    states: States = next(filter(None, (states_needed(units.configurations[name]) for name in fused)), "true")

    lists = Transmission(fuse_members(log, units, group), units, group, complete=_needs_all_rows(units), states=states)
    receivers, sightings = Receivers(lists, fused), list[Tracks]()
    judges = {name: Judge(log, units, name, receivers.issue_s(name), matches=matched) for name in fused}
    began_s = time.perf_counter()
    for world in receivers.worlds():
        observed = world.sightings(lists.states)  # perceive
        sightings.append(observed.in_lists_of(sightings[0] if sightings else observed))
        cache = log.truth_cache_of(world.chunk)
        for name, judge in judges.items():
            output = receivers.fuse(world, name)  # transmit, fuse
            matches = judge.match(cache, output)
            judge.measure(cache, output, matches)
    took_s = time.perf_counter() - began_s

    listed = sightings[0] if len(sightings) == 1 else splice_rows(sightings, states=False)[0]
    scores = {name: scores for name, judge in judges.items() if (scores := judge.scores(len(group.runs))) is not None}
    events = {}
    for name in units.configurations:
        known = scores[name].detections if name in scores and not units.facts[name].by_truth_id else None
        conflict_known_s = judges[name].conflict_known_s() if name in judges else None
        events[name] = replace(find_events(lists, name, listed, known), conflict_known_s=conflict_known_s)
    # Lists that are matched for accuracy alone would not even be fused.
    for_accuracy = measure.accuracy and not _needs_matches(units) and measure.conflict is None
    accuracy_s = took_s if for_accuracy else sum(judge.accuracy_s for judge in judges.values())
    return GroupOutcome(events, scores, accuracy_s)


def find_events(lists: Transmission, name: str, listed: Tracks, known: FirstDetections | None) -> DetectionEvents:
    """The detections of one configuration: `known` by match, None: by truth id; and their way to the receiver.

    `listed`: the rows that units list, at least those of objects with an episode.
    """
    log, units, measure = lists.log, lists.experiment, lists.experiment.measure
    configuration = units.configurations[name]
    names, of_truth = units.units_of(configuration), configuration.units == TRUTH
    listed, ready = (log.measured_truth, lists.truth) if of_truth else (listed, lists.lists)
    received = lists.receive(listed if of_truth else lists.send(listed), name)
    detections = known or detect_by_truth_id(
        received, log.episodes, confirm=measure.confirm, count_earlier=measure.count_earlier,
        max_age_s=configuration.max_age_s,
    )  # fmt: skip
    listed_s, way = detections.captured_s, None
    if units.has_way(name) or known is not None or measure.confirm.of > 1:
        listed_s = first_listed_s(listed, log.episodes, names or (TRUTH,), count_earlier=measure.count_earlier)
    if units.has_way(name):
        informing = find_informing_list(received, detections)
        arriving = lists.arriving(name).common_arrives_s
        way = Way(listed_s, *(pick_list_times(informing, times_s) for times_s in (ready.common_arrives_s, arriving)))
    until_s = np.fmin(np.fmin(listed_s, detections.captured_s), log.episodes.ended_s)
    sensing = None if of_truth else units.list_sensing(names)
    sight = measure_sight(log.sight_spans, log.sighted, sensing, lists.group.listing, until_s)
    return DetectionEvents(received.units, detections, sight, way=way)
