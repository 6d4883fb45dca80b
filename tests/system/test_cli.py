from __future__ import annotations

import csv
import errno
import io
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pytest

from copem_replay.cli import main as cli
from copem_replay.core import yaml as plain_yaml
from copem_replay.experiment.file import parse_experiment, read_experiment_file
from copem_replay.pipeline import run as gather
from copem_replay.pipeline import study_log
from copem_replay.results import write as results
from copem_replay.results.compare import compare_folders, comparison_markdown, comparison_text
from copem_replay.results.read import read_results
from tests.helpers.experiments import ALL_COUNT, TEXT, changed, drive
from tests.helpers.recordings import Obj, truth_topic, write_mcap, write_recording
from tests.helpers.viewer import free_port

ROOT = Path(__file__).parents[2]
COMMAND = Path(sys.executable).with_name("copem-replay")
REINDEX = (
    ".: expected a recording, found a folder without metadata.yaml; name its files as logs of their own, or let "
    "`ros2 bag reindex` write it: then they are one"
)
NO_WIDTH = {"COLUMNS": "40", "TERM": "xterm-256color", "FORCE_COLOR": "1"}


class Ended(NamedTuple):
    code: int
    out: str
    lines: list[str]
    """Of stderr."""


Call = Callable[..., Ended]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Call:
    """Run a command in this process, from `tmp_path`, as if in a narrow terminal that has colours."""
    monkeypatch.chdir(tmp_path)
    for name, value in NO_WIDTH.items():
        monkeypatch.setenv(name, value)

    def called(*arguments: str | Path) -> Ended:
        monkeypatch.setattr(sys, "argv", ["copem-replay", *map(str, arguments)])
        capsys.readouterr()
        code = cli._run_to_exit_code()
        out, err = capsys.readouterr()
        if code != 70:
            assert "Traceback" not in err
            assert "\x1b" not in err + out
            assert err == "" or err.endswith("\n")
        return Ended(code, out, err.splitlines())

    return called


@pytest.fixture
def here(tmp_path: Path) -> Path:
    """A folder with the small experiment, `e.yaml`, and its recording."""
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(TEXT)
    return tmp_path


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of results of that experiment, made once for all who copy it."""
    return run_in(tmp_path_factory.mktemp("made"), TEXT)


def run_in(folder: Path, text: str) -> Path:
    """The results of an experiment of that recording, as `run` puts them into a folder."""
    drive(folder / "drive.mcap")
    (folder / "e.yaml").write_text(text)
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()):
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["copem-replay", "run", "e.yaml"])
        assert cli._run_to_exit_code() == 0
    return folder / "out/e"


@pytest.fixture
def ran(here: Path, made_once: Path) -> Path:
    """That folder where `copem-replay run e.yaml` has put its results, `out/e`. The results are returned."""
    return shutil.copytree(made_once, here / "out/e")


def installed(*arguments: str | Path, folder: Path, **more: Any) -> subprocess.CompletedProcess[str]:
    """The command as it is installed, in a process of its own."""
    environment = os.environ | NO_WIDTH | more.pop("environment", {})
    options: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "timeout": 100} | more
    return subprocess.run([COMMAND, *arguments], cwd=folder, env=environment, text=True, **options)


def written(folder: Path) -> dict[str, bytes]:
    """All files of a folder, but for .rrd, and their seals."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".rrd" and path.name != "made.jsonl"
    }


def table(folder: Path) -> pd.DataFrame:
    return pd.read_parquet(folder / "detections.parquet")


class TestUsage:
    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            ([], "expected a command, one of "),
            (["replay"], "No such command 'replay'."),
            (["--nope"], "No such option: --nope"),
            (["info"], "Missing argument 'LOG'."),
            (["init"], "Missing argument 'LOG'."),
            (["check"], "Missing argument 'EXPERIMENT'."),
            (["check", "a", "b"], "unexpected extra argument"),
            (["run"], "Missing argument 'EXPERIMENT'."),
            (["run", "e.yaml", "--runz", "5"], "No such option: --runz"),
            (["run", "e.yaml", "--runs"], "Option '--runs' requires an argument."),
            (["run", "e.yaml", "--runs", "many"], "Invalid value for '--runs': "),
            (["run", "e.yaml", "--runs", "0"], "Invalid value for '--runs': "),
            (["run", "e.yaml", "--seed", "1.5"], "Invalid value for '--seed': "),
            (["run", "e.yaml", "--jobs", "0"], "Invalid value for '--jobs': "),
            (["run", "e.yaml", "--jobs", "1000000"], "Invalid value for '--jobs': "),
            (["compare"], "Missing argument 'FOLDER'."),
            (["compare", "out", "--false-positives-per-min", "-1"], "Invalid value for '--false-positives-per-min': "),
            (["compare", "out", "--false-positives-per-min", "few"], "Invalid value for '--false-positives-per-min': "),
            (["view"], "Missing argument 'FOLDER'."),
            (["schema", "all"], "unexpected extra argument"),
        ],
    )
    def test_errors_are_one_line(self, call: Call, arguments: list[str], said: str) -> None:
        ended = call(*arguments)
        assert ended.code == 2
        assert ended.out == ""
        (line,) = ended.lines
        assert line.startswith("copem-replay: ")
        assert said in line

    @pytest.mark.parametrize("command", [[], ["info"], ["init"], ["check"], ["run"], ["compare"], ["view"], ["schema"]])
    @pytest.mark.parametrize("option", ["--help", "-h"])
    def test_help(self, call: Call, command: list[str], option: str) -> None:
        ended = call(*command, option)
        assert ended.code == 0
        assert ended.lines == []
        assert ended.out.startswith("Usage: copem-replay ")

    def test_every_option_of_run_is_in_its_help(self, call: Call) -> None:
        out = call("run", "--help").out
        for option in ["log", "ego", "out", "runs", "seed", "jobs", "overwrite", "skip-unreadable", "live", "viewer"]:
            assert f"--{option}" in out

    def test_version(self, call: Call) -> None:
        ended = call("--version")
        assert ended.code == 0
        assert ended.out.startswith("copem-replay 0.")


class TestInstalled:
    @pytest.mark.parametrize("arguments", [["--help"], ["info", "drive.mcap"], ["init", "drive.mcap"]])
    def test_heavy_imports_happen_where_they_are_used(self, here: Path, arguments: list[str]) -> None:
        code = (
            "import sys; from copem_replay.cli import main as cli; code = cli._run_to_exit_code(); "
            "heavy = {'pandas', 'numba', 'rerun', 'scipy', 'shapely', 'pyarrow'} & sys.modules.keys(); "
            "sys.exit(f'imported {heavy}' if heavy else code)"
        )
        done = subprocess.run([sys.executable, "-c", code, *arguments], cwd=here, capture_output=True, text=True)
        assert done.stderr == ""
        assert done.returncode == 0
        assert done.stdout

    def test_a_check_needs_no_tables(self, here: Path) -> None:
        code = (
            "import sys; from copem_replay.cli import main as cli; code = cli._run_to_exit_code(); "
            "heavy = {'pandas', 'rerun', 'pyarrow', 'matplotlib'} & sys.modules.keys(); "
            "sys.exit(f'imported {heavy}' if heavy else code)"
        )
        done = subprocess.run([sys.executable, "-c", code, "check", "e.yaml"], cwd=here, capture_output=True, text=True)
        assert (done.stderr, done.returncode) == ("", 0)

    def test_run(self, here: Path) -> None:
        done = installed("run", "e.yaml", folder=here)
        assert done.returncode == 0
        assert done.stderr == ""
        lines = done.stdout.splitlines()
        assert lines[:3] == ["drive: 1 object counts, 4 runs", lines[1], ""]
        assert lines[1].startswith("! One object says nothing about other traffic")
        assert lines[4].split() == ["mean", "median", "95", "%", "by", "median", "detected"]
        assert [line.split()[0] for line in lines[5:7]] == ["PEM", "coPEM"]
        assert re.search(END, done.stdout)
        assert table(here / "out" / "e").shape[0] == 12

    def test_wrong_input(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(changed("runs: no", "unit: " + "x" * 200))
        said = [
            "e.yaml:3: runs: expected a whole number, found 'no'",
            "e.yaml:19: unit: unknown key; did you mean units?",
        ]
        assert call("check", "e.yaml") == (2, "", said)

    def test_interrupt(self, here: Path) -> None:
        """Ctrl-C in the middle of a replay: nothing is left, not even a temporary folder."""
        code = "import os, signal\nfrom copem_replay.perception.pem.detection import DetectionModel\n\n\n"
        code += "class Pressed(DetectionModel):\n    def probability(self, view):\n"
        code += "        os.kill(os.getpid(), signal.SIGINT)\n        return view.visible_share\n"
        (here / "keys.py").write_text(code)
        (here / "e.yaml").write_text(changed("      detection: {kind: 'keys:Pressed'}"))

        def listen() -> None:  # a background job of a shell ignores it, and so would its children
            signal.signal(signal.SIGINT, signal.default_int_handler)

        environment = {"PYTHONPATH": str(here), "PYTHONDONTWRITEBYTECODE": "1"}
        done = installed("run", "e.yaml", folder=here, environment=environment, preexec_fn=listen)
        assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")
        assert sorted(path.name for path in here.iterdir()) == ["drive.mcap", "e.yaml", "keys.py"]

    def test_reader_that_has_gone(self, here: Path) -> None:
        reading, writing = os.pipe()
        os.close(reading)
        try:
            done = installed("info", "drive.mcap", folder=here, stdout=writing)
        finally:
            os.close(writing)
        assert (done.returncode, done.stderr) == (0, "")

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
    def test_output_that_cannot_be_written(self, here: Path) -> None:
        with open("/dev/full", "w") as full:
            done = installed("info", "drive.mcap", folder=here, stdout=full)
        assert (done.returncode, done.stderr) == (2, "copem-replay: No space left on device\n")

    def test_terminal_without_the_letters(self, here: Path) -> None:
        done = installed("info", "drive.mcap", folder=here, environment={"PYTHONIOENCODING": "ascii"})
        assert (done.returncode, done.stderr) == (0, "")
        assert r"4.00 \xd7 2.00 \xd7 1.50 m" in done.stdout

    def test_progress_on_a_terminal_only(self, here: Path) -> None:
        reading, writing = os.openpty()
        shown: list[bytes] = []

        def read() -> None:  # all the while: a terminal that is full holds up who writes to it
            while not shown or not shown[-1].endswith(b"\0"):
                shown.append(os.read(reading, 4096))

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        done = installed("run", "e.yaml", folder=here, stderr=writing)
        os.write(writing, b"\0")
        reader.join(timeout=10)
        os.close(reading)
        os.close(writing)
        assert done.returncode == 0
        assert b"replaying" in b"".join(shown)
        assert "\x1b" not in done.stdout

    def test_closed_streams(self, here: Path) -> None:
        close = "import os, sys; os.close(int(sys.argv[1])); os.execv(sys.argv[2], sys.argv[2:])"
        for stream in ("1", "2"):
            words = [sys.executable, "-c", close, stream, str(COMMAND), "run", "e.yaml", "--out", stream]
            assert subprocess.run(words, cwd=here, timeout=100).returncode == 0

    @pytest.mark.parametrize("module", ["typer", "copem_replay.core.errors", "pydantic"])
    def test_an_interrupt_while_modules_are_imported(self, here: Path, module: str) -> None:
        """Whenever it comes: here as a module is looked for, before `main` is there to catch it and after."""
        (here / "sitecustomize.py").write_text(
            "import sys\n"
            "class Interrupts:\n"
            "    def find_spec(self, name, path=None, target=None):\n"
            f"        if name == {module!r}:\n"
            "            raise KeyboardInterrupt\n"
            "sys.meta_path.insert(0, Interrupts())\n"
        )
        ended = installed("check", "e.yaml", folder=here, environment={"PYTHONPATH": str(here)})
        assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "interrupted\n")


class TestInfo:
    def test_text(self, here: Path, call: Call) -> None:
        ended = call("info", "drive.mcap")
        assert ended.code == 0
        assert ended.lines == []
        assert "ego: 1 (car, 4.00 × 2.00 × 1.50 m)" in ended.out

    def test_json(self, here: Path, call: Call) -> None:
        drive(here / "ünd zwei.mcap", host=None)
        ended = call("info", "--json", "drive.mcap", "ünd zwei.mcap")
        assert ended.code == 0
        first, second = json.loads(ended.out)
        assert first["recording"] == "drive.mcap"
        assert first["truth"][0]["ego"]["id"] == "1"
        assert second["recording"] == "ünd zwei.mcap"
        assert second["truth"][0]["ego"] is None

    @pytest.mark.parametrize("name", ["none.mcap", ".", "empty.mcap", "e.yaml", "/dev/null", "x" * 300])
    def test_none_can_be_read(self, here: Path, call: Call, name: str) -> None:
        (here / "empty.mcap").touch()
        for option in ([], ["--json"]):
            ended = call("info", name, *option)
            assert ended.code == 2
            (line,) = ended.lines
            assert name in line

    def test_no_object_list(self, here: Path, call: Call) -> None:
        write_mcap(here / "other.mcap", [truth_topic([(0.0, [])], schema="other.Schema")])
        ended = call("info", "other.mcap")
        assert ended.code == 2
        assert "other.Schema" in ended.out
        (line,) = ended.lines
        assert line.startswith("other.mcap: no list of true objects")

    def test_one_of_two_can_be_read(self, here: Path, call: Call) -> None:
        ended = call("info", "none.mcap", "drive.mcap")
        assert ended.code == 0
        assert ended.lines == ["none.mcap: no such file"]
        assert "truth: truth" in ended.out
        ended = call("info", "--json", "none.mcap", "drive.mcap")
        assert [one["readable"] for one in json.loads(ended.out)] == [False, True]

    def test_topic_that_would_colour_the_terminal(self, here: Path, call: Call) -> None:
        frames = [(0.1 * k, [Obj(id=1)]) for k in range(3)]
        write_mcap(here / "odd.mcap", [truth_topic(frames, name="a\x1b[31m\nb", host=1)])
        ended = call("info", "odd.mcap")
        assert ended.code == 0
        assert r"truth: a\x1b[31m\nb" in ended.out.splitlines()

    def test_name_that_would_break_the_line(self, here: Path, call: Call) -> None:
        ended = call("info", "a\nb\x1b[31m.mcap")
        assert ended.lines == [r"a\nb\x1b[31m.mcap: no such file"]


BEGAN = (
    "within 30 m: 0 objects count\n"
    "within 40 m: 1 object counts: 1 crossed\n"
    "within 50 m: 1 object counts: 1 crossed\n"
    "within 60 m: 1 object counts: 1 crossed (chosen)\n"
)
BEGAN_OF_TWO = BEGAN.replace("1 object counts: 1", "2 objects count: 2")


class TestCheck:
    def test_fine(self, here: Path, call: Call) -> None:
        drive(here / "two.mcap")
        (here / "e.yaml").write_text(changed("logs: ['*.mcap']"))
        ended = call("check", "e.yaml")
        assert ended == (0, f"{BEGAN_OF_TWO}e.yaml: no problem found; logs: drive, two\n", [])

    def test_every_problem_at_once(self, here: Path, call: Call) -> None:
        drive(here / "drive.mcap", host=None)
        unit = "  mast: {on: 9, height_m: 1, pem: 5}"
        (here / "e.yaml").write_text(changed("logs: [drive.mcap, none.mcap, 'x*']", unit, "show: {run: 9}"))
        ended = call("check", "e.yaml")
        assert ended.code == 2
        assert ended.out == ""
        assert [line[:40] for line in ended.lines] == [
            "e.yaml:2: logs[2]: no file matches 'x*'",
            "e.yaml:12: units.mast.pem: no PEM is nam",
            "e.yaml:18: show.run: expected a run belo",
            "e.yaml:1: ego: drive.mcap: no ego vehicl",
            "e.yaml:12: units.mast.on: drive.mcap: no",
            "e.yaml:2: logs[1]: none.mcap: no such fi",
        ]

    def test_the_first_fifty_of_many_problems(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(TEXT + "".join(f"k{k}: 1\n" for k in range(300)))
        ended = call("check", "e.yaml")
        assert (ended.code, len(ended.lines)) == (2, 51)
        assert ended.lines[49].startswith("e.yaml:68: k49: unknown key; ")
        assert ended.lines[50] == "and 250 more"

    def test_a_key_cannot_break_the_line(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(TEXT + '"a\\nb\\e[31m\\u2028": 1\n')
        ended = call("check", "e.yaml")
        (line,) = ended.lines
        assert line.startswith(r"e.yaml:19: a\nb\x1b[31m\u2028: unknown key; known here: ")

    @pytest.mark.parametrize(
        ("name", "said"),
        [
            ("none.yaml", "none.yaml: no such file"),
            (".", ".: is a folder; expected an experiment file (YAML)"),
            (
                "drive.mcap",
                "drive.mcap: expected an experiment file (YAML), found a recording; `copem-replay init "
                "drive.mcap > experiment.yaml` makes one that replays it",
            ),
            ("x" * 300, "x" * 300 + ": cannot be read: File name too long"),
        ],
    )
    def test_no_experiment(self, here: Path, call: Call, name: str, said: str) -> None:
        for command in ("check", "run") if name != "drive.mcap" else ("check",):
            assert call(command, name) == (2, "", [said])

    def test_run_takes_recordings_by_their_drafts(self, here: Path, call: Call) -> None:
        """The same as `init` and `run`; the draft is in the folder, and runs from there."""
        ended = call("run", "drive.mcap", "--runs", "2")
        assert ended.code == 0
        assert "results in out/drive, drafted as by init (experiment.yaml)" in ended.out
        (here / "draft.yaml").write_text(call("init", "drive.mcap").out)
        assert call("run", "draft.yaml", "--runs", "2").code == 0
        for file in ("summary.csv", "tally.parquet"):
            assert (here / "out/drive" / file).read_bytes() == (here / "out/draft" / file).read_bytes()
        assert call("check", "out/drive/experiment.yaml").code == 0

    def test_run_takes_a_recording_in_a_folder(self, here: Path, call: Call) -> None:
        (here / "drives").mkdir()
        shutil.copy(here / "drive.mcap", here / "drives/monday.mcap")
        assert call("run", "drives/monday.mcap", "--runs", "1").code == 0
        assert (here / "out/monday/summary.csv").is_file()

    def test_run_of_several_recordings_is_one_study(self, here: Path, call: Call) -> None:
        shutil.copy(here / "drive.mcap", here / "second.mcap")
        assert call("run", "drive.mcap", "second.mcap", "--runs", "2").code == 0
        assert set(pd.read_csv(here / "out/drives/logs.csv")["log"]) == {"drive", "second"}

    def test_run_takes_either_an_experiment_or_recordings(self, here: Path, call: Call) -> None:
        said = "expected one experiment, or recordings, found e.yaml, drive.mcap"
        assert call("run", "e.yaml", "drive.mcap") == (2, "", [said])
        assert call("run", "none.mcap") == (2, "", ["none.mcap: no such file"])

    def test_what_can_hardly_be_meant_is_said_as_run_says_it(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(
            changed(
                "logs: [drive.mcap, '*.mcap']",
                "    - when: {range_m: [0, 80], azimuth_deg: [-0.001, 0.001]}",
                "  mast: {at: [12.0, 450000.0], ground_z_m: 0, height_m: 5.0, pem: onboard}",
                "  coPEM: {units: all, latency_s: 250}",
            )
        )
        checked, run = call("check", "e.yaml"), call("run", "e.yaml")
        assert (checked.code, run.code) == (0, 0)
        assert checked.out == f"{BEGAN}e.yaml: no problem found; logs: drive\n"
        assert checked.lines == run.lines
        assert [line.partition(":")[0] for line in checked.lines] == ["note"] * 4
        for part in ("logs[0], logs[1]", "450 km away", "unit mast: no object ever meets", "longer than the log"):
            assert any(part in line for line in checked.lines), part

    @pytest.mark.parametrize("command", ["check", "run"])
    def test_runs_that_no_memory_holds(self, here: Path, call: Call, command: str) -> None:
        (here / "e.yaml").write_text(changed("runs: 1000000000"))
        ended = call(command, "e.yaml")
        assert (ended.code, ended.out) == (2, "")
        (line,) = ended.lines
        least = r"1000000000 runs of 3 rows each take at least 1\.2e\+03 GB"
        assert re.fullmatch(rf"e\.yaml:3: runs: {least}, and .* GB are free; take \d+ or fewer", line)
        assert not (here / "out").exists()

    def test_runs_that_may_be_too_many_are_said_before(
        self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("copem_replay.pipeline.cost.free_bytes", lambda: 30_000)
        monkeypatch.setattr(gather, "replay_outcomes", raising(OSError(5, "Input/output error")))
        said = "note: 4 runs of 3 rows each may take 3.68e-05 GB, and 3e-05 GB are free"
        assert call("check", "e.yaml").lines == [said]
        assert call("run", "e.yaml").lines == [said, "copem-replay: Input/output error"]

    @pytest.mark.skipif(not Path("/proc/self/mem").is_file(), reason="no file here whose reading fails")
    def test_a_file_that_cannot_be_read_is_named_among_the_others(self, here: Path, call: Call) -> None:
        failing = "/proc/self/mem: cannot be read: Input/output error"
        for command in (["check"], ["run", "--seed", "1"]):
            ended = call(*command, "e.yaml", "--log", "/proc/self/mem", "--log", "none.mcap")
            assert ended == (2, "", [failing, "none.mcap: no such file"])
        assert call("info", "/proc/self/mem").lines == [failing]
        assert call("init", "/proc/self/mem").lines == [failing]
        skipped = call("run", "e.yaml", "--log", "/proc/self/mem", "--log", "drive.mcap", "--skip-unreadable")
        assert skipped.code == 1
        assert skipped.lines == ["note: " + failing.replace(": cannot", ": skipped: cannot")]

    def test_from_another_folder(self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        (here / "sub").mkdir()
        monkeypatch.chdir(here / "sub")
        ended = call("check", "../e.yaml")
        assert ended == (0, f"{BEGAN}../e.yaml: no problem found; logs: drive\n", [])


END = r"\nresults in out/e; every figure: --explain\nnext: copem-replay report out/e\n\n[A-Z][^\n]*(\n +[^\n]*)*\.\n$"


class TestRun:
    def test_every_figure_where_it_is_asked_for(self, here: Path, call: Call) -> None:
        lines = call("run", "e.yaml", "--explain").out.splitlines()
        assert lines[0].startswith("configuration  detected_share  95 %")
        assert [line.split()[0] for line in lines[1:4]] == ["GT", "PEM", "coPEM"]
        assert any(line.startswith("baseline of compare and report: ") for line in lines)

    def test_results(self, here: Path, call: Call) -> None:
        ended = call("run", "e.yaml")
        assert ended.code == 0
        assert ended.lines == []
        assert re.search(END, ended.out)
        assert sorted(written(here / "out" / "e")) == [
            "accuracy.parquet", "bands.csv", "detections.parquet", "experiment.yaml", "false_tracks.parquet",
            "instants.parquet", "lists.parquet", "logs.csv", "provenance.json", "read.csv", "summary.csv",
            "tally.parquet", "thresholds.parquet",
        ]  # fmt: skip
        assert os.listdir(here / "out") == ["e"]
        assert set(table(here / "out" / "e")["configuration"]) == {"GT", "PEM", "coPEM"}
        assert list(pd.read_csv(here / "out/e/summary.csv")["n"]) == [4, 4, 4]

    def test_with_recordings(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(changed("show: {run: 1}"))
        for out in ("one", "two"):
            assert call("run", "e.yaml", "--out", out).code == 0
        assert {"replay.mcap", "replay.rrd"} < set(os.listdir(here / "one"))
        assert written(here / "one") == written(here / "two")
        found = json.loads((here / "one/provenance.json").read_text())
        assert found["run_shown"] == {"drive": 1}
        # What was written is a recording itself: its truth is untouched.
        assert call("info", "one/replay.mcap").code == 0

    def test_the_largest_seed_is_in_the_recording(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(changed("show: {run: 0}", f"seed: {2**64 - 1}"))
        ended = call("run", "e.yaml", "--out", "one")
        assert (ended.code, [line for line in ended.lines if "replay" in line]) == (0, [])
        assert (here / "one/replay.rrd").is_file()

    def test_recordings_of_several_logs(self, here: Path, call: Call) -> None:
        drive(here / "a" / "drive.mcap")
        (here / "e.yaml").write_text(changed("logs: [drive.mcap, a/drive.mcap]", "show: {logs: [all], run: worst}"))
        assert call("run", "e.yaml").code == 0
        names = [name for name in written(here / "out/e") if name.startswith("replay")]
        assert names == ["replay/a/drive.mcap", f"replay/{here.name}/drive.mcap"]
        assert len(list((here / "out/e").rglob("*.rrd"))) == 2

    def test_no_row(self, here: Path, call: Call) -> None:
        """Nothing ever comes within 1 m: tables without rows, and it is said."""
        (here / "e.yaml").write_text(changed("measure: {onset: {kind: in_range, range_m: 1}}"))
        ended = call("run", "e.yaml")
        assert ended.code == 0
        assert ended.lines == ["note: drive: no rows: no measured object has an onset (in_range)"]
        found = table(here / "out/e")
        assert len(found) == 0
        assert found.dtypes["onset_s"].kind == "f"
        assert list(pd.read_csv(here / "out/e/summary.csv")["n"]) == [0, 0, 0]
        assert ended.out.splitlines()[0] == "drive: 0 objects count, 4 runs"
        assert ended.out.splitlines()[-1] == "There is no answer: no measured object has an onset."
        refused = call("compare", "out/e", "--baseline", "PEM")
        assert (refused.code, refused.lines) == (
            2, ["out/e: nothing can be compared: no measured object has an onset"],
        )  # fmt: skip

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            (
                "measure: {objects: {classes: [truck]}}",
                "note: drive: no rows: nothing to measure (truck); the log has car",
            ),
            (
                "measure: {onset: {kind: at, time_s: 99}}",
                "note: drive: no rows: the onset at 99 s lies after the log's end, ",
            ),
        ],
    )
    def test_why_there_is_no_row(self, here: Path, call: Call, change: str, said: str) -> None:
        (here / "e.yaml").write_text(changed(change))
        ended = call("run", "e.yaml")
        assert ended.code == 0
        assert any(line.startswith(said) for line in ended.lines), ended.lines

    def test_what_can_hardly_be_meant_is_said(self, here: Path, call: Call) -> None:
        """Radians for degrees, a latency in milliseconds."""
        text = (here / "e.yaml").read_text().replace("\n  PEM: {", "\n  late: {units: all, latency_s: 250}\n  PEM: {")
        assert "latency_s: 250" in text
        (here / "e.yaml").write_text(text)
        lines = call("run", "e.yaml").lines
        assert any("configuration late: the latency of ego" in line for line in lines), lines
        narrow = TEXT.replace("range_m: [0, 80]", "azimuth_deg: [-0.001, 0.001], range_m: [1, 2]")
        (here / "e.yaml").write_text(narrow)
        lines = call("run", "e.yaml", "--overwrite").lines
        assert "note: drive: unit ego: no object ever meets a condition of its PEM 'onboard'" in lines

    def test_nothing_is_cut_off_or_wrapped(self, here: Path, call: Call) -> None:
        name = "a very long name of a configuration " * 5
        (here / "e.yaml").write_text(TEXT.replace("  PEM:", f"  '{name}':"))
        ended = call("run", "e.yaml", "--explain")
        assert ended.code == 0
        lines = ended.out.splitlines()
        assert len(lines[0]) > 250
        assert sum(line.startswith(name) for line in lines) == 1

    @pytest.mark.parametrize("file", ["noending", "a b.yaml", "ü – 中.yaml", "x.v2.yml", "-e.yaml"])
    def test_name_of_the_experiment(self, here: Path, call: Call, file: str) -> None:
        (here / file).write_text(TEXT)
        ended = call("run", "--", file)
        assert ended.code == 0
        assert (here / "out" / Path(file).stem / "provenance.json").exists()

    def test_name_of_the_log(self, here: Path, call: Call) -> None:
        names = ["[1] ü–中 #x.mcap", "a'b\"c: d.mcap", "tab\tnew\nline.mcap", "*.mcap", "- x.mcap"]
        for k, name in enumerate(names):
            drive(here / f"night {k}" / name)
            (here / "e.yaml").write_text(
                plain_yaml.dump_yaml(plain_yaml.parse_yaml(TEXT)[0] | {"logs": [f"night {k}/{name}"]})
            )
            assert call("run", "e.yaml", "--out", f"out/{k}").code == 0
            assert set(table(here / f"out/{k}")["log"]) == {name.removesuffix(".mcap")}
            again = call("run", f"out/{k}/experiment.yaml", "--out", f"again/{k}")
            assert again.code == 0
            assert (
                written(here / f"out/{k}")["detections.parquet"] == written(here / f"again/{k}")["detections.parquet"]
            )

    def test_log_that_is_not_utf8(self, here: Path, call: Call) -> None:
        drive(here / "caf\udce9.mcap")
        for arguments in (["--log", "caf\udce9.mcap"], ["--log", "*.mcap", "--skip-unreadable"]):
            ended = call("run", "e.yaml", *arguments)
            assert r"caf\udce9.mcap: " in ended.lines[0]
            assert len(ended.lines) == 1
        assert ended.code == 1
        skipped = json.loads((here / "out/e/provenance.json").read_text())["logs_skipped"]
        assert [one["log"] for one in skipped] == [r"caf\udce9.mcap"]


class TestOptions:
    def test_out(self, here: Path, call: Call) -> None:
        """Missing parents are made; a relative path is relative to where we are."""
        assert call("run", "e.yaml", "--out", "a/b c/ü").code == 0
        assert (here / "a/b c/ü/provenance.json").exists()
        assert not (here / "out").exists()

    def test_runs(self, here: Path, call: Call) -> None:
        assert call("run", "e.yaml", "--runs", "7").code == 0
        assert set(table(here / "out/e")["run"]) == set(range(7))
        assert plain_yaml.parse_yaml((here / "out/e/experiment.yaml").read_text())[0]["runs"] == 7

    def test_fewer_runs_are_the_first_of_more(self, here: Path, call: Call) -> None:
        assert call("run", "e.yaml", "--runs", "2", "--out", "two").code == 0
        assert call("run", "e.yaml", "--out", "four").code == 0
        four = table(here / "four")
        pd.testing.assert_frame_equal(table(here / "two"), four[four["run"] < 2].reset_index(drop=True))

    def test_run_shown_must_be_among_the_runs(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(changed("show: {run: 3}"))
        ended = call("run", "e.yaml", "--runs", "3")
        assert ended == (2, "", ["e.yaml:18: show.run: expected a run below 3, found 3"])

    def test_too_many_runs(self, here: Path, call: Call) -> None:
        ended = call("run", "e.yaml", "--runs", "1" + "0" * 30)
        assert ended.code == 2
        assert ended.lines == ["--runs: expected at most 1e+09, found 1" + "0" * 30]

    @pytest.mark.parametrize("seed", ["-5", "0", "18446744073709551615"])
    def test_seed(self, here: Path, call: Call, seed: str) -> None:
        assert call("run", "e.yaml", "--runs", "50", "--out", "one").code == 0
        assert call("run", "e.yaml", "--runs", "50", "--seed", seed, "--out", "two").code == 0
        one, two = (table(here / name).set_index("configuration") for name in ("one", "two"))
        assert one.loc["GT"].equals(two.loc["GT"])
        assert not one.loc["PEM"].equals(two.loc["PEM"])
        assert json.loads((here / "two/provenance.json").read_text())["seed"] == int(seed)

    def test_ego(self, here: Path, call: Call) -> None:
        assert call("run", "e.yaml", "--ego", "2").code == 0
        assert set(table(here / "out/e")["object_id"]) == {"1"}
        assert plain_yaml.parse_yaml((here / "out/e/experiment.yaml").read_text())[0]["ego"] == "2"

    @pytest.mark.parametrize("ego", ["9", "3", ""])
    def test_ego_that_is_not_there(self, here: Path, call: Call, ego: str) -> None:
        ended = call("run", "e.yaml", "--ego", ego)
        assert ended == (2, "", [f"--ego: drive.mcap: no moving object {ego!r}; there are 1 (car), 2 (car)"])

    def test_no_ego(self, here: Path, call: Call) -> None:
        drive(here / "drive.mcap", host=None)
        ended = call("run", "e.yaml")
        assert ended.code == 2
        (line,) = ended.lines
        assert "--ego ID" in line
        assert call("run", "e.yaml", "--ego", "1").code == 0

    def test_log(self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        """Instead of those of the file, relative to where we are."""
        drive(here / "other/night.mcap")
        drive(here / "other/day.mcap")
        (here / "e.yaml").write_text(changed("logs: [none.mcap]"))
        monkeypatch.chdir(here / "other")
        assert call("run", "../e.yaml", "--log", "night.mcap", "--log", "day.mcap").code == 0
        assert list(dict.fromkeys(table(here / "other/out/e")["log"])) == ["night", "day"]
        assert call("run", "../e.yaml", "--log", "*.mcap", "--out", "globbed").code == 0
        assert list(dict.fromkeys(table(here / "other/globbed")["log"])) == ["day", "night"]

    def test_log_of_a_file_without_logs(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(TEXT.replace("logs: [drive.mcap]\n", ""))
        assert call("run", "e.yaml").lines == ["e.yaml:1: logs: missing"]
        assert call("run", "e.yaml", "--log", "drive.mcap").code == 0

    @pytest.mark.parametrize(
        ("log", "said"),
        [
            ("none.mcap", "none.mcap: no such file"),
            ("x*.mcap", "--log: no file matches 'x*.mcap'"),
            ("e.yaml", "e.yaml: expected an MCAP file, found text that begins with 'version: 1'"),
            (".", REINDEX),
            ("", REINDEX),
            ("x" * 300, "x" * 300 + ": no such file"),
        ],
    )
    def test_log_that_cannot_be_read(self, here: Path, call: Call, log: str, said: str) -> None:
        assert call("run", "e.yaml", "--log", log) == (2, "", [said])
        assert not (here / "out").exists()

    def test_jobs_do_not_change_the_results(self, here: Path, call: Call) -> None:
        drive(here / "two.mcap")
        (here / "e.yaml").write_text(changed("logs: ['*.mcap']", "runs: 7", "show: {run: 2}"))
        for jobs in ("1", "3", "64"):
            assert call("run", "e.yaml", "--jobs", jobs, "--out", jobs).code == 0
        assert call("run", "e.yaml", "--out", "default").code == 0
        assert written(here / "1") == written(here / "3") == written(here / "64") == written(here / "default")

    def test_a_log_that_cannot_be_replayed_stops_the_run_before_it_starts(self, here: Path, call: Call) -> None:
        (here / "bad.mcap").write_text("x")
        (here / "e.yaml").write_text(changed("logs: [bad.mcap, none.mcap, drive.mcap]"))
        ended = call("run", "e.yaml")
        assert ended.code == 2
        assert [line.split(": ")[-3:-1] for line in ended.lines][1] == ["logs[1]", "none.mcap"]
        assert ended.lines[0].startswith("bad.mcap: expected an MCAP file")
        assert not (here / "out").exists()

    def test_skip_unreadable(self, here: Path, call: Call) -> None:
        (here / "bad.mcap").write_text("x")
        drive(here / "nohost.mcap", host=None)
        text = changed("logs: [bad.mcap, none.mcap, drive.mcap, nohost.mcap]")
        (here / "e.yaml").write_text(text)
        ended = call("run", "e.yaml", "--skip-unreadable")
        assert ended.code == 1
        assert [line[:31] for line in ended.lines] == [
            "note: bad.mcap: skipped: expect", "note: none.mcap: skipped: no su", "note: nohost.mcap: skipped: no ",
        ]  # fmt: skip
        assert set(table(here / "out/e")["log"]) == {"drive"}
        found = json.loads((here / "out/e/provenance.json").read_text())
        assert [one["log"] for one in found["logs_skipped"]] == ["bad.mcap", "none.mcap", "nohost.mcap"]
        assert found["logs_skipped"][1]["reason"] == "no such file"
        assert [one["log"] for one in found["logs"]] == ["drive"]
        # What it says of them does not depend on where it was called from.
        (here / "sub").mkdir()
        os.chdir(here / "sub")
        assert call("run", "../e.yaml", "--skip-unreadable", "--out", "../again").code == 1
        again, before = (
            json.loads((here / name / "provenance.json").read_text()) | {"sha256": None} for name in ("again", "out/e")
        )
        assert again == before

    def test_skip_unreadable_with_nothing_to_skip(self, here: Path, call: Call) -> None:
        assert call("run", "e.yaml", "--skip-unreadable").code == 0

    def test_skip_unreadable_with_nothing_left(self, here: Path, call: Call) -> None:
        ended = call("run", "e.yaml", "--log", "none.mcap", "--skip-unreadable")
        assert ended == (2, "", ["none.mcap: no such file"])

    def test_skip_unreadable_does_not_skip_mistakes_of_the_experiment(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(changed("  PEM: {units: [eg0]}"))
        ended = call("run", "e.yaml", "--skip-unreadable", "--log", "drive.mcap", "--log", "none.mcap")
        assert ended.code == 2
        assert ended.lines == ["e.yaml:15: configurations.PEM.units[0]: no unit is named 'eg0'; did you mean ego?"]


def shown(show: str) -> str:
    """The small experiment with another `show`."""
    return "\n".join(f"show: {show}" if line.startswith("show:") else line for line in TEXT.splitlines()) + "\n"


class TestLive:
    def test_refused_before_the_replay_where_nobody_listens(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(shown("{run: 0}"))
        url = f"rerun+http://127.0.0.1:{free_port()}/proxy"
        ended = call("run", "e.yaml", "--live", "--viewer", url)
        assert ended.code == 2
        (line,) = ended.lines
        assert line.startswith(f"--live: no viewer at {url} (")
        assert line.endswith("); start one first: python -m rerun")
        assert not (here / "out").exists()

    def test_an_address_that_is_none(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(shown("{run: 0}"))
        said = "--viewer: expected an address such as rerun+http://127.0.0.1:9876/proxy, found 'localhost'"
        assert call("run", "e.yaml", "--viewer", "localhost") == (2, "", [said])

    @pytest.mark.parametrize("show", ["null", "{run: null}"])
    def test_nothing_to_show(self, here: Path, call: Call, show: str) -> None:
        (here / "e.yaml").write_text(shown(show))
        said = "--live: nothing to show: the experiment has `show: null` or `show: {run: null}`"
        assert call("run", "e.yaml", "--live") == (2, "", [said])


class TestOtherLogs:
    """`--log` in the place of the logs of the file, of which `show` names some."""

    @pytest.mark.parametrize(
        ("shown", "logs", "written_of"),
        [
            ("[drive]", ["other.mcap"], "other"),
            ("[drive, other]", ["other.mcap"], "other"),
            ("[drive, all]", ["other.mcap"], "other"),
            ("[drive]", ["other.mcap", "drive.mcap"], "drive"),
        ],
    )
    def test_what_is_not_replayed_is_not_shown(
        self, here: Path, call: Call, shown: str, logs: list[str], written_of: str
    ) -> None:
        drive(here / "other.mcap")
        (here / "e.yaml").write_text(changed(f"show: {{run: 0, logs: {shown}}}"))
        options = [word for log in logs for word in ("--log", log)]
        assert call("run", "e.yaml", *options).code == 0
        provenance = json.loads((here / "out/e/provenance.json").read_text())
        assert list(provenance["runs_shown"]) == [written_of]
        assert call("run", "out/e/experiment.yaml", "--out", "again").code == 0

    def test_a_log_that_the_file_does_not_have_is_a_mistake_still(self, here: Path, call: Call) -> None:
        drive(here / "other.mcap")
        (here / "e.yaml").write_text(changed("show: {run: 0, logs: [drvie]}"))
        ended = call("run", "e.yaml", "--log", "other.mcap")
        assert ended.code == 2
        assert "no log is named 'drvie'" in ended.lines[0]


class TestWrittenExperiment:
    def test_runs_as_it_is_and_gives_the_same(self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        drive(here / "a/drive.mcap")
        (here / "store").mkdir()
        drive(here / "store/7.mcap")
        (here / "link.mcap").symlink_to("store/7.mcap")
        (here / "b").mkdir()
        (here / "b/drive.mcap").touch()  # skipped: and then two logs are called drive, not three
        (here / "e.yaml").write_text(changed("logs: [drive.mcap, a/drive.mcap, b/drive.mcap, link.mcap]"))
        assert call("run", "e.yaml", "--seed", "9", "--runs", "5", "--ego", "1", "--skip-unreadable").code == 1
        folder = here / "out/e"
        monkeypatch.chdir(folder)
        assert call("run", "experiment.yaml", "--out", here / "again").code == 0
        first, again = written(folder), written(here / "again")
        assert first["detections.parquet"] == again["detections.parquet"]
        assert first["summary.csv"] == again["summary.csv"]
        assert list(dict.fromkeys(table(folder)["log"])) == [f"{here.name}/drive", "a/drive", "link"]

    def test_holds_every_default_and_nothing_of_the_host(self, here: Path, call: Call) -> None:
        assert call("run", "e.yaml", "--jobs", "2").code == 0
        text = (here / "out/e/experiment.yaml").read_text()
        data, _, _ = plain_yaml.parse_yaml(text)
        assert data["logs"] == ["../../drive.mcap"]
        assert data["units"]["ego"] == {
            "on": "ego", "at": None, "offset_m": [0.0, 0.0], "yaw_deg": 0.0, "height_m": 1.8, "ground_z_m": None,
            "pem": "onboard", "recorded": None, "rate_hz": None, "phase_s": 0.0,
        }  # fmt: skip
        assert data["measure"]["confirm"] == {"hits": 1, "of": 1}
        assert data["measure"]["match"] == {"gate_m": 3.0}
        assert data["measure"]["gospa"] == {"cutoff_m": None, "power": 2.0}
        assert data["measure"]["accuracy"] is True
        assert data["configurations"]["PEM"]["fusion"] == {"kind": "ideal", "combine": "samples"}
        assert "jobs" not in text
        assert str(here) not in "".join(map(str, written(here / "out/e").values()))

    def test_may_be_replaced_by_its_own_results(self, ran: Path, call: Call) -> None:
        before = written(ran)
        assert call("run", "out/e/experiment.yaml", "--out", "out/e", "--overwrite").code == 0
        assert written(ran) == before

    def test_two_runs_give_the_same_bytes(self, here: Path, call: Call) -> None:
        for out in ("one", "two"):
            assert call("run", "e.yaml", "--out", out).code == 0
        assert written(here / "one") == written(here / "two")


class TestCompare:
    @pytest.fixture
    def fused(self, here: Path, call: Call) -> Path:
        """Results of ideal fusion and of none at all."""
        (here / "e.yaml").write_text(changed("  PEM: {units: all, latency_s: 0.5, fusion: {kind: union}}"))
        assert call("run", "e.yaml", "--seed", "2").code == 0
        return here

    def test_prints_what_the_library_finds(self, fused: Path, call: Call) -> None:
        found = compare_folders([fused / "out/e"], baseline="coPEM")
        assert found.configurations == ("GT", "PEM")
        ended = call("compare", "out/e", "--baseline", "coPEM", "--explain")
        assert ended.code == 0
        words = comparison_text(found).split()
        assert ended.out.split()[: len(words)] == words  # then the answer, in a sentence
        assert ended.lines == [f"note: {note}" for note in found.notes]

    def test_of_some_configurations_into_a_file(self, fused: Path, call: Call) -> None:
        options = ["--baseline", "coPEM", "--configurations", "PEM", "--false-positives-per-min", "3"]
        found = compare_folders(
            [fused / "out/e"], baseline="coPEM", configurations=["PEM"], false_positives_per_min=3.0
        )
        for name in ("c.csv", "c.md"):
            ended = call("compare", "out/e", *options, "--out", name)
            assert ended.code == 0
            assert f"written to {name}\n" in ended.out
        kept = pd.read_csv(fused / "c.csv")
        assert kept["metric"].tolist() == found.table["metric"].tolist()
        assert kept["difference"].to_numpy() == pytest.approx(found.table["difference"].to_numpy(), nan_ok=True)
        assert set(kept["configuration"]) == {"PEM"}
        assert "ttd_rmst_s_equal_ghosts" in set(kept["metric"])
        assert (fused / "c.md").read_text() == comparison_markdown(found)

    def test_of_two_folders(self, fused: Path, call: Call) -> None:
        assert call("run", "e.yaml", "--seed", "2", "--out", "other").code == 0
        options = ["--baseline", "e:coPEM", "--configurations", "e:PEM, other:PEM", "--explain"]
        ended = call("compare", "out/e", "other", *options)
        assert ended.code == 0
        first, other = ([line.split()[1:] for line in ended.out.splitlines() if line.startswith(name)]
                        for name in ("e:PEM ", "other:PEM "))  # fmt: skip
        assert first == other != []

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (["nowhere"], "nowhere: expected a results folder, found no such folder; `copem-replay run` writes one"),
            (["e.yaml"], "e.yaml: expected a results folder, found a file; `copem-replay run` writes one"),
            (["."], ".: expected a results folder, found no provenance.json in it; `copem-replay run` writes one"),
            (["out/e", "--baseline", "coPEN"], "no configuration is named 'coPEN'; did you mean coPEM?"),
            (["out/e", "--baseline", "GT", "--configurations", "PEN"], "no configuration is named 'PEN'"),
            (["out/e", "--baseline", "GT", "--out", "c.txt"], "c.txt: expected a name that ends with .csv or .md"),
        ],
    )
    def test_what_cannot_be_compared(self, fused: Path, call: Call, arguments: list[str], said: str) -> None:
        ended = call("compare", *arguments)
        assert (ended.code, ended.out) == (2, "")
        (line,) = ended.lines
        assert said in line
        assert not (fused / "c.txt").exists()

    def test_other_seeds_are_no_pairs(self, fused: Path, call: Call) -> None:
        assert call("run", "e.yaml", "--seed", "3", "--out", "other").code == 0
        ended = call("compare", "out/e", "other", "--baseline", "e:coPEM")
        assert (ended.code, ended.out) == (2, "")
        assert any("seed" in line for line in ended.lines)


class TestNamesOfConfigurations:
    """Names that spreadsheets, Markdown and HTML read as something else go through all commands as they are."""

    NAMES = ("=1+1", "-x", "+y", "@SUM(A1)", "'q", "''", "<b>*_|&amp;")

    @pytest.fixture
    def odd(self, here: Path, call: Call) -> Path:
        data = plain_yaml.parse_yaml(TEXT)[0]
        data["configurations"] = {name: {"units": ["ego"], "latency_s": 0.1 * k} for k, name in enumerate(self.NAMES)}
        data["sweep"] = {"latency_s": [0.0, 0.5], "configurations": list(self.NAMES[:4])}
        (here / "e.yaml").write_text(plain_yaml.dump_yaml(data))
        assert call("run", "e.yaml").code == 0
        return here

    def test_no_cell_is_a_formula(self, odd: Path, call: Call) -> None:
        assert call("compare", "out/e", "--baseline=-x", "--out", "c.csv").code == 0
        for path in (odd / "out/e/summary.csv", odd / "out/e/sweep.csv", odd / "out/e/bands.csv", odd / "c.csv"):
            with path.open(newline="") as file:
                cells = [cell for row in csv.reader(file) for cell in row]
            begin = [cell for cell in cells if cell.startswith(("=", "+", "-", "@", "\t", "\r"))]
            assert all(math.isfinite(float(cell)) for cell in begin), path
            assert "'=1+1" in cells, path

    def test_they_are_read_as_they_were(self, odd: Path, call: Call) -> None:
        found = read_results(odd / "out/e")
        assert tuple(found.summary["configuration"]) == self.NAMES
        assert found.sweep is not None
        assert set(found.sweep["configuration"]) == {"=1+1"}, "at one latency the others are as this one"
        for name in self.NAMES:
            ended = call("compare", "out/e", f"--baseline={name}", "--explain")
            assert ended.code == 0
            assert [line.split()[0] for line in ended.out.splitlines()[1:7]] == [n for n in self.NAMES if n != name]
        assert call("report", "out/e", "--baseline==1+1").code == 0
        page = (odd / "out/e/report.html").read_text()
        assert "<b>*" not in page
        assert "&lt;b&gt;*_|&amp;amp;" in page
        ended = call("plot", "out/e", "--configurations", ",".join(self.NAMES[:5]))
        assert (ended.code, [line for line in ended.lines if "expected" in line]) == (0, [])


class TestTarget:
    def test_results_are_not_replaced_unasked(self, here: Path, ran: Path, call: Call) -> None:
        before = written(ran)
        ended = call("run", "e.yaml", "--seed", "5")
        assert ended.code == 2
        assert ended.lines == [
            "out/e: results are there already; --overwrite replaces them, --out chooses another folder"
        ]
        assert written(here / "out/e") == before
        assert call("run", "e.yaml", "--seed", "5", "--overwrite").code == 0
        assert written(here / "out/e") != before
        assert os.listdir(here / "out") == ["e"]

    def test_overwrite_where_there_is_nothing(self, here: Path, call: Call) -> None:
        assert call("run", "e.yaml", "--overwrite").code == 0

    def test_nothing_of_the_old_results_is_left(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(changed("show: {run: 0}"))
        assert call("run", "e.yaml").code == 0
        assert (here / "out/e/replay.mcap").exists()
        (here / "e.yaml").write_text(TEXT)
        assert call("run", "e.yaml", "--overwrite").code == 0
        assert not (here / "out/e/replay.mcap").exists()

    def test_a_folder_of_other_things_is_never_replaced(self, here: Path, call: Call) -> None:
        (here / "mine").mkdir()
        (here / "mine/thesis.tex").write_text("x")
        ended = call("run", "e.yaml", "--out", "mine", "--overwrite")
        assert ended == (2, "", ["mine: not empty and no results folder; choose another with --out"])
        assert os.listdir(here / "mine") == ["thesis.tex"]

    def test_an_empty_folder_is_filled(self, here: Path, call: Call) -> None:
        (here / "mine").mkdir()
        assert call("run", "e.yaml", "--out", "mine").code == 0

    @pytest.mark.parametrize(
        ("out", "said"),
        [
            ("e.yaml", "--out: expected another name, found that of an input of this command: e.yaml"),
            ("e.yaml/x", "e.yaml/x: cannot be written: {here}/e.yaml is a file"),
            ("e.yaml/x/y", "e.yaml/x/y: cannot be written: {here}/e.yaml is a file"),
            (".", ".: not empty and no results folder; choose another with --out"),
            ("..", "..: not empty and no results folder; choose another with --out"),
            ("", ".: not empty and no results folder; choose another with --out"),
            ("/", "/: not empty and no results folder; choose another with --out"),
            ("x" * 300, "x" * 300 + ": cannot be written: File name too long"),
            ("x" * 256 + "/e", "x" * 256 + "/e: cannot be written: File name too long"),
            ("loop", "loop: cannot be written: Too many levels of symbolic links"),
            ("loop/e", "loop/e: cannot be written: Too many levels of symbolic links"),
            ("x/" * 2000, "x/" * 1999 + "x: cannot be written: its whole path has more than 3496 bytes"),
            (
                "o\udcff",
                "o\\udcff: cannot be written: expected a path in UTF-8, found other bytes; choose another with --out",
            ),
            ("/proc/x", "/proc/x: cannot be written: No such file or directory"),
        ],
    )
    def test_where_nothing_can_be_written(
        self, here: Path, call: Call, out: str, said: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Said before anything is replayed."""
        monkeypatch.setattr(gather, "replay_outcomes", raising(AssertionError("replayed")))
        (here / "loop").symlink_to("pool")
        (here / "pool").symlink_to("loop")
        before = sorted(os.listdir(here))
        ended = call("run", "e.yaml", "--out", out, "--overwrite")
        assert ended == (2, "", [said.format(here=here)])
        assert sorted(os.listdir(here)) == before

    def test_the_folder_we_are_in(self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        """It would be gone under the feet of the shell."""
        (here / "r/sub").mkdir(parents=True)
        monkeypatch.chdir(here / "r/sub")
        ended = call("run", "../../e.yaml", "--out", ".")
        assert ended.lines == [".: cannot be replaced, being in use or a mount point; choose a folder in it"]
        assert (here / "r/sub").exists()

    def test_a_mount_point(self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        (here / "out").mkdir()
        monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == here / "out")
        ended = call("run", "e.yaml", "--out", "out")
        assert ended.lines == ["out: cannot be replaced, being in use or a mount point; choose a folder in it"]
        assert call("run", "e.yaml", "--out", "out/e").code == 0

    def test_no_permission(self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        """Said before anything is replayed."""
        access = os.access

        def locked(path: Any, mode: int) -> bool:
            return access(path, mode) and not (mode & os.W_OK and Path(path).name == "locked")

        monkeypatch.setattr(os, "access", locked)
        (here / "locked").mkdir()
        ended = call("run", "e.yaml", "--out", "locked")
        assert ended.lines == ["locked: cannot be written: no permission to replace what is in it"]
        ended = call("run", "e.yaml", "--out", "locked/a/b")
        assert ended.lines == [f"locked/a/b: cannot be written: no permission to write in {here}/locked"]

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
    def test_read_only_folder(self, here: Path, call: Call) -> None:
        (here / "locked").mkdir(mode=0o555)
        ended = call("run", "e.yaml", "--out", "locked/e")
        assert ended.lines == [f"locked/e: cannot be written: no permission to write in {here}/locked"]

    def test_results_are_for_all_that_may_read_the_folder(self, here: Path, call: Call) -> None:
        before = os.umask(0o022)
        try:
            (here / "e.yaml").write_text(changed("show: {run: 0}"))
            assert call("run", "e.yaml").code == 0
        finally:
            os.umask(before)
        assert (here / "out/e").stat().st_mode & 0o777 == 0o755
        assert {path.stat().st_mode & 0o777 for path in (here / "out/e").iterdir()} == {0o644}

    def test_a_link_is_followed(self, here: Path, call: Call) -> None:
        (here / "disk").mkdir()
        (here / "out").symlink_to("disk/results")
        assert call("run", "e.yaml", "--out", "out").code == 0
        assert (here / "out").is_symlink()
        assert (here / "disk/results/provenance.json").exists()
        assert call("run", "e.yaml", "--out", "out", "--overwrite").code == 0
        assert (here / "out").is_symlink()
        assert os.listdir(here / "disk") == ["results"]
        assert call("run", "out/experiment.yaml", "--out", "again").code == 0

    def test_a_log_is_not_replaced_by_its_own_results(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(changed("show: {run: 0}"))
        assert call("run", "e.yaml").code == 0
        before = written(here / "out/e")
        ended = call("run", "e.yaml", "--log", "out/e/replay.mcap", "--overwrite")
        assert ended.code == 2
        assert ended.lines == [
            "out/e: out/e/replay.mcap is in this folder and would be removed; choose another folder with --out"
        ]
        assert written(here / "out/e") == before
        assert call("run", "e.yaml", "--log", "out/e/replay.mcap", "--out", "out/f").code == 0


class Failure(NamedTuple):
    error: BaseException
    code: int
    line: str


DEFECT = "copem-replay: internal error; please report it with the lines above"
DISK = OSError(errno.ENOSPC, "No space left on device")
FAILURES = [
    Failure(DISK, 2, "out/e: cannot be written: No space left on device"),
    Failure(
        OSError(errno.ENOSPC, "Error writing bytes to file. Detail: [errno 28] No space left on device"),  # of Arrow
        2,
        "out/e: cannot be written: No space left on device",
    ),
    Failure(RuntimeError("oops"), 70, DEFECT),
    Failure(KeyboardInterrupt(), 130, "interrupted"),
    Failure(MemoryError(), 2, "copem-replay: not enough memory; take fewer runs, units or objects at a time"),
]


class TestFailure:
    """Whatever goes wrong, at whatever point: the old results stay as they were, and nothing else is left."""

    @pytest.fixture(params=[False, True], ids=["first", "overwrite"])
    def arguments(self, request: pytest.FixtureRequest, here: Path, call: Call) -> list[str]:
        if request.param:
            request.getfixturevalue("ran")
        return ["run", "e.yaml", "--seed", "5", *(["--overwrite"] if request.param else [])]

    def fails(self, here: Path, call: Call, arguments: list[str], failure: Failure) -> None:
        before = written(here)
        ended = call(*arguments)
        assert ended.code == failure.code
        assert ended.lines[-1] == failure.line.format(here=here)
        assert len(ended.lines) == 1 or ended.code == 70
        assert written(here) == before
        left = os.listdir(here / "out") if (here / "out").exists() else []
        assert left == (["e"] if "--overwrite" in arguments else [])

    @pytest.mark.parametrize("failure", FAILURES, ids=[type(f.error).__name__ for f in FAILURES])
    @pytest.mark.parametrize("step", ["write_csv", "build_provenance"])
    def test_while_writing(
        self, here: Path, call: Call, arguments: list[str], failure: Failure, step: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(results, step, raising(failure.error))
        self.fails(here, call, arguments, failure)

    @pytest.mark.parametrize("failure", FAILURES[2:], ids=[type(f.error).__name__ for f in FAILURES[2:]])
    def test_while_replaying(
        self, here: Path, call: Call, arguments: list[str], failure: Failure, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(gather, "replay_outcomes", raising(failure.error))
        self.fails(here, call, arguments, failure)

    @pytest.mark.parametrize("failure", FAILURES, ids=[type(f.error).__name__ for f in FAILURES])
    def test_while_giving_the_folder_its_name(
        self, here: Path, call: Call, arguments: list[str], failure: Failure, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The old folder is moved away, then the new one to its name: each of the steps fails."""
        rename = os.rename
        for step in range(2 if "--overwrite" in arguments else 1):
            count = iter(range(9))

            def fails(source: Any, target: Any, step: int = step, count: Iterator[int] = count) -> None:
                if next(count) == step:
                    raise failure.error
                rename(source, target)

            monkeypatch.setattr(os, "rename", fails)
            self.fails(here, call, arguments, failure)

    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
    def test_termination_is_a_failure_like_any_other(
        self, here: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
    ) -> None:
        monkeypatch.setattr(results, "write_csv", lambda *_: os.kill(os.getpid(), number))
        before = signal.signal(number, signal.SIG_DFL)  # what is ignored from the start, as under nohup, stays so
        try:
            with pytest.raises(SystemExit) as ended:
                self.main(here, monkeypatch)
        finally:
            signal.signal(number, before)
        assert ended.value.code == 128 + number
        assert sorted(os.listdir(here)) == ["drive.mcap", "e.yaml"]

    def test_a_terminal_that_goes_does_not_end_what_was_told_to_go_on(
        self, here: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """`nohup copem-replay run …`."""

        write = results.write_csv

        def go(table: pd.DataFrame, path: Path) -> None:
            write(table, path)
            os.kill(os.getpid(), signal.SIGHUP)

        monkeypatch.setattr(results, "write_csv", go)
        previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        try:
            with pytest.raises(SystemExit) as ended:
                self.main(here, monkeypatch)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        finally:
            signal.signal(signal.SIGHUP, previous)
        assert ended.value.code == 0
        assert (here / "out/e/provenance.json").exists()

    def main(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
        monkeypatch.chdir(here)
        monkeypatch.setattr(sys, "argv", ["copem-replay", "run", "e.yaml"])
        try:
            cli.main()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def test_a_defect_shows_where_it_is(self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(
            "copem_replay.experiment.draft.survey.survey_recording", raising(ZeroDivisionError("division by zero"))
        )
        ended = call("info", "drive.mcap")
        assert ended.code == 70
        assert ended.lines[0] == "Traceback (most recent call last):"
        assert "ZeroDivisionError: division by zero" in ended.lines

    def test_a_log_that_vanishes(self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        """A recording that is gone when its checksum is taken: no results, and the reason in a line."""
        digest = study_log.sha256_of
        monkeypatch.setattr(study_log, "sha256_of", lambda at: [at.unlink(), digest(at)][1])
        ended = call("run", "e.yaml")
        assert ended.code == 2
        assert len(ended.lines) == 1
        assert not (here / "out").exists()


def raising(error: BaseException) -> Callable[..., None]:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    return fail


class TestView:
    @pytest.fixture
    def viewer(self, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
        """A viewer that writes down what it is asked to open, and ends as VIEWER_ENDS says."""
        folder = tmp_path_factory.mktemp("viewer")
        (folder / "rerun.py").write_text(
            "import json, os, sys\nfrom pathlib import Path\n"
            "Path(__file__).with_name('asked.json').write_text(json.dumps(sys.argv[1:]))\n"
            "sys.exit(int(os.environ.get('VIEWER_ENDS', 0)))\n"
        )
        monkeypatch.setenv("PYTHONPATH", str(folder))
        return folder / "asked.json"

    def test_opens_the_recording(self, tmp_path: Path, call: Call, viewer: Path) -> None:
        (tmp_path / "-r").mkdir()
        (tmp_path / "-r/replay.rrd").touch()
        assert call("view", "--", "-r") == (0, "", [])
        asked = json.loads(viewer.read_text())
        assert asked[-1:] == [str(tmp_path / "-r/replay.rrd")]
        assert asked[:3] == ["--bind", "127.0.0.1", "--port"]

    def test_opens_all_recordings(self, tmp_path: Path, call: Call, viewer: Path) -> None:
        names = ("replay/a/c", "replay/b", "replay/b.configurations_7-12", "replay_worst/a/c", "replay_worst/b")
        for name in (*reversed(names), "figures/c"):
            (tmp_path / "r" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "r" / f"{name}.rrd").touch()
        assert call("view", "r").code == 0
        asked = json.loads(viewer.read_text())[4:]
        assert asked == [str(tmp_path / f"r/{name}.rrd") for name in reversed(names)], "the first is shown: opened last"

    def test_opens_all_runs(self, tmp_path: Path, call: Call, viewer: Path) -> None:
        names = ("replay", "replay.configurations_7-12", "replay_7", "replay_worst")
        for name in (*reversed(names), "compared"):
            (tmp_path / f"{name}.rrd").touch()
        assert call("view", ".").code == 0
        assert json.loads(viewer.read_text())[4:] == [str(tmp_path / f"{name}.rrd") for name in reversed(names)]

    def test_opens_a_file(self, tmp_path: Path, call: Call, viewer: Path) -> None:
        (tmp_path / "any.rrd").touch()
        assert call("view", "any.rrd") == (0, "", [])
        assert json.loads(viewer.read_text())[4:] == [str(tmp_path / "any.rrd")]

    def test_opens_a_run_of_the_draft_of_a_recording(self, here: Path, call: Call, viewer: Path) -> None:
        drive(here / "drive.mcap")
        ended = call("view", "drive.mcap")
        assert ended.code == 0
        assert ended.lines[-1] == (
            "note: drive.mcap: one run of the draft of `init`; `copem-replay run drive.mcap` keeps results"
        )
        [opened] = json.loads(viewer.read_text())[4:]
        assert Path(opened).name == "replay.rrd"
        assert not Path(opened).exists(), "it is gone with the viewer"

    def test_viewer_that_fails(self, tmp_path: Path, call: Call, viewer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "replay.rrd").touch()
        monkeypatch.setenv("VIEWER_ENDS", "3")
        ended = call("view", ".")
        assert ended.code == 2
        (line,) = ended.lines
        assert line.startswith(".: the Rerun viewer could not be opened (it ended with 3); without a display, ")

    @pytest.mark.parametrize(
        ("folder", "said"),
        [
            (".", ".: no replay.rrd in this folder; `show: {run: 0}` in an experiment writes one"),
            ("none", "none: no such folder"),
            ("file", "file: no such folder"),
            ("drive.mcap", "drive.mcap: no such file"),
        ],
    )
    def test_nothing_to_open(self, tmp_path: Path, call: Call, viewer: Path, folder: str, said: str) -> None:
        (tmp_path / "file").touch()
        assert call("view", folder) == (2, "", [said])
        assert not viewer.exists()

    def test_interrupt(self, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "replay.rrd").touch()
        monkeypatch.setattr(subprocess, "Popen", raising(KeyboardInterrupt()))
        assert call("view", ".") == (130, "", ["interrupted"])


class TestSamples:
    def test_runs_elsewhere(self, tmp_path: Path, call: Call) -> None:
        assert call("samples") == (0, "15 files in logs\nnext: copem-replay run logs/tc016d.yaml\n", [])
        for path in (ROOT / "logs").iterdir():
            assert (tmp_path / "logs" / path.name).read_bytes() == path.read_bytes()
        assert call("check", "logs/tc016d.yaml").code == 0

    def test_no_file_is_replaced(self, tmp_path: Path, call: Call) -> None:
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine/tc016d.yaml").write_text("mine")
        said = "mine/tc016d.yaml: expected no such file, found one; samples FOLDER names another folder"
        assert call("samples", "mine") == (2, "", [said])
        assert [path.read_text() for path in (tmp_path / "mine").iterdir()] == ["mine"]


class TestSchema:
    @pytest.fixture
    def schema(self, call: Call) -> dict[str, Any]:
        ended = call("schema")
        assert ended.code == 0
        assert ended.lines == []
        found: dict[str, Any] = json.loads(ended.out)
        return found

    def test_says_what_it_is(self, schema: dict[str, Any]) -> None:
        assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
        assert schema["type"] == "object"

    @pytest.mark.parametrize("file", sorted(path.name for path in (ROOT / "logs").glob("*.yaml")))
    def test_accepts_the_samples(self, schema: dict[str, Any], file: str) -> None:
        source = read_experiment_file(ROOT / "logs" / file)
        assert list(wrong(source.data, schema, schema)) == []

    def test_accepts_what_is_written(self, schema: dict[str, Any], here: Path) -> None:
        text = changed("ego: 1", "measure: {objects: {ids: [2, '3']}}", "show: {logs: [first], run: median}")
        (here / "e.yaml").write_text(text)
        experiment, problems = parse_experiment(read_experiment_file(here / "e.yaml"))
        assert problems == []
        assert experiment is not None
        assert list(wrong(experiment.as_written(), schema, schema)) == []
        assert list(wrong(read_experiment_file(here / "e.yaml").data, schema, schema)) == []

    @pytest.mark.parametrize(
        "change",
        [
            "unit: {}",
            "version: 2",
            "runs: 0",
            "runs: yes",
            "logs: []",
            "      detection: {kind: sure}",
            "      detection: {kind: constant}",
            "      detection: {kind: constant, probability: 2}",
            "      error: {kind: gaussian, covariance_m2: [1, 2]}",
            "  ego: {on: ego, height_m: x, pem: onboard}",
            "  PEM: {units: ego}",
            "  PEM: {units: all, latency_s: -1}",
            "measure: {onset: {kind: soon}}",
            "measure: {onset: {kind: in_range, range_m: 0}}",
            "measure: {onset: {kind: starts_moving, from_: front}}",
            "show: {run: mean}",
            "show: {run: [best, mean]}",
            "show: {run: []}",
        ],
    )
    def test_refuses(self, schema: dict[str, Any], here: Path, change: str) -> None:
        (here / "e.yaml").write_text(changed(change))
        assert list(wrong(read_experiment_file(here / "e.yaml").data, schema, schema)) != []


TYPES: dict[str, Callable[[Any], bool]] = {
    "object": lambda v: isinstance(v, dict),
    "array": lambda v: isinstance(v, list),
    "string": lambda v: isinstance(v, str),
    "boolean": lambda v: isinstance(v, bool),
    "null": lambda v: v is None,
    "integer": lambda v: isinstance(v, int) and not isinstance(v, bool),
    "number": lambda v: isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v),
}


def wrong(value: Any, schema: Any, root: dict[str, Any]) -> Iterator[str]:
    """What of a value a JSON Schema refuses: as much of the standard as the schema uses, and nothing else in it."""
    annotations = {"title", "description", "default", "$defs", "$schema", "discriminator"}
    for word, rule in schema.items():
        if word in annotations:
            continue
        if word == "$ref":
            yield from wrong(value, root["$defs"][rule.removeprefix("#/$defs/")], root)
        elif word == "type":
            if not any(TYPES[name](value) for name in ([rule] if isinstance(rule, str) else rule)):
                yield f"{value!r}: not {rule}"
        elif word == "const":
            if value != rule:
                yield f"{value!r}: not {rule}"
        elif word == "enum":
            if value not in rule:
                yield f"{value!r}: none of {rule}"
        elif word in ("anyOf", "oneOf"):
            if not any(list(wrong(value, one, root)) == [] for one in rule):
                yield f"{value!r}: no alternative fits"
        elif isinstance(value, dict):
            if word == "required":
                yield from (f"{name}: missing" for name in rule if name not in value)
            elif word == "properties":
                for name in rule.keys() & value.keys():
                    yield from wrong(value[name], rule[name], root)
            elif word == "additionalProperties":
                for name in value.keys() - schema.get("properties", {}).keys():
                    yield from wrong(value[name], rule, root) if isinstance(rule, dict) else [f"{name}: not known"]
            elif word == "minProperties":
                yield from ["too few"] * (len(value) < rule)
        elif isinstance(value, list):
            if word == "items":
                for item in value:
                    yield from wrong(item, rule, root)
            elif word == "prefixItems":
                for item, one in zip(value, rule, strict=False):
                    yield from wrong(item, one, root)
            elif word in ("minItems", "maxItems"):
                yield from ["too few"] * (word == "minItems" and len(value) < rule)
                yield from ["too many"] * (word == "maxItems" and len(value) > rule)
        elif isinstance(value, str):
            if word == "pattern":
                yield from ["no match"] * (rule not in value)
        elif isinstance(value, int | float):
            fine = {
                "minimum": lambda v, r: v >= r,
                "maximum": lambda v, r: v <= r,
                "exclusiveMinimum": lambda v, r: v > r,
            }
            yield from [] if word not in fine or fine[word](value, rule) else [f"{value}: {word} {rule}"]


EXTREMES = [
    "  coPEM: {units: all, latency_s: 86400}",
    "  coPEM: {units: all, latency_s: 1e-300, max_age_s: 1e-300}",
    "  coPEM: {units: all, max_age_s: 1e12}",
    "  mast: {at: [1e12, -1e12], height_m: 1e12, pem: onboard}",
    "  mast: {at: [0, 0], height_m: 0, pem: onboard, ground_z_m: -1e12, yaw_deg: 1e12}",
    "  mast: {at: [0, 0], height_m: 1, pem: onboard, rate_hz: 1000, phase_s: 1e12}",
    "  mast: {at: [0, 0], height_m: 1, pem: onboard, rate_hz: 0.001}",
    "  mast: {at: [0, 0], height_m: 1, pem: onboard, rate_hz: 999.9, phase_s: 1e-300}",
    "  ego: {on: ego, height_m: 1, pem: onboard, offset_m: [1e12, -1e12]}",
    "    - when: {range_m: [0, 1e12], azimuth_deg: [-360, 360], visible_share: [1, 1]}",
    "      error: {kind: gaussian, covariance_m2: [[1e12, 0], [0, 1e12]], mean_m: [1e12, 1e12]}",
    "      error: {kind: gaussian, covariance_m2: [[1e-300, 0], [0, 0]], yaw_sigma_deg: 1e12}",
    "      error: {kind: gaussian, covariance_m2: [[0, 0], [0, 0]], speed_sigma_mps: 1e12}",
    "      error: {kind: gaussian, covariance_m2: [[1, 0], [0, 1]], size_sigma_m: 1e12}",
    "measure: {onset: {kind: in_range, range_m: 1e12}, began: [log_start, crossed, appeared]"
    ", horizon_s: 1e12, confirm: {hits: 1000, of: 1000}}",
    "measure: {onset: {kind: in_range, range_m: 1e12}, began: [log_start, crossed, appeared], horizon_s: 1e-300}",
    "measure: {onset: {kind: at, time_s: 1e12}}",
    "measure: {onset: {kind: starts_moving, speed_mps: 1e-300, within_m: 1e12}, began: [log_start]}",
    "max_gap_s: 1e12",
    "max_gap_s: 1e-300",
    "obstacles: [{polygon_m: [[-1e12, -1e12], [1e12, -1e12], [0, 1e12]], height_m: 1e12, ground_z_m: 1e12}]",
    "obstacles: [{polygon_m: [[0, 0], [1e-9, 0], [0, 1e-9]], height_m: 1e-300}]",
]
SEEN = {"  mast", "  ego:", "    - ", "obstac"}
"""How those begin that say who sees what: the others are all one to what hides."""


class TestExtremes:
    """Numbers that are allowed, and that nobody needs: no warning, no traceback."""

    @pytest.mark.parametrize(
        ("visibility", "change"),
        [
            *(("surface", change) for change in EXTREMES),
            *(("flat", change) for change in EXTREMES if change[:6] in SEEN),
        ],
    )
    def test_run(self, here: Path, call: Call, change: str, visibility: str) -> None:
        (here / "e.yaml").write_text(changed(change, "show: {run: 0}", f"visibility: {visibility}"))
        ended = call("run", "e.yaml")
        assert ended.code == 0, ended.lines

    def test_recording_of_one_instant(self, here: Path, call: Call) -> None:
        write_recording(here / "drive.mcap", [(0.0, [Obj(id=1), Obj(id=2, x=5.0)])], host=1)
        (here / "e.yaml").write_text(changed(ALL_COUNT, "show: {run: 0}"))
        assert call("run", "e.yaml").code == 0
