"""Gather: the tables of all logs and runs, computed in blocks by several workers, or found among the pieces."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import pandas as pd
import pyarrow as pa

from copem_replay.core.remote import is_url
from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.blocks import Outcome, blocks, outcomes
from copem_replay.pipeline.closed_form import exact_table
from copem_replay.pipeline.cost import Cost
from copem_replay.pipeline.log_tables import LogTables, joined, log_tables
from copem_replay.pipeline.pieces import Pieces, ranges
from copem_replay.pipeline.recipe import recipe
from copem_replay.pipeline.study_log import StudyLog
from copem_replay.pipeline.study_tables import StudyTables

Progress = Callable[[int, int], None]
"""`progress(done, total)`, called after each block of runs."""


_Found = dict[tuple[str, tuple[int, int]], LogTables | None]
"""Pieces of a log by configuration and range of runs; None: it is not there."""

_AT_ONCE = 8
"""So many pieces are read at once of object storage, where one by one is waiting (chosen)."""


@dataclass(frozen=True)
class _Range:
    """Runs of a log in which some configurations have to be computed."""

    log: StudyLog
    experiment: Experiment  # of the log, with these configurations
    runs: tuple[int, int] | None  # None: no more of this log
    recipes: dict[str, str] = field(default_factory=dict)  # by configuration; none: nothing is kept


class Gatherer:
    """Computes tables, or finds them; tells how far it is. `tables`: how many experiments there are to come."""

    def __init__(self, jobs: int, progress: Progress | None, tables: int, cost: Cost, pieces: Pieces | None) -> None:
        self._jobs, self._progress, self._tables, self._cost, self._pieces = jobs, progress, tables, cost, pieces
        self._done = self._runs = 0  # of the runs of all logs, in all tables
        self._silent = False  # of what was gathered before

    def tables(self, logs: Sequence[StudyLog], experiment: Experiment) -> StudyTables:
        """None yet, of any log; those that are added can be read again where pieces are kept."""
        by_name = {log.name: log for log in logs}

        def again(name: str) -> LogTables:
            silent = copy(self)
            silent._silent = True
            (tables,) = silent.each([by_name[name]], experiment)
            return tables

        of_logs = {id(alone): alone for alone in (of_log(experiment, name) for name in by_name)}.values()
        way = any(alone.has_way(name) for alone in of_logs for name in alone.configurations)
        return StudyTables(None if self._pieces is None else again, way=way)

    def each(self, logs: Sequence[StudyLog], experiment: Experiment) -> Iterator[LogTables]:
        """The tables of each log: of all its configurations and runs. A log is in memory while it is its turn."""
        self._runs, found = self._tables * len(logs) * experiment.runs, dict[str, _Found]()
        kept = self._pieces is not None
        plan = self._missing(logs, experiment, found) if kept else self._computing(logs, experiment)
        for of_range, tables in self._computed(plan):
            name = of_range.log.name
            if self._pieces is None:
                yield tables
            elif of_range.runs is None:
                yield joined(name, [piece for piece in found.pop(name).values() if piece is not None])
            for configuration, made_by in of_range.recipes.items():
                assert self._pieces is not None
                assert of_range.runs is not None
                way = of_range.experiment.has_way(configuration)
                piece = self._pieces.write(made_by, tables.of(configuration, way=way))
                found[name][configuration, of_range.runs] = piece

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
            self._pieces.found += piece is not None
            if piece is None:
                mine = alone.model_copy(update={"configurations": {name: configuration}})
                piece = self._pieces.write(made_by, LogTables(log.name, exact_table(log.replay(), mine)))
            parts.append(piece.rows)
        log.drop()
        return pa.concat_tables(
            [one.replace_schema_metadata(None) for one in parts], promote_options="permissive"
        ).to_pandas()

    def _computing(self, logs: Sequence[StudyLog], experiment: Experiment) -> Iterator[_Range]:
        """All runs of each log."""
        for log in logs:
            log.facts(experiment)  # while it is there
            yield _Range(log, alone := of_log(experiment, log.name), (0, alone.runs))

    def _missing(self, logs: Sequence[StudyLog], experiment: Experiment, found: dict[str, _Found]) -> Iterator[_Range]:
        """What has to be computed of each log, and its end; what is there already is put among what is `found`."""
        assert self._pieces is not None
        for log, there in self._read_ahead(logs, experiment):
            alone, found[log.name] = of_log(experiment, log.name), there
            if not self._silent:
                self._pieces.found += sum(piece is not None for piece in there.values())
            for runs in dict.fromkeys(runs for _, runs in there):
                names = [name for name in alone.configurations if there[name, runs] is None]
                if names:
                    mine = alone.model_copy(update={"configurations": {n: alone.configurations[n] for n in names}})
                    yield _Range(log, mine, runs, {n: recipe(alone, n, log.identity, runs) for n in names})
                else:
                    self._went(runs[1] - runs[0])
            yield _Range(log, alone, None)

    def _read_ahead(self, logs: Sequence[StudyLog], experiment: Experiment) -> Iterator[tuple[StudyLog, _Found]]:
        """The pieces of each log that are there; those of the next log are read meanwhile."""
        before: tuple[StudyLog, dict[tuple[str, tuple[int, int]], Future[LogTables | None]]] | None = None
        assert self._pieces is not None
        with ThreadPoolExecutor(_AT_ONCE if is_url(self._pieces.address) else 1) as pool:
            try:
                for log in logs:
                    reading = {key: pool.submit(*of) for key, of in self._wanted(log, experiment)}
                    before, now = (log, reading), before
                    if now is not None:
                        yield now[0], {key: piece.result() for key, piece in now[1].items()}
                if before is not None:
                    yield before[0], {key: piece.result() for key, piece in before[1].items()}
            finally:  # interrupted: what has not begun never does
                pool.shutdown(cancel_futures=True)

    def _wanted(self, log: StudyLog, experiment: Experiment) -> Iterator[tuple[tuple[str, tuple[int, int]], Any]]:
        """By configuration and range of runs how a piece of a log is read."""
        assert self._pieces is not None
        alone, cut = of_log(experiment, log.name), list(ranges(experiment.runs, log.facts(experiment).episodes))
        for name in alone.configurations:
            for runs in cut:
                made_by = recipe(alone, name, log.identity, runs)
                yield (name, runs), (self._pieces.read, made_by, log.name, name)

    def _computed(self, plan: Iterable[_Range]) -> Iterator[tuple[_Range, LogTables]]:
        """The tables of ranges, one after the other. No log is read before the workers have nearly nothing to do."""
        pool, began_s = ThreadPoolExecutor(self._jobs), time.perf_counter()
        waiting: deque[tuple[_Range, list[tuple[int, Future[list[Outcome]]]]]] = deque()
        try:
            for of_range in plan:
                parts = []
                if of_range.runs is not None:
                    replay, alone = of_range.log.replay(), of_range.experiment
                    cut = blocks(replay, alone, self._jobs, of_range.runs)
                    parts = [(len(b), pool.submit(outcomes, replay, alone, b)) for b in cut]
                waiting.append((of_range, parts))
                while waiting and (not waiting[0][1] or sum(len(parts) for _, parts in waiting) > self._jobs):
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
        if of_range.runs is None or self._pieces is None:
            of_range.log.drop()
        if of_range.runs is None:
            return of_range, LogTables(of_range.log.name, pd.DataFrame())
        self._cost.add(0.0, made)
        names, accuracy = list(of_range.experiment.configurations), of_range.experiment.measure.accuracy
        return of_range, log_tables(of_range.log.name, made, names, accuracy=accuracy)

    def _went(self, runs: int) -> None:
        self._done += runs
        if self._progress is not None and not self._silent:
            self._progress(self._done, self._runs)
