"""Pieces of lines for keys and rows of tables, as the figures have them (`report/figures/style.py`)."""

from __future__ import annotations

from copem_replay.report.figures.style import Appearance, Colour
from copem_replay.report.html.markup import Html, tag

_PX = 1.25
"""Pixels of a line for each point of its width (chosen)."""


def rgb(colour: Colour) -> str:
    """A colour as CSS has it."""
    red, green, blue = (round(255 * channel) for channel in colour)
    return f"rgb({red},{green},{blue})"


def _dash(look: Appearance, width_px: float) -> str:
    # As in the figures, dashes are longer on thicker lines, if not by as much.
    scale = 1.6 * _PX * max(width_px / (1.6 * _PX * 2), 1.0) ** 0.5
    return ",".join(f"{round(length * scale, 1):g}" for length in look.dashes)


def swatch(look: Appearance) -> Html:
    """A piece of a configuration's line, for keys and captions."""
    width = look.width_pt * _PX
    dash = _dash(look, width) or None

    def line(colour: Colour, wide: float) -> Html:
        return tag(
            "line",
            x1="1", y1="7", x2="43", y2="7", stroke=rgb(colour), stroke_width=f"{wide:.2f}",
            stroke_dasharray=dash,
        )  # fmt: skip

    edge = [line(look.edge, width + 1.8)] if look.edge != look.colour else []
    return tag("svg", *edge, line(look.colour, width), class_="swatch", viewBox="0 0 44 14", aria_hidden="true")
