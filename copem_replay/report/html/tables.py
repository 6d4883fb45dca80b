"""The summary and the regret as tables, with what their columns mean.

Cells are rounded as in the terminal; `data-value` holds the number of `summary.csv`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pandas as pd

from copem_replay.metrics.metric import RowMetric, own_metrics
from copem_replay.metrics.summary_metrics import METRIC, METRICS, PARTS
from copem_replay.metrics.summary_text import cell, intervals_said
from copem_replay.report.html.markup import Html, breakable, joined, listed, table, tag
from copem_replay.report.html.swatches import swatch
from copem_replay.results.compare.metrics import METRICS as COMPARED
from copem_replay.results.compare.tables import comparison_lines, plain, signed, without_interval

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_COUNTS = ("n", "n_conflict")
_INTERVALS = {"detected_share": "interval", "pass_share": "pass_interval"}
"""Columns that have limits, and where it is said of which kind."""


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
        columns = {name: says for name, says in part.columns.items() if name in rows and rows[name].notna().any()}
        wanted = part.id != "braking" or "pass_share" in columns
        if columns and wanted:
            parts += [_table(study, part, columns), _meanings(columns.items()), _interval(study, part, columns)]
    horizon = rows["ttd_rmst_horizon_s"].dropna() if "ttd_rmst_horizon_s" in rows else pd.Series()
    if len(horizon):
        parts.append(tag("p", f"The horizon of mean times is {cell(float(horizon.iloc[0]))} s."))
    return joined(parts)


def _table(study: Study, part: Part, columns: dict[str, str]) -> Html:
    rows = []
    for row in study.results.summary.to_dict("records"):
        cells = [_cell(row, name) for name in columns]
        rows.append(tag("tr", named(study, str(row["configuration"])), *cells, data_row=str(row["configuration"])))
    return table(["configuration", *columns], rows, caption=part.caption, id_=part.id)


def named(study: Study, name: str) -> Html:
    """The head of a configuration's row."""
    return tag("th", tag("span", swatch(study.looks[name]), tag("span", breakable(name)), class_="named"), scope="row")


def _cell(row: dict[str, Any], name: str) -> Html:
    value = row[name]
    parts = [Html(cell(int(value) if name in _COUNTS and pd.notna(value) else float(value)))]
    low, high = (row.get(f"{name}_{end}") if name in _INTERVALS else None for end in ("low", "high"))
    if low is not None and high is not None and pd.notna(low) and pd.notna(high):
        parts.append(interval(cell(float(low)), cell(float(high))))
    return tag("td", *parts, data_column=name, data_value=full(value), data_low=full(low), data_high=full(high))


def interval(low: str, high: str) -> Html:
    """Limits, below their figure where that is narrower."""
    return joined([" ", tag("span", f"[{low}, {high}]", class_="interval")])


def full(value: Any) -> str | None:
    """A number as `summary.csv` has it; None: there is none."""
    return f"{value:.9g}" if value is not None and pd.notna(value) else None


def _interval(study: Study, part: Part, columns: Iterable[str]) -> Html:
    of = next((name for name in columns if name in _INTERVALS), None)
    if of is None:
        return Html()
    if said := intervals_said(study.results.summary, _INTERVALS[of]):
        return joined(tag("p", f"{of}, {line}.") for line in said)
    return tag("p", f"No interval of {of}: too few logs and objects, and more runs do not tell about other traffic.")


def _meanings(columns: Iterable[tuple[str, str]]) -> Html:
    terms = [part for name, says in columns for part in (tag("dt", tag("code", name)), tag("dd", says))]
    return tag("dl", *terms)


_WORDS = {name: METRIC[name].compared for name in COMPARED if name in METRIC} | {
    "ttd_rmst_s_equal_ghosts": "the same at as many ghosts per minute as asked for",
}


def regret_table(study: Study) -> Html:
    """Each configuration minus the baseline, as `copem-replay compare` has it; or why there is none."""
    regret = study.regret
    if regret is None:
        why = "nobody was measured" if study.best is None else "there is one configuration only"
        return tag("p", f"No differences: {why}.")
    rows = {(row.configuration, row.metric): row for row in regret.overall.itertuples(index=False)}
    metrics = [m for m in COMPARED if any((name, m) in rows for name in regret.configurations)]
    lines = [
        tag("tr", named(study, name), *(_difference(rows.get((name, m)), m) for m in metrics), data_row=name)
        for name in regret.configurations
    ]
    words = [(m, f"{_WORDS[m]}; {'more' if COMPARED[m] > 0 else 'less'} is better") for m in metrics]
    return joined(
        [
            tag("p", *_baseline(study)),
            table(["configuration", *metrics], lines, caption=f"Differences to {regret.baseline}", id_="regret"),
            _meanings(words),
            listed(_sentence(line) for line in comparison_lines(regret)),
        ]
    )


def _baseline(study: Study) -> Sequence[str]:
    assert study.baseline is not None
    if study.baseline == "ideal":
        return ("Each configuration minus the ideal fusion: the regret. It is a baseline, not a bound.",)
    by_default = study.baseline == study.contenders[0] and "ideal" not in study.names
    why = (
        "None is named ideal, so this is the first that is not the truth; --baseline of copem-replay report chooses "
        "another."
        if by_default
        else "It was chosen with --baseline, or is the only one to compare with."
    )
    return ("Each configuration minus ", tag("b", study.baseline), f". {why}")


def _difference(row: Any, metric: str) -> Html:
    if row is None or pd.isna(row.difference):
        return tag("td", "–", data_column=metric)
    limits = row.low, row.high
    shown = [signed(row.difference)]
    if pd.notna(row.interval_over):
        shown.append(interval(*("–" if pd.isna(limit) else plain(limit) for limit in limits)))
    shown += [f" ({why})" for why in without_interval(row)]
    low, high = map(full, limits)
    return tag("td", *shown, data_column=metric, data_value=full(row.difference), data_low=low, data_high=high)


def _sentence(line: str) -> str:
    first = line.partition(" ")[0]
    return (line if "_" in first else line[:1].upper() + line[1:]) + "."
