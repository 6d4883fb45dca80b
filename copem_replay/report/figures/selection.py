"""Selection for figures: which object and run, and which configurations where not all have a place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.report.figures.captions import short_names
from copem_replay.report.figures.contenders import soonest_first, truths

if TYPE_CHECKING:
    from copem_replay.results.compare import Comparison
    from copem_replay.results.read import Results

_COLUMNS = 4
"""Runs side by side unless configurations are named (chosen: the paper's)."""
MOST_LINES = 12
"""Configurations in one plot, at most (chosen: more cannot be told apart)."""
_NAMED = 12
"""Ids named in an error (chosen)."""


@dataclass(frozen=True)
class Selection:
    """What is drawn. None: all configurations; of log, object and run the ones that tell most (`choose`).

    `differences`: to a baseline, where they are known already; None: to the default baseline.
    """

    configurations: Sequence[str] | None = None
    log: str | None = None
    object_id: str | None = None
    run: int | None = None
    differences: Comparison | None = None


@dataclass(frozen=True)
class Choice:
    """One object in one run of one log, in some configurations; `named`: these were asked for."""

    log: str
    object_id: str
    run: int
    configurations: tuple[str, ...]
    named: bool


def choose(results: Results, of: Selection) -> Choice:
    """What was asked for; by default the object that tells most (`most_telling`) and the run that is in the .rrd, else
    the first; four configurations from worst to best.

    Raises InputError for what is not among the results.
    """
    rows, where = results.table, f"{results.folder}"
    for key, column, wanted in (("log", "log", of.log), ("object", "object_id", of.object_id)):
        if wanted is not None:
            known = list(dict.fromkeys(rows[column]))
            rows = rows[rows[column] == wanted]
            if not len(rows):
                there = ", ".join(map(str, known[:_NAMED])) + (", …" if len(known) > _NAMED else "")
                raise InputError(f"{where}: {key}: expected one of {there}; found {wanted!r}")
    named = results.chosen(of.configurations)
    # Of each row the run of its log that is in the .rrd, else the first.
    shown_run = rows["log"].map(results.provenance.run_shown).fillna(rows["run"].min()).astype(int)
    of_run = rows[rows["run"] == (shown_run if of.run is None else of.run)]
    if not len(of_run):
        raise InputError(f"{where}: run: expected {rows['run'].min()} to {rows['run'].max()}, found {of.run}")
    log, object_id = most_telling(of_run, truths(results))
    rows = rows[(rows["log"] == log) & (rows["object_id"] == object_id)]
    run = int(of_run.loc[of_run["log"] == log, "run"].iloc[0])
    shown = named if of.configurations else worst_to_best(rows, named)
    return Choice(log, object_id, run, shown, bool(of.configurations))


def most_telling(table: pd.DataFrame, upper: Sequence[str]) -> tuple[str, str]:
    """Log and id of the object that tells most: in conflict with the ego, known at different times, late.

    As `telling` of the viewer has it; of equals the first. Never known counts as known at the end; `upper`, the ground
    truth, does not count beside others.
    """
    others = table[~table["configuration"].isin(list(upper))]
    rows = others if len(others) else table
    time_s = rows["time_to_detection_s"].fillna(rows["ended_s"] - rows["onset_s"])
    keys = [rows["log"], rows["object_id"]]
    of_each = time_s.groupby(keys, sort=False)
    conflict = rows["conflict"] if "conflict" in rows else pd.Series(False, index=rows.index)
    rank = pd.DataFrame(
        {
            "conflict": conflict.fillna(False).astype(bool).groupby(keys, sort=False).any(),
            "apart": of_each.max() - of_each.min(),
            "late": of_each.max(),
        }
    )
    log, object_id = rank.sort_values(list(rank), ascending=False, kind="stable").index[0]
    return str(log), str(object_id)


def that_differ(results: Results, names: Sequence[str], most: int = MOST_LINES) -> tuple[str, ...]:
    """At most so many configurations, in their order: all, or the first of those that detect alike.

    Where these still are too many, evenly from the soonest to the latest.
    """
    if len(names) <= most:
        return tuple(names)
    keys = ["log", "object_id", "run"]
    times = results.table.set_index([*keys, "configuration"])["time_to_detection_s"].unstack("configuration").round(6)
    first: dict[bytes, str] = {}
    for name in names:
        first.setdefault(times[name].to_numpy(dtype=float).tobytes(), name)
    kept = evenly(soonest_first(results, list(first.values())), most)
    return tuple(name for name in names if name in kept)


def evenly(ranked: Sequence[str], most: int) -> tuple[str, ...]:
    """So many of them, the first and the last among them."""
    picked = np.unique(np.rint(np.linspace(0, len(ranked) - 1, min(most, len(ranked)))).astype(int))
    return tuple(ranked[k] for k in picked)


def left_out(names: Sequence[str], shown: Sequence[str]) -> str:
    """Which configurations a figure leaves out; empty: none."""
    left = [short for name, short in short_names(names).items() if name not in shown]
    if not left:
        return ""
    return f"{len(shown)} of {len(names)} configurations, from the soonest to the latest; not drawn: {', '.join(left)}"


def worst_to_best(rows: pd.DataFrame, names: Sequence[str]) -> tuple[str, ...]:
    """Four of the configurations: by the share of the rows that pass, then by the mean time to detection.

    Never detected counts as the longest episode.
    """
    longest_s = float((rows["ended_s"] - rows["onset_s"]).max())
    late_s = rows["time_to_detection_s"].fillna(longest_s).groupby(rows["configuration"]).mean()
    passes = pd.Series(0.0, index=late_s.index)
    if "conflict" in rows and rows["conflict"].any():
        passes = rows["braking_pass"].astype(float).groupby(rows["configuration"]).mean()
    # Of equals the first counts as the better one: by custom that is the truth.
    ranked = sorted(names, key=lambda name: (passes[name], -late_s[name], -names.index(name)))
    return evenly(ranked, _COLUMNS)
