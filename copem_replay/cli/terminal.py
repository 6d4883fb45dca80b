"""The terminal: lines that nothing in a name can break, notes and problems on stderr, a bar while it takes long."""

from __future__ import annotations

import sys
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
Progress = Callable[[int, int], None]


def printable(text: str) -> str:
    """One line that no file name or key can break, colour or stop."""
    harmful = {c for c in text if unicodedata.category(c)[0] == "C" or c in "\u2028\u2029"}
    return "".join(c.encode("unicode_escape").decode() if c in harmful else c for c in text)


def say(line: str) -> None:
    """Print a line of the answer."""
    print(printable(line))


def say_blocks(blocks: Iterable[Sequence[str]]) -> None:
    """Print blocks of lines, an empty line between them."""
    print("\n\n".join("\n".join(map(printable, block)) for block in blocks))


def complain(lines: Iterable[str]) -> None:
    """Print problems on stderr."""
    for line in lines:
        print(printable(line), file=sys.stderr)


def note(lines: Iterable[str]) -> None:
    """Print notes on stderr."""
    complain(f"note: {line}" for line in lines)


def tidied(path: Path, place: Path | None = None) -> None:
    """Remove what killed commands left of a file or folder beside it, or in `place`, and say so."""
    from copem_replay.core.scratch import remove_leftovers

    note(remove_leftovers(path, place))


def with_progress(work: Callable[[Progress | None], T]) -> T:
    """Show a bar on a terminal, nothing otherwise."""
    if sys.stderr is None or not sys.stderr.isatty():
        return work(None)
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("replaying", total=None)
        return work(lambda done, total: bar.update(task, completed=done, total=total))
