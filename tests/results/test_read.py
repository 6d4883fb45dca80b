"""Results folders as they are read: only what is asked for, and nothing of other results."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from copem_replay.core.errors import InputError
from copem_replay.results.read import open_results, read_results
from tests.helpers.compare_folders import row, write_folder


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
    with pytest.raises(InputError, match="other results took its place while it was read; do it once more"):
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
