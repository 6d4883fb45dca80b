"""The figure of distances: how far away the object was when it was detected, every row a point.

After the paper's figure of all runs (Piazzoni et al. 2022): pass and fail told apart. Points of nearly one distance are
spread across the strip, as wide as there are many of them, those that fail below those that pass.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.text import counted
from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.tally import CONFLICT, DETECTED
from copem_replay.report.figures.captions import list_rates, percent, short_names, study
from copem_replay.report.figures.strips import FAIL, KINDS, MOST, NEUTRAL, PASS, Strip, counts, kinds
from copem_replay.report.figures.style import (
    FAINT,
    INK,
    Appearance,
    add_note,
    appearances,
    new_figure,
    of_configuration,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results

_COLUMNS = {DETECTED: "distance_at_detection_m", CONFLICT: "distance_at_conflict_detection_m"}
_WORDS = {DETECTED: "Distance at detection (m)", CONFLICT: "Distance when the collision is foreseen (m)"}
_NEVER = {DETECTED: "never\ndetected", CONFLICT: "never\nforeseen"}

_HALF = 0.38
"""Half the height of a strip's points, in strips (chosen)."""
_BINS = 150
_FEW, _MANY = 600, 4000
"""Points of a panel up to which they are large, and from which they are one picture in the SVG (chosen)."""


def distances_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Distance at detection of all rows, a strip per configuration; a second panel where collisions are foreseen."""
    names, braking = results.chosen(configurations), results.experiment.braking
    tally = results.tally[results.tally["configuration"].isin(names)]
    events = [event for event in _COLUMNS if (tally["event"] == event).any()]
    known = tally[tally["event"] == DETECTED]
    top_m = float(np.nanmax(tally["distance_at_detection_m"].to_numpy(dtype=float), initial=1.0))
    # A driver that brakes for the one event has no verdict at the distance of the other.
    judged = None if braking is None else CONFLICT if braking.brakes_for == "conflict" else DETECTED
    strips = {
        (event, name): Strip.of(
            tally[(tally["event"] == event) & (tally["configuration"] == name)], top_m / _BINS, judged=event == judged
        )
        for event in events
        for name in names
    }
    points = _placed(results, strips)
    with style():
        figure = new_figure(1.6 + 4.4 * len(events) + 0.6, 1.5 + 0.5 * len(names))
        panels = figure.subplots(1, len(events), sharex=True, sharey=True, squeeze=False)[0]
        looks = appearances(tuple(results.experiment.configurations))
        for axes, event in zip(panels, events, strict=True):
            mine = {name: (strips[event, name], points[event, name]) for name in names}
            _panel(axes, event, mine, looks, int(known["runs"].sum()), top_m)
        _strips(panels, names, known)
        if braking is not None:
            many = counts(known).sum(axis=0)
            _legend(figure, [kind for kind in (PASS, FAIL, NEUTRAL) if many[KINDS.index(kind)]])
        most = max(int(strip.count.sum(axis=1).max()) for strip in strips.values())
        lost = sum(strip.lost for strip in strips.values())
        add_note(
            figure,
            [
                study(results, names),
                list_rates(results.summary, names),
                _braking(results),
                "A point is one object in one run; from centre to centre",
                f"Of more than {MOST} points at nearly one distance {MOST} are drawn" if most > MOST else "",
                f"Without a point: {counted(lost, 'detection')} while the truth has a gap" if lost else "",
            ],
        )
    return figure


def distances_about(results: Results) -> list[str]:
    """Paragraphs on what is drawn."""
    braking = results.experiment.braking
    about = [
        "How far apart the centres of object and reference are in truth at the instant of detection, every row a "
        "point. Farther is earlier only while the two approach each other."
    ]
    if (results.tally["event"] == CONFLICT).any():
        about.append("Distance when the collision is foreseen: the same at the first list that implies a collision.")
    if braking is not None:
        what = "the detection" if braking.brakes_for == "object" else "the list that implies a collision"
        about.append(
            f"A row passes if the ego, braking as its declared driver does after {what}, stays more than "
            f"{braking.margin_m:g} m away. Rows without detection have no point, but are judged like all others in "
            "conflict: the share that passes counts them."
        )
    return about


@dataclass(frozen=True)
class _Points:
    """Of a strip those that are drawn: how far away, where across, of which of KINDS; (n,) each."""

    distance_m: Float
    across: Float
    kind: Int


def _placed(results: Results, strips: Mapping[tuple[str, str], Strip]) -> dict[tuple[str, str], _Points]:
    """The points of strips by event and configuration, log by log."""
    parts: dict[tuple[str, str], list[tuple[Float, Float, Int]]] = {key: [] for key in strips}
    before = {key: np.zeros_like(strip.count) for key, strip in strips.items()}
    for rows in results.each("configuration", *_COLUMNS.values(), "conflict", "braking_pass"):
        for key, strip in strips.items():
            mine = rows[(rows["configuration"] == key[1]) & rows[_COLUMNS[key[0]]].notna()]
            distance_m = mine[_COLUMNS[key[0]]].to_numpy(dtype=float)
            kind = kinds(mine) if strip.judged else np.full(len(mine), KINDS.index(NEUTRAL))
            across, drawn = strip.place(distance_m, kind, before[key])
            parts[key].append((distance_m[drawn], across[drawn], kind[drawn]))
    return {key: _Points(*map(np.concatenate, zip(*of, strict=True))) for key, of in parts.items()}


def _panel(
    axes: Axes,
    event: str,
    strips: Mapping[str, tuple[Strip, _Points]],
    looks: dict[str, Appearance],
    count: int,
    top_m: float,
) -> None:
    """Draw one panel; `count`: rows in all."""
    for k, (name, (strip, points)) in enumerate(strips.items()):
        with of_configuration(list(looks).index(name), axes):
            _points(axes, points, k, looks[name], name, count, strip.judged)
            colour = INK if strip.never else FAINT
            axes.text(-0.07 * top_m, k, f"{strip.never}", ha="center", va="center_baseline", color=colour)
    axes.axvspan(-0.14 * top_m, 0, color="0.95", zorder=0)
    axes.text(-0.07 * top_m, -0.62, _NEVER[event], ha="center", va="bottom", fontsize=7, color="0.3")
    axes.set_xlim(-0.14 * top_m, 1.04 * top_m)
    axes.set_xticks([tick for tick in axes.get_xticks() if 0 <= tick <= 1.04 * top_m])
    axes.set_xlabel(_WORDS[event])


def _points(axes: Axes, points: _Points, place: int, look: Appearance, name: str, count: int, judged: bool) -> None:
    size, alpha = (14.0, 0.8) if count <= _FEW else (8.0, 0.6)
    own: dict[str, Any] = {"marker": "o", "color": look.colour, "s": size}
    grey: dict[str, Any] = {"marker": "s", "color": "0.65", "s": 0.6 * size}
    markers = {NEUTRAL: grey if judged else own, PASS: own, FAIL: {"marker": "x", "color": "black", "s": 1.4 * size}}
    for verdict, marker in markers.items():
        chosen = points.kind == KINDS.index(verdict)
        if not chosen.any():
            continue
        where = points.distance_m[chosen], (place - _HALF * points.across)[chosen]
        drawn: dict[str, Any] = {"linewidths": 0.8 if verdict == FAIL else 0, "rasterized": count > _MANY} | marker
        if marker is own and look.edge != look.colour:  # around all of them, not each: they lie close together
            outline = {"color": look.edge, "s": (size**0.5 + 1.2) ** 2, "label": "_outline"}
            axes.scatter(*where, zorder=1.9, **(drawn | outline))
            drawn["alpha"] = 1.0
        if verdict == FAIL and drawn["rasterized"]:  # black in a picture, which stays so on a dark page
            halo = {"color": "white", "linewidths": 2.4, "label": "_halo", "zorder": 1.95}
            axes.scatter(*where, **(drawn | halo))
        label = f"{name}: {verdict}"
        axes.scatter(*where, label=label, zorder=2, **({"alpha": alpha} | drawn))


def _strips(panels: Sequence[Axes], names: Sequence[str], known: pd.DataFrame) -> None:
    short = short_names(names)
    axes = panels[0]
    axes.set_yticks(range(len(names)), [short[name] for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    for panel in panels:
        panel.grid(visible=False, axis="y")
        panel.tick_params(axis="y", length=0)
        for k in range(1, len(names)):
            panel.axhline(k - 0.5, color="0.85", linewidth=0.6, zorder=0.5)
    if "in_conflict" not in known:
        return
    for k, name in enumerate(names):
        failed, _, passed = counts(known[known["configuration"] == name]).sum(axis=0).tolist()
        share = percent(passed / (passed + failed)) if passed + failed else "–"
        panels[-1].text(1.02, k, share, transform=panels[-1].get_yaxis_transform(), ha="left", va="center_baseline")
    panels[-1].text(
        1.02, -0.62, "pass", transform=panels[-1].get_yaxis_transform(), fontsize=7, color="0.3", va="bottom"
    )


def _legend(figure: Figure, shown: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    looks: dict[str, dict[str, Any]] = {
        PASS: {"marker": "o", "markerfacecolor": "white", "markeredgecolor": INK, "markersize": 5},
        FAIL: {"marker": "x", "markeredgecolor": "black", "markersize": 5},
        NEUTRAL: {"marker": "s", "markerfacecolor": "0.7", "markeredgecolor": "0.55", "markersize": 4},
    }
    words = {PASS: "passes (in the configuration's colour)", FAIL: "fails", NEUTRAL: "not in conflict"}
    handles = [Line2D([], [], linestyle="none", **looks[kind]) for kind in shown]
    figure.legend(
        handles, [words[kind] for kind in shown], loc="outside upper center", ncols=len(shown), columnspacing=1.5
    )


def _braking(results: Results) -> str:
    braking = results.experiment.braking
    if braking is None:
        return ""
    what = "knows of the object" if braking.brakes_for == "object" else "foresees the collision"
    return (
        f"Passes: the ego, which brakes as its declared driver does when it {what}, stays more than "
        f"{braking.margin_m:g} m away; at the right the share of the rows in conflict"
    )
