"""The truth of a run as a scene for Foxglove and Lichtblick: outlines, units, fields of view, names, the ego to follow.

What an entity looks like is told once, and where it is in every frame: in columns, as fused lists are.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pandas as pd

from copem_replay.core.tracks import CLASSES, FROM_MAP, Float, Int, Scene, Tracks
from copem_replay.io.write.message_family import EGO_FRAME, MIDDLE_FRAME
from copem_replay.io.write.scene import Ellipse, Entity, Line, MovingEntities, Place, Pose, Rgba, Text, TruthScene
from copem_replay.perception.sensor_poses import couple_outlines, mounting_height
from copem_replay.pipeline.expansion import give_views
from copem_replay.pipeline.one_run import ReplayedRun

BODY: Rgba = (0.62, 0.62, 0.62, 1.0)
UNIT: Rgba = (0.85, 0.85, 0.85, 1.0)
FIELD: Rgba = (0.45, 0.45, 0.38, 1.0)
STATIC: Rgba = (0.4, 0.4, 0.4, 1.0)
LANE: Rgba = (0.35, 0.35, 0.4, 1.0)
"""Greys: the truth is thin and neutral, so that the colours of configurations stand out."""
NAMED_OBJECTS = 6
"""Measured objects with a name, at most: those that configurations detect at the most different times."""
MANY_MOVING = 8
"""With more moving units than this their fields of view are not drawn, as they would cover the scene."""
_MARK_M, _ABOVE_M = 0.5, 0.05


def draw_truth(replayed: ReplayedRun, table: pd.DataFrame) -> TruthScene:
    """The scene of a run's truth: static and moving entities, frame to follow. `table`: the run's detections."""
    replay, replayed = replayed.replay, replace(replayed, experiment=give_views(replayed.experiment))
    static = [*_draw_obstacles(replayed), *_draw_lanes(replayed)]
    for name, unit in replayed.experiment.modelled.items():
        if unit.at is not None and len(replay.placed.stamps_ns[name]):
            poses = replay.placed.poses[name]
            pose = Pose(*(float(column[0]) for column in (poses.x_m, poses.y_m, poses.z_m, poses.heading_rad)))
            static.append(_draw_unit(replayed, name, field=True).placed(pose))
    named = {replay.scene.object_number[name] for name in choose_named_objects(table)}
    follow = EGO_FRAME if replay.scene.ego_ix >= 0 else MIDDLE_FRAME
    return TruthScene(static, _draw_moving(replayed, named), _find_followed(replay.scene, replay.truth), follow)


def choose_named_objects(table: pd.DataFrame) -> list[str]:
    """Ids of the objects with a visible name: those whose detections differ most between configurations."""
    time_s = table["time_to_detection_s"].fillna(table["ended_s"] - table["onset_s"])
    apart = time_s.groupby(table["object_id"], sort=False).agg(lambda times: times.max() - times.min())
    return list(apart.sort_values(ascending=False, kind="stable").index[:NAMED_OBJECTS])


def _find_followed(scene: Scene, truth: Tracks) -> list[Pose | None]:
    """The pose to follow in each frame: the ego's, else the median of all places; None: there are neither."""
    poses: list[Pose | None] = [_find_middle(truth) if scene.ego_ix < 0 else None] * len(truth.stamp_ns)
    own = np.flatnonzero((truth.row_object_ix == scene.ego_ix) & truth.valid[0] & (scene.ego_ix >= 0))
    columns = (getattr(truth, name)[0, own].tolist() for name in ("x_m", "y_m", "z_m", "yaw_rad"))
    for frame, *pose in zip(truth.frame_ix[own].tolist(), *columns, strict=True):
        poses[frame] = Pose(*pose)
    return poses


def _find_middle(truth: Tracks) -> Pose | None:
    valid = truth.valid[0]
    if not valid.any():
        return None
    return Pose(*(float(np.median(getattr(truth, name)[0, valid])) for name in ("x_m", "y_m", "z_m")))


MOST_ROWS = 200_000
"""Rows of entities at a time, some 20 MB; frames stay whole. The messages do not depend on it."""


def _draw_moving(replayed: ReplayedRun, named: Collection[int]) -> Iterator[MovingEntities]:
    """Bodies and carried units in chunks of frames: first bodies, then units in the experiment's order."""
    scene, truth = replayed.replay.scene, replayed.replay.truth
    order, bounds = truth.by_frame
    carried = [*_draw_carried_units(replayed)]
    cuts = np.unique(np.searchsorted(bounds, np.arange(0, len(order), MOST_ROWS)))
    for begin, end in pairwise([*cuts.tolist(), len(truth.stamp_ns)]):
        bodies = _draw_bodies(scene, truth, order[bounds[begin] : bounds[end]], named)
        parts = [bodies, *(part.between(begin, end) for part in carried)]
        before = np.cumsum([0, *(len(part.looks) for part in parts)])
        frame = np.concatenate([part.frame for part in parts])
        by_frame = np.argsort(frame, kind="stable")
        start = np.searchsorted(frame, np.arange(begin, end + 1), sorter=by_frame)
        look = np.concatenate([part.look + first for part, first in zip(parts, before[:-1], strict=True)])
        poses = np.concatenate([part.poses for part in parts], axis=1)[:, by_frame]
        looks = [look for part in parts for look in part.looks]
        yield MovingEntities(looks, truth.stamp_ns[begin:end], start, look[by_frame], *poses)


class _Moving(NamedTuple):
    """Looks; of P rows the frame, the number of the look, and the pose (4, P): x, y, z, yaw."""

    looks: list[Entity]
    frame: Int
    look: Int
    poses: Float

    def between(self, begin: int, end: int) -> _Moving:
        """The rows of some frames."""
        rows = slice(*np.searchsorted(self.frame, [begin, end]))
        return self._replace(frame=self.frame[rows], look=self.look[rows], poses=self.poses[:, rows])


def _draw_bodies(scene: Scene, truth: Tracks, rows: Int, named: Collection[int]) -> _Moving:
    """Bodies of valid truth `rows`: distinct looks (object and size) and each row's look and pose (x, y, z, yaw)."""
    rows = rows[truth.valid[0, rows]]
    numbers = np.stack([truth.row_object_ix[rows], *(getattr(truth, f"{n}_m")[0, rows] for n in _SIZES)])
    by_object = np.argsort(numbers[0], kind="stable")
    ordered = numbers[:, by_object]
    is_new = np.concatenate([[True], (ordered[:, 1:] != ordered[:, :-1]).any(axis=0)])[: len(rows)]
    look = np.empty(len(rows), dtype=np.int64)
    look[by_object] = np.cumsum(is_new) - 1
    looks = [_draw_body(scene, int(k), size, named=int(k) in named) for k, *size in ordered[:, is_new].T.tolist()]
    poses = np.stack([getattr(truth, name)[0, rows] for name in ("x_m", "y_m", "z_m", "yaw_rad")])
    return _Moving(looks, truth.frame_ix[rows], look, poses)


_SIZES = ("length", "width", "height")


def _draw_body(scene: Scene, object_ix: int, size_m: list[float], *, named: bool) -> Entity:
    """The outline of an object: the footprint, up one edge, and around the roof."""
    half = [extent / 2 for extent in size_m]
    around = [(half[0] * a, half[1] * b) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1))]
    points: list[Place] = [(x, y, z) for z in (-half[2], half[2]) for x, y in around]
    name, kind = scene.object_ids[object_ix], CLASSES[int(scene.object_class[object_ix])]
    texts = [Text(f"{name} {kind}", BODY, above_m=(half[2], _MARK_M))] if named or object_ix == scene.ego_ix else []
    return Entity(name, {"object": name, "class": kind}, [Line(points, BODY)], texts)


def _draw_carried_units(replayed: ReplayedRun) -> Iterator[_Moving]:
    """Marks of each carried unit, at its poses of the newest list."""
    placed, stamps_ns = replayed.replay.placed, replayed.replay.truth.stamp_ns
    carried = [name for name, unit in replayed.experiment.modelled.items() if unit.at is None]
    for name in carried:
        newest = np.searchsorted(placed.stamps_ns[name], stamps_ns, side="right") - 1
        poses, frame = placed.poses[name], np.flatnonzero(newest >= 0)
        frame = frame[poses.present[newest[frame]]]
        look = _draw_unit(replayed, name, field=len(carried) <= MANY_MOVING)
        poses_m = np.stack([poses.x_m, poses.y_m, poses.z_m, poses.heading_rad])[:, newest[frame]]
        yield _Moving([look], frame, np.zeros_like(frame), poses_m)


def _draw_unit(replayed: ReplayedRun, name: str, *, field: bool) -> Entity:
    """A mark at a unit, its name over it, and its field of view on the ground under it."""
    replay, unit = replayed.replay, replayed.experiment.modelled[name]
    lines = []
    if field:
        down_m = _ABOVE_M - mounting_height(replay.scene, replay.truth, unit)
        for border in couple_outlines(replayed.experiment.pems[str(unit.pem)].couples):
            lines.append(Line([(x, y, down_m) for x, y in border.tolist()], FIELD))
    mark = Ellipse((_MARK_M, _MARK_M, _MARK_M / 2), UNIT)
    return Entity(f"unit {name}", {"unit": name}, lines, [Text(name, UNIT, above_m=(_MARK_M,))], [mark])


def _draw_lanes(replayed: ReplayedRun) -> Iterator[Entity]:
    """The boundaries of all lanes as one entity, if the log has any."""
    if boundaries := replayed.replay.lane_boundaries:
        yield Entity("lanes", lines=[Line([(x, y, z) for x, y, z in line.tolist()], LANE, 1.0) for line in boundaries])


def _draw_obstacles(replayed: ReplayedRun) -> Iterator[Entity]:
    """Outlines of obstacles' convex parts at bottom and top, an entity each; all solids of maps are one entity."""
    static, solids = replayed.replay.placed.static, replayed.replay.placed.solids
    of_maps: list[Line] = []
    for part in range(len(static.body)):
        corners = static.xy_m[static.start[part] : static.start[part + 1]].tolist()
        around = [*corners, *corners[:1]]
        solid = solids[static.body[part]]
        lines = [Line([(x, y, z) for x, y in around], STATIC) for z in (solid.bottom_m, solid.top_m)]
        if solid.name.startswith(FROM_MAP):
            of_maps += lines
        else:
            yield Entity(f"{solid.name}:{part}", {"obstacle": solid.name.split()[-1]}, lines)
    if of_maps:
        yield Entity("solids of maps", lines=of_maps)
