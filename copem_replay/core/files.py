"""Files that are complete under their name, or not there: they are written in a scratch folder and then moved.

What is read again of them is JSON, and may be damaged or a stranger's: `parse_json`.

A scratch folder is `.NAME.xxxxxxxx.tmp` beside NAME, locked as long as its process lives, with a list of what is in it.
When its process is killed it stays, its lock free; `remove_leftovers` then removes what its list names, and only that:
docs/develop/decisions/0020-results-folder.md.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import stat
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from copem_replay.core.errors import OutputError

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

IS_WINDOWS = os.name == "nt"
"""Where open files cannot be removed, and folders cannot be flushed."""
NO_LINK = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
"""Flags to open a file as it is: no link is followed, no pipe waited for; those that the system has."""
_LOCKED_BYTE = 1 << 30
"""The byte of a file that is locked on Windows: far behind its content, which others could not read otherwise."""

MANIFEST = "files.json"
"""In a scratch folder: its list, and its lock."""
OLD = "old"
"""In a scratch folder: what was under the final name, where folders cannot be exchanged in one step."""
_NEW = "new"
"""In a scratch folder of several files: the folder that is exchanged."""
_RANDOM = r"\.[a-z0-9_]{8}\.tmp"
_TEMPORARY = re.compile(r"\..+" + _RANDOM, re.DOTALL)
_LONGEST = 200
"""Bytes of the longest name that the names made of it keep whole: a name has 255 at most, and they are longer."""


DEEPEST_JSON = 64
"""Most values within values of what is read as JSON: what is written has ten."""


def parse_json(text: bytes | str) -> Any:
    """The value of a JSON text. Raises ValueError: no JSON, or nested deeper than anything that is written."""
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError("values within values without end") from None
    inner = [value]
    for _ in range(DEEPEST_JSON):
        inner = [
            v for of in inner for v in (of.values() if isinstance(of, dict) else of if isinstance(of, list) else ())
            if isinstance(v, dict | list)
        ]  # fmt: skip
        if not inner:
            return value
    raise ValueError(f"more than {DEEPEST_JSON} values within values")


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """The path to write `path` at: it gets its name when all went well, and is removed when anything did not.

    Missing folders are made. Raises OutputError when it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with make_scratch_folder(path) as scratch:
            scratch.will_hold([path.name])
            yield scratch.path / path.name
            flush_file(scratch.path / path.name)
            os.replace(scratch.path / path.name, path)
            flush_file(path.parent)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


@contextmanager
def atomic_files(folder: Path, names: Sequence[str], *, way_out: str = "") -> Iterator[Path]:
    """A folder to write files of these names in. They replace those in `folder` when all went well, and none before.

    The folder is exchanged with the new one in one step, its other files linked into it. Where it cannot be (it has
    folders in it, belongs to another user, is a mount point or a process's working folder, or cannot have links), its
    files are replaced one by one. A name that is not written in the end goes from `folder`, too. Missing folders are
    made. `way_out`: the end of the message where nothing can be written. Raises OutputError.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: cannot be written: expected a folder, found a file{way_out}")
        place = Path(os.path.realpath(folder))  # what a link leads to is replaced, not the link
        place.parent.mkdir(parents=True, exist_ok=True)
        beside = not place.exists() or os.access(place.parent, os.W_OK | os.X_OK)
        with make_scratch_folder(place, place.parent if beside else place) as scratch:
            scratch.will_hold(f"{_NEW}/{name}" for name in names)
            new = scratch.path / _NEW
            new.mkdir()
            yield new
            flush_all(new)
            if not (beside and _replace_folder(scratch, place, names)):
                _replace_each(new, place, names)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}{way_out}") from error


def _replace_folder(scratch: ScratchFolder, folder: Path, names: Sequence[str]) -> bool:
    """Put the new folder in the place of `folder`, with its files of other names; False where it cannot be."""
    new, old = scratch.path / _NEW, scratch.path / OLD
    if not folder.exists():
        os.rename(new, folder)
        flush_file(folder.parent)
        return True
    others = {entry.name for entry in os.scandir(folder)}.difference(names)
    scratch.will_hold(f"{at}/{name}" for at in (_NEW, OLD) for name in names)
    try:
        state, here = folder.stat(), Path.cwd()
        if os.path.ismount(folder) or folder in (here, *here.parents) or state.st_uid != new.stat().st_uid:
            return False
        for name in others:
            os.link(folder / name, new / name, follow_symlinks=False)
        new.chmod(stat.S_IMODE(state.st_mode))
    except OSError:  # a folder among them, or a file system without links
        return False
    flush_file(new)
    if exchange_folders(new, folder):
        old = new
    else:
        exchange_in_two_steps(new, folder, old)
    flush_file(folder.parent)
    for late in [entry for entry in os.scandir(old) if entry.name not in others.union(names)]:
        with suppress(OSError):
            os.rename(late.path, folder / late.name)
    return True


def _replace_each(new: Path, folder: Path, names: Sequence[str]) -> None:
    folder.mkdir(exist_ok=True)
    for name in names:
        if (new / name).exists():
            os.replace(new / name, folder / name)
        else:
            (folder / name).unlink(missing_ok=True)


# The exchange of two names in one step, where the system has it (Linux, most of its file systems).

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # fcntl.h, linux/fs.h
_CANNOT = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM)
"""Errors of an old kernel, of a file system without the exchange, and of containers that refuse unknown calls."""


def exchange_folders(first: Path, second: Path) -> bool:
    """Exchange two names of one file system by renameat2(2); neither is missing at any instant. Raises OSError.

    False: the system has no such exchange.
    """
    import ctypes

    function = None if IS_WINDOWS else getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if function is None:
        return False
    if function(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(second), ctypes.c_uint(_RENAME_EXCHANGE)) == 0:
        return True
    code = ctypes.get_errno()
    if code in _CANNOT:
        return False
    raise OSError(code, os.strerror(code), str(second))


def exchange_in_two_steps(new: Path, name: Path, old: Path) -> None:
    """Move the folder `name` to `old` and `new` to `name`. A process killed between: `remove_leftovers` repairs it."""
    os.rename(name, old)
    try:
        os.rename(new, name)
    except BaseException:
        with suppress(OSError):
            os.rename(old, name)
        raise


def try_lock(fd: int) -> bool | None:
    """Whether the lock of an open file is now this process's. None: the system, or the file system, has no locks."""
    if fcntl is None:
        return _try_lock_byte(fd)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:  # EACCES is how SMB says that it is held
        return False if error.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    return True


def _try_lock_byte(fd: int) -> bool | None:
    """`try_lock` on Windows."""
    try:
        import msvcrt
    except ImportError:
        return None
    os.lseek(fd, _LOCKED_BYTE, os.SEEK_SET)
    try:
        msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined, unused-ignore]
    except OSError as error:
        return False if error.errno in (errno.EACCES, errno.EDEADLOCK) else None
    return True


def overwrite_file(fd: int, content: bytes) -> None:
    """Make this the content of an open file. Raises OSError."""
    os.lseek(fd, 0, os.SEEK_SET)
    os.write(fd, content)
    os.ftruncate(fd, len(content))


_REFUSED = re.compile(r'[<>:"\\|?*%\x00-\x1f]|[. ]$')
_DEVICES = re.compile(r"(con|prn|aux|nul|(com|lpt)[0-9¹²³])(\..*)?", re.IGNORECASE | re.DOTALL)


def portable_name(name: str) -> str:
    """The path of a file called by any name, as every system takes it: `a:b` is `a%3Ab`, and `aux` is `%61ux`.

    Characters, ends and names of devices that Windows refuses are written as in URLs; `/` divides folders.
    """
    return "/".join(avoid_device_name(_REFUSED.sub(_encode, part)) for part in name.split("/"))


def avoid_device_name(name: str) -> str:
    """The name of a file, its first character as in URLs where Windows takes the name for that of a device."""
    return f"%{ord(name[0]):02X}{name[1:]}" if _DEVICES.fullmatch(name) else name


def _encode(found: re.Match[str]) -> str:
    return f"%{ord(found[0]):02X}"


def hidden_name(name: str) -> str:
    """`.NAME`, the beginning of names of temporary files beside NAME; of a very long name its start and its digest."""
    encoded = os.fsencode(name)
    if len(encoded) <= _LONGEST:
        return f".{name}"
    return f".{os.fsdecode(encoded[:100])}~{hashlib.sha256(encoded).hexdigest()[:16]}"


def is_scratch(folder: Path) -> bool:
    """Whether a folder is a scratch folder, of this process, of another, or of one that was killed."""
    return _TEMPORARY.fullmatch(folder.name) is not None and os.path.lexists(folder / MANIFEST)


def find_scratch_names(folder: Path) -> list[str]:
    """Names of all scratch folders in a folder, in order; none where it cannot be read."""
    with suppress(OSError):
        return sorted(name for name in os.listdir(folder) if _TEMPORARY.fullmatch(name))
    return []


@dataclass(frozen=True)
class ScratchFolder:
    """A scratch folder. `fd`: its list, open and locked."""

    path: Path
    fd: int

    def will_hold(self, files: Iterable[str]) -> None:
        """Note the names of files in it that may be removed, before they are there: so a killed process leaves nothing
        unknown. Beside these, links to files of the folder that it replaces may be removed.
        """
        overwrite_file(self.fd, json.dumps({"files": sorted(files)}).encode())


@contextmanager
def make_scratch_folder(path: Path, place: Path | None = None) -> Iterator[ScratchFolder]:
    """A scratch folder for what is to become `path`, beside it or in `place`; removed in the end. Raises OSError."""
    scratch = _create_scratch(place or path.parent, hidden_name(path.name))
    try:
        yield scratch
    finally:
        if IS_WINDOWS:
            os.close(scratch.fd)
        with suppress(OSError):
            _remove_listed(scratch.path, path)
        if not IS_WINDOWS:  # locked until all is gone
            os.close(scratch.fd)


def _create_scratch(place: Path, prefix: str) -> ScratchFolder:
    while True:
        path = Path(tempfile.mkdtemp(dir=place, prefix=f"{prefix}.", suffix=".tmp"))
        try:
            fd = os.open(path / MANIFEST, os.O_RDWR | os.O_CREAT | os.O_EXCL | NO_LINK, 0o600)
        except FileNotFoundError:  # taken for a leftover before it had its lock
            continue
        if try_lock(fd) is not False and (path / MANIFEST).exists():
            return ScratchFolder(path, fd)
        os.close(fd)


def remove_leftovers(path: Path, place: Path | None = None) -> list[str]:
    """Remove what killed processes left of `path` beside it, or in `place`. Returns notes for the user.

    A folder that one of them had moved away, to put another in its place, gets its name back.
    """
    notes = []
    pattern = re.compile(re.escape(hidden_name(path.name)) + _RANDOM, re.DOTALL)
    with suppress(OSError):
        leftovers = sorted(each for each in (place or path.parent).iterdir() if pattern.fullmatch(each.name))
        for leftover in leftovers:
            with suppress(OSError):
                notes += _remove_leftover(leftover, path)
    return notes


def _remove_leftover(left: Path, path: Path) -> list[str]:
    """Remove one folder that may have been left; returns notes for the user. Raises OSError."""
    if left.is_symlink() or not left.is_dir():
        return []
    notes = []
    with _hold_lock(left) as free:
        if not free:
            return []
        if (left / OLD).is_dir() and not os.path.lexists(path):
            os.rename(left / OLD, path)
            notes.append(f"{path}: put back, as a run was killed that was about to replace it")
        if _remove_listed(left, path):
            return [*notes, f"{left}: removed, left by a process that was killed"]
    return [*notes, f"{left}: left by a process that was killed, and not removed: it holds what is not ours"]


@contextmanager
def _hold_lock(scratch: Path) -> Iterator[bool]:
    """Hold the lock of a scratch folder, if it is free. One that has none yet is free."""
    try:
        fd = os.open(scratch / MANIFEST, os.O_RDWR | NO_LINK)
    except FileNotFoundError:
        yield True
        return
    free = try_lock(fd) is True
    if IS_WINDOWS:
        os.close(fd)
    try:
        yield free
    finally:
        if not IS_WINDOWS:
            os.close(fd)


def _remove_listed(scratch: Path, path: Path | None = None) -> bool:
    """Remove what the list of a scratch folder names, and links to files in `path`; True where nothing is left.

    Raises OSError.
    """
    if not os.path.lexists(scratch / MANIFEST):  # killed before it had a list, or about to get one
        with suppress(OSError):
            scratch.rmdir()
        return not scratch.exists()
    files = _read_scratch_list(scratch)

    def cleared(folder: Path) -> bool:
        kept = [entry.name for entry in sorted(os.scandir(folder), key=lambda entry: entry.name) if not gone(entry)]
        return kept in ([], [MANIFEST]) if folder == scratch else not kept

    def gone(entry: os.DirEntry[str]) -> bool:
        place = Path(entry.path)
        inside = place.relative_to(scratch).as_posix()
        if entry.is_dir(follow_symlinks=False):
            if is_scratch(place):  # that of a file in it
                with _hold_lock(place) as free:
                    return free and _remove_listed(place)
            if not cleared(place):
                return False
            place.rmdir()
            return True
        if inside in files or (path is not None and is_hard_link(place, path / inside.partition("/")[2])):
            place.unlink()
            return True
        return False

    if not cleared(scratch):
        return False
    (scratch / MANIFEST).unlink()
    scratch.rmdir()
    return True


def _read_scratch_list(scratch: Path) -> set[str]:
    """The names in the list of a scratch folder; none where it cannot be read."""
    try:
        return set(parse_json((scratch / MANIFEST).read_bytes())["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def is_hard_link(place: Path, other: Path) -> bool:
    """Whether two names are there and of one file. Raises OSError."""
    return os.path.lexists(place) and os.path.lexists(other) and os.path.samestat(os.lstat(place), os.lstat(other))


def flush_all(folder: Path) -> None:
    """Flush a folder and all that is in it to the disk. Raises OSError."""
    for place, _, names in os.walk(folder):
        for name in names:
            if stat.S_ISREG(os.lstat(file := os.path.join(place, name)).st_mode):
                flush_file(file)
        flush_file(place)


def flush_file(path: str | Path) -> None:
    """Flush a file, or the names in a folder, to the disk. Raises OSError."""
    if IS_WINDOWS and os.path.isdir(path):
        return
    fd = os.open(path, os.O_RDWR if IS_WINDOWS else os.O_RDONLY)
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # folders of some network file systems
            raise
    finally:
        os.close(fd)
