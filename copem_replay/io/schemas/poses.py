"""Poses over time: odometry, stamped poses, and transforms between frames of reference, by the schemas that are known.

Sources: the message definitions of nav_msgs, geometry_msgs and tf2_msgs; foxglove.FrameTransform, FrameTransforms,
PoseInFrame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.io.channel import ENCODINGS, Channel, schema_name
from copem_replay.io.encodings import make_definition
from copem_replay.io.encodings.columns import list_level, shred_messages
from copem_replay.io.findings import FARTHEST_M, FASTEST_MPS, Finding, find
from copem_replay.io.stamps import find_stamp_paths, parse_nanoseconds, settle_stamps


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
_TRANSFORMS = replace(_TRANSFORM, inside="transforms[].")
_POSE = PoseFields("timestamp", "frame_id", "pose.position", "pose.orientation")
POSES = _ROS | {
    f"{package}{name}": where
    for package in ("foxglove.", "foxglove_msgs/msg/")
    for name, where in (("FrameTransform", _TRANSFORM), ("FrameTransforms", _TRANSFORMS), ("PoseInFrame", _POSE))
}
ODOMETRY = "nav_msgs/msg/Odometry"


def is_static(channel: Channel) -> bool:
    """Whether the channel holds static transforms: each holds for ever, as in tf2, until it is sent again."""
    return channel.topic.endswith("tf_static")


def is_pose(channel: Channel) -> bool:
    """Whether the channel holds poses of a schema in `POSES`, in an encoding that is read."""
    return schema_name(channel) in POSES and channel.encoding in ENCODINGS


@dataclass(frozen=True)
class Poses:
    """K poses in the order of the messages: of `child` ("": not named) in `frame`."""

    stamp_ns: Int
    position_m: Float  # (K, 3)
    rotation: Float  # (K, 4) unit quaternions x, y, z, w
    velocity_mps: Float  # (K, 2) ahead and to the left, NaN: not stated
    frame: tuple[str, ...]
    child: tuple[str, ...]
    log_time_ns: Int
    notes: tuple[Finding, ...] = ()  # what was left out, or is not stated

    def take(self, rows: Int) -> Poses:
        """The poses at these indices or in this mask."""
        names = ("stamp_ns", "position_m", "rotation", "velocity_mps", "log_time_ns")
        frame, child = (tuple(np.array(texts, dtype=object)[rows]) for texts in (self.frame, self.child))
        return replace(self, frame=frame, child=child, **{name: getattr(self, name)[rows] for name in names})


def decode_poses(channel: Channel, payloads: Sequence[bytes], log_time_ns: Int) -> Poses:
    """The poses of a channel, without those that are none: not finite, too far, or no rotation.

    Raises DefinitionError, KeyError.
    """
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
    notes = list(find("undecoded", int((~shredded.decoded).sum())))
    logged_ns, stamp_ns, stamped = log_time_ns[message], log_time_ns[message], np.zeros(len(message), dtype=bool)
    if stamps:
        stated_ns, stamped, impossible = parse_nanoseconds([level.texts[s] for s in stamps], "s")
        stamp_ns = np.where(stamped, stated_ns - channel.ahead_ns, logged_ns)
        notes += find("stamp impossible", impossible, noun="pose")
    if stamps and not is_static(channel):  # of static ones stamps say nothing: the last one logged holds
        stamp_ns, findings = _settle_each(stamp_ns, stamped, logged_ns, level.texts[names[-1]].code, channel.ahead_ns)
        notes += findings
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(columns[:, 3:7], axis=1)
        near = (np.abs(columns[:, :3]) <= FARTHEST_M).all(axis=1)
        velocity = columns[:, 7:9] if where.velocity is not None else np.full((len(columns), 2), np.nan)
        moves = np.abs(velocity).max(axis=1, initial=0.0) <= FASTEST_MPS
    valid = near & (length > 0.5) & (length < 2.0)
    notes += find("pose", int((~valid).sum()))
    notes += find("pose velocity", int((valid & ~moves).sum()) if where.velocity is not None else 0)
    poses = Poses(
        stamp_ns,
        columns[:, :3],
        columns[:, 3:7] / np.where(valid, length, 1.0)[:, None],
        np.where(moves[:, None], velocity, np.nan),
        tuple(texts[0]),
        tuple(texts[1]) if where.child else ("",) * len(columns),
        logged_ns,
        tuple(notes),
    )
    return poses if valid.all() else poses.take(np.flatnonzero(valid))


def _settle_each(
    stamp_ns: Int, stamped: Bool, log_time_ns: Int, frame: Int, ahead_ns: int
) -> tuple[Int, Iterator[Finding]]:
    """The stamps (K,) of the poses, settled frame by frame (each has its own sender), and findings."""
    settled_ns, counts = stamp_ns.copy(), Counter[str]()
    for number in np.unique(frame):
        rows = np.flatnonzero(frame == number)
        settled_ns[rows], _, _, findings = settle_stamps(
            stamp_ns[rows], stamped[rows], log_time_ns[rows], ahead_ns=ahead_ns
        )
        for finding in findings:
            counts[finding.rule] += finding.number
    return settled_ns, (line for rule, count in counts.items() for line in find(rule, count, noun="pose"))
