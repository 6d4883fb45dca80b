"""The waterfall: where the time from the clock's start to knowing goes, stage by stage.

| stage | from | to |
|---|---|---|
| hidden | the onset | the first list of any of the configuration's units in which it is in sight (`in_sight_s`) |
| in sight | there | the newest capture that contributed to knowing (`captured_s`) |
| transport | there | the arrival of that list: captured plus latency |
| fusion | there | the fused list with which it was known (`detection_s`) |

Means over the rows that were detected, so that stages add up. An object listed while nobody had it in sight was hidden
until it was listed. Of a confirmation only the newest capture is known: what it takes is spent *in sight*, as is the
time in which another unit's list of the object is still on its way. Ideal fusion and the truth know from the list that
brings it (one hit): all from its capture on is transport, nothing fusion. Otherwise transport is the latency, where all
units have the same; else the two stages are one. So are the first two where it is not known when it was in sight: the
truth needs no sight, and recorded units don't tell. With `count_earlier` times may be negative, and nothing is drawn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Float
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.summary_text import cell
from copem_replay.pipeline.receiver import by_truth
from copem_replay.report.figures.captions import percent, short_names
from copem_replay.report.html.markup import Html, joined, table, tag
from copem_replay.report.html.plotly_figures import FAINT, Drawn, axis, box, label, layout, numbers, place, rgb
from copem_replay.report.html.tables import named

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

HIDDEN, IN_SIGHT, UNTIL_CAPTURED = "hidden", "in sight", "until captured"
TRANSPORT, FUSION, SINCE_CAPTURED = "transport", "fusion", "since captured"
STAGES = {
    HIDDEN: "from the start of the clock until any of the configuration's units has it in sight in a list it makes",
    IN_SIGHT: "from there until the capture of the newest list that contributed to knowing it: out of range, missed by "
    "the perception, between two lists, not yet confirmed, or listed by a unit whose list was still on its way",
    UNTIL_CAPTURED: "from the start of the clock until that capture, where it is not known when the object was in "
    "sight: the truth needs no sight, and recorded units do not tell",
    TRANSPORT: "the latency of that list: making the message and sending it, of which the experiment says one number",
    FUSION: "from its arrival until the fused list with which the object was known",
    SINCE_CAPTURED: "from that capture until then, where it is not known how much of it is transport: units have "
    "different latencies, or recorded ones",
}
_FILLS = {
    HIDDEN: ("#d9d9d9", "", ""),
    IN_SIGHT: ("#8c8c8c", "/", "white"),
    UNTIL_CAPTURED: ("white", "/", "#8c8c8c"),
    TRANSPORT: ("#404040", "", ""),
    FUSION: ("white", ".", "black"),
    SINCE_CAPTURED: ("#6e6e6e", "x", "white"),
}
"""Of each stage its fill, and the pattern on it with its colour."""
_MARKS = {
    "": "",
    "/": "M1 8L8 1M1 14L14 1M7 13L13 7",
    ".": "M3 4h2M9 4h2M3 10h2M9 10h2",
    "x": "M1 1L13 13M13 1L1 13M1 7L7 13M7 1L13 7M7 1L1 7M13 7L7 13",
}
_ROW_PX = 30


def waterfall(study: Study) -> tuple[Html, list[Drawn]]:
    """The section, and its figure; in its place the reason why there is none."""
    results = study.results
    if results.experiment.measure.count_earlier:
        return tag("p", "No waterfall: with count_earlier an object may be known before the clock starts."), []
    by_name = {name: results.table[results.table["configuration"] == name] for name in study.names}
    means = {name: stages(rows, results.experiment, name) for name, rows in by_name.items()}
    if not any(means.values()):
        return tag("p", "No waterfall: nothing was detected."), []
    there = [stage for stage in STAGES if any(stage in of for of in means.values())]
    known = {name: (int(rows["detected"].sum()), len(rows)) for name, rows in by_name.items()}
    said = (
        "Where the time goes, on the average over the looks in which the object became known; how many that is, where "
        "not all, is beside the bar. Those that never did have no stages, so bars of configurations that miss many are "
        "not about the same looks, and their sum is not ttd_rmst_s."
    )
    terms = [part for stage in there for part in (tag("dt", _box(stage), stage), tag("dd", STAGES[stage]))]
    parts = [
        tag("p", said),
        place("waterfall", "mean duration of the stages from the start of the clock to knowing, by configuration"),
        tag("dl", *terms),
        _table(study, means, there, known),
    ]
    return joined(parts), [_figure(study, means, there, known)]


def stages(rows: pd.DataFrame, experiment: Experiment, name: str) -> dict[str, float]:
    """Mean seconds of each stage that is known of a configuration's rows; empty where none was detected."""
    rows = rows[rows["detected"].astype(bool) & rows["captured_s"].notna()]
    if not len(rows):
        return {}
    onset_s, captured_s, known_s = (rows[c].to_numpy(dtype=float) for c in ("onset_s", "captured_s", "detection_s"))
    result = {}
    sight_s = rows["in_sight_s"].to_numpy(dtype=float) if "in_sight_s" in rows else np.full(len(rows), np.nan)
    if np.isnan(sight_s).all():
        result[UNTIL_CAPTURED] = captured_s - onset_s
    else:
        seen_s = np.fmin(sight_s, captured_s)
        result |= {HIDDEN: seen_s - onset_s, IN_SIGHT: captured_s - seen_s}
    result |= _since_captured(known_s - captured_s, experiment, name)
    # To a nanosecond: 3.9 − 3 is not 0.9.
    return {stage: float(np.round(values.mean(), 9)) + 0.0 for stage, values in result.items()}


def _since_captured(delay_s: Float, experiment: Experiment, name: str) -> dict[str, Float]:
    configuration = experiment.configurations[name]
    units = experiment.units_of(configuration)
    by_id = by_truth(configuration) and not experiment.measure.match.always
    if by_id and experiment.measure.confirm.hits == 1:
        return {TRANSPORT: delay_s, FUSION: np.zeros_like(delay_s)}
    latency_s = {configuration.latency_of(unit) for unit in units} or {configuration.latency_of("truth")}
    fixed_s = latency_s.pop() if len(latency_s) == 1 else None
    if fixed_s is None or any(unit in experiment.recorded for unit in units):
        return {SINCE_CAPTURED: delay_s}
    transport_s = np.minimum(delay_s, fixed_s)
    return {TRANSPORT: transport_s, FUSION: delay_s - transport_s}


def _figure(
    study: Study, means: dict[str, dict[str, float]], there: list[str], known: dict[str, tuple[int, int]]
) -> Drawn:
    short = short_names(study.names)
    rows = [
        f'<span style="color:{rgb(study.looks[name].colour)}">■</span> {label(short[name])} ' for name in study.names
    ]
    total = [sum(means[name].values()) for name in study.names]
    traces: list[Drawn] = [
        {
            "type": "bar",
            "orientation": "h",
            "name": stage,
            "y": rows,
            "x": numbers(np.array([means[name].get(stage, np.nan) for name in study.names]), 6),
            "marker": _marker(stage),
            "hovertemplate": "%{y}: %{x:.4~g} s " + stage + "<extra></extra>",
        }
        for stage in there
    ]
    text = [_beside(sum_s, *known[name]) for name, sum_s in zip(study.names, total, strict=True)]
    beside = {"type": "scatter", "mode": "text", "y": rows, "x": numbers(np.array(total), 6), "text": text}
    traces.append(beside | {"textposition": "middle right", "hoverinfo": "skip"})
    drawn = layout(
        64 + _ROW_PX * len(rows),
        axis("Mean time (s)", range=[0, round(1.3 * max(total), 5) or 1.0]),
        axis("", autorange="reversed", showgrid=False, ticks="", ticklabelstandoff=2, type="category"),
        barmode="stack",
        bargap=0.3,
    )
    drawn["margin"] = drawn["margin"] | {"l": 10}
    drawn["xaxis"]["linecolor"] = FAINT
    return {"id": "waterfall", "data": traces, "layout": drawn, "row": _ROW_PX}


def _marker(stage: str) -> Drawn:
    fill, shape, colour = _FILLS[stage]
    pattern = {"shape": shape, "fgcolor": colour, "bgcolor": fill, "solidity": 0.3, "size": 7}
    return {"color": fill, "line": {"color": "#404040", "width": 0.8}} | ({"pattern": pattern} if shape else {})


def _box(stage: str) -> Html:
    fill, shape, colour = _FILLS[stage]
    return box(fill, _MARKS[shape], colour)


def _beside(total_s: float, detected: int, rows: int) -> str:
    if not detected:
        return " never known"
    return f" {total_s:.3g} s" + ("" if detected == rows else f", {percent(detected / rows)} known")


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
