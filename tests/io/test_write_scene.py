"""What replay.mcap holds for looking at: statuses, ellipses, the truth as a scene, the frame to follow.

The small experiment: a car is 60 m away, its onset, 1 s after the log starts, and drives towards the ego at 10 m/s.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader

import copem_replay as cr
from copem_replay.io.encodings.cdr_bytes import encode_cdr
from copem_replay.io.encodings.column_bytes import encode_messages
from copem_replay.io.encodings.ros2_types import message_definition
from copem_replay.io.recording import read_log
from copem_replay.io.write.detail import KNOWN, LISTED, NOT_LISTED
from copem_replay.io.write.scene import (
    Draw,
    Ellipse,
    Entity,
    Line,
    MovingEntities,
    Pose,
    Text,
    draw_moving,
    draw_scenes,
    principal_axes,
    transform_content,
)
from tests.helpers.experiments import changed, drive
from tests.oracles import messages as plain

GREY = (0.5, 0.5, 0.5, 1.0)
DRAWN = [
    Entity(
        "odd",
        {"class": "car", "object": "1"},
        lines=[Line([(0, 0, 0), (1, 2, 3), (4, 5, 6)], GREY)],
        texts=[Text("a text", GREY, above_m=(0.75, 0.5))],
        ellipses=[Ellipse((4, 2, 0.1), GREY), Ellipse((1, 1, 1), GREY)],
        pose=Pose(1, 2, 3, 0.5),
    ),
    Entity("nothing"),
    Entity("text alone", texts=[Text("x", GREY)] * 2),
]


def messages(path: Path, topic: str) -> list[tuple[int, bytes]]:
    with path.open("rb") as file:
        return [(m.log_time, m.data) for *_, m in make_reader(file).iter_messages(topics=[topic])]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("scene")
    drive(place / "drive.mcap")
    lines = (
        "show: {run: 1}",
        "measure: {onset: {kind: in_range, range_m: 60}, confirm: {hits: 2, of: 3}}",
        "obstacles: [{polygon_m: [[10, 10], [20, 10], [20, 20]], height_m: 4.0}]",
    )
    text = changed(*lines).replace("  coPEM:", "  gnn: {units: all, latency_s: 0.2, fusion: {kind: gnn}}\n  coPEM:")
    (place / "e.yaml").write_text(text)
    return cr.run(place / "e.yaml").save(place / "r")


class TestStatus:
    def test_nothing_is_known_before_the_table_says_so(self, results: Path) -> None:
        table = pd.read_parquet(results / "detections.parquet").query("run == 1")
        seen = []
        for row in table.itertuples():
            found = messages(results / "replay.mcap", f"copem/{row.configuration}/status")
            assert len(found) > 20
            t0_ns = messages(results / "replay.mcap", "copem/truth/scene")[0][0]
            for time_ns, data in found:
                (status,) = (o["status"] for o in json.loads(data)["objects"] if o["id"] == row.object_id)
                known = row.detected and (time_ns - t0_ns) * 1e-9 >= row.detection_s - 1e-6
                assert status == NOT_LISTED or (status == KNOWN) == known, (row.configuration, time_ns)
                seen.append(status)
        assert set(seen) == {NOT_LISTED, LISTED, KNOWN}

    def test_it_is_known_with_the_list_that_detects_it(self, results: Path) -> None:
        table = pd.read_parquet(results / "detections.parquet").query("run == 1 and detected")
        assert set(table["configuration"]) >= {"GT", "gnn"}
        for row in table.itertuples():
            found = messages(results / "replay.mcap", f"copem/{row.configuration}/status")
            t0_ns = messages(results / "replay.mcap", "copem/truth/scene")[0][0]
            known = [
                time_ns
                for time_ns, data in found
                for each in json.loads(data)["objects"]
                if each["id"] == row.object_id and each["status"] == KNOWN
            ]
            assert (known[0] - t0_ns) * 1e-9 == pytest.approx(row.detection_s, abs=1e-6)

    def test_entries_are_as_old_as_their_latency(self, results: Path) -> None:
        found = [json.loads(data)["objects"] for _, data in messages(results / "replay.mcap", "copem/coPEM/status")]
        ages = {each["age_s"] for objects in found for each in objects if each["status"] != NOT_LISTED}
        assert ages
        assert all(age_s == pytest.approx(0.5, abs=1e-3) for age_s in ages)


class TestTruth:
    def test_an_outline_for_every_object(self, results: Path) -> None:
        found = messages(results / "replay.mcap", "copem/truth/scene")
        assert len(found) == 31
        update = SceneUpdate.FromString(found[10][1])
        bodies = {e.id: e for e in update.entities if not e.id.startswith("unit ")}
        assert set(bodies) == {"1", "2", "3"}
        pose = bodies["2"].lines[0].pose
        assert (pose.position.x, pose.position.y) == pytest.approx((60.0, 0.0))
        assert [text.text for text in bodies["2"].texts] == ["2 car"]
        assert [text.text for text in bodies["3"].texts] == [], "not measured"
        assert "unit ego" in {e.id for e in update.entities}

    def test_what_does_not_move_is_said_once(self, results: Path) -> None:
        ((_, data),) = messages(results / "replay.mcap", "copem/truth/static")
        found = {e.id: e for e in SceneUpdate.FromString(data).entities}
        assert set(found) == {"unit mast", "obstacle 0:0"}
        (field,) = found["unit mast"].lines
        radii = [math.hypot(point.x, point.y) for point in field.points]
        assert radii == pytest.approx([80.0] * len(radii)), "the range of its PEM"
        assert {round(point.z, 2) for point in field.points} == {-4.95}, "on the ground under it"
        top = found["obstacle 0:0"].lines[1]
        assert {(point.x, point.y) for point in top.points} == {(10, 10), (20, 10), (20, 20)}

    @pytest.mark.extras
    def test_houses_of_a_map_are_one_entity(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        houses = "".join(
            f'<object id="{k}" type="building" s="{20 + 10 * k}" t="20" length="6" width="4" height="5"/>'
            for k in (0, 1)
        )
        line = '<planView><geometry s="0" x="0" y="0" hdg="0" length="90"><line/></geometry></planView>'
        (tmp_path / "town.xodr").write_text(
            f'<OpenDRIVE><road id="1" length="90">{line}<objects>{houses}</objects></road></OpenDRIVE>'
        )
        (tmp_path / "e.yaml").write_text(changed("show: {run: 0}", "maps: [{file: town.xodr, frame: same}]"))
        ((_, data),) = messages(cr.run(tmp_path / "e.yaml").save(tmp_path / "r") / "replay.mcap", "copem/truth/static")
        (entity,) = (e for e in SceneUpdate.FromString(data).entities if "unit" not in e.id)
        assert (entity.id, len(entity.lines)) == ("solids of maps", 4)
        assert {(p.x, p.y, p.z) for p in entity.lines[1].points} == {(x, y, 5) for x in (17, 23) for y in (18, 22)}

    def test_lanes_are_one_entity_of_what_does_not_move(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        (tmp_path / "e.yaml").write_text(changed("show: {run: 0}"))
        boundaries = [[[0.0, 2, 0], [50, 2, 0]], [[0.0, -2, 0], [50, -2, 0], [60, -3, 0.5]]]
        recording = read_log(tmp_path / "drive.mcap", name="drive")
        recording = replace(recording, lane_boundaries=tuple(map(np.array, boundaries)))
        folder = cr.run(tmp_path / "e.yaml", recording).save(tmp_path / "r")
        ((_, data),) = messages(folder / "replay.mcap", "copem/truth/static")
        (lanes,) = (e for e in SceneUpdate.FromString(data).entities if e.id == "lanes")
        assert [[[point.x, point.y, point.z] for point in line.points] for line in lanes.lines] == boundaries

    def test_the_frame_to_follow_is_the_ego(self, results: Path) -> None:
        found = [
            FrameTransform.FromString(data) for _, data in messages(results / "replay.mcap", "copem/truth/transform")
        ]
        assert len(found) == 31
        assert {(f.parent_frame_id, f.child_frame_id) for f in found} == {("global", "copem_ego")}
        assert {(f.translation.x, f.translation.y, f.rotation.w) for f in found} == {(0.0, 0.0, 1.0)}

    def test_without_an_ego_it_stands_amid_all_objects(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap", host=None)
        at = "measure: {onset: {kind: at, time_s: 1.0}, distance_to: mast}"
        text = changed("show: {run: 0}", at, "ego: none").replace("  ego: {on: ego, height_m: 1.8, pem: onboard}\n", "")
        (tmp_path / "e.yaml").write_text(text.replace("PEM: {units: [ego]}", "PEM: {units: [mast]}", 1))
        folder = cr.run(tmp_path / "e.yaml").save(tmp_path / "r")
        found = [
            FrameTransform.FromString(data) for _, data in messages(folder / "replay.mcap", "copem/truth/transform")
        ]
        assert {f.child_frame_id for f in found} == {"copem_middle"}
        assert len({f.translation.SerializeToString() for f in found}) == 1

    def test_a_configuration_of_that_name_has_its_topics(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        (tmp_path / "e.yaml").write_text(changed("show: {run: 0}").replace("  GT:", "  truth:"))
        folder = cr.run(tmp_path / "e.yaml").save(tmp_path / "r")
        assert messages(folder / "replay.mcap", "copem/truth/objects")
        assert SceneUpdate.FromString(messages(folder / "replay.mcap", "copem/truth/scene")[0][1]).entities[0].cubes
        assert not messages(folder / "replay.mcap", "copem/truth/transform")

    def test_is_left_out_where_it_is_not_to_be_shown(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        (tmp_path / "e.yaml").write_text(changed("show: {run: 0, truth: false}"))
        folder = cr.run(tmp_path / "e.yaml").save(tmp_path / "r")
        with (folder / "replay.mcap").open("rb") as file, (tmp_path / "drive.mcap").open("rb") as recorded:
            ours, theirs = make_reader(file), make_reader(recorded)
            topics = {channel.topic for channel in ours.get_summary().channels.values()}
            assert not [topic for topic in topics if topic.startswith("copem/truth")]
            assert "copem/PEM/objects" in topics
            truth = [c.topic for c in theirs.get_summary().channels.values()]
            passed = [(m.log_time, m.data) for *_, m in ours.iter_messages(topics=truth)]
            assert passed == [(m.log_time, m.data) for *_, m in theirs.iter_messages(topics=truth)]
            assert passed


class TestUncertainty:
    @pytest.mark.parametrize(
        ("covariance", "expected"),
        [
            ((4.0, 0.0, 1.0), (2.0, 1.0, 0.0)),
            ((1.0, 0.0, 4.0), (2.0, 1.0, math.pi / 2)),
            ((1.0, 0.5, 1.0), (math.sqrt(1.5), math.sqrt(0.5), math.pi / 4)),
        ],
    )
    def test_axes(self, covariance: tuple[float, float, float], expected: tuple[float, float, float]) -> None:
        found = principal_axes(*(np.array([value]) for value in covariance))
        assert [float(value[0]) for value in found] == pytest.approx(expected)

    def test_ellipses_of_two_sigma_where_a_covariance_is_claimed(self, results: Path) -> None:
        found = [SceneUpdate.FromString(data) for _, data in messages(results / "replay.mcap", "copem/PEM/uncertainty")]
        ellipses = [cylinder for update in found for entity in update.entities for cylinder in entity.cylinders]
        assert len(ellipses) > 5
        for ellipse in ellipses:  # of a variance of 0.5 m² in all directions
            assert (ellipse.size.x, ellipse.size.y) == pytest.approx((4 * math.sqrt(0.5),) * 2)
        late = messages(results / "replay.mcap", "copem/coPEM/uncertainty")
        faded = [e.cylinders[0].color.a for _, data in late for e in SceneUpdate.FromString(data).entities]
        assert set(np.round(faded, 3)) == {0.375}, "half as old as what is palest"
        truth = messages(results / "replay.mcap", "copem/GT/uncertainty")
        assert all(not SceneUpdate.FromString(data).entities for _, data in truth)


SCENE_UPDATE, TRANSFORM = "foxglove_msgs/msg/SceneUpdate", "foxglove_msgs/msg/FrameTransform"
IN_PROTOBUF: Draw = partial(draw_scenes, partial(encode_messages, SceneUpdate.DESCRIPTOR), "map")
IN_ROS2: Draw = partial(draw_scenes, partial(encode_cdr, SCENE_UPDATE), "map")


def same_scenes(moving: MovingEntities, frames: list[list[Entity]]) -> None:
    """In protobuf the bytes of its library, in ROS 2 messages of the same content."""
    expected = [plain.drawn_scene(each, "map", ns) for each, ns in zip(frames, moving.time_ns.tolist(), strict=True)]
    assert list(draw_moving(moving, IN_PROTOBUF)) == expected
    decoded = [plain.decode_ros2(SCENE_UPDATE, data) for data in draw_moving(moving, IN_ROS2)]
    found = [plain.content_of(message, SceneUpdate.DESCRIPTOR) for message in decoded]
    assert found == [plain.content_of(SceneUpdate.FromString(data), SceneUpdate.DESCRIPTOR) for data in expected]


def test_entities_once() -> None:
    for entities in (DRAWN, [DRAWN[1]], []):
        same_scenes(MovingEntities.at(1_500_000_000, entities), [entities])


def test_moving_entities_are_the_messages_of_each_frame_alone() -> None:
    """Frames of nothing, of one and of several entities; at 0, where protobuf leaves numbers out, and turned by π."""
    looks, look_ix = DRAWN, [0, 2, 1, 0, 0]
    moving = MovingEntities(
        looks, np.array([0, 1_500_000_000, 2_000_000_000, 3_000_000_001]), np.array([0, 1, 1, 4, 5]),
        np.array(look_ix), *(np.array(column) for column in (
            [0.0, 1.0, 2.0, -3.0, 4.0], [0.0, 5.0, 6.0, 7.0, -8.0], [0.0, -0.75, 1.0, 2.0, 3.0],
            [0.0, 0.5, math.pi, -2.0, 1e-9],
        ))
    )  # fmt: skip
    frames = [[0], [], [1, 2, 3], [4]]
    columns = moving.x_m, moving.y_m, moving.z_m, moving.yaw_rad
    same_scenes(
        moving,
        [[looks[look_ix[r]].placed(Pose(*(float(c[r]) for c in columns))) for r in rows] for rows in frames],
    )


def test_both_families_place_a_frame_alike() -> None:
    poses = [Pose(1.0, 2.0, 3.0, math.pi / 3), Pose()]
    content = transform_content("map", "copem_ego", poses, np.array([2_000_000_001, -1]))
    ours = [FrameTransform.FromString(data) for data in encode_messages(FrameTransform.DESCRIPTOR, content, 2)]
    theirs = [plain.decode_ros2(TRANSFORM, data) for data in encode_cdr(TRANSFORM, content, 2)]
    for one, other in zip(ours, theirs, strict=True):
        assert plain.content_of(one, FrameTransform.DESCRIPTOR) == plain.content_of(other, FrameTransform.DESCRIPTOR)
    first, last = ours
    assert (first.parent_frame_id, first.child_frame_id) == ("map", "copem_ego")
    assert (first.translation.x, first.translation.y, first.translation.z) == (1.0, 2.0, 3.0)
    assert (first.rotation.x, first.rotation.z, first.rotation.w) == pytest.approx((0, 0.5, math.sqrt(0.75)))
    assert (first.timestamp.seconds, first.timestamp.nanos) == (2, 1)
    assert (last.rotation.z, last.rotation.w, last.timestamp.seconds) == (0, 1, -1)
    with pytest.raises(KeyError, match="foxglove_msgs/FrameTransform has no child"):
        encode_cdr(TRANSFORM, {"child": 1.0}, 1)


def test_statuses_of_ros_have_their_words() -> None:
    assert "string status" in message_definition("copem_replay_msgs/msg/Status").decode()
