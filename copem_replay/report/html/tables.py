"""The summary and the regret as tables, with what their columns mean.

Cells have three significant digits; `data-value` holds the number of `summary.csv`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.core.text import counted
from copem_replay.metrics.metric import RowMetric, own_metrics
from copem_replay.metrics.summary_metrics import METRIC, METRICS, PARTS
from copem_replay.metrics.summary_text import intervals_said
from copem_replay.report.figures.captions import plain
from copem_replay.report.figures.differences import excludes_0
from copem_replay.report.html.headers import (
    difference,
    difference_header,
    header,
    in_order,
    number,
    signed_difference,
    without_unit,
)
from copem_replay.report.html.markup import Html, breakable, folded, joined, listed, table, tag
from copem_replay.report.html.swatches import swatch
from copem_replay.results.compare.metrics import METRICS as COMPARED
from copem_replay.results.compare.tables import comparison_lines, without_interval

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_INTERVALS = {"detected_share": "interval", "pass_share": "pass_interval"}
"""Columns that have limits, and where it is said of which kind."""
_COUNTS = {"n": ("row", "rows"), "n_conflict": ("row in conflict", "rows in conflict")}
_ONCE = (*_COUNTS, "list_rate_hz")
"""Columns that are said once below a table where they are the same for all."""


@dataclass(frozen=True)
class Part:
    """Columns of `summary.csv` that are shown together, and what they mean."""

    id: str
    caption: str
    columns: dict[str, str]


def _parts(own: Sequence[RowMetric]) -> list[Part]:
    metrics = (*METRICS, *own_metrics(own))
    return [Part(id_, caption, {m.name: m.help for m in metrics if m.part == id_}) for id_, caption in PARTS.items()]


def summary_tables(study: Study) -> Html:
    """What `summary.csv` says, in parts of which each fits on a page."""
    rows = study.results.summary
    parts = []
    for part in _parts(study.results.experiment.measure.metrics):
        there = {name: says for name, says in part.columns.items() if name in rows and rows[name].notna().any()}
        once = [name for name in there if name in _ONCE and rows[name].nunique(dropna=False) == 1]
        columns = {name: there[name] for name in in_order(list(there)) if name not in once}
        wanted = part.id != "braking" or "pass_share" in columns
        if columns and wanted:
            below = [*_once(rows, once), *_interval(study, part, columns)]
            parts += [_table(study, part, columns), *(tag("p", line, class_="below") for line in below)]
            parts.append(folded("What the columns mean", _meanings(columns.items())))
    return joined(parts)


def _once(rows: pd.DataFrame, names: Sequence[str]) -> list[str]:
    """Columns that are the same for all: `500 rows, 10 fused lists per second for each configuration.`"""
    said = [counted(int(rows[name].iloc[0]), noun, many) for name, (noun, many) in _COUNTS.items() if name in names]
    said += [f"{plain(float(rows[name].iloc[0]))} {header(name)}" for name in names if name not in _COUNTS]
    return [f"{', '.join(said)} for each configuration."] if said else []


def _table(study: Study, part: Part, columns: dict[str, str]) -> Html:
    rows = []
    for row in study.results.summary.to_dict("records"):
        cells = [_cell(row, name) for name in columns]
        rows.append(tag("tr", named(study, str(row["configuration"])), *cells, data_row=str(row["configuration"])))
    return table(["configuration", *map(header, columns)], rows, caption=part.caption, id_=part.id)


def named(study: Study, name: str) -> Html:
    """The head of a configuration's row."""
    return tag("th", tag("span", swatch(study.looks[name]), tag("span", breakable(name)), class_="named"), scope="row")


def _cell(row: dict[str, Any], name: str) -> Html:
    value = float("nan") if pd.isna(row[name]) else float(row[name])
    parts = [Html(number(name, value))]
    low, high = (row.get(f"{name}_{end}") if name in _INTERVALS else None for end in ("low", "high"))
    if low is not None and high is not None and pd.notna(low) and pd.notna(high):
        parts.append(interval(number(name, float(low)), number(name, float(high))))
    return tag("td", *parts, data_column=name, data_value=full(row[name]), data_low=full(low), data_high=full(high))


def interval(low: str, high: str) -> Html:
    """Limits, below their figure where that is narrower."""
    return joined([" ", tag("span", f"[{low}, {high}]", class_="interval")])


def full(value: Any) -> str | None:
    """A number as `summary.csv` has it; None: there is none."""
    return f"{value:.9g}" if value is not None and pd.notna(value) else None


def _interval(study: Study, part: Part, columns: Iterable[str]) -> list[str]:
    rows = study.results.summary
    said = []
    for of in (name for name in columns if name in _INTERVALS):
        lines = intervals_said(rows, _INTERVALS[of])
        none = ["no interval: too few logs and objects; additional runs say nothing about other traffic"]
        words = [line.replace("95 %: ", "95 % ").replace("no 95 % of", "no 95 % interval of") for line in lines or none]
        said += [_sentence(f"{without_unit(of)}: {line}") for line in words]
    horizon = rows["ttd_rmst_horizon_s"].dropna() if "ttd_rmst_s" in columns else pd.Series(dtype=float)
    if len(horizon):
        said.append(f"In means an object that is never detected counts as {plain(float(horizon.iloc[0]))} s.")
    return said


def _meanings(columns: Iterable[tuple[str, str]], names: Any = header) -> Html:
    terms = [
        part for name, says in columns for part in (tag("dt", names(name)), tag("dd", says, " ", tag("code", name)))
    ]
    return tag("dl", *terms)


_WORDS = {name: METRIC[name].compared for name in COMPARED if name in METRIC} | {
    "ttd_rmst_s_equal_ghosts": "the same at as many false positives per minute as the baseline has",
}


_LISTS = ("position_rmse_m", "gospa_m", "false_positives_per_min")
"""Differences in a table of their own, so that both fit on a page."""


def regret_table(study: Study) -> Html:
    """Each configuration minus the baseline, as `copem-replay compare` has it; or why there is none."""
    regret = study.regret
    if regret is None:
        why = "no object is measured" if study.best is None else "there is one configuration only"
        return tag("p", f"No differences: {why}.")
    rows = {(row.configuration, row.metric): row for row in regret.overall.itertuples(index=False)}
    metrics = in_order([m for m in COMPARED if any((name, m) in rows for name in regret.configurations)])
    words = [(m, f"{_WORDS[m]}; {'more' if COMPARED[m] > 0 else 'less'} is better") for m in metrics]
    tables = []
    for id_, what, there in (
        ("regret", "", [m for m in metrics if m not in _LISTS]),
        ("regret-lists", ", of the lists", [m for m in metrics if m in _LISTS]),
    ):
        lines = [
            tag("tr", named(study, name), *(_difference(rows.get((name, m)), m) for m in there), data_row=name)
            for name in regret.configurations
        ]
        head = ["configuration", *map(difference_header, there)]
        tables += [table(head, lines, caption=f"Differences to {regret.baseline}{what}", id_=id_)] if there else []
    return joined(
        [
            *tables,
            tag("p", "Bold: the interval excludes 0.", class_="below"),
            folded(
                "What the columns mean, and how they are made",
                _meanings(words, difference_header),
                listed(_sentence(line) for line in comparison_lines(regret) if not line.startswith("*")),
            ),
        ]
    )


def baseline_words(study: Study) -> Html:
    """What the baseline is, and why it is this one."""
    if study.baseline is None:
        return Html()
    if study.baseline == "ideal":
        return tag("p", "Each configuration minus the ideal fusion: the regret. It is a baseline, not a bound.")
    by_default = study.baseline == study.contenders[0] and "ideal" not in study.names
    why = (
        "No configuration is named ideal, so this is the first that is not the ground truth; --baseline of "
        "copem-replay report chooses another."
        if by_default
        else "It is chosen with --baseline, or the only one to compare with."
    )
    return tag("p", "Each configuration minus ", tag("b", study.baseline), f". {why}")


def _difference(row: Any, metric: str) -> Html:
    if row is None or pd.isna(row.difference):
        return tag("td", "–", data_column=metric)
    limits = row.low, row.high
    shown: list[str] = [signed_difference(metric, row.difference)]
    if excludes_0(row):
        shown = [tag("b", *shown)]
    if pd.notna(row.interval_over):
        shown.append(interval(*("–" if pd.isna(limit) else difference(metric, limit) for limit in limits)))
    shown += [f" ({why})" for why in without_interval(row)]
    low, high = map(full, limits)
    return tag("td", *shown, data_column=metric, data_value=full(row.difference), data_low=low, data_high=high)


_METRIC_NAMES = re.compile("|".join(rf"\b{name}\b" for name in sorted(COMPARED, key=len, reverse=True)))


def _sentence(line: str) -> str:
    """A line of the comparison with its columns as they are called on the page."""
    line = _METRIC_NAMES.sub(lambda found: without_unit(found[0]), line)
    return f"{line[:1].upper()}{line[1:]}."
