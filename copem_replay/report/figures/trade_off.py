"""The figure of fusions: false positives per minute against position error, a mark per configuration.

Marks near the origin are better in both. A fusion that keeps more of what is listed detects sooner, and keeps more of
what is not there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.pipeline.receiver import by_truth
from copem_replay.report.figures.captions import short_names, study
from copem_replay.report.figures.contenders import contenders
from copem_replay.report.figures.style import add_note, appearances, new_figure, of_configuration, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results

_ERROR, _FALSE = "position_rmse_m", "false_positives_per_min"
_WIDE_IN, _HIGH_IN = 8.0, 4.0
_FAR = 20.0
"""Largest over smallest rate from which the axis is logarithmic (chosen)."""
_MARK_PT = 7.0


def no_trade_off(results: Results, names: Sequence[str]) -> str | None:
    """The reason why nothing is drawn, "" where it need not be given; None: something is."""
    every = results.experiment.configurations
    if all(by_truth(every[name]) for name in names):
        return ""
    return None if len(_known(results, names)) > 1 else ""


def _known(results: Results, names: Sequence[str]) -> list[str]:
    """Contenders with both metrics."""
    rows = results.summary.set_index("configuration")
    if _ERROR not in rows or _FALSE not in rows:
        return []
    there = rows[[_ERROR, _FALSE]].notna().all(axis=1)
    return [name for name in contenders(results, names) if there[name]]


def trade_off_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """False positives per minute over the position error (RMSE) of each configuration; lower left is better."""
    asked = results.chosen(configurations)
    names = _known(results, asked)
    rows = results.summary.set_index("configuration")
    error_m, rate = (rows.loc[names, key].to_numpy(dtype=float) for key in (_ERROR, _FALSE))
    looks, short = appearances(tuple(results.experiment.configurations)), short_names(names)
    with style():
        figure = new_figure(_WIDE_IN, _HIGH_IN + 0.06 * max(len(names) - 8, 0))
        axes = figure.subplots()
        _scales(axes, error_m, rate)
        for k, name in enumerate(names):
            look = looks[name]
            with of_configuration(list(looks).index(name), axes):
                axes.scatter(
                    [error_m[k]], [rate[k]], s=_MARK_PT**2, marker=look.marker, facecolor=look.colour, zorder=3,
                    edgecolor=look.edge, label=name, clip_on=False,
                )  # fmt: skip
        axes.set_xlabel("Position error, RMSE (m)")
        axes.set_ylabel("False positives per minute")
        left = [short_name for name, short_name in short_names(asked).items() if name not in names]
        add_note(
            figure,
            [
                study(results, names),
                "Better towards the lower left. Without intervals: those of the differences are in the table",
                f"Not drawn, for they have no such metrics or are the ground truth: {', '.join(left)}" if left else "",
            ],
        )
        figure.legend(axes.collections, [short[name] for name in names], loc="outside right upper")
    return figure


def _scales(axes: Axes, error_m: Float, rate: Float) -> None:
    """From 0 where that leaves the marks apart, else from near the smallest; rates far apart on a logarithmic axis."""
    span = float(np.ptp(error_m))
    low = 0.0 if span > 0.3 * error_m.max() else max(0.0, error_m.min() - 0.3 * (span or error_m.max() or 1.0))
    axes.set_xlim(low, error_m.max() + 0.25 * (error_m.max() - low or 1.0))
    if rate.min() > 0 and rate.max() / rate.min() > _FAR:
        axes.set_yscale("log")
        axes.set_ylim(rate.min() / 1.6, rate.max() * 1.6)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    else:
        axes.set_ylim(0.0, 1.12 * rate.max() or 1.0)
