"""ASAM OSI, the other way: a fused list as osi3.SensorData.

`timestamp` is when the list is available, `last_measurement_time` the newest capture in it. Positions are in the log's
world frame, said by an identity `mounting_position` and no host location (OSI's own frame for this message would be the
virtual sensor's). `base_rmse` holds standard deviations. `ground_truth_id` is the object's id in the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from copem_replay.chance import object_words
from copem_replay.fusion.ideal import Belief
from copem_replay.tracks import CLASSES, Float, Scene

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
    return int(number) if number.isdigit() and int(number) < 2**64 else int(object_words([object_id])[0])


def message_class() -> Any:
    """The SensorData class, imported when first needed."""
    from osi3.osi_sensordata_pb2 import SensorData

    return SensorData


class SensorDataWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, list by list.

    `unit_numbers` are the numbers by which `sensor_id` names the units that contributed.
    """

    def __init__(self, scene: Scene, belief: Belief, unit_numbers: Mapping[str, int]) -> None:
        fused = belief.fused
        self._scene, self._belief, self._fused = scene, belief, fused
        self._unit_numbers = [unit_numbers[name] for name in belief.heard.units]
        self._order, self._bounds = fused.by_frame
        self._ids = [osi_id(name) for name in scene.object_ids]
        self._columns = {
            name: getattr(fused, name)[0]
            for name in (
                "x_m",
                "y_m",
                "z_m",
                "yaw_rad",
                "vx_mps",
                "vy_mps",
                "length_m",
                "width_m",
                "height_m",
            )
        }
        self._sigma = {
            name: _sigma(getattr(fused, name), len(fused.frame_ix))
            for name in ("cov_ee_m2", "cov_nn_m2", "yaw_var_rad2", "size_var_m2", "speed_var_m2ps2")
        }

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        data = message_class()()
        data.version.version_major, data.version.version_minor, data.version.version_patch = OSI_VERSION
        _stamp(data.timestamp, available_ns)
        _stamp(data.last_measurement_time, int(self._fused.stamp_ns[frame]))
        data.mounting_position.position.SetInParent()
        data.mounting_position.orientation.SetInParent()
        rows = self._order[self._bounds[frame] : self._bounds[frame + 1]]
        for row in rows[self._fused.valid[0, rows]].tolist():
            self._add(data, row)
        encoded: bytes = data.SerializeToString(deterministic=True)
        return encoded

    def _contributors(self, row: int) -> list[tuple[int, int]]:
        """Unit index and capture stamp of each entry that the row was made of, by unit."""
        heard, entries = self._belief.heard, self._belief.entries
        mine = entries[self._belief.start[row] : self._belief.start[row + 1]]
        mine = mine[heard.valid[0, mine]]
        return list(zip(heard.row_unit_ix[mine].tolist(), heard.stamp_ns[heard.frame_ix[mine]].tolist(), strict=True))

    def _add(self, data: Any, row: int) -> None:
        number = int(self._fused.row_object_ix[row])
        moving = bool(self._scene.moving[number])
        item = data.moving_object.add() if moving else data.stationary_object.add()
        item.header.tracking_id.value = self._ids[number]
        item.header.ground_truth_id.add().value = self._ids[number]
        item.header.existence_probability = 1.0
        fresh = False
        for unit, captured_ns in self._contributors(row):
            item.header.sensor_id.add().value = self._unit_numbers[unit]
            fresh |= captured_ns == self._fused.stamp_ns[self._fused.frame_ix[row]]
        item.header.measurement_state = _MEASURED if fresh else _STALE
        value = {name: float(column[row]) for name, column in self._columns.items()}
        sigma = {name: float(column[row]) for name, column in self._sigma.items()}
        base, spread = item.base, item.base_rmse
        base.position.x, base.position.y, base.position.z = value["x_m"], value["y_m"], value["z_m"]
        base.orientation.yaw = value["yaw_rad"]
        size = base.dimension
        size.length, size.width, size.height = value["length_m"], value["width_m"], value["height_m"]
        spread.position.x, spread.position.y = sigma["cov_ee_m2"], sigma["cov_nn_m2"]
        spread.orientation.yaw = sigma["yaw_var_rad2"]
        spread.dimension.length = spread.dimension.width = spread.dimension.height = sigma["size_var_m2"]
        if moving:
            base.velocity.x, base.velocity.y = value["vx_mps"], value["vy_mps"]
            spread.velocity.x = spread.velocity.y = sigma["speed_var_m2ps2"]
            candidate = item.candidate.add()
            candidate.probability = 1.0
            candidate.type, vehicle = _OSI_TYPE[CLASSES[self._scene.object_class[number]]]
            if vehicle is not None:
                candidate.vehicle_classification.type = vehicle


def _sigma(variance: Float | None, rows: int) -> Float:
    """(P,) standard deviations; 0 where the state is exact."""
    return np.zeros(rows) if variance is None else np.sqrt(np.nan_to_num(variance[0]))


def _stamp(field: Any, time_ns: int) -> None:
    field.seconds, field.nanos = divmod(time_ns, 1_000_000_000)
