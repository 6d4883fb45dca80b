"""The results folders of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from copem_replay.core.errors import InputError
from copem_replay.results.read import Results, open_results


def read_folders(paths: Sequence[Path]) -> list[Results]:
    """Read results folders. Raises InputError, a line for each that cannot be, or that is given twice."""
    folders: list[Results] = []
    problems: list[str] = []
    seen: dict[Path, Path] = {}
    for path in paths:
        if path.resolve() in seen:
            problems.append(f"{path}: expected each folder once, found it twice ({seen[path.resolve()]})")
            continue
        seen[path.resolve()] = path
        try:
            folders.append(_read(path))
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(problems)
    if not folders:
        raise InputError("compare: expected a results folder, found none")
    return folders


def _read(path: Path) -> Results:
    results = open_results(path)
    for name in ("arrow", "source"):
        getattr(results, name)
    return results
