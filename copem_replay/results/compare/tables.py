"""A comparison as text: for a terminal, as Markdown, as CSV. Nothing is cut off."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.errors import OutputError, printable
from copem_replay.core.files import atomic_file
from copem_replay.core.text import wrapped
from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.summary_text import as_text
from copem_replay.results.belongings import list_made
from copem_replay.results.compare.limits import ALL_ALIKE
from copem_replay.results.compare.metrics import METRICS

if TYPE_CHECKING:
    from copem_replay.results.compare.compare import Comparison

_SUFFIXES = (".csv", ".md")
_RESULTS = ("summary.csv", "sweep.csv", "bands.csv")
NOTHING = 1e-9
"""Closer to 0 than this is 0 (chosen: below what any of the metrics is measured with)."""
APART = "*"
"""Marks a difference whose interval excludes 0."""
_WITHOUT = {ALL_ALIKE: "all alike", NOTHING_DRAWN: NOTHING_DRAWN}
"""How it is said in a cell that there is no interval, and why."""


def comparison_text(comparison: Comparison, width: int | None = None) -> str:
    """A row per configuration, a column per metric, and what they are; for a terminal of a width, or a pipe."""
    lines = (part for line in comparison_lines(comparison) for part in wrapped(line, width))
    return "\n".join([as_text(_cells(comparison), width), *lines])


def comparison_markdown(comparison: Comparison) -> str:
    """The same as a Markdown table, the lines after it and the notes as a list; ends with a newline."""
    cells = _cells(comparison)
    notes = (f"note: {note}" for note in comparison.notes)
    rows = [list(cells.columns), ["---"] * len(cells.columns), *cells.itertuples(index=False)]
    lines = ["| " + " | ".join(in_markdown(str(cell)) for cell in row) + " |" for row in rows]
    return "\n".join([*lines, "", *(f"- {in_markdown(line)}" for line in (*comparison_lines(comparison), *notes)), ""])


def check_out(path: Path) -> None:
    """Raise OutputError where a comparison cannot be written as what the file's name says."""
    if path.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"{path}: expected a name that ends with {' or '.join(_SUFFIXES)}, found {path.name}")
    if path.name in _RESULTS and (path.parent / "provenance.json").exists():
        raise OutputError(f"{path}: expected another name, found that of a table of the results in that folder")


def write_comparison(comparison: Comparison, path: Path, folders: Sequence[Path] = ()) -> None:
    """Write CSV (a row per log, configuration and metric) or a Markdown table, as the name says. Raises OutputError.

    `folders`: of the results that are compared.
    """
    from copem_replay.results.write import write_csv

    check_out(path)
    with atomic_file(path) as scratch:
        if path.suffix.lower() == ".csv":
            write_csv(comparison.table, scratch)
        else:
            scratch.write_text(comparison_markdown(comparison), encoding="utf-8")
        for folder in folders:
            list_made(folder, [path])


def _cells(comparison: Comparison) -> pd.DataFrame:
    rows = {(row.configuration, row.metric): row for row in comparison.overall.itertuples(index=False)}
    metrics = [metric for metric in METRICS if any((name, metric) in rows for name in comparison.configurations)]
    columns: dict[str, list[str]] = {"configuration": list(comparison.configurations)}
    for metric in metrics:
        columns[metric] = [_cell(rows.get((name, metric))) for name in comparison.configurations]
    return pd.DataFrame(columns)


def _cell(row: Any) -> str:
    """`+0.12 [0.05, 0.2] *`; `+0.12 (all alike)`; a dash where there is no difference."""
    if row is None or pd.isna(row.difference):
        return "–"
    if pd.isna(row.interval_over):
        return " ".join([signed(row.difference), *(f"({why})" for why in without_interval(row))])
    low, high = ("–" if pd.isna(limit) else plain(limit) for limit in (row.low, row.high))
    return f"{signed(row.difference)} [{low}, {high}]{f' {APART}' if _excludes_0(row.low, row.high) else ''}"


def _excludes_0(low: float, high: float) -> bool:
    """Whether an interval tells a difference from none."""
    return bool(low > NOTHING or high < -NOTHING)


def without_interval(row: Any) -> list[str]:
    """Why a difference has no interval, in a word or two; nothing where it has one, or where clusters are too few."""
    return [_WITHOUT[row.interval]] if row.interval in _WITHOUT else []


def signed(value: float) -> str:
    """A difference to three significant digits, with its sign."""
    return "±0" if abs(value) < NOTHING else ("+" if value > 0 else "") + plain(value)


def plain(value: float) -> str:
    """A limit to three significant digits."""
    return "0" if abs(value) < NOTHING else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def comparison_lines(comparison: Comparison) -> Iterator[str]:
    """What the table shows, and which are better than the baseline."""
    overall = comparison.overall
    shown = set(overall["metric"])
    yield f"differences to {comparison.baseline}, paired by log, object and run; accuracy at instants that both have"
    over = overall.dropna(subset="interval_over").groupby("interval_over", sort=False)["metric"].unique()
    kinds = [kind if len(over) == 1 else f"{kind} ({', '.join(metrics)})" for kind, metrics in over.items()]
    if kinds:
        yield f"[95 %]: bootstrap interval over {'; '.join(kinds)}"
    if any(_excludes_0(low, high) for low, high in zip(overall["low"], overall["high"], strict=True)):
        yield f"{APART}: the interval excludes 0"
    yield from _on_intervals(overall)
    yield (
        f"ttd_rmst_s: mean time to detection up to {comparison.horizon_s:.4g} s, never detected counting as that; "
        "objects still there at the end are censored"
    )
    if "ttd_rmst_s_equal_ghosts" in shown:
        yield (
            "ttd_rmst_s_equal_ghosts: the same mean by match (also for ideal fusion and the truth), with the least "
            f"certain entries of each left out until {comparison.false_positives_per_min:.4g} ghosts per minute "
            "remain, not counting stale ones"
        )
    for metric, better in METRICS.items():
        of = overall[overall["metric"] == metric]
        beyond = of["low"] > NOTHING if better > 0 else of["high"] < -NOTHING
        if beyond.any():
            names = ", ".join(of.loc[beyond, "configuration"])
            yield f"better than {comparison.baseline} in {metric}, the interval excluding 0: {names}"


_HTML = {"&": "&amp;", "<": "&lt;", ">": "&gt;"}
_MARKDOWN = re.compile(r"[\\`*~|$]|(?<![^\W_])_|_(?![^\W_])|!(?=\[)|\](?=[(\[])|:(?=//)")
"""What begins something in Markdown wherever it stands; `_` only at the edge of a word, `]` only before a target."""


def in_markdown(text: str) -> str:
    """Text that reads as itself, on one line, in Markdown and in the HTML that it becomes."""
    html = re.sub("[&<>]", lambda found: _HTML[found[0]], printable(text))
    return _MARKDOWN.sub(r"\\\g<0>", html)


def _on_intervals(overall: pd.DataFrame) -> Iterator[str]:
    """Which differences have other intervals, or none, because there is nothing to resample."""
    kinds = {kind: list(dict.fromkeys(of["metric"])) for kind, of in overall.groupby("interval", sort=False)}
    if "exact" in kinds:
        yield (
            f"{', '.join(kinds['exact'])}: exact binomial limits where the difference is the same in every cluster, "
            "because all resamples are then the same"
        )
    if ALL_ALIKE in kinds:
        yield (
            f"({_WITHOUT[ALL_ALIKE]}): the difference is the same in every cluster, or a median in nearly all, so how "
            "it varies is not known"
        )
    if NOTHING_DRAWN in kinds:
        yield f"({_WITHOUT[NOTHING_DRAWN]}): every run is the same, so an interval over runs has no meaning"
