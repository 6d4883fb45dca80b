"""Figure of single runs: speed, distance, visible share and events of one object in one run, by configuration.

After the figures of single runs in Piazzoni et al. 2022, with their events: the pedestrian starts to walk, it is
detected, the vehicle brakes. Perception is open-loop: lists are those of an ego that does not brake.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.compiled import kernel
from copem_replay.core.errors import RecordingError
from copem_replay.core.geometry import box_distance, pose_on_path
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, Float
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.braking.driver import Driver
from copem_replay.metrics.braking.encounter import EgoPath, Encounter
from copem_replay.metrics.braking.verdict import simulate_braking
from copem_replay.metrics.config import Objects
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.metrics.survival import EndReason
from copem_replay.pipeline.one_run import BY_EGO, share_curves
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.report.figures.selection import (
    Choice,
    Selection,
    choose_object_and_run,
    describe_left_out,
    find_differing,
)
from copem_replay.report.figures.style import (
    FAINT,
    INK,
    Appearance,
    add_note,
    choose_appearances,
    describe_list_rates,
    figure_style,
    new_figure,
    shorten_names,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


# Labels of events, above the panel, each on its own step, the earliest highest. A label begins at the right of its
# mark, which ends at its height, so no mark crosses a label. The time axis only has to be long enough for the labels.

LABEL_PT = 7.5
"""Size of labels (points)."""
STEP_IN = 0.145
"""Height of a step, a line of text (inches)."""
_LETTER_EM = 0.56
"""Mean width of a letter of DejaVu Sans by its font size, rounded up."""


def last_instant(events: Sequence[StoryEvent], begin_s: float, end_s: float, width_in: float) -> float:
    """The end of the time axis, `end_s` or later, with room for all labels. `width_in`: width of the panel."""
    for event in events:
        label_in = (len(event.label) + 1.5) * _LETTER_EM * LABEL_PT / 72
        share = min(label_in / width_in, 0.8)
        end_s = max(end_s, begin_s + (event.time_s - begin_s) / (1 - share))
    return end_s


def draw_labels(axes: Axes, events: Sequence[StoryEvent], steps: int, height_in: float) -> None:
    """Draw marks and labels of events, in order of time, above a panel of this height, from step `steps` down."""
    for k, event in enumerate(events):
        top = 1 + (steps - k - 0.1) * STEP_IN / height_in
        axes.plot(
            [event.time_s, event.time_s],
            [1, top],
            transform=axes.get_xaxis_transform(),
            clip_on=False,
            **event_line_style(event),
        )
        axes.annotate(
            event.label,
            (event.time_s, top),
            xycoords=axes.get_xaxis_transform(),
            xytext=(2.5, 0),
            textcoords="offset points",
            fontsize=LABEL_PT,
            va="top",
            color=INK,
            annotation_clip=False,
        )


def event_line_style(event: StoryEvent) -> dict[str, Any]:
    """Style of an event's line: solid for what the ego does, dashed for what it comes to know, dotted for the onset."""
    style = {"onset": (0, (1, 1.5)), "brakes": "-", "outcome": "-"}.get(event.kind, (0, (4, 2)))
    return {"color": INK, "linewidth": 0.9, "linestyle": style, "zorder": 1.5}


# Courses of the ego and its distance to the object: recorded, judged without braking, and braked.


@dataclass(frozen=True)
class DrivenCourse:
    """Speed of the ego and distance to the object at instants (T,) since the log's start; NaN while one is absent."""

    time_s: Float
    speed_mps: Float
    gap_m: Float  # box to box


def recorded_course(replay: Replay, max_gap_s: float, object_ix: int, time_s: Float) -> DrivenCourse:
    """The course in the log."""
    ego = EgoPath(replay.scene, replay.truth, max_gap_s)
    course = ego.course(time_s)
    states, present = ego.states(object_ix, time_s)
    poses = np.stack([states["x_m"], states["y_m"], states["yaw_rad"]])
    k = int(np.argmax(present))  # sizes do not change
    size_m = np.array([states["length_m"][k], states["width_m"][k]])
    speed = np.where(np.isnan(course.along_m), np.nan, course.speed_mps)
    return DrivenCourse(time_s, speed, _box_gaps(course.along_m, ego.path, ego.size_m, poses, size_m))


def free_course(
    replay: Replay, max_gap_s: float, object_ix: int, encounter: Encounter | None, time_s: Float
) -> DrivenCourse:
    """The course without braking: recorded until the onset, then that by which the encounter is judged, if any."""
    course = recorded_course(replay, max_gap_s, object_ix, time_s)
    if encounter is None:
        return course
    after = time_s >= encounter.time_s[0]
    along_m = np.interp(time_s[after], encounter.time_s, encounter.course.along_m, right=np.nan)
    speed = np.interp(time_s[after], encounter.time_s, encounter.course.speed_mps)
    course.speed_mps[after] = np.where(np.isnan(along_m), np.nan, speed)
    course.gap_m[after] = _gaps_along(encounter, along_m, time_s[after])
    return course


def braked_course(encounter: Encounter, driver: Driver, brake_s: float, time_s: Float) -> DrivenCourse:
    """The course from the onset on of an ego that brakes at `brake_s` (inf: never); the object does not react."""
    along_m, speed = (
        np.interp(time_s, encounter.time_s, of[0]) for of in simulate_braking(encounter, driver, np.array([brake_s]))
    )
    speed[np.isnan(along_m)] = np.nan
    course = DrivenCourse(time_s, speed, _gaps_along(encounter, along_m, time_s))
    beyond = (time_s < encounter.time_s[0] - SAME_INSTANT_S) | (time_s > encounter.time_s[-1] + SAME_INSTANT_S)
    course.speed_mps[beyond] = course.gap_m[beyond] = np.nan
    return course


def _gaps_along(encounter: Encounter, along_m: Float, time_s: Float) -> Float:
    """Distance (T,) between boxes, with the ego at places (T,) of its path."""
    poses = np.stack([np.interp(time_s, encounter.time_s, values, right=np.nan) for values in encounter.other])
    return _box_gaps(along_m, encounter.path, encounter.size_m, poses, encounter.other_size_m)


@kernel
def _box_gaps(along: Float, path: Float, size: Float, other: Float, other_size: Float) -> Float:
    """Box distance (T,) of the ego at places (T,) of its path to the other at poses (3, T); NaN while one is absent."""
    result = np.full(len(along), np.nan)
    for k in range(len(along)):
        if not np.isnan(along[k]) and not np.isnan(other[0, k]):
            x, y, yaw = pose_on_path(path, along[k])
            result[k] = box_distance(
                x, y, yaw, size[0], size[1], other[0, k], other[1, k], other[2, k], other_size[0], other_size[1]
            )
    return result


# Stories: events and result of one run in one configuration, from its row of `detections.parquet`.

_STOOD_MPS = 0.05
"""A slower ego has stopped: no slower motion is visible in the figure."""
_LOOK_S = 0.05
"""Time step of the search for the nearest approach of an object without conflict."""

KINDS = ("onset", "captured", "arrives", "foreseen", "brakes", "outcome", "ended")
"""Kinds of events, in the order in which simultaneous ones are listed."""


@dataclass(frozen=True)
class StoryEvent:
    """An event at `time_s` since the onset; `kind` is one of `KINDS`."""

    time_s: float
    kind: str
    label: str


@dataclass(frozen=True)
class Story:
    """One run of one object in one configuration. `encounter`: None without a conflict to judge."""

    configuration: str
    onset_s: float
    object_ix: int
    brake_s: float  # since the log's start; inf: never
    impact_s: float  # since the log's start; inf: never
    encounter: Encounter | None
    events: tuple[StoryEvent, ...]  # in order of time
    result: str


def tell_story(replay: Replay, experiment: Experiment, row: Any) -> Story:
    """The story of one row of `detections.parquet`."""
    object_ix = replay.scene.object_number[row.object_id]
    braking = experiment.braking
    of_row = (replay.episodes.object_ix == object_ix) & (replay.episodes.number == row.episode)
    encounter = next((e for e in replay.encounters if of_row[e.episode_ix]), None)
    occurred = [(row.onset_s, "onset", experiment.measure.onset.label(CLASSES[replay.scene.object_class[object_ix]]))]
    result = "never known"
    if row.detected:
        occurred += [(row.captured_s, "captured", "captured"), (row.detection_s, "arrives", "list arrives")]
        result = f"known after {_format_number(row.time_to_detection_s)} s"
    brake_s = impact_s = np.inf
    if braking is not None and encounter is not None:
        brake_s, impact_s = _or_never(row.brake_s), _or_never(row.impact_s)
        if braking.brakes_for == "conflict" and _or_never(row.conflict_detection_s) < np.inf:
            occurred.append((row.conflict_detection_s, "foreseen", "collision foreseen"))
        if brake_s <= encounter.time_s[np.isfinite(encounter.course.bound_m)].max(
            initial=-np.inf
        ):  # while the ego drives
            occurred.append((brake_s, "brakes", "brakes"))
        ended_s, label = _find_outcome(encounter, braking.driver, braking.margin_m, row, brake_s)
        occurred.append((ended_s, "outcome", label))
        result += ", passes" if row.braking_pass else ", fails"
    else:
        occurred += _find_nearest(replay, experiment.max_gap_s, object_ix, row)
        occurred += [] if row.detected else [(row.ended_s, "ended", EndReason(row.ended_by).label)]
        result += ", no conflict" if braking is not None else ""
    occurred.sort(key=lambda event: (event[0], KINDS.index(event[1])))
    events = tuple(StoryEvent(float(time_s - row.onset_s), kind, label) for time_s, kind, label in occurred)
    return Story(row.configuration, row.onset_s, object_ix, brake_s, impact_s, encounter, events, result)


def _or_never(time_s: float) -> float:
    return float(time_s) if time_s == time_s else np.inf


def _format_number(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".").replace("-", "−")


def _find_outcome(encounter: Encounter, driver: Driver, margin_m: float, row: Any, brake_s: float) -> tuple[float, str]:
    """When a conflict ends (s), and words on how: hit, too near, stopped, or passed."""
    if row.impact_s == row.impact_s:
        return row.impact_s, f"hits at {row.impact_speed_mps:.1f} m/s"
    course = braked_course(encounter, driver, brake_s, encounter.time_s)
    nearest_ix = int(np.nanargmin(course.gap_m))
    if not row.braking_pass:
        near = np.flatnonzero(course.gap_m <= margin_m)  # empty if it is so only between two instants
        return course.time_s[near[0] if len(near) else nearest_ix], f"too near: {row.min_distance_m:.2f} m"
    standstill_s = _find_standstill(course, brake_s)
    if standstill_s is not None:
        return standstill_s, "stops"
    return course.time_s[nearest_ix], f"passes {row.min_distance_m:.1f} m away"


def _find_standstill(course: DrivenCourse, brake_s: float) -> float | None:
    """The instant from which the braking ego stands until the end; None if it does not."""
    instants = np.flatnonzero(~np.isnan(course.speed_mps) & (course.time_s > brake_s))
    if not len(instants) or course.speed_mps[instants[-1]] >= _STOOD_MPS:
        return None
    moving = instants[course.speed_mps[instants] >= _STOOD_MPS]
    after = instants[instants > moving[-1]] if len(moving) else instants
    return float(course.time_s[after[0]])


def _find_nearest(replay: Replay, max_gap_s: float, object_ix: int, row: Any) -> list[tuple[float, str, str]]:
    """The event of the nearest approach in the log, for an object without conflict."""
    count = int((row.ended_s - row.onset_s) / _LOOK_S)
    course = recorded_course(replay, max_gap_s, object_ix, row.onset_s + _LOOK_S * np.arange(count + 1))
    if np.isnan(course.gap_m).all():
        return []
    k = int(np.nanargmin(course.gap_m))
    return [(course.time_s[k], "outcome", f"nearest: {course.gap_m[k]:.1f} m")]


_WIDTH_IN, _HEIGHT_IN = 2.15, 1.25
"""Approximate size of a panel (inches)."""
_NODE_S = 0.01  # step of the drawn courses
_BEFORE, _AFTER = 0.12, 0.15
"""Margins of the time axis, as shares of the time between first and last event; the last label needs more."""
_LABELS = ("Speed of\nthe ego (m/s)", "Distance between\nthe boxes (m)", "Visible share\nfrom the ego")


def runs_figure(results: Results, selection: Selection) -> Figure:
    """Speed of the ego, distance and visible share of one object in one run, a column per configuration.

    Where the ego does not brake, the curves of all configurations are the same: they are drawn once, with a mark of
    when each configuration knows the object.

    Raises InputError for a selection that is not among the results, RecordingError if the log is missing or has
    changed.
    """
    choice = choose_object_and_run(results, selection)
    replay = _prepare_object(results, choice.log, choice.object_id)
    (rows,) = results.each(log=choice.log, every=True)
    of_run = first_episodes(rows[(rows["object_id"] == choice.object_id) & (rows["run"] == choice.run)])
    of_run = of_run.set_index("configuration", drop=False)
    is_shared = not replay.encounters or results.experiment.braking is None
    if is_shared and not choice.named:
        present = [name for name in results.chosen(None) if name in of_run.index]
        choice = replace(choice, configurations=find_differing(results, present))
    stories = [tell_story(replay, results.experiment, of_run.loc[name]) for name in choice.configurations]
    with figure_style():
        figure = (_draw_together if is_shared else _draw_stories)(results, replay, stories)
        add_note(figure, _note_sentences(results, choice, stories))
    return figure


def _prepare_object(results: Results, log: str, object_id: str) -> Replay:
    """One log, prepared again for replay with one measured object only. Raises RecordingError, also without an ego."""
    of_log = resolve_for_log(results.experiment, log)
    measure = of_log.measure.model_copy(update={"objects": Objects(ids=(object_id,))})
    experiment = of_log.model_copy(update={"measure": measure})
    recording = results.recording(log, of_log)
    if recording.scene.ego_ix < 0:
        raise RecordingError("no ego in this study, whose runs could be drawn", path=recording.path)
    return prepare_log(recording, experiment)


def _draw_stories(results: Results, replay: Replay, stories: Sequence[Story]) -> Figure:
    """A column of panels (speed, distance, visible share) for each configuration, with its events."""
    shown = [story.configuration for story in stories]
    looks, names = choose_appearances(results), shorten_names(shown)
    begin_s, end_s = _choose_limits([event for story in stories for event in story.events], _WIDTH_IN)
    steps = max(len(story.events) for story in stories)
    figure = new_figure(0.75 + (_WIDTH_IN + 0.12) * len(stories), 3 * _HEIGHT_IN + steps * STEP_IN + 1.35)
    panels = figure.subplots(3, len(stories), sharex=True, sharey="row", squeeze=False)
    nodes = np.arange(begin_s, end_s, _NODE_S)
    for column, story in zip(panels.T, stories, strict=True):
        look = looks[story.configuration]
        since_s = np.unique(np.concatenate([nodes, [event.time_s for event in story.events]]))
        _draw_courses(column[0], column[1], story, results, replay, look, since_s)
        _draw_share(column[2], story, results, replay, look)
        for axes in column:
            for event in story.events:
                axes.axvline(event.time_s, **event_line_style(event))
        draw_labels(column[0], story.events, steps, _HEIGHT_IN)
        title = f"{names[story.configuration]}\n{story.result}"
        column[0].set_title(title, pad=(steps * STEP_IN + 0.08) * 72, loc="left", linespacing=1.4)
        column[2].set_xlabel("Time since the object counts (s)")
    for axes, label in zip(panels[:, 0], _LABELS, strict=True):
        axes.set_ylabel(label)
    panels[0, 0].set_xlim(begin_s, end_s)
    for axes in panels[:2, 0]:
        top = max(axes.get_ylim()[1], 1.0)
        axes.set_ylim(-0.04 * top, top)
    panels[2, 0].set_ylim(-0.05, 1.05)
    return figure


_OF_ONE = ("captured", "arrives", "foreseen", "ended")
"""Kinds of events that differ between configurations."""
_WIDE_IN = 6.4
"""Approximate width of the panels of all configurations together (inches)."""


def _draw_together(results: Results, replay: Replay, stories: Sequence[Story]) -> Figure:
    """One column of panels for all configurations, with a mark and a label of when each knows the object."""
    shown = [story.configuration for story in stories]
    looks, names = choose_appearances(results), shorten_names(shown)
    first_story = stories[0]
    common_events = [event for event in first_story.events if event.kind not in _OF_ONE]
    known = {story.configuration: _find_known(story) for story in stories}
    never_known = [names[name] for name, event in known.items() if event is None]
    marks = [(name, replace(event, label=f"{names[name]}: {event.label}")) for name, event in known.items() if event]
    labelled = sorted([*(("", event) for event in common_events), *marks], key=lambda mark: mark[1].time_s)
    events = [event for _, event in labelled]
    begin_s, end_s = _choose_limits(events, _WIDE_IN)
    figure = new_figure(0.75 + _WIDE_IN, 3 * _HEIGHT_IN + len(events) * STEP_IN + 1.1)
    column = figure.subplots(3, 1, sharex=True)
    since_s = np.unique(np.concatenate([np.arange(begin_s, end_s, _NODE_S), [event.time_s for event in events]]))
    course = recorded_course(replay, results.experiment.max_gap_s, first_story.object_ix, since_s + first_story.onset_s)
    for axes, values in zip(column, (course.speed_mps, course.gap_m), strict=False):
        axes.plot(since_s, values, label="as recorded", color=INK, linewidth=1.6)
        axes.set_ylim(-0.04 * (top := max(axes.get_ylim()[1], 1.0)), top)
    _draw_share(column[2], first_story, results, replay, replace(looks[shown[0]], colour=INK))
    for name, event in labelled:
        style = event_line_style(event) | ({"color": looks[name].colour, "linewidth": 1.8} if name else {})
        for axes in column:
            axes.axvline(event.time_s, label=f"of {name}" if name else event.kind, **style)
    draw_labels(column[0], events, len(events), _HEIGHT_IN)
    title = f"never known: {', '.join(never_known)}" if never_known else "known by all that are shown"
    column[0].set_title(title, pad=(len(events) * STEP_IN + 0.08) * 72, loc="left")
    for axes, label in zip(column, _LABELS, strict=True):
        axes.set_ylabel(label)
    column[2].set_xlabel("Time since the object counts (s)")
    column[2].set_ylim(-0.05, 1.05)
    column[0].set_xlim(begin_s, end_s)
    return figure


def _find_known(story: Story) -> StoryEvent | None:
    """When a configuration knows the object, with the result; None: never."""
    arrives = [event for event in story.events if event.kind == "arrives"]
    return replace(arrives[0], label=story.result.partition(",")[0]) if arrives else None


def _choose_limits(events: Sequence[StoryEvent], width_in: float) -> tuple[float, float]:
    """Limits of the time axis around all events, with room for all labels."""
    instants = [event.time_s for event in events]
    span_s = max(max(instants) - min(instants), 1.0)
    begin_s, end_s = min(instants) - _BEFORE * span_s, max(instants) + _AFTER * span_s
    return begin_s, last_instant(events, begin_s, end_s, width_in)


def _draw_courses(
    speed: Axes, gap: Axes, story: Story, results: Results, replay: Replay, look: Appearance, since_s: Float
) -> None:
    """Draw speed and distance at instants (T,) since the onset: with braking thick, without thin; else as recorded."""
    experiment, time_s = results.experiment, since_s + story.onset_s
    free = free_course(replay, experiment.max_gap_s, story.object_ix, story.encounter, time_s)
    style = look.line(2.2) | {"linestyle": "-"}
    if story.encounter is None or experiment.braking is None:
        speed.plot(since_s, free.speed_mps, label="as recorded", **style)
        gap.plot(since_s, free.gap_m, label="as recorded", **style)
        return
    course = braked_course(story.encounter, experiment.braking.driver, story.brake_s, time_s)
    is_until_impact = time_s <= story.impact_s
    gap.axhline(experiment.braking.margin_m, color=INK, linewidth=0.8, linestyle=(0, (2, 2)), label="margin")
    for axes, thin, thick in ((speed, free.speed_mps, course.speed_mps), (gap, free.gap_m, course.gap_m)):
        axes.plot(since_s, thin, color=FAINT, linewidth=1.0, label="does not brake")
        with_braking = np.where(since_s < 0, thin, thick)[is_until_impact]  # until the onset the ego does not brake
        axes.plot(since_s[is_until_impact], with_braking, label="brakes", **style)
        if np.isfinite(story.impact_s):
            axes.plot(since_s[is_until_impact][-1:], with_braking[-1:], "X", color=INK, markersize=6, label="hits")


def _draw_share(axes: Axes, story: Story, results: Results, replay: Replay, look: Appearance) -> None:
    """Draw the visible share from the ego's units, list by list, along the recorded course; pale after braking."""
    curve = share_curves(replay, replay.rows_of(np.array([story.object_ix])), story.object_ix).get(BY_EGO)
    if curve is None:
        axes.text(0.5, 0.5, "the ego carries no unit", transform=axes.transAxes, ha="center", va="center", color=FAINT)
        return
    since_s, brakes_s = curve.elapsed_ns * 1e-9 - story.onset_s, story.brake_s - story.onset_s
    before = since_s <= brakes_s
    last_share = curve.share[before][-1:]  # at the instant of braking; empty if it is before the first list
    parts = [("visible share", look, since_s[before], curve.share[before])]
    if not before.all():  # from braking on, the share without braking is pale: the ego would be elsewhere
        instant = np.full(len(last_share), brakes_s)
        parts = [
            ("visible share", look, np.append(since_s[before], instant), np.append(curve.share[before], last_share)),
            (
                "without braking",
                look.pale,
                np.append(instant, since_s[~before]),
                np.append(last_share, curve.share[~before]),
            ),
        ]
    for label, shade, time_s, share in parts:
        axes.step(time_s, share, label=label, where="post", **(shade.line(1.8) | {"linestyle": "-"}))


def _note_sentences(results: Results, choice: Choice, stories: Sequence[Story]) -> list[str]:
    """The sentences below the figure: which object, run and seed, what lines mean, and what is left out."""
    experiment, braking = results.experiment, results.experiment.braking
    kind = results.tally.loc[results.tally["object_id"] == choice.object_id, "object_class"].iloc[0]
    thin = ""
    if braking is not None and any(story.encounter is not None for story in stories):
        course = "as recorded" if braking.ego == "recorded" else "with constant speed from then on"
        thin = (
            f"Thick: the ego brakes as its declared driver does; thin: it does not brake, {course}; dashed: the margin "
            f"of {braking.margin_m:g} m. The visible share is that of an ego that does not brake: pale from braking on"
        )
    return [
        f"{results.name}: {kind} {choice.object_id} in log {choice.log}, run {choice.run}, seed {experiment.seed}; it "
        f"counts from {stories[0].onset_s:.2f} s after the log's start on",
        describe_list_rates(results.summary, choice.configurations),
        thin,
        describe_left_out(results.chosen(None), choice.configurations) if not choice.named else "",
        f"Visibility: {experiment.visibility.label}",
    ]
