"""Settings of single logs: what they replace, which configurations they leave out, what they may not say.

The oracle: a study of several logs gives for each what an experiment gives that is written for this log alone.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from pandas.testing import assert_frame_equal
from typer.testing import CliRunner

import copem_replay as cr
from copem_replay.cli.main import app
from copem_replay.experiment.drive import resolve_for_log, settings_notes
from copem_replay.experiment.file import parse_experiment
from tests.experiment.test_validate import against_logs, without_logs
from tests.helpers.experiments import changed, drive, source_of


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("drive", "two", "three"):
        drive(tmp_path / f"{name}.mcap")
    return tmp_path


def experiment(folder: Path, *changes: str) -> cr.Experiment:
    found, problems = parse_experiment(source_of(folder, changed(*changes)))
    assert problems == []
    assert found is not None
    return found


def run(folder: Path, text: str, logs: str) -> pd.DataFrame:
    (folder / "experiment.yaml").write_text(text.replace("logs: [drive.mcap]", f"logs: {logs}"))
    return cr.run(folder / "experiment.yaml", jobs=1).detections


MIXED = (
    "[drive.mcap, {file: two.mcap, name: second, ego: 2, window_s: [0, 2], units: {mast: {at: [3, 4], height_m: 2}}, "
    "measure: {objects: {ids: [1]}, onset: {kind: appears}}, obstacles: "
    "[{polygon_m: [[20, -1], [22, -1], [22, 1]], height_m: 9}]}, {file: three.mcap, units: {mast: null}}]"
)
ALONE = {
    "drive": ("[drive.mcap]", []),
    "second": (
        "[{file: two.mcap, name: second}]",
        [
            "  mast: {at: [3.0, 4.0], height_m: 2.0, pem: onboard}",
            "ego: 2",
            "window_s: [0, 2]",
            "measure: {objects: {ids: [1]}, onset: {kind: appears}, began: [log_start]}",
            "obstacles: [{polygon_m: [[20, -1], [22, -1], [22, 1]], height_m: 9}]",
        ],
    ),
    "three": ("[three.mcap]", ["  mast:", "  coPEM: {units: [ego], latency_s: 0.5}"]),
}


@pytest.mark.parametrize("log", ALONE)
def test_each_log_comes_out_as_if_the_experiment_were_written_for_it_alone(folder: Path, log: str) -> None:
    logs, changes = ALONE[log]
    text = changed(*changes).replace("  mast:\n", "")
    together = run(folder, changed(), MIXED)
    alone = run(folder, text, logs)
    assert len(alone)
    assert_frame_equal(together[together["log"] == log].reset_index(drop=True), alone, check_dtype=False)


WINDOWS = ("{file: drive.mcap, name: one, window_s: [0, 2]}", "{file: drive.mcap, name: other, window_s: [0, 2.5]}")


def test_two_windows_of_one_drive_are_two_logs(folder: Path) -> None:
    """Each as alone; results are read again, `--log` asks for both, and a part that is named twice is one log."""
    together = run(folder, changed(), f"[{', '.join(WINDOWS)}]")
    assert together["log"].unique().tolist() == ["one", "other"]
    for name, entry in zip(("one", "other"), WINDOWS, strict=True):
        alone = run(folder, changed(), f"[{entry}]")
        assert len(alone)
        assert_frame_equal(together[together["log"] == name].reset_index(drop=True), alone, check_dtype=False)
    (folder / "experiment.yaml").write_text(changed().replace("[drive.mcap]", f"[{', '.join(WINDOWS)}, {WINDOWS[0]}]"))
    found = CliRunner().invoke(app, ["run", f"{folder / 'experiment.yaml'}", "--out", f"{folder / 'out'}"])
    assert found.exit_code == 0
    assert pd.read_parquet(folder / "out/detections.parquet")["log"].unique().tolist() == ["one", "other"]
    again = cr.run(folder / "out" / "experiment.yaml", jobs=1).detections
    assert_frame_equal(again, together, check_dtype=False)
    words = ["check", f"{folder / 'experiment.yaml'}", "--log", f"{folder / 'drive.mcap'}"]
    assert "logs: one, other" in CliRunner().invoke(app, words).output


def test_windows_of_one_drive_need_names(folder: Path) -> None:
    (folder / "experiment.yaml").write_text(
        changed().replace(
            "[drive.mcap]", "[{file: drive.mcap, window_s: [0, 2]}, {file: drive.mcap, window_s: [2, 4]}]"
        )
    )
    with pytest.raises(cr.InputError, match=r"expected a name of its own, found .* of another log, too"):
        cr.run(folder / "experiment.yaml", jobs=1)


def test_a_configuration_without_any_of_its_units_is_left_out_of_that_log_alone(folder: Path) -> None:
    text = changed("  PEM: {units: [mast]}")
    table = run(folder, text, "[{file: drive.mcap, units: {mast: null}}, two.mcap]")
    rows = table.groupby(["log", "configuration"]).size().to_dict()
    assert rows.keys() == {(log, name) for log in ("drive", "two") for name in ("GT", "PEM", "coPEM")} - {
        ("drive", "PEM")
    }
    result = cr.run(folder / "experiment.yaml", jobs=1)
    assert result.summary.set_index("configuration")["n"].to_dict() == {"GT": 8, "PEM": 4, "coPEM": 8}
    assert [note for note in result.notes if "configuration" in note] == [
        "configuration PEM: none of its units in 1 of 2 logs (drive), and left out there",
        "configuration coPEM: without unit mast in 1 of 2 logs (drive)",
    ]


def test_results_keep_the_settings_and_come_out_the_same_again(folder: Path) -> None:
    run(folder, changed(), MIXED)
    cr.run(folder / "experiment.yaml", jobs=1).save(folder / "one")
    cr.run(folder / "one" / "experiment.yaml", jobs=2).save(folder / "two_")
    one, two = (cr.load_results(folder / name) for name in ("one", "two_"))
    assert_frame_equal(one.detections, two.detections)
    assert [log.name for log in one.provenance.logs] == ["drive", "second", "three"]
    assert [one.log_place(log).resolve().name for log in ("drive", "second")] == ["drive.mcap", "two.mcap"]


def test_log_keeps_the_settings_of_a_recording_that_the_experiment_names(folder: Path) -> None:
    source = folder / "experiment.yaml"
    source.write_text(changed("logs: [{file: drive.mcap, ego: 2, units: {mast: null}}]"))
    result = CliRunner().invoke(app, ["check", str(source), "--log", str(folder / "drive.mcap")], standalone_mode=False)
    assert "configuration coPEM: without unit mast in 1 of 1 log (drive)" in result.output
    (study,) = cr.read_recordings(cr.load_experiment(source))
    assert study.scene.object_ids[study.scene.ego_ix] == "2"


def test_an_option_goes_before_the_settings(folder: Path) -> None:
    source = folder / "experiment.yaml"
    source.write_text(changed("logs: [{file: drive.mcap, ego: 99, window_s: [90, 99]}]"))
    args = ["check", str(source), "--ego", "2", "--from", "0", "--to", "1"]
    assert CliRunner().invoke(app, args, standalone_mode=False).return_value == 0


def test_a_key_takes_the_place_of_the_one_it_excludes(folder: Path) -> None:
    logs = "logs: [{file: drive.mcap, name: a, units: {ego: {at: [0, 1]}, mast: {on: 2}}}]"
    alone = resolve_for_log(experiment(folder, logs), "a")
    ego, mast = alone.units["ego"], alone.units["mast"]
    assert (ego.on, ego.at, mast.on, mast.at) == (None, (0.0, 1.0), "2", None)
    assert resolve_for_log(alone, "a") is alone


def test_latencies_of_absent_units_go_with_them(folder: Path) -> None:
    logs = "logs: [{file: drive.mcap, name: a, units: {mast: null}}, two.mcap]"
    late = "  coPEM: {units: [ego, mast], latency_s: {mast: 0.3, default: 0.1}}"
    wanted = experiment(folder, logs, late)
    alone = resolve_for_log(wanted, "a").configurations["coPEM"]
    assert (alone.units, alone.latency_s) == (("ego",), {"default": 0.1})
    assert resolve_for_log(wanted, "two") is wanted
    assert list(settings_notes(wanted)) == ["configuration coPEM: without unit mast in 1 of 2 logs (a)"]


@pytest.mark.parametrize(
    ("logs", "expected"),
    [
        (
            "[{file: drive.mcap, units: {mst: {at: [1, 2]}}}]",
            "2: logs[0].units.mst: no unit is named 'mst'; did you mean mast?",
        ),
        (
            "[{file: drive.mcap, units: {mast: {pem: x}}}]",
            "2: logs[0].units.mast.pem: no PEM is named 'x'; there are onboard",
        ),
        (
            "[{file: drive.mcap, units: {mast: {hight_m: 1}}}]",
            "2: logs[0].units.mast.hight_m: unknown key; did you mean height_m?",
        ),
        (
            "[{file: drive.mcap, measure: {objects: {clases: [vru]}}}]",
            "2: logs[0].measure.objects.clases: unknown key; did you mean classes?",
        ),
        (
            "[{file: drive.mcap, measure: {runs: 3}}]",
            "2: logs[0].measure: runs: goes for all logs alike; "
            "a log has its own objects, onset, distance_to, annotated",
        ),
        (
            "[{name: x}]",
            "2: logs[0]: expected one of `file: <recording>` and `together: [<recording>, <recording>]`",
        ),
        ("[{file: nix.mcap, ego: 1}, 'n*x']", "2: logs[1]: no file matches 'n*x'"),
        ("['/**']", "2: logs[0]: expected a folder before `**`, found '/**', which searches all of this machine"),
        (
            "['/**/*.mcap']",
            "2: logs[0]: expected a folder before `**`, found '/**/*.mcap', which searches all of this machine",
        ),
        (
            "[{file: '*.mcap', name: x}]",
            "2: logs[0].name: a name goes with one recording; '*.mcap' matches 3",
        ),
    ],
)
def test_what_is_wrong_with_settings_is_one_line(folder: Path, logs: str, expected: str) -> None:
    assert without_logs(folder, changed(f"logs: {logs}")) == [expected]


def test_what_a_log_lacks_cannot_be_measured_from(folder: Path) -> None:
    logs = "logs: [drive.mcap, {file: two.mcap, units: {mast: null}}]"
    found = without_logs(folder, changed(logs, "measure: {distance_to: mast}"))
    line = (
        "2: logs[1].units.mast: the log lacks unit 'mast', from which distances are measured; give the log its own "
        "`measure: {distance_to: …}`"
    )
    assert found == [line]
    own = logs.replace("null}", "null}, measure: {distance_to: ego}")
    assert without_logs(folder, changed(own, "measure: {distance_to: mast}")) == []


def test_what_is_swept_goes_for_all_logs(folder: Path) -> None:
    logs = "logs: [{file: drive.mcap, units: {mast: {rate_hz: 5}}}]"
    assert without_logs(folder, changed(logs, "sweep: {rate_hz: [1, 2]}")) == [
        "2: logs[0].units.mast.rate_hz: rate_hz is swept, in all logs alike; leave it out here"
    ]


def test_problems_with_a_recording_name_the_key_of_its_settings(folder: Path) -> None:
    cars = "1 (car), 2 (car)"
    logs = "logs: [{file: drive.mcap, ego: 9}, {file: two.mcap, measure: {objects: {ids: [1, 8]}}}]"
    assert against_logs(folder, changed(logs)) == [
        f"2: logs[0].ego: drive.mcap: no moving object '9'; there are {cars}",
        f"2: logs[1].measure.objects.ids[1]: no object '8' in the log; there are {cars}",
    ]
    logs = "logs: [{file: drive.mcap, units: {mast: {on: 9}}}]"
    assert against_logs(folder, changed(logs)) == [
        f"2: logs[0].units.mast.on: drive.mcap: no object '9' in the log; there are {cars}"
    ]


def test_names_are_their_own_and_no_configuration_is_without_any_log(folder: Path) -> None:
    logs = "logs: [{file: drive.mcap, name: two}, two.mcap]"
    assert against_logs(folder, changed(logs)) == [
        "2: logs[0].name: expected a name of its own, found 'two' of another log, too"
    ]
    logs = "logs: [{file: drive.mcap, units: {mast: null}}]"
    assert against_logs(folder, changed(logs, "  PEM: {units: [mast]}")) == [
        "15: configurations.PEM: no log has any of its units"
    ]
