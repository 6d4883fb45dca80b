"""The recording as it is written: its stream, its paths, and values as the viewer has them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from copem_replay.tracks import CLASSES, Bool, Float, Int, Scene, Tracks

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun as rr

ELAPSED, TIME = "elapsed", "time"
"""The two timelines: since the log's start, and the log's own clock."""

_RESERVED = ("truth", "static", "units", "fields", "sight")


@dataclass(frozen=True)
class Out:
    """Where everything goes."""

    rec: rr.RecordingStream
    t0_ns: int

    def static(self, path: Sequence[str], *what: Any) -> None:
        """What holds at all times."""
        import rerun as rr

        self.rec.log(rr.new_entity_path(list(path)), *what, static=True)

    def columns(self, path: Sequence[str], elapsed_ns: Int, columns: Any) -> None:
        """A row per instant (F,)."""
        import rerun as rr

        if len(elapsed_ns):
            times = [
                rr.TimeColumn(ELAPSED, duration=elapsed_ns.astype("timedelta64[ns]")),
                rr.TimeColumn(TIME, timestamp=(self.t0_ns + elapsed_ns).astype("datetime64[ns]")),
            ]
            self.rec.send_columns(rr.new_entity_path(list(path)), times, columns)


def part_of(configuration: str) -> str:
    """A configuration's part of entity paths; not one that is taken."""
    taken = configuration in _RESERVED or configuration.startswith("configuration ")
    return f"configuration {configuration}" if taken else configuration


def path_of(*parts: str) -> str:
    """An entity path in one piece, names escaped."""
    import rerun as rr

    return rr.new_entity_path(list(parts))


def digest(*texts: str) -> str:
    """A short name for the texts."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


def object_labels(scene: Scene) -> pa.Array:
    """(N,) what each object is called."""
    names = [f"{name} {CLASSES[k]}" for name, k in zip(scene.object_ids, scene.object_class, strict=True)]
    return pa.array(names, pa.string())


def by_frame(tracks: Tracks, kept: Bool) -> tuple[Int, Int]:
    """The kept rows list by list, and how many each list holds (F,)."""
    order, _ = tracks.by_frame
    rows = order[kept[order]]
    return rows, np.bincount(tracks.frame_ix[rows], minlength=len(tracks.stamp_ns))


def ns(time_s: Any) -> Any:
    """Seconds as whole nanoseconds."""
    return np.rint(np.asarray(time_s) * 1e9).astype(np.int64)


def elapsed_ns(tracks: Tracks) -> Int:
    """(F,) when each list is available, since the log's start."""
    elapsed: Int = ns(tracks.arrives_s[0])
    return elapsed


def f32(*columns: Float) -> np.ndarray:
    """Columns (K,) side by side, as the viewer has them."""
    return np.stack(columns, axis=-1).astype(np.float32)


def upright(yaw_rad: Float) -> np.ndarray:
    """Quaternions xyzw (K, 4) of turns about the vertical."""
    zero = np.zeros(len(yaw_rad))
    return f32(zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2))
