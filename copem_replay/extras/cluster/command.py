"""`run --cluster`: Dask processes as a crew of workers, for as long as the study is read and computed; its progress."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from copem_replay.api.run import count_workers
from copem_replay.cli.terminal import EVERY_S, TimeLeft, print_notes, print_problems
from copem_replay.core.errors import count_noun
from copem_replay.extras.cluster.crew import Crew, CrewProgress
from copem_replay.extras.cluster.dask_workers import connect_workers

if TYPE_CHECKING:
    from copem_replay.pipeline.parts import PartCache


@contextmanager
def connect_crew(address: str, parts: PartCache) -> Iterator[Crew]:
    """The crew at an address. Prints what became of its workers, also after an interrupt. Raises CopemError: no
    scheduler at the address, workers of another version, or workers that do not see the parts.
    """
    with connect_workers(address, parts, count_workers(None)) as workers:
        try:
            with show_crew_progress() as show:
                crew = Crew(workers, parts, show)
                yield crew
            print_notes(crew.notes)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(crew.interrupted) from None
        except SystemExit:  # of a signal
            print_problems([crew.interrupted])
            raise


@contextmanager
def show_crew_progress() -> Iterator[Callable[[CrewProgress], None]]:
    """A function that shows a crew's progress on stderr: as a bar in a terminal, else as lines."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield CrewProgressLines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    lines = CrewProgressLines()
    with Bar(BarColumn(), TextColumn("{task.description}"), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)

        def show(progress: CrewProgress) -> None:
            words = lines.words(progress)
            bar.update(task, completed=progress.done, total=progress.total, description=words)

        yield show


class CrewProgressLines:
    """Progress of a crew in lines: `replaying: 412 of 5000 logs, 9 minutes left, 1 worker lost`."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._what, self._left = clock, "", TimeLeft()
        self._printed_s = clock()

    def __call__(self, progress: CrewProgress) -> None:
        """Print a line if the last one is at least `EVERY_S` old."""
        words = self.words(progress)
        if self._clock() - self._printed_s >= EVERY_S and progress.done < progress.total:
            self._printed_s = self._clock()
            print_problems([words])

    def words(self, progress: CrewProgress) -> str:
        """The progress in one line; the time left is that of this kind of work."""
        if progress.what != self._what:
            self._what, self._left = progress.what, TimeLeft()
        parts = [f"{progress.what}: {progress.done} of {count_noun(progress.total, 'log')}"]
        parts += self._left.words(self._clock(), progress.done, progress.total)
        if progress.lost:
            parts.append(f"{count_noun(progress.lost, 'worker')} lost")
        return ", ".join(parts)
