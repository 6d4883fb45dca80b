"""The page: all sections one after the other, in one file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from copem_replay.report.figures.registry import FIGURES
from copem_replay.report.figures.selection import Selection
from copem_replay.report.html.conclusions import lead, more
from copem_replay.report.html.embedded import drawn
from copem_replay.report.html.latency_breakdown import stage_table
from copem_replay.report.html.markup import Html, joined, tag
from copem_replay.report.html.missed_objects import never_detected, without_a_draw
from copem_replay.report.html.provenance import provenance
from copem_replay.report.html.setup import configurations, question, setting
from copem_replay.report.html.study import Study
from copem_replay.report.html.swatches import swatch
from copem_replay.report.html.tables import baseline_words, regret_table, summary_tables
from copem_replay.report.html.whole import contents, whole_page

_ANSWER, _DIFFERENCES = "answer", "differences"
_BELOW = {"latency_breakdown": stage_table}
"""What stands below a figure."""


@dataclass(frozen=True)
class _Section:
    id: str
    title: str
    parts: Sequence[Html]


def page(study: Study) -> str:
    """The whole report as HTML, nothing of which has to be fetched."""
    measured = len(study.results.known) > 0
    sections = [
        _Section("differences-of-it", "Differences", _differences(study)),
        *_figures(study, ("trade_off",)),
        _Section("configurations-of-it", "What is compared", [tag("p", setting(study)), configurations(study)]),
        _Section("table", "Summary", [summary_tables(study)]),
    ]
    if measured:
        sections += _figures(study, [name for name in FIGURES if name not in (_ANSWER, _DIFFERENCES, "trade_off")])
        sections.append(_Section("missed", "Never detected", [never_detected(study), without_a_draw(study)]))
    sections.append(_Section("provenance", "Where this comes from", [provenance(study)]))
    title = f"When was it known? {', '.join(file.name for file in study.results.provenance.logs)}"
    head = tag(
        "header",
        tag("h1", "When was it known?"),
        tag("p", question(study), class_="question"),
        lead(study),
        *([_embedded(study, _ANSWER)] if measured else []),
        more(study),
        contents((one.id, one.title) for one in sections),
        *([_key(study)] if measured and len(study.names) > 1 else []),
    )
    return whole_page(
        title, joined([head, *(tag("section", tag("h2", s.title), *s.parts, id_=s.id) for s in sections)])
    )


def _embedded(study: Study, name: str) -> Html:
    kind = FIGURES[name]
    return drawn(name, kind.draw(study.results, Selection(differences=study.regret)), kind.title, kind.shows)


def _differences(study: Study) -> list[Html]:
    """The figure above the table that it is drawn from."""
    if study.regret is None or FIGURES[_DIFFERENCES].missing(study.results, Selection(differences=study.regret)):
        return [regret_table(study)]
    return [baseline_words(study), _embedded(study, _DIFFERENCES), regret_table(study)]


def _figures(study: Study, names: Sequence[str]) -> Iterator[_Section]:
    """A section for each figure that needs no recording; with the reason where it cannot be drawn."""
    for name in names:
        kind = FIGURES[name]
        why = "" if kind.needs_recording else kind.missing(study.results, Selection())
        if why == "" or not len(study.results.known):
            continue
        if why is not None:
            yield _Section(f"section-{name}", kind.title, [tag("p", f"No figure: {why}.")])
            continue
        about = [tag("p", line) for line in kind.about(study.results)]
        below = [_BELOW[name](study)] if name in _BELOW else []
        yield _Section(f"section-{name}", kind.title, [*about, _embedded(study, name), *below])


def _key(study: Study) -> Html:
    """The line of each configuration; pressed to leave a configuration out of all figures."""
    buttons = [
        tag("button", swatch(look), name, type="button", aria_pressed="true", data_configuration=str(k))
        for k, (name, look) in enumerate(study.looks.items())
    ]
    every = [tag("button", word, type="button", data_every=word) for word in ("all", "none")]
    said = tag("span", "Shown in the figures:", class_="screen")
    return tag("div", said, *buttons, tag("span", *every, class_="screen"), class_="key", id_="key")
