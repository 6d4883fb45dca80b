"""Boxes and lines of the scene: the truth with its paths and lanes, obstacles, grid, and fused tracks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.colours import TRUTH, Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, Bool, Float, Int, Scene, Tracks
from copem_replay.perception.sensor_poses import SensorPoses
from copem_replay.viewer.camera import MovingPicture, write_false_words
from copem_replay.viewer.sink import (
    EGO,
    GRID,
    LANE,
    STANDING,
    RecordingSink,
    configuration_part,
    join_points,
    object_labels,
    slice_by_frame,
    stack_float32,
    upright_turns,
)

if TYPE_CHECKING:
    import rerun as rr


SMALLEST_VARIANCE_M2 = 1e-6
"""Least variance with an ellipse: 2σ of 2 mm could not be seen."""
STEP_M, TURN_STEP = 1 / 128, 2 * np.pi / 512
"""Ellipses are drawn in these steps of place and half axes, 8 mm, and of their turn, 0.7°: less cannot be seen, and
equal numbers take less of the file."""

ALPHAS, STEP_S = (220, 160, 120, 90, 65, 45), 0.2
"""Opacity of a box by its age of information, in steps of `STEP_S`; the last is for 1 s and older."""

GRID_M, LONG_WAY_M = 10.0, 2000.0
"""Spacing of the grid, ten times as wide where paths extend farther than the second, to keep the lines few."""
MOST_NAMES = 65_535
"""Class ids of the viewer are 16 bits; objects beyond share the last one's name."""


def names_and_colours(scene: Scene) -> rr.AnnotationContext:
    """A class id per object, by its index, and per class of entries about no object, with its name and truth colour.

    The truth is grey, darker if it never moves; the ego is white. Names are written once: in every box they would be a
    sixth of the file.
    """
    import rerun as rr

    infos = []
    for k, label in enumerate(object_labels(scene).to_pylist()[: MOST_NAMES - len(CLASSES)]):
        colour = EGO if k == scene.ego_ix else TRUTH if scene.moving[k] else STANDING
        infos.append(rr.AnnotationInfo(k, label, colour))
    number = len(scene.object_ids)
    infos += [rr.AnnotationInfo(_annotate_kind(number + k), f"unmatched {name}") for k, name in enumerate(CLASSES)]
    return rr.AnnotationContext(infos)


def _annotate_kind(number: Any) -> Any:
    return np.minimum(number, MOST_NAMES).astype(np.uint16)


def write_truth(out: RecordingSink, scene: Scene, truth: Tracks, shown: Sequence[int]) -> None:
    """Write all boxes of the truth, and the paths of the shown objects and the ego."""
    import rerun as rr

    path = ["world", "truth", "boxes"]
    _write_boxes(out, path, truth, lambda rows: {"class_ids": _annotate_kind(truth.row_object_ix[rows])})
    wireframe = rr.components.FillMode.MajorWireframe
    thin = rr.Radius.ui_points(0.6)
    out.static(path, rr.Boxes3D.from_fields(fill_mode=wireframe, radii=thin, show_labels=False))
    if scene.ego_ix >= 0:
        _write_ego(out, scene, truth)
    out.static(["world", "truth", "paths"], _path_strips(truth, [*shown, scene.ego_ix]))


def _write_ego(out: RecordingSink, scene: Scene, truth: Tracks) -> None:
    """Write the ego's box: the only filled one of the truth, so that it is easily found."""
    import rerun as rr

    path, track = ["world", "truth", "ego"], truth.take_tracks(truth.object_ix == scene.ego_ix)
    _write_boxes(out, path, track, lambda rows: {})
    solid = rr.components.FillMode.Solid
    out.static(path, rr.Boxes3D.from_fields(colors=[(*EGO, 150)], fill_mode=solid, show_labels=False))


def _path_strips(truth: Tracks, objects: Sequence[int]) -> rr.LineStrips3D:
    """Paths of objects on the ground, broken where an object is absent."""
    import rerun as rr

    rows = np.flatnonzero(np.isin(truth.row_object_ix, objects))
    ground = stack_float32(truth.x_m[0, rows], truth.y_m[0, rows], truth.z_m[0, rows] - truth.height_m[0, rows] / 2)
    broken = (np.diff(truth.track_ix[rows]) != 0) | (np.diff(truth.frame_ix[rows]) != 1)
    strips = np.split(ground, np.flatnonzero(broken) + 1) if len(rows) else []
    return rr.LineStrips3D(strips, colors=[TRUTH], radii=rr.Radius.ui_points(0.5))


def write_grid(out: RecordingSink, truth: Tracks) -> None:
    """Write lines on the ground every `GRID_M` around all paths; ten times as wide for long ones."""
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


def write_solids(out: RecordingSink, placed: SensorPoses) -> None:
    """Write obstacles as prisms: a wall per edge, with its own corners so that it is shaded flat, and a lid.

    Obstacles that reach below the ground are drawn from the ground.
    """
    import rerun as rr

    static = placed.static
    if not len(static.body):
        return
    sizes = np.diff(static.start)
    part, corner = np.repeat(np.arange(len(sizes)), sizes), np.arange(len(static.xy_m))
    next_corner = corner + 1
    next_corner[static.start[1:] - 1] = static.start[:-1]
    a, b = static.xy_m[corner], static.xy_m[next_corner]
    bottom = np.array([solid.bottom_m for solid in placed.solids])[static.body][part]
    top = static.top_m[part]
    corners = [
        stack_float32(*a.T, bottom),
        stack_float32(*b.T, bottom),
        stack_float32(*b.T, top),
        stack_float32(*a.T, top),
    ]
    outward = stack_float32((b - a)[:, 1], -(b - a)[:, 0], np.zeros(len(a)))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    up_normals = np.tile(np.array([0, 0, 1], dtype=np.float32), (len(a), 1))
    walls = (4 * corner[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    fan = (corner != static.start[part]) & (next_corner != static.start[part])
    lid = 4 * len(a) + np.stack([static.start[part], corner, next_corner], axis=-1)[fan]
    mesh = rr.Mesh3D(
        vertex_positions=np.concatenate([np.stack(corners, axis=1).reshape(-1, 3), corners[3]]),
        vertex_normals=np.concatenate([np.repeat(outward, 4, axis=0), up_normals]),
        triangle_indices=np.concatenate([walls, lid]),
        albedo_factor=(110, 110, 110, 100),
    )
    out.static(["world", "static", "obstacles"], mesh)


def write_lane_boundaries(out: RecordingSink, lines: Sequence[Float]) -> None:
    """Write the boundaries of lanes, if the log has any: lines of points (K, 3)."""
    import rerun as rr

    if len(lines):
        strips = [stack_float32(*line.T) for line in lines]
        out.static(["world", "truth", "lanes"], rr.LineStrips3D(strips, colors=[LANE], radii=rr.Radius.ui_points(0.5)))


def write_fused_boxes(
    out: RecordingSink, path: list[str], scene: Scene, fused_tracks: FusedTracks, colour: Rgb
) -> None:
    """Write boxes and ellipses of a configuration's fused tracks, paler with age of information."""
    import rerun as rr

    tracks, captured_s = fused_tracks.fused, fused_tracks.captured_s[0]
    object_ix = tracks.row_object_ix
    kind = _annotate_kind(np.where(object_ix >= 0, object_ix, len(scene.object_ids) + fused_tracks.class_of(scene)))
    shades = np.array([_pack_rgba((*colour, alpha)) for alpha in ALPHAS], dtype=np.uint32)

    def more(rows: Int) -> dict[str, Any]:
        age_of_information_s = tracks.common_arrives_s[tracks.frame_ix[rows]] - captured_s[rows]
        step = np.clip(np.rint(age_of_information_s / STEP_S), 0, len(ALPHAS) - 1).astype(np.int64)
        return {"class_ids": kind[rows], "colors": shades[step]}

    _write_boxes(out, [*path, "boxes"], tracks, more, tracks.valid[0] & (object_ix >= 0))
    solid = rr.components.FillMode.TransparentFillMajorWireframe
    out.static([*path, "boxes"], rr.Boxes3D.from_fields(radii=0.04, fill_mode=solid, show_labels=False))
    _write_covariance(out, [*path, "covariance"], tracks, colour)


class EntriesBeside:
    """Draws entries that are no object's match: false ones as dashed outlines with a cross over their boxes, with
    names; second entries of somebody, and what does not count as false, as thin outlines at their places.
    """

    def __init__(self, out: RecordingSink, name: str, colour: Rgb, picture: MovingPicture | None) -> None:
        self._out, self._name, self._colour, self._picture = out, name, colour, picture
        self._shown = {"false": False, "second": False}

    def add(self, fused_tracks: FusedTracks, false: Bool) -> None:
        """Write the entries of the next time chunk, `false (P,)` or not; an empty list gets a row if one before had
        any.
        """
        tracks = fused_tracks.fused
        second = tracks.valid[0] & (tracks.row_object_ix < 0) & ~false
        for kind, rows_of, outlines in (("false", false, _cross_corners), ("second", second, _outline)):
            if rows_of.any() or self._shown[kind]:
                self._write(kind, tracks, rows_of, outlines)

    def _write(self, kind: str, tracks: Tracks, drawn: Bool, outlines: Callable[[Tracks, Int], np.ndarray]) -> None:
        """Write outlines of `drawn` entries of one kind (as `false`, which have words), and once how they look."""
        import rerun as rr

        path, lines = ["world", configuration_part(self._name), kind], _LINES if kind == "false" else 1
        for rows, counts, available_ns in slice_by_frame(tracks, drawn):
            strips = rr.LineStrips3D.columns(strips=join_points(outlines(tracks, rows)))
            self._out.columns(path, available_ns, strips.partition(counts * lines))
            if kind == "false" and self._picture is not None:
                place_m = np.stack([tracks.x_m[0, rows], tracks.y_m[0, rows], tracks.z_m[0, rows]])
                write_false_words(self._out, self._name, self._picture, available_ns, counts, place_m)
        if not self._shown[kind]:
            radius = rr.Radius.ui_points(1.2 if kind == "false" else 0.6)
            self._out.static(path, rr.LineStrips3D.from_fields(colors=[self._colour], radii=radius))
        self._shown[kind] = True


_DASH = 0.3
"""Which part of a side is drawn from each corner: no side is closed."""
CROSS_M = 4.0
"""Least length of the lines of a cross: that over a false pedestrian would be 4 pixels wide."""
_LINES = 6
"""Lines of a false entry, of three points each: its corners, and two of the cross."""


def _find_corners(tracks: Tracks, rows: Int) -> Float:
    """(R, 4, 3) corners of boxes, at the height of their tops."""
    along = np.array([1.0, -1.0, -1.0, 1.0]) * tracks.length_m[0, rows, None] / 2
    across = np.array([1.0, 1.0, -1.0, -1.0]) * tracks.width_m[0, rows, None] / 2
    cos, sin = np.cos(tracks.yaw_rad[0, rows, None]), np.sin(tracks.yaw_rad[0, rows, None])
    top_m = np.broadcast_to((tracks.z_m[0, rows] + tracks.height_m[0, rows] / 2)[:, None], along.shape)
    x_m = tracks.x_m[0, rows, None] + cos * along - sin * across
    y_m = tracks.y_m[0, rows, None] + sin * along + cos * across
    return np.stack([x_m, y_m, top_m], axis=-1)


def _outline(tracks: Tracks, rows: Int) -> np.ndarray:
    """(R, 1, 5, 3) points of the closed outlines of boxes."""
    corner = _find_corners(tracks, rows)
    return np.concatenate([corner, corner[:, :1]], axis=1)[:, None].astype(np.float32)


def _cross_corners(tracks: Tracks, rows: Int) -> np.ndarray:
    """(R, `_LINES`, 3, 3) points of the lines of false entries, at the height of their tops; crosses reach beyond."""
    corner = _find_corners(tracks, rows)
    dashes = [corner + _DASH * (np.roll(corner, way, axis=1) - corner) for way in (1, -1)]
    corners = np.stack([dashes[0], corner, dashes[1]], axis=2)
    middle = corner.mean(axis=1, keepdims=True)
    size_m = np.linalg.norm(corner[:, :1] - corner[:, 2:3], axis=-1, keepdims=True)
    ends = middle + (corner - middle) * np.maximum(1.0, CROSS_M / np.maximum(size_m, 0.1))
    cross = [np.stack([ends[:, k], middle[:, 0], ends[:, k + 2]], axis=1) for k in (0, 1)]
    return np.concatenate([corners, np.stack(cross, axis=1)], axis=1).astype(np.float32)


def _pack_rgba(colour: tuple[int, int, int, int]) -> int:
    red, green, blue, alpha = colour
    return red << 24 | green << 16 | blue << 8 | alpha


def _write_boxes(
    out: RecordingSink, path: list[str], tracks: Tracks, look: Callable[[Int], dict[str, Any]], mask: Bool | None = None
) -> None:
    """Write the boxes of `tracks`, each list from the instant it is available. `look(rows)`: further columns of rows,
    such as colours; `mask` (P,): which are drawn, None: all valid ones.
    """
    import rerun as rr

    for rows, counts, available_ns in slice_by_frame(tracks, tracks.valid[0] if mask is None else mask):
        columns = rr.Boxes3D.columns(
            centers=stack_float32(tracks.x_m[0, rows], tracks.y_m[0, rows], tracks.z_m[0, rows]),
            half_sizes=stack_float32(tracks.length_m[0, rows], tracks.width_m[0, rows], tracks.height_m[0, rows]) / 2,
            rotation_axis_angles=upright_turns(tracks.yaw_rad[0, rows]),
            **look(rows),
        )
        out.flush()  # so that no more than two slices are held: one is sent while the next is made
        out.columns(path, available_ns, columns.partition(counts))


def _round_to_steps(values: np.ndarray, step: float) -> np.ndarray:
    """Values rounded to multiples of a step."""
    return np.asarray(np.rint(values / step) * step)


def _write_covariance(out: RecordingSink, path: list[str], tracks: Tracks, colour: Rgb) -> None:
    """Write 2σ ellipses of the positions, flat under the boxes; none for exact positions or without covariance."""
    import rerun as rr

    if tracks.cov_ee_m2 is None or tracks.cov_en_m2 is None or tracks.cov_nn_m2 is None:
        return
    ee, en, nn = tracks.cov_ee_m2[0], tracks.cov_en_m2[0], tracks.cov_nn_m2[0]
    is_spread = tracks.valid[0] & ((ee + nn) / 2 + np.hypot((ee - nn) / 2, en) > SMALLEST_VARIANCE_M2)
    if not is_spread.any():
        return
    place = tracks.x_m, tracks.y_m, tracks.z_m - tracks.height_m / 2
    for rows, counts, available_ns in slice_by_frame(tracks, is_spread):
        a, b, d = ee[rows], en[rows], nn[rows]
        half_spread = np.hypot((a - d) / 2, b)
        high, low = (a + d) / 2 + half_spread, np.maximum((a + d) / 2 - half_spread, SMALLEST_VARIANCE_M2)
        columns = rr.Ellipsoids3D.columns(
            centers=_round_to_steps(stack_float32(*(column[0, rows] for column in place)), STEP_M),
            half_sizes=stack_float32(
                *(_round_to_steps(2 * np.sqrt(of), STEP_M) for of in (high, low)), np.full(len(rows), 0.01)
            ),
            rotation_axis_angles=upright_turns(_round_to_steps(np.arctan2(b, (a - d) / 2) / 2, TURN_STEP)),
        )
        out.flush()
        out.columns(path, available_ns, columns.partition(counts))
    solid = rr.components.FillMode.Solid
    out.static(path, rr.Ellipsoids3D.from_fields(colors=[(*colour, 55)], fill_mode=solid))
