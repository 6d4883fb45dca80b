"""`compare` of studies of two sizes: what ten times the logs cost in memory and time, in processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd

from benches import common
from copem_replay.pipeline.expansion import ConfigurationFacts
from copem_replay.results.provenance import FORMAT
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


_VERDICT = """
import sys, time
import copem_replay as cr
import copem_replay.results.judge
began = time.process_time()
verdicts = cr.judge(sys.argv[1])
print(len(verdicts.all), time.process_time() - began)
"""
_METRICS = ("detected_share", "ttd_p5_s", "ttd_median_s", "ttd_p95_s", "ttd_rmst_s", "unknown_s", "dad_median_m",
            "dad_p5_m", "left_undetected_share", "open_share")  # fmt: skip
LOGS, INSTANTS = 10, 100


def verdict() -> Iterator[common.Line]:
    """20 criteria, each for every one of ten logs, on a tally of a million rows: processor seconds without imports."""
    with common.scratch() as folder:
        rows = write_tally(folder)
        command = [sys.executable, "-c", _VERDICT, str(folder)]
        number, seconds = subprocess.run(command, check=True, capture_output=True).stdout.split()
    yield {"verdict_rows": rows, "verdicts": int(number), "cpu_s": round(float(seconds), 2)}


def write_tally(folder: Path) -> int:
    """A results folder with a tally of ten logs, two configurations and 500 objects; how many rows it has.

    Each object is detected at one of 99 instants or never, and a third of them are still there when the log ends.
    """
    rng, episodes = np.random.default_rng(1), LOGS * 2 * 500
    names, instant = ("PEM", "coPEM"), np.append(np.arange(INSTANTS - 1) / 20, np.nan)

    def each(values: Sequence[object], before: int, after: int) -> np.ndarray:
        return np.tile(np.repeat(np.array(values, dtype=object), after), before)

    time_s = np.tile(instant, episodes)
    tally = pd.DataFrame({
        "log": each([f"log {k}" for k in range(LOGS)], 1, 2 * 500 * INSTANTS),
        "configuration": each(names, LOGS, 500 * INSTANTS),
        "event": "detected",
        "object_id": each([str(k) for k in range(500)], LOGS * 2, INSTANTS),
        "object_class": "car", "episode": 0, "onset_s": 0.0, "distance_at_onset_m": 50.0, "began": "crossed",
        "ended_s": np.repeat(rng.uniform(4.0, 12.0, episodes), INSTANTS),
        "ended_by": np.repeat(np.where(rng.random(episodes) < 1 / 3, "log_end", "object_left"), INSTANTS),
        "detection_s": time_s, "time_to_detection_s": time_s,
        "distance_at_detection_m": 60.0 - 10.0 * time_s, "gap_at_detection_m": 55.0 - 10.0 * time_s,
        "runs": 1,
    })  # fmt: skip
    write_parquet(tally, folder / "tally.parquet")
    rows = tally.assign(run=np.arange(len(tally)) % INSTANTS, detected=~np.isnan(time_s))
    write_parquet(rows.drop(columns=["event", "runs"]), folder / "detections.parquet")
    (folder / "summary.csv").write_text("configuration,detected_share\n")
    criteria = {
        f"{metric} of {name}": {"metric": metric, "at_most": 1.0, "each": "log", "configurations": [name]}
        for metric in _METRICS
        for name in names
    }
    units = {"ego": {"on": "ego", "pem": "one"}}
    pem = [{"detection": {"kind": "constant", "probability": 0.5}}]
    experiment = {
        "version": 1, "logs": [f"log {k}.mcap" for k in range(LOGS)], "pems": {"one": pem}, "units": units,
        "configurations": {name: {"units": ["ego"]} for name in names}, "measure": {"accuracy": False},
        "criteria": criteria,
    }  # fmt: skip
    write_provenance(folder, names, [f"log {k}" for k in range(LOGS)])
    (folder / "experiment.yaml").write_text(json.dumps(experiment))
    return len(tally)


def write_provenance(folder: Path, names: Sequence[str], logs: Sequence[str]) -> None:
    """What made the results: nothing that is fixed."""
    said = {"format": FORMAT, "seed": 1, "runs": RUNS, "measure": {"horizon_used_s": 10.0}, "braking": None}
    drawn = ConfigurationFacts(
        truth=False, recorded=False, by_truth_id=True, fixed=False, fixed_verdicts=False, needs_visibility=False,
        ideal=None, ideal_of=None, remembering=None,
    )  # fmt: skip
    said["configurations"] = dict.fromkeys(names, asdict(drawn))
    said["logs"] = [{"log": log, "topic": None, "sha256": log, "truth": log} for log in logs]
    (folder / "provenance.json").write_text(json.dumps(said))


def write(folder: Path, logs: list[str]) -> None:
    """A results folder of so many logs, without accuracy: each object is detected at one of 50 instants, or never."""
    write_provenance(folder, CONFIGURATIONS, logs)
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
