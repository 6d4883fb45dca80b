"""The pictures of README and docs, made anew: the sample experiment and a city, in the Rerun viewer; figures.

python tools/pictures.py

The viewer draws without a window, but needs a Vulkan driver; one in software will do (Debian: mesa-vulkan-drivers).
"""

from __future__ import annotations

import argparse
import io
import os
import socket
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs/pictures"
LARGEST_BYTES = 400_000
WINDOW = "1280x720"
BAR_PX = 36
"""Of the viewer's menu, which also says that it runs without a window: cut off."""
QUESTIONS = {
    "Overview": "crowded.png",
    "Who knew when": "who_knew_when.png",
    "Side by side": "side_by_side.png",
    "Why not earlier": "why_not_earlier.png",
    "What each believes": "what_each_believes.png",
    "How far off": "how_far_off.png",
    "Units": "where_units_are.png",
}
"""By pages of the viewer's layout: what is taken of the city, with 80 road users, at 1280 × 720."""
PATIENCE_S = 180.0
SETTLED = 3
"""So many pictures in a row have to be the same: what is loaded is drawn piece by piece (chosen)."""

Picture = Image.Image


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the pictures of the README anew.")
    parser.add_argument("--out", type=Path, default=PICTURES, help="where they go [docs/pictures]")
    out = parser.parse_args().out
    os.environ["RERUN_ANALYTICS"] = "0"
    with tempfile.TemporaryDirectory() as scratch:
        folder = _run("tc016d", Path(scratch))
        differences = folder / "differences.rrd"
        _differences(folder, differences)
        made = {
            "replay.png": _seen(folder / "replay.rrd")["Overview"],
            "crossing.png": _seen(_run("crossing_memory", Path(scratch)) / "replay.rrd")["Overview"],
            "differences.png": _seen(differences)["Overview"],
            "runs.png": _drawn(folder),
        }
        seen = _seen(_city(Path(scratch) / "city") / "replay.rrd", list(QUESTIONS))
        made |= {QUESTIONS[page]: picture for page, picture in seen.items()}
    out.mkdir(parents=True, exist_ok=True)
    for name, picture in made.items():
        content = as_png(picture)
        (out / name).write_bytes(content)
        print(f"{name}: {picture.width} × {picture.height}, {len(content) / 1000:.0f} kB")


def _run(name: str, scratch: Path) -> Path:
    """The results of `copem-replay run logs/NAME.yaml`, the command beside the picture: its runs, the one it shows."""
    import copem_replay as cr

    return cr.run(ROOT / f"logs/{name}.yaml").save(scratch / name)


def _city(folder: Path) -> Path:
    """The city's results."""
    import copem_replay as cr
    from city_traffic import experiment, write

    return cr.run(experiment(write(folder.parent))).save(folder)


def _differences(folder: Path, out: Path) -> None:
    """`copem-replay compare --rrd`: two latencies beside the car's own perception."""
    from copem_replay.viewer.side_by_side import write_side_by_side

    write_side_by_side(out, [folder], configurations=["coPEM:0.5s", "coPEM:1s"], baseline="PEM")


def _drawn(folder: Path) -> Picture:
    """The figure of single runs of `copem-replay plot`."""
    from copem_replay.report.figures.selection import Selection
    from copem_replay.report.figures.single_runs import runs_figure
    from copem_replay.results.read import read_results

    content = io.BytesIO()
    runs_figure(read_results(folder), Selection()).savefig(content, format="png", dpi=130)
    return Image.open(content)


def _seen(recording: Path, pages: Sequence[str] = ("Overview",)) -> dict[str, Picture]:
    """The whole viewer as `copem-replay view` opens a recording, on each of some pages, when all of it is drawn."""
    from copem_replay.viewer.open import opening_s

    found, at_s = {}, opening_s(recording.parent, [recording])[recording]
    with _viewer() as viewer:
        viewer.open(str(recording))
        _until(lambda: viewer.get_state().views and not viewer.get_state().loading)
        viewer.set_time("elapsed", duration=at_s, play_state="paused")
        for page in pages:
            _turn_to(viewer, page)
            found[page] = _settled(viewer)
        broken = [view.name for view in viewer.get_state().views if any(r.severity == "error" for r in view.reports)]
    if broken:
        sys.exit(f"{recording.name}: the viewer could not draw {', '.join(broken)}")
    return found


def _turn_to(viewer: Any, page: str) -> None:
    """Make one of the layout's tabs the active one."""
    layout = viewer.get_blueprint().blueprint
    tabs = layout[f"/container/{layout['/viewport']['ViewportBlueprint']['root_container']}"]["ContainerBlueprint"]
    for content in tabs["contents"]:
        if layout["/" + content.lstrip("/")].get("ContainerBlueprint", {}).get("display_name") == page:
            tabs["active_tab"] = content
    viewer.set_blueprint(layout, "recording")
    time.sleep(1.0)


def _settled(viewer: Any) -> Picture:
    same: list[bytes] = []

    def settled() -> bool:
        try:
            shot = viewer.take_screenshot()
        except TimeoutError:  # on a busy machine
            return False
        same[:] = [*same, shot] if same and same[-1] == shot else [shot]
        return len(same) == SETTLED

    _until(settled)
    whole = Image.open(io.BytesIO(same[-1])).convert("RGB")
    return whole.crop((0, BAR_PX, whole.width, whole.height))


@contextmanager
def _viewer() -> Iterator[Any]:
    from rerun.experimental import ViewerClient

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # The program itself: the script of that name would leave it running when it is stopped.
    import rerun_cli

    with tempfile.TemporaryDirectory() as scratch:
        program = Path(scratch) / "viewer"  # the client has no option for the size
        real = Path(rerun_cli.__file__).with_name("rerun")
        program.write_text(f'#!/bin/sh\nexec "{real}" --window-size {WINDOW} "$@"\n')
        program.chmod(0o755)
        with redirect_stdout(sys.stderr):
            viewer = ViewerClient.spawn(
                headless=True, port=port, hide_welcome_screen=True, executable_path=str(program)
            )
        with viewer as opened:
            yield opened


def _until(done: Any) -> None:
    end = time.monotonic() + PATIENCE_S
    while not done():
        if time.monotonic() > end:
            sys.exit(f"the viewer was not ready after {PATIENCE_S:g} s")
        time.sleep(0.2)


def as_png(picture: Picture) -> bytes:
    """In its own colours if that is small enough, else in 256. Exits where that is too many bytes for a page."""
    content = io.BytesIO()
    picture.convert("RGB").save(content, format="png", optimize=True)
    if content.tell() > LARGEST_BYTES:
        content = io.BytesIO()
        # Not by how often a colour is there: nearly all of a dark window is nearly black.
        few = picture.convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        few.save(content, format="png", optimize=True)
    if content.tell() > LARGEST_BYTES:
        sys.exit(f"a picture of {content.tell()} bytes: expected at most {LARGEST_BYTES}")
    return content.getvalue()


if __name__ == "__main__":
    main()
