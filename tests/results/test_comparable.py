"""What cannot be compared is refused, a line for every reason; what is left out is said."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from pyarrow import parquet

from copem_replay.core.errors import InputError
from copem_replay.results.compare import compare_folders
from copem_replay.results.folder import list_belongings
from copem_replay.results.read import open_results
from tests.helpers.compare_folders import BRAKING, MEASURE, Row, ghosts, row, seen, write_folder

ROWS = [row("ideal", 1.0, 30.0), row("late", 2.0, 20.0)]
VERDICTS = [r | {"conflict": True, "braking_pass": True} for r in ROWS]


def problems(*folders: Path, **options: Any) -> list[str]:
    with pytest.raises(InputError) as caught:
        compare_folders(folders, **({"baseline": "first:ideal"} | options))
    assert all("\n" not in problem for problem in caught.value.problems)
    return list(caught.value.problems)


def two(tmp_path: Path, first: dict[str, Any], second: dict[str, Any]) -> tuple[Path, Path]:
    """Two folders of the same rows, what is said of them different."""
    rows = VERDICTS if first.get("braking") or second.get("braking") else ROWS
    return write_folder(tmp_path / "first", rows, **first), write_folder(tmp_path / "second", rows, **second)


SIGHT = {"onset": {"kind": "line_of_sight_any", "visible_share": 0.1}}
PERCEIVED = BRAKING | {"brakes_for": "conflict"}
DIFFERENCES = [
    ({"seed": 1}, {"seed": 2}, "seed: expected 1 as in {first}, found 2"),
    ({}, {"max_gap_s": 1.0}, "max_gap_s: expected 0.5 as in {first}, found 1.0"),
    (
        {},
        {"measure": {"confirm": {"hits": 2, "of": 3}}},
        'measure.confirm: expected {{"hits": 1, "of": 1}} as in {first}, found {{"hits": 2, "of": 3}}',
    ),
    ({}, {"measure": {"count_earlier": True}}, "measure.count_earlier: expected false as in {first}, found true"),
    (
        {},
        {"measure": {"began": ["crossed"]}},
        'measure.began: expected ["crossed", "appeared"] as in {first}, found ["crossed"]',
    ),
    ({}, {"measure": {"distance_to": "mast"}}, 'measure.distance_to: expected "ego" as in {first}, found "mast"'),
    (
        {"measure": SIGHT},
        {"measure": SIGHT, "visibility": "flat"},
        'visibility: expected "surface" as in {first}, found "flat"',
    ),
    (
        {},
        {"logs": {"a": "other content"}},
        "expected the logs of {first}, found a missing and a of another truth",
    ),
    (
        {"logs": {"a": "x", "b": "y"}},
        {"logs": {"a": "x"}},
        "expected the logs of {first}, found b missing",
    ),
]


@pytest.mark.parametrize(("first", "second", "expected"), DIFFERENCES)
def test_results_of_something_else_are_refused(tmp_path, first, second, expected):
    folders = two(tmp_path, first, second)
    assert problems(*folders) == [f"{folders[1]}: {expected.format(first=folders[0])}"]


@pytest.mark.parametrize("key", ["objects", "onset", "match", "gospa"])
def test_every_parameter_of_the_metrics_is_compared(tmp_path, key):
    folders = two(tmp_path, {}, {"measure": {key: MEASURE[key] | {"more": 1}}})
    (problem,) = problems(*folders)
    assert problem.startswith(f"{folders[1]}: measure.{key}: expected ")


def test_another_driver_is_refused(tmp_path):
    (problem,) = problems(*two(tmp_path, {"braking": BRAKING}, {"braking": BRAKING | {"margin_m": 1.0}}))
    assert "braking: expected {" in problem
    assert '"margin_m": 1.0' in problem


def test_another_conflict_is_refused_where_it_is_braked_for(tmp_path):
    wide = {"conflict": {"horizon_s": 3.0, "margin_m": 2.0}}
    given = ({"braking": brakes} | more for brakes, more in ((PERCEIVED, {}), (PERCEIVED, {"measure": wide})))
    (problem,) = problems(*two(tmp_path, *given))
    assert "measure.conflict: expected null" in problem
    alike = two(tmp_path / "alike", {"braking": BRAKING}, {"braking": BRAKING, "measure": wide})
    assert len(compare_folders(alike, baseline="first:ideal").table)


def test_every_reason_is_said(tmp_path):
    folders = two(tmp_path, {}, {"seed": 2, "max_gap_s": 1.0})
    third = write_folder(tmp_path / "third", ROWS, seed=3)
    assert [problem.partition(": expected")[0] for problem in problems(*folders, third)] == [
        f"{folders[1]}: seed", f"{folders[1]}: max_gap_s", f"{third}: seed",
    ]  # fmt: skip


def test_another_ego_of_other_logs_is_said(tmp_path):
    folders = two(tmp_path, {"ego": "4"}, {"ego": "null", "logs": {"a": "other content"}})
    assert problems(*folders) == [
        f"{folders[1]}: expected the logs of {folders[0]}, found a missing and a of another truth",
        f"{folders[1]}: ego: expected 4 as in {folders[0]}, found null",
    ]


def test_logs_whose_names_are_swapped_are_refused(tmp_path):
    """The drives are the same, but what is drawn depends on the name."""
    folders = two(tmp_path, {"logs": {"a": "x", "b": "y"}}, {"logs": {"a": "y", "b": "x"}})
    assert [problem.partition(", for")[0] for problem in problems(*folders)] == [
        f"{folders[1]}: log {found}: expected the name {expected} as in {folders[0]}"
        for expected, found in (("a", "b"), ("b", "a"))
    ]


def test_logs_of_one_truth_are_paired_by_their_names(tmp_path):
    """Two recordings of a drive, of which one folder lists them in another order."""
    folders = two(tmp_path, {"logs": {"a": "x", "b": "x"}}, {"logs": {"b": "x", "a": "x"}})
    assert len(compare_folders(folders, baseline="first:ideal").table)


@pytest.mark.parametrize("column", ["onset_s", "ended_s"])
def test_another_look_at_the_same_object_is_refused(tmp_path, column):
    first = write_folder(tmp_path / "first", ROWS)
    second = write_folder(tmp_path / "second", [r | {column: 0.5} for r in ROWS])
    (problem,) = problems(first, second)
    assert problem.startswith(
        f"{second}: log a: object 7: expected {column} {ROWS[0][column]:g} as in {first}, found 0.5"
    )


def test_what_does_not_matter_may_differ(tmp_path):
    others = {"visibility": "flat", "measure": {"exact": True, "conflict": {"horizon_s": 3.0, "margin_m": 0.5}}}
    assert len(compare_folders(two(tmp_path, {}, others), baseline="first:ideal").table) == 15


def test_keys_that_an_older_version_did_not_have_stand_for_their_defaults(tmp_path):
    folders = two(tmp_path, {}, {})
    said = json.loads((folders[1] / "provenance.json").read_text())
    for key in ("match", "gospa", "accuracy"):
        del said["measure"][key]
    (folders[1] / "provenance.json").write_text(json.dumps(said))
    assert len(compare_folders(folders, baseline="first:ideal").table)


# ------------------------------------------------------------------------------------------- damaged folders


def test_no_results_folder(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    found = problems(tmp_path / "nowhere", tmp_path / "file", tmp_path / "empty")
    wanted = "expected a results folder, found"
    assert found == [
        f"{tmp_path}/nowhere: {wanted} no such folder; `copem-replay run` writes one",
        f"{tmp_path}/file: {wanted} a file; `copem-replay run` writes one",
        f"{tmp_path}/empty: {wanted} no provenance.json in it; `copem-replay run` writes one",
    ]


@pytest.mark.parametrize("name", ["provenance.json", "experiment.yaml", "detections.parquet"])
def test_a_file_that_is_not_there(tmp_path, name):
    folder = write_folder(tmp_path / "first", ROWS)
    (folder / name).unlink()
    (problem,) = problems(folder)
    assert f"found no {name} in it" in problem


FILES = ["accuracy.parquet", "detections.parquet", "instants.parquet", "lists.parquet", "thresholds.parquet"]


@pytest.mark.parametrize("name", ["provenance.json", "experiment.yaml", *FILES])
@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000])
def test_a_file_that_cannot_be_read(tmp_path, name, content):
    folder = write_folder(tmp_path / "first", ROWS)
    (folder / name).write_bytes(content)
    (problem,) = problems(folder)
    assert problem.startswith(f"{folder / name}: expected ")
    assert "found damage" in problem


@pytest.mark.parametrize("key", ["format", "logs", "measure", "window_s", "run_shown"])
@pytest.mark.parametrize("deep", [200, 900, 100_000])
def test_provenance_with_values_within_values(tmp_path, key, deep):
    """Also as deep as Python can read and not write: `run --overwrite` takes the folder for nobody's results."""
    folder = write_folder(tmp_path / "first", ROWS)
    said = json.loads((folder / "provenance.json").read_text())
    text = json.dumps(said | {key: "HERE"}).replace('"HERE"', "[" * deep + "]" * deep)
    (folder / "provenance.json").write_text(text)
    (problem,) = problems(folder)
    assert problem.startswith(f"{folder}/provenance.json: expected the provenance of results, found damage: ")
    assert "values within values" in problem
    assert list_belongings(folder) is None


@pytest.mark.parametrize("metadata", [b"[" * 100_000, b"{", b'{"columns": 7}'], ids=["deep", "cut", "else"])
def test_what_a_table_says_to_pandas_is_not_read(tmp_path, metadata):
    """A stranger's file may hold any text there."""
    first, second = write_folder(tmp_path / "first", ROWS), write_folder(tmp_path / "second", ROWS)
    for path in first.glob("*.parquet"):
        table = parquet.read_table(path)
        parquet.write_table(table.replace_schema_metadata({b"pandas": metadata}), path)
    (mine,), (theirs,) = open_results(first).each(), open_results(second).each()
    assert mine.equals(theirs)


@pytest.mark.parametrize("key", ["seed", "runs", "logs", "measure"])
def test_provenance_that_does_not_say_enough(tmp_path, key):
    folder = write_folder(tmp_path / "first", ROWS)
    said = json.loads((folder / "provenance.json").read_text())
    del said[key]
    (folder / "provenance.json").write_text(json.dumps(said))
    (problem,) = problems(folder)
    assert f"no '{key}'" in problem


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("notes", 3),
        ("notes", [None]),
        ("logs_skipped", ["log"]),
        ("logs_skipped", [{"log": "a"}]),
        ("logs_skipped", [{"log": "a", "reason": []}]),
        ("seed", math.inf),
        ("runs", math.inf),
        ("measure", {"horizon_used_s": 2.0, "gospa": "power"}),
        ("measure", {"horizon_used_s": 2.0, "gospa": {"power": None}}),
        ("measure", {"horizon_used_s": 2.0, "began": 255}),
        ("runs", 0),
        ("runs", 2**64),
    ],
)
def test_provenance_with_something_else_in_it(tmp_path, key, value):
    folder = write_folder(tmp_path / "first", ROWS)
    said = json.loads((folder / "provenance.json").read_text())
    (folder / "provenance.json").write_text(json.dumps(said | {key: value}))
    (problem,) = problems(folder)
    assert problem.startswith(f"{folder}/provenance.json: expected the provenance of results, found damage: ")


def complete(tmp_path: Path) -> Path:
    """A folder with every table."""
    rows = [seen(name, [1, 1, 1, 1], [1, 1, 1, 1]) for name in ("ideal", "late")]
    return write_folder(tmp_path / "first", rows, lists=[ghosts("ideal", 20), ghosts("late", 20)], steps=[])


def changed(path: Path, name: str, values: Any) -> None:
    table = parquet.read_table(path)
    parquet.write_table(table.set_column(table.column_names.index(name), name, values), path)


def test_a_column_that_no_comparison_reads_and_that_is_there_twice(tmp_path):
    path = complete(tmp_path) / "detections.parquet"
    table = parquet.read_table(path)
    column = pa.nulls(len(table), pa.float64())
    parquet.write_table(table.append_column("bias_east_m", column).append_column("bias_east_m", column), path)
    (problem,) = problems(path.parent)
    assert problem.startswith(f"{path}: expected the column bias_east_m, found 2; ")


@pytest.mark.parametrize("name", FILES)
def test_a_column_that_is_missing_or_of_another_kind(tmp_path, name):
    folder = complete(tmp_path)
    assert len(compare_folders([folder]).table) == 9
    table = parquet.read_table(folder / name)
    last = {"detections.parquet": "ended_s", "lists.parquet": "ghosts_at"}.get(name, table.column_names[-1])
    changed(folder / name, last, pa.array(["text"] * len(table), pa.string()))
    (problem,) = problems(folder)
    assert problem.startswith(f"{folder / name}: column {last}: expected ")
    parquet.write_table(table.drop_columns([last]), folder / name)
    assert problems(folder)[0].startswith(f"{folder / name}: expected the column {last}, found none")
    twice = table.rename_columns([last if k == 0 else other for k, other in enumerate(table.column_names)])
    parquet.write_table(twice, folder / name)
    assert problems(folder)[0].startswith(f"{folder / name}: expected the column ")
    parquet.write_table(table.drop_columns(["configuration"]), folder / name)
    assert problems(folder)[0].startswith(f"{folder / name}: expected the column configuration, found none")


def rows_twice(folder: Path) -> None:
    table = parquet.read_table(folder / "detections.parquet")
    parquet.write_table(pa.concat_tables([table, table]), folder / "detections.parquet")


def fewer_rows(folder: Path) -> None:
    table = parquet.read_table(folder / "accuracy.parquet")
    parquet.write_table(table.slice(1), folder / "accuracy.parquet")


def other_lengths(folder: Path) -> None:
    changed(folder / "accuracy.parquet", "gospa_held_m2", pa.array([[1.0]] * 2))


def later_frames(folder: Path) -> None:
    changed(folder / "accuracy.parquet", "first_frame", pa.array([1, 1]))


def fewer_frames(folder: Path) -> None:
    for name in ("error_held_m", "age_held_s", "gospa_held_m2"):
        changed(folder / "accuracy.parquet", name, pa.array([[1.0] * 4, [1.0] * 3]))


def other_frames(folder: Path) -> None:
    changed(folder / "instants.parquet", "frame_s", pa.array([[0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0, 3.5]]))


def other_thresholds(folder: Path) -> None:
    changed(folder / "lists.parquet", "ghosts_at", pa.array([[0, 0], [1, 1]]))


def no_onset(folder: Path) -> None:
    changed(folder / "detections.parquet", "onset_s", pa.array([0.0, None]))


def no_object(folder: Path) -> None:
    changed(folder / "detections.parquet", "object_id", pa.array(["7", None]))


def another_log(folder: Path) -> None:
    changed(folder / "detections.parquet", "log", pa.array(["a", "z"]))


def another_configuration(folder: Path) -> None:
    names = pa.array(["ideal", "z"])
    changed(folder / "detections.parquet", "configuration", names)


DAMAGES = {
    rows_twice: "ideal: expected each log, run and object once, found some twice",
    fewer_rows: "expected the rows of detections.parquet, found others",
    other_lengths: "expected error_held_m, age_held_s, gospa_held_m2 of equal length, found others",
    later_frames: "expected frames of instants.parquet, found more",
    fewer_frames: "log a: late: expected the frames of ideal in ",
    other_frames: "expected the frames of ideal in ",
    other_thresholds: "expected the same ascending existence and as many ghosts_at in all rows, found others",
    no_onset: "column onset_s: expected a number in every row, found none in some",
    no_object: "column object_id: expected text in every row, found none in some",
    another_log: "expected the logs of provenance.json, found 'z'",
    another_configuration: "expected the configurations of provenance.json, found 'z'",
}


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_tables_that_do_not_go_together(tmp_path, damage):
    folder = complete(tmp_path)
    damage(folder)
    (problem,) = problems(folder, baseline="ideal")
    assert DAMAGES[damage] in problem


def test_no_rows_at_all(tmp_path):
    folder = complete(tmp_path)
    for name in FILES:
        parquet.write_table(parquet.read_table(folder / name).slice(0, 0), folder / name)
    assert "no measured object has an onset" in problems(folder)[0]


def test_a_folder_given_twice(tmp_path):
    folder = write_folder(tmp_path / "first", ROWS)
    again = tmp_path / "first" / ".." / "first"
    assert problems(folder, again) == [f"{again}: expected each folder once, found it twice ({folder})"]
    assert problems() == ["compare: expected a results folder, found none"]


def test_a_link_to_itself_is_no_folder(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    assert problems(tmp_path / "loop") == [
        f"{tmp_path}/loop: expected a results folder, found no such folder; `copem-replay run` writes one"
    ]


@pytest.mark.parametrize("per_min", [-1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none(tmp_path, per_min):
    (problem,) = problems(write_folder(tmp_path / "first", ROWS), false_positives_per_min=per_min)
    assert problem == f"--false-positives-per-min: expected a number of at least 0, found {per_min:g}"


# ----------------------------------------------------------------------------------------------------- notes


def note_of(text: str, notes: tuple[str, ...]) -> str:
    (found,) = [note for note in notes if text in note]
    return found


def test_the_runs_that_both_have_are_compared(tmp_path):
    def rows(*times: float) -> list[Row]:
        return [row(name, time, 30.0, run=run) for run, time in enumerate(times) for name in ("ideal", "late")]

    first, second = (write_folder(tmp_path / n, rows(*t)) for n, t in (("first", (1, 1, 1)), ("second", (2, 5))))
    comparison = compare_folders([first, second], baseline="first:ideal", configurations=["second:late"])
    table = comparison.table.set_index("metric")
    assert table["n"].tolist() == [2] * 5
    assert table.loc["ttd_rmst_s", "difference"] == (1 + 4) / 2
    assert note_of("numbers of runs", comparison.notes) == (
        f"other numbers of runs ({first} 3, {second} 2): the first 2 are compared"
    )


def test_rows_without_a_partner_are_left_out_and_counted(tmp_path):
    more = [row(name, 5.0, 30.0, object_id="8") for name in ("ideal", "late")]
    first, second = write_folder(tmp_path / "first", ROWS), write_folder(tmp_path / "second", [*ROWS, *more])
    comparison = compare_folders([first, second], baseline="first:ideal", configurations=["second:late"])
    assert comparison.table["n"].tolist() == [1] * 5
    assert note_of("left out", comparison.notes) == "1 row of second:late left out: first:ideal has no such object"


def test_braking_of_one_folder_only_is_left_out(tmp_path):
    first, second = two(tmp_path, {"braking": BRAKING}, {})
    comparison = compare_folders([first, second], baseline="first:ideal")
    by = comparison.table.groupby("configuration")["metric"].agg(set)
    assert {name for name, metrics in by.items() if "pass_share" in metrics} == {"first:late"}
    assert note_of("no braking", comparison.notes).startswith(f"{second}: no braking: pass_share is compared only")


def test_without_accuracy_the_rest_is_compared(tmp_path):
    first = complete(tmp_path)
    second = write_folder(tmp_path / "second", ROWS)
    comparison = compare_folders([first, second], baseline="first:ideal")
    by = comparison.table.groupby("configuration")["metric"].agg(set)
    accuracy = ("position_rmse_held_m", "gospa_held_m", "false_positives_per_min", "ttd_rmst_s_equal_ghosts")
    assert by["first:late"] - by["second:late"] == set(accuracy)
    assert note_of("without accuracy", comparison.notes) == (
        f"{second}: no accuracy.parquet, instants.parquet, lists.parquet, thresholds.parquet (without "
        f"accuracy, or of an older version): not compared: {', '.join(accuracy)}"
    )
