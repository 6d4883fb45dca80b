"""From a data set or a simulation to recordings of OSI truth: which files, one after the other, and what is noted.

A format is one module with `frames(source, report, **options)` and a row of `FORMATS`. A recording is complete or not
there, and the same input gives the same bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from copem_replay.core.errors import InputError, OutputError
from copem_replay.core.text import counted, unknown
from copem_replay.io.convert.ground_truth import RECORD, Frame, Report, write
from copem_replay.io.convert.scenario_folder import scenarios

FORMATS: Final[Mapping[str, str]] = {
    "argoverse2": "argoverse2",
    "scenarionet": "scenarionet",
    "openlabel": "openlabel",
    "commonroad": "commonroad",
    "sumo": "sumo",
    "csv": "csv_rows",
}
"""Module of this folder by the name of the format."""
_MOST_LINES: Final = 10
"""Lines of one kind in a summary (chosen): a data set has thousands of scenarios."""


def convert(source: Path, out: Path, *, format: str, options: Mapping[str, Any] | None = None) -> Report:
    """Convert one recording to the file `out`.

    `options`: keyword arguments of the format's `frames`. Raises InputError: unknown format, or a source that cannot be
    converted; OutputError.
    """
    if format not in FORMATS:
        raise InputError(unknown("format", format, FORMATS))
    frames: Callable[..., Iterator[Frame]] = import_module(f"copem_replay.io.convert.{FORMATS[format]}").frames
    report = Report()
    write(out, frames(source, report, **(options or {})), report, source=source, format_name=format)
    return report


def outputs(source: Path, out: Path, *, format: str, overwrite: bool = False) -> dict[Path, Path]:
    """Return the source of each recording to write: one, or one per scenario of a folder of ScenarioNet.

    Raises InputError: the source does not exist, or an output exists already.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder")
    if format == "scenarionet" and source.is_dir():
        if out.suffix == ".mcap" or out.is_file():
            raise InputError(f"{out}: expected a folder for the recordings of one, found a file's name")
        asked = {out / f"{name}.mcap": path for name, path in scenarios(source).items()}
    else:
        if out.suffix != ".mcap":
            raise InputError(f"{out}: expected an output that ends in .mcap, found {out.name!r}")
        asked = {out: source}
    there = [path for path in asked if path.is_file()]
    if there and not overwrite:
        more = f", and {counted(len(there) - 1, 'other')}" if len(there) > 1 else ""
        raise InputError(f"{there[0]}: is there already{more}; give another name, or --overwrite")
    return asked


@dataclass
class Conversion:
    """What the notes and errors of all recordings of one command add up to."""

    asked: int = 0  # recordings
    done: int = 0
    wrong: list[str] = field(default_factory=list)  # a line per problem
    notes: Counter[tuple[str, str]] = field(default_factory=Counter)  # (noun, what): how many
    assumed: Counter[str] = field(default_factory=Counter)  # line: recordings
    numbered: bool = False  # ids are not the names of the source

    def add(self, report: Report) -> None:
        """Take in the report of a recording that was written."""
        self.done += 1
        self.notes += report.counts
        self.assumed.update(list(report.assumed))
        self.numbered |= any(name != str(ident) for ident, name in report.names.items())

    def note_lines(self) -> list[str]:
        """What was skipped, assumed or put right, a line each."""
        many = self.asked > 1
        lines = [f"{line} ({counted(n, 'recording')})" if many else line for line, n in self.assumed.items()]
        if len(lines) > _MOST_LINES:
            more = len(lines) - _MOST_LINES
            lines[_MOST_LINES:] = [f"… and {more} more; the metadata record {RECORD} of each has all"]
        lines += [f"{counted(number, noun)} {what}" for (noun, what), number in self.notes.items()]
        if self.numbered:
            lines.append(f"objects are numbered; the file's metadata record {RECORD} has their names")
        return lines

    def problem_lines(self) -> list[str]:
        """What is wrong, a line each, and of many recordings how many are missing."""
        lines = self.wrong[:_MOST_LINES]
        if len(self.wrong) > _MOST_LINES:
            lines.append(f"… and {len(self.wrong) - _MOST_LINES} more")
        if self.wrong and self.asked > 1:
            lines.append(f"{self.asked - self.done} of {counted(self.asked, 'scenario')} not converted")
        return lines


def convert_all(
    asked: Mapping[Path, Path], conversion: Conversion, *, format: str, options: Mapping[str, Any] | None = None
) -> Iterator[str]:
    """Convert every source of `asked` to its output and yield a line per recording, as soon as it is written.

    `conversion` takes up the notes, and the problems of sources that cannot be converted; the others are converted
    all the same. Nothing further is tried once an output cannot be written.
    """
    conversion.asked = len(asked)
    for output, source in asked.items():
        try:
            report = convert(source, output, format=format, options=options)
        except InputError as error:
            conversion.wrong += error.problems
            continue
        except OutputError as error:
            conversion.wrong += error.problems
            break
        conversion.add(report)
        objects = ", ".join(f"{many} {name}" for name, many in sorted(report.objects.items()))
        yield f"{output}: {counted(report.frames, 'frame')}, {objects}"
