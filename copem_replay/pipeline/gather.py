"""Gather: the tables of all logs and runs, computed in blocks by several workers, or found among the pieces."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import pandas as pd
import pyarrow as pa

from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.way import WAY
from copem_replay.pipeline.blocks import Outcome, blocks, outcomes
from copem_replay.pipeline.closed_form import exact_table
from copem_replay.pipeline.cost import Cost
from copem_replay.pipeline.log_tables import LogTables, joined, log_tables
from copem_replay.pipeline.pieces import Pieces, ranges
from copem_replay.pipeline.recipe import recipe
from copem_replay.pipeline.study_log import StudyLog

Progress = Callable[[int, int], None]
"""`progress(done, total)`, called after each block of runs."""


@dataclass(frozen=True)
class _Range:
    """Runs of a log in which some configurations have to be computed."""

    log: StudyLog
    experiment: Experiment  # of the log, with these configurations
    runs: tuple[int, int]
    recipes: dict[str, str] = field(default_factory=dict)  # by configuration; none: nothing is kept
    last: bool = False  # of its log


class Gatherer:
    """Computes tables, or finds them; tells how far it is. `tables`: how many experiments there are to come."""

    def __init__(self, jobs: int, progress: Progress | None, tables: int, cost: Cost, pieces: Pieces | None) -> None:
        self._jobs, self._progress, self._tables, self._cost, self._pieces = jobs, progress, tables, cost, pieces
        self._done = self._runs = 0  # of the runs of all logs, in all tables

    def of(self, logs: Sequence[StudyLog], experiment: Experiment) -> list[LogTables]:
        """The tables of each log: of all its configurations and runs. A log is in memory while it is its turn."""
        found: dict[tuple[str, str, tuple[int, int]], LogTables] = {}
        self._runs = self._tables * len(logs) * experiment.runs
        plan = (of_range for log in logs for of_range in self._missing(log, experiment, found))
        whole: dict[str, LogTables] = {}
        for of_range, tables in self._computed(plan):
            name = of_range.log.name
            if self._pieces is None:
                whole[name] = tables
            for configuration, made_by in of_range.recipes.items():
                assert self._pieces is not None
                way = of_range.experiment.has_way(configuration)
                piece = self._pieces.write(made_by, tables.of(configuration, way=way))
                found[name, configuration, of_range.runs] = piece
        return [whole[log.name] if self._pieces is None else self._joined(log, experiment, found) for log in logs]

    def exact(self, log: StudyLog, experiment: Experiment) -> pd.DataFrame:
        """The rows of `exact.parquet` of a log."""
        alone = of_log(experiment, log.name)
        if self._pieces is None:
            table = exact_table(log.replay(), alone)
            log.drop()
            return table
        parts = []
        for name, configuration in alone.configurations.items():
            made_by = recipe(alone, name, log.identity, None)
            piece = self._pieces.read(made_by, log.name, name)
            if piece is None:
                mine = alone.model_copy(update={"configurations": {name: configuration}})
                piece = self._pieces.write(made_by, LogTables(log.name, exact_table(log.replay(), mine)))
            parts.append(piece.rows)
        log.drop()
        return frame_of(parts)

    def _missing(
        self, log: StudyLog, experiment: Experiment, found: dict[tuple[str, str, tuple[int, int]], LogTables]
    ) -> list[_Range]:
        """What has to be computed of a log; what is there already is put among what is `found`."""
        alone, facts = of_log(experiment, log.name), log.facts(experiment)
        if self._pieces is None:
            return [_Range(log, alone, (0, alone.runs), last=True)]
        plan: list[_Range] = []
        for runs in ranges(alone.runs, facts.episodes):
            missing = {}
            for name in alone.configurations:
                made_by = recipe(alone, name, log.identity, runs)
                piece = self._pieces.read(made_by, log.name, name)
                if piece is None:
                    missing[name] = made_by
                else:
                    found[log.name, name, runs] = piece
            if missing:
                mine = {name: alone.configurations[name] for name in missing}
                plan.append(_Range(log, alone.model_copy(update={"configurations": mine}), runs, missing))
            else:
                self._went(runs[1] - runs[0])
        if not plan:
            log.drop()
        return [replace(one, last=one is plan[-1]) for one in plan]

    def _computed(self, plan: Iterable[_Range]) -> Iterator[tuple[_Range, LogTables]]:
        """The tables of ranges, one after the other. No log is read before the workers have nearly nothing to do."""
        pool, began_s = ThreadPoolExecutor(self._jobs), time.perf_counter()
        waiting: deque[tuple[_Range, list[tuple[int, Future[list[Outcome]]]]]] = deque()
        try:
            for of_range in plan:
                replay, alone = of_range.log.replay(), of_range.experiment
                cut = blocks(replay, alone, self._jobs, of_range.runs)
                waiting.append((of_range, [(len(b), pool.submit(outcomes, replay, alone, b)) for b in cut]))
                while sum(len(parts) for _, parts in waiting) > self._jobs:
                    yield self._ended(*waiting.popleft())
            while waiting:
                yield self._ended(*waiting.popleft())
        finally:  # interrupted: what has not begun never does
            pool.shutdown(cancel_futures=True)
            self._cost.add(time.perf_counter() - began_s, ())

    def _ended(self, of_range: _Range, parts: Sequence[tuple[int, Future[list[Outcome]]]]) -> tuple[_Range, LogTables]:
        """The tables of a range, waited for."""
        made = []
        for runs, part in parts:
            made += part.result()
            self._went(runs)
        if of_range.last:
            of_range.log.drop()
        self._cost.add(0.0, made)
        names, accuracy = list(of_range.experiment.configurations), of_range.experiment.measure.accuracy
        return of_range, log_tables(of_range.log.name, made, names, accuracy=accuracy)

    def _went(self, runs: int) -> None:
        self._done += runs
        if self._progress is not None:
            self._progress(self._done, self._runs)

    def _joined(
        self, log: StudyLog, experiment: Experiment, found: dict[tuple[str, str, tuple[int, int]], LogTables]
    ) -> LogTables:
        names = of_log(experiment, log.name).configurations
        cut = list(ranges(experiment.runs, log.facts(experiment).episodes))
        return joined(log.name, [found[log.name, name, runs] for name in names for runs in cut])


def frame_of(rows: Sequence[pd.DataFrame | pa.Table]) -> pd.DataFrame:
    """Rows of several logs in one table, of the same kinds however they came to be."""
    arrow = [one for one in rows if isinstance(one, pa.Table)]
    if len(arrow) < len(rows):
        return _way_last(pd.concat(rows, ignore_index=True).infer_objects())
    table = pa.concat_tables([one.replace_schema_metadata(None) for one in arrow], promote_options="permissive")
    frame = table.to_pandas()
    if "braking_pass" in frame:
        frame["braking_pass"] = pd.array(frame["braking_pass"], dtype="boolean")
    return _way_last(frame)


def _way_last(frame: pd.DataFrame) -> pd.DataFrame:
    """Columns that only some configurations have are in one place, however the tables came together."""
    if not set(WAY) <= set(frame):
        return frame
    return frame[[*(name for name in frame if name not in WAY), *WAY]]
