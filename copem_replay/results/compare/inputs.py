"""The results folders of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from copem_replay.core.errors import InputError
from copem_replay.results.read import Results, open_results


def read_folders(given: Sequence[Path | Results]) -> list[Results]:
    """Read results folders; one that is open is not read again. Raises InputError, a line for each that cannot be read,
    or that is given twice.
    """
    folders: list[Results] = []
    problems: list[str] = []
    seen: dict[Path, Path] = {}
    for one in given:
        path = one.folder if isinstance(one, Results) else one
        if path.resolve() in seen:
            problems.append(f"{path}: expected each folder once, found it twice ({seen[path.resolve()]})")
            continue
        seen[path.resolve()] = path
        try:
            folders.append(_read(one))
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(problems)
    if not folders:
        raise InputError("compare: expected a results folder, found none")
    return folders


def _read(one: Path | Results) -> Results:
    results = one if isinstance(one, Results) else open_results(one)
    for name in ("by_log", "source"):
        getattr(results, name)
    return results
