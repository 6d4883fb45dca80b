"""OpenDRIVE maps, `.xodr`: lanes and their directions, crosswalks and junctions as areas, objects as solids.

Road marks, signals and the surface of roads are not read. A crossfall (`shape`) and an object's pitch and roll are
taken as 0, counted.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from copem_replay.core.errors import InputError, count_noun, quote_value
from copem_replay.core.site_map import Lane, LaneKind, MapSolid, SiteMap, make_area, make_polygon
from copem_replay.core.tracks import Area, Float
from copem_replay.extras.convert.commonroad import XmlNode, read_parts
from copem_replay.extras.maps.opendrive_geometry import CHORD_M, SHAPES, Cubics, Piece, RoadLine
from copem_replay.io.channel import DefinitionError
from copem_replay.io.encodings import make_definition
from copem_replay.io.encodings.columns import shred_messages
from copem_replay.io.open import open_log
from copem_replay.io.schemas.osi_ground_truth import EMBEDDED_MAP

_FARTHEST: Final = 1e8
"""No number of a map is larger: metres of projections are below 2e7."""
_MOST_COPIES: Final = 20_000
_MOST_CORNERS: Final = 1_000_000
"""Of all borders and outlines of a map."""
_MOST_LANES: Final = 100
"""Beside one another on one side."""
_FLAT_M: Final = 0.05

_LANE_KIND: Final[dict[str, LaneKind]] = {
    **dict.fromkeys(
        ("driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane", "bidirectional", "bus", "taxi",
         "HOV", "stop", "roadWorks", "special1", "special2", "special3", "mwyEntry", "mwyExit", "shared"),
        "driving",
    ),
    "biking": "bicycle",
    "sidewalk": "walking",
    "walking": "walking",
    "parking": "parking",
}  # fmt: skip
_NO_LANE: Final = frozenset({"none", "border", "curb", "median", "restricted"})
_HIDES_NOTHING: Final = frozenset({"crosswalk", "parkingSpace", "roadMark", "roadSurface", "patch", "trafficIsland"})


@dataclass
class _Reading:
    """A map while it is read, with what is counted on the way."""

    path: Path
    lanes: list[Lane] = field(default_factory=list)
    areas: list[Area] = field(default_factory=list)
    solids: list[MapSolid] = field(default_factory=list)
    outlines: dict[str, list[Float]] = field(default_factory=lambda: defaultdict(list))  # of lanes, by junction
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    corners: int = 0

    def number(self, node: XmlNode, name: str, default: float | None = None) -> float:
        """The number of an attribute. Raises InputError: missing without a `default`, or out of bounds."""
        text = node.attributes.get(name, "")
        if not text.strip() and default is not None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not abs(value) <= _FARTHEST:
            found = quote_value(text or None)
            raise InputError(
                f"{self.path}:{node.line}: <{node.tag} {name}>: expected a number of at most 1e8, found {found}"
            )
        return value

    def spend(self, corners: int, node: XmlNode) -> None:
        """Count corners. Raises InputError: the map has too many."""
        self.corners += corners
        if self.corners > _MOST_CORNERS:
            raise InputError(
                f"{self.path}:{node.line}: <{node.tag}>: expected at most {_MOST_CORNERS:,} corners, found more"
            )


def read_embedded_map(path: Path, _heights_m: object = None) -> SiteMap:
    """The map that a recording has in it, as omega-prime writes it. Raises InputError, with the line of the map."""
    log, name = open_log(path), "open_drive_xml_content"
    maps = {c.number: c for c in log.channels if c.schema == EMBEDDED_MAP and c.messages}
    message = log.attempt(lambda log: next(log.payloads(frozenset(maps)), None))
    if message is None:
        raise InputError(f"{path}: expected a map in the recording ({EMBEDDED_MAP}), found none")
    try:
        columns = shred_messages(make_definition(maps[message[0]], [message[2]]), [message[2]], texts=[name]).levels[""]
    except (DefinitionError, KeyError) as error:
        raise InputError(f"{path}: the map in it cannot be read: {error}") from None
    return read_opendrive(path, content="".join(columns.texts[name].words).encode())


def read_opendrive(
    path: Path, _heights_m: object = None, *, chord_m: float = CHORD_M, content: bytes | None = None
) -> SiteMap:
    """Lanes, areas and solids of a map; `content`: of the file, None: it is read. Raises InputError with the line."""
    reading = _Reading(path)
    proj, offset_m, yaw_rad = "", (0.0, 0.0), 0.0
    for part in read_parts(path, ("OpenDRIVE",), most_elements=300_000, content=content):
        if part.tag == "header":
            reference = part.find("geoReference")
            proj = "" if reference is None else reference.text.strip()
            if (offset := part.find("offset")) is not None:
                offset_m = (reading.number(offset, "x", 0.0), reading.number(offset, "y", 0.0))
                yaw_rad = reading.number(offset, "hdg", 0.0)
        elif part.tag == "road":
            _read_road(reading, part, chord_m)
    _join_junctions(reading)
    notes = [f"{count_noun(number, noun)} {what}" for (noun, what), number in reading.counts.items()]
    return SiteMap(
        tuple(reading.lanes), tuple(reading.areas), tuple(reading.solids), proj, offset_m, yaw_rad, assumed=tuple(notes)
    )


def _read_road(reading: _Reading, road: XmlNode, chord_m: float) -> None:
    line = read_road_line(reading, road)
    if line is None:
        reading.counts["road", "without a reference line: left out"] += 1
        return
    _read_lanes(reading, road, line, chord_m)
    for node in _children(road, "objects", "object"):
        _read_object(reading, node, line, road.attributes.get("id", ""))


def _children(node: XmlNode, parent: str, tag: str) -> list[XmlNode]:
    """All children of a tag in all children of another."""
    return [child for each in node.all(parent) for child in each.all(tag)]


def read_road_line(reading: _Reading, road: XmlNode) -> RoadLine | None:
    """The reference line of a road; None: it has none. Raises InputError."""
    pieces = [_read_piece(reading, node) for node in _children(road, "planView", "geometry")]
    if not pieces:
        return None
    if _children(road, "lateralProfile", "shape"):
        reading.counts["road", "with a crossfall: taken as level across"] += 1
    return RoadLine(
        f"{reading.path}:{road.line}: road {road.attributes.get('id', '')}",
        reading.number(road, "length"),
        tuple(sorted(pieces, key=lambda piece: piece.s)),
        _read_cubics(reading, _children(road, "elevationProfile", "elevation")),
        _read_cubics(reading, _children(road, "lateralProfile", "superelevation")),
    )


def _read_piece(reading: _Reading, node: XmlNode) -> Piece:
    """One `<geometry>` of a reference line. Raises InputError."""
    shape = next((child for child in node.children if child.tag in SHAPES), None)
    if shape is None:
        found = ", ".join(child.tag for child in node.children[:3]) or "nothing"
        raise InputError(
            f"{reading.path}:{node.line}: <geometry>: expected one of {', '.join(SHAPES)}, found {quote_value(found)}"
        )
    numbers = {name: reading.number(shape, name) for name in SHAPES[shape.tag][0]}
    numbers["normalized"] = float(shape.attributes.get("pRange", "normalized") == "normalized")
    s, x, y, heading, length = (reading.number(node, name) for name in ("s", "x", "y", "hdg", "length"))
    if length < 0.0:
        raise InputError(f"{reading.path}:{node.line}: <geometry length>: expected 0 m or more, found {length:g}")
    return Piece(s, x, y, heading, length, shape.tag, numbers)


def _read_cubics(reading: _Reading, nodes: list[XmlNode], first: str = "s", add: float = 0.0) -> Cubics:
    """A piecewise cubic of elements with a, b, c, d; `add` to where they start."""
    return Cubics.of_rows(
        [
            (reading.number(node, first, 0.0) + add, *(reading.number(node, name, 0.0) for name in "abcd"))
            for node in nodes
        ]
    )


@dataclass(frozen=True)
class _LaneNode:
    """One lane of a section: its number, its kind, and its cubics, of its width or of its outer border."""

    number: int
    kind: str
    cubics: Cubics
    border: bool


def _read_lanes(reading: _Reading, road: XmlNode, line: RoadLine, chord_m: float) -> None:
    """Add the lanes of all sections of a road; chords of their borders stay within `chord_m`."""
    offset = _read_cubics(reading, _children(road, "lanes", "laneOffset"))
    sections = sorted(
        ((reading.number(node, "s"), node) for node in _children(road, "lanes", "laneSection")),
        key=lambda item: item[0],
    )
    left_hand = road.attributes.get("rule") == "LHT"
    for k, (start, section) in enumerate(sections):
        end = min(line.length_m, sections[k + 1][0] if k + 1 < len(sections) else line.length_m)
        if not end - start > 1e-6:
            continue
        for side, sign in (("left", 1), ("right", -1)):
            nodes = _children(section, side, "lane")
            if len(nodes) > _MOST_LANES:
                expected = f"expected at most {_MOST_LANES} lanes, found {len(nodes):,}"
                raise InputError(f"{reading.path}:{section.line}: <{side}>: {expected}")
            lanes = [_read_lane(reading, node, start) for node in nodes]
            lanes = sorted((lane for lane in lanes if lane.number), key=lambda lane: abs(lane.number))
            if not lanes:
                continue

            def beside(s: Float, lanes: list[_LaneNode] = lanes, sign: int = sign) -> Float:
                return _find_borders(s, offset.at(s), lanes, sign)

            breaks = [*offset.start, *line.height.start, *line.tilt.start, *(s for o in lanes for s in o.cubics.start)]
            s = line.sample(start, end, beside, breaks, chord_m)
            reading.spend(len(s) * (len(lanes) + 1), section)
            borders = line.place(s, beside(s))
            _add_lanes(reading, road, k, lanes, borders, forward=(sign < 0) != left_hand)


def _read_lane(reading: _Reading, node: XmlNode, start: float) -> _LaneNode:
    text = node.attributes.get("id", "")
    try:
        number = int(text)
    except ValueError:
        raise InputError(
            f"{reading.path}:{node.line}: <lane id>: expected a whole number, found {quote_value(text or None)}"
        ) from None
    widths, borders = node.all("width"), node.all("border")
    cubics = _read_cubics(reading, widths or borders, "sOffset", start)
    return _LaneNode(number, node.attributes.get("type", "none"), cubics, bool(borders and not widths))


def _find_borders(s: Float, offset_m: Float, lanes: list[_LaneNode], sign: int) -> Float:
    """T (B, K) of the borders of the lanes on one side, from the middle outwards: one more than lanes."""
    borders = [offset_m]
    for lane in lanes:
        value = lane.cubics.at(s)
        borders.append(offset_m + value if lane.border else borders[-1] + sign * np.maximum(value, 0.0))
    return np.stack(borders)


def _add_lanes(
    reading: _Reading, road: XmlNode, section: int, lanes: list[_LaneNode], borders: Float, *, forward: bool
) -> None:
    """Add lanes between neighbouring borders (B, K, 3). `forward`: they are driven along the road."""
    junction = road.attributes.get("junction", "-1")
    for lane, inner, outer in zip(lanes, borders, borders[1:], strict=False):
        if np.abs(inner - outer).max() < 0.01:
            continue  # no lane yet, or no more
        along = slice(None) if forward else slice(None, None, -1)
        left, right = (inner, outer) if (lane.number < 0) == forward else (outer, inner)
        kind = _LANE_KIND.get(lane.kind, "other")
        name = f"{road.attributes.get('id', '')}/{section}/{lane.number}"
        if lane.kind not in _NO_LANE:
            reading.lanes.append(Lane(name, kind, left[along], right[along], junction != "-1"))
        if junction != "-1" and kind == "driving":
            reading.outlines[junction].append(np.concatenate([inner[:, :2], outer[::-1, :2]]))


def _join_junctions(reading: _Reading) -> None:
    """Add the area of each junction: the union of its lanes."""
    import shapely

    for name, outlines in reading.outlines.items():
        polygons = [make_polygon([outline]) for outline in outlines]
        if crossing_count := sum(polygon.is_empty for polygon in polygons):
            reading.counts["lane", "whose outline crosses itself: not in the area of its junction"] += crossing_count
        joined = shapely.union_all([polygon.buffer(0.05) for polygon in polygons])
        for polygon in shapely.get_parts(joined):
            if polygon.geom_type == "Polygon" and polygon.area > 1.0:
                rings = [np.array(ring.coords) for ring in (polygon.exterior, *polygon.interiors)]
                reading.areas.append(make_area(f"junction {name}", "junction", *rings))


# Objects.

_Prism = tuple[Float, float, float]
"""Corners (K, 2), bottom and top."""


def _read_object(reading: _Reading, node: XmlNode, line: RoadLine, road: str) -> None:
    """Add an object of a road as a solid, or a crosswalk as an area; flat ones hide nothing."""
    kind, name = node.attributes.get("type", ""), f"road {road} object {node.attributes.get('id', '')}"
    if kind in _HIDES_NOTHING and kind != "crosswalk":
        return
    if abs(reading.number(node, "pitch", 0.0)) + abs(reading.number(node, "roll", 0.0)) > 1e-6:
        reading.counts["object", "with pitch or roll: taken as upright"] += 1
    prisms = list(_outline_prisms(reading, node, line))
    if not prisms:
        repeats = node.all("repeat")
        prisms = [p for r in repeats for p in _repeat_prisms(reading, node, r, line)] if repeats else []
        prisms = prisms if repeats else _single_prism(reading, node, line)
    for corners, bottom_m, top_m in prisms:
        reading.spend(len(corners), node)
        if kind == "crosswalk":
            reading.areas.append(make_area(name, "crosswalk", corners))
        elif top_m - bottom_m > _FLAT_M + 1e-9:
            reading.solids.append(MapSolid(name, kind, (corners,), bottom_m, top_m))
        else:
            reading.counts["object", "that is flat: hides nothing"] += 1


def _place_object(reading: _Reading, node: XmlNode, line: RoadLine) -> tuple[Float, float]:
    """The place (3,) of an object on the road, and its heading."""
    s, t = np.array([reading.number(node, "s")]), np.array([reading.number(node, "t")])
    return line.place(s, t)[0], float(line.follow(s)[2][0]) + reading.number(node, "hdg", 0.0)


def _outline_prisms(reading: _Reading, node: XmlNode, line: RoadLine) -> Iterator[_Prism]:
    """The prisms (corners, bottom, top) of an object's outlines, each as high as its highest corner."""
    raised_m = reading.number(node, "zOffset", 0.0)
    for outline in [*_children(node, "outlines", "outline"), *node.all("outline")]:
        if on_road := outline.all("cornerRoad"):
            s, t, above_m, height = _columns(reading, on_road, ("s", "t", "dz", "height"))
            points = line.place(s, t)
        else:
            u, v, above_m, height = _columns(reading, outline.all("cornerLocal"), ("u", "v", "z", "height"))
            base, heading = _place_object(reading, node, line)
            cos, sin = math.cos(heading), math.sin(heading)
            points = np.stack(
                [base[0] + cos * u - sin * v, base[1] + sin * u + cos * v, base[2] + raised_m + 0 * u], -1
            )
        closed = outline.attributes.get("closed", "true") != "false"
        if len(points) < (3 if closed else 2):
            reading.counts["outline", "of too few corners: left out"] += 1
            continue
        if np.ptp(height) > 1e-6:
            reading.counts["outline", "with corners of several heights: the highest taken"] += 1
        foot_m = points[:, 2] + above_m
        bottom_m, top_m = float(foot_m.min()), float((foot_m + height).max())
        if closed:
            yield points[:, :2], bottom_m, top_m
        else:
            width_m = max(reading.number(node, "width", 0.0), 0.1)
            for a, b in zip(points[:-1, :2], points[1:, :2], strict=True):
                if (length_m := float(np.hypot(*(b - a)))) > 1e-6:
                    heading = math.atan2(b[1] - a[1], b[0] - a[0])
                    yield _turn_box((a + b) / 2, heading, length_m, width_m), bottom_m, top_m


def _columns(reading: _Reading, nodes: list[XmlNode], names: tuple[str, ...]) -> Float:
    """Numbers (n, K) of elements."""
    reading.spend(len(nodes), nodes[0]) if nodes else None
    rows = [[reading.number(node, name, 0.0) for name in names] for node in nodes]
    return np.array(rows, dtype=np.float64).reshape(-1, len(names)).T


def _single_prism(reading: _Reading, node: XmlNode, line: RoadLine) -> list[_Prism]:
    """The octagon around an object's radius, or the box of its length and width; empty: it has no size."""
    base, heading = _place_object(reading, node, line)
    length_m, width_m, height_m, radius_m = (
        reading.number(node, name, 0.0) for name in ("length", "width", "height", "radius")
    )
    bottom_m = float(base[2]) + reading.number(node, "zOffset", 0.0)
    if radius_m > 0.0:
        return [(_octagon(base[:2], radius_m), bottom_m, bottom_m + height_m)]
    if length_m > 0.0 and width_m > 0.0:
        return [(_turn_box(base[:2], heading, length_m, width_m), bottom_m, bottom_m + height_m)]
    reading.counts["object", "without a size: left out"] += 1
    return []


def _octagon(at_m: Float, radius_m: float) -> Float:
    """The regular octagon around a circle."""
    angle = (np.arange(8) + 0.5) * np.pi / 4
    return at_m + radius_m / math.cos(np.pi / 8) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _turn_box(at_m: Float, heading_rad: float, length_m: float, width_m: float) -> Float:
    """Corners (4, 2) of a box."""
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (length_m / 2, width_m / 2)
    corners: Float = at_m + half @ np.array([[cos, sin], [-sin, cos]])
    return corners


def _repeat_prisms(reading: _Reading, node: XmlNode, repeat: XmlNode, line: RoadLine) -> list[_Prism]:
    """Copies of an object along the road, or with the distance 0 a strip along it. Raises InputError: too many."""
    start, length_m, apart_m = (reading.number(repeat, name) for name in ("s", "length", "distance"))
    if not (length_m >= 0.0 and apart_m >= 0.0) or (apart_m > 0.0 and length_m / apart_m >= _MOST_COPIES):
        raise InputError(
            f"{reading.path}:{repeat.line}: <repeat> of object {quote_value(node.attributes.get('id'))}: expected at "
            f"most {_MOST_COPIES:,} copies, found length {length_m:g} m with distance {apart_m:g} m"
        )
    heading = reading.number(node, "hdg", 0.0)

    def value(name: str, base: str, s: Float) -> Float:
        """A number that goes evenly from the start of the repetition to its end."""
        first = reading.number(repeat, f"{name}Start", reading.number(node, base, 0.0))
        last = reading.number(repeat, f"{name}End", first)
        return first + (last - first) * ((s - start) / length_m if length_m else 0.0 * s)

    if apart_m > 0.0:
        s = np.array([start + apart_m * k for k in range(int(length_m / apart_m + 1e-9) + 1)])
    else:
        end = min(start + length_m, line.length_m)
        if not end - start > 1e-6:
            return []
        s = line.sample(start, end, lambda s: value("t", "t", s)[None], list(line.height.start))
    t, raised, height, width, length = (
        value(name, base, s)
        for name, base in (
            ("t", "t"),
            ("zOffset", "zOffset"),
            ("height", "height"),
            ("width", "width"),
            ("length", "length"),
        )
    )
    bottom = line.place(s, t)[:, 2] + raised
    if apart_m > 0.0:
        headings, at = line.follow(s)[2] + heading, line.place(s, t)[:, :2]
        round_m = 2 * reading.number(node, "radius", 0.0)
        return [
            (_turn_box(at[k], headings[k], max(length[k] or round_m, 0.01), max(width[k] or round_m, 0.01)),
             float(bottom[k]), float(bottom[k] + height[k]))
            for k in range(len(s))
        ]  # fmt: skip
    half = np.maximum(width, 0.1) / 2
    left, right = line.place(s, t + half)[:, :2], line.place(s, t - half)[:, :2]
    return [
        (np.array([left[k], right[k], right[k + 1], left[k + 1]]),
         float(bottom[k : k + 2].min()), float((bottom + height)[k : k + 2].max()))
        for k in range(len(s) - 1)
    ]  # fmt: skip
