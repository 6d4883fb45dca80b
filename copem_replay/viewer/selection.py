"""What is shown of many: which configurations, and of which objects words, lines, lanes and plots tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

SHOWN_OBJECTS = 6
"""Of how many measured objects words, lines, lanes and plots tell (chosen)."""
VIEWED = 6
"""How many configurations a file has: more views than this are too small to see anything (chosen)."""


@dataclass(frozen=True)
class Part:
    """What one file holds of the configurations, and what its name has in addition."""

    configurations: tuple[str, ...]
    infix: str = ""

    def path(self, path: Path) -> Path:
        """The file's own path; `path`: of the first one."""
        return path.with_name(f"{path.stem}{self.infix}{path.suffix}")


def in_parts(configurations: Sequence[str], baseline: str | None = None) -> list[Part]:
    """All configurations, in their order, six a file: `replay.rrd`, `replay.configurations_7-12.rrd` and so on.

    A baseline that the others are held against is in every file; it is the first of them.
    """
    shared = tuple(name for name in configurations if name == baseline)
    others = [name for name in configurations if name != baseline]
    each = VIEWED - len(shared)
    parts = [Part((*shared, *others[:each]) if shared else tuple(others[:each]))]
    for first in range(each, len(others), each):
        mine = others[first : first + each]
        begin = first + len(shared) + 1
        last = f"-{begin + len(mine) - 1}" if len(mine) > 1 else ""
        parts.append(Part((*shared, *mine), f".configurations_{begin}{last}"))
    return parts


def measured(table: pd.DataFrame, baselines: Sequence[str]) -> list[str]:
    """Ids of the objects that words, lanes and curves are about: the one first that tells most."""
    return sorted(telling(table, baselines, SHOWN_OBJECTS), key=telling(table, baselines, 1).__contains__, reverse=True)


def telling(table: pd.DataFrame, baselines: Sequence[str], most: int) -> list[str]:
    """Ids of the objects that tell configurations apart: in conflict with the ego, known at different times, late.

    In the table's order. Never known counts as known when the episode ended; `baselines` don't count beside others.
    """
    others = table[~table["configuration"].isin(baselines)]
    episodes = others if len(others) else table
    time_s = episodes["time_to_detection_s"].fillna(episodes["ended_s"] - episodes["onset_s"])
    of_each = time_s.groupby(episodes["object_id"], sort=False)
    conflict = episodes["conflict"] if "conflict" in episodes else pd.Series(False, index=episodes.index)
    rank = pd.DataFrame(
        {
            "conflict": conflict.fillna(False).astype(bool).groupby(episodes["object_id"], sort=False).any(),
            "apart": of_each.max() - of_each.min(),
            "late": of_each.max(),
        }
    )
    rank = rank.loc[list(dict.fromkeys(episodes["object_id"]))]
    chosen = set(rank.sort_values(["conflict", "apart", "late"], ascending=False, kind="stable").index[:most])
    return [name for name in dict.fromkeys(table["object_id"]) if name in chosen]
