"""V2X-Seq (SPD), the cooperative labels of DAIR-V2X with tracks: each sequence of the vehicle becomes a recording.

`cooperative/label/<vehicle frame>.json` has boxes in the frame of the vehicle's lidar: the centre, sizes l w h, and
the rotation about z in radians; `track_id` holds through a sequence. `lidar_to_novatel` and `novatel_to_world` lead
from there to the world. Stamps are microseconds of the vehicle's lidar. The layout is that of OpenDAIRV2X
(Apache-2.0). Labels of DAIR-V2X-C have no track ids: without them there is no truth to replay.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np

from copem_replay.core.errors import InputError, quote_value
from copem_replay.core.files import avoid_device_name, parse_json
from copem_replay.core.tracks import Float
from copem_replay.extras.convert.conversion import (
    KINDS,
    LAST_SECOND,
    Box,
    ConversionReport,
    ConvertedFrame,
    PlannedRecording,
    check_size,
    parse_number,
    parse_number_or_none,
    sign_files,
)

EGO_SIZE_M: Final = (4.9, 1.9, 1.5)
"""Length, width, height of the vehicle, which the data set does not state: a large car."""

_EGO: Final = "ego"
_PAIRS: Final = "cooperative/data_info.json"
_FRAMES: Final = "vehicle-side/data_info.json"


@dataclass(frozen=True)
class _FramePair:
    """A frame of the vehicle and that of the infrastructure it is paired with."""

    vehicle: str
    infrastructure: str
    stamp_ns: int


def list_recordings(source: Path) -> dict[str, PlannedRecording]:
    """The sequences of the vehicle. Raises InputError."""
    if not source.is_dir():
        raise InputError(f"{source}: expected the folder of V2X-Seq, found a file")
    return {
        avoid_device_name(quote(name, safe=" ")): PlannedRecording(source, {"sequence": name})
        for name in sorted(_read_sequences(source, sign_files(source / name for name in (_PAIRS, _FRAMES))))
    }


def frames(
    source: Path,
    report: ConversionReport,
    *,
    sequence: str | None = None,
    ego_size_m: tuple[float, float, float] = EGO_SIZE_M,
) -> Iterator[ConvertedFrame]:
    """A sequence in the frame of the world, the vehicle as host. `sequence`: None: the only one. Raises InputError."""
    sequences = _read_sequences(source, sign_files(source / name for name in (_PAIRS, _FRAMES)))
    if sequence is None and len(sequences) == 1:
        sequence = next(iter(sequences))
    if sequence not in sequences:
        raise InputError(f"{source}: expected one sequence of {len(sequences)}, found {sequence}")
    ids = {_EGO: 1}
    size = "×".join(f"{v:g}" for v in ego_size_m)
    report.assume(
        f"vehicle: id 1, {size} m (the data set does not say), its centre below its lidar, which is on its roof"
    )
    _say_where_infrastructure_is(source, sequences[sequence][0].infrastructure, report)
    for pair in sequences[sequence]:
        path = source / f"cooperative/label/{pair.vehicle}.json"
        if not path.is_file():
            report.count("frame", "without its file of labels: a gap")
            continue
        R, t = _read_pose(source / "vehicle-side/calib", ("novatel_to_world", "lidar_to_novatel"), pair.vehicle)
        x, y, z = t.tolist()
        boxes = [Box(1, KINDS["car"], (x, y, z - ego_size_m[2] / 2), math.atan2(R[1, 0], R[0, 0]), ego_size_m)]
        seen_ids = set[int]()
        for number, label in enumerate(_read_list(path), start=1):
            box = _make_box(label, ids, R, t, f"{path}: label {number}", report)
            if box.id in seen_ids:
                report.count("label", "of an object that the frame has already: skipped")
                continue
            seen_ids.add(box.id)
            boxes.append(box)
        report.names |= {number: name for name, number in ids.items()}
        yield ConvertedFrame(pair.stamp_ns, boxes, host=1)


def _make_box(label: Any, ids: dict[str, int], R: Float, t: Float, where: str, report: ConversionReport) -> Box:
    """The box of one label, moved to the world by R (3, 3) and t (3,). Raises InputError."""
    if not isinstance(label, dict):
        raise InputError(f"{where}: expected an object, found {quote_value(label)}")
    track = label.get("track_id")
    if not isinstance(track, str | int) or isinstance(track, bool) or str(track) in ("", "-1"):
        raise InputError(
            f"{where}: expected a track_id, found {quote_value(track)}: V2X-Seq has them, DAIR-V2X-C has none "
            "and cannot be replayed"
        )
    kind = report.find_kind(str(label.get("type") or ""))
    at_m = R @ _read_named(label.get("3d_location"), "xyz", f"{where}: 3d_location") + t
    length, width, height = _read_named(label.get("3d_dimensions"), "lwh", f"{where}: 3d_dimensions").tolist()
    yaw_rad = parse_number_or_none(label.get("rotation"), f"{where}: rotation")
    ahead = R @ np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
    x, y, z = at_m.tolist()
    ident = ids.setdefault(str(track), len(ids) + 1)
    return Box(ident, kind, (x, y, z), math.atan2(ahead[1], ahead[0]), (length, width, height))


def _say_where_infrastructure_is(source: Path, frame: str, report: ConversionReport) -> None:
    """A note with the place of the roadside lidar, where the calibration of the frame is there."""
    folder = source / "infrastructure-side/calib"
    if (folder / "virtuallidar_to_world" / f"{frame}.json").is_file():
        R, t = _read_pose(folder, ("virtuallidar_to_world",), frame)
        x, y, z = t.tolist()
        yaw_deg = math.degrees(math.atan2(R[1, 0], R[0, 0]))
        place = f"at: [{x:.2f}, {y:.2f}], height_m: {z:.2f}, yaw_deg: {yaw_deg:.1f}"
        report.assume(f"the roadside lidar, for a unit: {place} (height above z = 0 of the world)")


# Files.


@lru_cache(maxsize=1)
def _read_sequences(source: Path, _signature: object) -> dict[str, list[_FramePair]]:
    """By sequence of the vehicle its pairs of frames, in order of time. Raises InputError."""
    stamps_ns: dict[str, int] = {}
    path = source / _FRAMES
    for number, row in enumerate(_read_list(path), start=1):
        where = f"{path}: row {number}"
        stamp_us = parse_number(_get_text(row, "pointcloud_timestamp", where), f"{where}: pointcloud_timestamp")
        if not 0 <= stamp_us <= LAST_SECOND * 1e6:
            raise InputError(f"{where}: pointcloud_timestamp: expected microseconds, found {stamp_us:g}")
        stamps_ns[_get_text(row, "frame_id", where)] = 1000 * round(stamp_us)
    sequences: dict[str, list[_FramePair]] = {}
    path = source / _PAIRS
    for number, row in enumerate(_read_list(path), start=1):
        where = f"{path}: row {number}"
        if isinstance(row, dict) and "vehicle_sequence" not in row and "cooperative_label_path" in row:
            raise InputError(f"{path}: expected V2X-Seq, found DAIR-V2X-C, whose labels have no tracks")
        vehicle, infrastructure, sequence = (
            _get_text(row, key, where) for key in ("vehicle_frame", "infrastructure_frame", "vehicle_sequence")
        )
        if vehicle not in stamps_ns:
            raise InputError(f"{where}: expected a frame of vehicle-side/data_info.json, found {vehicle!r}")
        sequences.setdefault(sequence, []).append(_FramePair(vehicle, infrastructure, stamps_ns[vehicle]))
    if not sequences:
        raise InputError(f"{path}: expected pairs of frames, found none")
    return {name: sorted(pairs, key=lambda pair: pair.stamp_ns) for name, pairs in sequences.items()}


def _get_text(row: Any, key: str, where: str) -> str:
    """A text or whole number of a row; names of frames are names of files."""
    value = row.get(key) if isinstance(row, dict) else None
    if not isinstance(value, str | int) or isinstance(value, bool) or not str(value) or "/" in str(value):
        raise InputError(f"{where}: expected {key}, found {quote_value(value if isinstance(row, dict) else row)}")
    return str(value)


def _read_file(path: Path) -> Any:
    try:
        return parse_json(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; V2X-Seq has one") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path}: expected JSON, found something else or its end: {error}") from None


def _read_list(path: Path) -> list[Any]:
    rows = _read_file(path)
    if not isinstance(rows, list):
        raise InputError(f"{path}: expected a list, found {quote_value(rows)}")
    return rows


def _read_pose(folder: Path, chain: tuple[str, ...], frame: str) -> tuple[Float, Float]:
    """The rotation (3, 3) and translation (3,) of a chain of calibrations, the last of which is applied first."""
    R, t = np.eye(3), np.zeros(3)
    for name in chain:
        path = folder / name / f"{frame}.json"
        calibration = _read_file(path)
        calibration = calibration.get("transform", calibration) if isinstance(calibration, dict) else {}
        rotation = _read_numbers(
            calibration.get("rotation") if isinstance(calibration, dict) else None, 9, f"{path}: rotation"
        )
        translation = _read_numbers(calibration.get("translation"), 3, f"{path}: translation")
        matrix = rotation.reshape(3, 3)
        if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-2):
            raise InputError(f"{path}: rotation: expected a rotation, found another matrix")
        R, t = R @ matrix, R @ translation + t
    return R, t


def _read_numbers(value: Any, count: int, where: str) -> Float:
    """Numbers in a list, or in lists of a list."""
    flat = (
        [number for row in value for number in (row if isinstance(row, list) else [row])]
        if isinstance(value, list)
        else []
    )
    if len(flat) != count:
        raise InputError(f"{where}: expected {count} numbers, found {quote_value(value)}")
    return check_size(np.array([parse_number(number, where) for number in flat]), where)


def _read_named(value: Any, names: str, where: str) -> Float:
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected {', '.join(names)}, found {quote_value(value)}")
    return np.array([parse_number_or_none(value.get(name), f"{where}: {name}") for name in names])
