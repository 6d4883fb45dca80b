"""The map of the busy crossing, `logs/crossing.xodr`: two roads, crosswalks, houses and a garden wall.

    python tools/crossing_map.py [--out logs]

The same bytes on every call. Houses and wall are the obstacles of `logs/crossing_wall.yaml`, but for the
kiosk beside the mast in the south-west.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

LANES: Final = (("driving", 4.0), ("biking", 2.2))
"""From the middle outwards: kind and width in metres, the same in each direction."""
REACH_M: Final = 150.0
ROADS: Final = {"1": (-REACH_M, 0.0, 0.0), "2": (0.0, -REACH_M, 1.5707963267948966)}
"""By id: where the reference line begins, and its heading."""
CROSSWALKS_AT_M: Final = (REACH_M - 9.0, REACH_M + 9.0)
SOLIDS: Final = {
    "house_north_east": ("building", 14.0, ((14, 14), (60, 14), (60, 40), (14, 40))),
    "house_north_west": ("building", 12.0, ((-70, 14), (-14, 14), (-14, 60), (-26, 60), (-26, 26), (-70, 26))),
    "house_south_east": ("building", 9.0, ((14, -34), (50, -34), (50, -14), (14, -14))),
    "kiosk": ("building", 6.0, ((-16, -17), (-8, -17), (-8, -13), (-16, -13))),
    "garden_wall": ("barrier", 2.0, ((10.3, 26.6), (10.6, 26.6), (10.6, 60), (10.3, 60))),
}
"""By id: type, height and corners in metres. They are objects of road 1, of which s is x + 150 and t is y."""


def write_lanes(sign: int) -> str:
    """The lanes of one side: 1 to the left, −1 to the right."""
    lanes = [
        f'<lane id="{sign * k}" type="{kind}"><width sOffset="0" a="{width}" b="0" c="0" d="0"/></lane>'
        for k, (kind, width) in enumerate(LANES, start=1)
    ]
    return "\n".join(lanes[:: sign * -1] if sign > 0 else lanes)


def write_objects(road: str) -> str:
    """Crosswalks of a road; houses and wall with road 1."""
    across_m = 2 * sum(width for _, width in LANES)
    found = [
        f'<object id="crosswalk_{k}" type="crosswalk" s="{s}" t="0" zOffset="0" hdg="0" length="4" width="{across_m}"/>'
        for k, s in enumerate(CROSSWALKS_AT_M, start=1)
    ]
    for name, (kind, height_m, corners) in SOLIDS.items() if road == "1" else ():
        outline = "".join(
            f'<cornerRoad s="{x + REACH_M:g}" t="{y:g}" dz="0" height="{height_m:g}"/>' for x, y in corners
        )
        place = f's="{corners[0][0] + REACH_M:g}" t="{corners[0][1]:g}" zOffset="0" hdg="0" height="{height_m:g}"'
        found.append(f'<object id="{name}" type="{kind}" {place}>\n<outline closed="true">{outline}</outline></object>')
    return "\n".join(found)


def write_road(road: str) -> str:
    """One straight road with its lanes and objects."""
    x, y, heading = ROADS[road]
    line = f'<geometry s="0" x="{x}" y="{y}" hdg="{heading}" length="{2 * REACH_M}"><line/></geometry>'
    sides = f"<left>\n{write_lanes(1)}\n</left>\n<right>\n{write_lanes(-1)}\n</right>"
    return (
        f'<road id="{road}" length="{2 * REACH_M}" junction="-1"><planView>{line}</planView>\n'
        f'<lanes><laneSection s="0">{sides}</laneSection></lanes>\n<objects>\n{write_objects(road)}\n</objects></road>'
    )


def main() -> None:
    """Write the map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("logs"))
    roads = "\n".join(map(write_road, ROADS))
    header = '<header revMajor="1" revMinor="6" name="crossing"/>'
    text = f'<?xml version="1.0"?>\n<OpenDRIVE>{header}\n{roads}\n</OpenDRIVE>\n'
    (parser.parse_args().out / "crossing.xodr").write_bytes(text.encode())


if __name__ == "__main__":
    main()
