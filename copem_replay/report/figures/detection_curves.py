"""The figure of curves: which share of the objects is detected by when, configuration by configuration.

The curves are cumulative incidences of detection (Aalen–Johansen, departure competing:
metrics/survival.py), so that what is never detected keeps them below 100 %.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.end_reason import competes
from copem_replay.metrics.fixed import NOTHING_DRAWN, fixed_in
from copem_replay.metrics.intervals import FEWEST_CLUSTERS, clusters
from copem_replay.metrics.survival import CENSORED, DETECTED, LEFT, cumulative_incidence
from copem_replay.report.figures.bands import band
from copem_replay.report.figures.captions import list_rates, short_names, study
from copem_replay.report.figures.selection import left_out, that_differ
from copem_replay.report.figures.style import (
    Appearance,
    add_note,
    appearances,
    new_figure,
    of_configuration,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results

_NEARLY = 0.005
"""The axis ends when each curve has come this near to its last value (chosen)."""
MOST_BANDS = 6
"""More bands than this hide each other (chosen)."""
_EXACT: dict[str, Any] = {"color": "black", "linewidth": 0.7, "linestyle": (0, (5, 3))}
_INSTANTS = 600
"""At which a band is drawn, at most (chosen: a few per pixel's width)."""


@dataclass(frozen=True)
class DetectionCurve:
    """A step function: 0 before the first of `times_s (M,)`, `share (M,)` from each on; limits (M,) or None."""

    times_s: Float
    share: Float
    low: Float | None = None
    high: Float | None = None

    @property
    def last(self) -> float:
        """The value it ends with."""
        return float(self.share[-1]) if len(self.share) else 0.0

    def nearly_s(self) -> float:
        """When it has come near to its last value."""
        return float(self.times_s[np.argmax(self.share >= self.last - _NEARLY)]) if len(self.share) else 0.0


def curves_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Share detected over the time since the onset, of up to twelve configurations that differ.

    With 95 % bands, unless there are too many of them, and the exact curves, where there are some.
    """
    every = results.chosen(configurations)
    names = that_differ(results, every)
    over, curves = curves_of(results, names, bands=len(names) <= MOST_BANDS)
    exact = {name: exact_curve(results.exact, name) for name in names} if results.exact is not None else {}
    with style():
        figure = _drawn(results, curves, exact)
        _note(figure, results, names, over, curves, bool(exact), left_out(every, names))
        return figure


def endings(rows: pd.DataFrame) -> tuple[Float, Int, Int]:
    """Time (n,) from the onset to the detection or to the end of the episode, how the episode ended, in how many runs.

    Of rows of `Results.known`.
    """
    detected = rows["time_to_detection_s"].notna().to_numpy()
    looked_s = (rows["ended_s"] - rows["onset_s"]).to_numpy(dtype=float)
    time_s = np.where(detected, rows["time_to_detection_s"].to_numpy(dtype=float), looked_s)
    ending = np.where(detected, DETECTED, np.where(competes(rows["ended_by"]), LEFT, CENSORED))
    return time_s, ending, rows["runs"].to_numpy()


def curves_of(
    results: Results, names: Sequence[str], *, bands: bool = True
) -> tuple[str | None, dict[str, DetectionCurve]]:
    """What is resampled whole, or `NOTHING_DRAWN`; and the curves, with bands where there is something to resample."""
    over, cluster = clusters(results.known)
    same = [name for name in names if over == "runs" and fixed_in(results.experiment.as_written()).known(name)]
    over = NOTHING_DRAWN if same and len(same) == len(names) else over
    curves = {}
    for name in names:
        rows = results.known["configuration"] == name
        banded = bands and over is not None and name not in same
        curves[name] = curve_of(results.known[rows], cluster[rows] if banded else None, results.experiment.seed)
    return over, curves


def curve_of(rows: pd.DataFrame, cluster: pd.Series | None, seed: int) -> DetectionCurve:
    """The curve of one configuration's rows (n,), with a band where it is said which cluster each row is of."""
    if not len(rows):
        return DetectionCurve(np.empty(0), np.empty(0))
    time_s, ending, runs = endings(rows)
    times_s, share = cumulative_incidence(time_s, ending, runs.astype(float))
    if cluster is None or not len(times_s):
        return DetectionCurve(times_s, share)
    # Few enough steps for a file of a bearable size.
    kept = np.unique(np.linspace(0, len(times_s) - 1, min(len(times_s), _INSTANTS)).astype(int))
    low, high = band(time_s, ending, list(cluster), times_s[kept], seed, runs)
    held = np.searchsorted(kept, np.arange(len(times_s)), side="right") - 1
    return DetectionCurve(times_s, share, low[held], high[held])


def exact_curve(exact: pd.DataFrame, name: str) -> DetectionCurve:
    """The probability of being detected by then, every log and object counting the same.

    Not the estimator of the runs' curves, which hands the weight of censored rows on to all that remain: be it a
    millionth of one, as none of the runs has it.
    """
    rows = exact[exact["configuration"] == name]
    known = rows[rows["time_to_detection_s"].notna() & (rows["probability"] > 0)]
    times_s, place = np.unique(known["time_to_detection_s"].to_numpy(dtype=float), return_inverse=True)
    mass = np.bincount(place, weights=known["probability"].to_numpy(dtype=float), minlength=len(times_s))
    return DetectionCurve(times_s, np.cumsum(mass) / max(rows.groupby(["log", "object_id"]).ngroups, 1))


def _drawn(results: Results, curves: dict[str, DetectionCurve], exact: dict[str, DetectionCurve]) -> Figure:
    looks = appearances(tuple(results.experiment.configurations))
    short = short_names(list(curves))
    begin_s, end_s = time_axis([*curves.values(), *exact.values()])
    figure = new_figure(8.0, 4.5)
    axes = figure.subplots()
    handles: list[Any] = []
    numbers = {name: k for k, name in enumerate(looks)}
    for name, curve in curves.items():
        with of_configuration(numbers[name], axes):
            _band(axes, curve, name, looks[name], begin_s, end_s)
            handles += _step(axes, curve, begin_s, end_s, label=name, zorder=2.2, **looks[name].line())
    for k, (name, curve) in enumerate(exact.items()):
        with of_configuration(numbers[name], axes):
            drawn = _step(axes, curve, begin_s, end_s, label="exact", zorder=3, **_EXACT)
        handles += drawn if k == 0 else []
    _axes(axes, begin_s, end_s)
    axes.set_xlabel("Time since the onset (s)")
    axes.set_ylabel("Share detected by then")
    figure.legend(
        handles=handles,
        labels=[*(short[name] for name in curves), *(["exact"] if exact else [])],
        loc="outside right upper",
        handlelength=3.6,
    )
    return figure


def _axes(axes: Axes, begin_s: float, end_s: float) -> None:
    axes.set_xlim(begin_s, end_s)
    axes.set_ylim(-0.02, 1.03)
    axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")


def _band(axes: Axes, curve: DetectionCurve, name: str, look: Appearance, begin_s: float, end_s: float) -> None:
    if curve.low is None or curve.high is None:
        return
    x, low, high = (_steps(curve.times_s, values, begin_s, end_s) for values in (None, curve.low, curve.high))
    axes.fill_between(
        x, low, high, step="post", color=look.colour, alpha=0.2, linewidth=0, zorder=1, label=f"band of {name}"
    )
    for limit in (low, high):
        axes.step(x, limit, where="post", color=look.edge, linewidth=0.5, alpha=0.7, zorder=1.1)


def time_axis(curves: Sequence[DetectionCurve]) -> tuple[float, float]:
    """From before the first detection until each curve has come near to its last value."""
    begin_s = min([0.0, *(float(curve.times_s[0]) for curve in curves if len(curve.times_s))])
    end_s = max(curve.nearly_s() for curve in curves)
    end_s += 0.12 * (end_s - begin_s) or 1.0
    return begin_s - 0.03 * (end_s - begin_s), end_s


def _step(axes: Axes, curve: DetectionCurve, begin_s: float, end_s: float, **line: Any) -> list[Any]:
    x, y = (_steps(curve.times_s, values, begin_s, end_s) for values in (None, curve.share))
    return axes.step(x, y, where="post", **line)


def _steps(times_s: Float, values: Float | None, begin_s: float, end_s: float) -> Float:
    """Vertices (M + 2,) of a step function over the whole axis: its times, or its values."""
    shown = times_s <= end_s
    if values is None:
        return np.concatenate([[begin_s], times_s[shown], [end_s]])
    kept = values[shown]
    return np.concatenate([[0.0], kept, kept[-1:] if len(kept) else [0.0]])


def _note(
    figure: Figure,
    results: Results,
    names: Sequence[str],
    over: str | None,
    curves: dict[str, DetectionCurve],
    exact: bool,
    left: str,
) -> None:
    bands = f"Bands: 95 %, bootstrap over whole {over}, or exact binomial limits where few decide"
    if over is None:
        few = f"fewer than {FEWEST_CLUSTERS}"
        bands = f"No bands: {few} logs and {few} objects, and more runs say nothing about other traffic"
    elif over == NOTHING_DRAWN:
        bands = "No bands: nothing drawn, every run is the same"
    elif len(names) > MOST_BANDS:
        bands = f"No bands with more than {MOST_BANDS} curves; choose some with --configurations"
    end_s = figure.axes[0].get_xlim()[1]
    later = max((curve.last - _share_at(curve, end_s) for curve in curves.values()), default=0.0)
    add_note(
        figure,
        [
            left,
            study(results, names),
            list_rates(results.summary, names),
            "Cumulative incidence of detection: what departs undetected is never detected",
            bands,
            "Dashed: the exact share detected by then" if exact else "",
            f"Beyond the axis at most {math.ceil(1000 * later) / 10:g} % more are detected" if later > 0 else "",
        ],
    )


def _share_at(curve: DetectionCurve, time_s: float) -> float:
    k = int(np.searchsorted(curve.times_s, time_s, side="right"))
    return float(curve.share[k - 1]) if k else 0.0
