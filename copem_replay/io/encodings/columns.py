"""Columns of messages of any schema: one table for each list on the way to the fields that are asked for.

A *path* names a field from the message down, `objects[].kinematics.pose.position.x`; `[]` stands for each item of a
list. Its *level* is the path up to its last `[]`: `""` for the message itself, `objects[]`,
`objects[].classification[]`. Every level is a table; a row knows the row of the level above that it belongs to. Code
that reads a format works on these columns, whatever the encoding of the messages.

A `Definition` makes the columns of one encoding. The walks through CDR and protobuf know no types: they give the bits
of numbers and the places of texts, of which `walk_columns` makes columns.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.io.decoded_size import check_decoded_bytes


@dataclass(frozen=True)
class DistinctTexts:
    """R texts, each distinct one stored once."""

    code: Int  # (R,) index into words; −1: not said
    words: tuple[str, ...]


@dataclass(frozen=True)
class LevelRows:
    """R rows of one list: `parent (R,)` is the row of the level above (of the message: its number)."""

    parent: Int
    numbers: dict[str, Float]  # (R,) by path; NaN: not said
    texts: dict[str, DistinctTexts]  # by path; whole numbers as digits, bytes as hexadecimal digits


@dataclass(frozen=True)
class ShreddedMessages:
    """F messages: `levels` by name, and which of the messages could be decoded; the others have no rows."""

    levels: dict[str, LevelRows]
    decoded: Bool  # (F,)


class Definition(ABC):
    """The fields of the messages of one channel, and how messages are decoded into columns."""

    def __init__(self) -> None:
        self._offers: dict[str, str] = {}

    def offers(self) -> dict[str, str]:
        """The kind of each leaf by its path: `number` or `text`."""
        return self._offers

    def names(self, path: str) -> Mapping[int, str]:
        """The names of an enumeration by their numbers; empty for any other field."""
        return {}

    def picks(self, path: str) -> bool:
        """Whether `shred` itself takes this path, in which an item of a list is chosen."""
        return False

    @abstractmethod
    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> ShreddedMessages:
        """The columns of messages. Raises KeyError for a path that is neither offered nor picked."""

    def _known(self, paths: Iterable[str]) -> list[str]:
        """The paths, each once. Raises KeyError for one that is neither offered nor picked."""
        unique = list(dict.fromkeys(paths))
        for path in unique:
            if path not in self._offers and not self.picks(path):
                raise KeyError(path)
        return unique


def shred_messages(
    definition: Definition, payloads: Sequence[bytes], numbers: Iterable[str] = (), texts: Iterable[str] = ()
) -> ShreddedMessages:
    """The columns of messages; a path may name one item of a list, `position[0]`, counted from 0.

    Such a column is of the level that is left when the item is chosen: `objects[].position[0]` of `objects[]`,
    `sensors[0].objects[].x` of `sensors[0].objects[]`. Raises KeyError for a path that is not offered.
    """
    numbers, texts = tuple(numbers), tuple(texts)
    item_paths = [p for p in dict.fromkeys((*numbers, *texts)) if _ITEM.search(p) and not definition.picks(p)]
    source_paths = [[any_item_path(p) if p in item_paths else p for p in paths] for paths in (numbers, texts)]
    shredded = definition.shred(payloads, *source_paths)
    levels = dict(shredded.levels)
    chosen_rows: dict[str, Int] = {}
    for path in item_paths:
        level = list_level(path)
        _choose_level(levels, chosen_rows, level)
        source = list_level(any_item_path(path))
        rows = np.arange(len(levels[source].parent))
        ancestors, inner = rows, source
        for step in reversed(_chosen_items(path)):
            is_item = _place_in_parent(levels[inner].parent)[ancestors] == step
            rows, ancestors = rows[is_item], levels[inner].parent[ancestors[is_item]]
            inner = parent_level(inner)
        target_rows = ancestors
        if level in chosen_rows:  # its rows are some of those of the whole level
            number = np.full(len(levels[inner].parent), -1)
            number[chosen_rows[level]] = np.arange(len(chosen_rows[level]))
            target_rows = number[ancestors]
            rows, target_rows = rows[target_rows >= 0], target_rows[target_rows >= 0]
        levels[level] = _add_items(levels[level], levels[source], path, target_rows, rows)
    return ShreddedMessages(levels, shredded.decoded)


COLUMN_BYTES = 17
"""Memory of a value while messages are walked through: its bits, its length, and whether it is there."""
BATCH_BYTES = 4_000_000
"""Bytes of messages that are decoded at once: as much as a cache holds."""


def split_batches(payloads: Sequence[bytes], most_bytes: int | None = None) -> Iterator[slice]:
    """Slices of messages of about `most_bytes` each, None: `BATCH_BYTES`."""
    most_bytes = BATCH_BYTES if most_bytes is None else most_bytes
    first, size = 0, 0
    for k, payload in enumerate(payloads):
        size += len(payload)
        if size > most_bytes:
            yield slice(first, k + 1)
            first, size = k + 1, 0
    if first < len(payloads):
        yield slice(first, len(payloads))


_ITEM = re.compile(r"\[(\d{1,9})\]")


def any_item_path(path: str) -> str:
    """The path with every item of its lists: `position[]` of `position[0]`."""
    return _ITEM.sub("[]", path)


def _chosen_items(path: str) -> list[int]:
    """The items chosen after the last `[]`: 1 and 0 of `objects[].b[1].c[0]`."""
    return [int(k) for k in _ITEM.findall(path[len(list_level(path)) :])]


def _choose_level(levels: dict[str, LevelRows], chosen_rows: dict[str, Int], name: str) -> None:
    """Add the level `name` and its parents to `levels`, with only the list items that its path chooses (`[k]`);
    `chosen_rows`: their rows in the level of all items.
    """
    if name in levels:
        return
    outer = parent_level(name)
    _choose_level(levels, chosen_rows, outer)
    all_items = any_item_path(name)
    rows = np.arange(len(levels[all_items].parent))
    ancestors, inner = levels[all_items].parent, parent_level(all_items)
    for step in reversed(_chosen_items(name.removesuffix("[]"))):
        matches = _place_in_parent(levels[inner].parent)[ancestors] == step
        rows, ancestors = rows[matches], levels[inner].parent[ancestors[matches]]
        inner = parent_level(inner)
    if outer in chosen_rows:
        number = np.full(len(levels[inner].parent), -1)
        number[chosen_rows[outer]] = np.arange(len(chosen_rows[outer]))
        matches = number[ancestors] >= 0
        rows, ancestors = rows[matches], number[ancestors[matches]]
    levels[name], chosen_rows[name] = LevelRows(ancestors, {}, {}), rows


def _place_in_parent(parent: Int) -> Int:
    """(R,) the number of each item in its list; items of one list lie together."""
    first = np.flatnonzero(np.diff(parent, prepend=-1))
    return np.arange(len(parent)) - np.repeat(first, np.diff(np.append(first, len(parent))))


def _add_items(target: LevelRows, source: LevelRows, path: str, target_rows: Int, source_rows: Int) -> LevelRows:
    """`target` with the column `path` added: rows `source_rows` the source at rows `target_rows`."""
    numbers, texts, array_path = dict(target.numbers), dict(target.texts), any_item_path(path)
    if array_path in source.numbers:
        numbers[path] = np.full(len(target.parent), np.nan)
        numbers[path][target_rows] = source.numbers[array_path][source_rows]
    if array_path in source.texts:
        code = np.full(len(target.parent), -1)
        code[target_rows] = source.texts[array_path].code[source_rows]
        texts[path] = DistinctTexts(code, source.texts[array_path].words)
    return LevelRows(target.parent, numbers, texts)


def format_number(value: float) -> str:
    """A number as text: a whole one as digits, another so that reading it gives the same number."""
    if isinstance(value, int) or (value.is_integer() and abs(value) < _WHOLE):
        return str(int(value))
    return repr(float(value))


_WHOLE = 1e18  # larger floats are not written as digits: a 64-bit integer would not hold them all


def list_level(path: str) -> str:
    """The level of a path: `objects[]` of `objects[].pose.x`."""
    head, bracket, _ = path.rpartition("[]")
    return head + bracket


def parent_level(level: str) -> str:
    """The level that holds a list: `objects[]` of `objects[].classification[]`, the message (`""`) of `objects[]`."""
    return list_level(level.removesuffix("[]"))


def list_levels(paths: Iterable[str]) -> list[str]:
    """All levels that lead to these paths, the outer ones first; the message (`""`) is always among them."""
    levels = {""}
    for path in paths:
        level = list_level(path)
        while level not in levels:
            levels.add(level)
            level = parent_level(level)
    return sorted(levels, key=lambda name: (name.count("[]"), name))


def ancestor_rows(shredded: ShreddedMessages, level: str, ancestor: str) -> NDArray[np.int64]:
    """(R,) for each row of `level` its row in `ancestor`, a level above it or itself."""
    row = np.arange(len(shredded.levels[level].parent))
    while level != ancestor:
        row = shredded.levels[level].parent[row]
        level = parent_level(level)
    return row


def common_level(level: str, second: str) -> str:
    """The innermost level that both levels are in."""
    outer_levels = {level, ""}
    while level:
        level = parent_level(level)
        outer_levels.add(level)
    while second not in outer_levels:
        second = parent_level(second)
    return second


# Raw values of messages, the bits of numbers and the bytes of texts, made into columns.


@dataclass(frozen=True)
class ValueKind:
    """The kind of a column's values.

    `how`: NumPy's type of the bits of a number (`f8`), or `bool`, `zigzag` (a signed number as in protobuf's sint),
    `text`, `ended` (a text up to the zeros at its end), `bytes`. `names`: those of an enumeration by their numbers.
    """

    how: str
    names: Mapping[int, str] = field(default_factory=dict)

    @property
    def is_number(self) -> bool:
        """Whether the values are numbers."""
        return self.how not in ("text", "ended", "bytes")


class _RawColumn:
    """The values of one path, gathered batch by batch."""

    def __init__(self, kind: ValueKind) -> None:
        self._kind = kind
        self._values: list[Any] = []
        self._codes: list[Int] = []
        self._said: list[Bool] = []
        self._code_of: dict[bytes, int] = {}

    def add(self, data: bytes, bits: Any, lengths: Int, is_present: Bool) -> None:
        """Add a batch: bits of numbers, or places of texts in `data` and their `lengths`; which rows have a value."""
        self._said.append(is_present)
        if self._kind.is_number:
            self._values.append(_decode_numbers(bits, self._kind.how))
            return
        code_of = self._code_of
        parts = [data[b : b + n] for b, n in zip(bits.tolist(), lengths.tolist(), strict=True)]
        self._codes.append(np.array([code_of.setdefault(p, len(code_of)) for p in parts], dtype=np.int64))

    def numbers(self) -> Float:
        """All values as numbers; NaN: no value, or no number."""
        if self._kind.is_number:
            with np.errstate(invalid="ignore"):  # some NaN of float32
                values: Float = join_arrays(self._values, np.float64).astype(np.float64)
        else:
            of_code = np.array([_parse_number(p, self._kind.how) for p in self._code_of], dtype=np.float64)
            values = of_code[join_arrays(self._codes, np.int64)]
        values[~join_arrays(self._said, bool)] = np.nan
        return values

    def texts(self) -> DistinctTexts:
        """All values as texts: distinct ones, and by row the index (code) of its text; −1: no value."""
        code: Int
        if self._kind.is_number:
            values, code = np.unique(join_arrays(self._values, np.float64), return_inverse=True)
            words = [self._word_of_number(v) for v in values.tolist()]
        else:
            code = join_arrays(self._codes, np.int64)
            words = [_format_text(p, self._kind.how) for p in self._code_of]
        distinct = dict.fromkeys(words)  # different bytes may be the same text
        number = {word: k for k, word in enumerate(distinct)}
        code = np.array([number[w] for w in words], dtype=np.int64)[code]
        code[~join_arrays(self._said, bool)] = -1
        return DistinctTexts(code, tuple(distinct))

    def _word_of_number(self, value: Any) -> str:
        if self._kind.how == "bool":
            return "true" if value else "false"
        return self._kind.names.get(value) or format_number(value)


Walk = Callable[[NDArray[np.uint8], Int, Int, Int, Any, Int, Bool, Int], Int]
"""(L,) number of rows of each level, by a walk through messages m, `data[bounds[m]:bounds[m + 1]]`.

Arguments: data, bounds, `first`, `room`, `bits`, `lengths`, `said`, `parent`. `room (L,)`: rows there is room for; more
are counted and not kept. The value of column c in row r of its level goes to `bits[first[c] + r]`, with `said`;
of a text that is its begin, and `lengths` has its length. `parent[l, r]` is the parent of row r of level l; level 0 is
the message. A message that cannot be decoded leaves no rows.
"""


def walk_columns(
    walk: Walk,
    batches: Iterable[tuple[Int, Sequence[bytes]]],
    kinds: Mapping[str, ValueKind],
    numbers: Collection[str],
    texts: Collection[str],
    count: int,
) -> ShreddedMessages:
    """The columns of `count` messages, from batches of their numbers and payloads. Raises OversizeError.

    `kinds`: of the values of each path, in the order of the walk's columns.
    """
    names = list_levels(kinds)
    level_ix = np.array([names.index(list_level(path)) for path in kinds], dtype=np.int64)
    columns = {path: _RawColumn(kind) for path, kind in kinds.items()}
    parents: dict[str, list[Int]] = {name: [] for name in names}
    rows = np.zeros(len(names), dtype=np.int64)
    for number, payloads in batches:
        data = b"".join(payloads)
        batch_rows, batch_columns, parent = _walk_batch(walk, data, list(map(len, payloads)), level_ix, len(names))
        for k, name in enumerate(names):
            owner = parent[k, : batch_rows[k]]
            parents[name].append(owner + rows[names.index(parent_level(name))] if name else number[owner])
        for column, values in zip(columns.values(), batch_columns, strict=True):
            column.add(data, *values)
        rows += batch_rows
    levels = {name: LevelRows(join_arrays(parts, np.int64), {}, {}) for name, parts in parents.items()}
    for path, column in columns.items():
        if path in numbers:
            levels[list_level(path)].numbers[path] = column.numbers()
        if path in texts:
            levels[list_level(path)].texts[path] = column.texts()
    decoded = np.zeros(count, dtype=bool)
    decoded[levels[""].parent] = True
    return ShreddedMessages(levels, decoded)


def _walk_batch(
    walk: Walk, data: bytes, sizes: Sequence[int], level_ix: Int, levels: int
) -> tuple[Int, list[tuple[Any, Int, Bool]], Int]:
    """Number of rows of each level; bits, lengths and presence of each column; parents (levels, most rows)."""
    octets, bounds = np.frombuffer(data, dtype=np.uint8), np.cumsum([0, *sizes], dtype=np.int64)
    first = np.zeros(len(level_ix) + 1, dtype=np.int64)

    def walk_into(room: Int, size: int, most: int) -> tuple[Int, Any, Int, Bool, Int]:
        bits, lengths = np.zeros(size, dtype=np.uint64), np.zeros(size, dtype=np.int64)
        is_present, parent = np.zeros(size, dtype=bool), np.empty((levels, most), dtype=np.int64)
        return walk(octets, bounds, first, room, bits, lengths, is_present, parent), bits, lengths, is_present, parent

    rows = walk_into(np.zeros(levels, dtype=np.int64), 0, 0)[0]  # counts them
    most = int(rows.max(initial=0))
    np.cumsum(rows[level_ix], out=first[1:])
    check_decoded_bytes(COLUMN_BYTES * int(first[-1]) + 8 * levels * most)
    _, bits, lengths, is_present, parent = walk_into(rows, int(first[-1]), most)
    parts = [slice(*ends) for ends in pairwise(first.tolist())]
    return rows, [(bits[p], lengths[p], is_present[p]) for p in parts], parent


def join_arrays(parts: Sequence[Any], kind: Any) -> Any:
    """The arrays concatenated; an empty one of type `kind` if there are none."""
    return np.concatenate(parts) if parts else np.zeros(0, dtype=kind)


def _decode_numbers(bits: Any, how: str) -> Any:
    if how == "bool":
        return bits.astype(np.uint8)
    if how == "zigzag":
        return (bits >> np.uint64(1)).view(np.int64) ^ -(bits & np.uint64(1)).view(np.int64)
    return bits.astype(f"u{how[1]}", copy=False).view(how)


def _parse_number(text: bytes, how: str) -> float:
    try:
        return float(_decode_text(text, how))
    except ValueError:
        return np.nan


def _format_text(text: bytes, how: str) -> str:
    return text.hex() if how == "bytes" else _decode_text(text, how)


def _decode_text(text: bytes, how: str) -> str:
    return (text if how == "text" else text.rstrip(b"\0")).decode(errors="replace")
