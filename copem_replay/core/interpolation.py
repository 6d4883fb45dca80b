"""States between recorded frames.

A state between two frames of an object is interpolated linearly (yaw the short way round) over at most
`max_gap_s`; in a longer gap the object is absent, and never is it extended beyond its first or last frame.
Within 1 µs of a frame the recorded state itself is taken.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS, VALUES, Bool, Float, Int, Tracks

_AT_ONCE = 1 << 20
"""States interpolated at a time, for memory's sake (chosen)."""
AROUND_S = 1e-3
"""More than all tolerances of time together."""


def at_instants(truth: Tracks, stamps_ns: Int, *, t0_ns: int, max_gap_s: float) -> Tracks:
    """The world at other instants: one list per instant of `stamps_ns (F,)` (ascending), of all objects then there."""
    if _as_it_is(truth, stamps_ns):
        return truth
    first, last = _ends(truth)
    lo = np.searchsorted(stamps_ns, first - SAME_INSTANT_NS, side="left")
    hi = np.searchsorted(stamps_ns, last + SAME_INSTANT_NS, side="right")
    counts = np.maximum(hi - lo, 0)
    track = np.repeat(np.arange(len(counts)), counts)
    frame = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(lo, counts)
    states, present = _interpolate(truth, track, stamps_ns[frame], max_gap_s)
    columns: dict[str, Any] = {name: column[None, present] for name, column in states.items()}
    track, frame = track[present], frame[present]
    lengths = np.bincount(track, minlength=len(counts))
    kept = lengths > 0
    captured_s: Float = (stamps_ns - t0_ns) * np.float64(1e-9)
    return replace(
        truth,
        start=np.concatenate([[0], np.cumsum(lengths[kept])]),
        unit_ix=truth.unit_ix[kept],
        object_ix=truth.object_ix[kept],
        frame_ix=frame,
        stamp_ns=np.asarray(stamps_ns, dtype=np.int64),
        captured_s=captured_s,
        frame_unit_ix=np.zeros(len(stamps_ns), dtype=np.int64),
        arrives_s=captured_s[None],
        valid=np.ones((1, len(frame)), dtype=bool),
        **columns,
    )


def _as_it_is(truth: Tracks, stamps_ns: Int) -> bool:
    """Whether these are the truth's own frames, and no object misses one of its stay: nothing is in between."""
    if not np.array_equal(stamps_ns, truth.stamp_ns) or (np.diff(stamps_ns) <= 2 * SAME_INSTANT_NS).any():
        return False
    missed = np.diff(truth.frame_ix) != 1
    missed[truth.start[1:-1] - 1] = False
    return not missed.any()


def states_at(
    truth: Tracks, object_ix: Int, time_s: Float, *, t0_ns: int, max_gap_s: float
) -> tuple[dict[str, Float], Bool]:
    """States of objects `(K,)` at times `(K,)`: a column `(K,)` per value, and whether the object is there then."""
    # One place more than there are objects: index −1, no truth id, has no track.
    track_of = np.full(int(max(object_ix.max(initial=-1), truth.object_ix.max(initial=-1))) + 2, -1)
    track_of[truth.object_ix] = np.arange(len(truth.object_ix))
    track = track_of[object_ix]
    stamp_ns = t0_ns + np.rint(time_s * 1e9).astype(np.int64)
    return _interpolate(truth, track, stamp_ns, max_gap_s)


def _ends(truth: Tracks) -> tuple[Int, Int]:
    """(E,) first and last stamp of each track."""
    return truth.stamp_ns[truth.frame_ix[truth.start[:-1]]], truth.stamp_ns[truth.frame_ix[truth.start[1:] - 1]]


def _interpolate(truth: Tracks, track: Int, stamp_ns: Int, max_gap_s: float) -> tuple[dict[str, Float], Bool]:
    """Columns (K,) of the state of tracks (K,) at stamps (K,), and presence (K,). NaN where absent."""
    columns = {name: np.full(len(track), np.nan) for name in VALUES}
    present: Bool = np.zeros(len(track), dtype=bool)
    if len(track) == 0 or len(truth.frame_ix) == 0:
        return columns, present
    own_ns = truth.stamp_ns[truth.frame_ix]
    # One sorted axis for all tracks: each gets its own stretch, long enough for the whole log.
    origin, stretch = own_ns.min(), int(np.ptp(own_ns)) + 10 * SAME_INSTANT_NS
    axis = own_ns - origin + truth.track_ix * stretch
    ends = _ends(truth)
    for begin in range(0, len(track), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        states, present[part] = _between(truth, own_ns, axis, ends, track[part], stamp_ns[part], max_gap_s)
        for name, values in states.items():
            columns[name][part] = values
    return columns, present


def _between(
    truth: Tracks, own_ns: Int, axis: Int, ends: tuple[Int, Int], track: Int, stamp_ns: Int, max_gap_s: float
) -> tuple[dict[str, Float], Bool]:
    """The same of some of them. `own_ns (P,)`: stamps of rows, `axis (P,)`: ascending over all tracks."""
    origin, stretch = own_ns.min(), int(np.ptp(own_ns)) + 10 * SAME_INSTANT_NS
    first, last = ends
    present = (track >= 0) & (stamp_ns >= first[track] - SAME_INSTANT_NS) & (stamp_ns <= last[track] + SAME_INSTANT_NS)
    stamp_ns = np.clip(stamp_ns, first[track], last[track])
    wanted = stamp_ns - origin + track * stretch + SAME_INSTANT_NS
    before = np.searchsorted(axis, wanted, side="right") - 1
    before = np.clip(before, truth.start[track], truth.start[track + 1] - 1)
    after = np.minimum(before + 1, truth.start[track + 1] - 1)
    elapsed_ns, gap_ns = stamp_ns - own_ns[before], own_ns[after] - own_ns[before]
    exact = np.abs(elapsed_ns) <= SAME_INSTANT_NS
    present &= exact | (gap_ns <= max_gap_s * 1e9 + SAME_INSTANT_NS)
    weight = np.where(exact, 0.0, elapsed_ns / np.maximum(gap_ns, 1))
    columns = {}
    for name in VALUES:
        values = getattr(truth, name)[0]
        step = values[after] - values[before]
        if name == "yaw_rad":
            step = wrap(step)
        value = values[before] + weight * step
        columns[name] = np.where(present, np.where(exact, values[before], value), np.nan)
    columns["yaw_rad"] = np.where(exact, columns["yaw_rad"], wrap(columns["yaw_rad"]))
    return columns, present


def wrap(angle_rad: Float) -> Float:
    """Angles brought to (−π, π]."""
    return np.pi - np.mod(np.pi - angle_rad, 2 * np.pi)
