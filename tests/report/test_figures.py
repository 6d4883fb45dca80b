"""Figures: what they are drawn from is read back from their artists and compared with what can be computed in the head.

The scene: the ego (1), 4 m long, drives at 10 m/s along x for 5 s. A pedestrian (2), 0.5 m deep, stands in its way at
30 m; another (3) stands 30 m aside. The clock starts at 0.5 s: the ego is at 5 m, 25 m from him, 22.75 m from box to
box. Its driver reacts after 0.2 s and brakes with 8 m/s², which takes 1.25 s and 6.25 m. Known after l seconds, it
stops 14.5 − 10 l metres before him.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from copem_replay.cli import main as cli
from copem_replay.core.errors import InputError
from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.metrics.columns import TABLES
from copem_replay.metrics.limits import Clusters
from copem_replay.metrics.row_figures import FigureRows
from copem_replay.metrics.survival import DETECTED, LEFT, cumulative_incidence
from copem_replay.report.figures.detection_curves import curves_figure
from copem_replay.report.figures.distances import FAIL, KINDS, NEUTRAL, PASS, Strip, distances_figure
from copem_replay.report.figures.latency_breakdown import latency_breakdown_figure
from copem_replay.report.figures.registry import write_figure_files
from copem_replay.report.figures.selection import Selection, choose_object_and_run
from copem_replay.report.figures.single_runs import StoryEvent, last_instant, runs_figure
from copem_replay.report.figures.style import choose_appearances, format_share, shorten_names
from copem_replay.report.figures.sweeps import sweeps_figure
from copem_replay.results.read import Results, read_results
from tests.helpers.compare_folders import unseal
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.replays import save_run
from tests.helpers.report_pages import named, with_rows
from tests.oracles import intervals as oracle

TEXT = """\
version: 1
logs: [drive.mcap]
runs: 3
seed: 1
pems:
  sure: [{detection: {kind: constant, probability: 1.0}}]
  blind: [{when: {classes: [animal]}, detection: {kind: constant, probability: 1.0}}]
units:
  ego: {on: ego, height_m: 1.8, pem: sure}
  eye: {on: ego, height_m: 1.8, pem: blind}
configurations:
  GT: {units: truth}
  late: {units: [ego], latency_s: 0.5}
  near: {units: [ego], latency_s: 1.42}
  hit: {units: [ego], latency_s: 1.8}
  never: {units: [eye]}
measure: {onset: {kind: at, time_s: 0.5}}
braking: {driver: {kind: constant_deceleration, a_max_mps2: 8.0, reaction: {kind: constant, delay_s: 0.2}}}
show: null
"""
TWO = "measure: {objects: {ids: [2]}, onset: {kind: at, time_s: 0.5}}"
NAMES = ("answer", "differences", "runs", "curves", "late_paths", "distances", "latency_breakdown")
WITHOUT_LOG = tuple(name for name in NAMES if name not in ("runs", "late_paths"))


def drive(path: Path) -> Path:
    frames = [
        (0.1 * k, [Obj(id=1, x=1.0 * k, vx=10.0), pedestrian(2, 30.0), pedestrian(3, 30.0, 30.0)]) for k in range(51)
    ]
    return write_recording(path, frames, host=1)


def changed(*changes: str, text: str = TEXT) -> str:
    """The text with lines replaced by key; a change `key:` alone takes the line out."""
    for change in changes:
        key = change.partition(":")[0] + ":"
        lines = [line for line in text.splitlines() if not line.startswith(key)]
        text = "\n".join([*lines, *([change] if change != key else [])]) + "\n"
    return text


def replayed(place: Path, text: str = TEXT, name: str = "results") -> Path:
    """A results folder beside the recording it is of."""
    drive(place / "drive.mcap")
    (place / "e.yaml").write_text(text, encoding="utf-8")
    source = read_experiment_file(place / "e.yaml")
    experiment, found = find_problems(source)
    assert experiment is not None, found
    recordings, refused = read_logs(experiment, log_paths(source)[0], source)
    assert not refused + found
    save_run(place / name, experiment, recordings, overwrite=True)
    return place / name


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the scene: to be read, not to be written to."""
    return replayed(tmp_path_factory.mktemp("made"))


@pytest.fixture(scope="module")
def results(made: Path) -> Results:
    return read_results(made)


@pytest.fixture
def mine(made: Path, tmp_path: Path) -> Path:
    """A copy of them, with its recording."""
    shutil.copytree(made.parent, tmp_path / "mine")
    return unseal(tmp_path / "mine" / "results")


class Ended(NamedTuple):
    code: int
    out: list[str]
    lines: list[str]
    """Of stderr."""


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ended]:
    def called(*arguments: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["copem-replay", "plot", *map(str, arguments)])
        capsys.readouterr()
        code = cli._run_to_exit_code()
        out, err = capsys.readouterr()
        return Ended(code, out.splitlines(), err.splitlines())

    return called


def line(axes: Axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the one line of a label."""
    (found,) = (one for one in axes.get_lines() if one.get_label() == label)
    return np.asarray(found.get_xdata(), dtype=float), np.asarray(found.get_ydata(), dtype=float)


def at(axes: Axes, label: str, x: float) -> float:
    """y of a line at x, linear between its vertices."""
    return float(np.interp(x, *line(axes, label)))


def events(axes: Axes) -> list[tuple[str, float]]:
    """The labels of a column of runs, and when."""
    notes = [text for text in axes.texts if isinstance(text, Annotation)]
    return [(text.get_text(), pytest.approx(text.xy[0], abs=0.011)) for text in notes]


def points(axes: Axes) -> dict[str, np.ndarray]:
    """Distances of the points of each label."""
    drawn = [c for c in axes.collections if len(c.get_offsets()) and not str(c.get_label()).startswith("_")]
    return {str(c.get_label()): np.asarray(c.get_offsets())[:, 0] for c in drawn}


def note(figure: Figure) -> str:
    return " ".join(figure.texts[-1].get_text().split())


class TestCommand:
    def test_writes_the_figures_and_prints_their_names(self, call: Callable[..., Ended], mine: Path) -> None:
        ended = call(mine)
        names = [f"{name}.{kind}" for name in NAMES for kind in ("png", "svg")]
        assert (ended.code, ended.lines) == (0, [])
        assert ended.out == [str(mine / "figures" / name) for name in names]
        assert sorted(path.name for path in (mine / "figures").iterdir()) == sorted(names)
        assert not list(mine.glob(".*"))

    def test_the_same_bytes_twice(self, results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        first, _ = write_figure_files(results, tmp_path / "a" / "deep", Selection())
        monkeypatch.setitem(matplotlib.rcParams, "font.size", 20.0)  # whatever the user likes
        monkeypatch.setenv("SOURCE_DATE_EPOCH", "1")
        second, _ = write_figure_files(read_results(results.folder), tmp_path / "b", Selection())
        assert len(first) == 2 * len(NAMES)
        assert {p.name: p.read_bytes() for p in first} == {p.name: p.read_bytes() for p in second}
        for path in first:
            content = path.read_bytes()
            assert matplotlib.__version__.encode() not in content
            assert b"dc:date" not in content

    def test_settings_are_left_as_they_were(self, results: Results) -> None:
        before = dict(matplotlib.rcParams)
        curves_figure(results)
        assert dict(matplotlib.rcParams) == before

    def test_out_keeps_what_is_not_ours(self, call: Callable[..., Ended], mine: Path, tmp_path: Path) -> None:
        (tmp_path / "paper").mkdir()
        (tmp_path / "paper" / "text.tex").write_text("mine")
        (tmp_path / "paper" / "sweeps.png").write_text("of an earlier call")
        assert call(mine, "--out", tmp_path / "paper").code == 0
        assert {p.name for p in (tmp_path / "paper").iterdir()} == {
            "text.tex", *(f"{name}.{kind}" for name in NAMES for kind in ("png", "svg"))
        }  # fmt: skip
        assert not (mine / "figures").exists()

    @pytest.mark.parametrize(
        ("damage", "said"),
        [
            (lambda log: log.unlink(), "drive.mcap: cannot be opened: No such file or directory; put the log back"),
            (lambda log: log.write_bytes(log.read_bytes() + b"x"), "drive.mcap: expected the log that was replayed"),
        ],
    )
    def test_without_the_log_the_runs_are_left_out(
        self, call: Callable[..., Ended], mine: Path, damage: Callable[[Path], object], said: str
    ) -> None:
        (mine / "figures").mkdir()
        (mine / "figures" / "runs.png").write_text("of an earlier call")
        damage(mine.parent / "drive.mcap")
        ended = call(mine)
        assert ended.code == 0
        for text, name in zip(ended.lines, ("runs", "late_paths"), strict=True):
            assert text.startswith(f"note: no figure of {name}: ")
            assert said in text
        # Nor does an old one stay, of a log that is no more.
        assert [Path(out).name for out in ended.out] == [
            f"{name}.{kind}" for name in WITHOUT_LOG for kind in ("png", "svg")
        ]
        assert {p.stem for p in (mine / "figures").iterdir()} == set(WITHOUT_LOG)

    @pytest.mark.parametrize(
        ("options", "said"),
        [
            (
                ["--configurations", "GT,PEM"],
                "configurations: expected some of GT, late, near, hit, never, found 'PEM'",
            ),
            (["--run", "3"], "run: expected 0 to 2, found 3"),
            (["--object", "7"], "object: expected one of 2, 3; found '7'"),
            (["--log", "other"], "log: expected one of drive; found 'other'"),
        ],
    )
    def test_what_is_not_there(self, call: Callable[..., Ended], mine: Path, options: Sequence[str], said: str) -> None:
        ended = call(mine, *options)
        assert (ended.code, ended.out, ended.lines) == (2, [], [f"{mine}: {said}"])
        assert not (mine / "figures").exists()

    @pytest.mark.parametrize(
        ("file", "content", "said"),
        [
            (
                "detections.parquet",
                b"PAR1 no",
                "/detections.parquet: expected a table that can be read, found damage: ",
            ),
            ("detections.parquet", None, ": expected a results folder, found no detections.parquet in it; "),
            ("tally.parquet", b"PAR1 no", "/tally.parquet: expected a table that can be read, found damage: "),
            ("tally.parquet", None, ": expected a results folder, found no tally.parquet in it; "),
            ("provenance.json", b"{", "/provenance.json: expected the provenance of results, found damage: "),
            (
                "provenance.json",
                b'{"format": 6}',
                "/provenance.json: expected the provenance of results, found damage: no 'logs'",
            ),
            ("summary.csv", b"a,b\n1,2\n", "/summary.csv: expected the column configuration, found none; run the "),
            ("summary.csv", b"", "/summary.csv: expected a table that can be read, found damage: "),
            (
                "summary.csv",
                b"configuration,n,list_rate_hz\nGT,3,x\n",
                "/summary.csv: expected the column detected_share",
            ),
            ("sweep.csv", b"sweep,value,configuration\nunits,x,GT\n", "/sweep.csv: column value: expected numbers"),
            ("experiment.yaml", b"version: 1\n", "/experiment.yaml:1: logs: missing"),
            ("sweep.csv", b"sweep,value\nunits,1\n", "/sweep.csv: expected the column configuration, found none; "),
        ],
    )
    def test_damaged_results(
        self, call: Callable[..., Ended], mine: Path, file: str, content: bytes | None, said: str
    ) -> None:
        (mine / file).unlink(missing_ok=True)
        if content is not None:
            (mine / file).write_bytes(content)
        ended = call(mine)
        assert (ended.code, ended.out) == (2, [])
        assert said in ended.lines[0]
        assert all(text.startswith(str(mine)) for text in ended.lines)
        assert file == "experiment.yaml" or len(ended.lines) == 1

    def test_rows_that_are_not_of_this_experiment(self, call: Callable[..., Ended], mine: Path) -> None:
        table = pd.read_parquet(mine / "detections.parquet")
        for rows, said in (
            (table.replace("late", "later"), "expected the configurations of experiment.yaml, found 'later'"),
            (table[table["configuration"] != "late"], "expected as many rows of each configuration, found 0 to 6"),
            (table.iloc[:0], "expected rows to draw, found none"),
        ):
            rows.to_parquet(mine / "detections.parquet")
            ended = call(mine)
            assert ended.code == 2
            assert said in ended.lines[0]

    def test_a_tally_of_other_rows(self, call: Callable[..., Ended], mine: Path) -> None:
        pd.read_parquet(mine / "tally.parquet").iloc[1:].to_parquet(mine / "tally.parquet")
        ended = call(mine)
        assert (ended.code, len(ended.lines)) == (2, 1)
        assert "/tally.parquet: expected the 30 rows of detections.parquet counted, found 27; " in ended.lines[0]

    def test_no_folder(self, call: Callable[..., Ended], mine: Path, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        for place, said in (
            (tmp_path / "none", "expected a results folder, found no such folder; `copem-replay run` writes one"),
            (mine / "summary.csv", "expected a results folder, found a file; `copem-replay run` writes one"),
            (tmp_path / "empty", "expected a results folder, found no provenance.json in it; "),
        ):
            ended = call(place)
            assert (ended.code, ended.out, len(ended.lines)) == (2, [], 1)
            assert ended.lines[0].startswith(f"{place}: {said}")

    def test_nothing_is_half_written(
        self, call: Callable[..., Ended], mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        ended = call(mine, "--out", mine / "summary.csv")
        assert ended.code == 2
        assert ended.lines[0].endswith("expected another name, found that of a file of the results in results")
        write = Path.write_bytes

        def full(path: Path, content: bytes) -> int:
            if path.name == "curves.svg":
                path.write_text("half")
                raise OSError(28, "No space left on device")
            return write(path, content)

        monkeypatch.setattr(Path, "write_bytes", full)
        ended = call(mine, "--out", tmp_path / "new")
        assert (ended.code, ended.out) == (2, [])
        assert ended.lines == [f"{tmp_path}/new: cannot be written: No space left on device; choose another with --out"]
        assert [path.name for path in tmp_path.iterdir()] == ["mine"]

    def test_matplotlib_is_imported_where_it_is_used(self) -> None:
        code = "import sys, copem_replay.cli.main, copem_replay.report.figures; sys.exit('matplotlib' in sys.modules)"
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


class TestRuns:
    def test_from_best_to_worst(self, results: Results) -> None:
        # hit, near and never do not pass; of them who never knows is worst, then who knows last.
        choice = choose_object_and_run(results, Selection())
        assert (choice.log, choice.object_id, choice.run) == ("drive", "2", 0)
        assert choice.configurations == ("GT", "late", "hit", "never")
        assert choose_object_and_run(results, Selection(["hit", "GT", "hit"])).configurations == ("hit", "GT")
        assert choose_object_and_run(results, Selection(object_id="3", run=2)).object_id == "3"

    def test_courses_and_events(self, results: Results) -> None:
        figure = runs_figure(results, Selection(["GT", "near", "hit", "never"], run=1))
        columns = np.array(figure.axes).reshape(3, 4).T
        titles = [column[0].get_title(loc="left") for column in columns]
        assert titles == [
            "GT\nknown after 0 s, passes", "near\nknown after 1.42 s, fails",
            "hit\nknown after 1.8 s, fails", "never\nnever known, fails",
        ]  # fmt: skip
        begin = [("clock starts", 0.0), ("captured", 0.0)]
        assert events(columns[0][0]) == [*begin, ("list arrives", 0.0), ("brakes", 0.2), ("stops", 1.45)]
        # It brakes 6.55 m before him and is 0.5 m away after τ s: 6.55 − 10 τ + 4 τ² = 0.5, so τ = (10 − √3.2) / 8.
        near = ("too near: 0.30 m", 1.62 + (10 - 3.2**0.5) / 8)
        assert events(columns[1][0]) == [*begin, ("list arrives", 1.42), ("brakes", 1.62), near]
        # It brakes 2.75 m before him: 2.75 = 10 τ − 4 τ², and is still √(100 − 2 · 8 · 2.75) = 7.48 m/s fast.
        hit = ("hits at 7.5 m/s", 2.0 + (10 - 56**0.5) / 8)
        assert events(columns[2][0]) == [*begin, ("list arrives", 1.8), ("brakes", 2.0), hit]
        assert events(columns[3][0]) == [("clock starts", 0.0), ("hits at 10.0 m/s", 2.275)]
        speed, gap, share = columns[0]
        assert [at(speed, "brakes", t) for t in (0.0, 0.2, 0.7, 1.4, 2.0)] == pytest.approx(
            [10, 10, 6, 0.4, 0], abs=0.02
        )
        assert at(speed, "does not brake", 2.0) == pytest.approx(10)
        # Before the onset, too: 1 m more a tenth of a second earlier.
        assert [at(gap, "brakes", t) for t in (-0.1, 0.0, 0.2)] == pytest.approx([23.75, 22.75, 20.75], abs=1e-6)
        assert [at(gap, "brakes", t) for t in (1.45, 2.0)] == pytest.approx([14.5, 14.5], abs=1e-3)
        assert [at(gap, "does not brake", t) for t in (1.0, 2.2)] == pytest.approx([12.75, 0.75])
        assert set(line(gap, "margin")[1]) == {0.5}
        # Until it brakes what it sees, then what it would see: wholly visible all the time.
        assert line(share, "visible share")[0][-1] == pytest.approx(0.2)
        assert set(line(share, "visible share")[1]) == set(line(share, "without braking")[1]) == {1.0}
        # The one that hits ends there.
        x, y = line(columns[2][0], "brakes")
        assert (x[-1], y[-1]) == pytest.approx((2.0 + (10 - 56**0.5) / 8, 56**0.5), abs=0.01)
        assert line(columns[2][1], "hits")[1] == pytest.approx([0], abs=1e-6)

    def test_without_a_conflict(self, results: Results) -> None:
        """The other stands 30 m aside and nothing brakes: one column, with a mark per configuration."""
        figure = runs_figure(results, Selection(["late", "never"], object_id="3"))
        speed, gap, share = figure.axes
        assert speed.get_title(loc="left") == "never known: never"
        # Beside each other from 22.75 m on, after 2.275 s; looked for every .05 s.
        begin, nearest = ("clock starts", 0.0), ("nearest: 28.7 m", 2.3)
        assert events(speed) == [begin, ("late: known after 0.5 s", 0.5), nearest]
        looks = choose_appearances(results)
        [mark] = [one for one in gap.get_lines() if one.get_label() == "of late"]
        assert (list(mark.get_xdata()), mark.get_color()) == ([0.5, 0.5], looks["late"].colour)
        # Nearest where the ego passes, 30 − 1 − 0.3 m, 2.5 s after the onset; the log ends after 4.5 s.
        assert at(gap, "as recorded", 2.5) == pytest.approx(28.7)
        x, y = line(speed, "as recorded")
        assert set(np.round(y[(x >= -0.3) & (x <= 4.49)], 9)) <= {10.0}
        assert set(line(share, "visible share")[1]) == {1.0}

    def test_without_braking_all_configurations_are_in_one_column(self, tmp_path: Path) -> None:
        text = changed("braking:", "configurations: {GT: {units: truth}, PEM: {units: [ego]}}", text=TEXT)
        text = "\n".join(
            row for row in text.splitlines() if not row.startswith("  ") or "probab" in row or "on: ego" in row
        )
        figure = runs_figure(read_results(replayed(tmp_path, text)), Selection())
        assert len(figure.axes) == 3
        told = [label for label, _ in events(figure.axes[0])]
        assert [label for label in told if "known" in label] == ["GT: known after 0 s", "PEM: known after 0 s"]
        assert "declared driver" not in note(figure)

    def test_labels_have_room(self) -> None:
        # The later label takes 12.5 letters of 0.56 · 7.5 pt: 0.729 of 2 inches, so that 1 s are what is left of it.
        listed = [StoryEvent(0.0, "onset", "x"), StoryEvent(1.0, "outcome", "a long one.")]
        assert last_instant(listed, 0.0, 1.2, 2.0) == pytest.approx(1 / (1 - 12.5 * 0.56 * 7.5 / 72 / 2))
        assert last_instant(listed[:1], 0.0, 1.2, 2.0) == 1.2

    def test_no_ego_unit(self, results: Results, mine: Path) -> None:
        text = (mine.parent / "e.yaml").read_text().replace("on: ego", "at: [0, 0]")
        figure = runs_figure(read_results(replayed(mine.parent, text, "fixed")), Selection())
        assert figure.axes[-1].texts[0].get_text() == "the ego carries no unit"


class TestDistances:
    def test_points(self, results: Results) -> None:
        figure = distances_figure(results)
        (axes,) = figure.axes
        found = points(axes)
        aside = float(np.hypot(25, 30))
        # Three runs each. The ego is 5 + 10 l metres on when it knows.
        assert set(found) == {
            "GT: passes", "late: passes", "near: fails", "hit: fails",
            *(f"{name}: not in conflict" for name in ("GT", "late", "near", "hit")),
        }  # fmt: skip
        assert found["GT: passes"] == pytest.approx([25.0] * 3)
        assert found["late: passes"] == pytest.approx([20.0] * 3)
        assert found["near: fails"] == pytest.approx([10.8] * 3)
        assert found["hit: fails"] == pytest.approx([7.0] * 3)
        assert found["GT: not in conflict"] == pytest.approx([aside] * 3)
        assert [text.get_text() for text in axes.get_yticklabels()] == ["GT", "late", "near", "hit", "never"]
        counts = [text.get_text() for text in axes.texts if text.get_text().isdigit()]
        assert counts == ["0", "0", "0", "0", "6"]
        shares = [text.get_text() for text in axes.texts if "%" in text.get_text()]
        assert shares == ["100 %", "100 %", "0 %", "0 %", "0 %"]
        assert "n = 6 per configuration, seed 1. 10 fused lists per second" in note(figure).replace("\u00a0", " ")

    def test_markers_tell_pass_from_fail(self, results: Results) -> None:
        (axes,) = distances_figure(results, configurations=["GT", "hit"]).axes
        paths = {
            str(c.get_label()): c.get_paths()[0].vertices.tobytes() for c in axes.collections if len(c.get_offsets())
        }
        colours = {
            str(c.get_label()): tuple(c.get_edgecolor()[0][:3]) for c in axes.collections if len(c.get_offsets())
        }
        kinds = ("GT: passes", "hit: fails", "GT: not in conflict")
        assert len({paths[kind] for kind in kinds}) == len({colours[kind] for kind in kinds}) == 3

    def test_failures_in_a_picture_are_seen_on_a_dark_page(
        self, results: Results, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Many points are one picture in the SVG, whose black cannot turn over with the page: it has a white edge."""
        monkeypatch.setattr("copem_replay.report.figures.distances._MANY", 3)
        (axes,) = distances_figure(results, configurations=["hit"]).axes
        found = {str(c.get_label()): c for c in axes.collections}
        halo, cross = found["_halo"], found["hit: fails"]
        assert halo.get_rasterized()
        assert tuple(halo.get_edgecolor()[0][:3]) == (1, 1, 1)
        assert halo.get_linewidths()[0] > cross.get_linewidths()[0]
        assert halo.get_zorder() < cross.get_zorder()
        np.testing.assert_array_equal(halo.get_offsets(), cross.get_offsets())

    def test_foreseen_collisions_have_a_panel(self, mine: Path, tmp_path: Path) -> None:
        table = pd.read_parquet(mine / "detections.parquet")
        table["conflict_detected"] = table["configuration"] == "GT"
        for name in ("conflict_detection_s", "time_to_conflict_detection_s", "distance_at_conflict_detection_m"):
            table[name] = np.where(table["conflict_detected"], 12.0, np.nan)
        table.loc[table["object_id"] == "2", "distance_at_conflict_detection_m"] = np.nan  # while the truth has a gap
        figure = distances_figure(with_rows(read_results(mine), table, tmp_path / "foreseen"))
        assert len(figure.axes) == 2
        # He brakes for the object, so that passing says nothing of this event.
        assert points(figure.axes[1]) == {"GT: not in conflict": pytest.approx([12.0] * 3)}
        assert [text.get_text() for text in figure.axes[1].texts if text.get_text().isdigit()] == ["0", *["6"] * 4]
        assert "Without a point: 3 detections" in note(figure)

    @staticmethod
    def strip(distance_m: Sequence[float], kind: Sequence[int]) -> Strip:
        """Of points, in bins half a metre wide: each was counted alone."""
        one = {"distance_at_detection_m": distance_m, "time_to_detection_s": 1.0, "runs": 1, "in_conflict": True}
        tally = pd.DataFrame(one).assign(passed=np.array(kind) == KINDS.index(PASS))
        tally["in_conflict"] = np.array(kind) != KINDS.index(NEUTRAL)
        return Strip.of(tally.astype({"passed": int}), 0.5, judged=True)

    def test_strips_are_as_wide_as_there_are_many(self) -> None:
        distance_m = np.array([5.0, 5.0, 5.0, 5.0, 9.0, 7.0, 7.01])
        kind = np.array([KINDS.index(one) for one in (PASS, FAIL, PASS, NEUTRAL, PASS, PASS, PASS)])
        strip = self.strip(distance_m, kind)
        across, drawn = strip.place(distance_m, kind, np.zeros_like(strip.count))
        # Four in a bin: the middles of quarters of −1 … 1, failures first; one alone: 0; two over half of it.
        assert across == pytest.approx([0.25, -0.75, 0.75, -0.25, 0, -0.25, 0.25])
        assert drawn.all()

    @given(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 2)), min_size=1, max_size=40), st.integers(0, 40))
    def test_points_find_their_places_log_by_log(self, points: list[tuple[int, int]], cut: int) -> None:
        """However the rows are cut, as if all were there: of a bin those of a kind in their order, evenly."""
        distance_m, kind = np.array([one / 8 for one, _ in points]), np.array([one for _, one in points])
        strip = self.strip(distance_m, kind)
        before = np.zeros_like(strip.count)
        parts = [strip.place(distance_m[of], kind[of], before)[0] for of in (slice(0, cut), slice(cut, None))]
        bins = [int(np.floor(one / 0.5 + 0.5)) for one in distance_m]
        widest = max(bins.count(one) for one in bins)
        for row, found in enumerate(np.concatenate(parts)):
            ranked = sorted((kind[k], k) for k in range(len(bins)) if bins[k] == bins[row])
            place, many = ranked.index((kind[row], row)), len(ranked)
            assert found == pytest.approx((2 * (place + 0.5) / many - 1) * many / widest)
        np.testing.assert_array_equal(before, strip.count)

    def test_of_very_many_in_a_bin_some_are_drawn(self, mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Every other of six, from one edge to the other, and it is said."""
        distance_m, kind = np.full(6, 5.0), np.zeros(6, dtype=int)
        monkeypatch.setattr("copem_replay.report.figures.distances.MOST", 3)
        monkeypatch.setattr("copem_replay.report.figures.distances.MOST", 3)
        strip = self.strip(distance_m, kind)
        across, drawn = strip.place(distance_m, kind, np.zeros_like(strip.count))
        assert across[drawn] == pytest.approx([-5 / 6, -1 / 6, 3 / 6])
        assert "Of more than" not in note(distances_figure(read_results(mine)))
        monkeypatch.setattr("copem_replay.report.figures.distances.MOST", 2)
        monkeypatch.setattr("copem_replay.report.figures.distances.MOST", 2)
        figure = distances_figure(read_results(mine))
        assert "Of more than 2 points at nearly one distance 2 are drawn" in note(figure)
        assert len(points(figure.axes[0])["GT: passes"]) == 2


class TestCurves:
    def test_steps(self, results: Results) -> None:
        figure = curves_figure(results)
        (axes,) = figure.axes
        for name, late_s, last in (("GT", 0.0, 1.0), ("late", 0.5, 1.0), ("hit", 1.8, 1.0)):
            x, y = line(axes, name)
            assert x[1:-1] == pytest.approx([late_s])
            assert y == pytest.approx([1, 1 - last, 1 - last])
            assert (x[0], x[-1]) == pytest.approx(axes.get_xlim())
        assert list(line(axes, "never")[1]) == [1, 1]
        assert "No bands: 2 objects of one drive, fewer than 5" in note(figure)
        assert [text.get_text().strip() for text in axes.texts] == ["GT", "late", "near", "hit", "never"]
        assert figure.legends == [], "names are at the ends of lines"

    def test_one_object_has_bands_over_runs(self, tmp_path: Path) -> None:
        # One in two lists holds him, so that the runs differ.
        text = changed(TWO, "runs: 40", text=TEXT.replace("sure: [{detection: {kind: constant, probability: 1.0}}]",
                       "sure: [{detection: {kind: constant, probability: 0.5}}]"))  # fmt: skip
        results = read_results(replayed(tmp_path, text))
        figure = curves_figure(results, configurations=["late"])
        (axes,) = figure.axes
        rows = results.detections[results.detections["configuration"] == "late"]
        times_s, share = cumulative_incidence(rows["time_to_detection_s"].to_numpy(), np.full(40, DETECTED))
        assert line(axes, "late")[1][1:-1] == pytest.approx(1 - share)
        (drawn,) = (c for c in axes.collections if c.get_label() == "band of late")
        corners = drawn.get_paths()[0].vertices
        # Around the first step: the binomial band of 40 runs is about ± 2 √(p (1 − p) / 40) wide.
        at_first = corners[np.isclose(corners[:, 0], times_s[0])][:, 1]
        low, high = 1 - at_first[at_first < 1].max(), 1 - at_first.min()
        half = 1.96 * (share[0] * (1 - share[0]) / 40) ** 0.5
        assert (low, high) == (pytest.approx(share[0] - half, abs=0.05), pytest.approx(share[0] + half, abs=0.05))
        assert "Bands: 95 %, over 40 runs of this one object: how far other draws" in " ".join(note(figure).split())

    def test_exact(self, mine: Path) -> None:
        # Of two objects one is known at once or after a second, the other half the time after a second, else never.
        columns = ["object_id", "time_to_detection_s", "probability"]
        rows = [("2", 0.0, 0.5), ("2", 1.0, 0.5), ("3", 1.0, 0.5), ("3", None, 0.5), ("3", 2.0, 0.0)]
        exact = pd.DataFrame(rows, columns=columns).assign(log="drive", configuration="GT", episode=0, began="crossed")
        exact = exact.assign(
            onset_s=0.0,
            ended_s=5.0,
            object_class="car",
            ended_by="log_end",
            conflict=False,
            detection_s=exact["time_to_detection_s"],
        )
        exact = exact.reindex(columns=[*exact, *TABLES["exact.parquet"].kinds("braking").keys() - {*exact}])
        exact.to_parquet(mine / "exact.parquet")
        figure = curves_figure(read_results(mine), configurations=["GT"])
        x, y = line(figure.axes[0], "exact")
        assert x[1:-1] == pytest.approx([0, 1])
        assert y == pytest.approx([1, 0.75, 0.25, 0.25])
        assert "Dashed: the exact share" in note(figure)


def bands(
    time_s: Any, ending: Any, over: str, names: Sequence[Any], units: Sequence[Any], at_s: list[float]
) -> tuple[Any, Any]:
    """Limits of the incidence of rows that are detected, or whose object left."""
    known = np.asarray(ending) == DETECTED
    table = pd.DataFrame({"time_to_detection_s": np.where(known, time_s, np.nan), "onset_s": 0.0, "ended_s": time_s})
    number, unit = (pd.factorize(np.array(of), sort=True)[0] for of in (names, units))
    rows = FigureRows(table.assign(ended_by="object_left"), np.ones(len(table)), Clusters(over, number, unit))
    return rows.limit_incidence(at_s, 0.95)


class TestBands:
    def test_clusters_stay_whole(self) -> None:
        # Each of five objects is always or never known, in any of its runs.
        time_s = np.repeat([1.0, 1.0, 1.0, 5.0, 5.0], 20)
        ending = np.repeat([DETECTED, DETECTED, DETECTED, LEFT, LEFT], 20)
        names = list(np.repeat(list("abcde"), 20))
        low, high = bands(time_s, ending, "objects", names, names, [0.5, 1.0])
        # None known by then: none of five, 1 − 0.025^(1/5). Then three of five, whose spread tells of four.
        assert (low[0], high[0]) == (0, pytest.approx(0.521824, abs=1e-6))
        assert (low[1], high[1]) == pytest.approx(oracle.exact(0.6, 4.0))

    def test_bands_end_where_the_summary_does(self) -> None:
        """Five logs of one to four objects in 20 runs: at last the share detected and its limits."""
        generator = np.random.default_rng(4)
        rows, clusters = [], []
        for log in range(5):
            known = generator.binomial(20, generator.beta(4, 1, log % 4 + 1))
            clusters.append((known.sum() / 20, len(known)))
            rows += [(f"log {log}", f"{log} {thing}", DETECTED if run < n else LEFT)
                     for thing, n in enumerate(known) for run in range(20)]  # fmt: skip
        logs, things, ending = zip(*rows, strict=True)
        low, high = bands(np.ones(len(rows)), ending, "logs", logs, things, [1.0])
        assert (low[0], high[0]) == pytest.approx(oracle.share(clusters), abs=1e-8)

    def test_bands_of_runs_are_binomial(self) -> None:
        ending = np.array([DETECTED] * 7 + [LEFT] * 3)
        low, high = bands(np.arange(10.0), ending, "runs", range(10), ["a"] * 10, [2.0, 9.0])
        assert [(low[0], high[0]), (low[1], high[1])] == [
            pytest.approx(oracle.exact(k / 10, 10)) for k in (3, 7)
        ]  # fmt: skip


class TestSweeps:
    @pytest.fixture
    def swept(self, mine: Path) -> Results:
        rows = [
            ("latency_s", 0.5, "late", 10.0, 0.9, 0.8, 1.0, 0.6, 0.7, None, 0.8, 0.7, 0.9),
            ("latency_s", 0.0, "late", 10.0, 1.0, 0.9, 1.0, 0.1, 0.2, 0.3, 0.9, 0.8, 1.0),
            ("latency_s", 0.0, "GT", 10.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0),
            ("rate_hz", 2.0, "late", 2.0, 0.4, 0.3, 0.5, 0.2, None, None, None, None, None),
        ]
        columns = ["sweep", "value", "configuration", "list_rate_hz", "detected_share", "detected_share_low",
                   "detected_share_high", "ttd_p5_s", "ttd_rmst_s", "ttd_p95_s", "pass_share", "pass_share_low",
                   "pass_share_high"]  # fmt: skip
        table = pd.DataFrame(rows, columns=columns).assign(
            n=6, interval="exact", interval_over="runs", interval_clusters=6
        )
        table["pass_share_exact"] = [0.79, 0.91, 1.0, None]
        table.to_csv(mine / "sweep.csv", index=False)
        return read_results(mine)

    def test_panels(self, swept: Results) -> None:
        figure = sweeps_figure(swept)
        panels = np.array(figure.axes).reshape(3, 2)
        labels = [axes.get_xlabel() for axes in panels[2]]
        assert labels == ["Latency (s)", "Rate of the units (lists per second)"]
        passes, detected, times = panels[:, 0]
        assert [list(v) for v in line(passes, "late")] == [[0, 0.5], [0.9, 0.8]]
        assert [list(v) for v in line(detected, "late")] == [[0, 0.5], [1.0, 0.9]]
        assert [list(v) for v in line(times, "late")] == [[0, 0.5], [0.2, 0.7]]
        assert [list(v) for v in line(passes, "GT")] == [[0], [1.0]]
        exact = [[list(v) for v in one.get_data()] for one in passes.get_lines() if one.get_label() == "exact"]
        assert exact == [[[0, 0.5], [0.91, 0.79]], [[0], [1.0]]]
        names = [text.get_text() for text in figure.legends[0].get_texts()]
        assert names == ["late (latency swept)", "late", "GT (latency swept)", "exact"]
        (drawn,) = (c for c in detected.collections if c.get_label() == "band of late")
        assert {tuple(v) for v in drawn.get_paths()[0].vertices} == {(0, 0.9), (0, 1), (0.5, 0.8), (0.5, 1)}
        # The 95 % quantile at 0.5 s is among the never detected: the band goes on beyond the axis.
        (drawn,) = (c for c in times.collections if c.get_label() == "band of late")
        corners = drawn.get_paths()[0].vertices
        assert corners[np.isclose(corners[:, 0], 0.5)][:, 1].max() > times.get_ylim()[1]
        assert 0.7 < times.get_ylim()[1] < 1
        said = note(figure).replace("\u00a0", " ")
        assert (
            "n = 6 per point, seed 1. Latency: 10 fused lists per second. "
            "Bands of shares, 95 %: exact binomial limits over 6 runs of this one object" in said
        )
        assert "reaches the top" in said

    def test_only_some(self, swept: Results) -> None:
        figure = sweeps_figure(swept, configurations=["GT"])
        assert len(figure.axes) == 3
        with pytest.raises(InputError, match="expected rows of never, found none"):
            sweeps_figure(swept, configurations=["never"])

    def test_the_command_draws_them(self, call: Callable[..., Ended], swept: Results) -> None:
        ended = call(swept.folder)
        assert [Path(out).name for out in ended.out[-2:]] == ["sweeps.png", "sweeps.svg"]
        ended = call(swept.folder, "--configurations", "never")
        assert (ended.code, len(ended.out)) == (0, 12)
        assert ended.lines == [
            "note: no figure of latency_breakdown: nothing was detected",
            f"note: no figure of sweeps: {swept.folder}/sweep.csv has no rows of never",
        ]

    def test_none(self, results: Results) -> None:
        with pytest.raises(InputError, match=r"expected sweep\.csv in it, found none"):
            sweeps_figure(results)


class TestLatencyBreakdown:
    def test_bars_add_up_to_the_mean_time_of_what_is_detected(self, results: Results) -> None:
        (axes,) = latency_breakdown_figure(results).axes
        names = list(results.experiment.configurations)
        assert [tick.get_text() for tick in axes.get_yticklabels()] == names
        bars = [bar for group in axes.containers if group.get_label() != "_edge" for bar in group.patches]
        for k, name in enumerate(names):
            rows = results.detections[(results.detections["configuration"] == name) & results.detections["detected"]]
            mine = [bar for bar in bars if bar.get_y() < k < bar.get_y() + bar.get_height()]
            spent_s = rows["detection_s"] - rows["onset_s"]
            assert sum(bar.get_width() for bar in mine) == pytest.approx(spent_s.mean() if len(rows) else 0.0)
        assert "never known" in [text.get_text().strip() for text in axes.texts]


class TestWords:
    def test_names_that_are_too_long_lose_their_middle(self) -> None:
        names = shorten_names(["GT", "roadside units of the crossing, 0.5 s"])
        assert names == {"GT": "GT", "roadside units of the crossing, 0.5 s": "roadside unit…ssing, 0.5 s"}
        alike = ["a" * 20 + "1" + "b" * 20, "a" * 20 + "2" + "b" * 20]
        assert list(shorten_names(alike).values()) == alike

    def test_percent(self) -> None:
        shares = [0, 1, 0.5, 0.996, 0.9999, 0.001, 0.0001, float("nan")]
        assert [format_share(share) for share in shares] == [
            "0 %", "100 %", "50 %", "99.6 %", "> 99.9 %", "0.1 %", "< 0.1 %", "–",
        ]  # fmt: skip

    def test_odd_names_are_drawn_as_they_are(self, tmp_path: Path) -> None:
        text = changed("runs: 1").replace("  late:", '  "$a$_{<&>}":').replace("  hit:", '  "_試":')
        results = read_results(replayed(tmp_path, text))
        files, notes = write_figure_files(results, None, Selection())
        assert (len(files), notes) == (2 * len(NAMES), [])
        labels = [text.get_text().strip() for text in curves_figure(results).axes[0].texts]
        assert labels == ["GT", "$a$_{<&>}", "near", "_試", "never"]

    def test_looks_differ(self) -> None:
        looks = choose_appearances(named([f"c{k}" for k in range(9)]))
        assert len({(look.dashes, look.colour) for look in looks.values()}) == 9
        assert len({look.dashes for look in list(looks.values())[:7]}) == 7
        # The first line is the widest.
        widths = [look.width_pt for look in looks.values()]
        assert widths == sorted(widths, reverse=True)

    def test_provenance_is_of_the_experiment(self, mine: Path) -> None:
        found = json.loads((mine / "provenance.json").read_text())
        (mine / "provenance.json").write_text(json.dumps(found | {"logs": []}))
        with pytest.raises(InputError, match=r"expected 1 logs as in experiment\.yaml, found 0"):
            read_results(mine)
