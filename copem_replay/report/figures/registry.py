"""Registry of all figures: `plot` writes those that can be drawn, the report embeds those that need no recording.

Another figure is added with `FIGURES["name"] = FigureKind(…)`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from copem_replay.core.errors import RecordingError
from copem_replay.report.figures.answer import answer_figure
from copem_replay.report.figures.detection_curves import curves_figure
from copem_replay.report.figures.differences import differences_figure, no_differences
from copem_replay.report.figures.distances import distances_about, distances_figure
from copem_replay.report.figures.false_positives import false_positives_figure, no_false_positives
from copem_replay.report.figures.latency_breakdown import latency_breakdown_figure, no_stages
from copem_replay.report.figures.paths import late_paths_figure, no_late_paths
from copem_replay.report.figures.selection import Selection, choose_object_and_run
from copem_replay.report.figures.slices import slices_figure
from copem_replay.report.figures.style import METADATA, check_summary, render_figure
from copem_replay.report.figures.sweeps import sweeps_figure
from copem_replay.report.figures.trade_off import no_trade_off, trade_off_figure
from copem_replay.results.outputs import made_files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


def _nothing_missing(results: Results, selection: Selection) -> str | None:
    return None


@dataclass(frozen=True)
class FigureKind:
    """A figure. `title`: its heading in the report. `shows`: what it shows, for readers who cannot see it.

    `draw` makes it (`new_figure` within `figure_style()`); where it needs a recording that is missing, it raises
    RecordingError. `missing`: the reason why the results have no such figure, "" for a reason that need not be
    given, None if they have one. `about`: paragraphs above it in the report.
    """

    title: str
    shows: str
    draw: Callable[[Results, Selection], Figure]
    missing: Callable[[Results, Selection], str | None] = _nothing_missing
    about: Callable[[Results], Sequence[str]] = lambda results: ()


def _draw_runs(results: Results, selection: Selection) -> Figure:
    from copem_replay.report.figures.single_runs import runs_figure

    return runs_figure(results, selection)


def _no_differences(results: Results, selection: Selection) -> str | None:
    reason = no_differences(results, results.chosen(selection.configurations), selection.differences)
    return None if reason is None else ""


def _no_sweep(results: Results, selection: Selection) -> str | None:
    names = results.chosen(selection.configurations)
    if results.sweep is None:
        return ""
    if results.sweep["configuration"].isin(names).any():
        return None
    return f"{results.place}/sweep.csv has no rows of {', '.join(names)}"


FIGURES: dict[str, FigureKind] = {
    "answer": FigureKind(
        "The answer",
        "mean time known after and share that passes, a dot with its interval per configuration, the soonest first",
        lambda results, of: answer_figure(results, configurations=of.configurations),
    ),
    "differences": FigureKind(
        "Differences",
        "each configuration minus the baseline, a dot with its interval, and the line of 0",
        lambda results, of: differences_figure(results, configurations=of.configurations, differences=of.differences),
        missing=_no_differences,
    ),
    "trade_off": FigureKind(
        "Sooner, and at what price",
        "seconds sooner than the car alone against the time braking for nothing, a mark per configuration",
        lambda results, of: trade_off_figure(results, configurations=of.configurations),
        missing=lambda results, of: no_trade_off(results, results.chosen(of.configurations)),
        about=lambda results: (
            "The driver brakes for nothing where he would have to brake for an entry of a list, and the truth gives no "
            "reason. Whoever reports more detects sooner, and makes him brake more often.",
        ),
    ),
    "false_positives": FigureKind(
        "False positives against position error",
        "false positives per minute over the position error, a mark per configuration",
        lambda results, of: false_positives_figure(results, configurations=of.configurations),
        missing=lambda results, of: no_false_positives(results, results.chosen(of.configurations)),
        about=lambda results: (
            "A false positive is an entry of a fused list at no object. A fusion that keeps more entries detects "
            "sooner, and keeps more false positives.",
        ),
    ),
    "runs": FigureKind(
        "Single runs",
        "speed of the ego, distance and visible share of one object in one run, a column per configuration",
        _draw_runs,
    ),
    "curves": FigureKind(
        "How soon",
        "share not yet known over the time since the clock started, a line per configuration",
        lambda results, of: curves_figure(results, configurations=of.configurations),
        about=lambda results: (
            "A curve gives the share of all rows (measured objects × runs × logs) that are not yet known this long "
            "after they begin to count, the lower the better: 100 % less the cumulative incidence of detection "
            "(Aalen–Johansen, departure competing). Objects that leave the scene undetected keep the curve above 0. "
            "Where lines coincide, the thinner ones are on top.",
        ),
    ),
    "late_paths": FigureKind(
        "Where it is late",
        "the path of every measured object, coloured by how long it stays unknown, a panel per configuration",
        late_paths_figure,
        missing=lambda results, of: no_late_paths(results, results.chosen(of.configurations)),
    ),
    "distances": FigureKind(
        "How far away",
        "distance at detection of every row, a strip per configuration",
        lambda results, of: distances_figure(results, configurations=of.configurations),
        about=distances_about,
    ),
    "latency_breakdown": FigureKind(
        "Where the time goes",
        "mean duration of the stages from the start of the clock to detection, a bar per configuration",
        lambda results, of: latency_breakdown_figure(results, configurations=of.configurations),
        missing=lambda results, of: no_stages(results, results.chosen(of.configurations)),
    ),
    "slices": FigureKind(
        "Which drive, which class",
        "mean time known after by group, a row per group and a column per configuration, darker is later",
        lambda results, of: slices_figure(results, of.sliced, configurations=of.configurations, linked=of.linked),
        missing=lambda results, of: "" if of.sliced is None else None,
    ),
    "sweeps": FigureKind(
        "At other values",
        "shares and times over each quantity that is swept",
        lambda results, of: sweeps_figure(results, configurations=of.configurations),
        missing=_no_sweep,
        about=lambda results: (
            "The experiment at other values of one quantity, with common random numbers per run. All numbers are in "
            "sweep.csv.",
        ),
    ),
}
"""Figures by the name of their files, in the order in which they are written."""


# Files: PNG and SVG of each figure, complete under their names or not there.


def write_figure_files(results: Results, folder: Path | None, selection: Selection) -> tuple[list[Path], list[str]]:
    """Write all figures of a results folder into `folder`, by default its `figures`.

    Returns the files, and a note per figure that cannot be made. Existing figures of these names are replaced, and
    removed if they can no longer be made. Raises InputError for a selection that is not among the results, OutputError
    if nothing can be written.
    """
    check_summary(results)
    choice = choose_object_and_run(results, selection)  # raises before anything is drawn
    selection = replace(selection, log=choice.log, object_id=choice.object_id, run=choice.run)
    folder = results.require_folder() / "figures" if folder is None else folder
    notes: list[str] = []
    files: list[str] = []
    names = [f"{name}{suffix}" for name in FIGURES for suffix in METADATA]
    with made_files(folder, names, results.place, way_out="; choose another with --out") as scratch:
        for name, kind in FIGURES.items():
            reason = kind.missing(results, selection)
            if reason is not None:
                notes += [f"no figure of {name}: {reason}"] * bool(reason)
                continue
            try:
                content = render_figure(kind.draw(results, selection))
            except RecordingError as error:
                notes += [f"no figure of {name}: {problem}" for problem in error.problems]
                continue
            results.check_unchanged()
            for suffix, data in content.items():
                (scratch / f"{name}{suffix}").write_bytes(data)
                files.append(f"{name}{suffix}")
        results.check_unchanged()
    return [folder / file for file in files], notes
