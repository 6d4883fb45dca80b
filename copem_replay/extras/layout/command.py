"""`copem-replay layout`: layouts of a replay for Foxglove and Lichtblick."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from copem_replay.cli.terminal import print_line, split_names
from copem_replay.core.errors import InputError


def layout(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Results folder, or a replay.mcap.")],
    configurations: Annotated[
        str | None, typer.Option("--compare", metavar="A,B,…", help="Show these over each other, and each alone.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Name of the layout [beside each replay, as .foxglove.json].")
    ] = None,
) -> int:
    """Write a layout of a replay, for Foxglove and Lichtblick.

    It shows the configurations side by side over the truth, with linked cameras, and when each knows an object.
    """
    from copem_replay.extras.layout.layout import build_layout, list_replays
    from copem_replay.results.folder import MARK
    from copem_replay.results.outputs import made_file

    replays = list_replays(folder)
    if out is not None and len(replays) > 1:
        raise InputError(f"--out: expected one replay, found {len(replays)} of several logs; name one: {replays[0]}")
    layouts = [build_layout(replay, split_names(configurations) or ()) for replay in replays]
    for replay, foxglove_layout in zip(replays, layouts, strict=True):
        path = out or replay.with_suffix(".foxglove.json")
        results_folder = next((place for place in replay.absolute().parents if (place / MARK).is_file()), replay.parent)
        with made_file(path, results_folder) as scratch:
            scratch.write_text(json.dumps(foxglove_layout, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print_line(f"layout in {path}")
    return 0
