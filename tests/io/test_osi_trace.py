"""OSI's single-channel traces: lengths and messages, and nothing that says what they are."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from osi3.osi_sensordata_pb2 import SensorData
from osi3trace.osi_trace import OSITrace

from copem_replay.cli.main import main
from copem_replay.core.errors import RecordingError
from copem_replay.experiment.draft.findings import TopicFound
from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.io.open import open_log
from copem_replay.io.recorded_lists import read_recorded
from copem_replay.io.recording import read_log
from copem_replay.io.write.mcap import OSI_RECORD
from tests.helpers.experiments import ALL_COUNT, changed
from tests.helpers.recordings import SHARED, Obj, ground_truth, pedestrian, sensor_view, write_recording

FRAMES: list[tuple[float, list[Obj]]] = [
    (k / 10, [Obj(id=1, x=1.0 * k, vx=10.0), pedestrian(2, 50.0, 3.0)]) for k in range(30)
]
TRUTHS = [ground_truth(t_s, objects, host=1) for t_s, objects in FRAMES]
VIEWS = [sensor_view(t_s, ground_truth(None, objects, host=1)) for t_s, objects in FRAMES]


def listed(t_s: float) -> Any:
    """A list of a unit: one object, with what only a detected object has."""
    data = SensorData()
    data.timestamp.seconds, data.timestamp.nanos = divmod(round(t_s * 1e9), 10**9)
    data.last_measurement_time.CopyFrom(data.timestamp)
    item = data.moving_object.add()
    item.header.tracking_id.value, item.header.existence_probability = 4, 0.75
    item.base.position.x, item.base.position.y = 12.0, 3.0
    item.base.dimension.length = 4.0
    return data


LISTS = [listed(k / 10) for k in range(30)]
BY_NAME = "20260102T030405Z_{}_3.8.0_6.33.1_30_name.osi"


def packed(messages: Sequence[Any]) -> bytes:
    payloads = [m if isinstance(m, bytes) else m.SerializeToString() for m in messages]
    return b"".join(struct.pack("<I", len(p)) + p for p in payloads)


def trace(folder: Path, messages: Sequence[Any], name: str = "log.osi") -> Path:
    path = folder / name
    path.write_bytes(packed(messages))
    return path


def problem(path: Path) -> str:
    """The one line that says why a trace cannot be read; looking at it says the same."""
    with pytest.raises(RecordingError) as caught:
        read_log(path, name="log")
    (line,) = caught.value.problems
    assert survey_recording(path).reason == line
    return line.removeprefix(f"{path}: ")


TAKEN = "taken for osi3.{} by its messages: the name of the file {}"


@pytest.mark.parametrize(
    ("messages", "kind", "short"), [(TRUTHS, "GroundTruth", "gt"), (VIEWS, "SensorView", "sv")], ids=["gt", "sv"]
)
@pytest.mark.parametrize("name", ["log.osi", "LOG.OSI", BY_NAME, "{}_380_2961_30_name.osi", "{}_380_2961_30.osi"])
def test_truth(tmp_path, messages, kind, short, name):
    """The same as in MCAP; what it was taken for is said where the name does not."""
    path = trace(tmp_path, messages, name.format(short))
    recording = read_log(path, name="log")
    assert recording.topic == kind
    assert recording.host_id == "1"
    assert recording.scene.object_ids == ("1", "2")
    assert recording.truth.stamp_ns.tolist() == [k * 10**8 for k in range(30)]
    assert recording.truth.x_m[0, :30].tolist() == [float(k) for k in range(30)]
    derived = "velocity of 30 object states is 0"
    said = [] if short in path.name else [TAKEN.format(kind, "does not say")]
    assert [n for n in recording.notes if not n.startswith(derived)] == said


def test_lists_of_a_unit(tmp_path):
    path = trace(tmp_path, LISTS)
    truth = read_log(trace(tmp_path, TRUTHS, "truth.osi"), name="log")
    lists = read_recorded(path, "SensorData", truth.scene)
    assert lists.tracks.x_m[0].tolist() == [12.0] * 30
    assert lists.existence.tolist() == [0.75] * 30
    assert survey_recording(path).topics == [
        TopicFound(topic="SensorData", schema="osi3.SensorData", encoding="protobuf", messages=30, role="unit")
    ]
    assert problem(path).startswith("no list of true objects; it holds osi3.SensorData on SensorData; ")


@pytest.mark.parametrize(("messages", "kind"), [(TRUTHS, "GroundTruth"), (VIEWS, "SensorView"), (LISTS, "SensorData")])
@pytest.mark.parametrize("said", ["gt", "sv", "sd"])
def test_name_that_cannot_be_true(tmp_path, messages, kind, said):
    """The messages hold."""
    log = open_log(trace(tmp_path, messages, BY_NAME.format(said)))
    assert log.channels[0].schema == f"osi3.{kind}"
    true = {"GroundTruth": "gt", "SensorView": "sv", "SensorData": "sd"}[kind]
    assert log.notes == (() if said == true else (TAKEN.format(kind, f"says {said}"),))


@pytest.mark.parametrize("kind", ["GroundTruth", "SensorView", "SensorData"])
@pytest.mark.parametrize(
    "path", sorted(SHARED.glob("*.mcap")) or [pytest.param(None, marks=pytest.mark.skip("no data"))]
)
def test_kind_of_real_messages(tmp_path, path, kind):
    """Messages of many writers, from 3.0 on, without a name to go by."""
    log = open_log(path)
    numbers = frozenset(c.number for c in log.channels if c.schema == f"osi3.{kind}" and c.messages)
    payloads = [payload for _, _, payload in log.payloads(numbers)]
    if not payloads:
        pytest.skip(f"no {kind} in {path.name}")
    (channel,) = open_log(trace(tmp_path, payloads)).channels
    assert (channel.schema, channel.messages) == (f"osi3.{kind}", len(payloads))


def test_newer_release(tmp_path):
    """Fields that this release does not know do not hide what it knows."""
    unknown = b"\xfa\xff\x03" + bytes([60]) + b"x" * 60  # field 8191, 60 bytes
    log = open_log(trace(tmp_path, [m.SerializeToString() + unknown for m in TRUTHS]))
    assert log.channels[0].schema == "osi3.GroundTruth"


def test_messages_that_say_nothing(tmp_path):
    """Version and time are the same in all kinds: the name decides, and without one nobody can tell."""
    empty = [ground_truth(t_s) for t_s, _ in FRAMES]
    assert problem(trace(tmp_path, empty)) == (
        "its messages can be told for none of osi3.GroundTruth, osi3.SensorView, osi3.SensorData; if they are, name "
        "the file by OSI's convention: 20260102T030405Z_gt_380_2961_10_name.osi"
    )
    named = open_log(trace(tmp_path, empty, BY_NAME.format("sv")))
    assert (named.channels[0].schema, named.notes) == ("osi3.SensorView", ())


def test_kinds_that_are_not_read(tmp_path):
    path = trace(tmp_path, TRUTHS, BY_NAME.format("tu"))
    assert problem(path) == "osi3.TrafficUpdate by its name, which is not read; gt, sv, sd are"


def test_mcap_by_another_name(tmp_path):
    path = write_recording(tmp_path / "log.mcap", FRAMES).rename(tmp_path / "log.osi")
    assert read_log(path, name="log").topic == "truth"


def test_out_of_order(tmp_path):
    """Messages come in the order of their time stamps."""
    log = open_log(trace(tmp_path, TRUTHS[::-1]))
    assert [t for _, t, _ in log.payloads(frozenset({1}))] == [k * 10**8 for k in range(30)]
    assert log.start_ns == 0


# ------------------------------------------------------------------------------- damage


def test_every_cut(tmp_path):
    """Wherever the file ends: the messages before it."""
    whole = packed(TRUTHS[:4])
    ends = [len(packed(TRUTHS[:k])) for k in range(5)]
    path = tmp_path / "gt_380_2961_30_cut.osi"
    for length in range(1, len(whole)):
        path.write_bytes(whole[:length])
        count = sum(end <= length for end in ends) - 1
        if count == 0:
            assert problem(path).startswith("expected an OSI trace, found ")
            continue
        log = open_log(path)
        assert log.channels[0].messages == count
        assert log.damage == (None if length in ends else "the file ends too early")


def test_cut_is_said(tmp_path):
    path = tmp_path / BY_NAME.format("gt")
    path.write_bytes(packed(TRUTHS)[:-1])
    assert (
        read_log(path, name="log").damage == "damaged after 2.800 s: 29 of 30 messages read (the file ends too early)"
    )


@pytest.mark.parametrize("length", [2**32 - 1, 2**31, 10**6])
def test_hostile_length(tmp_path, length):
    """What is before it is read, and nothing is allocated for it."""
    path = tmp_path / "log.osi"
    path.write_bytes(packed(TRUTHS[:7]) + struct.pack("<I", length) + packed(TRUTHS[8:]))
    tracemalloc.start()
    try:
        recording = read_log(path, name="log")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert recording.damage == "damaged after 0.600 s: 7 messages read (the file ends too early)"
    assert peak < 30e6


def test_sparse_file_of_one_message(tmp_path):
    """A message of 2 GiB is none, and is not read."""
    path = tmp_path / "log.osi"
    path.write_bytes(packed(TRUTHS) + struct.pack("<I", 2**31))
    with path.open("ab") as file:
        file.truncate(2**31 + 10**5)
    assert read_log(path, name="log").damage == "damaged after 2.900 s: 30 messages read (something that is no message)"


def test_zeros(tmp_path):
    path = tmp_path / "log.osi"
    path.write_bytes(packed(TRUTHS[:3]) + bytes(1000))
    assert read_log(path, name="log").damage == "damaged after 0.200 s: 3 messages read (something that is no message)"


def test_messages_that_are_none(tmp_path):
    late = ground_truth(0, FRAMES[0][1])
    late.timestamp.seconds = 2**40
    before = ground_truth(0, FRAMES[0][1])
    before.timestamp.seconds = -1
    recording = read_log(
        trace(tmp_path, [*TRUTHS, b"\xff\xff", ground_truth(None, FRAMES[0][1]), late, before]), name="log"
    )
    assert len(recording.truth.stamp_ns) == 30
    assert recording.notes[1:4] == (
        "1 message cannot be decoded: skipped",
        "1 message without a time stamp: skipped",
        "2 messages with an impossible time stamp: skipped",
    )


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "the file is empty"),
        (b"\x05", "expected an OSI trace, found a file whose first bytes are 05"),
        (bytes(40), "expected an OSI trace, found a file whose first bytes are 00 00 00"),
        (
            b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n",
            "a git-lfs pointer, not the recording itself",
        ),
        (packed([b"\xff" * 90]), "its messages can be told for none of osi3.GroundTruth"),
    ],
)
def test_files_that_are_none(tmp_path, content, why):
    path = tmp_path / "log.osi"
    path.write_bytes(content)
    assert problem(path).startswith(why)


# ------------------------------------------------------------------------------- commands


def run(*arguments: str, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr("sys.argv", ["copem-replay", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_replay_is_a_multi_channel_trace(tmp_path, monkeypatch, capsys):
    """With the messages of the input on a channel of their own, which OSI's own library reads."""
    monkeypatch.chdir(tmp_path)
    for message in TRUTHS:
        message.version.version_major, message.version.version_minor, message.version.version_patch = 3, 5, 0
    trace(tmp_path, TRUTHS, "drive.osi")
    Path("e.yaml").write_text(changed(ALL_COUNT, "logs: [drive.osi]", "show: {run: 0}"))
    assert run("run", "e.yaml", monkeypatch=monkeypatch) == 0, capsys.readouterr().err
    replay = Path("out/e/replay.mcap")
    with replay.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        records = {r.name: r.metadata for r in reader.iter_metadata()}
        found = [(c.metadata, m, d) for _, c, m, d in reader.iter_decoded_messages(topics=["GroundTruth"])]
    assert [m.data for _, m, _ in found] == [m.SerializeToString() for m in TRUTHS]
    assert [m.log_time for _, m, _ in found] == [k * 10**8 for k in range(30)]
    assert found[7][2].moving_object[0].base.position.x == 7.0
    assert found[0][0]["net.asam.osi.trace.channel.osi_version"] == "3.5.0"
    assert records[OSI_RECORD]["min_osi_version"] == "3.5.0"
    read_back = OSITrace(str(replay), "GroundTruth", topic="GroundTruth")
    assert [message.timestamp.nanos for message in read_back][:3] == [0, 10**8, 2 * 10**8]
    read_back.close()
    assert len(read_log(replay, name="log").truth.stamp_ns) == 30


def test_info_and_init(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    trace(tmp_path, VIEWS, BY_NAME.format("sv"))
    assert run("info", BY_NAME.format("sv"), monkeypatch=monkeypatch) == 0
    assert "  SensorView  osi3.SensorView  protobuf        30  the truth" in capsys.readouterr().out.splitlines()
    assert run("init", BY_NAME.format("sv"), monkeypatch=monkeypatch) == 0
    Path("begin.yaml").write_text(capsys.readouterr().out)
    assert run("check", "begin.yaml", monkeypatch=monkeypatch) == 0, capsys.readouterr().err
