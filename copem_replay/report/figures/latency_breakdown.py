"""The figure of stages: where the time from the clock's start to the detection goes.

| stage | from | to |
|---|---|---|
| hidden | the onset | the first list of any of the configuration's units in which it is in sight (`in_sight_s`) |
| in sight | there | the first list that has the object (`listed_s`) |
| listed | there | the newest capture that contributed to knowing (`captured_s`) |
| processing | there | when that list was ready to be sent (`sent_s`) |
| transport | there | its arrival (`arrived_s`): captured plus latency where there is neither link nor `ready` |
| fusion | there | the fused list with which it was known (`detection_s`) |

Means over the rows that were detected, so that stages add up. An object listed while no unit had it in sight was hidden
until it was listed. Of a confirmation only the newest capture is known: what it takes is spent *in sight*, as is the
time in which another unit's list of the object is still on its way; `listed` where lists have a way that is told
(`metrics/way.py`). Where they have not, ideal fusion and the truth know from the list that brings it (one hit): all
from its capture on is transport, nothing fusion. Otherwise transport is the latency, where all units have the same;
else the two stages are one. So are the first two where it is not known when it was in sight: the truth needs no sight,
and recorded units don't tell. With `count_earlier` times may be negative, and nothing is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.tracks import TRUTH, Float
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.way import WAY
from copem_replay.pipeline.receiver import by_truth
from copem_replay.report.figures.captions import percent, short_names, study
from copem_replay.report.figures.style import add_note, appearances, new_figure, of_configuration, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results

_INSTANTS = ("onset_s", "in_sight_s", *WAY, "captured_s", "detection_s")
HIDDEN, IN_SIGHT, UNTIL_CAPTURED, LISTED = "hidden", "in sight", "until captured", "listed"
PROCESSING, TRANSPORT, FUSION, SINCE_CAPTURED = "processing", "transport", "fusion", "since captured"
STAGES = {
    HIDDEN: "from the start of the clock until any of the configuration's units has it in sight in a list it makes",
    IN_SIGHT: "from there until the capture of the newest list that contributed to knowing it: out of range, missed by "
    "the perception, between two lists, not yet confirmed, or listed by a unit whose list was still on its way",
    UNTIL_CAPTURED: "from the start of the clock until that capture, where it is not known when the object was in "
    "sight: the truth needs no sight, and recorded units do not tell",
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
HATCHES = {
    HIDDEN: ("#d9d9d9", "", "#000000"),
    IN_SIGHT: ("#8c8c8c", "///", "#ffffff"),
    UNTIL_CAPTURED: ("#ffffff", "///", "#8c8c8c"),
    LISTED: ("#d9d9d9", "\\\\\\", "#404040"),
    PROCESSING: ("#ffffff", "|||", "#404040"),
    TRANSPORT: ("#404040", "", "#000000"),
    FUSION: ("#ffffff", "...", "#000000"),
    SINCE_CAPTURED: ("#6e6e6e", "xxx", "#ffffff"),
}
"""Of each stage its fill, and the hatch on it with its colour."""


def stages_of(results: Results, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """By configuration the mean seconds of each stage."""
    sums: dict[str, dict[str, float]] = {name: {} for name in names}
    for rows in results.each("configuration", "detected", *_INSTANTS):
        for name, so_far in sums.items():
            for stage, of in _sums(rows[rows["configuration"] == name], results.experiment, name).items():
                so_far[stage] = so_far.get(stage, 0.0) + of
    return {name: _means(of) for name, of in sums.items()}


def how_many(results: Results) -> dict[str, tuple[int, int]]:
    """Of each configuration in how many rows the object is detected, and how many rows there are."""
    known = results.known
    detected = known["runs"].where(known["time_to_detection_s"].notna(), 0).groupby(known["configuration"]).sum()
    every = known["runs"].groupby(known["configuration"]).sum()
    return {name: (int(detected[name]), int(every[name])) for name in results.experiment.configurations}


def no_stages(results: Results, names: Sequence[str]) -> str | None:
    """The reason why nothing can be drawn; None: it can."""
    if results.experiment.measure.count_earlier:
        return "with count_earlier an object may be known before the clock starts"
    detected = how_many(results)
    return None if any(detected[name][0] for name in names) else "nothing was detected"


def latency_breakdown_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Mean duration of the stages from the onset to the detection, a bar per configuration."""
    names = results.chosen(configurations)
    means, known = stages_of(results, names), how_many(results)
    looks, short = appearances(tuple(results.experiment.configurations)), short_names(names)
    with style():
        figure = new_figure(8.0, 1.3 + 0.3 * len(names))
        axes = figure.subplots()
        longest_s = max(sum(of.values()) for of in means.values())
        for k, name in enumerate(names):
            with of_configuration(list(looks).index(name), axes):
                _bar(axes, k, means[name], looks[name].colour)
                said = _beside(sum(means[name].values()), *known[name])
                axes.text(sum(means[name].values()) + 0.008 * longest_s, k, said, va="center_baseline")
        axes.set_yticks(range(len(names)), [short[name] for name in names])
        axes.tick_params(axis="y", length=0, pad=10)
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_xlim(0, 1.3 * longest_s or 1.0)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("Mean time (s)")
        there = [stage for stage in STAGES if any(stage in of for of in means.values())]
        _legend(figure, there)
        note = [study(results, names), "Means over the rows that are detected"]
        add_note(figure, [*note, *(["Listed: not sent, lost or late"] if LISTED in there else [])])
    return figure


def _bar(axes: Axes, place: int, means: dict[str, float], colour: tuple[float, float, float]) -> None:
    """The stages of one configuration one after the other, after a tick of its colour."""
    beside: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "clip_on": False, "label": "_colour"}
    axes.plot(
        [-0.008, -0.008], [place - 0.35, place + 0.35], color=colour, linewidth=5, solid_capstyle="butt", **beside
    )
    begin_s = 0.0
    for stage, mean_s in ((stage, means[stage]) for stage in STAGES if stage in means):
        fill, hatch, ink = HATCHES[stage]
        axes.barh(place, mean_s, 0.7, begin_s, color=fill, edgecolor=ink, hatch=hatch, linewidth=0, label=stage)
        axes.barh(place, mean_s, 0.7, begin_s, fill=False, edgecolor="#404040", linewidth=0.7, label="_edge")
        begin_s += mean_s


def _legend(figure: Figure, there: Sequence[str]) -> None:
    from matplotlib.patches import Patch

    handles = []
    for stage in there:
        fill, hatch, ink = HATCHES[stage]
        patch = Patch(facecolor=fill, edgecolor=ink if hatch else "#404040", hatch=hatch, linewidth=0.4)
        handles.append(patch)
    figure.legend(handles, list(there), loc="outside upper center", ncols=len(there), columnspacing=1.5)


def stages(rows: pd.DataFrame, experiment: Experiment, name: str) -> dict[str, float]:
    """Mean seconds of each stage that is known of a configuration's rows; empty where none was detected."""
    return _means(_sums(rows, experiment, name))


def _means(sums: Mapping[str, float]) -> dict[str, float]:
    """Of sums over the rows, and their number under "" (none: nothing was detected)."""
    sums = dict(sums)
    count = sums.pop("", 0.0)
    if HIDDEN in sums and UNTIL_CAPTURED in sums:  # in some logs in sight, in others never until it was listed
        sums[HIDDEN] += sums.pop(UNTIL_CAPTURED)
    # To a nanosecond: 3.9 − 3 is not 0.9.
    means = {stage: float(np.round(of / count, 9)) + 0.0 for stage, of in sums.items()}
    return {stage: mean_s for stage, mean_s in means.items() if mean_s or stage not in (LISTED, PROCESSING)}


def _sums(rows: pd.DataFrame, experiment: Experiment, name: str) -> dict[str, float]:
    """Of some rows; of one log and another they add up."""
    rows = rows[rows["detected"].astype(bool) & rows["captured_s"].notna()]
    if not len(rows):
        return {}
    onset_s, captured_s, known_s = (rows[c].to_numpy(dtype=float) for c in ("onset_s", "captured_s", "detection_s"))
    result = {}
    sight_s, listed_s, sent_s, arrived_s = (
        rows[c].to_numpy(dtype=float) if c in rows else np.full(len(rows), np.nan) for c in ("in_sight_s", *WAY)
    )
    listed_s = np.fmin(listed_s, captured_s)
    if np.isnan(sight_s).all():
        result[UNTIL_CAPTURED] = listed_s - onset_s
    else:
        seen_s = np.fmin(sight_s, listed_s)
        result |= {HIDDEN: seen_s - onset_s, IN_SIGHT: listed_s - seen_s}
    if experiment.has_way(name):
        arrived_s = np.fmin(arrived_s, known_s)
        sent_s = np.fmin(sent_s, arrived_s)
        result |= {LISTED: captured_s - listed_s, PROCESSING: sent_s - captured_s}
        result |= {TRANSPORT: arrived_s - sent_s, FUSION: known_s - arrived_s}
    else:
        result |= _since_captured(known_s - captured_s, experiment, name)
    return {"": float(len(rows))} | {stage: float(values.sum()) for stage, values in result.items()}


def _since_captured(delay_s: Float, experiment: Experiment, name: str) -> dict[str, Float]:
    configuration = experiment.configurations[name]
    units = experiment.units_of(configuration)
    by_id = by_truth(configuration) and not experiment.measure.match.always
    if by_id and experiment.measure.confirm.hits == 1:
        return {TRANSPORT: delay_s, FUSION: np.zeros_like(delay_s)}
    latency_s = {experiment.delay_of(name, unit) for unit in units or (TRUTH,)}
    fixed_s = latency_s.pop() if len(latency_s) == 1 else None
    recorded = configuration.recorded is not None
    if recorded or fixed_s is None or any(unit in experiment.recorded for unit in units):
        return {SINCE_CAPTURED: delay_s}
    transport_s = np.minimum(delay_s, fixed_s)
    return {TRANSPORT: transport_s, FUSION: delay_s - transport_s}


def _beside(total_s: float, detected: int, rows: int) -> str:
    if not detected:
        return " never known"
    return f" {total_s:.3g} s" + ("" if detected == rows else f", {percent(detected / rows)} known")
