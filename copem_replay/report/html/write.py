"""The report as a file: complete under its name, or not there; the same results, the same bytes."""

from __future__ import annotations

from pathlib import Path

from copem_replay.core.errors import OutputError
from copem_replay.core.files import atomic_file
from copem_replay.results.belongings import check_still, list_made

REPORT = "report.html"
_SUFFIXES = (".html", ".htm")


def check_report(path: Path) -> None:
    """Raise OutputError where a file's name is not that of a page."""
    if path.suffix.lower() not in _SUFFIXES or path.is_dir():
        found = "a folder" if path.is_dir() else path.name
        raise OutputError(f"{path}: expected a name that ends with {' or '.join(_SUFFIXES)}, found {found}")


def write_report(folder: Path, out: Path | None = None, *, baseline: str | None = None) -> Path:
    """Write the report of a results folder, by default as `report.html` in it. Returns its path.

    A report that is there is replaced. Raises InputError where the results cannot be read, OutputError where nothing
    can be written.
    """
    from copem_replay.report.html.page import page
    from copem_replay.report.html.study import load_study

    path = folder / REPORT if out is None else out
    check_report(path)
    study = load_study(folder, baseline)
    html = page(study)
    with atomic_file(path) as scratch:
        scratch.write_text(html, encoding="utf-8", newline="\n")
        check_still(folder, study.results.seen)
        list_made(folder, [path])
    return path
