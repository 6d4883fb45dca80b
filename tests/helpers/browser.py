"""Headless Chromium, as readers of reports have it, through Selenium.

Needs Chromium and its driver on the PATH (Debian: chromium, chromium-driver); tests skip without.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--window-size=1280,900",
)  # fmt: skip


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

    def scheme(self, name: str) -> None:
        """`light`, `dark`: which the reader prefers; empty: as it was."""
        features = [{"name": "prefers-color-scheme", "value": name}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": features})


@contextmanager
def opened_browser(user: Path) -> Iterator[Browser]:
    """A browser with its data in the folder `user`; skips the test where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium, which `pip install .[dev]` brings")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs chromium and chromedriver on the PATH, found none; apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for option in (*OPTIONS, f"--user-data-dir={user}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    opened = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield Browser(opened)
    opened.quit()
