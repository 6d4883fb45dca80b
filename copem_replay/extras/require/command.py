"""`copem-replay require`: for which values of a key a criterion holds."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from copem_replay.cli.run import Pieces
from copem_replay.cli.terminal import (
    ExperimentFile,
    print_answer,
    print_line,
    print_rows,
    show_progress,
    width_of,
)


def require(
    experiment: ExperimentFile,
    criterion: Annotated[str, typer.Option("--criterion", metavar="NAME", help="Which criterion has to hold.")],
    free: Annotated[
        list[str],
        typer.Option(metavar="KEY", help="Key that is sought, or two: path, or path=FROM:TO:STEP [what is usual]."),
    ],
    criteria: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Criteria, a file with this key [those of the experiment].")
    ] = None,
    want: Annotated[
        list[str] | None,
        typer.Option(metavar="WHICH", help="Wanted value of each key: largest or smallest [as the verdicts say]."),
    ] = None,
    pieces: Pieces = None,
    jobs: Annotated[
        int | None, typer.Option(metavar="N", min=1, max=1024, help="Number of workers [one per core].")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Folder [out/<experiment>_require].")] = None,
) -> int:
    """Find the value of a key from which a criterion holds.

    The largest latency, loss or error, the smallest probability, range, rate or share that are enough: one key, or two
    as a front. Exit code 1 where no value that was tried passes.
    """
    from copem_replay.extras.require import outputs
    from copem_replay.extras.require.api import require as find

    needed = show_progress(
        "searching",
        lambda progress: find(
            experiment, criterion=criterion, free=free, criteria=criteria, want=want or (), jobs=jobs, pieces=pieces,
            progress=progress,
        ),
    )  # fmt: skip
    print_rows([*outputs.describe_criterion(needed), "", *outputs.tabulate_requirement(needed, width_of(sys.stdout))])
    written = outputs.write_requirement(needed, out or Path("out") / f"{experiment.stem}_require")
    print_line(f"{', '.join(path.name for path in written)} in {written[0].parent}")
    print_answer(list(outputs.tell_requirement(needed)))
    return 0 if needed.required is not None else 1
