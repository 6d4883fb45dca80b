"""Whether probabilities of detection are right: as many rows are listed as the fitted model says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import beta

from copem_replay.report.figures.style import FAINT, add_note, new_figure, style
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.study import RECORDED, FitStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BINS = 12


def calibration_figure(study: FitStudy) -> Figure:
    """The share listed over the fitted probability, a point with its interval for each bin."""
    p, hit, worth = study.probability, study.rows.listed, max(study.detection.rows_per_effective, 1.0)
    edges = np.unique(np.quantile(p, np.linspace(0, 1, BINS + 1)))
    bin_ix = np.clip(np.searchsorted(edges, p, side="right") - 1, 0, max(len(edges) - 2, 0))
    n = np.bincount(bin_ix)
    there = np.flatnonzero(n)
    n, said, share = n[there], *(np.bincount(bin_ix, of)[there] / n[there] for of in (p, hit))
    k = share * n / worth
    low, high = beta.ppf([[0.025], [0.975]], k + 0.5, n / worth - k + 0.5)
    with style():
        figure = new_figure(5.2, 4.4)
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=FAINT, linewidth=1.0, dashes=(4, 2))
        bars = [np.maximum(share - low, 0), np.maximum(high - share, 0)]
        axes.errorbar(said, share, bars, fmt="o", color=RECORDED, markersize=5, capsize=2.5, linewidth=1.2)
        around = [float(min(said.min(), low.min())), float(max(said.max(), high.max()))]
        room = 0.06 * max(around[1] - around[0], 0.1)
        wide = max(room, 0.1 - np.ptp(said) / 2)
        axes.set_xlim(max(said.min() - wide, -0.02), min(said.max() + wide, 1.02))
        axes.set_ylim(max(around[0] - room, -0.02), min(around[1] + room, 1.02))
        axes.set_xlabel("Fitted probability of detection")
        axes.set_ylabel("Share listed")
        add_note(figure, [f"{len(p)} rows, worth {len(p) / worth:.0f} independent ones; bars: 95 %"])
    return figure


CALIBRATION = FitFigure(
    "Is the probability of detection right?",
    "share of rows that are listed over the fitted probability, with intervals, beside the diagonal",
    "Rows (a list and a true object within reach) are put into bins by the probability that the fitted model gives "
    "them. Points on the dashed line: as many are listed as the model says. Intervals count rows that hang together "
    "for less. A point bin_ix bar misses the line is a place where the model is wrong.",
    calibration_figure,
)
