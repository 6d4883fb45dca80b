"""Truth and held lists for TrackEval and nuScenes: figures by hand, held against what the tools compute."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from pyarrow import parquet
from typer.testing import CliRunner

from copem_replay.cli.main import app
from copem_replay.core.errors import InputError
from copem_replay.extras.exports.track_files import write_nuscenes, write_trackeval
from tests.helpers.experiments import changed, drive
from tests.helpers.kits import ask_kit
from tests.system.test_cli import Call, call

__all__ = ["call"]  # a fixture

KNOWN = changed(
    "pems: {near: [{when: {range_m: [0, 50.5]}, detection: {kind: constant, probability: 1}}], "
    "far: [{when: {range_m: [0, 80]}, detection: {kind: constant, probability: 1}}]}",
    "units: {near: {on: ego, height_m: 1.8, pem: near}, far: {on: ego, height_m: 1.8, pem: far}}",
    "configurations: {GT: {units: truth}, near: {units: [near]}, late: {units: [far], latency_s: 0.1}, "
    "nameless: {units: [near], fusion: {kind: gnn}}}",
    "show: {run: 0}",
)
KNOWN = "\n".join(line for line in KNOWN.splitlines() if not line.startswith("  ") and not line.startswith("    - "))
"""The car has its onset 60 m away, at 1 s of 3 s: 21 frames. `near` lists it from 50 m, 2 s: 11 frames of them."""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracked")
    drive(folder / "drive.mcap")
    (folder / "experiment.yaml").write_text(KNOWN)
    done = CliRunner().invoke(app, ["run", str(folder / "experiment.yaml"), "--out", str(folder / "out")])
    assert done.exit_code == 0, done.output
    return folder / "out"


def rows(file: Path) -> list[list[float]]:
    return [[float(cell) for cell in line.split(",")] for line in file.read_text().splitlines()]


def test_trackeval_has_the_episodes_and_what_is_held(results: Path, call: Call) -> None:
    assert call("export", results, "--trackeval").code == 0
    folder = results / "trackeval"
    truth = rows(folder / "gt/copem-all/drive/gt/gt.txt")
    assert [row[0] for row in truth] == list(range(11, 32))  # the first instant is frame 1
    width = truth[0][5]
    assert truth[0] == pytest.approx([11, 1, 58, -width / 2, 4, width, 1, 1, 1])
    assert "seqLength=31" in (folder / "gt/copem-all/drive/seqinfo.ini").read_text()
    assert (folder / "gt/seqmaps/copem-all.txt").read_text() == "name\ndrive\n"
    trackers = folder / "trackers/copem-all"
    assert sorted(path.name for path in trackers.iterdir()) == ["GT", "late", "nameless", "near"]
    assert [row[:6] for row in rows(trackers / "GT/data/drive.txt")] == [row[:6] for row in truth]
    near = rows(trackers / "near/data/drive.txt")
    assert [row[0] for row in near] == list(range(21, 32))
    assert {row[1] for row in near} == {1}
    late = rows(trackers / "late/data/drive.txt")
    assert [row[2] for row in late] == pytest.approx([row[2] + 1 for row in truth])  # 0.1 s at 10 m/s
    made = (results / "made.jsonl").read_text()
    assert '"trackeval/gt/seqmaps/copem-all.txt"' in made


OF_TRACKEVAL = """
import json, sys, trackeval
quiet = ("PRINT_RESULTS", "PRINT_CONFIG", "TIME_PROGRESS", "OUTPUT_SUMMARY", "OUTPUT_DETAILED", "PLOT_CURVES")
judge = trackeval.Evaluator({**dict.fromkeys(quiet, False), "OUTPUT_EMPTY_CLASSES": False, "BREAK_ON_ERROR": True})
folders = {"GT_FOLDER": sys.argv[1] + "/gt", "TRACKERS_FOLDER": sys.argv[1] + "/trackers"}
names = {"BENCHMARK": "copem", "SPLIT_TO_EVAL": "all", "DO_PREPROC": False, "PRINT_CONFIG": False}
data = trackeval.datasets.MotChallenge2DBox({**folders, **names})
said = {"PRINT_CONFIG": False}
found, _ = judge.evaluate([data], [trackeval.metrics.HOTA(), trackeval.metrics.Identity(said)])
print(json.dumps({
    name: [float((of := one["COMBINED_SEQ"]["pedestrian"])["HOTA"]["HOTA"].mean()), float(of["Identity"]["IDF1"])]
    for name, one in found["MotChallenge2DBox"].items()
}))
"""


def test_trackeval_computes_what_a_hand_does(results: Path) -> None:
    write_trackeval(results)
    found = ask_kit("trackeval", OF_TRACKEVAL, results / "trackeval")
    assert found["GT"] == pytest.approx([1, 1])
    # 11 of 21 frames, one identity: DetA = AssA = 11/21, HOTA is the root of their product; IDF1 = 2·11 / (2·11 + 10).
    assert found["near"] == pytest.approx([11 / 21, 22 / 32])
    # The same entries without identities: each is a track of one frame. AssA = 1/21, and one of them is the object's.
    assert found["nameless"] == pytest.approx([math.sqrt(11 / 21 / 21), 2 / 32])
    # 1 m behind, of 4 m: an overlap of 3/5. HOTA is 1 at the 12 thresholds 0.05 … 0.60, and 0 at the 7 above them.
    assert found["late"] == pytest.approx([12 / 19, 1])


def test_nuscenes_has_the_same(results: Path, call: Call) -> None:
    assert call("export", results, "--nuscenes", "--out", results.parent / "n").code == 0
    found = {path.stem: json.loads(path.read_text()) for path in (results.parent / "n").iterdir()}
    assert sorted(found) == ["GT", "late", "nameless", "near", "truth"]
    assert all(
        set(one["meta"]) == {f"use_{n}" for n in ("camera", "lidar", "radar", "map", "external")}
        for one in found.values()
    )
    truth, near = found["truth"]["results"], found["near"]["results"]
    assert list(truth) == list(near)
    assert len(truth) == 31
    assert sum(map(len, truth.values())) == 21
    assert sum(map(len, near.values())) == 11
    (box,) = list(truth.values())[10]
    assert box["translation"][:2] == pytest.approx([60, 0])
    assert box["velocity"] == pytest.approx([-10, 0])
    assert box["rotation"] == pytest.approx([0, 0, 0, 1], abs=1e-9)  # it faces the ego
    assert (box["tracking_name"], box["tracking_id"], box["tracking_score"]) == ("car", "2", 1)
    assert box["size"][0] < box["size"][1]  # width, length, height


OF_NUSCENES = """
import json, sys
from nuscenes.eval.common.config import config_factory
from nuscenes.eval.common.loaders import load_prediction
from nuscenes.eval.tracking.data_classes import TrackingBox
config_factory("tracking_nips_2019")  # which knows the names of classes
boxes, meta = load_prediction(sys.argv[1], 500, TrackingBox)
print(json.dumps([len(boxes.sample_tokens), len(boxes.all)]))
"""


def test_the_kit_of_nuscenes_reads_them(results: Path) -> None:
    files, notes = write_nuscenes(results)
    assert notes == []
    assert [ask_kit("nuscenes", OF_NUSCENES, file) for file in files[:3]] == [[31, 21], [31, 21], [31, 11]]


def test_the_same_bytes_again_and_other_runs(results: Path) -> None:
    def texts() -> dict[str, bytes]:
        return {str(file): file.read_bytes() for file in [*write_trackeval(results)[0], *write_nuscenes(results)[0]]}

    assert texts() == texts()
    write_trackeval(results, run=3)
    with pytest.raises(InputError, match="--run: expected 0 to 3, found 4"):
        write_trackeval(results, run=4)


def test_export_asks_for_one_format(results: Path, call: Call) -> None:
    for words, said in (
        ([], "export: expected one format, --geojson, --trackeval or --nuscenes, found none"),
        (["--trackeval", "--nuscenes"], "found several"),
        (["--geojson", "--run", "1"], "--run: expected --trackeval or --nuscenes with it, found --geojson"),
    ):
        ended = call("export", results, *words)
        assert ended.code == 2
        assert said in ended.lines[-1]


def test_parquet_says_units(results: Path) -> None:
    units: dict[str, Any] = {}
    for path in results.glob("*.parquet"):
        for field in parquet.read_schema(path):
            units[field.name] = (field.metadata or {}).get(b"unit")
    assert units["detection_s"] == b"s"
    assert units["distance_at_detection_m"] == b"m"
    assert units["gospa_m2"] == "m²".encode()
    assert units["run"] is None
    assert units["configuration"] is None
