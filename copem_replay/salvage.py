"""The records of an MCAP file from its start, as far as they go: for files whose index is missing or wrong.

A chunk whose checksum or compression fails is left out and the next one read; of a chunk that the end of the file cuts
off, what can be decompressed is read. Nothing is raised: look at `error` afterwards. (MCAP specification: records are
an opcode, a length of eight bytes, and as many bytes.)
"""

from __future__ import annotations

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
from mcap.stream_reader import breakup_chunk

MAGIC = b"\x89MCAP0\r\n"
RECORD_LIMIT_BYTES = 1 << 30
"""A longer record is taken for damage (chosen)."""
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

_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, uncompressed size, checksum, length of the compression's name
_OPCODES = {int(opcode) for opcode in Opcode}
_NEEDED: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}
_PRIVATE = 0x80  # opcodes from here on are for others' use


class FromStart:
    """Iterate to get the records; what was met on the way is in the attributes."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.error: BaseException | None = None  # the first one
        self.complete = True  # whether all messages were read all the same
        self.went_on = False  # whether messages were read after the damage

    def __iter__(self) -> Iterator[McapRecord]:
        for record in self._records():
            if isinstance(record, Schema):
                self.schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                self.channels.setdefault(record.id, record)
            yield record

    def _failed(self, error: BaseException, *, complete: bool = False) -> None:
        self.error = self.error or error
        self.complete &= complete

    def _records(self) -> Iterator[McapRecord]:
        self._file.seek(0)
        checksum = zlib.crc32(self._file.read(len(MAGIC)))
        data_ended = False
        while True:
            head = self._file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                return self._failed(EndOfFile(), complete=data_ended)
            opcode, length = _HEAD.unpack(head)
            if length > RECORD_LIMIT_BYTES or (opcode not in _OPCODES and opcode < _PRIVATE):
                return self._failed(ValueError("something that is no record"), complete=data_ended)
            body = self._file.read(length)
            if len(body) < length:
                self._failed(EndOfFile(), complete=data_ended)
                if opcode == Opcode.CHUNK:
                    yield from _of_cut_chunk(body)
                return
            if opcode == Opcode.DATA_END:
                data_ended = True
                expected = int.from_bytes(body[:4], "little")
                if expected not in (0, checksum):
                    self._failed(ValueError("the checksum of the data fails"))
            if opcode == Opcode.FOOTER:
                return
            checksum = zlib.crc32(body, zlib.crc32(head, checksum))
            if data_ended:
                continue  # what follows only repeats
            try:
                records = _parsed(opcode, body)
            except DAMAGE as error:
                self._failed(error)
                continue
            self.went_on |= self.error is not None and any(isinstance(r, Message) for r in records)
            yield from records


def _parsed(opcode: int, body: bytes) -> list[McapRecord]:
    """The record of an opcode; of a chunk the records in it; nothing of what is not needed here. Raises DAMAGE."""
    stream = ReadDataStream(BytesIO(body))
    if opcode == Opcode.CHUNK:
        return breakup_chunk(Chunk.read(stream), validate_crc=True)
    if opcode == Opcode.MESSAGE:
        return [Message.read(stream, len(body))]
    return [_NEEDED[opcode].read(stream)] if opcode in _NEEDED else []


def _of_cut_chunk(body: bytes) -> Iterator[McapRecord]:
    """Whole records of a chunk whose end is missing."""
    try:
        *_, named = _CHUNK_HEAD.unpack_from(body)
        content = body[_CHUNK_HEAD.size + named + 8 :]
        plain = _decompressed(body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + named], content)
        at = 0
        while at + _HEAD.size <= len(plain):
            opcode, length = _HEAD.unpack_from(plain, at)
            end = at + _HEAD.size + length
            if end > len(plain):
                return
            yield from _parsed(opcode, plain[at + _HEAD.size : end])
            at = end
    except DAMAGE:
        return


def _decompressed(compression: bytes, content: bytes) -> bytes:
    """As much as there is. Raises DAMAGE."""
    if compression == b"zstd":
        with zstandard.ZstdDecompressor().stream_reader(BytesIO(content)) as reader:
            return reader.read(RECORD_LIMIT_BYTES)
    if compression == b"lz4":
        plain: bytes = lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=RECORD_LIMIT_BYTES)
        return plain
    return content
