"""Protobuf messages made of columns, many at once, the bytes those of `SerializeToString(deterministic=True)`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from numpy.typing import NDArray

from copem_replay.core.tracks import Bool, Int
from copem_replay.io.encodings.column_bytes import Each, Number, Part, Pieces, Sized, records, starts

_VARINT, _FIXED64, _SIZED = 0, 1, 2  # wire types

Content: TypeAlias = Mapping[str, "float | NDArray[Any] | Pieces | Content | Repeated"]
"""By field: numbers (N,) or one for all, the bytes of a text, a message's content; of a repeated field its rows, or all
of it, encoded already.
"""


@dataclass(frozen=True)
class Repeated:
    """The messages of a repeated field: in row n those of rows `start[n]:start[n + 1]`."""

    start: Int
    content: Content


def where(said: Bool, content: Content) -> Repeated:
    """A message in some rows only, (N,); its content has these rows alone."""
    return Repeated(starts(said), content)


def messages(descriptor: Descriptor, content: Content, rows: int) -> list[bytes]:
    """A message of every row."""
    return records(_fields(descriptor, content, rows), rows)


def _fields(descriptor: Descriptor, content: Content, rows: int) -> list[Part]:
    """In the order of their numbers."""
    fields = {name: descriptor.fields_by_name[name] for name in content}
    return [_field(fields[name], content[name], rows) for name in sorted(content, key=lambda n: fields[n].number)]


def _field(field: FieldDescriptor, value: Any, rows: int) -> Part:
    number = field.number << 3
    if isinstance(value, Repeated):
        inside = int(value.start[-1])
        parts = _fields(field.message_type, value.content, inside)
        return Each(value.start, [Sized(number | _SIZED, parts, inside, always=True)])
    if isinstance(value, Mapping):
        return Sized(number | _SIZED, _fields(field.message_type, value, rows), rows, always=True)
    if isinstance(value, Pieces):
        return value if field.message_type else Sized(number | _SIZED, [value], rows, always=field.has_presence)
    wire, dtype = (_FIXED64, np.float64) if field.type == field.TYPE_DOUBLE else (_VARINT, np.int64)
    column = value if isinstance(value, np.ndarray) else np.full(rows, value, dtype=dtype)
    return Number(number | wire, column, always=field.has_presence)
