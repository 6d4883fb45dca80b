"""Long recordings, and crowds: time and memory of all that a run does, and how both grow with the length."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

from benches import common
from copem_replay.io.write.osi import write_osi_trace
from make_logs import long_drive

_RUN = ("run", "--out", "out", "--overwrite", "--jobs", "2")
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


def drafted(folder: Path, name: str) -> common.Spent:
    """What the experiment takes that `init` writes for a recording, with its own number of runs."""
    begun = subprocess.run([*common.TOOL, "init", name], cwd=folder, check=True, capture_output=True, text=True)
    (folder / "e.yaml").write_text(begun.stdout)
    return common.spent([*_RUN, "e.yaml"], folder)


def grown(folder: Path, minutes: Sequence[float] = (20, 60), objects: int = 100) -> Iterator[common.Line]:
    """A line for each length, and the slope: how many times as long it takes, per how many times as long it is."""
    taken: list[tuple[float, int]] = []
    for length in minutes:
        write_osi_trace(long_drive(length, objects), folder / "city.mcap")
        out = folder / "out"
        _, seconds, peak_mb = drafted(folder, "city.mcap")
        taken.append((seconds, peak_mb))
        states = round(length * 600) * objects
        yield {
            "long_minutes": length,
            "object_states": states,
            "long_s": round(seconds, 1),
            "long_states_per_s": round(states / seconds),
            "long_peak_mb": peak_mb,
            "mcap_mb": round((out / "replay.mcap").stat().st_size / 1e6, 1),
            "rrd_mb": round((out / "replay.rrd").stat().st_size / 1e6, 1),
        }
    (first_s, first_mb), (last_s, last_mb) = taken[0], taken[-1]
    times = minutes[-1] / minutes[0]
    yield {"long_slope": round(last_s / first_s / times, 2), "long_memory_slope": round(last_mb / first_mb / times, 2)}


def stayed(folder: Path, minutes: float = 60, objects: int = 100) -> common.Line:
    """What a recording takes in which all objects stay the whole time, at 20 Hz."""
    common.write_truth(folder / "stay.mcap", common.boxes(round(minutes * 1200), objects))
    _, seconds, peak_mb = drafted(folder, "stay.mcap")
    return {"stay_minutes": minutes, "stay_s": round(seconds, 1), "stay_peak_mb": peak_mb}


def drawn_often(folder: Path, runs: int = 10_000) -> common.Line:
    """What many runs of one drive take, with accuracy."""
    sample = str(common.ROOT / "logs/tc016d.yaml")
    _, seconds, peak_mb = common.spent([*_RUN, sample, "--runs", str(runs)], folder)
    return {"often_runs": runs, "often_s": round(seconds, 1), "often_peak_mb": peak_mb}


def crowded(folder: Path, frames: int, objects: int) -> common.Line:
    """What `crowd.mcap`, of so many frames and objects, takes where each of them carries a unit."""
    units = "\n".join(f"  u{k}: {{on: {k}, height_m: 1.8, pem: all_around}}" for k in range(objects))
    (folder / "crowd.yaml").write_text(CROWD.format(units=units))
    _, seconds, peak_mb = common.spent([*_RUN, "crowd.yaml"], folder)
    views = frames * objects * (objects - 1)
    return {
        "crowd_units": objects,
        "crowd_views": views,
        "crowd_s": round(seconds, 1),
        "crowd_views_per_s": round(views / seconds),
        "crowd_peak_mb": peak_mb,
    }


def long() -> Iterator[common.Line]:
    """Twenty minutes of recording, and an hour; an hour in which all stay; many runs. It takes an hour."""
    with common.scratch() as folder:
        yield from grown(folder)
        yield stayed(folder)
        yield drawn_often(folder)


def crowd() -> Iterator[common.Line]:
    """200 units among 200 objects in a disc of 60 m, 60 frames, 5 runs, `ideal` and `gnn`: all that a run does."""
    frames, count = 60, 200
    with common.scratch() as folder:
        common.write_truth(folder / "crowd.mcap", common.boxes(frames, count))
        yield crowded(folder, frames, count)
