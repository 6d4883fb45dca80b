"""`copem-replay fit`: fit a perception error model to the recorded lists of a unit."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from copem_replay.cli.terminal import ExperimentFile, print_blocks, print_line, print_notes, print_problems, split_names


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
        typer.Option(metavar="KIND", help="partial: lists may have objects that the truth lacks; complete: not."),
    ] = None,
    by: Annotated[
        str | None,
        typer.Option(metavar="A,B,…", help="What detection may depend on: range, visible_share, class, azimuth [all]."),
    ] = None,
    simplest: Annotated[bool, typer.Option("--simplest", help="Take the simplest of the candidate models.")] = False,
    not_monotone: Annotated[
        bool, typer.Option("--not-monotone", help="Detection may improve with range and occlusion.")
    ] = False,
    delay_by: Annotated[
        str | None,
        typer.Option(
            "--delay-by",
            metavar="KIND",
            help="log: each log has its own delay; class: logs of one class have that of the class [one for all].",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Folder of the fit [out/<experiment>_fit].")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the fit in the folder.")] = False,
) -> int:
    """Fit a perception error model to recorded lists.

    Every number comes with an interval, or with the reason why the data cannot determine it. The exit code is 1 if the
    fitted model fails its replay check, or a page cannot be written.
    """
    from copem_replay.experiment.file import read_experiment_file
    from copem_replay.extras.fitting.api import check_fit_options, fit_study, read_study_to_fit
    from copem_replay.extras.fitting.page import PEM, fill_fit, table_lines
    from copem_replay.results.folder import EXPERIMENT, check_inputs, take_place

    options = check_fit_options(hold_out or (), folds, truth, split_names(by), not not_monotone, simplest, delay_by)
    with take_place(out or Path("out") / f"{experiment.stem}_fit", overwrite=overwrite) as place:
        print_notes(place.notes)
        place.notes.clear()
        study = read_study_to_fit(read_experiment_file(experiment), unit)
        check_inputs(place, [experiment, *(path for recording in study.recordings for path in recording.paths)])
        fitted = fit_study(study, unit, options)
        fill_fit(place, fitted.found, fitted.experiment, fitted.recordings)
        print_notes([*place.notes, *fitted.notes])
        print_problems(place.failed)
        print_blocks([table_lines(fitted.found)])
        print_line(f"the model is in {place.shown / PEM}")
    print_line(f"next: copem-replay run {shlex.quote(str(place.shown / EXPERIMENT))}")
    return 1 if place.failed or (fitted.found.checks is not None and fitted.found.checks.fails) else 0
