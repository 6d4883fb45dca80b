"""Workers of Dask: on this machine, or behind a scheduler that is there already. Nothing is deployed.

Dask unpickles what it is sent, on both sides: a scheduler is trusted as one's own shell is.
"""

from __future__ import annotations

import json
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

from copem_replay.core.errors import CopemError, InputError
from copem_replay.core.remote import is_url
from copem_replay.pipeline.crew.crew import WorkerDiedError, Workers
from copem_replay.pipeline.crew.task import LogTask, Receipt, Task
from copem_replay.pipeline.crew.worker import differs, done
from copem_replay.pipeline.pieces import Pieces
from copem_replay.pipeline.recipe import fingerprint
from copem_replay.pipeline.store import store_at

MOST_DEATHS = 3
"""So many workers may die while they have a task, before it is what they die of (chosen)."""
WAIT_S = 600.0
"""So long a scheduler that has gone, or has no worker, is waited for (chosen: a machine is up again by then)."""
_ANSWERS_S = 10.0
_LOOKS = 1000
"""Among so many tasks one is looked for whose log a worker has in memory (chosen)."""
_STARTS_S = 60.0
"""So long a scheduler file is waited for: the line before may be starting it (chosen)."""
_KEEPS_MEMORY = {"MALLOC_MMAP_THRESHOLD_": 1 << 25, "MALLOC_TRIM_THRESHOLD_": 1 << 30}
"""For workers: as Dask has it what they free goes back to the system at once, and asking for it again was a
quarter of the time of a study with accuracy. It is read when a process starts, by glibc."""
_LOCAL = re.compile(r"local(:[1-9][0-9]{0,3})?")
_ADDRESS = re.compile(r"(tcp|tls)://[^/\s]+:[1-9][0-9]{0,4}")
_TLS = "DASK_DISTRIBUTED__COMM__TLS__"
_PROBE = "probe.txt"
_CLOSED = ("closing", "closed")
_GONE = (OSError, RuntimeError)
"""The scheduler does not answer (a TimeoutError is an OSError), or the client has closed itself for that."""


def check_address(address: str) -> None:
    """Raises InputError where an address is none, or Dask is not installed."""
    if not _LOCAL.fullmatch(address) and not _ADDRESS.fullmatch(address) and Path(address).suffix != ".json":
        expected = "local, local:N, tcp://HOST:PORT, tls://HOST:PORT or a scheduler file (.json)"
        raise InputError(f"--cluster: expected {expected}, found {address!r}")
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError("--cluster: Dask is not installed: pip install 'copem-replay[cluster]'") from None


class DaskWorkers(Workers):
    """The workers of a scheduler; `cores`: how many there are of `local`. `wait_s`: as WAIT_S says.

    Raises CopemError: no scheduler there, workers unlike this process, or that do not see the pieces.
    """

    def __init__(self, address: str, pieces: Pieces, cores: int, wait_s: float = WAIT_S) -> None:
        self.address, self._pieces, self._wait_s = address, pieces, wait_s
        self._given: dict[str, tuple[Future[Receipt], int]] = {}  # and how many pieces, by the keys of Dask
        self._unwanted: list[Any] = []
        self._deaths, self._beside = Counter[str](), set[str]()  # … while others of ours were there
        self._has, self._idle = dict[LogTask, str](), list[str]()  # who has which log in memory, and nothing to do
        self._threads, self._changed = 1, True
        logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # what matters is said in our own words
        self._cluster = _local(int(address.partition(":")[2] or cores)) if _LOCAL.fullmatch(address) else None
        try:
            answers_s = _STARTS_S if Path(address).suffix == ".json" else _ANSWERS_S
            self._client = self._connected(min(self._wait_s, answers_s))
        except (OSError, ValueError) as error:  # nobody there; no address in the file
            raise CopemError(f"--cluster: {address}: no scheduler answers there ({_in_a_line(error)})") from None
        try:
            self._begin(time.monotonic() + self._wait_s)
        except TimeoutError:
            self.close()
            raise CopemError(f"--cluster: {address}: there is no worker, after {self._wait_s:g} s") from None
        except BaseException:
            self.close()
            raise

    def threads(self) -> int:
        """How many tasks it does at once."""
        if self._client.status in _CLOSED:  # what it had may never be told of again
            for mine, _ in [*self._given.values()]:
                _given_up(mine)
        if self._changed:
            self._changed = False
            with suppress(*_GONE):  # futures say so
                self._threads = max(sum(self._client.nthreads().values()), 1)
        return self._threads

    def next(self, tasks: deque[Task]) -> Task:
        """Take out the first task whose log is in memory of a worker that has just become idle; else the first.

        Dask gives it to that worker, for the others are busy. Asking for a worker by name is worse: a task that is to
        be done by one that has died, or by any other, waits for ever where for a moment there was no worker at all.
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
        mine: Future[Receipt] = Future()
        key = f"copem-{secrets.token_hex(8)}"
        self._given[key] = mine, len(task.keys)
        try:
            given = self._client.submit(_done_at, task, key=key, pure=False)
            given.add_done_callback(lambda _: self._landed(task, given, mine))
        except Exception:
            if self._client.status not in _CLOSED:
                raise
            del self._given[key]
            _given_up(mine)
            return mine
        mine.add_done_callback(lambda _: self._let_go(key, given))
        return mine

    def come_back(self) -> None:
        """Wait for the scheduler and a worker. Raises TimeoutError; CopemError as at the beginning."""
        until_s = time.monotonic() + self._wait_s
        while time.monotonic() < until_s:
            with suppress(*_GONE):
                self._client.close(timeout=1)
            with suppress(OSError):  # which a TimeoutError is
                self._client = self._connected(until_s - time.monotonic())
                self._begin(until_s)
                return
        raise TimeoutError(f"{self.address}: the scheduler has not answered for {self._wait_s:g} s")

    def close(self) -> None:
        """Cancel what has not begun, and end what was begun here."""
        with suppress(*_GONE):
            self._forget()
            self._client.close(timeout=1)
        if self._cluster is not None:
            with suppress(*_GONE):
                self._cluster.close(timeout=10)

    def _forget(self) -> None:
        """Tell Dask of the tasks that nobody waits for any more."""
        while self._unwanted:
            with suppress(Exception):  # a client that has closed itself has no tasks, and errors of its own
                self._unwanted.pop().cancel()

    def _connected(self, timeout_s: float) -> Any:
        """Raises OSError: nobody answers; InputError: tls:// without certificates."""
        import distributed

        where = self._cluster or self.address
        if Path(self.address).suffix == ".json":
            until_s = time.monotonic() + timeout_s
            where = _address_in(Path(self.address), until_s)
            timeout_s = max(until_s - time.monotonic(), 1)
        if f"{where}".startswith("tls://"):
            _check_certificates(self.address)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of versions, which are compared more closely
            return distributed.Client(where, timeout=timeout_s, set_as_default=False)

    def _begin(self, until_s: float) -> None:
        """Wait for a worker, and look at all there are. Raises TimeoutError, CopemError."""
        self._client.wait_for_workers(1, timeout=max(until_s - time.monotonic(), 1))
        self._client.subscribe_topic("all", self._event)
        self._changed = True
        token = secrets.token_hex(8)
        self._pieces.store.write(_PROBE, token.encode())
        folder = str(Path.cwd())
        found = self._client.run(greeting, fingerprint(), self._pieces.address, folder, token, on_error="return")
        there = {worker: said for worker, said in found.items() if not isinstance(said, OSError)}  # others have died
        unlike = [words for worker, said in there.items() if (words := _unlike(worker, said))]
        if unlike:
            many = f"({len(unlike)} of {len(there)} workers differ): results would not be the same bits"
            raise CopemError(f"{self.address}: worker {unlike[0]} {many}")
        for host, _, sees in there.values():
            if not sees:
                out = "--pieces with a shared folder or s3://…"
                raise CopemError(f"{self._pieces.store.where}: not visible from worker {host}; {out}")

    def _event(self, event: tuple[float, dict[str, Any]]) -> None:
        """What the scheduler tells of workers; called where the client listens."""
        _, said = event
        self._changed |= said.get("action") in ("add-worker", "remove-worker")
        if said.get("action") != "remove-worker" or said.get("expected"):
            return
        keys = [key for key in said["processing-tasks"] if key in self._given]
        self.lost += 1
        for key in keys:
            mine, pieces = self._given[key]
            self.again += pieces
            self._deaths[key] += 1
            self._beside |= {key} if len(keys) > 1 else set()
            if self._deaths[key] >= MOST_DEATHS:
                host, alone = said["worker"].partition("://")[2], key not in self._beside
                with suppress(InvalidStateError):
                    mine.set_exception(WorkerDiedError(self._deaths[key], host, alone=alone))

    def _landed(self, task: Task, given: Any, mine: Future[Receipt]) -> None:
        """Hand over what became of a task."""
        with suppress(InvalidStateError):  # it is not wanted any more
            try:
                at, receipt = given.result()
                self._has[task.log] = at
                self._idle.append(at)
                mine.set_result(receipt)
            except (CancelledError, *_GONE) as error:
                if isinstance(error, RuntimeError) and given.status == "error":  # of the worker, not of a closed client
                    mine.set_exception(error)
                _given_up(mine)
            except Exception as error:
                mine.set_exception(error)

    def _let_go(self, key: str, given: Any) -> None:
        """A task that is done, or not wanted any more. In whatever thread: Dask is told later."""
        del self._given[key]
        self._unwanted.append(given)


def _done_at(task: Task) -> tuple[str, Receipt]:
    """What a worker answers, and which worker it is."""
    from distributed import get_worker

    return get_worker().address, done(task)


def _given_up(mine: Future[Receipt]) -> None:
    """As who had it is gone."""
    if mine.cancel():
        mine.set_running_or_notify_cancel()


def greeting(expected: dict[str, str], pieces: str, folder: str, token: str) -> tuple[str, str | None, bool]:
    """Of a worker: its host, in what it differs, whether it sees in the pieces what was written there."""
    host, other = platform.node(), differs(expected)
    try:
        os.chdir(folder)
        sees = is_url(pieces) or Path(pieces).is_dir()  # not to be made there
        return host, other, sees and store_at(pieces).read(_PROBE) == token.encode()
    except (OSError, CopemError):
        return host, other, False


def _unlike(worker: str, said: tuple[str, str | None, bool] | Exception) -> str:
    """In what a worker differs, in words; empty: in nothing."""
    if isinstance(said, Exception):  # it has not even the same modules
        return f"{worker} has no such copem-replay as here ({_in_a_line(said)})"
    return f"{said[0]} {said[1]}" if said[1] else ""


def _address_in(file: Path, until_s: float) -> str:
    """The address in a scheduler file, when it is written. Raises TimeoutError."""
    while True:
        with suppress(OSError, ValueError, KeyError, TypeError):
            return str(json.loads(file.read_bytes())["address"])
        if time.monotonic() > until_s:
            raise TimeoutError("expected the file of `dask scheduler --scheduler-file`, found none")
        time.sleep(0.1)


def _check_certificates(address: str) -> None:
    """Raises InputError where there are none for tls://: a client that cannot begin ends 20 s later in a traceback."""
    import distributed

    try:
        there = distributed.Security().get_connection_args("client")["ssl_context"]
        found = "none" if there is None else ""
    except OSError as error:  # no such file, or not a certificate with its key (ssl.SSLError)
        found = _in_a_line(error)
    if found:
        out = f"set {_TLS}CA_FILE and {_TLS}CLIENT__CERT"
        raise InputError(f"--cluster: {address}: expected certificates in Dask's settings, found {found}; {out}")


def _local(count: int) -> Any:
    """Workers on this machine, a process each, that nobody else is told of."""
    import dask
    import distributed

    # A worker that dies again while it starts is started again, however long that takes.
    dask.config.set({"distributed.deploy.lost-worker-timeout": "365 days"})
    dask.config.set({f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in _KEEPS_MEMORY.items()})
    # Without a dashboard the scheduler still listens for requests about its health; at any port, for 8787 may be taken.
    return distributed.LocalCluster(
        n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address="127.0.0.1:0",
        memory_limit=None, silence_logs=logging.CRITICAL + 1,
        scheduler_kwargs={"allowed_failures": 1000, "dashboard": False},
    )  # fmt: skip


def _in_a_line(error: Exception) -> str:
    return " ".join(f"{error}".split())[:200] or type(error).__name__
