"""JSON messages of any schema, taken apart into columns, many messages at once."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import NoneType
from typing import Any

import numpy as np
import orjson

from copem_replay.core.tracks import Float, Int
from copem_replay.io.encodings.columns import Definition, Level, Shredded, Texts, as_text, batches, level_of, levels_to
from copem_replay.io.encodings.raw_values import joined

_DEEPEST = 12
"""Levels of values within values that are offered (chosen)."""
_MOST_FIELDS = 20_000
"""So many are offered of a message (chosen)."""
_LOOKED_AT = 20
"""Messages with something in a list that a channel is judged by, and items of each list (chosen)."""
_LOOKED_AT_MOST = 2000
"""Messages, whatever they hold (chosen: minutes of empty lists)."""
_LATER = 50
"""Of those after, evenly spaced, where a list was empty so far (chosen)."""
_BATCH_BYTES = 30_000
"""Of messages that are trees at the same time: larger heaps of them leave the cache (chosen: the fastest of some)."""
_INEXACT = 2.0**63
"""A number as large may have been a whole one, with digits that orjson drops and `json` does not."""
_UNLIKE = (TypeError, ValueError, AttributeError, RecursionError, OverflowError)
"""What is raised at messages that are not what the others are."""


class JsonDefinition(Definition):
    """JSON messages, judged by some of them: a schema need not be there, nor be kept to."""

    def __init__(self, samples: Sequence[bytes]) -> None:
        super().__init__()
        self._filled: dict[str, bool] = {}  # of each list, whether a message had something in it
        telling = 0
        later: Sequence[bytes] = ()
        for number, payload in enumerate(samples[:_LOOKED_AT_MOST], 1):
            telling += self._look_at(payload)
            if telling == _LOOKED_AT:
                later = samples[number:]
                break
        for payload in later[:: max(1, len(later) // _LATER)]:
            if all(self._filled.values()):
                break
            self._look_at(payload)

    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> Shredded:
        """Take messages apart. Raises KeyError for a path that is not offered."""
        numbers, texts = tuple(dict.fromkeys(numbers)), tuple(dict.fromkeys(texts))
        self._known((*numbers, *texts))
        table = _Table(numbers, texts)
        decoded = np.zeros(len(payloads), dtype=bool)
        for batch in batches(payloads, _BATCH_BYTES):
            trees = [_quickly(payload) for payload in payloads[batch]]
            there = batch.start + np.flatnonzero([tree is not None for tree in trees])
            try:
                table.add([tree for tree in trees if tree is not None], there, exact=False)
                decoded[there] = True
            except _UNLIKE:  # of one of them; which, is seen one by one
                for number in there.tolist():
                    decoded[number] = table.add_one(payloads[number], number)
        return Shredded(table.levels(), decoded)

    def _look_at(self, payload: bytes) -> bool:
        """Note what a message holds; whether it is more than empty lists."""
        message = _quickly(payload)
        lists: list[bool] = []
        self._explore(message, "", lists)
        return message is not None and (any(lists) or not lists)

    def _explore(self, value: Any, path: str, lists: list[bool], depth: int = 0) -> None:
        """Note all leaves below a value, and of each list whether there is something in it."""
        if depth > _DEEPEST or len(self._offers) >= _MOST_FIELDS:
            return
        if isinstance(value, dict):
            for name, inner in value.items():
                if name and not _NO_NAME.search(name):
                    self._explore(inner, f"{path}.{name}" if path else name, lists, depth + 1)
        elif isinstance(value, list):
            lists.append(bool(value))
            self._filled[path] = self._filled.get(path, False) or bool(value)
            for item in value[:_LOOKED_AT]:
                self._explore(item, f"{path}[]", lists, depth + 1)
        elif value is not None and self._offers.get(path) != "text":
            self._offers[path] = "text" if isinstance(value, str) else "number"


_NO_NAME = re.compile(r"[][.]")
"""What paths are made of: a field with such a name cannot be named."""


def _exactly(payload: bytes) -> Any:
    """A message, None for what is none."""
    try:
        message = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict | list) else None


def _quickly(payload: bytes) -> Any:
    """The same; whole numbers beyond 64 bits may be rounded. NaN, say, orjson leaves to `json`."""
    try:
        message = orjson.loads(payload)
    except ValueError:
        return _exactly(payload)
    return message if isinstance(message, dict | list) else None


class _Place:
    """Where in a message something is wanted: the fields to step into, and what is to be taken at them."""

    def __init__(self) -> None:
        self.fields: dict[str, _Place] = {}
        self.item: _Place | None = None  # of a list
        self.level = ""
        self.number: str | None = None  # the path whose column this is
        self.text: str | None = None


class _Table:
    """The rows of all levels while they are gathered."""

    def __init__(self, numbers: Sequence[str], texts: Sequence[str]) -> None:
        self._root = _planned(numbers, texts)
        self._parents: dict[str, list[Int]] = {name: [] for name in levels_to((*numbers, *texts))}
        self._rows = dict.fromkeys(self._parents, 0)
        self._numbers: dict[str, list[Float]] = {path: [] for path in numbers}
        self._codes: dict[str, list[Int]] = {path: [] for path in texts}
        self._words: dict[str, dict[str, int]] = {path: {} for path in texts}

    def add(self, trees: Sequence[Any], number: Int, *, exact: bool) -> None:
        """Messages of these numbers. Raises one of `_UNLIKE`, and then adds nothing."""
        found = _Batch({"": number}, self._rows, exact)
        found.visit(self._root, trees)
        for name, parent in found.parents.items():
            self._parents[name].append(parent)
            self._rows[name] += len(parent)
        for path, column in found.numbers.items():
            self._numbers[path].append(column)
        for path, said in found.texts.items():
            words = self._words[path]
            code = [-1 if word is None else words.setdefault(word, len(words)) for word in said]
            self._codes[path].append(np.array(code, dtype=np.int64))

    def add_one(self, payload: bytes, number: int) -> bool:
        """A message; whether it is like the others."""
        try:
            self.add([_exactly(payload)], np.array([number]), exact=True)
        except _UNLIKE:
            return False
        return True

    def levels(self) -> dict[str, Level]:
        """All that was gathered."""
        made = {name: Level(joined(parts, np.int64), {}, {}) for name, parts in self._parents.items()}
        for path, columns in self._numbers.items():
            made[level_of(path)].numbers[path] = joined(columns, np.float64)
        for path, codes in self._codes.items():
            made[level_of(path)].texts[path] = Texts(joined(codes, np.int64), tuple(self._words[path]))
        return made


class _Batch:
    """What some messages hold: the parents of its rows by level, and columns by path; all values of a path at once."""

    def __init__(self, parents: dict[str, Int], before: Mapping[str, int], exact: bool) -> None:
        self.parents, self._before, self._exact = parents, before, exact
        self.numbers: dict[str, Float] = {}
        self.texts: dict[str, list[str | None]] = {}

    def visit(self, place: _Place, values: Sequence[Any]) -> None:
        """Take what is wanted at a place, from its value in every row; None: it has none there."""
        if place.number is not None:
            self.numbers[place.number] = _numbers(values)
        if place.text is not None:
            self.texts[place.text] = [
                v if v is None or (type(v) is str and v.isascii()) else self._text(v) for v in values
            ]
        for name, inner in place.fields.items():
            self.visit(inner, [None if v is None else v.get(name) for v in values])
        if place.item is not None:
            if not {*map(type, values)} <= {list, NoneType}:
                raise TypeError("expected a list")
            number = [0 if v is None else len(v) for v in values]
            row = self._before[place.level] + np.arange(len(values))
            self.parents[place.item.level] = np.repeat(row, number)
            self.visit(place.item, list(itertools.chain.from_iterable(v for v in values if v)))

    def _text(self, value: Any) -> str:
        if isinstance(value, bool):
            return "true" if value else "false"
        if isinstance(value, float) and not self._exact and abs(value) >= _INEXACT:
            raise ValueError("a number that may have had more digits")
        if isinstance(value, float | int):
            return as_text(value)
        if isinstance(value, str):
            return value.encode(errors="replace").decode()  # half a surrogate is no text
        raise TypeError("expected a text, found a structure")


def _numbers(values: Sequence[Any]) -> Float:
    if {*map(type, values)} <= {float, int, bool, NoneType}:
        return np.array(values, dtype=np.float64)
    return np.array([np.nan if v is None else _number(v) for v in values], dtype=np.float64)


def _number(value: Any) -> float:
    """A number, or a text that is one (MSight writes such); NaN for a text that is none."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return np.nan
    return float(value)


def _planned(numbers: Sequence[str], texts: Sequence[str]) -> _Place:
    root = _Place()
    for path, is_text in (*((p, False) for p in numbers), *((p, True) for p in texts)):
        place = root
        for step in _steps(path):
            if step == "[]":
                if place.item is None:
                    place.item = _Place()
                place = place.item
            else:
                place = place.fields.setdefault(step, _Place())
        if is_text:
            place.text = path
        else:
            place.number = path
    _name_levels(root, "", "")
    return root


def _steps(path: str) -> Iterator[str]:
    """`a.b[].c` → a, b, [], c."""
    for part in path.split("."):
        name = part.rstrip("[]")
        if name:
            yield name
        yield from ["[]"] * part.count("[]")


def _name_levels(place: _Place, path: str, level: str) -> None:
    place.level = level
    for name, inner in place.fields.items():
        _name_levels(inner, f"{path}.{name}" if path else name, level)
    if place.item is not None:
        _name_levels(place.item, f"{path}[]", f"{path}[]")
