"""Messages of any schema taken apart into columns: one table per list that was asked into.

A *path* names a field from the message down, `objects[].kinematics.pose.position.x`; `[]` stands for each item of a
list. Its *level* is the path up to its last `[]`: `""` for the message itself, `objects[]`,
`objects[].classification[]`. Every level is a table; a row knows the row of the level above that it belongs to. So
whoever reads a format works on columns, whatever the messages were encoded in.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Bool, Float, Int


@dataclass(frozen=True)
class Texts:
    """R texts, each distinct one kept once."""

    code: Int  # (R,) index into words; −1: not said
    words: tuple[str, ...]


@dataclass(frozen=True)
class Level:
    """R rows of one list: `parent (R,)` is the row of the level above (of the message: its number)."""

    parent: Int
    numbers: dict[str, Float]  # (R,) by path; NaN: not said
    texts: dict[str, Texts]  # by path; whole numbers as digits, bytes as hexadecimal digits


@dataclass(frozen=True)
class Shredded:
    """F messages: `levels` by name, and which of the messages could be decoded; the others have no rows."""

    levels: dict[str, Level]
    decoded: Bool  # (F,)


class Definition(ABC):
    """What messages of one channel look like. Made from the schema inside the recording."""

    def __init__(self) -> None:
        self._offers: dict[str, str] = {}

    def offers(self) -> dict[str, str]:
        """The paths of all leaves, and what each is: `number`, `text`."""
        return self._offers

    def names(self, path: str) -> Mapping[int, str]:
        """The names of the numbers of an enumeration, empty for what is none."""
        return {}

    def picks(self, path: str) -> bool:
        """Whether `shred` takes this path, with an item chosen in it, as it is."""
        return False

    @abstractmethod
    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> Shredded:
        """Take messages apart. Raises KeyError for a path that is neither offered nor picked."""

    def _known(self, paths: Iterable[str]) -> list[str]:
        """Each path once. Raises KeyError."""
        wanted = list(dict.fromkeys(paths))
        for path in wanted:
            if path not in self._offers and not self.picks(path):
                raise KeyError(path)
        return wanted


def take_apart(
    definition: Definition, payloads: Sequence[bytes], numbers: Iterable[str] = (), texts: Iterable[str] = ()
) -> Shredded:
    """Take messages apart; a path may name one item of a list, `position[0]`, counted from 0.

    Such a column is of the level that is left when the item is chosen: `objects[].position[0]` of `objects[]`,
    `sensors[0].objects[].x` of `sensors[0].objects[]`. Raises KeyError for a path that is not offered.
    """
    numbers, texts = tuple(numbers), tuple(texts)
    picked = [p for p in dict.fromkeys((*numbers, *texts)) if _ITEM.search(p) and not definition.picks(p)]
    whole = [[any_item(p) if p in picked else p for p in paths] for paths in (numbers, texts)]
    found = definition.shred(payloads, *whole)
    levels = dict(found.levels)
    chosen: dict[str, Int] = {}
    for path in picked:
        level = level_of(path)
        _choose_level(levels, chosen, level)
        source = level_of(any_item(path))
        rows = np.arange(len(levels[source].parent))
        at, inner = rows, source
        for step in reversed(_items_chosen(path)):
            good = _place_in_parent(levels[inner].parent)[at] == step
            rows, at = rows[good], levels[inner].parent[at[good]]
            inner = above(inner)
        to = at
        if level in chosen:  # its rows are some of those of the whole level
            number = np.full(len(levels[inner].parent), -1)
            number[chosen[level]] = np.arange(len(chosen[level]))
            to = number[at]
            rows, to = rows[to >= 0], to[to >= 0]
        levels[level] = _with_items(levels[level], levels[source], path, to, rows)
    return Shredded(levels, found.decoded)


BATCH_BYTES = 4_000_000
"""Of messages taken apart at once: what a cache holds (chosen)."""


def batches(payloads: Sequence[bytes], most_bytes: int | None = None) -> Iterator[slice]:
    """Messages in runs of some megabytes, or of about `most_bytes`."""
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


def any_item(path: str) -> str:
    """The path with every item of its lists: `position[]` of `position[0]`."""
    return _ITEM.sub("[]", path)


def _items_chosen(path: str) -> list[int]:
    """The items chosen after the last `[]`: 1 and 0 of `objects[].b[1].c[0]`."""
    return [int(k) for k in _ITEM.findall(path[len(level_of(path)) :])]


def _choose_level(levels: dict[str, Level], chosen: dict[str, Int], name: str) -> None:
    """Make the level `name`, and those above it, of the rows that lie in the items it names; note which those are."""
    if name in levels:
        return
    outer = above(name)
    _choose_level(levels, chosen, outer)
    whole = any_item(name)
    rows = np.arange(len(levels[whole].parent))
    at, inner = levels[whole].parent, above(whole)
    for step in reversed(_items_chosen(name.removesuffix("[]"))):
        good = _place_in_parent(levels[inner].parent)[at] == step
        rows, at = rows[good], levels[inner].parent[at[good]]
        inner = above(inner)
    if outer in chosen:
        number = np.full(len(levels[inner].parent), -1)
        number[chosen[outer]] = np.arange(len(chosen[outer]))
        good = number[at] >= 0
        rows, at = rows[good], number[at[good]]
    levels[name], chosen[name] = Level(at, {}, {}), rows


def _place_in_parent(parent: Int) -> Int:
    """(R,) the number of each item in its list; items of one list lie together."""
    first = np.flatnonzero(np.diff(parent, prepend=-1))
    return np.arange(len(parent)) - np.repeat(first, np.diff(np.append(first, len(parent))))


def _with_items(target: Level, source: Level, path: str, to: Int, of: Int) -> Level:
    """`target` with the column `path` added: rows `of` the source at rows `to`."""
    numbers, texts, whole = dict(target.numbers), dict(target.texts), any_item(path)
    if whole in source.numbers:
        numbers[path] = np.full(len(target.parent), np.nan)
        numbers[path][to] = source.numbers[whole][of]
    if whole in source.texts:
        code = np.full(len(target.parent), -1)
        code[to] = source.texts[whole].code[of]
        texts[path] = Texts(code, source.texts[whole].words)
    return Level(target.parent, numbers, texts)


def as_text(value: float) -> str:
    """A number as text: whole ones as digits, others so that nothing is lost."""
    if isinstance(value, int) or (value.is_integer() and abs(value) < _WHOLE):
        return str(int(value))
    return repr(float(value))


_WHOLE = 1e18  # floats beyond are not written as digits (chosen)


def level_of(path: str) -> str:
    """The list a path leads into: `objects[].pose.x` is of `objects[]`."""
    head, bracket, _ = path.rpartition("[]")
    return head + bracket


def above(level: str) -> str:
    """The level that holds a list: `objects[]` of `objects[].classification[]`, the message (`""`) of `objects[]`."""
    return level_of(level.removesuffix("[]"))


def levels_to(paths: Iterable[str]) -> list[str]:
    """All levels that lead to these paths, the outer ones first; the message (`""`) is always among them."""
    found = {""}
    for path in paths:
        level = level_of(path)
        while level not in found:
            found.add(level)
            level = above(level)
    return sorted(found, key=lambda name: (name.count("[]"), name))


def rows_above(shredded: Shredded, level: str, ancestor: str) -> NDArray[np.int64]:
    """(R,) for each row of `level` its row in `ancestor`, a level above it or itself."""
    row = np.arange(len(shredded.levels[level].parent))
    while level != ancestor:
        row = shredded.levels[level].parent[row]
        level = above(level)
    return row


def common_level(one: str, other: str) -> str:
    """The innermost level that both are in."""
    around = {one, ""}
    while one:
        one = above(one)
        around.add(one)
    while other not in around:
        other = above(other)
    return other
