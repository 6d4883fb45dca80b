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
    """A recording is unreadable, or cannot be replayed.

    >>> cr.read_recording("logs/tc016d.mcap", ego="99")
    Traceback (most recent call last):
    copem_replay.core.errors.RecordingError: logs/tc016d.mcap: ego: no moving object '99'; there are 1 (car), ...
    """


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
