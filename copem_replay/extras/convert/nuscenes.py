"""nuScenes tables and T4 (TIER IV): a folder of JSON tables, of which each scene becomes a recording.

Annotations are boxes in the frame of the map: the centre, width length height, a quaternion w x y z. They are there at
key frames alone, 2 Hz in nuScenes; `ego_pose` is the rear axle on the ground. Stamps are microseconds of Unix time.
Names of columns and categories are those of nuscenes-devkit and t4-devkit (Apache-2.0). A T4 data set has its tables
in `annotation/`, and categories without the groups before them (`car`, not `vehicle.car`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np

from copem_replay.core.errors import InputError, count_noun, quote_value
from copem_replay.core.files import avoid_device_name
from copem_replay.core.tracks import Float
from copem_replay.extras.convert.conversion import (
    KINDS,
    LARGEST_M,
    LAST_SECOND,
    Box,
    ConversionReport,
    ConvertedFrame,
    OsiKind,
    PlannedRecording,
    parse_number,
    parse_vector,
    rotation_from_quaternion,
    sign_files,
    wrap_yaw,
)

EGO_CENTRE_M: Final = 1.385
"""Centre of nuScenes' Renault Zoe ahead of its rear axle: as in py123d, from the model's data."""
EGO_SIZE_M: Final = (4.084, 1.73, 1.562)
"""Length, width, height of that car."""
RATE_HZ: Final = 10.0
"""Frames a second between key frames: a truth of 2 Hz has a gap wherever key frames are 0.51 s apart."""

_EGO: Final = "ego"
_LONGEST_NS: Final = 1_050_000_000  # between key frames that are interpolated: one of 2 Hz may be missing
_NEAR_M: Final = 100.0  # lanes within this distance of the ego's path


# Tables: lists of rows. The largest has 2.6 million, a GB of text: rows are taken one by one, and those not used go.


def list_recordings(source: Path) -> dict[str, PlannedRecording]:
    """The scenes, by their names as those of files. Raises InputError."""
    if not source.is_dir():
        raise InputError(f"{source}: expected the folder of a nuScenes or T4 data set, found a file")
    folder = _find_tables(source)
    scenes: dict[str, PlannedRecording] = {}
    for row in _read_rows(folder / "scene.json", "token", "name"):
        name = avoid_device_name(quote(row["name"], safe=" ")) or row["token"]
        if name in scenes:
            raise InputError(f"{folder / 'scene.json'}: expected one scene {name}, found several")
        scenes[name] = PlannedRecording(source, {"scene": row["token"]})
    if not scenes:
        raise InputError(f"{folder / 'scene.json'}: expected scenes, found none")
    return scenes


def _find_tables(source: Path) -> Path:
    """The folder with the tables: this one, or the only one of a version below. Raises InputError: none or several."""
    if (source / "scene.json").is_file():
        return source
    folders = sorted(
        {path.parent for pattern in ("*/scene.json", "*/annotation/scene.json") for path in source.glob(pattern)}
    )
    if len(folders) == 1:
        return folders[0]
    count_words = (
        "none of them"
        if not folders
        else f"several: {', '.join(str(path.relative_to(source)) for path in folders)}; name one"
    )
    raise InputError(f"{source}: expected the tables of one version (scene.json, sample.json, …), found {count_words}")


def _read_rows(path: Path, *texts: str) -> Iterator[dict[str, Any]]:
    """The rows of a table, each with `texts`, keys that have to be texts. Raises InputError."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; a nuScenes or T4 data set has one") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected JSON in UTF-8, found something else: {error}") from None
    decode, space = json.JSONDecoder().raw_decode, json.decoder.WHITESPACE.match  # type: ignore[attr-defined]
    number, position = 0, space(text, 0).end()
    try:
        if text[position : position + 1] != "[":
            raise InputError(f"{path}: expected a list of rows, found {quote_value(text[position : position + 40])}")
        position = space(text, position + 1).end()
        while text[position : position + 1] != "]":
            row, position = decode(text, position)
            number += 1
            for key in texts:
                if not isinstance(row, dict) or not isinstance(row.get(key), str):
                    raise InputError(
                        f"{path}: row {number}: expected an object with the text {key!r}, found {quote_value(row)}"
                    )
            yield row
            position = space(text, position).end()
            if text[position : position + 1] == ",":
                position = space(text, position + 1).end()
            elif text[position : position + 1] != "]":
                raise json.JSONDecodeError("Expecting ',' or ']'", text, position)
    except json.JSONDecodeError as error:
        line = text.count("\n", 0, error.pos) + 1
        raise InputError(
            f"{path}:{line}: expected JSON, found something else or its end after {count_noun(number, 'row')}"
        ) from None
    except RecursionError:
        raise InputError(f"{path}: row {number + 1}: expected a row, found values within values without end") from None


@dataclass(frozen=True)
class _Sample:
    """A key frame."""

    token: str
    stamp_ns: int


@dataclass(frozen=True)
class _Tables:
    """What is used of the tables."""

    samples: Mapping[str, list[_Sample]]  # of each scene, in order of time
    ego: Mapping[str, tuple[Float, Float]]  # of each sample: position (3,), quaternion (4,)
    boxes: Mapping[str, list[tuple[str, Float]]]  # of each sample: instance, position size quaternion (10,)
    category: Mapping[str, str]  # of each instance
    location: Mapping[str, str]  # of each scene


@lru_cache(maxsize=1)
def _read_tables(folder: Path, _signature: object) -> _Tables:
    """The tables of a data set, read once for all scenes as long as the files stay. Raises InputError."""
    scene_of: dict[str, str] = {}
    samples: dict[str, list[_Sample]] = {}
    stamp_us: dict[str, float] = {}
    for number, row in enumerate(_read_rows(folder / "sample.json", "token", "scene_token"), start=1):
        token, stamp = row["token"], _read_stamp(row, f"{folder / 'sample.json'}: row {number}")
        scene_of[token], stamp_us[token] = row["scene_token"], stamp
        samples.setdefault(row["scene_token"], []).append(_Sample(token, 1000 * round(stamp)))
    for of_scene in samples.values():
        of_scene.sort(key=lambda sample: sample.stamp_ns)
    categories = {row["token"]: row["name"] for row in _read_rows(folder / "category.json", "token", "name")}
    instances = {
        row["token"]: row["category_token"] for row in _read_rows(folder / "instance.json", "token", "category_token")
    }
    for instance, token in instances.items():
        if token not in categories:
            raise InputError(
                f"{folder / 'instance.json'}: expected a category of category.json, found {token!r} of {instance}"
            )
    boxes: dict[str, list[tuple[str, Float]]] = {}
    path = folder / "sample_annotation.json"
    for number, row in enumerate(_read_rows(path, "token", "sample_token", "instance_token"), start=1):
        where = f"{path}: row {number}"
        if row["instance_token"] not in instances:
            raise InputError(f"{where}: expected an instance of instance.json, found {row['instance_token']!r}")
        values = _read_vectors(row, ("translation", "size", "rotation"), where)
        boxes.setdefault(row["sample_token"], []).append((row["instance_token"], np.concatenate(values)))
    category = {instance: categories[token] for instance, token in instances.items()}
    return _Tables(samples, _read_ego_poses(folder, stamp_us), boxes, category, _read_locations(folder))


def _read_ego_poses(folder: Path, stamp_us: Mapping[str, float]) -> dict[str, tuple[Float, Float]]:
    """By key frame the ego's position and quaternion: those of the lidar's data, else of the sensor nearest in time."""
    lidars = {
        row["token"] for row in _read_rows(folder / "sensor.json", "token", "modality") if row["modality"] == "lidar"
    }
    by_lidar = {
        row["token"]
        for row in _read_rows(folder / "calibrated_sensor.json", "token", "sensor_token")
        if row["sensor_token"] in lidars
    }
    best_pose: dict[str, tuple[bool, float, str, str]] = {}
    path = folder / "sample_data.json"
    texts = ("token", "sample_token", "ego_pose_token", "calibrated_sensor_token")
    for number, row in enumerate(_read_rows(path, *texts), start=1):
        if row.get("is_key_frame") and (sample := row["sample_token"]) in stamp_us:
            apart = abs(_read_stamp(row, f"{path}: row {number}") - stamp_us[sample])
            rank = (row["calibrated_sensor_token"] not in by_lidar, apart, row["token"], row["ego_pose_token"])
            best_pose[sample] = min(best_pose.get(sample, rank), rank)
    wanted = {pose for *_, pose in best_pose.values()}
    path, poses = folder / "ego_pose.json", dict[str, tuple[Float, Float]]()
    for number, row in enumerate(_read_rows(path, "token"), start=1):
        if row["token"] in wanted:
            where = f"{path}: row {number}"
            position, quaternion = _read_vectors(row, ("translation", "rotation"), where)
            poses[row["token"]] = position, quaternion
    return {sample: poses[pose] for sample, (*_, pose) in best_pose.items() if pose in poses}


def _read_locations(folder: Path) -> dict[str, str]:
    """Of each scene the name of its map; none where there is no table of logs."""
    if not (folder / "log.json").is_file():
        return {}
    logs = {row["token"]: row["location"] for row in _read_rows(folder / "log.json", "token", "location")}
    scenes = _read_rows(folder / "scene.json", "token", "log_token")
    return {row["token"]: logs[row["log_token"]] for row in scenes if row["log_token"] in logs}


def _read_stamp(row: Mapping[str, Any], where: str) -> float:
    """Microseconds; they are whole, below 2⁵³."""
    stamp = parse_number(row.get("timestamp"), f"{where}: timestamp")
    if not 0 <= stamp <= LAST_SECOND * 1e6:
        raise InputError(f"{where}: timestamp: expected microseconds of 0 to {LAST_SECOND} s, found {stamp:g}")
    return stamp


_COUNTS: Final = {"translation": 3, "size": 3, "rotation": 4}


def _read_vectors(row: Mapping[str, Any], keys: Sequence[str], where: str) -> list[Float]:
    return [parse_vector(row.get(key), _COUNTS[key], f"{where}: {key}") for key in keys]


# Frames.


@dataclass(frozen=True)
class _Pose:
    """An object at an instant: its kind, and x y z yaw length width height (7,)."""

    kind: OsiKind
    values: Float


def frames(
    source: Path,
    report: ConversionReport,
    *,
    scene: str | None = None,
    rate_hz: float | None = RATE_HZ,
    ego_size_m: tuple[float, float, float] = EGO_SIZE_M,
    ego_centre_m: float = EGO_CENTRE_M,
) -> Iterator[ConvertedFrame]:
    """A scene with the ego vehicle as host. Raises InputError. `scene`: its token, None: there is only one. `rate_hz`:
    of the frames between key frames, None: none.
    """
    folder = _find_tables(source)
    tables = _read_tables(folder, sign_files(folder.glob("*.json")))
    if scene is None:
        planned = list_recordings(source)
        if len(planned) > 1:
            raise InputError(f"{source}: expected one scene, found {len(planned)}: name one")
        scene = next(iter(planned.values())).options["scene"]
    ids, keys = {_EGO: 1}, list[tuple[int, dict[int, _Pose]]]()
    for sample in tables.samples.get(scene, ()):
        if sample.token not in tables.ego:
            report.count("key frame", "without an ego pose: skipped")
            continue
        keys.append((sample.stamp_ns, _place_objects(sample, tables, ids, report, ego_size_m, ego_centre_m)))
    report.names |= {number: name for name, number in ids.items()}
    size = "×".join(f"{v:g}" for v in ego_size_m)
    report.assume(
        f"ego vehicle: id 1, {size} m, its centre {ego_centre_m:g} m ahead of its pose, the rear axle on the ground"
    )
    if not any(len(objects) > 1 for _, objects in keys):
        report.assume("no annotations: nothing but the ego vehicle")
    lines = _read_lanes(source, folder, tables.location.get(scene, ""), keys, report)
    for frame in _fill_between(keys, rate_hz, report):
        yield ConvertedFrame(*frame, host=1, lines=lines)
        lines = []


def _place_objects(
    sample: _Sample,
    tables: _Tables,
    ids: dict[str, int],
    report: ConversionReport,
    ego_size_m: tuple[float, float, float],
    ego_centre_m: float,
) -> dict[int, _Pose]:
    """All objects of a key frame by number, the ego as 1; `ids` gets the numbers of new ones."""
    at_m, quaternion = tables.ego[sample.token]
    yaw_rad = _find_yaws(quaternion[None])[0]
    centre_offset_m = [ego_centre_m * math.cos(yaw_rad), ego_centre_m * math.sin(yaw_rad), ego_size_m[2] / 2]
    objects = {1: _Pose(KINDS["car"], np.array([*(at_m + centre_offset_m), yaw_rad, *ego_size_m]))}
    boxes = tables.boxes.get(sample.token, [])
    yaws = _find_yaws(np.array([values[6:] for _, values in boxes]).reshape(-1, 4))
    for (instance, values), yaw_rad in zip(boxes, yaws, strict=True):
        width, length, height = values[3:6]
        pose = np.array([*values[:3], yaw_rad, length, width, height])
        objects[ids.setdefault(instance, len(ids) + 1)] = _Pose(report.find_kind(tables.category[instance]), pose)
    return objects


def _find_yaws(quaternions: Float) -> Float:
    """Yaws (N,) of quaternions (N, 4), w x y z."""
    R = rotation_from_quaternion(*quaternions.T)
    yaws: Float = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return yaws


def _fill_between(
    keys: list[tuple[int, dict[int, _Pose]]], rate_hz: float | None, report: ConversionReport
) -> Iterator[tuple[int, list[Box]]]:
    """Time (ns) and boxes of key frames, and between two, of objects that both have, in straight lines."""
    interpolated = 0
    for k, (stamp_ns, objects) in enumerate(keys):
        yield stamp_ns, [_make_box(number, pose.kind, pose.values) for number, pose in objects.items()]
        later_ns, after = keys[k + 1] if k + 1 < len(keys) else (stamp_ns, {})
        gap_ns = later_ns - stamp_ns
        if rate_hz is None or not 0 < gap_ns <= _LONGEST_NS:
            continue
        parts = max(1, round(gap_ns * rate_hz / 1e9))
        pairs = [
            (number, pose, after[number].values - pose.values) for number, pose in objects.items() if number in after
        ]
        for _, _, change in pairs:
            change[3] = wrap_yaw(change[3])
        for part in range(1, parts):
            boxes = [
                _make_box(number, pose.kind, pose.values + change * part / parts) for number, pose, change in pairs
            ]
            yield stamp_ns + gap_ns * part // parts, boxes
        interpolated += parts - 1
    if interpolated:
        report.assume(
            f"frames between key frames are interpolated to {rate_hz:g} Hz, of objects that both key frames have"
        )
        report.count("frame", "interpolated", interpolated)


def _make_box(number: int, kind: OsiKind, values: Float) -> Box:
    x, y, z, yaw_rad, length, width, height = values.tolist()
    return Box(
        number,
        kind,
        (x, y, z),
        wrap_yaw(yaw_rad) if math.isfinite(yaw_rad) else yaw_rad,
        (length, width, height),
    )


def _read_lanes(
    source: Path, folder: Path, location: str, keys: list[tuple[int, dict[int, _Pose]]], report: ConversionReport
) -> list[Float]:
    """Outlines (K, 3) of lanes near the ego's path, from the map expansion, at the ego's height; none without it."""
    places = (root / "maps" / "expansion" / f"{quote(location)}.json" for root in (source, folder.parent))
    path = next((path for path in places if location and path.is_file()), None)
    if path is None or not keys:
        return []
    import shapely

    document = _read_map(path)
    nodes = {row["token"]: (row["x"], row["y"]) for row in document["node"]}
    rings = {row["token"]: row["exterior_node_tokens"] for row in document["polygon"]}
    driven_m = np.array([objects[1].values[:3] for _, objects in keys])
    near_box = shapely.box(*driven_m[:, :2].min(axis=0) - _NEAR_M, *driven_m[:, :2].max(axis=0) + _NEAR_M)
    lines = list[Float]()
    for lane in document["lane"]:
        ring = [nodes[token] for token in rings.get(lane["polygon_token"], ()) if token in nodes]
        if len(ring) > 2 and (outline := shapely.LineString([*ring, ring[0]])).intersects(near_box):
            points = shapely.get_coordinates(outline.simplify(0.05))
            lines.append(np.column_stack([points, np.full(len(points), driven_m[0, 2] - keys[0][1][1].values[6] / 2)]))
    report.count(
        "lane", f"of {path.name} within {_NEAR_M:g} m of the ego's path: its outline is a lane boundary", len(lines)
    )
    return lines


_MAP_COLUMNS: Final[dict[str, dict[str, type]]] = {
    "node": {"token": str, "x": float, "y": float},
    "polygon": {"token": str, "exterior_node_tokens": list},
    "lane": {"polygon_token": str},
}


def _read_map(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Nodes, polygons and lanes of a map expansion. Raises InputError."""
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected a map expansion in JSON, found something else: {error}") from None
    for layer, columns in _MAP_COLUMNS.items():
        rows = document.get(layer) if isinstance(document, dict) else None
        for row in rows if isinstance(rows, list) else [None]:
            if not isinstance(row, dict) or not all(_is_of(row.get(key), kind) for key, kind in columns.items()):
                raise InputError(f"{path}: {layer}: expected rows with {', '.join(columns)}, found {quote_value(row)}")
    return {layer: document[layer] for layer in _MAP_COLUMNS}


def _is_of(value: Any, kind: type) -> bool:
    """Whether a value is text, a list of texts, or a number that is a place."""
    if kind is float:
        return type(value) in (int, float) and abs(value) <= LARGEST_M
    return isinstance(value, kind) and (not isinstance(value, list) or all(isinstance(token, str) for token in value))
