"""Run: an experiment over its logs, from blocks of runs to the tables of a results folder.

Parts are computed by several workers, or found among those that are kept; then the summary, the sweep and the notes are
made of all of them.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import pyarrow as pa

from copem_replay.core.errors import is_url
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.accuracy.statistics import AccuracyTotal, join_totals
from copem_replay.metrics.config import parse_slices
from copem_replay.metrics.metric import OutputTimes, OwnSums
from copem_replay.metrics.onset import select_counted
from copem_replay.metrics.slices import (
    LISTS_COLUMNS,
    SliceSettings,
    StudyRows,
    describe_chance,
    sum_episodes,
    sum_lists,
    summarise_groups,
)
from copem_replay.metrics.summary import add_own_sums, own_sums_by_log, settle_horizon, summarise_tally, tally_rows
from copem_replay.pipeline.closed_form import check_closed_form, exact_table
from copem_replay.pipeline.cost import RunCost, memory_notes, return_memory, watch_cost
from copem_replay.pipeline.expansion import ConfigurationFacts, find_facts
from copem_replay.pipeline.notes import ListRate, LogFacts, join_list_rates, study_notes
from copem_replay.pipeline.parts import MOST_RUNS, STATES_A_PART, PartCache, cut_parts, write_recipe
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.replay import BlockOutcome, cut_blocks, replay_outcomes
from copem_replay.pipeline.scoring import accuracy_settings
from copem_replay.pipeline.study_log import StudyLog
from copem_replay.pipeline.sweep import SweepPoint, list_points
from copem_replay.pipeline.tables import (
    BATCH_ROWS,
    AccuracyTables,
    PartTables,
    StudyTables,
    accuracy_tables,
    build_parts,
    tabulate_bands,
    tabulate_rows,
    total_over_logs,
)

# Gather: the parts of all logs, computed or found.

Progress = Callable[[int, int], None]
"""`progress(done, total)`, called after each block of runs."""

_AT_ONCE = 8
"""Parts of object storage that are read at once: one by one would mostly wait. No result depends on it."""


class _Computing(NamedTuple):
    """A block of runs of a log: its parts that are kept by configuration (None: missing), and what computes these."""

    log: StudyLog
    runs: tuple[int, int]
    is_last: bool  # of the log
    kept: dict[str, PartTables | None]
    missing: Experiment  # of the log, with the configurations whose parts are missing
    outcomes: list[Future[list[BlockOutcome]]]


class Gatherer:
    """Computes parts, or finds them. `advance`: called with the number of runs of a log that are done."""

    def __init__(
        self, jobs: int, cost: RunCost, cache: PartCache | None, advance: Callable[[int], None] = lambda _: None
    ) -> None:
        self._jobs, self._cost, self._cache, self._advance = jobs, cost, cache, advance

    def each(self, logs: Sequence[StudyLog], experiment: Experiment) -> Iterator[PartTables]:
        """The parts of each log, by block of runs, then by configuration. The next log is read when workers are nearly
        idle; no more than the parts that are computed are in memory.
        """
        began_s, waiting = time.perf_counter(), deque[_Computing]()
        pool, reading = ThreadPoolExecutor(self._jobs), ThreadPoolExecutor(_AT_ONCE)
        try:
            for block in self._begin_blocks(logs, experiment, pool, reading):
                waiting.append(block)
                while waiting and (not waiting[0].outcomes or sum(len(w.outcomes) for w in waiting) > self._jobs):
                    yield from self._finish_block(waiting.popleft())
            while waiting:
                yield from self._finish_block(waiting.popleft())
        finally:  # interrupted: what has not begun never does
            reading.shutdown(cancel_futures=True)
            pool.shutdown(cancel_futures=True)
            self._cost.add(time.perf_counter() - began_s, ())

    def _begin_blocks(
        self, logs: Sequence[StudyLog], experiment: Experiment, pool: Executor, reading: Executor
    ) -> Iterator[_Computing]:
        for log in logs:
            alone = resolve_for_log(experiment, log.name)
            log.facts(experiment)  # while the log is in memory
            blocks = cut_parts(alone.runs, log.object_states)
            for runs in blocks:
                kept = self._read_parts(log, alone, runs, reading)
                names, missing, outcomes = [name for name in kept if kept[name] is None], alone, []
                if len(names) < len(kept):
                    missing = alone.model_copy(update={"configurations": {n: alone.configurations[n] for n in names}})
                if names:
                    replay, workers = log.replay(), -(-self._jobs // len(blocks))
                    outcomes = [
                        pool.submit(replay_outcomes, replay, missing, some)
                        for some in cut_blocks(replay, missing, workers, runs)
                    ]
                yield _Computing(log, runs, runs == blocks[-1], kept, missing, outcomes)

    def _read_parts(
        self, log: StudyLog, alone: Experiment, runs: tuple[int, int], reading: Executor
    ) -> dict[str, PartTables | None]:
        """The parts of a block that are kept, by configuration; None: missing."""
        cache, names = self._cache, list(alone.configurations)
        if cache is None:
            return dict.fromkeys(names)

        def read(name: str) -> PartTables | None:
            return cache.read(write_recipe(alone, name, log.identity, runs), log.name, name)

        kept = dict(zip(names, (reading.map if is_url(cache.address) else map)(read, names), strict=True))
        cache.found += sum(part is not None for part in kept.values())
        return kept

    def _finish_block(self, block: _Computing) -> Iterable[PartTables]:
        """Wait for the missing parts of a block, keep them, and return all its parts."""
        log, kept, outcomes = block.log, block.kept, list[BlockOutcome]()
        for future in block.outcomes:
            outcomes += (done := future.result())
            self._advance(sum(len(outcome.runs) for outcome in done))
        if block.is_last:
            log.drop()
        if not outcomes:
            self._advance(block.runs[1] - block.runs[0])
            return [part for part in kept.values() if part is not None]
        self._cost.add(0.0, outcomes)
        parts = build_parts(log.name, outcomes, block.missing)
        if log.object_states > STATES_A_PART // MOST_RUNS:  # the part took long enough for it to cost nothing
            outcomes.clear()
            return_memory()
        for part in parts:
            kept[part.configuration] = part
            if self._cache is not None:
                recipe = write_recipe(block.missing, part.configuration, log.identity, block.runs)
                self._cache.write(recipe, part)
        return [part for part in kept.values() if part is not None]

    def exact(self, log: StudyLog, experiment: Experiment) -> pd.DataFrame:
        """The rows of `exact.parquet` of a log."""
        alone, cache, rows = resolve_for_log(experiment, log.name), self._cache, list[pa.Table]()
        for name, configuration in alone.configurations.items():
            recipe, part = "", None
            if cache is not None:
                part = cache.read(recipe := write_recipe(alone, name, log.identity, None), log.name, name)
                cache.found += part is not None
            if part is None:
                only = alone.model_copy(update={"configurations": {name: configuration}})
                part = PartTables(log.name, name, tabulate_rows(exact_table(log.replay(), only)))
                if cache is not None:
                    cache.write(recipe, part)
            rows.append(part.rows)
        log.drop()
        return pa.concat_tables(rows, promote_options="permissive").to_pandas()


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
    summary_by: pd.DataFrame | None = None  # summary_by.csv, with `measure: {by: …}`
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
        return None if self.bands is None else self.accuracy_of(self.tables.parts(), self.table)

    def accuracy_of(self, parts: Iterable[PartTables], rows: pd.DataFrame) -> AccuracyTables:
        """The accuracy tables of some parts, which have these rows."""
        return accuracy_tables(parts, rows, same_instants=self.same_instants)


def run_experiment(
    experiment: Experiment,
    recordings: Sequence[Recording],
    *,
    jobs: int = 1,
    progress: Progress | None = None,
    ready: Sequence[Replay] | None = None,
    parts: PartCache | None = None,
) -> ExperimentResult:
    """Replay logs through an experiment. The result does not depend on `jobs`, nor on how runs are cut into blocks.

    `ready`: the logs if they are prepared and checked already. `parts`: where computed parts are kept and found.
    Raises ExperimentError before any run: exact times without a closed form, or more rows than memory holds.
    """
    with watch_cost() as cost:
        if ready is None and parts is None:
            read = [recording for recording in recordings if recording.survey is None]
            ready = [prepare_log(recording, resolve_for_log(experiment, recording.scene.log)) for recording in read]
            check_closed_form(ready, experiment)
            memory_notes(ready, experiment)
        by_name = {replay.scene.log: replay for replay in ready or ()}
        logs = [StudyLog(r, experiment, parts, by_name.get(r.scene.log)) for r in recordings]
        total, done = len(logs) * experiment.runs * (1 + sum(1 for _ in list_points(experiment))), 0

        def advance(runs: int) -> None:
            nonlocal done
            done += runs
            if progress is not None:
                progress(done, total)

        result = _run_study(experiment, logs, Gatherer(jobs, cost, parts, advance))
    return replace(result, costs=cost.notes())


def _run_study(experiment: Experiment, logs: Sequence[StudyLog], gatherer: Gatherer) -> ExperimentResult:
    exact = _compute_exact(logs, experiment, gatherer)
    sums = _sum_tables(logs, experiment, gatherer, whole=True)
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
        facts=find_facts(experiment),
        own=experiment.measure.metrics,
        sums=sums.sums,
        outputs={name: sum((sums.outputs[name] for sums in facts), OutputTimes()) for name in experiment.outputs},
        conflicts_asked=experiment.measure.conflict is not None,
        links={name: one.links for name, one in times.items() if one.links is not None},
    )
    sliced = _summarise_slices(experiment, logs, sums, exact, horizon_s)
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
        (*notes, *horizon_notes, *summary_notes, *(describe_chance(sliced) if sliced is not None else ())),
        ready,
        horizon_s,
        exact,
        tabulate_bands(sums.totals) if accurate else None,
    )
    alike = all(sums.same_instants for sums in facts)
    result = replace(result, sweep=sweep, summary_by=sliced, tally=sums.tally)
    return replace(result, logs=tuple(logs), facts=tuple(facts), same_instants=alike)


class _StudySums(NamedTuple):
    """The tables of all logs, their tally, sums of accuracy by log and configuration, and sums of own metrics.

    `episodes`, `lists`: what slices are made of, in batches; empty where none are asked for.
    """

    tables: StudyTables
    tally: pd.DataFrame
    totals: dict[tuple[str, str], AccuracyTotal]
    sums: dict[str, dict[str, OwnSums]]
    episodes: list[pd.DataFrame]
    lists: list[pd.DataFrame]


def _sum_tables(logs: Sequence[StudyLog], experiment: Experiment, gatherer: Gatherer, *, whole: bool) -> _StudySums:
    """Gather all logs, one after the other. `whole`: the tables are needed, too."""
    of_logs = {id(alone): alone for alone in (resolve_for_log(experiment, log.name) for log in logs)}.values()
    tables = StudyTables(way=any(alone.has_way(name) for alone in of_logs for name in alone.configurations))
    nodes, sums = dict[tuple[str, str], list[tuple[int, AccuracyTotal]]](), dict[str, dict[str, OwnSums]]()
    tallies, batch, last = list[pd.DataFrame](), list[PartTables](), logs[-1].name
    episodes, lists, measure = list[pd.DataFrame](), list[pd.DataFrame](), experiment.measure
    for log, parts in groupby(gatherer.each(logs, experiment), key=attrgetter("log")):
        for part in parts:
            batch.append(replace(part, beside=None, runs=None))
            tables.add(part, counted=not whole)
            if part.total is not None and part.runs is not None:
                nodes.setdefault((log, part.configuration), []).append((len(part.runs), part.total))
                lists += [sum_lists(part.runs.select([*LISTS_COLUMNS]).to_pandas())] if measure.by else []
        if log != last and sum(len(part.rows) for part in batch) < BATCH_ROWS:
            continue
        rows = tables.frame(batch)
        batch.clear()
        tallies.append(tally_rows(rows))
        episodes += [sum_episodes(rows, measure.metrics, measure.began)] if measure.by else []
        if measure.metrics:
            for _, rows_of_log in select_counted(rows, measure.began).groupby("log", sort=False):
                sums = add_own_sums(sums, own_sums_by_log(rows_of_log, measure.metrics))
    totals = {key: join_totals(of_log) for key, of_log in nodes.items()}
    return _StudySums(tables, pd.concat(tallies, ignore_index=True), totals, sums, episodes, lists)


def _summarise_slices(
    experiment: Experiment, logs: Sequence[StudyLog], sums: _StudySums, exact: pd.DataFrame | None, horizon_s: float
) -> pd.DataFrame | None:
    if not experiment.measure.by:
        return None
    study = StudyRows(
        slice_settings(experiment, find_facts(experiment), horizon_s),
        {log.name: log.recording.scene.tags for log in logs},
        sums.tally,
        exact,
        pd.concat(sums.episodes, ignore_index=True),
        sum_lists(pd.concat(sums.lists)) if sums.lists else None,
    )
    return summarise_groups(study, parse_slices(experiment.measure.by))


def slice_settings(experiment: Experiment, facts: Mapping[str, ConfigurationFacts], horizon_s: float) -> SliceSettings:
    """What the figures of groups are computed with."""
    measure = experiment.measure
    return SliceSettings(
        tuple(experiment.configurations),
        horizon_s,
        measure.began,
        measure.metrics,
        accuracy_settings(measure, 0.0) if measure.accuracy else None,
        measure.conflict is not None,
        frozenset(name for name, of in facts.items() if of.fixed),
        frozenset(name for name, of in facts.items() if of.fixed_verdicts),
    )


def _summarise_point(point: SweepPoint, logs: Sequence[StudyLog], gatherer: Gatherer, horizon_s: float) -> pd.DataFrame:
    """The rows of `sweep.csv` of one point: summaries of its configurations, at the horizon of the experiment."""
    experiment = point.experiment
    if not point.same_units:
        logs = [StudyLog(log.recording, experiment, log.parts) for log in logs]
    exact = _compute_exact(logs, experiment, gatherer)
    sums = _sum_tables(logs, experiment, gatherer, whole=False)
    times = _rates_by_configuration([log.facts(experiment) for log in logs], experiment)
    rows, _ = summarise_tally(
        select_counted(sums.tally, experiment.measure.began),
        list(experiment.configurations),
        {name: one.rate_hz for name, one in times.items()},
        horizon_s=horizon_s,
        exact=None if exact is None else select_counted(exact, experiment.measure.began),
        accuracy=total_over_logs(sums.totals),
        facts=find_facts(experiment),
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
