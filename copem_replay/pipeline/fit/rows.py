"""What a model is fitted to: one row per list of the unit and true object that it could hold, and the other entries."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

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
    errors `along_m` and `across_m` of the line of sight (entry − truth; along: outwards, across: to its left; the
    delay removed), `east_m`, `north_m` the same in easting and northing, `yaw_rad` wrapped, `speed_mps`, `size_m`
    (3, R) of length, width and height; NaN, too, where the lists have no such field, and where another true object is
    so near that the entry may be about either. `class_ix`, `existence` and `track_id` as listed. `state_m (R, 2)`: the
    true easting and northing. `fold`: which part of a cross-validation. `apart`: whether no other true object is so
    near; None: of none.
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
        """Some rows, in their order."""
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
    """The entries (E,) about no true object, and duplicates of one: where, when and what they say.

    `list`: index into `FitLists`; `range_m`, `azimuth_rad` from the unit; `nearest_m`: to the centre of the nearest
    true object (inf: none), `nearest_listed`: whether that object has an entry of its own in this list.
    """

    list: Int
    log: Int
    captured_s: Float
    east_m: Float
    north_m: Float
    range_m: Float
    azimuth_rad: Float
    nearest_m: Float
    nearest_listed: Bool
    class_ix: Int
    existence: Float
    track_id: Int
