"""How long a recording takes to be seen, in a real viewer without a window."""

from __future__ import annotations

import sys
import time
from pathlib import Path


def first_picture(rrd: Path) -> dict[str, object]:
    """Seconds from a viewer that runs to the first picture of all its views; None: nothing to draw with."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from tests.helpers.viewer import headless_viewer, vulkan_missing

    if (reason := vulkan_missing()) is not None:
        return {"rrd_first_picture_s": None, "skipped": reason}
    with headless_viewer() as viewer:
        start = time.perf_counter()
        viewer.open(rrd)
        picture = viewer.picture()
        assert picture.max() > 0
        seconds = time.perf_counter() - start
    return {"rrd_first_picture_s": round(seconds, 2)}
