"""Seconds of a process by part, and processes that are timed so: a command of ours, and its floor.

The floor of a command is a script that imports the modules of the same libraries, does with them what cannot be left
out, and ends. Of `run`: it reads the same recordings with Google's parser, writes the same messages through
`mcap.Writer` and the same boxes by Rerun's `send_columns`. Of `plot` and `report`: matplotlib draws the same figures,
each once. Of the others: nothing but the imports.

Whatever is imported, and whenever, is of the part `start`; `end` is all that comes after the results are written.
`work`: of other commands than `run`, all but imports and the end of the process.
"""

from __future__ import annotations

import gc
import importlib
import json
import pickle
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

START, READ, REPLAY, TABLES, MCAP, RRD, END = "start", "read", "replay", "tables", "MCAP", ".rrd", "end"
WORK = "work"
NOT_COUNTED = "not counted"
OURS = {
    "copem_replay.api.study": {"read_study": READ, "prepare_study": READ},
    "copem_replay.api.run": {"replay_study": REPLAY},
    "copem_replay.results.write": {"fill_place": TABLES},
}
"""Functions of the package that `run` calls once each, and their parts; what comes before is of the start."""


class Parts:
    """Seconds of the clock and of the processor, each counted once: for the innermost part of the main thread."""

    def __init__(self, begun_s: float) -> None:
        """`begun_s`: when the process was started, by the clock of `time.perf_counter`."""
        self.took: dict[str, list[float]] = {}
        self._within, self._at = [START], (begun_s, 0.0)

    def _count(self) -> None:
        now = time.perf_counter(), time.process_time()
        of_part = self.took.setdefault(self._within[-1], [0.0, 0.0])
        for k in (0, 1):
            of_part[k] += now[k] - self._at[k]
        self._at = now

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        """What is done within is of this part; of the main thread alone."""
        if threading.current_thread() is not threading.main_thread() or NOT_COUNTED in self._within:
            yield
            return
        self._count()
        self._within.append(part)
        try:
            yield
        finally:
            self._count()
            self._within.pop()

    def go_on(self, part: str) -> None:
        """What is in no other part is of this one from now on."""
        self._count()
        self._within[0] = part

    def counted(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        """A function that is counted as a part."""

        def call(*arguments: Any, **named: Any) -> Any:
            with self.of(part):
                return function(*arguments, **named)

        return call

    def print(self) -> None:
        """Print the parts as JSON, the last line; what comes is of the end."""
        self._count()
        print("\n" + json.dumps(self.took), flush=True)

    def count_imports(self) -> None:
        """From now on all imports are of the start."""
        bootstrap: Any = importlib._bootstrap  # type: ignore[attr-defined]
        bootstrap._find_and_load = self.counted(bootstrap._find_and_load, START)


# ------------------------------------------------------------------------------------------------------------ commands


def run_command(parts: Parts, keep: Path | None, words: list[str]) -> None:
    """Call a command in this process. `keep`: a folder for the names of the modules that it has imported in the end."""
    from copem_replay.cli.main import main

    if words[0] == "run":
        _count_run(parts)
    else:
        parts.go_on(WORK)
    sys.argv = ["copem-replay", *words]
    try:
        main()
    except SystemExit as ended:
        if ended.code not in (None, 0, 1):
            raise
    parts.go_on(END)
    if keep is not None:
        names = [name for name in sys.modules if name.partition(".")[0] not in ("copem_replay", "benches", "__main__")]
        (keep / "modules.json").write_text(json.dumps(names))


def _count_run(parts: Parts) -> None:
    for name, functions in OURS.items():
        module = importlib.import_module(name)
        for function, part in functions.items():
            setattr(module, function, parts.counted(getattr(module, function), part))
    api: Any = importlib.import_module("copem_replay.api.run")
    write = importlib.import_module("copem_replay.results.write")
    list_exporters, fill_place = api.list_exporters, write.fill_place

    def list_counted(viewer: str | None = None) -> list[Any]:
        named = {".mcap": MCAP, ".rrd": RRD}
        return [replace(one, write=parts.counted(one.write, named[one.suffix])) for one in list_exporters(viewer)]

    def fill_and_end(*arguments: Any, **named: Any) -> Any:
        try:
            return fill_place(*arguments, **named)
        finally:
            parts.go_on(END)

    api.list_exporters, write.fill_place = list_counted, fill_and_end  # type: ignore[attr-defined]


# -------------------------------------------------------------------------------------------------------------- floors


def run_floor(parts: Parts, keep: Path, words: list[str]) -> None:
    """Do in this process what a command cannot leave out. `words`: recordings that it reads; there may be none."""
    for name in json.loads((keep / "modules.json").read_text()):
        with suppress(Exception):  # such as modules that C code makes: they come with those that have them
            importlib.import_module(name)
    parts.go_on(END)
    for path in words:
        with parts.of(READ):
            read_plainly(Path(path))
    for path, part, write in (("messages", MCAP, write_plainly), ("boxes", RRD, send_plainly)):
        if (keep / path).exists():
            with parts.of(part):
                write(keep / path, keep / f"{path}.out")
    if (keep / "draws.json").exists():
        draw_plainly(parts, json.loads((keep / "draws.json").read_text()))


def read_plainly(path: Path) -> int:
    """Read all messages of OSI with Google's parser, object by object; how many objects there are."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass
    from mcap.reader import make_reader

    made: dict[int, Any] = {}
    rows: list[tuple[float, ...]] = []
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages():
            if schema is None or schema.name not in ("osi3.GroundTruth", "osi3.SensorData"):
                continue
            if schema.id not in made:
                pool = DescriptorPool()
                for definition in FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(definition)
                made[schema.id] = GetMessageClass(pool.FindMessageTypeByName(schema.name))
            said = made[schema.id].FromString(message.data)
            for item in said.moving_object:
                base = item.base
                at, size = base.position, base.dimension
                rows.append((at.x, at.y, at.z, base.orientation.yaw, size.length, size.width, size.height))
    return len(rows)


def keep_messages(mcap: Path, folder: Path) -> None:
    """Keep the messages of a file for `write_plainly`: their bytes, and where each ends."""
    from mcap.reader import make_reader

    folder.mkdir()
    with mcap.open("rb") as file, (folder / "bytes").open("wb") as data:
        summary, heads = make_reader(file).get_summary(), []
        assert summary is not None
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            data.write(message.data)
            heads.append((channel.id, message.log_time, message.publish_time, message.sequence, len(message.data)))
    channels = [(c.id, c.topic, c.message_encoding, c.schema_id, c.metadata) for c in summary.channels.values()]
    schemas = [(s.id, s.name, s.encoding, s.data) for s in summary.schemas.values()]
    (folder / "heads").write_bytes(pickle.dumps((schemas, channels, heads)))


def write_plainly(folder: Path, out: Path) -> None:
    """Write the same messages through `mcap.Writer`."""
    from mcap.writer import Writer

    schemas, channels, heads = pickle.loads((folder / "heads").read_bytes())
    data, at = memoryview((folder / "bytes").read_bytes()), 0
    with out.open("wb") as file:
        writer = Writer(file, enable_data_crcs=True)
        writer.start()
        schema_of = {0: 0} | {k: writer.register_schema(*said) for k, *said in schemas}
        channel_of = {
            k: writer.register_channel(topic, encoding, schema_of[schema], metadata)
            for k, topic, encoding, schema, metadata in channels
        }
        for channel, log_time, publish_time, sequence, size in heads:
            writer.add_message(channel_of[channel], log_time, bytes(data[at : at + size]), publish_time, sequence)
            at += size
        writer.finish()


def keep_boxes(rrd: Path, folder: Path) -> int:
    """Keep the boxes of a file for `send_plainly`, as columns of each of its pieces; how many there are."""
    import numpy as np
    from rerun.chunk import RrdReader

    folder.mkdir()
    kept, number, reader = [], 0, RrdReader(str(rrd))
    for store in reader.recordings():
        for chunk in reader.stream(store=store):
            batch = chunk.to_record_batch()
            if chunk.is_static or "Boxes3D:centers" not in batch.schema.names or "elapsed" not in batch.schema.names:
                continue
            lists = [batch.column(f"Boxes3D:{name}") for name in ("centers", "half_sizes", "rotation_axis_angles")]
            if any(one.null_count for one in lists):
                continue
            counts = np.diff(lists[0].offsets.to_numpy())
            number += int(counts.sum())
            centres, sizes = (one.flatten().flatten().to_numpy().reshape(-1, 3) for one in lists[:2])
            yaw = lists[2].flatten().field("angle").to_numpy()
            kept.append((chunk.entity_path, batch.column("elapsed").to_numpy(), counts, centres, sizes, yaw))
    (folder / "columns").write_bytes(pickle.dumps(kept))
    return number


def send_plainly(folder: Path, out: Path) -> None:
    """Write the same boxes by Rerun's `send_columns`."""
    import numpy as np
    import rerun as rr

    rec = rr.RecordingStream("floor")
    rec.save(out)
    for path, elapsed, counts, centres, sizes, yaw in pickle.loads((folder / "columns").read_bytes()):
        half = yaw / 2
        turns = np.stack([np.zeros_like(half), np.zeros_like(half), np.sin(half), np.cos(half)], axis=1)
        columns = rr.Boxes3D.columns(centers=centres, half_sizes=sizes, quaternions=turns.astype(np.float32))
        rec.send_columns(path, [rr.TimeColumn("elapsed", duration=elapsed)], columns.partition(counts))
    rec.disconnect()


def draw_plainly(parts: Parts, words: list[str]) -> None:
    """Draw the figures of a command, each of them once for each kind of file. To have them, the command is called."""
    from io import BytesIO

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    figures: list[tuple[Any, str]] = []
    with parts.of(NOT_COUNTED):
        style: Any = importlib.import_module("copem_replay.report.figures.style")
        save = style._save

        def save_and_keep(figure: Any, suffix: str) -> bytes:
            figures.append((figure, suffix))
            made: bytes = save(figure, suffix)
            return made

        style._save = save_and_keep
        run_command(Parts(0.0), None, words)
    with parts.of(WORK), style.figure_style():
        for figure, suffix in figures:
            if suffix == ".svg":
                FigureCanvasSVG(figure).print_svg(BytesIO())  # type: ignore[no-untyped-call]
            else:
                FigureCanvasAgg(figure).print_png(BytesIO())  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    gc.set_threshold(100_000, 50, 100)  # the command collects as seldom, and ends without looking through all objects
    parts = Parts(float(sys.argv[1]))
    parts.count_imports()
    keep, words = sys.argv[3], sys.argv[4:]
    if sys.argv[2] == "command":
        run_command(parts, Path(keep) if keep else None, words)
    else:
        run_floor(parts, Path(keep), words)
    parts.print()
    gc.freeze()
