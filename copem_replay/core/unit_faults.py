"""False and missing parts of the units' lists in one run: for notes and display, no fusion knows of them."""

from __future__ import annotations

from dataclasses import dataclass

from copem_replay.core.tracks import Bool, Int


@dataclass(frozen=True)
class UnitFaults:
    """`ghosts (G,)`: rows of the lists that are about no object. `not_made (F,)`: lists that an outage swallowed."""

    ghosts: Int
    not_made: Bool
