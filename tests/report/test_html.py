"""The report, read back from its HTML: its numbers are those of the tables, its words those of the case."""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pytest
from matplotlib.figure import Figure

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.core.errors import InputError, OutputError
from copem_replay.report import write_html_report
from copem_replay.report.figures import FIGURES, FigureKind, Selection
from copem_replay.report.figures.latency_breakdown import (
    FUSION,
    HIDDEN,
    IN_SIGHT,
    LISTED,
    OUT_OF_VIEW,
    PROCESSING,
    SINCE_CAPTURED,
    STAGES,
    TRANSPORT,
    UNTIL_CAPTURED,
    mean_stages,
)
from copem_replay.report.figures.registry import write_figure_files
from copem_replay.report.figures.selection import choose_object_and_run
from copem_replay.report.figures.style import figure_style, new_figure, render_figure, take_note
from copem_replay.report.html.conclusions import write_details
from copem_replay.report.html.markup import Html, make_tag
from copem_replay.report.html.page import build_page
from copem_replay.report.html.study import load_study
from copem_replay.report.html.tables import count_misses, format_power
from copem_replay.results.compare import compare_folders
from copem_replay.results.read import Results, read_results
from tests.helpers.compare_folders import unseal
from tests.helpers.report_pages import ALONE, EVERY, ONE, Page, changed, drive, replayed

NAMES = ("GT", "late", "half", "hit", "never")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the scene: to be read, not to be written to."""
    return replayed(tmp_path_factory.mktemp("made"), changed(ONE))


@pytest.fixture(scope="module")
def html(made: Path) -> str:
    return build_page(load_study(made))


@pytest.fixture(scope="module")
def read(html: str) -> Page:
    return Page(html)


@pytest.fixture
def mine(made: Path, tmp_path: Path) -> Path:
    """A copy of them, with its recording."""
    shutil.copytree(made.parent, tmp_path / "mine")
    return tmp_path / "mine" / "results"


class Ended(NamedTuple):
    code: int
    out: list[str]
    lines: list[str]
    """Of stderr."""


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ended]:
    def called(*arguments: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["copem-replay", *map(str, arguments)])
        capsys.readouterr()
        code = cli._run_to_exit_code()
        out, err = capsys.readouterr()
        return Ended(code, out.splitlines(), err.splitlines())

    return called


def summary_rows(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "summary.csv").open(newline="", encoding="utf-8") as file:
        return {row["configuration"]: row for row in csv.DictReader(file)}


def lines_of(folder: Path) -> list[str]:
    """What the top of a folder's report says."""
    return Page(build_page(load_study(folder))).lines()


def test_what_does_not_count_is_said(tmp_path: Path) -> None:
    """2 is within 31 m from the start, 3 comes within them after 2.3 s."""
    near = ("onset: {kind: at, time_s: 0.5}", "onset: {kind: in_range, range_m: 31}")
    page = Page(build_page(load_study(replayed(tmp_path, changed(near)))))
    said = "1 measured object, 6 runs, so 6 rows for each configuration; common random numbers per run (seed 1). "
    said += "1 more object was in range when the recording began; it does not count."
    assert said in page.words


RANKED = ["GT", "half", "late", "hit", "never"]
"""The truth, then the soonest first, as in the figures."""


class TestNumbers:
    def test_the_summary_has_the_numbers_of_the_file(self, read: Page, made: Path) -> None:
        rows = summary_rows(made)
        checked = 0
        for id_ in ("summary", "undetected", "braking", "accuracy", "lists"):
            assert list(read.tables[id_]) == RANKED
            for name, cells in read.tables[id_].items():
                for column, cell in cells.items():
                    assert (cell.value or "") == rows[name][column], (id_, name, column)
                    if column in ("detected_share", "pass_share"):
                        assert (cell.low or "") == rows[name][f"{column}_low"]
                        assert (cell.high or "") == rows[name][f"{column}_high"]
                    checked += 1
        assert checked == len(NAMES) * (8 + 2 + 1 + 11)

    def test_cells_have_two_decimals_and_shares_one_in_per_cent(self, read: Page, made: Path) -> None:
        rows = summary_rows(made)

        def plainly(column: str, text: str) -> str:
            """By Decimal, and so not as the report does it."""
            if not text:
                return "–"
            value = Decimal(text) * (100 if column.endswith("_share") else 1)
            if abs(value) >= 1000:
                return str(int(value.to_integral_value()))
            if column in ("n", "n_conflict"):
                return str(int(value))
            return str(round(value, 1 if column.endswith("_share") else 2)).replace("-", "−")

        seen = 0
        for id_ in ("summary", "undetected", "braking", "accuracy", "lists"):
            for name, cells in read.tables[id_].items():
                for column, cell in cells.items():
                    expected = plainly(column, rows[name][column])
                    if column in ("detected_share", "pass_share") and rows[name][f"{column}_low"]:
                        limits = [f"{100 * float(rows[name][f'{column}_{end}']):.3g}" for end in ("low", "high")]
                        expected += f" [{', '.join(limits)}]"
                    assert cell.text == expected, (name, column)
                    seen += 1
        assert seen == len(NAMES) * 22

    def test_columns_that_are_the_same_for_all_are_said_once(self, read: Page) -> None:
        assert "6 rows, 10 fused lists per second for each configuration.\n" in read.words
        assert "6 rows in conflict for each configuration.\n" in read.words
        assert not {"n", "list_rate_hz", "n_conflict"} & {
            name for t in read.tables.values() for name in t.get("GT", {})
        }

    def test_times_come_first_and_headers_have_units(self, read: Page) -> None:
        assert read.rows["summary"][0] == [
            "configuration", "known after (mean), s", "known after (median), s", "known after (95 % by), s",
            "detected, %", "unknown (mean), s", "unknown up to the horizon (mean), s",
            "at distance (median), m", "at distance (95 % beyond), m",
        ]  # fmt: skip
        assert read.rows["regret"][0][1:3] == ["known after (mean), s", "detected, percentage points"]
        assert read.rows["regret-lists"][0][1:] == [
            "position error of the newest list (RMSE), m",
            "GOSPA of the newest list, m",
            "false positives per minute",
        ]

    def test_the_regret_is_that_of_compare(self, read: Page, made: Path) -> None:
        rows = compare_folders([made], baseline="late").overall.set_index(["configuration", "metric"])
        seen = 0
        for id_ in ("regret", "regret-lists"):
            assert list(read.tables[id_]) == ["GT", "half", "hit", "never"]
            for name, cells in read.tables[id_].items():
                for metric, cell in cells.items():
                    row = rows.loc[(name, metric)]
                    for found, wanted in ((cell.value, row.difference), (cell.low, row.low), (cell.high, row.high)):
                        assert (found is None) == pd.isna(wanted)
                        assert found is None or float(found) == pytest.approx(wanted, rel=1e-8, abs=1e-12)
                    seen += 1
        assert seen == len(rows)

    def test_what_errors_are_over_stands_beside_them(self, read: Page, made: Path) -> None:
        rows = compare_folders([made], baseline="late").overall
        rows = rows[rows["metric"] == "position_rmse_held_m"].set_index("configuration")
        head, *lines = read.rows["regret-held"]
        assert head == ["configuration", "pairs", "frames", "listed by one only", "mean age, s", "no list", "no truth"]
        assert [line[0] for line in lines] == ["GT", "half", "hit", "never"]
        for name, pairs, frames, only, *_ in lines:
            row = rows.loc[name]
            assert (pairs, frames) == (str(row["n"]), str(row["frames"]))
            assert only == f"{row['only_configuration']} / {row['only_baseline']}"

    def test_differences_that_stand_in_the_whole_table_are_bold(self, read: Page, html: str, made: Path) -> None:
        overall = cr.compare(made).overall.set_index(["configuration", "metric"])
        for id_ in ("regret", "regret-lists"):
            for name, cells in read.tables[id_].items():
                row = re.search(rf'<table id="{id_}">.*?<tr data-row="{name}">(.*?)</tr>', html, re.DOTALL)
                assert row is not None
                for column, cell in cells.items():
                    bold = re.search(rf'data-column="{column}"[^>]*><b>', row[1]) is not None
                    star = overall["star"].get((name, column))
                    assert bold == (star == "*"), (name, column)
                    assert (" ° [" in cell.text) == (star == "°")

    def test_every_column_shown_is_explained(self, read: Page) -> None:
        tables = ("summary", "undetected", "braking", "needless", "accuracy", "lists", "regret", "regret-lists")
        shown = {name for id_ in tables for name in read.rows[id_][0][1:]}
        terms = re.findall(r"<dt>([^<]*?)</dt><dd>(.+?) <code>(\w+)</code></dd>", read.html)
        assert shown == {name for name, _, _ in terms}
        assert {name for id_ in tables for name in read.tables[id_]["GT"]} == {column for _, _, column in terms}

    def test_provenance_is_all_there(self, read: Page, made: Path) -> None:
        data = json.loads((made / "provenance.json").read_text(encoding="utf-8"))
        cells = {row[0]: row[1] for id_ in ("parameters", "libraries") for row in read.rows[id_]}
        (first, *_) = csv.DictReader((made / "read.csv").read_text(encoding="utf-8").splitlines())
        counts = [first["frames"], first["entries"]]
        assert all(int(count) > 0 for count in counts)
        assert read.rows["logs"][1] == ["drive", "truth", *counts, data["logs"][0]["sha256"]]
        assert {name: cells[name] for name in data["libraries"]} == data["libraries"]
        expected = {
            "seed": "1",
            "runs": "6",
            "copem_replay": data["copem_replay"],
            "measure.onset.kind": "at",
            "measure.objects.ids": "2",
            "measure.match.gate_m": "3",
            "measure.horizon_used_s": "4.5",
            "braking.driver.reaction.delay_s": "0.2",
        }
        assert {name: cells[name] for name in expected} == expected


class TestWords:
    def test_who_wins_by_how_much_and_how_sure(self, made: Path) -> None:
        lines = lines_of(made)
        assert lines[2] == (
            "Worse than late (100 % of conflicts pass): hit and never by 100 percentage points [54.1, 100]; no "
            "difference to late is shown, for 6 runs are too few: half 0 percentage points [-45.9, 45.9]."
        )
        assert "never never detects any object." in lines
        assert any(
            line.startswith("Braking in time: of 6 rows in conflict 100 % [") and "pass with late, half" in line
            for line in lines
        )
        assert "GT is the ground truth: the upper bound, not ranked." in lines
        assert any("over 6 runs of this one object" in line and "nothing about other traffic" in line for line in lines)

    def test_without_intervals_it_says_so(self, tmp_path: Path) -> None:
        lines = lines_of(replayed(tmp_path, changed()))
        assert lines[2] == (
            "The same as late (100 % of conflicts pass): half; on these objects alone, without an interval, against "
            "late: hit and never -100 percentage points."
        )
        assert any(line.startswith("There are no intervals: 2 objects of one drive, fewer than 5. ") for line in lines)

    def test_what_a_log_leaves_out_is_no_winner(self, tmp_path: Path) -> None:
        """Soonest by its mean, `half` is over one of two logs: it is ranked last and compared where both are."""
        logs = ("logs: [drive.mcap]", "logs: [drive.mcap, {file: two.mcap, units: {weak: null}}]")
        for name in ("drive", "two"):
            drive(tmp_path / f"{name}.mcap")
        (tmp_path / "e.yaml").write_text(changed(logs))
        folder = cr.run(tmp_path / "e.yaml", jobs=1).save(tmp_path / "results")
        rows, whole = summary_rows(folder), Page(build_page(load_study(folder)))
        lines = whole.lines()
        assert int(rows["half"]["n"]) == int(rows["late"]["n"]) / 2
        assert float(rows["half"]["ttd_rmst_s"]) < float(rows["late"]["ttd_rmst_s"])
        assert any(line.startswith("half is ranked last: some logs lack the units, and means and") for line in lines)
        results = read_results(folder)
        assert set(choose_object_and_run(results, Selection(log="two")).configurations) == {
            "GT",
            "late",
            "hit",
            "never",
        }
        with pytest.raises(InputError, match="log two has none of the units of half; choose another log"):
            choose_object_and_run(results, Selection(("half",), log="two"))
        note = "configuration half: none of its units in 1 of 2 logs (two), and left out there"
        assert any(note in line for line in whole.words.splitlines())

    def test_of_equal_lists_none_is_the_best(self, tmp_path: Path) -> None:
        """Braking names all that are equal."""
        second = ("  hit: {units: [ego], latency_s: 1.8}", "  second: {units: [ego]}")
        blind = ("  late: {units: [ego], latency_s: 0.5}", "  late: {units: [eye]}")
        text = changed(ONE, ("  half: {units: [weak]}", "  half: {units: [ego]}"), second, blind)
        lines = lines_of(replayed(tmp_path, text))
        [braking] = [line for line in lines if line.startswith("Braking")]
        assert "pass with half, second, 0 % [" in braking
        assert "with late, never" in braking

    @pytest.mark.parametrize(
        ("low", "high", "includes"),
        [
            (-0.3, 0.2, True),
            (-0.3, 0.0, True),
            (0.0, 0.3, True),
            (-0.3, -1e-12, True),  # what is left of 0 when floats are summed
            (1e-12, 0.3, True),
            (-0.3, -1e-9 / 100, True),  # in percentage points, what counts as nothing, exactly
            (1e-9 / 100, 0.3, True),
            (-0.3, -2e-11, False),
            (2e-11, 0.3, False),
            (-0.3, -0.01, False),
            (0.01, 0.3, False),
        ],
    )
    def test_an_interval_of_shares_that_includes_0_is_said_to(
        self, made: Path, low: float, high: float, includes: bool
    ) -> None:
        study = load_study(made, "hit")
        assert study.regret is not None
        table = study.regret.table.copy()
        table.loc[table["metric"] == "pass_share", ["low", "high"]] = low, high
        words = write_details(replace(study, regret=replace(study.regret, table=table)))
        assert "against hit" in words
        assert ("the interval includes 0, so no difference can be shown" in words) is includes

    def test_one_configuration_is_compared_with_nothing(self, tmp_path: Path) -> None:
        folder = replayed(tmp_path, changed(ONE, *ALONE))
        found = Page(build_page(load_study(folder)))
        lines = found.lines()
        assert "with the one configuration of perception units" in lines[1]
        assert lines[2].startswith("half: an object is known after ")
        assert lines[2].endswith(" of conflicts pass; there is nothing to compare it with.")
        assert "No differences: there is one configuration only." in found.words
        assert "regret" not in found.tables
        assert list(found.tables["summary"]) == ["half"]

    def test_beside_the_truth_alone_nobody_competes(self, tmp_path: Path) -> None:
        folder = replayed(tmp_path, changed(ONE, *ALONE[1:]))
        assert lines_of(folder)[2].endswith("; there is nothing to compare it with.")
        study = load_study(folder)
        assert study.baseline == "half"
        assert study.regret is not None
        assert study.regret.configurations == ("GT",)

    def test_nothing_detected_has_no_winner(self, tmp_path: Path) -> None:
        text = changed(ONE, ("  late: {units: [ego], latency_s: 0.5}", "  late: {units: [eye]}"), *ALONE[:1], ALONE[2])
        text = text.replace("  half: {units: [weak]}", "  half: {units: [eye]}")
        found = Page(build_page(load_study(replayed(tmp_path, text))))
        assert found.lines()[2] == ("No configuration detects any measured object in any run.")
        assert "No figure: nothing was detected." in found.words
        assert found.rows["never"][1][:5] == ["drive", "2", "pedestrian", "6 runs (all)", "all 3 configurations"]

    def test_nobody_measured_is_no_answer(self, tmp_path: Path) -> None:
        folder = replayed(tmp_path, changed((EVERY, "measure: {objects: {classes: [animal]}, onset")))
        found = Page(build_page(load_study(folder)))
        assert found.lines()[2] == "There is no answer: no measured object has an onset."
        assert any(line.startswith("drive: no rows: nothing to measure") for line in found.lines())
        assert "No differences: no object is measured." in found.words
        assert found.plots == []
        assert "0 rows" in found.words

    def test_the_baseline_is_ideal_else_the_first_else_as_asked(self, made: Path, tmp_path: Path) -> None:
        assert load_study(made).baseline == "late"
        assert load_study(made, "hit").baseline == "hit"
        first = (
            "Each configuration minus <b>late</b>: the first that is not the truth; --baseline of copem-replay report"
        )
        assert first in build_page(load_study(made))
        assert "Each configuration minus <b>hit</b>: chosen with --baseline." in build_page(load_study(made, "hit"))
        with pytest.raises(InputError, match="no configuration is named 'hti'"):
            load_study(made, "hti")
        named = replayed(tmp_path, changed(ONE, ("  hit:", "  ideal:")))
        assert load_study(named).baseline == "ideal"
        assert "minus <b>ideal</b>: by its name; " in build_page(load_study(named))


class TestNeverDetected:
    def test_by_name_and_in_how_many_runs(self, tmp_path: Path) -> None:
        found = Page(build_page(load_study(replayed(tmp_path, changed()))))
        assert found.rows["never"] == [
            ["log", "object", "class", "never in", "by", "looked at for (s)", "until", "look at it"],
            ["drive", "2", "pedestrian", "6 runs (all)", "never", "4.5", "the log ended", "story"],
            ["drive", "3", "pedestrian", "6 runs (all)", "never", "4.5", "the log ended", "story"],
        ]

    def test_without_a_draw(self, tmp_path: Path) -> None:
        """`half` has 46 lists of the one in the way, 14 of which are soon enough; odds of 1 : 1, halved 1 : 2."""
        exact = (EVERY, "measure: {exact: true, objects: {ids: [2]}, onset")
        folder = replayed(tmp_path, changed(exact))
        rows = summary_rows(folder)
        assert float(rows["half"]["miss_log10"]) == pytest.approx(46 * math.log10(1 / 2))
        assert float(rows["half"]["miss_per_logit"]) == pytest.approx(-23)
        assert float(rows["half"]["miss_log10_half_odds"]) == pytest.approx(46 * math.log10(2 / 3))
        assert float(rows["half"]["fail_share_exact"]) == pytest.approx(2.0**-14)
        words = Page(build_page(load_study(folder))).words
        certain = "the detection of every measured object is certain. The ego fails with probability"
        assert f"GT: {certain} 0." in words
        assert f"hit: {certain} 1." in words
        assert (
            "half: a measured object is never detected with probability 1.4·10−14; were the odds of every detection "
            "half of what the PEM says, that would be 7.9·10−9. The ego fails with probability 6.1·10−5."
        ) in words
        assert "never: no list ever holds a measured object. The ego fails with probability 1." in words

    def test_nothing_of_it_where_it_was_not_asked_for(self, read: Page) -> None:
        assert "Without a draw" not in read.words

    @pytest.mark.parametrize(
        ("log10", "shown"),
        [
            (0.0, "1"),
            (math.log10(0.0123), "0.0123"),
            (-3.5, "3.2·10<sup>−4</sup>"),
            (-22.0, "10<sup>−22</sup>"),
            (-22.000000000000004, "10<sup>−22</sup>"),
            (math.log10(9.96) - 30, "10<sup>−29</sup>"),
            (-3630.3010299956640, "5.0·10<sup>−3631</sup>"),
        ],
    )
    def test_numbers_of_any_size(self, log10: float, shown: str) -> None:
        assert format_power(log10) == shown

    def test_counts_runs_by_log_object_and_configuration(self) -> None:
        rows = pd.DataFrame(
            [
                ("a", "1", "A", 0.5, 1), ("a", "1", "A", None, 2), ("a", "1", "B", 0.5, 3),
                ("b", "1", "A", 0.1, 1), ("b", "1", "A", 0.7, 1), ("b", "1", "A", None, 1),
            ],
            columns=["log", "object_id", "configuration", "time_to_detection_s", "runs"],
        ).assign(object_class="car", episode=0, onset_s=0.0, ended_s=1.0, ended_by="log_end")  # fmt: skip
        found = count_misses(rows)[["log", "object_id", "configuration", "missed", "runs"]].to_numpy().tolist()
        assert found == [["a", "1", "A", 2, 3], ["b", "1", "A", 1, 3]]


class TestWaterfall:
    def test_stages_by_hand(self, read: Page) -> None:
        cells = read.tables["stages"]
        shown = {name: {stage: cell.text for stage, cell in row.items()} for name, row in cells.items()}
        assert shown["late"] == {
            "detected": "6 of 6", HIDDEN: "0.00", IN_SIGHT: "0.00", UNTIL_CAPTURED: "–", TRANSPORT: "0.50",
            FUSION: "0.00", "sum": "0.50",
        }  # fmt: skip
        assert (shown["GT"][UNTIL_CAPTURED], shown["GT"][HIDDEN], shown["GT"]["sum"]) == ("0.00", "–", "0.00")
        assert (shown["never"]["detected"], shown["never"]["sum"]) == ("0 of 6", "–")
        assert float(cells["half"][IN_SIGHT].value or "nan") == pytest.approx(float(cells["half"]["sum"].value or 0))

    @staticmethod
    def rows(**columns: Any) -> pd.DataFrame:
        """Two rows of one configuration, seconds: the clock starts at 1, captured at 3 and 4, known at 5 and 7."""
        given = {
            "detected": [True, True],
            "onset_s": [1.0, 1.0],
            "out_of_view_s": [0.0, 0.0],
            "hidden_s": [1.0, 1.0],
            "captured_s": [3.0, 4.0],
            "detection_s": [5.0, 7.0],
        }
        return pd.DataFrame(given | columns)

    def stages(self, made: Path, rows: pd.DataFrame, **configuration: Any) -> dict[str, float]:
        experiment = read_results(made).experiment
        measure = configuration.pop("measure", {})
        data = experiment.as_written()
        data["measure"] |= measure
        data["configurations"] = {"it": {"units": ["ego", "weak"], **configuration}}
        return mean_stages(rows, type(experiment).model_validate(data), "it")

    def test_what_arrives_is_known_where_fusion_is_ideal(self, made: Path) -> None:
        expected = {HIDDEN: 1.0, IN_SIGHT: 1.5, TRANSPORT: 2.5, FUSION: 0.0}
        assert self.stages(made, self.rows()) == expected
        assert self.stages(made, self.rows(), latency_s={"ego": 1.0, "default": 2.0}) == expected

    def test_latency_is_transport_and_the_rest_fusion(self, made: Path) -> None:
        gnn = {"fusion": {"kind": "gnn"}}
        expected = {HIDDEN: 1.0, IN_SIGHT: 1.5, TRANSPORT: 1.5, FUSION: 1.0}
        assert self.stages(made, self.rows(), latency_s=1.5, **gnn) == expected
        assert self.stages(made, self.rows(), latency_s={"ego": 1.5, "weak": 1.5}, **gnn) == expected
        confirm = {"confirm": {"hits": 2, "of": 3}}
        assert self.stages(made, self.rows(), latency_s=1.5, measure=confirm) == expected, "ideal, confirmed"

    def test_what_is_not_known_is_one_stage(self, made: Path) -> None:
        mixed = {"fusion": {"kind": "gnn"}, "latency_s": {"ego": 1.5, "weak": 1.0}}
        assert self.stages(made, self.rows(), **mixed) == {HIDDEN: 1.0, IN_SIGHT: 1.5, SINCE_CAPTURED: 2.5}
        blind = self.rows(out_of_view_s=[float("nan")] * 2, hidden_s=[float("nan")] * 2)
        assert self.stages(made, blind) == {UNTIL_CAPTURED: 2.5, TRANSPORT: 2.5, FUSION: 0.0}
        older = self.rows().drop(columns=["out_of_view_s", "hidden_s"])
        assert self.stages(made, older) == {UNTIL_CAPTURED: 2.5, TRANSPORT: 2.5, FUSION: 0.0}

    def test_with_a_link_ready_or_sends_the_way_is_told(self, made: Path) -> None:
        """Listed at 2.5 and 3, ready .25 and .75 s after the capture, arrived .5 s before it is known."""
        way = self.rows(listed_s=[2.5, 3.0], sent_s=[3.25, 4.75], arrived_s=[4.5, 6.5])
        linked = {"link": {"kind": "radio", "latency": 0.1}}
        expected = {HIDDEN: 1.0, IN_SIGHT: 0.75, LISTED: 0.75, PROCESSING: 0.5, TRANSPORT: 1.5, FUSION: 0.5}
        assert self.stages(made, way, **linked) == expected
        assert list(STAGES) == [OUT_OF_VIEW, HIDDEN, IN_SIGHT, UNTIL_CAPTURED, *list(expected)[2:], SINCE_CAPTURED], (
            "drawn in order"
        )
        at_once = way.assign(listed_s=[9.0, 9.0], sent_s=way["captured_s"])
        none = {HIDDEN: 1.0, IN_SIGHT: 1.5, TRANSPORT: 2.0, FUSION: 0.5}
        assert self.stages(made, at_once, **linked) == none, "stages that take no time are none"
        blind = way.assign(out_of_view_s=float("nan"), hidden_s=float("nan"))
        rest = {stage: mean_s for stage, mean_s in expected.items() if stage not in (HIDDEN, IN_SIGHT)}
        assert self.stages(made, blind, **linked) == {UNTIL_CAPTURED: 1.75} | rest

    def test_what_is_out_of_view_is_a_stage_of_its_own(self, made: Path) -> None:
        found = self.stages(made, self.rows(out_of_view_s=[0.5, 1.0], hidden_s=[1.5, 0.0]))
        assert found == {OUT_OF_VIEW: 0.75, HIDDEN: 0.75, IN_SIGHT: 1.0, TRANSPORT: 2.5, FUSION: 0.0}

    def test_only_the_detected_have_stages(self, made: Path) -> None:
        nan = float("nan")
        one = self.rows(detected=[True, False], captured_s=[3.0, nan], detection_s=[5.0, nan])
        assert self.stages(made, one) == {HIDDEN: 1.0, IN_SIGHT: 1.0, TRANSPORT: 2.0, FUSION: 0.0}
        assert self.stages(made, self.rows(detected=[False, False])) == {}

    def test_with_count_earlier_there_is_none(self, tmp_path: Path) -> None:
        folder = replayed(tmp_path, changed(("time_s: 0.5}}", "time_s: 0.5}, count_earlier: true}")))
        found = Page(build_page(load_study(folder)))
        assert "No figure: with count_earlier" in found.words
        assert found.plots == ["answer-stacked", "answer", "differences", "late_paths", "curves", "distances"]


class TestFigures:
    def test_each_that_the_report_has(self, read: Page, tmp_path: Path) -> None:
        assert read.plots == [
            "answer-stacked",
            "answer",
            "differences",
            "late_paths",
            "curves",
            "distances",
            "latency_breakdown",
        ]
        text = changed(ONE, *ALONE[2:]) + "sweep: {latency_s: [0, 0.5], rate_hz: [2, 10]}\n"
        assert Page(build_page(load_study(replayed(tmp_path, text)))).plots == [*read.plots, "sweeps"]

    def test_they_are_those_of_plot(self, made: Path, html: str) -> None:
        """Shape by shape: the paths of each figure of `plot` without its note, in their order, are in the page."""
        results = read_results(made)
        shapes = re.findall(r' d="([^"]*)"', html)
        for name in ("curves", "distances", "latency_breakdown"):
            figure = FIGURES[name].draw(results, Selection())
            take_note(figure)
            drawn = re.findall(r' d="([^"]*)"', render_figure(figure, (".svg",))[".svg"].decode("utf-8"))
            first = next(k for k in range(len(shapes)) if shapes[k : k + len(drawn)] == drawn)
            assert len(drawn) > 50, name
            del shapes[first : first + len(drawn)]

    def test_one_of_ones_own_is_in_plot_and_report(
        self, mine: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        def rows(results: Results, of: Selection) -> Figure:
            with figure_style():
                figure = new_figure(3.0, 2.0)
                figure.subplots().bar(results.chosen(of.configurations), 1.0)
            return figure

        about = ("Of each configuration a bar.",)
        own = FigureKind("How many", "a bar per configuration", rows, about=lambda results: about)
        monkeypatch.setitem(FIGURES, "how_many", own)
        files, notes = write_figure_files(read_results(mine), tmp_path / "figures", Selection())
        assert [file.name for file in files[-2:]] == ["how_many.png", "how_many.svg"]
        assert notes == []
        found = Page(build_page(load_study(mine)))
        assert found.plots[-1] == "how_many"
        assert "How many\nOf each configuration a bar.\n" in found.words
        monkeypatch.setitem(FIGURES, "how_many", replace(own, missing=lambda results, of: "there are none"))
        assert "No figure: there are none." in Page(build_page(load_study(mine))).words
        _, notes = write_figure_files(read_results(mine), tmp_path / "figures", Selection())
        assert notes == ["no figure of how_many: there are none"]
        assert not list((tmp_path / "figures").glob("how_many*"))

    def test_ids_are_of_one_figure(self, read: Page) -> None:
        ids = [given["id"] for _, given in read.elements + read.drawn if given.get("id")]
        drawn = [id_ for id_ in ids if id_ and id_.startswith(("curves-", "distances-", "latency_breakdown-"))]
        assert len(drawn) > 30
        assert len(set(ids)) == len(ids)
        known = {f"#{id_}" for id_ in ids}
        used = {given["xlink:href"] for _, given in read.elements + read.drawn if "xlink:href" in given}
        clips = {clip[4:-1] for _, given in read.elements + read.drawn if (clip := given.get("clip-path"))}
        assert used | clips <= known

    def test_what_is_of_a_configuration_is_marked(self, read: Page) -> None:
        ids = [given["id"] or "" for _, given in read.elements + read.drawn if "id" in given]
        for name in ("curves", "distances", "latency_breakdown"):
            numbers = {id_.split("-")[2] for id_ in ids if id_.startswith(f"{name}-configuration-")}
            assert numbers == {"0", "1", "2", "3", "4"}, name

    def test_a_foreseen_collision_is_said(self, tmp_path: Path) -> None:
        text = changed(ONE, *ALONE[2:], ("time_s: 0.5}}", "time_s: 0.5}, conflict: {horizon_s: 2.0}}"))
        text = text.replace("braking: {", "braking: {brakes_for: conflict, ")
        found = Page(build_page(load_study(replayed(tmp_path, text))))
        assert "Distance when the collision is foreseen" in found.words
        assert list(found.tables["conflict"]) == ["GT", "half", "late"], "the soonest first"

    def test_the_page_is_small(self, html: str) -> None:
        assert len(html.encode()) < 1_500_000


class TestFile:
    def test_the_same_bytes_wherever_the_folder_lies(self, made: Path, mine: Path, tmp_path: Path, html: str) -> None:
        assert write_html_report(mine) == mine / "report.html"
        assert (mine / "report.html").read_text(encoding="utf-8") == html
        other = tmp_path / "elsewhere" / "other"
        shutil.copytree(mine, other)
        shutil.copy(mine.parent / "drive.mcap", other.parent)
        (other / "report.html").unlink()
        deep = write_html_report(other, tmp_path / "new" / "deep.htm")
        assert deep.read_bytes() == (mine / "report.html").read_bytes()
        assert not (other / "report.html").exists()
        assert str(tmp_path).encode() not in deep.read_bytes()

    def test_nothing_is_fetched(self, read: Page) -> None:
        for name, found in read.elements + read.drawn:
            assert name not in ("img", "iframe", "object", "embed", "base", "form"), name
            for key, value in found.items():
                assert key not in ("src", "srcset", "action"), (name, key)
                assert key != "style" or "url(" not in (value or "").replace("url(#", ""), (name, value)
                assert key != "xlink:href" or (value or "").startswith("#"), (name, value)
                assert not key.startswith("on"), (name, key)
                assert key != "href" or value == "data:," or (value or "").startswith("#"), (name, value)
        (policy,) = [found["content"] for _, found in read.elements if found.get("http-equiv")]
        assert policy is not None
        assert policy.startswith("default-src 'none';")
        assert "http" not in policy
        style = re.search(r"<style>(.*?)</style>", read.html, re.DOTALL)
        assert style is not None
        assert "url(" not in style[1]
        assert {given["href"] for name, given in read.elements if name == "a"} <= {
            f"#{given['id']}" for _, given in read.elements if "id" in given
        }
        assert "@import" not in style[1]

    def test_names_are_shown_and_do_nothing(self, tmp_path: Path) -> None:
        name, log = "<img src=x onerror=alert(1)>\"'&amp;", "<script>alert(2)&'.mcap"
        text = changed(("logs: [drive.mcap]", f'logs: ["{log}"]'), ("  late:", f"  {json.dumps(name)}:"))
        text = text.replace("  ego: {on", '  "<b>ego": {on').replace("[ego]", '["<b>ego"]')
        html = build_page(load_study(replayed(tmp_path, text, log)))
        found = Page(html)
        plain = Page(build_page(load_study(replayed(tmp_path / "plain", changed()))))
        assert [tag for tag, _ in found.elements] == [tag for tag, _ in plain.elements]
        assert [sorted(given) for _, given in found.elements] == [sorted(given) for _, given in plain.elements]
        assert name in found.tables["summary"]
        assert found.rows["logs"][1][0] == log.removesuffix(".mcap")
        assert "<b>ego" in found.words
        assert html.count("onerror") == html.count("&lt;img src=x onerror=alert(1)&gt;")

    def test_elements_escape_all_but_html(self) -> None:
        made = make_tag("td", "a<b>&\"'", Html("<i></i>"), class_='x"y', data_value=None, hidden=True)
        assert made == '<td class="x&quot;y" hidden>a&lt;b&gt;&amp;&quot;&#x27;<i></i></td>'
        assert make_tag("p", "a\nb\x1b\u202e") == "<p>a\\nb\\x1b\\u202e</p>"

    def test_another_summary_is_refused(self, mine: Path) -> None:
        text = (unseal(mine) / "summary.csv").read_text(encoding="utf-8")
        for damaged, said in (
            (text.replace("ttd_rmst_s,", "ttd_mean_s,"), "expected the column ttd_rmst_s, found none"),
            (text.replace("pass_share_low", "low"), "expected the column pass_share_low, found none"),
            (
                text.replace("\nhit,", "\nhits,"),
                "expected rows of GT, late, half, hit, never, found GT, late, half, hits",
            ),
            (text.replace("\nnever,", "\n,"), "found GT, late, half, hit, ; run the experiment again"),
            (re.sub(r"(?<=\nhit,)[^,]*", "x", text), "column [a-z_]*: expected numbers, found "),
        ):
            (mine / "summary.csv").write_text(damaged, encoding="utf-8")
            with pytest.raises(InputError, match=said):
                write_html_report(mine)
            with pytest.raises(InputError, match=said):
                write_figure_files(read_results(mine), None, Selection())

    def test_nothing_half_written(self, mine: Path, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("a file")
        for out in (tmp_path / "report.pdf", tmp_path / "file" / "report.html", mine):
            with pytest.raises(OutputError):
                write_html_report(mine, out)
        (mine / "detections.parquet").write_bytes(b"PAR1 damaged")
        with pytest.raises(InputError, match=r"detections.parquet: expected the file that was written"):
            write_html_report(mine)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "mine"]
        assert not (mine / "report.html").exists()


class TestCommands:
    def test_run_writes_it_when_asked(self, call: Callable[..., Ended], tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        experiment, out = tmp_path / "e.yaml", tmp_path / "out"
        experiment.write_text(changed(ONE), encoding="utf-8")
        assert call("run", experiment, "--out", out).code == 0
        assert not (out / "report.html").exists()
        refused = call("run", experiment, "--out", out, "--report")
        assert (refused.code, len(refused.lines)) == (2, 1)
        assert not (out / "report.html").exists()
        ended = call("run", experiment, "--out", out, "--report", "--overwrite")
        lead = Page((out / "report.html").read_text(encoding="utf-8")).lines()[2]
        assert ended.code == 0
        assert " ".join(line.strip() for line in ended.out[ended.out.index("") + 1 :]).endswith(lead)
        assert ended.out[ended.out.index(f"report in {out / 'report.html'}") :][:4] == (
            [
                f"report in {out / 'report.html'}",
                f"results in {out}; every figure: --explain",
                f"next: copem-replay report {out}",
                "",
            ]
        )
        first = (out / "report.html").read_bytes()
        assert call("report", out).out == [f"report in {out / 'report.html'}"]
        assert (out / "report.html").read_bytes() == first
        assert call("run", experiment, "--out", out, "--overwrite").code == 0
        assert not (out / "report.html").exists(), "a report of other results would be left behind"

    def test_wrong_input_is_one_line(self, call: Callable[..., Ended], mine: Path, tmp_path: Path) -> None:
        for arguments, said in (
            ((tmp_path / "none",), "expected a results folder, found no such folder"),
            ((mine, "--out", tmp_path / "x.csv"), "expected a name that ends with .html or .htm, found x.csv"),
            ((mine, "--baseline", "nobody"), "--baseline: no configuration is named 'nobody'"),
        ):
            ended = call("report", *arguments)
            assert (ended.code, len(ended.lines), ended.out) == (2, 1, [])
            assert said in ended.lines[0]
