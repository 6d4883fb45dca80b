"""Run: an experiment over its logs, from blocks of runs to the tables of a results folder.

Tables are computed in blocks by several workers, or found among the pieces that are kept; then the summary, the sweep
and the notes are made of all of them.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyarrow as pa

from copem_replay.core.errors import is_url
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.accuracy.statistics import AccuracyTotal
from copem_replay.metrics.intervals import find_fixed_outcomes
from copem_replay.metrics.metric import OutputTimes, OwnSums
from copem_replay.metrics.onset import select_counted
from copem_replay.metrics.summary import add_own_sums, own_sums_by_log, settle_horizon, summarise_tally, tally_rows
from copem_replay.pipeline.closed_form import check_closed_form, exact_table
from copem_replay.pipeline.cost import RunCost, memory_notes, watch_cost
from copem_replay.pipeline.notes import ListRate, LogFacts, join_list_rates, study_notes
from copem_replay.pipeline.pieces import PieceCache, split_runs, write_recipe
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.replay import BlockOutcome, cut_blocks, replay_outcomes
from copem_replay.pipeline.study_log import StudyLog
from copem_replay.pipeline.sweep import SweepPoint, list_points
from copem_replay.pipeline.tables import (
    AccuracyTables,
    LogTables,
    StudyTables,
    accuracy_tables,
    join_log_tables,
    log_tables,
    tabulate_bands,
    total_by_log,
    total_over_logs,
)

# Gather: the tables of all logs and runs, computed or found.

Progress = Callable[[int, int], None]
"""`progress(done, total)`, called after each block of runs."""


_Found = dict[tuple[str, tuple[int, int]], LogTables | None]
"""Pieces of a log by configuration and range of runs; None: the piece is missing."""

_AT_ONCE = 8
"""Pieces of object storage that are read at once: one by one would mostly wait. No result depends on it."""


@dataclass(frozen=True)
class _Range:
    """Runs of a log in which some configurations have to be computed."""

    log: StudyLog
    experiment: Experiment  # of the log, with these configurations
    runs: tuple[int, int] | None  # None: no more of this log
    recipes: dict[str, str] = field(default_factory=dict)  # by configuration; empty: nothing is kept


class Gatherer:
    """Computes tables, or finds them, and reports progress. `tables`: how many experiments, sweep points among them."""

    def __init__(
        self, jobs: int, progress: Progress | None, tables: int, cost: RunCost, pieces: PieceCache | None
    ) -> None:
        self._jobs, self._progress, self._tables, self._cost, self._pieces = jobs, progress, tables, cost, pieces
        self._done = self._runs = 0  # of the runs of all logs, in all tables
        self._silent = False  # no progress for tables that are read again

    def tables(self, logs: Sequence[StudyLog], experiment: Experiment) -> StudyTables:
        """The tables of the study, still empty; logs that are added can be read again where pieces are kept."""
        by_name = {log.name: log for log in logs}

        def again(name: str) -> LogTables:
            silent = copy(self)
            silent._silent = True
            (tables,) = silent.each([by_name[name]], experiment)
            return tables

        of_logs = {id(alone): alone for alone in (resolve_for_log(experiment, name) for name in by_name)}.values()
        way = any(alone.has_way(name) for alone in of_logs for name in alone.configurations)
        return StudyTables(None if self._pieces is None else again, way=way)

    def each(self, logs: Sequence[StudyLog], experiment: Experiment) -> Iterator[LogTables]:
        """The tables of each log with all its configurations and runs. Only the current log is in memory."""
        self._runs, found = self._tables * len(logs) * experiment.runs, dict[str, _Found]()
        keeps_pieces = self._pieces is not None
        plan = self._plan_missing(logs, experiment, found) if keeps_pieces else self._plan_all(logs, experiment)
        for of_range, tables in self._compute_ranges(plan):
            name = of_range.log.name
            if self._pieces is None:
                yield tables
            elif of_range.runs is None:
                yield join_log_tables(name, [piece for piece in found.pop(name).values() if piece is not None])
            for configuration, recipe in of_range.recipes.items():
                assert self._pieces is not None
                assert of_range.runs is not None
                way = of_range.experiment.has_way(configuration)
                piece = self._pieces.write(recipe, tables.of(configuration, way=way))
                found[name][configuration, of_range.runs] = piece

    def exact(self, log: StudyLog, experiment: Experiment) -> pd.DataFrame:
        """The rows of `exact.parquet` of a log."""
        alone = resolve_for_log(experiment, log.name)
        if self._pieces is None:
            table = exact_table(log.replay(), alone)
            log.drop()
            return table
        parts = []
        for name, configuration in alone.configurations.items():
            recipe = write_recipe(alone, name, log.identity, None)
            piece = self._pieces.read(recipe, log.name, name)
            self._pieces.found += piece is not None
            if piece is None:
                of_configuration = alone.model_copy(update={"configurations": {name: configuration}})
                piece = self._pieces.write(recipe, LogTables(log.name, exact_table(log.replay(), of_configuration)))
            parts.append(piece.rows)
        log.drop()
        return pa.concat_tables(
            [one.replace_schema_metadata(None) for one in parts], promote_options="permissive"
        ).to_pandas()

    def _plan_all(self, logs: Sequence[StudyLog], experiment: Experiment) -> Iterator[_Range]:
        """All runs of each log."""
        for log in logs:
            log.facts(experiment)  # while the log is in memory
            yield _Range(log, alone := resolve_for_log(experiment, log.name), (0, alone.runs))

    def _plan_missing(
        self, logs: Sequence[StudyLog], experiment: Experiment, found: dict[str, _Found]
    ) -> Iterator[_Range]:
        """The ranges that have to be computed of each log, then its end; pieces that are kept are put into `found`."""
        assert self._pieces is not None
        for log, kept in self._read_ahead(logs, experiment):
            alone, found[log.name] = resolve_for_log(experiment, log.name), kept
            if not self._silent:
                self._pieces.found += sum(piece is not None for piece in kept.values())
            for runs in dict.fromkeys(runs for _, runs in kept):
                names = [name for name in alone.configurations if kept[name, runs] is None]
                if names:
                    missing = alone.model_copy(update={"configurations": {n: alone.configurations[n] for n in names}})
                    yield _Range(log, missing, runs, {n: write_recipe(alone, n, log.identity, runs) for n in names})
                else:
                    self._advance(runs[1] - runs[0])
            yield _Range(log, alone, None)

    def _read_ahead(self, logs: Sequence[StudyLog], experiment: Experiment) -> Iterator[tuple[StudyLog, _Found]]:
        """The kept pieces of each log; those of the next log are read meanwhile."""
        ahead: tuple[StudyLog, dict[tuple[str, tuple[int, int]], Future[LogTables | None]]] | None = None
        assert self._pieces is not None
        with ThreadPoolExecutor(_AT_ONCE if is_url(self._pieces.address) else 1) as pool:
            try:
                for log in logs:
                    reading = {key: pool.submit(*call) for key, call in self._list_reads(log, experiment)}
                    ahead, current = (log, reading), ahead
                    if current is not None:
                        yield current[0], {key: piece.result() for key, piece in current[1].items()}
                if ahead is not None:
                    yield ahead[0], {key: piece.result() for key, piece in ahead[1].items()}
            finally:  # interrupted: what has not begun never does
                pool.shutdown(cancel_futures=True)

    def _list_reads(self, log: StudyLog, experiment: Experiment) -> Iterator[tuple[tuple[str, tuple[int, int]], Any]]:
        """By configuration and range of runs the call that reads a piece of a log."""
        assert self._pieces is not None
        alone, ranges = (
            resolve_for_log(experiment, log.name),
            list(split_runs(experiment.runs, log.facts(experiment).episodes)),
        )
        for name in alone.configurations:
            for runs in ranges:
                recipe = write_recipe(alone, name, log.identity, runs)
                yield (name, runs), (self._pieces.read, recipe, log.name, name)

    def _compute_ranges(self, plan: Iterable[_Range]) -> Iterator[tuple[_Range, LogTables]]:
        """The tables of ranges, one after the other. The next log is read when workers are nearly idle."""
        pool, began_s = ThreadPoolExecutor(self._jobs), time.perf_counter()
        waiting: deque[tuple[_Range, list[tuple[int, Future[list[BlockOutcome]]]]]] = deque()
        try:
            for of_range in plan:
                parts = []
                if of_range.runs is not None:
                    replay, alone = of_range.log.replay(), of_range.experiment
                    blocks = cut_blocks(replay, alone, self._jobs, of_range.runs)
                    parts = [(len(b), pool.submit(replay_outcomes, replay, alone, b)) for b in blocks]
                waiting.append((of_range, parts))
                while waiting and (not waiting[0][1] or sum(len(parts) for _, parts in waiting) > self._jobs):
                    yield self._finish_range(*waiting.popleft())
            while waiting:
                yield self._finish_range(*waiting.popleft())
        finally:  # interrupted: what has not begun never does
            pool.shutdown(cancel_futures=True)
            self._cost.add(time.perf_counter() - began_s, ())

    def _finish_range(
        self, of_range: _Range, parts: Sequence[tuple[int, Future[list[BlockOutcome]]]]
    ) -> tuple[_Range, LogTables]:
        """Wait for the blocks of a range, and return its tables."""
        outcomes = []
        for runs, part in parts:
            outcomes += part.result()
            self._advance(runs)
        if of_range.runs is None or self._pieces is None:
            of_range.log.drop()
        if of_range.runs is None:
            return of_range, LogTables(of_range.log.name, pd.DataFrame())
        self._cost.add(0.0, outcomes)
        names, accuracy = list(of_range.experiment.configurations), of_range.experiment.measure.accuracy
        return of_range, log_tables(of_range.log.name, outcomes, names, accuracy=accuracy)

    def _advance(self, runs: int) -> None:
        self._done += runs
        if self._progress is not None and not self._silent:
            self._progress(self._done, self._runs)


ROWS_A_BATCH = 100_000
"""Rows that are counted together, at least: what is done once per batch then costs nothing. No result depends on it."""


@dataclass(frozen=True)
class ExperimentResult:
    """The tables, the summary and the notes of one experiment."""

    tables: StudyTables
    summary: pd.DataFrame  # summary.csv
    notes: tuple[str, ...]  # one line each
    replays: tuple[Replay, ...]  # one per log
    horizon_s: float
    exact: pd.DataFrame | None = None  # exact.parquet, with `measure: {exact: true}`
    bands: pd.DataFrame | None = None  # bands.csv, with `measure: {accuracy: true}`
    sweep: pd.DataFrame | None = None  # sweep.csv, with `sweep:`
    costs: tuple[str, ...] = ()  # notes for the terminal alone: no two runs take the same time
    tally: pd.DataFrame = field(default_factory=pd.DataFrame)  # tally.parquet
    logs: tuple[StudyLog, ...] = ()
    facts: tuple[LogFacts, ...] = ()  # a log each
    same_instants: bool = True  # whether lists have the same instants in all runs

    @property
    def table(self) -> pd.DataFrame:
        """The rows of `detections.parquet`, of all logs."""
        return self.tables.whole

    @cached_property
    def accuracy(self) -> AccuracyTables | None:
        """The tables of all logs, with `measure: {accuracy: true}`."""
        return None if self.bands is None else self.accuracy_of(list(self.tables.each()), self.table)

    def accuracy_of(self, logs: Sequence[LogTables], rows: pd.DataFrame) -> AccuracyTables:
        """The accuracy tables of some logs, which have these rows."""
        return accuracy_tables(logs, rows, same_instants=self.same_instants)


def run_experiment(
    experiment: Experiment,
    recordings: Sequence[Recording],
    *,
    jobs: int = 1,
    progress: Progress | None = None,
    ready: Sequence[Replay] | None = None,
    pieces: PieceCache | None = None,
) -> ExperimentResult:
    """Replay logs through an experiment. The result does not depend on `jobs`, nor on how runs are cut into blocks.

    `ready`: the logs if they are prepared and checked already. `pieces`: where computed pieces are kept and found.
    Raises ExperimentError before any run: exact times without a closed form, or more rows than memory holds.
    """
    with watch_cost() as cost:
        if ready is None and pieces is None:
            read = [recording for recording in recordings if recording.survey is None]
            ready = [prepare_log(recording, resolve_for_log(experiment, recording.scene.log)) for recording in read]
            check_closed_form(ready, experiment)
            memory_notes(ready, experiment)
        by_name = {replay.scene.log: replay for replay in ready or ()}
        logs = [StudyLog(r, experiment, pieces, by_name.get(r.scene.log)) for r in recordings]
        gatherer = Gatherer(jobs, progress, 1 + sum(1 for _ in list_points(experiment)), cost, pieces)
        result = _run_study(experiment, logs, gatherer)
    return replace(result, costs=cost.notes())


def _run_study(experiment: Experiment, logs: Sequence[StudyLog], gatherer: Gatherer) -> ExperimentResult:
    exact = _compute_exact(logs, experiment, gatherer)
    sums = _sum_tables(logs, experiment, gatherer)
    facts, counted = [log.facts(experiment) for log in logs], select_counted(sums.tally, experiment.measure.began)
    horizon_s, horizon_notes = settle_horizon(counted, experiment.measure.horizon_s)
    times = _rates_by_configuration(facts, experiment)
    rows, summary_notes = summarise_tally(
        counted,
        list(experiment.configurations),
        {name: one.rate_hz for name, one in times.items()},
        horizon_s=horizon_s,
        exact=None if exact is None else select_counted(exact, experiment.measure.began),
        accuracy=total_over_logs(sums.totals),
        fixed=find_fixed_outcomes(experiment.as_written()),
        own=experiment.measure.metrics,
        sums=sums.sums,
        outputs={name: sum((sums.outputs[name] for sums in facts), OutputTimes()) for name in experiment.outputs},
        conflicts_asked=experiment.measure.conflict is not None,
        links={name: one.links for name, one in times.items() if one.links is not None},
    )
    swept = [_summarise_point(point, logs, gatherer, horizon_s) for point in list_points(experiment)]
    recordings = [log.recording for log in logs]
    notes = study_notes(
        recordings, {log.name: sums.oddities for log, sums in zip(logs, facts, strict=True)}, experiment
    )
    sweep = pd.concat(swept, ignore_index=True) if swept else None
    accurate = experiment.measure.accuracy and len(experiment.configurations)
    ready = tuple(log.ready for log in logs if log.ready is not None)
    result = ExperimentResult(
        sums.tables,
        rows,
        (*notes, *horizon_notes, *summary_notes),
        ready,
        horizon_s,
        exact,
        tabulate_bands(sums.totals) if accurate else None,
    )
    alike = all(sums.same_instants for sums in facts)
    return replace(result, sweep=sweep, tally=sums.tally, logs=tuple(logs), facts=tuple(facts), same_instants=alike)


class _StudySums(NamedTuple):
    """The tables of all logs, their tally, sums of accuracy by log and configuration, and sums of own metrics."""

    tables: StudyTables
    tally: pd.DataFrame
    totals: dict[tuple[str, str], AccuracyTotal]
    sums: dict[str, dict[str, OwnSums]]


def _sum_tables(logs: Sequence[StudyLog], experiment: Experiment, gatherer: Gatherer) -> _StudySums:
    """Gather all logs, one after the other."""
    tables = gatherer.tables(logs, experiment)
    tallies, totals, sums = (
        list[pd.DataFrame](),
        dict[tuple[str, str], AccuracyTotal](),
        dict[str, dict[str, OwnSums]](),
    )
    for batch in _batch_tables(gatherer.each(logs, experiment)):
        rows = tables.add(batch)
        tallies.append(tally_rows(rows))
        totals |= total_by_log(batch)
        counted = select_counted(rows, experiment.measure.began) if experiment.measure.metrics else rows.iloc[:0]
        for _, rows_of_log in counted.groupby("log", sort=False):
            sums = add_own_sums(sums, own_sums_by_log(rows_of_log, experiment.measure.metrics))
    return _StudySums(tables, pd.concat(tallies, ignore_index=True), totals, sums)


def _batch_tables(each: Iterable[LogTables]) -> Iterator[list[LogTables]]:
    """Tables of logs in batches of ROWS_A_BATCH rows or more."""
    batch, rows = list[LogTables](), 0
    for tables in each:
        batch.append(tables)
        rows += len(tables.rows)
        if rows >= ROWS_A_BATCH:
            yield batch
            batch, rows = [], 0
    if batch:
        yield batch


def _summarise_point(point: SweepPoint, logs: Sequence[StudyLog], gatherer: Gatherer, horizon_s: float) -> pd.DataFrame:
    """The rows of `sweep.csv` of one point: summaries of its configurations, at the horizon of the experiment."""
    experiment = point.experiment
    if not point.same_units:
        logs = [StudyLog(log.recording, experiment, log.pieces) for log in logs]
    exact, sums = _compute_exact(logs, experiment, gatherer), _sum_tables(logs, experiment, gatherer)
    times = _rates_by_configuration([log.facts(experiment) for log in logs], experiment)
    rows, _ = summarise_tally(
        select_counted(sums.tally, experiment.measure.began),
        list(experiment.configurations),
        {name: one.rate_hz for name, one in times.items()},
        horizon_s=horizon_s,
        exact=None if exact is None else select_counted(exact, experiment.measure.began),
        accuracy=total_over_logs(sums.totals),
        fixed=find_fixed_outcomes(experiment.as_written()),
        conflicts_asked=experiment.measure.conflict is not None,
        links={name: one.links for name, one in times.items() if one.links is not None},
    )
    rows.insert(0, "sweep", point.sweep)
    rows.insert(1, "value", point.value)
    return rows


def _compute_exact(logs: Sequence[StudyLog], experiment: Experiment, gatherer: Gatherer) -> pd.DataFrame | None:
    if not experiment.measure.exact:
        return None
    return pd.concat([gatherer.exact(log, experiment) for log in logs], ignore_index=True)


def _rates_by_configuration(facts: Sequence[LogFacts], experiment: Experiment) -> dict[str, ListRate]:
    return {
        name: join_list_rates(of.times[name] for of in facts if name in of.times) for name in experiment.configurations
    }


def find_log_path(recordings: Sequence[Recording], log: str) -> Path:
    """The path of the recording of a log."""
    return next(recording.path for recording in recordings if recording.scene.log == log)
