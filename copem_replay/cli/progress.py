"""Progress of what takes long: a bar on a terminal; elsewhere a line a minute, after the first minute."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from copem_replay.cli.terminal import complain
from copem_replay.core.text import counted

if TYPE_CHECKING:
    from copem_replay.pipeline.crew.crew import CrewProgress

T = TypeVar("T")
Progress = Callable[[int, int], None]
EVERY_S = 60.0
"""So often a line is said where there is no terminal, and not before (chosen: a log of an hour is a page)."""
_MINUTE_S, _HOUR_S = 60.0, 3600.0


def with_progress(what: str, work: Callable[[Progress], T]) -> T:
    """Do some work, and say on stderr how far it is: per cent, what is being done, time left."""
    if sys.stderr is None or not sys.stderr.isatty():
        return work(Lines(what))
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    words = "{task.description}", "left"
    columns = (TextColumn(words[0]), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(), TextColumn(words[1]))
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        return work(lambda done, total: bar.update(task, completed=done, total=total))


class Lines:
    """A line a minute for logs and pipes: `replaying: 37 %, 4 minutes left`. `clock`: seconds that only grow."""

    def __init__(self, what: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._what, self._clock = what, clock
        self._begun_s = self._said_s = clock()

    def __call__(self, done: int, total: int) -> None:
        """So many steps of so many are done."""
        now_s = self._clock()
        if now_s - self._said_s < EVERY_S or not 0 < done < total:
            return
        self._said_s = now_s
        left_s = (now_s - self._begun_s) * (total - done) / done
        complain([f"{self._what}: {100 * done // total} %, {duration(left_s)} left"])


@contextmanager
def crew_progress() -> Iterator[Callable[[CrewProgress], None]]:
    """What a crew tells of its progress, said on stderr."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield CrewLines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    lines = CrewLines()
    with Bar(BarColumn(), TextColumn("{task.description}"), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)

        def show(at: CrewProgress) -> None:
            words = lines.words(at)
            bar.update(task, completed=at.done, total=at.total, description=words)

        yield show


class CrewLines:
    """The same in a line a minute: `replaying: 412 of 5000 logs, 83 M rows, 9 minutes left, 1 worker lost`."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._what = clock, ""
        self._begun_s = self._said_s = clock()

    def __call__(self, at: CrewProgress) -> None:
        """Say it, if a minute has gone by."""
        words = self.words(at)
        if self._clock() - self._said_s >= EVERY_S and at.done < at.total:
            self._said_s = self._clock()
            complain([words])

    def words(self, at: CrewProgress) -> str:
        """How far it is, in a line."""
        if at.what != self._what:
            self._what, self._begun_s = at.what, self._clock()
        said = [f"{at.what}: {at.logs_done} of {counted(at.logs, 'log')}"]
        if at.rows_done:
            said.append(f"{_about(at.rows_done)} rows")
        if 0 < at.done < at.total:
            said.append(f"{duration((self._clock() - self._begun_s) * (at.total - at.done) / at.done)} left")
        if at.lost:
            said.append(f"{counted(at.lost, 'worker')} lost")
        return ", ".join(said)


def _about(count: int) -> str:
    """A number in three digits or fewer."""
    for size, letter in ((10**9, " G"), (10**6, " M"), (10**3, " k")):
        if count >= size:
            return f"{count // size}{letter}"
    return str(count)


def duration(time_s: float) -> str:
    """A time in words that are exact enough for waiting: `40 seconds`, `3 minutes`, `2 h 10 min`."""
    if time_s < _MINUTE_S:
        return counted(max(1, round(time_s)), "second")
    minutes = round(time_s / _MINUTE_S)
    if time_s < _HOUR_S:
        return counted(minutes, "minute")
    return f"{minutes // 60} h {minutes % 60} min"
