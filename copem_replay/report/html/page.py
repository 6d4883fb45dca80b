"""The page: all sections one after the other, in one file."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib.resources import files

from copem_replay.report.html.conclusions import answer
from copem_replay.report.html.detection_curves import curves
from copem_replay.report.html.distances import distances
from copem_replay.report.html.latency_breakdown import waterfall
from copem_replay.report.html.markup import Html, joined, tag, text
from copem_replay.report.html.missed_objects import never_detected, without_a_draw
from copem_replay.report.html.plotly_figures import Drawn, swatch
from copem_replay.report.html.provenance import provenance
from copem_replay.report.html.setup import configurations, question, setting
from copem_replay.report.html.study import Study
from copem_replay.report.html.sweeps import sweeps
from copem_replay.report.html.tables import regret_table, summary_tables

_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""What a browser lets the page load: nothing."""

Drawing = Callable[[Study], tuple[Html, list[Drawn]]]


def page(study: Study) -> str:
    """The whole report as HTML, nothing of which has to be fetched."""
    sections = [
        _section("configurations-of-it", "What was compared", tag("p", setting(study)), configurations(study)),
        _section("table", "Summary", summary_tables(study)),
        _section("differences", "Differences", regret_table(study)),
    ]
    figures: list[Drawn] = []
    if len(study.results.table):
        drawings: dict[str, Drawing] = {
            "How soon": curves,
            "How far away": distances,
            "Where the time goes": waterfall,
        }
        if study.results.sweep is not None:
            drawings["At other values"] = sweeps
        for k, (title, drawing) in enumerate(drawings.items()):
            html, drawn = drawing(study)
            figures += drawn
            above = [_key(study)] if k == 0 and len(study.names) > 1 else []
            sections.append(_section(f"figures-{k}", title, *above, html))
        sections.append(_section("missed", "Never detected", never_detected(study), without_a_draw(study)))
    sections.append(_section("provenance", "Where this comes from", provenance(study)))
    title = f"When was it known? {', '.join(file.name for file in study.results.provenance.logs)}"
    head = tag("header", tag("h1", "When was it known?"), tag("p", question(study), class_="question"), answer(study))
    return _whole(title, joined([head, *sections]), figures)


def _section(id_: str, title: str, *parts: Html) -> Html:
    return tag("section", tag("h2", title), *parts, id_=id_)


def _key(study: Study) -> Html:
    """Which line is whose; pressed to leave a configuration out of all figures."""
    buttons = [
        tag("button", swatch(look), name, type="button", aria_pressed="true", data_configuration=str(k))
        for k, (name, look) in enumerate(study.looks.items())
    ]
    every = [tag("button", word, type="button", data_every=word) for word in ("all", "none")]
    said = tag("span", "Shown in the figures:", class_="screen")
    return tag("div", said, *buttons, tag("span", *every, class_="screen"), class_="key", id_="key")


def _whole(title: str, body: Html, figures: list[Drawn]) -> str:
    from plotly.offline import get_plotlyjs

    own = files("copem_replay.report.html")
    style, script = ((own / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    library = [f"<script>{get_plotlyjs()}</script>"] if figures else []
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<link rel="icon" href="data:,">',
            f"<title>{text(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>",
            body,
            "</main>",
            f'<script type="application/json" id="figures">{_data(figures)}</script>',
            *library,
            f"<script>\n{script}</script>\n</body>\n</html>\n",
        ]
    )


def _data(figures: list[Drawn]) -> str:
    """JSON that no name can end: of HTML it has no character."""
    said = json.dumps(figures, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return said.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
