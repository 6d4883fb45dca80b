"""What tells whether a recording is still the one that was replayed."""

from __future__ import annotations

import hashlib

from copem_replay.io.containers.rosbag2_metadata import files_of
from copem_replay.io.log import open_file
from copem_replay.io.together import Local, Together


def sha256_of(at: Local) -> str:
    """Of a file; of a folder of rosbag2, or of several recordings, of the files one after the other, as `cat` has them.

    Raises RecordingError: it cannot be read, or the folder is none of rosbag2.
    """
    digest = hashlib.sha256()
    paths = at.paths if isinstance(at, Together) else (at,)
    for place in (file for path in paths for file in (files_of(path) if path.is_dir() else [path])):
        with open_file(place) as file:
            hashlib.file_digest(file, lambda: digest)  # type: ignore[arg-type]  # it has `readinto`
    return digest.hexdigest()
