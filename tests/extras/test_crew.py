"""A crew: whoever computes the pieces, and whatever becomes of workers, results are the same bytes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import dask
import distributed
import pandas as pd
import pytest

from copem_replay.cli import main as cli
from copem_replay.core.errors import CopemError, InputError
from copem_replay.extras.cluster import crew as crew_module
from copem_replay.extras.cluster import dask_workers
from copem_replay.extras.cluster.crew import TaskFailedError
from copem_replay.extras.cluster.dask_workers import connect_workers
from copem_replay.pipeline import run as gather
from copem_replay.pipeline.parts import FolderStore, PartCache
from tests.cli.test_api import cr
from tests.helpers.experiments import changed, drive, files
from tests.helpers.object_storage import Bucket
from tests.helpers.recordings import Obj, write_recording
from tests.pipeline.test_parts import EXACT, FLEET, study

OWN_SETTINGS = "logs: [a.mcap, {file: b.mcap, name: other, units: {mast: null}}]"
STUDIES = {
    "fusions": study(gnn=True),
    "exact and swept": study(EXACT, "sweep: {latency_s: [0, 0.3]}"),
    "fleet, swept": study(FLEET, "sweep: {penetration_rate: [0, 0.3]}", runs=70),
    "a log of its own": study(OWN_SETTINGS, "sweep: {rate_hz: [2, 5]}"),
}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        drive(tmp_path / f"{name}.mcap")
    return tmp_path


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Three workers on this machine, for all tests of this file."""
    made = dask_workers._start_local(3)
    yield made
    made.close()


@pytest.fixture
def connected(cluster: Any, here: Path) -> Iterator[Callable[..., Any]]:
    """Connects to them, with parts in a folder."""
    with ExitStack() as stack:

        def connect(kept: str = "kept", **keys: float) -> Any:
            return stack.enter_context(connect_workers(cluster.scheduler_address, PartCache(kept), 0, **keys))

        yield connect


def replayed(text: str, out: str, **keys: Any) -> tuple[dict[str, bytes], int, int]:
    """Files of the results, and how many parts were computed and found."""
    Path("e.yaml").write_text(text)
    result = cr.run("e.yaml", **keys)
    result.save(out, overwrite=True)
    store = result.study.logs[0].parts
    return files(out), *((0, 0) if store is None else (store.computed, store.found))


class Shuffled(Executor):
    """One thread, which does the youngest task first."""

    _max_workers = 4

    def __init__(self) -> None:
        self._waiting: list[tuple[Future[Any], Callable[[], Any]]] = []
        self._thread = ThreadPoolExecutor(1)

    def submit(self, do: Callable[..., Any], /, *given: Any, **keys: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self._waiting.append((future, lambda: do(*given)))
        self._thread.submit(self._next)
        return future

    def _next(self) -> None:
        future, work = self._waiting.pop()
        future.set_result(work())


@pytest.mark.parametrize("text", STUDIES.values(), ids=STUDIES.keys())
def test_the_same_bytes_by_threads_and_processes_of_dask(text: str, connected: Callable[..., Any]) -> None:
    plain, _, _ = replayed(text, "plain", jobs=2)
    _, computed, found = replayed(text, "threads", pieces="alone")
    assert found == 0
    assert replayed(text, "dask", pieces="kept", crew=connected()) == (plain, computed, 0)
    assert replayed(text, "again", pieces="kept", crew=connected()) == (plain, 0, computed)
    for path in sorted(Path("kept/parts").rglob("*.arrows"))[::3]:
        path.unlink()
    half, more, rest = replayed(text, "half", pieces="kept", crew=Shuffled())
    assert (half, more + rest) == (plain, computed)
    assert more == len(range(0, computed, 3))


def test_the_same_bytes_by_a_pool_of_processes(here: Path) -> None:
    plain, computed, _ = replayed(study(), "plain", pieces="alone")
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert replayed(study(), "pool", pieces="kept", crew=pool) == (plain, computed, 0)


def test_recordings_and_pieces_under_urls_by_a_pool_of_processes(here: Path, bucket: Bucket) -> None:
    bucket.put(Path("a.mcap"), "drives/a.mcap")
    bucket.put(Path("b.mcap"), "drives/b.mcap")
    text = study(f"logs: ['{bucket.url}/drives/*.mcap']", runs=70)
    plain, _, _ = replayed(text, "plain")
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        kept = f"{bucket.url}/kept"
        assert replayed(text, "pool", pieces=kept, crew=pool) == (plain, 2 * 3, 0)
        assert replayed(text, "again", pieces=kept, crew=pool) == (plain, 0, 2 * 3)


def many(count: int) -> None:
    """The recording `a` under so many more names."""
    for k in range(count):
        Path(f"name{k}.mcap").hardlink_to("a.mcap")


def at_45_m_and_a_half(kind: str, **keys: Any) -> str:
    """An experiment whose model does something in one log of many, but not to this process."""
    thing = Obj(id=3, x=0.0, y=45.5, stationary=True)
    frames = [(0.1 * k, [Obj(id=1, x=0.0), Obj(id=2, x=70.0 - k, vx=-10.0), thing]) for k in range(31)]
    write_recording(Path("at45.mcap"), frames, host=1)
    said = "".join(f", {name}: {value!r}" for name, value in keys.items())
    model = f"{{kind: 'tests.helpers.bad_models:{kind}', spare: {os.getpid()}{said}}}"
    text = changed("logs: ['*.mcap']")
    if kind.endswith("Fusion"):
        return text.replace("latency_s: 0.5", f"fusion: {model}")
    return text.replace("{kind: constant, probability: 0.5}", model)


@pytest.mark.long
def test_the_same_bytes_where_workers_are_killed(connected: Callable[..., Any]) -> None:
    many(10)
    text = study("logs: ['*.mcap']")
    plain, computed, _ = replayed(text, "plain", pieces="alone")
    workers, killed = connected(), list[int]()

    def kill(done: int, total: int) -> None:
        """One while logs are surveyed, the others when some rows are there."""
        pids = sorted(set(workers._client.run(os.getpid, on_error="ignore").values()) - {*killed})
        if len(killed) < 3 and pids and (not killed or done > 0):
            os.kill(pids[0], signal.SIGKILL)
            killed.append(pids[0])

    assert replayed(text, "dask", pieces="kept", crew=workers, progress=kill) == (plain, computed, 0)
    assert len(killed) == 3
    assert replayed(text, "again", pieces="kept") == (plain, 0, computed)


@pytest.mark.long
def test_a_log_that_workers_die_of_is_named_and_the_others_are_done(connected: Callable[..., Any]) -> None:
    text, workers = at_45_m_and_a_half("Deadly"), connected()
    where = r"died 3 times, last on 127.0.0.1:\d+ \(out of memory\?\); more memory per worker, or --skip-unreadable"
    wanted = rf"^at45.mcap: the worker that replayed it {where}; what is done stays done in kept$"
    with pytest.raises(InputError, match=wanted):
        replayed(text, "out", pieces="kept", crew=workers)
    assert workers.lost >= 3
    others = text.replace("'*.mcap'", "a.mcap, b.mcap")
    plain, _, _ = replayed(others, "plain")
    surveyed = len(list(Path("kept/logs").iterdir()))
    assert surveyed == 2
    assert replayed(others, "out", pieces="kept", crew=workers)[0] == plain
    assert len(list(Path("kept/logs").iterdir())) == surveyed


@pytest.mark.long
def test_a_log_that_workers_die_of_is_skipped_where_that_is_asked_for(
    cluster: Any, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Here they die when it is replayed, and have surveyed it before."""
    text = at_45_m_and_a_half("DeadlyFusion")
    plain, _, _ = replayed(text.replace("'*.mcap'", "a.mcap, b.mcap"), "plain")
    Path("e.yaml").write_text(text)
    command = f"copem-replay run e.yaml --skip-unreadable --out out --cluster {cluster.scheduler_address}"
    monkeypatch.setattr("sys.argv", command.split())
    assert cli._run_to_exit_code() == 1
    why = "the worker that replayed it died 3 times (out of memory?)"
    assert f"note: at45.mcap: skipped: {why}" in capsys.readouterr().err.splitlines()
    rows = pd.read_csv("out/logs.csv", keep_default_na=False)[["path", "state", "reason"]].to_numpy().tolist()
    assert rows == [["../a.mcap", "done", ""], ["../b.mcap", "done", ""], ["../at45.mcap", "skipped", why]]
    assert len(list(Path("out.pieces/logs").iterdir())) == 3
    found = files("out")
    assert {name for name in plain if found.pop(name) != plain[name]} == {"logs.csv", "provenance.json"}
    assert found == {}


def test_a_dead_pool_is_said_and_what_is_done_stays(here: Path) -> None:
    """A pool of processes breaks with its first dead one: no telling of what."""
    text = at_45_m_and_a_half("Deadly")
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        words = r"^crew: a worker died, and its executor with it \(BrokenProcessPool\); 0 of 3 logs are in kept; the"
        with pytest.raises(CopemError, match=words):
            replayed(text, "out", pieces="kept", crew=pool)


def test_parts_that_are_kept_elsewhere_are_missed(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crew_module, "_open_store", lambda *_: FolderStore(Path("elsewhere")))
    Path("e.yaml").write_text(study())
    cr.run("e.yaml", pieces="kept", recordings=["a.mcap"])  # so that this log is known
    with (
        ThreadPoolExecutor(1) as pool,
        pytest.raises(CopemError, match=r"^kept: what workers keep there is not seen fr"),
    ):
        replayed(study("seed: 2"), "out", pieces="kept", crew=pool)


def test_a_defect_is_told_once_with_its_log(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = []

    def fail(*given: Any) -> None:
        begun.append(given)
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(gather, "replay_outcomes", fail)
    with ThreadPoolExecutor(1) as pool, pytest.raises(TaskFailedError) as caught:
        replayed(study(), "out", pieces="kept", crew=pool)
    said = str(caught.value)
    assert said.startswith("a.mcap: on worker ")
    assert said.count("ZeroDivisionError: a defect") == 1
    assert len(begun) == 1  # and not tried again


def test_workers_that_differ_are_refused(
    connected: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, here: Path
) -> None:
    expected = dask_workers.take_fingerprint() | {"numba": "0.1.2"}
    monkeypatch.setattr(dask_workers, "take_fingerprint", lambda: expected)
    words = (
        r"^tcp://127.0.0.1:\d+: worker \S+ has numba \d[\d.]+, expected 0.1.2 \(\d of \d workers differ\): results wou"
    )
    with pytest.raises(CopemError, match=words):
        connected()
    made = [crew_module.take_fingerprint()] * 2  # by the command, for two tasks
    with ThreadPoolExecutor(1) as pool:  # which is asked with its first task
        monkeypatch.setattr(crew_module, "take_fingerprint", lambda: made.pop(0) if made else expected)
        with pytest.raises(
            CopemError, match=r"^worker \S+ has numba 0.1.2, expected \d\S+: results would not be the same"
        ):
            replayed(study(), "out", pieces="kept", crew=pool)


def test_parts_that_a_worker_does_not_see(connected: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the folder were on this machine alone: what is written is not where workers look."""
    monkeypatch.setattr(dask_workers, "greet_worker", _blind)
    words = r"^kept: not visible from worker \S+; --pieces with a shared folder or s3://…$"
    with pytest.raises(CopemError, match=words):
        connected()


def _blind(expected: dict[str, str], pieces: str, folder: str, token: str) -> tuple[str, str | None, bool]:
    return dask_workers.greet_worker(expected, f"{pieces} of another machine", folder, token)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        (
            "here",
            r"^--cluster: expected local, local:N, tcp://HOST:PORT, tls://HOST:PORT or .*\(.json\), found 'here'$",
        ),
        ("local:0", r"^--cluster: expected local"),
        ("tcp://", r"^--cluster: expected local"),
        ("tls://127.0.0.1:port", r"^--cluster: expected local"),
    ],
)
def test_addresses(address: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        dask_workers.check_address(address)


def test_a_scheduler_that_is_not_there(here: Path) -> None:
    with pytest.raises(CopemError, match=r"^--cluster: tcp://127.0.0.1:1: no scheduler answers there \("):
        ExitStack().enter_context(connect_workers("tcp://127.0.0.1:1", PartCache("kept"), 0, wait_s=0.1))


def test_a_scheduler_file_that_is_not_there_and_one_that_comes(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = (
        r"^--cluster: s.json: no scheduler answers there \(expected the file of `dask scheduler --scheduler-file`, fo"
    )
    with pytest.raises(CopemError, match=words):
        ExitStack().enter_context(connect_workers("s.json", PartCache("kept"), 0, wait_s=0))
    contents = ["", "{", '{"address": "tcp://127.0.0.1:1"}']
    monkeypatch.setattr(time, "sleep", lambda _: Path("s.json").write_text(contents.pop(0)))
    assert dask_workers._read_address(Path("s.json"), time.monotonic() + 60) == "tcp://127.0.0.1:1"


@pytest.mark.parametrize(
    ("authority", "own", "found"),
    [(None, None, "none"), ("own.pem", None, "none"), ("no.pem", "own.pem", "[Errno 2] No such file or directory")],
)
def test_certificates_that_are_not_there(
    authority: str | None,
    own: str | None,
    found: str,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Said at once; also where a scheduler file says so."""
    Path("e.yaml").write_text(study())
    Path("s.json").write_text('{"address": "tls://127.0.0.1:1"}')
    settings = {"distributed.comm.tls.ca-file": authority, "distributed.comm.tls.client.cert": own}
    out = "set DASK_DISTRIBUTED__COMM__TLS__CA_FILE and DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT"
    for address in ("tls://127.0.0.1:1", "s.json"):
        monkeypatch.setattr("sys.argv", f"copem-replay run e.yaml --cluster {address}".split())
        with dask.config.set(settings):
            assert cli._run_to_exit_code() == 2
        said = f"--cluster: {address}: expected certificates in Dask's settings, found {found}; {out}\n"
        assert capsys.readouterr().err == said


def test_a_client_that_has_closed_itself_is_said(connected: Callable[..., Any]) -> None:
    """As it does where the scheduler is gone for longer than it looks for it; the same command goes on."""
    plain, _, _ = replayed(study(), "plain", pieces="alone")
    workers = connected()

    def close(done: int, total: int) -> None:
        if done:
            workers._client.close()

    with pytest.raises(CopemError, match=r"^crew: the .*gone; [12] of 2 logs are in kept; the same command goes on$"):
        replayed(study(), "dask", pieces="kept", crew=workers, progress=close)
    assert replayed(study(), "again", pieces="kept", crew=connected())[0] == plain


@pytest.mark.parametrize("asked", ["submit", "nthreads"])
def test_a_client_that_closes_itself_while_it_is_asked_is_said(
    asked: str, connected: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Between a look at its state and the next task: the client has an error of its own for it."""
    workers = connected()
    client, ask = workers._client, getattr(workers._client, asked)

    def close_first(*given: Any, **keys: Any) -> Any:
        client.close()
        return ask(*given, **keys)

    monkeypatch.setattr(client, asked, close_first)
    with pytest.raises(
        CopemError, match=r"^crew: the scheduler is gone; 0 of 2 logs are in kept; the same command goe"
    ):
        replayed(study(), "dask", pieces="kept", crew=workers)
    assert "Traceback" not in caplog.text


@pytest.mark.parametrize("asked", ["wait_for_workers", "run", "subscribe_topic"])
def test_a_scheduler_that_goes_while_workers_are_greeted_is_said(
    asked: str, connected: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    ask = getattr(distributed.Client, asked)

    def close_first(client: Any, *given: Any, **keys: Any) -> Any:
        client.close()
        return ask(client, *given, **keys)

    monkeypatch.setattr(distributed.Client, asked, close_first)
    with pytest.raises(CopemError, match=r"^--cluster: tcp://127.0.0.1:\d+: its scheduler is gone$"):
        connected()


def test_what_a_crew_needs(here: Path) -> None:
    Path("e.yaml").write_text(study())
    with ThreadPoolExecutor(1) as pool:
        with pytest.raises(InputError, match=r"^crew: expected `pieces`, too: a folder or a URL that all its workers"):
            cr.run("e.yaml", crew=pool)
        with pytest.raises(InputError, match=r"^crew: expected paths of recordings"):
            cr.run("e.yaml", cr.read_recordings("e.yaml"), pieces="kept", crew=pool)
        Path("b.mcap").write_bytes(b"nothing")
        with pytest.raises(InputError, match=r"^b.mcap: expected an MCAP file") as caught:
            cr.run("e.yaml", pieces="kept", crew=pool)
        with pytest.raises(InputError) as alone:
            cr.run("e.yaml", pieces="other")
    assert caught.value.problems == alone.value.problems
