"""Page: the report of a results folder as one HTML file, which loads nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from copem_replay.core.errors import OutputError, RecordingError
from copem_replay.core.extras import EXTRAS, has_extra, load_extra
from copem_replay.metrics.columns import FALSE_TRACKS
from copem_replay.pipeline.false_tracks import describe_false_tracks
from copem_replay.report.figures.answer import answer_figure
from copem_replay.report.figures.registry import FIGURES
from copem_replay.report.figures.selection import Selection
from copem_replay.report.figures.style import Appearance, render_figure, take_note
from copem_replay.report.html.conclusions import write_details, write_lead
from copem_replay.report.html.markup import (
    Html,
    drop_dead_links,
    escape_text,
    join_html,
    line_swatch,
    make_list,
    make_tag,
    page_colours,
    replace_colours,
    replace_greys,
)
from copem_replay.report.html.setup import (
    describe_configurations,
    describe_question,
    describe_setting,
    provenance_tables,
)
from copem_replay.report.html.slices import group_tables
from copem_replay.report.html.study import NO_RECORDING, ReportData, load_study
from copem_replay.report.html.tables import (
    baseline_words,
    exact_misses,
    never_detected,
    regret_table,
    stage_table,
    summary_tables,
    verdicts_table,
)
from copem_replay.results.outputs import check_output, made_file
from copem_replay.results.read import Results

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
"""Content-Security-Policy: the page loads nothing from outside."""


def section_links(sections: Iterable[tuple[str, str]]) -> Html:
    """Links to sections, (id, title) each."""
    links = [make_tag("a", title, href=f"#{id_}") for id_, title in sections]
    return make_tag("nav", make_list(links), aria_label="Contents", class_="screen")


def whole_page(title: str, body: Html) -> str:
    """A page around a body, with style, script, and the greys of a dark screen."""
    own, body = files("copem_replay.report.html"), drop_dead_links(body)
    style, script = ((own / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="color-scheme" content="light dark">',
            '<link rel="icon" href="data:,">',
            f"<title>{escape_text(title)}</title>\n<style>\n{style}{page_colours(body)}</style>\n</head>\n<body>\n<main>",
            body,
            f"</main>\n<script>\n{script}</script>\n</body>\n</html>\n",
        ]
    )


# The file: complete under its name or not there, and of equal bytes for equal results.

REPORT = "report.html"
_SUFFIXES = (".html", ".htm")


def check_report(path: Path) -> None:
    """Raise OutputError for a folder, a name without the suffix of a page, or a file that may not be written."""
    if path.suffix.lower() not in _SUFFIXES or path.is_dir():
        found = "a folder" if path.is_dir() else path.name
        raise OutputError(f"{path}: expected a name that ends with {' or '.join(_SUFFIXES)}, found {found}")
    check_output(path)


def write_html_report(
    source: Path | Results, out: Path | None = None, *, baseline: str | None = None, by: Sequence[str] | None = None
) -> Path:
    """Write the report of results, or of a results folder, by default as `report.html` in it. Returns its path.

    `by`: entries of slices, None: those of the experiment. An existing report is replaced. Raises InputError if the
    results cannot be read, OutputError if the file cannot be written.
    """
    path = out or (source.require_folder() if isinstance(source, Results) else source) / REPORT
    check_report(path)
    study = load_study(source, baseline, by)
    html = build_page(study)
    with made_file(path, study.results.place) as scratch:
        scratch.write_text(html, encoding="utf-8", newline="\n")
        study.results.check_unchanged()
    return path


# Figures in a page: the SVG that `plot` writes, with ids that are unique on the page.

_NOT_DRAWN = re.compile(r"<!--.*?-->\s*|<metadata>.*?</metadata>\s*|<style .*?</style>\s*", re.DOTALL)
_IDS = re.compile(r'(?<= id=")|(?<=xlink:href="#)|(?<=url\(#)')
_LARGER = 1.25
"""Enlargement of a figure, where there is room: its texts are then about as large as those of tables."""
_SIZE = re.compile(r'(<svg [^>]*?)width="([\d.]+)pt" height="[\d.]+pt"')


def _enlarge(size: re.Match[str]) -> str:
    return f'{size[1]}style="width: {_LARGER * float(size[2]):.0f}pt"'


def figure_element(name: str, figure: Figure, title: str, shows: str, looks: Iterable[Appearance] = ()) -> Html:
    """A figure as an element of a page, scrolled where there is no room. `shows`: text for screen readers. `looks`: of
    configurations, whose colours are others on a dark page.
    """
    note = take_note(figure)
    svg = render_figure(figure, (".svg",))[".svg"].decode("utf-8")
    svg = _NOT_DRAWN.sub("", svg[svg.index("<svg ") :])  # comments repeat texts of users without escapes
    svg = _SIZE.sub(_enlarge, _IDS.sub(f"{name}-", svg), count=1)
    svg = replace_greys(replace_colours(svg, looks)).replace("<svg ", '<svg aria-hidden="true" ', 1)
    plot = make_tag("div", Html(svg), id_=name, class_="plot", role="img", aria_label=shows)
    drawn = make_tag("div", plot, class_="scroll figure", tabindex="0", role="region", aria_label=title)
    return join_html([drawn, make_tag("div", note, class_="below note")]) if note else drawn


_ANSWER, _DIFFERENCES = "answer", "differences"
_ALONE = ("runs",)
"""Figures that `plot` draws alone: stories show single runs here."""
_FIRST = ("late_paths", "trade_off", "false_positives")
"""Figures above the summary."""
_BELOW = {"latency_breakdown": stage_table, "slices": group_tables}
"""Elements below figures."""


@dataclass(frozen=True)
class _Section:
    id: str
    title: str
    parts: Sequence[Html]


def build_page(study: ReportData) -> str:
    """The whole report as HTML."""
    measured = len(study.results.known) > 0
    sections = [
        *_verdict_sections(study),
        _Section("differences-of-it", "Differences", _difference_parts(study)),
        *_extra_sections(study),
        *_figure_sections(study, _FIRST),
        *_false_sections(study),
        _Section(
            "configurations-of-it",
            "What is compared",
            [make_tag("p", describe_setting(study)), describe_configurations(study)],
        ),
        _Section("table", "Summary", [summary_tables(study)]),
    ]
    if measured:
        sections += _figure_sections(study, [name for name in FIGURES if name not in (_ANSWER, _DIFFERENCES, *_FIRST)])
        sections.append(_Section("missed", "Never detected", [never_detected(study), exact_misses(study)]))
    sections.append(_Section("provenance", "Where this comes from", [provenance_tables(study)]))
    title = f"When was it known? {', '.join(file.name for file in study.results.provenance.logs)}"
    head = make_tag(
        "header",
        make_tag("h1", "When was it known?"),
        make_tag("p", describe_question(study), class_="question"),
        write_lead(study),
        *([_embed_answer(study)] if measured else []),
        write_details(study),
        section_links((section.id, section.title) for section in sections),
        *([_configuration_key(study)] if measured and len(study.names) > 1 else []),
    )
    parts = (make_tag("section", make_tag("h2", s.title), *s.parts, id_=s.id) for s in sections)
    return whole_page(title, join_html([head, *parts]))


def _false_sections(study: ReportData) -> Iterator[_Section]:
    """A section that lists the false tracks of the run that is shown, where it has any."""
    results, shown = study.results, study.results.provenance.run_shown
    log = next(iter(shown), results.provenance.logs[0].name)
    if not results.has(FALSE_TRACKS):
        return
    rows = results.frame(FALSE_TRACKS)
    rows = rows[(rows["log"] == log) & (rows["run"] == shown.get(log, 0))]
    items = []
    for name in study.contenders:
        tracks = rows[rows["configuration"] == name]
        items.append(
            join_html(
                [
                    make_tag("b", name),
                    f", {len(tracks)}: {describe_false_tracks(tracks)}" if len(tracks) else ": none",
                ]
            )
        )
    if len(rows):
        where = f"run {shown.get(log, 0)} of {log}"
        words = f"Entries about nobody in {where}, the longest first. Those of all runs are in {FALSE_TRACKS}."
        yield _Section("false-tracks", "False tracks", [make_tag("p", words), make_list(items)])


def _extra_sections(study: ReportData) -> Iterator[_Section]:
    """The sections of extras that are installed and have something to show."""
    for name in EXTRAS["section of the report"]:
        if has_extra("section of the report", name):
            section = load_extra("section of the report", name)(study)
            if section is not None:
                yield _Section(name, *section)


def _verdict_sections(study: ReportData) -> list[_Section]:
    """The section of verdicts: those in the folder, else of the criteria of the experiment; none without criteria."""
    verdicts = study.verdicts
    return [] if verdicts is None else [_Section("criteria", "Good enough?", [verdicts_table(verdicts)])]


def _embed_figure(study: ReportData, name: str) -> Html:
    kind = FIGURES[name]
    drawn = kind.draw(study.results, _select(study))
    return figure_element(name, drawn, kind.title, kind.shows, study.looks.values())


def _embed_answer(study: ReportData) -> Html:
    """The figure of the answer in a wide and a stacked layout; CSS shows the one that fits the screen."""
    kind, looks = FIGURES[_ANSWER], study.looks.values()
    stacked = answer_figure(study.results, stacked=True)
    take_note(stacked)  # the other one has it
    narrow = figure_element(f"{_ANSWER}-stacked", stacked, kind.title, kind.shows, looks)
    wide = figure_element(_ANSWER, kind.draw(study.results, _select(study)), kind.title, kind.shows, looks)
    return join_html([make_tag("div", narrow, class_="stacked"), make_tag("div", wide, class_="beside")])


def _select(study: ReportData) -> Selection:
    return Selection(differences=study.regret, sliced=study.sliced, linked=True)


def _difference_parts(study: ReportData) -> list[Html]:
    """The figure of differences, if there is one, and its table."""
    if study.regret is None or FIGURES[_DIFFERENCES].missing(study.results, Selection(differences=study.regret)):
        return [regret_table(study)]
    return [baseline_words(study), _embed_figure(study, _DIFFERENCES), regret_table(study)]


def _figure_sections(study: ReportData, names: Sequence[str]) -> Iterator[_Section]:
    """A section per figure, with the reason in place of one that cannot be drawn."""
    for name in names:
        kind = FIGURES[name]
        why_missing = "" if name in _ALONE else kind.missing(study.results, _select(study))
        if why_missing == "" or not len(study.results.known):
            continue
        if why_missing is not None:
            yield _Section(f"section-{name}", kind.title, [make_tag("p", f"No figure: {why_missing}.")])
            continue
        paragraphs = [make_tag("p", line) for line in kind.about(study.results)]
        tables = [_BELOW[name](study)] if name in _BELOW else []
        try:
            figure = _embed_figure(study, name)
        except RecordingError:
            figure = make_tag("p", f"No figure: {NO_RECORDING}.")
        yield _Section(f"section-{name}", kind.title, [*paragraphs, figure, *tables])


def _configuration_key(study: ReportData) -> Html:
    """A button with the line of each configuration, which hides it in all figures or shows it again."""
    buttons = [
        make_tag("button", line_swatch(look), name, type="button", aria_pressed="true", data_configuration=str(k))
        for k, (name, look) in enumerate(study.looks.items())
    ]
    switches = [make_tag("button", word, type="button", data_every=word) for word in ("all", "none")]
    label = make_tag("span", "Shown in the figures:", class_="screen")
    return make_tag("div", label, *buttons, make_tag("span", *switches, class_="screen"), class_="key", id_="key")
