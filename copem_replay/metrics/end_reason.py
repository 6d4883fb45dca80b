"""Why observation of an object ended, as the column `ended_by` says it."""

from __future__ import annotations

from enum import Enum

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Bool, Int


class EndReason(Enum):
    """Why observation of an object ended; the value is what `ended_by` holds."""

    OBJECT_LEFT = "object_left"
    EGO_LEFT = "ego_left"
    LOG_END = "log_end"

    @property
    def censors(self) -> bool:
        """Whether the object could still have been detected. An object that leaves undetected is never detected."""
        return self is not EndReason.OBJECT_LEFT

    @property
    def label(self) -> str:
        """Two words for figures."""
        return _WORDS[self][0]

    @property
    def past(self) -> str:
        """A clause about the object, in the past tense."""
        return _WORDS[self][1]


_WORDS = {
    EndReason.OBJECT_LEFT: ("object leaves", "it left"),
    EndReason.EGO_LEFT: ("ego leaves", "the ego left"),
    EndReason.LOG_END: ("log ends", "the log ended"),
}
END_REASONS = tuple(EndReason)
"""What positions such as `Episodes.ended_by` count in."""
COMPETES = tuple(reason.value for reason in END_REASONS if not reason.censors)
"""Texts of the reasons that are no censoring."""


def texts_of(position: Int) -> np.ndarray:
    """(n,) texts, as `ended_by` holds them, of positions (n,)."""
    return np.array([reason.value for reason in END_REASONS], dtype=object)[position]


def competes(ended_by: pd.Series) -> Bool:
    """(n,) whether texts (n,) are those of a reason that is no censoring."""
    found: Bool = ended_by.isin(COMPETES).to_numpy(dtype=bool)
    return found
