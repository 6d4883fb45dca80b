"""Greys of figures as variables of the page, so that a dark page has them light and the other way round.

Colours stay what they are: a configuration has one colour. Black to white become the dark page's ink to its paper.
"""

from __future__ import annotations

import re

_GREY = re.compile(r"(?<=[: \"])#([0-9a-f]{2})\1\1\b")
_USED = re.compile(r"var\(--g-([0-9a-f]{2})\)")
INK, PAPER = (232, 232, 232), (27, 27, 27)
"""Of the dark page (`page.css` has the same)."""


def as_variables(svg: str) -> str:
    """`#262626` as `var(--g-26)`, in styles and attributes; what has no colour is of the ink that `page.css` says."""
    return _GREY.sub(r"var(--g-\1)", svg)


def dark_greys(html: str) -> str:
    """What the variables of a page are, on light paper and on dark screens."""
    levels = sorted({int(level, 16) for level in _USED.findall(html)})
    light = "".join(f"--g-{k:02x}:#{k:02x}{k:02x}{k:02x};" for k in levels)
    dark = "".join(f"--g-{k:02x}:{_inverted(k)};" for k in levels)
    if not levels:
        return ""
    return f":root{{{light}}}\n@media screen and (prefers-color-scheme: dark){{:root{{{dark}}}}}\n"


def _inverted(level: int) -> str:
    """Linear from ink (black) to paper (white)."""
    share = level / 255
    red, green, blue = (round(ink + (paper - ink) * share) for ink, paper in zip(INK, PAPER, strict=True))
    return f"#{red:02x}{green:02x}{blue:02x}"
