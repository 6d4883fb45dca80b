"""Bodies that move, and the messages of OSI truth that a recipe of `make_logs.py` writes of them.

Axes in metres: x along the road, y to its left, z up. Times in seconds since the first frame, which has stamp 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_lane_pb2 import LaneBoundary
from osi3.osi_object_pb2 import MovingObject, StationaryObject

from copem_replay.io.write.osi import NANOS_PER_SECOND, empty_ground_truth

Kind = MovingObject.VehicleClassification
Edge = LaneBoundary.Classification
SOURCE: Final = "synthetic (tools/make_logs.py)"


@dataclass(frozen=True)
class Body:
    """A box on the ground that stands, drives straight on, and may start late or brake to a stop."""

    id: int
    size_m: tuple[float, float, float]  # length, width, height
    at_m: tuple[float, float]  # box centre at time 0
    yaw_deg: float = 0.0
    speed_mps: float = 0.0
    starts_s: float = 0.0  # stands until then, and is at full speed in that very frame
    brakes_s: float = math.inf
    deceleration_mps2: float = 0.0
    vehicle: int | None = Kind.TYPE_MEDIUM_CAR  # None: a pedestrian

    def speed(self, time_s: float) -> float:
        """Speed at `time_s`, in m/s."""
        braked_mps = self.deceleration_mps2 * max(0.0, time_s - self.brakes_s)
        return max(0.0, self.speed_mps - braked_mps) if time_s >= self.starts_s else 0.0

    def travelled(self, time_s: float) -> float:
        """Way from `at_m` at `time_s`, in m."""
        way_m = self.speed_mps * max(0.0, min(time_s, self.brakes_s) - self.starts_s)
        if time_s > self.brakes_s:  # the mean speed of a braking that is over is half the speed it began with
            braking_s = min(time_s - self.brakes_s, self.speed_mps / self.deceleration_mps2)
            way_m += braking_s * (self.speed_mps + self.speed(time_s)) / 2
        return way_m


def _along(yaw_rad: float, length: float) -> tuple[float, float]:
    """Return the vector of a direction, rounded: no platform's sine shows in the bytes, and no −0.0."""
    x, y = round(length * math.cos(yaw_rad), 12), round(length * math.sin(yaw_rad), 12)
    return x + 0.0, y + 0.0


def _place(base: Any, body: Body, time_s: float) -> None:
    """Set size and pose, which moving and stationary objects have in common."""
    yaw_rad = math.radians(body.yaw_deg)
    way_m = _along(yaw_rad, body.travelled(time_s))
    base.dimension.length, base.dimension.width, base.dimension.height = body.size_m
    base.position.x, base.position.y = (round(at + way, 12) for at, way in zip(body.at_m, way_m, strict=True))
    base.position.z = body.size_m[2] / 2  # OSI places the centre of the box; the ground is z = 0
    base.orientation.roll, base.orientation.pitch, base.orientation.yaw = 0.0, 0.0, yaw_rad


def moving_object(body: Body, time_s: float) -> MovingObject:
    """Return a body at a time as OSI has it."""
    osi = MovingObject(type=MovingObject.TYPE_VEHICLE if body.vehicle else MovingObject.TYPE_PEDESTRIAN)
    osi.id.value = body.id
    _place(osi.base, body, time_s)
    velocity_mps = _along(math.radians(body.yaw_deg), body.speed(time_s))
    osi.base.velocity.x, osi.base.velocity.y, osi.base.velocity.z = *velocity_mps, 0.0
    if body.vehicle:
        osi.vehicle_classification.type = body.vehicle
        rear = osi.vehicle_attributes.bbcenter_to_rear  # chosen: 0.3 of the length behind the centre, 0.3 m up
        rear.x, rear.y, rear.z = -0.3 * body.size_m[0], 0.0, 0.3 - body.size_m[2] / 2
    return osi


def stationary_object(body: Body) -> StationaryObject:
    """Return a body that never moves as OSI has it."""
    osi = StationaryObject()
    osi.id.value = body.id
    _place(osi.base, body, 0.0)
    osi.classification.type = StationaryObject.Classification.TYPE_OTHER
    return osi


Boundary = tuple[int, list[tuple[float, float]]]
"""Of a lane: its kind, an `Edge`, and its points on the ground, m."""
FIRST_BOUNDARY_ID: Final = 200


def ground_truth(
    stamp_ns: int, moving: list[Body], stationary: list[Body], host_id: int, road: list[Boundary]
) -> GroundTruth:
    """Return all bodies at one instant, and in the first message the road, which stays."""
    osi = empty_ground_truth(stamp_ns, host_id)
    osi.moving_object.extend(moving_object(body, stamp_ns / NANOS_PER_SECOND) for body in moving)
    osi.stationary_object.extend(stationary_object(body) for body in stationary)
    for number, (kind, points_m) in enumerate(road if stamp_ns == 0 else ()):
        boundary = osi.lane_boundary.add()
        boundary.id.value, boundary.classification.type = FIRST_BOUNDARY_ID + number, kind
        for x, y in points_m:
            place = boundary.boundary_line.add().position
            place.x, place.y, place.z = x, y, 0.0
    return osi
