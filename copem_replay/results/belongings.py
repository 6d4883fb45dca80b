"""Files that belong to a results folder, and go when new results take its place; the rest stays."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from copem_replay.core.errors import InputError, OutputError
from copem_replay.core.scratch import is_scratch

MARK = "provenance.json"
_FIGURES = ("runs", "curves", "one_by_one", "distances", "latency_breakdown", "sweeps")
_MADE_OF_RESULTS = {
    "report.html",
    *(f"figures/{name}.{kind}" for name in _FIGURES for kind in ("png", "svg")),
}
"""What `report` and `plot` make: not in the list of files, and true of the results they were made of alone."""


@dataclass(frozen=True)
class Belongings:
    """What is in a results folder, by names relative to it. `ours` is None where it does not say (an older version)."""

    ours: frozenset[str] | None
    every: tuple[str, ...]  # files, links, empty folders

    def others(self, written: Collection[str]) -> list[str]:
        """The user's own files; `written`: what the new results are. A folder that does not say has the same."""
        ours = (self.ours if self.ours is not None else frozenset(written)) | _MADE_OF_RESULTS
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
    return Belongings(frozenset(map(str, listed)) if isinstance(listed, list) else None, tuple(names_in(folder)))


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
