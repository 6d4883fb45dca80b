"""Diagnostics: the figures of a fit, each with a heading, words for readers who cannot see it, and an explanation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr, ndtri
from scipy.stats import beta

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.fitting.errors import build_series
from copem_replay.report.figures.style import FAINT, INK, Colour, add_note, figure_style, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.fitting.detection import DetectionFit
    from copem_replay.fitting.errors import ErrorFit
    from copem_replay.fitting.estimate import Estimate
    from copem_replay.fitting.rest import RestFit
    from copem_replay.fitting.rows import FitLists, FitRows


RECORDED: Colour = (0.0, 114 / 255, 178 / 255)
FITTED: Colour = (213 / 255, 94 / 255, 0.0)
MEMORYLESS: Colour = (204 / 255, 121 / 255, 167 / 255)
"""Colours of the recording, of the fitted model, and of the model without memory, from Okabe and Ito's palette."""


@dataclass(frozen=True)
class FitStudy:
    """A fitted unit, as its figures need it. `estimates`: all numbers by name. `delay_s`: the delay that is used.

    `ranks`: by statistic of the replay check the rank (0 … 1) of each recorded value among fitted runs;
    `ranks_memoryless`: among runs without memory. `verdicts`: those of the check, by statistic. `notes`: lines.
    """

    unit: str
    logs: Sequence[str]
    rows: FitRows
    lists: FitLists
    detection: DetectionFit
    errors: ErrorFit
    rest: RestFit
    delay_s: float
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    ranks: Mapping[str, Float] = field(default_factory=dict)
    ranks_memoryless: Mapping[str, Float] = field(default_factory=dict)
    verdicts: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()

    @cached_property
    def probability(self) -> Float:
        """(R,) the fitted probability that each row is listed."""
        return self.detection.probability(self.rows.view)

    @cached_property
    def first_rows(self) -> np.ndarray:
        """(P + 1,) where each pass begins."""
        new = np.flatnonzero(np.diff(self.rows.pass_ix)) + 1
        return np.concatenate([[0], new, [len(self.rows.pass_ix)]])


def _nothing_missing(study: FitStudy) -> str | None:
    return None


@dataclass(frozen=True)
class FitFigure:
    """A figure. `title`: its heading. `shows`: for readers who cannot see it. `about`: the explanation below it.

    `missing`: why there is no figure; None: there is one.
    """

    title: str
    shows: str
    about: str
    draw: Callable[[FitStudy], Figure]
    missing: Callable[[FitStudy], str | None] = _nothing_missing


# Calibration: whether as many rows are listed as the fitted model says.

BINS = 12
"""Bins of probability, with equal numbers of rows."""


def calibration_figure(study: FitStudy) -> Figure:
    """The share listed over the fitted probability, a point with its interval for each bin."""
    p, hit, worth = study.probability, study.rows.listed, max(study.detection.rows_per_effective, 1.0)
    edges = np.unique(np.quantile(p, np.linspace(0, 1, BINS + 1)))
    bin_ix = np.clip(np.searchsorted(edges, p, side="right") - 1, 0, max(len(edges) - 2, 0))
    n = np.bincount(bin_ix)
    filled = np.flatnonzero(n)
    n, fitted, share = n[filled], *(np.bincount(bin_ix, of)[filled] / n[filled] for of in (p, hit))
    k = share * n / worth
    low, high = beta.ppf([[0.025], [0.975]], k + 0.5, n / worth - k + 0.5)
    with figure_style():
        figure = new_figure(5.2, 4.4)
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=FAINT, linewidth=1.0, dashes=(4, 2))
        bars = [np.maximum(share - low, 0), np.maximum(high - share, 0)]
        axes.errorbar(fitted, share, bars, fmt="o", color=RECORDED, markersize=5, capsize=2.5, linewidth=1.2)
        extent = [float(min(fitted.min(), low.min())), float(max(fitted.max(), high.max()))]
        room = 0.06 * max(extent[1] - extent[0], 0.1)
        wide = max(room, 0.1 - np.ptp(fitted) / 2)
        axes.set_xlim(max(fitted.min() - wide, -0.02), min(fitted.max() + wide, 1.02))
        axes.set_ylim(max(extent[0] - room, -0.02), min(extent[1] + room, 1.02))
        axes.set_xlabel("Fitted probability of detection")
        axes.set_ylabel("Share listed")
        add_note(figure, [f"{len(p)} rows, worth {len(p) / worth:.0f} independent ones; bars: 95 %"])
    return figure


CALIBRATION = FitFigure(
    "Is the probability of detection right?",
    "share of rows that are listed over the fitted probability, with intervals, beside the diagonal",
    "Rows (a list and a true object within reach) are put into bins by the probability that the fitted model gives "
    "them. Points on the dashed line: as many are listed as the model says. Intervals count rows that hang together "
    "for less. A point whose bar misses the line is a place where the model is wrong.",
    calibration_figure,
)


# Probability map: the share listed by range and visible share, as recorded and as fitted.

_SHARES = (0.0, 0.25, 0.5, 0.75, 0.95, 1.0)
_BINS = 6
_LIGHT, _DARK = (0.98, 0.99, 1.0), (0.04, 0.05, 0.1)
"""Colours of numbers on cells: no pure greys, which a dark page would invert."""


def probability_map_figure(study: FitStudy) -> Figure:
    """Two panels: the share listed in each cell, with its number of rows, and the mean fitted probability."""
    view = study.rows.view
    edges: Float = np.unique(np.round(np.quantile(view.range_m, np.linspace(0, 1, _BINS + 1)), 1))
    if len(edges) < 2:
        edges = np.array([edges[0] - 0.5, edges[0] + 0.5])
    column = np.clip(np.searchsorted(edges, view.range_m, side="right") - 1, 0, len(edges) - 2)
    share_ix = np.clip(np.searchsorted(_SHARES, view.visible_share, side="right") - 1, 0, len(_SHARES) - 2)
    used = np.unique(share_ix)
    row = np.searchsorted(used, share_ix)
    shape = (len(used), len(edges) - 1)
    cell = row * shape[1] + column

    def summed(of: Float) -> Float:
        return np.bincount(cell, of, shape[0] * shape[1]).reshape(shape).astype(float)

    n = summed(np.ones(len(cell)))
    with np.errstate(invalid="ignore"):
        recorded, fitted = summed(study.rows.listed.astype(float)) / n, summed(study.probability) / n
    with figure_style():
        figure = new_figure(8.6, 1.5 + 0.5 * shape[0])
        panels = figure.subplots(1, 2, sharey=True)
        for axes, values, title in zip(panels, (recorded, fitted), ("Recorded: share listed", "Fitted"), strict=True):
            _draw_panel(axes, values, n, edges, title)
        names = [f"{_SHARES[k]:g} to {_SHARES[k + 1]:g}" for k in used]
        panels[0].set_yticks(np.arange(shape[0]) + 0.5, names)
        panels[0].set_ylabel("Visible share")
        add_note(
            figure, ["In each cell the share, and below it how many rows it has; cells without a number have none"]
        )
    return figure


def _draw_panel(axes: Axes, values: Float, n: Float, edges: Float, title: str) -> None:
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


# Miss runs: how long misses last as recorded, by the fitted model, and by one without memory.

_REPEATS = 200
_MOST_MISS_ROWS = 20_000
"""Rows that are simulated, each `_REPEATS` times. More: smoother bands, and a slower page."""


def miss_runs_figure(study: FitStudy) -> Figure:
    """The number of runs of misses per pass over their least length."""
    first = study.first_rows
    step = max(len(study.rows.log) // _MOST_MISS_ROWS, 1)
    passes = np.arange(0, len(first) - 1, step)
    rows = np.concatenate([np.arange(first[p], first[p + 1]) for p in passes])
    new = np.isin(rows, first[passes])
    listed, p = study.rows.listed[rows], study.probability[rows]
    gap_s = np.diff(study.rows.captured_s[rows], prepend=0.0)
    memory = study.detection.memory
    share, tau_s = (0.0, 1.0) if memory is None else (memory["share"].value, memory["correlation_s"].value)
    drawn = {"fitted": _draw_hits(p, gap_s, new, share, tau_s), "without memory": _draw_hits(p, gap_s, new, 0.0, 1.0)}
    if share == 0:
        del drawn["fitted"]
    recorded = _count_longer(~listed[:, None], new)
    with figure_style():
        figure = new_figure(6.4, 3.6)
        axes = figure.subplots()
        least = 0.3 / len(passes)
        for (name, hits), colour in zip(drawn.items(), (FITTED, MEMORYLESS)[-len(drawn) :], strict=True):
            each = _count_longer(~hits, new)
            low, high = np.quantile(each, [0.025, 0.975], axis=1)
            mean = each.mean(axis=1)
            lengths = np.arange(1, len(mean) + 1)
            axes.fill_between(lengths, np.maximum(low, 0.5) / len(passes), np.maximum(high, 0.5) / len(passes),
                              step="mid", color=colour, alpha=0.25, linewidth=0)  # fmt: skip
            shown = mean / len(passes) > least
            axes.plot(lengths[shown], mean[shown] / len(passes), color=colour, linewidth=1.8, label=name)
        counts = recorded[:, 0]
        axes.plot(np.arange(1, len(counts) + 1), counts / len(passes), color=RECORDED, marker="o", markersize=3.5,
                  linewidth=1.2, label="recorded")  # fmt: skip
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(lambda value, _: f"{value:g}")
            axis.set_minor_formatter("")
        axes.set_ylim(bottom=least)
        axes.set_xlim(0.9, max(len(counts), 8) * 1.4)
        axes.set_xlabel("At least so many misses in a row (lists)")
        axes.set_ylabel("Runs per pass")
        axes.legend(loc="upper right")
        add_note(figure, [f"{len(passes)} passes; lines: mean of {_REPEATS} repetitions, bands hold 95 % of them"])
    return figure


def _draw_hits(p: Float, gap_s: Float, new: Bool, share: float, tau_s: float) -> Bool:
    """(R, repeats) hits of a model that uses a held number with probability `share`; from a fixed seed."""
    rng = np.random.default_rng(0)
    hits = rng.uniform(size=(len(p), _REPEATS)) < p[:, None]
    if share == 0:
        return hits
    held = rng.uniform(size=_REPEATS)
    stays = np.where(new, 0.0, np.exp(-gap_s / tau_s))
    for k in range(len(p)):
        held = np.where(rng.uniform(size=_REPEATS) < stays[k], held, rng.uniform(size=_REPEATS))
        hits[k] = np.where(rng.uniform(size=_REPEATS) < share, held < p[k], hits[k])
    return hits


def _count_longer(missed: Bool, new: Bool) -> Int:
    """(lengths, columns) how many runs of misses are at least 1, 2, … rows long."""
    run, out = np.zeros(missed.shape[1], dtype=np.int64), np.zeros((1, missed.shape[1]), dtype=np.int64)
    columns = np.arange(missed.shape[1])
    for k in range(len(missed)):
        run = np.where(missed[k], (0 if new[k] else run) + 1, 0)
        if (longest := int(run.max(initial=0))) > len(out):
            out = np.vstack([out, np.zeros((longest - len(out), missed.shape[1]), dtype=np.int64)])
        on = run > 0
        out[run[on] - 1, columns[on]] += 1
    return out


MISS_RUNS = FitFigure(
    "How long misses last",
    "number of runs of misses per pass over their length, recorded, fitted and without memory",
    "How often an object is missed in at least so many lists in a row. Recorded points within the band of the fitted "
    "model: its misses last as long as the recorded ones. A model without memory has the same share of misses, but "
    "falls off too fast where misses last.",
    miss_runs_figure,
    lambda study: f"no miss in {len(study.rows.log)} rows" if study.rows.listed.all() else None,
)


# Ranks: the replay check, the recording among replays of the fitted model.


def ranks_figure(study: FitStudy) -> Figure:
    """A strip per statistic, a point per pass: the fitted model above, the model without memory below."""
    names = list(study.ranks)
    both = bool(study.ranks_memoryless)
    with figure_style():
        figure = new_figure(8.0, 1.3 + 0.52 * len(names))
        axes = figure.subplots()
        axes.axvspan(0.025, 0.975, color=FAINT, alpha=0.1, linewidth=0)
        kinds = [("fitted", study.ranks, FITTED, "o", -0.17 if both else 0.0)]
        kinds += [("without memory", study.ranks_memoryless, MEMORYLESS, "s", 0.17)] if both else []
        for label, ranks, colour, mark, offset in kinds:
            for k, name in enumerate(names):
                ranked = np.sort(ranks.get(name, np.empty(0)))
                axes.plot(
                    ranked, k + offset + _spread_points(ranked), mark, color=colour, markersize=4, linestyle="none",
                    label=label if k == 0 else None,
                )  # fmt: skip
        axes.set_yticks(range(len(names)), names)
        for k, name in enumerate(names):
            verdict = study.verdicts.get(name, "") + 4 * "\u00a0"  # room for wider letters in a browser
            axes.text(1.03, k, verdict, transform=axes.get_yaxis_transform(), va="center", fontsize=7.5)
        axes.set_ylim(len(names) - 0.45, -0.55)
        axes.set_xlim(-0.02, 1.02)
        axes.set_xlabel("Rank of the recorded value among replays of the fitted model")
        axes.grid(visible=False, axis="y")
        if both:
            figure.legend(loc="outside upper left", ncols=2)
        passes = max((len(one) for one in study.ranks.values()), default=0)
        add_note(figure, [f"{passes} passes; a point each; grey: 95 % of the ranks of a model that is right"])
    return figure


def _spread_points(ranked: Float) -> Float:
    """Offsets that put points of about equal rank beside each other."""
    cell = np.floor(ranked * 60)
    nth = np.arange(len(cell)) - np.searchsorted(cell, cell)
    step = min(0.035, 0.13 / max((int(nth.max(initial=0)) + 1) // 2, 1))
    aside: Float = np.where(nth % 2 == 1, 1, -1) * ((nth + 1) // 2) * step
    return aside


def _explain_no_ranks(study: FitStudy) -> str | None:
    return None if study.ranks else "nothing was replayed beside what was recorded"


RANKS = FitFigure(
    "Does a replay look like the recording?",
    "rank of each recorded pass among replays of the fitted model, a strip per statistic",
    "For each pass the recorded value is ranked among runs of the fitted model: 0 is below all of them, 1 above. Of a "
    "model that is right, ranks are spread evenly. Ranks in a heap in the middle: the model varies too much; at the "
    "ends: it is too sure.",
    ranks_figure,
    _explain_no_ranks,
)


# Autocorrelation: how long errors last, beside the fitted memory.

_LAGS = 40
_FEWEST = 10
"""Lags at most, and pairs below which no point is drawn."""


def autocorrelation_figure(study: FitStudy) -> Figure:
    """The correlation of standardised errors over the time between them, and the fitted w·e^(−Δ/τ) + c."""
    fit, z = study.errors, study.errors.shape.z
    series = build_series(study.rows.take(fit.rows))
    period_s = float(np.median(series.gap_s[~series.new]))
    series_ix, at_s = np.cumsum(series.new) - 1, study.rows.captured_s[fit.rows]
    far_s = min(max(20 * period_s, 4 * fit.shares.tau_s if fit.shares.drift else 0), 200 * period_s)
    lags = np.unique(np.geomspace(1, max(far_s / period_s, 2), _LAGS).round().astype(np.int64))
    correlations, n = _mean_products(z, series_ix, at_s, lags, period_s)
    names = ("along", "across") if fit.frame == "line_of_sight" else ("easting", "northing")
    with figure_style():
        figure = new_figure(6.4, 3.6)
        axes = figure.subplots()
        axes.axhline(0, color=FAINT, linewidth=0.8)
        enough = n >= _FEWEST
        for column, name, colour, mark in zip(correlations.T, names, (RECORDED, FITTED), ("o", "^"), strict=True):
            axes.plot(lags[enough] * period_s, column[enough], mark, color=colour, markersize=4, label=name)
        shares = fit.shares
        dense = np.linspace(period_s / 4, lags[-1] * period_s, 300)
        label = f"fitted: {shares.drift:.2f} e^(−Δ/{shares.tau_s:.2g} s)" if shares.drift else "fitted: "
        label += f" + {shares.constant:.2f}" if shares.constant else ("0" if not shares.drift else "")
        axes.plot(dense, shares.drift * np.exp(-dense / shares.tau_s) + shares.constant, color=INK, linewidth=1.8,
                  label=label)  # fmt: skip
        axes.set_ylim(min(-0.15, float(correlations[enough].min(initial=0)) - 0.05), 1.02)
        axes.set_xlim(left=0)
        axes.set_xlabel("Time between two entries of an object (s)")
        axes.set_ylabel("Correlation of their errors")
        axes.legend(loc="upper right")
        untold = fit.untold.get("memory.position")
        add_note(figure, [f"{len(z)} entries in {int(series.new.sum())} series", untold or ""])
    return figure


def _mean_products(z: Float, series_ix: Int, at_s: Float, lags: Int, period_s: float) -> tuple[Float, Int]:
    """(lags, 2) mean products of errors of variance 1 that are `lags` periods apart, ± a half; and how many (lags,)."""
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


# Error map: whether errors and misses belong to places.

_MOST_POINTS = 6000
_MOST_VECTOR_POINTS = 1500
"""Points that are drawn at most, and above which they are one raster image, to keep the page small."""


def error_map_figure(study: FitStudy) -> Figure:
    """True places of objects, coloured by the error of their entry, crosses where missed; a triangle for the unit."""
    rows = study.rows
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
        places = np.unique(np.column_stack([study.lists.east_m, study.lists.north_m]).round(1), axis=0)[:2000] - centre
        axes.plot(*places.T, "^" if len(places) < 5 else ".", color=INK, markersize=8 if len(places) < 5 else 2)
        bar = figure.colorbar(shown, ax=axes, shrink=0.85, pad=0.02)
        bar.set_label("Error of the entry (m)")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("East of the middle (m)")
        axes.set_ylabel("North of the middle (m)")
        thinned = f", of which one in {step} is drawn" if step > 1 else ""
        add_note(figure, [f"{len(rows.log)} rows{thinned}; crosses: missed; triangle (or dots, if it moves): the unit"])
    return figure


def _explain_no_map(study: FitStudy) -> str | None:
    return None if study.rows.listed.any() else "no entry is of a true object"


ERROR_MAP = FitFigure(
    "Errors over the map",
    "true places of objects, coloured by the error of their entries, with crosses where they are missed",
    "Where objects truly are, seen from above. Colours or crosses that gather in one place (a tree, a pole, a crest) "
    "are not explained by range and visible share: an obstacle may be missing in the experiment, or the truth be "
    "off there.",
    error_map_figure,
    _explain_no_map,
)


# Gaussian: whether position errors are, by quantiles of standardised errors and by the fitted distribution.

_POINTS = 120
_BARS = 20


def gaussian_figure(study: FitStudy) -> Figure:
    """Left: quantiles over normal ones; right: the share of errors in each twentieth of the fitted distribution."""
    z = study.errors.shape.z
    names = ("along", "across") if study.errors.frame == "line_of_sight" else ("easting", "northing")
    level = (np.arange(min(_POINTS, len(z))) + 0.5) / min(_POINTS, len(z))
    with figure_style():
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


# Delay: how well the lists determine it, by the errors at other delays.

_AROUND_S = 0.3
_MOVING_MPS = 1.0
"""Delays on each side of the one that is used, and speed above which an object tells a delay."""


def delay_figure(study: FitStudy) -> Figure:
    """The root mean square of the errors over the delay, with and without their mean along the way."""
    rows = _keep_moving(study)
    delays = study.delay_s + np.linspace(-_AROUND_S, _AROUND_S, 61)
    plain, centred = _rmse_by_delay(
        rows.east_m, rows.north_m, rows.view.yaw_rad, rows.view.speed_mps, delays - study.delay_s
    )
    with figure_style():
        figure = new_figure(6.4, 3.2)
        axes = figure.subplots()
        axes.axvline(study.delay_s, color=FAINT, linewidth=1.0, dashes=(4, 2))
        axes.plot(delays, plain, color=RECORDED, linewidth=1.8, label="errors")
        axes.plot(delays, centred, color=FITTED, linewidth=1.8, dashes=(5, 1.6), label="without a shift along the way")
        axes.set_ylim(0, 1.05 * float(plain.max()))
        axes.set_xlabel("Delay of the lists (s)")
        axes.set_ylabel("Position error (RMSE, m)")
        axes.legend(loc="lower right")
        used = f"dashed: {study.delay_s:.3g} s, which is taken"
        add_note(figure, [f"{len(rows.log)} entries of objects faster than {_MOVING_MPS:g} m/s; {used}"])
    return figure


def _keep_moving(study: FitStudy) -> FitRows:
    rows = study.rows
    return rows.take(rows.listed & np.isfinite(rows.east_m) & (rows.view.speed_mps > _MOVING_MPS))


def _rmse_by_delay(
    east_m: Float, north_m: Float, yaw_rad: Float, speed_mps: Float, later_s: Float
) -> tuple[Float, Float]:
    """(K,) RMSE of errors, and without their mean along the way, if lists were captured `later_s` before."""
    ahead = east_m * np.cos(yaw_rad) + north_m * np.sin(yaw_rad)
    aside = north_m * np.cos(yaw_rad) - east_m * np.sin(yaw_rad)
    moved = ahead + speed_mps * later_s[:, None]
    left = moved - moved.mean(axis=1)[:, None]
    return np.sqrt((moved**2 + aside**2).mean(axis=1)), np.sqrt((left**2 + aside**2).mean(axis=1))


def _explain_too_few(study: FitStudy) -> str | None:
    n = len(_keep_moving(study).log)
    return None if n >= 10 else f"{n} entries are of objects faster than {_MOVING_MPS:g} m/s"


DELAY = FitFigure(
    "How late are the lists?",
    "root mean square position error over the assumed delay",
    "A wrong delay shifts entries along the way of moving objects. The narrower the valley, the better the delay is "
    "told. Where only the first line has one, a delay cannot be told from a shift of all entries along the way: "
    "speeds vary too little.",
    delay_figure,
    _explain_too_few,
)


# Strips: each pass as hits and misses, which shows before any fit how misses lie together.

MOST_PASSES = 40
"""Passes that are drawn at most: as many as fit on a page."""
_MOST_VECTOR_CHANGES = 1000
"""Changes between hits and misses above which the strips are one raster image, to keep the page small."""


def strips_figure(study: FitStudy) -> Figure:
    """A row per pass: hits as a broad bar, misses as a thin one."""
    first, rows = study.first_rows, study.rows
    P = len(first) - 1
    shown = np.unique(np.linspace(0, P - 1, min(P, MOST_PASSES)).round().astype(np.int64))
    with figure_style():
        figure = new_figure(8.6, 1.0 + 0.17 * max(len(shown), 3))
        axes = figure.subplots()
        picture = bool((np.diff(rows.listed.astype(np.int8)) != 0).sum() > _MOST_VECTOR_CHANGES)
        for k, p in enumerate(shown):
            of_pass = slice(first[p], first[p + 1])
            since_s = rows.captured_s[of_pass] - rows.captured_s[first[p]]
            step_s = float(np.median(np.diff(since_s))) if len(since_s) > 1 else 0.1
            for hit, half, colour in ((True, 0.36, RECORDED), (False, 0.13, FITTED)):
                bars = _find_runs(rows.listed[of_pass] == hit, since_s, step_s)
                axes.broken_barh(bars, (k - half, 2 * half), color=colour, linewidth=0, rasterized=picture)
        axes.set_yticks(range(len(shown)), [f"{p + 1}" for p in shown], fontsize=6.5)
        axes.set_ylim(len(shown) - 0.4, -0.6)
        axes.set_xlim(left=0)
        axes.set_ylabel("Pass")
        axes.set_xlabel("Time since the object came within reach (s)")
        axes.grid(visible=False, axis="y")
        thinned = f", of which {len(shown)} are drawn" if len(shown) < P else ""
        add_note(figure, [f"{P} passes{thinned}; broad: listed, thin: missed"])
    return figure


def _find_runs(which: Bool, since_s: Float, step_s: float) -> list[tuple[float, float]]:
    """(start, length) of each run of rows, up to the next row, or by two steps where that is farther away."""
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


# All figures.

FIT_FIGURES: dict[str, FitFigure] = {
    "ranks": RANKS,
    "calibration": CALIBRATION,
    "probability_map": PROBABILITY_MAP,
    "strips": STRIPS,
    "miss_runs": MISS_RUNS,
    "gaussian": GAUSSIAN,
    "autocorrelation": AUTOCORRELATION,
    "error_map": ERROR_MAP,
    "delay": DELAY,
}
"""Figures by name, in the order of the page."""
