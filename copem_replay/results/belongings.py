"""Files that belong to a results folder, and go when new results take its place; the rest stays.

Those of the results are listed in `provenance.json`, those that commands made of them in `made.jsonl`.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from copem_replay.core.errors import InputError, OutputError
from copem_replay.core.scratch import is_scratch

MARK = "provenance.json"
MADE = "made.jsonl"
"""In a results folder: the names of files that commands made of the results later, a JSON string a line.

Lines are only ever added, so that two commands at a time lose none, and a line that is half-written is no name.
"""


@dataclass(frozen=True)
class Belongings:
    """What is in a results folder, by names relative to it.

    `results`: None where it does not say (an older version). `made`: of the results, afterwards.
    """

    results: frozenset[str] | None
    made: frozenset[str]
    every: tuple[str, ...]  # files, links, empty folders

    def others(self, written: Collection[str]) -> list[str]:
        """The user's own files; `written`: what the new results are. A folder that does not say has the same."""
        ours = (self.results if self.results is not None else frozenset(written)) | self.made
        return [name for name in self.every if name not in ours]


def belongings(folder: Path) -> Belongings | None:
    """What is in a results folder; None: it is not one. Raises OSError, OutputError for a mount point in it."""
    try:
        said: Any = json.loads((folder / MARK).read_bytes())
    except (OSError, ValueError):
        return None
    if not isinstance(said, dict) or "copem_replay" not in said:
        return None
    listed = said.get("files")
    results = frozenset(map(str, listed)) if isinstance(listed, list) else None
    return Belongings(results, made_in(folder), tuple(names_in(folder)))


def made_in(folder: Path) -> frozenset[str]:
    """What is listed as made of the results of a folder, and the list itself. No name in it leads anywhere.

    They are compared with names that are there, and never opened: a list may say whatever it likes.
    """
    found = {MADE}
    for line in _listed(folder).splitlines():
        try:
            name = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(name, str):
            found.add(name)
    return frozenset(found)


def list_made(folder: Path, files: Iterable[Path]) -> None:
    """List those of some files that lie in a results folder as made of its results: with them they go.

    To be called before a file has its name, so that no process that is killed leaves one that is not listed.
    Raises OutputError.
    """
    root = os.path.realpath(folder)
    if not os.path.isfile(os.path.join(root, MARK)):
        return
    places = [os.path.join(os.path.realpath(file.parent), file.name) for file in files]
    names = {os.path.relpath(place, root) for place in places if place.startswith(f"{root}{os.sep}")}
    if not (new := sorted(names - made_in(folder))):
        return
    begun = _listed(folder)[-1:] not in (b"", b"\n")  # by a process that was killed
    text = "\n" * begun + "".join(f"{json.dumps(name)}\n" for name in new)
    try:
        fd = os.open(folder / MADE, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        try:
            os.write(fd, text.encode())
            os.fsync(fd)
        finally:
            os.close(fd)
    except OSError as error:
        raise OutputError(f"{folder / MADE}: cannot be written: {error.strerror or error}") from None


def _listed(folder: Path) -> bytes:
    """The content of the list; nothing where there is none, or something else in its place."""
    try:
        fd = os.open(folder / MADE, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with open(fd, "rb") as file:
            return file.read() if stat.S_ISREG(os.fstat(fd).st_mode) else b""
    except OSError:
        return b""


def check_still(folder: Path, seen: os.stat_result) -> None:
    """Raise InputError where other results have taken the place of those that were read."""
    try:
        same = os.path.samestat(os.stat(folder), seen)
    except OSError:
        same = False
    if not same:
        raise InputError(f"{folder}: other results took its place while it was read; do it once more")


def names_in(folder: Path, at: str = "") -> Iterator[str]:
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
            yield from names_in(Path(entry.path), f"{at}{entry.name}/")


def keep(name: str, old: Path, new: Path, spare: Path) -> str:
    """Have in `new` what in `old` is called `name`: linked, else copied by way of `spare`.

    Returns how it is called now: the same, or, where `new` has another of that name, with `.kept`. Raises OSError.
    """
    source, target, number = old / name, new / name, 0
    while os.path.lexists(target) or any(parent.is_file() for parent in _between(target, new)):
        number += 1
        first, slash, rest = name.partition("/")
        target = new / f"{first}.kept{number if number > 1 else ''}{slash}{rest}"
    name = target.relative_to(new).as_posix()
    if source.is_dir() and not source.is_symlink():
        _make_folders(source, target, old)
        return name
    _make_folders(source.parent, target.parent, old)
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        spare.unlink(missing_ok=True)
        shutil.copy2(source, spare, follow_symlinks=False)
        os.rename(spare, target)
    return name


def _between(path: Path, top: Path) -> Iterator[Path]:
    yield from (parent for parent in path.parents if parent != top and top in parent.parents)


def _make_folders(source: Path, target: Path, top: Path) -> None:
    """Make a folder like another, and those above it up to `top`."""
    if target.exists():
        return
    if source != top:
        _make_folders(source.parent, target.parent, top)
    target.mkdir()
    target.chmod(source.stat().st_mode & 0o777 | 0o700)
