"""Figure of distances: distance at detection of every row as a point, in a strip per configuration.

After the figure of all runs in Piazzoni et al. 2022, which distinguishes pass and fail. Points of nearly one distance
lie side by side across the strip, over a width that grows with their number, failing ones below passing ones. The
counts come from the tally, so that points find their places log by log; of very many only some are drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError, count_noun
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.summary import CONFLICT, DETECTED
from copem_replay.report.figures.style import (
    FAINT,
    INK,
    Appearance,
    add_note,
    choose_appearances,
    describe_list_rates,
    describe_results,
    figure_style,
    format_share,
    mark_configuration,
    new_figure,
    shorten_names,
)
from copem_replay.results.table_files import AGAIN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from copem_replay.results.read import Results


# Strips.

KINDS = FAIL, NEUTRAL, PASS = "fails", "not in conflict", "passes"
"""Kinds of points in their order across a strip."""
MOST = 1000
"""Most points of a bin that are drawn: they cover their part of the strip ten times over."""


@dataclass(frozen=True)
class Strip:
    """Numbers of a configuration's points, `count` (bins, 3), by distance in bins of `width_m` and by kind.

    `judged`: whether kinds are distinguished. `never`, `lost`: rows without the event, and without a distance.
    """

    width_m: float
    count: Int
    judged: bool = True
    never: int = 0
    lost: int = 0

    @classmethod
    def of(cls, tally: pd.DataFrame, width_m: float, *, judged: bool) -> Strip:
        """The strip of a tally's rows of one event and configuration."""
        distance_m, runs = (tally[name].to_numpy() for name in ("distance_at_detection_m", "runs"))
        detected, placed = tally["time_to_detection_s"].notna().to_numpy(), ~np.isnan(distance_m)
        cell = _bin_distances(distance_m[placed], width_m)
        count = np.zeros((int(cell.max(initial=0)) + 1, len(KINDS)), dtype=np.int64)
        np.add.at(count, cell, count_kinds(tally if judged else tally[["runs"]])[placed])
        return cls(width_m, count, judged, int(runs[~detected].sum()), int(runs[detected & ~placed].sum()))

    def has(self, distance_m: Float, kind: Int) -> bool:
        """Whether rows (n,) are among those that the tally counts."""
        cell = _bin_distances(distance_m, self.width_m)
        return bool(cell.max(initial=0) < len(self.count) and self.count[cell, kind].all())

    def place(self, distance_m: Float, kind: Int, before: Int) -> tuple[Float, Bool]:
        """Places (n,) of points across the strip, −1 … 1, even within a bin; and (n,) which are drawn. `before`, as
        `count`: points placed before, to which these are added; `kind` (n,): indices into KINDS.
        """
        cell = _bin_distances(distance_m, self.width_m)
        ranked = np.lexsort((kind, cell))
        is_first = np.diff(len(KINDS) * cell[ranked] + kind[ranked], prepend=-1) != 0
        first = np.maximum.accumulate(np.where(is_first, np.arange(len(cell)), 0))
        rank = np.empty(len(cell), dtype=np.int64)
        rank[ranked] = np.arange(len(cell)) - first
        rank += (np.cumsum(self.count, axis=1) - self.count + before)[cell, kind]
        np.add.at(before, (cell, kind), 1)
        in_bin = self.count.sum(axis=1)
        across: Float = (2 * (rank + 0.5) / in_bin[cell] - 1) * in_bin[cell] / max(in_bin.max(), 1)
        drawn: Bool = rank * np.minimum(in_bin[cell], MOST) % in_bin[cell] < MOST
        return across, drawn


def count_kinds(tally: pd.DataFrame) -> Int:
    """(n, 3) numbers of rows by kind, in the order of KINDS, of each row of a tally."""
    runs = tally["runs"].to_numpy()
    if "in_conflict" not in tally:
        return np.stack([0 * runs, runs, 0 * runs], axis=1)
    conflict, passed = tally["in_conflict"].to_numpy(dtype=bool), tally["passed"].to_numpy()
    parts = conflict * (runs - passed), ~conflict * runs, conflict * passed
    return np.stack(parts, axis=1)


def row_kinds(rows: pd.DataFrame) -> Int:
    """(n,) the kind of each row of `detections.parquet`, as index into KINDS."""
    conflict, passed = (rows[name].fillna(False).to_numpy(dtype=bool) for name in ("conflict", "braking_pass"))
    return np.where(conflict, np.where(passed, KINDS.index(PASS), KINDS.index(FAIL)), KINDS.index(NEUTRAL))


def _bin_distances(distance_m: Float, width_m: float) -> Int:
    return np.floor(distance_m / width_m + 0.5).astype(np.int64)


_COLUMNS = {DETECTED: "distance_at_detection_m", CONFLICT: "distance_at_conflict_detection_m"}
_WORDS = {DETECTED: "Distance at detection (m)", CONFLICT: "Distance when the collision is foreseen (m)"}
_NEVER = {DETECTED: "never\ndetected", CONFLICT: "never\nforeseen"}

_HALF = 0.38
"""Half the height that points take of a strip, which leaves gaps between strips."""
_BINS = 150
"""Bins of the distance axis, each about as wide as a point."""
_FEW, _MANY = 600, 4000
"""Most points of a panel that are drawn large, and that are drawn one by one: more become a picture in the SVG."""


def distances_figure(results: Results, *, configurations: Sequence[str] | None = None) -> Figure:
    """Distance at detection of all rows, a strip per configuration; a second panel where collisions are foreseen."""
    names, braking = results.chosen(configurations), results.experiment.braking
    tally = results.counted(results.tally[results.tally["configuration"].isin(names)])
    events = [event for event in _COLUMNS if (tally["event"] == event).any()]
    detections = tally[tally["event"] == DETECTED]
    top_m = float(np.nanmax(tally["distance_at_detection_m"].to_numpy(dtype=float), initial=1.0))
    # A driver that brakes for one event has no verdict at the distance of the other.
    judged = None if braking is None else CONFLICT if braking.brakes_for == "conflict" else DETECTED
    strips = {
        (event, name): Strip.of(
            tally[(tally["event"] == event) & (tally["configuration"] == name)], top_m / _BINS, judged=event == judged
        )
        for event in events
        for name in names
    }
    points = _place_points(results, strips)
    with figure_style():
        figure = new_figure(1.6 + 4.4 * len(events) + 0.6, 1.5 + 0.5 * len(names))
        panels = figure.subplots(1, len(events), sharex=True, sharey=True, squeeze=False)[0]
        looks = choose_appearances(results)
        for axes, event in zip(panels, events, strict=True):
            panel_strips = {name: (strips[event, name], points[event, name]) for name in names}
            _draw_panel(axes, event, panel_strips, looks, int(detections["runs"].sum()), top_m)
        _build_strips(panels, names, detections)
        if braking is not None:
            by_kind = count_kinds(detections).sum(axis=0)
            _add_legend(figure, [kind for kind in (PASS, FAIL, NEUTRAL) if by_kind[KINDS.index(kind)]])
        fullest = max(int(strip.count.sum(axis=1).max()) for strip in strips.values())
        lost = sum(strip.lost for strip in strips.values())
        add_note(
            figure,
            [
                describe_results(results, names),
                describe_list_rates(results.summary, names),
                _describe_braking(results),
                "A point is one object in one run; from centre to centre",
                f"Of more than {MOST} points at nearly one distance {MOST} are drawn" if fullest > MOST else "",
                f"Without a point: {count_noun(lost, 'detection')} while the truth has a gap" if lost else "",
            ],
        )
    return figure


def distances_about(results: Results) -> list[str]:
    """Paragraphs of the report on this figure."""
    braking = results.experiment.braking
    about = [
        "How far apart the centres of object and reference are in truth at the instant of detection, every row a "
        "point. Farther is earlier only while the two approach each other."
    ]
    if (results.tally["event"] == CONFLICT).any():
        about.append("Distance when the collision is foreseen: the same at the first list that implies a collision.")
    if braking is not None:
        event = "the detection" if braking.brakes_for == "object" else "the list that implies a collision"
        about.append(
            f"A row passes if the ego, braking as its declared driver does after {event}, stays more than "
            f"{braking.margin_m:g} m away. Rows without detection have no point, but are judged like all others in "
            "conflict: the share that passes counts them."
        )
    return about


@dataclass(frozen=True)
class _Points:
    """Drawn points (n,) of a strip: distance, place across, and kind as index into KINDS."""

    distance_m: Float
    across: Float
    kind: Int


def _place_points(results: Results, strips: Mapping[tuple[str, str], Strip]) -> dict[tuple[str, str], _Points]:
    """The points of all strips by event and configuration, placed log by log. InputError: tally and rows differ."""
    parts: dict[tuple[str, str], list[tuple[Float, Float, Int]]] = {key: [] for key in strips}
    before = {key: np.zeros_like(strip.count) for key, strip in strips.items()}
    for rows in results.each("configuration", *_COLUMNS.values(), "conflict", "braking_pass"):
        for key, strip in strips.items():
            strip_rows = rows[(rows["configuration"] == key[1]) & rows[_COLUMNS[key[0]]].notna()]
            distance_m = strip_rows[_COLUMNS[key[0]]].to_numpy(dtype=float)
            kind = row_kinds(strip_rows) if strip.judged else np.full(len(strip_rows), KINDS.index(NEUTRAL))
            if not strip.has(distance_m, kind):
                raise InputError(
                    f"{results.place}/tally.parquet: expected the rows of detections.parquet counted, found others; "
                    f"{AGAIN}"
                )
            across, drawn = strip.place(distance_m, kind, before[key])
            parts[key].append((distance_m[drawn], across[drawn], kind[drawn]))
    return {key: _Points(*map(np.concatenate, zip(*chunks, strict=True))) for key, chunks in parts.items()}


def _draw_panel(
    axes: Axes,
    event: str,
    strips: Mapping[str, tuple[Strip, _Points]],
    looks: dict[str, Appearance],
    count: int,
    top_m: float,
) -> None:
    """Draw the strips of one event (`count`: of all rows), and at the left how many rows never had it."""
    for k, (name, (strip, points)) in enumerate(strips.items()):
        with mark_configuration(list(looks).index(name), axes):
            _draw_points(axes, points, k, looks[name], name, count, strip.judged)
            colour = INK if strip.never else FAINT
            axes.text(-0.07 * top_m, k, f"{strip.never}", ha="center", va="center_baseline", color=colour)
    axes.axvspan(-0.14 * top_m, 0, color="0.95", zorder=0)
    axes.text(-0.07 * top_m, -0.62, _NEVER[event], ha="center", va="bottom", fontsize=7, color="0.3")
    axes.set_xlim(-0.14 * top_m, 1.04 * top_m)
    axes.set_xticks([tick for tick in axes.get_xticks() if 0 <= tick <= 1.04 * top_m])
    axes.set_xlabel(_WORDS[event])


def _draw_points(
    axes: Axes, points: _Points, place: int, look: Appearance, name: str, count: int, judged: bool
) -> None:
    """Draw the points of one strip, by verdict: passes in colour, fails as black crosses, others grey."""
    size, alpha = (14.0, 0.8) if count <= _FEW else (8.0, 0.6)
    in_colour: dict[str, Any] = {"marker": "o", "color": look.colour, "s": size}
    grey: dict[str, Any] = {"marker": "s", "color": "0.65", "s": 0.6 * size}
    markers = {
        NEUTRAL: grey if judged else in_colour,
        PASS: in_colour,
        FAIL: {"marker": "x", "color": "black", "s": 1.4 * size},
    }
    for verdict, marker in markers.items():
        chosen = points.kind == KINDS.index(verdict)
        if not chosen.any():
            continue
        position = points.distance_m[chosen], (place - _HALF * points.across)[chosen]
        style: dict[str, Any] = {"linewidths": 0.8 if verdict == FAIL else 0, "rasterized": count > _MANY} | marker
        if verdict == FAIL and style["rasterized"]:  # a picture stays black on a dark page
            halo_style = {"color": "white", "linewidths": 2.4, "label": "_halo", "zorder": 1.95}
            axes.scatter(*position, **(style | halo_style))
        label = f"{name}: {verdict}"
        axes.scatter(*position, label=label, zorder=2, **({"alpha": alpha} | style))


def _build_strips(panels: Sequence[Axes], names: Sequence[str], detections: pd.DataFrame) -> None:
    """Set up the rows of the panels, named at the left, and write at the right which share passes."""
    short = shorten_names(names)
    axes = panels[0]
    axes.set_yticks(range(len(names)), [short[name] for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    for panel in panels:
        panel.grid(visible=False, axis="y")
        panel.tick_params(axis="y", length=0)
        for k in range(1, len(names)):
            panel.axhline(k - 0.5, color="0.85", linewidth=0.6, zorder=0.5)
    if "in_conflict" not in detections:
        return
    for k, name in enumerate(names):
        failed, _, passed = count_kinds(detections[detections["configuration"] == name]).sum(axis=0).tolist()
        share = format_share(passed / (passed + failed)) if passed + failed else "–"
        panels[-1].text(1.02, k, share, transform=panels[-1].get_yaxis_transform(), ha="left", va="center_baseline")
    panels[-1].text(
        1.02, -0.62, "pass", transform=panels[-1].get_yaxis_transform(), fontsize=7, color="0.3", va="bottom"
    )


def _add_legend(figure: Figure, shown: Sequence[str]) -> None:
    """Add the legend of the markers of the `shown` verdicts."""
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


def _describe_braking(results: Results) -> str:
    braking = results.experiment.braking
    if braking is None:
        return ""
    event = "knows of the object" if braking.brakes_for == "object" else "foresees the collision"
    return (
        f"Passes: the ego, which brakes as its declared driver does when it {event}, stays more than "
        f"{braking.margin_m:g} m away; at the right the share of the rows in conflict"
    )
