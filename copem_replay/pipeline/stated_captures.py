"""Stated captures: what fusions are told of when lists were captured, where units' clocks are off.

The engine itself goes by the true captures: a list's age, which of a unit's lists is its newest, when it arrives, and
whether an entry was captured since the onset. Of which instant an entry tells is what is stated: a clock error is an
error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.object_list import ObjectLists
from copem_replay.core.tracks import SAME_INSTANT_NS, Float, Int, Scene, Tracks
from copem_replay.perception.clock import clock_errors_s

if TYPE_CHECKING:
    from copem_replay.pipeline.expansion import ExpandedExperiment

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


@dataclass(frozen=True)
class StatedCaptures:
    """The lists (F,) of one run as their units state them, and as they are. Seconds since the log's start."""

    stated_s: Float
    captured_s: Float
    arrives_s: Float

    @property
    def ahead_s(self) -> float:
        """How far a stated capture is ahead of the true one, at most; 0 where none is."""
        return float((self.stated_s - self.captured_s).max(initial=0.0))

    def captured_between_s(self, stated_s: Float) -> tuple[Float, Float]:
        """The earliest and the latest true capture (K,) of the lists that state each instant (K,), one at least."""
        order = np.lexsort((self.captured_s, self.stated_s))
        first, after = (np.searchsorted(self.stated_s[order], stated_s, side=side) for side in ("left", "right"))
        captured_s = self.captured_s[order]
        return captured_s[first], captured_s[after - 1]

    def as_told(self, lists: ObjectLists) -> ObjectLists:
        """The units' lists, one run of F, with stated captures."""
        entries = lists.entries.copy()
        entries["captured_s"] = np.repeat(self.stated_s, np.diff(lists.start[0]))
        return replace(lists, entries=entries)

    def true_lists(self, fused: ObjectLists, issue_s: Float) -> ObjectLists:
        """Fused lists, one run of K available at `issue_s`, whose entries go back to true captures."""
        entries = fused.entries.copy()
        entries["captured_s"] = self._true_s(entries["captured_s"], np.repeat(issue_s, np.diff(fused.start[0])))
        return replace(fused, entries=entries)

    def _true_s(self, told_s: Float, issue_s: Float) -> Float:
        """The true captures (N,) of entries that tell of stated ones: of those that had arrived, the last.

        An entry that tells of no list's stated capture is taken at its word.
        """
        order = np.lexsort((self.captured_s, self.stated_s))
        stated_s, arrives_s = self.stated_s[order], self.arrives_s[order]
        at: Int = np.searchsorted(stated_s, told_s + _TOLERANCE_S, side="right") - 1
        while True:
            there = (at >= 0) & (stated_s[np.maximum(at, 0)] >= told_s - _TOLERANCE_S)
            early = there & (arrives_s[np.maximum(at, 0)] > issue_s + _TOLERANCE_S)
            if not early.any():
                return np.where(there, self.captured_s[order][np.maximum(at, 0)], told_s)
            at = np.where(early, at - 1, at)


def stated_captures(scene: Scene, heard: Tracks, experiment: ExpandedExperiment, run: int) -> StatedCaptures | None:
    """What a receiver is told of the captures of the lists it hears, none after its arrival; None: the truth."""
    error_s = clock_errors_s(scene, heard.units, experiment, heard.captured_s, heard.frame_unit_ix, run)
    if error_s is None:
        return None
    arrives_s = heard.common_arrives_s
    return StatedCaptures(np.minimum(heard.captured_s + error_s, arrives_s), heard.captured_s, arrives_s)
