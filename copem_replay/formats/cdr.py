"""ROS 2 messages: the definition inside the recording, made into a program for `cdr_kernel`.

Definitions (`ros2msg`, `ros2idl`) are parsed by rosbags; what a package changed between releases is therefore read as
the file says it. Of a message only the fields that are asked for are taken.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from copem_replay.formats import cdr_kernel as kernel
from copem_replay.formats.shred import Level, Shredded, Texts, above, as_text, level_of, levels_to
from copem_replay.tracks import Bool, Float, Int

# size in bytes and how NumPy reads it
_BASES = {
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
_TEXT = {"string": 1}
_DEEPEST = kernel.DEEPEST - 1
_MOST_FIELDS = 20_000
"""A definition that has more is taken for damage (chosen: the largest of autoware have some 100)."""
_LONGEST_ARRAY = 1 << 31
_BATCH_BYTES = 4_000_000  # of messages walked through at once: what a cache holds (chosen)
_EVERYWHERE: dict[str, Any] = {
    f"builtin_interfaces/msg/{name}": ([], [("sec", (1, ("int32", 0))), ("nanosec", (1, ("uint32", 0)))])
    for name in ("Time", "Duration")
}
"""Types that some writers leave out of their definitions, as rosbags has them."""


class DefinitionError(ValueError):
    """A definition that cannot be used: what is wrong with it, in words."""


class CdrDefinition:
    """What the messages of a ROS 2 channel look like. Raises DefinitionError."""

    def __init__(self, name: str, encoding: str, text: bytes) -> None:
        self._name = name if name.count("/") == 2 else name.replace("/", "/msg/")
        try:
            self._types = {**_EVERYWHERE, **_parsed(text.decode().replace("\r", ""), self._name, encoding)}
        except Exception as error:  # whatever a parser raises at what is no definition
            why = " ".join(str(error).split())[:200] or type(error).__name__
            raise DefinitionError(f"the definition of {name} cannot be parsed: {why}") from None
        if self._name not in self._types:
            raise DefinitionError(f"the definition of {name} is not among the types its schema defines")
        self._offers: dict[str, str] = {}
        self._arrays: dict[str, int] = {}  # paths of the arrays of numbers, and how many each has
        self._explored = 0
        self._explore(self._name, "", ())

    def offers(self) -> dict[str, str]:
        """The paths of all leaves, and what each is: `number`, `text`."""
        return self._offers

    def picks(self, path: str) -> bool:
        """Whether a path is of one item of an array of numbers: taken without the others."""
        array, item = _picked(path)
        return 0 <= item < self._arrays.get(array, 0)

    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> Shredded:
        """Take messages apart. Raises KeyError for a path that is neither offered nor picked."""
        wanted = list(dict.fromkeys((*(numbers := tuple(numbers)), *(texts := tuple(texts)))))
        for path in wanted:
            if path not in self._offers and not self.picks(path):
                raise KeyError(path)
        levels = levels_to(wanted)
        builder = _Program(self._types, wanted, levels)
        builder.add_type(self._name, "")
        program = builder.finished()
        level_ix = np.array([levels.index(level_of(path)) for path in wanted], dtype=np.int64)
        columns = [_Column(builder.kinds[path], path in numbers, path in texts) for path in wanted]
        rows = np.zeros(len(levels), dtype=np.int64)
        parents: list[list[Int]] = [[] for _ in levels]
        decoded = np.zeros(len(payloads), dtype=bool)
        for batch in _batches(payloads):
            data = b"".join(payloads[batch])
            bounds = np.cumsum([0, *map(len, payloads[batch])], dtype=np.int64)
            found, bits, lengths, parent = _walked(data, bounds, program, level_ix, decoded[batch], len(levels))
            for k, name in enumerate(levels):
                up = batch.start if not name else rows[levels.index(above(name))]
                parents[k].append(parent[k, : found[k]] + up)
            for column, b, n in zip(columns, bits, lengths, strict=True):
                column.add(data, b, n)
            rows += found

        made = {name: Level(_joined(parents[k], np.int64), {}, {}) for k, name in enumerate(levels)}
        for path, column in zip(wanted, columns, strict=True):
            if path in numbers:
                made[level_of(path)].numbers[path] = column.numbers()
            if path in texts:
                made[level_of(path)].texts[path] = column.texts()
        return Shredded(made, decoded)

    def _explore(self, name: str, path: str, inside: tuple[str, ...]) -> None:
        """Note all leaves below a type. Raises DefinitionError for what has no end, or is too much."""
        if name in inside or len(inside) > _DEEPEST:
            raise DefinitionError(f"the definition of {self._name} is nested without end ({name})")
        for field, node in _fields(self._types, name, self._name):
            self._explore_node(node, f"{path}.{field}" if path else field, (*inside, name))

    def _explore_node(self, node: Any, path: str, inside: tuple[str, ...]) -> None:
        self._explored += 1
        if self._explored > _MOST_FIELDS:
            raise DefinitionError(f"the definition of {self._name} has more than {_MOST_FIELDS} fields")
        kind, detail = node
        if kind == _BASE:
            base = _base(detail[0])
            self._offers[path] = "text" if base in _TEXT else "number"
        elif kind == _NAME:
            self._explore(_named(detail, self._types, self._name), path, inside)
        else:
            item, number = detail
            if kind == _ARRAY and not 0 < number <= _LONGEST_ARRAY:
                raise DefinitionError(f"{path} of {self._name} is an array of {number} items")
            if item[0] == _BASE and item[1][0] in ("uint8", "byte"):
                self._offers[path] = "text"  # as one: an id, say
            if item[0] == _BASE and item[1][0] in _BASES and kind == _ARRAY:
                self._arrays[path] = number
            self._explore_node(item, f"{path}[]", inside)


_BASE, _NAME, _ARRAY, _SEQUENCE = 1, 2, 3, 4
"""rosbags' kinds of node."""


def _fields(types: Any, name: str, of: str) -> list[tuple[str, Any]]:
    return list(types[_named(name, types, of)][1])


def _named(name: str, types: Any, of: str) -> str:
    if name not in types:
        raise DefinitionError(f"the definition of {of} lacks {name}")
    return name


def _base(name: str) -> str:
    if name not in _BASES and name not in _TEXT:
        raise DefinitionError(f"values of type {name} are not read by this version")
    return name


class _Program:
    """Instructions for a message, with the columns that `wanted` asks for."""

    def __init__(self, types: Any, wanted: Sequence[str], levels: Sequence[str]) -> None:
        self._types = types
        self._column = {path: k for k, path in enumerate(wanted)}
        self._level = {name: k for k, name in enumerate(levels)}
        self._picked: dict[str, list[int]] = {}
        for array, item in map(_picked, wanted):
            if item >= 0:
                self._picked.setdefault(array, []).append(item)
        self._rows: list[list[int]] = []
        self.kinds: dict[str, str] = {}  # of each wanted path: how NumPy reads it, `text` or `bytes`

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
        if kind == _BASE:
            self._add_base(detail[0], path)
        elif kind == _NAME:
            self.add_type(detail, path)
        else:
            item, number = detail
            self._add_list(kind == _ARRAY, item, number, path)

    def _add_list(self, fixed: bool, item: Any, number: int, path: str) -> None:
        """A list: as one text where that is wanted, some of its items, then all of it."""
        base = item[1][0] if item[0] == _BASE else ""
        size = _BASES[base][0] if base in _BASES else 0
        level = self._level.get(f"{path}[]", -1)
        if path in self._column or path in self._picked:
            self._add(kernel.MARK)
        if path in self._column:
            column, of = self._column[path], self._level[level_of(path)]
            self.kinds[path] = "bytes"
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
        if name in _TEXT:
            self._add(kernel.TEXT, column, _TEXT[name], level)
            self.kinds[path] = "text"
            return
        size, how = _BASES[name]
        self.kinds[path] = "bool" if name == "bool" else how
        if column < 0:
            self._skip(size, 1)
        else:
            self._add(kernel.TAKE, size, column, level)


class _Column:
    """The values of one path, batch by batch."""

    def __init__(self, kind: str, as_numbers: bool, as_texts: bool) -> None:
        self._kind = kind
        self._as_numbers, self._as_texts = as_numbers, as_texts
        self._numbers: list[Any] = []
        self._codes: list[Int] = []
        self._code_of: dict[bytes, int] = {}

    def add(self, data: bytes, bits: Any, lengths: Int) -> None:
        """Values of a batch: their bits, or where in `data` they lie, and how long they are."""
        if self._kind not in ("text", "bytes"):
            how = "u1" if self._kind == "bool" else self._kind
            self._numbers.append(bits.astype(f"u{how[1]}", copy=False).view(how))
            return
        parts = [data[b : b + n] for b, n in zip(bits.tolist(), lengths.tolist(), strict=True)]
        if self._as_numbers:
            self._numbers.append(np.array([_number_in(p) for p in parts], dtype=np.float64))
        if self._as_texts:
            known = self._code_of
            self._codes.append(np.array([known.setdefault(p, len(known)) for p in parts], dtype=np.int64))

    def numbers(self) -> Float:
        """All of them, as numbers."""
        with np.errstate(invalid="ignore"):  # some NaN of float32
            found: Float = _joined(self._numbers, np.float64).astype(np.float64, copy=False)
        return found

    def texts(self) -> Texts:
        """All of them, as texts."""
        if self._kind not in ("text", "bytes"):
            values, code = np.unique(_joined(self._numbers, np.float64), return_inverse=True)
            said = [_as_words(v, self._kind) for v in values.tolist()]
        else:
            code, said = _joined(self._codes, np.int64), [_word(p, self._kind) for p in self._code_of]
        words = dict.fromkeys(said)  # what differs in bytes may be the same text
        number = {word: k for k, word in enumerate(words)}
        return Texts(np.array([number[w] for w in said], dtype=np.int64)[code], tuple(words))


def _picked(path: str) -> tuple[str, int]:
    """The list and the number of the item that a path chooses at its end; −1: it chooses none there."""
    array, _, item = path.removesuffix("]").rpartition("[")
    return (array, int(item)) if path.endswith("]") and item.isdecimal() and len(item) < 10 else (path, -1)


def _joined(parts: Sequence[Any], kind: Any) -> Any:
    return np.concatenate(parts) if parts else np.zeros(0, dtype=kind)


def _batches(payloads: Sequence[bytes]) -> Iterator[slice]:
    first, size = 0, 0
    for k, payload in enumerate(payloads):
        size += len(payload)
        if size > _BATCH_BYTES:
            yield slice(first, k + 1)
            first, size = k + 1, 0
    if first < len(payloads):
        yield slice(first, len(payloads))


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


def _number_in(text: bytes) -> float:
    try:
        return float(text.rstrip(b"\0"))
    except ValueError:
        return np.nan


def _as_words(value: Any, kind: str) -> str:
    if kind == "bool":
        return "true" if value else "false"
    return as_text(value)


def _word(text: bytes, kind: str) -> str:
    return text.hex() if kind == "bytes" else text.rstrip(b"\0").decode(errors="replace")


_SEPARATOR = re.compile(r"^={10,}[ \t]*$", re.MULTILINE)


@lru_cache(maxsize=32)  # one is asked for several times: to look, for the truth, for the lists of units
def _parsed(text: str, name: str, encoding: str) -> dict[str, Any]:
    """The types a schema defines, by name. Raises whatever rosbags does."""
    # Imported here: recordings of other kinds have no use for it.
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if encoding != "ros2idl":
        return dict(get_types_from_msg(_SEPARATOR.sub("=" * 80, text), name))
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
