"""ASAM OSI, the other way: a fused list as osi3.SensorData.

`timestamp` is when the list is available, `last_measurement_time` the newest capture in it. Positions are in the log's
world frame, said by an identity `mounting_position` and no host location (OSI's own frame for this message would be the
virtual sensor's). `base_rmse` holds standard deviations. `ground_truth_id` is the object's id in the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.tracks import CLASSES, NO_CAPTURE_NS, VALUES, Float, Scene

if TYPE_CHECKING:
    from copem_replay.core.fused_tracks import FusedTracks

SCHEMA = "osi3.SensorData"
OSI_VERSION = (3, 8, 0)

# osi_object.proto: MovingObject.Type and MovingObject.VehicleClassification.Type by class; None: not a vehicle
_OSI_TYPE: dict[str, tuple[int, int | None]] = {
    "pedestrian": (3, None),
    "animal": (4, None),
    "other": (1, None),
    "vehicle": (2, 0),
    "car": (2, 4),
    "van": (2, 6),
    "truck": (2, 7),
    "trailer": (2, 9),
    "motorcycle": (2, 10),
    "bicycle": (2, 11),
    "bus": (2, 12),
}
_MEASURED, _STALE = 2, 1  # osi_detectedobject.proto: MEASUREMENT_STATE_MEASURED, _OTHER: from an older list only


def osi_id(object_id: str) -> int:
    """The number OSI has for an object: its id where that is a number, else a stable hash of it."""
    number = object_id.removeprefix("stationary:")
    if number.isdigit() and int(number) < 2**64:
        return int(number)
    from copem_replay.core.random import object_words  # compiled: a look at lists whose ids are numbers does without

    return int(object_words([object_id])[0])


def message_class() -> Any:
    """The SensorData class, imported when first needed."""
    from osi3.osi_sensordata_pb2 import SensorData

    return SensorData


class SensorDataWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, list by list.

    `unit_numbers` are the numbers by which `sensor_id` names the units that contributed.
    """

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, unit_numbers: Mapping[str, int]) -> None:
        fused = fused_tracks.fused
        self._fused, self._listed = fused, fused_tracks.listed
        object_ix, said = fused.row_object_ix, fused_tracks.said
        self._moving = np.where(object_ix >= 0, scene.moving[object_ix], True).tolist()
        # What is the same in every list of an object is set once, on a prototype: setting fields is what costs.
        if said is None:
            by_object = [_prototype(scene, number) for number in range(len(scene.object_ids))]
            self._prototype = [by_object[number] for number in object_ix]
        else:
            self._prototype = [_claimed(scene, k, entry) for k, entry in zip(object_ix.tolist(), said, strict=True)]
        self._values = list(zip(*(getattr(fused, name)[0].tolist() for name in VALUES), strict=True))
        spread = ("cov_ee_m2", "cov_nn_m2", "yaw_var_rad2", "size_var_m2", "speed_var_m2ps2")
        self._sigma = list(zip(*(_sigma(getattr(fused, name), len(fused.frame_ix)) for name in spread), strict=True))
        heard = fused_tracks.heard
        numbers = np.array([unit_numbers[name] for name in heard.units])
        if said is None:
            self._unit = numbers[heard.row_unit_ix[fused_tracks.used]].tolist()
            self._captured_ns = heard.stamp_ns[heard.frame_ix[fused_tracks.used]].tolist()
            self._used_start = fused_tracks.used_start.tolist()
        else:  # of what contributed, only the first unit and the newest capture are said
            known = said["unit_ix"] >= 0
            self._unit = numbers[said["unit_ix"][known]].tolist()
            self._captured_ns = (scene.t0_ns + np.rint(said["captured_s"][known] * 1e9).astype(np.int64)).tolist()
            self._used_start = np.concatenate([[0], np.cumsum(known)]).tolist()

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        data = message_class()()
        data.version.version_major, data.version.version_minor, data.version.version_patch = OSI_VERSION
        captured_ns = int(self._fused.stamp_ns[frame])
        _stamp(data.timestamp, available_ns)
        if captured_ns != NO_CAPTURE_NS:
            _stamp(data.last_measurement_time, captured_ns)
        data.mounting_position.position.SetInParent()
        data.mounting_position.orientation.SetInParent()
        for row in self._listed(frame):
            self._add(data.moving_object if self._moving[row] else data.stationary_object, row, captured_ns)
        encoded: bytes = data.SerializeToString(deterministic=True)
        return encoded

    def _add(self, items: Any, row: int, captured_ns: int) -> None:
        item = items.add()
        item.CopyFrom(self._prototype[row])
        header, base, spread = item.header, item.base, item.base_rmse
        first, last = self._used_start[row], self._used_start[row + 1]
        sensors = header.sensor_id
        for unit in self._unit[first:last]:
            sensors.add().value = unit
        header.measurement_state = _MEASURED if captured_ns in self._captured_ns[first:last] else _STALE
        position, size = base.position, base.dimension
        position.x, position.y, position.z, base.orientation.yaw, vx, vy, size.length, size.width, size.height = (
            self._values[row]
        )
        spread.position.x, spread.position.y, spread.orientation.yaw, around, fast = self._sigma[row]
        off = spread.dimension
        off.length = off.width = off.height = around
        if self._moving[row]:
            base.velocity.x, base.velocity.y = vx, vy
            spread.velocity.x = spread.velocity.y = fast


def _prototype(scene: Scene, number: int) -> Any:
    """A detected object with all that its id and class say."""
    from osi3.osi_detectedobject_pb2 import DetectedMovingObject, DetectedStationaryObject

    moving = bool(scene.moving[number])
    item = DetectedMovingObject() if moving else DetectedStationaryObject()
    item.header.tracking_id.value = osi_id(scene.object_ids[number])
    item.header.ground_truth_id.add().value = osi_id(scene.object_ids[number])
    item.header.existence_probability = 1.0
    if moving:
        candidate = item.candidate.add()
        candidate.probability = 1.0
        candidate.type, vehicle = _OSI_TYPE[CLASSES[scene.object_class[number]]]
        if vehicle is not None:
            candidate.vehicle_classification.type = vehicle
    return item


def _claimed(scene: Scene, number: int, entry: Any) -> Any:
    """A detected object as a fusion without truth ids lists it; `number` of the object it was matched with, or −1."""
    from osi3.osi_detectedobject_pb2 import DetectedMovingObject, DetectedStationaryObject

    moving = number < 0 or bool(scene.moving[number])
    item = DetectedMovingObject() if moving else DetectedStationaryObject()
    if entry["track_id"] >= 0:
        item.header.tracking_id.value = int(entry["track_id"])
    if number >= 0:
        item.header.ground_truth_id.add().value = osi_id(scene.object_ids[number])
    item.header.existence_probability = float(entry["existence"])
    for index in np.flatnonzero(entry["class_probability"]) if moving else ():
        candidate = item.candidate.add()
        candidate.probability = float(entry["class_probability"][index])
        candidate.type, vehicle = _OSI_TYPE[CLASSES[index]]
        if vehicle is not None:
            candidate.vehicle_classification.type = vehicle
    return item


def _sigma(variance: Float | None, rows: int) -> list[float]:
    """(P,) standard deviations; 0 where the state is exact."""
    return [0.0] * rows if variance is None else np.sqrt(np.nan_to_num(variance[0])).tolist()


def _stamp(field: Any, time_ns: int) -> None:
    field.seconds, field.nanos = divmod(time_ns, 1_000_000_000)
