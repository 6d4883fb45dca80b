"""The replay check: where what was recorded ranks among replays of the fitted model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.report.figures.style import FAINT, add_note, new_figure, style
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.study import FITTED, MEMORYLESS, FitStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def ranks_figure(study: FitStudy) -> Figure:
    """A strip per statistic: a point per pass, of the fitted model above, of one without memory below."""
    names = list(study.ranks)
    both = bool(study.ranks_memoryless)
    with style():
        figure = new_figure(8.0, 1.3 + 0.52 * len(names))
        axes = figure.subplots()
        axes.axvspan(0.025, 0.975, color=FAINT, alpha=0.1, linewidth=0)
        kinds = [("fitted", study.ranks, FITTED, "o", -0.17 if both else 0.0)]
        kinds += [("without memory", study.ranks_memoryless, MEMORYLESS, "s", 0.17)] if both else []
        for label, ranks, colour, mark, offset in kinds:
            for k, name in enumerate(names):
                ranked = np.sort(ranks.get(name, np.empty(0)))
                axes.plot(ranked, k + offset + _aside(ranked), mark, color=colour, markersize=4, linestyle="none",
                          label=label if k == 0 else None)  # fmt: skip
        axes.set_yticks(range(len(names)), names)
        for k, name in enumerate(names):
            said = study.verdicts.get(name, "") + 4 * "\u00a0"  # a browser's letters may be wider than those measured
            axes.text(1.03, k, said, transform=axes.get_yaxis_transform(), va="center", fontsize=7.5)
        axes.set_ylim(len(names) - 0.45, -0.55)
        axes.set_xlim(-0.02, 1.02)
        axes.set_xlabel("Rank of the recorded value among replays of the fitted model")
        axes.grid(visible=False, axis="y")
        if both:
            figure.legend(loc="outside upper left", ncols=2)
        passes = max((len(one) for one in study.ranks.values()), default=0)
        add_note(figure, [f"{passes} passes; a point each; grey: 95 % of the ranks of a model that is right"])
    return figure


def _aside(ranked: Float) -> Float:
    """Points that would lie on each other beside each other."""
    cell = np.floor(ranked * 60)
    nth = np.arange(len(cell)) - np.searchsorted(cell, cell)
    step = min(0.035, 0.13 / max((int(nth.max(initial=0)) + 1) // 2, 1))
    aside: Float = np.where(nth % 2 == 1, 1, -1) * ((nth + 1) // 2) * step
    return aside


def _none(study: FitStudy) -> str | None:
    return None if study.ranks else "nothing was replayed beside what was recorded"


RANKS = FitFigure(
    "Does a replay look like the recording?",
    "rank of each recorded pass among replays of the fitted model, a strip per statistic",
    "For each pass the recorded value is ranked among runs of the fitted model: 0 is below all of them, 1 above. Of a "
    "model that is right, ranks are spread evenly. Ranks in a heap in the middle: the model varies too much; at the "
    "ends: it is too sure.",
    ranks_figure,
    _none,
)
