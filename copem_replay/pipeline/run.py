"""Run: experiment × logs × blocks of runs → results folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.fixed import fixed_in
from copem_replay.metrics.summary import horizon_s, own_sums_of, summary_of
from copem_replay.metrics.tally import tally
from copem_replay.pipeline.accuracy_tables import AccuracyTables, accuracy_tables, totals, with_accuracy
from copem_replay.pipeline.blocks import Outcome, blocks, outcomes
from copem_replay.pipeline.closed_form import check_exact, exact_table
from copem_replay.pipeline.cost import Cost, watched
from copem_replay.pipeline.list_rates import ListTimes, list_times, together
from copem_replay.pipeline.memory import memory_notes
from copem_replay.pipeline.notes import notes_of, same_instants
from copem_replay.pipeline.output_times import output_times
from copem_replay.pipeline.prepare import Replay, prepare
from copem_replay.pipeline.sweep import Point, points

Progress = Callable[[int, int], None]
"""`progress(done, total)`, called after each block of runs."""


@dataclass(frozen=True)
class Result:
    """What one experiment gave."""

    table: pd.DataFrame  # detections.parquet
    summary: pd.DataFrame  # summary.csv
    notes: tuple[str, ...]  # what has to be said, one line each
    replays: tuple[Replay, ...]  # one per log
    horizon_s: float | None
    exact: pd.DataFrame | None = None  # exact.parquet, with `measure: {exact: true}`
    accuracy: AccuracyTables | None = None  # with `measure: {accuracy: true}`
    sweep: pd.DataFrame | None = None  # sweep.csv, with `sweep:`
    costs: tuple[str, ...] = ()  # what has to be said on the terminal alone: no two runs take the same time
    tally: pd.DataFrame = field(default_factory=pd.DataFrame)  # tally.parquet


def run(
    experiment: Experiment,
    recordings: Sequence[Recording],
    *,
    jobs: int = 1,
    progress: Progress | None = None,
    ready: Sequence[Replay] | None = None,
) -> Result:
    """Replay logs through an experiment. The result does not depend on `jobs`, nor on how runs are cut into blocks.

    `ready`: the logs as they were prepared and checked before. Raises ExperimentError before any run: something that
    has no closed form, runs that no memory holds.
    """
    with watched() as cost:
        if ready is None:
            ready = [prepare(recording, of_log(experiment, recording.scene.log)) for recording in recordings]
            check_closed_form(ready, experiment)
            memory_notes(ready, experiment)
        tables = _Tables(jobs, progress, 1 + sum(1 for _ in points(experiment)), cost)
        result = _run(experiment, recordings, ready, tables)
    return replace(result, costs=cost.notes())


def _run(experiment: Experiment, recordings: Sequence[Recording], ready: Sequence[Replay], tables: _Tables) -> Result:
    exact = _exactly(ready, experiment)
    table, parts, order = tables.of(ready, experiment)
    tallied = tally(table)
    horizon = horizon_s(tallied, experiment.measure.horizon_s)
    times = _times(ready, experiment)
    rows, said = summary_of(
        tallied,
        list(experiment.configurations),
        {name: one.rate_hz for name, one in times.items()},
        seed=experiment.seed,
        horizon_s=horizon,
        exact=exact,
        accuracy=totals(parts),
        fixed=fixed_in(experiment.as_written()),
        own=experiment.measure.metrics,
        sums=own_sums_of(table, experiment.measure.metrics),
        outputs=output_times(recordings, experiment),
        conflicts_asked=experiment.measure.conflict is not None,
        links={name: one.links for name, one in times.items() if one.links is not None},
    )
    swept = [_at_point(point, recordings, ready, tables, horizon) for point in points(experiment)]
    notes = notes_of(recordings, ready, experiment, replayed=True)
    sweep = pd.concat(swept, ignore_index=True) if swept else None
    accuracy = None
    if experiment.measure.accuracy and len(experiment.configurations):
        accuracy = accuracy_tables(parts, order, same_instants=same_instants(ready))
    return Result(table, rows, (*notes, *said), tuple(ready), horizon, exact, accuracy, sweep, tally=tallied)


def check_closed_form(ready: Sequence[Replay], experiment: Experiment) -> None:
    """Raises ExperimentError where exact times are asked for, also along a sweep, and there are none."""
    check_exact(ready, experiment)
    for point in points(experiment):
        if point.same_units:
            check_exact(ready, point.experiment)


def _at_point(
    point: Point, recordings: Sequence[Recording], ready: Sequence[Replay], tables: _Tables, horizon: float | None
) -> pd.DataFrame:
    """The rows of `sweep.csv` of one point: summaries of its configurations, at the horizon of the experiment."""
    experiment = point.experiment
    if not point.same_units:
        ready = [prepare(recording, of_log(experiment, recording.scene.log)) for recording in recordings]
    table, parts, _ = tables.of(ready, experiment)
    times = _times(ready, experiment)
    rows, _ = summary_of(
        tally(table),
        list(experiment.configurations),
        {name: one.rate_hz for name, one in times.items()},
        seed=experiment.seed,
        horizon_s=horizon,
        exact=_exactly(ready, experiment),
        accuracy=totals(parts),
        fixed=fixed_in(experiment.as_written()),
        conflicts_asked=experiment.measure.conflict is not None,
        links={name: one.links for name, one in times.items() if one.links is not None},
    )
    rows.insert(0, "sweep", point.sweep)
    rows.insert(1, "value", point.value)
    return rows


def _exactly(ready: Sequence[Replay], experiment: Experiment) -> pd.DataFrame | None:
    if not experiment.measure.exact:
        return None
    return pd.concat([exact_table(replay, of_log(experiment, replay.scene.log)) for replay in ready], ignore_index=True)


class _Tables:
    """Tables of all logs and runs, computed in blocks by several workers; tells how far it is."""

    def __init__(self, jobs: int, progress: Progress | None, tables: int, cost: Cost) -> None:
        self._jobs, self._progress, self._tables, self._done, self._cost = jobs, progress, tables, 0, cost

    def of(
        self, ready: Sequence[Replay], experiment: Experiment
    ) -> tuple[pd.DataFrame, list[Outcome], NDArray[np.int64]]:
        """The rows of `detections.parquet` of an experiment; all outcomes, and the order their rows have got."""
        work = [
            (replay, alone, block)
            for replay in ready
            for alone in (of_log(experiment, replay.scene.log),)
            for block in blocks(replay, alone, self._jobs)
        ]
        parts: list[list[Outcome]] = []
        pool, began_s = ThreadPoolExecutor(self._jobs), time.perf_counter()
        try:
            for part in pool.map(lambda item: outcomes(*item), work):
                parts.append(part)
                if self._progress is not None:
                    self._progress(self._done * len(work) + len(parts), self._tables * len(work))
        finally:  # interrupted: what has not begun never does
            pool.shutdown(cancel_futures=True)
        self._done += 1
        every = [outcome for part in parts for outcome in part]
        self._cost.add(time.perf_counter() - began_s, every)
        table = pd.concat([with_accuracy(outcome) for outcome in every], ignore_index=True)
        order = _order(table, [replay.scene.log for replay in ready], experiment)
        return table.iloc[order].reset_index(drop=True), every, order


def _order(table: pd.DataFrame, logs: list[str], experiment: Experiment) -> NDArray[np.int64]:
    """The order (n,) of rows by log, configuration, run and object, however the runs were cut into blocks."""
    log = table["log"].map({name: k for k, name in enumerate(logs)}).to_numpy()
    configuration = table["configuration"].map({n: k for k, n in enumerate(experiment.configurations)}).to_numpy()
    return np.lexsort((table["run"].to_numpy(), configuration, log))


def _times(ready: Sequence[Replay], experiment: Experiment) -> dict[str, ListTimes]:
    of_logs = [list_times(replay, of_log(experiment, replay.scene.log)) for replay in ready]
    return {name: together(one for log in of_logs for one in log.get(name, ())) for name in experiment.configurations}


def log_path_of(recordings: Sequence[Recording], log: str) -> Path:
    """Where a log lies."""
    return next(recording.path for recording in recordings if recording.scene.log == log)
