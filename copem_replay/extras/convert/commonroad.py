"""CommonRoad scenarios, XML of the versions 2018b and 2020a, with their lanes.

The world is flat: boxes stand on z = 0, with the typical height of their class. Times are steps of `timeStepSize`.
Values are exact or intervals, of which the middle is taken. The planning problem has no body and no trajectory: it
gives no host vehicle. Velocities are speeds along the orientation.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from io import BytesIO
from pathlib import Path
from typing import Final
from xml.parsers import expat

import numpy as np

from copem_replay.core.errors import InputError, quote_value
from copem_replay.core.site_map import Lane, LaneKind, SiteMap, make_area
from copem_replay.extras.convert.conversion import (
    KINDS,
    Box,
    ConversionReport,
    ConvertedFrame,
    OsiKind,
    check_size,
    parse_number,
    parse_number_or_none,
    parse_positive,
    parse_seconds_as_ns,
    wrap_yaw,
)

# XML read part by part: each child of the root as a small tree that is dropped after use. Expat is used directly, since
# it gives line numbers. A DOCTYPE is refused: no entity is ever expanded, no file fetched.

_BLOCK_BYTES: Final = 1 << 16


@dataclass
class XmlNode:
    """One element."""

    tag: str
    attributes: dict[str, str]
    line: int
    text: str = ""
    children: list[XmlNode] = field(default_factory=list)

    def all(self, tag: str) -> list[XmlNode]:
        """Children of that tag."""
        return [child for child in self.children if child.tag == tag]

    def attribute(self, name: str, path: Path) -> str:
        """The value of an attribute. Raises InputError: there is none."""
        if (value := self.attributes.get(name)) is None:
            found = ", ".join(self.attributes) or "none"
            raise InputError(f"{path}:{self.line}: expected <{self.tag}> with the attribute {name}, found {found}")
        return value

    def find(self, *tags: str) -> XmlNode | None:
        """Return the first child of the first tag, its first child of the next, and so on."""
        node: XmlNode | None = self
        for tag in tags:
            node = next((child for child in node.children if child.tag == tag), None) if node is not None else None
        return node


def read_parts(
    path: Path, root_tags: tuple[str, ...], *, most_elements: int | None = None, content: bytes | None = None
) -> Iterator[XmlNode]:
    """Yield the root without its children, then each child once it is complete. `most_elements`: of one child.
    `content`: what is read, None: that of the file. Raises InputError.
    """
    reading = _ParserHandlers(path, root_tags, most_elements)
    try:
        with (
            BytesIO(content) if content is not None else gzip.open(path) if path.suffix == ".gz" else path.open("rb")
        ) as stream:
            while block := stream.read(_BLOCK_BYTES):
                reading.parser.Parse(block, False)
                while reading.done:
                    yield reading.done.popleft()
            reading.parser.Parse(b"", True)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise InputError(
            f"{path}: expected a file that gzip has packed, found something else or its end: {error}"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except expat.ExpatError as error:
        found = expat.errors.messages[error.code]
        raise InputError(f"{path}:{error.lineno}: expected XML, found something else or its end: {found}") from None
    except (LookupError, ValueError) as error:  # an encoding that Python lacks
        raise InputError(f"{path}: expected XML, found something else: {error}") from None
    yield from reading.done


class _ParserHandlers:
    """Handlers of the parser, with the parts they have completed."""

    def __init__(self, path: Path, root_tags: tuple[str, ...], most_elements: int | None) -> None:
        self.path, self.root_tags, self.most_elements = path, root_tags, most_elements
        self.elements = 0  # of the child of the root that is open
        self.open: list[XmlNode] = []
        self.done: deque[XmlNode] = deque()
        self.parser = parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._text
        parser.StartDoctypeDeclHandler = self._doctype

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        """Begin an element: children of the root are handed out when they end, others are kept. Raises InputError."""
        node = XmlNode(tag, attributes, self.parser.CurrentLineNumber)
        if not self.open:
            if tag not in self.root_tags:
                expected = " or ".join(f"<{name}>" for name in self.root_tags)
                raise InputError(f"{self.path}:{node.line}: expected {expected}, found <{tag}>")
            self.done.append(node)
        elif len(self.open) > 1:  # children of the root are handed out, not kept
            self.open[-1].children.append(node)
            self.elements += 1
            if self.most_elements is not None and self.elements > self.most_elements:
                expected = f"expected <{self.open[1].tag}> with at most {self.most_elements:,} elements, found more"
                raise InputError(f"{self.path}:{self.open[1].line}: {expected}")
        else:
            self.elements = 0
        self.open.append(node)

    def _end(self, _tag: str) -> None:
        node = self.open.pop()
        if len(self.open) == 1:
            self.done.append(node)

    def _text(self, text: str) -> None:
        if len(self.open) > 1:
            self.open[-1].text += text

    def _doctype(self, *_: object) -> None:
        line = self.parser.CurrentLineNumber
        raise InputError(f"{self.path}:{line}: expected no DOCTYPE, found one: refused, it could expand without end")


_LANE_KIND: Final[dict[str, LaneKind]] = {  # of `laneletType`; others, and lanelets without a type, are driven
    "bicycleLane": "bicycle",
    "border": "other",
    "crosswalk": "walking",
    "parking": "parking",
    "restricted": "other",
    "shoulder": "other",
    "sidewalk": "walking",
}
_LAST_STEP: Final = 10_000_000  # eleven days at 10 Hz; a larger step is an error
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


def frames(path: Path, report: ConversionReport) -> Iterator[ConvertedFrame]:
    """All steps at which a dynamic obstacle has a state; static ones are in all of them. Raises InputError."""
    source = read_parts(path, ("commonRoad",))
    step_s = _read_time_step(next(source), path)
    steps: dict[int, list[Box]] = {}
    static: list[Box] = []
    road = _Road(path, report)
    for node in source:
        if node.tag in ("lanelet", "intersection"):
            road.add(node)
        elif node.tag in _IGNORED:
            report.count(node.tag, _IGNORED[node.tag])
        elif node.tag in ("dynamicObstacle", "staticObstacle"):
            moving = node.tag == "dynamicObstacle"
            ident = _read_id(node, path)
            kind = _map_kind(node, path, report, moving=moving)
            shape = _read_shape(node, path, report)
            if shape is None:
                continue
            report.names[ident] = str(ident)
            report.assume("flat world: boxes stand on z = 0, with the typical height of their class")
            for state in _list_states(node, path, report) if moving else [_initial_state(node, path)]:
                box = _make_box(ident, kind, shape, state, path, report, moving=moving)
                if box is None:
                    continue
                if moving:
                    steps.setdefault(_read_time(state, path), []).append(box)
                else:
                    static.append(box)
    site: SiteMap | None = road.build_site()
    for step in sorted(steps or {0: []}):
        stamp_ns = parse_seconds_as_ns(step, f"{path}: time step {step}", times=step_s)
        yield ConvertedFrame(stamp_ns, [*steps.get(step, []), *static], site=site)
        site = None


class _Road:
    """The lanelets of a scenario, and which of them are crosswalks: by their type, or by an intersection."""

    def __init__(self, path: Path, report: ConversionReport) -> None:
        self._path, self._report = path, report
        self._lanes, self._crossings = dict[str, Lane](), set[str]()

    def add(self, node: XmlNode) -> None:
        """Add a lanelet, or the crossings of an intersection. Raises InputError."""
        if node.tag == "intersection":
            crossed = [item for part in node.all("crossing") for item in part.all("crossingLanelet")]
            self._crossings |= {item.attribute("ref", self._path) for item in crossed}
            return
        parts = [part.all("point") if (part := node.find(side)) else [] for side in ("leftBound", "rightBound")]
        if min(map(len, parts)) < 2:
            self._report.count("lanelet", "without two bounds of two points: left out")
            return
        bounds = [np.array([(*_read_point(point, self._path), 0.0) for point in part]) for part in parts]
        left, right = (check_size(bound, f"{self._path}:{node.line}: <lanelet>") for bound in bounds)
        name, types = str(_read_id(node, self._path)), [item.text.strip() for item in node.all("laneletType")]
        kinds: list[LaneKind] = [_LANE_KIND[item] for item in types if item in _LANE_KIND]
        self._lanes[name] = Lane(name, kinds[0] if kinds else "driving", left, right)
        if "crosswalk" in types:
            self._crossings.add(name)

    def build_site(self) -> SiteMap:
        """The lanes and crosswalks, counted."""
        crosswalks = [lane for name, lane in self._lanes.items() if name in self._crossings]
        self._report.count("lane", "of the scenario", len(self._lanes))
        self._report.count("crosswalk", "among its lanes", len(crosswalks))
        areas = (make_area(f"crosswalk {lane.id}", "crosswalk", lane.outline_m) for lane in crosswalks)
        return SiteMap(tuple(self._lanes.values()), tuple(areas))


def _read_time_step(root: XmlNode, path: Path) -> Decimal:
    text = root.attributes.get("timeStepSize")
    try:
        step_s = Decimal(text or "")
    except InvalidOperation:
        step_s = Decimal(0)
    if not step_s.is_finite() or not Decimal("1e-6") <= step_s <= 1000:
        raise InputError(
            f"{path}:{root.line}: expected timeStepSize in seconds (1e-6 to 1000), found {quote_value(text)}"
        )
    return step_s


def _read_id(node: XmlNode, path: Path) -> int:
    text = node.attributes.get("id", "")
    if not (text.isascii() and text.isdecimal() and len(text) < 19):
        raise InputError(
            f"{path}:{node.line}: expected <{node.tag}> with a whole number as id, found {quote_value(text)}"
        )
    return int(text)


def _map_kind(node: XmlNode, path: Path, report: ConversionReport, *, moving: bool) -> OsiKind:
    type_node = node.find("type")
    name = type_node.text.strip() if type_node is not None else ""
    kind = report.find_kind(name, "obstacle")
    if moving == kind.moving:
        return kind
    if moving:
        return KINDS["other"]
    # A static obstacle keeps the typical height of its kind.
    return OsiKind("static", False, KINDS["static"].type, like=kind.like)


def _read_shape(node: XmlNode, path: Path, report: ConversionReport) -> _Shape | None:
    """The size of an obstacle and its place in it; None: it has another shape than is read, which is counted."""
    shape = node.find("shape")
    children = shape.children if shape is not None else []
    if len(children) != 1 or children[0].tag not in ("rectangle", "circle", "polygon"):
        found = ", ".join(child.tag for child in children) or "none"
        report.count("obstacle", f"with another shape than one rectangle, circle or polygon ({found}): skipped")
        return None
    (drawn,) = children
    if drawn.tag == "polygon":
        return _box_around([_read_point(point, path) for point in drawn.all("point")], drawn, path, report)
    centre = drawn.find("center")
    x, y = _read_point(centre, path) if centre is not None else (0.0, 0.0)
    if drawn.tag == "circle":
        size_m = 2 * parse_positive(_read_text(drawn, path, "radius"), f"{path}:{drawn.line}: radius")
        return _Shape(size_m, size_m, x, y)
    length, width = (
        parse_positive(_read_text(drawn, path, tag), f"{path}:{drawn.line}: {tag}") for tag in ("length", "width")
    )
    orientation = drawn.find("orientation")
    yaw_rad = _read_value(orientation, path, report) if orientation is not None else 0.0
    return _Shape(length, width, x, y, yaw_rad)


def _box_around(points: list[tuple[float, float]], node: XmlNode, path: Path, report: ConversionReport) -> _Shape:
    """Return the box along the obstacle's own axes around a polygon."""
    if len(points) < 3:
        raise InputError(f"{path}:{node.line}: expected a polygon of at least 3 points, found {len(points)}")
    report.count("obstacle", "with a polygon as shape: the box around it taken")
    (west, east), (south, north) = ((min(axis), max(axis)) for axis in zip(*points, strict=True))
    return _Shape(east - west, north - south, (east + west) / 2, (north + south) / 2)


def _initial_state(node: XmlNode, path: Path) -> XmlNode:
    if (state := node.find("initialState")) is None:
        raise InputError(f"{path}:{node.line}: expected <{node.tag}> with an <initialState>, found none")
    return state


def _list_states(node: XmlNode, path: Path, report: ConversionReport) -> list[XmlNode]:
    trajectory = node.find("trajectory")
    if trajectory is None and node.find("occupancySet") is not None:
        report.count("obstacle", "with an occupancySet: only its initial state taken")
    return [_initial_state(node, path), *(trajectory.all("state") if trajectory is not None else [])]


def _read_time(state: XmlNode, path: Path) -> int:
    """Return the step of a state; of an interval the first."""
    time = state.find("time")
    value = None if time is None else time.find("exact") or time.find("intervalStart")
    text = value.text.strip() if value is not None else ""
    if not (text.isascii() and text.isdecimal() and len(text) < 19 and int(text) <= _LAST_STEP):
        raise InputError(f"{path}:{state.line}: time: expected a step of 0 to {_LAST_STEP}, found {quote_value(text)}")
    return int(text)


def _make_box(
    ident: int, kind: OsiKind, shape: _Shape, state: XmlNode, path: Path, report: ConversionReport, *, moving: bool
) -> Box | None:
    """The box of an obstacle in a state; None: the state has no position, which is counted."""
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
    x, y = _read_point(point, path, parse_number_or_none)
    orientation, speed = state.find("orientation"), state.find("velocity")
    if orientation is None:
        report.count("state", "without orientation: 0 taken")
    yaw_rad = _read_value(orientation, path, report) if orientation is not None else 0.0
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    at_m = (x + cos * shape.x_m - sin * shape.y_m, y + sin * shape.x_m + cos * shape.y_m, kind.height_m / 2)
    velocity = None
    if moving and speed is not None:
        speed_mps = _read_value(speed, path, report)
        velocity = (speed_mps * cos, speed_mps * sin)
    size_m = (shape.length_m, shape.width_m, kind.height_m)
    return Box(ident, kind, at_m, wrap_yaw(yaw_rad + shape.yaw_rad), size_m, velocity)


def _read_value(node: XmlNode, path: Path, report: ConversionReport) -> float:
    """Return a value, stated as such, as `exact`, or as an interval, of which it is the middle."""
    where = f"{path}:{node.line}: {node.tag}"
    low, high, exact = node.find("intervalStart"), node.find("intervalEnd"), node.find("exact")
    if low is not None and high is not None:
        report.count("value", f"of {node.tag} given as an interval: the middle taken")
        return (parse_number_or_none(low.text, where) + parse_number_or_none(high.text, where)) / 2
    return parse_number_or_none((node if exact is None else exact).text.strip(), where)


def _read_point(node: XmlNode, path: Path, parse: Callable[[object, str], float] = parse_number) -> tuple[float, float]:
    x, y = (parse(_read_text(node, path, axis), f"{path}:{node.line}: {axis}") for axis in "xy")
    return x, y


def _read_text(node: XmlNode, path: Path, tag: str) -> str:
    if (child := node.find(tag)) is None:
        found = ", ".join(c.tag for c in node.children) or "nothing"
        raise InputError(f"{path}:{node.line}: expected <{node.tag}> with <{tag}>, found {found}")
    return child.text.strip()
