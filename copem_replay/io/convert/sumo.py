"""SUMO floating car data (`--fcd-output fcd.xml`), with `<vehicle>` and `<person>`.

x and y of a vehicle are the centre of its front bumper, of a person they are taken as the centre. `angle` is in degrees
clockwise from north. Sizes are not in the file: they are those of the types that route and additional files define.
The file is read time step by time step, it may be larger than memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from copem_replay.core.errors import InputError
from copem_replay.io.convert.ground_truth import Box, Frame, Report
from copem_replay.io.convert.parse import number, seconds_as_ns
from copem_replay.io.convert.rotate import wrapped
from copem_replay.io.convert.sumo_types import VehicleType, of_class, types
from copem_replay.io.convert.xml_nodes import Node, parts

_SHOWN: Final = 12  # ids named in an error (chosen)
_CLASS: Final = {"vehicle": "passenger", "person": "pedestrian"}


def frames(path: Path, report: Report, *, type_files: Iterable[Path] = (), host: str | None = None) -> Iterator[Frame]:
    """All time steps; `host` is the id of a vehicle. Raises InputError."""
    known = types(type_files)
    # A vehicle and a person may have the same id: both are numbered together, the host first.
    ids: dict[tuple[str, str], int] = {} if host is None else {("vehicle", host): 1}
    met = host is None
    report.assume("x and y: front bumper of a vehicle, centre of a person")
    source = parts(path, ("fcd-export",))
    next(source)
    for step in source:
        if step.tag != "timestep":
            report.count("element", f"<{step.tag}>: skipped")
            continue
        stamp_ns = seconds_as_ns(step.attributes.get("time"), f"{path}:{step.line}: time")
        boxes = []
        for node in step.children:
            if node.tag not in _CLASS:
                report.count("element", f"<{node.tag}>: skipped")
                continue
            if node.tag == "person" and node.attributes.get("vehicle"):
                report.count("person", "in a vehicle at a time step: skipped")
                continue
            key = node.tag, node.attribute("id", path)
            met |= key == ("vehicle", host)
            ident = ids.setdefault(key, len(ids) + 1)
            report.names[ident] = " ".join(key)
            boxes.append(_box(ident, node, _type(node, known, report), path, report))
        yield Frame(stamp_ns, boxes, host=None if host is None else 1)
    if not met:
        found = [name for tag, name in ids if tag == "vehicle" and name != host]
        more = f", … ({len(found)} in all)" if len(found) > _SHOWN else ""
        raise InputError(f"{path}: --host: no vehicle {host!r}; there are {', '.join(found[:_SHOWN]) or 'none'}{more}")


def _type(node: Node, known: dict[str, VehicleType], report: Report) -> VehicleType:
    name = node.attributes.get("type", "")
    # A vehicle whose parameters were changed has a type of its own, `type@vehicle`.
    for candidate in (name, name.rpartition("@")[0]):
        if candidate in known:
            return known[candidate]
    default = of_class(_CLASS[node.tag])
    assert default is not None  # both are in the table
    size = "×".join(f"{v:g}" for v in default.size_m)
    what = f"of type {name!r}, which is not among --types" if name else "without a type"
    report.count(f"{node.tag} state", f"{what}: {default.kind.name} of {size} m taken")
    return default


def _box(ident: int, node: Node, kind: VehicleType, path: Path, report: Report) -> Box:
    x, y, angle_deg = (
        number(node.attribute(name, path), f"{path}:{node.line}: {name}") for name in ("x", "y", "angle")
    )
    ground_m = number(node.attributes.get("z", 0.0), f"{path}:{node.line}: z")
    if "z" not in node.attributes:
        report.assume("no z: the ground is z = 0")
    length_m, _, height_m = kind.size_m
    yaw_rad = math.radians(90.0 - angle_deg)
    back_m = length_m / 2 if node.tag == "vehicle" else 0.0
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    velocity = None
    if "speed" in node.attributes:
        speed_mps = number(node.attributes["speed"], f"{path}:{node.line}: speed")
        velocity = (speed_mps * cos, speed_mps * sin)
    at_m = (x - back_m * cos, y - back_m * sin, ground_m + height_m / 2)
    return Box(ident, kind.kind, at_m, wrapped(yaw_rad), kind.size_m, velocity)
