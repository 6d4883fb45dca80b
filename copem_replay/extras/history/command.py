"""`copem-replay history`: verdicts of many results folders on one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from copem_replay.cli.terminal import print_line


def history(
    folders: Annotated[list[Path], typer.Argument(metavar="FOLDER", help="Results folders, the oldest first.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Name of the page.")] = Path("history.html"),
) -> int:
    """Write the verdicts of many results folders, as one HTML file.

    Each criterion is a strip of verdicts, and its figure with its interval.
    """
    from copem_replay.extras.history.history import write_history

    path = write_history(folders, out)
    print_line(f"history in {path}")
    return 0
