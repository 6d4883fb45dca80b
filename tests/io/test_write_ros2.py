"""A replay of a ROS 2 recording is one of ROS 2: written, decoded by rosbags, and read back by this project."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from copem_replay.core.colours import configuration_colours
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, NO_CAPTURE_NS, UNCERTAINTIES, VALUES, Scene
from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.io.recorded_lists import read_described_lists
from copem_replay.io.recording import Recording, read_log
from copem_replay.io.write.mcap import OSI_RECORD, write_mcap
from copem_replay.io.write.message_family import OSI, RUN_RECORD, find_family
from copem_replay.io.write.ros2 import LABELS
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.replay import replay_block
from tests.helpers.recordings import SHARED, Obj, ns, write_recording
from tests.helpers.replays import save_run

TRACKED = """\
std_msgs/Header header
autoware_perception_msgs/TrackedObject[] objects
{rule}
MSG: autoware_perception_msgs/TrackedObject
unique_identifier_msgs/UUID object_id
float32 existence_probability
autoware_perception_msgs/ObjectClassification[] classification
autoware_perception_msgs/TrackedObjectKinematics kinematics
autoware_perception_msgs/Shape shape
{rule}
MSG: autoware_perception_msgs/ObjectClassification
uint8 label
float32 probability
{rule}
MSG: autoware_perception_msgs/TrackedObjectKinematics
geometry_msgs/PoseWithCovariance pose_with_covariance
geometry_msgs/TwistWithCovariance twist_with_covariance
geometry_msgs/AccelWithCovariance acceleration_with_covariance
uint8 orientation_availability
bool is_stationary
{rule}
MSG: autoware_perception_msgs/Shape
uint8 type
geometry_msgs/Polygon footprint
geometry_msgs/Vector3 dimensions
""".format(rule="=" * 80)
TRACKED_NAME, ODOMETRY = "autoware_perception_msgs/msg/TrackedObjects", "nav_msgs/msg/Odometry"
TOPIC = "/tracks"
T0_S = 1_700_000_000
LABEL_OF = {"car": 1, "truck": 2, "bicycle": 6, "pedestrian": 7}

EXPERIMENT = """\
version: 1
logs: [drive.mcap]
seed: 1
ego: {topic: /odom, size_m: [4.0, 1.8, 1.5], centre_from_rear_axle_m: 1.4}
pems:
  onboard:
    - detection: {kind: constant, probability: 0.8}
      error:
        kind: gaussian
        covariance_m2: [[1.0, 0.3], [0.3, 0.5]]
        yaw_sigma_deg: 3
        size_sigma_m: 0.05
        speed_sigma_mps: 0.4
units:
  ego: {on: ego, height_m: 1.8, pem: onboard}
  mast: {at: [12.0, -4.5], height_m: 5.0, pem: onboard}
configurations:
  GT: {units: truth}
  PEM: {units: [ego]}
  coPEM: {units: all, latency_s: 0.25}
  gnn: {units: all, latency_s: 0.1, fusion: {kind: gnn}}
show: {run: 0}
"""


def course(k: int) -> list[tuple[str, int, float, float, float, float]]:
    """What is there in frame k: class, number, x, y, yaw, speed."""
    t = k / 10
    return [
        ("car", 1, 60.0 - 8.0 * t, 3.5, np.pi, 8.0),
        ("pedestrian", 2, 25.0, -6.0 + 1.2 * t, np.pi / 2, 1.2),
        ("bicycle", 3, 30.0 + 3.0 * t, -8.0 + 2.0 * t, float(np.arctan2(2.0, 3.0)), float(np.hypot(3.0, 2.0))),
        *([("truck", 4, 40.0, 8.0, 0.4, 0.0)] if k > 5 else []),
    ]


SIZES = {"car": (4.2, 1.8, 1.5), "pedestrian": (0.5, 0.7, 1.75), "bicycle": (1.8, 0.6, 1.7), "truck": (9.0, 2.5, 3.2)}


def drive(path: Path, frame_id: str = "map") -> Path:
    """3 s at 10 Hz as rosbag2 leaves them: its record, QoS, an ego from odometry and tracks of Autoware's."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(TRACKED, TRACKED_NAME))
    kinds: Any = store.types
    geometry = "geometry_msgs/msg/"

    def made(kind: str, *values: Any) -> Any:
        return kinds[kind](*values)

    def vector(x: float, y: float, z: float) -> Any:
        return made(f"{geometry}Vector3", x, y, z)

    def posed(x: float, y: float, z: float, yaw: float) -> Any:
        turn = made(f"{geometry}Quaternion", 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))
        pose = made(f"{geometry}Pose", made(f"{geometry}Point", x, y, z), turn)
        return made(f"{geometry}PoseWithCovariance", pose, np.zeros(36))

    def moved(speed: float) -> Any:
        twist = made(f"{geometry}Twist", vector(speed, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        return made(f"{geometry}TwistWithCovariance", twist, np.zeros(36))

    still = made(f"{geometry}Accel", vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    still = made(f"{geometry}AccelWithCovariance", still, np.zeros(36))
    autoware = "autoware_perception_msgs/msg/"
    qos = {"offered_qos_profiles": "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2"}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="tests")
        writer.add_metadata("rosbag2", {"ROS_DISTRO": "humble"})
        writer.add_metadata("rosbag2", {"serialized_metadata": "message_count: 62"})
        channels = {
            topic: writer.register_channel(
                topic,
                "cdr",
                writer.register_schema(name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode()),
                qos,
            )
            for topic, name in (("/odom", ODOMETRY), (TOPIC, TRACKED_NAME))
        }
        for k in range(31):
            stamp = made("builtin_interfaces/msg/Time", T0_S + k // 10, k % 10 * 100_000_000)
            header = made("std_msgs/msg/Header", stamp, frame_id)
            items = [
                made(
                    f"{autoware}TrackedObject",
                    made("unique_identifier_msgs/msg/UUID", np.full(16, number, dtype=np.uint8)),
                    0.9,
                    [made(f"{autoware}ObjectClassification", LABEL_OF[kind], 1.0)],
                    made(
                        f"{autoware}TrackedObjectKinematics",
                        posed(x, y, SIZES[kind][2] / 2, yaw), moved(speed), still, 2, speed == 0.0,
                    ),
                    made(f"{autoware}Shape", 0, made(f"{geometry}Polygon", []), vector(*SIZES[kind])),
                )
                for kind, number, x, y, yaw, speed in course(k)
            ]  # fmt: skip
            odometry = made(ODOMETRY, header, "base_link", posed(0.5 * k, 0.0, 0.0, 0.0), moved(5.0))
            at = (T0_S * 10 + k) * 10**8
            for topic, name, message in (
                ("/odom", ODOMETRY, odometry),
                (TOPIC, TRACKED_NAME, made(TRACKED_NAME, header, items)),
            ):
                writer.add_message(channels[topic], at + 7, bytes(store.serialize_cdr(message, name)), at + 7)
        writer.finish()
    return path


class Written:
    """The drive, written once for all tests."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.source = folder, drive(folder / "drive.mcap")
        (folder / "e.yaml").write_text(EXPERIMENT)
        source = read_experiment_file(folder / "e.yaml")
        experiment, found = find_problems(source)
        assert experiment is not None, found
        self.experiment: Experiment = experiment
        (self.recording,) = read_logs(experiment, log_paths(source)[0], source)[0]
        self.replay: Replay = prepare_log(self.recording, experiment)
        self.run_tracks: dict[str, FusedTracks] = tracks_of_run(self.replay, experiment, 0)
        self.table: pd.DataFrame = replay_block(self.replay, experiment, np.array([0]))
        self.path = folder / "replay.mcap"
        self.notes = self.write(self.path)

    def write(self, path: Path, source: Path | None = None) -> list[str]:
        return write_mcap(
            path,
            source or self.source,
            self.replay.scene,
            [(self.run_tracks, ())],
            self.table,
            {"run": "0"},
            find_family(self.recording),
            colours=configuration_colours(self.run_tracks, ()),
        )


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    return Written(tmp_path_factory.mktemp("ros2"))


def decoded(path: Path, topic: str | None = None) -> Iterator[tuple[int, bytes, Any]]:
    """Log time, bytes and message, as rosbags understands the schemas in the file; re-encoded the same bytes."""
    stores: dict[int, Any] = {}
    with path.open("rb") as file:
        topics = None if topic is None else [topic]
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(topics=topics):
            if not channel.topic.startswith("copem/"):
                continue
            assert schema is not None
            if schema.id not in stores:
                stores[schema.id] = get_typestore(Stores.EMPTY)
                stores[schema.id].register(get_types_from_msg(schema.data.decode(), schema.name))
            found = stores[schema.id].deserialize_cdr(message.data, schema.name)
            assert bytes(stores[schema.id].serialize_cdr(found, schema.name)) == message.data
            yield message.log_time, message.data, found


def name_of(fused_tracks: FusedTracks, scene: Scene, row: int) -> str:
    names, which = fused_tracks.names_of(scene)
    return names[which[row]]


def stamp_of(time: Any) -> int:
    return int(time.sec * 10**9 + time.nanosec)


def test_the_profile_stays_valid_and_the_input_untouched(written: Written) -> None:
    with written.path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        records = {record.name: record.metadata for record in reader.iter_metadata()}
        out = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages() if not c.topic.startswith("copem/")]
    assert summary is not None
    assert records.keys() == {"rosbag2", RUN_RECORD}, "no record of OSI"
    assert records["rosbag2"] == {"ROS_DISTRO": "humble"}, "what counted the messages is gone"
    schemas = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    for channel in summary.channels.values():
        assert channel.message_encoding == "cdr"
        assert schemas[channel.topic].encoding == "ros2msg"
        (qos,) = parse_qos(channel.metadata["offered_qos_profiles"]) if channel.topic.startswith("copem/") else (None,)
        assert qos is None or (qos.depth, qos.reliability.name, qos.durability.name) == (10, "RELIABLE", "VOLATILE")
    for name in written.experiment.configurations:
        assert schemas[f"copem/{name}/objects"].name == "autoware_perception_msgs/msg/DetectedObjects"
        assert schemas[f"copem/{name}/scene"].name == "foxglove_msgs/msg/SceneUpdate"
        assert schemas[f"copem/{name}/detail"].name == "std_msgs/msg/String"
    with written.source.open("rb") as file:
        assert out == [(c.topic, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]
    assert written.notes == []


@pytest.mark.parametrize("configuration", ["GT", "PEM", "coPEM", "gnn"])
def test_every_column_comes_back(written: Written, configuration: str) -> None:
    fused_tracks, scene = written.run_tracks[configuration], written.replay.scene
    fused, said, kinds = fused_tracks.fused, fused_tracks.said, fused_tracks.class_of(scene)
    lists = list(decoded(written.path, f"copem/{configuration}/objects"))
    details = [json.loads(m.data) for _, _, m in decoded(written.path, f"copem/{configuration}/detail")]
    assert len(lists) == len(details) == len(fused.stamp_ns)
    seen = 0
    for frame, ((log_ns, _, message), detail) in enumerate(zip(lists, details, strict=True)):
        assert stamp_of(message.header.stamp) == log_ns == scene.t0_ns + round(fused.arrives_s[0, frame] * 1e9)
        assert message.header.frame_id == "map"
        rows = fused_tracks.listed(frame)
        assert len(message.objects) == len(detail["objects"]) == len(rows)
        for item, beside, p in zip(message.objects, detail["objects"], rows, strict=True):
            seen += 1
            assert beside["id"] == name_of(fused_tracks, scene, p)
            pose, twist = item.kinematics.pose_with_covariance, item.kinematics.twist_with_covariance
            at, turn, size = pose.pose.position, pose.pose.orientation, item.shape.dimensions
            assert (at.x, at.y, at.z) == (fused.x_m[0, p], fused.y_m[0, p], fused.z_m[0, p])
            yaw = 2 * np.arctan2(turn.z, turn.w)
            assert np.exp(1j * yaw) == pytest.approx(np.exp(1j * fused.yaw_rad[0, p]), abs=1e-12)
            v = np.exp(1j * yaw) * complex(twist.twist.linear.x, twist.twist.linear.y)
            assert v == pytest.approx(complex(fused.vx_mps[0, p], fused.vy_mps[0, p]), abs=1e-9)
            assert item.kinematics.has_twist
            assert item.kinematics.orientation_availability == 2
            cylinder = CLASSES[kinds[p]] == "pedestrian"
            assert item.shape.type == int(cylinder)
            sides = (fused.length_m[0, p], fused.width_m[0, p])
            if cylinder:
                assert size.x == size.y == pytest.approx(sum(sides) / 2)
                assert (beside["length_m"], beside["width_m"]) == sides
            else:
                assert (size.x, size.y) == sides
            assert size.z == fused.height_m[0, p]
            assert fused.cov_ee_m2 is not None
            assert fused.cov_nn_m2 is not None
            for name, places in (("cov_ee_m2", [0]), ("cov_en_m2", [1, 6]), ("cov_nn_m2", [7]), ("yaw_var_rad2", [35])):
                column = getattr(fused, name)
                assert [pose.covariance[k] for k in places] == [0 if column is None else column[0, p]] * len(places)
            assert np.count_nonzero(pose.covariance) <= 5
            known = bool(fused.cov_ee_m2[0, p] > 0 and fused.cov_nn_m2[0, p] > 0)
            assert item.kinematics.has_position_covariance == known
            fast = 0.0 if fused.speed_var_m2ps2 is None else fused.speed_var_m2ps2[0, p]
            assert twist.covariance[0] == twist.covariance[7] == fast
            assert item.kinematics.has_twist_covariance == bool(fast > 0)
            assert beside["size_var_m2"] == (None if fused.size_var_m2 is None else fused.size_var_m2[0, p])
            expected = dict.fromkeys([LABELS[CLASSES[kinds[p]]]], 1.0)
            if said is not None:
                expected = {}
                for name, share in zip(CLASSES, said["class_probability"][p], strict=True):
                    expected[LABELS[name]] = expected.get(LABELS[name], 0.0) + share
            shares = {c.label: c.probability for c in item.classification}
            assert shares == pytest.approx({label: share for label, share in expected.items() if share}, abs=1e-6)
            assert item.existence_probability == pytest.approx(1.0 if said is None else said["existence"][p], abs=1e-6)
    assert seen > 50


def test_scene_updates_draw_each_list_anew(written: Written) -> None:
    fused_tracks, scene = written.run_tracks["gnn"], written.replay.scene
    updates = list(decoded(written.path, "copem/gnn/scene"))
    assert len(updates) == len(fused_tracks.fused.stamp_ns)
    for frame, (log_ns, _, update) in enumerate(updates):
        assert [(d.type, stamp_of(d.timestamp), d.id) for d in update.deletions] == [(1, log_ns, "")]
        rows = fused_tracks.listed(frame)
        assert [e.id for e in update.entities] == [name_of(fused_tracks, scene, p) for p in rows]
        for entity, p in zip(update.entities, rows, strict=True):
            assert (entity.frame_id, stamp_of(entity.timestamp), stamp_of(entity.lifetime)) == ("map", log_ns, 0)
            assert {m.key: m.value for m in entity.metadata} == {
                "configuration": "gnn", "class": CLASSES[fused_tracks.class_of(scene)[p]], "object": entity.id,
            }  # fmt: skip
            (cube,) = entity.cubes
            at, size, color = cube.pose.position, cube.size, cube.color
            fused = fused_tracks.fused
            assert [at.x, at.y, at.z, size.x, size.y, size.z] == [
                getattr(fused, n)[0, p] for n in ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m")
            ]
            yaw = 2 * np.arctan2(cube.pose.orientation.z, cube.pose.orientation.w)
            assert np.cos(yaw - fused.yaw_rad[0, p]) == pytest.approx(1)
            assert color.a == 0.5
            shades = configuration_colours(written.run_tracks, ())["gnn"]
            assert (color.r, color.g, color.b) == tuple(shade / 255 for shade in shades)


@pytest.mark.parametrize("configuration", ["GT", "coPEM", "gnn"])
def test_read_back_as_the_lists_of_a_unit(written: Written, configuration: str) -> None:
    fused_tracks, scene = written.run_tracks[configuration], written.replay.scene
    fused = fused_tracks.fused
    back = read_described_lists(written.path, f"copem/{configuration}/objects", scene, None)
    assert back is not None
    rows = [p for frame in range(len(fused.stamp_ns)) for p in fused_tracks.listed(frame)]
    assert len(back.tracks.frame_ix) == len(rows) > 0
    np.testing.assert_allclose(back.tracks.arrives_s, fused.arrives_s, atol=1e-9)
    np.testing.assert_array_equal(back.tracks.frame_ix, fused.frame_ix[rows])
    for name in (*VALUES, *UNCERTAINTIES):  # round ones have their length and width beside the list
        column = getattr(fused, name)
        unsaid = 0.0 if name in (*VALUES, *UNCERTAINTIES[:3]) else np.nan
        expected = np.full(len(rows), unsaid) if column is None else np.nan_to_num(column[0, rows], nan=unsaid)
        found = getattr(back.tracks, name)[0]
        if name == "yaw_rad":
            expected, found = np.cos(expected - found), np.ones(len(rows))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9, err_msg=name)
    captured = fused.stamp_ns != NO_CAPTURE_NS
    assert (fused.stamp_ns[captured] < scene.t0_ns + np.rint(fused.arrives_s[0, captured] * 1e9)).any() or (
        configuration == "GT"
    )
    np.testing.assert_array_equal(back.tracks.stamp_ns[captured], fused.stamp_ns[captured])
    np.testing.assert_array_equal(back.capture_said, captured)
    if fused_tracks.said is not None:
        np.testing.assert_array_equal(back.existence, fused_tracks.said["existence"][rows])
    assert back.class_probability.argmax(axis=1).tolist() == fused_tracks.class_of(scene)[rows].tolist()


def test_read_back_as_a_log_it_is_the_input(written: Written) -> None:
    a, b = written.recording, read_log(written.path, name="again", ego=written.experiment.ego)
    assert (a.topic, a.world, a.encoding) == (b.topic, b.world, b.encoding) == (TOPIC, "map", "cdr")
    assert a.scene.object_ids == b.scene.object_ids
    for name in ("stamp_ns", "start", "frame_ix", "object_ix", *VALUES):
        np.testing.assert_array_equal(getattr(a.truth, name), getattr(b.truth, name), err_msg=name)


def test_the_same_bytes_again_and_into_its_own_output(written: Written, tmp_path: Path) -> None:
    written.write(tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == written.path.read_bytes()
    notes = written.write(tmp_path / "twice.mcap", source=written.path)
    assert any("earlier replay" in note for note in notes)
    assert [m[:2] for m in decoded(tmp_path / "twice.mcap")] == [m[:2] for m in decoded(written.path)]


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "/map", "local_map", "карта"])
def test_names_of_any_length_do_not_shift_what_follows(written: Written, tmp_path: Path, frame_id: str) -> None:
    source = drive(tmp_path / "drive.mcap", frame_id)
    (tmp_path / "e.yaml").write_text(EXPERIMENT)
    recording = read_log(source, name="drive", ego=written.experiment.ego)
    target = tmp_path / "out.mcap"
    family, colours = find_family(recording), configuration_colours(written.run_tracks, ())
    tracks = [(written.run_tracks, ())]
    write_mcap(target, source, written.replay.scene, tracks, written.table, {}, family, colours=colours)
    lists = [m for _, _, m in decoded(target) if hasattr(m, "header")]
    assert {m.header.frame_id for m in lists} == {frame_id.lstrip("/") or "map"}
    assert sum(len(m.objects) for m in lists) == sum(int(b.fused.valid.sum()) for b in written.run_tracks.values())


def folder_of(path: Path) -> tuple[Recording, Path]:
    """The results folder of the experiment at `path`."""
    source = read_experiment_file(path)
    experiment, found = find_problems(source)
    assert experiment is not None, found
    recordings = read_logs(experiment, log_paths(source)[0], source)[0]
    save_run(path.parent / "out", experiment, recordings)
    return recordings[0], path.parent / "out" / "replay.mcap"


def schemas_in(path: Path) -> set[tuple[str, str]]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {(c.topic, summary.schemas[c.schema_id].name) for c in summary.channels.values()}


def test_the_results_folder_has_it(tmp_path: Path) -> None:
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(EXPERIMENT)
    _, path = folder_of(tmp_path / "e.yaml")
    assert ("copem/coPEM/objects", "autoware_perception_msgs/msg/DetectedObjects") in schemas_in(path)
    assert sum(1 for _ in decoded(path)) > 100


def test_a_recording_of_osi_gets_messages_of_osi(tmp_path: Path) -> None:
    frames = [(k / 10, [Obj(id=1), Obj(id=2, x=30.0 - k)]) for k in range(11)]
    path = write_recording(tmp_path / "drive.mcap", frames, host=1)
    recording = read_log(path, name="drive")
    assert (recording.encoding, recording.world) == ("protobuf", "")
    assert find_family(recording).func is OSI  # type: ignore[attr-defined]


def scene_updates(path: Path) -> Path:
    """A Foxglove recording: two cubes for 2 s, in the frame `odom`."""
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
    from mcap_protobuf.writer import Writer as ProtobufWriter

    with path.open("wb") as file, ProtobufWriter(file) as writer:
        for k in range(21):
            update = SceneUpdate()
            for name, x in (("a", 0.0), ("b", 30.0 - k)):
                entity = update.entities.add(id=name, frame_id="odom")
                entity.timestamp.FromNanoseconds(ns(k / 10))
                entity.metadata.add(key="class", value="car")
                cube = entity.cubes.add()
                cube.pose.position.x, cube.pose.orientation.w = x, 1.0
                cube.size.x, cube.size.y, cube.size.z = 4.0, 2.0, 1.5
            writer.write_message("/boxes", update, log_time=ns(k / 10), publish_time=ns(k / 10))
    return path


def test_a_recording_of_foxglove_gets_scene_updates_in_its_own_frame(tmp_path: Path) -> None:
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    scene_updates(tmp_path / "drive.mcap")
    text = EXPERIMENT.replace(
        "ego: {topic: /odom, size_m: [4.0, 1.8, 1.5], centre_from_rear_axle_m: 1.4}", "ego: a\nread: {topic: /boxes}"
    )
    (tmp_path / "e.yaml").write_text(text)
    _, path = folder_of(tmp_path / "e.yaml")
    found = schemas_in(path)
    assert {("copem/GT/scene", "foxglove.SceneUpdate"), ("copem/GT/objects", "osi3.SensorData")} < found
    with path.open("rb") as file:
        reader = make_reader(file)
        assert OSI_RECORD in {record.name for record in reader.iter_metadata()}
        updates = [SceneUpdate.FromString(m.data) for _, _, m in reader.iter_messages(topics=["copem/GT/scene"])]
    assert {entity.frame_id for update in updates for entity in update.entities} == {"odom"}


@pytest.mark.long
def test_a_real_recording_of_autoware(tmp_path: Path) -> None:
    source = SHARED / "nuscenes_scene0916_autoware_ros2.mcap"
    if not source.exists():
        pytest.skip("shared/data with recordings is not beside the project")
    text = EXPERIMENT.replace("drive.mcap", str(source)).replace("/odom", "/localization/kinematic_state")
    (tmp_path / "e.yaml").write_text(text)
    recording, path = folder_of(tmp_path / "e.yaml")
    kinds = {type(m).__name__ for _, _, m in decoded(path)}
    assert {k.rsplit("__", 1)[-1] for k in kinds} == {
        "DetectedObjects", "SceneUpdate", "String", "Status", "FrameTransform",
    }  # fmt: skip
    lists = list(decoded(path, "copem/GT/objects"))
    assert len(lists) == len(recording.truth.stamp_ns)
    assert sum(len(m.objects) for _, _, m in lists) > 1000
