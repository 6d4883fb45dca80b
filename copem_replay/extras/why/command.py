"""`copem-replay why`: why objects are known late, by replays on the same draws without something."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from copem_replay.cli.terminal import (
    ExperimentFile,
    print_blocks,
    print_line,
    print_notes,
    print_rows,
    show_progress,
    split_names,
    width_of,
)


def why(
    experiment: ExperimentFile,
    configuration: Annotated[
        list[str] | None,
        typer.Option("--configuration", metavar="NAME", help="Only this one. May be repeated [all with units]."),
    ] = None,
    causes: Annotated[bool, typer.Option("--causes", help="Seconds by cause.")] = False,
    units: Annotated[bool, typer.Option("--units", help="Seconds that each unit spares.")] = False,
    triage: Annotated[bool, typer.Option("--triage", help="Late episodes in groups.")] = False,
    sensitivity: Annotated[bool, typer.Option("--sensitivity", help="How much the order hangs on the PEMs.")] = False,
    unit: Annotated[
        str | None, typer.Option(metavar="A,B,…", help="Units whose worth is asked for [all but the ego's].")
    ] = None,
    explain: Annotated[bool, typer.Option("--explain", help="Every figure, and what it means.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Folder of the tables [out/<experiment>_why, FOLDER/why]."),
    ] = None,
) -> int:
    """Explain lateness: causes, worth of units, triage, sensitivity.

    Each is a replay on the same draws without something. Without any of the four, all are computed, and what fits a
    screen is said. Of a results folder the tables are put into it, and its report shows them.
    """
    from copem_replay.extras.why.api import PARTS
    from copem_replay.extras.why.api import why as compute
    from copem_replay.extras.why.screen import tell_explanation
    from copem_replay.results.read import open_results

    folder = out or Path("out") / f"{experiment.stem}_why"
    if experiment.is_dir():
        folder = out or experiment / "why"
    chosen_parts = [part for part, on in zip(PARTS, (causes, units, triage, sensitivity), strict=True) if on]
    if chosen_parts and unit is not None and "units" not in chosen_parts:
        chosen_parts.append("units")
    answer = show_progress(
        "explaining",
        lambda progress: compute(
            experiment,
            configurations=configuration,
            parts=chosen_parts or None,
            units=split_names(unit),
            progress=progress,
        ),
    )
    full = explain or bool(chosen_parts)
    print_notes(answer.notes if full or configuration else [note for note in answer.notes if ": of " in note])
    paths = answer.save(folder)
    place, one_log = str(experiment) if experiment.is_dir() else "FOLDER", False
    if experiment.is_dir():
        one_log = len(open_results(experiment).provenance.logs) == 1
    if full:
        print_blocks(list(answer.blocks(width_of(sys.stdout))))
    else:
        print_rows(tell_explanation(answer, place, one_log=one_log))
    print_line(f"{', '.join(path.name for path in paths)} in {folder}{'' if full else '; every figure: --explain'}")
    return 0
