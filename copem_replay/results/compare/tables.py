"""Tables of a comparison: for a terminal, as Markdown, as CSV. Nothing is cut off."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.errors import OutputError, count_noun, escape_unprintable, wrap_line
from copem_replay.metrics.braking.driving import SHARE
from copem_replay.metrics.limits import (
    ALL_ALIKE,
    EXACT,
    FEWEST_LOGS,
    NOTHING_DRAWN,
    describe_absent,
    describe_clusters,
    format_limit,
    format_limits,
)
from copem_replay.metrics.summary import describe_mean, format_table
from copem_replay.metrics.summary_metrics import COMPARED
from copem_replay.results.compare.groups import describe_group_chance
from copem_replay.results.compare.limits import ALONE, STAR
from copem_replay.results.outputs import check_output, made_file
from copem_replay.results.table_files import write_csv

if TYPE_CHECKING:
    from copem_replay.results.compare.compare import Comparison


_SUFFIXES = (".csv", ".md")
NOTHING = 1e-9
"""Differences closer to 0 are 0: far below what any of the metrics resolves."""
_WITHOUT = {ALL_ALIKE: "all alike", NOTHING_DRAWN: NOTHING_DRAWN}
"""Words in a cell without an interval, by the reason."""


def comparison_text(comparison: Comparison, width: int | None = None) -> str:
    """The comparison as text: a row per configuration, a column per metric, lines on them, and what errors are over.

    `width`: None for a pipe.
    """
    comparison = comparison.changed
    lines = (part for line in comparison_lines(comparison) for part in wrap_line(line, width))
    held = held_cells(comparison)
    tables = [format_table(held, width)] if len(held) else []
    groups = [f"\n{table}" for table in _group_blocks(comparison, width)]
    whole = [format_table(_format_cells(comparison), width)] if comparison.configurations else []
    return "\n".join([*whole, *lines, *tables, *groups])


def _group_blocks(comparison: Comparison, width: int | None) -> Iterator[str]:
    """A table for each entry by which groups are compared, and how many of its intervals exclude 0."""
    if comparison.groups is None:
        return
    for by, rows in comparison.groups.groupby("by", sort=False):
        lines = (part for line in describe_group_chance(rows) for part in wrap_line(line, width))
        yield "\n".join([format_table(_format_groups(str(by), rows), width), *lines])


def _format_groups(entry: str, rows: pd.DataFrame) -> pd.DataFrame:
    """The differences of each group and configuration as text; metrics that have none are left out."""
    names = [name for name in COMPARED if rows.loc[rows["metric"] == name, "difference"].notna().any()]
    cells: list[dict[str, str]] = []
    for (group, configuration), of_pair in rows.groupby(["group", "configuration"], sort=False):
        row_of = {row.metric: row for row in of_pair.itertuples(index=False)}
        figures = {name: _format_cell(row_of.get(name)) for name in names}
        cells.append({entry: str(group), "configuration": str(configuration), **figures})
    return pd.DataFrame(cells, columns=[entry, "configuration", *names])


def comparison_markdown(comparison: Comparison) -> str:
    """The comparison as Markdown: its table, lines and notes as a list, what errors are over; ends with a newline."""
    comparison = comparison.changed
    held, notes = held_cells(comparison), (f"note: {note}" for note in comparison.notes)
    lines = [f"- {escape_markdown(use_headers(line))}" for line in (*comparison_lines(comparison), *notes)]
    below = ["", *_markdown_rows(held)] if len(held) else []
    if comparison.groups is not None:
        for by, rows in comparison.groups.groupby("by", sort=False):
            chance = (f"- {escape_markdown(line)}" for line in describe_group_chance(rows))
            below += ["", *_markdown_rows(_format_groups(str(by), rows)), "", *chance]
    cells = [*_markdown_rows(_format_cells(comparison)), ""] if comparison.configurations else []
    return "\n".join([*cells, *lines, *below, ""])


def _markdown_rows(cells: pd.DataFrame) -> Iterator[str]:
    for row in (map(use_headers, cells.columns), ["---"] * len(cells.columns), *cells.itertuples(index=False)):
        yield "| " + " | ".join(escape_markdown(str(cell)) for cell in row) + " |"


_NAMES = re.compile("|".join(rf"\b{name}\b" for name in sorted(COMPARED, key=len, reverse=True)))


def use_headers(line: str) -> str:
    """A line of the comparison with headers of columns, without units, in place of their names in files."""
    return _NAMES.sub(lambda found: COMPARED[found[0]].header.partition(", ")[0], line)


def check_out(path: Path) -> None:
    """Raise OutputError where the file's name has another suffix, or it may not be written."""
    if path.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{path}: expected a name that ends with {' or '.join(_SUFFIXES)}, found {path.name}")
    check_output(path)


def write_comparison(comparison: Comparison, path: Path, folders: Sequence[Path] = ()) -> None:
    """Write CSV (a row per log, configuration and metric) or a Markdown table, by the suffix. Raises OutputError.

    `folders`: of the compared results, which list the file if it lies in them.
    """
    check_out(path)
    with made_file(path, *folders) as scratch:
        if path.suffix.lower() == ".csv":
            groups = [] if comparison.groups is None else [comparison.groups]
            write_csv(pd.concat([comparison.table, *groups], ignore_index=True), scratch)
        else:
            scratch.write_text(comparison_markdown(comparison), encoding="utf-8")


def _format_cells(comparison: Comparison) -> pd.DataFrame:
    """The table for people: a row by configuration, a column by metric that is not 0 or missing throughout."""
    rows = {(row.configuration, row.metric): row for row in comparison.overall.itertuples(index=False)}
    metrics = [metric for metric in COMPARED if any((name, metric) in rows for name in comparison.configurations)]
    if not any(row.value or row.baseline_value for (_, metric), row in rows.items() if metric == SHARE):
        metrics = [metric for metric in metrics if metric != SHARE]  # nobody brakes for nothing
    columns: dict[str, list[str]] = {"configuration": list(comparison.configurations)}
    for metric in metrics:
        columns[metric] = [_format_cell(rows.get((name, metric))) for name in comparison.configurations]
    if "ttd_both_s" in columns:
        alone = [format_alone(comparison, name) for name in comparison.configurations]
        columns["ttd_both_s"] = [
            f"{cell} {words}".strip() for cell, words in zip(columns["ttd_both_s"], alone, strict=True)
        ]
    return pd.DataFrame(columns)


def format_alone(comparison: Comparison, configuration: str) -> str:
    """The shares that `ttd_both_s` leaves out: `(only it 5.4 %, only the baseline 0 %)`; empty: none."""
    of_pair = comparison.overall[comparison.overall["configuration"] == configuration].set_index("metric")
    if not {"ttd_both_s", "detected_share"} <= set(of_pair.index) or not of_pair.loc["detected_share", "n"]:
        return ""
    row, rows = of_pair.loc["ttd_both_s"], int(of_pair.loc["detected_share", "n"])
    shares = [100 * row[name] / rows for name in ("only_configuration", "only_baseline")]
    return "(only it {:.3g} %, only the baseline {:.3g} %)".format(*shares) if any(shares) else ""


def _format_cell(row: Any) -> str:
    """`+0.12 [0.05, 0.2] *`; `+0.12 (all alike)`; a dash where there is no difference."""
    if row is None or pd.isna(row.difference):
        return "–"
    if pd.isna(row.interval_over):
        return " ".join([format_signed(row.difference), *(f"({why})" for why in explain_no_interval(row))])
    low, high = (math.nan if pd.isna(limit) else float(limit) for limit in (row.low, row.high))
    marks = (mark for mark in (row.star, row.word) if not pd.isna(mark))
    return " ".join([f"{format_signed(row.difference)} {format_limits(low, high)}", *marks])


def explain_no_interval(row: Any) -> list[str]:
    """Why a difference has no interval, in a word or two; empty where it has one, or where clusters are too few."""
    return [_WITHOUT[row.interval]] if row.interval in _WITHOUT else []


def format_signed(value: float) -> str:
    """A difference to three significant digits, with its sign."""
    return "±0" if abs(value) < NOTHING else ("+" if value > 0 else "") + format_limit(value)


def comparison_lines(comparison: Comparison) -> Iterator[str]:
    """Lines on the table: its meaning, and the configurations that are better than the baseline."""
    overall = comparison.overall
    shown = set(overall["metric"])
    how = "paired by log, object and run; accuracy of the newest list at each frame"
    yield f"differences to {comparison.baseline}, {how}"
    if comparison.unchanged:
        yield f"unchanged: {', '.join(comparison.unchanged)}"
    if comparison.baseline_why is not None:
        yield f"baseline {comparison.baseline}: {comparison.baseline_why}; --baseline names another"
    limited = overall.dropna(subset="interval_over")
    of_driving = limited["metric"].map(lambda metric: COMPARED[metric].part == "needless").rename("driving")
    kinds = [
        describe_clusters(str(kind), int(of["clusters"].max()), int(of["clusters"].min()), bool(driving))
        for (kind, driving), of in limited.groupby(["interval_over", of_driving], sort=False)
    ]
    if kinds:
        yield f"[95 %]: over {'; '.join(kinds)}"
    yield from _describe_logs(limited[limited["interval_over"] == "logs"])
    yield from _describe_stars(comparison, overall)
    yield from _describe_intervals(overall)
    yield f"ttd_rmst_s: {describe_mean(comparison.horizon_s, censored=True)}"
    if "ttd_rmst_s_equal_ghosts" in shown:
        rate = comparison.false_positives_per_min
        ghosts = f"as many ghosts as in {comparison.baseline}" if rate is None else f"{rate:.4g} ghosts per minute"
        yield (
            "ttd_rmst_s_equal_ghosts: the same mean by match (also for ideal fusion and the truth), with the least "
            f"certain entries of each left out until {ghosts} remain, not counting stale ones"
        )
    yield from _describe_held(comparison)
    yield from _describe_better(comparison)


def _describe_stars(comparison: Comparison, rows: pd.DataFrame) -> Iterator[str]:
    """Lines below a table: what its star marks mean, which metric decides, and the least difference that matters."""
    number = int(rows["difference"].notna().sum())
    decide = comparison.decide
    decided = number if decide is None else int(rows.loc[rows["metric"] == decide, "difference"].notna().sum())
    together = f"the {count_noun(decided, 'difference')} of {'this table' if decide is None else decide} together"
    if decide is not None:
        yield f"decided by {decide}, named beforehand: no other column has a {STAR}"
    if (rows["star"] == STAR).any():
        yield f"{STAR}: the interval excludes 0, {together} at 95 %"
    if (rows["star"] == ALONE).any():
        yield f"{ALONE}: its own interval alone excludes 0; of {number} such 1 in 20 does by chance"
    over_logs = rows.loc[rows["interval_over"] == "logs", "clusters"]
    if len(over_logs) and over_logs.max() == FEWEST_LOGS and decided > 1:
        yield "three drives cannot star a table; name one figure (--decide METRIC), or record eight"
    for metric, least in comparison.matters.items():
        yield (
            f"{metric}: better or worse with a {STAR}; alike: the interval is within ±{format_limit(least)}, the least "
            "difference that matters; else open"
        )


def _describe_better(comparison: Comparison) -> Iterator[str]:
    """Lines on who is better than the baseline (in needless braking also worse); metrics with equal names share one."""
    metrics: dict[tuple[str, str, str], list[str]] = {}
    for metric, row in COMPARED.items():
        metric_rows = comparison.overall[comparison.overall["metric"] == metric]
        gain = metric_rows["difference"] * row.better
        for word, beyond in (("better", gain > 0), ("worse", (gain < 0) & (row.part == "needless"))):
            rows_beyond = metric_rows[beyond & (metric_rows["star"] == STAR)]
            for baseline, rows in rows_beyond.groupby("baseline", sort=False):
                names = ", ".join(map(_name_with_logs, rows.itertuples(index=False)))
                metrics.setdefault((word, names, str(baseline)), []).append(metric)
    for (word, names, baseline), of_names in metrics.items():
        yield f"{word} than {baseline} in {', '.join(of_names)} ({STAR}): {names}"


def _describe_logs(limited: pd.DataFrame) -> Iterator[str]:
    """Lines on intervals over logs: in how many logs each configuration is better, and what none of them may have."""
    if not len(limited):
        return
    parts = []
    for metric, rows in limited.groupby("metric", sort=False):
        counts = (f"{row.configuration} {row.logs_better} of {row.clusters}" for row in rows.itertuples())
        parts.append(f"{metric} {', '.join(counts)}")
    yield f"logs that gain: {'; '.join(parts)}"
    yield f"whatever the interval, {describe_absent(int(limited['clusters'].min()))}"


def _name_with_logs(row: Any) -> str:
    """A configuration, and in how many logs it gains, where the interval is over logs."""
    return row.configuration if pd.isna(row.logs_better) else f"{row.configuration} ({describe_gain(row)})"


def describe_gain(row: Any) -> str:
    """In how many logs a configuration is better than the baseline: `7 of 8 logs gain`."""
    return f"{row.logs_better} of {row.clusters} logs gain"


def _describe_held(comparison: Comparison) -> Iterator[str]:
    """Lines that explain the columns on errors of the held list, and the extra table; none without such columns."""
    if not len(held_cells(comparison)):
        return
    yield (
        "position_rmse_held_m: position error (RMSE) of the newest list at each frame, over objects that both list; "
        f"negative is better than {comparison.baseline}"
    )
    yield (
        f"of the configuration / of {comparison.baseline}: entries of one only; mean age of the entries in pairs; "
        "share of the frames without a list, as the newest is older than max_age_s (these count in gospa_held_m); "
        "entries whose object has no truth at the frame (in no error)"
    )


def held_cells(comparison: Comparison) -> pd.DataFrame:
    """What `position_rmse_held_m` is over, as one row of text per configuration; no rows: it is not compared."""
    overall = comparison.overall
    rows = overall[(overall["metric"] == "position_rmse_held_m") & overall["frames"].notna()]
    columns: dict[str, list[str]] = {"configuration": list(rows["configuration"])}
    columns["pairs"], columns["frames"] = ([str(count) for count in rows[name]] for name in ("n", "frames"))
    for header, names, shown in (
        ("listed by one only", ("only_configuration", "only_baseline"), str),
        ("mean age, s", ("age_s", "baseline_age_s"), "{:.3f}".format),  # to the millisecond, so that pairs align
        ("no list", ("no_list_share", "baseline_no_list_share"), lambda share: f"{100 * share:.3g} %"),
        ("no truth", ("without_truth", "baseline_without_truth"), str),
    ):
        both = zip(*(rows[name] for name in names), strict=True)
        columns[header] = [" / ".join("–" if pd.isna(one) else shown(one) for one in sides) for sides in both]
    return pd.DataFrame(columns)


_HTML = {"&": "&amp;", "<": "&lt;", ">": "&gt;"}
_MARKDOWN = re.compile(r"[\\`*~|$]|(?<![^\W_])_|_(?![^\W_])|!(?=\[)|\](?=[(\[])|:(?=//)")
"""Characters with a meaning in Markdown anywhere; `_` only at the edge of a word, `]` only before a target."""


def escape_markdown(text: str) -> str:
    """Text on one line, escaped so that Markdown and its HTML show it unchanged."""
    html = re.sub("[&<>]", lambda match: _HTML[match[0]], escape_unprintable(text))
    return _MARKDOWN.sub(r"\\\g<0>", html)


def _describe_intervals(overall: pd.DataFrame) -> Iterator[str]:
    """Lines that explain cells without the usual interval: exact limits, all pairs alike, or runs that do not vary."""
    kinds = {kind: list(dict.fromkeys(of["metric"])) for kind, of in overall.groupby("interval", sort=False)}
    if EXACT in kinds:
        yield f"{', '.join(kinds[EXACT])}: exact binomial limits where the difference is the same in every cluster"
    if ALL_ALIKE in kinds:
        yield (
            f"({_WITHOUT[ALL_ALIKE]}): no interval, the difference is the same in every cluster (of a median in "
            "nearly all)"
        )
    if NOTHING_DRAWN in kinds:
        yield f"({_WITHOUT[NOTHING_DRAWN]}): every run is the same, so an interval over runs has no meaning"
