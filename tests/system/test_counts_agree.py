"""One number of one thing: titles of the viewer, events, tables and figures of one results folder, read back."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.report.figures.answer import answer_figure
from copem_replay.report.figures.differences import differences_figure
from copem_replay.report.figures.false_positives import false_positives_figure
from copem_replay.report.html.page import build_page
from copem_replay.report.html.study import load_study
from copem_replay.results.compare import Comparison, compare_folders
from copem_replay.results.read import Results, read_results
from copem_replay.results.screen import format_screen
from copem_replay.viewer.blueprint import RecordingContent
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.scenes import experiment
from tests.report.test_answer import dots, intervals
from tests.viewer.test_rrd import rows as rows_of
from tests.viewer.test_status import titles

ERROR = {"kind": "gaussian", "covariance_m2": [[0.3, 0.0], [0.0, 0.3]]}
GHOSTS = [{"in_list": 0.6, "lasts_s": 0.5, "where": {"kind": "field", "range_m": [5, 40]}}]
SEES = [{"detection": {"kind": "constant", "probability": 0.4}, "error": ERROR}]
FUSIONS = ("ideal", "union", "gnn", "tracker")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pedestrians walk towards a standing ego: who is within 30 m at the start does not count; one more comes back.

    Two units list each of them, so that a union has second entries; one has false ones; lists of `late` are 0.5 s old.
    """
    place = tmp_path_factory.mktemp("agree")
    frames = [
        (0.1 * k, [
            Obj(id=1, x=0.0),
            *(pedestrian(id=2 + n, x=20.0 + 2.5 * n - 0.3 * k, y=6.0 * (n % 3), vx=-3.0) for n in range(14)),
            *([pedestrian(id=20, x=29.0, y=-5.0)] if k // 20 in (1, 3) else []),
        ])
        for k in range(81)
    ]  # fmt: skip
    log = write_recording(place / "drive.mcap", frames, host=1)
    asked = experiment(
        logs=[str(log)], runs=3, pems={"sees": SEES, "ghostly": {"couples": SEES, "ghosts": GHOSTS}},
        units={"ego": {"on": "ego", "pem": "sees"}, "mast": {"at": [0.0, -8.0], "height_m": 5.0, "pem": "ghostly"}},
        configurations={
            "GT": {"units": "truth"}, **{kind: {"units": "all", "fusion": {"kind": kind}} for kind in FUSIONS},
            "late": {"units": "all", "fusion": {"kind": "union"}, "latency_s": 0.5},
        },
        measure={"onset": {"kind": "in_range", "range_m": 30}, "began": ["crossed", "appeared"], "horizon_s": 2},
        show={"run": 1},
    )  # fmt: skip
    cr.run(asked).save(place / "out")
    return place / "out"


@pytest.fixture(scope="module")
def results(folder: Path) -> Results:
    return read_results(folder)


@pytest.fixture(scope="module")
def false(results: Results) -> pd.DataFrame:
    return results.frame("false_tracks.parquet")


@pytest.fixture(scope="module")
def compared(results: Results) -> Comparison:
    return compare_folders([results], baseline="ideal")


NAMES = (*FUSIONS, "late")


def test_titles_count_what_tables_count(results: Results, folder: Path, false: pd.DataFrame) -> None:
    """The first line of the screen: objects that count, in all passes; in the title those of the run, all of them."""
    every = [re.match(r"(.+?)(?: · |, )whole run: (.*)", title) for title in titles(folder / "replay.rrd")]
    shown = {title[1]: title[2] for title in every if title is not None}
    assert shown.keys() == set(NAMES)
    table = results.detections
    table = results.counted(table[table["run"] == 1])
    in_run = false[false["run"] == 1]["configuration"]
    passes = results.tally[results.tally["event"] == "detected"]
    number = len(results.counted(passes).drop_duplicates(["object_id", "episode"]))
    for name in NAMES:
        known, of, wrong = map(int, re.findall(r"\d+", shown[name]))
        rows = table[table["configuration"] == name]
        assert (known, of, wrong) == (rows["detected"].sum(), number, (in_run == name).sum())
        assert of == int(results.summary.set_index("configuration").loc[name, "n"]) / 3
    assert (in_run == "union").sum() > 3, "there is something to count"
    assert (in_run == "ideal").sum() == 0
    first = next(line for line in format_screen(results, results.summary, [])[0] if "count" in line)
    assert re.search(r"(\d+) objects", first)
    assert int(re.search(r"(\d+) objects", first)[1]) == results.known["object_id"].nunique()  # type: ignore[index]


def test_a_title_says_how_often_the_driver_brakes_for_nothing() -> None:
    rows = pd.DataFrame({"configuration": ["late", "late", "gnn"]})
    content = SimpleNamespace(counted=None, false_tracks=rows.iloc[:0], needless=rows)
    said = [RecordingContent.title(content, name) for name in ("late", "gnn", "ideal")]  # type: ignore[arg-type]
    assert said == [
        "late · whole run: 0 false, brakes 2× for nothing", "gnn · whole run: 0 false, brakes 1× for nothing",
        "ideal · whole run: 0 false",
    ]  # fmt: skip


def test_false_positives_are_the_entries_of_false_tracks(results: Results, false: pd.DataFrame) -> None:
    """In the list, in `lists.parquet`, in the summary, in the bands and in the figure."""
    lists, summary = results.frame("lists.parquet"), results.summary.set_index("configuration")
    bands = results.frame("bands.csv")
    figure = dict(_places(false_positives_figure(results).axes[0]))
    for name in NAMES:
        of, of_lists = false[false["configuration"] == name], lists[lists["configuration"] == name]
        by_run = of.groupby("run")["entries"].sum().reindex(range(3), fill_value=0)
        assert by_run.tolist() == of_lists["ghosts"].tolist()
        rate = of["entries"].sum() / of_lists["minutes"].sum()
        assert summary.loc[name, "false_positives_per_min"] == pytest.approx(rate)
        if name in figure:
            assert figure[name] == pytest.approx((summary.loc[name, "position_rmse_m"], rate))
        counted = bands[(bands["configuration"] == name) & (bands["by"] == "time_s")]["ghosts"].sum()
        assert counted == of["entries"].sum()
    assert {"union", "gnn", "late"} <= figure.keys()
    late, union = (summary.loc[name] for name in ("late", "union"))
    assert late["stale_false_positives_per_min"] >= union["stale_false_positives_per_min"] == 0.0
    assert abs(late["false_positives_per_min"] - union["false_positives_per_min"]) < 60, "latency makes nothing false"
    assert union["duplicates_per_min"] > 100


def _places(axes: object) -> list[tuple[str, tuple[float, float]]]:
    return [
        (str(mark.get_label()), tuple(np.asarray(mark.get_offsets())[0]))
        for mark in axes.collections  # type: ignore[attr-defined]
    ]


def test_crosses_are_the_false_entries_and_thin_outlines_the_second_ones(folder: Path, false: pd.DataFrame) -> None:
    """Six lines of a cross in each list that holds one; a union of two units draws second entries thin."""
    path = folder / "replay.rrd"
    for name in ("union", "gnn", "late", "tracker"):
        entries = int(false[(false["configuration"] == name) & (false["run"] == 1)]["entries"].sum())
        assert _count(path, f"/world/{name}/false", "LineStrips3D:strips") == 6 * entries
    assert _count(path, "/world/union/second", "LineStrips3D:strips") > 50


def _count(path: Path, entity: str, component: str) -> int:
    return sum(len(row[component] or []) for row in rows_of(path, entity))


def test_each_false_track_is_an_event_and_in_the_report_the_longest(folder: Path, false: pd.DataFrame) -> None:
    page = build_page(load_study(folder))
    told = page[page.index("Entries about nobody in run 1 of drive") :]
    for name in FUSIONS:
        of = false[(false["configuration"] == name) & (false["run"] == 1)]
        assert f"<b>{name}</b>" + (f", {len(of)}: " if len(of) else ": none") in told
        assert _count(folder / "replay.rrd", f"/events/{name}/false", "TextLog:text") == len(of)
    assert "and " in told[: told.index("</ul>")]


def test_figures_show_the_numbers_of_tables(results: Results, compared: Comparison) -> None:
    summary = results.summary.set_index("configuration")
    answer, differences = answer_figure(results).axes[0], differences_figure(results, differences=compared).axes[0]
    rows = compared.overall[compared.overall["metric"] == "ttd_rmst_s"].set_index("configuration")
    for name in NAMES:
        assert dots(answer)[name][0] == pytest.approx(summary.loc[name, "ttd_rmst_s"])
        if name in intervals(answer):
            limits = summary.loc[name, ["ttd_rmst_s_low", "ttd_rmst_s_high"]].tolist()
            assert intervals(answer)[name] == pytest.approx(limits)
        if name != "ideal":
            assert dots(differences)[name][0] == pytest.approx(rows.loc[name, "difference"])
            if name in intervals(differences):
                assert intervals(differences)[name] == pytest.approx(rows.loc[name, ["low", "high"]].tolist())
    assert len(intervals(answer)) > 2
    assert Counter(rows["interval"])["exact"] == 0


def test_no_interval_ends_where_the_difference_cannot_be(compared: Comparison) -> None:
    """Nobody knows before the truth does, nor before the ideal of the same lists; `late` has no ideal of its own."""
    rows = compared.overall.set_index(["configuration", "metric"])
    for metric, sign in (("ttd_rmst_s", 1), ("unknown_to_horizon_s", 1), ("detected_share", -1)):
        ends = ["low", "high", "low_bounded", "high_bounded"]
        truth, gnn = (rows.loc[(name, metric), ends].dropna().astype(float) * sign for name in ("GT", "gnn"))
        assert (truth <= 0).all()
        assert (gnn >= 0).all()
        assert len(truth) == 4
