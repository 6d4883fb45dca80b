"""Reports held against the rules of axe-core in headless Chromium: nothing serious or critical, light and dark.

axe-core comes with selenium-axe-python, which `pip install .[dev]` brings; skipped without it or without Chromium.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.report import write_html_report
from tests.helpers.browser import Browser, opened_browser
from tests.helpers.replays import save_run
from tests.helpers.report_pages import eighteen, replayed

pytestmark = pytest.mark.long

axe = pytest.importorskip("selenium_axe_python", reason="needs selenium-axe-python, which `pip install .[dev]` brings")
DEMO = Path(__file__).parents[2] / "logs/tc016d.yaml"
GRAVE = ("serious", "critical")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with opened_browser(tmp_path_factory.mktemp("user")) as opened:
        opened.driver.set_script_timeout(120)
        yield opened


def demo(place: Path) -> Path:
    """The sample experiment in fewer runs, one of which the page plays."""
    source = read_experiment_file(DEMO)
    experiment, found = find_problems(source)
    assert experiment is not None, found
    experiment = experiment.model_copy(update={"runs": 20})
    recordings, refused = read_logs(experiment, log_paths(source)[0], source)
    assert not refused
    save_run(place / "demo", experiment, recordings)
    return place / "demo"


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("reports")
    (place / "many").mkdir()
    return {"demo": write_html_report(demo(place)), "eighteen": write_html_report(replayed(place / "many", eighteen()))}


def violations(browser: Browser) -> list[dict[str, Any]]:
    """Grave violations on the page that is open."""
    checker = axe.Axe(browser.driver)
    checker.inject()
    found = checker.run("{exclude: [['.plot svg']]}")  # whose shapes are one image each to readers, with a name
    assert len(found["passes"]) > 10, "rules were applied"
    return [one for one in found["violations"] if one["impact"] in GRAVE]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["demo", "eighteen"])
def test_no_grave_violation(browser: Browser, reports: dict[str, Path], name: str, scheme: str) -> None:
    browser.scheme(scheme)
    browser.open(reports[name])
    assert browser.run("return document.getElementById('player') !== null") == (name == "demo")
    for details in browser.driver.find_elements("css selector", "details"):
        browser.run("arguments[0].open = true", details)
    found = violations(browser)
    assert not found, axe.Axe.report(found)


def test_it_would_tell(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "wrong.html"
    page.write_text(
        '<html data-drawn="0"><body style="background: white"><p style="color: #bbb">too pale</p><img src="data:,">'
        "<button></button></body></html>",
        encoding="utf-8",
    )
    browser.scheme("light")
    browser.open(page)
    checker = axe.Axe(browser.driver)
    checker.inject()
    found = {one["id"] for one in checker.run()["violations"] if one["impact"] in GRAVE}
    assert {"color-contrast", "image-alt", "button-name", "html-has-lang"} <= found
