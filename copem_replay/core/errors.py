"""The errors a user can meet.

    CopemError
    ├── InputError            what was given is wrong: one line per problem, exit code 2
    │   ├── ExperimentError   … in an experiment file (file:line: key: …)
    │   └── RecordingError    … in a recording (file: …)
    │       ├── EgoError
    │       └── EmptyWindowError
    └── OutputError           what was asked for cannot be written, exit code 2

Anything else that escapes is a defect of this project: traceback, exit code 70.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from copem_replay.core.remote import Remote


def printable(text: str) -> str:
    """On one line, and without what a terminal would act on: names in a recording may hold anything."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class CopemError(Exception):
    """Base of all errors that are not defects.

    `problems` holds one line each: where, what was expected, what was found, what to do.

    >>> try:
    ...     cr.load_experiment({"version": 1, "runs": 0})
    ... except cr.CopemError as error:
    ...     print(error)
    experiment: runs: expected at least 1, found 0
    experiment: configurations: missing
    """

    def __init__(self, problems: str | Sequence[str]) -> None:
        lines = (problems,) if isinstance(problems, str) else problems
        self.problems: tuple[str, ...] = tuple(printable(line) for line in lines)
        super().__init__("\n".join(self.problems))


class InputError(CopemError):
    """The input is wrong: an experiment, a recording, results, or an argument.

    >>> cr.load_results("nowhere")
    Traceback (most recent call last):
    copem_replay.core.errors.InputError: nowhere: expected a results folder, found no such folder; ...
    """


class ExperimentError(InputError):
    """An experiment is wrong, or does not fit its recordings.

    >>> cr.load_experiment("nowhere.yaml")
    Traceback (most recent call last):
    copem_replay.core.errors.ExperimentError: nowhere.yaml: no such file
    """


class RecordingError(InputError):
    """A recording cannot be read or replayed.

    Each of `problems` reads `path: topic: reason`. `path`: the file or folder, `topic`: where in it, `reasons`: what is
    wrong, a line each, without either. `key`: the key of an experiment file that asks in vain, () where none does.

    >>> cr.read_recording("logs/tc016d.mcap", ego="99")
    Traceback (most recent call last):
    copem_replay.core.errors.EgoError: logs/tc016d.mcap: ego: no moving object '99'; there are 1 (car), ...
    """

    _about: str | None = None

    def __init__(
        self,
        reasons: str | Sequence[str],
        *,
        path: Path | Remote | None = None,
        topic: str | None = None,
        key: tuple[str | int, ...] = (),
    ) -> None:
        self.reasons = (reasons,) if isinstance(reasons, str) else tuple(reasons)
        self.path, self.topic, self.key = path, topic, key
        super().__init__(self._lines(path, topic))

    def _lines(self, path: Path | Remote | None, topic: str | None) -> list[str]:
        where = "".join(f"{place}: " for place in (path, topic, self._about) if place is not None)
        return [f"{where}{reason}" for reason in self.reasons]

    def within(self, path: Path, topic: str | None = None) -> list[str]:
        """Return the problems without the path and topic that are these, for messages that name them already."""
        lines = self._lines(None if self.path == path else self.path, None if self.topic == topic else self.topic)
        return [printable(line) for line in lines]


class EgoError(RecordingError):
    """The ego that is asked for is not in the recording; the line names `ego` as its place."""

    _about = "ego"

    def __init__(self, reasons: str | Sequence[str], *, path: Path) -> None:
        super().__init__(reasons, path=path, key=("ego",))


class EmptyWindowError(RecordingError):
    """The window holds no message of the truth.

    >>> cr.read_recording("logs/tc016d.mcap", window_s=(60, None))
    Traceback (most recent call last):
    copem_replay.core.errors.EmptyWindowError: logs/tc016d.mcap: ...
    """


class OutputError(CopemError):
    """A result cannot be written to its place.

    >>> cr.write_report("out/tc016d", "report.pdf")
    Traceback (most recent call last):
    copem_replay.core.errors.OutputError: report.pdf: expected a name that ends with .html or .htm, found report.pdf
    """
