"""The public API: every name is there, typed and lazy, and what it takes and gives is what its commands do."""

from __future__ import annotations

import ast
import filecmp
import inspect
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

import copem_replay as cr
from copem_replay.api import run as api_run
from copem_replay.cli import main as cli
from copem_replay.report.figures.registry import FIGURES
from copem_replay.viewer import open as opening
from tests.helpers.experiments import TEXT, drive

ROOT = Path(__file__).parents[2]
INIT = ROOT / "copem_replay/__init__.py"
SURE = {"sure": [{"detection": {"kind": "constant", "probability": 1}}]}
HEAVY = {"numba", "pandas", "matplotlib", "numpy", "pydantic", "scipy", "pyarrow", "rerun", "plotly"}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with the small experiment, `e.yaml`, and its recording."""
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(TEXT)
    (tmp_path / "shown.yaml").write_text(TEXT.replace("show: null", "show: {run: 2}"))
    return tmp_path


class TestNames:
    @pytest.mark.extras
    def test_every_name_is_there_and_for_editors_too(self) -> None:
        ifs = (node for node in ast.parse(INIT.read_text()).body if isinstance(node, ast.If))
        (block,) = (node for node in ifs if ast.unparse(node.test) == "TYPE_CHECKING")
        typed = {
            alias.asname or alias.name: (node.module, alias.name)
            for node in block.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        assert set(typed) == set(cr.__all__)
        for name, (module, own) in typed.items():
            found = getattr(cr, name)
            assert found is getattr(__import__(str(module), fromlist=[own]), own), name
        assert set(cr.__all__) <= set(dir(cr))
        assert not [name for name in dir(cr) if name not in cr.__all__ and not name.startswith("__")]

    def test_another_name_is_refused(self) -> None:
        with pytest.raises(AttributeError, match="'copem_replay' has no attribute 'rum'"):
            cr.rum  # type: ignore[attr-defined]  # noqa: B018

    def test_type_checkers_know_them(self, tmp_path: Path) -> None:
        (tmp_path / "page.py").write_text(
            "import copem_replay as cr\nreveal_type(cr.run)\nresult: int = cr.run('')\ncr.rum\n"
        )
        check = [sys.executable, "-m", "mypy", "--config-file", ROOT / "pyproject.toml", tmp_path / "page.py"]
        said = subprocess.run(check, cwd=ROOT, capture_output=True, text=True).stdout
        assert "-> copem_replay.results.read.Results" in said
        assert 'has type "Results", variable has type "int"' in said
        assert 'Module has no attribute "rum"' in said

    @pytest.mark.parametrize("code", ["import copem_replay", "import copem_replay; dir(copem_replay)"])
    def test_importing_it_imports_nothing_heavy(self, code: str) -> None:
        code = f"import sys; {code}; sys.exit(str({HEAVY} & sys.modules.keys() or ''))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.stderr.strip() == ""

    def test_help_imports_nothing_heavy(self) -> None:
        code = (
            "import sys\nfrom copem_replay.cli import main as cli\nsys.argv = ['copem-replay', '--help']\n"
            f"cli._run_to_exit_code()\nsys.exit(str({HEAVY} & sys.modules.keys() or ''))"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.stderr.strip() == ""
        assert "Replay recorded traffic" in done.stdout


class TestLoadExperiment:
    def test_of_a_file_in_another_folder(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (here / "below").mkdir()
        monkeypatch.chdir(here / "below")
        experiment = cr.load_experiment("../e.yaml")
        assert experiment.logs == ("../drive.mcap",)
        (recording,) = cr.read_recordings(experiment)
        assert recording.scene.log == "drive"

    def test_globs_are_resolved(self, here: Path) -> None:
        drive(here / "drive2.mcap")
        plan = {"version": 1, "logs": ["drive*.mcap"], "configurations": {"GT": {"units": "truth"}}}
        assert cr.load_experiment(plan).logs == ("drive.mcap", "drive2.mcap")

    def test_all_problems_at_once(self, here: Path) -> None:
        (here / "bad.yaml").write_text(TEXT.replace("pem:", "pen:", 1) + "runz: 3\n")
        with pytest.raises(cr.ExperimentError) as refused:
            cr.load_experiment(here / "bad.yaml")
        assert len(refused.value.problems) >= 2
        assert all(line.startswith(f"{here}/bad.yaml:") for line in refused.value.problems)

    def test_a_dict_has_no_lines(self) -> None:
        plan = {"version": 1, "configurations": {"A": {"units": ["x"]}}, "runs": 0}
        with pytest.raises(cr.ExperimentError) as refused:
            cr.load_experiment(plan)
        assert refused.value.problems == (
            "experiment: runs: expected at least 1, found 0",
            "experiment: configurations.A.units[0]: no unit is named 'x'; there are none",
        )

    def test_logs_are_optional_in_python_only(self, here: Path) -> None:
        assert cr.Experiment(version=1, configurations={"GT": cr.Configuration(units="truth")}).logs == ()
        text = "\n".join(line for line in TEXT.splitlines() if not line.startswith("logs:"))
        (here / "none.yaml").write_text(text)
        with pytest.raises(cr.ExperimentError, match=r"none.yaml:1: logs: missing"):
            cr.load_experiment(here / "none.yaml")
        assert cr.run(here / "none.yaml", here / "drive.mcap").detections["log"].unique().tolist() == ["drive"]


class TestRun:
    def test_same_folder_as_the_command(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sys, "argv", ["copem-replay", "run", "e.yaml"])
        assert cli._run_to_exit_code() == 0
        done: list[tuple[int, int]] = []
        result = cr.run("e.yaml", jobs=2, progress=lambda *at: done.append(at))
        assert done[-1][0] == done[-1][1] > 0
        assert result.save("out/api") == Path("out/api")
        names = sorted(path.name for path in (here / "out/api").iterdir())
        assert names == sorted(path.name for path in (here / "out/e").iterdir())
        same = [name for name in names if name not in ("replay.rrd", "made.jsonl")]
        _, differ, errors = filecmp.cmpfiles("out/e", "out/api", same, shallow=False)
        assert (differ, errors) == ([], [])

    def test_read_back_under_the_same_names(self, here: Path) -> None:
        result = cr.run("e.yaml")
        result.save("out/e")
        read = cr.load_results("out/e")
        pd.testing.assert_frame_equal(read.detections, result.detections, check_dtype=False)
        assert read.summary["configuration"].tolist() == result.summary["configuration"].tolist()
        assert read.notes == result.notes
        assert (read.exact is None, read.sweep is None) == (result.exact is None, result.sweep is None)
        for name in ("accuracy", "bands"):
            kept, given = getattr(read, name), getattr(result, name)
            assert (kept is None) == (given is None)
            if kept is not None:
                assert kept.shape == given.shape
                assert list(kept.columns) == list(given.columns)
        with pytest.raises(cr.OutputError, match="results are there already"):
            result.save("out/e")
        result.save("out/e", overwrite=True)

    def test_whatever_form_experiment_and_recordings_have(self, here: Path) -> None:
        expected = cr.run("e.yaml").detections
        experiment = cr.load_experiment("e.yaml")
        recordings = cr.read_recordings(experiment)
        plan = experiment.as_written()
        for given in [
            (experiment,),
            (plan,),
            (experiment, recordings),
            (experiment, recordings[0]),
            (plan, "drive.mcap"),
            (here / "e.yaml", [here / "drive.mcap"]),
        ]:
            pd.testing.assert_frame_equal(cr.run(*given).detections, expected)

    def test_two_recordings_of_one_name_are_told_apart(self, here: Path) -> None:
        (here / "a").mkdir()
        drive(here / "a/drive.mcap")
        plan = {"version": 1, "configurations": {"GT": {"units": "truth"}}}
        read = [cr.read_recording(path) for path in ("drive.mcap", "a/drive.mcap")]
        logs = cr.run(plan, read).detections["log"].unique().tolist()
        assert logs == [f"{here.name}/drive", "a/drive"]
        with pytest.raises(cr.InputError, match="expected each once"):
            cr.run(plan, [read[0], read[0]])

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"ego": "none", "measure": {"distance_to": "ego"}}, "ego: expected none as by the experiment, found "),
            ({"ego": "2"}, "ego: expected 2 as by the experiment, found 1; read it with read_recordings(experiment)"),
            ({"window_s": [0, 1]}, "window_s: expected the window [0.0, 1.0] s as by the experiment, found another"),
            ({"read": {"topic": "/other"}}, "read.topic: expected /other as in the experiment, found "),
            ({"units": {"u": {"recorded": {"topic": "t"}}}}, "expected the recorded lists of the unit u, found none"),
            ({"units": {"u": {"on": "99", "pem": "sure"}}, "pems": SURE}, "no object '99' in the log"),
        ],
    )
    def test_a_recording_that_does_not_fit_is_refused(self, here: Path, change: dict[str, Any], said: str) -> None:
        plan = {"version": 1, "configurations": {"GT": {"units": "truth"}}} | change
        with pytest.raises(cr.InputError, match=r"drive\.mcap: ") as refused:
            cr.run(plan, cr.read_recording("drive.mcap"))
        assert said in str(refused.value)

    def test_a_recording_that_is_read_otherwise_by_hand_is_refused(self, here: Path) -> None:
        """What is saved names no such ego, nor such a window: it could not be made again."""
        plan = {"version": 1, "configurations": {"GT": {"units": "truth"}}}
        with pytest.raises(cr.InputError, match="ego: expected 1 as by the experiment, found 2"):
            cr.run(plan, cr.read_recording("drive.mcap", ego="2"))
        with pytest.raises(cr.InputError, match="window_s: expected all of it as by the experiment"):
            cr.run(plan, cr.read_recording("drive.mcap", window_s=(0, 1)))
        part = cr.read_recording("drive.mcap", ego="2", window_s=(0, 1))
        assert len(cr.run(plan | {"ego": "2", "window_s": [0, 1]}, part).summary) == 1

    @pytest.mark.parametrize(
        ("recordings", "said"),
        [
            ("nope.mcap", "nope.mcap: no such file"),
            ("*.bag", "recordings: no file matches '*.bag'"),
            ([], "recordings: expected at least one, found none"),
            (None, "experiment: logs: expected at least one recording, found none"),
        ],
    )
    def test_recordings_that_are_not_there(self, here: Path, recordings: Any, said: str) -> None:
        with pytest.raises(cr.InputError) as refused:
            cr.run({"version": 1, "configurations": {"GT": {"units": "truth"}}}, recordings)
        assert refused.value.problems == (said,)

    def test_a_result_is_a_line(self, here: Path) -> None:
        assert repr(cr.run("e.yaml")) == "Results(3 configurations, 4 runs, 1 log, not saved)"

    def test_jobs(self, here: Path) -> None:
        with pytest.raises(cr.InputError, match="jobs: expected at least 1, found 0"):
            cr.run("e.yaml", jobs=0)


class TestFusedTracks:
    def test_the_same_lists_as_in_the_written_run(self, here: Path) -> None:
        cr.run("shown.yaml").save("out/e")
        (recording,) = cr.read_recordings("e.yaml")
        fused = cr.fused_tracks("e.yaml", recording, run=2)
        for name, each in fused.items():
            found = each.to_dataframe()
            lists = cr.read_lists("out/e/replay.mcap", f"copem/{name}/objects", recording.scene)
            order = lists.by_frame[0]
            ids = np.array(recording.scene.object_ids)[lists.row_object_ix[order]]
            assert len(found) > 0
            arrives_s = lists.arrives_s[0, lists.frame_ix[order]]
            written = zip(arrives_s.round(6), ids, lists.x_m[0, order].round(6), strict=True)
            columns = (found["available_s"].round(6), found["object_id"], found["x_m"].round(6))
            assert sorted(zip(*columns, strict=True)) == sorted(written)
            assert (found["captured_s"] <= found["available_s"] + 1e-9).all()

    def test_exact_states_have_a_covariance_of_0(self, here: Path) -> None:
        fused = cr.fused_tracks("e.yaml", "drive.mcap")["GT"]
        exact = replace(fused.fused, cov_ee_m2=None, cov_en_m2=None, cov_nn_m2=None)
        found = replace(fused, fused=exact).to_dataframe()
        assert len(found) > 0
        assert (found[["cov_ee_m2", "cov_en_m2", "cov_nn_m2"]] == 0).all(axis=None)

    def test_a_run_beyond_the_experiment(self, here: Path) -> None:
        runs = cr.load_experiment("e.yaml").runs
        with pytest.raises(cr.InputError, match=f"run: expected 0 … {runs - 1}, found {runs}"):
            cr.fused_tracks("e.yaml", "drive.mcap", run=runs)


class TestFolders:
    def test_a_result_a_reading_and_a_path_are_the_same(self, here: Path) -> None:
        result = cr.run("e.yaml")
        result.save("out/e")
        baseline = result.summary["configuration"][0]
        tables = [cr.compare(one, baseline=baseline).table for one in (result, cr.load_results("out/e"), "out/e")]
        assert len(tables[0]) > 0
        for table in tables[1:]:
            pd.testing.assert_frame_equal(table, tables[0])
        assert cr.write_report(result, "page.html") == Path("page.html")
        assert cr.write_report(cr.load_results("out/e")) == Path("out/e/report.html")
        assert (here / "page.html").stat().st_size > 0

    def test_view_opens_the_recordings(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        cr.run("shown.yaml").save("out/e")
        called: list[tuple[list[Path], dict[Path, float]]] = []
        monkeypatch.setattr(opening, "open_viewer", lambda files, at_s: called.append((files, at_s)) or 0)
        results, file = cr.load_results("out/e"), here / "out/e/replay.rrd"
        cr.view(results)
        row = results.detections.iloc[0]
        cr.view(results, object_id=str(row["object_id"]), log=str(row["log"]))
        at_s = {file: pytest.approx(max(float(row["onset_s"]) - 0.5, 0.0))}
        (files, opens_s), sought = called
        assert (files, sought) == ([file], ([file], at_s))
        times_s = results.detections["detection_s"].fillna(np.inf)
        assert times_s.min() < opens_s[file] < times_s.max(), "some know it and others do not yet"
        with pytest.raises(cr.InputError, match=r"^out/e: no recording of log nowhere has the measured object '2'$"):
            cr.view("out/e", object_id="2", log="nowhere")
        with pytest.raises(cr.InputError, match=r"^--log: expected --object ID with it, found none$"):
            cr.view("out/e", log="nowhere")

    def test_results_in_memory_are_compared_drawn_and_reported_as_those_read_back(self, here: Path) -> None:
        result = cr.run("e.yaml")
        compared, words, axes = cr.compare(result), cr.write_report(result, "r.html"), cr.plot.single_runs(result).axes
        assert result.folder is None
        folder = cr.run("e.yaml").save("out/e")
        kept = cr.compare(folder)
        pd.testing.assert_frame_equal(compared.table, kept.table)
        assert (compared.baseline, compared.notes) == (kept.baseline, kept.notes)
        read = cr.load_results(folder)
        assert len(axes) == len(cr.plot.single_runs(read).axes)
        for name in ("known", "tally", "bands"):
            pd.testing.assert_frame_equal(
                getattr(result, name), getattr(read, name), check_dtype=False, check_exact=False, rtol=1e-8
            )
        for log in ("drive",):
            rows, expected = result.rows_of(log), read.rows_of(log)
            assert {name: table.column_names for name, table in rows.items()} == {
                name: table.column_names for name, table in expected.items()
            }
            assert all(rows[name].to_pylist() == expected[name].to_pylist() for name in expected)
        assert words.stat().st_size == pytest.approx(cr.write_report(folder, "s.html").stat().st_size, rel=0.02)

    def test_two_results_in_memory_have_names_of_their_own(self, here: Path) -> None:
        one, other = cr.run("e.yaml"), cr.run("e.yaml")
        comparison = cr.compare([one, other], configurations=["PEM"], baseline=f"{one.name}:GT")
        assert comparison.configurations == (f"{one.name}:PEM", f"{other.name}:PEM")
        assert comparison.overall["difference"].notna().any()

    @pytest.mark.extras
    def test_what_is_not_in_a_folder_is_said(self, here: Path) -> None:
        result = cr.run("e.yaml")
        for call in (cr.view, cr.write_report, cr.write_figures, cr.write_film):
            with pytest.raises(cr.InputError, match=r"found some that are not saved; result\.save\(folder\) does"):
                call(result)
        with pytest.raises(cr.InputError, match="expected results of a run to save, found some that were read"):
            cr.load_results(result.save("out/e")).save("out/again")
        assert not Path("out/again").exists()


class TestProgressInANotebook:
    @pytest.fixture
    def told(self, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
        """What a kernel would show: the first line, then what takes its place."""
        told: list[Any] = []

        class Handle:
            def update(self, words: dict[str, str], *, raw: bool) -> None:
                assert raw
                told.append(words["text/plain"])

        def display(words: dict[str, str], *, raw: bool, display_id: bool) -> Handle:
            assert (raw, display_id, told) == (True, True, []), "one line for the whole run"
            told.append(words["text/plain"])
            return Handle()

        shell = type("Shell", (), {"kernel": object()})()
        monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
        monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=display))
        return told

    def test_a_line_that_is_empty_in_the_end(
        self, here: Path, told: list[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(api_run, "SHOWN_AFTER_S", 0.0)
        show = api_run.show_below_cell()
        assert show is not None
        for done in (0, 1, 3, 4):
            show(done, 4)
        assert told == ["replaying: 0 %", "replaying: 25 %", "replaying: 75 %", ""]

    def test_a_run_calls_it_and_one_of_yours_takes_its_place(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        below: list[tuple[int, int]] = []
        own: list[tuple[int, int]] = []
        monkeypatch.setattr(api_run, "show_below_cell", lambda: lambda *reached: below.append(reached))
        cr.run("e.yaml", progress=lambda *reached: own.append(reached))
        assert (bool(own), below) == (True, [])
        cr.run("e.yaml")
        assert below == own

    def test_short_runs_and_runs_elsewhere_show_nothing(
        self, here: Path, told: list[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(api_run, "SHOWN_AFTER_S", 1e9)
        cr.run("e.yaml")
        assert told == []
        monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))
        assert api_run.show_below_cell() is None  # IPython is imported, yet nobody's shell
        monkeypatch.delitem(sys.modules, "IPython")
        assert api_run.show_below_cell() is None


class TestRecordings:
    def test_a_draft_runs(self, here: Path) -> None:
        (here / "draft.yaml").write_text(cr.draft_experiment("drive.mcap"))
        assert len(cr.run("draft.yaml").summary) > 0

    def test_no_draft_of_what_is_unreadable(self, here: Path) -> None:
        (here / "bad.mcap").write_bytes(b"no recording")
        found = cr.inspect_recording("bad.mcap")
        assert not found["readable"]
        with pytest.raises(cr.RecordingError) as refused:
            cr.draft_experiment("bad.mcap")
        assert refused.value.problems == (found["reason"],)


class TestShownShortly:
    """What a notebook prints of objects, and the versions of names that it completes."""

    def test_recordings_and_tracks_fit_a_line(self) -> None:
        recording = cr.read_recording(ROOT / "logs" / "tc016d.mcap")
        assert repr(recording) == "Recording(tc016d.mcap, ground_truth: 9 objects, 81 frames, 8.0 s)"
        assert repr(recording.truth) == "Tracks(729 states of 9 tracks in 81 lists of truth, runs: 1)"

    def test_the_truth_as_a_table(self) -> None:
        recording = cr.read_recording(ROOT / "logs" / "tc016d.mcap")
        table = recording.truth.to_dataframe(recording.scene)
        assert len(table) == 729
        assert table["captured_s"].is_monotonic_increasing
        ego = table[table["object_id"] == "1"]
        assert (ego["object_class"] == "car").all()
        # 10 m/s over 8 s.
        assert ego["x_m"].iloc[-1] - ego["x_m"].iloc[0] == pytest.approx(80.0)
        assert "object_id" not in recording.truth.to_dataframe()

    def test_names_of_plot_are_figures_alone_and_all_of_them(self) -> None:
        """One function for each figure that `plot` writes; two have names that say more than those of their files."""
        assert dir(cr.plot) == sorted(cr.plot.__all__)
        called = {"curves": "detection_curves", "runs": "single_runs"}
        assert dir(cr.plot) == sorted(called.get(name, name) for name in FIGURES)
        assert {inspect.signature(getattr(cr.plot, name)).return_annotation for name in cr.plot.__all__} == {"Figure"}

    def test_a_figure_that_results_lack_is_refused_with_the_reason(self, here: Path) -> None:
        result = cr.run("e.yaml")
        with pytest.raises(
            cr.InputError, match="no figure of false_positives: fewer than two configurations have both"
        ):
            cr.plot.false_positives(result)
        with pytest.raises(cr.InputError, match="no figure of trade_off: "):
            cr.plot.trade_off(result)
        with pytest.raises(cr.InputError, match="no slices"):
            cr.plot.slices(result)
        with pytest.raises(cr.InputError, match="no figure of late_paths: of the truth alone nothing is late"):
            cr.plot.late_paths(result, configurations=["GT"])
        with pytest.raises(cr.InputError, match="nowhere"):
            cr.plot.answer(result, configurations=["nowhere"])

    def test_the_version_is_the_installed_one(self) -> None:
        from importlib.metadata import version

        assert cr.__version__ == version("copem-replay")


def test_an_experiment_read_by_yaml_1_1_has_its_on() -> None:
    """`yaml.safe_load` reads the key `on` as True."""
    loaded = yaml.safe_load((ROOT / "logs" / "tc016d.yaml").read_text())
    assert any(True in unit for unit in loaded["units"].values())
    loaded["logs"] = [str(ROOT / "logs" / "tc016d.mcap")]
    assert cr.load_experiment(loaded).units["ego"].on == "ego"
