"""MCAP out, read back: by the plain mcap and protobuf libraries, and by this project itself."""

from __future__ import annotations

import io
import itertools
import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import Writer
from osi3.osi_sensordata_pb2 import SensorData

from copem_replay.core.colours import configuration_colours
from copem_replay.core.errors import OutputError, RecordingError
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import NO_CAPTURE_NS, UNCERTAINTIES, VALUES
from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.io.recorded_lists import read_sensor_data
from copem_replay.io.recording import read_log
from copem_replay.io.write import osi as sensor_data
from copem_replay.io.write.detail import DetailWriter
from copem_replay.io.write.mcap import OSI_RECORD, BatchWriter, atomic_mcap, write_mcap
from copem_replay.io.write.message_family import RUN_RECORD, find_family
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.replay import replay_block
from tests.oracles import messages as plain

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "logs/tc016d.mcap"
RUN = 3


class Written:
    """The sample scenario, written once for all tests: every kind of error, late and fresh units."""

    def __init__(self, folder: Path) -> None:
        source = read_experiment_file(ROOT / "logs/tc016d.yaml")
        error = {
            "kind": "gaussian", "covariance_m2": [[1.0, 0.3], [0.3, 0.5]], "yaw_sigma_deg": 3, "size_sigma_m": 0.05,
            "speed_sigma_mps": 0.4,
        }  # fmt: skip
        for pem in source.data["pems"].values():
            pem[0]["error"] = error
        source.data["configurations"]["mixed"] = {"units": "all", "latency_s": {"ego": 0, "default": 0.25}}
        experiment, found = find_problems(source)
        assert experiment is not None, found
        self.experiment: Experiment = experiment
        (self.recording,) = read_logs(experiment, log_paths(source)[0], source)[0]
        self.replay: Replay = prepare_log(self.recording, experiment)
        self.run_tracks: dict[str, FusedTracks] = tracks_of_run(self.replay, experiment, RUN)
        self.table: pd.DataFrame = replay_block(self.replay, experiment, np.array([RUN]))
        self.path = folder / "replay.mcap"
        self.notes = self.write(self.path)

    def write(self, path: Path, source: Path = SOURCE) -> list[str]:
        manifest = {"experiment": "version: 1", "run": str(RUN)}
        colours = configuration_colours(self.run_tracks, ())
        tracks, scene = [(self.run_tracks, ())], self.replay.scene
        return write_mcap(path, source, scene, tracks, self.table, manifest, colours=colours)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    return Written(tmp_path_factory.mktemp("write"))


def messages(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    """Topic, log time, publish time, sequence and payload of every message, as mcap reads them."""
    with path.open("rb") as file:
        return [
            (channel.topic, m.log_time, m.publish_time, m.sequence, m.data)
            for _, channel, m in make_reader(file, validate_crcs=True).iter_messages()
        ]


def metadata(path: Path) -> dict[str, dict[str, str]]:
    with path.open("rb") as file:
        records = [(record.name, dict(record.metadata)) for record in make_reader(file).iter_metadata()]
    assert len({name for name, _ in records}) == len(records), "no record twice"
    return dict(records)


def test_the_inputs_messages_are_untouched_and_all_is_in_order_of_time(written: Written) -> None:
    out = messages(written.path)
    assert [m for m in out if not m[0].startswith("copem/")] == messages(SOURCE)
    times = [m[1] for m in out]
    assert times == sorted(times)
    assert written.notes == []


def test_channels_and_records(written: Written) -> None:
    with written.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    schemas = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    for name in written.experiment.configurations:
        assert schemas[f"copem/{name}/objects"] == "osi3.SensorData"
        assert schemas[f"copem/{name}/scene"] == "foxglove.SceneUpdate"
        assert schemas[f"copem/{name}/detail"] == "copem_replay.ListDetail"
    assert len({(s.name, s.data) for s in summary.schemas.values()}) == len(summary.schemas)
    osi = metadata(written.path)[OSI_RECORD]
    for key in ("version", "min_osi_version", "max_osi_version", "min_protobuf_version", "max_protobuf_version"):
        assert len(osi[key].split(".")) == 3, key
    for key, value in metadata(SOURCE)[OSI_RECORD].items():
        if not key.startswith(("min_", "max_")):
            assert osi[key] == value
    ours = metadata(written.path)["org.copem_replay.run"]  # a name of the file format, whatever modules are called
    assert ours["run"] == str(RUN)
    assert sorted(v for k, v in ours.items() if k.startswith("unit.")) == sorted(["truth", *written.experiment.units])


@pytest.mark.parametrize("configuration", ["GT", "PEM", "coPEM:0.5s", "mixed"])
def test_sensor_data_says_what_was_believed(written: Written, configuration: str) -> None:
    fused_tracks, scene = written.run_tracks[configuration], written.replay.scene
    fused = fused_tracks.fused
    lists = [m for m in messages(written.path) if m[0] == f"copem/{configuration}/objects"]
    assert len(lists) == len(fused.stamp_ns)

    def sigma(name: str, row: int) -> float:
        variance = getattr(fused, name)
        assert variance is not None
        return math.sqrt(variance[0, row])

    units = {int(k[5:]): v for k, v in metadata(written.path)[RUN_RECORD].items() if k.startswith("unit.")}
    seen = 0
    for frame, (_topic, log_time, publish_time, _sequence, payload) in enumerate(lists):
        data = SensorData.FromString(payload)
        stamp = data.timestamp.seconds * 10**9 + data.timestamp.nanos
        assert log_time == publish_time == stamp == scene.t0_ns + round(fused.arrives_s[0, frame] * 1e9)
        captured = data.last_measurement_time.seconds * 10**9 + data.last_measurement_time.nanos
        assert captured == fused.stamp_ns[frame]
        assert data.HasField("mounting_position")
        assert not data.HasField("host_vehicle_location")
        items = {str(i.header.ground_truth_id[0].value): i for i in [*data.moving_object, *data.stationary_object]}
        rows = [p for p in np.flatnonzero(fused.frame_ix == frame) if fused.valid[0, p]]
        assert set(items) == {scene.object_ids[fused.row_object_ix[p]] for p in rows}
        for p in rows:
            seen += 1
            item = items[scene.object_ids[fused.row_object_ix[p]]]
            base, spread = item.base, item.base_rmse
            assert (base.position.x, base.position.y, base.position.z) == (
                fused.x_m[0, p],
                fused.y_m[0, p],
                fused.z_m[0, p],
            )
            assert base.orientation.yaw == fused.yaw_rad[0, p]
            assert base.dimension.length == fused.length_m[0, p]
            assert base.dimension.width == fused.width_m[0, p]
            assert base.dimension.height == fused.height_m[0, p]
            assert (spread.position.x, spread.position.y) == (sigma("cov_ee_m2", p), sigma("cov_nn_m2", p))
            assert spread.orientation.yaw == sigma("yaw_var_rad2", p)
            size = spread.dimension
            assert (size.length, size.width, size.height) == (sigma("size_var_m2", p),) * 3
            if scene.moving[fused.row_object_ix[p]]:
                assert (base.velocity.x, base.velocity.y) == (fused.vx_mps[0, p], fused.vy_mps[0, p])
                assert (spread.velocity.x, spread.velocity.y) == (sigma("speed_var_m2ps2", p),) * 2
            assert item.header.existence_probability == 1
            entries = fused_tracks.entries[fused_tracks.start[p] : fused_tracks.start[p + 1]]
            behind = [k for k in entries if fused_tracks.received.valid[0, k]]
            assert [units[i.value] for i in item.header.sensor_id] == [
                fused_tracks.received.units[fused_tracks.received.row_unit_ix[k]] for k in behind
            ]
            newest = max(fused_tracks.received.stamp_ns[fused_tracks.received.frame_ix[k]] for k in behind)
            assert (item.header.measurement_state == 2) == (newest == captured), "measured, or only from an older list"
    assert seen > 100


def test_ids_beyond_64_bits_are_hashed() -> None:
    assert sensor_data.osi_id("18446744073709551615") == 2**64 - 1
    assert sensor_data.osi_id("stationary:7") == 7
    assert 0 <= sensor_data.osi_id("18446744073709551616") < 2**64
    assert sensor_data.osi_id("18446744073709551616") != sensor_data.osi_id("18446744073709551617")


def test_scene_updates_draw_each_list_anew(written: Written) -> None:
    fused, scene = written.run_tracks["PEM"].fused, written.replay.scene
    colour = configuration_colours(written.run_tracks, ())["PEM"]
    assert max(colour) > 100
    updates = [m for m in messages(written.path) if m[0] == "copem/PEM/scene"]
    assert len(updates) == len(fused.stamp_ns)
    for frame, (_topic, log_time, _publish, _sequence, payload) in enumerate(updates):
        update = SceneUpdate.FromString(payload)
        assert [d.type for d in update.deletions] == [1], "one deletion of all"
        assert update.deletions[0].timestamp.ToNanoseconds() == log_time
        rows = [p for p in np.flatnonzero(fused.frame_ix == frame) if fused.valid[0, p]]
        assert {e.id for e in update.entities} == {scene.object_ids[fused.row_object_ix[p]] for p in rows}
        by_id = {e.id: e for e in update.entities}
        for p in rows:
            entity = by_id[scene.object_ids[fused.row_object_ix[p]]]
            assert (entity.frame_id, entity.timestamp.ToNanoseconds()) == ("global", log_time)
            (cube,) = entity.cubes
            # Colours are shares of 1, and what is inside of a box stays visible.
            assert (cube.color.r, cube.color.g, cube.color.b) == tuple(shade / 255 for shade in colour)
            assert cube.color.a == 0.5
            assert (cube.pose.position.x, cube.pose.position.y) == (fused.x_m[0, p], fused.y_m[0, p])
            assert (cube.size.x, cube.size.y, cube.size.z) == (
                fused.length_m[0, p], fused.width_m[0, p], fused.height_m[0, p],
            )  # fmt: skip
            yaw = 2 * np.arctan2(cube.pose.orientation.z, cube.pose.orientation.w)
            assert np.cos(yaw - fused.yaw_rad[0, p]) == pytest.approx(1)


def test_details_tell_entries_and_detections(written: Written) -> None:
    details = [json.loads(m[4]) for m in messages(written.path) if m[0] == "copem/mixed/detail"]
    events = [(d["available_ns"], e) for d in details for e in d["events"]]
    row = written.table[(written.table["configuration"] == "mixed") & written.table["detected"]].iloc[0]
    ((available_ns, event),) = events
    assert available_ns == written.replay.scene.t0_ns + round(row["detection_s"] * 1e9)
    assert event["object"] == row["object_id"]
    assert event["first_unit"] == row["first_unit"]
    assert event["time_to_detection_s"] == row["time_to_detection_s"]


def test_details_are_of_the_object_they_stand_beside(written: Written) -> None:
    """Object by object in the order of the list: what it was made of, and its variances."""
    fused_tracks, scene = written.run_tracks["mixed"], written.replay.scene
    fused, received, view = fused_tracks.fused, fused_tracks.received, fused_tracks.view
    assert view is not None
    contents = [json.loads(m[4]) for m in messages(written.path) if m[0] == "copem/mixed/detail"]
    assert len(contents) == len(fused.stamp_ns)
    several = 0
    for frame, content in enumerate(contents):
        rows = [p for p in np.flatnonzero(fused.frame_ix == frame) if fused.valid[0, p]]
        assert content["captured_ns"] == fused.stamp_ns[frame]
        assert content["available_ns"] == scene.t0_ns + round(fused.arrives_s[0, frame] * 1e9)
        assert sorted(one["id"] for one in content["objects"]) == sorted(
            scene.object_ids[fused.row_object_ix[p]] for p in rows
        )
        for one in content["objects"]:
            (p,) = [p for p in rows if scene.object_ids[fused.row_object_ix[p]] == one["id"]]
            used = [
                k
                for k in fused_tracks.entries[fused_tracks.start[p] : fused_tracks.start[p + 1]]
                if received.valid[0, k]
            ]
            several += len(used) > 1
            assert one["units"] == [received.units[received.row_unit_ix[k]] for k in used]
            assert one["captured_ns"] == [received.stamp_ns[received.frame_ix[k]] for k in used]
            assert one["range_m"] == [view.range_m[k] for k in used]
            assert one["visible_share"] == [view.visible_share[k] for k in used]
            assert [one[name] for name in UNCERTAINTIES] == [getattr(fused, name)[0, p] for name in UNCERTAINTIES]
    assert several > 100


def test_a_list_of_nothing_was_captured_never(written: Written) -> None:
    fused_tracks = written.run_tracks["PEM"]
    never = np.full(len(fused_tracks.fused.stamp_ns), NO_CAPTURE_NS)
    silent = replace(fused_tracks.fused, stamp_ns=never, valid=np.zeros_like(fused_tracks.fused.valid))
    writer = DetailWriter(written.replay.scene, replace(fused_tracks, fused=silent), {})
    content = json.loads(next(writer.messages(np.full(len(never), 7))))
    assert content == {"available_ns": 7, "captured_ns": None, "objects": [], "events": []}


def test_read_back_as_a_log_it_is_the_input(written: Written) -> None:
    a, b = written.recording, read_log(written.path, name="again")
    assert a.scene.object_ids == b.scene.object_ids
    assert a.scene.ego_ix == b.scene.ego_ix
    for name in ("stamp_ns", "start", "frame_ix", "object_ix", *VALUES):
        np.testing.assert_array_equal(getattr(a.truth, name), getattr(b.truth, name), err_msg=name)


def rows_by_key(tracks: Any) -> dict[tuple[int, int], int]:
    return {
        (int(o), int(f)): p
        for p, (o, f) in enumerate(zip(tracks.row_object_ix, tracks.frame_ix, strict=True))
        if tracks.valid[0, p]
    }


@pytest.mark.parametrize("configuration", ["GT", "PEM", "coPEM:0.5s", "mixed"])
def test_read_back_as_lists_every_column_is_there(written: Written, configuration: str) -> None:
    fused = written.run_tracks[configuration].fused
    back = read_sensor_data(written.path, f"copem/{configuration}/objects", written.replay.scene)
    np.testing.assert_array_equal(back.stamp_ns, fused.stamp_ns)
    np.testing.assert_allclose(back.arrives_s, fused.arrives_s, atol=1e-9)
    np.testing.assert_allclose(back.captured_s, fused.captured_s, atol=1e-9)
    ours, theirs = rows_by_key(fused), rows_by_key(back)
    assert set(ours) == set(theirs)
    order, other = [ours[k] for k in ours], [theirs[k] for k in ours]
    moving = written.replay.scene.moving[fused.row_object_ix[order]]
    for name in (*VALUES, *UNCERTAINTIES):
        expected, found = getattr(fused, name)[0, order], getattr(back, name)[0, other]
        keep = moving if name in ("vx_mps", "vy_mps") else np.ones(len(order), dtype=bool)
        np.testing.assert_array_equal(found[keep], expected[keep], err_msg=name)


def test_lists_of_a_real_unit_are_read() -> None:
    path = ROOT.parent / "shared/data/msight_trial3.mcap"
    if not path.exists():
        pytest.skip("shared/data with recordings is not beside the project")
    scene = read_log(path, name="trial3").scene
    lists = read_sensor_data(path, "mcity.RSU.SensorData", scene)
    assert len(lists.stamp_ns) == 278
    assert (np.diff(lists.arrives_s[0]) >= 0).all()
    with pytest.raises(RecordingError, match=r"mcity\.RSU\.SensorData"):
        read_sensor_data(path, "nowhere", scene)


def test_lists_that_cannot_be_decoded_and_a_foreign_detail_topic(written: Written, tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="other")
        lists = writer.register_channel(
            "u/objects", "protobuf", writer.register_schema("osi3.SensorData", "protobuf", b"")
        )
        foreign = writer.register_channel("u/detail", "json", writer.register_schema("their.Detail", "jsonschema", b""))
        writer.add_message(lists, 7, SensorData().SerializeToString(), 7)
        writer.add_message(foreign, 7, b"no json", 7)
        bad = writer.register_channel("bad", "protobuf", writer.register_schema("osi3.SensorData", "protobuf", b"2"))
        writer.add_message(bad, 8, b"\xff\xff", 8)
        writer.finish()
    assert read_sensor_data(path, "u/objects", written.replay.scene).stamp_ns.tolist() == [7]
    with pytest.raises(RecordingError, match="bad: none of its 1 messages can be decoded"):
        read_sensor_data(path, "bad", written.replay.scene)


def test_the_same_bytes_again(written: Written, tmp_path: Path) -> None:
    written.write(tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == written.path.read_bytes()


def test_a_recording_of_osi_is_written_as_ever(written: Written, tmp_path: Path) -> None:
    """Channels and records in their places: what is written for other families moves nothing here."""
    family = find_family(written.recording)
    manifest = {"experiment": "version: 1", "run": str(RUN)}
    path = tmp_path / "out.mcap"
    tracks, colours = [(written.run_tracks, ())], configuration_colours(written.run_tracks, ())
    write_mcap(path, SOURCE, written.replay.scene, tracks, written.table, manifest, family, colours=colours)
    assert path.read_bytes() == written.path.read_bytes()
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        records = [record.name for record in reader.iter_metadata()]
    assert summary is not None
    assert records == [RUN_RECORD, OSI_RECORD]
    added = [c for c in summary.channels.values() if c.topic.startswith("copem/")]
    ours = [c for c in added if c.topic.endswith(("/objects", "/scene", "/detail"))]
    kinds = (
        ("objects", "protobuf", "osi3.SensorData", True),
        ("scene", "protobuf", "foxglove.SceneUpdate", False),
        ("detail", "json", "copem_replay.ListDetail", False),
    )
    others = len(summary.channels) - len(added)
    assert [(c.id, c.topic, c.message_encoding, summary.schemas[c.schema_id].name, bool(c.metadata)) for c in ours] == [
        (others + 1 + 3 * k + i, f"copem/{name}/{kind}", *rest)
        for k, name in enumerate(written.run_tracks)
        for i, (kind, *rest) in enumerate(kinds)
    ]
    scene = written.replay.scene
    for name, fused_tracks in written.run_tracks.items():
        numbers = {v: int(k[5:]) for k, v in metadata(path)[RUN_RECORD].items() if k.startswith("unit.")}
        lists = [(m[1], m[4]) for m in messages(path) if m[0] == f"copem/{name}/objects"]
        assert lists == [
            (at, plain.sensor_data(scene, fused_tracks, numbers, frame, at)) for frame, (at, _) in enumerate(lists)
        ]


def test_what_counts_the_messages_is_dropped(written: Written, tmp_path: Path) -> None:
    source = tmp_path / "bag.mcap"
    with source.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="other")
        writer.add_metadata("rosbag2", {"serialized_metadata": "message_count: 1"})
        writer.finish()
    written.write(tmp_path / "out.mcap", source=source)
    assert "rosbag2" not in metadata(tmp_path / "out.mcap")


def test_written_into_its_own_output_the_old_lists_are_replaced_and_it_is_said(
    written: Written, tmp_path: Path
) -> None:
    notes = written.write(tmp_path / "twice.mcap", source=written.path)
    assert any("earlier replay" in note for note in notes)
    assert metadata(tmp_path / "twice.mcap") == metadata(written.path)  # no record twice
    assert messages(tmp_path / "twice.mcap") == messages(written.path)


def test_metadata_attachments_and_foreign_channels_are_kept(written: Written, tmp_path: Path) -> None:
    source = tmp_path / "rich.mcap"
    with source.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="mine", library="other")
        schema = writer.register_schema("their.Schema", "jsonschema", b"{}")
        for _ in range(2):  # the same channel twice: libraries do that
            channel = writer.register_channel("their/topic", "json", schema, {"b": "2", "a": "1"})
            writer.add_message(channel, 5, b'{"x":1}', 7, 9)
        writer.register_channel("silent", "json", schema, {})
        writer.add_attachment(1, 2, "calibration.txt", "text/plain", b"data")
        writer.add_metadata("their.record", {"k": "v"})
        writer.add_metadata(OSI_RECORD, {"min_osi_version": "3.5.0", "max_osi_version": "3.10.0", "authors": "them"})
        writer.finish()
    written.write(tmp_path / "out.mcap", source=source)
    assert [m for m in messages(tmp_path / "out.mcap") if m[0] == "their/topic"] == [
        ("their/topic", 5, 7, 9, b'{"x":1}')
    ] * 2
    records = metadata(tmp_path / "out.mcap")
    assert records["their.record"] == {"k": "v"}
    osi = records[OSI_RECORD]
    assert (osi["authors"], osi["min_osi_version"], osi["max_osi_version"]) == ("them", "3.5.0", "3.10.0")
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "mine"
        assert [(a.name, a.data, a.log_time) for a in reader.iter_attachments()] == [("calibration.txt", b"data", 2)]
        summary = reader.get_summary()
    assert summary is not None
    assert [c.topic for c in summary.channels.values() if not c.topic.startswith("copem/")].count("their/topic") == 1
    assert any(c.topic == "silent" for c in summary.channels.values())


def rich(path: Path) -> None:
    """Two channels of one topic, told apart by their metadata alone; an attachment twice; a record in two parts."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="mine", library="other")
        schema = writer.register_schema("their.Schema", "jsonschema", b"{}")
        writer.add_metadata("their.record", {"first": "1", "both": "early"})
        writer.add_metadata("other.record", {"k": "v"})
        writer.add_metadata("their.record", {"second": "2", "both": "late"})
        for _ in range(2):
            writer.add_attachment(1, 2, "calibration.txt", "text/plain", b"data")
        writer.add_attachment(1, 2, "calibration.txt", "text/plain", b"other data")
        for k, frame in enumerate(("left", "right")):
            channel = writer.register_channel("their/topic", "json", schema, {"frame": frame})
            writer.add_message(channel, k, frame.encode(), k)
        writer.finish()


@pytest.mark.parametrize("indexed", [True, False])
def test_what_differs_in_metadata_alone_stays_apart_and_what_belongs_together_is_one(
    written: Written, tmp_path: Path, indexed: bool
) -> None:
    source, out = tmp_path / "rich.mcap", tmp_path / "out.mcap"
    rich(source)
    if not indexed:  # read from its start
        source.write_bytes(source.read_bytes()[:-40])
    written.write(out, source=source)
    with out.open("rb") as file:
        reader = make_reader(file)
        theirs = [(c.metadata, m.data) for _, c, m in reader.iter_messages() if c.topic == "their/topic"]
        attached = [a.data for a in reader.iter_attachments()]
    assert theirs == [({"frame": "left"}, b"left"), ({"frame": "right"}, b"right")]
    assert sorted(attached) == [b"data", b"other data"]
    records = metadata(out)
    assert records["their.record"] == {"first": "1", "second": "2", "both": "late"}
    assert records["other.record"] == {"k": "v"}


def test_a_damaged_recording_is_copied_as_far_as_it_goes(written: Written, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    content = written.path.read_bytes()
    cut.write_bytes(content[: len(content) * 3 // 5])
    notes = written.write(tmp_path / "out.mcap", source=cut)
    assert any("damaged" in note for note in notes)
    truth = [m for m in messages(tmp_path / "out.mcap") if m[0] == "ground_truth"]
    assert 0 < len(truth) < 81
    assert truth == messages(SOURCE)[: len(truth)]


def test_nothing_is_left_when_writing_fails(written: Written, tmp_path: Path) -> None:
    target = tmp_path / "deep" / "out.mcap"
    with pytest.raises(ZeroDivisionError), atomic_mcap(target, profile=""):
        raise ZeroDivisionError
    assert list(target.parent.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        written.write(tmp_path / "file" / "out.mcap")


SIZES = st.one_of(st.integers(0, 30), st.sampled_from([968, 969, 970, 4000]))  # 1000 bytes with the head are no chunk
MESSAGES = st.lists(
    st.builds(
        lambda channel, log_ns, size, publish_ns, sequence: Message(
            channel, log_ns, bytes(k % 251 for k in range(size)), publish_ns, sequence
        ),
        st.integers(1, 3), st.integers(0, 2**64 - 1), SIZES, st.integers(0, 2**64 - 1), st.integers(0, 2**32 - 1),
    ),
    max_size=12,
)  # fmt: skip


@given(st.lists(MESSAGES, max_size=4))
def test_messages_at_once_are_written_as_one_by_one(batches: list[list[Message]]) -> None:
    """The bytes of mcap's own writer; its reader finds the messages by the index, and checksums hold."""

    def written(at_once: bool) -> bytes:
        out = io.BytesIO()
        writer = BatchWriter(out, chunk_size=1000, enable_data_crcs=True)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        for topic in ("a", "b", "c"):
            writer.register_channel(topic, "json", schema)
        for batch in batches:
            if at_once:
                writer.add_messages(batch)
            else:
                for m in batch:
                    writer.add_message(m.channel_id, m.log_time, m.data, m.publish_time, m.sequence)
        writer.finish()
        return out.getvalue()

    content = written(at_once=True)
    assert content == written(at_once=False)
    reader = make_reader(io.BytesIO(content), validate_crcs=True)
    found = [m for *_, m in reader.iter_messages()]
    assert found == sorted(itertools.chain(*batches), key=lambda m: m.log_time)


KILLED = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
import copem_replay.io.write.mcap as write
from tests.io.test_write_mcap import Written
folder = Path({folder!r})
original = write.BatchWriter.add_messages
count = 0
def slowly(self, messages):
    global count
    for message in messages:
        count += 1
        if count == {stop}:
            print("now", flush=True)
            sys.stdin.read()
        original(self, [message])
write.BatchWriter.add_messages = slowly
Written(folder)
"""


@pytest.mark.long
@pytest.mark.parametrize("stop", [1, 300, 1200])
def test_killed_at_any_moment_no_half_written_file_has_the_name(tmp_path: Path, stop: int) -> None:
    code = KILLED.format(tests=str(Path(__file__).parents[2]), folder=str(tmp_path), stop=stop)
    child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdin is not None
    assert child.stdout.readline() == b"now\n"
    os.kill(child.pid, signal.SIGKILL)
    child.communicate()
    assert not (tmp_path / "replay.mcap").exists()
