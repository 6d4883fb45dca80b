"""What stands in the world: the log's boxes and paths, obstacles, a configuration's fused tracks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.colours import TRUTH, Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, Float, Int, Scene, Tracks
from copem_replay.perception.sensor_poses import SensorPoses
from copem_replay.viewer.palette import EGO, GRID, LANE, STANDING
from copem_replay.viewer.sink import Out, f32, object_labels, slices, upright

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun as rr

SMALLEST_VARIANCE_M2 = 1e-6
"""Positions known better than this have no ellipse (chosen: 2 mm would not be seen)."""

ALPHAS, STEP_S = (220, 160, 120, 90, 65, 45), 0.2
"""How opaque a box is, by its age in steps of so much, the last for all that is older (chosen)."""

GRID_M, LONG_WAY_M = 10.0, 2000.0
"""From line to line of the grid; where ways are longer than the second, ten times that (chosen)."""
MOST_NAMES = 65_535
"""So many kinds of boxes the viewer can tell apart; objects past them share the last one's name."""


def names_and_colours(scene: Scene) -> rr.AnnotationContext:
    """A kind of box per object, by its index, and per class what belongs to no true object: name, colour in the log.

    The truth is grey, darker where stationary, the ego white. Written once, where a name in every box would be a sixth
    of the file.
    """
    import rerun as rr

    infos = []
    for k, label in enumerate(object_labels(scene).to_pylist()[: MOST_NAMES - len(CLASSES)]):
        colour = EGO if k == scene.ego_ix else TRUTH if scene.moving[k] else STANDING
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
    thin = rr.Radius.ui_points(0.6)
    out.static(path, rr.Boxes3D.from_fields(fill_mode=wireframe, radii=thin, show_labels=False))
    if scene.ego_ix >= 0:
        _ego(out, scene, truth)
    out.static(["world", "truth", "paths"], _paths(truth, [*shown, scene.ego_ix]))


def _ego(out: Out, scene: Scene, truth: Tracks) -> None:
    """The ego's body: the one that is filled, so that it is found at once."""
    import rerun as rr

    path, whole = ["world", "truth", "ego"], truth.take_tracks(truth.object_ix == scene.ego_ix)
    _boxes(out, path, whole, lambda rows: {})
    solid = rr.components.FillMode.Solid
    out.static(path, rr.Boxes3D.from_fields(colors=[(*EGO, 150)], fill_mode=solid, show_labels=False))


def _paths(truth: Tracks, objects: Sequence[int]) -> rr.LineStrips3D:
    """The ways of some objects on the ground, broken where one is absent for a while."""
    import rerun as rr

    rows = np.flatnonzero(np.isin(truth.row_object_ix, objects))
    ground = f32(truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows] - truth.height_m[0, rows] / 2)
    broken = (np.diff(truth.track_ix[rows]) != 0) | (np.diff(truth.frame_ix[rows]) != 1)
    strips = np.split(ground, np.flatnonzero(broken) + 1) if len(rows) else []
    return rr.LineStrips3D(strips, colors=[TRUTH], radii=rr.Radius.ui_points(0.5))


def grid(out: Out, truth: Tracks) -> None:
    """Lines on the ground every 10 m around all ways; every 100 m where these are long."""
    import rerun as rr

    if not len(truth.frame_ix):
        return
    x, y = truth.x_m[0], truth.y_m[0]
    step = GRID_M if max(np.ptp(x), np.ptp(y)) <= LONG_WAY_M else 10 * GRID_M
    z = float(np.median(truth.z_m[0] - truth.height_m[0] / 2))
    (west, east), (south, north) = (
        ((np.floor(of.min() / step) - 2) * step, (np.ceil(of.max() / step) + 2) * step) for of in (x, y)
    )
    along = [[[at, south, z], [at, north, z]] for at in np.arange(west, east + step / 2, step)]
    across = [[[west, at, z], [east, at, z]] for at in np.arange(south, north + step / 2, step)]
    out.static(
        ["world", "static", "grid"], rr.LineStrips3D(along + across, colors=[GRID], radii=rr.Radius.ui_points(0.5))
    )


def solids(out: Out, placed: SensorPoses) -> None:
    """Obstacles as prisms: a wall per edge, each with its own corners so that it is shaded flat, and a lid.

    Those that hide from below the ground are drawn from the ground.
    """
    import rerun as rr

    static = placed.static
    if not len(static.body):
        return
    sizes = np.diff(static.start)
    part, here = np.repeat(np.arange(len(sizes)), sizes), np.arange(len(static.xy_m))
    there = here + 1
    there[static.start[1:] - 1] = static.start[:-1]
    a, b = static.xy_m[here], static.xy_m[there]
    bottom = np.array([solid.bottom_m for solid in placed.solids])[static.body][part]
    top = static.top_m[part]
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
    out.static(["world", "static", "obstacles"], mesh)


def lane_boundaries(out: Out, lines: Sequence[Float]) -> None:
    """The lanes, where the log has them."""
    import rerun as rr

    if len(lines):
        strips = [f32(*line.T) for line in lines]
        out.static(["world", "truth", "lanes"], rr.LineStrips3D(strips, colors=[LANE], radii=rr.Radius.ui_points(0.5)))


def fused_boxes(out: Out, path: list[str], scene: Scene, fused_tracks: FusedTracks, colour: Rgb) -> None:
    """Boxes and ellipses of a configuration's lists, paler the older what they show."""
    import rerun as rr

    tracks, captured_s = fused_tracks.fused, fused_tracks.captured_s[0]
    object_ix = tracks.row_object_ix
    kind = _kind(np.where(object_ix >= 0, object_ix, len(scene.object_ids) + fused_tracks.class_of(scene)))
    shades = np.array([_rgba((*colour, alpha)) for alpha in ALPHAS], dtype=np.uint32)

    def more(rows: Int) -> dict[str, Any]:
        age_of_information_s = tracks.common_arrives_s[tracks.frame_ix[rows]] - captured_s[rows]
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
        out.flush()


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
        out.flush()
    solid = rr.components.FillMode.Solid
    out.static(path, rr.Ellipsoids3D.from_fields(colors=[(*colour, 55)], fill_mode=solid))
