"""Roads in messages of OSI truth: boundaries, lanes and crosswalks."""

from __future__ import annotations

from collections.abc import Sequence

from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_lane_pb2 import Lane

from copem_replay.io.schemas.osi_lanes import ZEBRA

Of = Lane.Classification
Points = Sequence[tuple[float, float]]


def add_boundary(truth: GroundTruth, ident: int, points: Points) -> None:
    boundary = truth.lane_boundary.add()
    boundary.id.value = ident
    for x, y in points:
        position = boundary.boundary_line.add().position
        position.x, position.y, position.z = x, y, 0.5


def add_lane(
    truth: GroundTruth, ident: int, left: Sequence[int], right: Sequence[int], centre: Points = (), **of: int | bool
) -> None:
    lane = truth.lane.add()
    lane.id.value = ident
    for name, value in {"type": Of.TYPE_DRIVING, **of}.items():
        setattr(lane.classification, name, value)
    for x, y in centre:
        lane.classification.centerline.add(x=x, y=y)
    for ids, places in (
        (left, lane.classification.left_lane_boundary_id),
        (right, lane.classification.right_lane_boundary_id),
    ):
        for each in ids:
            places.add().value = each


def two_lanes(from_x: float = 0.0, to_x: float = 100.0) -> GroundTruth:
    """A street of two lanes towards +x, each 4 m wide: lane 8 is driven as it is stored, lane 9 against it."""
    truth = GroundTruth()
    for ident, y in ((1, 4.0), (2, 0.0), (3, -4.0)):
        add_boundary(truth, ident, [(from_x, y), (to_x, y)])
    add_lane(truth, 8, [2], [3], [(from_x, -2), (to_x, -2)], centerline_is_driving_direction=True)
    add_lane(truth, 9, [1], [2], [(from_x, 2), (to_x, 2)], centerline_is_driving_direction=False)
    return truth


def add_marking(truth: GroundTruth, sign: int = ZEBRA) -> GroundTruth:
    """4 m along the street, 8 m across it, its middle at (30, 5)."""
    marking = truth.road_marking.add()
    marking.id.value, marking.classification.traffic_main_sign_type = 40, sign
    base = marking.base
    base.position.x, base.position.y, base.position.z = 30.0, 5.0, 0.25
    base.dimension.length, base.dimension.width, base.dimension.height = 4.0, 8.0, 0.01
    return truth
