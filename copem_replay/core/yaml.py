"""YAML 1.2 as plain data and back: `on`, `off`, `yes`, `no`, dates and 1_000 are text, and each key has its line."""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import StringIO
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode
from ruamel.yaml.scalarstring import DoubleQuotedScalarString

Key = tuple[str | int, ...]
"""The way to a value: keys and places in lists."""


class NotYamlError(Exception):
    """A text is not YAML: at which line, and why."""

    def __init__(self, line: int, why: str) -> None:
        super().__init__(f"line {line}: {why}")
        self.line, self.why = line, why


class AliasesError(NotYamlError):
    """A text is YAML, and its aliases stand for more than any use has."""


def read(text: str) -> tuple[Any, dict[Key, int], list[tuple[Key, int, str]]]:
    """Plain data, the line of each key, and problems that leave the rest readable (key, line, message).

    Raises NotYamlError, AliasesError.
    """
    root = composed(text)
    if root is None:
        return None, {(): 1}, []
    reading = _Reading()
    return reading.plain(root, ()), reading.lines, reading.problems


def composed(text: str) -> Node | None:
    """The nodes of a text, None where it is empty. Raises NotYamlError."""
    line, why = 1, ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an anchor's name may be used again
            root: Node | None = YAML(typ="safe", pure=True).compose(StringIO(text))
            return root
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        why = error.problem or error.context
        if why.startswith("but ") and error.context:
            why = f"{error.context} {why}"
    except YAMLError as error:
        position = getattr(error, "position", 0)
        line = text.count("\n", 0, position) + 1
        why = f"character {text[position]!r} is not allowed" if position else str(error)
    except RecursionError:
        why = "nested too deeply"
    raise NotYamlError(line, " ".join(why.split()))


_CORE: tuple[tuple[re.Pattern[str], Any], ...] = (
    (re.compile(r"~|null|Null|NULL|"), lambda text: None),
    (re.compile(r"true|True|TRUE"), lambda text: True),
    (re.compile(r"false|False|FALSE"), lambda text: False),
    (re.compile(r"[-+]?[0-9]+"), int),
    (re.compile(r"0o[0-7]+"), lambda text: int(text, 0)),
    (re.compile(r"0x[0-9a-fA-F]+"), lambda text: int(text, 0)),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    (re.compile(r"[-+]?\.(inf|Inf|INF)"), lambda text: float(text.replace(".", ""))),
    (re.compile(r"\.nan|\.NaN|\.NAN"), lambda text: math.nan),
)
"""What a plain scalar stands for: the core schema of YAML 1.2.2 (10.3.2). Everything else is text."""


_PLAIN = re.compile(r"[A-Za-z0-9_./][A-Za-z0-9_./:+-]*[A-Za-z0-9_./]|[A-Za-z]")
"""Text that has no other meaning in YAML, in a list or out of it: written without quotes if it is no number."""


def _core(text: str) -> Any:
    for pattern, value_of in _CORE:
        if pattern.fullmatch(text):
            return value_of(text) if len(text) < 1000 else text  # Python's own limit on digits is a few thousand
    return text


_REPEATED = 200_000
"""Characters and values that aliases of one text may stand for (chosen: hundreds of PEMs written out again)."""


@dataclass
class _Reading:
    """Nodes into plain data: where each key stands, and what is wrong on the way."""

    lines: dict[Key, int] = field(default_factory=lambda: {(): 1})
    problems: list[tuple[Key, int, str]] = field(default_factory=list)
    within: list[Node] = field(default_factory=list)
    seen: set[int] = field(default_factory=set)  # nodes, which live as long as their root
    repeated: int = 0

    def plain(self, node: Node, key: Key) -> Any:
        """A node as plain data. Raises AliasesError."""
        if id(node) in self.seen:  # by way of an alias, of it or of what it is in
            self.repeated += 1 + (len(node.value) if isinstance(node, ScalarNode) else 0)
            if self.repeated > _REPEATED:
                raise AliasesError(
                    node.start_mark.line + 1,
                    f"expected aliases that stand for at most {_REPEATED} characters and values in all, found more "
                    "(what stands here is repeated most lately); take fewer aliases of aliases",
                )
        self.seen.add(id(node))
        if isinstance(node, ScalarNode):
            return self._scalar(node, key)
        if any(node is outer for outer in self.within):
            self._problem(node, key, "an alias of something that holds it")
            return None
        self.within.append(node)
        value = self._mapping(node, key) if isinstance(node, MappingNode) else self._sequence(node, key)
        self.within.pop()
        return value

    def _mapping(self, node: Node, key: Key) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for name_node, value_node in node.value:
            if not isinstance(name_node, ScalarNode):
                self._problem(name_node, key, "expected text or a number as a key, found a list or keys and values")
                continue
            plain = self._scalar(name_node, key)
            # Ids may be numbers or text; any other key is text anyway.
            name = str(plain) if isinstance(plain, int) and not isinstance(plain, bool) else name_node.value
            inner = (*key, name)
            if name == "<<" and name_node.style is None:
                self._problem(name_node, inner, "not in YAML 1.2: write out the keys, or use an alias for all of them")
            elif name in mapping:
                self._problem(name_node, inner, "key given twice")
            else:
                self.lines[inner] = name_node.start_mark.line + 1
                mapping[name] = self.plain(value_node, inner)
        return mapping

    def _sequence(self, node: Node, key: Key) -> list[Any]:
        for k, item in enumerate(node.value):
            self.lines[(*key, k)] = item.start_mark.line + 1
        return [self.plain(item, (*key, k)) for k, item in enumerate(node.value)]

    def _scalar(self, node: ScalarNode, key: Key) -> Any:
        if any("\ud800" <= c <= "\udfff" for c in node.value):
            self._problem(node, key, "half a character (a surrogate)")
        if node.tag == "tag:yaml.org,2002:str":
            return node.value
        if str(node.tag).rpartition(":")[2] in ("null", "bool", "int", "float", "timestamp", "value", "merge"):
            return _core(node.value)
        self._problem(node, key, f"tag {node.tag} is not known here")
        return node.value

    def _problem(self, node: Node, key: Key, message: str) -> None:
        self.problems.append((key, node.start_mark.line + 1, message))


def dump(data: dict[str, Any]) -> str:
    """Plain data as YAML 1.2 text, keys in order; short lists on one line."""
    writer = YAML(typ="rt", pure=True)
    writer.default_flow_style = None
    writer.width = 110
    text = StringIO()
    writer.dump(_quoted(data), text)
    return text.getvalue()


def _quoted(value: Any) -> Any:
    """Text that would not be read as the same text is put in quotes."""
    if isinstance(value, str):
        plain = _PLAIN.fullmatch(value) and isinstance(_core(value), str)
        return value if plain else DoubleQuotedScalarString(value)
    if isinstance(value, Mapping):
        return {_quoted(name): _quoted(inner) for name, inner in value.items()}
    return [_quoted(inner) for inner in value] if isinstance(value, list) else value


@dataclass(frozen=True)
class Noted:
    """A value with a comment behind it, on its line."""

    value: Any
    words: str


def commented(data: Mapping[str, Any]) -> str:
    """Plain data in which values may be `Noted`, as YAML 1.2 text: with a line of its own for each that is."""
    return "".join(f"{line}\n" for line in _block(data))


def _block(value: Any) -> list[str]:
    """The lines of a value that holds more than one line."""
    lines: list[str] = []
    items = value.items() if isinstance(value, Mapping) else ((None, item) for item in value)
    for key, item in items:
        name = "-" if key is None else f"{flow(key)}:"
        if isinstance(item, Noted):
            lines += [f"{name} {flow(item.value)}  # {' '.join(item.words.split())}"]
        elif not _noted(item):
            lines += [f"{name} {flow(item)}"]
        elif key is None:
            first, *rest = _block(item)
            lines += [f"- {first}", *(f"  {line}" for line in rest)]
        else:
            lines += [name, *(f"  {line}" for line in _block(item))]
    return lines


def _noted(value: Any) -> bool:
    """Whether anything in a value is `Noted`."""
    if isinstance(value, Mapping):
        return any(map(_noted, value.values()))
    return isinstance(value, Noted) or (isinstance(value, list | tuple) and any(map(_noted, value)))


def flow(value: Any) -> str:
    """Plain data on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{flow(key)}: {flow(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(flow, value))}]"
    if isinstance(value, str):
        plain = _PLAIN.fullmatch(value) and isinstance(_core(value), str)
        return value if plain else f'"{"".join(map(_escaped, value))}"'
    return json.dumps(value)


def _escaped(c: str) -> str:
    if c in '"\\':
        return f"\\{c}"
    return c if c.isprintable() else f"\\U{ord(c):08x}"


def without_notes(value: Any) -> Any:
    """The same as plain data."""
    if isinstance(value, Noted):
        return value.value
    if isinstance(value, Mapping):
        return {key: without_notes(inner) for key, inner in value.items()}
    return [without_notes(inner) for inner in value] if isinstance(value, list | tuple) else value
