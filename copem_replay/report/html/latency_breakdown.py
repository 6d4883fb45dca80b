"""The stages of the latency in words and numbers, below their figure (`report/figures/latency_breakdown.py`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from copem_replay.metrics.summary_text import cell
from copem_replay.report.figures.latency_breakdown import HATCHES, STAGES, stages_of
from copem_replay.report.html.markup import Html, joined, table, tag
from copem_replay.report.html.swatches import box
from copem_replay.report.html.tables import named

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_MARKS = {
    "": "",
    "///": "M1 8L8 1M1 14L14 1M7 13L13 7",
    "...": "M3 4h2M9 4h2M3 10h2M9 10h2",
    "xxx": "M1 1L13 13M13 1L1 13M1 7L7 13M7 1L13 7M7 1L1 7M13 7L7 13",
}
"""Of each hatch what stands for it in a square of 14."""


def stage_table(study: Study) -> Html:
    """What the stages are, and their means."""
    table = study.results.table
    means = stages_of(study.results, study.names)
    there = [stage for stage in STAGES if any(stage in of for of in means.values())]
    rows = {name: table[table["configuration"] == name] for name in study.names}
    known = {name: (int(of["detected"].sum()), len(of)) for name, of in rows.items()}
    about = (
        "Where the time goes, on the average over the looks in which the object became known; how many that is, where "
        "not all, is beside the bar. Those that never did have no stages, so bars of configurations that miss many are "
        "not about the same looks, and their sum is not ttd_rmst_s."
    )
    terms = [part for stage in there for part in (tag("dt", _box(stage), stage), tag("dd", STAGES[stage]))]
    return joined([tag("p", about), tag("dl", *terms), _table(study, means, there, known)])


def _box(stage: str) -> Html:
    fill, hatch, ink = HATCHES[stage]
    return box(fill, _MARKS[hatch], ink)


def _table(
    study: Study, means: dict[str, dict[str, float]], there: list[str], known: dict[str, tuple[int, int]]
) -> Html:
    rows = []
    for name in study.names:
        figures = [*(means[name].get(stage) for stage in there), sum(means[name].values()) if means[name] else None]
        cells = [
            tag("td", cell(value), data_column=stage, data_value="" if value is None else f"{value:.9g}")
            for stage, value in zip([*there, "sum"], figures, strict=True)
        ]
        counted = tag("td", f"{known[name][0]} of {known[name][1]}", data_column="detected")
        rows.append(tag("tr", named(study, name), counted, *cells, data_row=name))
    head = ["configuration", "known", *there, "sum"]
    return table(head, rows, caption="Mean duration of the stages, in seconds", id_="stages")
