"""Detection-time curves: the share that is known by then, together and one by one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.intervals import FEWEST_CLUSTERS
from copem_replay.metrics.summary_text import cell
from copem_replay.report.figures.captions import percent
from copem_replay.report.figures.detection_curves import Curve, curves_of, exact_curve, time_axis
from copem_replay.report.figures.style import Appearance
from copem_replay.report.html.markup import Html, joined, tag
from copem_replay.report.html.plotly_figures import (
    Drawn,
    axis,
    card,
    label,
    layout,
    line_of,
    numbers,
    outlined,
    place,
    rgb,
    swatch,
)

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_TITLE, _SHARE = "Time since the clock started (s)", "Known by then"
_MOST_BANDS = 3
"""More bands than this hide each other where there are small figures for them (chosen)."""


def curves(study: Study) -> tuple[Html, list[Drawn]]:
    """The section, and its figures: all curves in one; where they are many, bands in a small figure of each."""
    results = study.results
    over, drawn = curves_of(results, study.names)
    exact = {name: exact_curve(results.exact, name) for name in study.names} if results.exact is not None else {}
    limits = time_axis([*drawn.values(), *exact.values()])
    one_by_one = len(study.names) > _MOST_BANDS
    traces: list[Drawn] = []
    for k, (name, curve) in enumerate(drawn.items()):
        look, own = study.looks[name], {"meta": k, "name": label(name)}
        traces += [] if one_by_one else [trace | own for trace in _band(curve, look, limits)]
        traces += [trace | own for trace in _line(curve, look, limits)]
    for k, curve in enumerate(exact.values()):
        if not one_by_one:
            traces.append(_exact(curve, limits) | {"meta": k, "name": "exact"})
    figures = [{"id": "curves", "data": traces, "layout": _layout(440, limits), "bar": True}]
    parts = [place("curves", "share known over the time since the clock started, a line per configuration")]
    if one_by_one:
        cards = []
        for k, (name, curve) in enumerate(drawn.items()):
            own_figure, html = _card(study, k, name, curve, exact.get(name), drawn, limits)
            figures.append(own_figure)
            cards.append(html)
        parts += [tag("h3", "One by one"), _cards_note(study), tag("div", *cards, class_="cards")]
    said = [*_said(drawn, over, limits, bool(exact), one_by_one)]
    return joined([*(tag("p", line) for line in said), *parts]), figures


def _said(drawn: dict[str, Curve], over: str | None, limits: tuple[float, float], exact: bool, many: bool) -> list[str]:
    later = max((curve.last - _by(curve, limits[1]) for curve in drawn.values()), default=0.0)
    bands = f"Bands: 95 %, bootstrap over whole {over}, or exact binomial limits where few decide"
    if over is None:
        bands = (
            f"No bands: fewer than {FEWEST_CLUSTERS} logs and fewer than {FEWEST_CLUSTERS} measured objects, and more "
            "runs do not tell about other traffic."
        )
    elif over == NOTHING_DRAWN:
        bands = "No bands: nothing drawn, every run is the same."
    else:
        bands += ", in the small figures below." if many else "."
    return [
        "A curve says which share of all looks (measured objects × runs × logs) had become known this long after the "
        "clock started: the cumulative incidence of detection (Aalen–Johansen, departure competing). Who departs "
        "undetected is never detected and keeps the curve below 100 %. Lines that coincide lie on each other, the "
        "thinner ones on top.",
        bands
        + (" Dashed black, thin: the exact share, without a draw." if exact else "")
        + (f" Beyond the axis at most {math.ceil(1000 * later) / 10:g} % more become known." if later > 0 else ""),
    ]


def _cards_note(study: Study) -> Html:
    baseline = f" Thin grey: {study.baseline}, the baseline." if study.baseline else ""
    return tag("p", f"Each configuration by itself, with its band.{baseline}")


def _card(
    study: Study, k: int, name: str, curve: Curve, exact: Curve | None, drawn: dict[str, Curve],
    limits: tuple[float, float],
) -> tuple[Drawn, Html]:  # fmt: skip
    look = study.looks[name]
    traces: list[Drawn] = []
    if study.baseline is not None and study.baseline != name:
        x, y = _vertices(drawn[study.baseline], limits)
        grey = {"color": "#9a9a9a", "width": 1.2}
        traces.append(_trace(x, y, line=grey, name=label(study.baseline), hoverinfo="skip"))
    traces += [trace | {"name": label(name)} for trace in _band(curve, look, limits) + _line(curve, look, limits)]
    traces += [_exact(exact, limits) | {"name": "exact"}] if exact is not None else []
    row = study.of(name)
    median = row["ttd_median_s"]
    known = f"{percent(float(row['detected_share']))} known" + (
        f", half by {cell(float(median))} s" if median == median else ""
    )
    small = _layout(190, limits)
    figure = {"id": f"curve-{k}", "data": traces, "layout": small}
    return figure, card(k, f"curve-{k}", f"share known over time: {name}", swatch(look), tag("b", name), " ", known)


def _layout(height_px: int, limits: tuple[float, float]) -> Drawn:
    return layout(
        height_px,
        axis(_TITLE, range=[round(limits[0], 4), round(limits[1], 4)]),
        axis(_SHARE, range=[-0.02, 1.03], tickformat=".0%", nticks=6),
    )


def _line(curve: Curve, look: Appearance, limits: tuple[float, float]) -> list[Drawn]:
    x, y = _vertices(curve, limits)
    hover = "%{fullData.name}<br>%{x:.3~f} s: %{y:.1%}<extra></extra>"
    return outlined(_trace(x, y, line=line_of(look), hovertemplate=hover), look)


def _exact(curve: Curve, limits: tuple[float, float]) -> Drawn:
    x, y = _vertices(curve, limits)
    return _trace(x, y, line={"color": "black", "width": 1, "dash": "5px,3px"}, hoverinfo="skip")


def _band(curve: Curve, look: Appearance, limits: tuple[float, float]) -> list[Drawn]:
    if curve.low is None or curve.high is None:
        return []
    edge = {"color": rgb(look.edge, 0.6), "width": 0.8}
    x, low = _vertices(curve, limits, curve.low)
    _, high = _vertices(curve, limits, curve.high)
    return [
        _trace(x, low, line=edge, hoverinfo="skip"),
        _trace(x, high, line=edge, hoverinfo="skip", fill="tonexty", fillcolor=rgb(look.colour, 0.22)),
    ]


def _trace(x: Float, y: Float, *, line: Drawn, **more: object) -> Drawn:
    line = {"shape": "hv", "simplify": False} | line
    return {"type": "scatter", "mode": "lines", "x": numbers(x), "y": numbers(y, 5), "line": line} | more


def _vertices(curve: Curve, limits: tuple[float, float], values: Float | None = None) -> tuple[Float, Float]:
    """Of a step function over the whole axis, each value held until the next instant."""
    shown = curve.times_s <= limits[1]
    kept = (curve.share if values is None else values)[shown]
    x = np.concatenate([[limits[0]], curve.times_s[shown], [limits[1]]])
    return x, np.concatenate([[0.0], kept, kept[-1:] if len(kept) else [0.0]])


def _by(curve: Curve, time_s: float) -> float:
    k = int(np.searchsorted(curve.times_s, time_s, side="right"))
    return float(curve.share[k - 1]) if k else 0.0
