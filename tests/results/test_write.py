"""The results folder, looked at with other libraries; which run is shown."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from pyarrow import parquet

import copem_replay as cr
from copem_replay.api.run import list_exporters
from copem_replay.core.tracks import TimeChunk
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import read_logs
from copem_replay.io.write.message_family import RUN_RECORD
from copem_replay.metrics.columns import COMPARED_FILES, TABLES
from copem_replay.pipeline import replay as blocks_module
from copem_replay.pipeline.one_run import choose_logs, select_shown_runs
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import StudyTables, run_experiment
from copem_replay.pipeline.study_log import StudyLog
from copem_replay.pipeline.tables import PartTables, tabulate_rows
from copem_replay.results import write as result_tables
from copem_replay.results.read import Results
from copem_replay.results.write import Exporter, RunToExport
from tests.helpers import scenes
from tests.helpers.experiments import changed, drive
from tests.helpers.recordings import Obj, write_recording
from tests.helpers.replays import save_run, study_rows
from tests.helpers.scenes import experiment

OF_ACCURACY = {*COMPARED_FILES, "bands.csv", "false_tracks.parquet"}


def plan(**changes: Any) -> Experiment:
    return experiment(ego="1", runs=3, **changes)


@pytest.fixture
def two_logs(tmp_path: Path) -> list[Path]:
    """Two recordings of one name in two folders: a car that comes from 100 m, and one that leaves at 70 m."""
    paths = []
    for folder, until in (("near", 60), ("far", 31)):
        frames = [(k / 10, [Obj(id=1, x=0.0), *([Obj(id=2, x=100.0 - k)] if k < until else [])]) for k in range(61)]
        path = tmp_path / folder / "drive.mcap"
        path.parent.mkdir()
        write_recording(path, frames, host=1)
        paths.append(path)
    return paths


def test_the_folder_of_several_logs(two_logs: list[Path], tmp_path: Path) -> None:
    chosen = plan(show={"logs": ["all"], "run": 1}, configurations={"GT": {"units": "truth"}, "PEM": {"units": "all"}})
    recordings, refused = read_logs(chosen, two_logs, None)
    assert not refused
    folder = save_run(tmp_path / "out", chosen, recordings)
    names = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert names == {
        "experiment.yaml", "provenance.json", "detections.parquet", "tally.parquet", "logs.csv", "read.csv",
        "summary.csv",
        "replay/near/drive.mcap", "replay/near/drive.rrd", "replay/far/drive.mcap", "replay/far/drive.rrd",
        "made.jsonl", *OF_ACCURACY,
    }  # fmt: skip
    table = parquet.read_table(folder / "detections.parquet")
    assert table.column_names == list(TABLES["detections.parquet"].kinds("accuracy"))
    rows = table.to_pylist()
    assert len(rows) == 2 * 2 * 3, "logs × configurations × runs, one measured object each"
    assert [(r["log"], r["configuration"], r["run"]) for r in rows] == [
        (log, name, k) for log in ("near/drive", "far/drive") for name in ("GT", "PEM") for k in range(3)
    ]
    left = next(r for r in rows if r["log"] == "far/drive" and r["configuration"] == "PEM")
    assert left["detected"] is False
    assert left["ended_by"] == "object_left"
    assert (left["matched_lists"], left["duplicates"]) == (0, 0)
    for name in ("detection_s", "captured_s", "time_to_detection_s", "distance_at_detection_m", "first_unit",
                 "position_rmse_m", "position_rmse_captured_m", "bias_east_m", "bias_north_m", "velocity_rmse_mps",
                 "nees", "age_of_information_s", "identity_switches"):  # fmt: skip
        assert left[name] is None, f"{name}: what does not exist is null"
    with (folder / "summary.csv").open(newline="") as file:
        summary = list(csv.DictReader(file))
    assert list(summary[0]) == list(TABLES["summary.csv"].kinds("accuracy"))
    assert [(s["configuration"], s["n"], s["detected_share"]) for s in summary] == [
        ("GT", "6", "1"),
        ("PEM", "6", "0.5"),
    ]
    assert summary[0]["interval"] == "", "two logs: too few"
    provenance = json.loads((folder / "provenance.json").read_text())
    assert [entry["log"] for entry in provenance["logs"]] == ["near/drive", "far/drive"]
    assert any("no interval" in note for note in provenance["notes"])
    assert provenance["run_shown"] == {"near/drive": 1, "far/drive": 1}


def test_without_accuracy_nothing_tells_of_it(two_logs: list[Path], tmp_path: Path) -> None:
    chosen = plan(show=None, measure={"accuracy": False})
    recordings, _ = read_logs(chosen, two_logs, None)
    folder = save_run(tmp_path / "out", chosen, recordings)
    assert {path.name for path in folder.iterdir()} == {
        "experiment.yaml", "provenance.json", "detections.parquet", "tally.parquet", "logs.csv", "read.csv",
        "summary.csv",
    }  # fmt: skip
    assert parquet.read_table(folder / "detections.parquet").column_names == list(TABLES["detections.parquet"].kinds())
    assert list(pd.read_csv(folder / "summary.csv")) == list(TABLES["summary.csv"].kinds())


def test_what_was_left_out_of_each_log_is_a_table(tmp_path: Path) -> None:
    """Two of 61 lists have a car that is nowhere, one a size that is none; the other log is as it should be."""
    for name in ("odd", "sound"):
        cars = [Obj(id=2, x=100.0 - k, vx=-10.0) for k in range(61)]
        if name == "odd":
            cars[3] = cars[4] = Obj(id=2, x=math.nan)
            cars[9] = Obj(id=2, x=91.0, vx=-10.0, length=math.nan)
        frames = [(k / 10, [Obj(id=1, x=0.0), car]) for k, car in enumerate(cars)]
        write_recording(tmp_path / f"{name}.mcap", frames, host=1)
    chosen = plan(show=None, measure={"accuracy": False})
    recordings, _ = read_logs(chosen, [tmp_path / "odd.mcap", tmp_path / "sound.mcap"], None)
    folder = save_run(tmp_path / "out", chosen, recordings)
    rows = pd.read_csv(folder / "read.csv").to_dict("records")
    assert [(row["log"], row["frames"], row["entries"], row["number"], row["changes"]) for row in rows] == [
        ("odd", 61, 120, 2, "yes"), ("odd", 61, 120, 1, "yes"), ("sound", 61, 122, 0, "no"),
    ]  # fmt: skip
    assert [row["what"] for row in rows] == [
        "2 object states without a position, or with one that is no number: skipped",
        "1 object state whose size is none: that of the same object at other times taken",
        "nothing was left out or mended",
    ]


NOISY = [
    {
        "when": {"range_m": [0, 60]},
        "detection": {"kind": "constant", "probability": 0.7},
        "error": {"kind": "gaussian", "covariance_m2": [[2.0, 0.0], [0.0, 1.0]]},
    }
]


ROUNDED = 0.5 / 1024
"""Values list by list are rounded to 1/1024: that far they may be off."""


def test_the_files_of_accuracy_say_the_same_as_rows_and_summary(two_logs: list[Path], tmp_path: Path) -> None:
    """Recomputed from what they hold list by list."""
    fused = {name: {"units": "all", "fusion": {"kind": name}} for name in ("ideal", "union", "tracker")}
    chosen = plan(
        show=None, pems={"p": NOISY}, units={name: {"on": "ego", "pem": "p"} for name in "ab"},
        configurations={"GT": {"units": "truth"}, **fused},
    )  # fmt: skip
    recordings, _ = read_logs(chosen, two_logs, None)
    folder = tmp_path / "out"
    Results(study=run_experiment(chosen, recordings, jobs=2), exporters=list_exporters).save(folder)

    def read(name: str) -> list[dict[str, Any]]:
        return parquet.read_table(folder / f"{name}.parquet").to_pylist()

    rows, by_list, by_run = read("detections"), read("accuracy"), read("lists")
    keys = ["log", "configuration", "run", "object_id"]
    assert [[r[k] for k in keys] for r in by_list] == [[r[k] for k in keys] for r in rows]
    assert [[r[k] for k in keys[:3]] for r in by_run] == [[r[k] for k in keys[:3]] for r in rows]
    available = {(r["log"], r["configuration"]): r["available_s"] for r in read("instants")}
    assert set(available) == {(r["log"], r["configuration"]) for r in rows}

    squares: dict[str, list[float]] = {name: [] for name in chosen.configurations}
    gospa: dict[str, list[float]] = {name: [] for name in chosen.configurations}
    for row, lists in zip(rows, by_list, strict=True):
        times = available[row["log"], row["configuration"]][lists["first_list"] :][: len(lists["error_m"])]
        assert len(lists["error_m"]) == len(lists["gospa_m2"]) == len(times) > 0
        errors = [error for error in lists["error_m"] if error is not None]
        assert row["matched_lists"] == len(errors)
        rmse_m = pytest.approx(np.sqrt(np.mean(np.square(errors))), abs=ROUNDED) if errors else None
        assert row["position_rmse_m"] == rmse_m
        looked = [row["onset_s"] - 1e-6 <= t <= row["ended_s"] + 1e-6 for t in times]
        assert [part is not None for part in lists["gospa_m2"]] == looked
        squares[row["configuration"]] += [error**2 for error in errors]
        gospa[row["configuration"]] += [part for part in lists["gospa_m2"] if part is not None]
        if row["detected"] and row["configuration"] in ("union", "tracker"):
            first = next(t for t, e, on in zip(times, lists["error_m"], looked, strict=True) if on and e is not None)
            assert row["detection_s"] == pytest.approx(first)

    # There is one object: its parts are all there is of GOSPA in a list.
    summary = pd.read_csv(folder / "summary.csv").set_index("configuration")
    for name, row in summary.iterrows():
        assert row["position_rmse_m"] == pytest.approx(np.sqrt(np.mean(squares[str(name)])), abs=ROUNDED)
        assert row["gospa_m"] ** 2 == pytest.approx(np.mean(gospa[str(name)]), abs=ROUNDED)
        mine = [r for r in by_run if r["configuration"] == name]
        minutes = sum(r["minutes"] for r in mine)
        assert row["false_positives_per_min"] == pytest.approx(sum(r["ghosts"] for r in mine) / minutes)
        assert row["duplicates_per_min"] == pytest.approx(sum(r["duplicates"] for r in mine) / minutes)
    assert summary.loc["GT", "gospa_m"] == 0
    assert summary.loc["union", "duplicates_per_min"] > 0
    assert summary.loc["union", "false_positives_per_min"] > 0
    for row in by_run:
        at = row["ghosts_at"]
        assert at == sorted(at, reverse=True)
        assert (row["existence"][0], at[0]) == (0, row["ghosts"])

    steps = pd.read_parquet(folder / "thresholds.parquet")
    for (log, name, number, one), part in steps.groupby(keys, sort=False):
        assert part["existence"].is_monotonic_increasing
        assert part["detection_s"].is_monotonic_increasing
        (row,) = [r for r in rows if [r[k] for k in keys] == [log, name, number, one]]
        assert part["detection_s"].iloc[0] == pytest.approx(row["detection_s"])

    bands = pd.read_csv(folder / "bands.csv")
    for name, part in bands[bands["by"] == "distance_m"].groupby("configuration"):
        pairs = part["pairs"].sum()
        assert pairs == len(squares[str(name)])
        square_m2 = (part["pairs"] * part["position_rmse_m"].fillna(0) ** 2).sum() / pairs
        assert square_m2 == pytest.approx(summary.loc[name, "position_rmse_m"] ** 2, rel=1e-6)
    for (log, name), part in bands[bands["by"] == "time_s"].groupby(["log", "configuration"]):
        mine = [r for r in by_run if (r["log"], r["configuration"]) == (log, name)]
        assert part["ghosts"].sum() == sum(r["ghosts"] for r in mine)


def made_up(rows: pd.DataFrame, plan: Experiment) -> StudyTables:
    """What a study of one log, `scene`, gives if it has these rows; the horizon is 9 s."""
    study = StudyTables(plan, (StudyLog(scenes.oncoming_car(), plan),), horizon_s=9.0)
    for name, of_configuration in rows.groupby("configuration", sort=False):
        study.add(PartTables("scene", str(name), tabulate_rows(of_configuration)))
    return study


@pytest.mark.parametrize(
    ("times", "best", "median", "worst"),
    [
        ([3.0, 1.0, 2.0], 1, 2, 0),
        ([3.0, None, 2.0], 2, 0, 1),  # never detected counts as the horizon
        ([5.0, 2.0, 1.0, 5.0], 2, 1, 0),  # the lower median; of equal runs the first
        ([4.0, 4.0 + 1e-9, 4.0 - 1e-9], 0, 0, 0),  # closer than instants are told apart: equal
        ([4.0], 0, 0, 0),
    ],
)
def test_which_run_is_shown(times: list[float | None], best: int, median: int, worst: int) -> None:
    of = {"log": "scene", "configuration": "PEM", "object_id": "a", "began": "crossed", "onset_s": 0.0, "ended_s": 10.0}
    rows = pd.DataFrame({**of, "run": range(len(times)), "time_to_detection_s": times})
    for which, expected in (("best", best), ("median", median), ("worst", worst), (0, 0)):
        (shown,) = select_shown_runs(made_up(rows, experiment(show={"run": which})), "scene")
        assert (shown.run, shown.stem) == (expected, "replay")
    for nothing in ({"run": None}, None):
        assert select_shown_runs(made_up(rows, experiment(show=nothing)), "scene") == ()
        assert choose_logs(experiment(show=nothing), ["scene"]) == []
    assert choose_logs(experiment(), ["scene"]) == ["scene"]


def test_several_runs_are_shown_each_as_it_was_asked_for() -> None:
    """Sums over two configurations and two objects: 4, 8, 4 and 8 s; the same run may be shown twice."""
    times = [1.0, 1.0, 1.0, 1.0], [2.0, 2.0, 2.0, 2.0], [0.0, 1.0, 1.0, 2.0], [2.0, 2.0, 4.0, 0.0]
    keys = [(name, one) for name in ("GT", "PEM") for one in ("a", "b")]
    rows = [
        {
            "log": "scene",
            "configuration": name,
            "object_id": one,
            "run": k,
            "began": "crossed",
            "onset_s": 0.0,
            "ended_s": 10.0,
            "time_to_detection_s": of_run[n],
        }
        for k, of_run in enumerate(times)
        for n, (name, one) in enumerate(keys)
    ]
    table = pd.DataFrame(rows)
    shown = select_shown_runs(made_up(table, experiment(show={"run": ["median", "worst", 0, "best"]}, runs=4)), "scene")
    over = "of 4 by time to detection summed over 2 configurations and 2 objects, the first of 2 equal"
    assert [(one.run, one.why, one.stem) for one in shown] == [
        (0, f"median {over}", "replay"),
        (1, f"worst {over}", "replay_worst"),
        (0, "", "replay_0"),
        (0, f"best {over}", "replay_best"),
    ]
    # Of a log in which nothing is measured.
    other = select_shown_runs(made_up(table, experiment(show={"run": ["worst", 3]}, runs=4)), "other")
    assert [(one.run, one.why) for one in other] == [
        (0, "first, not worst, as no measured object has an onset"),
        (3, ""),
    ]


def test_several_runs_of_several_logs(two_logs: list[Path], tmp_path: Path) -> None:
    """A file each, in a folder each, that says which run it is and why."""
    from rerun.chunk import RrdReader

    seldom = {"p": [{"detection": {"kind": "constant", "probability": 0.1}}]}
    units = {"units": {"ego": {"on": "ego", "pem": "p"}}, "configurations": {"PEM": {"units": "all"}}}
    chosen = plan(show={"logs": ["all"], "run": ["worst", "best", 1]}, pems=seldom, **units)
    recordings, _ = read_logs(chosen, two_logs, None)
    result = run_experiment(chosen, recordings)
    folder = tmp_path / "out"
    for _ in range(2):  # what is there already goes
        Results(study=result, exporters=list_exporters).save(folder, overwrite=True)
    stems = ["replay", "replay_best", "replay_1"]
    files = {f"{stem}/{log}/drive.{kind}" for stem in stems for log in ("near", "far") for kind in ("mcap", "rrd")}
    assert {p.relative_to(folder).as_posix() for p in folder.rglob("replay*/**/*") if p.is_file()} == files
    said = json.loads((folder / "provenance.json").read_text())
    shown = said["runs_shown"]["near/drive"]
    assert [each["file"] for each in shown] == stems
    assert said["run_shown"]["near/drive"] == shown[0]["run"]
    time_s = study_rows(result)[study_rows(result)["log"] == "near/drive"].set_index("run")["time_to_detection_s"]
    assert len(set(time_s)) > 1, "else it would not matter which is shown"
    assert (time_s[shown[0]["run"]], time_s[shown[1]["run"]], shown[2]["run"]) == (time_s.max(), time_s.min(), 1)
    names = set()
    for each in shown:
        with (folder / each["file"] / "near/drive.mcap").open("rb") as file:
            (record,) = [m for m in make_reader(file).iter_metadata() if m.name == RUN_RECORD]
        assert record.metadata["run"] == str(each["run"])
        assert record.metadata["run_is"] == (each["run_is"] or "")
        name = f"near/drive: run {each['run']}" + (f": {each['run_is']}" if each["run_is"] else "")
        recording = RrdReader(folder / each["file"] / "near/drive.rrd")
        (entry,) = recording.recordings()
        names.add(entry.recording_id)
        properties = [c.to_record_batch() for c in recording.stream() if c.entity_path.startswith("/__properties")]
        told = [batch.column(n).to_pylist()[0] for batch in properties for n in batch.schema.names if "name" in n]
        assert [name] in told
    assert len(names) == 3, "else a viewer would take two of them for one"


def test_blocks_bound_what_is_held_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all that is listed where lists are measured, and with its states; else of the measured, only that it is."""
    things = [scenes.Thing("ego", "car", scenes.standing(0, 0)), scenes.Thing("a", "car", scenes.driving(60, 0, -10)),
              scenes.Thing("b", "pedestrian", scenes.standing(9, 9))]  # fmt: skip
    log = scenes.recording(things, until_s=3.0)
    for accuracy in (False, True):
        measure = {"onset": {"kind": "appears"}, "objects": {"ids": ["a"]}, "accuracy": accuracy}
        many = experiment(runs=100, measure=measure, pems={"sure": NOISY})
        ready = prepare_log(log, many)
        candidates = ready.observe(TimeChunk()) if accuracy else ready.measured
        rows = len(candidates.tracks.frame_ix)
        assert rows == (62 if accuracy else 31)
        whole = run_experiment(many, [log])
        with monkeypatch.context() as patch:
            patch.setattr(blocks_module, "BLOCK_BYTES", 7 * rows * (blocks_module.STATE_BYTES if accuracy else 1))
            cut = blocks_module.cut_blocks(ready, many, jobs=1)
            assert max(map(len, cut)) == 7
            assert np.concatenate(cut).tolist() == list(range(100))
            in_sevens = run_experiment(many, [log])
            patch.setattr(blocks_module, "BLOCK_BYTES", 1)
            assert set(map(len, blocks_module.cut_blocks(ready, many, jobs=1))) == {1}
            for cut_up in (in_sevens, run_experiment(many, [log])):
                assert study_rows(cut_up).equals(study_rows(whole))
                assert cut_up.summary.equals(whole.summary)


def test_what_is_shown_is_written_by_the_exporters_that_are_passed(two_logs: list[Path], tmp_path: Path) -> None:
    def write(path: Path, exported: RunToExport) -> list[str]:
        assert exported.recording.scene.log == exported.manifest["log"]
        path.write_text(f"{exported.shown.run} {sorted(set(exported.table['configuration']))}")
        return ["half as long as it was"]

    chosen = plan(show={"logs": ["all"], "run": 1}, configurations={"GT": {"units": "truth"}})
    recordings, _ = read_logs(chosen, two_logs, None)
    result = run_experiment(chosen, recordings)
    Results(study=result, exporters=lambda _: [Exporter(".txt", write)]).save(tmp_path / "own")
    provenance = json.loads((tmp_path / "own/provenance.json").read_text())
    shown = {path.relative_to(tmp_path / "own").as_posix() for path in (tmp_path / "own").rglob("replay/**/*.*")}
    assert shown == {"replay/near/drive.txt", "replay/far/drive.txt"}
    assert {(tmp_path / "own" / name).read_text() for name in shown} == {"1 ['GT']"}
    assert {"near/drive: half as long as it was", "far/drive: half as long as it was"} <= set(provenance["notes"])
    assert shown <= set(provenance["files"])
    Results(study=result, exporters=lambda _: ()).save(tmp_path / "none")
    assert not (tmp_path / "none" / "replay").exists()


def test_a_table_of_many_rows_is_a_folder_that_reads_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file per log, in the experiment's order; what reads results reads either."""
    monkeypatch.chdir(tmp_path)
    for name in ("b", "a"):
        drive(tmp_path / f"{name}.mcap")
    said = changed("logs: [{file: b.mcap, name: two/b %}, {file: a.mcap, name: a}]")
    (tmp_path / "e.yaml").write_text(said)
    cr.run("e.yaml").save("whole")
    monkeypatch.setattr(result_tables, "MANY_ROWS", 10)
    cr.run("e.yaml").save("many")
    names = ["a.parquet", "two%2Fb %25.parquet"]
    assert sorted(path.name for path in Path("many/detections.parquet").iterdir()) == names
    whole, many = cr.load_results("whole"), cr.load_results("many")
    pd.testing.assert_frame_equal(whole.detections, many.detections)
    in_any_order = pd.read_parquet("many/detections.parquet").sort_values(["log", "configuration", "run"])
    assert len(in_any_order) == len(whole.detections)
    first, second = (cr.compare(folder, baseline="PEM").table for folder in (whole, many))
    pd.testing.assert_frame_equal(first, second)
    listed = json.loads(Path("many/provenance.json").read_text())["files"]
    assert [name for name in listed if name.startswith("detections")] == [f"detections.parquet/{n}" for n in names]
    monkeypatch.setattr(result_tables, "MANY_ROWS", 1000)
    cr.run("e.yaml").save("many", overwrite=True)  # a file in the place of the folder
    assert Path("many/detections.parquet").is_file()
