"""Situations from public reports: which topic is the truth, what a recorder left out, parts of a split bag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from copem_replay.core.errors import RecordingError
from copem_replay.io.config import EgoTopic
from copem_replay.io.recording import read_log
from tests.helpers.recordings import Topic, write_mcap
from tests.helpers.ros2 import header, made, pose, topic, transform
from tests.io.test_world_frame import TIMES, json_topic

ARRAY, MARKERS = "vision_msgs/msg/Detection3DArray", "visualization_msgs/msg/MarkerArray"


def detections(t_s: float, ids: Sequence[str] = ("7",), x: float = 0.0) -> dict[str, Any]:
    stamp = {"sec": int(t_s), "nanosec": round(t_s * 1e9) % 10**9}
    turn = {"x": 0, "y": 0, "z": 0, "w": 1}

    def detection(name: str, k: int) -> dict[str, Any]:
        centre = {"position": {"x": x + 5 * t_s, "y": 9.0 * k, "z": 1}, "orientation": turn}
        box = {"center": centre, "size": {"x": 4, "y": 2, "z": 1.5}}
        return {"id": name, "results": [{"hypothesis": {"class_id": "car", "score": 0.9}}], "bbox": box}

    return {
        "header": {"stamp": stamp, "frame_id": "map"},
        "detections": [detection(name, k) for k, name in enumerate(ids)],
    }


def lists(name: str, **how: Any) -> Topic:
    return json_topic(name, [(t, detections(t, **how)) for t in TIMES], schema=ARRAY)


def markers(t_s: float, frame: str = "map") -> Any:
    size = made("geometry_msgs/msg/Vector3", x=4.0, y=2.0, z=1.5)
    box = made(
        "visualization_msgs/msg/Marker",
        header=header(t_s, frame), ns="car", id=1, type=1, pose=pose(5 * t_s, 0.0, 1.0), scale=size,
    )  # fmt: skip
    return made(MARKERS, markers=[box])


@pytest.mark.parametrize(
    "name", ["/ground_truth/objects", "/GroundTruth", "/carla/ground-truth", "/gt", "/sim/gt/boxes"]
)
def test_a_topic_that_says_ground_truth_is_taken_before_tracking(tmp_path: Path, name: str) -> None:
    others = [lists(f"/perception/{of}", x=1.0) for of in ("tracking", "prediction")]
    found = read_log(write_mcap(tmp_path / "a.mcap", [*others, lists(name)]), name="a")
    assert found.topic == name
    assert f"topic /perception/tracking ({ARRAY}) not read: {name} taken" in found.notes


@pytest.mark.parametrize("name", ["/legt", "/gtx", "/ground", "/truthful"])
def test_other_names_do_not_say_it(tmp_path: Path, name: str) -> None:
    with pytest.raises(RecordingError, match=r"on several topics.*choose one with `read: \{topic: …\}`"):
        read_log(write_mcap(tmp_path / "a.mcap", [lists("/tracking"), lists(name)]), name="a")


def test_detections_without_ids_are_no_truth(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", [lists("/detections", ids=("", ""))])
    with pytest.raises(RecordingError, match="/detections: its objects have no ids, all are empty; lists of a unit"):
        read_log(path, name="a")


def test_some_of_the_ids_are_empty(tmp_path: Path) -> None:
    found = read_log(write_mcap(tmp_path / "a.mcap", [lists("/detections", ids=("7", ""))]), name="a")
    assert found.scene.object_ids == ("7",)
    assert "11 object states without an id: skipped" in found.notes


def test_a_later_part_of_a_split_bag_names_the_transforms_that_it_lacks(tmp_path: Path) -> None:
    boxes = topic("/boxes", MARKERS, [(t, markers(t, "lidar")) for t in TIMES])
    moves = topic(
        "/tf", "tf2_msgs/msg/TFMessage",
        [(t, made("tf2_msgs/msg/TFMessage", transforms=[transform(t, "map", "base_link", t, 0.0)])) for t in TIMES],
    )  # fmt: skip
    mounts = made("tf2_msgs/msg/TFMessage", transforms=[transform(0.0, "base_link", "lidar", 1.0, 0.0)])
    static = topic("/tf_static", "tf2_msgs/msg/TFMessage", [(0.0, mounts)])
    ego = EgoTopic(topic="/tf", frame="base_link", size_m=(4.5, 1.8, 1.5))
    whole = write_mcap(tmp_path / "a.mcap", [boxes, moves, static], profile="ros2")
    assert read_log(whole, name="a", ego=ego).scene.ego_ix >= 0
    part = write_mcap(tmp_path / "b.mcap", [boxes, moves, replace(static, messages=[])], profile="ros2")
    with pytest.raises(
        RecordingError, match=r"/tf_static is empty: of a split bag the first part alone has it, so give"
    ):
        read_log(part, name="a", ego=ego)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_metadata_of_old_releases_has_the_name_of_the_folder_in_its_paths(tmp_path: Path, version: int) -> None:
    folder = tmp_path / "foxy"
    folder.mkdir()
    write_mcap(folder / "foxy_0.mcap", [lists("/detections")])
    text = f"rosbag2_bagfile_information:\n  version: {version}\n  storage_identifier: mcap\n"
    (folder / "metadata.yaml").write_text(f"{text}  relative_file_paths:\n    - foxy/foxy_0.mcap\n")
    assert read_log(folder, name="a").scene.object_ids == ("7",)


def test_a_schema_without_a_definition(tmp_path: Path) -> None:
    """Of packages that many have it is known; of others a line says that the recorder lacked it."""
    boxes = topic("/boxes", MARKERS, [(t, markers(t)) for t in TIMES])
    bare = replace(boxes, definition=("ros2msg", b""))
    found = read_log(write_mcap(tmp_path / "a.mcap", [bare], profile="ros2"), name="a")
    assert found.scene.object_ids == ("car/1",)
    known = read_log(write_mcap(tmp_path / "b.mcap", [boxes], profile="ros2"), name="a")
    assert found.truth.x_m.tolist() == known.truth.x_m.tolist()
    other = replace(bare, schema="derived_object_msgs/msg/ObjectArray")
    with pytest.raises(RecordingError, match="the recorder lacked the package of derived_object_msgs/msg/ObjectArray"):
        read_log(write_mcap(tmp_path / "c.mcap", [other], profile="ros2"), name="a")
