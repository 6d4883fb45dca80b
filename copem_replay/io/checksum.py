"""What tells whether a recording is still the one that was replayed."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Self

from copem_replay.core.errors import RecordingError
from copem_replay.io.containers.rosbag2_metadata import METADATA, files_of
from copem_replay.io.log import open_file
from copem_replay.io.together import Local, Together


class FileStamp(NamedTuple):
    """What changes with a file's content. `path`: as it was given; `file`: where it leads.

    `cp -p`, `rsync -t` and `tar` set `mtime_ns`. No program sets `ctime_ns`, the time of the last change of anything,
    and a file that takes another's name has a number of its own.
    """

    path: Path
    file: str
    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int

    @classmethod
    def of(cls, path: Path) -> Self:
        """Raises RecordingError: there is no such file."""
        try:
            stat = os.stat(path)
        except OSError as error:
            raise RecordingError(f"cannot be opened: {error.strerror}", path=path) from None
        return cls(path, os.path.realpath(path), stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino)


Stamps = tuple[FileStamp, ...]
"""Of all files of a recording."""


def sha256_of(at: Local) -> str:
    """Of a file; of a folder of rosbag2, or of several recordings, of the files one after the other, as `cat` has them.

    Raises RecordingError: it cannot be read, or the folder is none of rosbag2.
    """
    digest = hashlib.sha256()
    for path in _paths(at):
        for place in files_of(path) if path.is_dir() else [path]:
            with open_file(place) as file:
                hashlib.file_digest(file, lambda: digest)  # type: ignore[arg-type]  # it has `readinto`
    return digest.hexdigest()


def stamps_of(at: Local) -> Stamps:
    """What changes with the content of a recording, without reading it.

    Raises RecordingError: a file is not there, or the folder is none of rosbag2.
    """
    return tuple(FileStamp.of(file) for path in _paths(at) for file in _parts(path))


def check_unchanged(stamps: Stamps) -> None:
    """Raise RecordingError where the files of a recording are no longer as they were when these stamps were taken."""
    for before in stamps:
        now = FileStamp.of(before.path)
        if now != before:
            sizes = f"{before.size} bytes then, {now.size} now"
            found = sizes if now.size != before.size else "of the same size, but written or replaced since"
            what = f"it has changed since it began to be read ({found})"
            raise RecordingError(f"{what}; wait until nothing writes it, then read it again", path=before.path)


def _paths(at: Local) -> tuple[Path, ...]:
    return at.paths if isinstance(at, Together) else (at,)


def _parts(path: Path) -> Iterator[Path]:
    """The files of one recording: itself, or a folder's description and what it names."""
    if path.is_dir():
        yield from files_of(path)
        yield path / METADATA
    else:
        yield path
