"""Selection of what figures show: object and run, and configurations if there are too many."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from types import MappingProxyType
from typing import TYPE_CHECKING

import pandas as pd

from copem_replay.core.colours import Rgb, configuration_colours
from copem_replay.core.errors import CopemError, InputError
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.metrics.onset import COUNTS_BY
from copem_replay.metrics.summary import DETECTED
from copem_replay.report.figures.style import find_truths, shorten_names, sort_soonest_first
from copem_replay.results.compare.labels import find_baseline
from copem_replay.results.shown_objects import choose_shown_objects, measure_apart, pick_evenly

if TYPE_CHECKING:
    from copem_replay.results.compare import Comparison
    from copem_replay.results.read import Results


_COLUMNS = 4
"""Configurations side by side unless some are named, as many as in the figures of Piazzoni et al. 2022."""
MOST_LINES = 12
"""Most configurations in one plot: more cannot be distinguished."""
TOGETHER = 6
"""Most curves in one panel: more hide each other."""
_RANKED_BY = ("time_to_detection_s", "detection_s", *COUNTS_BY, "conflict", "braking_pass")
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

    By default these are the object that counts and tells most (`choose_shown_objects`), the run shown in the .rrd, else
    the first, and four configurations from best to worst. Any object may be named. Raises InputError for a selection
    that is not among the results.
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
    log, object_id = _find_most_telling(results, of_run)
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
        else pick_best_to_worst(
            rows[rows["object_id"] == object_id],
            present_names,
            configuration_colours(results.experiment.configurations, find_truths(results)),
        )
    )
    return Choice(log, object_id, run, shown, bool(selection.configurations))


def _rows_of_run(results: Results, known: pd.DataFrame, run: int | None) -> pd.DataFrame:
    """Rows of one run for logs and objects in `known`; `run` None: each log's run shown in the .rrd, else run 0."""
    rows_by_log = []
    for log in dict.fromkeys(known["log"]):
        (rows,) = results.each("object_id", "episode", "configuration", "run", *_RANKED_BY, log=log, every=True)
        rows = first_episodes(rows)
        rows = rows[rows["object_id"].isin(known.loc[known["log"] == log, "object_id"])]
        wanted_run = results.provenance.run_shown.get(log, 0) if run is None else run
        rows_by_log.append(rows[rows["run"] == wanted_run].assign(log=log))
    run_rows = pd.concat(rows_by_log)
    if not len(run_rows):
        raise InputError(f"{results.place}: run: expected 0 to {results.experiment.runs - 1}, found {run}")
    return run_rows


def _find_most_telling(results: Results, of_run: pd.DataFrame) -> tuple[str, str]:
    """The log, and the object in it whose times differ most between configurations, near the ego's path if known."""
    ranking = {
        log: measure_apart(resolve_for_log(results.experiment, log), rows).sort_values(
            ["observed", "apart_s", "apart_raw_s"], ascending=False, kind="stable"
        )
        for log, rows in of_run.groupby("log", sort=False)
    }
    log = max(ranking, key=lambda name: tuple(ranking[name][["observed", "apart_s"]].iloc[0]))
    first, experiment = str(ranking[log].index[0]), resolve_for_log(results.experiment, log)
    if len(ranking[log]) == 1:
        return log, first
    try:
        recording = results.recording(log, experiment)
    except CopemError:
        return log, first
    shown = choose_shown_objects(recording.scene, recording.truth, experiment, of_run[of_run["log"] == log])
    return log, recording.scene.object_ids[shown.object_ix[0]]


def find_differing(
    results: Results, names: Sequence[str], most: int = MOST_LINES, colours: Mapping[str, object] = MappingProxyType({})
) -> tuple[str, ...]:
    """Up to `most` configurations in their order: all, or the first ones of those with equal times to detection.

    If these are still too many, they are picked evenly from the soonest to the latest, with `colours` that differ. The
    baseline is always among them.
    """
    if len(names) <= most:
        return tuple(names)
    baseline = find_baseline(results.facts, names).name
    digests = {name: blake2b() for name in names}
    for times_s in pivot_by_run(results, "time_to_detection_s"):
        for name, so_far in digests.items():
            so_far.update(times_s[name].round(6).to_numpy(dtype=float).tobytes())
    first: dict[bytes, str] = {}
    for name in (baseline, *digests):
        first.setdefault(digests[name].digest(), name)
    others = [name for name in first.values() if name != baseline]
    kept = pick_evenly(sort_soonest_first(results, others), most, [baseline], colours)
    return tuple(name for name in names if name in kept)


def pivot_by_run(results: Results, column: str) -> Iterator[pd.DataFrame]:
    """Per log a table of one column's times, a row per episode and run, a column per configuration; NaN: never."""
    keys = ["object_id", "episode", "run", "configuration"]
    for rows in results.each(*keys, column):
        times = rows.set_index(keys)[column].unstack("configuration")
        yield times.reindex(columns=list(results.experiment.configurations))


def describe_left_out(names: Sequence[str], shown: Sequence[str]) -> str:
    """A sentence on the configurations that a figure omits; empty without any."""
    left = [short for name, short in shorten_names(names).items() if name not in shown]
    if not left:
        return ""
    return f"{len(shown)} of {len(names)} configurations, from the soonest to the latest; not drawn: {', '.join(left)}"


def pick_best_to_worst(rows: pd.DataFrame, names: Sequence[str], colours: Mapping[str, Rgb]) -> tuple[str, ...]:
    """Up to four configurations from best to worst, by the share of rows that pass, then by mean time to detection. An
    object that is never detected counts as the longest episode.
    """
    longest_s = float((rows["ended_s"] - rows["onset_s"]).max())
    late_s = rows["time_to_detection_s"].fillna(longest_s).groupby(rows["configuration"]).mean()
    passes = pd.Series(0.0, index=late_s.index)
    if "conflict" in rows and rows["conflict"].any():
        passes = rows["braking_pass"].astype(float).groupby(rows["configuration"]).mean()
    # Of equal ones the first ranks better: usually that is the truth.
    ranked = sorted(names, key=lambda name: (-passes[name], late_s[name], names.index(name)))
    return pick_evenly(ranked, _COLUMNS, colours=colours)
