"""Tables of numbers over two axes, bilinear between the given values, constant beyond them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from copem_replay.core.tracks import Float, Int

Axis = tuple[str, Sequence[float]]
"""Its name, and its values."""


def check_grid(first: Axis, second: Axis, name: str, rows: Sequence[Sequence[float]]) -> None:
    """Raise ValueError unless both axes increase and `name` has a row for each value of the first, one number each."""
    for axis_name, axis in (first, second):
        if any(b <= a for a, b in pairwise(axis)):
            raise ValueError(f"{axis_name}: expected increasing values, found {list(axis)}")
    expected, widths = (len(first[1]), len(second[1])), {len(row) for row in rows}
    if len(rows) != expected[0] or widths != {expected[1]}:
        raise ValueError(
            f"{name}: expected {expected[0]} rows ({first[0]}) of {expected[1]} values ({second[0]}), "
            f"found {len(rows)} rows of {sorted(widths)}"
        )


def bilinear(
    first: Sequence[float], second: Sequence[float], rows: Sequence[Sequence[float]], x: Float, y: Float
) -> Float:
    """(P,) the table at x (P,) on its first axis and y (P,) on its second."""
    table = np.array(rows)
    i, a = place_on(np.array(first), x)
    j, b = place_on(np.array(second), y)
    i1, j1 = np.minimum(i + 1, table.shape[0] - 1), np.minimum(j + 1, table.shape[1] - 1)
    low = table[i, j] * (1 - b) + table[i, j1] * b
    high = table[i1, j] * (1 - b) + table[i1, j1] * b
    result: Float = low * (1 - a) + high * a
    return result


def place_on(axis: Float, value: Float) -> tuple[Int, Float]:
    """Cell (P,) and place within it (P,), 0 … 1, of values on an ascending axis; the ends hold beyond them."""
    if len(axis) == 1:
        return np.zeros(len(value), dtype=int), np.zeros(len(value))
    cell = np.clip(np.searchsorted(axis, value, side="right") - 1, 0, len(axis) - 2)
    return cell, np.clip((value - axis[cell]) / (axis[cell + 1] - axis[cell]), 0.0, 1.0)
