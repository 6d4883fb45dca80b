"""The figure of single runs: dynamics and events of one object in one run, a column per configuration.

After the paper's figures of single runs (Piazzoni et al. 2022): speed, distance, and when walking starts, when the
pedestrian is detected, when the vehicle brakes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.visibility_curves import BY_EGO, share_curves
from copem_replay.report.figures.captions import list_rates, short_names
from copem_replay.report.figures.label_layout import STEP_IN, draw_labels, last_instant, mark
from copem_replay.report.figures.selection import Choice, Selection, choose, left_out
from copem_replay.report.figures.style import FAINT, INK, Appearance, add_note, appearances, new_figure, style
from copem_replay.report.figures.timeline import Story, story
from copem_replay.report.figures.trajectories import braked_course, free_course
from copem_replay.results.reread import reread

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results

_WIDTH_IN, _HEIGHT_IN = 2.15, 1.25
"""Size of a panel, about."""
_NODE_S = 0.01
_BEFORE, _AFTER = 0.12, 0.15
"""How much of the time between first and last event is shown before and after (chosen)."""
_LABELS = ("Speed of\nthe ego (m/s)", "Distance between\nthe boxes (m)", "Visible share\nfrom the ego")


def runs_figure(results: Results, of: Selection) -> Figure:
    """Speed of the ego, distance and visible share of one object in one run, a column per configuration.

    Raises InputError for what is not among the results, RecordingError where the log is missing or has changed.
    """
    choice = choose(results, of)
    replay = reread(results, choice.log, choice.object_id)
    (rows,) = results.each(log=choice.log)
    of_run = rows[(rows["object_id"] == choice.object_id) & (rows["run"] == choice.run)].set_index(
        "configuration", drop=False
    )
    stories = [story(replay, results.experiment, of_run.loc[name]) for name in choice.configurations]
    with style():
        figure = _drawn(results, replay, stories)
        add_note(figure, _note(results, choice, stories))
    return figure


def _drawn(results: Results, replay: Replay, stories: Sequence[Story]) -> Figure:
    looks = appearances(tuple(results.experiment.configurations))
    names = short_names([told.configuration for told in stories])
    begin_s, end_s = _limits(stories)
    steps = max(len(told.events) for told in stories)
    figure = new_figure(0.75 + (_WIDTH_IN + 0.12) * len(stories), 3 * _HEIGHT_IN + steps * STEP_IN + 1.35)
    panels = figure.subplots(3, len(stories), sharex=True, sharey="row", squeeze=False)
    nodes = np.arange(begin_s, end_s, _NODE_S)
    for column, told in zip(panels.T, stories, strict=True):
        look = looks[told.configuration]
        since_s = np.unique(np.concatenate([nodes, [event.time_s for event in told.events]]))
        _courses(column[0], column[1], told, results, replay, look, since_s)
        _share(column[2], told, results, replay, look)
        for axes in column:
            for event in told.events:
                axes.axvline(event.time_s, **mark(event))
        draw_labels(column[0], told.events, steps, _HEIGHT_IN)
        title = f"{names[told.configuration]}\n{told.result}"
        column[0].set_title(title, pad=(steps * STEP_IN + 0.08) * 72, loc="left", linespacing=1.4)
        column[2].set_xlabel("Time since the onset (s)")
    for axes, label in zip(panels[:, 0], _LABELS, strict=True):
        axes.set_ylabel(label)
    panels[0, 0].set_xlim(begin_s, end_s)
    for axes in panels[:2, 0]:
        top = max(axes.get_ylim()[1], 1.0)
        axes.set_ylim(-0.04 * top, top)
    panels[2, 0].set_ylim(-0.05, 1.05)
    return figure


def _limits(stories: Sequence[Story]) -> tuple[float, float]:
    """From before the first event until after the last, and until all labels have room."""
    instants = [event.time_s for told in stories for event in told.events]
    span_s = max(max(instants) - min(instants), 1.0)
    begin_s, end_s = min(instants) - _BEFORE * span_s, max(instants) + _AFTER * span_s
    return begin_s, max(last_instant(told.events, begin_s, end_s, _WIDTH_IN) for told in stories)


def _courses(
    speed: Axes, gap: Axes, told: Story, results: Results, replay: Replay, look: Appearance, since_s: Float
) -> None:
    """Speed and distance at instants (T,) since the onset: braked, and thin without; as recorded without a verdict."""
    experiment, time_s = results.experiment, since_s + told.onset_s
    free = free_course(replay, experiment.max_gap_s, told.object_ix, told.encounter, time_s)
    own = look.line(2.2) | {"linestyle": "-"}
    if told.encounter is None or experiment.braking is None:
        speed.plot(since_s, free.speed_mps, label="as recorded", **own)
        gap.plot(since_s, free.gap_m, label="as recorded", **own)
        return
    course = braked_course(told.encounter, experiment.braking.driver, told.brake_s, time_s)
    kept = time_s <= told.impact_s
    gap.axhline(experiment.braking.margin_m, color=INK, linewidth=0.8, linestyle=(0, (2, 2)), label="margin")
    for axes, thin, thick in ((speed, free.speed_mps, course.speed_mps), (gap, free.gap_m, course.gap_m)):
        axes.plot(since_s, thin, color=FAINT, linewidth=1.0, label="does not brake")
        drawn = np.where(since_s < 0, thin, thick)[kept]  # until the onset the ego does not brake
        axes.plot(since_s[kept], drawn, label="brakes", **own)
        if np.isfinite(told.impact_s):
            axes.plot(since_s[kept][-1:], drawn[-1:], "X", color=INK, markersize=6, label="hits")


def _share(axes: Axes, told: Story, results: Results, replay: Replay, look: Appearance) -> None:
    """How much of the object the ego's own units see of it, list by list, along the recorded course."""
    curve = share_curves(replay, replay.measured, told.object_ix).get(BY_EGO)
    if curve is None:
        axes.text(0.5, 0.5, "the ego carries no unit", transform=axes.transAxes, ha="center", va="center", color=FAINT)
        return
    since_s, brakes_s = curve.elapsed_ns * 1e-9 - told.onset_s, told.brake_s - told.onset_s
    before = since_s <= brakes_s
    there = curve.share[before][-1:]  # at the instant of braking; nothing where it brakes before the first list
    parts = [("visible share", look, since_s[before], curve.share[before])]
    if not before.all():  # from braking on the ego is elsewhere: paler, what it would have seen without
        instant = np.full(len(there), brakes_s)
        parts = [
            ("visible share", look, np.append(since_s[before], instant), np.append(curve.share[before], there)),
            (
                "without braking",
                look.pale,
                np.append(instant, since_s[~before]),
                np.append(there, curve.share[~before]),
            ),
        ]
    for label, shade, time_s, share in parts:
        axes.step(time_s, share, label=label, where="post", **(shade.line(1.8) | {"linestyle": "-"}))


def _note(results: Results, choice: Choice, stories: Sequence[Story]) -> list[str]:
    experiment, braking = results.experiment, results.experiment.braking
    kind = results.known.loc[results.known["object_id"] == choice.object_id, "object_class"].iloc[0]
    thin = ""
    if braking is not None and any(told.encounter is not None for told in stories):
        course = "as recorded" if braking.ego == "recorded" else "with constant speed from the onset"
        thin = (
            f"Thick: the ego brakes as its declared driver does; thin: it does not brake, {course}; dashed: the margin "
            f"of {braking.margin_m:g} m. The visible share is that of an ego that does not brake: pale from braking on"
        )
    return [
        f"{results.name}: {kind} {choice.object_id} in log {choice.log}, run {choice.run}, seed {experiment.seed}; the "
        f"onset is {stories[0].onset_s:.2f} s after the log's start",
        list_rates(results.summary, choice.configurations),
        thin,
        left_out(results.chosen(None), choice.configurations) if not choice.named else "",
        f"Visibility: {experiment.visibility.label}",
    ]
