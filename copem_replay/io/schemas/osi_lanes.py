"""Roads in ASAM OSI: boundaries of lanes, lanes by their borders, and crosswalks among road markings.

`logical_lane` and `lane` are of one road; logical lanes run through intersections, too, and are taken where there are
any. Borders of a lane are on its left and right as its points are stored: a lane driven against them is turned, one
that is driven both ways, or does not say, is there in both directions. Intersections among `lane` have no such borders.
OSI has no type for a crosswalk: it is a marking whose `traffic_main_sign_type` is that of a zebra crossing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from copem_replay.core.errors import count_noun
from copem_replay.core.site_map import Lane, LaneKind, make_area
from copem_replay.core.tracks import Area, Float
from copem_replay.io.findings import FARTHEST_M, find

INTERSECTION: Final = 4  # osi_lane.proto, Lane.Classification.Type
DRIVING: Final = 2
ZEBRA: Final = 87  # osi_trafficsign.proto, TrafficSign.MainSign.Classification.Type
INCREASING, DECREASING = 2, 3  # osi_logicallane.proto, LogicalLane.MoveDirection
SUBTYPES: Final[Mapping[LaneKind, int]] = {"driving": 2, "bicycle": 3, "walking": 4, "parking": 5, "other": 1}
"""Lane.Classification.Subtype by kind. LogicalLane.Type has the same numbers."""
# Exits, entries and ramps (10 … 14) are driven.
_KINDS: Final = {number: kind for kind, number in SUBTYPES.items()} | dict.fromkeys(range(10, 15), "driving")
_NOWHERE: Final = np.empty((0, 3))
_BESIDE_M: Final = 1.0
"""A part of a border that begins this far before the end of the one before is another line beside it."""


@dataclass
class OsiRoad:
    """What a message says of its road: lines to draw (K, 3), lanes, crosswalks, and notes on what is left out."""

    lines: list[Float] = field(default_factory=list)
    lanes: list[Lane] = field(default_factory=list)
    crosswalks: list[Area] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.lines or self.lanes or self.crosswalks or self.notes)


def read_road(truth: Any) -> OsiRoad:
    """The road of a message of osi3.GroundTruth. Points beyond `FARTHEST_M` or NaN are left out of lines."""
    of_physical = [(boundary.id.value, _read_points(boundary.boundary_line)[:, :3]) for boundary in truth.lane_boundary]
    of_logical = [(boundary, _read_points(boundary.boundary_line)) for boundary in truth.logical_lane_boundary]
    physical, logical = dict(of_physical), {boundary.id.value: points for boundary, points in of_logical}
    drawn = [line for _, line in of_physical]
    drawn += [line[:, :3] for of, line in of_logical if not any(i.value in physical for i in of.physical_boundary_id)]
    road = OsiRoad([line for line in drawn if len(line) > 1])
    stated = sum(len(of.boundary_line) for of in (*truth.lane_boundary, *truth.logical_lane_boundary))
    road.notes += find("border point", stated - sum(len(line) for _, line in (*of_physical, *of_logical)))
    read_lanes = [_read_logical_lane(lane, logical) for lane in truth.logical_lane]
    if not any(read_lanes):
        with_borders = (lane for lane in truth.lane if lane.classification.type != INTERSECTION)
        read_lanes += [_read_lane(lane, physical) for lane in with_borders]
    road.lanes += [lane for lanes in read_lanes for lane in lanes]
    _add_crosswalks(road, truth.road_marking)
    if unbordered := sum(not lanes for lanes in read_lanes):
        road.notes.append(f"{count_noun(unbordered, 'lane')} without a left and a right border: left out")
    return road


def _read_points(points: Iterable[Any]) -> Float:
    """Points (K, 4) of a boundary: x, y, z, and the place along a reference line, 0 where it has none."""
    rows = [(p.position.x, p.position.y, p.position.z, getattr(p, "s_position", 0.0)) for p in points]
    line = np.array(rows, dtype=np.float64).reshape(-1, 4)
    somewhere: Float = line[(np.abs(line[:, :3]) <= FARTHEST_M).all(axis=1)]  # no NaN, either
    return somewhere


def _read_lane(lane: Any, boundaries: Mapping[int, Float]) -> list[Lane]:
    """The lane as a list of one, in the direction in which it is driven; empty: a boundary is missing."""
    classification = lane.classification
    kind = _KINDS.get(classification.subtype, "other") if classification.subtype > 1 else "driving"
    if classification.type != DRIVING and kind == "driving":
        kind = "other"
    centre = np.array([(p.x, p.y) for p in classification.centerline], dtype=np.float64).reshape(-1, 2)
    centre = np.round(centre[(np.abs(centre) <= FARTHEST_M).all(axis=1)], 3)  # to mm: GEOS fails at 5e-324 m
    left, right = (
        _join_along([line for i in ids if len(line := boundaries.get(i.value, _NOWHERE)) > 1], centre)
        for ids in (classification.left_lane_boundary_id, classification.right_lane_boundary_id)
    )
    if min(len(left), len(right)) < 2:  # points that are all at one place are one
        return []
    found = Lane(str(lane.id.value), kind, left, right)
    return [found if classification.centerline_is_driving_direction or kind != "driving" else found.turned()]


def _join_along(parts: Sequence[Float], centre_m: Float) -> Float:
    """Parts of a border (K, 3) as one line in order along a centre line (L, 2); of parts side by side the first."""
    if len(parts) > 1 and len(np.unique(centre_m, axis=0)) > 1:
        import shapely

        ends_m = np.array([part[[0, -1], :2] for part in parts])
        begin, end = shapely.line_locate_point(shapely.LineString(centre_m), shapely.points(ends_m)).T
        ahead_parts, reached_m = list[Float](), -np.inf
        for k in np.argsort(begin, kind="stable").tolist():
            if begin[k] >= reached_m - _BESIDE_M:
                ahead_parts.append(parts[k])
                reached_m = end[k]
        parts = ahead_parts
    line = np.concatenate([_NOWHERE, *parts])
    return line[np.append(True, (np.diff(line, axis=0) != 0).any(axis=1))] if len(line) else line


def _read_logical_lane(lane: Any, boundaries: Mapping[int, Float]) -> list[Lane]:
    """The lane as a list, of two where it is driven both ways; empty: a border is missing."""
    left, right = (
        _join_along(
            [_cut(boundaries[i.value], lane.start_s, lane.end_s) for i in ids if i.value in boundaries], _NOWHERE
        )
        for ids in (lane.left_boundary_id, lane.right_boundary_id)
    )
    if min(len(left), len(right)) < 2:
        return []
    lane_as_listed = Lane(str(lane.id.value), _KINDS.get(lane.type, "other"), left, right)
    if lane.move_direction == INCREASING:
        return [lane_as_listed]
    return [lane_as_listed.turned()] if lane.move_direction == DECREASING else [lane_as_listed, lane_as_listed.turned()]


def _cut(points: Float, start_s: float, end_s: float) -> Float:
    """A border (K, 4) between two places along its reference line (L, 3): it may go on beyond the lane."""
    s = points[:, 3]
    if not (len(s) > 1 and s[0] < s[-1] and (np.diff(s) >= 0.0).all() and start_s < end_s):
        return points[:, :3]
    first, last = np.clip((start_s, end_s), s[0], s[-1])
    ends = [[np.interp(at, s, points[:, k]) for k in range(3)] for at in (first, last)]
    return np.concatenate([ends[:1], points[(first < s) & (s < last), :3], ends[1:]])


def _add_crosswalks(road: OsiRoad, markings: Iterable[Any]) -> None:
    """Add crosswalks to the road: as areas, with their outlines as lines."""
    no_extent = 0
    for marking in markings:
        if marking.classification.traffic_main_sign_type != ZEBRA or marking.classification.is_out_of_service:
            continue
        ring = next(_list_outlines(marking.base), None)
        if ring is None:
            no_extent += 1
            continue
        road.crosswalks.append(make_area(f"crosswalk {marking.id.value}", "crosswalk", ring))
        at_z = np.full(len(ring) + 1, marking.base.position.z)
        road.lines.append(np.column_stack([np.append(ring, ring[:1], axis=0), at_z]))
    if no_extent:
        road.notes.append(f"{count_noun(no_extent, 'crosswalk')} without an extent on the ground: left out")


def _list_outlines(base: Any) -> Iterator[Float]:
    """What a marking covers, seen from above: corners (K, 2) of its base polygon, and of its box. The frame of a
    marking has x up and z along it in OSI, but many leave it level: the box is turned as a whole.
    """
    import shapely

    turn, size, at = base.orientation, base.dimension, base.position
    (cr, cp, cy), (sr, sp, sy) = (wave([turn.roll, turn.pitch, turn.yaw]) for wave in (np.cos, np.sin))
    axes = np.array([[cy * cp, sy * cp], [cy * sp * sr - sy * cr, sy * sp * sr + cy * cr],
                     [cy * sp * cr + sy * sr, sy * sp * cr - cy * sr]])  # fmt: skip
    polygon = np.array([(p.x, p.y, 0.0) for p in base.base_polygon]).reshape(-1, 3)
    box = np.array(np.meshgrid(*([-v / 2, v / 2] for v in (size.length, size.width, size.height)))).reshape(3, -1).T
    for corners, is_box in ((polygon, False), (box, True)):
        ring = np.round(corners @ axes + [at.x, at.y], 6)  # to µm: a level box has its lower corners under the upper
        if not (len(ring) > 2 and (np.abs(ring) <= FARTHEST_M).all() and abs(at.z) <= FARTHEST_M):
            continue
        outline = shapely.MultiPoint(ring).convex_hull if is_box else shapely.Polygon(ring)
        if outline.geom_type == "Polygon" and outline.area > 0.0:
            yield np.array(outline.exterior.coords)[:-1]
