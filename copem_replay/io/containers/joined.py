"""Several recordings of one drive as one log: in order of log time by the clock of the first, topics told apart.

A topic that several files have is named after its file, `rsu:/objects`. Log times are brought to the first clock here;
stamps in messages where they are decoded, by `Channel.ahead_ns`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from mcap.records import Message

from copem_replay.core.errors import RecordingError
from copem_replay.io.channel import Channel
from copem_replay.io.containers.in_order import merged
from copem_replay.io.log import BrokenIndexError, Log
from copem_replay.io.together import Together
from copem_replay.io.window import ALWAYS, Window


@dataclass(frozen=True)
class JoinedPart:
    """A recording of several. `numbers`: the log's number of each channel, by the recording's."""

    log: Log
    numbers: Mapping[int, int]
    ahead_ns: int
    label: str


@dataclass(frozen=True)
class Joined(Log):
    """Recordings that were looked at."""

    place: Together = field(default_factory=lambda: Together((), ()))
    parts: tuple[JoinedPart, ...] = ()

    def messages(self, numbers: Set[int]) -> Iterator[Message]:
        """Messages of some channels in order of log time. Raises BrokenIndexError."""
        streams: list[tuple[int, Callable[[], Iterator[Message]]]] = []
        for part in self.parts:
            mine = {theirs: ours for theirs, ours in part.numbers.items() if ours in numbers}
            if mine:
                streams.append((part.log.start_ns - part.ahead_ns, partial(_moved, part, mine)))
        yield from merged(streams)

    def within(self, window: Window | None) -> Log:
        """The same recordings, of which only a window is read, each by its own clock."""
        parts = tuple(replace(part, log=part.log.within(_by_clock(window, part.ahead_ns))) for part in self.parts)
        return replace(self, window=window, parts=parts)

    def from_start(self, error: BrokenIndexError) -> Log:
        """The same, with the recording whose index is broken read from its start. Raises RecordingError."""
        broken = [error.path in (part.log.path, *part.log.path.glob("*")) for part in self.parts]
        logs = [
            part.log.from_start(error) if wrong else part.log for part, wrong in zip(self.parts, broken, strict=True)
        ]
        return joined(self.place, logs).within(self.window)


def open_joined(place: Together, open_one: Callable[[Path], Log]) -> Joined:
    """Look at several recordings. Raises RecordingError: one cannot be read, or they have no time in common."""
    logs = [open_one(path) for path in place.paths]
    spans = [(log.start_ns, log.end_ns) for log in logs]
    moved = [(a - ahead_ns, b - ahead_ns) for (a, b), ahead_ns in zip(spans, place.ahead_ns, strict=True)]
    for k in range(1, len(logs)):
        if not _overlap(moved[0], moved[k]):
            (a, b), (c, d) = moved[0], moved[k]
            apart_s = max(a - d, c - b) * 1e-9
            name = place.paths[k].name
            by_offset = _overlap(spans[0], spans[k])
            key = ("clock_offset_s",) if by_offset else ("together",)
            why = f"with {place.ahead_s[k]:g} s the offset is beyond the overlap: " if by_offset else ""
            found = f"expected a time in common with {place.paths[0].name}, found {apart_s:.3f} s between them"
            raise RecordingError(f"{name}: {why}{found}", path=place.paths[0], key=key)
    return joined(place, logs)


def joined(place: Together, logs: Sequence[Log]) -> Joined:
    """Recordings that were looked at as one."""
    files = Counter(topic for log in logs for topic in {c.topic for c in log.channels})
    channels: list[Channel] = []
    parts = []
    for log, label, ahead_ns in zip(logs, labels_of(place.paths), place.ahead_ns, strict=True):
        numbers = {}
        for c in log.channels:
            numbers[c.number] = len(channels) + 1
            topic = named(c.topic, label) if files[c.topic] > 1 else c.topic
            moved = replace(c, number=len(channels) + 1, topic=topic, ahead_ns=c.ahead_ns + ahead_ns)
            channels.append(replace(moved, part=part_of(label, c.part)))
        parts.append(JoinedPart(log, numbers, ahead_ns, label))
    damages = [f"{log.path.name}: {log.damage}" for log in logs if log.damage]
    return Joined(
        path=place.paths[0],
        channels=tuple(channels),
        indexed=all(log.indexed for log in logs),
        damage="; ".join(damages) or None,
        complete=all(log.complete for log in logs),
        went_on=any(log.went_on for log in logs if not log.complete),
        start_ns=max(0, min(part.log.start_ns - part.ahead_ns for part in parts)),
        end_ns=max(part.log.end_ns - part.ahead_ns for part in parts),
        notes=tuple(f"{log.path.name}: {note}" for log in logs for note in log.notes),
        place=place,
        parts=tuple(parts),
    )


def named(topic: str, label: str) -> str:
    """A topic that several files have, after its file."""
    return f"{label}:{topic}"


def part_of(label: str, before: str) -> str:
    """The recording that a channel is of, in a file that may itself have been written from several."""
    return f"{label}/{before}" if before else label


def labels_of(paths: Sequence[Path]) -> list[str]:
    """What files are called: without suffix, with as many folders as tell them apart."""
    bare = [path.parent.absolute() / (path.name if path.is_dir() else path.stem) for path in paths]
    deep = next(d for d in range(1, 99) if len({p.parts[-d:] for p in bare}) == len(set(bare)))
    return ["/".join(path.parts[-deep:]) for path in bare]


def _overlap(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]


def _by_clock(window: Window | None, ahead_ns: int) -> Window | None:
    if window is None:
        return None
    from_ns, to_ns = (
        edge if edge in ALWAYS else min(max(edge + ahead_ns, 0), ALWAYS[1]) for edge in (window.from_ns, window.to_ns)
    )
    return Window(from_ns, to_ns)


def _moved(part: JoinedPart, numbers: Mapping[int, int]) -> Iterator[Message]:
    for m in part.log.messages(numbers.keys()):
        yield moved_back(m, numbers[m.channel_id], part.ahead_ns)


def moved_back(message: Message, number: int, ahead_ns: int) -> Message:
    """A message by the first clock, on another channel."""
    times = (max(t - ahead_ns, 0) for t in (message.log_time, message.publish_time))
    log_time, publish_time = times
    return Message(number, log_time, message.data, publish_time, message.sequence)
