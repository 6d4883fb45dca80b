"""OpenLABEL: one JSON file, or a folder of them (TUMTraf: one per frame). Read are the cuboids of the frames.

A cuboid is x y z, a quaternion x y z w or roll pitch yaw, and three sizes along its own axes. In KITTI the axes are
those of the camera (y down): after the transform to the world, the axis closest to the vertical is the height. KITTI's
DontCare has sizes of −1000 or −1, and its Egocar no data at all. TUMTraf has the type in `object_data` and one cuboid
where others have a list. Track ids are the keys of `objects`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, Final

import numpy as np

from copem_replay.core.errors import InputError, quote_value
from copem_replay.core.files import parse_json
from copem_replay.core.tracks import Float
from copem_replay.extras.convert.conversion import (
    Box,
    ConversionReport,
    ConvertedFrame,
    OsiKind,
    number_names,
    parse_number,
    parse_number_or_none,
    parse_seconds_as_ns,
    rotation_from_euler,
    rotation_from_quaternion,
)

# Coordinate systems of OpenLABEL. Systems have poses with respect to their parents; transforms of a frame override
# them. A matrix of `src` to `dst`, or of a system with respect to its parent, takes points of the first to the second.

Edges = dict[tuple[str, str], Float]
"""(4, 4) matrices by (from, to)."""


def read_poses(systems: Any, where: str) -> Edges:
    """Poses of all systems that have one. Raises InputError."""
    edges: Edges = {}
    for name, system in _system_items(systems, where):
        pose = system.get("pose_wrt_parent")
        if pose is not None and system.get("parent"):
            _add_edge(edges, str(name), str(system["parent"]), _read_matrix(pose, f"{where}: {name}: pose_wrt_parent"))
    return edges


def find_roots(systems: Any, where: str) -> list[str]:
    """Return the systems without a parent."""
    return [str(name) for name, system in _system_items(systems, where) if not system.get("parent")]


def read_transforms(properties: Mapping[str, Any], where: str) -> Edges:
    """Return the transforms of one frame. Raises InputError."""
    edges: Edges = {}
    for name, transform in _system_items(properties.get("transforms") or {}, where):
        if not {"src", "dst", "transform_src_to_dst"} <= set(transform):
            raise InputError(
                f"{where}: {name}: expected src, dst and transform_src_to_dst, found {', '.join(map(str, transform))}"
            )
        matrix = _read_matrix(transform["transform_src_to_dst"], f"{where}: {name}")
        _add_edge(edges, str(transform["src"]), str(transform["dst"]), matrix)
    return edges


def find_transform(edges: Edges, source: str, target: str) -> Float | None:
    """(4, 4) matrix from one system to the other by the fewest steps; None: they are not connected."""
    matrices, queue = {source: np.eye(4)}, [source]
    for system in queue:  # it grows in the loop
        if system == target:
            return matrices[system]
        for (start, end), matrix in edges.items():
            if start == system and end not in matrices:
                matrices[end] = matrix @ matrices[system]
                queue.append(end)
    return None


def _add_edge(edges: Edges, source: str, target: str, matrix: Float) -> None:
    edges[source, target] = matrix
    edges[target, source] = np.linalg.inv(matrix).astype(np.float64)


def _system_items(systems: Any, where: str) -> list[tuple[str, dict[str, Any]]]:
    if not isinstance(systems, dict) or not all(isinstance(system, dict) for system in systems.values()):
        raise InputError(f"{where}: expected an object of objects, found {quote_value(systems)}")
    return list(systems.items())


def _read_matrix(pose: Any, where: str) -> Float:
    """The (4, 4) matrix of a pose: of `matrix4x4`, or of a quaternion x y z w and a translation. Raises InputError."""
    pose = pose if isinstance(pose, dict) else {}
    if (flat := pose.get("matrix4x4")) is not None:
        matrix = _read_numbers(flat, 16, where).reshape(4, 4)
    elif "quaternion" in pose and "translation" in pose:
        x, y, z, w = _read_numbers(pose["quaternion"], 4, where)[:, None]
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_from_quaternion(w, x, y, z)[0]
        matrix[:3, 3] = _read_numbers(pose["translation"], 3, where)
    else:
        raise InputError(
            f"{where}: expected matrix4x4, or quaternion and translation, found {', '.join(pose) or 'none'}"
        )
    rotation, last = matrix[:3, :3], [0, 0, 0, 1]
    is_finite = np.isfinite(matrix).all() and np.abs(rotation).max() < 2 and np.allclose(matrix[3], last)
    if not is_finite or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise InputError(f"{where}: expected a rotation and a translation, found another matrix")
    return matrix


def _read_numbers(values: Any, count: int, where: str) -> Float:
    if not isinstance(values, list) or len(np.ravel(np.array(values, dtype=object))) != count:
        raise InputError(f"{where}: expected {count} numbers, found {quote_value(values)}")
    return np.array([parse_number(value, where) for value in np.ravel(np.array(values, dtype=object)).tolist()])


_NOWHERE_M: Final = -1000.0  # KITTI's position of an object without one


@dataclass(frozen=True)
class _Labels:
    """One frame of one file."""

    where: str
    stamp_ns: int
    objects: dict[str, Any]  # those of the frame
    types: dict[str, str]  # by object of the file
    edges: Edges
    target: str | None  # the coordinate system of the output, None: there is not exactly one candidate


def frames(
    path: Path,
    report: ConversionReport,
    *,
    rate_hz: float | None = None,
    source: str | None = None,
    target: str | None = None,
) -> Iterator[ConvertedFrame]:
    """All frames in order of time, without a host. Raises InputError.

    `rate_hz`: for frames without time stamps, number / rate. `source`: the coordinate system of cuboids that name
    none. `target`: the one to give them in, None for the only one without a parent.
    """
    files = _list_files(path)
    labels = [frame for file in files for frame in _read_labels(file, rate_hz, target)]
    labels.sort(key=lambda frame: frame.stamp_ns)
    ids = number_names(name for frame in labels for name in frame.objects)
    for frame in labels:
        boxes = []
        for name, labelled in frame.objects.items():
            box = _make_box(ids[name], name, labelled, frame, report, source)
            if box is not None:
                boxes.append(box)
                report.names[box.id] = name
        yield ConvertedFrame(frame.stamp_ns, boxes)


def _list_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    if files := sorted(path.glob("*.json")):
        return files
    raise InputError(f"{path}: expected OpenLABEL files, found no *.json in the folder")


def _read_labels(path: Path, rate_hz: float | None, target: str | None) -> Iterator[_Labels]:
    """The frames of one file, with poses and types; `target`: the output's system, None: the root. InputError."""
    root = _read_root(path)
    systems = root.get("coordinate_systems") or {}
    poses = read_poses(systems, f"{path}: coordinate_systems")
    if target is None and len(roots := find_roots(systems, str(path))) == 1:
        target = roots[0]
    objects = root.get("objects") or {}
    types = {name: str(o.get("type")) for name, o in objects.items() if isinstance(o, dict) and o.get("type")}
    for key, frame in root["frames"].items():
        where = f"{path}: frame {key}"
        if not isinstance(frame, dict) or not isinstance(frame.get("objects", {}), dict):
            raise InputError(f"{where}: expected an object with `objects`, found {quote_value(frame)}")
        properties = frame.get("frame_properties")
        properties = properties if isinstance(properties, dict) else {}
        edges = poses | read_transforms(properties, f"{where}: transforms")
        stamp_ns = _frame_stamp(properties.get("timestamp"), str(key), rate_hz, where)
        yield _Labels(where, stamp_ns, frame.get("objects", {}), types, edges, target)


def _read_root(path: Path) -> dict[str, Any]:
    """The content of `openlabel` in a file. Raises InputError: no JSON, or no frames."""
    try:
        document = parse_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path}: expected JSON, found something else: {error}") from None
    root = document.get("openlabel") if isinstance(document, dict) else None
    if not isinstance(root, dict) or not isinstance(root.get("frames"), dict):
        found = ", ".join(list(document)[:8]) if isinstance(document, dict) else type(document).__name__
        raise InputError(f"{path}: expected OpenLABEL with `openlabel` and its `frames`, found {found}")
    if not isinstance(root.get("objects") or {}, dict):
        raise InputError(f"{path}: objects: expected an object, found {quote_value(root['objects'])}")
    return root


def _frame_stamp(timestamp: Any, key: str, rate_hz: float | None, where: str) -> int:
    """Return the time of a frame in ns: its own, stated in seconds, or by its number."""
    if timestamp is not None:
        return parse_seconds_as_ns(timestamp, f"{where}: timestamp")
    if rate_hz is None:
        raise InputError(f"{where}: expected a timestamp, found none: say how many frames a second with --rate-hz")
    return parse_seconds_as_ns(key, f"{where}: number", times=1 / Decimal(str(rate_hz)))


def _make_box(
    ident: int, name: str, labelled: Any, frame: _Labels, report: ConversionReport, source: str | None
) -> Box | None:
    """One object of a frame as a box; None: it has no usable cuboid, which is counted."""
    where = f"{frame.where}: object {name}"
    data = labelled.get("object_data") if isinstance(labelled, dict) else None
    if not isinstance(data, dict) or not data:
        report.count("object", "without object_data in a frame: skipped")
        return None
    cuboids = data.get("cuboid") or []
    cuboids = cuboids if isinstance(cuboids, list) else [cuboids]
    if not cuboids:
        report.count("object", "without a cuboid in a frame: skipped")
        return None
    report.count("cuboid", "beyond the first of an object in a frame: skipped", len(cuboids) - 1)
    cuboid = cuboids[0] if isinstance(cuboids[0], dict) else {}
    kind_name = str(data.get("type") or frame.types.get(name) or "")
    values = _read_values(cuboid.get("val"), where)
    at_m, size_m = values[:3], values[-3:]
    if kind_name == "DontCare" or _NOWHERE_M in at_m:
        report.count("object", "without a place (DontCare) in a frame: skipped")
        return None
    system = cuboid.get("coordinate_system") or data.get("coordinate_system") or source
    matrix = _transform_to_target(str(system) if system else None, frame, where, report)
    return _upright_box(ident, report.find_kind(kind_name), at_m, _read_rotation(values), size_m, matrix)


def _read_values(val: Any, where: str) -> list[float]:
    if not isinstance(val, list) or len(val) not in (9, 10):
        raise InputError(f"{where}: expected a cuboid of 9 or 10 numbers, found {quote_value(val)}")
    return [parse_number_or_none(value, f"{where}: cuboid") for value in val]


def _read_rotation(values: list[float]) -> Float:
    if len(values) == 9:
        return rotation_from_euler(*values[3:6])
    x, y, z, w = (np.array([v]) for v in values[3:7])
    matrix: Float = rotation_from_quaternion(w, x, y, z)[0]
    return matrix


def _transform_to_target(system: str | None, frame: _Labels, where: str, report: ConversionReport) -> Float:
    """(4, 4) matrix from the system of a cuboid to that of the output; what is assumed goes to the report."""
    if system is None:
        report.assume("cuboids name no coordinate system: taken as they are")
        return np.eye(4)
    if frame.target is None:
        report.assume(f"no single coordinate system above all others: cuboids in {system} taken as they are")
        return np.eye(4)
    if (matrix := find_transform(frame.edges, system, frame.target)) is None:
        raise InputError(
            f"{where}: expected poses that lead from {system} to {frame.target}, found none: choose another with --to"
        )
    report.assume(f"cuboids in {system} given in {frame.target}")
    return matrix


def _upright_box(
    ident: int, kind: OsiKind, at_m: list[float], turned: Float, size_m: list[float], matrix: Float
) -> Box:
    """Return the box upright: the axis closest to the vertical is its height, the first of the others its length."""
    axes = matrix[:3, :3] @ turned
    vertical = int(np.argmax(np.abs(axes[2])))
    along, across = (axis for axis in range(3) if axis != vertical)
    x, y, z = (matrix @ np.array([*at_m, 1.0]))[:3].tolist()
    yaw_rad = float(np.arctan2(axes[1, along], axes[0, along]))
    return Box(ident, kind, (x, y, z), yaw_rad, (size_m[along], size_m[across], size_m[vertical]))
