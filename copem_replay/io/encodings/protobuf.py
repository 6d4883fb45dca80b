"""Protobuf messages of any schema, taken apart into columns by the descriptors inside the recording.

Google's parser says what is a message, and brings it into canonical form; then one compiled walk (`protobuf_kernel`)
takes the fields that are asked for.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, EncodeError

from copem_replay.core.tracks import Int
from copem_replay.io.encodings import protobuf_kernel as kernel
from copem_replay.io.encodings.columns import Definition, Shredded, above, batches, level_of, levels_to
from copem_replay.io.encodings.raw_values import DefinitionError, Kind, RawColumn, joined, shredded

_DEEPEST = 12
"""Levels of messages within messages that are offered (chosen: definitions may refer to themselves)."""
_MOST_FIELDS = 20_000
"""So many are offered of a message (chosen)."""
_TYPES = {
    FieldDescriptor.TYPE_DOUBLE: (kernel.FIXED64, "f8"),
    FieldDescriptor.TYPE_FIXED64: (kernel.FIXED64, "u8"),
    FieldDescriptor.TYPE_SFIXED64: (kernel.FIXED64, "i8"),
    FieldDescriptor.TYPE_FLOAT: (kernel.FIXED32, "f4"),
    FieldDescriptor.TYPE_FIXED32: (kernel.FIXED32, "u4"),
    FieldDescriptor.TYPE_SFIXED32: (kernel.FIXED32, "i4"),
    FieldDescriptor.TYPE_INT64: (kernel.VARINT, "i8"),
    FieldDescriptor.TYPE_UINT64: (kernel.VARINT, "u8"),
    FieldDescriptor.TYPE_SINT64: (kernel.VARINT, "zigzag"),
    FieldDescriptor.TYPE_INT32: (kernel.VARINT, "i4"),
    FieldDescriptor.TYPE_UINT32: (kernel.VARINT, "u4"),
    FieldDescriptor.TYPE_SINT32: (kernel.VARINT, "zigzag"),
    FieldDescriptor.TYPE_ENUM: (kernel.VARINT, "i4"),
    FieldDescriptor.TYPE_BOOL: (kernel.VARINT, "bool"),
    FieldDescriptor.TYPE_STRING: (kernel.BYTES, "text"),
    FieldDescriptor.TYPE_BYTES: (kernel.BYTES, "bytes"),
}
"""How each type lies in a message, and how it is read."""


class ProtobufDefinition(Definition):
    """What the messages of a protobuf channel look like. Raises DefinitionError."""

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
        self._names: dict[str, Mapping[int, str]] = {}
        self._explore(empty.DESCRIPTOR)

    def names(self, path: str) -> Mapping[int, str]:
        """The names of the numbers of an enumeration, empty for what is none."""
        return self._names.get(path, {})

    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> Shredded:
        """Take messages apart. Raises KeyError for a path that is not offered."""
        numbers, texts = tuple(numbers), tuple(texts)
        wanted = self._known((*numbers, *texts))
        levels = levels_to(wanted)
        table = _Table(self._root, wanted, levels)
        columns = [RawColumn(table.kinds[path]) for path in wanted]
        level_ix = np.array([levels.index(level_of(path)) for path in wanted], dtype=np.int64)
        rows = np.zeros(len(levels), dtype=np.int64)
        parents: list[list[Int]] = [[] for _ in levels]
        decoded = np.zeros(len(payloads), dtype=bool)
        for batch in batches(payloads):
            whole = [self._canonical(payload) for payload in payloads[batch]]
            good = batch.start + np.flatnonzero([p is not None for p in whole])
            decoded[good] = True
            data = b"".join(p for p in whole if p is not None)
            bounds = np.cumsum([0, *(len(p) for p in whole if p is not None)], dtype=np.int64)
            found, taken, parent = _walked(data, bounds, table, level_ix, len(levels))
            for k, name in enumerate(levels):
                of = parent[k, : found[k]]
                parents[k].append(of + rows[levels.index(above(name))] if name else good[of])
            for column, (bits, lengths, said) in zip(columns, taken, strict=True):
                column.add(data, bits, lengths, said)
            rows += found

        by_level = {name: joined(parents[k], np.int64) for k, name in enumerate(levels)}
        return shredded(by_level, dict(zip(wanted, columns, strict=True)), numbers, texts, decoded)

    def _canonical(self, payload: bytes) -> bytes | None:
        """A message with every field once and as its schema has it, None for what is none."""
        try:
            message = self._parse(payload)
            message.DiscardUnknownFields()
            written: bytes = message.SerializePartialToString()
        except (DecodeError, EncodeError, RecursionError, ValueError):
            return None
        return written

    def _explore(self, root: Any) -> None:
        """Note all leaves, those of outer messages first: definitions may refer to themselves, and many times."""
        level = [(root, "")]
        for _ in range(_DEEPEST):
            below = []
            for descriptor, path in level:
                for field in descriptor.fields:
                    here = (f"{path}.{field.name}" if path else field.name) + ("[]" if field.is_repeated else "")
                    if field.message_type is None:
                        self._offers[here] = "number" if _TYPES[field.type][0] != kernel.BYTES else "text"
                        if field.enum_type is not None:
                            self._names[here] = _names_of(field)
                    elif not field.message_type.GetOptions().map_entry:
                        below.append((field.message_type, here))
                if len(self._offers) + len(below) > _MOST_FIELDS:
                    return
            level = below


class _Table:
    """The fields that lead to `wanted` paths, for the walk, by the kind of message they are in."""

    def __init__(self, root: Any, wanted: Sequence[str], levels: Sequence[str]) -> None:
        self.kinds: dict[str, Kind] = {}
        self._level = {name: k for k, name in enumerate(levels)}
        nodes: list[tuple[Any, str]] = [(root, "")]
        node_of = {"": 0}
        fields: list[list[list[int]]] = [[]]
        blank: list[list[int]] = [[]]
        for column, path in enumerate(wanted):
            node, here = 0, ""
            parts = path.split(".")
            for part in parts[:-1]:
                here = f"{here}.{part}" if here else part
                field = nodes[node][0].fields_by_name[part.removesuffix("[]")]
                if here not in node_of:
                    node_of[here] = len(nodes)
                    nodes.append((field.message_type, here))
                    fields.append([])
                    blank.append([])
                    level = self._level[here] if field.is_repeated else -1
                    fields[node].append([field.number, kernel.MESSAGE, -1, level, node_of[here]])
                node = node_of[here]
            field = nodes[node][0].fields_by_name[parts[-1].removesuffix("[]")]
            wire, how = _TYPES[field.type]
            level = self._level[path] if field.is_repeated else -1
            fields[node].append([field.number, wire, column, level, -1])
            if not field.is_repeated and not field.has_presence:
                blank[node].append(column)
            self.kinds[path] = Kind(how, _names_of(field) if field.enum_type is not None else {})
        self.fields = np.array([row for rows in fields for row in rows], dtype=np.int64).reshape(-1, 5)
        self.node_first = np.cumsum([0, *map(len, fields)], dtype=np.int64)
        self.node_level = np.array([self._level[level_of(path)] for _, path in nodes], dtype=np.int64)
        self.blank = np.array([column for columns in blank for column in columns], dtype=np.int64)
        self.blank_first = np.cumsum([0, *map(len, blank)], dtype=np.int64)


def _names_of(field: Any) -> dict[int, str]:
    return {v.number: v.name for v in field.enum_type.values}


def _walked(
    data: bytes, bounds: Int, table: _Table, level_ix: Int, levels: int
) -> tuple[Int, list[tuple[Any, Int, Any]], Int]:
    """Rows of each level; bits, lengths and whether it is said, of each column; the parents, (levels, most rows)."""
    at = np.frombuffer(data, dtype=np.uint8)
    plan = (table.fields, table.node_first, table.node_level, table.blank, table.blank_first)
    first = np.zeros(len(level_ix) + 1, dtype=np.int64)

    def walk(room: Int, size: int, most: int) -> tuple[Int, Any, Int, Any, Int]:
        bits, lengths = np.empty(size, dtype=np.uint64), np.empty(size, dtype=np.int64)
        said, parent = np.zeros(size, dtype=bool), np.empty((levels, most), dtype=np.int64)
        return kernel.walk(at, bounds, *plan, first, room, bits, lengths, said, parent), bits, lengths, said, parent

    rows = walk(np.zeros(levels, dtype=np.int64), 0, 0)[0]
    np.cumsum(rows[level_ix], out=first[1:])
    _, bits, lengths, said, parent = walk(rows, int(first[-1]), int(rows.max(initial=0)))
    lengths[~said], bits[~said] = 0, 0
    parts = [slice(*ends) for ends in pairwise(first.tolist())]
    return rows, [(bits[p], lengths[p], said[p]) for p in parts], parent
