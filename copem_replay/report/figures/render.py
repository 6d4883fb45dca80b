"""A figure as the bytes of a file, the same every time."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING

from copem_replay.report.figures.style import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METADATA = {
    ".png": {"Software": None},  # the version of matplotlib
    ".svg": {"Date": None, "Creator": None},
}
"""Kinds of files, and what matplotlib would write into them that is not the figure."""


def rendered(figure: Figure, suffixes: Sequence[str] = tuple(METADATA)) -> dict[str, bytes]:
    """The content of a file of each kind."""
    content = {}
    with style(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")  # of a name; drawn as a box
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # laid out once: all files show the same
        for axes in figure.axes:
            # The last bits of a layout are not the same on every call, and names within an SVG are made of them.
            left, bottom, width, height = (round(float(v), 6) for v in axes.get_position().bounds)
            axes.set_position((left, bottom, width, height))
        for suffix in suffixes:
            file = BytesIO()
            figure.savefig(file, format=suffix[1:], metadata=METADATA[suffix])
            content[suffix] = file.getvalue()
    return content
