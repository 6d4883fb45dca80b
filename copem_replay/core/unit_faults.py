"""What of the units' lists in one run is false or missing: for telling and showing, no fusion knows of it."""

from __future__ import annotations

from dataclasses import dataclass

from copem_replay.core.tracks import Bool, Int


@dataclass(frozen=True)
class UnitFaults:
    """`ghosts (G,)`: rows of the lists that are about nobody. `not_made (F,)`: lists that an outage swallowed."""

    ghosts: Int
    not_made: Bool
