"""Files that are complete under their name, or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from copem_replay.core.errors import OutputError
from copem_replay.core.scratch import flush, flush_all, scratch_for


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """The path to write `path` at: it gets its name when all went well, and is removed when anything did not.

    Missing folders are made. Raises OutputError when it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with scratch_for(path) as scratch:
            scratch.will_hold([path.name])
            yield scratch.path / path.name
            flush(scratch.path / path.name)
            os.replace(scratch.path / path.name, path)
            flush(path.parent)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


@contextmanager
def atomic_files(folder: Path, names: Sequence[str], *, way_out: str = "") -> Iterator[Path]:
    """A folder to write files of these names in. They replace those in `folder` when all went well, and none before.

    A name that is not written in the end goes from `folder`, too. Missing folders are made. `way_out`: the end of the
    message where nothing can be written. Raises OutputError.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: cannot be written: expected a folder, found a file{way_out}")
        folder.parent.mkdir(parents=True, exist_ok=True)
        with scratch_for(folder, folder if folder.is_dir() else folder.parent) as scratch:
            scratch.will_hold(names)
            yield scratch.path
            flush_all(scratch.path)
            folder.mkdir(exist_ok=True)
            for name in names:
                if (scratch.path / name).exists():
                    os.replace(scratch.path / name, folder / name)
                else:
                    (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}{way_out}") from error
