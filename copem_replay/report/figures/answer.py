"""The figure of the answer: how soon each configuration detects on average, and how many pass; the soonest first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.metrics.fixed import fixed_in
from copem_replay.metrics.intervals import clusters
from copem_replay.report.figures.bands import mean_limits
from copem_replay.report.figures.captions import few_in_words, per_cent, plain, short_names, study
from copem_replay.report.figures.contenders import RANKED_BY, contenders, soonest_first, truths
from copem_replay.report.figures.detection_curves import endings
from copem_replay.report.figures.dots import ROW_IN, Dot, draw_rows
from copem_replay.report.figures.style import add_note, appearances, new_figure, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results

_SHARES = {"pass_share": "Passes, of rows in conflict", "detected_share": "Detected"}
"""Of these the first that tells something is drawn, too."""


def answer_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Mean time to detection and share that passes, a dot with its 95 % interval each; the ground truth as a line."""
    names = soonest_first(results, contenders(results, configurations))
    rows = results.summary.set_index("configuration")
    upper = [name for name in truths(results) if name in results.chosen(configurations) and name not in names]
    times, why = _times(results, names)
    share = _share(rows, names)
    with style():
        figure = new_figure(8.0, 1.0 + ROW_IN * len(names) + 0.15 * bool(upper))
        panels = figure.subplots(1, 1 + bool(share), squeeze=False, width_ratios=[1.5, 1.0] if share else None)[0]
        looks = appearances(tuple(results.experiment.configurations))
        draw_rows(panels[0], list(zip(names, times, strict=True)), looks, named=True)
        panels[0].set_xlabel("Mean time to detection (s)")
        _line(panels[0], {name: float(rows.loc[name, RANKED_BY]) for name in upper}, " s")
        _from_zero(panels[0], times)
        if share:
            shares = [_share_dot(rows.loc[name], share) for name in names]
            draw_rows(panels[1], list(zip(names, shares, strict=True)), looks, named=False)
            panels[1].set_xlabel(f"{_SHARES[share]} (%)")
            panels[1].set_xlim(-4, 104)
            _line(panels[1], {name: 100 * float(rows.loc[name, share]) for name in upper}, " %")
        drawn = any(dot.low is not None for dot in times)
        add_note(figure, [*why, *_note(results, names, rows, intervals=drawn)])
    return figure


def _times(results: Results, names: Sequence[str]) -> tuple[list[Dot], list[str]]:
    """A dot of each, and first of all what has no interval, and why."""
    rows = results.summary.set_index("configuration")
    over, cluster = clusters(results.known)
    fixed = fixed_in(results.experiment.as_written())
    dots: list[Dot] = []
    without: dict[str, list[str]] = {}
    for name in names:
        mean_s, horizon_s = (float(rows.loc[name, key]) for key in (RANKED_BY, "ttd_rmst_horizon_s"))
        if np.isnan(mean_s):
            dots.append(Dot(None, None, None, "not measured"))
            continue
        if rows.loc[name, "detected_share"] == 0:
            dots.append(Dot(None, None, None, f"never (counts as {plain(horizon_s)} s)"))
            continue
        limits = None
        reason = few_in_words(results) if over is None else "every run is the same"
        if over is not None and not (over == "runs" and fixed.known(name)):
            mine = results.known["configuration"] == name
            time_s, ending, runs = endings(results.known[mine])
            seed = results.experiment.seed
            limits = mean_limits(np.round(time_s, 9), ending, list(cluster[mine]), horizon_s, seed, runs)
            reason = f"all {over} alike"
        if limits is None:
            without.setdefault(reason, []).append(name)
            dots.append(Dot(mean_s, None, None, plain(mean_s)))
        else:
            dots.append(Dot(mean_s, *limits, f"{plain(mean_s)} [{plain(limits[0])}, {plain(limits[1])}]"))
    return dots, [_without(reason, of, names) for reason, of in without.items()]


def _without(reason: str, of: Sequence[str], names: Sequence[str]) -> str:
    short = short_names(names)
    of_names = "" if len(of) == len(names) else f" of {', '.join(short[name] for name in of)}"
    return f"No interval of the mean time{of_names} (hollow): {reason}"


def _share(rows: pd.DataFrame, names: Sequence[str]) -> str | None:
    """Which share is drawn beside the times; None: it tells nothing."""
    if "pass_share" in rows and rows.loc[list(names), "pass_share"].notna().any():
        return "pass_share"
    return "detected_share" if (rows.loc[list(names), "detected_share"] < 1).any() else None


def _share_dot(row: Any, share: str) -> Dot:
    value, low, high = (
        None if pd.isna(row[key]) else float(row[key]) for key in (share, f"{share}_low", f"{share}_high")
    )
    if value is None:
        return Dot(None, None, None, "no conflict")
    if low is None or high is None:
        return Dot(100 * value, None, None, per_cent(value))
    return Dot(100 * value, 100 * low, 100 * high, f"{per_cent(value)} [{per_cent(low)}, {per_cent(high)}]")


def _line(axes: Axes, values: dict[str, float], unit: str) -> None:
    """The ground truth: not ranked, what could be had at best."""
    for name, value in values.items():
        if not np.isnan(value):
            axes.axvline(value, color="0.45", linewidth=1.2, linestyle=(0, (4, 2)), zorder=1, label=name)
    shown = ", ".join(f"{short} {plain(values[name])}{unit}" for name, short in short_names(list(values)).items())
    first = next(iter(values.values()), None)
    if first is not None and not np.isnan(first):
        axes.annotate(
            shown, (first, 1), xycoords=axes.get_xaxis_transform(), xytext=(0, 2), textcoords="offset points",
            ha="center" if 0.15 < _place(axes, first) < 0.85 else "left" if _place(axes, first) <= 0.15 else "right",
            va="bottom", fontsize=7.5, color="0.3", annotation_clip=False,
        )  # fmt: skip


def _place(axes: Axes, value: float) -> float:
    low, high = axes.get_xlim()
    return (value - low) / (high - low)


def _from_zero(axes: Axes, dots: Sequence[Dot]) -> None:
    """Times begin at 0 where they are not negative, and there is a way to go where all are 0."""
    ends = [end for dot in dots for end in (dot.value, dot.low, dot.high) if end is not None]
    low, high = min([0.0, *ends]), max([0.0, *ends])
    span = (high - low) or 1.0
    axes.set_xlim(low - 0.04 * span, high + 0.06 * span)


def _note(results: Results, names: Sequence[str], rows: pd.DataFrame, *, intervals: bool) -> list[str]:
    over = clusters(results.known)[0]
    said = [study(results, names)]
    if intervals:
        said.append(f"Lines: 95 % intervals over {over}. Two that overlap may differ for sure: see the differences")
    horizon = rows["ttd_rmst_horizon_s"].dropna()
    if (rows.loc[list(names), "detected_share"] < 1).any() and len(horizon):
        said.append(f"An object that is never detected counts as {plain(float(horizon.iloc[0]))} s")
    if truths(results):
        said.append("Dashed: the ground truth, an upper bound, not ranked")
    return said
