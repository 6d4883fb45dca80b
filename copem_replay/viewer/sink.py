"""Sink: where a Rerun recording is written, and what all its parts share.

Streams to a file and to a running viewer, entity paths, colours and statuses, values in the viewer's types, and which
configurations a file holds.
"""

from __future__ import annotations

import hashlib
import os
import re
import socket
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.core.colours import Rgb
from copem_replay.core.errors import InputError, OutputError
from copem_replay.core.files import atomic_file
from copem_replay.core.tracks import CLASSES, Bool, Float, Int, Scene, Tracks
from copem_replay.perception.sight import HIDDEN, IN_SIGHT, OUT_OF_VIEW
from copem_replay.pipeline.status import EARLY, KNOWN, LOST, NOT_SENT, UNDER_WAY, UNLISTED, UNMATCHED, elapsed_ns

if TYPE_CHECKING:
    import rerun as rr


# Colours of everything but configurations: ground, truth, statuses, words.
#
# Lines have a contrast of 3:1 or more to the dark ground, words 4.5:1, also to the grey plate behind them in the
# viewer's light theme, and to lanes in both themes; deuteranopes can tell the statuses apart. Tests compute all of it.
# Every 3-D view and plot sets the ground, so that it is dark in the light theme, too.

GROUND: Rgb = (8, 9, 11)
GRID: Rgb = (36, 38, 44)
"""Grid on the ground: fainter than any line that carries information."""
EGO: Rgb = (255, 255, 255)
"""The ego and all units."""
STANDING: Rgb = (112, 112, 112)
"""True objects that never move; moving ones have the truth's grey."""
LANE: Rgb = (104, 104, 114)
"""Boundaries of lanes: visible, but less than everything else."""
FIELD: Rgb = (150, 146, 118)
"""Outlines of fields of view."""
ONSET: tuple[Rgb, Rgb] = ((255, 255, 255), (0, 0, 0))
"""Halves of the mark of the onset in lanes, whose ground is that of the theme; elsewhere the first."""
HIDES: Rgb = (255, 110, 95)
"""Lines to what hides an object."""
WORDS_COLOUR: Rgb = (255, 255, 255)
"""Words over objects: nothing darker can be read on the grey plate behind words in the viewer's light theme."""
DIFFERENCE: Rgb = (255, 255, 255)
"""Marks of objects that only one of two configurations holds."""
STATUS: dict[int, Rgb] = {
    OUT_OF_VIEW: (72, 68, 144),
    UNLISTED: (92, 76, 48),
    HIDDEN: (205, 160, 100),
    IN_SIGHT: (76, 78, 80),
    NOT_SENT: (160, 176, 140),
    LOST: (236, 216, 180),
    UNDER_WAY: (140, 165, 225),
    UNMATCHED: (205, 220, 250),
}
"""Statuses in which the receiver's list does not hold the object; one colour for all configurations."""
FAINT = 1 / 3
"""Strength of a configuration's colour where the object is listed but not known: so dark that words are white on it."""
BRIGHT = 0.602
"""Least intensity (0 to 1) of what has dark words on it in a lane: the viewer's words are white up to 0.6."""


DIFFERENCE_TEXT, DIFFERENCE_SHORT = ("difference",), ("difference_short",)
"""Entities with the tables of times to detection: of all shown objects, and what of them fits into the overview."""
WORDS, NEAR_WORDS = "status", "status_near"
"""Entities with words of statuses, in views around the ego and in those of one object: each is below bodies there."""


def status_colour(status: int, colour: Rgb) -> Rgb:
    """Colour of a status in a lane: neutral until the object is listed, then `colour`, at `FAINT` until known.

    Known, it is as much lighter as words on it ask: the viewer writes them in black or white, and mixes a lane's
    colour with the ground of its theme.
    """
    if status < EARLY:
        return STATUS[status]
    if status != KNOWN:
        return scale_colour(colour, FAINT)
    intensity = float(np.dot(colour, (0.299, 0.587, 0.114))) / 255
    lighter = max(BRIGHT - intensity, 0.0) / (1 - intensity)
    red, green, blue = (round(channel + lighter * (255 - channel)) for channel in colour)
    return red, green, blue


def scale_colour(colour: Rgb, share: float) -> Rgb:
    """A colour, darker by a share."""
    red, green, blue = (round(channel * share) for channel in colour)
    return red, green, blue


# Streams: into a file, with little of it held in memory, and to a running viewer.

VIEWER = "rerun+http://127.0.0.1:9876/proxy"
"""Where a Rerun viewer listens by default."""
ANSWERS_S, TAKES_S = 2.0, 60.0
"""Time for a viewer to answer, and to take a piece of the recording: longest delays by a viewer that hangs."""
_PIPE_BYTES = 1 << 20


@contextmanager
def file_stream(path: Path, application_id: str, recording_id: str) -> Iterator[rr.RecordingStream]:
    """A stream into a file that in the end is complete under its name, or does not exist. Raises OutputError.

    Rerun writes into a pipe, and a thread copies the pipe into the file. Rerun's own file sink waits for ever on a full
    disk or leaves half a file without an error, and its memory sink gives a long recording only as several files.
    """
    import rerun as rr

    with atomic_file(path) as scratch:
        read_fd, write_fd = os.pipe()
        pump = _Pump(read_fd, scratch)
        rec = rr.RecordingStream(application_id, recording_id=recording_id, send_properties=False)
        try:
            if not rr.is_enabled(rec):
                raise OutputError(f"{path}: not written, Rerun is switched off (RERUN=off in the environment?)")
            rec.save(f"/dev/fd/{write_fd}")
            yield rec
        finally:
            rec.disconnect()  # writes the end of the file
            os.close(write_fd)
            pump.join()
        if pump.error is not None:
            raise pump.error


class _Pump(Thread):
    """Copies a pipe into a file. After an error (`error`) it reads on, so that the writer at the other end goes on."""

    def __init__(self, out: int, path: Path) -> None:
        super().__init__()
        self.error: OSError | None = None
        self._out, self._path = out, path
        self.start()

    def run(self) -> None:
        try:
            with self._path.open("wb") as file:
                while piece := os.read(self._out, _PIPE_BYTES):
                    file.write(piece)
        except OSError as error:
            self.error = error
        while os.read(self._out, _PIPE_BYTES):
            pass
        os.close(self._out)


class ViewerStream:
    """A stream to a running viewer. When the viewer ends (`gone`), nothing more is sent."""

    def __init__(self, url: str, application_id: str, recording_id: str) -> None:
        import rerun as rr

        self.url, self.gone = url, False
        self._rec = rr.RecordingStream(application_id, recording_id=recording_id, send_properties=False)
        self._rec.connect_grpc(url)

    def send(self, write: Callable[[rr.RecordingStream], None]) -> None:
        """Send what `write` puts into a stream, and wait until the viewer has it."""
        if self.gone:
            return
        try:
            write(self._rec)
            self._rec.flush(timeout_sec=TAKES_S)
        except RuntimeError:  # Rerun raises it for a broken connection
            self.gone = True

    def close(self) -> None:
        """End the stream."""
        with suppress(RuntimeError):
            self._rec.disconnect()


def check_viewer(url: str) -> None:
    """Raise InputError for an address that is no viewer's, or at which nothing listens."""
    try:
        place = urlsplit(url)
        host, port = place.hostname, place.port
    except ValueError:
        host = port = None
    if not url.startswith(("rerun+http://", "rerun://", "rerun+https://")) or not host or place.path != "/proxy":
        raise InputError(f"--viewer: expected an address such as {VIEWER}, found {url!r}")
    try:
        socket.create_connection((host, port or 443), timeout=ANSWERS_S).close()
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"--live: no viewer at {url} ({reason}); start one first: python -m rerun") from None


ELAPSED, TIME = "elapsed", "time"
"""The two timelines: time since the log's start, and the log's own clock."""
OPENS = "opens_at_s"
"""The property of a recording that has the instant (s) at which it opens."""
SLICE_ROWS = 100_000
"""Boxes that are made and sent at a time: some ten megabytes."""
LONG_ID = 12
"""Longer ids are shortened where they are drawn: the 36 letters of a UUID would cover the scene."""

_RESERVED = ("truth", "static", "units", "fields", "eyes", "names")
"""Parts of entity paths that no configuration may have as its name."""


@dataclass(frozen=True)
class RecordingSink:
    """Target of all writing: the stream of the file, and that of a running viewer, if any."""

    rec: rr.RecordingStream
    t0_ns: int
    live: ViewerStream | None = None

    def send(self, write: Callable[[rr.RecordingStream], None]) -> None:
        """Write to the file, and to the viewer if there is one."""
        write(self.rec)
        if self.live is not None:
            self.live.send(write)

    def flush(self) -> None:
        """Wait until all that was sent has left this process, so that little of it is held in memory."""
        self.rec.flush()

    def static(self, path: Sequence[str], *components: Any) -> None:
        """Write components that hold at all times."""
        import rerun as rr

        self.send(lambda rec: rec.log(rr.new_entity_path(list(path)), *components, static=True))

    def columns(self, path: Sequence[str], elapsed_ns: Int, columns: Any) -> None:
        """Write columns with a row per instant (F,), ns since the log's start."""
        import rerun as rr

        if len(elapsed_ns):
            times = [
                rr.TimeColumn(ELAPSED, duration=elapsed_ns.astype("timedelta64[ns]")),
                rr.TimeColumn(TIME, timestamp=(self.t0_ns + elapsed_ns).astype("datetime64[ns]")),
            ]
            self.send(lambda rec: rec.send_columns(rr.new_entity_path(list(path)), times, columns))


def configuration_part(configuration: str) -> str:
    """The part of entity paths that names a configuration: its name, unless that is reserved."""
    taken = configuration in _RESERVED or configuration.startswith("configuration ")
    return f"configuration {configuration}" if taken else configuration


def make_entity_path(*parts: str) -> str:
    """An entity path as one text, with names escaped."""
    import rerun as rr

    return rr.new_entity_path(list(parts))


def plain_part(name: str) -> str:
    """A name as a part of an entity path that needs no escapes: “coPEM_0.5s”."""
    return re.sub(r"[^0-9A-Za-z_.-]+", "_", name)


def entity_names(scene: Scene) -> tuple[str, ...]:
    """(N,) names of objects in entity paths, “6_pedestrian”; equal names get a number."""
    return _name_entities(short_ids(scene), tuple(scene.object_class.tolist()))


@lru_cache(maxsize=4)  # asked for object by object
def _name_entities(ids: tuple[str, ...], classes: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(make_distinct([f"{plain_part(name)}_{CLASSES[k]}" for name, k in zip(ids, classes, strict=True)]))


def make_distinct(names: Sequence[str]) -> list[str]:
    """The names, those that occur more than once with their index."""
    twice = {name for name, count in Counter(names).items() if count > 1}
    return [f"{name}_{k}" if name in twice else name for k, name in enumerate(names)]


def helps_path(scene: Scene, object_ix: int) -> tuple[str, ...]:
    """The entity with the sentence of what would help with an object."""
    return "helps", entity_names(scene)[object_ix]


def object_lanes_path(scene: Scene, object_ix: int) -> list[str]:
    """The entity above all lanes of an object."""
    return ["lanes", entity_names(scene)[object_ix]]


def lane_path(scene: Scene, object_ix: int, place: int, configuration: str) -> list[str]:
    """The entity of one lane; `place`: index of the configuration in the file."""
    return [*object_lanes_path(scene, object_ix), f"{place + 1}_{plain_part(configuration)}"]


def table_rows(table: pd.DataFrame) -> list[SimpleNamespace]:
    """The rows of a table, with columns as attributes. Faster than `itertuples`, which makes a class per table."""
    names = list(table.columns)
    columns = [table[name].tolist() for name in names]
    return [SimpleNamespace(**dict(zip(names, row, strict=True))) for row in zip(*columns, strict=True)]


def digest_texts(*texts: str) -> str:
    """The first 16 hex digits of the SHA-256 of the texts."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


def short_ids(scene: Scene) -> tuple[str, ...]:
    """(N,) ids as drawn: long ones cut to the shortest beginning, of four letters or more, that keeps them distinct."""
    return _shorten_ids(scene.object_ids)


@lru_cache(maxsize=4)
def _shorten_ids(ids: tuple[str, ...]) -> tuple[str, ...]:
    if max(map(len, ids), default=0) <= LONG_ID:
        return ids
    keep = next(k for k in range(4, max(map(len, ids)) + 1) if len({name[:k] for name in ids}) == len(set(ids)))
    return tuple(name if len(name) <= max(keep, LONG_ID) else name[:keep] for name in ids)


def object_labels(scene: Scene) -> pa.Array:
    """(N,) labels of objects: id and class."""
    names = [f"{name} {CLASSES[k]}" for name, k in zip(short_ids(scene), scene.object_class, strict=True)]
    return pa.array(names, pa.string())


def sort_by_frame(tracks: Tracks, drawn: Bool) -> tuple[Int, Int]:
    """The rows (P,) with `drawn`, list by list, and their number per list (F,)."""
    order, _ = tracks.by_frame
    rows = order[drawn[order]]
    return rows, np.bincount(tracks.frame_ix[rows], minlength=len(tracks.stamp_ns))


def slice_by_frame(tracks: Tracks, drawn: Bool) -> Iterator[tuple[Int, Int, Int]]:
    """`sort_by_frame` in pieces of whole lists, of about `SLICE_ROWS` rows; with the instants of each piece (ns)."""
    rows, counts = sort_by_frame(tracks, drawn)
    ends = np.cumsum(counts)
    available_ns = elapsed_ns(tracks)
    frame = row = 0
    while frame < len(counts):
        last = max(int(np.searchsorted(ends, row + SLICE_ROWS, side="right")), frame + 1)
        yield rows[row : ends[last - 1]], counts[frame:last], available_ns[frame:last]
        frame, row = last, int(ends[last - 1])


def show_seconds(time_s: float) -> str:
    """Seconds with two decimals, never `-0.00`."""
    return f"{round(time_s, 2) + 0.0:.2f}"


def stack_float32(*columns: Float) -> np.ndarray:
    """Columns (K,) as one array (K, n) of 32-bit floats, the viewer's type."""
    return np.stack(columns, axis=-1).astype(np.float32)


def upright_turns(yaw_rad: Float) -> pa.Array:
    """Rotations (K,) about the vertical, by axis and angle: in the file the axis takes next to nothing."""
    import rerun as rr

    kind = rr.encodings.RotationAxisAngleBatch._ARROW_DATATYPE
    up = np.zeros((len(yaw_rad), 3), dtype=np.float32)
    up[:, 2] = 1.0
    axis = pa.FixedSizeListArray.from_arrays(pa.array(up.ravel()), type=kind.field("axis").type)
    return pa.StructArray.from_arrays([axis, pa.array(yaw_rad.astype(np.float32))], fields=list(kind))


# Selection: which configurations a file holds.

VIEWED = 7
"""Most configurations of a file: those of a drafted experiment. More lanes of an object are too thin."""


@dataclass(frozen=True)
class RecordingPart:
    """The configurations of one file, and the infix of its name before the suffix."""

    configurations: tuple[str, ...]
    infix: str = ""

    def path(self, path: Path) -> Path:
        """The path of this part's file, derived from `path`, that of the first file."""
        return path.with_name(f"{path.stem}{self.infix}{path.suffix}")


def split_into_files(configurations: Sequence[str], baselines: Mapping[str, str] | None = None) -> list[RecordingPart]:
    """All configurations in their order, seven per file: `replay.rrd`, `replay.configurations_8-14.rrd` and so on.

    The baseline of all is the first in every file. Of several baselines each stands in the file of the configurations
    that are compared with it, before them.
    """
    against = {*(baselines or {}).values()}
    shared = tuple(name for name in configurations if name in against) if len(against) == 1 else ()
    others = [name for name in configurations if name not in shared]
    per_file = VIEWED - (VIEWED % 2 if len(against) > 1 else len(shared))
    parts = [RecordingPart((*shared, *others[:per_file]) if shared else tuple(others[:per_file]))]
    for first in range(per_file, len(others), per_file):
        names = others[first : first + per_file]
        begin = first + len(shared) + 1
        last = f"-{begin + len(names) - 1}" if len(names) > 1 else ""
        parts.append(RecordingPart((*shared, *names), f".configurations_{begin}{last}"))
    return parts


def join_points(lines: np.ndarray) -> pa.Array:
    """Lines (…, K, 3) as strips of K points: Rerun itself counts the points of each strip in Python."""
    import rerun as rr

    kind, bounds = rr.components.LineStrip3DBatch._ARROW_DATATYPE, np.arange(0, lines.size // 3 + 1, lines.shape[-2])
    points = pa.FixedSizeListArray.from_arrays(pa.array(lines.astype(np.float32).ravel()), type=kind.value_type)
    return pa.ListArray.from_arrays(pa.array(bounds.astype(np.int32)), points, type=kind)
