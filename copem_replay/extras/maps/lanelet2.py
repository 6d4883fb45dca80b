"""Lanelet2 maps, `.osm` with relations of the type lanelet: lanes, crosswalks, intersections, parking, walls.

Where all nodes have `local_x` and `local_y`, these are taken; else the longitude and latitude. Borders may be stored
against each other and against the lane: they are turned so that the left one is on the left. Neither speed limits nor
regulatory elements are read.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from copem_replay.core.errors import InputError, count_noun, quote_value
from copem_replay.core.site_map import AreaKind, Lane, LaneKind, SiteMap, make_area
from copem_replay.core.tracks import Float
from copem_replay.experiment.maps import DEFAULT_HEIGHTS_M
from copem_replay.extras.convert.commonroad import XmlNode, read_parts
from copem_replay.extras.maps.solids import Shape, make_site

_FARTHEST: Final = 1e8
_KIND: Final[dict[str, LaneKind]] = {
    **dict.fromkeys(("road", "highway", "play_street", "bus_lane", "exit"), "driving"),
    "bicycle_lane": "bicycle",
    **dict.fromkeys(("walkway", "shared_walkway", "crosswalk", "pedestrian_lane"), "walking"),
    "parking": "parking",
}
_AREA: Final[dict[str, AreaKind]] = {
    "intersection_area": "junction",
    "parking_lot": "parking",
    "parking_space": "parking",
}


@dataclass(frozen=True)
class _Nodes:
    """Places of nodes by id, (x, y, z) of the map and (longitude, latitude, z); None: the node has none."""

    local: dict[str, tuple[float, float, float]]
    degrees: dict[str, tuple[float, float, float]]


def read_lanelet2(path: Path, heights_m: Mapping[str, float] = DEFAULT_HEIGHTS_M) -> SiteMap:
    """Lanes, areas and walls of a map. Raises InputError with file and line."""
    import shapely

    nodes, ways, relations = _Nodes({}, {}), dict[str, XmlNode](), list[XmlNode]()
    for part in read_parts(path, ("osm",), most_elements=300_000):
        if part.tag == "node":
            _add_node(nodes, part, path)
        elif part.tag == "way":
            ways[part.attributes.get("id", "")] = part
        elif part.tag == "relation" and _tags(part).get("type") == "lanelet":
            relations.append(part)
    local = len(nodes.local) == len(nodes.degrees) or not nodes.degrees
    places = nodes.local if local else nodes.degrees
    lines = {name: _find_line(way, places, path) for name, way in ways.items()}
    lanes, counts = list[Lane](), Counter[str]()
    for relation in relations:
        lane = _find_lane(relation, lines)
        if lane is None:
            counts["lanelet"] += 1
        else:
            lanes.append(lane)
    areas = [
        make_area(f"crosswalk {lane.id}", "crosswalk", lane.outline_m)
        for lane, relation in zip(lanes, (r for r in relations if _find_lane(r, lines)), strict=True)
        if _tags(relation).get("subtype") == "crosswalk"
    ]
    for name, way in ways.items():
        if (kind := _AREA.get(_tags(way).get("type", ""))) is not None and len(lines[name]) > 3:
            areas.append(make_area(f"{kind} {name}", kind, lines[name]))
    notes = [f"{count_noun(n, noun)} without two borders of two points: left out" for noun, n in counts.items()]
    walls = [
        Shape(f"way/{name}", shapely.LineString(lines[name][:, :2]), _wall_tags(way))
        for name, way in ways.items()
        if _is_wall(way)
    ]
    site = make_site(walls, heights_m, Counter(), degrees=not local)
    return replace(site, lanes=tuple(lanes), areas=tuple(areas), assumed=(*notes, *site.assumed))


def _is_wall(way: XmlNode) -> bool:
    """Whether a line hides: guard rails, fences and kerbs are seen through."""
    return _tags(way).get("type") == "wall" and len({nd.attributes.get("ref") for nd in way.all("nd")}) > 1


def _wall_tags(way: XmlNode) -> dict[str, str]:
    return {name: value for name, value in _tags(way).items() if name in ("height", "width")} | {"barrier": "wall"}


def _add_node(nodes: _Nodes, node: XmlNode, path: Path) -> None:
    """Add a node's places. Raises InputError: numbers that are none."""
    tags, ident = _tags(node), node.attributes.get("id", "")
    elevation = _parse(tags.get("ele", "0"), "ele", node, path)
    if "local_x" in tags and "local_y" in tags:
        x, y = (_parse(tags[name], name, node, path) for name in ("local_x", "local_y"))
        nodes.local[ident] = (x, y, elevation)
    if "lat" in node.attributes or "lon" in node.attributes or ident not in nodes.local:
        lon, lat = (_parse(node.attributes.get(name), name, node, path) for name in ("lon", "lat"))
        nodes.degrees[ident] = (lon, lat, elevation)


def _parse(text: str | None, name: str, node: XmlNode, path: Path) -> float:
    most = {"lat": 90.0, "lon": 180.0}.get(name, _FARTHEST)
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) <= most:
        raise InputError(
            f"{path}:{node.line}: <{node.tag}> {name}: expected a number of at most {most:g}, found {quote_value(text)}"
        )
    return value


def _tags(node: XmlNode) -> dict[str, str]:
    return {tag.attributes.get("k", ""): tag.attributes.get("v", "") for tag in node.all("tag")}


def _find_line(way: XmlNode, places: dict[str, tuple[float, float, float]], path: Path) -> Float:
    """The points (K, 3) of a way. Raises InputError: a node that is not in the file."""
    points = []
    for each in way.all("nd"):
        if (place := places.get(each.attributes.get("ref", ""))) is None:
            found = quote_value(each.attributes.get("ref"))
            raise InputError(f"{path}:{each.line}: <nd ref>: expected a node of this file with a place, found {found}")
        points.append(place)
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def _find_lane(relation: XmlNode, lines: dict[str, Float]) -> Lane | None:
    """The lane of a relation, its left border on the left; None: it lacks a border."""
    members = {m.attributes.get("role"): m.attributes.get("ref", "") for m in relation.all("member")}
    left, right = (lines.get(members.get(role, "")) for role in ("left", "right"))
    if left is None or right is None or min(len(left), len(right)) < 2:
        return None
    left, right = _turn_borders(left, right)
    kind = _KIND.get(_tags(relation).get("subtype", ""), "other")
    junction = "turn_direction" in _tags(relation)
    return Lane(relation.attributes.get("id", ""), kind, left, right, junction)


def _turn_borders(left: Float, right: Float) -> tuple[Float, Float]:
    """Both borders (K, 3) in one direction, in which the left one is on the left."""

    def apart(a: int, b: int) -> float:
        return float(np.hypot(*(left[a, :2] - right[b, :2])))

    if apart(0, 0) + apart(-1, -1) > apart(0, -1) + apart(-1, 0):
        right = right[::-1]
    x, y = (np.concatenate([left, right[::-1]])[:, k] for k in (0, 1))
    x, y = x - x[0], y - y[0]  # longitudes are large beside their differences
    if np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) > 0.0:  # counter-clockwise: the left one is on the right
        return left[::-1], right[::-1]
    return left, right
