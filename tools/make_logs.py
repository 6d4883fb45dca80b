"""Make the sample recordings in `logs/`: the same bytes on every call.

    python tools/make_logs.py [tc016d …] [--out logs]
    python tools/make_logs.py --long --out FOLDER [--minutes 60] [--objects 100]
    python tools/make_logs.py --bags --out FOLDER                  # the two bags of docs/guide/study.md

A recording is an OSI multi-channel trace (MCAP). A further one is a function that returns an `OsiTrace` of bodies
(`traffic.py`), in a module beside this one, say, and an entry in `recipes`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from city import city
from copem_replay.io.write.osi import NANOS_PER_SECOND, OsiTrace, write_osi_trace
from crossing import crossing
from study_bags import write_bags
from traffic import SOURCE, Body, Boundary, Edge, Kind, ground_truth

# tc016d: a truck hides a pedestrian -------------------------------------------------------------------------

TC016D_RATE_HZ: Final = 10
TC016D_FRAMES: Final = 81
TC016D_ONSET_S: Final = 3.0
_EGO_START_M: Final = -(20.0 + 4.6 / 2 + 10.0 * TC016D_ONSET_S) + 1e-10
"""At the onset its front is 20 m from the pedestrian; 0.1 nm less, or rounding might delay it by a frame."""


TC016D_TRUCK_EDGE_M: Final = -2.12
"""Road side of the truck, calibrated (docs/reference/calibration.md)."""


def tc016d_bodies(truck_edge_m: float = TC016D_TRUCK_EDGE_M) -> tuple[list[Body], list[Body]]:
    """Return what moves and what doesn't. The pedestrian walks along x = 0, the ego drives along y = 0.

    The truck's road side is at `truck_edge_m` and its front at x = −0.75, half a metre before the pedestrian. Past
    that corner the ego sees nothing of him until 0.5 s after his first step, 18 % at 0.6 s, all at 1.1 s.
    """
    car = Body(id=0, size_m=(4.4, 1.8, 1.5), at_m=(0.0, 0.0), speed_mps=10.0)
    walker = Body(id=0, size_m=(0.5, 0.5, 1.8), at_m=(0.0, 0.0), vehicle=None)
    moving = [
        replace(car, id=1, size_m=(4.6, 1.9, 1.5), at_m=(_EGO_START_M, 0.0)),
        replace(walker, id=2, at_m=(0.0, -3.0), yaw_deg=90.0, speed_mps=1.0, starts_s=TC016D_ONSET_S),
        Body(id=3, size_m=(8.0, 2.5, 3.5), at_m=(-4.75, truck_edge_m - 1.25), vehicle=Kind.TYPE_HEAVY_TRUCK),
        # Two oncoming cars: one has passed the crossing, the other stops before it because of the pedestrian.
        replace(car, id=4, at_m=(-8.0, 3.5), yaw_deg=180.0, speed_mps=11.0),
        replace(car, id=5, at_m=(100.0, 3.5), yaw_deg=180.0, brakes_s=4.0, deceleration_mps2=1.25),
        # One behind the ego that brakes once the pedestrian is in sight, and a cyclist well ahead.
        replace(car, id=6, at_m=(-82.3, 0.0), brakes_s=4.5, deceleration_mps2=2.5),
        Body(id=7, size_m=(1.8, 0.6, 1.7), at_m=(12.0, -1.4), speed_mps=4.5, vehicle=Kind.TYPE_BICYCLE),
        replace(walker, id=8, at_m=(60.0, 8.0), yaw_deg=-90.0),  # waits, far down the other sidewalk
    ]
    shelter = Body(id=9, size_m=(4.0, 1.6, 2.5), at_m=(4.0, -6.2))
    return moving, [shelter]


def tc016d_road() -> list[Boundary]:
    """Return a street of two lanes with parking on the right, and the crosswalk before the truck."""
    begin_m, end_m = -90.0, 110.0
    along = [
        (Edge.TYPE_CURB, 5.25),
        (Edge.TYPE_DASHED_LINE, 1.75),
        (Edge.TYPE_DASHED_LINE, -1.9),
        (Edge.TYPE_CURB, -4.9),
    ]
    lanes = [(kind, [(begin_m, y), (end_m, y)]) for kind, y in along]
    return lanes + [(Edge.TYPE_DASHED_LINE, [(x, -4.9), (x, 5.25)]) for x in (-0.6, 3.0)]


def tc016d_units() -> list[dict[str, Any]]:
    """Return twenty roadside units on masts, ten on either side, which face the crossing point (0, 0).

    From the first frame until the ego runs into him each of them sees all of the pedestrian.
    """
    masts_m = [  # x, y, height; none far to the west, where the truck or the ego would be in between
        (-1.0, -9.0, 5.0), (0.0, -8.0, 4.0), (1.0, -9.5, 6.0), (7.5, -5.0, 4.5), (9.0, -5.5, 5.0),
        (10.5, -5.0, 5.5), (12.0, -5.5, 4.0), (14.0, -5.0, 5.0), (16.0, -5.5, 6.0), (18.0, -5.0, 4.5),
        (-3.0, 10.0, 6.0), (-2.0, 8.0, 4.5), (-1.0, 7.0, 4.0), (0.0, 9.0, 5.0), (1.0, 7.5, 5.5),
        (3.0, 8.5, 4.0), (5.0, 7.5, 4.5), (7.5, 9.0, 5.0), (10.0, 8.0, 5.5), (12.5, 9.5, 6.0),
    ]  # fmt: skip
    return [
        {"at": [x, y], "yaw_deg": round(math.degrees(math.atan2(-y, -x)), 1), "height_m": height}
        for x, y, height in masts_m
    ]


def tc016d(truck_edge_m: float = TC016D_TRUCK_EDGE_M) -> OsiTrace:
    """Return the scenario of the paper: a pedestrian steps out from behind a truck, 20 m ahead of the ego."""
    moving, stationary = tc016d_bodies(truck_edge_m)
    stamps_ns = (frame * NANOS_PER_SECOND // TC016D_RATE_HZ for frame in range(TC016D_FRAMES))
    return OsiTrace(
        source=SOURCE,
        description="A parked truck hides a pedestrian who starts to cross 20 m ahead of the ego vehicle.",
        topics={"ground_truth": "osi3.GroundTruth, 10 Hz: all road users and the bus shelter"},
        messages=(("ground_truth", ground_truth(t, moving, stationary, 1, tc016d_road())) for t in stamps_ns),
    )


def recipes() -> dict[str, Callable[[], OsiTrace]]:
    """Return every recording by the name of its file."""
    return {"tc016d": tc016d, "crossing": crossing}


def long_drive(minutes: float, objects: int = 100) -> OsiTrace:
    """Return a drive of many minutes through a city: for what long recordings cost."""
    return OsiTrace(
        source=SOURCE,
        description=f"A drive of {minutes:g} minutes among {objects} objects at a time: a load, no traffic.",
        topics={"ground_truth": "osi3.GroundTruth, 10 Hz: all road users"},
        messages=city(minutes, objects),
    )


def main() -> None:
    logs = Path(__file__).resolve().parents[1] / "logs"
    parser = argparse.ArgumentParser(description="Make the sample recordings.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(recipes())}; none: all")
    parser.add_argument("--out", type=Path, default=logs, help="folder (default: the project's logs/)")
    parser.add_argument("--long", action="store_true", help="only the long drive, city.mcap; it is not committed")
    parser.add_argument(
        "--bags", action="store_true", help="only the bags of docs/guide/study.md; they are not committed"
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="how long the long drive is (default: 60)")
    parser.add_argument("--objects", type=int, default=100, help="how many there are at a time (default: 100)")
    arguments = parser.parse_args()
    if arguments.long:
        write_osi_trace(long_drive(arguments.minutes, arguments.objects), arguments.out / "city.mcap")
        return
    if arguments.bags:
        write_bags(arguments.out)
        return
    if unknown := set(arguments.names) - set(recipes()):
        parser.error(f"no recipe for {', '.join(sorted(unknown))}; there are: {', '.join(recipes())}")
    for name in arguments.names or recipes():
        write_osi_trace(recipes()[name](), arguments.out / f"{name}.mcap")


if __name__ == "__main__":
    main()
