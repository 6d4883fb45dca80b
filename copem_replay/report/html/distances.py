"""Distances at detection: of each configuration how many rows at which distance, pass and fail told apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.text import counted
from copem_replay.report.figures.captions import percent
from copem_replay.report.figures.distances import FAIL, NEUTRAL, PASS, verdicts
from copem_replay.report.figures.style import Appearance
from copem_replay.report.html.markup import Html, joined, tag
from copem_replay.report.html.plotly_figures import FAINT, INK, Drawn, axis, box, card, layout, numbers, rgb, swatch

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_BINS = 40
"""Of the distance, about (chosen)."""


@dataclass(frozen=True)
class Event:
    """What happens at a distance: columns of `detections.parquet`, its median in `summary.csv`, and words for it."""

    key: str
    known: str
    distance: str
    median: str
    title: str
    never: str


_EVENTS = (
    Event(
        "distances", "detected", "distance_at_detection_m", "dad_median_m",
        "Distance at detection", "never detected",
    ),
    Event(
        "foreseen", "conflict_detected", "distance_at_conflict_detection_m", "conflict_dad_median_m",
        "Distance when the collision is foreseen", "never foreseen",
    ),
)  # fmt: skip


def distances(study: Study) -> tuple[Html, list[Drawn]]:
    """The section, and its figures: one of each configuration; the same again where collisions are foreseen."""
    table = study.results.table
    braking = study.results.experiment.braking
    parts: list[Html] = []
    figures: list[Drawn] = []
    for event in _EVENTS:
        if event.distance not in table:
            continue
        # Who brakes for the one event has nothing to show at the distance of the other.
        braked_for = "foreseen" if braking is not None and braking.brakes_for == "conflict" else "distances"
        judged = braking is not None and braked_for == event.key and bool(table["conflict"].any())
        counts = {name: _counts(rows, event, judged) for name, rows in _by_configuration(table, study)}
        width_m, last = _bins(counts)
        shares = {name: _binned(found, width_m, last, len(table) // len(study.names)) for name, found in counts.items()}
        top = max(float(sum(share.values()).max(initial=0.0)) for share in shares.values())
        cards = []
        for k, name in enumerate(study.names):
            id_ = f"{event.key}-{k}"
            figures.append(_figure(id_, study, name, event, shares[name], width_m, last, top))
            caption = _caption(study, name, event, counts[name], judged)
            cards.append(card(k, id_, f"{event.title.lower()}: {name}", *caption))
        said = joined(tag("p", line) for line in _said(study, event, counts, judged))
        title = tag("h3", event.title) if event.key != "distances" else Html()
        parts += [title, said, _key() if judged else Html(), tag("div", *cards, class_="cards")]
    return joined(parts), figures


def _by_configuration(table: pd.DataFrame, study: Study) -> list[tuple[str, pd.DataFrame]]:
    return [(name, table[table["configuration"] == name]) for name in study.names]


def _counts(rows: pd.DataFrame, event: Event, judged: bool) -> dict[str, Any]:
    """Distances (n,) by verdict, how many rows never came to know, and how many did while the truth had a gap."""
    known = rows[event.known].to_numpy(dtype=bool)
    distance_m = rows[event.distance].to_numpy(dtype=float)
    kind = verdicts(rows).to_numpy() if judged else np.full(len(rows), NEUTRAL, dtype=object)
    placed = known & ~np.isnan(distance_m)
    of = {verdict: distance_m[placed & (kind == verdict)] for verdict in (FAIL, NEUTRAL, PASS)}
    return {"of": of, "never": int((~known).sum()), "gap": int((known & ~placed).sum()), "rows": len(rows)}


def _bins(counts: dict[str, dict[str, Any]]) -> tuple[float, int]:
    """Their width, a round number of metres, and how many there are."""
    every = [values for found in counts.values() for values in found["of"].values()]
    top_m = max((float(values.max(initial=0.0)) for values in every), default=0.0) or 1.0
    least = top_m / _BINS
    power = 10.0 ** np.floor(np.log10(least))
    width_m = float(next(step * power for step in (1, 2, 5, 10) if step * power >= least * (1 - 1e-9)))
    return width_m, int(np.floor(top_m / width_m)) + 1


def _binned(found: dict[str, Any], width_m: float, last: int, rows: int) -> dict[str, Any]:
    """By verdict the share of all rows in each bin (last,)."""
    return {
        verdict: np.bincount((values / width_m + 1e-9).astype(np.int64), minlength=last) / max(rows, 1)
        for verdict, values in found["of"].items()
    }


def _figure(
    id_: str, study: Study, name: str, event: Event, share: dict[str, Any], width_m: float, last: int, top: float
) -> Drawn:
    look = study.looks[name]
    middle_m = (np.arange(last) + 0.5) * width_m
    traces = []
    for verdict in (FAIL, NEUTRAL, PASS):
        there = share[verdict] > 0
        if not there.any():
            continue
        edges = [[round(k * width_m, 4), round((k + 1) * width_m, 4)] for k in np.flatnonzero(there).tolist()]
        judged = len([kind for kind, of in share.items() if of.any()]) > 1 or verdict != NEUTRAL
        traces.append(
            {
                "type": "bar",
                "name": verdict,
                "x": numbers(middle_m[there]),
                "y": numbers(share[verdict][there], 6),
                "width": round(width_m, 4),
                "customdata": edges,
                "marker": _marker(verdict, look, judged),
                "hovertemplate": "%{customdata[0]} to %{customdata[1]} m: %{y:.1%} of the rows"
                + (f", {verdict}" if judged else "")
                + "<extra></extra>",
            }
        )
    row = study.of(name)
    median_m = float(row.get(event.median, np.nan))
    shapes = []
    if median_m == median_m:
        line = {"color": INK, "width": 1.4, "dash": "4px,2px"}
        at = round(median_m, 4)
        shapes.append({"type": "line", "x0": at, "x1": at, "y0": 0, "y1": 1, "yref": "paper", "line": line})
    drawn = layout(
        150,
        axis("Distance (m)", range=[0, round(last * width_m, 4)]),
        axis("", range=[0, round(1.05 * top, 5) or 1], tickformat=".0%" if top > 0.04 else ".1%", nticks=4),
        barmode="stack",
        bargap=0,
        shapes=shapes,
    )
    # A configuration that never came to know has nothing to draw, but is drawn.
    empty = {"type": "scatter", "mode": "lines", "x": [0, round(last * width_m, 4)], "y": [0, 0]}
    base = empty | {"line": {"color": FAINT, "width": 1}, "hoverinfo": "skip"}
    return {"id": id_, "data": [*traces, base], "layout": drawn}


def _marker(verdict: str, look: Appearance, judged: bool) -> Drawn:
    edge = {"color": rgb(look.edge), "width": 0.7}
    if verdict == PASS or not judged:
        return {"color": rgb(look.colour), "line": edge}
    if verdict == NEUTRAL:
        return {"color": "#cfcfcf", "line": {"color": FAINT, "width": 0.7}}
    pattern = {"shape": "x", "fgcolor": "black", "bgcolor": "white", "size": 6, "solidity": 0.35}
    return {"color": "white", "pattern": pattern, "line": {"color": "black", "width": 0.7}}


def _caption(study: Study, name: str, event: Event, found: dict[str, Any], judged: bool) -> list[str]:
    said = []
    if judged:
        share = float(study.of(name)["pass_share"])
        said.append(f"{percent(share)} pass" if share == share else "none in conflict")
    if found["never"]:
        said.append(f"{found['never']} of {found['rows']} {event.never}")
    return [swatch(study.looks[name]), tag("b", name), " ", ", ".join(said)]


def _said(study: Study, event: Event, counts: dict[str, dict[str, Any]], judged: bool) -> list[str]:
    lost = sum(found["gap"] for found in counts.values())
    braking = study.results.experiment.braking
    said = (
        "How far apart the centres of object and reference were at that instant, in truth: which share of a "
        "configuration's rows lies at which distance, all on the same axes. Dashed: the median over all rows, those "
        "that never got there ranking below every distance; without a line it is among them. Farther is earlier only "
        "while the two approach each other."
    )
    if event.key == "foreseen":
        said = "The same at the first list that implied a collision."
    lines = [said + (f" Without a bar: {counted(lost, 'detection')} while the truth has a gap." if lost else "")]
    if judged and braking is not None:
        what = "knows of the object" if braking.brakes_for == "object" else "foresees the collision"
        lines.append(
            f"A row passes if the ego, braking as its declared driver does from when it {what}, stays more than "
            f"{braking.margin_m:g} m away. Who was never known is in no bar, but judged like all others in conflict: "
            "the share that passes counts them."
        )
    return lines


def _key() -> Html:
    """What bars of each verdict look like, whatever the configuration."""
    boxes = {
        "passes (in the configuration's colour)": box("#7a7a7a"),
        "fails": box("white", "M1 1L13 13M13 1L1 13"),
        "not in conflict": box("#cfcfcf"),
    }
    items = [tag("span", drawn, word) for word, drawn in boxes.items()]
    return tag("p", *items, class_="key")
