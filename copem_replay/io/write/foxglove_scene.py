"""foxglove.SceneUpdate: a fused list as boxes for Foxglove and Lichtblick.

Every message deletes all that was on its topic and draws the list anew, so playback shows the right boxes after a seek
and nothing piles up (entities replace by id and live until deleted).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, Float, Int, Scene
from copem_replay.io.encodings.column_bytes import Texts, constant
from copem_replay.io.encodings.protobuf_columns import Content, Repeated, messages, where
from copem_replay.io.write.drawing import Entity, Pose
from copem_replay.io.write.list_blocks import blocks
from copem_replay.io.write.uncertainty import Ellipses

SCHEMA = "foxglove.SceneUpdate"
FRAME_ID = "global"
"""Name of the world frame in the OSI converters of these viewers."""
ALPHA = 0.5
"""How opaque boxes are (chosen: what is inside stays visible)."""


def message_class() -> Any:
    """The SceneUpdate class, imported when first needed."""
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    return SceneUpdate


class SceneWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, many lists at once."""

    def __init__(
        self, scene: Scene, fused_tracks: FusedTracks, configuration: str, colour: Rgb, frame_id: str = FRAME_ID
    ) -> None:
        self._fused, self._rows, self._frame_id = fused_tracks.fused, fused_tracks.listed_rows, frame_id
        names, self._name = fused_tracks.names_of(scene)
        self._names = Texts.of([name.encode() for name in names])
        # What a click on a box tells is made once for every name and class there is.
        keys, self._key = np.unique(self._name * len(CLASSES) + fused_tracks.class_of(scene), return_inverse=True)
        pairs = (divmod(key, len(CLASSES)) for key in keys.tolist())
        self._says = Texts.of([_metadata(metadata(names[name], kind, configuration)) for name, kind in pairs])
        shades = zip("rgb", colour, strict=True)
        self._colour: Content = {**{shade: c / 255 for shade, c in shades}, "a": ALPHA}

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        for first, last in blocks(self._rows[1]):
            bounds = self._rows[1][first : last + 1]
            rows = self._rows[0][bounds[0] : bounds[-1]]
            entities: Content = {
                "id": self._names.at(self._name[rows]),
                "metadata": self._says.at(self._key[rows]),
                "cubes": Repeated(np.arange(len(rows) + 1), self._cubes(rows)),
            }
            yield from updates(available_ns[first:last], bounds - bounds[0], entities, self._frame_id)

    def _cubes(self, rows: Int) -> Content:
        x, y, z, length, width, height, yaw = (
            getattr(self._fused, name)[0, rows]
            for name in ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
        )
        pose: Content = {"position": {"x": x, "y": y, "z": z}, "orientation": turned(yaw)}
        return {"pose": pose, "size": {"x": length, "y": width, "z": height}, "color": self._colour}


def turned(yaw_rad: Float) -> Content:
    """An orientation about the vertical."""
    return {"z": np.sin(yaw_rad / 2), "w": np.cos(yaw_rad / 2)}


def updates(time_ns: Int, start: Int, entities: Content, frame_id: str) -> list[bytes]:
    """Messages that delete all that was on their topic; message k draws the entities `start[k]:start[k + 1]`."""
    rows = int(start[-1])
    deletion: Content = {"timestamp": _stamp(time_ns), "type": 1}  # ALL
    drawn: Content = {
        "timestamp": _stamp(np.repeat(time_ns, np.diff(start))),
        "frame_id": constant(frame_id.encode(), rows),
        **entities,
    }
    content: Content = {
        "deletions": Repeated(np.arange(len(time_ns) + 1), deletion),
        "entities": Repeated(start, drawn),
    }
    return messages(message_class().DESCRIPTOR, content, len(time_ns))


def ellipses(drawn: Ellipses, time_ns: Int, start: Int, frame_id: str) -> list[bytes]:
    """Messages of ellipses, message k of those `start[k]:start[k + 1]`."""
    rows = np.arange(len(drawn.names) + 1)
    told = [age.encode() for age in drawn.ages if age]
    age: Content = {"key": constant(b"age_s", len(told)), "value": Texts.of(told).at(np.arange(len(told)))}
    red, green, blue = drawn.colour
    cylinder: Content = {
        "pose": {"position": {"x": drawn.x_m, "y": drawn.y_m, "z": drawn.z_m}, "orientation": turned(drawn.yaw_rad)},
        "size": {"x": drawn.length_m, "y": drawn.width_m, "z": drawn.height_m},
        "bottom_scale": 1.0,
        "top_scale": 1.0,
        "color": {"r": red, "g": green, "b": blue, "a": drawn.alpha},
    }
    entities: Content = {
        "id": Texts.of([name.encode() for name in drawn.names]).at(rows[:-1]),
        "metadata": where(np.array([age != "" for age in drawn.ages], dtype=bool), age),
        "cylinders": Repeated(rows, cylinder),
    }
    return updates(time_ns, start, entities, frame_id)


def _stamp(time_ns: Int) -> Content:
    seconds, nanos = np.divmod(time_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}


def metadata(name: str, class_ix: int, configuration: str) -> dict[str, str]:
    """What a click on a box tells."""
    return {"configuration": configuration, "class": CLASSES[class_ix], "object": name}


def _metadata(said: dict[str, str]) -> bytes:
    """All of a box's metadata, encoded."""
    from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity

    entity = SceneEntity()
    for key, text in said.items():
        entity.metadata.add(key=key, value=text)
    encoded: bytes = entity.SerializeToString(deterministic=True)
    return encoded


def drawn(entities: Sequence[Entity], time_ns: int, frame_id: str) -> bytes:
    """A message that deletes all that was on its topic, and draws entities."""
    from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion

    update = message_class()()
    deletion = update.deletions.add()
    deletion.type = SceneEntityDeletion.ALL
    deletion.timestamp.FromNanoseconds(time_ns)
    for each in entities:
        entity = update.entities.add(frame_id=frame_id, id=each.name)
        entity.timestamp.CopyFrom(deletion.timestamp)
        for key, value in each.says.items():
            entity.metadata.add(key=key, value=value)
        for ellipse in each.ellipses:
            made = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
            made.size.x, made.size.y, made.size.z = ellipse.size
            _placed(made, ellipse.pose, ellipse.colour)
        for line in each.lines:
            made = entity.lines.add(thickness=line.width, scale_invariant=True)
            for x, y, z in line.points:
                made.points.add(x=x, y=y, z=z)
            _placed(made, line.pose, line.colour)
        for text in each.texts:
            made = entity.texts.add(billboard=True, font_size=text.size, scale_invariant=True, text=text.text)
            _placed(made, text.pose, text.colour)
    encoded: bytes = update.SerializeToString(deterministic=True)
    return encoded


def transform_class() -> Any:
    """The FrameTransform class, imported when first needed."""
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

    return FrameTransform


def transform(parent: str, pose: Pose, time_ns: int, child: str) -> bytes:
    """Where the frame `child` is in the frame `parent`."""
    made = transform_class()(parent_frame_id=parent, child_frame_id=child)
    made.timestamp.FromNanoseconds(time_ns)
    made.translation.x, made.translation.y, made.translation.z = pose.x_m, pose.y_m, pose.z_m
    made.rotation.z, made.rotation.w = math.sin(pose.yaw_rad / 2), math.cos(pose.yaw_rad / 2)
    encoded: bytes = made.SerializeToString(deterministic=True)
    return encoded


def _placed(primitive: Any, pose: Pose, colour: tuple[float, float, float, float]) -> None:
    at, turn, color = primitive.pose.position, primitive.pose.orientation, primitive.color
    at.x, at.y, at.z = pose.x_m, pose.y_m, pose.z_m
    turn.z, turn.w = math.sin(pose.yaw_rad / 2), math.cos(pose.yaw_rad / 2)
    color.r, color.g, color.b, color.a = colour
