"""The command samples: what README and tutorial run, for an installation without the repository."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated, Final

import typer

from copem_replay.cli.terminal import say
from copem_replay.core.errors import InputError
from copem_replay.core.files import atomic_files

_SAMPLES: Final = Path(__file__).with_name("sample_logs")


def samples(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to write to.")] = Path("logs"),
) -> int:
    """Write the sample recordings and experiments into a folder.

    The paper's scenario (tc016d) and a busy crossing. No file is replaced.
    """
    names = sorted(path.name for path in _SAMPLES.iterdir())
    if there := [name for name in names if (folder / name).exists()]:
        raise InputError(f"{folder / there[0]}: expected no such file, found one; samples FOLDER names another folder")
    with atomic_files(folder, names) as scratch:
        for name in names:
            shutil.copyfile(_SAMPLES / name, scratch / name)
    say(f"{len(names)} files in {folder}")
    say(f"next: copem-replay run {folder / 'tc016d.yaml'}")
    return 0
