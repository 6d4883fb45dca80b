"""The converters of data sets: Argoverse 2, ScenarioNet, OpenLABEL. A few rows each, all expected values by hand."""

from __future__ import annotations

import collections
import json
import math
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from osi3.osi_object_pb2 import StationaryObject
from pyarrow import feather

from copem_replay.core.errors import InputError
from copem_replay.core.frame import Frame
from copem_replay.io.convert import restricted_pickle
from copem_replay.io.recording import read_log
from tests.helpers.conversions import Runner, convert, run

__all__ = ["run"]

# Argoverse 2 ------------------------------------------------------------------------------------------------

T0 = 315966253660223000  # ns; not a Unix time
HALF = math.sqrt(0.5)
WEST_TO_NORTH = (HALF, 0.0, 0.0, HALF)  # w x y z: 90° counter-clockwise
NO_TURN = (1.0, 0.0, 0.0, 0.0)
Pose = tuple[float, float, float, float]


def pose(stamp: int, turn: Pose, *at: float) -> dict[str, Any]:
    return {
        "timestamp_ns": stamp,
        **dict(zip(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), (*turn, *at), strict=True)),
    }


def box(stamp: int, uuid: str, category: str, turn: Pose, *at: float) -> dict[str, Any]:
    size = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5, "num_interior_pts": 7}
    return {**pose(stamp, turn, *at), "track_uuid": uuid, "category": category, **size}


def av2_log(run: Runner, boxes: list[dict[str, Any]], poses: list[dict[str, Any]]) -> Path:
    log = run.folder / "log"
    log.mkdir()
    pd.DataFrame(boxes).to_feather(log / "annotations.feather")
    pd.DataFrame(poses).to_feather(log / "city_SE3_egovehicle.feather")
    return log


BOXES = [
    box(T0, "car-uuid", "REGULAR_VEHICLE", WEST_TO_NORTH, 10, 1, 0.5),
    box(T0 + 10**8, "car-uuid", "REGULAR_VEHICLE", NO_TURN, 10, 1, 0.5),
    box(T0 + 10**8, "cone-uuid", "CONSTRUCTION_CONE", NO_TURN, 5, -3, 0),
    box(T0 + 10**8, "odd-uuid", "HOVERCRAFT", NO_TURN, 20, 0, 0),
    box(T0 + 10**8, "ego-uuid", "EGO_VEHICLE", NO_TURN, 0, 0, 0),
    box(T0 + 2 * 10**8, "car-uuid", "REGULAR_VEHICLE", NO_TURN, 10, 1, 0.5),
]
POSES = [
    pose(T0, WEST_TO_NORTH, 100, 200, 20),
    pose(T0 + 50, WEST_TO_NORTH, 999, 999, 99),  # poses are at the rates of all sensors
    pose(T0 + 10**8, NO_TURN, 100, 201, 20),
]


def test_argoverse2_from_the_rear_axle_to_the_city(run: Runner) -> None:
    found = run("argoverse2", av2_log(run, BOXES, POSES))
    assert found.stamps_ns == [T0, T0 + 10**8]
    assert found.names == {"1": "EGO_VEHICLE", "2": "car-uuid", "3": "cone-uuid", "4": "odd-uuid"}
    # The ego faces north: 10 m ahead and 1 m to the left is 10 m north and 1 m west; north + 90° is west.
    names = ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    first, second = found.values("2", *names)
    assert [*first[:3], abs(first[3]), *first[4:]] == pytest.approx([99, 210, 20.5, math.pi, 4, 2, 1.5])
    assert second == pytest.approx([110, 202, 20.5, 0, 4, 2, 1.5])
    # The rear axle at (100, 200, 20): its centre is 1.339 m ahead, north, then east, and 0.438 m up.
    first, second = found.values("1", *names)
    assert first == pytest.approx([100, 201.339, 20.438, math.pi / 2, 4.877, 2, 1.473])
    assert second == pytest.approx([101.339, 201, 20.438, 0, 4.877, 2, 1.473])
    rear = found.messages[0].moving_object[0].vehicle_attributes.bbcenter_to_rear
    assert (rear.x, rear.y, rear.z) == (-1.339, 0, -0.438)
    assert found.recording.host_id == "1"
    assert found.class_of("2") == "car"
    assert found.class_of("4") == "other"
    (cone,) = found.messages[1].stationary_object
    assert cone.id.value == 3
    assert cone.classification.type == StationaryObject.Classification.TYPE_CONSTRUCTION_SITE_ELEMENT
    assert not any(moving.base.HasField("velocity") for message in found.messages for moving in message.moving_object)
    for note in (
        "1 annotated instant without an ego pose of the same time stamp: skipped",
        "1 object state of the unknown category HOVERCRAFT: taken as other",
        "1 row of category EGO_VEHICLE: replaced by the ego pose",
        "ego vehicle: id 1, 4.877×2×1.473 m, its centre 1.339, 0, 0.438 m (ahead, left, up) of the rear axle",
    ):
        assert f"note: {note}" in found.printed


def test_argoverse2_brings_the_lanes_of_its_map(run: Runner) -> None:
    """Two lanes side by side have three borders; in the first message alone. The crosswalk is at their height."""
    log = av2_log(run, BOXES, POSES)
    (log / "map").mkdir()

    def line(y: float) -> list[dict[str, float]]:
        return [{"x": x, "y": y, "z": 20.0} for x in (90.0, 110.0)]

    lanes = {
        name: {"left_lane_boundary": line(y), "right_lane_boundary": line(y - 3), "lane_type": kind}
        for name, y, kind in (("71", 6, "BIKE"), ("72", 3, "VEHICLE"))
    }
    crossing = {"edge1": [{"x": 95, "y": 0}, {"x": 95, "y": 6}], "edge2": [{"x": 98, "y": 0}, {"x": 98, "y": 6}]}
    site = {"lane_segments": lanes, "pedestrian_crossings": {"73": crossing}}
    (log / "map/log_map_archive_x____PIT_city_1.json").write_text(json.dumps(site))
    found = run("argoverse2", log)
    *borders, outline = found.recording.lane_boundaries
    assert [b[:, 1].tolist() for b in borders] == [[6, 6], [3, 3], [0, 0]]
    assert [(lane.id, lane.kind) for lane in found.recording.lanes] == [("71", "bicycle"), ("72", "driving")]
    assert found.recording.lanes[1].left_m.tolist() == [[90, 3, 20], [110, 3, 20]]
    assert found.messages[0].lane[1].classification.centerline[1].y == 1.5
    (area,) = found.recording.scene.areas
    assert (area.name, area.kind, set(area.rings_m[0])) == (
        "crosswalk 73",
        "crosswalk",
        {(95, 0), (95, 6), (98, 6), (98, 0)},
    )
    assert (outline[:, 2] == 20).all()
    later = found.messages[1]
    assert not any((later.lane_boundary, later.lane, later.road_marking))
    assert "note: 2 lanes of log_map_archive_x____PIT_city_1.json" in found.printed
    assert "note: 1 crosswalk of the map" in found.printed
    assert "place on earth: that of city PIT, by the name of log_map_archive_x____PIT_city_1.json" in found.printed
    place = found.recording.place_said
    assert place is not None
    origin = Frame(place.proj, place.offset_m).to_wgs84([(0.0, 0.0)])[0]  # as av2's geometry/utm.py has it
    assert origin == pytest.approx([40.44177902989321, -80.01294377242584], abs=1e-9)


def test_argoverse2_a_map_that_is_none_is_refused(run: Runner) -> None:
    log = av2_log(run, BOXES, POSES)
    (log / "map").mkdir()
    (log / "map/log_map_archive_x.json").write_text("[")
    assert "log_map_archive_x.json:1: expected JSON" in run.refused("argoverse2", log)


def test_argoverse2_a_quaternion_that_overflows_is_no_turn(run: Runner) -> None:
    found = run("argoverse2", av2_log(run, [{**BOXES[0], "qw": 1e200}, *BOXES[1:]], POSES))
    assert len(found.values(found.id_of("car-uuid"), "x_m")) == 1  # of two


def test_argoverse2_a_place_that_is_not_finite_is_skipped(run: Runner) -> None:
    found = run("argoverse2", av2_log(run, [{**BOXES[0], "tx_m": math.inf}, *BOXES[1:]], POSES))
    assert len(found.values(found.id_of("car-uuid"), "x_m")) == 1  # of two


def test_argoverse2_ego_of_another_size(run: Runner) -> None:
    options = ("--ego-size-m", "5", "2.1", "1.6", "--centre-from-rear-axle-m", "1.5", "0", "0.4")
    found = run("argoverse2", av2_log(run, BOXES, POSES), *options)
    row = found.values("1", "x_m", "y_m", "z_m", "length_m", "width_m", "height_m")[1]
    assert row == pytest.approx([101.5, 201, 20.4, 5, 2.1, 1.6])


def test_argoverse2_every_category_of_the_data_set_is_known() -> None:
    from copem_replay.io.convert.argoverse2 import _KIND
    from copem_replay.io.convert.conversion import KINDS

    assert len(_KIND) == 30  # AnnotationCategories of av2-api
    static = {name for name, kind in _KIND.items() if not KINDS[kind].moving}
    assert static == {
        *("BOLLARD", "CONSTRUCTION_BARREL", "CONSTRUCTION_CONE", "MOBILE_PEDESTRIAN_CROSSING_SIGN"),
        *("SIGN", "STOP_SIGN"),
    }


def test_argoverse2_refuses(run: Runner) -> None:
    log = av2_log(run, BOXES, POSES)
    annotations, poses = log / "annotations.feather", log / "city_SE3_egovehicle.feather"
    assert "expected the folder of an Argoverse 2 sensor log" in run.refused("argoverse2", annotations)
    table = pa.Table.from_pandas(pd.DataFrame(BOXES).drop(columns=["qx", "category"]))
    feather.write_feather(table.append_column("tx_m", table["tx_m"]), annotations)
    line = run.refused("argoverse2", log)
    assert line.startswith(f"{annotations}: expected the columns timestamp_ns, category")
    assert line.endswith(", once each; found no category, no qx, 2 tx_m")
    pd.DataFrame(BOXES).assign(tx_m="far").to_feather(annotations)
    assert "annotations.feather: column tx_m: expected double, found " in run.refused("argoverse2", log)
    pd.DataFrame(BOXES).assign(track_uuid=None).to_feather(annotations)
    assert "annotations.feather: column track_uuid: expected no gaps, found 6" in run.refused("argoverse2", log)
    pd.DataFrame(BOXES).assign(timestamp_ns=-1).to_feather(annotations)
    assert "no object to convert in 0 frames; ego vehicle: id 1" in run.refused("argoverse2", log)
    annotations.write_text("version https://git-lfs.github.com/spec/v1\n")
    assert "annotations.feather: expected a feather file, found" in run.refused("argoverse2", log)
    poses.unlink()
    assert "city_SE3_egovehicle.feather: no such file" in run.refused("argoverse2", log)


# ScenarioNet ------------------------------------------------------------------------------------------------


def track(kind: str, category: str, place: list[list[float]], **more: Any) -> dict[str, Any]:
    steps = len(place)
    state = {
        "position": np.array(place, dtype=float),
        "heading": np.zeros(steps),
        "velocity": np.zeros((steps, 2)),
        "valid": np.ones(steps),
        "length": np.full((steps, 1), 4.5),
        "width": np.full((steps, 1), 1.9),
        "height": np.full((steps, 1), 1.6),
    }
    return {"type": kind, "state": state | more, "metadata": {"type": category, "track_length": steps}}


def scenario(**tracks: Any) -> dict[str, Any]:
    metadata = {"dataset": "nuscenes", "ts": np.arange(0.0, 0.35, 0.1), "sdc_id": "ego", "map": "boston-seaport"}
    return {"id": "scene-0061", "version": "nuscenesv1.0-mini", "metadata": metadata, "tracks": tracks}


def ego() -> dict[str, Any]:
    return track(
        "VEHICLE",
        "vehicle.car",
        [[0, 0, 0], [0, 1, 0], [0, 2, 0], [0, 3, 0]],
        heading=np.full(4, math.pi / 2),
        velocity=np.array([[0, 10], [0, 10], [0, 10], [0, 0]]),
        length=np.full((4, 1), 1.73),
        width=np.full((4, 1), 4.08),
        height=np.full((4, 1), 1.56),
    )


def test_scenarionet_brings_lines_of_the_road_and_outlines_of_lanes(run: Runner) -> None:
    whole = scenario(ego=ego())
    whole["map_features"] = {
        "1": {"type": "ROAD_LINE_SOLID_SINGLE_WHITE", "polyline": np.array([[0.0, 1.0], [5.0, 1.0], [9.0, 1.0]])},
        "2": {
            "type": "LANE_SURFACE_STREET",
            "polyline": np.zeros((2, 2)),
            "polygon": [[0, 0, 4], [9, 0, 4], [9, 3, 4]],
        },
        "3": {"type": "LANE_SURFACE_STREET", "polyline": np.zeros((2, 2))},
    }
    found = run("scenarionet", run.file("s.pkl", pickle.dumps(whole)))
    assert [line.tolist() for line in found.recording.lane_boundaries] == [
        [[0, 1, 0], [9, 1, 0]], [[0, 0, 4], [9, 0, 4], [9, 3, 4]],
    ]  # fmt: skip
    assert "2 lines of the road taken as lane boundaries" in found.printed


@pytest.mark.parametrize(
    "points", [[[0, 1e300], [1, 1]], [[0, math.nan], [1, 1]], [0, 1], "x", [[1], [2]], [[10**400, 1]]]
)
def test_scenarionet_lines_that_are_none(run: Runner, points: Any) -> None:
    whole = scenario(ego=ego()) | {"map_features": {"1": {"type": "ROAD_EDGE_BOUNDARY", "polyline": points}}}
    said = run.refused("scenarionet", run.file("s.pkl", pickle.dumps(whole)))
    assert "map_features 1: polyline: expected rows of 2 or 3 numbers of at most 1e+08, found something else" in said


def test_scenarionet_ego_put_right(run: Runner) -> None:
    found = run("scenarionet", run.file("s.pkl", pickle.dumps(scenario(ego=ego()))))
    assert found.stamps_ns == [0, 100_000_000, 200_000_000, 300_000_000]  # arange gives 0.30000000000000004
    ident = found.id_of("ego")
    assert found.recording.host_id == ident
    # It heads north: the centre is 1.385 m north of the rear axle, and half a height above the ground.
    rows = found.values(ident, "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    assert rows[1] == pytest.approx([0, 2.385, 0.78, math.pi / 2, 4.08, 1.73, 1.56])
    assert [m.moving_object[0].base.HasField("velocity") for m in found.messages] == [True, True, True, False]
    assert found.values(ident, "vx_mps", "vy_mps")[3] == pytest.approx([0, 10])  # derived by the reader
    for note in (
        "4 states of the ego vehicle with length and width swapped (1.73×4.08 m): put right",
        "1 track at z = 0 throughout: taken as the ground, the centre half a height above",
        "position of the ego vehicle (ego): its rear axle, the centre 1.385 m ahead",
        "1 state at the ends of tracks with velocity 0: taken as not given",
    ):
        assert f"note: {note}\n" in found.printed


def test_scenarionet_ego_centre_is_an_option_and_nuscenes_own(run: Runner) -> None:
    source = run.file("s.pkl", pickle.dumps(scenario(ego=ego())))
    assert run("scenarionet", source, "--ego-centre-m", "0").values("1", "y_m")[0] == [0]
    other = scenario(ego=ego())
    other["metadata"]["dataset"] = "waymo"
    assert run("scenarionet", run.file("s.pkl", pickle.dumps(other))).values("1", "y_m")[0] == [0]


def test_scenarionet_valid_steps_and_categories(run: Runner) -> None:
    still = [[5.0, 5.0, 0.8]] * 4
    gone = track(
        "VEHICLE",
        "vehicle.truck",
        [[0, 0, 0], [7, 8, 1.5], [8, 8, 1.5], [0, 0, 0]],
        valid=np.array([0.0, 1, 1, 0]),
        heading=np.array([0, 3.5, 3.5, 0]),
        length=np.array([0, 8, 8, 0.0]),
    )
    tracks = {
        "a": gone,
        "b": track("PEDESTRIAN", "human.pedestrian.adult", still),
        "c": track("TRAFFIC_CONE", "movable_object.trafficcone", still),
        "d": track("VEHICLE", "vehicle.bus.rigid", still),
        "e": track("CYCLIST", "CYCLIST", still, position=np.array(still)[:, :2]),  # Waymo: no category, flat here
        "f": track("UNSET", "noise", still),
    }
    whole = scenario(**tracks)
    whole["metadata"]["timestep"] = whole["metadata"].pop("ts").astype(np.float32)
    found = run("scenarionet", run.file("s.pkl", pickle.dumps(whole, protocol=2)))
    assert found.stamps_ns == [0, 100_000_000, 200_000_000, 300_000_000]
    assert found.values("1", "x_m", "length_m") == [[7, 8], [8, 8]]
    assert found.values("1", "yaw_rad")[0] == pytest.approx([3.5 - 2 * math.pi])
    assert not any(
        moving.base.HasField("velocity") for moving in found.messages[1].moving_object if moving.id.value == 1
    )
    classes = {name: found.class_of(found.id_of(name)) for name in "abdef"}
    assert classes == {"a": "truck", "b": "pedestrian", "d": "bus", "e": "bicycle", "f": "other"}
    assert found.values(found.id_of("e"), "z_m")[0] == [0.8]
    assert not found.moves(found.id_of("c"))
    assert found.recording.host_id is None
    assert "note: no ego vehicle: no track ego (sdc_id)\n" in found.printed
    assert "note: 1 track of the unknown type 'UNSET': taken as other\n" in found.printed


def test_scenarionet_refuses_what_it_does_not_know(run: Runner) -> None:
    def line(whole: Any) -> str:
        return run.refused("scenarionet", run.file("s.pkl", pickle.dumps(whole)))

    assert "s.pkl: expected a ScenarioNet description with 'metadata', found list" in line([1])
    assert "with 'metadata', found id, tracks" in line({"id": 1, "tracks": {}})
    assert "with 'tracks', found metadata" in line({"metadata": {"ts": [0]}})
    assert "metadata: expected the times of the steps in `ts`, found map" in line(
        {"metadata": {"map": 0}, "tracks": {}}
    )
    assert "metadata: ts: expected numbers, found 'now'" in line({"metadata": {"ts": "now"}, "tracks": {}})
    assert "metadata: ts: expected times in seconds, found [nan]" in line(
        {"metadata": {"ts": [math.nan]}, "tracks": {}}
    )
    assert "track a: expected a ScenarioNet description with 'state'" in line(scenario(a={"type": "VEHICLE"}))
    short = ego()
    short["state"]["heading"] = np.zeros(3)
    assert "track ego: heading: expected 4 steps of up to 1, as `ts` has, found shape (3,)" in line(scenario(ego=short))
    del short["state"]["heading"]
    assert "track ego: expected 'heading' in its state, found position" in line(scenario(ego=short))
    flat = ego()
    flat["state"]["velocity"] = np.zeros((4, 1))
    assert "track ego: velocity: expected 2 or 3 columns, found 1" in line(scenario(ego=flat))
    assert "s.pkl: no object to convert in 4 frames" in line(scenario())
    assert "expected a pickle, found something else" in run.refused("scenarionet", run.file("s.pkl", "no pickle"))
    assert "expected a pickle, found something else" in run.refused("scenarionet", run.file("s.pkl", b""))


def counting(**more: Any) -> dict[str, Any]:
    """A scenario as ScenarioNet writes it of Waymo's: its summary counts with a defaultdict."""
    whole = scenario(ego=ego())
    moving = collections.defaultdict(int, VEHICLE=1)
    nested = collections.defaultdict(list, {"VEHICLE": [collections.defaultdict(set)]})
    whole["metadata"] |= {"dataset": "waymo", "number_summary": {"moving": moving, "by type": nested}, **more}
    return whole


@pytest.mark.parametrize("protocol", range(6))
def test_scenarionet_of_waymo_counts_with_a_defaultdict(run: Runner, protocol: int) -> None:
    path = run.file("w.pkl", pickle.dumps(counting(), protocol=protocol))
    assert run("scenarionet", path).class_of("1") == "car"
    found = restricted_pickle.load_pickle(path)["metadata"]["number_summary"]
    assert found == {"moving": {"VEHICLE": 1}, "by type": {"VEHICLE": [{}]}}
    assert type(found["moving"]) is dict  # nothing that makes up what it is asked for


def test_scenarionet_whole_folder(run: Runner, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("w/w_0/sd_waymo_a.pkl", "w/w_1/sd_waymo_b.pkl", "w/w_1/sd_waymo_left_out.pkl"):
        run.file(name, pickle.dumps(counting()))
    summary = pickle.dumps({"sd_waymo_a.pkl": counting()["metadata"]})
    for place in ("w", "w/w_0", "w/w_1"):
        run.file(f"{place}/dataset_summary.pkl", summary)
    run.file("w/w_0/dataset_mapping.pkl", pickle.dumps({"sd_waymo_a.pkl": ""}))
    run.file("w/dataset_mapping.pkl", pickle.dumps({"sd_waymo_b.pkl": "w_1", "sd_waymo_a.pkl": "w_0"}))
    out = run.folder / "out"
    words = ["scenarionet", run.folder / "w", "--out", out]
    assert convert(*words) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[:2] == [f"{out / f'sd_waymo_{name}.mcap'}: 4 frames, 1 car" for name in "ab"]
    assert "note: 8 states of the ego vehicle with length and width swapped (1.73×4.08 m): put right" in printed
    assert sorted(path.name for path in out.iterdir()) == ["sd_waymo_a.mcap", "sd_waymo_b.mcap"]
    assert read_log(out / "sd_waymo_b.mcap", name="b").host_id == "1"
    # The same again is refused before anything is read, and done with --overwrite, to the same bytes.
    before = (out / "sd_waymo_a.mcap").read_bytes()
    assert convert(*words) == 2
    assert capsys.readouterr().err == (
        f"{out / 'sd_waymo_a.mcap'}: is there already, and 1 other; give another name, or --overwrite\n"
    )
    assert convert(*words, "--overwrite") == 0
    assert (out / "sd_waymo_a.mcap").read_bytes() == before


def test_scenarionet_folder_without_a_mapping_and_with_one_that_is_none(
    run: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    run.file("w/deep/sd_a.pkl", pickle.dumps(counting(sdc_id="nobody")))
    run.file("w/sd_b.pkl", b"nothing")
    run.file("w/0.pkl", pickle.dumps(counting(sdc_id=None)))
    out = run.folder / "out"
    assert convert("scenarionet", run.folder / "w", "--out", out) == 2
    printed = capsys.readouterr()
    first, last = printed.err.splitlines()
    assert first.startswith(f"{run.folder / 'w' / 'sd_b.pkl'}: expected a pickle, found something else")
    assert last == "1 of 3 scenarios not converted"
    assert "note: no ego vehicle: no sdc_id (1 recording)\n" in printed.out
    assert "note: no ego vehicle: no track nobody (sdc_id) (1 recording)\n" in printed.out
    assert sorted(path.name for path in out.iterdir()) == ["0.mcap", "sd_a.mcap"]
    # Where nothing can be written, all is said once.
    place = run.file("place", "") / "out"
    assert convert("scenarionet", run.folder / "w", "--out", place) == 2
    first, last = capsys.readouterr().err.splitlines()
    assert first.startswith(f"{place / '0.mcap'}: cannot be written: ")
    assert last == "3 of 3 scenarios not converted"


def test_scenarionet_folders_that_are_refused(run: Runner, capsys: pytest.CaptureFixture[str]) -> None:
    out = run.folder / "out"

    def line(folder: str, output: Path = out) -> str:
        assert convert("scenarionet", run.folder / folder, "--out", output) == 2
        assert not out.exists()
        (found,) = capsys.readouterr().err.splitlines()
        return str(found)

    (run.folder / "empty").mkdir()
    assert line("empty").endswith("empty: expected scenarios of ScenarioNet, found no *.pkl in the folder")
    run.file("two/a/sd_x.pkl", pickle.dumps(counting()))
    assert "expected a folder for the recordings of one, found a file's name" in line("two", run.folder / "x.mcap")
    run.file("two/b/sd_x.pkl", pickle.dumps(counting()))
    assert f"expected one scenario sd_x, found {run.folder / 'two' / 'a' / 'sd_x.pkl'} and " in line("two")
    for hostile in ({"../sd_x.pkl": "two"}, {"sd_x.pkl": 1}, {"": "two"}):
        run.file("two/dataset_mapping.pkl", pickle.dumps(hostile))
        assert "dataset_mapping.pkl: expected files and their folders, found " in line("two")
    run.file("two/dataset_mapping.pkl", pickle.dumps(["sd_x.pkl"]))
    assert line("two").endswith("expected the folder of each scenario by its file, found list")


class Shell:
    """Would run a command when it is unpickled."""

    def __init__(self, call: Any, *arguments: Any) -> None:
        self.call, self.arguments = call, arguments

    def __reduce__(self) -> Any:
        return self.call, self.arguments


class Built:
    """Is made by a call, and then given a state."""

    def __init__(self, call: Any, arguments: tuple[Any, ...], state: Any) -> None:
        self.reduced = call, arguments, state

    def __reduce__(self) -> Any:
        return self.reduced


class Anew:
    """A dict that is given one thing after the other by the same key."""

    def __init__(self, things: list[Any]) -> None:
        self.things = things

    def __reduce__(self) -> Any:
        return collections.OrderedDict, (), None, None, iter([("key", thing) for thing in self.things])


def hostile_array(dtype: Any, shape: tuple[int, ...], content: Any) -> Built:
    return Built(np.empty(0).__reduce__()[0], (np.ndarray, (0,), b"b"), (1, shape, dtype, False, content))


# An object type that says of itself it holds no references: numpy would take the bytes for addresses.
LYING = Built(np.dtype, ("O8", False, True), (3, "|", None, None, None, -1, -1, 0))


@pytest.mark.parametrize(
    ("hostile", "what"),
    [
        (hostile_array(LYING, (1,), b"A" * 8), r"an array of shape \(1,\) with other content"),
        (hostile_array(np.dtype(object), (50_000_000,), []), "with other content"),  # read beyond the list
        (hostile_array(np.dtype("f8"), (-1, -1), b"A" * 8), r"an array of shape \(-1, -1\)"),
        (hostile_array(np.dtype("f8"), (2,), b"A" * 8), "with other content"),
        (hostile_array("f8", (1,), b"A" * 8), "an array without a type"),
        (hostile_array(np.dtype([("a", "f8")]), (1,), b"A" * 8), "an array of V8"),
        (Built(np.dtype, ("i4", False, True), (3, "<", None, ("a",), {"a": 1}, 800, 1, 0)), "with parts"),
        (Shell(np.float64(1).__reduce__()[0], np.dtype("S300000000")), "expected a pickle"),
        (Shell(np.float64(1).__reduce__()[0], np.dtype("f8"), b"A" * 16), "a number of float64 with other content"),
        (Shell(np.ndarray, (2**27,)), "not callable"),
        (Shell(list, (1,)), "not callable"),
        (Shell(collections.defaultdict, list, {}), "expected a pickle"),
    ],
)
def test_a_pickle_says_nothing_that_numpy_would_believe(tmp_path: Path, hostile: Any, what: str) -> None:
    path = tmp_path / "p.pkl"
    for protocol in range(2, 6):
        path.write_bytes(pickle.dumps({"metadata": hostile}, protocol=protocol))
        with pytest.raises(InputError, match=what):
            restricted_pickle.load_pickle(path)


def test_an_array_is_filled_once(tmp_path: Path) -> None:
    """What is filled again would leave those behind who look at what it held before."""
    path = tmp_path / "p.pkl"
    filled = pickle.dumps(np.arange(2.0), 2)
    state = pickle.dumps((1, (1,), np.dtype("f8"), False, b"A" * 8), 2)
    path.write_bytes(filled[:-1] + state[2:-1] + b"b.")
    with pytest.raises(InputError, match=r"an array of shape \(1,\)$"):
        restricted_pickle.load_pickle(path)


def test_a_pickle_cannot_hold_one_thing_too_often(tmp_path: Path) -> None:
    path = tmp_path / "p.pkl"
    bomb: list[Any] = []
    for _ in range(40):
        bomb = [bomb, bomb]  # 2⁴⁰ lists to whom looks at all of them
    circle: list[Any] = []
    circle.append(circle)
    text, items = "x" * 10_000, list(range(1000))
    shared = [Shell(set, items) for _ in range(1000)]  # a million places
    named = {(text, k): None for k in range(1000)}
    for hostile in (bomb, [text] * 10_000, [np.zeros(1000)] * 1000, shared, named):
        path.write_bytes(pickle.dumps(hostile))
        with pytest.raises(InputError, match="far more content than it has bytes"):
            restricted_pickle.load_pickle(path)
    # Nor make it anew, each time in the place of the one before.
    content, dtype = bytes(8000), np.dtype("f8")
    for anew in (lambda: Shell(set, items), lambda: hostile_array(dtype, (1000,), content)):
        path.write_bytes(pickle.dumps(Anew([anew() for _ in range(1000)])))
        with pytest.raises(InputError, match="far more content than it has bytes"):
            restricted_pickle.load_pickle(path)
    path.write_bytes(pickle.dumps(circle))
    with pytest.raises(InputError, match="containers in each other, more than 100 deep"):
        restricted_pickle.load_pickle(path)
    path.write_bytes(pickle.dumps({"same": [items, items]}))  # a few times is no harm
    assert restricted_pickle.load_pickle(path) == {"same": [items, items]}


@pytest.mark.parametrize("protocol", range(6))
def test_a_pickle_that_would_run_something_is_refused(run: Runner, protocol: int) -> None:
    proof = run.folder / "proof"
    hostile = scenario(ego=ego(), bad=Shell(os.system, f"touch {proof}"))
    line = run.refused("scenarionet", run.file("s.pkl", pickle.dumps(hostile, protocol=protocol)))
    assert f"s.pkl: refused: the pickle names {os.system.__module__}.system; expected only containers" in line
    assert not proof.exists()
    line = run.refused("scenarionet", run.file("s.pkl", pickle.dumps(Shell(eval, "1"), protocol=protocol)))
    assert "eval" in line
    assert "refused" in line


def test_a_pickle_may_hold_containers_numbers_strings_and_arrays(tmp_path: Path) -> None:
    path = tmp_path / "p.pkl"
    fine = {
        "list": [1, 2.5, None, True, 1 + 2j, "ä", b"\xff"],
        "tuple": ({1}, frozenset({2}), collections.OrderedDict(a=1)),
        "scalars": [np.float32(1.5), np.int64(7), np.bool_(True), np.str_("x"), np.str_("")],
        "arrays": [
            *(np.arange(6.0).reshape(2, 3).T, np.arange(3, dtype=">f4")),
            *(np.array(["a", "bc"]), np.array([{"a": 1}, None], dtype=object)),
        ],
    }
    for protocol in range(6):
        path.write_bytes(pickle.dumps(fine, protocol=protocol))
        found = restricted_pickle.load_pickle(path)
        for one, other in zip(found.pop("arrays"), fine["arrays"], strict=True):
            assert one.dtype.newbyteorder("=") == other.dtype.newbyteorder("=")  # numpy itself may turn bytes
            np.testing.assert_array_equal(one, other)
        assert found == {key: value for key, value in fine.items() if key != "arrays"}
    for bad in (np.zeros(2, dtype=[("a", "f8")]), np.array(["2020-01-01"], dtype="M8[D]")):
        path.write_bytes(pickle.dumps(bad))
        with pytest.raises(InputError, match="expected a pickle, found something else: an array of"):
            restricted_pickle.load_pickle(path)
    # A name is looked up whole: nothing hangs below one that is allowed.
    path.write_bytes(b"\x80\x04\x8c\x05numpy\x8c\x0cndarray.dump\x93.")
    with pytest.raises(InputError, match=r"the pickle names numpy\.ndarray\.dump"):
        restricted_pickle.load_pickle(path)


@pytest.mark.parametrize(
    ("program", "what"),
    [
        (b"\x80\x02}r\xff\xff\xff\x7f.", "a memo of 2147483647 places"),
        (
            b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n(L99999999999L\ntU\x01b\x87R.",
            "an array of shape",
        ),
        (b"\x80\x04\x95\xff\xff\xff\xff\xff\x00\x00\x00}.", "expected a pickle"),  # a frame of a terabyte
        (b"\x80\x04\x8e\xff\xff\xff\xff\xff\x00\x00\x00a.", "expected a pickle"),  # bytes of that length
    ],
)
def test_a_pickle_cannot_ask_for_gigabytes(tmp_path: Path, program: bytes, what: str) -> None:
    path = tmp_path / "p.pkl"
    path.write_bytes(program)
    with pytest.raises(InputError, match=what):
        restricted_pickle.load_pickle(path)


def test_scenarionet_arrays_of_nothing_in_any_shape(run: Runner) -> None:
    huge = np.lib.stride_tricks.as_strided(np.zeros(1), shape=(10**11,), strides=(0,))
    from copem_replay.io.convert.scenarionet import _read_array, _read_stamps

    with pytest.raises(InputError, match="ts: expected times in seconds"):
        _read_stamps({"ts": huge}, "m")
    with pytest.raises(InputError, match=r"x: expected 4 steps of up to 16, .* found shape \(100000000000,\)"):
        _read_array({"x": huge}, "x", 4, 0, "t")


# OpenLABEL --------------------------------------------------------------------------------------------------


def labels(frames: dict[str, Any], **more: Any) -> str:
    return json.dumps({"openlabel": {"metadata": {"schema_version": "1.0.0"}, "frames": frames, **more}})


def turned(yaw_deg: float, *at: float) -> list[float]:
    """Matrix of a turn about z and a translation, row by row."""
    c, s = round(math.cos(math.radians(yaw_deg))), round(math.sin(math.radians(yaw_deg)))
    return [c, -s, 0, at[0], s, c, 0, at[1], 0, 0, 1, at[2], 0, 0, 0, 1]


def kitti() -> dict[str, Any]:
    """A car 20 m ahead of the left camera and 3 m to its right, facing away from it, in two frames.

    The camera looks along z, its y points down; it is 1 m ahead of and 1.6 m above the origin of the vehicle, which
    stands at (100, 50), heading east first and north later.
    """
    camera = [0, 0, 1, 1, -1, 0, 0, 0, 0, -1, 0, 1.6, 0, 0, 0, 1]
    dont_care = {
        "name": "box3D",
        "coordinate_system": "CAM",
        "val": [-10.0, 499.0, -1.0, 0, -1.0, 0, -1000, -1000, -1000],
    }
    flat = {"name": "box3D", "coordinate_system": "CAM", "val": [-1000, -1000, -1000, 0, -10, 0, -1, -1, -1]}
    # Sizes along the box's own axes: length along x, height along y (down), width along z. A turn of −90° about the
    # camera's y brings x to where it looks.
    car = {"name": "box3D", "coordinate_system": "CAM", "val": [3.0, 0.85, 20.0, 0, -math.pi / 2, 0, 4.0, 1.5, 1.8]}
    objects = {
        "-1": {"object_data": {"bbox": [], "cuboid": [dont_care]}},
        "-2": {},
        "3": {"object_data": {"bbox": [], "cuboid": [flat]}},
        "7": {"object_data": {"bbox": [], "cuboid": [car]}},
    }
    frames = {}
    for number, yaw_deg in (("0", 0.0), ("1", 90.0)):
        moved = {"src": "vehicle", "dst": "odom", "transform_src_to_dst": {"matrix4x4": turned(yaw_deg, 100, 50, 0)}}
        frames[number] = {"frame_properties": {"transforms": {"vehicle_to_odom": moved}}, "objects": objects}
    systems = {
        "odom": {"type": "scene_cs", "parent": "", "children": ["vehicle"]},
        "vehicle": {"type": "local_cs", "parent": "odom", "children": ["CAM"]},
        "CAM": {"type": "sensor_cs", "parent": "vehicle", "pose_wrt_parent": {"matrix4x4": camera}},
    }
    types = {"-1": "DontCare", "-2": "Egocar", "3": "Van", "7": "Car"}
    named = {key: {"name": f"{kind}{key}", "type": kind} for key, kind in types.items()}
    return {"frames": frames, "coordinate_systems": systems, "objects": named}


def test_openlabel_as_kitti_has_it(run: Runner) -> None:
    found = run("openlabel", run.file("k.json", labels(**kitti())), "--rate-hz", "10")
    assert found.stamps_ns == [0, 100_000_000]
    assert found.names == {"4": "7"}  # −1 is no OSI id: numbered as they come
    names = ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    first, second = found.values("4", *names)
    # East: 1 + 20 m ahead, 3 m to the right (south), 1.6 − 0.85 m up. North: 21 m north, 3 m to the right (east).
    assert first == pytest.approx([121, 47, 0.75, 0, 4, 1.8, 1.5])
    assert second == pytest.approx([103, 71, 0.75, math.pi / 2, 4, 1.8, 1.5])
    assert found.class_of("4") == "car"
    assert found.recording.host_id is None
    assert "note: cuboids in CAM given in odom\n" in found.printed
    assert "note: 2 objects without object_data in a frame: skipped\n" in found.printed
    assert "note: 4 objects without a place or size (DontCare) in a frame: skipped\n" in found.printed


def test_openlabel_in_another_system(run: Runner) -> None:
    found = run("openlabel", run.file("k.json", labels(**kitti())), "--rate-hz", "10", "--to", "vehicle")
    assert found.values("4", "x_m", "y_m", "z_m")[1] == pytest.approx([21, -3, 0.75])
    line = run.refused("openlabel", run.folder / "k.json", "--rate-hz", "10", "--to", "moon")
    assert "frame 0: object 7: expected poses that lead from CAM to moon, found none: choose another with --to" in line


def tumtraf(seconds: str, x_m: float, yaw_rad: float, *, name: str | None = None) -> str:
    quaternion = [0, 0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)]  # x y z w
    cuboid: dict[str, Any] = {
        "name": "shape3D",
        "val": [x_m, 2, -7, *quaternion, 4.2, 1.9, 1.4],
        "attributes": {"num": []},
    }
    if name:
        cuboid["coordinate_system"] = name
    data = {"name": "CAR_6d8e", "type": "CAR", "cuboid": cuboid}
    frame = {"frame_properties": {"timestamp": float(seconds)}, "objects": {"6d8e-uuid": {"object_data": data}}}
    systems = {
        "base": {"type": "scene_cs", "parent": ""},
        "lidar": {
            "parent": "base",
            "pose_wrt_parent": {"quaternion": [0, 0, math.sqrt(0.5), math.sqrt(0.5)], "translation": [10, 0, 8]},
        },
    }
    return labels({"5": frame}, coordinate_systems=systems)


def test_openlabel_as_tumtraf_has_it(run: Runner) -> None:
    run.file("labels/b.json", tumtraf("1651673050.16", 1.0, 3.5))
    run.file("labels/c.json", tumtraf("1651673050.06", 0.0, 3.0))  # the names are not in order of time
    found = run("openlabel", run.folder / "labels")
    assert found.stamps_ns == [1651673050_060000000, 1651673050_160000000]
    assert found.names == {"1": "6d8e-uuid"}
    rows = found.values("1", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    assert rows[0] == pytest.approx([0, 2, -7, 3, 4.2, 1.9, 1.4])
    assert rows[1] == pytest.approx([1, 2, -7, 3.5 - 2 * math.pi, 4.2, 1.9, 1.4])
    assert "note: cuboids name no coordinate system: taken as they are\n" in found.printed


def test_openlabel_cuboids_of_a_sensor(run: Runner) -> None:
    # The lidar is turned by 90° at (10, 0, 8): (1, 2, −7) of it is (10 − 2, 1, 1) of the base.
    for text, options in ((tumtraf("1", 1, 0), ("--from", "lidar")), (tumtraf("1", 1, 0, name="lidar"), ())):
        found = run("openlabel", run.file("t.json", text), *options)
        assert found.values("1", "x_m", "y_m", "z_m", "yaw_rad")[0] == pytest.approx([8, 1, 1, math.pi / 2])


def test_openlabel_what_is_skipped_is_said(run: Runner) -> None:
    box = {"name": "a", "val": [0, 0, 1, 0, 0, 0, 2, 1, 1]}
    objects = {
        "1": {"object_data": {"type": "UFO", "cuboid": [box, box]}},
        "2": {"object_data": {"bbox": [], "type": "CAR"}},
    }
    frames = {
        "3": {"frame_properties": {"timestamp": "2.5"}, "objects": objects},
        "4": {"frame_properties": {"timestamp": 3}},
    }
    found = run("openlabel", run.file("t.json", labels(frames)))
    assert found.stamps_ns == [2_500_000_000, 3_000_000_000]
    assert found.class_of("1") == "other"
    assert "note: 1 object state of the unknown type 'UFO': taken as other\n" in found.printed
    assert "note: 1 cuboid beyond the first of an object in a frame: skipped\n" in found.printed
    assert "note: 1 object without a cuboid in a frame: skipped\n" in found.printed


def cuboid(val: Any, **more: Any) -> str:
    frame = {
        "frame_properties": {"timestamp": 1, **more},
        "objects": {"1": {"object_data": {"cuboid": [{"val": val}]}}},
    }
    return labels({"0": frame})


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("{", "t.json: expected JSON, found something else"),
        ("[" * 100_000, "t.json: expected JSON, found something else"),
        ("\xff", "t.json: "),
        ("[]", "t.json: expected OpenLABEL with `openlabel` and its `frames`, found list"),
        ('{"vcd": {}}', "t.json: expected OpenLABEL with `openlabel` and its `frames`, found vcd"),
        (labels({"0": 1}), "t.json: frame 0: expected an object with `objects`, found 1"),
        (labels({"0": {}}), "frame 0: expected a timestamp, found none: say how many frames a second with --rate-hz"),
        (cuboid([1] * 8), "t.json: frame 0: object 1: expected a cuboid of 9 or 10 numbers, found [1, 1"),
        (cuboid([1] * 8 + ["a"]), "t.json: frame 0: object 1: cuboid: expected a number, found 'a'"),
        (cuboid([1] * 9, timestamp="noon"), "t.json: frame 0: timestamp: expected a time of 0 to"),
        (cuboid([1] * 9, transforms={"t": {}}), "frame 0: transforms: t: expected src, dst and transform_src_to_dst"),
        (cuboid([1] * 9, transforms=3), "frame 0: transforms: expected an object of objects, found 3"),
        (
            labels({}, coordinate_systems={"a": {"parent": "b", "pose_wrt_parent": {}}}),
            "a: pose_wrt_parent: expected matrix",
        ),
        (
            labels({}, coordinate_systems={"a": {"parent": "b", "pose_wrt_parent": {"matrix4x4": [1.0] * 16}}}),
            "a: pose_wrt_parent: expected a rotation and a translation, found another matrix",
        ),
        (  # a rotation, and a last row that makes no movement of it
            labels(
                {},
                coordinate_systems={
                    "a": {"parent": "b", "pose_wrt_parent": {"matrix4x4": [*turned(0, 1, 2, 3)[:-1], 0]}}
                },
            ),
            "a: pose_wrt_parent: expected a rotation and a translation, found another matrix",
        ),
        (
            labels({}, coordinate_systems={"a": {"parent": "b", "pose_wrt_parent": {"matrix4x4": [1.0] * 9}}}),
            "a: pose_wrt_parent: expected 16 numbers, found [1.0",
        ),
        (labels({}, objects=[1]), "t.json: objects: expected an object, found [1]"),
        (labels({}), "t.json: no object to convert in 0 frames"),
    ],
)
def test_openlabel_refuses(run: Runner, text: str, line: str) -> None:
    assert line in run.refused("openlabel", run.file("t.json", text))


def test_openlabel_refuses_two_files_of_one_instant(run: Runner) -> None:
    run.file("labels/a.json", tumtraf("1", 0, 0))
    run.file("labels/b.json", tumtraf("1", 1, 0))
    assert "frame 2: expected a time after 1.000000 s" in run.refused("openlabel", run.folder / "labels")
    (run.folder / "empty").mkdir()
    assert "empty: expected OpenLABEL files, found no *.json in the folder" in run.refused(
        "openlabel", run.folder / "empty"
    )
