"""ASAM OSI: the decoder of osi3.GroundTruth, and of osi3.SensorView for the ground truth inside it.

Decoded with the classes of osi-python, whose wire format is common to OSI 3.0 – 3.8: the schema inside a
recording is not needed. The tables below hold value numbers, not names, because names were added and renamed
over these releases; a number that is not known reads as 0, unknown (the enums are closed).
"""

from __future__ import annotations

import itertools
import math
from array import array
from collections import Counter
from functools import cache
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import CLASSES, VALUES, Float, Solid
from copem_replay.io.channel import LAST_NS
from copem_replay.io.decoded_size import check_objects
from copem_replay.io.ground_truth import FARTHEST_M, DecodedObjects

GROUND_TRUTH = "osi3.GroundTruth"
SENSOR_VIEW = "osi3.SensorView"
SENSOR_DATA = "osi3.SensorData"
TRUTH_SCHEMAS = (GROUND_TRUTH, SENSOR_VIEW)
"""Schemas that hold the truth, the one to prefer first."""

OTHER = CLASSES.index("other")
VEHICLE = CLASSES.index("vehicle")

# osi_object.proto, MovingObject.Type: 0 unknown, 1 other, 2 vehicle, 3 pedestrian, 4 animal
_IS_VEHICLE = 2
_CLASS_OF_TYPE = {3: CLASSES.index("pedestrian"), 4: CLASSES.index("animal")}

# osi_object.proto, MovingObject.VehicleClassification.Type (OSI 3.8); what is not here is `vehicle`
_NAME_OF_VEHICLE = {
    2: "car",  # small car
    3: "car",  # compact car
    4: "car",  # (medium) car
    5: "car",  # luxury car
    6: "van",  # (delivery) van
    7: "truck",  # heavy truck
    8: "trailer",  # semitrailer
    9: "trailer",
    10: "motorcycle",  # motorbike
    11: "bicycle",
    12: "bus",
    13: "other",  # tram
    14: "other",  # train
    15: "pedestrian",  # wheelchair
    16: "truck",  # semitractor
    17: "bicycle",  # stand-up scooter
    18: "bicycle",  # micromobility device
    19: "truck",  # work machine: big, slow, hides others
    20: "other",  # watercraft
    21: "other",  # aircraft
}
_CLASS_OF_VEHICLE = {number: CLASSES.index(name) for number, name in _NAME_OF_VEHICLE.items()}

_MOST_CORNERS = 1000  # of a base polygon: visibility computes with each of them
_LAST_SECOND = LAST_NS // 10**9
_NAN = float("nan")


def osi_class_index(kind: int, vehicle: int | None) -> int:
    """Index into CLASSES, from a MovingObject's type and its type of vehicle classification (None: it has none)."""
    if kind != _IS_VEHICLE:
        return _CLASS_OF_TYPE.get(kind, OTHER)
    return VEHICLE if vehicle is None else _CLASS_OF_VEHICLE.get(vehicle, VEHICLE)


_SMALL_MESSAGE_BYTES = 1 << 20
"""An OSI message this long is within the limit: its types have some 30 fields at most."""


def check_osi(message_class: Any, payload: bytes) -> None:
    """Raises OversizeError where a message of one of OSI's classes would take too much memory."""
    if len(payload) > _SMALL_MESSAGE_BYTES:
        _osi_size(message_class).check(payload)


@cache
def _osi_size(message_class: Any) -> Any:
    from copem_replay.io.encodings.protobuf import ProtobufSize  # with Numba, which few recordings of OSI need

    return ProtobufSize(message_class.DESCRIPTOR)


class GroundTruthDecoder:
    """Collects messages of one topic: `add` each payload, then take `columns`."""

    def __init__(self) -> None:
        # Imported here: 0.03 s that `--help` need not pay.
        from osi3.osi_groundtruth_pb2 import GroundTruth
        from osi3.osi_sensorview_pb2 import SensorView

        self._message_of = {GROUND_TRUTH: GroundTruth, SENSOR_VIEW: SensorView}
        self._stamp_ns = array("q")
        self._stamped = array("b")
        self._rows = array("q")
        self._hosts: list[str] = []
        self._moving_number: dict[int, int] = {}  # OSI id → number of the object
        self._stationary_number: dict[int, int] = {}
        self._object_ix = array("q")
        self._class_ix = array("b")
        self._values = array("d")
        self._lane_boundaries: list[Float] = []
        self._solids: dict[int, Solid | None] = {}  # of stationary objects by OSI id; None: a box
        self._notes: Counter[tuple[str, str]] = Counter()  # what is counted, and what is the matter with it

    def add(self, payload: bytes, *, schema: str, log_time_ns: int, ahead_ns: int = 0) -> None:
        """Add a message of `schema`, one of `TRUTH_SCHEMAS`; one that cannot be decoded is skipped with a note.

        `ahead_ns`: how far the clock of its stamp is ahead of that of the log times. Raises OversizeError.
        """
        message_class = self._message_of[schema]
        check_osi(message_class, payload)
        try:
            message = message_class.FromString(payload)
        except DecodeError:
            self._notes["message", "cannot be decoded: skipped"] += 1
            return
        truth = message
        if schema == SENSOR_VIEW:
            if not message.HasField("global_ground_truth"):
                self._notes["message", "without global_ground_truth: skipped"] += 1
                return
            truth = message.global_ground_truth
        stamped = next((m for m in (message, truth) if m.HasField("timestamp")), None)
        if stamped is not None:
            seconds, nanos = stamped.timestamp.seconds, stamped.timestamp.nanos
        else:
            seconds, nanos = divmod(log_time_ns, 1_000_000_000)
        if abs(seconds) > _LAST_SECOND:
            self._notes["message", "with an impossible time stamp: skipped"] += 1
            return
        self._stamp_ns.append(seconds * 1_000_000_000 + nanos - (0 if stamped is None else ahead_ns))
        self._stamped.append(stamped is not None)
        self._add_host(message, truth)
        if not self._lane_boundaries and len(truth.lane_boundary):  # the lanes of one message are those of all
            self._add_lanes(truth.lane_boundary)
        before = len(self._object_ix)
        check_objects(len(truth.moving_object) + len(truth.stationary_object))
        self._add_moving(truth.moving_object)
        self._add_stationary(truth.stationary_object)
        self._rows.append(len(self._object_ix) - before)

    @property
    def states(self) -> int:
        """Number of object states of all messages that were added."""
        return len(self._object_ix)

    def columns(self) -> DecodedObjects:
        """The columns of all messages that were added: the rows are those here, without a copy; none can be added."""
        ids, moving = self._names()
        solids = tuple(solid for solid in self._solids.values() if solid is not None)
        if solids:
            self._notes["stationary object", "with a base_polygon: hides as that prism, and is no object"] = len(solids)
        return DecodedObjects(
            stamp_ns=np.array(self._stamp_ns, dtype=np.int64),
            stamped=np.array(self._stamped, dtype=bool),
            rows=np.array(self._rows, dtype=np.int64),
            object_ids=ids,
            moving=np.array(moving, dtype=bool),
            object_ix=np.asarray(self._object_ix, dtype=np.int64),
            class_ix=np.asarray(self._class_ix, dtype=np.int8),
            values=np.asarray(self._values, dtype=np.float64).reshape(-1, len(VALUES)),
            lane_boundaries=tuple(self._lane_boundaries),
            solids=solids,
            hosts=tuple(self._hosts),
            notes=tuple(f"{count_noun(number, noun)} {what}" for (noun, what), number in self._notes.items()),
        )

    def _add_host(self, message: Any, truth: Any) -> None:
        """Add the host's id: that of the ground truth, else of the sensor view around it. An id of 0 is an id."""
        for source in (truth, message):
            if source.HasField("host_vehicle_id"):
                self._hosts.append(str(source.host_vehicle_id.value))
                return

    def _add_moving(self, objects: Any) -> None:
        """Add a row for each. Reading fields costs most: each is read once, its presence only where it is 0."""
        number_of, next_number = self._moving_number, self._next_number
        add_object, add_class = self._object_ix.append, self._class_ix.append
        add_values, notes = self._values.extend, self._notes
        for moving in objects:
            ident = moving.id.value
            if ident == 0 and not moving.HasField("id"):
                notes["object state", "without an id: skipped"] += 1
                continue
            base = moving.base
            position, size, velocity = base.position, base.dimension, base.velocity
            x, y, z, yaw = position.x, position.y, position.z, base.orientation.yaw
            vx, vy = velocity.x, velocity.y
            if x == 0.0 and y == 0.0 and not base.HasField("position"):
                x = _NAN
            if yaw == 0.0 and not base.HasField("orientation"):
                notes["object state", "without orientation: yaw 0 taken"] += 1
            if vx == 0.0 and vy == 0.0 and not base.HasField("velocity"):
                vx = vy = _NAN
            kind = moving.type
            if kind == _IS_VEHICLE:
                # Only here: writers are known that classify pedestrians as some vehicle.
                add_class(_CLASS_OF_VEHICLE.get(moving.vehicle_classification.type, VEHICLE))
            else:
                add_class(_CLASS_OF_TYPE.get(kind, OTHER))
            number = number_of.get(ident)
            add_object(next_number(number_of, ident) if number is None else number)
            add_values((x, y, z, yaw, vx, vy, size.length, size.width, size.height))

    def _add_stationary(self, objects: Any) -> None:
        """Add a row of class `other`, at rest, for each; none for those with a base polygon, which become solids."""
        number_of, notes = self._stationary_number, self._notes
        for stationary in objects:
            ident = stationary.id.value
            if ident == 0 and not stationary.HasField("id"):
                notes["object state", "without an id: skipped"] += 1
                continue
            base = stationary.base
            if ident not in self._solids:
                self._solids[ident] = self._solid(ident, base)
            if self._solids[ident] is not None:
                continue
            position, size, yaw = base.position, base.dimension, base.orientation.yaw
            x, y = position.x, position.y
            if x == 0.0 and y == 0.0 and not base.HasField("position"):
                x = _NAN
            if yaw == 0.0 and not base.HasField("orientation"):
                notes["object state", "without orientation: yaw 0 taken"] += 1
            number = number_of.get(ident)
            self._object_ix.append(self._next_number(number_of, ident) if number is None else number)
            self._class_ix.append(OTHER)
            self._values.extend((x, y, position.z, yaw, 0.0, 0.0, size.length, size.width, size.height))

    def _solid(self, ident: int, base: Any) -> Solid | None:
        """The prism over an object's base polygon, as high as its box; None: no base polygon, or no simple one."""
        if not base.base_polygon:
            return None
        import shapely

        position, height_m, yaw = base.position, base.dimension.height, base.orientation.yaw
        cos, sin = math.cos(yaw), math.sin(yaw)
        corners = tuple(
            (position.x + cos * p.x - sin * p.y, position.y + sin * p.x + cos * p.y) for p in base.base_polygon
        )
        corners = corners[:-1] if corners[0] == corners[-1] else corners
        somewhere = all(abs(value) <= FARTHEST_M for value in (*itertools.chain(*corners), position.z))
        outline = shapely.Polygon(corners) if somewhere and 3 <= len(corners) <= _MOST_CORNERS else None
        if outline is None or not outline.is_valid or not outline.area > 0.0:
            self._notes["stationary object", "whose base_polygon is no simple polygon: its box taken"] += 1
            return None
        if not 0.0 < height_m <= FARTHEST_M:  # a note tells of it when its box is assembled
            return None
        return Solid(f"object {ident}", corners, position.z - height_m / 2, height_m)

    def _add_lanes(self, boundaries: Any) -> None:
        """Add the boundaries that have two points or more; points beyond `FARTHEST_M` or NaN are left out."""
        for boundary in boundaries:
            points = [(p.position.x, p.position.y, p.position.z) for p in boundary.boundary_line]
            line = np.array(points, dtype=np.float64).reshape(-1, 3)
            line = line[(np.abs(line) <= FARTHEST_M).all(axis=1)]  # no NaN, either
            if len(line) > 1:
                self._lane_boundaries.append(line)

    def _next_number(self, number_of: dict[int, int], ident: int) -> int:
        """Give a number to an object not seen before; moving and stationary ones are numbered together."""
        number_of[ident] = number = len(self._moving_number) + len(self._stationary_number)
        return number

    def _names(self) -> tuple[tuple[str, ...], list[bool]]:
        """(N,) ids as texts, and (N,) whether objects move. A stationary object may have the id of a moving one."""
        ids = [""] * (len(self._moving_number) + len(self._stationary_number))
        moving = [False] * len(ids)
        for ident, number in self._moving_number.items():
            ids[number], moving[number] = str(ident), True
        for ident, number in self._stationary_number.items():
            ids[number] = f"stationary:{ident}" if ident in self._moving_number else str(ident)
        return tuple(ids), moving


def osi_id(object_id: str) -> int:
    """The number OSI has for an object: its id where that is a number, else a stable hash of it."""
    number = object_id.removeprefix("stationary:")
    if number.isdigit() and int(number) < 2**64:
        return int(number)
    from copem_replay.core.random import object_words

    return int(object_words([object_id])[0])


def load_sensor_data_class() -> Any:
    """The SensorData class, imported when first needed."""
    from osi3.osi_sensordata_pb2 import SensorData

    return SensorData
