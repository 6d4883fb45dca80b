"""autoware_perception_msgs/DetectedObjects, written: a fused list for those who drive with ROS 2.

`header.stamp` is when the list is available, `header.frame_id` the world of the recording. The twist is along the
object, as Autoware has it; a pedestrian is a cylinder whose diameter is the mean of its length and width. Where nothing
is known of the covariance, it is 0 and said to be absent; of height, roll and pitch it is always 0.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, Float, Int, Scene
from copem_replay.io.write import cdr_writer as cdr
from copem_replay.io.write.ros2_definitions import DETECTED_OBJECTS as SCHEMA

__all__ = ["LABELS", "SCHEMA", "DetectedObjectsWriter"]

LABELS = {
    "pedestrian": 7,
    "bicycle": 6,
    "motorcycle": 5,
    "car": 1,
    "van": 1,  # there is none of its own
    "truck": 2,
    "bus": 3,
    "trailer": 4,
    "animal": 8,
    "other": 0,
    "vehicle": 0,  # nor one for a vehicle of any kind
}
"""ObjectClassification.label by class."""
_LABEL = np.array([LABELS[name] for name in CLASSES])
_BOUNDING_BOX, _CYLINDER = 0, 1  # Shape.type
_AVAILABLE = 2  # DetectedObjectKinematics: the orientation is known in full

# A DetectedObject from its pose on; it begins, and so ends, where 8 divides.
_BODY = np.dtype(
    [
        ("pose", "<f8", 7),
        ("pose_covariance", "<f8", 36),
        ("has_position_covariance", "u1"),
        ("orientation_availability", "u1"),
        ("", "V6"),
        ("twist", "<f8", 6),
        ("twist_covariance", "<f8", 36),
        ("has_twist", "u1"),
        ("has_twist_covariance", "u1"),
        ("shape", "u1"),
        ("", "V1"),
        ("footprint_points", "<u4"),
        ("dimensions", "<f8", 3),
    ]
)
_EAST, _EAST_NORTH, _NORTH_EAST, _NORTH, _YAW = 0, 1, 6, 7, 35  # places in a 6 × 6 matrix by rows


class DetectedObjectsWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, list by list."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, frame_id: str) -> None:
        self._fused, self._listed, self._said = fused_tracks.fused, fused_tracks.listed, fused_tracks.said
        object_ix = fused_tracks.fused.row_object_ix
        self._moving = np.where(object_ix >= 0, scene.moving[object_ix], True)
        self._class_ix = fused_tracks.class_of(scene)
        self.round = self._class_ix == CLASSES.index("pedestrian")
        """(P,) which objects are cylinders."""
        self._certain: list[bytes] = [_head(1.0, {int(label): 1.0}) for label in _LABEL]
        self._frame_id = cdr.filled(cdr.text(frame_id))

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        rows = self._listed(frame)
        begin = cdr.stamp(available_ns) + self._frame_id + cdr.number(len(rows))
        if not rows:
            return cdr.HEAD + begin
        bodies = self._bodies(np.array(rows)).tobytes()
        parts = [cdr.HEAD, begin]
        for k, row in enumerate(rows):
            parts.append(self._head_of(row))
            if k == 0:
                parts.append(bytes(-len(begin) % 8))  # all others begin where 8 divides
            parts.append(bodies[k * _BODY.itemsize : (k + 1) * _BODY.itemsize])
        return b"".join(parts)

    def _head_of(self, row: int) -> bytes:
        if self._said is None:
            return self._certain[int(self._class_ix[row])]
        entry = self._said[row]
        share: dict[int, float] = {}
        for index in np.flatnonzero(entry["class_probability"]):
            label = int(_LABEL[index])
            share[label] = share.get(label, 0.0) + float(entry["class_probability"][index])
        return _head(float(entry["existence"]), share)

    def _bodies(self, rows: Int) -> Any:
        fused, moving, cylinder = self._fused, self._moving[rows], self.round[rows]
        body = np.zeros(len(rows), dtype=_BODY)
        yaw = fused.yaw_rad[0, rows]
        pose, covariance = body["pose"], body["pose_covariance"]
        for k, name in enumerate(("x_m", "y_m", "z_m")):
            pose[:, k] = getattr(fused, name)[0, rows]
        pose[:, 5], pose[:, 6] = np.sin(yaw / 2), np.cos(yaw / 2)
        east, north = self._variance("cov_ee_m2", rows), self._variance("cov_nn_m2", rows)
        covariance[:, _EAST], covariance[:, _NORTH] = east, north
        covariance[:, _EAST_NORTH] = covariance[:, _NORTH_EAST] = self._variance("cov_en_m2", rows)
        covariance[:, _YAW] = self._variance("yaw_var_rad2", rows)
        body["has_position_covariance"] = (east > 0) & (north > 0)
        body["orientation_availability"] = _AVAILABLE

        cos, sin = np.cos(yaw), np.sin(yaw)
        vx, vy = np.where(moving, fused.vx_mps[0, rows], 0.0), np.where(moving, fused.vy_mps[0, rows], 0.0)
        body["twist"][:, 0], body["twist"][:, 1] = cos * vx + sin * vy, cos * vy - sin * vx
        fast = np.where(moving, self._variance("speed_var_m2ps2", rows), 0.0)
        body["twist_covariance"][:, 0] = body["twist_covariance"][:, 7] = fast
        body["has_twist"], body["has_twist_covariance"] = moving, fast > 0

        length, width = fused.length_m[0, rows], fused.width_m[0, rows]
        across = (length + width) / 2
        body["shape"] = np.where(cylinder, _CYLINDER, _BOUNDING_BOX)
        body["dimensions"][:, 0] = np.where(cylinder, across, length)
        body["dimensions"][:, 1] = np.where(cylinder, across, width)
        body["dimensions"][:, 2] = fused.height_m[0, rows]
        return body

    def _variance(self, name: str, rows: Int) -> Float:
        """Of some rows; 0 where the state is exact, or it is not known."""
        known = getattr(self._fused, name)
        return np.zeros(len(rows)) if known is None else np.nan_to_num(known[0, rows])


def _head(existence: float, share: dict[int, float]) -> bytes:
    """A DetectedObject up to its pose: what it is, by label."""
    classes = (struct.pack("<B3xf", label, probability) for label, probability in share.items())
    return struct.pack("<fI", existence, len(share)) + b"".join(classes)
