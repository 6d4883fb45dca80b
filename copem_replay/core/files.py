"""Files and folders that are complete under their name, or not there: written beside it, and then renamed.

What is read again of them is JSON, and may be damaged or a stranger's: `parse_json`.

A file is written as `.NAME.xxxxxxxx.tmp`, a folder as `new` in a folder of that name, with a list of what may be
removed; both are locked as long as their process lives. When it is killed they stay, their lock free, and
`remove_leftovers` removes them: docs/develop/decisions/results.md.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import secrets
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
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
"""Where open files cannot be renamed or removed, and folders cannot be flushed."""
NO_LINK = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
"""Flags to open a file as it is: no link is followed, no pipe waited for; those that the system has."""
_NEW_FILE = os.O_RDWR | os.O_CREAT | os.O_EXCL | NO_LINK
_LOCKED_BYTE = 1 << 30
"""The byte of a file that is locked on Windows: far behind its content, which others could not read otherwise."""
MANIFEST = "files.json"
"""In a scratch folder: its list, and its lock."""
_RANDOM = r"\.[a-z0-9_]{8}\.tmp(\.\w{1,10})?"
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


# Names.

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


def _encode(match: re.Match[str]) -> str:
    return f"%{ord(match[0]):02X}"


def hidden_name(name: str) -> str:
    """`.NAME`, with which temporary files beside NAME begin; of a very long name, its start and its digest."""
    encoded = os.fsencode(name)
    if len(encoded) <= _LONGEST:
        return f".{name}"
    return f".{os.fsdecode(encoded[:100])}~{hashlib.sha256(encoded).hexdigest()[:16]}"


def is_temporary(name: str) -> bool:
    """Whether a file or folder has a temporary name, which it bears until it is complete."""
    return _TEMPORARY.fullmatch(name) is not None


def find_scratch_names(folder: Path) -> list[str]:
    """Names of all temporary files and scratch folders in a folder, in order; none where it cannot be read."""
    with suppress(OSError):
        return sorted(filter(is_temporary, os.listdir(folder)))
    return []


def list_names(folder: Path, prefix: str = "") -> Iterator[str]:
    """Files, links and empty folders in a folder, by names relative to it; `prefix` comes before them. Raises OSError.

    Temporary files are left out: they are of commands that run now, or were killed.
    """
    entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    if prefix and not entries:
        yield prefix.removesuffix("/")
    for entry in entries:
        if _is_unfinished(entry):
            continue
        if not entry.is_dir(follow_symlinks=False):
            yield prefix + entry.name
        elif os.path.ismount(entry.path):
            raise OutputError(f"{entry.path}: a mount point cannot be replaced; choose another folder with --out")
        else:
            yield from list_names(Path(entry.path), f"{prefix}{entry.name}/")


def _is_unfinished(entry: os.DirEntry[str]) -> bool:
    whole = entry.is_symlink() or (entry.is_dir() and not os.path.lexists(os.path.join(entry.path, MANIFEST)))
    return is_temporary(entry.name) and not whole


def check_parent(path: Path, look: Callable[[Path], object] = os.lstat) -> None:
    """Raise OutputError where `path` cannot be written, as far as its folder, present or future, shows it."""
    try:
        parent = next((place for place in Path(os.path.abspath(path)).parents if place.exists()), Path("/"))
        with suppress(FileNotFoundError, NotADirectoryError):
            look(path)
        os.fsencode(os.path.abspath(path)).decode()
    except UnicodeDecodeError:
        raise OutputError(
            f"{path}: cannot be written: expected a path in UTF-8, found other bytes; choose another with --out"
        ) from None
    except OSError as error:  # a loop of links, a name that is too long
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
    if not parent.is_dir():
        raise OutputError(f"{path}: cannot be written: {parent} is a file")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: cannot be written: no permission to write in {parent}")


def may_be_moved(folder: Path) -> bool:
    """Whether another folder may replace this one: it is no mount point, and not the working folder of this process."""
    here = Path.cwd()
    return not os.path.ismount(folder) and folder not in (here, *here.parents)


# Locks.


def try_lock(fd: int) -> bool | None:
    """Lock an open file; whether this process has the lock now. None: the system, or the file system, has no locks."""
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
    """Replace the content of an open file. Raises OSError."""
    os.lseek(fd, 0, os.SEEK_SET)
    os.write(fd, content)
    os.ftruncate(fd, len(content))


def is_still(path: Path, fd: int) -> bool:
    """Whether `name` still names this open file."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(fd), os.lstat(path))
    return False


def _create_locked(prefix: Path, suffix: str = "", *, folder: bool = False) -> tuple[Path, int]:
    """A new temporary file, or scratch folder, and the open file that locks it. Raises OSError."""
    while True:
        path = prefix.with_name(f"{prefix.name}.{secrets.token_hex(4)}.tmp{suffix}")
        try:
            if folder:
                path.mkdir(0o700)
            lock = path / MANIFEST if folder else path
            fd = os.open(lock, _NEW_FILE, 0o666)
        except (FileExistsError, FileNotFoundError):  # a name twice; or taken for a leftover before it had its lock
            if not prefix.parent.is_dir():
                raise
            continue
        if try_lock(fd) is not False and is_still(lock, fd):
            return path, fd
        os.close(fd)


# One file.


@contextmanager
def atomic_file(path: Path, *, flush: bool = True) -> Iterator[Path]:
    """The path to write `path` at: it is renamed when all went well, and removed otherwise.

    Missing folders are made. `flush`: it is on the disk before it has its name. Raises OutputError when it cannot be
    written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        suffix = path.suffix if re.fullmatch(r"\.\w{1,10}", path.suffix) else ""  # some writers go by it
        scratch, fd = _create_locked(path.with_name(hidden_name(path.name)), suffix)
        try:
            with open(fd, "rb") as lock:
                yield scratch
                if flush:
                    flush_file(scratch)
                if IS_WINDOWS:
                    lock.close()
                os.replace(scratch, path)
                if flush:
                    flush_file(path.parent)
        finally:
            scratch.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


# A folder.


@dataclass(frozen=True)
class ScratchFolder:
    """A scratch folder. `fd`: its list, open and locked."""

    path: Path
    fd: int

    @property
    def new(self) -> Path:
        """The folder to fill."""
        return self.path / "new"

    @property
    def old(self) -> Path:
        """The replaced folder, once the new one has the final name."""
        return self.path / "old"

    def may_remove(self, files: Iterable[str]) -> None:
        """List the names of files, in the new or the old folder, that may be removed, before they are there.

        So a killed process leaves nothing unknown. Beside these, links to files of the final folder may be removed.
        """
        overwrite_file(self.fd, json.dumps({"files": sorted(files)}).encode())


@contextmanager
def make_scratch_folder(path: Path, place: Path | None = None) -> Iterator[ScratchFolder]:
    """A scratch folder for the future `path`, beside it or in `place`; removed in the end. Raises OSError."""
    scratch = ScratchFolder(*_create_locked((place or path.parent) / hidden_name(path.name), folder=True))
    try:
        scratch.new.mkdir()
        yield scratch
    finally:
        if IS_WINDOWS:
            os.close(scratch.fd)
        with suppress(OSError):
            _clear(scratch.path, path)
        if not IS_WINDOWS:  # locked until all is gone
            os.close(scratch.fd)


def replace_folder(
    scratch: ScratchFolder, folder: Path, list_others: Callable[[Path], Collection[str]], old_stat: os.stat_result
) -> list[str] | None:
    """Put the new folder in the place of `folder`, with the files of it that `list_others` names: the user's own.

    They are linked into the new folder before it has its name; those that cannot be, or come meanwhile, are moved after
    that. Between two renames there is no folder of the name: of a process that is killed there, `remove_leftovers` puts
    the old one back. Returns a line for each file that stays in the scratch folder; None: nothing is replaced, because
    the folder is no longer the one `old_stat`. Raises OSError.
    """
    new, old, linked = scratch.new, scratch.old, list(list_others(folder))
    for name in linked:
        with suppress(OSError):
            _move_over(name, folder, new, lambda source, target: os.link(source, target, follow_symlinks=False))
    new.chmod(stat.S_IMODE(old_stat.st_mode))
    flush_all(new)
    os.rename(folder, old)
    try:
        if is_same := os.path.samestat(old.stat(), old_stat):
            os.rename(new, folder)
    except BaseException:
        os.rename(old, folder)
        raise
    if not is_same:
        os.rename(old, folder)
        return None
    flush_file(folder.parent)
    staying = {}
    for name in list_others(old):
        try:
            _move_over(name, old, folder, os.rename)
        except OSError as error:
            staying[name] = f"{name}: cannot be moved over ({error.strerror}); it is in {old}"
    scratch.may_remove(set(list_names(old)).difference(staying))
    return list(staying.values())


def _move_over(name: str, old: Path, new: Path, move: Callable[[Path, Path], None]) -> None:
    """Link or rename, by `move`, a file or an empty folder of `old` to the same name in `new`. Raises OSError."""
    source, target = old / name, new / name
    if os.path.lexists(target):
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir() and not source.is_symlink():
        target.mkdir()
    else:
        move(source, target)


@contextmanager
def atomic_files(folder: Path, names: Sequence[str], *, way_out: str = "") -> Iterator[Path]:
    """A folder to write files of these names in. They replace those in `folder` when all went well, and none before.

    The whole folder is replaced, with its other files. Where it cannot be (it has folders in it, belongs to another
    user, is a mount point or a process's working folder), its files are replaced one by one. A name that is not written
    in the end goes from `folder`, too, and what killed processes left of it. Missing folders are made. `way_out`: the
    end of the message where nothing can be written. Raises OutputError.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: cannot be written: expected a folder, found a file{way_out}")
        place = Path(os.path.realpath(folder))  # what a link leads to is replaced, not the link
        place.parent.mkdir(parents=True, exist_ok=True)
        beside = not place.exists() or os.access(place.parent, os.W_OK | os.X_OK)
        with make_scratch_folder(place, place.parent if beside else place) as scratch:
            scratch.may_remove(names)
            yield scratch.new
            if not place.exists():
                flush_all(scratch.new)
                os.rename(scratch.new, place)
                flush_file(place.parent)
            elif not (beside and _replace_whole(scratch, place, names)):
                flush_all(scratch.new)
                _replace_each(scratch.new, place, names)
        for where in (place.parent, place):
            remove_leftovers(place, where)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}{way_out}") from error


def _replace_whole(scratch: ScratchFolder, folder: Path, names: Sequence[str]) -> bool:
    """Replace a folder but for its files of other names; False where it cannot be."""
    seen = folder.stat()
    if not may_be_moved(folder) or seen.st_uid != scratch.new.stat().st_uid or any(map(Path.is_dir, folder.iterdir())):
        return False
    return replace_folder(scratch, folder, lambda at: set(list_names(at)).difference(names), seen) is not None


def _replace_each(new: Path, folder: Path, names: Sequence[str]) -> None:
    for name in names:
        if (new / name).exists():
            os.replace(new / name, folder / name)
        else:
            (folder / name).unlink(missing_ok=True)


# What killed processes left.


def remove_leftovers(path: Path, place: Path | None = None) -> list[str]:
    """Remove temporary files of `path` that killed processes left beside it, or in `place`. Returns notes for the user.

    A folder that one of them had moved away, to put another in its place, gets its name back.
    """
    notes = []
    pattern, place = re.compile(re.escape(hidden_name(path.name)) + _RANDOM, re.DOTALL), place or path.parent
    for name in find_scratch_names(place):
        if pattern.fullmatch(name):
            with suppress(OSError):
                notes += _remove_leftover(place / name, path)
    return notes


def _remove_leftover(leftover: Path, path: Path) -> list[str]:
    """Remove a file or folder that may have been left; returns notes for the user. Raises OSError."""
    notes = []
    with _hold_lock(leftover) as free:
        if not free:
            return []
        if (leftover / "old").is_dir() and not os.path.lexists(path):
            os.rename(leftover / "old", path)
            notes.append(f"{path}: put back, as a run was killed that was about to replace it")
        if _clear(leftover, path):
            return [*notes, f"{leftover}: removed, left by a process that was killed"]
    return [*notes, f"{leftover}: left by a process that was killed, and not removed: it holds what is not ours"]


@contextmanager
def _hold_lock(leftover: Path) -> Iterator[bool]:
    """Hold the lock of a temporary file or scratch folder, if it is free. A folder that has none yet is free."""
    is_folder = leftover.is_dir() and not leftover.is_symlink()
    try:
        fd = os.open(leftover / MANIFEST if is_folder else leftover, os.O_RDWR | NO_LINK)
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


def _clear(leftover: Path, path: Path) -> bool:
    """Remove a temporary file; of a scratch folder what its list names, links to files in `path`, and what killed
    processes left in it. True where nothing is left. Raises OSError.
    """
    if leftover.is_file():
        leftover.unlink()
        return True
    if not os.path.lexists(leftover / MANIFEST):  # killed before it had a list, or about to get one
        with suppress(OSError):
            leftover.rmdir()
        return not leftover.exists()
    listed = _read_scratch_list(leftover)
    for place, folders, files in os.walk(leftover, topdown=False):
        for item in (Path(place, name) for name in (*files, *folders)):
            relative = "/".join(item.relative_to(leftover).parts[1:])
            if item.is_dir() and not item.is_symlink():
                with suppress(OSError):
                    _remove_leftover(item, path) if os.path.lexists(item / MANIFEST) else item.rmdir()
            elif relative and (relative in listed or is_temporary(item.name) or _are_links(item, path / relative)):
                item.unlink()
    if os.listdir(leftover) == [MANIFEST]:
        (leftover / MANIFEST).unlink()
        leftover.rmdir()
    return not leftover.exists()


def _read_scratch_list(scratch: Path) -> set[str]:
    """The names in the list of a scratch folder; none where it cannot be read."""
    try:
        return set(parse_json((scratch / MANIFEST).read_bytes())["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _are_links(place: Path, other: Path) -> bool:
    """Whether two names are there and of one file. Raises OSError."""
    return os.path.lexists(other) and os.path.samestat(os.lstat(place), os.lstat(other))


def flush_all(folder: Path) -> None:
    """Flush a folder and its content to the disk. Raises OSError."""
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
