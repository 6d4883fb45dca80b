"""Messages encoded from columns, many at once: what they hold (`Content`), protobuf, and JSON texts.

Messages of ROS 2 are encoded from the same content in `cdr_bytes.py`. Of the others, first the sizes are computed, then
their bytes are put into one buffer. A part of a record knows its size in every row, `sizes` (N,), and puts its bytes at
the places `offset` (N,). A record is its parts one after the other. Letters: N rows, M rows of a repeated part.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol, TypeAlias

import numpy as np
import orjson
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from numpy.typing import NDArray

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.tracks import Bool, Int

# Blocks of lists.

MOST_ROWS = 5_000
"""Rows of a block, unless one list has more: some MB of records."""


def split_into_blocks(bounds: Int) -> Iterator[tuple[int, int]]:
    """The first list of each block and the one after its last; list k has rows `bounds[k]:bounds[k + 1]`."""
    first = 0
    while first < len(bounds) - 1:
        last = max(first + 1, int(np.searchsorted(bounds, bounds[first] + MOST_ROWS, side="right")) - 1)
        yield first, last
        first = last


def expand_ranges(start: Int, rows: Int) -> tuple[Int, Int]:
    """(R + 1,) begin of each row's range in the result, and the ranges `start[row]:start[row + 1]` concatenated."""
    counts = start[rows + 1] - start[rows]
    begin = np.concatenate([[0], np.cumsum(counts)])
    return begin, np.arange(begin[-1]) + np.repeat(start[rows] - begin[:-1], counts)


# Kernels that put a column's bytes to their places.


@callee
def _put_varint(out: Bytes, offset: int, value: Any) -> int:
    """Put a number in groups of seven bits; returns the place after it."""
    while value >= np.uint64(128):
        out[offset] = np.uint8(value & np.uint64(127)) | np.uint8(128)
        value >>= np.uint64(7)
        offset += 1
    out[offset] = np.uint8(value)
    return offset + 1


@kernel
def varint_sizes(values: NDArray[np.uint64]) -> Int:
    """(N,) sizes of numbers (N,) as varints, in bytes."""
    sizes = np.empty(len(values), dtype=np.int64)
    for k in range(len(values)):
        rest, size = values[k] >> np.uint64(7), 1
        while rest:
            rest >>= np.uint64(7)
            size += 1
        sizes[k] = size
    return sizes


@kernel
def put_numbers(out: Bytes, offset: Int, sizes: Int, tag: Any, bits: NDArray[np.uint64], fixed: bool) -> None:
    """Put tags and numbers at places `offset` (N,), as varints or eight bytes each, except where the size is 0."""
    for k in range(len(offset)):
        if sizes[k]:
            place = _put_varint(out, offset[k], tag)
            if fixed:
                for i in range(8):
                    out[place + i] = np.uint8(bits[k] >> np.uint64(8 * i))
            else:
                _put_varint(out, place, bits[k])


@kernel
def put_pieces(out: Bytes, offset: Int, pool: Bytes, first: Int, sizes: Int) -> None:
    """Put `pool[first[k]:first[k] + sizes[k]]` at `offset[k]`."""
    for k in range(len(offset)):
        for i in range(sizes[k]):
            out[offset[k] + i] = pool[first[k] + i]


# Parts of records.

Bytes = NDArray[np.uint8]


class RecordPart(Protocol):
    """A part of every record, in N rows."""

    @property
    def sizes(self) -> Int:
        """(N,) size in each row, in bytes."""

    def put(self, out: Bytes, offset: Int) -> None:
        """Put the bytes of every row at its place in `out`, `offset` (N,)."""


class TextPool:
    """Texts to choose from: number k is `pool[first[k]:first[k] + lengths[k]]`."""

    def __init__(self, pool: bytes, first: Int, lengths: Int) -> None:
        self.pool, self.first, self.lengths = np.frombuffer(pool, dtype=np.uint8), first, lengths

    @classmethod
    def of(cls, texts: Sequence[str | bytes]) -> TextPool:
        """A pool of these texts."""
        encoded = [text.encode() if isinstance(text, str) else text for text in texts]
        lengths = np.fromiter(map(len, encoded), dtype=np.int64, count=len(encoded))
        return cls(b"".join(encoded), np.cumsum(lengths) - lengths, lengths)

    def at(self, which: Int | Bool) -> RowTexts:
        """The part that has the text `which[n]` in row n."""
        return RowTexts(self, np.asarray(which, dtype=np.int64))

    @cached_property
    def quoted(self) -> TextPool:
        """The texts as JSON strings."""
        whole, ends = self.pool.tobytes(), (self.first + self.lengths).tolist()
        texts = [whole[begin:end].decode() for begin, end in zip(self.first.tolist(), ends, strict=True)]
        return TextPool.of([orjson.dumps(text) for text in texts])


class RowTexts:
    """A part that has a text of a pool in each row."""

    def __init__(self, source: TextPool, which: Int) -> None:
        self.source, self.which = source, which
        self.first, self.sizes = source.first[which], source.lengths[which]

    def put(self, out: Bytes, offset: Int) -> None:
        """Put the bytes of every row at its place in `out`, `offset` (N,)."""
        put_pieces(out, offset, self.source.pool, self.first, self.sizes)


def repeat_text(text: str | bytes, rows: int) -> RowTexts:
    """The part that has the same text in every row."""
    return TextPool.of([text]).at(np.zeros(rows, dtype=np.int64))


class NumberField:
    """A tag and a number, a varint or the eight bytes of a double; left out where it is 0 unless `always`."""

    def __init__(self, tag: int, values: NDArray[Any], always: bool) -> None:
        self._fixed = values.dtype.kind == "f"
        dtype = np.float64 if self._fixed else np.uint64 if values.dtype.kind == "u" else np.int64
        self._bits = np.ascontiguousarray(values, dtype=dtype).view(np.uint64)
        self._tag = np.uint64(tag)
        head = -(-tag.bit_length() // 7)
        sizes = np.full(len(values), head + 8) if self._fixed else varint_sizes(self._bits) + head
        self.sizes: Int = sizes if always else np.where(self._bits != 0, sizes, 0)

    def put(self, out: Bytes, offset: Int) -> None:
        """Put the bytes of every row at its place in `out`, `offset` (N,)."""
        put_numbers(out, offset, self.sizes, self._tag, self._bits, self._fixed)


class SizedField:
    """A tag, the size of the parts, and the parts; left out where these are empty unless `always`."""

    def __init__(self, tag: int, parts: Sequence[RecordPart], rows: int, always: bool) -> None:
        self._parts = parts
        inner = count_bytes(parts, rows)
        self._head = NumberField(tag, inner, always)
        self.sizes = self._head.sizes + inner

    def put(self, out: Bytes, offset: Int) -> None:
        """Put the bytes of every row at its place in `out`, `offset` (N,)."""
        self._head.put(out, offset)
        put_parts(self._parts, out, offset + self._head.sizes)


class RowGroups:
    """A part that has in row n the rows `start[n]:start[n + 1]` of other parts, (M,), one after the other."""

    def __init__(self, start: Int, parts: Sequence[RecordPart]) -> None:
        self._start, self._parts = start, parts
        self._before: Int = np.concatenate([[0], np.cumsum(count_bytes(parts, int(start[-1])))])

    @cached_property
    def sizes(self) -> Int:
        """(N,) size in each row, in bytes."""
        return np.diff(self._before[self._start])

    def put(self, out: Bytes, offset: Int) -> None:
        """Put the bytes of every row at its place in `out`, `offset` (N,)."""
        shift = offset - self._before[self._start[:-1]]
        put_parts(self._parts, out, np.repeat(shift, np.diff(self._start)) + self._before[:-1])


def start_offsets(counts: Int | Bool) -> Int:
    """(N + 1,) the first row of each of N groups of so many rows, and the end of the last."""
    result: Int = np.concatenate([[0], np.cumsum(counts)])
    return result


def count_bytes(parts: Sequence[RecordPart], rows: int) -> Int:
    """(N,) sizes of all parts together, in bytes."""
    result = np.zeros(rows, dtype=np.int64)
    for part in parts:
        result += part.sizes
    return result


def put_parts(parts: Sequence[RecordPart], out: Bytes, offset: Int) -> None:
    """Put the parts one after the other, from `offset` (N,) on."""
    for part in parts:
        part.put(out, offset)
        offset = offset + part.sizes


def encode_records(parts: Sequence[RecordPart], rows: int) -> list[bytes]:
    """The bytes of every row."""
    bounds = start_offsets(count_bytes(parts, rows))
    out = np.empty(bounds[-1], dtype=np.uint8)
    put_parts(parts, out, bounds[:-1])
    whole, cuts = out.tobytes(), bounds.tolist()
    return [whole[first:last] for first, last in pairwise(cuts)]


# What messages hold, in any encoding.


@dataclass(frozen=True)
class Instants:
    """Times of any clock (N,), in ns."""

    time_ns: Int


class MessagePool:
    """Groups of messages to choose from: group k has the rows `start[k]:start[k + 1]` of `content`."""

    def __init__(self, start: Int, content: Content) -> None:
        self.start, self.content = start, content
        self._encoded: dict[str, TextPool] = {}

    def at(self, which: Int) -> RepeatedMessages:
        """The messages of a repeated field: in row n those of the group `which[n]`."""
        return RepeatedMessages(self.start, self.content, which, self)

    def encode(self, field: FieldDescriptor) -> TextPool:
        """Each group as a repeated field of protobuf, encoded once."""
        if field.full_name not in self._encoded:
            whole = RepeatedMessages(self.start, self.content)
            texts = encode_records([_encode_field(field, whole, len(self.start) - 1)], len(self.start) - 1)
            self._encoded[field.full_name] = TextPool.of(texts)
        return self._encoded[field.full_name]


@dataclass(frozen=True)
class RepeatedMessages:
    """A repeated field: in row n the rows `start[n]:start[n + 1]` of its content, or of the pool's `which[n]`."""

    start: Int
    content: Any  # that of messages, or times; in JSON any value
    which: Int | None = None
    pool: MessagePool | None = None


Content: TypeAlias = Mapping[str, "float | NDArray[Any] | RowTexts | Instants | Content | RepeatedMessages"]
"""Values by field: numbers (N,) or one for all, of an array of K numbers (N, K), texts, times, the content of a
message, the messages of a repeated field. A field that is left out has its default in all rows."""


def optional_message(is_stated: Bool, content: Content | Instants) -> RepeatedMessages:
    """A message in the rows `is_stated` (N,) only; `content` has these rows alone."""
    return RepeatedMessages(start_offsets(is_stated), content)


# Protobuf messages, with the bytes of `SerializeToString(deterministic=True)`.

_VARINT, _FIXED64, _SIZED = 0, 1, 2  # wire types


def encode_messages(descriptor: Descriptor, content: Content, rows: int) -> list[bytes]:
    """One encoded message for each row."""
    return encode_records(_encode_fields(descriptor, content, rows), rows)


def _encode_fields(descriptor: Descriptor, content: Content | Instants, rows: int) -> list[RecordPart]:
    """The parts of a message: its fields in the order of their numbers; without repeated ones that no row has."""
    if isinstance(content, Instants):
        content = dict(zip(("seconds", "nanos"), np.divmod(content.time_ns, 1_000_000_000), strict=True))
    present = {
        name: value for name, value in content.items() if not isinstance(value, RepeatedMessages) or value.start[-1]
    }
    fields = sorted((descriptor.fields_by_name[name] for name in present), key=lambda field: field.number)
    return [_encode_field(field, present[field.name], rows) for field in fields]


def _is_constant(value: Any) -> bool:
    """Whether a value is the same in all rows."""
    return all(map(_is_constant, value.values())) if isinstance(value, Mapping) else isinstance(value, int | float)


def _encode_field(field: FieldDescriptor, value: Any, rows: int) -> RecordPart:
    """The bytes of one field of protobuf for each of `rows` messages; `value`: a constant, a column or content."""
    if rows != 1 and _is_constant(value):
        return repeat_text(encode_records([_encode_field(field, value, 1)], 1)[0], rows)
    number = field.number << 3
    if isinstance(value, RepeatedMessages):
        if value.pool is not None and value.which is not None:
            return value.pool.encode(field).at(value.which)
        inside = int(value.start[-1])
        parts = _encode_fields(field.message_type, value.content, inside)
        return RowGroups(value.start, [SizedField(number | _SIZED, parts, inside, always=True)])
    if isinstance(value, Mapping | Instants):
        return SizedField(number | _SIZED, _encode_fields(field.message_type, value, rows), rows, always=True)
    if isinstance(value, RowTexts):
        return SizedField(number | _SIZED, [value], rows, always=field.has_presence)
    wire, dtype = (_FIXED64, np.float64) if field.type == field.TYPE_DOUBLE else (_VARINT, np.int64)
    column = value if isinstance(value, np.ndarray) else np.full(rows, value, dtype=dtype)
    return NumberField(number | wire, column, always=field.has_presence)


# JSON, as orjson writes it.

_COMMA, _NULL = TextPool.of([b",", b""]), TextPool.of([b"null", b""])


@dataclass(frozen=True)
class StatedRows:
    """A value in the rows `said` (N,) only, `values` of these rows alone; the others have null, or nothing."""

    said: Bool
    values: NDArray[Any] | RowTexts
    null: bool = True


JsonContent: TypeAlias = Mapping[str, Any]
"""Values by name, in this order: those of `Content` but for times, `StatedRows`, and None, which is null."""


def encode_json(content: JsonContent, rows: int) -> list[bytes]:
    """One encoded object for each row."""
    return encode_records(_encode_value(content, rows), rows)


def _encode_value(value: Any, rows: int) -> list[RecordPart]:
    """The texts of which the JSON of a value is made, for each of `rows` messages."""
    if value is None:
        return [repeat_text(b"null", rows)]
    if isinstance(value, RowTexts):
        return [value.source.quoted.at(value.which)]
    if isinstance(value, StatedRows):
        start = start_offsets(value.said)
        return [RowGroups(start, _encode_value(value.values, int(start[-1]))), _NULL.at(value.said)]
    if isinstance(value, RepeatedMessages):
        return _encode_arrays(value.start, _encode_value(value.content, int(value.start[-1])))
    if isinstance(value, Mapping):
        parts: list[RecordPart] = []
        for name, inner_value in value.items():
            key = b"%s%s:" % (b"," if parts else b"{", orjson.dumps(name))
            if isinstance(inner_value, StatedRows) and not inner_value.null:
                stated_count = int(inner_value.said.sum())
                field = [repeat_text(key, stated_count), *_encode_value(inner_value.values, stated_count)]
                parts.append(RowGroups(start_offsets(inner_value.said), field))
            else:
                parts += [repeat_text(key, rows), *_encode_value(inner_value, rows)]
        return [*parts, repeat_text(b"}", rows)]
    return [_encode_numbers(value, rows)]


def _encode_numbers(values: NDArray[Any], rows: int) -> RowTexts:
    """The part of numbers (N,); null where one is not finite."""
    text = orjson.dumps(np.ascontiguousarray(values), option=orjson.OPT_SERIALIZE_NUMPY)
    commas = np.flatnonzero(np.frombuffer(text, dtype=np.uint8) == ord(","))
    first = np.concatenate([[1], commas + 1])[:rows]
    return TextPool(text, first, np.append(commas, len(text) - 1)[:rows] - first).at(np.arange(rows))


def _encode_arrays(start: Int, parts: Sequence[RecordPart]) -> list[RecordPart]:
    """The parts of arrays: array n has as items the rows `start[n]:start[n + 1]` of `parts`."""
    rows, first = len(start) - 1, np.zeros(start[-1] + 1, dtype=bool)
    first[start[:-1]] = True
    return [repeat_text(b"[", rows), RowGroups(start, [_COMMA.at(first[:-1]), *parts]), repeat_text(b"]", rows)]
