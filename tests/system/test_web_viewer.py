"""`view --web` in headless Chromium: a recording loaded, laid out and at its instant; nothing comes from elsewhere.

Needs Chromium and its driver on the PATH (Debian: chromium, chromium-driver); skipped without.
"""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest

import copem_replay as cr
from copem_replay.viewer.open import list_rrd_files, opening_s, serve_recordings
from tests.helpers.experiments import changed, drive

pytest.importorskip("selenium", reason="needs selenium, which `pip install .[dev]` brings")

OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--window-size=800,600",
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
)  # fmt: skip


@pytest.mark.long
def test_the_page_opens_at_the_instant_of_the_recording_and_asks_nobody_else(tmp_path: Path) -> None:
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service
    from selenium.webdriver.support.ui import WebDriverWait

    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs chromium and chromedriver on the PATH, found none; apt-get install chromium chromium-driver")
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(changed("show: {run: 0}"))
    folder = cr.run(tmp_path / "e.yaml").save(tmp_path / "r")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for option in (*OPTIONS, f"--user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    with serve_recordings(folder, list_rrd_files(folder)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        browser = webdriver.Chrome(options=options, service=Service(driver))
        try:
            browser.get(f"{server.url}?renderer=webgl")
            shown = browser.execute_script("return document.elementFromPoint(400, 300).innerText")
            assert shown.startswith("copem-replay view\nloading"), "not what the viewer shows while it loads"
            opened = "return document.documentElement.dataset.opened !== undefined"
            WebDriverWait(browser, 240).until(lambda _: browser.execute_script(opened))
            assert browser.execute_script("return document.elementFromPoint(400, 300).tagName") == "CANVAS"
            state = bytes(browser.execute_script("return [...window._handle.viewer_state()]"))
            log = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
        finally:
            browser.quit()
            server.shutdown()
            thread.join()
    # A cursor: timeline `elapsed`, a duration, at this many nanoseconds, seven bits a byte, the lowest first.
    [at_s] = opening_s(folder, list_rrd_files(folder)).values()
    assert at_s > 0.5
    instant = bytes(round(at_s * 1e9) >> 7 * k & 127 | 128 * (k < 4) for k in range(5))
    assert b"\x0a\x09\x0a\x07elapsed\x10\x02\x1a\x06\x08" + instant in state
    for view in (b"PEM", b"coPEM", b"GOSPA of all measured objects"):
        assert view in state, "the layout of the recording, not the viewer's own"
    answered = {m["params"]["response"]["url"] for m in log if m["method"] == "Network.responseReceived"}
    hosts = {urlsplit(url).netloc for url in answered if not url.startswith(("data:", "blob:", "chrome"))}
    assert hosts == {urlsplit(server.url).netloc}
