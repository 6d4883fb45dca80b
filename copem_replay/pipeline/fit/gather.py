"""From a recorded unit over its logs to what a model is fitted to: lists, rows, and entries about no true object."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from copem_replay.core.errors import InputError
from copem_replay.core.interpolation import wrap
from copem_replay.core.text import counted
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.io.recorded_osi import RecordedLists
from copem_replay.io.recorded_units import with_truth_ids
from copem_replay.pipeline.fit.log_view import LogView
from copem_replay.pipeline.fit.reach import FitReach, folds_of, passes, reach_of
from copem_replay.pipeline.fit.rows import FitLists, FitRows, OtherEntries

_OTHER = CLASSES.index("other")
_NEAR_GATE = 0.8
"""Matches farther apart than this share of the gate may well be none (the design's)."""


_CONFUSED = 0.5
"""So much a match counts whose classes do not agree (chosen): what is mistaken for another class is listed, too."""
_APART_M = 1e5
"""Lists lie so far apart in a tree that no object is near one of another list."""
_SIGMAS = 5.0
"""So many standard deviations off an entry is not about an object (chosen)."""
LONGEST_S = 0.5
"""No delay is longer, as far as matches are sought (the design's)."""


class NothingMatchedError(InputError):
    """No entry, or hardly any, is near a true object."""


@dataclass(frozen=True)
class Gathered:
    """What is fitted. `reach`: where; `beyond`: which share of matches is farther apart than .8 of the gate."""

    lists: FitLists
    rows: FitRows
    other: OtherEntries
    reach: FitReach
    matched: int
    beyond: float
    crowded: bool  # a list has more entries about no true object than true objects are within reach
    notes: tuple[str, ...]

    @property
    def number_of_passes(self) -> int:
        """How many there are."""
        return int(self.rows.pass_ix[-1]) + 1 if len(self.rows.pass_ix) else 0


def gather(
    views: Sequence[LogView], *, gate_m: float, max_gap_s: float, reach: FitReach | None = None,
    folds: int | None = None, name: str = "",
) -> Gathered:  # fmt: skip
    """Match the lists of all logs with the truth, and lay both side by side.

    `reach`: None, as these rows have it. Raises NothingMatchedError.
    """
    pieces = [_of_log(k, view, (gate_m, max_gap_s), np.full(2, np.inf)) for k, view in enumerate(views)]
    ellipse_m = _ellipse_m(pieces)
    pieces = [_of_log(k, view, (gate_m, max_gap_s), ellipse_m) for k, view in enumerate(views)]
    first_list = np.cumsum([0, *(len(view.captured_s) for view in views)])
    columns = {key: np.concatenate([p.rows[key] for p in pieces], axis=-1) for key in pieces[0].rows}
    others = {key: np.concatenate([p.others[key] for p in pieces]) for key in pieces[0].others}
    seen = ViewGeometry(
        **{
            f: np.concatenate([getattr(view.view, f)[view.row] for view in views])
            for f in ViewGeometry.__dataclass_fields__
        }
    )
    log = columns["log"]
    columns["list"] += first_list[log]
    others["list"] += first_list[others["log"]]
    entries = np.concatenate([piece.entries for piece in pieces])
    where = ("captured_s", "east_m", "north_m", "heading_rad")
    lists = FitLists(
        log=np.repeat(np.arange(len(views)), [len(view.captured_s) for view in views]),
        **{name: np.concatenate([getattr(view, name) for view in views]) for name in where},
        entries=entries,
    )
    reach = reach or reach_of(seen, columns["listed"])
    if reach is None:
        raise NothingMatchedError(_too_few(name, int(entries.sum()), int(columns["listed"].sum()), gate_m))
    inside = np.flatnonzero(reach.holds(seen))
    columns = {key: column[..., inside] for key, column in columns.items()}
    away_m = columns.pop("away_m")
    notes = [line for name in ("yaw_rad", "speed_mps", "size_m") for line in _without_outliers(name, columns[name])]
    pass_ix = passes(columns["log"], columns["object"], columns["list"])
    state_m = np.stack([columns.pop("x_m"), columns.pop("y_m")], axis=1)
    rows = FitRows(
        **columns, pass_ix=pass_ix, view=seen.take(inside), state_m=state_m,
        fold=folds_of(pass_ix, columns["log"], folds),
    )  # fmt: skip
    matched = int(rows.listed.sum())
    there = np.bincount(rows.list, minlength=len(entries))
    crowded = bool((np.bincount(others["list"], minlength=len(entries)) > there).any())
    beyond = float((away_m[rows.listed] > _NEAR_GATE * gate_m).mean()) if matched else 0.0
    return Gathered(lists, rows, OtherEntries(**others), reach, matched, beyond, crowded, tuple(notes))


def _without_outliers(name: str, values: Float) -> Iterator[str]:
    """Errors (…, R) farther off than entries of the same object can be become NaN; how many there were."""
    size = np.abs(values)
    there = np.isfinite(size)
    far = there & (size > _SIGMAS / 1.96 * np.quantile(size[there], 0.95)) if there.any() else there
    if far.any():
        values[far] = np.nan
        what, said = name.partition("_")[0], counted(int(far.sum()), "error")
        yield f"{said} of {what} beyond {_SIGMAS:g} standard deviations (flips, other objects): left out of its spread"


def _too_few(name: str, entries: int, matched: int, gate_m: float) -> str:
    said = counted(entries, "entry", "entries")
    if matched:
        return f"only {matched} of unit {name}'s {said} are within {gate_m:g} m of a true object: too few to fit"
    return (
        f"nothing of unit {name}'s {said} is within {gate_m:g} m of a true object at any delay up to {LONGEST_S:g} s: "
        "other frame, or other clock?"
    )


@dataclass(frozen=True)
class _Piece:
    """One log, matched: columns of rows (R,) and of other entries (E,), and how many entries lists (L,) hold."""

    rows: dict[str, Any]
    others: dict[str, Any]
    entries: Int


def _ellipse_m(pieces: Sequence[_Piece]) -> Float:
    """(2,) half axes along and across the line of sight beyond which a match is none: five standard deviations, as the
    nearest 95 % have them. What is nearer than a metre stays.
    """
    error_m = np.stack([np.concatenate([piece.rows[name] for piece in pieces]) for name in ("along_m", "across_m")])
    error_m = np.abs(error_m[:, np.isfinite(error_m[0])])
    half_m: Float = np.quantile(error_m, 0.95, axis=1) / 1.96 * _SIGMAS if error_m.size else np.full(2, np.inf)
    return np.maximum(half_m, 1.0)


def _of_log(number: int, view: LogView, gates: tuple[float, float], ellipse_m: Float) -> _Piece:
    gate_m, max_gap_s = gates
    found, scene, L = view.found, view.scene, len(view.captured_s)
    # To a unit the ego is an object as any other.
    told = with_truth_ids(
        found, replace(scene, ego_ix=-1), view.truth, gate_m=gate_m, max_gap_s=max_gap_s, confused=_CONFUSED
    )
    object_ix, list_of = told.row_object_ix.copy(), view.place_of[told.frame_ix]
    mine = list_of >= 0
    kind = found.class_probability.argmax(axis=1)
    entries = np.bincount(list_of[mine], minlength=L)
    class_ix = kind if (kind != _OTHER).any() else np.full(len(kind), -1)
    said = {"class_ix": class_ix, "existence": found.existence, "track_id": found.track_id}
    R, objects = len(view.row), len(scene.object_ids)
    row_object = view.states.row_object_ix[view.row]
    key = view.list_ix * objects + row_object
    by_key = np.argsort(key)
    about = np.flatnonzero(mine & (object_ix >= 0) & (object_ix != view.carrier_ix))
    at = by_key[np.searchsorted(key[by_key], list_of[about] * objects + object_ix[about])]
    entry = np.full(R, -1)
    entry[at] = about
    errors = _errors(view, found, entry)
    far = np.hypot(errors["along_m"] / ellipse_m[0], errors["across_m"] / ellipse_m[1]) > 1
    if far.any():
        object_ix[entry[far]] = -1
        entry[far] = -1
        errors = _errors(view, found, entry)
    listed = entry >= 0
    apart = ~_among_others(view, errors, min(gate_m, float(ellipse_m.max())))
    for name in ("along_m", "across_m", "east_m", "north_m", "yaw_rad", "speed_mps", "size_m"):
        errors[name][..., ~apart] = np.nan
    rows: dict[str, Any] = {
        "list": view.list_ix.copy(), "log": np.full(R, number), "object": row_object,
        "captured_s": view.captured_s[view.list_ix], "listed": listed,
        "apart": apart,
        **errors,
        **{name: np.where(listed, column[entry], _missing(column)) for name, column in said.items()},
    }  # fmt: skip
    other = np.flatnonzero(mine & (object_ix < 0))
    return _Piece(rows, _others(number, view, other, list_of[other], rows, said), entries)


def _among_others(view: LogView, errors: dict[str, Any], near_m: float) -> Bool:
    """(R,) which true objects have another so near in the same list that an entry may be about either."""
    places = np.stack([errors["x_m"], errors["y_m"], view.list_ix * _APART_M], axis=1)
    if len(places) < 2:
        return np.zeros(len(places), dtype=bool)
    near: Bool = cKDTree(places).query(places, k=2)[0][:, 1] <= near_m
    return near


def _missing(column: Any) -> float | int:
    return np.nan if column.dtype.kind == "f" else -1


def _errors(view: LogView, found: RecordedLists, entry: Int) -> dict[str, Any]:
    """Entry minus truth of rows (R,), NaN where not listed, or where no entry of the log has such a field."""
    tracks, listed = found.tracks, entry >= 0

    def told(name: str) -> Float:
        column = getattr(tracks, name)[0]
        return np.where(listed, column[entry], np.nan) if column.any() else np.full(len(entry), np.nan)

    def true(name: str) -> Float:
        column: Float = getattr(view.states, name)[0, view.row]
        return column

    east, north = told("x_m") - true("x_m"), told("y_m") - true("y_m")
    bearing = view.view.bearing_rad[view.row]
    cos, sin = np.cos(bearing), np.sin(bearing)
    vx, vy = true("vx_mps"), true("vy_mps")
    speed = np.hypot(vx, vy)
    towards = [(vx, np.cos(true("yaw_rad"))), (vy, np.sin(true("yaw_rad")))]
    ahead_e, ahead_n = (np.where(speed > 0, v / np.maximum(speed, 1e-9), turn) for v, turn in towards)
    east_mps, north_mps = (np.where(listed, column[0, entry], np.nan) for column in (tracks.vx_mps, tracks.vy_mps))
    # Messages have no velocity of stationary objects, and those of some units of none.
    unsaid = (east_mps == 0) & (north_mps == 0) & ~view.scene.moving[view.states.row_object_ix[view.row]]
    if not (tracks.vx_mps.any() or tracks.vy_mps.any()):
        unsaid = np.ones(len(entry), dtype=bool)
    fast = np.where(unsaid, np.nan, east_mps * ahead_e + north_mps * ahead_n)
    return {
        "east_m": east, "north_m": north, "along_m": east * cos + north * sin, "across_m": north * cos - east * sin,
        "yaw_rad": wrap(told("yaw_rad") - true("yaw_rad")), "speed_mps": fast - speed,
        "size_m": np.stack([told(n) - true(n) for n in ("length_m", "width_m", "height_m")]),
        "x_m": true("x_m"), "y_m": true("y_m"), "away_m": np.hypot(east, north),
    }  # fmt: skip


def _others(
    number: int, view: LogView, other: Int, list_ix: Int, rows: dict[str, Any], said: dict[str, Any]
) -> dict[str, Any]:
    """Entries about no true object, and the true object that is nearest to each."""
    tracks = view.found.tracks
    east, north = tracks.x_m[0, other], tracks.y_m[0, other]
    nearest_m, nearest_listed = np.full(len(other), np.inf), np.zeros(len(other), dtype=bool)
    order = np.argsort(view.list_ix, kind="stable")
    bounds = np.searchsorted(view.list_ix[order], np.arange(len(view.captured_s) + 1))
    for k, f in enumerate(list_ix.tolist()):
        there = order[bounds[f] : bounds[f + 1]]
        if len(there):
            away_m = np.hypot(rows["x_m"][there] - east[k], rows["y_m"][there] - north[k])
            nearest = int(away_m.argmin())
            nearest_m[k], nearest_listed[k] = away_m[nearest], rows["listed"][there[nearest]]
    dx, dy = east - view.east_m[list_ix], north - view.north_m[list_ix]
    return {
        "list": list_ix.copy(), "log": np.full(len(other), number), "captured_s": view.captured_s[list_ix],
        "east_m": east, "north_m": north, "range_m": np.hypot(dx, dy),
        "azimuth_rad": wrap(np.arctan2(dy, dx) - view.heading_rad[list_ix]),
        "nearest_m": nearest_m, "nearest_listed": nearest_listed,
        **{name: column[other] for name, column in said.items()},
    }  # fmt: skip
