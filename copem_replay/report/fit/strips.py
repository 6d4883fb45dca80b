"""Each pass as a strip of hits and misses: how misses lie together is seen before anything is fitted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Bool, Float
from copem_replay.report.figures.style import add_note, new_figure, style
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.study import FITTED, RECORDED, FitStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST = 40
"""Passes that are drawn (chosen)."""
_PICTURE = 1000
"""Changes between hits and misses from which the strips are one picture in the file (chosen)."""


def strips_figure(study: FitStudy) -> Figure:
    """A row per pass: hits as a bar, misses as a thin one of another colour."""
    first, rows = study.first_rows, study.rows
    P = len(first) - 1
    shown = np.unique(np.linspace(0, P - 1, min(P, MOST)).round().astype(np.int64))
    with style():
        figure = new_figure(8.6, 1.0 + 0.17 * max(len(shown), 3))
        axes = figure.subplots()
        picture = bool((np.diff(rows.listed.astype(np.int8)) != 0).sum() > _PICTURE)
        for k, p in enumerate(shown):
            mine = slice(first[p], first[p + 1])
            since_s = rows.captured_s[mine] - rows.captured_s[first[p]]
            step_s = float(np.median(np.diff(since_s))) if len(since_s) > 1 else 0.1
            for hit, half, colour in ((True, 0.36, RECORDED), (False, 0.13, FITTED)):
                bars = _runs(rows.listed[mine] == hit, since_s, step_s)
                axes.broken_barh(bars, (k - half, 2 * half), color=colour, linewidth=0, rasterized=picture)
        axes.set_yticks(range(len(shown)), [f"{p + 1}" for p in shown], fontsize=6.5)
        axes.set_ylim(len(shown) - 0.4, -0.6)
        axes.set_xlim(left=0)
        axes.set_ylabel("Pass")
        axes.set_xlabel("Time since the object came within reach (s)")
        axes.grid(visible=False, axis="y")
        some = f", of which {len(shown)} are drawn" if len(shown) < P else ""
        add_note(figure, [f"{P} passes{some}; broad: listed, thin: missed"])
    return figure


def _runs(which: Bool, since_s: Float, step_s: float) -> list[tuple[float, float]]:
    """(start, length) of each run of rows, until the next row; over a gap only as far as a list lasts."""
    change = np.flatnonzero(np.diff(np.concatenate([[0], which.astype(np.int8), [0]])))
    until_s = np.append(np.minimum(since_s[1:], since_s[:-1] + 2 * step_s), since_s[-1] + step_s)
    return [
        (float(since_s[a]), float(until_s[b - 1] - since_s[a])) for a, b in zip(*change.reshape(-1, 2).T, strict=True)
    ]


STRIPS = FitFigure(
    "Hits and misses, pass by pass",
    "a strip per pass, broad where the object is listed, thin where it is missed",
    "A pass is one unbroken stay of an object within reach. Misses that come singly, here and there, are what a model "
    "without memory makes; long thin stretches are misses that last, and need one.",
    strips_figure,
)
