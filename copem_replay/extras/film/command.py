"""`copem-replay film`: ten seconds of an object as a GIF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from copem_replay.cli.terminal import ResultsFolder, print_line, split_names


def film(
    folder: ResultsFolder,
    object: Annotated[str | None, typer.Option(metavar="ID", help="Object to follow [the first in conflict].")] = None,
    configurations: Annotated[
        str | None, typer.Option(metavar="A,B,…", help="Only these, six at most [four, from worst to best].")
    ] = None,
    run: Annotated[int | None, typer.Option(metavar="N", help="Run to show [as in replay.rrd].")] = None,
    log: Annotated[str | None, typer.Option(metavar="NAME", help="Log to show [the first].")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Name of the film [FOLDER/film.gif].")] = None,
) -> int:
    """Write ten seconds of an object as a GIF, for slides. Plans side by side show what configurations believe, and say
    whether the object is known, or why it is not.
    """
    from copem_replay.extras.film.film import write_film

    names = split_names(configurations)
    path = write_film(folder, out, configurations=names, log=log, object_id=object, run=run)
    print_line(f"film in {path}")
    return 0
