"""Figure of false positives per minute over position error, a mark per configuration.

Marks near the origin are better in both. A fusion that keeps more entries detects sooner, and keeps more false
positives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.report.figures.style import (
    add_note,
    choose_appearances,
    describe_results,
    figure_style,
    find_contenders,
    mark_configuration,
    new_figure,
    number_marks,
    shorten_names,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


_ERROR, _FALSE = "position_rmse_m", "false_positives_per_min"
_WIDE_IN, _HIGH_IN = 8.0, 4.0
_FAR = 20.0
"""Ratio of largest to smallest rate from which the axis is logarithmic, so that small rates stay apart."""
_MARK_PT = 7.0


def no_false_positives(results: Results, names: Sequence[str]) -> str | None:
    """The reason why the figure cannot be drawn, "" if it need not be given; None if it can."""
    if all(results.facts[name].by_truth_id for name in names):
        return ""
    return None if len(_contenders_with_both(results, names)) > 1 else ""


def _contenders_with_both(results: Results, names: Sequence[str]) -> list[str]:
    """Contenders with both metrics."""
    rows = results.summary.set_index("configuration")
    if _ERROR not in rows or _FALSE not in rows:
        return []
    has_both = rows[[_ERROR, _FALSE]].notna().all(axis=1)
    return [name for name in find_contenders(results, names) if has_both[name]]


def false_positives_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """False positives per minute over the position error (RMSE) of each configuration; lower left is better."""
    selected = results.chosen(configurations)
    names = _contenders_with_both(results, selected)
    rows = results.summary.set_index("configuration")
    error_m, rate = (rows.loc[names, key].to_numpy(dtype=float) for key in (_ERROR, _FALSE))
    looks, short = choose_appearances(results), shorten_names(names)
    with figure_style():
        figure = new_figure(_WIDE_IN, _HIGH_IN + 0.06 * max(len(names) - 8, 0))
        axes = figure.subplots()
        _set_scales(axes, error_m, rate)
        for k, name in enumerate(names):
            look = looks[name]
            with mark_configuration(list(looks).index(name), axes):
                axes.scatter(
                    [error_m[k]], [rate[k]], s=_MARK_PT**2, marker=look.marker, facecolor=look.colour, zorder=3,
                    label=name, clip_on=False,
                )  # fmt: skip
        axes.set_xlabel("Position error, RMSE (m)")
        axes.set_ylabel("False positives per minute")
        rest = [short_name for name, short_name in shorten_names(selected).items() if name not in names]
        add_note(
            figure,
            [
                describe_results(results, names),
                "Better towards the lower left. Without intervals: those of the differences are in the table",
                f"Not drawn, for they have no such metrics or are the ground truth: {', '.join(rest)}" if rest else "",
            ],
        )
        number_marks(figure, axes, [short[name] for name in names], _MARK_PT)
    return figure


def _set_scales(axes: Axes, error_m: Float, rate: Float) -> None:
    """Set the axes: error from 0 if marks stay apart, else from near the smallest; rates far apart logarithmic."""
    span = float(np.ptp(error_m))
    low = 0.0 if span > 0.3 * error_m.max() else max(0.0, error_m.min() - 0.3 * (span or error_m.max() or 1.0))
    axes.set_xlim(low, error_m.max() + 0.25 * (error_m.max() - low or 1.0))
    if rate.min() > 0 and rate.max() / rate.min() > _FAR:
        axes.set_yscale("log")
        axes.set_ylim(rate.min() / 1.6, rate.max() * 1.6)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    else:
        axes.set_ylim(0.0, 1.12 * rate.max() or 1.0)
