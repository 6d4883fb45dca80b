"""The truth of a run as a scene for Foxglove and Lichtblick: outlines, units, fields of view, texts, the ego."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from copem_replay.core.tracks import CLASSES, Scene, Tracks
from copem_replay.io.write.drawing import Ellipse, Entity, Line, Place, Pose, Rgba, Text, TruthFrame, TruthScene
from copem_replay.io.write.message_family import EGO_FRAME, MIDDLE_FRAME
from copem_replay.perception.field_of_view import outlines
from copem_replay.perception.sensor_poses import UnitPoses, mounting_height
from copem_replay.pipeline.selected_runs import OneRun

BODY: Rgba = (0.62, 0.62, 0.62, 1.0)
UNIT: Rgba = (0.85, 0.85, 0.85, 1.0)
FIELD: Rgba = (0.45, 0.45, 0.38, 1.0)
STATIC: Rgba = (0.4, 0.4, 0.4, 1.0)
"""Greys: the truth is thin and neutral, so that the colours of configurations stand out (chosen)."""
NAMED_OBJECTS = 6
"""So many measured objects have their names over them: those that configurations know at the most different times."""
MANY_MOVING = 8
"""With more moving units than these their fields of view are not drawn (chosen: they would cover the scene)."""
_MARK_M, _ABOVE_M = 0.5, 0.05


def truth_scene(one: OneRun, table: pd.DataFrame) -> TruthScene:
    """The truth of a run; `table`: the rows of `detections.parquet` of its log and run."""
    stamps_ns = one.replay.placed.stamps_ns
    fixed = [name for name, unit in one.experiment.modelled.items() if unit.at is not None and len(stamps_ns[name])]
    units = [_unit(one, name, _pose(one.replay.placed.poses[name], 0)) for name in fixed]
    follow = EGO_FRAME if one.replay.scene.ego_ix >= 0 else MIDDLE_FRAME
    return TruthScene([*_statics(one), *units], _Frames(one, named(table)), follow)


def named(table: pd.DataFrame) -> list[str]:
    """Ids of the objects that are named: of many those that configurations know at the most different times."""
    time_s = table["time_to_detection_s"].fillna(table["ended_s"] - table["onset_s"])
    apart = time_s.groupby(table["object_id"], sort=False).agg(lambda times: times.max() - times.min())
    return list(apart.sort_values(ascending=False, kind="stable").index[:NAMED_OBJECTS])


class _Frames:
    """The frames of the truth, made one at a time, as often as asked for."""

    def __init__(self, one: OneRun, names: Sequence[str]) -> None:
        self._one, self._names = one, {one.replay.scene.object_number[name] for name in names}
        moving = [name for name, unit in one.experiment.modelled.items() if unit.at is None]
        self._moving = moving if len(moving) <= MANY_MOVING else []
        self._marked = moving
        self._middle = _middle(one.replay.truth) if one.replay.scene.ego_ix < 0 else None

    def __iter__(self) -> Iterator[TruthFrame]:
        scene, truth = self._one.replay.scene, self._one.replay.truth
        order, bounds = truth.by_frame
        for frame, time_ns in enumerate(truth.stamp_ns.tolist()):
            rows = order[bounds[frame] : bounds[frame + 1]]
            rows = rows[truth.valid[0, rows]].tolist()
            bodies = [_body(scene, truth, row, named=int(truth.row_object_ix[row]) in self._names) for row in rows]
            own = [row for row in rows if truth.row_object_ix[row] == scene.ego_ix]
            followed = _at(truth, own[0]) if own else self._middle
            yield TruthFrame(time_ns, [*bodies, *self._units(time_ns)], followed)

    def _units(self, time_ns: int) -> Iterator[Entity]:
        """Carried units where they were at their newest list."""
        placed = self._one.replay.placed
        for name in self._marked:
            newest = int(np.searchsorted(placed.stamps_ns[name], time_ns, side="right")) - 1
            if newest >= 0 and placed.poses[name].present[newest]:
                pose = _pose(placed.poses[name], newest)
                yield _unit(self._one, name, pose, field=name in self._moving)


def _middle(truth: Tracks) -> Pose | None:
    """Amid all places of all objects; None: there are none."""
    there = truth.valid[0]
    if not there.any():
        return None
    return Pose(*(float(np.median(getattr(truth, name)[0, there])) for name in ("x_m", "y_m", "z_m")))


def _body(scene: Scene, truth: Tracks, row: int, *, named: bool) -> Entity:
    """An outline: the footprint, up one edge, and around the roof."""
    k = int(truth.row_object_ix[row])
    half = [float(getattr(truth, name)[0, row]) / 2 for name in ("length_m", "width_m", "height_m")]
    around = [(half[0] * a, half[1] * b) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1))]
    points: list[Place] = [(x, y, z) for z in (-half[2], half[2]) for x, y in around]
    pose, kind = _at(truth, row), CLASSES[int(scene.object_class[k])]
    says = {"object": scene.object_ids[k], "class": kind}
    over = Pose(pose.x_m, pose.y_m, pose.z_m + half[2] + _MARK_M)
    texts = [Text(f"{scene.object_ids[k]} {kind}", BODY, over)] if named or k == scene.ego_ix else []
    return Entity(scene.object_ids[k], says, [Line(points, BODY, pose)], texts)


def _unit(one: OneRun, name: str, pose: Pose, *, field: bool = True) -> Entity:
    """A mark where a unit is, its name over it, and its field of view on the ground under it."""
    replay, unit = one.replay, one.experiment.modelled[name]
    lines = []
    if field:
        down_m = _ABOVE_M - mounting_height(replay.scene, replay.truth, unit)
        for border in outlines(one.experiment.pems[str(unit.pem)].couples):
            lines.append(Line([(x, y, down_m) for x, y in border.tolist()], FIELD, pose))
    over = Pose(pose.x_m, pose.y_m, pose.z_m + _MARK_M)
    mark = Ellipse((_MARK_M, _MARK_M, _MARK_M / 2), UNIT, pose)
    return Entity(f"unit {name}", {"unit": name}, lines, [Text(name, UNIT, over)], [mark])


def _statics(one: OneRun) -> Iterator[Entity]:
    """Obstacles: the outlines of their convex parts, at the bottom and at the top."""
    static, solids = one.replay.placed.static, one.replay.placed.solids
    for part in range(len(static.body)):
        corners = static.xy_m[static.start[part] : static.start[part + 1]].tolist()
        around = [*corners, *corners[:1]]
        solid = solids[static.body[part]]
        lines = [Line([(x, y, z) for x, y in around], STATIC) for z in (solid.bottom_m, solid.top_m)]
        yield Entity(f"{solid.name}:{part}", {"obstacle": solid.name.split()[-1]}, lines)


def _at(truth: Tracks, row: int) -> Pose:
    return Pose(*(float(getattr(truth, name)[0, row]) for name in ("x_m", "y_m", "z_m", "yaw_rad")))


def _pose(poses: UnitPoses, k: int) -> Pose:
    return Pose(*(float(column[k]) for column in (poses.x_m, poses.y_m, poses.z_m, poses.heading_rad)))
