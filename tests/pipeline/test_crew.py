"""A crew: whoever computes the pieces, and whatever becomes of workers, results are the same bytes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from copem_replay.pipeline.crew import dask_workers
from copem_replay.pipeline.crew.dask_workers import DaskWorkers
from copem_replay.pipeline.pieces import Pieces
from tests.cli.test_api import cr
from tests.helpers.experiments import drive
from tests.pipeline.test_pieces import EXACT, FLEET, study

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
    made = dask_workers._local(3)
    yield made
    made.close()


@pytest.fixture
def connected(cluster: Any, here: Path) -> Iterator[Callable[..., DaskWorkers]]:
    """Connects to them, with pieces in a folder."""
    opened: list[DaskWorkers] = []

    def connect(kept: str = "kept", **keys: float) -> DaskWorkers:
        opened.append(DaskWorkers(cluster.scheduler_address, Pieces(kept), 0, **keys))
        return opened[-1]

    yield connect
    for one in opened:
        one.close()


def replayed(text: str, out: str, **keys: Any) -> tuple[dict[str, bytes], int, int]:
    """Files of the results, and how many pieces were computed and found."""
    Path("e.yaml").write_text(text)
    result = cr.run("e.yaml", **keys)
    result.save(out, overwrite=True)
    store = result.replayed.logs[0].pieces
    files = {str(p.relative_to(out)): p.read_bytes() for p in Path(out).rglob("*") if p.is_file()}
    return files, *((0, 0) if store is None else (store.computed, store.found))


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
def test_the_same_bytes_by_threads_and_processes_of_dask(text: str, connected: Callable[..., DaskWorkers]) -> None:
    plain, _, _ = replayed(text, "plain", jobs=2)
    _, computed, found = replayed(text, "threads", pieces="alone")
    assert found == 0
    assert replayed(text, "dask", pieces="kept", crew=connected()) == (plain, computed, 0)
    assert replayed(text, "again", pieces="kept", crew=connected()) == (plain, 0, computed)
    for path in sorted(Path("kept/pieces").rglob("*[0-9a-f].parquet"))[::3]:
        path.unlink()
    half, more, rest = replayed(text, "half", pieces="kept", crew=Shuffled())
    assert (half, more + rest) == (plain, computed)
    assert more == len(range(0, computed, 3))


def test_the_same_bytes_by_a_pool_of_processes(here: Path) -> None:
    plain, computed, _ = replayed(study(), "plain", pieces="alone")
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert replayed(study(), "pool", pieces="kept", crew=pool) == (plain, computed, 0)
