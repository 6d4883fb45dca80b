"""Areas on the ground: whether a place is in one. Their edges belong to them."""

from __future__ import annotations

import numpy as np

from copem_replay.core.kernels import borrowing
from copem_replay.core.tracks import Bool, Float

_EDGE_M = 1e-6
"""So near an edge a place is on it (chosen: rounding is less, and no place is known so well)."""


@borrowing
def in_polygon(x_m: float, y_m: float, corners_m: Float) -> bool:
    """Whether a place is in a polygon (V, 2), on its edge included. By the number of edges east of it."""
    inside = False
    for k in range(len(corners_m)):
        from_x, from_y = corners_m[k - 1]
        to_x, to_y = corners_m[k]
        way_x, way_y = to_x - from_x, to_y - from_y
        square = way_x * way_x + way_y * way_y
        along = ((x_m - from_x) * way_x + (y_m - from_y) * way_y) / square if square > 0 else 0.0
        along = min(max(along, 0.0), 1.0)
        if np.hypot(x_m - from_x - along * way_x, y_m - from_y - along * way_y) <= _EDGE_M:
            return True
        if (from_y > y_m) != (to_y > y_m) and x_m < from_x + (y_m - from_y) / way_y * way_x:
            inside = not inside
    return inside


@borrowing
def in_area(x_m: float, y_m: float, from_x_m: float, from_y_m: float, corners_m: Float, range_m: float) -> bool:
    """Whether a place is within a range of another one, and in a polygon; `corners_m` without corners: anywhere."""
    if np.hypot(x_m - from_x_m, y_m - from_y_m) > range_m + _EDGE_M:
        return False
    return len(corners_m) == 0 or in_polygon(x_m, y_m, corners_m)


def in_areas(x_m: Float, y_m: Float, from_x_m: Float, from_y_m: Float, corners_m: Float, range_m: float) -> Bool:
    """(K,) the same of places, each from one."""
    found = (in_area(*place, corners_m, range_m) for place in zip(x_m, y_m, from_x_m, from_y_m, strict=True))
    return np.fromiter(found, dtype=bool, count=len(x_m))


def corners(polygon_m: tuple[tuple[float, float], ...] | None) -> Float:
    """(V, 2) the corners of a polygon, none: anywhere."""
    return np.array(polygon_m or (), dtype=np.float64).reshape(-1, 2)
