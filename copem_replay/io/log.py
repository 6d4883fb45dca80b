"""A log: the channels and messages of an opened recording, including what can be read of a damaged file.

This is the log of an MCAP file; those of other containers (`io/open.py` lists them) derive from it. A file with a sound
index is read through it. Any other (no index, a wrong index, a file that was cut off, a checksum that fails) is read
from start to end, as far as it goes.
"""

from __future__ import annotations

import io
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, TypeVar

import zstandard
from mcap.exceptions import EndOfFile
from mcap.records import Message, Metadata
from mcap.stream_reader import CRCValidationError
from mcap.summary import Summary

from copem_replay.core.errors import EmptyWindowError, RecordingError, count_noun
from copem_replay.io.channel import AHEAD, LAST_NS, PART, Channel
from copem_replay.io.containers.mcap_records import (
    DAMAGE,
    MAGIC,
    RecordsFromStart,
    drop_traceback,
    read_by_log_time,
    read_metadata,
    read_summary,
)
from copem_replay.io.decoded_size import DecodeAllowance, OversizeError
from copem_replay.io.window import ALWAYS, POSE_MARGIN_NS, Span, Window, WindowSeconds, describe_window, is_kept

# Files that are not read: what they are by their first bytes and their names, and what to do about it.

CONVERT = "`ros2 bag convert` makes MCAP of it (`storage_id: mcap` in its output options)"
_UNPACKED_BY = {".xz": "xz", ".lzma": "xz", ".zst": "zstd", ".zstd": "zstd", ".gz": "gzip", ".bz2": "bzip2"}
_LFS_POINTER = b"version https://git-lfs"
_LOOKED_AT = 64  # bytes by which a file is told
_SHOWN_BYTES = 16
_CONVERTED = (".csv", ".tsv", ".json", ".xml")  # suffixes of files that `copem-replay convert` may read
_MADE = "; docs/guide/data-sets.md says what makes a recording of such files"
ROS1 = b"#ROSBAG"
_NEWER = "`rosbags-convert --src FILE --dst FOLDER --dst-storage mcap` makes a folder of it that is"
SQLITE = b"SQLite format 3\0"


def check_magic(path: Path, file: IO[bytes]) -> None:
    """Raises RecordingError where a file does not begin as MCAP does. Leaves the file at its start."""
    start = file.read(_LOOKED_AT)
    if not start.startswith(MAGIC):
        raise unsupported_file_error("an MCAP file", path, start)
    file.seek(0)


def unpacking_advice(path: Path) -> str | None:
    """Advice on a file that is compressed as a whole, by its name; None: it is not."""
    program = _UNPACKED_BY.get(path.suffix.lower())
    return f"compressed as a whole, which is not read; unpack it first: {program} -d {path.name}" if program else None


def unsupported_file_error(expected: str, path: Path, start: bytes) -> RecordingError:
    """The error that says what a file is instead of what was expected; `start`: its first 64 bytes."""
    return RecordingError(_describe_file(expected, path, start), path=path)


def _describe_file(expected: str, path: Path, start: bytes) -> str:
    """What a file is instead of the `expected` recording, and what to do; `start`: its first bytes."""
    if not start:
        return "the file is empty"
    if start.startswith(_LFS_POINTER):
        return "a git-lfs pointer, not the recording itself (`git lfs pull` fetches it)"
    if start.startswith(ROS1):
        return f"a bag of ROS 1, which is not read; {_NEWER}"
    if advice := unpacking_advice(path):
        return advice
    if path.suffix.lower() in (".txt", ".txth"):
        return "text, which is not read; OSI traces are read as .osi (messages in binary) or .mcap"
    if path.name == "metadata.yaml":
        return "the description of a rosbag2 folder; give the folder it is in"
    return f"expected {expected}, found {_describe_content(path, start)}"


def _describe_content(path: Path, start: bytes) -> str:
    """What a file of unknown kind begins with: columns of a table, its first line, or its first bytes."""
    try:
        text = start.decode("utf-8", errors="ignore" if len(start) == _LOOKED_AT else "strict")
    except UnicodeDecodeError:
        text = ""
    first_line = text.strip().partition("\n")[0].strip()
    is_text = len(text.encode()) > len(start) - 4  # a character may be cut off at the end
    if not first_line or not is_text or not all(c.isprintable() or c in "\t\r\n" for c in text):
        return f"a file whose first bytes are {start[:_SHOWN_BYTES].hex(' ')}"
    if path.suffix.lower() in (".csv", ".tsv"):
        return f"a table with the columns {first_line}{_MADE}"
    return f"text that begins with {first_line!r}{_MADE if path.suffix.lower() in _CONVERTED else ''}"


# The log of an MCAP file.

TAGS = "tags"
"""The metadata record of a file that says what the drive is: names and values."""
_READ_AT_ONCE = 1 << 16
"""Bytes of the buffer of a file: a call of Python for as many takes no time beside reading them."""


Result = TypeVar("Result")


class BrokenIndexError(Exception):
    """An index that seemed sound is wrong, or what it points at is damaged; `Log.from_start` reads without it."""

    def __init__(self, path: Path) -> None:
        self.path, self.reason = path, "the index cannot be used"
        super().__init__(f"{path}: {self.reason}")


@dataclass(frozen=True)
class Log:
    """An opened recording: an MCAP file; the logs of other containers override how messages are read.

    `damage`: what is wrong with the file, None: nothing. `complete`: whether all messages can be read all the same.
    `notes`: other lines about the container. Counts of messages are those of the whole recording, not of the `window`.
    """

    path: Path
    channels: tuple[Channel, ...]  # by number
    indexed: bool
    damage: str | None = None
    complete: bool = True
    went_on: bool = False  # whether messages after the damage were read
    start_ns: int = 0  # log time of the first message
    end_ns: int = ALWAYS[1]  # log time of the last message
    notes: tuple[str, ...] = ()
    window: Window | None = None  # the log time that is read, None: all
    tags: Mapping[str, str] = field(default_factory=dict)  # of the metadata record `TAGS`

    def within(self, window: Window | None) -> Log:
        """The log restricted to a window; None: the whole recording."""
        return replace(self, window=window)

    def file_bytes(self) -> int:
        """Size of the recording's files."""
        return self.path.stat().st_size

    def spans(self, numbers: Set[int]) -> dict[int, Span]:
        """The log time that is read of some channels, by their numbers."""
        if self.window is None:
            return dict.fromkeys(numbers, ALWAYS)
        kept = {c.number: self.window.span(c) for c in self.channels if c.number in numbers}
        return dict.fromkeys(numbers, (self.window.from_ns, self.window.to_ns)) | kept

    def payloads(self, numbers: frozenset[int]) -> Iterator[tuple[int, int, bytes]]:
        """Channel number, log time in ns and payload of the messages of some channels, in the order of `messages`.

        Raises BrokenIndexError.
        """
        for message in self.messages(numbers):
            yield message.channel_id, message.log_time, message.data

    def messages(self, numbers: Set[int], *, sort: bool = False) -> Iterator[Message]:
        """Messages of some channels: by log time through the index, else as in the file, up to the damage.

        `sort`: those of a file without an index, too, are in order of log time. Raises BrokenIndexError.
        """
        spans = self.spans(numbers)
        with open_file(self.path) as file:
            messages = self._by_index(file, spans) if self.indexed else _read_from_start(file, spans)
            yield from sorted(messages, key=_log_time) if sort and not self.indexed else messages

    def attempt(self, read: Callable[[Log], Result]) -> Result:
        """The result of `read` with the log, opened without indexes that prove to be broken. Raises RecordingError."""
        log = self
        while True:  # of several files each may have one
            try:
                return read(log)
            except BrokenIndexError as error:
                log = log.from_start(error)

    def from_start(self, error: BrokenIndexError) -> Log:
        """The recording opened without the index that turned out to be broken. Raises RecordingError."""
        return open_from_start(self.path, error.__cause__, self.channels).within(self.window)

    def _by_index(self, file: IO[bytes], spans: Mapping[int, Span]) -> Iterator[Message]:
        """Messages by log time, from the index. Raises BrokenIndexError, also if there are not as many as promised."""
        promised = sum(c.messages for c in self.channels if c.number in spans)
        count = 0
        try:
            summary = read_summary(file)
            if summary is None:
                raise ValueError("the index is gone")
            for message in read_by_log_time(file, summary, spans):
                count += 1
                yield message
            if count != promised and self.window is None:  # the index does not count a window's messages
                raise ValueError(f"the index promises {promised} messages, and there are {count}")
        except DAMAGE as error:
            raise BrokenIndexError(self.path) from drop_traceback(error)


def _read_from_start(file: IO[bytes], spans: Mapping[int, Span]) -> Iterator[Message]:
    for record in RecordsFromStart(file):
        if isinstance(record, Message) and is_kept(spans, record.channel_id, record.log_time):
            yield record


def _log_time(message: Message) -> int:
    return message.log_time


class _File(io.FileIO):
    """A file whose disk or network may fail: RecordingError then says so, since the content is not damaged."""

    def readinto(self, buffer: Any) -> int:
        try:
            return super().readinto(buffer)
        except OSError as error:
            raise RecordingError(f"cannot be read: {error.strerror}", path=Path(self.name)) from None

    def readall(self) -> bytes:
        try:
            return super().readall()
        except OSError as error:
            raise RecordingError(f"cannot be read: {error.strerror}", path=Path(self.name)) from None


def open_file(path: Path) -> IO[bytes]:
    """Open a file for reading. Raises RecordingError, also later when it cannot be read."""
    try:
        return io.BufferedReader(_File(str(path)), _READ_AT_ONCE)
    except OSError as error:
        raise RecordingError(f"cannot be opened: {error.strerror}", path=path) from None


def open_mcap(path: Path) -> Log:
    """The log of an MCAP file, by its index or from start to end. Raises RecordingError."""
    if not path.exists():
        raise RecordingError("no such file", path=path)
    if not path.is_file():
        raise RecordingError(
            f"expected an MCAP file, found {'a directory' if path.is_dir() else 'a device'}", path=path
        )
    with open_file(path) as file:
        check_magic(path, file)
        try:
            summary = read_summary(file)
            if summary is not None and _index_is_sound(summary):
                start_ns = min((c.message_start_time for c in summary.chunk_indexes), default=0)
                end_ns = max((c.message_end_time for c in summary.chunk_indexes), default=0)
                tags = read_metadata(file, summary, TAGS)
                return Log(path, _make_channels(summary), indexed=True, start_ns=start_ns, end_ns=end_ns, tags=tags)
        except DAMAGE as error:
            return open_from_start(path, error)
    return open_from_start(path)


def open_from_start(path: Path, index_error: BaseException | None = None, promised: tuple[Channel, ...] = ()) -> Log:
    """The log of an MCAP file whose index is missing or wrong, read from start to end, as far as it goes.

    `index_error`: what is wrong with the index. `promised`: the channels as the index has them, where it could be read.
    Raises RecordingError: the file is damaged and no message can be read.
    """
    counts: Counter[int] = Counter()
    start_ns, end_ns, tags = 1 << 64, 0, dict[str, str]()
    with open_file(path) as file:
        stream = RecordsFromStart(file)
        for record in stream:
            if isinstance(record, Message):
                counts[record.channel_id] += 1
                start_ns, end_ns = min(start_ns, record.log_time), max(end_ns, record.log_time)
            elif isinstance(record, Metadata) and record.name == TAGS:
                tags |= record.metadata
    expected = {c.number: c.messages for c in promised}
    channels = tuple(
        _make_channel(number, channel, stream.schemas.get(channel.schema_id), counts[number], expected.get(number))
        for number, channel in sorted(stream.channels.items())
    )
    error = stream.error or index_error
    if error is None and promised and sum(expected.values()) != sum(counts.values()):
        error = ValueError(
            f"the index promises {sum(expected.values())} messages, and there are {sum(counts.values())}"
        )
    damage = _describe_error(error) if error else None
    if damage and not sum(counts.values()):
        raise RecordingError(f"damaged, and no message can be read ({damage})", path=path)
    if damage and stream.complete:
        damage = f"its index cannot be used ({damage}): read from start to end, no message is lost"
    return Log(
        path,
        channels,
        indexed=False,
        damage=damage,
        complete=stream.complete,
        went_on=stream.went_on,
        start_ns=start_ns,
        end_ns=end_ns,
        notes=(UNPROTECTED,) if stream.unprotected else (),
        tags=tags,
    )


UNPROTECTED = "no checksum is over its messages: bits that changed since it was written are not noticed"
"""The note on a file whose messages lie outside of chunks, written without the checksum of its data."""


def _describe_error(error: BaseException) -> str:
    """Why reading failed, for a note."""
    if isinstance(error, EndOfFile | struct.error):
        return "the file ends too early"
    if isinstance(error, CRCValidationError):
        return f"the checksum of a {type(error.record).__name__} record fails"
    if isinstance(error, zstandard.ZstdError | RuntimeError):
        return f"a chunk cannot be decompressed: {error}"
    return f"{error}" if str(error) and not isinstance(error, KeyError) else f"{type(error).__name__} {error}".strip()


def _index_is_sound(summary: Summary) -> bool:
    """Whether the index is complete: counts, every channel, every schema, and the places of the chunks."""
    statistics = summary.statistics
    return (
        statistics is not None
        and all(number in summary.channels for number in statistics.channel_message_counts)
        and all(c.schema_id == 0 or c.schema_id in summary.schemas for c in summary.channels.values())
        and (statistics.message_count == 0 or bool(summary.chunk_indexes))
        and sum(statistics.channel_message_counts.values()) == statistics.message_count
    )


def _make_channels(summary: Summary) -> tuple[Channel, ...]:
    counts = summary.statistics.channel_message_counts if summary.statistics else {}
    return tuple(
        _make_channel(number, channel, summary.schemas.get(channel.schema_id), counts.get(number, 0))
        for number, channel in sorted(summary.channels.items())
    )


def _ahead_ns(text: str) -> int:
    """`AHEAD` in the metadata of a channel, in ns; 0 for a text that is no whole number."""
    return int(text) if re.fullmatch(r"-?[0-9]{1,18}", text) else 0


def _make_channel(number: int, channel: Any, schema: Any, messages: int, expected: int | None = None) -> Channel:
    """A channel from its MCAP records (`schema` None: it has none); `messages`: read, `expected`: by the index."""
    return Channel(
        number=number,
        topic=channel.topic,
        schema=schema.name if schema is not None else "",
        encoding=channel.message_encoding,
        messages=messages,
        expected=expected,
        schema_encoding=schema.encoding if schema is not None else "",
        schema_data=schema.data if schema is not None else b"",
        ahead_ns=_ahead_ns(channel.metadata.get(AHEAD, "")),
        part=channel.metadata.get(PART, ""),
        metadata=dict(channel.metadata),
    )


@dataclass(frozen=True)
class Messages:
    """Payloads and log times of all messages of some channels, by channel number, in the order read."""

    payloads: Mapping[int, list[bytes]]
    log_time_ns: Mapping[int, list[int]]
    skipped: int = 0  # messages with an impossible log time

    def notes(self) -> tuple[str, ...]:
        """A note on the messages that were skipped; none: nothing was."""
        return (f"{count_noun(self.skipped, 'message')} logged at an impossible time: skipped",) if self.skipped else ()


def gather_messages(log: Log, numbers: frozenset[int]) -> Messages:
    """All messages of some channels in memory. Raises RecordingError: too much memory; BrokenIndexError."""
    allowance = DecodeAllowance(log.file_bytes())
    payloads: dict[int, list[bytes]] = {number: [] for number in numbers}
    times: dict[int, list[int]] = {number: [] for number in numbers}
    skipped = 0
    for number, log_time_ns, payload in log.payloads(numbers):
        if log_time_ns > LAST_NS:
            skipped += 1
            continue
        try:
            allowance.spend(len(payload))
        except OversizeError as error:
            topic = next(c.topic for c in log.channels if c.number == number)
            raise RecordingError(str(error), path=log.path, topic=topic) from None
        payloads[number].append(payload)
        times[number].append(log_time_ns)
    return Messages(payloads, times, skipped)


# A window of a log, in seconds since the first message of the truth.

_NEAR_END_NS = 10_000_000_000
"""Time before the end in which the last message is sought first; if there is none, the whole recording is read."""


def cut_window(log: Log, topic: str, window_s: WindowSeconds, max_gap_s: float = 0.0) -> Log:
    """The log restricted to `window_s`, in seconds since the first message on the `topic` of its truth was logged.

    `max_gap_s`: poses are interpolated over such gaps.
    Raises EmptyWindowError: the topic has no message in it; BrokenIndexError.
    """
    if window_s is None or window_s == (None, None) or log.window is not None:
        return log
    from_s, to_s = window_s
    numbers = frozenset(c.number for c in log.channels if c.topic == topic and c.messages)
    times_ns = (time_ns for _, time_ns, _ in log.payloads(numbers))
    first_ns = next(times_ns, None) if log.indexed else min(times_ns, default=None)
    if first_ns is None:  # all messages are lost: decoding them raises the error
        return log
    window = Window(
        ALWAYS[0] if from_s is None else first_ns + round(from_s * 1e9),
        ALWAYS[1] if to_s is None else first_ns + round(to_s * 1e9),
        max(POSE_MARGIN_NS, round(max_gap_s * 1e9)),
    )
    cut = log.within(window)
    if next(cut.payloads(numbers), None) is None:
        span_s = (_last_ns(log, numbers) - first_ns) * 1e-9
        raise EmptyWindowError(
            f"no message in the window {describe_window(from_s, to_s)}; there are some from 0 to {span_s:.10g} s",
            path=log.path,
            topic=topic,
            key=("window_s",),
        )
    return cut


def _last_ns(log: Log, numbers: frozenset[int]) -> int:
    """Log time of the last message of some channels."""
    for since_ns in (log.end_ns - _NEAR_END_NS, ALWAYS[0]):
        times_ns = [time_ns for _, time_ns, _ in log.within(Window(since_ns)).payloads(numbers)]
        if times_ns:
            return max(times_ns)
    return log.start_ns


def window_notes(window_s: WindowSeconds) -> list[str]:
    """A note that only a window is read; none: all is."""
    if window_s is None or window_s == (None, None):
        return []
    return [f"window {describe_window(*window_s)} of the recording: seconds count from there"]
