"""Transmit: when the receiver has each list. Latency comes on top exactly, no rounding to a tick.

A modelled unit sends a list when it is captured, a recorded one when it was recorded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from copem_replay.core.tracks import Tracks


def transmit(seen: Tracks, latency_of: Callable[[str], float]) -> Tracks:
    """The same tracks with the arrival times of their lists: `latency_of(unit's name)` in seconds, inf: never."""
    latency_s = np.array([latency_of(name) for name in seen.units] or [0.0])
    return replace(seen, arrives_s=seen.arrives_s + latency_s[seen.frame_unit_ix])
