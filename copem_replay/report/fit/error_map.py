"""Errors and misses over the map: whether they belong to places."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.report.figures.style import INK, add_note, new_figure, style
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.study import MEMORYLESS, FitStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST = 6000
_PICTURE = 1500
"""Points that are drawn, and from which they are one picture in the file (chosen)."""


def error_map_figure(study: FitStudy) -> Figure:
    """True places of objects: entries by the size of their error, misses as crosses; the unit as a triangle."""
    rows = study.rows
    step = max(len(rows.log) // _MOST, 1)
    some = rows.take(np.arange(0, len(rows.log), step))
    error_m = np.hypot(some.east_m, some.north_m)
    hit = some.listed & np.isfinite(error_m)
    centre = rows.state_m.mean(axis=0)
    x, y = (some.state_m - centre).T
    span = np.maximum(np.ptp(rows.state_m, axis=0), 5.0)
    high = float(np.clip(7.0 * span[1] / span[0], 3.0, 7.5))
    picture = len(x) > _PICTURE
    with style():
        figure = new_figure(7.6, high)
        axes = figure.subplots()
        order = np.argsort(error_m[hit])
        shown = axes.scatter(
            x[hit][order], y[hit][order], c=error_m[hit][order], cmap="viridis", s=9, linewidths=0, rasterized=picture,
            vmin=0, vmax=float(np.quantile(error_m[hit], 0.98)),
        )  # fmt: skip
        missed = ~some.listed
        axes.scatter(
            x[missed], y[missed], marker="x", color=MEMORYLESS, s=11, linewidths=0.8, zorder=1, rasterized=picture
        )
        at = np.unique(np.column_stack([study.lists.east_m, study.lists.north_m]).round(1), axis=0)[:2000] - centre
        axes.plot(*at.T, "^" if len(at) < 5 else ".", color=INK, markersize=8 if len(at) < 5 else 2)
        bar = figure.colorbar(shown, ax=axes, shrink=0.85, pad=0.02)
        bar.set_label("Error of the entry (m)")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("East of the middle (m)")
        axes.set_ylabel("North of the middle (m)")
        every = f", of which one in {step} is drawn" if step > 1 else ""
        add_note(figure, [f"{len(rows.log)} rows{every}; crosses: missed; triangle (or dots, if it moves): the unit"])
    return figure


def _none(study: FitStudy) -> str | None:
    return None if study.rows.listed.any() else "no entry is of a true object"


ERROR_MAP = FitFigure(
    "Errors over the map",
    "true places of objects, coloured by the error of their entries, with crosses where they are missed",
    "Where objects truly are, seen from above. Colours or crosses that gather in one place (a tree, a pole, a crest) "
    "are not explained by range and visible share: an obstacle may be missing in the experiment, or the truth be "
    "off there.",
    error_map_figure,
    _none,
)
