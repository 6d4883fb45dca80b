"""ASAM OSI, the other way: a fused list as osi3.SensorData.

`timestamp` is when the list is available, `last_measurement_time` the newest capture in it. Positions are in the log's
world frame, said by an identity `mounting_position` and no host location (OSI's own frame for this message would be the
virtual sensor's). `base_rmse` holds standard deviations. `ground_truth_id` is the object's id in the truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.tracks import CLASSES, NO_CAPTURE_NS, Float, Int, Scene
from copem_replay.io.encodings.column_bytes import starts
from copem_replay.io.encodings.protobuf_columns import Content, Repeated, messages, where
from copem_replay.io.write.list_blocks import blocks, ranges
from copem_replay.io.write.osi_sensor_data import OSI_VERSION, message_class, osi_id

if TYPE_CHECKING:
    from copem_replay.core.fused_tracks import FusedTracks

# osi_object.proto: MovingObject.Type and MovingObject.VehicleClassification.Type by class; −1: not a vehicle
_OSI_TYPE: dict[str, tuple[int, int]] = {
    "pedestrian": (3, -1),
    "animal": (4, -1),
    "other": (1, -1),
    "vehicle": (2, 0),
    "car": (2, 4),
    "van": (2, 6),
    "truck": (2, 7),
    "trailer": (2, 9),
    "motorcycle": (2, 10),
    "bicycle": (2, 11),
    "bus": (2, 12),
}
_TYPE, _VEHICLE = np.array([_OSI_TYPE[name] for name in CLASSES]).T
_MEASURED, _STALE = 2, 1  # osi_detectedobject.proto: MEASUREMENT_STATE_MEASURED, _OTHER: from an older list only


class SensorDataWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, many lists at once.

    `unit_numbers` are the numbers by which `sensor_id` names the units that contributed.
    """

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, unit_numbers: Mapping[str, int]) -> None:
        self._scene, self._fused_tracks = scene, fused_tracks
        object_ix, said, heard = fused_tracks.fused.row_object_ix, fused_tracks.said, fused_tracks.heard
        self._moving = np.where(object_ix >= 0, scene.moving[object_ix], True)
        self._ids = np.array([osi_id(name) for name in scene.object_ids], dtype=np.uint64)
        numbers = np.array([unit_numbers[name] for name in heard.units])
        if said is None:
            self._unit = numbers[heard.row_unit_ix[fused_tracks.used]]
            self._captured_ns = heard.stamp_ns[heard.frame_ix[fused_tracks.used]]
            self._used_start = fused_tracks.used_start
        else:  # of what contributed, only the first unit and the newest capture are said
            known = said["unit_ix"] >= 0
            self._unit = numbers[said["unit_ix"][known]]
            self._captured_ns = scene.t0_ns + np.rint(said["captured_s"][known] * 1e9).astype(np.int64)
            self._used_start = np.concatenate([[0], np.cumsum(known)])

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        rows, bounds = self._fused_tracks.listed_rows
        version = dict(zip(("version_major", "version_minor", "version_patch"), OSI_VERSION, strict=True))
        for first, last in blocks(bounds):
            listed, lists = rows[bounds[first] : bounds[last]], np.diff(bounds[first : last + 1])
            captured_ns = self._fused_tracks.fused.stamp_ns[first:last]
            content: dict[str, Any] = {
                "version": version,
                "timestamp": _stamp(available_ns[first:last]),
                "mounting_position": {"position": {}, "orientation": {}},
                "last_measurement_time": where(
                    captured_ns != NO_CAPTURE_NS, _stamp(captured_ns[captured_ns != NO_CAPTURE_NS])
                ),
            }
            frame = np.repeat(np.arange(len(lists)), lists)
            for name, kind in (("moving_object", self._moving[listed]), ("stationary_object", ~self._moving[listed])):
                start = np.searchsorted(frame[kind], np.arange(len(lists) + 1))
                items = self._items(listed[kind], captured_ns[frame[kind]], name == "moving_object")
                content[name] = Repeated(start, items)
            yield from messages(message_class().DESCRIPTOR, content, last - first)

    def _items(self, rows: Int, captured_ns: Int, moving: bool) -> Content:
        """Detected objects; `captured_ns`: the newest capture of their lists."""
        fused = self._fused_tracks.fused
        x, y, z, length, width, height, yaw, vx, vy = (
            getattr(fused, name)[0, rows]
            for name in ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad", "vx_mps", "vy_mps")
        )
        around, fast = _sigma(fused.size_var_m2, rows), _sigma(fused.speed_var_m2ps2, rows)
        return {
            "header": self._header(rows, captured_ns),
            "base": {
                "position": {"x": x, "y": y, "z": z},
                "orientation": {"yaw": yaw},
                "dimension": {"length": length, "width": width, "height": height},
                **({"velocity": {"x": vx, "y": vy}} if moving else {}),
            },
            "base_rmse": {
                "position": {"x": _sigma(fused.cov_ee_m2, rows), "y": _sigma(fused.cov_nn_m2, rows)},
                "orientation": {"yaw": _sigma(fused.yaw_var_rad2, rows)},
                "dimension": dict.fromkeys(("length", "width", "height"), around),
                **({"velocity": {"x": fast, "y": fast}} if moving else {}),
            },
            **({"candidate": self._candidates(rows)} if moving else {}),
        }

    def _header(self, rows: Int, captured_ns: Int) -> Content:
        said, object_ix = self._fused_tracks.said, self._fused_tracks.fused.row_object_ix[rows]
        true_id = self._ids[object_ix[object_ix >= 0]]
        track_id = None if said is None else said["track_id"][rows]
        start, used = ranges(self._used_start, rows)
        fresh = starts(self._captured_ns[used] == np.repeat(captured_ns, np.diff(start)))
        return {
            "tracking_id": {"value": true_id}
            if track_id is None
            else where(track_id >= 0, {"value": track_id[track_id >= 0]}),
            "ground_truth_id": where(object_ix >= 0, {"value": true_id}),
            "existence_probability": 1.0 if said is None else said["existence"][rows],
            "measurement_state": np.where(np.diff(fresh[start]) > 0, _MEASURED, _STALE),
            "sensor_id": Repeated(start, {"value": self._unit[used]}),
        }

    def _candidates(self, rows: Int) -> Repeated:
        """What the objects may be: the true class, or all that the fusion says is possible."""
        said = self._fused_tracks.said
        if said is None:
            start, kind = np.arange(len(rows) + 1), self._fused_tracks.class_of(self._scene)[rows]
            share = np.ones(len(rows))
        else:
            shares = said["class_probability"][rows]
            row, kind = np.nonzero(shares)
            start, share = np.searchsorted(row, np.arange(len(rows) + 1)), shares[row, kind]
        vehicle = _VEHICLE[kind]
        classified = where(vehicle >= 0, {"type": vehicle[vehicle >= 0]})
        return Repeated(start, {"probability": share, "type": _TYPE[kind], "vehicle_classification": classified})


def _sigma(variance: Float | None, rows: Int) -> Float:
    """Standard deviations of some rows; 0 where the state is exact."""
    result: Float = np.zeros(len(rows)) if variance is None else np.sqrt(np.nan_to_num(variance[0, rows]))
    return result


def _stamp(time_ns: Int) -> Content:
    seconds, nanos = np.divmod(time_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}
