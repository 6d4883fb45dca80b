"""Selection of what figures show: object and run, and configurations if there are too many."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.metrics.summary import DETECTED
from copem_replay.report.figures.style import find_truths, shorten_names, sort_soonest_first
from copem_replay.results.shown_objects import is_observed_long

if TYPE_CHECKING:
    from copem_replay.results.compare import Comparison
    from copem_replay.results.read import Results


_COLUMNS = 4
"""Configurations side by side unless some are named, as many as in the figures of Piazzoni et al. 2022."""
MOST_LINES = 12
"""Most configurations in one plot: more cannot be distinguished."""
_RANKED_BY = ("time_to_detection_s", "onset_s", "ended_s", "conflict", "braking_pass")
_NAMED = 12
"""Most ids named in an error: more would hide its end."""


@dataclass(frozen=True)
class Selection:
    """What figures show. None: all configurations; log, object and run as in `choose_object_and_run`.

    `differences`: to a baseline, computed before; None: to the default baseline. `sliced`: rows of `summary_by.csv`;
    None: there are none. `linked`: whether groups are links to parts of the page that the figure is on.
    """

    configurations: Sequence[str] | None = None
    log: str | None = None
    object_id: str | None = None
    run: int | None = None
    differences: Comparison | None = None
    sliced: pd.DataFrame | None = None
    linked: bool = False


@dataclass(frozen=True)
class Choice:
    """One object in one run of one log, in some configurations; `named`: the selection names these."""

    log: str
    object_id: str
    run: int
    configurations: tuple[str, ...]
    named: bool


def choose_object_and_run(results: Results, selection: Selection) -> Choice:
    """The selected object, run and configurations.

    By default these are the most telling object that counts (`find_most_telling`), the run shown in the .rrd, else the
    first, and four configurations from best to worst. Any object may be named. Raises InputError for a selection that
    is not among the results.
    """
    known = results.tally[results.tally["event"] == DETECTED]
    for key, column, value in (("log", "log", selection.log), ("object", "object_id", selection.object_id)):
        if value is not None:
            values = list(dict.fromkeys(known[column]))
            known = known[known[column] == value]
            if not len(known):
                some = ", ".join(map(str, values[:_NAMED])) + (", …" if len(values) > _NAMED else "")
                raise InputError(f"{results.place}: {key}: expected one of {some}; found {value!r}")
    counted = results.counted(known)
    known = counted if len(counted) else known
    asked_names = results.chosen(selection.configurations)
    of_run = _rows_of_run(results, known, selection.run)
    log, object_id = find_most_telling(of_run, find_truths(results))
    run = int(of_run.loc[of_run["log"] == log, "run"].iloc[0])
    (rows,) = results.each("object_id", "configuration", *_RANKED_BY, log=log, every=True)
    present_names = tuple(name for name in asked_names if (rows["configuration"] == name).any())
    if not present_names:
        raise InputError(
            f"{results.place}: log {log} has none of the units of {', '.join(asked_names)}; choose another log"
        )
    shown = (
        present_names
        if selection.configurations
        else pick_best_to_worst(rows[rows["object_id"] == object_id], present_names)
    )
    return Choice(log, object_id, run, shown, bool(selection.configurations))


def _rows_of_run(results: Results, known: pd.DataFrame, run: int | None) -> pd.DataFrame:
    """Rows of a run for logs and objects in `known`; None: of each log's run shown in the .rrd, else run 0."""
    parts = []
    for log in dict.fromkeys(known["log"]):
        (rows,) = results.each("object_id", "episode", "configuration", "run", *_RANKED_BY, log=log, every=True)
        rows = first_episodes(rows)
        rows = rows[rows["object_id"].isin(known.loc[known["log"] == log, "object_id"])]
        wanted_run = results.provenance.run_shown.get(log, 0) if run is None else run
        parts.append(rows[rows["run"] == wanted_run].assign(log=log))
    of_run = pd.concat(parts)
    if not len(of_run):
        raise InputError(f"{results.place}: run: expected 0 to {results.experiment.runs - 1}, found {run}")
    return of_run


def find_most_telling(table: pd.DataFrame, upper: Sequence[str]) -> tuple[str, str]:
    """Log and id of the object that tells configurations apart most; of equal ones the first.

    Objects in conflict with the ego rank first, then those that are not too short to judge, as in the viewer, then by
    the spread of their times to detection over configurations, then by the latest of them. An object that was never
    known counts as known at the end of its episode. `upper`, the ground truth, is left out unless there are no others.
    """
    # A conflict decides, unlike in the viewer: the figure of runs is about how the ego brakes. How near its path an
    # object is takes the recording, which a table of results may lack.
    others = table[~table["configuration"].isin(list(upper))]
    rows = others if len(others) else table
    time_s = rows["time_to_detection_s"].fillna(rows["ended_s"] - rows["onset_s"])
    keys = [rows["log"], rows["object_id"]]
    by_object = time_s.groupby(keys, sort=False)
    conflict = rows["conflict"] if "conflict" in rows else pd.Series(False, index=rows.index)
    rank = pd.DataFrame(
        {
            "conflict": conflict.fillna(False).astype(bool).groupby(keys, sort=False).any(),
            "observed": is_observed_long(rows).groupby(keys, sort=False).any(),
            "apart": by_object.max() - by_object.min(),
            "late": by_object.max(),
        }
    )
    log, object_id = rank.sort_values(list(rank), ascending=False, kind="stable").index[0]
    return str(log), str(object_id)


def find_differing(results: Results, names: Sequence[str], most: int = MOST_LINES) -> tuple[str, ...]:
    """Up to `most` configurations in their order: all, or the first ones of those with equal times to detection.

    If these are still too many, they are picked evenly from the soonest to the latest.
    """
    if len(names) <= most:
        return tuple(names)
    digests = {name: blake2b() for name in names}
    for times_s in pivot_by_run(results, "time_to_detection_s"):
        for name, so_far in digests.items():
            so_far.update(times_s[name].round(6).to_numpy(dtype=float).tobytes())
    first: dict[bytes, str] = {}
    for name, digest in digests.items():
        first.setdefault(digest.digest(), name)
    kept = pick_evenly(sort_soonest_first(results, list(first.values())), most)
    return tuple(name for name in names if name in kept)


def pivot_by_run(results: Results, column: str) -> Iterator[pd.DataFrame]:
    """Per log a table of one column's times, a row per episode and run, a column per configuration; NaN: never."""
    keys = ["object_id", "episode", "run", "configuration"]
    for rows in results.each(*keys, column):
        times = rows.set_index(keys)[column].unstack("configuration")
        yield times.reindex(columns=list(results.experiment.configurations))


def pick_evenly(ranked: Sequence[str], most: int) -> tuple[str, ...]:
    """Up to `most` of the names, evenly spaced, with the first and the last."""
    picked = np.unique(np.rint(np.linspace(0, len(ranked) - 1, min(most, len(ranked)))).astype(int))
    return tuple(ranked[k] for k in picked)


def describe_left_out(names: Sequence[str], shown: Sequence[str]) -> str:
    """A sentence on the configurations that a figure leaves out; empty without any."""
    left = [short for name, short in shorten_names(names).items() if name not in shown]
    if not left:
        return ""
    return f"{len(shown)} of {len(names)} configurations, from the soonest to the latest; not drawn: {', '.join(left)}"


def pick_best_to_worst(rows: pd.DataFrame, names: Sequence[str]) -> tuple[str, ...]:
    """Up to four configurations from best to worst, by the share of rows that pass, then by mean time to detection.

    An object that is never detected counts as the longest episode.
    """
    longest_s = float((rows["ended_s"] - rows["onset_s"]).max())
    late_s = rows["time_to_detection_s"].fillna(longest_s).groupby(rows["configuration"]).mean()
    passes = pd.Series(0.0, index=late_s.index)
    if "conflict" in rows and rows["conflict"].any():
        passes = rows["braking_pass"].astype(float).groupby(rows["configuration"]).mean()
    # Of equal ones the first ranks better: usually that is the truth.
    ranked = sorted(names, key=lambda name: (-passes[name], late_s[name], names.index(name)))
    return pick_evenly(ranked, _COLUMNS)
