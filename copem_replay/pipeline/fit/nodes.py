"""Where the nodes of a fitted table lie, and the rows put together by where they lie between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from copem_replay.core.grid import place_on
from copem_replay.core.tracks import Bool, Float, Int

_PARTS = 16
"""Rows between two nodes are put together by sixteenths of the way (chosen); their means are kept."""

_APART = 0.05
"""A node is no nearer than this share of the axis to a frequent value (chosen)."""


@dataclass(frozen=True)
class Placed:
    """Between which nodes each of (R,) lies: `node` and `weight` (R, 4).

    `shape`: so many tables, ranges and visible shares; their nodes (K,) are numbered in that order.
    """

    node: Int
    weight: Float
    shape: tuple[int, int, int]

    def chances(self, theta: Float) -> Float:
        """(R,) probability of a hit, by the probabilities (K,) at the nodes."""
        result: Float = (self.weight * theta[self.node]).sum(axis=1)
        return result

    def pooled(self) -> Placed:
        """The same in one table that all have in common."""
        one = self.shape[1] * self.shape[2]
        return Placed(self.node % one, self.weight, (1, *self.shape[1:]))


@dataclass(frozen=True)
class Entries:
    """Rows put together (C,): where they lie, and whether they are listed; `count (passes, C)` of each pass."""

    placed: Placed
    hit: Bool
    count: csr_array


def nodes_of(values: Float, most: int, least: float, decimals: int) -> Float:
    """Nodes of an axis: at quantiles of values (R,), and at values that are frequent by themselves.

    At most `most`, each with at least `least` rows by their weights; where there are too few, one node.
    """
    values = np.round(values, decimals)
    unique, count = np.unique(values, return_counts=True)
    often = count * most > len(values)
    rest = values[~np.isin(values, unique[often])]
    levels = np.linspace(0, 1, max(most - int(often.sum()), 2))
    quantiles = np.round(np.quantile(rest, levels), decimals) if len(rest) else rest
    near = (np.abs(quantiles[:, None] - unique[often]) < _APART * np.ptp(values)).any(axis=1)
    nodes = np.unique(np.concatenate([unique[often], quantiles[~near]]))
    while len(nodes) > 1:
        cell, along = place_on(nodes, values)
        mass = np.bincount(cell, 1 - along, len(nodes)) + np.bincount(cell + 1, along, len(nodes))
        if mass.min() >= least and len(nodes) <= most:
            break
        # Of a poor end its neighbour goes: the ends stay.
        poor = int(np.argmin(mass))
        nodes = nodes[:1] if len(nodes) == 2 else np.delete(nodes, min(max(poor, 1), len(nodes) - 2))
    return nodes


def placed(axes: tuple[Float, Float], values: tuple[Float, Float], table: Int) -> Placed:
    """Where rows (R,) lie: `axes`: nodes of range and visible share, `values` of the rows; `table` of each."""
    (i, a), (j, b) = (place_on(axis, value) for axis, value in zip(axes, values, strict=True))
    size = len(axes[0]), len(axes[1])
    far, wide = np.minimum(i + 1, size[0] - 1), np.minimum(j + 1, size[1] - 1)
    node = [(table * size[0] + m) * size[1] + n for m in (i, far) for n in (j, wide)]
    weight = [one * other for one in (1 - a, a) for other in (1 - b, b)]
    return Placed(np.stack(node, axis=1), np.stack(weight, axis=1), (int(table.max()) + 1, *size))


def put_together(rows: Placed, listed: Bool, pass_number: Int) -> Entries:
    """Rows (R,) of the same place, as near as makes no difference, put together."""
    along = [np.rint(rows.weight[:, m].sum(axis=1) * _PARTS).astype(np.int64) for m in ([1, 3], [2, 3])]
    label = ((rows.node[:, 0] * (_PARTS + 1) + along[0]) * (_PARTS + 1) + along[1]) * 2 + listed
    _, first, which, size = np.unique(label, return_index=True, return_inverse=True, return_counts=True)
    shape = (int(pass_number.max()) + 1, len(first))
    count = csr_array((np.ones(len(which)), (pass_number, which)), shape=shape)
    count.sum_duplicates()
    weight = np.stack([np.bincount(which, one) / size for one in rows.weight.T], axis=1)
    return Entries(Placed(rows.node[first], weight, rows.shape), listed[first], count)
