"""The figure of sweeps: what becomes of shares and times when latency, rate, units or their share change.

Made of `sweep.csv`: the columns of `summary.csv`, and which `sweep` and `value` each row is of.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.core.text import interval_words
from copem_replay.core.tracks import Float
from copem_replay.report.figures.captions import list_rates, short_names
from copem_replay.report.figures.selection import MOST_LINES, evenly, left_out
from copem_replay.report.figures.style import Appearance, add_note, appearances, new_figure, of_configuration, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from copem_replay.results.read import Results

_BEYOND_S = 1e9
"""Stands for never where a band is drawn: above every axis (chosen)."""
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
    "ttd": "Time to detection (s)\nmedian, 5 % to 95 %",
}


def sweeps_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Shares with 95 % intervals and times to detection over each swept value. Raises InputError without a sweep."""
    sweep = results.sweep
    if sweep is None:
        raise InputError(f"{results.folder}: expected sweep.csv in it, found none; give the experiment a `sweep:`")
    wanted = results.chosen(configurations) if configurations else tuple(dict.fromkeys(sweep["configuration"]))
    sweep = sweep[sweep["configuration"].isin(wanted)]
    kinds = list(dict.fromkeys(sweep["sweep"]))
    if not kinds:
        raise InputError(f"{results.folder}/sweep.csv: expected rows of {', '.join(wanted)}, found none")
    every, wanted = wanted, _that_differ(sweep, wanted)
    sweep = sweep[sweep["configuration"].isin(wanted)]
    rows = [name for name in _ROWS if name == "ttd" or (name in sweep and sweep[name].notna().any())]
    looks = appearances(tuple(dict.fromkeys([*results.experiment.configurations, *wanted])))
    with style():
        figure = new_figure(2.2 + 2.35 * len(kinds), 1.0 + 1.75 * len(rows))
        panels = figure.subplots(len(rows), len(kinds), sharex="col", sharey="row", squeeze=False)
        for column, kind in zip(panels.T, kinds, strict=True):
            part = sweep[sweep["sweep"] == kind]
            for axes, row in zip(column, rows, strict=True):
                for name in wanted:
                    mine = part[part["configuration"] == name].sort_values("value", kind="stable")
                    if len(mine):
                        with of_configuration(list(looks).index(name), axes):
                            _series(axes, mine, row, name, looks[name])
            _value_axis(column[-1], kind, part)
        for axes, row in zip(panels[:, 0], rows, strict=True):
            axes.set_ylabel(_ROWS[row])
            if row != "ttd":
                axes.set_ylim(-0.03, 1.05)
                axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
        _close_open_bands(panels[-1])
        _legend(figure, panels, kinds, wanted)
        add_note(figure, [*_note(results, sweep, kinds, wanted), left_out(every, wanted)])
    return figure


def _that_differ(sweep: pd.DataFrame, names: Sequence[str]) -> tuple[str, ...]:
    """At most twelve, evenly from the soonest to the latest, by the mean over all values."""
    mean_s = sweep["ttd_rmst_s"].groupby(sweep["configuration"]).mean() if "ttd_rmst_s" in sweep else pd.Series()
    kept = evenly(sorted(names, key=lambda name: float(mean_s.get(name, 0.0))), MOST_LINES)
    return tuple(name for name in names if name in kept)


def swept_name(name: str, kind: str) -> str:
    """What a configuration is called where a quantity is swept: its own name may tell the latency it no longer has."""
    return f"{name} (latency swept)" if kind == "latency_s" else name


def _legend(figure: Figure, panels: Any, kinds: Sequence[str], names: Sequence[str]) -> None:
    """A configuration that is drawn with its latency swept and as it is, too, is there twice."""
    short = short_names(names)
    handles: dict[str, Line2D] = {}
    for name in (*names, "exact"):
        for column, kind in zip(panels.T, kinds, strict=True):
            drawn = [line for axes in column for line in axes.get_lines() if line.get_label() == name]
            if drawn:
                handles.setdefault(name if name == "exact" else swept_name(short[name], kind), drawn[0])
    figure.legend(list(handles.values()), list(handles), loc="outside right upper", handlelength=3.2)


def _series(axes: Axes, rows: pd.DataFrame, what: str, name: str, look: Appearance) -> None:
    """One configuration in one panel: a line with markers, and its band."""
    value = rows["value"].to_numpy(dtype=float)
    if what == "ttd":
        middle, low, high = (_column(rows, f"ttd_{q}_s") for q in ("median", "p5", "p95"))
        # A quantile among the never detected lies beyond every axis, where the fifth percentile is known.
        high = np.where(np.isnan(high) & ~np.isnan(low), np.inf, high)
    else:
        middle, low, high = (_column(rows, what + end) for end in ("", "_low", "_high"))
    known = ~np.isnan(low) & ~np.isnan(high)
    if known.any():
        high = np.minimum(high, _BEYOND_S)
        axes.fill_between(
            value, low, high, where=known, color=look.colour, alpha=0.12, linewidth=0, label=f"band of {name}"
        )
        for limit in (low, high):  # as lines, too: bands lie on each other
            shown = np.where(known & (limit < _BEYOND_S), limit, np.nan)
            axes.plot(value, shown, color=look.edge, linewidth=0.5, label="_limit")
        beside = np.concatenate([[False], known[:-1]]) | np.concatenate([known[1:], [False]])
        alone = known & ~beside  # a point between two without limits has no band
        axes.vlines(value[alone], low[alone], high[alone], color=look.edge, linewidth=1)
    line = look.line(max(look.width_pt * 0.6, 1.2))
    axes.plot(
        value, middle, marker=look.marker, markersize=4.5, markeredgecolor=look.edge, label=name, zorder=2.5, **line
    )
    exact = _column(rows, "ttd_median_s_exact" if what == "ttd" else f"{what}_exact")
    if not np.isnan(exact).all():
        axes.plot(value, exact, color="black", linewidth=0.7, linestyle=(0, (5, 3)), label="exact", zorder=3)


def _any_exact(sweep: pd.DataFrame) -> bool:
    names = ("pass_share_exact", "detected_share_exact", "ttd_median_s_exact")
    return any(bool(sweep[name].notna().any()) for name in names if name in sweep)


def _column(rows: pd.DataFrame, name: str) -> Float:
    """A column (n,) as numbers, NaN where there is none."""
    return rows[name].to_numpy(dtype=float) if name in rows else np.full(len(rows), np.nan)


def _close_open_bands(panels: Sequence[Axes]) -> None:
    """End the time axis above all that is finite: bands that go on reach its top."""
    drawn = [np.asarray(line.get_ydata(), dtype=float) for axes in panels for line in axes.get_lines()]
    heights = np.concatenate([np.zeros(1), *drawn])
    heights = heights[np.isfinite(heights) & (heights < _BEYOND_S)]
    span = np.ptp(heights) or 1.0
    panels[0].set_ylim(heights.min() - 0.03 * span, heights.max() + 0.08 * span)


def _value_axis(axes: Axes, kind: str, part: pd.DataFrame) -> None:
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


def _interval_kinds(sweep: pd.DataFrame) -> list[str]:
    """Of which kinds the limits of shares are, and over what; those that there are none of are not among them."""
    if "interval_over" not in sweep or "interval" not in sweep:
        return []
    there = sweep[["interval", "interval_over"]].dropna().drop_duplicates()
    return sorted(interval_words(*of) for of in there.itertuples(index=False))


def _note(results: Results, sweep: pd.DataFrame, kinds: Sequence[str], names: Sequence[str]) -> list[str]:
    n = sorted({int(value) for value in sweep["n"].dropna()}) if "n" in sweep else []
    rows = f", n = {n[0] if n[0] == n[-1] else f'{n[0]} to {n[-1]}'} per point" if n else ""
    said = [f"Sweeps, {results.experiment.runs} runs{rows}, seed {results.experiment.seed}"]
    for kind in kinds:
        if kind != "rate_hz":
            rates = list_rates(sweep[sweep["sweep"] == kind], names)
            said.append(f"{AXES.get(kind, kind).partition(' (')[0]}: {rates[:1].lower()}{rates[1:]}" if rates else "")
    limits = _interval_kinds(sweep)
    said.append(f"Bands of shares: 95 %, {'; '.join(limits)}" if limits else "No intervals of the shares")
    said.append("Dashed black: exact, what the runs tend to" if _any_exact(sweep) else "")
    if "ttd_p95_s" in sweep and sweep["ttd_p95_s"].isna().any():
        said.append(
            "Where a band reaches the top of the axis, or a line is missing, the quantile is among the never detected"
        )
    return said
