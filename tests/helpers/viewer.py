"""A real Rerun viewer without a window, drawn by the processor: the one place that knows how to start and ask it."""

from __future__ import annotations

import ctypes.util
import io
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

os.environ["RERUN_ANALYTICS"] = "0"  # before it is imported

READY_S = 120.0
"""How long it may take until everything is loaded (chosen: many times what it takes on a busy machine)."""


def vulkan_missing() -> str | None:
    """Why no viewer can draw here, or None."""
    drivers = [*Path("/usr/share/vulkan/icd.d").glob("lvp_icd*"), *Path("/dev/dri").glob("render*")]
    if ctypes.util.find_library("vulkan") is None or not drivers:
        return "no Vulkan to draw with (Debian: mesa-vulkan-drivers libvulkan1)"
    return None


def free_port() -> int:
    with socket.socket() as any_port:
        any_port.bind(("127.0.0.1", 0))
        return int(any_port.getsockname()[1])


class Viewer:
    """What a test may ask a viewer."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self.url: str = client.url

    def open(self, path: Path) -> None:
        """Open a file; returns when it is loaded and laid out."""
        self._client.open(str(path.resolve()))
        self.wait(set())

    def wait(self, views: set[str]) -> None:
        """Until these views, one at least, are there and nothing is being loaded."""
        until = time.monotonic() + READY_S
        while not (self.views() and self.views() >= views) or self._client.get_state().loading:
            assert time.monotonic() < until, f"not loaded within {READY_S} s: {self.views()}"
            time.sleep(0.05)

    def views(self) -> set[str]:
        return {view.name for view in self._client.get_state().views}

    def errors(self) -> list[str]:
        """What views and the viewer itself complain of."""
        reports = [str(r) for v in self._client.get_state().views for r in v.reports if r.severity == "error"]
        return reports + [entry.message for entry in self._client.get_logs() if entry.level == "ERROR"]

    def entities(self) -> set[str]:
        return {entity.entity_path for entity in self._client.get_recording_schema().entities}

    def cursors(self) -> dict[str, tuple[str | None, int | None]]:
        """Timeline and instant, in its unit, of each recording by its id."""
        recordings = self._client.get_state().recordings
        return {one.store_id.rpartition(":")[2]: (one.current_timeline, one.current_time) for one in recordings}

    def seek(self, elapsed_s: float) -> None:
        self._client.set_time("elapsed", duration=elapsed_s, play_state="paused")

    def picture(self, view: str | None = None) -> np.ndarray:
        """All of it, or one view: (height, width, 3), 0 … 255."""
        from PIL import Image

        ids = {v.name: v.view_id for v in self._client.get_state().views}
        png = self._client.take_screenshot(view_id=None if view is None else ids[view], max_size=1200)
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


@contextmanager
def headless_viewer() -> Iterator[Viewer]:
    """A viewer; the test is skipped where it could not draw."""
    if (reason := vulkan_missing()) is not None:
        pytest.skip(reason)
    from rerun.experimental import ViewerClient

    command = str(Path(sys.executable).parent / "rerun")
    with ViewerClient.spawn(
        headless=True, port=free_port(), hide_welcome_screen=True, executable_path=command
    ) as client:
        yield Viewer(client)
