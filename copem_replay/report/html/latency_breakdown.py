"""The stages of the latency in words and numbers, below their figure (`report/figures/latency_breakdown.py`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from copem_replay.report.figures.captions import plain
from copem_replay.report.figures.latency_breakdown import STAGES, how_many, stages_of
from copem_replay.report.html.markup import Html, folded, joined, table, tag
from copem_replay.report.html.tables import full, named

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study


def stage_table(study: Study) -> Html:
    """What the stages are, and their means."""
    means = stages_of(study.results, study.names)
    there = [stage for stage in STAGES if any(stage in of for of in means.values())]
    known = how_many(study.results)
    about = (
        "Means over the rows in which the object is detected; how many these are, where not all, is beside the bar. "
        "Rows without detection have no stages, so bars of configurations that miss many objects are over other rows, "
        "and their sum is not the mean time to detection."
    )
    terms = [part for stage in there for part in (tag("dt", stage), tag("dd", STAGES[stage]))]
    below = folded("What the stages are", tag("dl", *terms))
    return joined([tag("p", about), _table(study, means, there, known), below])


def _table(
    study: Study, means: dict[str, dict[str, float]], there: list[str], known: dict[str, tuple[int, int]]
) -> Html:
    rows = []
    for name in study.names:
        figures = [*(means[name].get(stage) for stage in there), sum(means[name].values()) if means[name] else None]
        cells = [
            tag("td", "–" if value is None else plain(value), data_column=stage, data_value=full(value) or "")
            for stage, value in zip([*there, "sum"], figures, strict=True)
        ]
        counted = tag("td", f"{known[name][0]} of {known[name][1]}", data_column="detected")
        rows.append(tag("tr", named(study, name), counted, *cells, data_row=name))
    head = ["configuration", "known", *there, "sum"]
    return table(head, rows, caption="Mean duration of the stages, in seconds", id_="stages")
