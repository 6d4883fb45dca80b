"""What recordings get wrong about velocities and heights, put right, and said.

Rows are the rows of the truth (P,), track by track (`start (E + 1,)`). Each function returns new columns and
a line for everything it changed.
"""

from __future__ import annotations

import numpy as np

from copem_replay.core.text import counted
from copem_replay.core.tracks import CLASSES, Bool, Float, Int

MAX_GAP_S = 0.5  # no difference is taken across a longer gap (the default of an experiment's `max_gap_s`)
MOVING_MPS = 0.5  # what is faster by its positions cannot stand still (chosen)
FASTEST_MPS = 100.0  # what is faster is no speed (chosen)

# class: (the least plausible height, the typical one) in metres, all chosen
HEIGHTS_M = {
    "pedestrian": (0.8, 1.75),
    "bicycle": (0.8, 1.7),
    "motorcycle": (0.8, 1.6),
    "car": (1.0, 1.5),
    "van": (1.4, 2.0),
    "truck": (1.5, 3.2),
    "bus": (2.0, 3.0),
    "trailer": (0.5, 3.0),
    "animal": (0.2, 0.7),
    "other": (0.05, 1.0),
    "vehicle": (0.5, 1.5),
}
_LEAST_M = np.array([HEIGHTS_M[name][0] for name in CLASSES])
_TYPICAL_M = np.array([HEIGHTS_M[name][1] for name in CLASSES])


def velocities(
    start: Int, time_s: Float, x_m: Float, y_m: Float, vx_mps: Float, vy_mps: Float, moving: Bool
) -> tuple[Float, Float, list[str]]:
    """Velocities (P,) and notes, from those of the messages (NaN: not given); all columns are (P,).

    One not given, above `FASTEST_MPS`, or exactly 0 although every neighbour says more than `MOVING_MPS`, is
    replaced by the central difference of the positions, one-sided at the ends of tracks and beside gaps.
    Objects not `moving` are left alone.
    """
    before, after = _neighbours(start, time_s)
    dx, dy, apart_s = (a[after] - a[before] for a in (x_m, y_m, time_s))
    with_both = np.maximum(apart_s, np.finfo(float).tiny)  # lone rows: 0 / tiny = 0
    derived_x, derived_y = dx / with_both, dy / with_both

    speed = np.hypot(vx_mps, vy_mps)
    unset = moving & np.isnan(speed)
    too_fast = moving & (speed > FASTEST_MPS)
    frozen = moving & (speed == 0.0) & _moves(before, after, time_s, x_m, y_m)
    derive = unset | too_fast | frozen
    notes = [
        f"velocity of {counted(int(rows.sum()), 'object state')} {what}: derived from the positions"
        for rows, what in (
            (unset, "is not given"),
            (frozen, "is 0 though the object moves"),
            (too_fast, f"exceeds {FASTEST_MPS:g} m/s"),
        )
        if rows.any()
    ]
    if (lone := int((derive & (before == after)).sum())) > 0:
        notes.append(f"velocity of {counted(lone, 'object state')} cannot be derived (no neighbour): 0 taken")
    vx, vy = np.where(derive, derived_x, vx_mps), np.where(derive, derived_y, vy_mps)
    return vx, vy, notes


def heights(
    object_ix: Int, object_class: Int, moving: Bool, z_m: Float, width_m: Float, height_m: Float
) -> tuple[Float, Float, list[str]]:
    """Heights of centres and of boxes (P,), and notes; all columns are (P,).

    A height below the least plausible one of its class, or none (0), becomes the typical one; the bottom
    of the box stays. Boxes all centred on z = 0 are stood on it.
    """
    notes = []
    height, z = height_m, z_m
    if not z.any() and len(np.unique(height)) > 1:
        z = height / 2.0
        notes.append("every box is centred on z = 0: stood on z = 0")
    of_moving = height[moving]
    if len(np.unique(object_ix[moving])) >= 3 and (of_moving == width_m[moving]).all():
        notes.append("the height of every moving object equals its width, a known defect of exporters")
    low = height < _LEAST_M[object_class]
    if low.any():
        notes.append(f"height implausible or missing: {_by_class(object_ix, object_class, low)}")
    typical = _TYPICAL_M[object_class]
    return (
        np.where(low, z + (typical - height) / 2.0, z),
        np.where(low, typical, height),
        notes,
    )


def _neighbours(start: Int, time_s: Float) -> tuple[Int, Int]:
    """(P,) row before and row after each in its track; itself at the end of the track and beside a gap."""
    row = np.arange(len(time_s))
    joined = np.diff(time_s) <= MAX_GAP_S  # row k and k + 1
    joined[start[1:-1] - 1] = False
    before, after = row.copy(), row.copy()
    before[1:] -= joined
    after[:-1] += joined
    return before, after


def _moves(before: Int, after: Int, time_s: Float, x_m: Float, y_m: Float) -> Bool:
    """(P,) whether every neighbour of a row says that it moves: who is about to walk still stands."""
    row = np.arange(len(time_s))
    moves: Bool = before != after
    for neighbour in (before, after):
        apart_m = np.hypot(x_m - x_m[neighbour], y_m - y_m[neighbour])
        apart_s = np.abs(time_s - time_s[neighbour])
        moves &= (neighbour == row) | (apart_m > MOVING_MPS * apart_s)
    return moves


def _by_class(object_ix: Int, object_class: Int, rows: Bool) -> str:
    """`3 pedestrian (1.75 m taken), 1 car (…)`: how many objects of each class have such rows."""
    _, first = np.unique(object_ix[rows], return_index=True)
    counts = np.bincount(object_class[rows][first], minlength=len(CLASSES))
    return ", ".join(
        f"{number} {name} ({HEIGHTS_M[name][1]:g} m taken)"
        for number, name in zip(counts.tolist(), CLASSES, strict=True)
        if number
    )
