"""The truth is checked as lists are: jumps that no speed explains, ids used again, headings, velocities.

A state is held against the path of its object: the places before and after. What is found is a `Finding` with the
object, the instant and the share; what can be mended is: a track is cut, a velocity is taken from the path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.interpolation import wrap_angles
from copem_replay.core.tracks import AGREE, CLASSES, Bool, Float, Int
from copem_replay.io.findings import VX, VY, YAW, X, Y, find

_SLACK_M = 3.0
"""Jitter of a place, and half a box where a tracker changes what it takes for the middle."""
_HARDEST_MPS2 = 15.0
"""No road user brakes or accelerates harder, but in a crash."""
_FASTEST_MPS = np.array([{"pedestrian": 12.0, "animal": 25.0, "bicycle": 30.0}.get(name, 100.0) for name in CLASSES])
"""No class is faster."""
_FEWEST = 3
"""States of a piece of a track that are an object of its own; fewer are errors of the recording."""
_MOVING_MPS = 1.0
"""A path that is faster has a direction: that of a slower one is jitter."""
_MANY = 0.5
"""A larger share of the moving states of an object contradicts what they state."""
_ACROSS_RAD = np.deg2rad(45.0)
_FLIP_RAD = np.deg2rad(150.0)


@dataclass(frozen=True)
class TrackRows:
    """Rows (P,) of the truth track by track, in each by time. `object_ix`: index into `ids`."""

    ids: tuple[str, ...]
    object_ix: Int
    time_s: Float
    class_ix: NDArray[np.int8]
    values: Float  # (P, V)
    moving: Bool  # (N,)
    max_gap_s: float = 0.5  # over a longer one nothing is known of an object


class HeadingUnitError(ValueError):
    """The headings are in another unit than the schema says."""


def check_truth(rows: TrackRows, places: bool, findings: list[str]) -> tuple[TrackRows, Int]:
    """The checked rows track by track, and the number that each had; `places`: ids are places in the list.

    Raises HeadingUnitError.
    """
    if _look_like_degrees(rows):
        raise HeadingUnitError(
            "headings are in degrees, by the paths, where the schema says radians; say so: "
            "`read: {topic: …, yaw_rad: {degrees: …}, …}`"
        )
    before = len(findings)
    rows, keep = cut_jumps(rows, findings)
    cut = len(findings) - before
    if places and cut:
        findings += find("places", cut)
    states = np.flatnonzero(keep)
    states = states[np.argsort(rows.object_ix[states], kind="stable")]
    if cut:
        rows = replace(rows, **{n: getattr(rows, n)[states] for n in ("object_ix", "time_s", "class_ix", "values")})
    return replace(rows, values=check_directions(rows, findings)), states


def cut_jumps(rows: TrackRows, findings: list[str]) -> tuple[TrackRows, Bool]:
    """The rows with tracks cut where no speed explains the step, or the id comes back as another class; which stay.

    The longest piece keeps the id, with what continues it. A piece in between is left out, one before or after is an
    object of its own, `ID/2`, unless it is short.
    """
    same, apart_s = _steps(rows)
    jumps = same & (_find_jumps(rows, same, apart_s) | _find_reuse(rows, apart_s)) & rows.moving[rows.object_ix[1:]]
    keep, object_ix = np.ones(len(rows.object_ix), dtype=bool), rows.object_ix.copy()
    ids, moving = list(rows.ids), rows.moving.tolist()
    for number in np.unique(rows.object_ix[1:][jumps]).tolist():
        track_rows = np.flatnonzero(rows.object_ix == number)
        groups = _join_pieces(rows, np.split(track_rows, np.flatnonzero(jumps[track_rows[:-1]]) + 1))
        longest = max(groups, key=len)
        first = int(track_rows[np.flatnonzero(jumps[track_rows[:-1]])[0] + 1])
        findings += find(
            "jump", len(groups) - 1, id=ids[number], at=rows.time_s[first], far=_step_m(rows)[first - 1],
            share=1 - len(longest) / len(track_rows),
        )  # fmt: skip
        for name, group in enumerate((group for group in groups if group is not longest), 2):
            inside = rows.time_s[longest[0]] < rows.time_s[group[0]] < rows.time_s[longest[-1]]
            if inside or len(group) < _FEWEST:
                keep[group] = False
                continue
            object_ix[group] = len(ids)
            ids.append(f"{rows.ids[number]}/{name}")
            moving.append(True)
    return replace(rows, ids=tuple(ids), object_ix=object_ix, moving=np.array(moving, dtype=bool)), keep


def _steps(rows: TrackRows) -> tuple[Bool, Float]:
    """(P − 1,) whether a row and the next are of one object, and the seconds between them."""
    return np.diff(rows.object_ix) == 0, np.diff(rows.time_s)


def _step_m(rows: TrackRows) -> Float:
    """(P − 1,) distance from each row to the next."""
    distance: Float = np.hypot(np.diff(rows.values[:, X]), np.diff(rows.values[:, Y]))
    return distance


def _find_jumps(rows: TrackRows, same: Bool, apart_s: Float) -> Bool:
    """(P − 1,) steps that are too far: for the class, or for the speed beside them and any acceleration."""
    step_m = _step_m(rows)
    speed = np.where(same, step_m / np.maximum(apart_s, 1e-9), np.inf)
    around = np.minimum(np.append(np.inf, speed[:-1]), np.append(speed[1:], np.inf))
    most_mps = np.minimum(around + _HARDEST_MPS2 * apart_s, _FASTEST_MPS[rows.class_ix[1:]])
    jumps: Bool = step_m > _SLACK_M + most_mps * apart_s
    return jumps


def _find_reuse(rows: TrackRows, apart_s: Float) -> Bool:
    """(P − 1,) gaps behind which the id is that of another class."""
    reuse: Bool = (apart_s > rows.max_gap_s) & ~AGREE[rows.class_ix[:-1], rows.class_ix[1:]]
    return reuse


def _join_pieces(rows: TrackRows, pieces: list[Int]) -> list[Int]:
    """Pieces (rows) of a track, each joined with later ones that continue it at a plausible speed."""
    groups: list[Int] = []
    for piece in pieces:
        for k, group in enumerate(groups):
            last, first = group[-1], piece[0]
            apart_s = rows.time_s[first] - rows.time_s[last]
            distance_m = float(np.hypot(*(rows.values[first, :2] - rows.values[last, :2])))
            speed_mps = _typical_mps(rows, group) + 0.5 * _HARDEST_MPS2 * min(apart_s, 1.0)
            if AGREE[rows.class_ix[first], rows.class_ix[last]] and distance_m <= _SLACK_M + speed_mps * apart_s:
                groups[k] = np.append(group, piece)
                break
        else:
            groups.append(piece)
    return groups


def _typical_mps(rows: TrackRows, group: Int) -> float:
    """The median speed along rows of one piece."""
    if len(group) < 2:
        return 0.0
    apart_s = np.maximum(np.diff(rows.time_s[group]), 1e-9)
    return float(np.median(np.hypot(*np.diff(rows.values[group, :2], axis=0).T) / apart_s))


# Headings and velocities against the path.


def check_directions(rows: TrackRows, findings: list[str]) -> Float:
    """The states (P, V), velocities that contradict the path as NaN; findings on headings and velocities."""
    course_rad, moves = _find_courses(rows)
    values = rows.values
    stated = np.hypot(values[:, VX], values[:, VY]) > _MOVING_MPS / 2
    across = np.abs(wrap_angles(np.arctan2(values[:, VY], values[:, VX]) - course_rad)) > _ACROSS_RAD
    for number, instant, share in _find_contradicted(rows, moves & stated, across):
        of_object = rows.object_ix == number
        findings += find("twist", int(of_object.sum()), id=rows.ids[number], at=instant, share=share)
        values = values if values is not rows.values else values.copy()
        values[of_object, VX : VY + 1] = np.nan
    off_rad = np.abs(wrap_angles(values[:, YAW] - course_rad))
    vehicles = moves & (rows.class_ix != CLASSES.index("pedestrian")) & (rows.class_ix != CLASSES.index("animal"))
    aside = (off_rad > _ACROSS_RAD) & (off_rad < np.pi - _ACROSS_RAD)
    for number, instant, share in _find_contradicted(rows, vehicles, aside):
        findings += find("heading", 1, id=rows.ids[number], at=instant, share=share)
    same, _ = _steps(rows)
    flips = same & (np.abs(wrap_angles(np.diff(values[:, YAW]))) > _FLIP_RAD) & vehicles[1:]
    for number in np.unique(rows.object_ix[1:][flips]).tolist():
        of_object = np.flatnonzero(flips & (rows.object_ix[1:] == number)) + 1
        share = len(of_object) / (rows.object_ix == number).sum()
        findings += find("flip", len(of_object), id=rows.ids[number], at=rows.time_s[of_object[0]], share=share)
    return values


def _look_like_degrees(rows: TrackRows) -> bool:
    """Whether headings are in degrees: more than two turns in radians, and the paths fit them so."""
    course_rad, moves = _find_courses(rows)
    yaw = rows.values[:, YAW]
    if moves.sum() < _FEWEST or not (np.abs(yaw[moves]) > 4 * np.pi).any():
        return False
    radians, degrees = (np.median(np.abs(wrap_angles(each - course_rad))[moves]) for each in (yaw, np.deg2rad(yaw)))
    return bool(degrees < np.deg2rad(20) < radians)


def _find_courses(rows: TrackRows) -> tuple[Float, Bool]:
    """(P,) direction (rad) of the path, from the place before to the one after; (P,) whether the object moves there."""
    same, apart_s = _steps(rows)
    joined = same & (apart_s <= 1.0)
    row = np.arange(len(rows.object_ix))
    before, after = row.copy(), row.copy()
    before[1:] -= joined
    after[:-1] += joined
    dx, dy = (rows.values[after, k] - rows.values[before, k] for k in (X, Y))
    duration_s = np.maximum(rows.time_s[after] - rows.time_s[before], 1e-9)
    moves = (np.hypot(dx, dy) > _MOVING_MPS * duration_s) & (np.hypot(dx, dy) > 0.1) & rows.moving[rows.object_ix]
    return np.arctan2(dy, dx), moves


def _find_contradicted(rows: TrackRows, judged: Bool, wrong: Bool) -> list[tuple[int, float, float]]:
    """Objects of whose `judged` states (P,) more than half are `wrong`: index, first instant in s, share."""
    number = len(rows.ids)
    of, bad = (np.bincount(rows.object_ix[which], minlength=number) for which in (judged, judged & wrong))
    found = np.flatnonzero((of >= 2 * _FEWEST) & (bad > _MANY * of))
    first = [float(rows.time_s[np.flatnonzero(judged & wrong & (rows.object_ix == k))[0]]) for k in found.tolist()]
    return list(zip(found.tolist(), first, (bad[found] / of[found]).tolist(), strict=True))


def are_places(ids: Sequence[str], object_ix: Int, message: Int) -> bool:
    """Whether ids are places in the list: each ends with the row's place in its `message (P,)`."""
    numbers = np.array([int(t) if t.isdecimal() and len(t) < 9 else -1 for t in (n.rpartition("/")[2] for n in ids)])
    if not len(object_ix) or (numbers[object_ix] < 0).any():
        return False
    first = np.flatnonzero(np.diff(message, prepend=-1))
    place = np.arange(len(message)) - np.repeat(first, np.diff(np.append(first, len(message))))
    return bool(place.max() > 0 and len(np.unique(numbers[object_ix] - place)) == 1)
