"""Where a log lies: in a file, in several of one drive with clocks of their own, or elsewhere, under a URL."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias, overload

from copem_replay.core.remote import Remote

AHEAD: Final = "copem_replay:clock_ahead_ns"
"""Metadata of a channel whose stamps are by a clock that is ahead of that of the log times, and by how much."""

PART: Final = "copem_replay:recording"
"""Metadata of a channel that was written from several recordings: which of them it is of."""


@dataclass(frozen=True)
class Together:
    """Recordings that are read as one; `ahead_s`: of each clock against the first one's, which is 0."""

    paths: tuple[Path, ...]
    ahead_s: tuple[float, ...]

    def __str__(self) -> str:
        return " + ".join(map(str, self.paths))

    @property
    def ahead_ns(self) -> tuple[int, ...]:
        """The same in nanoseconds."""
        return tuple(round(ahead_s * 1e9) for ahead_s in self.ahead_s)


Local: TypeAlias = Path | Together
"""What can be opened: one recording, or several."""
File: TypeAlias = Path | Remote
Place: TypeAlias = Local | Remote
"""Where a log lies."""


def paths_of(place: Place) -> tuple[File, ...]:
    """The recordings that a log is made of."""
    return place.paths if isinstance(place, Together) else (place,)


@overload
def first_of(place: Local) -> Path: ...
@overload
def first_of(place: Place) -> File: ...
def first_of(place: Place) -> File:
    """The recording that a log is called after."""
    return place.paths[0] if isinstance(place, Together) else place


@contextmanager
def at_hand(place: Place) -> Iterator[Local]:
    """The place itself; of what lies elsewhere a copy in a scratch folder, which is deleted afterwards.

    Raises InputError.
    """
    if not isinstance(place, Remote):
        yield place
        return
    with tempfile.TemporaryDirectory(prefix="copem-replay-") as folder:
        copy = Path(folder) / place.name
        place.fetch(str(copy))
        yield copy
