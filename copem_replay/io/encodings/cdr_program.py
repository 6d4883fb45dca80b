"""The definition of a ROS 2 message, as rosbags parses it, made into a program for `cdr_kernel`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from copem_replay.core.tracks import Int
from copem_replay.io.encodings import cdr_kernel as kernel
from copem_replay.io.encodings.columns import level_of
from copem_replay.io.encodings.raw_values import DefinitionError, Kind

# size in bytes and how NumPy reads it
BASES = {
    "bool": (1, "u1"),
    "byte": (1, "u1"),
    "char": (1, "u1"),
    "int8": (1, "i1"),
    "uint8": (1, "u1"),
    "int16": (2, "i2"),
    "uint16": (2, "u2"),
    "int32": (4, "i4"),
    "uint32": (4, "u4"),
    "int64": (8, "i8"),
    "uint64": (8, "u8"),
    "float32": (4, "f4"),
    "float64": (8, "f8"),
}
TEXT = "string"
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""rosbags' kinds of node."""


def fields_of(types: Any, name: str, of: str) -> list[tuple[str, Any]]:
    """The fields of a type, which the definition `of` a message may lack. Raises DefinitionError."""
    return list(types[named(name, types, of)][1])


def named(name: str, types: Any, of: str) -> str:
    """The name of a type. Raises DefinitionError where the definition `of` a message lacks it."""
    if name not in types:
        raise DefinitionError(f"the definition of {of} lacks {name}")
    return name


def base(name: str) -> str:
    """The name of a type of values. Raises DefinitionError for one that is not read."""
    if name not in BASES and name != TEXT:
        raise DefinitionError(f"values of type {name} are not read by this version")
    return name


class Program:
    """Instructions for a message, with the columns that `wanted` asks for."""

    def __init__(self, types: Any, wanted: Sequence[str], levels: Sequence[str]) -> None:
        self._types = types
        self._column = {path: k for k, path in enumerate(wanted)}
        self._level = {name: k for k, name in enumerate(levels)}
        self._picked: dict[str, list[int]] = {}
        for array, item in map(picked, wanted):
            if item >= 0:
                self._picked.setdefault(array, []).append(item)
        self._rows: list[list[int]] = []
        self.kinds: dict[str, Kind] = {}  # of each wanted path

    def finished(self) -> Int:
        """The program, (I, 4)."""
        return np.array([*self._rows, [kernel.END, 0, 0, 0]], dtype=np.int64)

    def add_type(self, name: str, path: str) -> None:
        """All fields of a type, in their order."""
        fields = self._types[name][1]
        if not fields:
            self._skip(1, 1)  # an empty structure is sent as one byte
        for field, node in fields:
            self._add_node(node, f"{path}.{field}" if path else field)

    def _skip(self, size: int, number: int) -> None:
        """Pass over numbers, together with those before them where nothing can lie between."""
        if self._rows and (last := self._rows[-1])[0] == kernel.SKIP and size <= last[1] and last[2] % size == 0:
            last[2] += size * number
        else:
            self._add(kernel.SKIP, size, size * number)

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
            self._add_list(kind == ARRAY, item, number, path)

    def _add_list(self, fixed: bool, item: Any, number: int, path: str) -> None:
        """A list: as one text where that is wanted, some of its items, then all of it."""
        base = item[1][0] if item[0] == BASE else ""
        size = BASES[base][0] if base in BASES else 0
        level = self._level.get(f"{path}[]", -1)
        if path in self._column or path in self._picked:
            self._add(kernel.MARK)
        if path in self._column:
            column, of = self._column[path], self._level[level_of(path)]
            self.kinds[path] = Kind("bytes")
            self._add(kernel.BYTES, number, column, of) if fixed else self._add(kernel.TEXT, column, 1, of)
            self._add(kernel.BACK)
        if picked := self._picked.get(path):
            before = 0
            for k in sorted(picked):
                if k > before:
                    self._skip(size, k - before)
                self._add_base(base, f"{path}[{k}]")
                before = k + 1
            self._add(kernel.BACK)
        if size and level < 0:
            self._skip(size, number) if fixed else self._add(kernel.NUMBERS, size)
            return
        if not size:
            self._add(kernel.SIZE)
        head = self._add(kernel.ARRAY, number, 0, level) if fixed else self._add(kernel.LIST, 0, level)
        self._add_node(item, f"{path}[]")
        self._add(kernel.NEXT)
        self._rows[head][2 if fixed else 1] = len(self._rows)

    def _add_base(self, name: str, path: str) -> None:
        column = self._column.get(path, -1)
        level = self._level.get(level_of(path), 0)
        if name == TEXT:
            self._add(kernel.TEXT, column, 1, level)
            self.kinds[path] = Kind("ended")
            return
        size, how = BASES[name]
        self.kinds[path] = Kind("bool" if name == "bool" else how)
        if column < 0:
            self._skip(size, 1)
        else:
            self._add(kernel.TAKE, size, column, level)


def picked(path: str) -> tuple[str, int]:
    """The list and the number of the item that a path chooses at its end; −1: it chooses none there."""
    array, _, item = path.removesuffix("]").rpartition("[")
    return (array, int(item)) if path.endswith("]") and item.isdecimal() and len(item) < 10 else (path, -1)
