"""Message paths of Foxglove and Lichtblick, read by hand: topic, fields, slices, filters.

By the published grammar (`grammar.ne` of both, as of 2026): a topic is a run of letters, digits, `_`, `-` and slashes,
or stands in double quotes, in which a backslash escapes itself and the quote; a field is a name after a dot; a slice
`[3]`, `[1:3]`, `[:]`; a filter `{field==value}`, whose text stands in quotes of either kind and knows no escapes.
"""

from __future__ import annotations

import re
from typing import Any

_TOPIC = re.compile(r"[A-Za-z0-9_-]+(?:/[A-Za-z0-9_-]*)*|(?:/[A-Za-z0-9_-]*)+")
_QUOTED = re.compile(r'"((?:[^"\\]|\\["\\])*)"')
_FIELD = re.compile(r"\.([A-Za-z0-9_-]+)")
_SLICE = re.compile(r"\[(?:(-?\d+)|(-?\d*):(-?\d*))\]")
_FILTER = re.compile(r"""\{([A-Za-z0-9_.-]+)==(?:"([^"]*)"|'([^']*)'|([+-]?\d+))\}""")


def parse(path: str) -> tuple[str, list[Any]]:
    """The topic, and the parts after it: a field as text, a slice as `slice`, a filter as (field, value).

    ValueError: not by the grammar.
    """
    quoted, plain = _QUOTED.match(path), _TOPIC.match(path)
    if quoted:
        topic, at = re.sub(r"\\(.)", r"\1", quoted[1]), quoted.end()
    elif plain:
        topic, at = plain[0], plain.end()
    else:
        raise ValueError(f"no topic: {path}")
    parts: list[Any] = []
    while at < len(path):
        if found := _FIELD.match(path, at):
            parts.append(found[1])
        elif (found := _SLICE.match(path, at)) and parts and isinstance(parts[-1], str):
            one, first, last = found.groups()
            parts.append(slice(int(one), int(one)) if one else slice(int(first or 0), int(last) if last else None))
        elif found := _FILTER.match(path, at):
            text = found[2] if found[2] is not None else found[3]
            parts.append((found[1], int(found[4]) if text is None else text))
        else:
            raise ValueError(f"at {at}: {path}")
        at = found.end()
    return topic, parts


def pick(message: Any, parts: list[Any]) -> list[Any]:
    """All values of a message that the parts of a path lead to."""
    values = [message]
    for part in parts:
        if isinstance(part, str):
            values = [value[part] for value in values]
        elif isinstance(part, slice):
            last = None if part.stop is None else part.stop + 1
            values = [each for value in values for each in value[part.start : last]]
        else:
            values = [value for value in values if value[part[0]] == part[1]]
    return values
