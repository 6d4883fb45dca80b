"""A recording that was looked at: its channels, the payloads of some of them, what can be saved of a damaged file.

Here it is an MCAP file; other containers (`io/open.py` lists them) derive from it. A file with a sound index is read
through it. Everything else (no index, an index
that lies, a file that was cut off, a checksum that fails) is read from start to end, as far as it goes.
"""

from __future__ import annotations

import io
import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import zstandard
from mcap.exceptions import EndOfFile
from mcap.records import Message
from mcap.stream_reader import CRCValidationError
from mcap.summary import Summary

from copem_replay.core.errors import RecordingError
from copem_replay.io.channel import Channel
from copem_replay.io.containers.mcap_indexed import in_order, summary_of
from copem_replay.io.containers.mcap_records import DAMAGE, without_trace
from copem_replay.io.containers.mcap_recovery import FromStart
from copem_replay.io.containers.unsupported import check_magic
from copem_replay.io.together import AHEAD, PART
from copem_replay.io.window import ALWAYS, Span, Window, kept

_READ_AT_ONCE = 1 << 16
"""Bytes (chosen: a call of Python's for as many takes no time beside reading them)."""


class BrokenIndexError(Exception):
    """An index that seemed sound is not, or what it points at is damaged: `Log.from_start` is the way."""

    def __init__(self, path: Path) -> None:
        self.path, self.reason = path, "the index cannot be used"
        super().__init__(f"{path}: {self.reason}")


@dataclass(frozen=True)
class Log:
    """A recording that was looked at: an MCAP file; other containers do the same in their own way.

    `damage` says what is wrong with the file, None where nothing is; `complete` whether all messages can be
    read all the same. `notes`: what else is to be said of the container. Counts of messages are those of the whole
    recording, whatever the `window`.
    """

    path: Path
    channels: tuple[Channel, ...]  # by number
    indexed: bool
    damage: str | None = None
    complete: bool = True
    went_on: bool = False  # whether messages after the damage were read
    start_ns: int = 0  # log time of the first message
    end_ns: int = ALWAYS[1]  # and of the last one
    notes: tuple[str, ...] = ()
    window: Window | None = None  # what is read of it, None: all

    def within(self, window: Window | None) -> Log:
        """The same recording, of which only a window is read."""
        return replace(self, window=window)

    def spans(self, numbers: Set[int]) -> dict[int, Span]:
        """What is read of some channels, by their numbers."""
        if self.window is None:
            return dict.fromkeys(numbers, ALWAYS)
        known = {c.number: self.window.span(c) for c in self.channels if c.number in numbers}
        return dict.fromkeys(numbers, (self.window.from_ns, self.window.to_ns)) | known

    def payloads(self, numbers: frozenset[int]) -> Iterator[tuple[int, int, bytes]]:
        """Messages of some channels: channel number, log time in ns, payload. As `messages`."""
        for message in self.messages(numbers):
            yield message.channel_id, message.log_time, message.data

    def messages(self, numbers: Set[int]) -> Iterator[Message]:
        """Messages of some channels: by log time through the index, else as in the file, up to the damage.

        Raises BrokenIndexError.
        """
        spans = self.spans(numbers)
        with open_file(self.path) as file:
            for message in self._by_index(file, spans) if self.indexed else FromStart(file):
                if isinstance(message, Message) and kept(spans, message.channel_id, message.log_time):
                    yield message

    def from_start(self, error: BrokenIndexError) -> Log:
        """The same recording, read without the index that turned out to be broken. Raises RecordingError."""
        return from_start(self.path, error.__cause__, self.channels).within(self.window)

    def _by_index(self, file: IO[bytes], spans: Mapping[int, Span]) -> Iterator[Message]:
        """Messages in order of log time. Raises BrokenIndexError, also where there are not as many as promised."""
        promised = sum(c.messages for c in self.channels if c.number in spans)
        found = 0
        try:
            summary = summary_of(file)
            if summary is None:
                raise ValueError("the index is gone")
            for message in in_order(file, summary, spans):
                found += 1
                yield message
            if found != promised and self.window is None:  # the index does not count a window's messages
                raise ValueError(f"the index promises {promised} messages, and there are {found}")
        except DAMAGE as error:
            raise BrokenIndexError(self.path) from without_trace(error)


class _File(io.FileIO):
    """A file whose disk or network may fail: that is no damage of what is in it, and is said of it."""

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
    """Open a file to be read. Raises RecordingError, also later when it cannot be read."""
    try:
        return io.BufferedReader(_File(str(path)), _READ_AT_ONCE)
    except OSError as error:
        raise RecordingError(f"cannot be opened: {error.strerror}", path=path) from None


def open_mcap(path: Path) -> Log:
    """Look at an MCAP file. Raises RecordingError."""
    if not path.exists():
        raise RecordingError("no such file", path=path)
    if not path.is_file():
        raise RecordingError(
            f"expected an MCAP file, found {'a directory' if path.is_dir() else 'a device'}", path=path
        )
    with open_file(path) as file:
        check_magic(path, file)
        try:
            summary = summary_of(file)
            if summary is not None and _index_is_sound(summary):
                start_ns = min((c.message_start_time for c in summary.chunk_indexes), default=0)
                end_ns = max((c.message_end_time for c in summary.chunk_indexes), default=0)
                return Log(path, _channels_of(summary), indexed=True, start_ns=start_ns, end_ns=end_ns)
        except DAMAGE as error:
            return from_start(path, error)
    return from_start(path)


def from_start(path: Path, index_error: BaseException | None = None, promised: tuple[Channel, ...] = ()) -> Log:
    """Look at an MCAP file whose index is missing or wrong: from start to end, as far as it goes.

    `promised`: the channels as the index has them, where it could be read. Raises RecordingError where there
    is damage and no message before it.
    """
    counts: Counter[int] = Counter()
    start_ns, end_ns = 1 << 64, 0
    with open_file(path) as file:
        stream = FromStart(file)
        for record in stream:
            if isinstance(record, Message):
                counts[record.channel_id] += 1
                start_ns, end_ns = min(start_ns, record.log_time), max(end_ns, record.log_time)
    expected = {c.number: c.messages for c in promised}
    channels = tuple(
        _channel(number, channel, stream.schemas.get(channel.schema_id), counts[number], expected.get(number))
        for number, channel in sorted(stream.channels.items())
    )
    error = stream.error or index_error
    if error is None and promised and sum(expected.values()) != sum(counts.values()):
        error = ValueError(
            f"the index promises {sum(expected.values())} messages, and there are {sum(counts.values())}"
        )
    damage = _reason(error) if error else None
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
    )


def _reason(error: BaseException) -> str:
    """Say why reading failed."""
    if isinstance(error, EndOfFile | struct.error):
        return "the file ends too early"
    if isinstance(error, CRCValidationError):
        return f"the checksum of a {type(error.record).__name__} record fails"
    if isinstance(error, zstandard.ZstdError | RuntimeError):
        return f"a chunk cannot be decompressed: {error}"
    return f"{error}" if str(error) and not isinstance(error, KeyError) else f"{type(error).__name__} {error}".strip()


def _index_is_sound(summary: Summary) -> bool:
    """Whether the index tells all: counts, every channel, every schema, and where the chunks are."""
    statistics = summary.statistics
    return (
        statistics is not None
        and all(number in summary.channels for number in statistics.channel_message_counts)
        and all(c.schema_id == 0 or c.schema_id in summary.schemas for c in summary.channels.values())
        and (statistics.message_count == 0 or bool(summary.chunk_indexes))
        and sum(statistics.channel_message_counts.values()) == statistics.message_count
    )


def _channels_of(summary: Summary) -> tuple[Channel, ...]:
    counts = summary.statistics.channel_message_counts if summary.statistics else {}
    return tuple(
        _channel(number, channel, summary.schemas.get(channel.schema_id), counts.get(number, 0))
        for number, channel in sorted(summary.channels.items())
    )


def _ahead_ns(said: str) -> int:
    """As the metadata of a channel has it that was written from several recordings."""
    return int(said) if re.fullmatch(r"-?[0-9]{1,18}", said) else 0


def _channel(number: int, channel: Any, schema: Any, messages: int, expected: int | None = None) -> Channel:
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
    )
