"""The converters of data sets: Argoverse 2, OpenLABEL. A few rows each, all expected values by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pytest
from osi3.osi_object_pb2 import StationaryObject
from pyarrow import feather

from copem_replay.core.frame import Frame
from tests.extras.conversions import Runner, run

__all__ = ["run"]

# Argoverse 2 ------------------------------------------------------------------------------------------------

T0 = 315966253660223000  # ns; not a Unix time
HALF = math.sqrt(0.5)
WEST_TO_NORTH = (HALF, 0.0, 0.0, HALF)  # w x y z: 90° counter-clockwise
NO_TURN = (1.0, 0.0, 0.0, 0.0)
Pose = tuple[float, float, float, float]


def pose(stamp: int, turn: Pose, *at: float) -> dict[str, Any]:
    return {
        "timestamp_ns": stamp,
        **dict(zip(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), (*turn, *at), strict=True)),
    }


def box(stamp: int, uuid: str, category: str, turn: Pose, *at: float) -> dict[str, Any]:
    size = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5, "num_interior_pts": 7}
    return {**pose(stamp, turn, *at), "track_uuid": uuid, "category": category, **size}


def av2_log(run: Runner, boxes: list[dict[str, Any]], poses: list[dict[str, Any]]) -> Path:
    log = run.folder / "log"
    log.mkdir()
    pd.DataFrame(boxes).to_feather(log / "annotations.feather")
    pd.DataFrame(poses).to_feather(log / "city_SE3_egovehicle.feather")
    return log


STEP_NS = 10**9  # between instants at which the car is 14 m apart
BOXES = [
    box(T0, "car-uuid", "REGULAR_VEHICLE", WEST_TO_NORTH, 10, 1, 0.5),
    box(T0 + STEP_NS, "car-uuid", "REGULAR_VEHICLE", NO_TURN, 10, 1, 0.5),
    box(T0 + STEP_NS, "cone-uuid", "CONSTRUCTION_CONE", NO_TURN, 5, -3, 0),
    box(T0 + STEP_NS, "odd-uuid", "HOVERCRAFT", NO_TURN, 20, 0, 0),
    box(T0 + STEP_NS, "ego-uuid", "EGO_VEHICLE", NO_TURN, 0, 0, 0),
    box(T0 + 2 * STEP_NS, "car-uuid", "REGULAR_VEHICLE", NO_TURN, 10, 1, 0.5),
]
POSES = [
    pose(T0, WEST_TO_NORTH, 100, 200, 20),
    pose(T0 + 50, WEST_TO_NORTH, 999, 999, 99),  # poses are at the rates of all sensors
    pose(T0 + STEP_NS, NO_TURN, 100, 201, 20),
]


def test_argoverse2_from_the_rear_axle_to_the_city(run: Runner) -> None:
    found = run("argoverse2", av2_log(run, BOXES, POSES))
    assert found.stamps_ns == [T0, T0 + STEP_NS]
    assert found.names == {"1": "EGO_VEHICLE", "2": "car-uuid", "3": "cone-uuid", "4": "odd-uuid"}
    # The ego faces north: 10 m ahead and 1 m to the left is 10 m north and 1 m west; north + 90° is west.
    names = ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    first, second = found.values("2", *names)
    assert [*first[:3], abs(first[3]), *first[4:]] == pytest.approx([99, 210, 20.5, math.pi, 4, 2, 1.5])
    assert second == pytest.approx([110, 202, 20.5, 0, 4, 2, 1.5])
    # The rear axle at (100, 200, 20): its centre is 1.339 m ahead, north, then east, and 0.438 m up.
    first, second = found.values("1", *names)
    assert first == pytest.approx([100, 201.339, 20.438, math.pi / 2, 4.877, 2, 1.473])
    assert second == pytest.approx([101.339, 201, 20.438, 0, 4.877, 2, 1.473])
    rear = found.messages[0].moving_object[0].vehicle_attributes.bbcenter_to_rear
    assert (rear.x, rear.y, rear.z) == (-1.339, 0, -0.438)
    assert found.recording.host_id == "1"
    assert found.class_of("2") == "car"
    assert found.class_of("4") == "other"
    (cone,) = found.messages[1].stationary_object
    assert cone.id.value == 3
    assert cone.classification.type == StationaryObject.Classification.TYPE_CONSTRUCTION_SITE_ELEMENT
    assert not any(moving.base.HasField("velocity") for message in found.messages for moving in message.moving_object)
    for note in (
        "1 annotated instant without an ego pose of the same time stamp: skipped",
        "1 object state of the class name 'HOVERCRAFT', which says nothing: taken as other; "
        "--class 'HOVERCRAFT=car' says what it is",
        "1 row of category EGO_VEHICLE: replaced by the ego pose",
        "ego vehicle: id 1, 4.877×2×1.473 m, its centre 1.339, 0, 0.438 m (ahead, left, up) of the rear axle",
    ):
        assert f"note: {note}" in found.printed


def test_argoverse2_brings_the_lanes_of_its_map(run: Runner) -> None:
    """Two lanes side by side have three borders; in the first message alone. The crosswalk is at their height."""
    log = av2_log(run, BOXES, POSES)
    (log / "map").mkdir()

    def line(y: float) -> list[dict[str, float]]:
        return [{"x": x, "y": y, "z": 20.0} for x in (90.0, 110.0)]

    lanes = {
        name: {"left_lane_boundary": line(y), "right_lane_boundary": line(y - 3), "lane_type": kind}
        for name, y, kind in (("71", 6, "BIKE"), ("72", 3, "VEHICLE"))
    }
    crossing = {"edge1": [{"x": 95, "y": 0}, {"x": 95, "y": 6}], "edge2": [{"x": 98, "y": 0}, {"x": 98, "y": 6}]}
    site = {"lane_segments": lanes, "pedestrian_crossings": {"73": crossing}}
    (log / "map/log_map_archive_x____PIT_city_1.json").write_text(json.dumps(site))
    found = run("argoverse2", log)
    *borders, outline = found.recording.lane_boundaries
    assert [b[:, 1].tolist() for b in borders] == [[6, 6], [3, 3], [0, 0]]
    assert [(lane.id, lane.kind) for lane in found.recording.lanes] == [("71", "bicycle"), ("72", "driving")]
    assert found.recording.lanes[1].left_m.tolist() == [[90, 3, 20], [110, 3, 20]]
    assert found.messages[0].lane[1].classification.centerline[1].y == 1.5
    (area,) = found.recording.scene.areas
    assert (area.name, area.kind, set(area.rings_m[0])) == (
        "crosswalk 73",
        "crosswalk",
        {(95, 0), (95, 6), (98, 6), (98, 0)},
    )
    assert (outline[:, 2] == 20).all()
    later = found.messages[1]
    assert not any((later.lane_boundary, later.lane, later.road_marking))
    assert "note: 2 lanes of log_map_archive_x____PIT_city_1.json" in found.printed
    assert "note: 1 crosswalk of the map" in found.printed
    assert "place on earth: that of city PIT, by the name of log_map_archive_x____PIT_city_1.json" in found.printed
    place = found.recording.place_said
    assert place is not None
    origin = Frame(place.proj, place.offset_m).to_wgs84([(0.0, 0.0)])[0]  # as av2's geometry/utm.py has it
    assert origin == pytest.approx([40.44177902989321, -80.01294377242584], abs=1e-9)


def test_argoverse2_a_map_that_is_none_is_refused(run: Runner) -> None:
    log = av2_log(run, BOXES, POSES)
    (log / "map").mkdir()
    (log / "map/log_map_archive_x.json").write_text("[")
    assert "log_map_archive_x.json:1: expected JSON" in run.refused("argoverse2", log)


def test_argoverse2_a_quaternion_that_overflows_is_no_turn(run: Runner) -> None:
    found = run("argoverse2", av2_log(run, [{**BOXES[0], "qw": 1e200}, *BOXES[1:]], POSES))
    assert len(found.values(found.id_of("car-uuid"), "x_m")) == 1  # of two


def test_argoverse2_a_place_that_is_not_finite_is_skipped(run: Runner) -> None:
    found = run("argoverse2", av2_log(run, [{**BOXES[0], "tx_m": math.inf}, *BOXES[1:]], POSES))
    assert len(found.values(found.id_of("car-uuid"), "x_m")) == 1  # of two


def test_argoverse2_ego_of_another_size(run: Runner) -> None:
    options = ("--ego-size-m", "5", "2.1", "1.6", "--centre-from-rear-axle-m", "1.5", "0", "0.4")
    found = run("argoverse2", av2_log(run, BOXES, POSES), *options)
    row = found.values("1", "x_m", "y_m", "z_m", "length_m", "width_m", "height_m")[1]
    assert row == pytest.approx([101.5, 201, 20.4, 5, 2.1, 1.6])


AV2_STATIC = {
    *("BOLLARD", "CONSTRUCTION_BARREL", "CONSTRUCTION_CONE", "MOBILE_PEDESTRIAN_CROSSING_SIGN", "SIGN", "STOP_SIGN"),
}
AV2_MOVING = {
    *("ANIMAL", "ARTICULATED_BUS", "BICYCLE", "BICYCLIST", "BOX_TRUCK", "BUS", "DOG", "LARGE_VEHICLE", "MOTORCYCLE"),
    *("MESSAGE_BOARD_TRAILER", "MOTORCYCLIST", "OFFICIAL_SIGNALER", "PEDESTRIAN", "RAILED_VEHICLE", "REGULAR_VEHICLE"),
    *("SCHOOL_BUS", "STROLLER", "TRAFFIC_LIGHT_TRAILER", "TRUCK", "TRUCK_CAB", "VEHICULAR_TRAILER", "WHEELCHAIR"),
    *("WHEELED_DEVICE", "WHEELED_RIDER"),
}


def test_argoverse2_every_category_of_the_data_set_is_known() -> None:
    from copem_replay.extras.convert.conversion import kind_from_name

    assert len(AV2_STATIC | AV2_MOVING) == 30  # AnnotationCategories of av2-api
    kinds = {name: kind_from_name(name) for name in AV2_STATIC | AV2_MOVING}
    assert all(kinds.values())
    assert {name for name, kind in kinds.items() if kind is not None and not kind.moving} == AV2_STATIC


def test_argoverse2_refuses(run: Runner) -> None:
    log = av2_log(run, BOXES, POSES)
    annotations, poses = log / "annotations.feather", log / "city_SE3_egovehicle.feather"
    assert "expected the folder of an Argoverse 2 sensor log" in run.refused("argoverse2", annotations)
    table = pa.Table.from_pandas(pd.DataFrame(BOXES).drop(columns=["qx", "category"]))
    feather.write_feather(table.append_column("tx_m", table["tx_m"]), annotations)
    line = run.refused("argoverse2", log)
    assert line.startswith(f"{annotations}: expected the columns timestamp_ns, category")
    assert line.endswith(", once each; found no category, no qx, 2 tx_m")
    pd.DataFrame(BOXES).assign(tx_m="far").to_feather(annotations)
    assert "annotations.feather: column tx_m: expected double, found " in run.refused("argoverse2", log)
    pd.DataFrame(BOXES).assign(track_uuid=None).to_feather(annotations)
    assert "annotations.feather: column track_uuid: expected no gaps, found 6" in run.refused("argoverse2", log)
    pd.DataFrame(BOXES).assign(timestamp_ns=-1).to_feather(annotations)
    assert "no object to convert in 0 frames; ego vehicle: id 1" in run.refused("argoverse2", log)
    annotations.write_text("version https://git-lfs.github.com/spec/v1\n")
    assert "annotations.feather: expected a feather file, found" in run.refused("argoverse2", log)
    poses.unlink()
    assert "city_SE3_egovehicle.feather: no such file" in run.refused("argoverse2", log)


# OpenLABEL --------------------------------------------------------------------------------------------------


def labels(frames: dict[str, Any], **more: Any) -> str:
    return json.dumps({"openlabel": {"metadata": {"schema_version": "1.0.0"}, "frames": frames, **more}})


def turned(yaw_deg: float, *at: float) -> list[float]:
    """Matrix of a turn about z and a translation, row by row."""
    c, s = round(math.cos(math.radians(yaw_deg))), round(math.sin(math.radians(yaw_deg)))
    return [c, -s, 0, at[0], s, c, 0, at[1], 0, 0, 1, at[2], 0, 0, 0, 1]


def kitti() -> dict[str, Any]:
    """A car 20 m ahead of the left camera and 3 m to its right, facing away from it, in two frames.

    The camera looks along z, its y points down; it is 1 m ahead of and 1.6 m above the origin of the vehicle, which
    stands at (100, 50), heading east first and north later.
    """
    camera = [0, 0, 1, 1, -1, 0, 0, 0, 0, -1, 0, 1.6, 0, 0, 0, 1]
    dont_care = {
        "name": "box3D",
        "coordinate_system": "CAM",
        "val": [-10.0, 499.0, -1.0, 0, -1.0, 0, -1000, -1000, -1000],
    }
    flat = {"name": "box3D", "coordinate_system": "CAM", "val": [-1000, -1000, -1000, 0, -10, 0, -1, -1, -1]}
    # Sizes along the box's own axes: length along x, height along y (down), width along z. A turn of −90° about the
    # camera's y brings x to where it looks.
    car = {"name": "box3D", "coordinate_system": "CAM", "val": [3.0, 0.85, 20.0, 0, -math.pi / 2, 0, 4.0, 1.5, 1.8]}
    objects = {
        "-1": {"object_data": {"bbox": [], "cuboid": [dont_care]}},
        "-2": {},
        "3": {"object_data": {"bbox": [], "cuboid": [flat]}},
        "7": {"object_data": {"bbox": [], "cuboid": [car]}},
    }
    frames = {}
    for number, yaw_deg in (("0", 0.0), ("1", 90.0)):
        moved = {"src": "vehicle", "dst": "odom", "transform_src_to_dst": {"matrix4x4": turned(yaw_deg, 100, 50, 0)}}
        frames[number] = {"frame_properties": {"transforms": {"vehicle_to_odom": moved}}, "objects": objects}
    systems = {
        "odom": {"type": "scene_cs", "parent": "", "children": ["vehicle"]},
        "vehicle": {"type": "local_cs", "parent": "odom", "children": ["CAM"]},
        "CAM": {"type": "sensor_cs", "parent": "vehicle", "pose_wrt_parent": {"matrix4x4": camera}},
    }
    types = {"-1": "DontCare", "-2": "Egocar", "3": "Van", "7": "Car"}
    named = {key: {"name": f"{kind}{key}", "type": kind} for key, kind in types.items()}
    return {"frames": frames, "coordinate_systems": systems, "objects": named}


def test_openlabel_as_kitti_has_it(run: Runner) -> None:
    found = run("openlabel", run.file("k.json", labels(**kitti())), "--rate-hz", "1")
    assert found.stamps_ns == [0, 1_000_000_000]
    assert found.names == {"4": "7"}  # −1 is no OSI id: numbered as they come
    names = ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    first, second = found.values("4", *names)
    # East: 1 + 20 m ahead, 3 m to the right (south), 1.6 − 0.85 m up. North: 21 m north, 3 m to the right (east).
    assert first == pytest.approx([121, 47, 0.75, 0, 4, 1.8, 1.5])
    assert second == pytest.approx([103, 71, 0.75, math.pi / 2, 4, 1.8, 1.5])
    assert found.class_of("4") == "car"
    assert found.recording.host_id is None
    assert "note: cuboids in CAM given in odom\n" in found.printed
    assert "note: 2 objects without object_data in a frame: skipped\n" in found.printed
    assert "note: 4 objects without a place (DontCare) in a frame: skipped\n" in found.printed


def test_openlabel_in_another_system(run: Runner) -> None:
    found = run("openlabel", run.file("k.json", labels(**kitti())), "--rate-hz", "1", "--to", "vehicle")
    assert found.values("4", "x_m", "y_m", "z_m")[1] == pytest.approx([21, -3, 0.75])
    line = run.refused("openlabel", run.folder / "k.json", "--rate-hz", "10", "--to", "moon")
    assert "frame 0: object 7: expected poses that lead from CAM to moon, found none: choose another with --to" in line


def tumtraf(seconds: str, x_m: float, yaw_rad: float, *, name: str | None = None) -> str:
    quaternion = [0, 0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)]  # x y z w
    cuboid: dict[str, Any] = {
        "name": "shape3D",
        "val": [x_m, 2, -7, *quaternion, 4.2, 1.9, 1.4],
        "attributes": {"num": []},
    }
    if name:
        cuboid["coordinate_system"] = name
    data = {"name": "CAR_6d8e", "type": "CAR", "cuboid": cuboid}
    frame = {"frame_properties": {"timestamp": float(seconds)}, "objects": {"6d8e-uuid": {"object_data": data}}}
    systems = {
        "base": {"type": "scene_cs", "parent": ""},
        "lidar": {
            "parent": "base",
            "pose_wrt_parent": {"quaternion": [0, 0, math.sqrt(0.5), math.sqrt(0.5)], "translation": [10, 0, 8]},
        },
    }
    return labels({"5": frame}, coordinate_systems=systems)


def test_openlabel_as_tumtraf_has_it(run: Runner) -> None:
    run.file("labels/b.json", tumtraf("1651673050.16", 1.0, 3.5))
    run.file("labels/c.json", tumtraf("1651673050.06", 0.0, 3.0))  # the names are not in order of time
    found = run("openlabel", run.folder / "labels")
    assert found.stamps_ns == [1651673050_060000000, 1651673050_160000000]
    assert found.names == {"1": "6d8e-uuid"}
    rows = found.values("1", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    assert rows[0] == pytest.approx([0, 2, -7, 3, 4.2, 1.9, 1.4])
    assert rows[1] == pytest.approx([1, 2, -7, 3.5 - 2 * math.pi, 4.2, 1.9, 1.4])
    assert "note: cuboids name no coordinate system: taken as they are\n" in found.printed


def test_openlabel_cuboids_of_a_sensor(run: Runner) -> None:
    # The lidar is turned by 90° at (10, 0, 8): (1, 2, −7) of it is (10 − 2, 1, 1) of the base.
    for text, options in ((tumtraf("1", 1, 0), ("--from", "lidar")), (tumtraf("1", 1, 0, name="lidar"), ())):
        found = run("openlabel", run.file("t.json", text), *options)
        assert found.values("1", "x_m", "y_m", "z_m", "yaw_rad")[0] == pytest.approx([8, 1, 1, math.pi / 2])


def test_openlabel_what_is_skipped_is_said(run: Runner) -> None:
    box = {"name": "a", "val": [0, 0, 1, 0, 0, 0, 2, 1, 1]}
    objects = {
        "1": {"object_data": {"type": "UFO", "cuboid": [box, box]}},
        "2": {"object_data": {"bbox": [], "type": "CAR"}},
    }
    frames = {
        "3": {"frame_properties": {"timestamp": "2.5"}, "objects": objects},
        "4": {"frame_properties": {"timestamp": 3}},
    }
    found = run("openlabel", run.file("t.json", labels(frames)))
    assert found.stamps_ns == [2_500_000_000, 3_000_000_000]
    assert found.class_of("1") == "other"
    assert "note: 1 object state of the class name 'UFO', which says nothing: taken as other; " in found.printed
    assert "note: 1 cuboid beyond the first of an object in a frame: skipped\n" in found.printed
    assert "note: 1 object without a cuboid in a frame: skipped\n" in found.printed


def cuboid(val: Any, **more: Any) -> str:
    frame = {
        "frame_properties": {"timestamp": 1, **more},
        "objects": {"1": {"object_data": {"cuboid": [{"val": val}]}}},
    }
    return labels({"0": frame})


@pytest.mark.parametrize("none", [math.nan, math.inf, -math.inf, 1e308])
@pytest.mark.parametrize("leaf", range(9))
def test_openlabel_a_number_that_is_none_is_left_out_or_completed(run: Runner, none: float, leaf: int) -> None:
    """Of an object by its type; a size that is none is that of its class, "other" here."""
    sound = [3.0, 2.0, 1.0, 0.0, 0.0, 0.1, 4.0, 2.0, 1.5]
    odd = [*sound[:leaf], none, *sound[leaf + 1 :]]
    objects = {str(k): {"object_data": {"cuboid": [{"val": val}]}} for k, val in ((1, sound), (2, odd))}
    text = labels({"0": {"frame_properties": {"timestamp": 1}, "objects": objects}})
    found = run("openlabel", run.file("t.json", text))
    skipped = "note: 1 object state with a number that is none: skipped\n" in found.printed
    assert skipped == (leaf < 6)
    assert len(found.recording.scene.object_ids) == 2 - skipped
    assert ("without a size, or with one that is none" in found.printed) != skipped


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("{", "t.json: expected JSON, found something else"),
        ("[" * 100_000, "t.json: expected JSON, found something else"),
        ("\xff", "t.json: "),
        ("[]", "t.json: expected OpenLABEL with `openlabel` and its `frames`, found list"),
        ('{"vcd": {}}', "t.json: expected OpenLABEL with `openlabel` and its `frames`, found vcd"),
        (labels({"0": 1}), "t.json: frame 0: expected an object with `objects`, found 1"),
        (labels({"0": {}}), "frame 0: expected a timestamp, found none: say how many frames a second with --rate-hz"),
        (cuboid([1] * 8), "t.json: frame 0: object 1: expected a cuboid of 9 or 10 numbers, found [1, 1"),
        (cuboid([1] * 8 + ["a"]), "t.json: frame 0: object 1: cuboid: expected a number, found 'a'"),
        (cuboid([1] * 9, timestamp="noon"), "t.json: frame 0: timestamp: expected a time of 0 to"),
        (cuboid([1] * 9, transforms={"t": {}}), "frame 0: transforms: t: expected src, dst and transform_src_to_dst"),
        (cuboid([1] * 9, transforms=3), "frame 0: transforms: expected an object of objects, found 3"),
        (
            labels({}, coordinate_systems={"a": {"parent": "b", "pose_wrt_parent": {}}}),
            "a: pose_wrt_parent: expected matrix",
        ),
        (
            labels({}, coordinate_systems={"a": {"parent": "b", "pose_wrt_parent": {"matrix4x4": [1.0] * 16}}}),
            "a: pose_wrt_parent: expected a rotation and a translation, found another matrix",
        ),
        (  # a rotation, and a last row that makes no movement of it
            labels(
                {},
                coordinate_systems={
                    "a": {"parent": "b", "pose_wrt_parent": {"matrix4x4": [*turned(0, 1, 2, 3)[:-1], 0]}}
                },
            ),
            "a: pose_wrt_parent: expected a rotation and a translation, found another matrix",
        ),
        (
            labels({}, coordinate_systems={"a": {"parent": "b", "pose_wrt_parent": {"matrix4x4": [1.0] * 9}}}),
            "a: pose_wrt_parent: expected 16 numbers, found [1.0",
        ),
        (labels({}, objects=[1]), "t.json: objects: expected an object, found [1]"),
        (labels({}), "t.json: no object to convert in 0 frames"),
    ],
)
def test_openlabel_refuses(run: Runner, text: str, line: str) -> None:
    assert line in run.refused("openlabel", run.file("t.json", text))


def test_openlabel_refuses_two_files_of_one_instant(run: Runner) -> None:
    run.file("labels/a.json", tumtraf("1", 0, 0))
    run.file("labels/b.json", tumtraf("1", 1, 0))
    assert "frame 2: expected a time after 1.000000 s" in run.refused("openlabel", run.folder / "labels")
    (run.folder / "empty").mkdir()
    assert "empty: expected OpenLABEL files, found no *.json in the folder" in run.refused(
        "openlabel", run.folder / "empty"
    )
