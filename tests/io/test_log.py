"""MCAP files as they come: sound, without index, cut off, hit, and files that are none."""

import io
import random
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType

from copem_replay.core.errors import RecordingError
from copem_replay.io import log
from copem_replay.io.containers.mcap_records import MAGIC
from copem_replay.io.open import open_log
from copem_replay.io.recording import Recording, read_log
from tests.helpers.recordings import Obj, Topic, truth_topic, write_mcap, write_recording

# Ten frames 0.1 s apart; with `chunk_size=1` every message has a chunk of its own.
FRAMES = [(k / 10, [Obj(id=1, x=10.0 * k, vx=100.0)]) for k in range(10)]
CUT_OFF = "the file ends too early"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


def problem(path: Path) -> str:
    """The one line that says why a file cannot be read."""
    with pytest.raises(RecordingError) as caught:
        read_log(path, name="log")
    (line,) = caught.value.problems
    assert "\n" not in line
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


def outcome(path: Path) -> Recording | tuple[str, ...]:
    """What reading gives: a recording, or the lines that say why not. Anything else is a defect."""
    try:
        return read_log(path, name="log")
    except RecordingError as error:
        return error.problems


# ------------------------------------------------------------------------------- files that are none


def test_absent_file(path):
    assert problem(path) == "no such file"


def test_directory(tmp_path):
    assert problem(tmp_path) == "expected a recording, found a folder without metadata.yaml"


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.osi.xz", b"\xfd7zXZ\0", "compressed as a whole, which is not read; unpack it first: xz -d a.osi.xz"),
        (
            "a.mcap.zstd",
            b"\x28\xb5\x2f\xfd",
            "compressed as a whole, which is not read; unpack it first: zstd -d a.mcap",
        ),
        ("a.txth", b"version {", "text, which is not read; OSI traces are read as .osi (messages in binary) or .mcap"),
        ("a.txt", b"\x0a$$__$$", "text, which is not read; OSI traces are read as .osi"),
        ("metadata.yaml", b"rosbag2:", "the description of a rosbag2 folder; give the folder it is in"),
    ],
)
def test_files_that_are_known_otherwise(tmp_path, name, content, why):
    path = tmp_path / name
    path.write_bytes(content)
    assert problem(path).startswith(why)


def test_empty_file(path):
    path.touch()
    assert problem(path) == "the file is empty"


def test_git_lfs_pointer(path):
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    assert problem(path) == "a git-lfs pointer, not the recording itself (`git lfs pull` fetches it)"


MADE = "; docs/guide/data-sets.md says what makes a recording of such files"
BYTES = "a file whose first bytes are"


def test_a_bag_of_ros_1(path):
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(200))
    assert problem(path) == (
        "a bag of ROS 1, which is not read; `rosbags-convert --src FILE --dst FOLDER --dst-storage mcap` makes a "
        "folder of it that is"
    )


@pytest.mark.parametrize(
    ("name", "content", "found"),
    [
        ("table.csv", b"t,id,x,y\r\n0.0,1,3.5,4\r\n", "a table with the columns t,id,x,y" + MADE),
        ("labels.json", b'{\n "openlabel": {', "text that begins with '{'" + MADE),
        ("notes", "größer\n".encode(), "text that begins with 'größer'"),
        ("notes", b"x" * 63 + "ü".encode(), f"text that begins with '{'x' * 63}'"),  # cut off within a character
        ("picture", b"\x89PNG\r\n\x1a\n" + bytes(60), f"{BYTES} 89 50 4e 47 0d 0a 1a 0a" + " 00" * 8),
        ("latin", "größer\n".encode("latin-1"), f"{BYTES} 67 72 f6 df 65 72 0a"),
        ("nearly", b"text\x00", f"{BYTES} 74 65 78 74 00"),
    ],
)
def test_another_format_says_what_it_begins_with(path, name, content, found):
    path = path.with_name(name)
    path.write_bytes(content)
    assert problem(path) == f"expected an MCAP file, found {found}"


def test_nothing_but_the_magic(path):
    path.write_bytes(MAGIC)
    assert problem(path) == f"damaged, and no message can be read ({CUT_OFF})"


def test_file_without_permission_to_read(path, monkeypatch):
    write_recording(path, FRAMES)

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(log, "_File", refuse)
    assert problem(path) == "cannot be opened: Permission denied"


class Failing(io.FileIO):
    """A disk that gives the first hundred bytes and the index, and nothing between them."""

    def readinto(self, buffer):
        if 100 <= self.tell() < 500:
            raise OSError(5, "Input/output error")
        return super().readinto(memoryview(buffer)[:50])


def test_a_disk_that_fails_is_no_damage(path, monkeypatch):
    """It is not taken for a recording that ends early."""
    write_recording(path, FRAMES)
    monkeypatch.setattr(log, "_File", type("OnIt", (log._File, Failing), {}))
    assert problem(path) == "cannot be read: Input/output error"


# ------------------------------------------------------------------------------- sound files of every kind


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.ZSTD},
        {"chunk_size": 1},
        {"enable_data_crcs": True},
        {"enable_crcs": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.MESSAGE},
        {"use_chunking": False, "enable_data_crcs": True},
        {"use_statistics": False},
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"repeat_channels": False, "use_statistics": False},
        {"profile": "osi2mcap"},
        {"profile": "ros2"},
    ],
    ids=str,
)
def test_all_kinds_of_files_read_the_same_and_need_no_note(path, options):
    recording = read_log(write_recording(path, FRAMES, **options), name="log")
    assert recording.truth.x_m[0].tolist() == [0, 10, 20, 30, 40, 50, 60, 70, 80, 90]
    assert recording.notes == ()
    assert recording.damage is None


def test_channels_of_one_topic_and_of_one_schema_name_are_kept_apart(path):
    topics = [truth_topic(FRAMES[:5]), truth_topic(FRAMES[5:]), Topic("truth", "", [(0, b"x")], "json")]
    write_mcap(path, topics)
    assert [c.messages for c in open_log(path).channels] == [5, 5, 1]
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 10
    assert recording.notes == ("1 message of no schema (json) not read",)


# ------------------------------------------------------------------------------- damaged files


def last_chunk_start(path: Path) -> int:
    """Where the file's last chunk begins."""
    with path.open("rb") as file:
        return make_reader(file).get_summary().chunk_indexes[-1].chunk_start_offset


def test_cut_off_in_a_chunk(path):
    write_recording(path, FRAMES, chunk_size=1)
    path.write_bytes(path.read_bytes()[: last_chunk_start(path) + 30])
    recording = read_log(path, name="log")
    assert recording.truth.x_m[0].tolist() == [0, 10, 20, 30, 40, 50, 60, 70, 80]
    assert recording.damage == f"damaged after 0.800 s: 9 messages read ({CUT_OFF})"
    assert recording.notes == (recording.damage,)


def test_cut_off_between_records(path):
    write_recording(path, FRAMES, chunk_size=1)
    path.write_bytes(path.read_bytes()[: last_chunk_start(path)])
    assert read_log(path, name="log").damage == f"damaged after 0.800 s: 9 messages read ({CUT_OFF})"


def test_cut_off_in_the_only_chunk(path):
    write_recording(path, FRAMES)
    path.write_bytes(path.read_bytes()[: last_chunk_start(path) + 60])
    assert problem(path) == f"damaged, and no message can be read ({CUT_OFF})"


@pytest.mark.parametrize("compression", list(CompressionType))
def test_of_a_chunk_that_is_cut_off_what_is_there_is_read(path, compression):
    """Many recordings are one chunk. Of 2,000 messages that hardly compress, about 6 in 10 are in 6 tenths of it."""
    rng = random.Random(2)
    frames = [(k / 10, [Obj(id=i, x=rng.random(), y=rng.random()) for i in range(9)]) for k in range(2000)]
    write_recording(path, frames, compression=compression, chunk_size=1 << 24)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    recording = read_log(path, name="log")
    count = len(recording.truth.stamp_ns)
    assert 800 < count < 1300
    assert recording.damage == f"damaged after {(count - 1) / 10:.3f} s: {count} messages read ({CUT_OFF})"
    x = [o.x for _, objects in frames[:count] for o in objects if o.id == 0]
    assert recording.truth.x_m[0, :count].tolist() == x


def test_after_a_damaged_chunk_the_next_is_read(path):
    write_recording(path, FRAMES, chunk_size=1, compression=CompressionType.NONE)
    with path.open("rb") as file:
        fourth = make_reader(file).get_summary().chunk_indexes[3].chunk_start_offset
    data = bytearray(path.read_bytes())
    data[fourth + 9 + 8 + 8 + 8 + 4 + 4 + 8 + 50] ^= 0x10
    path.write_bytes(data)
    recording = read_log(path, name="log")
    assert recording.truth.x_m[0].tolist() == [0, 10, 20, 40, 50, 60, 70, 80, 90]
    assert recording.damage == "damaged: 9 of 10 messages read (the checksum of a Chunk record fails)"


def test_cut_off_in_a_message_without_chunks(path):
    write_recording(path, FRAMES, use_chunking=False)
    data = path.read_bytes()
    end_of_data = data.rindex(FRAMES_LAST := truth_topic(FRAMES).messages[-1][1]) + len(FRAMES_LAST)
    path.write_bytes(data[: end_of_data - 3])
    assert read_log(path, name="log").damage == f"damaged after 0.800 s: 9 messages read ({CUT_OFF})"


def test_a_bit_flipped_anywhere_in_a_file_without_chunks_is_noticed(path):
    """It is refused, or read with what is damaged: one bit made 4.25 m of a length of 4 m."""
    whole = write_recording(path, FRAMES[:2], use_chunking=False, enable_data_crcs=True).read_bytes()
    for bit in range(8 * len(MAGIC), 8 * (len(whole) - len(MAGIC)), 29):
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        read = outcome(path)
        assert isinstance(read, tuple) or read.damage is not None, f"bit {bit}"


def test_the_end_of_the_data_is_missing(path):
    """The record with the checksum was hit in its kind: the messages are read, and are not trusted."""
    write_recording(path, FRAMES, use_chunking=False, enable_data_crcs=True)
    data = bytearray(path.read_bytes())
    at = data.rindex(b"\x0f" + (4).to_bytes(8, "little"))
    data[at] = 0x8F  # a record of some other program
    path.write_bytes(data)
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 10
    assert recording.damage == ("damaged after 0.900 s: 10 messages read (the record that ends the data is missing)")


def test_no_checksum_is_over_the_messages(path):
    """As several writers do by default: nothing can tell a changed bit, which a note says."""
    recording = read_log(write_recording(path, FRAMES, use_chunking=False), name="log")
    assert recording.notes == (
        "no checksum is over its messages: bits that changed since it was written are not noticed",
    )
    assert recording.damage is None


def test_recorder_was_killed(path):
    write_recording(path, FRAMES, chunk_size=1, finish=False)
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 10
    assert recording.damage == f"damaged after 0.900 s: 10 messages read ({CUT_OFF})"


def test_last_bytes_missing(path):
    write_recording(path, FRAMES)
    path.write_bytes(path.read_bytes()[:-10])
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 10
    assert recording.damage == (
        f"damaged: its index cannot be used ({CUT_OFF}): read from start to end, no message is lost"
    )


def test_hit_in_the_index(path):
    write_recording(path, FRAMES)
    data = bytearray(path.read_bytes())
    data[data.rindex(b"osi3.GroundTruth")] ^= 1  # the schema's name is no longer that of the truth
    path.write_bytes(data)
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 10
    assert recording.damage == (
        "damaged: its index cannot be used (the checksum of the index fails): "
        "read from start to end, no message is lost"
    )


def test_hit_in_a_chunk_that_the_index_points_at(path):
    write_recording(path, FRAMES, chunk_size=1, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    data[last_chunk_start(path) + 9 + 8 + 8 + 8 + 4 + 4 + 8 + 50] ^= 0x10  # inside the records of the chunk
    path.write_bytes(data)
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 9
    assert recording.damage == ("damaged after 0.800 s: 9 of 10 messages read (the checksum of a Chunk record fails)")


def test_hit_in_the_only_chunk(path):
    write_recording(path, FRAMES, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    data[last_chunk_start(path) + 200] ^= 0x10
    path.write_bytes(data)
    assert problem(path) == "damaged, and no message can be read (the checksum of a Chunk record fails)"


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_flipped_bit_anywhere_gives_a_recording_or_one_line(path, compression):
    """500 files with one flipped bit each: no traceback, and no more messages than there were."""
    frames = [(k / 10, [Obj(id=i, x=10.0 * k) for i in range(4)]) for k in range(12)]
    write_recording(path, frames, chunk_size=400, compression=compression, host=2)
    whole = path.read_bytes()
    rng = random.Random(1)
    for _ in range(500):
        data = bytearray(whole)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        found = outcome(path)
        if isinstance(found, Recording):
            assert 1 <= len(found.truth.stamp_ns) <= 12
        else:
            assert len(found) == 1


def test_cut_off_anywhere_gives_a_recording_or_one_line(path):
    write_recording(path, FRAMES, chunk_size=1)
    whole = path.read_bytes()
    read_frames = []
    for length in range(len(MAGIC), len(whole), 7):
        path.write_bytes(whole[:length])
        found = outcome(path)
        if isinstance(found, Recording):
            assert found.damage is not None
            read_frames.append(len(found.truth.stamp_ns))
        else:
            assert found == (f"{path}: damaged, and no message can be read ({CUT_OFF})",)
            read_frames.append(0)
    assert read_frames == sorted(read_frames)  # the more is left, the more is read
    assert set(read_frames) == set(range(11))
