"""SUMO floating car data (`--fcd-output fcd.xml`, or `fcd.xml.gz`), with `<vehicle>` and `<person>`.

x and y of a vehicle are the centre of its front bumper, of a person they are taken as the centre. `angle` is in degrees
clockwise from north. Sizes are not in the file: they are those of the types that route and additional files define.
The file is read time step by time step, it may be larger than memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from copem_replay.core.errors import InputError
from copem_replay.extras.convert.commonroad import XmlNode, read_parts
from copem_replay.extras.convert.conversion import (
    KINDS,
    Box,
    ConversionReport,
    ConvertedFrame,
    OsiKind,
    kind_from_name,
    parse_number_or_none,
    parse_positive,
    parse_seconds_as_ns,
    wrap_yaw,
)

# Sizes and kinds of SUMO's vehicle types, which its FCD output only names. Defaults of the classes are SUMO's own
# (sumo.dlr.de, Vehicle Type Parameter Defaults; its source of 2025), since SUMO placed the front bumper with them.

_CLASSES: Final = {  # vClass: length, width, height in m
    "passenger": (5.0, 1.8, 1.5),
    "pedestrian": (0.215, 0.478, 1.719),
    "wheelchair": (5.0, 0.8, 1.5),  # no length of its own in SUMO, nor has the scooter
    "bicycle": (1.6, 0.65, 1.7),
    "scooter": (5.0, 0.5, 1.7),
    "moped": (2.1, 0.78, 1.7),
    "motorcycle": (2.2, 0.9, 1.5),
    "truck": (7.1, 2.4, 2.4),
    "trailer": (16.5, 2.55, 4.0),  # a truck with a trailer, one rigid box
    "bus": (12.0, 2.5, 3.4),
    "coach": (14.0, 2.6, 4.0),
    "delivery": (6.5, 2.16, 2.86),
    "emergency": (6.5, 2.16, 2.86),
    "tram": (22.0, 2.4, 3.2),
    "rail_urban": (109.5, 3.0, 3.6),
    "subway": (109.5, 3.0, 3.6),
    "rail": (135.0, 2.84, 3.75),
    "rail_electric": (200.0, 2.95, 3.89),
    "rail_fast": (200.0, 2.95, 3.89),
    "ship": (17.0, 4.0, 4.0),
}
_LIKE_CARS: Final = ("private", "vip", "hov", "taxi", "evehicle", "custom1", "custom2", "ignoring", "authority", "army")


@dataclass(frozen=True)
class VehicleType:
    """The kind and the size of a vehicle type."""

    kind: OsiKind
    size_m: tuple[float, float, float]  # length, width, height


def class_defaults(name: str) -> VehicleType | None:
    """Return the defaults of a vClass; None: not known."""
    name = "passenger" if name in _LIKE_CARS else name
    kind = KINDS["truck"] if name == "trailer" else kind_from_name(name)
    return VehicleType(kind, _CLASSES[name]) if name in _CLASSES and kind is not None else None


def _built_in_types() -> Iterator[tuple[str, VehicleType]]:
    pairs = {"VEH": "passenger", "PED": "pedestrian", "BIKE": "bicycle", "TAXI": "taxi"}
    for part, name in pairs.items():
        if (kind := class_defaults(name)) is not None:
            yield f"DEFAULT_{part}TYPE", kind


def read_types(files: Iterable[Path]) -> dict[str, VehicleType]:
    """Return all types of route and additional files, and those SUMO has itself. Raises InputError."""
    types = dict(_built_in_types())
    for path in files:
        before = len(types)
        for part in read_parts(path, ("routes", "additional")):
            for node in [part, *part.children]:  # at the top, or in a vTypeDistribution
                if node.tag == "vType":
                    types[node.attribute("id", path)] = _read_type(node, path)
        if len(types) == before:
            raise InputError(f"{path}: expected vehicle types (<vType>), found no further one")
    return types


def _read_type(node: XmlNode, path: Path) -> VehicleType:
    """Parse a type; values that it does not state are those of its class, by default a passenger car."""
    name = node.attributes.get("vClass", "passenger")
    if (default := class_defaults(name)) is None:
        raise InputError(f"{path}:{node.line}: vClass: expected one of {', '.join(_CLASSES)}, found {name!r}")
    length, width, height = (
        parse_positive(node.attributes.get(key, value), f"{path}:{node.line}: {key}")
        for key, value in zip(("length", "width", "height"), default.size_m, strict=True)
    )
    return VehicleType(default.kind, (length, width, height))


# Frames.

_SHOWN: Final = 12  # ids named in an error, at most
_CLASS: Final = {"vehicle": "passenger", "person": "pedestrian"}


def frames(
    path: Path, report: ConversionReport, *, type_files: Iterable[Path] = (), host: str | None = None
) -> Iterator[ConvertedFrame]:
    """All time steps; `host` is the id of a vehicle. Raises InputError."""
    types = read_types(type_files)
    # A vehicle and a person may have the same id: both are numbered together, the host first.
    ids: dict[tuple[str, str], int] = {} if host is None else {("vehicle", host): 1}
    host_met = host is None
    report.assume("x and y: front bumper of a vehicle, centre of a person")
    source = read_parts(path, ("fcd-export",))
    next(source)
    for step in source:
        if step.tag != "timestep":
            report.count("element", f"<{step.tag}>: skipped")
            continue
        stamp_ns = parse_seconds_as_ns(step.attributes.get("time"), f"{path}:{step.line}: time")
        boxes = []
        for node in step.children:
            if node.tag not in _CLASS:
                report.count("element", f"<{node.tag}>: skipped")
                continue
            if node.tag == "person" and node.attributes.get("vehicle"):
                report.count("person", "in a vehicle at a time step: skipped")
                continue
            key = node.tag, node.attribute("id", path)
            host_met |= key == ("vehicle", host)
            ident = ids.setdefault(key, len(ids) + 1)
            report.names[ident] = " ".join(key)
            boxes.append(_make_box(ident, node, _find_type(node, types, report), path, report))
        yield ConvertedFrame(stamp_ns, boxes, host=None if host is None else 1)
    if not host_met:
        vehicles = [name for tag, name in ids if tag == "vehicle" and name != host]
        more = f", … ({len(vehicles)} in all)" if len(vehicles) > _SHOWN else ""
        raise InputError(
            f"{path}: --host: no vehicle {host!r}; there are {', '.join(vehicles[:_SHOWN]) or 'none'}{more}"
        )


def _find_type(node: XmlNode, types: dict[str, VehicleType], report: ConversionReport) -> VehicleType:
    """The type of a vehicle or person; one that is not in `types` has the size of its class, counted."""
    name = node.attributes.get("type", "")
    # A vehicle whose parameters were changed has a type of its own, `type@vehicle`.
    for candidate in (name, name.rpartition("@")[0]):
        if candidate in types:
            return types[candidate]
    default = class_defaults(_CLASS[node.tag])
    assert default is not None  # both are in the table
    size = "×".join(f"{v:g}" for v in default.size_m)
    what = f"of type {name!r}, which is not among --types" if name else "without a type"
    report.count(f"{node.tag} state", f"{what}: {default.kind.name} of {size} m taken")
    return default


def _make_box(ident: int, node: XmlNode, kind: VehicleType, path: Path, report: ConversionReport) -> Box:
    """The box of one state; x and y of a vehicle are the middle of its front, so its centre is behind them."""
    x, y, angle_deg = (
        parse_number_or_none(node.attribute(name, path), f"{path}:{node.line}: {name}") for name in ("x", "y", "angle")
    )
    ground_m = parse_number_or_none(node.attributes.get("z", 0.0), f"{path}:{node.line}: z")
    if "z" not in node.attributes:
        report.assume("no z: the ground is z = 0")
    length_m, _, height_m = kind.size_m
    yaw_rad = math.radians(90.0 - angle_deg)
    back_m = length_m / 2 if node.tag == "vehicle" else 0.0
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    velocity = None
    if "speed" in node.attributes:
        speed_mps = parse_number_or_none(node.attributes["speed"], f"{path}:{node.line}: speed")
        velocity = (speed_mps * cos, speed_mps * sin)
    at_m = (x - back_m * cos, y - back_m * sin, ground_m + height_m / 2)
    return Box(ident, kind.kind, at_m, wrap_yaw(yaw_rad), kind.size_m, velocity)
