"""MCAP files taken apart to be hit and put together again, with checksums that fit: for `fuzz.py`."""

from __future__ import annotations

import random
import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6
CHUNK_INDEX, STATISTICS, DATA_END = 8, 11, 15


def record(opcode: int, body: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


@dataclass
class Schema:
    """A record of a schema."""

    id: int
    name: bytes
    encoding: bytes
    data: bytes

    def body(self) -> bytes:
        """What stands after opcode and length."""
        return struct.pack("<H", self.id) + text(self.name) + text(self.encoding) + text(self.data)


@dataclass
class Channel:
    """A record of a channel."""

    id: int
    schema: int
    topic: bytes
    encoding: bytes

    def body(self) -> bytes:
        """What stands after opcode and length."""
        return struct.pack("<HH", self.id, self.schema) + text(self.topic) + text(self.encoding) + text(b"")


@dataclass
class Message:
    """A record of a message."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes

    def body(self) -> bytes:
        """What stands after opcode and length."""
        return struct.pack("<HIQQ", self.channel, self.sequence, self.log_time, self.publish_time) + self.data


@dataclass
class Raw:
    """Bytes in place of a record: its length may lie."""

    opcode: int
    content: bytes
    length: int


@dataclass
class Piece:
    """A chunk; the fields that are None are as they should be."""

    records: list[Schema | Channel | Message | Raw]
    compression: str = "zstd"
    claimed: int | None = None
    checksum: int | None = None
    content: bytes | None = None  # instead of the records
    length: int | None = None  # claimed, of the compressed data


@dataclass
class Sample:
    """A recording taken apart."""

    name: str
    schemas: list[Schema]
    channels: list[Channel]
    messages: list[Message]

    def encoding(self, message: Message) -> bytes:
        """As what a message is encoded, by its channel."""
        return next((c.encoding for c in self.channels if c.id == message.channel), b"")


@dataclass
class Model:
    """A file to be put together."""

    pieces: list[Piece]
    indexed: bool = True
    counts: dict[int, int] = field(default_factory=dict)  # instead of the true ones
    offsets: dict[int, int] = field(default_factory=dict)  # of chunks, instead of the true ones
    start_times: dict[int, int] = field(default_factory=dict)

    def written(self) -> bytes:
        """The file."""
        out = bytearray(MAGIC + record(HEADER, text(b"") + text(b"fuzz")))
        indexes, counts, kept = [], Counter[int](), {}
        for k, piece in enumerate(self.pieces):
            plain = bytearray()
            times = []
            for item in piece.records:
                if isinstance(item, Raw):
                    plain += record(item.opcode, item.content, item.length)
                    continue
                opcode = SCHEMA if isinstance(item, Schema) else CHANNEL if isinstance(item, Channel) else MESSAGE
                plain += record(opcode, item.body())
                if isinstance(item, Message):
                    counts[item.channel] += 1
                    times.append(item.log_time)
                else:
                    kept[opcode, item.id] = item
            content = piece.content if piece.content is not None else compressed(bytes(plain), piece.compression)
            checksum = piece.checksum if piece.checksum is not None else zlib.crc32(plain)
            claimed = piece.claimed if piece.claimed is not None else len(plain)
            start, end = min(times, default=0), max(times, default=0)
            length = piece.length if piece.length is not None else len(content)
            body = struct.pack("<QQQI", start, end, claimed & (2**64 - 1), checksum) + text(piece.compression.encode())
            body += struct.pack("<Q", length & (2**64 - 1)) + content
            at = self.offsets.get(k, len(out))
            index = struct.pack("<QQQQ", self.start_times.get(k, start), end, at, 9 + len(body)) + text(b"")
            index += struct.pack("<Q", 0) + text(piece.compression.encode()) + struct.pack("<QQ", len(content), claimed)
            indexes.append(record(CHUNK_INDEX, index))
            out += record(CHUNK, body)
        out += record(DATA_END, bytes(4))
        start = len(out)
        if not self.indexed:
            return bytes(out + record(FOOTER, bytes(20)) + MAGIC)
        for (opcode, _), item in kept.items():
            out += record(opcode, item.body())
        for channel in {c for o, c in kept if o == CHANNEL} & self.counts.keys():
            counts[channel] = self.counts[channel]
        stated = b"".join(struct.pack("<HQ", c & 0xFFFF, n) for c, n in counts.items())
        total = sum(counts.values()) & (2**64 - 1)
        out += record(
            STATISTICS,
            struct.pack("<QHIIIIQQ", total, len(self.pieces), len(counts), 0, 0, len(self.pieces), 0, 0) + text(stated),
        )
        out += b"".join(indexes)
        footer = struct.pack("<BQQQ", FOOTER, 20, start, 0)
        checksum = zlib.crc32(footer, zlib.crc32(out[start:]))
        return bytes(out + footer + struct.pack("<I", checksum) + MAGIC)


def compressed(plain: bytes, compression: str) -> bytes:
    if compression == "zstd":
        return zstandard.compress(plain, 1)
    return lz4.frame.compress(plain) if compression == "lz4" else plain


def taken_apart(path: Path, most: int) -> Sample:
    """The first `most` messages of each channel."""
    from copem_replay.io.containers.mcap_records import RecordsFromStart

    counts, messages = Counter[int](), []
    with path.open("rb") as file:
        stream = RecordsFromStart(file)
        for item in stream:
            if type(item).__name__ == "Message" and counts[item.channel_id] < most:
                counts[item.channel_id] += 1
                messages.append(
                    Message(item.channel_id, item.sequence, item.log_time, item.publish_time, bytes(item.data))
                )
    schemas = [Schema(s.id, s.name.encode(), s.encoding.encode(), s.data) for s in stream.schemas.values()]
    channels = [
        Channel(c.id, c.schema_id, c.topic.encode(), c.message_encoding.encode()) for c in stream.channels.values()
    ]
    return Sample(path.stem, schemas, channels, messages)


def model_of(sample: Sample, dice: random.Random, most: tuple[int, ...] = (5, 10, 40)) -> Model:
    """A sound file of so many messages of a sample, in chunks of some size and compression."""
    import copy

    first = dice.randrange(max(1, len(sample.messages) // 2))
    some = sample.messages[first : first + dice.choice(most)]
    schemas, channels, messages = copy.deepcopy((sample.schemas, sample.channels, some))
    size = dice.choice((3, 10, 100))
    groups = [messages[k : k + size] for k in range(0, len(messages), size)] or [[]]
    compression = dice.choice(("zstd", "zstd", "lz4", ""))
    pieces = [Piece([*schemas, *channels, *group], compression) for group in groups]
    return Model(pieces, indexed=dice.random() < 0.7)
