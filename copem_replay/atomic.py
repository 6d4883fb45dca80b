"""Files that are complete under their name, or not there."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from copem_replay.errors import OutputError


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Where to write what is to become `path`: it gets its name when all went well, and goes when anything did not.

    Missing folders are made. Raises OutputError when it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp") as folder:
            scratch = Path(folder) / path.name
            yield scratch
            with scratch.open("rb") as file:
                os.fsync(file.fileno())
            os.replace(scratch, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
