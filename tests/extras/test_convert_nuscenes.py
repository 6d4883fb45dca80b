"""The converter of nuScenes and T4 tables: two scenes of a few rows, all expected values by hand, and by the kits."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from osi3.osi_object_pb2 import StationaryObject

from tests.extras.conversions import Runner, convert, run
from tests.helpers.kits import ask_kit

__all__ = ["run"]

T0_US = 1_532_402_927_647_951
HALF = math.sqrt(0.5)
NORTH, EAST = [HALF, 0.0, 0.0, HALF], [1.0, 0.0, 0.0, 0.0]
PLACE = ("x_m", "y_m", "z_m", "yaw_rad")
SIZE = ("length_m", "width_m", "height_m")


def key_frame(k: int, scene: str, at: list[float], turn: list[float]) -> dict[str, list[dict[str, Any]]]:
    """A key frame with a lidar 1 µs late and a camera 30 ms early, whose pose is another."""
    stamp, sample = T0_US + 500_000 * k, f"{scene}-{k}"
    rows: dict[str, list[dict[str, Any]]] = {"sample": [{"token": sample, "timestamp": stamp, "scene_token": scene}]}
    rows["sample"][0] |= {"prev": f"{scene}-{k - 1}" if k else "", "next": f"{scene}-{k + 1}" if k < 2 else ""}
    for channel, off_us, moved in (("lidar", 1, 0.0), ("camera", -30_000, 99.0)):
        token = f"{sample}-{channel}"
        pose = {"token": token, "timestamp": stamp + off_us, "rotation": turn}
        data = {"token": token, "sample_token": sample, "ego_pose_token": token, "timestamp": stamp + off_us}
        data |= {"calibrated_sensor_token": f"calibrated-{channel}", "is_key_frame": True, "filename": f"{token}.bin"}
        data |= {"fileformat": "pcd", "width": 0, "height": 0, "prev": "", "next": ""}
        rows.setdefault("ego_pose", []).append({**pose, "translation": [at[0] + moved, *at[1:]]})
        rows.setdefault("sample_data", []).append(data)
    return rows


def annotation(sample: str, instance: str, at: list[float], turn: list[float]) -> dict[str, Any]:
    row = {"token": f"{sample}-{instance}", "sample_token": sample, "instance_token": instance, "translation": at}
    row |= {"size": [1.9, 4.5, 1.6], "rotation": turn, "visibility_token": "4", "attribute_tokens": []}
    return row | {"num_lidar_pts": 5, "num_radar_pts": 0, "prev": "", "next": ""}


def tables() -> dict[str, list[dict[str, Any]]]:
    """Scene a: the ego drives north, 5 m/s; a car turns left from east to north. Scene b: the ego alone."""
    whole: dict[str, list[dict[str, Any]]] = {}
    frames = [key_frame(k, "a", [100.0, 200.0 + 2.5 * k, 0.0], NORTH) for k in range(3)]
    for part in [*frames, key_frame(0, "b", [0.0, 0.0, 0.0], EAST)]:
        for name, rows in part.items():
            whole.setdefault(name, []).extend(rows)
    whole["sample_annotation"] = [
        annotation("a-0", "turning", [110.0, 200.0, 0.8], EAST),
        annotation("a-1", "turning", [111.0, 202.0, 0.8], NORTH),
        annotation("a-1", "cone", [120.0, 200.0, 0.4], EAST),
        annotation("a-2", "odd", [130.0, 200.0, 0.4], EAST),
    ]
    of = {"turning": "vehicle.car", "cone": "movable_object.trafficcone", "odd": "hovercraft"}
    whole["instance"] = [{"token": i, "category_token": c, "nbr_annotations": 1} for i, c in of.items()]
    for row in whole["instance"]:
        row |= {"first_annotation_token": "", "last_annotation_token": "", "instance_name": row["token"]}
    whole["category"] = [{"token": c, "name": c, "description": ""} for c in of.values()]
    whole["sensor"] = [{"token": c, "channel": c.upper(), "modality": c} for c in ("lidar", "camera")]
    at_ego = {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "camera_intrinsic": [], "camera_distortion": []}
    whole["calibrated_sensor"] = [
        {"token": f"calibrated-{c}", "sensor_token": c, **at_ego} for c in ("lidar", "camera")
    ]
    log = {"token": "log", "logfile": "", "vehicle": "", "data_captured": "", "location": "singapore-onenorth"}
    whole["log"] = [log]
    whole["map"] = [{"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": ""}]
    scene = {"log_token": "log", "nbr_samples": 1, "description": ""}
    whole["scene"] = [
        {**scene, "token": "a", "name": "scene-0061", "first_sample_token": "a-0", "last_sample_token": "a-2"},
        {**scene, "token": "b", "name": "scene-0103", "first_sample_token": "b-0", "last_sample_token": "b-0"},
    ]
    return whole | {"attribute": [], "visibility": [{"token": "4", "level": "v80-100", "description": ""}]}


def write(folder: Path, of: dict[str, list[dict[str, Any]]] | None = None, version: str = "v1.0-mini") -> Path:
    (folder / version).mkdir(parents=True, exist_ok=True)
    for name, rows in (of or tables()).items():
        (folder / version / f"{name}.json").write_text(json.dumps(rows, indent=0))
    return folder


def test_key_frames_in_the_frame_of_the_map(run: Runner) -> None:
    found = run("nuscenes", write(run.folder / "set"), "--only", "scene-0061", "--key-frames")
    assert found.stamps_ns == [1000 * (T0_US + 500_000 * k) for k in range(3)]
    assert found.recording.host_id == "1"
    # The rear axle at (100, 200) faces north: the centre is 1.385 m north, half of 1.562 m up.
    assert found.values("1", *PLACE, *SIZE)[1] == pytest.approx([100, 203.885, 0.781, math.pi / 2, 4.084, 1.73, 1.562])
    rows = found.values(found.id_of("turning"), *PLACE, *SIZE)
    assert rows[0] == pytest.approx([110, 200, 0.8, 0, 4.5, 1.9, 1.6])  # size is width, length, height
    assert rows[1] == pytest.approx([111, 202, 0.8, math.pi / 2, 4.5, 1.9, 1.6])
    assert (found.class_of(found.id_of("turning")), found.class_of(found.id_of("odd"))) == ("car", "other")
    (cone,) = found.messages[1].stationary_object
    assert cone.classification.type == StationaryObject.Classification.TYPE_CONSTRUCTION_SITE_ELEMENT
    assert not any(moving.base.HasField("velocity") for message in found.messages for moving in message.moving_object)
    assert "note: 1 object state of the class name 'hovercraft', which says nothing: taken as other; " in found.printed
    assert "interpolated" not in found.printed


def test_between_key_frames_is_interpolated_of_what_both_have(run: Runner) -> None:
    found = run("nuscenes", write(run.folder / "set"), "--only", "scene-0061")
    assert found.stamps_ns == [1000 * (T0_US + 100_000 * k) for k in range(11)]
    turning = found.values(found.id_of("turning"), "x_m", "y_m", "yaw_rad")
    assert len(turning) == 6
    assert turning[2] == pytest.approx([110.4, 200.8, 0.4 * math.pi / 2])  # two fifths of the way
    assert [row[0] for row in found.values("1", "y_m")] == pytest.approx([201.385 + 0.5 * k for k in range(11)])
    assert "8 frames interpolated" in found.printed
    assert "frames between key frames are interpolated to 10 Hz, of objects that both key frames have" in found.printed


def test_a_turn_over_the_back_is_the_short_one(run: Runner) -> None:
    of = tables()
    for row, yaw in zip(of["sample_annotation"][:2], (math.radians(170), math.radians(-170)), strict=True):
        row["rotation"] = [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
    found = run("nuscenes", write(run.folder / "set", of), "--only", "scene-0061", "--rate-hz", "4")
    yaws = [math.degrees(row[0]) % 360 for row in found.values(found.id_of("turning"), "yaw_rad")]
    assert yaws == pytest.approx([170, 180, 190])


def test_key_frames_far_apart_stay_apart(run: Runner) -> None:
    of = tables()
    of["sample"][1]["scene_token"] = "nowhere"  # the second of scene a: 1 s between two is interpolated, 1.5 s are not
    assert len(run("nuscenes", write(run.folder / "a", of), "--only", "scene-0061").stamps_ns) == 11
    of["sample"][2]["timestamp"] += 500_000
    assert len(run("nuscenes", write(run.folder / "b", of), "--only", "scene-0061").stamps_ns) == 2


def test_a_folder_becomes_a_folder_with_a_recording_per_scene(run: Runner) -> None:
    assert convert("nuscenes", write(run.folder / "set"), "--out", run.folder / "out") == 0
    assert sorted(path.name for path in (run.folder / "out").iterdir()) == ["scene-0061.mcap", "scene-0103.mcap"]
    printed = run.capsys.readouterr().out
    assert f"{run.folder / 'out' / 'scene-0103.mcap'}: 1 frame, 1 car" in printed
    assert "no annotations: nothing but the ego vehicle (1 recording)" in printed


def test_t4_has_its_tables_in_annotation_and_short_categories(run: Runner) -> None:
    of = tables()
    of["category"][0]["name"], of["category"][2]["name"] = "CAR", "pedestrian.adult"
    del of["log"]
    found = run("nuscenes", write(run.folder / "set", of, "2/annotation"), "--only", "scene-0061", "--key-frames")
    assert found.class_of(found.id_of("turning")) == "car"
    assert found.class_of(found.id_of("odd")) == "pedestrian"


def test_outlines_of_lanes_near_the_path(run: Runner) -> None:
    folder = write(run.folder / "set")
    corners = {"1": (95, 190), "2": (105, 190), "3": (105, 300), "4": (95, 300), "9": (5000, 0), "8": (5000, 9)}
    far = {"token": "far", "exterior_node_tokens": ["9", "8", "9"]}
    document = {
        "node": [{"token": token, "x": x, "y": y} for token, (x, y) in corners.items()],
        "polygon": [{"token": "near", "exterior_node_tokens": ["1", "2", "3", "4"], "holes": []}, far],
        "lane": [{"token": "l1", "polygon_token": "near"}, {"token": "l2", "polygon_token": "far"}],
    }
    (folder / "maps/expansion").mkdir(parents=True)
    (folder / "maps/expansion/singapore-onenorth.json").write_text(json.dumps(document))
    found = run("nuscenes", folder, "--only", "scene-0061")
    (outline,) = found.recording.lane_boundaries
    assert outline.tolist() == [[95, 190, 0], [105, 190, 0], [105, 300, 0], [95, 300, 0], [95, 190, 0]]
    assert "1 lane of singapore-onenorth.json within 100 m of the ego's path" in found.printed
    (folder / "maps/expansion/singapore-onenorth.json").write_text(json.dumps(document | {"node": [{"token": "1"}]}))
    said = run.refused("nuscenes", folder, "--only", "scene-0061")
    assert "singapore-onenorth.json: node: expected rows with token, x, y, found {'token': '1'}" in said


@pytest.mark.parametrize(
    ("table", "change", "said"),
    [
        ("scene", None, "expected the tables of one version (scene.json, sample.json, …), found none of them"),
        ("ego_pose", None, "ego_pose.json: no such file; a nuScenes or T4 data set has one"),
        ("sample", "[{", "sample.json:1: expected JSON, found something else or its end after 0 rows"),
        ("sample_data", '[\n{"token": "a"', "sample_data.json:2: expected JSON, found something else or its end"),
        ("category", "{}", "category.json: expected a list of rows, found '{}'"),
        ("category", "[]", "instance.json: expected a category of category.json, found 'vehicle.car' of turning"),
        ("instance", "[]", "sample_annotation.json: row 1: expected an instance of instance.json, found 'turning'"),
        ("sensor", "[1]", "sensor.json: row 1: expected an object with the text 'token', found 1"),
        ("log", "[" * 9999, "expected JSON, found something else or its end"),
        ("scene", "[]", "scene.json: expected scenes, found none"),
        ("calibrated_sensor", b"\xff", "calibrated_sensor.json: expected JSON in UTF-8"),
    ],
)
def test_a_table_that_is_none_is_one_line(run: Runner, table: str, change: str | bytes | None, said: str) -> None:
    folder = write(run.folder / "set")
    path = folder / "v1.0-mini" / f"{table}.json"
    path.unlink() if change is None else path.write_bytes(change if isinstance(change, bytes) else change.encode())
    assert said in run.refused("nuscenes", folder, "--only", "scene-0061") or table == "log"


@pytest.mark.parametrize(
    ("table", "key", "value", "said"),
    [
        ("sample", "timestamp", -1, "row 1: timestamp: expected microseconds of 0 to 4000000000 s, found -1"),
        ("sample", "timestamp", "soon", "row 1: timestamp: expected a number, found 'soon'"),
        ("sample_annotation", "size", [1, 2], "row 1: size: expected 3 numbers, found [1, 2]"),
        ("sample_annotation", "rotation", None, "row 1: rotation: expected 4 numbers, found nothing"),
        ("sample_annotation", "translation", [1e300, 0, 0], "expected numbers of at most 1e+08, found 1e+300"),
    ],
)
def test_a_row_that_is_wrong_is_one_line(run: Runner, table: str, key: str, value: Any, said: str) -> None:
    of = tables()
    of[table][0][key] = value
    assert said in run.refused("nuscenes", write(run.folder / "set", of), "--only", "scene-0061")


def test_wrong_folders_and_options(run: Runner) -> None:
    folder = write(run.folder / "set")
    assert "expected the folder of a nuScenes or T4 data set, found a file" in run.refused(
        "nuscenes", folder / "v1.0-mini/scene.json"
    )
    assert "expected a folder for the recordings of one, found a file's name" in run.refused("nuscenes", folder)
    assert "--only: no recording is named 'scene-61'; did you mean scene-0061?" in run.refused(
        "nuscenes", folder, "--only", "scene-61"
    )
    rate = ("--only", "scene-0061", "--rate-hz", "1e9")
    assert "--rate-hz: expected at most 1000, found 1e+09" in run.refused("nuscenes", folder, *rate)
    write(folder, version="v1.0-test")
    assert "found several: v1.0-mini, v1.0-test; name one" in run.refused("nuscenes", folder)
    assert run("nuscenes", folder / "v1.0-test", "--only", "scene-0061").recording.host_id == "1"


OF_KIT = """
import json, sys
from nuscenes.nuscenes import NuScenes
kit = NuScenes(sys.argv[2], sys.argv[1], verbose=False)
found = {}
for sample in (row for row in kit.sample if row["scene_token"] == "a"):
    pose = kit.get("ego_pose", kit.get("sample_data", sample["data"]["LIDAR"])["ego_pose_token"])
    found[sample["timestamp"]] = {"ego": pose["translation"]} | {
        kit.get("sample_annotation", token)["instance_token"]:
        [*(box := kit.get_box(token)).center, box.orientation.yaw_pitch_roll[0], *box.wlh, box.name]
        for token in sample["anns"]
    }
print(json.dumps(found))
"""


def test_the_kit_of_nuscenes_reads_the_same(run: Runner) -> None:
    folder = write(run.folder / "set")
    boxes = ask_kit("nuscenes", OF_KIT, folder, "v1.0-mini")
    found = run("nuscenes", folder, "--only", "scene-0061", "--key-frames")
    assert [int(stamp) * 1000 for stamp in boxes] == found.stamps_ns
    numbers = {name: number for number, name in found.names.items()}
    count = 0
    for message, objects in zip(found.messages, boxes.values(), strict=True):
        x, y, _ = objects.pop("ego")
        moving = {str(o.id.value): o.base for o in [*message.moving_object, *message.stationary_object]}
        ego = moving.pop("1")
        assert (ego.position.x, ego.position.y) == pytest.approx((x, y + 1.385))
        assert {numbers[name] for name in objects} == moving.keys()
        for name, (*place, width, length, height, _) in objects.items():
            base = moving[numbers[name]]
            seen = (base.position.x, base.position.y, base.position.z, base.orientation.yaw)
            assert seen == pytest.approx(place)
            assert (base.dimension.width, base.dimension.length) == pytest.approx((width, length))
            assert base.dimension.height == pytest.approx(height)
            count += 1
    assert count == 4


T4_KIT = """
import json, sys
from t4_devkit import Tier4
kit = Tier4("annotation", sys.argv[1], verbose=False)
print(json.dumps({box.token: [*map(float, box.translation), *map(float, box.size)] for box in kit.sample_annotation}))
"""


def test_the_kit_of_t4_reads_the_same(run: Runner) -> None:
    folder = write(run.folder / "set", version="annotation")
    boxes = ask_kit("t4_devkit", T4_KIT, folder)
    turning = boxes["a-1-turning"]
    found = run("nuscenes", folder, "--only", "scene-0061", "--key-frames")
    (x, y, z, length, width, height) = found.values(found.id_of("turning"), "x_m", "y_m", "z_m", *SIZE)[1]
    assert turning == pytest.approx([x, y, z, width, length, height])
