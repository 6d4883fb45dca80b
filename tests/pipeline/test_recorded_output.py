"""A stack's own output as a configuration: times by hand, matches by hand, and `union` of one unit as the oracle."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.core.errors import ExperimentError
from copem_replay.core.object_list import Inputs, ObjectLists, entries_of
from copem_replay.core.yaml import dump_yaml
from copem_replay.experiment.file import make_plain_source
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.fusion.interface import PredictedFusion, RecordedFusion
from copem_replay.io.recording import Recording
from copem_replay.pipeline import prepare as chunking
from copem_replay.pipeline.closed_form import check_closed_form
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import StudyTables, run_experiment
from copem_replay.pipeline.sweep import list_points
from copem_replay.results.compare.compare import compare_folders
from copem_replay.results.read import Results, read_results
from tests.helpers.recordings import SHARED, Obj, Topic, ns, write_recording
from tests.helpers.replays import study_accuracy, study_rows
from tests.io.test_recorded_units import car, list_of

COVARIANCE = [[0.25, 0.0], [0.0, 0.25]]
FASTER = 10.0
"""m/s of the other car, from 30 m on."""


def logged(at_s: float, message: tuple[int, bytes]) -> tuple[int, bytes]:
    return ns(at_s), message[1]


def drive(path: Path, stack: Any, rsu: Any = (), *, speed_mps: float = 0.0, others: Any = ()) -> Path:
    """The truth at 10 Hz, 2 s: the ego, 1, and another car, 2; lists on the topics `stack` and `rsu`."""
    frames = [
        (k / 10, [Obj(id=1, x=0.0), Obj(id=2, x=30.0 + speed_mps * k / 10, vx=speed_mps), *others]) for k in range(21)
    ]
    more = [Topic("stack", "osi3.SensorData", stack), Topic("rsu", "osi3.SensorData", rsu)]
    return write_recording(path, frames, host=1, more=[topic for topic in more if topic.messages])


def plan(path: Path, *, inputs: Any = ("rsu",), output: Any = None, **changes: Any) -> Experiment:
    stack: dict[str, Any] = {"recorded": {"topic": "stack", "covariance_m2": COVARIANCE} | (output or {})}
    if inputs is not None:
        stack["inputs"] = list(inputs)
    units = {"rsu": {"recorded": {"topic": "rsu", "covariance_m2": COVARIANCE, "delay_s": 0.05}}}
    data: dict[str, Any] = {
        "version": 1, "logs": [str(path)], "units": {} if inputs is None else units,
        "configurations": {"stack": stack},
        "measure": {"onset": {"kind": "appears"}, "began": ["log_start", "appeared"], "match": {"gate_m": 1.0}},
    }  # fmt: skip
    return Experiment.model_validate(data | changes)


def replayed(experiment: Experiment) -> tuple[Recording, StudyTables]:
    recordings, refused = read_logs(experiment, [Path(experiment.logs[0])], None)
    assert not refused, refused
    return recordings[0], run_experiment(experiment, recordings)


def row(result: StudyTables, configuration: str = "stack") -> pd.Series:
    return study_rows(result).set_index(["configuration", "object_id"]).loc[(configuration, "2")]


def figures(result: StudyTables, configuration: str = "stack") -> pd.Series:
    return result.summary.set_index("configuration").loc[configuration]


class TestTimes:
    def test_stamp_less_delay_and_log_time(self, tmp_path: Path) -> None:
        """Stamped .5, logged .7, its states .1 s before the stamp; the newest input was captured at .35."""
        rsu = [list_of(t, car(30)) for t in (0.3, 0.4, 0.7001)]
        path = drive(tmp_path / "a.mcap", [logged(0.7, list_of(0.5, car(30)))], rsu)
        _, result = replayed(plan(path, output={"delay_s": 0.1}))
        found = row(result)
        assert [found["detection_s"], found["captured_s"]] == pytest.approx([0.7, 0.4])
        assert pd.isna(found["first_unit"])
        of = figures(result)
        assert of[["output_latency_s", "output_delay_s", "input_age_s"]].tolist() == pytest.approx([0.2, 0.1, 0.35])
        assert of["age_of_information_s"] == pytest.approx(0.3)
        ideal = figures(result, "stack:ideal")
        assert ideal[["output_latency_s", "output_delay_s", "input_age_s"]].isna().all()
        assert row(result, "stack:ideal")["detection_s"] == pytest.approx(0.3)

    @pytest.mark.parametrize("lacks", ["rsu", None])
    def test_an_input_that_a_log_lacks(self, tmp_path: Path, lacks: str | None) -> None:
        """Of two logs alike the newest input is .35 s old; where one lacks the unit, it goes by the other alone."""
        rsu = [list_of(t, car(30)) for t in (0.3, 0.4, 0.7001)]
        paths = [drive(tmp_path / f"{k}.mcap", [logged(0.7, list_of(0.5, car(30)))], rsu) for k in "ab"]
        second = {"file": str(paths[1])} | ({"units": {lacks: None}} if lacks else {})
        (tmp_path / "e.yaml").write_text(dump_yaml(plan(paths[0], logs=[str(paths[0]), second]).as_written()))
        result = cr.run(tmp_path / "e.yaml", jobs=1)
        of = result.summary.set_index("configuration")
        assert of["input_age_s"]["stack"] == pytest.approx(0.35)
        assert of["output_latency_s"]["stack"] == pytest.approx(0.2)
        assert of["n"].to_dict() == {"stack": 2, "stack:ideal": 1 if lacks else 2}
        said = "configuration stack:ideal: none of its units in 1 of 2 logs (b), and left out there"
        assert (said in result.notes) == (lacks is not None)

    def test_what_the_messages_say_goes_before(self, tmp_path: Path) -> None:
        """Of .3, available at .5 by its own words, whatever the log time and `delay_s`."""
        path = drive(tmp_path / "a.mcap", [logged(0.9, list_of(0.5, car(30), captured_s=0.3))])
        _, result = replayed(plan(path, inputs=None, output={"delay_s": 0.1}))
        assert row(result)[["detection_s", "captured_s"]].tolist() == pytest.approx([0.5, 0.3])
        of = figures(result)
        assert of[["output_latency_s", "output_delay_s"]].tolist() == pytest.approx([0.2, 0.0])
        assert pd.isna(of["input_age_s"])

    def test_another_clock(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", [logged(1000.0 + t, list_of(t, car(30))) for t in (0.5, 0.6)])
        recording, result = replayed(plan(path, inputs=None))
        assert any("logged 1000 s from its stamps, by another clock" in note for note in recording.notes)
        assert row(result)["detection_s"] == pytest.approx(0.5)
        assert pd.isna(figures(result)["output_latency_s"])

    def test_logged_before_its_stamp(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", [logged(0.4, list_of(0.5, car(30))), logged(0.7, list_of(0.6, car(30)))])
        recording, result = replayed(plan(path, inputs=None))
        assert any("1 list was logged before its stamp; taken as available then" in note for note in recording.notes)
        assert row(result)["detection_s"] == pytest.approx(0.5)
        assert figures(result)["output_latency_s"] == pytest.approx(0.05)


class TestWhatAnEntryTellsOf:
    """The car drives 10 m/s and the list takes .4 s, so 4 m lie between its state and the present; the gate is 1 m."""

    @pytest.mark.parametrize(
        ("tells_of", "x_m", "known"),
        [("stamp", 35.0, True), ("stamp", 39.0, False), ("available", 39.0, True), ("available", 35.0, False)],
    )
    def test_of_its_state_or_of_now(self, tmp_path: Path, tells_of: str, x_m: float, known: bool) -> None:
        path = drive(tmp_path / "a.mcap", [logged(0.9, list_of(0.6, car(x_m)))], speed_mps=FASTER)
        _, result = replayed(plan(path, inputs=None, output={"delay_s": 0.1, "tells_of": tells_of}))
        assert row(result)["detected"] == known
        if known:
            assert row(result)["position_rmse_m"] == pytest.approx(4.0 if tells_of == "stamp" else 0.0)
            assert row(result)["position_rmse_captured_m"] == pytest.approx(0.0)

    @pytest.mark.parametrize(
        ("tells_of", "late_s", "said"),
        [
            ("available", 0.0, None),
            ("available", 0.17, "by `tells_of` its states are of when it is available, a delay of 0, but its entries"),
            ("stamp", 0.0, "delay_s is 0, but its entries fit the truth at -0.17"),
            ("stamp", 0.17, None),
        ],
    )
    def test_what_predicts_is_not_late(self, tmp_path: Path, tells_of: str, late_s: float, said: str | None) -> None:
        """States of when a list is available, .17 s after its stamp, or `late_s` before then, of a car that brakes."""

        def at(t: float) -> tuple[float, float]:
            return 30 + 12 * t + 4 * np.sin(t), 12 + 4 * np.cos(t)

        frames = [(k / 10, [Obj(id=1), Obj(id=2, x=at(k / 10)[0], vx=at(k / 10)[1])]) for k in range(200)]
        lists = []
        for t in np.arange(0.3, 19.0, 0.1).tolist():
            x_m, speed_mps = at(t + 0.17 - late_s)
            lists.append(logged(t + 0.17, list_of(t, car(x_m, vx=speed_mps))))
        stack = Topic("stack", "osi3.SensorData", lists)
        path = write_recording(tmp_path / "a.mcap", frames, host=1, more=[stack])
        recording, _ = replayed(plan(path, inputs=None, output={"tells_of": tells_of}))
        notes = [note for note in recording.notes if "but its entries" in note]
        assert len(notes) == (said is not None)
        assert all(note.startswith(f"configuration stack: {said}") for note in notes)


class TestMeasured:
    def test_a_sweep_leaves_it_out_and_says_so(self, tmp_path: Path) -> None:
        lists = [list_of(0.5, car(30))]
        units = {"alone": {"units": ["rsu"], "latency_s": 0.1}}
        experiment = plan(drive(tmp_path / "a.mcap", lists, lists), sweep={"latency_s": [0, 0.2]})
        data = experiment.as_written()
        experiment = Experiment.model_validate(data | {"configurations": data["configurations"] | units})
        _, result = replayed(experiment)
        assert result.sweep is not None
        assert set(result.sweep["configuration"]) == {"alone"}
        assert "sweep: leaves stack out, for the output of a stack is as it was recorded" in result.notes

    def test_as_union_of_the_same_lists(self, tmp_path: Path) -> None:
        """Late by nothing, the union of one unit hands its lists on, too: every figure and row alike."""
        lists = [list_of(t, car(30.2, existence=0.6), car(50, existence=0.7)) for t in (0.3, 0.5, 0.9)]
        path = drive(tmp_path / "a.mcap", lists, lists)
        experiment = plan(path, output={"delay_s": 0.05})
        union = {"union": {"units": ["rsu"], "fusion": {"kind": "union"}}}
        data = experiment.as_written()
        experiment = Experiment.model_validate(data | {"configurations": data["configurations"] | union})
        _, result = replayed(experiment)
        same_as_union(result, "stack")
        assert figures(result)["false_positives_per_min"] == pytest.approx(3 / (0.6 / 60))  # from 0.35 to 0.95 s
        assert study_accuracy(result)

    def test_nothing_is_drawn(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", [list_of(0.5, car(30))], [list_of(0.4, car(30))])
        _, result = replayed(plan(path, runs=7))
        assert figures(result)["interval"] == "nothing drawn"
        assert study_rows(result).groupby("configuration")["detection_s"].nunique().tolist() == [1, 1]

    def test_an_id_named_twice_in_a_list_is_no_track(self) -> None:
        entries = entries_of(5)
        entries["track_id"] = [4, 4, 7, 4, -1]
        one = np.array([0])
        two = ObjectLists(np.array([[0, 3, 5]]), entries)
        inputs = Inputs(
            ("s",), np.zeros(2, dtype=int), np.array([0.0, 0.1]), np.array([0.2, 0.3]), two, np.array([0.2, 0.3]),
            np.array([[0], [1]]), np.array([0, 1]), np.array([0, 1, 2]),
        )  # fmt: skip
        assert RecordedFusion().fuse(inputs).entries["track_id"].tolist() == [-1, -1, 7, 4, -1]
        assert PredictedFusion().fuse(inputs).of(int(one[0]), 1)["track_id"].tolist() == [4, -1]
        assert (RecordedFusion.tells_of, PredictedFusion.tells_of, PredictedFusion.resumable) == (
            "capture",
            "now",
            True,
        )

    def test_several_runs_with_lists_of_several_lengths(self) -> None:
        """Run 0 has 2 and 1 entries, run 1 none and 3; two lists at one instant: the one captured last."""
        entries = entries_of(6)
        entries["x_m"] = range(6)
        lists = ObjectLists(np.array([[0, 2, 3], [3, 3, 6]]), entries)
        inputs = Inputs(
            ("s",), np.zeros(2, dtype=int), np.array([0.0, 0.1]), np.array([0.2, 0.2]), lists, np.array([0.2]),
            np.array([[1]]), np.array([1, 0]), np.array([0, 2]),
        )  # fmt: skip
        found = RecordedFusion().fuse(inputs)
        assert found.start.tolist() == [[0, 1], [1, 4]]
        assert found.entries["x_m"].tolist() == [2, 3, 4, 5]

    def test_in_time_chunks_as_in_one_piece(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        stack = [logged(t + 0.17, list_of(t, car(30 + t), car(50))) for t in np.arange(0.2, 1.8, 0.1)]
        rsu = [list_of(t, car(30)) for t in np.arange(0.25, 1.8, 0.1)]
        experiment = plan(drive(tmp_path / "a.mcap", stack, rsu), output={"delay_s": 0.1})
        _, whole = replayed(experiment)
        monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
        monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 10)
        recording, pieces = replayed(experiment)
        assert len(prepare_log(recording, experiment).chunks) > 3
        pd.testing.assert_frame_equal(study_rows(whole), study_rows(pieces))
        pd.testing.assert_frame_equal(whole.summary, pieces.summary)


def same_as_union(result: StudyTables, name: str) -> None:
    """Rows and figures of a recorded output and of the union of the unit with the same lists."""
    rows = [
        study_rows(result)[study_rows(result)["configuration"] == one].drop(
            columns=["configuration", "first_unit", "identity_switches"]
        )
        for one in (name, "union")
    ]
    pd.testing.assert_frame_equal(*(part.reset_index(drop=True) for part in rows), rtol=1e-9)
    columns = [column for column in result.summary if not column.startswith(("output", "input", "identity"))]
    mine, union = (figures(result, one)[columns[1:]] for one in (name, "union"))
    pd.testing.assert_series_equal(mine, union, check_names=False, rtol=1e-9)


@pytest.mark.parametrize("trial", ["msight_trial3", "msight_trial5", "msight_trial14"])
def test_the_list_of_a_real_roadside_unit(trial: str) -> None:
    """Taken for the output of a stack: its regret in detection is none, it is all ideal fusion has."""
    path = SHARED / f"{trial}.mcap"
    if not path.exists():
        pytest.skip("shared/data with recordings is not beside the project")
    recorded = {"topic": "mcity.RSU.SensorData", "delay_s": 0.13, "covariance_m2": [[0.1, 0], [0, 0.1]]}
    experiment = Experiment.model_validate({
        "version": 1, "logs": [str(path)], "ego": "none",
        "units": {"rsu": {"recorded": recorded, "at": [0, 0], "height_m": 5}},
        "configurations": {
            "stack": {"recorded": recorded, "inputs": ["rsu"]}, "union": {"units": ["rsu"], "fusion": {"kind": "union"}}
        },
        "measure": {"onset": {"kind": "appears"}, "began": ["log_start", "appeared"], "distance_to": "rsu"},
    })  # fmt: skip
    _, result = replayed(experiment)
    same_as_union(result, "stack")
    of = figures(result)
    assert of[["output_latency_s", "output_delay_s", "input_age_s"]].tolist() == pytest.approx([0, 0.13, 0.13])
    times = study_rows(result).pivot(index="object_id", columns="configuration", values="detection_s")
    np.testing.assert_allclose(times["stack"], times["stack:ideal"])


class TestRegret:
    def test_ideal_fusion_of_the_inputs_is_beside_it(self, tmp_path: Path) -> None:
        """The stack knows the car .3 s after ideal fusion of its input does; both stay to the end."""
        path = drive(tmp_path / "a.mcap", [list_of(0.7, car(30))], [list_of(0.4, car(30))])
        experiment = plan(path)
        _, result = replayed(experiment)
        assert any("its regret is the difference to stack:ideal" in note for note in result.notes)
        Results(study=result, exporters=lambda _: ()).save(tmp_path / "out")
        comparison = compare_folders([tmp_path / "out"])
        assert (comparison.baseline, comparison.configurations) == ("stack:ideal", ("stack",))
        found = comparison.overall.set_index("metric")["difference"]
        assert found["ttd_rmst_s"] == pytest.approx(0.3)
        again = read_results(tmp_path / "out").experiment
        assert (again.configurations, again.as_written()["configurations"]) == (
            experiment.configurations, experiment.as_written()["configurations"],
        )  # fmt: skip

    def test_one_that_is_there_already_serves(self, tmp_path: Path) -> None:
        stack = {"recorded": {"topic": "stack"}, "inputs": ["rsu"]}
        mine = {"best": {"units": ["rsu"]}, "late": {"units": ["rsu"], "latency_s": 0.1}, "stack": stack}
        assert list(plan(tmp_path, configurations=mine).configurations) == ["best", "late", "stack"]
        del mine["best"]
        assert list(plan(tmp_path, configurations=mine).configurations) == ["late", "stack", "stack:ideal"]
        taken = mine | {"stack:ideal": {"units": "truth"}}
        with pytest.raises(ValueError, match="stack:ideal: expected ideal fusion of the inputs of stack"):
            plan(tmp_path, configurations=taken)

    def test_without_inputs_there_is_none(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", [list_of(0.7, car(30))])
        configurations = {
            "GT": {"units": "truth"},
            "stack": plan(path, inputs=None).as_written()["configurations"]["stack"],
        }
        experiment = plan(path, inputs=None, configurations=configurations)
        _, result = replayed(experiment)
        assert list(experiment.configurations) == ["GT", "stack"]
        said = "configuration stack: no regret: it has no `inputs`, so the ideal fusion of its inputs is not known"
        assert said in result.notes
        Results(study=result, exporters=lambda _: ()).save(tmp_path / "out")
        chosen = compare_folders([tmp_path / "out"])
        assert (chosen.baseline, chosen.baseline_why) == ("stack", "the first that is not the truth")
        notes = compare_folders([tmp_path / "out"], baseline="GT").notes
        assert "stack: no regret, for it has no `inputs`: only a difference to GT" in notes


class TestRefused:
    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            ({"units": ["rsu"]}, "recorded: nothing is made of it, so it goes without units"),
            ({"fusion": {"kind": "gnn"}, "latency_s": 1.0}, "so it goes without fusion, latency_s"),
            ({"inputs": ["rus"]}, "configurations: stack: inputs[0]: no unit is named 'rus'; did you mean rsu?"),
            ({"inputs": ["rsu", "rsu"]}, "inputs[1]: unit 'rsu' named twice"),
            ({"inputs": ["camera"]}, "inputs[0]: unit 'camera' has a PEM; the inputs of a stack are `recorded` units"),
            ({"inputs": []}, "expected at least 1 in the list, found []"),
            ({"recorded": {"topic": "stack", "tells_of": "now"}}, "expected 'stamp' or 'available', found 'now'"),
            ({"recorded": None, "units": ["rsu"]}, "inputs: what a `recorded` output was made of"),
        ],
    )
    def test_in_one_line(self, changes: Any, said: str) -> None:
        units = {"rsu": {"recorded": {"topic": "rsu"}}, "camera": {"on": "ego", "pem": "p"}}
        stack = {"recorded": {"topic": "stack"}, "inputs": ["rsu"]} | changes
        data = {"version": 1, "logs": [], "units": units, "pems": {"p": [{"detection": {"kind": "visible_share"}}]},
                "configurations": {"stack": {k: v for k, v in stack.items() if v is not None}}}  # fmt: skip
        _, found = find_problems(make_plain_source({**data, "logs": ["x"]}))
        assert any(said in line.replace("configurations.stack", "configurations: stack").replace("stack.", "stack: ")
                   for line in found), found  # fmt: skip

    def test_no_such_topic(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", [list_of(0.7, car(30))])
        _, (refused,) = read_logs(plan(path, inputs=None, output={"topic": "stock"}), [path], None)
        assert refused.key == ("configurations", "stack", "recorded")
        assert "no topic 'stock'" in refused.reason

    def test_a_unit_of_that_name(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", [list_of(0.7, car(30))])
        unit = {"stack (recorded)": {"recorded": {"topic": "stack", "covariance_m2": COVARIANCE}}}
        with pytest.raises(ExperimentError, match="is what the recorded output of stack is called"):
            replayed(plan(path, inputs=None, units=unit))

    def test_exact(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", [list_of(0.7, car(30))])
        experiment = plan(
            path, inputs=None, measure={"onset": {"kind": "appears"}, "began": ["log_start", "appeared"], "exact": True}
        )
        recordings, _ = read_logs(experiment, [path], None)
        with pytest.raises(ExperimentError, match="it is recorded, and nothing says how probable its lists were"):
            check_closed_form([prepare_log(recordings[0], experiment)], experiment)
        _, found = find_problems(make_plain_source(experiment.as_written()))
        assert any("a recorded output has no exact times" in line for line in found)


def test_sweeps_leave_it_as_it_is(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", [list_of(0.7, car(30))], [list_of(0.4, car(30))])
    late = {"late": {"units": ["rsu"], "latency_s": 0.1}}
    stack = plan(path).as_written()["configurations"]
    experiment = plan(path, configurations=stack | late, sweep={"latency_s": [0.0, 0.2]})
    assert [list(point.experiment.configurations) for point in list_points(experiment)] == [["late"], ["late"]]
    _, result = replayed(experiment)
    assert result.sweep is not None
    assert set(result.sweep["configuration"]) == {"late"}


def test_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table, the recording that Rerun shows, `compare` with one, and the report have it like any other."""

    def said(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["copem-replay", *map(str, arguments)])
        assert cli._run_to_exit_code() == 0
        return capsys.readouterr().out

    stack = [logged(t + 0.1, list_of(t, car(30))) for t in np.arange(0.4, 1.8, 0.1)]
    path = drive(tmp_path / "a.mcap", stack, [list_of(t, car(30)) for t in np.arange(0.3, 1.8, 0.1)])
    (tmp_path / "e.yaml").write_text(dump_yaml(plan(path).as_written()))
    out = tmp_path / "out"
    said("check", tmp_path / "e.yaml")
    assert "output_latency_s  output_delay_s  input_age_s" in said(
        "run", tmp_path / "e.yaml", "--out", out, "--explain"
    )
    assert "differences to stack:ideal" in said("compare", out, "--explain", "--rrd", tmp_path / "x.rrd")
    said("report", out)
    page = (out / "report.html").read_text()
    assert "recorded on stack, of rsu" in page
    assert "as recorded" in page
    assert {"replay.mcap", "replay.rrd"} <= {file.name for file in out.iterdir()}
