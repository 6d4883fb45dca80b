"""Formats known by name: definitions as the packages have them (as far as they matter), values by hand."""

import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.json_format import ParseDict
from mcap_protobuf.schema import build_file_descriptor_set

from copem_replay.core.tracks import CLASSES
from copem_replay.io.encodings.cdr import CdrDefinition
from copem_replay.io.encodings.columns import Definition
from copem_replay.io.encodings.json import JsonDefinition
from copem_replay.io.encodings.protobuf import ProtobufDefinition
from copem_replay.io.schemas.formats import description
from copem_replay.io.schemas.object_lists import DecodedLists, decode_lists
from copem_replay.io.schemas.registry import SCHEMAS
from tests.helpers.messages import SEPARATOR, classes, ids, quaternion, serialised, values

COMMON = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point32": "float32 x\nfloat32 y\nfloat32 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Accel": "Vector3 linear\nVector3 angular",
    "geometry_msgs/AccelWithCovariance": "Accel accel\nfloat64[36] covariance",
    "geometry_msgs/Polygon": "geometry_msgs/Point32[] points",
    "unique_identifier_msgs/UUID": "uint8[16] uuid",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a",
}
HEADER = {"stamp": {"sec": 1533151603, "nanosec": 547590000}, "frame_id": "map"}
STAMP = 1533151603547590000


def text_of(first: str, **others: str) -> str:
    """The definition of a message with those it needs, and many it does not."""
    parts = [f"MSG: {name.replace('__', '/')}\n{text}" for name, text in {**others, **COMMON}.items()]
    return ("\n" + SEPARATOR).join([first, *parts]) + "\n"


def written(name: str, text: str, *messages: dict[str, Any], encoding: str = "ros2msg", idl: str = "") -> DecodedLists:
    """Serialised by rosbags; the package of `text` is called p."""
    text = text.replace("MSG: p/", f"MSG: {name.split('/')[0]}/")
    definition = CdrDefinition(name, encoding, (idl or text).encode())
    payloads = [serialised(text, m, name=name) for m in messages]
    made = SCHEMAS[name].description(definition.offers())
    return decode_lists(definition, made, payloads, np.arange(len(payloads), dtype=np.int64))


def xyz(x: float = 0, y: float = 0, z: float = 0) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def matrix(*diagonal: float) -> list[float]:
    return [diagonal[k // 7] if k % 7 == 0 and k // 7 < len(diagonal) else 0.0 for k in range(36)]


# ------------------------------------------------------------------------------------------------ Autoware

KINDS = "uint8 UNKNOWN = 0\nuint8 CAR = 1\nuint8 label\nfloat32 probability"
SHAPE = "uint8 BOUNDING_BOX=0\nuint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions"
KINEMATICS = {
    "Detected": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance\nbool has_position_covariance\n"
        "uint8 orientation_availability\ngeometry_msgs/TwistWithCovariance twist_with_covariance\nbool has_twist\n"
        "bool has_twist_covariance"
    ),
    "Tracked": (
        "geometry_msgs/PoseWithCovariance pose_with_covariance\n"
        "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance\nuint8 orientation_availability\n"
        "bool is_stationary"
    ),
    "Predicted": (
        "geometry_msgs/PoseWithCovariance initial_pose_with_covariance\n"
        "geometry_msgs/TwistWithCovariance initial_twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance initial_acceleration_with_covariance\nPath[] predicted_paths"
    ),
}
ZERO = [0.0] * 36


def autoware(kind: str) -> str:
    ident = "" if kind == "Detected" else "unique_identifier_msgs/UUID object_id\n"
    types = {
        "p__Object": (
            f"{ident}float32 existence_probability\nKind[] classification\nKinematics kinematics\nShape shape"
        ),
        "p__Kind": KINDS,
        "p__Kinematics": KINEMATICS[kind],
        "p__Shape": SHAPE,
        "p__Path": "geometry_msgs/Pose[] path\nbuiltin_interfaces/Duration time_step\nfloat32 confidence",
    }
    return text_of("std_msgs/Header header\nObject[] objects", **types)


def autoware_object(kind: str, number: int, **changes: Any) -> dict[str, Any]:
    pose = {
        "pose": {"position": xyz(10, 20, 0.75), "orientation": quaternion(math.pi / 2)},
        "covariance": matrix(0.25, 0.5),
    }
    pose["covariance"][1] = pose["covariance"][6] = 0.1
    twist = {"twist": {"linear": xyz(5, 1), "angular": xyz()}, "covariance": ZERO}
    accel = {"accel": {"linear": xyz(), "angular": xyz()}, "covariance": ZERO}
    path = {"path": [pose["pose"]] * 2, "time_step": {"sec": 0, "nanosec": 5}, "confidence": 1.0}
    kinematics = {
        "pose_with_covariance": pose,
        "twist_with_covariance": twist,
        "acceleration_with_covariance": accel,
        "initial_pose_with_covariance": pose,
        "initial_twist_with_covariance": twist,
        "initial_acceleration_with_covariance": accel,
        "orientation_availability": changes.get("orientation", 2),
        "has_twist": changes.get("has_twist", True),
        "has_twist_covariance": False,
        "has_position_covariance": changes.get("has_covariance", True),
        "is_stationary": False,
        "predicted_paths": [path] * number,
    }
    return {
        "object_id": {"uuid": [number] * 16},
        "existence_probability": 0.5,
        "classification": changes.get(
            "classification", [{"label": 7, "probability": 0.75}, {"label": 6, "probability": 0.25}]
        ),
        "kinematics": kinematics,
        "shape": changes.get("shape", {"type": 0, "footprint": {"points": []}, "dimensions": xyz(4, 2, 1.5)}),
    }


@pytest.mark.parametrize("kind", ["Detected", "Tracked", "Predicted"])
@pytest.mark.parametrize("package", ["autoware_perception_msgs", "autoware_auto_perception_msgs"])
def test_autoware(package: str, kind: str) -> None:
    objects = [autoware_object(kind, 1), autoware_object(kind, 2, classification=[{"label": 3, "probability": 1.0}])]
    message = {"header": HEADER, "objects": objects}
    found = written(f"{package}/msg/{kind}Objects", autoware(kind), message, {**message, "objects": []})
    assert found.columns.rows.tolist() == [2, 0]
    assert found.columns.stamp_ns.tolist() == [STAMP, STAMP]
    assert found.columns.stamped.all()
    assert found.frames == ("map",)
    assert [values(found, n)[0] for n in ("x_m", "y_m", "z_m", "yaw_rad")] == [10, 20, 0.75, math.pi / 2]
    assert [values(found, n)[0] for n in ("vx_mps", "vy_mps")] == [-1, 5]  # along the object, which looks north
    assert [values(found, n)[0] for n in ("length_m", "width_m", "height_m")] == [4, 2, 1.5]
    assert classes(found) == ["pedestrian", "bus"]
    assert found.probability[0, CLASSES.index("bicycle")] == pytest.approx(0.25)
    assert found.existence.tolist() == [0.5, 0.5]
    np.testing.assert_allclose(found.covariance_m2[0], [0.25, 0.1, 0.5])
    assert ids(found) == (["0", "1"] if kind == "Detected" else ["01" * 16, "02" * 16])
    assert noted(found) == ()


def test_autoware_says_what_it_does_not_know() -> None:
    objects = [
        autoware_object("Detected", 1),
        autoware_object("Detected", 2, orientation=0, has_twist=False, has_covariance=False),
    ]
    name = "autoware_perception_msgs/msg/DetectedObjects"
    found = written(name, autoware("Detected"), {"header": HEADER, "objects": objects})
    assert values(found, "vx_mps") == [-1, None]
    assert values(found, "yaw_rad") == [math.pi / 2] * 2
    assert np.isnan(found.covariance_m2).all(axis=1).tolist() == [False, True]
    assert noted(found) == ("1 object state that does not say its heading: as written",)


def test_autoware_shapes() -> None:
    corners = [xyz(-1, -0.5), xyz(2, -0.5), xyz(2, 1.5), xyz(-1, 1.5)]
    shapes = [
        {"type": 1, "footprint": {"points": []}, "dimensions": xyz(0.6, 0.6, 1.8)},
        {"type": 2, "footprint": {"points": corners}, "dimensions": xyz(0, 0, 1.2)},
    ]
    objects = [autoware_object("Tracked", k, shape=shape) for k, shape in enumerate(shapes)]
    name = "autoware_perception_msgs/msg/TrackedObjects"
    found = written(name, autoware("Tracked"), {"header": HEADER, "objects": objects})
    assert values(found, "length_m") == [0.6, 3]
    assert values(found, "width_m") == [0.6, 2]
    assert values(found, "height_m") == [1.8, 1.2]
    assert values(found, "x_m") == [10, 9.5]  # half a metre to its left, and it looks north
    assert values(found, "y_m") == [20, 20.5]


def test_autoware_auto_as_idl() -> None:
    """The package is defined in IDL; rosbag2 records it so, file after file."""
    package = "autoware_auto_perception_msgs"
    geometry = {
        "Point": "double x; double y; double z;",
        "Point32": "float x; float y; float z;",
        "Vector3": "double x; double y; double z;",
        "Quaternion": "@default (value=0.0) double x; @default (value=0.0) double y; double z; double w;",
        "Pose": "geometry_msgs::msg::Point position; geometry_msgs::msg::Quaternion orientation;",
        "PoseWithCovariance": "geometry_msgs::msg::Pose pose; double__36 covariance;",
        "Twist": "geometry_msgs::msg::Vector3 linear; geometry_msgs::msg::Vector3 angular;",
        "TwistWithCovariance": "geometry_msgs::msg::Twist twist; double__36 covariance;",
        "Accel": "geometry_msgs::msg::Vector3 linear; geometry_msgs::msg::Vector3 angular;",
        "AccelWithCovariance": "geometry_msgs::msg::Accel accel; double__36 covariance;",
        "Polygon": "sequence<geometry_msgs::msg::Point32> points;",
    }
    own = {
        "TrackedObjects": f"std_msgs::msg::Header header; sequence<{package}::msg::TrackedObject> objects;",
        "TrackedObject": (
            "unique_identifier_msgs::msg::UUID object_id;\n@range (min=0.0, max=1.0)\nfloat existence_probability;\n"
            f"sequence<{package}::msg::ObjectClassification> classification;\n"
            f"{package}::msg::TrackedObjectKinematics kinematics; {package}::msg::Shape shape;"
        ),
        "ObjectClassification": "uint8 label; float probability;",
        "TrackedObjectKinematics": (
            "geometry_msgs::msg::PoseWithCovariance pose_with_covariance;\n@default (value=0)\n"
            "uint8 orientation_availability;\n"
            "geometry_msgs::msg::TwistWithCovariance twist_with_covariance;\n"
            "geometry_msgs::msg::AccelWithCovariance acceleration_with_covariance;\nboolean is_stationary;"
        ),
        "Shape": "uint8 type; geometry_msgs::msg::Polygon footprint; geometry_msgs::msg::Vector3 dimensions;",
    }

    def module(package: str, name: str, body: str) -> str:
        before = "typedef double double__36[36];" if "double__36" in body else ""
        before += "typedef uint8 uint8__16[16];" if "uint8__16" in body else ""
        if name == "ObjectClassification":
            before += " module ObjectClassification_Constants { const uint8 UNKNOWN = 0; const uint8 CAR = 1; };"
        note = '@verbatim (language="comment", text=\n "A list of them." "\\n" "It\'s << long.")'
        return (
            f'{SEPARATOR}IDL: {package}/msg/{name}\n// generated\n#include "std_msgs/msg/Header.idl"\n'
            f"module {package} {{\n  module msg {{\n {before}\n{note}\n    struct {name} {{ {body} }};\n  }};\n}};\n"
        )

    idl = "".join(module(package, name, body) for name, body in own.items())
    idl += "".join(module("geometry_msgs", name, body) for name, body in geometry.items())
    idl += module("std_msgs", "Header", "builtin_interfaces::msg::Time stamp; string frame_id;")
    idl += module("builtin_interfaces", "Time", "int32 sec; uint32 nanosec;")
    idl += module("unique_identifier_msgs", "UUID", "uint8__16 uuid;")
    in_msg = autoware("Tracked").replace(
        KINEMATICS["Tracked"],
        "geometry_msgs/PoseWithCovariance pose_with_covariance\nuint8 orientation_availability\n"
        "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance\nbool is_stationary",
    )
    message = {"header": HEADER, "objects": [autoware_object("Tracked", k) for k in (1, 2)]}
    found = written(f"{package}/msg/TrackedObjects", in_msg, message, encoding="ros2idl", idl=idl)
    assert ids(found) == ["01" * 16, "02" * 16]
    assert found.columns.stamp_ns.tolist() == [STAMP]
    assert values(found, "x_m") == [10, 10]
    assert values(found, "vy_mps") == [5, 5]
    assert values(found, "length_m") == [4, 4]
    assert classes(found) == ["pedestrian"] * 2


# ------------------------------------------------------------------------------------------------ vision_msgs

BOX = {"p__Box": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size"}
BOX_SAID = {"center": {"position": xyz(1, 2, 3), "orientation": quaternion(0.5)}, "size": xyz(4, 2, 1.5)}


def test_detections_of_vision_msgs() -> None:
    text = text_of(
        "std_msgs/Header header\nDetection3D[] detections",
        p__Detection3D="std_msgs/Header header\nResult[] results\nBox bbox\nstring id",
        p__Result="Hypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
        p__Hypothesis="string class_id\nfloat64 score",
        **BOX,
    )
    pose = {"pose": BOX_SAID["center"], "covariance": matrix(0.5, 2)}
    results = [
        {"hypothesis": {"class_id": "car", "score": 0.5}, "pose": pose},
        {"hypothesis": {"class_id": "VEHICLE_TRUCK", "score": 0.25}, "pose": pose},
    ]
    detections = [
        {"header": HEADER, "results": results, "bbox": BOX_SAID, "id": "17"},
        {"header": HEADER, "results": [], "bbox": BOX_SAID, "id": "18"},
    ]
    name = "vision_msgs/msg/Detection3DArray"
    found = written(name, text, {"header": HEADER, "detections": detections})
    assert ids(found) == ["17", "18"]
    assert classes(found) == ["car", "other"]
    assert found.probability[0, CLASSES.index("truck")] == pytest.approx(1 / 3)
    np.testing.assert_array_equal(found.existence, [0.5, np.nan])
    np.testing.assert_array_equal(found.covariance_m2, [[0.5, 0, 2], [np.nan] * 3])
    assert values(found, "yaw_rad") == [0.5, 0.5]
    assert values(found, "vx_mps") == [None, None]
    assert [values(found, n)[0] for n in ("x_m", "z_m", "length_m", "height_m")] == [1, 3, 4, 1.5]
    unnamed = [{**d, "id": ""} for d in detections]
    assert ids(written(name, text, {"header": HEADER, "detections": unnamed})) == ["0", "1"]


@pytest.mark.parametrize(("ident", "label"), [("string", "person"), ("int64", 3)])
def test_detections_of_old_vision_msgs(ident: str, label: Any) -> None:
    """As of Foxy; before, classes were numbers, and nobody says of what."""
    text = text_of(
        "std_msgs/Header header\nDetection3D[] detections",
        p__Detection3D="std_msgs/Header header\nResult[] results\nBox bbox\nbool is_tracking\nstring tracking_id",
        p__Result=f"{ident} id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose",
        **BOX,
    )
    pose = {"pose": BOX_SAID["center"], "covariance": ZERO}
    detection = {"header": HEADER, "results": [{"id": label, "score": 0.5, "pose": pose}], "bbox": BOX_SAID}
    detection |= {"is_tracking": True, "tracking_id": "t1"}
    found = written("vision_msgs/msg/Detection3DArray", text, {"header": HEADER, "detections": [detection]})
    assert ids(found) == ["t1"]
    assert classes(found) == ["pedestrian" if ident == "string" else "other"]
    assert found.existence.tolist() == [0.5]


# ------------------------------------------------------------------------------------------------ others


def test_derived_objects() -> None:
    text = text_of(
        "std_msgs/Header header\nObject[] objects",
        p__Object=(
            "std_msgs/Header header\nuint32 id\nuint8 detection_level\nbool object_classified\n"
            "geometry_msgs/Pose pose\n"
            "geometry_msgs/Twist twist\ngeometry_msgs/Accel accel\ngeometry_msgs/Polygon polygon\nSolid shape\n"
            "uint8 classification\nuint8 classification_certainty\nuint32 classification_age"
        ),
        p__Solid="uint8 BOX=1\nuint8 type\nfloat64[<=3] dimensions\ngeometry_msgs/Polygon polygon",
    )
    still = {"linear": xyz(), "angular": xyz()}
    item = {
        "header": HEADER,
        "id": 4294967295,
        "detection_level": 2,
        "object_classified": True,
        "pose": {"position": xyz(1, 2, 3), "orientation": quaternion(math.pi / 2)},
        "twist": {"linear": xyz(5, 1), "angular": xyz()},
        "accel": still,
        "polygon": {"points": [xyz()] * 3},
        "shape": {"type": 1, "dimensions": [4, 2, 1.5], "polygon": {"points": []}},
        "classification": 4,
        "classification_certainty": 255,
        "classification_age": 0,
    }
    round_ = {
        kind: {**item, "id": kind, "shape": {**item["shape"], "type": kind, "dimensions": dimensions}}
        for kind, dimensions in ((2, [0.5]), (3, [1.8, 0.25]), (4, [0.75, 0.2]))
    }
    other = {**item, "id": 7, "shape": {**item["shape"], "dimensions": []}, "classification": 9}
    solids = written("derived_object_msgs/msg/ObjectArray", text, {"header": HEADER, "objects": [*round_.values()]})
    assert values(solids, "length_m") == values(solids, "width_m") == [1, 0.5, 0.4]  # a sphere, a cylinder, a cone
    assert values(solids, "height_m") == [1, 1.8, 0.75]
    message = {"header": HEADER, "objects": [item, other]}
    found = written("derived_object_msgs/msg/ObjectArray", text, message)
    assert ids(found) == ["4294967295", "7"]
    assert classes(found) == ["pedestrian", "vehicle"]
    assert values(found, "vx_mps") == [5, 5]  # along the axes of the list
    assert values(found, "length_m") == [4, None]
    assert values(found, "height_m") == [1.5, None]


def noted(found: DecodedLists) -> tuple[str, ...]:
    """Its notes, but that messages have no time stamp."""
    return tuple(note for note in found.columns.notes if "without timestamp" not in note)


def test_markers() -> None:
    text = text_of(
        "Marker[] markers",
        p__Marker=(
            "int32 CUBE=1\nstd_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\n"
            "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n"
            "builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\nstring text"
        ),
    )

    def marker(ns: str, ident: int, kind: int, action: int) -> dict[str, Any]:
        return {
            "header": HEADER,
            "ns": ns,
            "id": ident,
            "type": kind,
            "action": action,
            "pose": BOX_SAID["center"],
            "scale": BOX_SAID["size"],
            "color": {"r": 1, "g": 1, "b": 1, "a": 1},
            "lifetime": {"sec": 0, "nanosec": 0},
            "frame_locked": False,
            "points": [xyz(1, 1)] * ident,
            "text": "a cube",
        }

    markers = [marker("", 0, 0, 3), marker("car", 1, 1, 0), marker("pedestrian", 1, 1, 0), marker("car", 2, 9, 0)]
    found = written("visualization_msgs/msg/MarkerArray", text, {"markers": markers}, {"markers": []})
    assert ids(found) == ["car/1", "pedestrian/1"] * 2  # they stay until they are deleted
    assert classes(found) == ["car", "pedestrian"] * 2
    assert found.columns.rows.tolist() == [2, 2]
    assert found.columns.stamp_ns.tolist() == [STAMP, STAMP + 1]  # as it was logged, by the clock of the other
    assert found.columns.stamped.tolist() == [True, False]
    assert values(found, "length_m") == [4, 4] * 2
    assert noted(found) == ("2 object states of what stands, not sent again: where it was",)


# ------------------------------------------------------------------------------------------------ SceneUpdate


def scene(sec: str, nanosec: str) -> list[dict[str, Any]]:
    """A message with three entities, one with two cubes, one with none; and one that only deletes."""
    stamp = {sec: 1533151603, nanosec: 547590000}
    cube = {"pose": {"position": xyz(1, 2, 3), "orientation": quaternion(0.5)}, "size": xyz(4, 2, 1.5)}
    cube["color"] = {"r": 1, "g": 0.5, "b": 0, "a": 1}
    entity = {"timestamp": stamp, "frame_id": "map", "lifetime": {sec: 0, nanosec: 0}, "frame_locked": False}
    entities = [
        {**entity, "id": "a", "metadata": [{"key": "speed", "value": "van"}, {"key": "Class", "value": "car"}]},
        {**entity, "id": "b", "metadata": [{"key": "category", "value": "human.pedestrian.adult"}]},
        {**entity, "id": "c", "metadata": []},
    ]
    for item, cubes in zip(entities, ([cube], [cube, {**cube, "size": xyz(0.5, 0.6, 1.8)}], []), strict=True):
        item["cubes"] = cubes
    return [
        {"deletions": [], "entities": entities},
        {"deletions": [{"timestamp": stamp, "type": 1, "id": "a"}], "entities": []},
    ]


def in_ros2() -> tuple[Definition, list[bytes]]:
    text = text_of(
        "Deletion[] deletions\nEntity[] entities",
        p__Deletion="uint8 MATCHING_ID=0\nbuiltin_interfaces/Time timestamp\nuint8 type\nstring id",
        p__Entity=(
            "builtin_interfaces/Time timestamp\nstring frame_id\nstring id\nbuiltin_interfaces/Duration lifetime\n"
            "bool frame_locked\nKeyValuePair[] metadata\nCube[] cubes"
        ),
        p__KeyValuePair="string key\nstring value",
        p__Cube="geometry_msgs/Pose pose\ngeometry_msgs/Vector3 size\nstd_msgs/ColorRGBA color",
    )
    name = "foxglove_msgs/msg/SceneUpdate"
    text = text.replace("MSG: p/", "MSG: foxglove_msgs/")
    payloads = [serialised(text, m, name=name) for m in scene("sec", "nanosec")]
    return CdrDefinition(name, "ros2msg", text.encode()), payloads


def in_protobuf() -> tuple[Definition, list[bytes]]:
    files: FileDescriptorSet = build_file_descriptor_set(SceneUpdate)
    made = SimpleNamespace(id=1, name="foxglove.SceneUpdate", encoding="protobuf", data=files.SerializeToString())
    payloads = []
    for message in scene("seconds", "nanos"):
        update = SceneUpdate()
        for entity in message["entities"]:
            said = update.entities.add()
            ParseDict({k: v for k, v in entity.items() if k not in ("timestamp", "lifetime")}, said)
            said.timestamp.FromNanoseconds(STAMP)
        for deletion in message["deletions"]:
            update.deletions.add(id=deletion["id"], type=deletion["type"])
        payloads.append(update.SerializeToString())
    return ProtobufDefinition(made.name, made), payloads


def in_json() -> tuple[Definition, list[bytes]]:
    payloads = [json.dumps(m).encode() for m in scene("sec", "nsec")]
    return JsonDefinition(payloads), payloads


@pytest.mark.parametrize("encoded", [in_ros2, in_protobuf, in_json])
def test_scene_updates(encoded: Any) -> None:
    definition, payloads = encoded()
    found = decode_lists(definition, description(definition.offers()), payloads, np.array([5, 6]))
    assert ids(found) == ["a", "b"]
    assert classes(found) == ["car", "pedestrian"]
    assert found.columns.rows.tolist() == [2, 0]
    assert found.columns.stamp_ns.tolist() == [STAMP, STAMP + 1]
    assert found.columns.stamped.tolist() == [True, False]
    assert [found.frames[k] for k in found.frame_code] == ["map"] * 2
    assert values(found, "x_m") == [1, 1]
    assert values(found, "yaw_rad") == [0.5, 0.5]
    assert values(found, "length_m") == [4, 4]
    assert values(found, "height_m") == [1.5, 1.5]
    assert values(found, "vx_mps") == [None] * 2
    assert noted(found) == ("1 cube beside a larger one of the same entity: left out",)


def body(size: float, x: float = 0) -> dict[str, Any]:
    return {"pose": {"position": xyz(x, 0, 0), "orientation": quaternion(0)}, "size": xyz(size, size, size)}


def test_the_largest_cube_of_an_entity() -> None:
    """Those behind it in the list, too; of equal ones the first; one without a size is smallest."""
    cubes = [[body(1), body(3, 5), body(2)], [body(2, 6), body(2, 7)], [{**body(9), "size": {"x": 9}}, body(1, 8)]]
    entities = [{"id": str(k), "cubes": of} for k, of in enumerate(cubes)]
    definition = JsonDefinition(payloads := [json.dumps({"entities": entities}).encode()])
    found = decode_lists(definition, description(definition.offers()), payloads, np.array([5]))
    assert ids(found) == ["0", "1", "2"]
    assert values(found, "x_m") == [5, 6, 8]
    assert noted(found) == ("4 cubes beside a larger one of the same entity: left out",)


STANDS = "of what stands, not sent again: where it was"
UNSAID = "in between that no message repeats: not taken, a list holds what its message says"


@pytest.mark.parametrize(
    ("messages", "held", "notes"),
    [
        # An entity and its x; `-` deletes it, `*` all; `~` ends by itself.
        ("a0 b0|a0 b0|a0 b0", "ab|ab|ab", ()),  # as most do
        ("a0 b0|a0|a0", "ab|ab|ab", (f"2 object states {STANDS}",)),
        ("a0|b9|b9|a0", "a|ab|ab|ab", (f"3 object states {STANDS}",)),
        ("a0 b0|a0 -b|a0|a0 b0", "ab|a|a|ab", ()),
        ("a0 b0|*|b5|", "ab||b|b", (f"1 object state {STANDS}",)),
        ("a0 b0|* a1|a2", "ab|a|a", ()),  # all are deleted before those of the message come
        ("a0|a5||a10|", "a|a||a|", (f"1 state {UNSAID}",)),  # it drives: where it is between is not said, nor after
        ("a0|a5||a5||a5|-a|", "a|a|a|a|a|a||", (f"2 object states {STANDS}",)),
        ("~a0||b0", "a||b", ()),
    ],
)
def test_entities_that_are_not_said_again(messages: str, held: str, notes: tuple[str, ...]) -> None:
    said = []
    for k, message in enumerate(messages.split("|")):
        entities, deletions = [], []
        for text in message.split():
            name, stamp = text.strip("-~*0123456789"), {"sec": k, "nsec": 0}
            if text[0] in "-*":
                deletions.append({"timestamp": stamp, "type": int(text[0] == "*"), "id": name})
                continue
            lasts = {"sec": 0, "nsec": int(text[0] == "~")}
            cubes = [body(1, float(text.strip("~ab")))]
            entities.append({"id": name, "timestamp": stamp, "lifetime": lasts, "cubes": cubes})
        said.append(json.dumps({"entities": entities, "deletions": deletions}).encode())
    definition = JsonDefinition(said)
    logged = np.arange(len(said)) * 10**9
    found = decode_lists(definition, description(definition.offers()), said, logged)
    ends = np.cumsum(found.columns.rows)[:-1]
    names = np.array([found.columns.object_ids[k] for k in found.columns.object_ix])
    assert "|".join("".join(sorted(of)) for of in np.split(names, ends)) == held
    assert noted(found) == notes


def test_json_scenes_may_leave_out_much() -> None:
    cube = {"pose": {"position": xyz(1, 2, 3), "orientation": quaternion(0)}, "size": xyz(4, 2, 1.5)}
    payloads = [json.dumps({"entities": [{"cubes": [cube]}]}).encode()]
    definition = JsonDefinition(payloads)
    found = decode_lists(definition, description(definition.offers()), payloads, np.array([5]))
    assert classes(found) == ["other"]
    assert found.columns.stamp_ns.tolist() == [5]
    assert found.frames == ()


# ------------------------------------------------------------------------------------------------ ika

OBJECT_LIST = text_of(
    "std_msgs/Header header\nObject[] objects",
    p__Object="uint64 id\nfloat64 existence_probability\nState state\nState[] state_history\nPrediction[] predictions",
    p__State=(
        "std_msgs/Header header\nuint8 model_id\nuint64[] sensor_id\nfloat64[] continuous_state\n"
        "int64[] discrete_state\nfloat64[] continuous_state_covariance\nKind[] classifications\n"
        "ReferencePoint reference_point"
    ),
    p__Kind="uint8 CAR=4\nuint8 type\nfloat64 probability",
    p__ReferencePoint="uint8 value\ngeometry_msgs/Vector3 translation_to_geometric_center",
    p__Prediction="float64 probability\nState[] states",
)


def ika_object(number: int, model: int, state: list[float], covariance: list[float], kind: int) -> dict[str, Any]:
    """Its reference point is 1.4 m behind its centre, 0.2 m to the right of it and 0.75 m below."""
    point = {"value": 11, "translation_to_geometric_center": xyz(1.4, 0.2, 0.75)}
    of = {"header": HEADER, "model_id": model, "sensor_id": [7], "continuous_state": state, "reference_point": point,
          "continuous_state_covariance": covariance, "discrete_state": [0, 0, 0, 0],
          "classifications": [{"type": kind, "probability": 0.8}]}  # fmt: skip
    return {"id": number, "existence_probability": 0.7, "state": of, "state_history": [of], "predictions": []}


def test_object_list_of_ika() -> None:
    """States of both models, the same car to the north; of another model nothing is known."""
    spread = {size: [0.0] * size * size for size in (12, 16)}
    for size, cells in spread.items():
        cells[0], cells[1], cells[size], cells[size + 1] = 0.25, 0.1, 0.1, 0.5
    yaw = math.pi / 2
    iscactr = [10, 20, 0, 5, 1, 0, 0, yaw, 0, 1.8, 4.5, 1.5]
    hexamotion = [10, 20, 0, 5, 1, 0, 0, 0, 0, yaw, 0, 0, 0, 4.5, 1.8, 1.5]
    found = written(
        "perception_msgs/msg/ObjectList",
        OBJECT_LIST,
        {
            "header": HEADER,
            "objects": [
                ika_object(3, 16, iscactr, spread[12], 4),
                ika_object(4, 17, hexamotion, spread[16], 1),
                ika_object(5, 1, iscactr, spread[12], 4),
                ika_object(6, 16, iscactr, [], 4),
            ],
        },
    )
    assert ids(found) == ["3", "4", "5", "6"]
    assert classes(found) == ["car", "pedestrian", "car", "car"]
    assert values(found, "x_m") == [9.8, 9.8, None, 9.8]
    assert values(found, "y_m") == [21.4, 21.4, None, 21.4]
    assert values(found, "z_m")[0] == 0.75
    assert values(found, "yaw_rad") == [yaw, yaw, None, yaw]
    assert values(found, "vx_mps")[:2] == [-1.0, -1.0]
    assert values(found, "vy_mps")[:2] == [5.0, 5.0]
    sides = [values(found, f"{side}_m") for side in ("length", "width", "height")]
    assert [side[:2] for side in sides] == [[4.5, 4.5], [1.8, 1.8], [1.5, 1.5]]
    assert found.covariance_m2[:2].tolist() == [[0.25, 0.1, 0.5]] * 2
    assert np.isnan(found.covariance_m2[2:]).all()
    assert found.existence.tolist() == [0.7] * 4
    assert found.columns.stamp_ns.tolist() == [STAMP]


def test_what_is_known_by_name() -> None:
    scenes = {"foxglove.SceneUpdate", "foxglove_msgs/msg/SceneUpdate"}
    assert scenes < set(SCHEMAS)
    assert len(SCHEMAS) == 14 + len(scenes)
