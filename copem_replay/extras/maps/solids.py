"""Solids of tagged shapes, in the words of OpenStreetMap: what hides, how high it is, and what was assumed.

Shapes are in degrees. They are cut and widened in metres of a plane that touches the middle of the map, and given back
in degrees: a projection is the business of a frame.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from copem_replay.core.errors import InputError, quote_value
from copem_replay.core.site_map import MapSolid, SiteMap
from copem_replay.core.tracks import Float

if TYPE_CHECKING:
    import shapely

Tags = Mapping[str, str]
Place = tuple[float, float]
"""Longitude, latitude."""
_BARRIERS: Final = ("wall", "city_wall", "retaining_wall", "hedge")
"""Others, such as fences, are seen through."""
_BARRIER_WIDTH_M: Final = 0.3
_ROOF_M: Final = 0.5
"""How thick a roof on posts is."""
_SLIVER_M: Final = 0.1
_LEAST_M2: Final = 0.05
_LEAST_REST_M2: Final = 1.0
_FOOT_M: Final = 0.3048
_EQUATOR_M, _FLATTENING = 6_378_137.0, 1 / 298.257223563
_NO_HEIGHT: Final = 1e4
"""More metres than anything has that stands on earth."""


class Shape(NamedTuple):
    """A polygon, or a line of a barrier, with what is said of it."""

    name: str
    geometry: Any  # shapely's, in degrees, x the longitude
    tags: Tags


class _Block(NamedTuple):
    """An upright prism in metres of the touching plane."""

    name: str
    kind: str
    footprint: shapely.Polygon
    bottom_m: float
    top_m: float
    on_ground: bool
    role: str  # outline, part, barrier


def check_place(lon: object, lat: object, where: str) -> Place:
    """A place in degrees. Raises InputError: no numbers, or none on earth."""
    try:
        place = float(lon), float(lat)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        place = math.nan, math.nan
    if isinstance(lon, bool) or isinstance(lat, bool) or not (abs(place[0]) <= 180.0 and abs(place[1]) <= 90.0):
        found = f"{quote_value(lon)}, {quote_value(lat)}"
        raise InputError(f"{where}: expected a longitude of ±180 and a latitude of ±90 degrees, found {found}")
    return place


def tag_text(value: object) -> str:
    """The text of a tag from a JSON value: numbers as they are, true as yes, none and false as no."""
    if value is None or isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)


def parse_metres(text: str | None) -> float | None:
    """The metres of a length: `12`, `12.5 m`, `40 ft`, `12'6"`; None: it is none."""
    said = (text or "").strip().replace(",", ".")
    if found := re.fullmatch(r"(\d{1,9}(?:\.\d*)?)\s*(m|metres?|meters?|ft|feet)?", said):
        metres = float(found[1]) * (_FOOT_M if found[2] in ("ft", "feet") else 1.0)
    elif found := re.fullmatch(r"(\d{1,9})'(?:\s*(\d{1,9}(?:\.\d*)?)\")?", said):
        metres = (float(found[1]) + float(found[2] or 0.0) / 12.0) * _FOOT_M
    else:
        return None
    return metres if metres < _NO_HEIGHT else None


def hides(tags: Tags) -> bool:
    """Whether a shape blocks the view: a building above the ground, or an opaque barrier."""
    if tags.get("location") == "underground" or _number(tags.get("layer")) < 0.0:
        return False
    building = any(tags.get(name, "no") != "no" for name in ("building", "building:part"))
    return building or tags.get("barrier") in _BARRIERS


def _number(text: str | None) -> float:
    """A plain number; 0 where it is none."""
    return float(text) if text and re.fullmatch(r"-?\d{1,6}(\.\d{0,9})?", text.strip()) else 0.0


def make_site(
    shapes: Iterable[Shape],
    heights_m: Mapping[str, float],
    counts: Counter[str],
    licence: str = "",
    *,
    degrees: bool = True,
) -> SiteMap:
    """The solids of shapes that hide, with what was assumed and left out, counted in `counts`, too.

    `degrees`: whether shapes are in degrees, and so the solids; else both are in metres.
    """
    import shapely

    hiding = [shape for shape in shapes if hides(shape.tags) and not shape.geometry.is_empty]
    if not hiding:
        return SiteMap(degrees=degrees, assumed=_list_counts(counts), licence=licence)
    middle = np.median(shapely.get_coordinates([shape.geometry for shape in hiding]), axis=0)
    scale = _metres_per_degree(float(middle[1])) if degrees else np.ones(2)
    blocks = list[_Block]()
    for shape in hiding:
        geometry = shapely.transform(shape.geometry, lambda places: (places - middle) * scale)
        blocks += _make_blocks(shape._replace(geometry=geometry), heights_m, counts)
    solids = [_make_map_solid(block) for block in _cut_outlines(blocks, counts)]
    site = SiteMap(solids=tuple(solids), degrees=degrees, assumed=_list_counts(counts), licence=licence)
    return site.moved(lambda metres: metres / scale + middle)


def _list_counts(counts: Counter[str]) -> tuple[str, ...]:
    return tuple(f"{number} × {what}" for what, number in counts.items())


def _metres_per_degree(latitude: float) -> Float:
    """East and north, (2,), by the radii of curvature of WGS84."""
    eccentricity2 = _FLATTENING * (2.0 - _FLATTENING)
    latitude = math.radians(max(min(latitude, 89.0), -89.0))
    bent = 1.0 - eccentricity2 * math.sin(latitude) ** 2
    east_m, north_m = _EQUATOR_M / math.sqrt(bent) * math.cos(latitude), _EQUATOR_M * (1 - eccentricity2) / bent**1.5
    return np.array([east_m, north_m]) * (math.pi / 180.0)


def _make_blocks(shape: Shape, heights_m: Mapping[str, float], counts: Counter[str]) -> Iterator[_Block]:
    """The prisms of a shape (m): one for each of its polygons, or for each stretch of a barrier."""
    import shapely

    tags, geometry = shape.tags, shape.geometry
    if building := any(tags.get(name, "no") != "no" for name in ("building", "building:part")):
        kind, role = "building", "part" if tags.get("building:part", "no") != "no" else "outline"
    else:
        kind, role = tags["barrier"], "barrier"
    bottom_m, top_m, on_ground = _find_heights(tags, kind, heights_m, counts)
    if top_m <= bottom_m:
        counts[f"{kind} whose top is not above its bottom: left out"] += 1
        return
    if shapely.get_dimensions(geometry) == 1:
        if building:
            counts["building whose outline stays open: left out"] += 1
            return
        parts = _widen_line(geometry, parse_metres(tags.get("width")) or _BARRIER_WIDTH_M)
    else:
        if not geometry.is_valid:
            counts["invalid area: mended"] += 1
            geometry = shapely.make_valid(geometry, method="structure", keep_collapsed=False)
        parts = list(shapely.get_parts(geometry))
    for part in parts:
        if part.geom_type == "Polygon" and part.area > (_LEAST_M2 if building else 0.0):
            yield _Block(shape.name, kind, part, bottom_m, top_m, on_ground, role)


def _widen_line(line: shapely.Geometry, width_m: float) -> list[shapely.Geometry]:
    """A rectangle for each segment of a line."""
    import shapely

    return [
        shapely.LineString([a, b]).buffer(width_m / 2, cap_style="flat")
        for part in shapely.get_parts(line)
        for a, b in zip(part.coords, part.coords[1:], strict=False)
        if a != b
    ]


def _find_heights(
    tags: Tags, kind: str, heights_m: Mapping[str, float], counts: Counter[str]
) -> tuple[float, float, bool]:
    """Bottom and top (m above the ground), and whether it stands on it; what is assumed is counted."""
    level_m = heights_m["level"]
    top_m = parse_metres(tags.get("height")) or parse_metres(tags.get("building:height"))
    if top_m is None and tags.get("height"):
        counts["height that says no length: not taken"] += 1
    if top_m is None and (levels := _number(tags.get("building:levels", tags.get("levels")))) > 0.0:
        top_m = level_m * (levels + max(_number(tags.get("roof:levels")), 0.0))
        counts[f"height of {kind} by its levels of {level_m:g} m"] += 1
    if top_m is None:
        top_m = heights_m[kind]
        counts[f"height of {kind} not said: {top_m:g} m taken"] += 1
    bottom_m = parse_metres(tags.get("min_height"))
    if bottom_m is None:
        bottom_m = level_m * max(_number(tags.get("building:min_level")), 0.0)
    if tags.get("building") in ("roof", "carport") or tags.get("building:part") == "roof":
        counts[f"roof on posts: {_ROOF_M:g} m thick"] += 1
        bottom_m = max(bottom_m, top_m - _ROOF_M)
    return bottom_m, top_m, bottom_m <= 0.0


def _cut_outlines(blocks: Sequence[_Block], counts: Counter[str]) -> Iterator[_Block]:
    """The blocks; outlines of buildings are cut by their parts (Simple 3D buildings), which say heights better."""
    import shapely

    parts = [block.footprint for block in blocks if block.role == "part"]
    tree = shapely.STRtree(parts)
    for block in blocks:
        parts_inside = (
            [parts[k] for k in tree.query(block.footprint, predicate="intersects")] if block.role == "outline" else []
        )
        remainder = block.footprint.difference(shapely.union_all(parts_inside)) if parts_inside else block.footprint
        if remainder.area > block.footprint.area - 0.5:
            yield block
            continue
        remainder = remainder.buffer(-_SLIVER_M / 2).buffer(_SLIVER_M / 2, join_style="mitre")
        counts["outline of a building with parts: what they leave is taken"] += 1
        for piece in shapely.get_parts(remainder):
            if piece.geom_type == "Polygon" and piece.area > _LEAST_REST_M2:
                yield block._replace(footprint=piece)


def _make_map_solid(block: _Block) -> MapSolid:
    import shapely

    area = shapely.orient_polygons(block.footprint)
    rings = tuple(np.array(ring.coords)[:-1] for ring in (area.exterior, *area.interiors))
    return MapSolid(
        block.name, block.kind, rings, block.bottom_m, block.top_m, above_ground=True, on_ground=block.on_ground
    )
