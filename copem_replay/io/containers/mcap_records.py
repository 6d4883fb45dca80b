"""Records of an MCAP file, taken from bytes that may be anything: nothing is believed that was not looked at.

Lengths are held against what is there before anything is read; chunks are decompressed piece by piece, up to a limit,
whatever they claim. (MCAP specification: records are an opcode, a length of eight bytes, and as many bytes.)
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import IO, Any

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError

MAGIC = b"\x89MCAP0\r\n"
RECORD_LIMIT_BYTES = 1 << 29
"""A longer record is taken for damage (chosen)."""
CHUNK_LIMIT_BYTES = 1 << 28
"""A chunk that holds more when decompressed is taken for damage (chosen: writers make them of 1 to 16 MB)."""
MOST_RECORDS = 1 << 18
"""A chunk that holds more records is taken for damage (chosen: 8 MB of the shortest messages are as many)."""
_SMALL_BYTES = 1 << 26
_MOST_TOO_LARGE = 2
MOST_EXPANSION = 1000
"""A file whose chunks hold more than this many times its size, and more than 64 MiB, is taken for damaged (chosen:
recordings of traffic have 2 to 40, of what hardly moves some hundreds)."""
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
    MemoryError,  # a length that was hit
)
"""What reading a damaged file raises."""

HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, uncompressed size, checksum, length of the compression's name
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_PIECE_BYTES = 1 << 20
OPCODES = frozenset(int(opcode) for opcode in Opcode)
PRIVATE = 0x80
"""Opcodes from here on are for others' use."""
_NEEDED: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}
_IN_CHUNKS = frozenset((int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)))


def without_trace(error: BaseException) -> BaseException:
    """The error without the frames it went through: they would keep a chunk in memory for as long as it is known."""
    error.__context__ = None
    return error.with_traceback(None)


class Allowance:
    """How much the chunks of a file may hold in all, and how many of them may be too large."""

    def __init__(self, file: IO[bytes]) -> None:
        self._left = _SMALL_BYTES + MOST_EXPANSION * os.fstat(file.fileno()).st_size
        self._too_large = 0

    def refuse(self) -> ValueError:
        """Take note of a chunk that is too large, for which work was done in vain."""
        self._too_large += 1
        return ValueError(f"a chunk holds more than {CHUNK_LIMIT_BYTES >> 20} MiB")

    def spend(self, size: int) -> None:
        """Take note of a chunk. Raises ValueError when it is one too many."""
        self._left -= size
        if self._too_large > _MOST_TOO_LARGE:
            raise ValueError("too many chunks are too large")
        if self._left < 0:
            raise ValueError(f"its chunks hold more than {MOST_EXPANSION} times the size of the file")


class _Exact(ReadDataStream):
    """Gives what is asked for, or raises EndOfFile; mcap's own gives what there is."""

    def read(self, length: int) -> bytes:
        data: bytes = super().read(length)
        if len(data) < length:
            raise EndOfFile()
        return data


def parsed(opcode: int, body: bytes) -> McapRecord | None:
    """The record of an opcode that is no chunk, None where nothing here needs it. Raises DAMAGE."""
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
        return Message(
            channel_id=channel,
            log_time=log_time,
            data=body[_MESSAGE_HEAD.size :],
            publish_time=publish_time,
            sequence=sequence,
        )
    record: McapRecord | None = _NEEDED[opcode].read(_Exact(BytesIO(body))) if opcode in _NEEDED else None
    return record


def in_chunk(body: bytes, allowance: Allowance) -> Iterator[McapRecord]:
    """Schemas, channels and messages of a chunk, of a broken one those before the break. Raises DAMAGE."""
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
    plain, whole = _decompressed(compression, memoryview(body)[content_at : content_at + size], claimed, allowance)
    allowance.spend(len(plain))
    if not whole:
        raise EndOfFile()
    if checksum and zlib.crc32(plain) != checksum:
        raise CRCValidationError(checksum, zlib.crc32(plain), Chunk(compression.decode(), b"", 0, 0, checksum, claimed))
    yield from _split(plain)


def in_cut_chunk(body: bytes, allowance: Allowance) -> Iterator[McapRecord]:
    """Whole records of a chunk whose end is missing. Raises nothing."""
    try:
        _, _, claimed, _, named = _CHUNK_HEAD.unpack_from(body)
        content = memoryview(body)[_CHUNK_HEAD.size + named + 8 :]
        plain, _ = _decompressed(body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + named], content, claimed, allowance)
        allowance.spend(len(plain))
        yield from _split(plain)
    except DAMAGE:
        return


def record_at(file: IO[bytes], offset: int, opcode: int) -> bytes:
    """The body of the record at a place that an index names. Raises DAMAGE."""
    end = os.fstat(file.fileno()).st_size
    if offset + HEAD.size > end:
        raise EndOfFile()
    file.seek(offset)
    found, length = HEAD.unpack(file.read(HEAD.size))
    if found != opcode:
        raise ValueError("the index points at something else")
    if length > RECORD_LIMIT_BYTES:
        raise ValueError("something that is no record")
    if offset + HEAD.size + length > end:
        raise EndOfFile()
    return file.read(length)


def _split(plain: bytes | bytearray) -> Iterator[McapRecord]:
    at = number = 0
    while at < len(plain):
        number += 1
        if number > MOST_RECORDS:
            raise ValueError(f"a chunk holds more than {MOST_RECORDS} records")
        if at + HEAD.size > len(plain):
            raise EndOfFile()
        opcode, length = HEAD.unpack_from(plain, at)
        at += HEAD.size
        if opcode not in _IN_CHUNKS and opcode < PRIVATE:
            raise ValueError("something that is no record in a chunk")
        if length > len(plain) - at:
            raise EndOfFile()
        if opcode in _IN_CHUNKS:
            record = parsed(opcode, bytes(plain[at : at + length]))
            if record is not None:
                yield record
        at += length


def _decompressed(
    compression: bytes, content: memoryview, claimed: int, allowance: Allowance
) -> tuple[bytes | bytearray, bool]:
    """As much as there is, and whether it came to its end. Raises DAMAGE."""
    if compression == b"zstd":
        return _zstd(content, claimed, allowance)
    if compression == b"lz4":
        return _lz4(content, allowance)
    if compression:
        raise ValueError(f"a chunk is compressed as {compression[:20].decode(errors='replace')!r}, which is not read")
    if len(content) > CHUNK_LIMIT_BYTES:
        raise allowance.refuse()
    return bytes(content), True


def _zstd(content: memoryview, claimed: int, allowance: Allowance) -> tuple[bytearray, bool]:
    plain, reader = bytearray(), zstandard.ZstdDecompressor().stream_reader(content)
    size = zstandard.frame_content_size(content)  # −1: the frame does not say
    if size > CHUNK_LIMIT_BYTES:
        raise allowance.refuse()
    while piece := reader.read(_PIECE_BYTES):
        plain += piece
        if len(plain) > CHUNK_LIMIT_BYTES:
            raise allowance.refuse()
    return plain, len(plain) >= (claimed if size < 0 else size)


def _lz4(content: memoryview, allowance: Allowance) -> tuple[bytearray, bool]:
    plain, reader = bytearray(), lz4.frame.LZ4FrameDecompressor()
    fed: bytes | memoryview = content
    while not reader.eof:
        piece = reader.decompress(fed, max_length=_PIECE_BYTES)
        fed = b""
        plain += piece
        if len(plain) > CHUNK_LIMIT_BYTES:
            raise allowance.refuse()
        if not piece and reader.needs_input:
            return plain, False
    return plain, True
