"""Fused lists block by block: many at once, and never so many that memory tells."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from copem_replay.core.tracks import Int

MOST_ROWS = 20_000
"""Of a block, unless one list has more (chosen: some MB)."""


def blocks(bounds: Int) -> Iterator[tuple[int, int]]:
    """The first list of each block and the one after its last; list k has rows `bounds[k]:bounds[k + 1]`."""
    first = 0
    while first < len(bounds) - 1:
        last = max(first + 1, int(np.searchsorted(bounds, bounds[first] + MOST_ROWS, side="right")) - 1)
        yield first, last
        first = last


def ranges(start: Int, rows: Int) -> tuple[Int, Int]:
    """Of some rows (R,) of all, `start[row]:start[row + 1]` one after the other, and where each begins (R + 1,)."""
    counts = start[rows + 1] - start[rows]
    begin = np.concatenate([[0], np.cumsum(counts)])
    return begin, np.arange(begin[-1]) + np.repeat(start[rows] - begin[:-1], counts)
