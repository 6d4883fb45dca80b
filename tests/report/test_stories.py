"""Stories of objects and the figure of where it is late: who is chosen, what is said, what is drawn.

The scene of `tests/helpers/report_pages.py` with a wall of a lorry between the ego and the pedestrian at its side.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.report.figures import FIGURES, Selection
from copem_replay.report.figures.paths import average_unknown, late_paths_figure
from copem_replay.report.html.page import build_page
from copem_replay.report.html.stories import choose_stories, story_parts
from copem_replay.report.html.study import load_study
from copem_replay.results.read import Results, read_results
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.report_pages import ALONE, ONE, Page, changed, replayed, with_rows

MAST = (
    ("  eye: {", "  mast: {at: [30.0, 20.0], height_m: 5.0, pem: sure}\n  eye: {"),
    ("  half: {units: [weak]}", "  half: {units: [ego, mast], latency_s: 0.3}"),
    ("  late: {units: [ego], latency_s: 0.5}", "  late: {units: [ego]}"),
)
"""A change: `half` has a mast that sees the pedestrian at the side, `late` does not."""


def rows(**times_s: list[float | None]) -> pd.DataFrame:
    """Rows of one run: by object the times of its configurations; None: never in 4 s."""
    table = [(name, str(k), time_s) for name, of in times_s.items() for k, time_s in enumerate(of)]
    frame = pd.DataFrame(table, columns=["object_id", "configuration", "time_to_detection_s"])
    frame = frame.assign(onset_s=0.0, ended_s=4.0)
    return frame.assign(unknown_s=frame["time_to_detection_s"].astype(float).fillna(4.0))


class TestChoice:
    def test_the_latest_and_those_that_differ_most(self) -> None:
        table = rows(
            at_once=[0.0, 0.0], a=[3.0, 3.0], b=[2.9, 2.9], c=[None, 0.0], d=[0.0, 3.5], e=[0.0, 1.0], f=[0.2, 0.2],
            g=[0.0, 0.1],
        )  # fmt: skip
        assert choose_stories(table) == {
            "a": "unknown longest",
            "b": "unknown longest",
            "c": "unknown longest",
            "d": "differs most",
            "e": "differs most",
            "g": "differs most",
        }

    def test_what_is_too_short_to_judge_only_if_all_are(self) -> None:
        table = rows(short=[1.0, 1.5], long=[0.2, 0.3])
        table.loc[table["object_id"] == "short", "ended_s"] = 1.9
        assert list(choose_stories(table)) == ["long"]
        assert list(choose_stories(table[table["object_id"] == "short"])) == ["short"]

    def test_of_what_all_know_at_once_there_is_none(self) -> None:
        assert choose_stories(rows(a=[0.0, 0.0])) == {}


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
    assert "Hidden from ego behind car 9 until " in said
    assert "half knows it after 0.30 s by mast, whose list takes 0.30 s." in said
    assert "copem-replay view FOLDER --object 3" not in said, "no run is shown"
    assert 'viewBox="0 0 960 360"' in story


def test_stories_are_in_the_report_and_without_the_recording_the_reason(tmp_path: Path) -> None:
    folder = replayed(tmp_path, changed(ONE))
    page = Page(build_page(load_study(folder)))
    assert {"late_paths", "answer"} <= set(page.plots)
    assert "pedestrian 2: unknown longest" in page.words
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
        table = results.table.copy()
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

    def test_of_the_truth_alone_there_is_none(self, results: Results) -> None:
        assert FIGURES["late_paths"].missing(results, Selection(("GT",))) == ""
        assert FIGURES["late_paths"].missing(results, Selection()) is None
