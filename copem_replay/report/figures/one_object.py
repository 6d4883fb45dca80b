"""The figure of a run in which nothing brakes: one course for all configurations, and when each of them detects.

Perception is open-loop, so ego and object drive the same course in every configuration: it is drawn once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.visibility_curves import BY_EGO, share_curves
from copem_replay.report.figures.captions import plain, short_names
from copem_replay.report.figures.dots import ROW_IN
from copem_replay.report.figures.label_layout import LABEL_PT
from copem_replay.report.figures.style import FAINT, INK, Appearance, appearances, new_figure
from copem_replay.report.figures.timeline import Story
from copem_replay.report.figures.trajectories import recorded_course

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results

_WIDTH_IN, _PANEL_IN = 7.0, 1.15
_NODE_S = 0.02
_MARGIN = 0.08
"""How much of the time that is shown is before the first and after the last event (chosen)."""
_CURVE: dict[str, Any] = {"color": INK, "linewidth": 1.6}


def draw_one_column(results: Results, replay: Replay, stories: Sequence[Story]) -> Figure:
    """A row per configuration, with a mark at its detection; below them speed, distance and visible share."""
    looks = appearances(tuple(results.experiment.configurations))
    shares = share_curves(replay, replay.measured, stories[0].object_ix).get(BY_EGO)
    heights = [ROW_IN * len(stories), _PANEL_IN, _PANEL_IN, *([_PANEL_IN] if shares is not None else [])]
    begin_s, end_s = _limits(stories)
    figure = new_figure(_WIDTH_IN, sum(heights) + 1.3)
    rows, *panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    _known(rows, stories, looks)
    since_s = np.arange(begin_s, end_s, _NODE_S)
    course = recorded_course(replay, results.experiment.max_gap_s, stories[0].object_ix, since_s + stories[0].onset_s)
    _curve(panels[0], since_s, course.speed_mps, "Speed of\nthe ego (m/s)")
    _curve(panels[1], since_s, course.gap_m, "Distance between\nthe boxes (m)")
    if shares is not None:
        time_s = shares.elapsed_ns * 1e-9 - stories[0].onset_s
        panels[2].step(time_s, shares.share, where="post", label="visible share", **_CURVE)
        panels[2].set_ylabel("Visible share\nfrom the ego")
        panels[2].set_ylim(-0.05, 1.05)
    for axes in (rows, *panels):
        axes.axvline(0.0, color=INK, linewidth=0.9, linestyle=(0, (1, 1.5)), zorder=1.5)
    for axes in panels:
        for told in stories:
            if (at_s := _at(told, "arrives")) is not None:
                axes.axvline(at_s, color=looks[told.configuration].edge, linewidth=1.0, zorder=1.4)
    rows.set_xlim(begin_s, end_s)
    panels[-1].set_xlabel("Time since the onset (s)")
    return figure


def _at(told: Story, kind: str) -> float | None:
    return next((event.time_s for event in told.events if event.kind == kind), None)


def _limits(stories: Sequence[Story]) -> tuple[float, float]:
    """From before the onset until after the last detection, or until the end where one never detects."""
    instants = [0.0]
    for told in stories:
        at_s = _at(told, "arrives")
        ends = [event.time_s for event in told.events]
        instants += [at_s] if at_s is not None else [max(ends)]
    span_s = max(max(instants) - min(instants), 1.0)
    return min(instants) - _MARGIN * span_s, max(instants) + 2 * _MARGIN * span_s


def _known(axes: Axes, stories: Sequence[Story], looks: dict[str, Appearance]) -> None:
    """From the capture of the list that tells to its arrival a line, and there a mark."""
    short = short_names([told.configuration for told in stories])
    for row, told in enumerate(stories):
        look, at_s, captured_s = looks[told.configuration], _at(told, "arrives"), _at(told, "captured")
        if at_s is not None:
            if captured_s is not None:
                axes.plot([captured_s, at_s], [row, row], color=look.edge, linewidth=1.4, zorder=2, label="transport")
            axes.scatter(
                [at_s], [row], s=36, marker=look.marker, facecolor=look.colour, edgecolor=look.edge, zorder=3,
                label=told.configuration,
            )  # fmt: skip
        words = "never known" if at_s is None else f"{plain(at_s)} s"
        axes.text(
            1.01, row, words, transform=axes.get_yaxis_transform(), ha="left", va="center_baseline",
            fontsize=LABEL_PT, color=FAINT if at_s is None else INK,
        )  # fmt: skip
    axes.set_yticks(range(len(stories)), [short[told.configuration] for told in stories])
    axes.set_ylim(len(stories) - 0.45, -0.55)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.set_title("Known, by configuration", loc="left")


def _curve(axes: Axes, since_s: Float, values: Float, label: str) -> None:
    axes.plot(since_s, values, label="as recorded", **_CURVE)
    axes.set_ylabel(label)
    top = max(float(np.nanmax(values, initial=0.0)), 1.0)
    axes.set_ylim(-0.04 * top, 1.06 * top)
