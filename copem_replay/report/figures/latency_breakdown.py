"""Figure of stages: how the time from the onset to the detection is spent, on average.

| stage | from | to |
|---|---|---|
| out of range or view, hidden, in sight | the onset | the first list that has the object (`listed_s`) |
| listed | first list | the newest capture that contributed to knowing (`captured_s`) |
| processing | capture | the instant at which that list is ready to be sent (`sent_s`) |
| transport | ready | its arrival (`arrived_s`): captured plus latency without a link and `ready` |
| fusion | arrival | the fused list with which it is known (`detection_s`) |

Means are over the detected rows, so that stages add up. Until it is listed, an object is out of range or view of all of
the configuration's units, or hidden from those that have it in view (`out_of_view_s`, `hidden_s`), or in sight. Only
the newest capture of a confirmation is known, so the time of a confirmation, and that in which another unit's list of
the object is on its way, belong to *listed* where the instants of lists on their way are known (`WAY` in
`metrics/detections_table.py`), and to *in sight* elsewhere.

Without these instants, ideal fusion and the truth know an object from the list that brings it (one hit): all time from
the capture on is transport. Otherwise transport is the latency if all units have one latency; if not, transport and
fusion are one stage, *since captured*. The first three stages are one, *until captured*, if it is unknown what units
have in sight: for the truth, and for recorded units without `views`. With `count_earlier` times may be negative, and
the figure is not drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.tracks import TRUTH, Float
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.detections_table import WAY
from copem_replay.pipeline.expansion import ConfigurationFacts, find_facts
from copem_replay.report.figures.style import (
    add_note,
    choose_appearances,
    describe_results,
    figure_style,
    format_share,
    mark_configuration,
    new_figure,
    shorten_names,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


_SIGHT = ("out_of_view_s", "hidden_s")
_INSTANTS = ("onset_s", *_SIGHT, *WAY, "captured_s", "detection_s")
OUT_OF_VIEW, HIDDEN, IN_SIGHT = "out of range or view", "hidden", "in sight"
UNTIL_CAPTURED, LISTED = "until captured", "listed"
PROCESSING, TRANSPORT, FUSION, SINCE_CAPTURED = "processing", "transport", "fusion", "since captured"
STAGES = {
    OUT_OF_VIEW: "from the start of the clock until its first list: out of range or view of all of the configuration's "
    "units",
    HIDDEN: "in that time: within range and view of a unit, and hidden from all that have it there",
    IN_SIGHT: "the rest of that time: missed by the perception, between two lists, and, where it is not known when it "
    "was first listed, not yet confirmed, or in a list that was still on its way",
    UNTIL_CAPTURED: "from the start of the clock until that capture, where it is not known when the object was in "
    "sight: the truth needs no sight, and recorded units tell by their `views` alone",
    LISTED: "where lists come by a link, or of units with ready or sends, the last part of that time: from the capture "
    "of the first list that has the object, which was not sent, lost, overtaken, still on its way, not enough to "
    "confirm it, or taken in together with a newer one",
    PROCESSING: "how long the unit works on that list until it is ready to be sent, or what is recorded is stamped",
    TRANSPORT: "from there until it arrives: the delay of the link, queue and all, and the latency; where there is "
    "neither link nor ready, all that the experiment says of making the message and sending it",
    FUSION: "from its arrival until the fused list with which the object was known: confirming it, or waiting for the "
    "next instant of issue_hz",
    SINCE_CAPTURED: "from that capture until then, where it is not known how much of it is transport: units have "
    "different latencies, or recorded ones",
}
_UNTIL_LISTED, _ONLY_IF_ANY = (OUT_OF_VIEW, HIDDEN, IN_SIGHT), (OUT_OF_VIEW, LISTED, PROCESSING)
HATCHES = {
    OUT_OF_VIEW: ("#ffffff", "", "#000000"),
    HIDDEN: ("#d9d9d9", "", "#000000"),
    IN_SIGHT: ("#8c8c8c", "///", "#ffffff"),
    UNTIL_CAPTURED: ("#ffffff", "///", "#8c8c8c"),
    LISTED: ("#d9d9d9", "\\\\\\", "#404040"),
    PROCESSING: ("#ffffff", "|||", "#404040"),
    TRANSPORT: ("#404040", "", "#000000"),
    FUSION: ("#ffffff", "...", "#000000"),
    SINCE_CAPTURED: ("#6e6e6e", "xxx", "#ffffff"),
}
"""Fill, hatch and colour of the hatch by stage."""


def mean_stages_by_configuration(results: Results, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Mean duration (s) of each stage, by configuration."""
    sums: dict[str, dict[str, float]] = {name: {} for name in names}
    for rows in results.each("configuration", "detected", *_INSTANTS):
        for name, so_far in sums.items():
            of_name = rows[rows["configuration"] == name]
            for stage, sum_s in _sum_stages(of_name, results.experiment, name, results.facts[name]).items():
                so_far[stage] = so_far.get(stage, 0.0) + sum_s
    return {name: _divide_sums(sum_s) for name, sum_s in sums.items()}


def count_detected(results: Results) -> dict[str, tuple[int, int]]:
    """Numbers of rows with detection and of all rows, by configuration."""
    rows = results.known
    detected = rows["runs"].where(rows["time_to_detection_s"].notna(), 0).groupby(rows["configuration"]).sum()
    counted = rows["runs"].groupby(rows["configuration"]).sum()
    return {name: (int(detected[name]), int(counted[name])) for name in results.experiment.configurations}


def no_stages(results: Results, names: Sequence[str]) -> str | None:
    """The reason why the figure cannot be drawn; None if it can."""
    if results.experiment.measure.count_earlier:
        return "with count_earlier an object may be known before the clock starts"
    detected = count_detected(results)
    return None if any(detected[name][0] for name in names) else "nothing was detected"


def latency_breakdown_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Mean duration of the stages from the onset to the detection, a bar per configuration."""
    names = results.chosen(configurations)
    means, detected = mean_stages_by_configuration(results, names), count_detected(results)
    looks, short = choose_appearances(results), shorten_names(names)
    with figure_style():
        figure = new_figure(8.0, 1.3 + 0.3 * len(names))
        axes = figure.subplots()
        longest_s = max(sum(means_of_name.values()) for means_of_name in means.values())
        for k, name in enumerate(names):
            with mark_configuration(list(looks).index(name), axes):
                _draw_bar(axes, k, means[name], looks[name].colour)
                label = _label_bar(sum(means[name].values()), *detected[name])
                axes.text(sum(means[name].values()) + 0.008 * longest_s, k, label, va="center_baseline")
        axes.set_yticks(range(len(names)), [short[name] for name in names])
        axes.tick_params(axis="y", length=0, pad=10)
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_xlim(0, 1.3 * longest_s or 1.0)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("Mean time (s)")
        stages = [stage for stage in STAGES if any(stage in means_of_name for means_of_name in means.values())]
        _add_legend(figure, stages)
        note = [describe_results(results, names), "Means over the rows that are detected"]
        add_note(figure, [*note, *(["Listed: not sent, lost or late"] if LISTED in stages else [])])
    return figure


def _draw_bar(axes: Axes, place: int, means: dict[str, float], colour: tuple[float, float, float]) -> None:
    """Draw the stages of one configuration in a row, after a tick of its colour."""
    style: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "clip_on": False, "label": "_colour"}
    axes.plot([-0.008, -0.008], [place - 0.35, place + 0.35], color=colour, linewidth=5, solid_capstyle="butt", **style)
    begin_s = 0.0
    for stage, mean_s in ((stage, means[stage]) for stage in STAGES if stage in means):
        fill, hatch, ink = HATCHES[stage]
        axes.barh(place, mean_s, 0.7, begin_s, color=fill, edgecolor=ink, hatch=hatch, linewidth=0, label=stage)
        axes.barh(place, mean_s, 0.7, begin_s, fill=False, edgecolor="#404040", linewidth=0.7, label="_edge")
        begin_s += mean_s


def _add_legend(figure: Figure, stages: Sequence[str]) -> None:
    from matplotlib.patches import Patch

    handles = []
    for stage in stages:
        fill, hatch, ink = HATCHES[stage]
        patch = Patch(facecolor=fill, edgecolor=ink if hatch else "#404040", hatch=hatch, linewidth=0.4)
        handles.append(patch)
    figure.legend(handles, list(stages), loc="outside upper center", ncols=len(stages), columnspacing=1.5)


def mean_stages(rows: pd.DataFrame, experiment: Experiment, name: str) -> dict[str, float]:
    """Mean duration (s) of each known stage over rows of a configuration; empty without a detection."""
    return _divide_sums(_sum_stages(rows, experiment, name, find_facts(experiment)[name]))


def _divide_sums(sums: Mapping[str, float]) -> dict[str, float]:
    """Means from sums over rows, whose number is under ""; empty without a detection."""
    sums = dict(sums)
    count = sums.pop("", 0.0)
    if IN_SIGHT in sums and UNTIL_CAPTURED in sums:  # logs of which it is known, and others
        sums = {UNTIL_CAPTURED: sum(sums.pop(stage, 0.0) for stage in (*_UNTIL_LISTED, UNTIL_CAPTURED))} | sums
    # Rounded to a nanosecond: in floats 3.9 − 3 is not 0.9.
    means = {stage: float(np.round(sum_s / count, 9)) + 0.0 for stage, sum_s in sums.items()}
    return {stage: mean_s for stage, mean_s in means.items() if mean_s or stage not in _ONLY_IF_ANY}


def _sum_stages(rows: pd.DataFrame, experiment: Experiment, name: str, facts: ConfigurationFacts) -> dict[str, float]:
    """Sums (s) of each stage over detected rows, and the number of rows under ""; sums of logs can be added."""
    rows = rows[rows["detected"].astype(bool) & rows["captured_s"].notna()]
    if not len(rows):
        return {}
    onset_s, captured_s, known_s = (rows[c].to_numpy(dtype=float) for c in ("onset_s", "captured_s", "detection_s"))
    stage_s = {}
    out_of_view_s, hidden_s, listed_s, sent_s, arrived_s = (
        rows[c].to_numpy(dtype=float) if c in rows else np.full(len(rows), np.nan) for c in (*_SIGHT, *WAY)
    )
    listed_s = np.fmin(listed_s, captured_s)
    if np.isnan(hidden_s).any():
        stage_s[UNTIL_CAPTURED] = listed_s - onset_s
    else:
        in_sight_s = listed_s - onset_s - out_of_view_s - hidden_s
        stage_s |= {OUT_OF_VIEW: out_of_view_s, HIDDEN: hidden_s, IN_SIGHT: in_sight_s}
    if experiment.has_way(name):
        arrived_s = np.fmin(arrived_s, known_s)
        sent_s = np.fmin(sent_s, arrived_s)
        stage_s |= {LISTED: captured_s - listed_s, PROCESSING: sent_s - captured_s}
        stage_s |= {TRANSPORT: arrived_s - sent_s, FUSION: known_s - arrived_s}
    else:
        stage_s |= _stages_since_capture(known_s - captured_s, experiment, name, facts)
    return {"": float(len(rows))} | {stage: float(values.sum()) for stage, values in stage_s.items()}


def _stages_since_capture(
    delay_s: Float, experiment: Experiment, name: str, facts: ConfigurationFacts
) -> dict[str, Float]:
    """The stages (s) after the capture, without times of the way: transport and fusion where they can be told apart."""
    units = experiment.units_of(experiment.configurations[name])
    if facts.by_truth_id and experiment.measure.confirm.hits == 1:
        return {TRANSPORT: delay_s, FUSION: np.zeros_like(delay_s)}
    latency_s = {experiment.delay_of(name, unit) for unit in units or (TRUTH,)}
    fixed_s = latency_s.pop() if len(latency_s) == 1 else None
    if facts.recorded or fixed_s is None or any(unit in experiment.recorded for unit in units):
        return {SINCE_CAPTURED: delay_s}
    transport_s = np.minimum(delay_s, fixed_s)
    return {TRANSPORT: transport_s, FUSION: delay_s - transport_s}


def _label_bar(total_s: float, detected: int, rows: int) -> str:
    if not detected:
        return " never known"
    return f" {total_s:.2f} s" + ("" if detected == rows else f", {format_share(detected / rows)} known")
