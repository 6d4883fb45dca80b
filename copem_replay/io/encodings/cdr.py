"""ROS 2 messages: the definition inside the recording, made into a program for `cdr_kernel`.

Definitions (`ros2msg`, `ros2idl`) are parsed by rosbags; what a package changed between releases is therefore read as
the file says it. Of a message only the fields that are asked for are taken.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from copem_replay.core.tracks import Bool, Int
from copem_replay.io.encodings import cdr_kernel as kernel
from copem_replay.io.encodings.cdr_program import (
    ARRAY,
    BASE,
    BASES,
    NAME,
    TEXT,
    Program,
    base,
    fields_of,
    named,
    picked,
)
from copem_replay.io.encodings.columns import Definition, Shredded, above, batches, level_of, levels_to
from copem_replay.io.encodings.raw_values import DefinitionError, RawColumn, joined, shredded

_DEEPEST = kernel.DEEPEST - 1
_MOST_FIELDS = 20_000
"""A definition that has more is taken for damage (chosen: the largest of autoware have some 100)."""
_LONGEST_ARRAY = 1 << 31
_EVERYWHERE: dict[str, Any] = {
    f"builtin_interfaces/msg/{name}": ([], [("sec", (1, ("int32", 0))), ("nanosec", (1, ("uint32", 0)))])
    for name in ("Time", "Duration")
}
"""Types that some writers leave out of their definitions, as rosbags has them."""


class CdrDefinition(Definition):
    """What the messages of a ROS 2 channel look like. Raises DefinitionError."""

    def __init__(self, name: str, encoding: str, text: bytes) -> None:
        super().__init__()
        self._name = name if name.count("/") == 2 else name.replace("/", "/msg/")
        try:
            self._types = {**_EVERYWHERE, **_parsed(text.decode().replace("\r", ""), self._name, encoding)}
        except Exception as error:  # whatever a parser raises at what is no definition
            why = " ".join(str(error).split())[:200] or type(error).__name__
            raise DefinitionError(f"the definition of {name} cannot be parsed: {why}") from None
        if self._name not in self._types:
            raise DefinitionError(f"the definition of {name} is not among the types its schema defines")
        self._arrays: dict[str, int] = {}  # paths of the arrays of numbers, and how many each has
        self._explored = 0
        self._explore(self._name, "", ())

    def picks(self, path: str) -> bool:
        """Whether a path is of one item of an array of numbers: taken without the others."""
        array, item = picked(path)
        return 0 <= item < self._arrays.get(array, 0)

    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> Shredded:
        """Take messages apart. Raises KeyError for a path that is neither offered nor picked."""
        wanted = self._known((*(numbers := tuple(numbers)), *(texts := tuple(texts))))
        levels = levels_to(wanted)
        builder = Program(self._types, wanted, levels)
        builder.add_type(self._name, "")
        program = builder.finished()
        level_ix = np.array([levels.index(level_of(path)) for path in wanted], dtype=np.int64)
        columns = [RawColumn(builder.kinds[path]) for path in wanted]
        rows = np.zeros(len(levels), dtype=np.int64)
        parents: list[list[Int]] = [[] for _ in levels]
        decoded = np.zeros(len(payloads), dtype=bool)
        for batch in batches(payloads):
            data = b"".join(payloads[batch])
            bounds = np.cumsum([0, *map(len, payloads[batch])], dtype=np.int64)
            found, bits, lengths, parent = _walked(data, bounds, program, level_ix, decoded[batch], len(levels))
            for k, name in enumerate(levels):
                up = batch.start if not name else rows[levels.index(above(name))]
                parents[k].append(parent[k, : found[k]] + up)
            for column, b, n in zip(columns, bits, lengths, strict=True):
                column.add(data, b, n)
            rows += found

        by_level = {name: joined(parents[k], np.int64) for k, name in enumerate(levels)}
        return shredded(by_level, dict(zip(wanted, columns, strict=True)), numbers, texts, decoded)

    def _explore(self, name: str, path: str, inside: tuple[str, ...]) -> None:
        """Note all leaves below a type. Raises DefinitionError for what has no end, or is too much."""
        if name in inside or len(inside) > _DEEPEST:
            raise DefinitionError(f"the definition of {self._name} is nested without end ({name})")
        for field, node in fields_of(self._types, name, self._name):
            self._explore_node(node, f"{path}.{field}" if path else field, (*inside, name))

    def _explore_node(self, node: Any, path: str, inside: tuple[str, ...]) -> None:
        self._explored += 1
        if self._explored > _MOST_FIELDS:
            raise DefinitionError(f"the definition of {self._name} has more than {_MOST_FIELDS} fields")
        kind, detail = node
        if kind == BASE:
            self._offers[path] = "text" if base(detail[0]) == TEXT else "number"
        elif kind == NAME:
            self._explore(named(detail, self._types, self._name), path, inside)
        else:
            item, number = detail
            if kind == ARRAY and not 0 < number <= _LONGEST_ARRAY:
                raise DefinitionError(f"{path} of {self._name} is an array of {number} items")
            if item[0] == BASE and item[1][0] in ("uint8", "byte"):
                self._offers[path] = "text"  # as one: an id, say
            if item[0] == BASE and item[1][0] in BASES and kind == ARRAY:
                self._arrays[path] = number
            self._explore_node(item, f"{path}[]", inside)


def _walked(
    data: bytes, bounds: Int, program: Int, level_ix: Int, decoded: Bool, levels: int
) -> tuple[Int, list[Any], list[Int], Int]:
    """Rows of each level; the bits and lengths of each column; the parents, (levels, most rows)."""
    at = np.frombuffer(data, dtype=np.uint8)
    first = np.zeros(len(level_ix) + 1, dtype=np.int64)
    none = np.zeros(0, dtype=np.uint64), np.zeros(0, dtype=np.int64), np.zeros((levels, 0), dtype=np.int64)
    rows = kernel.walk(at, bounds, program, first, np.zeros(levels, dtype=np.int64), *none, decoded)
    np.cumsum(rows[level_ix], out=first[1:])
    bits, lengths = np.empty(first[-1], dtype=np.uint64), np.empty(first[-1], dtype=np.int64)
    parent = np.empty((levels, int(rows.max(initial=0))), dtype=np.int64)
    kernel.walk(at, bounds, program, first, rows, bits, lengths, parent, decoded)
    parts = [slice(*ends) for ends in pairwise(first.tolist())]
    return rows, [bits[p] for p in parts], [lengths[p] for p in parts], parent


_SEPARATOR = re.compile(r"^={10,}[ \t]*$", re.MULTILINE)


@lru_cache(maxsize=32)  # one is asked for several times: to look, for the truth, for the lists of units
def _parsed(text: str, name: str, encoding: str) -> dict[str, Any]:
    """The types a schema defines, by name. Raises whatever rosbags does."""
    # Imported here: recordings of other kinds have no use for it.
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if encoding != "ros2idl":
        return get_types_from_msg(_SEPARATOR.sub("=" * 80, text), name)
    if shift := _FAR_SHIFT.search(text):  # rosbags would compute it, gigabytes long
        raise ValueError(f"a constant is shifted by {shift[1]}")
    types: dict[str, Any] = {}
    for part in _SEPARATOR.split(text):
        if part.strip():
            types.update(get_types_from_idl(_NOT_IDL.sub("", part)))
    return types


_FAR_SHIFT = re.compile(r"<<[\s(]*(\d{3,})")
_NOT_IDL = re.compile(r"^[ \t]*(#|IDL:).*$", re.MULTILINE)
"""Lines for the preprocessor, and those that name the file of a definition."""
