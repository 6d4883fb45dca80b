"""From the channels of a recording to the columns of its lists, whatever they are encoded in, in one world.

OSI is decoded by modules of its own. All else is described by where its messages have what (`formats.fields`); its
lists may be in any frame of reference that the recording places, and its ego comes from odometry.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import EgoError, RecordingError
from copem_replay.core.rotation import turned, yaw_of
from copem_replay.core.text import counted
from copem_replay.core.tracks import CLASSES, VALUES, Float
from copem_replay.io.channel import Channel, schema_name
from copem_replay.io.encodings.definition import definition_of
from copem_replay.io.encodings.raw_values import DefinitionError
from copem_replay.io.log import Log
from copem_replay.io.schemas.decoded import LAST_NS, Columns
from copem_replay.io.schemas.object_lists import Description, Fields, FieldsError, Listed, listed
from copem_replay.io.schemas.pose_schemas import ODOMETRY, is_pose
from copem_replay.io.schemas.poses import Poses, poses_of
from copem_replay.io.schemas.registry import description_of
from copem_replay.io.transforms import Course, Frames, course_of

if TYPE_CHECKING:
    from copem_replay.io.config import EgoTopic

EGO = "ego"
"""Id of an ego that is no object of any list."""
NOMINAL_M = (4.5, 1.8, 1.5)
"""Box of an ego whose size nobody says (chosen: a car), to hide others with; gaps to it are not given."""
_SHOWN = 12  # frames named in an error (chosen)
_X, _Y, _Z, _YAW, _VX, _VY = range(6)


@dataclass(frozen=True)
class Messages:
    """Payloads of channels, by their numbers: in the order read, with the times they were logged."""

    payloads: Mapping[int, list[bytes]]
    log_time_ns: Mapping[int, list[int]]
    skipped: int = 0  # messages that were logged at a time that cannot be

    def notes(self) -> tuple[str, ...]:
        """Say what was skipped."""
        return (f"{counted(self.skipped, 'message')} logged at an impossible time: skipped",) if self.skipped else ()


def gathered(log: Log, numbers: frozenset[int]) -> Messages:
    """All messages of some channels. Raises BrokenIndexError."""
    payloads: dict[int, list[bytes]] = {number: [] for number in numbers}
    times: dict[int, list[int]] = {number: [] for number in numbers}
    skipped = 0
    for number, log_time_ns, payload in log.payloads(numbers):
        if log_time_ns > LAST_NS:
            skipped += 1
            continue
        payloads[number].append(payload)
        times[number].append(log_time_ns)
    return Messages(payloads, times, skipped)


@dataclass(frozen=True)
class Surroundings:
    """What a recording says of places: its frames of reference, and the course of the ego."""

    frames: Frames
    ego: Course | None
    asked: EgoTopic | None
    notes: tuple[str, ...]

    def world_for(self, frame: str) -> str:
        """The frame that all is brought into, where lists are in `frame`."""
        return self.ego.parent if self.ego is not None else self.frames.world_of(frame)

    def world_of(self, found: Listed) -> str:
        """The frame that lists are brought into, "" where nobody names one."""
        said = found.frame_code[found.frame_code >= 0]
        return self.world_for(found.frames[said[0]].lstrip("/") if len(said) else "")


def surroundings(log: Log, asked: EgoTopic | None, *, seek_ego: bool) -> Surroundings:
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
        frames.add(poses, static=channel.topic.endswith("tf_static"))
    chosen = _ego_channel(log, channels, asked, seek_ego)
    if chosen is not None and not found.payloads[chosen.number]:
        raise EgoError(f"no pose on topic {chosen.topic!r}{_there(log)}", path=log.path)
    if chosen is None or chosen.number not in of_channel:
        return Surroundings(frames, None, asked, tuple(notes))
    poses = of_channel[chosen.number]
    child = asked.frame if asked is not None else None
    picked = None if child is None else np.array([name == child.lstrip("/") for name in poses.child], dtype=bool)
    children = sorted(set(poses.child))
    if picked is None and len(children) > 1:
        raise EgoError(
            f"{chosen.topic} has poses of several frames; choose with `frame`: {', '.join(children[:_SHOWN])}",
            path=log.path,
        )
    course = course_of(poses, picked)
    if course is None:
        of = f" of frame {child!r}" if child else ""
        raise EgoError(f"no pose on topic {chosen.topic!r}{of}{_there(log)}", path=log.path)
    return Surroundings(frames, course, asked, (*notes, *_on_ego(chosen, asked)))


def _there(log: Log) -> str:
    return "" if log.window is None else " in the window"


def _bare(poses: Poses) -> Poses:
    """Names of frames as they are known: `/map` is `map`."""
    return replace(
        poses, frame=tuple(n.lstrip("/") for n in poses.frame), child=tuple(n.lstrip("/") for n in poses.child)
    )


def _ego_channel(log: Log, channels: Sequence[Channel], asked: EgoTopic | None, seek_ego: bool) -> Channel | None:
    if asked is not None:
        mine = [c for c in channels if c.topic == asked.topic]
        if not mine:
            there = ", ".join(f"{c.topic} ({c.schema})" for c in channels) or "none"
            raise EgoError(f"no poses on topic {asked.topic!r}; poses are on: {there}", path=log.path)
        return mine[0]
    odometry = [c for c in channels if schema_name(c) == ODOMETRY]
    return odometry[0] if seek_ego and len(odometry) == 1 else None


def _on_ego(chosen: Channel, asked: EgoTopic | None) -> Iterator[str]:
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


def lists_of(log: Log, channels: Sequence[Channel], fields: Fields | None) -> Listed:
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
    return replace(lists, columns=replace(lists.columns, notes=(*lists.columns.notes, *found.notes())))


def in_world(found: Listed, around: Surroundings, path: Path, topic: str) -> Listed:
    """The same lists in the world; states at instants at which their frame is nowhere are left out, and said.

    Raises RecordingError, naming `path` and `topic`, where the recording does not say how frames lie to each other.
    """
    names = [name.lstrip("/") for name in found.frames]
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
        values[rows, _X : _Z + 1] = turned(placed.rotation[back], values[rows, _X : _Z + 1]) + placed.position_m[back]
        yaw = yaw_of(placed.rotation)[back]
        cos, sin = np.cos(yaw), np.sin(yaw)
        values[rows, _YAW] += yaw
        vx, vy = values[rows, _VX].copy(), values[rows, _VY].copy()
        values[rows, _VX], values[rows, _VY] = cos * vx - sin * vy, sin * vx + cos * vy
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


def with_ego(columns: Columns, around: Surroundings) -> Columns:
    """The ego added to every list at whose instant it has a place."""
    course, asked = around.ego, around.asked
    if course is None:
        return columns
    placed = course.at(columns.stamp_ns)
    length, width, height = asked.size_m if asked is not None and asked.size_m is not None else NOMINAL_M
    ahead = (asked.centre_from_rear_axle_m if asked is not None else None) or 0.0
    centre = placed.position_m + turned(placed.rotation, np.array([ahead, 0.0, height / 2]))
    yaw = yaw_of(placed.rotation)
    rows = np.full((len(yaw), len(VALUES)), np.nan)
    rows[:, : _Z + 1], rows[:, _YAW] = centre, yaw
    rows[:, -3:] = length, width, height
    after = np.searchsorted(course.stamp_ns, columns.stamp_ns).clip(0, len(course.stamp_ns) - 1)
    vx, vy = course.velocity_mps[after].T
    rows[:, _VX], rows[:, _VY] = vx * np.cos(yaw) - vy * np.sin(yaw), vx * np.sin(yaw) + vy * np.cos(yaw)
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
        values=_stacked(columns.values, rows[mine])[order],
        hosts=(name,),
    )


def _stacked(first: Float, second: Float) -> Float:
    return np.concatenate([first, second])
