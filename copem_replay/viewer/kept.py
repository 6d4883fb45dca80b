"""Fused tracks of a few objects over all of a log, however long: their rows of every time chunk, joined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.object_list import Entries
from copem_replay.core.tracks import Bool, Int, Tracks, spliced


@dataclass
class _Pieces:
    """Of one configuration, by time chunk: rows of units' lists (P,) with their keys, fused rows (R,), their sources.

    `made_of`: keys of the entries of each fused row, `count (R,)` how many there are.
    """

    heard: list[Tracks] = field(default_factory=list)
    keys: list[Int] = field(default_factory=list)
    fused: list[Tracks] = field(default_factory=list)
    made_of: list[Int] = field(default_factory=list)
    count: list[Int] = field(default_factory=list)
    said: list[Entries] = field(default_factory=list)


class Kept:
    """Fused tracks of one run, of some objects only, taken in chunk by chunk, in order of time; values (1, P)."""

    def __init__(self, object_ix: Sequence[int]) -> None:
        self.object_ix = np.array(object_ix, dtype=np.int64)
        self._pieces: dict[str, _Pieces] = {}

    def add(self, run_tracks: Mapping[str, FusedTracks]) -> None:
        """The next time chunk's fused tracks, by configuration; they need not be kept otherwise."""
        for name, fused_tracks in run_tracks.items():
            pieces = self._pieces.setdefault(name, _Pieces())
            self._add_heard(pieces, fused_tracks.heard)
            rows = np.flatnonzero(self._wanted(fused_tracks.fused))
            count = np.diff(fused_tracks.start)[rows]
            within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
            entries = fused_tracks.entries[np.repeat(fused_tracks.start[rows], count) + within]
            pieces.fused.append(fused_tracks.fused.take_rows(rows))
            pieces.made_of.append(self._key(fused_tracks.heard)[entries])
            pieces.count.append(count)
            if fused_tracks.said is not None:
                pieces.said.append(fused_tracks.said[rows])

    def whole(self) -> dict[str, FusedTracks]:
        """Of all time chunks, as of one. How rows look from their units is not kept."""
        return {name: _joined(pieces) for name, pieces in self._pieces.items()}

    def _add_heard(self, pieces: _Pieces, heard: Tracks) -> None:
        """Rows that no time chunk before has had: what has been captured before a time chunk may be in it once more."""
        wanted, key = self._wanted(heard), self._key(heard)
        before = np.concatenate([np.empty(0, dtype=np.int64), *pieces.keys])
        fresh = np.flatnonzero(wanted & ~np.isin(key, before))
        taken = heard.take_rows(fresh)
        if pieces.heard:  # the lists are those of all the log in every time chunk: they are kept once
            first = pieces.heard[0]
            lists = ("stamp_ns", "captured_s", "frame_unit_ix", "arrives_s")
            taken = replace(taken, **{column: getattr(first, column) for column in lists})
        pieces.heard.append(taken)
        pieces.keys.append(key[fresh])

    def _wanted(self, tracks: Tracks) -> Bool:
        return np.asarray(np.isin(tracks.row_object_ix, self.object_ix))

    @staticmethod
    def _key(tracks: Tracks) -> Int:
        """(P,) a number for the list and object of each row that has one."""
        return tracks.row_object_ix * len(tracks.stamp_ns) + tracks.frame_ix


def _joined(pieces: _Pieces) -> FusedTracks:
    heard, order = spliced(pieces.heard)
    keys = np.concatenate(pieces.keys)[order]
    fused, order = _one_after_another(pieces.fused)
    count = np.concatenate(pieces.count)
    begin = np.cumsum(count) - count
    start = np.concatenate([[0], np.cumsum(count[order])])
    within = np.arange(start[-1]) - np.repeat(start[:-1], count[order])
    made_of = np.concatenate(pieces.made_of)[np.repeat(begin[order], count[order]) + within]
    by_key = np.argsort(keys, kind="stable")
    entries = by_key[np.searchsorted(keys[by_key], made_of)]
    said = np.concatenate(pieces.said)[order] if pieces.said else None
    return FusedTracks(fused, heard, entries, start, said=said)


def _one_after_another(fused: Sequence[Tracks]) -> tuple[Tracks, Int]:
    """Lists of time chunks as the lists of one, and where its rows come from, as of `spliced`."""
    frames: dict[str, Any] = {
        name: np.concatenate([getattr(piece, name) for piece in fused], axis=-1)
        for name in ("stamp_ns", "captured_s", "frame_unit_ix", "arrives_s")
    }
    before = np.cumsum([0, *(len(piece.stamp_ns) for piece in fused)])
    return spliced([replace(piece, frame_ix=piece.frame_ix + before[k], **frames) for k, piece in enumerate(fused)])
