"""ScenarioNet scenario descriptions: one pickle with a dict of arrays, T steps long, from nuScenes and others.

nuScenes, as ScenarioNet writes it: labels of 2 Hz interpolated to 10 Hz; the ego vehicle has length and width swapped
(1.73 × 4.08 m) and its z is 0; its position is that of the rear axle on the ground (nuscenes-devkit issues 108 and
161), not the centre; the velocity beside a step without the object is 0, whatever the object does. `valid` says which
steps count: elsewhere there are zeros. Positions of everything else are centres.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from copem_replay.core.errors import InputError, count_noun, quote_value
from copem_replay.core.tracks import Bool, Float
from copem_replay.io.convert import restricted_pickle
from copem_replay.io.convert.conversion import (
    KINDS,
    LAST_SECOND,
    Box,
    ConversionReport,
    ConvertedFrame,
    OsiKind,
    PlannedRecording,
    number_names,
    wrap_yaw,
)
from copem_replay.io.convert.nuscenes import EGO_CENTRE_M, find_kind

_MOST_COLUMNS: Final = 16  # of an array; formats have at most 3
_FARTHEST_M: Final = 1e8  # of lines of the map
_MOST_STEPS: Final = 10_000_000  # eleven days at 10 Hz; a longer array is an error

_KIND_OF_METADRIVE: Final = {
    "VEHICLE": "vehicle",
    "PEDESTRIAN": "pedestrian",
    "CYCLIST": "bicycle",
    "TRAFFIC_BARRIER": "barrier",
    "TRAFFIC_CONE": "cone",
    "TRAFFIC_OBJECT": "static",
    "OTHER": "other",
}


@dataclass(frozen=True)
class _Track:
    """One object, (T,) and (T, n) each."""

    kind: OsiKind
    valid: Bool
    at_m: Float  # (T, 3)
    yaw_rad: Float
    size_m: Float  # (T, 3)
    velocity_mps: Float  # (T, 2), NaN: not given


# Folders of ScenarioNet: a pickle for each scenario, in a folder for each worker, and two with indexes. The mapping
# names the files and their folders relative to itself: a data set may be nothing but a mapping to others. Without it
# all pickles in the folder and below are scenarios.

_MAPPING: Final = "dataset_mapping.pkl"
_SUMMARY: Final = "dataset_summary.pkl"  # of metadata that the scenarios have, too


def list_recordings(source: Path) -> dict[str, PlannedRecording] | None:
    """The scenarios of a folder; None: a file is one. Raises InputError."""
    if not source.is_dir():
        return None
    return {name: PlannedRecording(path) for name, path in find_scenarios(source).items()}


def find_scenarios(folder: Path) -> dict[str, Path]:
    """Files of the scenarios by their names without the ending, in order of the names. Raises InputError."""
    mapping = folder / _MAPPING
    files = _read_mapping(mapping) if mapping.is_file() else sorted(folder.rglob("*.pkl"))
    found: dict[str, Path] = {}
    for path in sorted(files, key=lambda path: path.name):
        if path.name in (_MAPPING, _SUMMARY):
            continue
        if (other := found.setdefault(path.stem, path)) != path:
            raise InputError(f"{folder}: expected one scenario {path.stem}, found {other} and {path}")
    if not found:
        raise InputError(f"{folder}: expected scenarios of ScenarioNet, found no *.pkl in the folder")
    return found


def _read_mapping(mapping: Path) -> list[Path]:
    places = restricted_pickle.load_pickle(mapping)
    if not isinstance(places, dict):
        raise InputError(f"{mapping}: expected the folder of each scenario by its file, found {type(places).__name__}")
    for name, place in places.items():
        if not (isinstance(name, str) and isinstance(place, str)) or not name or Path(name).name != name:
            raise InputError(
                f"{mapping}: expected files and their folders, found {quote_value(name)} in {quote_value(place)}"
            )
    return [mapping.parent / place / name for name, place in places.items()]


def frames(path: Path, report: ConversionReport, *, ego_centre_m: float | None = None) -> Iterator[ConvertedFrame]:
    """All steps, with the track of `sdc_id` as host. Raises InputError.

    `ego_centre_m`: of the ego's box ahead of the position given for it; None: `EGO_CENTRE_M` for nuScenes, else 0.
    """
    scenario = restricted_pickle.load_pickle(path)
    metadata = _get_part(scenario, "metadata", dict, str(path))
    stamps_ns = _read_stamps(metadata, f"{path}: metadata")
    named = {str(name): track for name, track in _get_part(scenario, "tracks", dict, str(path)).items()}
    ids = number_names(named)
    host = None if metadata.get("sdc_id") is None else str(metadata["sdc_id"])
    if host not in ids:
        report.assume("no ego vehicle: " + ("no sdc_id" if host is None else f"no track {host} (sdc_id)"))
    tracks = {
        name: _read_track(track, len(stamps_ns), f"{path}: track {name}", report, ego=name == host)
        for name, track in named.items()
    }
    if host in tracks:
        if ego_centre_m is None:
            ego_centre_m = EGO_CENTRE_M if metadata.get("dataset") == "nuscenes" else 0.0
        if ego_centre_m:
            report.assume(f"position of the ego vehicle ({host}): its rear axle, the centre {ego_centre_m:g} m ahead")
            _move_ahead(tracks[host], ego_centre_m)
    report.names |= {ids[name]: name for name in tracks}
    lines = _read_road_lines(scenario, str(path), report)
    for step, stamp_ns in enumerate(stamps_ns):
        boxes = [_make_box(ids[name], t, step) for name, t in tracks.items() if t.valid[step]]
        yield ConvertedFrame(stamp_ns, boxes, ids.get(host) if host is not None else None, lines if step == 0 else ())


def _read_road_lines(scenario: Any, where: str, report: ConversionReport) -> list[Float]:
    """Lines on the road and outlines of lanes, (K, 3) each, thinned to 5 cm; lanes without an outline have none."""
    import shapely

    lines, features = list[Float](), scenario.get("map_features") if isinstance(scenario, dict) else None
    for name, feature in features.items() if isinstance(features, dict) else ():
        kind = str(feature.get("type", "")) if isinstance(feature, dict) else ""
        key = "polyline" if kind.startswith("ROAD_") else "polygon" if kind.startswith("LANE_") else None
        if key is None or key not in feature:
            continue
        points = _read_points(feature[key], f"{where}: map_features {name}: {key}")
        if len(points) > 1:
            lines.append(shapely.get_coordinates(shapely.LineString(points).simplify(0.05), include_z=True))
    report.count("line", "of the road taken as lane boundaries", len(lines))
    return lines


def _read_points(value: Any, where: str) -> Float:
    """Points (K, 3), z = 0 where there is none. Raises InputError."""
    try:
        points = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not (np.abs(points) <= _FARTHEST_M).all():
        raise InputError(f"{where}: expected rows of 2 or 3 numbers of at most {_FARTHEST_M:g}, found something else")
    return np.concatenate([points, np.zeros((len(points), 3 - points.shape[1]))], axis=1)


def _make_box(ident: int, track: _Track, step: int) -> Box:
    x, y, z = track.at_m[step].tolist()
    length, width, height = track.size_m[step].tolist()
    vx, vy = track.velocity_mps[step].tolist()
    yaw_rad = float(track.yaw_rad[step])
    yaw_rad = wrap_yaw(yaw_rad) if np.isfinite(yaw_rad) else yaw_rad
    return Box(ident, track.kind, (x, y, z), yaw_rad, (length, width, height), (vx, vy))


def _read_track(track: Any, steps: int, where: str, report: ConversionReport, *, ego: bool) -> _Track:
    state = _get_part(track, "state", dict, where)
    valid = _read_array(state, "valid", steps, 1, where)[:, 0] > 0.5
    position = _read_array(state, "position", steps, 0, where)
    if position.shape[1] not in (2, 3):
        raise InputError(f"{where}: position: expected 2 or 3 columns, found {position.shape[1]}")
    at_m = np.zeros((steps, 3))
    at_m[:, : position.shape[1]] = position
    size_m = np.concatenate(
        [_read_array(state, name, steps, 1, where) for name in ("length", "width", "height")], axis=1
    )
    if ego and (swapped := valid & (size_m[:, 0] < size_m[:, 1])).any():
        found = "×".join(f"{v:g}" for v in size_m[swapped][0, :2])
        report.count(
            "state", f"of the ego vehicle with length and width swapped ({found} m): put right", int(swapped.sum())
        )
        size_m[swapped, :2] = size_m[swapped, 1::-1]
    if valid.any() and not at_m[valid, 2].any():
        report.count("track", "at z = 0 throughout: taken as the ground, the centre half a height above")
        at_m[:, 2] = size_m[:, 2] / 2
    velocity = np.full((steps, 2), np.nan)
    if "velocity" in state:
        velocity = _read_array(state, "velocity", steps, 0, where)[:, :2].copy()
        if velocity.shape[1] != 2:
            raise InputError(f"{where}: velocity: expected 2 or 3 columns, found 1")
        beside = np.concatenate([[True], ~valid[:-1]]) | np.concatenate([~valid[1:], [True]])
        unknown = valid & beside & ~velocity.any(axis=1)
        report.count("state", "at the ends of tracks with velocity 0: taken as not given", int(unknown.sum()))
        velocity[unknown] = np.nan
    yaw_rad = _read_array(state, "heading", steps, 1, where)[:, 0]
    return _Track(_map_kind(track, report), valid, at_m, yaw_rad, size_m, velocity)


def _move_ahead(track: _Track, ahead_m: float) -> None:
    """Move all positions along the heading, in place."""
    track.at_m[:, 0] += ahead_m * np.cos(track.yaw_rad)
    track.at_m[:, 1] += ahead_m * np.sin(track.yaw_rad)


def _map_kind(track: Mapping[str, Any], report: ConversionReport) -> OsiKind:
    """The kind of an object, by its category in nuScenes if it has one, else by its type in MetaDrive."""
    metadata = track.get("metadata")
    category = str(metadata.get("type", "")) if isinstance(metadata, dict) else ""
    if name := find_kind(category):
        return KINDS[name]
    if (kind := str(track.get("type"))) not in _KIND_OF_METADRIVE:
        report.count("track", f"of the unknown type {quote_value(kind)}: taken as other")
    return KINDS[_KIND_OF_METADRIVE.get(kind, "other")]


def _read_stamps(metadata: Mapping[str, Any], where: str) -> list[int]:
    """Nanoseconds of each step, from seconds; whole microseconds: they come as 0.30000000000000004 and as float32."""
    name = next((name for name in ("ts", "timestep") if name in metadata), None)
    if name is None:
        raise InputError(f"{where}: expected the times of the steps in `ts`, found {', '.join(map(str, metadata))}")
    try:
        times = np.asarray(metadata[name])
        times_s = times.astype(np.float64).ravel() if times.size <= _MOST_STEPS else np.empty(0)
    except (TypeError, ValueError):
        raise InputError(f"{where}: {name}: expected numbers, found {quote_value(metadata[name])}") from None
    if not len(times_s) or not (np.isfinite(times_s).all() and (np.abs(times_s) <= LAST_SECOND).all()):
        raise InputError(f"{where}: {name}: expected times in seconds, found {quote_value(metadata[name])}")
    stamps: list[int] = (np.round(times_s * 1e6).astype(np.int64) * 1000).tolist()
    return stamps


def _get_part(whole: Any, key: str, kind: type, where: str) -> Any:
    """Return a part of a dict. Raises InputError."""
    if not isinstance(whole, dict) or not isinstance(whole.get(key), kind):
        found = ", ".join(map(str, list(whole)[:8])) if isinstance(whole, dict) else type(whole).__name__
        raise InputError(f"{where}: expected a ScenarioNet description with {key!r}, found {found}")
    return whole[key]


def _read_array(state: Mapping[str, Any], name: str, steps: int, columns: int, where: str) -> Float:
    """(T, n) array of a state; `columns` of 0: any number of them. Raises InputError."""
    if name not in state:
        raise InputError(f"{where}: expected {name!r} in its state, found {', '.join(map(str, state))}")
    try:
        values = np.asarray(state[name])
        most = columns or _MOST_COLUMNS
        # Checked before any number is converted: an empty array can have any shape.
        if values.ndim not in (1, 2) or len(values) != steps or not steps <= values.size <= steps * most:
            raise InputError(
                f"{where}: {name}: expected {count_noun(steps, 'step')} of up to {most}, as `ts` has, "
                f"found shape {values.shape}"
            )
        return values.astype(np.float64).reshape(steps, -1)
    except (TypeError, ValueError):
        raise InputError(f"{where}: {name}: expected an array of numbers, found {quote_value(state[name])}") from None
