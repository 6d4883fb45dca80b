"""What `--cluster` says of its progress, and the hint that there is such a thing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from copem_replay.cli.run import advise_cluster
from copem_replay.extras.cluster.command import CrewProgressLines
from copem_replay.extras.cluster.crew import CrewProgress

ROOT = Path(__file__).parents[2]


def test_a_line_a_minute_with_logs_time_left_and_lost_workers(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = [0.0]
    lines = CrewProgressLines(lambda: now_s[0])
    surveyed = CrewProgress("surveying", 100, 5000)
    lines(surveyed)
    now_s[0] = 61.0
    lines(surveyed)
    now_s[0] = 100.0
    lines(CrewProgress("replaying", 0, 5000))
    now_s[0] = 149.3
    lines(CrewProgress("replaying", 412, 5000, lost=1))
    now_s[0] = 150.0
    lines(CrewProgress("replaying", 413, 5000, lost=1))
    now_s[0] = 247.9  # 824 logs more in 98.6 s: 3764 take 450 s
    lines(CrewProgress("replaying", 1236, 5000, lost=1))
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "surveying: 100 of 5000 logs",
        "replaying: 412 of 5000 logs, 1 worker lost",
        "replaying: 1236 of 5000 logs, 8 minutes left, 1 worker lost",
    ]


def test_the_hint_is_given_where_it_helps() -> None:
    assert advise_cluster(60.0, 8) == advise_cluster(61.0, 4) == []
    assert advise_cluster(75.2, 8) == [
        "replaying took 75 s; `--cluster local` makes more of 8 cores: its workers are processes"
    ]


def test_without_dask_a_line_says_what_to_type() -> None:
    code = (
        "import sys; sys.modules['distributed'] = None; from copem_replay.cli.main import main;"
        "sys.argv = ['copem-replay', 'run', 'logs/tc016d.yaml', '--cluster', 'local']; main()"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert ended.returncode == 2
    assert ended.stderr == "--cluster: Dask is not installed: pip install 'copem-replay[cluster]'\n"
