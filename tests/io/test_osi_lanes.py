"""Roads in ASAM OSI: lanes by their borders, logical lanes, crosswalks; by hand, and of esmini against its map."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_logicallane_pb2 import LogicalLane

from copem_replay.core.site_map import Lane
from copem_replay.extras.maps.opendrive import read_opendrive
from copem_replay.io.recording import read_log
from copem_replay.io.schemas.osi_lanes import OsiRoad, read_road
from copem_replay.metrics.agreement import find_agreement
from tests.helpers.recordings import SHARED
from tests.helpers.roads import Of, Points, add_boundary, add_lane, add_marking, two_lanes


def borders(lane: Lane) -> list[list[list[float]]]:
    return [line[:, :2].tolist() for line in (lane.left_m, lane.right_m)]


def test_lanes_have_their_borders_in_the_direction_in_which_they_are_driven() -> None:
    road = read_road(two_lanes())
    with_it, against_it = road.lanes
    assert (with_it.id, with_it.kind, against_it.id) == ("8", "driving", "9")
    assert borders(with_it) == [[[0, 0], [100, 0]], [[0, -4], [100, -4]]]
    assert borders(against_it) == [[[100, 0], [0, 0]], [[100, 4], [0, 4]]]  # the middle of the street is on the left
    assert (with_it.left_m[:, 2] == 0.5).all()
    assert (len(road.lines), road.notes) == (3, [])


@pytest.mark.parametrize(("of", "kind"), [
    ({"subtype": Of.SUBTYPE_NORMAL}, "driving"),
    ({"subtype": Of.SUBTYPE_ONRAMP}, "driving"),
    ({"subtype": Of.SUBTYPE_BIKING}, "bicycle"),
    ({"type": Of.TYPE_NONDRIVING, "subtype": Of.SUBTYPE_SIDEWALK}, "walking"),
    ({"type": Of.TYPE_NONDRIVING, "subtype": Of.SUBTYPE_PARKING}, "parking"),
    ({"type": Of.TYPE_NONDRIVING, "subtype": Of.SUBTYPE_BORDER}, "other"),
    ({"type": Of.TYPE_NONDRIVING}, "other"),
    ({"type": Of.TYPE_NONDRIVING, "subtype": Of.SUBTYPE_NORMAL}, "other"),
    ({}, "driving"),  # before OSI 3.3 lanes have no subtype
])  # fmt: skip
def test_kinds_of_lanes(of: dict[str, int], kind: str) -> None:
    truth = two_lanes()
    add_lane(truth, 7, [1], [2], **of)
    assert read_road(truth).lanes[-1].kind == kind


def test_parts_of_a_border_are_joined_along_the_centre_line() -> None:
    """The parts are listed against the lane; 5 is the second line of a double one and no part of the border."""
    truth = two_lanes()
    add_boundary(truth, 4, [(60.0, -4.0), (100.0, -4.5)])
    add_boundary(truth, 5, [(0.0, -4.2), (60.0, -4.2)])
    add_boundary(truth, 6, [(0.0, -4.0), (60.0, -4.0)])
    add_lane(truth, 10, [2], [4, 6, 5], [(0, -2), (100, -2)], centerline_is_driving_direction=True)
    assert borders(read_road(truth).lanes[-1])[1] == [[0, -4], [60, -4], [100, -4.5]]


@pytest.mark.parametrize("centre", [[], [(0, 1e308), (1, 1)], [(0, 0), (5e-324, 0)], [(math.nan, 0), (1, 0)]])
def test_parts_without_a_centre_line_are_joined_as_they_are_listed(centre: Points) -> None:
    truth = two_lanes()
    add_boundary(truth, 4, [(60.0, -4.0), (100.0, -4.5)])
    add_lane(truth, 10, [2], [4, 3], centre, centerline_is_driving_direction=True)
    assert borders(read_road(truth).lanes[-1])[1] == [[60, -4], [100, -4.5], [0, -4], [100, -4]]


def test_lanes_without_borders_are_left_out_and_said() -> None:
    """Intersections have none by the standard, and are no lanes that lack them."""
    truth = two_lanes()
    add_boundary(truth, 4, [(0.0, 9.0), (math.nan, 9.0), (1e9, 9.0)])
    add_lane(truth, 10, [4], [2])
    add_lane(truth, 11, [77], [2])
    add_lane(truth, 12, [], [], type=Of.TYPE_INTERSECTION)
    add_boundary(truth, 5, [(7.0, 9.0), (7.0, 9.0)])
    add_lane(truth, 13, [5], [2])
    road = read_road(truth)
    assert [lane.id for lane in road.lanes] == ["8", "9"]
    assert road.notes == [
        "2 points of borders of lanes with a number that is none: left out",
        "3 lanes without a left and a right border: left out",
    ]
    assert not OsiRoad()
    assert OsiRoad(notes=road.notes)


def logical(truth: GroundTruth, ident: int, left: Sequence[int], right: Sequence[int], **of: float) -> None:
    lane = truth.logical_lane.add()
    lane.id.value = ident
    for name, value in {"type": LogicalLane.TYPE_NORMAL, "start_s": 0.0, "end_s": 50.0, **of}.items():
        setattr(lane, name, value)
    for ids, places in ((left, lane.left_boundary_id), (right, lane.right_boundary_id)):
        for each in ids:
            places.add().value = each


def logical_street() -> GroundTruth:
    """Borders 21, 22 on the left, which share a point and go on to 80 m, 23 on the right; 23 has a physical one."""
    truth = two_lanes()
    for ident, points in (
        (21, [(0, 3, 0), (20, 3, 20)]),
        (22, [(20, 3, 20), (80, 9, 80)]),
        (23, [(0, 0, 0), (80, 0, 80)]),
    ):
        boundary = truth.logical_lane_boundary.add()
        boundary.id.value = ident
        for x, y, s in points:
            point = boundary.boundary_line.add(s_position=s)
            point.position.x, point.position.y, point.position.z = x, y, 0.0
    truth.logical_lane_boundary[2].physical_boundary_id.add().value = 2
    return truth


def test_logical_lanes_come_before_physical_ones() -> None:
    truth = logical_street()
    logical(truth, 30, [21, 22], [23], move_direction=LogicalLane.MOVE_DIRECTION_INCREASING_S)
    logical(
        truth,
        31,
        [21],
        [23],
        move_direction=LogicalLane.MOVE_DIRECTION_DECREASING_S,
        end_s=20,
        type=LogicalLane.TYPE_BIKING,
    )
    logical(truth, 32, [21], [23], move_direction=LogicalLane.MOVE_DIRECTION_BOTH_ALLOWED, end_s=20)
    logical(truth, 33, [], [23])
    road = read_road(truth)
    assert [(lane.id, lane.kind) for lane in road.lanes] == [
        ("30", "driving"), ("31", "bicycle"), ("32", "driving"), ("32", "driving")
    ]  # fmt: skip
    assert borders(road.lanes[0]) == [[[0, 3], [20, 3], [50, 6]], [[0, 0], [50, 0]]]  # the border is at 6 m half-way
    assert borders(road.lanes[1]) == [[[20, 0], [0, 0]], [[20, 3], [0, 3]]]
    assert borders(road.lanes[2]) == borders(road.lanes[3].turned())
    assert len(road.lines) == 5  # three physical, and two logical that no physical one stands for
    assert road.notes == ["1 lane without a left and a right border: left out"]


def test_borders_without_places_along_a_reference_line_are_taken_whole() -> None:
    truth = logical_street()
    for boundary in truth.logical_lane_boundary:
        for point in boundary.boundary_line:
            point.ClearField("s_position")
    logical(truth, 30, [21, 22], [23], move_direction=LogicalLane.MOVE_DIRECTION_INCREASING_S)
    assert borders(read_road(truth).lanes[0])[0] == [[0, 3], [20, 3], [80, 9]]


# Crosswalks.


def corners(truth: GroundTruth) -> set[tuple[float, float]]:
    (area,) = read_road(truth).crosswalks
    assert (area.name, area.kind, len(area.rings_m)) == ("crosswalk 40", "crosswalk", 1)
    return {(round(x, 5), round(y, 5)) for x, y in area.rings_m[0]}


LEVEL = {(28.0, 1.0), (32.0, 1.0), (32.0, 9.0), (28.0, 9.0)}


def test_a_crosswalk_is_an_area_and_drawn() -> None:
    truth = add_marking(GroundTruth())
    assert corners(truth) == LEVEL
    (line,) = read_road(truth).lines
    assert (len(line), line[0].tolist()) == (5, line[-1].tolist())
    assert (line[:, 2] == 0.25).all()
    truth.road_marking[0].base.orientation.yaw = math.pi / 2
    assert corners(truth) == {(26.0, 3.0), (34.0, 3.0), (34.0, 7.0), (26.0, 7.0)}


def test_a_crosswalk_in_the_frame_that_osi_has_for_markings() -> None:
    """x is up, and z along the street: a pitch of −90° turns x to z and z to −x. The box is 8 m wide and 4 m "high"."""
    truth = add_marking(GroundTruth())
    base = truth.road_marking[0].base
    base.orientation.pitch = -math.pi / 2
    base.dimension.length, base.dimension.height = 0.01, 4.0
    assert corners(truth) == LEVEL
    for x, y in ((-1, -1), (1, -1), (1, 1)):  # seen from above they are a line
        base.base_polygon.add(x=x, y=y)
    assert corners(truth) == LEVEL


def test_a_crosswalk_with_an_outline_of_its_own() -> None:
    truth = add_marking(GroundTruth())
    truth.road_marking[0].base.orientation.yaw = math.pi / 2
    for x, y in ((0, 0), (3, 0), (3, 2)):
        truth.road_marking[0].base.base_polygon.add(x=x, y=y)
    assert corners(truth) == {(30.0, 5.0), (30.0, 8.0), (28.0, 8.0)}


def test_markings_that_are_no_crosswalk() -> None:
    assert not read_road(add_marking(GroundTruth(), sign=17))
    gone = add_marking(GroundTruth())
    gone.road_marking[0].classification.is_out_of_service = True
    assert not read_road(gone)
    flat = add_marking(GroundTruth())
    flat.road_marking[0].base.dimension.width = 0.0
    assert read_road(flat).notes == ["1 crosswalk without an extent on the ground: left out"]
    flat.road_marking[0].base.position.x = math.nan
    assert read_road(flat).crosswalks == []


WHOLE = logical_street()
logical(WHOLE, 30, [21, 22], [23])
add_boundary(WHOLE, 4, [(60.0, -4.0), (100.0, -4.5)])
add_lane(WHOLE, 10, [2], [4, 3], [(0, -2), (100, -2)])
add_marking(WHOLE).road_marking[0].base.base_polygon.add(x=3, y=1)
NUMBERS = st.sampled_from([math.nan, math.inf, 1e308, -1e308, 5e-324, 1e9, 0.0])
HIT = st.tuples(st.integers(0, WHOLE.ByteSize() - 1), NUMBERS | st.integers(0, 255))


@given(st.lists(HIT, max_size=5), st.booleans())
def test_no_message_stops_the_reading_of_its_road(hits: list[tuple[int, float]], logical_too: bool) -> None:
    content = bytearray(WHOLE.SerializeToString())
    for at, value in hits:
        new = struct.pack("<d", value) if isinstance(value, float) else bytes([value])
        content[at : at + len(new)] = new
    try:
        truth = GroundTruth.FromString(bytes(content))
    except DecodeError:
        return
    if not logical_too:
        truth.ClearField("logical_lane")
    with np.errstate(over="ignore", invalid="ignore"):  # as where recordings are read
        road = read_road(truth)
    for lane in road.lanes:
        assert min(len(lane.left_m), len(lane.right_m)) > 1
        assert np.isfinite(lane.outline_m).all()


# Lanes that esmini writes, against those of the OpenDRIVE map that it drives on.


@pytest.mark.parametrize("name", ["pedestrian_esmini", "pedestrian_esmini_betterosi"])
def test_lanes_of_esmini_are_those_of_its_map(name: str) -> None:
    """Each driven lane covers, and runs along, one of the map's: two of each arm; the junction's are in no OSI lane."""
    recording, map_file = SHARED / f"{name}.mcap", SHARED / "maps/opendrive/fabriksgatan.xodr"
    if not (recording.is_file() and map_file.is_file()):
        pytest.skip("no recording of esmini here")
    log = read_log(recording, name="a")
    driven = [lane for lane in log.lanes if lane.kind == "driving"]
    of_map = [lane for lane in read_opendrive(map_file).lanes if lane.kind == "driving"]
    assert (len(log.lanes), len(driven)) == (24, 8)
    for lane in driven:
        own = shapely.Polygon(lane.outline_m)
        best = max(of_map, key=lambda other: own.intersection(shapely.Polygon(other.outline_m)).area)
        assert own.intersection(shapely.Polygon(best.outline_m)).area > 0.997 * own.area
        ahead, other = (one.left_m[-1] - one.left_m[0] for one in (lane, best))
        assert ahead[:2] @ other[:2] > 0.0
    assert find_agreement(log.scene, log.truth, log.lanes).share == 1.0
