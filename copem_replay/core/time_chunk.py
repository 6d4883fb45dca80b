"""A part of a log in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TimeChunk:
    """Instants from `from_s` on and before `until_s`, in seconds of the log."""

    from_s: float = -np.inf
    until_s: float = np.inf


WHOLE = TimeChunk()
