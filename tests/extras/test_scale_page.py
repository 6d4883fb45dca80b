"""What docs/guide/scale.md says to type: each command as it stands there, on this machine alone."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import distributed
import pytest
from distributed.cli import dask_worker

from copem_replay.cli import main as cli
from copem_replay.extras.cluster import dask_workers
from tests.cli.test_api import cr
from tests.helpers.experiments import changed, drive, files
from tests.helpers.page import blocks, spans
from tests.viewer.test_rrd import rerun

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/guide/scale.md"
BIN = Path(sys.executable).parent
MARKS = ("out/study.pieces", "s3://", "--cluster local", "tcp://", "srun", "tls://")
"""What tells the blocks apart. That of s3:// is run by test_object_storage_page.py, the others are run here."""
IN_A_LINE = ("cr.run(", "pip install ", "python tools/bench.py ", "rm -r ")
NO_COMMANDS = ("--pieces FOLDER", "Client.get_executor()", "cr.load_results(", "each(", "interrupted; ", "logs: [")


COMPUTED = "pieces: 6 computed, 0 found in {}/study.pieces"


def block(mark: str) -> str:
    (found,) = [one for one in blocks(PAGE) if mark in one]
    return found


def in_a_line(begin: str) -> list[str]:
    return sorted({span for span in spans(PAGE) if span.startswith(begin)})


def test_every_command_of_the_page_is_known_here() -> None:
    assert [[mark for mark in MARKS if mark in one] for one in blocks(PAGE)] == [[mark] for mark in MARKS]
    assert [span for span in spans(PAGE) if not span.startswith(IN_A_LINE + NO_COMMANDS)] == []


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A study of two names of a drive, its results, and two cores: as many workers."""
    monkeypatch.chdir(tmp_path)
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(cores)[:2])
    drive(tmp_path / "drives/a.mcap")
    (tmp_path / "drives/b.mcap").hardlink_to("drives/a.mcap")
    (tmp_path / "study.yaml").write_text(changed("logs: [drives/**/*.mcap]"))
    cr.run("study.yaml").save("out/plain")
    yield tmp_path
    os.sched_setaffinity(0, cores)


def typed(text: str, here: Path) -> str:
    """What commands say on stderr. All that they have begun ends with them; packages are those that are there."""
    environment = os.environ | {"PATH": f"{here / 'bin'}:{BIN}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    environment |= {"PIP_NO_INDEX": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    said = here / "said"
    with said.open("w") as file:
        process = subprocess.Popen(
            ["bash", "-euc", text], env=environment, stdout=subprocess.DEVNULL, stderr=file, start_new_session=True
        )
    try:
        assert process.wait(timeout=100) == 0, said.read_text()
    finally:
        with suppress(ProcessLookupError):  # nothing is left
            os.killpg(process.pid, signal.SIGKILL)
    return said.read_text()


def test_parts_are_found_again_and_removed(here: Path) -> None:
    """In Python, too, by executors of both kinds that the page names."""
    assert COMPUTED.format("out") in typed(block("out/study.pieces"), here)
    assert files("out/study") == files("out/plain")
    alone, crewed = in_a_line("cr.run(")
    found = eval(alone, {"cr": cr})
    found.save("out/alone")
    assert (found.study.logs[0].parts.computed, files("out/alone")) == (0, files("out/plain"))
    (remove,) = in_a_line("rm -r ")
    typed(remove, here)
    assert not Path("out/study.pieces").exists()
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        eval(crewed, {"cr": cr, "executor": pool}).save("out/pool")
    assert files("out/pool") == files("out/plain")
    cluster = dask_workers._start_local(1)
    client = distributed.Client(cluster)
    typed(remove.replace("out/", ""), here)
    eval(crewed, {"cr": cr, "executor": client.get_executor()}).save("out/dask")
    client.close()
    cluster.close()
    assert files("out/dask") == files("out/plain")


@pytest.mark.parametrize(("more", "processes"), [("", 2), (":1", 1), (":3", 3)], ids=["local", "local:1", "local:3"])
def test_as_many_processes_as_are_said(
    more: str, processes: int, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One per core as the page has it. What is shown is the same, too."""
    Path("study.yaml").write_text(changed("logs: [drives/**/*.mcap]", "show: {run: worst, logs: [b]}"))
    cr.run("study.yaml").save("out/shown")
    _, command = block("--cluster local").splitlines()
    monkeypatch.setattr("sys.argv", shlex.split(command + more))
    begun, local = [], dask_workers._start_local
    monkeypatch.setattr(dask_workers, "_start_local", lambda workers: begun.append(workers) or local(workers))
    assert cli._run_to_exit_code() == 0
    assert begun == [processes]
    assert COMPUTED.format("out") in capsys.readouterr().err.splitlines()
    found, expected = files("out/study"), files("out/shown")
    (shown,) = [name for name in expected if name.endswith(".rrd")]
    assert rerun("rrd", "compare", "--unordered", f"out/study/{shown}", f"out/shown/{shown}").returncode == 0
    differ = {shown, "made.jsonl"}  # which has its seal
    assert found.keys() == expected.keys()
    assert all(found[name] == expected[name] for name in expected.keys() - differ)


def test_packages_are_those_of_the_project(here: Path) -> None:
    install, _ = block("--cluster local").splitlines()
    for command in {install, *in_a_line("pip install ")}:
        assert "does not provide" not in typed(command, here)


@pytest.mark.parametrize("mark", ["tcp://", "srun", "tls://"])
def test_other_machines(mark: str, here: Path) -> None:
    """All of them are this one: what listens does so at 127.0.0.1 and a port that is free, `srun` runs its words."""
    (here / "shared").mkdir()
    certificate(here / "shared/study.pem")
    if mark == "srun":  # of a job before, which workers would go by
        Path("scheduler.json").write_text('{"address": "tcp://127.0.0.1:1"}')
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    stand_in(here / "bin/srun", 'exec "$@"')
    scheduler = f'if [ "$1" = scheduler ]; then [ ! -e scheduler.json ] || exit; set -- "$@" --port {port}; fi'
    stand_in(here / "bin/dask", f'{scheduler}\nexec "{BIN}/dask" "$@" --host 127.0.0.1 --no-dashboard')
    text = block(mark).replace("192.168.0.10:8786", f"127.0.0.1:{port}").replace("/shared/", f"{here}/shared/")
    said = typed(re.sub(r"^(dask [^#&\n]*)(#.*)?$", r"\1 &", text, flags=re.MULTILINE), here)
    assert COMPUTED.format(here / "shared") in said.splitlines()
    assert said.count("Registered to:") == said.count("Start worker at:") == 2
    assert (said.count("tls://127.0.0.1") > 0) == (mark == "tls://")
    assert files("out/study") == files("out/plain")


def stand_in(path: Path, lines: str) -> None:
    """A program that is found before the one of that name."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#!/bin/sh\n{lines}\n")
    path.chmod(0o755)


def certificate(path: Path) -> None:
    """One that signs itself, and its key."""
    made = distributed.Security.temporary()
    path.write_text(made.tls_client_key + made.tls_client_cert)


def test_a_worker_of_the_page_is_a_process_of_one_thread_per_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """On eight cores, where Dask's `auto` makes four processes of two threads."""
    monkeypatch.setattr(dask_worker, "CPU_COUNT", 8)
    monkeypatch.setattr(distributed.deploy.utils, "CPU_COUNT", 8)
    commands = [line for one in blocks(PAGE) for line in one.splitlines() if "dask worker " in line]
    assert len(commands) == 3
    for command in commands:
        threads: list[int] = []

        def begin(*given: Any, nthreads: int, begun: list[int] = threads, **keys: Any) -> None:
            begun.append(nthreads)
            if len(begun) == 8:
                raise InterruptedError

        monkeypatch.setattr(dask_worker, "Nanny", begin)
        words = shlex.split(command.partition("dask worker ")[2].rstrip("& "), comments=True)
        with pytest.raises(InterruptedError):
            dask_worker.main.main(words, standalone_mode=False)
        assert threads == [1] * 8


def test_benchmarks_of_the_page(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Each prints what the page says that it tells; of fewer rows, and without the time that commands take."""
    monkeypatch.syspath_prepend(ROOT / "tools")
    bench, common, compare = (importlib.import_module(n) for n in ("bench", "benches.common", "benches.compare"))
    monkeypatch.setattr(compare, "RUNS", 5)
    monkeypatch.setattr(common, "spent", lambda *command, **how: common.Spent(1.0, 2.0, 3))
    monkeypatch.setenv("COPEM_REPLAY_DATA", "nowhere")
    for command in in_a_line("python tools/bench.py "):
        bench.main(["--alone", command.split()[-1]])
    printed = {key for line in capsys.readouterr().out.splitlines() for key in json.loads(line)}
    assert printed >= {"pieces_overhead", "resume_cpu_s", "compare_peak_ratio", "crew"}
