"""Arguments and options that several commands have, each declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

ExperimentFile: TypeAlias = Annotated[Path, typer.Argument(metavar="EXPERIMENT", help="Experiment file (YAML).")]
ResultsFolder: TypeAlias = Annotated[Path, typer.Argument(metavar="FOLDER", help="Results folder.")]
LogFiles: TypeAlias = Annotated[
    list[Path], typer.Argument(metavar="LOG", help="Recordings: MCAP files, rosbag2 folders, .osi files.")
]
Logs: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--log", metavar="FILE", help="Use this recording instead of those in the experiment."),
]
Ego: TypeAlias = Annotated[str | None, typer.Option("--ego", metavar="ID", help="Id of the ego vehicle.")]
FromS: TypeAlias = Annotated[
    float | None,
    typer.Option("--from", metavar="SECONDS", help="Start of the window to read, since the log's start [0]."),
]
ToS: TypeAlias = Annotated[
    float | None,
    typer.Option("--to", metavar="SECONDS", help="End of the window to read, since the log's start [its end]."),
]
OneDrive: TypeAlias = Annotated[
    bool, typer.Option("--together", help="The recordings are of one drive: estimate their clock offsets.")
]
Baseline: TypeAlias = Annotated[
    str | None, typer.Option("--baseline", metavar="NAME", help="Configuration to compare with [the one named ideal].")
]


def listed(names: str | None) -> list[str] | None:
    """The names in a list with commas; None: none is given."""
    return None if names is None else [name.strip() for name in names.split(",")]
