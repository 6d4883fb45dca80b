"""Screens: what `run` and `compare` say on 80 columns and 24 lines. `--explain` has every column and what it means.

A table in the words that a person says, units once; what makes the results worthless stands above it. Rows that say the
same are one, zeros of the truth and columns that nobody has are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple

import pandas as pd

from copem_replay.core.errors import count_noun, name_first
from copem_replay.metrics.braking.driving import SHARE
from copem_replay.metrics.columns import FALSE_TRACKS
from copem_replay.metrics.limits import FEWEST_CLUSTERS, count_clusters, describe_clusters, format_limit, format_limits
from copem_replay.metrics.onset import has_frame_after
from copem_replay.metrics.summary import describe_no_needless
from copem_replay.metrics.summary_metrics import COMPARED
from copem_replay.results.compare.limits import STAR
from copem_replay.results.compare.tables import NOTHING, explain_no_interval
from copem_replay.results.decision import MATTERS, tell_seconds

if TYPE_CHECKING:
    from copem_replay.results.compare import Comparison
    from copem_replay.results.read import Results

FALSE = "false_positives_per_min"
_MOST_ROWS, _MOST_CHANGES = 12, 5
"""Rows of a table, and of one of old and new; more configurations are in `summary.csv`, or shown by `--explain`."""
_NAMES = 26
"""Most characters of the names of configurations that share a row."""


class _Column(NamedTuple):
    """`group`: words above neighbouring columns; `format`: of the value, of shares per cent."""

    group: str
    header: str
    metric: str
    format: str = "{:.3g} %"
    never: str = "–"


_COLUMNS = (
    _Column("known after, s", "mean", "ttd_rmst_s", "{:.2f}", "never"),
    _Column("known after, s", "median", "ttd_median_s", "{:.2f}", "never"),
    _Column("known after, s", "95 % by", "ttd_p95_s", "{:.2f}", "never"),
    _Column("at distance, m", "median", "dad_median_m", "{:.1f}"),
    _Column("", "detected", "detected_share"),
    _Column("conflicts", "passed", "pass_share"),
    _Column("braking", "for nothing", SHARE),
)


def format_screen(results: Results, summary: pd.DataFrame, best: Sequence[str]) -> tuple[list[str], list[str]]:
    """The lines of the screen but for the answer, and those of its rows that have one of the `best`.

    `summary`: as it was computed.
    """
    if not len(results.known):
        return [*_describe_rows(results)][:1], []
    shown = summary[[not _is_trivial(results, row) for _, row in summary.iterrows()]]
    columns = [column for column in _COLUMNS if column.metric in shown and _is_told(shown[column.metric], column)]
    rows = (
        (str(row["configuration"]), [_format_cell(row, column) for column in columns]) for _, row in shown.iterrows()
    )
    headers, groups = zip(*((column.header, column.group) for column in columns), strict=True)
    lines, marked = tabulate_alike(rows, headers, best, groups=groups, more_in="summary.csv")
    none = describe_no_needless(summary) if SHARE in summary else None
    false = [] if FALSE not in shown else _tell_false(results, shown.set_index("configuration")[FALSE].astype(float))
    return [*_describe_rows(results), *lines, *false, *([] if none is None else [none]), ""], marked


def _tell_false(results: Results, per_min: pd.Series) -> list[str]:
    """Who lists entries about nobody, `per_min` by configuration, where that is worth a look, and for how long."""
    if not len(rates := per_min[per_min >= MATTERS[FALSE]].sort_values(ascending=False, kind="stable")):
        return []
    told = name_first([f"{name} {format_limit(rate)}" for name, rate in rates.items()], len(rates), _WIDE - 44)
    tracks = results.frame(FALSE_TRACKS)
    longest_s = tracks.loc[tracks["configuration"].isin(rates.index), "lasts_s"].max()
    return [f"False per minute: {told}; none lasts over {longest_s:.2g} s."]


def _is_trivial(results: Results, row: Any) -> bool:
    """Whether a row is of the truth, which knows all at once."""
    return bool(results.facts[str(row["configuration"])].truth) and len(results.facts) > 1 and row["ttd_rmst_s"] == 0


def _is_told(values: pd.Series, column: _Column) -> bool:
    """Whether a column is shown: somebody has it, and of braking for nothing, somebody does."""
    return bool(values.notna().any()) and (column.metric != SHARE or bool(values.any()))


def _format_cell(row: Any, column: _Column) -> str:
    value = row[column.metric]
    return column.never if pd.isna(value) else column.format.format(value * (100 if "share" in column.metric else 1))


def tabulate_alike(
    rows: Iterable[tuple[str, Sequence[str]]], headers: Sequence[str], best: Sequence[str] = (), *,
    groups: Sequence[str] = (), pad: Callable[[str, int], str] = str.rjust, more_in: str = "--explain",
    most: int = _MOST_ROWS,
) -> tuple[list[str], list[str]]:  # fmt: skip
    """Aligned rows of configurations and cells, one row for equal cells; and the rows with one of the `best`.

    `groups`: words above columns, once for neighbours with equal words. `more_in`: where omitted ones are.
    """
    names_by_cells: dict[tuple[str, ...], list[str]] = {}
    for name, cells in rows:
        names_by_cells.setdefault(tuple(cells), []).append(name)
    shown = [*names_by_cells.items()][:most]
    table = [("", *headers), *((name_first(names, _NAMES, _NAMES), *cells) for cells, names in shown)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    header, after = [" " * widths[0]], 1
    for group, of_group in groupby(groups):
        first, after = after, after + len([*of_group])
        width = sum(widths[first:after]) + 2 * (after - first - 1)
        widths[first] += max(0, len(group) - width)
        header.append(group.rjust(width))
    padded = ([row[0].ljust(widths[0]), *map(pad, row[1:], widths[1:])] for row in table)
    head, *lines = ["  ".join(cells).rstrip() for cells in padded]
    marked = [line for line, (_, names) in zip(lines, shown, strict=True) if {*names} & {*best}]
    hidden = sum(len(names) for names in [*names_by_cells.values()][most:])
    more = [f"and {hidden} more: {more_in}"] if hidden else []
    return [*(["  ".join(header).rstrip()] if groups else []), head, *lines, *more], marked


def _describe_rows(results: Results) -> Iterator[str]:
    """Lines on how many objects, runs and logs count, and warnings where they are too few for an interval."""
    logs, objects, passes = count_clusters(results.known)
    runs, names = results.provenance.runs, [log.name for log in results.provenance.logs]
    where = names[0] if len(names) == 1 else count_noun(len(names), "log")
    counted = describe_counted(objects, passes)
    verb = "counts" if objects == 1 else "count"
    yield f"{where}: {counted} {verb}, {count_noun(runs, 'run')}{_describe_left_out(results)}"
    if objects == 1 and passes < FEWEST_CLUSTERS:
        yield "! One object says nothing about other traffic; `check` says who else is there."
    elif logs == 1 and objects < FEWEST_CLUSTERS:
        yield f"! {objects} objects of one drive are too few for an interval."
    elif logs == 2:
        yield "! Two logs tell no interval; three do."
    horizon_s, asked_s = results.provenance.horizon_used_s, results.experiment.measure.horizon_s
    if not math.isclose(horizon_s, asked_s):
        yield f"Too few are in range for {asked_s:g} s: means are up to {horizon_s:.3g} s."
    yield ""


def describe_counted(objects: int, passes: int) -> str:
    """`5 objects`; `5 objects in 9 passes`."""
    return count_noun(objects, "object") + (f" in {count_noun(passes, 'pass', 'passes')}" if passes > objects else "")


def _describe_left_out(results: Results) -> str:
    """`; not 9 more there at the start`: how many objects do not count, by how their episode began; “”: all count."""
    rows = results.tally.drop_duplicates(["log", "object_id", "episode"])
    rows = rows[has_frame_after(rows)]
    words = set(results.provenance.measure["began"])
    parts = {"log_start": "there at the start", "appeared": "that appeared in range", "crossed": "that came into range"}
    phrases = [
        f"not {number} more {phrase}"
        for word, phrase in parts.items()
        if word not in words and (number := int((rows["began"] == word).sum()))
    ]
    return "".join(f"; {one}" for one in phrases)


# The screen of a comparison.

_WIDE = 80
SHOWN = {
    "ttd_rmst_s": "known", SHARE: "brakes for nothing", "pass_share": "brakes in time",
    "position_rmse_held_m": "position error, m", FALSE: "false per minute",
}  # fmt: skip
"""Metrics of a comparison that are shown, the first ones first, and their headers."""


def choose_notes(notes: Sequence[str]) -> list[str]:
    """The notes about figures on the screen, in fewer words."""
    notes = [re.sub("^no interval of [^:]*: ([^;]*);.*", r"no interval: \1", note) for note in notes]
    named = [{*re.findall(r"\w+", note)} & {*COMPARED} for note in notes]
    return [note for note, metrics in zip(notes, named, strict=True) if not metrics or metrics & {*SHOWN}]


def format_comparison(comparison: Comparison, best: Sequence[str]) -> tuple[list[str], list[str]]:
    """The lines of a comparison but for the answer, and those of its rows that have one of the `best`."""
    overall = comparison.overall
    rows = {(row.configuration, row.metric): row for row in overall.itertuples(index=False)}
    least, most = {SHARE: MATTERS[SHARE]}, _MOST_CHANGES if comparison.newer else _MOST_ROWS
    same = [name for name in comparison.unchanged if name not in comparison.truths]
    folded = [f"{name_first(same, _WIDE, _WIDE - len(': unchanged'))}: unchanged"] if same else []
    changed = comparison.changed.configurations
    if not (names := [name for name in changed if name not in comparison.truths] or changed):
        return folded, []
    if comparison.newer:  # whoever changed most comes first, so that it fits however many did
        matters = overall["metric"].map(MATTERS).astype(float)
        changes = (overall["difference"].abs() / matters).groupby(overall["configuration"]).max().fillna(0.0)
        names = sorted(names, key=lambda name: (name not in best, -changes[name]))
    overall = overall[overall["configuration"].isin(names)]
    cells = {
        metric: [tell_difference(metric, rows.get((name, metric)), alike=bool(comparison.newer)) for name in names]
        for metric in SHOWN
        if overall.loc[overall["metric"] == metric, "difference"].abs().gt(least.get(metric, NOTHING)).any()
    }
    packed = _pack_columns(names, cells)
    tables = [
        tabulate_alike(
            zip(names, zip(*(cells[metric] for metric in metrics), strict=True), strict=True),
            [SHOWN[metric] for metric in metrics], best, pad=str.ljust, most=most,
        )
        for metrics in packed
    ]  # fmt: skip
    number = max(1, most // len(tables[0][0])) if tables else 0
    shown, cells = tables[:number], {metric: cells[metric] for metrics in packed[:number] for metric in metrics}
    if folded_names := [SHOWN[metric].partition(", ")[0] for metrics in packed[number:] for metric in metrics]:
        folded.insert(0, f"{' and '.join(folded_names)}: --explain")
    lines = [line for of_table, _ in shown for line in ["", *of_table]] if cells else ["", "nothing differs"]
    lines += folded
    starred = any(f" {STAR}" in line for line in lines)
    limited = [metric for metric in SHOWN if metric in cells and metric != SHARE]  # which is of drives
    return [*_describe_pairs(comparison, limited or ["ttd_rmst_s"], starred), *lines], [
        line for _, marked in shown for line in marked
    ]


def _pack_columns(names: Sequence[str], cells: Mapping[str, Sequence[str]]) -> list[list[str]]:
    """Metrics that stand side by side, in as many tables as it takes."""
    widths = {metric: 2 + max(map(len, [SHOWN[metric], *of_metric])) for metric, of_metric in cells.items()}
    room, packed = _WIDE - min(_NAMES, len(", ".join(names))), list[list[str]]()
    for metric in cells:
        fits = [of for of in packed if sum(widths[other] for other in [*of, metric]) <= room]
        if not fits:
            fits = [list[str]()]
            packed += fits
        fits[0].append(metric)
    return packed


def _describe_pairs(comparison: Comparison, metrics: Sequence[str], starred: bool) -> Iterator[str]:
    """Lines on the baseline, on what the intervals are over (logs, objects or runs), and on what the star means."""
    limited, over = comparison.overall.dropna(subset=["interval_over", "clusters"]), dict[str, list[str]]()
    for metric in metrics:
        for kind, of in limited[limited["metric"] == metric].groupby("interval_over"):
            counts = of["clusters"].astype(int)
            over.setdefault(describe_clusters(str(kind), counts.max(), counts.min()), []).append(
                SHOWN[metric].partition(", ")[0]
            )
    why = "" if comparison.baseline_why is None else f" ({comparison.baseline_why})"
    against = f"against {comparison.baseline}{why}; --baseline names another"
    itself = f"each minus itself in {comparison.baseline}; every figure: --explain"
    yield itself if comparison.newer else against
    for k, (words, headers) in enumerate(over.items()):
        of_what = f" of {' and '.join(headers)}" if len(over) > 1 else ""
        yield f"[95 %]{of_what}: over {words if k == 0 else words.partition(': ')[0]}"
    if starred:
        yield f"{STAR}: the interval excludes 0, all differences together held at 95 %"


def tell_difference(metric: str, row: Any, *, alike: bool = False) -> str:
    """`0.53 s later [0.454, 0.606] *`; `as soon` where it cannot matter; else signed. `alike`: also why no interval."""
    if row is None or pd.isna(row.difference):
        return "–"
    size, limits = float(row.difference), (row.low, row.high)
    known = not (pd.isna(row.low) or pd.isna(row.high))
    if metric == "ttd_rmst_s":
        if max(map(abs, (size, *limits) if known else (size,))) < MATTERS[metric]:
            return "as soon"
        words, known = tell_seconds(size, row.low, row.high), False
    else:
        size, limits = (100 * size, (100 * row.low, 100 * row.high)) if "share" in metric else (size, limits)
        words = (
            "±0"
            if abs(size) < NOTHING
            else f"{'+' if size > 0 else ''}{format_limit(size)}" + (" points" if "share" in metric else "")
        )
    marks = [STAR] if row.star == STAR else [f"({why})" for why in explain_no_interval(row) if alike and words != "±0"]
    return " ".join([words, *([format_limits(*limits)] if known and words != "±0" else []), *marks])
