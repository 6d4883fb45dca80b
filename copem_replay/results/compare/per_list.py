"""The fused lists of two configurations, paired instant by instant: what they say of the same object at the same time.

Only instants that both have count (within 1 µs is one): of other latencies or rates there may be none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS, Float, Int
from copem_replay.results.compare.pairing import Grid

if TYPE_CHECKING:
    from copem_replay.results.compare.configuration_data import AccuracyData

_VALUES = 4_000_000
"""Values paired at a time (chosen: a few hundred MB)."""


@dataclass(frozen=True)
class Together:
    """Sums over the lists that two configurations share. (…, 2): of the first and of the second."""

    matched: Int  # (C,) lists in which both match the object of the cell
    squared_m2: Float  # (C, 2) Σ e² over them
    measured: Int  # (C,) lists in which the object of the cell is measured
    gospa: Float  # (C, 2) Σ of its parts of GOSPA over them
    lists: Int  # (S,) shared lists in which an object of the cells is measured


def together(first: AccuracyData, second: AccuracyData, grid: Grid, cells: Int) -> Together:
    """Pair the lists of cells (C,)."""
    run_of = cells % grid.runs
    other, offset = _same_instants(first, second, np.arange(grid.runs))
    most = max((len(times) for times in first.available_s), default=0)
    matched, measured = np.zeros((2, len(cells)), dtype=np.int64)
    squared, gospa = np.zeros((2, len(cells), 2))
    seen = np.zeros(grid.runs * most, dtype=bool)
    until = np.cumsum(first.length[cells])
    bounds = np.searchsorted(until, np.arange(_VALUES, int(until[-1]) if len(until) else 0, _VALUES))
    for part in np.split(np.arange(len(cells)), bounds):
        row, at, number, same = _aligned(first, second, other, offset[run_of], cells, part)
        both = [side.error_m[k].astype(float) for side, k in ((first, at), (second, same))]
        k = ~np.isnan(both[0] + both[1])
        matched += np.bincount(row[k], minlength=len(cells))
        parts = [side.gospa[k] for side, k in ((first, at), (second, same))]
        g = ~np.isnan(parts[0] + parts[1])
        measured += np.bincount(row[g], minlength=len(cells))
        for side in (0, 1):
            squared[:, side] += np.bincount(row[k], both[side][k] ** 2, minlength=len(cells))
            gospa[:, side] += np.bincount(row[g], parts[side][g], minlength=len(cells))
        seen[run_of[row[g]] * most + number[g]] = True
    return Together(matched, squared, measured, gospa, seen.reshape(grid.runs, most).sum(axis=1))


def shared_instants(first: AccuracyData, second: AccuracyData) -> Int:
    """(3,) how many instants of the log both have, and how many each; of all runs where those of a side differ."""
    sides = (first, second)
    runs = np.arange(len(first.of_run) if first.by_run or second.by_run else 1)
    other, offset = _same_instants(first, second, runs)
    counts = [np.array([len(times) for times in side.available_s])[side.of_run[runs]] for side in sides]
    has = np.append(0, np.cumsum(other >= 0))
    return np.array([(has[offset + counts[0]] - has[offset]).sum(), *(count.sum() for count in counts)])


def _same_instants(first: AccuracyData, second: AccuracyData, runs: Int) -> tuple[Int, Int]:
    """For instants of the first their numbers in the second, −1: none; and where those of each run (R,) begin."""
    pairs, which = np.unique(np.stack([first.of_run[runs], second.of_run[runs]]), axis=1, return_inverse=True)
    found = []
    for mine, others in pairs.T.tolist():
        mine_s, other_s = first.available_s[mine], second.available_s[others]
        # The nearest of the other's, to the left or to the right.
        right = np.searchsorted(other_s, mine_s)
        near = np.full(len(mine_s), -1, dtype=np.int64)
        for k in (right - 1, right):
            there = (k >= 0) & (k < len(other_s))
            there[there] = np.abs(other_s[k[there]] - mine_s[there]) <= SAME_INSTANT_NS * 1e-9 * (1 + 1e-6)
            near[there] = k[there]
        found.append(near)
    counts = np.array([len(near) for near in found], dtype=np.int64)
    begins = (np.cumsum(counts) - counts)[which.ravel()]
    return np.concatenate([np.empty(0, dtype=np.int64), *found]), begins


def _aligned(
    first: AccuracyData, second: AccuracyData, other: Int, offset: Int, cells: Int, part: Int
) -> tuple[Int, Int, Int, Int]:
    """(V,) rows of `cells`, places in the first's values, numbers of its instants, places in the second's values.

    Of the rows `part` of `cells (C,)`, whose instants begin at `offset (C,)` in `other`.
    """
    length = first.length[cells[part]]
    row = np.repeat(part, length)
    within = np.arange(len(row)) - np.repeat(np.cumsum(length) - length, length)
    cell = cells[row]
    number = first.first[cell] + within
    same = other[offset[row] + number] - second.first[cell]
    shared = (other[offset[row] + number] >= 0) & (same >= 0) & (same < second.length[cell])
    if not shared.all():
        row, within, cell, number, same = (values[shared] for values in (row, within, cell, number, same))
    return row, first.start[cell] + within, number, second.start[cell] + same
