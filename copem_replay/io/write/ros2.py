"""Writing ROS 2 messages: lists as autoware_perception_msgs/DetectedObjects, of units with track ids TrackedObjects.

`header.stamp` is the instant the list is available, `header.frame_id` the world of the recording. The twist is along
the object, as in Autoware; a pedestrian is a cylinder whose diameter is the mean of its length and width. An unknown
covariance is 0 and flagged as absent; of height, roll and pitch it is always 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, Float, Int, Scene
from copem_replay.io.encodings.cdr_bytes import encode_cdr
from copem_replay.io.encodings.column_bytes import (
    Content,
    Instants,
    RepeatedMessages,
    repeat_text,
    split_into_blocks,
    start_offsets,
)
from copem_replay.io.schemas.formats import AUTOWARE
from copem_replay.io.write.scene import pose_content

DETECTED_OBJECTS = "autoware_perception_msgs/msg/DetectedObjects"
TRACKED_OBJECTS = "autoware_perception_msgs/msg/TrackedObjects"

LABELS = {name: int(label) for label, name in AUTOWARE.items()} | {"van": 1, "other": 0, "vehicle": 0}
"""ObjectClassification.label by class: a van is a car, for it has no label of vans, nor of vehicles of any kind."""
_LABEL = np.array([LABELS[name] for name in CLASSES])
_BOUNDING_BOX, _CYLINDER = 0, 1  # Shape.type
_AVAILABLE = 2  # DetectedObjectKinematics: the orientation is known in full


class ObjectsWriter:
    """Turns the lists of one run (values (1, P)) into messages, many lists at once; `tracked`: into TrackedObjects."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, frame_id: str, *, tracked: bool = False) -> None:
        self._fused, self._rows, self._said = fused_tracks.fused, fused_tracks.listed_rows, fused_tracks.said
        object_ix = fused_tracks.fused.row_object_ix
        self._moving = np.where((object_ix >= 0) & (self._said is None), scene.moving[object_ix], True)
        self._class_ix = fused_tracks.class_of(scene)
        self.round = self._class_ix == CLASSES.index("pedestrian")
        """(P,) which objects are cylinders."""
        self._frame_id, self._tracked = frame_id, tracked

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as DetectedObjects or TrackedObjects, available at these instants (F,) of the log's clock."""
        rows, bounds = self._rows
        for first, last in split_into_blocks(bounds):
            objects = self._objects(rows[bounds[first] : bounds[last]])
            header: Content = {
                "stamp": Instants(available_ns[first:last]),
                "frame_id": repeat_text(self._frame_id, last - first),
            }
            content: Content = {
                "header": header,
                "objects": RepeatedMessages(bounds[first : last + 1] - bounds[first], objects),
            }
            yield from encode_cdr(TRACKED_OBJECTS if self._tracked else DETECTED_OBJECTS, content, last - first)

    def _objects(self, rows: Int) -> Content:
        """The content of detected or tracked objects in some rows; pedestrians and the like are cylinders."""
        fused, cylinder = self._fused, self.round[rows]
        length, width, height = (getattr(fused, name)[0, rows] for name in ("length_m", "width_m", "height_m"))
        across = (length + width) / 2
        size = {"x": np.where(cylinder, across, length), "y": np.where(cylinder, across, width), "z": height}
        return {
            **({"object_id": {"uuid": self._uuids(rows)}} if self._tracked else {}),
            "existence_probability": 1.0 if self._said is None else self._said["existence"][rows],
            "classification": self._classes(rows),
            "kinematics": self._kinematics(rows),
            "shape": {"type": np.where(cylinder, _CYLINDER, _BOUNDING_BOX), "dimensions": size},
        }

    def _uuids(self, rows: Int) -> NDArray[np.uint8]:
        """(N, 16) track ids as big-endian numbers."""
        assert self._said is not None
        ids = self._said["track_id"][rows].astype(">u8").view(np.uint8).reshape(-1, 8)
        return np.concatenate([np.zeros_like(ids), ids], axis=1)

    def _classes(self, rows: Int) -> RepeatedMessages:
        """The label of the true class, or the probability of each label: the sum over its classes."""
        if self._said is None:
            return RepeatedMessages(
                np.arange(len(rows) + 1), {"label": _LABEL[self._class_ix[rows]], "probability": 1.0}
            )
        claimed = self._said["class_probability"][rows]
        share = np.stack([claimed[:, label == _LABEL].sum(axis=1) for label in range(_LABEL.max() + 1)], axis=1)
        lead = np.where(claimed != 0, _LABEL, -1)  # of each class its label, at the first class of that label only
        for k in range(1, len(_LABEL)):
            lead[(lead[:, :k] == lead[:, k : k + 1]).any(axis=1), k] = -1
        row, kind = np.nonzero(lead >= 0)
        labels: Content = {"label": lead[row, kind], "probability": share[row, lead[row, kind]]}
        return RepeatedMessages(start_offsets((lead >= 0).sum(axis=1)), labels)

    def _kinematics(self, rows: Int) -> Content:
        """Pose, twist (along the object) and covariances of some rows as content of the message."""
        fused, moving = self._fused, self._moving[rows]
        x, y, z, yaw = (getattr(fused, name)[0, rows] for name in ("x_m", "y_m", "z_m", "yaw_rad"))
        cos, sin = np.cos(yaw), np.sin(yaw)
        vx, vy = (np.where(moving, column[0, rows], 0.0) for column in (fused.vx_mps, fused.vy_mps))
        fast = np.where(moving, self._variance("speed_var_m2ps2", rows), 0.0)
        east, cross, north, turn = (
            self._variance(name, rows) for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2", "yaw_var_rad2")
        )
        flags: Content = {
            "has_position_covariance": (east > 0) & (north > 0),
            "has_twist": moving,
            "has_twist_covariance": fast > 0,
        }
        return {
            "pose_with_covariance": {
                "pose": pose_content(x, y, z, yaw),
                "covariance": _matrix(
                    len(rows), {(0, 0): east, (0, 1): cross, (1, 0): cross, (1, 1): north, (5, 5): turn}
                ),
            },
            "orientation_availability": _AVAILABLE,
            "twist_with_covariance": {
                "twist": {"linear": {"x": cos * vx + sin * vy, "y": cos * vy - sin * vx}},
                "covariance": _matrix(len(rows), {(0, 0): fast, (1, 1): fast}),
            },
            **({"is_stationary": ~moving} if self._tracked else flags),
        }

    def _variance(self, name: str, rows: Int) -> Float:
        """Variances of `rows`, 0 where the state is exact or the variance is not known."""
        variance = getattr(self._fused, name)
        return np.zeros(len(rows)) if variance is None else np.nan_to_num(variance[0, rows])


def _matrix(rows: int, entries: Mapping[tuple[int, int], Float]) -> Float:
    """(N, 36) matrices of 6 × 6, by rows; 0 where there is no entry (N,)."""
    matrices = np.zeros((rows, 6, 6))
    for (k, other), values in entries.items():
        matrices[:, k, other] = values
    return matrices.reshape(rows, 36)
