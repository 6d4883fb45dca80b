"""Boxes of objects that say their shape otherwise: an outline, a solid that is no box, several bodies."""

from __future__ import annotations

import numpy as np

from copem_replay.core.tracks import VALUES, Bool, Float
from copem_replay.io.encodings.columns import Shredded, level_of, rows_above

_SPHERE, _CYLINDER, _CONE = 2, 3, 4
"""Types of shape_msgs/SolidPrimitive; a cylinder and a cone have a height and a radius."""
_YAW = VALUES.index("yaw_rad")
_SIZE = slice(VALUES.index("length_m"), VALUES.index("width_m") + 1)
_SIZES = slice(VALUES.index("length_m"), VALUES.index("height_m") + 1)


def outlined(values: Float, found: Shredded, objects: str, footprint: str) -> None:
    """Give those of `values (P, V)` without length and width the box around the points at `footprint`."""
    level = level_of(f"{footprint}.x")
    points = found.levels[level]
    owner = rows_above(found, level, objects)
    least, most = (np.full((len(values), 2), end) for end in (np.inf, -np.inf))
    for k, axis in enumerate("xy"):
        along = points.numbers[f"{footprint}.{axis}"]
        np.minimum.at(least[:, k], owner, along)
        np.maximum.at(most[:, k], owner, along)
    size = values[:, _SIZE]
    flat = np.flatnonzero(~(size > 0).all(axis=1) & (most > least).all(axis=1))  # of no point: never
    middle, yaw = (least[flat] + most[flat]) / 2, values[flat, _YAW]
    values[flat, _SIZE] = most[flat] - least[flat]
    values[flat, 0] += middle[:, 0] * np.cos(yaw) - middle[:, 1] * np.sin(yaw)
    values[flat, 1] += middle[:, 0] * np.sin(yaw) + middle[:, 1] * np.cos(yaw)


def rounded(values: Float, kind: Float, first: Float, second: Float) -> None:
    """Give solids that are no boxes the box around them, from their kind and their dimensions (P,)."""
    ball, upright = kind == _SPHERE, (kind == _CYLINDER) | (kind == _CONE)
    across = 2.0 * np.where(ball, first, second)
    height = np.where(ball, across, first)
    round_ = ball | upright
    values[round_, _SIZES] = np.stack([across, across, height], axis=1)[round_]


def largest(values: Float, meant: Bool, found: Shredded, objects: str, of: str) -> Bool:
    """(P,) of those that are meant the largest of each thing of the list `of`, the first of equal ones."""
    owner = rows_above(found, objects, of)
    volume = np.where(meant, np.nan_to_num(values[:, _SIZES]).prod(axis=1), -np.inf)
    order = np.lexsort((-volume, owner))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(owner[order]) != 0
    chosen = meant.copy()
    chosen[order[~first]] = False
    return chosen
