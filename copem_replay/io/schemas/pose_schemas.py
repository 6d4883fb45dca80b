"""The schemas of poses that are known by name: where their messages have what.

Sources: nav_msgs, geometry_msgs, tf2_msgs (ROS 2); foxglove.FrameTransform, FrameTransforms, PoseInFrame.
"""

from __future__ import annotations

from dataclasses import dataclass

from copem_replay.io.channel import ENCODINGS, Channel, schema_name


@dataclass(frozen=True)
class PoseFields:
    """The fields of a schema; `inside`: the list that holds the poses, "" for the message itself."""

    stamp: str
    frame: str
    position: str
    rotation: str
    child: str | None = None
    inside: str = ""
    velocity: str | None = None  # along the child's axes


_ROS = {
    "nav_msgs/msg/Odometry": PoseFields(
        "header.stamp", "header.frame_id", "pose.pose.position", "pose.pose.orientation", "child_frame_id",
        velocity="twist.twist.linear",
    ),
    "geometry_msgs/msg/PoseStamped": PoseFields("header.stamp", "header.frame_id", "pose.position", "pose.orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": PoseFields(
        "header.stamp", "header.frame_id", "pose.pose.position", "pose.pose.orientation"
    ),
    "geometry_msgs/msg/TransformStamped": PoseFields(
        "header.stamp", "header.frame_id", "transform.translation", "transform.rotation", "child_frame_id"
    ),
    "tf2_msgs/msg/TFMessage": PoseFields(
        "header.stamp", "header.frame_id", "transform.translation", "transform.rotation", "child_frame_id",
        inside="transforms[].",
    ),
}  # fmt: skip
_TRANSFORM = PoseFields("timestamp", "parent_frame_id", "translation", "rotation", "child_frame_id")
_TRANSFORMS = PoseFields(
    "timestamp", "parent_frame_id", "translation", "rotation", "child_frame_id", inside="transforms[]."
)
_POSE = PoseFields("timestamp", "frame_id", "pose.position", "pose.orientation")
POSES = _ROS | {
    f"{package}{name}": where
    for package in ("foxglove.", "foxglove_msgs/msg/")
    for name, where in (("FrameTransform", _TRANSFORM), ("FrameTransforms", _TRANSFORMS), ("PoseInFrame", _POSE))
}
ODOMETRY = "nav_msgs/msg/Odometry"


def is_pose(channel: Channel) -> bool:
    """Whether the channel holds poses in a format that is known."""
    return schema_name(channel) in POSES and channel.encoding in ENCODINGS
