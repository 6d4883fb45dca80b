"""Figure of differences: each configuration minus the baseline, a dot with its 95 % interval, and the line of 0."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.metrics.limits import ALL_ALIKE, CLUSTERS, NOTHING_DRAWN, find_clusters
from copem_replay.report.figures.style import (
    INK,
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
    find_truths,
    format_signed_decimals,
    new_figure,
    sort_soonest_first,
    write_limits,
)
from copem_replay.results.compare.labels import find_baseline
from copem_replay.results.compare.limits import STAR
from copem_replay.results.compare.tables import NOTHING, describe_gain, explain_no_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.compare import Comparison
    from copem_replay.results.read import Results


_PANELS = {
    RANKED_BY: ("Known after, mean (s)", 1.0, "sooner", "later"),
    "pass_share": ("Passes (percentage points)", 100.0, "fewer", "more"),
    "detected_share": ("Detected (percentage points)", 100.0, "fewer", "more"),
}
"""By metric: label of the axis, factor of the values, words left and right of 0."""


def no_differences(results: Results, names: Sequence[str], differences: Comparison | None) -> str | None:
    """The reason why the figure cannot be drawn; None if it can."""
    if not len(results.known):
        return "no object is measured"
    all_names = tuple(results.experiment.configurations)
    against = find_baseline(results.facts, all_names).name if differences is None else differences.baseline
    return None if set(names) - {against} else "there is nothing to compare with"


def differences_figure(
    results: Results, *, configurations: Sequence[str] | None = None, differences: Comparison | None = None
) -> Figure:
    """Differences to a baseline in the mean time to detection and in the share that passes, the soonest first.
    `differences`: computed before; None: to the baseline of `compare`. Raises InputError without any.
    """
    from copem_replay.results.compare import compare_folders

    names = results.chosen(configurations)
    if (reason := no_differences(results, names, differences)) is not None:
        raise InputError(f"{results.place}: no differences: {reason}")
    comparison = differences or compare_folders([results], configurations=names, metrics=tuple(_PANELS))
    compared = [name for name in comparison.configurations if name in names]
    drawn = [name for name in compared if name not in find_truths(results)] or compared
    names = sort_soonest_first(results, drawn)
    rows = {(row.configuration, row.metric): row for row in comparison.overall.itertuples(index=False)}
    metrics = _choose_metrics(rows, names)
    dots = {metric: [_make_dot(rows.get((name, metric)), metric) for name in names] for metric in metrics}
    with figure_style():
        figure = new_figure(8.0, 1.0 + ROW_IN * len(names))
        panels = figure.subplots(1, len(metrics), squeeze=False, width_ratios=[1.3, 1.0][: len(metrics)])[0]
        looks = choose_appearances(results)
        for k, (axes, metric) in enumerate(zip(panels, metrics, strict=True)):
            draw_rows(axes, list(zip(names, dots[metric], strict=True)), looks, named=k == 0)
            _centre_on_zero(axes, dots[metric], metric, comparison.baseline)
        add_note(
            figure,
            [
                *_explain_without(results, rows, names, metrics),
                *_note_sentences(results, comparison, names),
                *_describe_upper_bound(results, rows, compared, names),
            ],
        )
    return figure


def _choose_metrics(rows: dict[tuple[str, str], Any], names: Sequence[str]) -> list[str]:
    """The metrics of the panels: the time, and the first share with a difference."""

    def known(metric: str) -> list[float]:
        differences = [rows[name, metric].difference for name in names if (name, metric) in rows]
        return [value for value in differences if not pd.isna(value)]

    shares = [metric for metric in ("pass_share", "detected_share") if any(abs(v) > NOTHING for v in known(metric))]
    return [RANKED_BY, *shares[:1]]


def _make_dot(row: Any, metric: str) -> Dot:
    """The dot of one difference, with its limits and words; without a row or a value “–”."""
    if row is None or pd.isna(row.difference):
        return Dot(None, None, None, "–")
    factor = _PANELS[metric][1]
    value, low, high = (
        None if pd.isna(number) else factor * float(number) for number in (row.difference, row.low, row.high)
    )
    assert value is not None
    words = format_signed_decimals(value)
    if pd.isna(row.interval_over) or low is None or high is None:
        return Dot(value, None, None, " ".join([words, *(f"({why})" for why in explain_no_interval(row))]))
    return Dot(value, low, high, f"{words} {write_limits(low, high)}", sure=row.star == STAR)


def _centre_on_zero(axes: Axes, dots: Sequence[Dot], metric: str, baseline: str) -> None:
    """Set the limits of the axis so that 0 is in it, draw its line, and say on which side what is better."""
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


def _explain_without(
    results: Results, rows: dict[tuple[str, str], Any], names: Sequence[str], metrics: Sequence[str]
) -> list[str]:
    """A sentence that says why no difference has an interval; empty where one has."""
    compared = [rows[name, metric] for metric in metrics for name in names if (name, metric) in rows]
    if any(not pd.isna(row.interval_over) for row in compared):
        return []
    clusters = find_clusters(results.known)
    kinds = {row.interval for row in compared}
    words = {ALL_ALIKE: f"each difference is the same in every {CLUSTERS[clusters.over][0] if clusters else 'object'}",
             NOTHING_DRAWN: "nothing is drawn, every run is the same"}  # fmt: skip
    reasons = [said for kind, said in words.items() if kind in kinds]
    return [f"No intervals: {' or '.join(reasons) or explain_no_intervals(results) or 'too few differ'}"]


def _note_sentences(results: Results, comparison: Comparison, names: Sequence[str]) -> list[str]:
    """The sentences below the figure: pairs, rows, intervals, and on how many logs each gains."""
    rows = comparison.overall
    limited = rows[(rows["metric"] == RANKED_BY) & rows["interval_over"].notna() & rows["configuration"].isin(names)]
    sentences = [
        f"Each configuration minus {comparison.baseline}, paired by log, object and run",
        describe_results(results, names),
    ]
    if len(limited):
        sentences.append(
            f"Lines: 95 % intervals over {describe_over(results)}; bold: it has a {STAR}; hollow: no interval"
        )
    gains = [
        f"{row.configuration} {describe_gain(row)}" for row in limited.itertuples() if not pd.isna(row.logs_better)
    ]
    return [*sentences, *([f"Mean time: {', '.join(gains)}"] if gains else [])]


def _describe_upper_bound(
    results: Results, rows: dict[tuple[str, str], Any], compared: Sequence[str], names: Sequence[str]
) -> list[str]:
    """A sentence on the ground truth, which is not drawn because it would lengthen the axis."""
    left = [name for name in compared if name not in names]
    values = [f"{name} {_make_dot(rows.get((name, RANKED_BY)), RANKED_BY).words} s" for name in left]
    return [f"The ground truth, an upper bound, is not drawn: {', '.join(values)}"] if values else []
