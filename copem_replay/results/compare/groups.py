"""Comparisons of groups: pairs of configurations over the episodes of a group alone (`metrics/slices.py`).

Groups are found in the tally of the first folder, whose logs, objects and episodes all folders have in common. The
ghosts at equal rates and the horizon are those of all groups. False positives belong to no episode: they are compared
where groups are of whole logs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import Bool
from copem_replay.metrics.config import BEGAN_BY, Slice
from copem_replay.metrics.limits import CONFIDENCE, TRAFFIC
from copem_replay.metrics.slices import number_groups
from copem_replay.metrics.summary import EPISODE
from copem_replay.results.compare.limits import STAR
from copem_replay.results.slices import read_slices

if TYPE_CHECKING:
    from copem_replay.results.compare.pairing import PairingGrid, PairSide
    from copem_replay.results.read import Results


class EpisodeGroups:
    """The groups that the entries of `by` make of the episodes of results, each with its entry and its label.

    Raises InputError for an entry that is none.
    """

    def __init__(self, results: Results, entries: Sequence[str]) -> None:
        self.named: list[tuple[Slice, str]] = []  # of each group what it is by, and its values
        self._groups_of: dict[tuple[str, str, int], list[int]] = {}  # by log, object, episode
        if not entries:
            return
        tags = {log.name: log.tags for log in results.provenance.logs}
        episodes = results.tally.drop_duplicates([*EPISODE])
        keys = list(zip(*(episodes[name].tolist() for name in EPISODE), strict=True))
        for entry in read_slices(results, entries):
            number, names = number_groups(episodes, entry, tags)
            for key, k in zip(keys, (number + len(self.named)).tolist(), strict=True):
                self._groups_of.setdefault(key, []).append(k)
            self.named += [(entry, ", ".join(values)) for values in names]

    def select(self, log: str, grid: PairingGrid) -> Iterator[tuple[int, Bool]]:
        """The numbers of the groups with episodes of a log, and a mask (N·S,) of the cells of each."""
        of_episodes = [self._groups_of.get((log, *episode), []) for episode in grid.episodes]
        for k in sorted({k for of in of_episodes for k in of}):
            yield k, np.repeat([k in of for of in of_episodes], grid.runs)

    def restrict(self, k: int, in_group: Bool, side: PairSide) -> PairSide:
        """A side of a pair with only the cells of a group; by `began` each group counts its own episodes."""
        entry, counted = self.named[k][0], side.counted
        if entry.names(BEGAN_BY):
            counted = side.counted_however_begun
        lists = side.lists if entry.of_logs else None
        return replace(side, there=side.there & in_group, counted=counted & in_group, lists=lists)


def without_limits_over_runs(row: dict[str, object]) -> dict[str, object]:
    """The row of a comparison without limits, if these are over the runs of one object, which say nothing on groups."""
    if row.get("interval_over") in TRAFFIC:
        return row
    return {name: value for name, value in row.items() if name not in _LIMITS}


_LIMITS = ("low", "high", "low_bounded", "high_bounded", "interval", "interval_over", "clusters")


def describe_group_chance(table: pd.DataFrame) -> list[str]:
    """One line per entry: numbers of groups, of differences, of intervals that exclude 0, and of those by chance."""
    lines = []
    for entry, rows in table.groupby("by", sort=False):
        limited = rows[rows["interval_over"].notna()]
        off_zero = int(limited["star"].notna().sum())
        lines.append(
            f"by {entry}: {count_noun(rows['group'].nunique(), 'group')} looked at; of "
            f"{count_noun(len(limited), 'interval')} {off_zero} exclude 0, by chance alone at least "
            f"{(1 - CONFIDENCE) * len(limited):.2g} would; {int((limited['star'] == STAR).sum())} with a {STAR}, all "
            "groups held at 95 % together"
        )
    return lines
