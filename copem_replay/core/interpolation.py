"""Interpolation: states between recorded frames, turning in space, and tables over two axes.

A state between two frames of an object is interpolated linearly (yaw the short way round) over at most
`max_gap_s`; in a longer gap the object is absent, and so it is before its first frame and after its last.
Within 1 µs of a frame the recorded state itself is taken.

Only where a list states another instant than that of its capture, an object that was there at the capture is there at
the stated instant, too: its nearest recorded state is moved by its velocity (`interpolate_at_stated_instants`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS, VALUES, Bool, Float, Int, Tracks, splice_rows

_AT_ONCE = 1 << 20
"""States interpolated at a time: arrays of 8 MB each, however long the log. No result depends on it."""
AROUND_S = 1e-3
"""Seconds by which a stretch of a log is widened before it is cut: more than all tolerances of time together."""


def interpolate_at_instants(truth: Tracks, stamps_ns: Int, *, t0_ns: int, max_gap_s: float) -> Tracks:
    """The world at instants `stamps_ns (F,)`, ascending: one list per instant, of all objects present."""
    own_frames = _find_own_frames(truth, stamps_ns, max_gap_s)
    captured_s: Float = (stamps_ns - t0_ns) * np.float64(1e-9)
    if own_frames is not None:
        return truth if len(own_frames) == len(truth.stamp_ns) else _take_frames(truth, own_frames, captured_s)
    truth = _cut_around(truth, captured_s, max_gap_s)
    first, last = _track_ends(truth)
    lo = np.searchsorted(stamps_ns, first - SAME_INSTANT_NS, side="left")
    hi = np.searchsorted(stamps_ns, last + SAME_INSTANT_NS, side="right")
    counts = np.maximum(hi - lo, 0)
    track = np.repeat(np.arange(len(counts)), counts)
    frame = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(lo, counts)
    states, present = _interpolate(truth, track, stamps_ns[frame], max_gap_s)
    columns: dict[str, Any] = {name: column[None, present] for name, column in states.items()}
    track, frame = track[present], frame[present]
    lengths = np.bincount(track, minlength=len(counts))
    has_rows = lengths > 0
    return replace(
        truth,
        start=np.concatenate([[0], np.cumsum(lengths[has_rows])]),
        unit_ix=truth.unit_ix[has_rows],
        object_ix=truth.object_ix[has_rows],
        frame_ix=frame,
        stamp_ns=np.asarray(stamps_ns, dtype=np.int64),
        captured_s=captured_s,
        frame_unit_ix=np.zeros(len(stamps_ns), dtype=np.int64),
        arrives_s=captured_s[None],
        valid=np.ones((1, len(frame)), dtype=bool),
        **columns,
    )


def interpolate_at_stated_instants(
    truth: Tracks, stamps_ns: Int, captured_ns: tuple[Int, Int], *, t0_ns: int, max_gap_s: float
) -> Tracks:
    """The world at instants `stamps_ns (F,)`, ascending, that lists state, whose captures are others.

    `captured_ns`: the earliest and the latest capture (F,) of the lists that state each instant. An object that is
    there at the capture, but not at the stated instant, has the first state after it moved back by its velocity, or
    the last state before it moved on, by at most `max_gap_s`. All else is as in `interpolate_at_instants`.
    """
    world = interpolate_at_instants(truth, stamps_ns, t0_ns=t0_ns, max_gap_s=max_gap_s)
    truth = _cut_around(truth, world.captured_s, max_gap_s)
    if not len(truth.frame_ix):
        return world
    row, frame = _select_beyond_stays(truth, stamps_ns, captured_ns, int(max_gap_s * 1e9))
    return splice_rows([world, _extrapolate_states(truth, world, row, frame)])[0] if len(row) else world


def _select_beyond_stays(
    truth: Tracks, stamps_ns: Int, captured_ns: tuple[Int, Int], max_gap_ns: int
) -> tuple[Int, Int]:
    """Where states are moved: from which rows (K,) of the truth, to which instants (K,), by track and instant."""
    own_ns = truth.stamp_ns[truth.frame_ix]
    apart = np.diff(own_ns) > max_gap_ns + SAME_INSTANT_NS
    apart[truth.start[1:-1] - 1] = True
    first, last = np.flatnonzero(np.append(True, apart)), np.flatnonzero(np.append(apart, True))
    earliest_ns, latest_ns = captured_ns
    pairs = []
    for row, from_ns, until_ns in (
        (first, own_ns[first] - max_gap_ns, own_ns[first] - SAME_INSTANT_NS),
        (last, own_ns[last] + SAME_INSTANT_NS + 1, own_ns[last] + max_gap_ns + 1),
    ):
        begin, after = np.searchsorted(stamps_ns, from_ns), np.searchsorted(stamps_ns, until_ns)
        counts = np.maximum(after - begin, 0)
        rows = np.repeat(row, counts)
        frames = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(begin, counts)
        back = stamps_ns[frames] < own_ns[rows]
        captured_there = np.where(
            back,
            latest_ns[frames] >= own_ns[rows] - SAME_INSTANT_NS,
            earliest_ns[frames] <= own_ns[rows] + SAME_INSTANT_NS,
        )
        pairs.append(np.stack([rows[captured_there], frames[captured_there]]))
    rows, frames = np.concatenate(pairs, axis=1)
    # In a gap both of its ends may be near: the nearer one counts, of two as near the earlier.
    order = np.lexsort((rows, np.abs(stamps_ns[frames] - own_ns[rows]), frames, truth.track_ix[rows]))
    rows, frames = rows[order], frames[order]
    track = truth.track_ix[rows]
    new = (np.diff(track, prepend=-1) != 0) | (np.diff(frames, prepend=-1) != 0)
    return rows[new], frames[new]


def _extrapolate_states(truth: Tracks, world: Tracks, row: Int, frame: Int) -> Tracks:
    """Rows (K,) of the truth in lists (K,) of the world, by track and list: moved to its instants by their velocity."""
    values = {name: getattr(truth, name)[:, row] for name in VALUES}
    elapsed_s = (world.stamp_ns[frame] - truth.stamp_ns[truth.frame_ix[row]]) * 1e-9
    values["x_m"] = values["x_m"] + values["vx_mps"] * elapsed_s
    values["y_m"] = values["y_m"] + values["vy_mps"] * elapsed_s
    track, start = np.unique(truth.track_ix[row], return_index=True)
    return replace(
        world,
        start=np.append(start, len(row)),
        unit_ix=truth.unit_ix[track],
        object_ix=truth.object_ix[track],
        frame_ix=frame,
        valid=np.ones((1, len(row)), dtype=bool),
        **values,
    )


def _find_own_frames(truth: Tracks, stamps_ns: Int, max_gap_s: float) -> Int | None:
    """Which of the truth's own frames these instants are (F,); None: not all are, or an object is between two then."""
    frames: Int = np.searchsorted(truth.stamp_ns, stamps_ns)
    own = np.array_equal(truth.stamp_ns[frames[frames < len(truth.stamp_ns)]], stamps_ns)
    if not own or (np.diff(frames) < 1).any() or (np.diff(truth.stamp_ns) <= 2 * SAME_INSTANT_NS).any():
        return None
    after_miss = truth.frame_ix[truth.rows_after_miss]
    gap_ns = truth.stamp_ns[after_miss] - truth.stamp_ns[truth.frame_ix[truth.rows_after_miss - 1]]
    return None if (gap_ns <= max_gap_s * 1e9 + SAME_INSTANT_NS).any() else frames


def _take_frames(truth: Tracks, frames: Int, captured_s: Float) -> Tracks:
    """Only some of the truth's frames (F,), ascending, and the rows in them."""
    rows = truth.rows_between(frames[0], frames[-1] + 1) if len(frames) else frames
    number = np.full(len(truth.stamp_ns), -1)
    number[frames] = np.arange(len(frames))
    rows = rows[number[truth.frame_ix[rows]] >= 0]
    return replace(
        truth.take_rows(rows),
        frame_ix=number[truth.frame_ix[rows]],
        stamp_ns=truth.stamp_ns[frames],
        captured_s=captured_s,
        frame_unit_ix=np.zeros(len(frames), dtype=np.int64),
        arrives_s=captured_s[None],
    )


def _cut_around(truth: Tracks, captured_s: Float, max_gap_s: float) -> Tracks:
    """The part of the truth that interpolation at instants (F,), ascending, needs."""
    around_s = max_gap_s + AROUND_S
    return truth.captured_between(captured_s[0] - around_s, captured_s[-1] + around_s) if len(captured_s) else truth


def interpolate_states(
    truth: Tracks, object_ix: Int, time_s: Float, *, t0_ns: int, max_gap_s: float
) -> tuple[dict[str, Float], Bool]:
    """States of objects (K,) at times (K,): one column (K,) per value, and whether the object is present."""
    # One place more than there are objects: index −1, no truth id, has no track.
    track_of = np.full(int(max(object_ix.max(initial=-1), truth.object_ix.max(initial=-1))) + 2, -1)
    track_of[truth.object_ix] = np.arange(len(truth.object_ix))
    track = track_of[object_ix]
    stamp_ns = t0_ns + np.rint(time_s * 1e9).astype(np.int64)
    return _interpolate(truth, track, stamp_ns, max_gap_s)


def _track_ends(truth: Tracks) -> tuple[Int, Int]:
    """(E,) first and last stamp of each track."""
    return truth.stamp_ns[truth.frame_ix[truth.start[:-1]]], truth.stamp_ns[truth.frame_ix[truth.start[1:] - 1]]


def _interpolate(truth: Tracks, track: Int, stamp_ns: Int, max_gap_s: float) -> tuple[dict[str, Float], Bool]:
    """Columns (K,) of the state of tracks (K,) at stamps (K,), and presence (K,). NaN where absent."""
    columns = {name: np.full(len(track), np.nan) for name in VALUES}
    present: Bool = np.zeros(len(track), dtype=bool)
    if len(track) == 0 or len(truth.frame_ix) == 0:
        return columns, present
    asked = np.bincount(track + 1, minlength=len(truth.object_ix) + 1)[1:] > 0
    if 2 * asked.sum() < len(asked) and asked.any():  # the rows of others cost time and memory
        number = np.append(np.cumsum(asked) - 1, -1)
        return _interpolate(truth.take_tracks(asked), number[track], stamp_ns, max_gap_s)
    own_ns = truth.stamp_ns[truth.frame_ix]
    # One sorted axis for all tracks: each gets its own stretch, long enough for the whole log.
    origin, stretch = own_ns.min(), int(np.ptp(own_ns)) + 10 * SAME_INSTANT_NS
    axis = own_ns - origin + truth.track_ix * stretch
    ends = _track_ends(truth)
    for begin in range(0, len(track), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        states, present[part] = _interpolate_rows(truth, own_ns, axis, ends, track[part], stamp_ns[part], max_gap_s)
        for name, values in states.items():
            columns[name][part] = values
    return columns, present


def _interpolate_rows(
    truth: Tracks, own_ns: Int, axis: Int, ends: tuple[Int, Int], track: Int, stamp_ns: Int, max_gap_s: float
) -> tuple[dict[str, Float], Bool]:
    """Columns (K,) of the state, NaN where absent, and presence (K,), as `_interpolate` joins them.

    `own_ns (P,)`: stamps of rows; `axis (P,)`: the axis they are sorted on, ascending over all tracks.
    """
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
            step = wrap_angles(step)
        value = values[before] + weight * step
        columns[name] = np.where(present, np.where(exact, values[before], value), np.nan)
    columns["yaw_rad"] = np.where(exact, columns["yaw_rad"], wrap_angles(columns["yaw_rad"]))
    return columns, present


def wrap_angles(angle_rad: Float) -> Float:
    """Angles brought to (−π, π]."""
    return np.pi - np.mod(np.pi - angle_rad, 2 * np.pi)


# Rotations as unit quaternions (K, 4), or (4,): x, y, z, w. scipy.spatial has them, too, but its import takes as long
# as reading a small recording.


def rotate_vectors(rotation: Float, vector: Float) -> Float:
    """Vectors (K, 3), turned by a rotation each, or all by one."""
    axis, w = rotation[..., :3], rotation[..., 3:]
    across = np.cross(axis, vector)
    result: Float = vector + 2.0 * (w * across + np.cross(axis, across))
    return result


def compose_rotations(outer: Float, inner: Float) -> Float:
    """The rotation (K, 4) by `inner`, then by `outer`."""
    a, b, v, w = outer[..., :3], inner[..., :3], outer[..., 3:], inner[..., 3:]
    axis = v * b + w * a + np.cross(a, b)
    return np.concatenate([axis, v * w - (a * b).sum(axis=-1, keepdims=True)], axis=-1)


def invert_rotation(rotation: Float) -> Float:
    """The inverse rotation."""
    result: Float = rotation * np.array([-1.0, -1.0, -1.0, 1.0])
    return result


def yaw_of(rotation: Float) -> Float:
    """(K,) headings, radians, (−π, π]."""
    x, y, z, w = rotation.T
    yaw: Float = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


# Tables of numbers over two axes, bilinear between the given values, constant beyond them.

Axis = tuple[str, Sequence[float]]
"""An axis of a table: its name, and its values."""


def check_grid(first: Axis, second: Axis, name: str, rows: Sequence[Sequence[float]]) -> None:
    """Raise ValueError unless both axes increase and `name` has a row for each value of the first, one number each."""
    for axis_name, axis in (first, second):
        if any(b <= a for a, b in pairwise(axis)):
            raise ValueError(f"{axis_name}: expected increasing values, found {list(axis)}")
    expected, widths = (len(first[1]), len(second[1])), {len(row) for row in rows}
    if len(rows) != expected[0] or widths != {expected[1]}:
        raise ValueError(
            f"{name}: expected {expected[0]} rows ({first[0]}) of {expected[1]} values ({second[0]}), "
            f"found {len(rows)} rows of {sorted(widths)}"
        )


def interpolate_bilinear(
    first: Sequence[float], second: Sequence[float], rows: Sequence[Sequence[float]], x: Float, y: Float
) -> Float:
    """(P,) the table at x (P,) on its first axis and y (P,) on its second."""
    table = np.array(rows)
    i, a = locate_on_axis(np.array(first), x)
    j, b = locate_on_axis(np.array(second), y)
    i1, j1 = np.minimum(i + 1, table.shape[0] - 1), np.minimum(j + 1, table.shape[1] - 1)
    low = table[i, j] * (1 - b) + table[i, j1] * b
    high = table[i1, j] * (1 - b) + table[i1, j1] * b
    result: Float = low * (1 - a) + high * a
    return result


def locate_on_axis(axis: Float, value: Float) -> tuple[Int, Float]:
    """Cell (P,) and place within it (P,), 0 … 1, of values on an ascending axis; the ends hold beyond them."""
    if len(axis) == 1:
        return np.zeros(len(value), dtype=int), np.zeros(len(value))
    cell = np.clip(np.searchsorted(axis, value, side="right") - 1, 0, len(axis) - 2)
    return cell, np.clip((value - axis[cell]) / (axis[cell + 1] - axis[cell]), 0.0, 1.0)
