"""From the columns of a decoder to the truth: ordered, each object one track, corrected.

Everything left out or put right is said in a line with its count.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.text import counted
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_NS, TRUTH, VALUES, Bool, Float, Int, Scene, Solid, Tracks
from copem_replay.io import plausibility as repair
from copem_replay.io.schemas.decoded import FARTHEST_M, DecodedObjects

LONGEST_M = 1000.0  # no wall, train or building is longer, wider or higher (chosen)
_X, _Y, _Z, _YAW, _VX, _VY, _LENGTH, _WIDTH, _HEIGHT = range(len(VALUES))


def assemble(
    columns: DecodedObjects, log: str
) -> tuple[Scene, Tracks, tuple[str, ...]] | tuple[None, None, tuple[str, ...]]:
    """Scene (without ego), truth and notes of the log named `log`. No scene where no object is usable."""
    notes: list[str] = []
    kept_list, stamp_ns = _in_order(columns, notes)
    frame_of_list = np.full(len(columns.stamp_ns), -1)
    frame_of_list[kept_list] = np.arange(len(kept_list))
    frame = np.repeat(frame_of_list, columns.rows)
    row = np.flatnonzero(_usable(columns.values, frame >= 0, notes))
    row = _once_per_list(row, frame, columns.object_ix, notes)
    if not len(row):
        return None, None, tuple(notes)

    object_ix, first_seen = _by_appearance(columns.object_ix[row])
    order = np.argsort(object_ix, kind="stable")  # rows are in order of capture: so are those of each track
    row, object_ix = row[order], object_ix[order]
    object_class = _most_frequent(object_ix, columns.class_ix[row], notes)
    scene = Scene(
        log=log,
        t0_ns=int(stamp_ns[0]),
        end_ns=int(stamp_ns[-1]),
        object_ids=tuple(columns.object_ids[k] for k in first_seen),
        object_class=object_class,
        moving=columns.moving[first_seen],
    )
    tracks = _tracks(scene, stamp_ns, frame[row], object_ix, columns.values[row], notes)
    return replace(scene, solids=_stood(columns.solids, columns.values[row, _Z], tracks.z_m)), tracks, tuple(notes)


def _stood(solids: tuple[Solid, ...], said_z_m: Float, z_m: Float) -> tuple[Solid, ...]:
    """The solids, those that are centred on z = 0 stood on it where the boxes were."""
    if said_z_m.any() or not z_m.any():
        return solids
    return tuple(one._replace(bottom_m=0.0) if 2 * one.bottom_m == -one.height_m else one for one in solids)


def _in_order(columns: DecodedObjects, notes: list[str]) -> tuple[Int, Int]:
    """Which messages are kept, in order of time, and their stamps: (F,) each."""
    stamp_ns, use = columns.stamp_ns, np.ones(len(columns.stamp_ns), dtype=bool)
    if not columns.stamped.all():
        if columns.stamped.any():
            # Log times may run on another clock: one of 2026 in a simulation would be a gap of decades.
            stamped = stamp_ns[columns.stamped]
            slack_ns = 1_000_000_000  # chosen
            use = columns.stamped | ((stamp_ns >= stamped.min() - slack_ns) & (stamp_ns <= stamped.max() + slack_ns))
        if taken := int((use & ~columns.stamped).sum()):
            notes.append(f"{counted(taken, 'message')} without timestamp: the time of logging taken")
        if dropped := int((~use).sum()):
            notes.append(f"{counted(dropped, 'message')} without timestamp, and logged at another time: skipped")
    kept = np.flatnonzero(use)
    if late := int((np.diff(stamp_ns[kept]) < 0).sum()):
        notes.append(f"{counted(late, 'message')} stamped earlier than the one before: sorted by time")
    kept = kept[np.argsort(stamp_ns[kept], kind="stable")]
    again = np.diff(stamp_ns[kept], prepend=stamp_ns[kept[:1]] - SAME_INSTANT_NS) < SAME_INSTANT_NS
    if again.any():
        notes.append(f"{counted(int(again.sum()), 'message')} with the time stamp of another: the first kept")
    kept = kept[~again]
    return kept, stamp_ns[kept]


def _usable(values: Float, kept: Bool, notes: list[str]) -> Bool:
    """(P,) which of the rows `kept` so far have a place and a footprint."""
    usable = kept.copy()
    place, size = values[:, _X : _Z + 1], values[:, _LENGTH : _WIDTH + 1]
    with np.errstate(invalid="ignore"):
        defects = {
            "without a position, or with one that is no number": ~np.isfinite(place).all(axis=1),
            f"farther than {FARTHEST_M:g} m from the origin": (np.abs(place) > FARTHEST_M).any(axis=1),
            "whose yaw is no number": ~np.isfinite(values[:, _YAW]),
            f"whose length or width is not between 0 and {LONGEST_M:g} m": ~((size > 0.0) & (size <= LONGEST_M)).all(
                axis=1
            ),
            f"whose height is negative, above {LONGEST_M:g} m or no number": ~(
                (values[:, _HEIGHT] >= 0.0) & (values[:, _HEIGHT] <= LONGEST_M)
            ),
        }
    for what, rows in defects.items():
        if number := int((usable & rows).sum()):
            notes.append(f"{counted(number, 'object state')} {what}: skipped")
        usable &= ~rows
    return usable


def _once_per_list(row: Int, frame: Int, object_ix: Int, notes: list[str]) -> Int:
    """`row (K,)` by time, as in the file within a message, each object once per message."""
    row = row[np.argsort(frame[row], kind="stable")]
    by_object = np.lexsort((frame[row], object_ix[row]))  # stable: the first of two stays the first
    same = np.zeros(len(row), dtype=bool)
    same[by_object[1:]] = (np.diff(object_ix[row][by_object]) == 0) & (np.diff(frame[row][by_object]) == 0)
    if same.any():
        notes.append(f"{counted(int(same.sum()), 'object state')} of an id twice in a message: the first kept")
    return row[~same]


def _by_appearance(object_ix: Int) -> tuple[Int, Int]:
    """Objects renumbered by first appearance: the new numbers (P,), and the old number of each (N,)."""
    old, first, inverse = np.unique(object_ix, return_index=True, return_inverse=True)
    order = np.argsort(first)
    new = np.empty_like(order)
    new[order] = np.arange(len(order))
    return new[inverse], old[order]


def _most_frequent(object_ix: Int, class_ix: NDArray[np.int8], notes: list[str]) -> NDArray[np.int8]:
    """(N,) class of each object: the most frequent of its rows, of equally frequent ones the first."""
    pairs, first, counts = np.unique(object_ix * len(CLASSES) + class_ix, return_index=True, return_counts=True)
    owner, candidate = pairs // len(CLASSES), pairs % len(CLASSES)
    best_first = np.lexsort((first, -counts, owner))
    _, top = np.unique(owner[best_first], return_index=True)
    if changing := int((np.bincount(owner) > 1).sum()):
        notes.append(f"{counted(changing, 'object')} of changing class: the most frequent taken")
    majority: NDArray[np.int8] = candidate[best_first][top].astype(np.int8)
    return majority


def _tracks(scene: Scene, stamp_ns: Int, frame: Int, object_ix: Int, values: Float, notes: list[str]) -> Tracks:
    """Build the truth: rows track by track, corrected."""
    number = len(scene.object_ids)
    start = np.concatenate([[0], np.cumsum(np.bincount(object_ix, minlength=number))])
    captured_s = ((stamp_ns - scene.t0_ns) * 1e-9).astype(np.float64)
    moving, class_ix = scene.moving[object_ix], scene.object_class[object_ix].astype(np.int64)
    column: dict[str, Float] = dict(zip(VALUES, values.T, strict=True))
    x, y = column["x_m"], column["y_m"]
    vx, vy, said = repair.velocities(start, captured_s[frame], x, y, column["vx_mps"], column["vy_mps"], moving)
    notes += said
    z, height, said = repair.heights(object_ix, class_ix, moving, column["z_m"], column["width_m"], column["height_m"])
    notes += said
    column |= {
        "vx_mps": vx,
        "vy_mps": vy,
        "z_m": z,
        "height_m": height,
        "yaw_rad": _wrapped(column["yaw_rad"]),
    }
    return Tracks(
        units=(TRUTH,),
        start=start,
        unit_ix=np.zeros(number, dtype=np.int64),
        object_ix=np.arange(number),
        frame_ix=frame,
        stamp_ns=stamp_ns,
        captured_s=captured_s,
        frame_unit_ix=np.zeros(len(stamp_ns), dtype=np.int64),
        arrives_s=captured_s[None],
        valid=np.ones((1, len(frame)), dtype=bool),
        **{name: np.ascontiguousarray(a)[None] for name, a in column.items()},
    )


def _wrapped(yaw_rad: Float) -> Float:
    """Angles in (−π, π]; those that are there already keep their bits."""
    wrapped = np.pi - np.mod(np.pi - yaw_rad, 2.0 * np.pi)
    wrapped = np.where(wrapped <= -np.pi, np.pi, wrapped)  # mod may round up to 2π
    return np.where((yaw_rad > -np.pi) & (yaw_rad <= np.pi), yaw_rad, wrapped)
