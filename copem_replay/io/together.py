"""Several recordings of one drive: which files, and how far the clock of each is ahead of the first one's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

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


Place: TypeAlias = Path | Together
"""Where a log lies: in one recording, or in several."""


def first_of(place: Place) -> Path:
    """The recording that a log is called after."""
    return place if isinstance(place, Path) else place.paths[0]
