"""JSON messages of any schema, decoded into columns, many messages at once.

A channel's fields are those of some of its messages: a JSON channel need not have a schema, nor keep to it.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from types import NoneType
from typing import Any

import numpy as np
import orjson

from copem_replay.core.tracks import Float, Int
from copem_replay.io.decoded_size import check_json
from copem_replay.io.encodings.columns import (
    Definition,
    DistinctTexts,
    LevelRows,
    ShreddedMessages,
    format_number,
    join_arrays,
    list_level,
    list_levels,
    split_batches,
)

_DEEPEST = 12
"""Levels of values within values that are offered; object lists have about five."""
_MOST_FIELDS = 20_000
"""Most fields that are offered of a channel: bounds the search where names of fields are data."""
_LOOKED_AT = 20
"""Messages with an item in a list by which a channel is judged, and items of each list; more make opening slower."""
_LOOKED_AT_MOST = 2000
"""Most messages at the start, with or without items: minutes of empty lists."""
_LATER = 50
"""Messages after those, evenly spaced, that are looked at while a list was empty in all before."""
_BATCH_BYTES = 30_000
"""Bytes of messages that are trees at the same time: larger heaps of trees leave the cache and are slower."""
_INEXACT = 2.0**63
"""A number as large may have been a whole one, with digits that orjson drops and `json` keeps."""
_UNLIKE = (TypeError, ValueError, AttributeError, RecursionError, OverflowError)
"""Errors at messages of another structure than the others."""


class JsonDefinition(Definition):
    """The definition of JSON messages, from some of them. Raises OversizeError."""

    def __init__(self, samples: Sequence[bytes]) -> None:
        super().__init__()
        for payload in samples:
            check_json(payload)
        self._filled: dict[str, bool] = {}  # of each list, whether a message had something in it
        telling = 0
        more_samples: Sequence[bytes] = ()
        for number, payload in enumerate(samples[:_LOOKED_AT_MOST], 1):
            telling += self._look_at(payload)
            if telling == _LOOKED_AT:
                more_samples = samples[number:]
                break
        for payload in more_samples[:: max(1, len(more_samples) // _LATER)]:
            if all(self._filled.values()):
                break
            self._look_at(payload)

    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> ShreddedMessages:
        """The columns of messages. Raises KeyError: a path is not offered; OversizeError."""
        for payload in payloads:
            check_json(payload)
        numbers, texts = tuple(dict.fromkeys(numbers)), tuple(dict.fromkeys(texts))
        self._known((*numbers, *texts))
        table = _RowTable(numbers, texts)
        decoded = np.zeros(len(payloads), dtype=bool)
        for batch in split_batches(payloads, _BATCH_BYTES):
            trees = [_parse_quickly(payload) for payload in payloads[batch]]
            numbers_in_batch = batch.start + np.flatnonzero([tree is not None for tree in trees])
            try:
                table.add([tree for tree in trees if tree is not None], numbers_in_batch, exact=False)
                decoded[numbers_in_batch] = True
            except _UNLIKE:  # one of them is unlike the others: one by one tells which
                for number in numbers_in_batch.tolist():
                    decoded[number] = table.add_one(payloads[number], number)
        return ShreddedMessages(table.levels(), decoded)

    def _look_at(self, payload: bytes) -> bool:
        """Add the fields of a message to the offered ones; whether it holds more than empty lists."""
        message = _parse_quickly(payload)
        lists: list[bool] = []
        self._explore(message, "", lists)
        return message is not None and (any(lists) or not lists)

    def _explore(self, value: Any, path: str, lists: list[bool], depth: int = 0) -> None:
        """Add all leaves below a value to the offered paths; `lists` gets whether each list on the way has items."""
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
"""Characters that paths are made of: no path can name a field with them in its name."""


def _parse_exactly(payload: bytes) -> Any:
    """The message in a payload, with exact whole numbers; None: it is no JSON object or list."""
    try:
        message = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict | list) else None


def _parse_quickly(payload: bytes) -> Any:
    """The message in a payload; None: it is no JSON object or list. Whole numbers beyond 64 bits may be rounded.

    What orjson refuses, such as NaN, is parsed by `json`.
    """
    try:
        message = orjson.loads(payload)
    except ValueError:
        return _parse_exactly(payload)
    return message if isinstance(message, dict | list) else None


class _WantedPlace:
    """A place in a message on the way to wanted paths: the fields to step into, and the columns to take here."""

    def __init__(self, level: str) -> None:
        self.level, self.fields = level, dict[str, _WantedPlace]()
        self.item: _WantedPlace | None = None  # of a list
        self.number: str | None = None  # the path whose column this is
        self.text: str | None = None


class _RowTable:
    """The rows of all levels, gathered batch by batch."""

    def __init__(self, numbers: Sequence[str], texts: Sequence[str]) -> None:
        self._root = _plan_places(numbers, texts)
        self._parents: dict[str, list[Int]] = {name: [] for name in list_levels((*numbers, *texts))}
        self._rows = dict.fromkeys(self._parents, 0)
        self._numbers: dict[str, list[Float]] = {path: [] for path in numbers}
        self._codes: dict[str, list[Int]] = {path: [] for path in texts}
        self._words: dict[str, dict[str, int]] = {path: {} for path in texts}

    def add(self, trees: Sequence[Any], number: Int, *, exact: bool) -> None:
        """Add decoded messages (`trees`) as rows; `number`: of each. Raises one of `_UNLIKE`, then nothing is added."""
        batch = _Batch({"": number}, self._rows, exact)
        batch.visit(self._root, trees)
        for name, parent in batch.parents.items():
            self._parents[name].append(parent)
            self._rows[name] += len(parent)
        for path, column in batch.numbers.items():
            self._numbers[path].append(column)
        for path, values in batch.texts.items():
            words = self._words[path]
            code = [-1 if word is None else words.setdefault(word, len(words)) for word in values]
            self._codes[path].append(np.array(code, dtype=np.int64))

    def add_one(self, payload: bytes, number: int) -> bool:
        """Add one message; False: it is unlike the others, and nothing is added."""
        try:
            self.add([_parse_exactly(payload)], np.array([number]), exact=True)
        except _UNLIKE:
            return False
        return True

    def levels(self) -> dict[str, LevelRows]:
        """The levels with all rows that were added."""
        levels = {name: LevelRows(join_arrays(parts, np.int64), {}, {}) for name, parts in self._parents.items()}
        for path, columns in self._numbers.items():
            levels[list_level(path)].numbers[path] = join_arrays(columns, np.float64)
        for path, codes in self._codes.items():
            levels[list_level(path)].texts[path] = DistinctTexts(join_arrays(codes, np.int64), tuple(self._words[path]))
        return levels


class _Batch:
    """The rows of some messages: parents by level, and columns by path; all values of a path are taken at once."""

    def __init__(self, parents: dict[str, Int], before: Mapping[str, int], exact: bool) -> None:
        self.parents, self._before, self._exact = parents, before, exact
        self.numbers: dict[str, Float] = {}
        self.texts: dict[str, list[str | None]] = {}

    def visit(self, place: _WantedPlace, values: Sequence[Any]) -> None:
        """Take the wanted columns at and below a place of the tree; `values`: there in each row, None: it has none."""
        if place.number is not None:
            self.numbers[place.number] = _convert_numbers(values)
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
            return format_number(value)
        if isinstance(value, str):
            return value.encode(errors="replace").decode()  # half a surrogate is no text
        raise TypeError("expected a text, found a structure")


def _convert_numbers(values: Sequence[Any]) -> Float:
    if {*map(type, values)} <= {float, int, bool, NoneType}:
        return np.array(values, dtype=np.float64)
    return np.array([np.nan if v is None else _convert_number(v) for v in values], dtype=np.float64)


def _convert_number(value: Any) -> float:
    """A number, or a text that is one (MSight writes such); NaN for a text that is none."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return np.nan
    return float(value)


def _plan_places(numbers: Sequence[str], texts: Sequence[str]) -> _WantedPlace:
    """The tree of wanted places, by field names and list items, from the paths of numbers and texts."""
    root = _WantedPlace("")
    for path, is_text in (*((p, False) for p in numbers), *((p, True) for p in texts)):
        place, prefix = root, ""
        for part in path.split("."):
            name = part.rstrip("[]")
            if name:
                prefix = f"{prefix}.{name}" if prefix else name
                place = place.fields.setdefault(name, _WantedPlace(place.level))
            for _ in range(part.count("[]")):
                prefix += "[]"
                place.item = place.item or _WantedPlace(prefix)
                place = place.item
        if is_text:
            place.text = path
        else:
            place.number = path
    return root
