"""Benchmarks, one JSON line each. Ratios are taken within one run: trust them, not the absolute figures.

python tools/bench.py [name …]
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

import bench_compare
import bench_crew
import bench_fit
import bench_fusion
import bench_links
import bench_long
import bench_memory
import bench_read
import bench_viewer
import bench_write
from copem_replay.core.tracks import TRUTH, Tracks
from copem_replay.experiment.file import load, log_paths
from copem_replay.experiment.validate import problems, read_logs
from copem_replay.io.recording import read
from copem_replay.perception.visibility import NO_STATICS, Flat, Observers, Surface, visible_shares
from copem_replay.pipeline.blocks import replay_block
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare

ROOT = Path(__file__).parents[1]


def main(names: list[str]) -> None:
    for bench in BENCHES:
        if not names or bench.__name__ in names:
            for line in bench():
                print(json.dumps(line), flush=True)


def best(work: Callable[[], object], times: int = 5) -> float:
    """Seconds of the fastest of several calls, after one that compiles and warms up."""
    work()
    return min(_seconds(work) for _ in range(times))


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def boxes(frames: int, count: int) -> Tracks:
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
    return Tracks(
        units=(TRUTH,), start=np.arange(count + 1) * frames, unit_ix=np.zeros(count, dtype=int),
        object_ix=np.arange(count), frame_ix=np.tile(np.arange(frames), count),
        stamp_ns=np.rint(t * 1e9).astype(np.int64), captured_s=t, frame_unit_ix=np.zeros(frames, dtype=int),
        arrives_s=t[None], valid=np.ones((1, count * frames), dtype=bool), x_m=x.reshape(1, -1), y_m=y.reshape(1, -1),
        z_m=rows(height) / 2, yaw_rad=rows(heading), vx_mps=zero, vy_mps=zero, length_m=rows(length),
        width_m=rows(width), height_m=rows(height),
    )  # fmt: skip


def visibility() -> Iterator[dict[str, object]]:
    """Views per second at 1200 lists × 60 boxes × 21 units."""
    frames, count, units = 1200, 60, 21
    world, rng = boxes(frames, count), np.random.default_rng(1)
    place = np.empty((units, frames, 3))
    place[..., :2] = rng.uniform(-60, 60, (units, 1, 2))
    place[..., 2] = rng.choice([1.8, 5.0], (units, 1))
    observers = Observers(place, np.ones((units, frames), dtype=bool), np.full(units, -1))
    for model in (Flat(), Surface()):
        seconds = best(lambda model=model: visible_shares(world, NO_STATICS, observers, model), 3)
        yield {f"visibility_{model.kind}_views_per_s": round(units * frames * count / seconds)}


def paper() -> Iterator[dict[str, object]]:
    """The six configurations × 500 runs of the sample scenario.

    Detections alone, against NumPy drawing as many uniforms × 3; and with measures, verdicts and summary, against the
    time that goes by in the scenario (after reading and compilation, workers as many as cores); most of the work is
    accuracy (RMSE, GOSPA, …).
    """
    from copem_replay.pipeline.run import run

    experiment, recordings = _loaded(ROOT / "logs/tc016d.yaml")
    listed = experiment.model_copy(update={"braking": None})
    ready, runs = prepare(recordings[0], listed), np.arange(experiment.runs)
    rng = np.random.default_rng(1)
    cells = len(ready.measured.tracks.frame_ix) * experiment.runs
    ours = best(lambda: replay_block(ready, listed, runs))
    theirs = best(lambda: rng.random(3 * cells))
    count = experiment.runs * len(experiment.configurations)
    yield {"paper_draw_ratio": round(ours / theirs, 2), "seconds": round(ours, 4), "runs_per_s": round(count / ours)}
    variants = {
        "": {"exact": False},
        "_with_exact": {"exact": True},
        "_without_accuracy": {"exact": False, "accuracy": False},
    }
    took_s: dict[str, float] = {}
    for name, keys in variants.items():
        whole = experiment.model_copy(update={"measure": experiment.measure.model_copy(update=keys)})
        seconds = best(lambda whole=whole: run(whole, recordings, jobs=os.cpu_count() or 1))
        took_s[name] = seconds
        factor = round(count * recordings[0].scene.end_s / seconds)
        yield {f"paper{name}_realtime_factor": factor, "seconds": round(seconds, 3)}
    yield {"paper_accuracy_cost": round(took_s[""] / took_s["_without_accuracy"], 1)}


def reading() -> Iterator[dict[str, object]]:
    """Reading 60 s × 20 Hz × 60 objects, against parsing the messages and touching the same fields in a plain loop."""
    with _scratch() as folder:
        path = folder / "read.mcap"
        _write_truth(path, boxes(1200, 60))
        ours = best(lambda: read(path, name="read"), 3)
        plain = best(lambda: _plain_loop(path), 3)
        yield {"read_ratio": round(ours / plain, 3), "read_objects_per_s": round(72_000 / ours)}
        yield from bench_read.benches(folder, path, best)


def writing() -> Iterator[dict[str, object]]:
    """The crossing: objects per second into MCAP (all channels) and into messages (of three channels); boxes per second
    and bytes per box into .rrd, seconds to see it.
    """
    from copem_replay.io.write.mcap import write_mcap
    from copem_replay.metrics.summary import horizon_s, summary
    from copem_replay.viewer import write_rrd

    experiment, recordings = _loaded(ROOT / "logs/crossing.yaml")
    experiment = experiment.model_copy(update={"configurations": experiment.shown()})
    ready = prepare(recordings[0], experiment)
    run_tracks = tracks_of_run(ready, experiment, 0)
    table = replay_block(ready, experiment, np.arange(1))
    rates: dict[str, float | None] = dict.fromkeys(experiment.configurations)
    rows, _ = summary(table, list(experiment.configurations), rates, seed=1, horizon_s=horizon_s(table, None))
    listed = sum(int(lists.fused.valid.sum()) for lists in run_tracks.values())
    shown = listed + len(ready.truth.frame_ix)
    with _scratch() as folder:
        mcap, rrd = folder / "w.mcap", folder / "w.rrd"
        seconds = best(lambda: write_mcap(mcap, recordings[0].path, ready.scene, [run_tracks], table, {}), 3)
        yield {"mcap_objects_per_s": round(listed / seconds), "objects": listed}
        yield from bench_write.encoding(best, ready.scene, run_tracks, "ideal")
        seconds = best(lambda: write_rrd(rrd, ready, experiment, [run_tracks], table, rows, 0), 3)
        yield {
            "rrd_boxes_per_s": round(shown / seconds),
            "rrd_bytes_per_box": round(rrd.stat().st_size / shown, 1),
            "boxes": shown,
        }
        yield bench_viewer.first_picture(rrd)


def commands() -> Iterator[dict[str, object]]:
    """Seconds of `--help` and `info`, seconds and peak memory of what `make demo` runs."""
    tool = [sys.executable, "-m", "copem_replay.cli.main"]
    for name, words in (("help", ["--help"]), ("info", ["info", str(ROOT / "logs/tc016d.mcap")])):
        seconds = best(lambda words=words: subprocess.run([*tool, *words], check=True, stdout=subprocess.DEVNULL), 3)
        yield {f"{name}_s": round(seconds, 3)}
    with _scratch() as folder:
        words = ["run", str(ROOT / "logs/tc016d.yaml"), "--overwrite", "--out", str(folder / "out")]
        code = (
            "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL);"
            "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
        )
        command = [sys.executable, "-c", code, *tool, *words]
        seconds = best(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL), 2)
        peak_kib = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        yield {"demo_s": round(seconds, 2), "demo_peak_mb": round(peak_kib / 1024)}


def reports() -> Iterator[dict[str, object]]:
    """Seconds of `copem-replay report` on the sample (6 configurations) and the crossing (18), kilobytes of each.

    And of `report` and `plot` on 4 and 40 names of the sample's log, 70,000 rows each, with the most memory.
    """
    tool = [sys.executable, "-m", "copem_replay.cli.main"]
    with _scratch() as folder:
        for name, key in (("tc016d", "report"), ("crossing", "report_18")):
            out = folder / name
            run = [*tool, "run", str(ROOT / f"logs/{name}.yaml"), "--out", str(out)]
            subprocess.run(run, check=True, stdout=subprocess.DEVNULL)
            command = [*tool, "report", str(out)]
            seconds = best(lambda command=command: subprocess.run(command, check=True, stdout=subprocess.DEVNULL), 3)
            yield {f"{key}_s": round(seconds, 2), f"{key}_kb": round((out / "report.html").stat().st_size / 1000)}
        for k in range(40):
            shutil.copy(ROOT / "logs/tc016d.mcap", folder / f"{k:02}.mcap")
        for names in ("0[0-3].mcap", "*.mcap"):
            text = NAMES.replace("*.mcap", names).replace("runs: 64", "runs: 5000")
            (folder / "rows.yaml").write_text(text.replace("{alone", "{late: {units: [ego], latency_s: 0.3}, alone"))
            _spent(["run", str(folder / "rows.yaml"), "--overwrite", "--out", str(folder / "rows")])
            rows = pd.read_csv(folder / "rows/logs.csv")["rows"].sum()
            for command in ("report", "plot"):
                spent = _spent([command, str(folder / "rows")])
                yield {f"{command}_rows": int(rows), "seconds": round(spent.seconds, 1), "peak_mb": spent.peak_mb}


def fusion() -> Iterator[dict[str, object]]:
    """Fused lists per second on the crossing, and how the time of one grows; see bench_fusion.py."""
    experiment, recordings = _loaded(ROOT / "logs/crossing.yaml")
    yield from bench_fusion.crossing(best, experiment, recordings[0])
    yield from bench_fusion.gnn_growth(best)
    yield from bench_fusion.combining(best)


def peers() -> Iterator[dict[str, object]]:
    """Fusion and GOSPA against NumPy and SciPy, and against Stone Soup."""
    for bench in (bench_fusion.gnn_vs_numpy, bench_fusion.gospa_vs_stonesoup, bench_fusion.tracker_vs_stonesoup):
        yield from bench(best)


def _loaded(path: Path):
    source = load(path)
    experiment, found = problems(source)
    assert experiment is not None, found
    recordings, refused = read_logs(experiment, log_paths(source)[0], source)
    assert not refused, refused
    return experiment, recordings


def long() -> Iterator[dict[str, object]]:
    """Twenty minutes of recording, and an hour; see bench_long.py. It takes a quarter of an hour."""
    with _scratch() as folder:
        yield from bench_long.long(folder)


def crowd() -> Iterator[dict[str, object]]:
    """200 units among 200 objects in a disc of 60 m, 60 frames, 5 runs, `ideal` and `gnn`: all that a run does."""
    frames, count = 60, 200
    with _scratch() as folder:
        _write_truth(folder / "crowd.mcap", boxes(frames, count))
        yield bench_long.crowd(folder, frames, count)


def links() -> Iterator[dict[str, object]]:
    """A minute of 20 objects, five of which send what they see by radio: what it costs that arrivals are drawn."""
    with _scratch() as folder:
        _write_truth(folder / "minute.mcap", boxes(600, 20))
        yield from bench_links.links(read(folder / "minute.mcap", name="minute", ego="0"))


@contextmanager
def _scratch() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def _write_truth(path: Path, world: Tracks) -> None:
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


def _plain_loop(path: Path) -> int:
    """What a script would do: parse every message, touch every field that `read` needs, keep the numbers."""
    from mcap.reader import make_reader
    from osi3.osi_groundtruth_pb2 import GroundTruth

    rows = []
    with path.open("rb") as file:
        for _schema, _channel, message in make_reader(file).iter_messages():
            truth = GroundTruth.FromString(message.data)
            t = truth.timestamp.seconds * 10**9 + truth.timestamp.nanos
            for item in truth.moving_object:
                base = item.base
                rows.append(
                    (t, item.id.value, item.type, item.vehicle_classification.type,
                     base.position.x, base.position.y, base.position.z, base.orientation.yaw,
                     base.velocity.x, base.velocity.y,
                     base.dimension.length, base.dimension.width, base.dimension.height)
                )  # fmt: skip
    return len(pd.DataFrame(rows))


def memory() -> Iterator[dict[str, object]]:
    """Numbers that last, and the crossing with all memory on."""
    yield from bench_memory.memory(*_loaded(ROOT / "logs/crossing.yaml"))


def pieces() -> Iterator[dict[str, object]]:
    """What keeping pieces costs, in CPU seconds of commands; and a finished study of 5,000 names, no log read."""
    with _scratch() as folder:
        kept, plain, keeping = str(folder / "kept"), [], []
        command = ["run", str(ROOT / "logs/crossing_share.yaml"), "--overwrite", "--out", str(folder / "out")]
        for _ in range(3):
            plain.append(_spent(command).cpu_s)
            shutil.rmtree(kept, ignore_errors=True)
            keeping.append(_spent([*command, "--pieces", kept]).cpu_s)
        before, after = float(np.median(plain)), float(np.median(keeping))
        yield {"pieces_overhead": round(after / before - 1, 3), "seconds": round(before, 2)}
        shutil.copy(ROOT / "logs/tc016d.mcap", folder / "0.mcap")
        for k in range(1, 5000):
            (folder / f"{k}.mcap").hardlink_to(folder / "0.mcap")
        (folder / "names.yaml").write_text(NAMES)
        command = ["run", str(folder / "names.yaml"), "--overwrite", "--out", str(folder / "many"), "--pieces", kept]
        first, again = _spent(command), _spent(command)
        yield {"resume_cpu_s": round(again.cpu_s, 1), "seconds": round(again.seconds, 1), "mb": again.peak_mb,
               "first_cpu_ms_a_log": round(first.cpu_s / 5, 1), "first_mb": first.peak_mb}  # fmt: skip


NAMES = """\
version: 1
logs: ["*.mcap"]
runs: 64
show: null
pems: {cam: [{detection: {kind: visible_share}}]}
units: {ego: {on: ego, height_m: 1.8, pem: cam}}
configurations: {alone: {units: [ego]}}
measure: {accuracy: false}
"""


class Spent(NamedTuple):
    """By a command: of all its threads together, of the clock, and the most memory."""

    cpu_s: float
    seconds: float
    peak_mb: int


def _spent(arguments: list[str]) -> Spent:
    began, null = time.perf_counter(), subprocess.DEVNULL
    command = [sys.executable, "-m", "copem_replay.cli.main", *arguments]
    process = subprocess.Popen(command, stdout=null, stderr=null)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if status:
        raise subprocess.CalledProcessError(process.returncode, command)
    return Spent(used.ru_utime + used.ru_stime, time.perf_counter() - began, used.ru_maxrss // 1024)


def crew() -> Iterator[dict[str, object]]:
    """Processes against threads, on recorded drives where they are; see bench_crew.py."""
    with _scratch() as folder:
        yield from bench_crew.crew(folder)


def fit() -> Iterator[dict[str, object]]:
    """Fitting a perception error model to 10⁵ rows; see bench_fit.py."""
    yield from bench_fit.detection()


def compare() -> Iterator[dict[str, object]]:
    """Comparing studies of 3 and 30 logs; see bench_compare.py."""
    yield from bench_compare.studies()


BENCHES = (
    pieces, compare, crew, visibility, memory, fit, paper, reading, writing, commands, reports, fusion, peers, links,
    crowd,
    long,
)  # fmt: skip

if __name__ == "__main__":
    main(sys.argv[1:])
