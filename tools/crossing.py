"""A busy signalised crossing, 60 s: `logs/crossing.mcap`.

Two roads meet at (0, 0), x to the east, y to the north, one lane and one cycle lane in each direction, traffic on the
right. Everybody follows a line of straight pieces and arcs with the Intelligent Driver Model (Treiber, Hennecke,
Helbing, Congested traffic states in empirical observations and microscopic simulations, Phys. Rev. E 62, 2000), behind
whatever is on the strip of ground ahead, and stops where it has to. No random numbers: see `road_users`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from copem_replay.io.write.osi import NANOS_PER_SECOND, OsiTrace
from traffic import SOURCE, Body, Boundary, Edge, ground_truth
from traffic import Kind as Vehicle

RATE_HZ, FRAMES, EGO = 10, 601, 1

EDGE_M = 120.0  # lines begin and end this far from the centre
LANE_M, CYCLE_LANE_M = 1.75, 4.6  # from the middle of the road to the middle of the lane
STOP_LINE_M, KERB_M = 12.0, 6.2  # from the centre: where vehicles wait, where pedestrians wait
LINE_M, CORNER_M = 3.4, 2.8  # from the middle of the road to the line beside the cycle lane; the radius of kerbs
CROSSWALK_M = (8.4, 11.6)  # from the centre
EAST, NORTH, WEST, SOUTH = 0, 90, 180, -90  # which way one comes driving or walking, degrees

Spans = tuple[tuple[float, float], ...]  # from … to, seconds
GREEN: dict[int, Spans] = {EAST: ((0.0, 4.0), (32.0, 50.0)), NORTH: ((9.0, 26.0), (56.0, math.inf))}  # and opposite
WALK: dict[int, Spans] = {EAST: ((32.0, 42.0),), NORTH: ((9.0, 17.0), (56.0, math.inf))}  # ends in time to get across

SAMPLE_M = 0.5
BEND_MPS2, SLOWING_MPS2 = 2.0, 1.4  # acceleration across in a bend, deceleration before it


class Line:
    """Straight pieces and arcs, one after the other: (length in m, degrees turned to the left)."""

    def __init__(self, start_m: tuple[float, float], heading_deg: float, *pieces: tuple[float, float]) -> None:
        self.start_m, self.heading_rad, self.pieces = start_m, math.radians(heading_deg), pieces
        self.length_m = sum(length for length, _ in pieces)
        ways_m = np.arange(0.0, self.length_m + SAMPLE_M, SAMPLE_M)
        samples = np.array([self.at(way_m) for way_m in ways_m])
        self.points_m = samples[:, :2]
        self.tangents = np.stack([np.cos(samples[:, 2]), np.sin(samples[:, 2])], axis=1)
        bends = [math.sqrt(BEND_MPS2 * n / abs(math.radians(turned))) if turned else math.inf for n, turned in pieces]
        in_piece = np.searchsorted(np.cumsum([length for length, _ in pieces[:-1]]), ways_m, side="right")
        slowing = 2 * SLOWING_MPS2 * ways_m  # v² = v_bend² + 2 a s, and the bend that allows least decides
        least = np.minimum.accumulate((np.array(bends)[in_piece] ** 2 + slowing)[::-1])[::-1]
        self.limit_mps = np.sqrt(least - slowing)

    def at(self, way_m: float) -> tuple[float, float, float]:
        """Position in m and direction in radians, some way along."""
        (x, y), yaw = self.start_m, self.heading_rad
        for length, turned_deg in self.pieces:
            part = min(way_m, length)
            angle = math.radians(turned_deg) * part / length
            chord = part * (math.sin(angle / 2) / (angle / 2) if angle else 1.0)
            x, y = x + chord * math.cos(yaw + angle / 2), y + chord * math.sin(yaw + angle / 2)
            yaw, way_m = yaw + angle, way_m - part
        return x, y, yaw

    def ahead(self, way_m: float, reach_m: float) -> slice:
        """The samples from `way_m` on."""
        return slice(max(0, math.ceil(way_m / SAMPLE_M)), math.ceil((way_m + reach_m) / SAMPLE_M) + 1)


def through(heading: int, right_m: float, turn: str = "") -> Line:
    """The line through the crossing `right_m` beside the middle of the road, straight on or into a side road."""
    cos, sin = round(math.cos(math.radians(heading))), round(math.sin(math.radians(heading)))
    start_m = (-EDGE_M * cos + right_m * sin, -EDGE_M * sin - right_m * cos)
    if not turn:
        return Line(start_m, heading, (2 * EDGE_M, 0))
    side, radius_m = (1, 11.0) if turn == "left" else (-1, 7.0)
    straight_m = EDGE_M + side * right_m - radius_m
    return Line(start_m, heading, (straight_m, 0), (radius_m * math.pi / 2, 90 * side), (straight_m, 0))


# Who is on the way -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """How big, how fast, how close: size, and the parameters of the IDM."""

    size_m: tuple[float, float, float]
    vehicle: int | None
    speed_mps: float
    acceleration_mps2: float = 1.5
    deceleration_mps2: float = 2.0
    headway_s: float = 1.1
    gap_m: float = 2.0
    clearance_m: float = 0.35  # at the sides


CAR = Kind((4.4, 1.8, 1.5), Vehicle.TYPE_MEDIUM_CAR, 11.5)
SUV = replace(CAR, size_m=(4.8, 1.95, 1.75), vehicle=Vehicle.TYPE_LUXURY_CAR)
SMALL = replace(CAR, size_m=(3.7, 1.7, 1.5), vehicle=Vehicle.TYPE_COMPACT_CAR, speed_mps=11.0)
VAN = replace(CAR, size_m=(6.0, 2.05, 2.7), vehicle=Vehicle.TYPE_DELIVERY_VAN, speed_mps=10.5)
TRUCK = Kind((8.6, 2.5, 3.6), Vehicle.TYPE_HEAVY_TRUCK, 10.5, 0.9, 1.8, 1.4)
BUS = Kind((12.0, 2.55, 3.1), Vehicle.TYPE_BUS, 10.0, 0.9, 1.6, 1.4)
BICYCLE = Kind((1.8, 0.6, 1.75), Vehicle.TYPE_BICYCLE, 5.0, 1.0, 1.8, 0.8, 1.0)
ADULT = Kind((0.5, 0.6, 1.75), None, 1.4, 1.2, 2.0, 0.3, 0.5, 0.15)
CHILD = replace(ADULT, size_m=(0.4, 0.45, 1.2), speed_mps=1.3)


@dataclass
class User:
    """Somebody on a line. A stop holds its front there until it opens; one that yields waits for a free strip."""

    id: int
    kind: Kind
    line: Line
    way_m: float = 0.0  # of its centre
    enters_s: float = 0.0
    speed_mps: float = math.nan  # at first; NaN: as fast as it likes
    stops: tuple[tuple[float, Spans], ...] = ()
    yields_m: float = math.inf

    def __post_init__(self) -> None:
        if math.isnan(self.speed_mps):
            self.speed_mps = self.kind.speed_mps

    def body(self, time_s: float) -> Body:
        """Its box at an instant, on a grid of 2⁻¹⁰ m, which hides the last bits and keeps the file small."""
        x, y, yaw = self.line.at(self.way_m)
        x, y, speed, yaw_deg = (round(v * 1024) / 1024 for v in (x, y, self.speed_mps, math.degrees(yaw)))
        return Body(self.id, self.kind.size_m, (x, y), yaw_deg, speed, starts_s=time_s, vehicle=self.kind.vehicle)


def drives(id: int, kind: Kind, heading: int, from_m: float, at_s: float = 0.0, turn: str = "", **more: Any) -> User:
    """Return a vehicle or cyclist who obeys the signal: `from_m` beyond the centre at `at_s`."""
    line = through(heading, CYCLE_LANE_M if kind is BICYCLE else LANE_M, turn)
    stops = ((EDGE_M - STOP_LINE_M, GREEN[heading % 180]), *more.pop("stops", ()))
    yields_m = line.pieces[0][0] + {"": math.inf, "left": 4.5, "right": 0.0}[turn]
    return User(id, kind, line, EDGE_M + from_m, at_s, stops=stops, yields_m=yields_m, **more)


def walks(id: int, kind: Kind, heading: int, right_m: float, from_m: float, at_s: float = 0.0) -> User:
    """Return a pedestrian on the sidewalk `right_m` beside the middle of a road, who crosses the other road."""
    line, stops = through(heading, right_m), ((EDGE_M - KERB_M, WALK[heading % 180]),)
    return User(id, kind, line, EDGE_M + from_m, at_s, stops=stops)


def road_users() -> list[User]:
    """Return everybody who moves, and the parked van."""
    return [
        # Eastbound: the truck hides the crossing from the ego, which waits behind it and then turns left.
        drives(EGO, replace(CAR, speed_mps=9.6), EAST, -114, turn="left"),
        drives(2, SMALL, EAST, -28),
        drives(3, TRUCK, EAST, -90),
        drives(4, SUV, EAST, -EDGE_M, 3),
        drives(5, CAR, EAST, -EDGE_M, 9),
        drives(6, BICYCLE, EAST, -75),
        drives(7, BICYCLE, EAST, -EDGE_M, 18),
        User(8, VAN, Line((-48, -6.7), EAST, (10, 0)), speed_mps=0, stops=((3.2, ()),)),  # parked
        # Westbound: the bus stops beyond the crossing, the truck waits to turn left and hides the cyclist beside it.
        drives(10, BUS, WEST, -16, stops=((EDGE_M + 35.2, ((36.0, math.inf),)),)),
        drives(11, CAR, WEST, 40),
        drives(12, TRUCK, WEST, -EDGE_M, 3, turn="left"),
        drives(13, SUV, WEST, -EDGE_M, 8),
        drives(14, CAR, WEST, -EDGE_M, 13),
        drives(15, BICYCLE, WEST, -EDGE_M, 16),
        # Northbound, southbound: some wait at red when the log begins, some when it ends.
        drives(20, CAR, NORTH, -14.5, speed_mps=0),
        drives(21, SMALL, NORTH, -21, speed_mps=0, turn="right"),
        drives(22, BICYCLE, NORTH, -13.2, speed_mps=0),
        drives(23, CAR, NORTH, -EDGE_M, 11),
        drives(24, VAN, NORTH, -EDGE_M, 22),
        drives(30, CAR, SOUTH, -14.5, speed_mps=0, turn="right"),
        drives(31, SUV, SOUTH, -21.3, speed_mps=0, turn="left"),
        drives(32, CAR, SOUTH, -EDGE_M, 20),
        drives(33, VAN, SOUTH, -EDGE_M, 24),
        drives(34, SMALL, SOUTH, -EDGE_M, 29),
        drives(35, BICYCLE, SOUTH, -EDGE_M, 25),
        # On the crosswalks, in the order in which they get there
        walks(40, ADULT, EAST, 9.0, -1),
        walks(41, ADULT, WEST, 9.3, -3),
        walks(42, ADULT, NORTH, -9.0, -12),
        walks(43, CHILD, NORTH, -9.9, -12.3),
        walks(44, ADULT, SOUTH, -9.0, -20),
        walks(45, ADULT, NORTH, 9.9, -30),
        walks(46, ADULT, EAST, -10.3, -40),
        walks(47, ADULT, WEST, -9.9, -25),
        walks(48, ADULT, EAST, 9.0, -60, 12),
        walks(49, replace(ADULT, speed_mps=3.0), NORTH, 10.0, -75, 30),
        walks(50, ADULT, SOUTH, -10.9, -60, 20),
        # Gets on the bus; gets off it and crosses behind it, between the waiting vehicles
        User(51, ADULT, Line((-27.5, 6.9), SOUTH, (3.1, 0)), speed_mps=0, stops=((0.5, ((11.0, math.inf),)),)),
        User(52, ADULT, Line((-33, 3.9), NORTH, (1.2, 0), (1.6, -90), (9.08, 0), (1.6, -90), (40, 0)), enters_s=17),
        # A child steps out behind the waiting van and runs across before the ego; one goes into a house, one leaves one
        User(53, replace(CHILD, speed_mps=2.5), Line((-2.4, 25.65), EAST, (15.8, 0)), enters_s=44, speed_mps=0),
        User(54, ADULT, Line((-10.3, 62), SOUTH, (20, 0), (1.6, -90), (1.4, 0)), enters_s=5),
        User(55, ADULT, Line((30, -12.8), NORTH, (1.5, 0), (1.6, -90), (80, 0)), enters_s=18),
        # Gets out of the parked van and goes to the kiosk
        User(56, ADULT, Line((-46.5, -8.2), EAST, (10.5, 0), (1.6, -90), (3.1, 0)), enters_s=21),
    ]


def street_furniture() -> list[Body]:
    """Return what never moves."""
    masts_m = ((12.4, 12.4), (-12.4, -12.4), (12.4, -12.4))  # of the roadside units
    shelter, column = Body(110, (4.0, 1.4, 2.5), (-31.0, 7.6)), Body(111, (1.4, 1.4, 3.6), (-12.0, 12.0))
    hedge, kiosk = Body(112, (14.0, 0.8, 1.3), (-33.0, -7.2)), Body(113, (3.0, 2.5, 2.8), (-34.5, -14.6))
    return [shelter, column, hedge, kiosk, *(Body(100 + k, (0.3, 0.3, 6.0), at_m) for k, at_m in enumerate(masts_m))]


def road() -> list[Boundary]:
    """Return lines and kerbs of the four arms, their crosswalks, and the bay of the parked van."""
    corner_m, angles = KERB_M + CORNER_M, np.radians(np.arange(0, 91, 15))
    arc = [(corner_m - CORNER_M * math.cos(a), corner_m - CORNER_M * math.sin(a)) for a in angles]
    bay_m = [(42.0, KERB_M), (43.5, 7.9), (52.5, 7.9), (54.0, KERB_M)]
    lines: list[Boundary] = []
    for quarter in range(4):  # the arm to the east and its corner in the northeast, then all are turned to the left
        lines.append((Edge.TYPE_SOLID_LINE, [(EDGE_M, 0.0), (STOP_LINE_M, 0.0)]))
        lines += [(Edge.TYPE_DASHED_LINE, [(EDGE_M, y), (STOP_LINE_M, y)]) for y in (LINE_M, -LINE_M)]
        lines += [(Edge.TYPE_DASHED_LINE, [(x, -KERB_M), (x, KERB_M)]) for x in CROSSWALK_M]
        bay = bay_m if quarter == 2 else []  # is turned twice: in the southwest
        lines.append((Edge.TYPE_CURB, [(KERB_M, EDGE_M), *arc, *bay, (EDGE_M, KERB_M)]))
        lines = [(kind, [(round(-y, 3) + 0.0, round(x, 3) + 0.0) for x, y in points]) for kind, points in lines]
    return lines


# How they move -----------------------------------------------------------------------------------------------

HARDEST_MPS2, YIELD_S = 4.5, 5.0  # hardest braking; how far one looks ahead before a turn


def idm(user: User, wanted_mps: float, gap_m: float, ahead_mps: float) -> float:
    """Return the acceleration in m/s² towards `wanted_mps`, behind what moves at `ahead_mps`, `gap_m` ahead."""
    kind, speed = user.kind, user.speed_mps
    closing_m = speed * (speed - ahead_mps) / (2 * math.sqrt(kind.acceleration_mps2 * kind.deceleration_mps2))
    desired_m = kind.gap_m + max(0.0, speed * kind.headway_s + closing_m)
    urge = max(1 - (speed / wanted_mps) ** 4, -1.0) - (desired_m / max(gap_m, 0.05)) ** 2
    return max(-HARDEST_MPS2, kind.acceleration_mps2 * urge)


def acceleration(user: User, others: list[User], circles: Any, time_s: float) -> float:
    """Return the acceleration that bends, things ahead, signals and traffic to yield to allow, in m/s²."""
    kind, front_m = user.kind, user.way_m + user.kind.size_m[0] / 2
    braking_m = user.speed_mps**2 / (2 * kind.deceleration_mps2)
    strip = user.line.ahead(user.way_m, kind.size_m[0] / 2 + braking_m + 15.0)
    wanted_mps = min(kind.speed_mps, float(user.line.limit_mps[int(user.way_m / SAMPLE_M)]))
    result = idm(user, wanted_mps, *in_the_way(user, front_m, strip, circles))
    held_m = [at_m for at_m, spans in user.stops if not any(start <= time_s < end for start, end in spans)]
    if front_m < user.yields_m < front_m + braking_m + 5.0 and somebody_comes(user, others):
        held_m.append(user.yields_m)
    for at_m in held_m:
        if at_m - front_m >= 0.5 * braking_m:  # else it has passed, or cannot stop any more
            result = min(result, idm(user, wanted_mps, at_m - front_m + kind.gap_m - 0.4, 0.0))
    return result


def in_the_way(user: User, front_m: float, strip: slice, circles: Any) -> tuple[float, float]:
    """Return the gap in m to the nearest of the others' circles in the strip ahead, and its speed along it."""
    points, tangents = user.line.points_m[strip], user.line.tangents[strip]
    circles = circles[circles[:, 0] != user.id]
    apart = circles[None, :, 1:3] - points[:, None]  # (samples, circles, 2)
    distances = np.hypot(apart[..., 0], apart[..., 1])
    nearest, column = distances.argmin(axis=0), np.arange(len(circles))
    ways_m = (strip.start + nearest) * SAMPLE_M + (apart[nearest, column] * tangents[nearest]).sum(axis=1)
    beside_m = circles[:, 3] + user.kind.size_m[1] / 2 + user.kind.clearance_m
    in_strip = (distances[nearest, column] < beside_m) & (ways_m > front_m)
    gaps = np.where(in_strip, ways_m - circles[:, 3] - front_m, math.inf)
    first = int(gaps.argmin())
    return float(gaps[first]), max(0.0, float(circles[first, 4:] @ tangents[nearest[first]]))


def somebody_comes(user: User, others: list[User]) -> bool:
    """Tell whether anybody from another lane will soon be on its way through the bend."""
    mine = user.line.points_m[user.line.ahead(user.yields_m, 20.0)]
    for other in others:
        if other.line.start_m == user.line.start_m or other.speed_mps < 0.3:
            continue
        length, width, _ = other.kind.size_m
        theirs = other.line.points_m[other.line.ahead(other.way_m - length / 2, length + YIELD_S * other.speed_mps)]
        apart = np.hypot(*(theirs[:, None] - mine[None]).transpose(2, 0, 1))
        if apart.min(initial=math.inf) < (width + user.kind.size_m[1]) / 2 + 0.5:
            return True
    return False


def covering(user: User) -> list[tuple[float, ...]]:
    """Return id, x, y, radius and velocity of circles along the length of its box."""
    length, width, _ = user.kind.size_m
    x, y, yaw = user.line.at(user.way_m)
    cos, sin, speed, end_m = math.cos(yaw), math.sin(yaw), user.speed_mps, max(0.0, (length - width) / 2)
    along_m = np.linspace(-end_m, end_m, math.ceil(length / width))
    return [(user.id, x + d * cos, y + d * sin, width / 2, speed * cos, speed * sin) for d in along_m]


def frames() -> Iterator[tuple[int, list[Body]]]:
    """Yield the stamp in ns and everybody who is on the way, frame by frame."""
    users = road_users()
    for frame in range(FRAMES):
        time_s = frame / RATE_HZ
        there = [u for u in users if u.enters_s <= time_s and u.way_m < u.line.length_m]
        yield frame * NANOS_PER_SECOND // RATE_HZ, [user.body(time_s) for user in there]
        circles = np.array([circle for user in there for circle in covering(user)])
        wanted = [acceleration(user, there, circles, time_s) for user in there]
        for user, change in zip(there, wanted, strict=True):
            before = user.speed_mps
            user.speed_mps = max(0.0, before + change / RATE_HZ)
            if user.speed_mps < 0.05 and change < 0.3:  # the IDM would creep for ever
                user.speed_mps = 0.0
            user.way_m += (before + user.speed_mps) / 2 / RATE_HZ


def crossing() -> OsiTrace:
    """Return the busy crossing: onboard, roadside and V2V perception see very different parts of it."""
    still = street_furniture()
    return OsiTrace(
        source=SOURCE,
        description="A busy signalised crossing: an ego vehicle that turns left, pedestrians and cyclists half hidden.",
        topics={"ground_truth": "osi3.GroundTruth, 10 Hz: all road users and the street furniture"},
        messages=(("ground_truth", ground_truth(t, moving, still, EGO, road())) for t, moving in frames()),
    )
