"""What a decoder hands to reading: the object lists of one topic as flat columns.

Nothing is corrected here, and nothing is in order of time yet: rows are as the messages have them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Bool, Float, Int, Solid

FARTHEST_M = 1e7
"""A coordinate beyond is no position (chosen; UTM northings end at 1e7)."""
LAST_NS = 4_000_000_000 * 10**9
"""A later time is none (chosen: Unix time of 2096; differences of such times still fit 64 bits)."""

X, Y, Z, YAW, VX, VY = range(6)
"""Columns of `values`, the first of `tracks.VALUES`."""


@dataclass(frozen=True)
class DecodedObjects:
    """The lists of one topic: F messages in the order read, P rows message by message, N objects.

    `values` are in the units and the frame of reference of `Tracks`, columns in the order of `tracks.VALUES`;
    NaN where the message does not say (or says NaN).
    """

    stamp_ns: Int  # (F,)
    stamped: Bool  # (F,) False: the message says no time, `stamp_ns` is when it was logged
    rows: Int  # (F,) how many rows each message has
    object_ids: tuple[str, ...]  # N
    moving: Bool  # (N,)
    object_ix: Int  # (P,) index into object_ids
    class_ix: NDArray[np.int8]  # (P,) index into CLASSES
    values: Float  # (P, len(VALUES))
    lane_boundaries: tuple[Float, ...] = ()  # (K, 3) each, in the truth's frame of reference: for showing only
    solids: tuple[Solid, ...] = ()  # in that frame, too
    hosts: tuple[str, ...] = ()  # the host vehicle's id, once per message that says one
    notes: tuple[str, ...] = ()  # a line per kind of thing that was skipped or filled in
