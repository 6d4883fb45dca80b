"""Records of an MCAP file, by its index or from its start, read with checks: the bytes may be anything.

A record is an opcode, a length of eight bytes, and as many bytes (MCAP specification). Lengths are compared with the
size of the file before anything is read; chunks are decompressed piece by piece, up to a limit, whatever size they
claim. A record, chunk or file beyond the limits below is taken for damaged.
"""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from typing import IO, Any

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Chunk,
    ChunkIndex,
    Header,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.records import Channel as ChannelRecord
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.summary import Summary

from copem_replay.io.window import Span, has_overlap, is_kept

MAGIC = b"\x89MCAP0\r\n"
RECORD_LIMIT_BYTES = 1 << 28
"""Longest record: room for the largest chunk, compressed or not, and its head."""
CHUNK_LIMIT_BYTES = 1 << 27
"""Most bytes of a decompressed chunk: writers make chunks of 1 to 16 MB."""
DEFINITION_LIMIT_BYTES = 1 << 24
"""Longest header, schema, channel or metadata: the definitions of OSI take 1 MB."""
MOST_RECORDS = 1 << 18
"""Most records of a chunk: 8 MB of the shortest messages are as many."""
_SMALL_BYTES = 1 << 26
_MOST_TOO_LARGE = 2
MOST_EXPANSION = 1000
"""Most bytes of all decompressed chunks together, in sizes of the file, beyond 64 MiB: recordings of traffic have 2 to
40, recordings in which hardly anything moves some hundreds."""
DAMAGE = (
    McapError,
    struct.error,
    EOFError,
    ValueError,  # includes checksums that fail and texts that are not UTF-8
    KeyError,
    RuntimeError,  # lz4
    OSError,  # an index that points outside of the file
    OverflowError,  # … far outside
    zstandard.ZstdError,
    MemoryError,  # a damaged length
)
"""Errors that reading a damaged file raises."""

HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, uncompressed size, checksum, length of the compression's name
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_PIECE_BYTES = 1 << 20
OPCODES = frozenset(int(opcode) for opcode in Opcode)
PRIVATE = 0x80
"""Opcodes from here on are private to other programs (MCAP specification)."""
_NEEDED: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: ChannelRecord,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}
_DEFINING = _NEEDED.keys() - {Opcode.ATTACHMENT}
_IN_CHUNKS = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)))


def drop_traceback(error: BaseException) -> BaseException:
    """The error without its traceback, whose frames would keep a chunk in memory as long as the error exists."""
    error.__context__ = None
    return error.with_traceback(None)


class ChunkAllowance:
    """How many bytes the chunks of a file may hold in all, and how many of them may be too large."""

    def __init__(self, file: IO[bytes]) -> None:
        self._left = _SMALL_BYTES + MOST_EXPANSION * os.fstat(file.fileno()).st_size
        self._too_large = 0

    def refuse(self) -> ValueError:
        """The error for a chunk that is too large; it is counted, as it cost work in vain."""
        self._too_large += 1
        return ValueError(f"a chunk holds more than {CHUNK_LIMIT_BYTES >> 20} MiB")

    def spend(self, size: int) -> None:
        """Count a chunk of `size` bytes. Raises ValueError: more than the allowance."""
        self._left -= size
        if self._too_large > _MOST_TOO_LARGE:
            raise ValueError("too many chunks are too large")
        if self._left < 0:
            raise ValueError(f"its chunks hold more than {MOST_EXPANSION} times the size of the file")


class _ExactStream(ReadDataStream):
    """A stream that reads exactly as much as is asked for, or raises EndOfFile; mcap's own reads what there is."""

    def read(self, length: int) -> bytes:
        data: bytes = super().read(length)
        if len(data) < length:
            raise EndOfFile()
        return data


def parse_record(opcode: int, body: bytes | memoryview) -> McapRecord | None:
    """The record of an opcode other than a chunk's; None: a kind that is not needed. Raises DAMAGE."""
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
        return Message(
            channel_id=channel,
            log_time=log_time,
            data=bytes(body[_MESSAGE_HEAD.size :]),
            publish_time=publish_time,
            sequence=sequence,
        )
    if opcode in _DEFINING and len(body) > DEFINITION_LIMIT_BYTES:
        raise ValueError(f"a definition takes more than {DEFINITION_LIMIT_BYTES >> 20} MiB")
    record: McapRecord | None = _NEEDED[opcode].read(_ExactStream(BytesIO(body))) if opcode in _NEEDED else None
    return record


def read_chunk(body: bytes, allowance: ChunkAllowance) -> Iterator[McapRecord]:
    """Schemas, channels and messages of a chunk, of a damaged one those before the damage. Raises DAMAGE."""
    _, _, claimed, checksum, named = _CHUNK_HEAD.unpack_from(body)
    content_at = _CHUNK_HEAD.size + named + 8
    if content_at > len(body):
        raise EndOfFile()
    size = int.from_bytes(body[content_at - 8 : content_at], "little")
    if size > len(body) - content_at:
        raise EndOfFile()
    allowance.spend(0)
    if claimed > CHUNK_LIMIT_BYTES:
        raise allowance.refuse()
    compression = body[_CHUNK_HEAD.size : content_at - 8]
    plain, whole = _decompress(compression, memoryview(body)[content_at : content_at + size], claimed, allowance)
    allowance.spend(len(plain))
    if not whole:
        raise EndOfFile()
    if checksum and zlib.crc32(plain) != checksum:
        raise CRCValidationError(checksum, zlib.crc32(plain), Chunk(compression.decode(), b"", 0, 0, checksum, claimed))
    yield from _split_records(plain)


def read_cut_chunk(body: bytes, allowance: ChunkAllowance) -> Iterator[McapRecord]:
    """Whole records of a chunk whose end is missing. Raises nothing."""
    try:
        _, _, claimed, _, named = _CHUNK_HEAD.unpack_from(body)
        content = memoryview(body)[_CHUNK_HEAD.size + named + 8 :]
        plain, _ = _decompress(body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + named], content, claimed, allowance)
        allowance.spend(len(plain))
        yield from _split_records(plain)
    except DAMAGE:
        return


def read_record_at(file: IO[bytes], offset: int, opcode: int) -> bytes:
    """The body of the record at an offset that an index names. Raises DAMAGE."""
    end = os.fstat(file.fileno()).st_size
    if offset + HEAD.size > end:
        raise EndOfFile()
    file.seek(offset)
    found_opcode, length = HEAD.unpack(file.read(HEAD.size))
    if found_opcode != opcode:
        raise ValueError("the index points at something else")
    if length > RECORD_LIMIT_BYTES:
        raise ValueError("something that is no record")
    if offset + HEAD.size + length > end:
        raise EndOfFile()
    return file.read(length)


def _split_records(plain: bytes | bytearray) -> Iterator[McapRecord]:
    """The records in a decompressed chunk. Raises DAMAGE: one is cut off, unknown, or there are too many."""
    offset = number = 0
    view = memoryview(plain)  # a slice of it copies nothing: a message may be as large as its chunk
    while offset < len(plain):
        number += 1
        if number > MOST_RECORDS:
            raise ValueError(f"a chunk holds more than {MOST_RECORDS} records")
        if offset + HEAD.size > len(plain):
            raise EndOfFile()
        opcode, length = HEAD.unpack_from(plain, offset)
        offset += HEAD.size
        if opcode not in _IN_CHUNKS and opcode < PRIVATE:
            raise ValueError("something that is no record in a chunk")
        if length > len(plain) - offset:
            raise EndOfFile()
        if opcode in _IN_CHUNKS:
            record = parse_record(opcode, view[offset : offset + length])
            if record is not None:
                yield record
        offset += length


def _decompress(
    compression: bytes, content: memoryview, claimed: int, allowance: ChunkAllowance
) -> tuple[bytes | bytearray, bool]:
    """The decompressed bytes of a chunk, as far as they go, and whether they are all. Raises DAMAGE."""
    if compression == b"zstd":
        return _decompress_zstd(content, claimed, allowance)
    if compression == b"lz4":
        return _decompress_lz4(content, allowance)
    if compression:
        raise ValueError(f"a chunk is compressed as {compression[:20].decode(errors='replace')!r}, which is not read")
    if len(content) > CHUNK_LIMIT_BYTES:
        raise allowance.refuse()
    return bytes(content), True


def _decompress_zstd(content: memoryview, claimed: int, allowance: ChunkAllowance) -> tuple[bytearray, bool]:
    plain, reader = bytearray(), zstandard.ZstdDecompressor().stream_reader(content)
    size = zstandard.frame_content_size(content)  # −1: the frame does not say
    if size > CHUNK_LIMIT_BYTES:
        raise allowance.refuse()
    while piece := reader.read(_PIECE_BYTES):
        plain += piece
        if len(plain) > CHUNK_LIMIT_BYTES:
            raise allowance.refuse()
    return plain, len(plain) >= (claimed if size < 0 else size)


def _decompress_lz4(content: memoryview, allowance: ChunkAllowance) -> tuple[bytearray, bool]:
    """The decompressed bytes, as far as they go, and whether they are all; never more than the limit."""
    plain, reader = bytearray(), lz4.frame.LZ4FrameDecompressor()
    next_input: bytes | memoryview = content
    while not reader.eof:
        piece = reader.decompress(next_input, max_length=_PIECE_BYTES)
        next_input = b""
        plain += piece
        if len(plain) > CHUNK_LIMIT_BYTES:
            raise allowance.refuse()
        if not piece and reader.needs_input:
            return plain, False
    return plain, True


# An MCAP file through its index: the summary at its end, and messages in order of log time.

_FOOTER = struct.Struct("<QQI")  # summary_start, summary_offset_start, summary_crc
_HELD_LIMIT_BYTES = 1 << 28
"""Most bytes of messages that wait for their turn, of chunks that overlap in time: two of the largest chunks."""


def read_summary(file: IO[bytes]) -> Summary | None:
    """The summary, its checksum checked; None where there is none. Raises DAMAGE."""
    size = os.fstat(file.fileno()).st_size
    footer_offset = size - len(MAGIC) - _FOOTER.size - HEAD.size
    if footer_offset < len(MAGIC):
        raise EndOfFile()
    file.seek(footer_offset)
    opcode, length = HEAD.unpack(file.read(HEAD.size))
    footer = file.read(_FOOTER.size)
    if file.read() != MAGIC or (opcode, length) != (Opcode.FOOTER, _FOOTER.size):
        raise EndOfFile()
    start, _, checksum = _FOOTER.unpack(footer)
    if start == 0:
        return None
    if not len(MAGIC) <= start <= footer_offset or footer_offset - start > RECORD_LIMIT_BYTES:
        raise ValueError("the index is somewhere else")
    file.seek(start)
    section = file.read(size - len(MAGIC) - 4 - start)
    if checksum and zlib.crc32(section) != checksum:
        raise ValueError("the checksum of the index fails")
    return _parse_summary(section[: footer_offset - start])


def _parse_summary(section: bytes) -> Summary:
    """The records of the summary section of a file. Raises DAMAGE."""
    summary, stream = Summary(), BytesIO(section)
    # Chunks stay closed: an index may point at anything.
    records = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=RECORD_LIMIT_BYTES).records
    while stream.tell() < len(section):
        record = next(records)
        if isinstance(record, Statistics):
            summary.statistics = record
        elif isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, ChannelRecord):
            summary.channels[record.id] = record
        elif isinstance(record, AttachmentIndex):
            summary.attachment_indexes.append(record)
        elif isinstance(record, ChunkIndex):
            summary.chunk_indexes.append(record)
        elif isinstance(record, MetadataIndex):
            summary.metadata_indexes.append(record)
    return summary


def read_metadata(file: IO[bytes], summary: Summary, name: str) -> dict[str, str]:
    """The metadata records of a name, later ones over earlier ones; empty without any. Raises DAMAGE."""
    entries: dict[str, str] = {}
    for index in summary.metadata_indexes:
        if index.name == name:
            record = parse_record(Opcode.METADATA, read_record_at(file, index.offset, Opcode.METADATA))
            entries |= record.metadata if isinstance(record, Metadata) else {}
    return entries


def read_by_log_time(file: IO[bytes], summary: Summary, spans: Mapping[int, Span]) -> Iterator[Message]:
    """Messages of some channels in order of log time, of equal ones as in the file. Raises DAMAGE.

    `spans`: the log time to read, by channel; chunks without such messages are not opened.
    """
    if any(number not in summary.channels for c in summary.chunk_indexes for number in c.message_index_offsets):
        raise ValueError("the index lacks a channel")
    chunks = {c.chunk_start_offset: c for c in summary.chunk_indexes if _may_hold(c, spans)}
    waiting: list[tuple[int, int, int, Message | None]] = [
        (c.message_start_time, offset, -1, None) for offset, c in chunks.items()
    ]
    heapq.heapify(waiting)
    allowance, held_bytes = ChunkAllowance(file), 0
    while waiting:
        _, offset, place, message = heapq.heappop(waiting)
        if message is not None:
            held_bytes -= len(message.data)
            yield message
            continue
        for place, record in enumerate(read_chunk(read_record_at(file, offset, Opcode.CHUNK), allowance)):
            if not isinstance(record, Message):
                continue
            if record.channel_id not in summary.channels:
                raise ValueError("the index lacks a channel")
            if is_kept(spans, record.channel_id, record.log_time):
                held_bytes += len(record.data)
                if held_bytes > _HELD_LIMIT_BYTES:
                    raise ValueError("its chunks overlap in time")
                heapq.heappush(waiting, (record.log_time, offset, place, record))


def _may_hold(chunk: ChunkIndex, spans: Mapping[int, Span]) -> bool:
    numbers = spans.keys() & chunk.message_index_offsets.keys() if chunk.message_index_offsets else spans.keys()
    return has_overlap((spans[n] for n in numbers), chunk.message_start_time, chunk.message_end_time)


def renumber_message(message: Message, numbers: Mapping[int, int]) -> Message:
    """The message on the channel that `numbers` gives for its own."""
    return Message(numbers[message.channel_id], message.log_time, message.data, message.publish_time, message.sequence)


# An MCAP file from its start, as far as it goes: for files whose index is missing or wrong.


class RecordsFromStart:
    """Iterates over the records of a file; the attributes tell what was met on the way. Iterating raises no DAMAGE.

    A chunk whose checksum or compression fails, or that is too large, is left out and the next one read. Of a chunk
    that the end of the file cuts off, what can be decompressed is read; of one that is damaged inside, the part before.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, ChannelRecord] = {}
        self.error: BaseException | None = None  # the first one
        self.complete = True  # whether all messages were read all the same
        self.went_on = False  # whether messages were read after the damage
        self.unprotected = False  # whether messages lie outside of chunks, and no checksum is over them

    def __iter__(self) -> Iterator[McapRecord]:
        for record in self._records():
            if isinstance(record, Schema):
                self.schemas.setdefault(record.id, record)
            elif isinstance(record, ChannelRecord):
                self.channels.setdefault(record.id, record)
            yield record

    def _failed(self, error: BaseException, *, complete: bool = False) -> None:
        self.error = self.error or drop_traceback(error)
        self.complete &= complete

    def _records(self) -> Iterator[McapRecord]:
        """The records from the start of the file, as far as they can be read; `error` says why no further."""
        self._file.seek(0)
        size, allowance = os.fstat(self._file.fileno()).st_size, ChunkAllowance(self._file)
        checksum = zlib.crc32(self._file.read(len(MAGIC)))
        data_ended = unchunked = False
        while True:
            head = self._file.read(HEAD.size)
            if len(head) < HEAD.size:
                return self._failed(EndOfFile(), complete=data_ended)
            opcode, length = HEAD.unpack(head)
            if length > RECORD_LIMIT_BYTES or (opcode not in OPCODES and opcode < PRIVATE):
                return self._failed(ValueError("something that is no record"), complete=data_ended)
            body = self._file.read(min(length, size - self._file.tell()))
            if len(body) < length:
                self._failed(EndOfFile(), complete=data_ended)
                if opcode == Opcode.CHUNK:
                    yield from read_cut_chunk(body, allowance)
                return
            if opcode == Opcode.DATA_END:
                data_ended = True
                expected = int.from_bytes(body[:4], "little")
                self.unprotected = unchunked and expected == 0
                if expected not in (0, checksum):
                    self._failed(ValueError("the checksum of the data fails"))
            if opcode == Opcode.FOOTER:
                if not data_ended:  # a flipped bit in the head of that record would hide the checksum, too
                    self._failed(ValueError("the record that ends the data is missing"))
                return
            checksum = zlib.crc32(body, zlib.crc32(head, checksum))
            if data_ended:
                continue  # what follows only repeats
            unchunked |= opcode == Opcode.MESSAGE
            try:
                for record in read_chunk(body, allowance) if opcode == Opcode.CHUNK else (parse_record(opcode, body),):
                    self.went_on |= self.error is not None and isinstance(record, Message)
                    if record is not None:
                        yield record
            except DAMAGE as error:
                self._failed(error)
