"""The figure of differences: each configuration minus the baseline, a dot with its 95 % interval, and the line of 0."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.intervals import clusters
from copem_replay.report.figures.captions import few_in_words, plain, study
from copem_replay.report.figures.contenders import RANKED_BY, default_baseline, differences_of, soonest_first, truths
from copem_replay.report.figures.dots import ROW_IN, Dot, draw_rows
from copem_replay.report.figures.style import INK, add_note, appearances, new_figure, style
from copem_replay.results.compare.limits import ALL_ALIKE
from copem_replay.results.compare.tables import NOTHING, without_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.compare import Comparison
    from copem_replay.results.read import Results

_PANELS = {
    RANKED_BY: ("Mean time to detection (s)", 1.0, "sooner", "later"),
    "pass_share": ("Passes (percentage points)", 100.0, "fewer", "more"),
    "detected_share": ("Detected (percentage points)", 100.0, "fewer", "more"),
}
"""Of each metric its axis, by how much it is multiplied, and what is to the left and to the right of 0."""


def no_differences(results: Results, names: Sequence[str], differences: Comparison | None) -> str | None:
    """The reason why nothing can be drawn; None: it can."""
    if not len(results.known):
        return "no object is measured"
    against = default_baseline(results) if differences is None else differences.baseline
    return None if set(names) - {against} else "there is nothing to compare with"


def differences_figure(
    results: Results, *, configurations: Sequence[str] | None = None, differences: Comparison | None = None
) -> Figure:
    """Differences to a baseline in the mean time to detection and in the share that passes, the soonest first.

    `differences`: where they are known already; None: to the default baseline. Raises InputError without any.
    """
    names = results.chosen(configurations)
    if (why := no_differences(results, names, differences)) is not None:
        raise InputError(f"{results.folder}: no differences: {why}")
    found = differences or differences_of(results, names, tuple(_PANELS))
    others = [name for name in found.configurations if name in names]
    drawn = [name for name in others if name not in truths(results)] or others
    names = soonest_first(results, drawn)
    rows = {(row.configuration, row.metric): row for row in found.overall.itertuples(index=False)}
    metrics = _drawn(rows, names)
    dots = {metric: [_dot(rows.get((name, metric)), metric) for name in names] for metric in metrics}
    with style():
        figure = new_figure(8.0, 1.0 + ROW_IN * len(names))
        panels = figure.subplots(1, len(metrics), squeeze=False, width_ratios=[1.3, 1.0][: len(metrics)])[0]
        looks = appearances(tuple(results.experiment.configurations))
        for k, (axes, metric) in enumerate(zip(panels, metrics, strict=True)):
            draw_rows(axes, list(zip(names, dots[metric], strict=True)), looks, named=k == 0)
            _around_zero(axes, dots[metric], metric, found.baseline)
        add_note(
            figure,
            [
                *_without(results, rows, names, metrics),
                *_note(results, found, names),
                *_upper(results, rows, others, names),
            ],
        )
    return figure


def _drawn(rows: dict[tuple[str, str], Any], names: Sequence[str]) -> list[str]:
    """The time, and the share that tells something."""

    def known(metric: str) -> list[float]:
        found = [rows[name, metric].difference for name in names if (name, metric) in rows]
        return [value for value in found if not pd.isna(value)]

    shares = [metric for metric in ("pass_share", "detected_share") if any(abs(v) > NOTHING for v in known(metric))]
    return [RANKED_BY, *shares[:1]]


def excludes_0(row: Any) -> bool:
    """Whether a difference has an interval, and 0 is outside it."""
    if pd.isna(row.interval_over) or pd.isna(row.low) or pd.isna(row.high):
        return False
    return bool(row.low > NOTHING or row.high < -NOTHING)


def _dot(row: Any, metric: str) -> Dot:
    if row is None or pd.isna(row.difference):
        return Dot(None, None, None, "–")
    times = _PANELS[metric][1]
    value, low, high = (None if pd.isna(of) else times * float(of) for of in (row.difference, row.low, row.high))
    assert value is not None
    words = "±0" if abs(value) < NOTHING else ("+" if value > 0 else "") + plain(value)
    if pd.isna(row.interval_over) or low is None or high is None:
        return Dot(value, None, None, " ".join([words, *(f"({why})" for why in without_interval(row))]))
    return Dot(value, low, high, f"{words} [{plain(low)}, {plain(high)}]", sure=excludes_0(row))


def _around_zero(axes: Axes, dots: Sequence[Dot], metric: str, baseline: str) -> None:
    label, _, left, right = _PANELS[metric]
    ends = [end for dot in dots for end in (dot.value, dot.low, dot.high) if end is not None]
    low, high = min([0.0, *ends]), max([0.0, *ends])
    span = (high - low) or 1.0
    axes.set_xlim(low - 0.06 * span, high + 0.06 * span)
    axes.axvline(0.0, color=INK, linewidth=1.0, zorder=1, label=f"as {baseline}")
    axes.set_xlabel(label)
    words: dict[str, Any] = {
        "xycoords": axes.get_xaxis_transform(), "textcoords": "offset points", "va": "bottom", "fontsize": 7.5,
        "color": "0.3", "annotation_clip": False,
    }  # fmt: skip
    axes.annotate(f"← {left}", (0.0, 1), xytext=(-4, 2), ha="right", **words)
    axes.annotate(f"{right} →", (0.0, 1), xytext=(4, 2), ha="left", **words)


def _without(
    results: Results, rows: dict[tuple[str, str], Any], names: Sequence[str], metrics: Sequence[str]
) -> list[str]:
    """That there is no interval at all, and why."""
    there = [rows[name, metric] for metric in metrics for name in names if (name, metric) in rows]
    if any(not pd.isna(row.interval_over) for row in there):
        return []
    over = clusters(results.known)[0]
    kinds = {row.interval for row in there}
    words = {ALL_ALIKE: f"each difference is the same in every {over[:-1] if over else 'object'}",
             NOTHING_DRAWN: "nothing is drawn, every run is the same"}  # fmt: skip
    reasons = [said for kind, said in words.items() if kind in kinds]
    return [f"No intervals: {' or '.join(reasons) or few_in_words(results) or 'too few differ'}"]


def _note(results: Results, found: Comparison, names: Sequence[str]) -> list[str]:
    over = found.overall.loc[found.overall["metric"] == RANKED_BY, "interval_over"].dropna().unique()
    said = [f"Each configuration minus {found.baseline}, paired by log, object and run", study(results, names)]
    if len(over):
        said.append(
            f"Lines: 95 % intervals, bootstrap over {over[0]}; bold: the interval excludes 0; hollow: no interval"
        )
    return said


def _upper(
    results: Results, rows: dict[tuple[str, str], Any], others: Sequence[str], names: Sequence[str]
) -> list[str]:
    """The ground truth is no row: it would only make the axis longer."""
    left = [name for name in others if name not in names]
    said = [f"{name} {_dot(rows.get((name, RANKED_BY)), RANKED_BY).words} s" for name in left]
    return [f"The ground truth, an upper bound, is not drawn: {', '.join(said)}"] if said else []
