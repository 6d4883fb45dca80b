"""Windows of recordings: as if only the messages in it had been recorded, and nothing else touched."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from copem_replay.cli import main as cli
from copem_replay.core.errors import EmptyWindowError, RecordingError
from copem_replay.core.tracks import VALUES
from copem_replay.core.yaml import dump_yaml
from copem_replay.core.yaml import parse_yaml as read_yaml
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import read_logs
from copem_replay.io import log as container
from copem_replay.io.containers import mcap_records as chunks
from copem_replay.io.open import open_log
from copem_replay.io.recording import Recording, read_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers.experiments import changed
from tests.helpers.recordings import (
    SHARED,
    Obj,
    Topic,
    ground_truth,
    ns,
    pedestrian,
    truth_topic,
    write_mcap,
    write_recording,
)
from tests.helpers.replays import study_rows
from tests.helpers.ros2 import header, made, odometry, pose, topic, transform
from tests.io.test_osi_trace import packed
from tests.io.test_recorded_units import car, list_of
from tests.io.test_rosbag2 import described
from tests.io.test_world_frame import json_topic

START_S = 1000.0  # of the recordings: windows count from their truth, stamps from elsewhere
NEVER_ENDS = float("inf")


def drive(path: Path, *, seconds: int = 10, **container: Any) -> Path:
    """OSI at 10 Hz, the other car coming nearer, a walker who appears at 4 s; lists of a unit, 50 ms later each."""
    frames: list[tuple[float | None, list[Obj]]] = []
    lists = []
    for k in range(10 * seconds + 1):
        t = k / 10
        objects = [Obj(id=1, x=2.0 * t, vx=2.0), Obj(id=2, x=90.0 - 8 * t, vx=-8.0)]
        frames.append((START_S + t, [*objects, *([pedestrian(3, 30.0, 4.0 - t / 2)] if t >= 4 else [])]))
        lists.append(list_of(START_S + t + 0.05, car(90.0 - 8 * t, vx=-8.0, track=5), captured_s=START_S + t))
    return write_recording(path, frames, host=1, more=[Topic("rsu", "osi3.SensorData", lists)], **container)


def ros_topics() -> list[Topic]:
    """Markers in the frame of a lidar, which is where /tf_static said at the start, on an ego that odometry places.

    Odometry is logged 0.3 s after its stamp.
    """
    lists, poses = [], []
    for k in range(101):
        t = START_S + k / 10
        poses.append((t + 0.3, odometry(t, 0.5 * k, 0.0, yaw_deg=k / 5, speed=5.0)))
        markers = [
            made(
                "visualization_msgs/msg/Marker",
                header=header(t, "lidar"), ns=kind, id=number, type=1,
                pose=pose(20.0 + number - 0.1 * k, 2.0 * number, 0.8, 30.0), scale=_vector(4.0, 1.8, 1.6),
            )
            for kind, number in (("car", 1), ("pedestrian", 2))
        ]  # fmt: skip
        lists.append((t, made("visualization_msgs/msg/MarkerArray", markers=markers)))
    mounted = made("tf2_msgs/msg/TFMessage", transforms=[transform(START_S, "base_link", "lidar", 1.0, 0.5, 10.0)])
    return [
        topic("/tf_static", "tf2_msgs/msg/TFMessage", [(START_S - 0.5, mounted)]),
        topic("/odom", "nav_msgs/msg/Odometry", poses),
        topic("/boxes", "visualization_msgs/msg/MarkerArray", lists),
    ]


def _vector(x: float, y: float, z: float) -> Any:
    return made("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def alone(path: Path, target: Path, from_s: float, to_s: float, beyond: Mapping[str, float] | None = None) -> Path:
    """The messages logged between two instants, as another tool reads and writes them.

    `beyond`: topics of which more is kept, by seconds.
    """
    target.parent.mkdir(exist_ok=True)
    numbers: dict[tuple[str, str], int] = {}
    with target.open("wb") as file:
        writer = Writer(file)
        writer.start()
        with path.open("rb") as content:
            for schema, channel, message in make_reader(content).iter_messages():
                more_s = (beyond or {}).get(channel.topic, 0.0)
                logged_s = message.log_time / 1e9 - START_S
                if schema is None or not from_s - more_s - 1e-9 <= logged_s <= to_s + more_s + 1e-9:
                    continue
                key = (channel.topic, schema.name)
                if key not in numbers:
                    number = writer.register_schema(schema.name, schema.encoding, schema.data)
                    numbers[key] = writer.register_channel(channel.topic, channel.message_encoding, number)
                writer.add_message(numbers[key], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


POSES = {"/tf_static": NEVER_ENDS, "/odom": 2.0}


def plan(**changes: Any) -> Experiment:
    data: dict[str, Any] = {
        "version": 1,
        "logs": ["x"],
        "runs": 3,
        "pems": {"p": [{"detection": {"kind": "constant", "probability": 0.4},
                        "error": {"kind": "gaussian", "covariance_m2": [[1.0, 0.2], [0.2, 1.0]]}}]},
        "units": {"ego": {"on": "ego", "height_m": 1.8, "pem": "p"}},
        "configurations": {"GT": {"units": "truth"}, "PEM": {"units": ["ego"], "latency_s": 0.2}},
        "measure": {"onset": {"kind": "appears"}, "began": ["log_start", "appeared"]},
    }  # fmt: skip
    return Experiment.model_validate(data | changes)


RSU = {"rsu": {"recorded": {"topic": "rsu", "covariance_m2": [[0.25, 0.0], [0.0, 0.25]]}}}


def replayed(path: Path, **changes: Any) -> tuple[Recording, pd.DataFrame]:
    wanted = plan(**changes)
    recordings, refused = read_logs(wanted, [path], None)
    assert not refused, refused
    return recordings[0], study_rows(run_experiment(wanted, recordings))


def check_same(cut: tuple[Recording, pd.DataFrame], whole: tuple[Recording, pd.DataFrame]) -> None:
    """The same world, unit's lists and results; draws are by the log's name, which is the same."""
    for one, other in ((cut[0].truth, whole[0].truth), *zip(_lists(cut[0]), _lists(whole[0]), strict=True)):
        for name in ("start", "object_ix", "frame_ix", "stamp_ns", "captured_s", "arrives_s", "valid", *VALUES):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    assert cut[0].scene.object_ids == whole[0].scene.object_ids
    assert len(cut[1]), "nothing to compare"
    pd.testing.assert_frame_equal(cut[1], whole[1])


def _lists(recording: Recording) -> list[Any]:
    return [found.tracks for found in recording.lists.values()]


@pytest.mark.parametrize("how", ["indexed", "without index", "one chunk", "topic after topic"])
def test_osi_and_a_recorded_unit(tmp_path: Path, how: str) -> None:
    """Between 3.9 and 6.25 s: 24 frames, and the lists logged then."""
    options: dict[str, Any] = {
        "indexed": {"chunk_size": 500},
        "without index": {"chunk_size": 500, "finish": False},
        "one chunk": {},
        "topic after topic": {"chunk_size": 500, "by_time": False},
    }[how]
    path = drive(tmp_path / "a.mcap", **options)
    configurations = {"GT": {"units": "truth"}, "rsu": {"units": ["rsu", "ego"], "fusion": {"kind": "gnn"}}}
    units = {"ego": {"on": "ego", "height_m": 1.8, "pem": "p"}} | RSU
    both = {"configurations": configurations, "units": units}
    cut = replayed(path, window_s=[3.9, 6.25], **both)
    assert len(cut[0].truth.stamp_ns) == 24
    assert cut[0].truth.captured_s[[0, -1]].tolist() == pytest.approx([0.0, 2.3])  # a log of its own
    ((rsu,)) = _lists(cut[0])
    assert len(rsu.stamp_ns) == 24  # logged from 3.95 to 6.25 s
    assert cut[0].notes[0 if how != "without index" else 1].startswith("window 3.9 – 6.25 s of the recording: ")
    whole = drive(tmp_path / "whole.mcap")
    check_same(cut, replayed(alone(whole, tmp_path / "alone" / "a.mcap", 3.9, 6.25), **both))


@pytest.mark.parametrize("window_s", [(None, 2.0), (7.5, None), (3.0, 3.0), (0.0, 500.0)])
def test_ends_that_are_left_out_and_bounds(tmp_path: Path, window_s: tuple[float | None, float | None]) -> None:
    path = drive(tmp_path / "a.mcap", chunk_size=500)
    from_s, to_s = (-1.0 if window_s[0] is None else window_s[0], 99.0 if window_s[1] is None else window_s[1])
    cut = replayed(path, window_s=window_s)
    assert len(cut[0].truth.stamp_ns) == {(None, 2.0): 21, (7.5, None): 26, (3.0, 3.0): 1}.get(window_s, 101)
    if window_s != (3.0, 3.0):  # one frame is no log to measure in
        check_same(cut, replayed(alone(path, tmp_path / "alone" / "a.mcap", from_s, to_s)))


def test_a_window_without_bounds_is_none(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap")
    recording = read_log(path, name="a", window_s=(None, None))
    assert (recording.window, recording.notes) == (None, read_log(path, name="a").notes)


def test_seconds_count_from_the_first_message_of_the_truth(tmp_path: Path) -> None:
    """Another topic begins 5 s earlier; the log times are not the stamps."""
    frames = [(500 + k / 10, [Obj(id=1, x=1.0 * k)]) for k in range(50)]
    early = Topic("other", "my.Schema", [(ns(START_S - 5 + k / 10), b"") for k in range(100)])
    log_s = [START_S + k / 10 for k in range(50)]
    path = write_recording(tmp_path / "a.mcap", frames, log_s=log_s, more=[early], chunk_size=1)
    recording = read_log(path, name="a", window_s=(1.0, 1.2))
    assert recording.truth.x_m[0].tolist() == [10.0, 11.0, 12.0]
    assert recording.scene.t0_ns == ns(501.0)


class TestRos2:
    def test_with_odometry_and_transforms(self, tmp_path: Path) -> None:
        """The ego has a place in the last frame, whose pose is logged after the window; and so has the lidar."""
        path = write_mcap(tmp_path / "a.mcap", ros_topics(), profile="ros2", chunk_size=2000)
        cut = replayed(path, window_s=[6.0, 8.0])
        assert cut[0].scene.object_ids[-1] == "ego"
        first, last = cut[0].truth.start[-2:]
        assert cut[0].truth.x_m[0, first:last].tolist() == pytest.approx([0.5 * k for k in range(60, 81)])
        assert cut[0].around is not None
        assert cut[0].around.ego is not None
        assert cut[0].around.ego.stamp_ns[[0, -1]].tolist() == [ns(START_S + 3.7), ns(START_S + 9.7)]
        check_same(cut, replayed(alone(path, tmp_path / "alone" / "a.mcap", 6.0, 8.0, POSES)))

    @pytest.mark.parametrize("finish", [True, False], ids=["indexed", "the last without index"])
    def test_a_folder_of_several_files(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, finish: bool) -> None:
        """Cut every 2 s; the window is in the fourth and the fifth, its poses from the third on."""
        bag = tmp_path / "bag"
        bag.mkdir()
        for k in range(6):
            span = range(ns(START_S + 2 * k - (k == 0)), ns(START_S + 2 * k + 2))
            parts = [replace(t, messages=[m for m in t.messages if m[0] in span]) for t in ros_topics()]
            write_mcap(bag / f"{k}.mcap", parts, chunk_size=2000, finish=finish or k < 5)
        described(bag, [f"{k}.mcap" for k in range(6)])
        log = open_log(bag)
        read_from = _files_opened(monkeypatch, log, _window(6.2, 8.4))
        assert read_from == {"0.mcap", "2.mcap", "3.mcap", "4.mcap", "5.mcap"}  # the first: /tf_static
        (boxes,) = (c.number for c in log.channels if c.topic == "/boxes")
        assert _files_opened(monkeypatch, log, _window(6.2, 8.4), {boxes}) == {"3.mcap", "4.mcap"}
        whole = write_mcap(tmp_path / "whole.mcap", ros_topics())
        inside = alone(whole, tmp_path / "alone" / "bag.mcap", 6.2, 8.4, POSES)
        check_same(replayed(bag, window_s=[6.2, 8.4]), replayed(inside))

    def test_poses_that_are_not_there(self, tmp_path: Path) -> None:
        """Odometry that ends 5 s before the window."""
        topics = ros_topics()
        topics[1] = replace(topics[1], messages=topics[1].messages[:30])
        path = write_mcap(tmp_path / "a.mcap", topics)
        with pytest.raises(RecordingError) as caught:
            read_log(path, name="a", window_s=(9.0, 10.0))
        assert str(caught.value) == f"{path}: ego: no pose on topic '/odom' in the window"

    @pytest.mark.parametrize("encoding", ["cdr", "json"])
    def test_lists_of_a_unit_that_are_not_there(self, tmp_path: Path, encoding: str) -> None:
        """In JSON only messages say what is in them; here there are none."""
        topics = ros_topics()
        early = topics[2].messages[:30]
        scenes = json_topic("/unit", [(t / 1e9, {"entities": []}) for t, _ in early], schema="foxglove.SceneUpdate")
        topics.append(scenes if encoding == "json" else replace(topics[2], name="/unit", messages=early))
        path = write_mcap(tmp_path / "a.mcap", topics)
        recorded = {"topic": "/unit", "covariance_m2": [[0.2, 0.0], [0.0, 0.2]]}
        wanted = plan(
            units={"u": {"recorded": recorded}},
            configurations={"u": {"units": ["u"]}},
            read={"topic": "/boxes"},
            window_s=[5.0, 9.0],
        )
        _, refused = read_logs(wanted, [path], None)
        assert [r.reason for r in refused] == ["/unit: holds no list in the window"]


def _window(from_s: float, to_s: float) -> container.Window:
    return container.Window(ns(START_S + from_s), ns(START_S + to_s))


def _files_opened(
    monkeypatch: pytest.MonkeyPatch, log: container.Log, window: container.Window, numbers: set[int] | None = None
) -> set[str]:
    opened = set()
    with monkeypatch.context() as patched:
        real = container.open_file
        patched.setattr(container, "open_file", lambda path: opened.add(path.name) or real(path))
        list(log.within(window).messages(numbers or {c.number for c in log.channels}))
    return opened


def test_a_trace(tmp_path: Path) -> None:
    times = [START_S + k / 10 for k in range(40)]
    frames = [(t, [Obj(id=1, x=1.0 * k, vx=10.0), Obj(id=2, x=50.0)]) for k, t in enumerate(times)]
    one = truth_topic(frames, host=1)
    path = tmp_path / "log_gt_3.8.0_6.33.1_40_x.osi"
    path.write_bytes(packed([payload for _, payload in one.messages[::-1]]))
    inside = write_mcap(tmp_path / f"{path.stem}.mcap", [replace(one, messages=one.messages[10:21])])
    check_same(replayed(path, window_s=[1.0, 2.0]), replayed(inside))


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """When the chunks that are decompressed through an index begin, in ns."""
    begun: list[int] = []
    read_chunk = chunks.read_chunk

    def watching(body: bytes, allowance: chunks.ChunkAllowance) -> Iterator[Any]:
        begun.append(struct.unpack_from("<Q", body)[0])
        return read_chunk(body, allowance)

    monkeypatch.setattr(chunks, "read_chunk", watching)
    return begun


@pytest.mark.parametrize("standing", [True, False])
def test_other_chunks_are_not_decompressed(tmp_path: Path, watched: list[int], standing: bool) -> None:
    """One message a chunk: the first, by which seconds are counted, and those of the window.

    Of a truth whose messages do not all have what stands, those before may have, and are read.
    """
    wall = [Obj(id=9, x=40, stationary=True)] if standing else []
    frames = [(START_S + k / 10, [Obj(id=1, x=0.2 * k), *wall]) for k in range(101)]
    path = write_recording(tmp_path / "a.mcap", frames, chunk_size=1)
    read_log(path, name="a", window_s=(3.0, 3.4))
    before = [0.0] if standing else [k / 10 for k in range(30)]
    assert {round(t / 1e9 - START_S, 3) for t in watched} == {*before, 3.0, 3.1, 3.2, 3.3, 3.4}


def spoilt(path: Path, first: int, last: int) -> None:
    """Chunks of a file made unreadable."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    content = bytearray(path.read_bytes())
    for c in sorted(summary.chunk_indexes, key=lambda c: c.message_start_time)[first:last]:
        end = c.chunk_start_offset + c.chunk_length
        content[end - 8 : end] = b"\xff" * 8
    path.write_bytes(content)


class TestDamage:
    """A file of 202 chunks, of which one by one list and frame."""

    def test_elsewhere_is_not_met(self, tmp_path: Path) -> None:
        path = drive(tmp_path / "a.mcap", chunk_size=1)
        spoilt(path, 2, 40)
        spoilt(path, 150, 202)
        cut = replayed(path, window_s=[3.0, 6.0], units={"ego": {"on": "ego", "height_m": 1.8, "pem": "p"}} | RSU)
        assert cut[0].damage is None
        assert len(cut[0].truth.stamp_ns) == 31

    def test_in_it_is_said(self, tmp_path: Path) -> None:
        """Frames of 4.0 and 4.5 s, and what is between, are lost."""
        path = drive(tmp_path / "a.mcap", chunk_size=1)
        spoilt(path, 80, 91)
        recording = read_log(path, name="a", window_s=(3.0, 6.0))
        assert recording.damage is not None
        assert recording.damage.startswith("damaged: what is lost may be of the window (")
        assert len(recording.truth.stamp_ns) == 31 - 6
        assert recording.window is not None


class TestRefused:
    @pytest.mark.parametrize("finish", [True, False], ids=["indexed", "without index"])
    def test_beyond_the_end(self, tmp_path: Path, finish: bool) -> None:
        path = drive(tmp_path / "a.mcap", chunk_size=500, finish=finish)
        with pytest.raises(EmptyWindowError) as caught:
            read_log(path, name="a", window_s=(10.01, 20.0))
        assert str(caught.value) == (
            f"{path}: truth: no message in the window 10.01 – 20 s; there are some from 0 to 10 s"
        )

    @pytest.mark.parametrize("beyond", [False, True], ids=["near the end", "long before the end"])
    def test_what_there_is_though_other_topics_go_on(self, tmp_path: Path, beyond: bool) -> None:
        others = Topic("other", "my.Schema", [(ns(START_S + 25 * beyond + k), b"") for k in range(5)])
        frames = [(START_S + k / 10, [Obj(id=1)]) for k in range(11)]
        path = write_recording(tmp_path / "a.mcap", frames, more=[others], chunk_size=1)
        with pytest.raises(EmptyWindowError, match=r"window from 1\.5 s on; there are some from 0 to 1 s$"):
            read_log(path, name="a", window_s=(1.5, None))


# ---------------------------------------------------------------------------------------------- the command line


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """The command in a folder with `drive.mcap` and `e.yaml`: exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "drive.mcap", chunk_size=2000)
    (tmp_path / "e.yaml").write_text(
        changed("show: {run: 0}", "measure: {onset: {kind: appears}, began: [log_start, appeared]}")
    )

    def called(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["copem-replay", *words])
        capsys.readouterr()
        code = cli._run_to_exit_code()
        return code, *capsys.readouterr()

    return called


WINDOW = ("--from", "2", "--to", "7.5")


def test_results_of_a_window(call: Callable[..., Any], tmp_path: Path) -> None:
    """They run as they are; the replay holds the window, and replays as it; figures and pages are made of them."""
    assert call("check", "e.yaml", *WINDOW)[0] == 0
    code, _, said = call("run", "e.yaml", "--out", "cut", *WINDOW)
    assert code == 0
    assert "note: drive: window 2 – 7.5 s of the recording: seconds count from there" in said
    assert "window_s:" in (tmp_path / "cut/experiment.yaml").read_text()
    provenance = json.loads((tmp_path / "cut/provenance.json").read_text())
    assert provenance["window_s"] == [2.0, 7.5]
    assert provenance["logs"][0]["sha256"] == hashlib.sha256((tmp_path / "drive.mcap").read_bytes()).hexdigest()

    assert call("run", "cut/experiment.yaml", "--out", "again")[0] == 0
    for name in ("detections.parquet", "summary.csv", "replay.mcap", "provenance.json"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    alone(tmp_path / "drive.mcap", tmp_path / "only" / "drive.mcap", 2.0, 7.5)
    assert call("run", "e.yaml", "--log", "only/drive.mcap", "--out", "whole")[0] == 0
    assert _rows("cut") == _rows("whole")

    inputs = [m for m in _messages(tmp_path / "cut/replay.mcap") if not m[0].startswith("copem/")]
    assert inputs == list(_messages(tmp_path / "only/drive.mcap"))
    (tmp_path / "third").mkdir()
    (tmp_path / "cut/replay.mcap").rename(tmp_path / "third/drive.mcap")
    assert call("run", "e.yaml", "--log", "third/drive.mcap", "--out", "back")[0] == 0
    assert _rows("cut") == _rows("back")

    assert call("plot", "cut")[0] == 0
    assert call("report", "cut")[0] == 0
    assert call("compare", "cut", "again", "--baseline", "again:GT", "--rrd", "both.rrd")[0] == 0
    assert (tmp_path / "both.rrd").stat().st_size > 0
    assert call("run", "e.yaml", "--out", "all")[0] == 0
    assert call("compare", "cut", "all")[::2] == (
        2, "all: window_s: expected [2.0, 7.5] as in cut, found null\n",
    )  # fmt: skip


def _rows(folder: str) -> Any:
    return pd.read_parquet(f"{folder}/detections.parquet").to_csv()


def _messages(path: Path) -> Iterator[tuple[str, int, bytes]]:
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            yield channel.topic, message.log_time, message.data


@pytest.mark.parametrize("finish", [True, False], ids=["indexed", "without index"])
def test_the_replay_of_a_ros2_window_replays_as_it(call: Callable[..., Any], tmp_path: Path, finish: bool) -> None:
    """Static transforms are in it wholly, poses with their margin, all else within the window only."""
    write_mcap(tmp_path / "drive.mcap", ros_topics(), profile="ros2", chunk_size=2000, finish=finish)
    asked = ("run", "e.yaml", "--from", "4", "--to", "6", "--out", "cut")
    assert call(*asked)[0] == 0
    found: dict[str, list[float]] = {}
    for name, time_ns, _ in _messages(tmp_path / "cut/replay.mcap"):
        found.setdefault(name, []).append(round(time_ns / 1e9 - START_S, 3))
    ends = {name: (times[0], times[-1]) for name, times in found.items() if not name.startswith("copem/")}
    assert ends == {"/tf_static": (-0.5, -0.5), "/odom": (2.0, 8.0), "/boxes": (4.0, 6.0)}
    (tmp_path / "third").mkdir()
    (tmp_path / "cut/replay.mcap").rename(tmp_path / "third/drive.mcap")
    assert call("run", "e.yaml", "--log", "third/drive.mcap", "--out", "back")[0] == 0
    assert _rows("cut") == _rows("back")


def test_attachments_records_and_channels_are_kept(tmp_path: Path, call: Callable[..., Any]) -> None:
    """A window has all that is not a message, and channels without one in it."""
    frames = truth_topic([(START_S + k / 10, [Obj(id=1), Obj(id=2, x=20.0)]) for k in range(40)], host=1)
    with (tmp_path / "drive.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=100)
        writer.start()
        truth, other = (writer.register_schema(name, "protobuf", b"") for name in ("osi3.GroundTruth", "my.Schema"))
        first, second = writer.register_channel("truth", "protobuf", truth), writer.register_channel("o", "raw", other)
        writer.add_message(second, ns(START_S), b"early", ns(START_S))
        for time_ns, payload in frames.messages:
            writer.add_message(first, time_ns, payload, time_ns)
        writer.add_attachment(5, 6, "map.png", "image/png", b"picture")
        writer.add_metadata("weather", {"rain": "no"})
        writer.finish()
    assert call("run", "e.yaml", "--from", "1", "--to", "3", "--out", "cut")[0] == 0
    with Path("cut/replay.mcap").open("rb") as file:
        reader = make_reader(file)
        assert [a.data for a in reader.iter_attachments()] == [b"picture"]
        assert {m.name for m in reader.iter_metadata()} >= {"weather"}
        summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = {c.topic: summary.statistics.channel_message_counts.get(n, 0) for n, c in summary.channels.items()}
    assert (counts["truth"], counts["o"]) == (21, 0)


@pytest.mark.parametrize(
    ("options", "in_file", "said"),
    [
        (("--from", "11"), "", "--from: drive.mcap: truth: no message in the window from 11 s on; "
         "there are some from 0 to 10 s"),
        (("--from", "11", "--to", "12"), "", "--from, --to: drive.mcap: truth: no message in the window 11 – 12 s; "
         "there are some from 0 to 10 s"),
        (("--from", "3", "--to", "2"), "", "--from, --to: expected [from, to], found one that ends (2 s) before it "
         "begins (3 s)"),
        (("--to", "2"), "window_s: [3, 5]", "--to: expected [from, to], found one that ends (2 s) before it begins "
         "(3 s)"),
        (("--to", "-2"), "", "--to: expected at least 0, found -2.0"),
        (("--from", "nan"), "", "--from: expected a finite number, found nan"),
        ((), "window_s: [11, 12]", "e.yaml:19: window_s: drive.mcap: truth: no message in the window 11 – 12 s; "
         "there are some from 0 to 10 s"),
        (("--from", "3"), "window_s: [1, x]", "e.yaml:19: window_s[1]: expected a number, found 'x'"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("command", ["check", "run"])
def test_refusals(
    call: Callable[..., Any], tmp_path: Path, command: str, options: tuple[str, ...], in_file: str, said: str
) -> None:
    (tmp_path / "e.yaml").write_text(changed(*([in_file] if in_file else [])))
    assert call(command, "e.yaml", *options)[::2] == (2, f"{said}\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [((), [3.0, 5.0]), (("--to", "8"), [3.0, 8.0]), (("--from", "4"), [4.0, 5.0]), (WINDOW, [2.0, 7.5])],
)
def test_options_take_the_place_of_what_the_file_says(
    call: Callable[..., Any], tmp_path: Path, options: tuple[str, ...], expected: list[float]
) -> None:
    every = "measure: {began: [log_start, crossed, appeared]}"
    (tmp_path / "e.yaml").write_text(changed("window_s: [3, 5]", every))
    assert call("run", "e.yaml", "--out", "cut", *options)[0] == 0
    data, _, _ = read_yaml((tmp_path / "cut/experiment.yaml").read_text())
    assert data["window_s"] == expected


def test_a_window_of_each_of_several_logs(call: Callable[..., Any], tmp_path: Path) -> None:
    """Seconds count in each of its own; the second is too short."""
    drive(tmp_path / "short.mcap", seconds=3)
    every = "measure: {began: [log_start, crossed, appeared]}"
    (tmp_path / "e.yaml").write_text(changed("logs: [drive.mcap, short.mcap]", "window_s: [2, 2.5]", every))
    assert call("run", "e.yaml", "--out", "cut")[0] == 0
    data, _, _ = read_yaml((tmp_path / "cut/experiment.yaml").read_text())
    assert dump_yaml(data).count("window_s") == 1
    code, _, said = call("run", "e.yaml", "--from", "4", "--to", "5", "--skip-unreadable", "--out", "one")
    assert code == 1
    assert "note: short.mcap: skipped: truth: no message in the window 4 – 5 s; there are some from 0 to 3 s" in said


# ---------------------------------------------------------------------------------------------------- properties


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[int]]:
    """Forty messages, not evenly spaced, several at one instant, in small chunks; and when they were logged."""
    times_ns = np.cumsum(np.random.default_rng(1).choice([0, 1, 10**7, 3 * 10**8], 40)).tolist()
    messages = [(t, f"{k}".encode()) for k, t in enumerate(times_ns)]
    topics = [Topic("a", "x", messages[::2]), Topic("b", "x", messages[1::2])]
    path = tmp_path_factory.mktemp("small") / "a.mcap"
    return write_mcap(path, topics, chunk_size=60, compression=CompressionType.NONE), times_ns


@given(st.data())
def test_consecutive_windows_hold_every_message_once(small: tuple[Path, list[int]], data: st.DataObject) -> None:
    path, times_ns = small
    near = st.sampled_from(times_ns).flatmap(lambda t: st.integers(max(t - 1, 0), t + 1))
    cuts = sorted(set(data.draw(st.lists(near | st.integers(0, times_ns[-1]), max_size=6))))
    log = open_log(path)
    ends = zip([0, *[c + 1 for c in cuts]], [*cuts, times_ns[-1]], strict=True)
    windows = [container.Window(first, last) for first, last in ends]
    found = [[m.data for m in log.within(w).messages({1, 2})] for w in windows]
    assert sorted(int(d) for part in found for d in part) == list(range(40))
    for window, part in zip(windows, found, strict=True):
        assert len(part) == sum(window.from_ns <= t <= window.to_ns for t in times_ns)


NUSCENES = SHARED / "nuscenes_scene0916_autoware_ros2.mcap"


@pytest.mark.skipif(not NUSCENES.exists(), reason="the recording is not there")
def test_a_recorded_drive() -> None:
    """States in the window are those of the whole, where nothing is derived from what is outside."""
    whole, cut = (read_log(NUSCENES, name="a", window_s=w) for w in (None, (5.0, 9.0)))
    assert 0 < len(cut.truth.stamp_ns) < len(whole.truth.stamp_ns)
    kept = np.isin(whole.truth.stamp_ns[whole.truth.frame_ix], cut.truth.stamp_ns)
    assert int(kept.sum()) == len(cut.truth.frame_ix)


@pytest.mark.parametrize("kind", ["osi", "osi trace", "scene", "markers"])
def test_what_is_sent_once_before_the_window_stands_in_it(tmp_path: Path, kind: str) -> None:
    """A car drives, a wall is sent at 0.5 s alone."""
    times = [k / 10 for k in range(31)]

    def scene(t: float) -> dict[str, Any]:
        def entity(name: str, x: float) -> dict[str, Any]:
            at = {"position": {"x": x, "y": 0, "z": 1}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
            cube = {"pose": at, "size": {"x": 4, "y": 2, "z": 2}}
            return {"id": name, "timestamp": {"sec": int(t), "nsec": ns(t) % 10**9}, "frame_id": "map", "cubes": [cube]}

        return {"entities": [entity("car", 5 * t), *([entity("wall", 40.0)] if t == 0.5 else [])]}

    def markers(t: float) -> bytes:
        def marker(name: str, x: float) -> Any:
            type_ = "visualization_msgs/msg/Marker"
            size, at = _vector(4.0, 2.0, 2.0), pose(x, 0, 1)
            return made(type_, header=header(t, "map"), ns=name, id=1, type=1, pose=at, scale=size)

        boxes = [marker("car", 5 * t), *([marker("wall", 40.0)] if t == 0.5 else [])]
        return made("visualization_msgs/msg/MarkerArray", markers=boxes)

    frames = [(t, [Obj(id=1, x=5 * t)] + [Obj(id=9, x=40, stationary=True)] * (t == 0.5)) for t in times]
    if kind == "osi trace":
        path = tmp_path / "a_gt_.osi"
        path.write_bytes(packed([ground_truth(t, objects).SerializeToString() for t, objects in frames]))
    elif kind == "osi":
        path = write_recording(tmp_path / "a.mcap", frames)
    else:
        topics = {
            "scene": lambda: json_topic("/scene", [(t, scene(t)) for t in times], schema="foxglove.SceneUpdate"),
            "markers": lambda: topic("/boxes", "visualization_msgs/msg/MarkerArray", [(t, markers(t)) for t in times]),
        }
        path = write_mcap(tmp_path / "a.mcap", [topics[kind]()])

    def wall(window_s: tuple[float | None, float | None] | None) -> list[float]:
        found = read_log(path, name="a", window_s=window_s)
        of = next(k for k, name in enumerate(found.scene.object_ids) if name in ("9", "wall", "wall/1"))
        at_s = found.truth.row_captured_s[found.truth.row_object_ix == of] + found.scene.t0_ns * 1e-9
        return at_s.round(3).tolist()

    assert wall(None) == times[5:]
    assert wall((1.0, 2.0)) == times[10:21]
    assert wall((0.3, None)) == times[5:]
