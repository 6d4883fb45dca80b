"""JSON and protobuf messages of any schema, taken apart into columns.

Slower than what is written for one schema (`osi.py`), and for everybody's schemas.
"""

from __future__ import annotations

import itertools
import json
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError

from copem_replay.formats.cdr import DefinitionError
from copem_replay.formats.shred import Level, Shredded, Texts, as_text, level_of, levels_to

_DEEPEST = 12
"""Levels of messages within messages that are offered (chosen: definitions may refer to themselves)."""
_MOST_FIELDS = 20_000
"""So many are offered of a message (chosen)."""
_LOOKED_AT = 20
"""Messages without an empty list that a JSON channel is judged by, and items of each list (chosen)."""
_LOOKED_AT_MOST = 2000
"""Messages, whatever they hold (chosen: minutes of empty lists)."""


class _Columns:
    """The rows of one level while they are gathered."""

    def __init__(self) -> None:
        self.parent: list[int] = []
        self.numbers: dict[str, list[float]] = {}
        self.texts: dict[str, list[int]] = {}
        self.words: dict[str, dict[str, int]] = {}

    def cut(self, rows: int) -> None:
        """Leave out all rows from here on."""
        del self.parent[rows:]
        for numbers in self.numbers.values():
            del numbers[rows:]
        for texts in self.texts.values():
            del texts[rows:]

    def level(self) -> Level:
        """All that was gathered."""
        return Level(
            np.array(self.parent, dtype=np.int64),
            {path: np.array(column, dtype=np.float64) for path, column in self.numbers.items()},
            {
                path: Texts(np.array(column, dtype=np.int64), tuple(self.words[path]))
                for path, column in self.texts.items()
            },
        )


class _Node:
    """Where in a message something is wanted: the fields to step into, and what is to be taken at them."""

    def __init__(self) -> None:
        self.fields: dict[str, _Node] = {}
        self.item: _Node | None = None  # of a list
        self.level = ""
        self.number: str | None = None  # the path whose column this is
        self.text: str | None = None


class TreeDefinition(ABC):
    """Messages that are decoded into trees of values before anything is taken from them."""

    @abstractmethod
    def offers(self) -> dict[str, str]:
        """The paths of all leaves, and what each is: `number`, `text`."""

    def picks(self, path: str) -> bool:
        """Whether `shred` takes a path with an item chosen in it: never."""
        return False

    @abstractmethod
    def _decode(self, payload: bytes) -> Any:
        """The message, None for what is none."""

    @abstractmethod
    def _child(self, node: Any, name: str) -> Any:
        """The value of a field, None where there is none."""

    def shred(self, payloads: Sequence[bytes], numbers: Iterable[str], texts: Iterable[str]) -> Shredded:
        """Take messages apart. Raises KeyError for a path that is not offered."""
        numbers, texts = tuple(dict.fromkeys(numbers)), tuple(dict.fromkeys(texts))
        offered = self.offers()
        for path in (*numbers, *texts):
            if path not in offered:
                raise KeyError(path)
        columns = {name: _Columns() for name in levels_to((*numbers, *texts))}
        for path in numbers:
            columns[level_of(path)].numbers[path] = []
        for path in texts:
            columns[level_of(path)].texts[path], columns[level_of(path)].words[path] = [], {}
        plan = _planned(numbers, texts)
        decoded = np.zeros(len(payloads), dtype=bool)
        for m, payload in enumerate(payloads):
            message = self._decode(payload)
            if message is None:
                continue
            before = {name: len(level.parent) for name, level in columns.items()}
            try:
                self._add_row(columns, "", m)
                self._visit(message, plan, columns)
                decoded[m] = True
            except (TypeError, ValueError, AttributeError, RecursionError, OverflowError):
                for name, rows in before.items():  # not what the schema, or the other messages, say
                    columns[name].cut(rows)
        return Shredded({name: level.level() for name, level in columns.items()}, decoded)

    def _add_row(self, columns: dict[str, _Columns], level: str, parent: int) -> None:
        rows = columns[level]
        rows.parent.append(parent)
        for number in rows.numbers.values():
            number.append(np.nan)
        for text in rows.texts.values():
            text.append(-1)

    def _visit(self, value: Any, plan: _Node, columns: dict[str, _Columns]) -> None:
        rows = columns[plan.level]
        if plan.number is not None:
            rows.numbers[plan.number][-1] = _number(value)
        if plan.text is not None:
            words = rows.words[plan.text]
            rows.texts[plan.text][-1] = words.setdefault(_text(value), len(words))
        for name, inner in plan.fields.items():
            child = self._child(value, name)
            if child is not None:
                self._visit(child, inner, columns)
        if plan.item is not None:
            parent = len(rows.parent) - 1
            if isinstance(value, str | dict):
                raise TypeError("expected a list")
            for item in value:
                self._add_row(columns, plan.item.level, parent)
                if item is not None:
                    self._visit(item, plan.item, columns)


class JsonDefinition(TreeDefinition):
    """JSON messages, judged by some of them: a schema need not be there, nor be kept to."""

    def __init__(self, samples: Iterable[bytes]) -> None:
        self._offers: dict[str, str] = {}
        looked_at = 0
        for payload in itertools.islice(samples, _LOOKED_AT_MOST):
            message = self._decode(payload)
            if message is not None:
                looked_at += self._explore(message, "")
            if looked_at >= _LOOKED_AT:
                break

    def offers(self) -> dict[str, str]:
        """The paths of all leaves, and what each is: `number`, `text`."""
        return self._offers

    def _decode(self, payload: bytes) -> Any:
        try:
            message = json.loads(payload)
        except (ValueError, RecursionError):
            return None
        return message if isinstance(message, dict | list) else None

    def _child(self, node: Any, name: str) -> Any:
        return node.get(name)

    def _explore(self, value: Any, path: str, depth: int = 0) -> bool:
        """Note all leaves below a value; whether there is something in each of its lists."""
        told = True
        if depth > _DEEPEST or len(self._offers) >= _MOST_FIELDS:
            return told
        if isinstance(value, dict):
            for name, inner in value.items():
                if name and not _NO_NAME.search(name):
                    told &= self._explore(inner, f"{path}.{name}" if path else name, depth + 1)
        elif isinstance(value, list):
            for item in value[:_LOOKED_AT]:
                told &= self._explore(item, f"{path}[]", depth + 1)
            return told and bool(value)
        elif value is not None and self._offers.get(path) != "text":
            self._offers[path] = "text" if isinstance(value, str) else "number"
        return told


_NO_NAME = re.compile(r"[][.]")
"""What paths are made of: a field with such a name cannot be named."""


class ProtobufDefinition(TreeDefinition):
    """Protobuf messages by the descriptors inside the recording. Raises DefinitionError."""

    def __init__(self, name: str, schema: Any) -> None:
        from mcap_protobuf.decoder import DecoderFactory

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
        self._offers: dict[str, str] = {}
        self._explore(empty.DESCRIPTOR)
        self._has: dict[tuple[Any, str], tuple[bool, Any]] = {}

    def offers(self) -> dict[str, str]:
        """The paths of all leaves, and what each is: `number`, `text`."""
        return self._offers

    def _decode(self, payload: bytes) -> Any:
        try:
            return self._parse(payload)
        except (DecodeError, RecursionError, ValueError):
            return None

    def _child(self, node: Any, name: str) -> Any:
        descriptor = node.DESCRIPTOR
        known = self._has.get((descriptor, name))
        if known is None:
            field = descriptor.fields_by_name[name]
            names = {v.number: v.name for v in field.enum_type.values} if field.enum_type else None
            known = self._has[descriptor, name] = (field.has_presence, names)
        told, names = known
        if told and not node.HasField(name):
            return None
        value = getattr(node, name)
        if names is None:
            return value
        return _Enum(value, names) if isinstance(value, int) else [_Enum(v, names) for v in value]

    def _explore(self, root: Any) -> None:
        """Note all leaves, those of outer messages first: definitions may refer to themselves, and many times."""
        level = [(root, "")]
        for _ in range(_DEEPEST):
            below = []
            for descriptor, path in level:
                for field in descriptor.fields:
                    here = (f"{path}.{field.name}" if path else field.name) + ("[]" if field.is_repeated else "")
                    if field.message_type is None:
                        text = field.type in (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)
                        self._offers[here] = "text" if text else "number"
                    elif not field.message_type.GetOptions().map_entry:
                        below.append((field.message_type, here))
                if len(self._offers) + len(below) > _MOST_FIELDS:
                    return
            level = below


class _Enum(int):
    """A number with a name."""

    name: str

    def __new__(cls, value: int, names: dict[int, str]) -> _Enum:
        made = super().__new__(cls, value)
        made.name = names.get(value, str(value))
        return made


def _planned(numbers: Sequence[str], texts: Sequence[str]) -> _Node:
    root = _Node()
    for path, is_text in (*((p, False) for p in numbers), *((p, True) for p in texts)):
        node = root
        for step in _steps(path):
            if step == "[]":
                if node.item is None:
                    node.item = _Node()
                node = node.item
            else:
                node = node.fields.setdefault(step, _Node())
        if is_text:
            node.text = path
        else:
            node.number = path
    _name_levels(root, "", "")
    return root


def _steps(path: str) -> Iterator[str]:
    """`a.b[].c` → a, b, [], c."""
    for part in path.split("."):
        name = part.rstrip("[]")
        if name:
            yield name
        yield from ["[]"] * part.count("[]")


def _name_levels(node: _Node, path: str, level: str) -> None:
    node.level = level
    for name, inner in node.fields.items():
        _name_levels(inner, f"{path}.{name}" if path else name, level)
    if node.item is not None:
        _name_levels(node.item, f"{path}[]", f"{path}[]")


def _number(value: Any) -> float:
    """A number, or a text that is one (MSight writes such); NaN for a text that is none."""
    if isinstance(value, str | bytes):
        try:
            return float(value)
        except ValueError:
            return np.nan
    if isinstance(value, dict | list):
        raise TypeError("expected a number, found a structure")
    return float(value)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, _Enum):
        return value.name
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float | int):
        return as_text(value)
    if isinstance(value, str):
        return value if value.isascii() else value.encode(errors="replace").decode()  # half a surrogate is no text
    raise TypeError("expected a text, found a structure")
