"""What is opened in the real viewer: all views there, none complaining, boxes when and where there should be some."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from copem_replay.core.colours import configuration_colours
from copem_replay.core.errors import InputError
from copem_replay.viewer import check_viewer, sink, write_rrd
from copem_replay.viewer.open import read_identities, seek_recordings
from tests.helpers.viewer import Viewer, free_port, headless_viewer
from tests.viewer.test_recorded import replayed, sensors
from tests.viewer.test_rrd import CHANGES, SUMMARY, Made, approaching, make, rerun, rows

ROOT = Path(__file__).parents[2]
VIEWS = {
    "PEM · whole run: 1 of 2 known",
    "pole · whole run: 2 of 2 known",
    "none · whole run: 0 of 2 known",
    "7 car, from 2.0 s",
    "What difference it made",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("viewer") / "replay.rrd", approaching(), **CHANGES)


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with headless_viewer() as opened:
        yield opened


def share_of(picture: np.ndarray, colour: tuple[int, int, int]) -> float:
    """How much of a picture has a colour's hue: bright and dark of it, on what is nearly black."""
    pixels = picture.reshape(-1, 3).astype(float)
    bright = np.linalg.norm(pixels, axis=1)
    direction = np.array(colour) / np.linalg.norm(colour)
    return float(((bright > 40) & (pixels @ direction > 0.985 * bright)).mean())


def test_the_layout_has_its_views(made: Made, viewer: Viewer) -> None:
    viewer.open(made.path)
    assert viewer.views() >= VIEWS
    assert viewer.errors() == []


def test_the_file_as_an_engineer_sees_it(made: Made, viewer: Viewer) -> None:
    viewer.open(made.path)
    colours = configuration_colours(made.run_tracks, ("GT", "GT late"))
    for elapsed_s in (0.3, 2.0, 4.8):
        viewer.seek(elapsed_s)
        for name in ("PEM", "pole"):
            # What was computed, what is in the file, what is in the picture.
            fused = made.run_tracks[name].fused
            frame = np.searchsorted(fused.arrives_s[0], elapsed_s + 1e-6, side="right") - 1
            listed = np.flatnonzero((fused.frame_ix == frame) & fused.valid[0])
            entity = f"/world/{name}/boxes".replace(" ", "\\ ")
            newest = [row for row in rows(made.path, entity) if row["elapsed"] <= elapsed_s * 1e9 + 1000][-1:]
            places = [tuple(place[:2]) for row in newest for place in row["Boxes3D:centers"]]
            expected = zip(fused.x_m[0, listed], fused.y_m[0, listed], strict=True)
            assert places == [pytest.approx(place, abs=1e-4) for place in expected]
            [title] = [view for view in viewer.views() if view.startswith(f"{name} · ")]
            drawn = share_of(viewer.picture(title), colours[name])
            assert (drawn > 1e-4) == (len(listed) > 0), f"{name} at {elapsed_s} s: {drawn}"
            height, width = viewer.picture(title).shape[:2]
            assert (width >= 400, height >= 200) == (True, True)
    whole = viewer.picture()
    assert len(np.unique(whole.reshape(-1, 3), axis=0)) > 100
    assert viewer.errors() == []


def test_images_and_points_of_the_recording(viewer: Viewer, tmp_path: Path) -> None:
    viewer.open(replayed(tmp_path, sensors()) / "replay.rrd")
    assert viewer.views() >= {"/cam/image · PEM", "Points · PEM"}
    assert viewer.errors() == []


def test_sent_to_a_viewer_that_runs(made: Made, viewer: Viewer, tmp_path: Path) -> None:
    check_viewer(viewer.url)
    fewer = {name: made.run_tracks[name] for name in ("GT", "PEM")}
    path = tmp_path / "live.rrd"
    said = write_rrd(path, made.replay, made.given, [fewer], made.table, SUMMARY, 3, viewer=viewer.url)
    assert said == []
    viewer.wait({"PEM · whole run: 1 of 2 known"})
    assert {"/world/PEM/boxes", "/world/PEM/status", "/plots/gospa/PEM"} <= viewer.entities()
    assert not any("pole" in view for view in viewer.views()), "the layout that was sent, not the one before"
    assert viewer.errors() == []
    made.write(tmp_path / "alone.rrd", run_tracks=fewer)
    assert rerun("rrd", "compare", "--unordered", path, tmp_path / "alone.rrd").returncode == 0


def test_a_viewer_that_goes_leaves_the_file_complete(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sink, "TAKES_S", 2.0)  # nothing listens: nothing is waited for
    path, url = tmp_path / "x.rrd", f"rerun+http://127.0.0.1:{free_port()}/proxy"
    said = write_rrd(path, made.replay, made.given, [made.run_tracks], made.table, SUMMARY, 3, viewer=url)
    assert said == [f"x.rrd: the viewer at {url} went before it had everything; the file is complete"]
    assert rerun("rrd", "compare", "--unordered", path, made.path).returncode == 0


@pytest.mark.parametrize("step", [-1, 1], ids=["before", "after"])
def test_another_minor_version_of_rerun_reads_the_same(made: Made, step: int) -> None:
    """Every value, as its own program prints them. `make reruns` gets these versions."""
    major, minor, _ = version("rerun-sdk").split(".")
    name = f"{major}.{int(minor) + step}"
    program = ROOT / f".venv-rerun-{name}/bin/rerun"
    if not program.is_file():
        pytest.skip(f"no rerun-sdk {name} here: make reruns, if there is such a version")
    printed = []
    for one in (program, Path(sys.executable).with_name("rerun")):
        assert subprocess.run([one, "rrd", "verify", made.path], check=False, timeout=120).returncode == 0
        command = [one, "rrd", "print", "-vvv", made.path]
        told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
        printed.append([line for line in told.splitlines() if "* version:" not in line])
    assert printed[0] == printed[1]
    assert sum("Boxes3D:centers" in line for line in printed[0]) > 1


def test_where_no_viewer_is_or_can_be() -> None:
    with pytest.raises(InputError, match=r"--live: no viewer at .*refused.*; start one first: python -m rerun"):
        check_viewer(f"rerun+http://127.0.0.1:{free_port()}/proxy")
    for wrong in ("127.0.0.1:9876", "http://127.0.0.1:9876/proxy", "rerun+http://host:99999999/proxy", "rerun://h/x"):
        with pytest.raises(InputError, match="--viewer: expected an address such as"):
            check_viewer(wrong)


def test_a_recording_is_moved_to_its_instant(made: Made, viewer: Viewer) -> None:
    viewer.open(made.path)
    viewer.seek(0.0)
    (identity,) = read_identities([made.path]).values()
    seek_recordings(viewer.url, {identity.recording: 1.5}, lambda: True)
    assert viewer.cursors()[identity.recording] == ("elapsed", 1_500_000_000)


def test_a_viewer_that_has_ended_is_not_waited_for() -> None:
    seek_recordings(f"rerun+http://127.0.0.1:{free_port()}/proxy", {"x": 1.0}, lambda: False)
