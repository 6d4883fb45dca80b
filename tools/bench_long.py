"""Long recordings, and crowds: time and memory of all that a run does, and how both grow with the length."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from copem_replay.io.write.osi_trace import write_osi_trace
from make_logs import long_drive

CROWD = """
version: 1
logs: [crowd.mcap]
ego: 0
runs: 5
seed: 1
pems:
  all_around:
    - detection: {{kind: visible_share}}
      error: {{kind: gaussian, covariance_m2: [[0.25, 0.0], [0.0, 0.25]]}}
units:
{units}
configurations:
  GT: {{units: truth}}
  ideal: {{units: all, latency_s: 0.1}}
  gnn: {{units: all, latency_s: 0.1, fusion: {{kind: gnn}}}}
show: null
"""
"""Every object carries a unit that sees as far as anything hides nothing: as many rows as there can be (chosen)."""


def long(folder: Path, minutes: Sequence[float] = (20, 60), objects: int = 100) -> Iterator[dict[str, object]]:
    """A line for each length, and the slope: how many times as long it takes, per how many times as long it is.

    The experiment is the one that `init` writes for the recording, but of two runs.
    """
    taken: list[tuple[float, float]] = []
    for length in minutes:
        write_osi_trace(long_drive(length, objects), folder / "city.mcap")
        begun = subprocess.run(_command(["init", "city.mcap"]), cwd=folder, check=True, capture_output=True, text=True)
        (folder / "city.yaml").write_text(re.sub(r"(?m)^runs: \d+", "runs: 2", begun.stdout))
        out = folder / "out"
        seconds, peak_mb = measured(["run", "city.yaml", "--out", "out", "--overwrite", "--jobs", "2"], folder)
        taken.append((seconds, peak_mb))
        states = round(length * 600) * objects
        yield {
            "long_minutes": length,
            "object_states": states,
            "long_s": round(seconds, 1),
            "long_states_per_s": round(states / seconds),
            "long_peak_mb": round(peak_mb),
            "mcap_mb": round((out / "replay.mcap").stat().st_size / 1e6, 1),
            "rrd_mb": round((out / "replay.rrd").stat().st_size / 1e6, 1),
        }
    (first_s, first_mb), (last_s, last_mb) = taken[0], taken[-1]
    times = minutes[-1] / minutes[0]
    yield {"long_slope": round(last_s / first_s / times, 2), "long_memory_slope": round(last_mb / first_mb / times, 2)}


def crowd(folder: Path, frames: int, objects: int) -> dict[str, object]:
    """What `crowd.mcap`, of so many frames and objects, takes where each of them carries a unit."""
    units = "\n".join(f"  u{k}: {{on: {k}, height_m: 1.8, pem: all_around}}" for k in range(objects))
    (folder / "crowd.yaml").write_text(CROWD.format(units=units))
    seconds, peak_mb = measured(["run", "crowd.yaml", "--out", "out", "--overwrite", "--jobs", "2"], folder)
    views = frames * objects * (objects - 1)
    return {
        "crowd_units": objects,
        "crowd_views": views,
        "crowd_s": round(seconds, 1),
        "crowd_views_per_s": round(views / seconds),
        "crowd_peak_mb": round(peak_mb),
    }


def measured(arguments: Sequence[str], folder: Path) -> tuple[float, float]:
    """Seconds and peak memory (MB) of a command. Raises CalledProcessError where it fails."""
    command = _command(arguments)
    begin = time.perf_counter()
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return time.perf_counter() - begin, usage.ru_maxrss / 1000  # kB on Linux


def _command(arguments: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "copem_replay.cli.main", *arguments]
