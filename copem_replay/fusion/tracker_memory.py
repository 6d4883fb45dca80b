"""What the tracker remembers of one run: from instant to instant, and from one time chunk of instants to the next."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import CLASSES, Float, Int

TRACK = np.dtype(
    [
        ("state", "f8", (4,)),  # x, y, vx, vy at `at_s`
        ("P", "f8", (4, 4)),
        ("common", "f8", (4, 4)),  # the part of P that may hang together with what is yet to come; 0 without a share
        ("at_s", "f8"),
        ("ee", "f8"), ("en", "f8"), ("nn", "f8"),  # R of the entry heard last
        ("z_m", "f8"),  # z and yaw of the newest entry
        ("yaw_rad", "f8"),
        ("length_m", "f8"),  # sums over all entries, sizes and class
        ("width_m", "f8"),
        ("height_m", "f8"),
        ("class_probability", "f8", (len(CLASSES),)),
        ("class_ix", "i8"),  # the most probable
        ("count", "i8"),  # of entries
        ("first_s", "f8"),  # captures of the first and the last list in support
        ("last_s", "f8"),
        ("unit_ix", "i8"),  # the unit that founded it
        ("track_id", "i8"),
    ]
)  # fmt: skip
CLAIM = np.dtype([("existence", "f8"), ("at_s", "f8")])
"""The newest thing a unit said of a track, and since when that fades: its capture (`stale`: when it was heard). Nothing
yet: 0, −inf."""


class Memory(NamedTuple):
    """What is remembered from one instant to the next; tracks stand in the order in which they were founded."""

    tracks: NDArray[Any]  # (T,) of TRACK
    claims: NDArray[Any]  # (T, U) of CLAIM
    together_s: Float  # (T, T) when one list last held both; −inf: never


class Remembered(NamedTuple):
    """What is remembered from one time chunk of instants to the next. `heard` and `before` are of `late: replay` alone.

    The memory before all lists captured at one instant is the same: it is there once, instant after instant, that of
    instant b the next `sizes[b]` of `tracks` and `claims`, and their square of `together_s`.
    """

    memory: Memory
    heard: Int  # (H,) the lists heard of late, in order
    sizes: Int  # (B,)
    tracks: NDArray[Any]  # (Σ sizes,) of TRACK
    claims: NDArray[Any]  # (Σ sizes, U) of CLAIM
    together_s: Float  # (Σ sizes²,)


def nothing_yet(units: int) -> Remembered:
    """Before the first instant."""
    memory = Memory(np.empty(0, TRACK), np.empty((0, units), CLAIM), np.empty((0, 0)))
    none = np.empty(0, np.int64)
    return Remembered(memory, none, none, memory.tracks, memory.claims, np.empty(0))


@nb.njit(cache=True, nogil=True)
def recalled(so_far: Remembered, captured_s: Float) -> tuple[Memory, list[Memory], Int]:
    """The memory, to be changed at will, the memories before each of the lists heard of late, and these lists."""
    memory = _copied(so_far.memory)
    before = [memory]
    before.pop()
    track = pair = b = 0
    for h in range(len(so_far.heard)):
        if h > 0 and captured_s[so_far.heard[h]] == captured_s[so_far.heard[h - 1]]:
            before.append(before[h - 1])
            continue
        n = so_far.sizes[b]
        together_s = so_far.together_s[pair : pair + n * n].copy().reshape(n, n)
        before.append(
            Memory(so_far.tracks[track : track + n].copy(), so_far.claims[track : track + n].copy(), together_s)
        )
        track, pair, b = track + n, pair + n * n, b + 1
    return memory, before, so_far.heard.copy()


@nb.njit(cache=True, nogil=True)
def remembered(memory: Memory, before: list[Memory], heard: Int, captured_s: Float) -> Remembered:
    """The same to be kept."""
    first = np.empty(len(heard), np.int64)
    instants = tracks = pairs = 0
    for h in range(len(heard)):
        if h == 0 or captured_s[heard[h]] != captured_s[heard[h - 1]]:
            first[instants] = h
            n = len(before[h].tracks)
            instants, tracks, pairs = instants + 1, tracks + n, pairs + n * n
    kept = Remembered(
        memory, heard.copy(), np.empty(instants, np.int64), np.empty(tracks, TRACK),
        np.empty((tracks, memory.claims.shape[1]), CLAIM), np.empty(pairs),
    )  # fmt: skip
    track = pair = 0
    for b in range(instants):
        one = before[first[b]]
        n = len(one.tracks)
        kept.sizes[b] = n
        kept.tracks[track : track + n], kept.claims[track : track + n] = one.tracks, one.claims
        kept.together_s[pair : pair + n * n] = one.together_s.copy().reshape(n * n)
        track, pair = track + n, pair + n * n
    return kept


@nb.njit(cache=True, nogil=True)
def _copied(memory: Memory) -> Memory:
    return Memory(memory.tracks.copy(), memory.claims.copy(), memory.together_s.copy())
