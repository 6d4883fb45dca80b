"""Anybody can recompute when objects are detected from `replay.mcap` alone, with links and clocks that are off."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_sensordata_pb2 import SensorData

import copem_replay as cr
from tests.helpers.recordings import Obj, write_recording

RUNS = 6
GATE_M = 3.0
TEXT = f"""\
version: 1
logs: [drive.mcap]
runs: {RUNS}
seed: 1
pems:
  onboard:
    - when: {{range_m: [0, 80]}}
      detection: {{kind: constant, probability: 0.5}}
      error: {{kind: gaussian, covariance_m2: [[0.2, 0.0], [0.0, 0.2]]}}
links:
  v2x:
    latency: {{kind: gamma, min_s: 0.1, mean_s: 0.3, shape: 2}}
    reception: {{kind: gilbert_elliott, bad_share: 0.3, bad_lasts_s: 0.3}}
units:
  ego: {{on: ego, height_m: 1.8, pem: onboard}}
  mast: {{at: [12.0, -4.5], height_m: 5.0, pem: onboard, clock: {{offset_sigma_s: 0.1}}}}
configurations:
  ideal: {{units: all, link: {{default: v2x, ego: none}}}}
  gnn: {{units: all, link: {{default: v2x, ego: none}}, fusion: {{kind: gnn}}}}
  ticks: {{units: [mast], link: v2x, fusion: {{kind: union}}, issue_hz: 7}}
measure: {{onset: {{kind: in_range, range_m: 60}}, match: {{gate_m: {GATE_M}}}}}
show: {{run: {list(range(RUNS))}}}
"""


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ego (1) stands; another car (2), 70 m ahead, drives towards it at 10 m/s for 3 s."""
    folder = tmp_path_factory.mktemp("links")
    frames = [(0.1 * k, [Obj(id=1, x=0.0), Obj(id=2, x=70.0 - k, vx=-10.0, yaw=math.pi)]) for k in range(31)]
    write_recording(folder / "drive.mcap", frames, host=1)
    (folder / "experiment.yaml").write_text(TEXT, encoding="utf-8")
    cr.run(folder / "experiment.yaml").save(folder / "out")
    return folder / "out"


def payloads(path: Path, topic: str) -> list[bytes]:
    with path.open("rb") as file:
        return [message.data for _, _, message in make_reader(file).iter_messages(topics=[topic])]


def truth(path: Path) -> tuple[list[float], list[tuple[float, float]], list[tuple[float, float]]]:
    """When frames are, seconds of the log's clock, and where the ego (1) and the car (2) are."""
    frames = [GroundTruth.FromString(data) for data in payloads(path, "truth")]
    places: dict[int, list[tuple[float, float]]] = {1: [], 2: []}
    for frame in frames:
        for one in frame.moving_object:
            if one.id.value in places:
                places[one.id.value].append((one.base.position.x, one.base.position.y))
    return [f.timestamp.seconds + f.timestamp.nanos * 1e-9 for f in frames], places[1], places[2]


def first_detection(
    path: Path, configuration: str, frame_s: Sequence[float], car: Sequence[tuple[float, float]], onset_s: float
) -> tuple[float, float] | None:
    """When the first list with an entry about the car is available, and the entry's capture; by match."""
    lists = payloads(path, f"copem/{configuration}/objects")
    details = payloads(path, f"copem/{configuration}/detail")
    assert len(lists) == len(details) > 0
    for data, said in zip(lists, map(json.loads, details), strict=True):
        objects = SensorData.FromString(data).moving_object
        assert len(objects) == len(said["objects"])
        about: list[float] = []
        for one, beside in zip(objects, said["objects"], strict=True):
            captured_s = beside["newest_captured_ns"] * 1e-9
            told_s = beside.get("stated_captured_ns", beside["newest_captured_ns"]) * 1e-9
            # The car keeps its speed: beyond the recording's first frame, too, where a clock says so.
            x_m, y_m = car[0][0] - 10.0 * (told_s - frame_s[0]), car[0][1]
            if (
                np.hypot(one.base.position.x - x_m, one.base.position.y - y_m) <= GATE_M
                and captured_s >= onset_s - 1e-6
            ):
                about.append(captured_s)
        if about and said["available_ns"] * 1e-9 <= frame_s[-1] + 1e-6:
            return said["available_ns"] * 1e-9, max(about)
    return None


@pytest.mark.parametrize("configuration", ["ideal", "gnn", "ticks"])
def test_detections_follow_from_the_recording_alone(out: Path, configuration: str) -> None:
    rows = pd.read_parquet(out / "detections.parquet").set_index(["configuration", "run", "object_id"])
    early = 0
    for run in range(RUNS):
        path = out / ("replay.mcap" if run == 0 else f"replay_{run}.mcap")
        frame_s, ego, car = truth(path)
        onset_s = next(t for t, a, b in zip(frame_s, ego, car, strict=True) if np.hypot(b[0] - a[0], b[1] - a[1]) <= 60)
        expected: Any = first_detection(path, configuration, frame_s, car, onset_s)
        found = rows.loc[(configuration, run, "2")]
        assert found["onset_s"] == pytest.approx(onset_s - frame_s[0], abs=1e-6)
        assert found["detected"] == (expected is not None)
        if expected is not None:
            got = found["detection_s"], found["captured_s"]
            assert got == pytest.approx([t - frame_s[0] for t in expected], abs=2e-6)
        # A capture before the onset does not count, which only the capture tells.
        anyhow = first_detection(path, configuration, frame_s, car, -np.inf)
        early += anyhow is not None and (expected is None or anyhow[0] < expected[0])
    assert early >= RUNS - 1


def test_stated_captures_are_there_where_a_clock_is_off(out: Path) -> None:
    for configuration, has in (("ideal", False), ("gnn", True), ("ticks", True)):
        objects = [
            one
            for data in payloads(out / "replay.mcap", f"copem/{configuration}/detail")
            for one in json.loads(data)["objects"]
        ]
        assert all(("stated_captured_ns" in one) == has for one in objects)
        if has:
            off_s = {round((one["stated_captured_ns"] - one["newest_captured_ns"]) * 1e-9, 4) for one in objects}
            # The mast's clock has one offset, and nothing is stated to be captured after it arrives; the ego's is true.
            assert off_s - {0.0}
            assert (0.0 in off_s) == (configuration == "gnn")
