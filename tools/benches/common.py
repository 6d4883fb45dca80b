"""What all benchmarks share: how time and memory are taken, and the recordings that they are taken on."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

import copem_replay as cr
from copem_replay.core.tracks import TRUTH

ROOT = Path(__file__).parents[2]
TOOL = (sys.executable, "-m", "copem_replay.cli.main")
Line = dict[str, object]
sys.path.insert(0, str(ROOT))  # tests/oracles and tests/helpers: peers, plainly written


# ------------------------------------------------------------------------------------------------------ time and memory


class Timed(NamedTuple):
    """What a call gave, seconds of the clock, and of the processor in all its threads."""

    result: Any
    seconds: float
    cpu_s: float


def timed(work: Callable[[], object]) -> Timed:
    start, busy = time.perf_counter(), time.process_time()
    result = work()
    return Timed(result, time.perf_counter() - start, time.process_time() - busy)


def best(work: Callable[[], object], times: int = 5) -> float:
    """Seconds of the fastest of several calls, after one that compiles and warms up."""
    work()
    return min(timed(work).seconds for _ in range(times))


def interleaved(calls: Sequence[Callable[[], object]], times: int = 9) -> list[float]:
    """Median processor seconds of each call, in turn, after one that compiles and warms up."""
    for call in calls:
        call()
    took = [[timed(call).cpu_s for call in calls] for _ in range(times)]
    return [median(seconds) for seconds in zip(*took, strict=True)]


class Spent(NamedTuple):
    """By a command: of all its threads together, of the clock, and the most memory."""

    cpu_s: float
    seconds: float
    peak_mb: int


def spent(
    arguments: Sequence[str],
    folder: Path | None = None,
    *,
    command: Sequence[str] = TOOL,
    stdout: int | None = subprocess.DEVNULL,
) -> Spent:
    """By a command, of the project unless another is named, in a folder. Raises CalledProcessError where it fails.

    `stdout` None: what it prints is printed. Processes that it waits for count, of memory the largest alone.
    """
    began, whole = time.perf_counter(), [*command, *arguments]
    process = subprocess.Popen(
        whole, cwd=folder, stdout=stdout, stderr=subprocess.DEVNULL if stdout else None,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": ""},  # modules are compiled once, as they are for users
    )  # fmt: skip
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if status:
        raise subprocess.CalledProcessError(process.returncode, whole)
    return Spent(used.ru_utime + used.ru_stime, time.perf_counter() - began, used.ru_maxrss // 1024)


def as_line(took: Spent) -> Line:
    """Rounded, for a line of a benchmark."""
    return {"cpu_s": round(took.cpu_s, 2), "seconds": round(took.seconds, 2), "peak_mb": took.peak_mb}


# ----------------------------------------------------------------------------------------------------------- recordings


def boxes(frames: int, count: int) -> cr.Tracks:
    """Boxes on random straight ways in a disc of 60 m: 60 % cars, 15 % trucks, 25 % pedestrians (chosen)."""
    rng = np.random.default_rng(0)
    kind = rng.choice(3, count, p=[0.6, 0.15, 0.25])
    length, width, height = (np.array(v)[kind] for v in ((4.5, 10, 0.5), (1.9, 2.5, 0.5), (1.5, 3.5, 1.8)))
    radius, angle = 60 * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
    heading, t = rng.uniform(-np.pi, np.pi, count), np.arange(frames) * 0.05
    x = (radius * np.cos(angle))[:, None] + np.cos(heading)[:, None] * t * 0.5
    y = (radius * np.sin(angle))[:, None] + np.sin(heading)[:, None] * t * 0.5

    def rows(values: np.ndarray) -> np.ndarray:
        return np.repeat(values, frames)[None]

    zero = np.zeros((1, count * frames))
    return cr.Tracks(
        units=(TRUTH,), start=np.arange(count + 1) * frames, unit_ix=np.zeros(count, dtype=int),
        object_ix=np.arange(count), frame_ix=np.tile(np.arange(frames), count),
        stamp_ns=np.rint(t * 1e9).astype(np.int64), captured_s=t, frame_unit_ix=np.zeros(frames, dtype=int),
        arrives_s=t[None], valid=np.ones((1, count * frames), dtype=bool), x_m=x.reshape(1, -1), y_m=y.reshape(1, -1),
        z_m=rows(height) / 2, yaw_rad=rows(heading), vx_mps=zero, vy_mps=zero, length_m=rows(length),
        width_m=rows(width), height_m=rows(height),
    )  # fmt: skip


def spread_boxes(frames: int, count: int) -> cr.Tracks:
    """As `boxes`, in a disc that grows with their number: as many are around each as of 60 in 60 m."""
    world, wider = boxes(frames, count), float(np.sqrt(count / 60))
    return replace(world, x_m=world.x_m * wider, y_m=world.y_m * wider)


def write_truth(path: Path, world: cr.Tracks) -> None:
    from mcap_protobuf.writer import Writer
    from osi3.osi_groundtruth_pb2 import GroundTruth

    order, bounds = world.by_frame
    columns = [getattr(world, n)[0] for n in ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")]
    with path.open("wb") as file, Writer(file) as writer:
        for f, stamp in enumerate(world.stamp_ns.tolist()):
            truth = GroundTruth()
            truth.timestamp.seconds, truth.timestamp.nanos = divmod(stamp, 10**9)
            truth.host_vehicle_id.value = 0
            for r in order[bounds[f] : bounds[f + 1]].tolist():
                item = truth.moving_object.add()
                item.id.value, item.type = int(world.row_object_ix[r]), 2
                item.vehicle_classification.type = 4
                base = item.base
                x, y, z, yaw, length, width, height = (float(c[r]) for c in columns)
                base.position.x, base.position.y, base.position.z = x, y, z
                base.orientation.yaw = yaw
                base.velocity.x, base.velocity.y = 1.0, 0.5
                base.dimension.length, base.dimension.width, base.dimension.height = length, width, height
            writer.write_message("truth", truth, log_time=stamp, publish_time=stamp)


def loaded(sample: str) -> tuple[cr.Experiment, list[cr.Recording]]:
    """An experiment of logs/, and its recordings."""
    experiment = cr.load_experiment(ROOT / f"logs/{sample}.yaml")
    return experiment, cr.read_recordings(experiment)


@contextmanager
def scratch() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)
