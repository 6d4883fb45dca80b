"""Diagnostics: the figures of a fit, each with a heading, words for readers who cannot see it, and an explanation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr, ndtri
from scipy.stats import beta

from copem_replay.core.tracks import Float, Int
from copem_replay.extras.fitting.errors import build_series
from copem_replay.report.figures.style import FAINT, INK, Colour, add_note, figure_style, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from copem_replay.extras.fitting.fit import Fit

RECORDED: Colour = (0.0, 114 / 255, 178 / 255)
FITTED: Colour = (213 / 255, 94 / 255, 0.0)
MEMORYLESS: Colour = (204 / 255, 121 / 255, 167 / 255)
"""Colours of the recording, of the fitted model, and of the model without memory, from Okabe and Ito's palette."""


@dataclass(frozen=True)
class FitFigure:
    """A figure. `title`: its heading. `shows`: for readers who cannot see it. `about`: the explanation below it.

    `missing`: why there is no figure; None: there is one.
    """

    title: str
    shows: str
    about: str
    draw: Callable[[Fit], Figure]
    missing: Callable[[Fit], str | None] = lambda fit: None


# Calibration: whether as many rows are listed as the fitted model says, near and far.

BINS = 12
"""Bins of range, with equal numbers of rows."""


def calibration_figure(fit: Fit) -> Figure:
    """The share listed over range, a point with its interval for each bin, and the mean fitted probability there."""
    rows, worth = fit.gathered.rows, max(fit.parts.detection.rows_per_effective, 1.0)
    range_m, p = rows.view.range_m, fit.parts.detection.probability(rows.view)
    edges = np.unique(np.quantile(range_m, np.linspace(0, 1, BINS + 1)))
    bin_ix = np.clip(np.searchsorted(edges, range_m, side="right") - 1, 0, max(len(edges) - 2, 0))
    n = np.bincount(bin_ix)
    filled = np.flatnonzero(n)
    n, at_m, fitted, share = (
        n[filled],
        *(np.bincount(bin_ix, of)[filled] / n[filled] for of in (range_m, p, rows.listed)),
    )
    k = share * n / worth
    low, high = beta.ppf([[0.025], [0.975]], k + 0.5, n / worth - k + 0.5)
    with figure_style():
        figure = new_figure(6.4, 3.6)
        axes = figure.subplots()
        axes.plot(at_m, fitted, color=FITTED, linewidth=1.8, label="fitted")
        bars = [np.maximum(share - low, 0), np.maximum(high - share, 0)]
        axes.errorbar(
            at_m, share, bars, fmt="o", color=RECORDED, markersize=5, capsize=2.5, linewidth=1.2, label="recorded"
        )
        axes.set(xlim=(0, None), ylim=(-0.03, 1.03), xlabel="Range (m)", ylabel="Share listed")
        axes.legend(loc="lower left")
        add_note(figure, [f"{len(p)} rows, worth {len(p) / worth:.0f} independent ones; bars: 95 %"])
    return figure


# Ranks: the replay check, the recording among replays of the fitted model.


def ranks_figure(fit: Fit) -> Figure:
    """A strip per statistic, a point per pass: the fitted model above, the model without memory below."""
    assert fit.checks is not None
    ranks, white = ({one.statistic: one.pit for one in checks} for checks in (fit.checks.fitted, fit.checks.memoryless))
    verdicts = {one.statistic: one.verdict for one in fit.checks.fitted}
    names, has_white = list(ranks), bool(white)
    with figure_style():
        figure = new_figure(8.0, 1.3 + 0.52 * len(names))
        axes = figure.subplots()
        axes.axvspan(0.025, 0.975, color=FAINT, alpha=0.1, linewidth=0)
        kinds = [("fitted", ranks, FITTED, "o", -0.17 if has_white else 0.0)]
        kinds += [("without memory", white, MEMORYLESS, "s", 0.17)] if has_white else []
        for label, of_kind, colour, mark, offset in kinds:
            for k, name in enumerate(names):
                ranked = np.sort(of_kind.get(name, np.empty(0)))
                axes.plot(
                    ranked, k + offset + _spread_points(ranked), mark, color=colour, markersize=4, linestyle="none",
                    label=label if k == 0 else None,
                )  # fmt: skip
        axes.set_yticks(range(len(names)), names)
        for k, name in enumerate(names):
            verdict = verdicts.get(name, "") + 4 * "\u00a0"  # room for wider letters in a browser
            axes.text(1.03, k, verdict, transform=axes.get_yaxis_transform(), va="center", fontsize=7.5)
        words = "Rank of the recorded value among replays of the fitted model"
        axes.set(ylim=(len(names) - 0.45, -0.55), xlim=(-0.02, 1.02), xlabel=words)
        axes.grid(visible=False, axis="y")
        if has_white:
            figure.legend(loc="outside upper left", ncols=2)
        passes = max((len(one) for one in ranks.values()), default=0)
        add_note(figure, [f"{passes} passes; a point each; grey: 95 % of the ranks of a model that is right"])
    return figure


def _spread_points(ranked: Float) -> Float:
    """Offsets that put points of about equal rank beside each other."""
    cell = np.floor(ranked * 60)
    nth = np.arange(len(cell)) - np.searchsorted(cell, cell)
    step = min(0.035, 0.13 / max((int(nth.max(initial=0)) + 1) // 2, 1))
    aside: Float = np.where(nth % 2 == 1, 1, -1) * ((nth + 1) // 2) * step
    return aside


# Autocorrelation: how long errors last, beside the fitted memory.

_LAGS = 40
_FEWEST = 10
"""Lags at most, and pairs below which no point is drawn."""


def autocorrelation_figure(fit: Fit) -> Figure:
    """The correlation of standardised errors over the time between them, and the fitted w·e^(−Δ/τ) + c."""
    rows, errors = fit.gathered.rows, fit.parts.errors
    shares, z = errors.shares, errors.shape.z
    series = build_series(rows.take(errors.rows))
    gaps_s = series.gap_s[~series.new]
    gaps_s = gaps_s[gaps_s > 0]  # lists may say one and the same time
    period_s = float(np.median(gaps_s)) if len(gaps_s) else 1.0  # no pair: no point is drawn
    series_ix, at_s = np.cumsum(series.new) - 1, rows.captured_s[errors.rows]
    far_s = min(max(20 * period_s, 4 * shares.tau_s if shares.drift else 0), 200 * period_s)
    lags = np.unique(np.geomspace(1, max(far_s / period_s, 2), _LAGS).round().astype(np.int64))
    correlations, n = _mean_products(z, series_ix, at_s, lags, period_s)
    with figure_style():
        figure = new_figure(6.4, 3.6)
        axes = figure.subplots()
        axes.axhline(0, color=FAINT, linewidth=0.8)
        has_pairs = n >= _FEWEST
        for column, name, colour, mark in zip(correlations.T, errors.axes, (RECORDED, FITTED), ("o", "^"), strict=True):
            axes.plot(lags[has_pairs] * period_s, column[has_pairs], mark, color=colour, markersize=4, label=name)
        dense = np.linspace(period_s / 4, lags[-1] * period_s, 300)
        label = f"fitted: {shares.drift:.2f} e^(−Δ/{shares.tau_s:.2g} s)" if shares.drift else "fitted: "
        label += f" + {shares.constant:.2f}" if shares.constant else ("0" if not shares.drift else "")
        axes.plot(dense, shares.drift * np.exp(-dense / shares.tau_s) + shares.constant, color=INK, linewidth=1.8,
                  label=label)  # fmt: skip
        least = min(-0.15, float(correlations[has_pairs].min(initial=0)) - 0.05)
        axes.set(ylim=(least, 1.02), xlim=(0, None), ylabel="Correlation of their errors")
        axes.set_xlabel("Time between two entries of an object (s)")
        axes.legend(loc="upper right")
        untold = errors.untold.get("memory.position")
        add_note(figure, [f"{len(z)} entries in {int(series.new.sum())} series", untold or ""])
    return figure


def _mean_products(z: Float, series_ix: Int, at_s: Float, lags: Int, period_s: float) -> tuple[Float, Int]:
    """(lags, 2) mean products of standardised errors `lags` periods apart (± half a period); (lags,) how many."""
    out, n = np.zeros((len(lags), 2)), np.zeros(len(lags), dtype=np.int64)
    z = z / np.sqrt((z**2).mean(axis=0))
    series_offset_s = 2 * np.ptp(at_s) + (lags[-1] + 1) * period_s
    key = series_offset_s * series_ix + at_s  # one axis of time on which series do not meet
    for k, lag in enumerate(lags):
        partner = np.searchsorted(key, key + (lag - 0.5) * period_s)
        partner = np.minimum(partner, len(key) - 1)
        is_partner = (key[partner] - key < (lag + 0.5) * period_s) & (key[partner] > key)
        n[k] = int(is_partner.sum())
        if n[k]:
            out[k] = (z[is_partner] * z[partner[is_partner]]).mean(axis=0)
    return out, n


# Error map: whether errors and misses belong to places.

_MOST_POINTS = 6000
_MOST_VECTOR_POINTS = 1500
"""Points that are drawn at most, and above which they are one raster image, to keep the page small."""


def error_map_figure(fit: Fit) -> Figure:
    """True places of objects, coloured by the error of their entry, crosses where missed; a triangle for the unit."""
    rows = fit.gathered.rows
    step = max(len(rows.log) // _MOST_POINTS, 1)
    drawn = rows.take(np.arange(0, len(rows.log), step))
    error_m = np.hypot(drawn.east_m, drawn.north_m)
    hit = drawn.listed & np.isfinite(error_m)
    centre = rows.state_m.mean(axis=0)
    x, y = (drawn.state_m - centre).T
    span = np.maximum(np.ptp(rows.state_m, axis=0), 5.0)
    high = float(np.clip(7.0 * span[1] / span[0], 3.0, 7.5))
    picture = len(x) > _MOST_VECTOR_POINTS
    with figure_style():
        figure = new_figure(7.6, high)
        axes = figure.subplots()
        order = np.argsort(error_m[hit])
        shown = axes.scatter(
            x[hit][order], y[hit][order], c=error_m[hit][order], cmap="viridis", s=9, linewidths=0, rasterized=picture,
            vmin=0, vmax=float(np.quantile(error_m[hit], 0.98)),
        )  # fmt: skip
        missed = ~drawn.listed
        axes.scatter(
            x[missed], y[missed], marker="x", color=MEMORYLESS, s=11, linewidths=0.8, zorder=1, rasterized=picture
        )
        places = (
            np.unique(np.column_stack([fit.gathered.lists.east_m, fit.gathered.lists.north_m]).round(1), axis=0)[:2000]
            - centre
        )
        axes.plot(*places.T, "^" if len(places) < 5 else ".", color=INK, markersize=8 if len(places) < 5 else 2)
        figure.colorbar(shown, ax=axes, shrink=0.85, pad=0.02, label="Error of the entry (m)")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="East of the middle (m)", ylabel="North of the middle (m)")
        thinned = f", of which one in {step} is drawn" if step > 1 else ""
        add_note(figure, [f"{len(rows.log)} rows{thinned}; crosses: missed; triangle (or dots, if it moves): the unit"])
    return figure


# Gaussian: whether position errors are, by quantiles of standardised errors and by the fitted distribution.

_POINTS = 120
_BARS = 20


def gaussian_figure(fit: Fit) -> Figure:
    """Left: quantiles over normal ones; right: the share of errors in each twentieth of the fitted distribution."""
    errors = fit.parts.errors
    z, shape = errors.shape.z, errors.shape
    level = (np.arange(min(_POINTS, len(z))) + 0.5) / min(_POINTS, len(z))
    with figure_style():
        figure = new_figure(8.6, 3.6)
        left, right = figure.subplots(1, 2)
        most = float(max(2.6, np.abs(np.quantile(z, [level[0], level[-1]])).max())) * 1.08
        left.plot([-most, most], [-most, most], color=FAINT, linewidth=1.0, dashes=(4, 2))
        for column, name, colour, mark in zip(z.T, errors.axes, (RECORDED, FITTED), ("o", "^"), strict=True):
            left.plot(ndtri(level), np.quantile(column, level), mark, color=colour, markersize=3, label=name)
            count = np.histogram(ndtr(column), np.linspace(0, 1, _BARS + 1))[0] / len(column) * _BARS
            right.step(np.linspace(0, 1, _BARS + 1), np.append(count, count[-1]), where="post", color=colour,
                       linewidth=1.6, label=name)  # fmt: skip
        worth = max(sum(one.covariance_m2[0].n_effective for one in errors.bins), 1)
        aside = 1.96 * np.sqrt((_BARS - 1) / worth)
        right.axhspan(max(1 - aside, 0), 1 + aside, color=FAINT, alpha=0.15, linewidth=0)
        right.axhline(1.0, color=FAINT, linewidth=1.0, dashes=(4, 2))
        left.set(xlabel="Quantile of a normal", ylabel="Standardised error")
        right.set(xlabel="Probability of a smaller error, as fitted", ylabel="Errors, relative to even")
        right.set(ylim=(0, None), xlim=(0, 1))
        left.legend(loc="upper left")
        add_note(figure, [f"{len(z)} entries; {shape.words()}"])
    return figure


# All figures.

FIT_FIGURES = {
    "ranks": FitFigure(
        "Does a replay look like the recording?",
        "rank of each recorded pass among replays of the fitted model, a strip per statistic",
        "For each pass the recorded value is ranked among runs of the fitted model: 0 is below all of them, 1 "
        "above. Of a model that is right, ranks are spread evenly. Ranks in a heap in the middle: the model "
        "varies too much; at the ends: it is too sure.",
        ranks_figure,
        lambda fit: (
            None if fit.checks is not None and fit.checks.fitted else "nothing was replayed beside what was recorded"
        ),
    ),
    "calibration": FitFigure(
        "Is the probability of detection right?",
        "share of rows that are listed over range, with intervals, beside the fitted probability",
        "Rows (a list and a true object within reach) are put into bins by range. The line is the mean "
        "probability that the fitted model gives them. Intervals count rows that hang together for less. A point "
        "whose bar misses the line is a range at which the model is wrong.",
        calibration_figure,
    ),
    "error_map": FitFigure(
        "Errors over the map",
        "true places of objects, coloured by the error of their entries, with crosses where they are missed",
        "Where objects truly are, seen from above. Colours or crosses that gather in one place (a tree, a pole, a"
        " crest) are not explained by range and visible share: an obstacle may be missing in the experiment, or "
        "the truth be off there.",
        error_map_figure,
        lambda fit: None if fit.gathered.rows.listed.any() else "no entry is of a true object",
    ),
    "autocorrelation": FitFigure(
        "How long do errors last?",
        "autocorrelation of standardised position errors over time, and the fitted curve",
        "Points near 1: an entry's error is nearly the same in the next list, and no tracker can average it away."
        " The line is the fitted memory: a part that drifts and is forgotten with its correlation time, and a "
        "part that stays for as long as the object is there. Points that begin below 1 at time 0 leave a rest "
        "that is new in every list. Over few passes points fall too low at long times, as they are taken about a "
        "mean of their own.",
        autocorrelation_figure,
    ),
    "gaussian": FitFigure(
        "Are the errors Gaussian?",
        "quantiles of standardised position errors over normal ones, and a histogram of their probabilities",
        "Errors have the fitted mean taken off and are divided by the fitted spread. On the dashed line (left), "
        "and within the grey band (right), they are Gaussian. Ends that leave the line are rare large errors, of "
        "which the model has too few.",
        gaussian_figure,
    ),
}
"""Figures by name, in the order of the page: those by which a model is trusted or not."""
