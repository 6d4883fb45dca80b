"""The place of a results folder: one writer, nothing lost that is not ours, nothing piling up."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from copem_replay.core import files as scratch
from copem_replay.core.errors import OutputError
from copem_replay.core.files import atomic_file
from copem_replay.pipeline import run as gather
from copem_replay.pipeline import run as runs
from copem_replay.results import folder as belongings
from copem_replay.results import folder as lock
from copem_replay.results import folder as place
from tests.helpers.experiments import TEXT, changed, drive
from tests.system.test_cli import ROOT, Call, Ended, call, here, installed, made_once, ran, written

__all__ = ["call", "here", "made_once", "ran"]  # fixtures

SHOWN = changed("show: {run: 0}")


@pytest.fixture
def old(ran: Path) -> Path:
    """Results of seed 1, with files in it that are the user's."""
    folder = ran
    (folder / "notes.txt").write_text("mine\n")
    (folder / "figures/more").mkdir(parents=True)
    (folder / "figures/more/mine.svg").write_text("<svg/>")
    (folder / "figures/runs.png").write_text("of the old results")
    (folder / "report.html").write_text("of the old results")
    belongings.add_to_made_list(
        folder, [folder / "figures/runs.png", folder / "report.html"]
    )  # as `plot` and `report` do
    (folder / "empty").mkdir()
    (folder / "link").symlink_to("../../drive.mcap")
    return folder


MINE = {"notes.txt", "figures/more/mine.svg", "empty", "link"}


def again(call: Call, *more: str) -> Ended:
    return call("run", "e.yaml", "--seed", "5", "--overwrite", *more)


def raises(error: int) -> Callable[..., None]:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError(error, os.strerror(error))

    return fail


def before_it_is_replaced(monkeypatch: pytest.MonkeyPatch, folder: Path, do: Callable[[], object]) -> None:
    """Do something at the last instant before a folder loses its name."""
    rename = os.rename

    def renamed(source: Path, target: Path) -> None:
        if source == folder:
            do()
        rename(source, target)

    monkeypatch.setattr(os, "rename", renamed)


class TestOthers:
    """What is not ours stays, and what is goes."""

    def test_the_list_is_what_is_written(self, here: Path, call: Call) -> None:
        for show in ("{logs: [all], run: [worst, 1]}", "null"):
            (here / "e.yaml").write_text(changed(f"show: {show}", "sweep: {latency_s: [0, 0.2]}"))
            drive(here / "b/drive.mcap")
            assert call("run", "e.yaml", "--log", "drive.mcap", "--log", "b/drive.mcap", "--overwrite").code == 0
            out = here / "out/e"
            names = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
            assert json.loads((out / "provenance.json").read_text())["files"] == sorted(names - {"made.jsonl"})
            assert belongings.read_made(out).keys() == {"made.jsonl"} | {one for one in names if one.endswith(".rrd")}

    @pytest.mark.parametrize("links", [True, False])
    def test_stays(self, old: Path, call: Call, monkeypatch: pytest.MonkeyPatch, links: bool) -> None:
        if not links:
            monkeypatch.setattr(os, "link", raises(errno.EPERM))
        before = written(old)
        inode = (old / "notes.txt").stat().st_ino
        assert again(call).lines == []
        assert set(belongings.list_names(old)) == MINE | set(json.loads(before["provenance.json"])["files"])
        assert (old / "notes.txt").read_text() == "mine\n"
        assert (old / "notes.txt").stat().st_ino == inode  # linked, else moved
        assert os.readlink(old / "link") == "../../drive.mcap"
        assert written(old)["provenance.json"] != before["provenance.json"]
        assert os.listdir(old.parent) == ["e"]

    @pytest.mark.parametrize("text", [None, '"verdic', "null"])
    def test_with_a_damaged_list_of_what_was_made_leaves_nothing_behind(
        self, here: Path, call: Call, text: str | None
    ) -> None:
        """The verdicts of before count as the user's then, and are replaced by those of the new results."""
        (here / "e.yaml").write_text(changed("criteria: {known: {metric: detected_share, at_least: 0}}"))
        call("run", "e.yaml")
        made = here / "out/e/made.jsonl"
        assert made.read_text() == '"verdicts.jsonl"\n'
        made.unlink()
        if text is not None:
            made.write_text(text)
        again(call)
        assert (os.listdir(here / "out"), made.read_text()) == (["e"], '"verdicts.jsonl"\n')

    @pytest.mark.parametrize(("name", "taken"), [("sweep.csv", "sweep.csv"), ("replay.rrd/x", "replay.rrd/x")])
    def test_of_one_name_with_new_results_is_refused_before_the_replay(
        self, old: Path, call: Call, monkeypatch: pytest.MonkeyPatch, name: str, taken: str
    ) -> None:
        """`sweep.csv` of the user's, then a sweep; a folder of the user's where a run will be shown."""
        (old / name).parent.mkdir(exist_ok=True)
        (old / name).write_text("mine\n")
        before = written(old)
        (old.parents[1] / "e.yaml").write_text(changed("sweep: {latency_s: [0, 0.2]}", "show: {run: 0}"))
        monkeypatch.setattr(runs, "run_experiment", raises(errno.EIO))
        out = "move it elsewhere, or choose another folder with --out"
        line = f"out/e/{taken}: the results will have a file of that name; {out}"
        assert again(call) == (2, "", [line])
        assert written(old) == before

    def test_of_one_name_with_new_results_that_comes_during_the_run(
        self, old: Path, call: Call, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        replay = runs.run_experiment

        def meanwhile(*a: Any, **k: Any) -> Any:
            (old / "sweep.csv").write_text("mine\n")
            return replay(*a, **k)

        (old.parents[1] / "e.yaml").write_text(changed("sweep: {latency_s: [0, 0.2]}"))
        monkeypatch.setattr(runs, "run_experiment", meanwhile)
        said = f"other content came there during the run and is kept; the results of this run are in {old}-2"
        assert again(call).lines == [f"note: out/e: {said}"]
        assert (old / "sweep.csv").read_text() == "mine\n"
        assert (old.parent / "e-2/sweep.csv").read_text().startswith("sweep,value")

    def test_that_can_be_neither_linked_nor_moved(self, old: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        """It is not lost, and it is said where it is."""
        rename = os.rename

        def refused(source: Path, target: Path) -> None:
            if Path(source).name == "mine.svg":
                raise PermissionError(errno.EACCES, "Permission denied", str(source))
            rename(source, target)

        monkeypatch.setattr(os, "link", raises(errno.EPERM))
        monkeypatch.setattr(os, "rename", refused)
        (line,) = again(call).lines
        (left,) = old.parent.glob(".e.*.tmp")
        said = f"note: out/e/figures/more/mine.svg: cannot be moved over (Permission denied); it is in {left}/old"
        assert line == said
        assert {path.name for path in left.rglob("*.*")} == {"mine.svg", "files.json"}
        assert (old / "notes.txt").read_text() == "mine\n"
        assert json.loads((old / "provenance.json").read_text())["seed"] == 5

    def test_that_came_while_the_folder_was_exchanged(
        self, old: Path, call: Call, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        before_it_is_replaced(monkeypatch, old, lambda: (old / "late.txt").write_text("late\n"))
        assert again(call).code == 0
        assert (old / "late.txt").read_text() == "late\n"
        assert os.listdir(old.parent) == ["e"]

    def test_results_of_an_older_version_are_replaced(self, old: Path, call: Call) -> None:
        """They have no list: of them goes what the new ones have, too."""
        said = json.loads((old / "provenance.json").read_text())
        files = said.pop("files")
        (old / "provenance.json").write_text(json.dumps(said))
        assert again(call).lines == []
        assert set(belongings.list_names(old)) == MINE | set(files)

    @pytest.mark.parametrize("text", ["", "{", "[]", '{"tool": "another"}'])
    def test_a_folder_with_the_provenance_of_something_else_is_not_replaced(
        self, old: Path, call: Call, text: str
    ) -> None:
        (old / "provenance.json").write_text(text)
        before = written(old)
        assert again(call) == (2, "", ["out/e: not empty and no results folder; choose another with --out"])
        assert written(old) == before

    def test_a_mount_point_within(self, old: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(os.path, "ismount", lambda path: path == "out/e/figures/more")
        line = "out/e/figures/more: a mount point cannot be replaced; choose another folder with --out"
        assert again(call) == (2, "", [line])

    def test_a_recording_of_the_users_in_it_may_be_replayed(self, old: Path, call: Call) -> None:
        drive(old / "mine.mcap")
        assert again(call, "--log", "out/e/mine.mcap").code == 0
        assert (old / "mine.mcap").exists()


EVERYTHING = changed(
    "show: {run: [worst, 1]}",
    "sweep: {latency_s: [0, 0.2]}",
    "measure: {onset: {kind: in_range, range_m: 60}, exact: true}",
)


class TestMade:
    """What commands make of results is listed in their folder, and goes with them."""

    def test_of_every_file_that_any_command_writes_none_outlives_its_results(self, here: Path, call: Call) -> None:
        (here / "e.yaml").write_text(EVERYTHING)
        configurations = "configurations:\n" + "".join(
            f"  late{k}: {{units: all, latency_s: 0.{k}}}\n" for k in range(4)
        )
        (here / "e.yaml").write_text(EVERYTHING.replace("configurations:\n", configurations))
        assert call("run", "e.yaml", "--report").code == 0
        folder = here / "out/e"
        commands = [
            ["plot", "out/e"],
            ["plot", "out/e", "--out", "out/e/more figures", "--configurations", "GT,PEM"],
            ["film", "out/e", "--configurations", "PEM"],
            ["report", "out/e"],
            ["report", "out/e", "--out", "out/e/pages/second.html", "--baseline", "PEM"],
            ["layout", "out/e"],
            ["layout", "out/e/replay_1.mcap", "--out", "out/e/wide.json", "--compare", "GT,PEM"],
            ["compare", "out/e", "--baseline", "PEM", "--out", "out/e/c.csv", "--rrd", "out/e/beside.rrd"],
            ["compare", "out/e", "--baseline", "PEM", "--out", "out/e/c.md"],
        ]
        for command in commands:
            assert call(*command).code == 0, command
        results = set(json.loads((folder / "provenance.json").read_text())["files"])
        assert {"sweep.csv", "exact.parquet", "bands.csv", "replay_1.rrd"} <= results
        made = set(belongings.list_names(folder)) - results
        assert {
            f"figures/{name}.{kind}" for name in ("answer", "differences", "sweeps") for kind in ("png", "svg")
        } <= made
        assert {"film.gif", "report.html", "pages/second.html", "replay.foxglove.json", "wide.json"} <= made
        assert {"c.csv", "c.md", "beside.rrd", "more figures/curves.svg"} <= made
        (folder / "figures/mine.svg").write_text("<svg/>")
        (folder / "notes.txt").write_text("mine\n")
        (here / "e.yaml").write_text(TEXT.replace("probability: 0.5", "probability: 0.9"))
        assert call("run", "e.yaml", "--overwrite").lines == []
        results = set(json.loads((folder / "provenance.json").read_text())["files"])
        assert set(belongings.list_names(folder)) == results | {"figures/mine.svg", "notes.txt"}
        assert os.listdir(here / "out") == ["e"]

    def test_of_other_results_stays(self, here: Path, call: Call) -> None:
        """A page of other results is no older than before, wherever it was put."""
        for out in ("out/e", "out/other"):
            assert call("run", "e.yaml", "--out", out).code == 0
        assert call("report", "out/other", "--out", "out/e/other.html").code == 0
        assert call("report", "out/e", "--out", "out/other/e.html").code == 0
        assert call("compare", "out/e", "out/other", "--baseline", "e:PEM", "--out", "out/other/c.csv").code == 0
        assert again(call).code == 0
        assert call("run", "e.yaml", "--out", "out/other", "--overwrite").code == 0
        assert (here / "out/e/other.html").exists()
        assert (here / "out/other/e.html").exists()
        assert not (here / "out/other/c.csv").exists()

    @pytest.mark.parametrize(
        "text",
        [
            "../keep.txt", "/keep.txt", "{here}/out/keep.txt", "{here}/out/e/notes.txt", "figures/../notes.txt",
            "link/a", "./notes.txt", "elsewhere/keep.txt", ".", "", "..", "figures",
        ],
    )  # fmt: skip
    def test_a_list_that_names_what_is_not_in_the_folder_removes_nothing(
        self, old: Path, call: Call, text: str
    ) -> None:
        (old.parent / "keep.txt").write_text("keep\n")
        (old / "elsewhere").symlink_to(old.parent)
        with (old / "made.jsonl").open("a") as file:
            file.write(json.dumps(text.format(here=old.parents[1])) + "\n")
        assert again(call).lines == []
        assert (old.parent / "keep.txt").read_text() == "keep\n"
        assert (old / "notes.txt").read_text() == "mine\n"
        assert (old / "elsewhere").is_symlink()
        assert set(belongings.list_names(old)) - set(json.loads((old / "provenance.json").read_text())["files"]) == {
            *MINE, "elsewhere",
        }  # fmt: skip
        assert sorted(os.listdir(old.parent)) == ["e", "keep.txt"]

    @pytest.mark.parametrize("content", [b"\xff\xfe\n", b"[" * 100_000, b'{"a": 1}\n3\nnull\n', b"", b'"notes.tx'])
    def test_a_damaged_list_names_nothing_but_what_can_be_read_of_it(
        self, old: Path, call: Call, content: bytes
    ) -> None:
        with (old / "made.jsonl").open("ab") as file:
            file.write(content)
        assert call("layout", "out/e").code == 2  # shows nothing: writes nothing
        assert call("report", "out/e", "--out", "out/e/late.html").code == 0
        assert again(call).lines == []
        assert set(belongings.list_names(old)) == MINE | set(json.loads((old / "provenance.json").read_text())["files"])

    @pytest.mark.parametrize("kind", ["link", "folder", "pipe"])
    def test_something_else_in_the_place_of_the_list(self, here: Path, ran: Path, call: Call, kind: str) -> None:
        place, outside = here / "out/e/made.jsonl", here / "outside.txt"
        outside.write_text('"summary.csv"\n')
        if kind == "link":
            place.symlink_to(outside)
        elif kind == "folder":
            place.mkdir()
        else:
            os.mkfifo(place)
        ended = call("report", "out/e")
        assert (ended.code, len(ended.lines)) == (2, 1)
        assert ended.lines[0].startswith("out/e/made.jsonl: cannot be written: ")
        assert not (here / "out/e/report.html").exists()
        assert outside.read_text() == '"summary.csv"\n'
        assert again(call).code == 0
        assert outside.exists()

    def test_what_is_made_while_the_folder_is_exchanged_goes_with_the_old_results(
        self, old: Path, call: Call, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def late() -> None:
            belongings.add_to_made_list(old, [old / "late.html"])
            (old / "late.html").write_text("of the old results")

        before_it_is_replaced(monkeypatch, old, late)
        assert again(call).lines == []
        assert set(belongings.list_names(old)) == MINE | set(json.loads((old / "provenance.json").read_text())["files"])
        assert os.listdir(old.parent) == ["e"]

    @pytest.mark.parametrize(
        "command", [["plot"], ["film"], ["report"], ["compare", "--baseline", "PEM", "--out", "out/e/c.csv"]]
    )
    def test_a_file_is_listed_before_it_is_there(
        self, ran: Path, call: Call, monkeypatch: pytest.MonkeyPatch, command: list[str]
    ) -> None:
        """So that a process that is killed at any instant leaves none that outlives its results."""
        folder, before = ran, set(belongings.list_names(ran))
        replace_ = os.replace

        def watched(source: Any, target: Any) -> None:
            assert Path(target).relative_to("out/e").as_posix() in belongings.read_made(folder)
            replace_(source, target)

        monkeypatch.setattr(os, "replace", watched)
        assert call(command[0], "out/e", *command[1:]).code == 0
        assert set(belongings.list_names(folder)) - before <= belongings.read_made(folder).keys()


class TestOneWriter:
    def test_a_second_run_is_refused_before_it_replays(
        self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with place.take_place(here / "out/e", overwrite=False):
            monkeypatch.setattr(gather, "replay_outcomes", raises(errno.EIO))
            ended = call("run", "e.yaml")
        assert ended.code == 2
        assert ended.lines == [
            f"{here}/out/e: another run (process {os.getpid()} on {os.uname().nodename}) is writing its results there; "
            "wait until it has ended, or choose another folder with --out"
        ]
        assert not (here / "out").exists()

    def test_two_processes(self, here: Path) -> None:
        """The first stands still until the second has ended; and then is done."""
        code = (
            "import sys\nfrom copem_replay.cli import main as cli\nfrom copem_replay.pipeline import run\n"
            "replay = run.run_experiment\n"
            "def waits(*a, **k):\n    print('now', flush=True)\n    sys.stdin.readline()\n    return replay(*a, **k)\n"
            "run.run_experiment = waits\nsys.argv = ['copem-replay', 'run', 'e.yaml']\ncli.main()\n"
        )
        first = subprocess.Popen(
            [sys.executable, "-c", code], cwd=here, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert first.stdout is not None
        assert first.stdout.readline() == "now\n"
        second = installed("run", "e.yaml", "--overwrite", folder=here)
        assert second.returncode == 2
        assert f"another run (process {first.pid} on " in second.stderr
        first.communicate("\n")
        assert first.returncode == 0
        assert os.listdir(here / "out") == ["e"]

    @pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP])
    def test_without_locks_what_finishes_second_has_another_name(
        self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch, code: int
    ) -> None:
        monkeypatch.setattr(fcntl, "flock", raises(code))
        replay = runs.run_experiment
        seeds = iter("23")

        def meanwhile(*a: Any, **k: Any) -> Any:
            seed = next(seeds, None)
            if seed is not None:  # another run, from beginning to end
                assert call("run", "e.yaml", "--seed", seed).code == 0
            return replay(*a, **k)

        monkeypatch.setattr(runs, "run_experiment", meanwhile)
        ended = call("run", "e.yaml")
        assert ended.code == 0
        found = {
            path.name: json.loads((path / "provenance.json").read_text())["seed"] for path in (here / "out").iterdir()
        }
        assert found == {"e": 3, "e-2": 2, "e-3": 1}
        assert ended.lines == [
            "note: out/e: other content came there during the run and is kept; the results of this run are in "
            f"{here}/out/e-3"
        ]
        assert f"results in {here}/out/e-3; every figure: --explain\n" in ended.out

    def test_without_locks_overwriting_what_another_run_has_just_written(
        self, old: Path, call: Call, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(fcntl, "flock", raises(errno.ENOLCK))
        count = iter(range(9))

        def meanwhile() -> None:
            if next(count) == 0:  # at the last instant
                assert again(call).code == 0

        before_it_is_replaced(monkeypatch, old, meanwhile)
        assert call("run", "e.yaml", "--seed", "6", "--overwrite").code == 0
        seeds = {path.name: json.loads((path / "provenance.json").read_text())["seed"] for path in old.parent.iterdir()}
        assert seeds == {"e": 5, "e-2": 6}

    def test_a_lock_file_that_is_left_is_no_lock(self, here: Path, call: Call) -> None:
        (here / "out").mkdir()
        (here / "out/.e.lock").write_text("process 1 on moon\n")
        assert call("run", "e.yaml").code == 0
        assert os.listdir(here / "out") == ["e"]

    def test_a_lock_file_that_goes_before_it_is_locked(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """What was opened has no name any more: the lock of another file is taken."""
        path = tmp_path / ".e.lock"
        opened = lock._open_lock
        left = [1, 1]

        def vanishing(path: Path) -> int:
            fd = opened(path)
            if left:
                left.pop()
                path.unlink()
            return fd

        monkeypatch.setattr(lock, "_open_lock", vanishing)
        with lock.lock_folder(tmp_path / "e"):
            assert not left
            with pytest.raises(OutputError, match="another run"), lock.lock_folder(tmp_path / "e"):
                pass
            assert path.exists()
        assert not path.exists()

    @pytest.mark.parametrize("kind", ["link", "folder", "pipe"])
    def test_something_else_in_the_place_of_the_lock(self, here: Path, call: Call, kind: str) -> None:
        (here / "out").mkdir()
        path = here / "out/.e.lock"
        {"link": lambda: path.symlink_to(here / "e.yaml"), "folder": path.mkdir, "pipe": lambda: os.mkfifo(path)}[
            kind
        ]()
        ended = call("run", "e.yaml")
        assert ended.code == (0 if kind == "pipe" else 2)
        assert (here / "e.yaml").read_text() == TEXT

    def test_a_name_as_long_as_it_may_be(self, here: Path, call: Call) -> None:
        name = "ü" * 127
        for _ in range(2):
            assert call("run", "e.yaml", "--out", name, "--overwrite").code == 0
        assert sorted(os.listdir(here)) == ["drive.mcap", "e.yaml", name]


class TestFlushed:
    def test_all_is_on_the_disk_before_it_has_its_name(
        self, old: Path, call: Call, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (old.parents[1] / "e.yaml").write_text(SHOWN)
        flushed: set[tuple[int, int]] = set()
        fsync, rename = os.fsync, os.rename

        def noted(fd: int) -> None:
            found = os.fstat(fd)
            flushed.add((found.st_dev, found.st_ino))
            fsync(fd)

        def ready(new: Path, name: Path) -> None:
            every = [new, *new.rglob("*")]
            here = {(p.lstat().st_dev, p.lstat().st_ino) for p in every if not p.is_symlink()}
            assert len(every) > 15
            assert here <= flushed
            rename(new, name)

        monkeypatch.setattr(os, "fsync", noted)
        monkeypatch.setattr(os, "rename", lambda new, name: (ready if name == old else rename)(new, name))
        assert again(call).code == 0
        assert (old.parent.stat().st_dev, old.parent.stat().st_ino) in flushed

    def test_a_file_and_the_folder_it_is_named_in(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        flushed = []
        monkeypatch.setattr(os, "fsync", lambda fd: flushed.append(os.fstat(fd).st_ino))
        with atomic_file(tmp_path / "a.csv") as path:
            path.write_text("1\n")
        assert flushed == [(tmp_path / "a.csv").stat().st_ino, tmp_path.stat().st_ino]


class TestLeftovers:
    """Of processes that were killed."""

    def left(self, folder: Path, files: list[str], there: list[str]) -> Path:
        """What a killed process leaves: its list, its lock free, and files."""
        path = folder.parent / f".{folder.name}.abcd_123.tmp"
        path.mkdir(parents=True)
        (path / scratch.MANIFEST).write_text(json.dumps({"files": files}))
        for name in there:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_text("x")
        return path

    def removed(self, path: Path) -> str:
        return f"note: {path}: removed, left by a process that was killed"

    def kept(self, path: Path) -> str:
        return f"note: {path}: left by a process that was killed, and not removed: it holds what is not ours"

    def test_go_and_it_is_said(self, here: Path, call: Call) -> None:
        path = self.left(here / "out/e", ["summary.csv", "replay/a.rrd"], ["new/replay/a.rrd"])
        assert call("run", "e.yaml").lines == [self.removed(path)]
        assert os.listdir(here / "out") == ["e"]

    def test_go_when_the_run_itself_is_refused(self, here: Path, call: Call) -> None:
        path = self.left(here / "out/e", [], [])
        (here / "drive.mcap").unlink()
        ended = call("run", "e.yaml")
        assert ended.code == 2
        assert ended.lines[0] == self.removed(path)

    def test_with_a_file_that_is_in_no_list_stay(self, here: Path, call: Call) -> None:
        path = self.left(here / "out/e", ["a"], ["new/a", "new/thesis.tex", "new/files.json"])
        for _ in range(2):
            assert call("run", "e.yaml", "--overwrite").lines == [self.kept(path)]
            assert {p.name for p in (path / "new").iterdir()} == {"thesis.tex", "files.json"}

    @pytest.mark.parametrize("text", [None, "", "{", "[]", '{"files": 3}', '{"files": [[]]}'])
    def test_without_a_list_stay_unless_they_are_empty(self, here: Path, call: Call, text: str | None) -> None:
        path = self.left(here / "out/e", [], ["new/summary.csv"])
        if text is None:
            (path / scratch.MANIFEST).unlink()
        else:
            (path / scratch.MANIFEST).write_text(text)
        assert call("run", "e.yaml").lines == [self.kept(path)]
        assert (path / "new/summary.csv").exists()
        shutil.rmtree(path / "new")
        assert call("run", "e.yaml", "--overwrite").lines == [self.removed(path)]

    def test_of_a_process_that_lives_stay(self, here: Path, call: Call) -> None:
        path = self.left(here / "out/e", ["a"], ["new/a"])
        with (path / scratch.MANIFEST).open() as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            assert call("run", "e.yaml").lines == []
            assert (path / "new/a").exists()
        assert call("run", "e.yaml", "--overwrite").lines == [self.removed(path)]

    def test_stay_where_there_are_no_locks(self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        path = self.left(here / "out/e", ["a"], ["new/a"])
        monkeypatch.setattr(fcntl, "flock", raises(errno.ENOLCK))
        assert call("run", "e.yaml").lines == []
        assert (path / "new/a").exists()

    def test_of_other_places_stay(self, here: Path, call: Call) -> None:
        other = self.left(here / "out/e.x", [], [])
        mine = here / "out/.e.thesis.tmp"
        mine.mkdir()
        assert call("run", "e.yaml").lines == []
        assert other.exists()
        assert mine.exists()

    @pytest.mark.parametrize("equal", [True, False])
    def test_with_a_file_of_the_users_go_where_it_is_in_the_results(self, old: Path, call: Call, equal: bool) -> None:
        """After the exchange the old folder, with links to what stays, is still there."""
        path = self.left(old, [], [])
        (path / "new").mkdir()
        if equal:
            os.link(old / "notes.txt", path / "new/notes.txt")
        else:
            (path / "new/notes.txt").write_text("mine\n")
        assert again(call).lines == [self.removed(path) if equal else self.kept(path)]
        assert (old / "notes.txt").read_text() == "mine\n"

    def test_with_a_link_of_the_users_to_a_folder_go_and_the_folder_stays(
        self, here: Path, old: Path, call: Call
    ) -> None:
        path = self.left(old, [], [])
        (here / "theirs").mkdir()
        (here / "theirs/notes.txt").write_text("mine\n")
        (path / "new").mkdir()
        (old / "theirs").symlink_to(here / "theirs")
        os.link(old / "theirs", path / "new/theirs", follow_symlinks=False)
        assert again(call).lines == [self.removed(path)]
        assert (here / "theirs/notes.txt").read_text() == "mine\n"

    def test_a_folder_that_was_moved_away_is_put_back(self, old: Path, call: Call) -> None:
        before = written(old)
        path = self.left(old, list(before), ["new/summary.csv"])
        os.rename(old, path / "old")
        ended = call("run", "e.yaml", "--seed", "5")
        assert ended.code == 2
        assert ended.lines == [
            "out/e: results are there already; --overwrite replaces them, --out chooses another folder"
        ]
        assert written(old) == before

    def test_of_a_file_in_them_go_with_them(self, here: Path, call: Call) -> None:
        path = self.left(here / "out/e", ["replay.rrd"], [])
        (path / "new").mkdir()
        (path / "new/.replay.rrd.abcd_124.tmp.rrd").write_text("half")
        assert call("run", "e.yaml").lines == [self.removed(path)]

    def test_of_figures_pages_and_tables(self, old: Path, call: Call) -> None:
        for file in (old / "report.html", old / "figures", old.parent / "c.csv"):
            self.left(file, ["runs.png"], ["new/runs.png"])
        inside = old / "figures/.figures.abcd_124.tmp"
        shutil.copytree(old / ".figures.abcd_123.tmp", inside)
        (old.parent / ".c.csv.abcd_125.tmp.csv").write_text("half")
        assert call("report", "out/e").code == 0
        assert call("compare", "out/e", "--baseline", "GT", "--out", "out/c.csv").code == 0
        assert call("plot", "out/e").code == 0
        assert not list(old.parent.rglob(".*.tmp*"))
        assert not inside.exists()


@pytest.mark.parametrize("command", ["plot", "report"])
def test_what_is_made_of_old_results_does_not_get_among_new_ones(
    old: Path, call: Call, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """Results that are replaced while figures are drawn, or a page is made."""
    from copem_replay.report.figures import FIGURES
    from copem_replay.report.html import page

    def meanwhile(original: Callable[..., Any]) -> Callable[..., Any]:
        def replaced(*a: Any, **k: Any) -> Any:
            assert call("run", "e.yaml", "--seed", "5", "--overwrite").code == 0
            return original(*a, **k)

        return replaced

    monkeypatch.setitem(FIGURES, "curves", replace(FIGURES["curves"], draw=meanwhile(FIGURES["curves"].draw)))
    monkeypatch.setattr(page, "build_page", meanwhile(page.build_page))
    ended = call(command, "out/e")
    assert ended.code == 2
    assert ended.lines[-1] == "out/e: other results took its place while it was read; run the command again"
    assert set(belongings.list_names(old)) == MINE | set(json.loads((old / "provenance.json").read_text())["files"])


def test_tables_of_old_and_new_results_are_not_read_as_one(
    old: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    from copem_replay.results import read

    load = read.read_experiment_file
    replaced = iter([True])

    def meanwhile(path: Path) -> Any:
        if next(replaced, False):
            assert again(call).code == 0
        return load(path)

    monkeypatch.setattr(read, "read_experiment_file", meanwhile)
    ended = call("compare", "out/e", "--baseline", "GT")
    assert (ended.code, ended.lines[-1]) == (
        2,
        "out/e: other results took its place while it was read; run the command again",
    )


@pytest.mark.long
def test_killed_at_any_moment() -> None:
    """Nothing half-written, nothing of the user's gone, nothing piling up, the next run as if there had been none."""
    tool = [sys.executable, ROOT / "tools/kill_runs.py", "--kills", "6"]
    ended = subprocess.run(tool, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert ended.stdout.startswith("6 kills, ")
    assert "wrong: 0;" in ended.stdout
