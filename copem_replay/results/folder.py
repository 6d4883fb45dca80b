"""The place of a results folder during a run: checked, locked, tidied up, and in the end replaced by the new one.

A folder lists the files of its results in `provenance.json`, and those that commands made of them in `made.jsonl`; both
go when new results take its place, the user's own files stay. See docs/develop/decisions/results.md.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import stat
import traceback
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from copem_replay.core.errors import CopemError, InputError, OutputError
from copem_replay.core.files import (
    IS_WINDOWS,
    NO_LINK,
    ScratchFolder,
    check_parent,
    flush_all,
    flush_file,
    hidden_name,
    is_still,
    list_names,
    make_scratch_folder,
    may_be_moved,
    overwrite_file,
    parse_json,
    remove_leftovers,
    replace_folder,
    try_lock,
)

# The files that belong to a results folder.

MARK = "provenance.json"
MADE = "made.jsonl"
"""Lists the files that commands made of the results later, a JSON string a line; sealed ones as {name: SHA-256}.

Lines are only appended, so that two commands at a time lose none, and a half-written line is no name.
"""


@dataclass(frozen=True)
class FolderFiles:
    """The files of a results folder, by names relative to it.

    `results`: those of the results, None where the folder does not list them (an older version). `made`: those that
    commands made of the results afterwards. They are only compared with names of existing files, never opened: a list
    may hold any text.
    """

    results: frozenset[str] | None
    made: frozenset[str]

    def is_ours(self, name: str) -> bool:
        """Whether the lists have this file, or a file in the folder of this name."""
        return any(one == name or one.startswith(f"{name}/") for one in (self.results or frozenset()) | self.made)

    def list_others(self, folder: Path, written: Collection[str]) -> list[str]:
        """The user's own files in the folder. `written`: new results, for those of a folder without a list."""
        ours = (self.results if self.results is not None else frozenset(written)) | self.made
        return [name for name in list_names(folder) if name not in ours]


def list_belongings(folder: Path) -> FolderFiles | None:
    """The listed files of a results folder; None: it is no results folder."""
    try:
        provenance: Any = parse_json((folder / MARK).read_bytes())
    except (OSError, ValueError):
        return None
    if not isinstance(provenance, dict) or "copem_replay" not in provenance:
        return None
    listed = provenance.get("files")
    results = frozenset(map(str, listed)) if isinstance(listed, list) else None
    return FolderFiles(results, frozenset(read_made(folder)))


def read_made(folder: Path) -> dict[str, str | None]:
    """Seals by the names listed as made of the results of a folder, the list itself included; None: not sealed."""
    made: dict[str, str | None] = {MADE: None}
    for line in _read_made_list(folder).splitlines():
        with suppress(ValueError):
            entry = parse_json(line)
            made |= {name: str(seal) for name, seal in entry.items()} if isinstance(entry, dict) else {str(entry): None}
    return made


def add_to_made_list(folder: Path, files: Iterable[Path], seals: Mapping[Path, str] | None = None) -> None:
    """List those of `files` that lie in a results folder as made of its results, with which they go.

    `seals`: of those that other commands read. To be called before a file gets its name, so that a killed
    process leaves no unlisted file. Raises OutputError.
    """
    root = os.path.realpath(folder)
    if not os.path.isfile(os.path.join(root, MARK)):
        return
    places = {os.path.join(os.path.realpath(file.parent), file.name): (seals or {}).get(file) for file in files}
    made = [(os.path.relpath(p, root), seal) for p, seal in sorted(places.items()) if p.startswith(f"{root}{os.sep}")]
    listed = read_made(folder).items()
    if not (new := [name if seal is None else {name: seal} for name, seal in made if (name, seal) not in listed]):
        return
    cut_off = _read_made_list(folder)[-1:] not in (b"", b"\n")  # the last line, by a killed process
    text = "\n" * cut_off + "".join(f"{json.dumps(entry)}\n" for entry in new)
    try:
        fd = os.open(folder / MADE, os.O_WRONLY | os.O_CREAT | os.O_APPEND | NO_LINK, 0o666)
        with open(fd, "ab") as file:
            file.write(text.encode())
            file.flush()
            os.fsync(fd)
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
        if IS_WINDOWS:
            os.close(fd)
        with suppress(OSError):  # while it is locked: a waiting process would lock a file without a name
            path.unlink()
        if not IS_WINDOWS:
            os.close(fd)


def _try_lock(path: Path, folder: Path) -> tuple[int, bool]:
    """An open file descriptor of the lock, and whether it is locked (False: the file system has no locks)."""
    for _ in range(_TRIES):
        fd = _open_lock(path)
        locked = try_lock(fd)
        if locked is None or (locked and is_still(path, fd)):
            return fd, bool(locked)
        os.lseek(fd, 0, os.SEEK_SET)
        name = os.read(fd, 200).decode(errors="replace").strip()
        os.close(fd)
        if not locked:
            raise OutputError(
                f"{folder}: another run ({name or 'just started'}) is writing its results there; wait until it has "
                "ended, or choose another folder with --out"
            )
    raise OutputError(
        f"{folder}: cannot be written: {path} is created and removed again and again; choose another folder with --out"
    )


def _open_lock(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | NO_LINK, 0o666)
    except PermissionError:  # left by another user
        return os.open(path, os.O_RDONLY | NO_LINK)


# The place of the results of one run.

EXPERIMENT = "experiment.yaml"
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
        """The folder of the results, in the user's spelling unless they had to go elsewhere."""
        return self.asked if self.folder == self.asked_folder else self.folder

    @property
    def new(self) -> Path:
        """The folder to fill."""
        return self.scratch.new

    @contextmanager
    def may_fail(self, names: Sequence[str]) -> Iterator[None]:
        """Context in which optional files are written: on an error they are deleted and a line goes to `failed`."""
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
        if state is None:
            done = _try_rename(self.new, self.folder)
        else:
            done = self.before is not None and os.path.samestat(state, self.before) and self._replace(files, state)
        if not done:
            self._put_elsewhere()
        flush_file(self.folder.parent)

    def _replace(self, files: Sequence[str], old_stat: os.stat_result) -> bool:
        """Swap the new folder in for the old one, keeping the user's files. False: a user's file is in the way."""
        belongings = list_belongings(self.folder)
        if belongings is None or find_taken(belongings.list_others(self.folder, files), files):
            return False
        own_files = belongings.list_others(self.folder, files)
        self.scratch.may_remove({*list_names(self.folder), *files}.difference(own_files))

        def list_others(folder: Path) -> list[str]:  # more may come, and more be made, meanwhile
            return (list_belongings(folder) or belongings).list_others(folder, files)

        staying = replace_folder(self.scratch, self.folder, list_others, old_stat)
        self.notes += [f"{self.asked}/{line}" for line in staying or ()]
        if staying is None:
            for name in set(own_files).difference(files):
                with suppress(OSError):
                    (self.new / name).unlink()
        return staying is not None

    def _put_elsewhere(self) -> None:
        """Give the new folder another name."""
        number = 2
        while True:
            new_folder = self.asked_folder.with_name(f"{self.asked_folder.name}-{number}")
            if not os.path.lexists(new_folder) and _try_rename(self.new, new_folder):
                break
            number += 1
        self.notes.append(f"{self.asked}: {_OTHERS}; the results of this run are in {new_folder}")
        self.folder = new_folder


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
            place = ResultsPlace(path, folder, path, scratch, _stat_folder(path), notes)
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
    check_parent(folder, os.stat)
    if not folder.exists():
        return
    if not folder.is_dir():
        raise OutputError(f"{folder}: expected a folder for the results, found a file")
    if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
        raise OutputError(f"{folder}: cannot be written: no permission to replace what is in it")
    if any(folder.iterdir()):
        if list_belongings(folder) is None:
            raise OutputError(f"{folder}: not empty and no results folder; choose another with --out")
        try:
            list(list_names(folder))
        except OSError as error:
            raise OutputError(f"{folder}: cannot be replaced: {error.filename}: {error.strerror}") from None
        if not overwrite:
            raise OutputError(
                f"{folder}: results are there already; --overwrite replaces them, --out chooses another folder"
            )
    if not may_be_moved(folder.resolve()):
        raise OutputError(f"{folder}: cannot be replaced, being in use or a mount point; choose a folder in it")


def find_taken(others: Iterable[str], files: Collection[str]) -> list[str]:
    """The user's own files that have a name which the results need, as a file or as a folder."""
    folders = {parent.as_posix() for file in files for parent in Path(file).parents}
    taken = folders.union(files)
    return [n for n in others if n in taken or any(parent.as_posix() in files for parent in Path(n).parents)]


def check_names(place: ResultsPlace, files: Sequence[str]) -> None:
    """Raise OutputError, before the replay, where a file of the user's own has a name that the results need."""
    held = None if place.before is None else list_belongings(place.folder)
    if held is None or held.results is None:
        return
    if taken := find_taken(held.list_others(place.folder, files), files):
        out = "move it elsewhere, or choose another folder with --out"
        raise OutputError(f"{place.asked}/{taken[0]}: the results will have a file of that name; {out}")


def check_inputs(place: ResultsPlace, inputs: Sequence[Path]) -> None:
    """Raise OutputError where an input of the run would go with the folder that is replaced."""
    belongings = None if place.before is None else list_belongings(place.folder)
    for path in inputs if place.before is not None else ():
        if not path.resolve().is_relative_to(place.folder):
            continue
        name = path.resolve().relative_to(place.folder).as_posix()
        goes = belongings is None or belongings.results is None or belongings.is_ours(name)
        if goes and name != EXPERIMENT:
            raise OutputError(
                f"{place.asked}: {path} is in this folder and would be removed; choose another folder with --out"
            )
