"""The errors a user can meet.

    CopemError
    ├── InputError            what was given is wrong: one line per problem, exit code 2
    │   ├── ExperimentError   … in an experiment file (file:line: key: …)
    │   └── RecordingError    … in a recording (file: …)
    │       └── EmptyWindowError
    └── OutputError           what was asked for cannot be written, exit code 2

Anything else that escapes is a defect of this project: traceback, exit code 70.
"""

from __future__ import annotations

from collections.abc import Sequence

from copem_replay.core.text import printable


class CopemError(Exception):
    """Base of all errors that are not defects.

    `problems` holds one line each: where, what was expected, what was found, what to do.
    """

    def __init__(self, problems: str | Sequence[str]) -> None:
        lines = (problems,) if isinstance(problems, str) else problems
        self.problems: tuple[str, ...] = tuple(printable(line) for line in lines)
        super().__init__("\n".join(self.problems))


class InputError(CopemError):
    """What was given is wrong."""


class ExperimentError(InputError):
    """An experiment file is wrong."""


class RecordingError(InputError):
    """A recording cannot be read or replayed."""


class EmptyWindowError(RecordingError):
    """Nothing of a recording is in the window that was asked for."""


class OutputError(CopemError):
    """A result cannot be written where it was asked for."""
