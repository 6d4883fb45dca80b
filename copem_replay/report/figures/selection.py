"""Selection for figures: which object and run, and which configurations where not all have a place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import blake2b
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
_RANKED_BY = ("time_to_detection_s", "onset_s", "ended_s", "conflict", "braking_pass")
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
    known = results.known
    for key, column, wanted in (("log", "log", of.log), ("object", "object_id", of.object_id)):
        if wanted is not None:
            every = list(dict.fromkeys(known[column]))
            known = known[known[column] == wanted]
            if not len(known):
                some = ", ".join(map(str, every[:_NAMED])) + (", …" if len(every) > _NAMED else "")
                raise InputError(f"{results.folder}: {key}: expected one of {some}; found {wanted!r}")
    asked = results.chosen(of.configurations)
    of_run = _of_run(results, known, of.run)
    log, object_id = most_telling(of_run, truths(results))
    run = int(of_run.loc[of_run["log"] == log, "run"].iloc[0])
    (rows,) = results.each("object_id", "configuration", *_RANKED_BY, log=log)
    named = tuple(name for name in asked if (rows["configuration"] == name).any())
    if not named:
        raise InputError(f"{results.folder}: log {log} has none of the units of {', '.join(asked)}; choose another log")
    shown = named if of.configurations else worst_to_best(rows[rows["object_id"] == object_id], named)
    return Choice(log, object_id, run, shown, bool(of.configurations))


def _of_run(results: Results, known: pd.DataFrame, run: int | None) -> pd.DataFrame:
    """Of the logs and objects in `known` the rows of a run; None: of that of each log that is in the .rrd, else 0."""
    found = []
    for log in dict.fromkeys(known["log"]):
        (rows,) = results.each("object_id", "configuration", "run", *_RANKED_BY, log=log)
        rows = rows[rows["object_id"].isin(known.loc[known["log"] == log, "object_id"])]
        wanted = results.provenance.run_shown.get(log, 0) if run is None else run
        found.append(rows[rows["run"] == wanted].assign(log=log))
    of_run = pd.concat(found)
    if not len(of_run):
        raise InputError(f"{results.folder}: run: expected 0 to {results.experiment.runs - 1}, found {run}")
    return of_run


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
    told = {name: blake2b() for name in names}
    for times_s in by_run(results, "time_to_detection_s"):
        for name, so_far in told.items():
            so_far.update(times_s[name].round(6).to_numpy(dtype=float).tobytes())
    first: dict[bytes, str] = {}
    for name, whole in told.items():
        first.setdefault(whole.digest(), name)
    kept = evenly(soonest_first(results, list(first.values())), most)
    return tuple(name for name in names if name in kept)


def by_run(results: Results, column: str) -> Iterator[pd.DataFrame]:
    """Of each log a column of times by object and run, of all configurations beside each other; NaN: never."""
    for rows in results.each("object_id", "run", "configuration", column):
        times = rows.set_index(["object_id", "run", "configuration"])[column].unstack("configuration")
        yield times.reindex(columns=list(results.experiment.configurations))


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
