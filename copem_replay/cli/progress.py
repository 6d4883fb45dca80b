"""Progress of what takes long: a bar on a terminal; elsewhere a line a minute, after the first minute."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import TypeVar

from copem_replay.cli.terminal import complain
from copem_replay.core.text import counted

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


def duration(time_s: float) -> str:
    """A time in words that are exact enough for waiting: `40 seconds`, `3 minutes`, `2 h 10 min`."""
    if time_s < _MINUTE_S:
        return counted(max(1, round(time_s)), "second")
    minutes = round(time_s / _MINUTE_S)
    if time_s < _HOUR_S:
        return counted(minutes, "minute")
    return f"{minutes // 60} h {minutes % 60} min"
