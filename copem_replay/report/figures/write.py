"""Figures as files: PNG and SVG of each, the same bytes every time, complete under their names or not there."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from copem_replay.core.errors import OutputError, RecordingError
from copem_replay.core.scratch import flush_all, scratch_for
from copem_replay.report.figures.detection_curves import curves_figure
from copem_replay.report.figures.distances import distances_figure
from copem_replay.report.figures.selection import choose
from copem_replay.report.figures.single_runs import runs_figure
from copem_replay.report.figures.style import style
from copem_replay.report.figures.sweeps import sweeps_figure
from copem_replay.results.belongings import check_still

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results

_FIGURES = ("runs", "distances", "curves", "sweeps")
_METADATA = {
    ".png": {"Software": None},  # the version of matplotlib
    ".svg": {"Date": None, "Creator": None},
}


def write_figures(
    results: Results,
    folder: Path | None = None,
    *,
    configurations: Sequence[str] | None = None,
    log: str | None = None,
    object_id: str | None = None,
    run: int | None = None,
) -> tuple[list[Path], list[str]]:
    """Write all figures of a results folder into `folder`, by default its `figures`.

    `log`, `object_id` and `run` choose what the runs are of. Returns the files, and what has to be said: a figure that
    cannot be made is left out. Figures of ours that are there already are replaced, and go where they can no longer be
    made. Raises InputError for what is not among the results, OutputError where nothing can be written.
    """
    names = results.chosen(configurations) if configurations else None
    choose(results, configurations=names, log=log, object_id=object_id, run=run)  # refused before anything is drawn
    figures: dict[str, Callable[[], Figure]] = {
        "runs": lambda: runs_figure(results, configurations=names, log=log, object_id=object_id, run=run),
        "distances": lambda: distances_figure(results, configurations=names),
        "curves": lambda: curves_figure(results, configurations=names),
    }
    notes: list[str] = []
    if results.sweep is not None and results.sweep["configuration"].isin(results.chosen(names)).any():
        figures["sweeps"] = lambda: sweeps_figure(results, configurations=names)
    elif results.sweep is not None:  # a sweep leaves out what it does not change
        notes.append(
            f"no figure of sweeps: {results.folder}/sweep.csv has no rows of {', '.join(results.chosen(names))}"
        )
    folder = results.folder / "figures" if folder is None else folder
    with _scratch_beside(folder) as scratch:
        for name, figure in figures.items():
            try:
                drawn = figure()
                check_still(results.folder, results.seen)
                _save(drawn, scratch / name)
            except RecordingError as error:
                notes += [f"no figure of runs: {problem}" for problem in error.problems]
        made = [scratch / f"{name}{suffix}" for name in figures for suffix in sorted(_METADATA)]
        made = [path for path in made if path.exists()]
        flush_all(scratch)
        check_still(results.folder, results.seen)
        folder.mkdir(exist_ok=True)
        for path in made:
            os.replace(path, folder / path.name)
        for name in _FIGURES:  # what an earlier call made of other results
            for suffix in _METADATA:
                if not any(path.name == name + suffix for path in made):
                    (folder / (name + suffix)).unlink(missing_ok=True)
    return [folder / path.name for path in made], notes


def _save(figure: Figure, stem: Path) -> None:
    with style(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")  # of a name; drawn as a box
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # laid out once: all files show the same
        for axes in figure.axes:
            # The last bits of a layout are not the same on every call, and names within an SVG are made of them.
            left, bottom, width, height = (round(float(v), 6) for v in axes.get_position().bounds)
            axes.set_position((left, bottom, width, height))
        for suffix, metadata in _METADATA.items():
            figure.savefig(stem.with_suffix(suffix), metadata=metadata)


@contextmanager
def _scratch_beside(folder: Path) -> Iterator[Path]:
    """A folder to write in, beside or in `folder`, that goes in the end. Raises OutputError."""
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(
                f"{folder}: cannot be written: expected a folder, found a file; choose another with --out"
            )
        folder.parent.mkdir(parents=True, exist_ok=True)
        with scratch_for(folder, folder if folder.is_dir() else folder.parent) as scratch:
            scratch.will_hold(f"{name}{suffix}" for name in _FIGURES for suffix in _METADATA)
            yield scratch.path
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be written: {error.strerror or error}; choose another with --out"
        ) from error
