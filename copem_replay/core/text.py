"""How counts and kinds of intervals read in notes, messages and tables."""

from __future__ import annotations

import difflib
import textwrap
from collections.abc import Iterable


def wrapped(line: str, width: int | None) -> list[str]:
    """A line in as many as it takes to fit, broken at spaces, the further ones indented; None: as it is.

    What has no spaces stays whole, so that paths and addresses can be copied.
    """
    if width is None or len(line) <= width:
        return [line]
    indent = " " * (len(line) - len(line.lstrip()))
    further = f"{indent}    "
    return textwrap.wrap(
        line, max(width, len(further) + 1), subsequent_indent=further,
        break_long_words=False, break_on_hyphens=False, drop_whitespace=True,
    )  # fmt: skip


def counted(number: int, noun: str, plural: str = "") -> str:
    """`1 message`, `2 messages`; `plural` where it is not the noun with an s."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def interval_words(kind: str, over: str) -> str:
    """What limits are, by their kind and what they are over in `summary.csv`; unknown kinds as they are."""
    words = {
        "wilson": "Wilson interval over {}",
        "bootstrap": "bootstrap interval over {}",
        "bootstrap+exact": "bootstrap interval over {}, nowhere narrower than exact binomial limits",
    }
    return words.get(kind, f"{kind} interval over {{}}").format(over)


def unknown(what: str, name: object, known: Iterable[str]) -> str:
    """A message that a name is unknown, with the names there are, or the likely one."""
    names = list(dict.fromkeys(known))
    near = difflib.get_close_matches(str(name), names, n=1)
    hint = f"; did you mean {near[0]}?" if near else f"; there {'are ' + ', '.join(names) if names else 'are none'}"
    return f"no {what} is named {str(name)!r}{hint}"
