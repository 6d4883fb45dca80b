"""Each command of the page on object storage, in turn, against a server on this machine."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from copem_replay.cli import main as cli
from tests.helpers.experiments import changed, drive
from tests.helpers.object_storage import Bucket

pytestmark = pytest.mark.long

PAGE = Path(__file__).parents[2] / "docs/guide/scale.md"


def test_the_commands_of_the_page(
    bucket: Bucket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8").partition("## Object storage")[2]
    (logs,) = re.findall(r"`(logs: \[.*?\])`", text)
    (commands,) = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    url = "s3://drives"
    bucket.fs.mkdir("drives")
    for day in ("monday", "tuesday"):
        bucket.fs.pipe_file(f"{url}/2026-10/{day}.mcap", drive(tmp_path / "drive.mcap").read_bytes())
    Path("study.yaml").write_text(changed(logs))
    said = []
    for command in commands.splitlines():
        monkeypatch.setattr("sys.argv", shlex.split(command))
        assert cli._run_to_exit_code() == 0, command
        said += capsys.readouterr().err.splitlines()
    assert [line for line in said if line.startswith("pieces: ")] == [
        f"pieces: 6 computed, 0 found in {url}/study.pieces",
        f"pieces: 0 computed, 3 found in {url}/study.pieces",
    ]
    assert Path("out/study/report.html").is_file()
    assert Path("out/monday/logs.csv").read_text().count(f"{url}/2026-10/monday.mcap") == 1
