"""foxglove_msgs/SceneUpdate, written: the boxes that `io/write/foxglove_scene.py` draws, encoded as ROS 2 messages."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Scene
from copem_replay.io.write import cdr_writer as cdr
from copem_replay.io.write.drawing import Entity, Pose, Rgba
from copem_replay.io.write.foxglove_scene import ALPHA, metadata
from copem_replay.io.write.ros2_definitions import SCENE_UPDATE as SCHEMA

__all__ = ["SCHEMA", "SceneWriter", "drawn", "transform"]

_ALL = 1  # SceneEntityDeletion.type
_FOREVER = bytes(8)  # lifetime
_UNLOCKED = bytes(4)  # frame_locked, and up to where 4 divides

# From the cube's pose to the end of an entity: one cube, no sphere, cylinder, line, triangle, text, model.
_CUBE = np.dtype([("pose", "<f8", 7), ("size", "<f8", 3), ("color", "<f8", 4), ("none", "<u4", 6)])


class SceneWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, list by list."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, configuration: str, colour: Rgb, frame_id: str) -> None:
        self._fused, self._listed = fused_tracks.fused, fused_tracks.listed
        every, which = fused_tracks.names_of(scene)
        names, kinds = [every[k] for k in which.tolist()], fused_tracks.class_of(scene).tolist()
        made = {
            key: _entity(key[0], metadata(*key, configuration), frame_id)
            for key in dict.fromkeys(zip(names, kinds, strict=True))
        }
        self._entity = [made[key] for key in zip(names, kinds, strict=True)]
        self._color = (*(c / 255 for c in colour), ALPHA)

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        rows = self._listed(frame)
        now = cdr.stamp(available_ns)
        deletion = cdr.filled(now + bytes([_ALL, 0, 0, 0]) + cdr.text(""))
        begin = cdr.number(1) + deletion + cdr.number(len(rows))
        cubes = self._cubes(rows)
        parts = [cdr.HEAD, begin]
        at = len(begin)
        for k, row in enumerate(rows):
            entity = self._entity[row]
            at += len(now) + len(entity)
            parts += (now, entity, bytes(-at % 8), cubes[k * _CUBE.itemsize : (k + 1) * _CUBE.itemsize])
            at = 0  # a cube begins, and so ends, where 8 divides
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


def _entity(name: str, said: dict[str, str], frame_id: str) -> bytes:
    """An entity from its frame of reference to the number of its cubes."""
    texts = [cdr.filled(cdr.text(each)) for pair in said.items() for each in pair]
    head = cdr.filled(cdr.text(frame_id)) + cdr.filled(cdr.text(name)) + _FOREVER + _UNLOCKED
    return head + cdr.number(len(said)) + b"".join(texts) + cdr.number(0) + cdr.number(1)


def drawn(entities: Sequence[Entity], time_ns: int, frame_id: str) -> bytes:
    """A message that deletes all that was on its topic, and draws entities."""
    out = cdr.Cdr()
    out.add("I", 1)
    out.stamp(time_ns)
    out.add("B", _ALL)
    out.text("")
    out.add("I", len(entities))
    for each in entities:
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
            _pose(out, ellipse.pose)
            out.add("d", *ellipse.size, 1.0, 1.0, *ellipse.colour)
        out.add("I", len(each.lines))
        for line in each.lines:
            _line(out, line.points, line.width, line.pose, line.colour)
        out.add("I", 0, len(each.texts))  # triangles, texts
        for words in each.texts:
            _pose(out, words.pose)
            out.add("B", 1)  # billboard
            out.add("d", words.size)
            out.add("B", 1)  # scale_invariant
            out.add("d", *words.colour)
            out.text(words.text)
        out.add("I", 0)  # models
    return out.message()


def transform(parent: str, pose: Pose, time_ns: int, child: str) -> bytes:
    """Where the frame `child` is in the frame `parent`: foxglove_msgs/FrameTransform."""
    out = cdr.Cdr()
    out.stamp(time_ns)
    out.text(parent)
    out.text(child)
    _pose(out, pose)
    return out.message()


def _line(out: cdr.Cdr, points: Sequence[tuple[float, float, float]], width: float, pose: Pose, colour: Rgba) -> None:
    out.add("B", 0)  # LINE_STRIP
    _pose(out, pose)
    out.add("d", width)
    out.add("B", 1)  # scale_invariant
    out.add("I", len(points))
    for point in points:
        out.add("d", *point)
    out.add("d", *colour)
    out.add("I", 0, 0)  # colors, indices


def _pose(out: cdr.Cdr, pose: Pose) -> None:
    out.add("d", pose.x_m, pose.y_m, pose.z_m, 0.0, 0.0, math.sin(pose.yaw_rad / 2), math.cos(pose.yaw_rad / 2))
