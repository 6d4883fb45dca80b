"""The data of the player in a report: places as whole numbers, the newest lists, what fits, what is left out."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from copem_replay.core.tracks import TRUTH, Tracks
from copem_replay.extras.player import player
from copem_replay.extras.player.player import Grid, Rows, encode_false, encode_tracks, find_rows
from copem_replay.report import write_html_report
from copem_replay.report.figures.selection import Selection, choose_object_and_run
from copem_replay.report.html.study import load_study
from copem_replay.results.shown_objects import ShownObjects
from tests.helpers.report_pages import changed, replayed

SHOWN = changed(("show: null\n", ""))


def rows(*of: tuple[int, int, float, float, float]) -> Rows:
    frame, object_ix, x_m, y_m, yaw_rad = zip(*of, strict=True)
    return Rows(np.array(frame), np.array(object_ix), np.array(x_m), np.array(y_m), np.array(yaw_rad))


GRID = Grid(np.arange(4) * 0.1, (100.0, 0.0), 0.01)


def test_tracks_are_pieces_without_a_gap() -> None:
    found = rows((0, 7, 101.0, 0.5, 0.0), (3, 7, 100.0, 0.0, -np.pi), (1, 7, 99.0, 0.0, np.pi / 2), (1, -1, 0, 0, 0))
    numbers = np.frombuffer(encode_tracks(found, GRID), "<i2").tolist()
    first = [7, 0, 2, 100, 50, 0, -100, 0, 16384]  # object, first frame, frames; cm from the middle, 2¹⁵ a half turn
    assert numbers == [*first, 7, 3, 1, 0, 0, -32768]


def test_an_object_that_is_listed_twice_is_drawn_once() -> None:
    twice = rows((0, 7, 101.0, 0.0, 0.0), (0, 7, 102.0, 0.0, 0.0))
    assert np.frombuffer(encode_tracks(twice, GRID), "<i2").tolist() == [7, 0, 1, 100, 0, 0]


def test_what_is_about_no_object_is_counted_frame_by_frame() -> None:
    found = rows((2, -1, 100.0, 1.0, 0.0), (0, 3, 100.0, 0.0, 0.0), (2, -1, 100.5, 2.0, 0.0))
    assert np.frombuffer(encode_false(found, GRID), "<i2").tolist() == [0, 0, 2, 0, 0, 100, 50, 200]


def test_places_beyond_the_numbers_stay_at_their_edge() -> None:
    far = rows((0, 0, 1000.0, -1000.0, 0.0))
    assert np.frombuffer(encode_tracks(far, GRID), "<i2").tolist()[3:5] == [32767, -32767]


def test_rows_are_those_of_the_newest_list_that_is_there() -> None:
    """Lists captured at 0 and 0.1 s, which come at 0.3 and 0.2 s: from 0.3 s on the older one is the newest there."""
    one = np.ones((1, 2))
    lists = Tracks(
        (TRUTH,), np.array([0, 2]), np.array([0]), np.array([5]), np.array([0, 1]), np.array([0, 100_000_000]),
        np.array([0.0, 0.1]), np.array([0, 0]), np.array([[0.3, 0.2]]), np.array([[True, True]]),
        np.array([[1.0, 2.0]]), *(0 * one for _ in range(5)), *(one for _ in range(3)),
    )  # fmt: skip
    found = find_rows(lists, lists.common_arrives_s, np.array([0.1, 0.2, 0.3]))
    assert found.frame.tolist() == [1, 2]
    assert found.x_m.tolist() == [2.0, 1.0]
    assert found.object_ix.tolist() == [5, 5]


def test_of_many_lanes_the_nearest_are_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(player, "_MOST_LANE_POINTS", 5)
    lines = tuple(np.array([[x, 0.0, 0.0], [x, 9.0, 0.0]]) for x in (300.0, 101.0, 102.0))
    replayed = SimpleNamespace(replay=SimpleNamespace(lane_boundaries=lines))
    assert player._list_lanes(replayed, GRID) == [[1.0, 0.0, 1.0, 9.0], [2.0, 0.0, 2.0, 9.0]]  # type: ignore[arg-type]


def data_of(page: Path) -> dict[str, Any]:
    text = page.read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="played">(.*?)</script>', text)
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data


def test_the_objects_that_the_viewer_shows_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pedestrian 2 is in conflict, but the viewer shows 3, the third of the log: so does the player."""
    study = load_study(replayed(tmp_path, SHOWN))
    choice = choose_object_and_run(study.results, Selection(configurations=("late", "half")))
    assert choice.object_id == "2"
    monkeypatch.setattr(player, "choose_shown_objects", lambda *given: ShownObjects((2,)))
    assert [k for k, _, _ in player.collect_player_data(study, choice)["measured"]] == [2, 1]


def test_a_page_has_the_run_that_the_viewer_shows(tmp_path: Path) -> None:
    folder = replayed(tmp_path, SHOWN.replace("  late:", '  "<!--<script>":'))
    data = data_of(write_html_report(folder))
    late = next(one for one in data["configurations"] if one["name"] == "<!--<script>")
    assert [one["name"] for one in data["configurations"]] == ["<!--<script>", "half", "hit", "never"], "not the truth"
    assert late["known"] == {"1": 1.0, "2": 1.0}
    assert data["measured"] == [[1, 0.5, 5.0], [2, 0.5, 5.0]]
    assert data["frames"] == 51
    first = write_html_report(folder).read_bytes()
    (tmp_path / "drive.mcap").rename(tmp_path / "elsewhere.mcap")
    gone = write_html_report(folder).read_text(encoding="utf-8")
    assert "No player: the recording is not where it was, or cannot be replayed again." in gone
    assert 'id="played"' not in gone
    (tmp_path / "elsewhere.mcap").rename(tmp_path / "drive.mcap")
    assert write_html_report(folder).read_bytes() == first


def test_a_page_of_no_run_has_no_player(tmp_path: Path) -> None:
    assert 'id="played"' not in write_html_report(replayed(tmp_path)).read_text(encoding="utf-8")


def test_a_hundred_objects_for_twenty_seconds_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.helpers import report_pages
    from tests.helpers.recordings import Obj, pedestrian, write_recording

    def crowd(path: Path) -> Path:
        others = [pedestrian(k, 20.0 + k, 3.0 * (k % 30)) for k in range(2, 102)]
        frames = [(0.1 * k, [Obj(id=1, x=1.0 * k, vx=10.0), *others]) for k in range(201)]
        return write_recording(path, frames, host=1)

    monkeypatch.setattr(report_pages, "drive", crowd)
    late = "".join(f"  c{k}: {{units: [ego], latency_s: {k / 10}}}\n" for k in range(7))
    text = changed(("show: null\n", ""), ("runs: 6", "runs: 1"), ("  half: {units: [weak]}\n", late))
    page = write_html_report(replayed(tmp_path, text))
    data = data_of(page)
    assert len(data["configurations"]) == 6, "the most that a page plays"
    assert len(json.dumps(data)) <= 1_500_000
    assert data["step"] <= 0.2
