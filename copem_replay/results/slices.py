"""Slices of results: their rows in groups, in memory or read back, without a replay.

What an entry is, and what a group has: `metrics/slices.py`. Tables are read log by log, and only sums
by episode are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError, wrap_line
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.metrics.config import AREA, NO_AREAS, Slice, find_range_problem, parse_slices
from copem_replay.metrics.limits import describe_clusters, format_limits
from copem_replay.metrics.slices import (
    KEYS,
    SUMMED_COLUMNS,
    StudyRows,
    describe_chance,
    find_unknown_tag,
    sum_episodes,
    sum_lists,
    summarise_groups,
)
from copem_replay.metrics.summary import format_table
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
    if any(by.names(AREA) for by in slices) and "area" not in results.tally:
        problems.append(NO_AREAS)
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
    lists = sum_lists(results.frame("lists.parquet")) if results.has("lists.parquet") else None
    tags = {log.name: log.tags for log in provenance.logs}
    return StudyRows(
        settings, tags, results.tally, results.exact, pd.concat(summed[1:] or summed, ignore_index=True), lists
    )


def summarise_slices(results: Results, entries: Sequence[str] | None) -> pd.DataFrame | None:
    """The rows of `summary_by.csv` of entries, without a replay; None: of the file, None where there is none.

    Raises InputError, one line: an entry that is none, a tag that no log has, `range_at_onset` with an onset by range.
    """
    if entries is None:
        return results.summary_by
    return summarise_groups(read_study_rows(results), read_slices(results, entries))


# As text, for a terminal.

SHOWN = ("detected_share", "ttd_rmst_s", "unknown_s", "dad_median_m", "pass_share", "position_rmse_m")
"""Figures of groups in the terminal and in the report; `summary_by.csv` has all."""


def groups_text(table: pd.DataFrame, width: int | None = None) -> str:
    """The rows of `summary_by.csv` for a terminal: a table for each entry, lines on it. `width`: None for a pipe."""
    parts = []
    for entry, rows in table.groupby("by", sort=False):
        limits = zip(rows["detected_share_low"], rows["detected_share_high"], rows["apart"], strict=True)
        words = [_format_limits(low, high, apart is True or apart is np.True_) for low, high, apart in limits]
        names = [name for name in SHOWN if name in rows and rows[name].notna().any()]
        shown = pd.DataFrame(
            {str(entry): rows["group"], "objects": rows["objects"], "configuration": rows["configuration"]}
        )
        for name in names:
            shown[name] = rows[name].astype(float)
            if name == "detected_share":
                shown["95 %"] = words
        lines = [*describe_chance(rows), *describe_groups(rows)]
        parts.append(
            "\n".join([format_table(shown, width), *(part for line in lines for part in wrap_line(line, width))])
        )
    return "\n\n".join(parts)


def _format_limits(low: float, high: float, apart: bool) -> str:
    return "–" if pd.isna(low) else f"{format_limits(low, high)}{' *' if apart else ''}"


def describe_groups(rows: pd.DataFrame) -> list[str]:
    """Lines on groups, one for those with equal words; and on what intervals are over."""
    limited = rows.loc[rows["interval_over"].notna(), ["interval_over", "interval_clusters"]]
    lines = []
    for over, group in limited.groupby("interval_over", sort=False):
        most, fewest = (int(number) for number in group["interval_clusters"].agg(["max", "min"]))
        lines.append(f"95 %: over {describe_clusters(str(over), most, fewest)}")
    lines += ["*: the interval excludes the share of all groups"] if rows["apart"].eq(True).any() else []
    for note, group in rows.dropna(subset="note").groupby("note", sort=False):
        lines.append(f"{', '.join(group['group'].unique())}: {note}")
    return lines
