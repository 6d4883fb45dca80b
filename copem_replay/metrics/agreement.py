"""Agreement of a map and the traffic of a log: whether both are in one frame, and by how much they may be apart.

*Agreement* is the share of states of moving vehicles (faster than 1 m/s) whose centre is in a lane, of any kind that is
driven, that runs within 45° of their heading. It cannot tell a map that is 1 or 2 m off from one that is right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.site_map import Lane
from copem_replay.core.tracks import CLASS_GROUPS, CLASSES, Bool, Float, Int, Scene, Tracks

NOTED_BELOW: Final = 0.6
REFUSED_BELOW: Final = 0.3
_FEWEST: Final = 100
"""States: of fewer the share is printed, and nothing is concluded from it."""
_MOVES_MPS: Final = 1.0
_ALONG_RAD: Final = math.pi / 4

_REACH_M: Final = 40.0
"""The largest offset of the map that is searched."""
_CELL_M: Final = 0.5
_HEADINGS: Final = 16
_MOST_STATES: Final = 3000
_AS_GOOD: Final = 0.95
_EQUAL: Final = 0.99
_ELSEWHERE_M: Final = 3.0


@dataclass(frozen=True)
class Agreement:
    """The number of `states` of moving vehicles, and how many of them, `along`, are in a lane of their heading."""

    states: int
    along: int

    @property
    def share(self) -> float | None:
        """The share of states along a lane; None: no vehicle moves."""
        return self.along / self.states if self.states else None

    @property
    def words(self) -> str:
        """The agreement in one line, without the map's name."""
        if self.share is None:
            return "agreement with the traffic unknown: no vehicle moves"
        line = f"agreement with the traffic {self.share:.2f}: {self.along:,} of {self.states:,} states of moving"
        line += " vehicles are in a lane of their heading"
        if self.states < _FEWEST:
            return f"{line}; too few to conclude from"
        return line + ("; is the map in the frame of the log? (1–2 m are not seen)" if self.share < NOTED_BELOW else "")

    @property
    def refused(self) -> bool:
        """Whether the share is too low for the map to be in the log's frame."""
        return self.share is not None and self.states >= _FEWEST and self.share < REFUSED_BELOW


SOLIDS_NOTED_ABOVE: Final = 0.02
SOLIDS_REFUSED_ABOVE: Final = 0.1


@dataclass(frozen=True)
class Inside:
    """The number of `states` of moving vehicles, and how many of them are `inside` a solid of a map."""

    states: int
    inside: int

    @property
    def share(self) -> float:
        """The share of states inside a solid; 0 where no vehicle moves."""
        return self.inside / self.states if self.states else 0.0

    @property
    def words(self) -> str:
        """One line for a suspicious share, without the map's name; empty: nothing to report."""
        if self.states < _FEWEST or self.share <= SOLIDS_NOTED_ABOVE:
            return ""
        told = f"{self.inside:,} of {self.states:,} states of moving vehicles are inside a solid"
        return f"{told} ({self.share:.0%}): is the map in the frame of the log?"

    @property
    def refused(self) -> bool:
        """Whether the share is too high for the map to be in the log's frame."""
        return self.states >= _FEWEST and self.share > SOLIDS_REFUSED_ABOVE


def find_inside(scene: Scene, truth: Tracks, outlines: NDArray[np.object_]) -> Inside:
    """Count the states of moving vehicles whose centre is in an outline of a solid (shapely polygons).

    It stands in for agreement where a map has no lanes.
    """
    import shapely

    rows = moving_vehicle_rows(scene, truth)
    points = shapely.points(truth.x_m[0, rows], truth.y_m[0, rows])
    found = shapely.STRtree(points).query(outlines, predicate="contains")[1] if len(outlines) else []
    return Inside(len(rows), len(np.unique(found)))


def moving_vehicle_rows(scene: Scene, truth: Tracks) -> Int:
    """Rows (N,) of the truth in which a vehicle, no pedestrian and no cyclist, is faster than 1 m/s."""
    motor = np.array([name in CLASS_GROUPS["vehicles"] for name in CLASSES])
    fast = np.hypot(truth.vx_mps[0], truth.vy_mps[0]) > _MOVES_MPS
    vehicle = motor[scene.object_class[truth.row_object_ix]] & scene.moving[truth.row_object_ix]
    return np.flatnonzero(truth.valid[0] & fast & vehicle)


def find_agreement(scene: Scene, truth: Tracks, lanes: Sequence[Lane]) -> Agreement:
    """The agreement of lanes, given in the log's frame, with the log's traffic."""
    rows = moving_vehicle_rows(scene, truth)
    directed = DirectedLanes(lanes)
    along = directed.are_along(truth.x_m[0, rows], truth.y_m[0, rows], truth.yaw_rad[0, rows])
    return Agreement(len(rows), int(along.sum()))


class DirectedLanes:
    """Driven lanes, cut across into quadrangles with a direction each."""

    def __init__(self, lanes: Sequence[Lane]) -> None:
        import shapely

        cuts = [_cut_lane(lane) for lane in lanes if lane.kind == "driving"]
        corners = np.concatenate([corners for corners, _ in cuts]) if cuts else np.zeros((0, 4, 2))
        self.direction_rad = np.concatenate([heading for _, heading in cuts]) if cuts else np.zeros(0)
        self.middles_m = corners.mean(axis=1)
        self.ends_m = np.stack([(corners[:, 0] + corners[:, 3]) / 2, (corners[:, 1] + corners[:, 2]) / 2], axis=1)
        self.tree = shapely.STRtree(shapely.convex_hull(shapely.polygons(corners)) if len(corners) else [])

    def are_along(self, x_m: Float, y_m: Float, yaw_rad: Float) -> Bool:
        """Whether places (N,) are in a lane that runs within 45° of their headings."""
        import shapely

        along = np.zeros(len(x_m), dtype=bool)
        place, piece = self.tree.query(shapely.points(x_m, y_m), predicate="intersects")
        turn = np.abs(np.angle(np.exp(1j * (yaw_rad[place] - self.direction_rad[piece]))))
        along[place[turn <= _ALONG_RAD]] = True
        return along


def _cut_lane(lane: Lane) -> tuple[Float, Float]:
    """Quadrangles (K, 4, 2) across a lane, left border, right border back; and their headings (K,)."""
    left, right = (line[:, :2] for line in lane.across())
    corners = np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
    ahead = left[1:] - left[:-1] + right[1:] - right[:-1]
    return corners, np.arctan2(ahead[:, 1], ahead[:, 0])


@dataclass(frozen=True)
class Shift:
    """The shift of the map that agrees best with the traffic, and the best score more than 3 m from it."""

    east_m: float
    north_m: float
    score: float
    elsewhere: float
    elsewhere_deg: float  # direction of that other place, from east towards north, 0 … 180

    @property
    def words(self) -> str:
        """The shift in one line; it is printed and never applied."""
        line = f"best agreement with the map moved by [{self.east_m:g}, {self.north_m:g}] m (east, north)"
        ratio = self.elsewhere / self.score if self.score else 1.0
        line += f"; the best more than {_ELSEWHERE_M:g} m from there is {ratio:.0%} as good"
        if ratio >= _AS_GOOD:
            line += f": not determined along {self.elsewhere_deg:.0f}° (from east towards north)"
        return f"{line}; nothing is moved by itself (`offset_m` of the map does it)"


def estimate_shift(scene: Scene, truth: Tracks, lanes: Sequence[Lane]) -> Shift | None:
    """The shift of the map within ±40 m that puts the traffic best on the middles of lanes; None: no traffic, no lanes.

    The middles of lanes are drawn into rasters of 0.5 m by heading, blurred by 1 m, and every shift is tried.
    """
    rows, directed = moving_vehicle_rows(scene, truth), DirectedLanes(lanes)
    if not len(rows) or not len(directed.direction_rad):
        return None
    rows = rows[:: max(1, len(rows) // _MOST_STATES)]
    at_m = np.stack([truth.x_m[0, rows], truth.y_m[0, rows]], axis=1)
    raster = _HeadingRaster(directed, at_m)
    scores = raster.score_shifts(at_m, truth.yaw_rad[0, rows])
    steps_m = _CELL_M * np.arange(-raster.reach, raster.reach + 1)
    move_m = np.where(scores >= _EQUAL * scores.max(), np.hypot(*np.meshgrid(steps_m, steps_m, indexing="ij")), np.inf)
    i, j = np.unravel_index(int(move_m.argmin()), scores.shape)  # of equals the nearest to where the map is
    away_m = np.hypot(*np.meshgrid(steps_m - steps_m[i], steps_m - steps_m[j], indexing="ij"))
    scores_away = np.where(away_m > _ELSEWHERE_M, scores, -1.0)
    k, m = np.unravel_index(int(scores_away.argmax()), scores_away.shape)
    direction = math.degrees(math.atan2(steps_m[m] - steps_m[j], steps_m[k] - steps_m[i])) % 180.0
    east_m, north_m = -float(steps_m[i]) + 0.0, -float(steps_m[j]) + 0.0  # the traffic moved that way, so the map back
    return Shift(east_m, north_m, float(scores[i, j]), float(scores_away[k, m]), direction)


class _HeadingRaster:
    """Middles of lanes around the traffic, by heading: (16, W, H) numbers, 1 on a middle of that heading."""

    reach: Final = round(_REACH_M / _CELL_M)

    def __init__(self, directed: DirectedLanes, at_m: Float) -> None:
        from scipy.ndimage import gaussian_filter

        margin_m = _REACH_M + 5.0
        self.low_m = at_m.min(axis=0) - margin_m
        extent = np.ceil((at_m.max(axis=0) + margin_m - self.low_m) / _CELL_M).astype(np.int64)
        self.width, self.height = (int(min(n, 4000)) for n in extent)
        layers = np.zeros((_HEADINGS, self.width, self.height), dtype=np.float32)
        for (start, end), bin_ in zip(directed.ends_m, self.bins(directed.direction_rad), strict=True):
            n = max(2, min(10_000, math.ceil(float(np.hypot(*(end - start))) / _CELL_M) + 1))
            cell = np.floor((np.linspace(start, end, n) - self.low_m) / _CELL_M).astype(np.int64)
            inside = ((cell >= 0) & (cell < (self.width, self.height))).all(axis=1)
            layers[bin_, cell[inside, 0], cell[inside, 1]] = 1.0
        blurred = np.stack([gaussian_filter(layer, 1.0 / _CELL_M) for layer in layers])
        self.layers = blurred + 0.6 * np.roll(blurred, 1, axis=0) + 0.6 * np.roll(blurred, -1, axis=0)

    @staticmethod
    def bins(heading_rad: Float) -> Int:
        """The layer of each heading."""
        return np.rint(heading_rad / (2 * np.pi) * _HEADINGS).astype(np.int64) % _HEADINGS

    def score_shifts(self, at_m: Float, yaw_rad: Float) -> Float:
        """(2R + 1, 2R + 1) the mean score of places moved by R cells west to east, and south to north."""
        cell = np.floor((at_m - self.low_m) / _CELL_M).astype(np.int64)
        layer, n = self.bins(yaw_rad), 2 * self.reach + 1
        sums = np.zeros((n, n))
        for (i, j), k in zip(cell - self.reach, layer, strict=True):
            if i >= 0 and j >= 0 and i + n <= self.width and j + n <= self.height:
                sums += self.layers[k, i : i + n, j : j + n]
        scores: Float = sums / len(cell)
        return scores
