"""Run: experiment × logs × blocks of runs → results folder."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.accuracy.statistics import Total
from copem_replay.metrics.fixed import fixed_in
from copem_replay.metrics.metric import OwnSums
from copem_replay.metrics.output_times import OutputTimes
from copem_replay.metrics.summary import added, horizon_s, own_sums_of, summary_of
from copem_replay.metrics.tally import tally
from copem_replay.pipeline.accuracy_tables import AccuracyTables, accuracy_tables, bands, by_log, totals
from copem_replay.pipeline.closed_form import check_exact
from copem_replay.pipeline.cost import watched
from copem_replay.pipeline.facts import Facts
from copem_replay.pipeline.gather import Gatherer, Progress
from copem_replay.pipeline.list_rates import ListTimes, together
from copem_replay.pipeline.log_tables import LogTables
from copem_replay.pipeline.memory import memory_notes
from copem_replay.pipeline.notes import study_notes
from copem_replay.pipeline.pieces import Pieces
from copem_replay.pipeline.prepare import Replay, prepare
from copem_replay.pipeline.study_log import StudyLog
from copem_replay.pipeline.study_tables import StudyTables
from copem_replay.pipeline.sweep import Point, points

ROWS_A_BATCH = 100_000
"""Rows of logs that are counted together, at least (chosen)."""


@dataclass(frozen=True)
class Result:
    """What one experiment gave."""

    tables: StudyTables
    summary: pd.DataFrame  # summary.csv
    notes: tuple[str, ...]  # what has to be said, one line each
    replays: tuple[Replay, ...]  # one per log
    horizon_s: float | None
    exact: pd.DataFrame | None = None  # exact.parquet, with `measure: {exact: true}`
    bands: pd.DataFrame | None = None  # bands.csv, with `measure: {accuracy: true}`
    sweep: pd.DataFrame | None = None  # sweep.csv, with `sweep:`
    costs: tuple[str, ...] = ()  # what has to be said on the terminal alone: no two runs take the same time
    tally: pd.DataFrame = field(default_factory=pd.DataFrame)  # tally.parquet
    logs: tuple[StudyLog, ...] = ()
    facts: tuple[Facts, ...] = ()  # of each log
    same_instants: bool = True  # of lists, in all runs

    @property
    def table(self) -> pd.DataFrame:
        """The rows of `detections.parquet`, of all logs."""
        return self.tables.whole

    @cached_property
    def accuracy(self) -> AccuracyTables | None:
        """The tables of all logs, with `measure: {accuracy: true}`."""
        return None if self.bands is None else self.accuracy_of(list(self.tables.each()), self.table)

    def accuracy_of(self, logs: Sequence[LogTables], rows: pd.DataFrame) -> AccuracyTables:
        """The same of some logs, which have these rows."""
        return accuracy_tables(logs, rows, same_instants=self.same_instants)


def run(
    experiment: Experiment,
    recordings: Sequence[Recording],
    *,
    jobs: int = 1,
    progress: Progress | None = None,
    ready: Sequence[Replay] | None = None,
    pieces: Pieces | None = None,
) -> Result:
    """Replay logs through an experiment. The result does not depend on `jobs`, nor on how runs are cut into blocks.

    `ready`: the logs as they were prepared and checked before. `pieces`: where what is computed is kept and found.
    Raises ExperimentError before any run: something that has no closed form, runs that no memory holds.
    """
    with watched() as cost:
        if ready is None and pieces is None:
            read = [recording for recording in recordings if recording.survey is None]
            ready = [prepare(recording, of_log(experiment, recording.scene.log)) for recording in read]
            check_closed_form(ready, experiment)
            memory_notes(ready, experiment)
        by_name = {replay.scene.log: replay for replay in ready or ()}
        logs = [StudyLog(r, experiment, pieces, by_name.get(r.scene.log)) for r in recordings]
        gatherer = Gatherer(jobs, progress, 1 + sum(1 for _ in points(experiment)), cost, pieces)
        result = _run(experiment, logs, gatherer)
    return replace(result, costs=cost.notes())


def _run(experiment: Experiment, logs: Sequence[StudyLog], gatherer: Gatherer) -> Result:
    exact = _exactly(logs, experiment, gatherer)
    of = _gathered(logs, experiment, gatherer)
    facts, tallied = [log.facts(experiment) for log in logs], of.tally
    horizon = horizon_s(tallied, experiment.measure.horizon_s)
    times = _times(facts, experiment)
    rows, said = summary_of(
        tallied,
        list(experiment.configurations),
        {name: one.rate_hz for name, one in times.items()},
        seed=experiment.seed,
        horizon_s=horizon,
        exact=exact,
        accuracy=totals(of.totals),
        fixed=fixed_in(experiment.as_written()),
        own=experiment.measure.metrics,
        sums=of.sums,
        outputs={name: sum((of.outputs[name] for of in facts), OutputTimes()) for name in experiment.outputs},
        conflicts_asked=experiment.measure.conflict is not None,
        links={name: one.links for name, one in times.items() if one.links is not None},
    )
    swept = [_at_point(point, logs, gatherer, horizon) for point in points(experiment)]
    recordings = [log.recording for log in logs]
    notes = study_notes(recordings, {log.name: of.oddities for log, of in zip(logs, facts, strict=True)}, experiment)
    sweep = pd.concat(swept, ignore_index=True) if swept else None
    accurate = experiment.measure.accuracy and len(experiment.configurations)
    ready = tuple(log.ready for log in logs if log.ready is not None)
    result = Result(of.tables, rows, (*notes, *said), ready, horizon, exact, bands(of.totals) if accurate else None)
    alike = all(of.same_instants for of in facts)
    return replace(result, sweep=sweep, tally=tallied, logs=tuple(logs), facts=tuple(facts), same_instants=alike)


class _Gathered(NamedTuple):
    """What the tables of all logs add up to. `sums`: of own metrics."""

    tables: StudyTables
    tally: pd.DataFrame
    totals: dict[tuple[str, str], Total]
    sums: dict[str, dict[str, OwnSums]]


def _gathered(logs: Sequence[StudyLog], experiment: Experiment, gatherer: Gatherer) -> _Gathered:
    """Log by log."""
    tables = gatherer.tables(logs, experiment)
    tallies, totals, sums = list[pd.DataFrame](), dict[tuple[str, str], Total](), dict[str, dict[str, OwnSums]]()
    for some in _batches(gatherer.each(logs, experiment)):
        rows = tables.add(some)
        tallies.append(tally(rows))
        totals |= by_log(some)
        for _, of in rows.groupby("log", sort=False) if experiment.measure.metrics else ():
            sums = added(sums, own_sums_of(of, experiment.measure.metrics))
    return _Gathered(tables, pd.concat(tallies, ignore_index=True), totals, sums)


def _batches(each: Iterable[LogTables]) -> Iterator[list[LogTables]]:
    """Tables of logs, so many together that what is done once per batch costs nothing."""
    some, rows = list[LogTables](), 0
    for one in each:
        some.append(one)
        rows += len(one.rows)
        if rows >= ROWS_A_BATCH:
            yield some
            some, rows = [], 0
    if some:
        yield some


def check_closed_form(ready: Sequence[Replay], experiment: Experiment) -> None:
    """Raises ExperimentError where exact times are asked for, also along a sweep, and there are none."""
    check_exact(ready, experiment)
    for point in points(experiment):
        if point.same_units:
            check_exact(ready, point.experiment)


def _at_point(point: Point, logs: Sequence[StudyLog], gatherer: Gatherer, horizon: float | None) -> pd.DataFrame:
    """The rows of `sweep.csv` of one point: summaries of its configurations, at the horizon of the experiment."""
    experiment = point.experiment
    if not point.same_units:
        logs = [StudyLog(log.recording, experiment, log.pieces) for log in logs]
    exact, of = _exactly(logs, experiment, gatherer), _gathered(logs, experiment, gatherer)
    times = _times([log.facts(experiment) for log in logs], experiment)
    rows, _ = summary_of(
        of.tally,
        list(experiment.configurations),
        {name: one.rate_hz for name, one in times.items()},
        seed=experiment.seed,
        horizon_s=horizon,
        exact=exact,
        accuracy=totals(of.totals),
        fixed=fixed_in(experiment.as_written()),
        conflicts_asked=experiment.measure.conflict is not None,
        links={name: one.links for name, one in times.items() if one.links is not None},
    )
    rows.insert(0, "sweep", point.sweep)
    rows.insert(1, "value", point.value)
    return rows


def _exactly(logs: Sequence[StudyLog], experiment: Experiment, gatherer: Gatherer) -> pd.DataFrame | None:
    if not experiment.measure.exact:
        return None
    return pd.concat([gatherer.exact(log, experiment) for log in logs], ignore_index=True)


def _times(facts: Sequence[Facts], experiment: Experiment) -> dict[str, ListTimes]:
    return {name: together(of.times[name] for of in facts if name in of.times) for name in experiment.configurations}


def log_path_of(recordings: Sequence[Recording], log: str) -> Path:
    """Where a log lies."""
    return next(recording.path for recording in recordings if recording.scene.log == log)
