"""Slices of 1.5 million rows by drive and class: the figures of each group, and their differences, from a folder."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from benches import common

LOGS, RUNS, OBJECTS = 20, 1250, 20
EXPERIMENT = """\
version: 1
logs: [{names}]
runs: {runs}
show: null
pems: {{dim: [{{detection: {{kind: constant, probability: 0.05}},
              error: {{kind: gaussian, covariance_m2: [[0.2, 0], [0, 0.2]]}}}}]}}
units: {{ego: {{on: ego, pem: dim}}}}
configurations:
  ideal: {{units: [ego]}}
  late: {{units: [ego], latency_s: 0.2}}
  later: {{units: [ego], latency_s: 0.4}}
measure: {{accuracy: {accuracy}, onset: {{kind: appears}}, began: [log_start, appeared]}}
"""
_SUMMARY = """
from copem_replay.results.read import open_results
from copem_replay.results.slices import summarise_slices
table = summarise_slices(open_results(FOLDER), ["log", "class"])
"""
_COMPARE = """
from copem_replay.results.compare import compare_folders
compare_folders([FOLDER], by=BY)
"""
_TIMED = """
import resource, sys
from pathlib import Path
import numpy, pandas, pyarrow.parquet, scipy.special
FOLDER = Path(sys.argv[1])
import copem_replay.results.slices, copem_replay.results.compare
began = resource.getrusage(resource.RUSAGE_SELF)
{work}
ended = resource.getrusage(resource.RUSAGE_SELF)
print(ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime, ended.ru_maxrss / 1024)
"""


def slices() -> Iterator[common.Line]:
    """Processor seconds of `--by log,class`, with accuracy and without, and what it adds to `compare`."""
    for accuracy in (False, True):
        with common.scratch() as folder:
            out = write(folder, accuracy=accuracy)
            works = {"summary": _SUMMARY}
            if not accuracy:
                works |= {"compare": _COMPARE.replace("BY", "None")}
                works |= {"compare_by": _COMPARE.replace("BY", '["log", "class"]')}
            for name, work in works.items():
                command = [sys.executable, "-c", _TIMED.format(work=work), str(out)]
                found = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
                yield {
                    "slices_of": name, "rows": LOGS * RUNS * OBJECTS * 3, "accuracy": accuracy,
                    "cpu_s": round(float(found[0]), 1), "peak_mb": round(float(found[1])),
                }  # fmt: skip


def write(folder: Path, *, accuracy: bool) -> Path:
    """The results of so many short drives: cars and pedestrians that stand around an ego."""
    from tests.helpers.recordings import Obj, pedestrian, write_recording

    names = [f"drive{k}.mcap" for k in range(LOGS)]
    for k, name in enumerate(names):
        frames = []
        for t in range(8):
            things = [Obj(id=1, x=0.0)]
            for n in range(OBJECTS):
                make = (Obj, pedestrian)[n % 2]
                things.append(make(id=2 + n, x=8.0 + 3 * n + k, y=4.0, vx=0.1))
            frames.append((0.1 * t, things))
        write_recording(folder / name, frames, host=1)
    file = folder / "study.yaml"
    words = {"names": ", ".join(names), "runs": RUNS, "accuracy": str(accuracy).lower()}
    file.write_text(EXPERIMENT.format(**words))
    command = [
        sys.executable,
        "-m",
        "copem_replay.cli.main",
        "run",
        str(file),
        "--out",
        str(folder / "out"),
        "--jobs",
        "1",
    ]
    subprocess.run(command, check=True, capture_output=True)
    return folder / "out"
