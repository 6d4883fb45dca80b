"""A long drive through a city, to try out what long recordings cost: `tools/make_logs.py --long`.

Five streets by five, 100 m apart; on them vehicles and pedestrians who go straight through, each as a new object, and
are replaced by the next one when they leave, so that there are as many at all times. The ego drives in a circle around
the middle. A load and no traffic: nobody gives way to anybody.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import osi3
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_object_pb2 import MovingObject

RATE_HZ: Final = 10
STREETS: Final = 5
SPACING_M: Final = 100.0
OUTSIDE_M: Final = 50.0  # they come from here before the first street, and leave as far behind the last
MIDDLE_M: Final = SPACING_M * (STREETS - 1) / 2
EGO_RADIUS_M: Final = 120.0
EGO_SPEED_MPS: Final = 10.0
PEDESTRIANS: Final = 0.2  # share of all
_LENGTH_M: Final = SPACING_M * (STREETS - 1) + 2 * OUTSIDE_M
_YAW_RAD: Final = (0.0, math.pi / 2, math.pi, -math.pi / 2)
_ALONG: Final = ((1, 0), (0, 1), (-1, 0), (0, -1))


@dataclass
class _Passage:
    """One object on its straight way through."""

    osi: MovingObject
    from_s: float
    until_s: float
    at_m: tuple[float, float]
    velocity_mps: tuple[float, float]


def city(minutes: float, objects: int = 100) -> Iterator[tuple[str, Any]]:
    """(topic, message) of so many minutes at 10 Hz; the ego, id 1, is one of the objects."""
    chance = random.Random(1)
    walkers = round(PEDESTRIANS * objects)
    there = [_passage(chance, k + 2, 0.0, walker=k < walkers, midway=True) for k in range(objects - 1)]
    ego = _vehicle(1, (4.6, 1.9, 1.5))
    following, osi = objects + 1, _frame()
    for frame in range(round(minutes * 60 * RATE_HZ)):
        time_s = frame / RATE_HZ
        osi.timestamp.seconds, osi.timestamp.nanos = frame // RATE_HZ, frame % RATE_HZ * (1_000_000_000 // RATE_HZ)
        for k, one in enumerate(there):
            if time_s > one.until_s:
                there[k] = _passage(chance, following, time_s, walker=k < walkers)
                following += 1
            _move(there[k], time_s)
        _drive(ego, time_s)
        del osi.moving_object[:]
        osi.moving_object.append(ego)
        osi.moving_object.extend(one.osi for one in there)
        yield "ground_truth", osi


def _frame() -> GroundTruth:
    osi = GroundTruth()
    parts = (int(part) for part in osi3.__version__.split(".")[:3])
    osi.version.version_major, osi.version.version_minor, osi.version.version_patch = parts
    osi.host_vehicle_id.value = 1
    return osi


def _vehicle(ident: int, size_m: tuple[float, float, float] | None) -> MovingObject:
    """A car of some size, or a pedestrian."""
    osi = MovingObject(type=MovingObject.TYPE_VEHICLE if size_m else MovingObject.TYPE_PEDESTRIAN)
    osi.id.value = ident
    size = osi.base.dimension
    size.length, size.width, size.height = size_m or (0.5, 0.5, 1.8)
    osi.base.position.z = size.height / 2
    osi.base.velocity.z = osi.base.orientation.roll = osi.base.orientation.pitch = 0.0
    if size_m:
        kind = MovingObject.VehicleClassification
        osi.vehicle_classification.type = kind.TYPE_HEAVY_TRUCK if size.length > 6 else kind.TYPE_MEDIUM_CAR
    return osi


def _passage(
    chance: random.Random, ident: int, from_s: float, *, walker: bool, midway: bool = False
) -> _Passage:  # fmt: skip
    """The next one: which street, which way, how fast. `midway`: somewhere on it already."""
    size_m = None if walker else (8.0, 2.5, 3.5) if chance.random() < 0.1 else (4.4, 1.8, 1.5)
    speed_mps = round(chance.uniform(1.0, 1.8) if walker else chance.uniform(8.0, 14.0), 2)
    way, street = chance.randrange(4), chance.randrange(STREETS) * SPACING_M
    beside_m = 6.0 if walker else 1.75  # to the right of the middle of the street
    (along_x, along_y), share = _ALONG[way], chance.random() if midway else 0.0
    begin_m = -OUTSIDE_M + share * _LENGTH_M
    x = begin_m if along_x > 0 else 2 * MIDDLE_M - begin_m if along_x else street + beside_m * along_y
    y = begin_m if along_y > 0 else 2 * MIDDLE_M - begin_m if along_y else street - beside_m * along_x
    osi = _vehicle(ident, size_m)
    osi.base.orientation.yaw = _YAW_RAD[way]
    velocity_mps = (speed_mps * along_x, speed_mps * along_y)
    osi.base.velocity.x, osi.base.velocity.y = velocity_mps
    return _Passage(osi, from_s, from_s + (1 - share) * _LENGTH_M / speed_mps, (x, y), velocity_mps)


def _move(one: _Passage, time_s: float) -> None:
    elapsed_s, position = time_s - one.from_s, one.osi.base.position
    position.x = round(one.at_m[0] + one.velocity_mps[0] * elapsed_s, 9)
    position.y = round(one.at_m[1] + one.velocity_mps[1] * elapsed_s, 9)


def _drive(ego: MovingObject, time_s: float) -> None:
    """Counter-clockwise; rounded, so that no platform's sine shows in the bytes."""
    turned = EGO_SPEED_MPS / EGO_RADIUS_M * time_s
    cos, sin = math.cos(turned), math.sin(turned)
    base = ego.base
    base.position.x, base.position.y = (round(MIDDLE_M + EGO_RADIUS_M * share, 9) for share in (cos, sin))
    base.velocity.x, base.velocity.y = round(-EGO_SPEED_MPS * sin, 9), round(EGO_SPEED_MPS * cos, 9)
    base.orientation.yaw = round(math.remainder(turned + math.pi / 2, 2 * math.pi), 9)
