"""ROS 2 messages for tests, serialised by rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from tests.helpers.recordings import Topic, ns

STORE = get_typestore(Stores.ROS2_JAZZY)


def made(kind: str, **fields: Any) -> Any:
    """A message of a type; what is not given is 0 or empty."""
    message = STORE.types[kind]
    given = {}
    for name, node in STORE.fielddefs[kind][1]:
        given[name] = fields[name] if name in fields else _empty(node)
    return message(**given)


def _empty(node: Any) -> Any:
    kind, detail = node
    if kind == 1:
        return "" if detail[0] == "string" else False if detail[0] == "bool" else 0
    if kind == 2:
        return made(detail)
    if kind == 3:
        return np.zeros(detail[1])
    inner, what = detail[0]
    return np.zeros(0, dtype=np.uint8) if inner == 1 and what[0] != "string" else []


def header(t_s: float, frame: str) -> Any:
    stamp = made("builtin_interfaces/msg/Time", sec=ns(t_s) // 10**9, nanosec=ns(t_s) % 10**9)
    return made("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def pose(x: float, y: float, z: float = 0.0, yaw_deg: float = 0.0) -> Any:
    half = np.deg2rad(yaw_deg) / 2
    return made(
        "geometry_msgs/msg/Pose",
        position=made("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=made("geometry_msgs/msg/Quaternion", z=float(np.sin(half)), w=float(np.cos(half))),
    )


def transform(t_s: float, parent: str, child: str, x: float, y: float, yaw_deg: float = 0.0) -> Any:
    at = pose(x, y, 0.0, yaw_deg)
    where = made(
        "geometry_msgs/msg/Transform",
        translation=made("geometry_msgs/msg/Vector3", x=x, y=y),
        rotation=at.orientation,
    )
    return made("geometry_msgs/msg/TransformStamped", header=header(t_s, parent), child_frame_id=child, transform=where)


def odometry(t_s: float, x: float, y: float, yaw_deg: float = 0.0, speed: float = 0.0, frame: str = "map") -> Any:
    twist = made("geometry_msgs/msg/Twist", linear=made("geometry_msgs/msg/Vector3", x=speed))
    return made(
        "nav_msgs/msg/Odometry",
        header=header(t_s, frame),
        child_frame_id="base_link",
        pose=made("geometry_msgs/msg/PoseWithCovariance", pose=pose(x, y, 0.0, yaw_deg)),
        twist=made("geometry_msgs/msg/TwistWithCovariance", twist=twist),
    )


def topic(name: str, kind: str, messages: Sequence[tuple[float, Any]]) -> Topic:
    """A channel of messages of one type, logged at these seconds."""
    text, _ = STORE.generate_msgdef(kind, ros_version=2)
    payloads = [(ns(t_s), bytes(STORE.serialize_cdr(message, kind))) for t_s, message in messages]
    return Topic(name, kind, payloads, encoding="cdr", definition=("ros2msg", text.encode()))
