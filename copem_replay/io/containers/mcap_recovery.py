"""The records of an MCAP file from its start, as far as they go: for files whose index is missing or wrong.

A chunk whose checksum or compression fails, or that is too large to be one, is left out and the next one read; of a
chunk that the end of the file cuts off, what can be decompressed is read, and of one that is broken inside what is
before the break. Nothing is raised: look at `error` afterwards.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from typing import IO

from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Message, Schema

from copem_replay.io.containers.mcap_records import (
    DAMAGE,
    HEAD,
    MAGIC,
    OPCODES,
    PRIVATE,
    RECORD_LIMIT_BYTES,
    Allowance,
    in_chunk,
    in_cut_chunk,
    parsed,
    without_trace,
)


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
        self.error = self.error or without_trace(error)
        self.complete &= complete

    def _records(self) -> Iterator[McapRecord]:
        self._file.seek(0)
        size, allowance = os.fstat(self._file.fileno()).st_size, Allowance(self._file)
        checksum = zlib.crc32(self._file.read(len(MAGIC)))
        data_ended = False
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
                    yield from in_cut_chunk(body, allowance)
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
                for record in in_chunk(body, allowance) if opcode == Opcode.CHUNK else (parsed(opcode, body),):
                    self.went_on |= self.error is not None and isinstance(record, Message)
                    if record is not None:
                        yield record
            except DAMAGE as error:
                self._failed(error)
