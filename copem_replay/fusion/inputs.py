"""From tracks with truth ids to lists without: what a real fusion sees of what the units heard in each run.

Nothing in a report tells which entries are of one object: the order within each list is drawn. The receiver's own body
is left out, since it knows where it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numba as nb
import numpy as np

from copem_replay.communication.arrivals import FusionSchedule, fusion_schedule
from copem_replay.communication.kept import KeptEntries
from copem_replay.core.object_list import COVARIANCES, ENTRY, Entries, Inputs, ObjectLists, joined, taken
from copem_replay.core.tracks import VALUES, Bool, Float, Int, Tracks
from copem_replay.fusion.ideal import floored


@dataclass(frozen=True)
class Claims:
    """What entries say beside their states, row by row. (P,), `class_probability (P, C)`."""

    existence: Float
    class_probability: Float
    track_id: Int


class RowEntries:
    """Rows (P,) of lists in the runs (S,) as entries: what of them is the same in all runs is made once."""

    def __init__(self, seen: Tracks, claims: Claims) -> None:
        self._columns = {name: getattr(seen, name) for name in VALUES}
        self._columns |= zip(COVARIANCES, floored(seen), strict=True)
        self._template = _template(seen, claims, self._columns)

    def lists(self, seen: Tracks, drawn: Float, s: int | None = None, *, without_object_ix: int) -> ObjectLists:
        """The lists of all runs, or of run s alone: `seen` and `drawn` are of that, too. `drawn` orders entries."""
        start, picked = listed_rows(seen, drawn, without_object_ix=without_object_ix)
        entries = taken(self._template, picked)
        run = np.repeat(np.arange(len(start)) if s is None else s, start[:, -1] - start[:, 0])
        for name, values in self._columns.items():
            if len(values) > 1:
                entries[name] = values[run, picked]
        return ObjectLists(start, entries)


def listed_rows(heard: Tracks, drawn: Float, *, without_object_ix: int) -> tuple[Int, Int]:
    """Where each of these lists begins, (S, F + 1), and the row of each entry, (N,)."""
    valid = heard.valid if without_object_ix < 0 else heard.valid & (heard.row_object_ix != without_object_ix)
    order, bounds = heard.by_frame
    start = np.zeros((len(valid), len(bounds)), dtype=np.int64)
    picked = np.empty(int(valid.sum()), dtype=np.int64)
    _pick(valid, drawn, order, bounds, start, picked)
    return start, picked


def inputs(
    heard: Tracks,
    lists: ObjectLists,
    *,
    max_age_s: float,
    at: FusionSchedule | None = None,
    captured_s: Float | None = None,
) -> Inputs:
    """The same lists as one configuration's receiver has them: when each arrives, and which it goes by when.

    `at`: some of the instants. `captured_s (F,)`: when they were captured, as fusion is told; None: the truth.
    """
    at = at or fusion_schedule(heard, max_age_s=max_age_s)
    captured_s = heard.captured_s if captured_s is None else captured_s
    return Inputs(
        heard.units, heard.frame_unit_ix, captured_s, heard.common_arrives_s, lists,
        at.issue_s, at.newest, at.arrived, at.arrived_start,
    )  # fmt: skip


def with_kept(told: Inputs, kept: KeptEntries, partial: Bool, max_age_s: float) -> Inputs:
    """The same in one run with what the receiver has of units (U,) whose messages are `partial`, for `max_age_s`."""
    lists, frame = told.lists, kept.frame
    start = np.concatenate([lists.start[0], lists.start[0, -1] + kept.start[1:]])[None]
    return replace(
        told,
        unit_ix=np.append(told.unit_ix, told.unit_ix[frame]),
        captured_s=np.append(told.captured_s, told.captured_s[frame]),
        arrives_s=np.append(told.arrives_s, told.arrives_s[frame]),
        lists=ObjectLists(start, joined([lists.entries, taken(lists.entries, kept.entry)])),
        newest=kept.newest,
        keeps_s=np.where(partial, max_age_s, 0.0),
    )


def _template(heard: Tracks, claims: Claims, columns: Mapping[str, Float]) -> Entries:
    """(P,) all that is the same in all runs."""
    entries = np.zeros(len(heard.frame_ix), dtype=ENTRY)
    for name, values in columns.items():
        if len(values) == 1:
            entries[name] = values[0]
    entries["existence"], entries["class_probability"] = claims.existence, claims.class_probability
    entries["track_id"] = claims.track_id
    entries["captured_s"], entries["unit_ix"] = heard.row_captured_s, heard.row_unit_ix
    return entries


@nb.njit(cache=True, nogil=True)
def _pick(valid: Bool, drawn: Float, order: Int, bounds: Int, start: Int, picked: Int) -> None:
    n = 0
    for s in range(valid.shape[0]):
        start[s, 0] = n
        for f in range(len(bounds) - 1):
            first = n
            for k in range(bounds[f], bounds[f + 1]):
                p = order[k]
                if not valid[s, p]:
                    continue
                at = n  # insertion by the number drawn
                while at > first and drawn[s, picked[at - 1]] > drawn[s, p]:
                    picked[at] = picked[at - 1]
                    at -= 1
                picked[at] = p
                n += 1
            start[s, f + 1] = n
