"""A rosbag2 folder as one recording: the MCAP files that its `metadata.yaml` names, in order of log time.

Channels of several files that agree in topic, schema and encoding are one. A file is opened when the time has come of
its first message, and closed when it is through. One that is damaged is read as far as it goes; of several, one that
cannot be read at all is left out, and it is said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path

from mcap.records import Message

from copem_replay.core.errors import RecordingError
from copem_replay.core.text import counted
from copem_replay.io.channel import Channel
from copem_replay.io.containers.in_order import merged
from copem_replay.io.containers.mcap_indexed import renumbered
from copem_replay.io.containers.rosbag2_metadata import files_of, unnamed_in
from copem_replay.io.log import BrokenIndexError, Log, from_start, open_mcap
from copem_replay.io.window import Window, overlap


@dataclass(frozen=True)
class Part:
    """A file of a folder."""

    log: Log
    numbers: Mapping[int, int]  # the folder's number of each channel, by the file's


@dataclass(frozen=True)
class Bag(Log):
    """A folder that was looked at."""

    parts: tuple[Part, ...] = ()
    lost: tuple[str, ...] = ()  # files that cannot be read at all, and why

    def messages(self, numbers: Set[int]) -> Iterator[Message]:
        """Messages of some channels in order of log time, of equal ones in the order of the files.

        Raises BrokenIndexError.
        """
        streams: list[tuple[int, Callable[[], Iterator[Message]]]] = []
        for part in self.parts:
            mine = {theirs: ours for theirs, ours in part.numbers.items() if ours in numbers}
            there = {c.number for c in part.log.channels if c.number in mine and c.messages}
            if overlap(part.log.spans(there).values(), part.log.start_ns, part.log.end_ns):
                streams.append((part.log.start_ns, _Renumbered(part.log, mine).__iter__))
        yield from merged(streams)

    def within(self, window: Window | None) -> Log:
        """The same folder, of which only a window is read, file by file."""
        parts = tuple(replace(part, log=part.log.within(window)) for part in self.parts)
        return replace(self, window=window, parts=parts)

    def from_start(self, error: BrokenIndexError) -> Log:
        """The same, every file read from its start. Raises RecordingError."""
        logs, lost = [], list(self.lost)
        for part in self.parts:
            log = part.log
            try:
                why = error.__cause__ if log.path == error.path else None
                logs.append(from_start(log.path, why, log.channels) if log.indexed else log)
            except RecordingError as found:
                lost.append(_of_file(log.path, found))
        return _joined(self.path, logs, lost, self.notes).within(self.window)


@dataclass(frozen=True)
class _Renumbered:
    log: Log
    numbers: Mapping[int, int]

    def __iter__(self) -> Iterator[Message]:
        for message in self.log.messages(self.numbers.keys()):
            yield renumbered(message, self.numbers)


def open_bag(folder: Path) -> Bag:
    """Look at a folder. Raises RecordingError: none of rosbag2, or of files that are missing or not read."""
    logs, lost = [], []
    paths = files_of(folder)
    for path in paths:
        try:
            logs.append(open_mcap(path))
        except RecordingError as error:
            lost.append(_of_file(path, error))
    return _joined(folder, logs, lost, tuple(unnamed_in(folder, paths)))


def _joined(folder: Path, logs: Sequence[Log], lost: Sequence[str], notes: tuple[str, ...]) -> Bag:
    if not logs:
        first, *others = lost
        more = f"; and so on, {counted(len(lost), 'file')} in all" if others else ""
        raise RecordingError(f"{first}{more}", path=folder)
    damages = [f"{log.path.name}: {log.damage}" for log in logs if log.damage]
    numbers: dict[tuple[object, ...], int] = {}
    channels: dict[int, Channel] = {}
    parts = []
    for log in logs:
        mine = {}
        for c in log.channels:
            key = (c.topic, c.schema, c.encoding, c.schema_encoding, c.schema_data)
            number = mine[c.number] = numbers.setdefault(key, len(numbers) + 1)
            channels[number] = _and(channels[number], c) if number in channels else replace(c, number=number)
        parts.append(Part(log, mine))
    last = max(log.start_ns for log in logs)
    return Bag(
        path=folder,
        channels=tuple(channels[number] for number in sorted(channels)),
        indexed=all(log.indexed for log in logs),
        damage="; ".join([*damages, *lost]) or None,
        complete=not lost and all(log.complete for log in logs),
        went_on=bool(lost) or any(log.went_on or log.start_ns < last for log in logs if not log.complete),
        start_ns=min(log.start_ns for log in logs),
        end_ns=max(log.end_ns for log in logs),
        notes=notes,
        parts=tuple(parts),
        lost=tuple(lost),
    )


def _and(one: Channel, other: Channel) -> Channel:
    """A channel of several files: all its messages."""
    expected = [c.messages if c.expected is None else c.expected for c in (one, other)]
    known = one.expected is not None or other.expected is not None
    return replace(one, messages=one.messages + other.messages, expected=sum(expected) if known else None)


def _of_file(path: Path, error: RecordingError) -> str:
    """What is wrong with a file of the folder, under its own name."""
    return f"{path.name}: {'; '.join(error.within(path))}"
