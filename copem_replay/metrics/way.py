"""The way of a detection: its first listing, and when the list that made the object known was sent and arrived."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS, Float, Int, Tracks

if TYPE_CHECKING:
    from copem_replay.metrics.detection.by_truth_id import Detections
    from copem_replay.metrics.episodes import Episodes

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class Way:
    """(S | 1, M) each, NaN: there is none. The list is that of the newest capture that contributed to knowing.

    `listed_s`: capture of the first list of any unit that has the object, whether it was sent and arrived or not.
    """

    listed_s: Float
    sent_s: Float
    arrived_s: Float


WAY = tuple(Way.__dataclass_fields__)
"""Columns of `detections.parquet`, its last, where a configuration has a link or units with `ready` or `sends`."""


def first_listed_s(seen: Tracks, found: Episodes, units: Collection[str], *, count_earlier: bool) -> Float:
    """(S, M) capture of the first list of some units that has the object of each episode; NaN: none."""
    episode_of = np.full(int(max(found.object_ix.max(initial=-1), seen.object_ix.max(initial=-1))) + 2, -1)
    episode_of[found.object_ix] = np.arange(len(found.object_ix))
    episode, captured_s = episode_of[seen.row_object_ix], seen.row_captured_s
    mine = np.array([name in units for name in seen.units], dtype=bool)[seen.row_unit_ix]
    rows = np.flatnonzero(mine & (episode >= 0) & np.isfinite(seen.common_arrives_s)[seen.frame_ix])
    during = captured_s[rows] <= found.ended_s[episode[rows]] + _TOLERANCE_S
    rows = rows[during & (count_earlier | (captured_s[rows] >= found.onset_s[episode[rows]] - _TOLERANCE_S))]
    first_s = np.full((len(seen.valid), len(found.object_ix)), np.inf)
    for s, valid in enumerate(seen.valid):
        listed = rows[valid[rows]]
        np.minimum.at(first_s[s], episode[listed], captured_s[listed])
    return np.where(np.isfinite(first_s), first_s, np.nan)


def list_that_told(heard: Tracks, known: Detections) -> Int:
    """(S | 1, M) which list (F,) made each object known; −1: none.

    Of the lists of that capture the last that the receiver had by then, of several at once that of the first unit.
    """
    told, came_s = np.full(known.detection_s.shape, -1), np.full(known.detection_s.shape, -np.inf)
    arrives_s = heard.common_arrives_s
    for unit_ix in range(len(heard.units)):
        mine = np.flatnonzero((heard.frame_unit_ix == unit_ix) & np.isfinite(arrives_s))
        if not len(mine):
            continue
        mine = mine[np.argsort(heard.captured_s[mine], kind="stable")]
        at = np.searchsorted(heard.captured_s[mine], known.captured_s - _TOLERANCE_S)
        frame = mine[np.minimum(at, len(mine) - 1)]
        fits = np.abs(heard.captured_s[frame] - known.captured_s) <= _TOLERANCE_S
        fits &= arrives_s[frame] <= known.detection_s + _TOLERANCE_S
        later = arrives_s[frame] > came_s + _TOLERANCE_S
        own = (known.first_unit_ix == unit_ix) & (arrives_s[frame] >= came_s - _TOLERANCE_S)
        told = np.where(fits & (later | own), frame, told)
        came_s = np.where(fits & (later | own), arrives_s[frame], came_s)
    return told


def at_list(told: Int, time_s: Float) -> Float:
    """(S | 1, M) of times of lists (F,) those of some lists; NaN where there is none."""
    return np.where(told >= 0, time_s[told] if len(time_s) else np.nan, np.nan)
