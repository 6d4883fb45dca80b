"""Files of rosbag2's SQLite storage: with their folder and alone, as MCAP of the same messages."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from copem_replay.core.errors import RecordingError
from copem_replay.io.log import Log
from copem_replay.io.open import open_log
from copem_replay.io.window import Window
from copem_replay.io.write.source import open_source
from tests.helpers.ros2 import STORE, odometry

KIND = "nav_msgs/msg/Odometry"
T0_NS = 1_795_869_296 * 10**9


def write_bag(folder: Path, plugin: StoragePlugin) -> Path:
    """Five messages on each of two topics, the later ones first in the file."""
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        for name in ("/odom", "/other"):
            connection = writer.add_connection(name, KIND, typestore=STORE)
            for k in (4, 3, 2, 1, 0):
                message = STORE.serialize_cdr(odometry(k / 10, 1.0 * k, 0.0), KIND)
                writer.write(connection, T0_NS + k * 10**8, message)
    return folder


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "drive", StoragePlugin.SQLITE3)


def content(log: Log) -> list[tuple[str, str, str, str, int, bytes]]:
    """The messages of each channel, with all that channels say."""
    return sorted(
        (c.topic, c.schema, c.encoding, c.schema_encoding, t, data)
        for c in log.channels
        for _, t, data in log.payloads(frozenset({c.number}))
    )


def test_a_folder_a_file_alone_and_mcap_are_the_same(bag: Path, tmp_path: Path) -> None:
    as_mcap = open_log(write_bag(tmp_path / "mcap" / "drive", StoragePlugin.MCAP))
    alone = tmp_path / "al#one 100%25?.db3"  # signs of a URL
    shutil.copy(bag / "drive.db3", alone)
    for log in (open_log(bag), open_log(alone)):
        assert content(log) == content(as_mcap)
        assert [c.messages for c in log.channels] == [5, 5]
        assert (log.start_ns, log.end_ns) == (T0_NS, T0_NS + 4 * 10**8)
        assert {c.schema_data for c in log.channels} == {c.schema_data for c in as_mcap.channels}
        times = [t for _, t, _ in log.payloads(frozenset(c.number for c in log.channels))]
        assert times == sorted(times)


def test_a_window_and_a_copy(bag: Path) -> None:
    path = bag / "drive.db3"
    log = open_log(path)
    numbers = frozenset(c.number for c in log.channels)
    kept = log.within(Window(T0_NS + 10**8, T0_NS + 2 * 10**8, 0))
    assert {t - T0_NS for _, t, _ in kept.payloads(numbers)} == {10**8, 2 * 10**8}
    assert not list(log.payloads(frozenset()))
    source = open_source(path)
    assert len(list(source.messages({n: n for n in numbers}))) == 10
    assert source.damage is None


def problem(path: Path) -> str:
    with pytest.raises(RecordingError) as error:
        list(open_log(path).payloads(frozenset({1, 2})))
    return str(error.value).removeprefix(f"{path}: ")


def test_other_and_damaged_files_are_one_line(bag: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.db3"
    with sqlite3.connect(other) as database:
        database.execute("CREATE TABLE cats (name TEXT)")
    assert problem(other).startswith("of SQLite, but damaged or none of rosbag2 (Cannot open database other.db3 or")
    cut = tmp_path / "cut.db3"
    cut.write_bytes((bag / "drive.db3").read_bytes()[:9000])
    assert problem(cut).startswith("of SQLite, but damaged or none of rosbag2 (")
    head = tmp_path / "head.db3"
    head.write_bytes(b"SQLite format 3\0" + bytes(84))
    assert problem(head).startswith("of SQLite, but damaged or none of rosbag2 (")


def test_what_its_recorder_did_not_write_into_it_is_said(bag: Path) -> None:
    Path(f"{bag / 'drive.db3'}-wal").write_bytes(b"x")
    (note,) = open_log(bag / "drive.db3").notes
    assert note == "drive.db3-wal beside it is not read: its recorder did not end; `ros2 bag reindex` takes it in"
