"""Figures in a page: the SVG that `plot` writes, with names of its own for what is in it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from copem_replay.report.figures.render import rendered
from copem_replay.report.html.greys import as_variables
from copem_replay.report.html.markup import Html, tag

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NOT_DRAWN = re.compile(r"<!--.*?-->\s*|<metadata>.*?</metadata>\s*|<style .*?</style>\s*", re.DOTALL)
_IDS = re.compile(r'(?<= id=")|(?<=xlink:href="#)|(?<=url\(#)')
_LARGER = 1.25
"""How much larger than on paper a figure is, where there is room (chosen: texts are then about those of tables)."""
_SIZE = re.compile(r'(<svg [^>]*?)width="([\d.]+)pt" height="[\d.]+pt"')


def _larger(size: re.Match[str]) -> str:
    return f'{size[1]}style="width: {_LARGER * float(size[2]):.0f}pt"'


def drawn(name: str, figure: Figure, title: str, shows: str) -> Html:
    """A figure as an element of a page, as wide as it was drawn where there is room; `shows`: for screen readers."""
    svg = rendered(figure, (".svg",))[".svg"].decode("utf-8")
    svg = _NOT_DRAWN.sub("", svg[svg.index("<svg ") :])  # texts are in comments, too: as users wrote them
    svg = as_variables(_SIZE.sub(_larger, _IDS.sub(f"{name}-", svg), count=1))
    plot = tag("div", Html(svg), id_=name, class_="plot", role="img", aria_label=shows)
    return tag("div", plot, class_="scroll figure", tabindex="0", role="region", aria_label=title)
