"""Stories of objects and the figure of where it is late: who is chosen, what is said, what is drawn.

The scene of `tests/helpers/report_pages.py` with a wall of a lorry between the ego and the pedestrian at its side.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

import copem_replay as cr
from copem_replay.core.errors import InputError
from copem_replay.core.frame import Frame
from copem_replay.extras.stories import story_facts
from copem_replay.extras.stories.stories import choose_stories, story_parts
from copem_replay.extras.stories.story_pictures import place_words
from copem_replay.report.figures import FIGURES, Selection, paths
from copem_replay.report.figures.paths import average_unknown, late_paths_figure, read_drive
from copem_replay.report.html.markup import drop_dead_links, join_html, link_story
from copem_replay.report.html.page import build_page
from copem_replay.report.html.study import load_study
from copem_replay.results.read import Results, read_results
from copem_replay.results.shown_objects import choose_shown_objects
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.report_pages import ALONE, ONE, Page, changed, replayed, with_rows

MAST = (
    ("  eye: {", "  mast: {at: [30.0, 20.0], height_m: 5.0, pem: sure}\n  eye: {"),
    ("  half: {units: [weak]}", "  half: {units: [ego, mast], latency_s: 0.3}"),
    ("  late: {units: [ego], latency_s: 0.5}", "  late: {units: [ego]}"),
)
"""A change: `half` has a mast that sees the pedestrian at the side, `late` does not."""


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lorry (9), 40 m long, stands between the lane of the ego and the pedestrian (3) aside; a mast is behind it."""
    place = tmp_path_factory.mktemp("hidden")
    lorry = Obj(id=9, x=15.0, y=12.0, z=2.0, length=40.0, width=2.5, height=4.0)
    frames = [(0.1 * k, [Obj(id=1, x=1.0 * k, vx=10.0), pedestrian(3, 20.0, 25.0), lorry]) for k in range(51)]
    write_recording(place / "drive.mcap", frames, host=1)
    text = changed(("measure: {onset", "measure: {objects: {ids: [3]}, onset"), *MAST, *ALONE[2:])
    sure = "sure: [{detection: {kind: %s}}]"
    text = text.replace(sure % "constant, probability: 1.0", sure % "visible_share")
    (place / "e.yaml").write_text(text)
    return cr.run(place / "e.yaml", jobs=1).save(place / "results")


def test_a_story_names_what_hides_and_who_listed_it(hidden: Path) -> None:
    study = load_study(hidden)
    [_, story] = story_parts(study)
    said = re.sub(r"<svg.*</svg>", "", story, flags=re.DOTALL)
    assert "late: behind car 9 (from ego) to the end, never known; " in said
    assert (
        "half: on its way from mast until 0.30 s, known after 0.30 s, by the list of mast, which arrives 0.30 s" in said
    )
    assert "copem-replay view FOLDER --object 3" not in said, "no run is shown"
    assert 'viewBox="0 0 960 360"' in story


def test_links_lead_to_the_stories_that_a_page_has(hidden: Path) -> None:
    """The pedestrian has one; the lorry's name stays a name."""
    [_, story] = story_parts(load_study(hidden))
    links = [link_story("drive", name, words) for words, name in (("pedestrian 3", "3"), ("<car> 9", "9"))]
    body = drop_dead_links(join_html([*links, story]))
    assert body.startswith('<a href="#story-drive-3">pedestrian 3</a>&lt;car&gt; 9<div ')
    assert body.count(' id="story-drive-3"') == 1


def test_stories_are_those_of_the_viewer(hidden: Path) -> None:
    """One rule: nearer to the way of the ego before farther from it, as `tests/viewer/test_objects.py` has it."""
    results = read_results(hidden)
    (table,) = results.each(log="drive", every=True)
    table = table[table["run"] == 0]
    drive = read_drive(results, "drive")
    rows = table[table["configuration"] != "GT"].assign(unknown_s=1.0)
    assert choose_stories(drive, table, rows) == (["3"], ("3",)), (
        "in the log for less than 2 s before its onset, but there is no other"
    )
    assert choose_stories(drive, table, rows.assign(unknown_s=0.0)) == ([], ("3",)), "all know it at its onset"
    shown = choose_shown_objects(drive.scene, drive.truth, drive.experiment, table)
    assert [drive.scene.object_ids[k] for k in shown.object_ix] == ["3"]


LOSSY = "links: {lossy: {reception: {kind: constant, probability: 0.15}}}\nconfigurations:"
LOST = ("configurations:", LOSSY), ("half: {units: [weak]}", "half: {units: [ego], link: lossy}")


def test_lists_that_the_radio_loses_are_told(tmp_path: Path) -> None:
    """Of ten lists a second, all with the object, one in seven arrives: all before the one that counts are lost."""
    folder = replayed(tmp_path, changed(ONE, ("seed: 1", "seed: 4"), *LOST, *ALONE))
    (rows,) = read_results(folder).each(log="drive")
    [row] = rows[rows["run"] == 0].itertuples(index=False)
    after_s = row.time_to_detection_s
    assert after_s > 0.2
    words = Page(build_page(load_study(folder))).words
    assert f"half: list lost until {after_s:.2f} s, known after {after_s:.2f} s, by the ego's own list" in words
    assert "is not told" not in words


def test_what_became_of_lists_is_not_told_of_a_run_that_comes_out_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder from another kind of processor may: then nobody knows what became of the lists."""

    def differs(*_: object) -> NoReturn:
        raise InputError("run 0 comes out otherwise")

    folder = replayed(tmp_path, changed(ONE, ("seed: 1", "seed: 4"), *LOST, *ALONE))
    monkeypatch.setattr(story_facts, "replay_again", differs)
    words = Page(build_page(load_study(folder))).words
    assert re.search(r"half: known after [0-9.]+ s, by the ego's own list", words)
    assert "lost until" not in words
    assert "What becomes of lists is not told: the run cannot be replayed again as it was." in words


def test_stories_are_in_the_report_and_without_the_recording_the_reason(tmp_path: Path) -> None:
    folder = replayed(tmp_path, changed(ONE))
    page = Page(build_page(load_study(folder)))
    assert {"late_paths", "answer"} <= set(page.plots)
    assert "pedestrian 2: " in page.words
    (tmp_path / "drive.mcap").unlink()
    page = Page(build_page(load_study(folder)))
    assert "late_paths" not in page.plots
    assert len(re.findall(r"No (?:plans of drive|figure): the recording is not there as it was; ", page.words)) == 2
    assert str(tmp_path) not in page.html


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return read_results(replayed(tmp_path_factory.mktemp("late"), changed()))


class TestLatePaths:
    def test_unknown_is_over_all_runs_and_of_never_until_its_end(self, results: Results, tmp_path: Path) -> None:
        """Six runs, of which two never know it: (4 × 1 + 2 × 4.5) / 6."""
        table = results.detections.copy()
        one = (table["configuration"] == "late") & (table["object_id"] == "2")
        for name in ("time_to_detection_s", "detection_s"):
            table.loc[one, name] = 1.0 if name == "time_to_detection_s" else 1.5
            table.loc[one & (table["run"] < 2), name] = np.nan
        table.loc[one, "detected"] = table.loc[one, "run"] >= 2
        found = average_unknown(with_rows(results, table, tmp_path / "r"), ["late"]).set_index("object_id")
        assert found.loc["2", "unknown_s"] == pytest.approx(13 / 6)
        assert found.loc["2", "never_share"] == pytest.approx(2 / 6)

    def test_a_panel_each_and_a_cross_where_it_is_never_known(self, results: Results) -> None:
        figure = late_paths_figure(results, Selection())
        panels = {axes.get_title(loc="left"): axes for axes in figure.axes if axes.get_title(loc="left")}
        assert list(panels) == ["half", "late", "hit", "never"]
        crosses = {
            name: sum(len(line.get_xdata()) for line in axes.get_lines() if line.get_label() == "never")
            for name, axes in panels.items()
        }
        assert crosses == {"half": 0, "late": 0, "hit": 0, "never": 2}
        times = {name: sorted(axes.collections[-1].get_array()) for name, axes in panels.items()}
        assert times["late"] == pytest.approx([0.5, 0.5])
        assert times["hit"] == pytest.approx([1.8, 1.8])
        assert times["never"] == pytest.approx([4.5, 4.5])

    @pytest.mark.parametrize(("yaw_rad", "said"), [(None, False), (0.0, True), (0.5, False)])
    def test_north_is_up_where_a_place_says_so(self, yaw_rad: float | None, said: bool, results: Results) -> None:
        drive = read_drive(results, results.provenance.logs[0].name)
        frame = None if yaw_rad is None else Frame("EPSG:25832", (0.0, 0.0), yaw_rad)
        drive = replace(drive, scene=replace(drive.scene, frame=frame))
        rows = average_unknown(results, ["late"])
        assert ("north is up" in paths._note_sentences(results, drive, rows, ["late"], ["late"])[0]) is said

    def test_of_the_truth_alone_there_is_none(self, results: Results) -> None:
        assert FIGURES["late_paths"].missing(results, Selection(("GT",))) == ""
        assert FIGURES["late_paths"].missing(results, Selection()) is None


def test_a_dark_page_has_the_colours_of_its_theme(hidden: Path) -> None:
    """In stories, too: a colour that stands out on paper may not on a dark screen."""
    study = load_study(hidden)
    [_, story] = story_parts(study)
    light = {bytes(round(255 * channel) for channel in look.colour).hex() for look in study.looks.values()}
    drawn = set(re.findall(r'(?:fill|stroke)="#([0-9a-f]{6})"', story))
    assert drawn & light == set()
    assert len(re.findall(r'"var\(--c-[0-9a-f]{6}-[0-9a-f]{6}\)"', story)) >= 2


def test_names_in_plans_are_clear_of_bodies_and_of_each_other() -> None:
    """A van hides a pedestrian above it from the ego below it; plans are 312 × 212 pixels, 18 from the top."""

    def corners(x: float, y: float, half_x: float, half_y: float) -> Any:
        return np.array([[x + a * half_x, y + b * half_y] for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))])

    beside = [("7", corners(100, 100, 3, 3)), ("ego", corners(100, 135, 12, 6)), ("van 8", corners(100, 115, 30, 10))]
    words = {name: (x, y) for name, x, y in place_words(beside, left=0)}
    assert words["7"] == (100, 93), "above"
    assert words["ego"] == (100, 153), "the van is above it"
    assert words["van 8"] == (100 + 30 + 2.5 * 6.5 + 4, 119), "right, as there are bodies above and below"
    [(_, x, _)] = place_words([("pedestrian 61", corners(300, 30, 3, 3))], left=0)
    assert x < 300 - 3 - 6 * 6.5, "left, since the plan ends at 312"
