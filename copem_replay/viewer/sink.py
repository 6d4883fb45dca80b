"""The recording as it is written: its streams, its paths, and values as the viewer has them."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.core.tracks import CLASSES, Bool, Float, Int, Scene, Tracks
from copem_replay.viewer.stream import Live

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun as rr

ELAPSED, TIME = "elapsed", "time"
"""The two timelines: since the log's start, and the log's own clock."""
SLICE_ROWS = 100_000
"""Boxes that are made and sent at a time (chosen: some ten megabytes)."""
LONG_ID = 12
"""Ids of more letters than this are shortened where they are drawn (chosen: a UUID has 36)."""

_RESERVED = ("truth", "static", "units", "fields", "eyes", "names")


@dataclass(frozen=True)
class Out:
    """Where everything goes: the file's stream, and a running viewer's if there is one."""

    rec: rr.RecordingStream
    t0_ns: int
    live: Live | None = None

    def send(self, what: Callable[[rr.RecordingStream], None]) -> None:
        """To the file, and to the viewer if there is one."""
        what(self.rec)
        if self.live is not None:
            self.live.send(what)

    def flush(self) -> None:
        """Returns when all that was sent has left this program: so that little of it is held at a time."""
        self.rec.flush()

    def static(self, path: Sequence[str], *what: Any) -> None:
        """What holds at all times."""
        import rerun as rr

        self.send(lambda rec: rec.log(rr.new_entity_path(list(path)), *what, static=True))

    def columns(self, path: Sequence[str], elapsed_ns: Int, columns: Any) -> None:
        """A row per instant (F,)."""
        import rerun as rr

        if len(elapsed_ns):
            times = [
                rr.TimeColumn(ELAPSED, duration=elapsed_ns.astype("timedelta64[ns]")),
                rr.TimeColumn(TIME, timestamp=(self.t0_ns + elapsed_ns).astype("datetime64[ns]")),
            ]
            self.send(lambda rec: rec.send_columns(rr.new_entity_path(list(path)), times, columns))


def part_of(configuration: str) -> str:
    """A configuration's part of entity paths; not one that is taken."""
    taken = configuration in _RESERVED or configuration.startswith("configuration ")
    return f"configuration {configuration}" if taken else configuration


def path_of(*parts: str) -> str:
    """An entity path in one piece, names escaped."""
    import rerun as rr

    return rr.new_entity_path(list(parts))


def plain(name: str) -> str:
    """A name as a part of an entity path that needs no escapes: “coPEM_0.5s”."""
    return re.sub(r"[^0-9A-Za-z_.-]+", "_", name)


def entity_names(scene: Scene) -> list[str]:
    """(N,) what objects are called in entity paths, “6_pedestrian”; a number after those that would be the same."""
    names = zip(short_ids(scene), scene.object_class, strict=True)
    return distinct([f"{plain(name)}_{CLASSES[k]}" for name, k in names])


def distinct(names: Sequence[str]) -> list[str]:
    """The names, with a number after those that are there twice."""
    twice = {name for name, count in Counter(names).items() if count > 1}
    return [f"{name}_{k}" if name in twice else name for k, name in enumerate(names)]


def lanes_of(scene: Scene, object_ix: int) -> list[str]:
    """The entity that has all lanes of an object."""
    return ["lanes", entity_names(scene)[object_ix]]


def lane_path(scene: Scene, object_ix: int, place: int, configuration: str) -> list[str]:
    """The entity of one lane; `place`: of the configuration among those of the file, from 0."""
    return [*lanes_of(scene, object_ix), f"{place + 1}_{plain(configuration)}"]


def table_rows(table: pd.DataFrame) -> list[SimpleNamespace]:
    """The rows of a table, with its columns by name; `itertuples` makes a class for every table, which takes longer."""
    names = list(table.columns)
    columns = [table[name].tolist() for name in names]
    return [SimpleNamespace(**dict(zip(names, row, strict=True))) for row in zip(*columns, strict=True)]


def digest(*texts: str) -> str:
    """A short name for the texts."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


def short_ids(scene: Scene) -> tuple[str, ...]:
    """(N,) ids as they are drawn: of long ones as much of the beginning as tells them apart, four letters at least."""
    ids = scene.object_ids
    if max(map(len, ids), default=0) <= LONG_ID:
        return ids
    keep = next(k for k in range(4, max(map(len, ids)) + 1) if len({name[:k] for name in ids}) == len(set(ids)))
    return tuple(name if len(name) <= max(keep, LONG_ID) else name[:keep] for name in ids)


def object_labels(scene: Scene) -> pa.Array:
    """(N,) what each object is called."""
    names = [f"{name} {CLASSES[k]}" for name, k in zip(short_ids(scene), scene.object_class, strict=True)]
    return pa.array(names, pa.string())


def by_frame(tracks: Tracks, kept: Bool) -> tuple[Int, Int]:
    """The kept rows list by list, and how many each list holds (F,)."""
    order, _ = tracks.by_frame
    rows = order[kept[order]]
    return rows, np.bincount(tracks.frame_ix[rows], minlength=len(tracks.stamp_ns))


def slices(tracks: Tracks, kept: Bool) -> Iterator[tuple[Int, Int, Int]]:
    """`by_frame` in pieces of whole lists, so that little is made at a time; with the instants of each piece."""
    rows, counts = by_frame(tracks, kept)
    ends = np.cumsum(counts)
    available_ns = elapsed_ns(tracks)
    frame = row = 0
    while frame < len(counts):
        last = max(int(np.searchsorted(ends, row + SLICE_ROWS, side="right")), frame + 1)
        yield rows[row : ends[last - 1]], counts[frame:last], available_ns[frame:last]
        frame, row = last, int(ends[last - 1])


def ns(time_s: Any) -> Any:
    """Seconds as whole nanoseconds."""
    return np.rint(np.asarray(time_s) * 1e9).astype(np.int64)


def elapsed_ns(tracks: Tracks) -> Int:
    """(F,) when each list is available, since the log's start."""
    elapsed: Int = ns(tracks.common_arrives_s)
    return elapsed


def f32(*columns: Float) -> np.ndarray:
    """Columns (K,) side by side, as the viewer has them."""
    return np.stack(columns, axis=-1).astype(np.float32)


def upright(yaw_rad: Float) -> np.ndarray:
    """Quaternions xyzw (K, 4) of turns about the vertical."""
    zero = np.zeros(len(yaw_rad))
    return f32(zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2))
