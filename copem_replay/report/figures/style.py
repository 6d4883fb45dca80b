"""Style of figures: one colour, dash, width and marker per configuration in every figure; notes, numbers, files, rows.

Colours, markers and dashes come from `core/colours.py`, for paper and for a dark page. Markers and dashes distinguish
configurations in grey, too. Lines get thinner from one configuration to the next, so that coinciding curves look
like stripes. The ground truth is a grey line of a pixel.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
import pandas as pd

from copem_replay.core.colours import Rgb, configuration_signs
from copem_replay.core.errors import InputError, count_noun
from copem_replay.metrics.limits import (
    count_clusters,
    describe_absent,
    describe_clusters,
    explain_no_clusters,
    find_clusters,
    format_limits,
)
from copem_replay.results.table_files import AGAIN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


Colour = tuple[float, float, float]

INK: Colour = (0.15, 0.15, 0.15)
FAINT: Colour = (0.45, 0.45, 0.45)
NOTE_PT = 7.5
"""Size of the note below a figure (points)."""

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
_WIDEST_PT, _THINNER_PT, _THINNEST_PT = 4.4, 0.4, 1.5
"""Width of the line of the first configuration, how much thinner the next is, and the least."""
_PALE = 0.4
"""Share of a colour in its pale version: clearly paler, but still that colour."""
_TRUTH_PT = 0.75
"""Width of lines of the ground truth: a pixel."""
WHITE: Colour = (1.0, 1.0, 1.0)
DARK: Colour = (27 / 255, 27 / 255, 27 / 255)
"""Paper of a file, and of the report on a dark screen."""

_STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],  # comes with matplotlib, so it is on every machine
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
    "svg.hashsalt": "copem-replay",  # otherwise ids, and so bytes, are random
    "savefig.dpi": 150,
}


@dataclass(frozen=True)
class Appearance:
    """Line and marker of one configuration. `dark`: its colour on a dark page."""

    colour: Colour
    dark: Colour
    dashes: tuple[float, ...]  # on and off in line widths; empty: solid
    marker: str
    width_pt: float

    @property
    def pale(self) -> Appearance:
        """The appearance mixed with white. Transparency would show the lines and outlines below."""
        return replace(
            self, colour=_mix_colours(self.colour, WHITE, 1 - _PALE), dark=_mix_colours(self.dark, DARK, 1 - _PALE)
        )

    def line(self, width_pt: float | None = None) -> dict[str, Any]:
        """Arguments of a matplotlib line."""
        width = width_pt or self.width_pt
        # matplotlib scales dashes with the width: those of thick lines would not repeat within a step.
        dashes = tuple(length * 1.6 / width for length in self.dashes)
        drawn: dict[str, Any] = {"color": self.colour, "linewidth": width, "solid_capstyle": "butt"}
        drawn["linestyle"] = (0, dashes) if dashes else "-"
        return drawn


def choose_appearances(results: Results) -> dict[str, Appearance]:
    """The appearance of each configuration of results, by its place in the experiment."""
    names, truths = tuple(results.experiment.configurations), find_truths(results)
    light, dark = (configuration_signs(names, truths, theme) for theme in ("light", "dark"))
    result = {}
    for k, name in enumerate(names):
        width = max(_WIDEST_PT - _THINNER_PT * k, _THINNEST_PT)
        result[name] = Appearance(
            _scale_channels(light[name].colour),
            _scale_channels(dark[name].colour),
            () if name in truths else _DASHES[light[name].shape],
            _MARKERS[light[name].shape],
            _TRUTH_PT if name in truths else width,
        )
    return result


def _scale_channels(colour: Rgb) -> Colour:
    red, green, blue = (channel / 255 for channel in colour)
    return red, green, blue


def _mix_colours(colour: Colour, other: Colour, share: float) -> Colour:
    red, green, blue = (one + share * (two - one) for one, two in zip(colour, other, strict=True))
    return red, green, blue


def contrast_ratio(colour: Colour, other: Colour) -> float:
    """Contrast of two colours, 1 (none) to 21. Source: WCAG 2.1, relative luminance."""
    low, high = sorted(map(_relative_luminance, (colour, other)))
    return (high + 0.05) / (low + 0.05)


def _relative_luminance(colour: Colour) -> float:
    red, green, blue = (c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in colour)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@contextmanager
def figure_style() -> Iterator[None]:
    """The package's settings of matplotlib while a figure is made or written, whatever the user's are."""
    import matplotlib

    settings: Any = matplotlib.rcParams
    with matplotlib.rc_context():
        if not _SETTINGS:  # once, as checking all defaults takes milliseconds
            matplotlib.rcdefaults()
            settings.update(_STYLE)
            _SETTINGS.update(dict.items(settings))
        dict.update(settings, _SETTINGS)
        yield


_SETTINGS: dict[str, Any] = {}
"""All settings of matplotlib as figures have them."""


_MARKED: WeakKeyDictionary[Any, int] = WeakKeyDictionary()
"""Number of artists marked so far, by figure."""


@contextmanager
def mark_configuration(number: int, *panels: Axes) -> Iterator[None]:
    """Mark everything drawn into panels in this context as a configuration's, so that an HTML page can hide it."""
    before = {id(artist) for axes in panels for artist in axes.get_children()}
    yield
    drawn = [artist for axes in panels for artist in axes.get_children() if id(artist) not in before]
    figure = panels[0].get_figure(root=True)
    marked = _MARKED.get(figure, 0)
    for place, artist in enumerate(drawn, start=marked):
        artist.set_gid(f"configuration-{number}-{place}")
    _MARKED[figure] = marked + len(drawn)


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure with constrained layout, without a window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def add_note(figure: Figure, sentences: Sequence[str]) -> float:
    """Write sentences below a figure in small print, in a space kept free. Returns its height in inches."""
    import re
    import textwrap

    width_in, height_in = (float(v) for v in figure.get_size_inches())
    per_line = int((width_in - 0.2) * 72 / (NOTE_PT * 0.56))  # a letter is on average 0.56 of the font size wide
    text = ". ".join(sentence.rstrip(".") for sentence in sentences if sentence) + "."
    lines = textwrap.wrap(re.sub(r"(?<=\d) (?=%|[ms]\b)", "\u00a0", text), per_line)
    below_in = len(lines) * NOTE_PT * 1.3 / 72 + 0.12
    below = below_in / height_in
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(rect=(0, below, 1, 1 - below))  # type: ignore[call-arg]
    figure.text(
        0.1 / width_in, 0.06 / height_in, "\n".join(lines), fontsize=NOTE_PT, color="0.3", va="bottom", gid=_NOTE
    )
    return below_in


_NUMBER_PT = 7.5
"""Size of the number beside a mark (points), whose figures are about half as wide."""
_BESIDE = ((1, 0), (1, 1), (0, 1), (-1, 0), (0, -1), (-1, 1), (1, -1), (-1, -1))
"""Places of a number around its mark, the best first: right, above and below."""


def number_marks(figure: Figure, axes: Axes, names: Sequence[str], mark_pt: float) -> None:
    """Add the legend of a figure with a mark per name, and their numbers in it and beside the marks.

    Marks that touch have their numbers together. Numbers stand where they cover neither each other nor a mark, if
    there is such a place next to their mark.
    """
    legend = figure.legend(
        axes.collections, [f"{k} {name}" for k, name in enumerate(names, start=1)], loc="outside right upper"
    )
    for handle in legend.legend_handles:
        handle.set_sizes([mark_pt**2])  # type: ignore[union-attr]
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)  # places of marks in points depend on it
    offsets = [tuple(np.asarray(mark.get_offsets())[0].tolist()) for mark in axes.collections]
    places = [axes.transData.transform(place) * 72 / figure.dpi for place in offsets]
    groups: list[list[int]] = []
    for k, place in enumerate(places):
        near = (group for group in groups if any(math.dist(places[other], place) < mark_pt for other in group))
        group = next(near, None)
        groups.append([k]) if group is None else group.append(k)
    left, bottom, right, _ = (72 / figure.dpi * edge for edge in axes.get_window_extent().extents)
    covered = [((left + right) / 2, bottom, right - left, 1.0), *((*place, mark_pt, mark_pt) for place in places)]
    for group in groups:
        text = ", ".join(str(k + 1) for k in group)
        wide, high = 0.58 * _NUMBER_PT * len(text), _NUMBER_PT
        spots = [
            (places[k][0] + x * (wide + mark_pt + 3) / 2, places[k][1] + y * (high + mark_pt + 1) / 2, wide, high)
            for x, y in _BESIDE
            for k in group
        ]
        spot = min(spots, key=lambda box: sum(_overlap(box, other) for other in covered))
        covered.append(spot)
        axes.annotate(
            text, offsets[group[0]], xytext=tuple(np.subtract(spot[:2], places[group[0]])),
            textcoords="offset points", ha="center", va="center", fontsize=_NUMBER_PT, color=INK, annotation_clip=False,
        )  # fmt: skip


def _overlap(box_a: tuple[float, ...], box_b: tuple[float, ...]) -> float:
    """Area common to two boxes, each by its middle, width and height."""
    wide = min((box_a[2] + box_b[2]) / 2 - abs(box_a[0] - box_b[0]), box_a[2], box_b[2])
    high = min((box_a[3] + box_b[3]) / 2 - abs(box_a[1] - box_b[1]), box_a[3], box_b[3])
    return max(wide, 0.0) * max(high, 0.0)


_NOTE = "note"
"""What tells the text of a note from others of a figure."""


def take_note(figure: Figure) -> str:
    """Take the note and its space away from a figure, as a page shows it as text. Empty without one."""
    from matplotlib.layout_engine import PlaceHolderLayoutEngine

    notes = [text for text in figure.texts if text.get_gid() == _NOTE]
    engine = figure.get_layout_engine()
    if not notes or engine is None:
        return ""
    words = notes[0].get_text()
    notes[0].remove()
    if not isinstance(engine, PlaceHolderLayoutEngine):  # else panels have their places already
        engine.set(rect=(0, 0, 1, 1))  # type: ignore[call-arg]
        below_in = (words.count("\n") + 1) * NOTE_PT * 1.3 / 72 + 0.12
        figure.set_size_inches(figure.get_size_inches()[0], figure.get_size_inches()[1] - below_in)
    return " ".join(words.replace("\u00a0", " ").split("\n"))


# Words of figures: names that fit, numbers of rows, list rates, formats of numbers.

_LONGEST_NAME = 26
"""Most letters of a configuration's name: longer ones would take too much of a figure's width."""


def shorten_names(names: Sequence[str]) -> dict[str, str]:
    """Short names by name: the middle of long ones left out, if all still differ."""
    half = _LONGEST_NAME // 2
    short = {name: name if len(name) <= _LONGEST_NAME else f"{name[:half]}…{name[-half + 1 :]}" for name in names}
    return short if len(set(short.values())) == len(short) else {name: name for name in names}


def describe_results(results: Results, names: Sequence[str]) -> str:
    """Runs, objects, logs, rows per configuration and seed of the results, in words."""
    counted = results.known[results.known["configuration"].isin(list(names))]
    objects = counted.groupby(["log", "object_id"]).ngroups
    logs, episodes = counted["log"].nunique(), counted.groupby(["log", "object_id", "episode"]).ngroups
    times = f" ({count_noun(episodes, 'episode')})" if episodes > objects else ""
    in_logs = f" in {count_noun(logs, 'log')}" if logs > 1 else ""
    rows = counted["runs"].sum() / max(counted["configuration"].nunique(), 1)
    return (
        f"{count_noun(results.experiment.runs, 'run')} of {count_noun(objects, 'object')}{times}{in_logs}, "
        f"n = {rows:.0f} per configuration, seed {results.experiment.seed}"
    )


def describe_list_rates(rows: pd.DataFrame, names: Sequence[str]) -> str:
    """Fused lists per second, configurations of one rate together; `rows` as in `summary.csv`."""
    by_rate: dict[str, list[str]] = {}
    for name, short in shorten_names(names).items():
        rates = rows.loc[rows["configuration"] == name, "list_rate_hz"].dropna()
        if len(rates):
            low, high = f"{rates.min():.3g}", f"{rates.max():.3g}"
            by_rate.setdefault(low if low == high else f"{low} to {high}", []).append(short)
    if not by_rate:
        return ""
    if len(by_rate) == 1:
        return f"{next(iter(by_rate))} fused lists per second"
    return "Fused lists per second: " + "; ".join(
        f"{rate} ({', '.join(names_alike)})" for rate, names_alike in by_rate.items()
    )


def format_share(share: float) -> str:
    """A share in per cent, `85 %` or `99.8 %`; 100 and 0 only for all and nothing."""
    if np.isnan(share):
        return "–"
    if 0 < share < 0.0005 or 0.9995 < share < 1:
        return "< 0.1 %" if share < 0.5 else "> 99.9 %"
    return f"{100 * share:.1f} %" if 0 < share < 0.01 or 0.99 < share < 1 else f"{100 * share:.0f} %"


def format_per_cent(share: float) -> str:
    """A share in per cent to three significant digits, `84.4` or `> 99.9`; 100 and 0 only for all and nothing."""
    if np.isnan(share):
        return "–"
    if 0 < share < 0.0005 or 0.9995 <= share < 1:
        return "< 0.1" if share < 0.5 else "> 99.9"
    return format_three_digits(100 * share)


def format_aligned_per_cent(share: float) -> str:
    """A share in per cent with one decimal, as those below each other; 100 and 0 only for all and nothing."""
    shown = format_per_cent(share)
    return shown if shown.startswith(("<", ">", "–")) else f"{100 * share:.1f}"


def format_signed_decimals(value: float) -> str:
    """A difference with its sign and two decimals; `±0` for none."""
    shown = format_two_decimals(value)
    return "±0" if shown == "0.00" else shown if value < 0 or shown.startswith("<") else f"+{shown}"


def format_three_digits(value: float) -> str:
    """A number to three significant digits; whole from 1000 on, 0 below 10⁻⁹, and no exponent below 10⁻³."""
    if 1e-9 <= abs(value) < 1e-3:
        return "< 0.001" if value > 0 else "> −0.001"
    return "0" if abs(value) < 1e-9 else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}".replace("-", "−")


def format_two_decimals(value: float) -> str:
    """A number with two decimals, as those below each other in a table; whole from 1000 on, never `−0.00`."""
    if 1e-9 <= abs(value) < 5e-3:
        return "< 0.01" if value > 0 else "> −0.01"
    shown = "0.00" if abs(value) < 1e-9 else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.2f}"
    return shown.replace("-", "−")


def write_limits(low: float, high: float) -> str:
    """An interval as it is written everywhere, with the sign of minus."""
    return format_limits(low, high).replace("-", "−")


def describe_over(results: Results) -> str:
    """What the intervals of results are over, what they show and cannot exclude; empty without any."""
    clusters = find_clusters(results.known)
    if clusters is None:
        return ""
    number = results.experiment.runs if clusters.by_run else clusters.count
    absent = f"; whatever the interval, {describe_absent(number)}" if clusters.over == "logs" else ""
    return describe_clusters(clusters.over, number) + absent


def explain_no_intervals(results: Results) -> str:
    """Why there are no intervals, such as `2 logs, fewer than 3: …`; empty where there are."""
    known = results.known
    return "" if find_clusters(known) is not None else explain_no_clusters(*count_clusters(known))


# Files of figures, of equal bytes every time.

METADATA = {
    ".png": {"Software": None},  # the version of matplotlib
    ".svg": {"Date": None, "Creator": None},
}
"""Suffixes of files, and metadata of matplotlib that are left out."""


def render_figure(figure: Figure, suffixes: Sequence[str] = tuple(METADATA)) -> dict[str, bytes]:
    """The content of one file per kind."""
    content = {}
    with figure_style(), warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message="Glyph .* missing from"
        )  # a letter of a name that the font lacks is drawn as a box
        lay_out(figure)
        for axes in figure.axes:
            # The last bits of a layout differ between calls, and ids within an SVG depend on them.
            left, bottom, width, height = (round(float(v), 6) for v in axes.get_position().bounds)
            axes.set_position((left, bottom, width, height))
        for suffix in suffixes:
            content[suffix] = _save(figure, suffix)
    return content


def _save(figure: Figure, suffix: str) -> bytes:
    """The bytes of the file that `savefig` writes, without drawing everything twice as it does."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    canvas, dpi, file = figure.canvas, figure.dpi, BytesIO()
    figure.dpi = matplotlib.rcParams["savefig.dpi"]  # of a PNG, and of pictures in an SVG
    if suffix == ".svg":
        FigureCanvasSVG(figure).print_svg(file, metadata=METADATA[suffix])  # type: ignore[no-untyped-call]
    else:
        FigureCanvasAgg(figure).print_png(file, metadata=METADATA[suffix])  # type: ignore[no-untyped-call]
    figure.dpi = dpi
    figure.set_canvas(canvas)
    return _round_coordinates(file.getvalue()) if suffix == ".svg" else file.getvalue()


def lay_out(figure: Figure) -> None:
    """Compute the layout and fix it, so that all files have one layout."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")


_PATH = re.compile(rb'(?<= d=")[^"]+|(?<= [xy]=")[-\d.]+(?=")')
_LONG = re.compile(rb"-?\d+\.\d{3,}")


def _round_coordinates(svg: bytes) -> bytes:
    """An SVG with coordinates rounded to 0.01 points: finer than any screen or printer, and half as long."""
    return _PATH.sub(lambda path: _LONG.sub(lambda number: b"%.2f" % float(number[0]), path[0]), svg)


# Contenders, and their order.

RANKED_BY = "ttd_rmst_s"
"""Metric of the ranking: the mean time to detection that includes objects never detected."""


def find_truths(results: Results) -> tuple[str, ...]:
    """Configurations of the ground truth, in their order."""
    return tuple(name for name, facts in results.facts.items() if facts.truth)


def find_contenders(results: Results, names: Sequence[str] | None = None) -> tuple[str, ...]:
    """The configurations of `names` (None: all) that are not the ground truth; all of `names` without any other."""
    chosen, upper = results.chosen(names), find_truths(results)
    return tuple(name for name in chosen if name not in upper) or chosen


def check_summary(results: Results) -> None:
    """Raise InputError unless `summary.csv` has the experiment's configurations."""
    expected, listed = list(results.experiment.configurations), list(map(str, results.summary["configuration"]))
    if listed != expected:
        rows, found = ", ".join(expected), ", ".join(listed)
        raise InputError(f"{results.place / 'summary.csv'}: expected rows of {rows}, found {found}; {AGAIN}")


def sort_soonest_first(results: Results, names: Sequence[str]) -> tuple[str, ...]:
    """Configurations by mean time to detection; equal ones by the share that passes, then in their order.
    Configurations with fewer rows come last: their means are over fewer objects.
    """
    rows = results.summary.set_index("configuration")
    fewer = find_with_fewer_rows(results, names)

    def rank(name: str) -> tuple[bool, float, float]:
        row = rows.loc[name]
        mean_s, passes = float(row[RANKED_BY]), float(row.get("pass_share", math.nan))
        return name in fewer, math.inf if math.isnan(mean_s) else mean_s, 0.0 if math.isnan(passes) else -passes

    return tuple(sorted(names, key=rank))


def find_with_fewer_rows(results: Results, names: Sequence[str]) -> tuple[str, ...]:
    """Configurations with fewer rows than the others, because some logs lack their units."""
    rows = results.summary.set_index("configuration")["n"].loc[list(names)]
    return tuple(name for name in names if rows[name] < rows.max())


# Dots with intervals, a row per configuration, for the figures of the answer and of differences.

ROW_IN = 0.27
"""Height of a row (inches)."""
_DOT = 34.0
"""Area of a dot (square points)."""


@dataclass(frozen=True)
class Dot:
    """A value with or without limits. `words`: text beside it; `sure`: in bold. Without a value only words."""

    value: float | None
    low: float | None
    high: float | None
    words: str
    sure: bool = False


def draw_rows(axes: Axes, dots: Sequence[tuple[str, Dot]], looks: dict[str, Appearance], *, named: bool) -> None:
    """Draw a row per dot, the first at the top; a dot is filled if it has an interval, else hollow. `named`: with names
    at the left.
    """
    numbers = {name: k for k, name in enumerate(looks)}
    for row, (name, dot) in enumerate(dots):
        with mark_configuration(numbers[name], axes):
            _draw_row(axes, row, dot, looks[name], name)
    short = shorten_names([name for name, _ in dots])
    axes.set_yticks(range(len(dots)), [short[name] for name, _ in dots] if named else [])
    axes.set_ylim(len(dots) - 0.45, -0.55)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.spines["left"].set_visible(False)
    for k in range(1, len(dots)):
        axes.axhline(k - 0.5, color="0.93", linewidth=0.6, zorder=0.5)


def _draw_row(axes: Axes, row: int, dot: Dot, look: Appearance, name: str) -> None:
    """Draw one dot with its interval, hollow without one, and its words at the right."""
    words: dict[str, Any] = {"va": "center_baseline", "fontsize": 8, "clip_on": False}
    axes.text(
        1.03, row, dot.words, transform=axes.get_yaxis_transform(), ha="left",
        color=INK if dot.value is not None else FAINT, fontweight="bold" if dot.sure else "normal", **words,
    )  # fmt: skip
    if dot.value is None:
        return
    has_limits = dot.low is not None and dot.high is not None
    if dot.low is not None and dot.high is not None:
        axes.plot([dot.low, dot.high], [row, row], color=look.colour, linewidth=2.4, zorder=2.1, label=f"of {name}")
    axes.scatter(
        [dot.value], [row], s=_DOT, marker=look.marker, zorder=3, label=name, linewidths=1.0 if has_limits else 1.6,
        facecolor=look.colour if has_limits else "white", edgecolor=look.colour, clip_on=False,
    )  # fmt: skip
