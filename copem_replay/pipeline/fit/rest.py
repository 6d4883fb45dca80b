"""The other errors of a unit: its pose, classes, existence, ghosts, ids, and when it makes no lists."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from copem_replay.pipeline.fit.confusion import ClassesFit, fit_classes
from copem_replay.pipeline.fit.durations import lasting_time
from copem_replay.pipeline.fit.errors import series_of
from copem_replay.pipeline.fit.estimate import Estimate, Note, digits, plain
from copem_replay.pipeline.fit.existence import ExistenceFit, fit_existence
from copem_replay.pipeline.fit.false_positives import GhostsFit, fit_ghosts
from copem_replay.pipeline.fit.list_times import ListTimesFit, fit_list_times
from copem_replay.pipeline.fit.pose import PoseFit, fit_pose
from copem_replay.pipeline.fit.rows import FitLists, FitRows, OtherEntries


@dataclass(frozen=True)
class RestFit:
    """Each with intervals, or in `untold` why nothing is told. `ids_last_s`: None where lists have no ids."""

    placed: PoseFit
    classes: ClassesFit
    existence: ExistenceFit
    ghosts: GhostsFit
    ids_last_s: Estimate | None
    list_times: ListTimesFit
    untold: dict[str, str]

    def pem_keys(self, note: Note = plain) -> dict[str, Any]:
        """Keys of a PEM beside its couples: `classes`, `ghosts`, `tracks`, and `memory` of the class."""
        ids, lasting = self.ids_last_s, [part.keys(note) for part in self.classes.memory]
        out: dict[str, Any] = {
            "classes": self.classes.keys(note),
            "ghosts": [sort.keys(note) for sort in self.ghosts.sorts],
            "tracks": {} if ids is None or ids.why is not None else {"lasts_s": note(digits(ids.value), ids.words())},
            "memory": {"class": lasting} if lasting else {},
        }
        return {key: value for key, value in out.items() if value}

    def couple_keys(self, note: Note = plain) -> dict[str, Any]:
        """Keys of each couple: `existence`."""
        claimed = self.existence.keys(note)
        return {} if claimed is None else {"existence": claimed}

    def unit_keys(self, note: Note = plain) -> dict[str, Any]:
        """Keys of the unit: `placed`, `outages`."""
        out = {"placed": self.placed.keys(note), "outages": self.list_times.keys(note)}
        return {key: value for key, value in out.items() if value}


def fit_rest(rows: FitRows, lists: FitLists, other: OtherEntries, *, truth: Literal["complete", "partial"]) -> RestFit:
    """Fit all of it. Ghosts, and how sure the unit is of them, only where the truth is `complete`."""
    listed = rows.take(rows.listed & np.isfinite(rows.along_m))
    series, complete = series_of(listed), truth == "complete"
    placed = fit_pose(listed, lists)
    classes = fit_classes(listed, series)
    existence = fit_existence(listed.existence, listed.pass_ix, other.existence if complete else None)
    partial = GhostsFit(untold="the truth is partial: entries about no true object may be other traffic")
    ghosts = fit_ghosts(rows, lists, other) if complete else partial
    ids = _ids(listed)
    times = fit_list_times(lists)
    told = {
        "placed": placed.untold, "classes": classes.untold, "existence": existence.untold, "ghosts": ghosts.untold,
        "tracks": "the lists have no track ids" if ids is None else ids.why, "outages": times.down_share.why,
    }  # fmt: skip
    untold = {name: why for name, why in told.items() if why is not None}
    return RestFit(placed, classes, existence, ghosts, ids, times, untold)


def _ids(rows: FitRows) -> Estimate | None:
    """The mean time between switches of the id, in passes."""
    some = rows.take(rows.track_id >= 0)
    if len(some.log) < 2:
        return None
    on = np.diff(some.pass_ix) == 0
    gap_s, switched = np.diff(some.captured_s)[on], np.diff(some.track_id)[on] != 0
    return lasting_time(gap_s[~switched], gap_s[switched], "switch of an id")
