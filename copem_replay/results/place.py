"""The place of a results folder, from the start of a run: refused, locked, tidied up, and in the end exchanged.

docs/develop/decisions/0020-results-folder.md
"""

from __future__ import annotations

import errno
import os
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from copem_replay.core.errors import CopemError, OutputError
from copem_replay.core.scratch import OLD, Scratch, flush, flush_all, remove_leftovers, scratch_for
from copem_replay.results.belongings import Belongings, belongings, keep, made_in, names_in
from copem_replay.results.exchange import exchange
from copem_replay.results.lock import only_writer

EXPERIMENT = "experiment.yaml"
_NEW, _SPARE = "results", "copy"
_OTHERS = "something else came there during the run, and stays"
_ROOM = 600
"""Bytes that paths in a results folder, and in the scratch folders in it, may take (chosen: two names and a half)."""


@dataclass
class Place:
    """Where results go. `folder` changes where they cannot have the name that was asked for."""

    folder: Path  # absolute, no links
    asked: Path  # as it was given
    asked_folder: Path  # the same, absolute, no links
    scratch: Scratch
    before: os.stat_result | None  # the folder that is to be replaced, as it was at the start
    notes: list[str] = field(default_factory=list)  # what has to be said of this place, and not of the results
    failed: list[str] = field(default_factory=list)  # what could not be written that the results are complete without
    left_out: set[str] = field(default_factory=set)  # the names of these files

    @property
    def shown(self) -> Path:
        """Where the results are, as it was given if they are there."""
        return self.asked if self.folder == self.asked_folder else self.folder

    @property
    def new(self) -> Path:
        """The folder to fill."""
        return self.scratch.path / _NEW

    def will_hold(self, files: Sequence[str]) -> None:
        """Say what the results are going to be, before any of it is written. Raises OSError."""
        self.scratch.will_hold([_SPARE, *(f"{_NEW}/{name}" for name in files)])

    @contextmanager
    def may_fail(self, names: Sequence[str]) -> Iterator[None]:
        """Write files that the results are complete without. Whatever goes wrong is `failed`, and they are left out."""
        try:
            yield
        except Exception as error:  # also a defect: it must not cost what hours have computed
            for path in (self.new / name for name in names):
                path.unlink(missing_ok=True)
                _without([parent for parent in path.parents if self.new in parent.parents])
            self.left_out.update(names)
            shown = [str(self.asked / name) for name in names]
            why = self._reason(error)
            for name in shown:
                why = why.removeprefix(f"{name}: ")
            self.failed.append(f"{', '.join(shown)}: not written ({why}); all other results are there")

    def _reason(self, error: Exception) -> str:
        """Why something could not be written, in a line."""
        if isinstance(error, CopemError):
            return "; ".join(error.problems).replace(str(self.new), str(self.asked))
        if isinstance(error, OSError):
            return error.strerror or str(error)
        if isinstance(error, MemoryError):
            return "not enough memory"
        at = traceback.extract_tb(error.__traceback__)[-1]
        said = " ".join(f"{type(error).__name__}: {error}".split())
        return f"internal error, please report it: {said}, in {Path(at.filename).name}, line {at.lineno}"

    def finish(self, files: Sequence[str]) -> None:
        """Give the new folder its name: what is there goes when all of the new one is on the disk. Raises OSError."""
        flush_all(self.new)
        there = _folder_at(self.folder)
        why: str | None = _OTHERS
        if there is None:
            why = None if _given(self.new, self.folder) else _OTHERS
        elif self.before is not None and os.path.samestat(there, self.before):
            why = self._replace(files)
        if why is not None:
            self._elsewhere(why)
        flush(self.folder.parent)

    def _replace(self, files: Sequence[str]) -> str | None:
        """Put the new folder in the place of the old one, with the user's own files. Returns why not: None, it is."""
        held = belongings(self.folder)
        if held is None:
            return _OTHERS
        try:
            kept = self._keep(held, files)
        except OSError as error:
            for name in set(held.others(files)) - set(files):
                with suppress(OSError):
                    (self.new / name).unlink()
            return f"not replaced, as {error.filename} can be neither linked nor copied ({error.strerror})"
        assert self.before is not None
        if exchange(self.new, self.folder):
            if not os.path.samestat(self.new.stat(), self.before):
                exchange(self.new, self.folder)
                return _OTHERS
            old = self.new
        else:
            old = self.scratch.path / OLD
            _move_in(self.new, self.folder, old)
        self._keep_late(old, held, kept)
        return None

    def _keep(self, held: Belongings, files: Sequence[str]) -> dict[str, str]:
        """Have the user's own files in the new folder, too: its names there by those in the old one."""
        others = held.others(files)
        ours = set(held.every) - set(others)
        removable = [_SPARE, *(f"{_NEW}/{name}" for name in {*files, *ours}), *(f"{OLD}/{name}" for name in ours)]
        kept: dict[str, str] = {}
        same: dict[str, str] = {}
        self.scratch.will_hold(removable, {f"{_NEW}/{name}": f"{self.folder.name}/{name}" for name in others})
        for name in sorted(others, key=lambda name: name in files):  # what need not give way, first
            kept[name] = keep(name, self.folder, self.new, self.scratch.path / _SPARE)
            if kept[name] != name:
                self.notes.append(f"{self.asked}/{name}: kept as {kept[name]}, as the results have one of that name")
            same |= {f"{at}/{name}": f"{self.folder.name}/{kept[name]}" for at in (_NEW, OLD)}
            same[f"{_NEW}/{kept[name]}"] = f"{self.folder.name}/{name}"
        if others:
            self.scratch.will_hold(removable, same)
            flush_all(self.new)
        return kept

    def _keep_late(self, old: Path, held: Belongings, kept: dict[str, str]) -> None:
        """What came into the old folder while the new one took its place: what was made of the old results goes."""
        made = made_in(old)
        late = [name for name in names_in(old) if name not in held.every]
        self.scratch.add([f"{old.name}/{name}" for name in made.intersection(late)])
        for name in late:
            if name not in made:
                with suppress(OSError):
                    kept[name] = keep(name, old, self.folder, self.scratch.path / _SPARE)
                    self.scratch.add(same={f"{old.name}/{name}": f"{self.folder.name}/{kept[name]}"})

    def _elsewhere(self, why: str) -> None:
        """Give the new folder another name."""
        number = 2
        while True:
            other = self.asked_folder.with_name(f"{self.asked_folder.name}-{number}")
            if not os.path.lexists(other) and _given(self.new, other):
                break
            number += 1
        self.notes.append(f"{self.asked}: {why}; the results of this run are in {other}")
        self.folder = other


def _folder_at(path: Path) -> os.stat_result | None:
    """What is under a name; None: nothing, or an empty folder. Raises OSError."""
    try:
        found = os.lstat(path)
    except FileNotFoundError:
        return None
    return found if not path.is_dir() or path.is_symlink() or any(path.iterdir()) else None


def _given(new: Path, name: Path) -> bool:
    """Whether a folder got a name at which there was nothing, or an empty folder. Raises OSError."""
    try:
        os.rename(new, name)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            return False
        raise
    return True


def _move_in(new: Path, name: Path, old: Path) -> None:
    """Put a folder in the place of another in two steps. Killed between them, it is put right by the next run."""
    os.rename(name, old)
    try:
        os.rename(new, name)
    except BaseException:
        with suppress(OSError):
            os.rename(old, name)
        raise


@contextmanager
def taken(folder: Path, *, overwrite: bool) -> Iterator[Place]:
    """Have a place for results to oneself; what killed runs left there goes. Raises OutputError, with nothing written.

    What is not finished in the end is gone, and so are folders that were made for it.
    """
    check_target(folder, overwrite=overwrite)
    with ExitStack() as stack:
        try:
            place = _taken(folder, overwrite, stack)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from None
        yield place


def _taken(folder: Path, overwrite: bool, stack: ExitStack) -> Place:
    path = folder.resolve()
    room = os.pathconf("/", "PC_PATH_MAX") - _ROOM
    if len(os.fsencode(path)) > room:
        raise OutputError(f"{folder}: cannot be written: its whole path has more than {room} bytes")
    for parent in (missing := [parent for parent in path.parents if not parent.exists()])[::-1]:
        parent.mkdir(exist_ok=True)
    stack.callback(_without, missing)
    stack.enter_context(only_writer(path))
    notes = remove_leftovers(path)
    check_target(folder, overwrite=overwrite)
    scratch = stack.enter_context(scratch_for(path))
    scratch.will_hold([])
    place = Place(path, folder, path, scratch, _folder_at(path), notes)
    place.new.mkdir()
    return place


def _without(folders: Sequence[Path]) -> None:
    """Remove folders as long as they are empty, the innermost first."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def check_target(folder: Path, *, overwrite: bool) -> None:
    """Whether a results folder may be written here. Raises OutputError."""
    try:
        parent = next((place for place in Path(os.path.abspath(folder)).parents if place.exists()), Path("/"))
        exists = _exists(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from None
    if not parent.is_dir():
        raise OutputError(f"{folder}: cannot be written: {parent} is a file")
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
        held = None if empty else belongings(folder)
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


def _exists(folder: Path) -> bool:
    """Raises OSError for what no folder can be: a loop of links, a name that is too long."""
    try:
        os.stat(folder)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def check_inputs(place: Place, inputs: Sequence[Path]) -> None:
    """Whether what a run reads stays where it is. Raises OutputError."""
    if place.before is None:
        return
    held = belongings(place.folder)
    ours = None if held is None or held.results is None else held.results | held.made
    for path in inputs:
        if not path.resolve().is_relative_to(place.folder):
            continue
        name = path.resolve().relative_to(place.folder).as_posix()
        goes = ours is None or any(one == name or one.startswith(f"{name}/") for one in ours)
        if goes and name != EXPERIMENT:
            raise OutputError(f"{place.asked}: {path} is in it and would go with it; choose another folder with --out")
