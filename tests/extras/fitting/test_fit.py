"""`copem-replay fit` as a whole: a known model is replayed, its lists are fitted, and what comes out runs again."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.core.errors import InputError
from copem_replay.core.yaml import dump_yaml, parse_yaml
from copem_replay.experiment.schema import Experiment
from tests.helpers.recordings import SHARED
from tools import check_fit

CROSSING = Path(__file__).parents[3] / "logs/crossing.mcap"
FILES = {
    "experiment.yaml", "fit.html", "fit.json", "places.rrd", "pem.yaml", "provenance.json", "rows.parquet",
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the unit `rsu`, and an experiment that names it."""
    place = tmp_path_factory.mktemp("fit")
    check_fit.write_lists(CROSSING, *check_fit.KNOWN["radar"], 3, place / "radar.mcap")
    unit = {"rsu": check_fit.PLACE | {"recorded": {"topic": check_fit.TOPIC}}}
    data = check_fit.experiment_of(unit, {"recorded": {"units": ["rsu"]}}, logs=["radar.mcap"], window_s=[0, 30])
    (place / "radar.yaml").write_text(dump_yaml(data))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert called(patch, "fit", "radar.yaml", "--unit", "rsu", "--out", "one") in (0, 1)
    return place


def called(patch: pytest.MonkeyPatch, *arguments: str) -> int:
    patch.setattr(sys, "argv", ["copem-replay", *arguments])
    return cli._run_to_exit_code()


def told(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err.strip()


def test_all_files_are_there(folder: Path) -> None:
    assert {path.name for path in (folder / "one").iterdir()} == FILES
    assert set(json.loads((folder / "one/provenance.json").read_text())["files"]) == FILES


def test_the_model_is_ready_to_paste(folder: Path) -> None:
    """It loads, and behind every number of it stands what is known of it."""
    text = (folder / "one/pem.yaml").read_text()
    data, _, problems = parse_yaml(text)
    assert not problems
    experiment = Experiment.model_validate(
        {"version": 1, "configurations": {"fitted": {"units": ["rsu"]}}} | data
    )  # fmt: skip
    assert experiment.units["rsu"].at == (12.4, 12.4)
    assert {"couples", "memory", "ghosts", "classes", "tracks"} <= data["pems"]["rsu"].keys()
    numbers = [line for line in text.splitlines() if re.search(r": -?[0-9.]+$", line)]
    kept = ("at:", "yaw_deg:", "height_m:")  # where the unit is, as the experiment says
    assert [line for line in numbers if not line.strip().startswith(kept)] == []


def test_the_experiment_runs_as_it_is(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    experiment = cr.load_experiment("one/experiment.yaml")
    assert (experiment.runs, set(experiment.configurations)) == (500, {"recorded", "fitted"})
    late = experiment.configurations["fitted"].latency_s
    assert isinstance(late, dict)
    assert late["rsu"] == pytest.approx(check_fit.DELAY_S, abs=0.03)
    assert called(monkeypatch, "run", "one/experiment.yaml", "--runs", "3", "--out", "run") == 0
    assert called(monkeypatch, "compare", "run", "--baseline", "recorded") == 0
    table = pd.read_parquet("run/detections.parquet").groupby("configuration")["detection_s"]
    assert table.count()["fitted"] > 0.8 * table.count()["recorded"] > 0


def test_rows_have_a_list_and_a_true_object_each(folder: Path) -> None:
    rows = pd.read_parquet(folder / "one/rows.parquet")
    assert not rows.duplicated(["list", "object_id"]).any()
    assert rows.loc[~rows["listed"], "error_along_m"].isna().all()
    assert rows.loc[rows["listed"], "error_along_m"].notna().mean() > 0.8
    assert rows["range_m"].max() <= 70.0


@pytest.mark.long
def test_it_is_replaced_only_when_asked_and_by_the_same_bytes(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    same = sorted(FILES - {"fit.html", "places.rrd"})
    before = [(folder / "one" / name).read_bytes() for name in same]
    again = ("fit", "radar.yaml", "--unit", "rsu", "--out", "one")
    assert called(monkeypatch, *again) == 2
    assert "results are there already; --overwrite replaces them" in told(capsys)
    assert called(monkeypatch, *again, "--overwrite") in (0, 1)
    assert [(folder / "one" / name).read_bytes() for name in same] == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--unit", "mast"), "unit mast: expected a unit whose lists are recorded (rsu), found no such unit"),
        (("--unit", "rsu", "--hold-out", "x"), "--hold-out x: expected a log of the experiment (radar)"),
        (("--unit", "rsu", "--hold-out", "radar"), "--hold-out: expected a log that is left to fit, found all"),
        (("--unit", "rsu", "--truth", "all"), "--truth: expected partial or complete, found all"),
        (("--unit", "rsu", "--by", "range,colour"), "--by: expected some of range, visible_share, class, azimuth;"),
        (("--unit", "rsu", "--delay-by", "colour"), "--delay-by: expected log or class, found colour"),
        (("--unit", "rsu", "--hold-out", "radar", "--folds", "3"), "--folds: expected either folds or logs to hold"),
    ],
)  # fmt: skip
def test_what_cannot_be_fitted_is_said_in_a_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: Any, said: str
) -> None:
    monkeypatch.chdir(folder)
    assert called(monkeypatch, "fit", "radar.yaml", *options, "--out", "refused") == 2
    found = told(capsys)
    assert found.startswith(said)
    assert "\n" not in found
    assert not (folder / "refused").exists()


def test_a_typo_names_the_units_whatever_the_lists_state() -> None:
    unit = {"rsu": check_fit.PLACE | {"recorded": {"topic": check_fit.TOPIC}}}
    data = check_fit.experiment_of(unit, {"recorded": {"units": ["rsu"]}}, logs=["missing.mcap"])
    with pytest.raises(InputError, match=r"^unit rsuu: expected .* lists are recorded \(rsu\), found no such unit$"):
        cr.fit(data, "rsuu")


def test_check_says_what_a_fit_will_say(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    assert called(monkeypatch, "check", "radar.yaml") == 0
    start = "copem-replay fit --unit rsu: "
    lines = [line.removeprefix(start) for line in capsys.readouterr().out.splitlines() if line.startswith(start)]
    fitted = json.loads((folder / "one/fit.json").read_text())
    assert f"{fitted['matched']} entries of true objects in {fitted['passes']} passes" in lines[0]
    assert set(lines[1:]) <= set(fitted["notes"])


@pytest.mark.long
def test_numbers_that_were_put_in_are_inside_their_intervals(tmp_path: Path) -> None:
    """Four seeds; `python tools/check_fit.py` has forty of each, and prints how wide the intervals are."""
    found = []
    for name, seeds in (("camera", (0, 1)), ("radar", (0, 1))):
        for seed in seeds:
            path = check_fit.write_lists(CROSSING, *check_fit.KNOWN[name], seed, tmp_path / f"{name}.mcap")
            found.append(check_fit.inside(check_fit.fitted_to(path), *check_fit.KNOWN[name]))
    pairs = [pair for one in found for pair in one.values()]
    assert len(pairs) > 4 * 30
    assert sum(check_fit.holds(*pair) for pair in pairs) >= 0.9 * len(pairs)
    names = (
        "delay_s",
        "detection.memory.share",
        "errors.memory.position.0.share",
        "ghosts.sorts.0.in_list",
        "ids_last_s",
    )
    assert all(name in one for one in found for name in names)


@pytest.mark.long
@pytest.mark.skipif(not (SHARED / "msight_trial14.mcap").exists(), reason="no shared/data beside the project")
def test_a_real_roadside_unit() -> None:
    """Its delay is told, its traffic is not taken for ghosts, and its misses come in runs: without memory it fails."""
    logs = [str(SHARED / f"msight_trial{k}.mcap") for k in (3, 4, 5, 14, 15)]
    fitted = check_fit.fitted_unit(logs, hold_out=["msight_trial3", "msight_trial5"])
    delay = fitted.estimates["delay_s"]
    assert delay.low < 0.19 < delay.high
    assert fitted.found.truth == "partial"
    assert not fitted.found.parts.rest.ghosts.sorts
    checks = fitted.found.checks
    assert checks is not None
    assert checks.held_out
    assert {one.verdict for one in checks.fitted} == {"too few passes to tell"}
    assert all(one.inside < len(one.pit) for one in checks.memoryless)


@pytest.mark.long
@pytest.mark.skipif(not (SHARED / "msight_trial14.mcap").exists(), reason="no shared/data beside the project")
def test_few_passes_of_a_real_unit_are_no_thousand_rows() -> None:
    """Neighbours correlate by .84 to .99 in four drives: a mean is that of a handful of errors, which last."""
    logs = [str(SHARED / f"msight_trial{k}.mcap") for k in ("3", "4", "5", "11_ped")]
    found = check_fit.fitted_unit(logs).found.parts.errors
    assert found.memory["position"]
    for mean in (mean for one in found.bins for mean in one.mean_m):
        assert mean.n_effective < 30
        assert mean.high - mean.low > 0.2


@pytest.mark.long
@pytest.mark.skipif(not (SHARED / "msight_trial14.mcap").exists(), reason="no shared/data beside the project")
def test_a_delay_of_each_log(tmp_path: Path) -> None:
    """Three drives say .12 to .15 s, a fourth .47 s: said with their values, and by log each is read at its own."""
    logs = [str(SHARED / f"msight_trial{k}.mcap") for k in ("3", "4", "5", "11_ped")]
    fitted = check_fit.fitted_unit(logs, delay_by="log", simplest=True)
    [note] = [note for note in fitted.notes if note.startswith("delays contradict each other")]
    assert "0.147 s in msight_trial3" in note
    assert "0.469 s in msight_trial11_ped" in note
    folder = fitted.save(tmp_path / "fit")
    experiment = cr.load_experiment(folder / "experiment.yaml")
    delays = [entry.units["rsu_recorded"]["recorded"]["delay_s"] for entry in experiment.logs]  # type: ignore[union-attr]
    assert delays == pytest.approx([0.147, 0.137, 0.119, 0.469], abs=1e-3)


@pytest.mark.long
@pytest.mark.skipif(not (SHARED / "msight_trial14.mcap").exists(), reason="no shared/data beside the project")
def test_a_delay_of_each_class(tmp_path: Path) -> None:
    """Three drives have a car, a fourth a pedestrian: each is read at the delay of its class, one is replayed."""
    logs = [str(SHARED / f"msight_trial{k}.mcap") for k in ("3", "4", "5", "11_ped")]
    fitted = check_fit.fitted_unit(logs, delay_by="class", simplest=True, hold_out=["msight_trial5"])
    car, walk = (fitted.estimates[f"delay_s.{kind}"] for kind in ("car", "pedestrian"))
    assert walk.value == pytest.approx(0.469, abs=1e-3)
    assert car.low < 0.14 < car.high < walk.low
    folder = fitted.save(tmp_path / "fit")
    assert f"delay of entries about a pedestrian: {walk.words()}" in (folder / "pem.yaml").read_text()
    [held_out] = cr.load_experiment(folder / "experiment.yaml").logs
    assert held_out.units["rsu_recorded"]["recorded"]["delay_s"] == pytest.approx(car.value, abs=1e-6)  # type: ignore[union-attr]
