"""Figures as files: PNG and SVG of each, the same bytes every time, complete under their names or not there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from copem_replay.core.errors import RecordingError
from copem_replay.core.files import atomic_files
from copem_replay.report.figures.registry import FIGURES
from copem_replay.report.figures.render import METADATA, rendered
from copem_replay.report.figures.selection import Selection, choose
from copem_replay.results.belongings import check_still, list_made

if TYPE_CHECKING:
    from copem_replay.results.read import Results


def write_figures(results: Results, folder: Path | None, selection: Selection) -> tuple[list[Path], list[str]]:
    """Write all figures of a results folder into `folder`, by default its `figures`.

    Returns the files, and what has to be said: a figure that cannot be made is left out. Figures of this package that
    are there already are replaced, and go where they can no longer be made. Raises InputError for what is not among the
    results, OutputError where nothing can be written.
    """
    choice = choose(results, selection)  # refused before anything is drawn
    selection = replace(selection, log=choice.log, object_id=choice.object_id, run=choice.run)
    folder = results.folder / "figures" if folder is None else folder
    notes: list[str] = []
    files: list[str] = []
    every = [f"{name}{suffix}" for name in FIGURES for suffix in METADATA]
    with atomic_files(folder, every, way_out="; choose another with --out") as scratch:
        for name, kind in FIGURES.items():
            why = kind.missing(results, selection)
            if why is not None:
                notes += [f"no figure of {name}: {why}"] * bool(why)
                continue
            try:
                content = rendered(kind.draw(results, selection))
            except RecordingError as error:
                notes += [f"no figure of {name}: {problem}" for problem in error.problems]
                continue
            check_still(results.folder, results.seen)
            for suffix, data in content.items():
                (scratch / f"{name}{suffix}").write_bytes(data)
                files.append(f"{name}{suffix}")
        check_still(results.folder, results.seen)
        list_made(results.folder, [folder / file for file in files])
    return [folder / file for file in files], notes
