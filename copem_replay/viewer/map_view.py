"""The map view of a recording, where it is asked for (`show: {map: true}`): what stands, units and the truth on earth.

Rerun's viewer fetches the ground of such a view, tiles of a map, from a server of its provider, which so learns where
the drive was. That is why it is not written by itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from copem_replay.core.colours import TRUTH
from copem_replay.core.frame import Frame
from copem_replay.core.tracks import Float, Scene, Tracks
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.sink import EGO, HIDES, LANE, STANDING, RecordingSink, slice_by_frame

if TYPE_CHECKING:
    import rerun.blueprint as rrb

    from copem_replay.experiment.schema import Experiment

MAP: Final = "map"
"""Root of its entities: they are degrees, not metres."""
NO_PLACE: Final = "no map view: it is not known where the log is on earth; write `frame: {proj: …}`"


def asks_for_map(experiment: Experiment) -> bool:
    """Whether an experiment has `show: {map: true}`."""
    return experiment.show is not None and experiment.show.map


def map_page(title: str = "Map") -> rrb.Container:
    """The page of the map view, around all that it shows."""
    import rerun.blueprint as rrb

    return rrb.Tabs(rrb.MapView(origin=MAP, name=title), name=title)


def write_map(out: RecordingSink, replay: Replay, experiment: Experiment, frame: Frame) -> None:
    """Write static things as lines and points, and the centres of the truth frame by frame."""
    import rerun as rr

    thin = rr.Radius.ui_points(1.0)
    lines = [frame.to_wgs84(line[:, :2]) for line in replay.lane_boundaries]
    walls = [frame.to_wgs84([*solid.corners_m, solid.corners_m[0]]) for solid in replay.placed.solids]
    for name, strips, colour in (("lanes", lines, LANE), ("solids", walls, HIDES)):
        if strips:
            out.static([MAP, name], rr.GeoLineStrings(lat_lon=strips, radii=thin, colors=[colour]))
    standing = [unit.at for unit in experiment.units.values() if unit.at is not None]
    if standing:
        points = rr.GeoPoints(lat_lon=frame.to_wgs84(standing), radii=rr.Radius.ui_points(6.0), colors=[EGO])
        out.static([MAP, "units"], points)
    _write_objects(out, replay.scene, replay.truth, frame)


def _write_objects(out: RecordingSink, scene: Scene, truth: Tracks, frame: Frame) -> None:
    import rerun as rr

    path = [MAP, "truth"]
    colours = _pack_colours(scene)
    for rows, counts, available_ns in slice_by_frame(truth, truth.valid[0]):
        degrees = frame.to_wgs84(np.stack([truth.x_m[0, rows], truth.y_m[0, rows]], axis=1))
        columns = rr.GeoPoints.columns(positions=degrees, colors=colours[truth.row_object_ix[rows]])
        out.columns(path, available_ns, columns.partition(counts))
    out.static(path, rr.GeoPoints.from_fields(radii=rr.Radius.ui_points(4.0)))


def _pack_colours(scene: Scene) -> Float:
    """(N,) the colour of each object as elsewhere: the ego white, what moves in the truth's grey, the rest darker."""
    rgb = np.where(scene.moving[:, None], np.array(TRUTH), np.array(STANDING))
    if scene.ego_ix >= 0:
        rgb[scene.ego_ix] = EGO
    packed: Float = rgb @ np.array([1 << 24, 1 << 16, 1 << 8]) + 255
    return packed.astype(np.uint32)
