"""How figures look: one colour, dash, width and marker per configuration, the same in every figure.

Colours come from `core/colours.py`; what would be hard to see on white, or on a dark page, has an outline. Dashes
and markers tell configurations apart in grey, too, and lines get thinner from one to the next, so that curves that
coincide lie on each other like stripes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from copem_replay.core.colours import configuration_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Colour = tuple[float, float, float]

INK: Colour = (0.15, 0.15, 0.15)
FAINT: Colour = (0.45, 0.45, 0.45)
NOTE_PT = 7.5
"""Size of the line that says what a figure shows (points)."""

_DASHES: tuple[Any, ...] = (
    (),
    (5, 1.6),
    (1.2, 1.2),
    (6, 1.5, 1.2, 1.5),
    (9, 2.5),
    (3, 1.2),
    (6, 1.2, 1.2, 1.2, 1.2, 1.2),
)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
_WIDEST_PT, _THINNEST_PT = 4.4, 1.5
_PALE = 0.4
"""How much of a colour is left in its pale version (chosen)."""
_NEEDS_OUTLINE = 3.0
"""Contrast with the paper, white or dark, below which a colour gets an outline. Source: WCAG 2.1, 1.4.11."""
WHITE: Colour = (1.0, 1.0, 1.0)
DARK: Colour = (27 / 255, 27 / 255, 27 / 255)
"""Paper: of a file, and of the report on a dark screen."""

_STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],  # comes with matplotlib: the same on every machine
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.labelsize": 8.5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "text.parse_math": False,  # a name may hold a dollar sign
    "svg.hashsalt": "copem-replay",  # else ids, and so bytes, are random
    "savefig.dpi": 150,
}


@dataclass(frozen=True)
class Appearance:
    """How one configuration is drawn. `edge`: colour of outlines, the colour itself where it is dark enough."""

    colour: Colour
    edge: Colour
    dashes: tuple[float, ...]  # on and off in line widths; empty: solid
    marker: str
    width_pt: float

    @property
    def pale(self) -> Appearance:
        """The same, mixed with white: see-through lines would show what lies below them, their outlines too."""
        return replace(self, colour=_mixed(self.colour, WHITE, 1 - _PALE), edge=_mixed(self.edge, WHITE, 1 - _PALE))

    def line(self, width_pt: float | None = None) -> dict[str, Any]:
        """Arguments of a matplotlib line."""
        from matplotlib import patheffects

        width = width_pt or self.width_pt
        # Dashes scale with widths: those of thick lines would be too long to repeat within a step.
        dashes = tuple(length * 1.6 / width for length in self.dashes)
        drawn: dict[str, Any] = {"color": self.colour, "linewidth": width, "solid_capstyle": "butt"}
        drawn["linestyle"] = (0, dashes) if dashes else "-"
        if self.edge != self.colour:
            outline = patheffects.Stroke(linewidth=width + 1.2, foreground=self.edge)
            drawn["path_effects"] = [outline, patheffects.Normal()]
        return drawn


def appearances(configurations: Sequence[str]) -> dict[str, Appearance]:
    """How each configuration of an experiment is drawn, whichever of them a figure shows."""
    count = len(configurations)
    result = {}
    for k, (name, rgb) in enumerate(configuration_colours(configurations).items()):
        red, green, blue = (channel / 255 for channel in rgb)
        edge = _outline((red, green, blue))
        width = _WIDEST_PT + (_THINNEST_PT - _WIDEST_PT) * k / max(count - 1, 1)
        result[name] = Appearance(
            (red, green, blue),
            edge,
            _DASHES[k % len(_DASHES)],
            _MARKERS[k % len(_MARKERS)],
            width,
        )
    return result


def _outline(colour: Colour) -> Colour:
    """Darker where white paper needs it, lighter where dark paper does, else the colour itself."""
    if contrast(colour, WHITE) < _NEEDS_OUTLINE:
        return _mixed(colour, (0.0, 0.0, 0.0), 0.45)
    return _mixed(colour, WHITE, 0.45) if contrast(colour, DARK) < _NEEDS_OUTLINE else colour


def _mixed(colour: Colour, other: Colour, share: float) -> Colour:
    red, green, blue = (one + share * (two - one) for one, two in zip(colour, other, strict=True))
    return red, green, blue


def contrast(colour: Colour, other: Colour) -> float:
    """Contrast of two colours, 1 (none) to 21. Source: WCAG 2.1, relative luminance."""
    low, high = sorted(map(_luminance, (colour, other)))
    return (high + 0.05) / (low + 0.05)


def _luminance(colour: Colour) -> float:
    red, green, blue = (c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in colour)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@contextmanager
def style() -> Iterator[None]:
    """The package's settings of matplotlib while a figure is made or written, whatever the user's are."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        for name, value in _STYLE.items():
            matplotlib.rcParams[name] = value  # type: ignore[index]
        yield


_MARKED: WeakKeyDictionary[Any, int] = WeakKeyDictionary()
"""How many artists of a figure are marked as those of some configuration."""


@contextmanager
def of_configuration(number: int, *panels: Axes) -> Iterator[None]:
    """Mark what is drawn into panels meanwhile as that of a configuration: a page of HTML can then hide it."""
    before = {id(artist) for axes in panels for artist in axes.get_children()}
    yield
    drawn = [artist for axes in panels for artist in axes.get_children() if id(artist) not in before]
    figure = panels[0].get_figure(root=True)
    marked = _MARKED.get(figure, 0)
    for place, artist in enumerate(drawn, start=marked):
        artist.set_gid(f"configuration-{number}-{place}")
    _MARKED[figure] = marked + len(drawn)


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure that lays itself out, on no window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def add_note(figure: Figure, sentences: Sequence[str]) -> float:
    """Write what the figure shows below it, in small print, and keep that place free. Returns its height in inches."""
    import re
    import textwrap

    width_in, height_in = (float(v) for v in figure.get_size_inches())
    per_line = int((width_in - 0.2) * 72 / (NOTE_PT * 0.56))  # a letter is 0.56 of the size wide, on the average
    text = ". ".join(sentence.rstrip(".") for sentence in sentences if sentence) + "."
    lines = textwrap.wrap(re.sub(r"(?<=\d) (?=%|[ms]\b)", "\u00a0", text), per_line)
    below_in = len(lines) * NOTE_PT * 1.3 / 72 + 0.12
    below = below_in / height_in
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(rect=(0, below, 1, 1 - below))  # type: ignore[call-arg]
    figure.text(0.1 / width_in, 0.06 / height_in, "\n".join(lines), fontsize=NOTE_PT, color="0.3", va="bottom")
    return below_in
