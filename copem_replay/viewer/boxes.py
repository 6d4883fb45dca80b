"""What stands in the world: the log's boxes and paths, obstacles, a configuration's fused tracks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASS_GROUPS, CLASSES, Float, Int, Scene, Tracks
from copem_replay.perception.visibility import Statics
from copem_replay.viewer.sink import Out, f32, object_labels, slices, upright

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun as rr

EGO: Rgb = (250, 250, 250)
"""The ego and all units."""
SMALLEST_VARIANCE_M2 = 1e-6
"""Positions known better than this have no ellipse (chosen: 2 mm would not be seen)."""

ALPHAS, STEP_S = (220, 160, 120, 90, 65, 45), 0.2
"""How opaque a box is, by its age in steps of so much, the last for all that is older (chosen)."""

MOST_NAMES = 65_535
"""So many kinds of boxes the viewer can tell apart; objects past them share the last one's name."""

LANE: Rgb = (95, 95, 105)
"""Boundaries of lanes: seen, but behind all else."""
_VRU, _VEHICLE, _OTHER = (235, 120, 140), (180, 180, 190), (150, 150, 130)


def names_and_colours(scene: Scene) -> rr.AnnotationContext:
    """A kind of box per object, by its index, and per class what nobody true belongs to: name, and colour in the log.

    By class, darker where stationary. Written once, where a name in every box would be a sixth of the file.
    """
    import rerun as rr

    groups = {"vru": _VRU, "vehicles": _VEHICLE}
    colour_of = {name: colour for group, colour in reversed(groups.items()) for name in CLASS_GROUPS[group]}
    infos = []
    for k, label in enumerate(object_labels(scene).to_pylist()[: MOST_NAMES - len(CLASSES)]):
        red, green, blue = colour_of.get(CLASSES[scene.object_class[k]], _OTHER)
        still = 1 if scene.moving[k] else 2
        colour = EGO if k == scene.ego_ix else (red // still, green // still, blue // still)
        infos.append(rr.AnnotationInfo(k, label, colour))
    number = len(scene.object_ids)
    infos += [rr.AnnotationInfo(_kind(number + k), f"unmatched {name}") for k, name in enumerate(CLASSES)]
    return rr.AnnotationContext(infos)


def _kind(number: Any) -> Any:
    return np.minimum(number, MOST_NAMES).astype(np.uint16)


def truth(out: Out, scene: Scene, truth: Tracks, shown: Sequence[int]) -> None:
    """The log: all boxes; paths of the shown objects and the ego."""
    import rerun as rr

    path = ["world", "truth", "boxes"]
    _boxes(out, path, truth, lambda rows: {"class_ids": _kind(truth.row_object_ix[rows])})
    wireframe = rr.components.FillMode.MajorWireframe
    out.static(path, rr.Boxes3D.from_fields(fill_mode=wireframe, radii=0.03, show_labels=False))
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
        albedo_factor=(110, 110, 110, 100),
    )
    out.static(["world", "static"], mesh)


def lane_boundaries(out: Out, lines: Sequence[Float]) -> None:
    """The lanes, where the log has them."""
    import rerun as rr

    if len(lines):
        strips = [f32(*line.T) for line in lines]
        out.static(["world", "truth", "lanes"], rr.LineStrips3D(strips, colors=[LANE], radii=0.05))


def fused_boxes(out: Out, path: list[str], scene: Scene, fused_tracks: FusedTracks, colour: Rgb) -> None:
    """Boxes and ellipses of a configuration's lists, paler the older what they show."""
    import rerun as rr

    tracks, captured_s = fused_tracks.fused, fused_tracks.captured_s[0]
    object_ix = tracks.row_object_ix
    kind = _kind(np.where(object_ix >= 0, object_ix, len(scene.object_ids) + fused_tracks.class_of(scene)))
    shades = np.array([_rgba((*colour, alpha)) for alpha in ALPHAS], dtype=np.uint32)

    def more(rows: Int) -> dict[str, Any]:
        age_of_information_s = tracks.arrives_s[0, tracks.frame_ix[rows]] - captured_s[rows]
        step = np.clip(np.rint(age_of_information_s / STEP_S), 0, len(ALPHAS) - 1).astype(np.int64)
        return {"class_ids": kind[rows], "colors": shades[step]}

    _boxes(out, [*path, "boxes"], tracks, more)
    solid = rr.components.FillMode.TransparentFillMajorWireframe
    out.static([*path, "boxes"], rr.Boxes3D.from_fields(radii=0.04, fill_mode=solid, show_labels=False))
    _covariance(out, [*path, "covariance"], tracks, colour)


def _rgba(colour: tuple[int, int, int, int]) -> int:
    red, green, blue, alpha = colour
    return red << 24 | green << 16 | blue << 8 | alpha


def _boxes(out: Out, path: list[str], tracks: Tracks, more: Callable[[Int], dict[str, Any]]) -> None:
    """All boxes of `tracks`, list by list, from the instant each is available. `more`: further columns of rows."""
    import rerun as rr

    for rows, counts, available_ns in slices(tracks, tracks.valid[0]):
        columns = rr.Boxes3D.columns(
            centers=f32(tracks.x_m[0, rows], tracks.y_m[0, rows], tracks.z_m[0, rows]),
            half_sizes=f32(tracks.length_m[0, rows], tracks.width_m[0, rows], tracks.height_m[0, rows]) / 2,
            quaternions=upright(tracks.yaw_rad[0, rows]),
            **more(rows),
        )
        out.columns(path, available_ns, columns.partition(counts))


def _covariance(out: Out, path: list[str], tracks: Tracks, colour: Rgb) -> None:
    """2σ ellipses of the position, lying under the boxes; none where it is exact."""
    import rerun as rr

    if tracks.cov_ee_m2 is None or tracks.cov_en_m2 is None or tracks.cov_nn_m2 is None:
        return
    ee, en, nn = tracks.cov_ee_m2[0], tracks.cov_en_m2[0], tracks.cov_nn_m2[0]
    spread = tracks.valid[0] & ((ee + nn) / 2 + np.hypot((ee - nn) / 2, en) > SMALLEST_VARIANCE_M2)
    if not spread.any():
        return
    for rows, counts, available_ns in slices(tracks, spread):
        a, b, d = ee[rows], en[rows], nn[rows]
        turn = np.hypot((a - d) / 2, b)
        high, low = (a + d) / 2 + turn, np.maximum((a + d) / 2 - turn, SMALLEST_VARIANCE_M2)
        columns = rr.Ellipsoids3D.columns(
            centers=f32(tracks.x_m[0, rows], tracks.y_m[0, rows], tracks.z_m[0, rows] - tracks.height_m[0, rows] / 2),
            half_sizes=f32(2 * np.sqrt(high), 2 * np.sqrt(low), np.full(len(rows), 0.01)),
            quaternions=upright(np.arctan2(b, (a - d) / 2) / 2),
        )
        out.columns(path, available_ns, columns.partition(counts))
    solid = rr.components.FillMode.Solid
    out.static(path, rr.Ellipsoids3D.from_fields(colors=[(*colour, 55)], fill_mode=solid))
