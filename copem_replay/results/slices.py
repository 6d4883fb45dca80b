"""Slices of results: their rows in groups, in memory or read back, without a replay.

What an entry is, and what a group has: `metrics/slices.py`. Tables are read log by log, and only sums
by episode are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.metrics.config import Slice, find_range_problem, parse_slices
from copem_replay.metrics.slices import (
    KEYS,
    SUMMED_COLUMNS,
    Group,
    StudyRows,
    find_unknown_tag,
    sum_episodes,
    sum_lists,
)
from copem_replay.pipeline.run import slice_settings

if TYPE_CHECKING:
    from copem_replay.results.read import Results


def read_slices(results: Results, entries: Sequence[str], where: str = "--by") -> tuple[Slice, ...]:
    """Entries of `by`, checked against results. `where`: what gave them. Raises InputError, one line."""
    try:
        slices = parse_slices(entries)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
    tags = {log.name: log.tags for log in results.provenance.logs}
    onsets = [resolve_for_log(results.experiment, log).measure.onset for log in tags]
    problems = [*(find_range_problem(onset, slices) for onset in onsets), find_unknown_tag(slices, tags)]
    for problem in filter(None, problems):
        raise InputError(f"{where}: {problem}")
    return slices


def read_study_rows(results: Results, *, sums: bool = True) -> StudyRows:
    """The rows of a whole study, from results that were just computed or from a folder; raises InputError for damage.

    Without `sums` no row of a run is read, and there is neither accuracy but that of lists nor an own metric.

    `read_study_rows(results).split(by)` gives the groups of an entry, `group.rows.inputs(configuration)` what
    `evaluate_metrics` computes the figures of a configuration from, with their intervals.
    """
    experiment, provenance = results.experiment, results.provenance
    measure = experiment.measure
    settings = slice_settings(experiment, results.facts, provenance.horizon_used_s)
    summed = [pd.DataFrame(columns=list(KEYS))]
    for log in results.rows.logs if sums and (measure.accuracy or measure.metrics) else ():
        (rows,) = results.each(*(() if measure.metrics else SUMMED_COLUMNS), log=log, every=True)
        summed.append(sum_episodes(rows.assign(log=log), measure.metrics, measure.began))
    lists = sum_lists(results.tables.frame("lists.parquet")) if results.tables.has("lists.parquet") else None
    tags = {log.name: log.tags for log in provenance.logs}
    return StudyRows(
        settings, tags, results.tally, results.exact, pd.concat(summed[1:] or summed, ignore_index=True), lists
    )


def read_groups(results: Results, by: Slice) -> list[Group]:
    """The groups of one entry; of several, split the same `read_study_rows`, which reads the tables once."""
    return read_study_rows(results).split(by)
