"""What is shown of many: which configurations, and of which objects words, lines, lanes and plots tell."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.receiver import by_truth

SHOWN_OBJECTS = 6
"""Of how many measured objects words, lines, lanes and plots tell (chosen)."""
VIEWED = 6
"""How many configurations are shown: more views than this are too small to see anything (chosen)."""


def viewed(experiment: Experiment, configurations: Sequence[str], baseline: str | None = None) -> list[str]:
    """Which configurations are shown, in their order: all, or the baselines (the truth, ideal fusion) before others.

    `baseline`: one that is shown in any case.
    """
    if len(configurations) <= VIEWED:
        return list(configurations)
    baselines = [name for name in configurations if name == baseline or by_truth(experiment.configurations[name])]
    baselines.sort(key=lambda name: name != baseline)
    # Half of the views at most, so that there is something to compare with them.
    others = [name for name in configurations if name not in baselines]
    first = [*baselines[: max(VIEWED // 2, VIEWED - len(others))], *others][:VIEWED]
    return [name for name in configurations if name in first]


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
