"""GeoJSON (RFC 7946): polygons of buildings, lines of barriers, with the words of OpenStreetMap as properties."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from copem_replay.core.errors import InputError, quote_value
from copem_replay.core.site_map import SiteMap
from copem_replay.extras.maps.solids import Place, Shape, Tags, check_place, make_site, tag_text

if TYPE_CHECKING:
    import shapely

_DEPTH = {"LineString": 1, "MultiLineString": 2, "Polygon": 2, "MultiPolygon": 3}
"""How many lists are around a position."""


def read_geojson(path: Path, content: dict[str, Any], heights_m: Mapping[str, float]) -> SiteMap:
    """Solids of features, in degrees. Raises InputError with the feature."""
    if (named := content.get("crs")) is not None and "CRS84" not in str(named):
        raise InputError(
            f"{path}: crs: expected degrees of WGS84 (RFC 7946), found {quote_value(named)}; convert it, for example "
            "with `ogr2ogr -t_srs EPSG:4326`"
        )
    features = content.get("features") if content["type"] == "FeatureCollection" else [content]
    if not isinstance(features, list):
        raise InputError(f"{path}: features: expected a list, found {quote_value(features)}")
    counts = Counter[str]()
    shapes = [shape for k, each in enumerate(features) for shape in _find_shapes(each, f"{path}: features[{k}]", k)]
    return make_site(shapes, heights_m, counts, _find_licence(content))


def _find_licence(content: dict[str, Any]) -> str:
    """What members beside the features say: Overpass turbo and others write `copyright` or `licence`."""
    names = ("copyright", "attribution", "licence", "license")
    return next((" ".join(str(content[name]).split())[:200] for name in names if content.get(name)), "")


def _find_shapes(feature: object, where: str, k: int) -> Iterator[Shape]:
    """The shape of feature number k; none where it has no lines or areas. Raises InputError."""
    if not isinstance(feature, dict):
        raise InputError(f"{where}: expected a feature, found {quote_value(feature)}")
    geometry, tags = feature.get("geometry"), _find_tags(feature, where)
    if not isinstance(geometry, dict) or str(geometry.get("type")) not in _DEPTH:
        return
    depth = _DEPTH[geometry["type"]]
    lists = _check_positions(geometry.get("coordinates"), depth, where)
    is_line = geometry["type"].endswith("LineString")
    shape_geometry = _make_geometry(lists if geometry["type"].startswith("Multi") else [lists], is_line, where)
    yield Shape(str(feature.get("id", tags.get("@id", f"feature {k}"))), shape_geometry, tags)


def _find_tags(feature: dict[str, Any], where: str) -> Tags:
    """Properties as tags; those of a `tags` among them, as osm2geojson writes them, too."""
    properties = feature.get("properties") or {}
    if not isinstance(properties, dict):
        raise InputError(f"{where}: properties: expected words by name, found {quote_value(properties)}")
    nested = properties.get("tags")
    tags = {str(name): tag_text(value) for name, value in properties.items() if not isinstance(value, dict | list)}
    if isinstance(nested, dict):
        tags |= {str(name): tag_text(value) for name, value in nested.items()}
    return tags


def _check_positions(value: Any, depth: int, where: str) -> Any:
    """Positions (longitude, latitude) in as many lists as are asked for. Raises InputError."""
    if not isinstance(value, list) or not value:
        raise InputError(f"{where}: coordinates: expected a list, found {quote_value(value)}")
    if depth == 0:
        if len(value) < 2:
            raise InputError(f"{where}: coordinates: expected longitude, latitude, found {quote_value(value)}")
        return check_place(value[0], value[1], where)
    return [_check_positions(item, depth - 1, where) for item in value]


def _make_geometry(lists: Any, is_line: bool, where: str) -> shapely.Geometry:
    """Lines, or polygons with their holes. Raises InputError: a ring of fewer than four positions."""
    import shapely

    least, rings = (2, lists) if is_line else (4, [ring for polygon in lists for ring in polygon])
    short: list[Place] | None = next((ring for ring in rings if len(ring) < least), None)
    if short is not None:
        raise InputError(f"{where}: coordinates: expected {least} positions or more, found {len(short)}")
    if is_line:
        return shapely.MultiLineString(lists)
    return shapely.MultiPolygon([(polygon[0], polygon[1:]) for polygon in lists])
