"""Where objects are detected: by range and visible share, as recorded and as fitted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.report.figures.style import add_note, new_figure, style
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.study import FitStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHARES = (0.0, 0.25, 0.5, 0.75, 0.95, 1.0)
_BINS = 6
_LIGHT, _DARK = (0.98, 0.99, 1.0), (0.04, 0.05, 0.1)
"""Of numbers on colours: no greys, which a dark page would turn."""


def probability_map_figure(study: FitStudy) -> Figure:
    """Two panels: the share listed in each cell, with its number of rows, and the mean fitted probability."""
    view = study.rows.view
    edges: Float = np.unique(np.round(np.quantile(view.range_m, np.linspace(0, 1, _BINS + 1)), 1))
    if len(edges) < 2:
        edges = np.array([edges[0] - 0.5, edges[0] + 0.5])
    column = np.clip(np.searchsorted(edges, view.range_m, side="right") - 1, 0, len(edges) - 2)
    every = np.clip(np.searchsorted(_SHARES, view.visible_share, side="right") - 1, 0, len(_SHARES) - 2)
    used = np.unique(every)
    row = np.searchsorted(used, every)
    shape = (len(used), len(edges) - 1)
    cell = row * shape[1] + column

    def summed(of: Float) -> Float:
        return np.bincount(cell, of, shape[0] * shape[1]).reshape(shape).astype(float)

    n = summed(np.ones(len(cell)))
    with np.errstate(invalid="ignore"):
        recorded, fitted = summed(study.rows.listed.astype(float)) / n, summed(study.probability) / n
    with style():
        figure = new_figure(8.6, 1.5 + 0.5 * shape[0])
        panels = figure.subplots(1, 2, sharey=True)
        for axes, values, title in zip(panels, (recorded, fitted), ("Recorded: share listed", "Fitted"), strict=True):
            _panel(axes, values, n, edges, title)
        names = [f"{_SHARES[k]:g} to {_SHARES[k + 1]:g}" for k in used]
        panels[0].set_yticks(np.arange(shape[0]) + 0.5, names)
        panels[0].set_ylabel("Visible share")
        add_note(
            figure, ["In each cell the share, and below it how many rows it has; cells without a number have none"]
        )
    return figure


def _panel(axes: Axes, values: Float, n: Float, edges: Float, title: str) -> None:
    rows, columns = values.shape
    shown = np.ma.masked_invalid(values)
    axes.pcolormesh(np.arange(columns + 1), np.arange(rows + 1), shown, cmap="cividis", vmin=0, vmax=1)
    for i in range(rows):
        for j in range(columns):
            if n[i, j]:
                colour = _LIGHT if values[i, j] < 0.55 else _DARK
                text = f"{values[i, j]:.2f}\n{n[i, j]:.0f}"
                axes.text(j + 0.5, i + 0.5, text, color=colour, ha="center", va="center", fontsize=7)
    axes.set_xticks(np.arange(columns + 1), [f"{edge:g}" for edge in edges])
    axes.set_xlabel("Range (m)")
    axes.set_title(title, loc="left")
    axes.grid(visible=False)
    axes.tick_params(length=0)


PROBABILITY_MAP = FitFigure(
    "Where is it detected?",
    "share listed and fitted probability in cells of range and visible share, with numbers of rows",
    "Farther to the right an object is farther away, farther up more of it is visible. The left panel is what was "
    "recorded, the right one what the fitted table gives for the same rows. Cells with few rows say little; the model "
    "claims nothing beyond the largest range.",
    probability_map_figure,
)
