"""Rows: what a model is fitted to, one per list and true object within reach; the other entries; nodes of tables."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.sparse import csr_array

from copem_replay.core.interpolation import locate_on_axis
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.core.view_geometry import ViewGeometry


@dataclass(frozen=True)
class FitLists:
    """The lists of the unit, (L,), log by log in the order of capture: `log` which log, `captured_s` since its start.

    `east_m`, `north_m`, `heading_rad`: where the unit is then. `entries`: how many it holds, matched or not.
    """

    log: Int
    captured_s: Float
    east_m: Float
    north_m: Float
    heading_rad: Float
    entries: Int


@dataclass(frozen=True)
class FitRows:
    """One row (R,) per list × true object within reach, ordered by log, object and capture.

    `list`: index into `FitLists`; `log`; `object`: number of the true object within its log. `pass_ix`: which unbroken
    stay of an object within reach (a pass), numbered over all logs; the rows of a pass lie together. `view`: the true
    object from the unit. `listed`: whether the list has an entry of it. Of entries, NaN or −1 where not listed:
    errors (entry − truth, the delay removed) `along_m` and `across_m` of the line of sight (outwards, and to its left),
    `east_m`, `north_m`, `yaw_rad` wrapped, `speed_mps`, `size_m` (3, R) of length, width and height; NaN, too, where
    the lists have no such field, and where another true object is so near that the entry may be about either.
    `class_ix`, `existence` and `track_id` as listed. `state_m (R, 2)`: the true easting and northing. `fold`: which
    part of a cross-validation. `apart`: whether no other true object is so near; None: no row has one.
    """

    list: Int
    log: Int
    object: Int
    pass_ix: Int
    captured_s: Float
    view: ViewGeometry
    state_m: Float
    listed: Bool
    along_m: Float
    across_m: Float
    east_m: Float
    north_m: Float
    yaw_rad: Float
    speed_mps: Float
    size_m: Float
    class_ix: Int
    existence: Float
    track_id: Int
    fold: Int
    apart: Bool | None = None

    def take(self, rows: Int | Bool) -> FitRows:
        """The rows at these indices or in this mask."""
        rows = np.flatnonzero(rows) if np.asarray(rows).dtype == bool else rows
        out = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None}
        return FitRows(
            **{
                name: value.take(rows) if name == "view" else value[:, rows] if name == "size_m" else value[rows]
                for name, value in out.items()
            }
        )


@dataclass(frozen=True)
class OtherEntries:
    """The entries (E,) about no true object, and duplicates of one, list by list: place, time and content.

    `list`: index into `FitLists`; `range_m`, `azimuth_rad` from the unit; `nearest_m`: to the centre of the nearest
    true object of the list (inf: none), of class `nearest_class_ix`.
    """

    list: Int
    log: Int
    captured_s: Float
    east_m: Float
    north_m: Float
    range_m: Float
    azimuth_rad: Float
    nearest_m: Float
    nearest_class_ix: Int
    class_ix: Int
    existence: Float
    track_id: Int


# Nodes of a fitted table, and rows pooled by their place between nodes.

_PARTS = 16
"""Rows between two nodes are pooled by sixteenths of the way and their means kept: probabilities differ by less than
0.002 (docs/develop/decisions/fitting.md)."""

_APART = 0.05
"""Share of an axis by which a node keeps away from a frequent value, itself a node: nearer ones share its rows."""


@dataclass(frozen=True)
class NodeWeights:
    """The four nodes around each row (R,) and their weights: `node` and `weight` (R, 4).

    `shape`: how many tables, ranges and visible shares; nodes (K,) are numbered in that order.
    """

    node: Int
    weight: Float
    shape: tuple[int, int, int]

    def chances(self, theta: Float) -> Float:
        """(R,) probability of a hit, by the probabilities (K,) at the nodes."""
        result: Float = (self.weight * theta[self.node]).sum(axis=1)
        return result

    def dense(self) -> Float:
        """(R, K) the weight of every node."""
        out = np.zeros((len(self.node), int(np.prod(self.shape))))
        np.add.at(out, (np.arange(len(self.node))[:, None], self.node), self.weight)
        return out

    def pooled(self) -> NodeWeights:
        """These weights in one table that all tables have in common."""
        nodes = self.shape[1] * self.shape[2]
        return NodeWeights(self.node % nodes, self.weight, (1, *self.shape[1:]))


@dataclass(frozen=True)
class PooledRows:
    """Pooled rows (C,): where they lie, and whether they are listed; `count (passes, C)`: how many of each pass."""

    placed: NodeWeights
    hit: Bool
    count: csr_array


def choose_nodes(values: Float, most: int, least: float, decimals: int) -> Float:
    """Nodes of an axis: at quantiles of values (R,), and at values that are frequent by themselves.

    At most `most`, each with at least `least` rows by their weights; with too few rows one node.
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
        cell, along = locate_on_axis(nodes, values)
        mass = np.bincount(cell, 1 - along, len(nodes)) + np.bincount(cell + 1, along, len(nodes))
        if mass.min() >= least and len(nodes) <= most:
            break
        # The ends stay: of an end with too few rows the neighbour is removed.
        poor = int(np.argmin(mass))
        nodes = nodes[:1] if len(nodes) == 2 else np.delete(nodes, min(max(poor, 1), len(nodes) - 2))
    return nodes


def weigh_nodes(axes: tuple[Float, Float], values: tuple[Float, Float], table: Int) -> NodeWeights:
    """The nodes around rows (R,). `axes`: nodes of range and visible share. `values`, `table`: of the rows."""
    (i, a), (j, b) = (locate_on_axis(axis, value) for axis, value in zip(axes, values, strict=True))
    size = len(axes[0]), len(axes[1])
    far, wide = np.minimum(i + 1, size[0] - 1), np.minimum(j + 1, size[1] - 1)
    node = [(table * size[0] + m) * size[1] + n for m in (i, far) for n in (j, wide)]
    weight = [one * other for one in (1 - a, a) for other in (1 - b, b)]
    return NodeWeights(np.stack(node, axis=1), np.stack(weight, axis=1), (int(table.max()) + 1, *size))


def pool_rows(rows: NodeWeights, listed: Bool, pass_number: Int) -> PooledRows:
    """Rows (R,) pooled by node, sixteenth of the way between nodes, and hit or miss."""
    along = [np.rint(rows.weight[:, m].sum(axis=1) * _PARTS).astype(np.int64) for m in ([1, 3], [2, 3])]
    label = ((rows.node[:, 0] * (_PARTS + 1) + along[0]) * (_PARTS + 1) + along[1]) * 2 + listed
    _, first, label_ix, size = np.unique(label, return_index=True, return_inverse=True, return_counts=True)
    shape = (int(pass_number.max()) + 1, len(first))
    count = csr_array((np.ones(len(label_ix)), (pass_number, label_ix)), shape=shape)
    count.sum_duplicates()
    weight = np.stack([np.bincount(label_ix, one) / size for one in rows.weight.T], axis=1)
    return PooledRows(NodeWeights(rows.node[first], weight, rows.shape), listed[first], count)


# How many rows are worth one that is independent: rows of a pass are correlated.

_LONGEST = 400
"""Largest lag of the correlation, in lists: forty seconds of ten lists a second. More takes longer."""


def count_rows_per_effective(residual: Float, pass_ix: Int) -> float:
    """1 + 2 Σ ρₖ, at least 1, of residuals (R,), recorded less expected, in the order of passes and lists.

    ρₖ: correlation of rows of a pass that are k apart, each pair counted once, as in the sum (1 − k/m) ρₖ of a pass of
    m. Summed in pairs of neighbours until a pair is not positive (Geyer, Statist. Sci. 7 (1992) 473–483).
    """
    square_sum = float(residual @ residual)
    if square_sum == 0:
        return 1.0
    total, odd = 0.0, 0.0
    for k in range(1, min(_LONGEST, len(residual))):
        same = pass_ix[k:] == pass_ix[:-k]
        if not same.any():
            break
        correlation = float((residual[k:] * residual[:-k])[same].sum()) / square_sum
        if k % 2 == 0 and odd + correlation <= 0:
            break
        if k % 2 == 0:
            total += odd + correlation
        odd = correlation
    return max(1 + 2 * total, 1.0)
