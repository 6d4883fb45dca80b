"""Schedulers and workers as users start them, on 127.0.0.1, and what becomes of them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from copem_replay.core.errors import CopemError
from copem_replay.extras.cluster.dask_workers import connect_workers
from copem_replay.pipeline.parts import PartCache
from tests.cli.test_api import cr
from tests.extras.test_crew import at_45_m_and_a_half
from tests.helpers.experiments import changed, drive, files

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "a.mcap")
    for name in "bcdef":
        (tmp_path / f"{name}.mcap").hardlink_to("a.mcap")
    (tmp_path / "e.yaml").write_text(changed("logs: ['*.mcap']"))
    return tmp_path


@pytest.fixture
def start(here: Path) -> Iterator[Start]:
    """Starts a command, in a group of its own, that is ended with the test."""
    begun: list[subprocess.Popen[str]] = []

    def started(command: str) -> subprocess.Popen[str]:
        program, *words = command.split()
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        begun.append(
            subprocess.Popen(
                [str(BIN / program), *words], cwd=here, env=environment, text=True, start_new_session=True,
                stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored in the background
            )
        )  # fmt: skip
        return begun[-1]

    yield started
    for process in begun:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def scheduler(start: Start, port: int = 0) -> tuple[subprocess.Popen[str], str]:
    """A scheduler that writes `scheduler.json`, and its address."""
    command = f"dask scheduler --host 127.0.0.1 --port {port} --no-dashboard --scheduler-file scheduler.json"
    process = start(command)
    assert process.stderr is not None
    found = (re.search(r"Scheduler at: +(tcp://[0-9.:]+)", line) for line in process.stderr)
    return process, next(one[1] for one in found if one is not None)


def test_a_scheduler_that_is_killed_ends_the_command_and_a_new_one_goes_on(here: Path, start: Start) -> None:
    cr.run("e.yaml").save("plain")
    first, address = scheduler(start)
    start(f"dask worker {address} --nworkers 1 --nthreads 1 --host 127.0.0.1 --no-dashboard")

    def kill(done: int, total: int) -> None:
        if done and first.poll() is None:
            os.killpg(first.pid, signal.SIGKILL)
            first.wait()

    words = r"^crew: the .*scheduler is gone; [1-5] of 6 logs are in kept; the same command goes on$"
    with connect_workers(address, PartCache("kept"), 0) as workers:
        workers._client._timeout = 0.5  # type: ignore[attr-defined]  # so long it looks for it
        with pytest.raises(CopemError, match=words):
            cr.run("e.yaml", pieces="kept", crew=workers, progress=kill)
    _, address = scheduler(start)
    start(f"dask worker {address} --nworkers 1 --nthreads 1 --host 127.0.0.1 --no-dashboard")
    with connect_workers(address, PartCache("kept"), 0) as workers:
        cr.run("e.yaml", pieces="kept", crew=workers).save("out")
    assert files("out") == files("plain")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_ends_all_and_says_what_is_done(number: int, code: int, here: Path, start: Start) -> None:
    """A signal to the group, as a terminal sends it, while a worker is busy."""
    for name in ("said", "go_on"):
        os.mkfifo(name)
    model = "{kind: 'tests.helpers.bad_models:Halting', said: said, go_on: go_on, range_m: 60}"
    text = Path("e.yaml").read_text().replace("{kind: constant, probability: 0.5}", model)
    Path("e.yaml").write_text(text)
    command = start("copem-replay run e.yaml --cluster local:1")
    with open("said", "rb") as file:
        assert file.read(1) == b"."
    mine = {*inodes(command.pid)}
    addresses = [address for address, inode in listening() if inode in mine]
    assert len(addresses) >= 2  # of the scheduler and of a worker
    assert {*addresses} == {"0100007F"}  # 127.0.0.1
    os.killpg(command.pid, number)
    _, said = command.communicate(timeout=60)  # until the last of its processes has closed the pipe
    assert command.returncode == code
    assert said == "interrupted; 0 of 6 logs are in out/e.pieces\n"


def test_a_command_that_is_killed_goes_on_with_what_is_missing(here: Path, start: Start) -> None:
    """Its one worker, which ends with it, has done the first of seven logs and halts in the second."""
    os.mkfifo("said")
    Path("e.yaml").write_text(at_45_m_and_a_half("HaltingFusion", said="said"))  # not in this process
    cr.run("e.yaml").save("out/plain")
    command = start("copem-replay run e.yaml --cluster local:1")
    with open("said", "rb") as file:
        assert file.read(1) == b"."
    command.kill()
    command.communicate(timeout=60)  # until its worker has closed the pipe
    assert len([*Path("out/e.pieces/parts").glob("*/[!.]*.arrows")]) == 3
    result = cr.run("e.yaml", pieces="out/e.pieces")
    result.save("out/again")
    parts = result.study.logs[0].parts
    assert parts is not None
    assert (parts.computed, parts.found) == (18, 3)
    assert files("out/again") == files("out/plain")


def inodes(leader: int) -> Iterator[str]:
    """Of the sockets of all processes of a session."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if os.getsid(int(process.name)) == leader:
                for fd in (process / "fd").iterdir():
                    yield from re.findall(r"^socket:\[(\d+)\]$", os.readlink(fd))
        except OSError:  # it has ended
            continue


def listening() -> list[tuple[str, str]]:
    """Address, in hexadecimal digits, and inode of each socket that listens."""
    found = []
    for table in ("tcp", "tcp6"):
        rows = [line.split() for line in Path("/proc/net", table).read_text().splitlines()[1:]]
        found += [(row[1].partition(":")[0], row[9]) for row in rows if row[3] == "0A"]
    return found
