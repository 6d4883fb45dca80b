"""Results folders as they are read: only what is asked for, and nothing of other results."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

import copem_replay as cr
from copem_replay.core.errors import InputError
from copem_replay.metrics.columns import TABLES
from copem_replay.results.read import open_results, read_results
from copem_replay.results.table_files import read_csv, read_frame, read_parquet, write_parquet
from tests.helpers.compare_folders import row, unseal, write_folder
from tests.helpers.experiments import changed, drive


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of an experiment that is none, without a summary: enough for a comparison."""
    return write_folder(tmp_path / "made", [row("ideal", 1.0), row("late", 2.0)], seed=7, run_shown={"a": 3})


def test_an_opened_folder_tells_its_provenance(folder: Path) -> None:
    found = open_results(folder)
    assert (found.name, found.provenance.seed, found.provenance.runs) == ("made", 7, 1)
    assert [(log.name, log.topic, log.sha256) for log in found.provenance.logs] == [
        ("a", "ground_truth", "content of a")
    ]
    assert found.provenance.run_shown == {"a": 3}
    assert found.provenance.horizon_used_s == 10.0
    assert "horizon_used_s" not in found.provenance.measure
    assert found.provenance.data["measure"]["horizon_used_s"] == 10.0, "the file as it is"


def test_files_are_read_when_they_are_asked_for(folder: Path) -> None:
    found = open_results(folder)
    assert found.rows_of("a")["detections.parquet"]["detection_s"].to_pylist() == [1.0, 2.0]
    assert found.source.data == {"version": 1, "ego": None}
    with pytest.raises(InputError, match=r"experiment\.yaml:1: logs: missing"):
        _ = found.experiment
    with pytest.raises(InputError, match=r"found no summary\.csv in it"):
        read_results(folder)


def test_tables_of_other_results_are_refused(folder: Path, tmp_path: Path) -> None:
    found = open_results(folder)
    assert found.source.data["version"] == 1
    shutil.copytree(folder, tmp_path / "other")
    shutil.rmtree(folder)
    (tmp_path / "other").rename(folder)
    with pytest.raises(InputError, match="other results took its place while it was read; run the command again"):
        _ = found.rows_of("a")
    assert found.source.data["version"] == 1, "what was read before"


def test_rows_are_counted_and_given_log_by_log(tmp_path: Path) -> None:
    rows = [row("ideal", 1.0), row("late", 2.0), row("late", None, run=1), row("late", 3.0, log="b")]
    found = open_results(write_folder(tmp_path / "made", rows))
    assert found.rows.counts == {("a", "ideal"): 1, ("a", "late"): 2, ("b", "late"): 1}
    assert found.rows.configurations == ("ideal", "late")
    first, second = found.each("detection_s", "brake_s", "run")
    assert list(first) == ["detection_s", "run"], "what there is of the columns"
    assert (first["detection_s"].to_list()[:2], second["detection_s"].to_list()) == ([1.0, 2.0], [3.0])
    (only,) = found.each(log="b")
    assert (only["configuration"].to_list(), "log" in only) == (["late"], False)


# What is in a table is checked where it is read.


def summary(**columns: list[object]) -> str:
    """`summary.csv` of two configurations."""
    given = {name: [None, None] for name in TABLES["summary.csv"].kinds()}
    return pd.DataFrame({**given, "configuration": ["ideal", "late"], "n": [1, 1], **columns}).to_csv(index=False)


SUMMARIES = {
    summary(ttd_p5_s=["1.0:", 2.0]): "column ttd_p5_s: expected numbers, found text",
    summary(
        interval_over=["2", "runs"]
    ): "column interval_over: expected one of logs, objects, passes, runs, found '2'",
    summary(nees=["-inf", 2.0]): "column nees: expected numbers from -1e+100 to 1e+100, found -inf",
    summary(ttd_p5_s=[1e200, 2.0]): "column ttd_p5_s: expected numbers from -1e+10 to 1e+10, found 1e+200",
    summary(mine=["a", 2.0]): "column mine: expected numbers, found text",
    summary().replace("late", "ideal"): "expected one row for each configuration, found several for ideal",
}


@pytest.mark.parametrize("text", SUMMARIES, ids=SUMMARIES.values())
def test_a_damaged_summary_is_refused_in_a_line(folder: Path, text: str) -> None:
    (folder / "summary.csv").write_text(text)
    with pytest.raises(InputError) as refused:
        _ = open_results(folder).summary
    assert refused.value.problems == (
        f"{folder}/summary.csv: {SUMMARIES[text]}; run the experiment again with --overwrite",
    )


def test_what_a_summary_may_have_is_read(folder: Path) -> None:
    text = summary(ttd_p5_s=[None, 0.0], interval=[None, None], nees=[None, None], mine=["inf", None])
    (folder / "summary.csv").write_text(text)
    found = open_results(folder).summary
    assert found["mine"].to_list()[0] == float("inf"), "an own metric may be anything"
    assert found[["ttd_p5_s", "interval", "nees"]].isna().sum().to_list() == [1, 2, 2]


@pytest.mark.parametrize(
    ("what", "problem"),
    [
        (
            {"by": "class,class"},
            "expected one row for each by, group, configuration, found several for class, car, late",
        ),
        ({"apart": "maybe,True"}, "column apart: expected true or false, found text"),
    ],
    ids=["twice", "no flag"],
)
def test_damaged_slices_are_refused(folder: Path, what: dict[str, str], problem: str) -> None:
    given = {"by": "class,log", "group": "car,car", "configuration": "late,late", "apart": "True,"} | what
    pd.DataFrame({name: values.split(",") for name, values in given.items()}).to_csv(
        folder / "summary_by.csv", index=False
    )
    with pytest.raises(InputError, match=problem):
        read_frame(folder / "summary_by.csv", read_csv, {})


@pytest.mark.parametrize(
    ("name", "values", "problem"),
    [
        ("run", [0, None], "expected a number in every row, found none in some"),
        ("run", [0, -1], "expected numbers from 0 to 1e+15, found -1"),
        ("episode", [None, None], "expected a number in every row, found none in some"),
        ("detected", [True, None], "expected true or false in every row, found none in some"),
        ("onset_s", [0.0, float("nan")], "expected a number in every row, found none in some"),
        ("onset_s", [0.0, -1e308], "expected numbers from -1e+10 to 1e+10, found -1e+308"),
        ("distance_at_detection_m", [float("inf"), 1.0], "expected numbers from -1e+100 to 1e+100, found inf"),
        ("object_id", ["7", None], "expected text in every row, found none in some"),
    ],
)
def test_damaged_rows_are_refused_log_by_log_and_as_a_whole(
    folder: Path, name: str, values: list[object], problem: str
) -> None:
    file = folder / "detections.parquet"
    table = parquet.read_table(file)
    k = table.column_names.index(name)
    parquet.write_table(table.set_column(k, name, pa.array(values, table.schema.field(name).type)), file)
    where = re.escape(f"{file}: column {name}: {problem}; run the experiment again with --overwrite")
    with pytest.raises(InputError, match=where):
        open_results(folder).rows_of("a")
    with pytest.raises(InputError, match=where):
        read_frame(file, read_parquet, {})


def test_a_braking_that_nothing_could_have_done_is_infinite(folder: Path) -> None:
    file = folder / "detections.parquet"
    table = parquet.read_table(file).append_column("required_deceleration_mps2", pa.array([float("inf"), None]))
    parquet.write_table(table, file)
    rows = open_results(folder).rows.of("a")
    assert rows["required_deceleration_mps2"].to_pylist() == [float("inf"), None]


def test_a_tally_counts_the_rows_of_detections(folder: Path) -> None:
    """Judged from the tally alone, rows that are gone would still count."""
    columns = TABLES["tally.parquet"].frame(
        [row("ideal", 1.0) | {"event": "detected", "runs": 1}, row("late", 2.0) | {"event": "detected", "runs": 2}]
    )
    write_parquet(columns.fillna({"object_class": "car"}), folder / "tally.parquet")
    with pytest.raises(
        InputError, match=r"tally\.parquet: expected the 2 rows of detections\.parquet counted, found 3; run the "
    ):
        _ = open_results(folder).tally


def test_a_key_of_gospa_that_is_missing_stands_for_its_default(folder: Path) -> None:
    file = folder / "provenance.json"
    data = json.loads(file.read_text())
    del data["measure"]["gospa"]["power"]
    file.write_text(json.dumps(data))
    assert open_results(folder).provenance.measure["gospa"] == {"cutoff_m": None, "power": 2.0}


@pytest.mark.parametrize("name", ["detections.parquet", "tally.parquet"])
def test_objects_that_the_recording_does_not_have_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    drive(Path("drive.mcap"))
    Path("e.yaml").write_text(changed("show: null"))
    unseal(cr.run("e.yaml").save("out"))
    table = parquet.read_table(f"out/{name}")
    k = table.column_names.index("object_id")
    parquet.write_table(table.set_column(k, "object_id", pa.array(["-1"] * len(table))), f"out/{name}")
    results = cr.load_results("out")
    with pytest.raises(InputError) as refused:
        results.recording("drive", results.experiment)
    assert refused.value.problems == (
        f"out/{name}: expected objects of the recording drive, found '-1'; run the experiment again with --overwrite",
    )
