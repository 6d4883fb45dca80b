"""The recordings that `fuzz.py` hits: those of the project, those beside it, and small ones of other kinds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing.mcap_model import Channel, Message, Sample, Schema, taken_apart

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (ROOT / "logs", ROOT.parent / "shared" / "data")


def samples(most: int, *, own: bool = False) -> list[Sample]:
    """All samples, `most` messages of each channel; `own`: none that is not part of the project."""
    folders = FOLDERS[:1] if own else FOLDERS
    paths = {p.name: p for folder in folders for p in sorted(folder.glob("*.mcap"))}
    found = [taken_apart(path, most) for _, path in sorted(paths.items())]
    return [*found, json_updates(), protobuf_updates(), markers(), poses_and_lists()]


def _sample(name: str, topics: list[tuple[str, str, str, str, bytes, list[bytes]]]) -> Sample:
    """Of (topic, encoding, schema, schema's encoding, schema's data, payloads), 0.1 s apart."""
    made = Sample(name, [], [], [])
    for number, (topic, encoding, schema, how, data, _) in enumerate(topics, 1):
        made.schemas.append(Schema(number, schema.encode(), how.encode(), data))
        made.channels.append(Channel(number, number, topic.encode(), encoding.encode()))
    for k in range(max(len(t[-1]) for t in topics)):
        for number, topic_ in enumerate(topics, 1):
            if k < len(topic_[-1]):
                made.messages.append(Message(number, k, k * 10**8, k * 10**8, topic_[-1][k]))
    return made


def json_updates() -> Sample:
    payloads = [
        json.dumps(
            {
                "deletions": [],
                "entities": [
                    {
                        "timestamp": {"sec": k // 10, "nsec": k % 10 * 10**8},
                        "frame_id": "map",
                        "id": f"car {i}",
                        "metadata": [{"key": "class", "value": "car"}],
                        "cubes": [
                            {
                                "pose": {
                                    "position": {"x": 1.5 * k, "y": 4.0 * i, "z": 0.7},
                                    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                                },
                                "size": {"x": 4.5, "y": 1.8, "z": 1.5},
                                "color": {"r": 1, "g": 0, "b": 0, "a": 1},
                            }
                        ],
                    }
                    for i in range(3)
                ],
            }
        ).encode()
        for k in range(20)
    ]
    schema = json.dumps({"title": "foxglove.SceneUpdate", "type": "object"}).encode()
    return _sample("json", [("/objects", "json", "foxglove.SceneUpdate", "jsonschema", schema, payloads)])


def protobuf_updates() -> Sample:
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
    from mcap_protobuf.schema import build_file_descriptor_set

    payloads, transforms = [], []
    for k in range(20):
        update = SceneUpdate()
        for i in range(3):
            entity = update.entities.add(frame_id="base_link", id=f"{i}")
            entity.timestamp.FromNanoseconds(k * 10**8)
            cube = entity.cubes.add()
            cube.pose.position.x, cube.pose.position.y, cube.pose.orientation.w = 2.0 * k, 3.0 * i, 1.0
            cube.size.x, cube.size.y, cube.size.z = 4.0, 2.0, 1.5
        payloads.append(update.SerializeToString())
        transform = FrameTransform(parent_frame_id="map", child_frame_id="base_link")
        transform.timestamp.FromNanoseconds(k * 10**8)
        transform.translation.x, transform.rotation.w = 1.0 * k, 1.0
        transforms.append(transform.SerializeToString())
    definitions = [build_file_descriptor_set(kind).SerializeToString() for kind in (SceneUpdate, FrameTransform)]
    return _sample(
        "protobuf",
        [
            ("/objects", "protobuf", "foxglove.SceneUpdate", "protobuf", definitions[0], payloads),
            ("/tf", "protobuf", "foxglove.FrameTransform", "protobuf", definitions[1], transforms),
        ],
    )


def _ros() -> tuple[Any, Any]:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)

    def make(name: str, **values: Any) -> Any:
        """A message, its fields that are not given as 0."""
        kind = store.types[name]
        fields = {}
        for field, (node, detail) in store.fielddefs[name][1]:
            if field in values:
                fields[field] = values[field]
            elif node == 1:
                fields[field] = "" if detail[0] == "string" else 0
            elif node == 2:
                fields[field] = make(detail)
            elif node == 3 and detail[0][0] == 1:
                fields[field] = np.zeros(detail[1], dtype=detail[0][1][0])
            else:
                item = detail[0]
                fields[field] = np.zeros(0, dtype=item[1][0]) if item[0] == 1 and item[1][0] != "string" else []
        return kind(**fields)

    return store, make


def _definition(store: Any, name: str) -> bytes:
    definition, _ = store.generate_msgdef(name, ros_version=2)
    return str(definition).encode()


def markers() -> Sample:
    store, make = _ros()
    name, payloads = "visualization_msgs/msg/MarkerArray", []
    for k in range(20):
        header = make(
            "std_msgs/msg/Header", frame_id="map", stamp=make("builtin_interfaces/msg/Time", sec=k, nanosec=5)
        )
        cubes = [
            make(
                "visualization_msgs/msg/Marker",
                header=header,
                ns="car",
                id=i,
                type=1,
                pose=make(
                    "geometry_msgs/msg/Pose",
                    position=make("geometry_msgs/msg/Point", x=1.0 * k, y=3.0 * i),
                    orientation=make("geometry_msgs/msg/Quaternion", w=1.0),
                ),
                scale=make("geometry_msgs/msg/Vector3", x=4.0, y=2.0, z=1.5),
            )
            for i in range(3)
        ]
        payloads.append(bytes(store.serialize_cdr(make(name, markers=cubes), name)))
    return _sample("markers", [("/markers", "cdr", name, "ros2msg", _definition(store, name), payloads)])


def poses_and_lists() -> Sample:
    """Cubes in the frame of a vehicle whose transforms and odometry are there, too."""
    store, make = _ros()
    listed = markers()
    quaternion = make("geometry_msgs/msg/Quaternion", w=1.0)
    odometry, transforms = [], []
    for k in range(20):
        stamp = make("builtin_interfaces/msg/Time", sec=k, nanosec=5)
        header = make("std_msgs/msg/Header", frame_id="map", stamp=stamp)
        pose = make(
            "geometry_msgs/msg/Pose", position=make("geometry_msgs/msg/Point", x=1.0 * k), orientation=quaternion
        )
        name = "nav_msgs/msg/Odometry"
        covered = make("geometry_msgs/msg/PoseWithCovariance", pose=pose)
        odometry.append(
            bytes(store.serialize_cdr(make(name, header=header, child_frame_id="base", pose=covered), name))
        )
        moved = make(
            "geometry_msgs/msg/Transform", translation=make("geometry_msgs/msg/Vector3", x=0.1), rotation=quaternion
        )
        one = make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id="base", transform=moved)
        name = "tf2_msgs/msg/TFMessage"
        transforms.append(bytes(store.serialize_cdr(make(name, transforms=[one]), name)))
    schema = listed.schemas[0]
    return _sample(
        "poses",
        [
            ("/markers", "cdr", schema.name.decode(), "ros2msg", schema.data, [m.data for m in listed.messages]),
            *(
                (topic, "cdr", name, "ros2msg", _definition(store, name), payloads)
                for topic, name, payloads in (
                    ("/odom", "nav_msgs/msg/Odometry", odometry),
                    ("/tf", "tf2_msgs/msg/TFMessage", transforms),
                )
            ),
        ],
    )
