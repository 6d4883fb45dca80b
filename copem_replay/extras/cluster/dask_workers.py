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
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from copem_replay.core.errors import CopemError, InputError, is_url
from copem_replay.core.files import parse_json
from copem_replay.extras.cluster.crew import describe_mismatch
from copem_replay.pipeline.parts import PartCache, open_store, take_fingerprint

MOST_DEATHS = 3
"""Workers of `local` that die while they have a task until it counts as the cause: one or two may die by chance."""
WAIT_S = 600.0
"""Seconds to wait for a first worker: a machine that starts is up by then."""
_ANSWERS_S = 10.0
"""Seconds to wait for a scheduler: Dask's own default is 30, a wrong address is found out sooner."""
_STARTS_S = 60.0
"""Seconds to wait for a scheduler file: the line before in a script may just have started the scheduler."""
_KEEPS_MEMORY = {"MALLOC_MMAP_THRESHOLD_": 1 << 25, "MALLOC_TRIM_THRESHOLD_": 1 << 30}
"""Environment of local workers, which glibc reads when a process starts: by Dask's default freed memory goes back to
the system at once, and asking for it again was a quarter of the time of a study with accuracy."""
_LOCAL = re.compile(r"local(:[1-9][0-9]{0,3})?")
_ADDRESS = re.compile(r"(tcp|tls)://[^/\s]+:[1-9][0-9]{0,4}")
_TLS = "DASK_DISTRIBUTED__COMM__TLS__"
_PROBE = "probe.txt"


def check_address(address: str) -> None:
    """Raises InputError where an address is not valid, or Dask is not installed."""
    if not _LOCAL.fullmatch(address) and not _ADDRESS.fullmatch(address) and Path(address).suffix != ".json":
        expected = "local, local:N, tcp://HOST:PORT, tls://HOST:PORT or a scheduler file (.json)"
        raise InputError(f"--cluster: expected {expected}, found {address!r}")
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError("--cluster: Dask is not installed: pip install 'copem-replay[cluster]'") from None


@contextmanager
def connect_workers(address: str, parts: PartCache, cores: int, wait_s: float = WAIT_S) -> Iterator[Executor]:
    """The workers of a scheduler as an executor that counts those that die (`lost`), until the `with` block ends.

    `cores`: how many `local` starts. Raises CopemError: no scheduler answers, workers differ from this process, or do
    not see the parts.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # messages of this project take its place
    with ExitStack() as stack:
        where: Any = address
        if _LOCAL.fullmatch(address):
            where = _start_local(int(address.partition(":")[2] or cores))
            stack.callback(_close, where.close, 10)
        try:
            answers_s = _STARTS_S if Path(address).suffix == ".json" else _ANSWERS_S
            client = _connect(address, where, min(wait_s, answers_s))
        except (OSError, ValueError) as error:  # no answer; no address in the file
            raise CopemError(f"--cluster: {address}: no scheduler answers there ({_format_error(error)})") from None
        stack.callback(_close, client.close, 1)
        with _say_where_it_ends(client, address):
            try:
                client.wait_for_workers(1, timeout=max(wait_s, 1))
            except TimeoutError:
                raise CopemError(f"--cluster: {address}: there is no worker, after {wait_s:g} s") from None
            _check_workers(client, address, parts)
        executor = client.get_executor(pure=False)
        executor.lost = 0

        def count_lost(event: tuple[float, dict[str, Any]]) -> None:
            executor.lost += event[1].get("action") == "remove-worker" and not event[1].get("expected")

        with _say_where_it_ends(client, address):
            client.subscribe_topic("all", count_lost)
        yield executor


@contextmanager
def _say_where_it_ends(client: Any, address: str) -> Iterator[None]:
    """Raise CopemError in place of what a client raises that has closed itself: its scheduler is gone."""
    try:
        yield
    except Exception as error:
        if isinstance(error, CopemError) or client.status not in ("closing", "closed"):
            raise
        raise CopemError(f"--cluster: {address}: its scheduler is gone") from None


def _close(close: Callable[..., None], timeout_s: float) -> None:
    with suppress(OSError, RuntimeError):  # of a scheduler that is gone
        close(timeout=timeout_s)


def _connect(address: str, where: Any, timeout_s: float) -> Any:
    """A client of the scheduler at an address, or named in a .json file. Raises OSError: no answer; InputError."""
    import distributed

    if Path(address).suffix == ".json":
        until_s = time.monotonic() + timeout_s
        where = _read_address(Path(address), until_s)
        timeout_s = max(until_s - time.monotonic(), 1)
    if f"{where}".startswith("tls://"):
        _check_certificates(address)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about versions, which `_check_workers` compares more closely
        return distributed.Client(where, timeout=timeout_s, set_as_default=False)


def _check_workers(client: Any, address: str, parts: PartCache) -> None:
    """Raise CopemError where workers have other versions than this process, or do not see the parts."""
    token, folder = secrets.token_hex(8), str(Path.cwd())
    parts.store.write(_PROBE, token.encode())
    greetings = client.run(greet_worker, take_fingerprint(), parts.address, folder, token, on_error="return")
    alive = {worker: greeting for worker, greeting in greetings.items() if not isinstance(greeting, OSError)}
    differences = [words for worker, greeting in alive.items() if (words := _describe_unlike(worker, greeting))]
    if differences:
        consequence = f"({len(differences)} of {len(alive)} workers differ): results would not be the same bits"
        raise CopemError(f"{address}: worker {differences[0]} {consequence}")
    for host, _, sees in alive.values():
        if not sees:
            advice = "--pieces with a shared folder or s3://…"
            raise CopemError(f"{parts.store.where}: not visible from worker {host}; {advice}")


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
    """Raise InputError where tls:// has no certificates: Dask's client would end 20 s later in a traceback."""
    import distributed

    try:
        context = distributed.Security().get_connection_args("client")["ssl_context"]
        fault = "none" if context is None else ""
    except OSError as error:  # no such file, or not a certificate with its key (ssl.SSLError)
        fault = _format_error(error)
    if fault:
        advice = f"set {_TLS}CA_FILE and {_TLS}CLIENT__CERT"
        raise InputError(f"--cluster: {address}: expected certificates in Dask's settings, found {fault}; {advice}")


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
        scheduler_kwargs={"allowed_failures": MOST_DEATHS - 1, "dashboard": False},
    )  # fmt: skip


def _format_error(error: Exception) -> str:
    return " ".join(f"{error}".split())[:200] or type(error).__name__
