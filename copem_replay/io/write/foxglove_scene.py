"""foxglove.SceneUpdate: a fused list as boxes for Foxglove and Lichtblick.

Every message deletes all that was on its topic and draws the list anew, so playback shows the right boxes after a seek
and nothing piles up (entities replace by id and live until deleted).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, Scene
from copem_replay.io.write.drawing import Entity, Pose

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
    """Turns the fused lists of one run (values (1, P)) into messages, list by list."""

    def __init__(
        self, scene: Scene, fused_tracks: FusedTracks, configuration: str, colour: Rgb, frame_id: str = FRAME_ID
    ) -> None:
        fused = fused_tracks.fused
        self._listed = fused_tracks.listed
        # What is the same in every list of an object is set once, on a prototype: setting fields is what costs.
        names = [fused_tracks.name_of(scene, row) for row in range(len(fused.frame_ix))]
        kinds = fused_tracks.class_of(scene).tolist()
        made = {
            key: _prototype(key[0], metadata(*key, configuration), colour, frame_id)
            for key in dict.fromkeys(zip(names, kinds, strict=True))
        }
        self._prototype = [made[key] for key in zip(names, kinds, strict=True)]
        half = fused.yaw_rad[0] / 2
        columns = [getattr(fused, n)[0] for n in ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m")]
        self._values = list(zip(*(c.tolist() for c in (*columns, np.sin(half), np.cos(half))), strict=True))

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion

        update = message_class()()
        deletion = update.deletions.add()
        deletion.type = SceneEntityDeletion.ALL
        deletion.timestamp.FromNanoseconds(available_ns)
        for row in self._listed(frame):
            entity = update.entities.add()
            entity.CopyFrom(self._prototype[row])
            entity.timestamp.CopyFrom(deletion.timestamp)
            cube = entity.cubes[0]
            at, turn, size = cube.pose.position, cube.pose.orientation, cube.size
            at.x, at.y, at.z, size.x, size.y, size.z, turn.z, turn.w = self._values[row]
        encoded: bytes = update.SerializeToString(deterministic=True)
        return encoded


def metadata(name: str, class_ix: int, configuration: str) -> dict[str, str]:
    """What a click on a box tells."""
    return {"configuration": configuration, "class": CLASSES[class_ix], "object": name}


def _prototype(name: str, said: dict[str, str], colour: Rgb, frame_id: str) -> Any:
    """A box with all that its object and its configuration say."""
    from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity

    entity = SceneEntity(frame_id=frame_id, id=name)
    for key, text in said.items():
        entity.metadata.add(key=key, value=text)
    color = entity.cubes.add().color
    color.r, color.g, color.b = (c / 255 for c in colour)
    color.a = ALPHA
    return entity


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
