"""Seals: `provenance.json` has the SHA-256 of every file of the results, and one of itself; readers check them.

A file is read from end to end once for that, which takes less time than to decode it. Recordings for Rerun, whose bytes
are others in each writing, have their seals in `made.jsonl`, so that `provenance.json` is the same; so does what
commands made of the results for others to read. A file that is gone is no damage here: who needs it says so. Results
of older versions have no seals.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from copem_replay.core.errors import InputError
from copem_replay.results.folder import MADE, MARK, add_to_made_list, read_made
from copem_replay.results.table_files import AGAIN

SEALS = "sha256"
"""The key of `provenance.json` that has the seals, by the name of the file."""
_OTHER_EACH_TIME = ".rrd"
"""Files whose ids of rows and times of writing Rerun alone sets."""


def seal_results(folder: Path, names: Iterable[str], said: Mapping[str, object]) -> dict[str, object]:
    """The data of `provenance.json`, with the seals of the named files in a folder, and of itself. Raises OSError."""
    seals = {name: digest_file(folder / name) for name in names if name != MARK and not name.endswith(_OTHER_EACH_TIME)}
    sealed = {**said, SEALS: seals}
    return {**sealed, SEALS: seals | {MARK: _digest_said(sealed)}}


def seal_recordings(folder: Path, names: Iterable[str]) -> list[str]:
    """Seal the named files of a folder whose bytes differ in each writing. Returns the name of the list, if any.

    Raises OutputError, OSError.
    """
    seals = {folder / name: digest_file(folder / name) for name in names if name.endswith(_OTHER_EACH_TIME)}
    add_to_made_list(folder, seals, seals)
    return [MADE] if seals else []


def check_recordings(files: Sequence[Path]) -> None:
    """Raise InputError where a sealed file of a results folder, in it or below, is not what was written."""
    for file in files:
        place = Path(os.path.realpath(file.parent)) / file.name
        for folder in (parent for parent in place.parents if (parent / MARK).is_file()):
            if seal := read_made(folder).get(place.relative_to(folder).as_posix()):
                _check_digest(file, seal, AGAIN)


def read_seals(content: Mapping[str, Any]) -> dict[str, str]:
    """The seals of files; empty in results of older versions. Raises ValueError where what is said is not sealed."""
    if SEALS not in content:
        return {}
    seals = dict(content[SEALS])
    own_seal = seals.pop(MARK, None)
    if _digest_said({**content, SEALS: seals}) != own_seal:
        raise ValueError("its content is not what was written (SHA-256)")
    return seals


def check_sealed(folder: Path, name: str, seals: Mapping[str, str | None], remedy: str = AGAIN) -> None:
    """Raise InputError where a file of results, or one of a table that is a folder, is not what was written.

    `remedy`: what writes it again.
    """
    named = {file: seal for file, seal in seals.items() if seal and (file == name or file.startswith(f"{name}/"))}
    if seals and not named and (folder / name).exists():
        out = f"give it another name, or {remedy}"
        raise InputError(f"{folder / name}: expected no such file among these results, found one; {out}")
    for file, seal in named.items():
        _check_digest(folder / file, seal, remedy)


def _check_digest(path: Path, seal: str, remedy: str) -> None:
    try:
        digest = digest_file(path)
    except OSError as error:
        raise InputError(f"{path}: expected a file of the results, found {error.strerror}; {remedy}") from None
    if digest != seal:
        raise InputError(
            f"{path}: expected the file that was written, SHA-256 {seal[:12]}…, found {digest[:12]}…; "
            f"put it back, or {remedy}"
        )


def _digest_said(content: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


_DIGESTS: dict[tuple[int, ...], str] = {}


def digest_file(path: Path) -> str:
    """The SHA-256 of a file, taken once in a process as long as the file stays the same. Raises OSError."""
    with path.open("rb") as file:
        seen = os.fstat(file.fileno())
        key = (seen.st_dev, seen.st_ino, seen.st_size, seen.st_mtime_ns, seen.st_ctime_ns)
        if key not in _DIGESTS:
            _DIGESTS[key] = hashlib.file_digest(file, "sha256").hexdigest()
    return _DIGESTS[key]
