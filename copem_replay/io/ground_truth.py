"""Ground truth from the decoded messages of a log: in order of time, one track per object, corrected.

A note with a count tells of everything that is left out or corrected. `truth_digest` identifies the result.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.frame import SaidPlace
from copem_replay.core.site_map import Lane
from copem_replay.core.tracks import (
    CLASSES,
    SAME_INSTANT_NS,
    SAME_INSTANT_S,
    TRUTH,
    VALUES,
    Area,
    Bool,
    Float,
    Int,
    Scene,
    Solid,
    Tracks,
)
from copem_replay.io.findings import (
    BODIES_M,
    FASTEST_MPS,
    LEAST_HEIGHT_M,
    TYPICAL_M,
    Finding,
    Z,
    complete_sizes,
    find,
    sift_states,
)
from copem_replay.io.truth_checks import TrackRows, are_places, check_truth


@dataclass(frozen=True)
class DecodedObjects:
    """The lists of one topic: F messages in the order read, P rows message by message, N objects.

    `values` are in the units and the frame of reference of `Tracks`, columns in the order of `tracks.VALUES`;
    NaN where the message states none (or NaN).
    """

    stamp_ns: Int  # (F,)
    stamped: Bool  # (F,) False: the message has no time stamp, `stamp_ns` is its log time, by the clock of the others
    log_time_ns: Int  # (F,)
    rows: Int  # (F,) number of rows of each message
    object_ids: tuple[str, ...]  # N
    moving: Bool  # (N,)
    object_ix: Int  # (P,) index into object_ids
    class_ix: NDArray[np.int8]  # (P,) index into CLASSES
    values: Float  # (P, len(VALUES))
    lane_boundaries: tuple[Float, ...] = ()  # (K, 3) each, for showing only, in the truth's frame, as what follows
    lanes: tuple[Lane, ...] = ()
    areas: tuple[Area, ...] = ()  # crosswalks
    solids: tuple[Solid, ...] = ()
    place: SaidPlace | None = None  # what it says of its place on earth
    hosts: tuple[str, ...] = ()  # the host vehicle's id, once per message that states one
    notes: tuple[str, ...] = ()  # a line for each kind of state that was skipped or completed


def take_messages(columns: DecodedObjects, keep: Bool) -> DecodedObjects:
    """The lists of the messages in the mask `keep` (F,)."""
    if keep.all():
        return columns
    rows = np.repeat(keep, columns.rows)
    of_message = {name: getattr(columns, name)[keep] for name in ("stamp_ns", "stamped", "log_time_ns", "rows")}
    return replace(columns, **of_message, **{n: getattr(columns, n)[rows] for n in ("object_ix", "class_ix", "values")})


def list_contents(columns: DecodedObjects) -> list[bytes]:
    """The content of each message (F,) as bytes: equal for equal lists."""
    ends = np.cumsum(columns.rows).tolist()
    spans = [slice(end - number, end) for end, number in zip(ends, columns.rows.tolist(), strict=True)]
    return [columns.object_ix[rows].tobytes() + columns.values[rows].tobytes() for rows in spans]


# Corrections of velocities and heights. Rows are those of the truth (P,), track by track (`start (E + 1,)`). Each
# function returns new columns and a note for everything that it changed.

_ROWS_AT_ONCE = 1 << 18
MAX_GAP_S = 0.5
"""No difference is taken across a longer gap: the default of an experiment's `max_gap_s`."""
MOVING_MPS = 0.5
"""An object that is faster by its positions moves: jitter of the positions of a standing one is slower."""


def correct_velocities(
    start: Int,
    time_s: Float,
    x_m: Float,
    y_m: Float,
    vx_mps: Float,
    vy_mps: Float,
    moving: Bool,
    max_gap_s: float = MAX_GAP_S,
) -> tuple[Float, Float, list[Finding]]:
    """Velocities (P,) and findings, from those of the messages (NaN: not given); all columns are (P,).

    A velocity is replaced by the central difference of the positions, one-sided at the ends of tracks and beside gaps,
    if it is not given, above `FASTEST_MPS`, or exactly 0 although the way to every neighbour is faster than
    `MOVING_MPS`. Objects not `moving` keep their velocities.
    """
    vx, vy, counts = vx_mps.copy(), vy_mps.copy(), np.zeros(4, dtype=np.int64)
    firsts = np.searchsorted(start, np.arange(0, len(time_s), _ROWS_AT_ONCE)).tolist()
    for first, last in pairwise(sorted({*firsts, len(start) - 1})):  # some tracks at a time: no column is there often
        here = slice(start[first], start[last])
        columns = (column[here] for column in (time_s, x_m, y_m, vx_mps, vy_mps))
        begin = start[first : last + 1] - start[first]
        vx[here], vy[here], of_tracks = _derive_velocities(begin, moving[here], max_gap_s, *columns)
        counts += of_tracks
    rules = ("velocity unset", "velocity frozen", "velocity fast", "velocity alone")
    return vx, vy, [note for rule, n in zip(rules, counts.tolist(), strict=True) for note in find(rule, n)]


def _derive_velocities(
    start: Int, moving: Bool, max_gap_s: float, time_s: Float, x_m: Float, y_m: Float, vx_mps: Float, vy_mps: Float
) -> tuple[Float, Float, Int]:
    """Velocities (P,) in m/s, from positions where implausible; how many are unset, frozen, too fast or alone."""
    before, after = _find_neighbours(start, time_s, max_gap_s)
    dx, dy, apart_s = (a[after] - a[before] for a in (x_m, y_m, time_s))
    with_both = np.maximum(apart_s, np.finfo(float).tiny)  # lone rows: 0 / tiny = 0
    speed = np.hypot(vx_mps, vy_mps)
    unset = moving & np.isnan(speed)
    too_fast = moving & (speed > FASTEST_MPS)
    frozen = moving & (speed == 0.0) & _is_moving(before, after, time_s, x_m, y_m)
    derive = unset | too_fast | frozen
    counts = np.array([rows.sum() for rows in (unset, frozen, too_fast, derive & (before == after))])
    return np.where(derive, dx / with_both, vx_mps), np.where(derive, dy / with_both, vy_mps), counts


def correct_heights(
    object_ix: Int, object_class: Int, moving: Bool, z_m: Float, width_m: Float, height_m: Float
) -> tuple[Float, Float, list[Finding]]:
    """Heights of centres and of boxes (P,), and notes; all columns are (P,).

    A height below the least plausible one of its class, or none (0), becomes the typical one; the bottom
    of the box stays. If all boxes are centred on z = 0, they are stood on z = 0.
    """
    notes = list[Finding]()
    height, z = height_m, z_m
    if not z.any() and len(np.unique(height)) > 1:
        z = height / 2.0
        notes += find("flat", len(z))
    of_moving = height[moving]
    if len(np.unique(object_ix[moving])) >= 3 and (of_moving == width_m[moving]).all():
        notes += find("height is width", len(of_moving))
    low = height < LEAST_HEIGHT_M[object_class]
    if not low.any():
        return z, height, notes
    notes += find("height", int(low.sum()), which=_count_by_class(object_ix, object_class, low))
    typical = TYPICAL_M[object_class, 2]
    return (
        np.where(low, z + (typical - height) / 2.0, z),
        np.where(low, typical, height),
        notes,
    )


def _find_neighbours(start: Int, time_s: Float, max_gap_s: float) -> tuple[Int, Int]:
    """(P,) row before and row after each in its track; itself at the end of the track and beside a gap."""
    row = np.arange(len(time_s))
    joined = np.diff(time_s) <= max_gap_s + SAME_INSTANT_S  # row k and k + 1
    joined[start[1:-1] - 1] = False
    before, after = row.copy(), row.copy()
    before[1:] -= joined
    after[:-1] += joined
    return before, after


def _is_moving(before: Int, after: Int, time_s: Float, x_m: Float, y_m: Float) -> Bool:
    """(P,) whether an object moves to every neighbour of a row; at rest beside one of them it may stand."""
    row = np.arange(len(time_s))
    moves: Bool = before != after
    for neighbour in (before, after):
        apart_m = np.hypot(x_m - x_m[neighbour], y_m - y_m[neighbour])
        apart_s = np.abs(time_s - time_s[neighbour])
        moves &= (neighbour == row) | (apart_m > MOVING_MPS * apart_s)
    return moves


def _count_by_class(object_ix: Int, object_class: Int, rows: Bool) -> str:
    """`3 pedestrian (1.75 m taken), 1 car (…)`: how many objects of each class have such rows."""
    _, first = np.unique(object_ix[rows], return_index=True)
    counts = np.bincount(object_class[rows][first], minlength=len(CLASSES))
    return ", ".join(
        f"{number} {name} ({BODIES_M[name][2]:g} m taken)"
        for number, name in zip(counts.tolist(), CLASSES, strict=True)
        if number
    )


# Assembly: messages in order, usable rows, tracks.


def assemble_truth(
    columns: DecodedObjects, log: str, max_gap_s: float = MAX_GAP_S
) -> tuple[Scene, Tracks, tuple[str, ...]] | tuple[None, None, tuple[str, ...]]:
    """Scene (without ego), truth and notes of the log named `log`. No scene where no object is usable."""
    notes = list[str]()
    kept_list, stamp_ns = _order_messages(columns, notes)
    frame_of_list = np.full(len(columns.stamp_ns), -1)
    frame_of_list[kept_list] = np.arange(len(kept_list))
    frame = np.repeat(frame_of_list, columns.rows)
    values, usable = sift_states(columns.values, frame >= 0, notes)
    row = np.flatnonzero(usable)
    row = _drop_repeated_objects(row, frame, columns.object_ix, notes)
    if not len(row):
        return None, None, tuple(notes)

    object_ix, first_seen = _number_by_appearance(columns.object_ix[row])
    order = np.argsort(object_ix, kind="stable")  # rows are in order of capture: so are those of each track
    row, object_ix = row[order], object_ix[order]
    time_s = (stamp_ns[frame[row]] - stamp_ns[0]) * np.float64(1e-9)
    ids = tuple(columns.object_ids[k] for k in first_seen)
    rows = TrackRows(ids, object_ix, time_s, columns.class_ix[row], values[row], columns.moving[first_seen], max_gap_s)
    rows, states = check_truth(rows, _are_places(columns), notes)
    row, object_ix, values = row[states], rows.object_ix, rows.values
    object_class = _most_frequent_class(object_ix, columns.class_ix[row], notes)
    scene = Scene(
        log=log,
        t0_ns=int(stamp_ns[0]),
        end_ns=int(stamp_ns[-1]),
        object_ids=rows.ids,
        object_class=object_class,
        moving=rows.moving,
    )
    values = complete_sizes(values, object_class[object_ix], object_ix, notes)
    column = {name: values[:, k] for k, name in enumerate(VALUES)}
    tracks = _build_tracks(scene, stamp_ns, frame[row], object_ix, column, max_gap_s, notes)
    return (
        replace(scene, solids=_stand_solids_on_ground(columns.solids, values[:, Z], tracks.z_m)),
        tracks,
        tuple(notes),
    )


def _are_places(columns: DecodedObjects) -> bool:
    """Whether the ids of listed objects are places in the list."""
    ego = [columns.object_ids.index(host) for host in set(columns.hosts) if host in columns.object_ids]
    listed = np.flatnonzero(~np.isin(columns.object_ix, ego))
    message = np.repeat(np.arange(len(columns.rows)), columns.rows)
    return are_places(columns.object_ids, columns.object_ix[listed], message[listed])


def _stand_solids_on_ground(solids: tuple[Solid, ...], stated_z_m: Float, z_m: Float) -> tuple[Solid, ...]:
    """The solids; those centred on z = 0 are stood on it if the boxes were (`z_m`), all stated at z = 0."""
    if stated_z_m.any() or not z_m.any():
        return solids
    return tuple(solid._replace(bottom_m=0.0) if 2 * solid.bottom_m == -solid.height_m else solid for solid in solids)


def _order_messages(columns: DecodedObjects, notes: list[str]) -> tuple[Int, Int]:
    """(F,) indices of the messages that are kept, in order of time, and (F,) their stamps."""
    stamp_ns = columns.stamp_ns
    notes += find("late", int((np.diff(stamp_ns) < 0).sum()))
    order = np.argsort(stamp_ns, kind="stable")
    repeated = np.diff(stamp_ns[order], prepend=stamp_ns[order[:1]] - SAME_INSTANT_NS) < SAME_INSTANT_NS
    notes += find("again", int(repeated.sum()))
    order = order[~repeated]
    return order, stamp_ns[order]


def _drop_repeated_objects(row: Int, frame: Int, object_ix: Int, notes: list[str]) -> Int:
    """(K,) rows in order of time, as in the file within a message, each object once per message."""
    row = row[np.argsort(frame[row], kind="stable")]
    by_object = np.lexsort((frame[row], object_ix[row]))  # stable: the first of two stays the first
    same = np.zeros(len(row), dtype=bool)
    same[by_object[1:]] = (np.diff(object_ix[row][by_object]) == 0) & (np.diff(frame[row][by_object]) == 0)
    notes += find("twice", int(same.sum()))
    return row[~same]


def _number_by_appearance(object_ix: Int) -> tuple[Int, Int]:
    """Objects renumbered by first appearance: the new numbers (P,), and the old number of each (N,)."""
    old, first, inverse = np.unique(object_ix, return_index=True, return_inverse=True)
    order = np.argsort(first)
    new = np.empty_like(order)
    new[order] = np.arange(len(order))
    return new[inverse], old[order]


def _most_frequent_class(object_ix: Int, class_ix: NDArray[np.int8], notes: list[str]) -> NDArray[np.int8]:
    """(N,) class of each object: the most frequent of its rows, of equally frequent ones the first."""
    pairs, first, counts = np.unique(object_ix * len(CLASSES) + class_ix, return_index=True, return_counts=True)
    owner, candidate = pairs // len(CLASSES), pairs % len(CLASSES)
    best_first = np.lexsort((first, -counts, owner))
    _, top = np.unique(owner[best_first], return_index=True)
    notes += find("class changes", int((np.bincount(owner) > 1).sum()))
    majority: NDArray[np.int8] = candidate[best_first][top].astype(np.int8)
    return majority


def _build_tracks(
    scene: Scene,
    stamp_ns: Int,
    frame: Int,
    object_ix: Int,
    column: dict[str, Float],
    max_gap_s: float,
    notes: list[str],
) -> Tracks:
    """The truth of rows sorted by track, velocities and heights corrected; `notes` gets the corrections."""
    number = len(scene.object_ids)
    start = np.concatenate([[0], np.cumsum(np.bincount(object_ix, minlength=number))])
    captured_s = ((stamp_ns - scene.t0_ns) * 1e-9).astype(np.float64)
    moving, class_ix = scene.moving[object_ix], scene.object_class[object_ix].astype(np.int64)
    x, y = column["x_m"], column["y_m"]
    vx, vy, corrections = correct_velocities(
        start, captured_s[frame], x, y, column["vx_mps"], column["vy_mps"], moving, max_gap_s
    )
    notes += corrections
    z, height, corrections = correct_heights(
        object_ix, class_ix, moving, column["z_m"], column["width_m"], column["height_m"]
    )
    notes += corrections
    column |= {
        "vx_mps": vx,
        "vy_mps": vy,
        "z_m": z,
        "height_m": height,
        "yaw_rad": _wrap_exceeding(column["yaw_rad"]),
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
        **{name: values[None] for name, values in column.items()},
    )


def _wrap_exceeding(yaw_rad: Float) -> Float:
    """Angles in (−π, π]; those that are there already keep their bits."""
    exceeding = ~((yaw_rad > -np.pi) & (yaw_rad <= np.pi))
    wrapped = np.pi - np.mod(np.pi - yaw_rad[exceeding], 2.0 * np.pi)
    angles = yaw_rad.copy()
    angles[exceeding] = np.where(wrapped <= -np.pi, np.pi, wrapped)  # mod may round up to 2π
    return angles


# Identity: two recordings with one digest are of one drive.


def truth_digest(scene: Scene, truth: Tracks) -> str:
    """SHA-256 of the truth: objects by id, their classes and states to the last bit, the ego, the span of time, solids.

    It does not depend on the file, the topic, the other topics, or the order of the objects in the recording.
    """
    digest = hashlib.sha256()
    ego = scene.object_ids[scene.ego_ix] if scene.ego_ix >= 0 else None
    digest.update(json.dumps([scene.t0_ns, scene.end_ns, ego]).encode())
    track_of = {int(object_ix): track for track, object_ix in enumerate(truth.object_ix)}
    for object_ix in sorted(track_of, key=lambda k: scene.object_ids[k]):
        track = track_of[object_ix]
        rows = slice(int(truth.start[track]), int(truth.start[track + 1]))
        header = [scene.object_ids[object_ix], int(scene.object_class[object_ix]), bool(scene.moving[object_ix])]
        digest.update(json.dumps([*header, rows.stop - rows.start]).encode())
        digest.update(truth.stamp_ns[truth.frame_ix[rows]].astype("<i8").tobytes())
        for name in VALUES:
            digest.update((np.asarray(getattr(truth, name)[0, rows], dtype="<f8") + 0.0).tobytes())  # no −0
    if scene.solids:
        digest.update(
            json.dumps(sorted(solid[:5] + solid[5:] * bool(solid.holes_m) for solid in scene.solids)).encode()
        )
    return digest.hexdigest()
