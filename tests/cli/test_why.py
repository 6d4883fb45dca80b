"""`copem-replay why`: what it prints and writes, and lines of what is wrong."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd
import pytest

from copem_replay.cli import main as cli
from tests.helpers.experiments import changed, drive

TEXT = changed("show: null")


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    """Calls the command on the drive: its exit code, what it prints, what it says on stderr."""
    monkeypatch.chdir(tmp_path)
    drive(Path("drive.mcap"))
    Path("e.yaml").write_text(TEXT)

    def called(*words: str) -> tuple[int, list[str], list[str]]:
        monkeypatch.setattr(sys, "argv", ["copem-replay", "why", *words])
        code = cli._run_to_exit_code()
        said = capsys.readouterr()
        return code, said.out.splitlines(), said.err.splitlines()

    return called


def test_all_parts_of_all_configurations_with_units(call) -> None:  # type: ignore[no-untyped-def]
    code, said, notes = call("e.yaml")
    assert code == 0
    assert said[-1] == "why.csv, units.csv, triage.csv, sensitivity.csv in out/e_why"
    causes = pd.read_csv("out/e_why/why.csv")
    assert list(dict.fromkeys(causes["configuration"])) == ["PEM", "coPEM"]
    late = causes[causes["configuration"] == "coPEM"].set_index("cause")
    assert late["added_s"]["latency"] == pytest.approx(0.5)
    assert pd.read_csv("out/e_why/units.csv")["unit"].tolist() == ["mast"]
    assert any("PEM: expected a unit beside the ego's, found ego alone" in note for note in notes)
    head = next(line for line in said if line.startswith("coPEM: objects are unknown"))
    assert head == f"coPEM: objects are unknown for {late['added_s'].sum():.2f} s in the mean"


def test_only_what_is_asked_for_is_written(call) -> None:  # type: ignore[no-untyped-def]
    code, said, _ = call("e.yaml", "--causes", "--configuration", "PEM", "--out", "there")
    assert code == 0
    assert [path.name for path in Path("there").iterdir()] == ["why.csv"]
    assert said[-1] == "why.csv in there"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--configuration", "coPEN"), "no configuration is named 'coPEN'; did you mean coPEM?"),
        (("--configuration", "GT"), "configuration GT: is the truth, which is never late; choose one with units"),
        (("--configuration", "coPEM", "--units", "--unit", "mats"),
         "configuration coPEM: no unit is named 'mats'; did you mean mast?"),
        (("--out", "drive.mcap"), "drive.mcap: cannot be written: expected a folder, found a file"),
    ],
)  # fmt: skip
def test_wrong_input_is_a_line(call, words: tuple[str, ...], line: str) -> None:  # type: ignore[no-untyped-def]
    code, _, problems = call("e.yaml", *words)
    assert (code, problems[-1]) == (2, line)
    assert not Path("out").exists()
