"""The command that fits a perception error model: fit."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from copem_replay.cli.options import ExperimentFile, listed
from copem_replay.cli.terminal import complain, note, say, say_blocks


def fit(
    experiment: ExperimentFile,
    unit: Annotated[str, typer.Option(metavar="NAME", help="Unit with recorded lists.")],
    hold_out: Annotated[
        list[str] | None,
        typer.Option("--hold-out", metavar="LOG", help="Keep this log for the check. May be repeated."),
    ] = None,
    folds: Annotated[
        int | None, typer.Option(metavar="K", min=2, help="Parts of the cross-validation that chooses a model [5].")
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(metavar="KIND", help="partial: the truth may lack objects of entries; complete: it has all."),
    ] = None,
    by: Annotated[
        str, typer.Option(metavar="A,B,…", help="What detection depends on: range, visible_share, azimuth, class.")
    ] = "range,visible_share",
    simplest: Annotated[bool, typer.Option("--simplest", help="Take the simplest of the candidate models.")] = False,
    not_monotone: Annotated[
        bool, typer.Option("--not-monotone", help="Detection may improve with range and occlusion.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Folder of the fit [out/<experiment>_fit].")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the fit in the folder.")] = False,
) -> int:
    """Fit a perception error model to recorded lists.

    Every number comes with an interval, or with the reason why the data cannot determine it. The exit code is 1 if the
    fitted model fails its replay check, or a page cannot be written.
    """
    from copem_replay.cli.api.fit import fill, fitted, how_of, study_to_fit
    from copem_replay.experiment.file import load
    from copem_replay.results.fit_files import PEM, table_lines
    from copem_replay.results.place import EXPERIMENT, check_inputs, taken

    how = how_of(hold_out or (), folds, truth, listed(by) or (), not not_monotone, simplest)
    with taken(out or Path("out") / f"{experiment.stem}_fit", overwrite=overwrite) as place:
        note(place.notes)
        place.notes.clear()
        study = study_to_fit(load(experiment), unit)
        check_inputs(place, [experiment, *(path for recording in study.recordings for path in recording.paths)])
        found = fitted(study, unit, how)
        fill(place, found)
        note([*place.notes, *found.notes])
        complain(place.failed)
        say_blocks([table_lines(found.found)])
        say(f"the model is in {place.shown / PEM}")
    say(f"next: copem-replay run {shlex.quote(str(place.shown / EXPERIMENT))}")
    unlike = found.found.checks is not None and found.found.checks.fails
    return 1 if unlike or place.failed else 0
