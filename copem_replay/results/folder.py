"""The place of a results folder during a run: checked, locked, tidied up, and in the end exchanged with the new one.

A folder lists the files of its results in `provenance.json`, and those that commands made of them in `made.jsonl`; both
go when new results take its place, the user's own files stay. See docs/develop/decisions/0020-results-folder.md.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import stat
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from copem_replay.core.errors import CopemError, InputError, OutputError
from copem_replay.core.files import (
    IS_WINDOWS,
    NO_LINK,
    OLD,
    ScratchFolder,
    exchange_folders,
    exchange_in_two_steps,
    flush_all,
    flush_file,
    hidden_name,
    is_hard_link,
    is_scratch,
    make_scratch_folder,
    overwrite_file,
    parse_json,
    remove_leftovers,
    try_lock,
)

# The files that belong to a results folder.

MARK = "provenance.json"
MADE = "made.jsonl"
"""Lists the files that commands made of the results later, a JSON string a line.

Lines are only appended, so that two commands at a time lose none, and a half-written line is no name.
"""


@dataclass(frozen=True)
class FolderFiles:
    """The files of a results folder, by names relative to it.

    `results`: those of the results, None where the folder does not list them (an older version). `made`: those that
    commands made of the results afterwards.
    """

    results: frozenset[str] | None
    made: frozenset[str]
    every: tuple[str, ...]  # files, links, empty folders

    def others(self, written: Collection[str]) -> list[str]:
        """The user's own files. `written`: new results, which stand for those of a folder without a list."""
        ours = (self.results if self.results is not None else frozenset(written)) | self.made
        return [name for name in self.every if name not in ours]


def list_belongings(folder: Path) -> FolderFiles | None:
    """The files of a results folder; None: it is not one. Raises OSError, OutputError for a mount point in it."""
    try:
        provenance: Any = parse_json((folder / MARK).read_bytes())
    except (OSError, ValueError):
        return None
    if not isinstance(provenance, dict) or "copem_replay" not in provenance:
        return None
    listed = provenance.get("files")
    results = frozenset(map(str, listed)) if isinstance(listed, list) else None
    return FolderFiles(results, read_made_names(folder), tuple(list_names(folder)))


def read_made_names(folder: Path) -> frozenset[str]:
    """The names listed as made of the results of a folder, and that of the list itself.

    They are only compared with names of existing files, never opened: a list may hold any text.
    """
    names = {MADE}
    for line in _read_made_list(folder).splitlines():
        try:
            name = parse_json(line)
        except ValueError:
            continue
        if isinstance(name, str):
            names.add(name)
    return frozenset(names)


def add_to_made_list(folder: Path, files: Iterable[Path]) -> None:
    """List those of `files` that lie in a results folder as made of its results, with which they go.

    To be called before a file gets its name, so that a killed process leaves no unlisted file. Raises OutputError.
    """
    root = os.path.realpath(folder)
    if not os.path.isfile(os.path.join(root, MARK)):
        return
    places = [os.path.join(os.path.realpath(file.parent), file.name) for file in files]
    names = {os.path.relpath(place, root) for place in places if place.startswith(f"{root}{os.sep}")}
    if not (new := sorted(names - read_made_names(folder))):
        return
    cut_off = _read_made_list(folder)[-1:] not in (b"", b"\n")  # the last line, by a killed process
    text = "\n" * cut_off + "".join(f"{json.dumps(name)}\n" for name in new)
    try:
        fd = os.open(folder / MADE, os.O_WRONLY | os.O_CREAT | os.O_APPEND | NO_LINK, 0o666)
        try:
            os.write(fd, text.encode())
            os.fsync(fd)
        finally:
            os.close(fd)
    except OSError as error:
        raise OutputError(f"{folder / MADE}: cannot be written: {error.strerror or error}") from None


def _read_made_list(folder: Path) -> bytes:
    """The content of the list; empty where there is none, or something else in its place."""
    try:
        fd = os.open(folder / MADE, os.O_RDONLY | NO_LINK)
        with open(fd, "rb") as file:
            return file.read() if stat.S_ISREG(os.fstat(fd).st_mode) else b""
    except OSError:
        return b""


def check_unchanged(folder: Path, seen: os.stat_result) -> None:
    """Raise InputError where other results have taken the place of those that were read."""
    try:
        same = os.path.samestat(os.stat(folder), seen)
    except OSError:
        same = False
    if not same:
        raise InputError(f"{folder}: other results took its place while it was read; run the command again")


def list_names(folder: Path, at: str = "") -> Iterator[str]:
    """Files, links and empty folders in a folder, by names relative to it; `at` comes before them. Raises OSError."""
    entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    if at and not entries:
        yield at.removesuffix("/")
    for entry in entries:
        if not entry.is_dir(follow_symlinks=False):
            yield at + entry.name
        elif os.path.ismount(entry.path):
            raise OutputError(f"{entry.path}: a mount point cannot be replaced; choose another folder with --out")
        elif not is_scratch(Path(entry.path)):  # a figure that is being written, or was when its process was killed
            yield from list_names(Path(entry.path), f"{at}{entry.name}/")


def _make_folder(folder: Path, old: Path, new: Path) -> None:
    """Make a folder below `new` and those above it, with the modes of those below `old`. Raises OSError."""
    if not folder.exists():
        _make_folder(folder.parent, old, new)
        folder.mkdir()
        folder.chmod((old / folder.relative_to(new)).stat().st_mode & 0o777 | 0o700)


def _move_over(name: str, old: Path, new: Path, move: Callable[[Path, Path], None]) -> None:
    """Link or rename, by `move`, a file or an empty folder of `old` to the same name in `new`. Raises OSError."""
    source, target = old / name, new / name
    if os.path.lexists(target):
        return
    if source.is_dir() and not source.is_symlink():
        _make_folder(target, old, new)
        return
    _make_folder(target.parent, old, new)
    move(source, target)


# The lock: one process at a time writes to a place.

_TRIES = 100
"""Tries to lock: each fails only where the lock file goes between being opened and locked, as its process ends."""


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Be the only process that writes to `folder`: `.NAME.lock` beside it is locked meanwhile, and removed in the end.

    On file systems without locks nothing is locked. Raises OutputError where another process has the lock, OSError.
    """
    path = folder.parent / f"{hidden_name(folder.name)}.lock"
    fd, locked = _try_lock(path, folder)
    if locked:
        with suppress(OSError):
            overwrite_file(fd, f"process {os.getpid()} on {platform.node()}\n".encode())
    try:
        yield
    finally:
        if locked:  # while it is locked: a waiting process would lock a file without a name
            with suppress(OSError):
                path.unlink()
        os.close(fd)
        if not locked or IS_WINDOWS:
            with suppress(OSError):
                path.unlink()


def _try_lock(path: Path, folder: Path) -> tuple[int, bool]:
    """The lock file, open, and whether it is locked: False where there are no locks."""
    for _ in range(_TRIES):
        fd = _open_lock(path)
        locked = try_lock(fd)
        if locked is None or (locked and _is_still(path, fd)):
            return fd, bool(locked)
        try:
            if locked is False:
                os.lseek(fd, 0, os.SEEK_SET)
                name = os.read(fd, 200).decode(errors="replace").strip()
                raise OutputError(
                    f"{folder}: another run ({name or 'just started'}) is writing its results there; wait until it has "
                    "ended, or choose another folder with --out"
                )
        finally:
            os.close(fd)
    raise OutputError(
        f"{folder}: cannot be written: {path} is created and removed again and again; choose another folder with --out"
    )


def _open_lock(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | NO_LINK, 0o666)
    except PermissionError:  # left by another user
        return os.open(path, os.O_RDONLY | NO_LINK)


def _is_still(path: Path, fd: int) -> bool:
    """Whether an open file is still the one of this name."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(fd), os.lstat(path))
    return False


# The place of the results of one run.

EXPERIMENT = "experiment.yaml"
_NEW = "results"
_OTHERS = "other content came there during the run and is kept"
_PATH_BYTES = 32_767
"""Length of the longest path where the system does not say it: on Windows, where long paths are enabled."""
_ROOM = 600
"""Bytes left for paths in a results folder and in scratch folders beside it: two names and a half of 255 bytes."""


@dataclass
class ResultsPlace:
    """The place that results are written to. `folder` changes where they cannot have the name that was asked for."""

    folder: Path  # absolute, no links
    asked: Path  # as it was given
    asked_folder: Path  # `asked`, absolute, no links
    scratch: ScratchFolder
    before: os.stat_result | None  # the folder to be replaced, at the start
    notes: list[str] = field(default_factory=list)  # about this place, not about the results
    failed: list[str] = field(
        default_factory=list
    )  # files that could not be written, without which the results are complete
    left_out: set[str] = field(default_factory=set)  # the names of these files

    @property
    def shown(self) -> Path:
        """The folder of the results, as it was given where they are there."""
        return self.asked if self.folder == self.asked_folder else self.folder

    @property
    def new(self) -> Path:
        """The folder to fill."""
        return self.scratch.path / _NEW

    def will_hold(self, files: Sequence[str]) -> None:
        """Declare the files of the results, before any is written. Raises OSError."""
        self.scratch.will_hold(f"{_NEW}/{name}" for name in files)

    @contextmanager
    def may_fail(self, names: Sequence[str]) -> Iterator[None]:
        """Write files without which the results are complete: an error goes to `failed`, and the files are left out."""
        try:
            yield
        except Exception as error:  # also a defect: it must not cost the results of hours
            for path in (self.new / name for name in names):
                path.unlink(missing_ok=True)
                _remove_empty([parent for parent in path.parents if self.new in parent.parents])
            self.left_out.update(names)
            shown = [str(self.asked / name) for name in names]
            why = self._reason(error)
            for name in shown:
                why = why.removeprefix(f"{name}: ")
            self.failed.append(f"{', '.join(shown)}: not written ({why}); all other results are there")

    def cannot_be_written(self, error: OSError) -> OutputError:
        """The error for a place that cannot be written: it names the folder that was asked for."""
        return OutputError(f"{self.asked}: cannot be written: {os.strerror(error.errno) if error.errno else error}")

    def _reason(self, error: Exception) -> str:
        """The reason of an error in a line."""
        if isinstance(error, CopemError):
            return "; ".join(error.problems).replace(str(self.new), str(self.asked))
        if isinstance(error, OSError):
            return error.strerror or str(error)
        if isinstance(error, MemoryError):
            return "not enough memory"
        frame = traceback.extract_tb(error.__traceback__)[-1]
        words = " ".join(f"{type(error).__name__}: {error}".split())
        return f"internal error, please report it: {words}, in {Path(frame.filename).name}, line {frame.lineno}"

    def finish(self, files: Sequence[str]) -> None:
        """Give the new folder its name; an old one goes when all of the new one is on the disk. Raises OSError."""
        flush_all(self.new)
        state = _stat_folder(self.folder)
        why: str | None = _OTHERS
        if state is None:
            why = None if _try_rename(self.new, self.folder) else _OTHERS
        elif self.before is not None and os.path.samestat(state, self.before):
            why = self._replace(files)
        if why is not None:
            self._elsewhere(why)
        flush_file(self.folder.parent)

    def _replace(self, files: Sequence[str]) -> str | None:
        """Put the new folder in the place of the old one, with the user's own files. Returns why not; None: done.

        They are linked into the new folder before it has its name; where links cannot be made, moved after that.
        """
        held = list_belongings(self.folder)
        if held is None or find_taken(held.others(files), files):
            return _OTHERS
        self._list_ours(_NEW, held, files)
        for name in held.others(files):
            with suppress(OSError):
                _move_over(name, self.folder, self.new, partial(os.link, follow_symlinks=False))
        flush_all(self.new)
        assert self.before is not None
        old = self.new
        if not exchange_folders(self.new, self.folder):
            old = self.scratch.path / OLD
            exchange_in_two_steps(self.new, self.folder, old)
        elif not os.path.samestat(self.new.stat(), self.before):
            exchange_folders(self.new, self.folder)
            for name in set(held.others(files)).difference(files):
                with suppress(OSError):
                    (self.new / name).unlink()
            return _OTHERS
        after = list_belongings(old) or held  # more may have come meanwhile
        self._list_ours(old.name, after, files)
        for name in after.others(files):
            try:
                _move_over(name, old, self.folder, os.rename)
            except OSError as error:
                self.notes.append(f"{self.asked}/{name}: cannot be moved over ({error.strerror}); it is in {old}")
        # What is in both goes from here, also where a command then writes another file of that name.
        both = [name for name in after.others(files) if is_hard_link(old / name, self.folder / name)]
        self._list_ours(old.name, after, files, both)
        return None

    def _list_ours(self, where: str, held: FolderFiles, files: Sequence[str], both: Sequence[str] = ()) -> None:
        """List what may be removed of the scratch folder, in which the old results come to lie as `where`.

        `both`: the user's own files of them that the new results have, too.
        """
        ours = {*held.every}.difference(held.others(files)).union(files)
        listed = {f"{at}/{name}" for at in {_NEW, OLD, where} for name in ours}
        self.scratch.will_hold(listed.union(f"{where}/{name}" for name in both))

    def _elsewhere(self, why: str) -> None:
        """Give the new folder another name."""
        number = 2
        while True:
            other = self.asked_folder.with_name(f"{self.asked_folder.name}-{number}")
            if not os.path.lexists(other) and _try_rename(self.new, other):
                break
            number += 1
        self.notes.append(f"{self.asked}: {why}; the results of this run are in {other}")
        self.folder = other


def _stat_folder(path: Path) -> os.stat_result | None:
    """The state of the file or folder at a path; None: nothing, or an empty folder. Raises OSError."""
    try:
        state = os.lstat(path)
    except FileNotFoundError:
        return None
    return state if not path.is_dir() or path.is_symlink() or any(path.iterdir()) else None


def _try_rename(new: Path, name: Path) -> bool:
    """Rename a folder; False where there is something at the new name but an empty folder. Raises OSError."""
    try:
        os.rename(new, name)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            return False
        raise
    return True


@contextmanager
def take_place(folder: Path, *, overwrite: bool) -> Iterator[ResultsPlace]:
    """Lock the place of a results folder and remove leftovers of killed runs. Raises OutputError, nothing being
    written.

    In the end unfinished results are removed, and folders that were made for them.
    """
    check_target(folder, overwrite=overwrite)
    with ExitStack() as stack:
        try:
            path = folder.resolve()
            room = (os.pathconf("/", "PC_PATH_MAX") if hasattr(os, "pathconf") else _PATH_BYTES) - _ROOM
            if len(os.fsencode(path)) > room:
                raise OutputError(f"{folder}: cannot be written: its whole path has more than {room} bytes")
            for parent in (missing := [parent for parent in path.parents if not parent.exists()])[::-1]:
                parent.mkdir(exist_ok=True)
            stack.callback(_remove_empty, missing)
            stack.enter_context(lock_folder(path))
            notes = remove_leftovers(path)
            check_target(folder, overwrite=overwrite)
            scratch = stack.enter_context(make_scratch_folder(path))
            scratch.will_hold([])
            place = ResultsPlace(path, folder, path, scratch, _stat_folder(path), notes)
            place.new.mkdir()
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from None
        yield place


def _remove_empty(folders: Sequence[Path]) -> None:
    """Remove folders as long as they are empty, the innermost first."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def check_target(folder: Path, *, overwrite: bool) -> None:
    """Raise OutputError where a results folder may not be written."""
    try:
        parent = next((place for place in Path(os.path.abspath(folder)).parents if place.exists()), Path("/"))
        exists = _folder_exists(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from None
    if not parent.is_dir():
        raise OutputError(f"{folder}: cannot be written: {parent} is a file")
    try:
        os.fsencode(os.path.abspath(folder)).decode()
    except UnicodeDecodeError:
        raise OutputError(
            f"{folder}: cannot be written: expected a path in UTF-8, found other bytes; choose another with --out"
        ) from None
    if not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f"{folder}: cannot be written: no permission to write in {parent}")
    if not exists:
        return
    if not folder.is_dir():
        raise OutputError(f"{folder}: expected a folder for the results, found a file")
    if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
        raise OutputError(f"{folder}: cannot be written: no permission to replace what is in it")
    empty = not any(folder.iterdir())
    try:
        held = None if empty else list_belongings(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be replaced: {error.filename}: {error.strerror}") from None
    if not empty and held is None:
        raise OutputError(f"{folder}: not empty and no results folder; choose another with --out")
    if not empty and not overwrite:
        raise OutputError(
            f"{folder}: results are there already; --overwrite replaces them, --out chooses another folder"
        )
    place = folder.resolve()
    if place.is_mount() or place in (Path.cwd(), *Path.cwd().parents):
        raise OutputError(f"{folder}: cannot be replaced, being in use or a mount point; choose a folder in it")


def find_taken(others: Iterable[str], files: Collection[str]) -> list[str]:
    """The user's own files whose names the results need, themselves or for a folder."""
    folders = {parent.as_posix() for file in files for parent in Path(file).parents}
    taken = folders.union(files)
    return [n for n in others if n in taken or any(parent.as_posix() in files for parent in Path(n).parents)]


def check_names(place: ResultsPlace, files: Sequence[str]) -> None:
    """Raise OutputError, before the replay, where a file of the user's own has a name that the results need."""
    held = None if place.before is None else list_belongings(place.folder)
    if held is not None and held.results is not None and (taken := find_taken(held.others(files), files)):
        out = "move it elsewhere, or choose another folder with --out"
        raise OutputError(f"{place.asked}/{taken[0]}: the results will have a file of that name; {out}")


def _folder_exists(folder: Path) -> bool:
    """Whether a path exists. Raises OSError for an impossible one: a loop of links, a name that is too long."""
    try:
        os.stat(folder)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def check_inputs(place: ResultsPlace, inputs: Sequence[Path]) -> None:
    """Raise OutputError where an input of the run would go with the folder that is replaced."""
    if place.before is None:
        return
    held = list_belongings(place.folder)
    ours = None if held is None or held.results is None else held.results | held.made
    for path in inputs:
        if not path.resolve().is_relative_to(place.folder):
            continue
        name = path.resolve().relative_to(place.folder).as_posix()
        goes = ours is None or any(one == name or one.startswith(f"{name}/") for one in ours)
        if goes and name != EXPERIMENT:
            raise OutputError(
                f"{place.asked}: {path} is in this folder and would be removed; choose another folder with --out"
            )
