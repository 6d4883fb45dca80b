"""`--cluster`: a crew of workers that Dask has, for the time that it is needed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from copem_replay.cli.progress import crew_progress
from copem_replay.cli.terminal import complain, note

if TYPE_CHECKING:
    from copem_replay.pipeline.crew.crew import Crew
    from copem_replay.pipeline.pieces import Pieces


@contextmanager
def crew_at(address: str | None, pieces: Pieces | None) -> Iterator[Crew | None]:
    """The crew at an address; None: there is none. Says what became of workers, and of an interrupted study.

    Raises CopemError: no scheduler there, workers unlike this process, or that do not see the pieces.
    """
    if address is None or pieces is None:
        yield None
        return
    from copem_replay.cli.api.run import workers
    from copem_replay.pipeline.crew.crew import Crew
    from copem_replay.pipeline.crew.dask_workers import DaskWorkers

    hands = DaskWorkers(address, pieces, workers(None))
    try:
        with crew_progress() as tell:
            crew = Crew(hands, pieces, tell)
            yield crew
        note(crew.notes)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(crew.interrupted) from None
    except SystemExit:  # of a signal
        complain([crew.interrupted])
        raise
    finally:
        hands.close()


def hint(took_s: float, cores: int) -> list[str]:
    """What helps where threads take long, and there are many cores."""
    if took_s <= 60 or cores <= 4:
        return []
    return [f"replaying took {took_s:.0f} s; `--cluster local` makes more of {cores} cores: its workers are processes"]
