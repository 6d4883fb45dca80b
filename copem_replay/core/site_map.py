"""What a map says of a site: lanes, areas and solids. Readers of map formats fill these; nothing else knows formats.

Places are metres in the frame of the map until a log's frame is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from copem_replay.core.tracks import Area, Float

LaneKind = Literal["driving", "bicycle", "walking", "parking", "other"]
AreaKind = Literal["crosswalk", "junction", "drivable", "parking"]


@dataclass(frozen=True)
class Lane:
    """A lane by its two borders, both in the direction in which it is driven."""

    id: str
    kind: LaneKind
    left_m: Float  # (K, 3)
    right_m: Float  # (L, 3)
    junction: bool = False

    @property
    def outline_m(self) -> Float:
        """The corners (K + L, 2): along the left border and back along the right."""
        return np.concatenate([self.left_m[:, :2], self.right_m[::-1, :2]])

    def across(self) -> tuple[Float, Float]:
        """Points (N, 3) of the left and the right border at equal shares of their lengths, at the vertices of both."""
        lines = (self.left_m, self.right_m)
        lengths = [np.append(0.0, np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))) for line in lines]
        shares = np.unique(np.concatenate([at / at[-1] for at in lengths if at[-1] > 0.0] or [[0.0, 1.0]]))
        left, right = (
            np.column_stack([np.interp(shares * at[-1], at, line[:, k]) for k in range(3)])
            for line, at in zip(lines, lengths, strict=True)
        )
        return left, right

    def turned(self) -> Lane:
        """The lane in the opposite driving direction."""
        return replace(self, left_m=self.right_m[::-1], right_m=self.left_m[::-1])


def make_area(name: str, kind: AreaKind | LaneKind, *rings_m: Float) -> Area:
    """An area of rings (K, 2), the outer first; a ring may repeat its first corner at the end."""
    rings = [ring[:-1] if len(ring) > 1 and (ring[0] == ring[-1]).all() else ring for ring in rings_m]
    return Area(name, kind, tuple(tuple((float(x), float(y)) for x, y in ring[:, :2]) for ring in rings))


class MapSolid(NamedTuple):
    """An upright prism that hides: its rings, the outer first, and heights in the map; where it is from."""

    name: str
    kind: str  # building, wall, barrier, …
    rings_m: tuple[Float, ...]  # (K, 2) each
    bottom_m: float
    top_m: float
    above_ground: bool = False  # heights are above the ground at its place, not above z = 0
    on_ground: bool = False  # nothing is seen below it


@dataclass(frozen=True)
class SiteMap:
    """A map as its file states it. `proj`: the projection of its metres that the file names, "": none."""

    lanes: tuple[Lane, ...] = ()
    areas: tuple[Area, ...] = ()
    solids: tuple[MapSolid, ...] = ()
    proj: str = ""
    offset_m: tuple[float, float] = (0.0, 0.0)  # p_projected = R(yaw)·p + offset
    yaw_rad: float = 0.0
    degrees: bool = False  # x is the longitude, y the latitude of WGS84: `proj` tells nothing
    assumed: tuple[str, ...] = field(default=())  # a line for each kind of thing assumed or left out
    licence: str = ""  # what the file says must be said wherever the map is shown

    def moved(self, move: Callable[[Float], Float]) -> SiteMap:
        """The map with all places (N, 2) moved by a function; heights stay."""

        def border(line: Float) -> Float:
            return np.column_stack([move(line[:, :2]), line[:, 2]])

        return replace(
            self,
            lanes=tuple(replace(a, left_m=border(a.left_m), right_m=border(a.right_m)) for a in self.lanes),
            areas=tuple(_move_area(a, move) for a in self.areas),
            solids=tuple(s._replace(rings_m=tuple(map(move, s.rings_m))) for s in self.solids),
        )  # fmt: skip


def _move_area(area: Area, move: Callable[[Float], Float]) -> Area:
    rings = (tuple((float(x), float(y)) for x, y in move(np.array(ring))) for ring in area.rings_m)
    return area._replace(rings_m=tuple(rings))


def find_borders(lanes: Sequence[Lane]) -> Iterator[Float]:
    """The borders of lanes; a border that two lanes share is there once."""
    seen = set[bytes]()
    for line in (line for lane in lanes for line in (lane.left_m, lane.right_m)):
        names = {line.tobytes(), line[::-1].tobytes()}
        if not names & seen:
            seen |= names
            yield line


def outline_crosswalks(areas: Sequence[Area], lanes: Sequence[Lane]) -> Iterator[Float]:
    """Closed outlines (K, 3) of crosswalks, as high as the nearest points of lanes' borders."""
    from scipy.spatial import KDTree

    points = np.concatenate([np.zeros((1, 3)) if not lanes else np.empty((0, 3)), *find_borders(lanes)])
    tree = KDTree(points[:, :2])
    for area in areas:
        if area.kind == "crosswalk":
            ring = np.array([*area.rings_m[0], area.rings_m[0][0]])
            yield np.column_stack([ring, points[tree.query(ring)[1], 2]])


_MOST_CROSSING = 200
"""Corners of an outline that crosses itself and is mended: with more, crossings may be more than can be found."""


def make_polygon(rings_m: Sequence[Any]) -> Any:
    """The shapely polygon of rings, mended where edges cross; empty where they cross and are many."""
    import shapely

    polygon = shapely.Polygon(rings_m[0], rings_m[1:]) if len(rings_m[0]) > 2 else shapely.Polygon()
    if polygon.is_valid:
        return polygon
    return shapely.make_valid(polygon) if sum(map(len, rings_m)) <= _MOST_CROSSING else shapely.Polygon()
