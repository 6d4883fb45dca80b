"""The crew: an executor whose workers survey logs and compute parts, and what happens where workers fail.

The command then finds every part among those that are kept, as it does when it is run again: results are the same
bytes, whichever worker computes and in whatever order. A task is a log with all its missing parts. Text and paths are
sent, a receipt comes back; rows, recordings and modules are never sent (docs/develop/decisions/scale.md).
"""

from __future__ import annotations

import json
import os
import platform
import secrets
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache

from pydantic import ValidationError

from copem_replay.api.study import LoadedStudy, check_any_counted
from copem_replay.core.errors import CopemError, ExperimentError, InputError, count_noun
from copem_replay.core.yaml import Key
from copem_replay.experiment.drive import apply_settings, resolve_for_log
from copem_replay.experiment.file import ExperimentSource, place_identity, relocate_settings
from copem_replay.experiment.schema import Experiment, LogSettings
from copem_replay.experiment.validate import RefusedLog, log_names, read_logs, refuse_missing, settings_by_place
from copem_replay.io.open import Place, first_recording
from copem_replay.io.recording import KnownLog
from copem_replay.pipeline.closed_form import check_exact
from copem_replay.pipeline.cost import RunCost, peak_bytes
from copem_replay.pipeline.parts import (
    PartCache,
    Store,
    cut_parts,
    open_store,
    part_name,
    take_fingerprint,
    write_recipe,
)
from copem_replay.pipeline.run import Gatherer, Progress
from copem_replay.pipeline.study_log import StudyLog, survey_key
from copem_replay.pipeline.sweep import list_points

# A task, and the worker that does it.


@dataclass(frozen=True)
class Task:
    """A log as a worker finds it. `experiment`: the study's, with the settings of this log alone, as JSON.

    `sha256`: of its content; empty: it is surveyed, that is read and checked, and its facts are kept.
    """

    name: str
    place: Place
    experiment: str
    folder: str  # the command's working directory, which paths are relative to
    parts: str
    fingerprint: tuple[tuple[str, str], ...]
    command: str  # parts are listed once for each
    sha256: str = ""


@dataclass(frozen=True)
class Receipt:
    """What a worker answers. At most one of `refused`, `problems` and `failure` is set.

    `refused`: why the log cannot be replayed. `problems`: what else is wrong, a line each, at the `key` of the
    experiment. `failure`: the traceback of an internal error.
    """

    host: str
    peak_bytes: int | None = None  # the most memory the worker has had so far, where its system says so
    refused: tuple[RefusedLog, ...] = ()
    problems: tuple[str, ...] = ()
    key: tuple[str, ...] = ()
    failure: str | None = None


def do_task(task: Task) -> Receipt:
    """Do a task. Errors are in the receipt: no exception has to be sent."""
    receipt = Receipt(platform.node())
    try:
        receipt = _do_task(task, receipt)
    except CopemError as error:
        receipt = replace(receipt, problems=error.problems)
    except ValidationError as error:  # the experiment is valid where the command runs
        why = error.errors()[0]["msg"]
        receipt = replace(receipt, problems=(f"worker {receipt.host}: the experiment cannot be read there: {why}",))
    except Exception:
        receipt = replace(receipt, failure=traceback.format_exc())
    return replace(receipt, peak_bytes=peak_bytes())


def _do_task(task: Task, receipt: Receipt) -> Receipt:
    """Survey a log, or compute its parts, on a worker; the receipt says what came of it. Raises InputError."""
    if other := describe_mismatch(dict(task.fingerprint)):
        raise InputError(f"worker {receipt.host} {other}: results would not be the same bits")
    try:
        os.chdir(task.folder)
    except OSError:
        raise InputError(f"{task.folder}: not visible from worker {receipt.host}") from None
    experiment = Experiment.model_validate(json.loads(task.experiment))
    parts = PartCache(task.parts, _open_store(task.parts, task.folder, task.command))
    recordings, refused = read_logs(resolve_for_log(experiment, task.name), [task.place], None)
    if refused:
        return replace(receipt, refused=tuple(refused))
    recording = replace(recordings[0], scene=replace(recordings[0].scene, log=task.name))
    first_log = StudyLog(recording, experiment, parts)
    points = [(experiment, first_log)]
    for point in list_points(experiment):
        log = first_log if point.same_units else StudyLog(recording, point.experiment, parts)
        points.append((point.experiment, log))
    if not task.sha256:
        return _survey_log(points, receipt)
    if first_log.digests["sha256"] != task.sha256:
        raise InputError(f"{task.place}: on worker {receipt.host} it has another content than where the command runs")
    gatherer = Gatherer(1, RunCost(), parts)
    for experiment, log in points:
        if experiment.measure.exact:
            gatherer.exact(log, experiment)
        for _ in gatherer.each([log], experiment):
            pass
    return receipt


def _survey_log(points: Sequence[tuple[Experiment, StudyLog]], receipt: Receipt) -> Receipt:
    """Keep the facts of a log, at each point of the study."""
    for experiment, log in points:
        try:
            check_exact([log.replay()], experiment)
        except ExperimentError as error:
            return replace(receipt, problems=error.problems, key=("measure", "exact"))
        log.facts(experiment)
    return receipt


@lru_cache(maxsize=2)
def _open_store(address: str, folder: str, command: str) -> Store:  # the address is relative to the folder
    return open_store(address)


def describe_mismatch(expected: Mapping[str, str]) -> str | None:
    """In what this process differs from a fingerprint: `has numba 0.67.1, expected 0.68.1`; None: in nothing."""
    own = take_fingerprint()
    for name, version in expected.items():
        if own[name] != version:
            return f"has {name} {_shorten_version(own[name])}, expected {_shorten_version(version)}"
    return None


def _shorten_version(version: str) -> str:
    """A version whose digest is cut: enough to tell two from one another."""
    name, _, digest = version.partition(" ")
    return f"{name} ({digest[:8]})" if len(digest) == 40 else version


# The crew that gives workers tasks.

TICK_S = 1.0
"""Seconds between reports of progress while no task ends: the display of time and of lost workers stays alive."""


class WorkerDiedError(Exception):
    """Workers died while they had a task."""

    def __init__(self, deaths: int, host: str) -> None:
        super().__init__(f"{count_noun(deaths, 'worker')} died, last on {host}")
        self.deaths, self.host = deaths, host


class TaskFailedError(RuntimeError):
    """An internal error in a task: where, and the traceback of the worker."""


@dataclass(frozen=True)
class CrewProgress:
    """How far the crew is."""

    what: str
    done: int  # logs
    total: int
    lost: int = 0  # workers


def gather_crew(executor: Executor, parts: PartCache, progress: Progress | None) -> Crew:
    """The crew of an executor; `progress(done, total)` is called after each log that is computed."""

    def tell(reached: CrewProgress) -> None:
        if progress is not None:
            progress(reached.done if reached.what == "replaying" else 0, reached.total)

    return Crew(executor, parts, tell)


class Crew:
    """Surveys and computes with an executor whose workers see the same parts. `tell`: called with the progress."""

    def __init__(
        self, executor: Executor, parts: PartCache, tell: Callable[[CrewProgress], None] = lambda _: None
    ) -> None:
        self._executor, self._parts, self._tell = executor, parts, tell
        self._progress, self._command = CrewProgress("", 0, 0), secrets.token_hex(8)
        self._lost: dict[str, WorkerDiedError] = {}  # logs at which workers died, by their identities
        self.peak_bytes = 0  # the most memory a worker has had, 0 where no system says so

    def read_study(self, read: Callable[[], LoadedStudy]) -> LoadedStudy:
        """The study that `read` returns, with all parts computed; it is read again after a log that killed workers."""
        check_any_counted(study := read())
        while self.fill(study.experiment, study.logs):
            study = read()
        return study

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
        surveys = self._plan_surveys(experiment, places, source)
        identity_by_name = {task.name: identity for identity, task in surveys.items()}
        tasks = [task for identity, task in surveys.items() if identity not in self._lost]
        total = len({place_identity(place) for place in places})
        self._progress = CrewProgress("surveying", total - len(tasks), total)
        refused: dict[str, list[RefusedLog]] = {}
        own_settings, problems = settings_by_place(experiment, source), list[str]()
        for task, receipt in self._do_all(tasks):
            entry, settings = own_settings.get(identity_by_name[task.name], (None, None))
            if receipt.refused:
                refused[identity_by_name[task.name]] = [log.within(entry, settings) for log in receipt.refused]
            problems += [source.at(receipt.key, line) if receipt.key else line for line in receipt.problems]
        self._parts.store.refresh()
        if problems:
            raise CopemError(list(dict.fromkeys(problems)))
        for place in places:
            if (error := self._lost.get(place_identity(place))) is not None:
                refused[place_identity(place)] = [
                    RefusedLog(first_recording(place), self._describe_death(error, skip_unreadable))
                ]
        return refused

    def _plan_surveys(
        self, experiment: Experiment, places: Mapping[Place, Key | None], source: ExperimentSource
    ) -> dict[str, Task]:
        """By identity of its place, a survey for each log of which facts are missing."""
        readable = {place_identity(place): place for place in places if refuse_missing(place, None) is None}
        own_settings = settings_by_place(experiment, source)
        own_names = {whose: settings.name for whose, (_, settings) in own_settings.items() if settings.name is not None}
        unnamed = [whose for whose in readable if whose not in own_names]
        # Names as if all logs can be replayed: else a log named after its folder, too, would be surveyed twice.
        names = own_names | dict(
            zip(unnamed, log_names([first_recording(readable[whose]) for whose in unnamed]), strict=True)
        )
        experiments = [experiment, *(point.experiment for point in list_points(experiment))]
        surveys = {}
        for whose, place in readable.items():
            settings = (
                own_settings[whose][1].model_copy(update={"name": names[whose]}) if whose in own_settings else None
            )
            resolved = (one if settings is None else apply_settings(one, settings) for one in experiments)
            if any(self._parts.known(survey_key(place, one)) is None for one in resolved):
                surveys[whose] = self._make_task(experiment, names[whose], place, settings)
        return surveys

    def fill(self, experiment: Experiment, recordings: Sequence[KnownLog]) -> bool:
        """Have workers compute all missing parts. Returns whether workers died of logs, which the study leaves out.
        Raises CopemError for what is wrong with the workers.
        """
        store, tasks, missing = self._parts.store, [], dict[str, list[str]]()
        store.refresh()
        for recording in sorted(recordings, key=lambda known_log: -StudyLog(known_log, experiment).object_states):
            log = StudyLog(recording, experiment, self._parts)
            if names := [name for name in list_parts(log, experiment) if not store.exists(name)]:
                settings = (one for one in experiment.logs if isinstance(one, LogSettings) and one.name == log.name)
                task = self._make_task(experiment, log.name, recording.place, next(settings, None))
                tasks.append(replace(task, sha256=log.digests["sha256"]))
                missing[log.name] = names
        self._progress = CrewProgress("replaying", len(recordings) - len(tasks), len(recordings))
        lost_before, computed_parts = len(self._lost), list[str]()
        for task, receipt in self._do_all(tasks):
            if receipt.problems or receipt.refused:
                raise CopemError([*receipt.problems, *(log.said(None) for log in receipt.refused)])
            computed_parts += missing[task.name]
        store.refresh()
        if not all(map(store.exists, computed_parts)):
            why = "what workers keep there is not seen from here, or their own components are of other files"
            raise CopemError(f"{store.where}: {why}; a shared folder or s3://…")
        self._parts.computed += len(computed_parts)
        self._parts.found -= len(computed_parts)  # gathering counts them as found
        return len(self._lost) > lost_before

    def _make_task(self, experiment: Experiment, name: str, place: Place, settings: LogSettings | None) -> Task:
        data = experiment.as_written()
        del data["logs"]
        if settings is not None:
            entry = relocate_settings(settings, place).model_copy(update={"name": name})
            data["logs"] = [entry.model_dump(mode="json", by_alias=True)]
        made_by = tuple(sorted(take_fingerprint().items()))
        return Task(name, place, json.dumps(data), os.getcwd(), self._parts.address, made_by, self._command)

    @property
    def notes(self) -> list[str]:
        """How many workers died, for the command's notes."""
        lost = self._progress.lost
        return [f"{count_noun(lost, 'worker')} died; what was not done was computed again"] if lost else []

    @property
    def interrupted(self) -> str:
        """The message of a command that is interrupted."""
        return f"interrupted; {self._so_far}"

    @property
    def _so_far(self) -> str:
        done = self._progress.done if self._progress.what == "replaying" else 0
        return f"{done} of {self._progress.total} logs are in {self._parts.store.where}"

    def _describe_death(self, error: WorkerDiedError, skip_unreadable: bool) -> str:
        died = f"the worker that replayed it died {error.deaths} times"
        if skip_unreadable:
            return f"{died} (out of memory?)"
        out, where = "more memory per worker, or --skip-unreadable", self._parts.store.where
        return f"{died}, last on {error.host} (out of memory?); {out}; what is done stays done in {where}"

    def _report(self, logs: int = 0) -> None:
        """Report that so many more logs are done."""
        lost = getattr(self._executor, "lost", 0)
        self._progress = replace(self._progress, done=self._progress.done + logs, lost=lost)
        self._tell(self._progress)

    def _do_all(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Receipt]]:
        """The receipts of tasks as they come. A task at which a worker died is tried once more, alone."""
        waiting, suspected, running = deque(tasks), deque[Task](), dict[Future[Receipt], tuple[Task, bool]]()
        self._report()
        try:
            while waiting or suspected or running:
                queue, at_once = (waiting, self._count_threads()) if waiting or running else (suspected, 1)
                while queue and len(running) < at_once:
                    task = queue.popleft()
                    if place_identity(task.place) not in self._lost:
                        with self._say_where_it_ends():
                            running[self._executor.submit(do_task, task)] = task, at_once == 1
                finished, _ = wait(running, TICK_S, FIRST_COMPLETED)
                self._report()
                for future in finished:
                    task, was_alone = running.pop(future)
                    try:
                        receipt = self._receive(future, task)
                    except WorkerDiedError as error:
                        suspected += [] if was_alone else [task]
                        self._lost |= {place_identity(task.place): error} if was_alone else {}
                        continue
                    yield task, receipt
                    self._report(1)
        except TaskFailedError:
            wait(running)  # running tasks end first
            raise
        finally:
            for future in running:
                future.cancel()

    def _count_threads(self) -> int:
        """How many tasks run at once: as many are given, so that none is suspected for its neighbour in a queue."""
        client = getattr(self._executor, "_client", None)  # Dask's
        if client is None:
            return int(getattr(self._executor, "_max_workers", None) or os.cpu_count() or 1)
        with self._say_where_it_ends():
            if self._is_gone():  # its futures might not tell of it
                raise CancelledError
            with suppress(OSError, RuntimeError):  # futures tell of a lost scheduler
                return int(max(sum(client.nthreads().values()), 1))
        return 1

    def _is_gone(self) -> bool:
        """Whether Dask's client has closed itself, as it does some time after its scheduler is gone."""
        return getattr(getattr(self._executor, "_client", None), "status", None) in ("closing", "closed")

    @contextmanager
    def _say_where_it_ends(self) -> Iterator[None]:
        """A context that raises CopemError where the executor takes no more tasks, or tells no more of them."""
        try:
            yield
        except BrokenExecutor as error:
            raise self._end(f"a worker died, and its executor with it ({type(error).__name__})") from None
        except Exception as error:
            if self._is_gone():  # whatever is asked of a closed client, and it has more than one error for it
                raise self._end("the scheduler is gone") from None
            if isinstance(error, CancelledError):
                raise self._end("the executor has cancelled what it was given: its scheduler is gone") from None
            raise

    def _receive(self, future: Future[Receipt], task: Task) -> Receipt:
        """The receipt of a task. Raises WorkerDiedError, CopemError, TaskFailedError, and what the executor raises."""
        try:
            with self._say_where_it_ends():
                receipt = future.result()
        except Exception as error:
            if type(error).__name__ != "KilledWorker":  # Dask's, which need not be installed
                raise
            deaths, host = error.allowed_failures + 1, error.last_worker.address  # type: ignore[attr-defined]
            raise WorkerDiedError(deaths, host.partition("://")[2]) from None
        self.peak_bytes = max(receipt.peak_bytes or 0, self.peak_bytes)
        if receipt.failure is not None:
            raise TaskFailedError(f"{task.place}: on worker {receipt.host}:\n{receipt.failure}")
        return receipt

    def _end(self, why: str) -> CopemError:
        return CopemError(f"crew: {why}; {self._so_far}; the same command goes on")


def list_parts(log: StudyLog, study: Experiment) -> Iterator[str]:
    """The names in a store of all parts of a log, at each point of a study."""
    for experiment in [study, *(point.experiment for point in list_points(study))]:
        alone = resolve_for_log(experiment, log.name)
        blocks: list[tuple[int, int] | None] = [None] if experiment.measure.exact else []
        for runs in [*blocks, *cut_parts(alone.runs, log.object_states)]:
            yield from (part_name(write_recipe(alone, name, log.identity, runs)) for name in alone.configurations)
