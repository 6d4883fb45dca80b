"""Dask workers: on this machine, or of a scheduler that already runs. Nothing is deployed.

Dask unpickles what it is sent, on both sides: a scheduler has to be trusted like a shell.
"""

from __future__ import annotations

import logging
import os
import platform
import re
import secrets
import time
import warnings
from collections import Counter, deque
from concurrent.futures import CancelledError, Future, InvalidStateError
from contextlib import suppress
from pathlib import Path
from typing import Any

from copem_replay.core.errors import CopemError, InputError, is_url
from copem_replay.core.files import parse_json
from copem_replay.pipeline.crew import WorkerDiedError, Workers
from copem_replay.pipeline.pieces import PieceCache, open_store, take_fingerprint
from copem_replay.pipeline.worker import LogTask, Receipt, Task, describe_mismatch, do_task

MOST_DEATHS = 3
"""Workers that die while they have a task until it counts as the cause: one or two may die by chance."""
WAIT_S = 600.0
"""Seconds to wait for a scheduler that is gone or has no worker: a machine that restarts is up again by then."""
_ANSWERS_S = 10.0
"""Seconds to wait for a scheduler at the beginning: Dask's own default is 30, a wrong address is found out sooner."""
_FETCHES_S = 60.0
"""Seconds to wait for a receipt, a few hundred bytes. Where its client closes meanwhile Dask waits without end, and
with it all later receipts: one thread hands them over."""
_LOOKS = 1000
"""Tasks that are searched for one whose log a worker has in memory. More take longer; no result depends on it."""
_STARTS_S = 60.0
"""Seconds to wait for a scheduler file: the line before in a script may just have started the scheduler."""
_KEEPS_MEMORY = {"MALLOC_MMAP_THRESHOLD_": 1 << 25, "MALLOC_TRIM_THRESHOLD_": 1 << 30}
"""Environment of local workers, which glibc reads when a process starts: by Dask's default freed memory goes back to
the system at once, and asking for it again was a quarter of the time of a study with accuracy."""
_LOCAL = re.compile(r"local(:[1-9][0-9]{0,3})?")
_ADDRESS = re.compile(r"(tcp|tls)://[^/\s]+:[1-9][0-9]{0,4}")
_TLS = "DASK_DISTRIBUTED__COMM__TLS__"
_PROBE = "probe.txt"
_CLOSED = ("closing", "closed")
_GONE = (OSError, RuntimeError)
"""What Dask raises if the scheduler does not answer (TimeoutError is an OSError), or the client has closed itself."""


def check_address(address: str) -> None:
    """Raises InputError where an address is not valid, or Dask is not installed."""
    if not _LOCAL.fullmatch(address) and not _ADDRESS.fullmatch(address) and Path(address).suffix != ".json":
        expected = "local, local:N, tcp://HOST:PORT, tls://HOST:PORT or a scheduler file (.json)"
        raise InputError(f"--cluster: expected {expected}, found {address!r}")
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError("--cluster: Dask is not installed: pip install 'copem-replay[cluster]'") from None


class DaskWorkers(Workers):
    """The workers of a scheduler. `cores`: how many `local` starts. `wait_s`: see WAIT_S.

    Raises CopemError: no scheduler answers, workers differ from this process, or workers do not see the pieces.
    """

    def __init__(self, address: str, pieces: PieceCache, cores: int, wait_s: float = WAIT_S) -> None:
        self.address, self._pieces, self._wait_s = address, pieces, wait_s
        self._given: dict[str, tuple[Future[Receipt], int]] = {}  # by Dask's key, with the number of pieces
        self._unwanted: list[Any] = []
        self._deaths, self._beside = Counter[str](), set[str]()  # deaths by key; keys that died beside others
        self._has, self._idle = dict[LogTask, str](), list[str]()  # worker that has a log in memory; idle workers
        self._threads, self._changed = 1, True
        logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # messages of this class take its place
        self._cluster = _start_local(int(address.partition(":")[2] or cores)) if _LOCAL.fullmatch(address) else None
        try:
            answers_s = _STARTS_S if Path(address).suffix == ".json" else _ANSWERS_S
            self._client = self._connect(min(self._wait_s, answers_s))
        except (OSError, ValueError) as error:  # no answer; no address in the file
            raise CopemError(f"--cluster: {address}: no scheduler answers there ({_format_error(error)})") from None
        try:
            self._begin(time.monotonic() + self._wait_s)
        except TimeoutError:
            self.close()
            raise CopemError(f"--cluster: {address}: there is no worker, after {self._wait_s:g} s") from None
        except BaseException:
            self.close()
            raise

    def threads(self) -> int:
        """How many tasks run at once."""
        if self._client.status in _CLOSED:  # a closed client reports no task's end
            for future, _ in [*self._given.values()]:
                _give_up(future)
        if self._changed:
            self._changed = False
            with suppress(*_GONE):  # futures report a lost scheduler
                self._threads = max(sum(self._client.nthreads().values()), 1)
        return self._threads

    def next(self, tasks: deque[Task]) -> Task:
        """Take out the first task whose log is in memory of a worker that has just become idle; else the first.

        Dask gives it to that worker, as the others are busy. Naming a worker is worse: a task for a worker that has
        died, "or any other", waits for ever where for a moment there was no worker at all.
        """
        while self._idle:
            idle = self._idle.pop()
            for k, task in zip(range(_LOOKS), tasks, strict=False):
                if self._has.get(task.log) == idle:
                    del tasks[k]
                    return task
        return tasks.popleft()

    def give(self, task: Task) -> Future[Receipt]:
        """Submit a task."""
        self._forget()
        future: Future[Receipt] = Future()
        key = f"copem-{secrets.token_hex(8)}"
        self._given[key] = future, len(task.keys)
        try:
            client = self._client
            given = client.submit(_do_at_worker, task, key=key, pure=False)
            given.add_done_callback(lambda _: self._landed(task, given, future, client))
        except Exception:
            if self._client.status not in _CLOSED:
                raise
            del self._given[key]
            _give_up(future)
            return future
        future.add_done_callback(lambda _: self._let_go(key, given))
        return future

    def come_back(self) -> None:
        """Wait for the scheduler and a worker. Raises TimeoutError; CopemError as at the beginning."""
        until_s = time.monotonic() + self._wait_s
        while time.monotonic() < until_s:
            with suppress(*_GONE):
                self._client.close(timeout=1)
            with suppress(OSError):  # which a TimeoutError is
                self._client = self._connect(until_s - time.monotonic())
                self._begin(until_s)
                return
        raise TimeoutError(f"{self.address}: the scheduler has not answered for {self._wait_s:g} s")

    def close(self) -> None:
        """Cancel tasks that have not begun, and end local workers."""
        with suppress(*_GONE):
            self._forget()
            self._client.close(timeout=1)
        if self._cluster is not None:
            with suppress(*_GONE):
                self._cluster.close(timeout=10)

    def _forget(self) -> None:
        """Cancel at Dask the tasks that are not wanted any more."""
        while self._unwanted:
            with suppress(Exception):  # a client that has closed itself has no tasks, and errors of its own
                self._unwanted.pop().cancel()

    def _connect(self, timeout_s: float) -> Any:
        """A client of the scheduler. Raises OSError: no answer; InputError: tls:// without certificates."""
        import distributed

        where = self._cluster or self.address
        if Path(self.address).suffix == ".json":
            until_s = time.monotonic() + timeout_s
            where = _read_address(Path(self.address), until_s)
            timeout_s = max(until_s - time.monotonic(), 1)
        if f"{where}".startswith("tls://"):
            _check_certificates(self.address)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about versions, which `_begin` compares more closely
            return distributed.Client(where, timeout=timeout_s, set_as_default=False)

    def _begin(self, until_s: float) -> None:
        """Wait for a worker, and check all workers. Raises TimeoutError, CopemError."""
        self._client.wait_for_workers(1, timeout=max(until_s - time.monotonic(), 1))
        self._client.subscribe_topic("all", self._event)
        self._changed = True
        token = secrets.token_hex(8)
        self._pieces.store.write(_PROBE, token.encode())
        folder = str(Path.cwd())
        greetings = self._client.run(
            greet_worker, take_fingerprint(), self._pieces.address, folder, token, on_error="return"
        )
        alive = {worker: greeting for worker, greeting in greetings.items() if not isinstance(greeting, OSError)}
        unlike = [words for worker, greeting in alive.items() if (words := _describe_unlike(worker, greeting))]
        if unlike:
            many = f"({len(unlike)} of {len(alive)} workers differ): results would not be the same bits"
            raise CopemError(f"{self.address}: worker {unlike[0]} {many}")
        for host, _, sees in alive.values():
            if not sees:
                out = "--pieces with a shared folder or s3://…"
                raise CopemError(f"{self._pieces.store.where}: not visible from worker {host}; {out}")

    def _event(self, event: tuple[float, dict[str, Any]]) -> None:
        """Take in an event of the scheduler about workers; called in the client's thread."""
        _, news = event
        self._changed |= news.get("action") in ("add-worker", "remove-worker")
        if news.get("action") != "remove-worker" or news.get("expected"):
            return
        keys = [key for key in news["processing-tasks"] if key in self._given]
        self.lost += 1
        for key in keys:
            future, pieces = self._given[key]
            self.again += pieces
            self._deaths[key] += 1
            self._beside |= {key} if len(keys) > 1 else set()
            if self._deaths[key] >= MOST_DEATHS:
                host, alone = news["worker"].partition("://")[2], key not in self._beside
                with suppress(InvalidStateError):
                    future.set_exception(WorkerDiedError(self._deaths[key], host, alone=alone))

    def _landed(self, task: Task, given: Any, future: Future[Receipt], client: Any) -> None:
        """Hand over the result of a task."""
        with suppress(InvalidStateError):  # the task is not wanted any more
            try:
                if client.status in _CLOSED:
                    raise CancelledError
                worker, receipt = given.result(timeout=_FETCHES_S)
                self._has[task.log] = worker
                self._idle.append(worker)
                future.set_result(receipt)
            except (CancelledError, *_GONE) as error:
                if isinstance(error, RuntimeError) and given.status == "error":  # the worker's, not a closed client's
                    future.set_exception(error)
                _give_up(future)
            except Exception as error:
                future.set_exception(error)

    def _let_go(self, key: str, given: Any) -> None:
        """Drop a task that is done or not wanted any more. Called in any thread: Dask is told later."""
        del self._given[key]
        self._unwanted.append(given)


def _do_at_worker(task: Task) -> tuple[str, Receipt]:
    """The address of the worker, and its receipt."""
    from distributed import get_worker

    return get_worker().address, do_task(task)


def _give_up(future: Future[Receipt]) -> None:
    """Cancel a task whose scheduler is gone."""
    if not future.cancelled() and future.cancel():  # once: a future tells of its end one time
        future.set_running_or_notify_cancel()


def greet_worker(expected: dict[str, str], pieces: str, folder: str, token: str) -> tuple[str, str | None, bool]:
    """Called on a worker: its host, in what it differs (None: in nothing), and whether it sees the command's probe."""
    host, difference = platform.node(), describe_mismatch(expected)
    try:
        os.chdir(folder)
        sees = is_url(pieces) or Path(pieces).is_dir()  # the folder must not be made there
        return host, difference, sees and open_store(pieces).read(_PROBE) == token.encode()
    except (OSError, CopemError):
        return host, difference, False


def _describe_unlike(worker: str, greeting: tuple[str, str | None, bool] | Exception) -> str:
    """In what a worker differs, in words; empty: in nothing."""
    if isinstance(greeting, Exception):  # it does not even have the same modules
        return f"{worker} has no such copem-replay as here ({_format_error(greeting)})"
    return f"{greeting[0]} {greeting[1]}" if greeting[1] else ""


def _read_address(file: Path, until_s: float) -> str:
    """The address in a scheduler file, once it is written. Raises TimeoutError."""
    while True:
        with suppress(OSError, ValueError, KeyError, TypeError):
            return str(parse_json(file.read_bytes())["address"])
        if time.monotonic() > until_s:
            raise TimeoutError("expected the file of `dask scheduler --scheduler-file`, found none")
        time.sleep(0.1)


def _check_certificates(address: str) -> None:
    """Raises InputError where tls:// has no certificates: Dask's client would end 20 s later in a traceback."""
    import distributed

    try:
        context = distributed.Security().get_connection_args("client")["ssl_context"]
        found = "none" if context is None else ""
    except OSError as error:  # no such file, or not a certificate with its key (ssl.SSLError)
        found = _format_error(error)
    if found:
        out = f"set {_TLS}CA_FILE and {_TLS}CLIENT__CERT"
        raise InputError(f"--cluster: {address}: expected certificates in Dask's settings, found {found}; {out}")


def _start_local(count: int) -> Any:
    """Workers on this machine, a process each, that listen to this machine alone."""
    import dask
    import distributed

    # A worker that dies while it starts is started again, however long that takes.
    dask.config.set({"distributed.deploy.lost-worker-timeout": "365 days"})
    dask.config.set({f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in _KEEPS_MEMORY.items()})
    # Without a dashboard the scheduler still listens for requests about its health: at any port, as 8787 may be taken.
    return distributed.LocalCluster(
        n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address="127.0.0.1:0",
        memory_limit=None, silence_logs=logging.CRITICAL + 1,
        scheduler_kwargs={"allowed_failures": 1000, "dashboard": False},
    )  # fmt: skip


def _format_error(error: Exception) -> str:
    return " ".join(f"{error}".split())[:200] or type(error).__name__
