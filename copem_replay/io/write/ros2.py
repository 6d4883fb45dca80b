"""Writing ROS 2 messages: CDR, definitions, fused lists as autoware_perception_msgs/DetectedObjects, and scenes.

`header.stamp` is the instant the list is available, `header.frame_id` the world of the recording. The twist is along
the object, as in Autoware; a pedestrian is a cylinder whose diameter is the mean of its length and width. An unknown
covariance is 0 and flagged as absent; of height, roll and pitch it is always 0.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, Float, Int, Scene
from copem_replay.io.encodings.column_bytes import (
    RowGroups,
    RowTexts,
    TextPool,
    encode_records,
    expand_ranges,
    put_pieces,
    split_into_blocks,
    start_offsets,
)
from copem_replay.io.write.scene import ALPHA, Entity, MovingEntities, Pose, Rgba, box_metadata

# CDR, little-endian, each value aligned to its own size.

HEAD = b"\0\1\0\0"
"""The begin of every message; alignment counts from its end."""
_FIRST_S, _LAST_S = -(2**31), 2**31 - 1
_POSE_BYTES = 56


def encode_time(time_ns: int) -> bytes:
    """builtin_interfaces/Time; seconds beyond its 32 bits become the nearest that they hold."""
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return struct.pack("<iI", min(max(seconds, _FIRST_S), _LAST_S), nanoseconds)


def encode_string(value: str) -> bytes:
    """A string, to be put at a multiple of 4 bytes."""
    encoded = value.encode()
    return struct.pack("<I", len(encoded) + 1) + encoded + b"\0"


def encode_count(value: int) -> bytes:
    """The number of items of a list."""
    return struct.pack("<I", value)


def pad_to_size(data: bytes, size: int = 4) -> bytes:
    """The data, padded with zeros to a multiple of `size` bytes."""
    return data + bytes(-len(data) % size)


class CdrMessage:
    """A message that grows field by field, each aligned to its own size."""

    def __init__(self, before: int = 0) -> None:
        """`before`: bytes of the message that lie before, of which alignment counts."""
        self._body, self._before = bytearray(before), before
        self.poses: list[int] = []
        """Where poses begin, from `before` on."""

    def add(self, kind: str, *values: float) -> None:
        """Add numbers of a format of `struct`: `B`, `I`, `i` or `d`."""
        size = struct.calcsize(kind)
        self._body += bytes(-len(self._body) % size) + struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, value: str) -> None:
        """Add a string."""
        self._body += bytes(-len(self._body) % 4) + encode_string(value)

    def stamp(self, time_ns: int) -> None:
        """Add a time."""
        self._body += bytes(-len(self._body) % 4) + encode_time(time_ns)

    def pose(self, pose: Pose) -> None:
        """Add a pose."""
        turn = 0.0, 0.0, math.sin(pose.yaw_rad / 2), math.cos(pose.yaw_rad / 2)
        self.add("d", pose.x_m, pose.y_m, pose.z_m, *turn)
        self.poses.append(len(self._body) - _POSE_BYTES - self._before)

    def content(self) -> bytes:
        """What was added, without a head."""
        return bytes(self._body[self._before :])

    def message(self) -> bytes:
        """The whole message, with its head."""
        return HEAD + self.content()


# Definitions of the written messages as in MCAP (`ros2msg`): a type, then all types in it. Sources: the packages' own
# message files (autoware_perception_msgs, foxglove_msgs, std_msgs, geometry_msgs), without their comments.

DETECTED_OBJECTS = "autoware_perception_msgs/msg/DetectedObjects"
SCENE_UPDATE = "foxglove_msgs/msg/SceneUpdate"
STRING = "std_msgs/msg/String"
TRANSFORM = "foxglove_msgs/msg/FrameTransform"
STATUS = "copem_replay_msgs/msg/Status"


LABELS = {
    "pedestrian": 7,
    "bicycle": 6,
    "motorcycle": 5,
    "car": 1,
    "van": 1,  # car: Autoware has no label for vans
    "truck": 2,
    "bus": 3,
    "trailer": 4,
    "animal": 8,
    "other": 0,
    "vehicle": 0,  # unknown: nor one for a vehicle of any kind
}
"""ObjectClassification.label by class."""
_LABEL = np.array([LABELS[name] for name in CLASSES])
_BOUNDING_BOX, _CYLINDER = 0, 1  # Shape.type
_AVAILABLE = 2  # DetectedObjectKinematics: the orientation is known in full

# A DetectedObject from its pose on; it begins, and so ends, at a multiple of 8 bytes.
_BODY = np.dtype(
    [
        ("pose", "<f8", 7),
        ("pose_covariance", "<f8", 36),
        ("has_position_covariance", "u1"),
        ("orientation_availability", "u1"),
        ("", "V6"),
        ("twist", "<f8", 6),
        ("twist_covariance", "<f8", 36),
        ("has_twist", "u1"),
        ("has_twist_covariance", "u1"),
        ("shape", "u1"),
        ("", "V1"),
        ("footprint_points", "<u4"),
        ("dimensions", "<f8", 3),
    ]
)
_EAST, _EAST_NORTH, _NORTH_EAST, _NORTH, _YAW = 0, 1, 6, 7, 35  # places in a 6 × 6 matrix by rows


class DetectedObjectsWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, list by list."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, frame_id: str) -> None:
        self._fused, self._listed, self._said = fused_tracks.fused, fused_tracks.listed, fused_tracks.said
        object_ix = fused_tracks.fused.row_object_ix
        self._moving = np.where(object_ix >= 0, scene.moving[object_ix], True)
        self._class_ix = fused_tracks.class_of(scene)
        self.round = self._class_ix == CLASSES.index("pedestrian")
        """(P,) which objects are cylinders."""
        self._certain: list[bytes] = [_encode_head(1.0, {int(label): 1.0}) for label in _LABEL]
        self._frame_id = pad_to_size(encode_string(frame_id))

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        rows = self._listed(frame)
        begin = encode_time(available_ns) + self._frame_id + encode_count(len(rows))
        if not rows:
            return HEAD + begin
        bodies = self._bodies(np.array(rows)).tobytes()
        parts = [HEAD, begin]
        for k, row in enumerate(rows):
            parts.append(self._head_of(row))
            if k == 0:
                parts.append(bytes(-len(begin) % 8))  # all others begin at a multiple of 8 bytes
            parts.append(bodies[k * _BODY.itemsize : (k + 1) * _BODY.itemsize])
        return b"".join(parts)

    def _head_of(self, row: int) -> bytes:
        if self._said is None:
            return self._certain[int(self._class_ix[row])]
        entry = self._said[row]
        share: dict[int, float] = {}
        for index in np.flatnonzero(entry["class_probability"]):
            label = int(_LABEL[index])
            share[label] = share.get(label, 0.0) + float(entry["class_probability"][index])
        return _encode_head(float(entry["existence"]), share)

    def _bodies(self, rows: Int) -> Any:
        fused, moving, cylinder = self._fused, self._moving[rows], self.round[rows]
        body = np.zeros(len(rows), dtype=_BODY)
        yaw = fused.yaw_rad[0, rows]
        pose, covariance = body["pose"], body["pose_covariance"]
        for k, name in enumerate(("x_m", "y_m", "z_m")):
            pose[:, k] = getattr(fused, name)[0, rows]
        pose[:, 5], pose[:, 6] = np.sin(yaw / 2), np.cos(yaw / 2)
        east, north = self._variance("cov_ee_m2", rows), self._variance("cov_nn_m2", rows)
        covariance[:, _EAST], covariance[:, _NORTH] = east, north
        covariance[:, _EAST_NORTH] = covariance[:, _NORTH_EAST] = self._variance("cov_en_m2", rows)
        covariance[:, _YAW] = self._variance("yaw_var_rad2", rows)
        body["has_position_covariance"] = (east > 0) & (north > 0)
        body["orientation_availability"] = _AVAILABLE

        cos, sin = np.cos(yaw), np.sin(yaw)
        vx, vy = np.where(moving, fused.vx_mps[0, rows], 0.0), np.where(moving, fused.vy_mps[0, rows], 0.0)
        body["twist"][:, 0], body["twist"][:, 1] = cos * vx + sin * vy, cos * vy - sin * vx
        fast = np.where(moving, self._variance("speed_var_m2ps2", rows), 0.0)
        body["twist_covariance"][:, 0] = body["twist_covariance"][:, 7] = fast
        body["has_twist"], body["has_twist_covariance"] = moving, fast > 0

        length, width = fused.length_m[0, rows], fused.width_m[0, rows]
        across = (length + width) / 2
        body["shape"] = np.where(cylinder, _CYLINDER, _BOUNDING_BOX)
        body["dimensions"][:, 0] = np.where(cylinder, across, length)
        body["dimensions"][:, 1] = np.where(cylinder, across, width)
        body["dimensions"][:, 2] = fused.height_m[0, rows]
        return body

    def _variance(self, name: str, rows: Int) -> Float:
        """Variances of `rows`, 0 where the state is exact or the variance is not known."""
        variance = getattr(self._fused, name)
        return np.zeros(len(rows)) if variance is None else np.nan_to_num(variance[0, rows])


def _encode_head(existence: float, share: dict[int, float]) -> bytes:
    """A DetectedObject up to its pose, by its label."""
    classes = (struct.pack("<B3xf", label, probability) for label, probability in share.items())
    return struct.pack("<fI", existence, len(share)) + b"".join(classes)


# Scenes in ROS 2: foxglove_msgs/SceneUpdate.

_ALL = 1  # SceneEntityDeletion.type
_FOREVER = bytes(8)  # lifetime
_UNLOCKED = bytes(4)  # frame_locked, padded to a multiple of 4 bytes

# From the cube's pose to the end of an entity: one cube, no sphere, cylinder, line, triangle, text, model.
_CUBE = np.dtype([("pose", "<f8", 7), ("size", "<f8", 3), ("color", "<f8", 4), ("none", "<u4", 6)])


class Ros2SceneWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, list by list."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, configuration: str, colour: Rgb, frame_id: str) -> None:
        self._fused, self._listed = fused_tracks.fused, fused_tracks.listed
        every, which = fused_tracks.names_of(scene)
        names, kinds = [every[k] for k in which.tolist()], fused_tracks.class_of(scene).tolist()
        entities = {
            key: _encode_entity(key[0], box_metadata(*key, configuration), frame_id)
            for key in dict.fromkeys(zip(names, kinds, strict=True))
        }
        self._entity = [entities[key] for key in zip(names, kinds, strict=True)]
        self._color = (*(c / 255 for c in colour), ALPHA)

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        rows = self._listed(frame)
        now = encode_time(available_ns)
        deletion = pad_to_size(now + bytes([_ALL, 0, 0, 0]) + encode_string(""))
        begin = encode_count(1) + deletion + encode_count(len(rows))
        cubes = self._cubes(rows)
        parts = [HEAD, begin]
        offset = len(begin)
        for k, row in enumerate(rows):
            entity = self._entity[row]
            offset += len(now) + len(entity)
            parts += (now, entity, bytes(-offset % 8), cubes[k * _CUBE.itemsize : (k + 1) * _CUBE.itemsize])
            offset = 0  # a cube begins, and so ends, at a multiple of 8 bytes
        return b"".join(parts)

    def _cubes(self, rows: list[int]) -> bytes:
        fused = self._fused
        cubes = np.zeros(len(rows), dtype=_CUBE)
        for k, name in enumerate(("x_m", "y_m", "z_m")):
            cubes["pose"][:, k] = getattr(fused, name)[0, rows]
        half = fused.yaw_rad[0, rows] / 2
        cubes["pose"][:, 5], cubes["pose"][:, 6] = np.sin(half), np.cos(half)
        for k, name in enumerate(("length_m", "width_m", "height_m")):
            cubes["size"][:, k] = getattr(fused, name)[0, rows]
        cubes["color"] = self._color
        return cubes.tobytes()


def _encode_entity(name: str, metadata: dict[str, str], frame_id: str) -> bytes:
    """An entity from its frame of reference to the number of its cubes."""
    texts = [pad_to_size(encode_string(each)) for pair in metadata.items() for each in pair]
    head = pad_to_size(encode_string(frame_id)) + pad_to_size(encode_string(name)) + _FOREVER + _UNLOCKED
    return head + encode_count(len(metadata)) + b"".join(texts) + encode_count(0) + encode_count(1)


def encode_ros2_scene(entities: Sequence[Entity], time_ns: int, frame_id: str) -> bytes:
    """A message that deletes all on its topic and draws entities."""
    out = CdrMessage()
    out.add("I", 1)
    out.stamp(time_ns)
    out.add("B", _ALL)
    out.text("")
    out.add("I", len(entities))
    for each in entities:
        _write_entity(out, each, time_ns, frame_id)
    return out.message()


def _write_entity(out: CdrMessage, each: Entity, time_ns: int, frame_id: str) -> None:
    """Add an entity. It ends at a multiple of 4 bytes, and so the next begins."""
    out.stamp(time_ns)
    out.text(frame_id)
    out.text(each.name)
    out.add("I", 0, 0)  # lifetime
    out.add("B", 0)  # frame_locked
    out.add("I", len(each.says))
    for pair in each.says.items():
        for text in pair:
            out.text(text)
    out.add("I", 0, 0, 0, len(each.ellipses))  # arrows, cubes, spheres, cylinders
    for ellipse in each.ellipses:
        out.pose(each.pose)
        out.add("d", *ellipse.size, 1.0, 1.0, *ellipse.colour)
    out.add("I", len(each.lines))
    for line in each.lines:
        _write_line(out, line.points, line.width, each.pose, line.colour)
    out.add("I", 0, len(each.texts))  # triangles, texts
    for words in each.texts:
        out.pose(words.place(each.pose))
        out.add("B", 1)  # billboard
        out.add("d", words.size)
        out.add("B", 1)  # scale_invariant
        out.add("d", *words.colour)
        out.text(words.text)
    out.add("I", 0)  # models


def encode_ros2_moving(moving: MovingEntities, frame_id: str) -> Iterator[bytes]:
    """A message for each frame, as `encode_ros2_scene` gives it, many at once."""
    looks = _CdrLooks(moving.looks, frame_id)
    for first, last in split_into_blocks(moving.start):
        bounds, time_ns = moving.start[first : last + 1], moving.time_ns[first:last]
        start, frames = bounds - bounds[0], last - first
        head = np.tile(np.frombuffer(_SCENE_HEAD, dtype=np.uint8), (frames, 1))
        stamps = _encode_times(time_ns)
        head[:, 8:16], head[:, 28:32] = stamps, np.diff(start).astype("<u4")[:, None].view(np.uint8)
        heads = TextPool(head.tobytes(), np.arange(frames) * len(_SCENE_HEAD), np.full(frames, len(_SCENE_HEAD)))
        entities = looks.placed(moving, slice(bounds[0], bounds[-1]), start, np.repeat(stamps, np.diff(start), axis=0))
        yield from encode_records([heads.at(np.arange(frames)), RowGroups(start, [entities])], frames)


_SCENE_HEAD = HEAD + encode_count(1) + bytes(8) + pad_to_size(bytes([_ALL, 0, 0, 0]) + encode_string("")) + bytes(4)
"""A message up to its entities, without its instant and their number."""


def _encode_times(time_ns: Int) -> NDArray[np.uint8]:
    """(F, 8) `encode_time` of each instant."""
    seconds, nanoseconds = np.divmod(time_ns, 1_000_000_000)
    pairs = np.stack([np.clip(seconds, _FIRST_S, _LAST_S), nanoseconds], axis=1).astype("<i4")
    return pairs.view(np.uint8)


class _CdrLooks:
    """What entities look like, encoded once for either alignment at which they may begin; then only poses differ."""

    def __init__(self, looks: Sequence[Entity], frame_id: str) -> None:
        self._looks, self._frame_id = looks, frame_id
        self._number: dict[tuple[int, int], int] = {}  # of what is encoded, by look and the place of its begin modulo 8
        self._encoded: list[bytes] = []
        self._poses: list[list[tuple[int, bool, tuple[float, ...]]]] = []  # place, whether it turns, heights above

    def placed(self, moving: MovingEntities, rows: slice, start: Int, stamps: NDArray[np.uint8]) -> _PlacedPieces:
        """The entities of some rows (P,) of frames `start` (F + 1,)."""
        look, which = moving.look_ix[rows].tolist(), list[int]()
        for first, last in pairwise(start.tolist()):
            begin = len(_SCENE_HEAD) - len(HEAD)
            for k in range(first, last):
                which.append(self._encode(look[k], begin % 8))
                begin += len(self._encoded[which[-1]])
        pieces = np.array(which, dtype=np.int64)
        begin_of = start_offsets(np.array([len(poses) for poses in self._poses], dtype=np.int64))
        _, pose = expand_ranges(begin_of, pieces)
        row = np.repeat(np.arange(len(pieces)), np.diff(begin_of)[pieces])
        every = [pose for poses in self._poses for pose in poses]
        x, y, z, yaw = (getattr(moving, name)[rows][row] for name in ("x_m", "y_m", "z_m", "yaw_rad"))
        for step in range(max((len(above) for *_, above in every), default=0)):
            up = np.array([above[step] if step < len(above) else np.nan for *_, above in every])[pose]
            z = np.where(np.isnan(up), z, z + up)
        half = np.where(np.array([turns for _, turns, _ in every], dtype=bool)[pose], yaw, 0.0) / 2
        zero = np.zeros(len(x))
        columns = np.stack([x, y, z, zero, zero, np.sin(half), np.cos(half)], axis=1).astype("<f8")
        place = np.array([at for at, *_ in every], dtype=np.int64)[pose]
        changes = ((np.arange(len(pieces)), np.zeros_like(pieces), stamps), (row, place, columns.view(np.uint8)))
        return _PlacedPieces(TextPool.of(self._encoded).at(pieces), changes)

    def _encode(self, look: int, begin: int) -> int:
        """The number of an encoded look."""
        if (look, begin) not in self._number:
            out, entity = CdrMessage(begin), self._looks[look]
            _write_entity(out, entity, 0, self._frame_id)
            turning = len(entity.ellipses) + len(entity.lines)
            heights = [*[()] * turning, *(text.above_m for text in entity.texts)]
            self._poses.append([(at, k < turning, heights[k]) for k, at in enumerate(out.poses)])
            self._number[look, begin] = len(self._encoded)
            self._encoded.append(out.content())
        return self._number[look, begin]


class _PlacedPieces:
    """A part that has a text in each row, with changes: of which rows, from which place in their texts, the bytes."""

    def __init__(self, texts: RowTexts, changes: Sequence[tuple[Int, Int, NDArray[np.uint8]]]) -> None:
        self._texts, self._changes, self.sizes = texts, changes, texts.sizes

    def put(self, out: NDArray[np.uint8], offset: Int) -> None:
        """Put the bytes of every row at its place in `out`, `offset` (N,)."""
        self._texts.put(out, offset)
        for row, place, content in self._changes:
            count, size = content.shape
            put_pieces(out, offset[row] + place, content.ravel(), np.arange(count) * size, np.full(count, size))


def encode_ros2_transform(parent: str, pose: Pose, time_ns: int, child: str) -> bytes:
    """The pose of the frame `child` in the frame `parent`: foxglove_msgs/FrameTransform."""
    out = CdrMessage()
    out.stamp(time_ns)
    out.text(parent)
    out.text(child)
    out.pose(pose)
    return out.message()


def _write_line(
    out: CdrMessage, points: Sequence[tuple[float, float, float]], width: float, pose: Pose, colour: Rgba
) -> None:
    out.add("B", 0)  # LINE_STRIP
    out.pose(pose)
    out.add("d", width)
    out.add("B", 1)  # scale_invariant
    out.add("I", len(points))
    for point in points:
        out.add("d", *point)
    out.add("d", *colour)
    out.add("I", 0, 0)  # colors, indices
