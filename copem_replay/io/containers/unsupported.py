"""What files are that are not what was expected, by their first bytes and their names, and what to do about it."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from copem_replay.core.errors import RecordingError
from copem_replay.io.containers.mcap_records import MAGIC

CONVERT = "`ros2 bag convert` makes MCAP of it (`storage_id: mcap` in its output options)"
_UNPACKED_BY = {".xz": "xz", ".lzma": "xz", ".zst": "zstd", ".zstd": "zstd", ".gz": "gzip", ".bz2": "bzip2"}
_LFS_POINTER = b"version https://git-lfs"
_LOOKED_AT = 64
_SHOWN_BYTES = 16
_CONVERTED = (".csv", ".tsv", ".json", ".xml")
_MADE = "; docs/guide/data-sets.md says what makes a recording of such files"
_ROS1 = b"#ROSBAG"
_NEWER = "`rosbags-convert --src FILE --dst FOLDER --dst-storage mcap` makes a folder of it that is"
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
    return RecordingError(_what(expected, path, start), path=path)


def _what(expected: str, path: Path, start: bytes) -> str:
    if not start:
        return "the file is empty"
    if start.startswith(_LFS_POINTER):
        return "a git-lfs pointer, not the recording itself (`git lfs pull` fetches it)"
    if start.startswith(_SQLITE):
        return f"a SQLite file, which is not read; of a rosbag2 folder, {CONVERT}"
    if start.startswith(_ROS1):
        return f"a bag of ROS 1, which is not read; {_NEWER}"
    if how := unpacking(path):
        return how
    if path.suffix.lower() in (".txt", ".txth"):
        return "text, which is not read; OSI traces are read as .osi (messages in binary) or .mcap"
    if path.name == "metadata.yaml":
        return "the description of a rosbag2 folder; give the folder it is in"
    return f"expected {expected}, found {_content(path, start)}"


def _content(path: Path, start: bytes) -> str:
    """What a file begins with that nothing is known of: its first words, or its first bytes."""
    try:
        text = start.decode("utf-8", errors="ignore" if len(start) == _LOOKED_AT else "strict")
    except UnicodeDecodeError:
        text = ""
    line = text.strip().partition("\n")[0].strip()
    whole = len(text.encode()) > len(start) - 4  # of what is cut off within a character
    if not line or not whole or not all(c.isprintable() or c in "\t\r\n" for c in text):
        return f"a file whose first bytes are {start[:_SHOWN_BYTES].hex(' ')}"
    if path.suffix.lower() in (".csv", ".tsv"):
        return f"a table with the columns {line}{_MADE}"
    return f"text that begins with {line!r}{_MADE if path.suffix.lower() in _CONVERTED else ''}"
