"""Benchmarks of reading: OSI, ROS 2, Foxglove; 60 s × 20 Hz × 60 objects each, whole recordings, read to tracks."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.writer import Writer

from benches import common
from copem_replay.io.recording import read_log

FRAMES, COUNT, STEP_S = 1200, 60, 0.05
STATES = FRAMES * COUNT
_RULE = "=" * 80
_TRACKED = "autoware_perception_msgs/msg/TrackedObjects"
_NESTED = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "autoware_perception_msgs/TrackedObject": (
        "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\nObjectClassification[] classification\n"
        "TrackedObjectKinematics kinematics\nShape shape"
    ),
    "unique_identifier_msgs/UUID": "uint8[16] uuid",
    "autoware_perception_msgs/ObjectClassification": "uint8 label\nfloat32 probability",
    "autoware_perception_msgs/TrackedObjectKinematics": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance\n"
        "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance\nuint8 orientation_availability\n"
        "bool is_stationary"
    ),
    "autoware_perception_msgs/Shape": "uint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance",
    "geometry_msgs/AccelWithCovariance": "Accel accel\nfloat64[36] covariance",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular",
    "geometry_msgs/Accel": "Vector3 linear\nVector3 angular",
    "geometry_msgs/Polygon": "Point32[] points",
    "geometry_msgs/Point32": "float32 x\nfloat32 y\nfloat32 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
}
DEFINITION = "\n".join(
    ["std_msgs/Header header\nTrackedObject[] objects", *(f"{_RULE}\nMSG: {n}\n{text}" for n, text in _NESTED.items())]
)


def by_format(folder: Path, osi: Path) -> Iterator[common.Line]:
    """Objects per second of each format (`osi`: the same as ground truth), and ROS 2 against mcap-ros2-support."""
    from mcap_ros2.decoder import DecoderFactory

    yield _line("osi", common.best(lambda: read_log(osi, name="osi"), 3))
    for name, (encoding, schema, payloads) in {
        "scene_update_protobuf": ("protobuf", *_scene_updates(as_json=False)),
        "scene_update_json": ("json", *_scene_updates(as_json=True)),
    }.items():
        path = _written(folder / f"{name}.mcap", "foxglove.SceneUpdate", encoding, schema, payloads)
        yield _line(name, common.best(lambda path=path: read_log(path, name="scene"), 3))
    path = write_tracked(folder / "tracked.mcap")
    ours = common.best(lambda: read_log(path, name="tracked"), 3)
    theirs = common.best(lambda: sum_decoded(path, DecoderFactory()), 1)
    yield _line("tracked_objects", ours) | {"times_mcap_ros2_support": round(theirs / ours, 1)}


def write_tracked(path: Path) -> Path:
    """Write a recording of TrackedObjects."""
    return _written(path, _TRACKED, "cdr", ("ros2msg", DEFINITION.encode()), _tracked())


def sum_decoded(path: Path, factory: Any) -> float:
    """Every message decoded by a peer, and the places of its objects touched: their sum, x in m."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        messages = make_reader(file, decoder_factories=[factory]).iter_decoded_messages()
        return float(sum(o.kinematics.pose_with_covariance.pose.position.x for *_, m in messages for o in m.objects))


def _line(name: str, seconds: float) -> common.Line:
    return {"read_objects_per_s": round(STATES / seconds), "format": name}


def _written(path: Path, name: str, encoding: str, schema: tuple[str, bytes], payloads: list[bytes]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/objects", encoding, writer.register_schema(name, *schema))
        for k, payload in enumerate(payloads):
            stamp_ns = round(k * STEP_S * 1e9)
            writer.add_message(channel, log_time=stamp_ns, publish_time=stamp_ns, data=payload)
        writer.finish()
    return path


def _places(k: int) -> np.ndarray:
    """(COUNT, 2) where objects are in frame k: in a row, all at 5 m/s."""
    return np.stack([np.arange(COUNT) * 10.0 + k * STEP_S * 5.0, np.zeros(COUNT)], axis=1)


def _tracked() -> list[bytes]:
    """TrackedObjects: one message by rosbags, then the stamp and the places set where they lie."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(DEFINITION, _TRACKED))

    def made(name: str, **given: Any) -> Any:
        return store.types[name](**{f: given.get(f, _nothing(node)) for f, node in store.get_msgdef(name).fields})

    def _nothing(node: Any) -> Any:
        kind, detail = int(node[0]), node[1]
        if kind == 2:
            return made(detail)
        if kind == 1:
            return "" if detail[0] == "string" else 0
        return np.zeros(detail[1], dtype=detail[0][1][0]) if kind == 3 else []

    marks = np.float64(12345.678)  # found again in the bytes
    pose = made(
        "geometry_msgs/msg/Pose",
        position=made("geometry_msgs/msg/Point", x=float(marks)),
        orientation=made("geometry_msgs/msg/Quaternion", w=1.0),
    )
    package = "autoware_perception_msgs/msg"
    objects = [
        made(
            f"{package}/TrackedObject",
            object_id=made("unique_identifier_msgs/msg/UUID", uuid=np.full(16, k, dtype=np.uint8)),
            classification=[made(f"{package}/ObjectClassification", label=1, probability=1.0)],
            kinematics=made(
                f"{package}/TrackedObjectKinematics",
                pose_with_covariance=made("geometry_msgs/msg/PoseWithCovariance", pose=pose),
            ),
            shape=made(f"{package}/Shape", dimensions=made("geometry_msgs/msg/Vector3", x=4.5, y=1.9, z=1.5)),
        )
        for k in range(COUNT)
    ]
    header = made("std_msgs/msg/Header", frame_id="map")
    template = bytearray(store.serialize_cdr(made(_TRACKED, header=header, objects=objects), _TRACKED))
    at = []
    begin = template.find(marks.tobytes())
    while begin >= 0:
        at.append(begin)
        begin = template.find(marks.tobytes(), begin + 1)
    assert len(at) == COUNT
    messages = []
    for k in range(FRAMES):
        nanos = round(k * STEP_S * 1e9)
        template[4:12] = np.array(divmod(nanos, 10**9), dtype="<u4").tobytes()
        for place, (x, _) in zip(at, _places(k), strict=True):
            template[place : place + 8] = np.float64(x).tobytes()
        messages.append(bytes(template))
    return messages


def _scene_updates(*, as_json: bool) -> tuple[tuple[str, bytes], list[bytes]]:
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
    from mcap_protobuf.schema import build_file_descriptor_set

    messages = []
    for k in range(FRAMES):
        sec, nanos = divmod(round(k * STEP_S * 1e9), 10**9)
        entities = [
            {
                "timestamp": {"sec": sec, "nsec": nanos},
                "frame_id": "map",
                "id": str(n),
                "metadata": [{"key": "class", "value": "car"}],
                "cubes": [
                    {
                        "pose": {
                            "position": {"x": x, "y": y, "z": 0.75},
                            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                        },
                        "size": {"x": 4.5, "y": 1.9, "z": 1.5},
                    }
                ],
            }
            for n, (x, y) in enumerate(_places(k).tolist())
        ]
        if as_json:
            messages.append(json.dumps({"deletions": [], "entities": entities}).encode())
            continue
        update = SceneUpdate()
        for one in entities:
            entity = update.entities.add(frame_id="map", id=one["id"])
            entity.timestamp.FromNanoseconds(sec * 10**9 + nanos)
            entity.metadata.add(key="class", value="car")
            cube, said = entity.cubes.add(), one["cubes"][0]
            for target, source in ((cube.pose.position, "position"), (cube.pose.orientation, "orientation")):
                for axis, value in said["pose"][source].items():
                    setattr(target, axis, value)
            cube.size.x, cube.size.y, cube.size.z = said["size"].values()
        messages.append(update.SerializeToString())
    if as_json:
        return ("jsonschema", b"{}"), messages
    return ("protobuf", build_file_descriptor_set(SceneUpdate).SerializeToString()), messages


def reading() -> Iterator[common.Line]:
    """Reading 60 s × 20 Hz × 60 objects, against parsing the messages and touching the same fields in a plain loop."""
    with common.scratch() as folder:
        path = folder / "read.mcap"
        common.write_truth(path, common.boxes(1200, 60))
        ours = common.best(lambda: read_log(path, name="read"), 3)
        plain = common.best(lambda: plain_loop(path), 3)
        yield {"read_ratio": round(ours / plain, 3), "read_objects_per_s": round(72_000 / ours)}
        yield from by_format(folder, path)


def plain_loop(path: Path) -> int:
    """What a script would do: parse every message, touch every field that `read` needs, keep the numbers."""
    from mcap.reader import make_reader
    from osi3.osi_groundtruth_pb2 import GroundTruth

    rows = []
    with path.open("rb") as file:
        for _schema, _channel, message in make_reader(file).iter_messages():
            truth = GroundTruth.FromString(message.data)
            t = truth.timestamp.seconds * 10**9 + truth.timestamp.nanos
            for item in truth.moving_object:
                base = item.base
                rows.append(
                    (t, item.id.value, item.type, item.vehicle_classification.type,
                     base.position.x, base.position.y, base.position.z, base.orientation.yaw,
                     base.velocity.x, base.velocity.y,
                     base.dimension.length, base.dimension.width, base.dimension.height)
                )  # fmt: skip
    return len(pd.DataFrame(rows))
