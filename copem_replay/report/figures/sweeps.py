"""Figure of sweeps: shares and times to detection over the values of each swept quantity, such as latency or rate.

Of more than six configurations each has panels of its own, with the baseline in every one.

It is drawn from `sweep.csv`, which has the columns of `summary.csv`, and `sweep` and `value` of each row.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Float
from copem_replay.metrics.summary import describe_intervals
from copem_replay.report.figures.selection import MOST_LINES, TOGETHER, describe_left_out
from copem_replay.report.figures.style import (
    Appearance,
    add_note,
    choose_appearances,
    describe_list_rates,
    figure_style,
    mark_configuration,
    new_figure,
    shorten_names,
)
from copem_replay.results.compare.labels import find_baseline
from copem_replay.results.shown_objects import pick_evenly

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from copem_replay.results.read import Results


_BEYOND_S = 1e9
"""Stands for never in bands: above every axis, and finite, as drawing needs it."""
AXES = {
    "latency_s": "Latency (s)",
    "rate_hz": "Rate of the units (lists per second)",
    "units": "Number of units",
    "penetration_rate": "Share of vehicles that carry a unit",
    "correlation_s": "Correlation time of detection (s)",
    "ghosts_in_list": "Ghosts in a list of a unit",
    "loss": "Share of lists that are lost",
    "burst_s": "How long losses last (s)",
}
_ROWS = {
    "pass_share": "Share that passes",
    "detected_share": "Share detected",
    "ttd": "Time to detection (s)\nmean, 5 % to 95 %",
}


def sweeps_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Shares with 95 % intervals and times to detection over each swept value. Raises InputError without a sweep."""
    sweep = results.sweep
    if sweep is None:
        raise InputError(f"{results.place}: expected sweep.csv in it, found none; give the experiment a `sweep:`")
    names = results.chosen(configurations) if configurations else tuple(dict.fromkeys(sweep["configuration"]))
    sweep = sweep[sweep["configuration"].isin(names)]
    kinds = list(dict.fromkeys(sweep["sweep"]))
    if not kinds:
        raise InputError(f"{results.place}/sweep.csv: expected rows of {', '.join(names)}, found none")
    baseline = find_baseline(results.facts, names).name
    selected, names = names, _find_differing(sweep, names, baseline)
    sweep = sweep[sweep["configuration"].isin(names)]
    rows = [name for name in _ROWS if name == "ttd" or (name in sweep and sweep[name].notna().any())]
    groups = [names] if len(names) <= TOGETHER else [(baseline, name) for name in names if name != baseline]
    looks = choose_appearances(results)
    with figure_style():
        figure, panels = _lay_out(groups, rows, kinds)
        for (group, row, kind), axes in zip(product(groups, rows, kinds), panels.flat, strict=True):
            part = sweep[sweep["sweep"] == kind]
            for name in group:
                series = part[part["configuration"] == name].sort_values("value", kind="stable")
                if len(series):
                    with mark_configuration(list(looks).index(name), axes):
                        _draw_series(axes, series, row, name, looks[name])
            if group == groups[-1] and (len(groups) > 1 or row == rows[-1]):
                _value_axis(axes, kind, part)
            if row != "ttd":
                axes.set_ylim(-0.03, 1.05)
                axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
        for shared in [panels[0, -1]] if len(groups) == 1 else panels[:, -1].T:
            _close_open_bands(shared)
        _add_legend(figure, panels.reshape(-1, len(kinds)), kinds, names if len(groups) == 1 else [baseline])
        add_note(figure, [*_note_sentences(results, sweep, kinds, names), describe_left_out(selected, names)])
    return figure


def _lay_out(groups: Sequence[Sequence[str]], rows: Sequence[str], kinds: Sequence[str]) -> tuple[Figure, Any]:
    """A figure and its panels (groups, rows, kinds): of one group a line a quantity, of several a line a group."""
    if len(groups) == 1:
        figure = new_figure(2.2 + 2.35 * len(kinds), 1.0 + 1.75 * len(rows))
        panels = figure.subplots(len(rows), len(kinds), sharex="col", sharey="row", squeeze=False)
        for axes, row in zip(panels[:, 0], rows, strict=True):
            axes.set_ylabel(_ROWS[row])
    else:
        figure = new_figure(2.0 + 1.9 * len(rows) * len(kinds), 1.4 + 1.1 * len(groups))
        panels = figure.subplots(len(groups), len(rows) * len(kinds), sharex="col", sharey="col", squeeze=False)
        short = shorten_names([name for group in groups for name in group])
        for axes, (_, name) in zip(panels[:, 0], groups, strict=True):
            axes.set_ylabel(short[name])
        for axes, (row, _) in zip(panels[0], product(rows, kinds), strict=True):
            axes.set_title(_ROWS[row], loc="left")
    return figure, panels.reshape(len(groups), len(rows), len(kinds))


def _find_differing(sweep: pd.DataFrame, names: Sequence[str], baseline: str) -> tuple[str, ...]:
    """Up to `MOST_LINES` configurations: the baseline, and evenly from the soonest to the latest by mean."""
    mean_s = sweep["ttd_rmst_s"].groupby(sweep["configuration"]).mean() if "ttd_rmst_s" in sweep else pd.Series()
    others = sorted((name for name in names if name != baseline), key=lambda name: float(mean_s.get(name, 0.0)))
    picked = pick_evenly(others, MOST_LINES, [baseline])
    return tuple(name for name in names if name in picked)


def name_in_sweep(name: str, kind: str) -> str:
    """Label of a configuration in a sweep; its name may contain a latency that is swept."""
    return f"{name} (latency swept)" if kind == "latency_s" else name


def _add_legend(figure: Figure, panels: Any, kinds: Sequence[str], names: Sequence[str]) -> None:
    """Add the legend of `names`; a configuration drawn in a sweep of latency and in another one has two entries."""
    short = shorten_names(names)
    handles: dict[str, Line2D] = {}
    for name in (*names, "exact"):
        for column, kind in zip(panels.T, kinds, strict=True):
            drawn = [line for axes in column for line in axes.get_lines() if line.get_label() == name]
            if drawn:
                handles.setdefault(name if name == "exact" else name_in_sweep(short[name], kind), drawn[0])
    figure.legend(list(handles.values()), list(handles), loc="outside right upper", handlelength=3.2)


def _draw_series(axes: Axes, rows: pd.DataFrame, quantity: str, name: str, look: Appearance) -> None:
    """Draw one configuration in one panel: a line with markers, its band, and the exact values dashed."""
    value = rows["value"].to_numpy(dtype=float)
    if quantity == "ttd":
        middle, low, high = (_read_column(rows, f"ttd_{q}_s") for q in ("rmst", "p5", "p95"))
        # With a known fifth percentile, a missing 95th is among the never detected: beyond every axis.
        high = np.where(np.isnan(high) & ~np.isnan(low), np.inf, high)
    else:
        middle, low, high = (_read_column(rows, quantity + end) for end in ("", "_low", "_high"))
    has_limits = ~np.isnan(low) & ~np.isnan(high)
    if has_limits.any():
        high = np.minimum(high, _BEYOND_S)
        axes.fill_between(
            value, low, high, where=has_limits, color=look.colour, alpha=0.12, linewidth=0, label=f"band of {name}"
        )
        for limit in (low, high):  # with lines, since bands overlap
            shown = np.where(has_limits & (limit < _BEYOND_S), limit, np.nan)
            axes.plot(value, shown, color=look.colour, linewidth=0.5, label="_limit")
        has_neighbour = np.concatenate([[False], has_limits[:-1]]) | np.concatenate([has_limits[1:], [False]])
        is_alone = has_limits & ~has_neighbour  # a point between two without limits has no band
        axes.vlines(value[is_alone], low[is_alone], high[is_alone], color=look.colour, linewidth=1)
    line = look.line(max(look.width_pt * 0.6, 1.2))
    axes.plot(
        value, middle, marker=look.marker, markersize=4.5, markeredgecolor=look.colour, label=name, zorder=2.5, **line
    )
    exact = _read_column(rows, "ttd_rmst_s_exact" if quantity == "ttd" else f"{quantity}_exact")
    if not np.isnan(exact).all():
        axes.plot(value, exact, color="black", linewidth=0.7, linestyle=(0, (5, 3)), label="exact", zorder=3)


def _any_exact(sweep: pd.DataFrame) -> bool:
    names = ("pass_share_exact", "detected_share_exact", "ttd_rmst_s_exact")
    return any(bool(sweep[name].notna().any()) for name in names if name in sweep)


def _read_column(rows: pd.DataFrame, name: str) -> Float:
    """A column (n,) as floats, NaN if it is missing."""
    return rows[name].to_numpy(dtype=float) if name in rows else np.full(len(rows), np.nan)


def _close_open_bands(panels: Sequence[Axes]) -> None:
    """End the time axis above all finite values, so that open bands reach its top."""
    drawn = [np.asarray(line.get_ydata(), dtype=float) for axes in panels for line in axes.get_lines()]
    heights = np.concatenate([np.zeros(1), *drawn])
    heights = heights[np.isfinite(heights) & (heights < _BEYOND_S)]
    span = np.ptp(heights) or 1.0
    panels[0].set_ylim(heights.min() - 0.03 * span, heights.max() + 0.08 * span)


def _value_axis(axes: Axes, kind: str, part: pd.DataFrame) -> None:
    """Set scale, ticks and label of the axis of the swept quantity `kind`."""
    from matplotlib.ticker import MaxNLocator

    values = np.unique(part["value"].to_numpy(dtype=float))
    if kind == "units":
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if kind == "rate_hz" and values[0] > 0 and values[-1] / values[0] >= 8:
        axes.set_xscale("log", base=2)
        axes.set_xticks(values, [f"{value:g}" for value in values], minor=False)
    if kind == "penetration_rate":
        axes.xaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    axes.set_xlabel(AXES.get(kind, kind))


def _describe_bands(sweep: pd.DataFrame) -> str:
    """What the limits of shares are, and over what."""
    if "interval_over" not in sweep or not sweep["interval_over"].notna().any():
        return "No intervals of the shares"
    limited = sweep.drop_duplicates(["interval", "interval_over"]) if "interval_clusters" not in sweep else sweep
    return ". ".join(f"Bands of shares, {line}" for line in describe_intervals(limited, "interval")[:1])


def _note_sentences(results: Results, sweep: pd.DataFrame, kinds: Sequence[str], names: Sequence[str]) -> list[str]:
    """The sentences below the figure: rows, list rates, what bands are, and what is beyond the axis."""
    n = sorted({int(value) for value in sweep["n"].dropna()}) if "n" in sweep else []
    rows = f", n = {n[0] if n[0] == n[-1] else f'{n[0]} to {n[-1]}'} per point" if n else ""
    sentences = [f"Sweeps, {results.experiment.runs} runs{rows}, seed {results.experiment.seed}"]
    for kind in kinds:
        if kind != "rate_hz":
            rates = describe_list_rates(sweep[sweep["sweep"] == kind], names)
            sentences.append(
                f"{AXES.get(kind, kind).partition(' (')[0]}: {rates[:1].lower()}{rates[1:]}" if rates else ""
            )
    sentences.append(_describe_bands(sweep))
    sentences.append("Dashed black: exact, what the runs tend to" if _any_exact(sweep) else "")
    if "ttd_p95_s" in sweep and sweep["ttd_p95_s"].isna().any():
        sentences.append(
            "Where a band reaches the top of the axis, or a line is missing, the quantile is among the never detected"
        )
    return sentences
