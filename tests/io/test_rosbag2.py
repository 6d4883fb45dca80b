"""Folders of rosbag2: several MCAP files as one recording."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosWriter

from copem_replay.cli.main import main
from copem_replay.core.errors import RecordingError
from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.experiment.draft.template import describe_survey
from copem_replay.io.containers.rosbag2 import merge_streams
from copem_replay.io.log import Log
from copem_replay.io.open import open_log
from copem_replay.io.recording import Recording, read_log
from tests.helpers.experiments import ALL_COUNT, changed
from tests.helpers.recordings import Obj, Topic, truth_topic, write_mcap, write_recording
from tests.helpers.ros2 import STORE, odometry

# Thirty frames 0.1 s apart, cut into three files; the car drives 10 m/s.
FRAMES = [(k / 10, [Obj(id=1, x=1.0 * k, vx=10.0), Obj(id=2, x=50.0)]) for k in range(30)]


def described(folder: Path, names: Sequence[str], more: str = "") -> Path:
    lines = "".join(f"    - {name}\n" for name in names)
    text = (
        f"rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  relative_file_paths:\n{lines}{more}"
    )
    (folder / "metadata.yaml").write_text(text)
    return folder


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A folder of three files."""
    folder = tmp_path / "drive.2026"
    folder.mkdir()
    for k in range(3):
        write_recording(folder / f"bag_{k}.mcap", FRAMES[10 * k : 10 * k + 10], host=1, chunk_size=1)
    return described(folder, [f"bag_{k}.mcap" for k in range(3)])


def x_m(recording: Recording) -> list[float]:
    """Where the car is, frame by frame."""
    first, last, *_ = recording.truth.start.tolist()
    return [float(x) for x in recording.truth.x_m[0, first:last]]


def problem(path: Path) -> str:
    """The one line that says why a folder cannot be read; looking at it says the same."""
    with pytest.raises(RecordingError) as caught:
        read_log(path, name="log")
    (line,) = caught.value.problems
    assert line.isprintable()
    assert survey_recording(path).reason == line
    return line.replace(f"{path}", "BAG")


def test_files_of_a_folder_are_one_recording(bag):
    recording = read_log(bag, name="log")
    assert recording.scene.object_ids == ("1", "2")
    assert len(recording.truth.start) == 3  # two tracks: nothing is cut where a file ends
    assert x_m(recording) == [1.0 * k for k in range(30)]
    assert recording.notes == ()
    (channel,) = open_log(bag).channels
    assert (channel.topic, channel.messages) == ("truth", 30)


def test_order_of_the_files_does_not_matter_for_times(bag):
    """Messages come in order of log time, whatever the description says first."""
    described(bag, ["bag_2.mcap", "bag_0.mcap", "bag_1.mcap"])
    log = open_log(bag)
    times = [time_ns for _, time_ns, _ in log.payloads(frozenset({1}))]
    assert times == [k * 10**8 for k in range(30)]
    assert log.start_ns == 0


def test_files_that_overlap_in_time(bag):
    write_recording(bag / "bag_0.mcap", FRAMES[::2], host=1)
    write_recording(bag / "bag_1.mcap", FRAMES[1::2], host=1)
    described(bag, ["bag_0.mcap", "bag_1.mcap"])
    assert [t for _, t, _ in open_log(bag).payloads(frozenset({1}))] == [k * 10**8 for k in range(30)]


def test_channels_are_joined_by_what_they_are_not_by_their_numbers(bag):
    """In the second file the truth is channel 2, and a topic of the same name is of another schema."""
    frames = truth_topic(FRAMES[10:20], host=1)
    write_mcap(bag / "bag_1.mcap", [Topic("truth", "", [(10**9, b"x")], "json"), frames])
    channels = open_log(bag).channels
    assert [(c.topic, c.schema, c.messages) for c in channels] == [("truth", "osi3.GroundTruth", 30), ("truth", "", 1)]
    assert len(read_log(bag, name="log").truth.stamp_ns) == 30


def test_only_the_files_that_are_at_their_time_are_open(bag, monkeypatch):
    """Split recordings of hours have more files than a process may open."""
    now, most = set(), []
    messages = Log.messages

    def watched(log, numbers, *, sort=False):
        now.add(log.path)
        most.append(len(now))
        yield from messages(log, numbers, sort=sort)
        now.discard(log.path)

    monkeypatch.setattr(Log, "messages", watched)
    log = open_log(bag)
    assert len(list(log.payloads(frozenset({1})))) == 30
    assert max(most) == 1


@given(st.lists(st.lists(st.integers(0, 9), min_size=1).map(sorted), max_size=5))
def test_merged_is_a_stable_sort(streams):
    """Of equal times the first stream's come first, and each stream keeps its order."""
    messages = [[Message(k, t, b"", t, n) for n, t in enumerate(times)] for k, times in enumerate(streams)]
    found = list(merge_streams([(times[0], list(of).__iter__) for times, of in zip(streams, messages, strict=True)]))
    assert found == sorted(itertools.chain(*messages), key=lambda m: m.log_time)


# ------------------------------------------------------------------------------- as other tools write them


def test_folder_as_rosbags_writes_it(tmp_path):
    """Its metadata.yaml and its MCAP; rosbags' own reader says the same messages."""
    folder = tmp_path / "ros"
    kind = "nav_msgs/msg/Odometry"
    with RosWriter(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/odom", kind, typestore=STORE)
        for k in range(5):
            writer.write(connection, k * 10**8, STORE.serialize_cdr(odometry(k / 10, 1.0 * k, 0.0), kind))
    log = open_log(folder)
    (channel,) = log.channels
    assert (channel.topic, channel.schema, channel.encoding, channel.messages) == ("/odom", kind, "cdr", 5)
    with Reader(folder) as reader:
        theirs = [(t, bytes(data)) for _, t, data in reader.messages()]
    assert [(t, data) for _, t, data in log.payloads(frozenset({1}))] == theirs
    assert problem(folder).startswith(
        "BAG: no list of true objects; it holds nav_msgs/msg/Odometry (cdr) on /odom; `read"
    )


def test_file_compressed_by_rosbags_is_refused(tmp_path):
    folder = tmp_path / "ros"
    writer = RosWriter(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=STORE)
    assert problem(folder) == (
        "BAG/ros.mcap.zstd: compressed as a whole, which is not read; unpack it first: zstd -d ros.mcap.zstd"
    )


def test_files_that_were_unpacked_are_read(bag):
    """`zstd -d` leaves the description as it was."""
    described(bag, [f"bag_{k}.mcap.zstd" for k in range(3)], "  compression_format: zstd\n  compression_mode: FILE\n")
    assert len(read_log(bag, name="log").truth.stamp_ns) == 30


# ------------------------------------------------------------------------------- descriptions


def test_files_may_be_named_under_files_only(bag):
    names = "".join(f"    - path: bag_{k}.mcap\n      message_count: 10\n" for k in range(3))
    (bag / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  version: 5\n  files:\n{names}")
    assert len(read_log(bag, name="log").truth.stamp_ns) == 30


def test_files_that_are_not_named_are_said(bag):
    described(bag, ["bag_0.mcap"])
    recording = read_log(bag, name="log")
    assert len(recording.truth.stamp_ns) == 10
    assert recording.notes == ("2 files that metadata.yaml does not name not read: bag_1.mcap …",)


REFUSED = {
    "a list": (
        "- 1\n",
        "BAG/metadata.yaml: expected the description of a rosbag2 folder, found no `rosbag2_bagfile_inf",
    ),
    "empty": (
        "",
        "BAG/metadata.yaml: expected the description of a rosbag2 folder, found no `rosbag2_bagfile_information`",
    ),
    "other": (
        "name: x\n",
        "BAG/metadata.yaml: expected the description of a rosbag2 folder, found no `rosbag2_bagfile_i",
    ),
    "no YAML": ("a: [1\nb: {", "BAG/metadata.yaml: not YAML: line 2: "),
    "no text": (b"\xff\xfe\0", "BAG/metadata.yaml: expected YAML, found text that is not UTF-8"),
    "too much": (
        "#" * (2**19 + 1),
        "BAG/metadata.yaml: expected the description of a rosbag2 folder, found more than 512",
    ),
    "deep": ("- " * 20_000, "BAG/metadata.yaml: not YAML: line 1: nested too deeply"),
}


@pytest.mark.parametrize(("content", "why"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_description(bag, content, why):
    (bag / "metadata.yaml").write_bytes(content if isinstance(content, bytes) else content.encode())
    assert problem(bag).startswith(why)


NAMED = {
    "none": ([], "BAG/metadata.yaml: names no file (`relative_file_paths`)"),
    "missing": (["bag_0.mcap", "bag_7.mcap"], "BAG/bag_7.mcap: no such file, but metadata.yaml names it"),
    "above": (["../x.mcap"], "BAG/metadata.yaml: expected files of the folder, found '../x.mcap'"),
    "elsewhere": (["/etc/hosts"], "BAG/metadata.yaml: expected files of the folder, found '/etc/hosts'"),
    "too long": (["a" * 300], f"BAG/{'a' * 300}: no such file, but metadata.yaml names it"),
    "the folder": (["."], "BAG: drive.2026: expected an MCAP file, found a directory"),
    "itself": (["metadata.yaml"], "BAG: metadata.yaml: the description of a rosbag2 folder; give the folder it is in"),
    "half a character": (['"\\ud800"'], "BAG/"),
}


@pytest.mark.parametrize(("names", "why"), NAMED.values(), ids=NAMED)
def test_files_that_cannot_be_read(bag, names, why):
    assert problem(described(bag, names)).startswith(why)


def test_messages_compressed_one_by_one_are_refused(bag):
    described(bag, ["bag_0.mcap"], "  compression_format: zstd\n  compression_mode: MESSAGE\n")
    assert problem(bag).startswith("BAG: its messages are compressed one by one, which is not read; `ros2 bag convert`")


def test_aliases_do_not_grow(bag):
    """Of a thousand million names none is made."""
    rows = "".join(f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 10)}]\n" for k in range(9))
    (bag / "metadata.yaml").write_text(f"a0: &a0 [x]\n{rows}rosbag2_bagfile_information:\n  relative_file_paths: *a9\n")
    assert problem(bag) == "BAG/metadata.yaml: names no file (`relative_file_paths`)"


def test_folder_without_description(bag):
    (bag / "metadata.yaml").unlink()
    assert problem(bag) == (
        "BAG: expected a recording, found a folder without metadata.yaml; name its files as logs of their own, or let "
        "`ros2 bag reindex` write it: then they are one"
    )


# ------------------------------------------------------------------------------- damage


def cut_off(path: Path) -> None:
    """In the eighth of ten messages, each of which has a chunk of its own."""
    with path.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[7]
    path.write_bytes(path.read_bytes()[: chunk.chunk_start_offset + 30])


def test_damage_is_said_of_its_file(bag):
    """The last file lost its end: what is before it is read."""
    cut_off(bag / "bag_2.mcap")
    recording = read_log(bag, name="log")
    assert recording.damage == "damaged after 2.600 s: 27 messages read (bag_2.mcap: the file ends too early)"
    assert len(recording.truth.stamp_ns) == 27
    assert recording.notes == (recording.damage,)


def test_damage_in_the_middle(bag):
    first = bag / "bag_0.mcap"
    with first.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[3]
    content = bytearray(first.read_bytes())
    content[chunk.chunk_start_offset + chunk.chunk_length - 3] ^= 0xFF
    first.write_bytes(content)
    recording = read_log(bag, name="log")
    assert recording.damage is not None
    assert recording.damage.startswith("damaged: 29 of 30 messages read (bag_0.mcap: ")
    assert len(recording.truth.start) == 3  # one frame is gone, the tracks are not cut


def test_file_that_cannot_be_read_at_all(bag):
    """As a recorder leaves the last one when the power fails."""
    (bag / "bag_2.mcap").write_bytes(b"")
    recording = read_log(bag, name="log")
    assert recording.damage == "damaged: 20 messages read (bag_2.mcap: the file is empty)"


def test_no_file_can_be_read(bag):
    for k in range(3):
        (bag / f"bag_{k}.mcap").write_bytes(b"x")
    assert problem(bag) == (
        "BAG: bag_0.mcap: expected an MCAP file, found text that begins with 'x'; and so on, 3 files in all"
    )


# ------------------------------------------------------------------------------- commands

SHOWN = "show: {run: 0}"


def run(*arguments: str, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr("sys.argv", ["copem-replay", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_a_folder_replays_as_one_file_does(bag, monkeypatch, capsys):
    """The same messages under the same name: the same tables, and the same messages in the replay."""
    monkeypatch.chdir(bag.parent)
    (bag.parent / "one").mkdir()
    write_recording(bag.parent / "one" / "drive.2026.mcap", FRAMES, host=1)
    for name, log in (("bag", "drive.2026"), ("one", "one/drive.2026.mcap")):
        Path(f"{name}.yaml").write_text(changed(ALL_COUNT, f"logs: [{log}]", SHOWN))
        assert run("run", f"{name}.yaml", monkeypatch=monkeypatch) == 0, capsys.readouterr().err
    of_bag, of_one = Path("out/bag"), Path("out/one")
    for table in ("detections.parquet", "summary.csv"):
        assert (of_bag / table).read_bytes() == (of_one / table).read_bytes()
    assert messages(of_bag / "replay.mcap") == messages(of_one / "replay.mcap")
    files = [(bag / f"bag_{k}.mcap").read_bytes() for k in range(3)]
    (log,), (alone,) = (json.loads((of / "provenance.json").read_text())["logs"] for of in (of_bag, of_one))
    assert log.pop("truth") == alone["truth"]
    assert log == {"log": "drive.2026", "topic": "truth", "sha256": hashlib.sha256(b"".join(files)).hexdigest()}
    assert run("check", "out/bag/experiment.yaml", monkeypatch=monkeypatch) == 0  # its paths lead to the folder


def messages(path: Path) -> list[tuple[str, str, int, bytes]]:
    """Sorted: messages of one instant have no order."""
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages()
        return sorted((c.topic, s.name if s else "", m.log_time, m.data) for s, c, m in found)


def test_results_of_a_folder_are_drawn_from_it_again(bag, monkeypatch, capsys):
    """As long as its files, one after the other, are what was replayed."""
    monkeypatch.chdir(bag.parent)
    Path("bag.yaml").write_text(changed(ALL_COUNT, "logs: [drive.2026]"))
    assert run("run", "bag.yaml", monkeypatch=monkeypatch) == 0
    capsys.readouterr()
    assert run("plot", "out/bag", monkeypatch=monkeypatch) == 0
    assert capsys.readouterr().err == ""
    write_recording(bag / "bag_2.mcap", FRAMES[20:29], host=1)
    assert run("plot", "out/bag", monkeypatch=monkeypatch) == 0
    assert "drive.2026: expected the log that was replayed, SHA-256" in capsys.readouterr().err


def test_records_of_the_files_are_kept_once(bag, monkeypatch):
    for k in range(3):
        with (bag / f"bag_{k}.mcap").open("wb") as file:
            out = Writer(file)
            out.start(profile="", library="tests")
            schema = out.register_schema("osi3.GroundTruth", "protobuf", b"")
            out.register_channel("beside", "json", 0)
            channel = out.register_channel("truth", "protobuf", schema, {"made": "by hand"})
            for time_ns, data in truth_topic(FRAMES[10 * k : 10 * k + 10], host=1).messages:
                out.add_message(channel, time_ns, data, time_ns)
            out.add_metadata("calibration", {"mast": "5 m"})
            out.add_attachment(0, 0, "map", "text/plain", b"the same in all")
            out.add_attachment(0, 0, "part", "text/plain", f"{k}".encode())
            out.finish()
    monkeypatch.chdir(bag.parent)
    Path("bag.yaml").write_text(changed(ALL_COUNT, "logs: [drive.2026]", SHOWN))
    assert run("run", "bag.yaml", monkeypatch=monkeypatch) == 0
    with Path("out/bag/replay.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        records = [r for r in reader.iter_metadata() if r.name == "calibration"]
        attachments = sorted((a.name, a.data) for a in reader.iter_attachments())
    ours = [c for c in summary.channels.values() if not c.topic.startswith("copem/")]
    assert sorted((c.topic, c.metadata) for c in ours) == [("beside", {}), ("truth", {"made": "by hand"})]
    assert [s.name for s in summary.schemas.values()].count("osi3.GroundTruth") == 1
    assert [r.metadata for r in records] == [{"mast": "5 m"}]
    assert attachments == [("map", b"the same in all"), ("part", b"0"), ("part", b"1"), ("part", b"2")]


def test_replay_of_a_damaged_folder_copies_what_there_is(bag, monkeypatch, capsys):
    cut_off(bag / "bag_2.mcap")
    (bag / "bag_1.mcap").write_bytes(b"")
    monkeypatch.chdir(bag.parent)
    Path("bag.yaml").write_text(changed(ALL_COUNT, "logs: [drive.2026]", SHOWN))
    assert run("run", "bag.yaml", monkeypatch=monkeypatch) == 0
    assert "damaged: its messages are copied as far as they can be read" in capsys.readouterr().err
    assert len([m for m in messages(Path("out/bag/replay.mcap")) if m[0] == "truth"]) == 17


def test_files_named_by_a_glob_are_logs_of_their_own(bag, monkeypatch, capsys):
    monkeypatch.chdir(bag.parent)
    Path("bag.yaml").write_text(changed(ALL_COUNT, "logs: [drive.2026/*.mcap]"))
    assert run("check", "bag.yaml", monkeypatch=monkeypatch) == 0
    assert capsys.readouterr().out.endswith("logs: bag_0, bag_1, bag_2\n")


@pytest.mark.parametrize("where", [".", "../drive.2026/", "../drive.2026"])
def test_name_of_a_folder_however_it_is_named(bag, monkeypatch, capsys, where):
    monkeypatch.chdir(bag)
    (bag.parent / "bag.yaml").write_text(changed(ALL_COUNT, "logs: [x]"))
    assert run("check", "../bag.yaml", "--log", where, monkeypatch=monkeypatch) == 0
    assert capsys.readouterr().out.endswith("logs: drive.2026\n")


def test_info_and_init_of_a_folder(bag, monkeypatch, capsys):
    monkeypatch.chdir(bag.parent)
    lines = describe_survey(survey_recording(Path("drive.2026")))
    assert lines[0] == "drive.2026"
    assert "experiment: copem-replay init drive.2026 > experiment.yaml" in lines
    assert run("init", "drive.2026", monkeypatch=monkeypatch) == 0
    Path("begin.yaml").write_text(capsys.readouterr().out)
    assert run("check", "begin.yaml", monkeypatch=monkeypatch) == 0, capsys.readouterr().err


def test_results_are_not_written_over_a_folder(bag, monkeypatch, capsys):
    monkeypatch.chdir(bag.parent)
    Path("bag.yaml").write_text(changed(ALL_COUNT, "logs: [drive.2026]"))
    before = sorted(os.listdir(bag))
    assert run("run", "bag.yaml", "--out", "drive.2026", "--overwrite", monkeypatch=monkeypatch) == 2
    assert "expected another folder, found a recording (rosbag2)" in capsys.readouterr().err
    assert sorted(os.listdir(bag)) == before
