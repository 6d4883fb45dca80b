"""Fused tracks of the receiver, in one run or several: for files, for display, and for perceived conflicts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from copem_replay.core.compiled import borrowing, borrowing_kernel
from copem_replay.core.object_list import Entries, most_probable_classes
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, VALUES, Bool, Float, Int, Scene, Tracks, UnitFaults
from copem_replay.core.view_geometry import ViewGeometry

if TYPE_CHECKING:
    import pandas as pd


class EntrySources(NamedTuple):
    """Entries of units' lists, `valid (S, P)` and else (P,), and the entries of each fused row: see FusedTracks."""

    valid: Bool
    captured_s: Float
    arrives_s: Float
    unit_ix: Int
    entries: Int
    start: Int


@dataclass(frozen=True)
class FusedTracks:
    """The fused lists as tracks, and the entries of the units' lists that each fused row (P,) is made of.

    Fusions without truth ids give the rows alone: `said` (P,) then holds the entries of the fusion, in one run, and
    `object_ix` of a track the true object it is matched with, −1: none. `stated_s` (P,): captures as units state them.

    >>> fused = cr.fused_tracks("logs/tc016d.yaml", "logs/tc016d.mcap")["PEM"]
    >>> fused.fused.valid.sum() == len(fused.to_dataframe())
    np.True_
    """

    fused: Tracks
    received: Tracks
    entries: Int  # (C,) rows of `received`, those that were not detected too
    start: Int  # (P + 1,) where the entries of each fused row begin
    view: ViewGeometry | None = None  # how the rows of `received` look from their units; the truth needs none
    said: Entries | None = None
    scene: Scene | None = None  # of the log, where rows are to be named
    faults: UnitFaults | None = None  # of `received`, in one run: where a unit has outages or ghosts
    stated_s: Float | None = None  # None: the captures that are stated are the true ones
    second_of: Int | None = None  # (P,) the object that each row is a second entry of, −1: none; None: no row is
    left_out: Bool | None = None  # (R,) rows of `received` that units list and do not send; None: they send all
    by_link: Bool | None = None  # (F,) lists of `received` that units send by a link, in one run; None: there is none

    def to_dataframe(self) -> pd.DataFrame:
        """The entries of all lists of one run, in the order of the lists.

        `available_s`: when the receiver has the list. `captured_s`: the newest capture that contributed. `object_id`:
        the true object, null without a match; `track_id`: of the fusion, −1: none. `object_class`: as `class_of`. State
        and covariance as in `Tracks`; `existence`: null where not said. Raises ValueError for several runs, or without
        a scene to name objects by.
        """
        import pandas as pd

        if self.scene is None or len(self.fused.valid) != 1:
            raise ValueError("to_dataframe: expected the tracks of one run, with their scene")
        order = self.fused.by_frame[0]
        rows = order[self.fused.valid[0, order]]
        ids = np.array([*self.scene.object_ids, None], dtype=object)  # −1 is the last
        entries = self.said
        columns: dict[str, object] = {
            "available_s": self.fused.common_arrives_s[self.fused.frame_ix[rows]],
            "captured_s": self.captured_s[0, rows],
            "object_id": ids[self.fused.row_object_ix[rows]],
            "track_id": np.full(len(rows), -1) if entries is None else entries["track_id"][rows],
            "object_class": np.array(CLASSES, dtype=object)[self.class_of(self.scene)[rows]],
            "existence": np.full(len(rows), np.nan) if entries is None else entries["existence"][rows],
        }
        for name in (*VALUES, "cov_ee_m2", "cov_en_m2", "cov_nn_m2"):
            values = getattr(self.fused, name)
            columns[name] = np.zeros(len(rows)) if values is None else values[0, rows]
        return pd.DataFrame(columns)

    def arriving(self, received: Tracks, issue_s: Float) -> FusedTracks:
        """These tracks of lists `received` at other times; `issue_s (F,)`: when fused lists are available."""
        return replace(self, received=received, fused=replace(self.fused, arrives_s=issue_s[None]))

    @cached_property
    def used(self) -> Int:
        """The entries that were detected, (C',) rows of `received`, grouped by `used_start`."""
        detected: Bool = self.received.valid[0, self.entries]
        return self.entries[detected]

    @cached_property
    def used_start(self) -> Int:
        """(P + 1,) where the detected entries of each fused row begin."""
        before: Int = np.concatenate([[0], np.cumsum(self.received.valid[0, self.entries])])
        starts: Int = before[self.start]
        return starts

    @cached_property
    def captured_s(self) -> Float:
        """(S, P) the newest capture that contributed to each row, −inf where none did."""
        if self.said is not None:
            return np.asarray(self.said["captured_s"], dtype=np.float64)[None]
        return self._newest_and_first[0]

    @cached_property
    def first_unit_ix(self) -> Int:
        """(S, P) the unit of each row whose contribution arrived first; −1: none, or not stated."""
        if self.said is not None:
            return np.asarray(self.said["unit_ix"], dtype=np.int64)[None]
        return self._newest_and_first[1]

    @cached_property
    def _newest_and_first(self) -> tuple[Float, Int]:
        newest_s, first = np.empty(self.fused.valid.shape), np.empty(self.fused.valid.shape, dtype=np.int64)
        _find_of_each_row(self.sources, newest_s, first)
        return newest_s, first

    @property
    def sources(self) -> EntrySources:
        """The entries of each row as arrays, for compiled code."""
        received = self.received
        arrives_s = received.common_arrives_s[received.frame_ix]
        return EntrySources(
            received.valid, received.entry_captured_s, arrives_s, received.row_unit_ix, self.entries, self.start
        )

    @cached_property
    def _place(self) -> Int:
        """(P,) places of rows in their lists."""
        order, bounds = self.fused.by_frame
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order)) - np.repeat(bounds[:-1], np.diff(bounds))
        return place

    def names_of(self, scene: Scene) -> tuple[list[str], Int]:
        """Names, and (P,) the index of each row's name.

        The id of the object a row is about, else the fusion's own identity for it, else its place in its list.
        """
        name_ix = self.fused.row_object_ix.copy()
        unknown = np.flatnonzero(name_ix < 0)
        track_id = np.full(len(unknown), -1) if self.said is None else self.said["track_id"][unknown]
        tracks, track = np.unique(track_id[track_id >= 0], return_inverse=True)
        name_ix[unknown] = len(scene.object_ids) + len(tracks) + self._place[unknown]
        name_ix[unknown[track_id >= 0]] = len(scene.object_ids) + track
        longest = int(np.diff(self.fused.by_frame[1]).max(initial=0))
        names = (*scene.object_ids, *(f"track:{t}" for t in tracks), *(f"entry:{k}" for k in range(longest)))
        return list(names), name_ix

    def class_of(self, scene: Scene) -> Int:
        """(P,) index into CLASSES: the true class, or the most probable one by the fusion."""
        if self.said is not None:
            likely: Int = most_probable_classes(np.ascontiguousarray(self.said["class_probability"]))
            return likely
        classes: Int = scene.object_class[self.fused.row_object_ix].astype(np.int64)
        return classes

    @cached_property
    def listed_rows(self) -> tuple[Int, Int]:
        """Rows of `fused` in the first run's lists, list by list, and where each list begins, (F + 1,)."""
        order, bounds = self.fused.by_frame
        valid = self.fused.valid[0, order]
        return order[valid], np.concatenate([[0], np.cumsum(valid)])[bounds]

    def listed(self, frame: int) -> list[int]:
        """Rows of `fused` that are in list `frame` of the first run."""
        rows, bounds = self.listed_rows
        result: list[int] = rows[bounds[frame] : bounds[frame + 1]].tolist()
        return result


@borrowing
def find_newest_and_first(sources: EntrySources, s: int, p: int) -> tuple[float, int]:
    """Of row p in run s the newest capture, −inf: none, and the unit whose list arrived first, −1: none."""
    newest_s, first, best_s = -np.inf, -1, np.inf
    for c in range(sources.start[p], sources.start[p + 1]):
        entry = sources.entries[c]
        if sources.valid[s, entry]:
            newest_s = max(newest_s, sources.captured_s[entry])
            # Entries are in the order of units: of those that arrive together (within 1 µs) the first stays.
            if sources.arrives_s[entry] < best_s - SAME_INSTANT_S:
                best_s, first = sources.arrives_s[entry], sources.unit_ix[entry]
    return newest_s, first


@borrowing_kernel
def _find_of_each_row(sources: EntrySources, newest_s: Float, first: Int) -> None:
    """Fill `newest_s (S, P)` and `first (S, P)` with what `find_newest_and_first` gives of each row."""
    for s in range(newest_s.shape[0]):
        for p in range(newest_s.shape[1]):
            newest_s[s, p], first[s, p] = find_newest_and_first(sources, s, p)
