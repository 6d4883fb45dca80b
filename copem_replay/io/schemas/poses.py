"""Poses over time: odometry, stamped poses, and transforms between frames of reference, by the schemas that are known.

Sources: the message definitions of nav_msgs, geometry_msgs and tf2_msgs; foxglove.FrameTransform, FrameTransforms,
PoseInFrame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Float, Int
from copem_replay.io.channel import ENCODINGS, LAST_NS, Channel, schema_name
from copem_replay.io.encodings import make_definition
from copem_replay.io.encodings.columns import list_level, shred_messages


@dataclass(frozen=True)
class PoseFields:
    """The fields of a schema of poses; `inside`: the list that holds the poses, "" for the message itself."""

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
    """Whether the channel holds poses of a schema in `POSES`, in an encoding that is read."""
    return schema_name(channel) in POSES and channel.encoding in ENCODINGS


_FARTHEST_M = 1e9
"""A larger coordinate is no position: it is far more than the diameter of the earth."""


@dataclass(frozen=True)
class Poses:
    """K poses in the order of the messages: of `child` ("": not named) in `frame`."""

    stamp_ns: Int
    position_m: Float  # (K, 3)
    rotation: Float  # (K, 4) unit quaternions x, y, z, w
    velocity_mps: Float  # (K, 2) ahead and to the left, NaN: not stated
    frame: tuple[str, ...]
    child: tuple[str, ...]


def decode_poses(channel: Channel, payloads: Sequence[bytes], log_time_ns: Int) -> Poses:
    """The poses of a channel, without those that are not finite, too far or no rotation.

    Raises DefinitionError, KeyError.
    """
    from copem_replay.io.schemas.description import find_stamp_paths  # pydantic, which no recording without poses needs

    where = POSES[schema_name(channel)]
    definition = make_definition(channel, payloads)
    p = where.inside
    numbers = [f"{p}{where.position}.{axis}" for axis in "xyz"] + [f"{p}{where.rotation}.{axis}" for axis in "xyzw"]
    if where.velocity is not None:
        numbers += [f"{p}{where.velocity}.{axis}" for axis in "xy"]
    names = [f"{p}{where.frame}"] + ([f"{p}{where.child}"] if where.child else [])
    stamps = find_stamp_paths(definition.offers(), f"{p}{where.stamp}")
    shredded = shred_messages(definition, payloads, numbers, [*names, *stamps])
    level = shredded.levels[list_level(numbers[0])]
    message = level.parent if where.inside else np.arange(len(level.parent))
    message = shredded.levels[""].parent[message]
    columns = np.stack([level.numbers[n] for n in numbers], axis=1)
    texts = [np.array([*level.texts[n].words, ""], dtype=object)[level.texts[n].code] for n in names]
    parts = [level.texts[s] for s in stamps]
    seconds = [np.array([*(_whole_number(w) for w in part.words), 0], dtype=np.int64)[part.code] for part in parts]
    has_stamps = len(seconds) == 2
    stamp_ns = seconds[0] * 1_000_000_000 + seconds[1] - channel.ahead_ns if has_stamps else log_time_ns[message]
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(columns[:, 3:7], axis=1)
        near = (np.abs(columns[:, :3]) <= _FARTHEST_M).all(axis=1)
    good = np.isfinite(columns[:, :7]).all(axis=1) & near & (length > 0.5) & (length < 2.0)
    velocity = columns[:, 7:9] if where.velocity is not None else np.full((len(columns), 2), np.nan)
    return Poses(
        stamp_ns[good],
        columns[good, :3],
        columns[good, 3:7] / length[good, None],
        velocity[good],
        tuple(texts[0][good]),
        tuple(texts[1][good]) if where.child else ("",) * int(good.sum()),
    )


_LAST_SECOND = LAST_NS // 10**9
"""A larger number of seconds is read as 0."""


def _whole_number(word: str) -> int:
    """Seconds or nanoseconds of a time stamp; 0 for a text that is none."""
    try:
        number = int(word)
    except ValueError:
        return 0
    return number if abs(number) < _LAST_SECOND else 0
