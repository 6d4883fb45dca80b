"""Figure of curves: share of objects not yet known over the time since the onset, with 95 % bands, by configuration.

More than six curves have a panel each, with the baseline in every one.

The curves are what cumulative incidences of detection (Aalen–Johansen, departure competing: `metrics/survival.py`)
leave of 100 %: objects that are never detected keep them above 0.

Bands are those of `metrics/row_figures.py`. Letters of the shapes: n rows, M steps of a curve.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Float
from copem_replay.metrics.limits import CONFIDENCE, NOTHING_DRAWN, OBJECTS, Clusters, find_clusters, weigh_rows
from copem_replay.metrics.row_figures import FigureRows
from copem_replay.report.figures.selection import TOGETHER, describe_left_out, find_differing
from copem_replay.report.figures.style import (
    Appearance,
    add_note,
    choose_appearances,
    describe_list_rates,
    describe_over,
    describe_results,
    explain_no_intervals,
    figure_style,
    mark_configuration,
    new_figure,
    shorten_names,
)
from copem_replay.results.compare.labels import find_baseline

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


# Curves.

_NEARLY = 0.005
"""The axis ends where each curve is within this of its last value: what follows could not be seen."""
_COLUMNS, _PANEL_IN = 3, 1.45
"""Panels beside each other, and the height of one."""
_EXACT: dict[str, Any] = {"color": "black", "linewidth": 0.7, "linestyle": (0, (5, 3))}
_INSTANTS = 600
"""Most instants of a band, about one per pixel: it keeps the SVG small."""


@dataclass(frozen=True)
class DetectionCurve:
    """A step function: 0 before the first of `times_s` (M,), `share` (M,) from each on; with limits (M,) or None."""

    times_s: Float
    share: Float
    low: Float | None = None
    high: Float | None = None

    @property
    def last(self) -> float:
        """The last value; 0 without steps."""
        return float(self.share[-1]) if len(self.share) else 0.0

    def nearly_s(self) -> float:
        """The first step within `_NEARLY` of the last value (s)."""
        return float(self.times_s[np.argmax(self.share >= self.last - _NEARLY)]) if len(self.share) else 0.0


def curves_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Share not yet known over the time since the onset, of up to twelve configurations that differ.

    Up to `TOGETHER` in one panel with 95 % bands; more in a panel each, with the baseline in all of them, without
    bands. With exact curves if the results have them.
    """
    selected = results.chosen(configurations)
    names = find_differing(results, selected)
    over, curves = build_curves(results, names, bands=len(names) <= TOGETHER)
    counted = None if results.exact is None else results.counted(results.exact)
    weigh = results.experiment.measure.weigh
    exact = {} if counted is None else {name: exact_curve(counted, name, weigh) for name in names}
    with figure_style():
        looks, limits_s = choose_appearances(results), choose_time_limits([*curves.values(), *exact.values()])
        if len(names) <= TOGETHER:
            figure = _draw_together(curves, exact, looks, limits_s)
        else:
            figure = _draw_apart(curves, exact, looks, limits_s, find_baseline(results.facts, names).name)
        _add_caption(figure, results, names, over, curves, bool(exact), describe_left_out(selected, names))
        return figure


def build_curves(
    results: Results, names: Sequence[str], *, bands: bool = True
) -> tuple[str | None, dict[str, DetectionCurve]]:
    """The kind of clusters (None, or `NOTHING_DRAWN`), and the curves, with bands where there are clusters."""
    weigh = results.experiment.measure.weigh
    clusters = find_clusters(results.known, weigh=weigh)
    fixed = [name for name in names if clusters is not None and clusters.by_run and results.facts[name].fixed]
    curves = {}
    for name in names:
        kept = (results.known["configuration"] == name).to_numpy()
        banded = bands and clusters is not None and name not in fixed
        chosen = clusters.select(kept) if banded and clusters else None
        curves[name] = build_curve(results.known[kept], chosen, weigh)
    over = None if clusters is None else clusters.over
    return (NOTHING_DRAWN if fixed and len(fixed) == len(names) else over), curves


def build_curve(rows: pd.DataFrame, clusters: Clusters | None, weigh: str = OBJECTS) -> DetectionCurve:
    """The curve of one configuration's rows (n,), with a band over their clusters if there are any. `weigh`: as for
    `weigh_rows`.
    """
    if not len(rows):
        return DetectionCurve(np.empty(0), np.empty(0))
    figures = FigureRows(rows, weigh_rows(rows, "runs", weigh), clusters)
    times_s, share = figures.curve
    if clusters is None or not len(times_s):
        return DetectionCurve(times_s, share)
    steps = np.unique(np.linspace(0, len(times_s) - 1, min(len(times_s), _INSTANTS)).astype(int))
    low, high = figures.limit_incidence(times_s[steps], CONFIDENCE)
    step_ix = np.searchsorted(steps, np.arange(len(times_s)), side="right") - 1
    return DetectionCurve(times_s, share, low[step_ix], high[step_ix])


def exact_curve(exact: pd.DataFrame, name: str, weigh: str = OBJECTS) -> DetectionCurve:
    """The exact probability of being detected by then, averaged over objects, or drives, by `weigh`.

    It differs from the estimator of the runs' curves, which hands the weight of censored rows on to all remaining ones,
    even to an ending with a probability of a millionth, which no run has.
    """
    rows = exact[exact["configuration"] == name]
    found = (rows["time_to_detection_s"].notna() & (rows["probability"] > 0)).to_numpy()
    detections, weight = rows[found], weigh_rows(rows, "probability", weigh)[found]
    times_s, place = np.unique(detections["time_to_detection_s"].to_numpy(dtype=float), return_inverse=True)
    mass = np.bincount(place, weights=weight, minlength=len(times_s))
    return DetectionCurve(times_s, np.cumsum(mass) / max(rows.groupby(["log", "object_id", "episode"]).ngroups, 1))


def _draw_apart(
    curves: dict[str, DetectionCurve], exact: dict[str, DetectionCurve], looks: dict[str, Appearance],
    limits_s: tuple[float, float], baseline: str,
) -> Figure:  # fmt: skip
    """A panel for each configuration but the baseline, which is in all of them, thicker."""
    short, others = shorten_names(list(curves)), [name for name in curves if name != baseline]
    panel_rows = math.ceil(len(others) / _COLUMNS)
    figure = new_figure(8.0, 0.8 + _PANEL_IN * panel_rows)
    panels = figure.subplots(panel_rows, _COLUMNS, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, name in zip(panels, others, strict=False):
        shown = [{key: of[key] for key in (baseline, name) if key in of} for of in (curves, exact)]
        widths = {key: replace(looks[key], width_pt=2.6 if key == baseline else 1.5) for key in shown[0]}
        _draw_lines(axes, shown[0], shown[1], looks | widths, limits_s)
        axes.set_title(short[name], loc="left")
    for axes in panels[len(others) :]:
        axes.set_axis_off()
    for axes in panels[max(len(others) - _COLUMNS, 0) : len(others)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("Time since the object counts (s)")
    for axes in panels[::_COLUMNS]:
        axes.set_ylabel("Not yet known")
    drawn = [line for line in panels[0].get_lines() if line.get_label() == baseline]
    figure.legend(drawn, [f"{short[baseline]}, in each panel"], loc="outside upper right", handlelength=3.2)
    return figure


def _draw_lines(
    axes: Axes, curves: dict[str, DetectionCurve], exact: dict[str, DetectionCurve], looks: dict[str, Appearance],
    limits_s: tuple[float, float],
) -> None:  # fmt: skip
    """Draw each curve with its band as share not yet known, and exact curves black; `limits_s`: ends of the axis."""
    numbers = {name: k for k, name in enumerate(looks)}
    for name, curve in curves.items():
        with mark_configuration(numbers[name], axes):
            _draw_band(axes, curve, name, looks[name], *limits_s)
            _draw_step(axes, curve, *limits_s, label=name, zorder=2.2, **looks[name].line())
    for name, curve in exact.items():
        with mark_configuration(numbers[name], axes):
            _draw_step(axes, curve, *limits_s, label="exact", zorder=3, **_EXACT)
    axes.set_xlim(*limits_s)
    axes.set_ylim(-0.02, 1.03)
    axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")


def _draw_together(
    curves: dict[str, DetectionCurve], exact: dict[str, DetectionCurve], looks: dict[str, Appearance],
    limits_s: tuple[float, float],
) -> Figure:  # fmt: skip
    """All curves in one panel, with their names at their ends."""
    short, end_s = shorten_names(list(curves)), limits_s[1]
    figure = new_figure(8.0, 4.5)
    axes = figure.subplots()
    numbers = {name: k for k, name in enumerate(looks)}
    _draw_lines(axes, curves, exact, looks, limits_s)
    label_places = spread_labels([1 - _evaluate_share(curve, end_s) for curve in curves.values()])
    for (name, curve), place in zip(curves.items(), label_places, strict=True):
        with mark_configuration(numbers[name], axes):
            _draw_label(axes, short[name], looks[name], (end_s, 1 - _evaluate_share(curve, end_s)), place)
    axes.set_xlabel("Time since the object counts (s)")
    axes.set_ylabel("Share not yet known")
    return figure


_APART = 0.05
"""Least distance of two labels at the ends of lines, as a share of the axis: the height of their letters."""


def spread_labels(ends: Sequence[float]) -> list[float]:
    """Places of labels at the ends of lines, in their order and `_APART` or more apart, the lowest at its end."""
    places = [0.0] * len(ends)
    lowest = -math.inf
    for k in sorted(range(len(ends)), key=lambda k: ends[k]):
        lowest = places[k] = max(ends[k], lowest + _APART)
    over = max([0.0, *(place - 1.02 for place in places)])
    return (
        [place - over for place in places] if over and max(ends, default=0) - min(ends, default=0) < _APART else places
    )


def _draw_label(axes: Axes, name: str, look: Appearance, end: tuple[float, float], place: float) -> None:
    """Write a name at the end of its line, right of the axis, with a thin line from one to the other."""
    begin_s, end_s = axes.get_xlim()
    beside = end[0] + 0.03 * (end_s - begin_s)
    axes.plot([end[0], beside], [end[1], place], color=look.colour, linewidth=0.8, clip_on=False)
    axes.text(beside, place, f" {name}", va="center", ha="left", fontsize=8.5, clip_on=False)


def _draw_band(axes: Axes, curve: DetectionCurve, name: str, look: Appearance, begin_s: float, end_s: float) -> None:
    if curve.low is None or curve.high is None:
        return
    x, low, high = (_step_vertices(curve.times_s, values, begin_s, end_s) for values in (None, curve.low, curve.high))
    low, high = 1 - high, 1 - low
    axes.fill_between(
        x, low, high, step="post", color=look.colour, alpha=0.2, linewidth=0, zorder=1, label=f"band of {name}"
    )
    for limit in (low, high):
        axes.step(x, limit, where="post", color=look.colour, linewidth=0.5, alpha=0.7, zorder=1.1)


def choose_time_limits(curves: Sequence[DetectionCurve]) -> tuple[float, float]:
    """Limits of the time axis: before the first detection, and where each curve is near its last value."""
    begin_s = min([0.0, *(float(curve.times_s[0]) for curve in curves if len(curve.times_s))])
    end_s = max(curve.nearly_s() for curve in curves)
    end_s += 0.12 * (end_s - begin_s) or 1.0
    return begin_s - 0.03 * (end_s - begin_s), end_s


def _draw_step(axes: Axes, curve: DetectionCurve, begin_s: float, end_s: float, **line: Any) -> list[Any]:
    x, y = (_step_vertices(curve.times_s, values, begin_s, end_s) for values in (None, curve.share))
    return axes.step(x, 1 - y, where="post", **line)


def _step_vertices(times_s: Float, values: Float | None, begin_s: float, end_s: float) -> Float:
    """Times (`values` None) or values of the vertices (M + 2,) of a step function over the whole axis."""
    shown = times_s <= end_s
    if values is None:
        return np.concatenate([[begin_s], times_s[shown], [end_s]])
    kept = values[shown]
    return np.concatenate([[0.0], kept, kept[-1:] if len(kept) else [0.0]])


def _add_caption(
    figure: Figure,
    results: Results,
    names: Sequence[str],
    over: str | None,
    curves: dict[str, DetectionCurve],
    exact: bool,
    omitted: str,
) -> None:
    """Add the note below the figure: rows, list rates, bands or why there are none, and what is beyond the axis."""
    bands = ""
    if over is None:
        bands = f"No bands: {explain_no_intervals(results)}"
    elif over == NOTHING_DRAWN:
        bands = "No bands: nothing drawn, every run is the same"
    elif len(names) > TOGETHER:
        bands = f"No bands with more than {TOGETHER} curves; choose some with --configurations"
    else:
        bands = f"Bands: 95 %, over {describe_over(results)}"
    end_s = figure.axes[0].get_xlim()[1]
    beyond = max((curve.last - _evaluate_share(curve, end_s) for curve in curves.values()), default=0.0)
    add_note(
        figure,
        [
            omitted,
            describe_results(results, names),
            describe_list_rates(results.summary, names),
            "What departs undetected is never known (Aalen–Johansen, departure competing)",
            bands,
            "Dashed: the exact share" if exact else "",
            f"Beyond the axis at most {math.ceil(1000 * beyond) / 10:g} % more are detected" if beyond > 0 else "",
        ],
    )


def _evaluate_share(curve: DetectionCurve, time_s: float) -> float:
    k = int(np.searchsorted(curve.times_s, time_s, side="right"))
    return float(curve.share[k - 1]) if k else 0.0
