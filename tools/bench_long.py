"""Long recordings: time and memory of all that a run does, and how both grow with the length of the recording."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from copem_replay.io.write.osi_trace import write_osi_trace
from make_logs import long_drive

UNITS = """
  ego: {on: ego, height_m: 1.8, pem: lidar}
  south_west: {at: [108, 108], height_m: 6.0, pem: lidar}
  south_east: {at: [308, 108], height_m: 6.0, pem: lidar}
  north_west: {at: [108, 308], height_m: 6.0, pem: lidar}
  north_east: {at: [308, 308], height_m: 6.0, pem: lidar}
"""
EXPERIMENT = f"""
version: 1
logs: [city.mcap]
runs: 1
seed: 1
pems:
  lidar:
    - when: {{range_m: [0, 120]}}
      detection: {{kind: visible_share}}
      error: {{kind: gaussian, covariance_m2: [[0.25, 0.0], [0.0, 0.25]]}}
units: {UNITS}
configurations:
  GT: {{units: truth}}
  PEM: {{units: [ego]}}
  ideal: {{units: all, latency_s: 0.1}}
  tracker: {{units: all, latency_s: 0.1, fusion: {{kind: tracker, late: predict}}}}
"""
"""Five units that see 120 m far, one run, all of it written to MCAP and .rrd (chosen)."""


def long(folder: Path, minutes: Sequence[float] = (15, 60), objects: int = 100) -> Iterator[dict[str, object]]:
    """A line for each length, and the slope: how many times as long it takes, per how many times as long it is."""
    (folder / "city.yaml").write_text(EXPERIMENT)
    taken: list[tuple[float, float]] = []
    for length in minutes:
        write_osi_trace(long_drive(length, objects), folder / "city.mcap")
        out = folder / "out"
        seconds, peak_mb = measured(["run", "city.yaml", "--out", "out", "--overwrite", "--jobs", "1"], folder)
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


def measured(arguments: Sequence[str], folder: Path) -> tuple[float, float]:
    """Seconds and peak memory (MB) of a command. Raises CalledProcessError where it fails."""
    command = [sys.executable, "-m", "copem_replay.cli.main", *arguments]
    begin = time.perf_counter()
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return time.perf_counter() - begin, usage.ru_maxrss / 1000  # kB on Linux
