"""Protobuf messages of any schema decoded into columns, by the descriptors inside the recording.

Google's parser decides what is a message and brings it into canonical form: every field as its schema has it, fields
that are not repeated once. Then one compiled walk, the kernel, takes the fields that are asked for by a table made from
the schema. It takes the bits of numbers and the places of texts, stays within the message whatever its bytes are, and
stops at bytes that are no message. Wire format: protobuf.dev/programming-guides/encoding.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, EncodeError
from numpy.typing import NDArray

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.tracks import Bool, Int
from copem_replay.io.channel import DefinitionError
from copem_replay.io.decoded_size import MESSAGE_LIMIT_BYTES, check_decoded_bytes
from copem_replay.io.encodings.columns import (
    Definition,
    ShreddedMessages,
    ValueKind,
    list_level,
    list_levels,
    split_batches,
    walk_columns,
)

# The kernel.

VARINT, FIXED64, BYTES, GROUP, END_GROUP, FIXED32 = range(6)
"""Wire types."""
MESSAGE = 6
"""Besides the wire types, in the table of fields: bytes that are a message to step into, as groups are."""
NUMBER, WHAT, COLUMN, LEVEL, INTO = range(5)
"""Columns of the table of fields: the field's number, its wire type or MESSAGE, its column or −1, the level of a
repeated field or −1, the kind of message inside or −1."""
DEEPEST = 32
"""Messages within messages, at most; no path leads deeper."""


@callee
def _read_varint(data: NDArray[np.uint8], offset: Any, end: Any) -> tuple[np.uint64, Any]:
    """A varint and the offset after it; an offset beyond `end` says that the number does not end before."""
    value, shift = np.uint64(0), 0
    while offset < end and shift < 70:
        byte = data[offset]
        value |= np.uint64(byte & 127) << np.uint64(shift)
        offset += 1
        shift += 7
        if byte < 128:
            return value, offset
    return value, end + 1


@callee
def _read_fixed(data: NDArray[np.uint8], offset: Any, size: Any) -> np.uint64:
    value = np.uint64(0)
    for k in range(size):
        value |= np.uint64(data[offset + k]) << np.uint64(8 * k)
    return value


@callee
def _skip_value(data: NDArray[np.uint8], offset: Any, end: Any, wire: Any) -> Any:
    """The offset after a value (of a group: of its end tag); beyond `end`: the value does not end before."""
    if wire == VARINT:
        return _read_varint(data, offset, end)[1]
    if wire == FIXED64:
        return offset + 8
    if wire == FIXED32:
        return offset + 4
    if wire == BYTES:
        size, offset = _read_varint(data, offset, end)
        return end + 1 if offset > end or size > np.uint64(end - offset) else offset + np.int64(size)
    group_depth = 1
    while offset < end:
        tag_offset = offset
        tag, offset = _read_varint(data, offset, end)
        inner = np.int64(tag & np.uint64(7))
        if inner == GROUP:
            group_depth += 1
        elif inner == END_GROUP:
            group_depth -= 1
            if group_depth == 0:
                return tag_offset
        elif inner > FIXED32:
            return end + 1
        else:
            offset = _skip_plain_value(data, offset, end, inner)
    return end + 1


@callee
def _skip_plain_value(data: NDArray[np.uint8], offset: Any, end: Any, wire: Any) -> Any:
    """The end of a value other than a group that begins at `offset`; beyond `end`: it has no end."""
    value, after = _read_varint(data, offset, end)
    if wire == VARINT:
        return after
    if wire == BYTES:
        return end + 1 if after > end or value > np.uint64(end - after) else after + np.int64(value)
    return offset + (8 if wire == FIXED64 else 4)


@kernel
def walk_protobuf(
    data: NDArray[np.uint8], bounds: Int, fields: Int, node_first: Int, node_level: Int, blank: Int, blank_first: Int,
    first: Int, room: Int, bits: Any, lengths: Int, is_present: Bool, parent: Int,
) -> Int:  # fmt: skip
    """As `Walk`. A message of kind n has `fields[node_first[n]:node_first[n + 1]]` and is of level `node_level[n]`.

    Where it is present, its columns `blank[blank_first[n]:blank_first[n + 1]]` are 0 or empty, as all are before,
    unless it states another value.
    """
    rows = np.zeros(len(room), dtype=np.int64)
    ends = np.zeros(DEEPEST, dtype=np.int64)
    nodes = np.zeros(DEEPEST, dtype=np.int64)
    for m in range(len(bounds) - 1):
        if rows[0] < room[0]:
            parent[0, rows[0]] = m
        rows[0] += 1
        offset, depth, entered = bounds[m], 0, True
        ends[0], nodes[0] = bounds[m + 1], 0
        while depth >= 0:
            node, end = nodes[depth], ends[depth]
            if entered:
                entered = False
                row = rows[node_level[node]] - 1
                if row < room[node_level[node]]:
                    for k in range(blank_first[node], blank_first[node + 1]):
                        is_present[first[blank[k]] + row] = True
            if offset >= end:
                offset, depth = end, depth - 1
                continue
            tag, offset = _read_varint(data, offset, end)
            wire, number = np.int64(tag & np.uint64(7)), np.int64(tag >> np.uint64(3))
            if offset > end or wire > FIXED32:
                break
            if wire == END_GROUP:  # of the one that was stepped into
                continue
            begin = offset
            if wire == BYTES:
                size, begin = _read_varint(data, offset, end)
                after = end + 1 if begin > end or size > np.uint64(end - begin) else begin + np.int64(size)
            elif wire == FIXED64:
                after = offset + 8
            else:
                after = _skip_value(data, offset, end, wire)
            if after > end:
                break
            field = -1
            for k in range(node_first[node], node_first[node + 1]):
                if fields[k, NUMBER] == number:
                    field = k
                    break
            if field < 0:
                offset = after
                continue
            kind, column, level, inner_node = fields[field, 1], fields[field, 2], fields[field, 3], fields[field, 4]
            if kind in (MESSAGE, GROUP):
                if wire != (GROUP if kind == GROUP else BYTES) or depth + 1 == DEEPEST:
                    offset = after
                    continue
                if level >= 0:
                    if rows[level] < room[level]:
                        parent[level, rows[level]] = rows[node_level[node]] - 1
                    rows[level] += 1
                depth += 1
                ends[depth], nodes[depth], offset, entered = after, inner_node, begin, True
                continue
            if kind == wire or (wire == BYTES and level >= 0):  # one value, or many in one
                while True:
                    value, next_at = np.uint64(begin), after
                    if kind == VARINT:
                        value, next_at = _read_varint(data, begin, after)
                    elif kind != BYTES:
                        next_at = begin + (8 if kind == FIXED64 else 4)
                    if next_at > after or (wire != kind and begin == after):
                        break
                    if kind == FIXED64:
                        value = _read_fixed(data, begin, 8)
                    elif kind == FIXED32:
                        value = _read_fixed(data, begin, 4)
                    row_level = node_level[node]
                    if level >= 0:
                        row_level = level
                        if rows[level] < room[level]:
                            parent[level, rows[level]] = rows[node_level[node]] - 1
                        rows[level] += 1
                    if rows[row_level] - 1 < room[row_level]:
                        place = first[column] + rows[row_level] - 1
                        bits[place], is_present[place] = value, True
                        if kind == BYTES:
                            lengths[place] = after - begin
                    begin = next_at
                    if begin >= after:
                        break
            offset = after
    return rows


_PARSED_DEEPEST = 100
"""Messages within messages that Google's parser takes."""


@kernel
def estimate_decoded_bytes(data: NDArray[np.uint8], fields: Int, first: Int, sizes: Int, limit: int) -> Any:
    """Memory that a message takes once parsed, from above; beyond `limit` it is not counted on.

    Type n has the rows `fields[first[n]:first[n + 1]]`, by number: the field's number, what it is (0 a message of the
    type in the third column, 1 a text, 2 a number), and takes `sizes[n]` itself. The message is of type 0.
    """
    ends = np.zeros(_PARSED_DEEPEST, dtype=np.int64)
    types = np.zeros(_PARSED_DEEPEST, dtype=np.int64)
    total = len(data) + sizes[0]
    offset, depth = 0, 0
    ends[0] = len(data)
    while depth >= 0 and total <= limit:
        end = ends[depth]
        if offset >= end:
            offset, depth = end, depth - 1
            continue
        tag, offset = _read_varint(data, offset, end)
        wire, number = np.int64(tag & np.uint64(7)), np.int64(tag >> np.uint64(3))
        if offset > end or wire > FIXED32:
            break
        if wire == END_GROUP:
            continue
        after = _skip_value(data, offset, end, wire)
        if after > end:
            break
        begin = _read_varint(data, offset, end)[1] if wire == BYTES else offset
        low, high = first[types[depth]], first[types[depth] + 1]
        while low < high:
            middle = (low + high) // 2
            if fields[middle, 0] < number:
                low = middle + 1
            else:
                high = middle
        if low == first[types[depth] + 1] or fields[low, 0] != number:
            total += 32  # kept as it is
        elif fields[low, 1] == 0 and wire in (BYTES, GROUP) and depth + 1 < _PARSED_DEEPEST:
            depth += 1
            ends[depth], types[depth], offset = after, fields[low, 2], begin
            total += sizes[types[depth]]
            continue
        elif fields[low, 1] == 1:
            total += 24
        else:
            total += 8 * max(after - begin, 1) if wire == BYTES else 8  # many in one: a byte may be a number
        offset = after
    return total


# What messages take, by the descriptors of their types.

_MESSAGE_BYTES, _FIELD_BYTES = 40, 8
"""Memory of a message inside another, and of each field that its type has, whether it is set or not (upb, Google's
parser): measured are 115 bytes for an empty osi3.MovingObject, for which this gives 144."""


class ProtobufSize:
    """The memory that messages of a type take, from above; by its descriptor."""

    def __init__(self, descriptor: Any) -> None:
        number_of = {descriptor.full_name: 0}
        descriptors, fields, first, sizes = [descriptor], list[tuple[int, int, int]](), [0], []
        for message in descriptors:  # it grows
            for field in sorted(message.fields, key=lambda field: field.number):
                inner = field.message_type
                if inner is not None and inner.full_name not in number_of:
                    number_of[inner.full_name] = len(descriptors)
                    descriptors.append(inner)
                kind = _INSIDE if inner is not None else _TEXT if field.type in _TEXT_TYPES else _NUMBER
                fields.append((field.number, kind, number_of[inner.full_name] if inner is not None else -1))
            first.append(len(fields))
            sizes.append(_MESSAGE_BYTES + _FIELD_BYTES * len(message.fields))
        self._fields: Int = np.array(fields, dtype=np.int64).reshape(-1, 3)
        self._first: Int = np.array(first, dtype=np.int64)
        self._sizes: Int = np.array(sizes, dtype=np.int64)
        self._growth = max(20, max(sizes) // 2 + 1)  # by a byte: an empty message inside another is two

    def check(self, payload: bytes) -> None:
        """Raises OversizeError where a message would take too much memory."""
        if len(payload) * self._growth <= MESSAGE_LIMIT_BYTES:
            return
        data = np.frombuffer(payload, dtype=np.uint8)
        check_decoded_bytes(estimate_decoded_bytes(data, self._fields, self._first, self._sizes, MESSAGE_LIMIT_BYTES))


_INSIDE, _TEXT, _NUMBER = range(3)
_TEXT_TYPES = (9, 12)  # FieldDescriptor.TYPE_STRING, TYPE_BYTES


# Definitions and decoding.

_DEEPEST = 12
"""Levels of messages within messages that are offered: definitions may refer to themselves."""
_MOST_FIELDS = 20_000
"""Most fields that are offered of a message: a definition that refers to itself has no end of them."""
_TYPES = {
    FieldDescriptor.TYPE_DOUBLE: (FIXED64, "f8"),
    FieldDescriptor.TYPE_FIXED64: (FIXED64, "u8"),
    FieldDescriptor.TYPE_SFIXED64: (FIXED64, "i8"),
    FieldDescriptor.TYPE_FLOAT: (FIXED32, "f4"),
    FieldDescriptor.TYPE_FIXED32: (FIXED32, "u4"),
    FieldDescriptor.TYPE_SFIXED32: (FIXED32, "i4"),
    FieldDescriptor.TYPE_INT64: (VARINT, "i8"),
    FieldDescriptor.TYPE_UINT64: (VARINT, "u8"),
    FieldDescriptor.TYPE_SINT64: (VARINT, "zigzag"),
    FieldDescriptor.TYPE_INT32: (VARINT, "i4"),
    FieldDescriptor.TYPE_UINT32: (VARINT, "u4"),
    FieldDescriptor.TYPE_SINT32: (VARINT, "zigzag"),
    FieldDescriptor.TYPE_ENUM: (VARINT, "i4"),
    FieldDescriptor.TYPE_BOOL: (VARINT, "bool"),
    FieldDescriptor.TYPE_STRING: (BYTES, "text"),
    FieldDescriptor.TYPE_BYTES: (BYTES, "bytes"),
}
"""The wire type of each type of field, and its `ValueKind.how`."""


class ProtobufDefinition(Definition):
    """The definition of a protobuf channel's messages. Raises DefinitionError."""

    def __init__(self, name: str, schema: Any) -> None:
        from mcap_protobuf.decoder import DecoderFactory

        super().__init__()
        try:
            decoder = DecoderFactory().decoder_for("protobuf", schema)
            if decoder is None:
                raise DefinitionError(f"the definition of {name} is not one of protobuf")
            empty = decoder(b"")
        except DefinitionError:
            raise
        except Exception as error:  # whatever descriptors that are none raise
            why = " ".join(str(error).split())[:200]
            raise DefinitionError(f"the definition of {name} cannot be used: {why}") from None
        self._parse = type(empty).FromString
        self._root = empty.DESCRIPTOR
        self._size = ProtobufSize(empty.DESCRIPTOR)
        self._names: dict[str, Mapping[int, str]] = {}
        self._explore(empty.DESCRIPTOR)

    def names(self, path: str) -> Mapping[int, str]:
        """The names of an enumeration by their numbers; empty for any other field."""
        return self._names.get(path, {})

    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> ShreddedMessages:
        """The columns of messages. Raises KeyError: a path is not offered; OversizeError."""
        numbers, texts = tuple(numbers), tuple(texts)
        table = _FieldTable(self._root, self._known((*numbers, *texts)))

        def canonical() -> Iterator[tuple[Int, list[bytes]]]:
            for batch in split_batches(payloads):
                canonical_payloads = [self._canonical(payload, table.closed) for payload in payloads[batch]]
                decoded_numbers = batch.start + np.flatnonzero([p is not None for p in canonical_payloads])
                yield decoded_numbers, [p for p in canonical_payloads if p is not None]

        return walk_columns(table.walk, canonical(), table.kinds, numbers, texts, len(payloads))

    def _canonical(self, payload: bytes, closed: bool) -> bytes | None:
        """The message with every known field once; None: no message. Raises OversizeError."""
        self._size.check(payload)
        try:
            message = self._parse(payload)
            if closed:
                message.DiscardUnknownFields()
            written: bytes = message.SerializePartialToString()
        except (DecodeError, EncodeError, RecursionError, ValueError):
            return None
        return written

    def _explore(self, root: Any) -> None:
        """Add all leaves to the offered paths, outer messages first: definitions may refer to themselves."""
        level = [(root, "")]
        for _ in range(_DEEPEST):
            inner = []
            for descriptor, path in level:
                for field in descriptor.fields:
                    leaf = (f"{path}.{field.name}" if path else field.name) + ("[]" if field.is_repeated else "")
                    if field.message_type is None:
                        self._offers[leaf] = "number" if _TYPES[field.type][0] != BYTES else "text"
                        if field.enum_type is not None:
                            self._names[leaf] = _enum_names(field)
                    elif not field.message_type.GetOptions().map_entry:
                        inner.append((field.message_type, leaf))
                if len(self._offers) + len(inner) > _MOST_FIELDS:
                    return
            level = inner


class _FieldTable:
    """The fields that lead to `wanted` paths, for the walk, by the kind of message they are in.

    `closed`: whether a column is of an enumeration of which Google's parser takes other numbers as unknown fields,
    which may hide one that is known.
    """

    def __init__(self, root: Any, paths: Sequence[str]) -> None:
        self.kinds: dict[str, ValueKind] = {}
        self.closed = False
        levels = list_levels(paths)
        nodes: list[tuple[Any, str]] = [(root, "")]
        node_of = {"": 0}
        fields: list[list[list[int]]] = [[]]
        blank: list[list[int]] = [[]]
        for column, path in enumerate(paths):
            node, reached = 0, ""
            for part in path.split("."):
                reached = f"{reached}.{part}" if reached else part
                field = nodes[node][0].fields_by_name[part.removesuffix("[]")]
                level = levels.index(reached) if field.is_repeated else -1
                if field.message_type is None:
                    fields[node].append([field.number, _TYPES[field.type][0], column, level, -1])
                    if not field.is_repeated and not field.has_presence:
                        blank[node].append(column)
                    continue
                if reached not in node_of:
                    kind = GROUP if field.type == FieldDescriptor.TYPE_GROUP else MESSAGE
                    node_of[reached] = len(nodes)
                    fields[node].append([field.number, kind, -1, level, len(nodes)])
                    nodes.append((field.message_type, reached))
                    fields.append([])
                    blank.append([])
                node = node_of[reached]
            self.kinds[path] = ValueKind(_TYPES[field.type][1], _enum_names(field) if field.enum_type else {})
            self.closed |= field.enum_type is not None and field.enum_type.is_closed
        self.fields = np.array([row for rows in fields for row in rows], dtype=np.int64).reshape(-1, 5)
        self.node_first = np.cumsum([0, *map(len, fields)], dtype=np.int64)
        self.node_level = np.array([levels.index(list_level(path)) for _, path in nodes], dtype=np.int64)
        self.blank = np.array([column for columns in blank for column in columns], dtype=np.int64)
        self.blank_first = np.cumsum([0, *map(len, blank)], dtype=np.int64)

    def walk(
        self, data: NDArray[np.uint8], bounds: Int, first: Int, room: Int, bits: Any, lengths: Int, is_present: Bool,
        parent: Int,
    ) -> Int:  # fmt: skip
        """The walk through messages as Google's parser has written them."""
        plan = (self.fields, self.node_first, self.node_level, self.blank, self.blank_first)
        return walk_protobuf(data, bounds, *plan, first, room, bits, lengths, is_present, parent)


def _enum_names(field: Any) -> dict[int, str]:
    return {v.number: v.name for v in field.enum_type.values}
