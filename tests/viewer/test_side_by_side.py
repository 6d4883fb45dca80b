"""Two results folders in one recording, differences marked.

The ego (1) stands at the origin. Another car (2) comes from 70 m at 10 m/s, 3 s long; its clock starts at 60 m, at 1 s.
A parked car (3) is 30 m to the left. In folder `b` the ego sees to 80 m, exactly: it knows the car when its clock
starts. In folder `a` it sees to 55 m, half a metre off (0.3 east, 0.4 north): it knows it 0.5 s later.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from copem_replay.cli import main as cli
from copem_replay.core.colours import configuration_colours
from copem_replay.experiment.schema import Experiment
from copem_replay.viewer.side_by_side import ComparedExperiment, join_experiments
from copem_replay.viewer.sink import ELAPSED, split_into_files
from tests.helpers.compare_folders import unseal
from tests.helpers.experiments import changed, drive
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.viewer.test_rrd import at, rows, static

os.environ["RERUN_ANALYTICS"] = "0"

Compare = Callable[..., tuple[int, list[str]]]
SEEN = "  onboard: [{when: {range_m: [0, %d]}, detection: {kind: constant, probability: 1.0}, error: {kind: gaussian, mean_m: %s, covariance_m2: [[0, 0], [0, 0]]}}]"  # noqa: E501


def text(range_m: int, mean_m: list[float], *more: str) -> str:
    lines = changed("runs: 2", *more).splitlines()
    first = lines.index("  onboard:")
    lines[first : first + 4] = [SEEN % (range_m, mean_m)]
    return "\n".join(lines) + "\n"


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Compare:
    """Both folders, and how to call the command: its exit code, and what it says on stderr."""
    monkeypatch.chdir(tmp_path)

    def called(*words: str) -> tuple[int, list[str]]:
        monkeypatch.setattr("sys.argv", ["copem-replay", *words])
        capsys.readouterr()
        return cli._run_to_exit_code(), capsys.readouterr().err.splitlines()

    drive(tmp_path / "drive.mcap")
    for name, content in (("a", text(55, [0.3, 0.4])), ("b", text(80, [0.0, 0.0]))):
        (tmp_path / f"{name}.yaml").write_text(content)
        assert called("run", f"{name}.yaml", "--out", name)[0] == 0
    return called


def elapsed_s(found: list[dict[str, Any]]) -> list[float]:
    return [row[ELAPSED] / 1e9 for row in found]


def test_two_folders_beside_each_other(call: Compare, tmp_path: Path) -> None:
    path = tmp_path / "new" / "ab.rrd"
    asked = ("compare", "a", "b", "--configurations", "PEM,a:GT", "--baseline", "b:PEM", "--rrd", str(path))
    assert call(*asked)[0] == 0
    entities = {chunk.entity_path for chunk in _all(path)}
    assert {"/world/a:PEM/boxes", "/world/a:GT/boxes", "/world/b:PEM/boxes"} <= {p.replace("\\", "") for p in entities}
    assert not any("b:PEM/difference" in entity.replace("\\", "") for entity in entities), "it is what they differ from"

    # The first folder's configurations have the colours of its own files, whatever is compared.
    colour = {name: at(path, rf"/world/{name}/boxes", 2.0)["Boxes3D:colors"][0] >> 8 for name in (r"a\:PEM", r"a\:GT")}
    of_a = configuration_colours(["GT", "PEM"], ["GT"]).values()
    assert list(colour.values())[::-1] == [red << 16 | green << 8 | blue for red, green, blue in of_a]
    assert at(path, r"/world/b\:PEM/boxes", 2.0)["Boxes3D:colors"][0] >> 8 not in colour.values()

    # Until 1.4 s only b holds the car, above whose true place that stands; from 1.5 s on both do.
    lost = rows(path, r"/world/a\:PEM/difference/lost")
    assert elapsed_s(lost) == pytest.approx([*np.arange(15) / 10, 1.5])
    for row in lost[:-1]:
        ((x, y, z),) = row["Points3D:positions"]
        assert (x, y) == pytest.approx((70 - row[ELAPSED] / 1e8, 0), abs=1e-4)
        assert z > 1.5, "above its box"
        assert row["Points3D:labels"] == ["2 only in b:PEM"]
    assert lost[-1]["Points3D:positions"] == []
    assert rows(path, r"/world/a\:PEM/difference/gained") == []
    # What the truth holds, b holds, too.
    assert rows(path, r"/world/a\:GT/difference/lost") == rows(path, r"/world/a\:GT/difference/gained") == []

    (first,) = rows(path, r"/world/a\:PEM/difference/first")
    assert first[ELAPSED] == 1_500_000_000
    (way,) = first["LineStrips3D:strips"]
    assert [point[:2] for point in way] == [pytest.approx([60, 0], abs=1e-4), pytest.approx([55, 0], abs=1e-4)]
    assert first["LineStrips3D:labels"] == ["2 +0.50 s to b:PEM"]

    more = rows(path, r"/plots/error_difference/2_car/a\:PEM")
    # Quartiles, each quarter of a second: from 1.5 s on both list it.
    assert elapsed_s(more) == pytest.approx(np.arange(6, 13) / 4)
    assert np.array([row["Scalars:scalars"] for row in more]) == pytest.approx(np.full((7, 3), 0.5))
    exact = rows(path, r"/plots/error_difference/2_car/a\:GT")
    assert np.array([row["Scalars:scalars"] for row in exact]) == pytest.approx(np.zeros((13, 3)))

    (told,) = rows(path, r"/events/difference/a\:PEM")
    assert (told[ELAPSED], told["TextLog:text"]) == (1_500_000_000, ["a:PEM knew 2 car 0.50 s after b:PEM"])
    (told,) = rows(path, r"/events/difference/a\:GT")
    assert told["TextLog:text"] == ["a:GT knew 2 car as soon as b:PEM"]

    # Opened without `view` it plays from the difference on: the viewer cannot be told of an instant.
    from rerun.chunk import RrdReader

    [blueprint] = RrdReader(path).blueprints()
    panel = {
        name: batch.column(name).to_pylist()[0]
        for batch in (chunk.to_record_batch() for chunk in RrdReader(path).stream(store=blueprint))
        for name in batch.schema.names
        if name.startswith("TimePanelBlueprint:")
    }
    assert panel["TimePanelBlueprint:time_selection"][0]["min"] == 1_250_000_000, "between 1 and 1.5 s"
    assert panel["TimePanelBlueprint:play_state"] == [2], "playing"

    # Both call their unit `ego` and mean different ones; the masts see as far as the egos, so they differ as well.
    units = {entity.removeprefix("/world/units/") for entity in entities if entity.startswith("/world/units/")}
    assert {unit.replace("\\", "") for unit in units} == {"ego", "mast", "a:ego", "a:mast"}
    assert ["drive: run 0: differences to b:PEM"] in [
        value for of in (static(path, entity) for entity in entities if "properties" in entity) for value in of.values()
    ]
    assert {"b:PEM", "a:PEM", "2 car: more error than b:PEM, m"} <= {view.partition(" · ")[0] for view in _views(path)}

    # An existing file is replaced, as the tables of `compare` are.
    assert call(*asked, "--run", "1", "--log", "drive")[0] == 0
    assert at(path, r"/world/a\:PEM/boxes", 2.0)["Boxes3D:centers"] != []


def test_an_older_version_and_a_newer_one(call: Compare, tmp_path: Path) -> None:
    """Each configuration beside itself: the newer one in its own colour, the older one in a paler one."""
    code, lines = call("compare", "a", "b", "--rrd", "ab.rrd")
    assert code == 0
    assert lines[:1] == [
        "note: b differs from a in pems.onboard.0.when.range_m ([0.0, 55.0], [0.0, 80.0]); "
        "pems.onboard.0.error.mean_m ([0.3, 0.4], [0.0, 0.0])"
    ]
    path = tmp_path / "ab.rrd"
    entities = {chunk.entity_path.replace("\\", "") for chunk in _all(path)}
    drawn = {entity.split("/")[2] for entity in entities if entity.startswith("/world/") and entity.endswith("/boxes")}
    assert {"a:PEM", "b:PEM"} <= drawn
    assert not any(":GT" in name for name in drawn), "nothing differs in it"
    (told,) = rows(path, r"/events/difference/b\:PEM")
    assert (told[ELAPSED], told["TextLog:text"]) == (1_500_000_000, ["b:PEM knew 2 car 0.50 s before a:PEM"])
    assert not any("a:PEM/difference" in entity for entity in entities)
    assert "2 car: more error than before, m" in {view.partition(" · ")[0] for view in _views(path)}
    assert call("compare", "b", "--baseline", "GT", "--rrd", "own.rrd")[0] == 0
    own, newer, older = (
        static(of, entity)["SeriesLines:colors"]
        for of, entity in (
            (tmp_path / "own.rrd", "/plots/known/PEM"), (path, r"/plots/known/b\:PEM"),
            (path, r"/plots/known/a\:PEM"),
        )
    )  # fmt: skip
    assert newer == own != older


def test_pairs_stay_in_one_file() -> None:
    pairs = {f"new:{k}": f"old:{k}" for k in range(4)}
    names = [name for new, old in pairs.items() for name in (old, new)]
    first, second = split_into_files(names, pairs)
    assert (first.configurations, second.configurations) == (tuple(names[:6]), tuple(names[6:]))
    assert second.infix == ".configurations_7-8"


def test_what_of_two_versions_fails(
    call: Compare, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`far` knows the car half a second before `near`: the older folder comes first."""
    for name, of in (("near", text(55, [0.3, 0.4])), ("far", text(80, [0.0, 0.0]))):
        (tmp_path / f"{name}.yaml").write_text(of.replace("runs: 2", "runs: 6"))
        assert call("run", f"{name}.yaml", "--out", name)[0] == 0
    limit = ("--fail-on", "ttd_rmst_s > 0.05", "--configurations", "PEM")
    for words, expected, code in ((("near", "far"), "better: PEM 0.50 s sooner", 0),
                                  (("far", "near"), "worse: PEM 0.50 s later", 1)):  # fmt: skip
        monkeypatch.setattr("sys.argv", ["copem-replay", "compare", *words, *limit])
        assert cli._run_to_exit_code() == code
        said = capsys.readouterr().out.splitlines()
        assert said[0] == f"{words[1]} against {words[0]}: {expected.partition(':')[0]}"
        assert said[-1].startswith(f"{words[1]} against {words[0]}: {expected}")
        monkeypatch.setattr("sys.argv", ["copem-replay", "compare", *words, *limit, "--json"])
        assert cli._run_to_exit_code() == code
        found = json.loads(capsys.readouterr().out)
        assert (found["answer"], found["newer"]) == (said[-1], [words[1]])
        assert {row["configuration"] for row in found["rows"]} == {"PEM"}
        (time,) = (row for row in found["rows"] if row["metric"] == "ttd_rmst_s")
        assert abs(time["difference"]) == pytest.approx(0.5)
    assert call("compare", "near", *limit) == (
        2, ["--fail-on: expected two folders, OLD NEW, or --baseline NAME, found 1"]
    )  # fmt: skip


def _all(path: Path) -> list[Any]:
    from rerun.chunk import RrdReader

    return list(RrdReader(path).stream())


def _views(path: Path) -> set[str]:
    from rerun.chunk import RrdReader

    name = "ViewBlueprint:display_name"
    [blueprint] = RrdReader(path).blueprints()
    batches = (chunk.to_record_batch() for chunk in RrdReader(path).stream(store=blueprint))
    return {batch.column(name)[0].as_py()[0] for batch in batches if name in batch.schema.names}


def test_never_known(call: Compare, tmp_path: Path) -> None:
    """In folder c the ego sees to 20 m, and the car stays 40 m away."""
    (tmp_path / "c.yaml").write_text(text(20, [0.0, 0.0]))
    assert call("run", "c.yaml", "--out", "c")[0] == 0
    assert call("compare", "c", "b", "--configurations", "PEM", "--baseline", "b:PEM", "--rrd", "bc.rrd")[0] == 0
    path = tmp_path / "bc.rrd"
    (told,) = rows(path, r"/events/difference/c\:PEM")
    assert (told[ELAPSED], told["TextLog:text"]) == (3_000_000_000, ["c:PEM never knew 2 car, b:PEM did"])
    assert told["TextLog:level"] == ["WARN"]
    assert rows(path, r"/world/c\:PEM/difference/first") == []
    # The parked car, too, is known to b only: it hides others, and nobody measures when it is known.
    last = rows(path, r"/world/c\:PEM/difference/lost")[-1]
    assert sorted(last["Points3D:labels"]) == ["2 only in b:PEM", "3 only in b:PEM"]


def test_the_units_of_that_run(call: Compare, tmp_path: Path) -> None:
    """Cars of which each carries a unit or not: there are those that do in that run, seeing what they saw."""
    cars = [Obj(id=k, x=8.0 * k, y=6.0) for k in range(2, 8)]
    frames = [(0.1 * k, [Obj(id=1, x=0.0), *cars, pedestrian(9, 20.0, -5.0 + 0.1 * k, vy=1.0)]) for k in range(6)]
    write_recording(tmp_path / "square.mcap", frames, host=1)
    (tmp_path / "f.yaml").write_text(
        "version: 1\nlogs: [square.mcap]\nruns: 6\n"
        "pems: {p: [{detection: {kind: constant, probability: 0.6}}]}\n"
        "units: {ego: {on: ego, pem: p}, fleet: {on: {classes: [car], penetration_rate: 0.5}, pem: p}}\n"
        "configurations: {alone: {units: [ego]}, V2V: {units: all, latency_s: {ego: 0, default: 0.2}}}\n"
        "measure: {objects: {classes: [pedestrian]}, onset: {kind: appears}, began: [log_start, appeared]}\n"
        "show: {run: [3, 4]}\n"
    )
    assert call("run", "f.yaml", "--out", "f")[0] == 0
    seen = {}
    for stem, options in (("replay", []), ("replay_4", ["--run", "4"])):
        assert call("compare", "f", "--baseline", "alone", "--rrd", "f.rrd", *options)[0] == 0
        for entity in ("/world/V2V/boxes", "/world/alone/boxes", "/plots/position_error/9_pedestrian/V2V"):
            assert rows(tmp_path / "f.rrd", entity) == rows(tmp_path / "f" / f"{stem}.rrd", entity)
        units = {c.entity_path for c in _all(tmp_path / "f.rrd") if c.entity_path.startswith("/world/units/")}
        assert units == {c.entity_path for c in _all(tmp_path / f"f/{stem}.rrd") if "/world/units/" in c.entity_path}
        seen[stem] = units
    assert seen["replay"] != seen["replay_4"]


def test_what_would_help_is_said_of_one_experiment_alone(call: Compare, tmp_path: Path) -> None:
    """In several folders more than the keys of configurations may differ."""
    frames = [(0.1 * k, [Obj(id=1, x=0.0), pedestrian(9, 20.0, -5.0 + 0.1 * k, vy=1.0)]) for k in range(31)]
    write_recording(tmp_path / "square.mcap", frames, host=1)
    for name in "gh":
        (tmp_path / f"{name}.yaml").write_text(
            "version: 1\nlogs: [square.mcap]\npems: {p: [{detection: {kind: constant, probability: 1}}]}\n"
            "units: {ego: {on: ego, pem: p}}\n"
            "configurations: {now: {units: all}, late: {units: all, latency_s: 0.5}}\n"
            "measure: {onset: {kind: appears}, began: [log_start, appeared]}\n"
        )
        assert call("run", f"{name}.yaml", "--out", name)[0] == 0
    told = {}
    for folders, names in ((("g",), "late"), (("g", "h"), "h:late")):
        asked = ("--configurations", names, "--baseline", "now" if len(folders) == 1 else "g:now", "--rrd", "x.rrd")
        assert call("compare", *folders, *asked)[0] == 0
        told[len(folders)] = static(tmp_path / "x.rrd", "/difference")["TextDocument:text"][0]
    words = "What would help late: without the 0.5 s of latency (now): known 0.50 s earlier."
    assert words in told[1]
    assert "What would help" not in told[2]


class TestRefusals:
    """One line, exit code 2, and nothing is written."""

    @pytest.mark.parametrize(
        ("options", "said"),
        [
            (["--rrd", "ab.html"], "ab.html: expected a name that ends with .rrd, found ab.html"),
            (["--rrd", "a/replay.rrd"],
             "a/replay.rrd: expected another name, found that of a recording of the results in a"),
            (["--run", "1"], "--run: expected --rrd FILE with it, found none"),
            (["--log", "drive"], "--log: expected --rrd FILE with it, found none"),
            (["--rrd", "ab.rrd", "--run", "2"], "--run: expected 0 to 1, the runs that all folders have, found 2"),
            (["--rrd", "ab.rrd", "--run", "-1"], "--run: expected 0 to 1, the runs that all folders have, found -1"),
            (["--rrd", "ab.rrd", "--log", "dive"], "--log: expected one of drive, found 'dive'"),
        ],
    )  # fmt: skip
    def test_options(self, call: Compare, tmp_path: Path, options: list[str], said: str) -> None:
        assert call("compare", "a", "b", "--baseline", "b:PEM", *options) == (2, [said])
        assert not list(tmp_path.rglob("*.rrd"))

    def test_a_log_that_is_gone_or_another_one(self, call: Compare, tmp_path: Path) -> None:
        asked = ("compare", "a", "b", "--baseline", "b:PEM", "--rrd", "ab.rrd")
        (tmp_path / "drive.mcap").rename(tmp_path / "aside.mcap")
        code, (line,) = call(*asked)
        assert code == 2
        assert "drive.mcap: cannot be opened: No such file or directory; put the log back" in line
        drive(tmp_path / "drive.mcap", first=5)
        code, (line,) = call(*asked)
        assert code == 2
        assert "drive.mcap: expected the log that was replayed, SHA-256" in line
        assert not (tmp_path / "ab.rrd").exists()

    def test_folders_that_are_not_comparable(self, call: Compare, tmp_path: Path) -> None:
        assert call("run", "a.yaml", "--seed", "2", "--out", "other")[0] == 0
        code, lines = call("compare", "other", "b", "--baseline", "b:PEM", "--rrd", "ab.rrd")
        assert (code, lines) == (2, ["b: seed: expected 2 as in other, found 1"])
        assert not (tmp_path / "ab.rrd").exists()

    def test_results_that_do_not_come_out_again(self, call: Compare, tmp_path: Path) -> None:
        table = pd.read_parquet(unseal(Path("a")) / "detections.parquet")
        table.loc[table["configuration"] == "PEM", "detection_s"] += 0.1
        table.to_parquet("a/detections.parquet")
        code, (line,) = call("compare", "a", "b", "--baseline", "b:PEM", "--rrd", "ab.rrd")
        assert (code, line) == (
            2, "a: log drive: run 0 comes out otherwise than in detections.parquet: another version, or another "
            "kind of processor, made it; run the experiment again with --overwrite",
        )  # fmt: skip
        assert not (tmp_path / "ab.rrd").exists()

    def test_another_world_is_said(self, call: Compare, tmp_path: Path) -> None:
        house = "obstacles: [{polygon_m: [[0, 60], [9, 60], [9, 70]], height_m: 9}]"
        (tmp_path / "d.yaml").write_text(text(80, [0.0, 0.0], house))
        assert call("run", "d.yaml", "--out", "d")[0] == 0
        code, lines = call("compare", "d", "b", "--baseline", "b:PEM", "--rrd", "bd.rrd")
        assert (code, lines[-1]) == (0, "note: bd.rrd: obstacles differ; those of b are shown")


def experiment(unit: dict[str, Any], range_m: float) -> Experiment:
    late = {"ego": 0.1, "default": 0.2}
    return Experiment.model_validate(
        {
            "version": 1,
            "logs": ["x.mcap"],
            "pems": {"p": [{"when": {"range_m": [0, range_m]}, "detection": {"kind": "visible_share"}}]},
            "units": {"ego": {"on": "ego", "pem": "p"}, "mast": unit | {"pem": "p"}},
            "configurations": {"GT": {"units": "truth"}, "PEM": {"units": "all", "latency_s": late}},
        }
    )


def test_units_of_one_name_are_one_only_where_they_are_the_same() -> None:
    east, west = ({"at": [x, 0], "height_m": 5.0} for x in (5, -5))
    same, moved, blind = experiment(east, 50), experiment(west, 50), experiment(east, 20)
    labels = {"PEM": "a:PEM", "GT": "GT"}
    both = join_experiments([ComparedExperiment("a", same, labels), ComparedExperiment("b", same, {"PEM": "b:PEM"})])
    assert list(both.units) == ["ego", "mast"]
    assert list(both.configurations) == ["a:PEM", "GT", "b:PEM"]
    both = join_experiments(
        [
            ComparedExperiment("a", same, labels),
            ComparedExperiment("b", moved, {"PEM": "b:PEM"}),
            ComparedExperiment("c", blind, {"PEM": "c:PEM"}),
        ]
    )
    assert list(both.units) == ["ego", "mast", "b:mast", "c:ego", "c:mast"]
    assert both.units["b:mast"].at == (-5, 0)
    pems = [both.pems[str(both.units[name].pem)] for name in ("mast", "b:mast", "c:mast")]
    assert [couple.when.range_m for pem in pems for couple in pem.couples] == [(0, 50), (0, 50), (0, 20)]
    assert both.units_of(both.configurations["b:PEM"]) == ("ego", "b:mast")
    assert both.units_of(both.configurations["GT"]) == ()
    assert [both.configurations["c:PEM"].latency_of(unit) for unit in ("c:ego", "c:mast")] == [0.1, 0.2]
