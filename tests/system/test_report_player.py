"""The player of a report in headless Chromium: opened from a file, driven by its slider, its list and by keys.

The scene of `report_pages`: two pedestrians stand, their clocks start at 0.5 s. `late` knows them with the list
captured then, which comes 0.5 s later; `hit` at 2.3 s; `never` does not.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from copem_replay.report import write_html_report
from tests.helpers.browser import Browser, opened_browser
from tests.helpers.report_pages import changed, replayed

pytestmark = pytest.mark.long

PIXELS = """
const [panel, red, green, blue] = arguments, canvas = document.querySelectorAll("#player canvas")[panel];
const found = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height - 24).data;
let count = 0;
for (let k = 0; k < found.length; k += 4) {
  if (Math.abs(found[k] - red) + Math.abs(found[k + 1] - green) + Math.abs(found[k + 2] - blue) < 12) count += 1;
}
return count;
"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_html_report(replayed(tmp_path_factory.mktemp("made"), changed(("show: null\n", ""))))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with opened_browser(tmp_path_factory.mktemp("user")) as opened:
        yield opened


@pytest.fixture
def played(browser: Browser, report: Path) -> Browser:
    browser.open(report)
    choose(browser, 0, "late")
    choose(browser, 1, "never")
    return browser


def choose(browser: Browser, panel: int, name: str) -> None:
    browser.run(
        """const select = document.querySelectorAll("#player select")[arguments[0]];
        select.value = [...select.options].find((one) => one.text === arguments[1]).value;
        select.dispatchEvent(new Event("change"));""",
        panel,
        name,
    )


def press(browser: Browser, *keys: str) -> None:
    player = browser.driver.find_element("id", "player")
    browser.run("document.getElementById('player').focus({preventScroll: true})")
    for key in keys:
        player.send_keys(key)


def move_to(browser: Browser, at_s: float) -> None:
    browser.run(
        """const slider = document.querySelector("#player .moment");
        slider.value = arguments[0];
        slider.dispatchEvent(new Event("input"));""",
        round(10 * at_s),
    )


def says(browser: Browser) -> list[str]:
    found = browser.run('return [...document.querySelectorAll("#player .counted")].map((one) => one.textContent)')
    assert isinstance(found, list)
    return found


def test_it_counts_what_is_known_at_each_instant(played: Browser, report: Path) -> None:
    for at_s, late in ((0.4, "0 of 0"), (0.9, "0 of 2"), (1.0, "2 of 2")):
        move_to(played, at_s)
        never = late.replace("2 of", "0 of")
        assert says(played) == [f"{late} known · 0 false", f"{never} known · 0 false"]
        assert played.run('return document.querySelector("#player output").textContent') == f"{at_s} s"
    assert played.said() == []
    assert played.asked_for(report) == set()


def test_what_is_listed_is_drawn_in_the_colour_of_its_configuration(played: Browser) -> None:
    colour = played.run("return document.querySelector('#played').textContent.match(/#[0-9a-f]{6}/)[0]")
    rgb = list(bytes.fromhex(colour[1:]))
    counts = []
    for at_s in (0.2, 0.8, 1.2):  # the first list comes at 0.5 s: then outlines, from 1.0 s on filled
        move_to(played, at_s)
        counts.append(played.run(PIXELS, 0, *rgb))
        assert played.run(PIXELS, 1, *rgb) == 0
    assert counts[0] == 0 < counts[1]
    pale = [round(0.85 * part + 0.15 * 255) for part in rgb]
    filled = played.run(PIXELS, 0, *pale)
    move_to(played, 0.8)
    outlined = played.run(PIXELS, 0, *pale)
    assert filled > 8
    assert filled > 2 * outlined, "edges of outlines have a few pixels of any colour"


def test_the_list_says_when_each_was_known_and_chooses(played: Browser) -> None:
    rows = (
        'return [...document.querySelectorAll("#player tbody tr")].map((r) => [...r.cells].map((c) => c.textContent))'
    )
    assert played.run(rows) == [[who, "0.50 s", "never", "story"] for who in ("2 pedestrian", "3 pedestrian")]
    played.run('document.querySelectorAll("#player tbody button")[1].click()')
    assert played.run('return document.getElementById("player").dataset.object') == "3"
    pressed = 'return [...document.querySelectorAll("#player tbody button")].map((b) => b.ariaPressed)'
    assert played.run(pressed) == ["false", "true"]


def test_tables_lead_to_story_and_player_and_say_the_command(played: Browser) -> None:
    """Of the second object: from the table of those never detected, from its story, and from the player's own list."""
    cells = played.run(
        "return [...document.querySelectorAll('#never tbody tr:nth-child(2) td')].map((one) => one.innerText)"
    )
    assert (cells[0], cells[-1]) == ("3", "story player copem-replay view FOLDER --object 3")
    played.run("document.querySelector('#never tr:nth-child(2) [data-played]').click()")
    at = "return [location.hash, document.querySelector('#player').dataset.object]"
    assert played.run(at) == ["#player", "3"]
    assert played.run("return document.querySelector('.command').textContent") == "copem-replay view FOLDER --object 3"
    for link in ("#never tr:nth-child(2) a", "#player tbody tr:nth-child(2) a"):
        shown = f"""document.querySelector({link!r}).click();
            return document.querySelector(location.hash).querySelector("h3").textContent"""
        assert played.run(shown).startswith("pedestrian 3: ")
        played.run("document.querySelector('.told:has(h3) [data-played=\"2\"]').click()")
        assert played.run(at) == ["#player", "2"]
    played.run("document.querySelector('#never th:nth-child(2) .sort').click()")
    assert played.run("return document.querySelectorAll('#never [data-played]').length") == 2, "sorting keeps links"


def test_keys_move_in_time_and_between_objects(played: Browser) -> None:
    from selenium.webdriver.common.keys import Keys

    def at() -> tuple[str, str]:
        of = played.run('return {...document.getElementById("player").dataset}')
        return of["frame"], of["object"]

    press(played, Keys.HOME)
    assert at() == ("0", "2")
    press(played, Keys.ARROW_LEFT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.SHIFT + Keys.ARROW_RIGHT)
    assert at() == ("12", "2")
    press(played, Keys.END)
    assert at() == ("50", "2")
    press(played, "n")
    assert at()[1] == "3"
    press(played, "n")
    assert at()[1] == "2"
    press(played, "p")
    assert at()[1] == "3"
    press(played, Keys.HOME, "x")
    move_to(played, 1.0)
    assert says(played) == ["0 of 2 known · 0 false", "2 of 2 known · 0 false"]
    press(played, Keys.SPACE)
    assert played.run('return document.querySelector("#player .play").textContent') == "pause"
    press(played, Keys.SPACE)
    assert played.run('return document.querySelector("#player .play").textContent') == "play"


def test_it_opens_where_the_two_differ(browser: Browser, report: Path) -> None:
    browser.open(report)
    known = [int(text.split(" ")[0]) for text in says(browser)]
    assert known[0] != known[1]


def test_on_a_phone_the_panels_are_stacked(played: Browser) -> None:
    played.narrow(390)
    boxes = """return [...document.querySelectorAll("#player canvas")]
      .map((one) => one.getBoundingClientRect()).map((box) => [box.left, box.top, box.right, box.bottom])"""
    first, second = played.run(boxes)
    played.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert first[3] < second[1]
    assert max(first[2], second[2]) <= 390


def test_on_paper_every_row_of_the_list_has_its_name(played: Browser) -> None:
    played.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        drawn = played.run(
            """return [...document.querySelectorAll("#player .objects button")].map((one) => one.offsetWidth > 0);"""
        )
        squashed = played.run(
            """return [...document.querySelectorAll("#player canvas")].map((one) =>
              (one.offsetWidth / one.offsetHeight) / (one.width / one.height));"""
        )
    finally:
        played.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert drawn == [True, True]
    assert squashed == pytest.approx([1.0, 1.0], abs=0.03)
