"""Folders to write in: locked as long as their process lives, with a list of what is in them.

`.NAME.xxxxxxxx.tmp` beside NAME. When its process is killed it stays, its lock free; what its list names is then
removed by `remove_leftovers`, and only that: docs/develop/decisions/0020-results-folder.md.
"""

from __future__ import annotations

import errno
import fcntl
import filecmp
import hashlib
import json
import os
import re
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

MANIFEST = "files.json"
OLD = "old"
"""In a scratch folder: what was under the final name, where folders cannot be exchanged in one step."""
_RANDOM = r"\.[a-z0-9_]{8}\.tmp"
_TEMPORARY = re.compile(r"\..+" + _RANDOM, re.DOTALL)
_LONGEST = 200
"""Bytes of a name that the names made of it keep, so that there is room for more (a name has 255 at most)."""


def try_lock(fd: int) -> bool | None:
    """Whether the lock of an open file is now this process's. None: the file system has no locks."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:  # EACCES is how SMB says that it is held
        return False if error.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    return True


def hidden(name: str) -> str:
    """`.NAME`, the beginning of what stands beside NAME for a time; of a very long name its start and its digest."""
    encoded = os.fsencode(name)
    if len(encoded) <= _LONGEST:
        return f".{name}"
    return f".{os.fsdecode(encoded[:100])}~{hashlib.sha256(encoded).hexdigest()[:16]}"


def is_scratch(folder: Path) -> bool:
    """Whether a folder is one to write in, of this process, of another, or of one that was killed."""
    return _TEMPORARY.fullmatch(folder.name) is not None and os.path.lexists(folder / MANIFEST)


@dataclass(frozen=True)
class Scratch:
    """A folder to write in. `fd`: its list, open and locked."""

    path: Path
    fd: int

    def will_hold(self, files: Iterable[str], same: Mapping[str, str] | None = None) -> None:
        """Say what is going to be in it: before it is, so that a killed process leaves nothing unknown.

        `files`: names in it that may be removed. `same`: names that may be removed if they are
        equal to a file beside the scratch folder.
        """
        self._say({"files": sorted(files), "same": same or {}})

    def add(self, files: Iterable[str] = (), same: Mapping[str, str] | None = None) -> None:
        """More of what is going to be in it."""
        known, known_same = _listed(self.path)
        self.will_hold(known.union(files), known_same | dict(same or {}))

    def _say(self, what: object) -> None:
        data = json.dumps(what).encode()
        os.pwrite(self.fd, data, 0)
        os.ftruncate(self.fd, len(data))


@contextmanager
def scratch_for(path: Path, place: Path | None = None) -> Iterator[Scratch]:
    """A folder to write what is to become `path`, beside it or in `place`, that goes in the end. Raises OSError."""
    scratch = _made(place or path.parent, hidden(path.name))
    try:
        yield scratch
    finally:
        with suppress(OSError):
            _remove(scratch.path)
        os.close(scratch.fd)


def _made(place: Path, prefix: str) -> Scratch:
    while True:
        path = Path(tempfile.mkdtemp(dir=place, prefix=f"{prefix}.", suffix=".tmp"))
        try:
            fd = os.open(path / MANIFEST, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        except FileNotFoundError:  # taken for a leftover before it had its lock
            continue
        if try_lock(fd) is not False and (path / MANIFEST).exists():
            return Scratch(path, fd)
        os.close(fd)


def remove_leftovers(path: Path, place: Path | None = None) -> list[str]:
    """Remove what killed processes left of `path` beside it, or in `place`. Returns what has to be said of it.

    A folder that one of them had moved away, to put another in its place, gets its name back.
    """
    notes = []
    pattern = re.compile(re.escape(hidden(path.name)) + _RANDOM, re.DOTALL)
    with suppress(OSError):
        found = sorted(each for each in (place or path.parent).iterdir() if pattern.fullmatch(each.name))
        for each in found:
            with suppress(OSError):
                notes += _removed(each, path)
    return notes


def _removed(left: Path, path: Path) -> list[str]:
    """Remove one folder that may have been left. Raises OSError."""
    if left.is_symlink() or not left.is_dir():
        return []
    notes = []
    with _lock_of(left) as free:
        if not free:
            return []
        if (left / OLD).is_dir() and not os.path.lexists(path):
            os.rename(left / OLD, path)
            notes.append(f"{path}: put back, as a run was killed that was about to replace it")
        if _remove(left):
            return [*notes, f"{left}: removed, left by a process that was killed"]
    return [*notes, f"{left}: left by a process that was killed, and not removed: it holds what is not ours"]


@contextmanager
def _lock_of(scratch: Path) -> Iterator[bool]:
    """Hold the lock of a scratch folder, if it is free. One that has none yet is free."""
    try:
        fd = os.open(scratch / MANIFEST, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        yield True
        return
    try:
        yield try_lock(fd) is True
    finally:
        os.close(fd)


def _remove(scratch: Path) -> bool:
    """Remove of a scratch folder what its list names; whether nothing is left. Raises OSError."""
    if not os.path.lexists(scratch / MANIFEST):  # killed before it had a list, or about to get one
        with suppress(OSError):
            scratch.rmdir()
        return not scratch.exists()
    files, same = _listed(scratch)

    def cleared(folder: Path) -> bool:
        kept = [entry.name for entry in sorted(os.scandir(folder), key=lambda entry: entry.name) if not gone(entry)]
        return kept in ([], [MANIFEST]) if folder == scratch else not kept

    def gone(entry: os.DirEntry[str]) -> bool:
        place = Path(entry.path)
        inside = place.relative_to(scratch).as_posix()
        if entry.is_dir(follow_symlinks=False):
            if is_scratch(place):  # that of a file in it
                with _lock_of(place) as free:
                    return free and _remove(place)
            if not cleared(place):
                return False
            place.rmdir()
            return True
        if inside in files or (inside in same and _equal(place, scratch.parent / same[inside])):
            place.unlink()
            return True
        return False

    if not cleared(scratch):
        return False
    (scratch / MANIFEST).unlink()
    scratch.rmdir()
    return True


def _listed(scratch: Path) -> tuple[set[str], dict[str, str]]:
    """What a scratch folder says is in it; nothing where that cannot be read."""
    try:
        data = json.loads((scratch / MANIFEST).read_bytes())
        return set(data["files"]), dict(data["same"])
    except (OSError, ValueError, KeyError, TypeError):
        return set(), {}


def _equal(one: Path, other: Path) -> bool:
    """Whether two names stand for the same: one file, equal links, or equal content."""
    if not os.path.lexists(other):
        return False
    if one.is_symlink() or other.is_symlink():
        return one.is_symlink() and other.is_symlink() and os.readlink(one) == os.readlink(other)
    if os.path.samefile(one, other):
        return True
    return one.is_file() and other.is_file() and filecmp.cmp(one, other, shallow=False)


def flush_all(folder: Path) -> None:
    """Have a folder and all that is in it on the disk. Raises OSError."""
    for place, _, names in os.walk(folder):
        for name in names:
            if stat.S_ISREG(os.lstat(file := os.path.join(place, name)).st_mode):
                flush(file)
        flush(place)


def flush(path: str | Path) -> None:
    """Have a file, or the names in a folder, on the disk. Raises OSError."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # folders of some network file systems
            raise
    finally:
        os.close(fd)
