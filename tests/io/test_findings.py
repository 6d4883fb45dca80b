"""Numbers that are none, at every entrance: whatever leaf of a message is none, the tracks are the same, or it is said.

The messages are of every kind that is read (OSI's truth and lists, lists of ROS 2, Foxglove and own schemas, odometry,
transforms); one leaf of one message is made NaN, infinite, as large as a number can be, or absent; an integer the
least and the largest that there is, a text empty.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.json_format import ParseDict
from mcap_protobuf.schema import build_file_descriptor_set
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_sensordata_pb2 import SensorData
from rosbags.typesys import get_types_from_msg

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import STATES, Tracks
from copem_replay.io.config import EgoTopic, RecordedTopic, TruthFields
from copem_replay.io.encodings.ros2_types import message_definition
from copem_replay.io.recorded_units import read_recorded_unit
from copem_replay.io.recording import Recording, read_log
from tests.helpers.drawn import examples
from tests.helpers.recordings import Obj, Topic, ground_truth, ns, pedestrian, write_mcap
from tests.helpers.ros2 import STORE, header, made, odometry, pose, topic, transform
from tests.io.test_recorded_units import car, list_of
from tests.io.test_situations import detections
from tests.io.test_world_frame import FIELDS, json_topic, own

NONE = (math.nan, math.inf, -math.inf, 1e308, -1e308, None)
"""What is put in the place of a number; None: the field is absent."""
EXTREMES = (-(2**63), -(2**31), 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1)
"""What is put in the place of an integer, as far as its type has it."""
ANY = (("id", "value"), ("tracking_id", "value"), ("ground_truth_id", "value"))
"""Integers whose every value is one: ids."""
TIMES = [k / 10 for k in range(7)]
CHANGED = 3  # the message that is changed: one in the middle, whose neighbours are sound
Change = tuple[str, bytes]


# A leaf of a message replaced, by the encoding of the message.


def instead(value: Any) -> tuple[Any, ...]:
    """What is put in the place of a value."""
    if isinstance(value, str):
        return ("", None)
    if isinstance(value, bool):
        return (not value, None)
    return NONE if isinstance(value, float) else (*EXTREMES, None)


def changed_protobuf(payload: bytes, message_class: Any) -> Iterator[Change]:
    def leaves(message: Any, path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], str, Any]]:
        for field, value in message.ListFields():
            if (
                field.message_type is None
                and not field.is_repeated
                and (*(at for at, _ in path[-1:]), field.name) not in ANY
            ):
                yield path, field.name, value
            elif field.message_type is not None:
                inner = list(value) if field.is_repeated else [value]
                for k, one in enumerate(inner):
                    yield from leaves(one, (*path, (field.name, k if field.is_repeated else None)))

    for path, name, stated in leaves(message_class.FromString(payload), ()):
        for value in instead(stated):
            message = inner = message_class.FromString(payload)
            for field, k in path:
                inner = getattr(inner, field) if k is None else getattr(inner, field)[k]
            if value is None:
                if not inner.DESCRIPTOR.fields_by_name[name].has_presence:
                    continue  # absent is 0
                inner.ClearField(name)
            else:
                most = 3e38 if inner.DESCRIPTOR.fields_by_name[name].type == FieldDescriptor.TYPE_FLOAT else math.inf
                if isinstance(value, float) and abs(value) > most:
                    value = math.copysign(min(most, abs(value)), value)
                try:
                    setattr(inner, name, value)
                except ValueError:  # its type, or its enumeration, has no such number
                    continue
            yield f"{'.'.join(field for field, _ in path)}.{name} = {value}", message.SerializePartialToString()


def changed_json(payload: bytes) -> Iterator[Change]:
    def leaves(value: Any, path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], Any]]:
        items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, inner in items:
            yield from leaves(inner, (*path, key))
        if isinstance(value, int | float | str):
            yield path, value

    for path, stated in leaves(json.loads(payload), ()):
        numbers = isinstance(stated, int) and not isinstance(stated, bool)
        for value in (*NONE[:-1], *EXTREMES, None) if numbers else instead(stated):
            message = inner = json.loads(payload)
            for key in path[:-1]:
                inner = inner[key]
            inner[path[-1]] = value
            yield f"{path} = {value}", json.dumps(message).encode()


def changed_ros(payload: bytes, kind: str) -> Iterator[Change]:
    def leaves(value: Any, path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], Any]]:
        if dataclasses.is_dataclass(value):
            for field in dataclasses.fields(value):
                if not field.name.startswith("__"):
                    yield from leaves(getattr(value, field.name), (*path, field.name))
        elif isinstance(value, list):
            for k, inner in enumerate(value):
                yield from leaves(inner, (*path, k))
        elif isinstance(value, np.ndarray):
            places = (0, 1, 7) if value.dtype.kind == "f" else (0,)  # of a covariance; of an id
            yield from (((*path, k), value[k].item()) for k in places if k < len(value))
        else:
            yield path, value

    for path, stated in leaves(STORE.deserialize_cdr(payload, kind), ()):
        eight_bits = (255,) if isinstance(stated, int) and path[-1] != "nanosec" else ()
        for value in (*instead(stated)[:-1], *eight_bits):  # no field of a message of ROS can be absent
            message = inner = copy.deepcopy(STORE.deserialize_cdr(payload, kind))
            for key in path[:-1]:
                inner = inner[key] if isinstance(key, int) else getattr(inner, key)
            try:
                if isinstance(path[-1], int):
                    inner[path[-1]] = value
                else:
                    object.__setattr__(inner, path[-1], value)
                yield f"{path} = {value}", bytes(STORE.serialize_cdr(message, kind))
            except (OverflowError, struct.error):  # its type has no such number
                continue


# Recordings: the topics, the one that is changed and how, and how the recording is read.


def osi_truth() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    def objects(t: float) -> list[Obj]:
        wall = Obj(id=9, x=20, y=9, stationary=True, length=8, width=1, height=3)
        return [Obj(id=1, x=5 * t, vx=5.0), pedestrian(2, 30.0, t, vx=0.0, vy=1.0, yaw=1.5), wall]

    messages = [(ns(t), ground_truth(t, objects(t), 1).SerializeToString()) for t in TIMES]
    return [Topic("truth", "osi3.GroundTruth", messages)], lambda p: changed_protobuf(p, GroundTruth), {}


def osi_lists() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    truth, _, _ = osi_truth()
    entries = [car(1 + 5 * t, vx=5.0, sigma_m=(0.3, 0.2), existence=0.8) for t in TIMES]
    for entry in entries:
        entry.base.dimension.length, entry.base.dimension.width, entry.base.dimension.height = 4.0, 2.0, 1.5
        entry.base.orientation.yaw, entry.base.velocity.y = 0.1, 0.1
        entry.base.position.y = 0.1
        entry.candidate.add(type=3, probability=0.2)
    lists = [list_of(t, entry, captured_s=t) for t, entry in zip(TIMES, entries, strict=True)]
    return [Topic("rsu", "osi3.SensorData", lists), *truth], lambda p: changed_protobuf(p, SensorData), {"unit": "rsu"}


def own_lists() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    payloads = [(ns(t), json.dumps(own(t)).encode()) for t in TIMES]
    boxes = Topic("/boxes", "my.Boxes", payloads, encoding="json", definition=("jsonschema", b"{}"))
    fields = TruthFields.model_validate(FIELDS)
    return [boxes], changed_json, {"topic": "/boxes", "fields": fields}


def markers(t: float) -> Any:
    def cube(name: str, x: float, y: float) -> Any:
        size = made("geometry_msgs/msg/Vector3", x=4.0, y=2.0, z=1.5)
        return made(
            "visualization_msgs/msg/Marker", header=header(t, "map"), ns=name, id=1, type=1, pose=pose(x, y, 0.7, 30.0),
            scale=size,
        )  # fmt: skip

    return made("visualization_msgs/msg/MarkerArray", markers=[cube("car", 20 + 5 * t, 0), cube("truck", 9, 9)])


def ros_lists() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    kind = "visualization_msgs/msg/MarkerArray"
    boxes = topic("/boxes", kind, [(t, markers(t)) for t in TIMES])
    return [boxes], lambda p: changed_ros(p, kind), {}


def ros_odometry() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    boxes, _, _ = ros_lists()
    kind = "nav_msgs/msg/Odometry"
    poses = topic("/odom", kind, [(t, odometry(t, 5 * t, 1.0, 20.0, speed=5.0)) for t in TIMES])
    ego = EgoTopic(topic="/odom", size_m=(4.5, 1.8, 1.5), centre_from_rear_axle_m=1.4)
    return [poses, *boxes], lambda p: changed_ros(p, kind), {"ego": ego}


def ros_transforms() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    kind = "tf2_msgs/msg/TFMessage"
    boxes = "visualization_msgs/msg/MarkerArray"
    size = made("geometry_msgs/msg/Vector3", x=4.0, y=2.0, z=1.5)
    moves = [(t, made(kind, transforms=[transform(t, "map", "base_link", 5 * t, 1.0, 20.0)])) for t in TIMES]
    cubes = [
        made(
            "visualization_msgs/msg/Marker",
            header=header(t, "base_link"),
            ns="car",
            type=1,
            pose=pose(9, 1),
            scale=size,
        )
        for t in TIMES
    ]
    lists = [(t, made(boxes, markers=[cube])) for t, cube in zip(TIMES, cubes, strict=True)]
    return [topic("/tf", kind, moves), topic("/boxes", boxes, lists)], lambda p: changed_ros(p, kind), {}


TRACKED = "autoware_perception_msgs/msg/TrackedObjects"
_TYPES = get_types_from_msg(message_definition(TRACKED).decode(), TRACKED)
STORE.register({name: fields for name, fields in _TYPES.items() if name not in STORE.fielddefs})


def autoware_lists() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    def tracked(number: int, label: int, at: Any, speed: float) -> Any:
        spread = np.zeros(36)
        spread[[0, 1, 7]] = 0.09, 0.01, 0.04
        twist = made("geometry_msgs/msg/Twist", linear=made("geometry_msgs/msg/Vector3", x=speed))
        kinematics = made(
            "autoware_perception_msgs/msg/TrackedObjectKinematics",
            pose_with_covariance=made("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=spread),
            twist_with_covariance=made("geometry_msgs/msg/TwistWithCovariance", twist=twist),
            orientation_availability=2,
        )
        sides = made("geometry_msgs/msg/Vector3", x=4.0, y=2.0, z=1.5)
        return made(
            "autoware_perception_msgs/msg/TrackedObject",
            object_id=made("unique_identifier_msgs/msg/UUID", uuid=np.full(16, number, dtype=np.uint8)),
            existence_probability=0.8,
            classification=[
                made("autoware_perception_msgs/msg/ObjectClassification", label=label, probability=0.9),
                made("autoware_perception_msgs/msg/ObjectClassification", label=2, probability=0.1),
            ],
            kinematics=kinematics,
            shape=made("autoware_perception_msgs/msg/Shape", dimensions=sides),
        )

    def lists(t: float) -> Any:
        objects = [tracked(1, 1, pose(20 + 5 * t, 0.5, 0.7), 5.0), tracked(2, 6, pose(9.0, 9.0, 0.7, 30.0), 0.0)]
        return made(TRACKED, header=header(t, "map"), objects=objects)

    tracks = topic("/tracks", TRACKED, [(t, lists(t)) for t in TIMES])
    truth = dataclasses.replace(tracks, name="/truth")
    return [tracks, truth], lambda p: changed_ros(p, TRACKED), {"topic": "/truth", "unit": "/tracks"}


def vision_lists() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    def lists(t: float) -> dict[str, Any]:
        message = detections(t, ids=("7", "8"), x=1.0)
        for detection in message["detections"]:
            detection["results"][0]["pose"] = {"covariance": [0.09, 0.01, 0, 0, 0, 0, 0.01, 0.04, *[0] * 28]}
            detection["bbox"]["center"]["position"]["y"] += 0.5
        return message

    found = json_topic("/tracks", [(t, lists(t)) for t in TIMES], schema="vision_msgs/msg/Detection3DArray")
    truth = dataclasses.replace(found, name="/truth")
    return [found, truth], changed_json, {"topic": "/truth", "unit": "/tracks"}


def scene(t: float) -> dict[str, Any]:
    def entity(name: str, x: float, y: float) -> dict[str, Any]:
        turn = {"x": 0.0, "y": 0.0, "z": 0.5, "w": 0.75**0.5}
        cube = {"pose": {"position": {"x": x, "y": y, "z": 0.7}, "orientation": turn}}
        cube["size"] = {"x": 4.0, "y": 2.0, "z": 1.5}
        whole = {"id": name, "frame_id": "map", "timestamp": {"sec": 0, "nsec": ns(t)}, "cubes": [cube]}
        return {**whole, "metadata": [{"key": "class", "value": "car"}]}

    return {"entities": [entity("a", 20 + 5 * t, 0.5), entity("b", 9.0, 9.0)]}


def foxglove_json() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    return [json_topic("/scene", [(t, scene(t)) for t in TIMES], schema="foxglove.SceneUpdate")], changed_json, {}


def foxglove_protobuf() -> tuple[list[Topic], Callable[[bytes], Iterator[Change]], dict[str, Any]]:
    def encoded(t: float) -> bytes:
        message = scene(t)
        for entity in message["entities"]:
            entity["timestamp"] = f"1970-01-01T00:00:{t:06.3f}Z"
        return ParseDict(message, SceneUpdate()).SerializeToString()

    definition = ("protobuf", build_file_descriptor_set(SceneUpdate).SerializeToString())
    updates = [(ns(t), encoded(t)) for t in TIMES]
    of = Topic("/scene", "foxglove.SceneUpdate", updates, definition=definition)
    return [of], lambda p: changed_protobuf(p, SceneUpdate), {}


def read(path: Path, how: dict[str, Any]) -> tuple[bytes, tuple[str, ...]]:
    """What is read, to the last bit, and the notes; of a refusal its lines."""
    unit = how.get("unit")
    try:
        recording: Recording = read_log(path, name="log", **{k: v for k, v in how.items() if k != "unit"})
        notes, tracks = recording.notes, [recording.truth]
        if unit is not None:
            lists, of_lists = read_recorded_unit(
                recording, unit, RecordedTopic(topic=unit, covariance_m2=((1, 0), (0, 1))), checked=False
            )
            notes, tracks = (*notes, *of_lists), [*tracks, lists.tracks]
            said = [lists.existence, lists.class_probability, lists.spread_said]
        else:
            said = []
    except RecordingError as error:
        return b"", tuple(error.problems)
    return b"".join(
        [repr(recording.scene.object_ids).encode(), *map(content, tracks), *(a.tobytes() for a in said)]
    ), notes


def content(tracks: Tracks) -> bytes:
    columns = [getattr(tracks, name) for name in ("stamp_ns", "frame_ix", "object_ix", "valid", "arrives_s", *STATES)]
    for name, column in zip(STATES, columns[-len(STATES) :], strict=True):
        assert column is None or "var" in name or np.isfinite(column).all(), name  # NaN: that is not said
    return b"".join(column.tobytes() for column in columns if column is not None)


@pytest.mark.parametrize(
    "recording",
    [
        osi_truth,
        osi_lists,
        own_lists,
        ros_lists,
        ros_odometry,
        ros_transforms,
        autoware_lists,
        vision_lists,
        foxglove_json,
        foxglove_protobuf,
    ],
    ids=lambda one: one.__name__,
)
def test_a_number_that_is_none_changes_nothing_or_is_said(tmp_path: Path, recording: Any) -> None:
    topics, change, how = recording()
    clean = read(write_mcap(tmp_path / "clean.mcap", topics), how)
    assert clean[0], clean[1]
    changed, *others = topics
    silent, tried = [], 0
    changes = list(change(changed.messages[CHANGED][1]))
    if len(changes) > (most := examples(600) * 3):
        changes = Random(52).sample(changes, most)
    for number, (label, payload) in enumerate(changes):
        messages = list(changed.messages)
        messages[CHANGED] = messages[CHANGED][0], payload
        one = dataclasses.replace(changed, messages=messages)
        found = read(write_mcap(tmp_path / f"{number}.mcap", [one, *others]), how)
        tried += 1
        if found[0] != clean[0] and found[1] == clean[1]:
            silent.append(label)
    assert not silent, "\n".join(silent)
    assert tried > 20
