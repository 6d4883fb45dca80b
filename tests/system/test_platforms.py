"""Any platform: a system without what only Unix has runs the same and writes the same bytes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import copem_replay as cr
from copem_replay.core.files import portable_name
from copem_replay.results.table_files import table_file
from copem_replay.viewer.open import list_rrd_files, opening_s
from tests.helpers.experiments import changed, drive

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]

POOR = """
import importlib.abc, os, signal, sys
with __import__("contextlib").suppress(ImportError):
    import psutil  # which on this system needs what is taken away

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in ("fcntl", "resource", "msvcrt"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

for name in ("fcntl", "resource"):
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Absent())
for name in ("pwrite", "pread", "pathconf", "geteuid", "getuid", "sched_getaffinity", "O_NOFOLLOW", "O_NONBLOCK",
             "O_CLOEXEC"):
    delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "SIGUSR1"):
    delattr(signal, name)
"""
"""What a process does first that is to be poor; the tests beside this one say that it is."""


@pytest.fixture(scope="module")
def poor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which any Python that has it in its path is poor, as are the processes it starts."""
    place = tmp_path_factory.mktemp("poor")
    (place / "sitecustomize.py").write_text(POOR)
    return place


def call(here: Path, *words: object, poor: Path | None = None) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([*([str(poor)] if poor else []), str(ROOT)])
    code = "from copem_replay.cli.main import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        cwd=here, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip


def test_a_poor_process_is_poor(tmp_path: Path, poor: Path) -> None:
    code = "import os, signal\nassert not hasattr(os, 'pwrite') and not hasattr(signal, 'SIGHUP')\nimport fcntl\n"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(poor)}, capture_output=True, text=True
    )
    assert done.stderr.splitlines()[-1] == "ModuleNotFoundError: No module named 'fcntl'"


def test_the_sample_runs_and_gives_the_same_files(tmp_path: Path, poor: Path) -> None:
    """`samples`, `run` by two workers, `run --overwrite`, `compare`, `plot`, `report`; nothing is left."""
    assert call(tmp_path, "samples", "logs", poor=poor).returncode == 0
    run = ["run", "logs/tc016d.yaml", "--runs", "5", "--jobs", "2"]
    assert call(tmp_path, *run, "--out", "rich").returncode == 0
    for more in ([], ["--overwrite"]):
        done = call(tmp_path, *run, "--out", "poor", *more, poor=poor)
        assert done.returncode == 0, done.stderr
    for name in ("summary.csv", "detections.parquet", "provenance.json", "replay.mcap"):
        assert (tmp_path / "poor" / name).read_bytes() == (tmp_path / "rich" / name).read_bytes(), name
    commands = ("compare poor --baseline PEM", "plot poor", "report poor", "layout poor", "info logs/tc016d.mcap")
    for words in map(str.split, commands):
        done = call(tmp_path, *words, poor=poor)
        assert done.returncode == 0, (words, done.stderr)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["logs", "poor", "rich"]
    made = {path.name for path in (tmp_path / "poor").rglob("*")}
    assert {"report.html", "figures", "replay.foxglove.json"} <= made
    assert {portable_name(name) for name in made} == made  # of configurations called `coPEM:0s`


def test_logs_called_what_windows_refuses(tmp_path: Path) -> None:
    """Their recordings have other names, their tables too where each log has one, and `view` finds them."""
    for name in ("aux.mcap", "a:b.mcap", "usual.mcap"):
        drive(tmp_path / name)
    (tmp_path / "e.yaml").write_text(changed("logs: [aux.mcap, 'a:b.mcap', usual.mcap]", "show: {run: 0, logs: [all]}"))
    folder = cr.run(tmp_path / "e.yaml").save(tmp_path / "r")
    made = {path.name for path in (folder / "replay").iterdir() if path.suffix == ".rrd"}
    assert made == {"%61ux.rrd", "a%3Ab.rrd", "usual.rrd"}
    assert len(opening_s(folder, list_rrd_files(folder))) == 3
    assert [table_file(Path("t"), log).as_posix() for log in ("aux", "a:b", "usual", "com1.x")] == [
        "t/%61ux.parquet", "t/a%3Ab.parquet", "t/usual.parquet", "t/%63om1.x.parquet"
    ]  # fmt: skip
