"""The crew: an executor whose workers survey logs and compute pieces, and what happens where workers fail.

The command then finds every piece among those that are kept, as it does when it is run again: results are the same
bytes, whichever worker computes and in whatever order. Tasks: of one log, at most MOST_CELLS or MOST_ROWS each; reading
a log again costs little, and a worker that dies gives up little. No piece depends on how tasks are cut.
"""

from __future__ import annotations

import json
import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path

from copem_replay.core.errors import CopemError, count_noun
from copem_replay.core.yaml import Key
from copem_replay.experiment.drive import apply_settings, resolve_for_log
from copem_replay.experiment.file import ExperimentSource, place_identity, relocate_settings
from copem_replay.experiment.schema import Experiment, LogSettings
from copem_replay.experiment.validate import RefusedLog, log_names, refuse_missing, settings_by_place
from copem_replay.io.open import Place, first_recording
from copem_replay.io.recording import Recording
from copem_replay.pipeline.pieces import PieceCache, recipe_key, split_runs, take_fingerprint, write_recipe
from copem_replay.pipeline.study_log import StudyLog, survey_key
from copem_replay.pipeline.sweep import list_points
from copem_replay.pipeline.worker import LogTask, Receipt, Task, Work, do_task

# Tasks: what a study still needs of its logs.

MOST_CELLS, MOST_ROWS = 50_000_000, 500_000
"""Row × run cells, and rows, of a task at most, unless one piece has more: some seconds of work."""
ROWS_AT_ONCE = {False: 250_000, True: 60_000}
"""Rows in memory of a worker at most, unless one piece has more, without accuracy and with it: up to 500 MB."""
LEAST_S = 1.0
"""Seconds below which a task is not cut further: sending it and reading its log would cost as much."""


def plan_surveys(
    experiment: Experiment, places: Mapping[Place, Key | None], source: ExperimentSource, pieces: PieceCache
) -> dict[str, Task]:
    """Surveys of the logs of which facts are missing, by the identities of their places."""
    readable = {place_identity(place): place for place in places if refuse_missing(place, None) is None}
    own_settings = settings_by_place(experiment, source)
    own_names = {whose: settings.name for whose, (_, settings) in own_settings.items() if settings.name is not None}
    unnamed = [whose for whose in readable if whose not in own_names]
    # Names as if all logs can be replayed: else a log that is named after its folder, too, would be surveyed twice.
    names = own_names | dict(
        zip(unnamed, log_names([first_recording(readable[whose]) for whose in unnamed]), strict=True)
    )
    experiments = [experiment, *(point.experiment for point in list_points(experiment))]
    surveys = {}
    for whose, place in readable.items():
        settings = own_settings[whose][1].model_copy(update={"name": names[whose]}) if whose in own_settings else None
        resolved = (one if settings is None else apply_settings(one, settings) for one in experiments)
        if any(pieces.known(survey_key(place, one)) is None for one in resolved):
            surveys[whose] = Task(_make_log_task(experiment, names[whose], place, settings, pieces.address))
    return surveys


def plan_pieces(experiment: Experiment, logs: Sequence[StudyLog], pieces: PieceCache, threads: int) -> list[Task]:
    """What has to be computed, log by log so that a worker keeps a log in memory, the largest logs first."""
    is_kept = pieces.keys()
    works = {log.name: list(_list_missing_work(log, experiment, is_kept)) for log in logs}
    whole_s = sum(Task(_NO_LOG, tuple(work)).about_s for work in works.values())
    most_s = max(whole_s / (4 * threads), LEAST_S)  # few logs then keep many workers busy
    tasks = []
    for log in logs:
        if works[log.name]:
            entry = next((e for e in experiment.logs if isinstance(e, LogSettings) and e.name == log.name), None)
            log_task = _make_log_task(experiment, log.name, log.recording.place, entry, pieces.address)
            tasks += [Task(log_task, part) for part in _cut_into_tasks(works[log.name], most_s)]
    log_seconds = dict.fromkeys(works, 0.0)
    for task in tasks:
        log_seconds[task.log.name] += task.about_s
    return sorted(tasks, key=lambda task: (-log_seconds[task.log.name], task.log.name, -task.about_s))


def _list_missing_work(log: StudyLog, study: Experiment, is_kept: Callable[[str], bool]) -> Iterator[Work]:
    for number, experiment in enumerate([study, *(point.experiment for point in list_points(study))]):
        alone, facts = resolve_for_log(experiment, log.name), log.facts(experiment)
        without_runs: list[tuple[int, int] | None] = [None] if experiment.measure.exact else []
        for runs in [*without_runs, *split_runs(alone.runs, facts.episodes)]:
            keys = {name: recipe_key(write_recipe(alone, name, log.identity, runs)) for name in alone.configurations}
            names = [name for name, key in keys.items() if not is_kept(key)]
            count = 1 if runs is None else runs[1] - runs[0]
            rows = max(facts.episodes * count, 1)
            step = max(ROWS_AT_ONCE[alone.measure.accuracy] // rows, 1)
            for k in range(0, len(names), step):
                part = names[k : k + step]
                yield Work(number, runs, {n: keys[n] for n in part}, rows * len(part), facts.listable * count)


def _cut_into_tasks(works: Sequence[Work], most_s: float) -> Iterator[tuple[Work, ...]]:
    """Neighbouring work together, up to the size of a task."""
    batch: list[Work] = []
    for work in works:
        task = Task(_NO_LOG, (*batch, work))
        cells = sum(one.cells for one in task.work)
        if batch and (cells > MOST_CELLS or task.rows > MOST_ROWS or task.about_s > most_s):
            yield tuple(batch)
            batch = []
        batch.append(work)
    if batch:
        yield tuple(batch)


_NO_LOG = LogTask("", Path(), "", "", "", ())


def _make_log_task(
    experiment: Experiment, name: str, place: Place, settings: LogSettings | None, address: str
) -> LogTask:
    written = experiment.as_written()
    del written["logs"]
    if settings is not None:
        entry = relocate_settings(settings, place).model_copy(update={"name": name})
        written["logs"] = [entry.model_dump(mode="json", by_alias=True)]
    made_by = tuple(sorted(take_fingerprint().items()))
    return LogTask(name, place, json.dumps(written), os.getcwd(), address, made_by)


# Workers, and the crew that gives them tasks.

TICK_S = 1.0
"""Seconds between reports of progress while no task ends: the display of time and of lost workers stays alive."""


class WorkerDiedError(Exception):
    """Workers died while they had a task. `alone`: they had no other task of the crew, so this one is the cause."""

    def __init__(self, deaths: int, host: str, *, alone: bool) -> None:
        super().__init__(f"{count_noun(deaths, 'worker')} died, last on {host}")
        self.deaths, self.host, self.alone = deaths, host, alone


class TaskFailedError(RuntimeError):
    """An internal error in a task: where, and the traceback of the worker."""


class Workers(Executor, ABC):
    """An executor that knows its workers. `lost`: how many have died; `again`: how many pieces they gave up."""

    lost = 0
    again = 0

    @abstractmethod
    def threads(self) -> int:
        """How many tasks run at once."""

    def next(self, tasks: deque[Task]) -> Task:
        """Take out the task to be done next."""
        return tasks.popleft()

    @abstractmethod
    def give(self, task: Task) -> Future[Receipt]:
        """Submit a task."""

    @abstractmethod
    def come_back(self) -> None:
        """Wait until tasks can be submitted again. Raises TimeoutError."""


class _ExecutorWorkers(Workers):
    """Any `concurrent.futures` executor: it breaks with its first dead worker."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def threads(self) -> int:
        client = getattr(self._executor, "_client", None)  # Dask's executor
        if client is not None:
            return max(sum(map(int, client.nthreads().values())), 1)
        return int(getattr(self._executor, "_max_workers", None) or os.cpu_count() or 1)

    def give(self, task: Task) -> Future[Receipt]:
        return self._executor.submit(do_task, task)

    def come_back(self) -> None:
        raise TimeoutError("crew: its executor has cancelled what it was given")


@dataclass(frozen=True)
class CrewProgress:
    """How far the crew is. `rows`: of the pieces that were missing; 0 for surveys."""

    what: str
    logs_done: int
    logs: int
    rows_done: int = 0
    rows: int = 0
    lost: int = 0  # workers

    @property
    def done(self) -> int:
        """Rows that are done; of surveys logs."""
        return self.rows_done if self.rows else self.logs_done

    @property
    def total(self) -> int:
        """All rows; of surveys all logs."""
        return self.rows or self.logs


class Crew:
    """Surveys and computes with an executor whose workers see the same pieces. `tell`: called with the progress."""

    def __init__(
        self, executor: Executor, pieces: PieceCache, tell: Callable[[CrewProgress], None] | None = None
    ) -> None:
        self._workers = executor if isinstance(executor, Workers) else _ExecutorWorkers(executor)
        self._pieces, self._tell = pieces, tell
        self._progress = CrewProgress("", 0, 0)
        self._lost: dict[str, WorkerDiedError] = {}  # logs at which workers died, by their identities
        self.peak_bytes = 0  # the most memory a worker has had, 0 where no system says so

    def survey(
        self,
        experiment: Experiment,
        places: Mapping[Place, Key | None],
        source: ExperimentSource,
        *,
        skip_unreadable: bool,
    ) -> dict[str, list[RefusedLog]]:
        """Have workers survey all logs of which facts are missing. Returns why some cannot be replayed, by identity.

        Raises CopemError for what is wrong with the experiment, or with the workers.
        """
        surveys = plan_surveys(experiment, places, source, self._pieces)
        whose = {task.log.name: identity for identity, task in surveys.items()}
        todo = [task for identity, task in surveys.items() if identity not in self._lost]
        total = len({place_identity(place) for place in places})
        self._progress = CrewProgress("surveying", total - len(todo), total)
        refused: dict[str, list[RefusedLog]] = {}
        own_settings, problems = settings_by_place(experiment, source), []
        for task, receipt in self._receive_all(todo):
            entry, settings = own_settings.get(whose[task.log.name], (None, None))
            if receipt.refused:
                refused[whose[task.log.name]] = [log.within(entry, settings) for log in receipt.refused]
            problems += [source.at(receipt.key, line) if receipt.key else line for line in receipt.problems]
            self._report(logs=1)
        self._pieces.store.refresh()
        if problems:
            raise CopemError(list(dict.fromkeys(problems)))
        for place in places:
            if (error := self._lost.get(place_identity(place))) is not None:
                refused[place_identity(place)] = [
                    RefusedLog(first_recording(place), self._describe_death(error, skip_unreadable))
                ]
        return refused

    def fill(self, experiment: Experiment, recordings: Sequence[Recording]) -> bool:
        """Have workers compute all missing pieces. Returns whether workers died of logs, which the study leaves out.

        Raises CopemError for what is wrong with the workers.
        """
        logs = [StudyLog(recording, experiment, self._pieces) for recording in recordings]
        tasks = plan_pieces(experiment, logs, self._pieces, self._workers.threads())
        left: dict[str, int] = {}
        for task in tasks:
            left[task.log.name] = left.get(task.log.name, 0) + 1
        self._progress = CrewProgress(
            "replaying", len(logs) - len(left), len(logs), rows=sum(task.rows for task in tasks)
        )
        lost_before, computed = len(self._lost), list[str]()
        for task, receipt in self._receive_all(tasks):
            if receipt.problems or receipt.refused:
                raise CopemError([*receipt.problems, *(log.said(None) for log in receipt.refused)])
            left[task.log.name] -= 1
            computed += task.keys
            self._report(int(left[task.log.name] == 0), task.rows)
        is_kept = self._pieces.keys()
        if not all(map(is_kept, computed)):
            where = self._pieces.store.where
            raise CopemError(f"{where}: what workers keep there is not seen from here; a shared folder or s3://…")
        self._pieces.computed += len(computed)
        self._pieces.found -= len(computed)  # gathering counts them as found
        return len(self._lost) > lost_before

    @property
    def notes(self) -> list[str]:
        """How many workers died, for the command's notes."""
        if not self._workers.lost:
            return []
        died = "a worker died" if self._workers.lost == 1 else f"{self._workers.lost} workers died"
        return [f"{died} ({count_noun(self._workers.again, 'piece')} computed again)"]

    @property
    def interrupted(self) -> str:
        """The message of a command that is interrupted."""
        return f"interrupted; {self._so_far}"

    @property
    def _so_far(self) -> str:
        done, logs = (0, 0) if self._progress.what != "replaying" else (self._progress.logs_done, self._progress.logs)
        return f"{done} of {logs or self._progress.logs} logs are in {self._pieces.store.where}"

    def _describe_death(self, error: WorkerDiedError, skip_unreadable: bool) -> str:
        died = f"the worker that replayed it died {error.deaths} times"
        if skip_unreadable:
            return f"{died} (out of memory?)"
        out, where = "more memory per worker, or --skip-unreadable", self._pieces.store.where
        return f"{died}, last on {error.host} (out of memory?); {out}; what is done stays done in {where}"

    def _report(self, logs: int = 0, rows: int = 0) -> None:
        """Report that so many more logs and rows are done."""
        progress = self._progress
        progress = replace(
            progress, logs_done=progress.logs_done + logs, rows_done=progress.rows_done + rows, lost=self._workers.lost
        )
        self._progress = progress
        if self._tell is not None:
            self._tell(self._progress)

    def _receive_all(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Receipt]]:
        """The receipts of tasks as they come. A task at which workers died beside others is tried once more, alone."""
        waiting, suspects, flying = deque(tasks), deque[Task](), dict[Future[Receipt], Task]()
        self._report()
        try:
            while waiting or suspects or flying:
                source, at_once = (waiting, self._workers.threads()) if waiting or flying else (suspects, 1)
                while source and len(flying) < at_once:
                    task = self._workers.next(source)
                    if place_identity(task.log.place) not in self._lost:
                        flying[self._workers.give(task)] = task
                finished, _ = wait(flying, TICK_S, FIRST_COMPLETED)
                self._report()
                if any(future.cancelled() for future in finished):  # the executor has lost its scheduler
                    given_up = [future for future in flying if future.cancelled() or not future.done()]
                    waiting.extendleft(flying.pop(future) for future in given_up)
                    self._come_back()
                    continue
                for future in finished:
                    task = flying.pop(future)
                    try:
                        yield task, self._receive(future, task)
                    except WorkerDiedError as error:
                        if error.alone:
                            self._lost[place_identity(task.log.place)] = error
                        else:
                            suspects.append(task)
        except TaskFailedError:
            wait(flying)  # running tasks end first
            raise
        finally:
            for future in flying:
                future.cancel()

    def _receive(self, future: Future[Receipt], task: Task) -> Receipt:
        """The receipt. Raises WorkerDiedError, CopemError, TaskFailedError, and what the executor raises."""
        try:
            receipt = future.result()
        except BrokenExecutor as error:
            why = f"a worker died, and its executor with it ({type(error).__name__})"
            raise CopemError(f"crew: {why}; {self._so_far}; the same command goes on") from None
        except Exception as error:
            if type(error).__name__ != "KilledWorker":  # Dask's, which need not be installed
                raise
            deaths, host = error.allowed_failures + 1, error.last_worker.address  # type: ignore[attr-defined]
            raise WorkerDiedError(deaths, host, alone=True) from None
        self.peak_bytes = max(receipt.peak_bytes or 0, self.peak_bytes)
        if receipt.failure is not None:
            pieces = "".join(f", runs {work.runs}: {', '.join(work.keys)}" for work in task.work)
            raise TaskFailedError(f"{task.log.place}{pieces}: on worker {receipt.host}:\n{receipt.failure}")
        return receipt

    def _come_back(self) -> None:
        """Wait for the executor to come back. Raises CopemError where it does not."""
        try:
            self._workers.come_back()
        except TimeoutError as error:
            raise CopemError(f"{error}; {self._so_far}; the same command goes on") from None
