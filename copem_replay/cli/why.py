"""`copem-replay why`: why objects are known late, and whose doing it is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from copem_replay.cli.terminal import (
    ExperimentFile,
    print_blocks,
    print_line,
    print_notes,
    split_names,
    tidy_outputs,
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
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Folder of the tables [out/<experiment>_why].")
    ] = None,
) -> int:
    """Explain lateness: causes, worth of units, triage, sensitivity.

    Each is a replay on the same draws without something. Without any of the four, all are computed.
    """
    import sys

    from copem_replay.api.why import PARTS
    from copem_replay.api.why import why as explain

    asked = [part for part, on in zip(PARTS, (causes, units, triage, sensitivity), strict=True) if on]
    found = explain(experiment, configurations=configuration, parts=asked or PARTS, units=split_names(unit))
    print_notes(found.notes)
    print_blocks(list(found.blocks(width_of(sys.stdout))))
    folder = out or Path("out") / f"{experiment.stem}_why"
    written = found.save(folder)
    tidy_outputs(written)
    print_line(f"{', '.join(path.name for path in written)} in {folder}")
    return 0
