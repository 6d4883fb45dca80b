"""The overlap of two boxes, seen from above."""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.core.tracks import Float

_MOST_CORNERS = 20
"""A rectangle cut by four lines has 8 corners at most. Whatever rounding does, a cut adds no more than half as many as
there were: 4, 6, 9, 13, 19."""


@nb.njit(cache=True, nogil=True)
def rotated_iou(
    x0: float, y0: float, yaw0: float, l0: float, w0: float,
    x1: float, y1: float, yaw1: float, l1: float, w1: float,
) -> float:  # fmt: skip
    """Intersection over union of two boxes: centre, yaw in radians, length and width; in [0, 1].

    The same with the boxes exchanged, to the last bit. 0 for boxes without an area, and where something is NaN.
    """
    area0 = l0 * w0 if l0 > 0.0 and w0 > 0.0 else 0.0
    area1 = l1 * w1 if l1 > 0.0 and w1 > 0.0 else 0.0
    dx, dy = x0 - x1, y0 - y1
    reach = (np.sqrt(l0 * l0 + w0 * w0) + np.sqrt(l1 * l1 + w1 * w1)) / 2
    if not (area0 > 0.0 and area1 > 0.0 and dx * dx + dy * dy < reach * reach):
        return 0.0
    if (l0, w0, yaw0, x0, y0) < (l1, w1, yaw1, x1, y1):  # always the same of the two is cut by the other
        both = _intersection(dx, dy, yaw0, l0, w0, yaw1, l1, w1)
    else:
        both = _intersection(-dx, -dy, yaw1, l1, w1, yaw0, l0, w0)
    both = min(both, area0, area1)
    return float(both / (area0 + area1 - both))


@nb.njit(cache=True, nogil=True)
def _intersection(
    dx: float, dy: float, yaw: float, length: float, width: float, by_yaw: float, by_length: float, by_width: float
) -> float:
    """Area of a box cut by another, whose centre it is dx, dy away from: side by side, in the frame of the other.

    Source: I. E. Sutherland, G. W. Hodgman, "Reentrant polygon clipping", Commun. ACM 17 (1974) 32–42.
    """
    c, s = np.cos(yaw - by_yaw), np.sin(yaw - by_yaw)
    cos, sin = np.cos(by_yaw), np.sin(by_yaw)
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    now, cut = np.empty((_MOST_CORNERS, 2)), np.empty((_MOST_CORNERS, 2))
    count = 0
    for u, v in ((length, width), (-length, width), (-length, -width), (length, -width)):
        now[count, 0], now[count, 1] = x + (c * u - s * v) / 2, y + (s * u + c * v) / 2
        count += 1
    for axis, side, reach in ((0, 1.0, by_length), (0, -1.0, by_length), (1, 1.0, by_width), (1, -1.0, by_width)):
        count = _cut(now, count, axis, side, reach / 2, cut)
        now, cut = cut, now
    twice = 0.0
    for k in range(2, count):  # triangles at the first corner
        ax, ay = now[k - 1, 0] - now[0, 0], now[k - 1, 1] - now[0, 1]
        bx, by = now[k, 0] - now[0, 0], now[k, 1] - now[0, 1]
        twice += ax * by - ay * bx
    return float(max(twice / 2, 0.0))


@nb.njit(cache=True, nogil=True)
def _cut(polygon: Float, count: int, axis: int, side: float, reach: float, out: Float) -> int:
    """What of a polygon lies where side · coordinate ≤ reach; how many corners that has."""
    kept = 0
    for k in range(count):
        m = k + 1 if k + 1 < count else 0
        here, there = reach - side * polygon[k, axis], reach - side * polygon[m, axis]
        if here >= 0.0:
            out[kept] = polygon[k]
            kept += 1
        if (here >= 0.0) != (there >= 0.0):
            f = here / (here - there)
            out[kept, axis] = side * reach
            out[kept, 1 - axis] = polygon[k, 1 - axis] + f * (polygon[m, 1 - axis] - polygon[k, 1 - axis])
            kept += 1
    return kept
