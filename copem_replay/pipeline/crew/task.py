"""What a worker is asked and what it answers: text and paths out, keys of pieces back.

A task is one log with some of its pieces, or none: then the log is surveyed. The worker reads the log itself and keeps
the pieces itself (`worker.py`); rows, recordings and modules are never sent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from copem_replay.experiment.validate import Refused
from copem_replay.io.together import Place


@dataclass(frozen=True)
class LogTask:
    """A log as a worker finds it. `experiment`: of the study, with the settings of this log alone, as JSON."""

    name: str
    place: Place
    experiment: str
    folder: str  # in which the command was typed, which paths are relative to
    pieces: str
    fingerprint: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Work:
    """Pieces of one range of runs; `runs` None: closed forms. `at`: which point of the study (0: the study itself)."""

    at: int
    runs: tuple[int, int] | None
    keys: Mapping[str, str]  # of the pieces, by configuration
    rows: int = 0
    cells: int = 0


@dataclass(frozen=True)
class Task:
    """What a worker is sent. Without `work` the log is surveyed: read, checked, and what is known of it kept."""

    log: LogTask
    work: tuple[Work, ...] = ()

    @property
    def keys(self) -> list[str]:
        """Of its pieces."""
        return [key for work in self.work for key in work.keys.values()]

    @property
    def rows(self) -> int:
        """Rows of its pieces."""
        return sum(work.rows for work in self.work)

    @property
    def about_s(self) -> float:
        """About how long it takes (measured on one core: 10 M cells and 150 k rows a second)."""
        return sum(work.cells / 10e6 + work.rows / 150e3 for work in self.work)


@dataclass(frozen=True)
class Receipt:
    """What a worker answers. Of `refused`, `problems` and `failure` at most one says anything.

    `refused`: why the log cannot be replayed; `problems`: what is wrong with anything else, a line each, `key` where;
    `failure`: the traceback of a defect.
    """

    host: str
    seconds: float
    peak_bytes: int  # the most memory the worker has had so far
    refused: tuple[Refused, ...] = ()
    problems: tuple[str, ...] = ()
    key: tuple[str, ...] = ()
    failure: str | None = None
