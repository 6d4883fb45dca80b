"""History: what became of criteria over many results folders, as one page that opens offline.

There is a row for each criterion, configuration and group: a strip with the verdict of each folder, the figure with its
interval over the folders beside the bound, and the first folder at which the verdict turned. Folders stand in the order
in which they are given.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from urllib.parse import quote

import pandas as pd

from copem_replay.core.errors import InputError, count_noun
from copem_replay.metrics.braking.driving import SHARE
from copem_replay.metrics.limits import format_limit, format_limits
from copem_replay.metrics.summary import format_cell
from copem_replay.metrics.summary_metrics import COMPARED
from copem_replay.report.html.markup import Html, allow_breaks, fold_parts, join_html, make_list, make_table, make_tag
from copem_replay.report.html.page import REPORT, check_report, section_links, whole_page
from copem_replay.report.html.tables import VERDICT_SIGNS, verdict_mark
from copem_replay.results.compare import compare_folders
from copem_replay.results.outputs import made_file
from copem_replay.results.read import Results, open_results
from copem_replay.results.verdicts import (
    FILE,
    Judgement,
    Verdict,
    find_verdicts,
)

# The history.


@dataclass(frozen=True)
class JudgedFolder:
    """A results folder of a history: its verdicts, its label, and where its report is seen from the page."""

    results: Results
    verdicts: Judgement
    label: str
    report: str | None

    @property
    def title(self) -> Html:
        """The label, as a link to the report where there is one."""
        name = allow_breaks(self.label)
        return make_tag("a", name, href=self.report) if self.report else name


def read_history(folders: Sequence[Path], page: Path) -> list[JudgedFolder]:
    """The folders of a history, in their order. Raises InputError, one line per damaged one or one without verdicts."""
    judged: list[JudgedFolder] = []
    problems: list[str] = []
    seen: dict[str, Path] = {}
    for folder in folders:
        try:
            if (first := seen.setdefault(os.path.realpath(folder), folder)) is not folder:
                raise InputError(f"{folder}: expected each folder once, found it twice ({first})")
            results = open_results(folder, "summary.csv")
            if (verdicts := find_verdicts(folder)) is None:
                raise InputError(f"{folder}: expected {FILE}, found none; `copem-replay verdict {folder}` writes it")
            has_report = (folder / REPORT).is_file()
            path = os.path.relpath(os.path.realpath(folder / REPORT), os.path.realpath(page.parent))
            label = str(results.provenance.data.get("label") or results.name)
            judged.append(JudgedFolder(results, verdicts, label, quote(Path(path).as_posix()) if has_report else None))
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(problems)
    return judged


def write_history(folders: Sequence[str | PathLike[str]], file: str | PathLike[str] = "history.html") -> Path:
    """Write what became of criteria over many results folders as one HTML file that opens offline. Returns its path.

    `folders`: results folders with their verdicts, the oldest first.

    Raises InputError where a folder has no verdicts or damaged ones, OutputError where the file is not writable.

    >>> cr.write_history([])
    Traceback (most recent call last):
    copem_replay.core.errors.InputError: history: expected results folders, found none
    """
    page, places = Path(file), [Path(folder) for folder in folders]
    check_report(page)
    if not places:
        raise InputError("history: expected results folders, found none")
    html = history_page(read_history(places, page))
    with made_file(page) as scratch:
        scratch.write_text(html, encoding="utf-8", newline="\n")
    return page


_Key = tuple[str, str, str]
_MOST_TURNS = 12
"""Most verdicts that turned in the newest folder and are named above the table."""


def history_page(folders: Sequence[JudgedFolder]) -> str:
    """The whole page as HTML."""
    rows = _rows_of(folders)
    turns_of = {key: turns for key, of in rows.items() if (turns := find_turns(of))}
    sections = [
        ("criteria", "Criteria", _criteria_table(folders, rows)),
        ("folders", "Folders", _folders_table(folders)),
        ("summaries", "Figures", _summaries_table(folders)),
        ("differences", "Side by side", _side_by_side(folders, turns_of)),
    ]
    newest = folders[-1]
    sentences = [f"The newest, {newest.label}: {newest.verdicts.headline}."]
    for (criterion, configuration, group), turns in turns_of.items():
        k, before, after = turns[-1]
        if k == len(folders) - 1:
            name = f"{criterion}: {group}" if group else criterion
            sentences.append(f"{name}, {configuration}: {before} before, {after} now.")
    if (more := len(sentences) - 1 - _MOST_TURNS) > 0:
        sentences = [*sentences[:-more], f"… and {more} more turned."]
    head = make_tag(
        "header",
        make_tag("h1", "What became of the criteria?"),
        make_tag("p", f"{count_noun(len(rows), 'verdict')} of each of {count_noun(len(folders), 'folder')}, the "
                 "newest last, in the order in which they were given.", class_="question"),
        make_list(sentences),
        section_links((id_, title) for id_, title, _ in sections),
    )  # fmt: skip
    below = (make_tag("section", make_tag("h2", title), body, id_=id_) for id_, title, body in sections)
    return whole_page("History of criteria", join_html([head, *below]))


def _rows_of(folders: Sequence[JudgedFolder]) -> dict[_Key, list[Verdict | None]]:
    """By criterion, configuration and group the verdict of each folder; None: it is not judged there."""
    rows: dict[_Key, list[Verdict | None]] = {}
    for k, folder in enumerate(folders):
        for one in folder.verdicts.all:
            rows.setdefault((one.criterion, one.configuration, one.group), [None] * len(folders))[k] = one
    return rows


def find_turns(verdicts: Sequence[Verdict | None]) -> list[tuple[int, str, str]]:
    """The changes of a verdict from the folder before that has one: the index, the word before, and the new word."""
    turns: list[tuple[int, str, str]] = []
    before: str | None = None
    for k, verdict in enumerate(verdicts):
        if verdict is None:
            continue
        if before is not None and verdict.verdict != before:
            turns.append((k, before, verdict.verdict))
        before = verdict.verdict
    return turns


def _criteria_table(folders: Sequence[JudgedFolder], rows: dict[_Key, list[Verdict | None]]) -> Html:
    """A row for each criterion, configuration and group, with its verdicts over the folders."""
    lines = []
    for verdicts in rows.values():
        newest_verdict = next(one for one in reversed(verdicts) if one is not None)
        turns = find_turns(verdicts)
        first_turn = [f"{after} at ", folders[turns[0][0]].title] if (after := turns[0][2] if turns else "") else ["–"]
        strip = make_tag("span", *map(verdict_mark, verdicts), class_="strip")
        lines.append(
            make_tag(
                "tr",
                make_tag("th", newest_verdict.name, scope="row"),
                make_tag("td", allow_breaks(newest_verdict.configuration), class_="text"),
                make_tag("td", allow_breaks(newest_verdict.asked), class_="text"),
                make_tag("td", strip, class_="text"),
                make_tag("td", draw_strip(verdicts), class_="text"),
                make_tag("td", newest_verdict.found, " ", make_tag("span", newest_verdict.limits, class_="interval")),
                make_tag("td", *first_turn, class_="text"),
            )
        )
    head = ["criterion", "configuration", "bound", "verdicts", "figure", "newest", "first turned"]
    key = ", ".join(f"{sign} {word}" for word, sign in VERDICT_SIGNS.items())
    legend = f"{key}; empty: not judged. The line is the bound, bars are the intervals, an open ring has none."
    return join_html([make_table(head, lines, id_="strips"), make_tag("p", legend, class_="below")])


_STEP_PX, _HEIGHT_PX, _EDGE_PX = 22.0, 56.0, 6.0


def draw_strip(verdicts: Sequence[Verdict | None]) -> Html:
    """The figure with its interval over folders as SVG, the bound as a line."""
    shown = [one for one in verdicts if one is not None]
    numbers = [n for one in shown for n in (one.estimate, one.low, one.high, one.bound) if n is not None]
    low, high = min(numbers), max(numbers)
    room = (high - low) or abs(high) or 1.0
    low, high = low - 0.06 * room, high + 0.06 * room

    def place_of(value: float) -> str:
        return f"{_EDGE_PX + (high - value) / (high - low) * (_HEIGHT_PX - 2 * _EDGE_PX):.1f}"

    parts: list[Html] = []
    for k, mark in enumerate(verdicts):
        if mark is None:
            continue
        x = _STEP_PX * (k + 0.5)
        left, right = f"{x - _STEP_PX / 2:.1f}", f"{x + _STEP_PX / 2:.1f}"
        bound = place_of(mark.bound)
        parts.append(make_tag("line", x1=left, x2=right, y1=bound, y2=bound, class_="bound"))
        if mark.limits != "–":
            ends = [place_of(high if mark.high is None else mark.high), place_of(low if mark.low is None else mark.low)]
            parts.append(make_tag("line", x1=f"{x:.1f}", x2=f"{x:.1f}", y1=ends[0], y2=ends[1], class_="limits"))
        if mark.estimate is not None:
            kind = f"found {mark.verdict.replace(' ', '-')}" + ("" if mark.limits != "–" else " open")
            parts.append(make_tag("circle", cx=f"{x:.1f}", cy=place_of(mark.estimate), r="3.5", class_=kind))
    width = _STEP_PX * len(verdicts)
    words = f"{shown[-1].metric} of {count_noun(len(shown), 'folder')}, from {format_cell(low)} to {format_cell(high)}"
    return make_tag(
        "svg", *parts, class_="strip", viewBox=f"0 0 {width:g} {_HEIGHT_PX:g}", width=f"{width:g}",
        height=f"{_HEIGHT_PX:g}", role="img", aria_label=words,
    )  # fmt: skip


def _folders_table(folders: Sequence[JudgedFolder]) -> Html:
    """A row for each folder: whether it passes, counts of verdicts, runs, logs and version."""
    lines = []
    for k, folder in enumerate(folders):
        provenance = folder.results.provenance
        counts = folder.verdicts.count()
        cells = [str(counts[word]) for word in VERDICT_SIGNS]
        cells += [str(provenance.runs), str(len(provenance.logs)), str(provenance.data.get("copem_replay", "–"))]
        lines.append(
            make_tag(
                "tr",
                make_tag("th", f"{k + 1}. ", folder.title, scope="row"),
                make_tag("td", allow_breaks(str(folder.results.place)), class_="text"),
                make_tag("td", "passes" if folder.verdicts.passes else make_tag("b", "fails"), class_="text"),
                *(make_tag("td", cell) for cell in cells),
            )
        )
    head = ["", "folder", "", *VERDICT_SIGNS, "runs", "logs", "version"]
    note = "A name leads to the report where the folder has one (`copem-replay report FOLDER`)."
    return join_html([make_table(head, lines, id_="all-folders"), make_tag("p", note, class_="below")])


_FIGURES = ("ttd_rmst_s", "ttd_p95_s", "detected_share", "pass_share", SHARE)


def _summaries_table(folders: Sequence[JudgedFolder]) -> Html:
    """Figures of the summary, a table each: rows are configurations that any folder has, columns folders."""
    tables = [folder.results.summary.set_index("configuration") for folder in folders]
    names = list(dict.fromkeys(str(name) for table in tables for name in table.index))
    parts = []
    for figure in _FIGURES:
        if not any(figure in table and table[figure].notna().any() for table in tables):
            continue
        lines = [
            make_tag(
                "tr",
                make_tag("th", allow_breaks(name), scope="row"),
                *(make_tag("td", _summary_value(table, name, figure)) for table in tables),
            )
            for name in names
        ]
        parts.append(make_table(["", *(folder.label for folder in folders)], lines, caption=figure))
    return fold_parts("Figures of every configuration, from summary.csv", *parts)


def _summary_value(table: pd.DataFrame, name: str, figure: str) -> str:
    if name not in table.index or figure not in table:
        return "–"
    value = table.loc[name, figure]
    return format_cell(None if pd.isna(value) else float(value))


# Two builds side by side.


def _side_by_side(folders: Sequence[JudgedFolder], turned: dict[_Key, list[tuple[int, str, str]]]) -> Html:
    """Differences of the newest folder to the one before it, and of each folder at which a verdict turned."""
    numbers = sorted({k for turns in turned.values() for k, _, _ in turns} | {len(folders) - 1} - {0}, reverse=True)
    if not numbers:
        return make_tag("p", "One folder: nothing to hold it against.")
    parts = []
    for k in numbers:
        new, old = folders[k], folders[k - 1]
        command = f"copem-replay compare {old.results.place} {new.results.place}"
        table = fold_parts(f"{new.label} minus {old.label}", _difference_table(new, old), make_tag("code", command))
        parts.append(Html(table.replace("<details>", "<details open>", 1)) if k == numbers[0] else table)
    return join_html(parts)


def _difference_table(new: JudgedFolder, old: JudgedFolder) -> Html:
    """Differences of a folder to the one before it, a row by configuration; or a sentence on why there are none."""
    try:
        rows = list(_difference_rows(new.results, old.results))
    except InputError as error:
        return make_tag("p", f"Not comparable: {'; '.join(error.problems)}.")
    metrics = list(dict.fromkeys(str(row["metric"]) for _, metric_rows in rows for row in metric_rows))
    metrics = [name for name in COMPARED if name in metrics]
    lines = []
    for name, metric_rows in rows:
        by_metric = {str(row["metric"]): row for row in metric_rows}
        cells = (_difference_words(by_metric.get(metric)) for metric in metrics)
        lines.append(make_tag("tr", make_tag("th", allow_breaks(name), scope="row"), *cells))
    return make_table(["configuration", *metrics], lines)


def _difference_rows(new: Results, old: Results) -> Iterator[tuple[str, list[pd.Series]]]:
    """By configuration that both have, the rows of a comparison of the new one with the old one."""
    if not new.facts.keys() & old.facts.keys():
        return
    metrics = ("detected_share", "ttd_rmst_s", "unknown_to_horizon_s", "pass_share", SHARE)
    overall = compare_folders([old, new], metrics=metrics).overall
    for name, rows in overall.groupby("configuration", sort=False):
        yield str(name), [row for _, row in rows.iterrows()]


def _difference_words(row: pd.Series | None) -> Html:
    if row is None or pd.isna(row["difference"]):
        return make_tag("td", "–")
    limits = format_limits(*(math.nan if pd.isna(row[end]) else float(row[end]) for end in ("low", "high")))
    shown = format_limit(float(row["difference"]))
    between = make_tag("span", limits, class_="interval") if limits != "[–, –]" else Html("")
    return make_tag("td", shown, " ", between)
