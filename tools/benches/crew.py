"""What processes give: `--cluster local:2` against one thread and two, on recorded drives, and memory of a worker.

Twice: with accuracy, as an experiment has it that does not say otherwise, and with times of detection alone.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from benches import common

DATA = common.ROOT.parent / "shared/data"
DRIVES = ("av2_3b3570b4", "nuscenes_scene0061", "nuscenes_scene0916")
NAMES, RUNS = 11, 1000
EXPERIMENT = f"""\
version: 1
logs: ["*.mcap"]
runs: {RUNS}
show: null
max_gap_s: 0.6
pems: {{cam: [{{when: {{range_m: [0, 80]}}, detection: {{kind: visible_share}}}}]}}
units: {{ego: {{on: ego, height_m: 1.8, pem: cam}}}}
configurations: {{alone: {{units: [ego]}}, late: {{units: [ego], latency_s: 0.3}}}}
measure: {{accuracy: ACCURACY}}
"""


def crew() -> Iterator[common.Line]:
    """Eleven names of three recorded drives; seconds from reading to the tables, Dask's start-up apart."""
    data = Path(os.environ.get("COPEM_REPLAY_DATA", DATA))
    if any(not (data / f"{name}.mcap").exists() for name in DRIVES):
        yield {"crew": f"skipped: no recorded drives ({', '.join(DRIVES)}) in {data}"}
        return
    with common.scratch() as folder:
        for k in range(NAMES):
            shutil.copy(data / f"{DRIVES[k % len(DRIVES)]}.mcap", folder / f"drive{k:02d}.mcap")
        for accuracy in (True, False):
            (folder / "e.yaml").write_text(EXPERIMENT.replace("ACCURACY", str(accuracy).lower()))
            yield {"accuracy": accuracy} | _compared(folder)


def _compared(folder: Path) -> common.Line:
    """Each way twice, the quicker one of it."""
    ways = ("one_thread", "two_threads", "local:2")
    found = {way: [] for way in ways}
    for _ in range(2):
        for way in ways:
            for name in ("kept", "warm"):
                shutil.rmtree(folder / name, ignore_errors=True)
            command = [sys.executable, "-c", _ONE_WAY, str(common.ROOT / "tools"), way, str(folder)]
            ended = subprocess.run(command, check=True, capture_output=True, text=True)
            found[way].append([float(value) for value in ended.stdout.split()])
    one, two, local = (min(found[way]) for way in ways)
    return {
        "crew_speed_up": round(one[0] / local[0], 2), "threads_speed_up": round(one[0] / two[0], 2),
        "seconds": round(local[0], 1), "start_s": round(local[1], 1), "one_thread_s": round(one[0], 1),
        "computed_s": round(local[4], 1), "worker_peak_mb": round(local[2]), "rows": int(one[3]),
    }  # fmt: skip


_ONE_WAY = "import sys; sys.path.insert(0, sys.argv[1]); from benches.crew import go; go(*sys.argv[2:])"


def go(way: str, folder: str) -> None:
    """Print seconds of one way, of its start, megabytes of a worker at most, rows: in a process of its own."""
    import copem_replay as cr
    from copem_replay.api.run import replay_study
    from copem_replay.api.study import make_study, prepare_study
    from copem_replay.extras.cluster.crew import Crew
    from copem_replay.extras.cluster.dask_workers import connect_workers
    from copem_replay.pipeline.parts import PartCache
    from copem_replay.pipeline.study_log import LogSurvey

    os.chdir(folder)
    cr.run("e.yaml", "drive00.mcap", jobs=1)  # compiled, and warm
    if way != "local:2":
        began_s = time.perf_counter()
        result = cr.run("e.yaml", jobs=1 if way == "one_thread" else 2)
        print(time.perf_counter() - began_s, 0, 0, len(result.detections), 0)
        return
    began_s = time.perf_counter()
    with connect_workers(way, PartCache("warm"), 2) as workers:
        warm = Crew(workers, parts := PartCache("warm"))  # kernels are loaded in the workers, too
        warm.read_study(lambda: make_study("e.yaml", ["drive00.mcap", "drive01.mcap"], LogSurvey(parts), warm))
        start_s, began_s = time.perf_counter() - began_s, time.perf_counter()
        hands = Crew(workers, parts := PartCache("kept"))
        study = hands.read_study(lambda: make_study("e.yaml", None, LogSurvey(parts), hands))
        computed_s = time.perf_counter() - began_s
        rows = sum(replay_study(study, prepare_study(study)[0], 1, None, parts).counts.values())
        took_s = time.perf_counter() - began_s
    print(took_s, start_s, hands.peak_bytes / 1e6, rows, computed_s)
