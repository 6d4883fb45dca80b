"""`compare` of studies of two sizes: what ten times the logs cost in memory and time, in processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd

from benches import common
from copem_replay.pipeline.expansion import ConfigurationFacts
from copem_replay.results.table_files import table_file, write_parquet

RUNS, OBJECTS, CONFIGURATIONS = 500, 20, ("ideal", "late", "later")
_COMPARE = """
import resource, sys, time
from copem_replay.results.compare import compare_folders as compare
began = time.perf_counter()
compare([__import__("pathlib").Path(sys.argv[1])])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, time.perf_counter() - began)
"""


def compare() -> Iterator[common.Line]:
    """3 and 30 logs of 30,000 rows each, in a file for each log."""
    peaks: list[float] = []
    for logs in (3, 30):
        with common.scratch() as folder:
            write(folder, [f"log {k}" for k in range(logs)])
            command = [sys.executable, "-c", _COMPARE, str(folder)]
            peak_mb, seconds = map(float, subprocess.run(command, check=True, capture_output=True).stdout.split())
        rows, peaks = logs * RUNS * OBJECTS * len(CONFIGURATIONS), [*peaks, peak_mb]
        yield {"compare_rows": rows, "peak_mb": round(peak_mb), "seconds": round(seconds, 1)}
    yield {"compare_peak_ratio": round(peaks[1] / peaks[0], 2)}


def write(folder: Path, logs: list[str]) -> None:
    """A results folder of so many logs, without accuracy: each object is detected at one of 50 instants, or never."""
    said = {"format": 4, "seed": 1, "runs": RUNS, "measure": {"horizon_used_s": 10.0}, "braking": None}
    drawn = ConfigurationFacts(
        truth=False, recorded=False, by_truth_id=True, fixed=False, fixed_verdicts=False, needs_visibility=False,
        ideal=None, ideal_of=None,
    )  # fmt: skip
    said["configurations"] = dict.fromkeys(CONFIGURATIONS, asdict(drawn))
    said["logs"] = [{"log": log, "topic": None, "sha256": log} for log in logs]
    (folder / "provenance.json").write_text(json.dumps(said))
    (folder / "experiment.yaml").write_text("version: 1\n")
    (folder / "detections.parquet").mkdir()
    rng, size = np.random.default_rng(1), RUNS * OBJECTS * len(CONFIGURATIONS)
    for log in logs:
        instant = rng.integers(0, 60, size)
        table = pd.DataFrame({
            "log": log,
            "configuration": np.repeat(CONFIGURATIONS, RUNS * OBJECTS),
            "run": np.tile(np.repeat(np.arange(RUNS), OBJECTS), len(CONFIGURATIONS)),
            "object_id": np.tile(np.arange(OBJECTS).astype(str), RUNS * len(CONFIGURATIONS)),
            "episode": 0,
            "onset_s": 0.0,
            "began": "crossed",
            "detected": instant < 50,
            "detection_s": np.where(instant < 50, instant / 10, np.nan),
            "distance_at_detection_m": np.where(instant < 50, 60.0 - instant, np.nan),
            "ended_s": 10.0,
            "ended_by": "object_left",
        })  # fmt: skip
        write_parquet(table, table_file(folder / "detections.parquet", log))
