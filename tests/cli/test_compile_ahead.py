"""The process that compiles ahead: when there is one, what it compiles, and that it ends with the command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from copem_replay.cli import compile_ahead as ahead
from tests.helpers.experiments import TEXT, drive
from tests.system.test_cli import Call, call

__all__ = ["call"]  # a fixture


class Process:
    """What is started in place of a process: it only tells."""

    def __init__(self, told: list[str]) -> None:
        self.told = told

    def kill(self) -> None:
        self.told.append("killed")

    def wait(self) -> None:
        self.told.append("waited for")


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What becomes of processes that are started, on two cores where nothing is compiled."""
    told: list[str] = []

    def start(command: list[str], **options: Any) -> Process:
        told.append(" ".join(command[1:]))
        assert set(options.values()) == {subprocess.DEVNULL}, "it neither reads nor says anything"
        return Process(told)

    monkeypatch.setattr(ahead.subprocess, "Popen", start)
    monkeypatch.setattr(ahead, "_is_compiled", lambda: False)
    monkeypatch.setattr("copem_replay.api.run.count_workers", lambda jobs: 2)
    monkeypatch.setattr("copem_replay.pipeline.cost.free_bytes", lambda: 3 << 30)
    return told


def test_it_ends_with_the_first_replay(told: list[str], call: Call, tmp_path: Path) -> None:
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(TEXT)
    assert call("run", "e.yaml")[0] == 0
    assert told == ["-P -m copem_replay.cli.compile_ahead", "killed", "waited for"]
    told.clear()
    assert call("run", "e.yaml", "--runs", "x")[0] == 2
    assert told == [], "a command that is wrong starts nothing"


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("copem_replay.cli.compile_ahead._is_compiled", lambda: True),
        ("copem_replay.api.run.count_workers", lambda jobs: 1),
        ("copem_replay.pipeline.cost.free_bytes", lambda: 1 << 30),
    ],
    ids=["compiled before", "one core", "little memory"],
)
def test_without_need_or_room_there_is_none(
    told: list[str], monkeypatch: pytest.MonkeyPatch, name: str, found: object
) -> None:
    monkeypatch.setattr(name, found)
    with ahead.compile_ahead():
        pass
    assert told == []


def test_where_none_can_be_started_the_command_does_without(told: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(ahead.subprocess, "Popen", refuse)
    with ahead.compile_ahead():
        told.append("replayed")
    assert told == ["replayed"]


USED = """
import gc, json
from copem_replay.cli.compile_ahead import _is_compiled, replay_in_advance
replay_in_advance()
from copem_replay.core.callees import Kernel
used = [one.__name__ for one in gc.get_objects() if isinstance(one, Kernel) and one.overloads]
print(json.dumps([used, _is_compiled()]))
"""


def test_what_it_compiles() -> None:
    """What comes last in a replay, and nothing of what comes first."""
    ran = subprocess.run([sys.executable, "-c", USED], capture_output=True, text=True, check=True)
    used, compiled = json.loads(ran.stdout)
    assert {"_match_lists", "add_up", "_measure_frames", "find_existence_levels", "cluster_run"} <= set(used)
    assert "compute_shares" not in used
    assert compiled, "the next command starts none"
