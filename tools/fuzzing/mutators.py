"""What `fuzz.py` does to recordings and documents: every way in which a file can be wrong, drawn from a seed."""

from __future__ import annotations

import copy
import csv
import io
import json
import random
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any

from fuzzing.mcap_model import Channel, Message, Model, Raw, Sample, Schema, compressed, model_of, record

_INTS = (0, 1, 2, 22, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_FLOATS = (float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 1e-320, 0.0, -0.0, -1.0, 1e7, 1e30, 2.0**63)
_NAMES = (b"", b"\n", b"a\nb", b"\x1b[31m", b"\xff\xfe", b"/objects", "é\u2028".encode(), b"x" * 70_000, b"\0")
_ENCODINGS = (b"", b"json", b"cdr", b"protobuf", b"ros1", b"flatbuffer", b"ros2msg", b"ros2idl", b"jsonschema")
_SCHEMAS = (
    b"osi3.GroundTruth", b"osi3.SensorView", b"osi3.SensorData", b"foxglove.SceneUpdate", b"foxglove.FrameTransform",
    b"foxglove.PoseInFrame", b"nav_msgs/msg/Odometry", b"tf2_msgs/TFMessage", b"visualization_msgs/msg/MarkerArray",
    b"vision_msgs/msg/Detection3DArray", b"derived_object_msgs/msg/ObjectArray", b"copem_replay.ListDetail",
    b"autoware_perception_msgs/msg/TrackedObjects", b"autoware_perception_msgs/msg/DetectedObjects",
)  # fmt: skip
Dice = random.Random


# ------------------------------------------------------------------------------- bytes


def flipped(data: bytes, dice: Dice) -> bytes:
    out = bytearray(data)
    for _ in range(dice.choice((1, 1, 2, 5, 30)) if out else 0):
        out[dice.randrange(len(out))] ^= 1 << dice.randrange(8)
    return bytes(out)


def overwritten(data: bytes, dice: Dice) -> bytes:
    at, length = dice.randrange(len(data) + 1), dice.choice((1, 2, 4, 8, 16, 100, 1000))
    fill = dice.choice((b"\0", b"\xff", b"\x80", b"A"))
    run = fill * length if dice.random() < 0.6 else dice.randbytes(length)
    return (data[:at] + run + data[at + length :])[: len(data)]


def cut(data: bytes, dice: Dice) -> bytes:
    return data[: dice.randrange(len(data) + 1)]


def spliced(data: bytes, dice: Dice) -> bytes:
    """A run of bytes left out, repeated, or put elsewhere."""
    a, b = sorted(dice.randrange(len(data) + 1) for _ in range(2))
    c = dice.randrange(len(data) + 1)
    return dice.choice((data[:a] + data[b:], data[:b] + data[a:], data[:c] + data[a:b] + data[c:]))


def numbered(data: bytes, dice: Dice) -> bytes:
    """An absurd number over what is there, mostly where numbers lie in CDR."""
    out = bytearray(data)
    for _ in range(dice.choice((1, 1, 3, 20))):
        size = dice.choice((4, 8, 8))
        if len(out) < size + 8:
            return bytes(out)
        at = dice.randrange(len(out) - size)
        if dice.random() < 0.7:
            at -= (at - 4) % 4
        if dice.random() < 0.5:
            word = struct.pack("<d" if size == 8 else "<f", _fit(dice.choice(_FLOATS), size))
        else:
            word = struct.pack("<Q", dice.choice(_INTS))[:size]
        out[max(at, 0) : max(at, 0) + size] = word
    return bytes(out)


def _fit(value: float, size: int) -> float:
    return value if size == 8 or abs(value) < 3e38 or abs(value) == float("inf") or value != value else 3e38


BYTES: tuple[Callable[[bytes, Dice], bytes], ...] = (flipped, overwritten, cut, spliced, numbered)


# ------------------------------------------------------------------------------- messages


def varint(number: int) -> bytes:
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])


def protobuf_hit(data: bytes, dice: Dice, depth: int = 0) -> bytes:
    """One field of a protobuf message with another value, going down into what looks like a message."""
    fields, at = [], 0
    try:
        while at < len(data):
            begin = at
            tag, at = _varint_at(data, at)
            kind, body = tag & 7, at
            if kind == 0:
                _, at = _varint_at(data, at)
            elif kind == 1:
                at += 8
            elif kind == 5:
                at += 4
            elif kind == 2:
                length, body = _varint_at(data, at)
                at = body + length
            else:
                return flipped(data, dice)
            if at > len(data):
                return flipped(data, dice)
            fields.append((begin, tag, body, at))
    except IndexError:
        return flipped(data, dice)
    if not fields:
        return data + dice.choice((b"\x0b" * 500, b"\x08\xff", b""))
    begin, tag, body, end = dice.choice(fields)
    kind = tag & 7
    new = data[body:end]
    if kind == 0:
        new = varint(dice.choice(_INTS))
    elif kind == 1:
        new = struct.pack("<d", dice.choice(_FLOATS))
    elif kind == 5:
        new = struct.pack("<f", _fit(dice.choice(_FLOATS), 4))
    elif depth < 6 and dice.random() < 0.85:
        inner = protobuf_hit(data[body:end], dice, depth + 1)
        new = varint(len(inner)) + inner
    else:
        new = dice.choice((varint(dice.choice(_INTS)), varint(0), varint(end - body) + dice.randbytes(end - body)))
    if dice.random() < 0.1:
        return data[:begin] + data[end:]
    return data[:begin] + varint(tag) + new + data[end:]


def _varint_at(data: bytes, at: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte = data[at]
        number |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128 or shift > 63:
            return number, at


_JSON = (
    "NaN", "Infinity", "-Infinity", "1e400", "-1", "1e308", "1" + "0" * 400, "1" + "0" * 5000, "null", "true", '"x"',
    '""',
    '"\\ud800"', '"a\\nb"', '"1e999"', "[]", "{}", "[[1]]", '{"x": {}}', "9223372036854775808", "-9223372036854775809",
    "18446744073709551616", '"' + "y" * 9000 + '"', "1.5", "0",
)  # fmt: skip


def json_hit(data: bytes, dice: Dice) -> bytes:
    """Values of a JSON message replaced, names left out."""
    said = data.decode(errors="replace")
    for _ in range(dice.choice((1, 1, 3))):
        places = list(re.finditer(r'-?\d+(\.\d+)?|"[^"]*"', said))
        if places:
            place = dice.choice(places)
            said = said[: place.start()] + dice.choice(_JSON) + said[place.end() :]
    return said.encode(errors="replace")


def nested(encoding: bytes, dice: Dice) -> bytes:
    depth = dice.choice((50, 120, 1000, 100_000))
    if encoding == b"json":
        opened, closed = dice.choice(((b"[", b"]"), (b'{"entities":', b"}"), (b'{"entities":[', b"]}")))
        return opened * depth + dice.choice((b"1", b"", b"{}")) + (closed * depth if dice.random() < 0.7 else b"")
    if encoding == b"protobuf":
        if dice.random() < 0.5:
            return b"\x0b" * depth + (b"\x0c" * depth if dice.random() < 0.7 else b"")
        data = b""
        for _ in range(min(depth, 3000)):
            data = b"\x0a" + varint(len(data)) + data
        return data
    return b"\0\1\0\0" + dice.choice((b"\xff", b"\1\0\0\0", b"\0")) * depth


def message_hit(message: Message, sample: Sample, dice: Dice) -> None:
    encoding = sample.encoding(message)
    pick = dice.random()
    if pick < 0.1:
        message.log_time = dice.choice(_INTS)
    elif pick < 0.15:
        message.channel = dice.choice((0, 1, 2, 3, 65535))
    elif pick < 0.2:
        message.data = nested(encoding, dice)
    elif encoding == b"protobuf" and pick < 0.75:
        for _ in range(dice.choice((1, 2, 8))):
            message.data = protobuf_hit(message.data, dice)
    elif encoding == b"json" and pick < 0.75:
        message.data = json_hit(message.data, dice)
    else:
        message.data = dice.choice(BYTES)(message.data, dice)


# ------------------------------------------------------------------------------- records


def _messages(model: Model, sample: Sample, dice: Dice) -> None:
    all_of_them = [m for p in model.pieces for m in p.records if isinstance(m, Message)]
    if all_of_them:
        share = dice.choice((1, 1, 3, len(all_of_them)))
        for message in dice.sample(all_of_them, min(share, len(all_of_them))):
            message_hit(message, sample, dice)


def _schema(model: Model, sample: Sample, dice: Dice) -> None:
    """A schema, in all chunks, that says something else."""
    schemas = [s for p in model.pieces for s in p.records if isinstance(s, Schema)]
    if not schemas:
        return
    chosen = dice.choice(schemas).id
    other = dice.choice(sample.schemas)
    what, seed = dice.randrange(6), dice.random()
    for schema in schemas:
        inner = Dice(seed)
        if schema.id != chosen:
            continue
        if what == 0:
            schema.data = other.data
        elif what == 1:
            schema.name = inner.choice(_SCHEMAS + _NAMES)
        elif what == 2:
            schema.encoding = inner.choice(_ENCODINGS)
        elif what == 3:
            schema.data = inner.choice(BYTES)(schema.data, inner)
        elif what == 4:
            schema.data = inner.choice(DEFINITIONS)
        else:
            schema.data = protobuf_hit(schema.data, inner)


def _channel(model: Model, sample: Sample, dice: Dice) -> None:
    channels = [c for p in model.pieces for c in p.records if isinstance(c, Channel)]
    if not channels:
        return
    chosen, what, seed = dice.choice(channels).id, dice.randrange(4), dice.random()
    for channel in channels:
        inner = Dice(seed)
        if channel.id != chosen:
            continue
        if what == 0:
            channel.schema = inner.choice((0, 1, 2, 3, 65535))
        elif what == 1:
            channel.encoding = inner.choice(_ENCODINGS)
        elif what == 2:
            channel.topic = inner.choice((*_NAMES, b"/tf_static", b"copem/x/objects", *(c.topic for c in channels)))
        else:
            channel.id = inner.choice((0, 1, 2, 65535))


def _order(model: Model, sample: Sample, dice: Dice) -> None:
    """Chunks and records swapped, doubled, left out."""
    where = model.pieces if dice.random() < 0.4 else dice.choice(model.pieces).records
    for _ in range(dice.choice((1, 3))):
        if not where:
            return
        a, b = dice.randrange(len(where)), dice.randrange(len(where))
        pick = dice.randrange(3)
        if pick == 0:
            where[a], where[b] = where[b], where[a]
        elif pick == 1:
            where.insert(b, where[a])
        else:
            del where[a]


def _lengths(model: Model, sample: Sample, dice: Dice) -> None:
    """Records in a chunk whose lengths, or opcodes, lie."""
    records = dice.choice(model.pieces).records
    if not records:
        return
    at = dice.randrange(len(records))
    item = records[at]
    if isinstance(item, Raw):
        return
    opcode = 3 if isinstance(item, Schema) else 4 if isinstance(item, Channel) else 5
    body = item.body()
    pick = dice.random()
    if pick < 0.4:
        records[at] = Raw(opcode, body, dice.choice(_INTS))
    elif pick < 0.6:
        records[at] = Raw(dice.choice((0, 1, 2, 6, 7, 15, 16, 127, 128, 255)), body, len(body))
    else:
        body = dice.choice((overwritten, numbered, cut))(body[:60], dice) + body[60:]
        records[at] = Raw(opcode, body, len(body))


def _counts(model: Model, sample: Sample, dice: Dice) -> None:
    """A sound index that lies."""
    model.indexed = True
    pick = dice.randrange(3)
    if pick == 0 and sample.channels:
        model.counts[dice.choice(sample.channels).id] = dice.choice(_INTS)
    elif pick == 1:
        model.offsets[dice.randrange(len(model.pieces))] = dice.choice((*_INTS, 8, 100))
    else:
        model.start_times[dice.randrange(len(model.pieces))] = dice.choice(_INTS)


def _chunk_head(model: Model, sample: Sample, dice: Dice) -> None:
    piece = dice.choice(model.pieces)
    pick = dice.randrange(5)
    if pick == 0:
        piece.claimed = dice.choice(_INTS)
    elif pick == 1:
        piece.length = dice.choice(_INTS)
    elif pick == 2:
        piece.compression = dice.choice(("zstd", "lz4", "", "bz2", "z\nstd"))
        piece.content = dice.randbytes(dice.choice((0, 4, 100)))
    elif pick == 3:
        piece.checksum = 0
        piece.content = dice.choice(BYTES)(compressed(dice.randbytes(200) * 20, piece.compression), dice)
    else:
        piece.checksum = dice.choice((0, 1))


_BOMBS: dict[tuple[str, int, bytes], tuple[bytes, int]] = {}


def bomb(compression: str, size: int, unit: bytes) -> tuple[bytes, int]:
    """`size` bytes of repeated `unit`, compressed without ever being there; and their checksum."""
    import lz4.frame
    import zstandard

    key = (compression, size, unit)
    if key not in _BOMBS:
        block = unit * max(1, (1 << 22) // len(unit))
        out, checksum = bytearray(), 0
        if compression == "zstd":
            stream = zstandard.ZstdCompressor(level=1).compressobj()
            pack = stream.compress
            last = stream.flush
        else:
            stream4 = lz4.frame.LZ4FrameCompressor()
            out += stream4.begin()
            pack, last = stream4.compress, stream4.flush
        for _ in range(max(1, size // len(block))):
            out += pack(block)
            checksum = zlib.crc32(block, checksum)
        _BOMBS[key] = bytes(out + last()), checksum
    return _BOMBS[key]


def _bomb(model: Model, sample: Sample, dice: Dice) -> None:
    piece = dice.choice(model.pieces)
    piece.compression = dice.choice(("zstd", "lz4"))
    size = dice.choice((1 << 28, 1 << 30))
    message = record(5, Message(1, 0, 0, 0, b"").body())
    unit = dice.choice((b"\0", record(0x80, b""), message, record(15, bytes(4))))
    piece.content, piece.checksum = bomb(piece.compression, size, unit)
    piece.claimed = dice.choice((size, 1000, 0, 2**63))


DEFINITIONS = (
    b"",
    b"\0" * 1000,
    b"((((" * 20_000,
    b"A a\n" * 5_000,
    b"visualization_msgs/Marker[] markers\n"
    + b"=" * 80
    + b"\nMSG: visualization_msgs/Marker\nvisualization_msgs/Marker m\n",
    b"float64[99999999999999999999] x\n",
    b"float64[4294967295] markers\n",
    b"\n".join(b"T%d[1000] f" % k + b"\n" + b"=" * 80 + b"\nMSG: p/T%d" % k for k in range(40)) + b"\nint8 x\n",
    b"string<=5 s\nint32 A=\nint32 B='" + b"x" * 10_000,
    b"module a { " * 3_000,
    b"<" * 50_000,
    b"# \n" * 30_000,
)


MUTATORS: tuple[tuple[Callable[[Model, Sample, Dice], None], float], ...] = (
    (_messages, 40),
    (_schema, 12),
    (_channel, 8),
    (_order, 8),
    (_lengths, 10),
    (_counts, 5),
    (_chunk_head, 6),
    (_bomb, 0.1),
)


def hostile(samples: list[Sample], seed: str, messages: tuple[int, ...] = (5, 10, 40)) -> tuple[bytes, str]:
    """The file of a seed, of so many messages, and what was done to it."""
    dice = random.Random(seed)
    sample = dice.choice(samples)
    model = model_of(sample, dice, messages)
    done = [sample.name]
    if dice.random() < 0.8:
        for _ in range(dice.choice((1, 1, 1, 2, 4))):
            if not model.pieces:
                break
            (change,) = dice.choices([m for m, _ in MUTATORS], [w for _, w in MUTATORS])
            change(model, sample, dice)
            done.append(change.__name__)
    data = model.written()
    if len(done) == 1 or dice.random() < 0.1:
        for _ in range(dice.choice((1, 1, 2))):
            change_bytes = dice.choice(BYTES)
            data = change_bytes(data, dice)
            done.append(change_bytes.__name__)
    return data, " ".join(done)


# ------------------------------------------------------------------------------- documents


_VALUES: tuple[Any, ...] = (
    None, True, False, "", "ego", "truth", "all", "none", "default", "PEM", "1", "a\nb", "\x1b[31m", "\ud800",
    "é\u2028", "x" * 5000, "..", "/", "../..", "C:\\x", "=1+1", "<b>", "nan", "os:system", "no.module:Class", [], {},
    [[]], [0], [0, 0], [1, 0], [-1, 1], {"kind": "constant"}, {"kind": "nothing"}, {"default": 0}, 0.5, 3, 1000, 1e-9,
    "gaussian", "visible_share", "tracker", "gnn", "union", "ideal", "median",
)  # fmt: skip
Place = tuple[Any, Any]
"""A container of plain data, and a key of it."""


def _places(value: Any) -> Iterator[Place]:
    for key, inner in list(value.items() if isinstance(value, dict) else enumerate(value)):
        yield value, key
        if isinstance(inner, dict | list):
            yield from _places(inner)


def tree_hit(value: Any, dice: Dice) -> Any:
    """Plain data with one place of it changed: another value, left out, doubled, put elsewhere, under another name."""
    value = copy.deepcopy(value)
    places = list(_places(value)) if isinstance(value, dict | list) else []
    if not places:
        return dice.choice(_VALUES)
    (inner, key), (other, other_key), pick = dice.choice(places), dice.choice(places), dice.random()
    numbers = [place for place in places if type(place[0][place[1]]) in (int, float)]
    if numbers and pick < 0.4:
        inner, key = dice.choice(numbers)
        inner[key] = inner[key] * dice.choice((-1, 0, 0.5, 2, 10, 1e3)) + dice.choice((0, 0, 1, -1))
    elif pick < 0.5:
        inner[key] = dice.choice((*_INTS, *_FLOATS))
    elif pick < 0.65:
        inner[key] = copy.deepcopy(dice.choice(_VALUES))
    elif pick < 0.75:
        del inner[key]
    elif pick < 0.85:
        inner[key] = copy.deepcopy(other[other_key])
    elif pick < 0.95 and isinstance(inner, dict):
        names = (*(key for _, key in places if isinstance(key, str)), f"{key}x", *map(str, _VALUES[3:24]))
        inner[dice.choice(names)] = inner.pop(key) if dice.random() < 0.7 else copy.deepcopy(inner[key])
    elif isinstance(inner, list):
        inner.insert(key, copy.deepcopy(other[other_key]))
    else:
        for _ in range(dice.choice((1, 3, 200))):
            inner[key] = [inner[key]] if dice.random() < 0.5 else {"kind": inner[key]}
    return value


def rows_hit(data: bytes, dice: Dice) -> bytes:
    """A table of CSV with a cell, a row or a column changed."""
    rows = list(csv.reader(io.StringIO(data.decode(errors="replace"))))
    if not rows or not rows[0]:
        return data + b"\x00,"
    at, column, pick = dice.randrange(len(rows)), dice.randrange(len(rows[0])), dice.random()
    if pick < 0.5:
        cells = rows[at] or [""]
        values = (*map(str, (*_INTS, *_FLOATS, *_VALUES[:24])), *dice.choice(rows))
        cells[dice.randrange(len(cells))] = dice.choice(values)
    elif pick < 0.65:
        rows = [row[:column] + row[column + 1 :] for row in rows]
    elif pick < 0.8:
        rows.insert(dice.randrange(len(rows)), list(rows[at]))
    elif pick < 0.9:
        del rows[at]
    else:
        dice.shuffle(rows[0] if dice.random() < 0.5 else rows)
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode(errors="replace")


def table_hit(table: Any, dice: Dice) -> Any:
    """An Arrow table with a column of other values, of another kind or name, or with other rows or metadata."""
    import pyarrow as pa

    if not table.num_columns or dice.random() < 0.2:
        rows = dice.choice((0, 1, table.num_rows // 2, 2 * table.num_rows))
        return table.take(
            pa.array([dice.randrange(table.num_rows) for _ in range(rows if table.num_rows else 0)], pa.int64())
        )
    k, pick = dice.randrange(table.num_columns), dice.random()
    name, column = table.field(k).name, table.column(k)
    if pick < 0.1:
        return table.remove_column(k)
    if pick < 0.2:
        names = [*table.column_names]
        names[k] = dice.choice((*table.column_names, "x", "", "a\nb"))
        return table.rename_columns(names)
    if pick < 0.3 and table.schema.metadata:
        metadata = {
            key: dice.choice((flipped, cut, json_hit))(text, dice) for key, text in table.schema.metadata.items()
        }
        return table.replace_schema_metadata(metadata)
    count = table.num_rows
    if pick < 0.5:
        kind = dice.choice((pa.string(), pa.float64(), pa.int64(), pa.bool_(), pa.null(), pa.list_(pa.int8())))
        value: Any = dice.choice((None, *([0] if pa.types.is_integer(kind) or pa.types.is_floating(kind) else [])))
        changed = pa.array([value] * count, type=kind)
    else:
        values = column.to_pylist()
        for at in dice.sample(range(count), min(count, dice.choice((1, 1, 3, count)))):
            values[at] = dice.choice(
                (None, values[dice.randrange(count)], *_FLOATS[:6], -1, 0, 1, 2**53, "", "x", "a\nb")
            )
        try:
            changed = pa.array(values, type=column.type, from_pandas=False)
        except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
            changed = pa.array([None if v is None else str(v) for v in values])
    return table.set_column(k, name, changed)


def document_hit(name: str, data: bytes, dice: Dice) -> bytes:
    """A document changed by what it is: plain data, rows, an Arrow table; or some of its bytes."""
    kind, pick = name.rpartition(".")[2], dice.random()
    if pick < 0.12:
        return dice.choice(BYTES)(data, dice)
    if pick < 0.15:
        return dice.choice((b"", b"[" * 100_000, b"\xff\xfe", b"null", b"[]", b"{}", b"0", b"\n", b"\0" * 1000))
    if kind in ("parquet", "feather"):
        return _arrow_hit(kind, data, dice)
    if kind == "csv":
        return rows_hit(data, dice)
    if kind == "json":
        value = json.loads(data)
        for _ in range(dice.choice((1, 1, 2, 4))):
            value = tree_hit(value, dice)
        return json.dumps(value).encode()
    if kind == "yaml":
        return yaml_hit(data, dice)
    if kind in ("xml", "jsonl", "txt"):
        return json_hit(data, dice)
    return dice.choice(BYTES)(data, dice)


def yaml_hit(data: bytes, dice: Dice) -> bytes:
    """An experiment with some of its places changed."""
    from copem_replay.core.yaml import parse_yaml

    value = parse_yaml(data.decode())[0]
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        value = tree_hit(value, dice)
    return json.dumps(value).replace("Infinity", ".inf").replace("NaN", ".nan").encode()


def _arrow_hit(kind: str, data: bytes, dice: Dice) -> bytes:
    from pyarrow import BufferOutputStream, BufferReader, feather, parquet

    table = parquet.read_table(BufferReader(data)) if kind == "parquet" else feather.read_table(BufferReader(data))
    out = BufferOutputStream()
    for _ in range(dice.choice((1, 1, 2))):
        table = table_hit(table, dice)
    if kind == "parquet":
        parquet.write_table(table, out)
    else:
        feather.write_feather(table, out)
    return bytes(out.getvalue())
