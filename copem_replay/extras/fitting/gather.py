"""Gather: from a recorded unit over its logs to what a model is fitted to: lists, rows, and entries about no object."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from copem_replay.core.errors import InputError, count_noun
from copem_replay.core.interpolation import interpolate_at_instants, wrap_angles
from copem_replay.core.tracks import CLASSES, Bool, Float, Int, Scene, Tracks
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment, Unit
from copem_replay.extras.fitting.estimate import FEWEST_PASSES
from copem_replay.extras.fitting.rows import FitLists, FitRows, OtherEntries
from copem_replay.io.recorded_lists import RecordedLists
from copem_replay.io.recorded_units import assign_truth_ids, read_as_recorded, shift_captures
from copem_replay.io.recording import Recording
from copem_replay.perception.observation import view_world_from_unit
from copem_replay.perception.sensor_poses import (
    collect_solids,
    compute_unit_poses,
    find_carrier,
    make_observers,
    make_solid_statics,
    unit_ground,
)
from copem_replay.perception.visibility import visible_shares

# A log as its unit sees it.


@dataclass(frozen=True)
class LogView:
    """One log from its unit: lists in order of capture, what they hold, and how each true object looks then."""

    scene: Scene
    truth: Tracks
    found: RecordedLists  # with captures
    place_of: Int  # (F,) by list of `found`: its index in order of capture; −1: not within the truth
    captured_s: Float  # (L,) in order of capture
    east_m: Float
    north_m: Float
    heading_rad: Float
    carrier_ix: int
    list_ix: Int  # (R,) of true objects' rows, in order of object and list
    states: Tracks
    row: Int  # (R,) index into `states` and `view`
    view: ViewGeometry


def check_unit(experiment: Experiment, name: str) -> Unit:
    """The recorded unit that is to be fitted. Raises InputError: no such unit, or its place is not stated."""
    unit = experiment.units.get(name)
    if unit is None or unit.recorded is None:
        names = ", ".join(experiment.recorded) or "none"
        found = "found no such unit" if unit is None else "found one with a pem"
        raise InputError(f"unit {name}: expected a unit whose lists are recorded ({names}), {found}")
    if unit.on is None and unit.at is None:
        raise InputError(f"unit {name}: fit needs its place (`at` or `on`): range and azimuth are seen from there")
    if unit.at is not None and unit.height_m is None:
        raise InputError(f"unit {name}: fit needs its `height_m`: what hides an object depends on it")
    return unit


def raw_lists(recordings: Sequence[Recording], experiment: Experiment, name: str) -> list[RecordedLists]:
    """The lists of a unit in each log, as recorded. Raises InputError, RecordingError."""
    units = [resolve_for_log(experiment, recording.scene.log).units.get(name) for recording in recordings]
    lists = []
    for recording, unit in zip(recordings, units, strict=True):
        if unit is None or unit.recorded is None:
            raise InputError(f"unit {name}: expected its lists in every log, found none in {recording.scene.log}")
        lists.append(read_as_recorded(recording, unit.recorded.topic))
    return lists


def view_log(recording: Recording, lists: RecordedLists, experiment: Experiment, name: str, delay_s: float) -> LogView:
    """A log as its unit sees it. Lists that do not state their capture were captured `delay_s` before their stamps."""
    resolved = resolve_for_log(experiment, recording.scene.log)
    unit, scene = check_unit(resolved, name), recording.scene
    lists = shift_captures(lists, scene, delay_s)
    truth = interpolate_at_instants(
        recording.truth, recording.truth.stamp_ns, t0_ns=scene.t0_ns, max_gap_s=resolved.max_gap_s
    )
    stamps, of_frame = np.unique(lists.tracks.stamp_ns, return_inverse=True)
    world = interpolate_at_instants(truth, stamps, t0_ns=scene.t0_ns, max_gap_s=resolved.max_gap_s)
    carrier_ix = find_carrier(scene, unit)
    host = world.take_tracks(world.object_ix == carrier_ix)
    poses = compute_unit_poses(scene, unit, host, unit_ground(truth, name, unit))
    poses = replace(poses, present=poses.present & (stamps >= scene.t0_ns) & (stamps <= scene.end_ns))
    shares = visible_shares(
        world,
        static=make_solid_statics(collect_solids(scene, truth, resolved.obstacles)),
        observers=make_observers([poses], np.array([carrier_ix])),
        model=resolved.visibility,
    )[0]
    states, view = view_world_from_unit(world, poses, carrier_ix, shares)
    view = replace(view, class_ix=scene.object_class[states.row_object_ix])
    order = np.argsort(of_frame, kind="stable")
    order = order[poses.present[of_frame[order]]]
    place_of = np.full(len(of_frame), -1)
    place_of[order] = np.arange(len(order))
    f = of_frame[order]
    row, list_ix = _repeat_by_list(states, np.flatnonzero(poses.present), f)
    return LogView(
        scene, truth, lists, place_of, (stamps[f] - scene.t0_ns) * np.float64(1e-9), poses.x_m[f], poses.y_m[f],
        poses.heading_rad[f], carrier_ix, list_ix, states, row, view,
    )  # fmt: skip


def _repeat_by_list(states: Tracks, present: Int, instant: Int) -> tuple[Int, Int]:
    """The row of `states`, and the list, of each row: lists that are captured at one instant have rows of their own.

    `present`: the instants at which the unit is there, by which `states` are numbered; `instant (L,)`: of each list.
    """
    first = np.searchsorted(instant, present)
    times = (np.searchsorted(instant, present, side="right") - first)[states.frame_ix]
    row = np.repeat(np.arange(len(states.frame_ix)), times)
    list_ix = first[states.frame_ix[row]] + np.arange(len(row)) - np.repeat(np.cumsum(times) - times, times)
    ordered = np.lexsort((list_ix, states.row_object_ix[row]))
    return row[ordered], list_ix[ordered]


# Reach, passes within it, and folds of a cross-validation.

RANGE_BIN_M, AZIMUTH_BIN_DEG = 5.0, 5.0
"""Bins by which the reach is found. Wider: a coarser reach; narrower: bins with too few entries."""
FEWEST_MATCHED = 5
"""Entries of true objects from which on a bin of range or azimuth counts: fewer may be chance matches."""
LEAST_SHARE = 0.05
"""Share of the rows of a bin that must be matched: fewer are matches with other entries nearby."""
FOLDS = 5
"""Folds of a cross-validation unless stated otherwise: the usual number. More: slower, larger parts are fitted."""


@dataclass(frozen=True)
class FitReach:
    """Where the fitted model applies: nothing is claimed beyond. `azimuth_deg` None: all around."""

    range_m: tuple[float, float]
    azimuth_deg: tuple[float, float] | None

    def holds(self, view: ViewGeometry) -> Bool:
        """(P,) which objects are within reach."""
        low_m, high_m = self.range_m
        is_within: Bool = (view.range_m >= low_m) & (view.range_m <= high_m)
        if self.azimuth_deg is not None:
            first, last = self.azimuth_deg
            turned = np.mod(np.degrees(view.azimuth_rad) - first, 360.0)
            is_within &= turned <= np.mod(last - first, 360.0)
        return is_within


def find_reach(view: ViewGeometry, listed: Bool) -> FitReach | None:
    """From the nearest to the farthest bin with enough matched rows; None: no bin has enough."""
    full = _find_full_bins((view.range_m / RANGE_BIN_M).astype(np.int64), listed)
    if not len(full):
        return None
    range_m = (float(full[0] * RANGE_BIN_M), float((full[-1] + 1) * RANGE_BIN_M))
    inside = (view.range_m >= range_m[0]) & (view.range_m <= range_m[1])
    return FitReach(range_m, _find_sector(np.degrees(view.azimuth_rad[inside]), listed[inside]))


def _find_full_bins(bin_ix: Int, listed: Bool) -> Int:
    """The bins with enough matched rows, ascending."""
    rows, matched = np.bincount(bin_ix), np.bincount(bin_ix[listed], minlength=int(bin_ix.max(initial=0)) + 1)
    return np.flatnonzero((matched >= FEWEST_MATCHED) & (matched >= LEAST_SHARE * rows))


def _find_sector(azimuth_deg: Float, listed: Bool) -> tuple[float, float] | None:
    """First and last azimuth (deg) of all bins but the widest gap; None: no gap, or no full bin."""
    count = round(360 / AZIMUTH_BIN_DEG)
    full_bins = _find_full_bins(np.floor(np.mod(azimuth_deg, 360.0) / AZIMUTH_BIN_DEG).astype(np.int64) % count, listed)
    if not len(full_bins):
        return None
    gap = np.diff(full_bins, append=full_bins[0] + count) - 1
    widest = int(gap.argmax())
    if gap[widest] == 0:
        return None
    sector_first = full_bins[(widest + 1) % len(full_bins)] * AZIMUTH_BIN_DEG
    sector_last = (full_bins[widest] + 1) * AZIMUTH_BIN_DEG
    first_deg = sector_first - 360.0 if sector_first >= 180.0 else sector_first
    last_deg = sector_last - 360.0 if sector_last > 180.0 else sector_last
    return float(first_deg), float(last_deg)


def number_passes(log: Int, object_ix: Int, list_ix: Int) -> Int:
    """(R,) the pass of each row; rows are ordered by log, object and list. A pass ends where a list has no row."""
    new = (np.diff(log, prepend=-1) != 0) | (np.diff(object_ix, prepend=-1) != 0) | (np.diff(list_ix, prepend=-1) != 1)
    number: Int = np.cumsum(new) - 1
    return number


def assign_folds(pass_ix: Int, log: Int, folds: int | None) -> Int:
    """(R,) the fold of each row: whole logs where there are as many, else whole passes; all 0 of too few passes."""
    logs, which_log = np.unique(log, return_inverse=True)
    number = int(pass_ix[-1]) + 1 if len(pass_ix) else 0
    n_folds = folds or FOLDS
    if len(logs) >= n_folds:
        return np.asarray(which_log % n_folds, dtype=np.int64)
    if number < FEWEST_PASSES:
        return np.zeros(len(pass_ix), dtype=np.int64)
    return pass_ix % min(n_folds, number)


# Matching the lists with the truth.

_OTHER = CLASSES.index("other")
_NEAR_GATE = 0.8
"""Share of the gate beyond which a match may well be wrong; how many are farther apart is noted."""
_CONFUSED = 0.5
"""Weight of a match whose classes do not agree: an object that is mistaken for another class is listed, too."""
_APART_M = 1e5
"""Offset between lists in one tree: no object is near one of another list."""
_SIGMAS = 5.0
"""Standard deviations beyond which an entry is not about an object: a Gaussian error is hardly ever so large."""
LONGEST_S = 0.5
"""The longest delay at which matches are sought."""


class NothingMatchedError(InputError):
    """No entry, or hardly any, is near a true object."""


@dataclass(frozen=True)
class Gathered:
    """What is fitted. `reach`: where. `beyond`: the share of matches that are farther apart than 0.8 of the gate."""

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
        """How many passes there are."""
        return int(self.rows.pass_ix[-1]) + 1 if len(self.rows.pass_ix) else 0


def gather_rows(
    views: Sequence[LogView], *, gate_m: float, max_gap_s: float, reach: FitReach | None = None,
    folds: int | None = None, name: str = "",
) -> Gathered:  # fmt: skip
    """Match the lists of all logs with the truth, and put both side by side.

    `reach`: None: the reach of these rows. Raises NothingMatchedError.
    """
    pieces = [_match_log(k, view, (gate_m, max_gap_s), np.full(2, np.inf)) for k, view in enumerate(views)]
    ellipse_m = _ellipse_m(pieces)
    pieces = [_match_log(k, view, (gate_m, max_gap_s), ellipse_m) for k, view in enumerate(views)]
    first_list = np.cumsum([0, *(len(view.captured_s) for view in views)])
    columns = {key: np.concatenate([p.rows[key] for p in pieces], axis=-1) for key in pieces[0].rows}
    other_columns = {key: np.concatenate([p.others[key] for p in pieces]) for key in pieces[0].others}
    view_of_rows = ViewGeometry(
        **{
            f: np.concatenate([getattr(view.view, f)[view.row] for view in views])
            for f in ViewGeometry.__dataclass_fields__
        }
    )
    log = columns["log"]
    columns["list"] += first_list[log]
    other_columns["list"] += first_list[other_columns["log"]]
    entries = np.concatenate([piece.entries for piece in pieces])
    where = ("captured_s", "east_m", "north_m", "heading_rad")
    lists = FitLists(
        log=np.repeat(np.arange(len(views)), [len(view.captured_s) for view in views]),
        **{name: np.concatenate([getattr(view, name) for view in views]) for name in where},
        entries=entries,
    )
    reach = reach or find_reach(view_of_rows, columns["listed"])
    if reach is None:
        count, matched = count_noun(int(entries.sum()), "entry", "entries"), int(columns["listed"].sum())
        of_unit, near = f"of unit {name}'s {count}", f"within {gate_m:g} m of a true object"
        raise NothingMatchedError(
            f"only {matched} {of_unit} are {near}: too few to fit" if matched
            else f"nothing {of_unit} is {near} at any delay up to {LONGEST_S:g} s: other frame, or other clock?"
        )  # fmt: skip
    rows_in_reach = np.flatnonzero(reach.holds(view_of_rows))
    columns = {key: column[..., rows_in_reach] for key, column in columns.items()}
    away_m = columns.pop("away_m")
    notes = [line for name in ("yaw_rad", "speed_mps", "size_m") for line in _remove_outliers(name, columns[name])]
    pass_ix = number_passes(columns["log"], columns["object"], columns["list"])
    state_m = np.stack([columns.pop("x_m"), columns.pop("y_m")], axis=1)
    rows = FitRows(
        **columns, pass_ix=pass_ix, view=view_of_rows.take(rows_in_reach), state_m=state_m,
        fold=assign_folds(pass_ix, columns["log"], folds),
    )  # fmt: skip
    matched = int(rows.listed.sum())
    rows_in_list = np.bincount(rows.list, minlength=len(entries))
    crowded = bool((np.bincount(other_columns["list"], minlength=len(entries)) > rows_in_list).any())
    beyond = float((away_m[rows.listed] > _NEAR_GATE * gate_m).mean()) if matched else 0.0
    return Gathered(lists, rows, OtherEntries(**other_columns), reach, matched, beyond, crowded, tuple(notes))


def _remove_outliers(name: str, values: Float) -> Iterator[str]:
    """Set errors (…, R) beyond five standard deviations to NaN, and note how many there are."""
    size = np.abs(values)
    finite = np.isfinite(size)
    far = finite & (size > _SIGMAS / 1.96 * np.quantile(size[finite], 0.95)) if finite.any() else finite
    if far.any():
        values[far] = np.nan
        what, count = name.partition("_")[0], count_noun(int(far.sum()), "error")
        yield f"{count} of {what} beyond {_SIGMAS:g} standard deviations (flips, other objects): left out of its spread"


@dataclass(frozen=True)
class _MatchedLog:
    """One log, matched: columns of rows (R,) and of other entries (E,), and how many entries lists (L,) hold."""

    rows: dict[str, Any]
    others: dict[str, Any]
    entries: Int


def _ellipse_m(pieces: Sequence[_MatchedLog]) -> Float:
    """(2,) half axes, along and across the line of sight, beyond which an entry is no match.

    Five standard deviations of a Gaussian with the 95 % quantile of the errors; a metre at least.
    """
    error_m = np.stack([np.concatenate([piece.rows[name] for piece in pieces]) for name in ("along_m", "across_m")])
    error_m = np.abs(error_m[:, np.isfinite(error_m[0])])
    half_m: Float = np.quantile(error_m, 0.95, axis=1) / 1.96 * _SIGMAS if error_m.size else np.full(2, np.inf)
    return np.maximum(half_m, 1.0)


def _match_log(number: int, view: LogView, gates: tuple[float, float], ellipse_m: Float) -> _MatchedLog:
    """Rows of one log (true objects by list) with their entries, and entries about no object; `gates`: m and s."""
    gate_m, max_gap_s = gates
    lists, scene, L = view.found, view.scene, len(view.captured_s)
    # To a unit the ego is an object like any other.
    assigned = assign_truth_ids(
        lists, replace(scene, ego_ix=-1), view.truth, gate_m=gate_m, max_gap_s=max_gap_s, confused=_CONFUSED
    )
    object_ix, list_of = assigned.row_object_ix.copy(), view.place_of[assigned.frame_ix]
    is_in_list = list_of >= 0
    entry_class = lists.class_probability.argmax(axis=1)
    entries = np.bincount(list_of[is_in_list], minlength=L)
    class_ix = entry_class if (entry_class != _OTHER).any() else np.full(len(entry_class), -1)
    fields = {"class_ix": class_ix, "existence": lists.existence, "track_id": lists.track_id}
    R, objects = len(view.row), len(scene.object_ids)
    row_object = view.states.row_object_ix[view.row]
    key = view.list_ix * objects + row_object
    row_by_key = np.argsort(key)
    matched = np.flatnonzero(is_in_list & (object_ix >= 0) & (object_ix != view.carrier_ix))
    rows_of_matched = row_by_key[np.searchsorted(key[row_by_key], list_of[matched] * objects + object_ix[matched])]
    entry = np.full(R, -1)
    entry[rows_of_matched] = matched
    errors = _error_columns(view, lists, entry)
    is_far = np.hypot(errors["along_m"] / ellipse_m[0], errors["across_m"] / ellipse_m[1]) > 1
    object_ix[entry[is_far]] = entry[is_far] = -1
    listed = entry >= 0
    places = np.stack([errors["x_m"], errors["y_m"], view.list_ix * _APART_M], axis=1)
    # An entry near several true objects of a list may be about either.
    is_apart = cKDTree(places).query(places, k=2)[0][:, 1] > min(gate_m, float(ellipse_m.max()))
    for name in ("along_m", "across_m", "east_m", "north_m", "yaw_rad", "speed_mps", "size_m"):
        errors[name][..., ~is_apart | is_far] = np.nan
    rows: dict[str, Any] = {
        "list": view.list_ix.copy(), "log": np.full(R, number), "object": row_object,
        "captured_s": view.captured_s[view.list_ix], "listed": listed,
        "apart": is_apart,
        **errors,
        **{name: np.where(listed, of[entry], np.nan if of.dtype.kind == "f" else -1) for name, of in fields.items()},
    }  # fmt: skip
    other = np.flatnonzero(is_in_list & (object_ix < 0))
    other = other[np.argsort(list_of[other], kind="stable")]
    return _MatchedLog(rows, _other_columns(number, view, other, list_of[other], rows, fields), entries)


def _error_columns(view: LogView, lists: RecordedLists, entry: Int) -> dict[str, Any]:
    """Entry minus truth of rows (R,), by column; NaN: not listed, or no entry of the log has the field."""
    tracks, listed = lists.tracks, entry >= 0

    def listed_value(name: str) -> Float:
        column = getattr(tracks, name)[0]
        return np.where(listed, column[entry], np.nan) if column.any() else np.full(len(entry), np.nan)

    def true_value(name: str) -> Float:
        column: Float = getattr(view.states, name)[0, view.row]
        return column

    east, north = listed_value("x_m") - true_value("x_m"), listed_value("y_m") - true_value("y_m")
    bearing = view.view.bearing_rad[view.row]
    cos, sin = np.cos(bearing), np.sin(bearing)
    vx, vy = true_value("vx_mps"), true_value("vy_mps")
    speed = np.hypot(vx, vy)
    components = [(vx, np.cos(true_value("yaw_rad"))), (vy, np.sin(true_value("yaw_rad")))]
    ahead_e, ahead_n = (np.where(speed > 0, v / np.maximum(speed, 1e-9), turn) for v, turn in components)
    east_mps, north_mps = (np.where(listed, column[0, entry], np.nan) for column in (tracks.vx_mps, tracks.vy_mps))
    # Messages state no velocity of stationary objects; some units state none at all.
    unstated = (east_mps == 0) & (north_mps == 0) & ~view.scene.moving[view.states.row_object_ix[view.row]]
    if not (tracks.vx_mps.any() or tracks.vy_mps.any()):
        unstated = np.ones(len(entry), dtype=bool)
    speed_listed = np.where(unstated, np.nan, east_mps * ahead_e + north_mps * ahead_n)
    return {
        "east_m": east, "north_m": north, "along_m": east * cos + north * sin, "across_m": north * cos - east * sin,
        "yaw_rad": wrap_angles(listed_value("yaw_rad") - true_value("yaw_rad")), "speed_mps": speed_listed - speed,
        "size_m": np.stack([listed_value(n) - true_value(n) for n in ("length_m", "width_m", "height_m")]),
        "x_m": true_value("x_m"), "y_m": true_value("y_m"), "away_m": np.hypot(east, north),
    }  # fmt: skip


def _other_columns(
    number: int, view: LogView, other: Int, list_ix: Int, rows: dict[str, Any], fields: dict[str, Any]
) -> dict[str, Any]:
    """Columns (E,) of the entries `other`, about no true object: place, class, and the nearest true object."""
    tracks = view.found.tracks
    east, north = tracks.x_m[0, other], tracks.y_m[0, other]
    places = np.stack([rows["x_m"], rows["y_m"], view.list_ix * _APART_M], axis=1)
    entry_places = np.stack([east, north, list_ix * _APART_M], axis=1)
    if len(places) and len(entry_places):
        nearest_m, nearest_row = cKDTree(places).query(entry_places)
    else:
        nearest_m, nearest_row = np.full(len(other), np.inf), np.zeros(len(other), dtype=np.int64)
    nearest_class = view.view.class_ix[view.row][nearest_row] if len(places) else np.full(len(other), -1)
    dx, dy = east - view.east_m[list_ix], north - view.north_m[list_ix]
    return {
        "list": list_ix.copy(), "log": np.full(len(other), number), "captured_s": view.captured_s[list_ix],
        "east_m": east, "north_m": north, "range_m": np.hypot(dx, dy),
        "azimuth_rad": wrap_angles(np.arctan2(dy, dx) - view.heading_rad[list_ix]),
        "nearest_m": np.where(nearest_m < _APART_M / 2, nearest_m, np.inf), "nearest_class_ix": nearest_class,
        **{name: column[other] for name, column in fields.items()},
    }  # fmt: skip
