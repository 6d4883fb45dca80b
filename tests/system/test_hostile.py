"""Hostile recordings: what was hit, lies about its size or nests without end is refused in a line, or read in part."""

from __future__ import annotations

import json
import os
import random
import struct
import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_lane_pb2 import LaneBoundary

from copem_replay.core.errors import CopemError, RecordingError
from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.io.containers.mcap_records import CHUNK_LIMIT_BYTES
from copem_replay.io.recording import read_log

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import fuzz  # noqa: E402
from fuzzing.containers import TARGETS, put  # noqa: E402
from fuzzing.mcap_model import Message, Model, Piece, Raw, Sample, record, taken_apart  # noqa: E402
from fuzzing.mutators import bomb, varint  # noqa: E402
from fuzzing.samples import json_updates, markers, poses_and_lists, protobuf_updates  # noqa: E402

OSI = taken_apart(ROOT / "logs/tc016d.mcap", 10)
TOO_LARGE = "a chunk holds more than 128 MiB"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


def written(path: Path, *pieces: Piece, indexed: bool = True, **more: object) -> Path:
    path.write_bytes(Model(list(pieces), indexed=indexed, **more).written())  # type: ignore[arg-type]
    return path


def whole(sample: Sample) -> Piece:
    return Piece([*sample.schemas, *sample.channels, *sample.messages])


def line(path: Path) -> str:
    """The one line that says why a file is refused; looking at it says the same."""
    with pytest.raises(RecordingError) as caught:
        read_log(path, name="log")
    (problem,) = caught.value.problems
    assert problem.isprintable()
    assert survey_recording(path).reason == problem
    return problem.removeprefix(f"{path}: ")


watched = pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(), reason="the memory of a process is watched through /proc"
)


@pytest.mark.long
@watched
def test_a_thousand_hostile_files_end_well():
    """Recordings of every format, hit in every way: each is read or refused, none for long or with much memory."""
    found = fuzz.fuzz(1000, 6, most=12, own=True)
    assert found["defects"] == []
    assert found["inputs"] == 1000
    assert found["outcomes"]["read"] > 250  # not all is refused: what was hit is also read
    assert found["outcomes"]["refused"] > 150
    assert found["past_header"] > 500


@pytest.mark.long
@watched
@pytest.mark.parametrize(("target", "inputs"), [("experiment", 40), ("results", 8), ("fit", 12), ("convert", 100)])
def test_commands_on_what_is_hostile_end_well(target, inputs):
    """Each ends well or is refused in lines; a run over damaged results gives what it always gives."""
    found = fuzz.fuzz(inputs, 6, target=target)
    assert found["defects"] == []
    assert found["inputs"] == inputs
    assert found["past_header"] >= inputs / 2


@pytest.mark.long
@watched
def test_hostile_maps_end_well():
    """Maps of every format are read and added to a recording, or refused in lines."""
    found = fuzz.fuzz(300, 6, target=fuzz.MAP)
    assert found["defects"] == []
    assert found["inputs"] == 300
    assert found["past_header"] > 60


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are found through /proc")
@pytest.mark.parametrize(("command", "kills"), [("convert", 10), ("fit", 2)])
def test_killed_commands_leave_the_old_or_the_new(command, kills):
    """The recording, the fit or the page is whole, and after the next call nothing lies beside it."""
    tool = [sys.executable, ROOT / "tools/kill_runs.py", command, "--kills", str(kills)]
    ended = subprocess.run(tool, cwd=ROOT, capture_output=True, text=True, timeout=500)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert f"{kills} kills" in ended.stdout
    assert "wrong: 0;" in ended.stdout


def test_inputs_come_in_every_container(tmp_path):
    made = [put([poses_and_lists(), OSI], f"1:{k}", tmp_path)[0] for k in range(60)]
    assert {p.suffix for p in made} == {".mcap", ".osi", ""}
    assert all(p.exists() for p in made)


def test_inputs_of_one_target(tmp_path):
    for target, suffix in zip(TARGETS, (".mcap", ".osi", ""), strict=True):
        made = [put([poses_and_lists(), OSI], f"1:{k}", tmp_path, target)[0] for k in range(5)]
        assert {p.suffix for p in made} == {suffix}


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("claimed", [1 << 31, 1000])
@pytest.mark.parametrize("indexed", [True, False])
def test_decompression_bomb(path, compression, claimed, indexed):
    """2 GiB in some kilobytes or megabytes, whatever they claim: the chunk is damage, what is beside it is read."""
    content, checksum = bomb(compression, 1 << 31, b"\0")
    sample = json_updates()
    written(path, whole(sample), Piece([], compression, claimed, checksum, content), indexed=indexed)
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 20
    assert recording.damage == f"damaged after 1.900 s: 20 messages read ({TOO_LARGE})" if not indexed else True
    assert recording.notes[0] == recording.damage


def test_bomb_and_nothing_else(path):
    content, checksum = bomb("zstd", 1 << 31, b"\0")
    sample = json_updates()
    sample.messages.clear()
    written(path, whole(sample), Piece([], "zstd", 1 << 31, checksum, content), indexed=False)
    assert line(path) == f"damaged, and no message can be read ({TOO_LARGE})"


def test_many_small_bombs(path):
    """Each within the limit of a chunk, together far more than a file of this size can hold."""
    content, checksum = bomb("zstd", 1 << 26, record(0x80, bytes(10_000)))
    written(path, whole(json_updates()), *[Piece([], "zstd", None, checksum, content)] * 40, indexed=False)
    assert read_log(path, name="log").damage == (
        "damaged after 1.900 s: 20 messages read (its chunks hold more than 1000 times the size of the file)"
    )


def test_many_bombs(path):
    content, checksum = bomb("zstd", 1 << 30, b"\0")
    written(path, *[Piece([], "zstd", None, checksum, content)] * 40, whole(json_updates()), indexed=False)
    assert line(path) == f"damaged, and no message can be read ({TOO_LARGE})"


def test_chunk_of_the_shortest_records(path):
    content, checksum = bomb("zstd", 1 << 25, record(0x80, b""))
    written(path, whole(json_updates()), Piece([], "zstd", None, checksum, content), indexed=False)
    assert read_log(path, name="log").damage == (
        "damaged after 1.900 s: 20 messages read (a chunk holds more than 262144 records)"
    )


def test_a_bomb_takes_no_more_memory_than_a_chunk(path):
    content, checksum = bomb("lz4", 1 << 31, b"\0")
    written(path, whole(json_updates()), Piece([], "lz4", 1000, checksum, content))
    tracemalloc.start()
    try:
        read_log(path, name="log")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1.5 * CHUNK_LIMIT_BYTES


@pytest.mark.parametrize("length", [2**63, 2**64 - 1, 10**6])
def test_absurd_length_of_a_message(path, length):
    """What is before it is read; mcap's reader would take the rest of the chunk for the message."""
    sample = json_updates()
    hit = Raw(5, sample.messages[7].body(), length)
    written(path, Piece([*sample.schemas, *sample.channels, *sample.messages[:7], hit, *sample.messages[8:]]))
    assert read_log(path, name="log").damage == "damaged after 0.600 s: 7 of 19 messages read (the file ends too early)"


def test_message_shorter_than_its_head(path):
    sample = json_updates()
    hit = Raw(5, b"\1\0", 2)
    written(path, Piece([*sample.schemas, *sample.channels, *sample.messages[:7], hit]))
    assert read_log(path, name="log").damage == "damaged after 0.600 s: 7 of 7 messages read (the file ends too early)"


@pytest.mark.parametrize("claimed", [2**40, 2**64 - 1])
def test_absurd_size_of_a_chunk(path, claimed):
    sample = json_updates()
    piece = whole(sample)
    piece.claimed = claimed
    written(path, piece)
    assert line(path) == f"damaged, and no message can be read ({TOO_LARGE})"


@pytest.mark.parametrize("indexed", [True, False])
def test_a_definition_larger_than_any(path, indexed):
    """A schema of many chunks, 160 MB in each: read over and over it took 50 s and 1.3 GB."""
    sample = json_updates()
    assert len(sample.schemas) == 1
    sample.schemas[0].data = bytes((16 << 20) + 1)
    written(path, whole(sample), indexed=indexed)
    assert line(path) == "damaged, and no message can be read (a definition takes more than 16 MiB)"


def test_absurd_length_of_a_name(path):
    sample = json_updates()
    body = struct.pack("<HHI", 1, 1, 2**32 - 1) + b"/objects"
    written(path, Piece([*sample.schemas, Raw(4, body, len(body)), *sample.messages]), indexed=False)
    assert line(path) == "damaged, and no message can be read (the file ends too early)"


def test_index_that_promises_more_than_there_is(path):
    sample = json_updates()
    written(path, whole(sample), counts={1: 2**62})
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 20
    assert recording.damage == (
        "damaged: its index cannot be used (the index promises 4611686018427387904 messages, and there are 20): "
        "read from start to end, no message is lost"
    )


def test_index_that_points_anywhere(path):
    written(path, whole(json_updates()), offsets={0: 2**63})
    assert len(read_log(path, name="log").truth.stamp_ns) == 20


@pytest.mark.parametrize("depth", [100, 100_000])
def test_deep_nesting(path, depth):
    """JSON and protobuf messages that nest without end are messages that cannot be decoded."""
    for sample, payload in (
        (json_updates(), b'{"entities":[' * depth + b"]}" * depth),
        (json_updates(), b"[" * depth),
        (protobuf_updates(), b"\x0b" * depth),
    ):
        sample.messages[0].data = payload
        written(path, whole(sample))
        recording = read_log(path, name="log")
        assert len(recording.truth.stamp_ns) >= 19
        assert depth == 100 or any("cannot be decoded: skipped" in note for note in recording.notes)


def test_messages_of_messages(path):
    data = b""
    for _ in range(3000):
        data = b"\x12" + varint(len(data)) + data
    sample = protobuf_updates()
    sample.messages[0].data = data
    written(path, whole(sample))
    assert "1 message cannot be decoded: skipped" in read_log(path, name="log").notes


def test_definition_without_end(path):
    sample = markers()
    sample.schemas[0].data = b"visualization_msgs/MarkerArray[] markers\n"
    written(path, whole(sample))
    assert line(path) == (
        "/markers: the definition of visualization_msgs/msg/MarkerArray is nested without end "
        "(visualization_msgs/msg/MarkerArray)"
    )


def test_names_cannot_break_a_line(path):
    sample = json_updates()
    sample.channels[0].topic = b"a\nb\x1b[31m"
    sample.schemas[0].name = b"some\nthing"
    written(path, whole(sample))
    assert r"; it holds some\nthing (json) on a\nb\x1b[31m; " in line(path)


def test_errors_are_lines():
    assert CopemError("a\nb\tc").problems == (r"a\nb\tc",)


@pytest.mark.parametrize("time_ns", [2**63, 2**64 - 1])
def test_log_time_beyond_all_clocks(path, time_ns):
    for sample in (json_updates(), poses_and_lists()):
        sample.messages[-1].log_time = time_ns
        written(path, whole(sample))
        assert "1 message logged at an impossible time: skipped" in read_log(path, name="log").notes


@pytest.mark.parametrize("value", ["NaN", "1e308", "-1e308", "1e999", "null", '"\\ud800"', "1" + "0" * 5000])
def test_absurd_numbers_in_json(path, value):
    sample = json_updates()
    for number, message in enumerate(sample.messages[:3]):
        said = json.loads(message.data)
        said["entities"][number]["cubes"][0]["pose"]["position"]["x"] = "HERE"
        message.data = json.dumps(said).replace('"HERE"', value).encode()
    written(path, whole(sample))
    recording = read_log(path, name="log")
    assert len(recording.truth.frame_ix) == 57 or len(recording.truth.frame_ix) == 51
    assert any("skipped" in note for note in recording.notes)


def test_schema_of_another_channel(path):
    sample = poses_and_lists()
    sample.schemas[0].data, sample.schemas[1].data = sample.schemas[1].data, sample.schemas[0].data
    written(path, whole(sample))
    assert "/markers: read." in line(path) or "/markers: the definition" in line(path)


def test_topic_of_several_schemas(path):
    """The list is read; which channel comes first does not matter."""
    sample = poses_and_lists()
    sample.channels[1].topic = sample.channels[2].topic = sample.channels[0].topic
    sample.channels[0].id, sample.channels[1].id = 2, 1
    for message in sample.messages:
        message.channel = {1: 2, 2: 1}.get(message.channel, message.channel)
    written(path, whole(sample))
    assert len(read_log(path, name="log").truth.stamp_ns) == 20


def test_message_of_no_channel(path):
    sample = json_updates()
    sample.messages[3] = Message(77, 0, 0, 0, b"")
    written(path, whole(sample))
    assert len(read_log(path, name="log").truth.stamp_ns) == 19


# A message may be small in the file, as large as a chunk out of it, and ten times as large once parsed.

EMPTY = 20_000_000  # objects: 2.3 GB as Google's parser has them, 1.4 GB as dictionaries
SURVEYED = """
import resource, sys
from pathlib import Path

resource.setrlimit(resource.RLIMIT_AS, (3 << 29, 3 << 29))
from copem_replay.experiment.draft.survey import survey_recording

print(survey_recording(Path(sys.argv[1])).reason)
"""


def inside(kind: type, name: str, content: bytes) -> bytes:
    """A field of a protobuf message that is a message itself."""
    number = kind.DESCRIPTOR.fields_by_name[name].number  # type: ignore[attr-defined]
    return varint(number << 3 | 2) + varint(len(content)) + content


def of_one_message(path: Path, sample: Sample, payload: bytes) -> Path:
    """A sample with that message alone, in a file that is not too small for its content."""
    ballast = Raw(0x80, random.Random(1).randbytes(300_000), 300_000)
    sample.messages[:] = [Message(sample.channels[0].id, 0, 0, 0, payload)]
    return written(path, Piece([*sample.schemas, *sample.channels, ballast, *sample.messages]))


def osi() -> Sample:
    return taken_apart(ROOT / "logs/tc016d.mcap", 1)


@pytest.mark.parametrize(
    ("sample", "payload"),
    [
        (json_updates, lambda: b'{"entities":[' + b"{}," * (EMPTY - 1) + b"{}]}"),
        (osi, lambda: inside(GroundTruth, "moving_object", b"") * EMPTY),
        (osi, lambda: inside(GroundTruth, "lane_boundary", inside(LaneBoundary, "boundary_line", b"") * EMPTY)),
        (protobuf_updates, lambda: b"\x12\0" * EMPTY),
    ],
    ids=["JSON", "OSI", "points of one OSI lane boundary", "protobuf"],
)
def test_millions_of_empty_objects_in_one_message_take_little_memory(path, sample, payload):
    """Less than 1.5 GB of addresses, which the interpreter and its libraries have 0.3 of."""
    of_one_message(path, sample(), payload())
    assert path.stat().st_size < 500_000
    ended = subprocess.run(
        [sys.executable, "-c", SURVEYED, str(path)], cwd=ROOT, capture_output=True, text=True, timeout=100,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (0, "")
    reason = ended.stdout.strip().removeprefix(f"{path}: ")
    assert reason.partition(": ")[2] == "a message would take more than 384 MiB of memory: no list of objects does"


def test_more_objects_than_a_city_has(path):
    of_one_message(path, osi(), inside(GroundTruth, "moving_object", b"") * 100_001)
    assert line(path) == "ground_truth: a message lists 100001 objects: expected at most 100000"
    entity = json.dumps(json.loads(json_updates().messages[0].data)["entities"][0])
    more = b',{"id":"a","cubes":[{"pose":{"position":{"x":1}}}]}' * 100_000
    of_one_message(path, json_updates(), f'{{"entities":[{entity}'.encode() + more + b"]}")
    assert line(path) == "/objects: a message lists 100001 objects: expected at most 100000"


def test_a_map_with_many_boundary_points_is_read(path):
    """They are no objects; a message as long is looked through before it is parsed."""
    truth = GroundTruth()
    truth.ParseFromString(osi().messages[0].data)
    boundary = truth.lane_boundary.add()
    for k in range(150_000):
        boundary.boundary_line.add().position.x = k / 7
    of_one_message(path, osi(), truth.SerializeToString())
    recording = read_log(path, name="log")
    assert max(map(len, recording.lane_boundaries)) == 150_000
    assert recording.damage is None


def test_all_messages_together(path, monkeypatch):
    """20 messages with 3 objects each: 400 B a message, or its own bytes, against so many sizes of the file."""
    for sample, text in ((OSI, "ground_truth: "), (json_updates(), "/objects: ")):
        written(path, whole(sample))
        read_log(path, name="log")
        with monkeypatch.context() as patch:
            patch.setattr("copem_replay.io.decoded_size.SMALL_BYTES", 0)
            patch.setattr("copem_replay.io.decoded_size.MOST_GROWTH", 0)
            assert line(path) == (
                f"{text}its messages would take more than 0 MiB and 0 times the size of the file in memory: "
                "no recording of traffic does"
            )
