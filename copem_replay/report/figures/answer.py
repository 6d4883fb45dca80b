"""Figure of the answer: mean time to detection and share that passes of each configuration, the soonest first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.metrics.limits import ALL_ALIKE, CONFIDENCE, find_clusters, weigh_rows
from copem_replay.metrics.row_figures import FigureRows
from copem_replay.report.figures.style import (
    RANKED_BY,
    ROW_IN,
    Dot,
    add_note,
    choose_appearances,
    describe_over,
    describe_results,
    draw_rows,
    explain_no_intervals,
    figure_style,
    find_contenders,
    find_truths,
    format_aligned_per_cent,
    format_three_digits,
    format_two_decimals,
    new_figure,
    shorten_names,
    sort_soonest_first,
    write_limits,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


_SHARES = {"pass_share": "Passes, of rows in conflict", "detected_share": "Detected"}
"""Shares of which the first informative one is drawn, too, with their labels."""
STACKED_IN = 3.6
"""Width of the figure on a phone, where its letters are about as large as those of tables."""
STACKED_ROW_IN = 0.44
"""Height of a row there: its name is above the dot, beside it a long one would leave no room for the axis."""


def answer_figure(results: Results, *, configurations: Sequence[str] | None = None, stacked: bool = False) -> Figure:
    """Mean time to detection and share that passes, dots with 95 % intervals; the ground truth as a line. `stacked`:
    the panels below each other, as narrow as a phone.
    """
    names = sort_soonest_first(results, find_contenders(results, configurations))
    rows = results.summary.set_index("configuration")
    upper = [name for name in find_truths(results) if name in results.chosen(configurations) and name not in names]
    times, reasons = _time_dots(results, names)
    share = _choose_share(rows, names)
    with figure_style():
        count = 1 + bool(share)
        height_in = (STACKED_ROW_IN if stacked else ROW_IN) * len(names) + 0.15 * bool(upper)
        if stacked:
            figure = new_figure(STACKED_IN, 0.6 + count * (0.5 + height_in))
            panels = figure.subplots(count, 1, squeeze=False)[:, 0]
        else:
            figure = new_figure(8.0, 1.0 + height_in)
            panels = figure.subplots(1, count, squeeze=False, width_ratios=[1.5, 1.0] if share else None)[0]
        looks = choose_appearances(results)
        draw_rows(panels[0], list(zip(names, times, strict=True)), looks, named=not stacked)
        panels[0].set_xlabel("Known after, mean (s)")
        _draw_truth_line(panels[0], {name: float(rows.loc[name, RANKED_BY]) for name in upper}, " s")
        _start_at_zero(panels[0], times)
        if share:
            shares = [_share_dot(rows.loc[name], share) for name in names]
            draw_rows(panels[1], list(zip(names, shares, strict=True)), looks, named=False)
            panels[1].set_xlabel(f"{_SHARES[share]} (%)")
            panels[1].set_xlim(-4, 104)
            _draw_truth_line(panels[1], {name: 100 * float(rows.loc[name, share]) for name in upper}, " %")
        if stacked:
            for panel in panels:
                _name_rows(panel, names)
        drawn = any(dot.low is not None for dot in times)
        add_note(figure, [*reasons, *_note_sentences(results, names, rows, intervals=drawn)])
    return figure


def _name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Write the name of each row above its dot."""
    short = shorten_names(names)
    for row, name in enumerate(names):
        axes.text(0.0, row - 0.46, short[name], fontsize=8, va="top", transform=axes.get_yaxis_transform())


def _time_dots(results: Results, names: Sequence[str]) -> tuple[list[Dot], list[str]]:
    """A dot of each configuration's mean time to detection, and sentences on those without an interval."""
    rows = results.summary.set_index("configuration")
    weigh = results.experiment.measure.weigh
    clusters = find_clusters(results.known, weigh=weigh)
    dots: list[Dot] = []
    unlimited: dict[str, list[str]] = {}
    for name in names:
        mean_s, horizon_s = (float(rows.loc[name, key]) for key in (RANKED_BY, "ttd_rmst_horizon_s"))
        if np.isnan(mean_s):
            dots.append(Dot(None, None, None, "not measured"))
            continue
        if rows.loc[name, "detected_share"] == 0:
            dots.append(Dot(None, None, None, f"never (counts as {format_three_digits(horizon_s)} s)"))
            continue
        limit = None
        reason = explain_no_intervals(results) if clusters is None else "every run is the same"
        if clusters is not None and not (clusters.by_run and results.facts[name].fixed):
            mask = (results.known["configuration"] == name).to_numpy()
            of_name = results.known[mask]
            weight, least_s = weigh_rows(of_name, "runs", weigh), results.facts[name].least_s
            rows_of_name = FigureRows(of_name, weight, clusters.select(mask), least_s=least_s)
            limit = rows_of_name.limit_mean_time(horizon_s, CONFIDENCE)
            reason = f"all {clusters.over} alike" if limit.kind == ALL_ALIKE else "no object is followed to the horizon"
        if limit is None or np.isnan(limit.low):
            unlimited.setdefault(reason, []).append(name)
            dots.append(Dot(mean_s, None, None, format_two_decimals(mean_s)))
        else:
            words = f"{format_two_decimals(mean_s)} {write_limits(limit.low, limit.high)}"
            dots.append(Dot(mean_s, limit.low, limit.high, words))
    return dots, [_explain_without(reason, without_interval, names) for reason, without_interval in unlimited.items()]


def _explain_without(reason: str, lacking: Sequence[str], names: Sequence[str]) -> str:
    short = shorten_names(names)
    of_names = "" if len(lacking) == len(names) else f" of {', '.join(short[name] for name in lacking)}"
    return f"No interval of the mean time{of_names} (hollow): {reason}"


def _choose_share(rows: pd.DataFrame, names: Sequence[str]) -> str | None:
    """The share that is drawn beside the times; None if there is no informative one."""
    if "pass_share" in rows and rows.loc[list(names), "pass_share"].notna().any():
        return "pass_share"
    return "detected_share" if (rows.loc[list(names), "detected_share"] < 1).any() else None


def _share_dot(row: Any, share: str) -> Dot:
    """The dot of the share in column `share` of a summary row, in per cent, with its limits."""
    value, low, high = (
        None if pd.isna(row[key]) else float(row[key]) for key in (share, f"{share}_low", f"{share}_high")
    )
    if value is None:
        return Dot(None, None, None, "no conflict")
    if low is None or high is None:
        return Dot(100 * value, None, None, format_aligned_per_cent(value))
    return Dot(
        100 * value,
        100 * low,
        100 * high,
        f"{format_aligned_per_cent(value)} {write_limits(100 * low, 100 * high)}",
    )


def _draw_truth_line(axes: Axes, values: dict[str, float], unit: str) -> None:
    """Draw the ground truth as dashed lines with their values: an upper bound, not ranked. `unit`: after each value."""
    for name, value in values.items():
        if not np.isnan(value):
            axes.axvline(value, color="0.45", linewidth=0.75, linestyle=(0, (4, 2)), zorder=1, label=name)
    shown = ", ".join(
        f"{short} {format_three_digits(values[name])}{unit}" for name, short in shorten_names(list(values)).items()
    )
    first_value = next(iter(values.values()), None)
    if first_value is not None and not np.isnan(first_value):
        position = _axes_fraction(axes, first_value)
        axes.annotate(
            shown, (first_value, 1), xycoords=axes.get_xaxis_transform(), xytext=(0, 2), textcoords="offset points",
            ha="center" if 0.15 < position < 0.85 else "left" if position <= 0.15 else "right",
            va="bottom", fontsize=7.5, color="0.3", annotation_clip=False,
        )  # fmt: skip


def _axes_fraction(axes: Axes, value: float) -> float:
    low, high = axes.get_xlim()
    return (value - low) / (high - low)


def _start_at_zero(axes: Axes, dots: Sequence[Dot]) -> None:
    """Set limits of the axis: from 0 unless a time is negative, and 1 s long if all times are 0."""
    ends = [end for dot in dots for end in (dot.value, dot.low, dot.high) if end is not None]
    low, high = min([0.0, *ends]), max([0.0, *ends])
    span = (high - low) or 1.0
    axes.set_xlim(low - 0.04 * span, high + 0.06 * span)


def _note_sentences(results: Results, names: Sequence[str], rows: pd.DataFrame, *, intervals: bool) -> list[str]:
    """The sentences below the figure: rows, intervals, how missed objects count, and what the dashed line is."""
    sentences = [describe_results(results, names)]
    if intervals:
        sentences.append(f"Lines: 95 % intervals over {describe_over(results)}")
        sentences.append("Lines that overlap can still differ clearly: see Differences")
    horizon = rows["ttd_rmst_horizon_s"].dropna()
    if len(horizon):
        up_to = f"{format_three_digits(float(horizon.iloc[0]))} s"
        missed = (rows.loc[list(names), "detected_share"] < 1).any()
        also = f"; an object that is never detected counts as {up_to}" if missed else ""
        sentences.append(f"Mean of min(time, {up_to}){also}")
    if find_truths(results):
        sentences.append("Dashed: the ground truth, an upper bound, not ranked")
    return sentences
