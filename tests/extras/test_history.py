"""Verdicts on pages: the section of a report, and the history of several folders."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import copem_replay as cr
from copem_replay.extras.history.history import draw_strip, find_turns
from copem_replay.results.verdicts import FILE, MET, NOT_MET, UNDECIDED, WORDS, write_verdicts
from tests.helpers.compare_folders import unseal
from tests.helpers.report_pages import changed, replayed
from tests.results.test_verdicts import verdict

CRITERIA = {
    "soon & <sure>": {"metric": "ttd_rmst_s", "at_most": 0.4},
    "seen": {"metric": "detected_share", "at_least": 0.5, "population": "these_logs"},
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three builds on the same log; the second has another latency."""
    of = []
    for k, text in enumerate((changed(), changed(("latency_s: 0.5", "latency_s: 0.9")), changed())):
        folder = replayed(tmp_path_factory.mktemp(f"build{k}"), text)
        write_verdicts(cr.judge(folder, CRITERIA), folder / FILE)
        of.append(folder)
    return of


def label_of(folder: Path, label: str) -> None:
    path = unseal(folder) / "provenance.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"label": label}))


def test_a_report_begins_with_the_verdicts(folders: list[Path], tmp_path: Path) -> None:
    html = cr.write_report(folders[0], tmp_path / "r.html").read_text()
    sections = re.findall(r'<section id="([^"]*)"', html)
    assert sections[0] == "criteria"
    assert "soon &amp; &lt;sure&gt;" in html
    assert cr.judge(folders[0], CRITERIA).headline in html


def test_a_history_has_a_strip_for_each_criterion_and_leads_to_the_reports(folders: list[Path], tmp_path: Path) -> None:
    for k, folder in enumerate(folders):
        label_of(folder, f"build <{k}>")
    report = cr.write_report(folders[1])
    page = cr.write_history(folders, tmp_path / "pages" / "history.html")
    html = page.read_text()
    of = cr.judge(folders[0], CRITERIA).all
    body = html[html.index('id="strips"') :]
    body = body[: body.index("</table>")]
    assert body.count("<tr>") == 1 + len(of)
    assert body.count('class="mark ') == 3 * len(of)
    assert "build &lt;1&gt;" in html
    (link,) = set(re.findall(r'href="([^"#]*report.html)"', html))
    assert (page.parent / link).resolve() == report.resolve()
    assert "late, " not in html
    assert "build &lt;2&gt; minus build &lt;1&gt;" in html
    assert page.read_text() == cr.write_history(folders, page).read_text()
    assert not re.search(r'(?:src|href)="https?:', html)


def test_the_first_folder_at_which_a_verdict_turned() -> None:
    of = [verdict(word) for word in (MET, MET, NOT_MET, UNDECIDED)]
    assert find_turns([of[0], None, of[1], of[2], None, of[3]]) == [(3, MET, NOT_MET), (5, NOT_MET, UNDECIDED)]
    assert find_turns([None, of[0]]) == []


@given(st.lists(st.none() | st.sampled_from(WORDS), min_size=1, max_size=9).filter(lambda of: any(of)))
def test_a_strip_draws_what_is_there(words: list[str | None]) -> None:
    of = [None if word is None else verdict(word) for word in words]
    svg = draw_strip(of)
    assert svg.count("<circle") == sum(one is not None and one.estimate is not None for one in of)
    assert svg.count('class="bound"') == sum(one is not None for one in of)
    places = [float(found) for found in re.findall(r'(?:y1|y2|cy)="([^"]*)"', svg)]
    assert all(0 <= place <= 56 for place in places)


def tamper(folder: Path) -> Any:
    path = folder / FILE
    before = path.read_text()
    path.write_text(before.replace('"bound": 0.4', '"bound": 0.5', 1))
    assert path.read_text() != before
    return path, before


def test_what_cannot_be_in_a_history_is_named(folders: list[Path], tmp_path: Path) -> None:
    path, before = tamper(folders[1])
    bare = replayed(tmp_path, changed())
    try:
        with pytest.raises(cr.InputError) as caught:
            cr.write_history([*folders, folders[0], bare, tmp_path / "nowhere"], tmp_path / "h.html")
    finally:
        path.write_text(before)
    found = str(caught.value).splitlines()
    assert [line.partition(": ")[0] for line in found] == [
        str(folders[1] / FILE), str(folders[0]), str(bare), str(tmp_path / "nowhere")
    ]  # fmt: skip
    assert "expected each folder once" in found[1]
    assert f"expected {FILE}, found none; `copem-replay verdict {bare}` writes it" in found[2]
    assert not (tmp_path / "h.html").exists()
