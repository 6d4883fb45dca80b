"""How far a fit reaches, which stays within that are passes, and which part of a cross-validation each is in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.core.view_geometry import ViewGeometry

RANGE_BIN_M, AZIMUTH_BIN_DEG = 5.0, 5.0
FEWEST_MATCHED = 5
"""A bin of range or of azimuth with fewer entries of true objects tells nothing (all chosen),"""
LEAST_SHARE = 0.05
"""nor does one in which less than this share of the rows is matched (chosen)."""
FOLDS = 5
"""Parts of a cross-validation where nothing else is asked for (chosen)."""
FEWEST_PASSES = 4
"""Of fewer passes none is held out."""


@dataclass(frozen=True)
class FitReach:
    """Where the fitted model applies: nothing is claimed beyond. `azimuth_deg` None: all around."""

    range_m: tuple[float, float]
    azimuth_deg: tuple[float, float] | None

    def holds(self, view: ViewGeometry) -> Bool:
        """(P,) what is within."""
        low_m, high_m = self.range_m
        inside: Bool = (view.range_m >= low_m) & (view.range_m <= high_m)
        if self.azimuth_deg is not None:
            first, last = self.azimuth_deg
            turned = np.mod(np.degrees(view.azimuth_rad) - first, 360.0)
            inside &= turned <= np.mod(last - first, 360.0)
        return inside


def reach_of(view: ViewGeometry, listed: Bool) -> FitReach | None:
    """From the nearest to the farthest bin that has matched rows enough; None: no bin has."""
    full = _full((view.range_m / RANGE_BIN_M).astype(np.int64), listed)
    if not len(full):
        return None
    range_m = (float(full[0] * RANGE_BIN_M), float((full[-1] + 1) * RANGE_BIN_M))
    inside = (view.range_m >= range_m[0]) & (view.range_m <= range_m[1])
    return FitReach(range_m, _sector(np.degrees(view.azimuth_rad[inside]), listed[inside]))


def _full(bin_ix: Int, listed: Bool) -> Int:
    """The bins with matched rows enough, ascending: what few of many rows match are other entries nearby."""
    rows, matched = np.bincount(bin_ix), np.bincount(bin_ix[listed], minlength=int(bin_ix.max(initial=0)) + 1)
    return np.flatnonzero((matched >= FEWEST_MATCHED) & (matched >= LEAST_SHARE * rows))


def _sector(azimuth_deg: Float, listed: Bool) -> tuple[float, float] | None:
    """All around but the widest gap between bins with rows enough; None: there is none, or no bin has enough."""
    count = round(360 / AZIMUTH_BIN_DEG)
    full = _full(np.floor(np.mod(azimuth_deg, 360.0) / AZIMUTH_BIN_DEG).astype(np.int64) % count, listed)
    if not len(full):
        return None
    gap = np.diff(full, append=full[0] + count) - 1
    widest = int(gap.argmax())
    if gap[widest] == 0:
        return None
    first = full[(widest + 1) % len(full)] * AZIMUTH_BIN_DEG
    last = (full[widest] + 1) * AZIMUTH_BIN_DEG
    turn = first - 360.0 if first >= 180.0 else first
    end = last - 360.0 if last > 180.0 else last
    return float(turn), float(end)


def passes(log: Int, object_ix: Int, list_ix: Int) -> Int:
    """(R,) the pass of each row, of rows ordered by log, object and list: ends where a list has no row."""
    new = (np.diff(log, prepend=-1) != 0) | (np.diff(object_ix, prepend=-1) != 0) | (np.diff(list_ix, prepend=-1) != 1)
    number: Int = np.cumsum(new) - 1
    return number


def folds_of(pass_ix: Int, log: Int, folds: int | None) -> Int:
    """(R,) the fold of each row: whole logs where there are as many, else whole passes; all 0 of too few passes."""
    logs, which_log = np.unique(log, return_inverse=True)
    number = int(pass_ix[-1]) + 1 if len(pass_ix) else 0
    asked = folds or FOLDS
    if len(logs) >= asked:
        return np.asarray(which_log % asked, dtype=np.int64)
    if number < FEWEST_PASSES:
        return np.zeros(len(pass_ix), dtype=np.int64)
    return pass_ix % min(asked, number)
