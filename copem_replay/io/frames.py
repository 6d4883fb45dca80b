"""Frames of reference of a recording, its ego's poses, and its object lists transformed into one world.

A frame is placed by the transforms and the odometry in the recording. Between two samples positions are interpolated
linearly and rotations along the short arc; a frame has no place before the first sample, after the last one, and in a
gap longer than `max_gap_s`. A transform with a single sample, or on a topic of static ones, holds for ever.

OSI's messages need none of this, they are in the world: `io/schemas/osi_ground_truth.py`. Lists of all other formats
are decoded by a description of their fields (`io/schemas/object_lists.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import EgoError, RecordingError, count_noun
from copem_replay.core.interpolation import compose_rotations, invert_rotation, rotate_vectors, yaw_of
from copem_replay.core.tracks import CLASSES, VALUES, Bool, Float, Int
from copem_replay.io.channel import Channel, DefinitionError, schema_name
from copem_replay.io.encodings import make_definition
from copem_replay.io.findings import VX, VY, YAW, X, Z, find
from copem_replay.io.ground_truth import MAX_GAP_S, DecodedObjects
from copem_replay.io.log import Log, gather_messages
from copem_replay.io.schemas.object_lists import (
    ClassField,
    DecodedLists,
    Description,
    Fields,
    FieldsError,
    decode_lists,
)
from copem_replay.io.schemas.poses import ODOMETRY, Poses, decode_poses, is_pose, is_static
from copem_replay.io.schemas.registry import describe_channel, may_stay
from copem_replay.io.stamps import find_runs
from copem_replay.io.window import Window

if TYPE_CHECKING:
    from copem_replay.io.config import EgoTopic


BODY_M = 5.0
"""Farthest that the frame of a vehicle is from the middle of its box: at its rear axle, at its front."""


@dataclass(frozen=True)
class SampledPoses:
    """Poses at K instants: `there (K,)` whether there is one, `position_m (K, 3)`, `rotation (K, 4)` as x, y, z, w."""

    there: Bool
    position_m: Float
    rotation: Float


@dataclass(frozen=True)
class PoseTrack:
    """Samples of one pose over time, in order of time, each instant once."""

    parent: str
    stamp_ns: Int
    position_m: Float
    rotation: Float
    velocity_mps: Float
    max_gap_s: float = MAX_GAP_S  # nothing is interpolated over a longer gap

    def at(self, stamp_ns: Int, *, forever: bool = False) -> SampledPoses:
        """The poses at instants (K,), between samples; `there`: known then. `forever`: the last sample always holds."""
        if forever or len(self.stamp_ns) == 1:
            last = np.full(len(stamp_ns), len(self.stamp_ns) - 1)
            return SampledPoses(np.ones(len(stamp_ns), dtype=bool), self.position_m[last], self.rotation[last])
        after = np.searchsorted(self.stamp_ns, stamp_ns, side="left").clip(1, len(self.stamp_ns) - 1)
        before = after - 1
        gap_ns = self.stamp_ns[after] - self.stamp_ns[before]
        fraction = ((stamp_ns - self.stamp_ns[before]) / gap_ns)[:, None]
        exact = (stamp_ns == self.stamp_ns[before]) | (stamp_ns == self.stamp_ns[after])
        covered = (fraction[:, 0] >= 0) & (fraction[:, 0] <= 1) & ((gap_ns <= self.max_gap_s * 1e9) | exact)
        a, b = self.rotation[before], self.rotation[after]
        b = np.where((a * b).sum(axis=1, keepdims=True) < 0, -b, b)
        mixed = (1 - fraction) * a + fraction * b  # samples are near each other: on the short arc this is the rotation
        return SampledPoses(
            covered,
            (1 - fraction) * self.position_m[before] + fraction * self.position_m[after],
            mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12),
        )


def make_pose_track(poses: Poses, chosen: Bool | None = None, max_gap_s: float = MAX_GAP_S) -> PoseTrack | None:
    """The `chosen` samples in order of time, of several at one instant the first; None: there is no sample."""
    rows = np.arange(len(poses.stamp_ns)) if chosen is None else np.flatnonzero(chosen)
    if not len(rows):
        return None
    stamps, first = np.unique(poses.stamp_ns[rows], return_index=True)
    rows = rows[first]
    return PoseTrack(
        poses.frame[rows[0]], stamps, poses.position_m[rows], poses.rotation[rows], poses.velocity_mps[rows], max_gap_s
    )


@dataclass
class FrameTree:
    """The tree of frames: the poses of each child frame in its parent frame."""

    pose_tracks: dict[str, PoseTrack] = field(default_factory=dict)
    static: set[str] = field(default_factory=set)
    max_gap_s: float = MAX_GAP_S

    def add(self, poses: Poses, *, static: bool = False) -> None:
        """Add transforms by child frame; one that has a parent keeps it. `static`: they hold for ever."""
        children = np.array(poses.child, dtype=object)
        for child in dict.fromkeys(poses.child):
            if not child or child in self.pose_tracks:
                continue
            of_child = np.asarray(children == child)
            if static:  # as in tf2 the last one that was sent holds
                rows = np.flatnonzero(of_child)
                of_child = np.arange(len(of_child)) == rows[np.argsort(poses.log_time_ns[rows], kind="stable")[-1]]
            course = make_pose_track(poses, of_child, self.max_gap_s)
            if course is not None and course.parent != child:
                self.pose_tracks[child] = course
                if static:
                    self.static.add(child)

    def chain(self, frame: str) -> list[str]:
        """The frames from `frame` up to its root, both included; a circle of frames ends where it began."""
        frames = [frame]
        while frames[-1] in self.pose_tracks and self.pose_tracks[frames[-1]].parent not in frames:
            frames.append(self.pose_tracks[frames[-1]].parent)
        return frames

    def world_of(self, frame: str) -> str:
        """The frame to take as the world: the outermost one that `frame` moves in, else `frame` itself."""
        chain = self.chain(frame)
        moving = [k for k, name in enumerate(chain[:-1]) if not self._stands(name)]
        return chain[moving[-1] + 1] if moving else frame

    def place(self, frame: str, world: str, stamp_ns: Int) -> SampledPoses | None:
        """The pose of `frame` in `world` at instants (K,) in ns; None: no transforms connect them."""
        up, down = self.chain(frame), self.chain(world)
        common = next((name for name in up if name in down), None)
        if common is None:
            return None
        placed, base = (self._climb(chain[: chain.index(common)], stamp_ns) for chain in (up, down))
        world_rotation = invert_rotation(base.rotation)
        return SampledPoses(
            placed.there & base.there,
            rotate_vectors(world_rotation, placed.position_m - base.position_m),
            compose_rotations(world_rotation, placed.rotation),
        )

    def place_by_ego(self, frame: str, ego: PoseTrack, stamp_ns: Int) -> SampledPoses | None:
        """The pose of `frame` in the frame of an ego's course, which is none of the tree's; None: not known. It is the
        outermost frame if the ego is at one place by both; else what `frame` is fixed in goes with the ego.
        """
        chain, outer = self.chain(frame), self.world_of(frame)
        body = next((name for name in chain[:-1] if not self._stands(name)), chain[-1])
        body_poses = self.place(body, outer, ego.stamp_ns) if body in self.pose_tracks else None
        if body_poses is not None and body_poses.there.any():
            apart_m = np.hypot(*(body_poses.position_m - ego.position_m)[body_poses.there, :2].T)
            if apart_m.max() <= BODY_M:
                return self.place(frame, outer, stamp_ns)
        carried = FrameTree(self.pose_tracks | {body: ego}, self.static - {body}, self.max_gap_s)
        return None if body == frame else carried.place(frame, ego.parent, stamp_ns)

    def _climb(self, steps: Iterable[str], stamp_ns: Int) -> SampledPoses:
        """The pose of the first frame of `steps` in the parent of the last one."""
        valid = np.ones(len(stamp_ns), dtype=bool)
        position, rotation = np.zeros((len(stamp_ns), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(stamp_ns), 1))
        for name in steps:
            step = self.pose_tracks[name].at(stamp_ns, forever=self._stands(name))
            position = rotate_vectors(step.rotation, position) + step.position_m
            rotation = compose_rotations(step.rotation, rotation)
            valid &= step.there
        return SampledPoses(valid, position, rotation)

    def _stands(self, child: str) -> bool:
        return child in self.static or len(self.pose_tracks[child].stamp_ns) == 1


# The ego of a recording whose lists do not hold it: from odometry, stamped poses or transforms.

EGO = "ego"
"""Id of an ego that is no object of any list."""
NOMINAL_M = (4.5, 1.8, 1.5)
"""Box of an ego without a stated size, in m: a car. It hides others; gaps to it are not given."""
_SHOWN = 12  # frames named in an error, at most


def ego_channel(log: Log, channels: Sequence[Channel], spec: EgoTopic | None, seek_ego: bool) -> Channel | None:
    """The channel of the ego's poses: the one `spec` for, else, with `seek_ego`, the only odometry; None: no ego.

    Raises EgoError: the topic that is asked for has no poses.
    """
    if spec is not None:
        on_topic = [c for c in channels if c.topic == spec.topic]
        if not on_topic:
            topics = ", ".join(f"{c.topic} ({c.schema})" for c in channels) or "none"
            raise EgoError(f"no poses on topic {spec.topic!r}; poses are on: {topics}", path=log.path)
        return on_topic[0]
    odometry = [c for c in channels if schema_name(c) == ODOMETRY]
    return odometry[0] if seek_ego and len(odometry) == 1 else None


def ego_course(log: Log, topic: str, poses: Poses, spec: EgoTopic | None, max_gap_s: float) -> PoseTrack:
    """The ego's poses, of the frame that is asked for. Raises EgoError: no pose, or poses of several frames."""
    child = spec.frame if spec is not None else None
    of_child = None if child is None else np.array([name == child.lstrip("/") for name in poses.child], dtype=bool)
    children = sorted(set(poses.child))
    if of_child is None and len(children) > 1:
        raise EgoError(
            f"{topic} has poses of several frames; choose with `frame`: {', '.join(children[:_SHOWN])}", path=log.path
        )
    course = make_pose_track(poses, of_child, max_gap_s)
    if course is None:
        of = f" of frame {child!r}" if child else ""
        raise EgoError(f"no pose on topic {topic!r}{of}{window_hint(log)}", path=log.path)
    return course


def window_hint(log: Log) -> str:
    """The end of a message on what is missing, where only a window of the log is read."""
    return "" if log.window is None else " in the window"


def ego_notes(channel: Channel, spec: EgoTopic | None) -> Iterator[str]:
    """A line for everything that is assumed of the ego."""
    if spec is None:
        yield f"the ego is where {channel.topic} ({channel.schema}) says"
    if spec is None or spec.centre_from_rear_axle_m is None:
        yield (
            "ego: its poses are taken for the centre of its box; they are often those of the rear axle: "
            f"`ego: {{topic: {channel.topic}, centre_from_rear_axle_m: …}}`"
        )
    if spec is None or spec.size_m is None:
        size = " × ".join(f"{side:g}" for side in NOMINAL_M)
        yield f"ego: no size is said (`size_m: [length, width, height]`): {size} m taken to hide others, gaps are null"


_SAME_BODY_M = 2.5
"""A vehicle whose centre is so near to the poses of the ego (of its rear axle, often) is the ego: no other has room."""


def find_listed_ego(columns: DecodedObjects, course: PoseTrack) -> int | None:
    """Index of the listed object that is the ego, by its place; None: the lists do not hold it."""
    placed = course.at(columns.stamp_ns)
    message = np.repeat(np.arange(len(columns.rows)), columns.rows)
    away_m = np.hypot(*(columns.values[:, k] - placed.position_m[message, k] for k in range(2)))
    driven = columns.class_ix != CLASSES.index("pedestrian")
    listed, near = (
        np.bincount(columns.object_ix[rows], minlength=len(columns.object_ids))
        for rows in (placed.there[message], placed.there[message] & (away_m < _SAME_BODY_M) & driven)
    )
    found = np.flatnonzero((near > _ALWAYS * listed) & (listed > _ALWAYS * placed.there.sum()) & columns.moving)
    return int(found[0]) if len(found) == 1 else None


_ALWAYS = 0.9  # share of the lists in which the ego is where its poses are


def add_ego(
    columns: DecodedObjects, course: PoseTrack | None, spec: EgoTopic | None, topic: str = ""
) -> DecodedObjects:
    """The columns with the ego added to every list at whose instant it has a pose; unchanged without a course.

    A listed object that is where the ego is, is the ego.
    """
    if course is None:
        return columns
    if (listed := find_listed_ego(columns, course)) is not None:
        name = columns.object_ids[listed]
        return replace(columns, hosts=(name,), notes=(*columns.notes, *find("ego listed", 1, id=name, topic=topic)))
    placed = course.at(columns.stamp_ns)
    length, width, height = spec.size_m if spec is not None and spec.size_m is not None else NOMINAL_M
    ahead = (spec.centre_from_rear_axle_m if spec is not None else None) or 0.0
    centre = placed.position_m + rotate_vectors(placed.rotation, np.array([ahead, 0.0, height / 2]))
    yaw = yaw_of(placed.rotation)
    rows = np.full((len(yaw), len(VALUES)), np.nan)
    rows[:, : Z + 1], rows[:, YAW] = centre, yaw
    rows[:, -3:] = length, width, height
    after = np.searchsorted(course.stamp_ns, columns.stamp_ns).clip(0, len(course.stamp_ns) - 1)
    vx, vy = course.velocity_mps[after].T
    rows[:, VX], rows[:, VY] = vx * np.cos(yaw) - vy * np.sin(yaw), vx * np.sin(yaw) + vy * np.cos(yaw)
    placed_lists = np.flatnonzero(placed.there)
    message = np.concatenate([np.repeat(np.arange(len(yaw)), columns.rows), placed_lists])
    order = np.argsort(message, kind="stable")
    number = len(columns.object_ids)
    name = EGO if EGO not in columns.object_ids else f"{EGO} vehicle"
    return replace(
        columns,
        rows=columns.rows + placed.there,
        object_ids=(*columns.object_ids, name),
        moving=np.append(columns.moving, True),
        object_ix=np.append(columns.object_ix, np.full(len(placed_lists), number))[order],
        class_ix=np.append(columns.class_ix, np.full(len(placed_lists), CLASSES.index("car"), dtype=np.int8))[order],
        values=np.concatenate([columns.values, rows[placed_lists]])[order],
        hosts=(name,),
    )


@dataclass(frozen=True)
class LogContext:
    """The frames of reference of a recording, and the course of its ego."""

    frames: FrameTree
    ego: PoseTrack | None
    asked: EgoTopic | None
    notes: tuple[str, ...]
    own: Mapping[tuple[str, str], str] = field(default_factory=dict)  # `_own_frame_names`
    ego_topic: str = ""
    static_missing: str = ""  # why there may be no static transforms
    classes: Mapping[str, str] = field(default_factory=dict)  # of names, beside those that are known

    def named(self, lists: DecodedLists) -> list[str]:
        """The frames of the lists by their names in `frames`."""
        return [self.own.get((lists.part, name.lstrip("/")), name.lstrip("/")) for name in lists.frames]

    def world_of(self, lists: DecodedLists) -> str:
        """The frame that the lists are transformed into; that of `""` where no list names one and no ego has poses."""
        codes = lists.frame_code[lists.frame_code >= 0]
        frame = self.named(lists)[codes[0]] if len(codes) else ""
        return self.ego.parent if self.ego is not None else self.frames.world_of(frame)


def read_log_context(log: Log, spec: EgoTopic | None, *, seek_ego: bool, max_gap_s: float = MAX_GAP_S) -> LogContext:
    """The frames and the ego of a recording; `seek_ego`: the only odometry is the ego's, if nothing is `spec`.

    Raises RecordingError: no such topic; BrokenIndexError.
    """
    channels = [c for c in log.channels if is_pose(c) and c.messages]
    messages = gather_messages(log, frozenset(c.number for c in channels))
    frames, notes = FrameTree(max_gap_s=max_gap_s), list(messages.notes())
    of_channel: dict[int, Poses] = {}
    for channel in channels:
        if not messages.payloads[channel.number]:  # none in the window
            continue
        try:
            poses = _strip_slashes(
                decode_poses(
                    channel,
                    messages.payloads[channel.number],
                    np.array(messages.log_time_ns[channel.number], dtype=np.int64),
                )
            )
        except (DefinitionError, KeyError) as error:
            notes.append(f"topic {channel.topic} ({channel.schema}) not read: {error}")
            continue
        notes += [note.within(f"topic {channel.topic}") for note in poses.notes]
        of_channel[channel.number] = _keep_run(poses, log.window)
    part_of = {channel.number: channel.part for channel in channels}
    own = _own_frame_names({(part_of[number], child) for number, poses in of_channel.items() for child in poses.child})
    for channel in channels:
        if channel.number in of_channel:
            of_channel[channel.number] = _rename_frames(of_channel[channel.number], channel.part, own)
            frames.add(of_channel[channel.number], static=is_static(channel))
    ego_poses = ego_channel(log, channels, spec, seek_ego)
    empty = [c.topic for c in log.channels if is_pose(c) and is_static(c) and not c.messages]
    missing = f"; {empty[0]} is empty: of a split bag the first part alone has it, so give the folder" if empty else ""
    if ego_poses is None:
        return LogContext(frames, None, spec, tuple(notes), own, static_missing=missing)
    if not messages.payloads[ego_poses.number]:
        raise EgoError(f"no pose on topic {ego_poses.topic!r}{window_hint(log)}", path=log.path)
    if ego_poses.number not in of_channel:  # not decoded, which a note tells
        return LogContext(frames, None, spec, tuple(notes), own)
    if spec is not None and spec.frame is not None:
        spec = spec.model_copy(update={"frame": own.get((ego_poses.part, spec.frame.lstrip("/")), spec.frame)})
    course = ego_course(log, ego_poses.topic, of_channel[ego_poses.number], spec, max_gap_s)
    return LogContext(frames, course, spec, (*notes, *ego_notes(ego_poses, spec)), own, ego_poses.topic, missing)


def _keep_run(poses: Poses, window: Window | None) -> Poses:
    """The poses without those of another run (of the clock) than the window's: its margin may reach into one."""
    if window is None:
        return poses
    same_run, frames = np.ones(len(poses.stamp_ns), dtype=bool), np.array(poses.child, dtype=object)
    for child in set(poses.child):
        rows = np.flatnonzero(frames == child)
        run = find_runs(poses.stamp_ns[rows], poses.log_time_ns[rows])
        inside = [window.from_ns <= logged_ns <= window.to_ns for logged_ns in poses.log_time_ns[rows].tolist()]
        if any(inside):
            same_run[rows] = np.isin(run, run[inside])
    return poses if same_run.all() else poses.take(np.flatnonzero(same_run))


def _strip_slashes(poses: Poses) -> Poses:
    """The poses with frames named without a leading slash: `/map` is `map`."""
    return replace(
        poses, frame=tuple(n.lstrip("/") for n in poses.frame), child=tuple(n.lstrip("/") for n in poses.child)
    )


def _own_frame_names(children: Set[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """Names of frames that several recordings of one drive place, by recording and name: `recording:name`.

    A frame that none or only one of them places is common to all, as the world is.
    """
    times = Counter(child for _, child in children if child)
    return {(part, child): f"{part}:{child}" for part, child in children if times[child] > 1}


def _rename_frames(poses: Poses, part: str, own: Mapping[tuple[str, str], str]) -> Poses:
    frame, child = (tuple(own.get((part, name), name) for name in names) for names in (poses.frame, poses.child))
    return replace(poses, frame=frame, child=child)


def _add_classes(description: Description, classes: Mapping[str, str]) -> Description:
    """The description with classes of further names."""
    class_field = description.fields.class_
    if not classes or class_field is None:
        return description
    class_field = ClassField(path=class_field) if isinstance(class_field, str) else class_field
    class_field = class_field.model_copy(update={"map": {**class_field.map, **classes}})
    return replace(description, fields=description.fields.model_copy(update={"class_": class_field}))


def read_decoded_lists(
    log: Log, channels: Sequence[Channel], fields: Fields | None, classes: Mapping[str, str]
) -> DecodedLists:
    """The lists on channels of one topic and schema. Raises RecordingError, BrokenIndexError."""
    of, channel, since_ns = frozenset(c.number for c in channels), channels[0], 0
    if log.window is not None and log.window.from_ns > 0 and may_stay(channel):
        since_ns, log = log.window.from_ns, log.within(replace(log.window, from_ns=0))
    messages = gather_messages(log, of)
    payloads = [p for c in channels for p in messages.payloads[c.number]]
    times = np.array([t for c in channels for t in messages.log_time_ns[c.number]], dtype=np.int64)
    try:
        definition = make_definition(channel, payloads)
        description = Description(fields) if fields is not None else describe_channel(channel, definition.offers())
        description = _add_classes(description, classes)
        lists = decode_lists(definition, description, payloads, times, channel.ahead_ns, since_ns)
    except (DefinitionError, FieldsError) as error:
        raise RecordingError(str(error), path=log.path, topic=channel.topic) from None
    columns = replace(lists.columns, notes=(*lists.columns.notes, *messages.notes()))
    return replace(lists, part=channel.part, columns=columns)


def transform_rows(values: Float, covariance: Float, placed: SampledPoses, instant: Int) -> tuple[Float, Float]:
    """Values (K, len(VALUES)) and covariances (K, 3) of rows, transformed by the pose at their `instant (K,)`."""
    values = values.copy()
    values[:, X : Z + 1] = rotate_vectors(placed.rotation[instant], values[:, X : Z + 1]) + placed.position_m[instant]
    yaw = yaw_of(placed.rotation)[instant]
    cos, sin = np.cos(yaw), np.sin(yaw)
    values[:, YAW] += yaw
    vx, vy = values[:, VX].copy(), values[:, VY].copy()
    values[:, VX], values[:, VY] = cos * vx - sin * vy, sin * vx + cos * vy
    xx, xy, yy = covariance.T
    rotated = [
        cos * cos * xx - 2 * cos * sin * xy + sin * sin * yy,
        cos * sin * (xx - yy) + (cos * cos - sin * sin) * xy,
        sin * sin * xx + 2 * cos * sin * xy + cos * cos * yy,
    ]
    return values, np.stack(rotated, axis=1)


def _name_frames(lists: DecodedLists, context: LogContext) -> DecodedLists:
    """The lists with entries of no named frame as of that which the others name, else of the ego's world."""
    nameless = np.array([not name.strip("/") for name in lists.frames] + [True])[lists.frame_code]
    if not nameless.any() or (context.ego is None and nameless.all()):
        return lists
    named = lists.frame_code[~nameless]
    code = int(np.bincount(named).argmax()) if len(named) else len(lists.frames)
    frames = lists.frames if len(named) or context.ego is None else (*lists.frames, context.ego.parent)
    findings = find("frameless", int(nameless.sum()), frame=frames[code])
    columns = replace(lists.columns, notes=(*lists.columns.notes, *findings))
    return replace(lists, columns=columns, frames=frames, frame_code=np.where(nameless, code, lists.frame_code))


def transform_to_world(lists: DecodedLists, context: LogContext, path: Path, topic: str) -> DecodedLists:
    """The lists in the world, without the states at instants at which their frame has no place; notes tell of both.

    Raises RecordingError, naming `path` and `topic`: no transforms connect a list's frame with the world.
    """
    lists = _name_frames(lists, context)
    names = context.named(lists)
    if not len(lists.frame_code) or not names:
        return lists
    world = context.world_of(lists)
    message = np.repeat(np.arange(len(lists.columns.stamp_ns)), lists.columns.rows)
    values, covariance = lists.columns.values.copy(), lists.covariance_m2.copy()
    has_place = np.ones(len(values), dtype=bool)
    notes = []
    for code, name in enumerate(names):
        rows = np.flatnonzero(lists.frame_code == code)
        if not len(rows) or name in (world, "") or not world:
            continue
        stamps, instant = np.unique(lists.columns.stamp_ns[message[rows]], return_inverse=True)
        placed = context.frames.place(name, world, stamps)
        if placed is None:
            raise RecordingError(
                f"lists are in the frame {name!r}, the ego in {world!r}, and no transform of the recording "
                f"says how they lie{context.static_missing}",
                path=path,
                topic=topic,
            )
        values[rows], covariance[rows] = transform_rows(values[rows], covariance[rows], placed, instant)
        has_place[rows] = placed.there[instant]
        notes.append(f"lists in the frame {name}: brought into {world}")
        if lost := int((~placed.there[instant]).sum()):
            notes.append(f"{count_noun(lost, 'object state')} at instants at which {name} has no place: skipped")
    columns = replace(lists.columns, values=values, notes=(*lists.columns.notes, *notes))
    return replace(lists, columns=columns, covariance_m2=covariance).take_rows(has_place)
