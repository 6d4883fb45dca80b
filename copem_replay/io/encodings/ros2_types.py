"""Definitions of the ROS 2 messages that are written, and read where a recorder has left them out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from copem_replay.core.errors import RecordingError
from copem_replay.io.channel import Channel, DefinitionError, schema_name

_FIELDS: dict[str, str] = {
    "builtin_interfaces/Time": "int32 sec; uint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec; uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp; string frame_id",
    "std_msgs/String": "string data",
    "geometry_msgs/Point": "float64 x; float64 y; float64 z",
    "geometry_msgs/Point32": "float32 x; float32 y; float32 z",
    "geometry_msgs/Vector3": "float64 x; float64 y; float64 z",
    "geometry_msgs/Quaternion": "float64 x 0; float64 y 0; float64 z 0; float64 w 1",
    "geometry_msgs/Polygon": "geometry_msgs/Point32[] points",
    "geometry_msgs/Pose": "geometry_msgs/Point position; geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose; float64[36] covariance",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear; geometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist; float64[36] covariance",
    "geometry_msgs/Accel": "geometry_msgs/Vector3 linear; geometry_msgs/Vector3 angular",
    "geometry_msgs/AccelWithCovariance": "geometry_msgs/Accel accel; float64[36] covariance",
    "autoware_perception_msgs/DetectedObjects": (
        "std_msgs/Header header; autoware_perception_msgs/DetectedObject[] objects"
    ),
    "autoware_perception_msgs/DetectedObject": (
        "float32 existence_probability; autoware_perception_msgs/ObjectClassification[] classification; "
        "autoware_perception_msgs/DetectedObjectKinematics kinematics; autoware_perception_msgs/Shape shape"
    ),
    "autoware_perception_msgs/TrackedObjects": (
        "std_msgs/Header header; autoware_perception_msgs/TrackedObject[] objects"
    ),
    "autoware_perception_msgs/TrackedObject": (
        "unique_identifier_msgs/UUID object_id; float32 existence_probability; "
        "autoware_perception_msgs/ObjectClassification[] classification; "
        "autoware_perception_msgs/TrackedObjectKinematics kinematics; autoware_perception_msgs/Shape shape"
    ),
    "autoware_perception_msgs/TrackedObjectKinematics": (
        "uint8 UNAVAILABLE=0; uint8 SIGN_UNKNOWN=1; uint8 AVAILABLE=2; "
        "geometry_msgs/PoseWithCovariance pose_with_covariance; "
        "geometry_msgs/TwistWithCovariance twist_with_covariance; "
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance; uint8 orientation_availability; "
        "bool is_stationary"
    ),
    "autoware_perception_msgs/ObjectClassification": (
        "uint8 UNKNOWN = 0; uint8 CAR = 1; uint8 TRUCK = 2; uint8 BUS = 3; uint8 TRAILER = 4; uint8 MOTORCYCLE = 5; "
        "uint8 BICYCLE = 6; uint8 PEDESTRIAN = 7; uint8 ANIMAL = 8; uint8 HAZARD = 9; uint8 OVER_DRIVABLE = 10; "
        "uint8 UNDER_DRIVABLE = 11; uint8 label; float32 probability"
    ),
    "autoware_perception_msgs/DetectedObjectKinematics": (
        "uint8 UNAVAILABLE=0; uint8 SIGN_UNKNOWN=1; uint8 AVAILABLE=2; "
        "geometry_msgs/PoseWithCovariance pose_with_covariance; bool has_position_covariance; "
        "uint8 orientation_availability; geometry_msgs/TwistWithCovariance twist_with_covariance; bool has_twist; "
        "bool has_twist_covariance"
    ),
    "autoware_perception_msgs/Shape": (
        "uint8 BOUNDING_BOX=0; uint8 CYLINDER=1; uint8 POLYGON=2; uint8 type; geometry_msgs/Polygon footprint; "
        "geometry_msgs/Vector3 dimensions"
    ),
    "unique_identifier_msgs/UUID": "uint8[16] uuid",
    "foxglove_msgs/SceneUpdate": "foxglove_msgs/SceneEntityDeletion[] deletions; foxglove_msgs/SceneEntity[] entities",
    "foxglove_msgs/SceneEntityDeletion": (
        "builtin_interfaces/Time timestamp; uint8 MATCHING_ID=0; uint8 ALL=1; uint8 type; string id"
    ),
    "foxglove_msgs/SceneEntity": (
        "builtin_interfaces/Time timestamp; string frame_id; string id; builtin_interfaces/Duration lifetime; "
        "bool frame_locked; foxglove_msgs/KeyValuePair[] metadata; foxglove_msgs/ArrowPrimitive[] arrows; "
        "foxglove_msgs/CubePrimitive[] cubes; foxglove_msgs/SpherePrimitive[] spheres; "
        "foxglove_msgs/CylinderPrimitive[] cylinders; foxglove_msgs/LinePrimitive[] lines; "
        "foxglove_msgs/TriangleListPrimitive[] triangles; foxglove_msgs/TextPrimitive[] texts; "
        "foxglove_msgs/ModelPrimitive[] models"
    ),
    "foxglove_msgs/FrameTransform": (
        "builtin_interfaces/Time timestamp; string parent_frame_id; string child_frame_id; "
        "geometry_msgs/Vector3 translation; geometry_msgs/Quaternion rotation"
    ),
    "foxglove_msgs/Color": "float64 r; float64 g; float64 b; float64 a",
    "foxglove_msgs/KeyValuePair": "string key; string value",
    "foxglove_msgs/ArrowPrimitive": (
        "geometry_msgs/Pose pose; float64 shaft_length; float64 shaft_diameter; float64 head_length; "
        "float64 head_diameter; foxglove_msgs/Color color"
    ),
    "foxglove_msgs/CubePrimitive": "geometry_msgs/Pose pose; geometry_msgs/Vector3 size; foxglove_msgs/Color color",
    "foxglove_msgs/SpherePrimitive": "geometry_msgs/Pose pose; geometry_msgs/Vector3 size; foxglove_msgs/Color color",
    "foxglove_msgs/CylinderPrimitive": (
        "geometry_msgs/Pose pose; geometry_msgs/Vector3 size; float64 bottom_scale; float64 top_scale; "
        "foxglove_msgs/Color color"
    ),
    "foxglove_msgs/LinePrimitive": (
        "uint8 LINE_STRIP=0; uint8 LINE_LOOP=1; uint8 LINE_LIST=2; uint8 type; geometry_msgs/Pose pose; "
        "float64 thickness; bool scale_invariant; geometry_msgs/Point[] points; foxglove_msgs/Color color; "
        "foxglove_msgs/Color[] colors; uint32[] indices"
    ),
    "foxglove_msgs/TriangleListPrimitive": (
        "geometry_msgs/Pose pose; geometry_msgs/Point[] points; foxglove_msgs/Color color; "
        "foxglove_msgs/Color[] colors; uint32[] indices"
    ),
    "foxglove_msgs/TextPrimitive": (
        "geometry_msgs/Pose pose; bool billboard; float64 font_size; bool scale_invariant; foxglove_msgs/Color color; "
        "string text"
    ),
    "foxglove_msgs/ModelPrimitive": (
        "geometry_msgs/Pose pose; geometry_msgs/Vector3 scale; foxglove_msgs/Color color; bool override_color; "
        "string url; string media_type; uint8[] data"
    ),
    "copem_replay_msgs/Status": "builtin_interfaces/Time stamp; copem_replay_msgs/ObjectStatus[] objects",
    "copem_replay_msgs/ObjectStatus": "string id; string status; float64 age_s",
}
"""The fields of each type, constants among them."""
_RULE = "=" * 80


def list_fields(name: str) -> list[tuple[str, str]]:
    """The type and the name of each field of a type (`package/Type`), without constants."""
    return [(kind, field) for kind, field, *_ in map(str.split, (f for f in _FIELDS[name].split("; ") if "=" not in f))]


def message_definition(name: str) -> bytes:
    """The definition of a message type (`package/msg/Type`) with those of all types in it."""
    types = [name.replace("/msg/", "/")]
    for each in types:  # grows as it goes
        inside = (field.split()[0].split("[")[0] for field in _FIELDS[each].split("; "))
        types += [kind for kind in dict.fromkeys(inside) if "/" in kind and kind not in types]
    first, *others = (_FIELDS[each].replace("; ", "\n") + "\n" for each in types)
    return "".join([first, *(f"{_RULE}\nMSG: {n}\n{t}" for n, t in zip(types[1:], others, strict=True))]).encode()


def known_types(name: str) -> dict[str, Any]:
    """The types of a message (`package/msg/Type`) whose schema has no definition. Raises DefinitionError: not known."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if name.replace("/msg/", "/") in _FIELDS:
        return get_types_from_msg(message_definition(name).decode(), name)
    common = get_typestore(Stores.ROS2_JAZZY).fielddefs
    if name not in common:
        raise DefinitionError(
            f"its schema has no definition: the recorder lacked the package of {name}; `read: {{definitions: FOLDER}}` "
            "names a folder that has it"
        )
    return dict(common)


def define_channels(channels: Sequence[Channel], folder: str) -> tuple[Channel, ...]:
    """The channels, those of ROS 2 without a definition with that in a folder of packages (`package/msg/Type.msg`).

    Raises RecordingError: no such file there, or one that is no definition.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, types = get_typestore(Stores.EMPTY), dict(get_typestore(Stores.ROS2_JAZZY).fielddefs)
    path, defined = Path(folder), list[Channel]()
    try:
        for path in sorted(Path(folder).rglob("*.msg")) or [Path(folder)]:
            types |= get_types_from_msg(path.read_text(), f"{path.parent.parent.name}/msg/{path.stem}")
        store.register(types)
        for channel in channels:
            name, text = schema_name(channel), channel.schema_data
            if channel.encoding == "cdr" and not text.strip() and name in types:
                text = store.generate_msgdef(name, ros_version=2)[0].encode()
            defined.append(replace(channel, schema_data=text))
    except Exception as error:  # whatever a parser raises at what is no definition
        why = " ".join(str(error).split())[:200] or type(error).__name__
        expected = "expected definitions of messages in a folder, `package/msg/Type.msg`"
        raise RecordingError(f"{expected}, found none ({why})", path=path, key=("read", "definitions")) from None
    return tuple(defined)
