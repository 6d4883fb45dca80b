"""XML read part by part: what stands directly under the root, each as a small tree, and forgotten when used.

Expat alone, since it tells lines. A DOCTYPE is refused: no entity is ever expanded, no file fetched.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.parsers import expat

from copem_replay.core.errors import InputError

_BLOCK_BYTES: Final = 1 << 16


@dataclass
class Node:
    """One element."""

    tag: str
    attributes: dict[str, str]
    line: int
    text: str = ""
    children: list[Node] = field(default_factory=list)

    def all(self, tag: str) -> list[Node]:
        """Children of that tag."""
        return [child for child in self.children if child.tag == tag]

    def attribute(self, name: str, path: Path) -> str:
        """What an attribute says. Raises InputError: there is none."""
        if (value := self.attributes.get(name)) is None:
            found = ", ".join(self.attributes) or "none"
            raise InputError(f"{path}:{self.line}: expected <{self.tag}> with the attribute {name}, found {found}")
        return value

    def find(self, *tags: str) -> Node | None:
        """Return the first child of the first tag, its first child of the next, and so on."""
        node: Node | None = self
        for tag in tags:
            node = next((child for child in node.children if child.tag == tag), None) if node is not None else None
        return node


def parts(path: Path, root_tags: tuple[str, ...]) -> Iterator[Node]:
    """Yield the root without its children, then each child once it is complete. Raises InputError."""
    reading = _Reading(path, root_tags)
    try:
        with path.open("rb") as stream:
            while block := stream.read(_BLOCK_BYTES):
                reading.parser.Parse(block, False)
                while reading.done:
                    yield reading.done.popleft()
            reading.parser.Parse(b"", True)
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except expat.ExpatError as error:
        found = expat.errors.messages[error.code]
        raise InputError(f"{path}:{error.lineno}: expected XML, found something else or its end: {found}") from None
    except (LookupError, ValueError) as error:  # an encoding that Python does not have
        raise InputError(f"{path}: expected XML, found something else: {error}") from None
    yield from reading.done


class _Reading:
    """Handlers of the parser, and what they have found."""

    def __init__(self, path: Path, root_tags: tuple[str, ...]) -> None:
        self.path, self.root_tags = path, root_tags
        self.open: list[Node] = []
        self.done: deque[Node] = deque()
        self.parser = parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._text
        parser.StartDoctypeDeclHandler = self._doctype

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        node = Node(tag, attributes, self.parser.CurrentLineNumber)
        if not self.open:
            if tag not in self.root_tags:
                expected = " or ".join(f"<{name}>" for name in self.root_tags)
                raise InputError(f"{self.path}:{node.line}: expected {expected}, found <{tag}>")
            self.done.append(node)
        elif len(self.open) > 1:  # children of the root are handed out, not kept
            self.open[-1].children.append(node)
        self.open.append(node)

    def _end(self, _tag: str) -> None:
        node = self.open.pop()
        if len(self.open) == 1:
            self.done.append(node)

    def _text(self, text: str) -> None:
        if len(self.open) > 1:
            self.open[-1].text += text

    def _doctype(self, *_: object) -> None:
        line = self.parser.CurrentLineNumber
        raise InputError(f"{self.path}:{line}: expected no DOCTYPE, found one: refused, it could expand without end")
