"""An MCAP file through its index: the summary at its end, and messages in order of log time."""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from typing import IO

from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Message,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.summary import Summary

from copem_replay.io.containers.mcap_records import HEAD, MAGIC, RECORD_LIMIT_BYTES, Allowance, in_chunk, record_at
from copem_replay.io.window import Span, kept, overlap

_FOOTER = struct.Struct("<QQI")  # summary_start, summary_offset_start, summary_crc
_HELD_LIMIT_BYTES = 1 << 29
"""Messages of chunks that overlap in time wait for their turn: no more than these (chosen)."""


def summary_of(file: IO[bytes]) -> Summary | None:
    """The summary, its checksum checked; None where there is none. Raises DAMAGE."""
    size = os.fstat(file.fileno()).st_size
    at = size - len(MAGIC) - _FOOTER.size - HEAD.size
    if at < len(MAGIC):
        raise EndOfFile()
    file.seek(at)
    opcode, length = HEAD.unpack(file.read(HEAD.size))
    footer = file.read(_FOOTER.size)
    if file.read() != MAGIC or (opcode, length) != (Opcode.FOOTER, _FOOTER.size):
        raise EndOfFile()
    start, _, checksum = _FOOTER.unpack(footer)
    if start == 0:
        return None
    if not len(MAGIC) <= start <= at or at - start > RECORD_LIMIT_BYTES:
        raise ValueError("the index is somewhere else")
    file.seek(start)
    section = file.read(size - len(MAGIC) - 4 - start)
    if checksum and zlib.crc32(section) != checksum:
        raise ValueError("the checksum of the index fails")
    return _parsed(section[: at - start])


def _parsed(section: bytes) -> Summary:
    summary, stream = Summary(), BytesIO(section)
    # Chunks are not opened here: an index may point at anything.
    records = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=RECORD_LIMIT_BYTES).records
    while stream.tell() < len(section):
        record = next(records)
        if isinstance(record, Statistics):
            summary.statistics = record
        elif isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, AttachmentIndex):
            summary.attachment_indexes.append(record)
        elif isinstance(record, ChunkIndex):
            summary.chunk_indexes.append(record)
        elif isinstance(record, MetadataIndex):
            summary.metadata_indexes.append(record)
    return summary


def in_order(file: IO[bytes], summary: Summary, spans: Mapping[int, Span]) -> Iterator[Message]:
    """Messages of some channels in order of log time, of equal ones as in the file. Raises DAMAGE.

    `spans`: which, by channel; chunks that hold none of them are not opened.
    """
    if any(number not in summary.channels for c in summary.chunk_indexes for number in c.message_index_offsets):
        raise ValueError("the index lacks a channel")
    chunks = {c.chunk_start_offset: c for c in summary.chunk_indexes if _may_hold(c, spans)}
    waiting: list[tuple[int, int, int, Message | None]] = [
        (c.message_start_time, offset, -1, None) for offset, c in chunks.items()
    ]
    heapq.heapify(waiting)
    allowance, held = Allowance(file), 0
    while waiting:
        _, offset, place, message = heapq.heappop(waiting)
        if message is not None:
            held -= len(message.data)
            yield message
            continue
        for place, record in enumerate(in_chunk(record_at(file, offset, Opcode.CHUNK), allowance)):
            if not isinstance(record, Message):
                continue
            if record.channel_id not in summary.channels:
                raise ValueError("the index lacks a channel")
            if kept(spans, record.channel_id, record.log_time):
                held += len(record.data)
                if held > _HELD_LIMIT_BYTES:
                    raise ValueError("its chunks overlap in time")
                heapq.heappush(waiting, (record.log_time, offset, place, record))


def _may_hold(chunk: ChunkIndex, spans: Mapping[int, Span]) -> bool:
    numbers = spans.keys() & chunk.message_index_offsets.keys() if chunk.message_index_offsets else spans.keys()
    return overlap((spans[n] for n in numbers), chunk.message_start_time, chunk.message_end_time)


def renumbered(message: Message, numbers: Mapping[int, int]) -> Message:
    """The same message on another channel."""
    return Message(numbers[message.channel_id], message.log_time, message.data, message.publish_time, message.sequence)
