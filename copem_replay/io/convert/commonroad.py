"""CommonRoad scenarios, XML of the versions 2018b and 2020a.

The world is flat: boxes stand on z = 0, with the typical height of their class. Times are steps of `timeStepSize`.
Values are exact or intervals, of which the middle is taken. The planning problem has no body and no trajectory: it
gives no host vehicle. Velocities are speeds along the orientation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Final

from copem_replay.core.errors import InputError
from copem_replay.io.convert.ground_truth import Box, Frame, Report
from copem_replay.io.convert.kinds import KINDS, Kind
from copem_replay.io.convert.parse import number, positive, seconds_as_ns, shown
from copem_replay.io.convert.rotate import wrapped
from copem_replay.io.convert.xml_nodes import Node, parts

_KIND: Final = {
    "bicycle": "bicycle",
    "building": "building",
    "bus": "bus",
    "car": "car",
    "constructionZone": "static",
    "medianStrip": "static",
    "median_strip": "static",
    "motorcycle": "motorcycle",
    "parkedVehicle": "car",
    "pedestrian": "pedestrian",
    "pillar": "pole",
    "priorityVehicle": "car",
    "roadBoundary": "barrier",
    "taxi": "car",
    "train": "train",
    "truck": "truck",
    "unknown": "other",
}
_LAST_STEP: Final = 10_000_000  # chosen: eleven days at 10 Hz
_IGNORED: Final = {
    "environmentObstacle": "has no pose: skipped",
    "phantomObstacle": "is nowhere in particular: skipped",
    "planningProblem": "has no body: no ego vehicle (choose one with `ego:` in the experiment)",
    "obstacle": "of a version before 2018b: skipped",
}


@dataclass(frozen=True)
class _Shape:
    """Footprint in the frame of the obstacle: size, and the centre and turn of the box."""

    length_m: float
    width_m: float
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


def frames(path: Path, report: Report) -> Iterator[Frame]:
    """All steps at which a dynamic obstacle is somewhere; static ones are in all of them. Raises InputError."""
    source = parts(path, ("commonRoad",))
    step_s = _step(next(source), path)
    steps: dict[int, list[Box]] = {}
    static: list[Box] = []
    for node in source:
        if node.tag in _IGNORED:
            report.count(node.tag, _IGNORED[node.tag])
        elif node.tag in ("dynamicObstacle", "staticObstacle"):
            moving = node.tag == "dynamicObstacle"
            ident = _id(node, path)
            kind = _kind(node, path, report, moving=moving)
            shape = _shape(node, path, report)
            if shape is None:
                continue
            report.names[ident] = str(ident)
            report.assume("flat world: boxes stand on z = 0, with the typical height of their class")
            for state in _states(node, path, report) if moving else [_initial(node, path)]:
                box = _box(ident, kind, shape, state, path, report, moving=moving)
                if box is None:
                    continue
                if moving:
                    steps.setdefault(_time(state, path), []).append(box)
                else:
                    static.append(box)
    for step in sorted(steps or {0: []}):
        stamp_ns = seconds_as_ns(step, f"{path}: time step {step}", times=step_s)
        yield Frame(stamp_ns, [*steps.get(step, []), *static])


def _step(root: Node, path: Path) -> Decimal:
    said = root.attributes.get("timeStepSize")
    try:
        step_s = Decimal(said or "")
    except InvalidOperation:
        step_s = Decimal(0)
    if not step_s.is_finite() or not Decimal("1e-6") <= step_s <= 1000:
        raise InputError(f"{path}:{root.line}: expected timeStepSize in seconds (1e-6 to 1000), found {shown(said)}")
    return step_s


def _id(node: Node, path: Path) -> int:
    said = node.attributes.get("id", "")
    if not (said.isascii() and said.isdecimal() and len(said) < 19):
        raise InputError(f"{path}:{node.line}: expected <{node.tag}> with a whole number as id, found {shown(said)}")
    return int(said)


def _kind(node: Node, path: Path, report: Report, *, moving: bool) -> Kind:
    said = node.find("type")
    name = said.text.strip() if said is not None else ""
    if name not in _KIND:
        report.count("obstacle", f"of the unknown type {shown(name)}: taken as other")
    kind = KINDS[_KIND.get(name, "other")]
    if moving == kind.moving:
        return kind
    if moving:
        return KINDS["other"]
    # What stands for good keeps the typical height of what it is.
    return Kind("static", False, KINDS["static"].type, like=kind.like)


def _shape(node: Node, path: Path, report: Report) -> _Shape | None:
    shape = node.find("shape")
    children = shape.children if shape is not None else []
    if len(children) != 1 or children[0].tag not in ("rectangle", "circle", "polygon"):
        found = ", ".join(child.tag for child in children) or "none"
        report.count("obstacle", f"with another shape than one rectangle, circle or polygon ({found}): skipped")
        return None
    (drawn,) = children
    if drawn.tag == "polygon":
        return _around([_point(point, path) for point in drawn.all("point")], drawn, path, report)
    centre = drawn.find("center")
    x, y = _point(centre, path) if centre is not None else (0.0, 0.0)
    if drawn.tag == "circle":
        size_m = 2 * positive(_text(drawn, path, "radius"), f"{path}:{drawn.line}: radius")
        return _Shape(size_m, size_m, x, y)
    length, width = (positive(_text(drawn, path, tag), f"{path}:{drawn.line}: {tag}") for tag in ("length", "width"))
    turned = drawn.find("orientation")
    yaw_rad = _value(turned, path, report) if turned is not None else 0.0
    return _Shape(length, width, x, y, yaw_rad)


def _around(points: list[tuple[float, float]], node: Node, path: Path, report: Report) -> _Shape:
    """Return the box along the obstacle's own axes around a polygon."""
    if len(points) < 3:
        raise InputError(f"{path}:{node.line}: expected a polygon of at least 3 points, found {len(points)}")
    report.count("obstacle", "with a polygon as shape: the box around it taken")
    (west, east), (south, north) = ((min(axis), max(axis)) for axis in zip(*points, strict=True))
    return _Shape(east - west, north - south, (east + west) / 2, (north + south) / 2)


def _initial(node: Node, path: Path) -> Node:
    if (state := node.find("initialState")) is None:
        raise InputError(f"{path}:{node.line}: expected <{node.tag}> with an <initialState>, found none")
    return state


def _states(node: Node, path: Path, report: Report) -> list[Node]:
    trajectory = node.find("trajectory")
    if trajectory is None and node.find("occupancySet") is not None:
        report.count("obstacle", "with an occupancySet: only its initial state taken")
    return [_initial(node, path), *(trajectory.all("state") if trajectory is not None else [])]


def _time(state: Node, path: Path) -> int:
    """Return the step of a state; of an interval the first."""
    time = state.find("time")
    said = None if time is None else time.find("exact") or time.find("intervalStart")
    text = said.text.strip() if said is not None else ""
    if not (text.isascii() and text.isdecimal() and len(text) < 19 and int(text) <= _LAST_STEP):
        raise InputError(f"{path}:{state.line}: time: expected a step of 0 to {_LAST_STEP}, found {shown(text)}")
    return int(text)


def _box(ident: int, kind: Kind, shape: _Shape, state: Node, path: Path, report: Report, *, moving: bool) -> Box | None:
    """Return the obstacle in a state, None where that gives no point."""
    place = state.find("position")
    point = next((child for child in place.children), None) if place is not None else None
    if point is not None and point.tag in ("rectangle", "circle"):
        report.count("state", "with a region as position: its centre taken")
        point = point.find("center")
    elif point is not None and point.tag != "point":
        point = None
    if point is None:
        report.count("state", "without a point as position: skipped")
        return None
    x, y = _point(point, path)
    turned, speed = state.find("orientation"), state.find("velocity")
    if turned is None:
        report.count("state", "without orientation: 0 taken")
    yaw_rad = _value(turned, path, report) if turned is not None else 0.0
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    at_m = (x + cos * shape.x_m - sin * shape.y_m, y + sin * shape.x_m + cos * shape.y_m, kind.height_m / 2)
    velocity = None
    if moving and speed is not None:
        speed_mps = _value(speed, path, report)
        velocity = (speed_mps * cos, speed_mps * sin)
    size_m = (shape.length_m, shape.width_m, kind.height_m)
    return Box(ident, kind, at_m, wrapped(yaw_rad + shape.yaw_rad), size_m, velocity)


def _value(node: Node, path: Path, report: Report) -> float:
    """Return a value: as such, exact, or the middle of an interval."""
    where = f"{path}:{node.line}: {node.tag}"
    low, high, exact = node.find("intervalStart"), node.find("intervalEnd"), node.find("exact")
    if low is not None and high is not None:
        report.count("value", f"of {node.tag} given as an interval: the middle taken")
        return (number(low.text, where) + number(high.text, where)) / 2
    return number((node if exact is None else exact).text.strip(), where)


def _point(node: Node, path: Path) -> tuple[float, float]:
    x, y = (number(_text(node, path, axis), f"{path}:{node.line}: {axis}") for axis in "xy")
    return x, y


def _text(node: Node, path: Path, tag: str) -> str:
    if (child := node.find(tag)) is None:
        found = ", ".join(c.tag for c in node.children) or "nothing"
        raise InputError(f"{path}:{node.line}: expected <{node.tag}> with <{tag}>, found {found}")
    return child.text.strip()
