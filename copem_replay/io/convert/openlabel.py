"""OpenLABEL: one JSON file, or a folder of them (TUMTraf: one per frame). Read are the cuboids of the frames.

A cuboid is x y z, a quaternion x y z w or roll pitch yaw, and three sizes along its own axes. In KITTI the axes are
those of the camera (y down): after the transform to the world, the axis closest to the vertical is the height. KITTI's
DontCare has sizes of −1000 or −1, and its Egocar no data at all. TUMTraf has the type in `object_data` and one cuboid
where others have a list. Track ids are the keys of `objects`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, Final

import numpy as np

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Float
from copem_replay.io.convert import openlabel_frames, rotate
from copem_replay.io.convert.ground_truth import Box, Frame, Report
from copem_replay.io.convert.kinds import KINDS, Kind
from copem_replay.io.convert.openlabel_frames import Edges
from copem_replay.io.convert.parse import number, numbered, seconds_as_ns, shown

_NOWHERE_M: Final = -1000.0  # KITTI's position of what is none
_KIND: Final = {  # lower case, without spaces and underscores
    "animal": "animal",
    "bicycle": "bicycle",
    "bus": "bus",
    "car": "car",
    "cyclist": "bicycle",
    "emergencyvehicle": "van",
    "misc": "other",
    "motorcycle": "motorcycle",
    "other": "other",
    "pedestrian": "pedestrian",
    "person": "pedestrian",
    "personsitting": "pedestrian",
    "trailer": "trailer",
    "tram": "tram",
    "truck": "truck",
    "van": "van",
    "vehicle": "vehicle",
}


@dataclass(frozen=True)
class _Labels:
    """One frame of one file."""

    where: str
    stamp_ns: int
    objects: dict[str, Any]  # of the frame
    types: dict[str, str]  # of the file's objects
    edges: Edges
    target: str | None  # the coordinate system to give, None: there is not exactly one


def frames(
    path: Path, report: Report, *, rate_hz: float | None = None, source: str | None = None, target: str | None = None
) -> Iterator[Frame]:
    """All frames in order of time, without a host. Raises InputError.

    `rate_hz`: for frames without time stamps, number / rate. `source`: the coordinate system of cuboids that name
    none. `target`: the one to give them in, None for the only one without a parent.
    """
    files = _files(path)
    labels = [frame for file in files for frame in _labels(file, rate_hz, target)]
    labels.sort(key=lambda frame: frame.stamp_ns)
    ids = numbered(name for frame in labels for name in frame.objects)
    for frame in labels:
        found = []
        for name, labelled in frame.objects.items():
            box = _box(ids[name], name, labelled, frame, report, source)
            if box is not None:
                found.append(box)
                report.names[box.id] = name
        yield Frame(frame.stamp_ns, found)


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    if files := sorted(path.glob("*.json")):
        return files
    raise InputError(f"{path}: expected OpenLABEL files, found no *.json in the folder")


def _labels(path: Path, rate_hz: float | None, target: str | None) -> Iterator[_Labels]:
    """Yield the frames of one file. Raises InputError."""
    root = _root(path)
    systems = root.get("coordinate_systems") or {}
    known = openlabel_frames.poses(systems, f"{path}: coordinate_systems")
    if target is None and len(roots := openlabel_frames.roots(systems, str(path))) == 1:
        target = roots[0]
    objects = root.get("objects") or {}
    types = {name: str(o.get("type")) for name, o in objects.items() if isinstance(o, dict) and o.get("type")}
    for key, frame in root["frames"].items():
        where = f"{path}: frame {key}"
        if not isinstance(frame, dict) or not isinstance(frame.get("objects", {}), dict):
            raise InputError(f"{where}: expected an object with `objects`, found {shown(frame)}")
        properties = frame.get("frame_properties")
        properties = properties if isinstance(properties, dict) else {}
        edges = known | openlabel_frames.transforms(properties, f"{where}: transforms")
        stamp_ns = _stamp(properties.get("timestamp"), str(key), rate_hz, where)
        yield _Labels(where, stamp_ns, frame.get("objects", {}), types, edges, target)


def _root(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON, found something else: {error}") from None
    root = document.get("openlabel") if isinstance(document, dict) else None
    if not isinstance(root, dict) or not isinstance(root.get("frames"), dict):
        found = ", ".join(list(document)[:8]) if isinstance(document, dict) else type(document).__name__
        raise InputError(f"{path}: expected OpenLABEL with `openlabel` and its `frames`, found {found}")
    if not isinstance(root.get("objects") or {}, dict):
        raise InputError(f"{path}: objects: expected an object, found {shown(root['objects'])}")
    return root


def _stamp(timestamp: Any, key: str, rate_hz: float | None, where: str) -> int:
    """Return the time of a frame: its own, as seconds, or by its number."""
    if timestamp is not None:
        return seconds_as_ns(timestamp, f"{where}: timestamp")
    if rate_hz is None:
        raise InputError(f"{where}: expected a timestamp, found none: say how many frames a second with --rate-hz")
    return seconds_as_ns(key, f"{where}: number", times=1 / Decimal(str(rate_hz)))


def _box(ident: int, name: str, labelled: Any, frame: _Labels, report: Report, source: str | None) -> Box | None:
    """One object of a frame, None where it has no usable cuboid."""
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
    values = _values(cuboid.get("val"), where)
    at_m, size_m = values[:3], values[-3:]
    if kind_name == "DontCare" or min(size_m) <= 0.0 or _NOWHERE_M in at_m:
        report.count("object", "without a place or size (DontCare) in a frame: skipped")
        return None
    system = cuboid.get("coordinate_system") or data.get("coordinate_system") or source
    matrix = _to_target(str(system) if system else None, frame, where, report)
    return _placed(ident, _kind(kind_name, report), at_m, _rotation(values), size_m, matrix)


def _values(val: Any, where: str) -> list[float]:
    if not isinstance(val, list) or len(val) not in (9, 10):
        raise InputError(f"{where}: expected a cuboid of 9 or 10 numbers, found {shown(val)}")
    return [number(value, f"{where}: cuboid") for value in val]


def _rotation(values: list[float]) -> Float:
    if len(values) == 9:
        return rotate.of_euler(*values[3:6])
    x, y, z, w = (np.array([v]) for v in values[3:7])
    matrix: Float = rotate.of_quaternion(w, x, y, z)[0]
    return matrix


def _to_target(system: str | None, frame: _Labels, where: str, report: Report) -> Float:
    """(4, 4) matrix from the system of a cuboid to the one to give."""
    if system is None:
        report.assume("cuboids name no coordinate system: taken as they are")
        return np.eye(4)
    if frame.target is None:
        report.assume(f"no single coordinate system above all others: cuboids in {system} taken as they are")
        return np.eye(4)
    if (matrix := openlabel_frames.path(frame.edges, system, frame.target)) is None:
        raise InputError(
            f"{where}: expected poses that lead from {system} to {frame.target}, found none: choose another with --to"
        )
    report.assume(f"cuboids in {system} given in {frame.target}")
    return matrix


def _placed(ident: int, kind: Kind, at_m: list[float], turned: Float, size_m: list[float], matrix: Float) -> Box:
    """Return the box upright: the axis closest to the vertical is its height, the first of the others its length."""
    axes = matrix[:3, :3] @ turned
    up = int(np.argmax(np.abs(axes[2])))
    along, across = (axis for axis in range(3) if axis != up)
    x, y, z = (matrix @ np.array([*at_m, 1.0]))[:3].tolist()
    yaw_rad = float(np.arctan2(axes[1, along], axes[0, along]))
    return Box(ident, kind, (x, y, z), yaw_rad, (size_m[along], size_m[across], size_m[up]))


def _kind(name: str, report: Report) -> Kind:
    known = _KIND.get(name.lower().replace("_", "").replace(" ", ""))
    if known is None:
        report.count("object state", f"of the unknown type {shown(name)}: taken as other")
    return KINDS[known or "other"]
