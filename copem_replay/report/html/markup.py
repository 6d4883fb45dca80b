"""HTML as text, of which only the package's own is taken literally."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence

from copem_replay.core.errors import printable


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def text(value: str) -> Html:
    """Any text as HTML that shows it, and does nothing else."""
    return value if isinstance(value, Html) else Html(html.escape(printable(value)))


def tag(name: str, *children: str, **attributes: str | bool | None) -> Html:
    """An element; `class_`, `data_value`: `class`, `data-value`. None or False: without the attribute."""
    said = "".join(
        f" {key.rstrip('_').replace('_', '-')}" + ("" if value is True else f'="{text(value)}"')
        for key, value in attributes.items()
        if value is not None and value is not False
    )
    return Html(f"<{name}{said}>{joined(children)}</{name}>")


def joined(parts: Iterable[str], between: str = "") -> Html:
    """Parts one after the other."""
    return Html(text(between).join(map(text, parts)))


def breakable(name: str) -> Html:
    """A name that may be broken after an underscore, a colon or a dot that is no decimal point."""
    return Html(re.sub(r"([_:](?=\w)|\.(?=[a-z]))", r"\1<wbr>", text(name)))


def table(head: Sequence[str], rows: Iterable[str], *, caption: str = "", id_: str | None = None) -> Html:
    """A table that scrolls where it is too wide; `rows` are elements, the first column of `head` names them."""
    first = tag("tr", *(tag("th", breakable(name), scope="col") for name in head))
    above = [tag("caption", caption)] if caption else []
    whole = tag("table", *above, tag("thead", first), tag("tbody", *rows), id_=id_)
    # To be scrolled with the keyboard it has to be reached by it.
    return tag("div", whole, class_="scroll", tabindex="0", role="region", aria_label=caption or "table")


def folded(title: str, *parts: str) -> Html:
    """Parts that are shown when asked for, and on paper."""
    return tag("details", tag("summary", title), *parts)


def listed(items: Iterable[str]) -> Html:
    """A list, nothing where it is empty."""
    found = [tag("li", item) for item in items]
    return tag("ul", *found) if found else Html()
