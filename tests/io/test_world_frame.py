"""Recordings that are not OSI: lists of any schema, the ego from odometry, frames of reference."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from copem_replay.core.errors import RecordingError
from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import CLASSES
from copem_replay.io.config import EgoTopic, TruthFields
from copem_replay.io.recording import Recording, read_log
from tests.helpers.recordings import SHARED, Topic, ns, write_mcap
from tests.helpers.ros2 import made, odometry, topic, transform

TIMES = [k / 10 for k in range(11)]


def boxes(t_s: float, items: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {"header": {"t": {"sec": ns(t_s) // 10**9, "nanosec": ns(t_s) % 10**9}, "frame": "map"}, "boxes": items}


def own(t_s: float) -> dict[str, Any]:
    """A walker 1 m/s north, a lorry that stands; numbers as some write them."""
    walker = {"track": {"id": 7}, "pos": [5.0, t_s, 0.9], "dims": [0.5, 0.6, 1.8], "rot": 90, "label": 2}
    lorry = {"track": {"id": 8}, "pos": [30.0, -4.0, "1.6"], "dims": [9, 2.5, 3.2], "rot": 180.0, "label": 5}
    return boxes(t_s, [walker, lorry])


FIELDS: dict[str, Any] = {
    "topic": "/boxes",
    "objects": "boxes[]",
    "stamp": "header.t",
    "frame": "header.frame",
    "id": "track.id",
    "class": {"path": "label", "map": {2: "pedestrian", 5: "truck"}},
    "x_m": "pos[0]",
    "y_m": "pos[1]",
    "z_m": "pos[2]",
    "yaw_rad": {"degrees": "rot"},
    "length_m": "dims[0]",
    "width_m": "dims[1]",
    "height_m": "dims[2]",
}


def json_topic(name: str, messages: Sequence[tuple[float, Any]], schema: str = "my.Boxes") -> Topic:
    payloads = [(ns(t_s), json.dumps(message).encode()) for t_s, message in messages]
    return Topic(name, schema, payloads, encoding="json", definition=("jsonschema", b"{}"))


def own_recording(path: Path, *more: Topic) -> Path:
    return write_mcap(path / "a.mcap", [json_topic("/boxes", [(t, own(t)) for t in TIMES]), *more])


def fields(**changes: Any) -> TruthFields:
    return TruthFields.model_validate(FIELDS | changes)


def state(recording: Recording, name: str, t_s: float) -> dict[str, float]:
    scene = recording.scene
    at, there = interpolate_states(
        recording.truth, np.array([scene.object_number[name]]), np.array([t_s]), t0_ns=scene.t0_ns, max_gap_s=0.5
    )
    assert there.all()
    return {key: round(float(value[0]), 6) for key, value in at.items()}


def classes(recording: Recording) -> dict[str, str]:
    scene = recording.scene
    return {name: CLASSES[c] for name, c in zip(scene.object_ids, scene.object_class.tolist(), strict=True)}


class TestAnySchema:
    def test_by_naming_its_fields(self, tmp_path: Path) -> None:
        found = read_log(own_recording(tmp_path), name="a", topic="/boxes", fields=fields())
        assert classes(found) == {"7": "pedestrian", "8": "truck"}
        assert state(found, "7", 0.45) == {
            "x_m": 5.0, "y_m": 0.45, "z_m": 0.9, "yaw_rad": round(np.pi / 2, 6), "vx_mps": 0.0, "vy_mps": 1.0,
            "length_m": 0.5, "width_m": 0.6, "height_m": 1.8,
        }  # fmt: skip
        assert state(found, "8", 0.2)["z_m"] == 1.6
        assert found.scene.ego_ix == -1

    def test_a_field_that_is_not_there(self, tmp_path: Path) -> None:
        path = own_recording(tmp_path)
        with pytest.raises(RecordingError) as caught:
            read_log(path, name="a", topic="/boxes", fields=fields(x_m="position.x"))
        (line,) = caught.value.problems
        assert line.startswith(
            f"{path}: /boxes: read.x_m: the messages have no 'boxes[].position.x'; they have boxes[]."
        )
        with pytest.raises(
            RecordingError, match=r"no true objects on topic '/box'; messages are on /boxes \(my.Boxes\)"
        ):
            read_log(path, name="a", topic="/box", fields=fields(topic="/box"))

    def test_objects_without_ids_are_not_the_truth(self, tmp_path: Path) -> None:
        with pytest.raises(RecordingError, match="have no ids"):
            read_log(own_recording(tmp_path), name="a", topic="/boxes", fields=fields(id=None))


class TestEgo:
    def drive(self, path: Path, *more: Topic, list_frame: str = "map") -> Path:
        """The ego's rear axle drives east at 10 m/s from the origin, 20 Hz."""
        lists = [(t, own(t)) for t in TIMES]
        for _, message in lists:
            message["header"]["frame"] = list_frame
        poses = topic(
            "/odom", "nav_msgs/msg/Odometry", [(t, odometry(t, 10 * t, 0.0, 0.0, 10.0)) for t in np.arange(21) / 20]
        )
        return write_mcap(path / "a.mcap", [json_topic("/boxes", lists), poses, *more], profile="ros2")

    def test_the_only_odometry_is_the_egos(self, tmp_path: Path) -> None:
        found = read_log(self.drive(tmp_path), name="a", topic="/boxes", fields=fields())
        scene = found.scene
        assert (scene.object_ids[scene.ego_ix], scene.ego_sized) == ("ego", False)
        assert state(found, "ego", 0.5)["x_m"] == 5.0
        assert state(found, "ego", 0.5)["vx_mps"] == 10.0
        assert [n for n in found.notes if "no size is said" in n and "gaps are null" in n]
        assert [n for n in found.notes if "centre_from_rear_axle_m" in n]

    @pytest.mark.parametrize("window_s", [None, (2.5, 4.0)])
    def test_poses_that_come_seldom_are_interpolated_over_the_gap_of_the_experiment(
        self, tmp_path: Path, window_s: tuple[float, float] | None
    ) -> None:
        """Every 5 s; a window may lie between two of them."""
        poses = topic("/odom", "nav_msgs/msg/Odometry", [(t, odometry(t, 10 * t, 0.0, 0.0, 10.0)) for t in (0, 5, 10)])
        lists = json_topic("/boxes", [(k / 10, own(k / 10)) for k in range(101)])
        path = write_mcap(tmp_path / "a.mcap", [lists, poses], profile="ros2")
        found = read_log(path, name="a", topic="/boxes", fields=fields(), max_gap_s=6.0, window_s=window_s)
        rows = found.truth.x_m[0, found.truth.row_object_ix == found.scene.ego_ix]
        expected = np.arange(25, 41) if window_s else np.arange(101)
        assert rows == pytest.approx(expected)
        if window_s is None:
            short = read_log(path, name="a", topic="/boxes", fields=fields())
            assert (short.truth.row_object_ix == short.scene.ego_ix).sum() == 3

    def test_its_size_and_its_centre(self, tmp_path: Path) -> None:
        asked = EgoTopic(topic="/odom", size_m=(4.6, 1.9, 1.5), centre_from_rear_axle_m=1.4)
        found = read_log(self.drive(tmp_path), name="a", topic="/boxes", fields=fields(), ego=asked)
        ego = state(found, "ego", 0.5)
        assert [ego[k] for k in ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m")] == [
            6.4,
            0,
            0.75,
            4.6,
            1.9,
            1.5,
        ]
        assert found.scene.ego_sized
        assert not [n for n in found.notes if n.startswith("ego:")]

    def test_no_poses_on_the_topic(self, tmp_path: Path) -> None:
        with pytest.raises(
            RecordingError, match=r"ego: no poses on topic '/pose'; poses are on: /odom \(nav_msgs/msg/Odometry\)"
        ):
            read_log(self.drive(tmp_path), name="a", topic="/boxes", fields=fields(), ego=EgoTopic(topic="/pose"))

    def test_lists_in_the_egos_frame_are_brought_into_the_world(self, tmp_path: Path) -> None:
        found = read_log(self.drive(tmp_path, list_frame="base_link"), name="a", topic="/boxes", fields=fields())
        assert state(found, "7", 0.5)["x_m"] == 10.0  # 5 m ahead of an ego at 5 m
        assert state(found, "7", 0.5)["vx_mps"] == 10.0
        assert "lists in the frame base_link: brought into map" in found.notes

    def test_through_a_chain_of_transforms(self, tmp_path: Path) -> None:
        """A lidar 2 m ahead of the base, that looks to the left."""
        static = topic(
            "/tf_static", "tf2_msgs/msg/TFMessage",
            [(0.0, made("tf2_msgs/msg/TFMessage", transforms=[transform(0.0, "base_link", "lidar", 2.0, 0.0, 90.0)]))],
        )  # fmt: skip
        found = read_log(self.drive(tmp_path, static, list_frame="lidar"), name="a", topic="/boxes", fields=fields())
        walker = state(found, "7", 0.5)  # at (5, 0.5) of the lidar
        assert (walker["x_m"], walker["y_m"]) == (5.0 + 2.0 - 0.5, 5.0)
        assert abs(walker["yaw_rad"]) == pytest.approx(np.pi)

    def test_a_frame_that_nothing_places(self, tmp_path: Path) -> None:
        path = self.drive(tmp_path, list_frame="camera")
        with pytest.raises(RecordingError) as caught:
            read_log(path, name="a", topic="/boxes", fields=fields())
        assert caught.value.problems == (
            f"{path}: /boxes: lists are in the frame 'camera', the ego in 'map', and no transform of the recording "
            "says how they lie",
        )


def scene_update(t_s: float) -> dict[str, Any]:
    """A car at 5 m/s; an arrow beside it that is no object."""
    cube = {
        "pose": {"position": {"x": 10 + 5 * t_s, "y": 0, "z": 1}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}},
        "size": {"x": 4, "y": 2, "z": 1.5},
    }
    at = {"sec": ns(t_s) // 10**9, "nsec": ns(t_s) % 10**9}
    metadata = [{"key": "speed", "value": "fast bus"}, {"key": "category", "value": "vehicle.car"}]
    entities = [{"id": "c1", "timestamp": at, "frame_id": "map", "cubes": [cube], "metadata": metadata}]
    return {
        "deletions": [],
        "entities": [*entities, {"id": "x", "timestamp": at, "frame_id": "map", "cubes": [], "metadata": []}],
    }


def test_scene_updates_in_json(tmp_path: Path) -> None:
    messages = [(t, scene_update(t)) for t in TIMES]
    path = write_mcap(tmp_path / "a.mcap", [json_topic("/scene", messages, schema="foxglove.SceneUpdate")])
    found = read_log(path, name="a")
    assert classes(found) == {"c1": "car"}
    assert state(found, "c1", 0.5)["x_m"] == 12.5
    assert state(found, "c1", 0.5)["vx_mps"] == 5.0


def test_the_same_drive_as_osi_and_as_ros_2() -> None:
    paths = [SHARED / f"nuscenes_scene0916{kind}.mcap" for kind in ("", "_autoware_ros2")]
    if not all(path.exists() for path in paths):
        pytest.skip(f"no {paths[1].name} in {SHARED}")
    osi = read_log(paths[0], name="a")
    size = tuple(float(getattr(osi.truth, n)[0, 0]) for n in ("length_m", "width_m", "height_m"))
    ros = read_log(paths[1], name="a", ego=EgoTopic(topic="/localization/kinematic_state", size_m=size))
    assert len(osi.scene.object_ids) == len(ros.scene.object_ids)
    assert len(osi.truth.frame_ix) == len(ros.truth.frame_ix)
    np.testing.assert_allclose(osi.truth.captured_s, ros.truth.captured_s, atol=1e-6)

    def states(one: Recording, shift: np.ndarray) -> np.ndarray:
        truth, scene = one.truth, one.scene
        others = truth.row_object_ix != scene.ego_ix
        rows = np.column_stack(
            [truth.frame_ix, truth.x_m[0] - shift[0], truth.y_m[0] - shift[1], truth.length_m[0], truth.vx_mps[0]]
        )[others]
        return rows[np.lexsort((np.round(rows[:, 2], 3), np.round(rows[:, 1], 3), rows[:, 0]))]

    # The ROS 2 file has the map's coordinates, the other is moved to near the origin.
    by = np.array(
        [np.median(ros.truth.x_m) - np.median(osi.truth.x_m), np.median(ros.truth.y_m) - np.median(osi.truth.y_m)]
    )
    a, b = states(osi, np.zeros(2)), states(ros, np.round(by))
    np.testing.assert_allclose(a[:, 1:4], b[:, 1:4], atol=2e-2)
