"""Figure of where it is late: the path of every measured object, coloured by how long it stays unknown.

A panel per configuration, all of one drive, that on which objects stay unknown longest. It needs the recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import RecordingError, RemoteFile, count_noun
from copem_replay.core.tracks import Float, Scene, Tracks
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.summary import EPISODE
from copem_replay.report.figures.selection import Selection, describe_left_out, find_differing
from copem_replay.report.figures.style import (
    FAINT,
    INK,
    add_note,
    figure_style,
    find_contenders,
    find_truths,
    new_figure,
    shorten_names,
    sort_soonest_first,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


# A drive as plans need it.


@dataclass(frozen=True)
class Drive:
    """The truth of one log, what stands in it, and who has to be named beside a plan of it."""

    log: str
    experiment: Experiment
    scene: Scene
    truth: Tracks
    lanes_m: tuple[Float, ...] = ()  # borders (K, 3)
    credits: tuple[str, ...] = ()

    def path(self, object_ix: int) -> tuple[Float, Float]:
        """Instants (K,) in seconds since the log's start, and places (K, 2) in metres, of an object; NaN in gaps."""
        rows = np.flatnonzero((self.truth.row_object_ix == object_ix) & self.truth.valid[0])
        time_s, at_m = self.truth.row_captured_s[rows], np.stack([self.truth.x_m[0, rows], self.truth.y_m[0, rows]], 1)
        gaps = np.flatnonzero(np.diff(time_s) > self.experiment.max_gap_s) + 1
        return np.insert(time_s, gaps, time_s[gaps - 1]), np.insert(at_m, gaps, np.nan, axis=0)

    def outlines(self) -> Iterator[Float]:
        """Corners (K, 2) of what stands there and hides: obstacles of the experiment, solids of the log."""
        yield from (np.array(one.polygon_m) for one in self.experiment.obstacles)
        yield from (np.array(solid.corners_m) for solid in self.scene.solids)

    def lanes_within(self, west_m: float, east_m: float, south_m: float, north_m: float) -> list[Float]:
        """Borders of lanes (K, 2) that reach into a box."""
        borders = (line[:, :2] for line in self.lanes_m)
        low, high = (west_m, south_m), (east_m, north_m)
        return [line for line in borders if (line.max(axis=0) >= low).all() and (line.min(axis=0) <= high).all()]

    def fixed_units(self) -> dict[str, tuple[float, float]]:
        """Places of the fixed units."""
        return {name: unit.at for name, unit in self.experiment.modelled.items() if unit.at is not None}


def read_drive(results: Results, log: str) -> Drive:
    """A drive of the results. Raises RecordingError where its recording is missing, another one, or elsewhere."""
    place = results.log_place(log)
    if isinstance(place, RemoteFile):
        raise RecordingError("plans need the recording on this machine", path=place)
    experiment = resolve_for_log(results.experiment, log)
    recording = results.recording(log, experiment)
    credits = dict.fromkeys(note[note.index("©") :] for note in recording.notes if "©" in note)
    return Drive(log, experiment, recording.scene, recording.truth, recording.lane_boundaries, tuple(credits))


def find_latest_log(results: Results) -> str:
    """The log whose objects stay unknown longest on average, over all contenders."""
    rows = average_unknown(results, find_contenders(results))
    return str(rows["unknown_s"].groupby(rows["log"], sort=False).mean().idxmax())


def average_unknown(results: Results, names: Sequence[str]) -> pd.DataFrame:
    """A row per configuration and episode: mean `unknown_s` over runs (never: to the episode's end), `never_share`."""
    rows = results.known
    rows = rows[rows["configuration"].isin(list(names))]
    never = rows["time_to_detection_s"].isna()
    unknown_s = rows["time_to_detection_s"].fillna(rows["ended_s"] - rows["onset_s"]).clip(lower=0.0)
    weighed = rows[["configuration", *EPISODE, "onset_s", "ended_s", "runs"]].assign(
        unknown_s=unknown_s * rows["runs"], never_share=never * rows["runs"]
    )
    sums = weighed.groupby(["configuration", *EPISODE, "onset_s", "ended_s"], sort=False, as_index=False).sum()
    return sums.assign(unknown_s=sums["unknown_s"] / sums["runs"], never_share=sums["never_share"] / sums["runs"])


# The figure.

_WIDTH_IN = 9.6
_COLUMNS = 3
_TALLEST, _FLATTEST = 0.8, 0.35
"""Limits of a panel's height by its width."""
_MARGIN_M = 5.0
_GROUND = (0.992, 0.99, 0.985)
"""Ground of the panels, no grey: it stays light on a dark page, as the colours of paths need it."""
_SHADES = 24
"""Shades of the scale: so few are shapes in an SVG, more would be a picture."""
_AT_0_S = 0.55
"""Place of 0 s on the scale, which ends at 0: lighter colours have less than 3:1 to the ground."""
NEVER_FROM = 0.5
"""Share of runs from which on an object counts as never known."""


def late_paths_figure(results: Results, selection: Selection) -> Figure:
    """Every path of the measured objects of a drive: grey before the onset, then coloured by the seconds unknown. A
    panel per configuration, the soonest first. Raises RecordingError where the recording is missing.
    """
    selected = sort_soonest_first(results, find_contenders(results, selection.configurations))
    names = [name for name in selected if name in find_differing(results, selected)]
    drive = read_drive(results, selection.log or find_latest_log(results))
    rows = average_unknown(results, names)
    rows = rows[rows["log"] == drive.log]
    most_s = max(float(rows["unknown_s"].max()) if len(rows) else 0.0, 0.1)
    box = _find_box(drive, rows)
    columns = max(min(len(names), _COLUMNS), 2)
    lines = math.ceil(len(names) / columns)
    wide_in = (_WIDTH_IN - 1.0) / _COLUMNS
    tall_in = wide_in * (box[3] - box[2]) / (box[1] - box[0])
    with figure_style():
        figure = new_figure(columns * wide_in + 1.0, lines * (tall_in + 0.3) + 0.7)
        below_in = add_note(figure, _note_sentences(results, drive, rows, names, selected))
        figure.set_layout_engine("none")  # panels have a place already, which takes half of the time
        width_in, height_in = (float(size) for size in figure.get_size_inches())
        figure.set_size_inches(width_in, height_in - 0.65 + below_in)
        height_in += below_in - 0.65
        figure.texts[-1].set_y(0.06 / height_in)
        short = shorten_names(names)
        for k, name in enumerate(names):
            left_in, bottom_in = 0.1 + k % columns * wide_in, height_in - (k // columns + 1) * (tall_in + 0.3)
            place = left_in / width_in, bottom_in / height_in, (wide_in - 0.1) / width_in, tall_in / height_in
            axes = figure.add_axes(place)
            axes.set_title(short[name], loc="left", pad=3)
            _draw_ground(axes, drive, box)
            drawn = _draw_paths(axes, drive, rows[rows["configuration"] == name], most_s)
        place = 1 - 0.8 / width_in, bottom_in / height_in, 0.15 / width_in, 1 - (bottom_in + 0.3) / height_in
        figure.colorbar(drawn, cax=figure.add_axes(place)).set_label("Seconds unknown (mean over runs)")
    return figure


def no_late_paths(results: Results, names: Sequence[str]) -> str | None:
    """The reason why there is no such figure: of the truth alone nothing is late; None: there is one."""
    return None if set(names) - set(find_truths(results)) and len(results.known) else ""


def _find_box(drive: Drive, rows: pd.DataFrame) -> tuple[float, float, float, float]:
    """West, east, south and north end of the paths, with a margin."""
    numbers = {drive.scene.object_number[name] for name in rows["object_id"]}
    at_m = np.concatenate([drive.path(k)[1] for k in sorted(numbers)])
    low, high = np.nanmin(at_m, axis=0), np.nanmax(at_m, axis=0)
    least_m = 0.3 * max(float((high - low).max()), 20.0)  # of a straight way, too, the surroundings are seen
    half, middle = np.maximum(high - low, least_m) / 2 + _MARGIN_M, (high + low) / 2
    half = np.maximum(half, half[::-1] * [1 / _TALLEST, _FLATTEST])
    (west, south), (east, north) = (middle - half).tolist(), (middle + half).tolist()
    return west, east, south, north


def _draw_ground(axes: Axes, drive: Drive, box: tuple[float, float, float, float]) -> None:
    """Draw scale, lanes, what stands there, the ego's way and units' places; `box`: the four ends of the axes (m)."""
    from matplotlib.collections import LineCollection, PolyCollection

    axes.set_facecolor(_GROUND)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(*box[:2])
    axes.set_ylim(*box[2:])
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set(visible=True, color="0.75")
    long_m = next(size for size in (50, 20, 10, 5) if size <= (box[1] - box[0]) / 3 or size == 5)
    at_m = box[0] + 0.04 * (box[1] - box[0]), box[2] + 0.05 * (box[3] - box[2])
    axes.plot([at_m[0], at_m[0] + long_m], [at_m[1]] * 2, color=INK, linewidth=2, solid_capstyle="butt", label="_scale")
    axes.annotate(f"{long_m} m", at_m, (0, 3), textcoords="offset points", fontsize=7.5, color=INK)
    axes.add_collection(LineCollection(drive.lanes_within(*box), colors="0.85", linewidths=0.6, zorder=0.9))
    axes.add_collection(PolyCollection(list(drive.outlines()), facecolor="0.8", edgecolor="0.6", linewidth=0.6))
    if drive.scene.ego_ix >= 0:
        axes.plot(
            *drive.path(drive.scene.ego_ix)[1].T,
            color=FAINT,
            linewidth=1.0,
            linestyle=(0, (5, 3)),
            label="ego",
            zorder=1.5,
        )
    units = list(drive.fixed_units().values())
    axes.plot([x for x, _ in units], [y for _, y in units], "^", color=INK, markersize=5, label="units", zorder=3)


def _draw_paths(axes: Axes, drive: Drive, rows: pd.DataFrame, most_s: float) -> Any:
    """Draw the paths of episodes, the latest on top, `most_s` darkest. Returns the lines that have the colours."""
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection
    from matplotlib.colors import ListedColormap, Normalize

    before, unknown, after, times_s, never = [], [], [], [], []
    for row in rows.sort_values("unknown_s", kind="stable").itertuples(index=False):
        time_s, at_m = drive.path(drive.scene.object_number[row.object_id])
        known_s = row.onset_s + row.unknown_s
        before.append(at_m[time_s <= row.onset_s])
        unknown.append(at_m[(time_s >= row.onset_s) & (time_s <= max(known_s, row.onset_s + 0.2))])
        after.append(at_m[(time_s >= known_s) & (time_s <= row.ended_s)])
        times_s.append(row.unknown_s)
        if row.never_share >= NEVER_FROM:
            never.append(at_m[(time_s <= row.ended_s) & ~np.isnan(at_m[:, 0])][-1:])
    axes.add_collection(LineCollection(before, colors="0.72", linewidths=1.0, zorder=1.6))
    coloured: dict[str, Any] = {
        "cmap": ListedColormap(colormaps["viridis"](np.linspace(_AT_0_S, 0.0, _SHADES))),
        "norm": Normalize(0, most_s),
        "array": np.array(times_s),
    }
    axes.add_collection(LineCollection(after, linewidths=0.9, zorder=1.8, **coloured))
    drawn = axes.add_collection(LineCollection(unknown, linewidths=3.0, zorder=2.0, capstyle="round", **coloured))
    if never:
        axes.plot(*np.concatenate(never).T, "X", color="#b3261e", markersize=6, label="never", zorder=3)
    return drawn


def _note_sentences(
    results: Results, drive: Drive, rows: pd.DataFrame, names: Sequence[str], selected: Sequence[str]
) -> list[str]:
    """The sentences below the figure: which drive, what lines and marks mean, and whose map it is."""
    logs, runs = len(results.provenance.logs), results.experiment.runs
    drive_words = f"{drive.log}, the drive of {logs} on which objects stay unknown longest" if logs > 1 else drive.log
    never = (
        f"; ✕: never known in {100 * NEVER_FROM:.0f} % of the {runs} runs or more" if runs > 1 else "; ✕: never known"
    )
    north = ", north is up" if drive.scene.frame is not None and not drive.scene.frame.yaw_rad else ""
    return [
        f"{drive_words}: {count_noun(rows['object_id'].nunique(), 'measured object')}{north}",
        "Grey: before it counts; thick: unknown from then on; thin: afterwards, in the colour of the time that it "
        f"took; darker is later{never}",
        *(["Dashed: the way of the ego"] if drive.scene.ego_ix >= 0 else []),
        *(["Triangles: fixed units"] if drive.fixed_units() else []),
        *(f"Map: {line}" for line in drive.credits),
        describe_left_out(selected, names),
    ]
