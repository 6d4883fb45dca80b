"""Films: their pictures say of the object what the table says, and nothing wrong is half-written.

The small experiment: a car is 60 m away, its onset, 1 s after the log starts, and drives towards the ego at 10 m/s.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.core.colours import configuration_colours
from copem_replay.extras.film.film import choose_instants
from tests.helpers.experiments import changed, drive

NAMES = ["GT", "late", "never"]
COLOURS = configuration_colours(NAMES, NAMES, "light")
"""On white; all are of the truth, so that none is grey."""
CONFIGURATIONS = """\
configurations:
  GT: {units: truth}
  late: {units: truth, latency_s: 0.5}
  never: {units: truth, latency_s: 9}
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("film")
    drive(place / "drive.mcap")
    text = changed("show: null", "measure: {onset: {kind: in_range, range_m: 60}, exact: false}")
    (place / "e.yaml").write_text(re.sub(r"(?ms)^configurations:.*?(?=^measure)", CONFIGURATIONS, text))
    return cr.run(place / "e.yaml").save(place / "r")


@pytest.fixture(scope="module")
def film(results: Path) -> Path:
    return cr.write_film(results, configurations=NAMES)


def frames(path: Path) -> list[np.ndarray]:
    with Image.open(path) as image:
        pictures = []
        for k in range(getattr(image, "n_frames", 1)):
            image.seek(k)
            pictures.append(np.asarray(image.convert("RGB")).astype(int))
        return pictures


def coloured(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """The pixels (height, width) of a full colour, up to what a palette does to it."""
    return np.asarray(np.abs(picture - np.array(colour)).max(axis=-1) < 16)


@pytest.mark.parametrize(
    ("onset_s", "end_s", "first_s", "last_s", "count"),
    [(12.0, 60.0, 10.0, 19.9, 100), (1.0, 60.0, 0.0, 9.9, 100), (57.0, 60.0, 50.0, 59.9, 100), (3.0, 8.0, 0.0, 7.9, 80),
     (0.0, 0.0, 0.0, 0.0, 1), (3.26, 8.0, 0.06, 7.86, 79)],
)  # fmt: skip
def test_ten_seconds_from_two_before_the_onset(
    onset_s: float, end_s: float, first_s: float, last_s: float, count: int
) -> None:
    instants_s = choose_instants(onset_s, end_s)
    assert len(instants_s) == count
    assert instants_s[[0, -1]] == pytest.approx([first_s, last_s])
    assert np.diff(instants_s) == pytest.approx(0.1)


def test_a_frame_each_tenth_of_a_second_for_a_slide(film: Path) -> None:
    with Image.open(film) as image:
        assert (image.format, image.size, image.n_frames) == ("GIF", (960, 540), 30)  # type: ignore[attr-defined]
        assert (image.info["duration"], image.info["loop"]) == (100, 0)
    assert '"film.gif"' in (film.parent / "made.jsonl").read_text().splitlines()


def test_bars_begin_at_the_detection_of_the_table(results: Path, film: Path) -> None:
    """In the last frame: the axis goes from 16 to 98 % of the width, from the first frame to one after the last."""
    table = pd.read_parquet(results / "detections.parquet").query("run == 0 and object_id == '2'")
    begins_s = table.set_index("configuration")["detection_s"]
    assert begins_s.notna().to_dict() == {"GT": True, "late": True, "never": False}
    picture = frames(film)[-1]
    bars = picture[-105:]
    for name, colour in COLOURS.items():
        columns = np.flatnonzero(coloured(bars, colour).sum(axis=0) >= 5)
        if name == "never":
            assert not len(columns)
            continue
        second_px = 960 * 0.82 / 3.0
        assert columns[0] == pytest.approx(960 * 0.16 + begins_s[name] * second_px, abs=0.1 * second_px + 2)
        assert columns[-1] == pytest.approx(960 * 0.98, abs=3)


def test_nothing_is_known_in_a_picture_before(film: Path) -> None:
    before = frames(film)[9]  # a tenth of a second before the onset
    assert not any(coloured(before[-105:], colour).sum(axis=0).max() >= 5 for colour in COLOURS.values())


def test_a_configuration_without_a_list_draws_no_boxes(film: Path) -> None:
    """Of three plans side by side the third has grey outlines and the ego alone; the first has its colour."""
    plans = [np.split(picture[90:430], [320, 640], axis=1) for picture in frames(film)[::10]]
    colourful = [[int((np.ptp(plan, axis=-1) > 60).sum()) for plan in row] for row in plans]
    assert all(of[0] > 100 for of in colourful)
    assert all(of[2] < of[0] for of in colourful)


def test_the_same_bytes_again(results: Path, film: Path, tmp_path: Path) -> None:
    again = cr.write_film(results, tmp_path / "again.gif", configurations=NAMES, object_id="2", run=0)
    assert again.read_bytes() == film.read_bytes()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--object", "61"], "{r}: object: expected one of 2; found '61'"),
        (["--configurations", "GT,cloud"], "{r}: configurations: expected some of GT, late, never, found 'cloud'"),
        (["--configurations", "a,b,c,d,e,f,g"], "configurations: expected at most 6 in a film, found 7"),
        (["--out", "film.mp4"], "film.mp4: expected a name that ends with .gif"),
        (["--run", "99"], "{r}: run: expected 0 to"),
        (["--log", "other"], "{r}: log: expected one of drive; found 'other'"),
    ],
)
def test_what_is_wrong_is_one_line(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    words: list[str], line: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["copem-replay", "film", str(results), "--out", "x.gif", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    problems = capsys.readouterr().err.splitlines()
    assert (ended.value.code, len(problems)) == (2, 1)
    assert problems[0].startswith(line.format(r=results))
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_is_gone_is_one_line(results: Path, tmp_path: Path) -> None:
    shutil.copytree(results, tmp_path / "r")  # the log is not beside this one
    with pytest.raises(cr.InputError, match=r"drive\.mcap: cannot be opened: No such file") as error:
        cr.write_film(tmp_path / "r", tmp_path / "x.gif")
    assert len(str(error.value).splitlines()) == 1
    assert not (tmp_path / "x.gif").exists()
