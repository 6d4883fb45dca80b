"""Reports opened in headless Chromium, as readers have them: all figures drawn, no network asked, no error."""

from __future__ import annotations

import base64
import csv
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from copem_replay.report import write_html_report
from tests.helpers.browser import Browser, opened_browser
from tests.helpers.report_pages import ONE, changed, replayed

pytestmark = pytest.mark.long

NAMES = ["GT", "<img src=x onerror=alert(1)>", "half", "hit", "never"]
SIZES = """
return [...document.querySelectorAll(".plot")].filter((plot) => plot.checkVisibility()).map((plot) => {
  const svg = plot.querySelector("svg");
  const box = svg ? svg.getBoundingClientRect() : { width: 0, height: 0 };
  const drawn = [...plot.querySelectorAll("path")].filter((t) => t.getBoundingClientRect().width > 0);
  return { id: plot.id, width: box.width, height: box.height, drawn: drawn.length };
});
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with opened_browser(tmp_path_factory.mktemp("user")) as opened:
        yield opened


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    text = changed(ONE, ("  late:", f"  {json.dumps(NAMES[1])}:")) + "sweep: {latency_s: [0, 0.5]}\n"
    return replayed(tmp_path_factory.mktemp("made"), text)


@pytest.fixture(scope="module")
def report(folder: Path) -> Path:
    return write_html_report(folder)


@pytest.fixture(scope="module")
def once(browser: Browser, report: Path) -> Browser:
    browser.open(report)
    return browser


@pytest.fixture
def opened(once: Browser, report: Path) -> Iterator[Browser]:
    """The report as it is opened on a desktop; what a test did to it is undone."""
    if once.driver.current_url != report.as_uri():
        once.open(report)
    yield once
    once.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    once.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_every_figure_is_drawn_and_nothing_goes_wrong(opened: Browser, report: Path) -> None:
    found = opened.run(SIZES)
    assert [one["id"] for one in found] == [
        "answer",
        "differences",
        "late_paths",
        "curves",
        "distances",
        "latency_breakdown",
        "sweeps",
    ]
    for one in found:
        assert one["width"] > 200, one
        assert one["height"] > 100, one
        assert one["drawn"] > 5, one
    assert opened.said() == []
    assert opened.asked_for(report) == set()


def test_the_summary_has_the_numbers_of_the_file(opened: Browser, folder: Path) -> None:
    shown = opened.run(
        """const cells = (row) => [...row.querySelectorAll("td")].map((c) => [c.dataset.column, c.dataset.value || ""]);
        const rows = [...document.querySelectorAll("#summary tbody tr")];
        return rows.map((row) => [row.dataset.row, Object.fromEntries(cells(row))]);"""
    )
    with (folder / "summary.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["configuration"] for row in rows] == NAMES
    assert [name for name, _ in shown] == ["GT", "half", NAMES[1], "hit", "never"], "the soonest first, as in figures"
    by_name = {row["configuration"]: row for row in rows}
    for configuration, cells in shown:
        assert len(cells) == 8
        assert cells == {name: by_name[configuration][name] for name in cells}


def test_a_header_sorts_its_table(opened: Browser) -> None:
    names = 'return [...document.querySelectorAll("#summary tbody tr")].map((row) => row.dataset.row)'
    before = opened.run(names)
    press = 'document.querySelectorAll("#summary thead button")[1].click()'
    opened.run(press)
    opened.run(press)
    assert opened.run(names) == before[::-1], "the latest first"
    assert opened.run('return document.querySelectorAll("#summary thead th")[1].ariaSort') == "descending"
    opened.run(press)
    assert opened.run(names) == before


def test_pointing_at_a_row_shows_its_configuration_in_figures(opened: Browser) -> None:
    strong = """document.querySelector(`#summary tr[data-row="${arguments[0]}"]`)
        .dispatchEvent(new PointerEvent("pointerover", {bubbles: true}));
      return [...document.querySelectorAll('#curves [id*="-configuration-"]')]
        .filter((one) => getComputedStyle(one).opacity === "1").map((one) => Number(one.id.split("-")[2]))"""
    assert set(opened.run(strong, "half")) == {2}
    every = """document.querySelector("h1").dispatchEvent(new PointerEvent("pointerover", {bubbles: true}));
      return document.querySelectorAll(".pointed, .at").length"""
    assert opened.run(every) == 0


def test_names_in_figures_do_nothing(opened: Browser) -> None:
    assert opened.run('return document.querySelectorAll("main img, .plot svg text").length') == 0


def test_a_configuration_can_be_left_out(opened: Browser) -> None:
    def shown() -> set[tuple[str, int]]:
        """Of which configuration something can be seen, in each figure."""
        found = opened.run(
            """return [...document.querySelectorAll('.plot [id*="-configuration-"]')]
              .filter((g) => g.getClientRects().length).map((g) => g.id)"""
        )
        return {(id_.partition("-")[0], int(id_.split("-")[2])) for id_ in found}

    def press(what: str) -> None:
        opened.run("document.querySelector(arguments[0]).click()", f"#key button[{what}]")

    before = shown()
    assert before >= {(name, k) for name in ("curves", "distances", "latency_breakdown") for k in range(5)}
    assert before >= {("answer", k) for k in range(1, 5)}, "the ground truth is a line of all"
    press('data-configuration="2"')
    assert shown() == {(name, k) for name, k in before if k != 2}
    press('data-every="none"')
    assert shown() == set()
    press('data-every="all"')
    assert shown() == before
    assert opened.said() == []


def test_on_a_phone_only_tables_and_figures_scroll_sideways(opened: Browser) -> None:
    opened.narrow(390)
    width = opened.run("return [document.documentElement.scrollWidth, window.innerWidth]")
    assert width == [390, 390]
    tables = '[...document.querySelectorAll(".scroll:not(.figure)")]'
    wide = opened.run(f"return {tables}.filter((s) => s.scrollWidth > s.clientWidth).length")
    assert wide > 0, "a table wider than the page is there to be scrolled"


BROKEN = """
const broken = [];
for (const cell of document.querySelectorAll("th, td")) {
  const texts = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const text = texts.currentNode, range = document.createRange();
    for (const word of text.data.matchAll(/[\\p{L}\\p{N}]+/gu)) {
      range.setStart(text, word.index);
      range.setEnd(text, word.index + word[0].length);
      if (new Set([...range.getClientRects()].map((box) => Math.round(box.top))).size > 1) broken.push(word[0]);
    }
  }
}
return broken;
"""
UNNAMED = """
return [...document.querySelectorAll("svg, canvas, img, [role=img]")].filter((one) =>
  !one.closest("[aria-hidden=true]") && !(one.getAttribute("aria-label") || "").trim()).map((one) => one.outerHTML);
"""


def test_on_a_phone_no_word_of_a_table_is_broken(opened: Browser) -> None:
    """But for digests, which no line holds."""
    opened.narrow(390)
    assert [word for word in opened.run(BROKEN) if len(word) < 40] == []
    cut = (
        "return [...document.querySelectorAll('th, td')].filter((one) => one.scrollWidth > one.clientWidth + 1).length"
    )
    assert opened.run(cut) == 0


def test_every_graphic_has_a_name_or_is_an_ornament(opened: Browser) -> None:
    assert opened.run(UNNAMED) == []
    assert opened.run("return document.querySelectorAll('svg').length") > 20


def test_on_a_phone_the_name_stays_and_times_come_first(opened: Browser) -> None:
    opened.narrow(390)
    first, column = opened.run(
        """const scroll = document.querySelector("#summary").closest(".scroll");
        scroll.scrollLeft = 0;
        const times = scroll.querySelector("tbody td").getBoundingClientRect();
        scroll.scrollLeft = scroll.scrollWidth;
        const name = scroll.querySelector("tbody th").getBoundingClientRect();
        const cell = scroll.querySelector("tbody td");
        const found = [[cell.dataset.column, times.right], name.left];
        scroll.scrollLeft = 0;
        return found;"""
    )
    assert first[0] == "ttd_rmst_s"
    assert first[1] <= 390, "seen without scrolling"
    assert 0 <= column <= 20, "at the left edge though the table is scrolled"


def test_a_dark_page_has_dark_paper_and_light_letters_in_figures_too(opened: Browser) -> None:
    lightness = """
      const level = (colour) => colour.match(/\\d+/g).slice(0, 3).map(Number).reduce((a, b) => a + b) / 765;
      const style = (element) => getComputedStyle(element);
      const label = document.querySelector("#answer [id*='-ytick_'] use, #answer [id*='-ytick_'] path");
      const paper = document.querySelector("#answer [id$='-patch_1'] path");
      return [level(style(document.body).backgroundColor), level(style(document.body).color),
              level(style(label).fill), level(style(paper).fill)];"""
    opened.scheme("dark")
    paper, ink, label, figure = opened.run(lightness)
    assert paper < 0.2 < 0.8 < min(ink, label)
    assert figure == pytest.approx(paper, abs=0.01)
    dot = """const third = document.querySelectorAll("#answer [id*='configuration-2-']");
      return [...third].flatMap((g) => [...g.querySelectorAll("use, path")]).map((e) => getComputedStyle(e).fill)"""
    dark = opened.run(dot)
    opened.scheme("light")
    paper, ink, label, figure = opened.run(lightness)
    assert max(ink, label) < 0.2 < 0.99 < paper
    assert figure == pytest.approx(paper, abs=0.01)
    light = opened.run(dot)
    assert len(set(dark)) > 1 < len(set(light))
    assert set(dark) != set(light), "a configuration has a colour for each ground"
    opened.scheme("")


def test_the_contents_lead_to_every_section(opened: Browser) -> None:
    titles, links = opened.run(
        """const title = (a) => document.querySelector(a.getAttribute("href") + " > h2").textContent;
        return [[...document.querySelectorAll("main > section > h2")].map((h) => h.textContent),
                [...document.querySelectorAll("nav a")].map(title)]"""
    )
    assert titles == links
    assert titles[0] == "Differences"


def test_on_a_phone_the_answer_is_stacked_and_other_figures_are_scrolled(browser: Browser, report: Path) -> None:
    browser.narrow(390)
    browser.open(report)
    answer, *others = browser.run(SIZES)
    assert answer["id"] == "answer-stacked"
    assert 340 <= answer["width"] <= 362, "as wide as the page"
    panels, words, sideways, note = browser.run(
        """const plot = document.querySelector("#answer-stacked"), box = (e) => e.getBoundingClientRect();
        const ground = (k) => plot.querySelector(`#answer-stacked-axes_${k} > [id*="-patch_"]`);
        const panels = [1, 2].map((k) => box(ground(k)));
        const texts = [...plot.querySelectorAll("[id*='-text_']")].map(box);
        const scroll = plot.closest(".scroll"), note = document.querySelector(".beside .note");
        return [panels.map((p) => [p.left, p.width, p.top, p.bottom]),
                [Math.min(...texts.map((t) => t.left)), Math.max(...texts.map((t) => t.right))],
                scroll.scrollWidth - scroll.clientWidth, note.checkVisibility() && note.textContent];"""
    )
    (left, width, _, bottom), (below_left, below_width, top, _) = panels
    assert abs(left - below_left) < 1
    assert min(width, below_width) > 150, "a long name leaves room for the axis"
    assert bottom < top, "the share is below the times"
    assert 0 <= words[0] < words[1] <= 390, "no word is cut"
    assert sideways == 0, "nothing to scroll"
    assert "Mean of min(time" in note, "its caption is text of the page"
    for one in others:
        assert one["width"] == 600, one  # letters that can be read
    wide = 'return [...document.querySelectorAll(".figure")].map((frame) => frame.getBoundingClientRect().width)'
    assert max(browser.run(wide)) <= 362
    browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_on_paper_nothing_is_cut_off(opened: Browser) -> None:
    printed = opened.driver.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True, "printBackground": True})
    assert base64.b64decode(printed["data"]).startswith(b"%PDF-")
    opened.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    opened.driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride", {"width": 688, "height": 1000, "deviceScaleFactor": 1, "mobile": False}
    )
    tables = opened.run(
        'return [...document.querySelectorAll("table")].map((t) => [t.id, t.getBoundingClientRect().right])'
    )
    assert [id_ for id_, right in tables if right > 688] == []
    figures = opened.run(SIZES)
    assert [one["id"] for one in figures if not 300 < one["width"] <= 688] == []
    assert opened.said() == []


def test_the_browser_would_tell(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "wrong.html"
    page.write_text(
        '<html data-drawn="0"><link rel="icon" href="data:,"><img src="missing.png"><script>fail()</script></html>',
        encoding="utf-8",
    )
    browser.open(page)
    assert browser.asked_for(page) == {(tmp_path / "missing.png").as_uri()}
    assert any("fail is not defined" in line for line in browser.said())
