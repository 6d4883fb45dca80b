"""The ego of a recording whose lists do not hold it: from odometry, stamped poses or transforms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import EgoError
from copem_replay.core.rotation import turned, yaw_of
from copem_replay.core.tracks import CLASSES, VALUES
from copem_replay.io.channel import Channel, schema_name
from copem_replay.io.log import Log
from copem_replay.io.schemas.decoded import VX, VY, YAW, DecodedObjects, Z
from copem_replay.io.schemas.pose_schemas import ODOMETRY
from copem_replay.io.transforms import PoseTrack, pose_track_of

if TYPE_CHECKING:
    from copem_replay.io.config import EgoTopic
    from copem_replay.io.schemas.poses import Poses

EGO = "ego"
"""Id of an ego that is no object of any list."""
NOMINAL_M = (4.5, 1.8, 1.5)
"""Box of an ego without a stated size (chosen: a car), which hides others; gaps to it are not given."""
_SHOWN = 12  # frames named in an error (chosen)


def ego_channel(log: Log, channels: Sequence[Channel], asked: EgoTopic | None, seek_ego: bool) -> Channel | None:
    """The channel of the ego's poses: the one that is `asked` for, else the only odometry, if it is to be sought.

    Raises EgoError: no poses are on the topic that is asked for.
    """
    if asked is not None:
        mine = [c for c in channels if c.topic == asked.topic]
        if not mine:
            there = ", ".join(f"{c.topic} ({c.schema})" for c in channels) or "none"
            raise EgoError(f"no poses on topic {asked.topic!r}; poses are on: {there}", path=log.path)
        return mine[0]
    odometry = [c for c in channels if schema_name(c) == ODOMETRY]
    return odometry[0] if seek_ego and len(odometry) == 1 else None


def ego_course(log: Log, topic: str, poses: Poses, asked: EgoTopic | None) -> PoseTrack:
    """The course of the ego, of the frame that is asked for. Raises EgoError: no pose, or poses of several frames."""
    child = asked.frame if asked is not None else None
    picked = None if child is None else np.array([name == child.lstrip("/") for name in poses.child], dtype=bool)
    children = sorted(set(poses.child))
    if picked is None and len(children) > 1:
        raise EgoError(
            f"{topic} has poses of several frames; choose with `frame`: {', '.join(children[:_SHOWN])}", path=log.path
        )
    course = pose_track_of(poses, picked)
    if course is None:
        of = f" of frame {child!r}" if child else ""
        raise EgoError(f"no pose on topic {topic!r}{of}{in_the_window(log)}", path=log.path)
    return course


def in_the_window(log: Log) -> str:
    """The end of a message on what is missing, where only a window of the log is read."""
    return "" if log.window is None else " in the window"


def ego_notes(chosen: Channel, asked: EgoTopic | None) -> Iterator[str]:
    """What is assumed of the ego, a line each."""
    if asked is None:
        yield f"the ego is where {chosen.topic} ({chosen.schema}) says"
    if asked is None or asked.centre_from_rear_axle_m is None:
        yield (
            "ego: its poses are taken for the centre of its box; they are often those of the rear axle: "
            f"`ego: {{topic: {chosen.topic}, centre_from_rear_axle_m: …}}`"
        )
    if asked is None or asked.size_m is None:
        size = " × ".join(f"{side:g}" for side in NOMINAL_M)
        yield f"ego: no size is said (`size_m: [length, width, height]`): {size} m taken to hide others, gaps are null"


def with_ego(columns: DecodedObjects, course: PoseTrack | None, asked: EgoTopic | None) -> DecodedObjects:
    """The ego added to every list at whose instant it has a place; without a course the same columns."""
    if course is None:
        return columns
    placed = course.at(columns.stamp_ns)
    length, width, height = asked.size_m if asked is not None and asked.size_m is not None else NOMINAL_M
    ahead = (asked.centre_from_rear_axle_m if asked is not None else None) or 0.0
    centre = placed.position_m + turned(placed.rotation, np.array([ahead, 0.0, height / 2]))
    yaw = yaw_of(placed.rotation)
    rows = np.full((len(yaw), len(VALUES)), np.nan)
    rows[:, : Z + 1], rows[:, YAW] = centre, yaw
    rows[:, -3:] = length, width, height
    after = np.searchsorted(course.stamp_ns, columns.stamp_ns).clip(0, len(course.stamp_ns) - 1)
    vx, vy = course.velocity_mps[after].T
    rows[:, VX], rows[:, VY] = vx * np.cos(yaw) - vy * np.sin(yaw), vx * np.sin(yaw) + vy * np.cos(yaw)
    mine = np.flatnonzero(placed.there)
    message = np.concatenate([np.repeat(np.arange(len(yaw)), columns.rows), mine])
    order = np.argsort(message, kind="stable")
    number = len(columns.object_ids)
    name = EGO if EGO not in columns.object_ids else f"{EGO} vehicle"
    return replace(
        columns,
        rows=columns.rows + placed.there,
        object_ids=(*columns.object_ids, name),
        moving=np.append(columns.moving, True),
        object_ix=np.append(columns.object_ix, np.full(len(mine), number))[order],
        class_ix=np.append(columns.class_ix, np.full(len(mine), CLASSES.index("car"), dtype=np.int8))[order],
        values=np.concatenate([columns.values, rows[mine]])[order],
        hosts=(name,),
    )
