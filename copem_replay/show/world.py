"""What stands in the world: the log's boxes and paths, obstacles, what a configuration believes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from copem_replay.colours import Rgb
from copem_replay.fusion.belief import Belief
from copem_replay.show.out import Out, by_frame, elapsed_ns, f32, object_labels, upright
from copem_replay.tracks import CLASS_GROUPS, CLASSES, Int, Scene, Tracks
from copem_replay.visibility import Statics

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun as rr

EGO: Rgb = (250, 250, 250)
"""The ego and all units."""
SMALLEST_VARIANCE_M2 = 1e-6
"""Positions known better than this have no ellipse (chosen: 2 mm would not be seen)."""

_STANDING, _EGO = 100, 200  # class ids: moving objects have the index of their class
_VRU, _VEHICLE, _OTHER = (235, 120, 140), (180, 180, 190), (150, 150, 130)


def class_colours() -> rr.AnnotationContext:
    """Of the log's boxes: by class, darker where stationary."""
    import rerun as rr

    groups = {"vru": _VRU, "vehicles": _VEHICLE}
    colour_of = {name: colour for group, colour in reversed(groups.items()) for name in CLASS_GROUPS[group]}
    infos = [rr.AnnotationInfo(_EGO, "ego", EGO)]
    for k, name in enumerate(CLASSES):
        colour = colour_of.get(name, _OTHER)
        infos.append(rr.AnnotationInfo(k, name, colour))
        infos.append(rr.AnnotationInfo(_STANDING + k, f"{name}, stationary", tuple(c // 2 for c in colour)))
    return rr.AnnotationContext(infos)


def truth(out: Out, scene: Scene, truth: Tracks, shown: Sequence[int]) -> None:
    """The log: all boxes; names and paths of the shown objects."""
    import rerun as rr

    class_ids = scene.object_class.astype(np.uint16) + np.where(scene.moving, 0, _STANDING).astype(np.uint16)
    if scene.ego_ix >= 0:
        class_ids[scene.ego_ix] = _EGO
    labels = object_labels(scene).take(pa.array(truth.row_object_ix))
    _boxes(out, ["world", "truth", "boxes"], truth, class_ids[truth.row_object_ix], labels)
    wireframe = rr.components.FillMode.MajorWireframe
    out.static(["world", "truth", "boxes"], rr.Boxes3D.from_fields(fill_mode=wireframe, radii=0.03, show_labels=False))
    rows, counts = by_frame(truth, np.isin(truth.row_object_ix, shown))
    above = f32(truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows] + truth.height_m[0, rows] / 2 + 2)
    labels = object_labels(scene).take(pa.array(truth.row_object_ix[rows]))
    names = rr.Points3D.columns(positions=above, labels=labels)
    out.columns(["world", "truth", "measured"], elapsed_ns(truth), names.partition(counts))
    small = rr.Points3D.from_fields(colors=[_VRU], radii=rr.Radius.ui_points(1.5), show_labels=True)
    out.static(["world", "truth", "measured"], small)
    out.static(["world", "truth", "paths"], _paths(truth, [*shown, scene.ego_ix]))


def _paths(truth: Tracks, objects: Sequence[int]) -> rr.LineStrips3D:
    """The ways of some objects on the ground, broken where one is absent for a while."""
    import rerun as rr

    rows = np.flatnonzero(np.isin(truth.row_object_ix, objects))
    ground = f32(truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows] - truth.height_m[0, rows] / 2)
    broken = (np.diff(truth.track_ix[rows]) != 0) | (np.diff(truth.frame_ix[rows]) != 1)
    strips = np.split(ground, np.flatnonzero(broken) + 1) if len(rows) else []
    return rr.LineStrips3D(strips, colors=[(*_OTHER, 90)], radii=0.03)


def statics(out: Out, static: Statics) -> None:
    """Obstacles as prisms: a wall per edge, each with its own corners so that it is shaded flat, and a lid."""
    import rerun as rr

    if not len(static.body):
        return
    sizes = np.diff(static.start)
    part, here = np.repeat(np.arange(len(sizes)), sizes), np.arange(len(static.xy_m))
    there = here + 1
    there[static.start[1:] - 1] = static.start[:-1]
    a, b = static.xy_m[here], static.xy_m[there]
    bottom, top = static.bottom_m[part], static.top_m[part]
    corners = [f32(*a.T, bottom), f32(*b.T, bottom), f32(*b.T, top), f32(*a.T, top)]
    outward = f32((b - a)[:, 1], -(b - a)[:, 0], np.zeros(len(a)))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    up = np.tile(np.array([0, 0, 1], dtype=np.float32), (len(a), 1))
    walls = (4 * here[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    fan = (here != static.start[part]) & (there != static.start[part])
    lid = 4 * len(a) + np.stack([static.start[part], here, there], axis=-1)[fan]
    mesh = rr.Mesh3D(
        vertex_positions=np.concatenate([np.stack(corners, axis=1).reshape(-1, 3), corners[3]]),
        vertex_normals=np.concatenate([np.repeat(outward, 4, axis=0), up]),
        triangle_indices=np.concatenate([walls, lid]),
        albedo_factor=(110, 110, 110),
    )
    out.static(["world", "static"], mesh)


def believed(out: Out, path: list[str], scene: Scene, belief: Belief, colour: Rgb) -> None:
    """Boxes and ellipses of a configuration's lists."""
    import rerun as rr

    tracks, class_ix = belief.fused, belief.class_of(scene)
    _boxes(out, [*path, "boxes"], tracks, class_ix.astype(np.uint16), _labels(belief, scene, class_ix))
    solid = rr.components.FillMode.TransparentFillMajorWireframe
    style = rr.Boxes3D.from_fields(colors=[(*colour, 150)], radii=0.04, fill_mode=solid, show_labels=False)
    out.static([*path, "boxes"], style)
    _covariance(out, [*path, "covariance"], tracks, colour)


def _labels(belief: Belief, scene: Scene, class_ix: Int) -> pa.Array:
    """(P,) what each row is called: its object, or what it is taken for where there is none."""
    object_ix = belief.fused.row_object_ix
    if belief.said is None:
        return object_labels(scene).take(pa.array(object_ix))
    nobody = pa.array([f"unmatched {name}" for name in CLASSES], pa.string())
    every = pa.concat_arrays([object_labels(scene), nobody])
    return every.take(pa.array(np.where(object_ix >= 0, object_ix, len(scene.object_ids) + class_ix)))


def _boxes(out: Out, path: list[str], tracks: Tracks, class_ids: np.ndarray, labels: pa.Array) -> None:
    """All boxes of `tracks`, list by list, from the instant each list is available. `class_ids` and `labels` (P,)."""
    import rerun as rr

    rows, counts = by_frame(tracks, tracks.valid[0])
    columns = rr.Boxes3D.columns(
        centers=f32(tracks.x_m[0, rows], tracks.y_m[0, rows], tracks.z_m[0, rows]),
        half_sizes=f32(tracks.length_m[0, rows], tracks.width_m[0, rows], tracks.height_m[0, rows]) / 2,
        quaternions=upright(tracks.yaw_rad[0, rows]),
        class_ids=class_ids[rows],
        labels=labels.take(pa.array(rows)),
    )
    out.columns(path, elapsed_ns(tracks), columns.partition(counts))


def _covariance(out: Out, path: list[str], tracks: Tracks, colour: Rgb) -> None:
    """2σ ellipses of the position, lying under the boxes; none where it is exact."""
    import rerun as rr

    if tracks.cov_ee_m2 is None or tracks.cov_en_m2 is None or tracks.cov_nn_m2 is None:
        return
    a, b, d = tracks.cov_ee_m2[0], tracks.cov_en_m2[0], tracks.cov_nn_m2[0]
    turn = np.hypot((a - d) / 2, b)
    high, low = (a + d) / 2 + turn, (a + d) / 2 - turn
    rows, counts = by_frame(tracks, tracks.valid[0] & (high > SMALLEST_VARIANCE_M2))
    if not len(rows):
        return
    columns = rr.Ellipsoids3D.columns(
        centers=f32(tracks.x_m[0, rows], tracks.y_m[0, rows], tracks.z_m[0, rows] - tracks.height_m[0, rows] / 2),
        half_sizes=f32(
            2 * np.sqrt(high[rows]), 2 * np.sqrt(np.maximum(low[rows], SMALLEST_VARIANCE_M2)), np.full(len(rows), 0.01)
        ),
        quaternions=upright(np.arctan2(b, (a - d) / 2)[rows] / 2),
    )
    out.columns(path, elapsed_ns(tracks), columns.partition(counts))
    solid = rr.components.FillMode.Solid
    out.static(path, rr.Ellipsoids3D.from_fields(colors=[(*colour, 70)], fill_mode=solid))
