"""Where nothing is drawn all runs are the same, and an interval over them would be about nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.summary import format_summary
from copem_replay.pipeline.expansion import find_facts
from copem_replay.report.figures.detection_curves import curves_figure
from copem_replay.report.html.page import build_page
from copem_replay.report.html.study import load_study
from copem_replay.results.compare import compare_folders, comparison_text
from copem_replay.results.read import read_results
from tests.helpers.report_pages import ONE, Page, changed, replayed

DRAWN_REACTION = ("{kind: constant, delay_s: 0.2}", "{kind: gamma, shape: 4.0, mean_s: 0.2}")
TRUTH_LATE = ("  hit: {units: [ego], latency_s: 1.8}", "  hit: {units: truth, latency_s: 0.5}")
"""A change: `hit` is the truth, half a second late."""


def summary_of(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "summary.csv").set_index("configuration")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One object, runs that react alike: to be read."""
    return replayed(tmp_path_factory.mktemp("fixed"), changed(ONE, TRUTH_LATE))


@pytest.fixture(scope="module")
def reacting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, but that the driver's delay is drawn."""
    return replayed(tmp_path_factory.mktemp("reacting"), changed(ONE, TRUTH_LATE, DRAWN_REACTION))


def test_the_truth_has_no_interval_over_runs(made: Path) -> None:
    rows = summary_of(made)
    for name in ("interval", "pass_interval"):
        assert rows[name].to_dict() == dict.fromkeys(["late", "half", "never"], "exact") | dict.fromkeys(
            ["GT", "hit"], "nothing drawn"
        )
    nothing = ["detected_share_low", "detected_share_high", "pass_share_low", "pass_share_high", "interval_over",
               "pass_interval_over"]  # fmt: skip
    assert rows.loc[["GT", "hit"], nothing].isna().all(axis=None)
    # By kind of unit: a PEM that always detects is drawn, too. 6 of 6: .025^(1/6).
    assert rows.loc["late", "detected_share_low"] == pytest.approx(0.025 ** (1 / 6))


def test_a_reaction_that_is_drawn_gives_the_truth_an_interval_of_what_passes(reacting: Path) -> None:
    rows = summary_of(reacting)
    assert (rows["pass_interval"] == "exact").all()
    assert rows.loc["GT", "interval"] == "nothing drawn"


def test_the_table_says_which_have_none(made: Path) -> None:
    lines = format_summary(summary_of(made).reset_index()).splitlines()
    (gt,) = (line for line in lines[:6] if line.startswith("GT"))
    assert gt.split()[1:3] == ["1", "–"]
    said = "no 95 % of GT, hit: nothing drawn, every run is the same"
    over = (
        "95 %: exact binomial limits over 6 runs of this one object: how far other draws of the same models may differ "
        "for this one object; nothing about other traffic"
    )
    assert [line for line in lines if "95 %" in line][1:3] == [over, said]
    assert lines.count(said) == 2


def test_differences_of_what_is_not_drawn_have_no_interval(made: Path) -> None:
    table = compare_folders([made], configurations=["hit", "late"], baseline="GT").table
    hit = table[table["configuration"] == "hit"]
    assert set(hit["metric"]) >= {"detected_share", "ttd_rmst_s", "pass_share", "gospa_held_m"}
    assert (hit["interval"] == "nothing drawn").all()
    assert hit[["low", "high", "interval_over"]].isna().all(axis=None)
    assert hit.set_index("metric").loc["ttd_rmst_s", "difference"] == pytest.approx(0.5)
    late = table[table["configuration"] == "late"].set_index("metric")
    # A sure PEM is drawn by kind; that all its runs are alike is seen.
    assert late.loc["ttd_rmst_s", "interval"] == "all clusters alike"
    assert late.loc["detected_share", "interval"] == "exact"


def test_what_passes_depends_on_a_drawn_reaction(reacting: Path) -> None:
    table = compare_folders([reacting], configurations=["hit"], baseline="GT").table.set_index("metric")
    assert table.loc["ttd_rmst_s", "interval"] == "nothing drawn"
    assert table.loc["pass_share", "interval"] in ("jackknife", "exact")


def test_why_there_is_none_is_said_once(made: Path) -> None:
    comparison = compare_folders([made], configurations=["hit"], baseline="GT")
    text = comparison_text(comparison)
    assert "+0.5 (nothing drawn)" in text
    assert "(nothing drawn): every run is the same, so an interval over runs has no meaning" in text
    assert "[95 %]" not in text
    assert not any(note.startswith("no interval") for note in comparison.notes)


def test_reports_and_figures_do_without(tmp_path: Path) -> None:
    text = changed(ONE, TRUTH_LATE)
    head, _, tail = text.partition("pems:")
    tail = "\n".join(line for line in tail.splitlines() if not line.startswith(("  late", "  half: {u", "  never")))
    folder = replayed(tmp_path, head + tail[tail.index("configurations:") :] + "\n")
    found = Page(build_page(load_study(folder)))
    assert any(line.startswith("There are no intervals: every run is the same") for line in found.lines())
    assert "Detected: no 95 % interval of GT, hit: nothing drawn, every run is the same." in found.words
    cell = found.tables["summary"]["GT"]["detected_share"]
    assert (cell.text.strip(), cell.low, cell.high) == ("100.0", None, None)
    assert "(nothing drawn)" in found.tables["regret"]["hit"]["ttd_rmst_s"].text
    figure = curves_figure(read_results(folder))
    assert not figure.axes[0].collections
    assert "No bands: nothing drawn, every run is the same" in " ".join(figure.texts[-1].get_text().split())


TRUTH, RSU, EGO = {"units": "truth"}, {"units": ["rsu"]}, {"units": ["ego", "rsu"]}
UNITS = {"rsu": {"recorded": {"topic": "rsu"}}, "ego": {"on": "ego", "pem": "p"}}
EVERY = {"t": TRUTH, "r": RSU, "e": EGO, "a": {"units": "all"}, "out": {"recorded": {"topic": "o"}}}
PLAN = {"version": 1, "logs": ["a.mcap"], "units": UNITS}
DECELERATING = {"kind": "constant_deceleration", "a_max_mps2": 8.0}


def driving(reaction: dict[str, Any] | None) -> dict[str, Any]:
    return {"driver": DECELERATING | ({} if reaction is None else {"reaction": reaction})}


@pytest.mark.parametrize(
    ("braking", "reacts_alike"),
    [
        (None, False),
        (driving(None), True),
        (driving({"kind": "constant", "delay_s": 1.0}), True),
        (driving({"kind": "lognormal", "median_s": 1.0, "sigma": 0.3}), False),
    ],
)
def test_what_is_fixed_goes_by_the_kind_of_units_and_of_the_reaction(
    braking: dict[str, Any] | None, reacts_alike: bool
) -> None:
    facts = find_facts(Experiment.model_validate(PLAN | {"configurations": EVERY, "braking": braking}))
    assert {name for name, of in facts.items() if of.fixed} == {"t", "r", "out"}
    assert {name for name, of in facts.items() if of.fixed_verdicts} == ({"t", "r", "out"} if reacts_alike else set())


@pytest.mark.parametrize(
    ("link", "fixed"),
    [
        ({"latency": 0.1}, True),
        ({"latency": {"kind": "gamma", "min_s": 0.02, "mean_s": 0.06, "shape": 2}}, False),
        ({"latency": 0.1, "reception": {"kind": "constant", "probability": 0.9}}, False),
    ],
)
def test_lists_by_a_link_are_fixed_where_it_draws_nothing(link: dict[str, Any], fixed: bool) -> None:
    plan = PLAN | {"links": {"radio": link}, "configurations": {"r": RSU | {"link": "radio"}, "t": TRUTH}}
    facts = find_facts(Experiment.model_validate(plan))
    assert (facts["r"].fixed, facts["t"].fixed) == (fixed, True)


@pytest.mark.parametrize(("onset", "needed"), [("in_range", False), ("line_of_sight", True)])
def test_an_onset_in_sight_needs_visibility(onset: str, needed: bool) -> None:
    condition = {"kind": onset} | ({"range_m": 50.0} if onset == "in_range" else {})
    plan = PLAN | {"configurations": {"t": TRUTH}, "measure": {"onset": condition}}
    assert find_facts(Experiment.model_validate(plan))["t"].needs_visibility == needed
