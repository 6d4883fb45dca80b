"""The page: all sections one after the other, in one file."""

from __future__ import annotations

from importlib.resources import files

from copem_replay.report.figures.registry import FIGURES, Selection
from copem_replay.report.html.conclusions import answer
from copem_replay.report.html.embedded import embedded
from copem_replay.report.html.latency_breakdown import stage_table
from copem_replay.report.html.markup import Html, joined, tag, text
from copem_replay.report.html.missed_objects import never_detected, without_a_draw
from copem_replay.report.html.provenance import provenance
from copem_replay.report.html.setup import configurations, question, setting
from copem_replay.report.html.study import Study
from copem_replay.report.html.swatches import swatch
from copem_replay.report.html.tables import regret_table, summary_tables

_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
"""What a browser lets the page load: nothing."""
_BELOW = {"latency_breakdown": stage_table}
"""What stands below a figure."""


def page(study: Study) -> str:
    """The whole report as HTML, nothing of which has to be fetched."""
    sections = [
        _section("configurations-of-it", "What was compared", tag("p", setting(study)), configurations(study)),
        _section("table", "Summary", summary_tables(study)),
        _section("differences", "Differences", regret_table(study)),
    ]
    if len(study.results.table):
        sections += _figures(study)
        sections.append(_section("missed", "Never detected", never_detected(study), without_a_draw(study)))
    sections.append(_section("provenance", "Where this comes from", provenance(study)))
    title = f"When was it known? {', '.join(file.name for file in study.results.provenance.logs)}"
    head = tag("header", tag("h1", "When was it known?"), tag("p", question(study), class_="question"), answer(study))
    return _whole(title, joined([head, *sections]))


def _figures(study: Study) -> list[Html]:
    """A section for each figure that needs no recording; with the reason where it cannot be drawn."""
    sections: list[Html] = []
    for name, kind in FIGURES.items():
        why = "" if kind.needs_recording else kind.missing(study.results, Selection())
        if why == "":
            continue
        above = [_key(study)] if not sections and len(study.names) > 1 else []
        if why is not None:
            sections.append(_section(f"section-{name}", kind.title, *above, tag("p", f"No figure: {why}.")))
            continue
        about = [tag("p", line) for line in kind.about(study.results)]
        below = [_BELOW[name](study)] if name in _BELOW else []
        figure = embedded(name, kind, study.results)
        sections.append(_section(f"section-{name}", kind.title, *above, *about, figure, *below))
    return sections


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


def _whole(title: str, body: Html) -> str:
    own = files("copem_replay.report.html")
    style, script = ((own / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<link rel="icon" href="data:,">',
            f"<title>{text(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>",
            body,
            f"</main>\n<script>\n{script}</script>\n</body>\n</html>\n",
        ]
    )
