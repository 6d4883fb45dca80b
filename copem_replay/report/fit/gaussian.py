"""Whether position errors are Gaussian: quantiles of standardised errors, and where they fall in the fitted law."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr, ndtri

from copem_replay.report.figures.style import FAINT, add_note, new_figure, style
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.study import FITTED, RECORDED, FitStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_POINTS = 120
_BARS = 20


def gaussian_figure(study: FitStudy) -> Figure:
    """Left: quantiles over those of a normal; right: the share of errors in each twentieth of the fitted law."""
    z = study.errors.shape.z
    names = ("along", "across") if study.errors.frame == "line_of_sight" else ("easting", "northing")
    level = (np.arange(min(_POINTS, len(z))) + 0.5) / min(_POINTS, len(z))
    with style():
        figure = new_figure(8.6, 3.6)
        left, right = figure.subplots(1, 2)
        most = float(max(2.6, np.abs(np.quantile(z, [level[0], level[-1]])).max())) * 1.08
        left.plot([-most, most], [-most, most], color=FAINT, linewidth=1.0, dashes=(4, 2))
        for column, name, colour, mark in zip(z.T, names, (RECORDED, FITTED), ("o", "^"), strict=True):
            left.plot(ndtri(level), np.quantile(column, level), mark, color=colour, markersize=3, label=name)
            count = np.histogram(ndtr(column), np.linspace(0, 1, _BARS + 1))[0] / len(column) * _BARS
            right.step(np.linspace(0, 1, _BARS + 1), np.append(count, count[-1]), where="post", color=colour,
                       linewidth=1.6, label=name)  # fmt: skip
        worth = max(
            float(np.mean([one.mean_m[0].n_effective for one in study.errors.bins])) * len(study.errors.bins), 1
        )
        aside = 1.96 * np.sqrt((_BARS - 1) / worth)
        right.axhspan(max(1 - aside, 0), 1 + aside, color=FAINT, alpha=0.15, linewidth=0)
        right.axhline(1.0, color=FAINT, linewidth=1.0, dashes=(4, 2))
        right.set_ylim(bottom=0)
        right.set_xlim(0, 1)
        left.set_xlabel("Quantile of a normal")
        left.set_ylabel("Standardised error")
        right.set_xlabel("Probability of a smaller error, as fitted")
        right.set_ylabel("Errors, relative to even")
        left.legend(loc="upper left")
        shape = study.errors.shape
        tails = "heavier" if shape.t4_gain > 0 else "no heavier"
        add_note(
            figure,
            [f"{len(z)} entries; excess kurtosis {shape.excess_kurtosis:.2g}; Student's t₄ explains "
             f"{shape.t4_gain:+.2g} nats per row more: tails are {tails} than a Gaussian's"],
        )  # fmt: skip
    return figure


GAUSSIAN = FitFigure(
    "Are the errors Gaussian?",
    "quantiles of standardised position errors over normal ones, and a histogram of their probabilities",
    "Errors have the fitted mean taken off and are divided by the fitted spread. On the dashed line (left), and within "
    "the grey band (right), they are Gaussian. Ends that leave the line are rare large errors, of which the model has "
    "too few.",
    gaussian_figure,
)
