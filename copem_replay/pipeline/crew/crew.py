"""The crew: an executor whose workers survey logs and compute pieces, and what becomes of what goes wrong with them.

The command itself then finds every piece among those that are kept, as it does when it is run again: results are the
same bytes, whoever computed and in whatever order.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass, replace

from copem_replay.core.errors import CopemError
from copem_replay.core.text import counted
from copem_replay.core.yaml import Key
from copem_replay.experiment.file import Source, identity
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import Refused, settings_by_place
from copem_replay.io.recording import Recording
from copem_replay.io.together import Place, first_of
from copem_replay.pipeline.crew.plan import missing, unsurveyed
from copem_replay.pipeline.crew.task import Receipt, Task
from copem_replay.pipeline.crew.worker import done
from copem_replay.pipeline.pieces import Pieces
from copem_replay.pipeline.study_log import StudyLog

TICK_S = 1.0
"""So often progress is told while nothing is done (chosen)."""


class WorkerDiedError(Exception):
    """Workers died while they had a task. `alone`: they had no other of ours, so that it is this one's doing."""

    def __init__(self, deaths: int, host: str, *, alone: bool) -> None:
        super().__init__(f"{counted(deaths, 'worker')} died, last on {host}")
        self.deaths, self.host, self.alone = deaths, host, alone


class TaskFailedError(RuntimeError):
    """A defect that showed in a task: where, and the traceback of the worker."""


class Workers(Executor, ABC):
    """An executor that knows its workers. `lost`: how many have died; `again`: how many pieces they had to give up."""

    lost = 0
    again = 0

    @abstractmethod
    def threads(self) -> int:
        """How many tasks it does at once."""

    def next(self, tasks: deque[Task]) -> Task:
        """Take out the task to be done next."""
        return tasks.popleft()

    @abstractmethod
    def give(self, task: Task) -> Future[Receipt]:
        """Submit a task."""

    @abstractmethod
    def come_back(self) -> None:
        """Wait until tasks can be submitted again. Raises TimeoutError."""


class _Plain(Workers):
    """Any other executor: it breaks with its first dead worker."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def threads(self) -> int:
        client = getattr(self._executor, "_client", None)  # of Dask
        if client is not None:
            return max(sum(map(int, client.nthreads().values())), 1)
        return int(getattr(self._executor, "_max_workers", None) or os.cpu_count() or 1)

    def give(self, task: Task) -> Future[Receipt]:
        return self._executor.submit(done, task)

    def come_back(self) -> None:
        raise TimeoutError("crew: its executor has cancelled what it was given")


@dataclass(frozen=True)
class CrewProgress:
    """How far the crew is. `rows`: of the pieces that were missing; surveys have none."""

    what: str
    logs_done: int
    logs: int
    rows_done: int = 0
    rows: int = 0
    lost: int = 0  # workers

    @property
    def done(self) -> int:
        """Rows, else logs."""
        return self.rows_done if self.rows else self.logs_done

    @property
    def total(self) -> int:
        """Of which there are so many."""
        return self.rows or self.logs


class Crew:
    """Surveys and computes with an executor, whose workers see the same pieces. `tell`: of progress."""

    def __init__(self, executor: Executor, pieces: Pieces, tell: Callable[[CrewProgress], None] | None = None) -> None:
        self._workers = executor if isinstance(executor, Workers) else _Plain(executor)
        self._pieces, self._tell = pieces, tell
        self._progress = CrewProgress("", 0, 0)
        self._lost: dict[str, WorkerDiedError] = {}  # logs at which workers died, by their identities
        self.peak_bytes = 0  # the most memory a worker has had

    def survey(
        self, experiment: Experiment, places: Mapping[Place, Key | None], source: Source, *, skip_unreadable: bool
    ) -> dict[str, list[Refused]]:
        """Have all logs read of which something is not known. Returns why some cannot be replayed, by identity.

        Raises CopemError for what is wrong with all of them, or with the workers.
        """
        surveys = unsurveyed(experiment, places, source, self._pieces)
        whose = {task.log.name: identity_ for identity_, task in surveys.items()}
        todo = [task for identity_, task in surveys.items() if identity_ not in self._lost]
        total = len({identity(place) for place in places})
        self._progress = CrewProgress("surveying", total - len(todo), total)
        refused: dict[str, list[Refused]] = {}
        mine, problems = settings_by_place(experiment, source), []
        for task, receipt in self._done(todo):
            entry, settings = mine.get(whose[task.log.name], (None, None))
            if receipt.refused:
                refused[whose[task.log.name]] = [log.within(entry, settings) for log in receipt.refused]
            problems += [source.at(receipt.key, line) if receipt.key else line for line in receipt.problems]
            self._said(logs=1)
        self._pieces.store.refresh()
        if problems:
            raise CopemError(list(dict.fromkeys(problems)))
        for place in places:
            if (error := self._lost.get(identity(place))) is not None:
                refused[identity(place)] = [Refused(first_of(place), self._words(error, skip_unreadable))]
        return refused

    def fill(self, experiment: Experiment, recordings: Sequence[Recording]) -> bool:
        """Have all pieces computed that are missing. Returns whether workers died of logs: the study has to do without.

        Raises CopemError for what is wrong with the workers.
        """
        logs = [StudyLog(recording, experiment, self._pieces) for recording in recordings]
        tasks = missing(experiment, logs, self._pieces, self._workers.threads())
        left: dict[str, int] = {}
        for task in tasks:
            left[task.log.name] = left.get(task.log.name, 0) + 1
        self._progress = CrewProgress(
            "replaying", len(logs) - len(left), len(logs), rows=sum(task.rows for task in tasks)
        )
        lost, computed = len(self._lost), list[str]()
        for task, receipt in self._done(tasks):
            if receipt.problems or receipt.refused:
                raise CopemError([*receipt.problems, *(log.said(None) for log in receipt.refused)])
            left[task.log.name] -= 1
            computed += task.keys
            self._said(int(left[task.log.name] == 0), task.rows)
        there = self._pieces.keys()
        if not all(map(there, computed)):
            where = self._pieces.store.where
            raise CopemError(f"{where}: what workers keep there is not seen from here; a shared folder or s3://…")
        self._pieces.computed += len(computed)
        self._pieces.found -= len(computed)  # which gathering is going to find
        return len(self._lost) > lost

    @property
    def notes(self) -> list[str]:
        """What has to be said of workers."""
        if not self._workers.lost:
            return []
        died = "a worker died" if self._workers.lost == 1 else f"{self._workers.lost} workers died"
        return [f"{died} ({counted(self._workers.again, 'piece')} computed again)"]

    @property
    def interrupted(self) -> str:
        """What is said when the command is interrupted."""
        return f"interrupted; {self._so_far}"

    @property
    def _so_far(self) -> str:
        done, logs = (0, 0) if self._progress.what != "replaying" else (self._progress.logs_done, self._progress.logs)
        return f"{done} of {logs or self._progress.logs} logs are in {self._pieces.store.where}"

    def _words(self, error: WorkerDiedError, skip_unreadable: bool) -> str:
        died = f"the worker that replayed it died {error.deaths} times"
        if skip_unreadable:
            return f"{died} (out of memory?)"
        out, where = "more memory per worker, or --skip-unreadable", self._pieces.store.where
        return f"{died}, last on {error.host} (out of memory?); {out}; what is done stays done in {where}"

    def _said(self, logs: int = 0, rows: int = 0) -> None:
        """Tell that so many more are done."""
        at = self._progress
        at = replace(at, logs_done=at.logs_done + logs, rows_done=at.rows_done + rows, lost=self._workers.lost)
        self._progress = at
        if self._tell is not None:
            self._tell(self._progress)

    def _done(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Receipt]]:
        """The receipts of tasks as they come. A task at which workers died beside others is tried once more, alone."""
        waiting, suspects, flying = deque(tasks), deque[Task](), dict[Future[Receipt], Task]()
        self._said()
        try:
            while waiting or suspects or flying:
                source, at_once = (waiting, self._workers.threads()) if waiting or flying else (suspects, 1)
                while source and len(flying) < at_once:
                    task = self._workers.next(source)
                    if identity(task.log.place) not in self._lost:
                        flying[self._workers.give(task)] = task
                finished, _ = wait(flying, TICK_S, FIRST_COMPLETED)
                self._said()
                if any(future.cancelled() for future in finished):  # who had them all is gone
                    given_up = [future for future in flying if future.cancelled() or not future.done()]
                    waiting.extendleft(flying.pop(future) for future in given_up)
                    self._come_back()
                    continue
                for future in finished:
                    task = flying.pop(future)
                    try:
                        yield task, self._received(future, task)
                    except WorkerDiedError as error:
                        if error.alone:
                            self._lost[identity(task.log.place)] = error
                        else:
                            suspects.append(task)
        except TaskFailedError:
            wait(flying)  # what is running ends first
            raise
        finally:
            for future in flying:
                future.cancel()

    def _received(self, future: Future[Receipt], task: Task) -> Receipt:
        """Raises WorkerDiedError, CopemError, TaskFailedError; and what the executor raises."""
        try:
            receipt = future.result()
        except BrokenExecutor as error:
            why = f"a worker died, and its executor with it ({type(error).__name__})"
            raise CopemError(f"crew: {why}; {self._so_far}; the same command goes on") from None
        except Exception as error:
            if type(error).__name__ != "KilledWorker":  # of Dask, which need not be there
                raise
            deaths, last = error.allowed_failures + 1, error.last_worker.address  # type: ignore[attr-defined]
            raise WorkerDiedError(deaths, last, alone=True) from None
        self.peak_bytes = max(receipt.peak_bytes, self.peak_bytes)
        if receipt.failure is not None:
            pieces = "".join(f", runs {work.runs}: {', '.join(work.keys)}" for work in task.work)
            raise TaskFailedError(f"{task.log.place}{pieces}: on worker {receipt.host}:\n{receipt.failure}")
        return receipt

    def _come_back(self) -> None:
        """Raises CopemError where nobody does."""
        try:
            self._workers.come_back()
        except TimeoutError as error:
            raise CopemError(f"{error}; {self._so_far}; the same command goes on") from None
