"""A film of one object in one run, as a GIF for slides: what each configuration believes, side by side.

A plan for each configuration: true objects as grey outlines, the ego dark, fused tracks in the configuration's
colour, units as dots, lanes and obstacles pale. Its title says in the words of the viewer whether the object is known,
or why it is not; a red line leads from the unit that sees most of a hidden object to what hides it. Below, a bar per
configuration grows while the object is known. A plan follows the object; its longer side is how the ego drove at the
onset.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.api.results import AnyResults, take_results
from copem_replay.core.colours import Rgb, configuration_colours
from copem_replay.core.errors import InputError
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_NS, TRUTH, Bool, Float, Int
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.perception.sight import HIDDEN
from copem_replay.perception.visibility import rectangle_corners
from copem_replay.pipeline.one_run import ReplayedRun
from copem_replay.pipeline.sight import ABSENT, Sight, compute_sight
from copem_replay.pipeline.status import (
    KNOWN,
    NEVER_NS,
    EpisodeClocks,
    Status,
    compute_status,
    elapsed_ns,
    read_episode_clocks,
    to_nanoseconds,
)
from copem_replay.report.figures.selection import Selection, choose_object_and_run
from copem_replay.report.figures.style import find_truths
from copem_replay.results.again import replay_again
from copem_replay.results.outputs import check_output, made_file
from copem_replay.viewer.sink import short_ids
from copem_replay.viewer.status import explain_status

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LASTS_S, BEFORE_S, FRAMES_PER_S = 10.0, 2.0, 10
"""Length of a film, how long before the onset it begins, and its frames per second."""
MOST_PLANS = 6
"""Configurations side by side; more are too small for a slide."""
_SIZE_IN, _DPI = (9.6, 5.4), 100
_NEAREST_M, _FARTHEST_M = 18.0, 40.0
"""Limits of half the longer side of a plan: in a shorter one nothing else is seen, in a longer one no pedestrian."""
_MARGIN_M = 5.0
"""Room around the object and the ego at the onset."""
_INSIDE = 0.75
"""How far from the middle of a plan the object is at most, by half a side."""
_INK, _GREY, _LANE, _WALL, _HIDES = "0.15", "0.5", "0.75", "0.88", "#c8321e"
_LONGEST_NAME = 40


@dataclass(frozen=True)
class _Knowledge:
    """What a configuration believes at the frames (T,): its list (−1: none yet), words on the object, what hides it."""

    colour: tuple[float, float, float]
    tracks: FusedTracks
    list_ix: Int  # (T,)
    known: Bool  # (T,)
    words: Sequence[str]  # T
    units_m: Float  # (T, U, 2) its units; NaN: absent
    hiding_m: Float  # (T, 2, 2) from the unit to what hides the object; NaN: nothing


@dataclass(frozen=True)
class _Plot:
    """A film before it is drawn: instants (T,), how the plan lies, and what is in it."""

    replayed: ReplayedRun
    object_ix: int
    onset_s: float
    time_s: Float  # (T,) since the log's start
    turn: Float  # (2, 2), from the world to the plan
    half_m: float
    centre_m: Float  # (T, 2) of the plan
    bodies_m: Float  # (T, N, 4, 2) corners of true objects; NaN: absent
    knowledge: Mapping[str, _Knowledge]

    def place(self, points_m: Float) -> Float:
        """Points (…, 2) of the world in the plan."""
        return np.asarray(points_m @ self.turn.T)


def write_film(
    results: AnyResults,
    file: str | PathLike[str] | None = None,
    *,
    configurations: Sequence[str] | None = None,
    log: str | None = None,
    object_id: str | None = None,
    run: int | None = None,
) -> Path:
    """Write ten seconds of one object in one run as a GIF, and return its path.

    A plan for each of up to six configurations shows what it believes, and says whether the object is known, or why
    not. `file`: None: `film.gif` in the results folder. `configurations`: None: four, from worst to best. `log`,
    `object_id`, `run` as in `single_runs`. The recording is replayed again.

    Raises InputError for what is not among the results and for more configurations, RecordingError where the recording
    is gone or has changed, OutputError where the file is not writable.

    >>> cr.write_film("out/tc016d", "film.gif", configurations=["PEM", "coPEM:0s"]).name
    'film.gif'
    """
    read = take_results(results)
    path = read.require_folder() / "film.gif" if file is None else Path(file)
    check_film(path, configurations)
    choice = choose_object_and_run(read, Selection(configurations, log, object_id, run))
    replayed, rows = replay_again(read, choice.log, choice.run, read.experiment.configurations)
    table = first_episodes(rows)
    read.check_unchanged()
    every = configuration_colours(read.experiment.configurations, find_truths(read), "light", choice.configurations)
    colours = {name: every[name] for name in choice.configurations}
    return draw_film(path, replayed, table, choice.object_id, colours, read.place)


def check_film(path: Path, configurations: Sequence[str] | None) -> None:
    """Raises InputError for a name that is no GIF, and for more configurations than fit, OutputError."""
    if path.suffix.lower() != ".gif":
        raise InputError(f"{path}: expected a name that ends with .gif")
    check_output(path)
    if (asked := len(set(configurations or ()))) > MOST_PLANS:
        raise InputError(f"configurations: expected at most {MOST_PLANS} in a film, found {asked}")


def draw_film(
    path: Path, replayed: ReplayedRun, table: pd.DataFrame, object_id: str, colours: Mapping[str, Rgb], folder: Path
) -> Path:
    """Write the film of an object, and return its path. Raises OutputError, ExperimentError where the log is too long.

    `table`: the first episodes in its log and run; `colours`: those of the configurations that are shown; `folder`:
    that of the results, which lists what is made of them.
    """
    from matplotlib.animation import PillowWriter

    plot = _prepare_plot(replayed, table, object_id, colours)
    with _plain_style(), made_file(path, folder) as scratch:
        figure = _new_figure()
        writer = PillowWriter(fps=FRAMES_PER_S)
        with writer.saving(figure, str(scratch), _DPI):
            for _ in _draw_frames(figure, plot):
                writer.grab_frame()
    return path


def _arrange_plans(plans: int) -> tuple[int, int, Float]:
    """Rows and columns of plans, and the sides (2,) of each by the longer one."""
    columns = plans if plans <= 3 else math.ceil(plans / 2)
    rows = math.ceil(plans / columns)
    sides_in = np.array([_SIZE_IN[0] / columns, (0.84 * _SIZE_IN[1] - _bars_in(plans)) / rows - 0.4 * (rows > 1)])
    return rows, columns, sides_in / sides_in.max()


def _bars_in(plans: int) -> float:
    """Height of the bars below the plans, inches."""
    return 0.55 + 0.17 * plans


def choose_instants(onset_s: float, end_s: float) -> Float:
    """The instants (T,) of a film of a log that ends at `end_s`: from two seconds before the onset, ten seconds long.
    Near the end of the log it begins earlier, and in a shorter log it is shorter. The onset is one of the instants.
    """
    begin_s = max(0.0, min(onset_s - BEFORE_S, end_s - LASTS_S))
    begin_s = onset_s - math.floor((onset_s - begin_s) * FRAMES_PER_S + 1e-6) / FRAMES_PER_S
    count = math.floor(min(LASTS_S, end_s - begin_s) * FRAMES_PER_S + 1e-6)
    return begin_s + np.arange(max(count, 1)) / FRAMES_PER_S


# What the film shows.


def _prepare_plot(replayed: ReplayedRun, table: pd.DataFrame, object_id: str, colours: Mapping[str, Rgb]) -> _Plot:
    """What all frames of the film share: instants, the plan's turn and size, bodies, and what is known."""
    replay, experiment = replayed.replay, replayed.experiment
    scene, object_ix = replay.scene, replay.scene.object_number[object_id]
    onset_s = float(table.loc[table["object_id"] == object_id, "onset_s"].iloc[0])
    time_s = choose_instants(onset_s, scene.end_s)
    all_objects = np.arange(len(scene.object_ids))
    states, present = interpolate_states(
        replay.truth, np.tile(all_objects, len(time_s)), np.repeat(time_s, len(all_objects)),
        t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s,
    )  # fmt: skip
    grid = (len(time_s), len(all_objects))
    centre_m = np.stack([states["x_m"], states["y_m"]], axis=-1).reshape(*grid, 2)
    corners_m = rectangle_corners(*(states[name] for name in ("x_m", "y_m", "yaw_rad", "length_m", "width_m")))
    corners_m[~present] = np.nan
    *_, sides = _arrange_plans(len(colours))
    yaw_rad, ego_offset_m = 0.0, np.zeros(2)
    if scene.ego_ix >= 0:
        at_onset = int(np.argmin(np.abs(time_s - onset_s)))
        yaw_rad = float(np.nan_to_num(states["yaw_rad"].reshape(grid)[at_onset, scene.ego_ix]))
        ego_offset_m = np.nan_to_num(centre_m[at_onset, scene.ego_ix] - centre_m[at_onset, object_ix])
    yaw_rad -= math.pi / 2 if sides[1] > sides[0] else 0.0
    turn = np.array([[math.cos(yaw_rad), math.sin(yaw_rad)], [-math.sin(yaw_rad), math.cos(yaw_rad)]])
    half_m = float(np.clip(((np.abs(turn @ ego_offset_m) / 2 + _MARGIN_M) / sides).max(), _NEAREST_M, _FARTHEST_M))
    beside_m = np.clip(turn @ ego_offset_m / 2, -_INSIDE * half_m * sides, _INSIDE * half_m * sides)
    followed_m = _hold_ends(centre_m[:, object_ix] @ turn.T) + beside_m
    knowledge = _collect_knowledge(replayed, table, object_ix, colours, time_s)
    bodies_m = corners_m.reshape(*grid, 4, 2) @ turn.T
    return _Plot(replayed, object_ix, onset_s, time_s, turn, half_m, followed_m, bodies_m, knowledge)


def _hold_ends(places_m: Float) -> Float:
    """Places (T, 2) where all are known: those of an absent object are its nearest ones in time."""
    known = np.flatnonzero(np.isfinite(places_m).all(axis=1))
    if not len(known):
        return np.zeros_like(places_m)
    instants = np.arange(len(places_m))
    return np.stack([np.interp(instants, known, places_m[known, axis]) for axis in range(2)], axis=-1)


def _collect_knowledge(
    replayed: ReplayedRun, table: pd.DataFrame, object_ix: int, colours: Mapping[str, Rgb], time_s: Float
) -> dict[str, _Knowledge]:
    """By configuration what it has of the object at each instant: lists, whether known, words, units, what hides it."""
    replay, experiment = replayed.replay, replayed.experiment
    sight = compute_sight(replay, experiment, [object_ix], replay.rows_of(np.array([object_ix])))
    run_tracks = replayed.run_tracks.whole()
    time_ns, knowledge = to_nanoseconds(time_s), {}
    for name, colour in colours.items():
        clock, tracks = read_episode_clocks(replay.scene, table, name), run_tracks[name]
        statuses = compute_status(replay, experiment, name, tracks, sight, clock)
        rows = np.searchsorted(statuses.elapsed_ns, time_ns + SAME_INSTANT_NS, side="right") - 1
        status = np.where(rows >= 0, statuses.status[rows, 0], ABSENT)
        red, green, blue = (channel / 255 for channel in colour)
        knowledge[name] = _Knowledge(
            (red, green, blue),
            tracks,
            np.searchsorted(elapsed_ns(tracks.fused), time_ns + SAME_INSTANT_NS, side="right") - 1,
            status == KNOWN,
            _choose_words(replayed, sight, statuses, clock, rows, status),
            _find_units(replayed, name, replay.scene.t0_ns + time_ns),
            _find_hiding_lines(sight, statuses, rows, status),
        )
    return knowledge


def _find_units(replayed: ReplayedRun, name: str, stamps_ns: Int) -> Float:
    """(T, U, 2) places (m) of a configuration's units as of their newest lists; NaN: no list yet, or absent."""
    experiment, placed = replayed.experiment, replayed.replay.placed
    configuration = experiment.configurations[name]
    unit_names = [] if configuration.units == TRUTH else experiment.units_of(configuration)
    units = [unit for unit in unit_names if len(placed.stamps_ns.get(unit, ()))]
    places_m = np.full((len(stamps_ns), len(units), 2), np.nan)
    for u, unit in enumerate(units):
        newest = np.searchsorted(placed.stamps_ns[unit], stamps_ns, side="right") - 1
        is_there = (newest >= 0) & placed.poses[unit].present[newest]
        for axis, column in enumerate((placed.poses[unit].x_m, placed.poses[unit].y_m)):
            places_m[is_there, u, axis] = column[newest[is_there]]
    return places_m


def _choose_words(
    replayed: ReplayedRun, sight: Sight, statuses: Status, clock: EpisodeClocks, rows: Int, status: Int
) -> list[str]:
    """(T,) the words at the object at rows of its statuses: “behind 41”, “known after 0.60 s”."""
    scene, object_ix = replayed.replay.scene, int(sight.object_ix[0])
    onset_ns, known_ns = int(clock.onset_ns[object_ix]), int(clock.known_ns[object_ix])
    column = np.zeros(len(rows), dtype=np.int64)
    reasons = explain_status(scene, replayed.experiment, sight, statuses, rows, column)
    after_s = (known_ns - onset_ns) * 1e-9 if NEVER_NS not in (known_ns, onset_ns) else 0.0
    words = {
        ABSENT: "absent",
        KNOWN: f"known after {after_s:.2f} s" if after_s > 0 else "known at once",
    }
    name = short_ids(scene)[object_ix]
    labels = reasons.labels.to_pylist()
    return [words.get(s, label.removeprefix(f"{name} ")) for s, label in zip(status.tolist(), labels, strict=True)]


def _find_hiding_lines(sight: Sight, statuses: Status, rows: Int, status: Int) -> Float:
    """(T, 2, 2) from the unit that sees most of a hidden object to the body that hides it; NaN: it is not hidden."""
    lines = np.full((len(rows), 2, 2), np.nan)
    hidden = np.flatnonzero(status == HIDDEN)
    unit, frame = statuses.unit_ix[rows[hidden], 0], statuses.frame[rows[hidden]]
    lines[hidden, 0], lines[hidden, 1] = sight.place_m[unit, frame, :2], sight.body_m[unit, frame, 0, :2]
    return lines


# How it is drawn.


def _plain_style() -> Any:
    """Matplotlib's own settings, whatever the user's are; a name may hold a dollar sign."""
    import matplotlib

    return matplotlib.rc_context(
        {**matplotlib.rcParamsDefault, "font.family": ["DejaVu Sans"], "text.parse_math": False}
    )


def _new_figure() -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_IN, dpi=_DPI)
    FigureCanvasAgg(figure)
    return figure


def _draw_frames(figure: Figure, plot: _Plot) -> Iterator[None]:
    """Draw frame after frame into the figure; yields once each is complete."""
    names = list(plot.knowledge)
    rows, columns, _ = _arrange_plans(len(names))
    bottom = _bars_in(len(names)) / _SIZE_IN[1]
    grid = figure.add_gridspec(
        rows, columns, left=0.012, right=0.988, top=0.84, bottom=bottom, wspace=0.03, hspace=0.36 if rows > 1 else 0
    )
    panels = [_Panel(figure.add_subplot(grid[k // columns, k % columns]), plot, name) for k, name in enumerate(names)]
    title = figure.text(0.5, 0.975, "", ha="center", va="top", fontsize=12, color=_INK)
    bars = _KnownBars(figure.add_axes((0.16, 0.36 / _SIZE_IN[1], 0.82, bottom - 0.5 / _SIZE_IN[1])), plot)
    scene = plot.replayed.replay.scene
    object_words = f"{CLASSES[int(scene.object_class[plot.object_ix])]} {short_ids(scene)[plot.object_ix]}"
    for frame, time_s in enumerate((plot.time_s - plot.onset_s).tolist()):
        time_words = f"{time_s:.1f} s after it counts" if time_s > -1e-6 else f"{-time_s:.1f} s before it counts"
        title.set_text(f"{object_words}, {time_words.replace('-0.0', '0.0')}")
        for panel in panels:
            panel.show(frame)
        bars.show(frame)
        yield


class _Panel:
    """The plan of one configuration."""

    def __init__(self, axes: Axes, plot: _Plot, name: str) -> None:
        from matplotlib.collections import LineCollection, PolyCollection

        self._axes, self._plot, self._knowledge = axes, plot, plot.knowledge[name]
        colour = self._knowledge.colour
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set_color(_LANE)
        box = axes.get_position()
        sides_in = np.array([box.width * _SIZE_IN[0], box.height * _SIZE_IN[1]])
        self._half_m = plot.half_m * sides_in / sides_in.max()
        replay = plot.replayed.replay
        static = replay.placed.static
        walls = [plot.place(part) for part in np.split(static.xy_m, static.start[1:-1])] if len(static.body) else []
        lanes = [plot.place(line[:, :2]) for line in replay.lane_boundaries]
        axes.add_collection(PolyCollection(walls, facecolor=_WALL, edgecolor="none"), autolim=False)
        axes.add_collection(LineCollection(lanes, colors=_LANE, linewidths=0.8), autolim=False)
        edge = tuple(0.6 * channel for channel in colour)
        self._fused = PolyCollection([], facecolor=(*colour, 0.55), edgecolor=edge, linewidths=1.0)
        self._truth = PolyCollection([], facecolor="none", edgecolor=_GREY, linewidths=0.8)
        self._ego = PolyCollection([], facecolor=_INK, edgecolor=_INK, linewidths=0.8)
        for collection in (self._ego, self._fused, self._truth):
            axes.add_collection(collection, autolim=False)
        (self._hiding,) = axes.plot([], [], color=_HIDES, linewidth=1.2, zorder=3)
        (self._ring,) = axes.plot([], [], "o", markersize=20, markerfacecolor="none", zorder=4)
        shown = name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"
        (self._units,) = axes.plot([], [], "o", markersize=3, color=_INK, zorder=3)
        corner: dict[str, Any] = {"xy": (0, 1), "xycoords": "axes fraction", "textcoords": "offset points"}
        axes.annotate(shown, xytext=(0, 17), weight="bold", color=_INK, fontsize=10, **corner)
        self._word = axes.annotate("", xytext=(0, 4), fontsize=9.5, **corner)
        scale = 10.0 / (2 * self._half_m[0])
        axes.plot([0.97 - scale, 0.97], [0.04, 0.04], transform=axes.transAxes, color=_GREY, linewidth=1.5)
        axes.text(0.97 - scale / 2, 0.055, "10 m", transform=axes.transAxes, ha="center", fontsize=7, color=_GREY)

    def show(self, frame: int) -> None:
        """Draw frame number `frame` into the panel."""
        plot, knowledge, ego_ix = self._plot, self._knowledge, self._plot.replayed.replay.scene.ego_ix
        x, y = plot.centre_m[frame].tolist()
        self._axes.set_xlim(x - self._half_m[0], x + self._half_m[0])
        self._axes.set_ylim(y - self._half_m[1], y + self._half_m[1])
        bodies = plot.bodies_m[frame]
        is_there = np.isfinite(bodies).all(axis=(1, 2))
        self._truth.set_verts(list(bodies[is_there]))
        self._ego.set_verts(list(bodies[ego_ix : ego_ix + 1][is_there[ego_ix : ego_ix + 1]]) if ego_ix >= 0 else [])
        self._fused.set_verts(list(self._fused_boxes(frame)))
        self._hiding.set_data(*plot.place(knowledge.hiding_m[frame]).T)
        self._ring.set_data(*bodies[plot.object_ix].mean(axis=0)[:, None])
        self._units.set_data(*plot.place(knowledge.units_m[frame]).T)
        colour = _HIDES if plot.time_s[frame] > plot.onset_s - 1e-6 and not knowledge.known[frame] else _INK
        self._ring.set_markeredgecolor(colour)
        self._word.set_text(knowledge.words[frame])
        self._word.set_color(colour)

    def _fused_boxes(self, frame: int) -> Float:
        """Corners (K, 4, 2) of what the configuration's newest list holds."""
        at, tracks = int(self._knowledge.list_ix[frame]), self._knowledge.tracks
        rows = np.array(tracks.listed(at) if at >= 0 else [], dtype=np.int64)
        names = ("x_m", "y_m", "yaw_rad", "length_m", "width_m")
        return self._plot.place(rectangle_corners(*(getattr(tracks.fused, name)[0, rows] for name in names)))


class _KnownBars:
    """A bar per configuration that grows while the object is known, over seconds since the onset."""

    def __init__(self, axes: Axes, plot: _Plot) -> None:
        from matplotlib.collections import PolyCollection

        self._plot, self._since_s = plot, plot.time_s - plot.onset_s
        names = list(plot.knowledge)
        axes.set_xlim(self._since_s[0], self._since_s[-1] + 1 / FRAMES_PER_S)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_yticks(range(len(names)), [name if len(name) <= 20 else f"{name[:19]}…" for name in names], fontsize=8)
        axes.tick_params(labelsize=8, length=0, colors=_INK)
        axes.set_xlabel("seconds since it counts", fontsize=8, labelpad=1, color=_INK)
        for side in ("top", "right", "left"):
            axes.spines[side].set_visible(False)
        axes.axvline(0.0, color=_INK, linewidth=1.0, linestyle=(0, (2, 2)))
        self._cursor = axes.axvline(self._since_s[0], color=_INK, linewidth=1.0)
        self._bars = [PolyCollection([], facecolor=of.colour, edgecolor="none") for of in plot.knowledge.values()]
        for bar in self._bars:
            axes.add_collection(bar, autolim=False)

    def show(self, frame: int) -> None:
        """Draw the bars up to a frame."""
        step_s = 1 / FRAMES_PER_S
        self._cursor.set_xdata([self._since_s[frame]] * 2)
        for k, (bar, of) in enumerate(zip(self._bars, self._plot.knowledge.values(), strict=True)):
            begins = self._since_s[: frame + 1][of.known[: frame + 1]].tolist()
            bar.set_verts([[(s, k - 0.3), (s + step_s, k - 0.3), (s + step_s, k + 0.3), (s, k + 0.3)] for s in begins])
