"""Files that are complete under their name, or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from copem_replay.core.errors import OutputError
from copem_replay.core.scratch import flush, scratch_for


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Where to write what is to become `path`: it gets its name when all went well, and goes when anything did not.

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
