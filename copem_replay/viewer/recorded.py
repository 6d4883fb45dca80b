"""What a recording holds besides lists: images and points, of lidar or radar, behind the boxes and on their time line.

Rerun's own reader of MCAP decodes them; nothing is decoded here. Poses of sensors are those of `io/frames.py`, by their
stamps: the reader has transforms at the times of logging.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import Int
from copem_replay.io.containers.rosbag2 import list_bag_files
from copem_replay.io.frames import FrameTree, PoseTrack, SampledPoses, read_log_context
from copem_replay.io.open import DriveRecordings, fetch_place, open_log
from copem_replay.io.recording import Recording
from copem_replay.io.schemas.poses import is_pose
from copem_replay.io.schemas.registry import is_list
from copem_replay.io.stamps import SLACK_NS
from copem_replay.viewer.camera import Camera
from copem_replay.viewer.sink import ELAPSED, GROUND, TIME, RecordingSink, configuration_part, make_entity_path

if TYPE_CHECKING:
    import rerun.blueprint as rrb

RECORDED = "recorded"
"""Root of its entities, which are named after topics."""
IMAGES = {
    "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image", "foxglove.CompressedImage", "foxglove.CompressedVideo",
    "foxglove.RawImage",
}  # fmt: skip
POINTS = {"sensor_msgs/msg/PointCloud2", "foxglove.PointCloud"}
CALIBRATIONS = {"sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration"}
"""Schemas that Rerun's reader draws (0.41)."""
_LOGGED = "message_log_time", "message_publish_time"
_FRAME, _PLANE = "CoordinateFrame:frame", "Pinhole:child_frame"
_TOLD = 6  # topics named in a note, at most


@dataclass(frozen=True)
class RecordedSensors:
    """Images and points of a recording. `files`: by path, how far their clocks are ahead of the first one's, ns.

    `shift_ns`: from times of logging to the clock of the truth. `frames`: of topics whose sensor has a pose, and of
    images those with a calibration, in `pinholes`. `notes`: what is not shown, and why.
    """

    recording: Recording
    files: Mapping[Path, int]
    tree: FrameTree
    shift_ns: int
    images: tuple[str, ...]
    points: tuple[str, ...]
    frames: Mapping[str, str]
    pinholes: Mapping[str, pa.RecordBatch]
    notes: tuple[str, ...]


@contextmanager
def find_recorded_sensors(recording: Recording) -> Iterator[RecordedSensors]:
    """The sensors of a recording, which may be a copy for as long. Raises RecordingError where it cannot be read."""
    with fetch_place(recording.place) as local:
        log = open_log(local).within(recording.window)
        places = zip(local.paths, local.ahead_ns, strict=True) if isinstance(local, DriveRecordings) else [(local, 0)]
        files = {file: ns for at, ns in places for file in (list_bag_files(at) if at.is_dir() else [at])}
        images, points, calibrations = (
            tuple(dict.fromkeys(c.topic for c in log.channels if c.messages and c.schema in of))
            for of in (IMAGES, POINTS, CALIBRATIONS)
        )
        context = recording.around or log.attempt(lambda log: read_log_context(log, None, seek_ego=False))
        truth = frozenset(c.number for c in log.channels if c.topic == recording.topic)
        apart_ns = recording.scene.t0_ns - log.attempt(lambda log: next(iter(log.payloads(truth))))[1]
        named = {topic: row.column(_FRAME)[0].as_py()[0] for topic, row in _find_first(files, images + points, _FRAME)}
        planes = {row.column(_PLANE)[0].as_py()[0]: row for _, row in _find_first(files, calibrations, _PLANE)}
        pinholes = {topic: planes[named[topic]] for topic in images if named.get(topic) in planes}
        named |= {topic: row.column("Pinhole:parent_frame")[0].as_py()[0] for topic, row in pinholes.items()}
        frames = {
            topic: frame.lstrip("/")
            for topic, frame in named.items()
            if topic in points or topic in pinholes
            if (poses := _place(recording, context.frames, frame.lstrip("/"), recording.truth.stamp_ns)) is not None
            if poses.there.any()
        }
        undrawn = [
            f"{c.topic} ({c.schema or c.encoding})"
            for c in log.channels
            if c.messages and c.topic not in (*images, *points, *calibrations, recording.topic)
            if not (is_list(c) or is_pose(c) or c.schema.startswith("osi3."))
        ]
        unplaced = [topic for topic in images + points if topic not in frames]
        notes = [
            _tell("Rerun's reader of MCAP does not draw", undrawn),
            _tell("no boxes on, for want of a calibration or of transforms", unplaced),
            "" if images + points else "it has no images and no points that Rerun's reader of MCAP draws",
        ]
        yield RecordedSensors(
            recording, files, context.frames, apart_ns if abs(apart_ns) > SLACK_NS else 0, images, points, frames,
            pinholes, tuple(filter(None, notes)),
        )  # fmt: skip


def _tell(what: str, names: Sequence[str]) -> str:
    more = f", … ({len(names)} in all)" if len(names) > _TOLD else ""
    return f"{what}: {', '.join(names[:_TOLD])}{more}" if names else ""


def _find_first(files: Collection[Path], topics: Collection[str], column: str) -> Iterator[tuple[str, pa.RecordBatch]]:
    """The first row of each topic that has the column."""
    for topic in topics:
        found = (rows for path in files for _, rows in _read(path, [topic]) if column in rows.schema.names)
        if (rows := next(found, None)) is not None:
            yield topic, rows[:1]


def _read(
    path: Path, topics: Collection[str], from_ns: int | None = None, to_ns: int | None = None
) -> Iterator[tuple[str, pa.RecordBatch]]:
    """Topic and rows (times and what Rerun draws) of messages logged from `from_ns` to `to_ns`; None: no limit."""
    from rerun.chunk import McapReader

    asked, by_entity = [f"^{re.escape(topic)}$" for topic in topics], {_entity(topic): topic for topic in topics}
    try:
        reader = McapReader(path, include_topic_regex=asked, start_time_ns=from_ns, end_time_ns=to_ns)
        for chunk in reader.stream() if asked else ():
            rows = chunk.to_record_batch()
            archetypes = {f.name: (f.metadata or {}).get(b"rerun:archetype", b"") for f in rows.schema}
            drawn = [name for name, of in archetypes.items() if of.startswith(b"rerun.")]
            if rows.num_rows and not chunk.is_static and drawn:
                yield by_entity[chunk.entity_path.lstrip("/")], rows.select([*chunk.timeline_names, *drawn])
    except (RuntimeError, ValueError) as error:
        raise RecordingError(f"Rerun's reader of MCAP cannot read it: {error}", path=path) from None


def _place(recording: Recording, tree: FrameTree, frame: str, stamp_ns: Int) -> SampledPoses | None:
    """The pose of a sensor's frame in that of the truth at instants (K,); None: not known."""
    truth = recording.truth
    rows = np.flatnonzero(truth.row_object_ix == recording.scene.ego_ix)
    if recording.world or not len(rows):
        return tree.place(frame, recording.world, stamp_ns)
    ground_m, half_rad = truth.z_m[0, rows] - truth.height_m[0, rows] / 2, truth.yaw_rad[0, rows] / 2
    at_m, zero = np.stack([truth.x_m[0, rows], truth.y_m[0, rows], ground_m], axis=1), np.zeros(len(rows))
    turned = np.stack([zero, zero, np.sin(half_rad), np.cos(half_rad)], axis=1)
    course = PoseTrack("", truth.stamp_ns[truth.frame_ix[rows]], at_m, turned, np.zeros_like(at_m), tree.max_gap_s)
    return tree.place_by_ego(frame, course, stamp_ns)


def write_recorded(out: RecordingSink, sensors: RecordedSensors) -> list[str]:
    """Write images and points, calibrations, and poses of sensors. Returns notes: what is not shown, and why."""
    import rerun as rr

    scene, topics, drawn_topics = sensors.recording.scene, (*sensors.images, *sensors.points), set[str]()
    for topic, rows in sensors.pinholes.items():
        _send(out, topic, rows, None)
    for path, ahead_ns in sensors.files.items():
        shift_ns = sensors.shift_ns - ahead_ns
        span_ns = max(scene.t0_ns - shift_ns - SLACK_NS, 0), scene.end_ns - shift_ns + SLACK_NS
        for topic, rows in _read(path, topics, *span_ns):
            stamp_ns = _find_stamps(rows, shift_ns, ahead_ns)
            _send(out, topic, rows, stamp_ns - scene.t0_ns)
            drawn_topics.add(topic)
            if topic in sensors.frames and _FRAME in rows.schema.names:
                poses = _place(sensors.recording, sensors.tree, sensors.frames[topic], stamp_ns)
                assert poses is not None
                at_m, rotation = poses.position_m[poses.there], poses.rotation[poses.there]
                columns = rr.Transform3D.columns(translation=at_m, quaternion=rotation)
                out.columns([RECORDED, *_parts(topic)], stamp_ns[poses.there] - scene.t0_ns, columns)
            out.flush()
    missed = [topic for topic in topics if topic not in drawn_topics]
    return [*sensors.notes, *filter(None, [_tell("Rerun's reader finds no message while the truth lasts on", missed)])]


def _send(out: RecordingSink, topic: str, rows: pa.RecordBatch, elapsed_ns: Int | None) -> None:
    """Send what Rerun draws of rows, at instants of the log (None: at all times), at the place of their entity."""
    drawn = rows.select([name for name in rows.schema.names if ":" in name and not name.endswith(("_frame", ":frame"))])
    if not drawn.num_columns:
        return
    drawn = drawn.replace_schema_metadata()  # which has the reader's entity
    if elapsed_ns is not None:
        drawn = drawn.append_column(ELAPSED, pa.array(elapsed_ns, pa.duration("ns")))
        drawn = drawn.append_column(TIME, pa.array(out.t0_ns + elapsed_ns, pa.timestamp("ns")))
    index = None if elapsed_ns is None else [ELAPSED, TIME]
    out.send(lambda rec: rec.send_record_batch(drawn, index=index, entity_path=_entity(RECORDED, topic)))


def _find_stamps(rows: pa.RecordBatch, shift_ns: int, ahead_ns: int) -> Int:
    """(K,) instants of rows on the clock of the truth: of stamps by this clock or that of logging, else of logging."""
    times = {name: rows.column(name).cast(pa.int64()).to_numpy() for name in rows.schema.names if ":" not in name}
    logged_ns: Int = times.pop(_LOGGED[0]) + shift_ns
    own = [ns + by for name, ns in times.items() if name not in _LOGGED for by in (-ahead_ns, shift_ns)]
    return next((ns for ns in own if abs(np.median(ns - logged_ns)) <= SLACK_NS), logged_ns)


def _parts(topic: str) -> list[str]:
    return [part for part in topic.split("/") if part]


def _entity(*topics: str) -> str:
    return make_entity_path(*(part for topic in topics for part in _parts(topic))).lstrip("/")


def recorded_page(sensors: RecordedSensors, eye: Camera, configuration: str) -> rrb.Container:
    """A view per camera, with the boxes of the truth and of a configuration on its image; one of all points."""
    import rerun.blueprint as rrb

    boxes = ["+ world/truth/boxes", f"+ {make_entity_path('world', configuration_part(configuration), 'boxes')}"]
    views: list[rrb.View] = [
        rrb.Spatial2DView(
            origin=_entity(RECORDED, topic),
            name=f"{topic} · {configuration}" if topic in sensors.frames else topic,
            contents=["+ $origin", *(boxes if topic in sensors.frames else [])],
        )
        for topic in sensors.images
    ]
    if placed := [f"+ {_entity(RECORDED, topic)}" for topic in sensors.points if topic in sensors.frames]:
        place_m, target_m = eye.place_m.tolist(), eye.target_m.tolist()
        views.append(
            rrb.Spatial3DView(
                origin=make_entity_path(*eye.path),
                name=f"Points · {configuration}",
                contents=["+ world/truth/**", *boxes, *placed],
                eye_controls=rrb.EyeControls3D(position=place_m, look_target=target_m, eye_up=(0, 0, 1)),
                line_grid=False,
                background=GROUND,
            )
        )
    columns = 1 if len(views) == 1 else 2 if len(views) <= 4 else 3
    return rrb.Grid(*views, grid_columns=columns, name="Recorded")
