"""A place that one process at a time writes to."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from copem_replay.core.errors import OutputError
from copem_replay.core.scratch import hidden, try_lock

_TRIES = 100
"""How often a lock file may go between being opened and being locked, each time because its process ended (chosen)."""


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Be the only process that writes to `folder`: `.NAME.lock` beside it is locked meanwhile, and goes in the end.

    On file systems without locks it is not. Raises OutputError where another process has the lock, OSError.
    """
    path = folder.parent / f"{hidden(folder.name)}.lock"
    fd, locked = _opened(path, folder)
    if locked:
        with suppress(OSError):
            os.pwrite(fd, (name := f"process {os.getpid()} on {platform.node()}\n").encode(), 0)
            os.ftruncate(fd, len(name.encode()))
    try:
        yield
    finally:
        if locked:  # while it is locked: what waits for it would lock a file that has no name
            with suppress(OSError):
                path.unlink()
        os.close(fd)
        if not locked:
            with suppress(OSError):
                path.unlink()


def _opened(path: Path, folder: Path) -> tuple[int, bool]:
    """The lock file, open, and whether it is locked: False where there are no locks."""
    for _ in range(_TRIES):
        fd = _open(path)
        locked = try_lock(fd)
        if locked is None or (locked and _is_still(path, fd)):
            return fd, bool(locked)
        try:
            if locked is False:
                name = os.pread(fd, 200, 0).decode(errors="replace").strip()
                raise OutputError(
                    f"{folder}: another run ({name or 'just started'}) is writing its results there; wait until it has "
                    "ended, or choose another folder with --out"
                )
        finally:
            os.close(fd)
    raise OutputError(f"{folder}: cannot be written: {path} comes and goes; choose another folder with --out")


def _open(path: Path) -> int:
    flags = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | flags, 0o666)
    except PermissionError:  # left by another user
        return os.open(path, os.O_RDONLY | flags)


def _is_still(path: Path, fd: int) -> bool:
    """Whether an open file is still the one of this name."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(fd), os.lstat(path))
    return False
