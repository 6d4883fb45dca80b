"""OpenStreetMap data, XML or Overpass JSON: nodes, ways and relations, and the areas and lines of their tags.

Coordinates are those of nodes, or of members (`out geom`). What was deleted in an editor is not read. A map of tagged
shapes becomes solids in extras/maps/solids.py.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from copem_replay.core.errors import InputError, quote_value
from copem_replay.core.site_map import SiteMap
from copem_replay.extras.convert.commonroad import XmlNode, read_parts
from copem_replay.extras.maps.solids import Place, Shape, Tags, check_place, hides, make_site, tag_text

if TYPE_CHECKING:
    import shapely

ATTRIBUTION: Final = "© OpenStreetMap contributors, ODbL 1.0"
_MOST_ELEMENTS: Final = 100_000
"""Of one way or relation: a way has at most 2,000 nodes, a relation 32,000 members."""


class Member(NamedTuple):
    """A way that is part of a relation."""

    way: str
    inner: bool


@dataclass
class OsmData:
    """Elements by id. What nodes tell beside their place is not kept."""

    places: dict[str, Place] = field(default_factory=dict)  # longitude, latitude
    ways: dict[str, tuple[list[str], Tags]] = field(default_factory=dict)  # nodes, tags
    relations: list[tuple[str, list[Member], Tags]] = field(default_factory=list)  # multipolygons
    licence: str = ""

    def add_geometry(self, way: str, points: Sequence[Place | None]) -> None:
        """Add a way by its places instead of nodes, unless it is there; None: a place that was cut off."""
        names = [f"{place[0]!r} {place[1]!r}" for place in points if place is not None]
        self.places.update(zip(names, (place for place in points if place is not None), strict=True))
        self.ways.setdefault(way, (names if None not in points else ["", *names], {}))


def read_osm(path: Path, heights_m: Mapping[str, float]) -> SiteMap:
    """Solids of a file of XML, in degrees. Raises InputError with file and line."""
    data = OsmData()
    for part in read_parts(path, ("osm",), most_elements=_MOST_ELEMENTS):
        _note_licence(data, part)
        if part.attributes.get("action") == "delete" or part.attributes.get("visible") == "false":
            continue
        ident = part.attributes.get("id", "")
        if part.tag == "node":
            if "lat" in part.attributes or "lon" in part.attributes:
                data.places[ident] = _read_place(part, path)
        elif part.tag == "way":
            if (nodes := part.all("nd")) and all("lat" in node.attributes for node in nodes):
                for node in nodes:
                    data.places.setdefault(node.attributes.get("ref", ""), _read_place(node, path))
            data.ways[ident] = ([node.attributes.get("ref", "") for node in nodes], _tags(part))
        elif part.tag == "relation" and _tags(part).get("type") == "multipolygon":
            data.relations.append((ident, list(_read_members(data, part, path)), _tags(part)))
    return _make_osm_site(data, path, heights_m)


def _read_members(data: OsmData, relation: XmlNode, path: Path) -> Iterator[Member]:
    for member in relation.all("member"):
        if member.attributes.get("type") == "way":
            way = member.attributes.get("ref", "")
            if nodes := member.all("nd"):
                data.add_geometry(way, [_read_place(n, path) if "lat" in n.attributes else None for n in nodes])
            yield Member(way, member.attributes.get("role") == "inner")


def _read_place(node: XmlNode, path: Path) -> Place:
    where = f"{path}:{node.line}: <{node.tag}>"
    return check_place(node.attributes.get("lon"), node.attributes.get("lat"), where)


def _tags(node: XmlNode) -> Tags:
    return {tag.attributes.get("k", ""): tag.attributes.get("v", "") for tag in node.all("tag")}


def _note_licence(data: OsmData, part: XmlNode) -> None:
    """What the root, a `<note>` or the number of a change set in its data base says of where the data are from."""
    words = [part.attributes.get(name, "") for name in ("copyright", "attribution", "license")]
    words += [part.text] if part.tag == "note" else []
    if "changeset" in part.attributes or re.search("openstreetmap|odbl", " ".join(words), re.IGNORECASE):
        data.licence = ATTRIBUTION


def read_overpass(path: Path, content: dict[str, Any], heights_m: Mapping[str, float]) -> SiteMap:
    """Solids of an answer of Overpass, in degrees. Raises InputError with the element."""
    elements = content["elements"]
    if not isinstance(elements, list):
        raise InputError(f"{path}: elements: expected a list, found {quote_value(elements)}")
    head = content.get("osm3s")
    data = OsmData(licence=ATTRIBUTION if isinstance(head, dict) and "copyright" in head else "")
    for k, element in enumerate(elements):
        where = f"{path}: elements[{k}]"
        if not isinstance(element, dict):
            raise InputError(f"{where}: expected an element, found {quote_value(element)}")
        data.licence = ATTRIBUTION if "changeset" in element else data.licence
        _add_element(data, element, where)
    return _make_osm_site(data, path, heights_m)


def _add_element(data: OsmData, element: dict[str, Any], where: str) -> None:
    """Add a node, way or multipolygon of Overpass JSON to `data`. Raises InputError."""
    ident, kind = str(element.get("id")), element.get("type")
    tags = _json_tags(element.get("tags", {}), where)
    if kind == "node" and ("lat" in element or "lon" in element):
        data.places[ident] = check_place(element.get("lon"), element.get("lat"), where)
    elif kind == "way":
        if "geometry" in element:
            data.add_geometry(ident, _read_points(element["geometry"], where))
        refs = [str(ref) for ref in _list_of(element, "nodes", where)]
        known_refs = data.ways.get(ident, (refs, {}))[0] if "geometry" in element else refs
        data.ways[ident] = (known_refs, tags)
    elif kind == "relation" and tags.get("type") == "multipolygon":
        members = list[Member]()
        for member in _list_of(element, "members", where):
            if isinstance(member, dict) and member.get("type") == "way":
                way = str(member.get("ref"))
                if "geometry" in member:
                    data.add_geometry(way, _read_points(member["geometry"], where))
                members.append(Member(way, member.get("role") == "inner"))
        data.relations.append((ident, members, tags))


def _read_points(points: object, where: str) -> list[Place | None]:
    if not isinstance(points, list) or not all(point is None or isinstance(point, dict) for point in points):
        raise InputError(f"{where}: geometry: expected places, found {quote_value(points)}")
    return [check_place(p.get("lon"), p.get("lat"), where) if p is not None else None for p in points]


def _list_of(element: dict[str, Any], name: str, where: str) -> list[Any]:
    if not isinstance(found := element.get(name, []), list):
        raise InputError(f"{where}: {name}: expected a list, found {quote_value(found)}")
    return found


def _json_tags(tags: object, where: str) -> Tags:
    if not isinstance(tags, dict):
        raise InputError(f"{where}: tags: expected words by name, found {quote_value(tags)}")
    return {str(name): tag_text(value) for name, value in tags.items()}


def _make_osm_site(data: OsmData, path: Path, heights_m: Mapping[str, float]) -> SiteMap:
    """The solids of elements. Raises InputError: ways, and not a place of theirs."""
    if data.ways and not data.places:
        raise InputError(f"{path}: expected nodes with places, found none; export with `(._;>;); out;` or `out geom;`")
    counts = Counter[str]()
    shapes = [*_find_multipolygons(data, counts), *_find_ways(data, counts)]
    return make_site(shapes, heights_m, counts, data.licence)


def _find_multipolygons(data: OsmData, counts: Counter[str]) -> Iterator[Shape]:
    """Areas of relations: rings joined from their ways. A ring that stays open is left out, counted."""
    import shapely

    for ident, members, tags in data.relations:
        if not hides(tags) or "barrier" in tags:
            continue
        lines: tuple[list[Any], list[Any]] = ([], [])  # of outer rings, of holes
        for member in members:
            line = _find_line(data, member.way) if member.way in data.ways else None
            if line is None:
                counts["member of a multipolygon that is not in the file: left out"] += 1
            else:
                lines[member.inner].append(line)
        (outer, open_outer), (inner, open_inner) = (_join_rings(each) for each in lines)
        if open_outer or open_inner:
            counts["ring of a multipolygon that stays open: left out"] += open_outer + open_inner
        if outer:
            area = shapely.union_all(outer).difference(shapely.union_all(inner))
            yield Shape(f"relation/{ident}", area, tags)


def _join_rings(lines: list[shapely.LineString]) -> tuple[list[shapely.Geometry], int]:
    """Areas of the closed rings that lines make, and how many stay open."""
    import shapely

    if not lines:
        return [], 0
    merged = shapely.line_merge(shapely.MultiLineString(lines))
    parts = shapely.get_parts(merged)
    closed = [part for part in parts if part.is_closed and len(part.coords) > 3]
    rings = [shapely.make_valid(shapely.Polygon(part), method="structure", keep_collapsed=False) for part in closed]
    return rings, len(parts) - len(closed)


def _find_ways(data: OsmData, counts: Counter[str]) -> Iterator[Shape]:
    """Shapes of ways: areas of closed ones, and lines of barriers."""
    import shapely

    for ident, (nodes, tags) in data.ways.items():
        if hides(tags) and (line := _find_line(data, ident)) is not None:
            if "barrier" in tags and not ("building" in tags or "building:part" in tags):
                yield Shape(f"way/{ident}", line, tags)
            elif nodes[0] == nodes[-1] and len(line.coords) > 3 and line.is_closed:
                yield Shape(f"way/{ident}", shapely.Polygon(line), tags)
            else:
                counts["building whose outline stays open: left out"] += 1


def _find_line(data: OsmData, way: str) -> shapely.LineString | None:
    """The line of a way through the nodes that have places; None: fewer than two."""
    import shapely

    points = [data.places[node] for node in data.ways[way][0] if node in data.places]
    return shapely.LineString(points) if len(points) > 1 else None
