"""From the channels of a recording to the columns of its lists, whatever they are encoded in, in one world.

OSI is decoded by modules of its own. All else is described by where its messages have what
(`io/schemas/object_lists.py`); its lists may be in any frame of reference that the recording places, and its ego comes
from odometry (`io/ego_pose.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import EgoError, RecordingError
from copem_replay.core.rotation import turned, yaw_of
from copem_replay.core.text import counted
from copem_replay.io.channel import Channel
from copem_replay.io.ego_pose import ego_channel, ego_course, ego_notes, in_the_window
from copem_replay.io.encodings.definition import definition_of
from copem_replay.io.encodings.raw_values import DefinitionError
from copem_replay.io.log import Log
from copem_replay.io.messages import gathered
from copem_replay.io.schemas.decoded import VX, VY, YAW, X, Z
from copem_replay.io.schemas.object_lists import DecodedLists, Description, Fields, FieldsError, listed
from copem_replay.io.schemas.pose_schemas import is_pose
from copem_replay.io.schemas.poses import Poses, poses_of
from copem_replay.io.schemas.registry import description_of
from copem_replay.io.transforms import Frames, PoseTrack

if TYPE_CHECKING:
    from copem_replay.io.config import EgoTopic


@dataclass(frozen=True)
class LogContext:
    """What a recording says of places: its frames of reference, and the course of the ego."""

    frames: Frames
    ego: PoseTrack | None
    asked: EgoTopic | None
    notes: tuple[str, ...]
    own: Mapping[tuple[str, str], str] = field(default_factory=dict)  # `_own_names`

    def named(self, found: DecodedLists) -> list[str]:
        """The frames of lists as they are known here."""
        return [self.own.get((found.part, name.lstrip("/")), name.lstrip("/")) for name in found.frames]

    def world_of(self, found: DecodedLists) -> str:
        """The frame that lists are brought into, "" where no list names one."""
        said = found.frame_code[found.frame_code >= 0]
        frame = self.named(found)[said[0]] if len(said) else ""
        return self.ego.parent if self.ego is not None else self.frames.world_of(frame)


def log_context(log: Log, asked: EgoTopic | None, *, seek_ego: bool) -> LogContext:
    """The frames and the ego of a recording; `seek_ego`: the only odometry is the ego's, if nothing is `asked`.

    Raises RecordingError: no such topic; BrokenIndexError.
    """
    channels = [c for c in log.channels if is_pose(c) and c.messages]
    found = gathered(log, frozenset(c.number for c in channels))
    frames, notes = Frames(), list(found.notes())
    of_channel: dict[int, Poses] = {}
    for channel in channels:
        if not found.payloads[channel.number]:  # none in the window
            continue
        try:
            poses = _bare(
                poses_of(
                    channel, found.payloads[channel.number], np.array(found.log_time_ns[channel.number], dtype=np.int64)
                )
            )
        except (DefinitionError, KeyError) as error:
            notes.append(f"topic {channel.topic} ({channel.schema}) not read: {error}")
            continue
        of_channel[channel.number] = poses
    part_of = {channel.number: channel.part for channel in channels}
    own = _own_names({(part_of[number], child) for number, poses in of_channel.items() for child in poses.child})
    for channel in channels:
        if channel.number in of_channel:
            of_channel[channel.number] = _renamed(of_channel[channel.number], channel.part, own)
            frames.add(of_channel[channel.number], static=channel.topic.endswith("tf_static"))
    chosen = ego_channel(log, channels, asked, seek_ego)
    if chosen is None:
        return LogContext(frames, None, asked, tuple(notes), own)
    if not found.payloads[chosen.number]:
        raise EgoError(f"no pose on topic {chosen.topic!r}{in_the_window(log)}", path=log.path)
    if chosen.number not in of_channel:  # which is among the notes
        return LogContext(frames, None, asked, tuple(notes), own)
    if asked is not None and asked.frame is not None:
        asked = asked.model_copy(update={"frame": own.get((chosen.part, asked.frame.lstrip("/")), asked.frame)})
    course = ego_course(log, chosen.topic, of_channel[chosen.number], asked)
    return LogContext(frames, course, asked, (*notes, *ego_notes(chosen, asked)), own)


def _bare(poses: Poses) -> Poses:
    """Names of frames as they are known: `/map` is `map`."""
    return replace(
        poses, frame=tuple(n.lstrip("/") for n in poses.frame), child=tuple(n.lstrip("/") for n in poses.child)
    )


def _own_names(children: Set[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """Frames that several recordings of one drive place, each in its own way, by recording and name: named after it.

    A frame that none places, or one alone, is the same for all: they share the world.
    """
    times = Counter(child for _, child in children if child)
    return {(part, child): f"{part}:{child}" for part, child in children if times[child] > 1}


def _renamed(poses: Poses, part: str, own: Mapping[tuple[str, str], str]) -> Poses:
    frame, child = (tuple(own.get((part, name), name) for name in names) for names in (poses.frame, poses.child))
    return replace(poses, frame=frame, child=child)


def lists_of(log: Log, channels: Sequence[Channel], fields: Fields | None) -> DecodedLists:
    """The lists on channels of one topic and schema. Raises RecordingError, BrokenIndexError."""
    found = gathered(log, frozenset(c.number for c in channels))
    payloads = [p for c in channels for p in found.payloads[c.number]]
    times = np.array([t for c in channels for t in found.log_time_ns[c.number]], dtype=np.int64)
    channel = channels[0]
    try:
        definition = definition_of(channel, payloads)
        description = Description(fields) if fields is not None else description_of(channel, definition.offers())
        lists = listed(definition, description, payloads, times)
    except (DefinitionError, FieldsError) as error:
        raise RecordingError(str(error), path=log.path, topic=channel.topic) from None
    columns = lists.columns
    stamp_ns = columns.stamp_ns - np.where(columns.stamped, channel.ahead_ns, 0)
    return replace(
        lists, part=channel.part, columns=replace(columns, stamp_ns=stamp_ns, notes=(*columns.notes, *found.notes()))
    )


def in_world(found: DecodedLists, around: LogContext, path: Path, topic: str) -> DecodedLists:
    """The same lists in the world; states at instants at which their frame is nowhere are left out, and said.

    Raises RecordingError, naming `path` and `topic`, where the recording does not say how frames lie to each other.
    """
    names = around.named(found)
    if not len(found.frame_code) or not names:
        return found
    world = around.world_of(found)
    message = np.repeat(np.arange(len(found.columns.stamp_ns)), found.columns.rows)
    values, covariance = found.columns.values.copy(), found.covariance_m2.copy()
    there = np.ones(len(values), dtype=bool)
    notes = []
    for code, name in enumerate(names):
        rows = np.flatnonzero(found.frame_code == code)
        if not len(rows) or name in (world, "") or not world:
            continue
        stamps, back = np.unique(found.columns.stamp_ns[message[rows]], return_inverse=True)
        placed = around.frames.place(name, world, stamps)
        if placed is None:
            raise RecordingError(
                f"lists are in the frame {name!r}, the ego in {world!r}, and no transform of the recording "
                "says how they lie",
                path=path,
                topic=topic,
            )
        values[rows, X : Z + 1] = turned(placed.rotation[back], values[rows, X : Z + 1]) + placed.position_m[back]
        yaw = yaw_of(placed.rotation)[back]
        cos, sin = np.cos(yaw), np.sin(yaw)
        values[rows, YAW] += yaw
        vx, vy = values[rows, VX].copy(), values[rows, VY].copy()
        values[rows, VX], values[rows, VY] = cos * vx - sin * vy, sin * vx + cos * vy
        xx, xy, yy = covariance[rows].T
        covariance[rows] = np.stack(
            [
                cos * cos * xx - 2 * cos * sin * xy + sin * sin * yy,
                cos * sin * (xx - yy) + (cos * cos - sin * sin) * xy,
                sin * sin * xx + 2 * cos * sin * xy + cos * cos * yy,
            ],
            axis=1,
        )
        there[rows] = placed.there[back]
        notes.append(f"lists in the frame {name}: brought into {world}")
        if lost := int((~placed.there[back]).sum()):
            notes.append(f"{counted(lost, 'object state')} at instants at which {name} has no place: skipped")
    columns = found.columns
    columns = replace(
        columns,
        rows=np.bincount(message[there], minlength=len(columns.rows)),
        object_ix=columns.object_ix[there],
        class_ix=columns.class_ix[there],
        values=values[there],
        notes=(*columns.notes, *notes),
    )
    return replace(
        found,
        columns=columns,
        frame_code=found.frame_code[there],
        existence=found.existence[there],
        covariance_m2=covariance[there],
        probability=found.probability[there],
    )
