"""Blocks: the runs of one log, block by block. A block is a pure function of what is prepared, so that blocks are
computed anywhere, in any order, by any number of workers.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from copem_replay.core.time_chunk import WHOLE
from copem_replay.core.tracks import Float, Int, Tracks, spliced
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.detection.by_truth_id import detect
from copem_replay.metrics.detection.conflict import Foreseeing
from copem_replay.metrics.detections_table import Events, table
from copem_replay.metrics.line_of_sight import in_sight_s
from copem_replay.pipeline.chunking import ROWS_A_STRETCH
from copem_replay.pipeline.conversions import as_belief
from copem_replay.pipeline.expansion import ExpandedExperiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.presence import Presence
from copem_replay.pipeline.receiver import Believed, Receivers, World, by_truth, listen, seen_by_all
from copem_replay.pipeline.scoring import Appraisal, Appraiser, Surroundings

BLOCK_BYTES = 200_000_000
"""How much a block may hold (chosen)."""

STATE_BYTES = 400
"""Bytes of a row × run cell where states are sampled, fused and measured, else one (chosen: fifty numbers)."""

WORTH_A_BLOCK = 1_000_000
"""Row × run cells below which a block is not cut further (chosen: a few milliseconds)."""


@dataclass(frozen=True)
class Outcome:
    """What a block of runs (S,) gave: rows of `detections.parquet`, and by configuration how good the lists were.

    `worked_s`, `accuracy_s`: how long it took, and how much of that `measure: {accuracy: false}` would have spared.
    """

    log: str
    runs: Int
    table: pd.DataFrame
    appraisals: dict[str, Appraisal]
    worked_s: float
    accuracy_s: float


def blocks(replay: Replay, experiment: Experiment, jobs: int) -> list[Int]:
    """The runs cut into blocks, small enough for memory and enough of them for the workers."""
    states = _needs_all(experiment) or experiment.measure.conflict is not None
    if len(replay.stretches) > 1:
        rows = ROWS_A_STRETCH
    else:
        found = replay.found(WHOLE) if _needs_all(experiment) else replay.measured
        rows = max(len(found.tracks.frame_ix), 1)
    even = -(-experiment.runs // jobs)
    # Smaller ones show progress and can be interrupted sooner, down to a size at which they would only cost time.
    small = max(-(-even // 8), WORTH_A_BLOCK // rows)
    at_once = BLOCK_BYTES // (rows * (STATE_BYTES if states else 1))
    size = max(1, min(at_once, even, small))
    return [np.arange(k, min(k + size, experiment.runs)) for k in range(0, experiment.runs, size)]


def _needs_all(experiment: Experiment) -> bool:
    """Whether anything goes by whole lists, and not only by whether they hold a measured object."""
    return experiment.measure.accuracy or _matches(experiment)


def _matches(experiment: Experiment) -> bool:
    """Whether anything is known by match, for which lists are needed whether their accuracy is measured or not."""
    others = any(not by_truth(configuration) for configuration in experiment.configurations.values())
    return experiment.measure.match.always or others


def replay_block(replay: Replay, experiment: Experiment, runs: Int) -> pd.DataFrame:
    """Only what was known and when: the rows of `detections.parquet` of one block of runs (S,), without accuracy."""
    when = experiment.model_copy(update={"measure": experiment.measure.model_copy(update={"accuracy": False})})
    return pd.concat([part.table for part in outcomes(replay, when, runs)], ignore_index=True)


def outcomes(replay: Replay, experiment: Experiment, runs: Int) -> list[Outcome]:
    """What one block of runs (S,) gives; in several parts where not all runs have the same units."""
    presence = Presence.of(replay.expanded, replay.scene.log, runs)
    measure = experiment.measure
    by_entry = measure.confirm.of == 1 and measure.conflict is None and not _needs_all(experiment)
    if by_entry:
        return [_block(replay, experiment, runs, presence)]
    # Which lists there are decides what is consecutive: runs with the same units go together.
    return [_block(replay, experiment, *part) for part in presence.parts(runs)]


def _block(replay: Replay, experiment: Experiment, runs: Int, presence: Presence) -> Outcome:
    """What runs (S,) give."""
    measure, began_s = experiment.measure, time.perf_counter()
    sight_s = _in_sight(replay, experiment, presence)
    events = _by_truth_id(replay, experiment, runs, presence, sight_s)
    appraisals: dict[str, Appraisal] = {}
    everything, accuracy_s, lists_s = _needs_all(experiment), 0.0, time.perf_counter()
    if everything or measure.conflict is not None:
        receivers = Receivers(runs, presence.sending)
        judges: dict[str, _Judge] = {}
        for world in replay.worlds(experiment, presence.sending, measured_only=not everything):
            around = replay.surroundings_of(world.stretch)
            for name, believed in receivers.believe(world):
                if name not in judges:
                    judges[name] = _Judge(replay, experiment, believed, receivers.issue_s(name), len(runs))
                judges[name].add(around, believed)
        for name, judge in judges.items():
            appraisal, foreseen_s = judge.result()
            if appraisal is not None:
                appraisals[name] = appraisal
                if name not in events or measure.match.always:
                    events[name] = Events(judge.units, appraisal.detections, sight_s[name])
            if foreseen_s is not None:
                events[name] = replace(events[name], foreseen_s=foreseen_s)
            accuracy_s += judge.accuracy_s
        if not _matches(experiment) and measure.conflict is None:  # for nothing else
            accuracy_s = time.perf_counter() - lists_s
    ordered = {name: events[name] for name in experiment.configurations}
    rows = table(replay.scene, replay.truth, experiment, replay.looks, replay.encounters, runs, ordered)
    return Outcome(replay.scene.log, runs, rows, appraisals, time.perf_counter() - began_s, accuracy_s)


class _Judge:
    """What comes of one configuration's lists, stretch by stretch."""

    def __init__(self, replay: Replay, experiment: Experiment, first: Believed, issue_s: Float, runs: int) -> None:
        measure = experiment.measure
        self.units, self._runs = first.heard.units, runs
        self._appraiser = self._foreseeing = None
        if _needs_all(experiment):
            self._appraiser = Appraiser(replay.surroundings, replay.looks, first, issue_s, measure)
        if measure.conflict is not None:
            self._foreseeing = Foreseeing(
                replay.ego,
                replay.looks,
                measure.conflict,
                confirm=measure.confirm,
                count_earlier=measure.count_earlier,
            )

    def add(self, around: Surroundings, believed: Believed) -> None:
        matches = None if self._appraiser is None else self._appraiser.add(around, believed)
        if self._foreseeing is None:
            return
        if believed.belief is not None:
            self._foreseeing.add(believed.belief)
        else:  # lists without truth ids: run by run, by what they were matched with
            assert matches is not None
            for s in range(len(believed.lists.start)):
                belief = as_belief(believed.lists, s, matches, believed.heard, believed.at.issue_s, believed.at.newest)
                self._foreseeing.add(belief, s)
        self._foreseeing.next(believed.at.issue_s)

    @property
    def accuracy_s(self) -> float:
        """How long measuring accuracy took."""
        return 0.0 if self._appraiser is None else self._appraiser.accuracy_s

    def result(self) -> tuple[Appraisal | None, Float | None]:
        appraisal = None if self._appraiser is None else self._appraiser.result(self._runs)
        return appraisal, None if self._foreseeing is None else self._foreseeing.result()


def _in_sight(replay: Replay, experiment: Experiment, presence: Presence) -> dict[str, Float]:
    """By configuration when any of its units first has each look in sight: (S | 1, M)."""
    units = replay.expanded.with_(experiment)
    return {
        name: in_sight_s(replay.first_sights_s, units, units.units_of(configuration), presence.listing)
        for name, configuration in units.configurations.items()
    }


def _by_truth_id(
    replay: Replay, experiment: Experiment, runs: Int, presence: Presence, sight_s: dict[str, Float]
) -> dict[str, Events]:
    """Detections of the configurations that have truth ids: they need no states, only who was listed."""
    units = replay.expanded.with_(experiment)
    chosen = {name: c for name, c in units.configurations.items() if by_truth(c)}
    if not chosen:
        return {}
    seen = _sightings(replay, units, runs, presence)
    events: dict[str, Events] = {}
    for name, configuration in chosen.items():
        heard = listen(seen, replay.truth, units, name, presence.sending)
        result = detect(
            heard,
            replay.looks,
            confirm=experiment.measure.confirm,
            count_earlier=experiment.measure.count_earlier,
            max_age_s=configuration.max_age_s,
        )
        events[name] = Events(heard.units, result, sight_s[name])
    return events


def _sightings(replay: Replay, experiment: ExpandedExperiment, runs: Int, presence: Presence) -> Tracks:
    """Who was listed in the runs (S,), at least of what is looked at. Of a long log without states."""
    pieces = []
    for stretch in replay.stretches:
        found = replay.measured if stretch == WHOLE else replay.found(stretch).of_objects(replay.looks.object_ix)
        found = found.listable
        recorded = None
        if replay.recorded is not None:
            recorded = replay.recorded.captured_between(stretch.from_s, stretch.until_s)
        world = World(replay.scene, replay.truth, found, recorded, experiment, stretch)
        seen = seen_by_all(world, runs, states="true", equipped=presence.listing)
        if stretch == WHOLE:
            return seen
        looked_at = np.isin(seen.row_object_ix, replay.looks.object_ix)
        pieces.append(seen.take_rows(np.flatnonzero(seen.valid.any(axis=0) & looked_at)))
    return spliced(pieces, states=False)[0]
