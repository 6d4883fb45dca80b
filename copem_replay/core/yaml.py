"""YAML 1.2 as plain data and back.

`on`, `off`, `yes`, `no`, dates and 1_000 are text, and each key has its line.
"""

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
"""The path to a value: keys and places in lists."""


class NotYamlError(Exception):
    """A text is not YAML: the line and the reason."""

    def __init__(self, line: int, why: str) -> None:
        super().__init__(f"line {line}: {why}")
        self.line, self.why = line, why


class AliasesError(NotYamlError):
    """A text is YAML whose aliases expand to more than any use needs."""


def parse_yaml(text: str) -> tuple[Any, dict[Key, int], list[tuple[Key, int, str]]]:
    """Plain data, the line of each key, and problems that leave the rest readable (key, line, message).

    Raises NotYamlError, AliasesError.
    """
    root = compose_nodes(text)
    if root is None:
        return None, {(): 1}, []
    reading = _NodeReader()
    return reading.plain(root, ()), reading.lines, reading.problems


def compose_nodes(text: str) -> Node | None:
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
        if r"'\t'" in why:
            why = "found a tab where only spaces may stand; indent with spaces"
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


def _resolve_scalar(text: str) -> Any:
    for pattern, value_of in _CORE:
        if pattern.fullmatch(text):
            return value_of(text) if len(text) < 1000 else text  # Python's own limit on digits is a few thousand
    return text


_REPEATED = 200_000
"""Characters and values that aliases of one text may stand for: enough for hundreds of PEMs written out again."""


@dataclass
class _NodeReader:
    """Nodes into plain data: where each key stands, and what is wrong on the way."""

    lines: dict[Key, int] = field(default_factory=lambda: {(): 1})
    problems: list[tuple[Key, int, str]] = field(default_factory=list)
    within: list[Node] = field(default_factory=list)
    seen: set[int] = field(default_factory=set)  # nodes, which live as long as their root
    repeated: int = 0

    def plain(self, node: Node, key: Key) -> Any:
        """A node as plain data. Raises AliasesError."""
        if id(node) in self.seen:  # reached by an alias, of it or of a value it is in
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
            return _resolve_scalar(node.value)
        self._problem(node, key, f"tag {node.tag} is not known here")
        return node.value

    def _problem(self, node: Node, key: Key, message: str) -> None:
        self.problems.append((key, node.start_mark.line + 1, message))


def dump_yaml(data: dict[str, Any]) -> str:
    """Plain data as YAML 1.2 text, keys in order; short lists on one line."""
    writer = YAML(typ="rt", pure=True)
    writer.default_flow_style = None
    writer.width = 110
    text = StringIO()
    writer.dump(_quote_text(data), text)
    return text.getvalue()


def _quote_text(value: Any) -> Any:
    """A value in which text is put in quotes where it would else be read as something other than itself."""
    if isinstance(value, str):
        plain = _PLAIN.fullmatch(value) and isinstance(_resolve_scalar(value), str)
        return value if plain else DoubleQuotedScalarString(value)
    if isinstance(value, Mapping):
        return {_quote_text(name): _quote_text(inner) for name, inner in value.items()}
    return [_quote_text(inner) for inner in value] if isinstance(value, list) else value


@dataclass(frozen=True)
class CommentedValue:
    """A value with a comment behind it, on its line."""

    value: Any
    words: str


def dump_with_comments(data: Mapping[str, Any]) -> str:
    """Plain data in which values may be `CommentedValue`, each of which gets a line of its own, as YAML 1.2 text."""
    return "".join(f"{line}\n" for line in _block_lines(data))


def _block_lines(value: Any) -> list[str]:
    """The lines of a value that holds more than one line."""
    lines: list[str] = []
    items = value.items() if isinstance(value, Mapping) else ((None, item) for item in value)
    for key, item in items:
        name = "-" if key is None else f"{dump_on_one_line(key)}:"
        if isinstance(item, CommentedValue):
            lines += [f"{name} {dump_on_one_line(item.value)}  # {' '.join(item.words.split())}"]
        elif not _has_comments(item):
            lines += [f"{name} {dump_on_one_line(item)}"]
        elif key is None:
            first, *rest = _block_lines(item)
            lines += [f"- {first}", *(f"  {line}" for line in rest)]
        else:
            lines += [name, *(f"  {line}" for line in _block_lines(item))]
    return lines


def _has_comments(value: Any) -> bool:
    """Whether anything in a value is a `CommentedValue`."""
    if isinstance(value, Mapping):
        return any(map(_has_comments, value.values()))
    return isinstance(value, CommentedValue) or (isinstance(value, list | tuple) and any(map(_has_comments, value)))


def dump_on_one_line(value: Any) -> str:
    """Plain data on one line."""
    if isinstance(value, Mapping):
        return (
            "{" + ", ".join(f"{dump_on_one_line(key)}: {dump_on_one_line(inner)}" for key, inner in value.items()) + "}"
        )
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(dump_on_one_line, value))}]"
    if isinstance(value, str):
        plain = _PLAIN.fullmatch(value) and isinstance(_resolve_scalar(value), str)
        return value if plain else f'"{"".join(map(_escape_character, value))}"'
    return json.dumps(value)


def _escape_character(c: str) -> str:
    if c in '"\\':
        return f"\\{c}"
    return c if c.isprintable() else f"\\U{ord(c):08x}"


def strip_comments(value: Any) -> Any:
    """A value without its comments: plain data."""
    if isinstance(value, CommentedValue):
        return value.value
    if isinstance(value, Mapping):
        return {key: strip_comments(inner) for key, inner in value.items()}
    return [strip_comments(inner) for inner in value] if isinstance(value, list | tuple) else value
