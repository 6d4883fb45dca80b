"""Reading recordings: each thing real ones get wrong, as one tiny log; and the real ones themselves."""

import json
import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_sensorview_pb2 import SensorView

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import CLASSES, TRUTH, VALUES
from copem_replay.io.recording import Recording, read_log
from copem_replay.pipeline.notes import scene_as_json, scene_from_json
from tests.helpers.recordings import (
    ANIMAL,
    PEDESTRIAN,
    SHARED,
    VEHICLE,
    Obj,
    Topic,
    ground_truth,
    ns,
    pedestrian,
    sensor_view,
    truth_topic,
    write_mcap,
    write_recording,
)

# One car at 10 m/s, two frames 0.1 s apart: enough where something else is the matter.
ONE_CAR = [(0.0, [Obj(x=0.0, vx=10.0)]), (0.1, [Obj(x=1.0, vx=10.0)])]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


def problem(path: Path, **how: str) -> str:
    """The one line that says why a file cannot be read."""
    with pytest.raises(RecordingError) as caught:
        read_log(path, name="log", **how)
    (line,) = caught.value.problems
    assert "\n" not in line
    return line.removeprefix(f"{path}: ")


def classes(recording: Recording) -> dict[str, str]:
    scene = recording.scene
    return {i: CLASSES[k] for i, k in zip(scene.object_ids, scene.object_class, strict=True)}


def states(recording: Recording, column: str = "x_m") -> dict[str, list[tuple[float, float]]]:
    """(captured_s, value) of each row of each object."""
    truth, values = recording.truth, getattr(recording.truth, column)[0]
    return {
        recording.scene.object_ids[o]: [
            (round(float(truth.row_captured_s[p]), 9), float(values[p]))
            for p in range(truth.start[e], truth.start[e + 1])
        ]
        for e, o in enumerate(truth.object_ix)
    }


# ------------------------------------------------------------------------------- what flows


def test_everything_of_a_log_without_defects(path):
    car = {"length": 4.5, "width": 1.8, "height": 1.5, "z": 10.75, "yaw": 0.5}
    frames = [
        (5.0, [Obj(id=7, x=0, y=3, vx=20, vy=-1, **car), pedestrian(3, 20, vx=0, vy=1)]),
        (5.25, [Obj(id=7, x=5, y=2.75, vx=20, vy=-1, **car), pedestrian(3, 20, y=0.25, vx=0, vy=1)]),
        (5.5, [Obj(id=7, x=10, y=2.5, vx=20, vy=-1, **car)]),
    ]
    write_recording(path, frames, host=7)
    recording = read_log(str(path), name="crossing")
    scene, truth = recording.scene, recording.truth
    assert (scene.log, scene.t0_ns, scene.end_ns) == ("crossing", 5_000_000_000, 5_500_000_000)
    assert scene.object_ids == ("7", "3")
    assert classes(recording) == {"7": "car", "3": "pedestrian"}
    assert scene.moving.tolist() == [True, True]
    assert scene.ego_ix == 0
    assert (recording.path, recording.topic, recording.host_id) == (path, "truth", "7")
    assert recording.notes == ()
    assert truth.units == (TRUTH,)
    assert truth.start.tolist() == [0, 3, 5]
    assert truth.unit_ix.tolist() == [0, 0]
    assert truth.object_ix.tolist() == [0, 1]
    assert truth.frame_ix.tolist() == [0, 1, 2, 0, 1]
    assert truth.stamp_ns.tolist() == [5_000_000_000, 5_250_000_000, 5_500_000_000]
    assert truth.captured_s.tolist() == [0, 0.25, 0.5]
    assert truth.arrives_s.tolist() == [[0, 0.25, 0.5]]
    assert truth.frame_unit_ix.tolist() == [0, 0, 0]
    assert truth.valid.tolist() == [[True] * 5]
    expected = {
        "x_m": [0, 5, 10, 20, 20],
        "y_m": [3, 2.75, 2.5, 0, 0.25],
        "z_m": [10.75, 10.75, 10.75, 0.9, 0.9],
        "yaw_rad": [0.5, 0.5, 0.5, 0, 0],
        "vx_mps": [20, 20, 20, 0, 0],
        "vy_mps": [-1, -1, -1, 1, 1],
        "length_m": [4.5, 4.5, 4.5, 0.5, 0.5],
        "width_m": [1.8, 1.8, 1.8, 0.6, 0.6],
        "height_m": [1.5, 1.5, 1.5, 1.8, 1.8],
    }
    assert {name: getattr(truth, name)[0].tolist() for name in VALUES} == expected
    assert truth.cov_ee_m2 is None


def test_objects_are_numbered_by_appearance_then_as_in_the_file(path):
    write_recording(path, [(0, [Obj(id=9), Obj(id=4, x=9)]), (0.1, [Obj(id=1, x=5), Obj(id=9), Obj(id=4, x=9)])])
    assert read_log(path, name="log").scene.object_ids == ("9", "4", "1")


def test_a_track_that_goes_and_comes_back_stays_one_track(path):
    write_recording(path, [(k, [Obj(id=1, x=k, vx=1)] if k != 2 else []) for k in range(4)])
    recording = read_log(path, name="log")
    assert states(recording) == {"1": [(0, 0), (1, 1), (3, 3)]}
    assert len(recording.truth.stamp_ns) == 4  # an empty list is a list


# ------------------------------------------------------------------------------- topics


def test_sensor_view(path):
    write_recording(path, ONE_CAR, schema="osi3.SensorView", host=1)
    recording = read_log(path, name="log")
    assert states(recording) == {"1": [(0, 0), (0.1, 1)]}
    assert recording.scene.ego_ix == 0
    assert recording.notes == ()


def test_sensor_view_without_ground_truth_is_skipped(path):
    good = truth_topic(ONE_CAR, schema="osi3.SensorView").messages
    empty = (ns(0.05), sensor_view(0.05, None).SerializeToString())
    write_mcap(path, [Topic("view", "osi3.SensorView", [*good, empty])])
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 2
    assert recording.notes == ("1 message without global_ground_truth: skipped",)


def test_the_stamp_of_a_sensor_view_is_its_own_else_that_of_the_ground_truth(path):
    both = (ns(9), sensor_view(2.5, ground_truth(2.0, [Obj()])).SerializeToString())
    inner = (ns(9), sensor_view(None, ground_truth(3.0, [Obj()])).SerializeToString())
    write_mcap(path, [Topic("view", "osi3.SensorView", [both, inner])])
    assert read_log(path, name="log").truth.stamp_ns.tolist() == [2_500_000_000, 3_000_000_000]


def test_ground_truth_is_taken_before_sensor_views(path):
    view = truth_topic(ONE_CAR[:1], name="view", schema="osi3.SensorView")
    write_recording(path, ONE_CAR, more=[view])
    recording = read_log(path, name="log")
    assert recording.topic == "truth"
    assert recording.notes == ("topic view (osi3.SensorView) not read: truth taken",)
    chosen = read_log(path, name="log", topic="view")
    assert (chosen.topic, len(chosen.truth.stamp_ns)) == ("view", 1)


def test_several_truths_are_a_choice(path):
    write_recording(path, ONE_CAR, more=[truth_topic(ONE_CAR[:1], name="other")])
    assert problem(path) == (
        "true objects on several topics, truth (osi3.GroundTruth), other (osi3.GroundTruth): "
        "choose one with `read: {topic: …}` in the experiment"
    )
    assert len(read_log(path, name="log", topic="other").truth.stamp_ns) == 1


def test_a_topic_without_messages_is_no_choice(path):
    write_recording(path, ONE_CAR, more=[Topic("empty", "osi3.GroundTruth")])
    assert read_log(path, name="log").topic == "truth"


def test_topic_that_is_not_there(path):
    write_recording(path, ONE_CAR, more=[Topic("map", "osi3.MapAsamOpenDrive", [(0, b"")])])
    for topic in ("map", "nowhere"):
        assert problem(path, topic=topic) == (
            f"no true objects on topic '{topic}'; they are on truth (osi3.GroundTruth)"
        )


def test_other_schemas_are_skipped_and_counted(path):
    # A payload that no class of OSI decodes, at log time 0 and last in the file, as seen with maps.
    more = [
        Topic("map", "osi3.MapAsamOpenDrive", [(0, b"\xff\xff")]),
        Topic("odometry", "nav_msgs/msg/Odometry", [(1, b"\x00\x01"), (2, b"\x00\x01")], "cdr"),
        Topic("remarks", "", [(3, b"{}")], "json"),
        Topic("silent", "tf2_msgs/msg/TFMessage", [], "cdr"),
    ]
    write_recording(path, ONE_CAR, more=more, by_time=False)
    recording = read_log(path, name="log")
    assert states(recording) == {"1": [(0, 0), (0.1, 1)]}
    assert recording.notes == (  # a map is no list; `info` names it
        "2 messages of nav_msgs/msg/Odometry not read",
        "1 message of no schema (json) not read",
    )


def test_no_message_at_all(path):
    write_mcap(path, [Topic("truth", "osi3.GroundTruth")])
    assert problem(path) == "holds no message (osi3.GroundTruth on truth)"
    write_mcap(path, [])
    assert problem(path) == "holds no message (and no channel)"


def test_no_channel_with_objects(path):
    topics = [
        Topic("/odom", "nav_msgs/msg/Odometry", [(0, b"x")], "cdr"),
        Topic("rsu", "osi3.SensorData", [(0, b"")]),
        Topic("truth", "osi3.GroundTruth", [(0, b"{}")], "json"),
    ]
    write_mcap(path, topics)
    assert problem(path) == (
        "no list of true objects; it holds nav_msgs/msg/Odometry (cdr) on /odom, osi3.SensorData on rsu, "
        "osi3.GroundTruth (json) on truth; "
        "beside a recording that has one its lists replay by `together: [THAT, THIS]`; "
        "`read: {topic: …, objects: …, id: …}` names the fields of any list (docs/guide/recordings.md)"
    )


def test_of_many_channels_only_some_are_named(path):
    write_mcap(path, [Topic(f"/{k}", "a/msg/B", [(0, b"x")], "cdr") for k in range(40)])
    said = problem(path)
    assert "a/msg/B (cdr) on /11, … (40 topics in all); `read: {topic" in said
    assert "/12" not in said


def test_no_usable_object(path):
    write_recording(path, [(0, [Obj(x=None)]), (0.1, [])])
    assert problem(path) == (
        "truth: no usable object in 2 messages; "
        "1 object state without a position, or with one that is no number: skipped"
    )
    write_mcap(path, [Topic("truth", "osi3.GroundTruth", [(0, b"\xff"), (1, b"\xff")])])
    assert problem(path) == "truth: no usable object in 2 messages; 2 messages cannot be decoded: skipped"


def test_a_payload_that_does_not_decode_is_skipped(path):
    good = truth_topic(ONE_CAR).messages
    write_mcap(path, [Topic("truth", "osi3.GroundTruth", [*good, (ns(0.05), good[0][1][:-3])])])
    recording = read_log(path, name="log")
    assert states(recording) == {"1": [(0, 0), (0.1, 1)]}
    assert recording.notes == ("1 message cannot be decoded: skipped",)


# ------------------------------------------------------------------------------- time


def test_the_stamp_counts_not_the_time_of_logging(path):
    write_recording(path, ONE_CAR, log_s=[99.7, 99.8])
    recording = read_log(path, name="log")
    assert recording.truth.stamp_ns.tolist() == [0, 100_000_000]
    assert recording.notes == ()


def test_file_order_and_logging_order_need_not_be_time_order(path):
    frames = [(t, [Obj(x=10 * t, vx=10)]) for t in (0.2, 0.0, 0.3, 0.1)]
    write_recording(path, frames, log_s=[1, 2, 3, 4])
    recording = read_log(path, name="log")
    assert states(recording) == {"1": [(0, 0), (0.1, 1), (0.2, 2), (0.3, 3)]}
    assert recording.notes == ("2 messages stamped earlier than the one before: sorted by time",)


def test_stamps_as_floats_cut_them(path):
    # 0.1 s steps as seen: cut off to …99 ns; the jitter stays, no instant is lost.
    stamps = [0, 99_999_999, 200_000_000, 300_000_000, 399_999_999]
    messages = [(s, ground_truth(s / 1e9, [Obj(vx=None)]).SerializeToString()) for s in stamps]
    write_mcap(path, [Topic("truth", "osi3.GroundTruth", messages)])
    assert read_log(path, name="log").truth.stamp_ns.tolist() == stamps


def test_two_messages_of_one_instant_the_first_is_kept(path):
    frames = [(0, [Obj(x=0)]), (0.1, [Obj(x=1)]), (0.1, [Obj(x=500)]), (0.1 + 9e-7, [Obj(x=600)]), (0.2, [Obj(x=2)])]
    write_recording(path, [(t, [Obj(x=o.x, vx=10) for o in objs]) for t, objs in frames])
    recording = read_log(path, name="log")
    assert states(recording) == {"1": [(0, 0), (0.1, 1), (0.2, 2)]}
    assert recording.notes == ("2 messages with the time stamp of another: the first kept",)


def test_messages_without_timestamp_are_taken_when_they_were_logged(path):
    write_recording(path, [(None, [Obj(x=0, vx=10)]), (None, [Obj(x=1, vx=10)])], log_s=[7, 7.1])
    recording = read_log(path, name="log")
    assert recording.scene.t0_ns == 7_000_000_000
    assert states(recording) == {"1": [(0, 0), (0.1, 1)]}
    assert recording.notes == ("2 messages without timestamp: the time of logging taken",)


def test_some_messages_without_timestamp(path):
    # One logged between its neighbours is taken; one logged by a clock of another epoch would make a log of decades.
    frames = [(0.0, [Obj(x=0, vx=10)]), (None, [Obj(x=1, vx=10)]), (0.2, [Obj(x=2, vx=10)]), (None, [Obj(x=9)])]
    write_recording(path, frames, log_s=[0, 0.1, 0.2, 1.7e9])
    recording = read_log(path, name="log")
    assert states(recording) == {"1": [(0, 0), (0.1, 1), (0.2, 2)]}
    assert recording.notes == (
        "1 message without timestamp: the time of logging taken",
        "1 message without timestamp, and logged at another time: skipped",
    )


def test_an_impossible_stamp_is_none(path):
    absurd = ground_truth(0.0, [Obj(x=7)])
    absurd.timestamp.seconds = 2**62
    write_mcap(
        path, [Topic("truth", "osi3.GroundTruth", [*truth_topic(ONE_CAR).messages, (5, absurd.SerializeToString())])]
    )
    recording = read_log(path, name="log")
    assert states(recording) == {"1": [(0, 0), (0.1, 1)]}
    assert recording.notes == (
        "1 message with an impossible time stamp: the time of logging taken",
        "1 message with the time stamp of another: the first kept",
    )


@pytest.mark.parametrize("start_s", [0.0, 0.3, 1_695_000_000.0, 315_900_000.0])
def test_a_log_may_start_at_any_time(path, start_s):
    write_recording(path, [(start_s, [Obj(x=0, vx=10)]), (start_s + 0.5, [Obj(x=5, vx=10)])])
    recording = read_log(path, name="log")
    assert recording.scene.t0_ns == ns(start_s)
    assert recording.truth.captured_s.tolist() == [0, 0.5]


def test_one_message_is_a_log(path):
    write_recording(path, ONE_CAR[:1])
    recording = read_log(path, name="log")
    assert recording.scene.end_s == 0
    assert states(recording, "vx_mps") == {"1": [(0, 10)]}


# ------------------------------------------------------------------------------- objects


@pytest.mark.parametrize(
    ("kind", "vehicle", "expected"),
    [
        (0, None, "other"),
        (1, None, "other"),
        (VEHICLE, None, "vehicle"),
        *[
            (VEHICLE, number, name)
            for name, numbers in {
                "vehicle": (0, 1, 22),
                "car": (2, 3, 4, 5),
                "van": (6,),
                "truck": (7, 16, 19),
                "trailer": (8, 9),
                "motorcycle": (10,),
                "bicycle": (11, 17, 18),
                "bus": (12,),
                "other": (13, 14, 20, 21),
                "pedestrian": (15,),
            }.items()
            for number in numbers
        ],
        (PEDESTRIAN, None, "pedestrian"),
        (PEDESTRIAN, 4, "pedestrian"),
        (ANIMAL, 4, "animal"),
    ],
)
def test_classes(path, kind, vehicle, expected):
    write_recording(path, [(0, [Obj(type=kind, vehicle=vehicle)])])
    assert classes(read_log(path, name="log")) == {"1": expected}


def test_enum_values_that_do_not_exist(path):
    """A pedestrian of vehicle type −1 (as a known writer has it), a vehicle of type 99, an object of type 77."""
    message = ground_truth(0.0, [pedestrian(1, 0), Obj(id=2, x=9, vehicle=None), Obj(id=3, x=20, vehicle=None)])
    walker, car, thing = message.moving_object
    minus_one = b"\xff" * 9 + b"\x01"  # varint of −1
    walker.MergeFromString(bytes([6 << 3 | 2, 11, 1 << 3]) + minus_one)  # vehicle_classification {type: −1}
    car.MergeFromString(bytes([6 << 3 | 2, 2, 1 << 3, 99]))
    thing.ClearField("type")
    thing.MergeFromString(bytes([3 << 3, 77]))
    write_mcap(path, [Topic("truth", "osi3.GroundTruth", [(0, message.SerializeToString())])])
    assert classes(read_log(path, name="log")) == {"1": "pedestrian", "2": "vehicle", "3": "other"}


def test_class_is_the_most_frequent_and_of_equals_the_first(path):
    vehicles = [(4, 12, 7, 12), (12, 4, 7, 4), (12, 12, 7, 4), (4, 4, 7, 4)]  # per frame, of four objects
    frames = [
        (k / 10, [Obj(id=i, x=10 * i, vehicle=v, height=2.5) for i, v in enumerate(row)])
        for k, row in enumerate(vehicles)
    ]
    recording = read_log(write_recording(path, frames), name="log")
    assert classes(recording) == {"0": "car", "1": "bus", "2": "truck", "3": "car"}
    assert recording.notes == ("3 objects of changing class: the most frequent taken",)


def test_stationary_objects(path):
    cone = {"length": 0.4, "width": 0.4, "height": 0.7, "z": 0.35, "stationary": True}
    objects = [Obj(id=5, x=0), Obj(id=5, x=20, **cone), Obj(id=6, x=30, **cone)]
    write_recording(path, [(0, objects), (0.1, objects)])
    recording = read_log(path, name="log")
    assert classes(recording) == {"5": "car", "stationary:5": "other", "6": "other"}
    assert recording.scene.moving.tolist() == [True, False, False]
    assert states(recording) == {
        "5": [(0, 0), (0.1, 0)],
        "stationary:5": [(0, 20), (0.1, 20)],
        "6": [(0, 30), (0.1, 30)],
    }
    assert not recording.truth.vx_mps.any()
    assert recording.notes == ()


HOUSE = {"id": 9, "x": 15, "y": 10, "z": 5, "length": 20, "width": 20, "height": 8, "stationary": True}
TRIANGLE = [(-10, -10), (10, 10), (-10, 10)]


@pytest.mark.parametrize("closed", [False, True])
def test_a_stationary_object_with_a_base_polygon_is_a_solid_of_that_outline(path, closed):
    """A triangle, half of its box, turned by 90°: (x, y) of its own is (15 − y, 10 + x) of the world."""
    house = Obj(**HOUSE, yaw=math.pi / 2, polygon=TRIANGLE + TRIANGLE[: int(closed)])
    write_recording(path, [(0, [Obj(id=1), house]), (0.1, [Obj(id=1), house])])
    recording = read_log(path, name="log")
    assert recording.scene.object_ids == ("1",)
    [solid] = recording.scene.solids
    assert (solid.name, solid.bottom_m, solid.top_m) == ("object 9", 1.0, 9.0)
    assert np.array(solid.corners_m) == pytest.approx(np.array([(25, 0), (5, 20), (5, 0)]))
    assert recording.notes == ("1 stationary object with a base_polygon: hides as that prism, and is no object",)
    assert scene_from_json(json.loads(json.dumps(scene_as_json(recording.scene)))).solids == recording.scene.solids


@pytest.mark.parametrize(
    "polygon",
    [
        TRIANGLE[:2],
        [(-10, -10), (10, 10), (10, -10), (-10, 10)],  # crosses itself
        [(0, 0), (1, 1), (2, 2)],
        [(0, 0), (math.nan, 1), (2, 0)],
        [(0, 0), (1e300, 1), (2, 0)],
        [(10 * math.cos(k), 10 * math.sin(k)) for k in np.arange(1001) * 2 * math.pi / 1001],
    ],
)
def test_a_base_polygon_that_is_none_leaves_the_box(path, polygon):
    write_recording(path, [(0, [Obj(id=1), Obj(**HOUSE, polygon=polygon)])] * 2)
    recording = read_log(path, name="log")
    assert (recording.scene.object_ids, recording.scene.solids) == (("1", "9"), ())
    assert recording.notes[0] == "1 stationary object whose base_polygon is no simple polygon: its box taken"


def test_a_solid_without_a_height_or_a_place_is_the_box_that_is_said_to_be_wrong(path):
    flat, nowhere = Obj(**HOUSE | {"height": None}, polygon=TRIANGLE), Obj(**HOUSE | {"id": 8, "x": None})
    write_recording(path, [(0, [Obj(id=1), flat, nowhere])])
    recording = read_log(path, name="log")
    assert (recording.scene.object_ids, recording.scene.solids) == (("1", "9"), ())


def test_solids_on_z_0_are_stood_on_it_as_boxes_are(path):
    write_recording(path, [(0, [Obj(id=1, z=0), pedestrian(2, 9, z=0), Obj(**HOUSE | {"z": 0}, polygon=TRIANGLE)])])
    recording = read_log(path, name="log")
    assert "every box is centred on z = 0: stood on z = 0" in recording.notes
    assert [(solid.bottom_m, solid.top_m) for solid in recording.scene.solids] == [(0.0, 8.0)]


def test_a_stationary_object_whose_id_moves_only_later_keeps_one_name(path):
    still = Obj(id=5, x=20, stationary=True)
    write_recording(path, [(0, [Obj(id=1), still]), (0.1, [Obj(id=1), still, Obj(id=5, x=40)])])
    assert read_log(path, name="log").scene.object_ids == ("1", "stationary:5", "5")


def test_large_ids(path):
    write_recording(path, [(0, [Obj(id=2**64 - 1), Obj(id=2**64 - 2, x=9)])])
    assert read_log(path, name="log").scene.object_ids == (str(2**64 - 1), str(2**64 - 2))


def test_an_id_twice_in_a_message_the_first_is_kept(path):
    write_recording(path, [(0, [Obj(x=0, vx=10), Obj(x=70)]), (0.1, [Obj(x=1, vx=10), Obj(x=80)])])
    recording = read_log(path, name="log")
    assert states(recording) == {"1": [(0, 0), (0.1, 1)]}
    assert recording.notes == ("2 object states of an id twice in a message: the first kept",)


def sizes_of(recording):
    truth = recording.truth
    boxes = zip(truth.length_m[0], truth.width_m[0], truth.height_m[0], strict=True)
    return [(recording.scene.object_ids[k], *box) for k, box in zip(truth.row_object_ix, boxes, strict=True)]


def test_unusable_states_are_skipped_by_reason(path):
    nan, inf = math.nan, math.inf
    good = Obj(id=1)
    bad = [
        Obj(id=None),
        Obj(id=2, x=None),
        Obj(id=3, y=nan),
        Obj(id=4, z=inf),
        Obj(id=5, x=2e7),
        Obj(id=6, yaw=nan),
        Obj(id=7, length=0),
        Obj(id=8, width=-1),
        Obj(id=9, length=1001),
        Obj(id=10, width=nan),
        Obj(id=11, height=nan),
        Obj(id=12, height=-1.5),
        Obj(id=13, height=5000),
    ]
    write_recording(path, [(0, [*bad, good])])
    recording = read_log(path, name="log")
    assert recording.scene.object_ids == ("7", "8", "9", "10", "11", "12", "13", "1")
    sizes = {name: (round(a, 2), round(b, 2), round(c, 2)) for name, a, b, c in sizes_of(recording)}
    typical = (4.5, 1.8, 1.5)  # of a car
    assert sizes == {
        "7": (4.5, 2.0, 1.5), "8": (4.0, 1.0, 1.5), "9": (4.5, 2.0, 1.5), "10": (4.0, 1.8, 1.5),
        **dict.fromkeys(("11", "12", "13", "1"), (4.0, 2.0, typical[2])),
    }  # fmt: skip
    assert recording.notes == (
        "1 object state without an id: skipped",
        "3 object states without a position, or with one that is no number: skipped",
        "1 object state farther than 1e+07 m from the origin: skipped",
        "1 object state whose yaw is no number: skipped",
        "2 object states with a negative size: its amount taken",
        "3 object states without a size, or with one that is none: that of its class taken",
        "height implausible or missing: 2 car (1.5 m taken)",
    )


def test_an_object_at_the_origin_is_there(path):
    write_recording(path, [(0, [Obj(x=0, y=0, z=0, yaw=0)])])
    assert read_log(path, name="log").notes == ()


def test_coordinates_of_a_city(path):
    write_recording(path, [(0, [Obj(x=-7_123.25, y=5_400_000.5, z=-25.0)])])
    truth = read_log(path, name="log").truth
    assert (truth.x_m[0, 0], truth.y_m[0, 0], truth.z_m[0, 0]) == (-7_123.25, 5_400_000.5, -25.0)


def test_yaw_is_wrapped_and_what_is_inside_keeps_its_bits(path):
    given = [3.5, -3.5, math.pi, -math.pi, 7.0, 0.1, np.nextafter(math.pi, 4)]
    write_recording(path, [(k / 10, [Obj(yaw=yaw)]) for k, yaw in enumerate(given)])
    yaw = read_log(path, name="log").truth.yaw_rad[0]
    assert (yaw > -math.pi).all()
    assert (yaw <= math.pi).all()
    expected = [3.5 - 2 * math.pi, 2 * math.pi - 3.5, math.pi, math.pi, 7 - 2 * math.pi, 0.1, math.pi]
    assert yaw.tolist() == pytest.approx(expected, abs=1e-15)
    assert yaw[[2, 5]].tolist() == [math.pi, 0.1]


def test_no_orientation_is_yaw_0_and_said(path):
    write_recording(path, [(0, [Obj(id=1, yaw=None), Obj(id=2, x=9), Obj(id=3, x=30, yaw=None, stationary=True)])])
    recording = read_log(path, name="log")
    assert recording.truth.yaw_rad[0].tolist() == [0, 0, 0]
    assert recording.notes == ("2 object states without orientation: yaw 0 taken",)


# ------------------------------------------------------------------------------- velocities and heights


def test_velocity_that_is_not_set(path):
    write_recording(path, [(k / 4, [Obj(id=1, x=5 * k, vx=None)]) for k in range(3)])
    recording = read_log(path, name="log")
    assert states(recording, "vx_mps") == {"1": [(0, 20), (0.25, 20), (0.5, 20)]}
    assert recording.notes == ("velocity of 3 object states is not given: derived from the positions",)


def test_velocity_that_is_no_number_counts_as_not_set(path):
    write_recording(path, [(k / 4, [Obj(id=1, x=5 * k, vx=math.nan if k else 20)]) for k in range(3)])
    assert states(read_log(path, name="log"), "vx_mps") == {"1": [(0, 20), (0.25, 20), (0.5, 20)]}


def test_velocity_0_in_the_first_and_last_frame_of_a_track(path):
    write_recording(path, [(k / 4, [Obj(id=1, x=5 * k, vx=20 if 0 < k < 3 else 0)]) for k in range(4)])
    assert states(read_log(path, name="log"), "vx_mps") == {"1": [(0, 20), (0.25, 20), (0.5, 20), (0.75, 20)]}


def test_velocities_are_derived_in_order_of_time_not_of_the_file(path):
    frames = [(k / 4, [Obj(id=1, x=5 * k, vx=None), Obj(id=2, x=99 - k, vx=None)]) for k in (2, 0, 1)]
    write_recording(path, frames)
    assert read_log(path, name="log").truth.vx_mps[0].tolist() == [20, 20, 20, -4, -4, -4]


def test_heights_of_an_exporter_that_writes_the_width(path):
    frames = [(0, [pedestrian(1, 0, width=0.5, height=0.5, z=0.25)] + [Obj(id=k, x=9 * k, height=2.0) for k in (2, 3)])]
    write_recording(path, frames)
    recording = read_log(path, name="log")
    assert recording.truth.height_m[0].tolist() == [1.75, 2.0, 2.0]
    assert recording.truth.z_m[0].tolist() == [0.875, 0.75, 0.75]
    assert recording.notes == (
        "the height of every moving object equals its width, a known defect of exporters",
        "height implausible or missing: 1 pedestrian (1.75 m taken)",
    )


def test_a_log_without_heights_of_centres(path):
    write_recording(path, [(0, [pedestrian(1, 0, z=0), Obj(id=2, x=9, z=0)])])
    recording = read_log(path, name="log")
    assert recording.truth.z_m[0].tolist() == [0.9, 0.75]
    assert recording.notes == ("every box is centred on z = 0: stood on z = 0",)


# ------------------------------------------------------------------------------- the ego vehicle


def test_host_0_is_a_host(path):
    write_recording(path, [(0, [Obj(id=3, x=9), Obj(id=0)])], host=0)
    recording = read_log(path, name="log")
    assert recording.host_id == "0"
    assert recording.scene.object_ids[recording.scene.ego_ix] == "0"


@pytest.mark.parametrize(
    ("host", "view_host", "expected"), [(1, None, "1"), (None, 2, "2"), (1, 2, "1"), (None, None, None)]
)
def test_host_of_the_ground_truth_before_that_of_the_sensor_view(path, host, view_host, expected):
    frames = [(0, [Obj(id=1), Obj(id=2, x=9)])]
    write_recording(path, frames, schema="osi3.SensorView", host=host, view_host=view_host)
    recording = read_log(path, name="log")
    assert recording.host_id == expected
    assert recording.scene.ego_ix == {"1": 0, "2": 1, None: -1}[expected]
    assert recording.notes == ()


def test_host_that_is_nobody(path):
    write_recording(path, ONE_CAR, host=114)
    recording = read_log(path, name="log")
    assert (recording.host_id, recording.scene.ego_ix) == ("114", -1)
    assert recording.notes == ("the host vehicle 114 is not among the moving objects: no ego vehicle",)


def test_host_that_changes(path):
    objects = [Obj(id=1), Obj(id=2, x=9)]
    messages = [(ns(k), ground_truth(k, objects, host).SerializeToString()) for k, host in enumerate((1, 2, 2, None))]
    write_mcap(path, [Topic("truth", "osi3.GroundTruth", messages)])
    recording = read_log(path, name="log")
    assert (recording.host_id, recording.scene.ego_ix) == ("2", 1)
    assert recording.notes == ("the host vehicle changes (2 in 2 messages, 1 in 1 message): the most frequent taken",)


def test_the_ego_one_asks_for(path):
    write_recording(path, [(0, [Obj(id=1), Obj(id=2, x=9)])], host=1)
    recording = read_log(path, name="log", ego="2")
    assert recording.scene.ego_ix == 1
    assert recording.host_id == "1"
    assert read_log(path, name="log", ego="2", topic="truth").scene.ego_ix == 1


def test_an_ego_that_is_not_there_lists_those_that_are(path):
    objects = [pedestrian(7, 0), Obj(id=4, x=9), Obj(id=5, x=30, stationary=True)]
    write_recording(path, [(0, objects)])
    for ego in ("1", "5"):
        assert problem(path, ego=ego) == f"ego: no moving object '{ego}'; there are 4 (car), 7 (pedestrian)"
    write_recording(path, [(0, [Obj(id=k, x=9 * k) for k in range(20)])])
    shown = ", ".join(f"{k} (car)" for k in range(12))
    assert problem(path, ego="99") == f"ego: no moving object '99'; there are {shown}, … (20 in all)"


# ------------------------------------------------------------------------------- real recordings

# file: objects (moving, all), messages, states, span, ego; all counted by the plain loop below as well
REAL = {
    "av2_3b3570b4": ((116, 120), 157, 13820, 15.600, "67"),
    "drone_swerve": ((2, 2), 411, 822, 20.5, "1"),
    "highway_merge": ((6, 6), 433, 2598, 14.256, "0"),
    "ind_aah1": ((10, 10), 150, 1420, 5.96, None),
    "msight_trial3": ((1, 1), 1401, 1401, 28.0, None),
    "msight_trial5": ((1, 1), 1101, 1101, 22.0, None),
    "nuscenes_scene0061": ((90, 226), 191, 22611, 19.0, "1"),
    "nuscenes_scene0916": ((95, 95), 201, 11855, 20.0, "1"),
    "pedestrian_esmini": ((2, 2), 434, 868, 14.289, None),
    "pedestrian_esmini_betterosi": ((2, 2), 434, 868, 14.289, None),
}


def real(name: str) -> Path:
    path = SHARED / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"{path.name} is not part of the project")
    return path


def plain_states(path: Path) -> dict[tuple[int, bool, int], tuple[float, ...]]:
    """Stamp, moving and id of each state, and its numbers as the file has them."""
    found = {}
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages():
            if schema.name == "osi3.GroundTruth":
                truth = GroundTruth.FromString(message.data)
            elif schema.name == "osi3.SensorView":
                truth = SensorView.FromString(message.data).global_ground_truth
            else:
                continue
            stamp = truth.timestamp.seconds * 10**9 + truth.timestamp.nanos
            for objects, moving in ((truth.moving_object, True), (truth.stationary_object, False)):
                for obj in objects:
                    at, size = obj.base.position, obj.base.dimension
                    speed = (obj.base.velocity.x, obj.base.velocity.y) if moving else (0.0, 0.0)
                    found[stamp, moving, obj.id.value] = (
                        *(at.x, at.y, at.z - size.height / 2, size.length, size.width),
                        *(math.cos(obj.base.orientation.yaw), math.sin(obj.base.orientation.yaw), *speed),
                    )
    return found


@pytest.mark.parametrize("name", REAL)
def test_real_recordings_against_a_plain_loop(name):
    path = real(name)
    recording = read_log(path, name=name)
    scene, truth = recording.scene, recording.truth
    expected = plain_states(path)
    row_object = truth.row_object_ix
    found = {}
    columns = zip(
        truth.x_m[0],
        truth.y_m[0],
        truth.z_m[0] - truth.height_m[0] / 2,
        truth.length_m[0],
        truth.width_m[0],
        np.cos(truth.yaw_rad[0]),
        np.sin(truth.yaw_rad[0]),
        truth.vx_mps[0],
        truth.vy_mps[0],
        strict=True,
    )
    for p, values in enumerate(columns):
        ident = scene.object_ids[row_object[p]].removeprefix("stationary:")
        found[int(truth.stamp_ns[truth.frame_ix[p]]), bool(scene.moving[row_object[p]]), int(ident)] = values
    assert found.keys() == expected.keys()
    keys = list(expected)
    a, b = (np.array([states[k] for k in keys]) for states in (found, expected))
    np.testing.assert_allclose(a[:, :7], b[:, :7], atol=1e-9)
    logged = b[:, 7:].any(axis=1)  # a velocity that is given and not 0 is kept
    np.testing.assert_array_equal(a[logged, 7:], b[logged, 7:])


@pytest.mark.parametrize("name", REAL)
def test_real_recordings_hold_what_is_known_of_them(name):
    recording = read_log(real(name), name=name)
    scene, truth = recording.scene, recording.truth
    objects, frames, rows, span_s, ego = REAL[name]
    assert (int(scene.moving.sum()), len(scene.object_ids)) == objects
    assert (len(truth.stamp_ns), len(truth.frame_ix)) == (frames, rows)
    assert scene.end_s == pytest.approx(span_s, abs=1e-3)
    assert (scene.object_ids[scene.ego_ix] if scene.ego_ix >= 0 else None) == ego
    assert (np.diff(truth.stamp_ns) > 0).all()
    for value in VALUES:
        assert np.isfinite(getattr(truth, value)).all()
    assert (truth.height_m > 0).all()


REAL_NOTES = {
    "av2_3b3570b4": (),
    "drone_swerve": ("velocity of 822 object states is not given: derived from the positions",),
    "highway_merge": (
        "the height of every moving object equals its width, a known defect of exporters",
        "height implausible or missing: 1 motorcycle (1.6 m taken), 1 bus (3 m taken)",
    ),
    "ind_aah1": (),
    "msight_trial3": ("278 messages of osi3.SensorData not read",),
    "msight_trial5": ("219 messages of osi3.SensorData not read",),
    "nuscenes_scene0061": ("velocity of 49 object states is 0 though the object moves: derived from the positions",),
    "nuscenes_scene0916": ("velocity of 11 object states is 0 though the object moves: derived from the positions",),
    **dict.fromkeys(
        ("pedestrian_esmini", "pedestrian_esmini_betterosi"),
        ("275 object states with a number left out, as some writers do where it is 0: 0 taken",),
    ),
}


@pytest.mark.parametrize("name", REAL_NOTES)
def test_notes_on_real_recordings(name):
    assert read_log(real(name), name=name).notes == REAL_NOTES[name]


def test_two_writers_of_one_simulation_give_one_truth():
    one, other = (read_log(real(n), name="log") for n in ("pedestrian_esmini", "pedestrian_esmini_betterosi"))
    assert Counter(classes(one).values()) == {"car": 1, "pedestrian": 1}
    assert classes(one) == classes(other)
    for value in VALUES:
        np.testing.assert_array_equal(getattr(one.truth, value), getattr(other.truth, value))


def test_derived_velocities_of_a_real_drive_are_those_of_a_car():
    recording = read_log(real("drone_swerve"), name="log")
    speed = np.hypot(recording.truth.vx_mps, recording.truth.vy_mps)
    assert 10 < np.median(speed) < 20
    assert speed.max() < 30


def test_the_same_drive_as_ros_2_and_as_osi():
    """The worlds lie differently, and the ego is the odometry's: classes, number of states and speeds are the same."""
    ros = read_log(real("nuscenes_scene0916_autoware_ros2"), name="log")
    osi = read_log(real("nuscenes_scene0916"), name="log")
    assert ros.scene.object_ids[ros.scene.ego_ix] == "ego"
    kinds = [np.bincount(r.scene.object_class, minlength=11).tolist() for r in (ros, osi)]
    assert kinds[0] == kinds[1]
    speeds = [
        np.sort(np.hypot(r.truth.vx_mps[0], r.truth.vy_mps[0])[r.truth.row_object_ix != r.scene.ego_ix])
        for r in (ros, osi)
    ]
    np.testing.assert_allclose(*speeds, atol=1e-3)


Lines = dict[int, list[list[tuple[float, float, float]]]]


def road_log(path: Path, lines: Lines) -> Path:
    """Three messages with a car; `lines` by message."""
    messages = []
    for k in range(3):
        truth = GroundTruth()
        truth.timestamp.nanos = k * 10**8
        one = truth.moving_object.add(type=2)
        one.id.value, one.base.position.x, one.base.dimension.length = 1, 1.0 * k, 4.0
        one.base.dimension.width, one.base.dimension.height = 2.0, 1.5
        for line in lines.get(k, []):
            boundary = truth.lane_boundary.add()
            for x, y, z in line:
                point = boundary.boundary_line.add().position
                point.x, point.y, point.z = x, y, z
        messages.append((k * 10**8, truth.SerializeToString()))
    write_mcap(path, [Topic("truth", "osi3.GroundTruth", messages)])
    return path


def test_boundaries_of_lanes(tmp_path: Path) -> None:
    """Of the first message that has some; lines of fewer than two points, and points that are nowhere, are none."""
    first = [[(0, 2, 0), (50, 2, 0), (90, 3, 0.5)], [(0, -2, 0)], [(0, 9, 0), (math.nan, 9, 0), (5, 9, 0)]]
    log = road_log(tmp_path / "a.mcap", {1: first, 2: [[(7, 7, 0), (8, 8, 0)]]})
    lines = read_log(log, name="a").lane_boundaries
    assert [line.tolist() for line in lines] == [[[0, 2, 0], [50, 2, 0], [90, 3, 0.5]], [[0, 9, 0], [5, 9, 0]]]


@pytest.mark.parametrize(
    ("later", "read"), [({}, [[0, 2, 0], [50, 2, 0]]), ({2: [[(7, 7, 0), (8, 8, 0)]]}, [[7, 7, 0], [8, 8, 0]])]
)
def test_a_window_has_the_road_of_the_first_message_unless_it_has_its_own(
    tmp_path: Path, later: Lines, read: list[list[float]]
) -> None:
    log = road_log(tmp_path / "a.mcap", {0: [[(0, 2, 0), (50, 2, 0)]], **later})
    recording = read_log(log, name="a", window_s=(0.1, None))
    assert [line.tolist() for line in recording.lane_boundaries] == [read]
    assert len(recording.truth.stamp_ns) == 2
