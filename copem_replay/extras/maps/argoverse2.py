"""Maps of Argoverse 2 sensor logs, `map/log_map_archive_*.json`: lanes, crosswalks and drivable areas in metres."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from copem_replay.core.errors import InputError, quote_value
from copem_replay.core.site_map import Lane, LaneKind, SiteMap, make_area
from copem_replay.core.tracks import Area, Float

_FARTHEST: Final = 1e8
_KIND: Final[dict[str, LaneKind]] = {"VEHICLE": "driving", "BUS": "driving", "BIKE": "bicycle"}


def read_argoverse2_map(path: Path, parts: dict[str, Any], _heights_m: Mapping[str, float]) -> SiteMap:
    """Lanes and areas of a log's map. Raises InputError."""
    lanes = tuple(_read_lane(name, item, path) for name, item in _items(parts, "lane_segments", path))
    crossings, drivable = list[Area](), list[Area]()
    for name, item in _items(parts, "pedestrian_crossings", path):
        edges = [_points(item, edge, f"{path}: pedestrian_crossings {name}") for edge in ("edge1", "edge2")]
        crossings.append(make_area(f"crosswalk {name}", "crosswalk", _hull(np.concatenate(edges)[:, :2])))
    for name, item in _items(parts, "drivable_areas", path):
        ring = _points(item, "area_boundary", f"{path}: drivable_areas {name}")
        drivable.append(make_area(f"drivable {name}", "drivable", ring))
    return SiteMap(lanes, (*crossings, *drivable))


def _read_lane(name: str, item: Mapping[str, Any], path: Path) -> Lane:
    left, right = (
        _points(item, f"{side}_lane_boundary", f"{path}: lane_segments {name}") for side in ("left", "right")
    )
    kind = _KIND.get(str(item.get("lane_type")), "other")
    return Lane(name, kind, left, right, item.get("is_intersection") is True)


def _items(parts: Mapping[str, Any], name: str, path: Path) -> list[tuple[str, dict[str, Any]]]:
    """The entries of a part of the map, by id. Raises InputError."""
    items = parts.get(name, {})
    if not isinstance(items, dict):
        raise InputError(f"{path}: {name}: expected entries by id, found {quote_value(items)}")
    for ident, item in items.items():
        if not isinstance(item, dict):
            raise InputError(f"{path}: {name} {quote_value(ident)}: expected an entry, found {quote_value(item)}")
    return list(items.items())


def _points(item: Mapping[str, Any], name: str, where: str) -> Float:
    """Points (K, 3) of the key `name` of an item, two at least. Raises InputError."""
    points = item.get(name)
    if not isinstance(points, list) or len(points) < 2:
        raise InputError(f"{where}: {name}: expected two points or more, found {quote_value(points)}")
    rows = []
    for point in points:
        values = [point.get(axis, 0.0 if axis == "z" else None) for axis in "xyz"] if isinstance(point, dict) else []
        if len(values) < 3 or not all(_is_near(value) for value in values):
            raise InputError(f"{where}: {name}: expected x, y, z of at most 1e8 m, found {quote_value(point)}")
        rows.append(values)
    return np.array(rows, dtype=np.float64)


def _is_near(value: object) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value) and abs(value) <= _FARTHEST  # type: ignore[arg-type]


def _hull(points: Float) -> Float:
    """The convex hull of the ends of two edges, which may be stored against each other; a line where it has no area."""
    import shapely

    hull = shapely.MultiPoint(points).convex_hull
    return np.array(hull.exterior.coords)[:-1] if hull.geom_type == "Polygon" else points
