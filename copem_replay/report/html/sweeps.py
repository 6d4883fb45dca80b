"""Sweeps: what becomes of shares and times when one quantity changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.report.figures.sweeps import AXES, swept_name
from copem_replay.report.html.markup import Html, joined, tag
from copem_replay.report.html.plotly_figures import Drawn, axis, label, layout, line_of, numbers, outlined, place, rgb

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_SYMBOLS = {
    "o": "circle",
    "s": "square",
    "^": "triangle-up",
    "D": "diamond",
    "v": "triangle-down",
    "P": "cross",
    "X": "x",
}
_WHAT = {
    "pass_share": "Share that passes",
    "detected_share": "Share detected",
    "ttd_median_s": "Median time to detection (s)",
}
_LIMITS = {
    "pass_share": ("pass_share_low", "pass_share_high"),
    "detected_share": ("detected_share_low", "detected_share_high"),
    "ttd_median_s": ("ttd_p5_s", "ttd_p95_s"),
}


def sweeps(study: Study) -> tuple[Html, list[Drawn]]:
    """The section, and a figure for each swept quantity and each figure of it that there is."""
    sweep = study.results.sweep
    assert sweep is not None
    figures: list[Drawn] = []
    cards: list[Html] = []
    for kind in dict.fromkeys(sweep["sweep"]):
        part = sweep[sweep["sweep"] == kind]
        for what, title in _WHAT.items():
            if what not in part or not part[what].notna().any():
                continue
            id_ = f"sweep-{len(figures)}"
            figures.append(_figure(id_, study, part, str(kind), what))
            cards.append(
                tag("figure", tag("figcaption", tag("b", title)), place(id_, f"{title} by {kind}"), class_="card")
            )
    said = (
        "The experiment at other values of one quantity, on the same dice. Vertical lines: 95 % intervals of shares; "
        "of times the 5 % and 95 % quantiles. Where a time is missing, it is among the never detected. All numbers are "
        "in sweep.csv."
    )
    return joined([tag("p", said), tag("div", *cards, class_="cards")]), figures


def _figure(id_: str, study: Study, part: pd.DataFrame, kind: str, what: str) -> Drawn:
    traces: list[Drawn] = []
    for k, name in enumerate(study.names):
        rows = part[part["configuration"] == name].sort_values("value", kind="stable")
        if not len(rows):
            continue
        look, middle = study.looks[name], rows[what].to_numpy(dtype=float)
        low, high = (rows[limit].to_numpy(dtype=float) if limit in rows else middle for limit in _LIMITS[what])
        bars = {"array": numbers(high - middle, 6), "arrayminus": numbers(middle - low, 6), "color": rgb(look.edge)}
        shape = {"symbol": _SYMBOLS[look.marker], "size": 8, "color": rgb(look.colour)}
        trace = {
            "type": "scatter",
            "mode": "lines+markers",
            "meta": k,
            "name": label(swept_name(name, kind)),
            "x": numbers(rows["value"].to_numpy(dtype=float), 6),
            "y": numbers(middle, 6),
            "line": line_of(look, max(look.width_pt * 0.7, 1.5)),
            "marker": shape | {"line": {"color": rgb(look.edge), "width": 1}},
            "hovertemplate": "%{fullData.name}<br>%{x}: %{y:.4~g}<extra></extra>",
        }
        traces += outlined(trace, look)
        traces[-1] = traces[-1] | {"error_y": bars | {"type": "data", "symmetric": False, "thickness": 1, "width": 3}}
    share = what != "ttd_median_s"
    y = axis("", nticks=6) | ({"range": [-0.03, 1.05], "tickformat": ".0%"} if share else {"rangemode": "tozero"})
    x = axis(AXES.get(kind, kind), tickformat=".0%") if kind == "share" else axis(AXES.get(kind, kind))
    values = np.unique(part["value"].to_numpy(dtype=float))
    if kind == "rate_hz" and values[0] > 0 and values[-1] / values[0] >= 8:
        x |= {"type": "log", "tickvals": numbers(values), "ticktext": [f"{value:g}" for value in values]}
    return {"id": id_, "data": traces, "layout": layout(280, x, y)}
