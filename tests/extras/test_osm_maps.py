"""Maps of OpenStreetMap, Overpass and GeoJSON: areas by hand and by osm2geojson, heights, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from copem_replay.core.errors import InputError
from copem_replay.core.site_map import MapSolid, SiteMap
from copem_replay.extras.maps.osm import ATTRIBUTION
from copem_replay.extras.maps.registry import read_map
from copem_replay.extras.maps.solids import parse_metres

MAPS = Path(__file__).parents[3] / "shared/data/maps"
METRE = 1 / 111_319.49079327358  # degrees along the equator of WGS84 (2π · 6 378 137 m / 360°)
NORTH = 1 / 110_574.2758215944  # and along a meridian there
CORNERS = [(0, 0), (10, 0), (10, 10), (0, 10)]


def at(x: float, y: float) -> str:
    return f'lat="{y * NORTH!r}" lon="{x * METRE!r}"'


def osm(
    *rings: list[tuple[float, float]], tags: str = 'k="building" v="yes"', more: str = "", closed: bool = True
) -> str:
    """Ways 1, 2, … through these corners (m), the tags on the first."""
    nodes = "".join(
        f'<node id="{w}{k:02}" {at(*corner)}/>'
        for w, ring in enumerate(rings, start=1)
        for k, corner in enumerate(ring)
    )
    ways = ""
    for w, ring in enumerate(rings, start=1):
        refs = [f"{w}{k:02}" for k in range(len(ring))]
        said = "".join(f"<tag {tag}/>" for tag in tags.split(";")) if w == 1 and tags else ""
        ways += f'<way id="{w}">{"".join(f"<nd ref={ref!r}/>" for ref in [*refs, *refs[:closed]])}{said}</way>'
    return f'<osm version="0.6">{nodes}{ways}{more}</osm>'


def read(folder: Path, text: str | dict[str, Any], **heights_m: float) -> SiteMap:
    (folder / "site").write_text(text if isinstance(text, str) else json.dumps(text))
    defaults = {"building": 8.0, "wall": 2.0, "hedge": 1.5, "retaining_wall": 2.0, "city_wall": 5.0, "level": 3.0}
    return read_map(folder / "site", defaults | heights_m)


def outline(solid: MapSolid) -> shapely.Polygon:
    """In metres near 0° N 0° E."""
    rings = [ring / (METRE, NORTH) for ring in solid.rings_m]
    return shapely.Polygon(rings[0], rings[1:])


def test_a_closed_way_is_a_building(tmp_path: Path) -> None:
    site = read(tmp_path, osm(CORNERS))
    (solid,) = site.solids
    assert site.degrees
    assert (solid.name, solid.kind, solid.bottom_m, solid.top_m) == ("way/1", "building", 0, 8)
    assert outline(solid).normalize().equals_exact(shapely.box(0, 0, 10, 10).normalize(), 1e-6)
    assert site.assumed == ("1 × height of building not said: 8 m taken",)


@pytest.mark.parametrize(("tags", "bottom_m", "top_m"), [
    ('k="building" v="yes";k="height" v="12,5 m"', 0, 12.5),
    ('k="building" v="yes";k="height" v="tall"', 0, 9),
    ('k="building" v="yes";k="building:height" v="40 ft"', 0, 12.192),
    ('k="building" v="yes";k="building:levels" v="2";k="roof:levels" v="1"', 0, 12),
    ('k="building" v="yes";k="building:levels" v="4";k="building:min_level" v="2"', 8, 16),
    ('k="building" v="yes";k="height" v="10";k="min_height" v="3"', 3, 10),
    ('k="building" v="carport";k="height" v="3"', 2.5, 3),
    ('k="building:part" v="roof";k="height" v="5"', 4.5, 5),
])  # fmt: skip
def test_heights(tmp_path: Path, tags: str, bottom_m: float, top_m: float) -> None:
    (solid,) = read(tmp_path, osm(CORNERS, tags=tags), building=9, level=4).solids
    assert (solid.bottom_m, solid.top_m, solid.on_ground) == (bottom_m, pytest.approx(top_m), bottom_m == 0)


@pytest.mark.parametrize("tags", [
    'k="building" v="no"', 'k="building" v="yes";k="location" v="underground"', 'k="building" v="yes";k="layer" v="-1"',
    'k="barrier" v="fence"', 'k="building" v="yes";k="height" v="3";k="min_height" v="3"', "",
])  # fmt: skip
def test_what_does_not_hide(tmp_path: Path, tags: str) -> None:
    assert read(tmp_path, osm(CORNERS, tags=tags)).solids == ()


@pytest.mark.parametrize(("text", "metres"), [
    ("12", 12), ("12'6\"", 3.81), ("6'", 1.8288), ("10 feet", 3.048), ("-3", None), ("1e5", None), ("NaN", None),
    (None, None),
])  # fmt: skip
def test_lengths(text: str | None, metres: float | None) -> None:
    assert parse_metres(text) == (None if metres is None else pytest.approx(metres))


def test_a_wall_is_a_rectangle_for_each_segment(tmp_path: Path) -> None:
    tags = 'k="barrier" v="hedge";k="width" v="1"'
    first, second = read(tmp_path, osm([(0, 0), (10, 0), (10, 5)], tags=tags, closed=False)).solids
    assert (first.kind, first.top_m) == ("hedge", 1.5)
    assert outline(first).normalize().equals_exact(shapely.box(0, -0.5, 10, 0.5).normalize(), 1e-4)
    assert outline(second).normalize().equals_exact(shapely.box(9.5, 0, 10.5, 5).normalize(), 1e-4)


MULTIPOLYGON = (
    '<relation id="9"><member type="way" ref="1" role="outer"/><member type="way" ref="2" role="outer"/>'
    '<member type="way" ref="3" role="inner"/>{more}<tag k="type" v="multipolygon"/>'
    '<tag k="building" v="yes"/></relation>'
)


def test_rings_are_joined_and_inner_ones_are_holes(tmp_path: Path) -> None:
    ring = [(2, 2), (4, 2), (4, 4), (2, 4), (2, 2)]
    text = osm([(0, 0), (10, 0), (10, 10)], [(10, 10), (0, 10), (0, 0)], ring, tags="", closed=False,
               more=MULTIPOLYGON.format(more='<member type="way" ref="77" role="outer"/>'))  # fmt: skip
    site = read(tmp_path, text)
    (solid,) = site.solids
    assert outline(solid).area == pytest.approx(96)
    assert len(solid.rings_m) == 2
    assert "1 × member of a multipolygon that is not in the file: left out" in site.assumed


def test_a_ring_that_stays_open_is_left_out(tmp_path: Path) -> None:
    text = osm(
        [(0, 0), (10, 0), (10, 10)], [(10, 10), (0, 10)], tags="", closed=False, more=MULTIPOLYGON.format(more="")
    )
    site = read(tmp_path, text)
    assert site.solids == ()
    assert "1 × ring of a multipolygon that stays open: left out" in site.assumed


def test_an_outline_keeps_what_its_parts_leave(tmp_path: Path) -> None:
    part = osm([(6, 0), (10, 0), (10, 10), (6, 10)], tags='k="building:part" v="yes";k="height" v="20"')
    part = part.removeprefix('<osm version="0.6">').removesuffix("</osm>")
    part = part.replace('id="1', 'id="5').replace("ref='1", "ref='5")
    first, second = read(tmp_path, osm(CORNERS, tags='k="building" v="yes";k="height" v="5"', more=part)).solids
    assert {(round(outline(s).area, 3), s.top_m) for s in (first, second)} == {(60, 5), (40, 20)}


def test_an_invalid_area_is_mended(tmp_path: Path) -> None:
    site = read(tmp_path, osm([(0, 0), (10, 10), (10, 0), (0, 10)]))
    assert sum(outline(s).area for s in site.solids) == pytest.approx(50)
    assert "1 × invalid area: mended" in site.assumed


def test_deleted_elements_are_not_read(tmp_path: Path) -> None:
    assert read(tmp_path, osm(CORNERS).replace('<way id="1"', '<way action="delete" id="1"')).solids == ()


def geometry(*corners: tuple[float, float]) -> list[dict[str, float]]:
    return [{"lat": y * NORTH, "lon": x * METRE} for x, y in [*corners, corners[0]]]


def test_overpass_with_and_without_nodes(tmp_path: Path) -> None:
    tags = {"building": "yes", "height": 6}
    nodes = [{"type": "node", "id": k, **place} for k, place in enumerate(geometry(*CORNERS)[:4])]
    plain = read(tmp_path, {"elements": [*nodes, {"type": "way", "id": 1, "nodes": [0, 1, 2, 3, 0], "tags": tags}]})
    geom = read(tmp_path, {"elements": [{"type": "way", "id": 1, "geometry": geometry(*CORNERS), "tags": tags}]})
    member = {"type": "way", "ref": 4, "role": "outer", "geometry": geometry(*CORNERS)}
    relation = {"type": "relation", "id": 1, "tags": {"type": "multipolygon", **tags}, "members": [member]}
    of_members = read(tmp_path, {"elements": [relation]})
    for site in (plain, geom, of_members):
        assert [(outline(s).area, s.top_m) for s in site.solids] == [(pytest.approx(100), 6)]


def test_coordinates_in_members_of_xml(tmp_path: Path) -> None:
    nodes = "".join(f"<nd {at(*corner)}/>" for corner in [*CORNERS, CORNERS[0]])
    text = (
        f'<osm><relation id="3"><member type="way" ref="1" role="outer">{nodes}</member>'
        '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/></relation></osm>'
    )
    assert [outline(s).area for s in read(tmp_path, text).solids] == [pytest.approx(100)]


def feature(kind: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def test_geojson(tmp_path: Path) -> None:
    ring = [[x * METRE, y * NORTH] for x, y in [*CORNERS, CORNERS[0]]]
    hole = [[x * METRE, y * NORTH, 3.0] for x, y in [(2, 2), (4, 2), (4, 4), (2, 2)]]
    site = read(tmp_path, {"type": "FeatureCollection", "features": [
        feature("Polygon", [ring, hole], building="yes", height=7.5),
        feature("MultiPolygon", [[ring]], building=True, levels=2),
        feature("LineString", ring[:2], barrier="wall"),
        feature("Point", [0, 0], building="yes"),
    ]})  # fmt: skip
    assert [(round(outline(s).area, 3), s.kind, s.top_m) for s in site.solids] == [
        (98, "building", 7.5), (100, "building", 6), (3, "wall", 2),
    ]  # fmt: skip


@pytest.mark.parametrize(("content", "says"), [
    ('<osm><way id="1"><nd ref="1"/></way></osm>', "expected nodes with places, found none; export with"),
    ('<osm>\n<node id="1" lat="91" lon="0"/></osm>', ":2: <node>: expected a longitude of ±180 and a latitude of ±90"),
    ('<osm>\n<node id="1" lat="nan" lon="0"/></osm>', ":2: <node>: expected a longitude"),
    ('<osm>\n<node id="1" lat="1e308" lon="0"/></osm>', ":2: <node>: expected a longitude"),
    ('<!DOCTYPE osm [<!ENTITY a "b">]><osm/>', "expected no DOCTYPE"),
    ("<osm><node", "expected XML, found something else or its end"),
    ('{"elements": 3}', "elements: expected a list, found"),
    ('{"elements": [3]}', r"elements\[0\]: expected an element"),
    ('{"elements": [{"type": "way", "geometry": 7}]}', r"elements\[0\]: geometry: expected places"),
    ('{"elements": [{"type": "node", "id": 1, "lat": "x", "lon": 0}]}', r"elements\[0\]: expected a longitude"),
    ('{"type": "FeatureCollection", "features": {}}', "features: expected a list"),
    ('{"type": "FeatureCollection", "crs": {"name": "EPSG:25832"}, "features": []}', "crs: expected degrees of WGS84"),
    ('{"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]}}', "expected 4 positions"),
    ('{"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [[[691000, 0]]]}}', "found 691000, 0"),
    ('{"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [[[0]]]}}', "expected longitude, latitude"),
    ("[" * 100_000, "nested without end"),
    ('{"a": NaN}', "NaN is no number of JSON"),
    ("\0\0\0\x0d\n\x09OSMHeader\x18", "found PBF; cut it: `osmium extract"),
])  # fmt: skip
def test_maps_that_are_refused(tmp_path: Path, content: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read(tmp_path, content)


def need(name: str) -> Path:
    if not (MAPS / name).exists():
        pytest.skip(f"{MAPS / name}: not there")
    return MAPS / name


def test_where_the_data_are_from_is_said() -> None:
    assert read_map(need("osm/neukolln.osm")).licence == ATTRIBUTION
    assert read_map(need("osm/osm2world_mp_two_outer_roof.osm")).licence == ""  # drawn by hand


def union(site: SiteMap, middle: np.ndarray) -> shapely.Geometry:
    scale = np.array([np.cos(np.radians(middle[1])) / METRE, 1 / NORTH])
    near = site.moved(lambda degrees: (degrees - middle) * scale)
    return shapely.union_all([shapely.Polygon(s.rings_m[0], s.rings_m[1:]) for s in near.solids])


def test_json_and_geojson_of_one_place_are_one(tmp_path: Path) -> None:
    overpass, geojson = read_map(need("overpass/map.json")), read_map(need("overpass/map.geojson"))
    middle = overpass.solids[0].rings_m[0].mean(axis=0)
    one, other = union(overpass, middle), union(geojson, middle)
    assert one.symmetric_difference(other).area <= 1e-3 * one.area


@pytest.mark.parametrize("name", ["neukolln", "quad_intersection"])
def test_areas_are_those_of_osm2geojson(name: str) -> None:
    """Without walls, which it leaves lines. It drops ways with tags of their own that are members of multipolygons."""
    import osm2geojson  # with requests, which the other tests do without

    path = need(f"osm/{name}.osm")
    site = read_map(path)
    middle = site.solids[0].rings_m[0].mean(axis=0)
    scale = np.array([np.cos(np.radians(middle[1])) / METRE, 1 / NORTH])
    theirs = []
    for feature in osm2geojson.xml2geojson(path.read_text(encoding="utf8"), log_level="ERROR")["features"]:
        tags, shape = feature["properties"].get("tags", {}), shapely.from_geojson(json.dumps(feature["geometry"]))
        above = tags.get("location") != "underground" and not tags.get("layer", "0").startswith("-")
        if (
            above
            and "Polygon" in shape.geom_type
            and {tags.get("building", "no"), tags.get("building:part", "no")} != {"no"}
        ):
            theirs.append(shapely.make_valid(shapely.transform(shape, lambda degrees: (degrees - middle) * scale)))
    of_them = shapely.union_all(theirs)
    houses = SiteMap(solids=tuple(s for s in site.solids if s.kind == "building"))
    assert union(houses, middle).symmetric_difference(of_them).area <= 1e-3 * of_them.area
