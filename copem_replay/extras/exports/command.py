"""`copem-replay export`: results in formats of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from copem_replay.cli.terminal import ResultsFolder, print_blocks, print_notes
from copem_replay.core.errors import InputError


def export(
    folder: ResultsFolder,
    geojson: Annotated[
        bool, typer.Option("--geojson", help="Units, paths of objects, lanes and houses, for maps of cities.")
    ] = False,
    trackeval: Annotated[
        bool, typer.Option("--trackeval", help="Truth and what is held, as MOTChallenge files for TrackEval.")
    ] = False,
    nuscenes: Annotated[
        bool, typer.Option("--nuscenes", help="Truth and what is held, as nuScenes tracking results.")
    ] = False,
    run: Annotated[int | None, typer.Option(metavar="N", help="Run that is tracked [as in replay.mcap].")] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the files [FOLDER/geojson, …/trackeval, …/nuscenes].")
    ] = None,
) -> int:
    """Write results in formats of other tools. GeoJSON has longitudes and latitudes: only of logs whose place on earth
    is known (`frame`).
    """
    from copem_replay.extras.exports.geojson import write_geojson
    from copem_replay.extras.exports.track_files import write_nuscenes, write_trackeval

    if geojson + trackeval + nuscenes != 1:
        found = "none" if geojson + trackeval + nuscenes == 0 else "several"
        raise InputError(f"export: expected one format, --geojson, --trackeval or --nuscenes, found {found}")
    if geojson and run is not None:
        raise InputError("--run: expected --trackeval or --nuscenes with it, found --geojson")
    if geojson:
        files, notes = write_geojson(folder, out)
    else:
        files, notes = (write_trackeval if trackeval else write_nuscenes)(folder, out, run=run)
    print_notes(notes)
    print_blocks([[str(file) for file in files]])
    return 0
