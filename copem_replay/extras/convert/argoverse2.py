"""Argoverse 2 sensor logs: a folder with annotations.feather and city_SE3_egovehicle.feather.

Boxes are in the frame of the ego vehicle, whose origin is the rear axle, not the centre of the car: each is brought
to the city frame with the ego pose of its time stamp. Quaternions are w x y z. Stamps are integer nanoseconds of the
recording car's own clock (3.159e17: not Unix time). The columns and categories are those of av2-api (MIT). There are
no velocities. A rider and his bicycle are two boxes. Borders of lanes are those of `map/log_map_archive_*.json`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.feather

from copem_replay.core.errors import InputError
from copem_replay.core.frame import SaidPlace, read_argoverse2_city
from copem_replay.core.site_map import Lane, SiteMap
from copem_replay.core.tracks import Area, Float
from copem_replay.extras.convert.conversion import (
    KINDS,
    Box,
    ConversionReport,
    ConvertedFrame,
    rotation_from_quaternion,
)
from copem_replay.extras.maps.registry import read_map

EGO_SIZE_M: Final = (4.877, 2.0, 1.473)
"""Length, width, height of the cars, Ford Fusion Hybrid; the recording `av2_3b3570b4` gives the ego this size."""
CENTRE_FROM_REAR_AXLE_M: Final = (1.339, 0.0, 0.438)
"""Centre of the box ahead of, left of and above the rear axle: estimate of py123d from model data and lidar points."""

_CITY: Final = re.compile(r"____([A-Z]{3})_city_")
_EGO: Final = "EGO_VEHICLE"
_POSE: Final = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_SIZE: Final = ("length_m", "width_m", "height_m")


def frames(
    log: Path,
    report: ConversionReport,
    *,
    ego_size_m: tuple[float, float, float] = EGO_SIZE_M,
    centre_from_rear_axle_m: tuple[float, float, float] = CENTRE_FROM_REAR_AXLE_M,
) -> Iterator[ConvertedFrame]:
    """All annotated instants, with the ego vehicle as host. Raises InputError."""
    if not log.is_dir():
        raise InputError(f"{log}: expected the folder of an Argoverse 2 sensor log, found no folder")
    poses = _read_table(log / "city_SE3_egovehicle.feather", _POSE)
    boxes = _read_table(log / "annotations.feather", (*_POSE, *_SIZE), ("category", "track_uuid"))
    city_R_ego, city_t_ego = _read_se3(poses)
    pose_of = {int(stamp): k for k, stamp in enumerate(poses["timestamp_ns"])}

    uuids = dict.fromkeys(boxes["track_uuid"][boxes["category"] != _EGO].tolist())
    ids = {uuid: k for k, uuid in enumerate(uuids, start=2)}
    report.names |= {1: _EGO} | {k: uuid for uuid, k in ids.items()}
    size, centre = "×".join(f"{v:g}" for v in ego_size_m), ", ".join(f"{v:g}" for v in centre_from_rear_axle_m)
    report.assume(
        f"ego vehicle: id 1, {size} m, its centre {centre} m (ahead, left, up) of the rear axle, where the log has it"
    )
    ego_R_object, ego_t_object = _read_se3(boxes)
    site: SiteMap | None
    site, place = _read_site(log, report), _find_place(log, report)
    for stamp_ns, rows in _group_by_stamp(boxes["timestamp_ns"]):
        if (pose := pose_of.get(stamp_ns)) is None:
            report.count("annotated instant", "without an ego pose of the same time stamp: skipped")
            continue
        R, t = city_R_ego[pose], city_t_ego[pose]
        frame_boxes = [_make_ego_box(R, t, ego_size_m, centre_from_rear_axle_m)]
        for k in rows:
            if boxes["category"][k] == _EGO:
                report.count("row", f"of category {_EGO}: replaced by the ego pose")
                continue
            length, width, height = (float(boxes[name][k]) for name in _SIZE)
            frame_boxes.append(
                Box(
                    id=ids[boxes["track_uuid"][k]],
                    kind=report.find_kind(str(boxes["category"][k])),
                    at_m=_move(R, ego_t_object[k], t),
                    yaw_rad=_yaw_of_matrix(R @ ego_R_object[k]),
                    size_m=(length, width, height),
                )
            )
        yield ConvertedFrame(stamp_ns, frame_boxes, host=1, site=site, place=place)
        site, place = None, None


def _read_site(log: Path, report: ConversionReport) -> SiteMap:
    """Lanes and crosswalks of the log's map, in the city frame; none without a map."""
    lanes, areas = list[Lane](), list[Area]()
    for path in sorted((log / "map").glob("log_map_archive_*.json")):
        site = read_map(path)
        lanes += site.lanes
        areas += [area for area in site.areas if area.kind == "crosswalk"]
        report.count("lane", f"of {path.name}", len(site.lanes))
    report.count("crosswalk", "of the map", len(areas))
    return SiteMap(tuple(lanes), tuple(areas))


def _find_place(log: Path, report: ConversionReport) -> SaidPlace | None:
    """The frame of the log's city on earth, which only the names of its maps say; None: they say none."""
    for path in sorted((log / "map").glob("log_map_archive_*.json")):
        if (city_match := _CITY.search(path.name)) is None:
            continue
        try:
            proj, offset_m = read_argoverse2_city(city_match[1])
        except InputError as error:
            report.count("place on earth", f"left out: {error}")
            return None
        report.assume(f"place on earth: that of city {city_match[1]}, by the name of {path.name}")
        return SaidPlace(proj, offset_m)
    return None


def _make_ego_box(R: Float, t: Float, size_m: tuple[float, float, float], centre_m: tuple[float, float, float]) -> Box:
    """Return the ego vehicle at a pose of its rear axle."""
    at_m = _move(R, np.array(centre_m), t)
    x, y, z = (-v + 0.0 for v in centre_m)
    return Box(1, KINDS["car"], at_m, _yaw_of_matrix(R), size_m, rear_axle_m=(x, y, z))


def _move(R: Float, at_m: Float, t: Float) -> tuple[float, float, float]:
    """A point turned and moved; not finite where the file's numbers are not."""
    with np.errstate(invalid="ignore", over="ignore"):
        x, y, z = (R @ at_m + t).tolist()
    return x, y, z


def _yaw_of_matrix(R: Float) -> float:
    return float(np.arctan2(R[1, 0], R[0, 0]))


def _read_se3(table: dict[str, Any]) -> tuple[Float, Float]:
    """(N, 3, 3) rotations and (N, 3) translations."""
    R = rotation_from_quaternion(*(table[name] for name in ("qw", "qx", "qy", "qz")))
    return R, np.stack([table[name] for name in ("tx_m", "ty_m", "tz_m")], axis=-1)


def _group_by_stamp(stamps_ns: Any) -> Iterator[tuple[int, Any]]:
    """Yield each stamp once, in order, with its rows as in the file."""
    unique, group = np.unique(stamps_ns, return_inverse=True)
    order = np.argsort(group, kind="stable")
    edges = np.searchsorted(group[order], np.arange(len(unique) + 1))
    for k, stamp_ns in enumerate(unique.tolist()):
        yield stamp_ns, order[edges[k] : edges[k + 1]].tolist()


def _read_table(path: Path, numbers: tuple[str, ...], texts: tuple[str, ...] = ()) -> dict[str, Any]:
    """The columns that are used, (N,) each, from a feather file. Raises InputError."""
    try:
        table = pyarrow.feather.read_table(path, memory_map=False)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; an Argoverse 2 sensor log has one") from None
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: expected a feather file, found {str(error).splitlines()[0]}") from None
    expected = ("timestamp_ns", *texts, *numbers)
    if wrong_columns := [name for name in expected if table.column_names.count(name) != 1]:
        found = ", ".join(f"{table.column_names.count(name) or 'no'} {name}" for name in wrong_columns)
        raise InputError(f"{path}: expected the columns {', '.join(expected)}, once each; found {found}")
    columns: dict[str, Any] = {}
    for name in expected:
        arrow_type = pa.int64() if name == "timestamp_ns" else pa.string() if name in texts else pa.float64()
        try:
            column = table[name].cast(arrow_type)
        except pa.ArrowException:
            raise InputError(f"{path}: column {name}: expected {arrow_type}, found {table[name].type}") from None
        if column.null_count:
            raise InputError(f"{path}: column {name}: expected no gaps, found {column.null_count}")
        columns[name] = column.to_numpy()
    return columns
