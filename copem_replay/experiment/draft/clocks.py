"""How far the clocks of several recordings of one drive are apart, by the traffic that they have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import Scene
from copem_replay.io.containers.joined import labels_of
from copem_replay.io.log import Log
from copem_replay.io.open import open_log
from copem_replay.io.recorded_lists import lists_on
from copem_replay.io.recording import read, truth_topics
from copem_replay.io.schemas.registry import known_lists
from copem_replay.io.short_tracks import Entries, entries_of
from copem_replay.io.time_offset import TimeOffset, time_offset

_OURS = "copem/"  # what this project wrote beside a recording


@dataclass(frozen=True)
class ClockFound:
    """What is told of the clock of a recording against the first one's: by which two lists; `offset`: the best.

    `late`: which of the two do not say when they were captured, so that their delay is in the offset.
    """

    path: Path
    lists: tuple[str, str]
    offset: TimeOffset
    late: tuple[str, ...] = ()

    def words(self) -> str:
        """`0.130 s (95 %: 0.120 … 0.140 s)` and the drift, or that it cannot be told."""
        found = self.offset
        if found.untold is not None:
            return f"cannot be told: {found.untold}"
        said = f"{found.offset_s:.3f} s (95 %: {found.low_s:.3f} … {found.high_s:.3f} s)"
        if found.unbiased:
            said += ", assuming no shift along the path"
        if found.drift is not None:
            drift, low, high = (1e6 * value for value in found.drift)
            said += f", drift {drift:.0f} µs/s (95 %: {low:.0f} … {high:.0f})"
        if self.late:
            do = "does" if len(self.late) == 1 else "do"
            said += f", the delay of {' and '.join(self.late)} included, which {do} not say when captured"
        return said

    def plain(self) -> dict[str, object]:
        """The same for JSON: seconds, and seconds per second; null where it cannot be told, and `untold` says why."""
        found = self.offset
        told = found.untold is None
        return {
            "lists": list(self.lists),
            "clock_offset_s": found.offset_s if told else None,
            "interval_s": [found.low_s, found.high_s] if told else None,
            "drift": found.drift[0] if told and found.drift else None,
            "drift_interval": list(found.drift[1:]) if told and found.drift else None,
            "entries": found.entries,
            "if_not_shifted": found.unbiased,
            "untold": found.untold,
        }


@dataclass(frozen=True)
class _Lists:
    name: str
    entries: Entries
    captures_said: bool = True  # of the truth, too


def clocks(paths: Sequence[Path]) -> list[ClockFound]:
    """The clock of each recording but the first. Raises RecordingError: one cannot be read, or has no object list."""
    t0_ns: int | None = None
    every: list[list[_Lists]] = []
    for path, label in zip(paths, labels_of(paths), strict=True):
        log = open_log(path)
        t0_ns = log.start_ns if t0_ns is None else t0_ns
        mine = list(_lists(log, label, t0_ns))
        if not mine:
            raise RecordingError("no object list to tell its clock by", path=path)
        every.append(mine)
    return [_best(path, every[0], mine) for path, mine in zip(paths[1:], every[1:], strict=True)]


def _best(path: Path, first: Sequence[_Lists], mine: Sequence[_Lists]) -> ClockFound:
    """What the two lists tell whose interval is narrowest, of those with the fewest unknown delays."""
    found = [
        ClockFound(
            path,
            (a.name, b.name),
            time_offset(a.entries, b.entries),
            tuple(one.name for one in (a, b) if not one.captures_said),
        )
        for a, b in product(first, mine)
    ]
    return min(
        found, key=lambda one: (one.offset.untold is not None, len(one.late), one.offset.high_s - one.offset.low_s)
    )


def _lists(log: Log, label: str, t0_ns: int) -> Iterator[_Lists]:
    """The object lists of a recording, truths first, in seconds since an instant. What cannot be read is none."""
    for topic in truth_topics(log):
        try:
            truth = read(log, name=label, topic=topic).truth
        except RecordingError:
            continue
        yield _Lists(f"{label}:{topic}", entries_of(truth, t0_ns))
    scene = without_objects(label, t0_ns, log.end_ns)
    osis = [c.topic for c in log.channels if c.schema == "osi3.SensorData" and c.messages]
    others = [c.topic for c in known_lists(log.channels) if c.messages and c.topic not in truth_topics(log)]
    for topic in dict.fromkeys([*osis, *others]):
        try:
            found = lists_on(log.path, topic, scene, None)
        except RecordingError:
            continue
        if not topic.startswith(_OURS) and len(found.tracks.frame_ix):
            entries = entries_of(found.tracks, t0_ns, found.track_id)
            yield _Lists(f"{label}:{topic}", entries, bool(found.capture_said.all()))


def without_objects(name: str, t0_ns: int, end_ns: int) -> Scene:
    """A log of which no truth is known."""
    return Scene(name, t0_ns, end_ns, (), np.empty(0, dtype=np.int8), np.empty(0, dtype=bool))
