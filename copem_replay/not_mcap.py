"""What files are that are not what was expected, by their first bytes and their names, and what to do about it."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from copem_replay.chunks import MAGIC
from copem_replay.errors import RecordingError

CONVERT = "`ros2 bag convert` makes MCAP of it (`storage_id: mcap` in its output options)"
_UNPACKED_BY = {".xz": "xz", ".lzma": "xz", ".zst": "zstd", ".zstd": "zstd", ".gz": "gzip", ".bz2": "bzip2"}
_LFS_POINTER = b"version https://git-lfs"
_LOOKED_AT = 64
_SQLITE = b"SQLite format 3\0"


def check_magic(path: Path, file: IO[bytes]) -> None:
    """Raises RecordingError where a file does not begin as MCAP does. Leaves the file at its start."""
    start = file.read(_LOOKED_AT)
    if not start.startswith(MAGIC):
        raise other_than("an MCAP file", path, start)
    file.seek(0)


def unpacking(path: Path) -> str | None:
    """What to do with a file that is compressed as a whole, None for one that is not, by its name."""
    by = _UNPACKED_BY.get(path.suffix.lower())
    return f"compressed as a whole, which is not read; unpack it first: {by} -d {path.name}" if by else None


def other_than(expected: str, path: Path, start: bytes) -> RecordingError:
    """The error that says what a file is instead of what was expected, by its first 64 bytes."""
    return RecordingError(f"{path}: {_what(expected, path, start)}")


def _what(expected: str, path: Path, start: bytes) -> str:
    if not start:
        return "the file is empty"
    if start.startswith(_LFS_POINTER):
        return "a git-lfs pointer, not the recording itself (`git lfs pull` fetches it)"
    if start.startswith(_SQLITE):
        return f"a SQLite file, which is not read; of a rosbag2 folder, {CONVERT}"
    if how := unpacking(path):
        return how
    if path.suffix.lower() in (".txt", ".txth"):
        return "text, which is not read; OSI traces are read as .osi (messages in binary) or .mcap"
    if path.name == "metadata.yaml":
        return "the description of a rosbag2 folder; give the folder it is in"
    return f"expected {expected}, found one that starts with {start[:16]!r}"
