"""How figures of a report look: what plotly.js draws, as plain data.

A figure is `{"id", "data", "layout"}`; colours, dashes and widths are those of all figures (`report/figures/style.py`).
"""

from __future__ import annotations

import html
from typing import Any

import numpy as np

from copem_replay.core.text import printable
from copem_replay.core.tracks import Float
from copem_replay.report.figures.style import Appearance, Colour
from copem_replay.report.html.markup import Html, tag

Drawn = dict[str, Any]
"""A figure, a trace or a layout of plotly.js."""

INK = "#262626"
FAINT = "#8c8c8c"
GRID = "#e3e3e3"
_PX = 1.25
"""Pixels of a line for each point of its width (chosen)."""


def numbers(values: Float, digits: int = 4) -> list[float | None]:
    """Values (n,) that are drawn, to so many decimals; None: nothing there."""
    return [None if np.isnan(v) else float(v) + 0.0 for v in np.round(np.asarray(values, dtype=float), digits)]


def label(name: str) -> str:
    """A name as plotly.js shows it: it takes some tags in any text literally."""
    return html.escape(printable(name), quote=False)


def rgb(colour: Colour, alpha: float = 1.0) -> str:
    """A colour as CSS has it."""
    red, green, blue = (round(255 * channel) for channel in colour)
    return f"rgb({red},{green},{blue})" if alpha == 1 else f"rgba({red},{green},{blue},{alpha:g})"


def line_of(look: Appearance, width_px: float | None = None) -> Drawn:
    """The line of a configuration."""
    width = width_px or look.width_pt * _PX
    return {"color": rgb(look.colour), "width": round(width, 2), "dash": _dash(look, width)}


def outlined(trace: Drawn, look: Appearance) -> list[Drawn]:
    """A line, over a darker one where its colour is hard to see on white."""
    if look.edge == look.colour:
        return [trace]
    below = {**trace["line"], "color": rgb(look.edge), "width": trace["line"]["width"] + 1.8}
    return [trace | {"line": below, "hoverinfo": "skip", "hovertemplate": None}, trace]


def _dash(look: Appearance, width_px: float) -> str:
    # As in the other figures, dashes are longer on thicker lines, if not by as much.
    scale = 1.6 * _PX * max(width_px / (1.6 * _PX * 2), 1.0) ** 0.5
    return ",".join(f"{round(length * scale, 1):g}px" for length in look.dashes) or "solid"


def swatch(look: Appearance) -> Html:
    """A piece of a configuration's line, for keys and captions."""
    width = look.width_pt * _PX
    dash = _dash(look, width).replace("px", "")

    def line(colour: Colour, wide: float) -> Html:
        return tag(
            "line",
            x1="1", y1="7", x2="43", y2="7", stroke=rgb(colour), stroke_width=f"{wide:.2f}",
            stroke_dasharray=None if dash == "solid" else dash,
        )  # fmt: skip

    edge = [line(look.edge, width + 1.8)] if look.edge != look.colour else []
    return tag("svg", *edge, line(look.colour, width), class_="swatch", viewBox="0 0 44 14", aria_hidden="true")


def box(fill: str, marks: str = "", colour: str = "black") -> Html:
    """A piece of a bar, for keys: filled, with `marks` on it, a path in a square of 14."""
    shape = tag("rect", x="0.5", y="0.5", width="13", height="13", fill=fill, stroke="#404040")
    drawn = [tag("path", d=marks, stroke=colour, stroke_width="1.6", fill="none")] if marks else []
    return tag("svg", shape, *drawn, class_="box", viewBox="0 0 14 14", aria_hidden="true")


def axis(title: str, **more: Any) -> Drawn:
    """An axis."""
    return {
        "title": {"text": title, "standoff": 8},
        "gridcolor": GRID,
        "linecolor": FAINT,
        "zeroline": False,
        "ticks": "outside",
        "tickcolor": FAINT,
        "ticklen": 4,
        "automargin": True,
        "fixedrange": True,
    } | more


def layout(height_px: int, x: Drawn, y: Drawn, **more: Any) -> Drawn:
    """A layout of one panel."""
    return {
        "height": height_px,
        "margin": {"l": 52, "r": 12, "t": 10, "b": 44, "pad": 0},
        "font": {"family": "system-ui, 'Segoe UI', 'Liberation Sans', sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "hovermode": "closest",
        "hoverlabel": {"bgcolor": "white", "bordercolor": FAINT, "font": {"color": INK}, "namelength": -1},
        "dragmode": False,
        "showlegend": False,
        "xaxis": x,
        "yaxis": y,
    } | more


def place(id_: str, what: str) -> Html:
    """Where a figure goes; `what` it shows, for those who cannot see it."""
    return tag("div", id_=id_, class_="plot", role="img", aria_label=what)


def card(number: int, id_: str, what: str, *caption: str) -> Html:
    """One of many small figures, of one configuration."""
    return tag("figure", tag("figcaption", *caption), place(id_, what), class_="card", data_configuration=str(number))
