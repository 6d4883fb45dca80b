"""The figure of distances: how far away the object was when it was detected, every row a point.

After the paper's figure of all runs (Piazzoni et al. 2022): pass and fail told apart. Points of nearly one distance are
spread across the strip, as wide as there are many of them, those that fail below those that pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.text import counted
from copem_replay.core.tracks import Bool, Float
from copem_replay.report.figures.captions import list_rates, percent, short_names, study
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

_OBJECT, _CONFLICT = "distance_at_detection_m", "distance_at_conflict_detection_m"
_WORDS = {_OBJECT: "Distance at detection (m)", _CONFLICT: "Distance when the collision is foreseen (m)"}
_NEVER = {_OBJECT: "never\ndetected", _CONFLICT: "never\nforeseen"}
_KNOWN = {_OBJECT: "detected", _CONFLICT: "conflict_detected"}

PASS, FAIL, NEUTRAL = "passes", "fails", "not in conflict"
_HALF = 0.38
"""Half the height of a strip's points, in strips (chosen)."""
_BINS = 150
_FEW, _MANY = 600, 4000
"""Points of a panel up to which they are large, and from which they are one picture in the SVG (chosen)."""


def distances_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Distance at detection of all rows, a strip per configuration; a second panel where collisions are foreseen."""
    names = results.chosen(configurations)
    table = results.table[results.table["configuration"].isin(names)]
    columns = [name for name in (_OBJECT, _CONFLICT) if name in table]
    with style():
        figure = new_figure(1.6 + 4.4 * len(columns) + 0.6, 1.5 + 0.5 * len(names))
        panels = figure.subplots(1, len(columns), sharex=True, sharey=True, squeeze=False)[0]
        looks = appearances(tuple(results.experiment.configurations))
        braking = results.experiment.braking
        braked_for = _CONFLICT if braking is not None and braking.brakes_for == "conflict" else _OBJECT
        lost = sum(
            _panel(axes, table, column, names, looks, "conflict" in table and column == braked_for)
            for axes, column in zip(panels, columns, strict=True)
        )
        _strips(panels, names, table)
        shown = [kind for kind in (PASS, FAIL, NEUTRAL) if (verdicts(table) == kind).any()]
        if "conflict" in table and len(shown):
            _legend(figure, shown)
        add_note(
            figure,
            [
                study(results, names),
                list_rates(results.summary, names),
                _braking(results),
                "A point is one object in one run; from centre to centre",
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
    if _CONFLICT in results.table:
        about.append("Distance when the collision is foreseen: the same at the first list that implies a collision.")
    if braking is not None:
        what = "the detection" if braking.brakes_for == "object" else "the list that implies a collision"
        about.append(
            f"A row passes if the ego, braking as its declared driver does after {what}, stays more than "
            f"{braking.margin_m:g} m away. Rows without detection have no point, but are judged like all others in "
            "conflict: the share that passes counts them."
        )
    return about


def verdicts(table: pd.DataFrame) -> pd.Series:
    """Of each row (n,): PASS, FAIL, or NEUTRAL where there is no conflict to judge."""
    if "conflict" not in table:
        return pd.Series(NEUTRAL, index=table.index)
    conflict, passed = (table[name].fillna(False).astype(bool) for name in ("conflict", "braking_pass"))
    return pd.Series(np.where(~conflict, NEUTRAL, np.where(passed, PASS, FAIL)), index=table.index)


def spread(distance_m: Float, verdict: Sequence[str], width_m: float) -> Float:
    """Where across the strip each point lies (n,), −1 … 1: those of a bin evenly, as wide as there are many.

    Of a bin the failures come first, then what is not in conflict, then what passes. `width_m`: of a bin.
    """
    order = np.array([(FAIL, NEUTRAL, PASS).index(kind) for kind in verdict], dtype=np.int64)
    cell = np.floor(distance_m / width_m + 0.5).astype(np.int64)
    ranked = np.lexsort((np.arange(len(cell)), order, cell))
    _, first, count = np.unique(cell[ranked], return_index=True, return_counts=True)
    rank = np.arange(len(cell)) - np.repeat(first, count)
    many = np.repeat(count, count)
    result = np.empty(len(cell))
    result[ranked] = (2 * (rank + 0.5) / many - 1) * many / max(count.max(initial=1), 1)
    return result


def _panel(
    axes: Axes, table: pd.DataFrame, column: str, names: Sequence[str], looks: dict[str, Appearance], judged: bool
) -> int:
    """Draw one panel; returns how many rows were known of but have no distance."""
    top_m = float(np.nanmax(table[[c for c in _WORDS if c in table]].to_numpy(dtype=float), initial=1.0))
    lost = 0
    for k, name in enumerate(names):
        rows = table[table["configuration"] == name]
        known = rows[_KNOWN[column]].to_numpy(dtype=bool)
        distance_m = rows[column].to_numpy(dtype=float)
        placed = known & ~np.isnan(distance_m)
        lost += int((known & ~placed).sum())
        # A driver that brakes for the one event has no verdict at the distance of the other.
        kind = verdicts(rows).to_numpy() if judged else np.full(len(rows), NEUTRAL, dtype=object)
        across = k - _HALF * spread(distance_m[placed], list(kind[placed]), top_m / _BINS)
        never = int((~known).sum())
        with of_configuration(list(looks).index(name), axes):
            _points(axes, distance_m[placed], across, kind[placed], looks[name], name, len(table), judged)
            axes.text(-0.07 * top_m, k, f"{never}", ha="center", va="center_baseline", color=INK if never else FAINT)
    axes.axvspan(-0.14 * top_m, 0, color="0.95", zorder=0)
    axes.text(-0.07 * top_m, -0.62, _NEVER[column], ha="center", va="bottom", fontsize=7, color="0.3")
    axes.set_xlim(-0.14 * top_m, 1.04 * top_m)
    axes.set_xticks([tick for tick in axes.get_xticks() if 0 <= tick <= 1.04 * top_m])
    axes.set_xlabel(_WORDS[column])
    return lost


def _points(
    axes: Axes, distance_m: Float, across: Float, kind: Any, look: Appearance, name: str, count: int, judged: bool
) -> None:
    size, alpha = (14.0, 0.8) if count <= _FEW else (8.0, 0.6)
    own: dict[str, Any] = {"marker": "o", "color": look.colour, "s": size}
    grey: dict[str, Any] = {"marker": "s", "color": "0.65", "s": 0.6 * size}
    markers = {NEUTRAL: grey if judged else own, PASS: own, FAIL: {"marker": "x", "color": "black", "s": 1.4 * size}}
    for verdict, marker in markers.items():
        chosen: Bool = kind == verdict
        if not chosen.any():
            continue
        points: dict[str, Any] = {"linewidths": 0.8 if verdict == FAIL else 0, "rasterized": count > _MANY} | marker
        if marker is own and look.edge != look.colour:  # around all of them, not each: they lie close together
            outline = {"color": look.edge, "s": (size**0.5 + 1.2) ** 2, "label": "_outline"}
            axes.scatter(distance_m[chosen], across[chosen], zorder=1.9, **(points | outline))
            points["alpha"] = 1.0
        if verdict == FAIL and points["rasterized"]:  # black in a picture, which stays so on a dark page
            halo = {"color": "white", "linewidths": 2.4, "label": "_halo", "zorder": 1.95}
            axes.scatter(distance_m[chosen], across[chosen], **(points | halo))
        label = f"{name}: {verdict}"
        axes.scatter(distance_m[chosen], across[chosen], label=label, zorder=2, **({"alpha": alpha} | points))


def _strips(panels: Sequence[Axes], names: Sequence[str], table: pd.DataFrame) -> None:
    short = short_names(names)
    axes = panels[0]
    axes.set_yticks(range(len(names)), [short[name] for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    for panel in panels:
        panel.grid(visible=False, axis="y")
        panel.tick_params(axis="y", length=0)
        for k in range(1, len(names)):
            panel.axhline(k - 0.5, color="0.85", linewidth=0.6, zorder=0.5)
    if "conflict" not in table:
        return
    kinds = verdicts(table)
    for k, name in enumerate(names):
        mine = kinds[table["configuration"] == name]
        judged = mine[mine != NEUTRAL]
        share = percent(float((judged == PASS).mean())) if len(judged) else "–"
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
