"""Dots with intervals, a row per configuration: what the figures of the answer and of differences are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from copem_replay.report.figures.captions import short_names
from copem_replay.report.figures.style import FAINT, INK, Appearance, of_configuration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROW_IN = 0.27
"""Height of a row."""
_DOT = 34.0
"""Area of a dot (square points)."""


@dataclass(frozen=True)
class Dot:
    """A value with its limits, or without. `words`: beside it; `sure`: in bold. A value of None has words only."""

    value: float | None
    low: float | None
    high: float | None
    words: str
    sure: bool = False


def draw_rows(axes: Axes, dots: Sequence[tuple[str, Dot]], looks: dict[str, Appearance], *, named: bool) -> None:
    """A row each, the first at the top: a filled dot where there is an interval, a hollow one where there is none.

    `named`: names at the left.
    """
    numbers = {name: k for k, name in enumerate(looks)}
    for row, (name, dot) in enumerate(dots):
        with of_configuration(numbers[name], axes):
            _row(axes, row, dot, looks[name], name)
    short = short_names([name for name, _ in dots])
    axes.set_yticks(range(len(dots)), [short[name] for name, _ in dots] if named else [])
    axes.set_ylim(len(dots) - 0.45, -0.55)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.spines["left"].set_visible(False)
    for k in range(1, len(dots)):
        axes.axhline(k - 0.5, color="0.93", linewidth=0.6, zorder=0.5)


def _row(axes: Axes, row: int, dot: Dot, look: Appearance, name: str) -> None:
    words: dict[str, Any] = {"va": "center_baseline", "fontsize": 8, "clip_on": False}
    axes.text(
        1.03, row, dot.words, transform=axes.get_yaxis_transform(), ha="left",
        color=INK if dot.value is not None else FAINT, fontweight="bold" if dot.sure else "normal", **words,
    )  # fmt: skip
    if dot.value is None:
        return
    limits = dot.low is not None and dot.high is not None
    if dot.low is not None and dot.high is not None:
        if look.edge != look.colour:
            axes.plot([dot.low, dot.high], [row, row], color=look.edge, linewidth=3.6, zorder=2, label="_outline")
        axes.plot([dot.low, dot.high], [row, row], color=look.colour, linewidth=2.4, zorder=2.1, label=f"of {name}")
    axes.scatter(
        [dot.value], [row], s=_DOT, marker=look.marker, zorder=3, label=name, linewidths=1.0 if limits else 1.6,
        facecolor=look.colour if limits else "white", edgecolor=look.edge, clip_on=False,
    )  # fmt: skip
