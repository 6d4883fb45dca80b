"""Run: an experiment over its logs, from blocks of runs to the tables of a results folder.

Parts are computed by several workers, or found among those that are kept; then the summary, the sweep and the notes are
made of all of them.
"""

from __future__ import annotations

import os
import tempfile
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from operator import attrgetter
from typing import IO, NamedTuple

import pandas as pd
import pyarrow as pa

from copem_replay.core.compiled import call_in_room
from copem_replay.core.errors import OutputError, is_url
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import KnownLog, Recording
from copem_replay.metrics.accuracy.statistics import AccuracyTotal, join_totals
from copem_replay.metrics.config import parse_slices
from copem_replay.metrics.detections_table import WAY
from copem_replay.metrics.metric import OutputTimes, OwnSums
from copem_replay.metrics.onset import select_counted
from copem_replay.metrics.slices import (
    LISTS_COLUMNS,
    OF_DRIVING,
    SliceSettings,
    StudyRows,
    sum_episodes,
    sum_lists,
    summarise_groups,
)
from copem_replay.metrics.summary import add_own_sums, own_sums_by_log, settle_horizon, summarise_tally, tally_rows
from copem_replay.pipeline.closed_form import check_closed_form, exact_table
from copem_replay.pipeline.cost import RunCost, memory_notes, return_memory, watch_cost
from copem_replay.pipeline.expansion import ConfigurationFacts, find_facts
from copem_replay.pipeline.notes import LogFacts, join_list_rates, study_notes
from copem_replay.pipeline.parts import MOST_RUNS, STATES_A_PART, PartCache, cut_parts, write_recipe
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.replay import BlockOutcome, cut_blocks, replay_outcomes
from copem_replay.pipeline.scoring import accuracy_settings
from copem_replay.pipeline.study_log import StudyLog
from copem_replay.pipeline.sweep import SweepPoint, list_points
from copem_replay.pipeline.tables import (
    PartTables,
    accuracy_tables,
    build_parts,
    pack_part,
    tabulate_bands,
    tabulate_rows,
    total_over_logs,
    unpack_part,
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
    """Computes parts or reads them from the cache. `advance`: called with the number of runs of a log that are done."""

    def __init__(
        self, jobs: int, cost: RunCost, cache: PartCache | None, advance: Callable[[int], None] = lambda _: None
    ) -> None:
        self._jobs, self._cost, self._cache, self._advance = jobs, cost, cache, advance

    def each(self, logs: Sequence[StudyLog], experiment: Experiment) -> Iterator[PartTables]:
        """The parts of each log, by block of runs, then by configuration. The next log is read when workers are nearly
        idle; only parts that are being computed are in memory.
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
        """The blocks of runs of each log, with parts from the cache; jobs for the missing ones are submitted."""
        for log in logs:
            local = resolve_for_log(experiment, log.name)
            log.facts(experiment)  # while the log is in memory
            if _is_long(log):  # what reading it took
                return_memory()
            blocks = cut_parts(local.runs, log.object_states)
            for runs in blocks:
                cached_parts = self._read_parts(log, local, runs, reading)
                names, missing, outcomes = [name for name in cached_parts if cached_parts[name] is None], local, []
                if len(names) < len(cached_parts):
                    missing = local.model_copy(update={"configurations": {n: local.configurations[n] for n in names}})
                if names:
                    replay, workers = log.replay(), -(-self._jobs // len(blocks))
                    outcomes = [
                        pool.submit(call_in_room, replay_outcomes, replay, missing, some)
                        for some in cut_blocks(replay, missing, workers, runs)
                    ]
                yield _Computing(log, runs, runs == blocks[-1], cached_parts, missing, outcomes)

    def _read_parts(
        self, log: StudyLog, local: Experiment, runs: tuple[int, int], reading: Executor
    ) -> dict[str, PartTables | None]:
        """By configuration its cached part of a block of runs; None: it has to be computed."""
        cache, names = self._cache, list(local.configurations)
        if cache is None:
            return dict.fromkeys(names)

        def read(name: str) -> PartTables | None:
            return cache.read(write_recipe(local, name, log.identity, runs), log.name, name)

        cached_parts = dict(zip(names, (reading.map if is_url(cache.address) else map)(read, names), strict=True))
        cache.found += sum(part is not None for part in cached_parts.values())
        return cached_parts

    def _finish_block(self, block: _Computing) -> Iterable[PartTables]:
        """Wait for the missing parts of a block, add them to the cache, and return all its parts."""
        log, known_parts, outcomes = block.log, block.kept, list[BlockOutcome]()
        for future in block.outcomes:
            outcomes += (finished := future.result())
            self._advance(sum(len(outcome.runs) for outcome in finished))
        if block.is_last:
            log.drop()
        if not outcomes:
            self._advance(block.runs[1] - block.runs[0])
            return [part for part in known_parts.values() if part is not None]
        self._cost.add(0.0, outcomes)
        parts = build_parts(log.name, outcomes, block.missing)
        if _is_long(log):
            outcomes.clear()
            return_memory()
        for part in parts:
            if self._cache is not None:
                recipe = write_recipe(block.missing, part.configuration, log.identity, block.runs)
                part = self._cache.write(recipe, part)
            known_parts[part.configuration] = part
        return [part for part in known_parts.values() if part is not None]

    def exact(self, log: StudyLog, experiment: Experiment) -> pd.DataFrame:
        """The exact detection times of a log (`exact.parquet`), by configuration from the cache or computed."""
        local, cache, rows = resolve_for_log(experiment, log.name), self._cache, list[pa.Table]()
        for name, configuration in local.configurations.items():
            recipe, part = "", None
            if cache is not None:
                part = cache.read(recipe := write_recipe(local, name, log.identity, None), log.name, name)
                cache.found += part is not None
            if part is None:
                single = local.model_copy(update={"configurations": {name: configuration}})
                part = PartTables(log.name, name, tabulate_rows(exact_table(log.replay(), single)))
                if cache is not None:
                    cache.write(recipe, part)
            rows.append(part.rows)
        log.drop()
        return pa.concat_tables(rows, promote_options="permissive").to_pandas()


def _is_long(log: StudyLog) -> bool:
    """Whether a part takes so long that giving memory back costs nothing beside it."""
    return log.object_states > STATES_A_PART // MOST_RUNS


# The tables of a study.

BATCH_ROWS, BATCH_BYTES = 100_000, 16_000_000
"""Rows and bytes that are put together at a time, at least: what is done once per batch then costs nothing."""


@dataclass(eq=False, repr=False)
class StudyTables:
    """What a study gives: the tables of its results, and what is said beside them.

    Parts come in by log, configuration and runs, and are read again from the folder that they are kept in; without one
    from a file without a name, which no killed process leaves behind. `kept`: they are needed again, not only counted.
    The other tables and the notes are made of all of them. None: not asked for.
    """

    experiment: Experiment
    logs: tuple[StudyLog, ...]
    kept: bool = True
    counts: dict[str, int] = field(default_factory=dict)
    """Rows by log, in the order in which logs are added."""
    tally: pd.DataFrame = field(default_factory=pd.DataFrame)
    totals: dict[tuple[str, str], AccuracyTotal] = field(default_factory=dict)
    """Sums of accuracy over all runs, by log and configuration."""
    own_sums: dict[str, dict[str, OwnSums]] = field(default_factory=dict)
    """Sums of own metrics."""
    sliced: tuple[pd.DataFrame, pd.DataFrame | None] | None = None
    """What slices are made of: sums by episode, and of lists; None: not asked for."""
    driving: pd.DataFrame | None = None
    """Columns of `lists.parquet` about needless braking; None: not asked for."""
    exact: pd.DataFrame | None = None
    horizon_s: float = 0.0
    summary: pd.DataFrame = field(default_factory=pd.DataFrame)
    summary_by: pd.DataFrame | None = None
    bands: pd.DataFrame | None = None
    sweep: pd.DataFrame | None = None
    notes: tuple[str, ...] = ()
    costs: tuple[str, ...] = ()
    """Notes for the terminal alone: no two runs take the same time."""
    _parts: dict[str, dict[str, list[Callable[[], PartTables]]]] = field(default_factory=dict)
    _schema: pa.Schema = field(default_factory=lambda: pa.schema([]))
    _file: IO[bytes] | None = None

    @property
    def recordings(self) -> tuple[KnownLog, ...]:
        """The recording of each log, with or without its content in memory."""
        return tuple(log.recording for log in self.logs)

    @cached_property
    def facts(self) -> tuple[LogFacts, ...]:
        """The facts of each log that results state beside its rows."""
        return tuple(log.facts(self.experiment) for log in self.logs)

    def find_log(self, name: str) -> StudyLog:
        """A log by its name."""
        return next(log for log in self.logs if log.name == name)

    @cached_property
    def _way(self) -> bool:
        """Whether rows have the columns `WAY`."""
        alone = {id(one): one for one in (resolve_for_log(self.experiment, log.name) for log in self.logs)}
        return any(one.has_way(name) for one in alone.values() for name in one.configurations)

    def add(self, part: PartTables) -> None:
        """Add a part: after those of earlier runs, and of earlier logs.

        Raises OutputError: no room on the disk.
        """
        self.counts[part.log] = self.counts.get(part.log, 0) + len(part.rows)
        if self._schema != part.rows.schema:
            self._schema = pa.unify_schemas([self._schema, part.rows.schema], promote_options="permissive")
        if not self.kept:
            return
        self._parts.setdefault(part.log, {}).setdefault(part.configuration, []).append(part.again or self._store(part))

    def _store(self, part: PartTables) -> Callable[[], PartTables]:
        """Write a part to a temporary file; returns the function that reads it again. Raises OutputError: no room."""
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            begin, size = self._file.seek(0, os.SEEK_END), self._file.write(pack_part(part))
        except OSError as error:
            place, out = tempfile.gettempdir(), "set TMPDIR to a folder with room"
            raise OutputError(f"{place}: cannot be written: {error.strerror or error}; {out}") from None
        file, log, configuration = self._file, part.log, part.configuration

        def read() -> PartTables:
            file.seek(begin)
            return unpack_part(file.read(size), log, configuration)

        return read

    def parts(self, log: str | None = None) -> Iterator[PartTables]:
        """The parts of all logs or of one, by configuration, in order of runs; those in the file are read again."""
        of_logs = self._parts.values() if log is None else [self._parts.get(log, {})]
        yield from (part() for of_log in of_logs for parts in of_log.values() for part in parts)

    def batches(self) -> Iterator[tuple[pd.DataFrame, list[PartTables]]]:
        """Rows of `detections.parquet` with their parts, so many at a time that one batch is in memory."""
        batch, rows, size = list[PartTables](), 0, 0
        for part in self.parts():
            batch.append(part)
            rows, size = rows + len(part.rows), size + part.size_bytes
            if rows >= BATCH_ROWS or size >= BATCH_BYTES:
                yield self.frame(batch), batch
                batch, rows, size = [], 0, 0
        if batch:
            yield self.frame(batch), batch

    def rows(self, log: str, run: int | None = None) -> pd.DataFrame:
        """The rows of `detections.parquet` of one log, or of one run of it."""
        if run is None:
            return self.frame(self.parts(log))
        chosen = ((part, pa.array(part.rows["run"].to_numpy() == run)) for part in self.parts(log))
        return self.frame(replace(part, rows=part.rows.filter(of_run)) for part, of_run in chosen)

    def events_of(self, log: str, run: int) -> Iterator[pd.DataFrame | None]:
        """The rows of `needless.parquet`, and of `false_tracks.parquet`, of one run of a log; None: not asked for."""
        parts = list(self.parts(log))
        for of_parts in ([part.needless for part in parts], [part.false_tracks for part in parts]):
            tables = [table for table in of_parts if table is not None]
            rows = pa.concat_tables(tables) if tables else None
            yield None if rows is None else rows.filter(pa.array(rows["run"].to_numpy() == run)).to_pandas()

    def frame(self, parts: Iterable[PartTables]) -> pd.DataFrame:
        """The rows of some parts, with the columns and types that those of all parts have."""
        frame = pa.concat_tables(
            [self._schema.empty_table(), *(part.rows for part in parts)], promote_options="permissive"
        ).to_pandas()
        if "braking_pass" in frame:
            frame["braking_pass"] = pd.array(frame["braking_pass"], dtype="boolean")
        if not self._way:
            return frame
        # Columns that only some configurations have come last, in whatever order tables were added.
        return frame.reindex(columns=[*(name for name in frame if name not in WAY), *WAY])

    def accuracy_of(self, parts: Iterable[PartTables], rows: pd.DataFrame) -> dict[str, pa.Table]:
        """The tables of accuracy of some parts, which have these rows."""
        return accuracy_tables(parts, rows, same_instants=all(of.same_instants for of in self.facts))


def run_experiment(
    experiment: Experiment,
    recordings: Sequence[KnownLog],
    *,
    jobs: int = 1,
    progress: Progress | None = None,
    ready: Sequence[Replay] | None = None,
    parts: PartCache | None = None,
) -> StudyTables:
    """Replay logs through an experiment. The result does not depend on `jobs`, nor on how runs are cut into blocks.

    `ready`: the logs if they are prepared and checked already. `parts`: where computed parts are kept and found.
    Raises ExperimentError before any run: exact times without a closed form, or more rows than memory holds.
    """
    with watch_cost() as cost:
        if ready is None and parts is None:
            read = [recording for recording in recordings if isinstance(recording, Recording)]
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

        study = _run_study(experiment, logs, Gatherer(jobs, cost, parts, advance))
    study.costs = cost.notes()
    return study


def _run_study(experiment: Experiment, logs: Sequence[StudyLog], gatherer: Gatherer) -> StudyTables:
    """All tables of a study: rows, summary, groups, sweep and bands, with the horizon that is used and notes."""
    study = _gather_study(logs, experiment, gatherer, reread=True)
    measure = experiment.measure
    study.horizon_s, horizon_notes = settle_horizon(select_counted(study.tally, measure.began), measure.horizon_s)
    study.summary, summary_notes = _summarise(study, study.horizon_s)
    study.summary_by = _summarise_slices(study, study.horizon_s)
    swept = [_summarise_point(point, logs, gatherer, study.horizon_s) for point in list_points(experiment)]
    study.sweep = pd.concat(swept, ignore_index=True) if swept else None
    if measure.accuracy and len(experiment.configurations):
        study.bands = tabulate_bands(study.totals)
    oddities = {log.name: of.oddities for log, of in zip(logs, study.facts, strict=True)}
    study.notes = (*study_notes(study.recordings, oddities, experiment), *horizon_notes, *summary_notes)
    return study


def _gather_study(logs: Sequence[StudyLog], experiment: Experiment, gatherer: Gatherer, *, reread: bool) -> StudyTables:
    """The tables of all logs, one log after the other, with tally and sums; `reread`: rows are read again later."""
    study, measure = StudyTables(experiment, tuple(logs), reread), experiment.measure
    if measure.exact:
        study.exact = pd.concat([gatherer.exact(log, experiment) for log in logs], ignore_index=True)
    nodes = dict[tuple[str, str], list[tuple[int, AccuracyTotal]]]()
    tallies, batch, last = list[pd.DataFrame](), list[PartTables](), logs[-1].name
    episodes, lists, sliced = list[pd.DataFrame](), list[pd.DataFrame](), bool(reread and measure.by)
    driving, columns = list[pd.DataFrame](), LISTS_COLUMNS[: None if experiment.needless else -len(OF_DRIVING)]
    for log, parts in groupby(gatherer.each(logs, experiment), key=attrgetter("log")):
        for part in parts:
            batch.append(replace(part, beside=None, runs=None))
            study.add(part)
            if part.total is not None and part.runs is not None:
                nodes.setdefault((log, part.configuration), []).append((len(part.runs), part.total))
                of_lists = part.runs.select([*columns] if sliced or experiment.needless else []).to_pandas()
                lists += [sum_lists(of_lists)] if sliced else []
                driving += [of_lists[["log", "configuration", "run", *OF_DRIVING]]] if experiment.needless else []
        if log != last and sum(len(part.rows) for part in batch) < BATCH_ROWS:
            continue
        rows = study.frame(batch)
        batch.clear()
        tallies.append(tally_rows(rows))
        episodes += [sum_episodes(rows, measure.metrics, measure.began)] if sliced else []
        if measure.metrics:
            for _, rows_of_log in select_counted(rows, measure.began).groupby("log", sort=False):
                study.own_sums = add_own_sums(study.own_sums, own_sums_by_log(rows_of_log, measure.metrics))
    if any(map(_is_long, logs)):
        return_memory()
    study.totals = {key: join_totals(of_log) for key, of_log in nodes.items()}
    study.tally = pd.concat(tallies, ignore_index=True)
    study.driving = pd.concat(driving, ignore_index=True) if driving else None
    if sliced:
        study.sliced = pd.concat(episodes, ignore_index=True), sum_lists(pd.concat(lists)) if lists else None
    return study


def _summarise_slices(study: StudyTables, horizon_s: float) -> pd.DataFrame | None:
    if study.sliced is None:
        return None
    experiment, (episodes, lists) = study.experiment, study.sliced
    settings = slice_settings(experiment, find_facts(experiment), horizon_s)
    tags = {log.name: log.recording.scene.tags for log in study.logs}
    rows = StudyRows(settings, tags, study.tally, study.exact, episodes, lists)
    return summarise_groups(rows, parse_slices(experiment.measure.by))


def slice_settings(experiment: Experiment, facts: Mapping[str, ConfigurationFacts], horizon_s: float) -> SliceSettings:
    """The settings from which figures of groups are computed."""
    measure = experiment.measure
    return SliceSettings(
        tuple(experiment.configurations),
        horizon_s,
        measure.began,
        measure.metrics,
        accuracy_settings(measure, 0.0) if measure.accuracy else None,
        measure.conflict is not None,
        facts,
        measure.weigh,
    )


def _summarise_point(point: SweepPoint, logs: Sequence[StudyLog], gatherer: Gatherer, horizon_s: float) -> pd.DataFrame:
    """The rows of `sweep.csv` of one point: summaries of its configurations, at the horizon of the experiment."""
    experiment = point.experiment
    if not point.same_units:
        logs = [StudyLog(log.recording, experiment, log.parts) for log in logs]
    rows, _ = _summarise(_gather_study(logs, experiment, gatherer, reread=False), horizon_s)
    rows.insert(0, "sweep", point.sweep)
    rows.insert(1, "value", point.value)
    return rows


def _summarise(study: StudyTables, horizon_s: float) -> tuple[pd.DataFrame, list[str]]:
    """The rows of `summary.csv`, one by configuration, and notes for the user about them."""
    experiment, facts, exact = study.experiment, study.facts, study.exact
    measure, names = experiment.measure, list(experiment.configurations)
    times = {name: join_list_rates(fact.times[name] for fact in facts if name in fact.times) for name in names}
    return summarise_tally(
        select_counted(study.tally, measure.began),
        names,
        {name: rates.rate_hz for name, rates in times.items()},
        horizon_s=horizon_s,
        exact=None if exact is None else select_counted(exact, measure.began),
        accuracy=total_over_logs(study.totals),
        facts=find_facts(experiment),
        own=measure.metrics,
        sums=study.own_sums,
        outputs={name: sum((fact.outputs[name] for fact in facts), OutputTimes()) for name in experiment.outputs},
        conflicts_asked=measure.conflict is not None,
        weigh=measure.weigh,
        driving=study.driving,
        links={name: rates.links for name, rates in times.items() if rates.links is not None},
    )
