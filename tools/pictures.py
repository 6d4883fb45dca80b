"""The pictures of the README, made anew: the sample experiment, its recordings in the Rerun viewer, its figures.

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
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs/pictures"
LARGEST_BYTES = 300_000
WIDE_PX = 1400
BAR_PX = 36
"""Of the viewer's menu, which also says that it runs without a window: cut off."""
AT_S = 3.6
"""Of the recording: 0.6 s after the pedestrian's first step (chosen: some know of him, others not yet)."""
PATIENCE_S = 60.0
SETTLED = 3
"""So many pictures in a row have to be the same: what is loaded is drawn piece by piece (chosen)."""

Picture = Image.Image


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the pictures of the README anew.")
    parser.add_argument("--out", type=Path, default=PICTURES, help="where they go [docs/pictures]")
    out = parser.parse_args().out
    os.environ["RERUN_ANALYTICS"] = "0"
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "tc016d"
        _replay(folder)
        differences = Path(scratch) / "differences.rrd"
        _differences(folder, differences)
        made = {
            "replay.png": _seen(folder / "replay.rrd"),
            "differences.png": _seen(differences),
            "runs.png": _drawn(folder),
        }
    out.mkdir(parents=True, exist_ok=True)
    for name, picture in made.items():
        content = as_png(picture)
        (out / name).write_bytes(content)
        print(f"{name}: {picture.width} × {picture.height}, {len(content) / 1000:.0f} kB")


def _replay(folder: Path) -> None:
    """`copem-replay run logs/tc016d.yaml`, with the median run shown."""
    from copem_replay.experiment.file import load, log_paths
    from copem_replay.experiment.schema import Show
    from copem_replay.experiment.validate import problems, read_logs
    from copem_replay.pipeline.run import run
    from copem_replay.results.write import write_results
    from copem_replay.viewer.export import EXPORTERS

    source = load(ROOT / "logs/tc016d.yaml")
    experiment, wrong = problems(source)
    if experiment is None or wrong:
        sys.exit("\n".join(wrong))
    experiment = experiment.model_copy(update={"show": Show(run="median")})
    recordings, _ = read_logs(experiment, log_paths(source)[0], source)
    write_results(folder, experiment, recordings, run(experiment, recordings), exporters=EXPORTERS)


def _differences(folder: Path, out: Path) -> None:
    """`copem-replay compare --rrd`: two latencies beside the car's own perception."""
    from copem_replay.viewer.side_by_side import write_beside

    write_beside(out, [folder], configurations=["coPEM:0.5s", "coPEM:1s"], baseline="PEM")


def _drawn(folder: Path) -> Picture:
    """The figure of single runs of `copem-replay plot`."""
    from copem_replay.report.figures import load_results, runs_figure

    content = io.BytesIO()
    runs_figure(load_results(folder)).savefig(content, format="png", dpi=130)
    return Image.open(content)


def _seen(recording: Path) -> Picture:
    """The whole viewer with a recording open, when all of it is drawn."""
    with _viewer() as viewer:
        viewer.open(str(recording))
        _until(lambda: not viewer.get_state().loading)
        viewer.set_time("elapsed", duration=AT_S, play_state="paused")
        same: list[bytes] = []

        def settled() -> bool:
            shot = viewer.take_screenshot()
            same[:] = [*same, shot] if same and same[-1] == shot else [shot]
            return len(same) == SETTLED

        _until(settled)
        broken = [view.name for view in viewer.get_state().views if any(r.severity == "error" for r in view.reports)]
    if broken:
        sys.exit(f"{recording.name}: the viewer could not draw {', '.join(broken)}")
    whole = Image.open(io.BytesIO(same[-1])).convert("RGB")
    cut = whole.crop((0, BAR_PX, whole.width, whole.height))
    return cut.resize((WIDE_PX, round(cut.height * WIDE_PX / cut.width)), Image.Resampling.LANCZOS)


@contextmanager
def _viewer() -> Iterator[Any]:
    from rerun.experimental import ViewerClient

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # The program itself: the script of that name would leave it running when it is stopped.
    import rerun_cli

    program = str(Path(rerun_cli.__file__).with_name("rerun"))
    with redirect_stdout(sys.stderr):
        viewer = ViewerClient.spawn(headless=True, port=port, hide_welcome_screen=True, executable_path=program)
    with viewer as opened:
        yield opened


def _until(done: Any) -> None:
    end = time.monotonic() + PATIENCE_S
    while not done():
        if time.monotonic() > end:
            sys.exit(f"the viewer was not ready after {PATIENCE_S:g} s")
        time.sleep(0.2)


def as_png(picture: Picture) -> bytes:
    """As few bytes as a picture of few colours needs. Exits where that is too many for a README."""
    content = io.BytesIO()
    # Not by how often a colour is there: nearly all of a dark window is nearly black.
    few = picture.convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(content, format="png", optimize=True)
    if content.tell() > LARGEST_BYTES:
        sys.exit(f"a picture of {content.tell()} bytes: expected at most {LARGEST_BYTES}")
    return content.getvalue()


if __name__ == "__main__":
    main()
