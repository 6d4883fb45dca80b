"""Every command on terminals of 80 and 120 characters: no line is longer. In a pipe lines are whole."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import termios
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.cli.terminal import (
    MOST_NOTES,
    ProgressLines,
    format_duration,
    print_first_notes,
    print_table,
    show_progress,
)
from copem_replay.core.compiled import compiling
from copem_replay.core.errors import wrap_line
from copem_replay.metrics.summary import format_summary, format_table
from tests.helpers.experiments import changed, drive
from tests.helpers.recordings import Topic, truth_topic, write_recording

ROOT = Path(__file__).parents[2]
COMMAND = Path(sys.executable).with_name("copem-replay")
MORE = """\
configurations:
  GT: {units: truth}
  PEM: {units: [ego]}
  everything half a second late: {units: all, latency_s: 0.5}
  gnn: {units: all, latency_s: {ego: 0, default: 0.3}, fusion: {kind: gnn}}
  a fusion of two units, with a long name: {units: all, latency_s: 1.0, fusion: {kind: gnn}}
"""
COMMANDS = ("", "info", "init", "check", "schema", "samples", "convert", "run", "why", "fit", "compare", "verdict",
            "require", "history", "view", "report", "plot", "film", "layout", "export")  # fmt: skip
FORMATS = ("argoverse2", "nuscenes", "opv2v", "v2xseq", "openlabel", "commonroad", "sumo", "csv")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


Show = Callable[..., list[str]]


@pytest.fixture
def show(monkeypatch: pytest.MonkeyPatch) -> Show:
    """The lines that a command puts on a terminal of a width, problems and notes as well; bars left out."""

    def shown(width: int, *words: str) -> list[str]:
        screen = Terminal()
        monkeypatch.setenv("COLUMNS", str(width))
        for name in ("stdout", "stderr"):
            monkeypatch.setattr(sys, name, screen)
        monkeypatch.setattr(sys, "argv", ["copem-replay", *words])
        with pytest.raises(SystemExit):
            cli.main()
        return [line for line in screen.getvalue().split("\n") if "\x1b" not in line]

    return shown


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "drive.mcap")
    lines = changed("show: {run: 0}", "measure: {onset: {kind: in_range, range_m: 60}, exact: false}")
    (tmp_path / "e.yaml").write_text(re.sub(r"(?ms)^configurations:.*?(?=^measure)", MORE, lines))
    return tmp_path


def test_the_best_rows_are_bold_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In each of its blocks, and no row whose name only begins alike; in a pipe nothing is."""
    lines = ["configuration  n", "PEM            6", "PEM:1s         6", "PEM late       6", "", "mean", "PEM  0.25"]
    print_table("\n".join(lines), ["PEM"])
    assert capsys.readouterr().out.splitlines() == lines, "a pipe"
    screen = Terminal()
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys, "stdout", screen)
    print_table("\n".join(lines), ["PEM"])
    bold = {1: f"\x1b[1m{lines[1]}\x1b[0m", 6: f"\x1b[1m{lines[6]}\x1b[0m"}
    assert screen.getvalue().splitlines() == [bold.get(k, line) for k, line in enumerate(lines)]


@pytest.mark.parametrize("width", [80, 120])
class TestWidth:
    def test_help(self, show: Show, width: int) -> None:
        for words in [[name] if name else [] for name in COMMANDS] + [["convert", name] for name in FORMATS]:
            lines = show(width, *words, "--help")
            assert len(lines) > 4, words
            assert max(map(len, lines)) <= width, words
            text = "\n".join(lines)
            assert "..." not in text.replace("[ARGS]...", "").replace("}...", ""), f"{words}: cut"
            assert not re.search(r"<(path|int|float|list|str)", text), f"{words}: types that are no words"

    def test_a_command_is_one_line_of_help(self, show: Show, width: int) -> None:
        lines = show(width, "--help")
        groups = lines[lines.index("From a recording to an experiment:") :]
        assert [line for line in groups if line.endswith(":")][1:] == ["Replay:", "Judge:", "Look:"]
        commands = [line for line in groups if line.startswith("  ")]
        assert [line.split()[0] for line in commands] == list(COMMANDS[1:])
        assert all(line.endswith(".") for line in commands)

    def test_info(self, show: Show, here: Path, width: int) -> None:
        more: list[Topic] = [truth_topic([], name="perception/object_recognition/tracking/objects_of_the_roadside")]
        write_recording(here / "long.mcap", [(0.0, []), (0.1, [])], more=more)
        for name in ("drive.mcap", "long.mcap"):
            lines = show(width, "info", name)
            assert len(lines) > 3
            assert max(map(len, lines)) <= width

    def test_info_of_the_samples(self, show: Show, monkeypatch: pytest.MonkeyPatch, width: int) -> None:
        monkeypatch.chdir(ROOT)
        lines = show(width, "info", "logs/tc016d.mcap", "logs/crossing.mcap")
        assert len(lines) > 20
        assert max(map(len, lines)) <= width

    def test_run_check_compare_and_report(self, show: Show, here: Path, width: int) -> None:
        for words in (
            ["check", "e.yaml"],
            ["run", "e.yaml", "--report"],
            ["compare", "out/e", "--baseline", "PEM"],
            ["compare", "out/e", "--baseline", "nothing"],
            ["report", "out/e"],
            ["plot", "out/e", "--configurations", "none"],
            ["view", "out/none"],
            ["run", "e.yaml", "--runs", "0"],
        ):
            lines = show(width, *words)
            assert any(lines), words
            assert max(map(len, lines)) <= width, words

    def test_run_ends_with_what_is_next(self, show: Show, here: Path, width: int) -> None:
        assert "next: copem-replay view out/e" in show(width, "run", "e.yaml")
        (here / "e.yaml").write_text(changed("show: null"))
        again = show(width, "run", "e.yaml", "--overwrite", "--out", "out/two words")
        assert "next: copem-replay report 'out/two words'" in again

    def test_what_was_wrapped_says_the_same(self, show: Show, here: Path, width: int) -> None:
        cr.run("e.yaml").save("out/e")
        summary = cr.load_results("out/e").summary
        whole, fitted = format_summary(summary), format_summary(summary, width)
        assert max(map(len, fitted.splitlines())) <= width
        assert set(whole.split()) == set(fitted.split())


def test_the_width_is_that_of_the_terminal(here: Path) -> None:
    """A real terminal of 50 characters; the same in a pipe has lines of any length."""
    words = [COMMAND, "info", "drive.mcap"]
    master, terminal = os.openpty()
    termios.tcsetwinsize(terminal, (40, 50))
    plain = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    subprocess.run(words, stdout=terminal, check=True, env=plain)
    os.close(terminal)
    seen = b""
    try:
        while piece := os.read(master, 1 << 16):
            seen += piece
    except OSError:  # what Linux says at the end
        pass
    os.close(master)
    lines = seen.decode().split("\r\n")
    assert len(lines) > 10
    assert 40 < max(map(len, lines)) <= 50
    piped = subprocess.run(words, capture_output=True, check=True, env=plain | {"COLUMNS": "50"}, text=True).stdout
    assert max(map(len, piped.splitlines())) > 50


class TestTables:
    TABLE = pd.DataFrame({"name": ["a", "bb"], "first": [1.0, 22.5], "second": ["x", "y"]})

    def test_whole_where_it_fits(self) -> None:
        whole = "name  first  second\na         1  x\nbb     22.5  y"
        assert format_table(self.TABLE) == format_table(self.TABLE, 19) == whole

    def test_in_blocks_where_it_does_not(self) -> None:
        assert format_table(self.TABLE, 18) == "name  first\na         1\nbb     22.5\n\nname  second\na     x\nbb    y"

    def test_values_under_names_where_not_even_one_fits(self) -> None:
        assert format_table(self.TABLE[["name", "first"]], 8) == "name\n  first\na\n  1\nbb\n  22.5"

    def test_what_all_have_alike_is_said_once(self, here: Path) -> None:
        cr.run("e.yaml").save("out/e")
        summary = cr.load_results("out/e").summary
        lines = format_summary(summary).splitlines()
        assert lines[0].split()[:2] == ["configuration", "detected_share"]
        assert "all configurations: n 4, list_rate_hz 10" in lines
        one = format_summary(summary.head(1)).splitlines()
        assert one[0].split()[:3] == ["configuration", "n", "list_rate_hz"]
        summary.loc[0, "n"] = 5
        assert "all configurations: list_rate_hz 10" in format_summary(summary).splitlines()


class TestWrapped:
    def test_at_spaces_and_indented(self) -> None:
        assert wrap_line("  one two three four", 11) == ["  one two", "      three", "      four"]

    def test_whole_without_spaces_or_without_a_width(self) -> None:
        assert wrap_line("x" * 30, 10) == ["x" * 30]
        assert wrap_line("a path/that/stays-whole", 10) == ["a", "    path/that/stays-whole"]
        assert wrap_line("one two", None) == ["one two"]


class TestProgress:
    def test_a_line_a_minute_after_the_first(self, capsys: pytest.CaptureFixture[str]) -> None:
        now_s = 1000.0
        lines = ProgressLines("replaying", lambda: now_s)
        said = {}
        for second in range(10, 201, 10):
            now_s = 1000.0 + second
            lines(second, 200)
            if out := capsys.readouterr().err:
                said[second] = out
        assert said == {
            60: "replaying: 30 %, 2 minutes left\n",
            120: "replaying: 60 %, 1 minute left\n",
            180: "replaying: 90 %, 20 seconds left\n",
        }

    def test_the_time_left_is_that_of_what_came_after_the_first_block(self, capsys: pytest.CaptureFixture[str]) -> None:
        """The first block compiles for 100 s, each of the others takes 10 s; a first line has no time left."""
        now_s = 0.0
        lines = ProgressLines("replaying", lambda: now_s)
        said = []
        for reported_s, done in ((100.0, 1), (110.0, 2), (120.0, 3), (160.0, 7)):
            now_s = reported_s
            lines(done, 20)
            said += capsys.readouterr().err.splitlines()
        assert said == ["replaying: 5 %", "replaying: 35 %, 2 minutes left"]  # 13 blocks

    def test_nothing_when_it_is_done_or_not_begun(self, capsys: pytest.CaptureFixture[str]) -> None:
        now_s = 0.0
        lines = ProgressLines("replaying", lambda: now_s)
        now_s = 100.0
        lines(0, 10)
        lines(10, 10)
        assert capsys.readouterr().err == ""

    def test_in_a_pipe_it_is_lines(self) -> None:
        assert show_progress("replaying", lambda progress: progress).__class__ is ProgressLines

    def test_on_a_terminal_a_bar_with_what_is_done(self, monkeypatch: pytest.MonkeyPatch) -> None:
        screen = Terminal()
        monkeypatch.setattr(sys, "stderr", screen)
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", "80")
        show_progress("replaying", lambda progress: progress(3, 4))
        shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.getvalue())
        assert "replaying: 75 %" in shown
        assert "left" not in shown, "nothing is known of it"

    def test_on_a_terminal_it_says_that_it_compiles(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """From when it begins, with no report."""
        screen = Terminal()
        monkeypatch.setattr(sys, "stderr", screen)
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", "80")
        monkeypatch.setattr(compiling, "running", 1)
        show_progress("replaying", lambda progress: None)
        assert "replaying: compiling (once)" in screen.getvalue()

    def test_what_is_compiled_is_no_measure_of_the_rest(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """Blocks take 10 s each; while the fourth is computed, something is compiled for 90 s."""
        now_s = 0.0
        lines = ProgressLines("replaying", lambda: now_s)
        said = []
        for reported_s, done in ((10.0, 1), (20.0, 2), (70.0, 3), (120.0, 4), (130.0, 5), (140.0, 6)):
            now_s = reported_s
            if done == 3:
                monkeypatch.setattr(compiling, "begun", compiling.begun + 1)
            monkeypatch.setattr(compiling, "running", int(done == 3))
            lines(done, 20)
            said += capsys.readouterr().err.splitlines()
        assert said == ["replaying: 15 %, compiling (once)", "replaying: 25 %, 2 minutes left"]  # 15 blocks

    @pytest.mark.parametrize(
        ("time_s", "said"),
        [(0.2, "1 second"), (59.4, "59 seconds"), (60, "1 minute"), (3500, "58 minutes"), (7800, "2 h 10 min")],
    )
    def test_durations(self, time_s: float, said: str) -> None:
        assert format_duration(time_s) == said


def test_notes_beyond_the_first_are_counted_and_explain_prints_them(capsys: pytest.CaptureFixture[str]) -> None:
    notes = [f"note {k}" for k in range(MOST_NOTES + 3)]
    print_first_notes(notes, explain=False)
    first = capsys.readouterr().err.splitlines()
    assert first == [f"note: {one}" for one in notes[:MOST_NOTES]] + ["and 3 more notes: --explain"]
    print_first_notes(notes, explain=True)
    assert capsys.readouterr().err.splitlines() == [f"note: {one}" for one in notes]
