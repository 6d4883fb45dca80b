"""A figure as the bytes of a file, the same every time."""

from __future__ import annotations

import re
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
        lay_out(figure)
        for axes in figure.axes:
            # The last bits of a layout are not the same on every call, and names within an SVG are made of them.
            left, bottom, width, height = (round(float(v), 6) for v in axes.get_position().bounds)
            axes.set_position((left, bottom, width, height))
        for suffix in suffixes:
            content[suffix] = _svg(figure) if suffix == ".svg" else _saved(figure, suffix)
    return content


def _saved(figure: Figure, suffix: str) -> bytes:
    file = BytesIO()
    figure.savefig(file, format=suffix[1:], metadata=METADATA[suffix])
    return file.getvalue()


def _svg(figure: Figure) -> bytes:
    """As `savefig` writes it, which draws everything twice."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    canvas, dpi, file = figure.canvas, figure.dpi, BytesIO()
    figure.dpi = matplotlib.rcParams["savefig.dpi"]  # of what is a picture in it
    FigureCanvasSVG(figure).print_svg(file, metadata=METADATA[".svg"])  # type: ignore[no-untyped-call]
    figure.dpi = dpi
    figure.set_canvas(canvas)
    return _rounded(file.getvalue())


def lay_out(figure: Figure) -> None:
    """Lay a figure out, once and for all: all files show the same."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")


_PATH = re.compile(rb'(?<= d=")[^"]+|(?<= [xy]=")[-\d.]+(?=")')
_LONG = re.compile(rb"-?\d+\.\d{3,}")


def _rounded(svg: bytes) -> bytes:
    """Coordinates to a hundredth of a point: finer than any screen or printer, and half as long."""
    return _PATH.sub(lambda path: _LONG.sub(lambda number: b"%.2f" % float(number[0]), path[0]), svg)
