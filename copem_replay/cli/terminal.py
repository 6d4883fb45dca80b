"""The terminal: lines that fit it and that nothing in a name can break, notes and problems on stderr."""

from __future__ import annotations

import shutil
import sys
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TextIO

from copem_replay.core.text import wrapped


def printable(text: str) -> str:
    """One line that no file name or key can break, colour or stop."""
    harmful = {c for c in text if unicodedata.category(c)[0] == "C" or c in "\u2028\u2029"}
    return "".join(c.encode("unicode_escape").decode() if c in harmful else c for c in text)


def width_of(stream: TextIO | None) -> int | None:
    """How many characters a line may have; None where it is no terminal: files and pipes get lines whole."""
    return shutil.get_terminal_size().columns if stream is not None and stream.isatty() else None


def say(line: str) -> None:
    """Print a line of the answer."""
    say_blocks([[line]])


def say_blocks(blocks: Iterable[Sequence[str]]) -> None:
    """Print blocks of lines, an empty line between them."""
    width = width_of(sys.stdout)
    print("\n\n".join("\n".join(_fitted(line, width) for line in block) for block in blocks))


def complain(lines: Iterable[str]) -> None:
    """Print problems on stderr."""
    width = width_of(sys.stderr)
    for line in lines:
        print(_fitted(line, width), file=sys.stderr)


def _fitted(line: str, width: int | None) -> str:
    return "\n".join(wrapped(printable(line), width))


def note(lines: Iterable[str]) -> None:
    """Print notes on stderr."""
    complain(f"note: {line}" for line in lines)


def tidied(path: Path, place: Path | None = None) -> None:
    """Remove what killed commands left of a file or folder beside it, or in `place`, and say so."""
    from copem_replay.core.scratch import remove_leftovers

    note(remove_leftovers(path, place))
