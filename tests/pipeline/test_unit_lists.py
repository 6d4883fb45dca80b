"""Lists of units in replay.mcap: another fusion is given what ours got, and ours gives the same of them again."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import shapely
from mcap.reader import make_reader
from osi3.osi_sensordata_pb2 import SensorData

import copem_replay as cr
from copem_replay.api.study import make_study
from copem_replay.core.tracks import TimeChunk
from copem_replay.io.write.detail import ReadyLists
from copem_replay.pipeline.one_run import replay_run
from tests.io.test_write_ros2 import drive

ROOT = Path(__file__).parents[2]
LOG = ROOT / "logs/tc016d.mcap"
GAUSSIAN = {"kind": "gaussian", "covariance_m2": [[0.2, 0.05], [0.05, 0.1]], "yaw_sigma_deg": 2, "speed_sigma_mps": 0.3}
PEM: dict[str, Any] = {
    "couples": [
        {"when": {"range_m": [2, 60], "azimuth_deg": [-60, 60]}, "detection": {"kind": "visible_share"},
         "error": GAUSSIAN, "existence": {"kind": "scores", "real": [8, 2], "ghost": [2, 4]}},
        {"when": {"range_m": [5, 30]}, "detection": {"kind": "constant", "probability": 0.9}, "error": GAUSSIAN},
    ],
    "ghosts": [{"in_list": 0.5, "lasts_s": 0.5, "where": {"kind": "places", "at_m": [[-60, 20]], "spread_m": 3.0}}],
    "tracks": {"lasts_s": 1.0},
}  # fmt: skip
LATE = {"kind": "gamma", "min_s": 0.02, "mean_s": 0.06, "shape": 2}
UNITS: dict[str, Any] = {
    "car": {"on": "ego", "height_m": 1.8, "pem": "any"},
    "mast": {"at": [0.0, 9.0], "yaw_deg": -90.0, "height_m": 5.0, "rate_hz": 5.0, "pem": "any", "ready": LATE},
}
GNN = {"units": ["car", "mast"], "fusion": {"kind": "gnn"}}
LINKS = {"lossy": {"latency": LATE | {"mean_s": 0.9}, "reception": {"kind": "constant", "probability": 0.7}}}


def experiment(log: Path, units: Mapping[str, Any] = UNITS, **more: Any) -> dict[str, Any]:
    pems = {"pems": {"any": PEM}} if any("pem" in unit for unit in units.values()) else {}
    return {"version": 1, "logs": [str(log)], "runs": 1, "units": units, "configurations": {"gnn": GNN}} | pems | more


def fused(data: dict[str, Any], log: Path) -> pd.DataFrame:
    """The entries of our gnn, in an order of their content."""
    table = cr.fused_tracks(data, log)["gnn"].to_dataframe().drop(columns=["track_id"])
    return table.sort_values(["available_s", "x_m", "y_m"], ignore_index=True)


def replayed(folder: Path, data: dict[str, Any]) -> Path:
    cr.run(data).save(folder)
    return folder / "replay.mcap"


def given_again(path: Path, **more: Any) -> pd.DataFrame:
    units = {name: {"recorded": {"topic": f"copem/units/{name}/objects"}} for name in UNITS}
    return fused(experiment(path, units, **more), path)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    late = {"late": GNN | {"latency_s": 0.5}}
    return replayed(tmp_path_factory.mktemp("lists") / "r", experiment(LOG, configurations={"gnn": GNN, **late}))


def messages(path: Path, topic: str) -> list[bytes]:
    with path.open("rb") as file:
        return [message.data for _, _, message in make_reader(file).iter_messages(topics=[topic])]


def test_our_gnn_gives_the_same_lists_of_them_again(path: Path) -> None:
    before, after = fused(experiment(LOG), LOG), given_again(path)
    assert len(before) > 500
    pd.testing.assert_frame_equal(before, after, rtol=0, atol=1e-9)


def test_so_it_does_where_messages_are_those_of_ros(tmp_path: Path) -> None:
    """Their existence and classes have single precision; there are cylinders, and ids."""
    log, ego = drive(tmp_path / "drive.mcap"), {"topic": "/odom", "size_m": [4.0, 1.8, 1.5]}
    path = replayed(tmp_path / "r", experiment(log, ego=ego))
    before, after = fused(experiment(log, ego=ego), log), given_again(path, ego=ego, read={"topic": "/tracks"})
    assert len(before) > 50
    pd.testing.assert_frame_equal(before, after, rtol=0, atol=1e-9)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    schemas = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    assert schemas["copem/units/mast/objects"] == "autoware_perception_msgs/msg/TrackedObjects"
    assert schemas["copem/gnn/objects"] == "autoware_perception_msgs/msg/DetectedObjects"


def test_messages_say_when_and_of_what_each_list_is(path: Path) -> None:
    lists = [SensorData.FromString(data) for data in messages(path, "copem/units/mast/objects")]
    details = [json.loads(data) for data in messages(path, "copem/units/mast/detail")]
    assert len(lists) == len(details) == 41
    ghosts = 0
    for told, detail in zip(lists, details, strict=True):
        ready_ns, captured_ns = (t.seconds * 10**9 + t.nanos for t in (told.timestamp, told.last_measurement_time))
        assert (ready_ns, captured_ns) == (detail["available_ns"], detail["captured_ns"])
        assert captured_ns % 200_000_000 == 0
        assert ready_ns >= captured_ns + 20_000_000
        assert detail["arrives_ns"]["gnn"] == ready_ns
        assert abs(detail["arrives_ns"]["late"] - ready_ns - 500_000_000) <= 1
        for item, entry in zip(told.moving_object, detail["objects"], strict=True):
            origin = [one.value for one in item.header.ground_truth_id]
            assert [str(one) for one in origin] == ([] if entry["id"] is None else [entry["id"]])
            assert item.header.HasField("tracking_id")
            if not origin:
                ghosts += 1
                assert np.hypot(item.base.position.x + 60, item.base.position.y - 20) < 20
    assert ghosts > 5
    assert not any(entry["id"] == "1" for detail in details for entry in detail["objects"]), "the ego itself"


def test_fields_of_view_are_detection_areas(path: Path) -> None:
    first = SensorData.FromString(messages(path, "copem/units/mast/objects")[0]).virtual_detection_area
    areas = [shapely.Polygon([(v.x, v.y) for v in polygon.vertex]) for polygon in first.polygon]
    assert [area.is_valid or area.buffer(0).is_valid for area in areas] == [True, True]
    # The mast looks south from (0, 9): 2 … 60 m over 120°, and all around from 5 to 30 m; chords of 9° are off by .3 %.
    assert [area.area for area in areas] == pytest.approx(
        [np.pi / 3 * (60**2 - 2**2), np.pi * (30**2 - 5**2)], rel=0.01
    )
    ahead, around = areas
    assert all(ahead.contains(shapely.Point(at)) for at in [(0, -50), (40, -16)])
    assert not any(ahead.contains(shapely.Point(at)) for at in [(0, 20), (0, 8), (45, 0), (0, -52)])
    around = shapely.make_valid(around)
    assert around.contains(shapely.Point(0, 35))
    assert not around.contains(shapely.Point(0, 12))
    # The car's moves with it.
    x = [
        np.mean([v.x for v in SensorData.FromString(data).virtual_detection_area.polygon[1].vertex])
        for data in messages(path, "copem/units/car/objects")
    ]
    assert np.diff(x) == pytest.approx(1.0, abs=0.02)  # 10 m/s at 10 Hz


def test_they_can_be_left_out(tmp_path: Path) -> None:
    path = replayed(tmp_path / "r", experiment(LOG, show={"units": False}))
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert not any(channel.topic.startswith("copem/units/") for channel in summary.channels.values())


def unit_lists(data: dict[str, Any], *cuts_s: float) -> Iterator[list[ReadyLists]]:
    study = make_study(data, LOG)
    one = replay_run(study.recordings[0], study.experiment, 0)
    bounds = [-np.inf, *cuts_s, np.inf]
    chunks = tuple(map(TimeChunk, bounds[:-1], bounds[1:]))
    run_tracks = replace(one.run_tracks, replay=replace(one.replay, chunks=chunks))
    return (chunk.unit_lists() for chunk in run_tracks.chunks())


@pytest.mark.parametrize("fusion", ["gnn", "ideal"])
def test_they_are_the_same_in_time_chunks_and_have_what_fusions_do_not_need(fusion: str) -> None:
    """Lists that are ready in a chunk may arrive far later, or never, so that no receiver needs them in it."""
    data = experiment(LOG, links=LINKS, configurations={"c": GNN | {"link": "lossy"}})
    if fusion == "ideal":  # alone, it draws neither ghosts nor ids
        units = {name: {key: value for key, value in of.items() if key != "ready"} for name, of in UNITS.items()}
        data = experiment(LOG, units, configurations={"c": {"units": ["car", "mast"], "latency_s": 0.9}})
    [whole] = unit_lists(data)
    parts = list(unit_lists(data, 1.93, 2.0, 5.05))
    assert [one.name for one in whole] == ["car", "mast"]
    for k, one in enumerate(whole):
        of_parts = [part[k] for part in parts]
        for name in ("x_m", "y_m", "cov_en_m2", "yaw_rad"):
            joined = np.concatenate([getattr(part.lists.fused, name)[0] for part in of_parts])
            np.testing.assert_array_equal(joined, getattr(one.lists.fused, name)[0])
        np.testing.assert_array_equal(np.concatenate([p.arrives_s["c"] for p in of_parts]), one.arrives_s["c"])
        assert (one.lists.fused.row_object_ix < 0).any(), "ghosts"
        assert one.lists.said is not None
        assert (one.lists.said["track_id"] >= 0).all()
        assert np.isinf(one.arrives_s["c"]).any() == (fusion == "gnn")


def test_a_clock_that_is_off_is_in_what_lists_state(tmp_path: Path) -> None:
    units = UNITS | {"mast": UNITS["mast"] | {"clock": {"offset_sigma_s": 0.05}}}
    details = messages(replayed(tmp_path / "r", experiment(LOG, units)), "copem/units/mast/detail")
    off_ns = {
        detail["captured_ns"] - detail["true_captured_ns"]
        for detail in map(json.loads, details)
        if detail["captured_ns"] != detail["available_ns"]  # no list states a capture after it is ready
    }
    assert len(off_ns) == 1
    assert abs(off_ns.pop()) > 1_000_000
