"""Screens: what `run` and `compare` say on 80 columns and 24 lines. `--explain` has every column and what it means.

A table in the words that a person says, units once; what makes the results worthless stands above it. Rows that say the
same are one, zeros of the truth and columns that nobody has are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.errors import count_noun
from copem_replay.metrics.braking.driving import SHARE
from copem_replay.metrics.limits import FEWEST_CLUSTERS, count_clusters, describe_clusters, format_limit, format_limits
from copem_replay.metrics.onset import has_frame_after
from copem_replay.metrics.summary import describe_no_needless
from copem_replay.metrics.summary_metrics import COMPARED
from copem_replay.results.compare.limits import STAR
from copem_replay.results.compare.tables import NOTHING, explain_no_interval
from copem_replay.results.decision import MATTERS_S, MATTERS_SHARE, tell_seconds

if TYPE_CHECKING:
    from copem_replay.results.compare import Comparison
    from copem_replay.results.read import Results

_MOST_ROWS = 12
"""More configurations are in `summary.csv`."""
_NAMES = 26
"""Most characters of the names of configurations that share a row."""


def _seconds(value: float) -> str:
    return f"{value:.2f}"


def _metres(value: float) -> str:
    return f"{value:.1f}"


def _per_cent(value: float) -> str:
    return f"{100 * value:.3g} %"


@dataclass(frozen=True)
class _Column:
    """`group`: words above neighbouring columns."""

    group: str
    header: str
    metric: str
    format: Callable[[float], str]
    never: str = "–"


_COLUMNS = (
    _Column("known after, s", "mean", "ttd_rmst_s", _seconds, "never"),
    _Column("known after, s", "median", "ttd_median_s", _seconds, "never"),
    _Column("known after, s", "95 % by", "ttd_p95_s", _seconds, "never"),
    _Column("at distance, m", "median", "dad_median_m", _metres),
    _Column("", "detected", "detected_share", _per_cent),
    _Column("conflicts", "passed", "pass_share", _per_cent),
    _Column("braking", "for nothing", SHARE, _per_cent),
)


def format_screen(results: Results, summary: pd.DataFrame, best: Sequence[str]) -> tuple[list[str], list[str]]:
    """The lines of the screen but for the answer, and those of its rows that have one of the `best`.

    `summary`: as it was computed.
    """
    if not len(results.known):
        return [*_describe_rows(results)][:1], []
    shown = summary[[not _is_trivial(results, row) for _, row in summary.iterrows()]]
    columns = [column for column in _COLUMNS if column.metric in shown and _is_told(shown[column.metric], column)]
    rows: dict[tuple[str, ...], list[str]] = {}
    for _, row in shown.iterrows():
        cells = tuple(_format_cell(row, column) for column in columns)
        rows.setdefault(cells, []).append(str(row["configuration"]))
    names = {cells: _join_names(of) for cells, of in rows.items()}
    kept = list(rows)[:_MOST_ROWS]
    lines = _format_table(columns, [(names[cells], *cells) for cells in kept])
    marked = [line for line, cells in zip(lines[2:], kept, strict=True) if {*rows[cells]} & {*best}]
    left = sum(len(rows[cells]) for cells in list(rows)[_MOST_ROWS:])
    more = [f"and {left} more in summary.csv"] if left else []
    none = describe_no_needless(summary) if SHARE in summary else None
    more += [none] if none is not None else []
    return [*_describe_rows(results), *lines, *more, ""], marked


def _is_trivial(results: Results, row: Any) -> bool:
    """Whether a row is of the truth, which knows all at once."""
    return bool(results.facts[str(row["configuration"])].truth) and len(results.facts) > 1 and row["ttd_rmst_s"] == 0


def _is_told(values: pd.Series, column: _Column) -> bool:
    """Whether a column is shown: somebody has it, and of braking for nothing, somebody does."""
    return bool(values.notna().any()) and (column.metric != SHARE or bool(values.any()))


def _format_cell(row: Any, column: _Column) -> str:
    value = row[column.metric]
    return column.never if value is None or pd.isna(value) else column.format(float(value))


def _join_names(names: Sequence[str], room: int = _NAMES) -> str:
    """`gnn, union`; `gnn and 3 more` where they do not fit."""
    whole = ", ".join(names)
    return whole if len(whole) <= room or len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _format_table(columns: Sequence[_Column], rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Two lines of headers, then the rows; numbers to the right."""
    headers = ["", *(column.header for column in columns)]
    widths = [max(map(len, cells)) for cells in zip(headers, *rows, strict=True)]
    groups, k = [" " * widths[0]], 0
    while k < len(columns):
        after = k
        while after < len(columns) and columns[after].group == columns[k].group:
            after += 1
        width = sum(widths[k + 1 : after + 1]) + 2 * (after - k - 1)
        if (grow := len(columns[k].group) - width) > 0:
            widths[k + 1] += grow
            width += grow
        groups.append(columns[k].group.rjust(width))
        k = after
    body = [
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))])
        for row in (headers, *rows)
    ]
    return ["  ".join(groups).rstrip(), *(line.rstrip() for line in body)]


def _describe_rows(results: Results) -> Iterator[str]:
    """What counts, over what, and what makes it worthless."""
    logs, objects, passes = count_clusters(results.known)
    runs, names = results.provenance.runs, [log.name for log in results.provenance.logs]
    where = names[0] if len(names) == 1 else count_noun(len(names), "log")
    counted = count_noun(objects, "object") + (
        f" in {count_noun(passes, 'pass', 'passes')}" if passes > objects else ""
    )
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


def _describe_left_out(results: Results) -> str:
    """Who does not count: `; not 9 more there at the start`."""
    rows = results.tally.drop_duplicates(["log", "object_id", "episode"])
    rows = rows[has_frame_after(rows)]
    words = set(results.provenance.measure["began"])
    parts = {"log_start": "there at the start", "appeared": "that appeared in range", "crossed": "that came into range"}
    told = [
        f"not {number} more {said}"
        for word, said in parts.items()
        if word not in words and (number := int((rows["began"] == word).sum()))
    ]
    return "".join(f"; {one}" for one in told)


# The screen of a comparison.

_WIDE = 80
SHOWN = {
    "ttd_rmst_s": "known", SHARE: "brakes for nothing", "pass_share": "brakes in time",
    "position_rmse_held_m": "position error, m", "false_positives_per_min": "false per minute",
}  # fmt: skip
"""Metrics of a comparison that are shown, the first ones first, and their headers."""


def choose_notes(notes: Sequence[str]) -> list[str]:
    """Notes without those that are about other figures than those of the screen, in fewer words."""
    notes = [re.sub("^no interval of [^:]*: ([^;]*);.*", r"no interval: \1", note) for note in notes]
    named = [{*re.findall(r"\w+", note)} & {*COMPARED} for note in notes]
    return [note for note, metrics in zip(notes, named, strict=True) if not metrics or metrics & {*SHOWN}]


def format_comparison(comparison: Comparison, best: Sequence[str]) -> tuple[list[str], list[str]]:
    """The lines of a comparison but for the answer, and those of its rows that have one of the `best`."""
    overall = comparison.overall
    rows = {(row.configuration, row.metric): row for row in overall.itertuples(index=False)}
    least = {SHARE: MATTERS_SHARE}
    same = [name for name in comparison.unchanged if name not in comparison.truths]
    folded = [f"{_join_names(same, _WIDE)}: unchanged"] if same else []
    told = comparison.changed.configurations
    if not (names := [name for name in told if name not in comparison.truths] or told):
        return folded, []
    overall = overall[overall["configuration"].isin(names)]
    cells = {
        metric: [tell_difference(metric, rows.get((name, metric)), alike=bool(comparison.newer)) for name in names]
        for metric in SHOWN
        if overall.loc[overall["metric"] == metric, "difference"].abs().gt(least.get(metric, NOTHING)).any()
    }
    packed = _pack_columns(names, cells)
    tables = [_tabulate_differences(names, {metric: cells[metric] for metric in of}, best) for of in packed]
    shown = tables[: max(1, _MOST_ROWS // len(tables[0][0]))] if tables else []
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


def _tabulate_differences(
    names: Sequence[str], cells: Mapping[str, Sequence[str]], best: Sequence[str]
) -> tuple[list[str], list[str]]:
    """The lines of one table, a row for all that differ alike, and those that have one of the `best`."""
    grouped: dict[tuple[str, ...], list[str]] = {}
    for k, name in enumerate(names):
        grouped.setdefault(tuple(of_metric[k] for of_metric in cells.values()), []).append(name)
    shown = list(grouped)[:_MOST_ROWS]
    table = [("", *(SHOWN[metric] for metric in cells)), *((_join_names(grouped[of]), *of) for of in shown)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in table]
    marked = [line for line, of in zip(lines[1:], shown, strict=True) if {*grouped[of]} & {*best}]
    left = sum(len(grouped[of]) for of in list(grouped)[_MOST_ROWS:])
    return [*lines, *([f"and {left} more: --explain"] if left else [])], marked


def _describe_pairs(comparison: Comparison, metrics: Sequence[str], starred: bool) -> Iterator[str]:
    """What it is held against, and what the intervals are over."""
    limited, over = comparison.overall.dropna(subset=["interval_over", "clusters"]), dict[str, list[str]]()
    for metric in metrics:
        for kind, of in limited[limited["metric"] == metric].groupby("interval_over"):
            counts = of["clusters"].astype(int)
            over.setdefault(describe_clusters(str(kind), counts.max(), counts.min()), []).append(
                SHOWN[metric].partition(", ")[0]
            )
    why = "" if comparison.baseline_why is None else f" ({comparison.baseline_why})"
    against = f"against {comparison.baseline}{why}; --baseline names another"
    itself = f"each minus itself in {comparison.baseline}; --explain: every figure; --baseline: all against one"
    yield itself if comparison.newer else against
    for k, (words, headers) in enumerate(over.items()):
        of_what = f" of {' and '.join(headers)}" if len(over) > 1 else ""
        yield f"[95 %]{of_what}: over {words if k == 0 else words.partition(': ')[0]}"
    if starred:
        yield f"{STAR}: the interval excludes 0, all differences together held at 95 %"


def tell_difference(metric: str, row: Any, *, alike: bool = False) -> str:
    """`0.53 s later [0.454, 0.606] *`; `as soon` where it cannot matter; of other metrics with a sign. `alike`: also
    why there is no interval.
    """
    if row is None or pd.isna(row.difference):
        return "–"
    size, limits = float(row.difference), (row.low, row.high)
    known = not (pd.isna(row.low) or pd.isna(row.high))
    if metric == "ttd_rmst_s":
        if abs(size) < MATTERS_S and (not known or max(abs(row.low), abs(row.high)) < MATTERS_S):
            return "as soon"
        told, known = tell_seconds(size, row.low, row.high), False
    else:
        size, limits = (100 * size, (100 * row.low, 100 * row.high)) if "share" in metric else (size, limits)
        told = (
            "±0"
            if abs(size) < NOTHING
            else f"{'+' if size > 0 else ''}{format_limit(size)}" + (" points" if "share" in metric else "")
        )
    marks = [STAR] if row.star == STAR else [f"({why})" for why in explain_no_interval(row) if alike and told != "±0"]
    return " ".join([told, *([format_limits(*limits)] if known and told != "±0" else []), *marks])
