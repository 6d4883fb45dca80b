"""False tracks: entries about nobody, put together over the lists that hold them.

An entry is *false* if it is of a measured class, in the annotated area, and about nobody by its origin
(`metrics/matching.py`), neither at the instant it tells of nor now: a second entry of somebody is not, nor is one that
was true at its capture. A *false track* is one as the fusion numbers it; entries without a number are linked to the
nearest false track of the lists within `PAUSE_S` before that has its last entry within `NEAR_M`, nearest pairs first.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.compiled import borrowing_kernel
from copem_replay.core.object_list import Entries, ObjectLists, join_entries, take_entries
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, Bool, Float, Int
from copem_replay.metrics.accuracy.aggregator import are_annotated
from copem_replay.metrics.accuracy.statistics import AccuracySettings
from copem_replay.metrics.episodes import Reference
from copem_replay.metrics.matching import GHOST, Matches

if TYPE_CHECKING:
    import pandas as pd

NEAR_M, PAUSE_S = 2.0, 1.0
"""How far apart neighbouring entries of a false track are at most, and for how long no list has one."""


class FalseTracks:
    """Collects the false entries of a configuration's lists, time chunk after time chunk.

    `issue_s (K,)`: when its lists of the whole log are available. `reference`: where the ego is then, if it is there.
    `measured_class (C,)`: whether entries of the class count.
    """

    def __init__(
        self, issue_s: Float, reference: Reference, measured_class: Bool, settings: AccuracySettings, max_age_s: float,
        units: tuple[str, ...],
    ) -> None:  # fmt: skip
        self._issue_s, self._reference, self._measured_class = issue_s, reference, measured_class
        self._settings, self._max_age_s, self._units = settings, max_age_s, units
        self._parts = list[tuple[Entries, Int, Int, Int]]()
        self._added = self._of_runs = 0

    def add(self, lists: ObjectLists, matches: Matches, now: Matches) -> None:
        """Add the next lists; their false entries, by the matches at the instants told of and now, are kept."""
        false = (matches.role == GHOST) & (now.role == GHOST)
        rows = np.flatnonzero(false & self._measured_class[matches.class_ix])
        list_number = np.searchsorted(lists.start.ravel(), rows, side="right") - 1
        run_ix, list_ix = np.divmod(list_number, lists.start.shape[1])
        list_ix += self._added
        entries = take_entries(lists.entries, rows)
        keep = are_annotated(entries["x_m"], entries["y_m"], list_ix, self._reference, self._settings)
        keep &= self._reference.present[list_ix]
        parts = entries[keep], matches.class_ix[rows][keep].astype(np.int64), run_ix[keep], list_ix[keep]
        self._parts.append(parts)
        self._added, self._of_runs = self._added + lists.start.shape[1] - 1, len(lists.start)

    def result(self, runs: int) -> pd.DataFrame:
        """The false tracks of all lists in `runs` runs, as `find_false_tracks`; where lists are of one, it is each."""
        import pandas as pd

        entries = join_entries([part[0] for part in self._parts])
        class_ix, run_ix, list_ix = (np.concatenate([part[k] for part in self._parts]) for k in (1, 2, 3))
        found = find_false_tracks(
            entries, class_ix, run_ix, list_ix, self._issue_s, self._max_age_s, self._units
        )  # fmt: skip
        return found if self._of_runs == runs else pd.concat([found.assign(run=run) for run in range(runs)])


SORTED = ("run", "begins_s", "x_m", "y_m")
"""The columns by which rows are in order."""


def find_false_tracks(
    entries: Entries, class_ix: Int, run_ix: Int, list_ix: Int, issue_s: Float, max_age_s: float, units: tuple[str, ...]
) -> pd.DataFrame:
    """A row per false track, in the order of `SORTED`, from false entries (N,) of lists; `issue_s (K,)`: when these are
    available.

    `run`; `begins_s`, `lasts_s`: while a list holds it, a list at most `max_age_s`; `entries`: how many; `units`: whose
    contribution arrived first, of most entries first, null: not stated; `object_class`, `x_m`, `y_m` of its first
    entry, `to_x_m`, `to_y_m` of its last; `track_id`: null, where there is none; `existence`: the highest.
    """
    import pandas as pd

    order = np.lexsort((entries["y_m"], entries["x_m"], list_ix, run_ix))
    entries, class_ix, run_ix, list_ix = entries[order], class_ix[order], run_ix[order], list_ix[order]
    number = np.full(len(order), -1)
    loose = np.flatnonzero(entries["track_id"] < 0)
    linked = np.full(len(loose), -1)
    x_m, y_m = (np.ascontiguousarray(entries[name][loose]) for name in ("x_m", "y_m"))
    _link_entries(run_ix[loose], list_ix[loose], issue_s[list_ix[loose]], x_m, y_m, linked, np.empty(len(loose), int))
    number[loose] = -1 - linked
    named = entries["track_id"] >= 0
    number[named] = entries["track_id"][named]
    track, (first, last) = _group_rows(run_ix, number)
    ends_s = np.minimum(np.append(issue_s[1:], np.inf), issue_s + max_age_s)
    existence = np.full(len(first), -np.inf)
    np.maximum.at(existence, track, entries["existence"])
    table = pd.DataFrame({
        "run": run_ix[first],
        "begins_s": issue_s[list_ix[first]],
        "lasts_s": ends_s[list_ix[last]] - issue_s[list_ix[first]],
        "entries": np.bincount(track, minlength=len(first)),
        "units": _name_units(track, entries["unit_ix"], units, len(first)),
        "object_class": np.array(CLASSES, dtype=object)[class_ix[first]],
        "track_id": [str(k) if k >= 0 else None for k in entries["track_id"][first].tolist()],
        "existence": existence,
        **{name: entries[name][first] for name in ("x_m", "y_m")},
        **{f"to_{name}": entries[name][last] for name in ("x_m", "y_m")},
    })  # fmt: skip
    return table.sort_values(list(SORTED), kind="stable", ignore_index=True)


LISTED = 5
"""Most false tracks told in words."""


def describe_false_tracks(rows: pd.DataFrame) -> str:
    """The false tracks of a configuration in one run in words, the longest first, at most `LISTED`; `none`."""
    import pandas as pd

    ranked = rows.iloc[np.lexsort((rows["begins_s"], -rows["lasts_s"].round(6)))]  # rounding decides nothing
    parts = [
        f"{row.object_class} at ({row.x_m:.0f}, {row.y_m:.0f}) m from {row.begins_s:.1f} s on for {row.lasts_s:.2f} s"
        + ("" if pd.isna(row.units) else f", by {row.units}")
        for row in ranked[:LISTED].itertuples()
    ]
    more = [f"and {len(rows) - LISTED} more"] if len(rows) > LISTED else []
    return "; ".join([*parts, *more]) or "none"


def _group_rows(run_ix: Int, number: Int) -> tuple[Int, tuple[Int, Int]]:
    """(N,) the track of each row, by run and number, and the first and the last row of each."""
    names, track = np.unique(np.stack([run_ix, number], axis=1), axis=0, return_inverse=True)
    track = track.ravel()
    last = np.zeros(len(names), dtype=np.int64)
    np.maximum.at(last, track, np.arange(len(track)))
    first = np.full(len(names), len(track))
    np.minimum.at(first, track, np.arange(len(track)))
    return track, (first, last)


def _name_units(track: Int, unit_ix: Int, units: tuple[str, ...], tracks: int) -> list[str | None]:
    pairs, counts = np.unique(np.stack([track, unit_ix], axis=1), axis=0, return_counts=True)
    names: list[list[str]] = [[] for _ in range(tracks)]
    for k in np.lexsort((pairs[:, 1], -counts, pairs[:, 0])).tolist():
        if pairs[k, 1] >= 0:
            names[pairs[k, 0]].append(units[pairs[k, 1]])
    return [", ".join(of) or None for of in names]


@borrowing_kernel
def _link_entries(run_ix: Int, list_ix: Int, time_s: Float, x_m: Float, y_m: Float, number: Int, newest: Int) -> None:
    """Fills `number (N,)`: the track of each entry, by run and list, nearest pairs first. `newest`: scratch."""
    n_tracks, oldest, first = 0, 0, 0
    while first < len(run_ix):
        after = first
        while after < len(run_ix) and run_ix[after] == run_ix[first] and list_ix[after] == list_ix[first]:
            after += 1
        while oldest < n_tracks and (
            run_ix[newest[oldest]] != run_ix[first] or time_s[first] - time_s[newest[oldest]] > PAUSE_S + SAME_INSTANT_S
        ):
            oldest += 1
        nearest_entry, nearest_track = first, 0
        while nearest_entry >= 0:
            least_square, nearest_entry = NEAR_M * NEAR_M + 1e-9, -1
            for i in range(first, after):
                for t in range(oldest, n_tracks):
                    j = newest[t]
                    too_late = time_s[first] - time_s[j] > PAUSE_S + SAME_INSTANT_S
                    if number[i] >= 0 or j >= first or run_ix[j] != run_ix[i] or too_late:
                        continue
                    square = (x_m[i] - x_m[j]) ** 2 + (y_m[i] - y_m[j]) ** 2
                    if square < least_square:
                        least_square, nearest_entry, nearest_track = square, i, t
            if nearest_entry >= 0:
                number[nearest_entry], newest[nearest_track] = nearest_track, nearest_entry
        for i in range(first, after):
            if number[i] < 0:
                number[i], newest[n_tracks] = n_tracks, i
                n_tracks += 1
        first = after
