"""The output of a stack, handed on as it was recorded: at each instant the list that then became available."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from copem_replay.core.object_list import Entries, Inputs, ObjectLists, TellsOf
from copem_replay.core.tracks import Int
from copem_replay.fusion.base import ListFusion


class AsRecorded(ListFusion):
    """Nothing is fused: the list that arrives at an instant is the fused list. Its states are of their stamp.

    An experiment does not name it: `recorded:` of a configuration stands for it.
    """

    resumable: ClassVar[bool] = True

    kind: Literal["recorded"] = "recorded"

    def fuse(self, inputs: Inputs) -> ObjectLists:
        """Of several lists at one instant the newest; no unit is said to have contributed."""
        which = np.array([_newest(inputs, k) for k in range(len(inputs.issue_s))], dtype=np.int64)
        given = inputs.lists.start
        lengths = (given[:, 1:] - given[:, :-1])[:, which]
        ends = np.cumsum(lengths.ravel()).reshape(lengths.shape)
        start = np.concatenate([np.append(0, ends[:-1, -1:].ravel())[:, None], ends], axis=1)
        first = np.repeat(given[:, :-1][:, which].ravel() - (ends - lengths).ravel(), lengths.ravel())
        entries = inputs.lists.entries[first + np.arange(len(first))]
        entries["unit_ix"] = -1
        _each_track_once(entries, np.repeat(np.arange(lengths.size), lengths.ravel()))
        return ObjectLists(start, entries)


class AsPredicted(AsRecorded):
    """The same of a stack that brings its states to the instant at which its list is available."""

    resumable: ClassVar[bool] = True
    tells_of: ClassVar[TellsOf] = "now"


def _newest(inputs: Inputs, instant: int) -> int:
    """Of the lists that arrive at an instant the one captured last."""
    came = inputs.arrived[inputs.arrived_start[instant] : inputs.arrived_start[instant + 1]]
    return int(came[np.argmax(inputs.captured_s[came])])


def _each_track_once(entries: Entries, of_list: Int) -> None:
    """Of an id that a list has twice it is not known which entry is the track: neither is."""
    tracked = np.flatnonzero(entries["track_id"] >= 0)
    keys = np.stack([of_list[tracked], entries["track_id"][tracked]])
    _, back, count = np.unique(keys, axis=1, return_inverse=True, return_counts=True)
    entries["track_id"][tracked[count[back.ravel()] > 1]] = -1
