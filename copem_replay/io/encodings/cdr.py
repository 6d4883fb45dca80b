"""ROS 2 messages (CDR) decoded into columns, by the definition inside the recording.

Definitions (`ros2msg`, `ros2idl`) are parsed by rosbags, so messages are read as the recording's release of a package
defines them. A definition becomes a program that says which fields to skip and which to take; one compiled walk, the
kernel, runs it over all messages. CDR has no lengths to jump by (OMG, Common Object Request Broker Architecture part
2, 9.3; DDS-XTypes 1.3, 7.4.3), so everything before a field is walked through. The kernel knows no types: it takes the
bits of numbers and the places of texts, which become columns afterwards.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.compiled import callee, kernel
from copem_replay.core.tracks import Bool, Int
from copem_replay.io.channel import DefinitionError
from copem_replay.io.encodings.columns import (
    Definition,
    ShreddedMessages,
    ValueKind,
    list_level,
    list_levels,
    split_batches,
    walk_columns,
)
from copem_replay.io.encodings.ros2_types import known_types

# The kernel.

END, SKIP, TAKE, TEXT, BYTES, NUMBERS, LIST, ARRAY, NEXT, MARK, BACK, SIZE = range(12)
"""Instructions, one in each row of a program, with up to three numbers:

SKIP alignment, bytes · TAKE size, column · TEXT column or −1, unit of its length · BYTES length, column · NUMBERS size
(a list of numbers, passed over) · LIST where it ends, level or −1 · ARRAY length, where it ends, level or −1 · NEXT
(the end of an item) · MARK, BACK: go back to where the mark is · SIZE (of what follows, which XCDR2 alone has) · END.
"""

DEEPEST = 32
"""Lists within lists that a program has, at most."""
_HEADER = 4  # bytes of the encapsulation; alignment counts from their end
_SPARE = 8  # bytes that may be left over at the end: padding


@callee
def _read_number(data: NDArray[np.uint8], offset: int, size: int, swapped: bool) -> np.uint64:
    """The bits of a number."""
    bits = np.uint64(0)
    for k in range(size):
        byte = data[offset + k] if swapped else data[offset + size - 1 - k]
        bits = (bits << np.uint64(8)) | np.uint64(byte)
    return bits


@kernel
def walk_cdr(
    data: NDArray[np.uint8], bounds: Int, program: Int, first: Int, room: Int, bits: Any, lengths: Int, parent: Int
) -> Int:
    """As `Walk`, of values that are all there. A message that does not fit its schema leaves no rows."""
    rows = np.zeros(len(room), dtype=np.int64)
    before = np.zeros(len(room), dtype=np.int64)
    loop_start = np.zeros(DEEPEST, dtype=np.int64)  # instruction after the head of each list that is open
    items_left = np.zeros(DEEPEST, dtype=np.int64)  # its items still to come
    owner = np.zeros(DEEPEST, dtype=np.int64)  # its level
    for m in range(len(bounds) - 1):
        begin, end = bounds[m] + _HEADER, bounds[m + 1]
        before[:] = rows
        if rows[0] < room[0]:
            parent[0, rows[0]] = m
        rows[0] += 1
        is_valid = end >= begin and data[bounds[m]] == 0 and data[bounds[m] + 1] in (0, 1, 6, 7)
        swapped = is_valid and data[bounds[m] + 1] in (0, 6)
        most = 4 if is_valid and data[bounds[m] + 1] >= 6 else 8  # XCDR2 aligns to four bytes at most
        offset, pc, depth, mark = begin, 0, 0, begin
        while is_valid:
            op, a, b, c = program[pc, 0], program[pc, 1], program[pc, 2], program[pc, 3]
            pc += 1
            if op in (SKIP, TAKE, BYTES):
                step = a if op != BYTES else 1
                step = min(step, most)
                offset += -(offset - begin) % step
                size = b if op == SKIP else a
                if size > end - offset:
                    is_valid = False
                    break
                if op != SKIP:
                    slot = b
                    level = program[pc - 1, 3]
                    row = rows[level] - 1
                    if row < room[level]:
                        if op == TAKE:
                            bits[first[slot] + row] = _read_number(data, offset, a, swapped)
                        else:
                            bits[first[slot] + row] = np.uint64(offset)
                            lengths[first[slot] + row] = a
                offset += size
            elif op == NEXT:
                items_left[depth - 1] -= 1
                if items_left[depth - 1] > 0:
                    level = owner[depth - 1]
                    pc = loop_start[depth - 1]
                    if level >= 0:
                        rows[level] += 1
                        if rows[level] <= room[level]:
                            parent[level, rows[level] - 1] = parent[level, rows[level] - 2]
                else:
                    depth -= 1
            elif op == MARK:
                mark = offset
            elif op == BACK:
                offset = mark
            elif op == SIZE:
                if most == 4:
                    offset += -(offset - begin) % 4 + 4
                    if offset > end:
                        is_valid = False
                        break
            elif op == END:
                is_valid = end - offset <= _SPARE
                break
            else:
                if op == ARRAY:
                    number, stop, level = a, b, c
                else:
                    offset += -(offset - begin) % 4
                    if end - offset < 4:
                        is_valid = False
                        break
                    number, stop, level = np.int64(_read_number(data, offset, 4, swapped)), a, b
                    offset += 4
                if op == TEXT:
                    size = number * b
                    if size > end - offset:
                        is_valid = False
                        break
                    if a >= 0:
                        row = rows[c] - 1
                        if row < room[c]:
                            bits[first[a] + row] = np.uint64(offset)
                            lengths[first[a] + row] = size
                    offset += size
                elif op == NUMBERS:
                    if number > 0:
                        offset += -(offset - begin) % min(a, most)
                    if number > (end - offset) // a:
                        is_valid = False
                        break
                    offset += number * a
                elif number == 0:
                    pc = stop
                else:
                    if number > end - offset:  # an item is a byte at least
                        is_valid = False
                        break
                    loop_start[depth], items_left[depth], owner[depth] = pc, number, level
                    if level >= 0:
                        rows[level] += 1
                        if rows[level] <= room[level]:
                            inner = 0  # the nearest level around it
                            for d in range(depth - 1, -1, -1):
                                if owner[d] >= 0:
                                    inner = owner[d]
                                    break
                            parent[level, rows[level] - 1] = rows[inner] - 1
                    depth += 1
        if not is_valid:
            rows[:] = before
    return rows


# The program of a definition.

BASES = {"bool": (1, "u1"), "byte": (1, "u1"), "char": (1, "u1")} | {
    f"{word}{8 * size}": (size, f"{word[0]}{size}")
    for word, sizes in (("int", (1, 2, 4, 8)), ("uint", (1, 2, 4, 8)), ("float", (4, 8)))
    for size in sizes
}
"""Types of numbers: the size in bytes and NumPy's name."""
STRING_TYPE = "string"
BASE, NAME, FIXED_ARRAY, SEQUENCE = 1, 2, 3, 4
"""rosbags' kinds of node."""


def find_message_fields(types: Any, name: str, message: str) -> list[tuple[str, Any]]:
    """The fields of a type, which the definition `message` a message may lack. Raises DefinitionError."""
    return list(types[resolve_type_name(name, types, message)][1])


def resolve_type_name(name: str, types: Any, message: str) -> str:
    """The name of a type. Raises DefinitionError where the definition `message` a message lacks it."""
    if name not in types:
        raise DefinitionError(f"the definition of {message} lacks {name}")
    return name


def base_type(name: str) -> str:
    """The name of a type of values. Raises DefinitionError for one that is not read."""
    if name not in BASES and name != STRING_TYPE:
        raise DefinitionError(f"values of type {name} are not read by this version")
    return name


class CdrProgram:
    """The program for the messages of a type, which takes the columns of the paths `wanted`."""

    def __init__(self, types: Any, paths: Sequence[str], levels: Sequence[str]) -> None:
        self._types = types
        self._column = {path: k for k, path in enumerate(paths)}
        self._level = {name: k for k, name in enumerate(levels)}
        self._picked: dict[str, list[int]] = {}
        for array, item in map(split_chosen_item, paths):
            if item >= 0:
                self._picked.setdefault(array, []).append(item)
        self._rows: list[list[int]] = []
        self.kinds: dict[str, ValueKind] = {}  # by path

    def finished(self) -> Int:
        """The program of I instructions, (I, 4)."""
        return np.array([*self._rows, [END, 0, 0, 0]], dtype=np.int64)

    def add_type(self, name: str, path: str) -> None:
        """Add instructions for all fields of a type, in their order."""
        fields = self._types[name][1]
        if not fields:
            self._skip(1, 1)  # an empty structure is sent as one byte
        for field, node in fields:
            self._add_node(node, f"{path}.{field}" if path else field)

    def _skip(self, size: int, number: int) -> None:
        """Skip numbers, in one instruction with those before them where no padding can lie between."""
        if self._rows and (last := self._rows[-1])[0] == SKIP and size <= last[1] and last[2] % size == 0:
            last[2] += size * number
        else:
            self._add(SKIP, size, size * number)

    def _add(self, *instruction: int) -> int:
        self._rows.append([*instruction, *[0] * (4 - len(instruction))])
        return len(self._rows) - 1

    def _add_node(self, node: Any, path: str) -> None:
        kind, detail = node
        if kind == BASE:
            self._add_base(detail[0], path)
        elif kind == NAME:
            self.add_type(detail, path)
        else:
            item, number = detail
            self._add_list(kind == FIXED_ARRAY, item, number, path)

    def _add_list(self, fixed: bool, item: Any, number: int, path: str) -> None:
        """Add the steps that read a list: as a text if that is wanted, then chosen items, then the list itself."""
        base = item[1][0] if item[0] == BASE else ""
        size = BASES[base][0] if base in BASES else 0
        level = self._level.get(f"{path}[]", -1)
        if path in self._column or path in self._picked:
            self._add(MARK)
        if path in self._column:
            column, of = self._column[path], self._level[list_level(path)]
            self.kinds[path] = ValueKind("bytes")
            self._add(BYTES, number, column, of) if fixed else self._add(TEXT, column, 1, of)
            self._add(BACK)
        if picked_items := self._picked.get(path):
            next_item = 0
            for k in sorted(picked_items):
                if k > next_item:
                    self._skip(size, k - next_item)
                self._add_base(base, f"{path}[{k}]")
                next_item = k + 1
            self._add(BACK)
        if size and level < 0:
            self._skip(size, number) if fixed else self._add(NUMBERS, size)
            return
        if not size:
            self._add(SIZE)
        list_step = self._add(ARRAY, number, 0, level) if fixed else self._add(LIST, 0, level)
        self._add_node(item, f"{path}[]")
        self._add(NEXT)
        self._rows[list_step][2 if fixed else 1] = len(self._rows)

    def _add_base(self, name: str, path: str) -> None:
        """Add the step that reads, or skips, one number or text of type `name`."""
        column = self._column.get(path, -1)
        level = self._level.get(list_level(path), 0)
        if name == STRING_TYPE:
            self._add(TEXT, column, 1, level)
            self.kinds[path] = ValueKind("ended")
            return
        size, how = BASES[name]
        self.kinds[path] = ValueKind("bool" if name == "bool" else how)
        if column < 0:
            self._skip(size, 1)
        else:
            self._add(TAKE, size, column, level)


def split_chosen_item(path: str) -> tuple[str, int]:
    """The list and the number of the item that a path chooses at its end; −1: it chooses none."""
    array, _, item = path.removesuffix("]").rpartition("[")
    return (array, int(item)) if path.endswith("]") and item.isdecimal() and len(item) < 10 else (path, -1)


# Definitions and decoding.

_DEEPEST = DEEPEST - 1
_MOST_FIELDS = 20_000
"""A definition with more fields is taken for damaged: the largest of Autoware have some 100."""
_LONGEST_ARRAY = 1 << 31
_EVERYWHERE: dict[str, Any] = {
    f"builtin_interfaces/msg/{name}": ([], [("sec", (1, ("int32", 0))), ("nanosec", (1, ("uint32", 0)))])
    for name in ("Time", "Duration")
}
"""Types that some writers leave out of their definitions, in the form of rosbags."""


class CdrDefinition(Definition):
    """The definition of a ROS 2 channel's messages. Raises DefinitionError."""

    def __init__(self, name: str, encoding: str, text: bytes) -> None:
        super().__init__()
        self._name = name if name.count("/") == 2 else name.replace("/", "/msg/")
        try:
            content = text.decode().replace("\r", "")
            parsed = _parse_definition(content, self._name, encoding) if content.strip() else known_types(self._name)
            self._types = {**_EVERYWHERE, **parsed}
        except DefinitionError:
            raise
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
        array, item = split_chosen_item(path)
        return 0 <= item < self._arrays.get(array, 0)

    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> ShreddedMessages:
        """The columns of messages. Raises KeyError: a path is neither offered nor picked; OversizeError."""
        paths = self._known((*(numbers := tuple(numbers)), *(texts := tuple(texts))))
        builder = CdrProgram(self._types, paths, list_levels(paths))
        builder.add_type(self._name, "")
        program = builder.finished()
        kinds = {path: builder.kinds[path] for path in paths}

        def walk(
            data: NDArray[np.uint8], bounds: Int, first: Int, room: Int, bits: Any, lengths: Int, present: Bool,
            parent: Int,
        ) -> Int:  # fmt: skip
            present[:] = True
            return walk_cdr(data, bounds, program, first, room, bits, lengths, parent)

        batches = ((np.arange(batch.start, batch.stop), payloads[batch]) for batch in split_batches(payloads))
        return walk_columns(walk, batches, kinds, numbers, texts, len(payloads))

    def _explore(self, name: str, path: str, outer_types: tuple[str, ...]) -> None:
        """Add all leaves below a type to the offered ones. Raises DefinitionError: nested without end, or too many."""
        if name in outer_types or len(outer_types) > _DEEPEST:
            raise DefinitionError(f"the definition of {self._name} is nested without end ({name})")
        for field, node in find_message_fields(self._types, name, self._name):
            self._explore_node(node, f"{path}.{field}" if path else field, (*outer_types, name))

    def _explore_node(self, node: Any, path: str, outer_types: tuple[str, ...]) -> None:
        """Add the leaves at and below a node to the offered paths. Raises DefinitionError: too many or too long."""
        self._explored += 1
        if self._explored > _MOST_FIELDS:
            raise DefinitionError(f"the definition of {self._name} has more than {_MOST_FIELDS} fields")
        kind, detail = node
        if kind == BASE:
            self._offers[path] = "text" if base_type(detail[0]) == STRING_TYPE else "number"
        elif kind == NAME:
            self._explore(resolve_type_name(detail, self._types, self._name), path, outer_types)
        else:
            item, number = detail
            if kind == FIXED_ARRAY and not 0 < number <= _LONGEST_ARRAY:
                raise DefinitionError(f"{path} of {self._name} is an array of {number} items")
            if item[0] == BASE and item[1][0] in ("uint8", "byte"):
                self._offers[path] = "text"  # as one: an id, say
            if item[0] == BASE and item[1][0] in BASES and kind == FIXED_ARRAY:
                self._arrays[path] = number
            self._explore_node(item, f"{path}[]", outer_types)


_SEPARATOR = re.compile(r"^={10,}[ \t]*$", re.MULTILINE)


@lru_cache(maxsize=32)  # a definition is needed several times: for the survey, the truth, the lists of units
def _parse_definition(text: str, name: str, encoding: str) -> dict[str, Any]:
    """By name the types that a schema defines, as rosbags parses them. Raises whatever rosbags does."""
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
