"""foxglove.SceneUpdate: a fused list as boxes for Foxglove and Lichtblick.

Every message deletes all that was on its topic and draws the list anew, so playback shows the right boxes after a seek
and nothing piles up (entities replace by id and live until deleted).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from copem_replay.colours import Rgb
from copem_replay.tracks import CLASSES, Scene, Tracks

SCHEMA = "foxglove.SceneUpdate"
FRAME_ID = "global"
"""Name of the world frame in the OSI converters of these viewers."""


def message_class() -> Any:
    """The SceneUpdate class, imported when first needed."""
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    return SceneUpdate


class SceneWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, list by list."""

    def __init__(self, scene: Scene, fused: Tracks, configuration: str, colour: Rgb) -> None:
        self._scene, self._fused, self._colour = scene, fused, tuple(c / 255 for c in colour)
        self._configuration = configuration
        self._order, self._bounds = fused.by_frame
        self._half_yaw = np.nan_to_num(fused.yaw_rad[0]) / 2

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion

        update = message_class()()
        deletion = update.deletions.add()
        deletion.type = SceneEntityDeletion.ALL
        deletion.timestamp.FromNanoseconds(available_ns)
        rows = self._order[self._bounds[frame] : self._bounds[frame + 1]]
        for row in rows[self._fused.valid[0, rows]].tolist():
            self._add(update.entities.add(), row, available_ns)
        encoded: bytes = update.SerializeToString(deterministic=True)
        return encoded

    def _add(self, entity: Any, row: int, available_ns: int) -> None:
        fused, number = self._fused, int(self._fused.row_object_ix[row])
        entity.timestamp.FromNanoseconds(available_ns)
        entity.frame_id = FRAME_ID
        entity.id = self._scene.object_ids[number]
        for key, text in (
            ("configuration", self._configuration),
            ("class", CLASSES[self._scene.object_class[number]]),
            ("object", self._scene.object_ids[number]),
        ):
            pair = entity.metadata.add()
            pair.key, pair.value = key, text
        cube = entity.cubes.add()
        at = cube.pose.position
        at.x, at.y, at.z = float(fused.x_m[0, row]), float(fused.y_m[0, row]), float(fused.z_m[0, row])
        half = self._half_yaw[row]
        cube.pose.orientation.z, cube.pose.orientation.w = float(np.sin(half)), float(np.cos(half))
        size = cube.size
        size.x, size.y, size.z = (float(getattr(fused, n)[0, row]) for n in ("length_m", "width_m", "height_m"))
        cube.color.r, cube.color.g, cube.color.b = self._colour
        cube.color.a = 0.5
