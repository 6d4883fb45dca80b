"""An order of entries by their content alone: neither the order they came in nor their units matter."""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.core.tracks import Float, Int

_BLOCK = 16
"""So few are put in order one by one (chosen)."""


@nb.njit(cache=True, nogil=True)
def rows_in_order(start: Int, content: Float) -> Int:
    """Indices of the entries (N,), list by list, in order of their content, place first."""
    rows = np.arange(start[-1])
    for f in range(len(start) - 1):
        sort_rows(content, rows[start[f] : start[f + 1]])
    return rows


@nb.njit(cache=True, nogil=True)
def sort_rows(values: Float, order: Int) -> None:
    """Sort `order`, indices of rows of `values (N, V)`, by the first column, then the second …; in place, stably."""
    n = len(order)
    # The first column nearly always decides: it is kept at hand.
    key, other_key, other = np.empty(n), np.empty(n), np.empty(n, np.int64)
    for p in range(n):
        x, r, at = values[order[p], 0], order[p], p
        while at % _BLOCK > 0 and (
            x < key[at - 1] or (x == key[at - 1] and compare_rows(values, r, order[at - 1]) < 0)
        ):
            key[at], order[at] = key[at - 1], order[at - 1]
            at -= 1
        key[at], order[at] = x, r
    block = _BLOCK
    while block < n:
        for left in range(0, n, 2 * block):
            middle, right = min(left + block, n), min(left + 2 * block, n)
            i, j = left, middle
            for p in range(left, right):
                later = j < right and i < middle
                if later:
                    later = key[j] < key[i] or (key[j] == key[i] and compare_rows(values, order[j], order[i]) < 0)
                if later or i == middle:
                    other_key[p], other[p] = key[j], order[j]
                    j += 1
                else:
                    other_key[p], other[p] = key[i], order[i]
                    i += 1
        for p in range(n):
            key[p], order[p] = other_key[p], other[p]
        block *= 2


@nb.njit(cache=True, nogil=True)
def compare_rows(values: Float, a: int, b: int) -> int:
    """−1, 0 or 1 as row a comes before row b, is the same, or comes after."""
    for v in range(values.shape[1]):
        if values[a, v] != values[b, v]:
            return -1 if values[a, v] < values[b, v] else 1
    return 0
