"""How long errors last: their autocorrelation over time, beside that of the fitted memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float, Int
from copem_replay.pipeline.fit.errors import series_of
from copem_replay.report.figures.style import FAINT, INK, add_note, new_figure, style
from copem_replay.report.fit.kind import FitFigure
from copem_replay.report.fit.study import FITTED, RECORDED, FitStudy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LAGS = 40
_FEWEST = 10


def autocorrelation_figure(study: FitStudy) -> Figure:
    """Correlation of standardised errors with those some time later, and w·e^(−Δ/τ) + c."""
    fit, z = study.errors, study.errors.shape.z
    series = series_of(study.rows.take(fit.rows))
    period_s = float(np.median(series.gap_s[~series.new]))
    series_ix, at_s = np.cumsum(series.new) - 1, study.rows.captured_s[fit.rows]
    far_s = min(max(20 * period_s, 4 * fit.shares.tau_s if fit.shares.drift else 0), 200 * period_s)
    lags = np.unique(np.geomspace(1, max(far_s / period_s, 2), _LAGS).round().astype(np.int64))
    found, n = _correlations(z, series_ix, at_s, lags, period_s)
    names = ("along", "across") if fit.frame == "line_of_sight" else ("easting", "northing")
    with style():
        figure = new_figure(6.4, 3.6)
        axes = figure.subplots()
        axes.axhline(0, color=FAINT, linewidth=0.8)
        there = n >= _FEWEST
        for column, name, colour, mark in zip(found.T, names, (RECORDED, FITTED), ("o", "^"), strict=True):
            axes.plot(lags[there] * period_s, column[there], mark, color=colour, markersize=4, label=name)
        shares = fit.shares
        dense = np.linspace(period_s / 4, lags[-1] * period_s, 300)
        said = f"fitted: {shares.drift:.2f} e^(−Δ/{shares.tau_s:.2g} s)" if shares.drift else "fitted: "
        said += f" + {shares.constant:.2f}" if shares.constant else ("0" if not shares.drift else "")
        axes.plot(dense, shares.drift * np.exp(-dense / shares.tau_s) + shares.constant, color=INK, linewidth=1.8,
                  label=said)  # fmt: skip
        axes.set_ylim(min(-0.15, float(found[there].min(initial=0)) - 0.05), 1.02)
        axes.set_xlim(left=0)
        axes.set_xlabel("Time between two entries of an object (s)")
        axes.set_ylabel("Correlation of their errors")
        axes.legend(loc="upper right")
        untold = fit.untold.get("memory.position")
        add_note(figure, [f"{len(z)} entries in {int(series.new.sum())} series", untold or ""])
    return figure


def _correlations(z: Float, series_ix: Int, at_s: Float, lags: Int, period_s: float) -> tuple[Float, Int]:
    """(lags, 2) mean products of errors so many periods apart, ± a half, of variance 1, and how many."""
    out, n = np.zeros((len(lags), 2)), np.zeros(len(lags), dtype=np.int64)
    z = z / np.sqrt((z**2).mean(axis=0))
    key = 2 * (at_s[-1] - at_s[0] + np.ptp(at_s) + 1) * series_ix + at_s  # one axis of time on which series do not meet
    for k, lag in enumerate(lags):
        later = np.searchsorted(key, key + (lag - 0.5) * period_s)
        later = np.minimum(later, len(key) - 1)
        close = (key[later] - key < (lag + 0.5) * period_s) & (key[later] > key)
        n[k] = int(close.sum())
        if n[k]:
            out[k] = (z[close] * z[later[close]]).mean(axis=0)
    return out, n


AUTOCORRELATION = FitFigure(
    "How long do errors last?",
    "autocorrelation of standardised position errors over time, and the fitted curve",
    "Points near 1: an entry's error is nearly the same in the next list, and no tracker can average it away. The line "
    "is the fitted memory: a part that drifts and is forgotten with its correlation time, and a part that stays for as "
    "long as the object is there. Points that begin below 1 at time 0 leave a rest that is new in every list. Over few "
    "passes points fall too low at long times, as they are taken about a mean of their own.",
    autocorrelation_figure,
)
