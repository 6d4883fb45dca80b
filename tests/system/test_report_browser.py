"""Reports opened in headless Chromium, as a reader has them: all figures drawn, nothing asked of a network, no error.

Needs Chromium and its driver on the PATH (Debian: chromium, chromium-driver); skipped without.
"""

from __future__ import annotations

import base64
import csv
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from copem_replay.report import write_report
from tests.helpers.report_pages import ONE, changed, replayed

selenium = pytest.importorskip("selenium", reason="needs selenium, which `pip install .[dev]` brings")

NAMES = ["GT", "<img src=x onerror=alert(1)>", "half", "hit", "never"]
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--window-size=1280,900",
)  # fmt: skip
SIZES = """
return [...document.querySelectorAll(".plot")].map((plot) => {
  const svg = plot.querySelector("svg");
  const box = svg ? svg.getBoundingClientRect() : { width: 0, height: 0 };
  const drawn = [...plot.querySelectorAll("path")].filter((t) => t.getBoundingClientRect().width > 0);
  return { id: plot.id, width: box.width, height: box.height, drawn: drawn.length };
});
"""


class Browser:
    """A page in a browser, and what the browser said of it."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver
        self.run = driver.execute_script

    def open(self, page: Path) -> None:
        from selenium.webdriver.support.ui import WebDriverWait

        self.driver.get(page.as_uri())
        WebDriverWait(self.driver, 120).until(lambda _: self.run("return document.documentElement.dataset.drawn"))

    def narrow(self, width: int) -> None:
        """As a phone shows it."""
        size = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": True}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)

    def said(self) -> list[str]:
        """What is on the console: errors, warnings, what was refused."""
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def asked_for(self, page: Path) -> set[str]:
        """Addresses that the page asked for, but itself and what it holds in itself."""
        found = set()
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                asked = message["params"]
                url = asked["request"]["url"]
                if asked.get("documentURL") == page.as_uri() and not url.startswith(("data:", "blob:")):
                    found.add(url)
        return found - {page.as_uri()}


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs chromium and chromedriver on the PATH, found none; apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for option in (*OPTIONS, f"--user-data-dir={tmp_path_factory.mktemp('user')}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    opened = webdriver.Chrome(options=options, service=Service(driver))
    yield Browser(opened)
    opened.quit()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    text = changed(ONE, ("  late:", f"  {json.dumps(NAMES[1])}:")) + "sweep: {latency_s: [0, 0.5]}\n"
    return replayed(tmp_path_factory.mktemp("made"), text)


@pytest.fixture(scope="module")
def report(folder: Path) -> Path:
    return write_report(folder)


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
    assert [one["id"] for one in found] == ["curves", "distances", "latency_breakdown", "sweeps"]
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
    assert [name for name, _ in shown] == [row["configuration"] for row in rows] == NAMES
    for (_, cells), row in zip(shown, rows, strict=True):
        assert len(cells) == 8
        assert cells == {name: row[name] for name in cells}


def test_names_in_figures_do_nothing(opened: Browser) -> None:
    assert opened.run('return document.querySelectorAll("main img, main svg text").length') == 0


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


def test_on_a_phone_figures_are_scrolled(browser: Browser, report: Path) -> None:
    browser.narrow(390)
    browser.open(report)
    for one in browser.run(SIZES):
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
