"""Maps of OpenDRIVE, Lanelet2 and Argoverse 2: places by hand and by other software, and what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from osi3.osi_groundtruth_pb2 import GroundTruth
from scipy.integrate import quad

from copem_replay.cli.main import main
from copem_replay.core.errors import InputError
from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.experiment.draft.template import describe_survey, format_draft
from copem_replay.extras.maps.opendrive import read_opendrive
from copem_replay.extras.maps.opendrive_geometry import follow_clothoid
from copem_replay.extras.maps.registry import read_map
from copem_replay.io.schemas.osi_lanes import read_road
from copem_replay.io.write.osi import add_road
from tests.helpers.recordings import Obj, Topic, write_recording

SHARED = Path(__file__).parents[3] / "shared/data"
MAPS = SHARED / "maps"
LANE = '<lane id="{id}" type="{type}"><width sOffset="0" a="{a}" b="{b}" c="{c}" d="{d}"/></lane>'


def lane(number: int, a: float = 3, b: float = 0, c: float = 0, d: float = 0, type: str = "driving") -> str:
    return LANE.format(id=number, type=type, a=a, b=b, c=c, d=d)


def road(
    geometry: str = "<line/>", length: float = 100, *, left: str = "", right: str = lane(-1), more: str = "",
    attributes: str = "", heading: float = 0, offset: str = "", before: str = "",
) -> str:  # fmt: skip
    return (
        f'<OpenDRIVE><header/><road id="7" length="{length}" junction="-1" {attributes}><planView>'
        f'<geometry s="0" x="10" y="20" hdg="{heading}" length="{length}">{geometry}</geometry></planView>{before}'
        f'<lanes>{offset}<laneSection s="0"><left>{left}</left><right>{right}</right></laneSection></lanes>{more}'
        "</road></OpenDRIVE>"
    )


def written(tmp_path: Path, text: str, name: str = "map.xodr") -> Path:
    (tmp_path / name).write_text(text)
    return tmp_path / name


def test_right_hand_lane_of_a_straight_road(tmp_path: Path) -> None:
    (found,) = read_map(written(tmp_path, road())).lanes
    assert found.left_m.tolist() == [[10, 20, 0], [110, 20, 0]]
    assert found.right_m.tolist() == [[10, 17, 0], [110, 17, 0]]


@pytest.mark.parametrize(("rule", "number", "left", "right"), [
    ("RHT", 1, [[110, 20], [10, 20]], [[110, 23], [10, 23]]),  # comes towards us, its left border the middle
    ("LHT", -1, [[110, 17], [10, 17]], [[110, 20], [10, 20]]),
    ("LHT", 1, [[10, 23], [110, 23]], [[10, 20], [110, 20]]),
])  # fmt: skip
def test_direction_of_a_lane_goes_by_side_and_rule(
    tmp_path: Path, rule: str, number: int, left: list[list[float]], right: list[list[float]]
) -> None:
    sides = {"left": lane(1), "right": ""} if number > 0 else {"left": "", "right": lane(-1)}
    (found,) = read_map(written(tmp_path, road(attributes=f'rule="{rule}"', **sides))).lanes
    assert found.left_m[:, :2].tolist() == left
    assert found.right_m[:, :2].tolist() == right


def test_chords_of_an_arc_are_within_five_centimetres(tmp_path: Path) -> None:
    text = road('<arc curvature="0.1"/>', 2 * math.pi * 10)  # a whole circle around (10, 30)
    (found,) = read_map(written(tmp_path, text)).lanes
    for line, radius_m in ((found.left_m, 10), (found.right_m, 13)):
        assert np.hypot(line[:, 0] - 10, line[:, 1] - 30) == pytest.approx(radius_m)
        middles = (line[1:] + line[:-1]) / 2
        off_m = radius_m - np.hypot(middles[:, 0] - 10, middles[:, 1] - 30)
        assert 0.01 < off_m.max() < 0.05


@pytest.mark.parametrize(
    "shape",
    [
        '<spiral curvStart="0.05" curvEnd="-0.02"/>',
        '<paramPoly3 aU="0" bU="15" cU="0" dU="0" aV="0" bV="0" cV="2" dV="0" pRange="normalized"/>',
    ],
)
def test_a_piece_without_length_is_a_point(tmp_path: Path, shape: str) -> None:
    """Nothing is divided by its length, which no number would hold; warnings are errors here."""
    text = (
        road(shape, 30.0)
        .replace('length="30.0"><s', 'length="1e-320"><s')
        .replace('length="30.0"><p', 'length="1e-320"><p')
    )
    assert 'length="1e-320"' in text
    read_map(written(tmp_path, text))


@pytest.mark.parametrize(("start", "end"), [(0.0, 0.1), (0.05, -0.05), (-0.02, 0.1), (0.1, 0.1 + 1e-7), (1e-9, 0)])
def test_spiral_against_numerical_integrals(start: float, end: float) -> None:
    length_m, change = 60.0, (end - start) / 60.0

    def heading(s: float) -> float:
        return start * s + change * s * s / 2

    x, y, turn = follow_clothoid(np.array([0.0, 25.0, length_m]), start, change)
    assert turn[-1] == pytest.approx((start + end) / 2 * length_m)
    for k, s in enumerate((0.0, 25.0, length_m)):
        assert x[k] == pytest.approx(quad(lambda q: math.cos(heading(q)), 0, s)[0], abs=1e-5)
        assert y[k] == pytest.approx(quad(lambda q: math.sin(heading(q)), 0, s)[0], abs=1e-5)


@pytest.mark.parametrize("p_range", ["normalized", "arcLength"])
def test_both_ranges_of_a_parametric_cubic(tmp_path: Path, p_range: str) -> None:
    scale = 1.0 if p_range == "arcLength" else 100.0  # u = p·scale: a straight line along the road
    text = road(
        f'<paramPoly3 aU="0" bU="{scale}" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0" pRange="{p_range}"/>',
        heading=math.pi / 2,
    )
    (found,) = read_map(written(tmp_path, text)).lanes
    assert found.left_m[-1] == pytest.approx([10, 120, 0])
    assert found.right_m[0] == pytest.approx([13, 20, 0])


def test_cubic_over_the_way_ahead(tmp_path: Path) -> None:
    text = road('<poly3 a="0" b="0" c="0.01" d="0"/>', 50.0)
    (found,) = read_map(written(tmp_path, text)).lanes
    u, v = (found.left_m - [10, 20, 0]).T[:2]
    assert v == pytest.approx(0.01 * u * u, abs=1e-3)
    assert np.hypot(np.diff(u), np.diff(v)).sum() == pytest.approx(50.0, abs=0.05)  # distance is along the curve


def test_width_that_swings_is_followed(tmp_path: Path) -> None:
    """Width 3 + w(s − 10)(s − 50)(s − 90)/64000·2: on a straight road, so that chords go by the width alone."""
    terms = np.polynomial.polynomial.polyfromroots([10, 50, 90]) / 32_000
    (found,) = read_map(written(tmp_path, road(right=lane(-1, 3 + terms[0], *terms[1:])))).lanes
    s = np.linspace(0, 100, 4001)
    width_m = 3 + (s - 10) * (s - 50) * (s - 90) / 32_000
    assert np.abs(20 - width_m - np.interp(s, found.right_m[:, 0] - 10, found.right_m[:, 1])).max() < 0.051


def test_offset_of_lanes_height_and_tilt(tmp_path: Path) -> None:
    before = (
        '<elevationProfile><elevation s="0" a="5" b="0.1" c="0" d="0"/></elevationProfile>'
        '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>'
    )
    text = road(before=before, offset='<laneOffset s="0" a="1" b="0" c="0" d="0"/>')
    (found,) = read_map(written(tmp_path, text)).lanes
    level_m, up_m = math.cos(0.1), math.sin(0.1)
    assert found.left_m[0] == pytest.approx([10, 20 + level_m, 5 + up_m])
    assert found.right_m[-1] == pytest.approx([110, 20 - 2 * level_m, 15 - 2 * up_m])


def test_borders_in_place_of_widths(tmp_path: Path) -> None:
    border = '<lane id="{}" type="driving"><border sOffset="0" a="{}" b="0" c="0" d="0"/></lane>'
    found = read_map(written(tmp_path, road(right=border.format(-2, -7) + border.format(-1, -3)))).lanes
    assert [(o.left_m[0, 1], o.right_m[0, 1]) for o in found] == [(20, 17), (17, 13)]


def test_lanes_that_nobody_drives(tmp_path: Path) -> None:
    right = lane(-1) + lane(-2, type="biking") + lane(-3, type="sidewalk") + lane(-4, type="curb") + lane(-5, a=0)
    assert [o.kind for o in read_map(written(tmp_path, road(right=right))).lanes] == ["driving", "bicycle", "walking"]


def objects(*texts: str) -> str:
    return f"<objects>{''.join(texts)}</objects>"


def test_outlines_by_road_and_by_object_are_one(tmp_path: Path) -> None:
    """A rectangle 20 … 30 m along, 5 … 9 m to the left of a road that goes north from (10, 20)."""
    on_road = "".join(
        f'<cornerRoad s="{s}" t="{t}" dz="0" height="6"/>' for s, t in ((20, 5), (30, 5), (30, 9), (20, 9))
    )
    local = "".join(f'<cornerLocal u="{u}" v="{v}" z="0" height="6"/>' for u, v in ((-5, -2), (5, -2), (5, 2), (-5, 2)))
    start = '<object id="{}" type="building" s="25" t="7" zOffset="0" hdg="0"><outline>{}</outline></object>'
    text = road(more=objects(start.format(1, on_road), start.format(2, local)), heading=math.pi / 2)
    one, other = read_map(written(tmp_path, text)).solids
    assert one.rings_m[0] == pytest.approx(np.array([[5, 40], [5, 50], [1, 50], [1, 40]]))
    assert other.rings_m[0] == pytest.approx(one.rings_m[0])
    assert (one.bottom_m, one.top_m, one.name) == (0, 6, "road 7 object 1")


def test_shapes_without_outline(tmp_path: Path) -> None:
    at = 's="50" t="10" zOffset="1"'
    text = road(
        more=objects(
            f'<object id="1" type="pole" {at} radius="0.5" height="4"/>',
            f'<object id="2" type="obstacle" {at} length="4" width="2" height="3" hdg="{math.pi / 2}"/>',
            f'<object id="3" type="parkingSpace" {at} length="4" width="2" height="3"/>',
            f'<object id="4" type="obstacle" {at} length="4" width="2" height="0.05"/>',
            f'<object id="5" type="obstacle" {at}/>',
        )
    )
    found = read_map(written(tmp_path, text))
    pole, box = found.solids
    assert shapely.Polygon(pole.rings_m[0]).contains(shapely.Point(60, 30).buffer(0.4999))
    assert (pole.bottom_m, pole.top_m) == (1, 5)
    assert box.rings_m[0] == pytest.approx(np.array([[59, 32], [59, 28], [61, 28], [61, 32]]))
    assert found.assumed == (
        "1 object that is flat: hides nothing", "1 object without a size: left out",
    )  # fmt: skip


def test_repeated_objects(tmp_path: Path) -> None:
    ends = 'tStart="-5" tEnd="-5" heightStart="1" heightEnd="2" widthStart="0.4" widthEnd="0.4"'
    start = '<object id="1" type="barrier" s="0" t="0" length="1" width="1" height="1"><repeat s="10" length="40"'
    copies = read_map(written(tmp_path, road(more=objects(f'{start} distance="10" {ends}/></object>')))).solids
    assert [c.rings_m[0].mean(axis=0).tolist() for c in copies] == [[20 + 10 * k, 15] for k in range(5)]
    assert [c.top_m for c in copies] == [1, 1.25, 1.5, 1.75, 2]
    strip = read_map(written(tmp_path, road(more=objects(f'{start} distance="0" {ends}/></object>')))).solids
    assert shapely.union_all([shapely.Polygon(c.rings_m[0]) for c in strip]).bounds == (20, 14.8, 60, 15.2)


def test_crosswalks_and_junctions_are_areas(tmp_path: Path) -> None:
    walk = '<object id="4" type="crosswalk" s="50" t="0" length="4" width="6" zOffset="0"/>'
    text = road(more=objects(walk)).replace('junction="-1"', 'junction="12"')
    crosswalk, junction = read_map(written(tmp_path, text)).areas
    assert (crosswalk.kind, shapely.Polygon(crosswalk.rings_m[0]).bounds) == ("crosswalk", (58, 17, 62, 23))
    assert (junction.kind, junction.name) == ("junction", "junction 12")
    assert shapely.Polygon(junction.rings_m[0]).area == pytest.approx(300, rel=0.05)


def test_a_lane_that_crosses_itself_often_is_in_no_junction(tmp_path: Path) -> None:
    """A road that goes around forty times: mending its outline would take longer than anybody waits."""
    text = road('<arc curvature="0.5"/>', 500.0).replace('junction="-1"', 'junction="12"')
    found = read_map(written(tmp_path, text))
    assert (len(found.lanes), found.areas) == (1, ())
    assert np.hypot(*(found.lanes[0].left_m[:, :2] - [10, 22]).T) == pytest.approx(2)
    assert len(found.lanes[0].left_m) > 40 * 4  # four chords of a circle of 2 m are .6 m from it
    assert found.assumed == ("1 lane whose outline crosses itself: not in the area of its junction",)


def test_header_says_where_the_map_is(tmp_path: Path) -> None:
    reference, offset = "<![CDATA[ EPSG:25832 ]]>", '<offset x="-1000" y="5" z="0" hdg="0.5"/>'
    header = f"<header><geoReference>{reference}</geoReference>{offset}</header>"
    found = read_map(written(tmp_path, road().replace("<header/>", header)))
    assert (found.proj, found.offset_m, found.yaw_rad) == ("EPSG:25832", (-1000, 5), 0.5)


@pytest.mark.parametrize(("text", "says"), [
    (road('<arc curvature="nan"/>'), r":1: <arc curvature>: expected a number of at most 1e8, found 'nan'"),
    (road('<arc curvature="1e308"/>'), "<arc curvature>: expected a number of at most 1e8, found '1e308'"),
    (road("<circle/>"), "<geometry>: expected one of line, arc, spiral, poly3, paramPoly3, found 'circle'"),
    (road(length=1e8), "road 7: expected at most 25,000 places along a section to follow it, found more"),
    (road(right=lane(-1) * 101), "<right>: expected at most 100 lanes, found 101"),
    (road(right=lane(-1).replace('id="-1"', 'id="x"')), "<lane id>: expected a whole number, found 'x'"),
    (road(more=objects('<object id="9" type="pole" s="0" t="0"><repeat s="0" length="1e6" distance="1e-9"/></object>')),
     "<repeat> of object '9': expected at most 20,000 copies, found length 1e\\+06 m with distance 1e-09 m"),
    (road().replace("<header/>", "<a>" * 300_002 + "</a>" * 300_002), "with at most 300,000 elements, found more"),
    ("<!DOCTYPE a><OpenDRIVE/>", "expected no DOCTYPE"),
    ("\n<OpenDRIVE><road>", ":2: expected XML, found something else or its end"),
    ("nothing", "expected a map of OpenDRIVE, Lanelet2, .*, found none of them"),
])  # fmt: skip
def test_what_is_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_map(written(tmp_path, text))


def test_against_the_boundaries_that_esmini_writes() -> None:
    recording, map_file = SHARED / "pedestrian_esmini.mcap", MAPS / "opendrive/fabriksgatan.xodr"
    if not (recording.is_file() and map_file.is_file()):
        pytest.skip("no recording of esmini here")
    from copem_replay.io.recording import read_log

    points = np.concatenate(read_log(recording, name="a").lane_boundaries)
    lanes = read_opendrive(map_file, chord_m=0.01).lanes
    lines = shapely.MultiLineString([line[:, :2] for lane in lanes for line in (lane.left_m, lane.right_m)])
    assert len(points) > 500
    assert shapely.distance(shapely.points(points[:, :2]), lines).max() <= 0.02


# Lanelet2 and Argoverse 2.


def lanelet(left: list[tuple[float, float]], right: list[tuple[float, float]], *, local: bool = True) -> str:
    def node(number: int, at: tuple[float, float]) -> str:
        tags = f'<tag k="local_x" v="{at[0]}"/><tag k="local_y" v="{at[1]}"/><tag k="ele" v="2"/>'
        return f'<node id="{number}" lat="{48 + at[1] / 1000}" lon="{11 + at[0] / 1000}">{tags if local else ""}</node>'

    nodes = "".join(node(k, at) for k, at in enumerate([*left, *right]))
    ways = "".join(
        f'<way id="{name}">{"".join(f"""<nd ref="{k}"/>""" for k in ids)}</way>'
        for name, ids in (("l", range(len(left))), ("r", range(len(left), len(left) + len(right))))
    )
    tags = '<tag k="type" v="lanelet"/><tag k="subtype" v="road"/>'
    members = '<member type="way" role="left" ref="l"/><member type="way" role="right" ref="r"/>'
    return f'<osm>{nodes}{ways}<relation id="5">{members}{tags}</relation></osm>'


@pytest.mark.parametrize("turned", [(False, False), (False, True), (True, False), (True, True)])
def test_borders_of_a_lanelet_are_turned(tmp_path: Path, turned: tuple[bool, bool]) -> None:
    """However its borders are stored, the left one is on the left of the way eastwards."""
    sides = [[(0.0, y), (10.0, y), (20.0, y)] for y in (3.0, 0.0)]
    left, right = (side[::-1] if turn else side for side, turn in zip(sides, turned, strict=True))
    (found,) = read_map(written(tmp_path, lanelet(left, right), "map.osm")).lanes
    assert (found.left_m.tolist(), found.right_m.tolist()) == tuple([[x, y, 2] for x, y in side] for side in sides)


def test_lanelets_without_local_places_have_degrees(tmp_path: Path) -> None:
    found = read_map(written(tmp_path, lanelet([(0, 3), (9, 3)], [(0, 0), (9, 0)], local=False), "map.osm"))
    assert found.degrees
    assert found.lanes[0].left_m[0, :2] == pytest.approx([11, 48.003])


@pytest.mark.parametrize("local", [True, False])
def test_walls_of_lanelets_hide_and_guard_rails_do_not(tmp_path: Path, local: bool) -> None:
    text = lanelet([(0, 3), (9, 3)], [(0, 0), (9, 0)], local=local)
    rail = '<way id="7"><nd ref="0"/><nd ref="1"/><tag k="type" v="guard_rail"/></way>'
    wall = rail.replace('"7"', '"8"').replace("guard_rail", "wall").replace("</way>", '<tag k="height" v="3 m"/></way>')
    found = read_map(written(tmp_path, text.replace("<relation", f"{rail}{wall}<relation"), "map.osm"))
    (solid,) = found.solids
    assert (solid.name, solid.kind, solid.bottom_m, solid.top_m, solid.on_ground) == ("way/8", "wall", 0.0, 3.0, True)
    west, south, east, north = shapely.Polygon(solid.rings_m[0]).bounds
    if local:
        assert (west, south, east, north) == pytest.approx((0, 2.85, 9, 3.15))
    else:  # a degree of latitude at 48° N has 111.2 km
        assert (west, east) == pytest.approx((11.0, 11.009))
        assert (north - south) * 111_200 == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize(("old", "new", "says"), [
    ('v="3"', 'v="1e308"', "<node> local_y: expected a number of at most 1e\\+08, found '1e308'"),
    ('<nd ref="0"/>', '<nd ref="77"/>', "<nd ref>: expected a node of this file with a place, found '77'"),
    ('lat="48.003"', 'lat="nan"', "<node> lat: expected a number of at most 90, found 'nan'"),
])  # fmt: skip
def test_refused_lanelets(tmp_path: Path, old: str, new: str, says: str) -> None:
    text = lanelet([(0, 3), (9, 3)], [(0, 0), (9, 0)])
    assert old in text
    with pytest.raises(InputError, match=says):
        read_map(written(tmp_path, text.replace(old, new, 1), "map.osm"))


def test_lanelets_of_autoware() -> None:
    if not (path := MAPS / "lanelet2/scenario_simulator_intersection_local_xy.osm").is_file():
        pytest.skip("no map of Autoware here")
    lanes = read_map(path).lanes
    shapes = [shapely.Polygon(lane.outline_m) for lane in lanes]
    widths_m = [s.area / shapely.LineString(o.left_m[:, :2]).length for s, o in zip(shapes, lanes, strict=True)]
    assert len(lanes) == 62
    assert all(shape.is_valid and not shape.exterior.is_ccw for shape in shapes)
    assert np.median(widths_m) == pytest.approx(3.12, abs=0.01)


def city() -> dict[str, dict[str, dict[str, object]]]:
    def points(*at: tuple[float, float]) -> list[dict[str, float]]:
        return [{"x": x, "y": y, "z": 1.0} for x, y in at]

    segment = {"lane_type": "VEHICLE", "is_intersection": True, "left_lane_boundary": points((0, 3), (9, 3)),
               "right_lane_boundary": points((0, 0), (4, 0), (9, 0))}  # fmt: skip
    crossing = {"edge1": points((0, 0), (4, 0)), "edge2": points((4, 2), (0, 2))}
    area = {"area_boundary": points((0, 0), (9, 0), (9, 9))}
    return {"lane_segments": {"1": segment}, "pedestrian_crossings": {"2": crossing}, "drivable_areas": {"3": area}}


def test_map_of_argoverse(tmp_path: Path) -> None:
    found = read_map(written(tmp_path, json.dumps(city()), "map.json"))
    (lane,) = found.lanes
    assert (lane.kind, lane.junction, lane.left_m.tolist()) == ("driving", True, [[0, 3, 1], [9, 3, 1]])
    assert [(a.name, a.kind, shapely.Polygon(a.rings_m[0]).area) for a in found.areas] == [
        ("crosswalk 2", "crosswalk", 8.0), ("drivable 3", "drivable", 40.5),
    ]  # fmt: skip


@pytest.mark.parametrize(("text", "says"), [
    ("[" * 200_000, "nested without end"),
    ('{"a":' * 200_000, "nested without end"),
    (json.dumps(city()).replace("3.0", "NaN", 1).replace('"x": 0', '"x": NaN', 1), "NaN is no number of JSON"),
    (json.dumps(city()).replace('"x": 0', '"x": 1e308', 1), "expected x, y, z of at most 1e8 m, found"),
    ('{"lane_segments": {"1": 5}}', "lane_segments '1': expected an entry, found 5"),
    ('{"lane_segments": 5}', "lane_segments: expected entries by id, found 5"),
    ('{"lane_segments": {"1": {"left_lane_boundary": []}}}', "left_lane_boundary: expected two points or more"),
])  # fmt: skip
def test_refused_maps_of_argoverse(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_map(written(tmp_path, text, "map.json"))


def test_a_map_of_argoverse_comes_back_from_osi() -> None:
    """As `convert argoverse2` writes it: every lane with its borders, bit for bit, and every crosswalk to µm."""
    found = sorted((MAPS / "av2").glob("log_map_archive_*.json"))
    if not found:
        pytest.skip("no map of Argoverse 2 here")
    site, osi = read_map(found[0]), GroundTruth()
    add_road(osi, (), site)
    road = read_road(GroundTruth.FromString(osi.SerializeToString()))
    assert len(road.lanes) == len(site.lanes) == 150
    for lane, written in zip(road.lanes, site.lanes, strict=True):
        assert (lane.id, lane.kind) == (written.id, written.kind)
        np.testing.assert_array_equal(lane.left_m, written.left_m)
        np.testing.assert_array_equal(lane.right_m, written.right_m)
    crosswalks = [area for area in site.areas if area.kind == "crosswalk"]
    assert [area.name for area in road.crosswalks] == [area.name for area in crosswalks]
    for area, as_written in zip(road.crosswalks, crosswalks, strict=True):
        np.testing.assert_allclose(area.rings_m[0], as_written.rings_m[0], atol=1e-6)


# ------------------------------------------------------------------------------------------------ in a recording


def map_topic(text: str) -> Topic:
    """As omega-prime writes a map: a message of its own package, which OSI does not have."""
    file = FileDescriptorProto(name="osi_mapasamopendrive.proto", package="osi3")
    message = file.message_type.add(name="MapAsamOpenDrive")
    for number, name in enumerate(("map_reference", "open_drive_xml_content"), 1):
        message.field.add(name=name, number=number, label=1, type=9)  # optional, string
    content = text.encode()
    length = bytes([len(content) & 0x7F | 0x80, len(content) >> 7])  # a varint of two bytes
    payload = b"\x0a\x04town" + b"\x12" + length + content
    definition = FileDescriptorSet(file=[file]).SerializeToString()
    return Topic("ground_truth_map", "osi3.MapAsamOpenDrive", [(0, payload)], definition=("protobuf", definition))


def drive(path: Path, text: str, y: float = 18.5) -> Path:
    """A car along the lane of `road()`, whose middle is at 18.5 m, at `y`, with the ego beside the road."""
    frames = [(k / 20, [Obj(id=1, x=60.0, y=40.0), Obj(id=2, x=12.0 + k / 2, y=y, vx=10.0)]) for k in range(150)]
    return write_recording(path, frames, host=1, more=[map_topic(text)])


def test_a_map_in_a_recording_is_that_of_a_file(tmp_path: Path) -> None:
    text = road()
    (found,) = read_map(drive(tmp_path / "drive.mcap", text)).lanes
    (of_file,) = read_map(written(tmp_path, text)).lanes
    assert found.left_m.tolist() == of_file.left_m.tolist() == [[10, 20, 0], [110, 20, 0]]


def test_a_draft_uses_the_map_in_its_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    drive(Path("drive.mcap"), road())
    survey = survey_recording("drive.mcap")
    assert [(t.topic, t.role) for t in survey.topics] == [("truth", "truth"), ("ground_truth_map", "map")]
    assert survey.truth[0].notes == []
    assert any("a map, for `maps: [{file: …, frame: same}]`" in line for line in describe_survey(survey))
    draft = format_draft(survey)
    assert "\nmaps: [{file: drive.mcap, frame: same}]   # the map in the recording\n" in draft
    Path("experiment.yaml").write_text(draft)
    monkeypatch.setattr("sys.argv", ["copem-replay", "check", "experiment.yaml"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert "drive.mcap: agreement with the traffic 1.00" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "y", "why"),
    [
        (road(), 60.0, "drive.mcap: expected at least"),  # nobody drives on it
        ("<OpenDRIVE><header/>", 18.5, "expected XML, found something else or its end"),
    ],
)
def test_a_map_that_cannot_be_used_is_behind_a_sign(tmp_path: Path, text: str, y: float, why: str) -> None:
    draft = format_draft(survey_recording(drive(tmp_path / "drive.mcap", text, y)))
    (line,) = (line for line in draft.splitlines() if "maps:" in line and "frame: same" in line)
    assert line.startswith("# maps: ")
    assert why in line


@pytest.mark.parametrize(
    ("definition", "why"),
    [
        (None, "the map in it cannot be read: "),
        (map_topic("").definition, "expected XML, found something else or its end"),
    ],
)
def test_a_message_that_is_no_map_is_one_line(tmp_path: Path, definition: tuple[str, bytes] | None, why: str) -> None:
    broken = Topic("map", "osi3.MapAsamOpenDrive", [(0, b"\xff\xff")], definition=definition)
    path = write_recording(tmp_path / "drive.mcap", [(0.0, [Obj()])], more=[broken])
    with pytest.raises(InputError) as error:
        read_map(path)
    assert why in str(error.value)
    assert format_draft(survey_recording(path)).count("\n# maps: [{file: ") == 1


def test_a_recording_without_a_map_is_none(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "drive.mcap", [(0.0, [Obj()])])
    with pytest.raises(InputError, match=r"expected a map in the recording \(osi3.MapAsamOpenDrive\), found none"):
        read_map(path)
