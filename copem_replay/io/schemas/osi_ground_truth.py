"""ASAM OSI: the decoder of osi3.GroundTruth, and of osi3.SensorView for the ground truth inside it.

Decoded with the classes of osi-python, whose wire format is common to OSI 3.0 – 3.8: the schema inside a
recording is not needed. The tables below hold value numbers, not names, because names were added and renamed
over these releases; a number that is not known reads as 0, unknown (the enums are closed).
"""

from __future__ import annotations

import itertools
import math
from array import array
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from copem_replay.core.frame import SaidPlace
from copem_replay.core.tracks import CLASSES, VALUES, Solid
from copem_replay.io.channel import LAST_NS
from copem_replay.io.decoded_size import DecodeAllowance, check_objects
from copem_replay.io.findings import FARTHEST_M, find
from copem_replay.io.ground_truth import DecodedObjects, take_messages
from copem_replay.io.schemas.osi_lanes import OsiRoad, read_road
from copem_replay.io.stamps import settle_stamps

GROUND_TRUTH = "osi3.GroundTruth"
SENSOR_VIEW = "osi3.SensorView"
SENSOR_DATA = "osi3.SensorData"
EMBEDDED_MAP = "osi3.MapAsamOpenDrive"  # of omega-prime, not of OSI
TRUTH_SCHEMAS = (GROUND_TRUTH, SENSOR_VIEW)
"""Schemas that hold the truth, the one to prefer first."""

OTHER = CLASSES.index("other")
VEHICLE = CLASSES.index("vehicle")

# osi_object.proto, MovingObject.Type: 0 unknown, 1 other, 2 vehicle, 3 pedestrian, 4 animal
_IS_VEHICLE = 2
_CLASS_OF_TYPE = {3: CLASSES.index("pedestrian"), 4: CLASSES.index("animal")}

# osi_object.proto, MovingObject.VehicleClassification.Type (OSI 3.8); what is not here is `vehicle`
_NAME_OF_VEHICLE = {
    **dict.fromkeys((2, 3, 4, 5), "car"),  # small, compact, medium, luxury car
    6: "van",  # (delivery) van
    **dict.fromkeys((7, 16, 19), "truck"),  # heavy truck, semitractor, work machine: big, slow, hides others
    **dict.fromkeys((8, 9), "trailer"),  # semitrailer, trailer
    10: "motorcycle",  # motorbike
    **dict.fromkeys((11, 17, 18), "bicycle"),  # bicycle, stand-up scooter, micromobility device
    12: "bus",
    **dict.fromkeys((13, 14, 20, 21), "other"),  # tram, train, watercraft, aircraft
    15: "pedestrian",  # wheelchair
}
_CLASS_OF_VEHICLE = {number: CLASSES.index(name) for number, name in _NAME_OF_VEHICLE.items()}

_MOST_CORNERS = 1000  # of a base polygon: visibility computes with each of them
_NAN = float("nan")


def osi_stamp_ns(stamp: Any) -> int | None:
    """An osi3.Timestamp in ns; None: impossible, beyond `LAST_NS` or with more nanoseconds than a second has."""
    whole_ns = int(stamp.seconds) * 10**9
    return whole_ns + stamp.nanos if abs(whole_ns) <= LAST_NS and stamp.nanos <= 10**9 else None


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


_Place = tuple[int, int, int]
"""Of a note: the message, whether the object is stationary, its place in the list."""


class GroundTruthDecoder:
    """Collects messages of one topic: `add` each payload, then take `columns`.

    `allowance`: memory that all of them may take.
    """

    def __init__(self, allowance: DecodeAllowance) -> None:
        self._message_of = {schema: load_message_class(schema) for schema in TRUTH_SCHEMAS}
        self._allowance = allowance
        self._stamp_ns = array("q")
        self._stamped = array("b")
        self._log_time_ns, self._ahead_ns = array("q"), array("q")
        self._hosts: list[str] = []
        self._moving_number: dict[int, int] = {}  # OSI id → number of the object
        self._stationary_number: dict[int, int] = {}
        self._rows = array("q")  # number of rows of each message
        self._object_ix, self._class_ix, self._values = array("q"), array("b"), array("d")  # moving objects first
        self._road = OsiRoad()  # of the first message that has one: the lanes of one message are those of all
        self._place: SaidPlace | None = None
        self._earlier: list[tuple[OsiRoad, Any]] = []  # the first road or place on earth before the window
        self._standing: dict[int, tuple[float, ...]] = {}  # values of stationary objects by OSI id, as last sent
        self._solids: dict[int, Solid | None] = {}  # of stationary objects by OSI id; None: a box
        self._notes: dict[str, tuple[int, _Place]] = {}  # by rule: how many, and where the first is
        self._messages = 0

    def add(self, payload: bytes, *, schema: str, log_time_ns: int, ahead_ns: int = 0) -> None:
        """Add a message of `schema` (one of `TRUTH_SCHEMAS`); one that cannot be decoded gives only a note. `ahead_ns`:
        how far the clock of its stamp is ahead of that of the log times. Raises OversizeError.
        """
        message_class = self._message_of[schema]
        self._messages += 1
        check_osi(message_class, payload)
        try:
            message = message_class.FromString(payload)
        except DecodeError:
            self._note("undecoded", (self._messages, 0, 0))
            return
        truth = message
        if schema == SENSOR_VIEW:
            if not message.HasField("global_ground_truth"):
                self._note("no ground truth", (self._messages, 0, 0))
                return
            truth = message.global_ground_truth
        stamped = next((m for m in (message, truth) if m.HasField("timestamp")), None)
        stamp_ns = None if stamped is None else osi_stamp_ns(stamped.timestamp)
        if stamped is not None and stamp_ns is None:
            self._note("stamp impossible", (self._messages, 0, 0))
        log_time_ns = min(log_time_ns, LAST_NS)
        self._stamp_ns.append(log_time_ns if stamp_ns is None else stamp_ns - ahead_ns)
        self._stamped.append(stamp_ns is not None)
        self._log_time_ns.append(log_time_ns)
        self._ahead_ns.append(ahead_ns)
        self._add_host(message, truth)
        if truth.proj_string:
            self._add_place(truth, self._stamp_ns[-1])
        self._road = self._road or read_road(truth)
        check_objects(len(truth.moving_object) + len(truth.stationary_object))
        before = len(self._object_ix)
        self._add_moving(truth.moving_object)
        self._add_stationary(truth.stationary_object)
        self._rows.append(len(self._object_ix) - before)
        self._allowance.spend(0, self._rows[-1])

    def add_earlier(self, payload: bytes, schema: str) -> None:
        """Take what stays of a message before those that are read: road, place, what stands. Raises OversizeError."""
        check_osi(self._message_of[schema], payload)
        with suppress(DecodeError):
            message = self._message_of[schema].FromString(payload)
            truth = message.global_ground_truth if schema == SENSOR_VIEW else message
            if not self._earlier and ((road := read_road(truth)) or truth.proj_string):
                self._earlier.append((road, truth))
            check_objects(len(truth.stationary_object))
            self._find_standing(truth.stationary_object, report=False)

    def columns(self) -> DecodedObjects:
        """The columns of all messages that were added; none can be added after. Raises OversizeError."""
        for road, truth in self._earlier:
            self._road = self._road or road
            if truth.proj_string and self._place is None:
                self._add_place(truth, 0)
        ids, moving = self._names()
        solids = tuple(solid for solid in self._solids.values() if solid is not None)
        counts = [(rule, number) for rule, (number, _) in sorted(self._notes.items(), key=lambda item: item[1][1])]
        notes = [note for rule, number in (*counts, ("prism", len(solids))) for note in find(rule, number)]
        logged_ns, ahead_ns = (np.array(times, dtype=np.int64) for times in (self._log_time_ns, self._ahead_ns))
        stamp_ns, stamped, keep, findings = settle_stamps(
            np.array(self._stamp_ns, dtype=np.int64),
            np.array(self._stamped, dtype=bool),
            logged_ns,
            ahead_ns=ahead_ns,
            noted=self._notes.get("stamp impossible", (0,))[0],
        )
        columns = DecodedObjects(
            stamp_ns=stamp_ns,
            stamped=stamped,
            log_time_ns=logged_ns,
            object_ids=ids,
            moving=np.array(moving, dtype=bool),
            rows=np.asarray(self._rows, dtype=np.int64),  # without a copy, as those that follow
            object_ix=np.asarray(self._object_ix, dtype=np.int64),
            class_ix=np.asarray(self._class_ix, dtype=np.int8),
            values=np.asarray(self._values, dtype=np.float64).reshape(-1, len(VALUES)),
            lane_boundaries=tuple(self._road.lines),
            lanes=tuple(self._road.lanes),
            areas=tuple(self._road.crosswalks),
            place=self._place,
            solids=solids,
            hosts=tuple(self._hosts),
            notes=(*notes, *findings, *self._road.notes),
        )
        return take_messages(columns, keep)

    def _add_host(self, message: Any, truth: Any) -> None:
        """Add the host's id: that of the ground truth, else of the sensor view around it. An id of 0 is an id."""
        for source in (truth, message):
            if source.HasField("host_vehicle_id"):
                self._hosts.append(str(source.host_vehicle_id.value))
                return

    def _add_place(self, truth: Any, stamp_ns: int) -> None:
        """Take the place on earth that a message says, or that it says another than one before."""
        offset = truth.proj_frame_offset
        place = SaidPlace(truth.proj_string, (offset.position.x, offset.position.y), offset.yaw)
        if self._place is None:
            self._place = place
        elif not self._place.changed and place != self._place:
            what = "proj_string" if place.proj != self._place.proj else "proj_frame_offset"
            before, now = (repr(one.proj) if what == "proj_string" else one[1:3] for one in (self._place, place))
            changed = f"{what} is {before} first and {now} at {stamp_ns / 1e9:.3f} s: expected one of all messages"
            self._place = place._replace(changed=changed)

    def _add_moving(self, objects: Any) -> None:
        """Add a row for each moving object. Speed: each field is read once, its presence only where it is 0."""
        number_of, next_number = self._moving_number, self._next_number
        add_object, add_class, add_values = self._object_ix.append, self._class_ix.append, self._values.extend
        for k, moving in enumerate(objects):
            ident = moving.id.value
            if ident == 0 and not moving.HasField("id"):
                self._note("no id", (self._messages, 0, k))
                continue
            base = moving.base
            position, size, velocity = base.position, base.dimension, base.velocity
            x, y, z, yaw = position.x, position.y, position.z, base.orientation.yaw
            vx, vy = velocity.x, velocity.y
            if 0.0 in (x, y, z, yaw, vx, vy):
                (x, y, z, yaw, vx, vy), rules = check_zeros(base, (x, y, z, yaw, vx, vy))
                for rule in rules:
                    self._note(rule, (self._messages, 0, k))
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
        """Add a row of class `other`, at rest, for each stationary object; those with a base polygon become solids.
        Many writers send them once. They stay until a message that repeats some of them leaves them out.
        """
        self._find_standing(objects)
        number_of = self._stationary_number
        for ident, values in self._standing.items():
            number = number_of.get(ident)
            self._object_ix.append(self._next_number(number_of, ident) if number is None else number)
            self._class_ix.append(OTHER)
            self._values.extend(values)

    def _find_standing(self, objects: Any, *, report: bool = True) -> None:
        """Update which stationary objects stand, by those of a message; `report`: notes on what is odd."""
        sent: dict[int, tuple[float, ...]] = {}
        for k, stationary in enumerate(objects):
            place, rules = (self._messages, 1, k), list[str]()
            ident = stationary.id.value
            if ident == 0 and not stationary.HasField("id"):
                rules.append("no id")
            else:
                if ident not in self._solids:
                    self._solids[ident] = self._solid(ident, stationary.base, place)
                if self._solids[ident] is None:
                    base = stationary.base
                    position, size = base.position, base.dimension
                    state: tuple[float, ...] = (position.x, position.y, position.z, base.orientation.yaw)
                    state, rules = check_zeros(base, state) if 0.0 in state else (state, rules)
                    if ident in sent:
                        rules.append("twice")
                    sent.setdefault(ident, (*state, 0.0, 0.0, size.length, size.width, size.height))
            for rule in rules if report else ():
                self._note(rule, place)
        not_repeated = len(self._standing.keys() - sent.keys())
        if self._standing.keys().isdisjoint(sent):
            if not_repeated and report:
                self._note("stands", (self._messages, 1, 0), not_repeated)
            sent = self._standing | sent
        self._standing = sent

    def _note(self, rule: str, at: _Place, number: int = 1) -> None:
        """Count a finding; `at`: the message, whether the object is stationary, its place in the list."""
        before, first = self._notes.get(rule, (0, at))
        self._notes[rule] = before + number, min(first, at)

    def _solid(self, ident: int, base: Any, place: _Place) -> Solid | None:
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
        is_near = all(abs(value) <= FARTHEST_M for value in (*itertools.chain(*corners), position.z))
        outline = shapely.Polygon(corners) if is_near and 3 <= len(corners) <= _MOST_CORNERS else None
        if outline is None or not outline.is_valid or not outline.area > 0.0:
            self._note("polygon", place)
            return None
        if not 0.0 < height_m <= FARTHEST_M:  # a note tells of it when its box is assembled
            return None
        return Solid(f"object {ident}", corners, position.z - height_m / 2, height_m)

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


def check_zeros(base: Any, values: tuple[float, ...]) -> tuple[tuple[float, ...], list[str]]:
    """x, y, z, yaw (vx, vy) of an object, NaN for a place and a velocity that are not said, and the rules that apply.

    Some writers leave a number out where it is 0. Presence costs, so it is asked only of zeros.
    """
    has = base.HasField
    x, y, z, yaw, *speed = values
    has_place, has_turn, has_velocity = has("position"), has("orientation"), bool(speed) and has("velocity")
    rules = [] if has_turn else ["yaw unset"]
    lacks = has_turn and yaw == 0.0 and not base.orientation.HasField("yaw")
    if has_place and not lacks:
        has = base.position.HasField
        lacks = (z == 0.0 and not has("z")) or (x == 0.0 and not has("x")) or (y == 0.0 and not has("y"))
    if has_velocity and not lacks:
        has = base.velocity.HasField
        lacks = (speed[0] == 0.0 and not has("x")) or (speed[1] == 0.0 and not has("y"))
    if lacks:
        rules.append("zero unset")
    return (x if has_place else _NAN, y, z, yaw, *(speed if has_velocity else [_NAN] * len(speed))), rules


def osi_id(object_id: str) -> int:
    """The number OSI has for an object: its id where that is a number, else a stable hash of it."""
    number = object_id.removeprefix("stationary:")
    if number.isdigit() and int(number) < 2**64:
        return int(number)
    from copem_replay.core.random import object_words

    return int(object_words([object_id])[0])


def sends_standing(payload: bytes, schema: str) -> bool:
    """Whether a message of ground truth has stationary objects."""
    with suppress(DecodeError):
        message = load_message_class(schema).FromString(payload)
        return bool((message.global_ground_truth if schema == SENSOR_VIEW else message).stationary_object)
    return False


def load_message_class(schema: str) -> Any:
    """The class of a schema's messages, imported when first needed."""
    name = schema.removeprefix("osi3.")
    return getattr(import_module(f"osi3.osi_{name.lower()}_pb2"), name)
