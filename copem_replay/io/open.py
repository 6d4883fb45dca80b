"""Opening a recording: the container of a path, several recordings of one drive as one log, and file stamps.

Recordings of a drive become one log in order of log time by the clock of the first of them. A topic that several files
have is named after its file, `rsu:/objects`. Log times are brought to the first clock here; stamps in messages where
they are decoded, by `Channel.ahead_ns`.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self, TypeAlias, overload

from mcap.records import Message

from copem_replay.core.errors import RecordingError, RemoteFile
from copem_replay.io.channel import Channel
from copem_replay.io.containers.osi_trace import is_trace, open_trace
from copem_replay.io.containers.rosbag2 import METADATA, list_bag_files, merge_streams, open_bag
from copem_replay.io.containers.sqlite import DB3, open_sqlite
from copem_replay.io.encodings.ros2_types import define_channels
from copem_replay.io.log import BrokenIndexError, Log, open_file, open_mcap
from copem_replay.io.window import ALWAYS, Window

# Places: a file or folder, several of one drive with clocks of their own, or a URL.


@dataclass(frozen=True)
class DriveRecordings:
    """Recordings that are read as one; `ahead_s`: how far each clock is ahead of the first one, 0 of the first.

    `part`: tells logs apart that are of the same recordings, which may be a single one; "": there is no other.
    `definitions`: a folder with definitions of messages that their recorders left out.
    """

    paths: tuple[Path, ...]
    ahead_s: tuple[float, ...]
    part: str = ""
    definitions: str | None = None

    def __str__(self) -> str:
        return " + ".join(map(str, self.paths))

    @property
    def ahead_ns(self) -> tuple[int, ...]:
        """How far each clock is ahead of the first one, in ns."""
        return tuple(round(ahead_s * 1e9) for ahead_s in self.ahead_s)


Local: TypeAlias = Path | DriveRecordings
"""A place that can be opened: one recording, or several of one drive."""
File: TypeAlias = Path | RemoteFile
Place: TypeAlias = Local | RemoteFile
"""Where a log lies."""


def list_recordings(place: Place) -> tuple[File, ...]:
    """The files or folders of a place."""
    return place.paths if isinstance(place, DriveRecordings) else (place,)


@overload
def first_recording(place: Local) -> Path: ...
@overload
def first_recording(place: Place) -> File: ...
def first_recording(place: Place) -> File:
    """The recording that a log is named after."""
    return place.paths[0] if isinstance(place, DriveRecordings) else place


@contextmanager
def fetch_place(place: Place) -> Iterator[Local]:
    """The place itself; of a remote file a copy in a scratch folder, which is deleted afterwards.

    Raises InputError.
    """
    if not isinstance(place, RemoteFile):
        yield place
        return
    with tempfile.TemporaryDirectory(prefix="copem-replay-") as folder:
        copy = Path(folder) / place.name
        place.fetch(str(copy))
        yield copy


# Stamps of files: whether a recording is still the one that was read.


class FileStamp(NamedTuple):
    """Properties that change with a file's content. `path`: as it was given; `file`: the path behind links.

    `cp -p`, `rsync -t` and `tar` set `mtime_ns`. No program sets `ctime_ns`, the time of the last change of content or
    attributes, and a file that takes another's name has an inode of its own.
    """

    path: Path
    file: str
    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int

    @classmethod
    def of(cls, path: Path) -> Self:
        """The stamp of a file. Raises RecordingError: there is no such file."""
        try:
            stat = os.stat(path)
        except OSError as error:
            raise RecordingError(f"cannot be opened: {error.strerror}", path=path) from None
        return cls(path, os.path.realpath(path), stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino)


Stamps = tuple[FileStamp, ...]
"""The stamps of all files of a recording."""


def sha256_of(recording: Local) -> str:
    """SHA-256 of a file; of a rosbag2 folder, or of several recordings, that of their files concatenated, as by `cat`.

    Raises RecordingError: a file cannot be read, or a folder is none of rosbag2.
    """
    digest = hashlib.sha256()
    for path in _list_paths(recording):
        for place in list_bag_files(path) if path.is_dir() else [path]:
            with open_file(place) as file:
                hashlib.file_digest(file, lambda: digest)  # type: ignore[arg-type]  # it has `readinto`
    return digest.hexdigest()


def read_file_stamps(recording: Local) -> Stamps:
    """The stamps of a recording's files, taken without reading them.

    Raises RecordingError: a file is not there, or the folder is none of rosbag2.
    """
    return tuple(FileStamp.of(file) for path in _list_paths(recording) for file in _list_files(path))


def check_files_unchanged(stamps: Stamps) -> None:
    """Raises RecordingError: a file has another stamp by now, so it has changed since."""
    for before in stamps:
        now = FileStamp.of(before.path)
        if now != before:
            sizes = f"{before.size} bytes then, {now.size} now"
            change = sizes if now.size != before.size else "of the same size, but written or replaced since"
            message = f"it has changed since it began to be read ({change})"
            raise RecordingError(f"{message}; wait until nothing writes it, then read it again", path=before.path)


def _list_paths(at: Local) -> tuple[Path, ...]:
    return at.paths if isinstance(at, DriveRecordings) else (at,)


def _list_files(path: Path) -> Iterator[Path]:
    """The files of one recording: itself, or of a folder the files that its description names, and that."""
    if path.is_dir():
        yield from list_bag_files(path)
        yield path / METADATA
    else:
        yield path


# Several recordings of one drive as one log.


@dataclass(frozen=True)
class JoinedRecording:
    """One recording of several. `numbers`: the joint log's channel numbers, by those of the recording."""

    log: Log
    numbers: Mapping[int, int]
    ahead_ns: int


@dataclass(frozen=True)
class JoinedLog(Log):
    """The log of several recordings of one drive."""

    place: DriveRecordings = field(default_factory=lambda: DriveRecordings((), ()))
    parts: tuple[JoinedRecording, ...] = ()

    def messages(self, numbers: Set[int], *, sort: bool = False) -> Iterator[Message]:
        """Messages of some channels in order of log time. Raises BrokenIndexError."""
        streams: list[tuple[int, Callable[[], Iterator[Message]]]] = []
        for part in self.parts:
            numbers_in_log = {theirs: ours for theirs, ours in part.numbers.items() if ours in numbers}
            if numbers_in_log:
                streams.append((part.log.start_ns - part.ahead_ns, partial(_read_moved, part, numbers_in_log, sort)))
        yield from merge_streams(streams)

    def file_bytes(self) -> int:
        """Size of the files of all recordings."""
        return sum(part.log.file_bytes() for part in self.parts)

    def within(self, window: Window | None) -> Log:
        """The log restricted to a window, which each recording gets by its own clock."""
        parts = tuple(replace(part, log=part.log.within(_shift_window(window, part.ahead_ns))) for part in self.parts)
        return replace(self, window=window, parts=parts)

    def from_start(self, error: BrokenIndexError) -> Log:
        """The log with the recording whose index is broken opened without it. Raises RecordingError."""
        broken = [error.path in (part.log.path, *part.log.path.glob("*")) for part in self.parts]
        logs = [
            part.log.from_start(error) if wrong else part.log for part, wrong in zip(self.parts, broken, strict=True)
        ]
        return join_logs(self.place, logs).within(self.window)


def open_joined(place: DriveRecordings, open_one: Callable[[Path], Log]) -> JoinedLog:
    """The log of several recordings. Raises RecordingError: one cannot be read, or they have no time in common."""
    logs = [open_one(path) for path in place.paths]
    spans = [(log.start_ns, log.end_ns) for log in logs]
    moved = [(a - ahead_ns, b - ahead_ns) for (a, b), ahead_ns in zip(spans, place.ahead_ns, strict=True)]
    for k in range(1, len(logs)):
        if not _windows_overlap(moved[0], moved[k]):
            (a, b), (c, d) = moved[0], moved[k]
            apart_s = max(a - d, c - b) * 1e-9
            name = place.paths[k].name
            by_offset = _windows_overlap(spans[0], spans[k])
            key = ("clock_offset_s",) if by_offset else ("together",)
            cause = f"with {place.ahead_s[k]:g} s the offset is beyond the overlap: " if by_offset else ""
            finding = f"expected a time in common with {place.paths[0].name}, found {apart_s:.3f} s between them"
            raise RecordingError(f"{name}: {cause}{finding}", path=place.paths[0], key=key)
    return join_logs(place, logs)


def join_logs(place: DriveRecordings, logs: Sequence[Log]) -> JoinedLog:
    """The log of several recordings, from the log of each."""
    files = Counter(topic for log in logs for topic in {c.topic for c in log.channels})
    channels: list[Channel] = []
    parts = []
    for log, label, ahead_ns in zip(logs, label_files(place.paths), place.ahead_ns, strict=True):
        numbers = {}
        for c in log.channels:
            numbers[c.number] = len(channels) + 1
            topic = f"{label}:{c.topic}" if files[c.topic] > 1 else c.topic
            part = f"{label}/{c.part}" if c.part else label  # of one in a file that was itself written from several
            ahead_of_first_ns = c.ahead_ns + ahead_ns
            channels.append(replace(c, number=numbers[c.number], topic=topic, ahead_ns=ahead_of_first_ns, part=part))
        parts.append(JoinedRecording(log, numbers, ahead_ns))
    damages = [f"{log.path.name}: {log.damage}" for log in logs if log.damage]
    return JoinedLog(
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
        tags={name: value for log in reversed(logs) for name, value in log.tags.items()},
    )


def label_files(paths: Sequence[Path]) -> list[str]:
    """A label for each file: its name without suffix, after as many folders as distinguish the files."""
    bare = [path.parent.absolute() / (path.name if path.is_dir() else path.stem) for path in paths]
    deep = next(d for d in range(1, 99) if len({p.parts[-d:] for p in bare}) == len(set(bare)))
    return ["/".join(path.parts[-deep:]) for path in bare]


def _windows_overlap(first: tuple[int, int], second: tuple[int, int]) -> bool:
    return first[0] <= second[1] and second[0] <= first[1]


def _shift_window(window: Window | None, ahead_ns: int) -> Window | None:
    if window is None:
        return None
    from_ns, to_ns = (
        edge if edge in ALWAYS else min(max(edge + ahead_ns, 0), ALWAYS[1]) for edge in (window.from_ns, window.to_ns)
    )
    return replace(window, from_ns=from_ns, to_ns=to_ns)


def _read_moved(part: JoinedRecording, numbers: Mapping[int, int], sort: bool) -> Iterator[Message]:
    """Messages with their times by the first clock."""
    for m in part.log.messages(numbers.keys(), sort=sort):
        log_time, publish_time = (max(t - part.ahead_ns, 0) for t in (m.log_time, m.publish_time))
        yield Message(numbers[m.channel_id], log_time, m.data, publish_time, m.sequence)


# Opening.


def open_log(place: Local) -> Log:
    """The log of a recording, or of several as one. Raises RecordingError: nothing in one of them can be read."""
    open_one = partial(_open_one, definitions=place.definitions if isinstance(place, DriveRecordings) else None)
    if isinstance(place, DriveRecordings) and len(place.paths) > 1:
        return open_joined(place, open_one)
    return open_one(first_recording(place))


def find_drive_recordings(log: Log) -> DriveRecordings | None:
    """The recordings that a log was joined from; None: it is a single one."""
    return log.place if isinstance(log, JoinedLog) else None


def _open_one(path: Path, definitions: str | None) -> Log:
    if path.is_dir():
        log: Log = open_bag(path)
    elif path.suffix == DB3 and path.is_file():
        log = open_sqlite(path)
    else:
        log = open_trace(path) if is_trace(path) else open_mcap(path)  # of any other path its error says what it is
    return log if definitions is None else replace(log, channels=define_channels(log.channels, definitions))


def name_log(path: Path) -> str:
    """The name of a log: that of a file without its suffix, that of a folder as it is."""
    return path.name if path.is_dir() else path.stem
