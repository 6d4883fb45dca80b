"""What it takes to explain lateness: the crossing in 200 runs, and a drive with the experiment that `init` writes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from benches import common

RUNS = 200
_EXPLAINED = """
import resource, sys
import copem_replay as cr
file, runs, configurations, parts = sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4]
experiment = cr.load_experiment(file)
experiment = experiment.model_copy(update={"runs": runs or experiment.runs})
question = {"configurations": configurations.split(",") if configurations else None, "parts": parts.split(",")}
recordings = cr.read_recordings(experiment)
cr.why(experiment.model_copy(update={"runs": 2}), recordings, **question)  # compiled and warm
began = resource.getrusage(resource.RUSAGE_SELF)
cr.why(experiment, recordings, **question)
ended = resource.getrusage(resource.RUSAGE_SELF)
print(ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime)
"""


def why() -> Iterator[common.Line]:
    """Processor seconds without the start of Python: a chain of causes, the worth of six units, all of a drive."""
    yield _line("crossing.yaml: causes of ideal", common.ROOT / "logs/crossing.yaml", RUNS, "ideal", "causes")
    yield _line(
        "crossing_radio.yaml: causes of bursts", common.ROOT / "logs/crossing_radio.yaml", RUNS, "bursts", "causes"
    )
    yield _line("crossing.yaml: six units of ideal", common.ROOT / "logs/crossing.yaml", RUNS, "ideal", "units")
    drive = common.ROOT.parent / "shared/data/nuscenes_scene0061.mcap"
    if drive.is_file():
        with common.scratch() as folder:
            file = folder / "drive.yaml"
            text = subprocess.run([*common.TOOL, "init", str(drive)], check=True, capture_output=True, text=True).stdout
            file.write_text(text)
            yield _line("a drive of 19 s with init's experiment: all parts", file, 0, "", ",".join(_PARTS))


_PARTS = ("causes", "units", "triage", "sensitivity")


def _line(what: str, file: Path, runs: int, configurations: str, parts: str) -> common.Line:
    command = [sys.executable, "-c", _EXPLAINED, str(file), str(runs), configurations, parts]
    found = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return {"why_cpu_s": round(float(found), 2), "of": what}
